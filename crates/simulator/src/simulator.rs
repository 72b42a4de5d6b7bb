//! Simulates blind grasps: draws candidates, keeps as many stable and unstable ones as asked for, makes frames of them.
//!
//! A simulation is cut into parts of a few hundred grasps. A candidate is a pure function of the seed, its part and its
//! number in it, and candidates are kept in the order of their numbers: a part depends on nothing but the options and
//! its index, so the same seed gives the same grasps with any number of threads, in one run or in several that share the
//! parts, and an interrupted run goes on with the next part. The thresholds of stability are never moved to reach the
//! asked-for fraction: candidates of the commoner kind are dropped, and [`SimulationReport`] says how many. In what order
//! stable and unstable grasps follow each other is drawn, so that a grasp's number says nothing of its label.
//!
//! A grasp that touches the object counts, even if no cell feels it: the arbiter then has to hold.

use blindgrasp_stages::label::Label;
use std::collections::{BTreeMap, VecDeque};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::candidate::{self, CandidateError, FrameOptions, Judged, Outcome, SimulatedGrasp};
use crate::contact_points::ContactOptions;
use crate::lifted;
use crate::mechanism::Mechanism;
use crate::planner::PlannerOptions;
use crate::protocol::{Approach, ProtocolOptions};
use crate::soft_finger::SoftFingerOptions;
use crate::tactile_sensor::SensorOptions;
use blindgrasp_messages::SceneContact;
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{CellUnit, Hand};

/// How many grasps of the commoner kind wait for their turn; more are dropped, so that memory stays flat.
const MAX_WAITING: usize = 64;

/// What to simulate and how.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatorOptions {
    /// How many grasps to keep.
    pub n_grasps: usize,
    /// Everything random comes from it.
    pub seed: u64,
    /// What stable means. The wrench space's; a lift's takes about a second of CPU time a candidate.
    #[serde(skip_serializing_if = "Label::is_default")]
    pub label: Label,
    /// This part of the grasps kept is stable (rounded to whole grasps); `None` keeps what comes. 0.48, as in the paper.
    pub stable_fraction: Option<f64>,
    /// Grasps are made in parts of so many: the unit that is shared between machines and made again after an
    /// interruption. 500: seconds of work.
    pub grasps_per_part: usize,
    /// Gives up after so many candidates per grasp asked for (and 1000 more). 50: a stable fraction of 0.48 is then
    /// reached down to a natural rate of 1 %.
    pub max_candidates_per_grasp: usize,
    /// Coulomb friction of every contact. 1.0: rubber on wood (the paper). With label `lift` that of the physics; epsilon
    /// and volume are then still those of 1.0.
    pub friction: f64,
    /// The exploration.
    pub protocol: ProtocolOptions,
    /// How planned grasps are found, where the protocol's approach is planned.
    pub planner: PlannerOptions,
    /// From touching links to contact points.
    pub contacts: ContactOptions,
    /// The rubber.
    pub soft_finger: SoftFingerOptions,
    /// Cells and encoders.
    pub sensor: SensorOptions,
    /// How many frames of which phase.
    pub frames: FrameOptions,
}

impl Default for SimulatorOptions {
    fn default() -> Self {
        SimulatorOptions {
            n_grasps: 1000,
            seed: 0,
            label: Label::default(),
            stable_fraction: Some(0.48),
            grasps_per_part: 500,
            max_candidates_per_grasp: 50,
            friction: 1.0,
            protocol: ProtocolOptions::default(),
            planner: PlannerOptions::default(),
            contacts: ContactOptions::default(),
            soft_finger: SoftFingerOptions::default(),
            sensor: SensorOptions::default(),
            frames: FrameOptions::default(),
        }
    }
}

