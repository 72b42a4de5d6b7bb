//! Lift trials with advice, as a graph of real processes: a grasp that is not lifted is repeated as the advice says.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use blindgrasp_messages::{LiftOutcome, RegraspProposal, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_simulator::trial::advised_start::{Grasped, first_advised_start};
use blindgrasp_simulator::trial::targets::{target_of_trial, targets_named};
use blindgrasp_simulator::trial::{Attempt, Start, TrialOptions, draw_start, sensor_seed};
use blindgrasp_stages::hand::Hand;
use serde_json::Value;

use super::trials_graph::{Run, assert_killed_hand_goes_on, run_to_end};
use crate::common::{
    assert_nothing_left, example, project, run, shared_folder, stubborn_classifier, text, unique_name,
};

const THINGS: &str = "paper/pencil-cup,paper/candle-box";
const SEED: u64 = 5;
const ATTEMPTS: usize = 4;
/// The default of the hand: after so many advised attempts, the next one is random.
const ADVISED_ATTEMPTS: usize = 2;

/// One with a joint beyond its limit; one beside every thing; then a little to the side, another spread; then the other
/// way.
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

/// The project's trials with a classifier that calls everything stable and an arbiter that is never sure enough, so
/// that every grasp is to be done anew; `adviser` are the params of the one who gives advice, in JSON.
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
         encoder:\n    inputs: {{contacts: contacts/contacts}}\n    params: {{model: {model}}}\n  \
         adviser:\n    run: {}\n    inputs: {{feature: encoder/feature}}\n    params: {adviser}\n  \
         classifier:\n    run: {}\n    inputs: {{feature: encoder/feature}}\n    params: {{knows_all: true}}\n  \
         lift_arbiter:\n    inputs: {{prediction: classifier/prediction}}\n    \
         params: {{regrasp: true, min_probability_stable: 1, max_age_ms: 600000}}\n",
        example("fixed_adviser").display(),
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

/// An undisturbed run with advice, made once, and its files.
struct Advised {
    flow: PathBuf,
    recording: PathBuf,
    run: Run,
}

fn advised() -> &'static Advised {
    static MADE: OnceLock<Advised> = OnceLock::new();
    MADE.get_or_init(|| {
        let folder = shared_folder("advised_trials");
        let (flow, recording) = (advising(&folder), folder.join("regrasp.mcap"));
        let run = run_to_end(&flow, &["--record", recording.to_str().expect("UTF-8")]);
        Advised { flow, recording, run }
    })
}

fn is_advised(outcome: &Value) -> bool {
    outcome["advised"] == true
}

#[test]
fn an_attempt_that_follows_advice_begins_where_the_proposal_says() {
    let Advised { recording, run, .. } = advised();
    let Run { decisions, outcomes: said, summary } = run;
    assert_eq!(said.len(), 2 * ATTEMPTS, "{said:?}");
    let n_regrasp = decisions.iter().filter(|line| line["action"] == "regrasp").count();
    assert!(n_regrasp > said.len() / 2, "{decisions:?}");
    assert_eq!((&summary["lift"], &summary["regrasp"]), (&0.into(), &n_regrasp.into()), "{summary}");
    assert_eq!(summary["hold"], said.len(), "what is grasped anew is not lifted: {summary}");
    assert!(said.iter().filter(|outcome| is_advised(outcome)).count() >= 2, "{said:?}");

    let mut frames: Vec<TactileFrame> = Vec::new();
    let mut outcomes: Vec<LiftOutcome> = Vec::new();
    for record in RecordingReader::open(recording).expect("opened") {
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
    // The same attempts again, without any process.
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("a hand");
    let (things, options) = (targets_named(THINGS).expect("things"), TrialOptions::default());
    let mut grasped: Vec<Grasped> = Vec::new();
    let mut next: Option<Start> = None;
    for outcome in &outcomes {
        let LiftOutcome { grasp_id, trial, attempt: number, .. } = *outcome;
        let thing = target_of_trial(&things, trial).expect("a thing");
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
            let target_from_palm = attempt.palm_from_target().inverse();
            grasped.push(Grasped { target_from_palm, open_joints_rad: start.open_joints_rad });
            next = first_advised_start(&hand, thing, &options, &grasped, &proposals(), start.yaw_rad).expect("a hand");
        }
    }
    // At most two advised attempts follow each other.
    let row = |outcomes: &[Value]| outcomes.iter().all(is_advised);
    assert!(!said.windows(ADVISED_ATTEMPTS + 1).any(row) && said.windows(ADVISED_ATTEMPTS).any(row), "{said:?}");
}

#[test]
fn a_hand_that_is_killed_amid_advice_repeats_nothing() {
    let Advised { flow, run, .. } = advised();
    assert!(run.outcomes.iter().any(is_advised), "{:?}", run.outcomes);
    // After an outcome that began at random, and amid those that followed advice.
    assert_killed_hand_goes_on(flow, &run.outcomes, (3, 3), &["lift_arbiter"]);
}

#[test]
fn without_proposals_or_advice_the_hand_goes_on_at_random() {
    let folder = tempfile::tempdir().expect("a folder");
    let empty = run_to_end(&flow(folder.path(), &serde_json::json!({})), &[]).outcomes;
    assert!(empty.len() == 2 * ATTEMPTS && !empty.iter().any(is_advised), "{empty:?}");
    let none_followed = ["--set", "simulated_hand.advised_attempts=0"];
    assert_eq!(run_to_end(&advised().flow, &none_followed).outcomes, empty);
    // It waits for advice that does not come, and counts that.
    let silent = flow(folder.path(), &serde_json::json!({"is_silent": true}));
    let few = ["simulated_hand.trials=1", "simulated_hand.decision_timeout_s=1"];
    let Run { outcomes: found, summary, .. } = run_to_end(&silent, &["--set", few[0], "--set", few[1]]);
    assert_eq!(found, empty[..ATTEMPTS]);
    let counts = &summary["counts"]["simulated_hand"];
    let n_waits: u64 = ["unadvised", "undecided"].iter().filter_map(|what| counts[what].as_u64()).sum();
    assert!((1..=ATTEMPTS as u64).contains(&n_waits), "{summary}");
}

#[test]
fn trials_with_advice_are_compared_with_random_ones() {
    let flow = &advised().flow;
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
    let report = made(&["--lift-policy", "decision", "--regrasp", "both", "--json"]);
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
    let off = made(&["--lift-policy", "decision", "--regrasp", "off", "--json"]);
    let off: Value = serde_json::from_str(&off).expect("JSON");
    assert_eq!(off["records_with_gate"], report["records_with_gate_at_random"]);
    // By default the dataflow file decides.
    let table = made(&["--lift-policy", "decision"]);
    assert!(table.contains("advised") && !table.contains("at random"), "{table}");

    let ordinary = project().join("dataflow.yaml");
    let refused = |arguments: &[&str], expected: &str| {
        let output = run(&[&["trials"], arguments].concat(), 1);
        assert!(text(&output.stderr).contains(expected), "{}", text(&output.stderr));
    };
    refused(
        &["--regrasp", "both", "--record", "both.mcap", "--lift-policy", "decision"],
        "--regrasp on or --regrasp off",
    );
    refused(
        &["--dataflow", ordinary.to_str().expect("UTF-8"), "--regrasp", "on"],
        "no node reports the outcomes of lifts",
    );
}
