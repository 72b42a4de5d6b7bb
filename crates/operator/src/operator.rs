//! What all operator processes have in common: `--describe`, joining the graph, commands, signs of life, reports.
//!
//! The `main` of an operator calls [`run`] with its description and a function that opens its ports, reports that it is
//! ready, and works until it is asked to stop. For an operator that answers samples, [`stage::run`](crate::stage::run) is
//! the body of that function; for one that has samples of its own, [`source::run`](crate::source::run).

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, VecDeque};
use std::io::Write;
use std::marker::PhantomData;
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use iceoryx2::prelude::Node;
use rustix::process::{Pid, Signal, getpgrp, getppid, kill_process_group};
use serde_json::{Map, Value};

use crate::cursors::{STATE_BYTES, SampleId, SharedCursors};
use crate::description::{LINK_OPERATOR, OperatorDescription};
use crate::descriptors::DescriptorWatch;
use crate::diagnostics::{print_diagnostic, with_lack_of_files};
use crate::link_status::LinkStatus;
use crate::partner::{Partner, PartnerInput};
use crate::port::{PortError, Publisher, ShadowPublisher, Subscriber};
use crate::private_service::PrivateService;
use crate::runner::InputPort;
use crate::sandbox::Sandbox;
use crate::waiter::{PollFd, Waiter, Waker};
use crate::wiring::{
    Addressed, Clock, Command, EdgePolicy, Enforcement, GroupMemberWiring, GroupWiring, LogEntry, Report,
    WIRING_VARIABLE, Wiring,
};
use crate::{host, identity, monotonic_nanos, namespace, reports, sandbox, trace, wiring};
use blindgrasp_messages::Message;

/// The longest time that an operator waits before it gives a sign of life.
pub const TICK: Duration = Duration::from_millis(100);
/// An operator whose launcher has died gets this long to end of its own accord.
const ORPHAN_LIMIT: Duration = Duration::from_secs(3);

/// An operator's place in a running graph.
#[derive(Clone)]
pub struct Operator(Rc<Member>);

/// An operator of a process, which may have several.
struct Member {
    wiring: Wiring,
    node: Node<PrivateService>,
    cursors: Arc<SharedCursors>,
    inbox: Arc<Inbox>,
    stop: Arc<AtomicBool>,
    waiter: Rc<Waiter>,
    /// The identity of the program, and of the program with its present parameters.
    identity: (u64, Cell<u64>),
    /// The restriction of the process so far, and the rights that it gives up when it is ready.
    sandbox: (Enforcement, Option<Arc<Sandbox>>),
    /// Of an operator that uses the network.
    descriptors: Option<RefCell<DescriptorWatch>>,
    voice: Voice,
    /// The partner inputs, and the counts of its own that it has reported.
    partners: RefCell<Vec<Rc<RefCell<PartnerInput>>>>,
    counts: RefCell<BTreeMap<String, u64>>,
    /// Of each output, whether all samples that are not answered can be received.
    has_sent_all: RefCell<Vec<Arc<AtomicBool>>>,
    /// The other operators of the process, and the stages that wait for all of them to be open; `None` if it is alone.
    group: Option<Rc<Group>>,
}

/// The operators of a process that run in turn.
pub(crate) struct Group {
    inboxes: Vec<Arc<Inbox>>,
    /// The slots of their inputs.
    input_slots: Vec<usize>,
    instance_slots: Vec<usize>,
    pub(crate) tasks: RefCell<Vec<Box<dyn Task>>>,
}

/// The voice of an operator towards the launcher. An operator of a group gives its name.
#[derive(Clone)]
struct Voice(Option<Arc<str>>);

thread_local! {
    /// The operator of a group whose turn it is on this thread: its log lines bear its name.
    static SPEAKER: RefCell<Option<Arc<str>>> = const { RefCell::new(None) };
}

/// A stage that runs in turn with others.
pub trait Task {
    fn operator(&self) -> &Operator;

    /// Reports that it is ready.
    fn begin(&mut self);

    /// Answers the samples that have come.
    ///
    /// # Errors
    /// An error of the stage or of a port.
    fn step(&mut self) -> anyhow::Result<Turn>;
}

