//! Fits Platt's sigmoid, which makes probabilities of decision values, as in Lin, Lin and Weng, "A note on Platt's
//! probabilistic outputs for support vector machines" (2007).
//!
//! It does not choose the data: decision values of samples the classifier was trained on are too confident, so pass
//! those of held-out samples (cross-validation within the training set).

use blindgrasp_stages::classifier::calibration::{CalibrationError, PlattCalibration, positive_probability};
use thiserror::Error;

/// Why a calibration could not be fitted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlattError {
    /// A class has no sample, so nothing says where the classes meet.
    #[error("calibration needs samples of both classes, found {n_positive} positive and {n_negative} negative")]
    OneClass {
        /// Number of positive labels.
        n_positive: usize,
        /// Number of negative labels.
        n_negative: usize,
    },
    /// A decision value is NaN or infinite.
    #[error("decision value {index} is {value}: every decision value must be finite")]
    NonFiniteDecisionValue {
        /// Index of the decision value.
        index: usize,
        /// What was found there.
        value: f64,
    },
    /// The decision values are too close together to be told apart.
    #[error(transparent)]
    Parameters(#[from] CalibrationError),
    /// Newton's method did not reach the minimum.
    #[error(
        "calibration did not converge: the gradient per sample is still {gradient:e}; look for extreme decision values"
    )]
    NotConverged {
        /// Largest component of the gradient over standardised decision values, divided by the
        /// number of samples.
        gradient: f64,
    },
}

/// Fits Platt's sigmoid to decision values and their labels (`true` = the positive class).
///
/// Minimises the cross-entropy between the sigmoid and the targets
/// `(n_positive + 1) / (n_positive + 2)` for positive and `1 / (n_negative + 2)` for negative
/// samples. These are not quite 1 and 0, so the minimum exists and is finite also when the decision
/// values separate the classes perfectly.
///
/// # Errors
/// When a class is missing, a decision value is not finite, or the fit itself
/// fails.
pub fn fit_platt(decision_values: &[f64], labels: &[bool]) -> Result<PlattCalibration, PlattError> {
    let n_positive = labels.iter().filter(|&&positive| positive).count();
    let n_negative = labels.len() - n_positive;
    if n_positive == 0 || n_negative == 0 {
        return Err(PlattError::OneClass { n_positive, n_negative });
    }
    if let Some((index, &value)) = decision_values.iter().enumerate().find(|(_, value)| !value.is_finite()) {
        return Err(PlattError::NonFiniteDecisionValue { index, value });
    }

    let scaling = Standardisation::of(decision_values);
    let (n_positive, n_negative) = (n_positive as f64, n_negative as f64);
    let positive_target = (n_positive + 1.0) / (n_positive + 2.0);
    let negative_target = 1.0 / (n_negative + 2.0);
    let samples: Vec<Sample> = decision_values
        .iter()
        .zip(labels)
        .map(|(&value, &positive)| Sample {
            value: scaling.apply(value),
            target: if positive { positive_target } else { negative_target },
        })
        .collect();
    let standardised = minimise_cross_entropy(
        &samples,
        PlattCalibration { a: 0.0, b: ((n_negative + 1.0) / (n_positive + 1.0)).ln() },
    )?;
    let calibration = scaling.undo(standardised);
    calibration.validate()?;
    Ok(calibration)
}

/// Newton steps allowed; quadratic convergence needs about ten.
const MAX_ITERATIONS: usize = 100;
/// The shortest Newton step tried before the line search gives up (Lin, Lin and Weng).
const MIN_STEP: f64 = 1e-10;
/// The share of the predicted decrease that a step must bring (Lin, Lin and Weng).
const SUFFICIENT_DECREASE: f64 = 1e-4;
/// Added to the diagonal of the Hessian per sample, which is singular when all decision values are
/// equal.
const RIDGE: f64 = 1e-12;
/// The gradient per sample at which the fit stops. Lin, Lin and Weng stop at 1e-5 for the whole sum. Newton's method
/// gets from there to just above rounding in a step or two, and then the result no longer depends on the order of the
/// samples.
const GRADIENT_TOLERANCE: f64 = 1e-12;
/// The gradient per sample that is still accepted when rounding keeps the line search from
/// descending further.
const ACCEPTED_GRADIENT: f64 = 1e-6;

/// A decision value, standardised, and its target probability.
struct Sample {
    value: f64,
    target: f64,
}

