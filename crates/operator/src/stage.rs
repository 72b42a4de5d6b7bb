//! An operator that answers samples: it reads one input, perhaps with [partners](crate::partner), and writes one output.
//!
//! The stage itself knows nothing of processes. [`run`] makes it an operator that can be killed and swapped, by the rules of
//! the module `engine`.

use std::collections::BTreeMap;

use blindgrasp_messages::zerocopy::{FromBytes as _, IntoBytes as _};
use blindgrasp_messages::{Header, Message};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::engine::{Answer, Hearing, Manner, Taken, Worker};
use crate::operator::Operator;
use crate::port::UntypedSample;
use crate::runner::{self, InputPort, OutputPort, Ports};
use crate::saved::{self, Book, Input, Numbers, Output};

/// Adds a state to `bytes`, after the name of its format: that of its operator.
///
/// # Errors
/// The state cannot be encoded.
pub fn encode_state(format: &str, state: impl Serialize, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
    bytes.extend_from_slice(format.as_bytes());
    saved::put(state, bytes)
}

/// A state that [`encode_state`] has encoded.
///
/// # Errors
/// It has another format.
pub fn decode_state<T: DeserializeOwned>(format: &str, bytes: &[u8]) -> anyhow::Result<T> {
    if let Some(mut rest) = bytes.strip_prefix(format.as_bytes())
        && let Some(state) = saved::take(&mut rest)
        && rest.is_empty()
    {
        return Ok(state);
    }
    let beginning = String::from_utf8_lossy(&bytes[..bytes.len().min(24)]);
    anyhow::bail!(
        "the node's saved state begins with {beginning:?}, expected one that '{format}' of this version has saved: swap to the \
         operator that has saved it, or start the graph anew"
    )
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

    /// Takes over a state that another instance has written, or begins anew. False if it cannot go on with all of that state
    /// (another model has written it, for example), or if there is none.
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

    fn items_of(&self, idx: usize) -> &[u8] {
        let start = idx.checked_sub(1).map_or(0, |before| self.heads[before].1);
        self.items[start..self.heads[idx].1].as_bytes()
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

/// A stage as the worker of an [`Engine`](crate::engine::Engine).
struct StageWorker<S: Stage> {
    stage: S,
    /// [`Stage::has_state`] at the start.
    has_state: bool,
    answers: Answers<S::Out>,
    /// The head that is sent just now.
    head: <S::Out as Message>::Head,
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
    let is_standby = operator.begins_as_standby();
    let input_port = InputPort::open::<S::In>(operator, input, is_standby)?;
    let output_port = OutputPort::open::<S::Out>(operator, output, Some(max_items), is_standby)?;
    let site = Ports::new(operator, vec![input_port], vec![output_port]);
    let book = Book::new(vec![Input::new(input, false)], vec![Output::new(output, Numbers::OfWorker)]);
    let has_state = stage.has_state();
    let manner = Manner {
        saves: has_state,
        answers_each: operator.answers_each(),
        n_batch: 1,
        has_suspect: operator.has_suspect(),
    };
    let answers = Answers { heads: Vec::with_capacity(2), items: Vec::with_capacity(max_items) };
    let worker = StageWorker { stage, has_state, answers, head: Default::default() };
    runner::run(site, worker, book, manner, identity)
}

impl<S: Stage> Worker<UntypedSample> for StageWorker<S> {
    fn has_state(&self) -> bool {
        self.has_state
    }

    fn ask(&mut self, _input: usize, samples: &[Taken<UntypedSample>]) -> anyhow::Result<bool> {
        let [taken] = samples else { return Ok(false) };
        self.answers.clear();
        let mut head: <S::In as Message>::Head = *taken.sample.beginning();
        *S::In::header_mut(&mut head) = taken.header;
        self.stage.answer(&head, taken.sample.items(), taken.arrival_nanos, &mut self.answers);
        Ok(true)
    }

    fn next(&mut self) -> usize {
        self.answers.heads.len()
    }

    fn hear(&mut self, hearing: Hearing, now_nanos: u64) -> anyhow::Result<Option<usize>> {
        self.answers.clear();
        match hearing {
            Hearing::Silence => self.stage.on_silence(now_nanos, &mut self.answers),
            Hearing::End => self.stage.on_end(&mut self.answers),
            Hearing::CutOff => self.stage.on_cut_off(&mut self.answers),
        }
        let n_answers = self.answers.heads.len();
        Ok(if n_answers == 0 { None } else { Some(n_answers) })
    }

    fn answer(&self, idx: usize) -> Answer<'_> {
        (0, self.answers.heads[idx].0.as_bytes(), self.answers.items_of(idx))
    }

    fn set_header(&mut self, idx: usize, header: &Header) {
        *S::Out::header_mut(&mut self.answers.heads[idx].0) = *header;
    }

    fn before_sending(&mut self, idx: usize, now_nanos: u64) -> anyhow::Result<Answer<'_>> {
        self.head = self.answers.heads[idx].0;
        self.stage.before_sending(&mut self.head, now_nanos);
        Ok((0, self.head.as_bytes(), self.answers.items_of(idx)))
    }

    fn before_sending_saved(&mut self, (_, head, _): Answer<'_>, now_nanos: u64) -> anyhow::Result<&[u8]> {
        let Ok(head) = <S::Out as Message>::Head::read_from_bytes(head) else {
            anyhow::bail!(
                "a saved answer of the node has a head of {} bytes, expected {}: an operator of another version has saved it",
                head.len(),
                size_of_val(&self.head)
            );
        };
        self.head = head;
        self.stage.before_sending(&mut self.head, now_nanos);
        Ok(self.head.as_bytes())
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        self.stage.state(bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        self.stage.restore(state)
    }

    fn has_missed_samples(&mut self) {
        self.stage.has_missed_samples();
    }

    fn deadline_nanos(&self) -> Option<u64> {
        self.stage.deadline_nanos()
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<anyhow::Result<()>> {
        Ok(self.stage.set(params))
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.stage.look();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_of_another_format_is_refused_in_words() {
        let mut bytes = Vec::new();
        encode_state("contacts", (7_u64, "grasp"), &mut bytes).expect("encoded");
        assert_eq!(decode_state::<(u64, String)>("contacts", &bytes).expect("decoded"), (7, "grasp".into()));
        for (format, bytes) in [("lift_arbiter", &bytes[..]), ("contacts", &bytes[..20]), ("contacts", b"[7]")] {
            let refusal = decode_state::<(u64, String)>(format, bytes).expect_err("refused").to_string();
            assert!(refusal.contains(format!("expected one that '{format}' of this version").as_str()), "{refusal}");
        }
        // A part of it would be a number by luck.
        assert!(decode_state::<u64>("contacts", &bytes).is_err());
    }
}
