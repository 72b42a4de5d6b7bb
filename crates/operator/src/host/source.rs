//! A hosted operator that has samples of its own, and perhaps feedback inputs.
//!
//! A source that can give its samples again (`resumes`) numbers them itself, and those that readers have are dropped. The
//! samples of any other come once: they are numbered one by one, and each is saved before it is sent, until all readers
//! have answered it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde_json::{Map, Value};

use super::child::Program;
use super::listen;
use super::ports::RawAnswer;
use super::protocol::{Ask, FINISHED, NOTHING_YET, Part, Ready, Resume, Work};
use super::stage::{next_key, open_inputs, open_outputs, output_of};
use super::store::{Input, Output, Store, is_at_most, look_for_readers};
use crate::cursors::SampleId;
use crate::description::OperatorDescription;
use crate::monotonic_nanos;
use crate::operator::Operator;
use crate::port::Sent;
use crate::source::{self, Source, Step};

const DEFAULT_PAUSE: Duration = Duration::from_millis(5);
/// A longer pause is cut to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

struct HostedSource {
    operator: Operator,
    child: Program,
    ready: Ready,
    inputs: Vec<Input>,
    outputs: Vec<Output>,
    /// Of a source whose samples come once.
    store: Option<Store>,
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
    let (inputs, _) = open_inputs(operator, description)?;
    let outputs = open_outputs(operator, description, &ready, false)?;
    let store = if ready.resumes { None } else { Some(Store::new(operator)?) };
    let mut n_next_bytes = 0;
    if store.is_some() {
        for output in &outputs {
            // Without a limit, a sample that is too large is found when it comes.
            n_next_bytes += output.max_bytes().unwrap_or(0);
        }
        let n_most = Store::room(&inputs, &outputs);
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
        operator: operator.clone(),
        child,
        ready,
        inputs,
        outputs,
        store,
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
        for output in &mut self.outputs {
            output.known = output.port.begin(is_handed_over);
        }
        match &mut self.store {
            None => {
                self.is_done = false;
                for input in &mut self.inputs {
                    let (last, _) = input.port.place();
                    input.port.take_over(last);
                }
                let mut places = Resume::new();
                for output in &self.outputs {
                    places.insert(output.name.clone(), output.known.map(|known| (known.epoch, known.seq)));
                }
                self.child.ask_json(Ask::Resume, &places)?;
                self.child.answer(Ask::Resume)?.done()?;
            }
            Some(store) => {
                let restored = store.restore(&mut self.inputs, &mut self.outputs, is_handed_over, true)?;
                self.is_done = restored.is_done;
                for input in &mut self.inputs {
                    input.port.take_over_at(input.last, input.counts);
                }
                if self.ready.has_state {
                    self.state = super::restore(&mut self.child, restored.state.as_deref())?.state;
                }
            }
        }
        Ok(true)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let step = self.take_step();
        super::log(&self.operator, self.child.lines());
        step
    }

