//! An operator that answers samples: it reads one input, perhaps with [partners](crate::partner), and writes one output.
//!
//! The stage itself knows nothing of processes. [`run`] makes it an operator that can be killed and swapped: it answers
//! while it is the active instance, reads along while it stands by, and begins after the last sample whose answer was
//! received, which the cursors name.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::cursors::{STATE_BYTES, SampleId};
use crate::operator::{Operator, TICK, Task, Turn, run_in_turn};
use crate::outbox::{Entry, Outbox};
use crate::partner::Partners;
use crate::port::{PortError, PortSample, Publisher, Sent, ShadowPublisher, Subscriber, sample_id};
use crate::wiring::{Clock, Command, InputCounts, OnLate};
use blindgrasp_messages::{Header, Message};

/// A stage that gave way to another one of its group tries again after this time.
pub(crate) const ROOM_PAUSE: Duration = Duration::from_millis(1);
/// A stage that answers each sample may answer so many before it wakes its readers, while more samples wait for it. That saves
/// most of the wake-ups …
const MOST_UNRUNG: u32 = 8;
/// … if the last answer took it no longer than this.
const QUICK_NANOS: u64 = 20_000;
/// A standby reports that it is warm after so many samples.
pub(crate) const N_WARM: u64 = 8;

/// The warning of an operator that takes over again from a replacement without a state, or with that of something else.
pub(crate) const STATE_OF_HAND_OVER: &str = "the failed replacement has left no state that this operator can use: it goes on \
     with its state of the hand-over, without the samples since";

/// The format of states: numbers of fixed size, which cost bytes but hardly any time.
pub const STATE_FORMAT: bincode::config::Configuration<bincode::config::LittleEndian, bincode::config::Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

/// Adds a value to `bytes` in the format of states.
///
/// # Errors
/// The value cannot be encoded.
pub fn encode_state(value: impl Serialize, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
    bincode::serde::encode_into_std_write(value, bytes, STATE_FORMAT)?;
    Ok(())
}

/// The work of an operator on samples.
pub trait Stage {
    type In: Message;
    type Out: Message;

    /// Whether its answers depend on earlier samples, which it knows from its parameters and files when it starts. A stage
    /// without state answers each sample with one of the same number, and would answer it the same way again. The state of a
    /// stage that has one is saved after each sample, with its answers and before they are sent.
    fn has_state(&self) -> bool {
        false
    }

    /// Answers a sample that arrived at `now_nanos` (CLOCK_BOOTTIME).
    fn answer(
        &mut self,
        head: &<Self::In as Message>::Head,
        items: &[<Self::In as Message>::Item],
        now_nanos: u64,
        answers: &mut Answers<Self::Out>,
    );

    /// The time (CLOCK_BOOTTIME) at which [`Stage::on_silence`] is called if no sample comes before.
    fn deadline_nanos(&self) -> Option<u64> {
        None
    }

    /// Called now and then when no sample is there.
    fn on_silence(&mut self, _now_nanos: u64, _answers: &mut Answers<Self::Out>) {}

    /// Called when no sample is there and none can come, because the link to the machine that sends them is cut off.
    fn on_cut_off(&mut self, _answers: &mut Answers<Self::Out>) {}

    /// Called when the stream is over.
    fn on_end(&mut self, _answers: &mut Answers<Self::Out>) {}

    /// Called right before an answer is sent, which may be long after it was made if a reader was behind or the process was
    /// stopped. `now_nanos` as for [`Stage::answer`].
    fn before_sending(&self, _head: &mut <Self::Out as Message>::Head, _now_nanos: u64) {}

    /// Called some times a second, between samples: a stage reports its counts here ([`Operator::has_counted`]).
    fn look(&mut self) {}

    /// Adds its state to `bytes`: see [`encode_state`].
    ///
    /// # Errors
    /// The state cannot be encoded.
    fn state(&self, _bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        Ok(())
    }

    /// Takes over a state that another instance has written, or begins anew. False if it cannot go on with all of that state,
    /// for example because another model has written it, or if there is none.
    ///
    /// # Errors
    /// The state cannot be decoded.
    fn restore(&mut self, _state: Option<&[u8]>) -> anyhow::Result<bool> {
        Ok(false)
    }

    /// Called when samples since its state were answered by another instance: a thing that it has followed has a hole.
    fn has_missed_samples(&mut self) {}

