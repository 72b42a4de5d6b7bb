//! Gradient-boosted decision trees: they decide better than the paper's SVM on features of mixed units.
//! They are grown by the crate `learning`.

use serde::{Deserialize, Serialize};

/// So many trees are gone down at once.
const N_AT_ONCE: usize = 8;

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
    pub fn validate(&self) -> Result<(), BoostingError> {
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
#[serde(into = "TreeFile", try_from = "TreeFile")]
pub struct Tree {
    pub nodes: Vec<TreeNode>,
}

/// A split or a leaf. What a step from node to node needs lies together: most steps are a cache miss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TreeNode {
    /// A sample goes left if its value is below this. For a leaf: its contribution to the decision value.
    pub threshold: f32,
    /// Index of the left child; 0 for a leaf.
    pub left: u32,
    /// Index of the value that a node compares; 0 for a leaf.
    pub feature: u16,
}

/// A tree as it stands in a model file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TreeFile {
    feature: Vec<u16>,
    threshold: Vec<f32>,
    left: Vec<u32>,
}

impl From<Tree> for TreeFile {
    fn from(tree: Tree) -> Self {
        let nodes = || tree.nodes.iter();
        TreeFile {
            feature: nodes().map(|node| node.feature).collect(),
            threshold: nodes().map(|node| node.threshold).collect(),
            left: nodes().map(|node| node.left).collect(),
        }
    }
}

impl TryFrom<TreeFile> for Tree {
    type Error = &'static str;

    fn try_from(file: TreeFile) -> Result<Self, Self::Error> {
        if file.left.len() != file.threshold.len() || file.left.len() != file.feature.len() {
            return Err("the lists of a tree differ in length");
        }
        let lists = file.threshold.into_iter().zip(file.left).zip(file.feature);
        Ok(Tree { nodes: lists.map(|((threshold, left), feature)| TreeNode { threshold, left, feature }).collect() })
    }
}

#[cfg(test)]
impl Tree {
    /// A split with the values of its two leaves.
    pub(crate) fn stump(feature: u16, threshold: f32, values: [f32; 2]) -> Tree {
        let [left, right] = values.map(TreeNode::leaf);
        Tree { nodes: vec![TreeNode { threshold, left: 1, feature }, left, right] }
    }
}

impl TreeNode {
    /// A leaf with its contribution to the decision value.
    pub fn leaf(value: f32) -> TreeNode {
        TreeNode { threshold: value, left: 0, feature: 0 }
    }
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
    #[inline]
    pub fn value(&self, sample: &[f64]) -> f32 {
        let mut node = self.nodes[0];
        while node.left != 0 {
            node = self.next(node, sample);
        }
        node.threshold
    }

    /// The child of a split that a sample goes to.
    #[inline]
    fn next(&self, split: TreeNode, sample: &[f64]) -> TreeNode {
        self.nodes[next_idx(split, sample)]
    }

    /// For each node, the mean of both sides of each split below it.
    fn means(&self) -> Vec<f64> {
        let mut means: Vec<f64> = self.nodes.iter().map(|node| f64::from(node.threshold)).collect();
        // Children come after their parent.
        for (idx, node) in self.nodes.iter().enumerate().rev() {
            let left = node.left as usize;
            if left != 0 {
                means[idx] = (means[left] + means[left + 1]) / 2.0;
            }
        }
        means
    }

    fn validate(&self, n_features: usize) -> Result<(), String> {
        let n_nodes = self.nodes.len();
        if n_nodes == 0 {
            return Err("it has no nodes".into());
        }
        for (idx, node) in self.nodes.iter().enumerate() {
            let left = node.left as usize;
            if left != 0 && (left <= idx || left + 1 >= n_nodes || usize::from(node.feature) >= n_features) {
                return Err(format!("node {idx} leads nowhere"));
            }
        }
        if !self.nodes.iter().all(|node| node.threshold.is_finite()) {
            return Err("a threshold is not finite".into());
        }
        Ok(())
    }
}

#[inline]
fn next_idx(split: TreeNode, sample: &[f64]) -> usize {
    // Trees are grown on values in single precision.
    let is_right = sample[usize::from(split.feature)] as f32 >= split.threshold;
    split.left as usize + usize::from(is_right)
}

