//! What all operator processes have in common: `--describe`, joining the graph, commands, signs of life, reports.
//!
//! An operator's `main` calls [`run`] with its description and a function that opens its ports, says that it is ready
//! and works until it is asked to stop. For an operator that answers samples, [`stage::run`](crate::stage::run) is that
//! function's body.

use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::{Node, ipc};
use rustix::event::PollFd;
use serde_json::{Map, Value};

use crate::board::Board;
use crate::description::OperatorDescription;
use crate::diagnostics::print_diagnostic;
use crate::link_status::LinkStatus;
use crate::port::{Publisher, ShadowPublisher, Subscriber};
use crate::waiter::{Waiter, Waker};
use crate::wiring::{Clock, Command, REPORT_PREFIX, Report, WIRING_VARIABLE, Wiring};
use crate::{domain, monotonic_nanos, trace};
use blindgrasp_messages::Message;

/// The longest that an operator waits before it gives a sign of life.
pub const TICK: Duration = Duration::from_millis(100);
/// An operator's place in a running graph.
pub struct Operator {
    wiring: Wiring,
    node: Node<ipc::Service>,
    board: Arc<Board>,
    inbox: Arc<Inbox>,
    stop: Arc<AtomicBool>,
    waiter: Waiter,
    waker: Waker,
}

/// What the launcher has said and nobody has acted on.
#[derive(Default)]
struct Inbox {
    commands: Mutex<VecDeque<Command>>,
    is_full: AtomicBool,
    is_to_hand_over: AtomicBool,
    quit: AtomicBool,
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
            "{}: {}\n\nAn operator: blindgrasp starts it as part of a graph (blindgrasp run dataflow.yaml).\n\
             With --describe it prints its ports and parameters.",
            description.operator, description.summary
        ));
        return ExitCode::from(2);
    }
    match join_and_work(work) {
        Ok(()) => return ExitCode::SUCCESS,
        Err(error) => report(&Report::Failed { message: format!("{error:#}") }),
    }
    ExitCode::FAILURE
}

impl Operator {
    /// The node's parameters.
    ///
    /// # Errors
    /// Parameters that are not what `T` expects: `--describe` and `T` disagree.
    pub fn params<T: serde::de::DeserializeOwned>(&self) -> anyhow::Result<T> {
        parse_params(&self.wiring.params).with_context(|| format!("parameters of node '{}'", self.wiring.node))
    }

    /// Whose time its stages go by.
    pub fn clock(&self) -> Clock {
        self.wiring.clock
    }

    /// Whether it begins as a standby: it is to answer nothing until [`Command::TakeOver`].
    pub fn begins_as_standby(&self) -> bool {
        self.wiring.standby
    }

