//! A search over the two parameters of a learner that tell most, by cross-validation over folds of objects: c and gamma
//! of a support vector machine, rounds and depth of boosted trees.
//!
//! Cells of the grid share what they have in common. Dictionary, scaling and features are made once for each fold; they
//! depend on neither parameter. What remains falls into [`Run`]s, one for each fold and value of the second parameter:
//! along the first one, kernel rows are computed once and each training begins at the end of the last one
//! ([`train_svm_path`]), and of boosted trees the first of many are the few. Runs are side by side as far as memory
//! allows; none depends on another, so the scores are the same whatever the number of threads and however often a search
//! was interrupted.

use blindgrasp_stages::training_summary::{CellSummary, GridSummary};
use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{BlendParams, Example, Learner, Prepared, Recipe, TrainingError, prepare, rows};
use blindgrasp_stages::classifier::boosting::train_boosted;
use blindgrasp_stages::classifier::svm::train_svm_path;
use blindgrasp_stages::classifier::{Blend, Machine};
use blindgrasp_stages::hand::Hand;

const FORMAT: &str = "blindgrasp-grid/1";

/// One of the two parameters and the values to try.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Axis {
    /// The parameter.
    pub name: String,
    /// Its values, rising.
    pub values: Vec<f64>,
}

/// What to search: all pairs of the axes' values.
#[derive(Debug, Clone, Copy)]
pub struct Search<'a> {
    /// The hand of the examples.
    pub hand: &'a Hand,
    /// Features and machine; its own values of the two parameters do not matter.
    pub recipe: &'a Recipe,
    /// The values to try: see [`axes_around`].
    pub axes: &'a [Axis; 2],
    /// What to learn from.
    pub examples: &'a [&'a Example],
    /// The fold of each example: see [`super::folds_by_object`].
    pub folds: &'a [usize],
    /// Seeds K-means and boosting.
    pub seed: u64,
}

/// What a machine says of the examples of a fold, which it has not seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FoldScore {
    /// Examples of the fold.
    pub n: usize,
    /// Those that are stable with a decision value above 0, or unstable with another.
    pub n_correct: usize,
    /// Those that are unstable with a decision value above 0.
    pub n_false_positive: usize,
    /// Solver iterations since the last value of the first parameter, or trees.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance.
    pub converged: bool,
    /// Time it took since the last value of the first parameter, seconds.
    pub secs: f64,
}

/// What is computed in one go: all values of the first parameter, for one of the second and one fold.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// Index of the second parameter's value.
    pub second_idx: usize,
    /// The fold.
    pub fold: usize,
    /// In the order of the first parameter's values.
    pub scores: Vec<FoldScore>,
}

/// A pair of values with its score over all folds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cell {
    /// The values, in the order of the axes.
    pub values: [f64; 2],
    /// The share of all examples on the right side of decision value 0.
    pub accuracy: f64,
    /// The standard error of the accuracy over folds.
    pub standard_error: f64,
    /// Unstable examples above decision value 0, as a share of all examples.
    pub false_positive_share: f64,
    /// Solver iterations, or trees, over all folds.
    pub n_iterations: usize,
    /// Whether the solver reached its tolerance in all folds.
    pub converged: bool,
    /// Time it took, seconds, over all folds.
    pub secs: f64,
}

/// What a search has found so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridReport {
    format: String,
    /// SHA-256 of all that the scores depend on.
    inputs: String,
    /// The recipe's name.
    pub recipe: String,
    /// What is searched.
    pub axes: [Axis; 2],
    /// Folds.
    pub n_folds: usize,
    /// Examples.
    pub n_examples: usize,
    /// What is done, by the second parameter and then by fold.
    pub runs: Vec<Run>,
    /// The pairs whose folds are all done, by the second parameter and then by the first.
    pub cells: Vec<Cell>,
    /// The pair to train with, when all are done: the least first parameter that is as good as any.
    pub best: Option<Cell>,
}

/// Why a search did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum GridError {
    /// Examples, features or a machine.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// Values that cannot be tried.
    #[error("the grid's {name}: {message}")]
    Axis {
        /// The parameter.
        name: String,
        /// What is wrong.
        message: String,
    },
    /// A report cannot be read, written or gone on from.
    #[error("grid report {}: {message}", path.display())]
    Report {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// It was asked to stop.
    #[error("interrupted: {n_done} of {n_runs} parts of the grid are done")]
    Stopped {
        /// Runs that the report holds.
        n_done: usize,
        /// Runs of the whole grid.
        n_runs: usize,
    },
}

