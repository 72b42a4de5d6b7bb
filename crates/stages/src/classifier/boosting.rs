//! Gradient-boosted decision trees: they decide better than the paper's SVM on features of mixed units.
//! `super::booster` grows them.

use serde::{Deserialize, Serialize};

/// How trees are grown, named as in XGBoost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoostingParams {
    /// Number of trees.
    pub n_rounds: usize,
    /// Factor on each tree's values.
    pub learning_rate: f64,
    /// Greatest depth of a tree.
    pub max_depth: usize,
    /// Share of the samples that each tree sees.
    pub subsample: f64,
    /// Share of the columns that each split may choose from.
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

impl BoostingParams {
    /// Checks the range of each parameter.
    ///
    /// # Errors
    /// [`BoostingError::Params`].
    pub(super) fn validate(&self) -> Result<(), BoostingError> {
        let share = |value: f64| value > 0.0 && value <= 1.0;
        let not_negative = |value: f64| value.is_finite() && value >= 0.0;
        let checks = [
            (
                "learning_rate",
                self.learning_rate,
                "more than 0",
                not_negative(self.learning_rate) && self.learning_rate > 0.0,
            ),
            ("subsample", self.subsample, "more than 0 and at most 1", share(self.subsample)),
            ("colsample_bynode", self.colsample_bynode, "more than 0 and at most 1", share(self.colsample_bynode)),
            ("min_child_weight", self.min_child_weight, "at least 0", not_negative(self.min_child_weight)),
            ("lambda", self.lambda, "at least 0", not_negative(self.lambda)),
        ];
        match checks.into_iter().find(|check| !check.3) {
            Some((name, value, expected, _)) => Err(BoostingError::Params { name, value, expected }),
            None => Ok(()),
        }
    }
}

/// Boosted trees; the decision value is a log-odds of the positive class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoostedTrees {
    pub n_features: usize,
    /// The decision value before any tree.
    pub base: f64,
    pub trees: Vec<Tree>,
}

/// A tree, node by node; children come after their parent, the right one just after the left one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tree {
    /// Index of the value that a node compares; 0 for a leaf.
    pub feature: Vec<u16>,
    /// A sample goes left if its value is below this. For a leaf: its contribution to the decision value.
    pub threshold: Vec<f32>,
    /// Index of the left child; 0 for a leaf.
    pub left: Vec<u32>,
}

/// Why trees could not be grown or are not valid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BoostingError {
    #[error(
        "{n_values} values for {n_labels} labels: expected {n_features} values for each label, at least one of each and at \
         most {} for a label",
        u16::MAX
    )]
    Shape { n_values: usize, n_labels: usize, n_features: usize },
    #[error("a value or a target is out of range: expected finite single-precision values and targets from 0 to 1")]
    Values,
    #[error("{name} of boosting is {value}: expected {expected}")]
    Params { name: &'static str, value: f64, expected: &'static str },
    #[error("tree {tree_idx}: {message}")]
    Tree { tree_idx: usize, message: String },
}

impl Tree {
    /// The sample's contribution to the decision value.
    pub(super) fn value(&self, sample: &[f64]) -> f32 {
        let mut idx = 0;
        loop {
            let (left, threshold) = (self.left[idx] as usize, self.threshold[idx]);
            if left == 0 {
                return threshold;
            }
            // Trees are grown on values in single precision.
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
    }
}
