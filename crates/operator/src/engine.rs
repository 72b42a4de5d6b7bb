//! The rules of a node that answers samples: which one is next, and how answers are numbered, kept, saved, sent and
//! committed. A node also gives way, hands over, takes over, and reads along as a standby.
//!
//! They are one machine without ports, memory or clock. A [`Worker`] computes the answers: a stage in Rust, or a program of
//! another language. All else is reached through a [`Site`]: the ports of an operator ([`runner`](crate::runner)), or a world of
//! the search through all histories (`recovery_model.rs`).

use std::collections::VecDeque;

use blindgrasp_messages::Header;
use blindgrasp_messages::zerocopy::{FromBytes as _, IntoBytes as _};
use serde_json::{Map, Value};

use crate::cursors::SampleId;
use crate::identity::stable_hash;
use crate::port::{PortError, Sent, sample_id};
use crate::saved::{Book, Input, Numbers, state_in};
use crate::wiring::{Clock, InputCounts, OnLate};
use crate::written::Written;

/// A stage that answers each sample may answer so many before it wakes its readers, while more samples wait for it. That saves
/// most of the wake-ups.
const MOST_UNRUNG: u32 = 8;
/// The most samples that a worker gets at once, and the number that it gets one by one after one has killed it, so that the
/// launcher learns which.
pub(crate) const MAX_BATCH: usize = 256;
/// A standby reports that it is warm after so many samples.
const N_WARM: u64 = 8;

/// A sample as it came.
pub(crate) trait Sample {
    fn header(&self) -> &Header;
    /// The sample in memory of this process.
    fn copied(self) -> Self;
}

/// A sample that a port has delivered.
pub(crate) struct Received<T> {
    pub(crate) sample: T,
    /// The counts of its input, itself included.
    pub(crate) counts: InputCounts,
    /// The consequence of its lateness, and its age in nanoseconds.
    pub(crate) late: Option<(OnLate, u64)>,
}

/// A sample that was taken and is not answered for good.
#[derive(Debug)]
#[cfg_attr(test, derive(Clone, PartialEq, Eq))]
pub(crate) struct Taken<T> {
    pub(crate) sample: T,
    /// Its header, which says that it has expired if it is late and the file asks for that.
    pub(crate) header: Header,
    /// The time at which it counts as arrived.
    pub(crate) arrival_nanos: u64,
    counts: InputCounts,
    /// Its age in nanoseconds, if the graph must end because of it.
    unfit_nanos: Option<u64>,
}

/// While a node waits for readers, it gives way …
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Yields {
    /// … to another instance and at the end.
    ToOthers,
    /// … also if it is to stop.
    OrToStop,
    /// … at the end alone.
    AtTheEnd,
}

/// The surroundings of a node: its ports, by number, the memory that outlives it, the launcher, the clock.
pub(crate) trait Site {
    type Sample: Sample;
    /// The largest state.
    const STATE_BYTES: usize;

    /// The next sample of an input in order; for a standby that has not been active, without its writer's waiting for it.
    fn receive(&mut self, input: usize) -> Result<Option<Received<Self::Sample>>, PortError>;
    /// Keeps a sample that was not answered until the input begins anew.
    fn put_back(&mut self, input: usize, sample: Self::Sample);
    /// Begins an input anew after the last sample of a place, as the active instance. Its cursor says from now on that it has
    /// answered the samples up to `cursor`.
    fn take_over(&mut self, input: usize, place: &Input, cursor: Option<SampleId>);
    /// Begins an input anew, as a standby that has its state from after this sample.
    fn look_on_from(&mut self, input: usize, last: SampleId);
    fn commit(&mut self, input: usize, key: SampleId, counts: &InputCounts);
    fn is_caught_up(&self, input: usize) -> bool;
    fn is_cut_off(&self, input: usize) -> bool;
    /// The last sample that any instance has answered, with its counts.
    fn place(&self, input: usize) -> (Option<SampleId>, InputCounts);
    fn is_after(&self, input: usize, key: SampleId, other: Option<SampleId>) -> bool;
    /// Whether more samples wait, and the last one came only just now.
    fn is_hurried(&self, input: usize) -> bool;

