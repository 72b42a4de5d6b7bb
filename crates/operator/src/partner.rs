//! Another input of a stage: for each sample that the stage answers, the sample of nearly the same time.
//!
//! The stage answers its main input by number. Of a partner input it gets the sample whose stamp is nearest, if the two are
//! no further apart than the edge's tolerance. It waits until a later sample of the partner input has come, because only then
//! the nearest one is known, so that the pairs do not depend on speed. A sample whose partner does not come in time is
//! answered without one, and counted. Where the stamps of an input go back, as those of a recording that is played again do, a
//! new round begins, and has no pairs with the one before.
//!
//! A sample of a partner input counts as answered once no sample of the main input that may be answered again needs it, so
//! that its writer keeps it until then. After a restart the instance finds the partners of the samples that it answers again.

use std::cell::{Ref, RefCell};
use std::collections::VecDeque;
use std::marker::PhantomData;
use std::rc::Rc;
use std::time::{Duration, Instant};

use crate::cursors::SampleId;
use crate::monotonic_nanos;
use crate::operator::Operator;
use crate::port::{PortError, UntypedSample, UntypedSubscriber, sample_id};
use crate::runner::InputPort;
use crate::wiring::{Clock, InputCounts, InputWiring};
use blindgrasp_messages::{Header, Message};

/// So many samples are kept for a main input that is behind.
const MAX_KEPT: usize = 1024;
/// By a recording's clock, a partner is waited for so long, and room for samples that are still needed.
const RECORDING_LIMIT: Duration = Duration::from_secs(1);

/// A sample is retained for at most so long for main samples that may be answered again.
const RETAIN_LIMIT: Duration = Duration::from_secs(2);

/// The samples of an input in the order in which they came. Where stamps go back, a new segment begins.
struct Timeline<T> {
    segments: VecDeque<Segment<T>>,
    tolerance_nanos: u64,
}

/// Samples whose stamps do not go back.
struct Segment<T> {
    kept: VecDeque<(u64, T)>,
    /// All samples from this stamp on are kept.
    from_nanos: u64,
}

impl<T> Timeline<T> {
    fn new(tolerance_nanos: u64) -> Self {
        Timeline { segments: VecDeque::new(), tolerance_nanos }
    }

    fn len(&self) -> usize {
        self.segments.iter().map(|segment| segment.kept.len()).sum()
    }

    fn push(&mut self, stamp_nanos: u64, sample: T) {
        let goes_on = match self.segments.back() {
            Some(segment) => segment.kept.back().is_none_or(|(last, _)| *last <= stamp_nanos),
            None => false,
        };
        if !goes_on {
            self.segments.push_back(Segment { kept: VecDeque::with_capacity(MAX_KEPT), from_nanos: stamp_nanos });
        }
        if let Some(segment) = self.segments.back_mut() {
            segment.kept.push_back((stamp_nanos, sample));
        }
    }

    /// The first segment in which no sample to come can be nearer to this stamp.
    fn covering(&self, stamp_nanos: u64) -> Option<usize> {
        self.segments.iter().position(|segment| {
            segment.from_nanos <= stamp_nanos.saturating_add(self.tolerance_nanos)
                && segment.kept.back().is_some_and(|(last, _)| *last >= stamp_nanos)
        })
    }

    /// Chooses the sample nearest to this stamp, the earlier one of two: its index in the first segment. Samples that later
    /// stamps do not need are taken out.
    fn choose(&mut self, stamp_nanos: u64) -> Option<usize> {
        let tolerance_nanos = self.tolerance_nanos;
        let at = match self.covering(stamp_nanos) {
            Some(at) => at,
            None => self.segments.iter().position(|one| one.nearest(stamp_nanos, tolerance_nanos).is_some())?,
        };
        self.segments.drain(..at);
        let segment = self.segments.front_mut()?;
        while segment.kept.front().is_some_and(|(first, _)| first.saturating_add(tolerance_nanos) < stamp_nanos) {
            segment.pop();
        }
        segment.nearest(stamp_nanos, tolerance_nanos)
    }

