//! The sending end of a channel. It decides which samples are sent, kept and given up. It does no I/O and reads no
//! clock.
//!
//! A sample is kept until the receiver's readers have answered it. The receiver requests samples from some sample on.
//! The samples of a request are numbered, so that the receiver notices a loss and requests again. It cannot notice the
//! loss of the last sample; the sender therefore repeats a sample that is not acknowledged.
//!
//! * **Lossless**: while the receiver is up, at most `window` samples are on their way or unanswered; then the channel
//!   takes no more samples from its writer. While the receiver is cut off, the channel keeps up to `buffer` samples and
//!   gives up the oldest beyond that. A receiver that is up and answers nothing **stalls**: after `stall_limit_nanos`
//!   with a full window the channel treats it as cut off, and only repeats one sample, until that is answered. So a
//!   machine that takes no samples cannot hold the writer up for ever.
//! * **Latest**: only the newest sample is kept.
//!
//! A sample may be **committed**, so that its writer forgets it, when it is answered, or when it was saved outside of this
//! process. The channel says which samples to save, because the writer must not wait for them ([`Outgoing::next_to_save`]); the
//! process that takes over gets them back ([`Outgoing::restore`]).
//!
//! A position in the stream counts the samples in the order in which they were pushed. Keys order samples only within
//! an epoch; the order of epochs is that in which the writer began them ([`Written`]).

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::link_status::ChannelStatus;
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_operator::written::Written;

/// A sample that is not acknowledged is repeated after the first pause. Each further pause is twice as long.
const FIRST_PROBE_NANOS: u64 = 250_000_000;
const LONGEST_PROBE_NANOS: u64 = 2_000_000_000;
/// Pause before the end of a channel is repeated.
const END_PAUSE_NANOS: u64 = 100_000_000;
/// While the receiver is cut off, a sample is saved and committed after this time. A writer starts a new epoch when all readers
/// have answered the old one, and it must not wait for a machine that is away.
const COMMIT_AFTER_NANOS: u64 = 50_000_000;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OutgoingOptions {
    pub policy: EdgePolicy,
    /// Maximum number of samples that are on their way or unanswered, at least 1.
    pub window: usize,
    /// Maximum number of samples by which the local writer may be ahead of this reader.
    pub capacity: usize,
    /// Maximum number of samples that are kept while the receiver is cut off; at least `window`.
    pub buffer: usize,
    /// A receiver that is up stalls when the window has been full for this time and nothing was answered.
    pub stall_limit_nanos: u64,
}

/// A sample as it is saved for a process that takes over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeptSample {
    pub key: SampleId,
    pub origin_nanos: u64,
    /// The encoded message.
    pub message: Vec<u8>,
}

/// The sending end of a channel.
#[derive(Debug, Clone, Default)]
pub struct Outgoing {
    options: OutgoingOptions,
    /// How far the writer has come.
    written: Option<Written>,
    /// In the order in which the samples were pushed.
    kept: VecDeque<Kept>,
    /// The position of the first kept sample.
    first: u64,
    /// The position of the next sample to send.
    cursor: u64,
    /// Samples before this position were sent, or the receiver had them.
    reached: u64,
    /// Samples before this position may be committed: they are answered, given up or saved.
    committed: u64,
    committed_key: Option<SampleId>,
    /// The last sample that is no longer kept.
    last_removed: Option<SampleId>,
    /// A sample that the receiver has and that was not pushed yet. It is pushed again after a restart of this process.
    skip: Option<SampleId>,
    /// Samples that were sent, are no longer kept, and are not acknowledged.
    unsettled: VecDeque<(Sent, SampleId)>,
    run: Option<Run>,
    is_catching_up: bool,
    /// The last sample that the receiver's readers have answered, by its last acknowledgement.
    last_answered: Option<SampleId>,
    /// Since when the window has been full without an answer.
    full_since_nanos: Option<u64>,
    is_stalled: bool,
    /// The receiver has stalled, and more than a window has waited for it ever since. It does not block the writer.
    is_on_trial: bool,
    blocked_since_nanos: Option<u64>,
    end: Option<End>,
    n_samples: u64,
    n_repeated: u64,
    n_lost: u64,
    blocked_nanos: u64,
}

