//! Judging grasps by machines that were not trained on them.
//!
//! For each fold, dictionary, scaling, machine and calibration are fitted on the other folds alone. The calibration is
//! fitted as training does it: on decision values out of inner folds, split as the outer ones. No choice depends on the
//! figures of a fold.

use std::collections::BTreeSet;

use super::EvaluationError;
use super::split::{Split, SplitError, split_into_folds};
use crate::learners::platt::fit_platt;
use crate::training::{Example, Fitted, TrainingError, cross_validate, fit, picked};
use blindgrasp_pictures::DrawnWord;
use blindgrasp_stages::dictionary::Dictionary;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::recipe::Recipe;

#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutOptions {
    pub split: Split,
    pub n_folds: usize,
    pub recipes: Vec<Recipe>,
    /// The seed of folds, K-means and boosting.
    pub seed: u64,
}

/// All examples judged once.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    /// The fold of each example.
    pub folds: Vec<usize>,
    /// For each recipe, the probability that each example is stable.
    pub probabilities: Vec<Vec<f64>>,
    /// The dictionary of the first recipe's first fold.
    pub words: Vec<DrawnWord>,
}

/// A step of the work, for progress.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    pub n_done: usize,
    pub n: usize,
    pub what: String,
}

/// Folds within the training data; the calibration is fitted on their decision values.
pub const N_INNER_FOLDS: usize = 3;

/// Judges every example by each recipe, trained on the folds that it is not in. `progress` is called before each step.
///
/// # Errors
/// The examples cannot be split so, or a recipe cannot be trained without a fold.
pub fn judge_held_out(
    hand: &Hand,
    examples: &[&Example],
    options: &HeldOutOptions,
    mut progress: impl FnMut(&Step),
) -> Result<HeldOut, EvaluationError> {
    let HeldOutOptions { split, n_folds, recipes, seed } = options;
    let folds = split_into_folds(*split, examples, *n_folds, *seed)?;
    let mut step = Step { n_done: 0, n: recipes.len() * n_folds, what: String::new() };
    let (mut all, mut words) = (vec![vec![0.0; examples.len()]; recipes.len()], Vec::new());
    for fold in 0..*n_folds {
        let (held_out, training): (Vec<usize>, Vec<usize>) = (0..folds.len()).partition(|idx| folds[*idx] == fold);
        let (judged, training) = (picked(examples, &held_out), picked(examples, &training));
        for (recipe_idx, recipe) in recipes.iter().enumerate() {
            step.what = format!("recipe {}, fold {} of {n_folds}", recipe.name, fold + 1);
            progress(&step);
            let (probabilities, fitted) = judge(hand, *split, recipe, &training, &judged, *seed)
                .map_err(|source| EvaluationError::Fit { what: step.what.clone(), source })?;
            step.n_done += 1;
            if (fold, recipe_idx) == (0, 0) {
                words = used_words(&fitted.features.dictionary, training.iter().copied());
            }
            for (idx, probability) in held_out.iter().zip(probabilities) {
                all[recipe_idx][*idx] = probability;
            }
        }
    }
    Ok(HeldOut { folds, probabilities: all, words })
}

/// A dictionary's words and their use in these examples.
pub fn used_words<'a>(dictionary: &Dictionary, examples: impl Iterator<Item = &'a Example>) -> Vec<DrawnWord> {
    let mut n_of_word = vec![(0_usize, 0_usize); dictionary.len()];
    let mut n_contacts = 0;
    for example in examples {
        for contact in &example.contacts {
            if let Some((word_idx, _)) = dictionary.nearest(contact.position_m) {
                n_contacts += 1;
                n_of_word[word_idx].0 += 1;
                n_of_word[word_idx].1 += usize::from(example.stable);
            }
        }
    }
    let share = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);
    let word = |(position_m, (n, n_stable)): (&[f64; 3], (usize, usize))| DrawnWord {
        position_m: *position_m,
        share_of_contacts: share(n, n_contacts),
        share_stable: share(n_stable, n),
    };
    dictionary.words_m.iter().zip(n_of_word).map(word).collect()
}

/// The probabilities of `held_out` by a machine and a calibration that were fitted on `training` alone.
fn judge(
    hand: &Hand,
    split: Split,
    recipe: &Recipe,
    training: &[&Example],
    held_out: &[&Example],
    seed: u64,
) -> Result<(Vec<f64>, Fitted), TrainingError> {
    let folds = inner_folds(split, training, seed)?;
    let inner = cross_validate(hand, recipe, training, &folds, seed, |_| {})?;
    let labels: Vec<bool> = training.iter().map(|example| example.stable).collect();
    let calibration = fit_platt(&inner, &labels)?;
    let fitted = fit(hand, recipe, training, seed)?;
    let values = fitted.decision_values(held_out)?;
    Ok((values.into_iter().map(|value| calibration.probability(value)).collect(), fitted))
}

/// Folds within the training examples, split as the outer ones: the calibration then sees grasps as new to the machine as
/// the judged ones. If all training examples are of one class, folds are split by object.
fn inner_folds(split: Split, training: &[&Example], seed: u64) -> Result<Vec<usize>, TrainingError> {
    let n_classes = training.iter().map(|example| &example.class).collect::<BTreeSet<_>>().len();
    let (split, n_groups) = match split {
        Split::Grasp => (Split::Grasp, training.len()),
        Split::Class if n_classes > 1 => (Split::Class, n_classes),
        Split::Class | Split::Object => (Split::Object, n_objects(training)),
    };
    split_into_folds(split, training, N_INNER_FOLDS.min(n_groups), seed).map_err(|error| {
        // Nobody can ask for other inner folds.
        TrainingError::Data(match error {
            SplitError::TooFewFolds(_) | SplitError::OneLabel { .. } => format!(
                "the calibration is fitted on the {} of the other folds, split once more: expected {} there, and more if a \
                 part holds them all; give recordings of more {}",
                split.counted(n_groups),
                split.needed(),
                split.words()
            ),
            other => format!("the calibration: {other}"),
        })
    })
}

fn n_objects(examples: &[&Example]) -> usize {
    examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::split::tests::examples;
    use blindgrasp_messages::Contact;

    #[test]
    fn too_few_objects_for_the_calibration_say_how_many_are_needed() {
        for (names, counted) in [(&[("a", "x", 6)][..], "1 object"), (&[("a", "x", 6), ("b", "x", 1)][..], "2 objects")]
        {
            let all = examples(names);
            let error =
                inner_folds(Split::Object, &all.iter().collect::<Vec<_>>(), 1).expect_err("refused").to_string();
            let expected = format!("the calibration is fitted on the {counted} of the other folds");
            assert!(error.starts_with(&expected) && error.contains("at least 2 objects"), "{error}");
            assert!(error.ends_with("give recordings of more objects"), "{error}");
        }
    }

    #[test]
    fn words_count_the_contacts_nearest_to_them() {
        let mut all = examples(&[("a", "x", 2)]);
        let at = |x| Contact { position_m: [x, 0.0, 0.0], ..Contact::default() };
        all[0].contacts = vec![at(0.0), at(0.1), at(1.0)];
        all[1].contacts = vec![at(0.2)];
        let dictionary = Dictionary { words_m: vec![[0.0; 3], [1.0, 0.0, 0.0], [9.0, 0.0, 0.0]] };
        let words = used_words(&dictionary, all.iter());
        let found: Vec<_> = words.iter().map(|word| (word.share_of_contacts, word.share_stable)).collect();
        assert_eq!(found, [(Some(0.75), Some(2.0 / 3.0)), (Some(0.25), Some(1.0)), (Some(0.0), None)]);
    }
}