    /// Ends the comparison as a standby.
    fn begin_active(&mut self);
    /// Takes over an output; returns the last sample that need not be sent again.
    fn begin(&mut self, output: usize, is_handed_over: bool) -> Option<SampleId>;
    /// How far the instances of the node have come with an output.
    fn written(&self, output: usize) -> Option<Written>;
    fn has_readers(&self, output: usize) -> bool;
    fn answered_by_readers(&self, output: usize) -> Option<SampleId>;
    fn wait_for_room(&mut self, output: usize, key: SampleId) -> Result<Sent, PortError>;
    fn wait_for_answers(&mut self, output: usize, key: SampleId, yields: Yields) -> Result<Sent, PortError>;
    /// Sends an answer for which its readers have room.
    fn send(&mut self, output: usize, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError>;
    /// Sends an answer of a standby, for comparison.
    fn send_beside(&mut self, output: usize, key: SampleId, head: &[u8], items: &[u8]) -> Result<(), PortError>;
    /// Sets whether the next answers are sent without waking their readers. If not, those of earlier answers are woken.
    fn delay_bells(&mut self, output: usize, delays: bool);
    fn ring_if_due(&self, output: usize);

    /// Takes in the samples of partner inputs.
    fn take_in_partners(&mut self, stop: bool) -> Result<(), PortError>;
    /// Chooses the partners of a sample; false if it must wait for one.
    fn choose_partners(&mut self, main: &Header, is_active: bool, stop: bool) -> Result<bool, PortError>;
    /// Samples up to `main` will not be answered again.
    fn partners_have_answered(&mut self, main: Option<SampleId>);
    fn has_partners(&self) -> bool;
    fn partners_are_caught_up(&self) -> bool;

    fn save_state(&mut self, bytes: &[u8]) -> anyhow::Result<()>;
    fn saved_state(&self) -> Option<Vec<u8>>;
    /// Drops the saved state, because the active instance saves none.
    fn forget_state(&mut self);

    /// Whether the launcher has a command, or asks for the end.
    fn is_interrupted(&self) -> bool;
    /// Whether ports and worker are to be looked at before further samples. A stage that is always behind is never idle.
    fn is_look_due(&self) -> bool {
        false
    }
    fn should_stop(&self) -> bool;
    fn beat(&self);
    /// Names the sample that is worked on, for the launcher if the process dies of it.
    fn works_on(&self, sample: Option<SampleId>);
    /// Whether a sample has killed earlier instances again and again.
    fn skips(&self, sample: SampleId) -> bool;
    fn is_unfit(&self, seq: u64, age_nanos: u64);
    fn warm(&self, n_samples: u64);
    /// The identity of the answers to samples that were `made_by` others.
    fn made_by(&self, made_by: u64) -> u64;
    fn clock(&self) -> Clock;
    /// The time at which a sample counts as arrived, and an answer as sent.
    fn arrival_nanos(&self, header: &Header) -> u64;
    fn now_nanos(&self) -> u64;
}

/// A thing besides samples that a worker hears.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Hearing {
    Silence,
    End,
    CutOff,
}

/// An answer: the number of its output, the bytes of its head, which begins with the header, and of its items.
pub(crate) type Answer<'a> = (usize, &'a [u8], &'a [u8]);

/// The work of a node on samples.
pub(crate) trait Worker<T> {
    /// Whether its answers depend on earlier samples.
    fn has_state(&self) -> bool;

    /// Answers samples of an input; its answers are asked for with [`Worker::next`]. False if it wants them one by one.
    ///
    /// # Errors
    /// It cannot go on.
    fn ask(&mut self, input: usize, samples: &[Taken<T>]) -> anyhow::Result<bool>;

    /// Goes on to the answers to the next sample that was asked: their number.
    fn next(&mut self) -> usize;

    /// Tells it something; the number of its answers, or `None` if nothing came of it.
    ///
    /// # Errors
    /// It cannot go on.
    fn hear(&mut self, hearing: Hearing, now_nanos: u64) -> anyhow::Result<Option<usize>>;

    /// One of the answers.
    fn answer(&self, idx: usize) -> Answer<'_>;

    fn set_header(&mut self, idx: usize, header: &Header);

    /// An answer, right before it is sent at this time.
    ///
    /// # Errors
    /// It cannot go on.
    fn before_sending(&mut self, idx: usize, now_nanos: u64) -> anyhow::Result<Answer<'_>>;

    /// The head with which a saved answer is sent at this time.
    ///
    /// # Errors
    /// It cannot go on.
    fn before_sending_saved(&mut self, answer: Answer<'_>, now_nanos: u64) -> anyhow::Result<&[u8]>;

    /// Adds its state to `bytes`.
    ///
    /// # Errors
    /// The state cannot be encoded.
    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()>;

    /// Takes over a state, or begins anew; false if it cannot go on with all of it.
    ///
    /// # Errors
    /// It cannot read the state.
    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool>;

    /// Samples since its state were answered by another instance.
    fn has_missed_samples(&mut self) {}

    /// When it wants to hear of silence (CLOCK_BOOTTIME).
    fn deadline_nanos(&self) -> Option<u64>;

    /// Takes new values of its live parameters; the inner error is its reason to refuse them.
    ///
    /// # Errors
    /// It cannot go on.
    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<anyhow::Result<()>>;

    /// Called some times a second, between samples.
    ///
    /// # Errors
    /// It cannot go on.
    fn look(&mut self) -> anyhow::Result<()>;

    /// Called after each turn, whatever came of it.
    fn has_had_turn(&mut self) {}
}

/// The answers to a sample that are to be saved, sent and committed.
#[derive(Debug)]
#[cfg_attr(test, derive(Clone, PartialEq, Eq, Hash))]
struct Pending<T> {
    /// The sample and its input; `None` if they answer none.
    sample: Option<(usize, Taken<T>)>,
    is_saved: bool,
    /// Of a node that saves none: the number of the worker's answers, and of those that were sent.
    n_answers: usize,
    n_sent: usize,
}

/// The outcome of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    Moved,
    /// A reader has no room, and something else has to be done first.
    GaveWay,
    /// A sample waits for its partner.
    Waits,
    /// No sample is there.
    Idle,
}

