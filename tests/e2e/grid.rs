//! A grid search gives the same scores as separate trainings.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::common::{RECORDING, json_lines, project, run, signal, text, wait_until};
use blindgrasp_learning::dataset::hand_of;
use blindgrasp_learning::training::grid::{Axis, GridError, GridReport, Search, with_values};
use blindgrasp_learning::training::{Example, Examples, Relabelling, cross_validate, folds_by_object};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::recipe::{Learner, Recipe};

const SEED: u64 = 3;

struct Data {
    hand: Hand,
    examples: Examples,
    folds: Vec<usize>,
}

fn data() -> Data {
    let recording: PathBuf = project().join(RECORDING);
    let hand = hand_of(&recording, None).expect("built in");
    let examples = Examples::read(&hand, &[recording], &Relabelling::default(), |_, _| {}).expect("readable");
    let folds = folds_by_object(&examples.examples.iter().collect::<Vec<_>>(), 3).expect("enough objects");
    Data { hand, examples, folds }
}

impl Data {
    fn examples(&self) -> Vec<&Example> {
        self.examples.examples.iter().collect()
    }

    /// Searches with a fresh report.
    fn search<T>(&self, recipe: &Recipe, axes: &[Axis; 2], with: impl FnOnce(&Search<'_>) -> T) -> T {
        let examples = self.examples();
        with(&Search { hand: &self.hand, recipe, axes, examples: &examples, folds: &self.folds, seed: SEED })
    }

    fn search_all(&self, recipe: &Recipe, axes: &[Axis; 2]) -> GridReport {
        self.search(recipe, axes, |search| {
            let mut report = search.new_report().expect("valid axes");
            search.go_on(&mut report, || false, |_| {}, |_| Ok(())).expect("searched");
            report
        })
    }
}

fn axes(first: (&str, &[f64]), second: (&str, &[f64])) -> [Axis; 2] {
    [first, second].map(|(name, values)| Axis { name: name.into(), values: values.to_vec() })
}

fn svm_axes() -> [Axis; 2] {
    axes(("c", &[0.3, 10.0, 300.0]), ("gamma", &[0.03, 1.0]))
}

/// As few words as 240 grasps can have.
fn recipe(name: &str) -> Recipe {
    Recipe { n_words: 16, ..Recipe::named(name).expect("built in") }
}

/// The report without times.
fn timeless(report: &GridReport) -> String {
    let mut report = report.clone();
    report.runs.iter_mut().flat_map(|run| &mut run.scores).for_each(|score| score.secs = 0.0);
    report.cells.iter_mut().chain(&mut report.best).for_each(|cell| cell.secs = 0.0);
    serde_json::to_string_pretty(&report).expect("written")
}

/// Right and false-positive examples of each cell, next to those of a cross-validation that knows no grid.
fn compare(data: &Data, recipe: &Recipe, axes: &[Axis; 2]) -> Vec<[(usize, usize); 2]> {
    let report = data.search_all(recipe, axes);
    assert_eq!(report.cells.len(), axes[0].values.len() * axes[1].values.len());
    let examples = data.examples();
    let n = examples.len() as f64;
    let of_cell = |cell: &blindgrasp_learning::training::grid::Cell| {
        let recipe = with_values(recipe, cell.values);
        let values = cross_validate(&data.hand, &recipe, &examples, &data.folds, SEED, |_| {}).expect("trained");
        let calls = || values.iter().zip(&examples).map(|(value, example)| (*value > 0.0, example.stable));
        let alone = (
            calls().filter(|(called, stable)| called == stable).count(),
            calls().filter(|(called, stable)| *called && !stable).count(),
        );
        let in_grid = ((cell.accuracy * n).round() as usize, (cell.false_positive_share * n).round() as usize);
        [in_grid, alone]
    };
    report.cells.iter().map(of_cell).collect()
}

#[test]
fn each_pair_scores_as_if_cross_validated_alone() {
    let data = data();
    for name in ["paper", "raw"] {
        let found = compare(&data, &recipe(name), &svm_axes());
        for [in_grid, alone] in &found {
            // Both are within the solver's tolerance of the optimum, so what lies just there may fall to either side.
            assert!(in_grid.0.abs_diff(alone.0) <= 2 && in_grid.1.abs_diff(alone.1) <= 2, "{name}: {found:?}");
        }
        assert!(found.iter().any(|cell| cell[0] != found[0][0]), "{name}: all pairs score the same: {found:?}");
    }
}

#[test]
fn the_first_of_many_trees_are_the_few() {
    let data = data();
    let axes = axes(("n_rounds", &[1.0, 5.0, 20.0]), ("max_depth", &[2.0, 4.0]));
    let found = compare(&data, &recipe("boosted"), &axes);
    assert!(found.iter().all(|[in_grid, alone]| in_grid == alone), "{found:?}");
}

#[test]
fn number_of_threads_changes_nothing() {
    let data = data();
    let boosted = axes(("n_rounds", &[2.0, 9.0]), ("max_depth", &[2.0, 4.0]));
    for (name, axes) in [("paper", svm_axes()), ("boosted", boosted)] {
        let search = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().expect("a pool");
            timeless(&pool.install(|| data.search_all(&recipe(name), &axes)))
        };
        let on_one = search(1);
        assert!([2, 3, 8].into_iter().all(|n_threads| search(n_threads) == on_one), "{name}");
    }
    // Nor does it matter how much memory there is: with little of it, runs come one after the other.
    let mut little = recipe("paper");
    if let Learner::Svm(params) = &mut little.learner {
        params.cache_bytes = 1000;
    }
    let reports = [little, recipe("paper")].map(|recipe| timeless(&data.search_all(&recipe, &svm_axes())));
    assert!(reports[0] == reports[1], "{} {}", reports[0], reports[1]);
}

