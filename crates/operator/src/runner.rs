//! The surroundings of an [`Engine`] in an operator: its ports over iceoryx2, and its turns among the operators of a process.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blindgrasp_messages::{Header, Message};

use crate::cursors::{STATE_BYTES, SampleId};
use crate::engine::{Engine, Manner, Received, Sample, Site, Worker, Yields};
use crate::monotonic_nanos;
use crate::operator::{Operator, OperatorError, TICK, Task, Turn, run_in_turn};
use crate::partner::Partners;
use crate::port::{PortError, Sent, ShadowPublisher, UntypedPublisher, UntypedSample, UntypedSubscriber};
use crate::saved::{Book, Input};
use crate::wiring::{Clock, Command, InputCounts};
use crate::written::Written;

/// A stage that gave way to another one of its group tries again after this time.
const ROOM_PAUSE: Duration = Duration::from_millis(1);
/// Readers are woken for each answer unless the last one took no longer than this.
const QUICK_NANOS: u64 = 20_000;

impl Sample for UntypedSample {
    fn header(&self) -> &Header {
        self.header()
    }

    fn copied(self) -> Self {
        self.copied()
    }
}

/// The ports of an operator.
pub(crate) struct Ports {
    pub(crate) operator: Operator,
    pub(crate) inputs: Vec<InputPort>,
    pub(crate) outputs: Vec<OutputPort>,
    partners: Partners,
    /// When writers, readers and the worker were last looked at.
    last_look: Instant,
}

pub(crate) struct InputPort {
    pub(crate) subscriber: UntypedSubscriber,
    /// The reader of a standby that has not been active.
    pub(crate) onlooker: Option<UntypedSubscriber>,
}

impl InputPort {
    /// # Errors
    /// The wiring lacks the port, or iceoryx2 refuses it.
    pub(crate) fn open<M: Message>(
        operator: &Operator,
        port: &str,
        has_onlooker: bool,
    ) -> Result<InputPort, OperatorError> {
        let onlooker = if has_onlooker { Some(operator.onlooker::<M>(port)?.into_untyped()) } else { None };
        Ok(InputPort { subscriber: operator.subscriber::<M>(port)?.into_untyped(), onlooker })
    }

    fn reader(&mut self) -> &mut UntypedSubscriber {
        self.onlooker.as_mut().unwrap_or(&mut self.subscriber)
    }
}

pub(crate) struct OutputPort {
    pub(crate) publisher: UntypedPublisher,
    /// The output of a standby that has not been active.
    pub(crate) shadow: Option<ShadowPublisher>,
}

impl OutputPort {
    /// Opens an output for samples of up to `max_items` items, if there is a limit.
    ///
    /// # Errors
    /// As [`InputPort::open`].
    pub(crate) fn open<M: Message>(
        operator: &Operator,
        port: &str,
        max_items: Option<usize>,
        is_compared: bool,
    ) -> Result<OutputPort, OperatorError> {
        let publisher = operator.publisher_for::<M>(port, max_items)?;
        let shadow = if is_compared { Some(operator.shadow::<M>(port, max_items)?) } else { None };
        Ok(OutputPort { publisher: publisher.into_untyped(), shadow })
    }
}

impl Ports {
    /// The ports of an operator, and the partner inputs that it has opened.
    pub(crate) fn new(operator: &Operator, inputs: Vec<InputPort>, outputs: Vec<OutputPort>) -> Ports {
        Ports {
            operator: operator.clone(),
            inputs,
            outputs,
            partners: Partners::of(operator),
            last_look: Instant::now(),
        }
    }

    /// Looks for writers that have come.
    pub(crate) fn connect(&mut self) -> Result<(), PortError> {
        for input in &mut self.inputs {
            input.subscriber.connect()?;
        }
        self.partners.connect()
    }

    /// Looks for readers that have come back.
    pub(crate) fn look_for_readers(&mut self) -> Result<(), PortError> {
        self.outputs.iter_mut().try_for_each(|output| output.publisher.look_for_readers())
    }
}