impl From<Sent> for Progress {
    fn from(sent: Sent) -> Progress {
        match sent {
            Sent::Yes => Progress::Moved,
            Sent::GaveWay => Progress::GaveWay,
        }
    }
}

/// How a node works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Manner {
    /// Its answers are saved before they are sent, with the places of its inputs and the worker's state.
    pub(crate) saves: bool,
    /// Its answers have the numbers of the samples: those that readers have say how far an instance that saves nothing has come.
    pub(crate) answers_each: bool,
    /// So many samples are answered at once.
    pub(crate) n_batch: usize,
    /// The last instance died while it worked on a sample.
    pub(crate) has_suspect: bool,
}

/// A node that answers samples, active or standby.
#[derive(Debug)]
#[cfg_attr(test, derive(Clone, PartialEq, Eq, Hash))]
pub(crate) struct Engine<T, W> {
    pub(crate) worker: W,
    book: Book,
    manner: Manner,
    is_active: bool,
    /// The last sample answered.
    last: Option<SampleId>,
    /// The input whose turn it is.
    turn: usize,
    /// By input, the samples that were taken and not answered.
    back: Vec<VecDeque<Taken<T>>>,
    /// The input and the samples that the worker has answered.
    batch: (usize, VecDeque<Taken<T>>),
    pending: Option<Pending<T>>,
    /// What was saved when it handed over, in case that its replacement fails.
    handed_over: Option<Vec<u8>>,
    /// It stands by and has not been active: it reads along with readers of its own.
    looks_on: bool,
    /// As a standby, it reads along after samples that a saved state includes.
    has_begun_from_state: bool,
    n_looked_on: u64,
    /// So many samples are given to the worker one by one.
    n_one_by_one: usize,
    /// It has said that the graph must end.
    is_unfit: bool,
    /// The worker has heard that no sample can come.
    is_cut_off: bool,
    has_heard_end: bool,
    /// Whether it has answered the last sample with a message.
    had_answer: bool,
    /// Number of samples that it has answered since it has woken its readers.
    n_unrung: u32,
}

impl<T: Sample, W: Worker<T>> Engine<T, W> {
    /// A node that begins as the active instance, or as a standby.
    ///
    /// # Errors
    /// The worker cannot read the saved state.
    pub(crate) fn begin<S: Site<Sample = T>>(
        site: &mut S,
        worker: W,
        book: Book,
        manner: Manner,
        is_standby: bool,
    ) -> anyhow::Result<Self> {
        let mut engine = Engine {
            worker,
            back: book.inputs.iter().map(|_| VecDeque::new()).collect(),
            book,
            manner,
            is_active: false,
            last: None,
            turn: 0,
            batch: (0, VecDeque::new()),
            pending: None,
            handed_over: None,
            looks_on: is_standby,
            has_begun_from_state: false,
            n_looked_on: 0,
            n_one_by_one: if manner.has_suspect { MAX_BATCH } else { 0 },
            is_unfit: false,
            is_cut_off: false,
            has_heard_end: false,
            had_answer: false,
            n_unrung: 0,
        };
        if is_standby {
            engine.stand_by(site)?;
        } else {
            engine.take_over(site, false)?;
        }
        Ok(engine)
    }

    pub(crate) fn is_active(&self) -> bool {
        self.is_active
    }

    pub(crate) fn saves(&self) -> bool {
        self.manner.saves
    }

    /// The number of the next sample.
    pub(crate) fn next_seq(&self) -> Option<u64> {
        self.last.map(|last| last.seq + 1)
    }

    /// Whether all samples that are not feedback are answered.
    pub(crate) fn is_caught_up<S: Site<Sample = T>>(&self, site: &S) -> bool {
        let mut inputs = self.book.inputs.iter().enumerate();
        self.is_between_samples()
            && inputs.all(|(idx, input)| input.is_feedback || site.is_caught_up(idx))
            && site.partners_are_caught_up()
    }

    /// Whether the worker has heard the end, and nothing has come since that is not answered.
    pub(crate) fn is_over<S: Site<Sample = T>>(&self, site: &S) -> bool {
        self.has_heard_end && self.is_caught_up(site)
    }

