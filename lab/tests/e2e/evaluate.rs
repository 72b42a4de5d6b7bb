//! `blindgrasp evaluate`: recipes judged on grasps held out, a model on recordings, predictions of other models, and the
//! reports.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_json::{Value, json};

use crate::common::browser::Browser;
use crate::common::python::{python, shell, utf8};
use crate::common::{MODEL, RECORDING, fails, json_of, project, report_data, run, text};
use crate::import::pincer;

const SPLIT: [&str; 9] =
    ["evaluate", RECORDING, "--split", "object", "--folds", "3", "--recipe", "boosted,paper", "--json"];

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

/// The texts of the tables' cells and of the whole page, as a browser shows them; `None` without a browser.
fn shown(page: &Path) -> Option<(Vec<String>, String)> {
    let mut browser = Browser::open(&format!("file://{}", page.display()))?;
    let cells = browser.ask("[...document.querySelectorAll('td')].map((cell) => cell.textContent)");
    let text = browser.ask("document.title + document.querySelector('main').textContent");
    assert_eq!(browser.ask("axe"), Value::Array(vec![]));
    assert_eq!(browser.ask("errors"), Value::Array(vec![]));
    Some((serde_json::from_value(cells).expect("texts"), text.as_str().expect("a text").to_owned()))
}

/// Asserts that a browser would fetch nothing, and run the page's own script alone.
fn assert_self_contained(page: &str) {
    assert!(page.contains("content=\"default-src 'none'; script-src 'unsafe-inline' blob:; "));
    assert_eq!(page.matches("<script").count(), 2, "the data, and the script that draws them");
    for banned in ["<link", "@import", "url(", "<iframe", "src=\"", "https:"] {
        assert!(!page.contains(banned), "{banned}");
    }
}

#[test]
fn recipes_are_judged_on_grasps_held_out_and_the_same_seed_gives_the_same_figures() {
    let report = json_of(&SPLIT);
    assert_eq!(report, json_of(&SPLIT));
    let mut other = SPLIT.to_vec();
    other.extend(["--seed", "2"]);
    assert_ne!(report["judges"], json_of(&other)["judges"]);

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
    arguments.extend(["--report", name]);
    let report = json_of(&arguments);
    let page = std::fs::read_to_string(&path).expect("the report");
    assert_self_contained(&page);
    assert_eq!(std::fs::read_dir(folder.path()).expect("readable").count(), 1, "nothing else is left there");
    let data = report_data(&page);
    for (name, value) in report.as_object().expect("a report") {
        assert_eq!(data["data"][name], *value, "{name}");
    }

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
    let Some((cells, shown)) = shown(&path) else { return };
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
    assert!(n_checked > 100, "{n_checked}");
    for expected in ["24,640", "81.0 %", "Receiver operating", "Figure 2: errors"] {
        assert!(shown.contains(expected), "{expected}");
    }
    assert!(page.contains("8 words"), "the dictionary is in the page");
}

#[test]
fn a_model_gets_the_same_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let (model, page) = (path("model.json"), path("report.html"));
    std::fs::copy(project().join(MODEL), &model).expect("copied");
    let report = json_of(&["evaluate", &model, RECORDING, "--json", "--report", &page]);
    let judge = &report["judges"][0];
    assert_eq!(judge["name"], "model.json");
    assert_eq!(report["made"]["split"], Value::Null);
    for (of_graph, of_judge) in [("score", "all"), ("score_judged", "judged")] {
        assert_eq!(report[of_graph]["accuracy"], judge[of_judge]["accuracy"]["value"]);
        assert_eq!(report[of_graph]["n_false_positive"], judge[of_judge]["n_false_positive"]);
    }
    assert!(number(&judge["roc_auc"]) > 0.9, "{}", judge["roc_auc"]);
    assert_eq!((&report["trained"]["n_left_out"], &report["trained"]["new_objects"]), (&0.into(), &report["score"]));
    assert_self_contained(&std::fs::read_to_string(&page).expect("the report"));
    if let Some((_, shown)) = shown(Path::new(&page)) {
        assert!(shown.contains("What model.json is worth"), "{shown}");
    }
    let table = text(&run(&["evaluate", &model, RECORDING], 0).stdout);
    assert!(table.contains("false positives") && table.contains("reasons: "), "{table}");

    fails(&["evaluate", &model, RECORDING, "--split", "object"], "leave out --split");
    fails(&["evaluate", &model, RECORDING, "--report", &model], "is an input");
}

