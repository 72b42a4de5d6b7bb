//! Scores of decisions against the truth. Positive is "stable": a false positive is an object dropped.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::{Action, GraspTruth, LiftDecision, Reason};

/// Decisions compared with the truth, counted.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Score {
    /// Grasps whose truth is known.
    pub n_grasps: usize,
    pub n_stable: usize,
    pub n_lift: usize,
    /// Lifted, and stable.
    pub n_true_positive: usize,
    /// Lifted, but unstable: the object is dropped.
    pub n_false_positive: usize,
    /// Held, though stable.
    pub n_false_negative: usize,
    /// Share of right decisions; none without grasps.
    pub accuracy: Option<f64>,
    /// Share of the larger class: what deciding always the same would get.
    pub majority_class: Option<f64>,
    /// False positives as a share of all grasps (the paper's figure).
    pub false_positive_share: Option<f64>,
    /// False positives as a share of the unstable grasps.
    pub false_positive_rate: Option<f64>,
}

/// The score of all decisions, and its parts.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Evaluation {
    /// Over all grasps with truth.
    pub score: Score,
    /// Over the grasps with truth that the classifier decided; without grasps that no cell feels, which are always held.
    pub score_judged: Score,
    /// By class of object.
    pub by_class: BTreeMap<String, Score>,
    pub by_reason: BTreeMap<String, usize>,
    /// Grasps that were decided and have no label.
    pub n_without_truth: usize,
}

impl Score {
    /// Counts a decision.
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
    /// Counts a decision; `truth` is `None` if the grasp has no label.
    pub fn add(&mut self, decision: &LiftDecision, truth: Option<&GraspTruth>) {
        *self.by_reason.entry(decision.reason.as_str().into()).or_default() += 1;
        let Some(truth) = truth else {
            self.n_without_truth += 1;
            return;
        };
        let lifted = decision.action == Action::Lift;
        self.score.add(lifted, truth.stable);
        if is_judged(decision.reason) {
            self.score_judged.add(lifted, truth.stable);
        }
        self.by_class.entry(truth.object_class.clone()).or_default().add(lifted, truth.stable);
    }
}

/// Whether the classifier's predictions made the decision.
pub fn is_judged(reason: Reason) -> bool {
    matches!(reason, Reason::Stable | Reason::Unstable | Reason::Unsure | Reason::NoAgreement)
}