/// A sample to send now.
#[derive(Debug, PartialEq, Eq)]
pub struct Next<'a> {
    /// The receiver's request that this sample answers.
    pub run: u32,
    /// The index of the sample among those that answer the request.
    pub index: u64,
    pub key: SampleId,
    /// The encoded message.
    pub message: &'a [u8],
    /// The time of publishing by the source, by this machine's clock; 0 if unknown.
    pub origin_nanos: u64,
    /// Whether the sample was sent before.
    pub is_repeat: bool,
}

#[derive(Debug, Clone)]
struct Kept {
    sample: KeptSample,
    pushed_nanos: u64,
    sent: Option<Sent>,
}

/// The last time that a sample was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sent {
    run: u32,
    index: u64,
}

/// A request of the receiver.
#[derive(Debug, Clone)]
struct Run {
    number: u32,
    n_sent: u64,
    n_received: u64,
    probe_due_nanos: u64,
    probe_pause_nanos: u64,
}

#[derive(Debug, Clone)]
struct End {
    last: Option<SampleId>,
    due_nanos: u64,
    is_to_say: bool,
    is_done: bool,
}

impl Outgoing {
    /// A channel whose reader has committed `begun_after` on the cursors, `None` in a graph that has just started, and whose
    /// writer has come to `written`.
    pub fn new(options: OutgoingOptions, begun_after: Option<SampleId>, written: Option<Written>) -> Self {
        let window = options.window.max(1);
        Outgoing {
            options: OutgoingOptions { window, buffer: options.buffer.max(window), ..options },
            written,
            committed_key: begun_after,
            last_removed: begun_after,
            is_catching_up: true,
            ..Outgoing::default()
        }
    }

    /// Goes on with what an earlier process has saved, in its order, and with the number of samples that it has lost. Those behind
    /// the last committed sample were not committed any more: the writer sends them again.
    pub fn restore(&mut self, mut saved: Vec<KeptSample>, n_lost: u64) {
        let n_committed =
            saved.iter().rposition(|sample| Some(sample.key) == self.committed_key).map_or(0, |idx| idx + 1);
        saved.truncate(n_committed);
        self.n_lost = n_lost;
        if saved.is_empty() {
            return;
        }
        self.kept = saved.into_iter().map(|sample| Kept { sample, pushed_nanos: 0, sent: None }).collect();
        self.committed = self.end_position();
        // The sample before them is not known.
        self.last_removed = None;
    }

    /// Whether another sample may be taken from the local writer. It may not while the receiver is up and behind; the
    /// time until it may again counts as blocked. After the receiver was cut off, the kept samples are sent without
    /// blocking the writer, as long as the buffer has room.
    pub fn wants_more(&mut self, is_up: bool, now_nanos: u64) -> bool {
        let n_kept = self.kept.len();
        self.look_for_stall(is_up, now_nanos);
        let is_up = is_up && !self.is_on_trial;
        self.is_catching_up = !is_up || (self.is_catching_up && n_kept >= self.options.window);
        let most = if self.is_catching_up { self.options.buffer } else { self.options.window };
        let wants = !is_up || self.options.policy == EdgePolicy::Latest || n_kept < most;
        match (wants, self.blocked_since_nanos) {
            (true, Some(since_nanos)) => {
                self.blocked_nanos += now_nanos.saturating_sub(since_nanos);
                self.blocked_since_nanos = None;
            }
            (false, None) => self.blocked_since_nanos = Some(now_nanos),
            _ => {}
        }
        wants
    }

    /// Whether the receiver is up and has answered nothing for too long.
    pub fn is_stalled(&self) -> bool {
        self.is_stalled
    }

    fn look_for_stall(&mut self, is_up: bool, now_nanos: u64) {
        let is_full = self.options.policy == EdgePolicy::Lossless && self.kept.len() >= self.options.window;
        if !is_up || !is_full {
            self.full_since_nanos = None;
            self.is_on_trial &= !is_up;
            return;
        }
        let since_nanos = *self.full_since_nanos.get_or_insert(now_nanos);
        if now_nanos.saturating_sub(since_nanos) >= self.options.stall_limit_nanos {
            (self.is_stalled, self.is_on_trial) = (true, true);
        }
    }

