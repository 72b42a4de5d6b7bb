//! The life of a graph's processes: each is started, watched, restarted, given up, swapped, drained and ended.
//!
//! These rules are one machine without processes, sockets, memory or clock. Events come in: a program has begun, a process has
//! reported, ended or fallen silent, a client asks, time has passed. Orders go out through [`Surroundings`]: the launcher's hands
//! (`hands`), or a world of the search through histories (`lifecycle_tests`). The rules of restarts are in `supervision`, those of a
//! swap in `swap`, those of the end in `ending`.

use std::collections::{BTreeMap, VecDeque};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::ExitStatus;
use std::time::Duration;

use crate::control::{GraphState, NodeState, Reply};
use crate::dataflow::{Graph, Node};
use crate::launcher::ending::Ending;
use crate::launcher::link_book::LinkBook;
use crate::launcher::swap::Swap;
use crate::launcher::{LaunchError, LaunchOptions, POLL, RUNNING};
use crate::plan::{N_INSTANCES, Port};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::text::did_you_mean;
use blindgrasp_operator::wiring::{Command, Enforcement, Report, Sandbox};
use rustix::process::Signal;

/// An ended process may take this long to be heard: the machine may be busy.
pub(super) const LOG_DRAIN_LIMIT: Duration = Duration::from_millis(500);
/// A killed process ends within this time, unless it waits for a device.
pub(super) const KILL_LIMIT: Duration = Duration::from_secs(1);
/// A program must begin within this time while the graph runs. At its start, and with files whose digest is read before, it has
/// as long as to be ready: a pinned recording may be long.
const BEGIN_LIMIT: Duration = Duration::from_secs(5);
/// A program that is being started when the graph is asked to stop still has this time.
const STOP_LIMIT: Duration = Duration::from_secs(1);
/// The pause between two looks at a hand-over, or at a restart that is due.
const SHORTEST_PAUSE: Duration = Duration::from_micros(500);
/// The pause between two looks at whether a process has ended, or was heard.
const END_PAUSE: Duration = Duration::from_millis(1);
/// An old instance stays for at most this long until its last samples are answered.
const READ_LIMIT: Duration = Duration::from_secs(30);

/// All that the machine orders and sees.
pub(super) trait Surroundings {
    /// Begins one process for these nodes. [`Lifecycle::on_begun`] or [`Lifecycle::on_not_begun`] tells the outcome.
    fn start(&mut self, orders: Vec<StartOrder>) -> Result<(), LaunchError>;
    fn tell(&mut self, id: u64, command: &Command);
    /// Asks a process to answer the samples that have come, and to report that it has drained.
    fn ask_to_drain(&mut self, id: u64);
    /// Lets a process exit.
    fn let_go(&mut self, id: u64);
    /// Kills a process, or ends its start. It does not wait for its end.
    fn kill(&mut self, id: u64);
    /// An instance is over, and nothing asks for it any more.
    fn forget(&mut self, id: u64);
    /// Tells the writers of a node's inputs whether it reads no more.
    fn stop_waiting_for(&mut self, node: &Node, reads_no_more: bool);
    /// The graph must end, because of this error.
    fn fail(&mut self, error: LaunchError);
    /// Prints and logs a line of the launcher's own.
    fn say(&mut self, line: &str);
    fn has_status(&mut self, status: &str);
    /// Answers a client that has asked for a swap.
    fn answer(&mut self, client: u64, reply: Reply);
    /// Frees the resources of dead processes.
    fn reap(&mut self);

