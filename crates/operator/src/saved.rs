//! The saved state of a node, for the instance that takes over: how far it has come, by port name, the answers that readers may still
//! need, and the bytes of its worker's own state.
//!
//! It is saved as a whole, before the answers are sent: a kill at any moment neither loses an answer nor makes another one
//! under its number. An instance of another language reads it as well.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use anyhow::Context as _;
use blindgrasp_messages::Header;
use blindgrasp_messages::zerocopy::{FromBytes as _, IntoBytes as _};

use crate::cursors::{STATE_BYTES, SampleId};
use crate::engine::{Site, Yields};
use crate::outbox::{Entry, Kept};
use crate::port::{Sent, sample_id};
use crate::wiring::InputCounts;
use crate::written::Written;

/// Numbers have a fixed size, which costs bytes but hardly any time.
const FORMAT: bincode::config::Configuration<bincode::config::LittleEndian, bincode::config::Fixint> =
    bincode::config::standard().with_fixed_int_encoding();
/// The beginning of what is saved. Sources in Rust save bytes of their own, which do not begin like this.
const MAGIC: &[u8] = b"bg-node2";
/// An upper bound of the bytes that are saved for each port besides its answers, and for the rest.
const PORT_BYTES: usize = 256;
/// The numbers that are saved with an answer: the lengths of its head and of both.
const ENTRY_BYTES: usize = 16;

/// How far the node has come with an input.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Input {
    pub(crate) name: Rc<str>,
    pub(crate) is_feedback: bool,
    /// The last sample that was answered, with the counts of that time.
    pub(crate) last: Option<SampleId>,
    pub(crate) counts: InputCounts,
    /// The counts include the samples up to here. It is after `last` while samples are answered again.
    pub(crate) counted: Option<SampleId>,
}

impl Input {
    pub(crate) fn new(name: &str, is_feedback: bool) -> Input {
        Input { name: name.into(), is_feedback, last: None, counts: InputCounts::default(), counted: None }
    }
}

/// An output, and the answers that were saved before they were sent, until all readers have answered them.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Output {
    pub(crate) name: Rc<str>,
    pub(crate) numbers: Numbers,
    /// Up to this sample, readers have all that an earlier instance has sent.
    pub(crate) known: Option<SampleId>,
    /// The last sample that was saved.
    pub(crate) last: Option<SampleId>,
    pub(crate) kept: Kept,
}

/// The numbers of the answers on an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Numbers {
    /// The worker numbers them, or leaves the header empty: then it is that of the sample.
    OfWorker,
    /// Each sample has one answer, under its own number.
    OfSample,
    /// As [`Numbers::OfSample`], for the samples of this input alone; `None`: of one that is not connected.
    OfInput(Option<usize>),
    /// They are counted.
    Counted,
}

impl Output {
    pub(crate) fn new(name: &str, numbers: Numbers) -> Output {
        Output { name: name.into(), numbers, known: None, last: None, kept: Kept::default() }
    }
}

/// The places of a node's ports, and the answers that are saved with them.
#[derive(Debug)]
#[cfg_attr(test, derive(Clone, PartialEq, Eq, Hash))]
pub(crate) struct Book {
    pub(crate) inputs: Vec<Input>,
    pub(crate) outputs: Vec<Output>,
    /// A source has no more samples.
    pub(crate) is_done: bool,
    scratch: Scratch,
}

/// Memory that is used again.
#[derive(Debug, Default)]
struct Scratch {
    bytes: Vec<u8>,
    entries: Vec<Vec<u8>>,
}

/// A saved state as it is read.
struct Found<'a> {
    inputs: BTreeMap<String, (Option<SampleId>, InputCounts, Option<SampleId>)>,
    outputs: BTreeMap<String, (Option<SampleId>, VecDeque<Entry>)>,
    is_done: bool,
    state: &'a [u8],
}

