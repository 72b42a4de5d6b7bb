//! Starts, watches and stops a graph's processes. It never touches samples.
//!
//! Each operator is a process in a process group of its own, so that Ctrl-C reaches the launcher alone, which then stops
//! the graph in its order: sources first, each operator drained before the next is asked, so that everything in flight
//! is decided. Ports close only after the last one is drained. An operator that doesn't end in time is killed.
//!
//! If the launcher dies, its operators end: their stdin closes, and the kernel sends them SIGTERM.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, kill_process_group, set_parent_process_death_signal};

use super::wiring::{DomainWiring, GO, PortCounts, REPORT_PREFIX, Report, ServiceWiring, WIRING_VARIABLE, Wiring};
use crate::dataflow::Graph;
use crate::diagnostics::print_diagnostic;

/// How often the launcher looks at the stop request and at its children.
const POLL: Duration = Duration::from_millis(20);
/// A port's publisher, and one that may take its place.
const MAX_PUBLISHERS: usize = 2;
/// Subscribers beyond those the graph was started with: tools that attach later.
const N_SPARE_SUBSCRIBERS: usize = 2;
/// How many samples a subscriber may hold at a time.
const MAX_BORROWED: usize = 2;
/// How long the launcher listens at a stretch before it looks at anything else.
const LISTEN: Duration = Duration::from_millis(50);
/// How many lines of all operators may wait for the launcher.
const MAX_PENDING_EVENTS: usize = 1024;
/// A longer line is taken for several.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// How many log lines of an operator are kept to explain its failure.
const N_KEPT_LINES: usize = 20;

/// Limits of a launch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaunchOptions {
    /// How long until every operator must be ready.
    pub startup_limit: Duration,
    /// How long an operator may take to drain, and then to exit, before it is killed.
    pub grace: Duration,
    /// How many samples each subscriber holds before its publisher has to wait.
    pub capacity: usize,
    /// How long a publisher waits for a full subscriber before it fails.
    pub wait_limit: Duration,
}

impl Default for LaunchOptions {
    fn default() -> Self {
        LaunchOptions {
            startup_limit: Duration::from_secs(20),
            grace: Duration::from_secs(10),
            capacity: 64,
            wait_limit: Duration::from_secs(5),
        }
    }
}

/// Why a graph did not run to its end.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// A program could not be started.
    #[error("cannot start node '{node}' ({program})")]
    Spawn {
        /// The node.
        node: String,
        /// Its program.
        program: String,
        /// The reason.
        source: std::io::Error,
    },
    /// An operator failed or ended too early.
    #[error("node '{node}' {what}{}", log_tail(log))]
    Failed {
        /// The node.
        node: String,
        /// What it did.
        what: String,
        /// Its last log lines.
        log: Vec<String>,
    },
    /// Operators that were not ready in time.
    #[error("not ready within {limit_secs} s: {}{}", nodes.join(", "), log_tail(log))]
    NotReady {
        /// The nodes.
        nodes: Vec<String>,
        /// The limit.
        limit_secs: u64,
        /// Their last log lines.
        log: Vec<String>,
    },
    /// Operators that had to be killed.
    #[error("killed, because they did not end within {grace_secs} s: {}", nodes.join(", "))]
    Killed {
        /// The nodes.
        nodes: Vec<String>,
        /// The limit.
        grace_secs: u64,
    },
}

/// How a graph came to its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// All sources have sent what they had.
    Finished,
    /// Somebody asked it to stop.
    Stopped,
}

/// A graph's processes. Dropping it kills those that are left.
pub struct Launcher {
    options: LaunchOptions,
    has_failed: bool,
    nodes: Vec<RunningNode>,
    events: Receiver<(usize, Event)>,
}

