//! From recordings to a model: dictionary, features, support vector machine, calibration.
//!
//! Each grasp counts once, by its first settled frame; grasps that no cell feels have no feature and are left out. The
//! cross-validated figures come from folds that share no object with what their dictionary and machine were trained on.
//! The two numbers of the calibration are fitted on the same out-of-fold decision values.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::classifier::Classifier;
use crate::classifier::calibration::{CalibrationError, fit_platt};
use crate::classifier::svm::{PreparedSvm, SvmError, SvmParams, train_svm};
use crate::contacts::contacts_from_frame;
use crate::dataset::{DatasetError, read_grasps};
use crate::dictionary::{Dictionary, DictionaryError, KMeans, KMeansParams, learn_dictionary};
use crate::hand::Hand;
use crate::histogram::histogram;
use crate::message::{Contact, Fault, MAX_FEATURES, Phase};
use crate::model::{FORMAT, Model, ModelHand};

/// How a model is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingOptions {
    /// The dictionary's size (the paper's k = 64).
    pub n_words: usize,
    /// σ of Eq. 3, metres (the paper's 36.45 mm).
    pub sigma_m: f64,
    /// The SVM's penalty, kernel width and tolerance.
    pub svm: SvmParams,
    /// Folds, grouped by object, for calibration and cross-validated figures.
    pub n_folds: usize,
    /// A grasp counts as stable from this probability on.
    pub threshold_probability: f64,
    /// Seeds K-means.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions {
            n_words: 64,
            sigma_m: 0.03645,
            // The best of six pairs (c 1, 10, 100; gamma 0.3, 1, 3) by cross-validation over the built-in training
            // objects; the held-out ones had no say.
            svm: SvmParams { c: 100.0, gamma: 0.3, tolerance: 1e-3, ..SvmParams::default() },
            n_folds: 5,
            threshold_probability: 0.5,
            seed: 1,
        }
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
    /// The SVM's penalty.
    pub c: f64,
    /// The SVM's kernel width.
    pub gamma: f64,
    /// The SVM's stopping tolerance.
    pub tolerance: f64,
    /// Solver iterations.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance.
    pub converged: bool,
    /// Folds of the cross-validation.
    pub n_folds: usize,
    /// Accuracy over folds grouped by object, at the threshold.
    pub cross_validated_accuracy: f64,
    /// Unstable grasps called stable in the same folds, as a share of all grasps trained on.
    pub cross_validated_false_positive_share: f64,
    /// The seed of K-means.
    pub seed: u64,
    /// The version of this program.
    pub version: String,
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
    /// The calibration.
    #[error("the calibration")]
    Calibration(#[from] CalibrationError),
    /// Too little to train on.
    #[error("{0}")]
    Data(String),
}

/// A grasp to train on.
struct Example {
    contacts: Vec<Contact>,
    stable: bool,
    object: String,
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
    let mut canonical = BTreeSet::new();
    for path in recordings {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            return Err(TrainingError::Data(format!("{} is given twice", path.display())));
        }
    }
    if options.n_words > MAX_FEATURES {
        return Err(TrainingError::Data(format!("{} words, expected at most {MAX_FEATURES}", options.n_words)));
    }
    progress("reading recordings");
    let (examples, n_excluded, made_by) = read_examples(hand, recordings)?;
    let n_stable = examples.iter().filter(|example| example.stable).count();
    let objects: BTreeSet<&str> = examples.iter().map(|example| example.object.as_str()).collect();
    if n_stable == 0 || n_stable == examples.len() {
        return Err(TrainingError::Data(format!(
            "{n_stable} of {} grasps with contact are stable: expected some of each (left out: {n_excluded:?})",
            examples.len()
        )));
    }
    if options.n_folds < 2 || objects.len() < options.n_folds {
        return Err(TrainingError::Data(format!(
            "{} objects for {} folds: expected at least 2 folds and an object for each",
            objects.len(),
            options.n_folds
        )));
    }
    let labels: Vec<bool> = examples.iter().map(|example| example.stable).collect();
    let fold_of: BTreeMap<&str, usize> =
        objects.iter().enumerate().map(|(idx, object)| (*object, idx % options.n_folds)).collect();
    let folds: Vec<usize> = examples.iter().map(|example| fold_of[example.object.as_str()]).collect();
    let out_of_fold = out_of_fold_decision_values(&examples, &folds, options, &mut progress)?;
    let calibration = fit_platt(&out_of_fold, &labels)?;
    let called_stable =
        out_of_fold.iter().map(|value| calibration.probability(*value) >= options.threshold_probability);
    let outcomes: Vec<(bool, bool)> = called_stable.zip(labels.iter().copied()).collect();
    let share = |wanted: fn(&(bool, bool)) -> bool| {
        outcomes.iter().filter(|outcome| wanted(outcome)).count() as f64 / outcomes.len() as f64
    };

    progress("training on all grasps");
    let all: Vec<&Example> = examples.iter().collect();
    let k_means = dictionary_of(&all, options)?;
    let dictionary = k_means.dictionary;
    let features = features(&dictionary, options.sigma_m, &all)?;
    let (svm, report) = train_svm(&features, options.n_words, &labels, &options.svm)?;
    let training = TrainingSummary {
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
        made_by,
        n_grasps: examples.len(),
        n_stable,
        n_objects: objects.len(),
        n_contacts: examples.iter().map(|example| example.contacts.len()).sum(),
        n_excluded,
        inertia: k_means.inertia,
        c: options.svm.c,
        gamma: options.svm.gamma,
        tolerance: options.svm.tolerance,
        n_iterations: report.n_iterations,
        converged: report.converged,
        n_folds: options.n_folds,
        cross_validated_accuracy: share(|(called, stable)| called == stable),
        cross_validated_false_positive_share: share(|(called, stable)| *called && !stable),
        seed: options.seed,
        version: env!("CARGO_PKG_VERSION").into(),
    };
    Ok(Model {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        sigma_m: options.sigma_m,
        dictionary,
        classifier: Classifier {
            svm: svm.try_into()?,
            calibration,
            threshold_probability: options.threshold_probability,
        },
        training,
        checksum: String::new(),
    })
}

