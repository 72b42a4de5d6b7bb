//! Puts the samples of one input in order, each once, whichever publisher sent them.
//!
//! While one instance of a node hands over to another, its reader has two publishers, and iceoryx2 keeps no order
//! between them: the new instance's first sample may come before the old one's last. After a crash the new instance sends
//! those samples again that the old one may not have delivered. So a reader takes samples by their number: it drops
//! duplicates, holds early samples until their turn, and counts samples as missing that do not come within a bounded wait.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::cursors::SampleId;
use crate::wiring::InputCounts;

/// An early sample waits so long for those before it.
pub const HOLD_LIMIT: Duration = Duration::from_millis(50);

/// The order of one input. It has no clock: the caller gives the time.
pub struct Sequencer<T> {
    /// The last sample delivered.
    last: Option<SampleId>,
    /// Samples up to here were answered by an earlier instance, and its answers were received: dropped.
    answered: Option<SampleId>,
    /// Samples up to here were counted by an earlier instance: delivered, not counted again.
    counted: Option<SampleId>,
    /// Whether the stream is expected to begin at 0, so that numbers before the first sample are missing.
    begins_at_zero: bool,
    /// The last sample of each publisher.
    publishers: Vec<(u128, SampleId)>,
    /// Early samples, and when they came.
    held: BTreeMap<SampleId, (T, Instant)>,
    /// Whether samples wait for those before them at all.
    may_hold: bool,
    counts: InputCounts,
}

/// What to do with a sample.
#[derive(Debug, PartialEq, Eq)]
pub enum Verdict<T> {
    Deliver(T),
    /// The sample is early.
    Hold,
    /// The sample is a duplicate.
    Drop,
}

impl<T> Sequencer<T> {
    /// The order of a reader that begins with whatever sample comes first.
    pub fn onlooker() -> Self {
        Sequencer {
            last: None,
            answered: None,
            counted: None,
            begins_at_zero: false,
            publishers: Vec::new(),
            held: BTreeMap::new(),
            may_hold: true,
            counts: InputCounts::default(),
        }
    }

    /// The order of a reader that goes on where an earlier instance left off.
    ///
    /// `counted` is the last sample that the earlier instance has answered, with its counts; `answered` is the last sample
    /// whose answer all readers have received. The samples between them are answered again.
    pub fn resume(answered: Option<SampleId>, counted: Option<SampleId>, counts: InputCounts) -> Self {
        // If they are of different epochs, `answered` has no meaning.
        let answered = answered.zip(counted).filter(|(answered, counted)| answered.epoch == counted.epoch);
        let answered = answered.map(|(answered, counted)| answered.min(counted));
        Sequencer {
            // Nothing is missing between the two: the earlier instance received it.
            last: answered,
            answered,
            counted,
            begins_at_zero: true,
            counts,
            ..Self::onlooker()
        }
    }

    /// The order of an edge on which samples may be dropped: no sample waits for those before it.
    pub fn without_waiting(self) -> Self {
        Sequencer { may_hold: false, ..self }
    }

    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    pub fn count_late(&mut self) {
        self.counts.n_late += 1;
    }

