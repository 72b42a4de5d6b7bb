//! Trains a model from recordings: examples, features, learner, calibration, thresholds.
//!
//! Each grasp counts once, by its first settled frame. Grasps that no cell feels have no feature and are left out. The
//! cross-validated figures come from folds whose dictionary, scaling and learner have seen no object of the fold. The
//! calibration is fitted on the same out-of-fold decision values.

mod adaptation;
mod approach;
mod day;
mod examples;
mod probes;
mod thresholds;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

pub use adaptation::{adapt, adapt_on};
pub use blindgrasp_stages::recipe::{BlendParams, Learner, Recipe};
pub use blindgrasp_stages::training_summary::{PolicySummary, TrainingSummary};
pub use examples::{Example, Examples, Signals};
pub(crate) use probes::{Attempted, LOOKS, Thresholds, reading_at, threshold_curve, values_at};
pub use thresholds::Aim;

use crate::evaluation::reliability::{N_RELIABILITY_BINS, reliability};
use crate::evaluation::split::Split;
use crate::file_name;
use crate::learners::booster::train_boosted;
use crate::learners::decision_values;
use crate::learners::k_means::{DictionaryError, KMeansParams, learn_dictionary};
use crate::learners::platt::{PlattError, fit_platt};
use crate::learners::svm::train_svm;
use crate::learners::training_range::{learn_training_range, widened_for_other_days};
use blindgrasp_grasps::dataset::DatasetError;
use blindgrasp_messages::{Fault, Phase};
use blindgrasp_stages::classifier::boosting::{BoostedTrees, BoostingError, BoostingParams};
use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::svm::SvmError;
use blindgrasp_stages::classifier::{Blend, Classifier, Predictor};
use blindgrasp_stages::encoder::{FeatureExtractor, FeltReading, Scaling};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::{FORMAT, Model, ModelHand};
use probes::LearnedProbes;
use thresholds::choose_thresholds;

/// Folds, grouped by object, for calibration and cross-validated figures.
const N_FOLDS: usize = 5;

/// A grasp counts as stable from this probability on, unless thresholds are chosen for trials.
const THRESHOLD_PROBABILITY: f64 = 0.5;

/// How a model is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingOptions {
    pub recipe: Recipe,
    /// The aim of the thresholds of all stages; without one, they are a probability of 0.5.
    pub aim: Option<Aim>,
    /// Seeds K-means and boosting.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions { recipe: Recipe::default(), aim: None, seed: 1 }
    }
}

