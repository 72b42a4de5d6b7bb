//! An operator that answers samples: it reads one input and writes one output.
//!
//! The stage itself knows nothing of processes. [`run`] makes it an operator that can be killed and swapped: it answers
//! while it is the active instance, reads along while it stands by, and begins after the last sample whose answer was
//! received, which the board names.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::board::Key;
use crate::operator::{Operator, TICK};
use crate::port::{Publisher, Sent, ShadowPublisher, Subscriber};
use crate::wiring::{Clock, Command, InputCounts};
use blindgrasp_messages::{Header, Message};

/// A standby reports that it is warm after so many samples.
const N_WARM: u64 = 8;

/// The format of states: numbers of fixed size, which cost bytes but hardly any time.
pub const STATE_FORMAT: bincode::config::Configuration<bincode::config::LittleEndian, bincode::config::Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

/// The work of an operator on samples.
pub trait Stage {
    type In: Message;
    type Out: Message;

    /// Whether its answers depend on earlier samples. A stage without state answers each sample with one of the same number,
    /// and would answer it the same way again. The state of a stage that has one is saved after each sample.
    const HAS_STATE: bool = false;

    /// Answers a sample that arrived at `now_nanos` (CLOCK_MONOTONIC).
    fn answer(
        &mut self,
        head: &<Self::In as Message>::Head,
        items: &[<Self::In as Message>::Item],
        now_nanos: u64,
        answers: &mut Answers<Self::Out>,
    );

    /// The time (CLOCK_MONOTONIC) at which [`Stage::on_silence`] is called if no sample comes before.
    fn deadline_nanos(&self) -> Option<u64> {
        None
    }

    /// Called now and then when no sample is there.
    fn on_silence(&mut self, _now_nanos: u64, _answers: &mut Answers<Self::Out>) {}

    /// Called when no sample is there and none can come, because the link to the machine that sends them is cut off.
    fn on_cut_off(&mut self, _answers: &mut Answers<Self::Out>) {}

    /// Called when the stream is over.
    fn on_end(&mut self, _answers: &mut Answers<Self::Out>) {}

    /// Its state, as bytes.
    ///
    /// # Errors
    /// The state cannot be encoded.
    fn state(&self) -> anyhow::Result<Vec<u8>> {
        Ok(Vec::new())
    }