    fn look(&mut self) -> anyhow::Result<()> {
        look_for_readers(&mut self.outputs)?;
        for input in &mut self.inputs {
            input.port.connect()?;
        }
        listen(&self.operator, &mut self.child)?;
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
        self.outputs.first()?.port.last().map(|last| last.seq + 1)
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
        if let Some(store) = &self.store
            && store.send(&mut self.outputs, false, |_, _, _, _| true)? == Sent::GaveWay
        {
            return Ok(Step::GaveWay);
        }
        if !self.receive()? {
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
        if let Some(store) = &self.store {
            let n_bytes = self.n_next_bytes + self.state.len();
            if store.wait_for_room(&self.inputs, &mut self.outputs, n_bytes)? == Sent::GaveWay {
                return Ok(Step::GaveWay);
            }
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
        let sent = if self.store.is_some() { self.save_and_send(work)? } else { self.send_again(&work.parts)? };
        Ok(Step::from(sent))
    }

    /// Takes in the samples of feedback inputs; false if it was asked to give way.
    fn receive(&mut self) -> anyhow::Result<bool> {
        for idx in 0..self.inputs.len() {
            while let Some(sample) = self.inputs[idx].port.receive()? {
                self.operator.beat();
                let own = std::iter::once((self.inputs[idx].idx, &sample.head[..], &sample.items[..]));
                self.child.ask(Ask::Sample, monotonic_nanos(), 0, &[], own)?;
                let work = self.child.answer(Ask::Sample)?.done()?;
                if !work.parts.is_empty() {
                    anyhow::bail!(
                        "its program answered feedback with a sample: expected that it gives its samples when asked for the next"
                    );
                }
                let input = &mut self.inputs[idx];
                if !is_at_most(sample.key(), input.last) {
                    input.last = Some(sample.key());
                }
                input.counts = sample.counts;
                self.ask_at = None;
                if let Some(store) = &mut self.store {
                    if self.ready.has_state {
                        self.state = work.state;
                    }
                    if store.save(&self.inputs, &mut self.outputs, &self.state, true)? == Sent::GaveWay {
                        self.inputs[idx].port.put_back(vec![sample]);
                        return Ok(false);
                    }
                }
                self.inputs[idx].port.commit(&sample);
            }
        }
        Ok(true)
    }

    fn end(&mut self, work: Work) -> anyhow::Result<Step> {
        match &mut self.store {
            None => {
                // An end before the sample after which it was to go on: it is not the same stream.
                if let Some((output, known)) = self.outputs.iter().find_map(|output| Some((output, output.known?))) {
                    anyhow::bail!(
                        "it ended without sample {} of the output {}, which readers have: expected that after `resume`, \
                         `next` gives that sample or one before it, and then the same samples again",
                        known.seq,
                        output.name
                    );
                }
            }
            Some(store) => {
                store.has_ended();
                if self.ready.has_state {
                    self.state = work.state;
                }
                if store.save(&self.inputs, &mut self.outputs, &self.state, true)? == Sent::GaveWay {
                    return Ok(Step::GaveWay);
                }
            }
        }
        self.is_done = true;
        Ok(Step::Next)
    }

    /// Numbers samples, saves and sends them.
    fn save_and_send(&mut self, work: Work) -> anyhow::Result<Sent> {
        for part in work.parts {
            let idx = output_of(&self.outputs, &part)?;
            let output = &mut self.outputs[idx];
            if let Some(last) = &mut output.last {
                last.seq += u64::from(part.n_lost);
            }
            let mut header = output.port.header_of(&part.head).unwrap_or_default();
            let next = next_key(&self.outputs, idx);
            (header.epoch, header.seq, header.origin_nanos) = (next.epoch, next.seq, monotonic_nanos());
            let output = &mut self.outputs[idx];
            let head = output.port.with_header(&part.head, header);
            output.keep(RawAnswer { header, head, items: part.items });
        }
        if self.ready.has_state {
            self.state = work.state;
        }
        let Some(store) = &mut self.store else { return Ok(Sent::Yes) };
        // A device cannot give a reading again: it is saved before another instance takes over, which then sends it.
        if store.save(&self.inputs, &mut self.outputs, &self.state, false)? == Sent::GaveWay {
            return Ok(Sent::GaveWay);
        }
        Ok(store.send(&mut self.outputs, false, |_, _, _, _| true)?)
    }

    /// Sends samples unless readers have them.
    fn send_again(&mut self, parts: &[Part]) -> anyhow::Result<Sent> {
        for part in parts {
            let idx = output_of(&self.outputs, part)?;
            let output = &mut self.outputs[idx];
            let mut header = output.port.header_of(&part.head).unwrap_or_default();
            let key = SampleId { epoch: header.epoch, seq: header.seq };
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
            header.origin_nanos = monotonic_nanos();
            let head = output.port.with_header(&part.head, header);
            let answer = RawAnswer { header, head, items: part.items.clone() };
            let operator = &self.operator;
            if output.port.send(&answer, &mut || operator.should_yield(), None)? == Sent::GaveWay {
                return Ok(Sent::GaveWay);
            }
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