/// Why a model could not be trained.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error("the dictionary")]
    Dictionary(#[from] DictionaryError),
    #[error("the SVM")]
    Svm(#[from] SvmError),
    #[error(transparent)]
    Boosting(#[from] BoostingError),
    #[error("the calibration")]
    Calibration(#[from] PlattError),
    /// No look keeps the bound of drops that was asked for.
    #[error("{why}")]
    Promise {
        why: String,
        /// The least bound that a look has; 1 if none has one.
        at_most: f64,
    },
    /// Recordings or options that cannot be trained with.
    #[error("{0}")]
    Data(String),
}

impl TrainingError {
    /// The share of drops that more lenient options could promise.
    pub fn best_bound(&self) -> Option<f64> {
        match self {
            TrainingError::Promise { at_most, .. } if *at_most < 1.0 => Some(*at_most),
            _ => None,
        }
    }
}

/// The result of a recipe before calibration.
#[derive(Debug, Clone)]
pub struct Fitted {
    pub features: FeatureExtractor,
    pub predictor: Predictor,
    /// K-means' inertia, square metres.
    pub inertia: f64,
    /// Solver iterations of the SVM, or the number of trees.
    pub n_iterations: usize,
    /// Whether the SVM's solver reached its tolerance.
    pub converged: bool,
    /// With a baseline of the day, the variance of each value within a day.
    pub(crate) day_variances: Vec<f64>,
}

/// Trains a model on examples. `recordings` names the files that they are from; it is empty for examples out of memory
/// ([`Examples::of_grasps`]), which have the labels that they came with. `progress` gets a description of each step.
///
/// # Errors
/// Examples of one class only, of fewer objects than folds, or with too few contacts.
pub fn train(
    hand: &Hand,
    read: &Examples,
    recordings: &[PathBuf],
    options: &TrainingOptions,
    progress: impl FnMut(&str),
) -> Result<Model, TrainingError> {
    train_checked(hand, read, recordings, options, progress).map_err(|error| with_unfelt_share(error, read))
}

/// Adds the share of grasps that no cell feels to a lack of grasps, where that may be its cause.
fn with_unfelt_share(error: TrainingError, read: &Examples) -> TrainingError {
    let with_share = |why: String| told_with_share(why, read);
    match error {
        TrainingError::Data(why) => TrainingError::Data(with_share(why)),
        TrainingError::Promise { why, at_most } => TrainingError::Promise { why: with_share(why), at_most },
        other => other,
    }
}

fn told_with_share(why: String, read: &Examples) -> String {
    let n_unfelt = read.n_excluded.get(Fault::NoContact.as_str()).copied().unwrap_or(0);
    let n_grasps = read.grasps.len();
    if 4 * n_unfelt <= n_grasps {
        return why;
    }
    format!(
        "{why}; no cell feels {n_unfelt} of the {n_grasps} grasps, and they teach nothing: lay cells where the hand touches objects \
         (blindgrasp new hand says how many grasps they feel)"
    )
}

fn train_checked(
    hand: &Hand,
    read: &Examples,
    recordings: &[PathBuf],
    options: &TrainingOptions,
    mut progress: impl FnMut(&str),
) -> Result<Model, TrainingError> {
    let recipe = &options.recipe;
    check_examples(read, recordings)?;
    let examples: Vec<&Example> = read.examples.iter().collect();
    let folds = folds_by_object(&examples, N_FOLDS)?;
    let judged = judge_out_of_fold(hand, &examples, &folds, options, &mut progress)?;
    let calibration = calibrate(&judged.examples, &judged.decision_values)?;
    progress("training on all grasps");
    let fitted = fit(hand, recipe, &examples, options.seed)?;
    let mut training_range = learn_training_range(hand, &fitted.features, &readings(&examples), &folds);
    if recipe.day_baseline {
        training_range = widened_for_other_days(training_range, &fitted.features);
    }
    let validated = CrossValidated::of(&judged, &calibration)?;
    let day = day::learn(recipe, &fitted, &examples, options.seed)?;
    if day.is_none() && examples.iter().any(|example| example.day != 0) {
        progress(
            "not learned: whether a day is like those of the training; every recording must say its days, with several objects each",
        );
    }
    let mut training = summary(read, recordings, options, &fitted, &validated);
    let mut classifier = Classifier {
        predictor: fitted.predictor,
        calibration,
        threshold_probability: THRESHOLD_PROBABILITY,
        unsure_from_probability: THRESHOLD_PROBABILITY,
    };
    let mut probes = learn_probes(hand, &fitted.features, &examples, &folds, options, &mut progress)?;
    if let Some(aim) = options.aim {
        progress("choosing thresholds for trials");
        let of_lifts = !read.labels.contains_key(&Label::WrenchSpace);
        let promises = of_lifts && !recipe.day_baseline;
        let n_grasps = read.grasps.len();
        training.policies =
            choose_thresholds(aim, promises, n_grasps, &judged, &mut classifier, &mut probes, &mut progress)?;
    }
    Ok(Model {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        features: fitted.features,
        classifier,
        training_range,
        squeezed: probes.squeezed.map(|learned| learned.probe),
        test_lifted: probes.test_lifted.map(|learned| learned.probe),
        day,
        approach: approach::learn(hand, &examples, &folds, options.seed)?,
        training,
        checksum: String::new(),
    })
}

/// Judges the examples by machines that have not seen their fold.
fn judge_out_of_fold<'a>(
    hand: &Hand,
    examples: &[&'a Example],
    folds: &[usize],
    options: &TrainingOptions,
    progress: &mut impl FnMut(&str),
) -> Result<OutOfFold<'a>, TrainingError> {
    let TrainingOptions { recipe, seed, .. } = options;
    let cross_validating = |fold: usize| progress(&format!("cross-validating, fold {} of {N_FOLDS}", fold + 1));
    if recipe.day_baseline {
        return day::cross_validate(hand, recipe, examples, folds, *seed, cross_validating);
    }
    let decision_values = cross_validate(hand, recipe, examples, folds, *seed, cross_validating)?;
    Ok(OutOfFold { examples: examples.to_vec(), decision_values, folds: folds.to_vec() })
}

/// Learns to judge the frames after each probe, where examples and recipe let it.
fn learn_probes(
    hand: &Hand,
    features: &FeatureExtractor,
    examples: &[&Example],
    folds: &[usize],
    options: &TrainingOptions,
    progress: &mut impl FnMut(&str),
) -> Result<LearnedProbes, TrainingError> {
    let mut learned = LearnedProbes::default();
    // Frames after a probe have no baseline.
    if options.recipe.day_baseline {
        return Ok(learned);
    }
    for (phase, name, probe) in [
        (Phase::Squeezed, "squeeze", &mut learned.squeezed),
        (Phase::TestLifted, "test lift", &mut learned.test_lifted),
    ] {
        let n_without = probes::n_without(phase, examples);
        // Recordings without this probe have nothing to learn from.
        if n_without == examples.len() {
            continue;
        }
        progress(&format!("learning the decision after the {name}"));
        if n_without > 0 {
            progress(&format!("not learned: {n_without} of {} grasps have no such frames", examples.len()));
        } else if let Learner::Boosting(_) = options.recipe.learner {
            *probe = probes::learn(hand, &options.recipe, features, phase, examples, folds, options.seed)?;
            match probe {
                // A policy sets its threshold later; until then it never lifts.
                Some(_) if options.aim.is_some() => {}
                Some(probe) => probe.set_threshold(THRESHOLD_PROBABILITY),
                None => {
                    progress(&format!("not learned: on new objects, frames after the {name} do no better than a guess"))
                }
            }
        }
    }
    if learned.squeezed.is_none() && learned.test_lifted.take().is_some() {
        progress("not learned: a test lift follows a squeeze, and the decision after that was not learned");
    }
    Ok(learned)
}

/// The record of a training, before policies are chosen.
fn summary(
    read: &Examples,
    recordings: &[PathBuf],
    options: &TrainingOptions,
    fitted: &Fitted,
    validated: &CrossValidated,
) -> TrainingSummary {
    let examples = &read.examples;
    TrainingSummary {
        policies: Vec::new(),
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
        made_by: read.made_by.clone(),
        labels: if read.labels.contains_key(&Label::Lift) { read.labels.clone() } else { BTreeMap::new() },
        recipe: options.recipe.clone(),
        frictions: Vec::new(),
        n_grasps: examples.len(),
        n_stable: examples.iter().filter(|example| example.stable).count(),
        n_objects: examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len(),
        n_contacts: examples.iter().map(|example| example.contacts.len()).sum(),
        n_excluded: read.n_excluded.clone(),
        inertia: fitted.inertia,
        n_iterations: fitted.n_iterations,
        converged: fitted.converged,
        n_folds: N_FOLDS,
        cross_validated_accuracy: validated.accuracy,
        cross_validated_false_positive_share: validated.false_positive_share,
        cross_validated_brier: validated.brier,
        cross_validated_ece: validated.ece,
        seed: options.seed,
        version: env!("CARGO_PKG_VERSION").into(),
        trained_on: Some(read.trained_on()),
        own_lifts: None,
    }
}

/// Examples that were judged by a machine that had not seen their fold: each with its decision value and its fold.
#[derive(Debug, Default)]
struct OutOfFold<'a> {
    examples: Vec<&'a Example>,
    decision_values: Vec<f64>,
    folds: Vec<usize>,
}

/// The figures of the cross-validation.
struct CrossValidated {
    accuracy: f64,
    false_positive_share: f64,
    brier: f64,
    ece: f64,
}

impl CrossValidated {
    fn of(judged: &OutOfFold<'_>, calibration: &PlattCalibration) -> Result<CrossValidated, TrainingError> {
        let probabilities = out_of_fold_probabilities(judged)?;
        let outcomes = labels(&judged.examples);
        let reliability = reliability(&probabilities, &outcomes, N_RELIABILITY_BINS);
        check_skill(calibration, &outcomes, reliability.brier)?;
        let (mut n_right, mut n_false_positives) = (0, 0);
        for (value, stable) in judged.decision_values.iter().zip(&outcomes) {
            let called_stable = calibration.probability(*value) >= THRESHOLD_PROBABILITY;
            n_right += usize::from(called_stable == *stable);
            n_false_positives += usize::from(called_stable && !stable);
        }
        Ok(CrossValidated {
            accuracy: n_right as f64 / outcomes.len() as f64,
            false_positive_share: n_false_positives as f64 / outcomes.len() as f64,
            brier: reliability.brier,
            ece: reliability.ece,
        })
    }
}

fn labels(examples: &[&Example]) -> Vec<bool> {
    examples.iter().map(|example| example.stable).collect()
}

/// Platt's calibration.
fn calibrate(examples: &[&Example], decision_values: &[f64]) -> Result<PlattCalibration, PlattError> {
    fit_platt(decision_values, &labels(examples))
}

/// Refuses a model that is no better than a guess, because it would lift all grasps or none.
fn check_skill(calibration: &PlattCalibration, outcomes: &[bool], brier: f64) -> Result<(), TrainingError> {
    let share = outcomes.iter().filter(|stable| **stable).count() as f64 / outcomes.len() as f64;
    let of_a_guess = share * (1.0 - share);
    if calibration.a < 0.0 && brier < of_a_guess {
        return Ok(());
    }
    let why = if brier < of_a_guess {
        "grasps that the classifier prefers are stable no more often than others".into()
    } else {
        format!(
            "the classifier does no better than the share of stable grasps (Brier score {brier:.4}, a guess has {of_a_guess:.4})"
        )
    };
    Err(TrainingError::Data(format!(
        "nothing was learned: on objects it has not seen, {why}; it learned from {} outcomes of grasps with contact, {:.0} % of them stable: expected \
         more grasps of more objects, or readings that tell stable grasps from unstable ones; or try another recipe",
        outcomes.len(),
        100.0 * share
    )))
}

/// The probability of each example from a decision value and a calibration that were made without its fold.
fn out_of_fold_probabilities(judged: &OutOfFold<'_>) -> Result<Vec<f64>, PlattError> {
    let OutOfFold { examples, decision_values, folds } = judged;
    let mut probabilities = vec![0.0; examples.len()];
    for fold in folds.iter().copied().collect::<BTreeSet<_>>() {
        let kept: Vec<usize> = (0..examples.len()).filter(|idx| folds[*idx] != fold).collect();
        let values: Vec<f64> = kept.iter().map(|idx| decision_values[*idx]).collect();
        let calibration = calibrate(&picked(examples, &kept), &values)?;
        for idx in (0..examples.len()).filter(|idx| folds[*idx] == fold) {
            probabilities[idx] = calibration.probability(decision_values[idx]);
        }
    }
    Ok(probabilities)
}

/// The settled frames of the examples.
fn readings<'a>(examples: &[&'a Example]) -> Vec<FeltReading<'a>> {
    examples.iter().map(|example| example.reading()).collect()
}