/// The names of the two parameters of a learner.
pub fn axis_names(learner: &Learner) -> [&'static str; 2] {
    match learner {
        Learner::Svm(_) | Learner::Blend(_) => ["c", "gamma"],
        Learner::Boosting(_) => ["n_rounds", "max_depth"],
    }
}

/// Values around a recipe's own: half a decade and a decade to either side, rounds in doublings, depths one by one.
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
    /// A report in which nothing is done yet.
    ///
    /// # Errors
    /// [`GridError::Axis`].
    pub fn new_report(&self) -> Result<GridReport, GridError> {
        self.check_axes()?;
        Ok(GridReport {
            format: FORMAT.into(),
            inputs: self.digest(),
            recipe: self.recipe.name.clone(),
            axes: self.axes.clone(),
            n_folds: self.fold_numbers().len(),
            n_examples: self.examples.len(),
            runs: Vec::new(),
            cells: Vec::new(),
            best: None,
        })
    }

    /// Does what is missing in `report`, unless `stop` says to leave off. `scored` is told of each score, `keep` of the
    /// report after each [`Run`].
    ///
    /// # Errors
    /// What a training or `keep` failed with, or [`GridError::Stopped`]; the report holds what is done.
    pub fn go_on(
        &self,
        report: &mut GridReport,
        stop: impl Fn() -> bool + Sync,
        scored: impl Fn(&FoldScore) + Sync,
        keep: impl FnMut(&GridReport) -> Result<(), GridError> + Send,
    ) -> Result<(), GridError> {
        let missing = report.missing();
        let folds_needed: BTreeSet<usize> = missing.iter().map(|(_, fold)| *fold).collect();
        let folds: Vec<Fold> = folds_needed.into_par_iter().map(|fold| self.fold(fold)).collect::<Result<_, _>>()?;
        let (n_side_by_side, cache_bytes) = self.side_by_side(&folds, missing.len());
        let next = AtomicUsize::new(0);
        let shared = Mutex::new((&mut *report, keep, Ok(())));
        // Every thread gets exactly one worker, which waits for others' pieces of work only while its own run is in
        // pieces: no thread holds two kernels, and none is without work.
        rayon::broadcast(|context| {
            while context.index() < n_side_by_side {
                let Some(&(second_idx, fold)) = missing.get(next.fetch_add(1, Ordering::Relaxed)) else { return };
                let Some(fold) = folds.iter().find(|candidate| candidate.number == fold) else { return };
                let outcome = self.run(second_idx, fold, cache_bytes, &stop, &scored);
                let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
                let (report, keep, result) = &mut *shared;
                if result.is_err() {
                    return;
                }
                *result = match outcome {
                    Ok(Some(run)) => {
                        report.add(run);
                        keep(report)
                    }
                    Ok(None) => Err(GridError::Stopped { n_done: report.runs.len(), n_runs: report.n_runs() }),
                    Err(error) => Err(error.into()),
                };
                if result.is_err() {
                    return;
                }
            }
        });
        let (_, _, result) = shared.into_inner().unwrap_or_else(PoisonError::into_inner);
        result
    }

    fn check_axes(&self) -> Result<(), GridError> {
        for (axis, name) in self.axes.iter().zip(axis_names(&self.recipe.learner)) {
            let wrong = |message: String| Err(GridError::Axis { name: axis.name.clone(), message });
            if axis.name != name {
                return wrong(format!("the recipe {} has no such parameter, expected {name}", self.recipe.name));
            }
            if axis.values.is_empty() || !axis.values.is_sorted_by(|left, right| left < right) {
                return wrong(format!("{:?}, expected values that rise", axis.values));
            }
            let is_count = matches!(self.recipe.learner, Learner::Boosting(_));
            let is_valid = |value: &f64| value.is_finite() && *value > 0.0 && (!is_count || value.fract() == 0.0);
            if let Some(value) = axis.values.iter().find(|value| !is_valid(value)) {
                return wrong(format!("{value}, expected a {}number above 0", if is_count { "whole " } else { "" }));
            }
        }
        Ok(())
    }

    fn fold_numbers(&self) -> BTreeSet<usize> {
        self.folds.iter().copied().collect()
    }

    /// SHA-256 of all that the scores depend on.
    fn digest(&self) -> String {
        let mut hasher = Sha256::new();
        let least = std::array::from_fn(|idx| self.axes[idx].values[0]);
        let mut recipe = with_values(self.recipe, least);
        if let Learner::Svm(params) = &mut recipe.learner {
            // More memory changes the time only.
            params.cache_bytes = 0;
        }
        let options = (env!("CARGO_PKG_VERSION"), self.hand.description_id(), recipe, self.axes, self.seed);
        hasher.update(format!("{options:?}"));
        for (example, fold) in self.examples.iter().zip(self.folds) {
            let outcomes = (example.stable, example.outcomes());
            hasher.update(format!("{:?} {:?} {outcomes:?} {fold}", example.joints_rad, example.contacts));
        }
        hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
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
        Ok(Fold { number, kept, rows, labels })
    }

    /// How many runs to have side by side, and the memory for kernel values of each: as many as have room for all their
    /// values in what one machine may use. Fewer share the work of a run between threads instead.
    fn side_by_side(&self, folds: &[Fold], n_runs: usize) -> (usize, usize) {
        let most = rayon::current_num_threads().min(n_runs).max(1);
        let params = match &self.recipe.learner {
            Learner::Svm(params) | Learner::Blend(BlendParams { svm: params, .. }) => params,
            Learner::Boosting(_) => return (most, 0),
        };
        let n_samples = folds.iter().map(|fold| fold.kept.labels.len()).max().unwrap_or(0);
        let n_fitting = params.cache_bytes / (n_samples * n_samples * size_of::<f32>()).max(1);
        let n = n_fitting.clamp(1, most);
        (n, params.cache_bytes / n)
    }

    /// `None` if it was asked to stop.
    fn run(
        &self,
        second_idx: usize,
        fold: &Fold,
        cache_bytes: usize,
        stop: &dyn Fn() -> bool,
        scored: &dyn Fn(&FoldScore),
    ) -> Result<Option<Run>, TrainingError> {
        let [first, second] = self.axes;
        let Prepared { features, rows, labels, targets, .. } = &fold.kept;
        let recipe = with_values(self.recipe, [first.values[first.values.len() - 1], second.values[second_idx]]);
        let mut run = Run { second_idx, fold: fold.number, scores: Vec::new() };
        let mut start = Instant::now();
        let mut add = |machine: Machine, n_iterations, converged| {
            let values = machine.decision_values(&fold.rows)?;
            let mut score = fold.score(&values);
            (score.n_iterations, score.converged) = (n_iterations, converged);
            score.secs = start.elapsed().as_secs_f64();
            start = Instant::now();
            scored(&score);
            run.scores.push(score);
            Ok::<(), TrainingError>(())
        };
        if stop() {
            return Ok(None);
        }
        match recipe.learner {
            Learner::Svm(mut params) | Learner::Blend(BlendParams { svm: mut params, .. }) => {
                params.cache_bytes = cache_bytes;
                let blend = match &self.recipe.learner {
                    Learner::Blend(blend) => {
                        let trees = train_boosted(rows, features.len(), targets, &blend.boosting, self.seed)?;
                        Some((trees, blend.svm_weight))
                    }
                    _ => None,
                };
                let machine = |svm| match &blend {
                    Some((trees, svm_weight)) => {
                        Machine::Blend(Blend { trees: trees.clone(), svm, svm_weight: *svm_weight })
                    }
                    None => Machine::Svm(svm),
                };
                let mut outcome = Ok(());
                train_svm_path(rows, features.len(), labels, &params, &first.values, |_, svm, report| {
                    outcome = svm
                        .try_into()
                        .map_err(TrainingError::Svm)
                        .and_then(|svm| add(machine(svm), report.n_iterations, report.converged));
                    if outcome.is_err() || stop() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
                })?;
                outcome?;
            }
            Learner::Boosting(params) => {
                let all = train_boosted(rows, features.len(), targets, &params, self.seed)?;
                for n_rounds in &first.values {
                    let mut trees = all.clone();
                    trees.trees.truncate(*n_rounds as usize);
                    let n_trees = trees.trees.len();
                    add(Machine::Boosting(trees), n_trees, true)?;
                }
            }
        }
        Ok((run.scores.len() == first.values.len()).then_some(run))
    }
}