#[test]
fn a_model_of_lifts_is_shown_at_each_stage() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("report.html");
    let model = "models/barrett-bh8-280-lifts.json";
    let report = json_of(&["evaluate", model, RECORDING, "--json", "--report", utf8(&page)]);
    let Some((cells, _)) = shown(&page) else { return };
    let row = cells.iter().position(|cell| cell == "settled").expect("the stage of a recording without probes");
    let look = &report["looks"][0];
    assert_eq!(cells[row + 1], look["n_grasps"].to_string());
    assert!(cells[row + 5].starts_with(&format!("{} (", look["n_lifted"])), "{}", cells[row + 5]);
}

#[test]
fn judged_grasps_have_their_own_objects() {
    let printed = text(&run(&SPLIT[..SPLIT.len() - 1], 0).stdout);
    // 240 grasps of 151 objects have a label.
    assert!(printed.contains("judged: 203 grasps of 132 objects; held without a judgement: 37,"), "{printed}");
}

/// The functions of the page's script, in a browser: numbers, axes, charts, and charts as files.
#[test]
fn a_page_writes_numbers_and_draws_charts_as_people_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("report.html");
    run(&["evaluate", MODEL, RECORDING, "--report", utf8(&page)], 0);
    let Some(mut browser) = Browser::open(&format!("file://{}", page.display())) else { return };
    let texts = [
        ("[0, 999, 24640, 1e6].map(blindgrasp.count)", json!(["0", "999", "24,640", "1,000,000"])),
        // An exact tie goes to the even digit, as on the console.
        ("[0.8125, 0.0625, 0.1875, -0.25].map(blindgrasp.percent)", json!(["81.2 %", "6.2 %", "18.8 %", "−25.0 %"])),
        ("[blindgrasp.decimals(0.95), blindgrasp.decimals(null)]", json!(["0.950", "–"])),
        ("[0.25, 1.234e-9].map(blindgrasp.pValue)", json!(["0.250", "1.2e−9"])),
        (
            "[{ value: 0.883, interval: { low: 0.8764, high: 0.89 } }, { value: 0.01, interval: { low: -0.01, high: 0.02 } }, \
             { value: 0.5, interval: null }, null].map(blindgrasp.estimate)",
            json!(["88.3 % (87.6–89.0)", "1.0 % (−1.0 to 2.0)", "50.0 %", "–"]),
        ),
        // A seed is no number of JavaScript, and a text stays as it is.
        (
            r#"Object.values(blindgrasp.read('{"a": 18446744073709551615, "b": "x:1234567890123456789,", "c": 0.1250000000000000}'))"#,
            json!(["18446744073709551615", "x:1234567890123456789,", 0.125]),
        ),
        ("blindgrasp.percentAxis('', 0.25).ticks.map(([, text]) => text)", json!(["0", "5", "10", "15", "20", "25"])),
        ("blindgrasp.axis('', 0, 16000).ticks.map(([, text]) => text)", json!(["0", "5,000", "10,000", "15,000"])),
        ("blindgrasp.axis('', -1, 1).ticks.map(([, text]) => text)", json!(["−1", "−0.5", "0", "0.5", "1"])),
        ("[0.21, 0].map(blindgrasp.roundUp)", json!([0.25, 1])),
    ];
    for (expression, expected) in texts {
        assert_eq!(browser.ask(expression), expected, "{expression}");
    }
    // The axes span 48 to 244 downwards and 68 to 268 to the right; 5 is moved to the edge.
    let line = browser.ask(
        "blindgrasp.lineChart({ title: 'T < 1', width: 292, height: 300, x: blindgrasp.axis('a & b', 0, 2), \
         y: blindgrasp.percentAxis('y'), series: [{ colour: '--series-0', points: [[0, 0], [2, 5]], marks: [[1, 0.5, 3]], \
         intervals: [[1, 0.25, 0.75]] }] }).svg.outerHTML",
    );
    for expected in ["M68 244L268 48", "M165 146a3 3", "M164 195h8m-4 0V97", "T &lt; 1", "a &amp; b"] {
        assert!(line.as_str().is_some_and(|svg| svg.contains(expected)), "{expected}: {line}");
    }
    let bars = browser.ask(
        "(window.bars = blindgrasp.barChart({ title: 'Errors', width: 250, height: 300, y: blindgrasp.percentAxis('y'), \
         groups: ['<b>a</b>', 'a name that does not fit'], series: ['errors', 'false positives'].map((name) => \
         ({ name, colour: '--series-1', heights: [0.5, 0.25] })) }), [bars.querySelectorAll('rect').length, \
         bars.querySelectorAll('b').length, bars.outerHTML.includes('rotate(-45'), bars.textContent.includes('<b>a</b>')])",
    );
    assert_eq!(bars, json!([7, 0, true, true]), "the card, two in the legend, two in each of two groups");
    // A saved chart has the colours of the page in it.
    for (idx, axes) in [
        ["unstable grasps that are lifted (%)", "stable grasps that are lifted (%)"],
        ["recall: stable grasps that are lifted (%)", "precision: lifted grasps that are stable (%)"],
        ["probability of stable, mean of a bin (%)", "grasps of the bin that are stable (%)"],
    ]
    .into_iter()
    .enumerate()
    {
        let saved = "let saved = null; const make = URL.createObjectURL; \
                     URL.createObjectURL = (blob) => { saved = blob; return make.call(URL, blob); };";
        let click = format!("document.querySelectorAll('.save')[{idx}].click(); return await saved.text();");
        let svg = browser.ask(&format!("(async () => {{ {saved} {click} }})()"));
        let svg = svg.as_str().expect("a picture");
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>") && !svg.contains("var("), "{svg}");
        for shown in axes.into_iter().chain(["barrett-bh8-280.json, ", "#1864ab"]) {
            assert!(svg.contains(shown), "{shown}: {svg}");
        }
    }
}