/// Numbers of grasps by their reason, for people.
pub fn counts(by_reason: &BTreeMap<String, usize>) -> String {
    let counts: Vec<String> = by_reason.iter().map(|(reason, n)| format!("{n} {reason}")).collect();
    if counts.is_empty() { "none".into() } else { counts.join(", ") }
}

/// Refuses examples without grasps or of one class only.
fn check_examples(read: &Examples, recordings: &[PathBuf]) -> Result<(), TrainingError> {
    let (n, n_excluded) = (read.examples.len(), &read.n_excluded);
    let n_stable = read.examples.iter().filter(|example| example.stable).count();
    if n == 0 {
        let names: Vec<_> = recordings.iter().map(|path| file_name(path)).collect();
        return Err(TrainingError::Data(format!(
            "no grasp to train on in {}: expected settled frames with contact, and truth (left out: {})",
            if names.is_empty() { "memory".into() } else { names.join(", ") },
            counts(n_excluded)
        )));
    }
    if n_stable == 0 || n_stable == n {
        return Err(TrainingError::Data(format!(
            "{n_stable} of {n} grasps with contact are stable: expected some of each (left out: {})",
            counts(n_excluded)
        )));
    }
    Ok(())
}

/// The fold of each example. All grasps of an object are in one fold.
///
/// # Errors
/// Fewer objects than folds.
fn folds_by_object(examples: &[&Example], n_folds: usize) -> Result<Vec<usize>, TrainingError> {
    let objects: BTreeSet<&str> = examples.iter().map(|example| example.object.as_str()).collect();
    if objects.len() < n_folds {
        return Err(TrainingError::Data(format!(
            "grasps with contact of {}: expected at least {n_folds} objects, one for each fold of the cross-validation, with stable \
             and unstable grasps of several; record more objects, or say which grasps are of which object",
            Split::Object.counted(objects.len())
        )));
    }
    let fold_of: BTreeMap<&str, usize> =
        objects.iter().enumerate().map(|(idx, object)| (*object, idx % n_folds)).collect();
    Ok(examples.iter().map(|example| fold_of[example.object.as_str()]).collect())
}