impl Book {
    pub(crate) fn new(inputs: Vec<Input>, outputs: Vec<Output>) -> Book {
        Book { inputs, outputs, is_done: false, scratch: Scratch::default() }
    }

    /// Takes an answer that is to be saved and then sent.
    pub(crate) fn keep(&mut self, output: usize, header: &Header, head: &[u8], items: &[u8]) {
        let mut bytes = self.scratch.entries.pop().unwrap_or_default();
        bytes.clear();
        bytes.extend_from_slice(head);
        bytes.extend_from_slice(items);
        header.write_to_prefix(&mut bytes).expect("a head begins with its header");
        let key = sample_id(header);
        let output = &mut self.outputs[output];
        output.last = Some(key);
        output.kept.push(Entry { key, n_head_bytes: head.len(), bytes });
    }

    /// The first output with an answer that is saved and was not sent.
    pub(crate) fn unsent(&self) -> Option<usize> {
        self.outputs.iter().position(|output| output.kept.next().is_some())
    }

    /// The number of the next sample of an output that counts.
    pub(crate) fn next_key(&self, output: usize) -> SampleId {
        if let Some(last) = self.outputs[output].last {
            return SampleId { epoch: last.epoch, seq: last.seq + 1 };
        }
        // The first one of a node begins its epoch.
        let epoch = self.outputs.iter().find_map(|output| output.last).map_or_else(unix_nanos, |last| last.epoch);
        SampleId { epoch, seq: 0 }
    }

    /// The most bytes that answers and state may take.
    pub(crate) fn room(&self) -> usize {
        STATE_BYTES - PORT_BYTES * (1 + self.inputs.len() + self.outputs.len())
    }

    /// The bytes that an answer takes besides its head and items.
    pub(crate) const fn n_bytes_saved(n_bytes: usize) -> usize {
        ENTRY_BYTES + n_bytes
    }

