//! Lift trials with advice, as a graph of real processes: what is not lifted is grasped anew as the advice says.

mod common;

use std::path::{Path, PathBuf};

use blindgrasp_messages::{LiftOutcome, RegraspProposal, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_simulator::trial::advised::{Grasped, first_advised_start};
use blindgrasp_simulator::trial::things::{thing_of_trial, things_named};
use blindgrasp_simulator::trial::{Attempt, Start, TrialOptions, draw_start, sensor_seed};
use blindgrasp_stages::hand::Hand;
use common::{
    Graph, assert_nothing_left, json_lines, operator, project, run, signal, stubborn_classifier, text, unique_name,
};
use rustix::process::Signal;
use serde_json::Value;

const THINGS: &str = "paper/pencil-cup,paper/candle-box";
const SEED: u64 = 5;
const ATTEMPTS: usize = 4;
/// The hand's default: after so many, one comes from anywhere.
const ADVISED_ATTEMPTS: usize = 2;
const N_KILLS: u64 = 3;

/// One with a joint beyond its limit; one beside every thing; then a little to the side, another spread; then the other way.
fn proposals() -> Vec<RegraspProposal> {
    let proposal = |position_m: [f64; 3], spread_rad: f64| {
        let mut open_joints_rad = vec![0.0; 7];
        open_joints_rad[0] = spread_rad;
        RegraspProposal {
            palm_position_m: position_m,
            palm_rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            open_joints_rad,
            probability_held: 0.9,
        }
    };
    vec![
        proposal([0.0; 3], 9.0),
        proposal([0.5, 0.0, 0.0], 0.2),
        proposal([0.012, 0.004, 0.0], 0.7),
        proposal([-0.012, 0.0, 0.0], 0.9),
    ]
}

/// The project's trials with a classifier that calls everything stable and an arbiter that is never sure enough, so that
/// every grasp is to be done anew; `adviser` are the params of the one who gives advice, in JSON.
fn flow(folder: &Path, adviser: &Value) -> PathBuf {
    let [hand, model] = ["hands/barrett-bh8-280.yaml", "models/barrett-bh8-280.json"].map(|path| project().join(path));
    let (hand, model) = (hand.display(), model.display());
    let flow = format!(
        "version: 1\nname: regrasp_trials\noperators:\n  \
         simulated_hand:\n    restart: {{policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}}\n    \
         inputs: {{decision: lift_arbiter/decision, advice: adviser/advice}}\n    \
         params: {{hand: {hand}, things: '{THINGS}', trials: 2, attempts: {ATTEMPTS}, seed: {SEED}, \
         decision_timeout_s: 600, advised_attempts: {ADVISED_ATTEMPTS}}}\n  \
         contacts:\n    inputs: {{tactile: simulated_hand/tactile}}\n    params: {{hand: {hand}}}\n  \
         histogram:\n    inputs: {{contacts: contacts/contacts}}\n    params: {{model: {model}}}\n  \
         adviser:\n    run: {}\n    inputs: {{histogram: histogram/histogram}}\n    params: {adviser}\n  \
         classifier:\n    run: {}\n    inputs: {{histogram: histogram/histogram}}\n    params: {{knows_all: true}}\n  \
         lift_arbiter:\n    inputs: {{prediction: classifier/prediction}}\n    \
         params: {{regrasp: true, min_probability_stable: 1, max_age_ms: 600000}}\n",
        operator("examples/fixed_adviser").display(),
        stubborn_classifier().display(),
    );
    let path = folder.join("regrasp.yaml");
    std::fs::write(&path, flow).expect("written");
    path
}

fn advising(folder: &Path) -> PathBuf {
    let proposals = serde_json::to_string(&proposals()).expect("JSON");
    flow(folder, &serde_json::json!({ "proposals": proposals }))
}

fn outcomes(lines: &[Value]) -> Vec<Value> {
    lines.iter().filter_map(|line| line.get("outcome")).cloned().collect()
}

/// Decisions and outcomes of a run to its end, and its summary.
fn run_to_end(flow: &Path, arguments: &[&str]) -> (Vec<Value>, Vec<Value>, Value) {
    let name = unique_name();
    let flow = flow.to_str().expect("UTF-8");
    let output = run(&[&["run", flow, "--json", "--name", &name], arguments].concat(), 0);
    assert_nothing_left(&name);
    let mut lines = json_lines(&output.stdout);
    let summary = lines.pop().expect("a summary")["summary"].take();
    assert_eq!(summary["samples_lost"], 0, "{summary}");
    let outcomes = outcomes(&lines);
    lines.retain(|line| line.get("action").is_some());
    (lines, outcomes, summary)
}

fn is_advised(outcome: &Value) -> bool {
    outcome["advised"] == true
}

#[test]
fn an_attempt_that_follows_advice_begins_where_the_proposal_says() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("regrasp.mcap");
    let (decisions, said, summary) =
        run_to_end(&advising(folder.path()), &["--record", recording.to_str().expect("UTF-8")]);
    assert_eq!(said.len(), 2 * ATTEMPTS, "{said:?}");
    let n_regrasp = decisions.iter().filter(|line| line["action"] == "regrasp").count();
    assert!(n_regrasp > said.len() / 2, "{decisions:?}");
    assert_eq!((&summary["lift"], &summary["regrasp"]), (&0.into(), &n_regrasp.into()), "{summary}");
    assert_eq!(summary["hold"], said.len(), "what is grasped anew is not lifted: {summary}");
    assert!(said.iter().filter(|outcome| is_advised(outcome)).count() >= 2, "{said:?}");

    let mut frames: Vec<TactileFrame> = Vec::new();
    let mut outcomes: Vec<LiftOutcome> = Vec::new();
    for record in RecordingReader::open(&recording).expect("opened") {
        match record.expect("read").1 {
            Record::Tactile(sample) => frames.push(sample.message),
            Record::Outcome(sample) => outcomes.push(sample.message),
            _ => {}
        }
    }
    assert_eq!(
        outcomes.iter().map(|outcome| outcome.advised).collect::<Vec<_>>(),
        said.iter().map(is_advised).collect::<Vec<_>>()
    );
    // The same again, attempt for attempt, without any process.
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
    let (things, options) = (things_named(THINGS).expect("things"), TrialOptions::default());
    let mut grasped: Vec<Grasped> = Vec::new();
    let mut next: Option<Start> = None;
    for outcome in &outcomes {
        let LiftOutcome { grasp_id, trial, attempt: number, .. } = *outcome;
        let thing = thing_of_trial(&things, trial).expect("a thing");
        assert_eq!(outcome.advised, next.is_some(), "grasp {grasp_id}");
        if next.is_none() {
            grasped.clear();
        }
        let start =
            next.take().unwrap_or_else(|| draw_start(&hand, thing, &options, SEED, trial, number).expect("a start"));
        let seed = sensor_seed(SEED, trial, number);
        let mut attempt = Attempt::begin(&hand, thing, &options, &start, seed).expect("begun");
        let expected: Vec<TactileFrame> =
            std::iter::from_fn(|| attempt.next_frame(grasp_id)).map(|timed| timed.frame).collect();
        let mut found: Vec<&TactileFrame> = frames.iter().filter(|frame| frame.grasp_id == grasp_id).collect();
        found.pop().expect("the end");
        assert_eq!(found, expected.iter().collect::<Vec<_>>(), "grasp {grasp_id}");
        if outcome.advised {
            let spread_rad = found[0].joints_rad[0];
            assert!((spread_rad - 0.7).abs() < 0.01 || (spread_rad - 0.9).abs() < 0.01, "{spread_rad}");
        }
        let is_anew = decisions.iter().any(|line| line["grasp_id"] == grasp_id && line["action"] == "regrasp");
        if is_anew && number as usize + 1 < ATTEMPTS && grasped.len() < ADVISED_ATTEMPTS {
            let thing_from_palm = attempt.palm_from_thing().inverse();
            grasped.push(Grasped { thing_from_palm, open_joints_rad: start.open_joints_rad });
            next = first_advised_start(&hand, thing, &options, &grasped, &proposals(), start.yaw_rad).expect("a hand");
        }
    }
    // Two in a row at most.
    let row = |outcomes: &[Value]| outcomes.iter().all(is_advised);
    assert!(!said.windows(ADVISED_ATTEMPTS + 1).any(row) && said.windows(ADVISED_ATTEMPTS).any(row), "{said:?}");
}