    /// Takes out the first sample.
    fn pop(&mut self) {
        if self.segments.len() > 1 && self.segments.front().is_some_and(|first| first.kept.is_empty()) {
            self.segments.pop_front();
        }
        if let Some(first) = self.segments.front_mut() {
            first.pop();
        }
    }
}

impl<T> Segment<T> {
    fn nearest(&self, stamp_nanos: u64, tolerance_nanos: u64) -> Option<usize> {
        let after = self.kept.partition_point(|(stamp, _)| *stamp < stamp_nanos);
        let distance = |idx: usize| self.kept.get(idx).map(|(stamp, _)| (stamp.abs_diff(stamp_nanos), idx));
        let nearest = after.checked_sub(1).and_then(distance).into_iter().chain(distance(after)).min()?;
        (nearest.0 <= tolerance_nanos).then_some(nearest.1)
    }

    fn pop(&mut self) {
        if let Some((stamp_nanos, _)) = self.kept.pop_front() {
            self.from_nanos = stamp_nanos + 1;
        }
    }
}

/// The samples of a partner input that may be needed again after a restart. They leave the timeline in the order in which they
/// came.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Retained {
    /// The samples that were received and not committed, with the counts and the time (CLOCK_BOOTTIME, nanoseconds) at which
    /// they came.
    samples: VecDeque<(SampleId, InputCounts, u64)>,
    /// So many of the first ones have left the timeline.
    n_left: usize,
    /// The samples of the main input that were answered, each with the number of samples that had left the timeline by then.
    answered: VecDeque<(SampleId, usize)>,
    /// At most so many are retained, so that the writer is not held up.
    n_most: usize,
    last: Option<SampleId>,
}

impl Retained {
    pub(crate) fn new(n_most: usize) -> Self {
        Retained { samples: VecDeque::new(), n_left: 0, answered: VecDeque::new(), n_most, last: None }
    }

    pub(crate) fn receive(&mut self, key: SampleId, counts: InputCounts, now_nanos: u64) {
        self.samples.push_back((key, counts, now_nanos));
        self.last = Some(key);
    }

    /// The cursor has these counts by now: those of samples that came before must not take its place.
    fn set_counts(&mut self, counts: InputCounts) {
        self.samples.iter_mut().for_each(|(_, of_sample, _)| *of_sample = counts);
    }

    /// Samples have left the timeline.
    pub(crate) fn leave(&mut self, n_samples: usize) {
        self.n_left += n_samples;
    }

    /// A sample of the main input is answered with those that are left.
    pub(crate) fn answer(&mut self, main: SampleId) {
        self.answered.push_back((main, self.n_left));
    }

    /// The sample up to which all may be committed, if there is one. Samples of the main input up to `main` will not be
    /// answered again. Samples that came before `until_nanos` are retained no longer: a main input that stands still must
    /// not hold up the writer, which begins an epoch only when all samples of the one before are committed.
    pub(crate) fn commit_point(&mut self, main: Option<SampleId>, until_nanos: u64) -> Option<(SampleId, InputCounts)> {
        let found = main.and_then(|main| self.answered.iter().rposition(|(key, _)| *key == main));
        let n_free = found.map_or(0, |idx| self.answered.drain(..=idx).next_back().map_or(0, |(_, n_left)| n_left));
        let n_old = self.samples.partition_point(|(_, _, came_nanos)| *came_nanos < until_nanos);
        self.commit(n_free.max(n_old).max(self.samples.len().saturating_sub(self.n_most)))
    }

    /// As [`Retained::commit_point`], when no sample will be answered any more.
    pub(crate) fn commit_all(&mut self) -> Option<(SampleId, InputCounts)> {
        self.commit(self.samples.len())
    }