/// A part of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part {
    /// Its index.
    pub idx: usize,
    /// Number of its first grasp.
    pub first_grasp_id: u64,
    /// How many grasps it has.
    pub n_grasps: usize,
    /// How many of them are to be stable, if that is asked for.
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

    /// Whether these options can be.
    ///
    /// # Errors
    /// The first that can't, with what was expected.
    pub fn check(&self) -> Result<(), OptionError> {
        let options = self;
        let positive = "a finite number above 0";
        let not_negative = "a finite number of 0 or more";
        let part = "a number from 0 to 1";
        let is_positive = |value: f64| value.is_finite() && value > 0.0;
        let is_not_negative = |value: f64| value.is_finite() && value >= 0.0;
        let is_part = |value: f64| (0.0..=1.0).contains(&value);
        let (protocol, rubber, sensor) = (&options.protocol, &options.soft_finger, &options.sensor);
        let [least, most] = protocol.preshape_range;
        let fraction = options.stable_fraction.unwrap_or(0.0);
        let n_points = options.contacts.contacts_per_link as f64;
        let FrameOptions { n_open, n_closing, n_settled, period_nanos } = options.frames;
        let [n_open, n_closing, n_settled, period] =
            [n_open as f64, n_closing as f64, n_settled as f64, period_nanos as f64];
        let planner = &options.planner;
        let n_approaches = planner.n_approaches as f64;
        let (n_grasps, largest_count) = (options.n_grasps as f64, f64::from(sensor.largest_count));
        let per_part = options.grasps_per_part as f64;
        let faults = sensor.dead_fraction + sensor.stuck_fraction;
        let count = "0 to 100000";
        let is_count = |value: f64| value <= 1e5;
        let checks = [
            ("grasps_per_part", per_part, (1.0..=1e5).contains(&per_part), "1 to 100000"),
            ("planner.n_approaches", n_approaches, (1.0..=1e4).contains(&n_approaches), "1 to 10000"),
            ("planner.normal_fraction", planner.normal_fraction, is_part(planner.normal_fraction), part),
            ("planner.distance_scale_m", planner.distance_scale_m, is_positive(planner.distance_scale_m), positive),
            ("gain_sigma", sensor.gain_sigma, is_not_negative(sensor.gain_sigma), not_negative),
            ("dead_fraction", sensor.dead_fraction, is_part(sensor.dead_fraction), part),
            ("stuck_fraction", sensor.stuck_fraction, is_part(sensor.stuck_fraction), part),
            ("dead_fraction + stuck_fraction", faults, is_part(faults), part),
            ("n_grasps", n_grasps, (1.0..=1e9).contains(&n_grasps), "1 to 1e9"),
            ("largest_count", largest_count, largest_count >= 1.0, "1 or more"),
            ("planner.stand_off_m", planner.stand_off_m, is_not_negative(planner.stand_off_m), not_negative),
            ("stable_fraction", fraction, is_part(fraction), part),
            ("friction", options.friction, is_positive(options.friction), positive),
            (
                "touch_tolerance_m",
                protocol.touch_tolerance_m,
                is_positive(protocol.touch_tolerance_m) && protocol.touch_tolerance_m <= 0.003,
                "a number above 0, at most 0.003: the rubber's thickness",
            ),
            ("clearance_m", protocol.clearance_m, is_positive(protocol.clearance_m), positive),
            ("preshape_range[0]", least, is_part(least), part),
            ("preshape_range[1]", most, is_part(most) && least <= most, "a number from preshape_range[0] to 1"),
            ("lateral_offset_m", protocol.lateral_offset_m, is_not_negative(protocol.lateral_offset_m), not_negative),
            ("back_off_m", protocol.back_off_m, is_not_negative(protocol.back_off_m), not_negative),
            ("contacts_per_link", n_points, (1.0..=3.0).contains(&n_points), "1, 2 or 3"),
            ("separation_m", options.contacts.separation_m, is_positive(options.contacts.separation_m), positive),
            ("thickness_m", rubber.thickness_m, is_positive(rubber.thickness_m), positive),
            ("youngs_modulus_pa", rubber.youngs_modulus_pa, is_positive(rubber.youngs_modulus_pa), positive),
            (
                "normal_force_newtons",
                rubber.normal_force_newtons,
                (1e-6..=1e4).contains(&rubber.normal_force_newtons),
                "1e-6 to 1e4",
            ),
            ("bare_half_width_m", rubber.bare_half_width_m, is_positive(rubber.bare_half_width_m), positive),
            ("largest_radius_m", rubber.largest_radius_m, is_positive(rubber.largest_radius_m), positive),
            ("noise_newtons", sensor.noise_newtons, is_not_negative(sensor.noise_newtons), not_negative),
            (
                "counts_per_newton_per_cm2",
                sensor.counts_per_newton_per_cm2,
                is_positive(sensor.counts_per_newton_per_cm2),
                positive,
            ),
            ("frames.n_open", n_open, is_count(n_open), count),
            ("frames.n_closing", n_closing, is_count(n_closing), count),
            ("frames.n_settled", n_settled, is_count(n_settled) && n_settled >= 1.0, "1 to 100000"),
            ("frames.period_nanos", period, (1.0..=1e12).contains(&period), "1 to 1e12"),
            (
                "encoder_quantum_rad",
                sensor.encoder_quantum_rad,
                is_not_negative(sensor.encoder_quantum_rad),
                not_negative,
            ),
        ];
        if let Some((option, found, _, expected)) = checks.into_iter().find(|(_, _, is_fine, _)| !is_fine) {
            return Err(OptionError { option, found: found.to_string(), expected });
        }
        match options.label {
            Label::WrenchSpace => Ok(()),
            Label::Lift if protocol.approach == Approach::Planned => {
                let expected = "blind with label lift: the physics have no planner";
                Err(OptionError { option: "protocol.approach", found: "planned".into(), expected })
            }
            Label::Lift if !(1e6..=1e8).contains(&period) => {
                let expected = "1e6 to 1e8 with label lift: steps of the physics are 5e6";
                Err(OptionError { option: "frames.period_nanos", found: period.to_string(), expected })
            }
            Label::Lift => options.check_unused_by_lift(),
        }
    }

    /// What the physics do not have may not be asked of them.
    fn check_unused_by_lift(&self) -> Result<(), OptionError> {
        let (protocol, ours) = (&self.protocol, ProtocolOptions::default());
        let expected = "its default with label lift: the physics have no such option";
        for (option, found, default) in [
            ("protocol.touch_tolerance_m", protocol.touch_tolerance_m, ours.touch_tolerance_m),
            ("protocol.clearance_m", protocol.clearance_m, ours.clearance_m),
            ("protocol.back_off_m", protocol.back_off_m, ours.back_off_m),
        ] {
            if found != default {
                return Err(OptionError { option, found: found.to_string(), expected });
            }
        }
        if self.planner != PlannerOptions::default() {
            return Err(OptionError { option: "planner", found: "set".into(), expected });
        }
        Ok(())
    }
}

