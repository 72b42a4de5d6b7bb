//! `blindgrasp train --grid`

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{check_new, number_in, percent, print_line, train, write_report};
use blindgrasp_learning::training::grid::{Axis, GridReport, Search, axes_around, with_values};
use blindgrasp_learning::training::{Example, Examples, Recipe, TrainingOptions, folds_by_object};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::training_summary::GridSummary;

#[derive(Debug, Args)]
pub(super) struct GridArguments {
    /// Search c and gamma of the SVM (of boosted: rounds and depth of the trees) by cross-validation over folds of objects,
    /// and train with the best pair.
    #[arg(long, conflicts_with_all = ["c", "gamma"])]
    grid: bool,
    /// Values of c to try, separated by commas [default: half a decade and a decade around the recipe's own].
    #[arg(long, requires = "grid", value_delimiter = ',', value_parser = |text: &str| number_in(text, 1e-9..=1e9))]
    grid_c: Vec<f64>,
    /// Values of gamma to try [default: as for c].
    #[arg(long, requires = "grid", value_delimiter = ',', value_parser = |text: &str| number_in(text, 1e-9..=1e9))]
    grid_gamma: Vec<f64>,
    /// Numbers of boosting rounds to try [default: a quarter to twice the recipe's own].
    #[arg(long, requires = "grid", value_delimiter = ',', value_parser = |text: &str| number_in(text, 1.0..=100_000.0))]
    grid_rounds: Vec<f64>,
    /// Depths of trees to try [default: up to two more or less than the recipe's own].
    #[arg(long, requires = "grid", value_delimiter = ',', value_parser = |text: &str| number_in(text, 1.0..=20.0))]
    grid_depth: Vec<f64>,
    /// Where to write the result of the search (JSON).
    #[arg(long, requires = "grid", value_parser = report_path)]
    grid_report: Option<PathBuf>,
}

/// The values to try, if `--grid` is given: checked before recordings are read.
pub(super) fn axes(
    arguments: &GridArguments,
    recordings: &[PathBuf],
    training: &train::Arguments,
    recipe: &Recipe,
) -> anyhow::Result<Option<[Axis; 2]>> {
    if !arguments.grid {
        return Ok(None);
    }
    if let Some(path) = &arguments.grid_report {
        check_new(path, recordings, training.overwrite)?;
        if std::path::absolute(path).ok() == std::path::absolute(&training.out).ok() {
            bail!("{} is given for --out and for --grid-report: choose two files", path.display());
        }
    }
    let mut axes = axes_around(recipe);
    let given = [
        ("--grid-c", "c", &arguments.grid_c),
        ("--grid-gamma", "gamma", &arguments.grid_gamma),
        ("--grid-rounds", "n_rounds", &arguments.grid_rounds),
        ("--grid-depth", "max_depth", &arguments.grid_depth),
    ];
    for (flag, name, values) in given.into_iter().filter(|(_, _, values)| !values.is_empty()) {
        let Some(axis) = axes.iter_mut().find(|axis| axis.name == name) else {
            bail!("{flag}: the recipe {} has no {name}; name another with --recipe", recipe.name);
        };
        axis.values = values.clone();
        axis.values.sort_by(f64::total_cmp);
        axis.values.dedup();
    }
    Ok(Some(axes))
}

/// Searches the grid, puts the best pair into the recipe, and returns the summary for the model.
pub(super) fn search(
    arguments: &GridArguments,
    axes: &[Axis; 2],
    hand: &Hand,
    read: &Examples,
    options: &mut TrainingOptions,
) -> anyhow::Result<GridSummary> {
    let examples: Vec<&Example> = read.examples.iter().collect();
    let folds = folds_by_object(&examples, options.n_folds)?;
    let search = Search { hand, recipe: &options.recipe, axes, examples: &examples, folds: &folds, seed: options.seed };
    let report = run(&search)?;
    if let Some(path) = &arguments.grid_report {
        let text = serde_json::to_string_pretty(&report)? + "\n";
        write_report(path, &text)?;
    }
    for point in &report.points {
        print_line(&format!(
            "{} {:<8} {} {:<8} accuracy {} ± {}, false positives {}{}{}",
            axes[0].name,
            point.values[0],
            axes[1].name,
            point.values[1],
            percent(Some(point.accuracy)),
            percent(Some(point.standard_error)),
            percent(Some(point.false_positive_share)),
            if point.converged { "" } else { ", not converged" },
            if *point == report.best { "  <- trained with" } else { "" },
        ))?;
    }
    for name in report.edges_of_most_accurate() {
        print_diagnostic(&format!(
            "the most accurate pair has the first or last {name} of the grid: a value beyond it may do better"
        ));
    }
    options.recipe = with_values(&options.recipe, report.best.values);
    Ok(report.summary())
}

fn run(search: &Search<'_>) -> anyhow::Result<GridReport> {
    let n_folds = search.folds.iter().collect::<BTreeSet<_>>().len();
    let n_trainings = search.axes.iter().map(|axis| axis.values.len()).product::<usize>() * n_folds;
    let bar = ProgressBar::new(n_trainings as u64);
    let template = "{bar:40} {pos}/{len} trainings, {elapsed} so far, {eta} left";
    bar.set_style(ProgressStyle::with_template(template)?);
    let mut n_done = 0;
    let report = search.run(|| {
        n_done += 1;
        bar.inc(1);
        if bar.is_hidden() {
            print_diagnostic(&format!("grid: {n_done} of {n_trainings} trainings"));
        }
    });
    bar.finish_and_clear();
    Ok(report?)
}

fn report_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension() {
        Some(extension) if extension == "json" => Ok(path),
        _ => Err("expected a name that ends in .json".into()),
    }
}