/// The rows of a table, each by the names of its columns.
fn rows(path: &Path) -> Vec<BTreeMap<String, String>> {
    let mut table = csv::Reader::from_path(path).expect("a table");
    table.deserialize().map(|row| row.expect("a row")).collect()
}

/// Writes the figures of recipes on held-out grasps to a folder; the report.
fn figures(folder: &Path) -> Value {
    json_of(&[&SPLIT[..], &["--figures", utf8(folder)]].concat())
}

#[test]
fn figures_have_the_fold_and_the_probability_of_each_grasp() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path().join("figures");
    let report = figures(&folder);
    assert!(folder.join("figure-1.svg").is_file());
    let of = |name: &str, model: &str| {
        rows(&folder.join(name)).into_iter().filter(|row| row["model"] == model).collect::<Vec<_>>()
    };
    for judge in report["judges"].as_array().expect("judges") {
        let model = judge["name"].as_str().expect("a name");
        let grasps = of("predictions.csv", model);
        assert_eq!(grasps.len() as f64, number(&report["data"]["n_judged"]));
        let mut fold_of: BTreeMap<&str, &str> = BTreeMap::new();
        for grasp in &grasps {
            assert_eq!(
                *fold_of.entry(&grasp["object"]).or_insert(&grasp["fold"]),
                grasp["fold"],
                "an object in two folds"
            );
        }
        assert_eq!(fold_of.into_values().collect::<BTreeSet<_>>(), BTreeSet::from(["1", "2", "3"]));
    }
}

