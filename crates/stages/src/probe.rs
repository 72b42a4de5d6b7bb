//! Judges a grasp after a probe: from the reading that decides and from the readings before it.
//!
//! A probe is a small movement that shows more of a grasp: the hand tightens to the force of a lift, and then the arm may lift
//! by a few millimetres and rest. The load that arrives on the fingers, moves over their cells or goes away again says
//! more about the lift than the settled grasp does (Chebotar et al., "Self-supervised regrasping using spatio-temporal tactile
//! features and reinforcement learning", 2016, predict from the early lift). [`ProbeModel`] takes the feature of the frame,
//! that of the last frame of the phase before, and their difference.
//!
//! Pure: no clock, no I/O. [`GraspHistory`] is the state.

use serde::{Deserialize, Serialize};

use crate::classifier::{Classifier, Verdict};
use crate::encoder::FeatureExtractor;
use crate::out_of_distribution::TrainingRange;
use blindgrasp_messages::{Fault, Phase};

/// What is learned of the readings after a probe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbeModel {
    /// It takes the values of [`GraspHistory::compose`].
    pub classifier: Classifier,
    /// What the frames look like that decide.
    #[serde(rename = "domain")]
    pub training_range: TrainingRange,
    /// Area under the ROC curve over folds of objects.
    pub cross_validated_roc_area: f64,
    /// Expected calibration error over the same folds.
    pub cross_validated_ece: f64,
}

impl ProbeModel {
    /// Checks a probe that was read from a file.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(crate) fn validate(&self, features: &FeatureExtractor) -> Result<(), String> {
        self.training_range.validate(features).map_err(|error| format!("the training range: {error}"))?;
        self.classifier.validate(n_values(features))
    }
}

/// Values that a probe's classifier takes.
pub fn n_values(features: &FeatureExtractor) -> usize {
    3 * features.len()
}

/// The features of the open grasp from which a probe is judged.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GraspHistory {
    /// Epoch and number of the grasp.
    grasp: Option<(u64, u64)>,
    /// The last feature of the settled hand.
    settled: Vec<f64>,
    /// The last feature of the tight hand, before the arm moved.
    squeezed: Vec<f64>,
}

impl GraspHistory {
    /// Takes the feature of the next frame; a frame without one has no values.
    pub fn add(&mut self, epoch: u64, grasp_id: u64, phase: Phase, values: &[f64]) {
        if self.grasp != Some((epoch, grasp_id)) {
            self.grasp = Some((epoch, grasp_id));
            self.settled.clear();
            self.squeezed.clear();
        }
        let kept = match phase {
            Phase::Settled => &mut self.settled,
            Phase::Squeezed => &mut self.squeezed,
            // The hand has moved again.
            Phase::Open | Phase::Closing => {
                self.settled.clear();
                self.squeezed.clear();
                return;
            }
            _ => return,
        };
        kept.clear();
        kept.extend_from_slice(values);
    }

    /// Writes the values from which a frame of the grasp is judged: the feature of the phase before, the frame's own, and
    /// how it differs.
    ///
    /// # Errors
    /// [`Fault::MissingReading`] if the phase before had no feature.
    pub fn compose(&self, phase: Phase, values: &[f64], composed: &mut Vec<f64>) -> Result<(), Fault> {
        composed.clear();
        let before = if phase == Phase::Squeezed { &self.settled } else { &self.squeezed };
        if before.len() != values.len() {
            return Err(Fault::MissingReading);
        }
        composed.extend_from_slice(before);
        composed.extend_from_slice(values);
        composed.extend(values.iter().zip(before).map(|(now, before)| now - before));
        Ok(())
    }

    /// # Errors
    /// As [`GraspHistory::compose`], and as [`Classifier::classify`].
    pub(crate) fn judge(&self, probe: &ProbeModel, phase: Phase, values: &[f64]) -> Result<Verdict, Fault> {
        let mut composed = Vec::with_capacity(3 * values.len());
        self.compose(phase, values, &mut composed)?;
        probe.classifier.classify(&composed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reading_is_compared_with_the_phase_before_of_the_same_grasp() {
        let mut history = GraspHistory::default();
        let mut composed = Vec::new();
        history.add(0, 7, Phase::Settled, &[1.0, 2.0]);
        history.add(0, 7, Phase::Settled, &[1.0, 3.0]);
        history.add(0, 7, Phase::Squeezing, &[9.0, 9.0]);
        assert_eq!(history.compose(Phase::Squeezed, &[2.0, 5.0], &mut composed), Ok(()));
        assert_eq!(composed, [1.0, 3.0, 2.0, 5.0, 1.0, 2.0]);
        assert_eq!(history.compose(Phase::TestLifted, &[2.0, 5.0], &mut composed), Err(Fault::MissingReading));
        history.add(0, 7, Phase::Squeezed, &[2.0, 5.0]);
        assert_eq!(history.compose(Phase::TestLifted, &[2.0, 4.0], &mut composed), Ok(()));
        assert_eq!(composed[4..], [0.0, -1.0]);
        // A hand that closes again, another grasp, and the same number of a source that began anew have no history.
        for (epoch, grasp_id, phase) in [(0, 7, Phase::Closing), (0, 8, Phase::Settled), (1, 7, Phase::Settled)] {
            let mut other = history.clone();
            other.add(epoch, grasp_id, phase, &[0.0, 0.0]);
            assert_eq!(other.compose(Phase::TestLifted, &[2.0, 4.0], &mut composed), Err(Fault::MissingReading));
        }
        // A frame without a feature leaves none behind.
        history.add(0, 7, Phase::Squeezed, &[]);
        assert_eq!(history.compose(Phase::TestLifted, &[2.0, 4.0], &mut composed), Err(Fault::MissingReading));
    }
}
