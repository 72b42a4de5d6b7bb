//! Trains the judgement of probes, and chooses the thresholds of all looks at a grasp together.
//!
//! A trial is a series of attempts at an object that ends with the first lift. An attempt that looks bad when the hand has
//! settled is given up; otherwise a probe follows, and its judgement decides. The thresholds are chosen for trials:
//! hard objects take more attempts, so a share of kept objects over single grasps would promise too much.

use rayon::prelude::*;

use super::{
    Example, OutOfFold, Signals, TrainingError, calibrate, fit_trees, out_of_fold_probabilities, picked, prepare,
};
use crate::evaluation::measures::{area_under_roc, curve};
use crate::evaluation::reliability::{N_RELIABILITY_BINS, reliability};
use crate::learners::training_range::learn_training_range;
use crate::promise::{ObjectTrials, promise};
use blindgrasp_grasps::reading::Felt;
use blindgrasp_messages::{Fault, Phase};
use blindgrasp_stages::classifier::boosting::BoostingParams;
use blindgrasp_stages::classifier::{Classifier, Predictor};
use blindgrasp_stages::encoder::{Block, FeatureExtractor, FeltReading};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::own_lifts::{SQUEEZE_COSTS, TEST_LIFT_COSTS, attempts_per_kept};
use blindgrasp_stages::probe::{GraspHistory, ProbeModel, n_values, signals};
use blindgrasp_stages::recipe::Recipe;
use blindgrasp_stages::training_summary::{Promise, ThresholdPoint};

/// The attempts of a trial that is never lifted.
const MOST_ATTEMPTS: u32 = 20;
/// Costs that differ by a smaller part than this count as equal. The cost is flat near its least value: two simulations of the same
/// 10,000 lifts, with other noise of the cells, had their least costs where 3.1 and 5.1 % of the lifts drop.
const EQUAL_COST: f64 = 0.02;
/// The thresholds of a curve, beside the chosen one. They are fixed, so that curves of different recordings can be compared.
const CURVE: [f64; 7] = [0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98];
/// Probes are judged by trees that learn from many more values than a settled grasp has.
const PARAMS: BoostingParams = BoostingParams {
    n_rounds: 400,
    learning_rate: 0.03,
    max_depth: 5,
    min_child_weight: 5.0,
    lambda: 5.0,
    subsample: 0.8,
    colsample_bynode: 0.3,
};

/// A probe that was learned, before its threshold is chosen.
pub(super) struct LearnedProbe {
    pub(super) probe: ProbeModel,
    /// The probability of each example by machines that have not seen its object; `None` if it has no such reading.
    pub(super) probabilities: Vec<Option<f64>>,
}

impl LearnedProbe {
    /// From here on a grasp is stable; below it is unstable.
    pub(super) fn set_threshold(&mut self, probability: f64) {
        self.probe.classifier.threshold_probability = probability;
        self.probe.classifier.unsure_from_probability = probability;
    }
}

/// The probes that could be learned. A test lift needs a squeeze before it, so that its probe never stands alone.
#[derive(Default)]
pub(super) struct LearnedProbes {
    pub(super) squeezed: Option<LearnedProbe>,
    pub(super) test_lifted: Option<LearnedProbe>,
}

impl LearnedProbes {
    /// The probe that this look comes after.
    pub(super) fn after(&mut self, look: Phase) -> Option<&mut LearnedProbe> {
        match look {
            Phase::Squeezed => self.squeezed.as_mut(),
            Phase::TestLifted => self.test_lifted.as_mut(),
            _ => None,
        }
    }
}

/// The number of grasps without a frame of this phase.
pub(super) fn n_without(phase: Phase, examples: &[&Example]) -> usize {
    examples.iter().filter(|example| reading_at(phase, example).is_none()).count()
}

