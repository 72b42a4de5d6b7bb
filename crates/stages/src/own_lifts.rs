//! Learns from the lifts of the robot that a model runs on.
//!
//! A simulator never is the user's hand. The outcomes of a robot's own lifts correct the look that decided them:
//!
//! * Its log-odds l become a·l + b, with the slope a and the offset b that are most probable given the outcomes and a normal
//!   prior ([`Correction::fit`]), so that its probabilities are this robot's.
//! * Its threshold is chosen again for the price of a drop that the model was trained for ([`threshold`]): where too many lifts
//!   drop, only surer grasps are lifted, if that is worth the attempts.
//!
//! Trees that learn from the same outcomes were tried and were worse with up to 600 of them (benches/archive.md).
//!
//! Pure: no clock, no input or output. [`OwnLifts`] is the state; the classifier of a graph and `blindgrasp model adapt` learn
//! with the same functions.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::classifier::Classifier;
use crate::classifier::calibration::{PlattCalibration, positive_probability};
use crate::shift_test::{Numbers, ShiftTest};
use blindgrasp_messages::Phase;

/// Outcomes that are remembered; older ones are forgotten.
pub const MOST_OUTCOMES: usize = 500;

/// The fewest outcomes that correct a model: fewer say less than the prior.
pub const FEWEST_OUTCOMES: usize = 20;

/// The use that a classifier makes of the outcomes of its robot's lifts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Adapt {
    /// It keeps them, and judges as the model does.
    #[default]
    Off,
    /// It keeps them, and corrects its probabilities after each one.
    On,
    /// It judges with the correction that it has, and keeps no more outcomes.
    Frozen,
}

/// A correction of log-odds l: a·l + b.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Correction {
    pub a: f64,
    pub b: f64,
}

/// Standard deviations of a normal prior of the slope about 1 and of the offset about 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    pub slope_deviation: f64,
    pub offset_deviation: f64,
}

/// The prior for one robot. It was chosen by the log loss on lifts of training objects and on one robot in MuJoCo
/// (benches/archive.md).
pub const OF_A_ROBOT: Prior = Prior { slope_deviation: 0.1, offset_deviation: 0.5 };

/// The prior for a robot of whose grasps many are unlike those of the training: the model's probabilities say little of them.
pub const OF_AN_UNLIKE_ROBOT: Prior = Prior { slope_deviation: 0.3, offset_deviation: 1.5 };

impl Default for Correction {
    fn default() -> Self {
        Correction { a: 1.0, b: 0.0 }
    }
}

impl Correction {
    /// The most probable correction of log-odds given which grasps were stable: Newton's method on a convex function of two
    /// numbers.
    pub fn fit(prior: Prior, grasps: impl Iterator<Item = (f64, bool)> + Clone) -> Correction {
        let (slope_weight, offset_weight) = (prior.slope_deviation.powi(-2), prior.offset_deviation.powi(-2));
        let cost = |a: f64, b: f64| {
            let of_prior = slope_weight * (a - 1.0).powi(2) + offset_weight * b.powi(2);
            grasps.clone().map(|(l, stable)| log_loss(a * l + b, stable)).sum::<f64>() + 0.5 * of_prior
        };
        let (mut a, mut b) = (1.0, 0.0);
        for _ in 0..100 {
            let (mut ga, mut gb) = (slope_weight * (a - 1.0), offset_weight * b);
            let (mut haa, mut hab, mut hbb) = (slope_weight, 0.0, offset_weight);
            for (l, stable) in grasps.clone() {
                let probability = probability(a * l + b);
                let (miss, weight) = (probability - f64::from(u8::from(stable)), probability * (1.0 - probability));
                (ga, gb) = (ga + miss * l, gb + miss);
                (haa, hab, hbb) = (haa + weight * l * l, hab + weight * l, hbb + weight);
            }
            let determinant = haa * hbb - hab * hab;
            let (da, db) = ((hbb * ga - hab * gb) / determinant, (haa * gb - hab * ga) / determinant);
            // Halved until the cost falls.
            let mut step = 1.0;
            while step > 1e-6 && cost(a - step * da, b - step * db) > cost(a, b) {
                step /= 2.0;
            }
            (a, b) = (a - step * da, b - step * db);
            if (step * da).abs() + (step * db).abs() < 1e-10 {
                break;
            }
        }
        // A slope at or below 0 would turn the ranking round.
        Correction { a: a.max(0.05), b }
    }

    pub fn apply(&self, log_odds: f64) -> f64 {
        self.a * log_odds + self.b
    }