    /// Takes new values of its live parameters.
    ///
    /// # Errors
    /// The stage refuses the values and keeps the old ones.
    fn set(&mut self, _params: &Map<String, Value>) -> anyhow::Result<()> {
        anyhow::bail!("it has no parameters that can be changed while it runs")
    }
}

/// The answers of a stage to one sample.
pub struct Answers<M: Message> {
    heads: Vec<(M::Head, usize)>,
    items: Vec<M::Item>,
}

impl<M: Message> Answers<M> {
    fn with_capacity(max_items: usize) -> Self {
        Answers { heads: Vec::with_capacity(2), items: Vec::with_capacity(max_items) }
    }

    /// The items of the next answer. Fill them before [`Answers::push`].
    pub fn items(&mut self) -> &mut Vec<M::Item> {
        &mut self.items
    }

    /// Adds an answer with the items that were added since the last answer.
    pub fn push(&mut self, head: M::Head) {
        self.heads.push((head, self.items.len()));
    }

    fn clear(&mut self) {
        self.heads.clear();
        self.items.clear();
    }

    fn iter(&self) -> impl Iterator<Item = (M::Head, &[M::Item])> {
        let starts = std::iter::once(0).chain(self.heads.iter().map(|(_, end)| *end));
        starts.zip(&self.heads).map(|(start, (head, end))| (*head, &self.items[start..*end]))
    }
}

/// A stage without state from a function: see [`from_fn`].
pub struct FromFn<In, Out, F> {
    function: F,
    _types: std::marker::PhantomData<(In, Out)>,
}

/// A stage without state from a function. The function gets a sample's head and items and an empty vector for the items
/// of its answer, and returns the answer's head.
pub fn from_fn<In: Message, Out: Message, F>(function: F) -> FromFn<In, Out, F>
where
    F: FnMut(&In::Head, &[In::Item], &mut Vec<Out::Item>) -> Out::Head,
{
    FromFn { function, _types: std::marker::PhantomData }
}

impl<In: Message, Out: Message, F> Stage for FromFn<In, Out, F>
where
    F: FnMut(&In::Head, &[In::Item], &mut Vec<Out::Item>) -> Out::Head,
{
    type In = In;
    type Out = Out;

    fn answer(&mut self, head: &In::Head, items: &[In::Item], _now_nanos: u64, answers: &mut Answers<Out>) {
        let head = (self.function)(head, items, answers.items());
        answers.push(head);
    }
}

/// The saved part of an instance: the last sample that its state includes, and the answers that readers may still need. The
/// bytes of the stage's own state follow.
#[derive(Deserialize)]
struct Snapshot {
    last: Option<SampleId>,
    counts: InputCounts,
    outbox: VecDeque<Entry>,
}

/// An instance of a stage, active or standby.
struct Instance<S: Stage> {
    operator: Operator,
    identity: BTreeMap<String, String>,
    stage: S,
    /// [`Stage::has_state`] at the start.
    has_state: bool,
    subscriber: Subscriber<S::In>,
    partners: Partners,
    publisher: Publisher<S::Out>,
    /// The last sample answered.
    last: Option<SampleId>,
    answers: Answers<S::Out>,
    /// The answers of a stage with state.
    outbox: Outbox<S::Out>,
    /// Memory for the bytes of its state.
    saved: Vec<u8>,
    /// The saved state with which it has handed over, in case that its replacement fails.
    handed_over: Option<Vec<u8>>,
    /// Of a stage with state: the work that was begun and gave way.
    pending: Option<Pending<S::In>>,
    /// It has said that the graph must end.
    is_unfit: bool,
    is_active: bool,
    /// The ports of a standby that has not been active.
    shadow: Option<Shadow<S>>,
    last_look: Instant,
    is_drained: bool,
    /// Whether it has answered the last sample with a message.
    had_answer: bool,
    /// Number of samples that it has answered since it has woken its readers.
    n_unrung: u32,
}

/// Answers in the outbox that are to be saved, sent and committed.
struct Pending<M: Message> {
    /// The sample that they answer; `None` if they answer none.
    sample: Option<PortSample<M>>,
    is_saved: bool,
}

struct Shadow<S: Stage> {
    subscriber: Subscriber<S::In>,
    publisher: ShadowPublisher<S::Out>,
    n_samples: u64,
    /// It reads along after a sample that a saved state includes.
    has_begun_from_state: bool,
}

