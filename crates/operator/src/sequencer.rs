//! Puts the samples of one input in order, each once, whichever publisher sent them.
//!
//! While one instance of a node hands over to another, its reader has two publishers, and iceoryx2 keeps no order
//! between them: the new instance's first sample may come before the old one's last. After a crash the new instance sends
//! those samples again that the old one may not have delivered. So a reader takes samples by their number: it drops
//! duplicates, holds early samples until their turn, and counts samples as missing that do not come within a bounded wait.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use crate::cursors::SampleId;
use crate::wiring::InputCounts;
use crate::written::Written;

/// An early sample waits at most this long for those before it: longer than a writer needs to notice that its predecessor has
/// ended ([`TICK`](crate::operator::TICK)).
pub const HOLD_LIMIT: Duration = Duration::from_millis(250);
/// A reader that has just begun waits so long for samples that were sent before. Each publisher gives it those that it kept once
/// it has noticed the reader, and on a busy machine one publisher can be much later than another.
pub const START_HOLD_LIMIT: Duration = Duration::from_secs(2);
/// The number of publishers whose last sample is remembered: more than there can be at a time.
const N_PUBLISHERS: usize = 16;

/// The number of epochs that are remembered.
const N_EPOCHS: usize = 16;

/// A place in the stream: the generation of the sample's epoch, and its number. Places are ordered as the stream is.
type Place = (usize, u64);

/// The order of one input. It has no clock: the caller gives the time.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Sequencer<T> {
    /// The last epochs of the stream in the order in which they began.
    epochs: VecDeque<Epoch>,
    /// The last sample delivered.
    last: Option<Place>,
    /// Samples up to here were answered by an earlier instance, and its answers were received: dropped.
    answered: Option<Place>,
    /// Samples up to here were counted by an earlier instance: delivered, not counted again.
    counted: Option<Place>,
    /// Whether the stream is expected to begin at 0, so that numbers before the first sample are missing.
    begins_at_zero: bool,
    /// The last sample of each publisher.
    publishers: VecDeque<(u128, Place)>,
    /// Early samples, and when they came.
    held: BTreeMap<Place, (T, Instant)>,
    /// Whether samples wait for those before them at all.
    may_hold: bool,
    /// Nothing is missing before the first sample.
    takes_what_comes: bool,
    /// Its node was given up, and no sample has come since.
    was_given_up: bool,
    /// The last sample that was sent before this reader began, and until when those up to it are awaited.
    awaited: Option<(SampleId, Instant)>,
    counts: InputCounts,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Epoch {
    generation: usize,
    value: u64,
    /// The number of its first sample, if the writer has said it.
    first_seq: Option<u64>,
    /// The number of its last sample, if it is over.
    last_seq: Option<u64>,
}

