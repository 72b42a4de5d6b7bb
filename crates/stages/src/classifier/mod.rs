//! The classifier stage: from a feature to a calibrated probability that the grasp is stable.
//!
//! The paper uses an RBF support vector machine (Dang & Allen, section IV-D); boosted trees decide better. A Platt
//! calibration turns the decision value of either into a probability.

pub mod boosting;
pub mod calibration;
pub mod loads;
pub mod svm;

use serde::{Deserialize, Serialize};

use blindgrasp_messages::Fault;
use boosting::BoostedTrees;
use calibration::{PlattCalibration, positive_probability};
use loads::LoadRule;
use svm::{PreparedSvm, SvmError};

/// A trained function from a feature to a decision value, above 0 on the stable side.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Predictor {
    /// A support vector machine with an RBF kernel; the positive class is "stable".
    Svm(PreparedSvm),
    Boosting(BoostedTrees),
    Blend(Blend),
    /// Nothing is learned.
    Loads(LoadRule),
}

/// Boosted trees and a support vector machine on the same feature.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Blend {
    pub trees: BoostedTrees,
    pub svm: PreparedSvm,
    /// Factor on the SVM's decision value before it is added to that of the trees.
    pub svm_weight: f64,
}

impl Predictor {
    /// Values of a feature.
    pub fn n_features(&self) -> usize {
        match self {
            Predictor::Svm(svm) => svm.n_features,
            Predictor::Boosting(trees) => trees.n_features,
            Predictor::Blend(blend) => blend.trees.n_features,
            Predictor::Loads(rule) => rule.n_features,
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
            Predictor::Svm(svm) => svm.decision_value(values).map_err(|_| Fault::InvalidValue),
            Predictor::Boosting(trees) => Ok(trees.decision_value(values)),
            Predictor::Blend(Blend { trees, svm, svm_weight }) => {
                let of_svm = svm.decision_value(values).map_err(|_| Fault::InvalidValue)?;
                Ok(trees.decision_value(values) + svm_weight * of_svm)
            }
            Predictor::Loads(rule) => Ok(rule.decision_value(values)),
        }
    }

    /// The decision value of each feature; `rows` holds one feature after the other.
    ///
    /// # Errors
    /// An incomplete last row, or a value that is not finite.
    pub fn decision_values(&self, rows: &[f64]) -> Result<Vec<f64>, SvmError> {
        let of_trees =
            |trees: &BoostedTrees| rows.chunks(trees.n_features).map(|row| trees.decision_value(row)).collect();
        match self {
            Predictor::Svm(svm) => svm.decision_values(rows),
            Predictor::Boosting(trees) => Ok(of_trees(trees)),
            Predictor::Blend(Blend { trees, svm, svm_weight }) => {
                let of_trees: Vec<f64> = of_trees(trees);
                Ok(of_trees
                    .iter()
                    .zip(svm.decision_values(rows)?)
                    .map(|(trees, svm)| trees + svm_weight * svm)
                    .collect())
            }
            Predictor::Loads(rule) => Ok(rows.chunks(rule.n_features).map(|row| rule.decision_value(row)).collect()),
        }
    }

    /// Checks a predictor that was read from a file.
    ///
    /// # Errors
    /// A description of the first problem.
    pub fn validate(&self) -> Result<(), String> {
        let check_svm = |svm: &PreparedSvm| svm.validate().map_err(|error| format!("the SVM: {error}"));
        let check_trees =
            |trees: &BoostedTrees| trees.validate().map_err(|error| format!("the boosted trees: {error}"));
        match self {
            Predictor::Svm(svm) => check_svm(svm),
            Predictor::Boosting(trees) => check_trees(trees),
            Predictor::Loads(rule) => rule.validate(),
            Predictor::Blend(Blend { trees, svm, svm_weight }) => {
                check_svm(svm)?;
                check_trees(trees)?;
                if svm.n_features != trees.n_features || !(svm_weight.is_finite() && *svm_weight >= 0.0) {
                    return Err(format!(
                        "the SVM takes {} values and the trees {}, its weight is {svm_weight}: expected equal numbers \
                         and a weight of at least 0",
                        svm.n_features, trees.n_features
                    ));
                }
                Ok(())
            }
        }
    }