    fn is_memory_full(&self) -> bool;
    fn last_lines(&self, id: u64) -> Vec<String>;
    /// The last sample that a node has sent at a port.
    fn last_sent_at(&self, port: &Port) -> Option<SampleId>;
    /// The last sample that a node has answered at an input.
    fn answered_at(&self, node: &str, input: &str) -> Option<SampleId>;
    /// Whether all these samples, the last that an instance has sent at its outputs, were answered by all readers and those
    /// behind them, so that its memory may go.
    fn is_read(&self, sent: &[(Port, SampleId)]) -> bool;
    /// Whether the nodes before this one rely on it that it answers each sample.
    fn relies_on_each_answer(&self, node: &str) -> bool;
    /// What a client needs to compare these nodes with their replacements.
    fn shadowing(&self, nodes: &[&str]) -> Reply;
}

/// An instance to be started.
#[derive(Clone)]
pub(super) struct StartOrder {
    pub(super) id: u64,
    /// The index of its node among the members.
    pub(super) idx: usize,
    pub(super) node: Node,
    pub(super) n_before: usize,
    pub(super) is_standby: bool,
    /// The samples that it leaves without an answer, and the one on which its predecessor has died.
    pub(super) skip: Vec<SampleId>,
    pub(super) suspect: Option<SampleId>,
}

#[derive(Clone)]
pub(super) struct Lifecycle<S> {
    pub(super) site: S,
    pub(super) name: String,
    /// The dataflow file.
    pub(super) file: PathBuf,
    pub(super) options: LaunchOptions,
    /// The time of the event at hand, since the launch. So are all other times.
    pub(super) now: Duration,
    pub(super) members: Vec<Member>,
    pub(super) swap: Option<Swap>,
    /// Instances on their way out.
    pub(super) leaving: Vec<Leaving>,
    pub(super) state: GraphState,
    pub(super) degraded: Option<String>,
    /// Not all operators have been ready: an operator that ends now ends the launch.
    pub(super) is_launching: bool,
    /// The sources have been told to go.
    pub(super) has_gone: bool,
    pub(super) is_asked_to_stop: bool,
    pub(super) ending: Ending,
    pub(super) link: LinkBook,
    n_instances: u64,
}

/// A node and its instances.
#[derive(Clone)]
pub(super) struct Member {
    pub(super) node: Node,
    /// The instance that answers samples; `None` before the restart of one that has died.
    pub(super) active: Option<Instance>,
    pub(super) standby: Option<Instance>,
    pub(super) state: NodeState,
    n_instances: usize,
    pub(super) n_swaps: u32,
    pub(super) n_restarts: u32,
    /// When it was restarted, within its window.
    pub(super) restarts: VecDeque<Duration>,
    pub(super) restart_at: Option<Duration>,
    /// It has died because shared memory is full, and is started again when there is room.
    pub(super) waits_for_room: bool,
    /// When it was found dead, until it is ready again.
    pub(super) died: Option<Duration>,
    /// The sample on which its last process has died.
    pub(super) deadly: Option<SampleId>,
    /// Samples on which it has died twice in a row. They are left without an answer.
    pub(super) quarantine: Vec<SampleId>,
    /// The reason for which its last process failed before it was ready.
    pub(super) start_failure: Option<String>,
    /// It has ended, and with it the graph: it is not started again.
    pub(super) is_over: bool,
    pub(super) is_source: bool,
    /// What its processes have counted besides their samples, together.
    pub(super) counts: BTreeMap<String, u64>,
}

