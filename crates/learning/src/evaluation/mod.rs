//! The evaluation of models and recipes.
//!
//! * [`evaluate`] runs a model's stages and the arbiter, as the graph does, over recorded grasps.
//! * [`split`] makes folds of grasps; [`cross_validation`] trains recipes on all folds but one and judges that one.
//! * [`measures`], [`statistics`], [`decisions`] and [`comparison`] compute figures; [`report`] collects them, [`mod@page`]
//!   shows them.
//! * [`looks`] judges the probes of models of lifts.
//! * [`paper_label`] compares the paper's label with other labels.

pub mod comparison;
pub mod cross_validation;
pub mod decisions;
pub mod looks;
pub mod measures;
pub mod page;
pub mod paper_label;
pub mod report;
pub mod split;
pub mod statistics;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::dataset::{DatasetError, read_grasps};
use crate::training::TrainingError;
use blindgrasp_messages::score::is_judged;
pub use blindgrasp_messages::score::{Evaluation, Score};
use blindgrasp_messages::{Action, Fault, GraspTruth, LiftDecision, Prediction, Reason, Stamped, TactileFrame};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::encoder::Reading;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::probe::GraspHistory;
use decisions::DecidedGrasp;
use split::SplitError;

#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    #[error(transparent)]
    Split(#[from] SplitError),
    /// A recipe cannot be trained without a fold.
    #[error("{what}")]
    Fit {
        /// The recipe and the fold.
        what: String,
        source: TrainingError,
    },
}

/// Decides every grasp of the recordings as the graph would. Returns the score, and the labelled grasps in order.
///
/// # Errors
/// A recording cannot be used, or the model is of another hand.
pub fn evaluate(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    options: &ArbiterOptions,
) -> Result<(Evaluation, Vec<DecidedGrasp>), DatasetError> {
    let (mut evaluation, mut decided) = (Evaluation::default(), Vec::new());
    let mut canonical = BTreeSet::new();
    for path in recordings {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            let message = "it is given twice: its grasps would count twice".into();
            return Err(DatasetError::Unusable { path: path.clone(), message });
        }
        for (decision, truth) in decide_recording(hand, model, path, options)? {
            evaluation.add(&decision, truth.as_ref());
            decided.extend(truth.map(|truth| decided_grasp(&decision, truth)));
        }
    }
    Ok((evaluation, decided))
}

fn decided_grasp(decision: &LiftDecision, truth: GraspTruth) -> DecidedGrasp {
    // Without agreement of the votes, no single probability decided.
    let has_probability = is_judged(decision.reason) && decision.reason != Reason::NoAgreement;
    DecidedGrasp {
        object: truth.object,
        class: truth.class,
        stable: truth.stable,
        lifted: decision.action == Action::Lift,
        judged: is_judged(decision.reason),
        probability: has_probability.then_some(decision.probability_stable),
    }
}

/// Decides every grasp of a recording, in order.
///
/// # Errors
/// As of [`evaluate`].
pub fn decide_recording(
    hand: &Hand,
    model: &Model,
    path: &Path,
    options: &ArbiterOptions,
) -> Result<Vec<(LiftDecision, Option<GraspTruth>)>, DatasetError> {
    let unusable = |message| DatasetError::Unusable { path: path.into(), message };
    if model.hand.id != hand.id() {
        return Err(unusable(format!(
            "it is for the hand '{}' ({:016x}), the model for '{}' ({:016x}): train a model for this hand",
            hand.name,
            hand.id(),
            model.hand.name,
            model.hand.id
        )));
    }
    // One arbiter for the whole recording, as in the graph: it sees missing samples between two grasps.
    let mut arbiter = LiftArbiter::new(*options);
    let mut history = GraspHistory::default();
    let mut decisions = Vec::new();
    let grasps = read_grasps(path, hand, |_, frames| {
        for frame in &frames {
            let prediction = predict(hand, model, &mut history, frame);
            arbiter.on_prediction(&frame.header, &prediction, 0, &mut decisions);
        }
    })?;
    decisions.extend(arbiter.on_end());
    if grasps.is_empty() {
        return Err(unusable("it holds no tactile frames to decide on".into()));
    }
    let mut by_grasp: BTreeMap<u64, LiftDecision> = decisions
        .into_iter()
        .filter(|it| !it.action.is_probe())
        .map(|decision| (decision.grasp_id, decision))
        .collect();
    let mut decide =
        |grasp_id| by_grasp.remove(&grasp_id).unwrap_or(LiftDecision { grasp_id, ..LiftDecision::default() });
    Ok(grasps.into_iter().map(|grasp| (decide(grasp.grasp_id), grasp.truth)).collect())
}

/// Runs the stages between a frame and the arbiter.
fn predict(hand: &Hand, model: &Model, history: &mut GraspHistory, frame: &Stamped<TactileFrame>) -> Prediction {
    let Stamped { header, message } = frame;
    let TactileFrame { grasp_id, phase, joints_rad, cells_newtons, .. } = message;
    let mut contacts = Vec::new();
    let mut values = Vec::new();
    let summary = contacts_from_frame(hand, header.hand_id, joints_rad, cells_newtons, &mut contacts);
    let verdict = match summary.fault {
        Fault::None => {
            let reading = Reading { joints_rad, contacts: &contacts, senses: message.senses() };
            model.extract(*phase, &reading, &mut values).and_then(|_| model.classify(*phase, &values, history))
        }
        fault => Err(fault),
    };
    model.remember(history, (header.epoch, *grasp_id), *phase, if verdict.is_ok() { &values } else { &[] });
    let prediction = Prediction { grasp_id: *grasp_id, phase: *phase, ..Prediction::default() };
    match verdict {
        Ok(verdict) => Prediction {
            decision_value: verdict.decision_value,
            probability_stable: verdict.probability_stable,
            stable: verdict.stable,
            unsure: verdict.unsure,
            ..prediction
        },
        Err(fault) => Prediction { fault, ..prediction },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_decisions_by_hand() {
        let mut score = Score::default();
        for (lifted, stable) in [(true, true), (true, false), (false, false), (false, false)] {
            score.add(lifted, stable);
        }
        assert_eq!(score.accuracy, Some(0.75));
        assert_eq!(score.majority_class, Some(0.75));
        assert_eq!(score.false_positive_share, Some(0.25));
        assert_eq!(score.false_positive_rate, Some(1.0 / 3.0));
        assert_eq!((score.n_lift, score.n_false_negative), (2, 0));
    }
}