    /// Answers the samples that are there, and tells the worker of silence or the end of the stream.
    ///
    /// # Errors
    /// An error of the worker or of a port.
    pub(crate) fn work<S: Site<Sample = T>>(&mut self, site: &mut S, stop: bool) -> anyhow::Result<Sent> {
        let sent = self.answer_samples(site, stop);
        self.n_unrung = 0;
        for output in 0..self.book.outputs.len() {
            site.delay_bells(output, false);
            site.ring_if_due(output);
        }
        sent
    }

    fn answer_samples<S: Site<Sample = T>>(&mut self, site: &mut S, stop: bool) -> anyhow::Result<Sent> {
        // Also while no main sample comes: their writers wait for this reader.
        site.take_in_partners(stop)?;
        let (mut has_heard, mut has_moved) = (false, false);
        loop {
            // Each turn answers a sample, however long a look takes.
            if self.is_between_samples() && (site.is_interrupted() || has_moved && site.is_look_due()) {
                return Ok(Sent::Yes);
            }
            match self.advance(site, stop)? {
                Progress::Moved => has_moved = true,
                Progress::GaveWay => return Ok(Sent::GaveWay),
                Progress::Waits => return Ok(Sent::Yes),
                Progress::Idle => {
                    // After silence in this turn, the worker hears the end as well.
                    let is_at_end = stop && !self.has_heard_end && self.is_caught_up(site);
                    if std::mem::replace(&mut has_heard, true) && !is_at_end || !self.hear(site, stop)? {
                        return Ok(Sent::Yes);
                    }
                }
            }
        }
    }

    pub(crate) fn is_between_samples(&self) -> bool {
        self.pending.is_none() && self.batch.1.is_empty() && self.book.unsent().is_none()
    }

    /// Does one thing that outlives this process: saves, sends an answer, commits a sample; or else takes the next sample.
    ///
    /// # Errors
    /// An error of the worker or of a port.
    pub(crate) fn advance<S: Site<Sample = T>>(&mut self, site: &mut S, stop: bool) -> anyhow::Result<Progress> {
        // A kill at any moment neither loses an answer nor makes another one under the same number.
        if self.manner.saves && self.pending.as_ref().is_some_and(|pending| !pending.is_saved) {
            return self.save(site);
        }
        if let Some(output) = self.book.unsent() {
            return self.send_saved(site, output);
        }
        match &self.pending {
            Some(pending) if pending.n_sent < pending.n_answers => self.send_next(site),
            Some(_) => {
                self.commit(site);
                Ok(Progress::Moved)
            }
            None => match self.batch.1.pop_front() {
                Some(taken) => {
                    self.take_answers(site, taken)?;
                    Ok(Progress::Moved)
                }
                None => self.take(site, stop),
            },
        }
    }

    /// Takes the next samples and lets the worker answer them.
    fn take<S: Site<Sample = T>>(&mut self, site: &mut S, stop: bool) -> anyhow::Result<Progress> {
        for _ in 0..self.back.len() {
            // In turn, so that no input waits for another.
            let input = self.turn;
            self.turn = (self.turn + 1) % self.back.len();
            let Some(taken) = self.receive(site, input)? else { continue };
            site.beat();
            if site.skips(self.name_of(input, &taken)) {
                // Readers find a gap: nothing is lifted on it.
                let seq = taken.header.seq;
                tracing::error!("sample {seq} is not answered: it has killed this operator again and again");
                self.find_gap(input, &taken, true);
                self.pend(site, Some((input, taken)), 0);
                return Ok(Progress::Moved);
            }
            if !site.choose_partners(&taken.header, true, stop)? {
                self.back[input].push_front(taken);
                return Ok(Progress::Waits);
            }
            self.fill_batch(site, input, taken)?;
            self.ask(site)?;
            return Ok(Progress::Moved);
        }
        Ok(Progress::Idle)
    }

    fn receive<S: Site<Sample = T>>(&mut self, site: &mut S, input: usize) -> Result<Option<Taken<T>>, PortError> {
        if let Some(taken) = self.back[input].pop_front() {
            return Ok(Some(taken));
        }
        let Some(Received { sample, counts, late }) = site.receive(input)? else { return Ok(None) };
        let (mut header, mut unfit_nanos) = (*sample.header(), None);
        if site.clock() == Clock::Machine
            && let Some((on_late @ (OnLate::Hold | OnLate::Stop), age_nanos)) = late
        {
            // The least that says so: see `Header::valid_until_nanos`.
            header.valid_nanos = 1;
            unfit_nanos = if on_late == OnLate::Stop { Some(age_nanos) } else { None };
        }
        Ok(Some(Taken { sample, header, arrival_nanos: 0, counts, unfit_nanos }))
    }