impl Site for Ports {
    type Sample = UntypedSample;
    const STATE_BYTES: usize = STATE_BYTES;

    fn receive(&mut self, input: usize) -> Result<Option<Received<UntypedSample>>, PortError> {
        let reader = self.inputs[input].reader();
        let Some(sample) = reader.receive()? else { return Ok(None) };
        Ok(Some(Received { sample, counts: reader.counts(), late: reader.lateness() }))
    }

    fn put_back(&mut self, input: usize, sample: UntypedSample) {
        self.inputs[input].reader().put_back(sample);
    }

    fn take_over(&mut self, input: usize, place: &Input, cursor: Option<SampleId>) {
        self.inputs[input].subscriber.take_over_at(place.last, place.counted, place.counts, cursor);
    }

    fn look_on_from(&mut self, input: usize, last: SampleId) {
        if let Some(onlooker) = &mut self.inputs[input].onlooker {
            onlooker.look_on_from(last);
        }
    }

    fn commit(&mut self, input: usize, key: SampleId, counts: &InputCounts) {
        self.inputs[input].subscriber.commit_late(key, counts);
    }

    fn is_caught_up(&self, input: usize) -> bool {
        self.inputs[input].subscriber.is_caught_up()
    }

    fn is_cut_off(&self, input: usize) -> bool {
        self.inputs[input].subscriber.is_cut_off()
    }

    fn place(&self, input: usize) -> (Option<SampleId>, InputCounts) {
        self.inputs[input].subscriber.place()
    }

    fn is_after(&self, input: usize, key: SampleId, other: Option<SampleId>) -> bool {
        self.inputs[input].subscriber.is_after(key, other)
    }

    fn is_hurried(&self, input: usize) -> bool {
        let subscriber = &self.inputs[input].subscriber;
        let Some(since) = subscriber.received_nanos() else { return false };
        subscriber.has_more() && monotonic_nanos().saturating_sub(since) < QUICK_NANOS
    }

    fn begin_active(&mut self) {
        self.inputs.iter_mut().for_each(|input| input.onlooker = None);
        self.outputs.iter_mut().for_each(|output| output.shadow = None);
        self.partners.take_over();
    }

    fn begin(&mut self, output: usize, is_handed_over: bool) -> Option<SampleId> {
        self.outputs[output].publisher.begin(is_handed_over)
    }

    fn written(&self, output: usize) -> Option<Written> {
        self.outputs[output].publisher.written()
    }

    fn has_readers(&self, output: usize) -> bool {
        self.outputs[output].publisher.has_readers()
    }

    fn answered_by_readers(&self, output: usize) -> Option<SampleId> {
        self.outputs[output].publisher.answered_by_readers()
    }

    fn wait_for_room(&mut self, output: usize, key: SampleId) -> Result<Sent, PortError> {
        let operator = &self.operator;
        self.outputs[output].publisher.wait_for_room(key, &mut || operator.should_yield())
    }

    fn wait_for_answers(&mut self, output: usize, key: SampleId, yields: Yields) -> Result<Sent, PortError> {
        let operator = &self.operator;
        self.outputs[output].publisher.wait_for_answers(key, &mut || {
            let should_yield = operator.should_yield();
            match yields {
                Yields::ToOthers => should_yield,
                Yields::OrToStop => should_yield || operator.should_stop(),
                Yields::AtTheEnd => operator.should_quit(),
            }
        })
    }

