//! Platt scaling: from the decision value of a classifier to a probability.
//!
//! The paper thresholds the decision value and stops there; a probability is what a lift can be
//! decided by. The method is Platt's sigmoid (1999). The crate `learning` fits it.

use serde::{Deserialize, Serialize};

/// The sigmoid `P(positive | f) = 1 / (1 + exp(a f + b))` of a decision value `f`; `a` is negative
/// when larger decision values speak for the positive class.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlattCalibration {
    /// Slope, per unit of decision value.
    pub a: f64,
    /// Offset, dimensionless.
    pub b: f64,
}

impl PlattCalibration {
    /// Probability of the positive class, in 0..=1; never NaN for a finite decision value and a
    /// valid calibration.
    pub fn probability(&self, decision_value: f64) -> f64 {
        positive_probability(self.a * decision_value + self.b)
    }

    /// Checks a calibration that was read from a file.
    ///
    /// # Errors
    /// When `a` or `b` is NaN or infinite.
    pub fn validate(&self) -> Result<(), CalibrationError> {
        if self.a.is_finite() && self.b.is_finite() { Ok(()) } else { Err(CalibrationError { a: self.a, b: self.b }) }
    }
}

/// A calibration whose parameters are not numbers: a damaged file, or decision values too close together to be told apart.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("calibration parameters a = {a}, b = {b}: both must be finite")]
pub struct CalibrationError {
    /// The slope.
    pub a: f64,
    /// The offset.
    pub b: f64,
}

/// `1 / (1 + exp(z))` without overflow.
pub fn positive_probability(z: f64) -> f64 {
    let e = libm::exp(-z.abs());
    if z >= 0.0 { e / (1.0 + e) } else { 1.0 / (1.0 + e) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probability_is_monotone_and_never_nan() {
        let calibration = PlattCalibration { a: -3.0, b: 0.2 };
        let values = [f64::MIN, -1e300, -1e3, -2.0, -1e-300, 0.0, 1e-300, 2.0, 1e3, 1e300, f64::MAX];
        let probabilities: Vec<f64> = values.iter().map(|&value| calibration.probability(value)).collect();
        assert!(probabilities.windows(2).all(|pair| pair[0] <= pair[1]), "{probabilities:?}");
        assert_eq!((probabilities[0], probabilities[10]), (0.0, 1.0));
        assert!((calibration.probability(0.2 / 3.0) - 0.5).abs() < 1e-15);
    }

    #[test]
    fn parameters_must_be_finite() {
        assert!(PlattCalibration { a: f64::NAN, b: 0.0 }.validate().is_err());
        assert!(PlattCalibration { a: -1.0, b: 0.0 }.validate().is_ok());
    }
}