/// Runs a stage between `input` and `output` until the operator is asked to stop. An answer has at most `max_items`
/// items. The launcher is told the `identity` (see [`Operator::ready`]). In a process with several operators it opens the
/// ports, and the stage runs in turn with the others.
///
/// # Errors
/// An error of a port or of the stage.
pub fn run<S: Stage + 'static>(
    operator: &Operator,
    input: &str,
    output: &str,
    max_items: usize,
    identity: BTreeMap<String, String>,
    stage: S,
) -> anyhow::Result<()> {
    let has_state = stage.has_state();
    let mut instance = Instance {
        operator: operator.clone(),
        identity,
        stage,
        has_state,
        subscriber: operator.subscriber(input)?,
        partners: Partners::of(operator),
        publisher: operator.publisher(output, max_items)?,
        last: None,
        answers: Answers::with_capacity(max_items),
        outbox: Outbox::new(),
        saved: Vec::new(),
        handed_over: None,
        pending: None,
        is_unfit: false,
        is_active: !operator.begins_as_standby(),
        shadow: None,
        last_look: Instant::now(),
        is_drained: false,
        had_answer: false,
        n_unrung: 0,
    };
    if has_state {
        operator.reserve_state()?;
    }
    if instance.is_active {
        instance.take_over(false)?;
    } else {
        instance.stand_by(input, output, max_items)?;
    }
    instance.subscriber.connect()?;
    instance.partners.connect()?;
    match operator.group() {
        Some(group) => group.tasks.borrow_mut().push(Box::new(instance)),
        None => run_in_turn(vec![Box::new(instance)])?,
    }
    Ok(())
}

impl<S: Stage> Task for Instance<S> {
    fn operator(&self) -> &Operator {
        &self.operator
    }

    fn begin(&mut self) {
        self.operator.ready_with(std::mem::take(&mut self.identity), self.has_state);
    }

    fn step(&mut self) -> anyhow::Result<Turn> {
        if self.is_drained {
            return self.wait_for_the_end();
        }
        // The request is read before the input: samples that were sent before the request are still answered.
        let stop = self.operator.should_stop();
        self.obey()?;
        let mut sent = Sent::Yes;
        if self.is_active {
            sent = self.work(stop)?;
        } else {
            self.read_along()?;
        }
        if self.operator.should_quit()
            || (stop && (!self.is_active || (self.subscriber.is_caught_up() && self.partners.is_caught_up())))
        {
            self.stage.look();
            self.partners.report(&self.operator);
            self.partners.have_ended();
            self.operator.report_drained();
            self.is_drained = true;
            return self.wait_for_the_end();
        }
        // Sending and receiving look as well; between samples there is no hurry, and a reader that was woken may need the
        // core.
        if self.last_look.elapsed() >= TICK {
            self.last_look = Instant::now();
            self.operator.look_at_descriptors()?;
            self.publisher.look_for_readers()?;
            self.subscriber.connect()?;
            self.partners.connect()?;
            self.stage.look();
            self.partners.report(&self.operator);
        }
        Ok(match sent {
            _ if self.is_interrupted() => Turn::Interrupted,
            // For the sake of another operator of its group. Nobody says when its reader has room.
            Sent::GaveWay => Turn::Idle(Some(Instant::now() + ROOM_PAUSE)),
            Sent::Yes => Turn::Idle(self.deadline()),
        })
    }
}

impl<S: Stage> Instance<S> {
    /// Keeps the ports open until the launcher needs nothing more: a publisher that ends too early could take unread samples
    /// with it. A reader that is restarted meanwhile needs its history.
    fn wait_for_the_end(&mut self) -> anyhow::Result<Turn> {
        if self.operator.should_quit() {
            return Ok(Turn::Ended);
        }
        self.publisher.look_for_readers()?;
        Ok(Turn::Idle(None))
    }

