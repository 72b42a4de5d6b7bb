//! The sending end of a channel: what is sent now, what is kept, and what is given up. It does no I/O and reads no clock.
//!
//! A sample is kept until the receiver's readers have answered it. The receiver says from where on it wants samples; from
//! there they are numbered, so that it notices what is lost on the way and asks again. What it cannot notice, the loss of
//! the last one, is noticed here: nothing says that it came, and it is sent again.
//!
//! * **Lossless**: while the receiver asks, at most `window` samples are on their way or unanswered, and then the channel
//!   takes no more from its writer. While it is cut off, up to `buffer` are taken; beyond that the oldest are given up.
//! * **Latest**: only the newest is kept.
//!
//! Places in the stream are places in the order in which samples were pushed. Their keys order them within an epoch only:
//! a recording that is played has the epochs that were recorded, and a machine's clock may have been set back.

use std::collections::VecDeque;

use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::link_status::ChannelStatus;
use blindgrasp_operator::wiring::EdgePolicy;

/// How long nothing needs to say that a sample came before it is sent again; twice as long each time.
const FIRST_PROBE_NANOS: u64 = 250_000_000;
const LONGEST_PROBE_NANOS: u64 = 2_000_000_000;
/// How long the end of a channel may go unanswered before it is said again.
const END_PAUSE_NANOS: u64 = 100_000_000;
/// How long a writer's place may lag behind what was taken from it while the receiver is cut off: a writer begins a new
/// epoch when everybody has answered the one before, and must not wait for a machine that is not there.
const COMMIT_AFTER_NANOS: u64 = 50_000_000;

/// How a channel is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutgoingOptions {
    /// What gives way.
    pub policy: EdgePolicy,
    /// The most samples on their way or unanswered, at least 1.
    pub window: usize,
    /// How far the local writer may get ahead of this reader of its port.
    pub capacity: usize,
    /// How many samples are kept while the receiver is cut off; never fewer than `window`.
    pub buffer: usize,
}

/// The sending end of a channel.
#[derive(Debug)]
pub struct Outgoing {
    options: OutgoingOptions,
    /// Where this process took over from an earlier one that had sent already.
    begun_after: Option<SampleId>,
    /// What is kept, in the order in which it was pushed.
    kept: VecDeque<Kept>,
    /// The place of the first of them: places count what was pushed.
    first: u64,
    /// The place of the next to send.
    cursor: u64,
    /// Samples before this place were sent, or the receiver had them.
    reached: u64,
    /// Up to where the local place may be committed.
    committed: u64,
    committed_key: Option<SampleId>,
    /// The last sample that is not kept any more.
    last_removed: Option<SampleId>,
    /// What the receiver has that was not pushed yet: it comes again after a restart of this process.
    skip: Option<SampleId>,
    /// Sent and not kept any more, and nothing says that they came.
    unsettled: VecDeque<(Sent, SampleId)>,
    run: Option<Run>,
    had_resume: bool,
    is_catching_up: bool,
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
    /// The receiver's request that it answers.
    pub run: u32,
    /// Its index in the run.
    pub index: u64,
    /// Which sample.
    pub key: SampleId,
    /// The encoded message.
    pub message: &'a [u8],
    /// When its source published it, by this machine's clock; 0 if unknown.
    pub origin_nanos: u64,
    /// Whether it went before.
    pub is_repeat: bool,
}

#[derive(Debug)]
struct Kept {
    key: SampleId,
    message: Vec<u8>,
    origin_nanos: u64,
    pushed_nanos: u64,
    sent: Option<Sent>,
}

/// When a sample went last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sent {
    run: u32,
    index: u64,
}

/// A request of the receiver.
#[derive(Debug)]
struct Run {
    number: u32,
    n_sent: u64,
    n_received: u64,
    probe_due_nanos: u64,
    probe_pause_nanos: u64,
}

#[derive(Debug)]
struct End {
    last: Option<SampleId>,
    due_nanos: u64,
    is_to_say: bool,
    is_done: bool,
}

