//! The hands of the [`Lifecycle`](crate::launcher::lifecycle::Lifecycle): processes, the graph's shared memory, the log.

use std::collections::BTreeMap;
use std::io::PipeReader;
use std::process::ExitStatus;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::control::Reply;
use crate::dataflow::{Node, Program};
use crate::launcher::lifecycle::{StartOrder, Surroundings};
use crate::launcher::log_writer::Log;
use crate::launcher::process::{BegunProgram, LineSink, PreparedProgram, Process, Start};
use crate::launcher::service::Service;
use crate::launcher::starter::{begin, kill_process_of};
use crate::launcher::{Event, LaunchError};
use crate::plan::{Plan, Port};
use blindgrasp_operator::cursors::{SampleId, SharedCursors};
use blindgrasp_operator::diagnostics::LinePrinter;
use blindgrasp_operator::wiring::{Command, LogEntry};
use blindgrasp_operator::{monotonic_nanos, namespace};

/// A launcher that has not looked for longer than this was stopped.
const AWAY_NANOS: u64 = 1_000_000_000;

pub(super) struct Hands {
    pub(super) plan: Plan,
    pub(super) cursors: SharedCursors,
    /// The program that has the ports of nodes in other languages.
    pub(super) host: Option<Program>,
    /// The processes by instance.
    pub(super) processes: BTreeMap<u64, Process>,
    /// The programs that have not begun, by their first instance. Each tells its process id before it begins.
    pub(super) starting: BTreeMap<u64, (Vec<Start>, PipeReader)>,
    /// The log of each node.
    pub(super) logs: Vec<Log>,
    pub(super) is_on_terminal: bool,
    /// Prints to stderr, and does not wait for its reader.
    pub(super) printer: Arc<Mutex<LinePrinter>>,
    /// The launcher's own log.
    pub(super) own_log: Option<Log>,
    pub(super) service: Service,
    pub(super) events: SyncSender<Event>,
    /// The first error because of which the graph must end.
    pub(super) failure: Option<LaunchError>,
    /// The clients that have asked for a swap.
    pub(super) swapping: BTreeMap<u64, SyncSender<Reply>>,
    /// When heartbeats were looked at last ([`monotonic_nanos`]).
    pub(super) last_look_nanos: u64,
}

impl Hands {
    /// The processes that have ended since the last look, each with the sample on which it worked.
    pub(super) fn ended(&mut self) -> Vec<(u64, ExitStatus, Option<SampleId>)> {
        let mut ended = Vec::new();
        for (id, process) in &mut self.processes {
            if process.look()
                && let Some(status) = process.exit
            {
                ended.push((*id, status, self.cursors.instance(process.instance_slot).sample()));
            }
        }
        ended
    }

    /// The processes that are watched, each with the time since its last sign of life.
    pub(super) fn silent(&mut self) -> Vec<(u64, Duration)> {
        let now = monotonic_nanos();
        // A launcher that was stopped itself, or suspended with the machine, does not know which processes were.
        let was_away = now.saturating_sub(std::mem::replace(&mut self.last_look_nanos, now)) > AWAY_NANOS;
        let mut silent = Vec::new();
        for (id, process) in &self.processes {
            let instance = self.cursors.instance(process.instance_slot);
            let last = instance.last_beat_nanos();
            if last == 0 || process.exit.is_some() {
                continue;
            }
            if was_away {
                instance.beat(now);
            } else {
                silent.push((*id, Duration::from_nanos(now.saturating_sub(last))));
            }
        }
        silent
    }

    /// The age of the last sign of life of an instance.
    pub(super) fn heartbeat_age(&self, id: u64) -> Option<Duration> {
        let last = self.cursors.instance(self.processes.get(&id)?.instance_slot).last_beat_nanos();
        (last != 0).then(|| Duration::from_nanos(monotonic_nanos().saturating_sub(last)))
    }

    /// Takes a program that has begun, unless it is not wanted any more, and returns its process id.
    pub(super) fn take(
        &mut self,
        id: u64,
        begun: Result<BegunProgram, LaunchError>,
    ) -> Option<Result<u32, LaunchError>> {
        let Some((starts, _)) = self.starting.remove(&id) else {
            // It is killed. Its end may take long, and this thread waits for nothing.
            let _ = std::thread::Builder::new().spawn(move || drop(begun));
            return None;
        };
        let begun = match begun {
            Ok(begun) => begun,
            Err(error) => return Some(Err(error)),
        };
        let pid = begun.pid();
        match Process::of(&starts, begun, &self.events) {
            Ok(processes) => self.processes.extend(starts.iter().map(|start| start.id).zip(processes)),
            Err(source) => return Some(Err(LaunchError::of_spawn(&starts[0].node, source))),
        }
        Some(Ok(pid))
    }

