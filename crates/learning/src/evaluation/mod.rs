//! The evaluation of models and recipes.
//!
//! * [`evaluate`] runs a model's stages and the arbiter, as the graph does, over recorded grasps.
//! * [`split`] makes folds of grasps; [`cross_validation`] trains recipes on all folds but one and judges that one.
//! * [`measures`], [`statistics`], [`decisions`] and [`comparison`] compute figures; [`report`] collects them, [`mod@page`]
//!   shows them.
//! * [`predictions`] reads what a model that is not blindgrasp's says of the same grasps, to judge it as the others.
//! * [`looks`] judges the probes of models of lifts.
//! * [`paper_label`] compares the paper's label with other labels.

pub mod comparison;
pub mod cross_validation;
pub mod decisions;
pub mod looks;
pub mod measures;
pub mod page;
pub mod paper_label;
pub mod predictions;
pub mod reliability;
pub mod report;
pub mod split;
pub mod statistics;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::dataset::{DatasetError, Grasp, read_grasps};
use crate::training::TrainingError;
use blindgrasp_messages::score::is_judged;
pub use blindgrasp_messages::score::{Evaluation, Score};
use blindgrasp_messages::{Action, GraspTruth, Header, LiftDecision, Phase, Prediction, Reason, Stamped, TactileFrame};
use blindgrasp_stages::out_of_distribution::Violation;
use blindgrasp_stages::training_summary::ReadingId;
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
    let trained_on = model.training.trained_on.as_ref();
    let mut evaluated = Evaluated { trained: trained_on.map(|_| Trained::default()), ..Evaluated::default() };
    let mut canonical = BTreeSet::new();
    let mut judge = Judge::with_options(hand.clone(), model.clone(), *options)?;
    for (recording_idx, path) in recordings.iter().enumerate() {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            let message = "it is given twice: its grasps would count twice".into();
            return Err(DatasetError::Unusable { path: path.clone(), message });
        }
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

/// A grasp of a recording, decided.
#[derive(Debug, Clone)]
pub struct Decided {
    pub decision: LiftDecision,
    /// Of its first settled frame.
    reading_id: Option<ReadingId>,
    pub truth: Option<GraspTruth>,
    /// The limits that it violates, if it was held as out of distribution.
    pub violations: Vec<Violation>,
}

/// Decides every grasp of a recording in order, as a graph that begins with it. A grasp without a decision is held.
///
/// # Errors
/// The recording cannot be used.
pub fn decide(judge: &mut Judge, recording: &Path) -> Result<Vec<Decided>, DatasetError> {
    judge.reset();
    decide_recording(judge, recording)
}

/// As [`decide`], for frames that are numbered without gaps (`seq`).
pub fn decide_frames(judge: &mut Judge, frames: &[Stamped<TactileFrame>]) -> Vec<Decided> {
    judge.reset();
    let mut decided: Vec<Decided> = frames.iter().flat_map(|frame| sample(judge, frame)).collect();
    decided.extend(judge.end().map(Decided::from));
    decided.retain(|decided| decided.decision.action.decides());
    decided
}

/// The decisions that come with a frame.
fn sample(judge: &mut Judge, frame: &Stamped<TactileFrame>) -> Vec<Decided> {
    let decisions = judge.sample(frame).decisions;
    let explained = |decision: LiftDecision| {
        let violations = judge.violations(&decision).to_vec();
        Decided { violations, ..Decided::from(decision) }
    };
    decisions.into_iter().map(explained).collect()
}

impl From<LiftDecision> for Decided {
    fn from(decision: LiftDecision) -> Self {
        Decided { decision, reading_id: None, truth: None, violations: Vec::new() }
    }
}

/// Whether a probability made the decision. Without agreement of the votes, no single one did.
pub fn has_probability(reason: Reason) -> bool {
    is_judged(reason) && reason != Reason::NoAgreement
}

fn decided_grasp(recording_idx: usize, decision: &LiftDecision, truth: GraspTruth) -> JudgedGrasp {
    JudgedGrasp {
        recording_idx,
        grasp_id: truth.grasp_id,
        fold: None,
        object: truth.object,
        class: truth.class,
        stable: truth.stable,
        lifted: decision.action == Action::Lift,
        judged: is_judged(decision.reason),
        probability: has_probability(decision.reason).then_some(decision.probability_stable),
    }
}

/// Decides every grasp of a recording, in order.
fn decide_recording(judge: &mut Judge, path: &Path) -> Result<Vec<Decided>, DatasetError> {
    judge.begin_recording();
    let mut decisions = Vec::new();
    let hand = judge.hand().clone();
    let grasps = read_grasps(path, &hand, |_, frames| {
        for frame in &frames {
            decisions.extend(sample(judge, frame));
        }
        let settled = frames.iter().map(|frame| &frame.message).find(|frame| frame.phase == Phase::Settled);
        settled.map(|frame| ReadingId::of(&frame.joints, &frame.cells_newtons))
    })?;
    decisions.extend(judge.end().map(Decided::from));
    if grasps.is_empty() {
        let message = "it holds no tactile frames to decide on".into();
        return Err(DatasetError::Unusable { path: path.into(), message });
    }
    let deciding = decisions.into_iter().filter(|decided| decided.decision.action.decides());
    let mut by_grasp: BTreeMap<u64, Decided> = deciding.map(|decided| (decided.decision.grasp_id, decided)).collect();
    let mut decide = |grasp_id| {
        let undecided = || Decided::from(LiftDecision { grasp_id, ..LiftDecision::default() });
        by_grasp.remove(&grasp_id).unwrap_or_else(undecided)
    };
    let decided = |grasp: Grasp<Option<ReadingId>>| Decided {
        reading_id: grasp.value,
        truth: grasp.truth,
        ..decide(grasp.grasp_id)
    };
    Ok(grasps.into_iter().map(decided).collect())
}

/// A grasp decided by itself.
#[derive(Debug, Clone)]
pub struct DecidedAlone {
    /// One for each frame.
    pub predictions: Vec<Prediction>,
    /// `None` if the frames end before the decision comes.
    pub decision: Option<LiftDecision>,
    /// The index of the frame at which the decision came.
    pub decided_at: Option<usize>,
}

/// Decides a grasp by its frames as a graph would that sees no other.
pub fn decide_alone(judge: &mut Judge, frames: &[Stamped<TactileFrame>]) -> DecidedAlone {
    judge.reset();
    let mut alone = DecidedAlone { predictions: Vec::new(), decision: None, decided_at: None };
    for (idx, frame) in frames.iter().enumerate() {
        // Its first frame is the first of all.
        let header = Header { seq: idx as u64, ..frame.header };
        let judged = judge.sample(&Stamped { header, message: frame.message.clone() });
        alone.predictions.push(judged.prediction);
        if alone.decision.is_none() && !judged.decisions.is_empty() {
            (alone.decision, alone.decided_at) = (judged.decisions.into_iter().last(), Some(idx));
        }
    }
    alone
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