    /// The calibration with this correction.
    #[must_use]
    pub fn of(&self, calibration: &PlattCalibration) -> PlattCalibration {
        PlattCalibration { a: self.a * calibration.a, b: self.a * calibration.b - self.b }
    }
}

/// The probability of log-odds.
pub fn probability(log_odds: f64) -> f64 {
    positive_probability(-log_odds)
}

/// The log-odds of a probability.
pub fn log_odds_of(probability: f64) -> f64 {
    libm::log(probability / (1.0 - probability))
}

/// The log loss of log-odds, nats.
pub fn log_loss(log_odds: f64, stable: bool) -> f64 {
    let z = if stable { log_odds } else { -log_odds };
    libm::log1p(libm::exp(-z.abs())) + (-z).max(0.0)
}

/// The costs of tightening the hand and of a test lift, in attempts. They take 0.4 and 0.8 s, where an arm opens its hand, goes
/// back and grasps again in some ten.
pub const SQUEEZE_COSTS: f64 = 0.04;
pub const TEST_LIFT_COSTS: f64 = 0.08;
/// Fewer lifts than this say nothing of the share that is kept.
const FEWEST_LIFTS: usize = 5;
/// The part by which another threshold must cost less than the present one.
const WORTH_A_CHANGE: f64 = 0.02;

/// Attempts for each kept object, if a drop costs as much as `drop_costs` attempts. `kept` is the share of the lifts that keep their
/// object.
pub fn attempts_per_kept(attempts_per_lift: f64, kept: f64, drop_costs: f64) -> f64 {
    (attempts_per_lift + drop_costs * (1.0 - kept)) / kept
}

/// The log-odds from which a grasp is lifted at the least cost. `log_odds` are those of grasps with an outcome, out of
/// `n_grasps`; their probabilities say how many are kept. It is `present` unless a higher one costs clearly less: outcomes of a few
/// grasps are no reason to lift what was held before.
pub fn threshold(log_odds: &[f64], n_grasps: u64, present: f64, drop_costs: f64) -> f64 {
    let mut lifted: Vec<f64> = log_odds.iter().copied().filter(|log_odds| *log_odds >= present).collect();
    lifted.sort_by(|a, b| b.total_cmp(a));
    let n_grasps = (n_grasps as f64).max(lifted.len() as f64);
    let mut kept = 0.0;
    let mut costs = Vec::with_capacity(lifted.len());
    for (idx, log_odds) in lifted.iter().enumerate() {
        kept += probability(*log_odds);
        let n = (idx + 1) as f64;
        costs.push((attempts_per_kept(n_grasps / n, kept / n, drop_costs), *log_odds));
    }
    let cost_of_present = costs.last().map_or(0.0, |(cost, _)| *cost);
    let least = costs.into_iter().skip(FEWEST_LIFTS - 1).min_by(|a, b| a.0.total_cmp(&b.0));
    least.filter(|(cost, _)| *cost < (1.0 - WORTH_A_CHANGE) * cost_of_present).map_or(present, |(_, log_odds)| log_odds)
}

/// The correction and the threshold of a look that follow from own lifts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    pub correction: Correction,
    /// A grasp is lifted from this corrected probability on.
    pub threshold_probability: f64,
}

impl Learned {
    /// Learns from outcomes of lifts that a look decided, out of `n_grasps`. Each has the model's own log-odds and says whether the
    /// object was kept. Without a price of a drop, the threshold keeps its probability.
    pub fn of(
        classifier: &Classifier,
        prior: Prior,
        outcomes: impl Iterator<Item = (f64, bool)> + Clone,
        n_grasps: u64,
        drop_costs: Option<f64>,
    ) -> Learned {
        let correction = Correction::fit(prior, outcomes.clone());
        let before = classifier.threshold_probability;
        let threshold_probability = match drop_costs {
            Some(drop_costs) if before < 1.0 => {
                let log_odds: Vec<f64> = outcomes.map(|(log_odds, _)| correction.apply(log_odds)).collect();
                let present = correction.apply(log_odds_of(before));
                let chosen = threshold(&log_odds, n_grasps, present, drop_costs);
                probability(chosen)
            }
            _ => before,
        };
        Learned { correction, threshold_probability }
    }

    /// The classifier's calibration and thresholds for this robot.
    pub fn apply(&self, classifier: &Classifier) -> (PlattCalibration, f64, f64) {
        let before = classifier.unsure_from_probability;
        let unsure_from = if before >= classifier.threshold_probability {
            self.threshold_probability
        } else if self.correction == Correction::default() {
            before.min(self.threshold_probability)
        } else {
            probability(self.correction.apply(log_odds_of(before))).min(self.threshold_probability)
        };
        (self.correction.of(&classifier.calibration), self.threshold_probability, unsure_from)
    }
}