    fn process(&mut self, id: u64, act: impl FnOnce(&mut Process)) {
        if let Some(process) = self.processes.get_mut(&id) {
            act(process);
        }
    }
}

impl Surroundings for Hands {
    fn start(&mut self, orders: Vec<StartOrder>) -> Result<(), LaunchError> {
        let mut starts = Vec::with_capacity(orders.len());
        for order in orders {
            let StartOrder { id, idx, node, n_before, is_standby, skip, suspect } = order;
            let Some(mut wiring) = self.plan.wiring(&node, n_before, is_standby) else {
                let error = std::io::Error::other("its ports are not those of the running graph");
                return Err(LaunchError::of_spawn(&node, error));
            };
            wiring.skip = skip;
            wiring.suspect = suspect;
            let slot = self.cursors.instance(wiring.instance_slot);
            slot.beat(0);
            slot.works_on(None);
            let log = Some(self.logs[idx].clone());
            let printer = self.is_on_terminal.then(|| Arc::clone(&self.printer));
            let sink = LineSink { node: node.id.clone(), log, printer };
            starts.push(Start { id, node, wiring, sink });
        }
        let first = &starts[0];
        let prepared = PreparedProgram::of(&starts, self.host.as_ref());
        let (prepared, its_pid) = prepared.map_err(|source| LaunchError::of_spawn(&first.node, source))?;
        let nodes = starts.iter().map(|start| start.node.clone()).collect();
        begin(first.id, nodes, prepared, &self.events)?;
        self.starting.insert(first.id, (starts, its_pid));
        Ok(())
    }

    fn tell(&mut self, id: u64, command: &Command) {
        self.process(id, |process| process.tell(command));
    }

    fn ask_to_drain(&mut self, id: u64) {
        self.process(id, Process::ask_to_drain);
    }

    fn let_go(&mut self, id: u64) {
        self.process(id, Process::let_go);
    }

    fn kill(&mut self, id: u64) {
        self.process(id, Process::kill);
        if let Some((_, its_pid)) = self.starting.remove(&id) {
            kill_process_of(its_pid);
        }
    }

    fn forget(&mut self, id: u64) {
        self.processes.remove(&id);
    }

    fn stop_waiting_for(&mut self, node: &Node, reads_no_more: bool) {
        for slot in self.plan.input_slots(&node.id) {
            self.cursors.input(slot).give_up(reads_no_more);
        }
    }

    fn fail(&mut self, error: LaunchError) {
        self.failure.get_or_insert(error);
    }

    fn say(&mut self, line: &str) {
        self.printer.lock().unwrap_or_else(PoisonError::into_inner).print(line);
        if let Some(log) = &self.own_log {
            log.write(LogEntry::plain(line));
        }
    }

    fn has_status(&mut self, status: &str) {
        self.service.has_status(status);
    }

    fn answer(&mut self, client: u64, reply: Reply) {
        if let Some(replies) = self.swapping.get(&client) {
            let _ = replies.try_send(reply);
        }
    }

    /// It does so on a thread, because it takes milliseconds.
    fn reap(&mut self) {
        let domain = self.plan.domain().clone();
        // Without a thread, they are freed the next time.
        let _ = std::thread::Builder::new().spawn(move || namespace::clean_dead_nodes(&domain));
    }

    fn is_memory_full(&self) -> bool {
        namespace::is_full()
    }

    fn last_lines(&self, id: u64) -> Vec<String> {
        self.processes.get(&id).map(Process::last_lines).unwrap_or_default()
    }

    fn last_sent_at(&self, port: &Port) -> Option<SampleId> {
        self.cursors.output(self.plan.output_slot(port)?).key()
    }

    fn answered_at(&self, node: &str, input: &str) -> Option<SampleId> {
        self.cursors.input(self.plan.input_slot(node, input)?).key()
    }

    fn is_read(&self, sent: &[(Port, SampleId)]) -> bool {
        sent.iter().all(|(port, last)| {
            let written = self.plan.output_slot(port).and_then(|slot| self.cursors.output(slot).written());
            self.plan.reader_slots(port).iter().all(|slot| {
                let slot = self.cursors.input(*slot);
                slot.is_given_up()
                    || slot.key().is_some_and(|key| written.is_none_or(|written| written.is_past(key, *last)))
            })
        })
    }

    fn relies_on_each_answer(&self, node: &str) -> bool {
        self.plan.relies_on_each_answer(node)
    }

    fn shadowing(&self, nodes: &[&str]) -> Reply {
        let mut outputs = Vec::new();
        for node in nodes {
            outputs.extend(self.plan.shadow_outputs(node));
        }
        Reply::Shadowing { domain: self.plan.domain().clone(), outputs }
    }
}
