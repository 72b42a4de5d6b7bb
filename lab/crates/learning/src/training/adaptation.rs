//! Corrects a model by the labelled grasps of a robot: by the outcomes of its lifts, or for one day of a model that looks at days.
//!
//! Lifts correct the look that decides ([`blindgrasp_stages::own_lifts`]), as in a running graph, and widen the limits of the training
//! range if they hold many of the robot's own grasps. Objects are the unit of a cross-fit: if the correction or the threshold is no better
//! for objects that it was not learned from, the model keeps its own. The labelled grasps of a day correct the log-odds of grasps that
//! are like them ([`Recalibration`]).

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use nalgebra::{DMatrix, DVector};

use super::probes::reading_at;
use super::{Example, Examples, LOOKS, N_FOLDS, TrainingError, counts, folds_by_object, values_at};
use crate::learners::decision_values;
use crate::learners::training_range::learn_training_range;
use crate::promise::{ObjectTrials, promise};
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::Classifier;
use blindgrasp_stages::day::{DayMethod, DayModel, DayStatistics, LabelledGrasp, Recalibration, covariance};
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::out_of_distribution::TrainingRange;
use blindgrasp_stages::own_lifts::{
    Correction, FEWEST_OUTCOMES, Learned, OF_A_ROBOT, OF_AN_UNLIKE_ROBOT, Prior, attempts_per_kept, log_loss,
    log_odds_of, probability,
};
use blindgrasp_stages::training_summary::{OwnLiftsSummary, Promise, RobotLifts};

/// The fewest labelled grasps of a day.
const MIN_LABELLED: usize = 20;
/// From this share of own grasps outside the limits on, the robot is unlike those that the model learned from, and the limits are
/// widened. A few grasps outside are as expected.
const UNLIKE_SHARE: f64 = 0.1;
/// Own grasps without which no limit is widened.
const FEWEST_FOR_LIMITS: usize = 30;

/// The model, corrected by the labelled grasps of recordings: lifts of robots of one hand, or grasps of one day for a model
/// that looks at days. The grasps count as trained on. `robots` names the robot of each recording.
///
/// # Errors
/// Recordings that cannot be used, whose label is the paper's, that the model was trained on, or with too few labelled grasps.
pub fn adapt(hand: &Hand, model: &Model, recordings: &[PathBuf], robots: &[String]) -> Result<Model, TrainingError> {
    adapt_on(hand, model, &Examples::read(hand, recordings, |_, _| {})?, robots)
}

/// Corrects a model by examples. `robots` names the robot of each recording that they are from; it may be empty if there is one.
///
/// # Errors
/// As of [`adapt`].
pub fn adapt_on(hand: &Hand, model: &Model, read: &Examples, robots: &[String]) -> Result<Model, TrainingError> {
    if model.hand.id != hand.id() {
        return refused(format!("the recordings are of the hand '{}', the model of '{}'", hand.name, model.hand.name));
    }
    if read.labels.contains_key(&Label::WrenchSpace) {
        return refused(
            "the recordings have the paper's label, which does not say whether a lifted object stays in the hand: expected \
             outcomes of lifts, of the robot or of simulate --label lift"
                .into(),
        );
    }
    let mut trained_on = model.training.trained_on.clone().unwrap_or_default();
    if let Some(known) = read.examples.iter().find(|example| trained_on.grasps.contains(&example.reading_id)) {
        return refused(format!("the model was trained on grasp {} of these: expected new grasps", known.grasp_id));
    }
    let mut adapted = match &model.day {
        Some(day) => adapt_to_day(model, day, read)?,
        None => adapt_to_lifts(hand, model, read, robots)?,
    };
    let is_changed = Model { training: model.training.clone(), ..adapted.clone() } != *model;
    if is_changed {
        // They were for the probabilities before.
        adapted.training.withdraw_promises();
    }
    let new = read.trained_on();
    trained_on.objects.extend(new.objects);
    trained_on.grasps.extend(new.grasps);
    adapted.training.trained_on = Some(trained_on);
    Ok(adapted)
}