    /// Takes over a state that another instance has written, or begins anew.
    ///
    /// # Errors
    /// The state cannot be decoded.
    fn restore(&mut self, _state: Option<&[u8]>) -> anyhow::Result<()> {
        Ok(())
    }

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

/// A stage's state, and the last sample that it includes.
#[derive(Serialize, Deserialize)]
struct Snapshot {
    last: Option<(u64, u64)>,
    counts: InputCounts,
    stage: Vec<u8>,
}

/// The ports of the active instance.
struct Ports<S: Stage> {
    subscriber: Subscriber<S::In>,
    publisher: Publisher<S::Out>,
    /// The last sample answered.
    last: Option<Header>,
}

/// The ports of a standby.
struct Shadow<S: Stage> {
    subscriber: Subscriber<S::In>,
    publisher: ShadowPublisher<S::Out>,
    n_samples: u64,
}

/// Runs a stage between `input` and `output` until the operator is asked to stop. An answer has at most `max_items`
/// items. The launcher is told the `identity` (see [`Operator::ready`]).
///
/// # Errors
/// An error of a port or of the stage.
pub fn run<S: Stage>(
    operator: &Operator,
    input: &str,
    output: &str,
    max_items: usize,
    identity: BTreeMap<String, String>,
    mut stage: S,
) -> anyhow::Result<()> {
    let mut ports: Ports<S> = Ports {
        subscriber: operator.subscriber(input)?,
        publisher: operator.publisher(output, max_items)?,
        last: None,
    };
    let mut answers = Answers::with_capacity(max_items);
    if S::HAS_STATE {
        operator.reserve_state()?;
    }
    let mut is_active = !operator.begins_as_standby();
    let mut shadow: Option<Shadow<S>> = None;
    if is_active {
        take_over(operator, &mut stage, &mut ports, false)?;
    } else {
        let snapshot = restore(operator, &mut stage)?;
        let (mut subscriber, publisher) = (operator.onlooker(input)?, operator.shadow(output, max_items)?);
        if let Some(last) = snapshot.and_then(|snapshot| snapshot.last) {
            subscriber.look_on_from(Key { epoch: last.0, seq: last.1 });
        }
        shadow = Some(Shadow { subscriber, publisher, n_samples: 0 });
    }
    ports.subscriber.connect()?;
    operator.ready(identity);
    let mut last_look = Instant::now();
    loop {
        // The request is read before the input: samples that were sent before the request are still answered.
        let stop = operator.should_stop();
        while let Some(command) = operator.next_command() {
            match command {
                Command::TakeOver { is_handed_over } => {
                    shadow = None;
                    take_over(operator, &mut stage, &mut ports, is_handed_over)?;
                    is_active = true;
                    operator.took_over();
                }
                Command::HandOver => {
                    is_active = false;
                    operator.handed_over();
                }
                Command::Set { id, params } => {
                    let from_seq = ports.last.map(|last| last.seq + 1);
                    operator.has_set(id, stage.set(&params), from_seq);
                }
                Command::Go | Command::NodeEnded { .. } | Command::TakeNoMore { .. } => {}
            }
        }
        if is_active {
            work(operator, &mut stage, &mut ports, &mut answers, stop)?;
        } else if let Some(shadow) = &mut shadow {
            look_on(operator, &mut stage, shadow, &mut answers)?;
        }
        if operator.should_quit() || (stop && (!is_active || ports.subscriber.is_caught_up())) {
            break;
        }
        // Sending and receiving look as well; between samples there is no hurry, and a reader that was woken may need the core.
        if last_look.elapsed() >= TICK {
            last_look = Instant::now();
            ports.publisher.look_for_readers()?;
            ports.subscriber.connect()?;
        }
        let listeners = match &shadow {
            Some(shadow) => vec![ports.subscriber.listener(), shadow.subscriber.listener()],
            None => vec![ports.subscriber.listener()],
        };
        let listeners: Vec<_> = listeners.into_iter().flatten().collect();
        let left = |deadline: u64| Duration::from_nanos(deadline.saturating_sub(crate::monotonic_nanos()));
        let deadline = stage
            .deadline_nanos()
            .filter(|_| is_active && operator.clock() == Clock::Machine)
            .map(|deadline| Instant::now() + left(deadline));
        operator
            .wait(&listeners, deadline.into_iter().chain(ports.subscriber.hold_deadline().filter(|_| is_active)).min());
    }
    operator.drained();
    Ok(())
}

/// The time at which a sample counts as arrived. By a recording's clock, its source sent it then: the load of the machine
/// must not influence the answers.
fn arrival_nanos(operator: &Operator, header: &Header) -> u64 {
    match operator.clock() {
        Clock::Machine => crate::monotonic_nanos(),
        Clock::Recording => header.origin_nanos,
    }
}

/// Answers the samples that are there, and tells the stage of silence or the end of the stream.
fn work<S: Stage>(
    operator: &Operator,
    stage: &mut S,
    ports: &mut Ports<S>,
    answers: &mut Answers<S::Out>,
    stop: bool,
) -> anyhow::Result<()> {
    while !operator.has_command()
        && !operator.should_quit()
        && let Some(sample) = ports.subscriber.receive()?
    {
        operator.beat();
        answers.clear();
        let head = sample.user_header();
        let header = *S::In::header(head);
        stage.answer(head, sample.payload(), arrival_nanos(operator, &header), answers);
        if publish(operator, ports, answers)? == Sent::GaveWay {
            // Another instance finds the sample in its own queue; this one finds it here if it is active again.
            ports.subscriber.put_back(sample);
            return Ok(());
        }
        commit(operator, stage, ports, Some(header))?;
    }
    if operator.has_command() || operator.should_quit() {
        return Ok(());
    }
    answers.clear();
    if stop && ports.subscriber.is_caught_up() {
        stage.on_end(answers);
    } else if ports.subscriber.is_cut_off() {
        stage.on_cut_off(answers);
    } else if operator.clock() == Clock::Machine {
        stage.on_silence(crate::monotonic_nanos(), answers);
    }
    if !answers.heads.is_empty() && publish(operator, ports, answers)? == Sent::Yes {
        commit(operator, stage, ports, None)?;
    }
    Ok(())
}

fn publish<S: Stage>(operator: &Operator, ports: &mut Ports<S>, answers: &Answers<S::Out>) -> anyhow::Result<Sent> {
    for (head, items) in answers.iter() {
        if ports.publisher.send(head, items, &mut || operator.is_to_give_way())? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
    }
    Ok(Sent::Yes)
}

/// Saves the state, then marks the sample as answered, so that an instance that takes over does not answer it again.
fn commit<S: Stage>(
    operator: &Operator,
    stage: &S,
    ports: &mut Ports<S>,
    header: Option<Header>,
) -> anyhow::Result<()> {
    ports.last = header.or(ports.last);
    if S::HAS_STATE {
        let snapshot = Snapshot {
            last: ports.last.map(|header| (header.epoch, header.seq)),
            counts: ports.subscriber.counts(),
            stage: stage.state()?,
        };
        operator.save_state(&bincode::serde::encode_to_vec(&snapshot, STATE_FORMAT)?)?;
    }
    if let Some(header) = header {
        ports.subscriber.commit(&header);
    }
    Ok(())
}

/// Computes live samples beside the active instance.
fn look_on<S: Stage>(
    operator: &Operator,
    stage: &mut S,
    shadow: &mut Shadow<S>,
    answers: &mut Answers<S::Out>,
) -> anyhow::Result<()> {
    while !operator.has_command()
        && !operator.should_stop()
        && let Some(sample) = shadow.subscriber.receive()?
    {
        operator.beat();
        answers.clear();
        let head = sample.user_header();
        stage.answer(head, sample.payload(), arrival_nanos(operator, S::In::header(head)), answers);
        for (head, items) in answers.iter() {
            shadow.publisher.send(head, items)?;
        }
        shadow.n_samples += 1;
        if shadow.n_samples == N_WARM {
            operator.warm(N_WARM);
        }
    }
    Ok(())
}

fn take_over<S: Stage>(
    operator: &Operator,
    stage: &mut S,
    ports: &mut Ports<S>,
    is_handed_over: bool,
) -> anyhow::Result<()> {
    if S::HAS_STATE {
        let snapshot = restore(operator, stage)?;
        let (last, counts) = snapshot.map_or_else(Default::default, |snapshot| (snapshot.last, snapshot.counts));
        let last = last.map(|(epoch, seq)| Key { epoch, seq });
        ports.last = last.map(|Key { epoch, seq }| Header { epoch, seq, ..Header::default() });
        ports.subscriber.take_over_at(last, counts);
    } else {
        let answered = ports.publisher.known(is_handed_over);
        ports.last = answered.map(|Key { epoch, seq }| Header { epoch, seq, ..Header::default() });
        ports.subscriber.take_over(answered);
    }
    Ok(())
}

fn restore<S: Stage>(operator: &Operator, stage: &mut S) -> anyhow::Result<Option<Snapshot>> {
    let Some(bytes) = operator.saved_state().filter(|_| S::HAS_STATE) else {
        stage.restore(None)?;
        return Ok(None);
    };
    let (snapshot, _) = bincode::serde::decode_from_slice::<Snapshot, _>(&bytes, STATE_FORMAT)
        .context("the node's saved state cannot be read")?;
    stage.restore(Some(&snapshot.stage))?;
    Ok(Some(snapshot))
}
