//! Starts, supervises and stops a graph's processes. It never touches samples.
//!
//! Each operator is a process in a process group of its own, so that Ctrl-C reaches the launcher alone. It then stops
//! the graph in its order: sources first, each operator drained before the next is asked, so that everything in flight
//! is decided. Ports close only after the last one is drained. An operator that doesn't end in time is killed.
//!
//! An operator that dies, or gives no sign of life for longer than it may, is started again and goes on where the cursors
//! say (`supervision`). One that keeps dying is given up: its writers wait for it no longer, and the graph goes on
//! degraded until somebody stops it or swaps the operator (`swap`).
//!
//! If the launcher dies, its operators end: their stdin closes, and the kernel sends them SIGTERM.

pub(crate) mod attached;
pub mod audit;
mod clients;
mod link_book;
mod log_writer;
mod process;
mod server;
mod service;
mod set;
mod slow_nodes;
mod starter;
mod supervision;
mod swap;
#[cfg(test)]
mod tests;
mod wake_policy;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::os::unix::net::UnixListener;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::control::{
    DecisionStatus, EdgeStatus, GraphState, GraphStatus, Iceoryx2Config, NodeState, NodeStatus, Reply, Request,
};
use crate::dataflow::pins::PinError;
use crate::dataflow::{Graph, Node, Program};
use crate::launcher::clients::Clients;
use crate::launcher::link_book::LinkBook;
use crate::launcher::log_writer::{Log, LogWriter};
pub use crate::launcher::process::ZENOH_THREADS;
use crate::launcher::process::{LineSink, PreparedProgram, Process, ProcessOutput, Start};
use crate::launcher::server::Ask;
use crate::launcher::service::Service;
use crate::launcher::set::PendingSet;
use crate::launcher::slow_nodes::SlowNodes;
pub(crate) use crate::launcher::supervision::QUARANTINED;
use crate::launcher::swap::Swap;
use crate::launcher::wake_policy::WakePolicy;
use crate::log::AUDIT;
use crate::log::{LogFolder, LogFormat, log_tail};
use crate::plan::{Plan, Port};
use blindgrasp_operator::cursors::{CursorsError, SampleId, SharedCursors};
use blindgrasp_operator::diagnostics::LinePrinter;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::namespace::{self, FILE_PREFIX, NamespaceError};
use blindgrasp_operator::text::did_you_mean;
use blindgrasp_operator::wiring::{Clock, Command, LogEntry, LogLevel, Report, WaitMode};
use rustix::io::Errno;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// The status of a graph without trouble.
const RUNNING: &str = "running";
/// The launcher checks the stop request and heartbeats this often. Output and ends of its children wake it at once.
const POLL: Duration = Duration::from_millis(50);
/// An ended process may take this long to be heard: the machine may be busy.
const LOG_DRAIN_LIMIT: Duration = Duration::from_millis(500);
/// The launcher listens this long at a stretch before it does anything else.
const LISTEN: Duration = Duration::from_millis(50);
/// A link says within this time that it takes no more samples, unless it hangs or was killed.
const LINK_WAIT: Duration = Duration::from_secs(1);
/// This many lines of all operators may wait for the launcher.
const MAX_PENDING_EVENTS: usize = 1024;
/// This many lines wait for the reader of stderr.
const MAX_UNREAD_LINES: usize = 4096;
/// An old instance stays for at most this long until its last samples are answered.
const READ_LIMIT: Duration = Duration::from_secs(30);
/// The limit of descriptors is not raised further: a connection of a stranger takes about 15 kB of the link's memory.
const MOST_DESCRIPTORS: u64 = 1 << 16;

#[derive(Debug, Clone, PartialEq)]
pub struct LaunchOptions {
    /// Every operator must be ready within this time.
    pub startup_limit: Duration,
    /// An operator must drain, and then exit, within this time each; otherwise it is killed.
    pub grace: Duration,
    /// A publisher that waits longer for a reader fails.
    pub wait_limit: Duration,
    /// Operators' log lines go to stderr as well as to their files. The launcher's own lines always go to stderr, and
    /// go to its file only if this is set.
    pub is_on_terminal: bool,
    pub log_format: LogFormat,
    /// A graph whose sources have ended begins again, so that its service is not stopping.
    pub begins_again: bool,
}

impl Default for LaunchOptions {
    fn default() -> Self {
        LaunchOptions {
            startup_limit: Duration::from_secs(20),
            grace: Duration::from_secs(10),
            wait_limit: Duration::from_secs(5),
            is_on_terminal: true,
            log_format: LogFormat::Text,
            begins_again: false,
        }
    }
}

