//! Splits of grasps into folds, each judged by a machine that was trained on the others.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use crate::training::Example;

/// The thing that no two folds have in common.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Grasps: random folds, each with the same share of stable ones. The objects are known from other grasps.
    Grasp,
    /// Objects: each judged grasp is of an object that training has not seen.
    Object,
    /// Classes: each judged grasp is of a class that training has not seen.
    Class,
}

#[derive(Debug, thiserror::Error)]
pub enum SplitError {
    /// Fewer than two folds.
    #[error("expected at least 2 folds, one to judge and one to train on, found {0}")]
    TooFewFolds(usize),
    /// A fold would be empty.
    #[error(
        "{} for {n_folds} folds: expected one for each; ask for fewer folds (2 at least), or give recordings of more {}",
        split.counted(*n_groups),
        split.words()
    )]
    TooFewGroups { split: Split, n_groups: usize, n_folds: usize },
    /// Nothing can be learned from grasps that are all alike.
    #[error(
        "without fold {} of {n_folds}, only {} grasps are left to train on ({n_grasps}): expected {}; ask for more folds, or \
         give recordings of more {}",
        fold + 1,
        if *stable { "stable" } else { "unstable" },
        split.needed(),
        split.words()
    )]
    OneLabel { split: Split, fold: usize, n_folds: usize, n_grasps: usize, stable: bool },
}

impl Split {
    pub fn word(self) -> &'static str {
        match self {
            Split::Grasp => "grasp",
            Split::Object => "object",
            Split::Class => "class",
        }
    }

    /// The word for several.
    pub fn words(self) -> &'static str {
        match self {
            Split::Grasp => "grasps",
            Split::Object => "objects",
            Split::Class => "classes",
        }
    }

    /// So many, for people.
    pub fn counted(self, n: usize) -> String {
        format!("{n} {}", if n == 1 { self.word() } else { self.words() })
    }

    /// The fewest of which both labels can be left without any fold, for people.
    pub fn needed(self) -> &'static str {
        match self {
            Split::Grasp => "at least 2 stable and 2 unstable grasps",
            Split::Object => "stable grasps of at least 2 objects and unstable ones of at least 2",
            Split::Class => "stable grasps of at least 2 classes and unstable ones of at least 2",
        }
    }

    pub fn named(name: &str) -> Option<Split> {
        [Split::Grasp, Split::Object, Split::Class].into_iter().find(|split| split.word() == name)
    }

    /// The name of the group that an example is kept together with.
    fn group_of(self, example: &Example) -> Option<&str> {
        match self {
            Split::Grasp => None,
            Split::Object => Some(&example.object),
            Split::Class => Some(&example.class),
        }
    }
}