    /// Saves all, with the worker's state that `state` adds. `GaveWay` if it was asked to while it waited for the readers of
    /// answers that must stay saved.
    ///
    /// # Errors
    /// State and answers take too much, or a reader stands still.
    pub(crate) fn save<S: Site>(
        &mut self,
        site: &mut S,
        yields: Yields,
        state: impl Fn(&mut Vec<u8>) -> anyhow::Result<()>,
    ) -> anyhow::Result<Sent> {
        while !self.save_if_it_fits(site, &state)? {
            let Some((output, first)) = self.first_sent() else {
                // The site says how long it may be.
                site.save_state(&self.scratch.bytes)?;
                break;
            };
            if self.wait_for_answers(site, output, first, yields)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
        Ok(Sent::Yes)
    }

    /// As [`Book::save`], without waiting; false if state and answers take too much.
    ///
    /// # Errors
    /// The state cannot be encoded.
    pub(crate) fn save_if_it_fits<S: Site>(
        &mut self,
        site: &mut S,
        state: &impl Fn(&mut Vec<u8>) -> anyhow::Result<()>,
    ) -> anyhow::Result<bool> {
        self.forget(site);
        self.scratch.bytes.clear();
        encode(&self.inputs, &self.outputs, self.is_done, &mut self.scratch.bytes)?;
        state(&mut self.scratch.bytes)?;
        let fits = self.scratch.bytes.len() <= S::STATE_BYTES;
        if fits {
            site.save_state(&self.scratch.bytes)?;
        }
        Ok(fits)
    }

    /// Waits until so many bytes may be saved. `GaveWay` if it was asked to, or to stop.
    ///
    /// # Errors
    /// A reader stands still.
    pub(crate) fn wait_for_room<S: Site>(&mut self, site: &mut S, n_bytes: usize) -> anyhow::Result<Sent> {
        loop {
            self.forget(site);
            let kept = self.outputs.iter().flat_map(|output| output.kept.entries());
            let n_kept: usize = kept.map(|entry| ENTRY_BYTES + entry.bytes.len()).sum();
            let n_ports = 1 + self.inputs.len() + self.outputs.len();
            if n_kept + n_bytes + PORT_BYTES * n_ports <= S::STATE_BYTES {
                return Ok(Sent::Yes);
            }
            let Some((output, first)) = self.first_sent() else { return Ok(Sent::Yes) };
            if self.wait_for_answers(site, output, first, Yields::OrToStop)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
        }
    }

    /// Waits until the readers have answered a kept answer, and drops it.
    fn wait_for_answers<S: Site>(
        &mut self,
        site: &mut S,
        output: usize,
        first: SampleId,
        yields: Yields,
    ) -> anyhow::Result<Sent> {
        let n_kept = self.outputs[output].kept.entries().len();
        if site.wait_for_answers(output, first, yields)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        self.forget(site);
        let Output { name, kept, .. } = &self.outputs[output];
        let SampleId { epoch, seq } = first;
        anyhow::ensure!(
            kept.entries().len() < n_kept,
            "the readers of output {name} have answered sample {seq} of epoch {epoch}, but it is still kept, and the state has no \
             room: this is an error in blindgrasp"
        );
        Ok(Sent::Yes)
    }

    /// Of the output whose answers take most, the first answer that was sent.
    fn first_sent(&self) -> Option<(usize, SampleId)> {
        let mut found = None;
        let mut most = 0;
        for (idx, output) in self.outputs.iter().enumerate() {
            let n_bytes: usize = output.kept.entries().iter().map(|entry| entry.bytes.len()).sum();
            if let Some(first) = output.kept.first_sent()
                && n_bytes >= most
            {
                (found, most) = (Some((idx, first)), n_bytes);
            }
        }
        found
    }

    /// Drops the answers that all readers have answered.
    fn forget<S: Site>(&mut self, site: &S) {
        for (idx, output) in self.outputs.iter_mut().enumerate() {
            let forgotten = output.kept.forget(site.has_readers(idx), site.answered_by_readers(idx), site.written(idx));
            self.scratch.entries.extend(forgotten.map(|entry| entry.bytes));
        }
    }

    /// Takes over what the node's active instance has saved last: the worker's state, or `None` if nothing was saved that this
    /// instance can go on with. Then a source goes on after the last sample that was sent, a stage after the last one that was
    /// answered.
    ///
    /// # Errors
    /// Another version has saved it.
    pub(crate) fn restore<S: Site>(&mut self, site: &S, is_source: bool) -> anyhow::Result<Option<Vec<u8>>> {
        // The places come first: for a standby, the active instance goes on meanwhile, and its saved state is never behind them.
        let answered: Vec<_> = (0..self.inputs.len()).map(|idx| site.place(idx)).collect();
        let sent: Vec<_> = (0..self.outputs.len()).map(|idx| site.written(idx)).collect();
        self.is_done = false;
        let saved = site.saved_state();
        let found = match saved.as_deref() {
            Some(bytes) if bytes.starts_with(MAGIC) || !is_source => Some(read(bytes)?),
            _ => None,
        };
        if let Some(found) = found {
            if !self.is_old(&found, site, &answered, &sent, is_source) {
                let state = found.state.to_vec();
                self.take_in(found, &sent);
                return Ok(Some(state));
            }
            tracing::info!("the saved state is older than the last samples of this node: it is not used");
        }
        for (input, (last, counts)) in self.inputs.iter_mut().zip(answered) {
            (input.last, input.counts, input.counted) = (last, counts, last);
        }
        for (output, written) in self.outputs.iter_mut().zip(sent) {
            (output.last, output.kept) = (written.map(|written| written.last), Kept::default());
        }
        Ok(None)
    }

    /// Takes over which samples are counted, for an instance that saves nothing and makes the saved answers again. The cursor
    /// says that, except where the instance before was to answer counted samples again.
    ///
    /// # Errors
    /// As [`Book::restore`].
    pub(crate) fn restore_counts<S: Site>(&mut self, site: &S) -> anyhow::Result<()> {
        self.restore(site, false)?;
        for (idx, input) in self.inputs.iter_mut().enumerate() {
            let (cursor, counts) = site.place(idx);
            // A sample that was saved and not committed is counted when it is answered again.
            if input.counts.n_received != counts.n_received {
                (input.counted, input.counts) = (cursor, counts);
            }
        }
        self.outputs.iter_mut().for_each(|output| output.kept = Kept::default());
        Ok(())
    }

    fn take_in(&mut self, mut found: Found<'_>, sent: &[Option<Written>]) {
        self.is_done = found.is_done;
        for input in &mut self.inputs {
            let saved = found.inputs.get(&*input.name).copied();
            (input.last, input.counts, input.counted) = saved.unwrap_or_default();
        }
        for (output, written) in self.outputs.iter_mut().zip(sent) {
            let saved = found.outputs.remove(&*output.name);
            let (last, entries) = saved.unwrap_or((output.last, VecDeque::new()));
            (output.last, output.kept) = (last, Kept::restored(entries, output.known, *written));
        }
    }

    /// Whether another operator was active since, which does not save like this one.
    fn is_old<S: Site>(
        &self,
        found: &Found<'_>,
        site: &S,
        answered: &[(Option<SampleId>, InputCounts)],
        sent: &[Option<Written>],
        is_source: bool,
    ) -> bool {
        for (idx, (input, (place, _))) in self.inputs.iter().zip(answered).enumerate() {
            let last = found.inputs.get(&*input.name).and_then(|(last, ..)| *last);
            if place.is_some_and(|place| site.is_after(idx, place, last)) {
                return true;
            }
        }
        is_source
            && self.outputs.iter().zip(sent).any(|(output, sent)| {
                let last = found.outputs.get(&*output.name).and_then(|(last, _)| *last);
                sent.is_some_and(|sent| !is_at_most(sent.last, last))
            })
    }
}

/// The worker's own state in what was saved.
///
/// # Errors
/// It was saved by another version.
pub(crate) fn state_in(bytes: &[u8]) -> anyhow::Result<&[u8]> {
    Ok(read(bytes)?.state)
}

/// Whether a sample is `other` or before it in the same epoch.
pub(crate) fn is_at_most(key: SampleId, other: Option<SampleId>) -> bool {
    other.is_some_and(|other| key.epoch == other.epoch && key.seq <= other.seq)
}

fn unix_nanos() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Realtime);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