/// An instance of a node, as far as it is known. The instances of a group's nodes share a process.
#[derive(Clone, Default)]
pub(super) struct Instance {
    /// Unique among all instances of this launch.
    pub(super) id: u64,
    /// The id of the first instance of its process.
    process: u64,
    /// The number of instances of its node before it.
    n_before: usize,
    /// `None` until its program has begun.
    pub(super) pid: Option<u32>,
    /// When its start was ordered, and then, when its program began.
    pub(super) started: Duration,
    /// Its identity, once it is ready.
    pub(super) identity: Option<BTreeMap<String, String>>,
    /// Its answers depend on earlier samples.
    pub(super) has_state: bool,
    /// It is a source that has ended, or an operator that is drained.
    pub(super) is_done: bool,
    /// It was asked to drain.
    pub(super) is_asked: bool,
    /// It has drained although the launcher did not ask it.
    pub(super) is_stopped: bool,
    /// It is a link, and the other machines are there.
    pub(super) is_connected: bool,
    /// Its answer to the last [`Command::HandOver`] or [`Command::TakeOver`].
    pub(super) answer: Option<Report>,
    /// It has computed samples as a standby.
    pub(super) is_warm: bool,
    /// Its counts of other things than samples, since it started.
    counts: BTreeMap<String, u64>,
    /// Its report that it cannot go on. It ends all nodes of its process.
    pub(super) failure: Option<String>,
    /// The launcher's reason to end it.
    finding: Option<String>,
    killed: Option<Duration>,
    pub(super) death: Option<Death>,
    wanted_sandbox: Sandbox,
    memory_max_mib: Option<u64>,
}

/// The end of an instance.
#[derive(Clone, Default)]
pub(super) struct Death {
    pub(super) at: Duration,
    /// `None` if its program had not begun, or if it was killed and the kernel has not ended it yet: it waits for a device, and
    /// computes nothing any more.
    pub(super) status: Option<ExitStatus>,
    /// The sample on which it worked.
    pub(super) sample: Option<SampleId>,
    /// Shared memory was full.
    pub(super) is_memory_full: bool,
}

/// An instance that is needed no more. An old one stays until its samples are answered, because its memory goes with it.
#[derive(Clone)]
pub(super) struct Leaving {
    /// The index of its node among the members.
    pub(super) idx: usize,
    pub(super) instance: Instance,
    pub(super) since: Duration,
    /// The last sample that it has sent at each output.
    pub(super) sent: Vec<(Port, SampleId)>,
    pub(super) is_let_go: bool,
}

impl<S: Surroundings> Lifecycle<S> {
    pub(super) fn new(graph: &Graph, name: &str, options: LaunchOptions, site: S) -> Lifecycle<S> {
        Lifecycle {
            site,
            name: name.into(),
            file: graph.file.clone(),
            options,
            now: Duration::ZERO,
            members: graph.nodes.iter().map(Member::new).collect(),
            swap: None,
            leaving: Vec::new(),
            state: GraphState::Starting,
            degraded: None,
            is_launching: true,
            has_gone: false,
            is_asked_to_stop: false,
            ending: Ending::default(),
            link: LinkBook::new(graph.local.clone()),
            n_instances: 0,
        }
    }

    /// Orders the start of all nodes.
    pub(super) fn launch(&mut self) {
        for idx in 0..self.members.len() {
            if self.members[idx].active.is_none() {
                self.start_active(idx);
            }
        }
    }

    /// Lets the sources go: all operators are ready.
    pub(super) fn begin_to_run(&mut self) {
        self.state = GraphState::Running;
        self.site.has_status(RUNNING);
        self.has_gone = true;
        for member in &mut self.members {
            if member.state == NodeState::Starting {
                member.state = if member.is_done() { NodeState::Done } else { NodeState::Running };
            }
            if let Some(active) = &member.active
                && !member.node.is_link()
            {
                self.site.tell(active.id, &Command::Go);
            }
        }
    }

    /// Looks after everything at this time.
    pub(super) fn step(&mut self, now: Duration) {
        self.now = now;
        self.end_late_starts();
        for instance in self.instances_mut() {
            if instance.is_running() && instance.killed.is_some_and(|killed| now - killed > KILL_LIMIT) {
                instance.death = Some(Death { at: now, ..Death::default() });
            }
        }
        self.supervise();
        self.go_on_with_swap();
        self.retire_leaving();
    }