/// The outcome of a lift, and the log-odds of the look that decided it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Outcome {
    look: Phase,
    log_odds: f32,
    is_kept: bool,
    /// Grasps that were looked at since the outcome before it, this one included.
    n_grasps: u32,
}

/// The outcomes of a robot's lifts, and the corrections that follow from them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OwnLifts {
    /// The grasp whose looks come.
    grasp: Option<LookedAt>,
    shift: ShiftTest,
    outcomes: VecDeque<Outcome>,
    learned: Vec<(Phase, Learned)>,
    /// Grasps that were looked at since the last outcome.
    n_grasps: u32,
    n_kept: u64,
    n_dropped: u64,
    n_changes: u64,
    /// The grasp of the last outcome, if its object was kept, and whether that outcome is among `outcomes`.
    kept: Option<(u64, bool)>,
}

/// A grasp that is looked at.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct LookedAt {
    grasp_id: u64,
    /// The last look, and the log-odds of its first frame.
    look: Phase,
    log_odds: f64,
    /// Whether the last frame was called unstable.
    is_unstable: bool,
    /// Whether the last frame before a later look was called unstable: a robot that obeys does not go on.
    is_given_up: bool,
    settled: Option<Numbers>,
}

/// A frame of a look at a grasp.
pub(crate) struct Looked {
    pub(crate) grasp_id: u64,
    pub(crate) look: Phase,
    /// By the model itself.
    pub(crate) log_odds: f64,
    pub(crate) is_unstable: bool,
    /// Of a settled hand, the numbers that the test of a change compares.
    pub(crate) settled: Option<Numbers>,
}

impl OwnLifts {
    /// Lifts that kept their object, of all since the readings have changed.
    pub fn n_kept(&self) -> u64 {
        self.n_kept
    }

    pub fn n_dropped(&self) -> u64 {
        self.n_dropped
    }

    /// How often the readings have changed, and the outcomes before that were forgotten.
    pub fn n_changes(&self) -> u64 {
        self.n_changes
    }

    /// The correction of a look; `None` until [`FEWEST_OUTCOMES`] lifts were decided by it.
    pub fn learned(&self, look: Phase) -> Option<Learned> {
        self.learned.iter().find(|(phase, _)| *phase == look).map(|(_, found)| *found)
    }

    /// Takes a frame of a look. The first frame of a grasp's last look counts.
    pub(crate) fn look(&mut self, frame: Looked) {
        let Looked { grasp_id, look, log_odds, is_unstable, settled } = frame;
        match &mut self.grasp {
            Some(known) if known.grasp_id == grasp_id => {
                if known.look != look {
                    known.is_given_up |= known.is_unstable;
                    (known.look, known.log_odds) = (look, log_odds);
                }
                (known.is_unstable, known.settled) = (is_unstable, known.settled.or(settled));
            }
            _ => {
                self.n_grasps += 1;
                self.grasp = Some(LookedAt { grasp_id, look, log_odds, is_unstable, is_given_up: false, settled });
            }
        }
    }

    /// Takes the outcome of a lift. If it looks for changes, it says whether the readings have changed; the outcomes before that
    /// are forgotten then. The outcome of another grasp does not count, nor does a second outcome of the same lift, unless an object
    /// that was kept is dropped after that: the drop takes its place. `classifier` gives
    /// the classifier of a look, and the price of a drop for which its threshold was chosen.
    pub(crate) fn lifted<'a>(
        &mut self,
        grasp_id: u64,
        is_kept: bool,
        looks_for_changes: bool,
        classifier: impl Fn(Phase) -> Option<(&'a Classifier, Option<f64>)>,
    ) -> bool {
        let Some(LookedAt { look, log_odds, is_given_up, settled, .. }) =
            self.grasp.take_if(|known| known.grasp_id == grasp_id)
        else {
            if let Some((_, has_outcome)) = self.kept.take_if(|(kept, _)| !is_kept && *kept == grasp_id) {
                (self.n_kept, self.n_dropped) = (self.n_kept - 1, self.n_dropped + 1);
                if has_outcome && let Some(last) = self.outcomes.back_mut() {
                    last.is_kept = false;
                    let look = last.look;
                    self.learn(look, classifier);
                }
            }
            return false;
        };
        let has_changed = looks_for_changes && settled.is_some_and(|settled| self.shift.observe(settled));
        if has_changed {
            (self.outcomes, self.learned, self.n_grasps) = (VecDeque::new(), Vec::new(), 1);
            (self.n_kept, self.n_dropped, self.n_changes) = (0, 0, self.n_changes + 1);
        }
        *(if is_kept { &mut self.n_kept } else { &mut self.n_dropped }) += 1;
        self.kept = is_kept.then_some((grasp_id, !is_given_up));
        // The gate would not have lifted it, whatever the last look says.
        if is_given_up {
            return has_changed;
        }
        if self.outcomes.len() >= MOST_OUTCOMES {
            self.outcomes.pop_front();
        }
        let n_grasps = std::mem::take(&mut self.n_grasps);
        self.outcomes.push_back(Outcome { look, log_odds: log_odds as f32, is_kept, n_grasps });
        self.learn(look, classifier);
        has_changed
    }

