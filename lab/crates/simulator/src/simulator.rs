//! Simulates grasps: draws candidates, keeps as many stable and unstable ones as asked for, and makes their frames.
//!
//! A simulation consists of parts of a few hundred grasps. A candidate is a pure function of the seed, its part and its
//! number in the part, and candidates are kept in the order of their numbers. So a part depends on nothing but the options
//! and its index. The same seed gives the same grasps with any number of threads and machines, and an interrupted run goes
//! on with the next part. The thresholds of stability are never moved to reach the asked-for fraction; candidates of the
//! commoner kind are dropped, and [`SimulationReport`] counts them. The order of stable and unstable grasps is drawn, so
//! that a grasp's number does not depend on its label.
//!
//! A grasp that touches the object counts, even if no cell feels it: the arbiter then has to hold.

use blindgrasp_stages::label::Label;
use std::collections::{BTreeMap, VecDeque};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::candidate::{self, CandidateError, Judged, Outcome, SimulatedGrasp};
use super::mechanism::Mechanism;
use super::option_check::OptionError;
use super::options::{CellUnitError, Thresholds, check_hand};
use crate::trial::lift_label;
use blindgrasp_messages::{Phase, SceneContact};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::Hand;

pub use super::options::SimulatorOptions;

/// Most grasps of a kind that wait for their turn. Further ones are dropped, so that memory stays flat.
const MAX_WAITING: usize = 64;

/// A part of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    pub idx: usize,
    pub first_grasp_id: u64,
    pub n_grasps: usize,
    /// Number of stable grasps, if a fraction is asked for.
    pub n_stable: Option<usize>,
}

impl SimulatorOptions {
    /// The parts that make up the simulation.
    pub fn parts(&self) -> impl Iterator<Item = Part> + '_ {
        let per_part = self.grasps_per_part.max(1);
        (0..self.n_grasps.div_ceil(per_part)).map(move |idx| {
            let (first, end) = (idx * per_part, ((idx + 1) * per_part).min(self.n_grasps));
            // Rounded to the whole simulation, not part by part.
            let n_stable_before = |n: usize, fraction: f64| (fraction * n as f64).round() as usize;
            let n_stable = self.stable_fraction.map(|part| n_stable_before(end, part) - n_stable_before(first, part));
            Part { idx, first_grasp_id: first as u64, n_grasps: end - first, n_stable }
        })
    }
}

/// The counts of a simulation. Counts that another version has not written are 0.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct SimulationReport {
    /// The meaning of stable.
    #[serde(skip_serializing_if = "Label::is_default")]
    pub label: Label,
    /// The least qualities of a stable grasp, with label `wrench-space`.
    #[serde(skip_serializing_if = "Thresholds::is_default")]
    pub thresholds: Thresholds,
    /// Candidates tried, up to the last one kept.
    pub n_candidates: usize,
    /// Grasps kept.
    pub n_grasps: usize,
    /// Stable grasps kept.
    pub n_stable: usize,
    /// Candidates that never touched the object, or whose open hand touched itself.
    pub n_without_touch: usize,
    /// Candidates dropped because their hull failed.
    pub n_hull_failures: usize,
    /// Candidates dropped because the physics of their lift diverged.
    pub n_diverged: usize,
    /// Candidates whose hull needed a joggle. They count.
    pub n_joggled: usize,
    /// Candidates dropped because there were enough of their kind.
    pub n_over_quota: usize,
    /// Candidates that touched and have a quality.
    pub n_judged: usize,
    /// Stable candidates among those with a quality, before any balance.
    pub n_judged_stable: usize,
    /// Grasps kept with at least one contact that no cell feels.
    pub n_with_unsensed_contacts: usize,
    /// Grasps kept that no cell feels at all.
    pub n_without_active_cell: usize,
    /// Grasps kept in which links of the hand press on each other.
    pub n_self_collisions: usize,
    /// Counts of each object with a candidate, by name.
    pub objects: BTreeMap<String, ObjectReport>,
}