    fn send(&mut self, output: usize, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError> {
        self.outputs[output].publisher.send_bytes(key, head, items)
    }

    fn send_beside(&mut self, output: usize, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError> {
        match &self.outputs[output].shadow {
            Some(shadow) => shadow.send_bytes(key, head, items),
            None => Ok(()),
        }
    }

    fn delay_bells(&mut self, output: usize, delays: bool) {
        self.outputs[output].publisher.delay_bells(delays);
    }

    fn ring_if_due(&self, output: usize) {
        self.outputs[output].publisher.ring_if_due();
    }

    fn take_in_partners(&mut self, stop: bool) -> Result<(), PortError> {
        self.partners.take_in(true, stop)
    }

    fn choose_partners(&mut self, main: &Header, is_active: bool, stop: bool) -> Result<bool, PortError> {
        self.partners.choose(main, is_active, stop)
    }

    fn partners_have_answered(&mut self, main: Option<SampleId>) {
        self.partners.have_answered(main);
    }

    fn has_partners(&self) -> bool {
        self.partners.are_there()
    }

    fn partners_are_caught_up(&self) -> bool {
        self.partners.is_caught_up()
    }

    fn save_state(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        Ok(self.operator.save_state(bytes)?)
    }

    fn saved_state(&self) -> Option<Vec<u8>> {
        self.operator.saved_state()
    }

    fn forget_state(&mut self) {
        self.operator.forget_state();
    }

    fn is_interrupted(&self) -> bool {
        self.operator.has_command() || self.operator.should_quit()
    }

    fn is_look_due(&self) -> bool {
        self.last_look.elapsed() >= TICK
    }

    fn should_stop(&self) -> bool {
        self.operator.should_stop()
    }

    fn beat(&self) {
        self.operator.beat();
    }

    fn works_on(&self, sample: Option<SampleId>) {
        self.operator.works_on(sample);
    }

    fn skips(&self, sample: SampleId) -> bool {
        self.operator.skips(sample)
    }

    fn is_unfit(&self, seq: u64, age_nanos: u64) {
        let age_ms = age_nanos as f64 / 1e6;
        self.operator.is_unfit(format!("got sample {seq} after {age_ms:.1} ms, too late, and 'on_late' is 'stop'"));
    }

    fn warm(&self, n_samples: u64) {
        self.operator.warm(n_samples);
    }

    fn made_by(&self, made_by: u64) -> u64 {
        self.operator.made_by(made_by)
    }

    fn clock(&self) -> Clock {
        self.operator.clock()
    }

    /// By a recording's clock, the source of a sample sent it then: the load of the machine must not influence the answers.
    fn arrival_nanos(&self, header: &Header) -> u64 {
        match self.operator.clock() {
            Clock::Machine => monotonic_nanos(),
            Clock::Recording => header.origin_nanos,
        }
    }

    fn now_nanos(&self) -> u64 {
        monotonic_nanos()
    }
}

/// An operator that answers samples in its turns.
struct Runner<W> {
    site: Ports,
    engine: Engine<UntypedSample, W>,
    identity: BTreeMap<String, String>,
    is_drained: bool,
}

/// Runs a worker between its ports until the operator is asked to stop. The launcher is told the `identity` (see
/// [`Operator::ready`]). In a process with several operators it runs in turn with the others.
///
/// # Errors
/// An error of a port or of the worker.
pub(crate) fn run<W: Worker<UntypedSample> + 'static>(
    mut site: Ports,
    worker: W,
    book: Book,
    manner: Manner,
    identity: BTreeMap<String, String>,
) -> anyhow::Result<()> {
    let operator = site.operator.clone();
    if manner.saves {
        operator.reserve_state()?;
    }
    let engine = Engine::begin(&mut site, worker, book, manner, operator.begins_as_standby())?;
    site.connect()?;
    let runner = Runner { site, engine, identity, is_drained: false };
    match operator.group() {
        Some(group) => group.tasks.borrow_mut().push(Box::new(runner)),
        None => run_in_turn(vec![Box::new(runner)])?,
    }
    Ok(())
}

impl<W: Worker<UntypedSample>> Task for Runner<W> {
    fn operator(&self) -> &Operator {
        &self.site.operator
    }

    fn begin(&mut self) {
        let saves = self.engine.saves();
        self.site.operator.ready_with(std::mem::take(&mut self.identity), saves);
    }

