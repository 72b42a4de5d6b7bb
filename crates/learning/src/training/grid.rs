//! A grid search over the two parameters of a learner that matter most, by cross-validation over folds of objects: c
//! and gamma of an SVM, rounds and depth of boosted trees.
//!
//! Dictionary, scaling and features depend on neither parameter, so they are made once for each fold. All values of the
//! first parameter share one training for each value of the second: an SVM's kernel rows are computed once and each
//! training begins with the last one's solution ([`train_svm_path`]), and the first trees of many are those of fewer
//! rounds.

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::time::Instant;

use serde::Serialize;

use super::{BlendParams, Example, Learner, Prepared, Recipe, TrainingError, prepare, rows};
use crate::learners::booster::train_boosted;
use crate::learners::decision_values;
use crate::learners::svm::train_svm_path;
use blindgrasp_stages::classifier::svm::{PreparedSvm, SvmParams};
use blindgrasp_stages::classifier::{Blend, Predictor};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::training_summary::{CellSummary, GridSummary};

/// One of the two parameters and the values to try.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Axis {
    pub name: String,
    /// In rising order.
    pub values: Vec<f64>,
}

/// A search over all pairs of the axes' values.
#[derive(Debug, Clone, Copy)]
pub struct Search<'a> {
    pub hand: &'a Hand,
    /// Its own values of the two parameters are not used.
    pub recipe: &'a Recipe,
    pub axes: &'a [Axis; 2],
    pub examples: &'a [&'a Example],
    /// The fold of each example: see [`super::folds_by_object`].
    pub folds: &'a [usize],
    /// Seeds K-means and boosting.
    pub seed: u64,
}

/// A pair of values with its score over all folds. The scores are those at decision value 0.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GridPoint {
    /// In the order of the axes.
    pub values: [f64; 2],
    /// Share of all examples that are called rightly.
    pub accuracy: f64,
    /// The standard error of the accuracy over folds.
    pub standard_error: f64,
    /// Unstable examples that are called stable, as a share of all examples.
    pub false_positive_share: f64,
    /// Solver iterations, or trees, over all folds.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance in all folds.
    pub converged: bool,
    /// Training time over all folds, seconds.
    pub secs: f64,
    pub fold_accuracies: Vec<f64>,
}

/// The result of a search.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GridReport {
    /// The recipe's name.
    pub recipe: String,
    pub axes: [Axis; 2],
    pub n_folds: usize,
    pub n_examples: usize,
    /// In the order of the second parameter and then of the first.
    #[serde(rename = "cells")]
    pub points: Vec<GridPoint>,
    /// The pair to train with.
    pub best: GridPoint,
}