    /// The longest time until the next step, if nothing happens.
    pub(super) fn pause(&self) -> Duration {
        let mut pause = self.ending.pause().unwrap_or(POLL);
        if self.is_launching {
            pause = pause.min(Duration::from_millis(5));
        }
        if self.swap.as_ref().is_some_and(Swap::is_being_handed_over) {
            pause = pause.min(SHORTEST_PAUSE);
        }
        for member in &self.members {
            if let Some(at) = member.restart_at {
                pause = pause.min(at.saturating_sub(self.now).max(SHORTEST_PAUSE));
            }
            for instance in member.instances() {
                // Its last words are heard, or the end of a killed one is awaited.
                let ends = instance.death.as_ref().map(|death| death.at).or(instance.killed);
                if ends.is_some_and(|ends| self.now - ends <= KILL_LIMIT) {
                    pause = pause.min(END_PAUSE);
                }
            }
        }
        pause
    }

    /// The members that share the process of a member, itself included, in the graph's order.
    pub(super) fn together(&self, idx: usize) -> Vec<usize> {
        match &self.members[idx].node.process.group {
            None => vec![idx],
            group => {
                (0..self.members.len()).filter(|other| self.members[*other].node.process.group == *group).collect()
            }
        }
    }

    /// Orders the process of a member, and of those that share it. Old instances are ended first if too many are on their way
    /// out; the start is then still due.
    pub(super) fn start_active(&mut self, idx: usize) {
        let idxs = self.together(idx);
        let Some(n_before) = self.free_instance(idx) else {
            if let Some(oldest) = self.leaving.iter().find(|leaving| leaving.idx == idx) {
                self.kill(oldest.instance.id, None);
            }
            self.members[idx].restart_at = Some(self.now + END_PAUSE);
            return;
        };
        let mut nodes = Vec::new();
        for idx in &idxs {
            self.members[*idx].restart_at = None;
            nodes.push((*idx, self.members[*idx].node.clone()));
        }
        self.start(nodes, n_before, false);
    }

    /// Orders a process for these nodes. The instances of a group's nodes live and end together, so a place that is free for one
    /// is free for all.
    pub(super) fn start(&mut self, nodes: Vec<(usize, Node)>, n_before: usize, is_standby: bool) {
        let process = self.n_instances + 1;
        let mut orders = Vec::new();
        for (idx, node) in nodes {
            self.n_instances += 1;
            let member = &mut self.members[idx];
            member.n_instances = n_before + 1;
            let instance = Instance {
                id: self.n_instances,
                process,
                n_before,
                started: self.now,
                wanted_sandbox: node.sandbox,
                memory_max_mib: node.memory_max_mib,
                ..Instance::default()
            };
            let (skip, suspect) =
                if is_standby { (Vec::new(), None) } else { (member.quarantine.clone(), member.deadly) };
            orders.push(StartOrder { id: instance.id, idx, node, n_before, is_standby, skip, suspect });
            if is_standby {
                member.standby = Some(instance);
            } else {
                member.active = Some(instance);
            }
        }
        if let Err(error) = self.site.start(orders) {
            self.on_not_begun(process, error);
        }
    }

    /// The number of instances before a node's next one: the first whose heartbeat slot is free. `None` if too many old
    /// instances are on their way out.
    pub(super) fn free_instance(&self, idx: usize) -> Option<usize> {
        let member = &self.members[idx];
        let leaving = self.leaving.iter().filter(|leaving| leaving.idx == idx).map(|leaving| &leaving.instance);
        let living: Vec<usize> = member
            .active
            .iter()
            .chain(&member.standby)
            .chain(leaving)
            .map(|each| each.n_before % N_INSTANCES)
            .collect();
        (member.n_instances..member.n_instances + N_INSTANCES).find(|number| !living.contains(&(number % N_INSTANCES)))
    }

