//! Judging grasps by machines that were not trained on them.
//!
//! For each fold, dictionary, scaling, machine and calibration are fitted on the other folds alone. The calibration is
//! fitted as training does it: on decision values out of inner folds, split as the outer ones. No choice depends on the
//! figures of a fold.

use std::collections::BTreeSet;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::EvaluationError;
use super::split::{Split, SplitError, check_disjoint, shuffle, split_into_folds};
use crate::learners::platt::fit_platt;
use crate::training::{Example, Fitted, TrainingError, cross_validate, fit, picked};
use blindgrasp_stages::dictionary::Dictionary;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::recipe::Recipe;

#[derive(Debug, Clone, PartialEq)]
pub struct HeldOutOptions {
    pub split: Split,
    pub n_folds: usize,
    pub recipes: Vec<Recipe>,
    /// The seed of folds, K-means and boosting. Repeat `i` splits by `seed + i`.
    pub seed: u64,
    /// The number of times that all is done, each time with other folds.
    pub n_repeats: usize,
    /// Whether to learn from growing parts of the grasps, too.
    pub learning_curve: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    pub repeats: Vec<Repeat>,
    /// Recipes trained on growing parts of all folds but the first of the first repeat, judged on that fold.
    pub learning_curve: Vec<LearningStep>,
    /// The dictionary of the first recipe's first fold.
    pub words: Vec<Word>,
}

/// All examples judged once.
#[derive(Debug, Clone, PartialEq)]
pub struct Repeat {
    pub seed: u64,
    /// The fold of each example.
    pub folds: Vec<usize>,
    /// For each recipe, the probability that each example is stable.
    pub probabilities: Vec<Vec<f64>>,
}

/// A recipe that learned from a part of the examples.
#[derive(Debug, Clone, PartialEq)]
pub struct LearningStep {
    pub recipe_idx: usize,
    /// The share of the training objects (grasps, for a split by grasp).
    pub share: f64,
    pub n_objects: usize,
    pub n_grasps: usize,
    /// The indices of the judged examples and their probabilities, or why the part was too small to learn from.
    pub judged: Result<Vec<(usize, f64)>, String>,
}

/// A word of a contact dictionary and the contacts that are nearest to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Word {
    /// Metres in the palm frame.
    pub position_m: [f64; 3],
    /// The share of all contacts that are nearest to this word; `None` if there are no contacts.
    pub share_of_contacts: Option<f64>,
    /// The share of these contacts that are of stable grasps; `None` if there are none.
    pub share_stable: Option<f64>,
}

/// A step of the work, for progress.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    pub n_done: usize,
    pub n: usize,
    pub what: String,
}

/// The shares of the training objects that the learning curve learns from, before all of them.
const LEARNING_SHARES: [f64; 4] = [0.1, 0.2, 0.4, 0.7];
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
    let HeldOutOptions { split, n_folds, recipes, seed, n_repeats, learning_curve } = options;
    // Splits that fail must fail before the long work.
    let seeds: Vec<u64> = (0..*n_repeats as u64).map(|repeat| seed.wrapping_add(repeat)).collect();
    let splits: Vec<Vec<usize>> =
        seeds.iter().map(|seed| split_into_folds(*split, examples, *n_folds, *seed)).collect::<Result<_, _>>()?;
    let n_shares = if *learning_curve { LEARNING_SHARES.len() } else { 0 };
    let step = Step { n_done: 0, n: recipes.len() * (n_repeats * n_folds + n_shares), what: String::new() };
    let mut judging = Judging { hand, examples, options, step, progress: &mut progress };
    let mut learned = Vec::new();
    if let (true, Some(folds)) = (learning_curve, splits.first()) {
        learned = judging.learning_curve(folds)?;
    }
    let (mut repeats, mut words) = (Vec::new(), Vec::new());
    for (repeat_idx, (folds, seed)) in splits.into_iter().zip(seeds).enumerate() {
        check_disjoint(*split, examples, &folds)?;
        let mut all = vec![vec![0.0; examples.len()]; recipes.len()];
        for fold in 0..*n_folds {
            let (held_out, training) = parts(&folds, fold);
            for (recipe_idx, recipe) in recipes.iter().enumerate() {
                let of_repeats =
                    if *n_repeats > 1 { format!(", repeat {} of {n_repeats}", repeat_idx + 1) } else { String::new() };
                let what = format!("fold {} of {n_folds}{of_repeats}", fold + 1);
                let (probabilities, fitted) = judging.judge(recipe, &training, &held_out, what)?;
                if (repeat_idx, fold) == (0, 0) {
                    if *learning_curve {
                        let judged = held_out.iter().copied().zip(probabilities.iter().copied()).collect();
                        learned.push(learning_step(examples, recipe_idx, 1.0, &training, Ok(judged)));
                    }
                    if recipe_idx == 0 {
                        words = used_words(&fitted.features.dictionary, training.iter().map(|idx| examples[*idx]));
                    }
                }
                for (idx, probability) in held_out.iter().zip(probabilities) {
                    all[recipe_idx][*idx] = probability;
                }
            }
        }
        repeats.push(Repeat { seed, folds, probabilities: all });
    }
    learned.sort_by_key(|step| step.recipe_idx);
    Ok(HeldOut { repeats, learning_curve: learned, words })
}