/// Why a search failed.
#[derive(Debug, thiserror::Error)]
pub enum GridError {
    #[error(transparent)]
    Training(#[from] TrainingError),
    #[error("the grid's {name}: {message}")]
    Axis { name: String, message: String },
}

/// The names of the two parameters of a learner.
pub fn axis_names(learner: &Learner) -> [&'static str; 2] {
    match learner {
        Learner::Svm(_) | Learner::Blend(_) => ["c", "gamma"],
        Learner::Boosting(_) => ["n_rounds", "max_depth"],
    }
}

/// Values around a recipe's own: half a decade and a decade to either side; for rounds, halves and doubles; for depths,
/// steps of one.
pub fn axes_around(recipe: &Recipe) -> [Axis; 2] {
    let times = |own: f64, factors: &[f64]| factors.iter().map(|factor| three_digits(own * factor)).collect();
    let values: [Vec<f64>; 2] = match &recipe.learner {
        Learner::Svm(params) | Learner::Blend(BlendParams { svm: params, .. }) => {
            [params.c, params.gamma].map(|own| times(own, &[0.1, 0.3, 1.0, 3.0, 10.0]))
        }
        Learner::Boosting(params) => {
            let n_rounds: Vec<f64> = times(params.n_rounds as f64, &[0.25, 0.5, 1.0, 2.0]);
            let least_depth = params.max_depth.saturating_sub(2).max(1);
            let max_depth = (least_depth..=params.max_depth + 2).map(|depth| depth as f64).collect();
            [n_rounds.into_iter().map(f64::ceil).collect(), max_depth]
        }
    };
    let names = axis_names(&recipe.learner);
    std::array::from_fn(|idx| Axis { name: names[idx].into(), values: values[idx].clone() })
}

/// A recipe with a pair of values in place of its own.
pub fn with_values(recipe: &Recipe, [first, second]: [f64; 2]) -> Recipe {
    let mut recipe = recipe.clone();
    match &mut recipe.learner {
        Learner::Svm(params) | Learner::Blend(BlendParams { svm: params, .. }) => {
            (params.c, params.gamma) = (first, second);
        }
        Learner::Boosting(params) => (params.n_rounds, params.max_depth) = (first as usize, second as usize),
    }
    recipe
}

impl Search<'_> {
    /// Scores every pair and chooses the best. `on_scored` is called after each training of a fold.
    ///
    /// # Errors
    /// Values that cannot be tried, or a training's error.
    pub fn run(&self, mut on_scored: impl FnMut()) -> Result<GridReport, GridError> {
        self.check_axes()?;
        let [first, second] = self.axes;
        let n_pairs = first.values.len() * second.values.len();
        let mut scores: Vec<Vec<FoldScore>> = vec![Vec::new(); n_pairs];
        let fold_numbers: BTreeSet<usize> = self.folds.iter().copied().collect();
        for number in &fold_numbers {
            let fold = self.fold(*number)?;
            for (second_idx, second) in second.values.iter().enumerate() {
                let start = second_idx * first.values.len();
                self.score(&fold, *second, |first_idx, score| {
                    scores[start + first_idx].push(score);
                    on_scored();
                })?;
            }
        }
        let pairs = second.values.iter().flat_map(|second| first.values.iter().map(move |first| [*first, *second]));
        let points: Vec<GridPoint> = pairs.zip(&scores).map(|(values, scores)| GridPoint::of(values, scores)).collect();
        let best = choose(&points)
            .ok_or_else(|| TrainingError::Data("the grid has no examples: expected some in each fold".into()))?;
        Ok(GridReport {
            recipe: self.recipe.name.clone(),
            axes: self.axes.clone(),
            n_folds: fold_numbers.len(),
            n_examples: self.examples.len(),
            best,
            points,
        })
    }

    fn check_axes(&self) -> Result<(), GridError> {
        for (axis, name) in self.axes.iter().zip(axis_names(&self.recipe.learner)) {
            let wrong = |message: String| Err(GridError::Axis { name: axis.name.clone(), message });
            if axis.name != name {
                return wrong(format!("the recipe {} has no such parameter, expected {name}", self.recipe.name));
            }
            if axis.values.is_empty() || !axis.values.is_sorted_by(|left, right| left < right) {
                return wrong(format!("{:?}, expected values in rising order", axis.values));
            }
            let is_count = matches!(self.recipe.learner, Learner::Boosting(_));
            let is_valid = |value: &f64| value.is_finite() && *value > 0.0 && (!is_count || value.fract() == 0.0);
            if let Some(value) = axis.values.iter().find(|value| !is_valid(value)) {
                return wrong(format!("{value}, expected a {}number above 0", if is_count { "whole " } else { "" }));
            }
        }
        Ok(())
    }

    fn fold(&self, number: usize) -> Result<Fold, TrainingError> {
        let of = |is_held_out: bool| -> Vec<&Example> {
            let of_fold = self.examples.iter().zip(self.folds).filter(|(_, fold)| (**fold == number) == is_held_out);
            of_fold.map(|(example, _)| *example).collect()
        };
        let held_out = of(true);
        let kept = prepare(self.hand, self.recipe, &of(false), self.seed)?;
        let rows = rows(&kept.features, &held_out)?;
        let labels = held_out.iter().map(|example| example.stable).collect();
        Ok(Fold { kept, rows, labels })
    }