    /// Ends the starts that take too long.
    fn end_late_starts(&mut self) {
        let mut late = Vec::new();
        for idx in 0..self.members.len() {
            let member = &self.members[idx];
            for instance in member.instances() {
                let limit = self.begin_limit(idx);
                let waited = self.now - instance.started;
                if instance.id == instance.process && instance.is_beginning() && waited > limit {
                    late.push((instance.id, limit, member.node.clone()));
                }
            }
        }
        for (id, limit, node) in late {
            self.kill(id, None);
            let secs = limit.as_secs_f64();
            let what = format!(
                "it has not begun within {secs:.1} s: its process was stopped, a file system hangs, or a file with a digest \
                 (sha256) takes long to read"
            );
            let error = std::io::Error::new(std::io::ErrorKind::TimedOut, what);
            self.on_not_begun(id, LaunchError::of_spawn(&node, error));
        }
    }

    fn begin_limit(&self, idx: usize) -> Duration {
        let has_digests = self.together(idx).iter().any(|idx| !self.members[*idx].node.sha256.is_empty());
        let most = if self.has_gone && !has_digests { BEGIN_LIMIT } else { self.options.startup_limit };
        let is_stopping = self.is_asked_to_stop || self.state == GraphState::Stopping;
        if is_stopping { most.min(STOP_LIMIT) } else { most }
    }

    /// The program of an ordered process has begun.
    pub(super) fn on_begun(&mut self, id: u64, pid: u32) {
        let now = self.now;
        for instance in self.instances_mut() {
            if instance.process == id {
                instance.pid = Some(pid);
                instance.started = now;
            }
        }
        for idx in 0..self.members.len() {
            if self.members[idx].active.as_ref().is_some_and(|active| active.process == id) {
                self.greet(idx);
            }
        }
    }

    /// Tells a program that has begun what its predecessor knew.
    fn greet(&mut self, idx: usize) {
        if self.members[idx].died.is_some() {
            self.count_restart(idx);
        }
        let member = &self.members[idx];
        let Some(active) = &member.active else { return };
        let is_link = member.node.is_link();
        if member.died.is_some() && (is_link || self.has_gone) {
            self.site.tell(active.id, &Command::Go);
        }
        if is_link {
            for node in &self.link.ended_nodes {
                self.site.tell(active.id, &Command::NodeEnded { node: node.clone() });
            }
        }
    }

    /// The program of an ordered process has not begun, and does not any more.
    pub(super) fn on_not_begun(&mut self, id: u64, error: LaunchError) {
        let (mut idxs, mut is_standby) = (Vec::new(), false);
        for (idx, member) in self.members.iter_mut().enumerate() {
            if member.active.take_if(|active| active.process == id).is_some() {
                idxs.push(idx);
            }
            is_standby |= member.standby.take_if(|standby| standby.process == id).is_some();
        }
        if self.is_launching {
            return self.site.fail(error);
        }
        let is_shortage = error.is_shortage();
        let message = format!("{:#}", anyhow::Error::from(error));
        if is_standby {
            self.abandon_swap(&message);
        } else {
            self.on_failed_restart(&idxs, is_shortage, &message);
        }
    }