    /// Takes an encoded sample from the local writer.
    pub fn push(&mut self, key: SampleId, message: Vec<u8>, origin_nanos: u64, now_nanos: u64) {
        let most_before = match self.options.policy {
            EdgePolicy::Lossless => self.options.buffer - 1,
            EdgePolicy::Latest => 0,
        };
        while self.kept.len() > most_before {
            self.give_up_first();
        }
        let sample = KeptSample { key, origin_nanos, message };
        self.kept.push_back(Kept { sample, pushed_nanos: now_nanos, sent: None });
        self.written = Written::with(self.written, key).or(self.written);
        if let Some(had) = self.skip {
            if self.is_before_or_at(&key, &had) {
                self.cursor = self.end_position();
                self.reached = self.reached.max(self.cursor);
            } else {
                self.skip = None;
            }
        }
    }

    /// The receiver requests the samples after `after`. A request that is not newer than the last is ignored.
    pub fn on_resume(&mut self, run: u32, after: Option<SampleId>) {
        if self.run.as_ref().is_some_and(|current| run <= current.number) {
            return;
        }
        self.settle(after);
        self.cursor = after.map_or(self.first, |key| self.position_after(&key));
        self.reached = self.reached.max(self.cursor);
        let is_known =
            |key: &SampleId| self.last_removed == Some(*key) || self.kept.iter().any(|kept| kept.sample.key == *key);
        self.skip = after.filter(|key| self.cursor == self.end_position() && !is_known(key));
        self.run = Some(Run {
            number: run,
            n_sent: 0,
            n_received: 0,
            probe_due_nanos: 0,
            probe_pause_nanos: FIRST_PROBE_NANOS,
        });
        if let Some(end) = &mut self.end {
            (end.is_to_say, end.due_nanos) = (true, 0);
        }
    }

    /// Whether the receiver has requested samples since it was cut off.
    pub fn has_request(&self) -> bool {
        self.run.is_some()
    }