    /// Passes on the index of each value of the first parameter with its score in a fold, for one value of the second.
    fn score(&self, fold: &Fold, second: f64, mut on_score: impl FnMut(usize, FoldScore)) -> Result<(), TrainingError> {
        let firsts = &self.axes[0].values;
        let Prepared { features, rows, labels, targets, .. } = &fold.kept;
        let mut start = Instant::now();
        let mut add = |first_idx, predictor: Predictor, n_iterations, converged| {
            let decision_values = decision_values(&predictor, &fold.rows)?;
            let secs = std::mem::replace(&mut start, Instant::now()).elapsed().as_secs_f64();
            on_score(first_idx, FoldScore { n_iterations, converged, secs, ..fold.score(&decision_values) });
            Ok::<(), TrainingError>(())
        };
        let mut add_path = |params: &SvmParams, predictor: &dyn Fn(PreparedSvm) -> Predictor| {
            let mut outcome = Ok(());
            train_svm_path(rows, features.len(), labels, params, firsts, |first_idx, svm, report| {
                outcome = svm
                    .try_into()
                    .map_err(TrainingError::Svm)
                    .and_then(|svm| add(first_idx, predictor(svm), report.n_iterations, report.converged));
                if outcome.is_err() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
            outcome
        };
        match with_values(self.recipe, [firsts[firsts.len() - 1], second]).learner {
            Learner::Svm(params) => add_path(&params, &Predictor::Svm),
            Learner::Blend(BlendParams { boosting, svm, svm_weight }) => {
                let trees = train_boosted(rows, features.len(), targets, &boosting, self.seed)?;
                add_path(&svm, &|svm| Predictor::Blend(Blend { trees: trees.clone(), svm, svm_weight }))
            }
            Learner::Boosting(params) => {
                let mut trees = train_boosted(rows, features.len(), targets, &params, self.seed)?;
                for (first_idx, n_rounds) in firsts.iter().enumerate().rev() {
                    trees.trees.truncate(*n_rounds as usize);
                    add(first_idx, Predictor::Boosting(trees.clone()), trees.trees.len(), true)?;
                }
                Ok(())
            }
        }
    }
}

/// What all pairs share of a fold.
struct Fold {
    /// The examples of all other folds, which the learner is trained on.
    kept: Prepared,
    /// The features of the fold's examples.
    rows: Vec<f64>,
    labels: Vec<bool>,
}

/// The score of a pair on the examples of a fold.
#[derive(Debug, Clone)]
struct FoldScore {
    n: usize,
    n_correct: usize,
    n_false_positive: usize,
    n_iterations: usize,
    converged: bool,
    secs: f64,
}

impl Fold {
    fn score(&self, decision_values: &[f64]) -> FoldScore {
        let outcomes = || decision_values.iter().map(|value| *value > 0.0).zip(self.labels.iter().copied());
        FoldScore {
            n: self.labels.len(),
            n_correct: outcomes().filter(|(called, stable)| called == stable).count(),
            n_false_positive: outcomes().filter(|(called, stable)| *called && !stable).count(),
            n_iterations: 0,
            converged: true,
            secs: 0.0,
        }
    }
}

impl GridPoint {
    fn of(values: [f64; 2], scores: &[FoldScore]) -> Self {
        let sum = |of: fn(&FoldScore) -> usize| scores.iter().map(of).sum::<usize>();
        let n = sum(|score| score.n) as f64;
        let fold_accuracies: Vec<f64> = scores.iter().map(|score| score.n_correct as f64 / score.n as f64).collect();
        GridPoint {
            values,
            accuracy: sum(|score| score.n_correct) as f64 / n,
            standard_error: mean_and_standard_error(&fold_accuracies).1,
            false_positive_share: sum(|score| score.n_false_positive) as f64 / n,
            n_iterations: sum(|score| score.n_iterations),
            converged: scores.iter().all(|score| score.converged),
            secs: scores.iter().map(|score| score.secs).sum(),
            fold_accuracies,
        }
    }
}

impl GridReport {
    /// The axes on whose ends the most accurate pair lies, though they have other values: a value beyond might do
    /// better.
    pub fn edges_of_most_accurate(&self) -> Vec<&str> {
        let Some(best) = most_accurate(&self.points) else { return Vec::new() };
        let is_edge = |(axis, value): &(&Axis, f64)| {
            axis.values.len() > 1 && (axis.values.first() == Some(value) || axis.values.last() == Some(value))
        };
        self.axes.iter().zip(best.values).filter(is_edge).map(|(axis, _)| axis.name.as_str()).collect()
    }

    /// The part of the report that a model keeps.
    pub fn summary(&self) -> GridSummary {
        let of = |point: &GridPoint| CellSummary {
            values: point.values,
            accuracy: point.accuracy,
            false_positive_share: point.false_positive_share,
        };
        GridSummary {
            axes: self.axes.each_ref().map(|axis| axis.name.clone()),
            cells: self.points.iter().map(of).collect(),
        }
    }
}

/// The pair to train with: of all pairs as good as the most accurate one, those with the least first parameter, and of
/// these the most accurate.
///
/// A pair is as good if it is less accurate by at most one standard error of the difference, fold by fold. Folds of
/// hard objects are hard for every pair, so that is much less than the standard error of the accuracy itself.
fn choose(points: &[GridPoint]) -> Option<GridPoint> {
    let best = most_accurate(points)?;
    let is_as_good = |point: &&GridPoint| {
        let accuracies = best.fold_accuracies.iter().zip(&point.fold_accuracies);
        let differences: Vec<f64> = accuracies.map(|(best, of_point)| best - of_point).collect();
        let (mean, standard_error) = mean_and_standard_error(&differences);
        mean <= standard_error
    };
    let as_good: Vec<&GridPoint> = points.iter().filter(is_as_good).collect();
    let least = as_good.iter().map(|point| point.values[0]).fold(f64::INFINITY, f64::min);
    most_accurate(as_good.into_iter().filter(|point| point.values[0] == least)).cloned()
}

/// The first of equally accurate ones.
fn most_accurate<'a>(points: impl IntoIterator<Item = &'a GridPoint>) -> Option<&'a GridPoint> {
    points.into_iter().reduce(|best, point| if point.accuracy > best.accuracy { point } else { best })
}