    fn commit(&mut self, n_samples: usize) -> Option<(SampleId, InputCounts)> {
        let n_samples = n_samples.min(self.samples.len());
        self.n_left = self.n_left.saturating_sub(n_samples);
        self.answered.iter_mut().for_each(|(_, n_left)| *n_left = n_left.saturating_sub(n_samples));
        self.samples.drain(..n_samples).next_back().map(|(key, counts, _)| (key, counts))
    }
}

/// A sample of a partner input.
pub struct PartnerSample<'a, M: Message> {
    sample: Ref<'a, UntypedSample>,
    message: PhantomData<M>,
}

impl<M: Message> PartnerSample<'_, M> {
    pub fn head(&self) -> &M::Head {
        self.sample.beginning()
    }

    pub fn items(&self) -> &[M::Item] {
        self.sample.items()
    }
}

/// A partner input, for the stage: see [`Operator::partner`](crate::Operator::partner).
pub struct Partner<M: Message> {
    pub(crate) input: Rc<RefCell<PartnerInput>>,
    pub(crate) message: PhantomData<M>,
}

impl<M: Message> Partner<M> {
    /// The sample that belongs to the one that is answered just now; `None` if none came in time, or none is near enough.
    pub fn sample(&self) -> Option<PartnerSample<'_, M>> {
        Some(PartnerSample { sample: chosen(&self.input)?, message: PhantomData })
    }
}

/// As [`Partner::sample`], of an input whatever its message.
pub(crate) fn chosen(input: &RefCell<PartnerInput>) -> Option<Ref<'_, UntypedSample>> {
    let chosen = Ref::filter_map(input.borrow(), |input| {
        let (_, sample) = input.timeline.segments.front()?.kept.get(input.chosen?)?;
        Some(sample)
    });
    chosen.ok()
}

/// A partner input, for the operator that runs the stage.
pub(crate) struct PartnerInput {
    port: String,
    retained: Retained,
    subscriber: UntypedSubscriber,
    /// The reader of a standby.
    onlooker: Option<UntypedSubscriber>,
    timeline: Timeline<UntypedSample>,
    chosen: Option<usize>,
    clock: Clock,
    wait: Duration,
    /// When the main input's last sample was answered.
    last_answer: Instant,
    n_without: u64,
}

/// The partner inputs of a stage.
pub(crate) struct Partners {
    inputs: Vec<Rc<RefCell<PartnerInput>>>,
    /// The main sample that waits for its partners, since when, and until when.
    waiting: Option<(SampleId, Instant, Instant)>,
    /// The counts that were reported last.
    n_without: u64,
}

impl Partners {
    /// The partner inputs that the operator has opened.
    pub(crate) fn of(operator: &Operator) -> Partners {
        Partners { inputs: operator.partners(), waiting: None, n_without: 0 }
    }

    pub(crate) fn are_there(&self) -> bool {
        !self.inputs.is_empty()
    }

    pub(crate) fn connect(&self) -> Result<(), PortError> {
        self.inputs.iter().try_for_each(|input| input.borrow_mut().connect())
    }

    pub(crate) fn take_over(&mut self) {
        self.waiting = None;
        self.inputs.iter().for_each(|input| input.borrow_mut().take_over());
    }

    pub(crate) fn take_in(&self, is_active: bool, is_ending: bool) -> Result<(), PortError> {
        self.inputs.iter().try_for_each(|input| input.borrow_mut().take_in(is_active, is_ending))
    }

    /// Samples of the main input up to `main` will not be answered again.
    pub(crate) fn have_answered(&self, main: Option<SampleId>) {
        self.inputs.iter().for_each(|input| input.borrow_mut().commit(main));
    }

    /// No sample waits any more: another instance answers it.
    pub(crate) fn have_handed_over(&mut self) {
        self.waiting = None;
    }

    /// No sample will be answered any more.
    pub(crate) fn have_ended(&self) {
        self.inputs.iter().for_each(|input| input.borrow_mut().commit_all());
    }