/// What a simulation did.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SimulationReport {
    /// What stable means in it.
    #[serde(default, skip_serializing_if = "Label::is_default")]
    pub label: Label,
    /// Candidates tried, up to the last one kept.
    pub n_candidates: usize,
    /// Grasps kept.
    pub n_grasps: usize,
    /// Grasps kept that are stable.
    pub n_stable: usize,
    /// Candidates that never touched the object (or whose open hand touched itself).
    pub n_without_touch: usize,
    /// Candidates without a quality because the hull failed; dropped.
    pub n_hull_failures: usize,
    /// Candidates whose hull needed a joggle; they count.
    pub n_joggled: usize,
    /// Candidates dropped because enough of their kind were there.
    pub n_over_quota: usize,
    /// Candidates that touched and have a quality.
    pub n_judged: usize,
    /// How many of those are stable: their natural rate, before any balance.
    pub n_judged_stable: usize,
    /// Grasps kept with at least one contact that no cell feels.
    pub n_with_unsensed_contacts: usize,
    /// Grasps kept that no cell feels at all.
    pub n_without_active_cell: usize,
    /// Grasps kept in which links of the hand press on each other.
    pub n_self_collisions: usize,
    /// Per object with a candidate, by name.
    pub objects: BTreeMap<String, ObjectReport>,
}