/// Learns to judge the frames of a phase, which all grasps have; `None` if the frames of objects not seen say nothing of the
/// outcome.
pub(super) fn learn(
    hand: &Hand,
    recipe: &Recipe,
    features: &FeatureExtractor,
    phase: Phase,
    examples: &[&Example],
    folds: &[usize],
    seed: u64,
) -> Result<Option<LearnedProbe>, TrainingError> {
    let n_values = n_values(features);
    let rows = composed_rows(features, phase, examples);
    let mut decision_values = vec![0.0; examples.len()];
    let n_folds = folds.iter().max().map_or(0, |last| last + 1);
    for fold in 0..n_folds {
        let others: Vec<usize> = (0..examples.len()).filter(|idx| folds[*idx] != fold).collect();
        let features = prepare(hand, recipe, &picked(examples, &others), seed)?.features;
        let rows = composed_rows(&features, phase, examples);
        let trees = fit_trees(&rows, n_values, examples, folds, Some(fold), &PARAMS, seed)?;
        for (idx, row) in rows.iter().enumerate() {
            if let Some(row) = row
                && folds[idx] == fold
            {
                decision_values[idx] = trees.decision_value(row);
            }
        }
    }
    let kept_idxs: Vec<usize> = (0..examples.len()).filter(|idx| rows[*idx].is_some()).collect();
    let kept = OutOfFold {
        examples: picked(examples, &kept_idxs),
        decision_values: kept_idxs.iter().map(|idx| decision_values[*idx]).collect(),
        folds: kept_idxs.iter().map(|idx| folds[*idx]).collect(),
    };
    let stable: Vec<bool> = kept.examples.iter().map(|example| example.stable).collect();
    let calibration = calibrate(&kept.examples, &kept.decision_values)?;
    if calibration.a >= 0.0 {
        return Ok(None);
    }
    let judged = out_of_fold_probabilities(&kept)?;
    let mut probabilities = vec![None; examples.len()];
    for (idx, probability) in kept_idxs.iter().zip(&judged) {
        probabilities[*idx] = Some(*probability);
    }
    let readings: Vec<FeltReading<'_>> =
        kept.examples.iter().filter_map(|example| reading_at(phase, example)).collect();
    let trees = fit_trees(&rows, n_values, examples, folds, None, &PARAMS, seed)?;
    let probe = ProbeModel {
        classifier: Classifier {
            predictor: Predictor::Boosting(trees),
            calibration,
            threshold_probability: 1.0,
            unsure_from_probability: 1.0,
        },
        training_range: learn_training_range(hand, features, &readings, &kept.folds),
        cross_validated_roc_area: area_under_roc(&curve(&judged, &stable)).unwrap_or(0.5),
        cross_validated_ece: reliability(&judged, &stable, N_RELIABILITY_BINS).ece,
    };
    Ok(Some(LearnedProbe { probe, probabilities }))
}

fn composed_rows(features: &FeatureExtractor, phase: Phase, examples: &[&Example]) -> Vec<Option<Vec<f64>>> {
    examples.par_iter().map(|example| composed(features, phase, example)).collect()
}

/// The frame of a look, as it was felt.
pub(crate) fn reading_at(look: Phase, example: &Example) -> Option<FeltReading<'_>> {
    match look {
        Phase::Settled => Some(example.reading()),
        Phase::Squeezed => example.squeezed.as_ref().map(Felt::reading),
        _ => example.test_lifted.as_ref().map(Felt::reading),
    }
}

/// The values from which a probe is judged; `None` if a reading has no feature.
fn composed(features: &FeatureExtractor, phase: Phase, example: &Example) -> Option<Vec<f64>> {
    let followed = signals(features);
    let [squeezing, test_lifting] = &example.moving;
    let mut history = GraspHistory::default();
    history.add(
        (0, 0),
        Phase::Settled,
        extracted(features, &example.reading()).as_deref().map_err(|fault| *fault),
        &followed,
    );
    add_moves(&mut history, Phase::Squeezing, squeezing, features, &followed);
    if phase == Phase::TestLifted {
        let squeezed = extracted(features, &reading_at(Phase::Squeezed, example)?);
        history.add((0, 0), Phase::Squeezed, squeezed.as_deref().map_err(|fault| *fault), &followed);
        add_moves(&mut history, Phase::TestLifting, test_lifting, features, &followed);
    }
    let now = extracted(features, &reading_at(phase, example)?).ok()?;
    let mut composed = Vec::new();
    history.compose(phase, &now, &followed, &mut composed).ok()?;
    Some(composed)
}

/// The values from which a model judges a grasp at a look; `None` if it has no feature there.
pub(crate) fn values_at(model: &Model, look: Phase, example: &Example) -> Option<Vec<f64>> {
    match look {
        Phase::Settled => extracted(&model.features, &example.reading()).ok(),
        _ => composed(&model.features, look, example),
    }
}