    /// Opens an output port.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn publisher<M: Message>(&self, port: &str, max_items: usize) -> anyhow::Result<Publisher<M>> {
        Ok(Publisher::open(&self.node, &self.board, wired(&self.wiring.outputs, port)?, max_items)?)
    }

    /// As [`Operator::publisher`], for messages of which nobody knows how many items they may have.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn growing_publisher<M: Message>(&self, port: &str) -> anyhow::Result<Publisher<M>> {
        Ok(Publisher::open_growing(&self.node, &self.board, wired(&self.wiring.outputs, port)?)?)
    }

    /// What ends a wait of this operator from another thread.
    ///
    /// # Errors
    /// The system has no more descriptors.
    pub fn waker(&self) -> anyhow::Result<Waker> {
        self.waker.try_clone().context("cannot duplicate a socket")
    }

    /// Opens an input port.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn subscriber<M: Message>(&self, port: &str) -> anyhow::Result<Subscriber<M>> {
        Ok(Subscriber::open(&self.node, Some(&self.board), wired(&self.wiring.inputs, port)?)?)
    }

    /// As [`Operator::subscriber`], for an optional input: `None` if nothing is connected to it.
    ///
    /// # Errors
    /// iceoryx2's reason.
    pub fn optional_subscriber<M: Message>(&self, port: &str) -> anyhow::Result<Option<Subscriber<M>>> {
        self.wiring.inputs.contains_key(port).then(|| self.subscriber(port)).transpose()
    }

    /// Opens a second reader of an input, that looks on while the active instance works.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn onlooker<M: Message>(&self, port: &str) -> anyhow::Result<Subscriber<M>> {
        Ok(Subscriber::open(&self.node, None, wired(&self.wiring.inputs, port)?)?)
    }

    /// Opens the place where a standby says what it would have said.
    ///
    /// # Errors
    /// A port that the wiring doesn't have, or iceoryx2's reason.
    pub fn shadow<M: Message>(&self, port: &str, max_items: usize) -> anyhow::Result<ShadowPublisher<M>> {
        Ok(ShadowPublisher::open(&self.node, wired(&self.wiring.outputs, port)?, max_items)?)
    }

    /// Takes the memory for [`Operator::save_state`].
    ///
    /// # Errors
    /// There is no room in shared memory.
    pub fn reserve_state(&self) -> anyhow::Result<()> {
        self.board.reserve_state(self.wiring.state_region).context("no room for the node's state in shared memory")
    }

    /// Saves the node's state for whoever takes over. Only the active instance may.
    ///
    /// # Errors
    /// It is too long.
    pub fn save_state(&self, state: &[u8]) -> anyhow::Result<()> {
        if self.board.save_state(self.wiring.state_region, state) {
            return Ok(());
        }
        anyhow::bail!(
            "its state takes {} bytes, more than the {} that are there",
            state.len(),
            crate::board::STATE_BYTES
        )
    }

    /// The state that the node's active instance saved last.
    pub fn saved_state(&self) -> Option<Vec<u8>> {
        self.board.state(self.wiring.state_region)
    }

    /// Says that its ports are open and that it could answer at once. `identity` is what it must have in common with
    /// its neighbours and with whoever takes its place, like the hand's identity under `hand`.
    pub fn ready(&self, identity: BTreeMap<String, String>) {
        self.beat();
        report(&Report::Ready { identity });
    }

    /// Gives a sign of life.
    pub fn beat(&self) {
        self.board.instance(self.wiring.instance_cell).beat(monotonic_nanos());
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

    /// Whether a publisher that waits for its readers should give up: somebody else is to take over, or all is over.
    /// Gives a sign of life as well.
    pub fn is_to_give_way(&self) -> bool {
        self.beat();
        self.inbox.is_to_hand_over.load(Ordering::Acquire) || self.should_quit()
    }

    /// Whether the launcher has asked for an end: take in what is there, then call [`Operator::drained`].
    pub fn should_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || self.should_quit()
    }

    /// Whether to exit now: the launcher has all it needs, or is gone.
    pub fn should_quit(&self) -> bool {
        self.inbox.quit.load(Ordering::Relaxed)
    }

    /// Waits until one of the listeners, the launcher or a signal has something to say, at most until `until` or the next
    /// sign of life, which it gives.
    pub fn wait(&self, listeners: &[&Listener<ipc::Service>], until: Option<Instant>) {
        let limit = until.map_or(TICK, |until| until.saturating_duration_since(Instant::now()));
        self.wait_for(listeners, &[], limit);
    }

    /// As [`Operator::wait`], also until a descriptor is ready, at most `limit`.
    pub fn wait_for(&self, listeners: &[&Listener<ipc::Service>], fds: &[PollFd<'_>], limit: Duration) {
        self.beat();
        self.waiter.wait_for(listeners, fds, limit.min(TICK));
        self.beat();
    }

    /// Waits for the launcher or a signal, at most `limit`.
    pub fn sleep(&self, limit: Duration) {
        self.wait(&[], Some(Instant::now() + limit));
    }

    /// Says that it answers no more.
    pub fn handed_over(&self) {
        report(&Report::HandedOver);
    }

    /// Says that it is the active one.
    pub fn took_over(&self) {
        report(&Report::TookOver);
    }

    /// Says how many live samples it has computed as a standby.
    pub fn warm(&self, n_samples: u64) {
        report(&Report::Warm { n_samples });
    }

    /// Says from which sample on the new values of its parameters apply, or why they don't.
    pub fn has_set(&self, id: u64, outcome: anyhow::Result<()>, from_seq: Option<u64>) {
        report(&Report::Set { id, from_seq, error: outcome.err().map(|error| format!("{error:#}")) });
    }

    /// Says what it has counted since it started, besides its samples; `ps`, `top` and the metrics show it. To be called
    /// when a count has changed, at most some times a second, and before it ends.
    pub fn has_counted(&self, counts: BTreeMap<String, u64>) {
        report(&Report::Counts { counts });
    }

    /// Of a link: says that all other machines are there and ready.
    pub fn connected(&self) {
        report(&Report::Connected);
    }

    /// Of a link: says which ports of other machines, as `NODE/PORT`, have ended: all of them.
    pub fn ended(&self, ports: Vec<String>) {
        report(&Report::Ended { ports });
    }

    /// Of a link: says how it is.
    pub fn has_link_status(&self, status: LinkStatus) {
        report(&Report::Link(Box::new(status)));
    }

    /// Says that a source has sent all it had.
    pub fn finished(&self) {
        report(&Report::Finished);
    }

    /// Says that all inputs are drained, and keeps the ports open until the launcher has all it needs: a publisher that
    /// goes too early could take unread samples with it.
    pub fn drained(&self) {
        report(&Report::Drained);
        while !self.should_quit() {
            self.sleep(TICK);
        }
    }
}