/// The outcome of a task's turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// It has answered all that it could, and must have a turn at that time at the latest.
    Idle(Option<Instant>),
    /// It was interrupted, and has more to answer.
    Interrupted,
    /// It has ended.
    Ended,
}

/// The commands of the launcher that are not carried out yet.
#[derive(Default)]
struct Inbox {
    commands: Mutex<VecDeque<Command>>,
    is_full: AtomicBool,
    is_to_hand_over: AtomicBool,
    /// The operator has read its files.
    is_ready: AtomicBool,
    /// An operator of a group is to drain: a signal would reach all of them.
    is_to_drain: AtomicBool,
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
    run_described(description, work)
}

/// As [`run`], in a process that was started as part of a graph.
pub(crate) fn run_described(
    description: &OperatorDescription,
    work: impl FnOnce(&Operator) -> anyhow::Result<()>,
) -> ExitCode {
    reports::take();
    match join_and_work(description, work) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&error),
    }
}

/// Reports to the launcher why this process cannot go on.
pub(crate) fn failed(error: &anyhow::Error) -> ExitCode {
    Voice(None).report(&Report::Failed { message: format!("{error:#}") });
    ExitCode::FAILURE
}

impl Operator {
    /// The node's parameters.
    ///
    /// # Errors
    /// The parameters are not what `T` expects: `--describe` and `T` disagree.
    pub fn params<T: serde::de::DeserializeOwned>(&self) -> Result<T, OperatorError> {
        parse_params(&self.0.wiring.params)
    }

    /// The graph's name.
    pub fn graph(&self) -> &str {
        &self.0.wiring.graph
    }

    /// A folder of the graph in which no process with a sandbox can make a file. It is removed when the graph has ended.
    pub fn link_folder(&self) -> std::path::PathBuf {
        self.0.wiring.domain.link()
    }

    /// The clock of its stages.
    pub fn clock(&self) -> Clock {
        self.0.wiring.clock
    }

    /// Whether it begins as a standby, which answers nothing until [`Command::TakeOver`].
    pub fn begins_as_standby(&self) -> bool {
        self.0.wiring.standby
    }

