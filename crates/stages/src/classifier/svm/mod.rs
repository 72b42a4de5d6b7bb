//! Support vector classification with an RBF kernel, the classifier of Dang & Allen, section IV-D.
//!
//! It evaluates a machine that was trained; it does not scale features or turn decision values into probabilities (see
//! [`super::calibration`]).

#[doc(hidden)]
pub mod lanes;
mod prepared;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use prepared::PreparedSvm;

/// Parameters of the training, named as in LIBSVM and scikit-learn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SvmParams {
    /// Penalty of a sample on the wrong side of its margin, the upper bound of every α; above 0.
    pub c: f64,
    /// Width of the kernel `exp(-gamma ‖x - z‖²)`, per squared unit of the features; above 0.
    pub gamma: f64,
    /// How far the optimality conditions may be violated, in units of the decision value; above 0.
    pub tolerance: f64,
    /// Factor of `c` for positive samples, LIBSVM's `-w1` with label 1; above 0.
    pub weight_positive: f64,
    /// Factor of `c` for negative samples, LIBSVM's `-w-1` with label -1; above 0.
    pub weight_negative: f64,
    /// Memory for kernel values, bytes. It changes the time that training takes, but no bit of its result.
    #[serde(skip, default = "default_cache_bytes")]
    pub cache_bytes: usize,
}

fn default_cache_bytes() -> usize {
    1_000_000_000
}

impl Default for SvmParams {
    /// LIBSVM's `c`, `tolerance` and weights, and 1 GB of cache; `gamma` is 0, which the training refuses, because it
    /// depends on the features.
    fn default() -> Self {
        Self {
            c: 1.0,
            gamma: 0.0,
            tolerance: 1e-3,
            weight_positive: 1.0,
            weight_negative: 1.0,
            cache_bytes: default_cache_bytes(),
        }
    }
}

/// A trained classifier: `f(x) = Σ_i y_i α_i exp(-gamma ‖x_i - x‖²) - rho`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RbfSvm {
    /// Width of the kernel, per squared unit of the features.
    pub gamma: f64,
    /// What is subtracted from the sum of kernels.
    pub rho: f64,
    /// Number of features of a sample.
    pub n_features: usize,
    /// `y_i α_i` of each support vector; positive for the positive class.
    pub dual_coefficients: Vec<f64>,
    /// The support vectors in the order of the training samples: row-major, n_support_vectors ×
    /// n_features.
    pub support_vectors: Vec<f64>,
}

impl RbfSvm {
    /// Decision value of one sample of `n_features` features; above 0 = the positive class.
    ///
    /// # Errors
    /// [`SvmError::FeatureCount`] or [`SvmError::NonFiniteFeature`] when the sample does not fit
    /// the model.
    pub fn decision_value(&self, features: &[f64]) -> Result<f64, SvmError> {
        if features.len() != self.n_features {
            return Err(SvmError::FeatureCount { expected: self.n_features, found: features.len() });
        }
        check_finite(features, self.n_features)?;
        let kernels: f64 = self
            .support_vectors
            .chunks_exact(self.n_features.max(1))
            .zip(&self.dual_coefficients)
            .map(|(support_vector, coefficient)| coefficient * rbf(self.gamma, support_vector, features))
            .sum();
        Ok(kernels - self.rho)
    }

    /// Number of support vectors.
    pub fn n_support_vectors(&self) -> usize {
        self.dual_coefficients.len()
    }

    /// Checks shapes and values of a model that was read from a file.
    ///
    /// # Errors
    /// [`SvmError::Model`] names the first thing that is wrong.
    pub fn validate(&self) -> Result<(), SvmError> {
        let wrong = |problem: String| Err(SvmError::Model { problem });
        let n_support_vectors = self.n_support_vectors();
        if !is_positive(self.gamma) {
            return wrong(format!("gamma is {}, expected a finite number above 0", self.gamma));
        }
        if !self.rho.is_finite() {
            return wrong(format!("rho is {}, expected a finite number", self.rho));
        }
        if self.n_features == 0 {
            return wrong("n_features is 0, expected at least 1".to_owned());
        }
        if n_support_vectors == 0 {
            return wrong("there is no support vector".to_owned());
        }
        if n_support_vectors.checked_mul(self.n_features) != Some(self.support_vectors.len()) {
            return wrong(format!(
                "support_vectors has {} values, expected {n_support_vectors} dual coefficients × {} features",
                self.support_vectors.len(),
                self.n_features
            ));
        }
        if let Some(index) = self.dual_coefficients.iter().position(|coefficient| !coefficient.is_finite()) {
            return wrong(format!("dual coefficient {index} is {}", self.dual_coefficients[index]));
        }
        if let Err(error) = check_finite(&self.support_vectors, self.n_features) {
            return wrong(format!("support vectors: {error}"));
        }
        Ok(())
    }
}

