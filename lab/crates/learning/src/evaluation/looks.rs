//! How well a model judges a grasp at each look: when the hand has settled, and after each probe.

use serde::Serialize;

use super::measures::{area_under_roc, curve};
use super::reliability::{N_RELIABILITY_BINS, reliability};
use crate::training::{Example, composed};
use blindgrasp_messages::Phase;
use blindgrasp_stages::classifier::Classifier;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::probe::ProbeModel;

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

/// One entry for each look that some grasp has, in order; empty for a model without probes. Whether a grasp is unlike the training
/// data is not considered, nor are votes: the graph lifts fewer.
pub fn looks(model: &Model, examples: &[Example]) -> Vec<Look> {
    let probes = [(Phase::Squeezed, &model.squeezed), (Phase::TestLifted, &model.test_lifted)];
    let probes: Vec<_> = probes.into_iter().filter_map(|(phase, probe)| Some((phase, probe.as_ref()?))).collect();
    if probes.is_empty() {
        return Vec::new();
    }
    let judged = |classifier: &Classifier, values: &[f64]| {
        let decision_value = classifier.predictor.decision_value(values).ok()?;
        Some(classifier.calibration.probability(decision_value))
    };
    let settled = |example: &Example| {
        let mut values = Vec::new();
        model.features.extract(&example.reading(), &mut values).ok()?;
        judged(&model.classifier, &values)
    };
    let settled: Vec<Option<f64>> = examples.iter().map(settled).collect();
    let of_settled = Look::of(Phase::Settled, model.classifier.threshold_probability, examples, |idx| {
        settled[idx].map(|probability| (probability, true))
    });
    let of_probe = |phase: Phase, probe: &ProbeModel| -> Vec<Option<f64>> {
        let composed = |example| composed(&model.features, phase, example);
        examples.iter().map(|example| judged(&probe.classifier, &composed(example)?)).collect()
    };
    // Whether a grasp was promising at all looks before.
    let mut is_promising: Vec<bool> =
        settled.iter().map(|settled| *settled >= Some(model.classifier.unsure_from_probability)).collect();
    let of_probes = probes.into_iter().map(|(phase, probe)| {
        let judged = of_probe(phase, probe);
        let look = Look::of(phase, probe.classifier.threshold_probability, examples, |idx| {
            Some((judged[idx]?, is_promising[idx]))
        });
        for (is_promising, probability) in is_promising.iter_mut().zip(&judged) {
            *is_promising &= *probability >= Some(probe.classifier.unsure_from_probability);
        }
        look
    });
    std::iter::once(of_settled).chain(of_probes).filter(|look| look.n_grasps > 0).collect()
}

impl Look {
    /// `judge` gives a grasp's probability and whether it was promising before; `None` if it has no such look.
    fn of(phase: Phase, threshold: f64, examples: &[Example], judge: impl Fn(usize) -> Option<(f64, bool)>) -> Look {
        let (mut probabilities, mut stable, mut n_lifted, mut n_kept) = (Vec::new(), Vec::new(), 0, 0);
        for (idx, example) in examples.iter().enumerate() {
            let Some((probability, is_promising)) = judge(idx) else { continue };
            probabilities.push(probability);
            stable.push(example.stable);
            let is_lifted = is_promising && probability >= threshold;
            n_lifted += usize::from(is_lifted);
            n_kept += usize::from(is_lifted && example.stable);
        }
        Look {
            look: phase.as_str().into(),
            n_grasps: stable.len(),
            n_stable: stable.iter().filter(|stable| **stable).count(),
            roc_area: area_under_roc(&curve(&probabilities, &stable)),
            ece: reliability(&probabilities, &stable, N_RELIABILITY_BINS).ece,
            n_lifted,
            n_kept,
        }
    }
}
