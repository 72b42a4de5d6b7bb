//! The account of its training in a model file.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _};
use sha2::{Digest, Sha256};

use crate::label::Label;
use crate::own_lifts::{Correction, attempts_per_kept};
use crate::recipe::Recipe;

/// How a model was trained.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSummary {
    pub recordings: Vec<String>,
    /// The program and options that made each recording, from its metadata.
    pub made_by: Vec<String>,
    /// Number of simulated recordings for each meaning of "stable". Empty if it is the wrench space's in all of them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub labels: BTreeMap<Label, usize>,
    pub recipe: Recipe,
    /// Friction coefficients for which an earlier version labelled the grasps again. Empty: the recordings' own labels.
    pub frictions: Vec<f64>,
    pub n_grasps: usize,
    /// Stable grasps among them.
    pub n_stable: usize,
    /// Different objects among them.
    pub n_objects: usize,
    /// Contacts that the dictionary was learned from.
    pub n_contacts: usize,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// K-means' inertia, square metres.
    pub inertia: f64,
    /// Solver iterations of the SVM, or the number of trees.
    pub n_iterations: usize,
    /// Whether the SVM's solver reached its tolerance.
    pub converged: bool,
    /// Folds of the cross-validation.
    pub n_folds: usize,
    /// Accuracy over folds grouped by object, at the threshold.
    pub cross_validated_accuracy: f64,
    /// Unstable grasps called stable in the same folds, as a share of all grasps trained on.
    pub cross_validated_false_positive_share: f64,
    /// Brier score of the probabilities over the same folds, each fold's calibration made without it.
    pub cross_validated_brier: f64,
    /// Expected calibration error of the same probabilities, over 10 bins of equally many grasps.
    pub cross_validated_ece: f64,
    /// What to expect of trials with each of the thresholds, over folds of objects, if they were chosen for trials.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub policies: Vec<PolicySummary>,
    /// The seed of K-means and boosting.
    pub seed: u64,
    /// The version of the program that trained.
    pub version: String,
    /// The grasps that the model has learned from, so that an evaluation can leave them out. Models of earlier versions do
    /// not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trained_on: Option<TrainedOn>,
    /// The lifts of a robot that corrected the model, if `blindgrasp model adapt` did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub own_lifts: Option<OwnLiftsSummary>,
}

/// The lifts of a robot, or of several of one hand, that corrected a model, and the figures of the corrected model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnLiftsSummary {
    pub recordings: Vec<String>,
    /// The phase of the look that decides.
    pub look: String,
    /// Lifts with an outcome that the model can judge at this look.
    pub n_lifts: usize,
    pub n_kept: usize,
    /// Other outcomes, by the reason why they taught nothing.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub taught_nothing: BTreeMap<String, usize>,
    /// Different objects among them. A lift whose object is not named counts as one of another object.
    pub n_objects: usize,
    /// The correction of the look's log-odds. It is none if it made the log loss no smaller.
    pub correction: Correction,
    /// The mean log loss of these lifts, nats: of the model before, and of a model that lifts of other objects corrected.
    pub log_loss_before: f64,
    pub log_loss_after: f64,
    /// Of these lifts, those that the corrected model makes, each judged with the correction by other objects.
    pub n_lifted: usize,
    /// Grasps that a limit of the model's training range held before; 0 if the limits are those of the model.
    pub n_outside: usize,
    /// The bounds of drops of these lifts; `None` if no lift is made.
    pub promise: Option<Promise>,
    /// The share of each robot, by its name; empty for one robot.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub robots: BTreeMap<String, RobotLifts>,
    /// Whether some of the lifts are simulated. Models of earlier versions do not say so.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub in_simulation: bool,
}

/// The lifts of one robot among those that corrected a model, as [`OwnLiftsSummary`] has them for all.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotLifts {
    pub n_lifts: usize,
    pub n_kept: usize,
    pub n_lifted: usize,
    pub promise: Option<Promise>,
}

impl TrainingSummary {
    /// Removes the promises, because the model has other probabilities from now on.
    pub fn withdraw_promises(&mut self) {
        for policy in &mut self.policies {
            policy.promise = None;
            policy.curve.clear();
        }
    }
}