/// Why a classifier could not be trained, read or asked.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SvmError {
    /// A parameter is not a finite number above 0.
    #[error("{name} is {value}, expected a finite number above 0")]
    Parameter {
        /// Name of the parameter.
        name: &'static str,
        /// The value given.
        value: f64,
    },
    /// The training matrix is not n_labels × n_features with at least one feature.
    #[error("{n_values} feature values do not make {n_labels} samples (one a label) of {n_features} features")]
    Shape {
        /// Number of feature values given.
        n_values: usize,
        /// Number of labels given.
        n_labels: usize,
        /// Number of features given.
        n_features: usize,
    },
    /// A class has no sample.
    #[error("training needs samples of both classes, found {n_positive} positive and {n_negative} negative")]
    OneClass {
        /// Number of positive labels.
        n_positive: usize,
        /// Number of negative labels.
        n_negative: usize,
    },
    /// A feature is NaN or infinite.
    #[error("feature at row {row}, column {column} is {value}: every feature must be finite")]
    NonFiniteFeature {
        /// Index of the sample; 0 for a single one.
        row: usize,
        /// Index of the feature.
        column: usize,
        /// What was found there.
        value: f64,
    },
    /// A sample has another number of features than the model.
    #[error("the model takes {expected} features, found {found}")]
    FeatureCount {
        /// Number of features of the model.
        expected: usize,
        /// Number of features given.
        found: usize,
    },
    /// A model read from a file is not consistent.
    #[error("invalid SVM model: {problem}")]
    Model { problem: String },
}

fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

/// # Errors
/// [`SvmError::NonFiniteFeature`] for the first feature that is not finite.
pub fn check_finite(features: &[f64], n_features: usize) -> Result<(), SvmError> {
    match features.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(SvmError::NonFiniteFeature {
            row: index / n_features.max(1),
            column: index % n_features.max(1),
            value: features[index],
        }),
    }
}

fn rbf(gamma: f64, left: &[f64], right: &[f64]) -> f64 {
    libm::exp(-gamma * squared_distance(left, right))
}

/// ‖left - right‖². Eight sums side by side let the compiler use vector instructions, which a
/// single one forbids because it fixes the order of additions.
///
/// Squared norms computed beforehand would leave only a scalar product to do, but `‖x‖² + ‖z‖² - 2 x·z` cancels for
/// samples far from the origin. Training on 24,640 samples of 64 features was no faster with it (23 s against 21 s, 2
/// cores).
fn squared_distance(left: &[f64], right: &[f64]) -> f64 {
    let (left_blocks, left_rest) = left.as_chunks::<8>();
    let (right_blocks, right_rest) = right.as_chunks::<8>();
    let mut sums = [0.0; 8];
    for (left, right) in left_blocks.iter().zip(right_blocks) {
        for lane in 0..8 {
            let difference = left[lane] - right[lane];
            sums[lane] += difference * difference;
        }
    }
    let rest: f64 = left_rest.iter().zip(right_rest).map(|(left, right)| (left - right) * (left - right)).sum();
    ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7])) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_and_samples_are_checked() {
        let model = RbfSvm {
            gamma: 0.5,
            rho: 0.0,
            n_features: 2,
            dual_coefficients: vec![1.0, -1.0],
            support_vectors: vec![0.0, 1.0, 2.0, 3.0],
        };
        assert_eq!(model.validate(), Ok(()));
        assert_eq!(model.n_support_vectors(), 2);
        assert_eq!(model.decision_value(&[0.0]), Err(SvmError::FeatureCount { expected: 2, found: 1 }));
        assert!(matches!(
            model.decision_value(&[0.0, f64::NAN]),
            Err(SvmError::NonFiniteFeature { row: 0, column: 1, .. })
        ));
        let broken: [fn(&mut RbfSvm); 9] = [
            |model| model.gamma = 0.0,
            |model| model.gamma = f64::NAN,
            |model| model.rho = f64::INFINITY,
            |model| model.n_features = 0,
            |model| model.n_features = usize::MAX,
            |model| model.dual_coefficients[1] = f64::NAN,
            |model| model.support_vectors[3] = f64::NEG_INFINITY,
            |model| model.support_vectors.truncate(3),
            |model| (model.dual_coefficients, model.support_vectors) = (Vec::new(), Vec::new()),
        ];
        for (case, break_it) in broken.iter().enumerate() {
            let mut model = model.clone();
            break_it(&mut model);
            assert!(matches!(model.validate(), Err(SvmError::Model { .. })), "case {case}");
            // Even unchecked, a broken model answers something rather than panic.
            let _ = model.decision_value(&vec![0.0; model.n_features.min(4)]);
        }
    }
}