/// Decision values as `(f / magnitude - mean) / spread`: Newton's method then sees the same problem
/// whatever the scale and the offset of the classifier. Dividing by the magnitude first keeps mean
/// and spread from overflowing.
struct Standardisation {
    magnitude: f64,
    mean: f64,
    spread: f64,
}

impl Standardisation {
    fn of(values: &[f64]) -> Self {
        let one_if_zero = |x: f64| if x > 0.0 { x } else { 1.0 };
        let n = values.len() as f64;
        let magnitude = one_if_zero(values.iter().fold(0.0, |largest: f64, value| largest.max(value.abs())));
        let mean = values.iter().map(|value| value / magnitude).sum::<f64>() / n;
        let variance = values.iter().map(|value| (value / magnitude - mean).powi(2)).sum::<f64>() / n;
        Self { magnitude, mean, spread: one_if_zero(variance.sqrt()) }
    }

    fn apply(&self, value: f64) -> f64 {
        (value / self.magnitude - self.mean) / self.spread
    }

    fn undo(&self, standardised: PlattCalibration) -> PlattCalibration {
        let a = standardised.a / self.spread;
        PlattCalibration { a: a / self.magnitude, b: standardised.b - a * self.mean }
    }
}

fn minimise_cross_entropy(samples: &[Sample], start: PlattCalibration) -> Result<PlattCalibration, PlattError> {
    let n = samples.len() as f64;
    let mut current = start;
    let mut value = cross_entropy(samples, current);
    let mut gradient = f64::INFINITY;
    for _ in 0..MAX_ITERATIONS {
        // With z = a f + b: dF/dz = target - p and d2F/dz2 = p (1 - p).
        let (mut gradient_a, mut gradient_b) = (0.0, 0.0);
        let (mut h_aa, mut h_ab, mut h_bb) = (RIDGE * n, 0.0, RIDGE * n);
        for sample in samples {
            let z = current.a * sample.value + current.b;
            let (p, not_p) = (positive_probability(z), positive_probability(-z));
            let (first, second) = (sample.target - p, p * not_p);
            gradient_a += sample.value * first;
            gradient_b += first;
            h_aa += sample.value * sample.value * second;
            h_ab += sample.value * second;
            h_bb += second;
        }
        gradient = gradient_a.abs().max(gradient_b.abs()) / n;
        if gradient <= GRADIENT_TOLERANCE {
            return Ok(current);
        }
        let determinant = h_aa * h_bb - h_ab * h_ab;
        let direction_a = -(h_bb * gradient_a - h_ab * gradient_b) / determinant;
        let direction_b = -(h_aa * gradient_b - h_ab * gradient_a) / determinant;
        let slope = gradient_a * direction_a + gradient_b * direction_b;

        let mut step = 1.0;
        let descended = loop {
            let tried = PlattCalibration { a: current.a + step * direction_a, b: current.b + step * direction_b };
            let tried_value = cross_entropy(samples, tried);
            if tried_value < value + SUFFICIENT_DECREASE * step * slope {
                break Some((tried, tried_value));
            }
            step /= 2.0;
            if step < MIN_STEP {
                break None;
            }
        };
        match descended {
            Some((tried, tried_value)) => (current, value) = (tried, tried_value),
            None => break,
        }
    }
    if gradient <= ACCEPTED_GRADIENT { Ok(current) } else { Err(PlattError::NotConverged { gradient }) }
}

