//! The state that a host saves for the one that takes over: how far it has come, answers that readers may still need, and the state of
//! its program.
//!
//! It is saved as a whole, before the answers are sent: a kill at any moment neither loses an answer nor makes another one
//! under its number.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use super::ports::{InputPort, OutputPort, RawAnswer};
use crate::cursors::{STATE_BYTES, SampleId};
use crate::operator::Operator;
use crate::outbox::{Kept, Keyed as _};
use crate::port::{LONGEST_TRY, LOOK_PAUSE, PortError, RETRY_PAUSE, Sent};
use crate::stage::{STATE_FORMAT, encode_state};
use crate::wiring::InputCounts;
use blindgrasp_messages::Header;

/// The beginning of what hosts save. No stage in Rust saves anything that begins like this.
const MAGIC: &[u8] = b"bg-host1";
/// An upper bound of the bytes that are saved for each port besides its answers, and for the rest.
const PORT_BYTES: usize = 256;
/// The numbers that are saved with an answer: the lengths of its head and items.
const ENTRY_BYTES: usize = 16;

/// An input, and how far the operator has come.
pub(super) struct Input {
    /// Its number in the description.
    pub(super) idx: usize,
    pub(super) name: String,
    pub(super) is_feedback: bool,
    pub(super) port: Box<dyn InputPort>,
    /// The reader of a standby.
    pub(super) onlooker: Option<Box<dyn InputPort>>,
    /// The last sample that was answered, with the counts of that time.
    pub(super) last: Option<SampleId>,
    pub(super) counts: InputCounts,
}

/// An output, and the answers that were saved before they were sent, until all readers have answered them.
pub(super) struct Output {
    pub(super) idx: usize,
    pub(super) name: String,
    pub(super) max_items: Option<usize>,
    /// The input whose samples it answers under their numbers.
    pub(super) answers: Option<usize>,
    pub(super) port: Box<dyn OutputPort>,
    /// Up to this sample, readers have all that an earlier instance has sent.
    pub(super) known: Option<SampleId>,
    /// The last sample that was saved.
    pub(super) last: Option<SampleId>,
    saved: Kept<RawAnswer>,
}

impl Output {
    pub(super) fn new(
        idx: usize,
        name: &str,
        max_items: Option<usize>,
        answers: Option<usize>,
        port: Box<dyn OutputPort>,
    ) -> Output {
        let name = name.into();
        Output { idx, name, max_items, answers, port, known: None, last: None, saved: Kept::default() }
    }

    /// Takes an answer that is to be saved and then sent.
    pub(super) fn keep(&mut self, answer: RawAnswer) {
        self.last = Some(answer.key());
        self.saved.push(answer);
    }

    /// Drops the answers that were sent and that all readers have answered; true if there was one.
    fn forget(&mut self) -> bool {
        let (has_readers, answered) = (self.port.has_readers(), self.port.answered_by_readers());
        self.saved.forget(has_readers, answered).count() > 0
    }

    fn restore(&mut self, saved: VecDeque<RawAnswer>, last: Option<SampleId>, known: Option<SampleId>) {
        self.saved = Kept::restored(saved, known);
        self.last = last;
    }

    fn n_saved_bytes(&self) -> usize {
        self.saved.entries().iter().map(|answer| ENTRY_BYTES + answer.head.len() + answer.items.len()).sum()
    }

    /// The most bytes that an answer takes where it is saved; `None` if that is not limited.
    pub(super) fn max_bytes(&self) -> Option<usize> {
        self.max_items.map(|n_items| ENTRY_BYTES + self.port.n_bytes(n_items))
    }
}

/// The saved places of the ports, by name.
#[derive(Default, Serialize, Deserialize)]
struct Places {
    inputs: BTreeMap<String, (Option<SampleId>, InputCounts)>,
    /// The last sample, and the number of answers that are saved.
    outputs: BTreeMap<String, (Option<SampleId>, u64)>,
    is_done: bool,
}