/// A node's process, as far as it is known.
struct RunningNode {
    id: String,
    is_source: bool,
    child: Child,
    stdin: Option<ChildStdin>,
    state: State,
    counts: Option<PortCounts>,
    failure: Option<String>,
    exit: Option<ExitStatus>,
    /// It was asked to drain.
    is_asked: bool,
    /// It did not drain in time: no use in waiting for it again.
    gave_up: bool,
    log: VecDeque<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum State {
    Starting,
    Ready,
    /// Finished or drained: nothing more will come out of it.
    Done,
}

enum Event {
    Report(Report),
    Log(String),
}

/// The service of every output port of a graph, by `node/port`. `observed` are the ports that somebody beside the
/// operators reads.
pub fn services(
    graph: &Graph,
    name: &str,
    observed: &BTreeSet<(String, String)>,
    options: &LaunchOptions,
) -> BTreeMap<(String, String), ServiceWiring> {
    let mut services = BTreeMap::new();
    for node in &graph.nodes {
        for output in node.outputs() {
            let port = (node.id.clone(), output.name.clone());
            let consumers = graph.nodes.iter().flat_map(|consumer| &consumer.inputs);
            let n_consumers =
                consumers.filter(|input| input.from_node == node.id && input.from_port == output.name).count();
            let n_consumers = n_consumers + usize::from(observed.contains(&port));
            let wiring = ServiceWiring {
                name: format!("{name}/{}/{}", node.id, output.name),
                type_name: output.type_name.clone(),
                n_consumers,
                capacity: options.capacity,
                max_publishers: MAX_PUBLISHERS,
                max_subscribers: n_consumers + N_SPARE_SUBSCRIBERS,
                max_borrowed: MAX_BORROWED,
                max_nodes: n_consumers + N_SPARE_SUBSCRIBERS + MAX_PUBLISHERS,
                wait_limit_millis: options.wait_limit.as_millis() as u64,
            };
            services.insert(port, wiring);
        }
    }
    services
}

impl Launcher {
    /// Starts all processes of a graph.
    ///
    /// # Errors
    /// A program that cannot be started; those already started are killed.
    pub fn start(
        graph: &Graph,
        name: &str,
        domain: &DomainWiring,
        services: &BTreeMap<(String, String), ServiceWiring>,
        options: LaunchOptions,
    ) -> Result<Launcher, LaunchError> {
        let (sender, events) = sync_channel(MAX_PENDING_EVENTS);
        let mut launcher = Launcher { options, has_failed: false, nodes: Vec::new(), events };
        let service = |node: &str, port: &str| services.get(&(node.to_string(), port.to_string())).cloned();
        for node in &graph.nodes {
            let wiring = Wiring {
                graph: name.into(),
                node: node.id.clone(),
                domain: domain.clone(),
                inputs: node
                    .inputs
                    .iter()
                    .filter_map(|input| Some((input.port.clone(), service(&input.from_node, &input.from_port)?)))
                    .collect(),
                outputs: node
                    .outputs()
                    .iter()
                    .filter_map(|output| Some((output.name.clone(), service(&node.id, &output.name)?)))
                    .collect(),
                params: node.params.clone(),
                startup_limit_millis: options.startup_limit.as_millis() as u64,
            };
            let failed = |source| LaunchError::Spawn {
                node: node.id.clone(),
                program: node.program.display().to_string(),
                source,
            };
            let mut child = spawn(&node.program, &wiring).map_err(failed)?;
            let node_idx = launcher.nodes.len();
            let streams: [Option<Box<dyn Read + Send>>; 2] = [
                child.stdout.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>),
                child.stderr.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>),
            ];
            launcher.nodes.push(RunningNode {
                id: node.id.clone(),
                is_source: node.inputs.is_empty(),
                stdin: child.stdin.take(),
                child,
                state: State::Starting,
                counts: None,
                failure: None,
                exit: None,
                is_asked: false,
                gave_up: false,
                log: VecDeque::new(),
            });
            for stream in streams.into_iter().flatten() {
                let sender = sender.clone();
                std::thread::spawn(move || forward_lines(stream, node_idx, &sender));
            }
        }
        Ok(launcher)
    }

    /// Node ids and process ids, in the graph's order.
    pub fn pids(&self) -> Vec<(String, u32)> {
        self.nodes.iter().map(|node| (node.id.clone(), node.child.id())).collect()
    }

    /// What each node reported of its ports, for those that did.
    pub fn counts(&self) -> BTreeMap<String, PortCounts> {
        self.nodes.iter().filter_map(|node| Some((node.id.clone(), node.counts.clone()?))).collect()
    }

    /// Waits until every operator is ready and `is_observed` says that whoever listens in is too, then starts the
    /// sources. `should_stop` ends the wait with [`End::Stopped`].
    ///
    /// # Errors
    /// An operator failed, or some are not ready in time.
    pub fn wait_until_ready(
        &mut self,
        is_observed: &dyn Fn() -> bool,
        should_stop: &dyn Fn() -> bool,
    ) -> Result<Option<End>, LaunchError> {
        let start = Instant::now();
        while self.nodes.iter().any(|node| node.state == State::Starting && node.exit.is_none()) || !is_observed() {
            if should_stop() {
                return Ok(Some(End::Stopped));
            }
            self.process_events(POLL)?;
            self.check_none_exited()?;
            if start.elapsed() > self.options.startup_limit {
                let late: Vec<_> = self.nodes.iter().filter(|node| node.state == State::Starting).collect();
                let mut nodes: Vec<_> = late.iter().map(|node| node.id.clone()).collect();
                if nodes.is_empty() {
                    nodes.push("the run itself: an operator said ready without opening an output".into());
                }
                return Err(LaunchError::NotReady {
                    nodes,
                    limit_secs: self.options.startup_limit.as_secs(),
                    log: late.iter().flat_map(|node| node.log.iter().cloned()).collect(),
                });
            }
        }
        for node in &mut self.nodes {
            if let Some(stdin) = &mut node.stdin {
                // One that has closed its stdin is no source of ours; if it has died, that is found out below.
                let _ = stdin.write_all(format!("{GO}\n").as_bytes());
            }
        }
        Ok(None)
    }

    /// Waits until all sources have sent what they had, or `should_stop` says so.
    ///
    /// # Errors
    /// An operator failed.
    pub fn wait_until_finished(&mut self, should_stop: &dyn Fn() -> bool) -> Result<End, LaunchError> {
        loop {
            if should_stop() {
                return Ok(End::Stopped);
            }
            if self.nodes.iter().all(|node| !node.is_source || node.state >= State::Done) {
                return Ok(End::Finished);
            }
            self.process_events(POLL)?;
            self.check_none_exited()?;
        }
    }

    /// Asks one operator after the other, sources first, to take in what is left and waits until it has; all of them
    /// within the grace period, and not at all once `should_hurry`.
    ///
    /// # Errors
    /// Operators that failed or did not answer in time; the others are drained all the same.
    pub fn drain(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        let mut first_error = None;
        let mut deadline = Instant::now() + self.options.grace;
        for idx in 0..self.nodes.len() {
            self.nodes[idx].is_asked = true;
            if self.nodes[idx].state < State::Done {
                self.nodes[idx].signal(Signal::TERM);
            }
            while self.nodes[idx].is_draining() && Instant::now() < deadline && !should_hurry() {
                let outcome = self.process_events(POLL);
                self.look_for_exits();
                if let Err(error) = outcome {
                    first_error.get_or_insert(error);
                }
            }
            let node = &mut self.nodes[idx];
            if node.is_draining() {
                node.gave_up = true;
                let what = match should_hurry() {
                    true => "had not drained when it was killed".into(),
                    false => format!("did not drain within {} s", self.options.grace.as_secs()),
                };
                first_error.get_or_insert(node.failed(what));
                // It has had its time; those behind it get a little, in case they have all they need.
                deadline = Instant::now() + LISTEN;
            } else if let Err(error) = node.check_exit() {
                first_error.get_or_insert(error);
            }
        }
        first_error.map_or(Ok(()), Err)
    }

    /// Lets all operators exit, and kills those that don't within the grace period, or at once if `should_hurry`.
    ///
    /// # Errors
    /// Operators that had to be killed, or that failed on their way out.
    pub fn quit(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        for node in &mut self.nodes {
            node.stdin = None;
            if node.state < State::Done && node.exit.is_none() {
                node.is_asked = true;
                node.signal(Signal::TERM);
            }
        }
        let start = Instant::now();
        let is_awaited = |node: &RunningNode| node.exit.is_none() && !node.gave_up;
        while self.nodes.iter().any(is_awaited) && start.elapsed() <= self.options.grace && !should_hurry() {
            self.look_for_exits();
            let _ = self.process_events(Duration::from_millis(1));
        }
        let nodes = self.kill_all();
        if !nodes.is_empty() {
            return Err(LaunchError::Killed { nodes, grace_secs: self.options.grace.as_secs() });
        }
        self.nodes.iter().try_for_each(RunningNode::check_exit)
    }

    /// Takes in what the operators say, for up to `limit` until the first word.
    fn process_events(&mut self, limit: Duration) -> Result<(), LaunchError> {
        let mut next = self.events.recv_timeout(limit);
        let start = Instant::now();
        loop {
            match next {
                Ok((idx, event)) => self.on_event(idx, event)?,
                Err(RecvTimeoutError::Timeout) => return Ok(()),
                // All streams have ended: only exits are left to wait for.
                Err(RecvTimeoutError::Disconnected) => {
                    std::thread::sleep(limit.min(POLL));
                    return Ok(());
                }
            }
            if start.elapsed() > LISTEN {
                return Ok(());
            }
            next = self.events.recv_timeout(Duration::ZERO);
        }
    }

    fn on_event(&mut self, idx: usize, event: Event) -> Result<(), LaunchError> {
        let node = &mut self.nodes[idx];
        match event {
            Event::Report(Report::Ready) => node.state = node.state.max(State::Ready),
            Event::Report(Report::Finished { counts }) => {
                node.counts = Some(counts);
                node.state = State::Done;
            }
            Event::Report(Report::Drained { counts }) => {
                node.counts = Some(counts);
                node.state = State::Done;
                if !node.is_asked {
                    return Err(node.failed("was stopped by somebody else (SIGTERM)".into()));
                }
            }
            Event::Report(Report::Failed { message }) => {
                node.failure = Some(message.clone());
                let error = node.failed(format!("failed: {message}"));
                if self.has_failed {
                    // The first failure is the graph's error; what follows from it, or comes beside it, is said here.
                    print_diagnostic(&format!("[{}] {message}", node.id));
                }
                self.has_failed = true;
                return Err(error);
            }
            Event::Log(line) => {
                print_diagnostic(&format!("[{}] {line}", node.id));
                node.log.push_back(line);
                if node.log.len() > N_KEPT_LINES {
                    node.log.pop_front();
                }
            }
        }
        Ok(())
    }

    fn look_for_exits(&mut self) {
        for node in &mut self.nodes {
            if node.exit.is_none()
                && let Ok(Some(status)) = node.child.try_wait()
            {
                node.exit = Some(status);
            }
        }
    }

    fn check_none_exited(&mut self) -> Result<(), LaunchError> {
        self.look_for_exits();
        let has_died =
            |node: &RunningNode| node.exit.is_some_and(|status| node.state < State::Done || !status.success());
        if !self.nodes.iter().any(has_died) {
            return Ok(());
        }
        // Its last words may still be on their way.
        self.process_events(POLL)?;
        match self.nodes.iter().find(|node| has_died(node)) {
            Some(node) => Err(node.failed(format!("ended too early{}", node.exit_text()))),
            None => Ok(()),
        }
    }

    /// Kills what still runs, and whatever the operators have started themselves; the nodes it had to kill.
    fn kill_all(&mut self) -> Vec<String> {
        let mut killed = Vec::new();
        for node in &mut self.nodes {
            let is_running = matches!(node.child.try_wait(), Ok(None));
            if let Some(group) = Pid::from_raw(node.child.id() as i32) {
                let _ = kill_process_group(group, Signal::KILL);
            }
            if is_running {
                let _ = node.child.wait();
                killed.push(node.id.clone());
            }
        }
        killed
    }
}

