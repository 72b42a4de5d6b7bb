//! `blindgrasp trials`: the graph runs with its gate and without, and the outcome of each attempt is counted.

use std::collections::BTreeSet;
use std::process::Stdio;

use crate::common::browser::Browser;
use crate::common::{assert_nothing_left, blindgrasp, fails, project, run, signal, text, unique_name};
use rustix::process::Signal;
use serde_json::Value;

const THINGS: &str = "paper/pencil-cup,paper/candle-box";

/// The command with the project's dataflow. No grasp is stale, even on a busy machine.
fn arguments<'a>(flow: &'a str, name: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let patient = ["--set", "lift_arbiter.max_age_ms=600000", "--set", "source.decision_timeout_s=600"];
    let mut arguments = vec!["trials", "--dataflow", flow, "--name", name, "--objects", THINGS];
    arguments.extend(patient);
    arguments.extend_from_slice(more);
    arguments
}

fn flow() -> String {
    project().join("dataflow-live.yaml").to_str().expect("UTF-8").to_owned()
}

fn trials(records: &Value) -> BTreeSet<u64> {
    records.as_array().expect("records").iter().filter_map(|record| record["trial"].as_u64()).collect()
}

#[test]
fn the_same_trials_with_the_gate_and_without_are_counted_and_reported() {
    let (flow, name) = (flow(), unique_name());
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("trials.html");
    let page = page.to_str().expect("UTF-8");
    let more = ["--trials", "3", "--attempts", "2", "--json", "--report", page];
    let made = |more: &[&str]| {
        let output = run(&arguments(&flow, &name, more), 0);
        assert_nothing_left(&name);
        output.stdout
    };
    let report: Value = serde_json::from_slice(&made(&more)).expect("JSON");
    assert_eq!(report["end"], "finished");
    let (with, without) = (&report["records_with_gate"], &report["records_without_gate"]);
    assert_eq!(trials(with), BTreeSet::from([0, 1, 2]), "{with}");
    assert_eq!(trials(without), BTreeSet::from([0, 1, 2]), "{without}");
    for record in without.as_array().expect("records") {
        assert_eq!((&record["attempt"], &record["lifted"]), (&Value::from(0), &Value::from(true)), "{record}");
    }
    for way in ["with_gate", "without_gate"] {
        let total = &report[way]["total"];
        assert_eq!(total["n_trials"], 3, "{total}");
        let n_attempts = report[format!("records_{way}")].as_array().map(Vec::len);
        assert_eq!(total["n_attempts"].as_u64().map(|n| n as usize), n_attempts, "{total}");
        assert_eq!(report[way]["n_unfinished"], 0);
    }
    assert_eq!(report["effect"]["n_trials"], 3);
    let html = std::fs::read_to_string(page).expect("a page");
    assert!(html.contains("Table II") && html.contains("\"title\":\"After "), "{} bytes", html.len());
    assert!(html.len() < 3_000_000, "{} bytes", html.len());
    if let Some(mut browser) = Browser::open(&format!("file://{page}")) {
        let shown = browser.ask("document.querySelector('main').textContent");
        let shown = shown.as_str().expect("a text");
        assert!(
            shown.contains("Table II: lifts that kept the object") && shown.contains("How this was made"),
            "{shown}"
        );
        let n_cards = browser.ask("document.querySelectorAll('.card').length").as_u64().expect("a number");
        assert!(n_cards > 1);
        browser.wait_until(&format!("window.blindgrasp?.drawn === {n_cards}"));
        let is_drawn = "[...document.querySelectorAll('.card canvas')].every((canvas) => \
                        canvas.getContext('2d').getImageData(0, 0, 280, 300).data.some((value) => value > 0))";
        assert_eq!(browser.ask(is_drawn), true);
        assert_eq!(browser.ask("axe"), Value::Array(vec![]));
        assert_eq!(browser.ask("errors"), Value::Array(vec![]));
    }

    // The shards make the same trials again. The time of a robot that made them all is known to a step.
    let shards = ["0/2", "1/2"].map(|shard| {
        let path = folder.path().join(shard.replace('/', "-")).to_str().expect("UTF-8").to_owned();
        std::fs::write(&path, made(&[&more[..5], &["--shard", shard]].concat())).expect("written");
        path
    });
    let [a, b] = shards.each_ref().map(String::as_str);
    fails(&["trials", "--merge", b], "0/2 is missing");
    let merged = run(&["trials", "--merge", b, a, "--json", "--report", page], 0).stdout;
    let merged: Value = serde_json::from_slice(&merged).expect("JSON");
    for way in ["records_with_gate", "records_without_gate"] {
        let [found, expected] = [&merged, &report].map(|report| {
            let mut records = report[way].as_array().expect("records").clone();
            records.iter_mut().for_each(|record| record["end_secs"] = Value::Null);
            records
        });
        assert_eq!(found, expected);
    }
    let html = std::fs::read_to_string(page).expect("a page");
    assert!(html.contains("Table II") && !html.contains("\"title\":\"After "), "{} bytes", html.len());
}

