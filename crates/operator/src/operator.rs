//! What all operator processes have in common: `--describe`, joining the graph, commands, signs of life, reports.
//!
//! The `main` of an operator calls [`run`] with its description and a function that opens its ports, reports that it is
//! ready, and works until it is asked to stop. For an operator that answers samples, [`stage::run`](crate::stage::run) is
//! the body of that function; for one that has samples of its own, [`source::run`](crate::source::run).

use std::cell::Cell;
use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use iceoryx2::prelude::{Node, ipc};
use rustix::process::{Pid, Signal, getpgrp, getppid, kill_process_group};
use serde_json::{Map, Value};

use crate::cursors::{STATE_BYTES, SampleId, SharedCursors};
use crate::description::OperatorDescription;
use crate::diagnostics::print_diagnostic;
use crate::link_status::LinkStatus;
use crate::port::{PortError, Publisher, ShadowPublisher, Subscriber};
use crate::sandbox::Sandbox;
use crate::waiter::{PollFd, Waiter, Waker};
use crate::wiring::{Clock, Command, Enforcement, REPORT_PREFIX, Report, WIRING_VARIABLE, Wiring};
use crate::{identity, monotonic_nanos, namespace, sandbox, trace, wiring};
use blindgrasp_messages::Message;

/// The longest time that an operator waits before it gives a sign of life.
pub const TICK: Duration = Duration::from_millis(100);
/// An operator whose launcher has died gets this long to end of its own accord.
const ORPHAN_LIMIT: Duration = Duration::from_secs(3);

/// An operator's place in a running graph.
pub struct Operator {
    wiring: Wiring,
    node: Node<ipc::Service>,
    cursors: Arc<SharedCursors>,
    inbox: Arc<Inbox>,
    stop: Arc<AtomicBool>,
    waiter: Waiter,
    /// The identity of the program, and of the program with its present parameters.
    identity: (u64, Cell<u64>),
    /// How far it is restricted, and what it gives up when it is ready.
    sandbox: (Enforcement, Option<Arc<Sandbox>>),
}

/// The commands of the launcher that are not carried out yet.
#[derive(Default)]
struct Inbox {
    commands: Mutex<VecDeque<Command>>,
    is_full: AtomicBool,
    is_to_hand_over: AtomicBool,
    /// The process has read its files.
    is_ready: AtomicBool,
    quit: AtomicBool,
}

