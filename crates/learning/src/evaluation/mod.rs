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

use serde::Serialize;

use crate::dataset::{DatasetError, Grasp, read_grasps};
use crate::training::TrainingError;
use blindgrasp_messages::score::is_judged;
pub use blindgrasp_messages::score::{Evaluation, Score};
use blindgrasp_messages::{
    Action, Fault, GraspTruth, Header, LiftDecision, Phase, Prediction, Reason, Stamped, TactileFrame,
};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::day::GraspPlace;
use blindgrasp_stages::encoder::Reading;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp_stages::model::{Memory, Model};
use blindgrasp_stages::training_summary::ReadingId;
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

/// A model's decisions on recordings.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Evaluated {
    pub evaluation: Evaluation,
    /// The labelled grasps in order.
    pub decided: Vec<DecidedGrasp>,
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
    let (mut memory, dictionary_id) = (Memory::default(), model.dictionary_id());
    for path in recordings {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            let message = "it is given twice: its grasps would count twice".into();
            return Err(DatasetError::Unusable { path: path.clone(), message });
        }
        for Decided { decision, reading_id, truth } in
            decide_recording(hand, (model, dictionary_id), path, options, &mut memory)?
        {
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
            evaluated.decided.extend(truth.map(|truth| decided_grasp(&decision, truth)));
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
}

/// Decides every grasp of a recording in order, as a graph that begins with it. A grasp without a decision is held.
///
/// # Errors
/// The recording cannot be used, or the model is of another hand.
pub fn decide(hand: &Hand, model: &Model, recording: &Path) -> Result<Vec<Decided>, DatasetError> {
    let model = (model, model.dictionary_id());
    decide_recording(hand, model, recording, &ArbiterOptions::default(), &mut Memory::default())
}

/// As [`decide`], for frames that are numbered without gaps (`seq`).
pub fn decide_frames(hand: &Hand, model: &Model, frames: &[Stamped<TactileFrame>]) -> Vec<LiftDecision> {
    let (mut arbiter, mut memory) = (LiftArbiter::new(ArbiterOptions::default()), Memory::default());
    let model = (model, model.dictionary_id());
    let mut decisions = Vec::new();
    for frame in frames {
        let prediction = predict(hand, model, &mut memory, frame);
        arbiter.on_prediction(&frame.header, &prediction, 0, &mut decisions);
    }
    decisions.extend(arbiter.on_end());
    decisions.retain(|decision| !decision.action.is_probe());
    decisions
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
fn decide_recording(
    hand: &Hand,
    (model, dictionary_id): (&Model, u64),
    path: &Path,
    options: &ArbiterOptions,
    memory: &mut Memory,
) -> Result<Vec<Decided>, DatasetError> {
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
    memory.begin_recording();
    let mut decisions = Vec::new();
    let grasps = read_grasps(path, hand, |_, frames| {
        for frame in &frames {
            let prediction = predict(hand, (model, dictionary_id), memory, frame);
            arbiter.on_prediction(&frame.header, &prediction, 0, &mut decisions);
        }
        let settled = frames.iter().map(|frame| &frame.message).find(|frame| frame.phase == Phase::Settled);
        settled.map(|frame| ReadingId::of(&frame.joints_rad, &frame.cells_newtons))
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
    let decided = |grasp: Grasp<Option<ReadingId>>| Decided {
        decision: decide(grasp.grasp_id),
        reading_id: grasp.value,
        truth: grasp.truth,
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

/// Judges frames one after the other as the stages of a graph do, with an arbiter that has the default options.
pub struct Judge {
    hand: Hand,
    model: Model,
    dictionary_id: u64,
    memory: Memory,
    arbiter: LiftArbiter,
}

impl Judge {
    /// # Errors
    /// The model is of another hand.
    pub fn new(hand: Hand, model: Model) -> Result<Judge, String> {
        if model.hand.id != hand.id() {
            return Err(format!("the model is for the hand '{}', expected one for '{}'", model.hand.name, hand.name));
        }
        let (dictionary_id, memory) = (model.dictionary_id(), Memory::default());
        Ok(Judge { hand, model, dictionary_id, memory, arbiter: LiftArbiter::new(ArbiterOptions::default()) })
    }

    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The prediction for a frame, and the decision, if it comes with this frame. Frames are numbered without gaps.
    pub fn take(&mut self, frame: &Stamped<TactileFrame>) -> (Prediction, Option<LiftDecision>) {
        let prediction = predict(&self.hand, (&self.model, self.dictionary_id), &mut self.memory, frame);
        let mut decisions = Vec::new();
        self.arbiter.on_prediction(&frame.header, &prediction, 0, &mut decisions);
        (prediction, decisions.into_iter().rfind(|decision| !decision.action.is_probe()))
    }

    /// Decides a grasp by its frames as a graph would that sees no other.
    pub fn decide_alone(&mut self, frames: &[Stamped<TactileFrame>]) -> DecidedAlone {
        self.memory = Memory::default();
        self.arbiter = LiftArbiter::new(ArbiterOptions::default());
        let mut alone = DecidedAlone { predictions: Vec::new(), decision: None, decided_at: None };
        for (idx, frame) in frames.iter().enumerate() {
            // Its first frame is the first of all.
            let header = Header { seq: idx as u64, ..frame.header };
            let (prediction, decision) = self.take(&Stamped { header, message: frame.message.clone() });
            alone.predictions.push(prediction);
            if let (None, Some(decision)) = (&alone.decision, decision) {
                (alone.decision, alone.decided_at) = (Some(decision), Some(idx));
            }
        }
        alone
    }
}

/// Runs the stages between a frame and the arbiter.
fn predict(
    hand: &Hand,
    (model, dictionary_id): (&Model, u64),
    memory: &mut Memory,
    frame: &Stamped<TactileFrame>,
) -> Prediction {
    let Stamped { header, message } = frame;
    let TactileFrame { grasp_id, phase, joints_rad, cells_newtons, day, .. } = message;
    let mut contacts = Vec::new();
    let mut values = Vec::new();
    let summary = contacts_from_frame(hand, header.hand_id, joints_rad, cells_newtons, &mut contacts);
    let feature = match summary.fault {
        Fault::None => {
            let reading = Reading { joints_rad, contacts: &contacts, senses: message.senses.view() };
            model.extract(*phase, &reading, &mut values).map(|_| values.as_slice())
        }
        fault => Err(fault),
    };
    let place = GraspPlace { epoch: header.epoch, grasp_id: *grasp_id, day: *day };
    let verdict = model.judge(memory, dictionary_id, place, *phase, feature);
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