/// The sequencer's answer to a sample.
#[derive(Debug, PartialEq, Eq)]
pub enum Placing<T> {
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
            epochs: VecDeque::new(),
            last: None,
            answered: None,
            counted: None,
            begins_at_zero: false,
            publishers: VecDeque::new(),
            held: BTreeMap::new(),
            may_hold: true,
            takes_what_comes: false,
            was_given_up: false,
            awaited: None,
            counts: InputCounts::default(),
        }
    }

    /// The order of a reader that goes on where an earlier instance left off.
    ///
    /// `counted` is the last sample that the earlier instance has answered, with its counts; `answered` is the last sample
    /// whose answer all readers have received. The samples between them are answered again.
    pub fn resume(answered: Option<SampleId>, counted: Option<SampleId>, counts: InputCounts) -> Self {
        // If they are of different epochs, all samples of the later one are answered again.
        let answered = answered.zip(counted).filter(|(answered, counted)| answered.epoch == counted.epoch);
        let answered = answered.map(|(answered, counted)| (0, answered.seq.min(counted.seq)));
        Sequencer {
            epochs: counted
                .iter()
                .map(|counted| Epoch { generation: 0, value: counted.epoch, first_seq: None, last_seq: None })
                .collect(),
            // Nothing is missing between the two: the earlier instance received it.
            last: answered,
            answered,
            counted: counted.map(|counted| (0, counted.seq)),
            begins_at_zero: true,
            counts,
            ..Self::onlooker()
        }
    }

    /// The order of an edge on which samples may be dropped: no sample waits for those before it.
    pub fn without_waiting(self) -> Self {
        Sequencer { may_hold: false, ..self }
    }

    /// The order of a reader that goes on with the first sample that its writer still has.
    pub fn taking_what_comes(self) -> Self {
        Sequencer { takes_what_comes: true, ..self }
    }

    /// The order of a reader whose node was given up. No writer has waited for it, so that the samples before the first one that
    /// comes are missing at once.
    pub fn after_giving_up(self) -> Self {
        Sequencer { was_given_up: true, ..self }
    }

    /// The order of a reader that begins at `start`, when `sent` was the last sample that its writer had sent.
    pub fn beginning_at(self, start: Instant, sent: Option<SampleId>) -> Self {
        Sequencer { awaited: sent.map(|sent| (sent, start + START_HOLD_LIMIT)), ..self }
    }

    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    pub fn count_late(&mut self) {
        self.counts.n_late += 1;
    }

    /// The place of a sample, whose writer has come to `written`; `None` if its epoch is over and this reader has left it. It has
    /// not left an epoch whose sample `goes_on` after the last one from the same publisher.
    fn place(&mut self, key: SampleId, written: Option<&Written>, goes_on: bool) -> Option<Place> {
        let current = written.filter(|written| written.is_current(key));
        let known = self.epochs.iter().rposition(|epoch| epoch.value == key.epoch);
        let first_seq = current.map(|written| written.first_seq);
        // An epoch that comes back with higher numbers is another one.
        if let Some(at) = known
            && (current.is_none() || at + 1 == self.epochs.len())
        {
            let epoch = &mut self.epochs[at];
            epoch.first_seq = epoch.first_seq.or(first_seq);
            return Some((epoch.generation, key.seq));
        }
        // A writer keeps samples of epochs that its readers have left. Where readers are not waited for, it may have begun
        // several since.
        let is_over = current.is_none() && written.is_some() && self.may_hold && !self.epochs.is_empty();
        if is_over && !goes_on {
            return None;
        }
        let generation = self.epochs.back().map_or(0, |epoch| epoch.generation + 1);
        if let (Some(ended), Some(before)) = (self.epochs.back_mut(), current.and_then(|written| written.before))
            && ended.value == before.epoch
        {
            ended.last_seq = Some(before.seq);
        }
        self.epochs.push_back(Epoch { generation, value: key.epoch, first_seq, last_seq: None });
        if self.epochs.len() > N_EPOCHS {
            self.epochs.pop_front();
        }
        Some((generation, key.seq))
    }

    fn epoch(&self, generation: usize) -> Option<&Epoch> {
        self.epochs.iter().rfind(|epoch| epoch.generation == generation)
    }

    /// Forgets which publisher has sent which samples: the reader has connected to them anew and gets their history again.
    pub fn has_reconnected(&mut self) {
        self.publishers.clear();
    }

    /// Takes a sample of a writer that has come to `written`. If the sample is early, `has_other_publishers` is asked whether
    /// another publisher may still have the samples before it.
    pub fn push(
        &mut self,
        sample: T,
        key: SampleId,
        publisher: u128,
        written: Option<&Written>,
        has_other_publishers: impl FnOnce() -> bool,
        now: impl FnOnce() -> Instant,
    ) -> Placing<T> {
        let goes_on = self.publishers.iter().any(|(id, last)| *id == publisher && Some(*last) >= self.last);
        let Some(place) = self.place(key, written, goes_on) else { return Placing::Drop };
        let known = self.publishers.iter_mut().find(|(id, _)| *id == publisher);
        let is_first_of_publisher = known.is_none();
        match known {
            Some((_, last)) if place <= *last => {
                // No restart or swap explains this: the stage sees the sample as it is.
                self.counts.n_repeated += 1;
                return Placing::Deliver(sample);
            }
            Some((_, last)) => *last = place,
            None => {
                self.publishers.truncate(N_PUBLISHERS - 1);
                self.publishers.push_front((publisher, place));
            }
        }
        if self.last.is_some_and(|last| place <= last) || self.held.contains_key(&place) {
            // An earlier instance has counted the sample.
            let is_known = self.answered.is_some_and(|answered| place <= answered);
            self.counts.n_repeated += u64::from(!is_known);
            return Placing::Drop;
        }
        let n_before = self.n_before(place);
        // A publisher sends in order and skips no number that it or another publisher has. So a gap within its own samples is
        // a gap of the stream; only before its first sample may be samples of the publisher that it took over from.
        // A reader that takes what comes begins with the first sample of all publishers. Their queues are read in any order.
        let may_begin_elsewhere = self.takes_what_comes && self.last.is_none();
        if self.may_hold && (self.is_early(place) || may_begin_elsewhere) {
            let may_be_elsewhere = (n_before > 0 || may_begin_elsewhere) && is_first_of_publisher;
            // Where no other publisher is left, the one that has sent the samples before may notice that, and send them.
            let may_be_sent = written.is_some() && !self.was_given_up;
            let were_sent = n_before > 0 && may_be_sent && (self.last.is_some() || self.since_first(place) > 0);
            let may_come = may_be_elsewhere && (were_sent || self.publishers.len() > 1 || has_other_publishers());
            if may_come || !self.held.is_empty() {
                self.held.insert(place, (sample, now()));
                return Placing::Hold;
            }
        }
        self.deliver(place, n_before);
        Placing::Deliver(sample)
    }

    /// Whether samples before this place have not been delivered: missing ones, or held ones of an earlier epoch.
    fn is_early(&self, place: Place) -> bool {
        self.n_before(place) > 0 || self.held.first_key_value().is_some_and(|(first, _)| *first < place)
    }

    /// The next held sample, if it is its turn.
    pub fn next_in_order(&mut self) -> Option<T> {
        let (place, _) = self.held.first_key_value()?;
        if self.n_before(*place) > 0 {
            return None;
        }
        self.counts.n_reordered += 1;
        self.first_held()
    }

    /// The next held sample, if its wait is over. Ask for it only when no more samples have come: after a long stop, the
    /// samples that it waits for may lie in the queue.
    pub fn next_overdue(&mut self, now: Instant) -> Option<T> {
        if now < self.deadline()? {
            return None;
        }
        self.first_held()
    }

    /// The first of the held samples, even if others are missing before it.
    fn first_held(&mut self) -> Option<T> {
        let (place, (sample, _)) = self.held.pop_first()?;
        self.deliver(place, self.n_before(place));
        Some(sample)
    }

    /// Takes over the samples that an earlier order of the same reader held, and a sample that was put back.
    pub fn hold_again(
        &mut self,
        before: Self,
        put_back: impl IntoIterator<Item = (SampleId, T)>,
        written: Option<&Written>,
        now: Instant,
    ) {
        let mut held: Vec<(SampleId, (T, Instant))> = Vec::new();
        let mut before = before;
        for ((generation, seq), sample) in std::mem::take(&mut before.held) {
            held.extend(before.epoch(generation).map(|epoch| (SampleId { epoch: epoch.value, seq }, sample)));
        }
        held.extend(put_back.into_iter().map(|(key, sample)| (key, (sample, now))));
        // Those that an earlier instance has counted are answered again, if its answers were not received.
        let last = self.last;
        for (key, sample) in held {
            let Some(place) = self.place(key, written, false) else { continue };
            if last.is_none_or(|last| place > last) {
                self.held.insert(place, sample);
            }
        }
    }

    /// Changes the form in which a held sample is kept.
    pub fn keep_as(&mut self, key: SampleId, form: impl FnOnce(T) -> T) {
        let epoch = self.epochs.iter().rfind(|epoch| epoch.value == key.epoch);
        let Some(place) = epoch.map(|epoch| (epoch.generation, key.seq)) else { return };
        if let Some((sample, since)) = self.held.remove(&place) {
            self.held.insert(place, (form(sample), since));
        }
    }

    /// When the wait of the next held sample is over.
    pub fn deadline(&self) -> Option<Instant> {
        let (_, (_, since)) = self.held.first_key_value()?;
        let deadline = *since + HOLD_LIMIT;
        let Some((sent, until)) = self.awaited else { return Some(deadline) };
        let has_all = self.last.is_some_and(|(generation, seq)| {
            // An epoch that has not come yet begins after all others.
            let of_sent = self.epochs.iter().rfind(|epoch| epoch.value == sent.epoch);
            of_sent.is_some_and(|of_sent| (of_sent.generation, sent.seq) <= (generation, seq))
        });
        Some(if has_all { deadline } else { deadline.max(until) })
    }

    pub fn n_held(&self) -> usize {
        self.held.len()
    }

    /// The number of samples before `place`, which is after the last one, that have not come.
    fn n_before(&self, place: Place) -> u64 {
        match self.last {
            Some((generation, seq)) if generation == place.0 => place.1.saturating_sub(seq).saturating_sub(1),
            // A new epoch may begin at any number; its writer says at which, and where the one before has ended.
            Some((generation, seq)) => {
                let ended = self.epoch(generation).and_then(|epoch| epoch.last_seq);
                ended.map_or(0, |last_seq| last_seq.saturating_sub(seq)) + self.since_first(place)
            }
            None if self.takes_what_comes => 0,
            None if self.begins_at_zero && self.counted.is_none() => place.1,
            None if self.begins_at_zero => self.since_first(place),
            None => 0,
        }
    }

    fn since_first(&self, place: Place) -> u64 {
        let first_seq = self.epoch(place.0).and_then(|epoch| epoch.first_seq);
        first_seq.map_or(0, |first_seq| place.1.saturating_sub(first_seq))
    }

    fn deliver(&mut self, place: Place, n_missing: u64) {
        (self.last, self.was_given_up) = (Some(place), false);
        if self.counted.is_some_and(|counted| place <= counted) {
            return;
        }
        // Samples that an earlier instance counted are not missing, though they may not have come again.
        let n_counted = match (self.counted, n_missing) {
            (Some((generation, seq)), 1..) if generation == place.0 => {
                n_missing.min((seq + 1).saturating_sub(place.1 - n_missing))
            }
            _ => 0,
        };
        self.counts.n_missing += n_missing - n_counted;
        self.counts.n_received += 1;
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A sample on its way: when it comes, its number, and whose it is.
    type Arrival = (Duration, u64, u128);

    const EPOCH: u64 = 7;

    /// One sample of twenty, by chance.
    fn some_of(rng: &mut ChaCha8Rng, n_samples: u64) -> Vec<u64> {
        let mut chosen = Vec::new();
        for seq in 0..n_samples {
            if rng.random_bool(0.05) {
                chosen.push(seq);
            }
        }
        chosen
    }

    /// The samples of up to three publishers, each of which takes over from the one before and sends its last few samples
    /// again; the last few of one that has crashed do not come. Samples come up to 40 ms late, those of one publisher in order.
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
                        sequencer.push(seq, SampleId { epoch: EPOCH, seq }, publisher, None, || true, || start + now);
                    if let Placing::Deliver(seq) = verdict {
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
            let skipped: Vec<u64> = if round % 2 == 1 { some_of(&mut rng, n_samples) } else { Vec::new() };
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
            let skipped = some_of(&mut rng, n_samples);
            let sent: Vec<u64> = (0..n_samples).filter(|seq| !skipped.contains(seq)).collect();
            if sent.is_empty() {
                continue;
            }
            let push = |sequencer: &mut Sequencer<u64>, seq: u64| {
                sequencer.push(seq, SampleId { epoch: EPOCH, seq }, 0, None, || false, Instant::now)
                    == Placing::Deliver(seq)
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

    /// Two swaps while the reader stands still: three publishers have unread samples, and the last one's come first.
    #[test]
    fn samples_of_several_publishers_are_put_in_order_whichever_comes_first() {
        let now = Instant::now();
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default());
        let mut delivered = Vec::new();
        for (publisher, numbers) in [(3, 40..60), (2, 20..40), (1, 0..20)] {
            for seq in numbers {
                let verdict = sequencer.push(seq, SampleId { epoch: EPOCH, seq }, publisher, None, || true, || now);
                delivered.extend(match verdict {
                    Placing::Deliver(seq) => Some(seq),
                    _ => None,
                });
            }
            assert_eq!(sequencer.next_overdue(now + HOLD_LIMIT / 2), None);
        }
        delivered.extend(std::iter::from_fn(|| sequencer.next_in_order()));
        assert_eq!(delivered, (0..60).collect::<Vec<u64>>());
        assert_eq!((sequencer.counts().n_missing, sequencer.counts().n_repeated), (0, 0));
    }

    #[test]
    fn a_reader_that_has_just_come_waits_longer_for_a_publisher_that_has_not_noticed_it() {
        let start = Instant::now();
        let id = |seq| SampleId { epoch: EPOCH, seq };
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default()).beginning_at(start, Some(id(5)));
        assert_eq!(sequencer.push(5, id(5), 2, None, || true, || start), Placing::Hold);
        assert_eq!(sequencer.next_overdue(start + 2 * HOLD_LIMIT), None);
        for seq in 0..5 {
            assert_eq!(sequencer.push(seq, id(seq), 1, None, || true, || start), Placing::Deliver(seq));
        }
        assert_eq!(sequencer.next_in_order(), Some(5));
        // A gap of later samples is not waited for longer.
        assert_eq!(sequencer.push(8, id(8), 3, None, || true, || start), Placing::Hold);
        assert_eq!(sequencer.next_overdue(start + HOLD_LIMIT), Some(8));
        // Those that do not come are given up in the end.
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default()).beginning_at(start, Some(id(5)));
        assert_eq!(sequencer.push(5, id(5), 2, None, || true, || start), Placing::Hold);
        assert_eq!(sequencer.next_overdue(start + START_HOLD_LIMIT), Some(5));
        // A reader that begins before its writer awaits nothing.
        let mut first = Sequencer::resume(None, None, InputCounts::default()).beginning_at(start, None);
        assert_eq!(first.push(5, id(5), 2, None, || true, || start), Placing::Hold);
        assert_eq!(first.next_overdue(start + HOLD_LIMIT), Some(5));
    }

    /// F1: a publisher that was handed over to has sent 1 when its predecessor ends with 0, and the reader with it. It notices
    /// within a tick, begins again, and sends 0 too.
    #[test]
    fn samples_before_the_first_one_of_the_only_publisher_may_come_again() {
        let start = Instant::now();
        let id = |seq| SampleId { epoch: EPOCH, seq };
        let written = Written { last: id(1), first_seq: 0, before: None };
        let resumed = Sequencer::resume(None, None, InputCounts::default());
        let push = |sequencer: &mut Sequencer<u64>, seq, publisher| {
            sequencer.push(seq, id(seq), publisher, Some(&written), || false, || start)
        };
        let mut sequencer = resumed.clone();
        assert_eq!(push(&mut sequencer, 1, 2), Placing::Hold);
        assert_eq!(sequencer.next_overdue(start + 2 * crate::operator::TICK), None);
        assert_eq!(push(&mut sequencer, 0, 3), Placing::Deliver(0));
        assert_eq!(sequencer.next_in_order(), Some(1));
        // They do not come: they are missing.
        let mut sequencer = resumed.clone();
        assert_eq!(push(&mut sequencer, 1, 2), Placing::Hold);
        assert_eq!((sequencer.next_overdue(start + HOLD_LIMIT), sequencer.counts().n_missing), (Some(1), 1));
        let mut sequencer = resumed.clone().after_giving_up();
        assert_eq!((push(&mut sequencer, 1, 2), sequencer.counts().n_missing), (Placing::Deliver(1), 1));
        // A recording that begins at 1 has nothing before it.
        let written = Written { first_seq: 1, ..written };
        let placing = resumed.clone().push(1, id(1), 2, Some(&written), || false, || start);
        assert_eq!(placing, Placing::Deliver(1));
    }

    /// The writer has begun an epoch although its reader has not answered the end of the one before: see
    /// [`Credit::has_waited_long`](crate::credit::Credit::has_waited_long).
    #[test]
    fn the_end_of_an_epoch_is_awaited_and_missing_if_it_does_not_come() {
        let (start, old, new) = (Instant::now(), EPOCH, EPOCH - 1);
        let key = |epoch, seq| SampleId { epoch, seq };
        let written = Written { last: key(new, 0), first_seq: 0, before: Some(key(old, 7)) };
        let counts = InputCounts { n_received: 6, ..InputCounts::default() };
        let resumed = Sequencer::resume(Some(key(old, 5)), Some(key(old, 5)), counts);
        let push = |sequencer: &mut Sequencer<_>, key, publisher| {
            sequencer.push(key, key, publisher, Some(&written), || false, || start)
        };
        let mut sequencer = resumed.clone();
        assert_eq!(push(&mut sequencer, key(new, 0), 2), Placing::Hold);
        assert_eq!(push(&mut sequencer, key(old, 6), 1), Placing::Deliver(key(old, 6)), "it was in another queue");
        assert_eq!(push(&mut sequencer, key(old, 7), 1), Placing::Deliver(key(old, 7)));
        assert_eq!(sequencer.next_in_order(), Some(key(new, 0)));
        let mut sequencer = resumed;
        assert_eq!(push(&mut sequencer, key(new, 0), 2), Placing::Hold);
        assert_eq!(sequencer.next_overdue(start + HOLD_LIMIT), Some(key(new, 0)));
        assert_eq!(sequencer.counts().n_missing, 2);
    }

    /// A standby has opened its publisher and sends nothing: the gaps of the other publisher are gaps.
    #[test]
    fn a_gap_within_the_samples_of_one_publisher_is_not_waited_for() {
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default());
        for seq in [0, 1, 5, 6, 9] {
            let verdict = sequencer.push(seq, SampleId { epoch: EPOCH, seq }, 1, None, || true, Instant::now);
            assert_eq!(verdict, Placing::Deliver(seq));
        }
        assert_eq!(sequencer.counts().n_missing, 5);
    }

    #[test]
    fn epochs_keep_their_order_whichever_publisher_they_come_from() {
        let now = Instant::now();
        let (old, new) = (EPOCH, EPOCH - 1);
        let key = |epoch, seq| SampleId { epoch, seq };
        let counts = InputCounts { n_received: 6, ..InputCounts::default() };
        let mut sequencer = Sequencer::resume(Some(key(old, 5)), Some(key(old, 5)), counts);
        let push =
            |sequencer: &mut Sequencer<_>, key, publisher| sequencer.push(key, key, publisher, None, || true, || now);
        assert_eq!(push(&mut sequencer, key(old, 9), 1), Placing::Hold);
        assert_eq!(push(&mut sequencer, key(new, 0), 2), Placing::Hold, "8 is on its way");
        assert_eq!(push(&mut sequencer, key(old, 6), 3), Placing::Deliver(key(old, 6)));
        let later = now + HOLD_LIMIT;
        assert_eq!(sequencer.next_overdue(later), Some(key(old, 9)));
        assert_eq!(sequencer.next_in_order(), Some(key(new, 0)));
        assert_eq!(push(&mut sequencer, key(old, 8), 4), Placing::Drop, "its epoch is over");
        assert_eq!(push(&mut sequencer, key(new, 1), 2), Placing::Deliver(key(new, 1)));
        assert_eq!((sequencer.counts().n_received, sequencer.counts().n_missing), (10, 2));
        assert_eq!(sequencer.counts().n_repeated, 1);
    }

    /// The writer keeps the last samples of the epoch before, and of earlier ones.
    #[test]
    fn a_reader_that_comes_back_after_a_change_of_epoch_takes_no_sample_of_the_epoch_before() {
        let key = |epoch, seq| SampleId { epoch, seq };
        let mut written = Written { last: key(2, 1), first_seq: 0, before: Some(key(9, 3)) };
        let mut sequencer = Sequencer::resume(Some(key(2, 0)), Some(key(2, 0)), InputCounts::default());
        let mut delivered = Vec::new();
        let mut push = |sequencer: &mut Sequencer<SampleId>, key, written: Written| {
            if let Placing::Deliver(key) = sequencer.push(key, key, 1, Some(&written), || false, Instant::now) {
                delivered.push(key);
            }
        };
        for key in [key(7, 0), key(9, 2), key(9, 3), key(2, 0), key(2, 1)] {
            push(&mut sequencer, key, written);
        }
        // The recording begins again: the first of these epochs comes back with higher numbers.
        for key in [key(9, 4), key(9, 5)] {
            written = Written::with(Some(written), key).expect("a new sample");
            push(&mut sequencer, key, written);
        }
        assert_eq!(delivered, [key(2, 1), key(9, 4), key(9, 5)]);
        assert_eq!(sequencer.counts(), InputCounts { n_received: 3, ..InputCounts::default() });
    }

    /// The writer does not wait for an attached reader to begin an epoch.
    #[test]
    fn epochs_that_are_over_are_taken_from_the_publisher_that_goes_on_to_them() {
        let key = |epoch, seq| SampleId { epoch, seq };
        let written = Written { last: key(3, 0), first_seq: 0, before: Some(key(8, 1)) };
        let mut sequencer = Sequencer::resume(Some(key(5, 0)), Some(key(5, 0)), InputCounts::default());
        let mut push = |key, publisher| sequencer.push(key, key, publisher, Some(&written), || true, Instant::now);
        for key in [key(5, 1), key(2, 0), key(2, 1), key(8, 0), key(8, 1)] {
            assert_eq!(push(key, 1), Placing::Deliver(key));
        }
        assert_eq!(push(key(7, 0), 2), Placing::Drop, "another publisher has kept it");
        assert_eq!(push(key(3, 0), 1), Placing::Deliver(key(3, 0)));
        assert_eq!(sequencer.counts(), InputCounts { n_received: 6, ..InputCounts::default() });
    }

    #[test]
    fn a_reader_that_takes_what_comes_begins_with_the_first_sample_of_all_publishers() {
        let id = |seq| SampleId { epoch: EPOCH, seq };
        let counts = InputCounts { n_received: 6, ..InputCounts::default() };
        for (n_publishers, arrivals, expected) in [
            (2, &[(8, 2), (9, 2), (4, 1), (5, 1), (6, 1), (7, 1)][..], [4, 5, 6, 7, 8, 9].as_slice()),
            (2, &[(4, 1), (8, 2), (5, 1), (6, 1), (7, 1)], &[4, 5, 6, 7, 8]),
            (2, &[(8, 2), (9, 2)], &[8, 9]),
            (1, &[(8, 2), (9, 2)], &[8, 9]),
        ] {
            let mut sequencer = Sequencer::resume(None, Some(id(5)), counts).taking_what_comes();
            let mut delivered = Vec::new();
            for (seq, publisher) in arrivals {
                match sequencer.push(*seq, id(*seq), *publisher, None, || n_publishers > 1, Instant::now) {
                    Placing::Deliver(seq) => delivered.push(seq),
                    Placing::Hold => {}
                    Placing::Drop => panic!("{seq} of {arrivals:?}"),
                }
            }
            delivered.extend(std::iter::from_fn(|| sequencer.next_in_order()));
            assert_eq!(delivered, expected, "{arrivals:?}");
            let n_new = expected.iter().filter(|seq| **seq > 5).count() as u64;
            assert_eq!((sequencer.counts().n_received, sequencer.counts().n_missing), (6 + n_new, 0), "{arrivals:?}");
        }
    }

    /// A sample that waits is copied, so that its publisher gets its own back.
    #[test]
    fn a_held_sample_is_kept_in_another_form_at_its_place() {
        let id = |seq| SampleId { epoch: EPOCH, seq };
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default());
        for seq in [2, 1] {
            assert_eq!(sequencer.push(seq, id(seq), seq.into(), None, || true, Instant::now), Placing::Hold);
            sequencer.keep_as(id(seq), |seq| 10 * seq);
        }
        sequencer.keep_as(SampleId { epoch: EPOCH + 1, seq: 1 }, |_| 0);
        assert_eq!(sequencer.push(0, id(0), 3, None, || true, Instant::now), Placing::Deliver(0));
        assert_eq!([sequencer.next_in_order(), sequencer.next_in_order()], [Some(10), Some(20)]);
    }

    #[test]
    fn where_gaps_are_usual_nothing_waits() {
        let mut sequencer = Sequencer::resume(None, None, InputCounts::default()).without_waiting();
        for (seq, publisher, verdict) in [
            (0, 1, Placing::Deliver(0)),
            (7, 2, Placing::Deliver(7)),
            (3, 1, Placing::Drop),
            (9, 2, Placing::Deliver(9)),
        ] {
            assert_eq!(
                sequencer.push(seq, SampleId { epoch: EPOCH, seq }, publisher, None, || true, Instant::now),
                verdict
            );
        }
        assert_eq!((sequencer.counts().n_missing, sequencer.n_held()), (7, 0));
    }

    #[test]
    fn what_one_publisher_sends_out_of_order_is_passed_on_as_it_is() {
        let mut sequencer = Sequencer::onlooker();
        for seq in [3, 4, 4, 2] {
            let verdict = sequencer.push(seq, SampleId { epoch: EPOCH, seq }, 1, None, || true, Instant::now);
            assert_eq!(verdict, Placing::Deliver(seq));
        }
        assert_eq!(sequencer.counts().n_repeated, 2);
    }
}