fn refused<T>(message: String) -> Result<T, TrainingError> {
    Err(TrainingError::Data(message))
}

/// A lift that the model judges at the look that decides.
struct JudgedLift<'a> {
    example: &'a Example,
    /// By the model itself.
    log_odds: f64,
}

fn adapt_to_lifts(hand: &Hand, model: &Model, read: &Examples, robots: &[String]) -> Result<Model, TrainingError> {
    let Some((look, classifier)) = deciding_look(model, &read.examples) else {
        return refused("no grasp with an outcome has frames that the model decides by: record whole grasps".into());
    };
    let (lifts, mut taught_nothing) = judged_lifts(look, model, &read.examples);
    for (reason, n) in &read.n_excluded {
        *taught_nothing.entry(reason.clone()).or_default() += n;
    }
    if lifts.len() < FEWEST_OUTCOMES {
        return refused(format!(
            "{} lifts with an outcome that the model can judge when the hand is {}: expected {FEWEST_OUTCOMES} or more (left \
             out: {})",
            lifts.len(),
            look.as_str(),
            counts(&taught_nothing),
        ));
    }
    let examples: Vec<&Example> = lifts.iter().map(|lift| lift.example).collect();
    let n_objects = examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len();
    if n_objects < 2 {
        return refused("all lifts are of one object: expected several, so that some can judge the others".into());
    }
    let folds = folds_by_object(&examples, N_FOLDS.min(n_objects))?;
    let n_grasps = (read.examples.len() + read.n_excluded.values().sum::<usize>()) as f64;
    let mut wider = model.clone();
    let all: Vec<&Example> = read.examples.iter().collect();
    let n_outside = widen(hand, &mut wider, &all)?;
    let is_unlike = n_outside as f64 > UNLIKE_SHARE * all.len() as f64;
    let mut adapted = if is_unlike { wider } else { model.clone() };
    // The place of a threshold among grasps that the model does not know means nothing: there it keeps its probability.
    let (prior, drop_costs) = if is_unlike { (OF_AN_UNLIKE_ROBOT, None) } else { (OF_A_ROBOT, model.drop_costs(look)) };
    let own = Judged { classifier, prior, drop_costs, n_grasps, lifts: &lifts }.learn(&folds);
    let of_look = match look {
        Phase::TestLifted => adapted.test_lifted.as_mut().map(|probe| &mut probe.classifier),
        Phase::Squeezed => adapted.squeezed.as_mut().map(|probe| &mut probe.classifier),
        _ => Some(&mut adapted.classifier),
    };
    if let Some(of_look) = of_look {
        (of_look.calibration, of_look.threshold_probability, of_look.unsure_from_probability) =
            own.learned.apply(classifier);
    }
    let of_all = summed_up(&lifts, &own.is_lifted, |_| true);
    adapted.training.own_lifts = Some(OwnLiftsSummary {
        recordings: read.recordings.clone(),
        look: look.as_str().into(),
        n_lifts: of_all.n_lifts,
        n_kept: of_all.n_kept,
        taught_nothing,
        n_objects,
        correction: own.learned.correction,
        log_loss_before: own.log_losses[0],
        log_loss_after: own.log_losses[1],
        n_lifted: of_all.n_lifted,
        n_outside: if is_unlike { n_outside } else { 0 },
        promise: of_all.promise,
        robots: by_robot(&lifts, &own.is_lifted, robots),
        in_simulation: !read.labels.is_empty(),
    });
    Ok(adapted)
}

/// The last look that lifts and that a grasp has, and its classifier.
fn deciding_look<'a>(model: &'a Model, examples: &[Example]) -> Option<(Phase, &'a Classifier)> {
    for look in LOOKS.into_iter().rev() {
        if let Some(classifier) = model.look(look)
            && classifier.threshold_probability < 1.0
            && examples.iter().any(|example| reading_at(look, example).is_some())
        {
            return Some((look, classifier));
        }
    }
    None
}