#[test]
fn an_interrupted_search_goes_on_where_it_was() {
    let data = data();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("grid.json");
    let (recipe, axes) = (recipe("paper"), svm_axes());
    let (reference, n_interruptions) = data.search(&recipe, &axes, |search| {
        assert!(matches!(GridReport::load(&path, search), Ok(None)));
        let mut n_interruptions = 0;
        loop {
            let found = GridReport::load(&path, search).expect("its own report");
            let mut report = found.unwrap_or_else(|| search.new_report().expect("valid axes"));
            let n_before = report.runs.len();
            // A run has three scores: when there is one more than two for each run that goes on, at least one run is
            // whole, and not all six are.
            let n_at_least = 2 * rayon::current_num_threads().min(6) + 1;
            let n_scores = AtomicUsize::new(0);
            let outcome = search.go_on(
                &mut report,
                || n_scores.load(Ordering::Relaxed) >= n_at_least,
                |_| {
                    n_scores.fetch_add(1, Ordering::Relaxed);
                },
                |report| report.save(&path),
            );
            assert!(report.runs.len() > n_before);
            match outcome {
                Err(GridError::Stopped { n_done, n_runs: 6 }) => assert_eq!(n_done, report.runs.len()),
                Ok(()) => break (data.search_all(&recipe, &axes), n_interruptions),
                other => panic!("{other:?}"),
            }
            n_interruptions += 1;
        }
    });
    assert!(n_interruptions >= 1);
    let is_the_same = data.search(&recipe, &axes, |search| {
        let found = GridReport::load(&path, search).expect("its own report").expect("there");
        timeless(&found) == timeless(&reference)
    });
    assert!(is_the_same);

    // Of another search, or broken: refused, and left as it is.
    let mut wider = axes.clone();
    wider[0].values.push(1000.0);
    let before = std::fs::read(&path).expect("readable");
    let refused = |recipe: &Recipe, axes: &[Axis; 2]| {
        let error = data.search(recipe, axes, |search| GridReport::load(&path, search)).expect_err("another search");
        assert!(error.to_string().contains("another search"), "{error}");
    };
    refused(&recipe, &wider);
    refused(&Recipe { sigma_m: 0.03, ..recipe.clone() }, &axes);
    assert_eq!(std::fs::read(&path).expect("readable"), before);
    std::fs::write(&path, "{").expect("written");
    let error = data.search(&recipe, &axes, |search| GridReport::load(&path, search)).expect_err("broken");
    assert!(error.to_string().contains("not a grid's report"), "{error}");
}

#[test]
fn axes_are_checked() {
    let data = data();
    let error = |name: &str, axes: [Axis; 2]| {
        let error = data.search(&recipe(name), &axes, |search| search.new_report()).expect_err("bad axes");
        assert!(matches!(error, GridError::Axis { .. }), "{error}");
        error.to_string()
    };
    let gamma = ("gamma", &[0.1][..]);
    assert!(error("paper", axes(("c", &[]), gamma)).contains("expected values that rise"));
    assert!(error("paper", axes(("c", &[1.0, 1.0]), gamma)).contains("expected values that rise"));
    assert!(error("paper", axes(("c", &[0.0, 1.0]), gamma)).contains("above 0"));
    assert!(error("paper", axes(("c", &[1.0, f64::INFINITY]), gamma)).contains("above 0"));
    assert!(error("boosted", axes(("c", &[1.0]), gamma)).contains("expected n_rounds"));
    let depth = ("max_depth", &[2.0][..]);
    assert!(error("boosted", axes(("n_rounds", &[1.5]), depth)).contains("whole number"));
}

/// Trains with a grid in a folder and returns the model.
fn train(folder: &Path, more: &[&str]) -> (Model, String, String) {
    let model = folder.join("model.json");
    let mut arguments = vec![
        "train",
        RECORDING,
        "--recipe",
        "paper",
        "--words",
        "16",
        "--grid",
        "--out",
        model.to_str().expect("UTF-8"),
    ];
    arguments.extend(more);
    let output = run(&arguments, 0);
    (Model::load(&model).expect("a model"), text(&output.stdout), text(&output.stderr))
}

