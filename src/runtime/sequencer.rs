//! Puts the samples of one input in order, each once, whoever sent them.
//!
//! While one instance of a node hands over to another, its reader has two publishers, and iceoryx2 keeps no order
//! between them: the new one's first sample may come before the old one's last. After a crash the new one sends again
//! what the old one may not have got through. So a reader takes samples by their number: what came already is dropped,
//! what comes early is held until its turn, and what does not come within a bounded wait is counted as missing.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::board::Key;
use super::wiring::InputCounts;

/// How long a sample that came early waits for those before it.
pub const HOLD_LIMIT: Duration = Duration::from_millis(50);

/// The order of one input. Without clock: the caller says what time it is.
pub struct Sequencer<T> {
    /// The last sample delivered.
    last: Option<Key>,
    /// Samples up to here were answered by an earlier instance, and its answers were received: dropped.
    answered: Option<Key>,
    /// Samples up to here were counted by an earlier instance: delivered, not counted again.
    counted: Option<Key>,
    /// Whether the stream is expected to begin at 0: what is before the first sample is missing.
    begins_at_zero: bool,
    /// The last sample of each publisher.
    publishers: Vec<(u128, Key)>,
    held: BTreeMap<Key, T>,
    held_since: Option<Instant>,
    /// How many samples may be held; the wait of the first is over when there are so many.
    max_held: usize,
    counts: InputCounts,
}

/// What becomes of a sample.
#[derive(Debug, PartialEq, Eq)]
pub enum Verdict<T> {
    /// It is its turn.
    Deliver(T),
    /// It came early.
    Hold,
    /// It came already.
    Drop,
}

impl<T> Sequencer<T> {
    /// For a reader that looks on from wherever it comes in, and can hold `max_held` samples.
    pub fn onlooker(max_held: usize) -> Self {
        Sequencer {
            last: None,
            answered: None,
            counted: None,
            begins_at_zero: false,
            publishers: Vec::new(),
            held: BTreeMap::new(),
            held_since: None,
            max_held: max_held.max(1),
            counts: InputCounts::default(),
        }
    }

    /// For a reader that goes on where an earlier instance of it left off.
    ///
    /// `counted` is the last sample that one has answered, with its counts; `answered` the last one whose answer has been
    /// received by all that read it. What lies between is answered again.
    pub fn resume(answered: Option<Key>, counted: Option<Key>, counts: InputCounts, max_held: usize) -> Self {
        let is_behind = |answered: &Key| counted.is_some_and(|counted| is_at_most(answered, &counted));
        let answered = answered.filter(is_behind);
        Sequencer {
            // Nothing is missed between what was answered and what was counted: it was received then.
            last: answered,
            answered,
            counted,
            begins_at_zero: true,
            counts,
            ..Self::onlooker(max_held)
        }
    }

    /// What has come in.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    /// Counts a sample that was late.
    pub fn count_late(&mut self) {
        self.counts.n_late += 1;
    }

    /// Takes a sample. `has_other_publishers` is asked where a sample came early: whether anybody else may still have what
    /// comes before it.
    pub fn push(
        &mut self,
        sample: T,
        key: Key,
        publisher: u128,
        has_other_publishers: impl FnOnce() -> bool,
        now: impl FnOnce() -> Instant,
    ) -> Verdict<T> {
        let before = self.publishers.iter().position(|(id, _)| *id == publisher);
        let goes_back = before.is_some_and(|idx| is_at_most(&key, &self.publishers[idx].1));
        match before {
            Some(idx) if !goes_back => self.publishers[idx].1 = key,
            Some(_) => {}
            None => self.publishers.push((publisher, key)),
        }
        if goes_back {
            // No restart or swap explains this: the stage sees it as it is, and whoever judges the order too.
            self.counts.n_repeated += 1;
            return Verdict::Deliver(sample);
        }
        if self.last.is_some_and(|last| is_at_most(&key, &last)) || self.held.contains_key(&key) {
            // An earlier instance has counted it.
            let is_known = self.answered.is_some_and(|answered| is_at_most(&key, &answered));
            self.counts.n_repeated += u64::from(!is_known);
            return Verdict::Drop;
        }
        let n_before = self.n_before(&key);
        if n_before > 0 && (self.publishers.len() > 1 || !self.held.is_empty() || has_other_publishers()) {
            self.held.insert(key, sample);
            self.held_since.get_or_insert_with(now);
            return Verdict::Hold;
        }
        self.deliver(key, n_before);
        Verdict::Deliver(sample)
    }

    /// The next held sample whose turn it is, or whose wait is over.
    pub fn next_held(&mut self, now: Instant) -> Option<T> {
        let (key, _) = self.held.first_key_value()?;
        let (key, n_before) = (*key, self.n_before(key));
        let is_full = self.held.len() >= self.max_held;
        let is_over = is_full || self.held_since.is_none_or(|since| now.duration_since(since) >= HOLD_LIMIT);
        if n_before > 0 && !is_over {
            return None;
        }
        let sample = self.held.remove(&key)?;
        if self.held.is_empty() {
            self.held_since = None;
        }
        self.counts.n_reordered += u64::from(n_before == 0);
        self.deliver(key, n_before);
        Some(sample)
    }

    /// When the wait of the held samples is over.
    pub fn deadline(&self) -> Option<Instant> {
        self.held_since.map(|since| since + HOLD_LIMIT)
    }

    /// How many samples are held.
    pub fn n_held(&self) -> usize {
        self.held.len()
    }

    /// How many samples of the stream come before `key` and have not.
    fn n_before(&self, key: &Key) -> u64 {
        match self.last {
            Some(last) if last.epoch == key.epoch => key.seq - last.seq - 1,
            // A new epoch begins wherever it begins.
            Some(_) => 0,
            None if self.begins_at_zero => self.counted.map_or(key.seq, |_| 0),
            None => 0,
        }
    }

    fn deliver(&mut self, key: Key, n_missing: u64) {
        self.last = Some(key);
        if self.counted.is_some_and(|counted| is_at_most(&key, &counted)) {
            return;
        }
        // What an earlier instance counted is not missing, though it may not have come again.
        let n_counted = match (self.counted, n_missing) {
            (Some(counted), 1..) if counted.epoch == key.epoch => {
                n_missing.min(counted.seq.saturating_sub(key.seq - n_missing - 1))
            }
            _ => 0,
        };
        self.counts.n_missing += n_missing - n_counted;
        self.counts.n_received += 1;
    }
}

/// Whether `key` is `other` or before it in the same epoch.
fn is_at_most(key: &Key, other: &Key) -> bool {
    key.epoch == other.epoch && key.seq <= other.seq
}