/// The fold of each example, from 0. Folds are of about equal size; the same seed gives the same folds. Each object has one
/// class: [`Examples`](crate::training::Examples) refuse others.
///
/// # Errors
/// There are too few grasps, objects or classes, or without a fold all grasps are alike.
pub fn split_into_folds(
    split: Split,
    examples: &[&Example],
    n_folds: usize,
    seed: u64,
) -> Result<Vec<usize>, SplitError> {
    if n_folds < 2 {
        return Err(SplitError::TooFewFolds(n_folds));
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let folds = match split {
        Split::Grasp => stratified_folds(examples, n_folds, &mut random)?,
        Split::Object | Split::Class => grouped_folds(split, examples, n_folds, &mut random)?,
    };
    for fold in 0..n_folds {
        let mut labels = examples.iter().zip(&folds).filter(|(_, of)| **of != fold).map(|(example, _)| example.stable);
        let Some(first) = labels.next() else { continue };
        if labels.all(|stable| stable == first) {
            let n_grasps = folds.iter().filter(|of| **of != fold).count();
            return Err(SplitError::OneLabel { split, fold, n_folds, n_grasps, stable: first });
        }
    }
    Ok(folds)
}

/// Puts items in a random order.
fn shuffle<T>(items: &mut [T], random: &mut ChaCha8Rng) {
    for idx in (1..items.len()).rev() {
        items.swap(idx, random.random_range(0..=idx));
    }
}

/// Deals stable and then unstable grasps to the folds in turn, each in a random order.
fn stratified_folds(examples: &[&Example], n_folds: usize, random: &mut ChaCha8Rng) -> Result<Vec<usize>, SplitError> {
    if examples.len() < n_folds {
        return Err(SplitError::TooFewGroups { split: Split::Grasp, n_groups: examples.len(), n_folds });
    }
    let (mut stable, mut unstable): (Vec<usize>, Vec<usize>) =
        (0..examples.len()).partition(|idx| examples[*idx].stable);
    shuffle(&mut stable, random);
    shuffle(&mut unstable, random);
    let mut folds = vec![0; examples.len()];
    for (turn, idx) in stable.into_iter().chain(unstable).enumerate() {
        folds[idx] = turn % n_folds;
    }
    Ok(folds)
}

/// Puts each group, the largest first, into the fold with the fewest grasps so far.
fn grouped_folds(
    split: Split,
    examples: &[&Example],
    n_folds: usize,
    random: &mut ChaCha8Rng,
) -> Result<Vec<usize>, SplitError> {
    let mut n_grasps: BTreeMap<&str, usize> = BTreeMap::new();
    for group in examples.iter().filter_map(|example| split.group_of(example)) {
        *n_grasps.entry(group).or_default() += 1;
    }
    if n_grasps.len() < n_folds {
        return Err(SplitError::TooFewGroups { split, n_groups: n_grasps.len(), n_folds });
    }
    let mut groups: Vec<(&str, usize)> = n_grasps.into_iter().collect();
    shuffle(&mut groups, random);
    groups.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    let mut n_in_fold = vec![0; n_folds];
    let mut fold_of: BTreeMap<&str, usize> = BTreeMap::new();
    for (group, n) in groups {
        let fold = (0..n_folds).min_by_key(|fold| n_in_fold[*fold]).unwrap_or(0);
        n_in_fold[fold] += n;
        fold_of.insert(group, fold);
    }
    Ok(examples.iter().map(|example| split.group_of(example).map_or(0, |group| fold_of[group])).collect())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// Grasps of objects named `class-object`.
    pub(in crate::evaluation) fn examples(names: &[(&str, &str, usize)]) -> Vec<Example> {
        let mut examples = Vec::new();
        for (object, class, n) in names {
            for idx in 0..*n {
                examples.push(Example {
                    grasp_id: examples.len() as u64,
                    stable: idx % 3 == 0,
                    object: (*object).into(),
                    class: (*class).into(),
                    ..Example::default()
                });
            }
        }
        examples
    }

    const NAMES: [(&str, &str, usize); 6] =
        [("a", "x", 30), ("b", "x", 12), ("c", "y", 9), ("d", "y", 9), ("e", "z", 12), ("f", "z", 3)];

    #[test]
    fn folds_share_no_group_and_are_about_equal() {
        let all = examples(&NAMES);
        let all: Vec<&Example> = all.iter().collect();
        for (split, n_folds, expected) in
            [(Split::Grasp, 5, vec![15; 5]), (Split::Object, 3, vec![21, 24, 30]), (Split::Class, 3, vec![15, 18, 42])]
        {
            let folds = split_into_folds(split, &all, n_folds, 7).expect("folds");
            let mut sizes: Vec<usize> =
                (0..n_folds).map(|fold| folds.iter().filter(|of| **of == fold).count()).collect();
            sizes.sort_unstable();
            assert_eq!(sizes, expected, "{split:?}");
            let mut fold_of = BTreeMap::new();
            for (example, fold) in all.iter().zip(&folds) {
                if let Some(group) = split.group_of(example) {
                    assert_eq!(fold_of.entry(group).or_insert(*fold), fold, "{group} is in two folds");
                }
            }
            assert_eq!(folds, split_into_folds(split, &all, n_folds, 7).expect("folds"), "the same seed");
        }
        let stable_in = |fold: usize, folds: &[usize]| {
            folds.iter().zip(&all).filter(|(of, example)| **of == fold && example.stable).count()
        };
        let folds = split_into_folds(Split::Grasp, &all, 5, 7).expect("folds");
        assert_eq!((0..5).map(|fold| stable_in(fold, &folds)).collect::<Vec<_>>(), [5; 5]);
        let seeds: BTreeSet<Vec<usize>> =
            (0..5).map(|seed| split_into_folds(Split::Grasp, &all, 5, seed).expect("folds")).collect();
        assert_eq!(seeds.len(), 5, "another seed, other folds");
    }

    #[test]
    fn what_cannot_be_split_is_refused() {
        let refused = |names: &[(&str, &str, usize)], split, n_folds| {
            let all = examples(names);
            split_into_folds(split, &all.iter().collect::<Vec<_>>(), n_folds, 1).expect_err("refused").to_string()
        };
        assert!(refused(&NAMES, Split::Object, 7).starts_with("6 objects for 7 folds"));
        assert!(refused(&NAMES[..1], Split::Object, 3).starts_with("1 object for 3 folds"));
        assert!(refused(&NAMES, Split::Class, 4).starts_with("3 classes for 4 folds"));
        assert!(refused(&NAMES, Split::Grasp, 1).starts_with("expected at least 2 folds"));
        assert!(refused(&NAMES, Split::Grasp, 100).starts_with("75 grasps for 100 folds"));
        // Object b has one grasp, a stable one.
        let error = refused(&[("a", "x", 9), ("b", "x", 1)], Split::Object, 2);
        let expected = "only stable grasps are left to train on (1): expected stable grasps of at least 2 objects";
        assert!(error.contains(expected) && error.contains("ask for more folds"), "{error}");
    }
}
