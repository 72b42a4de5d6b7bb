//! A hosted operator that has samples of its own, and perhaps feedback inputs.
//!
//! A source that can give its samples again (`resumes`) numbers them itself, and those that readers have are dropped. The
//! samples of any other come once: they are numbered one by one, and each is saved before it is sent, until all readers
//! have answered it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blindgrasp_messages::Header;
use serde_json::{Map, Value};

use super::child::Program;
use super::listen;
use super::ports::{HostedOutput, output_of};
use super::protocol::{Ask, FINISHED, NOTHING_YET, Part, Ready, Resume, Work};
use super::stage::HostedPorts;
use crate::cursors::SampleId;
use crate::description::OperatorDescription;
use crate::engine::{Received, Site as _, Yields, header_of, with_header};
use crate::monotonic_nanos;
use crate::operator::Operator;
use crate::port::{Sent, sample_id};
use crate::runner::Ports;
use crate::saved::{Book, is_at_most};
use crate::source::{self, Source, Step};

const DEFAULT_PAUSE: Duration = Duration::from_millis(5);
/// A longer pause is cut to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

struct HostedSource {
    child: Program,
    ready: Ready,
    site: Ports,
    book: Book,
    /// The numbers of the inputs in the description.
    inputs: Vec<usize>,
    outputs: Vec<HostedOutput>,
    /// Its samples come once.
    saves: bool,
    /// The state of the program after the last message.
    state: Vec<u8>,
    pause: Duration,
    /// When it is asked again, after it had nothing.
    ask_at: Option<Instant>,
    is_open: bool,
    is_done: bool,
    /// Of a source that resumes: the samples of each output that came from it.
    came: BTreeMap<usize, Came>,
    has_warned: bool,
    /// Room that the next sample may take.
    n_next_bytes: usize,
}

/// Runs the source of a program until the operator is asked to stop.
///
/// # Errors
/// The reason of the program or of a port.
pub(super) fn run(
    operator: &Operator,
    description: &OperatorDescription,
    ready: Ready,
    child: Program,
) -> anyhow::Result<()> {
    let HostedPorts { site, book, inputs, outputs, .. } = HostedPorts::open(operator, description, &ready, false)?;
    let saves = !ready.resumes;
    let mut n_next_bytes = 0;
    if saves {
        operator.reserve_state()?;
        for output in &outputs {
            // Without a limit, a sample that is too large is found when it comes.
            n_next_bytes +=
                output.max_items.map_or(0, |n_items| Book::n_bytes_saved(output.layout.n_bytes_of(n_items)));
        }
        let n_most = book.room();
        if n_next_bytes > n_most {
            anyhow::bail!(
                "its samples may take {n_next_bytes} bytes, expected at most {n_most}: more cannot be saved until readers have \
                 them; give a smaller max_items, or a `resume` that can give samples again"
            );
        }
    }
    let pause = ready.pause_secs.and_then(|secs| Duration::try_from_secs_f64(secs).ok()).unwrap_or(DEFAULT_PAUSE);
    let identity = ready.identity.clone();
    let mut source = HostedSource {
        child,
        ready,
        site,
        book,
        inputs,
        outputs,
        saves,
        state: Vec::new(),
        pause: pause.min(LONGEST_PAUSE),
        ask_at: None,
        is_open: false,
        is_done: false,
        came: BTreeMap::new(),
        has_warned: false,
        n_next_bytes,
    };
    if !operator.begins_as_standby() {
        source.take_over()?;
    }
    source::run(operator, identity, source)
}

impl Source for HostedSource {
    fn resume(&mut self, is_handed_over: bool) -> anyhow::Result<bool> {
        self.came.clear();
        self.ask_at = None;
        for (idx, output) in self.book.outputs.iter_mut().enumerate() {
            output.known = self.site.begin(idx, is_handed_over);
        }
        if self.saves {
            let state = self.book.restore(&self.site, true)?;
            self.is_done = self.book.is_done;
            for (idx, input) in self.book.inputs.iter().enumerate() {
                self.site.take_over(idx, input, input.last);
            }
            if self.ready.has_state {
                self.state = super::restore(&mut self.child, state.as_deref())?.state;
            }
            return Ok(true);
        }
        self.is_done = false;
        for (idx, input) in self.book.inputs.iter_mut().enumerate() {
            (input.last, input.counts) = self.site.place(idx);
            input.counted = input.last;
            self.site.take_over(idx, input, input.last);
        }
        let mut places = Resume::new();
        for output in &self.book.outputs {
            places.insert(output.name.to_string(), output.known.map(|known| (known.epoch, known.seq)));
        }
        self.child.ask_json(Ask::Resume, &places)?;
        self.child.answer(Ask::Resume)?.done()?;
        Ok(true)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let step = self.take_step();
        super::log(&self.site.operator, self.child.lines());
        step
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.site.look_for_readers()?;
        self.site.connect()?;
        listen(&self.site.operator, &mut self.child)?;
        Ok(())
    }