/// Why a graph did not run to its end, or not as it should.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// A program could not be started.
    #[error("cannot start node '{node}' ({program})")]
    Spawn { node: String, program: String, source: std::io::Error },
    /// A file of the node is not the one that the dataflow file fixes.
    #[error("node '{node}' is not started")]
    Pin { node: String, source: PinError },
    /// An operator failed or ended too early.
    #[error("node '{node}' {what}{}", log_tail(log))]
    Failed { node: String, what: String, log: Vec<String> },
    /// Operators that were not ready in time.
    #[error("not ready within {limit_secs} s: {}{}", nodes.join(", "), log_tail(log))]
    NotReady { nodes: Vec<String>, limit_secs: f64, log: Vec<String> },
    /// Operators that had to be killed.
    #[error("killed, because they did not end within {grace_secs} s: {}", nodes.join(", "))]
    Killed { nodes: Vec<String>, grace_secs: f64 },
    /// The graph ran to its end without an operator that was given up.
    #[error("the graph was degraded: {0}")]
    Degraded(String),
    #[error(transparent)]
    SharedCursors(#[from] CursorsError),
    /// Shared memory is full.
    #[error(transparent)]
    Room(NamespaceError),
    /// Without its socket no command could stop the graph.
    #[error("commands cannot reach the graph: its socket cannot be used")]
    Control(#[source] std::io::Error),
}

impl LaunchError {
    fn of_spawn(node: &Node, source: std::io::Error) -> LaunchError {
        LaunchError::Spawn { node: node.id.clone(), program: node.program.display().to_string(), source }
    }

    /// Whether the machine lacks descriptors, processes or memory, which may pass.
    fn is_shortage(&self) -> bool {
        let LaunchError::Spawn { source, .. } = self else { return false };
        let errno = source.raw_os_error().map(Errno::from_raw_os_error);
        errno.is_some_and(|errno| [Errno::AGAIN, Errno::MFILE, Errno::NFILE, Errno::NOMEM].contains(&errno))
    }
}

/// How a graph ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// All sources have sent what they had.
    Finished,
    /// It was asked to stop.
    Stopped,
}

/// What wakes the launcher's loop.
enum Event {
    /// Output of the process with this id.
    Output(u64, ProcessOutput),
    /// A client asks for something.
    Ask(Box<Ask>),
    /// A client has closed its connection.
    ClientGone(u64),
}

/// A graph's processes. The processes that are left are killed when it is dropped.
pub struct Launcher {
    options: LaunchOptions,
    name: String,
    /// The program that has the ports of nodes in other languages.
    host: Option<Program>,
    file: PathBuf,
    /// The folder of the dataflow file, for relative paths in it.
    folder: PathBuf,
    plan: Plan,
    cursors: SharedCursors,
    members: Vec<Member>,
    swap: Option<Swap>,
    clients: Clients,
    link: LinkBook,
    /// Old instances of swapped nodes on their way out.
    leaving: Vec<Leaving>,
    state: GraphState,
    degraded: Option<String>,
    /// The failure of a node that must not be started again, found while the launcher waited for another one.
    failure: Option<LaunchError>,
    events: Receiver<Event>,
    sender: SyncSender<Event>,
    log_folder: LogFolder,
    logs: LogWriter,
    /// Prints to stderr, and does not wait for its reader.
    printer: Arc<Mutex<LinePrinter>>,
    /// The launcher's own log.
    own_log: Option<Log>,
    /// The decisions that the launching command has read.
    decisions: Arc<Mutex<DecisionStatus>>,
    /// The sources have been told to go.
    has_gone: bool,
    n_processes: u64,
    n_sets: u64,
    settings: Vec<PendingSet>,
    service: Service,
    is_to_begin_again: bool,
    /// No sample is on its way any more: a sample that was sent and not received is lost.
    has_ended: bool,
    started: Instant,
    slow_nodes: SlowNodes,
    wake_policy: WakePolicy,
    /// When heartbeats were looked at last ([`monotonic_nanos`]).
    last_look_nanos: u64,
}

/// An old instance of a swapped node. It stays until its samples are answered, because its memory goes with it.
struct Leaving {
    /// The index of its node among the members.
    idx: usize,
    process: Process,
    since: Instant,
    /// The last sample that it has sent at each output.
    sent: Vec<(Port, SampleId)>,
    is_let_go: bool,
}

/// A node and its processes.
struct Member {
    node: Node,
    /// The process that answers samples; `None` before the restart of one that has died.
    active: Option<Process>,
    standby: Option<Process>,
    state: NodeState,
    n_instances: usize,
    n_swaps: u32,
    log: Log,
    n_restarts: u32,
    /// When it was restarted, within its window.
    restarts: VecDeque<Instant>,
    restart_at: Option<Instant>,
    /// It has died because shared memory is full, and is started again when there is room.
    waits_for_room: bool,
    /// When it was found dead, until it is ready again.
    died: Option<Instant>,
    /// The sample on which its last process has died.
    deadly: Option<SampleId>,
    /// Samples on which it has died twice in a row. They are left without an answer.
    quarantine: Vec<SampleId>,
    /// The reason for which its last process failed before it was ready.
    start_failure: Option<String>,
    /// It has ended, and with it the graph: it is not started again.
    is_over: bool,
    is_source: bool,
    /// What its processes have counted besides their samples, together.
    counts: BTreeMap<String, u64>,
}

