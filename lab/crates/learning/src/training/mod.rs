//! Trains a model from recordings: examples, features, learner, calibration, thresholds.
//!
//! Each grasp counts once, by its first settled frame. Grasps that no cell feels have no feature and are left out. The
//! cross-validated figures come from folds whose dictionary, scaling and learner have seen no object of the fold. The
//! calibration is fitted on the same out-of-fold decision values.

mod adaptation;
mod approach;
mod day;
mod examples;
mod friction;
mod probes;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub use adaptation::{adapt, adapt_on};
pub use blindgrasp_stages::recipe::{BlendParams, Learner, Recipe};
pub use blindgrasp_stages::training_summary::{PolicySummary, TrainingSummary};
pub use examples::{Example, Examples, Relabelling, Signals, UnfeltGrasp};
pub(crate) use probes::composed;

use crate::evaluation::measures::{area_under_roc, curve};
use crate::evaluation::reliability::{N_RELIABILITY_BINS, reliability};
use crate::evaluation::split::Split;
use crate::learners::booster::train_boosted;
use crate::learners::decision_values;
use crate::learners::k_means::{DictionaryError, KMeansParams, learn_dictionary};
use crate::learners::platt::{PlattError, fit_platt};
use crate::learners::svm::train_svm;
use crate::learners::training_range::{learn_training_range, widened_for_other_days};
use blindgrasp_grasps::dataset::DatasetError;
use blindgrasp_messages::{MAX_FEATURES, Phase};
use blindgrasp_stages::classifier::boosting::BoostingError;
use blindgrasp_stages::classifier::calibration::PlattCalibration;
use blindgrasp_stages::classifier::svm::SvmError;
use blindgrasp_stages::classifier::{Blend, Classifier, Predictor};
use blindgrasp_stages::encoder::{FeatureExtractor, FeltReading, Scaling};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::{FORMAT, Model, ModelHand};
use blindgrasp_stages::training_summary::{Bounded, Promise};
use probes::Last;

/// How a model is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingOptions {
    pub recipe: Recipe,
    /// Folds, grouped by object, for calibration and cross-validated figures.
    pub n_folds: usize,
    /// A grasp counts as stable from this probability on, and as unstable below 1 minus it; between them it is unsure.
    pub threshold_probability: f64,
    /// What the thresholds of all stages are chosen for, in place of that probability.
    pub aim: Option<Aim>,
    /// Friction coefficients, equally probable, for which the grasps are labelled again from their scenes. The target
    /// is then the probability that a grasp is stable. Empty: the recordings' own labels.
    pub frictions: Vec<f64>,
    /// Whether grasps are labelled by epsilon and volume, whatever the recordings say.
    pub by_wrench_space: bool,
    /// Seeds K-means and boosting.
    pub seed: u64,
}

/// The aim of thresholds that are chosen for trials, in which a hand grasps again until it lifts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aim {
    /// The least time for each kept object if a drop takes so many seconds more.
    DropSecs(f64),
    /// At most this share of the lifts drops.
    MaxDrops(f64),
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions {
            recipe: Recipe::default(),
            n_folds: 5,
            threshold_probability: 0.5,
            aim: None,
            frictions: Vec::new(),
            by_wrench_space: false,
            seed: 1,
        }
    }
}

impl TrainingOptions {
    /// The label to learn.
    pub fn relabelling(&self) -> Relabelling {
        Relabelling { frictions: self.frictions.clone(), by_wrench_space: self.by_wrench_space }
    }

