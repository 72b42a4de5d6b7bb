//! Lift trials as a graph of real processes: the decision comes back to the hand.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::common::{
    Graph, assert_nothing_left, blindgrasp, json_lines, json_of, project, run, shared_folder, signal,
    stubborn_classifier, text, unique_name,
};
use rustix::process::Signal;
use serde_json::Value;

/// The project's trials on two light objects, with a slow classifier that calls every felt grasp stable.
fn flow(folder: &Path) -> PathBuf {
    let classifier = "    inputs: {feature: encoder/feature}\n";
    let stubborn = format!(
        "    run: {}\n{classifier}    params: {{pause_ms: 5, knows_all: true}}\n",
        stubborn_classifier().display()
    );
    let probe = "${PROBE:-test_lift}";
    trial_flow(folder, "trials: 6, attempts: 2", &[(probe, "none"), (classifier, &stubborn)])
}

/// The project's live graph with a simulated hand, whose nodes may be killed often, and in which no grasp is stale, even on a
/// busy machine.
fn trial_flow(folder: &Path, trials: &str, replace: &[(&str, &str)]) -> PathBuf {
    const RESTART: &str = "    restart: {policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}\n";
    let mut text = std::fs::read_to_string(project().join("dataflow-live.yaml")).expect("dataflow-live.yaml");
    let run = "    run: ${SOURCE:-tactile_source}\n";
    let hand = format!(
        "    run: simulated_hand\n    params: {{things: 'paper/pencil-cup,paper/candle-box', decision_timeout_s: 600, {trials}}}\n"
    );
    let fixed = [(run, hand.as_str()), ("${MAX_AGE_MS:-200}", "600000")];
    for (what, by) in fixed.iter().chain(replace) {
        assert!(text.contains(what), "dataflow-live.yaml has no '{what}'");
        text = text.replace(what, by);
    }
    text = text.replace("${MODEL:-", "").replace(".json}", ".json");
    for node in ["  source:\n", "  classifier:\n", "  lift_arbiter:\n"] {
        assert!(text.contains(node), "dataflow-live.yaml has no '{node}'");
        text = text.replace(node, &format!("{node}{RESTART}"));
    }
    for shared in ["models", "hands"] {
        text = text.replace(&format!(" {shared}/"), &format!(" {}/{shared}/", project().display()));
    }
    let path = folder.join("trials.yaml");
    std::fs::write(&path, text).expect("written");
    path
}

fn outcomes(lines: &[Value]) -> Vec<Value> {
    lines.iter().filter_map(|line| line.get("outcome")).cloned().collect()
}

/// What a run to its end printed.
pub(super) struct Run {
    pub(super) decisions: Vec<Value>,
    pub(super) outcomes: Vec<Value>,
    pub(super) summary: Value,
}

pub(super) fn run_to_end(flow: &Path, arguments: &[&str]) -> Run {
    let name = unique_name();
    let flow = flow.to_str().expect("UTF-8");
    let output = run(&[&["run", flow, "--json", "--name", &name], arguments].concat(), 0);
    assert_nothing_left(&name);
    let mut lines = json_lines(&output.stdout);
    let summary = lines.pop().expect("a summary")["summary"].take();
    assert_eq!(summary["samples_lost"], 0, "{summary}");
    let outcomes = outcomes(&lines);
    lines.retain(|line| line.get("action").is_some());
    Run { decisions: lines, outcomes, summary }
}