/// What all cells share of a fold.
struct Fold {
    number: usize,
    /// What machines learn from: the examples of all other folds.
    kept: Prepared,
    /// The features of the fold's examples.
    rows: Vec<f64>,
    labels: Vec<bool>,
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

impl GridReport {
    /// Reads a report to go on from, if it is there.
    ///
    /// # Errors
    /// [`GridError::Report`]: it cannot be read, or is of another search.
    pub fn load(path: &Path, search: &Search<'_>) -> Result<Option<GridReport>, GridError> {
        let invalid = |message: String| GridError::Report { path: path.into(), message };
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(invalid(error.to_string())),
        };
        let mut report: GridReport =
            serde_json::from_str(&text).map_err(|error| invalid(format!("not a grid's report: {error}")))?;
        let new = search.new_report()?;
        if report.format != new.format || report.inputs != new.inputs || !report.is_consistent(&new) {
            return Err(invalid(
                "of another search (other data, recipe, values, folds, seed or version): name another file, or delete \
                 this one"
                    .into(),
            ));
        }
        report.complete();
        Ok(Some(report))
    }

    /// Writes the report; whoever reads it meanwhile finds the old one or the new one.
    ///
    /// # Errors
    /// [`GridError::Report`].
    pub fn save(&self, path: &Path) -> Result<(), GridError> {
        let failed = |error: std::io::Error| GridError::Report { path: path.into(), message: error.to_string() };
        let text = serde_json::to_string_pretty(self).map_err(|error| failed(error.into()))? + "\n";
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        std::fs::write(&partial, text).and_then(|()| std::fs::rename(&partial, path)).map_err(failed)
    }