/// The work on examples, step by step.
struct Judging<'a> {
    hand: &'a Hand,
    examples: &'a [&'a Example],
    options: &'a HeldOutOptions,
    step: Step,
    progress: &'a mut dyn FnMut(&Step),
}

impl Judging<'_> {
    fn judge(
        &mut self,
        recipe: &Recipe,
        training: &[usize],
        held_out: &[usize],
        what: String,
    ) -> Result<(Vec<f64>, Fitted), EvaluationError> {
        let HeldOutOptions { split, seed, .. } = self.options;
        self.step.what = format!("recipe {}, {what}", recipe.name);
        (self.progress)(&self.step);
        let (training, held_out) = (picked(self.examples, training), picked(self.examples, held_out));
        let judged = judge(self.hand, *split, recipe, &training, &held_out, *seed);
        self.step.n_done += 1;
        judged.map_err(|source| EvaluationError::Fit { what: self.step.what.clone(), source })
    }

    /// Recipes trained on growing parts of all folds but the first, before all of them.
    fn learning_curve(&mut self, folds: &[usize]) -> Result<Vec<LearningStep>, EvaluationError> {
        let HeldOutOptions { split, recipes, seed, .. } = self.options;
        let (held_out, training) = parts(folds, 0);
        let mut learned = Vec::new();
        for (share, training) in nested(*split, self.examples, &training, *seed) {
            for (recipe_idx, recipe) in recipes.iter().enumerate() {
                let what = format!("learning curve at {:.0} %", 100.0 * share);
                let judged = match self.judge(recipe, &training, &held_out, what) {
                    Ok((probabilities, _)) => Ok(held_out.iter().copied().zip(probabilities).collect()),
                    // A small part may have too few contacts for a dictionary; larger parts are still tried.
                    Err(EvaluationError::Fit { source, .. }) => Err(with_causes(&source)),
                    Err(other) => return Err(other),
                };
                learned.push(learning_step(self.examples, recipe_idx, share, &training, judged));
            }
        }
        Ok(learned)
    }
}

/// A dictionary's words and their use in these examples.
pub fn used_words<'a>(dictionary: &Dictionary, examples: impl Iterator<Item = &'a Example>) -> Vec<Word> {
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
    let word = |(position_m, (n, n_stable)): (&[f64; 3], (usize, usize))| Word {
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

/// The indices of a fold, and of all others.
fn parts(folds: &[usize], fold: usize) -> (Vec<usize>, Vec<usize>) {
    (0..folds.len()).partition(|idx| folds[*idx] == fold)
}

fn n_objects(examples: &[&Example]) -> usize {
    examples.iter().map(|example| &example.object).collect::<BTreeSet<_>>().len()
}

/// Growing parts of the training examples, each within the next. They grow by objects, so that larger parts have more
/// different objects; for a split by grasp, they grow by grasps.
fn nested(split: Split, examples: &[&Example], training: &[usize], seed: u64) -> Vec<(f64, Vec<usize>)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut groups: Vec<Vec<usize>> = match split {
        Split::Grasp => training.iter().map(|idx| vec![*idx]).collect(),
        Split::Object | Split::Class => {
            let objects: BTreeSet<&str> = training.iter().map(|idx| examples[*idx].object.as_str()).collect();
            let of = |object: &str| training.iter().copied().filter(|idx| examples[*idx].object == object).collect();
            objects.into_iter().map(of).collect()
        }
    };
    shuffle(&mut groups, &mut random);
    let first = |share: f64| {
        let n = (share * groups.len() as f64).ceil() as usize;
        let mut idxs: Vec<usize> = groups[..n].iter().flatten().copied().collect();
        // Training takes examples in the recordings' order.
        idxs.sort_unstable();
        idxs
    };
    LEARNING_SHARES.into_iter().map(|share| (share, first(share))).collect()
}

fn learning_step(
    examples: &[&Example],
    recipe_idx: usize,
    share: f64,
    training: &[usize],
    judged: Result<Vec<(usize, f64)>, String>,
) -> LearningStep {
    let training: Vec<&Example> = training.iter().map(|idx| examples[*idx]).collect();
    LearningStep { recipe_idx, share, n_objects: n_objects(&training), n_grasps: training.len(), judged }
}

/// An error and its causes in a line.
fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::split::tests::examples;
    use blindgrasp_messages::Contact;

    #[test]
    fn learning_parts_are_nested_and_of_whole_objects() {
        let all = examples(&[("a", "x", 5), ("b", "x", 6), ("c", "x", 7), ("d", "y", 8), ("e", "y", 9)]);
        let all: Vec<&Example> = all.iter().collect();
        let training: Vec<usize> = (0..all.len()).collect();
        let parts = nested(Split::Object, &all, &training, 3);
        assert_eq!(parts.len(), LEARNING_SHARES.len());
        for (_, part) in &parts {
            for object in ["a", "b", "c", "d", "e"] {
                let n = part.iter().filter(|idx| all[**idx].object == object).count();
                assert!(n == 0 || n == all.iter().filter(|example| example.object == object).count());
            }
        }
        for pair in parts.windows(2) {
            assert!(pair[0].1.iter().all(|idx| pair[1].1.contains(idx)) && pair[0].1.len() <= pair[1].1.len());
        }
        let sizes: Vec<usize> = nested(Split::Grasp, &all, &training, 3).iter().map(|(_, part)| part.len()).collect();
        assert_eq!(sizes, [4, 7, 14, 25]);
    }

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
