//! The evaluation of models and recipes.
//!
//! * [`evaluate`] runs a model's stages and the arbiter, as the graph does, over recorded grasps.
//! * [`split`] makes folds of grasps; [`cross_validation`] trains recipes on all folds but one and judges that one.
//! * [`measures`], [`statistics`], [`decisions`] and [`comparison`] compute figures; [`report`] collects them, [`mod@page`]
//!   shows them.
//! * [`predictions`] reads what a model that is not blindgrasp's says of the same grasps, to judge it as the others.
//! * [`looks`] judges the probes of models of lifts, [`baselines`] has plain rules beside them.

pub mod baselines;
pub mod comparison;
pub mod cross_validation;
pub mod decisions;
pub mod looks;
pub mod measures;
pub mod page;
pub mod predictions;
pub mod reliability;
pub mod report;
pub mod split;
pub mod statistics;

use std::path::PathBuf;

use serde::Serialize;

use crate::training::TrainingError;
use blindgrasp_grasps::dataset::{DatasetError, check_once};
use blindgrasp_grasps::decide::{Decided, decide_recording, has_probability};
use blindgrasp_messages::score::is_judged;
pub use blindgrasp_messages::score::{Evaluation, Score};
use blindgrasp_messages::{Action, GraspTruth, LiftDecision, Reason};
use blindgrasp_stages::{ArbiterOptions, Hand, Judge, Model};
use decisions::JudgedGrasp;
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

/// A model's decisions on recordings.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evaluated {
    pub evaluation: Evaluation,
    /// The labelled grasps in order.
    pub decided: Vec<JudgedGrasp>,
    /// `None` if the model does not name its training grasps.
    pub trained: Option<Trained>,
}

/// The grasps of an evaluation, by whether the model was trained on them or on their objects.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Trained {
    /// Grasps that the model was trained on: they are in no score.
    pub n_left_out: usize,
    /// Other grasps of objects that the model was trained on.
    pub trained_objects: Score,
    /// Grasps of objects that the model was not trained on.
    pub new_objects: Score,
}

/// Decides every grasp of the recordings as the graph would, and scores those that the model was not trained on.
///
/// # Errors
/// A recording cannot be used, the model is of another hand, or it was trained on every grasp that some cell feels.
pub fn evaluate(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    options: &ArbiterOptions,
) -> Result<Evaluated, DatasetError> {
    check_once(recordings)?;
    let trained_on = model.training.trained_on.as_ref();
    let mut evaluated = Evaluated { trained: trained_on.map(|_| Trained::default()), ..Evaluated::default() };
    let mut judge = Judge::with_options(hand.clone(), model.clone(), *options)?;
    for (recording_idx, path) in recordings.iter().enumerate() {
        for Decided { decision, reading_id, truth, .. } in decide_recording(&mut judge, path)? {
            if let (Some(trained), Some(trained_on)) = (&mut evaluated.trained, trained_on) {
                if reading_id.is_some_and(|id| trained_on.grasps.contains(&id)) {
                    trained.n_left_out += 1;
                    continue;
                }
                if let Some(truth) = &truth {
                    let is_trained = trained_on.objects.contains(&truth.object);
                    let score = if is_trained { &mut trained.trained_objects } else { &mut trained.new_objects };
                    score.add(decision.action == Action::Lift, truth.stable);
                }
            }
            evaluated.evaluation.add(&decision, truth.as_ref());
            evaluated.decided.extend(truth.map(|truth| decided_grasp(recording_idx, &decision, truth)));
        }
    }
    // Grasps that no cell feels are part of no training.
    let is_rest_unfelt = evaluated.evaluation.by_reason.keys().all(|reason| reason == Reason::NoContact.as_str());
    if let (Some(Trained { n_left_out: 1.., .. }), Some(first), true) =
        (&evaluated.trained, recordings.first(), is_rest_unfelt)
    {
        let message = "the model was trained on every grasp that some cell feels, so these recordings say nothing about new \
                       grasps: expected other recordings, or recipes instead of a model (--split object)";
        return Err(DatasetError::Unusable { path: first.clone(), message: message.into() });
    }
    Ok(evaluated)
}

fn decided_grasp(recording_idx: usize, decision: &LiftDecision, truth: GraspTruth) -> JudgedGrasp {
    JudgedGrasp {
        recording_idx,
        grasp_id: truth.grasp_id,
        fold: None,
        object: truth.object,
        class: truth.object_class,
        stable: truth.stable,
        lifted: decision.action == Action::Lift,
        judged: is_judged(decision.reason),
        probability: has_probability(decision.reason).then_some(decision.probability_stable),
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