/// The grasps that the model judges at a look, and the number of the others by reason. A robot that obeys gives up those that an
/// earlier look calls unstable.
fn judged_lifts<'a>(
    look: Phase,
    model: &Model,
    examples: &'a [Example],
) -> (Vec<JudgedLift<'a>>, BTreeMap<String, usize>) {
    let (mut lifts, mut others) = (Vec::new(), BTreeMap::new());
    for example in examples {
        let mut earlier = LOOKS.into_iter().take_while(|other| *other != look);
        if let Some(earlier) = earlier.find(|earlier| is_unstable(model, *earlier, example)) {
            *others.entry(format!("held when {}", earlier.as_str())).or_default() += 1;
        } else if let Some(log_odds) = log_odds(model, look, example) {
            lifts.push(JudgedLift { example, log_odds });
        } else {
            let what = if reading_at(look, example).is_none() {
                "frame with contact"
            } else {
                "earlier frames that the model needs"
            };
            *others.entry(format!("no {what} when {}", look.as_str())).or_default() += 1;
        }
    }
    (lifts, others)
}

/// The lifts that a look decides, with all that learning from them needs.
struct Judged<'a> {
    classifier: &'a Classifier,
    prior: Prior,
    drop_costs: Option<f64>,
    /// Grasps that the lifts were chosen from.
    n_grasps: f64,
    lifts: &'a [JudgedLift<'a>],
}

/// The correction that follows from the lifts, and its figures for objects that it was not learned from.
struct Own {
    learned: Learned,
    /// The mean log loss of the model and of the corrected model, nats.
    log_losses: [f64; 2],
    /// Whether each of the lifts would be made.
    is_lifted: Vec<bool>,
}

impl Judged<'_> {
    /// Learns a correction and a threshold, and keeps each only if it is better for objects of other folds: by the log loss, and
    /// by the attempts for each kept object.
    fn learn(&self, folds: &[usize]) -> Own {
        let of_model =
            Learned { correction: Correction::default(), threshold_probability: self.classifier.threshold_probability };
        let n_folds = folds.iter().max().map_or(0, |last| last + 1);
        let by_fold: Vec<Learned> = (0..n_folds).map(|fold| self.learned(|idx| folds[idx] != fold)).collect();
        let (before, after) = (self.tried(|_| of_model), self.tried(|idx| by_fold[folds[idx]]));
        let log_losses = [before.log_loss, after.log_loss];
        let learned = self.learned(|_| true);
        let is_worth_it = self.drop_costs.is_none() || after.attempts_per_kept < before.attempts_per_kept;
        let (learned, tried) = match (after.log_loss < before.log_loss, is_worth_it) {
            (true, true) => (learned, after),
            // The same grasps are lifted as before, with other probabilities.
            (true, false) => (self.at_the_same_place(learned), before),
            (false, _) => (of_model, before),
        };
        Own { learned, log_losses, is_lifted: tried.is_lifted }
    }

    /// Learns from those of the lifts that are used.
    fn learned(&self, is_used: impl Fn(usize) -> bool) -> Learned {
        let used: Vec<(f64, bool)> = (self.lifts.iter().enumerate())
            .filter(|(idx, _)| is_used(*idx))
            .map(|(_, lift)| (lift.log_odds, lift.example.stable))
            .collect();
        let n_grasps = self.n_grasps * used.len() as f64 / self.lifts.len() as f64;
        Learned::of(self.classifier, self.prior, used.iter().copied(), n_grasps as u64, self.drop_costs)
    }

    /// The same correction with a threshold that lifts the grasps that the model lifts.
    fn at_the_same_place(&self, learned: Learned) -> Learned {
        let before = self.classifier.threshold_probability;
        let threshold_probability = probability(learned.correction.apply(log_odds_of(before)));
        Learned { threshold_probability, ..learned }
    }

    /// The lifts as each would be judged.
    fn tried(&self, by: impl Fn(usize) -> Learned) -> Tried {
        let log_odds = |idx: usize| by(idx).correction.apply(self.lifts[idx].log_odds);
        let is_lifted = |idx: usize| probability(log_odds(idx)) >= by(idx).threshold_probability;
        let idxs = 0..self.lifts.len();
        let is_lifted: Vec<bool> = idxs.clone().map(is_lifted).collect();
        let n_lifted = is_lifted.iter().filter(|is_lifted| **is_lifted).count() as f64;
        let is_kept = |idx: &usize| is_lifted[*idx] && self.lifts[*idx].example.stable;
        let n_kept = idxs.clone().filter(is_kept).count() as f64;
        let losses = idxs.map(|idx| log_loss(log_odds(idx), self.lifts[idx].example.stable));
        Tried {
            log_loss: losses.sum::<f64>() / self.lifts.len() as f64,
            // A robot that keeps nothing tries for ever.
            attempts_per_kept: if n_kept > 0.0 {
                attempts_per_kept(self.n_grasps / n_lifted, n_kept / n_lifted, self.drop_costs.unwrap_or(0.0))
            } else {
                f64::INFINITY
            },
            is_lifted,
        }
    }
}