    /// A process has reported. The reports of an instance on its way out are not needed.
    pub(super) fn on_report(&mut self, id: u64, report: Report) {
        let Some(idx) = self.member_of(id) else { return };
        let member = &mut self.members[idx];
        let is_active = member.active.as_ref().is_some_and(|active| active.id == id);
        let place = if is_active { &mut member.active } else { &mut member.standby };
        let Some(instance) = place else { return };
        match report {
            Report::Ready { identity, has_state, sandbox } => {
                if instance.wanted_sandbox == Sandbox::Required && sandbox != Enforcement::Full {
                    self.on_failure(id, &format!("its sandbox is required, and {}", lacking(sandbox)));
                    self.kill(id, None);
                    return;
                }
                instance.identity = Some(identity);
                instance.has_state = has_state;
                if instance.wanted_sandbox == Sandbox::On && sandbox != Enforcement::Full {
                    let (node, what) = (&member.node.id, lacking(sandbox));
                    self.site.say(&format!("blindgrasp: node '{node}' has 'sandbox: on', but {what}"));
                }
            }
            Report::HandedOver { .. } | Report::TookOver => instance.answer = Some(report),
            Report::Warm { .. } => instance.is_warm = true,
            Report::Connected => instance.is_connected = true,
            Report::Finished => instance.is_done = true,
            Report::Drained if instance.is_asked => instance.is_done = true,
            Report::Drained => instance.is_stopped = true,
            Report::Failed { message } => self.on_failure(id, &message),
            // A standby counts what the active process counts as well.
            Report::Counts { counts, in_all: true } => {
                // Zeros are shown in the place of other counts, and not by themselves.
                if is_active && counts.iter().any(|(name, count)| *count > 0 || member.counts.contains_key(name)) {
                    member.counts.extend(counts);
                }
            }
            Report::Counts { counts, in_all: false } if !is_active => instance.counts = counts,
            Report::Counts { counts, in_all: false } => {
                for (name, count) in &counts {
                    let before = instance.counts.get(name).copied().unwrap_or(0);
                    *member.counts.entry(name.clone()).or_default() += count.saturating_sub(before);
                }
                instance.counts = counts;
            }
            Report::Log(_) | Report::Set { .. } | Report::Ended { .. } | Report::Link(_) | Report::Unfit { .. } => {}
        }
    }

    fn on_failure(&mut self, id: u64, message: &str) {
        let process = self.instances_mut().find(|instance| instance.id == id).map(|instance| instance.process);
        for instance in self.instances_mut() {
            if Some(instance.process) == process {
                instance.failure = Some(message.into());
            }
        }
    }

    /// A process has ended, while it worked on a sample.
    pub(super) fn on_end(&mut self, id: u64, status: ExitStatus, sample: Option<SampleId>) {
        let is_memory_full = self.site.is_memory_full();
        let death = Death { at: self.now, status: Some(status), sample, is_memory_full };
        let is_asked = self.instances_mut().any(|instance| instance.id == id && instance.is_asked);
        if !(status.success() && is_asked) {
            // Until then its neighbours count its ports among those that live.
            self.site.reap();
        }
        if let Some(instance) = self.instances_mut().find(|instance| instance.id == id && instance.is_running()) {
            instance.death = Some(death);
        }
    }

    /// A process has given no sign of life for so long.
    pub(super) fn on_silence(&mut self, id: u64, silence: Duration) {
        let leaving = self.leaving.iter().find(|leaving| leaving.instance.id == id).map(|leaving| leaving.idx);
        let Some(idx) = self.member_of(id).or(leaving) else { return };
        if let Some(limit_millis) = self.members[idx].node.heartbeat_millis
            && silence > Duration::from_millis(limit_millis)
            && !self.ending.is_quitting()
        {
            self.kill(id, Some(format!("had no heartbeat for {limit_millis} ms and was killed")));
        }
    }

    /// The node whose active or standby instance this is.
    pub(super) fn member_of(&self, id: u64) -> Option<usize> {
        self.members.iter().position(|member| member.instances().any(|instance| instance.id == id))
    }

    fn instances_mut(&mut self) -> impl Iterator<Item = &mut Instance> {
        let of_members = self.members.iter_mut().flat_map(|member| member.active.iter_mut().chain(&mut member.standby));
        of_members.chain(self.leaving.iter_mut().map(|leaving| &mut leaving.instance))
    }

    /// Kills the process of an instance, for a reason; false if it had ended before.
    pub(super) fn kill(&mut self, id: u64, finding: Option<String>) -> bool {
        let now = self.now;
        let Some(instance) = self.instances_mut().find(|instance| instance.id == id) else { return false };
        if !instance.is_running() || instance.killed.is_some() {
            return false;
        }
        instance.finding = finding;
        let process = instance.process;
        for instance in self.instances_mut() {
            if instance.process == process && instance.is_running() {
                instance.killed.get_or_insert(now);
                if instance.pid.is_none() {
                    instance.death = Some(Death { at: now, ..Death::default() });
                }
            }
        }
        self.site.kill(process);
        true
    }

