//! From recordings to a model: examples, a recipe, features, a machine, its calibration.
//!
//! Each grasp counts once, by its first settled frame; grasps that no cell feels have no feature and are left out. The
//! cross-validated figures come from folds that share no object with what their dictionary, scaling and machine were
//! trained on. The calibration is fitted on the same out-of-fold decision values.

mod examples;
pub mod grid;
mod recipe;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use examples::{Example, Examples};
pub use recipe::{Learner, Recipe};

use crate::classifier::boosting::{BoostingError, train_boosted};
use crate::classifier::calibration::{CalibrationError, fit_platt};
use crate::classifier::svm::{SvmError, train_svm};
use crate::classifier::{Classifier, Machine};
use crate::dataset::DatasetError;
use crate::dictionary::{DictionaryError, KMeansParams, learn_dictionary};
use crate::feature::{FeatureExtractor, Scaling};
use crate::hand::Hand;
use crate::message::MAX_FEATURES;
use crate::model::{FORMAT, Model, ModelHand};

/// How a model is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingOptions {
    /// Features and machine.
    pub recipe: Recipe,
    /// Folds, grouped by object, for calibration and cross-validated figures.
    pub n_folds: usize,
    /// A grasp counts as stable from this probability on.
    pub threshold_probability: f64,
    /// Seeds K-means and boosting.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions { recipe: Recipe::default(), n_folds: 5, threshold_probability: 0.5, seed: 1 }
    }
}

/// How a model was trained, as it says of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSummary {
    /// File names of the recordings.
    pub recordings: Vec<String>,
    /// What made each recording, as it says of itself.
    pub made_by: Vec<String>,
    /// Features and machine.
    pub recipe: Recipe,
    /// Grasps trained on.
    pub n_grasps: usize,
    /// How many of them are stable.
    pub n_stable: usize,
    /// Different objects among them.
    pub n_objects: usize,
    /// Contacts that the dictionary was learned from.
    pub n_contacts: usize,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// K-means' inertia, square metres.
    pub inertia: f64,
    /// Solver iterations of the SVM, or trees.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance.
    pub converged: bool,
    /// Folds of the cross-validation.
    pub n_folds: usize,
    /// Accuracy over folds grouped by object, at the threshold.
    pub cross_validated_accuracy: f64,
    /// Unstable grasps called stable in the same folds, as a share of all grasps trained on.
    pub cross_validated_false_positive_share: f64,
    /// The seed of K-means and boosting.
    pub seed: u64,
    /// The version of this program.
    pub version: String,
    /// The search that two values of the recipe come from; none = nothing was searched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grid: Option<grid::GridSummary>,
}