/// The counts of an object.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct ObjectReport {
    pub class: String,
    /// Candidates that touched and have a quality.
    pub n_judged: usize,
    /// Stable candidates among those with a quality.
    pub n_judged_stable: usize,
    /// Grasps kept.
    pub n_grasps: usize,
    /// Stable grasps kept.
    pub n_stable: usize,
}

impl SimulationReport {
    /// Adds another part's report, of the same simulation.
    pub fn add(&mut self, other: &SimulationReport) {
        (self.label, self.thresholds) = (other.label, other.thresholds);
        self.n_candidates += other.n_candidates;
        self.n_grasps += other.n_grasps;
        self.n_stable += other.n_stable;
        self.n_without_touch += other.n_without_touch;
        self.n_hull_failures += other.n_hull_failures;
        self.n_diverged += other.n_diverged;
        self.n_joggled += other.n_joggled;
        self.n_over_quota += other.n_over_quota;
        self.n_judged += other.n_judged;
        self.n_judged_stable += other.n_judged_stable;
        self.n_with_unsensed_contacts += other.n_with_unsensed_contacts;
        self.n_without_active_cell += other.n_without_active_cell;
        self.n_self_collisions += other.n_self_collisions;
        for (name, theirs) in &other.objects {
            let ours = self.objects.entry(name.clone()).or_default();
            ours.class.clone_from(&theirs.class);
            ours.n_judged += theirs.n_judged;
            ours.n_judged_stable += theirs.n_judged_stable;
            ours.n_grasps += theirs.n_grasps;
            ours.n_stable += theirs.n_stable;
        }
    }

    /// Stable candidates among those that touched and have a quality; 0 if there are none.
    pub fn natural_stable_rate(&self) -> f64 {
        if self.n_judged == 0 { 0.0 } else { self.n_judged_stable as f64 / self.n_judged as f64 }
    }
}

/// Why a simulation ended early.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError<E> {
    #[error("no objects to grasp: expected at least one")]
    NoObjects,
    #[error(transparent)]
    Option(#[from] OptionError),
    #[error(transparent)]
    CellUnit(#[from] CellUnitError),
    /// A candidate failed because of a fault of the simulator.
    #[error(transparent)]
    Candidate(#[from] CandidateError),
    #[error(
        "gave up after {} candidates with {} of {n_wanted} grasps: {:.1} % of the candidates are \
         stable by nature; ask for a stable fraction nearer to that, or for other objects",
        done.n_candidates, done.n_grasps, done.natural_stable_rate() * 100.0
    )]
    GaveUp {
        n_wanted: usize,
        /// Of the grasps that the sink has got.
        done: Box<SimulationReport>,
    },
    /// The observer asked to stop.
    #[error("interrupted")]
    Stopped {
        /// Of the grasps that the sink has got.
        done: Box<SimulationReport>,
    },
    /// The observer refused a grasp.
    #[error("{0}")]
    Sink(E),
}

/// Draws and judges a candidate by its number: a pure function of it and the options' seed.
type TryCandidate = fn(&Mechanism<'_>, &[Object], &SimulatorOptions, u64) -> Result<Outcome, CandidateError>;

/// A hand, the objects that it grasps, and the options.
#[derive(Debug, Clone, Copy)]
pub struct Simulation<'a> {
    pub hand: &'a Hand,
    pub objects: &'a [Object],
    pub options: &'a SimulatorOptions,
}