    /// Kills an instance that is not needed any more.
    pub(super) fn discard(&mut self, idx: usize, instance: Instance) {
        let id = instance.id;
        self.leaving.push(Leaving { idx, instance, since: self.now, sent: Vec::new(), is_let_go: true });
        self.kill(id, None);
    }

    /// Lets old instances go whose samples are answered, and kills those that do not end.
    fn retire_leaving(&mut self) {
        let mut leaving = std::mem::take(&mut self.leaving);
        for old in &mut leaving {
            if !old.is_let_go && (self.site.is_read(&old.sent) || self.now - old.since > READ_LIMIT) {
                old.let_go(self.now, &mut self.site);
            }
        }
        let needed: Vec<u64> = leaving.iter().filter(|old| !old.is_let_go).map(|old| old.instance.process).collect();
        let mut late = Vec::new();
        for old in leaving {
            let instance = &old.instance;
            if instance.is_running() {
                if !needed.contains(&instance.process) && self.now - old.since > self.options.grace {
                    late.push(instance.id);
                }
                self.leaving.push(old);
                continue;
            }
            self.site.forget(instance.id);
        }
        for id in late {
            self.kill(id, None);
        }
    }

    /// The folder of the dataflow file, for relative paths in it.
    pub(super) fn folder(&self) -> &Path {
        self.file.parent().unwrap_or(Path::new("/"))
    }

    pub(super) fn member_idx(&self, id: &str) -> Result<usize, String> {
        let found = self.members.iter().position(|member| member.node.id == id);
        found.ok_or_else(|| {
            if let Some(machine) = self.link.machine_of(id) {
                return format!("node '{id}' runs on machine '{machine}': run the command there, for example with ssh");
            }
            let known: Vec<_> = self.members.iter().map(|member| member.node.id.as_str()).collect();
            let alike = did_you_mean(id, known.iter().copied()).map(|alike| format!("{alike} ")).unwrap_or_default();
            format!("graph '{}' has no node '{id}'; {alike}its nodes: {}", self.name, known.join(", "))
        })
    }

    /// The error of a node whose active process has failed.
    pub(super) fn failed(&self, idx: usize, is_early: bool) -> LaunchError {
        let member = &self.members[idx];
        let (mut what, mut log) = ("has no process".into(), Vec::new());
        if let Some(instance) = &member.active {
            what = instance.ending();
            // The report of its failure is the error's text already.
            if instance.failure.is_none() {
                log = self.site.last_lines(instance.id);
                if is_early {
                    what.push_str(" too early");
                }
            }
        }
        LaunchError::Failed { node: member.node.id.clone(), what, log }
    }
}

impl Leaving {
    /// Asks it to end, within the grace period from now on.
    pub(super) fn let_go<S: Surroundings>(&mut self, now: Duration, site: &mut S) {
        if !std::mem::replace(&mut self.is_let_go, true) {
            self.since = now;
            site.let_go(self.instance.id);
            self.instance.is_asked = true;
            site.ask_to_drain(self.instance.id);
        }
    }
}

impl Member {
    fn new(node: &Node) -> Member {
        Member {
            node: node.clone(),
            active: None,
            standby: None,
            state: NodeState::Starting,
            n_instances: 0,
            n_swaps: 0,
            n_restarts: 0,
            restarts: VecDeque::new(),
            restart_at: None,
            waits_for_room: false,
            died: None,
            start_failure: None,
            is_over: false,
            is_source: node.is_source(),
            deadly: None,
            quarantine: Vec::new(),
            counts: BTreeMap::new(),
        }
    }

    pub(super) fn is_starting(&self) -> bool {
        self.active.as_ref().is_none_or(|active| !active.is_ready() && !active.is_done)
    }

