//! The evaluation of models and recipes.
//!
//! * [`evaluate`] runs a model's stages and the arbiter, as the graph does, over recorded grasps.
//! * [`split`] makes folds of grasps; [`cross_validation`] trains recipes on all folds but one and judges that one.
//! * [`measures`], [`statistics`], [`decisions`] and [`comparison`] compute figures; [`report`] collects them, [`mod@page`]
//!   shows them.
//! * [`paper_label`] compares the paper's label with other labels.

pub mod comparison;
pub mod cross_validation;
pub mod decisions;
pub mod measures;
pub mod page;
pub mod paper_label;
pub mod report;
pub mod split;
pub mod statistics;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::dataset::{DatasetError, read_grasps};
use crate::training::TrainingError;
use blindgrasp_messages::{Action, Fault, GraspTruth, LiftDecision, Prediction, Reason, Stamped, TactileFrame};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp_stages::model::Model;
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

/// The score of decisions against labels.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Score {
    /// Grasps with labels.
    pub n_grasps: usize,
    /// How many of them are stable.
    pub n_stable: usize,
    pub n_lift: usize,
    /// Lifted and stable.
    pub n_true_positive: usize,
    /// Lifted and unstable: the object is dropped.
    pub n_false_positive: usize,
    /// Held and stable.
    pub n_false_negative: usize,
    /// Share of right decisions; `None` without grasps.
    pub accuracy: Option<f64>,
    /// The accuracy of always deciding the same.
    pub majority_class: Option<f64>,
    /// False positives as a share of all grasps (the paper's figure).
    pub false_positive_share: Option<f64>,
    /// False positives as a share of the unstable grasps.
    pub false_positive_rate: Option<f64>,
}

/// A model's score on recordings.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Evaluation {
    /// Over all grasps with labels.
    pub score: Score,
    /// Over the labelled grasps that the classifier decided. Grasps without contact, for example, are always held and do not
    /// count.
    pub score_judged: Score,
    pub by_class: BTreeMap<String, Score>,
    pub by_reason: BTreeMap<String, usize>,
    /// Grasps without a label: decided, but not scored.
    pub n_without_truth: usize,
}

impl Score {
    pub fn add(&mut self, lifted: bool, stable: bool) {
        self.n_grasps += 1;
        self.n_stable += usize::from(stable);
        self.n_lift += usize::from(lifted);
        self.n_true_positive += usize::from(lifted && stable);
        self.n_false_positive += usize::from(lifted && !stable);
        self.n_false_negative += usize::from(!lifted && stable);
        let share = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);
        let n_unstable = self.n_grasps - self.n_stable;
        let n_right = self.n_grasps - self.n_false_positive - self.n_false_negative;
        self.accuracy = share(n_right, self.n_grasps);
        self.majority_class = share(self.n_stable.max(n_unstable), self.n_grasps);
        self.false_positive_share = share(self.n_false_positive, self.n_grasps);
        self.false_positive_rate = share(self.n_false_positive, n_unstable);
    }
}

impl Evaluation {
    /// Counts a decision, and its label if there is one.
    pub fn add(&mut self, decision: &LiftDecision, truth: Option<&GraspTruth>) {
        *self.by_reason.entry(decision.reason.word().into()).or_default() += 1;
        let Some(truth) = truth else {
            self.n_without_truth += 1;
            return;
        };
        let lifted = decision.action == Action::Lift;
        self.score.add(lifted, truth.stable);
        if is_judged(decision.reason) {
            self.score_judged.add(lifted, truth.stable);
        }
        self.by_class.entry(truth.class.clone()).or_default().add(lifted, truth.stable);
    }
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

/// Whether the classifier made the decision.
fn is_judged(reason: Reason) -> bool {
    matches!(reason, Reason::Stable | Reason::Unstable | Reason::Unsure | Reason::NoAgreement)
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
    let mut decisions = Vec::new();
    let grasps = read_grasps(path, hand, |_, frames| {
        for frame in &frames {
            arbiter.on_prediction(&frame.header, &predict(hand, model, frame), 0, &mut decisions);
        }
    })?;
    decisions.extend(arbiter.on_end());
    if grasps.is_empty() {
        return Err(unusable("it holds no tactile frames to decide on".into()));
    }
    let mut by_grasp: BTreeMap<u64, LiftDecision> =
        decisions.into_iter().map(|decision| (decision.grasp_id, decision)).collect();
    let mut decide =
        |grasp_id| by_grasp.remove(&grasp_id).unwrap_or(LiftDecision { grasp_id, ..LiftDecision::default() });
    Ok(grasps.into_iter().map(|grasp| (decide(grasp.grasp_id), grasp.truth)).collect())
}

/// Runs the stages between a frame and the arbiter.
fn predict(hand: &Hand, model: &Model, frame: &Stamped<TactileFrame>) -> Prediction {
    let TactileFrame { grasp_id, phase, joints_rad, cells_newtons } = &frame.message;
    let mut contacts = Vec::new();
    let mut values = Vec::new();
    let summary = contacts_from_frame(hand, frame.header.hand_id, joints_rad, cells_newtons, &mut contacts);
    let verdict = match summary.fault {
        Fault::None => {
            model.extract(joints_rad, &contacts, &mut values).and_then(|_| model.classifier.classify(&values))
        }
        fault => Err(fault),
    };
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