type Examples = (Vec<Example>, BTreeMap<String, usize>, Vec<String>);

fn read_examples(hand: &Hand, recordings: &[PathBuf]) -> Result<Examples, TrainingError> {
    let mut examples = Vec::new();
    let mut n_excluded: BTreeMap<String, usize> = BTreeMap::new();
    let mut made_by = Vec::new();
    let mut exclude = |reason: &str| *n_excluded.entry(reason.into()).or_default() += 1;
    for path in recordings {
        made_by.push(crate::recording::RecordingReader::open(path).map_err(DatasetError::from)?.info().made_by.clone());
        let grasps = read_grasps(path, hand, |_, frames| {
            let frame = frames.into_iter().find(|frame| frame.message.phase == Phase::Settled)?;
            let (joints, cells) = (&frame.message.joints_rad, &frame.message.cells_newtons);
            let mut contacts = Vec::new();
            let summary = contacts_from_frame(hand, frame.header.hand_id, joints, cells, &mut contacts);
            Some((contacts, summary.fault))
        })?;
        for grasp in grasps {
            match (grasp.value, grasp.truth) {
                (_, None) => exclude("no truth"),
                (None, _) => exclude("no settled frame"),
                (Some((contacts, Fault::None)), Some(truth)) => {
                    examples.push(Example { contacts, stable: truth.stable, object: truth.object });
                }
                (Some((_, fault)), _) => exclude(fault.word()),
            }
        }
    }
    if examples.is_empty() {
        let names: Vec<_> = recordings.iter().map(|path| file_name(path)).collect();
        return Err(TrainingError::Data(format!(
            "no grasp to train on in {}: expected settled frames with contact, and truth (left out: {n_excluded:?})",
            names.join(", ")
        )));
    }
    Ok((examples, n_excluded, made_by))
}

fn dictionary_of(examples: &[&Example], options: &TrainingOptions) -> Result<KMeans, TrainingError> {
    let positions_m: Vec<[f64; 3]> =
        examples.iter().flat_map(|example| example.contacts.iter().map(|contact| contact.position_m)).collect();
    let params = KMeansParams { n_clusters: options.n_words, seed: options.seed, ..KMeansParams::default() };
    Ok(learn_dictionary(&positions_m, &params)?)
}

/// The features of the examples, row after row.
fn features(dictionary: &Dictionary, sigma_m: f64, examples: &[&Example]) -> Result<Vec<f64>, TrainingError> {
    let mut features = Vec::with_capacity(examples.len() * dictionary.words_m.len());
    let mut values = Vec::new();
    for example in examples {
        histogram(dictionary, sigma_m, &example.contacts, &mut values).map_err(|fault| {
            TrainingError::Data(format!("a grasp of {} has the fault {}", example.object, fault.word()))
        })?;
        features.extend_from_slice(&values);
    }
    Ok(features)
}

/// The decision value of each grasp from a dictionary and a machine that know no grasp of its object's fold.
fn out_of_fold_decision_values(
    examples: &[Example],
    folds: &[usize],
    options: &TrainingOptions,
    progress: &mut impl FnMut(&str),
) -> Result<Vec<f64>, TrainingError> {
    let mut decision_values = vec![0.0; examples.len()];
    for fold in 0..options.n_folds {
        progress(&format!("cross-validating, fold {} of {}", fold + 1, options.n_folds));
        let (held_out, kept): (Vec<usize>, Vec<usize>) = (0..examples.len()).partition(|idx| folds[*idx] == fold);
        let of = |idxs: &[usize]| idxs.iter().map(|idx| &examples[*idx]).collect::<Vec<&Example>>();
        let (held_out_examples, kept_examples) = (of(&held_out), of(&kept));
        let dictionary = dictionary_of(&kept_examples, options)?.dictionary;
        let kept_labels: Vec<bool> = kept_examples.iter().map(|example| example.stable).collect();
        let kept_features = features(&dictionary, options.sigma_m, &kept_examples)?;
        let (svm, _) = train_svm(&kept_features, options.n_words, &kept_labels, &options.svm)?;
        let held_out_features = features(&dictionary, options.sigma_m, &held_out_examples)?;
        let values = PreparedSvm::try_from(svm)?.decision_values(&held_out_features)?;
        for (idx, value) in held_out.iter().zip(values) {
            decision_values[*idx] = value;
        }
    }
    Ok(decision_values)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