/// Why a model could not be trained.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// A recording cannot be used.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The dictionary.
    #[error("the dictionary")]
    Dictionary(#[from] DictionaryError),
    /// The SVM.
    #[error("the SVM")]
    Svm(#[from] SvmError),
    /// The boosted trees.
    #[error(transparent)]
    Boosting(#[from] BoostingError),
    /// The calibration.
    #[error("the calibration")]
    Calibration(#[from] CalibrationError),
    /// Too little to train on.
    #[error("{0}")]
    Data(String),
}

/// What a recipe makes of examples, before any calibration.
#[derive(Debug, Clone)]
pub struct Fitted {
    /// What makes features.
    pub features: FeatureExtractor,
    /// What makes decision values of them.
    pub machine: Machine,
    /// K-means' inertia, square metres.
    pub inertia: f64,
    /// Solver iterations of the SVM, or trees.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance.
    pub converged: bool,
}

/// Trains a model on recordings with truth. `progress` is told what is being done.
///
/// # Errors
/// Recordings that cannot be used, of one class only, of fewer objects than folds, or with too few contacts.
pub fn train(
    hand: &Hand,
    recordings: &[PathBuf],
    options: &TrainingOptions,
    mut progress: impl FnMut(&str),
) -> Result<Model, TrainingError> {
    let recipe = &options.recipe;
    if recipe.n_words > MAX_FEATURES {
        return Err(TrainingError::Data(format!("{} words, expected at most {MAX_FEATURES}", recipe.n_words)));
    }
    let read = Examples::read(hand, recordings, |n_read, n| progress(&format!("read recording {n_read} of {n}")))?;
    let examples: Vec<&Example> = read.examples.iter().collect();
    check(&read, recordings)?;
    let labels: Vec<bool> = examples.iter().map(|example| example.stable).collect();
    let folds = folds_by_object(&examples, options.n_folds)?;
    let out_of_fold = cross_validate(hand, recipe, &examples, &folds, options.seed, |fold| {
        progress(&format!("cross-validating, fold {} of {}", fold + 1, options.n_folds));
    })?;
    let calibration = fit_platt(&out_of_fold, &labels)?;
    let called_stable =
        out_of_fold.iter().map(|value| calibration.probability(*value) >= options.threshold_probability);
    let outcomes: Vec<(bool, bool)> = called_stable.zip(labels.iter().copied()).collect();
    let share = |wanted: fn(&(bool, bool)) -> bool| {
        outcomes.iter().filter(|outcome| wanted(outcome)).count() as f64 / outcomes.len() as f64
    };

    progress("training on all grasps");
    let fitted = fit(hand, recipe, &examples, options.seed)?;
    let training = TrainingSummary {
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
        made_by: read.made_by.clone(),
        recipe: recipe.clone(),
        n_grasps: examples.len(),
        n_stable: labels.iter().filter(|stable| **stable).count(),
        n_objects: examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len(),
        n_contacts: examples.iter().map(|example| example.contacts.len()).sum(),
        n_excluded: read.n_excluded.clone(),
        inertia: fitted.inertia,
        n_iterations: fitted.n_iterations,
        converged: fitted.converged,
        n_folds: options.n_folds,
        cross_validated_accuracy: share(|(called, stable)| called == stable),
        cross_validated_false_positive_share: share(|(called, stable)| *called && !stable),
        seed: options.seed,
        version: env!("CARGO_PKG_VERSION").into(),
        grid: None,
    };
    Ok(Model {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        features: fitted.features,
        classifier: Classifier {
            machine: fitted.machine,
            calibration,
            threshold_probability: options.threshold_probability,
            unsure_from_probability: options.threshold_probability,
        },
        training,
        checksum: String::new(),
    })
}

/// Refuses examples that nothing can be learned from.
fn check(read: &Examples, recordings: &[PathBuf]) -> Result<(), TrainingError> {
    let (n, n_excluded) = (read.examples.len(), &read.n_excluded);
    let n_stable = read.examples.iter().filter(|example| example.stable).count();
    if n == 0 {
        let names: Vec<_> = recordings.iter().map(|path| file_name(path)).collect();
        return Err(TrainingError::Data(format!(
            "no grasp to train on in {}: expected settled frames with contact, and truth (left out: {n_excluded:?})",
            names.join(", ")
        )));
    }
    if n_stable == 0 || n_stable == n {
        return Err(TrainingError::Data(format!(
            "{n_stable} of {n} grasps with contact are stable: expected some of each (left out: {n_excluded:?})"
        )));
    }
    Ok(())
}

/// The fold of each example, so that all grasps of an object are in one.
///
/// # Errors
/// Fewer than two folds, or fewer objects than folds.
pub fn folds_by_object(examples: &[&Example], n_folds: usize) -> Result<Vec<usize>, TrainingError> {
    let objects: BTreeSet<&str> = examples.iter().map(|example| example.object.as_str()).collect();
    if n_folds < 2 || objects.len() < n_folds {
        return Err(TrainingError::Data(format!(
            "{} objects for {n_folds} folds: expected at least 2 folds and an object for each",
            objects.len()
        )));
    }
    let fold_of: BTreeMap<&str, usize> =
        objects.iter().enumerate().map(|(idx, object)| (*object, idx % n_folds)).collect();
    Ok(examples.iter().map(|example| fold_of[example.object.as_str()]).collect())
}

/// Learns dictionary, scaling and machine from examples.
///
/// # Errors
/// Too few contacts for the dictionary, or one class only.
pub fn fit(hand: &Hand, recipe: &Recipe, examples: &[&Example], seed: u64) -> Result<Fitted, TrainingError> {
    let Prepared { features, inertia, rows, labels } = prepare(hand, recipe, examples, seed)?;
    let (machine, n_iterations, converged) = match &recipe.learner {
        Learner::Svm(params) => {
            let (svm, report) = train_svm(&rows, features.len(), &labels, params)?;
            (Machine::Svm(svm.try_into()?), report.n_iterations, report.converged)
        }
        Learner::Boosting(params) => {
            let trees = train_boosted(&rows, features.len(), &targets(&labels), params, seed)?;
            let n_trees = trees.trees.len();
            (Machine::Boosting(trees), n_trees, true)
        }
    };
    Ok(Fitted { features, machine, inertia, n_iterations, converged })
}

/// All that a machine learns from.
struct Prepared {
    features: FeatureExtractor,
    inertia: f64,
    /// The feature of each example, row after row.
    rows: Vec<f64>,
    labels: Vec<bool>,
}

/// Learns dictionary and scaling, and makes the examples' features.
fn prepare(hand: &Hand, recipe: &Recipe, examples: &[&Example], seed: u64) -> Result<Prepared, TrainingError> {
    let positions_m: Vec<[f64; 3]> =
        examples.iter().flat_map(|example| example.contacts.iter().map(|contact| contact.position_m)).collect();
    let params = KMeansParams { n_clusters: recipe.n_words, seed, ..KMeansParams::default() };
    let k_means = learn_dictionary(&positions_m, &params)?;
    let mut features = FeatureExtractor::new(hand, &recipe.blocks, k_means.dictionary, recipe.sigma_m);
    let mut rows = rows(&features, examples)?;
    if recipe.scaled {
        let scaling = Scaling::of(&rows, features.len());
        scaling.apply(&mut rows);
        features.scaling = Some(scaling);
    }
    let labels = examples.iter().map(|example| example.stable).collect();
    Ok(Prepared { features, inertia: k_means.inertia, rows, labels })
}

/// What boosting aims at.
fn targets(labels: &[bool]) -> Vec<f64> {
    labels.iter().map(|stable| f64::from(u8::from(*stable))).collect()
}

impl Fitted {
    /// The decision value of each example.
    ///
    /// # Errors
    /// An example without a feature.
    pub fn decision_values(&self, examples: &[&Example]) -> Result<Vec<f64>, TrainingError> {
        decision_values(&self.machine, &rows(&self.features, examples)?)
    }
}

/// The decision value of each of `rows`.
fn decision_values(machine: &Machine, rows: &[f64]) -> Result<Vec<f64>, TrainingError> {
    match machine {
        Machine::Svm(svm) => Ok(svm.decision_values(rows)?),
        Machine::Boosting(trees) => Ok(rows.chunks(trees.n_features).map(|row| trees.decision_value(row)).collect()),
    }
}

/// The features of the examples, row after row.
fn rows(features: &FeatureExtractor, examples: &[&Example]) -> Result<Vec<f64>, TrainingError> {
    let mut rows = Vec::with_capacity(examples.len() * features.len());
    let mut values = Vec::new();
    for example in examples {
        features.extract(&example.joints_rad, &example.contacts, &mut values).map_err(|fault| {
            TrainingError::Data(format!("grasp {} of {}: {}", example.grasp_id, example.object, fault.word()))
        })?;
        rows.extend_from_slice(&values);
    }
    Ok(rows)
}

/// The decision value of each example from a dictionary, a scaling and a machine that know no example of its fold.
/// `progress` is told each fold that begins.
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