fn encode(inputs: &[Input], outputs: &[Output], is_done: bool, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
    bytes.extend_from_slice(MAGIC);
    put((inputs.len() as u64, outputs.len() as u64, is_done), bytes)?;
    for input in inputs {
        put((&*input.name, input.last, input.counts, input.counted), bytes)?;
    }
    for output in outputs {
        let kept = output.kept.entries();
        put((&*output.name, output.last, kept.len() as u64), bytes)?;
        for entry in kept {
            put((entry.n_head_bytes as u64, entry.bytes.len() as u64), bytes)?;
            bytes.extend_from_slice(&entry.bytes);
        }
    }
    Ok(())
}

fn read(bytes: &[u8]) -> anyhow::Result<Found<'_>> {
    read_whole(bytes).context("the node's saved state cannot be read: an operator of another version has saved it")
}

fn read_whole(bytes: &[u8]) -> Option<Found<'_>> {
    let mut rest = bytes.strip_prefix(MAGIC)?;
    let (n_inputs, n_outputs, is_done): (u64, u64, bool) = take(&mut rest)?;
    let (mut inputs, mut outputs) = (BTreeMap::new(), BTreeMap::new());
    for _ in 0..n_inputs {
        let (name, last, counts, counted) = take(&mut rest)?;
        inputs.insert(name, (last, counts, counted));
    }
    for _ in 0..n_outputs {
        let (name, last, n_answers): (String, Option<SampleId>, u64) = take(&mut rest)?;
        let mut entries = VecDeque::new();
        for _ in 0..n_answers {
            entries.push_back(take_entry(&mut rest)?);
        }
        outputs.insert(name, (last, entries));
    }
    Some(Found { inputs, outputs, is_done, state: rest })
}