impl Outgoing {
    /// A channel whose local place on the cursors is `begun_after`: `None` in a graph that has just started.
    pub fn new(options: OutgoingOptions, begun_after: Option<SampleId>) -> Self {
        let window = options.window.max(1);
        Outgoing {
            options: OutgoingOptions { window, buffer: options.buffer.max(window), ..options },
            begun_after,
            kept: VecDeque::new(),
            first: 0,
            cursor: 0,
            reached: 0,
            committed: 0,
            committed_key: begun_after,
            last_removed: begun_after,
            skip: None,
            unsettled: VecDeque::new(),
            run: None,
            had_resume: false,
            is_catching_up: true,
            blocked_since_nanos: None,
            end: None,
            n_samples: 0,
            n_repeated: 0,
            n_lost: 0,
            blocked_nanos: 0,
        }
    }

    /// Whether to take another sample from the local writer. Not while the receiver is up and behind; the time until it
    /// is asked again and says yes counts as blocked. After a cut, what came in meanwhile goes out without holding up the
    /// writer, as long as the buffer has room.
    pub fn wants_more(&mut self, is_up: bool, now_nanos: u64) -> bool {
        let n_kept = self.kept.len();
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

    /// Takes a sample from the local writer, encoded.
    pub fn push(&mut self, key: SampleId, message: Vec<u8>, origin_nanos: u64, now_nanos: u64) {
        let most_before = match self.options.policy {
            EdgePolicy::Lossless => self.options.buffer - 1,
            EdgePolicy::Latest => 0,
        };
        while self.kept.len() > most_before {
            self.give_up_first();
        }
        self.kept.push_back(Kept { key, message, origin_nanos, pushed_nanos: now_nanos, sent: None });
        if let Some(had) = self.skip {
            if self.is_before_or_at(&key, &had) {
                self.cursor = self.end_place();
                self.reached = self.reached.max(self.cursor);
            } else {
                self.skip = None;
            }
        }
    }

    /// The receiver wants samples from here on. A request that came before is none.
    pub fn on_resume(&mut self, run: u32, after: Option<SampleId>) {
        if self.run.as_ref().is_some_and(|current| run <= current.number) {
            return;
        }
        self.settle(after);
        if !std::mem::replace(&mut self.had_resume, true) {
            self.count_lost_before_start(after);
        }
        self.cursor = after.map_or(self.first, |key| self.place_after(&key));
        self.reached = self.reached.max(self.cursor);
        let is_known =
            |key: &SampleId| self.last_removed == Some(*key) || self.kept.iter().any(|kept| kept.key == *key);
        self.skip = after.filter(|key| self.cursor == self.end_place() && !is_known(key));
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

    /// The next sample to send, if there is one now; to be asked until there is none.
    pub fn next(&mut self, now_nanos: u64) -> Option<Next<'_>> {
        let end_place = self.end_place();
        let run = self.run.as_mut()?;
        let is_latest = self.options.policy == EdgePolicy::Latest;
        let n_on_their_way = if is_latest { run.n_sent - run.n_received } else { self.cursor - self.first };
        let is_probe_due = run.n_sent > run.n_received && now_nanos >= run.probe_due_nanos;
        let has_room = n_on_their_way < self.options.window as u64;
        let (place, index) = if self.cursor < end_place && (has_room || (is_latest && is_probe_due)) {
            self.cursor += 1;
            run.n_sent += 1;
            (self.cursor - 1, run.n_sent - 1)
        } else if is_probe_due {
            // The last one again, if it is still kept: the receiver notices what else it lacks.
            let place = self.cursor.checked_sub(1).filter(|place| *place >= self.first)?;
            (place, run.n_sent - 1)
        } else {
            return None;
        };
        let sent = Sent { run: run.number, index };
        let kept = self.kept.get_mut((place - self.first) as usize)?;
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
        let Kept { key, origin_nanos, .. } = *kept;
        Some(Next { run: sent.run, index, key, message: &kept.message, origin_nanos, is_repeat })
    }

    /// The receiver has `n_received` samples of a run, and its readers have answered all up to a key.
    pub fn on_ack(&mut self, run: u32, n_received: u64, answered: Option<SampleId>, now_nanos: u64) {
        if let Some(current) = self.run.as_mut().filter(|current| current.number == run) {
            let n_received = n_received.min(current.n_sent);
            if n_received > current.n_received {
                current.n_received = n_received;
                current.probe_pause_nanos = FIRST_PROBE_NANOS;
                current.probe_due_nanos = now_nanos.saturating_add(FIRST_PROBE_NANOS);
            }
            if self.options.policy == EdgePolicy::Latest {
                // What was lost on the way before these, the receiver has counted.
                self.unsettled.retain(|(sent, _)| sent.run != run || sent.index >= n_received);
            }
        }
        let Some(key) = answered else { return };
        let exactly = self.kept.iter().position(|kept| kept.key == key);
        let place = match exactly {
            Some(idx) => self.first + idx as u64 + 1,
            None => self.place_after(&key),
        };
        // Nobody answers what was not sent.
        while self.first < place.min(self.reached) {
            self.remove_first();
            // The receiver has had its chance to say that it lacks something before.
            self.unsettled.clear();
        }
    }

    /// Up to where the place on this machine's cursors may be committed, so that the local writer goes on: what is answered,
    /// and what lies in this process's memory only because the writer must not wait for it.
    pub fn commit_point(&mut self, now_nanos: u64) -> Option<SampleId> {
        let Some(newest) = self.kept.back().map(|kept| kept.key) else { return self.committed_key };
        if self.options.policy == EdgePolicy::Lossless {
            let capacity = self.options.capacity as u64;
            let most = capacity - (capacity / 4).max(1).min(capacity);
            while let Some(kept) = self.kept.get((self.committed - self.first) as usize) {
                // The writer counts numbers, not samples.
                let is_far = newest.epoch == kept.key.epoch && newest.seq.saturating_sub(kept.key.seq) >= most;
                let is_many = self.end_place() - self.committed > most;
                let is_cut_off_long =
                    self.run.is_none() && now_nanos.saturating_sub(kept.pushed_nanos) >= COMMIT_AFTER_NANOS;
                if !is_far && !is_many && !is_cut_off_long {
                    break;
                }
                self.committed_key = Some(kept.key);
                self.committed += 1;
            }
        }
        self.committed_key
    }

    /// The writer has ended for good; `last` was its last sample, and has been pushed.
    pub fn end(&mut self, last: Option<SampleId>) {
        self.end.get_or_insert(End { last, due_nanos: 0, is_to_say: true, is_done: false });
    }

    /// The end to be said now: the request that it answers and the last sample. Not before all is answered.
    pub fn end_to_send(&mut self, now_nanos: u64) -> Option<(u32, Option<SampleId>)> {
        let run = self.run.as_ref()?.number;
        let end = self.end.as_mut()?;
        if !end.is_to_say || !self.kept.is_empty() || now_nanos < end.due_nanos {
            return None;
        }
        end.due_nanos = now_nanos.saturating_add(END_PAUSE_NANOS);
        Some((run, end.last))
    }

    /// The receiver knows of the end.
    pub fn on_ended(&mut self) {
        if let Some(end) = &mut self.end {
            (end.is_to_say, end.is_done) = (false, true);
        }
    }

    /// Whether the writer has ended and the receiver knows it.
    pub fn is_done(&self) -> bool {
        self.end.as_ref().is_some_and(|end| end.is_done)
    }

    /// The receiver is gone, or another instance of it has come: nothing is sent until it asks.
    pub fn cut_off(&mut self) {
        self.run = None;
        self.is_catching_up = true;
    }

    /// This process ends, and nobody goes on in its place: what the receiver is not known to have is lost.
    pub fn give_up(&mut self) {
        self.n_lost += self.n_waiting() + self.unsettled.len() as u64;
        self.unsettled.clear();
        while !self.kept.is_empty() {
            self.remove_first();
        }
    }

    /// How many samples the receiver is not known to have.
    pub fn n_waiting(&self) -> u64 {
        let is_waiting = |kept: &&Kept| match (kept.sent, &self.run) {
            (Some(sent), Some(run)) => sent.run != run.number || sent.index >= run.n_received,
            _ => true,
        };
        self.kept.iter().filter(is_waiting).count() as u64
    }

    /// For `ps`; `port` is `NODE/PORT`. What is given up after it was sent counts as lost once the receiver says that it
    /// has not got it.
    pub fn status(&self, port: &str, now_nanos: u64) -> ChannelStatus {
        let since = |since_nanos| now_nanos.saturating_sub(since_nanos);
        ChannelStatus {
            port: port.to_owned(),
            is_sent: true,
            n_samples: self.n_samples,
            n_repeated: self.n_repeated,
            n_waiting: self.n_waiting(),
            n_lost: self.n_lost,
            blocked_nanos: self.blocked_nanos + self.blocked_since_nanos.map_or(0, since),
        }
    }

    fn end_place(&self) -> u64 {
        self.first + self.kept.len() as u64
    }

    fn remove_first(&mut self) -> Option<Kept> {
        let removed = self.kept.pop_front()?;
        self.first += 1;
        self.cursor = self.cursor.max(self.first);
        self.reached = self.reached.max(self.first);
        self.last_removed = Some(removed.key);
        if self.committed < self.first {
            self.committed = self.first;
            self.committed_key = Some(removed.key);
        }
        Some(removed)
    }

    /// For want of room, or because there is a newer one.
    fn give_up_first(&mut self) {
        // Sent or had, and not asked for again.
        let may_be_had = self.first < if self.run.is_some() { self.cursor } else { self.reached };
        match self.remove_first() {
            Some(_) if !may_be_had => self.n_lost += 1,
            Some(Kept { sent: Some(sent), key, .. }) => self.unsettled.push_back((sent, key)),
            _ => {}
        }
    }

    /// The place behind a sample that the receiver has. Of an epoch of which nothing is kept, it is either one that is over,
    /// or of an earlier life of this machine's part of the graph: then the receiver lacks all that is kept. But a process
    /// that took over from another one may not have come again to where that one was.
    fn place_after(&self, key: &SampleId) -> u64 {
        let last = |is_before: &dyn Fn(&SampleId) -> bool| {
            self.kept.iter().rposition(|kept| is_before(&kept.key)).map(|idx| self.first + idx as u64 + 1)
        };
        last(&|kept| kept == key).or_else(|| last(&|kept| self.is_before_or_at(kept, key))).unwrap_or(self.first)
    }

    fn is_before_or_at(&self, kept: &SampleId, key: &SampleId) -> bool {
        let is_over = self.last_removed.is_some_and(|removed| removed.epoch == key.epoch);
        if kept.epoch == key.epoch {
            kept.seq <= key.seq
        } else {
            self.begun_after.is_some() && !is_over && kept.epoch < key.epoch
        }
    }

    /// The receiver says what it has: of what went and is not kept, all behind that is lost. What it has and is not known
    /// here any more came before.
    fn settle(&mut self, after: Option<SampleId>) {
        let n_lost = match after {
            Some(key) if self.kept.iter().any(|kept| kept.key == key) => 0,
            _ => {
                let last_had = self.unsettled.iter().rposition(|(_, unsettled)| Some(*unsettled) == after);
                self.unsettled.len() - last_had.map_or(0, |idx| idx + 1)
            }
        };
        self.n_lost += n_lost as u64;
        self.unsettled.clear();
    }

    /// What an earlier process had taken from the writer, and its memory was the only place where it lay.
    fn count_lost_before_start(&mut self, after: Option<SampleId>) {
        if self.options.policy == EdgePolicy::Latest {
            return;
        }
        if let (Some(place), Some(had)) = (self.begun_after, after) {
            self.n_lost += match place.epoch.cmp(&had.epoch) {
                std::cmp::Ordering::Equal => place.seq.saturating_sub(had.seq),
                std::cmp::Ordering::Greater => place.seq.saturating_add(1),
                std::cmp::Ordering::Less => 0,
            };
        }
    }
}

#[cfg(test)]
mod tests;