    /// The next sample that is due; call this until it returns `None`.
    pub fn next(&mut self, now_nanos: u64) -> Option<Next<'_>> {
        let end_position = self.end_position();
        let run = self.run.as_mut()?;
        let is_latest = self.options.policy == EdgePolicy::Latest;
        let n_on_their_way = if is_latest { run.n_sent - run.n_received } else { self.cursor - self.first };
        let is_probe_due = run.n_sent > run.n_received && now_nanos >= run.probe_due_nanos;
        let has_room = if self.is_stalled {
            // One sample, and later another one if that was given up. An answer ends the stall.
            run.n_sent == 0 || (self.cursor == self.first && now_nanos >= run.probe_due_nanos)
        } else {
            n_on_their_way < self.options.window as u64
        };
        let (position, index) = if self.cursor < end_position && (has_room || (is_latest && is_probe_due)) {
            self.cursor += 1;
            run.n_sent += 1;
            (self.cursor - 1, run.n_sent - 1)
        } else if is_probe_due {
            // Repeats the last sample, if it is still kept. The receiver then notices which other samples it lacks.
            let position = self.cursor.checked_sub(1).filter(|position| *position >= self.first)?;
            (position, run.n_sent - 1)
        } else {
            return None;
        };
        let sent = Sent { run: run.number, index };
        let kept = self.kept.get_mut((position - self.first) as usize)?;
        if is_probe_due {
            run.probe_pause_nanos = (2 * run.probe_pause_nanos).min(LONGEST_PROBE_NANOS);
        }
        run.probe_due_nanos = now_nanos.saturating_add(run.probe_pause_nanos);
        self.reached = self.reached.max(self.cursor);
        let is_repeat = kept.sent.replace(sent).is_some();
        if is_repeat {
            self.n_repeated += 1;
        } else {
            self.n_samples += 1;
        }
        let KeptSample { key, origin_nanos, message } = &kept.sample;
        Some(Next { run: sent.run, index, key: *key, message, origin_nanos: *origin_nanos, is_repeat })
    }

    /// The receiver has `n_received` samples of a request, and its readers have answered all samples up to `answered`.
    pub fn on_ack(&mut self, run: u32, n_received: u64, answered: Option<SampleId>, now_nanos: u64) {
        if let Some(current) = self.run.as_mut().filter(|current| current.number == run) {
            let n_received = n_received.min(current.n_sent);
            if n_received > current.n_received {
                current.n_received = n_received;
                current.probe_pause_nanos = FIRST_PROBE_NANOS;
                current.probe_due_nanos = now_nanos.saturating_add(FIRST_PROBE_NANOS);
            }
            if self.options.policy == EdgePolicy::Latest {
                // The receiver has counted the samples that were lost before these.
                self.unsettled.retain(|(sent, _)| sent.run != run || sent.index >= n_received);
            }
        }
        let Some(key) = answered else { return };
        if self.last_answered.replace(key) != Some(key) {
            (self.full_since_nanos, self.is_stalled) = (None, false);
        }
        let exactly = self.kept.iter().position(|kept| kept.sample.key == key);
        let position = match exactly {
            Some(idx) => self.first + idx as u64 + 1,
            None => self.position_after(&key),
        };
        // Only samples that were sent can be answered.
        while self.first < position.min(self.reached) {
            self.remove_first();
            // The receiver could have requested the samples before this one.
            self.unsettled.clear();
        }
    }

    /// The next sample that must be saved outside of this process, because the writer must not wait for its answer: call
    /// [`Outgoing::saved`] once that is done, and this until it returns `None`.
    pub fn next_to_save(&self, now_nanos: u64) -> Option<&KeptSample> {
        if self.options.policy != EdgePolicy::Lossless {
            return None;
        }
        let newest = self.kept.back()?.sample.key;
        let kept = self.kept.get((self.committed - self.first) as usize)?;
        let capacity = self.options.capacity as u64;
        let most = capacity - (capacity / 4).max(1).min(capacity);
        // The writer's limit is a difference of sequence numbers, not a number of samples.
        let key = kept.sample.key;
        let is_far = newest.epoch == key.epoch && newest.seq.saturating_sub(key.seq) >= most;
        let is_many = self.end_position() - self.committed > most;
        let is_cut_off_long = (self.run.is_none() || self.is_on_trial)
            && now_nanos.saturating_sub(kept.pushed_nanos) >= COMMIT_AFTER_NANOS;
        (is_far || is_many || is_cut_off_long).then_some(&kept.sample)
    }

    /// The sample of [`Outgoing::next_to_save`] is saved: it may be committed.
    pub fn saved(&mut self) {
        if let Some(kept) = self.kept.get((self.committed - self.first) as usize) {
            self.committed_key = Some(kept.sample.key);
            self.committed += 1;
        }
    }

    /// The samples that are committed and not answered. A process that takes over needs them.
    pub fn committed(&self) -> impl ExactSizeIterator<Item = &KeptSample> {
        self.kept.iter().take((self.committed - self.first) as usize).map(|kept| &kept.sample)
    }

    /// The last sample that may be committed on this machine's cursors, so that the local writer goes on.
    pub fn commit_point(&self) -> Option<SampleId> {
        self.committed_key
    }

    /// The number of lost samples for a process that takes over. Of the samples that were sent and given up, only this process
    /// would learn whether the receiver has them.
    pub fn n_lost_to_save(&self) -> u64 {
        self.n_lost + self.unsettled.len() as u64
    }

    /// The writer has ended; `last` was its last sample and has been pushed.
    pub fn end(&mut self, last: Option<SampleId>) {
        self.end.get_or_insert(End { last, due_nanos: 0, is_to_say: true, is_done: false });
    }

    /// The end of the channel, if it is due: the request that it answers and the last sample. It is due when all
    /// samples are answered.
    pub fn end_to_send(&mut self, now_nanos: u64) -> Option<(u32, Option<SampleId>)> {
        let run = self.run.as_ref()?.number;
        let end = self.end.as_mut()?;
        if !end.is_to_say || !self.kept.is_empty() || now_nanos < end.due_nanos {
            return None;
        }
        end.due_nanos = now_nanos.saturating_add(END_PAUSE_NANOS);
        Some((run, end.last))
    }

    /// The receiver knows that the channel has ended.
    pub fn on_ended(&mut self) {
        if let Some(end) = &mut self.end {
            (end.is_to_say, end.is_done) = (false, true);
        }
    }

    /// Whether the writer has ended and the receiver knows this.
    pub fn is_done(&self) -> bool {
        self.end.as_ref().is_some_and(|end| end.is_done)
    }

    /// The receiver is gone or was restarted: nothing is sent until it requests samples.
    pub fn cut_off(&mut self) {
        self.run = None;
        self.is_catching_up = true;
        (self.full_since_nanos, self.is_stalled) = (None, false);
    }

    /// This process ends without a successor: the samples that are not acknowledged are lost.
    pub fn give_up(&mut self) {
        self.n_lost += self.n_waiting() + self.unsettled.len() as u64;
        self.unsettled.clear();
        while !self.kept.is_empty() {
            self.remove_first();
        }
    }

    /// Number of samples that the receiver has not acknowledged.
    pub fn n_waiting(&self) -> u64 {
        let waiting = self.kept.iter().filter(|kept| match (kept.sent, &self.run) {
            (Some(sent), Some(run)) => sent.run != run.number || sent.index >= run.n_received,
            _ => true,
        });
        waiting.count() as u64
    }

    /// For `ps`; `port` is `NODE/PORT`. A sample that was sent and then given up counts as lost when the receiver says
    /// that it does not have it.
    pub fn status(&self, port: &str, now_nanos: u64) -> ChannelStatus {
        let now_blocked_nanos = self.blocked_since_nanos.map_or(0, |since_nanos| now_nanos.saturating_sub(since_nanos));
        ChannelStatus {
            port: port.to_owned(),
            is_sent: true,
            n_samples: self.n_samples,
            n_repeated: self.n_repeated,
            n_waiting: self.n_waiting(),
            n_lost: self.n_lost,
            blocked_nanos: self.blocked_nanos + now_blocked_nanos,
        }
    }

    fn end_position(&self) -> u64 {
        self.first + self.kept.len() as u64
    }

    fn remove_first(&mut self) -> Option<Kept> {
        let removed = self.kept.pop_front()?;
        self.first += 1;
        self.cursor = self.cursor.max(self.first);
        self.reached = self.reached.max(self.first);
        self.last_removed = Some(removed.sample.key);
        if self.committed < self.first {
            self.committed = self.first;
            self.committed_key = Some(removed.sample.key);
        }
        Some(removed)
    }

    /// Gives up the oldest sample, because there is no room or a newer one.
    fn give_up_first(&mut self) {
        // The receiver may have the sample: it was sent or had, and was not requested again.
        let may_be_had = self.first < if self.run.is_some() { self.cursor } else { self.reached };
        match self.remove_first() {
            Some(_) if !may_be_had => self.n_lost += 1,
            Some(Kept { sent: Some(sent), sample, .. }) => self.unsettled.push_back((sent, sample.key)),
            _ => {}
        }
        // A receiver that says nothing for ever must not fill the memory.
        if self.unsettled.len() > self.options.buffer {
            self.unsettled.pop_front();
            self.n_lost += 1;
        }
    }

    /// The position after a sample that the receiver has. If no sample of its epoch is kept, this epoch is over or
    /// belongs to an earlier run of this machine's part of the graph; then the receiver lacks all kept samples. But a
    /// process that took over from another one may not have reached the position of that one yet.
    fn position_after(&self, key: &SampleId) -> u64 {
        let found = self.kept.iter().rposition(|kept| kept.sample.key == *key);
        match found.or_else(|| self.kept.iter().rposition(|kept| self.is_before_or_at(&kept.sample.key, key))) {
            Some(idx) => self.first + idx as u64 + 1,
            None => self.first,
        }
    }

    fn is_before_or_at(&self, kept: &SampleId, key: &SampleId) -> bool {
        if kept.epoch == key.epoch {
            return kept.seq <= key.seq;
        }
        self.written.is_some_and(|written| written.is_past(*key, *kept))
    }

    /// The receiver has the samples up to `after`. Of the samples that were sent and are no longer kept, those behind
    /// it are lost. A sample that is unknown here is older than all of them.
    fn settle(&mut self, after: Option<SampleId>) {
        let n_lost = match after {
            Some(key) if self.kept.iter().any(|kept| kept.sample.key == key) => 0,
            _ => {
                let last_had = self.unsettled.iter().rposition(|(_, unsettled)| Some(*unsettled) == after);
                self.unsettled.len() - last_had.map_or(0, |idx| idx + 1)
            }
        };
        self.n_lost += n_lost as u64;
        self.unsettled.clear();
    }
}

#[cfg(test)]
mod model;
#[cfg(test)]
mod tests;