fn extracted(features: &FeatureExtractor, reading: &FeltReading<'_>) -> Result<Vec<f64>, Fault> {
    let mut values = Vec::new();
    features.extract(reading, &mut values)?;
    Ok(values)
}

/// Adds the frames of a hand that moves, of which the followed signals alone are known.
fn add_moves(
    history: &mut GraspHistory,
    phase: Phase,
    moving: &[Signals],
    features: &FeatureExtractor,
    followed: &[usize],
) {
    let mut row = vec![0.0; features.len()];
    for signals in moving {
        let pads = if features.blocks.contains(&Block::Pads) { &signals.pad_newtons[..] } else { &[] };
        let numbers = pads.iter().copied().chain(signals.wrist_newtons);
        for (idx, number) in followed.iter().zip(numbers) {
            row[*idx] = number;
        }
        history.add((0, 0), phase, Ok(&row), followed);
    }
}

/// The thresholds of the looks at a grasp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Thresholds {
    /// A settled grasp below this is given up.
    pub(crate) promising: f64,
    /// A tight grasp below this is given up before the test lift. 0 without a test lift.
    pub(crate) promising_squeezed: f64,
    /// From here on the grasp is lifted.
    pub(crate) lift: f64,
}

/// The thresholds of a policy, and what to expect of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Policy {
    pub(super) thresholds: Thresholds,
    pub(super) expected: Expected,
}

/// What to expect of trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Expected {
    /// Of the objects that are lifted, the share that is kept.
    pub(super) kept: f64,
    pub(super) attempts_per_lift: f64,
    pub(super) given_up: f64,
    /// Attempts and probes for each lift, in attempts.
    work_per_lift: f64,
}

impl Expected {
    /// Attempts and probes for each kept object if a drop costs as much as `drop_costs` attempts.
    fn cost(&self, drop_costs: f64) -> f64 {
        attempts_per_kept(self.work_per_lift, self.kept, drop_costs)
    }
}

/// One grasp of a policy: its object, its probability at each look, and its outcome.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Attempted {
    /// A number below that of all objects.
    pub(crate) object: usize,
    /// The fold of its object.
    pub(crate) fold: usize,
    pub(crate) settled: f64,
    /// When it is tight, before a test lift that decides. 1 without one.
    pub(crate) squeezed: f64,
    /// When it is decided; `None` if that look has no feature.
    pub(crate) decided: Option<f64>,
    pub(crate) stable: bool,
}

/// The looks that may decide.
pub(crate) const LOOKS: [Phase; 3] = [Phase::Settled, Phase::Squeezed, Phase::TestLifted];

/// Takes the place of a probability where a look has no feature: only a threshold that gives up no grasp lets it go on.
pub(super) const NO_FEATURE: f64 = -1.0;

/// The policies that grasps offer, from all of them and from those of all folds but one.
pub(super) struct Policies {
    all: Vec<Policy>,
    /// The grasps of each fold, and the policies that the other folds offer.
    folds: Vec<(Vec<Attempted>, Vec<Policy>)>,
    n_attempts: u32,
}

impl Policies {
    /// Without a probe, `decided` is `settled`, and no grasp is given up before. With one, no grasp is given up from
    /// the first of `stable_from` on when it has settled, and from the second on when it is tight: it counts as stable there.
    pub(super) fn new(grasps: &[Attempted], last: Phase, stable_from: [f64; 2]) -> Policies {
        let n_folds = grasps.iter().map(|grasp| grasp.fold + 1).max().unwrap_or(0);
        let mut folds = Vec::new();
        for fold in 0..n_folds {
            let (own, others): (Vec<_>, Vec<_>) = grasps.iter().partition(|grasp| grasp.fold == fold);
            folds.push((own, policies(&others, last, stable_from)));
        }
        Policies { all: policies(grasps, last, stable_from), folds, n_attempts: most_attempts(grasps) }
    }

    /// The policy that costs the least for each kept object if a drop costs as much as `drop_costs` attempts, or hardly more with
    /// fewer drops; `None` if nothing is ever lifted.
    pub(super) fn cheapest(&self, drop_costs: f64) -> Option<Policy> {
        cheapest(&self.all, drop_costs)
    }