/// Raises the limit of descriptors of this process and of those that it starts as far as it may. Connections of strangers to
/// the link take some, and the usual limit (1024) is for programs that call select().
fn raise_descriptor_limit() {
    let limit = getrlimit(Resource::Nofile);
    let most = limit.maximum.unwrap_or(MOST_DESCRIPTORS).min(MOST_DESCRIPTORS);
    if limit.current.is_some_and(|current| current < most) {
        // A process may raise its soft limit to the hard one. If the system refuses nevertheless, the graph runs as before.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(most), ..limit });
    }
}

impl Launcher {
    /// Starts all processes of a graph, in its order, and answers commands on `control`.
    ///
    /// # Errors
    /// A program cannot be started, or the socket cannot be used; processes already started are killed.
    pub fn start(
        graph: &Graph,
        name: &str,
        plan: Plan,
        cursors: SharedCursors,
        control: &UnixListener,
        decisions: Arc<Mutex<DecisionStatus>>,
        options: LaunchOptions,
    ) -> Result<Launcher, LaunchError> {
        raise_descriptor_limit();
        let (sender, events) = sync_channel(MAX_PENDING_EVENTS);
        let log_folder = LogFolder::of_graph(name);
        let logs = LogWriter::new(log_folder.clone(), options.log_format);
        let mut launcher = Launcher {
            own_log: if options.is_on_terminal { Some(logs.log("run")) } else { None },
            log_folder,
            logs,
            printer: Arc::new(Mutex::new(LinePrinter::new(std::io::stderr(), MAX_UNREAD_LINES))),
            options,
            name: name.into(),
            folder: graph.file.parent().unwrap_or(std::path::Path::new("/")).into(),
            file: graph.file.clone(),
            host: graph.host.clone(),
            plan,
            cursors,
            members: Vec::new(),
            swap: None,
            clients: Clients::default(),
            link: LinkBook::new(graph.local.clone()),
            leaving: Vec::new(),
            state: GraphState::Starting,
            degraded: None,
            failure: None,
            events,
            sender,
            decisions,
            has_gone: false,
            n_processes: 0,
            n_sets: 0,
            settings: Vec::new(),
            service: Service::of_this_process(),
            is_to_begin_again: false,
            has_ended: false,
            started: Instant::now(),
            slow_nodes: SlowNodes::new(),
            wake_policy: WakePolicy::new(),
            last_look_nanos: monotonic_nanos(),
        };
        for node in &graph.nodes {
            launcher.members.push(Member::new(node, launcher.logs.log(&node.id)));
        }
        let audit = launcher.logs.log_if_written(AUDIT);
        let pins = graph.nodes.iter().map(|node| (node.id.clone(), node.sha256.clone())).collect();
        let server = server::serve(control, pins, &launcher.sender, audit).map_err(LaunchError::Control)?;
        launcher.clients.server = Some(server);
        launcher.spawn_all()?;
        Ok(launcher)
    }

    fn spawn_all(&mut self) -> Result<(), LaunchError> {
        for idx in 0..self.members.len() {
            if self.members[idx].active.is_none() {
                self.spawn_active(idx)?;
            }
        }
        Ok(())
    }

    /// The members that share the process of a member, itself included, in the graph's order.
    fn together(&self, idx: usize) -> Vec<usize> {
        match &self.members[idx].node.process.group {
            None => vec![idx],
            group => {
                (0..self.members.len()).filter(|other| self.members[*other].node.process.group == *group).collect()
            }
        }
    }

    /// Starts the process of a member, and of those that share it.
    fn spawn_active(&mut self, idx: usize) -> Result<(), LaunchError> {
        let idxs = self.together(idx);
        let nodes: Vec<(usize, Node)> = idxs.iter().map(|idx| (*idx, self.members[*idx].node.clone())).collect();
        for (idx, process) in idxs.into_iter().zip(self.spawn(&nodes, false)?) {
            self.members[idx].active = Some(process);
        }
        Ok(())
    }

    /// Starts a process for a node, or for all nodes of a group.
    fn spawn(&mut self, nodes: &[(usize, Node)], standby: bool) -> Result<Vec<Process>, LaunchError> {
        let mut starts = Vec::with_capacity(nodes.len());
        // The instances of a group's nodes live and end together, so a place that is free for one is free for all.
        let n_before = nodes.first().map_or(0, |(idx, _)| self.make_room_for_instance(*idx));
        for (idx, node) in nodes {
            let Some(mut wiring) = self.plan.wiring(node, n_before, standby) else {
                let error = std::io::Error::other("its ports are not those of the running graph");
                return Err(LaunchError::of_spawn(node, error));
            };
            if !standby {
                wiring.skip.clone_from(&self.members[*idx].quarantine);
                wiring.suspect = self.members[*idx].deadly;
            }
            let slot = self.cursors.instance(wiring.instance_slot);
            slot.beat(0);
            slot.works_on(None);
            self.n_processes += 1;
            self.members[*idx].n_instances = n_before + 1;
            let sink = LineSink {
                node: node.id.clone(),
                log: Some(self.members[*idx].log.clone()),
                printer: self.options.is_on_terminal.then(|| Arc::clone(&self.printer)),
            };
            starts.push(Start { id: self.n_processes, node, wiring, sink });
        }
        let Some((_, first)) = nodes.first() else {
            return Ok(Vec::new());
        };
        let failed = |source| LaunchError::of_spawn(first, source);
        let prepared = PreparedProgram::of(&starts, self.host.as_ref()).map_err(failed)?;
        let begun = self.begin(nodes, prepared)?;
        Process::of(&starts, begun, &self.sender).map_err(failed)
    }