/// `-Σ t ln p + (1 - t) ln (1 - p)`, in the form of Lin, Lin and Weng that neither overflows nor
/// cancels.
fn cross_entropy(samples: &[Sample], calibration: PlattCalibration) -> f64 {
    samples
        .iter()
        .map(|sample| {
            let z = calibration.a * sample.value + calibration.b;
            let weight = if z >= 0.0 { sample.target } else { sample.target - 1.0 };
            weight * z + (-z.abs()).exp().ln_1p()
        })
        .sum()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    /// Labels whose share at each decision value is what the sigmoid says: 1,000 samples a value.
    fn samples_of(truth: PlattCalibration) -> (Vec<f64>, Vec<bool>) {
        let mut values = Vec::new();
        let mut labels = Vec::new();
        for step in -20..=20 {
            let value = f64::from(step) * 0.1;
            let n_positive = (1000.0 * truth.probability(value)).round() as usize;
            for sample_idx in 0..1000 {
                values.push(value);
                labels.push(sample_idx < n_positive);
            }
        }
        (values, labels)
    }

    #[test]
    fn recovers_a_known_sigmoid() {
        for truth in [PlattCalibration { a: -2.0, b: 0.3 }, PlattCalibration { a: 1.5, b: -0.7 }] {
            let (values, labels) = samples_of(truth);
            let fitted = fit_platt(&values, &labels).unwrap();
            assert!((fitted.a - truth.a).abs() < 0.01, "{fitted:?}");
            assert!((fitted.b - truth.b).abs() < 0.01, "{fitted:?}");
        }
    }

    #[test]
    fn agrees_with_scikit_learn() {
        // sklearn.calibration._sigmoid_calibration of scikit-learn 1.9.1 on the same six samples;
        // it stops at 1e-6.
        let (a, b) = (-1.065_188_5, 0.028_476_6);
        let values = [-1.5, -0.5, 0.2, -0.1, 0.6, 1.4];
        let labels = [false, false, false, true, true, true];
        let fitted = fit_platt(&values, &labels).unwrap();
        assert!((fitted.a - a).abs() < 1e-5, "{fitted:?}");
        assert!((fitted.b - b).abs() < 1e-5, "{fitted:?}");
    }

    #[test]
    fn scale_and_offset_of_the_decision_value_and_order_of_the_samples_change_nothing() {
        let (values, labels) = samples_of(PlattCalibration { a: -2.0, b: 0.3 });
        let reference = fit_platt(&values, &labels).unwrap();
        for (scale, offset) in [(1e-9, 0.0), (1e9, 0.0), (1.0, 1e4), (-3.0, 2.0), (1e300, 0.0), (1e-300, 0.0)] {
            let moved: Vec<f64> = values.iter().map(|value| value * scale + offset).collect();
            let fitted = fit_platt(&moved, &labels).unwrap();
            for (value, moved) in values.iter().zip(&moved) {
                let difference = fitted.probability(*moved) - reference.probability(*value);
                assert!(difference.abs() < 1e-7, "{scale} {offset}: {difference}");
            }
        }
        let reversed: (Vec<f64>, Vec<bool>) = values.into_iter().zip(labels).rev().unzip();
        let fitted = fit_platt(&reversed.0, &reversed.1).unwrap();
        assert!((fitted.a - reference.a).abs() < 1e-9 && (fitted.b - reference.b).abs() < 1e-9);
    }

    #[test]
    fn perfectly_separable_values_stay_finite() {
        for (n_negative, n_positive) in [(1, 1), (5, 5), (3, 2000)] {
            let mut values = vec![-1.0; n_negative];
            values.extend(vec![1.0; n_positive]);
            let labels: Vec<bool> = values.iter().map(|&value| value > 0.0).collect();
            let fitted = fit_platt(&values, &labels).unwrap();
            // Two distinct values: the sigmoid can meet both smoothed targets exactly.
            let (n_negative, n_positive) = (n_negative as f64, n_positive as f64);
            assert!((fitted.probability(1.0) - (n_positive + 1.0) / (n_positive + 2.0)).abs() < 1e-8, "{fitted:?}");
            assert!((fitted.probability(-1.0) - 1.0 / (n_negative + 2.0)).abs() < 1e-8, "{fitted:?}");
        }
    }

    #[test]
    fn equal_decision_values_give_the_prior() {
        let fitted = fit_platt(&[0.7; 4], &[true, false, false, false]).unwrap();
        // The mean of the targets: (2/3 + 3 * 1/5) / 4.
        let mean_target = (2.0 / 3.0 + 3.0 / 5.0) / 4.0;
        assert!((fitted.probability(0.7) - mean_target).abs() < 1e-8, "{fitted:?}");
    }

    #[test]
    fn errors_say_what_is_wrong() {
        assert_eq!(fit_platt(&[], &[]), Err(PlattError::OneClass { n_positive: 0, n_negative: 0 }));
        assert_eq!(fit_platt(&[1.0, 2.0], &[true; 2]), Err(PlattError::OneClass { n_positive: 2, n_negative: 0 }));
        assert_eq!(
            fit_platt(&[1.0, f64::INFINITY], &[true, false]),
            Err(PlattError::NonFiniteDecisionValue { index: 1, value: f64::INFINITY })
        );
    }
}