    /// The batch that begins with a sample.
    fn fill_batch<S: Site<Sample = T>>(&mut self, site: &mut S, input: usize, first: Taken<T>) -> anyhow::Result<()> {
        let is_single = self.manner.saves || site.has_partners() || self.n_one_by_one > 0;
        let n_most = if is_single { 1 } else { self.manner.n_batch.clamp(1, MAX_BATCH) };
        self.batch.0 = input;
        if n_most == 1 {
            self.batch.1.push_back(first);
            return Ok(());
        }
        let mut next = Some(first);
        while let Some(taken) = next {
            if site.skips(self.name_of(input, &taken)) {
                self.back[input].push_front(taken);
                break;
            }
            // No more samples are borrowed from their publishers than there is room for.
            self.batch.1.push_back(Taken { sample: taken.sample.copied(), ..taken });
            next = if self.batch.1.len() < n_most { self.receive(site, input)? } else { None };
        }
        Ok(())
    }

    /// Lets the worker answer the batch. The launcher learns on which sample the process dies.
    fn ask<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<()> {
        let (input, samples) = (self.batch.0, &mut self.batch.1);
        let name = self.book.inputs[input].name.clone();
        let is_alone = self.book.inputs.len() == 1;
        let samples = samples.make_contiguous();
        for taken in samples.iter_mut() {
            taken.arrival_nanos = site.arrival_nanos(&taken.header);
        }
        site.works_on(samples.first().map(|first| name_of(&name, is_alone, first.header)));
        if !self.worker.ask(input, samples)? {
            for idx in 0..samples.len() {
                site.works_on(Some(name_of(&name, is_alone, samples[idx].header)));
                self.worker.ask(input, &samples[idx..=idx])?;
            }
        }
        site.works_on(None);
        Ok(())
    }

    /// The name of a sample for the launcher.
    fn name_of(&self, input: usize, taken: &Taken<T>) -> SampleId {
        name_of(&self.book.inputs[input].name, self.book.inputs.len() == 1, taken.header)
    }

    /// Takes the worker's answers to a sample.
    fn take_answers<S: Site<Sample = T>>(&mut self, site: &mut S, taken: Taken<T>) -> anyhow::Result<()> {
        if let Some(age_nanos) = taken.unfit_nanos
            && !std::mem::replace(&mut self.is_unfit, true)
        {
            site.is_unfit(taken.header.seq, age_nanos);
        }
        let input = self.batch.0;
        let n_answers = self.worker.next();
        self.find_gap(input, &taken, false);
        self.number_answers(site, Some((input, &taken.header)), n_answers)?;
        self.require_answers(input, n_answers)?;
        self.delay_or_ring(site, input, n_answers > 0);
        self.pend(site, Some((input, taken)), n_answers);
        Ok(())
    }

    /// Readers of an output that counts must find a gap of an input as well.
    fn find_gap(&mut self, input: usize, taken: &Taken<T>, is_skipped: bool) {
        if !is_skipped && taken.counts.n_missing <= self.book.inputs[input].counts.n_missing {
            return;
        }
        for output in self.book.outputs.iter_mut().filter(|output| output.numbers == Numbers::Counted) {
            if let Some(last) = &mut output.last {
                last.seq += 1;
            }
        }
    }

    /// Gives the answers to a sample, or to something else, the headers with which they are sent.
    fn number_answers<S: Site<Sample = T>>(
        &mut self,
        site: &S,
        to: Option<(usize, &Header)>,
        n_answers: usize,
    ) -> anyhow::Result<()> {
        for idx in 0..n_answers {
            let (output, head, _) = self.worker.answer(idx);
            let own = header_of(head);
            let numbers = self.book.outputs[output].numbers;
            let mut header = match to {
                Some((_, answered)) if numbers != Numbers::OfWorker || own == Header::default() => *answered,
                _ => own,
            };
            header.made_by = site.made_by(to.map_or(own.made_by, |(_, answered)| answered.made_by));
            let expected = match numbers {
                Numbers::OfSample => Some(Some(0)),
                Numbers::OfInput(expected) => Some(expected),
                Numbers::OfWorker | Numbers::Counted => None,
            };
            if let Some(expected) = expected
                && (expected.is_none() || to.map(|(input, _)| input) != expected)
            {
                let found = to.map_or("silence", |(input, _)| &*self.book.inputs[input].name);
                let name = &self.book.outputs[output].name;
                anyhow::bail!("it answered {found} on the output {name}, which answers the samples of one input alone");
            }
            if numbers == Numbers::Counted {
                let next = self.book.next_key(output);
                self.book.outputs[output].last = Some(next);
                (header.epoch, header.seq) = (next.epoch, next.seq);
            }
            self.worker.set_header(idx, &header);
        }
        Ok(())
    }