    /// Takes a sample. If the sample is early, `has_other_publishers` is asked whether another publisher may still have the
    /// samples before it.
    pub fn push(
        &mut self,
        sample: T,
        key: SampleId,
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
            // No restart or swap explains this: the stage sees the sample as it is.
            self.counts.n_repeated += 1;
            return Verdict::Deliver(sample);
        }
        if self.last.is_some_and(|last| is_at_most(&key, &last)) || self.held.contains_key(&key) {
            // An earlier instance has counted the sample.
            let is_known = self.answered.is_some_and(|answered| is_at_most(&key, &answered));
            self.counts.n_repeated += u64::from(!is_known);
            return Verdict::Drop;
        }
        let n_before = self.n_before(&key);
        let may_come = || self.publishers.len() > 1 || !self.held.is_empty() || has_other_publishers();
        if n_before > 0 && self.may_hold && may_come() {
            self.held.insert(key, (sample, now()));
            return Verdict::Hold;
        }
        self.deliver(key, n_before);
        Verdict::Deliver(sample)
    }

    /// The next held sample, if it is its turn.
    pub fn next_in_order(&mut self) -> Option<T> {
        let (key, _) = self.held.first_key_value()?;
        if self.n_before(key) > 0 {
            return None;
        }
        self.counts.n_reordered += 1;
        self.first_held()
    }

    /// The next held sample, if its wait is over. Ask for it only when no more samples have come: after a long stop, the
    /// samples that it waits for may lie in the queue.
    pub fn next_overdue(&mut self, now: Instant) -> Option<T> {
        let (_, (_, since)) = self.held.first_key_value()?;
        if now.duration_since(*since) < HOLD_LIMIT {
            return None;
        }
        self.first_held()
    }

    /// The first of the held samples, even if others are missing before it.
    pub fn first_held(&mut self) -> Option<T> {
        let (key, (sample, _)) = self.held.pop_first()?;
        let n_before = self.n_before(&key);
        if n_before > 0 {
            // No publisher had the missing samples: the next gap is waited for only if a new publisher has come.
            self.publishers.clear();
        }
        self.deliver(key, n_before);
        Some(sample)
    }

    /// Takes over the samples that an earlier order of the same reader held, and a sample that was put back.
    pub fn hold_again(&mut self, before: Self, put_back: Option<(SampleId, T)>, now: Instant) {
        let held = before.held.into_iter().chain(put_back.map(|(key, sample)| (key, (sample, now))));
        let last = self.last.or(self.counted);
        let is_done = |key: &SampleId| last.is_some_and(|last| is_at_most(key, &last));
        self.held = held.filter(|(key, _)| !is_done(key)).collect();
    }

    /// When the wait of the next held sample is over.
    pub fn deadline(&self) -> Option<Instant> {
        self.held.first_key_value().map(|(_, (_, since))| *since + HOLD_LIMIT)
    }

    pub fn n_held(&self) -> usize {
        self.held.len()
    }

    /// The number of samples before `key` that have not come.
    fn n_before(&self, key: &SampleId) -> u64 {
        match self.last {
            Some(last) if last.epoch == key.epoch => key.seq - last.seq - 1,
            // A new epoch may begin at any number.
            Some(_) => 0,
            None if self.begins_at_zero => self.counted.map_or(key.seq, |_| 0),
            None => 0,
        }
    }

    fn deliver(&mut self, key: SampleId, n_missing: u64) {
        self.last = Some(key);
        if self.counted.is_some_and(|counted| is_at_most(&key, &counted)) {
            return;
        }
        // Samples that an earlier instance counted are not missing, though they may not have come again.
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
fn is_at_most(key: &SampleId, other: &SampleId) -> bool {
    key.epoch == other.epoch && key.seq <= other.seq
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A sample on its way: when it comes, its number, and whose it is.
    type Arrival = (Duration, u64, u128);

    const EPOCH: u64 = 7;

    /// What up to three publishers send, each of which takes over from the one before and sends its last few samples again;
    /// whose last few do not come if it has crashed. Samples come up to 40 ms late, those of one publisher in order.
    /// `skipped` are never sent.
    fn arrivals(rng: &mut ChaCha8Rng, n_samples: u64, skipped: &[u64]) -> Vec<Arrival> {
        let mut arrivals = Vec::new();
        let (mut now, mut first) = (Duration::ZERO, 0);
        let n_publishers = rng.random_range(1..=3);
        for publisher in 0..n_publishers {
            let end = if publisher + 1 == n_publishers { n_samples } else { rng.random_range(first..=n_samples) };
            let n_again = rng.random_range(0..=first.min(5));
            // What its successor sends again may be lost with it, if it is lost without a trace for the rest as well.
            let mut own = Vec::new();
            let mut last = Duration::ZERO;
            for seq in (first - n_again..end).filter(|seq| !skipped.contains(seq)) {
                now += Duration::from_micros(rng.random_range(0..4000));
                last = last.max(now + Duration::from_micros(rng.random_range(0..40_000)));
                own.push((last, seq, publisher));
            }
            arrivals.push(own);
            first = end;
        }
        for at in 1..arrivals.len() {
            let again = arrivals[at].first().map_or(u64::MAX, |(_, seq, _)| *seq);
            let n_lost = arrivals[at - 1].iter().filter(|(_, seq, _)| *seq >= again).count();
            if rng.random_bool(0.5) {
                let n = arrivals[at - 1].len();
                arrivals[at - 1].truncate(n - n_lost);
            }
        }
        let mut arrivals: Vec<Arrival> = arrivals.into_iter().flatten().collect();
        arrivals.sort_by_key(|(at, ..)| *at);
        arrivals
    }

    /// Reads as a subscriber does, each time after a pause of up to `max_pause`; what has come from several publishers is
    /// taken in any order between them.
    fn received(
        rng: &mut ChaCha8Rng,
        sequencer: &mut Sequencer<u64>,
        arrivals: &[Arrival],
        max_pause: Duration,
    ) -> Vec<u64> {
        let start = Instant::now();
        let mut now = Duration::ZERO;
        let mut waiting = arrivals.to_vec();
        let mut received = Vec::new();
        while !waiting.is_empty() || sequencer.n_held() > 0 {
            now += max_pause.mul_f64(rng.random_range(0.0..1.0));
            loop {
                if let Some(seq) = sequencer.next_in_order() {
                    received.push(seq);
                    continue;
                }
                let publisher = rng.random_range(0..3);
                let is_there = |(at, ..): &Arrival| *at <= now;
                let of_publisher = |arrival: &Arrival| is_there(arrival) && arrival.2 == publisher;
                if let Some(next) = waiting.iter().position(of_publisher) {
                    let (_, seq, publisher) = waiting.remove(next);
                    let verdict =
                        sequencer.push(seq, SampleId { epoch: EPOCH, seq }, publisher, || true, || start + now);
                    if let Verdict::Deliver(seq) = verdict {
                        received.push(seq);
                    }
                } else if !waiting.iter().any(is_there) {
                    match sequencer.next_overdue(start + now) {
                        Some(seq) => received.push(seq),
                        None => break,
                    }
                }
            }
        }
        received
    }

    #[test]
    fn whoever_sends_them_in_whatever_order_each_sample_is_delivered_once_in_order() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let (mut n_reordered, mut n_repeated, mut n_missing) = (0, 0, 0);
        for round in 0..3000 {
            let n_samples = rng.random_range(1..60);
            let skipped: Vec<u64> = (0..n_samples).filter(|_| round % 2 == 1 && rng.random_bool(0.05)).collect();
            let arrivals = arrivals(&mut rng, n_samples, &skipped);
            // Also a reader that is stopped for longer than samples wait.
            let max_pause = Duration::from_millis([1, 10, 200][round % 3]);
            let mut sequencer = Sequencer::resume(None, None, InputCounts::default());
            let received = received(&mut rng, &mut sequencer, &arrivals, max_pause);
            let expected: Vec<u64> = (0..n_samples).filter(|seq| !skipped.contains(seq)).collect();
            assert_eq!(received, expected, "{arrivals:?}");
            let counts = sequencer.counts();
            let n_skipped_before_last =
                expected.last().map_or(0, |last| skipped.iter().filter(|seq| *seq < last).count());
            assert_eq!(counts.n_received, expected.len() as u64, "{arrivals:?}");
            assert_eq!(counts.n_missing, n_skipped_before_last as u64, "{arrivals:?}");
            assert_eq!(counts.n_repeated, (arrivals.len() - expected.len()) as u64, "{arrivals:?}");
            n_reordered += counts.n_reordered;
            n_repeated += counts.n_repeated;
            n_missing += counts.n_missing;
        }
        assert!(n_reordered > 100 && n_repeated > 100 && n_missing > 100, "{n_reordered} {n_repeated} {n_missing}");
    }

    /// A reader that dies after any sample, and whose successor asks again for what it had answered in vain.
    #[test]
    fn a_reader_that_comes_back_answers_the_rest_and_counts_each_sample_once() {
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        for _ in 0..3000 {
            let n_samples = rng.random_range(2..60);
            let skipped: Vec<u64> = (0..n_samples).filter(|_| rng.random_bool(0.05)).collect();
            let sent: Vec<u64> = (0..n_samples).filter(|seq| !skipped.contains(seq)).collect();
            if sent.is_empty() {
                continue;
            }
            let push = |sequencer: &mut Sequencer<u64>, seq: u64| {
                sequencer.push(seq, SampleId { epoch: EPOCH, seq }, 0, || false, Instant::now) == Verdict::Deliver(seq)
            };
            let n_counted = rng.random_range(0..=sent.len());
            let n_answered = rng.random_range(0..=n_counted);
            let mut first = Sequencer::resume(None, None, InputCounts::default());
            assert!(sent[..n_counted].iter().all(|seq| push(&mut first, *seq)));
            let key = |n: usize| (n > 0).then(|| SampleId { epoch: EPOCH, seq: sent[n - 1] });
            let mut second = Sequencer::resume(key(n_answered), key(n_counted), first.counts());
            // The history reaches back to what is not answered, or further.
            let from = rng.random_range(0..=n_answered);
            let delivered: Vec<u64> = sent[from..].iter().copied().filter(|seq| push(&mut second, *seq)).collect();
            assert_eq!(delivered, sent[n_answered..]);
            let last = sent[sent.len() - 1];
            let n_missing = skipped.iter().filter(|seq| **seq < last).count() as u64;
            let expected = InputCounts { n_received: sent.len() as u64, n_missing, ..InputCounts::default() };
            assert_eq!(second.counts(), expected, "{sent:?} {n_counted} {n_answered} {from}");
        }
    }

    #[test]
    fn where_gaps_are_usual_nothing_waits() {
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default()).without_waiting();
        for (seq, publisher, verdict) in [
            (0, 1, Verdict::Deliver(0)),
            (7, 2, Verdict::Deliver(7)),
            (3, 1, Verdict::Drop),
            (9, 2, Verdict::Deliver(9)),
        ] {
            assert_eq!(sequencer.push(seq, SampleId { epoch: EPOCH, seq }, publisher, || true, Instant::now), verdict);
        }
        assert_eq!((sequencer.counts().n_missing, sequencer.n_held()), (7, 0));
    }

    #[test]
    fn what_one_publisher_sends_out_of_order_is_passed_on_as_it_is() {
        let mut sequencer = Sequencer::onlooker();
        for seq in [3, 4, 4, 2] {
            let verdict = sequencer.push(seq, SampleId { epoch: EPOCH, seq }, 1, || true, Instant::now);
            assert_eq!(verdict, Verdict::Deliver(seq));
        }
        assert_eq!(sequencer.counts().n_repeated, 2);
    }
}