impl Simulation<'_> {
    /// Simulates a part's grasps and gives each to `sink`, in order. `progress` hears the counts so far now and then;
    /// `should_stop` is asked before each candidate.
    ///
    /// # Errors
    /// Options or a hand that cannot be used, no objects, the sink's error, a stable fraction that is out of reach, or
    /// [`SimulateError::Stopped`].
    pub fn part<E>(
        &self,
        part: &Part,
        should_stop: impl Fn() -> bool + Sync,
        mut progress: impl FnMut(&SimulationReport),
        mut sink: impl FnMut(SimulatedGrasp) -> Result<(), E>,
    ) -> Result<SimulationReport, SimulateError<E>> {
        let Simulation { hand, objects, options } = *self;
        options.check()?;
        check_hand(hand)?;
        if objects.is_empty() {
            return Err(SimulateError::NoObjects);
        }
        let mechanism = Mechanism::new(hand);
        let try_candidate: TryCandidate = match options.label {
            Label::WrenchSpace => candidate::try_candidate,
            Label::Lift => lift_label::try_candidate,
        };
        let mut run = PartRun::new(options, part);
        while run.report.n_grasps < part.n_grasps {
            let batch = run.next_batch(options)?;
            let outcomes: Vec<_> = batch
                .into_par_iter()
                .map(|candidate| (!should_stop()).then(|| try_candidate(&mechanism, objects, options, candidate)))
                .collect();
            let (mut kept, mut is_stopped) = (Vec::new(), false);
            for outcome in outcomes {
                if run.report.n_grasps == part.n_grasps {
                    break;
                }
                let Some(outcome) = outcome else {
                    is_stopped = true;
                    break;
                };
                run.count(outcome?, objects);
                kept.extend(std::iter::from_fn(|| run.next_kept()));
            }
            let made: Vec<SimulatedGrasp> = kept
                .into_par_iter()
                .map(|(grasp_id, judged)| judged.into_simulated(hand, objects, options, grasp_id))
                .collect();
            for grasp in made {
                run.report.count(&grasp, hand);
                sink(grasp).map_err(SimulateError::Sink)?;
            }
            if is_stopped {
                return Err(SimulateError::Stopped { done: Box::new(run.report) });
            }
            progress(&run.report);
        }
        run.report.n_over_quota += run.order.waiting.iter().map(VecDeque::len).sum::<usize>();
        Ok(run.report)
    }
}

/// Simulates all parts in order.
///
/// # Errors
/// The same as [`Simulation::part`]'s.
pub fn simulate_all<E>(
    hand: &Hand,
    objects: &[Object],
    options: &SimulatorOptions,
    mut sink: impl FnMut(SimulatedGrasp) -> Result<(), E>,
) -> Result<SimulationReport, SimulateError<E>> {
    let simulation = Simulation { hand, objects, options };
    let mut report = SimulationReport::default();
    for part in options.parts() {
        report.add(&simulation.part(&part, || false, |_| {}, &mut sink)?);
    }
    Ok(report)
}

/// The bookkeeping of a part.
struct PartRun<'a> {
    part: &'a Part,
    order: Order<Box<Judged>>,
    report: SimulationReport,
}

impl<'a> PartRun<'a> {
    fn new(options: &SimulatorOptions, part: &'a Part) -> Self {
        let SimulatorOptions { label, thresholds, .. } = *options;
        let report = SimulationReport { label, thresholds, ..SimulationReport::default() };
        PartRun { part, order: Order::new(options.seed, part), report }
    }

    /// The numbers of the next candidates. Batches only spread the work: the grasps do not depend on their sizes.
    fn next_batch<E>(&self, options: &SimulatorOptions) -> Result<std::ops::Range<u64>, SimulateError<E>> {
        let SimulationReport { n_candidates, n_grasps, .. } = self.report;
        let n_wanted = self.part.n_grasps;
        if n_candidates >= n_wanted.saturating_mul(options.max_candidates_per_grasp).saturating_add(1000) {
            return Err(SimulateError::GaveUp { n_wanted, done: Box::new(self.report.clone()) });
        }
        let (n_missing, n_threads) = (n_wanted - n_grasps, rayon::current_num_threads());
        let n_batch = match options.label {
            Label::WrenchSpace => (2 * n_missing).clamp(16, 256),
            // A superfluous candidate takes a second.
            Label::Lift => n_missing.clamp(n_threads, 8 * n_threads),
        };
        let first = ((self.part.idx as u64) << 32) + n_candidates as u64;
        Ok(first..first + n_batch as u64)
    }

