//! A grid search gives the same scores as separate trainings.

use std::path::{Path, PathBuf};

use crate::common::{RECORDING, json_lines, project, run, text};
use blindgrasp_learning::dataset::hand_of;
use blindgrasp_learning::training::grid::{Axis, GridError, GridPoint, GridReport, Search, with_values};
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

    fn search(&self, recipe: &Recipe, axes: &[Axis; 2]) -> Result<GridReport, GridError> {
        let examples = self.examples();
        Search { hand: &self.hand, recipe, axes, examples: &examples, folds: &self.folds, seed: SEED }.run(|| {})
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

/// The report without the times.
fn timeless(mut report: GridReport) -> GridReport {
    report.points.iter_mut().for_each(|point| point.secs = 0.0);
    report.best.secs = 0.0;
    report
}

/// Right and false-positive examples of each point, next to those of a cross-validation without a grid.
fn compare(data: &Data, recipe: &Recipe, axes: &[Axis; 2]) -> Vec<[(usize, usize); 2]> {
    let report = data.search(recipe, axes).expect("searched");
    assert_eq!(report.points.len(), axes[0].values.len() * axes[1].values.len());
    let examples = data.examples();
    let n = examples.len() as f64;
    let of_point = |point: &GridPoint| {
        let recipe = with_values(recipe, point.values);
        let values = cross_validate(&data.hand, &recipe, &examples, &data.folds, SEED, |_| {}).expect("trained");
        let calls = || values.iter().zip(&examples).map(|(value, example)| (*value > 0.0, example.stable));
        let alone = (
            calls().filter(|(called, stable)| called == stable).count(),
            calls().filter(|(called, stable)| *called && !stable).count(),
        );
        let in_grid = ((point.accuracy * n).round() as usize, (point.false_positive_share * n).round() as usize);
        [in_grid, alone]
    };
    report.points.iter().map(of_point).collect()
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
            timeless(pool.install(|| data.search(&recipe(name), &axes)).expect("searched"))
        };
        let on_one = search(1);
        assert!([2, 3, 8].into_iter().all(|n_threads| search(n_threads) == on_one), "{name}");
    }
}

#[test]
fn axes_are_checked() {
    let data = data();
    let error = |name: &str, axes: [Axis; 2]| {
        let error = data.search(&recipe(name), &axes).expect_err("bad axes");
        assert!(matches!(error, GridError::Axis { .. }), "{error}");
        error.to_string()
    };
    let gamma = ("gamma", &[0.1][..]);
    assert!(error("paper", axes(("c", &[]), gamma)).contains("expected values in rising order"));
    assert!(error("paper", axes(("c", &[1.0, 1.0]), gamma)).contains("expected values in rising order"));
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
        "--overwrite",
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
    let json = folder.path().join("grid.json");
    let json_text = json.to_str().expect("UTF-8");
    let more = ["--grid-c", "10,1", "--grid-gamma", "0.1,0.3,1", "--grid-report", json_text];
    let (model, stdout, stderr) = train(folder.path(), &more);
    assert!(stderr.contains("grid: 30 of 30 trainings"), "{stderr}");
    assert_eq!(stdout.matches("<- trained with").count(), 1, "{stdout}");

    let report = &json_lines(std::fs::read_to_string(&json).expect("there").replace('\n', " ").as_bytes())[0];
    assert_eq!(report["axes"][0]["values"], serde_json::json!([1.0, 10.0]));
    assert_eq!(report["cells"].as_array().map(Vec::len), Some(6));
    let best: Vec<f64> = serde_json::from_value(report["best"]["values"].clone()).expect("a pair");
    let Learner::Svm(params) = &model.training.recipe.learner else { panic!("an SVM") };
    assert_eq!([params.c, params.gamma], best[..]);
    let kept = model.training.grid.as_ref().expect("a table");
    assert_eq!((kept.axes.join(" "), kept.cells.len()), ("c gamma".into(), 6));
    assert!(kept.cells.iter().all(|cell| cell.accuracy > 0.3 && cell.false_positive_share < 0.7));

    // Once more: the model is the same to the byte.
    let bytes = std::fs::read(folder.path().join("model.json")).expect("there");
    let (_, stdout_again, _) = train(folder.path(), &more);
    assert_eq!(stdout, stdout_again);
    assert_eq!(std::fs::read(folder.path().join("model.json")).expect("there"), bytes);
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
    refused(&["--grid", "--grid-report", "grid.txt"], 2, "ends in .json");
    refused(&["--grid", "--grid-c", "1,2"], 1, "--grid-c: the recipe boosted has no c");
    refused(&["--recipe", "paper", "--grid", "--grid-depth", "3"], 1, "the recipe paper has no max_depth");
    refused(&["--grid", "--grid-rounds", "1.5"], 1, "whole number");
    refused(&["--grid", "--grid-report", RECORDING], 2, "ends in .json");
}