/// Kills the simulated hand and other nodes so often, each time after that many more outcomes. Asserts that the outcomes are as
/// expected all the same, and that each grasp has its number once.
pub(super) fn assert_killed_hand_goes_on(
    flow: &Path,
    expected: &[Value],
    (n_kills, n_between_kills): (u64, usize),
    others: &[&str],
) {
    // However fast the hand is, it goes on until all kills are done.
    let graph = Graph::launch(&unique_name(), flow, &["--set", "source.trials=1000000"]);
    let wait_for = |n: usize| {
        crate::common::wait_until(|| outcomes(&graph.lines()).len() >= n, || format!("{n} outcomes: {}", graph.said()));
    };
    for n in 1..=n_kills {
        wait_for(n as usize * n_between_kills);
        // The others die as well, before the hand has carried out its last decision or after that.
        signal(graph.pid_of("source"), Signal::STOP);
        others.iter().for_each(|node| graph.kill(node));
        graph.kill("source");
    }
    wait_for(expected.len());
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}\n{}", ended.summary, ended.stderr);
    assert_eq!(ended.summary["restarts"], (1 + others.len() as u64) * n_kills, "{}", ended.stderr);
    let found = outcomes(&ended.decisions);
    assert_eq!(found[..expected.len()], *expected, "{}", ended.stderr);
    // Outcomes after those are numbered as well.
    let grasps: Vec<u64> = found.iter().filter_map(|it| it["grasp_id"].as_u64()).collect();
    assert_eq!(grasps, (0..found.len() as u64).collect::<Vec<_>>(), "{}", ended.stderr);
}

/// An undisturbed run, made once, and its files.
struct Made {
    flow: PathBuf,
    recording: String,
    run: Run,
}

fn made() -> &'static Made {
    static MADE: OnceLock<Made> = OnceLock::new();
    MADE.get_or_init(|| {
        let folder = shared_folder("trials");
        let recording = folder.join("trials.mcap").to_str().expect("UTF-8").to_owned();
        let flow = flow(&folder);
        let run = run_to_end(&flow, &["--record", &recording]);
        Made { flow, recording, run }
    })
}

#[test]
fn decisions_are_carried_out_and_the_same_seed_gives_the_same_outcomes() {
    let Made { flow, run, .. } = made();
    let Run { outcomes: first, summary, .. } = run;
    let trials: std::collections::BTreeSet<u64> = first.iter().filter_map(|it| it["trial"].as_u64()).collect();
    assert_eq!(trials, (0..6).collect(), "{first:?}");
    let grasps: Vec<u64> = first.iter().filter_map(|it| it["grasp_id"].as_u64()).collect();
    assert_eq!(grasps, (0..first.len() as u64).collect::<Vec<_>>());
    assert_eq!(summary["grasps"], first.len(), "{summary}");
    let n_lifted = first.iter().filter(|it| it["lifted"] == true).count();
    assert!(n_lifted > 0, "{first:?}");
    assert_eq!(summary["lift"], n_lifted, "{summary}");
    assert_eq!(summary["with_truth"], n_lifted, "{summary}");
    // The arbiter hears of each lift from the hand's own frames.
    let n_kept = first.iter().filter(|it| it["held"] == true).count();
    let counts = &summary["counts"]["lift_arbiter"];
    for (name, n) in [("kept", n_kept), ("dropped", n_lifted - n_kept)] {
        assert_eq!(
            (&counts[format!("lifts/{name}")], &counts[format!("promise/{name}")]),
            (&n.into(), &n.into()),
            "{counts}"
        );
    }
    assert_eq!((&counts["lifts/unreported"], &counts["promise_withdrawn"]), (&0.into(), &0.into()), "{counts}");
    for outcome in first {
        assert!(outcome["lifted"] == true || outcome["held"] == false, "{outcome}");
        let thing =
            if outcome["trial"].as_u64().is_some_and(|trial| trial % 2 == 0) { "pencil cup" } else { "candle box" };
        assert_eq!(outcome["thing"], thing, "{outcome}");
    }
    assert_eq!(run_to_end(flow, &[]).outcomes, *first);
    let other = run_to_end(flow, &["--set", "source.seed=1"]);
    assert_ne!(other.outcomes, *first);
}