    /// The number of a node's next instance: the first whose heartbeat slot is free. `None` if too many old instances are on
    /// their way out.
    fn free_instance(&self, idx: usize) -> Option<usize> {
        let member = &self.members[idx];
        let leaving = self.leaving.iter().map(|leaving| &leaving.process);
        let living: Vec<usize> =
            member.active.iter().chain(&member.standby).chain(leaving).map(|process| process.instance_slot).collect();
        let mut numbers = member.n_instances..member.n_instances + crate::plan::N_INSTANCES;
        numbers.find(|n_before| {
            self.plan.instance_slot(&member.node.id, *n_before).is_some_and(|slot| !living.contains(&slot))
        })
    }

    /// Ends old instances of a node until a new one has a heartbeat slot of its own.
    fn make_room_for_instance(&mut self, idx: usize) -> usize {
        loop {
            if let Some(n_before) = self.free_instance(idx) {
                return n_before;
            }
            let slots: Vec<usize> = (0..crate::plan::N_INSTANCES)
                .filter_map(|n| self.plan.instance_slot(&self.members[idx].node.id, n))
                .collect();
            match self.leaving.iter().position(|leaving| slots.contains(&leaving.process.instance_slot)) {
                // Dropping it kills it.
                Some(oldest) => drop(self.leaving.remove(oldest)),
                None => return self.members[idx].n_instances,
            }
        }
    }

    /// Node ids and process ids, in the graph's order.
    pub fn pids(&self) -> Vec<(String, u32)> {
        let active =
            self.members.iter().filter_map(|member| Some((member.node.id.clone(), member.active.as_ref()?.pid())));
        active.collect()
    }

    /// The counts of each edge.
    pub fn edges(&self) -> Vec<EdgeStatus> {
        self.plan.edges(&self.cursors, self.has_ended)
    }

    /// Waits until every operator is ready and `is_observed` says that the observer is, then starts the sources.
    /// `should_stop` ends the wait with [`End::Stopped`].
    ///
    /// # Errors
    /// An operator failed or is not ready in time.
    pub fn wait_until_ready(
        &mut self,
        is_observed: &dyn Fn() -> bool,
        should_stop: &dyn Fn() -> bool,
    ) -> Result<Option<End>, LaunchError> {
        let start = Instant::now();
        while self.members.iter().any(Member::is_starting) || !is_observed() {
            if should_stop() || self.clients.is_asked_to_stop {
                return Ok(Some(End::Stopped));
            }
            self.listen(POLL.min(Duration::from_millis(5)));
            for (idx, member) in self.members.iter_mut().enumerate() {
                if let Some(process) = &mut member.active
                    && (process.look() || process.failure().is_some())
                {
                    member.is_over = true;
                    let id = member.node.id.clone();
                    self.drain_logs(|launcher| launcher.members[idx].active.as_ref());
                    return Err(self.failed(&id, true));
                }
            }
            if start.elapsed() > self.options.startup_limit {
                return Err(self.not_ready());
            }
        }
        namespace::take_room(self.plan.domain()).map_err(LaunchError::Room)?;
        self.warn_of_mismatches();
        // The start of the service must not depend on other machines.
        self.service.is_ready(if self.link_idx().is_some() { "waiting for the other machines" } else { RUNNING });
        if let Some(end) = self.wait_for_machines(should_stop)? {
            return Ok(Some(end));
        }
        self.state = GraphState::Running;
        self.service.has_status(RUNNING);
        self.has_gone = true;
        for member in &mut self.members {
            member.state = match member.state {
                NodeState::Starting if member.is_done() => NodeState::Done,
                NodeState::Starting => NodeState::Running,
                other => other,
            };
            if let Some(process) = member.active.as_mut()
                && !member.node.is_link()
            {
                process.tell(&Command::Go);
            }
        }
        Ok(None)
    }

    fn not_ready(&self) -> LaunchError {
        let late: Vec<&Member> = self.members.iter().filter(|member| member.is_starting()).collect();
        let mut nodes: Vec<_> = late.iter().map(|member| member.node.id.clone()).collect();
        if nodes.is_empty() {
            nodes.push("the run itself: an operator reported ready but did not open an output".into());
        }
        let processes = late.iter().filter_map(|member| member.active.as_ref());
        LaunchError::NotReady {
            nodes,
            limit_secs: self.options.startup_limit.as_secs_f64(),
            log: processes.flat_map(Process::last_lines).collect(),
        }
    }

