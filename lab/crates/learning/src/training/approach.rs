//! Learns how often lifts keep their object after an approach.

use std::collections::BTreeSet;

use super::{Example, TrainingError, calibrate};
use crate::evaluation::measures::{area_under_roc, curve};
use crate::learners::booster::train_boosted;
use blindgrasp_messages::Sense;
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::classifier::boosting::BoostingParams;
use blindgrasp_stages::hand::Hand;

/// Few values, and little to learn from each: shallow trees of many grasps a leaf.
const PARAMS: BoostingParams = BoostingParams {
    n_rounds: 150,
    learning_rate: 0.03,
    max_depth: 4,
    min_child_weight: 20.0,
    lambda: 5.0,
    subsample: 0.8,
    colsample_bynode: 1.0,
};

/// `None` if a grasp has no gravity, or its approach says nothing about objects that were not learned from.
pub(super) fn learn(
    hand: &Hand,
    examples: &[&Example],
    folds: &[usize],
    seed: u64,
) -> Result<Option<ApproachPrior>, TrainingError> {
    let preshape_idxs: Vec<usize> = (0..hand.joints.len()).filter(|idx| hand.joints[*idx].is_preshape).collect();
    let row = |example: &&Example| {
        let gravity = example.senses.get(Sense::Gravity).try_into().ok()?;
        ApproachPrior::values(&preshape_idxs, gravity, &example.joints)
    };
    let Some(rows) = examples.iter().map(row).collect::<Option<Vec<Vec<f64>>>>() else { return Ok(None) };
    let trees = |is_used: &dyn Fn(usize) -> bool| {
        let used = || (0..rows.len()).filter(|idx| is_used(*idx));
        let values: Vec<f64> = used().flat_map(|idx| rows[idx].iter().copied()).collect();
        let targets: Vec<f64> = used().map(|idx| examples[idx].target()).collect();
        train_boosted(&values, 3 + preshape_idxs.len(), &targets, &PARAMS, seed)
    };
    let mut decision_values = vec![0.0; rows.len()];
    for fold in folds.iter().copied().collect::<BTreeSet<_>>() {
        let trees = trees(&|idx| folds[idx] != fold)?;
        for idx in (0..rows.len()).filter(|idx| folds[*idx] == fold) {
            decision_values[idx] = trees.decision_value(&rows[idx]);
        }
    }
    let calibration = calibrate(examples, &decision_values)?;
    let stable: Vec<bool> = examples.iter().map(|example| example.stable).collect();
    let cross_validated_roc_area = area_under_roc(&curve(&decision_values, &stable)).unwrap_or(0.5);
    let trees = trees(&|_| true)?;
    let prior = ApproachPrior { preshape_idxs, trees, calibration, cross_validated_roc_area };
    Ok((prior.calibration.a < 0.0 && cross_validated_roc_area > 0.5).then_some(prior))
}