    pub(crate) fn is_caught_up(&self) -> bool {
        self.inputs.iter().all(|input| input.borrow().is_caught_up())
    }

    /// Chooses the partners of a main sample; false if it must wait for one. At the end of the stream, none comes any more.
    pub(crate) fn choose(&mut self, main: &Header, is_active: bool, is_ending: bool) -> Result<bool, PortError> {
        if !self.are_there() {
            return Ok(true);
        }
        self.take_in(is_active, is_ending)?;
        let id = sample_id(main);
        let since = self.waiting.filter(|waiting| waiting.0 == id).map_or_else(Instant::now, |waiting| waiting.1);
        let is_over = is_ending && self.is_caught_up();
        let until = self.inputs.iter().filter_map(|input| input.borrow().waits_until(main, since)).max();
        self.waiting = if is_over { None } else { until.map(|until| (id, since, until)) };
        if self.waiting.is_none() {
            self.inputs.iter().for_each(|input| input.borrow_mut().choose(main, is_active));
        }
        Ok(self.waiting.is_none())
    }

    pub(crate) fn deadline(&self, is_active: bool) -> Option<Instant> {
        let held = self.inputs.iter().filter_map(|input| input.borrow().hold_deadline(is_active)).min();
        self.waiting.map(|waiting| waiting.2).into_iter().chain(held).min()
    }

    /// Reports how many samples were answered without a partner.
    pub(crate) fn report(&mut self, operator: &Operator) {
        let n_without = self.inputs.iter().map(|input| input.borrow().n_without).sum();
        if std::mem::replace(&mut self.n_without, n_without) != n_without {
            let counts = self.inputs.iter().map(|input| {
                let input = input.borrow();
                (format!("{}_without_partner", input.port), input.n_without)
            });
            operator.has_counted(counts.collect());
        }
    }
}

impl PartnerInput {
    pub(crate) fn new(port: &str, wiring: &InputWiring, clock: Clock, input: InputPort) -> Self {
        PartnerInput {
            port: port.into(),
            retained: Retained::new(wiring.capacity),
            subscriber: input.subscriber,
            onlooker: input.onlooker,
            timeline: Timeline::new(wiring.tolerance_nanos),
            chosen: None,
            clock,
            wait: match clock {
                Clock::Machine => Duration::from_nanos(wiring.partner_wait_nanos),
                Clock::Recording => RECORDING_LIMIT,
            },
            last_answer: Instant::now(),
            n_without: 0,
        }
    }

    /// Looks for its writers.
    fn connect(&mut self) -> Result<(), PortError> {
        self.onlooker.as_mut().map_or(Ok(false), |onlooker| onlooker.connect())?;
        self.subscriber.connect().map(|_| ())
    }

    /// Goes on as the reader of the active instance.
    fn take_over(&mut self) {
        // The samples of a standby are its own copies. One that is active again goes on with those that it has received: they do
        // not come again.
        if self.onlooker.take().is_some() {
            self.timeline.segments.clear();
        }
        self.chosen = None;
        self.subscriber.take_over_all();
        self.retained.set_counts(self.subscriber.counts());
    }

    /// Takes in the samples that have come. At the end of the stream, none stays behind.
    fn take_in(&mut self, is_active: bool, is_ending: bool) -> Result<(), PortError> {
        // In a replay the other input may be far behind: the writer of this one waits.
        let may_forget = self.clock == Clock::Machine || is_ending || self.last_answer.elapsed() > RECORDING_LIMIT;
        loop {
            if self.timeline.len() >= MAX_KEPT {
                if !may_forget {
                    return Ok(());
                }
                self.chosen = None;
                self.timeline.pop();
                self.retained.leave(1);
                self.commit(None);
            }
            let reader = match (&mut self.onlooker, is_active) {
                (_, true) => &mut self.subscriber,
                (Some(onlooker), false) => onlooker,
                (None, false) => return Ok(()),
            };
            let Some(sample) = reader.receive()? else {
                if is_active {
                    self.commit(None);
                }
                return Ok(());
            };
            let header = *sample.header();
            if is_active {
                self.retained.receive(sample_id(&header), self.subscriber.counts(), monotonic_nanos());
                self.commit(None);
            }
            self.timeline.push(header.stamp_nanos, sample.copied());
        }
    }