    fn require_answers(&self, input: usize, n_answers: usize) -> anyhow::Result<()> {
        for (idx, output) in self.book.outputs.iter().enumerate() {
            let promise = match output.numbers {
                Numbers::OfSample => "a fault where it has nothing to say, or a state and answers_each false",
                Numbers::OfInput(answered) if answered == Some(input) => "it has promised that",
                _ => continue,
            };
            let n_found = (0..n_answers).filter(|answer| self.worker.answer(*answer).0 == idx).count();
            if n_found != 1 {
                let (name, input) = (&output.name, &self.book.inputs[input].name);
                anyhow::bail!(
                    "it gave {n_found} answers on the output {name}, expected one to each sample of {input}: {promise}"
                );
            }
        }
        Ok(())
    }

    /// Decides whether readers are woken for the answer. An answer that is not one of many, such as a decision, wakes them at
    /// once.
    fn delay_or_ring<S: Site<Sample = T>>(&mut self, site: &mut S, input: usize, has_answer: bool) {
        let is_one_of_many = std::mem::replace(&mut self.had_answer, has_answer) && has_answer;
        if self.book.outputs.len() != 1 {
            return;
        }
        let delays = is_one_of_many && self.n_unrung < MOST_UNRUNG && site.is_hurried(input);
        self.n_unrung = if delays { self.n_unrung + 1 } else { 0 };
        site.delay_bells(0, delays);
        // An answer wakes them once it is sent.
        if !has_answer {
            site.ring_if_due(0);
        }
    }

    /// Keeps the worker's answers to a sample, or to none, until they are saved, sent and committed.
    fn pend<S: Site<Sample = T>>(&mut self, site: &S, sample: Option<(usize, Taken<T>)>, n_answers: usize) {
        if let Some((input, taken)) = &sample {
            let key = sample_id(&taken.header);
            if self.manner.saves {
                let place = &mut self.book.inputs[*input];
                // A sample that goes back in order is answered, but does not move the cursor.
                if site.is_after(*input, key, place.last) {
                    place.last = Some(key);
                }
                if site.is_after(*input, key, place.counted) {
                    place.counted = Some(key);
                }
                place.counts = taken.counts;
            }
            self.last = Some(key);
            self.is_cut_off = false;
        }
        let mut pending = Pending { sample, is_saved: false, n_answers, n_sent: 0 };
        if self.manner.saves {
            for idx in 0..n_answers {
                let (output, head, items) = self.worker.answer(idx);
                let header = header_of(head);
                self.book.keep(output, &header, head, items);
            }
            pending.n_answers = 0;
        }
        self.pending = Some(pending);
    }

    fn save<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<Progress> {
        let worker = &self.worker;
        let sent = self.book.save(site, Yields::ToOthers, |bytes| worker.state(bytes))?;
        if let (Sent::Yes, Some(pending)) = (sent, &mut self.pending) {
            pending.is_saved = true;
        }
        Ok(sent.into())
    }

    /// Sends the first saved answer that was not sent.
    fn send_saved<S: Site<Sample = T>>(&mut self, site: &mut S, output: usize) -> anyhow::Result<Progress> {
        let kept = &mut self.book.outputs[output].kept;
        let Some(entry) = kept.next() else { return Ok(Progress::Moved) };
        if site.wait_for_room(output, entry.key)? == Sent::GaveWay {
            return Ok(Progress::GaveWay);
        }
        let (head, items) = entry.parts();
        let header = header_of(head);
        let head = self.worker.before_sending_saved((output, head, items), site.arrival_nanos(&header))?;
        site.send(output, entry.key, head, items)?;
        kept.has_sent_next();
        Ok(Progress::Moved)
    }

    /// Sends the next answer of a node that saves none.
    fn send_next<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<Progress> {
        let Some(pending) = &mut self.pending else { return Ok(Progress::Moved) };
        let (output, head, _) = self.worker.answer(pending.n_sent);
        let header = header_of(head);
        let key = sample_id(&header);
        let known = self.book.outputs[output].known;
        // One output may be ahead of another: its readers have this answer.
        let is_known = self.book.outputs.len() > 1 && !site.is_after(0, key, known);
        if !is_known {
            if site.wait_for_room(output, key)? == Sent::GaveWay {
                return Ok(Progress::GaveWay);
            }
            let (_, head, items) = self.worker.before_sending(pending.n_sent, site.arrival_nanos(&header))?;
            site.send(output, key, head, items)?;
            self.book.outputs[output].known = None;
        }
        pending.n_sent += 1;
        Ok(Progress::Moved)
    }

    /// Marks the sample as answered.
    fn commit<S: Site<Sample = T>>(&mut self, site: &mut S) {
        let Some(Pending { sample: Some((input, taken)), .. }) = self.pending.take() else { return };
        site.commit(input, sample_id(&taken.header), &taken.counts);
        self.n_one_by_one = self.n_one_by_one.saturating_sub(1);
        if site.has_partners() {
            site.partners_have_answered(self.needed_from(site, input));
        }
    }