    /// Opens an output port.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn publisher<M: Message>(&self, port: &str, max_items: usize) -> Result<Publisher<M>, OperatorError> {
        self.publisher_for(port, Some(max_items))
    }

    /// As [`Operator::publisher`]; without `max_items` for messages whose largest number of items is unknown.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn publisher_for<M: Message>(
        &self,
        port: &str,
        max_items: Option<usize>,
    ) -> Result<Publisher<M>, OperatorError> {
        let wiring = wired(&self.0.wiring.outputs, port)?;
        let mut publisher = Publisher::open(&self.0.node, &self.0.cursors, wiring, max_items)?;
        if let Some(group) = &self.0.group {
            publisher.shares_process_with(group.input_slots.clone());
        }
        self.0.has_sent_all.borrow_mut().push(publisher.has_sent_all());
        Ok(publisher)
    }

    /// Whether an input is connected.
    pub(crate) fn has_input(&self, port: &str) -> bool {
        self.0.wiring.inputs.contains_key(port)
    }

    /// The node's parameters as they are.
    pub(crate) fn all_params(&self) -> &Map<String, Value> {
        &self.0.wiring.params
    }

    /// A handle by which another thread ends a wait of this operator.
    pub fn waker(&self) -> Waker {
        self.0.waiter.waker()
    }

    /// Opens an input port.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn subscriber<M: Message>(&self, port: &str) -> Result<Subscriber<M>, OperatorError> {
        Ok(Subscriber::open(&self.0.node, Some(&self.0.cursors), wired(&self.0.wiring.inputs, port)?)?)
    }

    /// As [`Operator::subscriber`], for an optional input: `None` if nothing is connected to it.
    ///
    /// # Errors
    /// iceoryx2 refuses it.
    pub fn optional_subscriber<M: Message>(&self, port: &str) -> Result<Option<Subscriber<M>>, OperatorError> {
        self.0.wiring.inputs.contains_key(port).then(|| self.subscriber(port)).transpose()
    }

    /// The connected inputs, and whether their writers wait for them.
    pub fn inputs(&self) -> impl Iterator<Item = (&str, bool)> {
        let inputs = self.0.wiring.inputs.iter();
        inputs.map(|(port, input)| (port.as_str(), input.policy == EdgePolicy::Lossless))
    }

    /// Opens a partner input of a stage, before [`stage::run`](crate::stage::run): while the stage answers a sample,
    /// [`Partner::sample`] is the one of nearly the same time.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn partner<M: Message>(&self, port: &str) -> Result<Partner<M>, OperatorError> {
        let input = InputPort::open::<M>(self, port, self.begins_as_standby())?;
        Ok(Partner { input: self.add_partner(port, input)?, message: PhantomData })
    }

    pub(crate) fn add_partner(&self, port: &str, input: InputPort) -> Result<Rc<RefCell<PartnerInput>>, OperatorError> {
        let wiring = wired(&self.0.wiring.inputs, port)?;
        let input = Rc::new(RefCell::new(PartnerInput::new(port, wiring, self.clock(), input)));
        self.0.partners.borrow_mut().push(Rc::clone(&input));
        Ok(input)
    }

    pub(crate) fn partners(&self) -> Vec<Rc<RefCell<PartnerInput>>> {
        self.0.partners.borrow().clone()
    }

    /// Opens a second reader of an input, for a standby beside the active instance.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub fn onlooker<M: Message>(&self, port: &str) -> Result<Subscriber<M>, OperatorError> {
        Ok(Subscriber::open(&self.0.node, None, wired(&self.0.wiring.inputs, port)?)?)
    }

    /// Opens the output to which a standby sends the samples that it would have sent as the active instance.
    ///
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub(crate) fn shadow<M: Message>(
        &self,
        port: &str,
        max_items: Option<usize>,
    ) -> Result<ShadowPublisher, OperatorError> {
        let wiring = wired(&self.0.wiring.outputs, port)?;
        Ok(ShadowPublisher::open::<M>(&self.0.node, &self.0.cursors, wiring, max_items)?)
    }

    /// Takes the memory for [`Operator::save_state`].
    ///
    /// # Errors
    /// There is no room in shared memory.
    pub fn reserve_state(&self) -> Result<(), OperatorError> {
        self.0.cursors.reserve_state(self.0.wiring.state_region).map_err(OperatorError::NoRoomForState)
    }

    /// Saves the node's state for the instance that takes over. Only the active instance may.
    ///
    /// # Errors
    /// The state is too long.
    pub fn save_state(&self, state: &[u8]) -> Result<(), OperatorError> {
        if self.0.cursors.save_state(self.0.wiring.state_region, state) {
            return Ok(());
        }
        Err(OperatorError::LongState { n_bytes: state.len(), max_bytes: STATE_BYTES })
    }

    /// The state that the node's active instance saved last.
    pub fn saved_state(&self) -> Option<Vec<u8>> {
        self.0.cursors.state(self.0.wiring.state_region)
    }

    /// Whether each sample is answered by one of the same number.
    pub(crate) fn answers_each(&self) -> bool {
        self.0.wiring.answers_each
    }

    /// Drops the node's saved state, because its active instance has none: an instance with a state that comes later must not
    /// go on with an old one. Where answers have numbers of their own, the state is kept with them.
    pub(crate) fn forget_state(&self) {
        if self.answers_each() {
            self.0.cursors.forget_state(self.0.wiring.state_region);
        }
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
        self.0.inbox.is_ready.store(true, Ordering::Relaxed);
        self.report(&Report::Ready { identity, has_state, sandbox });
    }

    /// Whether the process has given up rights that its work does not need.
    pub fn has_sandbox(&self) -> bool {
        self.0.wiring.sandbox != wiring::Sandbox::Off
    }

    /// Gives up reading files that the operator does not name in its params.
    fn close_sandbox(&self) -> Enforcement {
        let (entered, sandbox) = &self.0.sandbox;
        let closed = sandbox.as_ref().map_or(Enforcement::None, |sandbox| sandbox::or_none(sandbox.close()));
        let closed = closed.min(*entered);
        if self.0.wiring.hosted.is_some() && closed != Enforcement::None {
            closed.min(host::enforcement())
        } else {
            closed
        }
    }

    /// Gives a sign of life, of the other operators of its group as well: while it works, they wait.
    pub fn beat(&self) {
        let own = [self.0.wiring.instance_slot];
        for slot in self.0.group.as_ref().map_or(&own[..], |group| &group.instance_slots) {
            self.0.cursors.instance(*slot).beat(monotonic_nanos());
        }
    }

    /// Looks, if the operator uses the network, whether strangers' connections hold the descriptors of this process. Call it
    /// often.
    ///
    /// # Errors
    /// Nearly none has been left for some time. The process must end, because only that frees them.
    pub fn look_at_descriptors(&self) -> anyhow::Result<()> {
        match &self.0.descriptors {
            Some(watch) => watch.borrow_mut().look(Instant::now()),
            None => Ok(()),
        }
    }

    /// Names the sample that a stage works on, for the launcher if the process dies of it.
    pub(crate) fn works_on(&self, sample: Option<SampleId>) {
        self.0.cursors.instance(self.0.wiring.instance_slot).works_on(sample);
    }

    /// Whether the last instance died while it worked on a sample.
    pub(crate) fn has_suspect(&self) -> bool {
        self.0.wiring.suspect.is_some()
    }

    /// Whether a sample has killed earlier instances again and again.
    pub(crate) fn skips(&self, sample: SampleId) -> bool {
        self.0.wiring.skip.contains(&sample)
    }

    /// The launcher's next command, if there is one.
    pub fn next_command(&self) -> Option<Command> {
        if !self.has_command() {
            return None;
        }
        let mut commands = self.0.inbox.commands.lock().unwrap_or_else(PoisonError::into_inner);
        let command = commands.pop_front();
        self.0.inbox.is_full.store(!commands.is_empty(), Ordering::Relaxed);
        if command == Some(Command::HandOver) {
            self.0.inbox.is_to_hand_over.store(false, Ordering::Relaxed);
        }
        command
    }

    /// Whether [`Operator::next_command`] has something. Cheap.
    pub fn has_command(&self) -> bool {
        self.0.inbox.is_full.load(Ordering::Relaxed)
    }

    /// Whether a publisher that waits for its readers should give up, because another instance is to take over or the
    /// graph ends. Gives a sign of life as well. In a group, the command of another operator is a reason too: that one may be
    /// the reader.
    pub fn should_yield(&self) -> bool {
        self.beat();
        if self.0.inbox.is_to_hand_over.load(Ordering::Acquire) || self.should_quit() {
            return true;
        }
        let mut inboxes = self.0.group.iter().flat_map(|group| &group.inboxes);
        inboxes.any(|inbox| inbox.is_full.load(Ordering::Acquire))
    }

    fn node(&self) -> &str {
        &self.0.wiring.node
    }

    pub(crate) fn group(&self) -> Option<&Rc<Group>> {
        self.0.group.as_ref()
    }

    fn report(&self, report: &Report) {
        self.0.voice.report(report);
    }

    /// Whether the launcher has asked for an end: receive the samples that are there, then call [`Operator::drained`].
    pub fn should_stop(&self) -> bool {
        self.0.stop.load(Ordering::Relaxed) || self.0.inbox.is_to_drain.load(Ordering::Relaxed) || self.should_quit()
    }

    /// Whether to exit now, because the launcher needs nothing more or is gone.
    pub fn should_quit(&self) -> bool {
        self.0.inbox.quit.load(Ordering::Relaxed)
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
            [] => self.0.waiter.wait(limit),
            _ => self.0.waiter.wait_for(fds, !self.0.wiring.inputs.is_empty(), limit),
        }
        self.beat();
    }

    /// Waits for the launcher or a signal, at most `limit`.
    pub fn sleep(&self, limit: Duration) {
        self.wait(Some(Instant::now() + limit));
    }

    /// Reports that it answers no more.
    pub fn handed_over(&self) {
        let has_sent_all = self.0.has_sent_all.borrow().iter().all(|has_sent_all| has_sent_all.load(Ordering::Relaxed));
        self.report(&Report::HandedOver { has_sent_all });
    }

    /// Reports that it is the active instance.
    pub fn took_over(&self) {
        self.report(&Report::TookOver);
    }

    /// Reports how many live samples it has computed as a standby.
    pub fn warm(&self, n_samples: u64) {
        self.report(&Report::Warm { n_samples });
    }

    /// The identity of the samples that this operator makes of samples that were `made_by` others:
    /// [`Header::made_by`](blindgrasp_messages::Header::made_by).
    pub fn made_by(&self, made_by: u64) -> u64 {
        identity::after(made_by, self.0.identity.1.get())
    }

    /// Takes the new values of its parameters into its identity.
    pub(crate) fn has_params(&self, params: &Map<String, Value>) {
        self.0.identity.1.set(identity::with_params(self.0.identity.0, params));
    }

    /// Reports from which sample on the new values of its parameters apply, or why they don't.
    pub fn has_set(&self, id: u64, outcome: anyhow::Result<()>, from_seq: Option<u64>) {
        self.report(&Report::Set { id, from_seq, error: outcome.err().map(|error| format!("{error:#}")) });
    }

    /// Reports counts of its own since it started, besides those of its samples; `ps`, `top` and the metrics show them.
    /// Call it when a count has changed, at most some times a second, and before the operator ends.
    pub fn has_counted(&self, counts: BTreeMap<String, u64>) {
        let mut all = self.0.counts.borrow_mut();
        all.extend(counts);
        self.report(&Report::Counts { counts: all.clone(), in_all: false });
    }

    /// As [`Operator::has_counted`], for counts that are a part of the stage's state: an instance that takes over goes on with
    /// them, and reports those of its predecessors as well.
    pub fn has_counted_in_all(&self, counts: BTreeMap<String, u64>) {
        self.report(&Report::Counts { counts, in_all: true });
    }

    /// Reports, as a link, that all other machines are there and ready.
    pub fn connected(&self) {
        self.report(&Report::Connected);
    }

    /// Reports, as a link, all ports of other machines that have ended, as `NODE/PORT`.
    pub fn ended(&self, ports: Vec<String>) {
        self.report(&Report::Ended { ports });
    }

    /// Reports, as a link, its status.
    pub fn has_link_status(&self, status: LinkStatus) {
        self.report(&Report::Link(Box::new(status)));
    }

    /// Reports a line for the log.
    pub(crate) fn log(&self, line: LogEntry) {
        self.report(&Report::Log(line));
    }

    /// Reports that the graph must end.
    pub(crate) fn is_unfit(&self, message: String) {
        self.report(&Report::Unfit { message });
    }

    /// Reports that a source has sent everything.
    pub fn finished(&self) {
        self.report(&Report::Finished);
    }

    /// Reports that all inputs are drained, and keeps the ports open until the launcher needs nothing more: a publisher
    /// that ends too early could take unread samples with it. A reader that is restarted meanwhile needs its history: `look`
    /// must look for readers at each output.
    ///
    /// # Errors
    /// The first error of `look`.
    pub fn drained<E>(&self, mut look: impl FnMut() -> Result<(), E>) -> Result<(), E> {
        self.report_drained();
        while !self.should_quit() {
            look()?;
            self.sleep(TICK);
        }
        Ok(())
    }

    /// Reports that all inputs are drained.
    pub(crate) fn report_drained(&self) {
        self.report(&Report::Drained);
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
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wiring: Wiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    let domain = wiring.domain.clone();
    let operators = join(std::slice::from_ref(description), vec![wiring]).map_err(with_lack_of_files)?;
    listen(&operators);
    let outcome = work(&operators[0]).map_err(with_lack_of_files);
    drop(operators);
    namespace::clear_orphaned(&domain);
    outcome
}

