//! Starts, supervises and stops a graph's processes. It never touches samples.
//!
//! One loop takes in events, and carries out the orders of the pure rules (`lifecycle`). It waits for nothing else.
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
mod ending;
mod hands;
mod lifecycle;
#[cfg(test)]
mod lifecycle_tests;
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
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::control::{DecisionStatus, EdgeStatus, GraphStatus, Iceoryx2Config, NodeStatus, Reply, Request};
use crate::dataflow::pins::PinError;
use crate::dataflow::{Graph, Node};
use crate::launcher::attached::AttachedReader;
use crate::launcher::hands::Hands;
use crate::launcher::lifecycle::{Lifecycle, Member, Surroundings};
use crate::launcher::log_writer::LogWriter;
use crate::launcher::process::BegunProgram;
pub use crate::launcher::process::ZENOH_THREADS;
use crate::launcher::server::{Ask, Server};
use crate::launcher::service::Service;
use crate::launcher::set::PendingSet;
use crate::launcher::slow_nodes::SlowNodes;
pub(crate) use crate::launcher::supervision::QUARANTINED;
use crate::launcher::wake_policy::WakePolicy;
use crate::log::AUDIT;
use crate::log::{LogFolder, LogFormat, log_tail};
use crate::plan::{N_ATTACHED, Plan};
use blindgrasp_operator::cursors::{CursorsError, SharedCursors};
use blindgrasp_operator::diagnostics::LinePrinter;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::namespace::{self, FILE_PREFIX, NamespaceError};
use blindgrasp_operator::wiring::{Clock, Command, LogEntry, LogLevel, Report, WaitMode};
use rustix::io::Errno;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// The status of a graph without trouble.
const RUNNING: &str = "running";
/// The launcher checks the stop request and heartbeats this often. Output and ends of its children wake it at once.
const POLL: Duration = Duration::from_millis(50);
/// The launcher listens this long at a stretch before it does anything else.
const LISTEN: Duration = Duration::from_millis(50);
/// A link says within this time that it takes no more samples, unless it hangs or was killed.
const LINK_WAIT: Duration = Duration::from_secs(1);
/// This many lines of all operators may wait for the launcher.
const MAX_PENDING_EVENTS: usize = 1024;
/// This many lines wait for the reader of stderr.
const MAX_UNREAD_LINES: usize = 4096;
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
    /// The program of the instance with this id has begun, or has not.
    Begun(u64, Result<BegunProgram, LaunchError>),
    /// A report of the instance with this id.
    Output(u64, Report),
    /// A process has closed the pipe for its reports, and is ending, most likely.
    Closed,
    /// A client asks for something.
    Ask(Box<Ask>),
    /// A client has closed its connection.
    ClientGone(u64),
}