#[test]
fn the_model_is_trained_with_the_best_pair_and_keeps_the_table() {
    let folder = tempfile::tempdir().expect("a folder");
    let (json, svg) = (folder.path().join("grid.json"), folder.path().join("grid.svg"));
    let [json_text, svg_text] = [&json, &svg].map(|path| path.to_str().expect("UTF-8"));
    let more = ["--grid-c", "10,1", "--grid-gamma", "0.1,0.3,1", "--grid-report", json_text, "--grid-report", svg_text];
    let (model, stdout, stderr) = train(folder.path(), &more);
    assert!(stderr.contains("grid: 15 of 15 parts"), "{stderr}");
    assert_eq!(stdout.matches("<- trained with").count(), 1, "{stdout}");

    let report = &json_lines(std::fs::read_to_string(&json).expect("there").replace('\n', " ").as_bytes())[0];
    assert_eq!(report["axes"][0]["values"], serde_json::json!([1.0, 10.0]));
    let best: Vec<f64> = serde_json::from_value(report["best"]["values"].clone()).expect("a pair");
    let Learner::Svm(params) = &model.training.recipe.learner else { panic!("an SVM") };
    assert_eq!([params.c, params.gamma], best[..]);
    let kept = model.training.grid.as_ref().expect("a table");
    assert_eq!((kept.axes.join(" "), kept.cells.len()), ("c gamma".into(), 6));
    assert!(kept.cells.iter().all(|cell| cell.accuracy > 0.3 && cell.false_positive_share < 0.7));
    let picture = std::fs::read_to_string(&svg).expect("there");
    assert_eq!(picture.matches("class=\"score\"").count(), 6, "{picture}");

    // Once more: nothing is left to do, and the model is the same to the byte.
    let bytes = std::fs::read(folder.path().join("model.json")).expect("there");
    let (_, stdout_again, stderr) = train(folder.path(), &more);
    assert!(!stderr.contains("grid: "), "{stderr}");
    assert_eq!(stdout, stdout_again);
    assert_eq!(std::fs::read(folder.path().join("model.json")).expect("there"), bytes);
}

#[test]
fn ctrl_c_keeps_what_is_done() {
    let folder = tempfile::tempdir().expect("a folder");
    let json = folder.path().join("grid.json");
    let more = [
        "--grid-c",
        "1,10,100",
        "--grid-gamma",
        "0.01,0.02,0.05,0.1,0.2,0.5,1,2,5,10",
        "--grid-report",
        json.to_str().expect("UTF-8"),
    ];
    let model = folder.path().join("model.json");
    let mut child = crate::common::blindgrasp()
        .args(["train", RECORDING, "--recipe", "paper", "--words", "16", "--grid", "--out"])
        .arg(&model)
        .args(more)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    wait_until(|| json.exists() || child.try_wait().expect("asked").is_some(), || "no report".into());
    signal(child.id() as i32, rustix::process::Signal::INT);
    let output = child.wait_with_output().expect("ended");
    let stderr = text(&output.stderr);
    // A fast machine may be done before the signal.
    if output.status.code() == Some(1) {
        assert!(stderr.contains("interrupted: ") && stderr.contains("goes on from there"), "{stderr}");
        assert!(!model.exists());
    }
    let n_first = stderr.lines().filter(|line| line.starts_with("grid: ")).count();
    let (_, _, stderr) = train(folder.path(), &more);
    let n_second = stderr.lines().filter(|line| line.starts_with("grid: ")).count();
    assert!(n_first > 0 && n_first + n_second == 50, "{n_first} and {n_second} parts");
}

#[test]
fn options_of_the_grid_are_checked() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("model.json");
    let refused = |more: &[&str], exit_code: i32, expected: &str| {
        let mut arguments = vec!["train", RECORDING, "--out", out.to_str().expect("UTF-8")];
        arguments.extend(more);
        let stderr = text(&run(&arguments, exit_code).stderr);
        assert!(stderr.contains(expected), "{more:?}: {stderr}");
        assert!(!out.exists());
    };
    refused(&["--grid-c", "1,2"], 2, "--grid");
    refused(&["--recipe", "paper", "--grid", "--c", "3"], 2, "--c");
    refused(&["--recipe", "paper", "--grid", "--grid-c", "1,-2"], 2, "-2");
    refused(&["--grid", "--grid-report", "grid.txt"], 2, ".json or .svg");
    refused(&["--grid", "--grid-c", "1,2"], 1, "--grid-c: the recipe boosted has no c");
    refused(&["--recipe", "paper", "--grid", "--grid-depth", "3"], 1, "the recipe paper has no max_depth");
    refused(&["--grid", "--grid-rounds", "1.5"], 1, "whole number");
    refused(&["--grid", "--grid-report", RECORDING], 2, ".json or .svg");
}