    /// The pair to train with: of all that are as good as the most accurate one, the least of the first parameter, and of
    /// these the most accurate.
    ///
    /// As good is what is less accurate by at most one standard error of the difference, fold by fold. Folds of hard
    /// objects are hard for every pair, so that is much less than the standard error of the accuracy itself.
    fn choose(&self) -> Option<Cell> {
        if self.runs.len() < self.n_runs() {
            return None;
        }
        let accuracies = |cell: &Cell| -> Vec<f64> { self.scores(cell.values).map(FoldScore::accuracy).collect() };
        let of_best = accuracies(most_accurate(&self.cells)?);
        let is_as_good = |cell: &&Cell| {
            let differences: Vec<f64> = of_best.iter().zip(accuracies(cell)).map(|(best, of)| best - of).collect();
            let (mean, standard_error) = mean_and_standard_error(&differences);
            mean <= standard_error
        };
        let as_good: Vec<&Cell> = self.cells.iter().filter(is_as_good).collect();
        let least = as_good.iter().map(|cell| cell.values[0]).fold(f64::INFINITY, f64::min);
        most_accurate(as_good.into_iter().filter(|cell| cell.values[0] == least)).cloned()
    }

    /// The axes on whose ends the most accurate pair lies, though they have other values: one beyond might do better.
    pub fn edges_of_most_accurate(&self) -> Vec<&str> {
        let Some(best) = most_accurate(&self.cells) else { return Vec::new() };
        let is_edge = |(axis, value): &(&Axis, f64)| {
            axis.values.len() > 1 && (axis.values.first() == Some(value) || axis.values.last() == Some(value))
        };
        self.axes.iter().zip(best.values).filter(is_edge).map(|(axis, _)| axis.name.as_str()).collect()
    }

    /// What a model keeps.
    pub fn summary(&self) -> GridSummary {
        let of = |cell: &Cell| CellSummary {
            values: cell.values,
            accuracy: cell.accuracy,
            false_positive_share: cell.false_positive_share,
        };
        GridSummary {
            axes: self.axes.each_ref().map(|axis| axis.name.clone()),
            cells: self.cells.iter().map(of).collect(),
        }
    }

    /// How many runs make it whole.
    pub fn n_runs(&self) -> usize {
        self.n_folds * self.axes[1].values.len()
    }

    fn missing(&self) -> Vec<(usize, usize)> {
        let is_there = |wanted: &(usize, usize)| self.runs.iter().any(|run| (run.second_idx, run.fold) == *wanted);
        let all =
            (0..self.axes[1].values.len()).flat_map(|second_idx| (0..self.n_folds).map(move |fold| (second_idx, fold)));
        all.filter(|wanted| !is_there(wanted)).collect()
    }

    fn is_consistent(&self, new: &GridReport) -> bool {
        let n_firsts = new.axes[0].values.len();
        let is_run = |run: &Run| {
            run.second_idx < new.axes[1].values.len()
                && run.fold < new.n_folds
                && run.scores.len() == n_firsts
                && run.scores.iter().all(|score| score.n > 0)
        };
        self.axes == new.axes && self.n_folds == new.n_folds && self.runs.iter().all(is_run)
    }