/// A graph's processes. The processes that are left are killed when it is dropped.
pub struct Launcher {
    life: Lifecycle<Hands>,
    server: Option<Server>,
    /// Requests that came while the launcher was busy.
    waiting: VecDeque<Box<Ask>>,
    /// The clients that asked the graph to stop. The end of their connection says that it has ended.
    stoppers: Vec<SyncSender<Reply>>,
    /// Clients that read edges, each with the slots of its place.
    attached: [Option<AttachedReader>; N_ATTACHED],
    events: Receiver<Event>,
    log_folder: LogFolder,
    /// The decisions that the launching command has read.
    decisions: Arc<Mutex<DecisionStatus>>,
    n_sets: u64,
    settings: Vec<PendingSet>,
    is_to_begin_again: bool,
    /// No sample is on its way any more: a sample that was sent and not received is lost.
    has_ended: bool,
    started: Instant,
    slow_nodes: SlowNodes,
    wake_policy: WakePolicy,
    /// It writes as long as it lives.
    _logs: LogWriter,
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
    /// Orders the start of all processes of a graph, and answers commands on `control`.
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
        let hands = Hands {
            plan,
            cursors,
            host: graph.host.clone(),
            processes: BTreeMap::new(),
            starting: BTreeMap::new(),
            logs: graph.nodes.iter().map(|node| logs.log(&node.id)).collect(),
            is_on_terminal: options.is_on_terminal,
            printer: Arc::new(Mutex::new(LinePrinter::new(std::io::stderr(), MAX_UNREAD_LINES))),
            own_log: if options.is_on_terminal { Some(logs.log("run")) } else { None },
            service: Service::of_this_process(),
            events: sender,
            failure: None,
            swapping: BTreeMap::new(),
            last_look_nanos: monotonic_nanos(),
        };
        let audit_log = logs.log_if_written(AUDIT);
        let mut launcher = Launcher {
            life: Lifecycle::new(graph, name, options, hands),
            server: None,
            waiting: VecDeque::new(),
            stoppers: Vec::new(),
            attached: std::array::from_fn(|_| None),
            events,
            log_folder,
            decisions,
            n_sets: 0,
            settings: Vec::new(),
            is_to_begin_again: false,
            has_ended: false,
            started: Instant::now(),
            slow_nodes: SlowNodes::new(),
            wake_policy: WakePolicy::new(),
            _logs: logs,
        };
        let pins = graph.nodes.iter().map(|node| (node.id.clone(), node.sha256.clone())).collect();
        let server =
            server::serve(control, pins, &launcher.life.site.events, audit_log).map_err(LaunchError::Control)?;
        launcher.server = Some(server);
        launcher.life.launch();
        while launcher.pids().len() < graph.nodes.len() {
            launcher.turn()?;
        }
        Ok(launcher)
    }

    /// Node ids and process ids, in the graph's order.
    pub fn pids(&self) -> Vec<(String, u32)> {
        let mut pids = Vec::new();
        for member in &self.life.members {
            if let Some(pid) = member.active.as_ref().and_then(|active| active.pid) {
                pids.push((member.node.id.clone(), pid));
            }
        }
        pids
    }

    /// The counts of each edge.
    pub fn edges(&self) -> Vec<EdgeStatus> {
        self.life.site.plan.edges(&self.life.site.cursors, self.has_ended)
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
        while self.life.members.iter().any(Member::is_starting) || !is_observed() {
            if should_stop() || self.life.is_asked_to_stop {
                return Ok(Some(End::Stopped));
            }
            self.turn()?;
            if start.elapsed() > self.life.options.startup_limit {
                return Err(self.not_ready());
            }
        }
        self.life.is_launching = false;
        namespace::take_room(self.life.site.plan.domain()).map_err(LaunchError::Room)?;
        self.warn_of_mismatches();
        // The start of the service must not depend on other machines.
        self.life.site.service.is_ready(if self.link_idx().is_some() {
            "waiting for the other machines"
        } else {
            RUNNING
        });
        if let Some(end) = self.wait_for_machines(should_stop)? {
            return Ok(Some(end));
        }
        self.life.begin_to_run();
        Ok(None)
    }

    fn not_ready(&self) -> LaunchError {
        let mut nodes = Vec::new();
        let mut log = Vec::new();
        for member in &self.life.members {
            if member.is_starting() {
                nodes.push(member.node.id.clone());
                log.extend(member.active.iter().flat_map(|active| self.life.site.last_lines(active.id)));
            }
        }
        if nodes.is_empty() {
            nodes.push("the run itself: an operator reported ready but did not open an output".into());
        }
        LaunchError::NotReady { nodes, limit_secs: self.life.options.startup_limit.as_secs_f64(), log }
    }

    /// Tells the link, if there is one, that all is ready here, and waits for the other machines: earlier samples of
    /// sources could not be decided. Machines may be started in any order, and at any time.
    fn wait_for_machines(&mut self, should_stop: &dyn Fn() -> bool) -> Result<Option<End>, LaunchError> {
        let Some(link) = self.link_idx() else {
            return Ok(None);
        };
        self.tell_link(link, &Command::Go);
        while !self.life.members[link].active.as_ref().is_some_and(|active| active.is_connected) {
            if should_stop() || self.life.is_asked_to_stop {
                return Ok(Some(End::Stopped));
            }
            self.turn()?;
        }
        Ok(None)
    }

    fn tell_link(&mut self, link: usize, command: &Command) {
        if let Some(active) = &self.life.members[link].active {
            self.life.site.tell(active.id, command);
        }
    }

    fn link_idx(&self) -> Option<usize> {
        self.life.members.iter().position(|member| member.node.is_link())
    }

    /// Whether a source goes on, here or on another machine whose samples are awaited here.
    fn is_fed(&self) -> bool {
        let members = &self.life.members;
        let link = &self.life.link;
        let has_source = members.iter().any(|member| member.is_source && !member.is_done() && !member.is_given_up());
        // A machine without operators watches until it is stopped.
        let is_watching = link.is_part() && members.iter().all(|member| member.node.is_link());
        has_source || link.awaits_source() || is_watching
    }

    /// Supervises the graph until all sources have ended, or `should_stop`, or a client stops it.
    ///
    /// # Errors
    /// An operator failed that must not be started again.
    pub fn wait_until_finished(&mut self, should_stop: &dyn Fn() -> bool) -> Result<End, LaunchError> {
        loop {
            if should_stop() || self.life.is_asked_to_stop {
                self.life.link.was_stopped = true;
                return Ok(End::Stopped);
            }
            if !self.is_fed() {
                self.is_to_begin_again = self.life.options.begins_again;
                self.life.abandon_swap("all sources have sent what they had");
                return Ok(End::Finished);
            }
            self.turn()?;
        }
    }

    /// How the run has ended. A client may have stopped a graph that begins again after its last sample, while it drained.
    #[must_use]
    pub fn final_end(&self, end: End) -> End {
        if self.is_to_begin_again && self.life.is_asked_to_stop { End::Stopped } else { end }
    }

    /// Asks one operator after the other, sources first, to answer the samples left, and waits for it: for all of them
    /// within the grace period, and not at all once `should_hurry`. An operator that dies meanwhile is started again,
    /// if it may be.
    ///
    /// # Errors
    /// An operator failed or did not drain in time; the others are drained all the same.
    pub fn drain(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        self.life.begin_draining();
        if !self.is_to_begin_again {
            self.life.site.service.is_stopping();
        }
        self.take_no_more();
        let mut outcome = Ok(());
        while !self.life.go_on_draining(should_hurry()) {
            outcome = outcome.and(self.turn());
        }
        outcome = outcome.and(self.life.site.failure.take().map_or(Ok(()), Err));
        self.retire_attached(should_hurry);
        if let Some(message) = &self.life.degraded {
            outcome = outcome.and(Err(LaunchError::Degraded(message.clone())));
        }
        outcome
    }

    /// A part of a graph that is stopped takes no more samples of sources on other machines.
    fn take_no_more(&mut self) {
        let ports: Vec<String> = self.life.link.driven_ports().cloned().collect();
        if let Some(link) = self.link_idx()
            && self.life.link.was_stopped
            && !ports.is_empty()
        {
            self.tell_link(link, &Command::TakeNoMore { ports });
            self.life.link.takes_more_until = Some(Instant::now() + LINK_WAIT);
        }
    }

    /// Lets all operators exit. Operators that are left after the grace period, or once `should_hurry`, are killed.
    ///
    /// # Errors
    /// An operator had to be killed, or failed on its way out.
    pub fn quit(&mut self, should_hurry: &dyn Fn() -> bool) -> Result<(), LaunchError> {
        self.life.begin_quitting();
        while !self.life.go_on_quitting(should_hurry()) {
            self.look();
        }
        self.stoppers.clear();
        self.has_ended = true;
        self.life.error_of_end().map_or(Ok(()), Err)
    }

    /// One round: takes in events, acts on them, and answers clients.
    fn turn(&mut self) -> Result<(), LaunchError> {
        self.look();
        if let Some(error) = self.life.site.failure.take() {
            return Err(error);
        }
        if self.life.is_launching {
            return Ok(());
        }
        self.look_at_settings();
        while !self.is_setting()
            && let Some(ask) = self.waiting.pop_front()
        {
            self.answer(*ask);
        }
        if self.life.site.plan.clock() == Clock::Machine && self.slow_nodes.is_due() {
            let edges = self.edges();
            if let Some(line) = self.slow_nodes.look(&edges) {
                self.life.site.say(&line);
            }
        }
        if self.wake_policy.is_due() {
            self.give_wake_policy();
        }
        Ok(())
    }

    /// Listens for as long as nothing is due, and acts on events.
    fn look(&mut self) {
        self.listen(self.life.pause());
        self.life.now = self.started.elapsed();
        for (id, status, sample) in self.life.site.ended() {
            self.life.on_end(id, status, sample);
        }
        for (id, silence) in self.life.site.silent() {
            self.life.on_silence(id, silence);
        }
        self.life.step(self.started.elapsed());
    }

    /// Gives a policy to the processes for which the dataflow file names none.
    fn give_wake_policy(&mut self) {
        // A node that polls does not give way: the others must interrupt it.
        let polls = self.life.members.iter().any(|member| member.node.process.wait != WaitMode::Event);
        let open = self.life.members.iter().filter(|member| {
            let options = &member.node.process;
            options.scheduling.is_none() && options.nice.is_none() && options.cpus.is_empty()
        });
        let ready = open.flat_map(Member::instances).filter(|instance| instance.is_ready() && instance.is_running());
        let pids: BTreeSet<u32> = ready.filter_map(|instance| instance.pid).collect();
        self.wake_policy.look(&pids, !polls);
    }

    /// Takes in the output of processes and the requests of clients, for up to `limit` until the first.
    fn listen(&mut self, limit: Duration) {
        self.life.site.service.beat();
        let mut next = self.events.recv_timeout(limit);
        let start = Instant::now();
        loop {
            self.life.now = self.started.elapsed();
            match next {
                Ok(Event::Begun(id, outcome)) => self.on_begun(id, outcome),
                Ok(Event::Output(id, output)) => self.on_output(id, output),
                Ok(Event::Closed) => {}
                Ok(Event::Ask(ask)) => self.on_ask(ask),
                Ok(Event::ClientGone(client)) => {
                    self.release_attached(client);
                    self.life.on_client_gone(client);
                    self.life.site.swapping.remove(&client);
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
                self.stoppers.push(ask.reply);
                self.life.is_asked_to_stop = true;
            }
            Request::Attach { ports, is_flight_recorder } => {
                self.attach(&ports, is_flight_recorder, ask.client, &ask.reply);
            }
            Request::Keep => {
                let _ = ask.reply.try_send(self.ask_flight_recorders());
            }
            _ => self.waiting.push_back(ask),
        }
    }

    fn on_begun(&mut self, id: u64, outcome: Result<BegunProgram, LaunchError>) {
        match self.life.site.take(id, outcome) {
            Some(Ok(pid)) => self.life.on_begun(id, pid),
            Some(Err(error)) => self.life.on_not_begun(id, error),
            None => {}
        }
    }

    fn on_output(&mut self, id: u64, report: Report) {
        // The output of an instance on its way out is not needed.
        let Some(idx) = self.life.member_of(id) else { return };
        match report {
            Report::Link(status) => self.life.link.on_status(id, *status),
            Report::Set { id, from_seq, error } => self.on_set(id, from_seq, error),
            Report::Unfit { message } => {
                let node = self.life.members[idx].node.id.clone();
                self.life.site.fail(LaunchError::Failed { node, what: message, log: Vec::new() });
            }
            Report::Ended { ports } => self.life.link.on_ended_imports(ports),
            Report::Failed { message } => {
                let entry = LogEntry { level: Some(LogLevel::Error), ..LogEntry::plain(&message) };
                self.life.site.logs[idx].write(entry);
                self.life.on_report(id, Report::Failed { message });
            }
            Report::Ready { .. } => {
                self.life.on_report(id, report);
                // A process of a restart or a swap has files of its own.
                if self.life.has_gone
                    && let Err(error) = namespace::take_room(self.life.site.plan.domain())
                {
                    self.life.site.say(&format!("blindgrasp: shared memory is nearly full: {error}"));
                }
            }
            report => self.life.on_report(id, report),
        }
    }

    /// Warns of nodes that were made for different hands or dictionaries: the arbiter will hold.
    fn warn_of_mismatches(&mut self) {
        let mut seen: Vec<(String, String, String)> = Vec::new();
        let mut lines = Vec::new();
        for member in &self.life.members {
            let identity = member.active.iter().filter_map(|active| active.identity.as_ref()).flatten();
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
            self.life.site.say(&line);
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
            Request::Swap(request) => {
                self.life.site.swapping.insert(ask.client, ask.reply);
                self.life.begin_swap(request, ask.description, ask.client);
            }
            Request::Promote | Request::Abandon => {
                self.life.site.swapping.insert(ask.client, ask.reply);
                self.life.on_promote(ask.request == Request::Promote, ask.client);
            }
        }
    }

    pub fn status(&self) -> GraphStatus {
        let life = &self.life;
        GraphStatus {
            graph: life.name.clone(),
            file: life.file.clone(),
            pid: std::process::id(),
            state: life.state,
            message: if life.members.iter().any(Member::is_given_up) { life.degraded.clone() } else { None },
            uptime_secs: self.started.elapsed().as_secs_f64(),
            log_folder: self.log_folder.path().into(),
            iceoryx2: Iceoryx2Config { root_path: life.site.plan.domain().ports(), prefix: FILE_PREFIX.into() },
            nodes: life.members.iter().map(|member| self.node_status(member)).collect(),
            edges: self.edges(),
            decisions: self.decisions.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            link: life.link.status().cloned(),
        }
    }

    fn node_status(&self, member: &Member) -> NodeStatus {
        let age = member.active.as_ref().and_then(|active| self.life.site.heartbeat_age(active.id));
        NodeStatus {
            node: member.node.id.clone(),
            program: member.node.program.clone(),
            args: member.node.args.clone(),
            state: member.state,
            pid: member.active.as_ref().and_then(|active| active.pid),
            standby_pid: member.standby.as_ref().and_then(|standby| standby.pid),
            n_restarts: member.n_restarts,
            n_swaps: member.n_swaps,
            heartbeat_age_millis: age.map(|age| age.as_millis() as u64),
            params: member.node.params.clone(),
            counts: member.counts.clone(),
        }
    }
}
