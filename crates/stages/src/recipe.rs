//! Recipes: what a feature is made of and what machine learns from it.

use serde::{Deserialize, Serialize};

use crate::classifier::boosting::BoostingParams;
use crate::classifier::svm::SvmParams;
use crate::encoder::Block;

/// A way from labelled grasps to features and a machine; a model keeps the recipe that made it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// For people.
    pub name: String,
    /// The parts of a feature.
    pub blocks: Vec<Block>,
    /// Whether each value is scaled to mean 0 and standard deviation 1 over the training data.
    pub scaled: bool,
    /// Size of the contact dictionary (the paper's k = 64).
    pub n_words: usize,
    /// σ of Eq. 3, metres (the paper's 36.45 mm).
    pub sigma_m: f64,
    /// What learns.
    pub learner: Learner,
}

/// What learns, and with which parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Learner {
    /// A support vector machine with an RBF kernel.
    Svm(SvmParams),
    /// Gradient-boosted trees.
    Boosting(BoostingParams),
    /// Both, their decision values added.
    Blend(BlendParams),
}

/// Boosted trees and a support vector machine side by side.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlendParams {
    /// The trees.
    pub boosting: BoostingParams,
    /// The support vector machine.
    pub svm: SvmParams,
    /// What the support vector machine's decision value is multiplied with before it is added to the trees' log-odds.
    pub svm_weight: f64,
}

impl Recipe {
    /// The names of the recipes that come with the program, the default one first.
    pub const NAMES: [&str; 5] = ["boosted", "blend", "paper", "raw", "posture"];

    /// A recipe by its name. The parameters are the choice of `train --grid` on 12,000 simulated grasps of the built-in
    /// training objects (docs/learning.md); held-out objects had no say. Those of `blend` are not searched.
    pub fn named(name: &str) -> Option<Recipe> {
        if name == "boosted" {
            return Some(Recipe::default());
        }
        let params = |c, gamma| SvmParams { c, gamma, tolerance: 1e-3, ..SvmParams::default() };
        let svm = |c, gamma| Learner::Svm(params(c, gamma));
        let (blocks, scaled, learner) = match name {
            // For dense skins that read at rest as well, where a cell means something beside its neighbours only.
            "blend" => {
                let blocks = vec![Block::Cells, Block::RelativeCells, Block::Joints];
                let boosting =
                    BoostingParams { n_rounds: 500, max_depth: 6, colsample_bynode: 0.2, ..BoostingParams::default() };
                // 2.5: about the slope with which Platt's calibration makes log-odds of an SVM's decision value.
                (blocks, true, Learner::Blend(BlendParams { boosting, svm: params(10.0, 0.01), svm_weight: 2.5 }))
            }
            // Dang & Allen.
            "paper" => (vec![Block::Histogram], false, svm(30.0, 0.3)),
            // The earlier work that the paper compares itself with: cells and joints as they are.
            "raw" => (vec![Block::Cells, Block::Joints], true, svm(10.0, 0.005)),
            // The paper's feature with the joint angles beside it.
            "posture" => (vec![Block::Histogram, Block::Joints, Block::Breakaways], true, svm(10.0, 0.01)),
            _ => return None,
        };
        Some(Recipe { name: name.into(), blocks, scaled, n_words: 64, sigma_m: 0.03645, learner })
    }
}

impl Default for Recipe {
    /// The paper's histogram, the load of each pad as a whole and the joint angles, and boosted trees. The trees grow more slowly
    /// and with a higher penalty than by default, because the histogram nearly doubles the columns that a split may choose
    /// from by chance (docs/learning.md).
    fn default() -> Self {
        Recipe {
            name: "boosted".into(),
            blocks: vec![Block::Histogram, Block::Pads, Block::Joints, Block::Breakaways],
            scaled: false,
            n_words: 64,
            sigma_m: 0.03645,
            learner: Learner::Boosting(BoostingParams {
                n_rounds: 350,
                learning_rate: 0.03,
                min_child_weight: 3.0,
                lambda: 5.0,
                ..BoostingParams::default()
            }),
        }
    }
}