    /// The active instance, and the one that stands by during a swap.
    pub(super) fn instances(&self) -> impl Iterator<Item = &Instance> {
        self.active.iter().chain(&self.standby)
    }

    pub(super) fn is_done(&self) -> bool {
        self.active.as_ref().is_some_and(|active| active.is_done)
    }

    pub(super) fn is_given_up(&self) -> bool {
        self.state == NodeState::Failed
    }
}

impl Instance {
    /// Whether it can answer samples.
    pub(super) fn is_ready(&self) -> bool {
        self.identity.is_some()
    }

    /// Whether it has not ended.
    pub(super) fn is_running(&self) -> bool {
        self.death.is_none()
    }

    fn is_beginning(&self) -> bool {
        self.pid.is_none() && self.is_running()
    }

    fn status(&self) -> Option<ExitStatus> {
        self.death.as_ref().and_then(|death| death.status)
    }

    /// Whether it has said why it failed, or ended so long ago that all that it said was heard.
    pub(super) fn is_heard(&self, now: Duration, limit: Duration) -> bool {
        self.failure.is_some() || self.death.as_ref().is_some_and(|death| now - death.at >= limit)
    }

    /// Whether it ended as it was asked to. A process that was asked to stop before it could listen ends by the signal
    /// itself.
    pub(super) fn has_ended_well(&self) -> bool {
        let Some(status) = self.status() else { return false };
        let ended_by_request = self.is_asked && status.signal() == Some(Signal::TERM.as_raw());
        self.failure.is_none() && (status.success() || ended_by_request)
    }

    /// Whether it ended with exit code 0, and the launcher did not end it.
    pub(super) fn has_succeeded(&self) -> bool {
        self.failure.is_none() && self.status().is_some_and(|status| status.success())
    }

    /// Whether it ended by itself, with an error.
    pub(super) fn has_exited_in_error(&self) -> bool {
        self.status().is_some_and(|status| status.code().is_some_and(|code| code != 0))
    }

    /// Whether it has died of shared memory that was not there when it was written to, or could not begin without it.
    pub(super) fn has_died_of_full_memory(&self) -> bool {
        let wrote_in_vain = self.status().is_some_and(|status| status.signal() == Some(Signal::BUS.as_raw()));
        (wrote_in_vain || !self.is_ready()) && self.death.as_ref().is_some_and(|death| death.is_memory_full)
    }

    /// How it ended, for a person: "failed: …", "was killed (signal 9)", "ended with exit status 1".
    pub(super) fn ending(&self) -> String {
        if let Some(finding) = &self.finding {
            return finding.clone();
        }
        if let Some(message) = &self.failure {
            return format!("failed: {message}");
        }
        let Some(status) = self.status() else {
            let is_killed = self.killed.is_some();
            return if is_killed { "was killed and has not ended: it waits for a device" } else { "is running" }.into();
        };
        match (status.signal(), self.memory_max_mib) {
            // Memory of a full /dev/shm is there only until it is written to.
            (Some(signal), _) if signal == Signal::BUS.as_raw() => {
                format!("was killed (signal {signal}: shared memory is full, most likely)")
            }
            (Some(signal), Some(mib)) if signal == Signal::ABORT.as_raw() => {
                format!("was killed (signal {signal}; its memory_max_mib is {mib})")
            }
            (Some(signal), _) => format!("was killed (signal {signal})"),
            (None, _) => format!("ended ({status})"),
        }
    }
}

/// The lack of a sandbox, for a person.
fn lacking(sandbox: Enforcement) -> &'static str {
    match sandbox {
        Enforcement::None => {
            "it is not restricted: the kernel has no Landlock (blindgrasp doctor tells), or its program does not use it"
        }
        Enforcement::Partial => {
            "it is restricted in part only: the kernel is older than Linux 6.12, or its program is not blindgrasp's own and may \
             read files and run programs"
        }
        Enforcement::Full => "it is restricted in full",
    }
}