/// An operator of a group: its description and its work.
pub type GroupMember = (OperatorDescription, fn(&Operator) -> anyhow::Result<()>);

/// The `main` of a process with several operators, which answer samples in turn. `member` finds an operator by the arguments
/// of its program.
pub fn run_group(member: impl Fn(&[String]) -> Option<GroupMember>) -> ExitCode {
    reports::take();
    match join_and_work_together(member) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&error),
    }
}

fn join_and_work_together(member: impl Fn(&[String]) -> Option<GroupMember>) -> anyhow::Result<()> {
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wirings: GroupWiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    let (mut descriptions, mut works, mut inner) = (Vec::new(), Vec::new(), Vec::new());
    for GroupMemberWiring { args, wiring } in wirings.members {
        let (description, work) = member(&args).with_context(|| format!("unknown operator {}", args.join(" ")))?;
        descriptions.push(description);
        works.push(work);
        inner.push(wiring);
    }
    let operators = join(&descriptions, inner).map_err(with_lack_of_files)?;
    listen(&operators);
    let domain = operators[0].0.wiring.domain.clone();
    let outcome = open(&operators, &works).and_then(run_in_turn).map_err(with_lack_of_files);
    drop(operators);
    namespace::clear_orphaned(&domain);
    outcome
}

/// The stages of the operators of a group, with open ports.
///
/// # Errors
/// An operator cannot begin.
pub fn open(
    operators: &[Operator],
    works: &[fn(&Operator) -> anyhow::Result<()>],
) -> anyhow::Result<Vec<Box<dyn Task>>> {
    for (operator, work) in operators.iter().zip(works) {
        operator.0.voice.takes_turn();
        work(operator).with_context(|| format!("node '{}'", operator.node()))?;
    }
    let group = operators.first().and_then(Operator::group);
    Ok(group.map(|group| group.tasks.take()).unwrap_or_default())
}