    fn step(&mut self) -> anyhow::Result<Turn> {
        let turn = self.take_turn();
        self.engine.worker.has_had_turn();
        turn
    }
}

impl<W: Worker<UntypedSample>> Runner<W> {
    fn take_turn(&mut self) -> anyhow::Result<Turn> {
        if self.is_drained {
            return self.wait_for_the_end();
        }
        // The request is read before the input: samples that were sent before the request are still answered.
        let stop = self.site.should_stop();
        self.obey()?;
        let mut sent = Sent::Yes;
        if self.engine.is_active() {
            sent = self.engine.work(&mut self.site, stop)?;
        } else {
            self.engine.look_on(&mut self.site)?;
        }
        let is_over = stop && (!self.engine.is_active() || self.engine.is_over(&self.site));
        if is_over || self.site.operator.should_quit() {
            self.engine.worker.look()?;
            self.site.partners.report(&self.site.operator);
            // One that has handed over must not overwrite the counts of the other.
            if self.engine.is_active() {
                self.site.partners.have_ended();
            }
            self.site.operator.report_drained();
            self.is_drained = true;
            return self.wait_for_the_end();
        }
        // Sending and receiving look as well; between samples there is no hurry, and a reader that was woken may need the
        // core.
        let has_looked = self.site.is_look_due();
        if has_looked {
            self.site.last_look = Instant::now();
            self.site.operator.look_at_descriptors()?;
            self.site.look_for_readers()?;
            self.site.connect()?;
            self.engine.worker.look()?;
            self.site.partners.report(&self.site.operator);
        }
        Ok(match sent {
            _ if self.site.is_interrupted() => Turn::Interrupted,
            // Samples may be left.
            _ if has_looked => Turn::Idle(Some(Instant::now())),
            // For the sake of another operator of its group. Nobody says when its reader has room.
            Sent::GaveWay => Turn::Idle(Some(Instant::now() + ROOM_PAUSE)),
            Sent::Yes => Turn::Idle(self.deadline()),
        })
    }

    /// Keeps the ports open until the launcher needs nothing more: a publisher that ends too early could take unread samples
    /// with it. A reader that is restarted meanwhile needs its history.
    fn wait_for_the_end(&mut self) -> anyhow::Result<Turn> {
        if self.site.operator.should_quit() {
            return Ok(Turn::Ended);
        }
        self.site.look_for_readers()?;
        Ok(Turn::Idle(None))
    }

    fn obey(&mut self) -> anyhow::Result<()> {
        while let Some(command) = self.site.operator.next_command() {
            match command {
                Command::TakeOver { is_handed_over } => {
                    self.engine.take_over(&mut self.site, is_handed_over)?;
                    self.site.operator.took_over();
                }
                Command::HandOver => {
                    self.engine.hand_over(&mut self.site);
                    self.site.partners.have_handed_over();
                    self.site.operator.handed_over();
                }
                Command::Set { id, params } => {
                    let from_seq = self.engine.next_seq();
                    let outcome = self.engine.worker.set(&params)?;
                    if outcome.is_ok() {
                        self.site.operator.has_params(&params);
                    }
                    self.site.operator.has_set(id, outcome, from_seq);
                }
                Command::Go
                | Command::NodeEnded { .. }
                | Command::TakeNoMore { .. }
                | Command::Drain
                | Command::Quit => {}
            }
        }
        Ok(())
    }

    /// When it must look again, if no sample comes before.
    fn deadline(&self) -> Option<Instant> {
        let mut deadline = self.site.partners.deadline(self.engine.is_active());
        if self.engine.is_active() {
            if self.site.clock() == Clock::Machine {
                let silence = self.engine.worker.deadline_nanos().map(crate::instant_of);
                deadline = deadline.into_iter().chain(silence).min();
            }
            let held = self.site.inputs.iter().filter_map(|input| input.subscriber.hold_deadline());
            deadline = held.chain(deadline).min();
        }
        deadline
    }
}