/// Why an operator cannot do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum OperatorError {
    #[error("the node's parameters are not what the operator expects; --describe and the operator disagree")]
    Params(#[source] serde_json::Error),
    #[error("the node has no port '{0}'; --describe and the operator disagree")]
    UnknownPort(String),
    #[error(transparent)]
    Port(#[from] PortError),
    #[error("there is no room for the node's state in shared memory")]
    NoRoomForState(#[source] std::io::Error),
    #[error("the node's state takes {n_bytes} bytes, expected at most {max_bytes}")]
    LongState { n_bytes: usize, max_bytes: usize },
}

/// The `main` of an operator: answers `--describe`, or joins the graph and calls `work`.
///
/// `work` gets an operator that has not opened its ports yet. Its error is reported to the launcher, which prints it.
pub fn run(description: &OperatorDescription, work: impl FnOnce(&Operator) -> anyhow::Result<()>) -> ExitCode {
    if std::env::args_os().any(|argument| argument == "--describe") {
        return match serde_json::to_string_pretty(description) {
            Ok(json) if std::io::stdout().lock().write_all(format!("{json}\n").as_bytes()).is_ok() => ExitCode::SUCCESS,
            Ok(_) => ExitCode::FAILURE,
            Err(error) => {
                print_diagnostic(&format!("{}: {error}", description.operator));
                ExitCode::FAILURE
            }
        };
    }
    if std::env::var_os(WIRING_VARIABLE).is_none() {
        print_diagnostic(&format!(
            "{}: {}\n\nThis is an operator: blindgrasp starts it as part of a graph (blindgrasp run dataflow.yaml).\n\
             With --describe it prints its ports and parameters.",
            description.operator, description.summary
        ));
        return ExitCode::from(2);
    }
    match join_and_work(description, work) {
        Ok(()) => return ExitCode::SUCCESS,
        Err(error) => report(&Report::Failed { message: format!("{error:#}") }),
    }
    ExitCode::FAILURE
}

impl Operator {
    /// The node's parameters.
    ///
    /// # Errors
    /// The parameters are not what `T` expects: `--describe` and `T` disagree.
    pub fn params<T: serde::de::DeserializeOwned>(&self) -> Result<T, OperatorError> {
        parse_params(&self.wiring.params)
    }

    /// The clock of its stages.
    pub fn clock(&self) -> Clock {
        self.wiring.clock
    }

    /// Whether it begins as a standby, which answers nothing until [`Command::TakeOver`].
    pub fn begins_as_standby(&self) -> bool {
        self.wiring.standby
    }

    /// Opens an output port.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn publisher<M: Message>(&self, port: &str, max_items: usize) -> Result<Publisher<M>, OperatorError> {
        Ok(Publisher::open(&self.node, &self.cursors, wired(&self.wiring.outputs, port)?, max_items)?)
    }

    /// As [`Operator::publisher`], for messages whose largest number of items is unknown.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn growing_publisher<M: Message>(&self, port: &str) -> Result<Publisher<M>, OperatorError> {
        Ok(Publisher::open_growing(&self.node, &self.cursors, wired(&self.wiring.outputs, port)?)?)
    }

    /// A handle by which another thread ends a wait of this operator.
    pub fn waker(&self) -> Waker {
        self.waiter.waker()
    }

    /// Opens an input port.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn subscriber<M: Message>(&self, port: &str) -> Result<Subscriber<M>, OperatorError> {
        Ok(Subscriber::open(&self.node, Some(&self.cursors), wired(&self.wiring.inputs, port)?)?)
    }

    /// As [`Operator::subscriber`], for an optional input: `None` if nothing is connected to it.
    ///
    /// # Errors
    /// iceoryx2 refuses it.
    pub fn optional_subscriber<M: Message>(&self, port: &str) -> Result<Option<Subscriber<M>>, OperatorError> {
        self.wiring.inputs.contains_key(port).then(|| self.subscriber(port)).transpose()
    }

    /// Opens a second reader of an input, for a standby beside the active instance.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn onlooker<M: Message>(&self, port: &str) -> Result<Subscriber<M>, OperatorError> {
        Ok(Subscriber::open(&self.node, None, wired(&self.wiring.inputs, port)?)?)
    }

    /// Opens the output to which a standby sends the samples that it would have sent as the active instance.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn shadow<M: Message>(&self, port: &str, max_items: usize) -> Result<ShadowPublisher<M>, OperatorError> {
        Ok(ShadowPublisher::open(&self.node, &self.cursors, wired(&self.wiring.outputs, port)?, max_items)?)
    }

    /// Takes the memory for [`Operator::save_state`].
    ///
    /// # Errors
    /// There is no room in shared memory.
    pub fn reserve_state(&self) -> Result<(), OperatorError> {
        self.cursors.reserve_state(self.wiring.state_region).map_err(OperatorError::NoRoomForState)
    }

    /// Saves the node's state for the instance that takes over. Only the active instance may.
    ///
    /// # Errors
    /// The state is too long.
    pub fn save_state(&self, state: &[u8]) -> Result<(), OperatorError> {
        if self.cursors.save_state(self.wiring.state_region, state) {
            return Ok(());
        }
        Err(OperatorError::LongState { n_bytes: state.len(), max_bytes: STATE_BYTES })
    }

    /// The state that the node's active instance saved last.
    pub fn saved_state(&self) -> Option<Vec<u8>> {
        self.cursors.state(self.wiring.state_region)
    }

    /// Reports that its ports are open and that it could answer at once. Its neighbours, and an instance that takes its
    /// place, must have the same `identity`, such as that of the hand under `hand`.
    pub fn ready(&self, identity: BTreeMap<String, String>) {
        self.ready_with(identity, false);
    }

    /// As [`Operator::ready`]; with `has_state`, its answers depend on earlier samples.
    pub(crate) fn ready_with(&self, identity: BTreeMap<String, String>, has_state: bool) {
        self.beat();
        let sandbox = self.close_sandbox();
        self.inbox.is_ready.store(true, Ordering::Relaxed);
        report(&Report::Ready { identity, has_state, sandbox });
    }

    /// Whether the process has given up rights that its work does not need.
    pub fn has_sandbox(&self) -> bool {
        self.wiring.sandbox != wiring::Sandbox::Off
    }

    /// Gives up reading files that the operator does not name in its params.
    fn close_sandbox(&self) -> Enforcement {
        let (entered, sandbox) = &self.sandbox;
        let closed = sandbox.as_ref().map_or(Enforcement::None, |sandbox| sandbox::or_none(sandbox.close()));
        closed.min(*entered)
    }

    /// Gives a sign of life.
    pub fn beat(&self) {
        self.cursors.instance(self.wiring.instance_cell).beat(monotonic_nanos());
    }

    /// Names the sample that a stage works on, for the launcher if the process dies of it.
    pub(crate) fn works_on(&self, sample: Option<SampleId>) {
        self.cursors.instance(self.wiring.instance_cell).works_on(sample);
    }

    /// Whether a sample has killed earlier instances again and again.
    pub(crate) fn skips(&self, sample: SampleId) -> bool {
        self.wiring.skip.contains(&sample)
    }

    /// The launcher's next command, if there is one.
    pub fn next_command(&self) -> Option<Command> {
        if !self.has_command() {
            return None;
        }
        let mut commands = self.inbox.commands.lock().unwrap_or_else(PoisonError::into_inner);
        let command = commands.pop_front();
        self.inbox.is_full.store(!commands.is_empty(), Ordering::Relaxed);
        if command == Some(Command::HandOver) {
            self.inbox.is_to_hand_over.store(false, Ordering::Relaxed);
        }
        command
    }

    /// Whether [`Operator::next_command`] has something. Cheap.
    pub fn has_command(&self) -> bool {
        self.inbox.is_full.load(Ordering::Relaxed)
    }

    /// Whether a publisher that waits for its readers should give up, because another instance is to take over or the
    /// graph ends. Gives a sign of life as well.
    pub fn is_to_give_way(&self) -> bool {
        self.beat();
        self.inbox.is_to_hand_over.load(Ordering::Acquire) || self.should_quit()
    }

    /// Whether the launcher has asked for an end: receive the samples that are there, then call [`Operator::drained`].
    pub fn should_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || self.should_quit()
    }

    /// Whether to exit now, because the launcher needs nothing more or is gone.
    pub fn should_quit(&self) -> bool {
        self.inbox.quit.load(Ordering::Relaxed)
    }

    /// Waits until a sample, the launcher or a signal wakes it, at most until `until` or the next sign of life. Gives a sign
    /// of life.
    pub fn wait(&self, until: Option<Instant>) {
        self.wait_for(&[], until.map_or(TICK, |until| until.saturating_duration_since(Instant::now())));
    }

    /// As [`Operator::wait`], also until a descriptor is ready, at most `limit`.
    pub fn wait_for(&self, fds: &[PollFd<'_>], limit: Duration) {
        self.beat();
        let limit = limit.min(TICK);
        match fds {
            [] => self.waiter.wait(limit),
            _ => self.waiter.wait_for(fds, !self.wiring.inputs.is_empty(), limit),
        }
        self.beat();
    }

    /// Waits for the launcher or a signal, at most `limit`.
    pub fn sleep(&self, limit: Duration) {
        self.wait(Some(Instant::now() + limit));
    }

    /// Reports that it answers no more.
    pub fn handed_over(&self) {
        report(&Report::HandedOver);
    }

    /// Reports that it is the active instance.
    pub fn took_over(&self) {
        report(&Report::TookOver);
    }

    /// Reports how many live samples it has computed as a standby.
    pub fn warm(&self, n_samples: u64) {
        report(&Report::Warm { n_samples });
    }

    /// The identity of the samples that this operator makes of samples that were `made_by` others:
    /// [`Header::made_by`](blindgrasp_messages::Header::made_by).
    pub fn made_by(&self, made_by: u64) -> u64 {
        identity::after(made_by, self.identity.1.get())
    }

    /// Takes the new values of its parameters into its identity.
    pub(crate) fn has_params(&self, params: &Map<String, Value>) {
        self.identity.1.set(identity::with_params(self.identity.0, params));
    }

    /// Reports from which sample on the new values of its parameters apply, or why they don't.
    pub fn has_set(&self, id: u64, outcome: anyhow::Result<()>, from_seq: Option<u64>) {
        report(&Report::Set { id, from_seq, error: outcome.err().map(|error| format!("{error:#}")) });
    }

    /// Reports counts of its own since it started, besides those of its samples; `ps`, `top` and the metrics show them.
    /// Call it when a count has changed, at most some times a second, and before the operator ends.
    pub fn has_counted(&self, counts: BTreeMap<String, u64>) {
        report(&Report::Counts { counts });
    }

    /// Reports, as a link, that all other machines are there and ready.
    pub fn connected(&self) {
        report(&Report::Connected);
    }

    /// Reports, as a link, all ports of other machines that have ended, as `NODE/PORT`.
    pub fn ended(&self, ports: Vec<String>) {
        report(&Report::Ended { ports });
    }

    /// Reports, as a link, its status.
    pub fn has_link_status(&self, status: LinkStatus) {
        report(&Report::Link(Box::new(status)));
    }

    /// Reports that a source has sent everything.
    pub fn finished(&self) {
        report(&Report::Finished);
    }

    /// Reports that all inputs are drained, and keeps the ports open until the launcher needs nothing more: a publisher
    /// that ends too early could take unread samples with it. A reader that is restarted meanwhile needs its history: `look`
    /// must look for readers at each output.
    ///
    /// # Errors
    /// The first error of `look`.
    pub fn drained<E>(&self, mut look: impl FnMut() -> Result<(), E>) -> Result<(), E> {
        report(&Report::Drained);
        while !self.should_quit() {
            look()?;
            self.sleep(TICK);
        }
        Ok(())
    }
}

