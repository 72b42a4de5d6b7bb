//! Gradient-boosted decision trees: a stronger machine than the paper's, for features of mixed units.
//!
//! Trees are grown by `hessboost` (second-order boosting of the logistic loss on binned features, as in XGBoost), the same
//! on any number of threads. What is kept here is only what a decision value takes: no allocation, no library.

use hessboost::config::TreeMethod;
use hessboost::data::DMatrix;
use hessboost::objective::{Objective, RegLoss};
use serde::{Deserialize, Serialize};

/// How trees are grown, named as in XGBoost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoostingParams {
    /// Number of trees.
    pub n_rounds: usize,
    /// What each tree's values are multiplied with.
    pub learning_rate: f64,
    /// Greatest depth of a tree.
    pub max_depth: usize,
    /// The share of the grasps that each tree sees.
    pub subsample: f64,
    /// The share of the values that each split may choose from.
    pub colsample_bynode: f64,
    /// Least sum of second derivatives in a leaf.
    pub min_child_weight: f64,
    /// Penalty on squared leaf values.
    pub lambda: f64,
}

impl Default for BoostingParams {
    fn default() -> Self {
        BoostingParams {
            n_rounds: 500,
            learning_rate: 0.04,
            max_depth: 6,
            subsample: 0.7,
            colsample_bynode: 0.4,
            min_child_weight: 1.0,
            lambda: 1.0,
        }
    }
}

/// Boosted trees; the decision value is a log-odds of the positive class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoostedTrees {
    /// Values of a feature.
    pub n_features: usize,
    /// The decision value before any tree.
    pub base: f64,
    /// The trees.
    pub trees: Vec<Tree>,
}

/// A tree, node by node; children come after their parent, the right one just after the left one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tree {
    /// Index of the value that a node compares; 0 for a leaf.
    pub feature: Vec<u16>,
    /// A sample goes left if its value is below this; a leaf's contribution to the decision value.
    pub threshold: Vec<f32>,
    /// Index of the left child; 0 for a leaf.
    pub left: Vec<u32>,
}

/// Why trees could not be grown or are not valid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BoostingError {
    /// Features and labels don't fit each other.
    #[error("{n_values} values for {n_labels} labels of {n_features} features each")]
    Shape {
        /// Values given.
        n_values: usize,
        /// Labels given.
        n_labels: usize,
        /// Values of a feature.
        n_features: usize,
    },
    /// The library's reason.
    #[error("boosting: {0}")]
    Boosting(String),
    /// Trees that lead nowhere.
    #[error("tree {tree_idx}: {message}")]
    Tree {
        /// Which tree.
        tree_idx: usize,
        /// What is wrong with it.
        message: String,
    },
}

/// Grows trees on `features` (row-major, n_samples × n_features), so that they tell samples by their `targets`: the
/// probability of the positive class, 0 or 1 where it is known for sure.
///
/// # Errors
/// Shapes that don't fit, or the library's reason.
pub fn train_boosted(
    features: &[f64],
    n_features: usize,
    targets: &[f64],
    params: &BoostingParams,
    seed: u64,
) -> Result<BoostedTrees, BoostingError> {
    let n_labels = targets.len();
    if n_features == 0 || n_features > usize::from(u16::MAX) || features.len() != n_labels * n_features {
        return Err(BoostingError::Shape { n_values: features.len(), n_labels, n_features });
    }
    let failed = |error: hessboost::error::HessboostError| BoostingError::Boosting(error.to_string());
    let single: Vec<f32> = features.iter().map(|value| *value as f32).collect();
    let labels: Vec<f32> = targets.iter().map(|target| *target as f32).collect();
    let data = DMatrix::from_dense(&single, n_labels, n_features).and_then(|data| data.with_labels(&labels));
    let data = data.map_err(failed)?;
    let library_params = hessboost::config::TrainingParams::builder()
        .objective(Objective::BinaryLogistic(RegLoss::default()))
        .tree_method(TreeMethod::Hist)
        .max_depth(params.max_depth)
        .eta(params.learning_rate)
        .subsample(params.subsample)
        .colsample_bynode(params.colsample_bynode)
        .min_child_weight(params.min_child_weight)
        .lambda(params.lambda)
        .seed(seed)
        .build()
        .map_err(failed)?;
    let grown = hessboost::training::train(&library_params, &data, params.n_rounds).map_err(failed)?;
    let trees = grown.trees().iter().map(|tree| Tree::from_nodes(tree.nodes())).collect();
    Ok(BoostedTrees { n_features, base: f64::from(grown.base_score()), trees })
}

impl Tree {
    fn from_nodes(nodes: &[hessboost::tree::Node]) -> Self {
        let mut tree = Tree { feature: Vec::new(), threshold: Vec::new(), left: Vec::new() };
        // Breadth first, so that siblings stand side by side.
        let mut order = vec![0];
        let mut idx = 0;
        while let Some(node) = order.get(idx).and_then(|node_idx: &usize| nodes.get(*node_idx)) {
            tree.feature.push(if node.is_leaf() { 0 } else { node.split_feature as u16 });
            tree.threshold.push(if node.is_leaf() { node.leaf_value } else { node.split_cond });
            tree.left.push(if node.is_leaf() { 0 } else { order.len() as u32 });
            if !node.is_leaf() {
                order.extend([node.left as usize, node.right as usize]);
            }
            idx += 1;
        }
        tree
    }

    fn value(&self, sample: &[f64]) -> f32 {
        let mut idx = 0;
        loop {
            let (left, threshold) = (self.left[idx] as usize, self.threshold[idx]);
            if left == 0 {
                return threshold;
            }
            // In single precision, as the trees were grown.
            idx = left + usize::from(!((sample[usize::from(self.feature[idx])] as f32) < threshold));
        }
    }

    fn validate(&self, n_features: usize) -> Result<(), String> {
        let n_nodes = self.left.len();
        if n_nodes == 0 || self.feature.len() != n_nodes || self.threshold.len() != n_nodes {
            return Err("its lists are empty or differ in length".into());
        }
        for (idx, left) in self.left.iter().map(|left| *left as usize).enumerate() {
            if left != 0 && (left <= idx || left + 1 >= n_nodes || usize::from(self.feature[idx]) >= n_features) {
                return Err(format!("node {idx} leads nowhere"));
            }
        }
        if !self.threshold.iter().all(|threshold| threshold.is_finite()) {
            return Err("a threshold is not finite".into());
        }
        Ok(())
    }
}

impl BoostedTrees {
    /// Decision value of one sample of `n_features` values; above 0 = the positive class is the more probable one. The
    /// sample must have that many values, and the trees must be valid.
    pub fn decision_value(&self, sample: &[f64]) -> f64 {
        self.base + self.trees.iter().map(|tree| f64::from(tree.value(sample))).sum::<f64>()
    }

    /// How many nodes all trees have.
    pub fn n_nodes(&self) -> usize {
        self.trees.iter().map(|tree| tree.left.len()).sum()
    }

    /// Checks trees that were read from a file.
    ///
    /// # Errors
    /// [`BoostingError::Tree`].
    pub fn validate(&self) -> Result<(), BoostingError> {
        for (tree_idx, tree) in self.trees.iter().enumerate() {
            tree.validate(self.n_features).map_err(|message| BoostingError::Tree { tree_idx, message })?;
        }
        if self.n_features == 0 || !self.base.is_finite() {
            return Err(BoostingError::Tree {
                tree_idx: 0,
                message: "no features, or a base that is not finite".into(),
            });
        }
        Ok(())
    }
}
