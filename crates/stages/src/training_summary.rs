//! How a model was trained, as its file says.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::label::Label;
use crate::recipe::Recipe;

/// How a model was trained, as it says of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingSummary {
    /// File names of the recordings.
    pub recordings: Vec<String>,
    /// What made each recording, as it says of itself.
    pub made_by: Vec<String>,
    /// For how many of the simulated recordings stable means what; empty if it means what the wrench space says for all,
    /// and all say so themselves.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub labels: BTreeMap<Label, usize>,
    /// Features and machine.
    pub recipe: Recipe,
    /// Friction coefficients that the grasps were judged again for; empty = the recordings' own truth.
    pub frictions: Vec<f64>,
    /// Grasps trained on.
    pub n_grasps: usize,
    /// How many of them are stable.
    pub n_stable: usize,
    /// Different objects among them.
    pub n_objects: usize,
    /// Contacts that the dictionary was learned from.
    pub n_contacts: usize,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// K-means' inertia, square metres.
    pub inertia: f64,
    /// Solver iterations of the SVM, or trees.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance.
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
    /// What is promised of the thresholds: by grasps of objects set aside, beside those trained on.
    pub guarantees: Vec<Guarantee>,
    /// The seed of K-means, boosting and the choice of objects set aside.
    pub seed: u64,
    /// The version of this program.
    pub version: String,
    /// The search that two values of the recipe come from; none = nothing was searched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grid: Option<GridSummary>,
}

/// What a model keeps of the search that its recipe's values come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridSummary {
    /// The names of the two parameters.
    pub axes: [String; 2],
    /// All pairs.
    pub cells: Vec<CellSummary>,
}

/// What a model keeps of a pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellSummary {
    /// The values, in the order of the axes.
    pub values: [f64; 2],
    /// The share of all examples on the right side of decision value 0.
    pub accuracy: f64,
    /// Unstable examples above decision value 0, as a share of all examples.
    pub false_positive_share: f64,
}

/// The calls that a guarantee is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WrongCall {
    /// Unstable grasps called stable.
    FalsePositive,
    /// Stable grasps called unstable.
    FalseNegative,
}

/// How a guarantee was reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Conformal risk control, the object being what is exchangeable.
    ConformalRiskControlByObject,
}

/// What is promised of a threshold, and on what grounds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Guarantee {
    /// Which calls.
    pub of: WrongCall,
    /// What the rate does not exceed in expectation over objects: called stable of the unstable grasps for false positives,
    /// called unstable of the stable ones for false negatives.
    pub max_rate: f64,
    /// On what grounds.
    pub method: Method,
    /// The threshold: called stable from there on, or unstable below.
    pub probability: f64,
    /// Objects set aside.
    pub n_objects: usize,
    /// Grasps of them that could be called wrongly.
    pub n_grasps: usize,
    /// The rate among these, each object weighing the same: what the promise is about.
    pub rate: f64,
    /// The rate among these, each grasp weighing the same.
    pub rate_of_grasps: f64,
}
