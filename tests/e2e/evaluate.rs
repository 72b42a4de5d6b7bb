//! `blindgrasp evaluate`: recipes judged on grasps held out, a model on recordings, and the report of either.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::Value;

use crate::common::{MODEL, RECORDING, project, run, text};

const SPLIT: [&str; 9] =
    ["evaluate", RECORDING, "--split", "object", "--folds", "3", "--recipe", "boosted,paper", "--json"];

fn json(arguments: &[&str]) -> Value {
    serde_json::from_slice(&run(arguments, 0).stdout).expect("JSON")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// Every number of a JSON value.
fn numbers(value: &Value, into: &mut Vec<f64>) {
    match value {
        Value::Number(number) => into.push(number.as_f64().expect("finite")),
        Value::Array(values) => values.iter().for_each(|value| numbers(value, into)),
        Value::Object(fields) => fields.values().for_each(|value| numbers(value, into)),
        _ => {}
    }
}

/// The text of the tables' cells, without tags.
fn cells(page: &str) -> Vec<String> {
    page.split("<td")
        .skip(1)
        .map(|rest| {
            let cell = rest.split("</td>").next().expect("a part").split_once('>').expect("a tag's end").1;
            let mut plain = String::new();
            let mut in_tag = false;
            for letter in cell.chars() {
                match letter {
                    '<' => in_tag = true,
                    '>' => in_tag = false,
                    other if !in_tag => plain.push(other),
                    _ => {}
                }
            }
            plain
        })
        .collect()
}

/// Asserts that a browser would fetch and run nothing.
fn assert_self_contained(page: &str) {
    for banned in ["<script", "<link", "@import", "url(", "<iframe", "src=\""] {
        assert!(!page.contains(banned), "{banned}");
    }
    for (at, _) in page.match_indices("href=\"") {
        assert!(page[at..].starts_with("href=\"data:image/png;base64,"), "{}", &page[at..at + 60]);
    }
    for (at, _) in page.match_indices("http") {
        assert!(page[..at].ends_with("xmlns=\""), "{}", &page[at - 20..at + 40]);
    }
}

#[test]
fn recipes_are_judged_on_grasps_held_out_and_the_same_seed_gives_the_same_figures() {
    let report = json(&SPLIT);
    assert_eq!(report, json(&SPLIT));
    let mut other = SPLIT.to_vec();
    other.extend(["--seed", "2"]);
    assert_ne!(report["judges"], json(&other)["judges"]);

    assert_eq!(report["made"]["split"]["by"], "object");
    let data = &report["data"];
    assert_eq!(data["n_grasps"], 240);
    assert_eq!(number(&data["n_judged"]) + number(&data["n_held_unjudged"]), 240.0);
    let judges = report["judges"].as_array().expect("judges");
    assert_eq!(judges.iter().map(|judge| judge["name"].as_str()).collect::<Vec<_>>(), [Some("boosted"), Some("paper")]);
    for judge in judges {
        let judged = &judge["judged"];
        let of = |name: &str| number(&judged[name]);
        let n = of("n_true_positive") + of("n_false_positive") + of("n_false_negative") + of("n_true_negative");
        assert_eq!(n, number(&data["n_judged"]), "each judged grasp is decided once");
        let accuracy = number(&judged["accuracy"]["value"]);
        assert!((accuracy - (of("n_true_positive") + of("n_true_negative")) / n).abs() < 1e-12);
        assert!(number(&judged["accuracy"]["interval"]["low"]) < accuracy);
        // Few grasps, but far better than a coin.
        assert!(number(&judge["roc_auc"]) > 0.65, "{}", judge["roc_auc"]);
        let by_class = judge["by_class"].as_array().expect("classes");
        let in_classes: f64 = by_class.iter().map(|class| number(&class["n_wrong"])).sum();
        assert_eq!(in_classes, of("n_false_positive") + of("n_false_negative"));
        let in_bins: f64 =
            judge["reliability"]["bins"].as_array().expect("bins").iter().map(|bin| number(&bin["n"])).sum();
        assert_eq!(in_bins, n);
    }
    let pair = &report["comparisons"][0];
    let wrong = |idx: usize| {
        number(&judges[idx]["judged"]["n_false_positive"]) + number(&judges[idx]["judged"]["n_false_negative"])
    };
    assert_eq!(number(&pair["n_only_first_right"]) - number(&pair["n_only_second_right"]), wrong(1) - wrong(0));
    assert!((number(&pair["relative_error_reduction"]["value"]) - (1.0 - wrong(0) / wrong(1))).abs() < 1e-12);
    assert_eq!(report["dictionary"]["words"].as_array().map(Vec::len), Some(8));
}

#[test]
fn a_report_is_self_contained_and_the_json_has_every_number_of_its_tables() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("report.html");
    let mut arguments = SPLIT.to_vec();
    let name = path.to_str().expect("UTF-8");
    arguments.extend(["--report", name, "--repeats", "2", "--learning-curve"]);
    let report = json(&arguments);
    let page = std::fs::read_to_string(&path).expect("the report");
    assert_self_contained(&page);
    assert_eq!(std::fs::read_dir(folder.path()).expect("readable").count(), 1, "nothing else is left there");

    let mut found = Vec::new();
    numbers(&report, &mut found);
    let mut written: BTreeSet<String> = BTreeSet::new();
    for value in found.into_iter().map(f64::abs) {
        written.extend([format!("{value:.0}"), format!("{value:.3}"), format!("{:.1}", 100.0 * value)]);
        let scientific = format!("{value:.1e}");
        written.extend(scientific.split(['e', '-']).map(String::from));
    }
    let classes: Vec<&str> = report["judges"][0]["by_class"]
        .as_array()
        .expect("classes")
        .iter()
        .filter_map(|class| class["class"].as_str())
        .collect();
    let cells = cells(&page);
    assert!(cells.len() > 100, "{}", cells.len());
    let mut n_checked = 0;
    for cell in cells.iter().filter(|cell| !classes.contains(&cell.as_str())) {
        // The paper's numbers, too: all are in the JSON.
        for token in cell.replace(',', "").split(|letter: char| !(letter.is_ascii_digit() || letter == '.')) {
            let token = token.trim_matches('.');
            if !token.is_empty() {
                assert!(written.contains(token), "{token} of {cell:?} is not in the JSON");
                n_checked += 1;
            }
        }
    }
    assert!(n_checked > 150, "{n_checked}");
    for expected in
        ["24,640", "81.0 %", "Receiver operating", "Figure 2: errors", "8 words", "Learning curve", "mean (range)"]
    {
        assert!(page.contains(expected), "{expected}");
    }
    assert_eq!(report["repeats"].as_array().map(Vec::len), Some(2));
    let curve = report["learning_curve"].as_array().expect("a curve");
    assert_eq!(curve.len(), 10, "five shares, two recipes");
    assert!(
        curve
            .windows(2)
            .filter(|pair| pair[0]["recipe"] == pair[1]["recipe"])
            .all(|pair| { number(&pair[0]["n_grasps"]) < number(&pair[1]["n_grasps"]) })
    );
}