impl BoostedTrees {
    /// The effect of each value of a sample on the decision value (Saabas, "Interpreting random forests", 2014, with equal
    /// weights of the sides). Each split that asks for it adds how far the sample's side lies from the mean of both sides.
    pub fn contributions(&self, sample: &[f64]) -> Vec<f64> {
        let mut contributions = vec![0.0; self.n_features];
        for tree in &self.trees {
            let means = tree.means();
            let mut idx = 0;
            while tree.nodes[idx].left != 0 {
                let next = next_idx(tree.nodes[idx], sample);
                contributions[usize::from(tree.nodes[idx].feature)] += means[next] - means[idx];
                idx = next;
            }
        }
        contributions
    }

    /// Decision value of one sample of `n_features` values; above 0 = the positive class is the more probable one. The
    /// sample must have that many values, and the trees must be valid.
    pub fn decision_value(&self, sample: &[f64]) -> f64 {
        let mut sum = 0.0;
        // Several trees are gone down at once: while one waits for memory, the others go on.
        let (groups, rest) = self.trees.as_chunks::<N_AT_ONCE>();
        for trees in groups {
            let mut nodes = trees.each_ref().map(|tree| tree.nodes[0]);
            while nodes.iter().any(|node| node.left != 0) {
                for (node, tree) in nodes.iter_mut().zip(trees).filter(|(node, _)| node.left != 0) {
                    *node = tree.next(*node, sample);
                }
            }
            sum = nodes.iter().fold(sum, |sum, leaf| sum + f64::from(leaf.threshold));
        }
        self.base + rest.iter().fold(sum, |sum, tree| sum + f64::from(tree.value(sample)))
    }

    /// How many nodes all trees have.
    pub fn n_nodes(&self) -> usize {
        self.trees.iter().map(|tree| tree.nodes.len()).sum()
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
        let leaf = Tree { nodes: vec![TreeNode::leaf(0.5)] };
        let split = Tree::stump(1, 0.5, [-1.0, 1.0]);
        let good = BoostedTrees { n_features: 2, base: 0.25, trees: vec![leaf, split.clone()] };
        good.validate().unwrap();
        assert_eq!(good.decision_value(&[9.0, 0.4]), -0.25);
        assert_eq!(good.decision_value(&[9.0, 0.5]), 1.75);
        let changed = |idx: usize, node: TreeNode| {
            let mut tree = split.clone();
            tree.nodes[idx] = node;
            tree
        };
        for bad in [
            changed(0, TreeNode { left: 2, ..split.nodes[0] }),
            changed(0, TreeNode { feature: 2, ..split.nodes[0] }),
            changed(1, TreeNode { left: 1, ..split.nodes[1] }),
            changed(0, TreeNode { threshold: f32::NAN, ..split.nodes[0] }),
            Tree { nodes: vec![] },
        ] {
            assert!(BoostedTrees { trees: vec![bad.clone()], ..good.clone() }.validate().is_err(), "{bad:?}");
        }
        let json = serde_json::to_string(&split).unwrap();
        assert_eq!(json, r#"{"feature":[1,0,0],"threshold":[0.5,-1.0,1.0],"left":[1,0,0]}"#);
        assert_eq!(serde_json::from_str::<Tree>(&json).unwrap(), split);
        let unequal = serde_json::from_str::<Tree>(r#"{"feature":[1],"threshold":[0.5],"left":[1,0,0]}"#);
        assert!(unequal.unwrap_err().to_string().contains("differ in length"));
    }

    #[test]
    fn trees_gone_down_at_once_say_the_same_as_one_after_the_other() {
        // 19 trees: two groups of eight, and three. Their depths differ.
        let trees: Vec<Tree> = (0..19_u16)
            .map(|idx| match idx % 3 {
                0 => Tree { nodes: vec![TreeNode::leaf(f32::from(idx))] },
                _ => Tree::stump(idx % 2, f32::from(idx) / 10.0, [-0.1 * f32::from(idx), 0.3]),
            })
            .collect();
        let trees = BoostedTrees { n_features: 2, base: 0.25, trees };
        let mean: f64 = trees.trees.iter().map(|tree| tree.means()[0]).sum();
        for sample in [[0.0, 2.0], [1.0, 0.5], [0.55, 0.75]] {
            let sum: f64 = trees.trees.iter().map(|tree| f64::from(tree.value(&sample))).sum();
            assert_eq!(trees.decision_value(&sample), 0.25 + sum);
            let contributions: f64 = trees.contributions(&sample).iter().sum();
            assert!((contributions - (sum - mean)).abs() < 1e-9, "{contributions}");
        }
    }
}