    /// Tells the link, if there is one, that all is ready here, and waits for the other machines: earlier samples of
    /// sources could not be decided. Machines may be started in any order, and at any time.
    fn wait_for_machines(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Option<End>, LaunchError> {
        let Some(link) = self.link_idx() else {
            return Ok(None);
        };
        if let Some(process) = &mut self.members[link].active {
            process.tell(&Command::Go);
        }
        while !self.members[link].active.as_ref().is_some_and(|process| process.is_connected) {
            if should_stop() || self.clients.is_asked_to_stop {
                return Ok(Some(End::Stopped));
            }
            self.turn(POLL)?;
        }
        Ok(None)
    }

    fn link_idx(&self) -> Option<usize> {
        self.members.iter().position(|member| member.node.is_link())
    }

    /// Whether a source goes on, here or on another machine whose samples are awaited here.
    fn is_fed(&self) -> bool {
        let has_source =
            self.members.iter().any(|member| member.is_source && !member.is_done() && !member.is_given_up());
        // A machine without operators watches until it is stopped.
        let is_watching = self.link.is_part() && self.members.iter().all(|member| member.node.is_link());
        has_source || self.link.awaits_source() || is_watching
    }

    /// Supervises the graph until all sources have ended, or `should_stop`, or a client stops it.
    ///
    /// # Errors
    /// An operator failed that must not be started again.
    pub fn wait_until_finished(&mut self, should_stop: &dyn Fn() -> bool) -> Result<End, LaunchError> {
        loop {
            if should_stop() || self.clients.is_asked_to_stop {
                self.link.was_stopped = true;
                return Ok(End::Stopped);
            }
            if !self.is_fed() {
                self.is_to_begin_again = self.options.begins_again;
                self.abandon_swap("all sources have sent what they had");
                return Ok(End::Finished);
            }
            self.turn(POLL)?;
        }
    }

    /// How the run has ended. A client may have stopped a graph that begins again after its last sample, while it drained.
    #[must_use]
    pub fn final_end(&self, end: End) -> End {
        if self.is_to_begin_again && self.clients.is_asked_to_stop { End::Stopped } else { end }
    }

    /// Asks one operator after the other, sources first, to answer what is left, and waits for it: for all of them
    /// within the grace period, and not at all once `should_hurry`. An operator that dies meanwhile is started again,
    /// if it may be.
    ///
    /// # Errors
    /// An operator failed or did not drain in time; the others are drained all the same.
    pub fn drain(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        self.abandon_swap("the graph is stopping");
        self.state = GraphState::Stopping;
        if !self.is_to_begin_again {
            self.service.is_stopping();
        }
        self.take_no_more();
        let mut first_error = None;
        let mut deadline = Instant::now() + self.options.grace;
        for idx in 0..self.members.len() {
            if let Err(error) = self.drain_member(idx, deadline, should_hurry) {
                first_error.get_or_insert(error);
            }
            let member = &self.members[idx];
            if !member.is_done() && !member.is_given_up() && !member.is_over {
                let what = if should_hurry() {
                    "had not drained when it was killed".into()
                } else {
                    format!("did not drain within {} s", self.options.grace.as_secs_f64())
                };
                let node = member.node.id.clone();
                first_error.get_or_insert(LaunchError::Failed { node, what, log: Vec::new() });
                // The operators behind it may have all that they need, and get a little time.
                deadline = Instant::now() + LISTEN;
            }
            self.on_node_ended(idx);
        }
        self.retire_attached(should_hurry);
        if let Some(message) = &self.degraded {
            first_error.get_or_insert(LaunchError::Degraded(message.clone()));
        }
        first_error.map_or(Ok(()), Err)
    }

    /// Asks an operator to drain, once no machine feeds it any more, and waits for it.
    fn drain_member(
        &mut self,
        idx: usize,
        deadline: Instant,
        should_hurry: &dyn Fn() -> bool,
    ) -> Result<(), LaunchError> {
        loop {
            let member = &mut self.members[idx];
            let is_fed = self.link.may_feed(&member.node);
            let is_asked = member.active.as_ref().is_none_or(|process| process.is_asked || member.is_source);
            if (member.is_done() && is_asked) || member.is_given_up() || member.is_over {
                return Ok(());
            }
            if let Some(process) = &mut member.active
                && !process.is_asked
                && process.is_ready()
                && !is_fed
            {
                process.ask_to_drain();
            }
            if Instant::now() >= deadline || should_hurry() {
                return Ok(());
            }
            self.turn(POLL.min(Duration::from_millis(2)))?;
        }
    }

    /// A part of a graph that is stopped takes no more samples of sources on other machines.
    fn take_no_more(&mut self) {
        let ports: Vec<String> = self.link.driven_ports().cloned().collect();
        let link = if self.link.was_stopped && !ports.is_empty() { self.link_idx() } else { None };
        if let Some(process) = link.and_then(|link| self.members[link].active.as_mut()) {
            process.tell(&Command::TakeNoMore { ports });
            self.link.takes_more_until = Some(Instant::now() + LINK_WAIT);
        }
    }

    /// Tells the other machines that the outputs of a node have ended.
    fn on_node_ended(&mut self, idx: usize) {
        let node = self.members[idx].node.id.clone();
        if let Some(link) = self.link_idx().filter(|link| *link != idx) {
            self.link.ended_nodes.push(node.clone());
            if let Some(process) = &mut self.members[link].active {
                process.tell(&Command::NodeEnded { node });
            }
        }
    }

    /// Lets all operators exit. Operators that are left after the grace period, or once `should_hurry`, are killed.
    ///
    /// # Errors
    /// An operator had to be killed, or failed on its way out.
    pub fn quit(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        self.state = GraphState::Stopping;
        let mut gave_up = Vec::new();
        for member in &mut self.members {
            for process in member.processes() {
                // A process that was asked and has not drained will not drain now.
                if process.is_asked && !process.is_done {
                    gave_up.push(process.id);
                } else if !process.is_done {
                    process.ask_to_drain();
                }
                process.let_go();
            }
        }
        self.leaving.iter_mut().for_each(Leaving::let_go);
        let start = Instant::now();
        while start.elapsed() <= self.options.grace && !should_hurry() {
            let members = self.members.iter_mut();
            let processes = members.flat_map(|member| member.processes());
            let mut n_awaited = 0;
            for process in processes.chain(self.leaving.iter_mut().map(|leaving| &mut leaving.process)) {
                process.look();
                n_awaited += usize::from(process.is_running() && !gave_up.contains(&process.id));
            }
            if n_awaited == 0 {
                break;
            }
            self.listen(Duration::from_millis(1));
        }
        let mut killed = Vec::new();
        for member in &mut self.members {
            let id = member.node.id.clone();
            for process in member.processes() {
                if process.kill() {
                    killed.push(id.clone());
                }
            }
        }
        self.leaving.clear();
        self.clients.stoppers.clear();
        self.has_ended = true;
        if !killed.is_empty() {
            return Err(LaunchError::Killed { nodes: killed, grace_secs: self.options.grace.as_secs_f64() });
        }
        for member in &self.members {
            if !member.is_given_up() && member.active.as_ref().is_some_and(|process| !process.has_ended_well()) {
                let id = member.node.id.clone();
                return Err(self.failed(&id, false));
            }
        }
        Ok(())
    }

    /// One round: listens for up to `limit`, finds dead and hung processes, restarts them, goes on with a swap.
    fn turn(&mut self, limit: Duration) -> Result<(), LaunchError> {
        let next_restart = self.members.iter().filter_map(|member| member.restart_at).min();
        let until_restart = next_restart.map(|at| at.saturating_duration_since(Instant::now()));
        self.listen(until_restart.map_or(limit, |until| limit.min(until)));
        self.supervise_others(&[]);
        if let Some(error) = self.failure.take() {
            return Err(error);
        }
        self.go_on_with_swap();
        self.look_at_settings();
        while !self.is_setting()
            && let Some(ask) = self.clients.waiting.pop_front()
        {
            self.answer(*ask);
        }
        self.retire_leaving();
        if self.plan.clock() == Clock::Machine && self.slow_nodes.is_due() {
            let edges = self.edges();
            if let Some(line) = self.slow_nodes.look(&edges) {
                self.say(&line);
            }
        }
        if self.wake_policy.is_due() {
            self.give_wake_policy();
        }
        Ok(())
    }

    /// Gives a policy to the processes for which the dataflow file names none.
    fn give_wake_policy(&mut self) {
        // A node that polls does not give way: the others must interrupt it.
        let polls = self.members.iter().any(|member| member.node.process.wait != WaitMode::Event);
        let open = self.members.iter().filter(|member| {
            let options = &member.node.process;
            options.scheduling.is_none() && options.nice.is_none() && options.cpus.is_empty()
        });
        let processes = open.flat_map(|member| member.active.iter().chain(&member.standby));
        let ready = processes.filter(|process| process.is_ready() && process.is_running());
        let pids: BTreeSet<u32> = ready.map(Process::pid).collect();
        self.wake_policy.look(&pids, !polls);
    }

    /// Lets old instances go whose samples are answered, and kills those that do not end.
    fn retire_leaving(&mut self) {
        let mut leaving = std::mem::take(&mut self.leaving);
        leaving.retain_mut(|leaving| {
            leaving.process.look();
            if !leaving.is_let_go && (self.is_read(&leaving.sent) || leaving.since.elapsed() > READ_LIMIT) {
                leaving.let_go();
            }
            let may_end = leaving.is_let_go && leaving.process.is_needed_by_none();
            if leaving.process.is_running() && may_end && leaving.since.elapsed() > self.options.grace {
                leaving.process.kill();
            }
            leaving.process.is_running()
        });
        self.leaving = leaving;
    }

    /// Takes in the output of processes and the requests of clients, for up to `limit` until the first.
    fn listen(&mut self, limit: Duration) {
        self.service.beat();
        let mut next = self.events.recv_timeout(limit);
        let start = Instant::now();
        loop {
            match next {
                Ok(Event::Output(id, output)) => self.on_output(id, output),
                Ok(Event::Ask(ask)) => self.on_ask(ask),
                Ok(Event::ClientGone(client)) => {
                    self.release_attached(client);
                    self.on_client_gone(client);
                }
                // The launcher itself holds a sender.
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => return,
            }
            if start.elapsed() > LISTEN {
                return;
            }
            next = self.events.recv_timeout(Duration::ZERO);
        }
    }

    /// Answers a request that needs no time; the others wait for the next turn.
    fn on_ask(&mut self, ask: Box<Ask>) {
        match ask.request {
            Request::Status => {
                let _ = ask.reply.try_send(Reply::Status(Box::new(self.status())));
            }
            Request::Stop => {
                let _ = ask.reply.try_send(Reply::Stopping);
                self.clients.stoppers.push(ask.reply);
                self.clients.is_asked_to_stop = true;
            }
            Request::Attach { ports, is_flight_recorder } => {
                self.attach(&ports, is_flight_recorder, ask.client, &ask.reply);
            }
            Request::Keep => {
                let _ = ask.reply.try_send(self.ask_flight_recorders());
            }
            _ => self.clients.waiting.push_back(ask),
        }
    }

    fn on_output(&mut self, id: u64, output: ProcessOutput) {
        let found = self.members.iter_mut().find_map(|member| {
            let is_active = member.active.as_ref().is_some_and(|process| process.id == id);
            let mut processes = member.active.iter_mut().chain(member.standby.iter_mut());
            let process = processes.find(|process| process.id == id)?;
            Some((&member.node.id, &member.log, &mut member.counts, process, is_active))
        });
        // The output of a process on its way out is not needed.
        let Some((node, log, totals, process, is_active)) = found else {
            return;
        };
        match output {
            ProcessOutput::Report(Report::Link(status)) => self.link.on_status(id, *status),
            ProcessOutput::Report(Report::Set { id, from_seq, error }) => self.on_set(id, from_seq, error),
            ProcessOutput::Report(Report::Unfit { message }) => {
                let node = node.clone();
                self.failure.get_or_insert(LaunchError::Failed { node, what: message, log: Vec::new() });
            }
            ProcessOutput::Report(Report::Ended { ports }) => self.link.on_ended_imports(ports),
            ProcessOutput::Report(report) => {
                match &report {
                    Report::Failed { message } => {
                        let entry = LogEntry { level: Some(LogLevel::Error), ..LogEntry::plain(message) };
                        log.write(entry);
                    }
                    // A standby counts what the active process counts as well.
                    Report::Counts { in_all: true, .. } if !is_active => {}
                    // Zeros are shown in the place of other counts, and not by themselves.
                    Report::Counts { counts, in_all: true }
                        if counts.iter().any(|(name, count)| *count > 0 || totals.contains_key(name)) =>
                    {
                        totals.extend(counts.clone());
                    }
                    Report::Counts { counts, in_all: false } => {
                        for (name, count) in counts {
                            let before = process.counts.get(name).copied().unwrap_or(0);
                            *totals.entry(name.clone()).or_default() += count.saturating_sub(before);
                        }
                    }
                    _ => {}
                }
                let is_ready = matches!(report, Report::Ready { .. });
                process.on_report(report);
                if !is_ready {
                    return;
                }
                let lacks_sandbox = process.lacks_sandbox();
                let lacks_sandbox =
                    lacks_sandbox.map(|what| format!("blindgrasp: node '{node}' has 'sandbox: on', but {what}"));
                lacks_sandbox.into_iter().for_each(|line| self.say(&line));
                // A process of a restart or a swap has files of its own.
                if self.has_gone
                    && let Err(error) = namespace::take_room(self.plan.domain())
                {
                    self.say(&format!("blindgrasp: shared memory is nearly full: {error}"));
                }
            }
            ProcessOutput::Closed => {}
        }
    }

    /// Prints and logs a line of the launcher's own.
    fn say(&mut self, line: &str) {
        self.printer.lock().unwrap_or_else(PoisonError::into_inner).print(line);
        if let Some(log) = &self.own_log {
            log.write(LogEntry::plain(line));
        }
    }

    /// Listens to an ended process until it has said why it failed, or half a second has passed: its last lines may still
    /// be on their way.
    fn drain_logs(&mut self, process: impl Fn(&Self) -> Option<&Process>) {
        let start = Instant::now();
        while process(self).is_some_and(|process| process.failure().is_none()) && start.elapsed() < LOG_DRAIN_LIMIT {
            self.listen(POLL);
        }
    }

    /// The error of a node whose active process has failed.
    fn failed(&self, id: &str, is_early: bool) -> LaunchError {
        let process = self.members.iter().find(|member| member.node.id == id).and_then(|member| member.active.as_ref());
        let (what, log) = process.map_or_else(
            || ("has no process".into(), Vec::new()),
            |process| {
                let early = if is_early && process.failure().is_none() { " too early" } else { "" };
                // The report of its failure is the error's text already.
                let log = if process.failure().is_some() { Vec::new() } else { process.last_lines() };
                (format!("{}{early}", process.ending()), log)
            },
        );
        LaunchError::Failed { node: id.into(), what, log }
    }

    /// Warns of nodes that were made for different hands or dictionaries: the arbiter will hold.
    fn warn_of_mismatches(&mut self) {
        let mut seen: Vec<(String, String, String)> = Vec::new();
        let mut lines = Vec::new();
        for member in &self.members {
            let identity = member.active.iter().filter_map(|process| process.identity.as_ref()).flatten();
            for (key, value) in identity {
                match seen.iter().find(|(known, _, _)| known == key) {
                    Some((_, other, node)) if other != value => lines.push(format!(
                        "blindgrasp: node '{}' is made for the {key} {value}, node '{node}' for {other}: nothing will be lifted",
                        member.node.id
                    )),
                    Some(_) => {}
                    None => seen.push((key.clone(), value.clone(), member.node.id.clone())),
                }
            }
        }
        for line in lines {
            self.say(&line);
        }
    }

    fn answer(&mut self, ask: Ask) {
        match ask.request {
            // Answered in `on_ask`.
            Request::Status | Request::Stop | Request::Attach { .. } | Request::Keep => {}
            Request::Set { node, param, value } => {
                if let Err(message) = self.set(&node, param, &value, &ask.reply) {
                    let _ = ask.reply.try_send(Reply::refusal(message));
                }
            }
            Request::Swap(request) => self.begin_swap(request, ask.description, ask.client, ask.reply),
            Request::Promote => self.on_promote(true, ask.client, ask.reply),
            Request::Abandon => self.on_promote(false, ask.client, ask.reply),
        }
    }

    fn member_idx(&self, id: &str) -> Result<usize, String> {
        let found = self.members.iter().position(|member| member.node.id == id);
        found.ok_or_else(|| {
            if let Some(machine) = self.link.machine_of(id) {
                return format!("node '{id}' runs on machine '{machine}': give --machine {machine}");
            }
            let known: Vec<_> = self.members.iter().map(|member| member.node.id.as_str()).collect();
            let alike = did_you_mean(id, known.iter().copied()).map(|alike| format!("{alike} ")).unwrap_or_default();
            format!("graph '{}' has no node '{id}'; {alike}its nodes: {}", self.name, known.join(", "))
        })
    }

    pub fn status(&self) -> GraphStatus {
        GraphStatus {
            graph: self.name.clone(),
            file: self.file.clone(),
            pid: std::process::id(),
            state: self.state,
            message: if self.members.iter().any(Member::is_given_up) { self.degraded.clone() } else { None },
            uptime_secs: self.started.elapsed().as_secs_f64(),
            log_folder: self.log_folder.path().into(),
            iceoryx2: Iceoryx2Config { root_path: self.plan.domain().ports(), prefix: FILE_PREFIX.into() },
            nodes: self.members.iter().map(|member| self.node_status(member)).collect(),
            edges: self.edges(),
            decisions: self.decisions.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            link: self.link.status().cloned(),
            ssh_hosts: self.link.ssh_hosts(),
        }
    }

    fn node_status(&self, member: &Member) -> NodeStatus {
        let beat = member.active.as_ref().map(|process| self.cursors.instance(process.instance_slot).last_beat_nanos());
        NodeStatus {
            node: member.node.id.clone(),
            program: member.node.program.clone(),
            args: member.node.args.clone(),
            state: member.state,
            pid: member.active.as_ref().map(Process::pid),
            standby_pid: member.standby.as_ref().map(Process::pid),
            n_restarts: member.n_restarts,
            n_swaps: member.n_swaps,
            heartbeat_age_millis: beat
                .filter(|beat| *beat != 0)
                .map(|beat| monotonic_nanos().saturating_sub(beat) / 1_000_000),
            params: member.node.params.clone(),
            counts: member.counts.clone(),
        }
    }
}

impl Leaving {
    /// Asks it to end, within the grace period from now on.
    fn let_go(&mut self) {
        if !std::mem::replace(&mut self.is_let_go, true) {
            self.since = Instant::now();
            self.process.let_go();
            self.process.ask_to_drain();
        }
    }
}

impl Member {
    fn new(node: &Node, log: Log) -> Member {
        Member {
            node: node.clone(),
            active: None,
            standby: None,
            state: NodeState::Starting,
            n_instances: 0,
            n_swaps: 0,
            log,
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

    fn is_starting(&self) -> bool {
        self.active.as_ref().is_none_or(|process| !process.is_ready() && !process.is_done)
    }

    /// The active process, and the one that stands by during a swap.
    fn processes(&mut self) -> impl Iterator<Item = &mut Process> {
        self.active.iter_mut().chain(self.standby.iter_mut())
    }

    fn is_done(&self) -> bool {
        self.active.as_ref().is_some_and(|process| process.is_done)
    }

    fn is_given_up(&self) -> bool {
        self.state == NodeState::Failed
    }
}