    /// Refuses options that no training takes, before recordings are read.
    ///
    /// # Errors
    /// Too many words, a threshold that is no probability, or frictions for a learner without probabilities.
    pub fn check(&self) -> Result<(), TrainingError> {
        let recipe = &self.recipe;
        if recipe.n_words > MAX_FEATURES {
            return Err(TrainingError::Data(format!("{} words, expected at most {MAX_FEATURES}", recipe.n_words)));
        }
        let threshold = self.threshold_probability;
        if !(threshold > 0.0 && threshold <= 1.0) {
            return Err(TrainingError::Data(format!("the threshold is {threshold}, expected more than 0, at most 1")));
        }
        if !self.frictions.is_empty() && !matches!(recipe.learner, Learner::Boosting(_)) {
            return Err(TrainingError::Data(format!(
                "several frictions need a learner of probabilities, and the recipe {} has an SVM: use the recipe boosted",
                recipe.name
            )));
        }
        Ok(())
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
    /// Recordings or options that cannot be trained with.
    #[error("{0}")]
    Data(String),
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
/// As of [`TrainingOptions::check`]; examples of one class only, of fewer objects than folds, or with too few contacts.
pub fn train(
    hand: &Hand,
    read: &Examples,
    recordings: &[PathBuf],
    options: &TrainingOptions,
    mut progress: impl FnMut(&str),
) -> Result<Model, TrainingError> {
    options.check()?;
    let recipe = &options.recipe;
    check_examples(read, recordings, &options.frictions)?;
    let examples: Vec<&Example> = read.examples.iter().collect();
    let folds = folds_by_object(&examples, options.n_folds)?;
    let mut cross_validating = |fold| progress(&format!("cross-validating, fold {} of {}", fold + 1, options.n_folds));
    let judged = if recipe.day_baseline {
        day::cross_validate(hand, recipe, &examples, &folds, options.seed, &mut cross_validating)?
    } else {
        OutOfFold {
            decision_values: cross_validate(hand, recipe, &examples, &folds, options.seed, &mut cross_validating)?,
            examples: examples.clone(),
            folds: folds.clone(),
        }
    };
    let calibration = calibrate(&judged.examples, &judged.decision_values)?;
    progress("training on all grasps");
    let fitted = fit(hand, recipe, &examples, options.seed)?;
    let mut training_range = learn_training_range(hand, &fitted.features, &readings(&examples), &folds);
    if recipe.day_baseline {
        training_range = widened_for_other_days(training_range, &fitted.features);
    }
    let threshold_probability = options.threshold_probability;
    let validated = CrossValidated::of(&judged, &calibration, threshold_probability)?;
    let day = day::learn(recipe, &fitted, &examples, options.seed)?;
    if day.is_none() && examples.iter().any(|example| example.day != 0) {
        progress(
            "not learned: whether a day is like those of the training; every recording must say its days, with several objects each",
        );
    }
    let mut classifier = Classifier {
        predictor: fitted.predictor,
        calibration,
        threshold_probability,
        // "Unstable" is to be as certain as "stable".
        unsure_from_probability: threshold_probability.min(1.0 - threshold_probability),
    };
    let mut learned = Vec::new();
    for phase in [Phase::Squeezed, Phase::TestLifted] {
        if recipe.day_baseline {
            // Frames after a probe have no baseline.
            learned.push(None);
            continue;
        }
        let n_without = probes::n_without(phase, &examples);
        if n_without == examples.len() {
            // Recordings without this probe have nothing to learn from.
            learned.push(None);
            continue;
        }
        let probe_name = if phase == Phase::Squeezed { "squeeze" } else { "test lift" };
        progress(&format!("learning the decision after the {probe_name}"));
        if n_without > 0 {
            progress(&format!("not learned: {n_without} of {} grasps have no such frames", examples.len()));
        }
        let mut probe = probes::learn(hand, recipe, &fitted.features, phase, &examples, &folds, options.seed)?;
        if probe.is_none() && n_without == 0 && matches!(recipe.learner, Learner::Boosting(_)) {
            progress(&format!("not learned: on new objects, frames after the {probe_name} do no better than a guess"));
        }
        if phase == Phase::TestLifted && matches!(learned[..], [None]) && probe.take().is_some() {
            progress("not learned: a test lift follows a squeeze, and the decision after that was not learned");
        }
        if let Some(learned) = &mut probe {
            learned.probe.classifier.threshold_probability = threshold_probability;
            learned.probe.classifier.unsure_from_probability = threshold_probability;
        }
        learned.push(probe);
    }
    let mut policies = Vec::new();
    if let Some(aim) = options.aim {
        progress("choosing thresholds for trials");
        let of_lifts = !options.by_wrench_space && !read.labels.contains_key(&Label::WrenchSpace);
        let promises = of_lifts && !recipe.day_baseline;
        policies = choose_policies(&mut classifier, &mut learned, &judged, (aim, promises), &mut progress)?;
    }
    let mut learned = learned.into_iter().map(|learned| learned.map(|learned| learned.probe));
    let (squeezed, test_lifted) = (learned.next().flatten(), learned.next().flatten());
    let training = TrainingSummary {
        policies,
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
        made_by: read.made_by.clone(),
        labels: if options.by_wrench_space || read.labels.contains_key(&Label::Lift) {
            read.labels.clone()
        } else {
            BTreeMap::new()
        },
        recipe: recipe.clone(),
        frictions: options.frictions.clone(),
        n_grasps: examples.len(),
        n_stable: examples.iter().filter(|example| example.stable).count(),
        n_objects: examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len(),
        n_contacts: examples.iter().map(|example| example.contacts.len()).sum(),
        n_excluded: read.n_excluded.clone(),
        inertia: fitted.inertia,
        n_iterations: fitted.n_iterations,
        converged: fitted.converged,
        n_folds: options.n_folds,
        cross_validated_accuracy: validated.accuracy,
        cross_validated_false_positive_share: validated.false_positive_share,
        cross_validated_brier: validated.brier,
        cross_validated_ece: validated.ece,
        seed: options.seed,
        version: env!("CARGO_PKG_VERSION").into(),
        trained_on: Some(read.trained_on()),
        own_lifts: None,
    };
    Ok(Model {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        features: fitted.features,
        classifier,
        training_range,
        squeezed,
        test_lifted,
        day,
        approach: approach::learn(hand, &examples, &folds, options.seed)?,
        training,
        checksum: String::new(),
    })
}

/// The prices of a drop that are tried for [`Aim::MaxDrops`], from strict to loose: fixed, so that the tests in this order need no
/// correction (fixed sequence testing, Angelopoulos et al. 2021, section 3).
const DROP_SECS: [f64; 10] = [1000.0, 500.0, 240.0, 120.0, 60.0, 30.0, 15.0, 8.0, 4.0, 0.0];

/// A look's policy with the price of a drop that it was chosen for, and its promise.
type Chosen = (probes::Policy, f64, Option<Promise>);

impl Aim {
    /// Chooses the policy of a look. The error is the reason why the look has none.
    fn choose(self, policies: &probes::Policies, look: &str) -> Result<Chosen, String> {
        match self {
            Aim::DropSecs(drop_secs) => {
                let policy = policies.cheapest(drop_secs).ok_or_else(|| {
                    format!("no threshold leads to a lift when the hand is {look}: record more grasps of more objects")
                })?;
                Ok((policy, drop_secs, policies.promise(drop_secs)))
            }
            Aim::MaxDrops(max_drops) => {
                let promises = DROP_SECS.map(|drop_secs| (drop_secs, policies.promise(drop_secs)));
                let is_kept = |promise: &Promise| promise.drops_of_lifts.at_most <= max_drops;
                let passed = promises.iter().take_while(|(_, promise)| promise.as_ref().is_some_and(is_kept)).last();
                if let Some((drop_secs, Some(promise))) = passed
                    && let Some(policy) = policies.cheapest(*drop_secs)
                {
                    // The sequence of tests bounds drops by this share, and not by the bound that the last test alone gives.
                    let bounded = |bounded| Bounded { at_most: max_drops, ..bounded };
                    let (drops_of_lifts, drops_of_trials) =
                        (bounded(promise.drops_of_lifts), bounded(promise.drops_of_trials));
                    return Ok((policy, *drop_secs, Some(Promise { drops_of_lifts, drops_of_trials, ..*promise })));
                }
                Err(match &promises[0].1 {
                    None => format!("nothing is lifted when the hand is {look}: record more grasps of more objects"),
                    Some(promise) => format!(
                        "when the hand is {look}, the strictest threshold promises at most {:.1} % of the lifts to drop, from {} \
                         objects: record more objects, or allow more drops",
                        100.0 * promise.drops_of_lifts.at_most,
                        promise.drops_of_lifts.n_objects
                    ),
                })
            }
        }
    }
}

/// The threshold of a look that never lifts.
const NEVER: f64 = 1.0;

/// Chooses the thresholds of all looks, each for hands that can do this probe and no other. A look without a policy never lifts.
/// Attempts are grasps with contact: those that no cell feels are attempts of a robot as well, and are not counted.
/// `promises` says whether the labels are outcomes of lifts, for which a promise can be made.
fn choose_policies(
    classifier: &mut Classifier,
    learned: &mut [Option<probes::Learned>],
    judged: &OutOfFold<'_>,
    (aim, promises): (Aim, bool),
    progress: &mut impl FnMut(&str),
) -> Result<Vec<PolicySummary>, TrainingError> {
    if matches!(aim, Aim::MaxDrops(_)) && !promises {
        return Err(TrainingError::Data(
            "a share of drops can be promised for lifts alone: expected recordings of lifts (simulate --label lift, import), without \
             --label wrench-space and without --day-baseline"
                .into(),
        ));
    }
    let examples = &judged.examples;
    let settled = out_of_fold_probabilities(judged)?;
    let names: BTreeSet<&String> = examples.iter().map(|example| &example.object).collect();
    let objects: BTreeMap<&String, usize> = names.into_iter().zip(0..).collect();
    let [squeezed, test_lifted] = learned else {
        return Err(TrainingError::Data(format!("{} looks after a probe, expected two", learned.len())));
    };
    let policies = |last: Last, learned: [&Option<probes::Learned>; 2], stable_from: [f64; 2]| {
        let probability = |learned: &Option<probes::Learned>, idx: usize| learned.as_ref()?.probabilities[idx];
        let attempts = examples.iter().zip(&settled).enumerate();
        let attempted = attempts.map(|(idx, (example, settled))| probes::Attempted {
            object: objects[&example.object],
            fold: judged.folds[idx],
            settled: *settled,
            // A tight hand that feels nothing is given up.
            squeezed: if last == Last::TestLift { probability(learned[0], idx).unwrap_or(-1.0) } else { 1.0 },
            decided: match last {
                Last::Settled => Some(*settled),
                Last::Squeeze => probability(learned[0], idx),
                Last::TestLift => probability(learned[1], idx),
            },
            stable: example.stable,
        });
        probes::Policies::new(&attempted.collect::<Vec<_>>(), last, stable_from)
    };
    let summary = |look: &str, roc_area: f64, (policy, drop_secs, promise): &Chosen| PolicySummary {
        roc_area,
        look: look.into(),
        drop_secs: *drop_secs,
        kept: policy.expected.kept,
        attempts_per_lift: policy.expected.attempts_per_lift,
        given_up: policy.expected.given_up,
        secs_per_kept: policy.expected.secs_per_kept,
        promise: if promises { *promise } else { None },
    };
    let (mut summaries, mut refusals) = (Vec::new(), Vec::new());
    match aim.choose(&policies(Last::Settled, [squeezed, test_lifted], [NEVER; 2]), "settled") {
        Ok(without) => {
            classifier.threshold_probability = without.0.lift;
            let stable: Vec<bool> = examples.iter().map(|example| example.stable).collect();
            let roc_area = area_under_roc(&curve(&settled, &stable)).unwrap_or(0.5);
            summaries.push(summary("settled", roc_area, &without));
        }
        Err(refusal) => {
            classifier.threshold_probability = NEVER;
            refusals.push(refusal);
        }
    }
    classifier.unsure_from_probability = classifier.threshold_probability;
    let settled_threshold = classifier.threshold_probability;
    let choose = |last: Last, look: &str, squeezed_threshold: f64| {
        let stable_from = [settled_threshold, squeezed_threshold];
        aim.choose(&policies(last, [squeezed, test_lifted], stable_from), look)
    };
    let of_squeeze = squeezed.is_some().then(|| choose(Last::Squeeze, "squeezed", NEVER));
    // With a promise, a tight hand is not lifted before its test lift, so that no threshold of its own lets it go on.
    let squeezed_threshold = match (&of_squeeze, aim) {
        (Some(Ok(chosen)), Aim::DropSecs(_)) => chosen.0.lift,
        _ => NEVER,
    };
    let of_test_lift = test_lifted.is_some().then(|| choose(Last::TestLift, "test_lifted", squeezed_threshold));
    for learned in [&mut *squeezed, &mut *test_lifted].into_iter().flatten() {
        let probe = &mut learned.probe.classifier;
        (probe.threshold_probability, probe.unsure_from_probability) = (NEVER, NEVER);
    }
    let has_test_lift = matches!(of_test_lift, Some(Ok(_)));
    if let (Some(learned), Some(chosen)) = (&mut *squeezed, of_squeeze) {
        match chosen {
            // Without a promise a look does not lift, if one was asked for, and that of this look was for another choice of
            // the grasps to probe.
            Ok(_) if has_test_lift && matches!(aim, Aim::MaxDrops(_)) => {
                progress("squeezed hands are never lifted: the thresholds are for the test lift");
            }
            Ok(chosen) => {
                let (probe, policy) = (&mut learned.probe.classifier, &chosen.0);
                (probe.threshold_probability, probe.unsure_from_probability) = (policy.lift, policy.lift);
                classifier.unsure_from_probability = policy.promising;
                let promised = if has_test_lift { (chosen.0, chosen.1, None) } else { chosen };
                summaries.push(summary("squeezed", learned.probe.cross_validated_roc_area, &promised));
            }
            Err(refusal) => refusals.push(refusal),
        }
    }
    if let (Some(learned), Some(before), Some(chosen)) = (test_lifted, squeezed, of_test_lift) {
        match chosen {
            Ok(chosen) => {
                let (probe, policy) = (&mut learned.probe.classifier, &chosen.0);
                (probe.threshold_probability, probe.unsure_from_probability) = (policy.lift, policy.lift);
                classifier.unsure_from_probability = policy.promising;
                let before = &mut before.probe.classifier;
                // A tight hand without a feature counts as -1 above.
                before.unsure_from_probability = policy.promising_squeezed.max(0.0);
                summaries.push(summary("test_lifted", learned.probe.cross_validated_roc_area, &chosen));
            }
            Err(refusal) => refusals.push(refusal),
        }
    }
    if summaries.is_empty() || matches!(aim, Aim::DropSecs(_)) && !refusals.is_empty() {
        return Err(TrainingError::Data(refusals.join("; ")));
    }
    refusals.iter().for_each(|refusal| progress(&format!("not lifted: {refusal}")));
    Ok(summaries)
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
    fn of(
        judged: &OutOfFold<'_>,
        calibration: &PlattCalibration,
        threshold_probability: f64,
    ) -> Result<CrossValidated, TrainingError> {
        let (probabilities, outcomes) = by_outcome(&judged.examples, &out_of_fold_probabilities(judged)?);
        let reliability = reliability(&probabilities, &outcomes, N_RELIABILITY_BINS);
        check_skill(calibration, &outcomes, reliability.brier)?;
        let (values, _) = by_outcome(&judged.examples, &judged.decision_values);
        let called_stable = values.iter().map(|value| calibration.probability(*value) >= threshold_probability);
        let decided: Vec<(bool, bool)> = called_stable.zip(outcomes).collect();
        let share = |wanted: fn(&(bool, bool)) -> bool| {
            decided.iter().filter(|outcome| wanted(outcome)).count() as f64 / decided.len() as f64
        };
        Ok(CrossValidated {
            accuracy: share(|(called, stable)| called == stable),
            false_positive_share: share(|(called, stable)| *called && !stable),
            brier: reliability.brier,
            ece: reliability.ece,
        })
    }
}

/// Each example's number, once for each of its outcomes, and the outcomes.
fn by_outcome(examples: &[&Example], numbers: &[f64]) -> (Vec<f64>, Vec<bool>) {
    let each = examples.iter().zip(numbers);
    each.flat_map(|(example, number)| example.outcomes().iter().map(move |outcome| (*number, *outcome))).unzip()
}

/// Platt's calibration. An example with labels for several frictions counts once for each.
fn calibrate(examples: &[&Example], decision_values: &[f64]) -> Result<PlattCalibration, PlattError> {
    let (values, outcomes) = by_outcome(examples, decision_values);
    fit_platt(&values, &outcomes)
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
        let calibration = calibrate(&kept.iter().map(|idx| examples[*idx]).collect::<Vec<_>>(), &values)?;
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

/// Refuses examples without grasps or of one class only.
fn check_examples(read: &Examples, recordings: &[PathBuf], frictions: &[f64]) -> Result<(), TrainingError> {
    let (n, n_excluded) = (read.examples.len(), &read.n_excluded);
    let n_stable = read.examples.iter().filter(|example| example.stable).count();
    if n == 0 {
        let names: Vec<_> = recordings.iter().map(|path| file_name(path)).collect();
        return Err(TrainingError::Data(format!(
            "no grasp to train on in {}: expected settled frames with contact, and truth (left out: {n_excluded:?})",
            if names.is_empty() { "memory".into() } else { names.join(", ") }
        )));
    }
    if n_stable == 0 || n_stable == n {
        return Err(TrainingError::Data(format!(
            "{n_stable} of {n} grasps with contact are stable: expected some of each (left out: {n_excluded:?})"
        )));
    }
    let targets = || read.examples.iter().map(Example::target);
    if targets().all(|target| target <= 0.0) || targets().all(|target| target >= 1.0) {
        let which = if targets().all(|target| target <= 0.0) {
            "no grasp is stable for any"
        } else {
            "every grasp is stable for each"
        };
        return Err(TrainingError::Data(format!(
            "{which} of the frictions {:?}: expected some of which only a part is stable",
            frictions
        )));
    }
    Ok(())
}

/// The fold of each example. All grasps of an object are in one fold.
///
/// # Errors
/// Fewer than two folds, or fewer objects than folds.
pub fn folds_by_object(examples: &[&Example], n_folds: usize) -> Result<Vec<usize>, TrainingError> {
    let objects: BTreeSet<&str> = examples.iter().map(|example| example.object.as_str()).collect();
    let n_needed = n_folds.max(2);
    if objects.len() < n_needed {
        return Err(TrainingError::Data(format!(
            "grasps with contact of {}: expected at least {n_needed} objects, one for each fold of the cross-validation, with stable \
             and unstable grasps of several; record more objects, or say which grasps are of which object",
            Split::Object.counted(objects.len())
        )));
    }
    if n_folds < 2 {
        return Err(TrainingError::Data(format!("expected at least 2 folds, found {n_folds}")));
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
    /// [`Example::target`] of each example, which boosting learns.
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
    let labels = examples.iter().map(|example| example.stable).collect();
    let targets = examples.iter().map(|example| example.target()).collect();
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
        let of = |idxs: &[usize]| idxs.iter().map(|idx| examples[*idx]).collect::<Vec<&Example>>();
        let values = fit(hand, recipe, &of(&kept), seed)?.decision_values(&of(&held_out))?;
        for (idx, value) in held_out.iter().zip(values) {
            decision_values[*idx] = value;
        }
    }
    Ok(decision_values)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
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
    fn too_few_objects_say_how_many_are_needed() {
        let example = |object: &str| Example { object: object.into(), ..Example::default() };
        let examples = [example("a"), example("b")];
        let folds = |n: usize, n_folds| folds_by_object(&examples[..n].iter().collect::<Vec<_>>(), n_folds);
        let refused = |n: usize, n_folds| folds(n, n_folds).expect_err("too few").to_string();
        assert!(refused(1, 5).starts_with("grasps with contact of 1 object: expected at least 5 objects"));
        assert!(refused(2, 5).starts_with("grasps with contact of 2 objects: expected at least 5 objects"));
        assert!(refused(1, 1).contains("expected at least 2 objects"));
        assert!(refused(2, 1).contains("expected at least 2 folds"));
        assert_eq!(folds(2, 2).expect("folds"), [0, 1]);
    }
}
