//! The classifier stage: from a feature to a calibrated probability that the grasp is stable.
//!
//! An RBF support vector machine (Dang & Allen, section IV-D) and a Platt calibration of its decision values.

pub mod calibration;
pub mod libsvm_format;
pub mod svm;

use serde::{Deserialize, Serialize};

use crate::message::Fault;
use calibration::PlattCalibration;
use svm::PreparedSvm;

/// A trained classifier.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Classifier {
    /// The support vector machine; the positive class is "stable".
    pub svm: PreparedSvm,
    /// From decision values to probabilities.
    pub calibration: PlattCalibration,
    /// A grasp counts as stable when its probability is at least this.
    pub threshold_probability: f64,
}

/// What the classifier says of a feature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Verdict {
    /// The SVM's decision value, > 0 on the stable side.
    pub decision_value: f64,
    /// Calibrated probability that the grasp is stable.
    pub probability_stable: f64,
    /// Whether the probability reaches the threshold.
    pub stable: bool,
}

impl Classifier {
    /// Classifies a feature of one value per word.
    ///
    /// # Errors
    /// The fault: [`Fault::WrongLength`], or [`Fault::InvalidValue`] for a value that is not finite.
    pub fn classify(&self, values: &[f64]) -> Result<Verdict, Fault> {
        if values.len() != self.svm.n_features {
            return Err(Fault::WrongLength);
        }
        let decision_value = self.svm.decision_value(values).map_err(|_| Fault::InvalidValue)?;
        let probability_stable = self.calibration.probability(decision_value);
        if !(decision_value.is_finite() && probability_stable.is_finite()) {
            return Err(Fault::InvalidValue);
        }
        Ok(Verdict { decision_value, probability_stable, stable: probability_stable >= self.threshold_probability })
    }
}