/// A node's parameters as an operator's own type.
///
/// # Errors
/// They are not what `T` expects.
pub fn parse_params<T: serde::de::DeserializeOwned>(params: &Map<String, Value>) -> anyhow::Result<T> {
    Ok(serde_json::from_value(params.clone().into())?)
}

fn join_and_work(work: impl FnOnce(&Operator) -> anyhow::Result<()>) -> anyhow::Result<()> {
    trace::install(|entry| report(&Report::Log(entry)));
    let stop = Arc::new(AtomicBool::new(false));
    let (waiter, waker) = Waiter::new().context("cannot make a pair of sockets")?;
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        // The flag first: whoever is woken sees it.
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
        signal_hook::low_level::pipe::register(signal, waker.stream()?).context("cannot listen for signals")?;
    }
    let inbox = Arc::new(Inbox::default());
    let own_waker = waker.try_clone().context("cannot make a pair of sockets")?;
    std::thread::spawn({
        let inbox = Arc::clone(&inbox);
        move || read_commands(&inbox, &waker)
    });
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wiring: Wiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    let domain = wiring.domain.clone();
    let board = Arc::new(Board::open(std::path::Path::new(&wiring.domain.board))?);
    let node = domain::join(&wiring.domain, &wiring.node)?;
    let operator = Operator { wiring, node, board, inbox, stop, waiter, waker: own_waker };
    let outcome = work(&operator);
    drop(operator);
    domain::clear_orphaned(&domain);
    outcome
}

fn read_commands(inbox: &Inbox, waker: &Waker) {
    for line in std::io::stdin().lines().map_while(Result::ok) {
        match serde_json::from_str::<Command>(&line) {
            Ok(command) => {
                let mut commands = inbox.commands.lock().unwrap_or_else(PoisonError::into_inner);
                let is_to_hand_over = command == Command::HandOver;
                commands.push_back(command);
                inbox.is_full.store(true, Ordering::Relaxed);
                // Last: a publisher that gives way for it finds the command.
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
}

fn wired<'a, W>(ports: &'a BTreeMap<String, W>, port: &str) -> anyhow::Result<&'a W> {
    ports.get(port).with_context(|| format!("the wiring has no port '{port}'"))
}

/// One write, so that lines of two threads don't mix. A launcher that is gone cannot be told anything.
fn report(report: &Report) {
    if let Ok(json) = serde_json::to_string(report) {
        let mut stdout = std::io::stdout().lock();
        let _ = stdout.write_all(format!("{REPORT_PREFIX}{json}\n").as_bytes()).and_then(|()| stdout.flush());
    }
}