    /// The bounds of drops for new objects if the policy is chosen like this. Each fold's objects are tried with the policy that is
    /// the cheapest for the probabilities of the other folds, and all objects count.
    pub(super) fn promise(&self, drop_costs: f64) -> Option<Promise> {
        let mut tried = Vec::new();
        for (grasps, policies) in &self.folds {
            let counts = counts(grasps, cheapest(policies, drop_costs)?.thresholds);
            tried.extend(counts.iter().map(|count| count.trials(self.n_attempts)));
        }
        Some(Promise { n_attempts: Some(self.n_attempts), ..promise(&tried)? })
    }
}

/// What thresholds of the deciding look lead to, the chosen one among them. A threshold that lifts nothing is left out.
pub(crate) fn threshold_curve(grasps: &[Attempted], chosen: Thresholds, last: Phase) -> Vec<ThresholdPoint> {
    let mut lifts = CURVE.to_vec();
    lifts.push(chosen.lift);
    lifts.sort_by(f64::total_cmp);
    lifts.dedup();
    let n_stable = grasps.iter().filter(|grasp| grasp.stable).count() as f64;
    let n_attempts = most_attempts(grasps);
    let mut points = Vec::new();
    for lift in lifts {
        let thresholds = Thresholds { lift, ..chosen };
        let Some(expected) = expect(grasps, thresholds, last) else { continue };
        let counts = counts(grasps, thresholds);
        let tried: Vec<ObjectTrials> = counts.iter().map(|count| count.trials(n_attempts)).collect();
        points.push(ThresholdPoint {
            threshold_probability: lift,
            kept: expected.kept,
            recall: counts.iter().map(|count| count.kept).sum::<f64>() / n_stable,
            attempts_per_lift: expected.attempts_per_lift,
            given_up: expected.given_up,
            drops_at_most: promise(&tried).map(|promise| promise.drops_of_lifts.at_most),
        });
    }
    points
}

/// The most attempts of a trial: so many grasps of nine objects in ten were recorded.
fn most_attempts(grasps: &[Attempted]) -> u32 {
    let all = Thresholds { promising: 0.0, promising_squeezed: 0.0, lift: 0.0 };
    let mut n_grasps: Vec<u32> = counts(grasps, all).iter().map(|count| count.n as u32).collect();
    n_grasps.sort_unstable();
    n_grasps.get(n_grasps.len() / 10).copied().unwrap_or(0).min(MOST_ATTEMPTS)
}

/// The policy that keeps the most among those whose cost equals the least cost: see [`EQUAL_COST`].
fn cheapest(policies: &[Policy], drop_costs: f64) -> Option<Policy> {
    let cost = |policy: &Policy| policy.expected.cost(drop_costs);
    let least = policies.iter().map(cost).min_by(f64::total_cmp)?;
    let equal = policies.iter().copied().filter(|policy| cost(policy) <= (1.0 + EQUAL_COST) * least);
    equal.max_by(|a, b| a.expected.kept.total_cmp(&b.expected.kept).then(cost(b).total_cmp(&cost(a))))
}

/// The policies among which one is chosen: quantiles of the probabilities as thresholds. All grasps from
/// `stable_from` on go on, settled and tight.
fn policies(grasps: &[Attempted], last: Phase, [settled_from, squeezed_from]: [f64; 2]) -> Vec<Policy> {
    let stable = || grasps.iter().filter(|grasp| grasp.stable);
    let settled = stable().map(|grasp| grasp.settled.min(settled_from)).collect();
    let squeezed = stable().map(|grasp| grasp.squeezed.min(squeezed_from)).collect();
    let (promising, promising_squeezed, n_lifts) = match last {
        Phase::TestLifted => (quantiles(settled, 16), quantiles(squeezed, 12), 200),
        Phase::Squeezed => (quantiles(settled, 20), vec![0.0], 400),
        _ => (vec![0.0], vec![0.0], 400),
    };
    let mut candidates = Vec::new();
    let lifts = quantiles(grasps.iter().filter_map(|grasp| grasp.decided).collect(), n_lifts);
    for promising in promising {
        for &promising_squeezed in &promising_squeezed {
            candidates.extend(lifts.iter().map(|&lift| Thresholds { promising, promising_squeezed, lift }));
        }
    }
    let policy = |thresholds| Some(Policy { thresholds, expected: expect(grasps, thresholds, last)? });
    candidates.into_par_iter().filter_map(policy).collect()
}