#[test]
fn grasps_that_a_slow_machine_held_are_counted_and_options_come_from_the_file() {
    let (flow, name) = (flow(), unique_name());
    let folder = tempfile::tempdir().expect("a folder");
    let options = folder.path().join("options.yaml");
    std::fs::write(&options, "protocol: {n_settled: 4}").expect("written");
    let options = options.to_str().expect("UTF-8");
    // No machine is that fast.
    let hasty =
        ["--set", "lift_arbiter.max_age_ms=0.000001", "--options", options, "--lift-policy", "decision", "--json"];
    let few = ["--trials", "1", "--attempts", "2", "--objects", THINGS];
    let command = ["trials", "--dataflow", &flow, "--name", &name];
    let output = run(&[&command[..], &few, &hasty].concat(), 3);
    assert_nothing_left(&name);
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(report["late"], serde_json::json!({"n_stale": 2, "n_undecided": 0}), "{report}");
    assert!(text(&output.stderr).contains("raise lift_arbiter.max_age_ms (--set)"), "{}", text(&output.stderr));
    assert_eq!((&report["options"]["protocol"]["n_settled"], &report["n_left_out"]), (&4.into(), &0.into()));
}

#[test]
fn an_object_out_of_reach_is_refused_by_its_name() {
    let (flow, name) = (flow(), unique_name());
    let folder = tempfile::tempdir().expect("a folder");
    let options = folder.path().join("options.yaml");
    // That far from the post the hand reaches no object.
    std::fs::write(&options, "protocol: {stand_clearance_m: 0.5}").expect("written");
    let more = ["--options", options.to_str().expect("UTF-8"), "--trials", "1"];
    let refused = run(&arguments(&flow, &name, &more), 1);
    assert_nothing_left(&name);
    let said = text(&refused.stderr);
    assert!(said.contains("pencil cup: no approach leads the open hand to it"), "{said}");
}

#[test]
fn ctrl_c_shows_the_trials_so_far() {
    let (flow, name) = (flow(), unique_name());
    let arguments = arguments(&flow, &name, &["--trials", "1000000", "--attempts", "1", "--lift-policy", "always"]);
    let mut command = blindgrasp();
    let mut child = command.args(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
    let mut stderr = std::io::BufReader::new(child.stderr.take().expect("piped"));
    let mut said = String::new();
    // It comes when ten trials are done.
    while !said.contains("10 of 1000000 trials, every grasp lifted") {
        let n_bytes = std::io::BufRead::read_line(&mut stderr, &mut said).expect("a line");
        assert!(n_bytes > 0, "{said}");
    }
    assert!(!said.contains("ms apart"), "{said}");
    signal(i32::try_from(child.id()).expect("a pid"), Signal::INT);
    std::thread::spawn(move || std::io::copy(&mut stderr, &mut std::io::sink()));
    let output = child.wait_with_output().expect("ended");
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("Table II") && said.contains("The run was stopped before all was done"), "{said}");
    assert_nothing_left(&name);
}

#[test]
fn options_that_do_not_fit_are_refused_before_the_start() {
    let flow = flow();
    let folder = tempfile::tempdir().expect("a folder");
    let options = folder.path().join("options.yaml");
    std::fs::write(&options, "physics: {stand_friction: 1.5}").expect("written");
    for (more, expected) in [
        (["--options", options.to_str().expect("UTF-8")], "option physics.stand_friction is 1.5, expected a number"),
        (["--model", "nosuch.json"], "does not exist"),
        (["--objects", "paper/pan"], "expected paper, paper/pencil-cup"),
        (["--set", "source.seed=2"], "use --seed instead"),
        (["--record", "both.mcap"], "--lift-policy decision"),
    ] {
        fails(&["trials", "--dataflow", &flow, more[0], more[1]], expected);
    }
    let ordinary = project().join("dataflow.yaml");
    fails(&["trials", "--dataflow", ordinary.to_str().expect("UTF-8")], "no node reports the outcomes of lifts");
}