struct Tried {
    log_loss: f64,
    attempts_per_kept: f64,
    is_lifted: Vec<bool>,
}

/// Sums up some of the lifts. Objects are the unit of the bounds, whichever robot lifts them.
fn summed_up(lifts: &[JudgedLift], is_lifted: &[bool], is_counted: impl Fn(&Example) -> bool) -> RobotLifts {
    let mut of_objects: BTreeMap<&String, [usize; 4]> = BTreeMap::new();
    for (JudgedLift { example, .. }, is_lifted) in lifts.iter().zip(is_lifted) {
        if is_counted(example) {
            let [n, n_kept, n_lifted, n_dropped] = of_objects.entry(&example.object).or_default();
            *n += 1;
            *n_kept += usize::from(example.stable);
            *n_lifted += usize::from(*is_lifted);
            *n_dropped += usize::from(*is_lifted && !example.stable);
        }
    }
    let mut trials = Vec::new();
    for [n, _, n_lifted, n_dropped] in of_objects.values() {
        let share = |count: &usize| *count as f64 / *n as f64;
        trials.push(ObjectTrials { lifted: share(n_lifted), dropped: share(n_dropped) });
    }
    let [n_lifts, n_kept, n_lifted] = [0, 1, 2].map(|idx| of_objects.values().map(|counts| counts[idx]).sum());
    // Each grasp counts as a trial of its own.
    let promise = promise(&trials).map(|promise| Promise { n_attempts: Some(1), ..promise });
    RobotLifts { n_lifts, n_kept, n_lifted, promise }
}

/// Sums up the lifts of each robot, if there are several.
fn by_robot(lifts: &[JudgedLift], is_lifted: &[bool], robots: &[String]) -> BTreeMap<String, RobotLifts> {
    let mut by_robot = BTreeMap::new();
    for robot in robots {
        let of_robot = summed_up(lifts, is_lifted, |example| robots[example.recording_idx] == *robot);
        by_robot.insert(robot.clone(), of_robot);
    }
    if by_robot.len() > 1 { by_robot } else { BTreeMap::new() }
}

/// Whether the model calls a grasp unstable at a look before the one that decides.
fn is_unstable(model: &Model, look: Phase, example: &Example) -> bool {
    let judged = model.look(look).zip(log_odds(model, look, example));
    judged.is_some_and(|(classifier, log_odds)| probability(log_odds) < classifier.unsure_from_probability)
}

/// The model's log-odds of an example at a look; `None` if it has no feature there.
fn log_odds(model: &Model, look: Phase, example: &Example) -> Option<f64> {
    let classifier = model.look(look)?;
    Some(classifier.log_odds(classifier.predictor.decision_value(&values_at(model, look, example)?).ok()?))
}