    fn add(&mut self, run: Run) {
        self.runs.push(run);
        self.complete();
    }

    /// Makes cells and best of the runs.
    fn complete(&mut self) {
        // In this order whichever thread was first.
        self.runs.sort_by_key(|run| (run.second_idx, run.fold));
        self.runs.dedup_by_key(|run| (run.second_idx, run.fold));
        let [first, second] = self.axes.clone();
        let pairs = second.values.iter().flat_map(|second| first.values.iter().map(move |first| [*first, *second]));
        self.cells = pairs.filter_map(|values| self.cell(values)).collect();
        self.best = self.choose();
    }

    /// The scores of a pair, fold by fold.
    fn scores(&self, [first, second]: [f64; 2]) -> impl Iterator<Item = &FoldScore> {
        let first_idx = self.axes[0].values.iter().position(|value| *value == first);
        let of_second = self.runs.iter().filter(move |run| self.axes[1].values[run.second_idx] == second);
        of_second.filter_map(move |run| run.scores.get(first_idx?))
    }

    /// A pair whose folds are all done.
    fn cell(&self, values: [f64; 2]) -> Option<Cell> {
        let scores: Vec<&FoldScore> = self.scores(values).collect();
        if scores.len() < self.n_folds {
            return None;
        }
        let sum = |of: fn(&FoldScore) -> usize| scores.iter().map(|score| of(score)).sum::<usize>();
        let n = sum(|score| score.n) as f64;
        let accuracies: Vec<f64> = scores.iter().map(|score| score.accuracy()).collect();
        Some(Cell {
            values,
            accuracy: sum(|score| score.n_correct) as f64 / n,
            standard_error: mean_and_standard_error(&accuracies).1,
            false_positive_share: sum(|score| score.n_false_positive) as f64 / n,
            n_iterations: sum(|score| score.n_iterations),
            converged: scores.iter().all(|score| score.converged),
            secs: scores.iter().map(|score| score.secs).sum(),
        })
    }
}

impl FoldScore {
    fn accuracy(&self) -> f64 {
        self.n_correct as f64 / self.n as f64
    }
}

/// The first of several.
fn most_accurate<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> Option<&'a Cell> {
    cells.into_iter().reduce(|best, cell| if cell.accuracy > best.accuracy { cell } else { best })
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

    /// A report of five folds of 100 examples each, from how many are right in each fold of a pair.
    fn report(firsts: &[f64], seconds: &[f64], n_correct: &[[usize; 5]]) -> GridReport {
        let axis = |name: &str, values: &[f64]| Axis { name: name.into(), values: values.to_vec() };
        let mut report = GridReport {
            format: FORMAT.into(),
            inputs: String::new(),
            recipe: "paper".into(),
            axes: [axis("c", firsts), axis("gamma", seconds)],
            n_folds: 5,
            n_examples: 500,
            runs: Vec::new(),
            cells: Vec::new(),
            best: None,
        };
        // Backwards, as threads may bring them.
        for (second_idx, fold) in report.missing().into_iter().rev() {
            let score = |first_idx: usize| FoldScore {
                n: 100,
                n_correct: n_correct[second_idx * firsts.len() + first_idx][fold],
                n_false_positive: 7,
                n_iterations: 10,
                converged: fold != 3,
                secs: 0.5,
            };
            assert_eq!(report.best, None);
            report.add(Run { second_idx, fold, scores: (0..firsts.len()).map(score).collect() });
        }
        report
    }

    #[test]
    fn a_cell_adds_up_its_folds() {
        let report = report(&[1.0], &[0.1], &[[80, 82, 84, 86, 88]]);
        let cell = report.best.clone().expect("all done");
        assert_eq!((cell.values, cell.n_iterations, cell.converged, cell.secs), ([1.0, 0.1], 50, false, 2.5));
        assert!((cell.accuracy - 0.84).abs() < 1e-12 && (cell.false_positive_share - 0.07).abs() < 1e-12);
        // Deviations 4, 2, 0, 2, 4 %: √(40/4) = √10 %, over √5.
        assert!((cell.standard_error - 0.02_f64.sqrt() / 10.0).abs() < 1e-12, "{}", cell.standard_error);
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
        let chosen = |n_correct: &[[usize; 5]]| {
            let report = report(&[1.0, 10.0], &[0.1, 0.3], n_correct);
            report.best.as_ref().map(|cell| cell.values)
        };
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