    /// The time at which a main sample that was looked at first at `since` is answered without its partner; `None` if the
    /// partner is known.
    fn waits_until(&self, main: &Header, since: Instant) -> Option<Instant> {
        if self.timeline.covering(main.stamp_nanos).is_some() {
            return None;
        }
        let left = match self.clock {
            // From the time at which its source sent it: samples that queue up wait at the same time.
            Clock::Machine => {
                self.wait.saturating_sub(Duration::from_nanos(monotonic_nanos().saturating_sub(main.origin_nanos)))
            }
            Clock::Recording => self.wait.saturating_sub(since.elapsed()),
        };
        (!left.is_zero()).then(|| Instant::now() + left)
    }

    /// Chooses the partner of a main sample that is about to be answered. A standby does not count.
    fn choose(&mut self, main: &Header, is_active: bool) {
        self.last_answer = Instant::now();
        let n_before = self.timeline.len();
        self.chosen = self.timeline.choose(main.stamp_nanos);
        if is_active {
            self.retained.leave(n_before - self.timeline.len());
            self.retained.answer(sample_id(main));
        }
        self.n_without += u64::from(is_active && self.chosen.is_none());
    }

    /// Whether all samples that its writer has sent were received.
    fn is_caught_up(&self) -> bool {
        self.subscriber.is_caught_up() || self.subscriber.written() == self.retained.last
    }

    /// Commits the samples that are needed no more: samples of the main input up to `main` will not be answered again.
    fn commit(&mut self, main: Option<SampleId>) {
        let until_nanos = monotonic_nanos().saturating_sub(RETAIN_LIMIT.as_nanos() as u64);
        if let Some((key, counts)) = self.retained.commit_point(main, until_nanos) {
            self.subscriber.commit_late(key, &counts);
        }
    }

    /// Commits all samples.
    fn commit_all(&mut self) {
        if let Some((key, counts)) = self.retained.commit_all() {
            self.subscriber.commit_late(key, &counts);
        }
    }