/// Widens the limits that own grasps violate, of every look, so that they hold the own grasps. Returns how many grasps a limit
/// held out.
fn widen(hand: &Hand, model: &mut Model, examples: &[&Example]) -> Result<usize, TrainingError> {
    if examples.len() < FEWEST_FOR_LIMITS {
        return Ok(0);
    }
    let n_objects = examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len();
    let folds = folds_by_object(examples, N_FOLDS.min(n_objects))?;
    let Model { features, training_range, squeezed, test_lifted, .. } = model;
    let probes = [(Phase::Squeezed, squeezed), (Phase::TestLifted, test_lifted)];
    let of_probes = probes.into_iter().filter_map(|(look, probe)| Some((look, &mut probe.as_mut()?.training_range)));
    let (mut outside, mut values) = (BTreeSet::new(), Vec::new());
    for (look, range) in std::iter::once((Phase::Settled, training_range)).chain(of_probes) {
        let mut own = Vec::new();
        for (idx, (example, fold)) in examples.iter().zip(&folds).enumerate() {
            // A hand that feels nothing is held for that, and not by a limit.
            if let Some(reading) = reading_at(look, example)
                && features.extract(&reading, &mut values).is_ok()
            {
                own.push((idx, reading, *fold));
            }
        }
        let (readings, folds): (Vec<_>, Vec<_>) = own.iter().map(|(_, reading, fold)| (*reading, *fold)).unzip();
        let violated = own.iter().flat_map(|(idx, FeltReading { joints, contacts, .. }, _)| {
            range.violations(features, joints, contacts).into_iter().map(|violation| (*idx, violation.limits.quantity))
        });
        let (held, quantities): (BTreeSet<usize>, BTreeSet<String>) = violated.unzip();
        outside.extend(held);
        let TrainingRange { limits: own, .. } = learn_training_range(hand, features, &readings, &folds);
        for (limits, own) in
            range.limits.iter_mut().zip(&own).filter(|(limits, _)| quantities.contains(&limits.quantity))
        {
            (limits.lower, limits.upper) = (limits.lower.min(own.lower), limits.upper.max(own.upper));
        }
    }
    Ok(outside.len())
}

/// The model, corrected for the day of the examples.
fn adapt_to_day(model: &Model, day_model: &DayModel, read: &Examples) -> Result<Model, TrainingError> {
    let day = match &read.examples[..] {
        [first, rest @ ..] if first.day != 0 && rest.iter().all(|example| example.day == first.day) => first.day,
        _ => return refused("expected labelled grasps of one day, which each frame says (import --day)".into()),
    };
    let variances = match &day_model.method {
        DayMethod::Baseline(baseline) => baseline.variances.clone(),
        DayMethod::Novelty(days) => days.deviations.iter().map(|deviation| deviation.powi(2)).collect(),
    };
    let DayGrasps { rows, log_odds, stable, statistics } = judged(model, &day_model.method, &read.examples)?;
    let n_stable = stable.iter().filter(|stable| **stable).count();
    if stable.len() < MIN_LABELLED || n_stable == 0 || n_stable == stable.len() {
        return refused(format!(
            "of {} labelled grasps of the day the model can judge {}, {n_stable} of them stable: expected at least \
             {MIN_LABELLED}, some stable and some not (the others are unlike those that it was trained on)",
            read.examples.len(),
            stable.len()
        ));
    }
    let grasps: Vec<(&[f64], f64)> = rows.chunks(model.features.len()).zip(log_odds.iter().copied()).collect();
    let covariances = DMatrix::from_fn(grasps.len(), grasps.len(), |a, b| covariance(grasps[a], grasps[b], &variances));
    let weights = most_probable_weights(&covariances, &log_odds, &stable);
    let labelled = |((values, log_odds), weight): (&(&[f64], f64), &f64)| LabelledGrasp {
        values: values.to_vec(),
        log_odds: *log_odds,
        weight: *weight,
    };
    let grasps = grasps.iter().zip(weights.iter()).map(labelled).collect();
    let mut corrected = model.clone();
    let mut day_model = day_model.clone();
    day_model.recalibration = Some(Recalibration { day, statistics, variances, grasps });
    corrected.day = Some(day_model);
    Ok(corrected)
}