    fn count(&mut self, outcome: Outcome, objects: &[Object]) {
        let report = &mut self.report;
        report.n_candidates += 1;
        let judged = match outcome {
            Outcome::NoTouch => {
                report.n_without_touch += 1;
                return;
            }
            Outcome::Diverged => {
                report.n_diverged += 1;
                return;
            }
            Outcome::HullFailure => {
                report.n_hull_failures += 1;
                return;
            }
            Outcome::Judged(judged) => judged,
        };
        let is_stable = judged.is_stable;
        let object = report.objects.entry(objects[judged.object_idx].name.clone()).or_default();
        object.class.clone_from(&objects[judged.object_idx].class);
        report.n_judged += 1;
        object.n_judged += 1;
        report.n_judged_stable += usize::from(is_stable);
        object.n_judged_stable += usize::from(is_stable);
        report.n_joggled += usize::from(judged.quality.joggle.is_some());
        report.n_over_quota += usize::from(!self.order.offer(is_stable, judged));
    }

    /// The next grasp that is kept, with its number.
    fn next_kept(&mut self) -> Option<(u64, Box<Judged>)> {
        let judged = self.order.next()?;
        let grasp_id = self.part.first_grasp_id + self.report.n_grasps as u64;
        self.report.n_grasps += 1;
        Some((grasp_id, judged))
    }
}

impl SimulationReport {
    /// Counts a grasp that is kept. [`PartRun::next_kept`] counts `n_grasps`.
    fn count(&mut self, grasp: &SimulatedGrasp, hand: &Hand) {
        let scene = &grasp.scene;
        let thresholds: Vec<f64> = hand.cells().map(|(_, cell)| cell.noise_threshold_newtons).collect();
        let least_threshold = thresholds.iter().copied().fold(f64::INFINITY, f64::min);
        let is_felt = |contact: &SceneContact| contact.felt_newtons > least_threshold;
        let mut settled = grasp.frames.iter().rev().filter(|timed| timed.frame.phase == Phase::Settled);
        let settled = settled.next().map_or(&[][..], |timed| &timed.frame.cells_newtons);
        let is_active = settled.iter().zip(&thresholds).any(|(newtons, threshold)| newtons > threshold);
        let of_object = scene.contacts.iter().filter(|contact| contact.other_link < 0);
        self.n_with_unsensed_contacts += usize::from(of_object.into_iter().any(|contact| !is_felt(contact)));
        self.n_without_active_cell += usize::from(!is_active);
        self.n_self_collisions += usize::from(scene.self_collision);
        self.n_stable += usize::from(grasp.truth.stable);
        let object = self.objects.entry(grasp.truth.object.clone()).or_default();
        object.n_grasps += 1;
        object.n_stable += usize::from(grasp.truth.stable);
    }
}

/// The order of stable and unstable grasps, and the grasps that wait for their turn.
struct Order<T> {
    /// The kinds still to come, last first; `None` takes grasps as they come.
    kinds: Option<Vec<bool>>,
    /// Unstable and stable grasps.
    waiting: [VecDeque<T>; 2],
}

impl<T> Order<T> {
    fn new(seed: u64, part: &Part) -> Self {
        let kinds = part.n_stable.map(|n_stable| {
            let mut kinds: Vec<bool> = (0..part.n_grasps).map(|idx| idx < n_stable).collect();
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            // Counted down from the last stream, which no candidate uses; the very last is the hand's.
            rng.set_stream(u64::MAX - 2 - part.idx as u64);
            for last in (1..kinds.len()).rev() {
                kinds.swap(last, rng.random_range(0..=last));
            }
            kinds
        });
        Order { kinds, waiting: [VecDeque::new(), VecDeque::new()] }
    }