    /// The last sample of an input that an instance after this one will not answer again.
    fn needed_from<S: Site<Sample = T>>(&self, site: &S, input: usize) -> Option<SampleId> {
        if self.manner.saves {
            return self.book.inputs[input].last;
        }
        let outputs = (0..self.book.outputs.len()).filter(|output| site.has_readers(*output));
        least(site, input, outputs.map(|output| site.answered_by_readers(output))).unwrap_or(self.last)
    }

    /// Tells the worker of the end of the stream, of a cut or of silence; false if nothing came of it.
    fn hear<S: Site<Sample = T>>(&mut self, site: &mut S, stop: bool) -> anyhow::Result<bool> {
        let hearing = if stop && self.is_caught_up(site) {
            if std::mem::replace(&mut self.has_heard_end, true) {
                return Ok(false);
            }
            Hearing::End
        } else if (0..self.back.len()).any(|input| site.is_cut_off(input)) {
            if std::mem::replace(&mut self.is_cut_off, true) {
                return Ok(false);
            }
            Hearing::CutOff
        } else {
            self.is_cut_off = false;
            if site.clock() != Clock::Machine {
                return Ok(false);
            }
            Hearing::Silence
        };
        let Some(n_answers) = self.worker.hear(hearing, site.now_nanos())? else { return Ok(false) };
        self.number_answers(site, None, n_answers)?;
        self.pend(site, None, n_answers);
        Ok(true)
    }

    /// Another instance takes over: a sample that no saved state includes is answered again by the one that is active next.
    pub(crate) fn hand_over<S: Site<Sample = T>>(&mut self, site: &mut S) {
        self.is_active = false;
        self.put_back(site);
        self.handed_over = if self.manner.saves && self.worker.has_state() { site.saved_state() } else { None };
    }

    fn put_back<S: Site<Sample = T>>(&mut self, site: &mut S) {
        if let Some(Pending { sample: Some((input, taken)), is_saved: false, .. }) = self.pending.take() {
            site.put_back(input, taken.sample);
        }
        while let Some(taken) = self.batch.1.pop_front() {
            self.worker.next();
            site.put_back(self.batch.0, taken.sample);
        }
        self.give_back(site);
    }

    /// Gives the samples that were not answered to their inputs, which find their places again.
    fn give_back<S: Site<Sample = T>>(&mut self, site: &mut S) {
        for (input, back) in self.back.iter_mut().enumerate() {
            back.drain(..).for_each(|taken| site.put_back(input, taken.sample));
        }
    }

    /// Becomes the active instance. With `is_handed_over`, readers will receive all that the other instance has sent.
    ///
    /// # Errors
    /// The worker cannot read the saved state.
    pub(crate) fn take_over<S: Site<Sample = T>>(&mut self, site: &mut S, is_handed_over: bool) -> anyhow::Result<()> {
        if self.is_active {
            self.put_back(site);
        }
        // Those of a standby are its own copies.
        self.back.iter_mut().for_each(VecDeque::clear);
        site.begin_active();
        self.looks_on = false;
        // It may have heard of an end or a cut of another time.
        (self.is_cut_off, self.has_heard_end) = (false, false);
        for (idx, output) in self.book.outputs.iter_mut().enumerate() {
            output.known = site.begin(idx, is_handed_over);
        }
        let has_handed_over = self.handed_over.is_some();
        let is_restored = self.restore(site)?;
        if has_handed_over && is_restored {
            // It may be the state of the hand-over: a second failure must not lose it.
            self.save_if_it_fits(site)?;
        }
        if !is_restored && (self.manner.answers_each || !self.manner.saves) {
            // The instance before had no state, and has answered each sample under its number.
            self.begin_after_readers(site, has_handed_over)?;
        } else {
            for (idx, input) in self.book.inputs.iter().enumerate() {
                site.take_over(idx, input, input.last);
            }
        }
        self.last = self.book.inputs.first().and_then(|input| input.last);
        self.is_active = true;
        Ok(())
    }

    /// Goes on after the last sample whose answers all readers of all outputs have.
    fn begin_after_readers<S: Site<Sample = T>>(&mut self, site: &mut S, has_handed_over: bool) -> anyhow::Result<()> {
        let least = least(site, 0, self.book.outputs.iter().map(|output| output.known)).flatten();
        let input = &mut self.book.inputs[0];
        if !self.manner.saves {
            input.last = least;
            // From now on the cursor says which samples are counted, and not the saved state of an instance before.
            site.take_over(0, input, input.counted);
            site.forget_state();
            return Ok(());
        }
        // Readers are ahead if the instance before has sent an answer and not committed its sample, which is not counted then.
        if least.is_none_or(|least| !site.is_after(0, least, input.last)) {
            input.last = least;
        }
        if input.last != input.counted || has_handed_over {
            // Saved before the cursor goes back: the next instance must know which samples are counted, and after a second
            // failure the state of the hand-over.
            self.save_if_it_fits(site)?;
        }
        let input = &self.book.inputs[0];
        site.take_over(0, input, input.last);
        Ok(())
    }

