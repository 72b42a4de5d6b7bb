//! Learns how often lifts keep their object after an approach.

use std::collections::BTreeSet;

use super::{Example, TrainingError, calibrate, fit_trees};
use crate::evaluation::measures::{area_under_roc, curve};
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
    let mut rows = Vec::new();
    for example in examples {
        let Ok(gravity) = example.senses.get(Sense::Gravity).try_into() else { return Ok(None) };
        rows.push(ApproachPrior::values(&preshape_idxs, gravity, &example.joints));
    }
    if rows.iter().any(Option::is_none) {
        return Ok(None);
    }
    let n_values = 3 + preshape_idxs.len();
    let mut decision_values = vec![0.0; rows.len()];
    for fold in folds.iter().copied().collect::<BTreeSet<_>>() {
        let trees = fit_trees(&rows, n_values, examples, folds, Some(fold), &PARAMS, seed)?;
        for (idx, row) in rows.iter().enumerate() {
            if let Some(row) = row
                && folds[idx] == fold
            {
                decision_values[idx] = trees.decision_value(row);
            }
        }
    }
    let calibration = calibrate(examples, &decision_values)?;
    let stable: Vec<bool> = examples.iter().map(|example| example.stable).collect();
    let cross_validated_roc_area = area_under_roc(&curve(&decision_values, &stable)).unwrap_or(0.5);
    let trees = fit_trees(&rows, n_values, examples, folds, None, &PARAMS, seed)?;
    let prior = ApproachPrior { preshape_idxs, trees, calibration, cross_validated_roc_area };
    Ok((prior.calibration.a < 0.0 && cross_validated_roc_area > 0.5).then_some(prior))
}