/// Lets tasks, upstream ones first, answer samples in turn until all have ended.
pub(crate) fn run_in_turn(mut tasks: Vec<Box<dyn Task>>) -> anyhow::Result<()> {
    tasks.iter_mut().for_each(|task| task.begin());
    let is_group = tasks.len() > 1;
    // After an interruption, those before the interrupted one wait: they would fill its queue.
    let mut first = 0;
    loop {
        let (mut until, mut interrupted, mut n_ended) = (None::<Instant>, None, 0);
        for (idx, task) in tasks.iter_mut().enumerate().skip(first) {
            task.operator().0.voice.takes_turn();
            match task.step() {
                Ok(Turn::Idle(at)) => until = at.into_iter().chain(until).min(),
                Ok(Turn::Interrupted) => {
                    interrupted.get_or_insert(idx);
                }
                Ok(Turn::Ended) => n_ended += 1,
                Err(error) if is_group => return Err(error.context(format!("node '{}'", task.operator().node()))),
                Err(error) => return Err(error),
            }
        }
        if n_ended == tasks.len() {
            return Ok(());
        }
        if interrupted.is_none() && first == 0 {
            tasks[0].operator().wait(until);
        }
        first = interrupted.unwrap_or(0);
    }
}

/// Joins the graph with the operators of this process, which share a bell. Nothing listens to the launcher yet.
///
/// # Errors
/// The graph's shared memory cannot be used.
pub fn join(descriptions: &[OperatorDescription], wirings: Vec<Wiring>) -> anyhow::Result<Vec<Operator>> {
    let leader = wirings.first().context("a process without operators")?.clone();
    let is_group = wirings.len() > 1;
    let has_link = descriptions.iter().any(|description| description.operator == LINK_OPERATOR);
    trace::install(has_link, |entry| Voice(SPEAKER.with_borrow(Option::clone)).report(&Report::Log(entry)));
    if leader.lock_memory {
        lock_memory()?;
    }
    // Before the first thread: those that it starts are restricted as well.
    let sandbox = (leader.sandbox != wiring::Sandbox::Off).then(|| {
        let operators = descriptions.iter().zip(wirings.iter().map(|wiring| &wiring.params));
        Arc::new(Sandbox::new(operators, &leader.domain))
    });
    let entered = sandbox.as_ref().map_or(Enforcement::None, |sandbox| sandbox::or_none(sandbox.enter()));
    let cursors = Arc::new(SharedCursors::open(&leader.domain.cursors())?);
    let waiter = Rc::new(Waiter::of_slot(&cursors, leader.bell_slot, leader.wait).context("cannot make an event")?);
    let inboxes: Vec<Arc<Inbox>> = wirings.iter().map(|_| Arc::default()).collect();
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        // The flag comes first: a thread that is woken sees it.
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
        let waker = waiter.waker();
        // SAFETY: the handler accesses atomics and makes system calls, which a handler may do.
        unsafe { signal_hook::low_level::register(signal, move || waker.wake()) }
            .context("cannot listen for signals")?;
    }
    let input_slots = wirings.iter().flat_map(|wiring| wiring.inputs.values()).filter_map(|input| input.slot).collect();
    let instance_slots = wirings.iter().map(|wiring| wiring.instance_slot).collect();
    let group = Group { inboxes: inboxes.clone(), input_slots, instance_slots, tasks: RefCell::default() };
    let group = is_group.then(|| Rc::new(group));
    let mut operators = Vec::with_capacity(wirings.len());
    for ((wiring, description), inbox) in wirings.into_iter().zip(descriptions).zip(inboxes) {
        let program = identity::of_program(description, &wiring.params);
        let descriptors = if description.uses_network || description.operator == LINK_OPERATOR {
            Some(RefCell::new(DescriptorWatch::open().context("/proc/self/fd cannot be read")?))
        } else {
            None
        };
        operators.push(Operator(Rc::new(Member {
            node: namespace::join(&wiring.domain, &wiring.node)?,
            cursors: Arc::clone(&cursors),
            inbox,
            stop: Arc::clone(&stop),
            waiter: Rc::clone(&waiter),
            identity: (program, Cell::new(identity::with_params(program, &wiring.params))),
            sandbox: (entered, sandbox.clone()),
            descriptors,
            voice: Voice(is_group.then(|| Arc::from(wiring.node.as_str()))),
            partners: RefCell::default(),
            counts: RefCell::default(),
            has_sent_all: RefCell::default(),
            group: group.clone(),
            wiring,
        })));
    }
    Ok(operators)
}