    fn obey(&mut self) -> anyhow::Result<()> {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::TakeOver { is_handed_over } => {
                    self.shadow = None;
                    self.take_over(is_handed_over)?;
                    self.is_active = true;
                    self.operator.took_over();
                }
                Command::HandOver => {
                    self.is_active = false;
                    self.put_pending_back();
                    self.handed_over = if self.has_state { self.operator.saved_state() } else { None };
                    self.operator.handed_over();
                }
                Command::Set { id, params } => {
                    let from_seq = self.last.map(|last| last.seq + 1);
                    let outcome = self.stage.set(&params);
                    if outcome.is_ok() {
                        self.operator.has_params(&params);
                    }
                    self.operator.has_set(id, outcome, from_seq);
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
        let is_timed = self.is_active && self.operator.clock() == Clock::Machine;
        let deadline = if is_timed { self.stage.deadline_nanos() } else { None };
        let deadline = deadline.map(crate::instant_of);
        let hold_deadline = if self.is_active { self.subscriber.hold_deadline() } else { None };
        deadline.into_iter().chain(hold_deadline).chain(self.partners.deadline()).min()
    }

    /// Answers the samples that are there, and tells the stage of silence or the end of the stream.
    fn work(&mut self, stop: bool) -> anyhow::Result<Sent> {
        let sent = self.answer_samples(stop);
        self.n_unrung = 0;
        self.publisher.delay_bells(false);
        self.publisher.ring_if_due();
        sent
    }

    fn answer_samples(&mut self, stop: bool) -> anyhow::Result<Sent> {
        if self.settle()? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        // Also while no main sample comes: their writers wait for this reader.
        self.partners.take_in(true, stop)?;
        while !self.is_interrupted()
            && let Some(sample) = next(&mut self.subscriber)?
        {
            self.operator.beat();
            self.answers.clear();
            let head = sample.head();
            let header = *S::In::header(head);
            if self.operator.skips(sample_id(&header)) {
                self.skip(&header)?;
                continue;
            }
            if !self.partners.choose(&header, true, stop)? {
                self.subscriber.put_back(sample);
                return Ok(Sent::Yes);
            }
            let arrival_nanos = arrival_nanos(&self.operator, &header);
            let mut head = *head;
            if self.operator.clock() == Clock::Machine {
                self.judge_lateness(S::In::header_mut(&mut head));
            }
            self.operator.works_on(Some(sample_id(&header)));
            self.stage.answer(&head, sample.items(), arrival_nanos, &mut self.answers);
            self.operator.works_on(None);
            self.delay_or_ring();
            let sent = if self.has_state { self.keep(Some(sample))? } else { self.send(sample)? };
            if sent == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            self.partners.have_answered(self.needed_from());
        }
        if self.is_interrupted() {
            return Ok(Sent::Yes);
        }
        self.answers.clear();
        if stop && self.subscriber.is_caught_up() {
            self.stage.on_end(&mut self.answers);
        } else if self.subscriber.is_cut_off() {
            self.stage.on_cut_off(&mut self.answers);
        } else if self.operator.clock() == Clock::Machine {
            self.stage.on_silence(crate::monotonic_nanos(), &mut self.answers);
        }
        if self.answers.heads.is_empty() {
            return Ok(Sent::Yes);
        }
        if self.has_state {
            return self.keep(None);
        }
        self.send_answers(None)
    }

    /// Decides whether readers are woken for the answer. An answer that is not one of many, such as a decision, wakes them at
    /// once.
    fn delay_or_ring(&mut self) {
        let has_answer = !self.answers.heads.is_empty();
        let is_one_of_many = std::mem::replace(&mut self.had_answer, has_answer) && has_answer;
        let received_nanos = self.subscriber.received_nanos();
        let delays = is_one_of_many
            && self.n_unrung < MOST_UNRUNG
            && self.subscriber.has_more()
            && received_nanos.is_some_and(|since| crate::monotonic_nanos().saturating_sub(since) < QUICK_NANOS);
        self.n_unrung = if delays { self.n_unrung + 1 } else { 0 };
        self.publisher.delay_bells(delays);
        // An answer wakes them once it is sent.
        if !has_answer {
            self.publisher.ring_if_due();
        }
    }

    /// The last sample that an instance after this one will not answer again.
    fn needed_from(&self) -> Option<SampleId> {
        if self.has_state || !self.publisher.has_readers() { self.last } else { self.publisher.answered_by_readers() }
    }

    /// Marks a late sample as expired, and tells the launcher, where the file asks for that.
    fn judge_lateness(&mut self, header: &mut Header) {
        match self.subscriber.lateness() {
            None | Some((OnLate::Count, _)) => {}
            Some((on_late, age_nanos)) => {
                // The least that says so: see `Header::valid_until_nanos`.
                header.valid_nanos = 1;
                if on_late == OnLate::Stop && !std::mem::replace(&mut self.is_unfit, true) {
                    self.operator.is_unfit(too_late(header.seq, age_nanos));
                }
            }
        }
    }

    /// Leaves a sample without an answer. Readers find a gap: nothing is lifted on it.
    fn skip(&mut self, header: &Header) -> anyhow::Result<()> {
        tracing::error!("sample {} is not answered: it has killed this operator again and again", header.seq);
        self.last = Some(sample_id(header));
        if self.has_state {
            // If it gives way, the next instance skips the sample again.
            let _ = self.save()?;
        }
        self.subscriber.commit(header);
        Ok(())
    }

    fn is_interrupted(&self) -> bool {
        self.operator.has_command() || self.operator.should_quit()
    }

    /// Answers a sample without saving anything.
    fn send(&mut self, sample: PortSample<S::In>) -> anyhow::Result<Sent> {
        let header = *S::In::header(sample.head());
        if self.send_answers(Some(&header))? == Sent::GaveWay {
            // Another instance finds the sample in its own queue; this one finds it here if it is active again, or still is.
            self.subscriber.put_back(sample);
            return Ok(Sent::GaveWay);
        }
        self.last = Some(sample_id(&header));
        self.subscriber.commit(&header);
        Ok(Sent::Yes)
    }

    fn send_answers(&mut self, answered: Option<&Header>) -> anyhow::Result<Sent> {
        self.name_makers(answered);
        let (operator, stage) = (&self.operator, &self.stage);
        for (head, items) in self.answers.iter() {
            let sent = self.publisher.send_checked(head, items, &mut || operator.should_yield(), |head| {
                stage.before_sending(head, arrival_nanos(operator, S::Out::header(head)));
                true
            });
            if sent? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
        Ok(Sent::Yes)
    }

    /// Names what the answers were made by.
    fn name_makers(&mut self, answered: Option<&Header>) {
        for (head, _) in &mut self.answers.heads {
            let header = S::Out::header_mut(head);
            header.made_by = self.operator.made_by(answered.map_or(header.made_by, |answered| answered.made_by));
        }
    }

    /// Takes the answers of a stage with state to a sample, or to none. They are saved with its state before they are sent: a
    /// kill at any moment neither loses an answer nor makes another one under the same number.
    fn keep(&mut self, sample: Option<PortSample<S::In>>) -> anyhow::Result<Sent> {
        let answered = sample.as_ref().map(|sample| *S::In::header(sample.head()));
        self.name_makers(answered.as_ref());
        self.last = answered.as_ref().map(sample_id).or(self.last);
        for (head, items) in self.answers.iter() {
            self.outbox.push(&head, items)?;
        }
        self.pending = Some(Pending { sample, is_saved: false });
        self.settle()
    }

    /// Saves, sends and commits the answers that were kept.
    fn settle(&mut self) -> anyhow::Result<Sent> {
        if self.pending.as_ref().is_some_and(|pending| !pending.is_saved) {
            if self.save()? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            self.pending.iter_mut().for_each(|pending| pending.is_saved = true);
        }
        if self.send_outbox()? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        if let Some(sample) = self.pending.take().and_then(|pending| pending.sample) {
            self.subscriber.commit(S::In::header(sample.head()));
        }
        Ok(Sent::Yes)
    }

    /// Before another instance takes over: a sample that the saved state does not include is answered again by the instance
    /// that is active next.
    fn put_pending_back(&mut self) {
        if let Some(Pending { sample: Some(sample), is_saved: false }) = self.pending.take() {
            self.subscriber.put_back(sample);
        }
    }

    fn send_outbox(&mut self) -> anyhow::Result<Sent> {
        let (operator, stage) = (&self.operator, &self.stage);
        while let Some((head, items)) = self.outbox.next()? {
            let sent = self.publisher.send_checked(head, &items, &mut || operator.should_yield(), |head| {
                stage.before_sending(head, arrival_nanos(operator, S::Out::header(head)));
                true
            });
            if sent? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            self.outbox.has_sent_next();
        }
        Ok(Sent::Yes)
    }

    /// Saves the state with the answers that readers may still need. Where they do not fit, it waits until readers have answered
    /// some of them.
    fn save(&mut self) -> anyhow::Result<Sent> {
        loop {
            self.outbox.forget(self.publisher.has_readers(), self.publisher.answered_by_readers());
            self.saved.clear();
            encode_state((self.last, self.subscriber.counts(), self.outbox.entries()), &mut self.saved)?;
            self.stage.state(&mut self.saved)?;
            let first_sent = if self.saved.len() > STATE_BYTES { self.outbox.first_sent() } else { None };
            let Some(first) = first_sent else {
                self.operator.save_state(&self.saved)?;
                return Ok(Sent::Yes);
            };
            let operator = &self.operator;
            if self.publisher.wait_for_answers(first, &mut || operator.should_yield())? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
    }

    /// Opens the ports of a standby, which reads along after the last sample that the saved state includes.
    fn stand_by(&mut self, input: &str, output: &str, max_items: usize) -> anyhow::Result<()> {
        let snapshot = self.restore()?;
        let (mut subscriber, publisher) = (self.operator.onlooker(input)?, self.operator.shadow(output, max_items)?);
        let last = snapshot.and_then(|snapshot| snapshot.last);
        if let Some(last) = last {
            subscriber.look_on_from(last);
        }
        self.shadow = Some(Shadow { subscriber, publisher, n_samples: 0, has_begun_from_state: last.is_some() });
        Ok(())
    }

    /// Answers live samples beside the active instance.
    fn read_along(&mut self) -> anyhow::Result<()> {
        let Some(shadow) = &mut self.shadow else { return Ok(()) };
        while !self.operator.has_command()
            && !self.operator.should_stop()
            && let Some(sample) = next(&mut shadow.subscriber)?
        {
            self.operator.beat();
            if shadow.has_begun_from_state && shadow.subscriber.counts().n_missing > 0 {
                // Its queue has overflowed: the state does not include the samples before this one, the saved one does.
                shadow.subscriber.put_back(sample);
                return self.look_on_again();
            }
            self.answers.clear();
            let head = sample.head();
            if !self.partners.choose(S::In::header(head), false, false)? {
                shadow.subscriber.put_back(sample);
                return Ok(());
            }
            let arrival_nanos = arrival_nanos(&self.operator, S::In::header(head));
            self.stage.answer(head, sample.items(), arrival_nanos, &mut self.answers);
            for (head, items) in self.answers.iter() {
                shadow.publisher.send(&head, items)?;
            }
            shadow.n_samples += 1;
            if shadow.n_samples == N_WARM {
                self.operator.warm(N_WARM);
            }
        }
        Ok(())
    }

    fn look_on_again(&mut self) -> anyhow::Result<()> {
        let snapshot = self.restore()?;
        if let (Some(shadow), Some(last)) = (&mut self.shadow, snapshot.and_then(|snapshot| snapshot.last)) {
            shadow.subscriber.look_on_from(last);
        }
        Ok(())
    }

    fn take_over(&mut self, is_handed_over: bool) -> anyhow::Result<()> {
        self.put_pending_back();
        self.partners.take_over();
        let known = self.publisher.begin(is_handed_over);
        if !self.has_state {
            self.operator.forget_state();
        }
        if let Some(snapshot) = self.restore()? {
            self.subscriber.take_over_at(snapshot.last, snapshot.counts);
            self.outbox.restore(snapshot.outbox, known);
            self.last = snapshot.last;
        } else {
            // The instance before had no state, and has answered each sample under its number.
            self.subscriber.take_over(known);
            self.outbox = Outbox::new();
            self.last = known;
        }
        Ok(())
    }

    /// Takes over the saved state; `None` if the stage has none or no state was saved.
    fn restore(&mut self) -> anyhow::Result<Option<Snapshot>> {
        let saved = if self.has_state { self.operator.saved_state() } else { None };
        restore_stage(&mut self.stage, saved.as_deref(), self.handed_over.take().as_deref())
    }
}

/// Gives a stage the saved state. Where its replacement, which has failed, has left none that it can use, it goes on with the
/// state with which it handed over; the place in the stream stays that of the replacement.
fn restore_stage(
    stage: &mut impl Stage,
    saved: Option<&[u8]>,
    handed_over: Option<&[u8]>,
) -> anyhow::Result<Option<Snapshot>> {
    let restored = restore_saved(stage, saved);
    let Some(bytes) = handed_over else { return Ok(restored?.0) };
    // The replacement may have left bytes that this stage cannot read.
    let (snapshot, is_whole) = restored.unwrap_or((None, false));
    if !is_whole {
        stage.restore(Some(decode_snapshot(bytes)?.1))?;
        stage.has_missed_samples();
        tracing::warn!("{STATE_OF_HAND_OVER}");
    }
    Ok(snapshot)
}

/// The place of a saved state, and whether the stage goes on with all of it.
fn restore_saved(stage: &mut impl Stage, saved: Option<&[u8]>) -> anyhow::Result<(Option<Snapshot>, bool)> {
    let Some(bytes) = saved else { return Ok((None, stage.restore(None)?)) };
    let (snapshot, state) = decode_snapshot(bytes)?;
    Ok((Some(snapshot), stage.restore(Some(state))?))
}

/// A saved state, and in it the bytes of the stage's own.
fn decode_snapshot(bytes: &[u8]) -> anyhow::Result<(Snapshot, &[u8])> {
    let (snapshot, n_bytes) =
        bincode::serde::decode_from_slice(bytes, STATE_FORMAT).context("the node's saved state cannot be read")?;
    Ok((snapshot, &bytes[n_bytes..]))
}

/// The next sample: one that was taken and not answered, or the next in order.
fn next<M: Message>(subscriber: &mut Subscriber<M>) -> Result<Option<PortSample<M>>, PortError> {
    match subscriber.take_back() {
        Some(sample) => Ok(Some(sample)),
        None => subscriber.receive(),
    }
}

/// Why an operator whose input has `on_late: stop` ends the graph.
pub(crate) fn too_late(seq: u64, age_nanos: u64) -> String {
    format!("got sample {seq} after {:.1} ms, too late, and 'on_late' is 'stop'", age_nanos as f64 / 1e6)
}

/// The time at which a sample counts as arrived, and an answer as sent. By a recording's clock, its source sent it then: the
/// load of the machine must not influence the answers.
pub(crate) fn arrival_nanos(operator: &Operator, header: &Header) -> u64 {
    match operator.clock() {
        Clock::Machine => crate::monotonic_nanos(),
        Clock::Recording => header.origin_nanos,
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{LiftDecision, Prediction};

    use super::*;

    /// A stage whose state is a number and the model that it belongs to.
    #[derive(Debug, PartialEq)]
    struct LearningStage {
        model: u64,
        n_learned: u64,
    }

    impl Stage for LearningStage {
        type In = Prediction;
        type Out = LiftDecision;

        fn answer(
            &mut self,
            _: &<Prediction as Message>::Head,
            _: &[<Prediction as Message>::Item],
            _: u64,
            _: &mut Answers<LiftDecision>,
        ) {
        }

        fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
            let saved = state.map(|bytes| bincode::serde::decode_from_slice::<(u64, u64), _>(bytes, STATE_FORMAT));
            let (model, n_learned) = saved.transpose()?.map_or((0, 0), |(saved, _)| saved);
            self.n_learned = if model == self.model { n_learned } else { 0 };
            Ok(model == self.model)
        }
    }

    fn saved(seq: u64, model: u64, n_learned: u64) -> Vec<u8> {
        let mut bytes = Vec::new();
        let last = Some(SampleId { epoch: 3, seq });
        encode_state((last, InputCounts::default(), VecDeque::<Entry>::new()), &mut bytes).expect("encoded");
        encode_state((model, n_learned), &mut bytes).expect("encoded");
        bytes
    }

    #[test]
    fn an_operator_whose_replacement_fails_goes_on_with_what_it_has_learned() {
        let own = saved(10, 1, 304);
        let other = saved(90, 2, 7);
        let newer = saved(90, 1, 310);
        for (found, handed_over, expected) in [
            // Its replacement had another model, or no state, which drops the saved one.
            (Some(&other), Some(&own), (Some(90), 304)),
            (None, Some(&own), (None, 304)),
            // Its replacement has gone on with its state.
            (Some(&newer), Some(&own), (Some(90), 310)),
            // It has not been active before.
            (Some(&other), None, (Some(90), 0)),
            (None, None, (None, 0)),
        ] {
            let mut stage = LearningStage { model: 1, n_learned: 304 };
            let snapshot = restore_stage(&mut stage, found.map(Vec::as_slice), handed_over.map(Vec::as_slice));
            let last = snapshot.expect("restored").and_then(|snapshot| snapshot.last);
            assert_eq!((last.map(|last| last.seq), stage.n_learned), expected);
        }
    }
}