    /// A short description for people.
    pub fn summary(&self) -> String {
        let of_svm =
            |svm: &PreparedSvm| format!("RBF SVM, gamma {}, {} support vectors", svm.gamma, svm.n_support_vectors());
        let of_trees = |trees: &BoostedTrees| format!("{} boosted trees, {} nodes", trees.trees.len(), trees.n_nodes());
        match self {
            Predictor::Svm(svm) => of_svm(svm),
            Predictor::Boosting(trees) => of_trees(trees),
            Predictor::Blend(Blend { trees, svm, svm_weight }) => {
                format!("{} + {svm_weight} x {}", of_trees(trees), of_svm(svm))
            }
            Predictor::Loads(rule) => rule.summary(),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Classifier {
    pub predictor: Predictor,
    pub calibration: PlattCalibration,
    /// A grasp counts as stable when its probability is at least this; 1 is never reached.
    pub threshold_probability: f64,
    /// The classifier is unsure from this probability up to the threshold. Below it the grasp counts as unstable. It is
    /// at most the threshold.
    pub unsure_from_probability: f64,
}

/// The classifier's result for a feature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Verdict {
    /// Above 0 on the stable side.
    pub decision_value: f64,
    /// Calibrated probability that the grasp is stable.
    pub probability_stable: f64,
    /// Whether the probability reaches the threshold.
    pub stable: bool,
    /// Whether the probability is below the threshold for stable, but not below the one for unstable.
    pub unsure: bool,
}

impl Classifier {
    /// Checks a classifier that was read from a file and takes `n_values`.
    ///
    /// # Errors
    /// The first problem found.
    pub(crate) fn validate(&self, n_values: usize) -> Result<(), String> {
        self.predictor.validate()?;
        if self.predictor.n_features() != n_values {
            return Err(format!(
                "the classifier takes {} values, a feature has {n_values}",
                self.predictor.n_features()
            ));
        }
        self.calibration.validate().map_err(|error| format!("the calibration: {error}"))?;
        if self.calibration.a >= 0.0 {
            return Err(
                "the calibration is upside down or flat: expected a < 0, stable for large decision values".into()
            );
        }
        let (threshold, unsure_from) = (self.threshold_probability, self.unsure_from_probability);
        if !(threshold > 0.0 && threshold <= 1.0 && unsure_from >= 0.0 && unsure_from <= threshold) {
            return Err(format!(
                "threshold_probability is {threshold}, expected more than 0, at most 1; unsure_from_probability is \
                 {unsure_from}, expected 0 to the threshold"
            ));
        }
        Ok(())
    }

    /// The log-odds of "stable" of a decision value.
    pub fn log_odds(&self, decision_value: f64) -> f64 {
        -(self.calibration.a * decision_value + self.calibration.b)
    }

    /// # Errors
    /// The fault: [`Fault::WrongLength`], or [`Fault::InvalidValue`] for a value that is not finite.
    pub fn classify(&self, values: &[f64]) -> Result<Verdict, Fault> {
        self.classify_by((self.calibration, self.threshold_probability, self.unsure_from_probability), values)
    }

    /// [`Classifier::classify`] with another calibration and other thresholds, for stable and for unsure.
    pub(crate) fn classify_by(
        &self,
        (calibration, threshold_probability, unsure_from_probability): (PlattCalibration, f64, f64),
        values: &[f64],
    ) -> Result<Verdict, Fault> {
        let decision_value = self.predictor.decision_value(values)?;
        let probability_stable = calibration.probability(decision_value);
        verdict(decision_value, probability_stable, threshold_probability, unsure_from_probability)
    }

    /// The verdict of a decision value whose log-odds are corrected.
    pub(crate) fn verdict(&self, decision_value: f64, log_odds: f64) -> Result<Verdict, Fault> {
        let probability = positive_probability(-log_odds);
        verdict(decision_value, probability, self.threshold_probability, self.unsure_from_probability)
    }
}

fn verdict(
    decision_value: f64,
    probability_stable: f64,
    threshold_probability: f64,
    unsure_from_probability: f64,
) -> Result<Verdict, Fault> {
    if !(decision_value.is_finite() && probability_stable.is_finite()) {
        return Err(Fault::InvalidValue);
    }
    // A probability of 1 is a rounded one.
    let stable = probability_stable >= threshold_probability && threshold_probability < 1.0;
    let unsure = !stable && probability_stable >= unsure_from_probability;
    Ok(Verdict { decision_value, probability_stable, stable, unsure })
}

#[cfg(test)]
mod tests {
    use super::boosting::Tree;
    use super::svm::RbfSvm;
    use super::*;

    fn blend(svm_weight: f64) -> Predictor {
        let split = Tree::stump(1, 0.5, [-1.0, 1.0]);
        let trees = BoostedTrees { n_features: 2, base: 0.25, trees: vec![split] };
        let svm = RbfSvm {
            gamma: 1.0,
            rho: 0.5,
            n_features: 2,
            support_vectors: vec![0.0, 0.0],
            dual_coefficients: vec![2.0],
        };
        Predictor::Blend(Blend { trees, svm: svm.try_into().expect("valid"), svm_weight })
    }

    #[test]
    fn a_blend_adds_both_decision_values() {
        // Trees: 0.25 + 1; SVM: 2 exp(-1) - 0.5, weighed with 3.
        let expected = 1.25 + 3.0 * (2.0 * libm::exp(-1.0) - 0.5);
        let predictor = blend(3.0);
        predictor.validate().expect("valid");
        let one = predictor.decision_value(&[0.0, 1.0]).expect("a value");
        assert!((one - expected).abs() < 1e-12);
        let several = predictor.decision_values(&[0.0, 1.0, 0.0, 0.0]).expect("values");
        assert!(
            (several[0] - expected).abs() < 1e-12 && (several[1] - (0.25 - 1.0 + 4.5)).abs() < 1e-12,
            "{several:?}"
        );
        assert_eq!(predictor.decision_value(&[0.0]), Err(Fault::WrongLength));
        assert_eq!(predictor.decision_value(&[0.0, f64::NAN]), Err(Fault::InvalidValue));
        for bad in [f64::NAN, -1.0] {
            assert!(blend(bad).validate().is_err());
        }
    }
}