/// Listens to the launcher, on a thread, until it closes stdin. It may be called once.
fn listen(operators: &[Operator]) {
    let inboxes: Vec<_> =
        operators.iter().map(|operator| (operator.node().to_owned(), Arc::clone(&operator.0.inbox))).collect();
    let (launcher, first) = (getppid(), &operators[0].0);
    let (waker, sandbox) = (first.waiter.waker(), first.sandbox.1.clone());
    std::thread::spawn(move || read_commands(&inboxes, &waker, launcher, sandbox.as_deref()));
}

fn read_commands(
    inboxes: &[(String, Arc<Inbox>)],
    waker: &Waker,
    launcher: Option<Pid>,
    mut sandbox: Option<&Sandbox>,
) {
    for line in std::io::stdin().lines().map_while(Result::ok) {
        // This thread began before the files were read, and reads none itself.
        if let Some(unclosed) = sandbox
            && inboxes.iter().all(|(_, inbox)| inbox.is_ready.load(Ordering::Relaxed))
        {
            sandbox::or_none(unclosed.close());
            sandbox = None;
        }
        match serde_json::from_str::<Addressed<Command>>(&line) {
            Ok(Addressed { member, message }) => {
                match inboxes.iter().find(|(name, _)| member.as_ref().is_none_or(|node| node == name)) {
                    Some((_, inbox)) => inbox.push(message),
                    None => tracing::warn!(line, "a command for an operator that is not here"),
                }
            }
            Err(error) => tracing::warn!(line, "not a command of this version: {error}"),
        }
        waker.wake();
    }
    inboxes.iter().for_each(|(_, inbox)| inbox.quit.store(true, Ordering::Relaxed));
    waker.wake();
    end_with_launcher(launcher);
}

impl Inbox {
    fn push(&self, command: Command) {
        match command {
            Command::Drain => return self.is_to_drain.store(true, Ordering::Relaxed),
            Command::Quit => return self.quit.store(true, Ordering::Relaxed),
            _ => {}
        }
        let mut commands = self.commands.lock().unwrap_or_else(PoisonError::into_inner);
        let is_to_hand_over = command == Command::HandOver;
        commands.push_back(command);
        self.is_full.store(true, Ordering::Relaxed);
        // The flag comes last: a publisher that gives way finds the command.
        if is_to_hand_over {
            self.is_to_hand_over.store(true, Ordering::Release);
        }
    }
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

impl Voice {
    /// Names the log lines of this thread after the operator, in a group.
    fn takes_turn(&self) {
        if self.0.is_some() {
            SPEAKER.set(self.0.clone());
        }
    }

    fn report(&self, report: &Report) {
        let addressed = Addressed { member: self.0.as_deref().map(str::to_owned), message: report };
        if let Ok(json) = serde_json::to_string(&addressed) {
            reports::write(&json);
        }
    }
}