    fn save_if_it_fits<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<()> {
        let worker = &self.worker;
        self.book.save_if_it_fits(site, &|bytes| worker.state(bytes))?;
        Ok(())
    }

    /// Reads along after the last samples that the saved state includes.
    fn stand_by<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<()> {
        self.has_begun_from_state = self.restore(site)?;
        if !self.has_begun_from_state {
            return Ok(());
        }
        self.give_back(site);
        for (idx, input) in self.book.inputs.iter().enumerate() {
            if let Some(last) = input.last {
                site.look_on_from(idx, last);
            }
        }
        Ok(())
    }

    /// Takes over what was saved, and gives the worker its state; false if there is nothing to go on with. If its
    /// failed replacement has left no state that the worker can use, the worker goes on with the state with which it handed
    /// over. The places stay those of the replacement.
    fn restore<S: Site<Sample = T>>(&mut self, site: &S) -> anyhow::Result<bool> {
        let mut saved = None;
        if self.manner.saves {
            saved = self.book.restore(site, false)?;
        } else {
            self.book.restore_counts(site)?;
        }
        let Some(own) = self.handed_over.take() else {
            self.worker.restore(saved.as_deref())?;
            return Ok(saved.is_some());
        };
        // The replacement may have left bytes that this worker cannot read.
        let is_whole = saved.is_some() && self.worker.restore(saved.as_deref()).unwrap_or(false);
        if !is_whole {
            self.worker.restore(Some(state_in(&own)?))?;
            self.worker.has_missed_samples();
            tracing::warn!(
                "the failed replacement has left no state that this operator can use: it goes on with its state of the hand-over, \
                 without the samples since"
            );
        }
        Ok(saved.is_some())
    }

    /// Answers live samples beside the active instance.
    ///
    /// # Errors
    /// An error of the worker or of a port.
    pub(crate) fn look_on<S: Site<Sample = T>>(&mut self, site: &mut S) -> anyhow::Result<()> {
        for input in 0..self.back.len() {
            // After it has handed over, the samples are for the time when it is active again.
            while self.looks_on && !self.book.inputs[input].is_feedback && !site.is_interrupted() && !site.should_stop()
            {
                let Some(taken) = self.receive(site, input)? else { break };
                site.beat();
                if self.has_begun_from_state && taken.counts.n_missing > 0 {
                    // Its queue has overflowed: the state does not include the samples before this one, the saved one does.
                    self.back[input].push_front(taken);
                    return self.stand_by(site);
                }
                if site.skips(self.name_of(input, &taken)) {
                    continue;
                }
                if !site.choose_partners(&taken.header, false, false)? {
                    self.back[input].push_front(taken);
                    return Ok(());
                }
                self.answer_beside(site, input, taken)?;
                if site.is_look_due() {
                    return Ok(());
                }
            }
        }
        Ok(())
    }

    fn answer_beside<S: Site<Sample = T>>(
        &mut self,
        site: &mut S,
        input: usize,
        taken: Taken<T>,
    ) -> anyhow::Result<()> {
        let header = taken.header;
        self.batch.0 = input;
        self.batch.1.push_back(taken);
        self.ask(site)?;
        self.batch.1.clear();
        let n_answers = self.worker.next();
        self.number_answers(site, Some((input, &header)), n_answers)?;
        for idx in 0..n_answers {
            let (output, head, items) = self.worker.answer(idx);
            let header = header_of(head);
            site.send_beside(output, sample_id(&header), head, items)?;
        }
        self.n_looked_on += 1;
        if self.n_looked_on == N_WARM {
            site.warm(N_WARM);
        }
        Ok(())
    }
}

/// The place that is furthest behind, if there is one.
fn least<S: Site>(site: &S, input: usize, places: impl Iterator<Item = Option<SampleId>>) -> Option<Option<SampleId>> {
    places.reduce(|a, b| if a.is_some_and(|a| site.is_after(input, a, b)) { b } else { a })
}

/// The header with which the bytes of a head begin.
pub(crate) fn header_of(head: &[u8]) -> Header {
    Header::read_from_prefix(head).expect("a head begins with its header").0
}

/// The bytes of a head with another header.
pub(crate) fn with_header(mut head: Vec<u8>, header: &Header) -> Vec<u8> {
    header.write_to_prefix(&mut head).expect("a head begins with its header");
    head
}

/// The name of a sample for the launcher, which knows nothing of inputs: two inputs may have samples of one number.
fn name_of(input: &str, is_alone: bool, header: Header) -> SampleId {
    let SampleId { epoch, seq } = sample_id(&header);
    let epoch = if is_alone { epoch } else { epoch ^ stable_hash(&[input]) };
    SampleId { epoch, seq }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
impl<T: std::hash::Hash> std::hash::Hash for Taken<T> {
    fn hash<H: std::hash::Hasher>(&self, state: &mut H) {
        (&self.sample, self.counts).hash(state);
    }
}