    /// When an early sample that it reads is due.
    fn hold_deadline(&self, is_active: bool) -> Option<Instant> {
        if is_active { self.subscriber.hold_deadline() } else { self.onlooker.as_ref()?.hold_deadline() }
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::LiftDecision;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::port::Sent;

    fn timeline(stamps: impl IntoIterator<Item = u64>, tolerance_nanos: u64) -> Timeline<u64> {
        let mut timeline = Timeline::new(tolerance_nanos);
        stamps.into_iter().for_each(|stamp| timeline.push(stamp, stamp));
        timeline
    }

    fn partner(timeline: &mut Timeline<u64>, stamp: u64) -> Option<u64> {
        let idx = timeline.choose(stamp)?;
        Some(timeline.segments[0].kept[idx].1)
    }

    #[test]
    fn the_nearest_sample_within_the_tolerance_is_the_partner() {
        let mut tens = timeline((1..=10).map(|n| 10 * n), 3);
        let partners = [7, 13, 14, 16, 17, 100, 103, 104].map(|stamp| partner(&mut tens, stamp));
        assert_eq!(partners, [Some(10), Some(10), None, None, Some(20), Some(100), Some(100), None]);
        assert_eq!(partner(&mut timeline([10, 20], 5), 15), Some(10), "the earlier one of two");
        assert_eq!(partner(&mut timeline([10, 20], 0), 20), Some(20), "the same stamp");
        assert_eq!(partner(&mut timeline([], 5), 15), None);
    }

    #[test]
    fn a_partner_is_known_once_a_later_sample_has_come() {
        let some = timeline([10, 20], 3);
        let is_known = [6, 7, 15, 20, 21].map(|stamp| some.covering(stamp).is_some());
        assert_eq!(is_known, [false, true, true, true, false]);
        assert!(timeline([], 3).covering(1).is_none());
    }

    /// Samples come in bits, and both streams begin again now and then, either of them first; main samples are answered as
    /// soon as their partners are known. The pairs are those of a search through the same round of the other stream, and no
    /// sample is kept that nobody needs.
    #[test]
    fn pairs_do_not_depend_on_the_order_of_arrival() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let stamps = |rng: &mut ChaCha8Rng, n: usize, most: u64| -> Vec<u64> {
            let mut last = 1000;
            let mut next = || {
                last += rng.random_range(1..=most);
                last
            };
            (0..n).map(|_| next()).collect()
        };
        for _ in 0..1000 {
            let tolerance = rng.random_range(0..20);
            let most = rng.random_range(1..30);
            let rounds: Vec<(Vec<u64>, Vec<u64>)> = (0..3)
                .map(|_| {
                    let side = [vec![1000], stamps(&mut rng, 60, most), vec![10_000]].concat();
                    (stamps(&mut rng, 40, 10), side)
                })
                .collect();
            let mut to_come: VecDeque<u64> = rounds.iter().flat_map(|(_, side)| side.clone()).collect();
            let mut timeline = timeline([], tolerance);
            for (main, side) in &rounds {
                for stamp in main {
                    while timeline.covering(*stamp).is_none() || rng.random_bool(0.3) {
                        let Some(next) = to_come.pop_front() else { break };
                        timeline.push(next, next);
                    }
                    let found = partner(&mut timeline, *stamp);
                    let nearest = side.iter().copied().min_by_key(|other| (other.abs_diff(*stamp), *other));
                    assert_eq!(found, nearest.filter(|nearest| nearest.abs_diff(*stamp) <= tolerance), "{stamp}");
                    assert!(timeline.segments[0].kept.iter().all(|(kept, _)| kept + tolerance >= *stamp));
                }
            }
        }
    }

    /// Its replacement has failed. The samples that it has received lie in no queue any more.
    #[test]
    fn an_instance_that_is_active_again_has_the_partners_that_it_had() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut publisher, subscriber, cursors, wiring) = crate::port::tests::edge(folder.path());
        let port = InputPort { subscriber: subscriber.into_untyped(), onlooker: None };
        let mut input = PartnerInput::new("p", &wiring, Clock::Recording, port);
        publisher.begin(false);
        input.take_over();
        input.connect().expect("connected");
        for stamp_nanos in 0..2 {
            let header = Header { seq: stamp_nanos, epoch: 7, stamp_nanos, ..Header::default() };
            let (head, _) = LiftDecision::default().to_parts(header);
            assert_eq!(publisher.send(head, &[], &mut || false).expect("no error"), Sent::Yes);
        }
        for stamp_nanos in 0..2 {
            input.take_in(true, false).expect("taken in");
            input.choose(&Header { stamp_nanos, ..Header::default() }, true);
            let stamp = input.chosen.map(|idx| input.timeline.segments[0].kept[idx].0);
            assert_eq!(stamp, Some(stamp_nanos));
            input.take_over();
        }
        // The replacement has answered both.
        let counts = InputCounts { n_received: 9, ..InputCounts::default() };
        cursors.input(1).place_at(Some(SampleId { epoch: 7, seq: 1 }), &counts);
        input.take_over();
        input.commit_all();
        assert_eq!(cursors.input(1).counts(), counts);
    }

    #[test]
    fn an_input_whose_clock_alone_goes_back_has_no_partners_until_the_other_one_follows() {
        let mut timeline = timeline([100, 110, 5, 15, 25], 3);
        assert_eq!(
            [100, 110, 120, 5, 16].map(|stamp| partner(&mut timeline, stamp)),
            [Some(100), Some(110), None, Some(5), Some(15)]
        );
    }
}