#[test]
fn a_hand_that_is_killed_amid_advice_repeats_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = advising(folder.path());
    let (_, expected, _) = run_to_end(&flow, &[]);
    assert!(expected.iter().any(is_advised), "{expected:?}");
    let graph = Graph::launch(&unique_name(), &flow, &["--set", "simulated_hand.trials=1000000"]);
    let wait_for = |n: usize| {
        common::wait_until(|| outcomes(&graph.lines()).len() >= n, || format!("{n} outcomes: {}", graph.said()));
    };
    for n_restarts in 1..=N_KILLS {
        // After one that began at random, and amid those that followed advice.
        wait_for(n_restarts as usize * 3);
        signal(graph.pid_of("simulated_hand"), Signal::KILL);
        graph.wait_for_restart("simulated_hand", n_restarts);
    }
    wait_for(expected.len());
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}\n{}", ended.summary, ended.stderr);
    assert_eq!(ended.summary["restarts"], N_KILLS, "{}", ended.stderr);
    let found = outcomes(&ended.decisions);
    assert_eq!(found[..expected.len()], expected, "{}", ended.stderr);
    let grasps: Vec<u64> = found.iter().filter_map(|it| it["grasp_id"].as_u64()).collect();
    assert_eq!(grasps, (0..found.len() as u64).collect::<Vec<_>>(), "{}", ended.stderr);
}