#[test]
fn predictions_of_any_model_are_judged_like_the_recipes() {
    let folder = tempfile::tempdir().expect("a folder");
    let report = figures(folder.path());
    let at = |name: &str| folder.path().join(name);
    // The predictions of the recipes themselves get the figures of the recipes.
    let table = at("predictions.csv");
    let page = at("report.html");
    let alone = ["evaluate", RECORDING, "--predictions", utf8(&table), "--json", "--report", utf8(&page)];
    let again = json_of(&alone);
    let own = report["judges"].as_array().expect("judges");
    assert_eq!(again["judges"].as_array().map(Vec::len), Some(2));
    for (own, again) in own.iter().zip(again["judges"].as_array().expect("judges")) {
        assert_eq!(again["about"], "predictions of predictions.csv");
        for figure in ["name", "threshold_probability", "judged", "all", "by_class", "roc_auc", "curve", "reliability"]
        {
            assert_eq!(own[figure], again[figure], "{figure}");
        }
    }
    assert_eq!((&report["data"], &report["comparisons"]), (&again["data"], &again["comparisons"]));
    assert_self_contained(&std::fs::read_to_string(&page).expect("a report"));
    if let Some((_, shown)) = shown(&page) {
        assert!(shown.contains("learning performance in simulation") && shown.contains("taken as they are"), "{shown}");
    }

    // A name is never read as HTML.
    let hostile = at("hostile.csv");
    let rows = std::fs::read_to_string(&table).expect("predictions").replace(",paper,", ",<img src=x>,");
    std::fs::write(&hostile, rows).expect("written");
    run(&["evaluate", RECORDING, "--predictions", utf8(&hostile), "--report", utf8(&page)], 0);
    assert_self_contained(&std::fs::read_to_string(&page).expect("a report"));
    if let Some((_, shown)) = shown(&page) {
        assert!(shown.contains("boosted against <img src=x>"), "{shown}");
    }

    // Under another name, beside the recipes: the outside model comes first, and is compared with each of them.
    let mine = at("mine.csv");
    let text_of_boosted: String = std::fs::read_to_string(&table)
        .expect("predictions")
        .lines()
        .filter(|line| !line.contains(",paper,"))
        .map(|line| line.replace(",boosted,", ",mine,") + "\n")
        .collect();
    std::fs::write(&mine, &text_of_boosted).expect("written");
    let beside = json_of(&[&SPLIT[..], &["--predictions", utf8(&mine)]].concat());
    let judges = beside["judges"].as_array().expect("judges");
    let names: Vec<_> = judges.iter().filter_map(|judge| judge["name"].as_str()).collect();
    assert_eq!(names, ["mine", "boosted", "paper"]);
    assert_eq!(judges[0]["judged"], judges[1]["judged"]);
    assert_eq!(beside["comparisons"].as_array().map(Vec::len), Some(3));
    assert_eq!(
        (&beside["comparisons"][0]["mcnemar_p"], &beside["comparisons"][0]["second"]),
        (&1.0.into(), &"boosted".into())
    );
    assert_eq!(
        beside["comparisons"][1]["relative_error_reduction"],
        report["comparisons"][0]["relative_error_reduction"]
    );

    // A higher threshold lifts less, and the curves stay.
    let strict = json_of(&["evaluate", RECORDING, "--predictions", utf8(&mine), "--threshold", "0.9", "--json"]);
    let lifted =
        |judge: &Value| number(&judge["judged"]["n_true_positive"]) + number(&judge["judged"]["n_false_positive"]);
    assert!(lifted(&strict["judges"][0]) < lifted(&judges[0]));
    assert_eq!(strict["judges"][0]["roc_auc"], judges[0]["roc_auc"]);

    // Beside a model, without the column of models: the file gives the name.
    let without_model: String =
        text_of_boosted.lines().map(|line| line.replace(",mine,", ",").replace(",model,", ",") + "\n").collect();
    std::fs::write(&mine, without_model).expect("written");
    let of_model = json_of(&["evaluate", MODEL, RECORDING, "--predictions", utf8(&mine), "--json"]);
    let names: Vec<_> =
        of_model["judges"].as_array().expect("judges").iter().map(|judge| judge["name"].clone()).collect();
    assert_eq!(names, ["mine", "barrett-bh8-280.json"]);
    assert_eq!(of_model["comparisons"].as_array().map(Vec::len), Some(1));
    let table = text(&run(&["evaluate", MODEL, RECORDING, "--predictions", utf8(&mine)], 0).stdout);
    assert!(table.contains("\nmodel ") && table.contains("mine against barrett-bh8-280.json"), "{table}");
}

