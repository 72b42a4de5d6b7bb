//! `blindgrasp train --grid`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{check_output, number_in, percent, print_line};
use blindgrasp_learning::training::grid::{GridError, GridReport, Search, axes_around, with_values};
use blindgrasp_learning::training::{Examples, TrainingOptions, folds_by_object};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_pictures::{HeatMap, HeatMapAxis, HeatMapCell, heat_map_svg};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::training_summary::GridSummary;

#[derive(Debug, Args)]
pub(super) struct GridArguments {
    /// Search c and gamma of the SVM (boosted: rounds and depth of the trees) by cross-validation over folds of
    /// objects, and train with the best pair.
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
    /// Where to write what the search has found: a table (.json), from which the same command goes on when it was
    /// interrupted, or a heat map (.svg); may be given for both.
    #[arg(long, requires = "grid", value_parser = report_path)]
    grid_report: Vec<PathBuf>,
}

/// Searches the grid if it was asked for, puts the best pair into the recipe, and returns what the model keeps of the
/// search.
pub(super) fn search(
    arguments: &GridArguments,
    hand: &Hand,
    recordings: &[PathBuf],
    options: &mut TrainingOptions,
) -> anyhow::Result<Option<GridSummary>> {
    if !arguments.grid {
        return Ok(None);
    }
    arguments.grid_report.iter().try_for_each(|path| check_output(path, recordings))?;
    let mut axes = axes_around(&options.recipe);
    let given = [
        ("--grid-c", "c", &arguments.grid_c),
        ("--grid-gamma", "gamma", &arguments.grid_gamma),
        ("--grid-rounds", "n_rounds", &arguments.grid_rounds),
        ("--grid-depth", "max_depth", &arguments.grid_depth),
    ];
    for (flag, name, values) in given.into_iter().filter(|(_, _, values)| !values.is_empty()) {
        let Some(axis) = axes.iter_mut().find(|axis| axis.name == name) else {
            bail!("{flag}: the recipe {} has no {name}; name another with --recipe", options.recipe.name);
        };
        axis.values = values.clone();
        axis.values.sort_by(f64::total_cmp);
        axis.values.dedup();
    }
    let read = Examples::read(hand, recordings, &options.relabelling(), |_, _| {})?;
    // What thresholds are to be guaranteed by has no say in anything else.
    let (examples, _) = options.thresholds.set_aside(&read.examples.iter().collect::<Vec<_>>(), options.seed);
    let folds = folds_by_object(&examples, options.n_folds)?;
    let search =
        Search { hand, recipe: &options.recipe, axes: &axes, examples: &examples, folds: &folds, seed: options.seed };
    let report = run(&search, &arguments.grid_report)?;
    let best = report.best.as_ref().context("no pair of the grid could be scored")?;
    for cell in &report.cells {
        print_line(&format!(
            "{} {:<8} {} {:<8} accuracy {} ± {}, false positives {}{}{}",
            axes[0].name,
            cell.values[0],
            axes[1].name,
            cell.values[1],
            percent(Some(cell.accuracy)),
            percent(Some(cell.standard_error)),
            percent(Some(cell.false_positive_share)),
            if cell.converged { "" } else { ", not converged" },
            if cell == best { "  <- trained with" } else { "" },
        ))?;
    }
    for name in report.edges_of_most_accurate() {
        print_diagnostic(&format!(
            "the most accurate pair has the first or last {name} of those tried: one beyond may do better"
        ));
    }
    let (best, summary) = (best.values, report.summary());
    options.recipe = with_values(&options.recipe, best);
    Ok(Some(summary))
}

/// Goes on from a report in JSON that is there, and keeps all reports up to date.
fn run(search: &Search<'_>, paths: &[PathBuf]) -> anyhow::Result<GridReport> {
    let is_json = |path: &&PathBuf| path.extension().is_some_and(|extension| extension == "json");
    let json = paths.iter().find(is_json);
    let found = json.map(|path| GridReport::load(path, search)).transpose()?.flatten();
    let mut report = match found {
        Some(report) => report,
        None => search.new_report()?,
    };
    // The first Ctrl-C leaves off where that loses nothing. The second ends the program at once, and so does any when
    // the search is over.
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register_conditional_default(signal, Arc::clone(&stop))
            .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&stop)))
            .context("cannot listen for signals")?;
    }
    let n_firsts = search.axes[0].values.len();
    let bar = ProgressBar::new((report.n_runs() * n_firsts) as u64);
    let template = "{bar:40} {pos}/{len} trainings, {elapsed} so far, {eta} left";
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    // What is done already says nothing of the rate.
    bar.set_position((report.runs.len() * n_firsts) as u64);
    bar.reset_eta();
    let outcome = search.go_on(
        &mut report,
        || stop.load(Ordering::Relaxed),
        |_| bar.inc(1),
        |report| {
            if bar.is_hidden() {
                print_diagnostic(&format!("grid: {} of {} parts", report.runs.len(), report.n_runs()));
            }
            json.map_or(Ok(()), |path| report.save(path))
        },
    );
    bar.finish_and_clear();
    stop.store(true, Ordering::Relaxed);
    match (outcome, json) {
        (Err(stopped @ GridError::Stopped { .. }), Some(path)) => {
            bail!("{stopped} and in {}; the same command goes on from there", path.display())
        }
        (Err(stopped @ GridError::Stopped { .. }), None) => {
            bail!("{stopped}, and nothing is kept (--grid-report with a .json keeps what is done)")
        }
        (outcome, _) => outcome?,
    }
    for path in paths {
        if is_json(&path) {
            report.save(path)?;
        } else {
            write_svg(&report, path)?;
        }
    }
    Ok(report)
}

fn write_svg(report: &GridReport, path: &Path) -> anyhow::Result<()> {
    let axis =
        |idx: usize| HeatMapAxis { name: report.axes[idx].name.clone(), values: report.axes[idx].values.clone() };
    let cells = report.cells.iter().map(|cell| HeatMapCell {
        at: cell.values,
        share: cell.accuracy,
        note: format!("FP {:.1}", 100.0 * cell.false_positive_share),
        is_marked: report.best.as_ref() == Some(cell),
    });
    let map = HeatMap {
        title: format!("{}: accuracy by {} and {}", report.recipe, report.axes[0].name, report.axes[1].name),
        about: format!(
            "{} grasps, {} folds of objects; FP: unstable grasps above decision value 0, % of all",
            report.n_examples, report.n_folds
        ),
        quantity: "accuracy, %".into(),
        axes: [axis(0), axis(1)],
        cells: cells.collect(),
    };
    std::fs::write(path, heat_map_svg(&map)).with_context(|| format!("cannot write {}", path.display()))
}

fn report_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension() {
        Some(extension) if extension == "json" || extension == "svg" => Ok(path),
        _ => Err("expected a name that ends in .json or .svg".into()),
    }
}