fn mean_and_standard_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, (variance / n).sqrt())
}

/// Rounded to three digits: 0.03, not 0.030000000000000002.
fn three_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A report of five folds of 100 examples each, from the number of right calls in each fold of a pair.
    fn report(firsts: &[f64], seconds: &[f64], n_correct: &[[usize; 5]]) -> GridReport {
        let axis = |name: &str, values: &[f64]| Axis { name: name.into(), values: values.to_vec() };
        let score = |(fold, n_correct): (usize, &usize)| FoldScore {
            n: 100,
            n_correct: *n_correct,
            n_false_positive: 7,
            n_iterations: 10,
            converged: fold != 3,
            secs: 0.5,
        };
        let pairs = seconds.iter().flat_map(|second| firsts.iter().map(move |first| [*first, *second]));
        let of_pair = |(values, n_correct): ([f64; 2], &[usize; 5])| {
            GridPoint::of(values, &n_correct.iter().enumerate().map(score).collect::<Vec<_>>())
        };
        let points: Vec<GridPoint> = pairs.zip(n_correct).map(of_pair).collect();
        GridReport {
            recipe: "paper".into(),
            axes: [axis("c", firsts), axis("gamma", seconds)],
            n_folds: 5,
            n_examples: 500,
            best: choose(&points).expect("some points"),
            points,
        }
    }

    #[test]
    fn a_point_adds_up_its_folds() {
        let report = report(&[1.0], &[0.1], &[[80, 82, 84, 86, 88]]);
        let point = &report.best;
        assert_eq!((point.values, point.n_iterations, point.converged, point.secs), ([1.0, 0.1], 50, false, 2.5));
        assert!((point.accuracy - 0.84).abs() < 1e-12 && (point.false_positive_share - 0.07).abs() < 1e-12);
        // Deviations 4, 2, 0, 2, 4 %: √(40/4) = √10 %, over √5.
        assert!((point.standard_error - 0.02_f64.sqrt() / 10.0).abs() < 1e-12, "{}", point.standard_error);
        assert_eq!(report.summary().cells[0].values, [1.0, 0.1]);
        assert_eq!(report.edges_of_most_accurate(), Vec::<&str>::new());
    }

    #[test]
    fn of_pairs_as_good_as_the_best_the_least_c_is_taken() {
        let best = [80, 90, 70, 85, 80];
        // One less in each fold: surely worse, though by far less than folds differ.
        let surely_worse = [79, 89, 69, 84, 79];
        // As much less on average, but better in two folds: that may be chance.
        let perhaps_worse = [82, 88, 71, 82, 77];
        let chosen = |n_correct: &[[usize; 5]]| Some(report(&[1.0, 10.0], &[0.1, 0.3], n_correct).best.values);
        let bad = [50; 5];
        assert_eq!(chosen(&[bad, surely_worse, bad, best]), Some([10.0, 0.3]));
        assert_eq!(chosen(&[bad, perhaps_worse, bad, best]), Some([10.0, 0.3]));
        assert_eq!(chosen(&[surely_worse, bad, bad, best]), Some([10.0, 0.3]));
        assert_eq!(chosen(&[perhaps_worse, bad, bad, best]), Some([1.0, 0.1]));
        assert_eq!(chosen(&[best, best, best, best]), Some([1.0, 0.1]));
        assert_eq!(chosen(&[bad, bad, best, best]), Some([1.0, 0.3]));
    }

    #[test]
    fn the_most_accurate_pair_may_lie_on_an_edge() {
        let edges = |firsts: &[f64], seconds: &[f64], best_idx: usize| {
            let mut n_correct = vec![[50; 5]; firsts.len() * seconds.len()];
            n_correct[best_idx] = [60; 5];
            report(firsts, seconds, &n_correct).edges_of_most_accurate().join(" ")
        };
        assert_eq!(edges(&[1.0, 2.0, 3.0], &[0.1, 0.2, 0.3], 4), "");
        assert_eq!(edges(&[1.0, 2.0, 3.0], &[0.1, 0.2, 0.3], 1), "gamma");
        assert_eq!(edges(&[1.0, 2.0, 3.0], &[0.1, 0.2, 0.3], 8), "c gamma");
        assert_eq!(edges(&[1.0, 2.0, 3.0], &[0.1], 2), "c");
    }

    #[test]
    fn values_around_a_recipes_own_hold_it_and_rise() {
        for name in Recipe::NAMES {
            let recipe = Recipe::named(name).expect("built in");
            let axes = axes_around(&recipe);
            assert!(axes.iter().all(|axis| axis.values.is_sorted_by(|left, right| left < right)), "{axes:?}");
            assert_eq!(axes.each_ref().map(|axis| axis.name.as_str()), axis_names(&recipe.learner));
            let is_own = |pair: &[f64; 2]| with_values(&recipe, *pair) == recipe;
            let pairs: Vec<[f64; 2]> = axes[1]
                .values
                .iter()
                .flat_map(|second| axes[0].values.iter().map(move |first| [*first, *second]))
                .collect();
            assert_eq!(pairs.iter().filter(|pair| is_own(pair)).count(), 1, "{axes:?}");
        }
    }
}