#[test]
fn without_proposals_or_advice_the_hand_goes_on_at_random() {
    let folder = tempfile::tempdir().expect("a folder");
    let (_, empty, _) = run_to_end(&flow(folder.path(), &serde_json::json!({})), &[]);
    assert!(empty.len() == 2 * ATTEMPTS && !empty.iter().any(is_advised), "{empty:?}");
    let none_followed = ["--set", "simulated_hand.advised_attempts=0"];
    assert_eq!(run_to_end(&advising(folder.path()), &none_followed).1, empty);
    // It waits for advice that doesn't come, and says so.
    let silent = flow(folder.path(), &serde_json::json!({"is_silent": true}));
    let few = ["simulated_hand.trials=1", "simulated_hand.decision_timeout_s=1"];
    let (_, found, summary) = run_to_end(&silent, &["--set", few[0], "--set", few[1]]);
    assert_eq!(found, empty[..ATTEMPTS]);
    let counts = &summary["counts"]["simulated_hand"];
    let n_waits: u64 = ["unadvised", "undecided"].iter().filter_map(|what| counts[what].as_u64()).sum();
    assert!((1..=ATTEMPTS as u64).contains(&n_waits), "{summary}");
}

#[test]
fn trials_with_advice_are_held_against_the_same_at_random() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = advising(folder.path());
    let arguments = |name: &str, more: &[&str]| -> Vec<String> {
        let flow = flow.to_str().expect("UTF-8");
        let common = ["trials", "--dataflow", flow, "--name", name, "--objects", THINGS, "--trials", "3"];
        common.iter().chain(&["--attempts", "3", "--seed", "5"]).chain(more).map(|it| (*it).into()).collect()
    };
    let made = |more: &[&str]| {
        let name = unique_name();
        let arguments = arguments(&name, more);
        let output = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), 0);
        assert_nothing_left(&name);
        text(&output.stdout)
    };
    let report = made(&["--gate", "on", "--regrasp", "both", "--json"]);
    let report: Value = serde_json::from_str(&report).expect("JSON");
    let advised_of = |records: &str| {
        report[records].as_array().expect("records").iter().filter(|record| record["advised"] == true).count()
    };
    let n_advised = advised_of("records_with_gate");
    assert!(n_advised > 0, "{report}");
    assert_eq!(advised_of("records_with_gate_at_random"), 0);
    assert_eq!(report["with_gate"]["total"]["n_advised"], n_advised);
    let effect = &report["regrasp_effect"];
    assert_eq!((&effect["n_trials"], &effect["next_advised"]["n"]), (&3.into(), &n_advised.into()), "{effect}");
    assert_eq!(effect["second_advised"]["n"], effect["second_at_random"]["n"]);
    let off = made(&["--gate", "on", "--regrasp", "off", "--json"]);
    let off: Value = serde_json::from_str(&off).expect("JSON");
    assert_eq!(off["records_with_gate"], report["records_with_gate_at_random"]);
    // By default as the file says.
    let table = made(&["--gate", "on"]);
    assert!(table.contains("advised") && !table.contains("at random"), "{table}");

    let ordinary = project().join("dataflow.yaml");
    let refused = |arguments: &[&str], expected: &str| {
        let output = run(&[&["trials"], arguments].concat(), 1);
        assert!(text(&output.stderr).contains(expected), "{}", text(&output.stderr));
    };
    refused(&["--regrasp", "both", "--record", "both.mcap", "--gate", "on"], "--regrasp on or --regrasp off");
    refused(&["--dataflow", ordinary.to_str().expect("UTF-8"), "--regrasp", "on"], "no node says what became of lifts");
}
