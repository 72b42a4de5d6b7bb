//! How well a model judges a grasp at each look: when the hand has settled, and after each probe.

use std::collections::BTreeMap;

use serde::Serialize;

use super::measures::{area_under_roc, curve};
use super::reliability::{N_RELIABILITY_BINS, reliability};
use crate::training::{Attempted, Example, LOOKS, Thresholds, threshold_curve, values_at};
use blindgrasp_messages::Phase;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::training_summary::ThresholdPoint;

/// The judgement of the grasps that have this look.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Look {
    /// The phase whose frame is judged.
    pub look: String,
    pub n_grasps: usize,
    pub n_stable: usize,
    /// `None` if all grasps are stable, or none.
    pub roc_area: Option<f64>,
    /// Expected calibration error.
    pub ece: f64,
    /// Grasps that the model's thresholds lift: promising at the looks before, and stable at this one.
    pub n_lifted: usize,
    /// Stable ones of these.
    pub n_kept: usize,
}

/// A look at all grasps.
pub(super) struct JudgedLook {
    pub(super) phase: Phase,
    threshold: f64,
    /// The probability of each grasp; `None` if it has no such look.
    pub(super) probabilities: Vec<Option<f64>>,
    /// Whether each grasp was promising at all looks before.
    is_promising: Vec<bool>,
}

impl JudgedLook {
    /// Whether the model's thresholds lift a grasp.
    pub(super) fn lifts(&self, idx: usize) -> bool {
        self.is_promising[idx] && self.probabilities[idx] >= Some(self.threshold)
    }

    /// What thresholds of this look lead to, the model's own among them. Those of the looks before stay.
    pub(super) fn curve(&self, examples: &[Example]) -> Vec<ThresholdPoint> {
        let mut objects = BTreeMap::new();
        let mut grasps = Vec::new();
        for (idx, example) in examples.iter().enumerate() {
            let n_objects = objects.len();
            grasps.push(Attempted {
                object: *objects.entry(&example.object).or_insert(n_objects),
                fold: 0,
                settled: f64::from(u8::from(self.is_promising[idx])),
                squeezed: 1.0,
                decided: self.probabilities[idx],
                stable: example.stable,
            });
        }
        let own = Thresholds { promising: 1.0, promising_squeezed: 0.0, lift: self.threshold };
        threshold_curve(&grasps, own, self.phase)
    }
}

/// The looks that the model has, in order.
pub(super) fn judged_looks(model: &Model, examples: &[Example]) -> Vec<JudgedLook> {
    let mut is_promising = vec![true; examples.len()];
    let mut looks = Vec::new();
    for phase in LOOKS {
        let of_phase = if phase == Phase::Settled { Some(&model.classifier) } else { model.look(phase) };
        let Some(classifier) = of_phase else { continue };
        let judge = |example| {
            let decision_value = classifier.predictor.decision_value(&values_at(model, phase, example)?).ok()?;
            Some(classifier.calibration.probability(decision_value))
        };
        let probabilities: Vec<Option<f64>> = examples.iter().map(judge).collect();
        let threshold = classifier.threshold_probability;
        let judged = JudgedLook { phase, threshold, probabilities, is_promising: is_promising.clone() };
        for (is_promising, probability) in is_promising.iter_mut().zip(&judged.probabilities) {
            *is_promising &= *probability >= Some(classifier.unsure_from_probability);
        }
        looks.push(judged);
    }
    looks
}

/// One entry for each look that some grasp has, in order; empty for a model without probes. Whether a grasp is unlike the training
/// data is not considered, nor are votes: the graph lifts fewer.
pub fn looks(model: &Model, examples: &[Example]) -> Vec<Look> {
    if model.squeezed.is_none() && model.test_lifted.is_none() {
        return Vec::new();
    }
    let looks = judged_looks(model, examples);
    looks.iter().map(|judged| Look::of(judged, examples)).filter(|look| look.n_grasps > 0).collect()
}

impl Look {
    fn of(judged: &JudgedLook, examples: &[Example]) -> Look {
        let (mut probabilities, mut stable, mut n_lifted, mut n_kept) = (Vec::new(), Vec::new(), 0, 0);
        for (idx, example) in examples.iter().enumerate() {
            let Some(probability) = judged.probabilities[idx] else { continue };
            probabilities.push(probability);
            stable.push(example.stable);
            n_lifted += usize::from(judged.lifts(idx));
            n_kept += usize::from(judged.lifts(idx) && example.stable);
        }
        Look {
            look: judged.phase.as_str().into(),
            n_grasps: stable.len(),
            n_stable: stable.iter().filter(|stable| **stable).count(),
            roc_area: area_under_roc(&curve(&probabilities, &stable)),
            ece: reliability(&probabilities, &stable, N_RELIABILITY_BINS).ece,
            n_lifted,
            n_kept,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_lifts_promising_grasps_alone_and_has_the_models_threshold() {
        let judged = JudgedLook {
            phase: Phase::TestLifted,
            threshold: 0.6,
            probabilities: vec![Some(0.9), Some(0.55), Some(0.9), None],
            is_promising: vec![true, true, false, true],
        };
        let examples = [("cup", true), ("box", false), ("box", true), ("cup", true)].map(|(object, stable)| Example {
            object: object.into(),
            stable,
            ..Example::default()
        });
        let third = 1.0 / 3.0;
        let figures = |point: &ThresholdPoint| (point.threshold_probability, point.kept, point.recall);
        // Each object is lifted as often: the cup is kept, and the box dropped if it is lifted at all.
        assert_eq!(
            judged.curve(&examples).iter().map(figures).collect::<Vec<_>>(),
            [(0.3, 0.5), (0.5, 0.5), (0.6, 1.0), (0.7, 1.0), (0.8, 1.0), (0.9, 1.0)]
                .map(|(threshold, kept)| (threshold, kept, third))
        );
    }
}