/// Gives this process a name for `ps`, `pgrep` and `top`. Linux keeps the first 15 bytes.
pub fn name_process(name: &str) {
    let _ = std::fs::write("/proc/self/comm", name);
}

/// A node's parameters as a type of the operator.
///
/// # Errors
/// The parameters are not what `T` expects.
pub fn parse_params<T: serde::de::DeserializeOwned>(params: &Map<String, Value>) -> Result<T, OperatorError> {
    serde_json::from_value(params.clone().into()).map_err(OperatorError::Params)
}

fn join_and_work(
    description: &OperatorDescription,
    work: impl FnOnce(&Operator) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    trace::install(|entry| report(&Report::Log(entry)));
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wiring: Wiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    if wiring.lock_memory {
        lock_memory()?;
    }
    let cursors = Arc::new(SharedCursors::open(std::path::Path::new(&wiring.domain.cursors))?);
    let waiter = Waiter::of_cell(&cursors, wiring.instance_cell, wiring.wait).context("cannot make an event")?;
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        // The flag comes first: a thread that is woken sees it.
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
        let waker = waiter.waker();
        // SAFETY: the handler accesses atomics and makes system calls, which a handler may do.
        unsafe { signal_hook::low_level::register(signal, move || waker.wake()) }
            .context("cannot listen for signals")?;
    }
    let inbox = Arc::new(Inbox::default());
    // Before the first thread: those that it starts are restricted as well.
    let is_restricted = wiring.sandbox != wiring::Sandbox::Off;
    let sandbox = is_restricted.then(|| Arc::new(Sandbox::new(description, &wiring.params, &wiring.domain)));
    let entered = sandbox.as_ref().map_or(Enforcement::None, |sandbox| sandbox::or_none(sandbox.enter()));
    std::thread::spawn({
        let (inbox, sandbox) = (Arc::clone(&inbox), sandbox.clone());
        let (launcher, waker) = (getppid(), waiter.waker());
        move || read_commands(&inbox, &waker, launcher, sandbox.as_deref())
    });
    let domain = wiring.domain.clone();
    let node = namespace::join(&wiring.domain, &wiring.node)?;
    let program = identity::of_program(description, &wiring.params);
    let identity = (program, Cell::new(identity::with_params(program, &wiring.params)));
    let sandbox = (entered, sandbox);
    let operator = Operator { wiring, node, cursors, inbox, stop, waiter, identity, sandbox };
    let outcome = work(&operator);
    drop(operator);
    namespace::clear_orphaned(&domain);
    outcome
}