#[test]
fn a_model_gets_the_same_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let (model, page) = (path("model.json"), path("report.html"));
    std::fs::copy(project().join(MODEL), &model).expect("copied");
    let report = json(&["evaluate", &model, RECORDING, "--json", "--report", &page]);
    let judge = &report["judges"][0];
    assert_eq!(judge["name"], "model.json");
    assert_eq!(report["made"]["split"], Value::Null);
    for (of_graph, of_judge) in [("score", "all"), ("score_judged", "judged")] {
        assert_eq!(report[of_graph]["accuracy"], judge[of_judge]["accuracy"]["value"]);
        assert_eq!(report[of_graph]["n_false_positive"], judge[of_judge]["n_false_positive"]);
    }
    assert!(number(&judge["roc_auc"]) > 0.9, "{}", judge["roc_auc"]);
    assert_eq!((&report["trained"]["n_left_out"], &report["trained"]["new_objects"]), (&0.into(), &report["score"]));
    let page = std::fs::read_to_string(page).expect("the report");
    assert_self_contained(&page);
    assert!(page.contains("What model.json is worth"));
    let table = text(&run(&["evaluate", &model, RECORDING], 0).stdout);
    assert!(table.contains("false positives") && table.contains("reasons: "), "{table}");

    let refused = run(&["evaluate", &model, RECORDING, "--split", "object"], 1);
    assert!(text(&refused.stderr).contains("leave out --split"), "{}", text(&refused.stderr));
    let refused = run(&["evaluate", &model, RECORDING, "--report", &model], 1);
    assert!(text(&refused.stderr).contains("is an input"), "{}", text(&refused.stderr));
}

#[test]
fn folds_by_grasp_and_by_class_are_judged_too() {
    for (split, interval) in [("grasp", "Wilson"), ("class", "objects")] {
        let arguments = ["evaluate", RECORDING, "--split", split, "--folds", "2", "--recipe", "boosted", "--json"];
        let report = json(&arguments);
        assert_eq!(report["made"]["split"]["by"], split);
        assert!(report["made"]["intervals"].as_str().is_some_and(|text| text.contains(interval)));
        assert!(report["comparisons"].as_array().is_some_and(Vec::is_empty), "one recipe has none to compare with");
    }
}

#[test]
fn arguments_that_do_not_fit_are_refused_with_a_way_out() {
    for (arguments, exit_code, expected) in [
        (vec![RECORDING], 1, "expected a model first"),
        (vec![RECORDING, "--split", "object", "--folds", "1000"], 1, "objects for 1000 folds"),
        (vec![RECORDING, "--split", "class", "--folds", "50"], 1, "classes for 50 folds"),
        (vec![RECORDING, "--split", "object", "--recipe", "paper,paper"], 1, "named twice"),
        (vec![RECORDING, RECORDING, "--split", "object"], 1, "given twice"),
        (vec!["absent.json"], 1, "nothing to judge"),
        (vec!["absent.json", RECORDING], 1, "absent.json"),
        (vec![RECORDING, "--split", "object", "--report", "absent/report.html"], 1, "no such folder"),
        (vec![RECORDING, "--folds", "5"], 2, "--split"),
        (vec![RECORDING, "--split", "hand"], 2, "grasp, object, class"),
        (vec![RECORDING, "--split", "object", "--folds", "1"], 2, "2..=1000"),
        (vec![RECORDING, "--split", "object", "--recipe", "magic"], 2, "boosted"),
    ] {
        let arguments: Vec<&str> = ["evaluate"].into_iter().chain(arguments).collect();
        let stderr = text(&run(&arguments, exit_code).stderr);
        assert!(stderr.contains(expected), "{arguments:?}: {stderr}");
    }
    assert!(!Path::new("absent").exists());
}