    fn take_over(&mut self) -> anyhow::Result<()> {
        if !std::mem::replace(&mut self.is_open, true) {
            self.child.ask(Ask::Open, monotonic_nanos(), 0, &[], std::iter::empty())?;
            self.child.answer(Ask::Open)?.done()?;
        }
        Ok(())
    }

    fn close(&mut self) {
        if !std::mem::replace(&mut self.is_open, false) {
            return;
        }
        let closed = self.child.ask(Ask::Close, monotonic_nanos(), 0, &[], std::iter::empty());
        if let Err(error) = closed.and_then(|()| self.child.answer(Ask::Close)?.done()) {
            tracing::error!("its program could not let go of what it had opened: {error}");
        }
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<()> {
        super::set(&mut self.child, params)?.map_err(anyhow::Error::msg)
    }

    fn next_seq(&self) -> Option<u64> {
        if self.outputs.is_empty() { None } else { self.site.written(0).map(|written| written.last.seq + 1) }
    }
}

/// The samples of an output that came.
#[derive(Default)]
struct Came {
    last: Option<SampleId>,
    /// The last one of the epoch before.
    ended: Option<SampleId>,
}

impl Came {
    /// Takes the next sample, and says whether readers take it for one of the epoch before, which they have.
    fn is_of_ended_epoch(&mut self, key: SampleId) -> bool {
        if let Some(last) = self.last.replace(key)
            && last.epoch != key.epoch
        {
            return is_at_most(key, self.ended.replace(last));
        }
        false
    }
}

impl HostedSource {
    /// Takes in feedback, and sends the next sample.
    fn take_step(&mut self) -> anyhow::Result<Step> {
        if self.send_saved()? == Sent::GaveWay || !self.receive()? {
            return Ok(Step::GaveWay);
        }
        if self.is_done {
            return Ok(Step::Done);
        }
        if let Some(at) = self.ask_at
            && Instant::now() < at
        {
            return Ok(Step::Wait(self.ask_at));
        }
        self.ask_at = None;
        let n_bytes = self.n_next_bytes + self.state.len();
        if self.saves && self.book.wait_for_room(&mut self.site, n_bytes)? == Sent::GaveWay {
            return Ok(Step::GaveWay);
        }
        self.child.ask(Ask::Next, monotonic_nanos(), 0, &[], std::iter::empty())?;
        let work = self.child.answer(Ask::Next)?.done()?;
        if work.flags & (FINISHED | NOTHING_YET) != 0 && !work.parts.is_empty() {
            anyhow::bail!(
                "its program gave samples and said that it has none: expected the samples first, and that it says so when it \
                 is asked again"
            );
        }
        if work.flags & FINISHED != 0 {
            return self.end(work);
        }
        if work.flags & NOTHING_YET != 0 {
            // Feedback that comes meanwhile is taken in, and then it is asked at its time.
            self.ask_at = Some(Instant::now() + self.pause);
            return Ok(Step::Wait(self.ask_at));
        }
        let sent = if self.saves { self.save_and_send(work)? } else { self.send_again(&work.parts)? };
        Ok(Step::from(sent))
    }

    /// Takes in the samples of feedback inputs; false if it was asked to give way.
    fn receive(&mut self) -> anyhow::Result<bool> {
        for idx in 0..self.inputs.len() {
            while let Some(Received { sample, counts, .. }) = self.site.receive(idx)? {
                self.site.beat();
                let key = sample_id(sample.header());
                let (head, items) = sample.parts();
                let own = std::iter::once((self.inputs[idx], head, items));
                self.child.ask(Ask::Sample, monotonic_nanos(), 0, &[], own)?;
                let work = self.child.answer(Ask::Sample)?.done()?;
                if !work.parts.is_empty() {
                    anyhow::bail!(
                        "its program answered feedback with a sample: expected that it gives its samples when asked for the next"
                    );
                }
                let input = &mut self.book.inputs[idx];
                if !is_at_most(key, input.last) {
                    (input.last, input.counted) = (Some(key), Some(key));
                }
                input.counts = counts;
                self.ask_at = None;
                self.take_state(work.state);
                if self.save(Yields::ToOthers)? == Sent::GaveWay {
                    self.site.put_back(idx, sample);
                    return Ok(false);
                }
                self.site.commit(idx, key, &counts);
            }
        }
        Ok(true)
    }