fn read_commands(inbox: &Inbox, waker: &Waker, launcher: Option<Pid>, mut sandbox: Option<&Sandbox>) {
    for line in std::io::stdin().lines().map_while(Result::ok) {
        // This thread began before the files were read, and reads none itself.
        if let Some(sandbox) = sandbox.take_if(|_| inbox.is_ready.load(Ordering::Relaxed)) {
            sandbox::or_none(sandbox.close());
        }
        match serde_json::from_str::<Command>(&line) {
            Ok(command) => {
                let mut commands = inbox.commands.lock().unwrap_or_else(PoisonError::into_inner);
                let is_to_hand_over = command == Command::HandOver;
                commands.push_back(command);
                inbox.is_full.store(true, Ordering::Relaxed);
                // The flag comes last: a publisher that gives way finds the command.
                if is_to_hand_over {
                    inbox.is_to_hand_over.store(true, Ordering::Release);
                }
            }
            Err(error) => tracing::warn!(line, "not a command of this version: {error}"),
        }
        waker.wake();
    }
    inbox.quit.store(true, Ordering::Relaxed);
    waker.wake();
    end_with_launcher(launcher);
}

/// After the launcher has died: ends this process and its children, whatever the operator hangs in. While the launcher lives,
/// it does so itself.
fn end_with_launcher(launcher: Option<Pid>) {
    while getppid() == launcher {
        std::thread::sleep(TICK);
    }
    std::thread::sleep(ORPHAN_LIMIT);
    let _ = kill_process_group(getpgrp(), Signal::KILL);
}

/// Keeps all memory of this process in RAM, as it is touched for the first time.
fn lock_memory() -> anyhow::Result<()> {
    use rustix::mm::{MlockAllFlags, mlockall};
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT).context(
        "its memory cannot be locked, as 'lock_memory' asks: it needs the right CAP_IPC_LOCK, or a limit RLIMIT_MEMLOCK \
         that is above its memory ('ulimit -l')",
    )
}

fn wired<'a, W>(ports: &'a BTreeMap<String, W>, port: &str) -> Result<&'a W, OperatorError> {
    ports.get(port).ok_or_else(|| OperatorError::UnknownPort(port.into()))
}

/// Writes a report in one go, so that lines of two threads don't mix. A launcher that is gone hears nothing.
fn report(report: &Report) {
    if let Ok(json) = serde_json::to_string(report) {
        let mut stdout = std::io::stdout().lock();
        let _ = stdout.write_all(format!("{REPORT_PREFIX}{json}\n").as_bytes()).and_then(|()| stdout.flush());
    }
}