/// The grasps that a model has learned from, those on which thresholds were chosen among them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainedOn {
    pub objects: BTreeSet<String>,
    /// The settled frame of each grasp.
    pub grasps: BTreeSet<ReadingId>,
}

/// Identifies a frame by its joint angles and cells: 8 bytes of their SHA-256. Two of 25,000 frames and 25,000 others have the
/// same with a probability of 3e-11.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ReadingId(u64);

impl ReadingId {
    pub fn of(joints: &[f64], cells_newtons: &[f64]) -> ReadingId {
        let numbers = joints.iter().chain(cells_newtons);
        let digest = numbers.fold(Sha256::new(), |hasher, number| hasher.chain_update(number.to_le_bytes())).finalize();
        let mut first = [0; 8];
        first.copy_from_slice(&digest[..8]);
        ReadingId(u64::from_be_bytes(first))
    }
}

impl Serialize for ReadingId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        blindgrasp_messages::hex_id::serialize(&self.0, serializer)
    }
}

impl<'de> Deserialize<'de> for ReadingId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        blindgrasp_messages::hex_id::deserialize(deserializer).map(ReadingId).map_err(D::Error::custom)
    }
}

/// What to expect of trials that end with a lift, or without one after 20 attempts, each object weighing the same.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicySummary {
    /// The phase after which the grasp is decided.
    pub look: String,
    /// The price of a drop, in attempts, for which the thresholds were chosen.
    pub drop_costs: f64,
    /// Area under the ROC curve of the probabilities out of folds.
    pub roc_area: f64,
    pub kept: f64,
    pub attempts_per_lift: f64,
    /// Share of the trials without a lift.
    pub given_up: f64,
    /// The bounds of drops for new objects. `None` in models of earlier versions, and for a look whose thresholds are not the
    /// model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub promise: Option<Promise>,
    /// What other thresholds of this look would lead to, from the lowest on. Models of earlier versions have none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub curve: Vec<ThresholdPoint>,
}

/// A threshold of a look, and what to expect if the thresholds of the looks before stay.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThresholdPoint {
    pub threshold_probability: f64,
    /// Of the objects that are lifted, the share that is kept.
    pub kept: f64,
    /// Of the stable grasps, the share that is lifted.
    pub recall: f64,
    pub attempts_per_lift: f64,
    /// Share of the trials without a lift.
    pub given_up: f64,
    /// The bound of the share of lifts that drop, of this threshold by itself; `None` if nothing is promised.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drops_at_most: Option<f64>,
}

impl ThresholdPoint {
    /// Attempts for each kept object, if a drop costs as much as `drop_costs` attempts.
    pub fn attempts_per_kept(&self, drop_costs: f64) -> f64 {
        attempts_per_kept(self.attempts_per_lift, self.kept, drop_costs)
    }
}

/// Upper bounds of drops, for new objects like those that were tried.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Promise {
    /// The probability with which each bound holds.
    pub confidence: f64,
    /// The most attempts of a trial; `None` if a run of trials says it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub n_attempts: Option<u32>,
    /// Share of the lifts that drop the object.
    pub drops_of_lifts: Bounded,
    /// Share of the trials that end with a drop. A trial that is given up ends without one.
    pub drops_of_trials: Bounded,
}

/// A share with its upper bound.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bounded {
    pub estimate: f64,
    pub at_most: f64,
    /// Objects that the bound is from.
    pub n_objects: usize,
}

impl fmt::Display for Promise {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Promise { confidence, n_attempts, drops_of_lifts: lifts, drops_of_trials: trials } = self;
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        write!(
            formatter,
            "at most {} of the lifts drop (estimate {}) and at most {} of the trials end in a drop (estimate {}), each with \
             {:.0} % confidence, from {} objects",
            percent(lifts.at_most),
            percent(lifts.estimate),
            percent(trials.at_most),
            percent(trials.estimate),
            100.0 * confidence,
            trials.n_objects,
        )?;
        n_attempts.map_or(Ok(()), |n| {
            let attempts = if n == 1 { "attempt" } else { "attempts" };
            write!(formatter, "; a trial has at most {n} {attempts}")
        })
    }
}