#[test]
fn predictions_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    figures(folder.path());
    let table = folder.path().join("predictions.csv");
    let whole = std::fs::read_to_string(&table).expect("predictions");
    let whole: String =
        whole.lines().filter(|line| !line.contains(",paper,")).map(|line| line.to_owned() + "\n").collect();
    let second = whole.lines().nth(1).expect("a row").to_owned();
    let mine = folder.path().join("mine.csv");
    let refuse = |text_of: &str, arguments: &[&str], expected: &str| {
        std::fs::write(&mine, text_of).expect("written");
        let refused = run(&[&["evaluate", RECORDING, "--predictions", utf8(&mine)], arguments].concat(), 1);
        let stderr = text(&refused.stderr);
        assert!(
            stderr.contains(expected) && stderr.contains("mine.csv") && refused.stdout.is_empty(),
            "{expected}: {stderr}"
        );
    };
    refuse(&whole.replace(&format!("{second}\n"), ""), &[], "model 'boosted' has no prediction for 1 of the");
    refuse(&format!("{whole}{second}\n"), &[], "on line 2 already");
    refuse(&whole.replace("held-out.mcap", "other.mcap"), &[], "line 2: column 'recording'");
    refuse(
        &(whole.clone() + &second.replacen("held-out.mcap,", "held-out.mcap,99", 1) + "\n"),
        &[],
        "held-out.mcap has no grasp 99",
    );
    let (before, _) = second.rsplit_once(',').expect("columns");
    refuse(
        &whole.replace(&second, &format!("{before},NaN")),
        &[],
        "line 2: column 'probability_stable': expected a number from 0",
    );
    let split = ["--split", "object", "--folds", "3", "--recipe", "boosted"];
    refuse(&whole, &split, "a model is called 'boosted', like one of blindgrasp's");
    // With another seed, grasps are in other folds.
    let other = [&split[..], &["--seed", "2"]].concat();
    refuse(&whole.replace(",boosted,", ",mine,"), &other, "in predictions.csv, which --figures writes");
    refuse("grasp_id\n", &[], "line 1: there is no column 'probability_stable'");

    let figures = ["--figures", utf8(folder.path())];
    fails(&[&["evaluate", RECORDING, "--predictions", utf8(&table)], &figures[..]].concat(), "is an input");
    fails(&["evaluate", RECORDING, "--predictions", utf8(&table), "--probe", "squeeze"], "give a model as well");
    fails(&["evaluate", MODEL, RECORDING, "--probe", "test_lift"], "judges no test_lifted grasps");
}

