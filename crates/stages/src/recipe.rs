//! Recipes: the blocks of a feature and the learner.

use serde::{Deserialize, Serialize};

use crate::classifier::boosting::BoostingParams;
use crate::classifier::svm::SvmParams;
use crate::encoder::Block;

/// The blocks of a feature and the learner. A model keeps the recipe that made it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    pub name: String,
    pub blocks: Vec<Block>,
    /// Whether each value is scaled to mean 0 and standard deviation 1 over the training data.
    pub scaled: bool,
    /// Whether each value is scaled over the grasps of its recording day instead: see [`crate::day`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub day_baseline: bool,
    /// Size of the contact dictionary (the paper's k = 64).
    pub n_words: usize,
    /// σ of Eq. 3, metres (the paper's 36.45 mm).
    pub sigma_m: f64,
    pub learner: Learner,
}

/// The learner and its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Learner {
    Svm(SvmParams),
    Boosting(BoostingParams),
    /// Both; their decision values are added.
    Blend(BlendParams),
    /// None: the rule of a hand that no grasp has taught.
    Loads,
}

/// Boosted trees and a support vector machine side by side.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlendParams {
    pub boosting: BoostingParams,
    pub svm: SvmParams,
    /// Factor on the SVM's decision value before it is added to the trees' log-odds.
    pub svm_weight: f64,
}

impl Recipe {
    /// The names of the recipes that come with the program, the default one first.
    pub const NAMES: [&str; 6] = ["boosted", "wrist", "blend", "paper", "raw", "joints"];

    /// A recipe by its name. The parameters are the choice of a grid search on 12,000 simulated grasps of the built-in
    /// training objects (docs/learning.md); held-out objects were not used. Those of `blend` were not searched.
    pub fn named(name: &str) -> Option<Recipe> {
        if name == "boosted" {
            return Some(Recipe::default());
        }
        if name == "wrist" {
            // For hands on an arm that knows where gravity points and has a force sensor at the wrist.
            let mut recipe = Recipe { name: name.into(), ..Recipe::default() };
            recipe.blocks.extend([Block::Gravity, Block::Wrist]);
            return Some(recipe);
        }
        if name == "joints" {
            // No touch: the baseline of every model with touch.
            let blocks = vec![Block::Joints, Block::Breakaways];
            return Some(Recipe { name: name.into(), blocks, ..Recipe::default() });
        }
        let params = |c, gamma| SvmParams { c, gamma, tolerance: 1e-3, ..SvmParams::default() };
        let svm = |c, gamma| Learner::Svm(params(c, gamma));
        let (blocks, scaled, learner) = match name {
            // For dense skins whose cells read at rest too, where only the difference to the neighbours counts.
            "blend" => {
                let blocks = vec![Block::Cells, Block::RelativeCells, Block::Joints];
                let boosting =
                    BoostingParams { n_rounds: 500, max_depth: 6, colsample_bynode: 0.2, ..BoostingParams::default() };
                // 2.5: about the slope with which Platt's calibration makes log-odds of an SVM's decision value.
                (blocks, true, Learner::Blend(BlendParams { boosting, svm: params(10.0, 0.01), svm_weight: 2.5 }))
            }
            // Dang & Allen.
            "paper" => (vec![Block::Histogram], false, svm(30.0, 0.3)),
            // The earlier work that the paper compares itself with: cells and joints.
            "raw" => (vec![Block::Cells, Block::Joints], true, svm(10.0, 0.005)),
            _ => return None,
        };
        Some(Recipe { name: name.into(), blocks, scaled, learner, n_words: 64, ..Recipe::default() })
    }

    /// The recipe with a baseline of the day. Where it has the cells relative to their pads too, it leaves out their readings as
    /// such, which say more of the day than of the grasp (benches/archive.md, "Another day").
    #[must_use]
    pub fn with_day_baseline(mut self) -> Recipe {
        self.day_baseline = true;
        if self.blocks.contains(&Block::RelativeCells) {
            self.blocks.retain(|block| *block != Block::Cells);
            if let Learner::Blend(BlendParams { svm, .. }) = &mut self.learner {
                // Squared distances are of half as many values.
                svm.gamma *= 2.0;
            }
        }
        self
    }
}

impl Default for Recipe {
    /// The paper's histogram, the load of each pad as a whole and the joint angles, and boosted trees. The trees grow
    /// more slowly and with a higher penalty than by default, because the histogram nearly doubles the columns that a
    /// split may choose from by chance.
    fn default() -> Self {
        Recipe {
            name: "boosted".into(),
            blocks: vec![Block::Histogram, Block::Pads, Block::Joints, Block::Breakaways],
            scaled: false,
            day_baseline: false,
            // By cross-validation over folds of training objects: 64 words were 0.4 points worse.
            n_words: 8,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_a_baseline_a_blend_judges_cells_relative_to_their_pads_alone() {
        let [blend, raw] = ["blend", "raw"].map(|name| Recipe::named(name).expect("a recipe").with_day_baseline());
        assert_eq!(blend.blocks, [Block::RelativeCells, Block::Joints]);
        assert_eq!(raw.blocks, [Block::Cells, Block::Joints], "a recipe of cells alone keeps them");
    }
}