impl Drop for Launcher {
    fn drop(&mut self) {
        self.kill_all();
    }
}

impl RunningNode {
    fn signal(&self, signal: Signal) {
        // Until the child has been waited for, its pid is its own.
        if self.exit.is_none()
            && let Some(pid) = Pid::from_raw(self.child.id() as i32)
        {
            let _ = kill_process(pid, signal);
        }
    }

    fn is_draining(&self) -> bool {
        self.state < State::Done && self.exit.is_none()
    }

    fn failed(&self, what: String) -> LaunchError {
        // What it said of its failure is the error's text already.
        let log = if self.failure.is_some() { Vec::new() } else { self.log.iter().cloned().collect() };
        LaunchError::Failed { node: self.id.clone(), what, log }
    }

    fn exit_text(&self) -> String {
        self.exit.map_or_else(String::new, |status| format!(" ({status})"))
    }

    fn check_exit(&self) -> Result<(), LaunchError> {
        // One that was asked to stop before it could listen ends by the signal itself.
        let is_fine =
            |status: ExitStatus| status.success() || (self.is_asked && status.signal() == Some(Signal::TERM.as_raw()));
        match (&self.failure, self.exit) {
            (Some(message), _) => Err(self.failed(format!("failed: {message}"))),
            (None, Some(status)) if !is_fine(status) => Err(self.failed(format!("ended with {status}"))),
            _ => Ok(()),
        }
    }
}