/// The ports of an operator that saves them.
pub(super) struct Store {
    pub(super) operator: Operator,
    bytes: Vec<u8>,
    is_done: bool,
}

/// The saved state of another instance.
pub(super) struct Restored {
    /// The state of its program; `None` if there is none.
    pub(super) state: Option<Vec<u8>>,
    /// Its source had ended.
    pub(super) is_done: bool,
}

impl Store {
    /// Takes the memory.
    ///
    /// # Errors
    /// There is no room in shared memory.
    pub(super) fn new(operator: &Operator) -> anyhow::Result<Store> {
        operator.reserve_state()?;
        Ok(Store { operator: operator.clone(), bytes: Vec::new(), is_done: false })
    }

    /// The most bytes that answers and state may take.
    pub(super) fn room(inputs: &[Input], outputs: &[Output]) -> usize {
        STATE_BYTES - MAGIC.len() - PORT_BYTES * (1 + inputs.len() + outputs.len())
    }

    /// Its source has no more samples.
    pub(super) fn has_ended(&mut self) {
        self.is_done = true;
    }

    /// Saves all. `GaveWay` if it was asked to while it waited for the readers of answers that must stay saved.
    ///
    /// # Errors
    /// State and answers take too much, or a reader stands still.
    pub(super) fn save(
        &mut self,
        inputs: &[Input],
        outputs: &mut [Output],
        state: &[u8],
        may_give_way: bool,
    ) -> anyhow::Result<Sent> {
        loop {
            for output in outputs.iter_mut() {
                output.forget();
            }
            let n_saved: usize = outputs.iter().map(Output::n_saved_bytes).sum();
            if n_saved + state.len() <= Store::room(inputs, outputs) {
                self.write(inputs, outputs, state)?;
                return Ok(Sent::Yes);
            }
            if outputs.iter().all(|output| output.saved.first_sent().is_none()) {
                anyhow::bail!(
                    "its state takes {} bytes and the answers to one sample {n_saved}, expected at most {} together",
                    state.len(),
                    Store::room(inputs, outputs)
                );
            }
            if self.wait_for_readers(outputs, may_give_way, false)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
    }

    fn write(&mut self, inputs: &[Input], outputs: &[Output], state: &[u8]) -> anyhow::Result<()> {
        self.bytes.clear();
        encode(inputs, outputs, self.is_done, state, &mut self.bytes)?;
        Ok(self.operator.save_state(&self.bytes)?)
    }

    /// Waits until so many bytes may be saved. `GaveWay` if it was asked to, or to stop.
    ///
    /// # Errors
    /// A reader stands still.
    pub(super) fn wait_for_room(
        &self,
        inputs: &[Input],
        outputs: &mut [Output],
        n_bytes: usize,
    ) -> anyhow::Result<Sent> {
        loop {
            let n_saved: usize = outputs.iter().map(Output::n_saved_bytes).sum();
            if n_saved + n_bytes <= Store::room(inputs, outputs)
                || outputs.iter().all(|output| output.saved.first_sent().is_none())
            {
                return Ok(Sent::Yes);
            }
            if self.wait_for_readers(outputs, true, true)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
    }

    /// Waits until all readers of an output have answered one of its saved answers.
    fn wait_for_readers(&self, outputs: &mut [Output], may_give_way: bool, may_stop: bool) -> anyhow::Result<Sent> {
        let start = Instant::now();
        let (mut last_look, mut last_try) = (start, start);
        let mut waited = vec![Duration::ZERO; outputs.len()];
        let limit = outputs.iter().map(|output| output.port.wait_limit()).max().unwrap_or_default();
        let outcome = loop {
            let mut has_forgotten = false;
            for output in outputs.iter_mut() {
                has_forgotten |= output.forget();
            }
            if has_forgotten {
                break Ok(Sent::Yes);
            }
            let gives_way = self.operator.should_yield() && (may_give_way || self.operator.should_quit());
            if gives_way || (may_stop && self.operator.should_stop()) {
                break Ok(Sent::GaveWay);
            }
            let now = Instant::now();
            let since = now.duration_since(std::mem::replace(&mut last_try, now)).min(LONGEST_TRY);
            for (output, waited) in outputs.iter().zip(&mut waited) {
                let first = output.saved.first_sent();
                let are_attached = first.is_some_and(|first| output.port.give_up_attached_that_lack(first, *waited));
                *waited = if are_attached { *waited + since } else { Duration::ZERO };
            }
            if start.elapsed() > limit {
                let slow = outputs.iter().filter(|output| output.saved.first_sent().is_some());
                let slow = slow.map(|output| output.name.as_str());
                let slow: Vec<&str> = slow.collect();
                break Err(anyhow::anyhow!(
                    "no saved sample of the output {} was answered within {} ms: a reader is stopped or too slow",
                    slow.join(", "),
                    limit.as_millis()
                ));
            }
            if last_look.elapsed() > LOOK_PAUSE {
                last_look = Instant::now();
                look_for_readers(outputs)?;
            }
            std::thread::sleep(RETRY_PAUSE);
        };
        for output in outputs.iter().filter(|output| output.saved.first_sent().is_some()) {
            output.port.has_waited(start.elapsed());
        }
        outcome
    }

    /// Sends the saved answers that were not sent.
    ///
    /// # Errors
    /// The reason of a port.
    pub(super) fn send(
        &self,
        outputs: &mut [Output],
        is_checked: bool,
        mut check: impl FnMut(usize, &Header, &mut Vec<u8>, &[u8]) -> bool,
    ) -> Result<Sent, PortError> {
        for output in outputs {
            while let Some(answer) = output.saved.next() {
                let idx = output.idx;
                let mut checked = |header: &Header, head: &mut Vec<u8>, items: &[u8]| check(idx, header, head, items);
                let check: Option<super::ports::Check<'_>> = if is_checked { Some(&mut checked) } else { None };
                if output.port.send(answer, &mut || self.operator.should_yield(), check)? == Sent::GaveWay {
                    return Ok(Sent::GaveWay);
                }
                output.saved.has_sent_next();
            }
        }
        Ok(Sent::Yes)
    }

    /// Takes over what the node's active instance has saved last.
    ///
    /// The state of another operator says nothing: a source then goes on after the last sample that was sent, a stage after
    /// the last one that was answered.
    ///
    /// # Errors
    /// A stage without a host has saved it, or it is damaged.
    pub(super) fn restore(
        &mut self,
        inputs: &mut [Input],
        outputs: &mut [Output],
        is_handed_over: bool,
        is_source: bool,
    ) -> anyhow::Result<Restored> {
        // The places come first: for a standby, the active instance goes on meanwhile, and what it has saved is never behind them.
        let answered: Vec<_> = inputs.iter().map(|input| input.port.place()).collect();
        let sent: Vec<_> = outputs.iter().map(|output| output.port.last()).collect();
        self.is_done = false;
        let saved = self.operator.saved_state();
        let content = saved.as_ref().and_then(|saved| saved.strip_prefix(MAGIC));
        if saved.is_some() && content.is_none() && !is_source {
            anyhow::bail!(
                "the node's state was saved by an operator of another kind, expected one that has a host: start the graph \
                 with this operator instead"
            );
        }
        if let Some(content) = content {
            let (places, n_bytes) = bincode::serde::decode_from_slice::<Places, _>(content, STATE_FORMAT)
                .context("the node's saved state cannot be read")?;
            if !is_old(&places, inputs, outputs, &answered, &sent, is_source) {
                self.is_done = places.is_done;
                let state = take_in(&places, &content[n_bytes..], inputs, outputs, is_handed_over)?;
                return Ok(Restored { state: Some(state), is_done: places.is_done });
            }
            tracing::info!("the saved state is older than the last samples of this node: it is not used");
        }
        for (input, (last, counts)) in inputs.iter_mut().zip(answered) {
            (input.last, input.counts) = (last, counts);
        }
        for (output, last) in outputs.iter_mut().zip(sent) {
            output.restore(VecDeque::new(), last, None);
        }
        Ok(Restored { state: None, is_done: false })
    }
}

/// Writes down all that is saved.
fn encode(
    inputs: &[Input],
    outputs: &[Output],
    is_done: bool,
    state: &[u8],
    bytes: &mut Vec<u8>,
) -> anyhow::Result<()> {
    let places = Places {
        inputs: inputs.iter().map(|input| (input.name.clone(), (input.last, input.counts))).collect(),
        outputs: outputs
            .iter()
            .map(|output| (output.name.clone(), (output.last, output.saved.entries().len() as u64)))
            .collect(),
        is_done,
    };
    bytes.extend_from_slice(MAGIC);
    encode_state(&places, &mut *bytes)?;
    // In the order of their names, in which they are read.
    for name in places.outputs.keys() {
        for answer in outputs.iter().filter(|output| output.name == *name).flat_map(|output| output.saved.entries()) {
            bytes.extend_from_slice(&(answer.head.len() as u64).to_ne_bytes());
            bytes.extend_from_slice(&(answer.items.len() as u64).to_ne_bytes());
            bytes.extend_from_slice(&answer.head);
            bytes.extend_from_slice(&answer.items);
        }
    }
    bytes.extend_from_slice(state);
    Ok(())
}

/// Goes on from what was saved; returns the state of the program.
fn take_in(
    places: &Places,
    mut rest: &[u8],
    inputs: &mut [Input],
    outputs: &mut [Output],
    is_handed_over: bool,
) -> anyhow::Result<Vec<u8>> {
    for input in inputs {
        (input.last, input.counts) = places.inputs.get(&input.name).copied().unwrap_or_default();
    }
    for (name, (last, n_answers)) in &places.outputs {
        let output = outputs.iter_mut().find(|output| output.name == *name);
        let answers = read_answers(&mut rest, *n_answers, output.as_deref())?;
        if let Some(output) = output {
            let known = output.port.known(is_handed_over);
            output.restore(answers, *last, known);
        }
    }
    Ok(rest.to_vec())
}

/// Lets all outputs look for readers that have come back.
///
/// # Errors
/// The reason of a port.
pub(super) fn look_for_readers(outputs: &mut [Output]) -> Result<(), PortError> {
    outputs.iter_mut().try_for_each(|output| output.port.look_for_readers())
}

/// Whether another operator was active since, which does not save like this one.
fn is_old(
    places: &Places,
    inputs: &[Input],
    outputs: &[Output],
    answered: &[(Option<SampleId>, InputCounts)],
    sent: &[Option<SampleId>],
    is_source: bool,
) -> bool {
    for (input, (place, _)) in inputs.iter().zip(answered) {
        let last = places.inputs.get(&input.name).and_then(|(last, _)| *last);
        if place.is_some_and(|place| input.port.is_after(place, last)) {
            return true;
        }
    }
    is_source
        && outputs.iter().zip(sent).any(|(output, sent)| {
            let last = places.outputs.get(&output.name).and_then(|(last, _)| *last);
            sent.is_some_and(|sent| !is_at_most(sent, last))
        })
}

/// Whether a sample is `other` or before it in the same epoch.
pub(super) fn is_at_most(key: SampleId, other: Option<SampleId>) -> bool {
    other.is_some_and(|other| key.epoch == other.epoch && key.seq <= other.seq)
}

fn read_answers(rest: &mut &[u8], n_answers: u64, output: Option<&Output>) -> anyhow::Result<VecDeque<RawAnswer>> {
    let mut answers = VecDeque::new();
    for _ in 0..n_answers {
        let n_head = take_length(rest).context("a saved answer of the node is cut off")?;
        let n_items = take_length(rest).context("a saved answer of the node is cut off")?;
        let head = rest.split_off(..n_head).context("a saved answer of the node is cut off")?.to_vec();
        let items = rest.split_off(..n_items).context("a saved answer of the node is cut off")?.to_vec();
        let Some(output) = output else { continue };
        let header = output.port.header_of(&head).context("a saved answer of the node is of another message")?;
        answers.push_back(RawAnswer { header, head, items });
    }
    Ok(answers)
}

fn take_length(rest: &mut &[u8]) -> Option<usize> {
    let bytes = rest.split_off(..8)?;
    usize::try_from(u64::from_ne_bytes(bytes.try_into().ok()?)).ok()
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::Header;

    use super::*;
    use crate::host::ports::{Check, RawSample};

    fn id(seq: u64) -> SampleId {
        SampleId { epoch: 3, seq }
    }

    fn answer(seq: u64, items: &[u8]) -> RawAnswer {
        let header = Header { epoch: 3, seq, ..Header::default() };
        RawAnswer { header, head: seq.to_ne_bytes().to_vec(), items: items.to_vec() }
    }

    /// An output whose readers have answered up to a sample.
    struct Answered(Option<SampleId>);

    impl OutputPort for Answered {
        fn send(
            &mut self,
            _: &RawAnswer,
            _: &mut dyn FnMut() -> bool,
            _: Option<Check<'_>>,
        ) -> Result<Sent, PortError> {
            Ok(Sent::Yes)
        }
        fn send_beside(&self, _: &RawAnswer) -> Result<(), PortError> {
            Ok(())
        }
        fn end_comparison(&mut self) {}
        fn look_for_readers(&mut self) -> Result<(), PortError> {
            Ok(())
        }
        fn begin(&mut self, _: bool) -> Option<SampleId> {
            self.0
        }
        fn known(&self, _: bool) -> Option<SampleId> {
            self.0
        }
        fn last(&self) -> Option<SampleId> {
            None
        }
        fn has_readers(&self) -> bool {
            true
        }
        fn answered_by_readers(&self) -> Option<SampleId> {
            self.0
        }
        fn wait_limit(&self) -> Duration {
            Duration::ZERO
        }
        fn has_waited(&self, _: Duration) {}
        fn give_up_attached_that_lack(&self, _: SampleId, _: Duration) -> bool {
            false
        }
        fn header_of(&self, head: &[u8]) -> Option<Header> {
            let seq = u64::from_ne_bytes(head.try_into().ok()?);
            Some(Header { epoch: 3, seq, ..Header::default() })
        }
        fn with_header(&self, head: &[u8], _: Header) -> Vec<u8> {
            head.to_vec()
        }
        fn n_items(&self, _: &[u8], items: &[u8]) -> Option<usize> {
            Some(items.len())
        }
        fn n_bytes(&self, n_items: usize) -> usize {
            8 + n_items
        }
    }

    /// An input whose writer is in one epoch.
    struct OfOneEpoch;

    impl InputPort for OfOneEpoch {
        fn connect(&mut self) -> Result<bool, PortError> {
            Ok(true)
        }
        fn receive(&mut self) -> Result<Option<RawSample>, PortError> {
            Ok(None)
        }
        fn put_back(&mut self, _: Vec<RawSample>) {}
        fn take_over(&mut self, _: Option<SampleId>) {}
        fn take_over_at(&mut self, _: Option<SampleId>, _: InputCounts) {}
        fn look_on_from(&mut self, _: SampleId) {}
        fn commit(&self, _: &RawSample) {}
        fn is_caught_up(&self) -> bool {
            true
        }
        fn is_cut_off(&self) -> bool {
            false
        }
        fn hold_deadline(&self) -> Option<Instant> {
            None
        }
        fn place(&self) -> (Option<SampleId>, InputCounts) {
            (None, InputCounts::default())
        }
        fn is_after(&self, key: SampleId, other: Option<SampleId>) -> bool {
            other.is_none_or(|other| other.seq < key.seq)
        }
    }

    fn input(name: &str, last: Option<SampleId>) -> Input {
        let port = Box::new(OfOneEpoch);
        let (name, counts) = (name.into(), InputCounts { n_received: 8, ..InputCounts::default() });
        Input { idx: 0, name, is_feedback: false, port, onlooker: None, last, counts }
    }

    fn output(name: &str, answered: Option<SampleId>) -> Output {
        Output::new(0, name, None, None, Box::new(Answered(answered)))
    }

    #[test]
    fn the_next_instance_sends_what_readers_lack_as_it_was() {
        let (inputs, mut outputs) = ([input("left", Some(id(7)))], [output("b", None), output("a", None)]);
        for seq in 0..3 {
            outputs[0].keep(answer(seq, b"items"));
        }
        outputs[1].keep(answer(9, b""));
        let mut bytes = Vec::new();
        encode(&inputs, &outputs, true, b"mine", &mut bytes).expect("encoded");
        let content = bytes.strip_prefix(MAGIC).expect("its beginning");
        let (places, n_bytes): (Places, _) = bincode::serde::decode_from_slice(content, STATE_FORMAT).expect("places");
        // Readers of b have 0, those of a have nothing; the operator has another input now.
        let (mut inputs, mut outputs) =
            ([input("left", None), input("new", None)], [output("a", None), output("b", Some(id(0)))]);
        let state = take_in(&places, &content[n_bytes..], &mut inputs, &mut outputs, false).expect("read");
        assert_eq!((&state[..], places.is_done), (&b"mine"[..], true));
        assert_eq!((inputs[0].last, inputs[0].counts.n_received, inputs[1].last), (Some(id(7)), 8, None));
        let [a, b] = outputs;
        assert_eq!((a.saved.first_sent(), a.last, a.saved.entries().len()), (None, Some(id(9)), 1));
        assert_eq!((b.saved.next(), b.last), (Some(&answer(1, b"items")), Some(id(2))));
        for n_bytes_kept in n_bytes..content.len() - 4 {
            let cut = &content[n_bytes..n_bytes_kept];
            assert!(take_in(&places, cut, &mut [], &mut [output("a", None)], false).is_err(), "{n_bytes_kept}");
        }
    }

    #[test]
    fn answers_that_all_readers_have_are_saved_no_more() {
        let mut output = output("a", Some(id(1)));
        (0..4).for_each(|seq| output.keep(answer(seq, b"")));
        assert!(!output.forget(), "nothing was sent");
        (0..3).for_each(|_| output.saved.has_sent_next());
        assert!(output.forget());
        assert_eq!((output.saved.entries().len(), output.saved.first_sent()), (2, Some(id(2))));
        assert_eq!(output.n_saved_bytes(), 2 * (ENTRY_BYTES + 8));
    }

    #[test]
    fn what_another_operator_did_meanwhile_makes_a_state_old() {
        let places =
            |last| Places { inputs: [("a".into(), (last, InputCounts::default()))].into(), ..Places::default() };
        let is_old = |saved: Option<u64>, answered: u64| {
            let input = input("a", None);
            let answered = [(Some(id(answered)), InputCounts::default())];
            is_old(&places(saved.map(id)), &[input], &[], &answered, &[], false)
        };
        assert!(!is_old(Some(7), 7));
        assert!(!is_old(Some(8), 7), "saved, and not marked as answered yet");
        assert!(is_old(Some(6), 7));
        assert!(is_old(None, 7));
        let outputs = [output("a", None)];
        let saved = Places { outputs: [("a".into(), (Some(id(4)), 0))].into(), ..Places::default() };
        for (sent, expected) in [(4, false), (5, true)] {
            assert_eq!(super::is_old(&saved, &[], &outputs, &[], &[Some(id(sent))], true), expected);
        }
    }
}
