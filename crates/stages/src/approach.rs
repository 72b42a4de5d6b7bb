//! How often lifts keep their object after an approach, before anything is touched.
//!
//! The arm knows which way is down, and the hand its preshape. Both say something of how a grasp will hold: fingers beside an
//! object hold it better than fingers above and below it.
//!
//! Pure: no clock, no I/O, no state.

use serde::{Deserialize, Serialize};

use crate::classifier::boosting::BoostedTrees;
use crate::classifier::calibration::PlattCalibration;

/// A learned probability over approaches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ApproachPrior {
    /// Indices of the joints that are set before the hand closes.
    pub preshape_idxs: Vec<usize>,
    /// Of [`ApproachPrior::values`].
    pub trees: BoostedTrees,
    pub calibration: PlattCalibration,
    /// Area under the ROC curve over folds of objects.
    pub cross_validated_roc_area: f64,
}

impl ApproachPrior {
    /// The numbers that describe an approach: the direction of gravity in the palm frame, a unit vector, and the preshape
    /// joints, radians. `None` if a joint is missing or gravity has no direction.
    pub fn values(preshape_idxs: &[usize], gravity: [f64; 3], joints: &[f64]) -> Option<Vec<f64>> {
        let norm = gravity.iter().map(|part| part * part).sum::<f64>().sqrt();
        let down = gravity.iter().map(|part| part / norm).filter(|part| part.is_finite());
        let preshape = preshape_idxs.iter().filter_map(|idx| joints.get(*idx)).copied();
        let values: Vec<f64> = down.chain(preshape).collect();
        (values.len() == 3 + preshape_idxs.len()).then_some(values)
    }

    /// The probability that a lift after this approach keeps the object.
    ///
    /// * `gravity` - in the palm frame; only its direction counts.
    /// * `joints` - the open hand's, in its order.
    pub fn probability_kept(&self, gravity: [f64; 3], joints: &[f64]) -> Option<f64> {
        let values = ApproachPrior::values(&self.preshape_idxs, gravity, joints)?;
        Some(self.calibration.probability(self.trees.decision_value(&values)))
    }

    /// Checks a prior that was read from a file.
    ///
    /// # Errors
    /// The first problem found.
    pub(crate) fn validate(&self, n_joints: usize) -> Result<(), String> {
        self.trees.validate().map_err(|error| error.to_string())?;
        self.calibration.validate().map_err(|error| error.to_string())?;
        let n_values = 3 + self.preshape_idxs.len();
        if self.trees.n_features != n_values || self.preshape_idxs.iter().any(|idx| *idx >= n_joints) {
            return Err(format!("{} values, expected {n_values}, of joints of the hand", self.trees.n_features));
        }
        Ok(())
    }
}