/// An object's share in a simulation.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ObjectReport {
    /// Its class.
    pub class: String,
    /// Candidates that touched and have a quality.
    pub n_judged: usize,
    /// How many of those are stable.
    pub n_judged_stable: usize,
    /// Grasps kept.
    pub n_grasps: usize,
    /// How many of those are stable.
    pub n_stable: usize,
}

impl SimulationReport {
    /// Adds another part's report, of the same simulation.
    pub fn add(&mut self, other: &SimulationReport) {
        self.label = other.label;
        self.n_candidates += other.n_candidates;
        self.n_grasps += other.n_grasps;
        self.n_stable += other.n_stable;
        self.n_without_touch += other.n_without_touch;
        self.n_hull_failures += other.n_hull_failures;
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

/// An option of the simulator that can't be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("option {option} is {found}, expected {expected}")]
pub struct OptionError {
    /// The option.
    pub option: &'static str,
    /// Its value.
    pub found: String,
    /// What was expected.
    pub expected: &'static str,
}

/// The hand's cells read no forces: what a simulated force would make them read is not known.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the cells of the hand '{hand}' read {}, no forces: expected a hand whose layout has newtons", unit.word())]
pub struct CellUnitError {
    /// The hand's name.
    pub hand: String,
    /// What its cells read.
    pub unit: CellUnit,
}

/// Checks that a hand can be simulated.
///
/// # Errors
/// Its cells read no forces.
pub fn check_hand(hand: &Hand) -> Result<(), CellUnitError> {
    match hand.cell_unit {
        CellUnit::Newtons => Ok(()),
        unit => Err(CellUnitError { hand: hand.name.clone(), unit }),
    }
}

/// Why a simulation ended early.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError<E> {
    /// Nothing to grasp.
    #[error("no objects to grasp: expected at least one")]
    NoObjects,
    /// An option that can't be.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// A hand that cannot be simulated.
    #[error(transparent)]
    CellUnit(#[from] CellUnitError),
    /// A candidate failed for a reason that is the simulator's, not the grasp's.
    #[error(transparent)]
    Candidate(#[from] CandidateError),
    /// The objects don't give enough grasps of one kind.
    #[error(
        "gave up after {n_candidates} candidates with {n_grasps} of {n_wanted} grasps: {:.1} % of the candidates are \
         stable by nature; ask for a stable fraction nearer to that, or for other objects",
        natural_stable_rate * 100.0
    )]
    GaveUp {
        /// Candidates tried.
        n_candidates: usize,
        /// Grasps kept.
        n_grasps: usize,
        /// Grasps asked for.
        n_wanted: usize,
        /// Stable among the candidates with a quality.
        natural_stable_rate: f64,
    },
    /// It was asked to stop.
    #[error("interrupted")]
    Stopped,
    /// The sink refused a grasp.
    #[error("{0}")]
    Sink(E),
}

/// Draws and judges a candidate by its number: a pure function of it and the options' seed.
type TryCandidate = fn(&Mechanism<'_>, &[Object], &SimulatorOptions, u64) -> Result<Outcome, CandidateError>;

/// Simulates a part's grasps, handing each to `sink` in order; `progress` hears (kept, tried) now and then, `should_stop` is
/// asked before each candidate.
///
/// # Errors
/// Options that can't be, no objects, the sink's error; the stable fraction is out of reach; or it was asked to stop.
pub fn simulate<E>(
    hand: &Hand,
    objects: &[Object],
    options: &SimulatorOptions,
    part: &Part,
    should_stop: impl Fn() -> bool + Sync,
    mut progress: impl FnMut(usize, usize),
    mut sink: impl FnMut(SimulatedGrasp) -> Result<(), E>,
) -> Result<SimulationReport, SimulateError<E>> {
    options.check()?;
    check_hand(hand)?;
    if objects.is_empty() {
        return Err(SimulateError::NoObjects);
    }
    let mechanism = Mechanism::new(hand);
    let n_wanted = part.n_grasps;
    let mut order: Order<Box<Judged>> = Order::new(options.seed, part);
    let most_candidates = n_wanted.saturating_mul(options.max_candidates_per_grasp).saturating_add(1000);
    let first_of_part = (part.idx as u64) << 32;
    let mut report = SimulationReport { label: options.label, ..SimulationReport::default() };
    let try_candidate: TryCandidate = match options.label {
        Label::WrenchSpace => candidate::try_candidate,
        Label::Lift => lifted::try_candidate,
    };
    let n_threads = rayon::current_num_threads();
    while report.n_grasps < n_wanted {
        if report.n_candidates >= most_candidates {
            return Err(SimulateError::GaveUp {
                n_candidates: report.n_candidates,
                n_grasps: report.n_grasps,
                n_wanted,
                natural_stable_rate: report.natural_stable_rate(),
            });
        }
        // Batches only spread the work: what is kept doesn't depend on their size.
        let n_missing = n_wanted - report.n_grasps;
        let n_batch = match options.label {
            Label::WrenchSpace => (2 * n_missing).clamp(16, 256),
            // One too many takes a second.
            Label::Lift => n_missing.clamp(n_threads, 8 * n_threads),
        };
        let first = first_of_part + report.n_candidates as u64;
        let outcomes: Vec<_> = (first..first + n_batch as u64)
            .into_par_iter()
            .map(|candidate| (!should_stop()).then(|| try_candidate(&mechanism, objects, options, candidate)))
            .collect();
        let mut kept = Vec::new();
        for outcome in outcomes {
            if report.n_grasps == n_wanted {
                break;
            }
            report.n_candidates += 1;
            let judged = match outcome.ok_or(SimulateError::Stopped)?? {
                Outcome::NoTouch => {
                    report.n_without_touch += 1;
                    continue;
                }
                Outcome::HullFailure => {
                    report.n_hull_failures += 1;
                    continue;
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
            if !order.offer(is_stable, judged) {
                report.n_over_quota += 1;
            }
            while let Some(judged) = order.next() {
                kept.push((part.first_grasp_id + report.n_grasps as u64, judged));
                report.n_grasps += 1;
            }
        }
        let made: Vec<SimulatedGrasp> = kept
            .into_par_iter()
            .map(|(grasp_id, judged)| judged.into_simulated(hand, objects, options, grasp_id))
            .collect();
        for grasp in made {
            report.count(&grasp, hand);
            sink(grasp).map_err(SimulateError::Sink)?;
        }
        progress(report.n_grasps, report.n_candidates);
    }
    report.n_over_quota += order.waiting.iter().map(VecDeque::len).sum::<usize>();
    Ok(report)
}

/// Simulates all parts in order.
///
/// # Errors
/// As [`simulate`].
pub fn simulate_all<E>(
    hand: &Hand,
    objects: &[Object],
    options: &SimulatorOptions,
    mut sink: impl FnMut(SimulatedGrasp) -> Result<(), E>,
) -> Result<SimulationReport, SimulateError<E>> {
    let mut report = SimulationReport::default();
    for part in options.parts() {
        report.add(&simulate(hand, objects, options, &part, || false, |_, _| {}, &mut sink)?);
    }
    Ok(report)
}

impl SimulationReport {
    /// Counts a grasp that is kept. `n_grasps` is counted where its number is given.
    fn count(&mut self, grasp: &SimulatedGrasp, hand: &Hand) {
        let scene = &grasp.scene;
        let thresholds: Vec<f64> = hand.cells().map(|(_, cell)| cell.noise_threshold_newtons).collect();
        let least_threshold = thresholds.iter().copied().fold(f64::INFINITY, f64::min);
        let is_felt = |contact: &SceneContact| contact.felt_newtons > least_threshold;
        let settled = grasp.frames.last().map_or(&[][..], |timed| &timed.frame.cells_newtons);
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

/// In what order stable and unstable grasps are kept, and those that wait for their turn.
struct Order<T> {
    /// The kinds still to come, last first; `None` takes what comes.
    kinds: Option<Vec<bool>>,
    /// Unstable and stable ones.
    waiting: [VecDeque<T>; 2],
}

impl<T> Order<T> {
    fn new(seed: u64, part: &Part) -> Self {
        let kinds = part.n_stable.map(|n_stable| {
            let mut kinds: Vec<bool> = (0..part.n_grasps).map(|idx| idx < n_stable).collect();
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            // Counted down from the last stream, where no candidate's is; the very last is the hand's.
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

    /// The next grasp in order, if it is there.
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
mod tests {
    use super::*;
    use blindgrasp_messages::Phase;
    use blindgrasp_objects::select;
    use std::convert::Infallible;
    use std::path::Path;

    fn run(options: &SimulatorOptions, n_threads: usize) -> (Vec<SimulatedGrasp>, SimulationReport) {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let objects = select("train").expect("a split");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().expect("threads");
        let mut grasps = Vec::new();
        let keep = |grasp: SimulatedGrasp| {
            grasps.push(grasp);
            Ok::<_, Infallible>(())
        };
        let report = pool.install(|| simulate_all(&hand, &objects, options, keep)).expect("simulated");
        (grasps, report)
    }

    #[test]
    fn the_same_seed_gives_the_same_grasps_with_any_number_of_threads() {
        let options = SimulatorOptions { n_grasps: 40, seed: 5, ..SimulatorOptions::default() };
        let (one, report_of_one) = run(&options, 1);
        let (two, report_of_two) = run(&options, 2);
        assert_eq!(report_of_one, report_of_two);
        for (a, b) in one.iter().zip(&two) {
            assert_eq!((&a.frames, &a.truth, &a.scene), (&b.frames, &b.truth, &b.scene));
        }
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
        let objects = select("train").expect("a split");
        let mut alone = Vec::new();
        let keep = |grasp: SimulatedGrasp| {
            alone.push(grasp);
            Ok::<_, Infallible>(())
        };
        simulate(&hand, &objects, &options, &parts[1], || false, |_, _| {}, keep).expect("simulated");
        for (a, b) in alone.iter().zip(&all[10..20]) {
            assert_eq!((&a.frames, &a.truth, &a.scene), (&b.frames, &b.truth, &b.scene));
        }
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
                assert_eq!((timed.frame.joints_rad.len(), timed.frame.cells_newtons.len()), (7, 96));
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
        let none = simulate(&hand, &[], &SimulatorOptions::default(), &first, || false, |_, _| {}, sink);
        assert!(matches!(none, Err(SimulateError::NoObjects)));
        let objects = select("ball").expect("a class");
        let mut options = SimulatorOptions { friction: -1.0, ..SimulatorOptions::default() };
        let refused = simulate(&hand, &objects, &options, &first, || false, |_, _| {}, sink);
        assert!(matches!(refused, Err(SimulateError::Option(OptionError { option: "friction", .. }))));
        // Nearly frictionless grasps are never stable.
        options = SimulatorOptions { friction: 0.01, ..Default::default() };
        options.max_candidates_per_grasp = 0;
        let gave_up = simulate(&hand, &objects, &options, &first, || false, |_, _| {}, sink);
        assert!(matches!(gave_up, Err(SimulateError::GaveUp { n_grasps: 0, .. })));
    }
}