/// The weights of labelled grasps whose corrections, covariances times weights, are the most probable given the labels: Newton's
/// method (Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, section 3.4).
fn most_probable_weights(covariances: &DMatrix<f64>, log_odds: &[f64], stable: &[bool]) -> DVector<f64> {
    let mut weights = DVector::zeros(log_odds.len());
    for round in 0..40 {
        let corrections = covariances * &weights;
        let probability = |idx: usize| probability(log_odds[idx] + corrections[idx]);
        let curvature = |idx: usize| (probability(idx) * (1.0 - probability(idx))).max(1e-4);
        let miss = |idx: usize| f64::from(u8::from(stable[idx])) - probability(idx);
        let aim = DVector::from_fn(log_odds.len(), |idx, _| corrections[idx] + miss(idx) / curvature(idx));
        let mut system = covariances.clone();
        (0..log_odds.len()).for_each(|idx| system[(idx, idx)] += 1.0 / curvature(idx));
        // It is positive definite: a covariance and a positive diagonal.
        let Some(cholesky) = system.cholesky() else { break };
        let next = cholesky.solve(&aim);
        // Half steps do not overshoot at first.
        let next = if round < 12 { (&weights + next) / 2.0 } else { next };
        let change = (&next - &weights).amax();
        weights = next;
        if change < 1e-7 {
            break;
        }
    }
    weights
}

/// The grasps of a day that can be judged.
struct DayGrasps {
    /// Their values, one grasp after the other.
    rows: Vec<f64>,
    log_odds: Vec<f64>,
    stable: Vec<bool>,
    statistics: DayStatistics,
}

/// Judges the grasps of a day. Against a baseline each is judged by all of them: in the graph only later grasps of the day are.
fn judged(model: &Model, method: &DayMethod, examples: &[Example]) -> Result<DayGrasps, TrainingError> {
    let mut statistics = DayStatistics::default();
    let (mut rows, mut stable, mut values) = (Vec::new(), Vec::new(), Vec::new());
    for example in examples {
        // A grasp without a feature is held in the graph too.
        if model.extract(Phase::Settled, &example.reading(), &mut values).is_ok() {
            statistics.add(&values);
            rows.extend_from_slice(&values);
            stable.push(example.stable);
        }
    }
    let mut scaled = rows.clone();
    if matches!(method, DayMethod::Baseline(_)) && !rows.is_empty() {
        statistics.scaling().apply(&mut scaled);
    }
    let decision_values = decision_values(&model.classifier.predictor, &scaled)?;
    let log_odds = decision_values.iter().map(|value| model.classifier.log_odds(*value)).collect();
    Ok(DayGrasps { rows, log_odds, stable, statistics })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::promise::least_bound;

    #[test]
    fn lifts_of_a_fleet_are_summed_up_by_robot_and_together() {
        // Two recordings of one robot with 20 lifts each, and one of another, which drops five of 20 and would not make the last.
        let example = |idx: usize| Example {
            recording_idx: idx / 20,
            stable: idx < 40 || !idx.is_multiple_of(4),
            object: idx.to_string(),
            ..Example::default()
        };
        let examples: Vec<Example> = (0..60).map(example).collect();
        let lifts: Vec<JudgedLift> = examples.iter().map(|example| JudgedLift { example, log_odds: 0.0 }).collect();
        let is_lifted: Vec<bool> = (0..60).map(|idx| idx < 59).collect();
        let robots = |names: [&str; 3]| by_robot(&lifts, &is_lifted, &names.map(String::from));
        let found = robots(["a", "a", "b"]);
        let counts = |of: &RobotLifts| (of.n_lifts, of.n_kept, of.n_lifted);
        assert_eq!((counts(&found["a"]), counts(&found["b"])), ((40, 40, 40), (20, 15, 19)));
        let at_most = |of: &RobotLifts| of.promise.expect("lifts").drops_of_lifts.at_most;
        let fleet = summed_up(&lifts, &is_lifted, |_| true);
        assert_eq!(counts(&fleet), (60, 55, 59));
        assert!((at_most(&found["a"]) - least_bound(40)).abs() < 1e-9);
        assert!(at_most(&found["a"]) < at_most(&fleet) && at_most(&fleet) < at_most(&found["b"]), "{found:?}");
        assert!(robots(["a", "a", "a"]).is_empty(), "one robot");
    }
}