/// Learns dictionary, scaling and predictor from examples. With a baseline of the day, the predictor takes values relative to
/// the day, which the features are not.
///
/// # Errors
/// Too few contacts for the dictionary, or one class only.
pub fn fit(hand: &Hand, recipe: &Recipe, examples: &[&Example], seed: u64) -> Result<Fitted, TrainingError> {
    let Prepared { features, inertia, rows, labels, targets, day_variances } = prepare(hand, recipe, examples, seed)?;
    let (predictor, n_iterations, converged) = match &recipe.learner {
        Learner::Svm(params) => {
            let (svm, report) = train_svm(&rows, features.len(), &labels, params)?;
            (Predictor::Svm(svm.try_into()?), report.n_iterations, report.converged)
        }
        Learner::Boosting(params) => {
            let trees = train_boosted(&rows, features.len(), &targets, params, seed)?;
            let n_trees = trees.trees.len();
            (Predictor::Boosting(trees), n_trees, true)
        }
        Learner::Blend(BlendParams { boosting, svm, svm_weight }) => {
            let trees = train_boosted(&rows, features.len(), &targets, boosting, seed)?;
            let (svm, report) = train_svm(&rows, features.len(), &labels, svm)?;
            let blend = Blend { trees, svm: svm.try_into()?, svm_weight: *svm_weight };
            (Predictor::Blend(blend), report.n_iterations, report.converged)
        }
        Learner::Loads => return Err(TrainingError::Data("the rule of loads learns nothing".into())),
    };
    Ok(Fitted { features, predictor, inertia, n_iterations, converged, day_variances })
}