    fn take_state(&mut self, state: Vec<u8>) {
        if self.ready.has_state {
            self.state = state;
        }
    }

    fn save(&mut self, yields: Yields) -> anyhow::Result<Sent> {
        if !self.saves {
            return Ok(Sent::Yes);
        }
        let state = &self.state;
        self.book.save(&mut self.site, yields, |bytes| {
            bytes.extend_from_slice(state);
            Ok(())
        })
    }

    /// Sends the saved samples that were not sent.
    fn send_saved(&mut self) -> anyhow::Result<Sent> {
        while let Some(output) = self.book.unsent() {
            let kept = &mut self.book.outputs[output].kept;
            let Some(entry) = kept.next() else { break };
            if self.site.wait_for_room(output, entry.key)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            let (head, items) = entry.parts();
            self.site.send(output, entry.key, head, items)?;
            kept.has_sent_next();
        }
        Ok(Sent::Yes)
    }

    fn end(&mut self, work: Work) -> anyhow::Result<Step> {
        // An end before the sample after which it was to go on: it is not the same stream.
        let known = self.book.outputs.iter().find_map(|output| Some((&output.name, output.known?)));
        if let (false, Some((name, known))) = (self.saves, known) {
            anyhow::bail!(
                "it ended without sample {} of the output {name}, which readers have: expected that after `resume`, `next` gives \
                 that sample or one before it, and then the same samples again",
                known.seq
            );
        }
        self.book.is_done = true;
        self.take_state(work.state);
        if self.save(Yields::ToOthers)? == Sent::GaveWay {
            return Ok(Step::GaveWay);
        }
        self.is_done = true;
        Ok(Step::Next)
    }

    /// Numbers samples, saves and sends them.
    fn save_and_send(&mut self, work: Work) -> anyhow::Result<Sent> {
        for part in work.parts {
            let idx = output_of(&self.outputs, &part)?;
            if let Some(last) = &mut self.book.outputs[idx].last {
                last.seq += u64::from(part.n_lost);
            }
            let next = self.book.next_key(idx);
            let origin_nanos = monotonic_nanos();
            let header = Header { epoch: next.epoch, seq: next.seq, origin_nanos, ..header_of(&part.head) };
            self.book.keep(idx, &header, &part.head, &part.items);
        }
        self.take_state(work.state);
        // A device cannot give a reading again: it is saved before another instance takes over, which then sends it.
        if self.save(Yields::AtTheEnd)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        self.send_saved()
    }

    /// Sends samples unless readers have them.
    fn send_again(&mut self, parts: &[Part]) -> anyhow::Result<Sent> {
        for part in parts {
            let idx = output_of(&self.outputs, part)?;
            let output = &mut self.book.outputs[idx];
            let mut header = header_of(&part.head);
            let key = sample_id(&header);
            let came = self.came.entry(idx).or_default();
            if let Some(before) = came.last
                && is_at_most(key, Some(before))
            {
                let (seq, name, before) = (key.seq, &output.name, before.seq);
                anyhow::bail!("sample {seq} of the output {name} came after {before}, expected a greater number");
            }
            if came.is_of_ended_epoch(key) && !std::mem::replace(&mut self.has_warned, true) {
                tracing::warn!(
                    "sample {} of the output {} is dropped, because readers have the samples of epoch {} up to a greater \
                     number: expected an epoch that was not used before",
                    key.seq,
                    output.name,
                    key.epoch
                );
            }
            if let Some(known) = output.known {
                let is_past = key.epoch == known.epoch && key.seq >= known.seq;
                if is_past {
                    output.known = None;
                }
                if !is_past || key == known {
                    continue;
                }
            }
            if self.site.wait_for_room(idx, key)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
            header.origin_nanos = monotonic_nanos();
            self.site.send(idx, key, &with_header(part.head.clone(), &header), &part.items)?;
        }
        Ok(Sent::Yes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_that_is_used_again_is_told_from_one_that_goes_on() {
        let mut came = Came::default();
        let mut take = |epoch, seq| came.is_of_ended_epoch(SampleId { epoch, seq });
        for (epoch, seq, expected) in
            [(1, 0, false), (1, 1, false), (2, 0, false), (1, 0, true), (3, 0, false), (1, 2, false)]
        {
            assert_eq!(take(epoch, seq), expected, "{epoch}.{seq}");
        }
    }
}