    /// Learns from the outcomes of a look, once there are enough.
    fn learn<'a>(&mut self, look: Phase, classifier: impl Fn(Phase) -> Option<(&'a Classifier, Option<f64>)>) {
        let of_look = || self.outcomes.iter().filter(|outcome| outcome.look == look);
        if of_look().count() >= FEWEST_OUTCOMES
            && let Some((classifier, drop_costs)) = classifier(look)
        {
            let n_grasps = self.outcomes.iter().map(|outcome| u64::from(outcome.n_grasps)).sum();
            let outcomes = of_look().map(|outcome| (f64::from(outcome.log_odds), outcome.is_kept));
            let learned = Learned::of(classifier, OF_A_ROBOT, outcomes, n_grasps, drop_costs);
            self.learned.retain(|(known, _)| *known != look);
            self.learned.push((look, learned));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classifier::Predictor;
    use crate::classifier::boosting::BoostedTrees;

    const WIDE: Prior = Prior { slope_deviation: 0.3, offset_deviation: 1.5 };

    /// Grasps that are stable with the probability of log-odds l + offset.
    fn grasps(n: u32, offset: f64) -> Vec<(f64, bool)> {
        let grasp = |idx: u32| {
            let l = 8.0 * (f64::from(idx % 400) / 400.0 - 0.5);
            let probability = 1.0 / (1.0 + libm::exp(-(l + offset)));
            // The digits of the golden ratio spread evenly.
            (l, (f64::from(idx) * 0.618_033_988_749_895).fract() < probability)
        };
        (0..n).map(grasp).collect()
    }

    #[test]
    fn a_shift_is_shifted_back() {
        let shifted = grasps(4000, -2.0);
        let Correction { a, b } = Correction::fit(WIDE, shifted.iter().copied());
        assert!((a - 1.0).abs() < 0.1 && (b + 2.0).abs() < 0.2, "{a} {b}");
        // Without grasps, and with those that the model expects, nothing changes.
        assert_eq!(Correction::fit(WIDE, std::iter::empty()), Correction::default());
        let Correction { a, b } = Correction::fit(WIDE, grasps(4000, 0.0).into_iter());
        assert!((a - 1.0).abs() < 0.1 && b.abs() < 0.1, "{a} {b}");
    }

    #[test]
    fn no_outcomes_turn_the_ranking_round() {
        let against = (0..400).map(|idx| (f64::from(idx) / 50.0 - 4.0, idx < 200));
        assert!(Correction::fit(WIDE, against).a > 0.0);
    }

    fn classifier(threshold_probability: f64) -> Classifier {
        let trees = BoostedTrees { n_features: 1, base: 0.0, trees: vec![] };
        let calibration = PlattCalibration { a: -1.0, b: 0.0 };
        let predictor = Predictor::Boosting(trees);
        Classifier { predictor, calibration, threshold_probability, unsure_from_probability: 0.3 }
    }

    fn looked(grasp_id: u64, look: Phase, log_odds: f64) -> Looked {
        Looked { grasp_id, look, log_odds, is_unstable: false, settled: None }
    }

    #[test]
    fn drops_make_the_look_that_decided_more_cautious() {
        let mut lifts = OwnLifts::default();
        let own = classifier(0.9);
        for grasp_id in 0..40 {
            lifts.look(looked(grasp_id, Phase::Settled, 1.0));
            lifts.look(looked(grasp_id, Phase::TestLifted, 3.0));
            lifts.look(looked(grasp_id, Phase::TestLifted, -9.0));
            lifts.lifted(grasp_id + 1, false, true, |_| Some((&own, None)));
            lifts.lifted(grasp_id, grasp_id % 4 != 0, true, |_| Some((&own, None)));
            lifts.lifted(grasp_id, true, true, |_| Some((&own, None)));
            let has_learned = lifts.learned(Phase::TestLifted).is_some();
            assert_eq!(has_learned, grasp_id + 1 >= FEWEST_OUTCOMES as u64);
        }
        assert_eq!((lifts.n_kept(), lifts.n_dropped()), (30, 10));
        assert_eq!(lifts.learned(Phase::Settled), None);
        // An object that was kept is dropped after that, which counts once and is learned from.
        let mut later = lifts.clone();
        (0..2).for_each(|_| assert!(!later.lifted(39, false, true, |_| Some((&own, None)))));
        assert_eq!((later.n_kept(), later.n_dropped()), (29, 11));
        let offset = |of: &OwnLifts| of.learned(Phase::TestLifted).map(|learned| learned.correction.b);
        assert!(offset(&later) < offset(&lifts));
        let learned = lifts.learned(Phase::TestLifted).expect("learned");
        let probability = 1.0 / (1.0 + libm::exp(-learned.correction.apply(3.0)));
        assert!((0.75..0.9).contains(&probability), "{probability}");
        // Without a price of a drop the threshold stays at its probability.
        assert_eq!(learned.threshold_probability, 0.9);
        let (calibration, threshold, unsure_from) = learned.apply(&own);
        assert!((calibration.probability(3.0) - probability).abs() < 1e-12);
        assert!(threshold == 0.9 && unsure_from < 0.3);
    }

    #[test]
    fn a_grasp_that_was_given_up_teaches_nothing() {
        let mut lifts = OwnLifts::default();
        for grasp_id in 0..40 {
            lifts.look(Looked { is_unstable: true, ..looked(grasp_id, Phase::Settled, -2.0) });
            lifts.look(looked(grasp_id, Phase::TestLifted, 3.0));
            lifts.lifted(grasp_id, false, true, |_| None);
        }
        assert_eq!((lifts.n_dropped(), lifts.outcomes.len()), (40, 0));
    }

    #[test]
    fn the_threshold_rises_where_surer_grasps_are_worth_the_attempts() {
        // Of 100 grasps, 20 are kept with a probability of 0.99 and 20 with 0.6.
        let log_odds = |probability: f64| libm::log(probability / (1.0_f64 - probability));
        let grasps: Vec<f64> = (0..40).map(|idx| log_odds(if idx < 20 { 0.99 } else { 0.6 })).collect();
        let choose = |present, drop_costs| threshold(&grasps, 100, present, drop_costs);
        assert_eq!(choose(0.0, 300.0), log_odds(0.99));
        assert_eq!(choose(0.0, 0.0), 0.0, "a drop costs nothing: it stays");
        assert_eq!(choose(log_odds(0.9), 0.0), log_odds(0.9), "it never falls");
        // Where all look alike, and with a few grasps, it stays.
        assert_eq!(threshold(&[2.0; 30], 100, 1.0, 300.0), 1.0);
        assert_eq!(threshold(&grasps[..4], 100, 0.0, 300.0), 0.0);
    }

    #[test]
    fn old_outcomes_are_forgotten() {
        let mut lifts = OwnLifts::default();
        let own = classifier(0.9);
        for grasp_id in 0..2 * MOST_OUTCOMES as u64 {
            lifts.look(looked(grasp_id, Phase::TestLifted, 2.0));
            lifts.lifted(grasp_id, grasp_id >= MOST_OUTCOMES as u64, true, |_| Some((&own, Some(60.0))));
        }
        assert_eq!((lifts.outcomes.len(), lifts.n_kept()), (MOST_OUTCOMES, MOST_OUTCOMES as u64));
        let learned = lifts.learned(Phase::TestLifted).expect("learned");
        assert!(learned.correction.b > 0.0, "all that are remembered were kept");
    }

    #[test]
    fn another_skin_begins_anew() {
        let mut lifts = OwnLifts::default();
        let has_changed: Vec<bool> = (0..100)
            .map(|grasp_id| {
                let load = if grasp_id < 80 { 0.0 } else { 4.0 } + (grasp_id % 7) as f32 / 7.0;
                lifts.look(Looked { settled: Some([load, 1.0, load]), ..looked(grasp_id, Phase::Settled, 2.0) });
                lifts.lifted(grasp_id, true, true, |_| None)
            })
            .collect();
        let noticed = has_changed.iter().position(|changed| *changed).expect("noticed");
        assert!((80..100).contains(&noticed), "{noticed}");
        assert_eq!((lifts.n_changes(), lifts.n_kept()), (1, 100 - noticed as u64));
    }
}