/// The training data of a learner.
struct Prepared {
    features: FeatureExtractor,
    inertia: f64,
    /// The feature of each example, row after row.
    rows: Vec<f64>,
    labels: Vec<bool>,
    /// The labels as 0 and 1, which boosting learns.
    targets: Vec<f64>,
    day_variances: Vec<f64>,
}

/// Learns dictionary and scaling, and encodes the examples.
fn prepare(hand: &Hand, recipe: &Recipe, examples: &[&Example], seed: u64) -> Result<Prepared, TrainingError> {
    let positions_m: Vec<[f64; 3]> =
        examples.iter().flat_map(|example| example.contacts.iter().map(|contact| contact.position_m)).collect();
    let params = KMeansParams { n_clusters: recipe.n_words, seed, ..KMeansParams::default() };
    let k_means = match learn_dictionary(&positions_m, &params) {
        // A hand of few cells in one posture has no more positions: each is a word.
        Err(DictionaryError::TooFewDistinct { n_distinct, .. }) if n_distinct > 0 => {
            learn_dictionary(&positions_m, &KMeansParams { n_clusters: n_distinct, ..params })?
        }
        learned => learned?,
    };
    let mut features = FeatureExtractor::new(hand, &recipe.blocks, k_means.dictionary, recipe.sigma_m);
    features.validate().map_err(|error| TrainingError::Data(format!("the recipe {}: {error}", recipe.name)))?;
    let mut rows = rows(&features, examples)?;
    let mut day_variances = Vec::new();
    if recipe.day_baseline {
        day_variances = day::scale_by_day(&mut rows, features.len(), examples);
    } else if recipe.scaled {
        let scaling = Scaling::of(&rows, features.len());
        scaling.apply(&mut rows);
        features.scaling = Some(scaling);
    }
    let labels = labels(examples);
    let targets = labels.iter().map(|stable| f64::from(u8::from(*stable))).collect();
    Ok(Prepared { features, inertia: k_means.inertia, rows, labels, targets, day_variances })
}

impl Fitted {
    /// The decision value of each example.
    ///
    /// # Errors
    /// An example without a feature.
    pub fn decision_values(&self, examples: &[&Example]) -> Result<Vec<f64>, TrainingError> {
        Ok(decision_values(&self.predictor, &rows(&self.features, examples)?)?)
    }
}

