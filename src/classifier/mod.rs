//! The classifier stage: from a feature to a calibrated probability that the grasp is stable.
//!
//! The paper's machine is an RBF support vector machine (Dang & Allen, section IV-D); boosted trees are the stronger one.
//! A Platt calibration makes a probability of either's decision value.

pub mod boosting;
pub mod calibration;
pub mod libsvm_format;
pub mod reliability;
pub mod svm;

use serde::{Deserialize, Serialize};

use crate::message::Fault;
use boosting::BoostedTrees;
use calibration::PlattCalibration;
use svm::PreparedSvm;

/// What tells stable features from unstable ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Machine {
    /// A support vector machine with an RBF kernel; the positive class is "stable".
    Svm(PreparedSvm),
    /// Gradient-boosted trees.
    Boosting(BoostedTrees),
}

impl Machine {
    /// How many values its features have.
    pub fn n_features(&self) -> usize {
        match self {
            Machine::Svm(svm) => svm.n_features,
            Machine::Boosting(trees) => trees.n_features,
        }
    }

    /// The decision value of a feature, > 0 on the stable side.
    ///
    /// # Errors
    /// The fault: [`Fault::WrongLength`], or [`Fault::InvalidValue`] for a value that is not finite.
    pub fn decision_value(&self, values: &[f64]) -> Result<f64, Fault> {
        if values.len() != self.n_features() {
            return Err(Fault::WrongLength);
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(Fault::InvalidValue);
        }
        match self {
            Machine::Svm(svm) => svm.decision_value(values).map_err(|_| Fault::InvalidValue),
            Machine::Boosting(trees) => Ok(trees.decision_value(values)),
        }
    }

    /// In a word or two, for people.
    pub fn summary(&self) -> String {
        match self {
            Machine::Svm(svm) => format!("RBF SVM, gamma {}, {} support vectors", svm.gamma, svm.n_support_vectors()),
            Machine::Boosting(trees) => format!("{} boosted trees, {} nodes", trees.trees.len(), trees.n_nodes()),
        }
    }
}

/// A trained classifier.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Classifier {
    /// What makes decision values.
    pub machine: Machine,
    /// From decision values to probabilities.
    pub calibration: PlattCalibration,
    /// A grasp counts as stable when its probability is at least this.
    pub threshold_probability: f64,
    /// From this probability on, up to the threshold, the classifier is unsure; below it the grasp counts as unstable. At
    /// most the threshold.
    pub unsure_from_probability: f64,
}

/// What the classifier says of a feature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Verdict {
    /// The machine's decision value, > 0 on the stable side.
    pub decision_value: f64,
    /// Calibrated probability that the grasp is stable.
    pub probability_stable: f64,
    /// Whether the probability reaches the threshold.
    pub stable: bool,
    /// Whether the probability is neither high enough for stable nor low enough for unstable.
    pub unsure: bool,
}

impl Classifier {
    /// Classifies a feature.
    ///
    /// # Errors
    /// The fault: [`Fault::WrongLength`], or [`Fault::InvalidValue`] for a value that is not finite.
    pub fn classify(&self, values: &[f64]) -> Result<Verdict, Fault> {
        let decision_value = self.machine.decision_value(values)?;
        let probability_stable = self.calibration.probability(decision_value);
        if !(decision_value.is_finite() && probability_stable.is_finite()) {
            return Err(Fault::InvalidValue);
        }
        let stable = probability_stable >= self.threshold_probability;
        let unsure = !stable && probability_stable >= self.unsure_from_probability;
        Ok(Verdict { decision_value, probability_stable, stable, unsure })
    }
}