/// At most `n` of the values, evenly spread among all different ones, in ascending order.
fn quantiles(mut values: Vec<f64>, n: usize) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values.dedup();
    (0..n).filter_map(|idx| values.get(idx * values.len() / n).copied()).collect()
}

/// The grasps of an object, and those of them that thresholds let pass.
#[derive(Clone, Default)]
struct Count {
    n: f64,
    promising: f64,
    /// Those that are still promising when they are tight.
    promising_squeezed: f64,
    lifted: f64,
    kept: f64,
}

impl Count {
    /// The trials of at most so many attempts if these are the grasps in random order, each once. So each share is an unbiased
    /// estimate for trials of this object, which the same grasp drawn several times would not give.
    fn trials(&self, n_attempts: u32) -> ObjectTrials {
        let not_lifted = self.n - self.lifted;
        let n_attempts = n_attempts.min(self.n as u32);
        let none_lifted: f64 =
            (0..n_attempts).map(f64::from).map(|k| (not_lifted - k).max(0.0) / (self.n - k)).product();
        let lifted = 1.0 - none_lifted;
        let dropped = if self.lifted > 0.0 { lifted * (1.0 - self.kept / self.lifted) } else { 0.0 };
        ObjectTrials { lifted, dropped }
    }
}

fn counts(grasps: &[Attempted], thresholds: Thresholds) -> Vec<Count> {
    let Thresholds { promising, promising_squeezed, lift } = thresholds;
    let n_objects = grasps.iter().map(|grasp| grasp.object + 1).max().unwrap_or(0);
    let mut objects = vec![Count::default(); n_objects];
    for grasp in grasps {
        let count = &mut objects[grasp.object];
        count.n += 1.0;
        if grasp.settled < promising {
            continue;
        }
        count.promising += 1.0;
        if grasp.squeezed < promising_squeezed {
            continue;
        }
        count.promising_squeezed += 1.0;
        if grasp.decided.is_some_and(|probability| probability >= lift) {
            count.lifted += 1.0;
            count.kept += f64::from(u8::from(grasp.stable));
        }
    }
    // Of a part of the grasps, some objects are in the other part.
    objects.retain(|count| count.n > 0.0);
    objects
}

/// The chances of objects that an attempt ends with a lift, by their first two moments over all objects, each of which weighs
/// the same. Taken as beta distributed, they say what an object does after its recorded grasps.
struct Chances {
    mean: f64,
    /// Their variance as a share of the largest one with this mean: 0 if all objects are alike, 1 if an object is lifted
    /// always or never.
    correlation: f64,
}

impl Chances {
    /// Both moments are unbiased for any number of grasps: the mean of the share of lifts, and that of the share of an object's
    /// pairs of grasps that are both lifts. Without a pair, an object's next grasp is taken to end like the one before.
    fn of(objects: &[Count]) -> Chances {
        let (mut lifted, mut both_lifted, mut n_with_pairs) = (0.0, 0.0, 0.0);
        for count in objects {
            lifted += count.lifted / count.n;
            if count.n > 1.0 {
                both_lifted += count.lifted * (count.lifted - 1.0) / (count.n * (count.n - 1.0));
                n_with_pairs += 1.0;
            }
        }
        let mean = lifted / objects.len() as f64;
        let square = if n_with_pairs > 0.0 { both_lifted / n_with_pairs } else { mean };
        let most = mean - mean * mean;
        let correlation = if most > 0.0 { ((square - mean * mean) / most).clamp(0.0, 1.0) } else { 0.0 };
        Chances { mean, correlation }
    }

    /// The probability that an object whose `n_failed` grasps were no lifts is not lifted by the next attempt either.
    fn fails_again(&self, n_failed: f64) -> f64 {
        let prior = 1.0 - self.correlation;
        (prior * (1.0 - self.mean) + self.correlation * n_failed) / (prior + self.correlation * n_failed)
    }
}

