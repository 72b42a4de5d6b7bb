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
            n_rounds: 250,
            learning_rate: 0.04,
            max_depth: 8,
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
            idx = left + usize::from(sample[usize::from(self.feature[idx])] as f32 >= threshold);
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Two values each; the positive class is where both are on the same side of a half.
    fn samples() -> (Vec<f64>, Vec<f64>) {
        let value = |idx: usize, column: usize| ((idx * idx * 37 + idx * 101 * (column + 1)) % 1009) as f64 / 1009.0;
        let features: Vec<f64> = (0..2000).flat_map(|idx| [value(idx, 0), value(idx, 1)]).collect();
        let targets = features.chunks(2).map(|row| f64::from(u8::from((row[0] > 0.5) == (row[1] > 0.5)))).collect();
        (features, targets)
    }

    fn params() -> BoostingParams {
        BoostingParams { n_rounds: 60, learning_rate: 0.3, max_depth: 4, ..BoostingParams::default() }
    }

    #[test]
    fn learns_what_no_line_can_tell() {
        let (features, targets) = samples();
        let trees = train_boosted(&features, 2, &targets, &params(), 1).unwrap();
        trees.validate().unwrap();
        let right =
            features.chunks(2).zip(&targets).filter(|(row, y)| (trees.decision_value(row) > 0.0) == (**y > 0.5));
        assert!(right.count() > 1950);
        assert!(trees.decision_value(&[0.9, 0.9]) > 1.0 && trees.decision_value(&[0.9, 0.1]) < -1.0);
    }

    #[test]
    fn values_are_the_librarys() {
        let (features, targets) = samples();
        let single: Vec<f32> = features.iter().map(|value| *value as f32).collect();
        let labels: Vec<f32> = targets.iter().map(|target| *target as f32).collect();
        let data = DMatrix::from_dense(&single, 2000, 2).unwrap().with_labels(&labels).unwrap();
        let theirs = hessboost::config::TrainingParams::builder()
            .objective(Objective::BinaryLogistic(RegLoss::default()))
            .tree_method(TreeMethod::Hist)
            .max_depth(4)
            .eta(0.3)
            .subsample(0.7)
            .colsample_bynode(0.4)
            .seed(1)
            .build()
            .unwrap();
        let theirs = hessboost::training::train(&theirs, &data, 60).unwrap();
        let theirs = theirs.predict(&data, hessboost::model::Iterations::Best).unwrap();
        let ours = train_boosted(&features, 2, &targets, &params(), 1).unwrap();
        for (idx, row) in features.chunks(2).enumerate() {
            let probability = 1.0 / (1.0 + (-ours.decision_value(row)).exp());
            assert!((probability - f64::from(*theirs.get(idx, 0).unwrap())).abs() < 1e-5, "row {idx}");
        }
    }

    #[test]
    fn number_of_threads_changes_no_bit() {
        let (features, targets) = samples();
        let grow = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            pool.install(|| train_boosted(&features, 2, &targets, &params(), 7)).unwrap()
        };
        assert_eq!(grow(1), grow(3));
        assert_ne!(grow(1), train_boosted(&features, 2, &targets, &params(), 8).unwrap());
    }

    #[test]
    fn trees_that_lead_nowhere_are_refused() {
        let leaf = Tree { feature: vec![0], threshold: vec![0.5], left: vec![0] };
        let split = Tree { feature: vec![1, 0, 0], threshold: vec![0.5, -1.0, 1.0], left: vec![1, 0, 0] };
        let good = BoostedTrees { n_features: 2, base: 0.25, trees: vec![leaf, split.clone()] };
        good.validate().unwrap();
        assert_eq!(good.decision_value(&[9.0, 0.4]), -0.25);
        assert_eq!(good.decision_value(&[9.0, 0.5]), 1.75);
        for bad in [
            Tree { left: vec![0, 0], ..split.clone() },
            Tree { left: vec![2, 0, 0], ..split.clone() },
            Tree { feature: vec![2, 0, 0], ..split.clone() },
            Tree { left: vec![1, 1, 0], ..split.clone() },
            Tree { threshold: vec![f32::NAN, 0.0, 0.0], ..split.clone() },
            Tree { feature: vec![], threshold: vec![], left: vec![] },
        ] {
            assert!(BoostedTrees { trees: vec![bad.clone()], ..good.clone() }.validate().is_err(), "{bad:?}");
        }
        assert!(train_boosted(&[1.0], 2, &[1.0], &params(), 1).is_err());
    }
}