fn spawn(program: &std::path::Path, wiring: &Wiring) -> std::io::Result<Child> {
    let launcher_pid = rustix::process::getpid();
    let mut command = Command::new(program);
    command
        .env(WIRING_VARIABLE, serde_json::to_string(wiring)?)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .process_group(0);
    let before_exec = move || {
        set_parent_process_death_signal(Some(Signal::TERM))?;
        // The launcher may have died before the signal was set.
        if rustix::process::getppid() != Some(launcher_pid) {
            return Err(rustix::io::Errno::SRCH.into());
        }
        Ok(())
    };
    // SAFETY: between fork and exec the closure makes two system calls; it neither allocates nor takes a lock.
    unsafe { command.pre_exec(before_exec) };
    command.spawn()
}

/// Blocks when the launcher is behind: an operator that floods its output waits, and nobody's memory grows.
fn forward_lines(stream: impl Read, node_idx: usize, sender: &SyncSender<(usize, Event)>) {
    let mut stream = BufReader::new(stream);
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        match (&mut stream).take(MAX_LINE_BYTES).read_until(b'\n', &mut bytes) {
            Ok(0) | Err(_) => return,
            Ok(_) => {}
        }
        let line = String::from_utf8_lossy(&bytes).trim_end().to_string();
        let event = match line.strip_prefix(REPORT_PREFIX).map(serde_json::from_str) {
            Some(Ok(report)) => Event::Report(report),
            Some(Err(error)) => Event::Log(format!("not a report of this version ({error}): {line}")),
            None => Event::Log(line),
        };
        if sender.send((node_idx, event)).is_err() {
            return;
        }
    }
}

fn log_tail(log: &[String]) -> String {
    if log.is_empty() {
        return String::new();
    }
    format!("; its last words:\n  {}", log.join("\n  "))
}