/// Boosted trees that learn from the examples that have a row, but not from those of the fold that is held out.
fn fit_trees(
    rows: &[Option<Vec<f64>>],
    n_values: usize,
    examples: &[&Example],
    folds: &[usize],
    held_out: Option<usize>,
    params: &BoostingParams,
    seed: u64,
) -> Result<BoostedTrees, BoostingError> {
    let (mut values, mut targets) = (Vec::new(), Vec::new());
    for ((row, example), fold) in rows.iter().zip(examples).zip(folds) {
        if let Some(row) = row
            && held_out != Some(*fold)
        {
            values.extend_from_slice(row);
            targets.push(f64::from(u8::from(example.stable)));
        }
    }
    train_boosted(&values, n_values, &targets, params, seed)
}

/// The features of the examples, row after row.
fn rows(features: &FeatureExtractor, examples: &[&Example]) -> Result<Vec<f64>, TrainingError> {
    let mut rows = Vec::with_capacity(examples.len() * features.len());
    let mut values = Vec::new();
    for example in examples {
        features.extract(&example.reading(), &mut values).map_err(|fault| {
            TrainingError::Data(format!("grasp {} of {}: {}", example.grasp_id, example.object, fault.as_str()))
        })?;
        rows.extend_from_slice(&values);
    }
    Ok(rows)
}

/// The decision value of each example from a dictionary, a scaling and a predictor that were made without its fold.
/// `progress` gets the number of each fold that begins.
///
/// # Errors
/// As of [`fit`].
pub fn cross_validate(
    hand: &Hand,
    recipe: &Recipe,
    examples: &[&Example],
    folds: &[usize],
    seed: u64,
    mut progress: impl FnMut(usize),
) -> Result<Vec<f64>, TrainingError> {
    let mut decision_values = vec![0.0; examples.len()];
    for fold in folds.iter().copied().collect::<BTreeSet<_>>() {
        progress(fold);
        let (held_out, kept): (Vec<usize>, Vec<usize>) = (0..examples.len()).partition(|idx| folds[*idx] == fold);
        let fitted = fit(hand, recipe, &picked(examples, &kept), seed)?;
        let values = fitted.decision_values(&picked(examples, &held_out))?;
        for (idx, value) in held_out.iter().zip(values) {
            decision_values[*idx] = value;
        }
    }
    Ok(decision_values)
}

/// The examples of these indices.
pub(crate) fn picked<'a>(examples: &[&'a Example], idxs: &[usize]) -> Vec<&'a Example> {
    idxs.iter().map(|idx| examples[*idx]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_guess_is_no_model() {
        let outcomes = [true, true, true, false];
        let check = |a, brier| check_skill(&PlattCalibration { a, b: 0.0 }, &outcomes, brier);
        // Three of four are stable: always saying 3/4 has the Brier score 3/16.
        assert!(check(-1.0, 0.18).is_ok());
        for (a, brier) in [(-1.0, 3.0 / 16.0), (-1.0, 0.2), (0.0, 0.1), (0.5, 0.1)] {
            let error = check(a, brier).expect_err("no skill").to_string();
            assert!(
                error.contains("nothing was learned") && error.contains("4 outcomes of grasps with contact, 75 %"),
                "{error}"
            );
            assert_eq!(error.contains("0.1875"), brier >= 0.1875, "{error}");
        }
    }

    #[test]
    fn lack_of_grasps_names_the_share_that_no_cell_felt() {
        let told = |n_unfelt: usize| {
            let n_excluded = BTreeMap::from([(Fault::NoContact.as_str().to_owned(), n_unfelt)]);
            let read = Examples { n_excluded, grasps: (0..12).map(|idx| (0, idx)).collect(), ..Examples::default() };
            let error = check_examples(&read, &[]).expect_err("no examples");
            with_unfelt_share(error, &read).to_string()
        };
        assert!(told(11).contains("no cell feels 11 of the 12 grasps"), "{}", told(11));
        assert!(!told(3).contains("no cell feels"), "{}", told(3));
    }

    #[test]
    fn too_few_objects_say_how_many_are_needed() {
        let example = |object: &str| Example { object: object.into(), ..Example::default() };
        let examples = [example("a"), example("b")];
        let folds = |n: usize, n_folds| folds_by_object(&examples[..n].iter().collect::<Vec<_>>(), n_folds);
        let refused = |n: usize, n_folds| folds(n, n_folds).expect_err("too few").to_string();
        assert!(refused(1, 5).starts_with("grasps with contact of 1 object: expected at least 5 objects"));
        assert!(refused(2, 5).starts_with("grasps with contact of 2 objects: expected at least 5 objects"));
        assert_eq!(folds(2, 2).expect("folds"), [0, 1]);
    }
}