/// A trial of an object with these grasps: the expected number of its attempts, and the probability that none of them ends
/// with a lift. The first attempts are the grasps in random order, each once, which is unbiased as in [`Count::trials`]. Later
/// ones are needed if none of the grasps is a lift, and follow from the chances of all objects.
fn trial(count: &Count, chances: &Chances) -> (f64, f64) {
    let (mut n_attempts, mut none_lifted) = (0.0, 1.0);
    for n_failed in (0..MOST_ATTEMPTS).map(f64::from) {
        n_attempts += none_lifted;
        none_lifted *= if n_failed < count.n {
            (count.n - count.lifted - n_failed).max(0.0) / (count.n - n_failed)
        } else {
            chances.fails_again(n_failed)
        };
    }
    (n_attempts, none_lifted)
}

/// What thresholds lead to in trials of objects like these; each object weighs the same. `None` if nothing is lifted.
fn expect(grasps: &[Attempted], thresholds: Thresholds, last: Phase) -> Option<Expected> {
    let objects = counts(grasps, thresholds);
    let chances = Chances::of(&objects);
    let (mut lifted, mut attempts, mut work) = (0.0, 0.0, 0.0);
    let (mut first_lifted, mut first_dropped) = (0.0, 0.0);
    for count in &objects {
        let (n_attempts, none_lifted) = trial(count, &chances);
        let ends = 1.0 - none_lifted;
        let of_first = count.trials(MOST_ATTEMPTS);
        first_lifted += of_first.lifted;
        first_dropped += of_first.dropped;
        lifted += ends;
        attempts += n_attempts;
        // The attempts before a lift are a random part of the grasps that are not lifted.
        let n_of = |part: f64| ends + (n_attempts - ends) * (part - count.lifted) / (count.n - count.lifted).max(1.0);
        let probes = match last {
            Phase::TestLifted => {
                n_of(count.promising) * SQUEEZE_COSTS + n_of(count.promising_squeezed) * TEST_LIFT_COSTS
            }
            Phase::Squeezed => n_of(count.promising) * SQUEEZE_COSTS,
            _ => 0.0,
        };
        work += n_attempts + probes;
    }
    // An object that is lifted after its recorded grasps is kept as often as others.
    let kept = if first_lifted > 0.0 { 1.0 - first_dropped / first_lifted } else { 0.0 };
    (kept > 0.0).then(|| Expected {
        kept,
        attempts_per_lift: attempts / lifted,
        given_up: 1.0 - lifted / objects.len() as f64,
        work_per_lift: work / lifted,
    })
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn grasps(of: &[(&str, f64, f64, bool)]) -> Vec<Attempted> {
        of.iter()
            .map(|(object, settled, decided, stable)| Attempted {
                object: usize::from(*object == "b"),
                fold: usize::from(*object == "b"),
                settled: *settled,
                squeezed: 1.0,
                decided: Some(*decided),
                stable: *stable,
            })
            .collect()
    }

    #[test]
    fn trials_by_hand() {
        // Of object a the first or second grasp is lifted, and kept; of b any of four, and dropped.
        let grasps = grasps(&[
            ("a", 0.9, 0.9, true),
            ("a", 0.1, 0.9, false),
            ("b", 0.9, 0.8, false),
            ("b", 0.9, 0.2, true),
            ("b", 0.9, 0.2, false),
            ("b", 0.9, 0.2, false),
        ]);
        let with = |lift: f64| Thresholds { promising: 0.5, promising_squeezed: 0.0, lift };
        let expected = expect(&grasps, with(0.5), Phase::TestLifted).expect("lifts");
        // In random order, the lift is number 1.5 and 2.5 in the mean. A probe comes before each lift, and in all grasps of b.
        let work = (1.5 + 2.5) + (1.0 + 2.5) * (SQUEEZE_COSTS + TEST_LIFT_COSTS);
        assert_eq!((expected.kept, expected.attempts_per_lift, expected.given_up), (0.5, 2.0, 0.0));
        assert!((expected.work_per_lift - work / 2.0).abs() < 1e-12, "{expected:?}");
        // A higher threshold lifts none of b's grasps, and keeps each object that it lifts. As both shares of lifts, 1/2 and 0,
        // vary less than chance makes them, b has the mean of the two from its fifth attempt on.
        let strict = expect(&grasps, with(0.85), Phase::TestLifted).expect("lifts");
        assert_eq!(strict.kept, 1.0);
        assert!((strict.given_up - 0.75_f64.powi(16) / 2.0).abs() < 1e-12, "{strict:?}");
        assert_eq!(expect(&grasps, with(1.0), Phase::TestLifted), None);
    }

    #[test]
    fn drops_that_cost_more_are_worth_more_attempts() {
        let grasps =
            grasps(&[("a", 0.9, 0.9, true), ("a", 0.9, 0.3, true), ("a", 0.9, 0.3, true), ("a", 0.9, 0.3, false)]);
        let policies = Policies::new(&grasps, Phase::Squeezed, [1.0, 1.0]);
        let chosen =
            |drop_costs| policies.cheapest(drop_costs).map(|policy| (policy.thresholds.lift, policy.expected.kept));
        assert_eq!((chosen(0.0), chosen(1000.0)), (Some((0.3, 0.75)), Some((0.9, 1.0))));
    }

    #[test]
    fn a_curve_has_what_each_threshold_leads_to() {
        let grasps =
            grasps(&[("a", 0.9, 0.9, true), ("a", 0.9, 0.3, true), ("a", 0.9, 0.3, true), ("a", 0.9, 0.3, false)]);
        let chosen = Thresholds { promising: 0.5, promising_squeezed: 0.0, lift: 0.5 };
        let curve = threshold_curve(&grasps, chosen, Phase::Squeezed);
        let figures = |point: &ThresholdPoint| (point.threshold_probability, point.kept, point.recall);
        let third = 1.0 / 3.0;
        assert_eq!(
            curve.iter().map(figures).collect::<Vec<_>>(),
            [(0.3, 0.75, 1.0), (0.5, 1.0, third), (0.7, 1.0, third), (0.8, 1.0, third), (0.9, 1.0, third)]
        );
        // A quarter of the grasps is lifted at 0.9, in random order after 2.5 attempts.
        assert_eq!((curve[0].attempts_per_lift, curve[4].attempts_per_lift), (1.0, 2.5));
        // A drop that costs nothing is worth no attempt, one that costs ten is.
        let costs = |drop_costs: f64| [0, 4].map(|idx: usize| curve[idx].attempts_per_kept(drop_costs));
        assert!(costs(0.0)[0] < costs(0.0)[1] && costs(10.0)[0] > costs(10.0)[1], "{:?} {:?}", costs(0.0), costs(10.0));
        // No threshold of the grasps that are given up before lifts anything.
        assert!(threshold_curve(&grasps, Thresholds { promising: 1.0, ..chosen }, Phase::Squeezed).is_empty());
    }

    #[test]
    fn what_is_expected_is_what_happens_however_few_grasps_an_object_has() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let n_runs = 200;
        // Chances that are beta distributed; with a or b = 1 they are a root of a uniform number.
        for (a, b) in [(1.0, 3.0), (0.4, 1.0)] {
            let chance = |uniform: f64| if a == 1.0 { 1.0 - uniform.powf(1.0 / b) } else { uniform.powf(1.0 / a) };
            let none_lifted = |n: u32| (0..n).map(f64::from).map(|k| (b + k) / (a + b + k)).product::<f64>();
            let (given_up, n_attempts) = (none_lifted(MOST_ATTEMPTS), (0..MOST_ATTEMPTS).map(none_lifted).sum::<f64>());
            let lifted = 1.0 - given_up;
            // Half of the grasps that are no lifts are probed.
            let work = n_attempts + (lifted + 0.5 * (n_attempts - lifted)) * SQUEEZE_COSTS;
            for n_grasps in [2, 5, 20] {
                let (mut of_given_up, mut of_attempts, mut of_work) = (0.0, 0.0, 0.0);
                for _ in 0..n_runs {
                    let mut grasps = Vec::new();
                    for object in 0..480 {
                        let chance = chance(random.random());
                        grasps.extend((0..n_grasps).map(|_| {
                            let is_lifted = random.random::<f64>() < chance;
                            let settled = if is_lifted { 1.0 } else { random.random() };
                            let decided = Some(f64::from(u8::from(is_lifted)));
                            Attempted { object, fold: 0, settled, squeezed: 1.0, decided, stable: true }
                        }));
                    }
                    let with = Thresholds { promising: 0.5, promising_squeezed: 0.0, lift: 0.5 };
                    let expected = expect(&grasps, with, Phase::Squeezed).expect("lifts");
                    of_given_up += expected.given_up / f64::from(n_runs);
                    of_attempts += expected.attempts_per_lift / f64::from(n_runs);
                    of_work += expected.work_per_lift / f64::from(n_runs);
                }
                assert!((of_given_up - given_up).abs() < 0.01, "{n_grasps} grasps: {of_given_up} for {given_up}");
                assert!((of_attempts * lifted / n_attempts - 1.0).abs() < 0.03, "{n_grasps} grasps: {of_attempts}");
                assert!((of_work * lifted / work - 1.0).abs() < 0.03, "{n_grasps} grasps: {of_work}");
            }
        }
    }

    #[test]
    fn a_tight_grasp_that_is_not_promising_is_worth_no_test_lift() {
        let looks = [("a", 0.9, 0.9, true), ("a", 0.9, 0.2, false), ("a", 0.9, 0.8, false), ("a", 0.9, 0.95, true)];
        let mut grasps = grasps(&looks);
        for (grasp, squeezed) in grasps.iter_mut().zip([0.9, 0.3, 0.3, 0.9]) {
            grasp.squeezed = squeezed;
        }
        let policy = Policies::new(&grasps, Phase::TestLifted, [1.0, 1.0]).cheapest(10.0).expect("a policy");
        assert_eq!((policy.thresholds.promising_squeezed, policy.expected.kept), (0.9, 1.0), "{policy:?}");
    }

    #[test]
    fn grasps_that_count_as_stable_are_probed() {
        let grasps =
            grasps(&[("a", 0.9, 0.9, true), ("a", 0.7, 0.1, false), ("b", 0.9, 0.9, true), ("b", 0.6, 0.1, false)]);
        let free = Policies::new(&grasps, Phase::Squeezed, [1.0, 1.0]).cheapest(0.0).expect("a policy");
        assert_eq!(free.thresholds.promising, 0.9, "the others are not worth a probe");
        assert_eq!(
            Policies::new(&grasps, Phase::Squeezed, [0.65, 1.0]).cheapest(0.0).expect("a policy").thresholds.promising,
            0.65
        );
    }

    #[test]
    fn trials_of_a_promise_use_each_grasp_once() {
        // One of 40 grasps is lifted, and dropped: it is among the first 20 in every second order.
        let one = Count { n: 40.0, promising: 1.0, lifted: 1.0, ..Count::default() };
        assert!((one.trials(20).lifted - 0.5).abs() < 1e-12 && (one.trials(20).dropped - 0.5).abs() < 1e-12);
        // With fewer grasps than attempts a lift is certain; of two lifted ones each is the first as often.
        let few = Count { n: 4.0, promising: 4.0, lifted: 2.0, kept: 1.0, ..Count::default() };
        assert_eq!(few.trials(20), ObjectTrials { lifted: 1.0, dropped: 0.5 });
        let none = Count { n: 30.0, ..Count::default() };
        assert_eq!(none.trials(20), ObjectTrials { lifted: 0.0, dropped: 0.0 });
    }

    #[test]
    fn an_objects_own_probabilities_have_no_part_in_its_threshold() {
        // For b alone, no threshold is worth a lift of a's grasps below 0.9; for a alone, 0.3 is. So a is tried with b's
        // threshold and b with a's.
        let grasps = grasps(&[
            ("a", 0.9, 0.9, true),
            ("a", 0.9, 0.3, true),
            ("b", 0.9, 0.95, true),
            ("b", 0.9, 0.9, true),
            ("b", 0.9, 0.3, false),
        ]);
        let policies = Policies::new(&grasps, Phase::Settled, [1.0, 1.0]);
        let found = policies.promise(1000.0).expect("lifts");
        // b with the threshold 0.3: a lift of three is dropped. a with 0.9 or more drops none.
        let dropped = (1.0 / 3.0) / 2.0;
        assert!((found.drops_of_trials.estimate - dropped).abs() < 1e-6, "{found:?}");
        assert_eq!((found.drops_of_lifts.n_objects, found.drops_of_lifts.at_most > 0.9), (2, true), "{found:?}");
    }
}