/// A robot's own table: the report must not say that it was simulated.
#[test]
fn a_report_on_a_real_hand_does_not_speak_of_simulation() {
    let folder = tempfile::tempdir().expect("a folder");
    let hand = pincer(folder.path());
    let write = |name: &str, content: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).expect("written");
        utf8(&path).to_owned()
    };
    let table = write(
        "table.csv",
        "object,held,l_1,l_2,r_1\ncup,yes,0.5,1.25,2\ncup,no,0.5,0,0.3\nbox,yes,1,1,2\nbox,no,0,0.2,0.5\n",
    );
    let recording = utf8(&folder.path().join("out.mcap")).to_owned();
    let columns = ["--cells", "l_*,r_*", "--label", "held", "--stable-value", "yes", "--group", "object"];
    let import = ["import", &table, "--hand", &hand, "--joints", "left=0.5", "--out", &recording];
    run(&[&import[..], &columns].concat(), 0);
    let predictions = write("forest.csv", "grasp_id,probability_stable\n0,0.9\n1,0.4\n2,0.7\n3,0.6\n");
    let page = folder.path().join("report.html");
    let arguments = ["evaluate", &recording, "--hand", &hand, "--predictions", &predictions, "--report", utf8(&page)];
    let printed = text(&run(&arguments, 0).stdout);
    assert!(printed.contains("\nforest") && printed.contains("75.0 %"), "{printed}");
    let Some((_, shown)) = shown(&page) else { return };
    assert!(shown.contains("Table I: learning performance") && !shown.contains("simulation"), "{shown}");
    assert!(shown.contains("What forest is worth") && shown.contains("predictions of forest.csv"), "{shown}");
}

/// The block of Python in docs/learning.md, as a reader would run it.
#[test]
fn the_example_with_scikit_learn_is_judged_beside_the_recipes() {
    let folder = tempfile::tempdir().expect("a folder");
    figures(&folder.path().join("figures"));
    let features = folder.path().join("features.csv");
    run(&["export", RECORDING, "--features", MODEL, "--out", utf8(&features)], 0);
    let page = std::fs::read_to_string(project().join("docs/learning.md")).expect("a page");
    let blocks: Vec<&str> =
        page.split("```python\n").skip(1).map(|block| block.split("```").next().expect("its end")).collect();
    let block = blocks.iter().find(|block| block.contains("mine.csv")).expect("an example");
    let program = folder.path().join("mine.py");
    std::fs::write(&program, block).expect("written");
    let printed = text(&shell(folder.path(), python(), &[utf8(&program)], 0).stdout);
    assert!(printed.contains("finger_") || printed.contains("hist_") || printed.contains("palm."), "{printed}");
    let mine = folder.path().join("mine.csv");
    let report = json_of(&[&SPLIT[..], &["--predictions", utf8(&mine)]].concat());
    let names: Vec<_> =
        report["judges"].as_array().expect("judges").iter().map(|judge| judge["name"].clone()).collect();
    assert_eq!(names, ["forest", "boosted", "paper"]);
    assert!(number(&report["judges"][0]["roc_auc"]) > 0.65, "{}", report["judges"][0]["roc_auc"]);
}

#[test]
fn folds_by_grasp_and_by_class_are_judged_too() {
    for (split, interval) in [("grasp", "Wilson"), ("class", "objects")] {
        let arguments = ["evaluate", RECORDING, "--split", split, "--folds", "2", "--recipe", "boosted", "--json"];
        let report = json_of(&arguments);
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
        (vec![RECORDING, "--predictions", "absent.csv"], 1, "absent.csv"),
        (vec![RECORDING, "--threshold", "0.5"], 2, "--predictions"),
        (vec![RECORDING, "--predictions", "absent.csv", "--threshold", "1.5"], 2, "a number from"),
        (vec![RECORDING, "--folds", "5"], 2, "--split"),
        (vec![RECORDING, "--split", "hand"], 2, "grasp, object, class"),
        (vec![RECORDING, "--split", "object", "--folds", "1"], 2, "2..=1000"),
        (vec![RECORDING, "--split", "object", "--recipe", "magic"], 2, "boosted"),
    ] {
        let arguments: Vec<&str> = ["evaluate"].into_iter().chain(arguments).collect();
        let stderr = text(&run(&arguments, exit_code).stderr);
        assert!(stderr.contains(expected), "{arguments:?}: {stderr}");
    }
    assert!(!project().join("absent").exists());
}