    /// Takes a grasp in; false if enough of its kind are waiting.
    fn offer(&mut self, is_stable: bool, grasp: T) -> bool {
        let waiting = &mut self.waiting[usize::from(is_stable)];
        let has_room = waiting.len() < MAX_WAITING
            && self.kinds.as_ref().is_none_or(|kinds| kinds.contains(&is_stable) || kinds.is_empty());
        if has_room {
            waiting.push_back(grasp);
        }
        has_room
    }

    /// The next grasp in order, if it has been offered.
    fn next(&mut self) -> Option<T> {
        let Some(kinds) = &mut self.kinds else {
            return self.waiting[0].pop_front().or_else(|| self.waiting[1].pop_front());
        };
        let grasp = self.waiting[usize::from(*kinds.last()?)].pop_front()?;
        kinds.pop();
        Some(grasp)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::touches::training_objects;
    use blindgrasp_objects::select;
    use std::convert::Infallible;
    use std::path::Path;

    /// Grasps of the Barrett hand.
    pub(crate) fn simulated(
        objects: &[Object],
        options: &SimulatorOptions,
        n_threads: usize,
    ) -> (Vec<SimulatedGrasp>, SimulationReport) {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().expect("threads");
        let mut grasps = Vec::new();
        let keep = |grasp: SimulatedGrasp| {
            grasps.push(grasp);
            Ok::<_, Infallible>(())
        };
        let report = pool.install(|| simulate_all(&hand, objects, options, keep)).expect("simulated");
        (grasps, report)
    }

    fn run(options: &SimulatorOptions, n_threads: usize) -> (Vec<SimulatedGrasp>, SimulationReport) {
        simulated(training_objects().expect("a split"), options, n_threads)
    }

    pub(crate) fn check_same(grasps: &[SimulatedGrasp], others: &[SimulatedGrasp]) {
        assert_eq!(grasps.len(), others.len());
        for (a, b) in grasps.iter().zip(others) {
            assert_eq!((&a.frames, &a.truth, &a.scene), (&b.frames, &b.truth, &b.scene));
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_grasps_with_any_number_of_threads() {
        let options = SimulatorOptions { n_grasps: 40, seed: 5, ..SimulatorOptions::default() };
        let (one, report_of_one) = run(&options, 1);
        let (two, report_of_two) = run(&options, 2);
        assert_eq!(report_of_one, report_of_two);
        check_same(&one, &two);
        let (other, _) = run(&SimulatorOptions { seed: 6, ..options }, 2);
        assert_ne!(one[0].frames, other[0].frames);
    }

    #[test]
    fn the_stable_fraction_is_met_exactly_and_the_report_adds_up() {
        let options = SimulatorOptions { n_grasps: 50, stable_fraction: Some(0.7), ..SimulatorOptions::default() };
        let (grasps, report) = run(&options, 2);
        assert_eq!(grasps.iter().filter(|grasp| grasp.truth.stable).count(), 35);
        assert_eq!((report.n_grasps, report.n_stable), (50, 35));
        assert_eq!(report.n_judged, report.n_grasps + report.n_over_quota);
        assert_eq!(report.n_candidates, report.n_judged + report.n_without_touch + report.n_hull_failures);
        assert_eq!(report.objects.values().map(|object| object.n_judged).sum::<usize>(), report.n_judged);
        for (idx, grasp) in grasps.iter().enumerate() {
            assert_eq!(grasp.truth.grasp_id, idx as u64);
            assert_eq!(grasp.truth.stable, grasp.truth.epsilon > 0.07 && grasp.truth.volume > 0.1);
        }
    }

    #[test]
    fn a_part_is_the_same_made_alone_and_the_stable_ones_are_rounded_to_the_whole() {
        let options = SimulatorOptions { n_grasps: 25, grasps_per_part: 10, seed: 4, ..SimulatorOptions::default() };
        let parts: Vec<Part> = options.parts().collect();
        let of = |part: &Part| (part.first_grasp_id, part.n_grasps, part.n_stable);
        assert_eq!(parts.iter().map(of).collect::<Vec<_>>(), [(0, 10, Some(5)), (10, 10, Some(5)), (20, 5, Some(2))]);
        let (all, _) = run(&options, 2);
        assert_eq!(all.iter().map(|grasp| grasp.truth.grasp_id).collect::<Vec<_>>(), (0..25).collect::<Vec<_>>());
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let objects = training_objects().expect("a split");
        let mut alone = Vec::new();
        let keep = |grasp: SimulatedGrasp| {
            alone.push(grasp);
            Ok::<_, Infallible>(())
        };
        let simulation = Simulation { hand: &hand, objects, options: &options };
        simulation.part(&parts[1], || false, |_| {}, keep).expect("simulated");
        check_same(&alone, &all[10..20]);
    }

    #[test]
    fn a_grasps_number_says_nothing_of_its_label() {
        let options = SimulatorOptions { n_grasps: 400, stable_fraction: Some(0.3), ..SimulatorOptions::default() };
        let (grasps, _) = run(&options, 2);
        for quarter in grasps.chunks(100) {
            let n_stable = quarter.iter().filter(|grasp| grasp.truth.stable).count();
            // 30 expected, 4 its standard deviation.
            assert!((16..=44).contains(&n_stable), "{n_stable}");
        }
    }

    #[test]
    fn frames_open_close_and_settle() {
        let (grasps, _) = run(&SimulatorOptions { n_grasps: 10, ..SimulatorOptions::default() }, 2);
        for grasp in &grasps {
            let phases: Vec<_> = grasp.frames.iter().map(|timed| timed.frame.phase).collect();
            let expected = [vec![Phase::Open; 2], vec![Phase::Closing; 6], vec![Phase::Settled; 6]].concat();
            assert_eq!(phases, expected);
            for (idx, timed) in grasp.frames.iter().enumerate() {
                assert_eq!(timed.offset_nanos, idx as u64 * 10_000_000);
                assert_eq!((timed.frame.joints.len(), timed.frame.cells_newtons.len()), (7, 96));
            }
            // Noise alone in the open hand; what the contacts bring in the settled one.
            let strongest = |idx: usize| grasp.frames[idx].frame.cells_newtons.iter().copied().fold(0.0, f64::max);
            assert!(strongest(0) < 0.06, "{}", strongest(0));
            let expected: f64 = grasp.scene.contacts.iter().map(|contact| contact.felt_newtons).sum();
            let found: f64 = grasp.frames[13].frame.cells_newtons.iter().sum();
            // 96 clamped noises of 0.01 N add 0.4 N; saturation may take some away.
            assert!(found < expected + 1.0, "{found} {expected}");
            assert_ne!(grasp.frames[12].frame.cells_newtons, grasp.frames[13].frame.cells_newtons);
        }
    }

    #[test]
    fn what_cannot_be_is_said() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let sink = |_| Ok::<_, Infallible>(());
        let first = Part { idx: 0, first_grasp_id: 0, n_grasps: 2, n_stable: Some(2) };
        let simulate = |objects: &[Object], options: &SimulatorOptions| {
            Simulation { hand: &hand, objects, options }.part(&first, || false, |_| {}, sink)
        };
        let none = simulate(&[], &SimulatorOptions::default());
        assert!(matches!(none, Err(SimulateError::NoObjects)));
        let objects = select("ball").expect("a class");
        let mut options = SimulatorOptions { friction: -1.0, ..SimulatorOptions::default() };
        let refused = simulate(&objects, &options);
        assert!(matches!(refused, Err(SimulateError::Option(OptionError { option: "friction", .. }))));
        // Nearly frictionless grasps are never stable.
        options = SimulatorOptions { friction: 0.01, ..Default::default() };
        options.max_candidates_per_grasp = 0;
        let gave_up = simulate(&objects, &options);
        assert!(matches!(gave_up, Err(SimulateError::GaveUp { done, .. }) if done.n_grasps == 0));
    }
}