/// Adds a value to `bytes`.
pub(crate) fn put(value: impl serde::Serialize, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
    bincode::serde::encode_into_std_write(value, bytes, FORMAT)?;
    Ok(())
}

/// Takes the value with which `rest` begins.
pub(crate) fn take<T: serde::de::DeserializeOwned>(rest: &mut &[u8]) -> Option<T> {
    let (value, n_bytes) = bincode::serde::decode_from_slice(rest, FORMAT).ok()?;
    *rest = &rest[n_bytes..];
    Some(value)
}

fn take_entry(rest: &mut &[u8]) -> Option<Entry> {
    let (n_head_bytes, n_bytes): (u64, u64) = take(rest)?;
    let bytes = rest.split_off(..usize::try_from(n_bytes).ok()?)?.to_vec();
    let n_head_bytes = usize::try_from(n_head_bytes).ok()?;
    let head = bytes.get(..n_head_bytes)?;
    let (header, _) = Header::read_from_prefix(head).ok()?;
    Some(Entry { key: sample_id(&header), n_head_bytes, bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Clone for Scratch {
        fn clone(&self) -> Self {
            Scratch::default()
        }
    }

    impl PartialEq for Scratch {
        fn eq(&self, _: &Self) -> bool {
            true
        }
    }

    impl Eq for Scratch {}

    impl std::hash::Hash for Scratch {
        fn hash<H: std::hash::Hasher>(&self, _: &mut H) {}
    }

    fn id(seq: u64) -> SampleId {
        SampleId { epoch: 3, seq }
    }

    #[test]
    fn the_next_instance_sends_what_readers_lack_as_it_was() {
        let output = |name, known| Output { known, ..Output::new(name, Numbers::Counted) };
        let counts = InputCounts { n_received: 8, ..InputCounts::default() };
        let left = Input { last: Some(id(7)), counts, counted: Some(id(9)), ..Input::new("left", false) };
        let mut book = Book::new(vec![left], vec![output("b", None), output("a", None)]);
        for (to, seq) in [(0, 0), (0, 1), (0, 2), (1, 9)] {
            let header = Header { epoch: 3, seq, ..Header::default() };
            book.keep(to, &header, &[0; size_of::<Header>()], b"items");
        }
        let mut bytes = Vec::new();
        encode(&book.inputs, &book.outputs, true, &mut bytes).expect("encoded");
        let n_bytes = bytes.len();
        bytes.extend_from_slice(b"mine");
        // Readers of b have 0, those of a have nothing; the operator has another input now.
        let inputs = vec![Input::new("new", false), Input::new("left", false)];
        let mut next = Book::new(inputs, vec![output("a", None), output("b", Some(id(0)))]);
        let found = read(&bytes).expect("read");
        assert_eq!(found.state, b"mine");
        next.take_in(found, &[None, Some(Written { last: id(0), first_seq: 0, before: None })]);
        assert!(next.is_done);
        assert!(is_at_most(id(7), Some(id(7))) && !is_at_most(id(7), Some(SampleId { epoch: 4, seq: 7 })));
        assert_eq!((next.inputs[0].last, &next.inputs[1]), (None, &book.inputs[0]));
        let [a, b] = &next.outputs[..] else { panic!("two outputs") };
        assert_eq!((a.kept.first_sent(), a.last, a.kept.entries().len()), (None, Some(id(9)), 1));
        assert_eq!((b.kept.next(), b.last), (book.outputs[0].kept.entries().get(1), Some(id(2))));
        for n_bytes_kept in 0..n_bytes {
            assert!(read(&bytes[..n_bytes_kept]).is_err(), "{n_bytes_kept}");
        }
    }
}