#[test]
fn without_the_gate_every_grasp_is_lifted() {
    // Nothing is ever voted stable.
    let arguments = [
        "--set",
        "source.gate=off",
        "--set",
        "lift_arbiter.min_probability_stable=1",
        "--set",
        "lift_arbiter.votes=1000",
    ];
    let folder = tempfile::tempdir().expect("a folder");
    let Run { outcomes, summary, .. } = run_to_end(&flow(folder.path()), &arguments);
    assert_eq!((outcomes.len(), summary["lift"].as_u64()), (6, Some(0)), "{summary}");
    assert!(outcomes.iter().all(|outcome| outcome["lifted"] == true && outcome["attempt"] == 0), "{outcomes:?}");
    // A grasp without agreement is decided when the hand says that it has ended, and not by a wait.
    let reasons = summary["reasons"].as_object().expect("reasons");
    assert!(reasons.contains_key("no_agreement") && !reasons.contains_key("stale"), "{summary}");
}

/// With the project's probes, and while it lifts and asks.
#[test]
fn a_hand_that_is_killed_with_its_classifier_and_arbiter_goes_on_where_it_was() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = trial_flow(folder.path(), "trials: 4, watch: 'on'", &[]);
    let Run { outcomes, summary, decisions } = run_to_end(&flow, &[]);
    let of = |action: &str| decisions.iter().filter(|line| line["action"] == action).collect::<Vec<_>>();
    let (lifts, asked, n_answers) = (of("lift"), of("test_lift"), of("go_on").len());
    let n_probed = outcomes.iter().filter(|outcome| outcome["probed"] == true).count();
    // A tight hand waits for the answer once more before its test lift.
    let grasps: BTreeSet<u64> = asked.iter().filter_map(|line| line["grasp_id"].as_u64()).collect();
    let n_asked = asked.len();
    assert!(n_probed > 0 && n_probed == grasps.len() && n_asked > n_probed, "{n_probed}, {n_asked}: {summary}");
    assert!(n_asked <= 2 * n_probed && summary["probes"] == n_asked, "{n_asked}: {summary}");
    // A lift follows a probe, and each grasp is decided once beside it.
    assert!(outcomes.iter().all(|outcome| outcome["probed"] == true || outcome["lifted"] == false), "{outcomes:?}");
    assert_eq!(lifts.len() + of("hold").len(), outcomes.len(), "{decisions:?}");
    assert_eq!(summary["lift"], lifts.len(), "{summary}");
    // A lift takes 4 s, in which the hand asks five times a second; a thing that is lost at once ends it.
    assert!(!lifts.is_empty() && n_answers >= 10, "{n_answers} answers, {} lifts: {summary}", lifts.len());
    assert_killed_hand_goes_on(&flow, &outcomes, (3, 1), &["lift_arbiter", "classifier"]);
}

#[test]
fn a_graph_that_is_stopped_amid_a_trial_ends_cleanly() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::launch(&unique_name(), &flow(folder.path()), &["--set", "source.trials=100000"]);
    graph.wait_for_decisions(2);
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &Value::from(0)), "{}", ended.stderr);
}

#[test]
fn recorded_trials_are_replayed_with_the_same_decisions() {
    let Made { flow, recording, .. } = made();
    // Every edge, bit for bit.
    let output = run(&["test", recording, "--dataflow", flow.to_str().expect("UTF-8")], 0);
    assert!(text(&output.stdout).contains("/decision"), "{}", text(&output.stdout));
    let shown = blindgrasp().args(["info", recording]).output().expect("started");
    assert!(text(&shown.stdout).contains("/outcome"), "{}", text(&shown.stdout));
    // The label's meaning is in the recording and in a recording of its replay.
    let folder = tempfile::tempdir().expect("a folder");
    let again = folder.path().join("again.mcap");
    let again = again.to_str().expect("UTF-8");
    let (name, play) = (unique_name(), format!("recorded_source.recording={recording}"));
    let ordinary = project().join("dataflow.yaml");
    let ordinary = ordinary.to_str().expect("UTF-8");
    run(&["run", ordinary, "--name", &name, "--set", &play, "--record", again], 0);
    for recording in [recording, again] {
        let info = json_of(&["info", recording, "--json"]);
        assert_eq!(info["labels"], serde_json::json!(["lift"]), "{recording}");
    }
}
