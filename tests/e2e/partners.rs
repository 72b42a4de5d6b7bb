//! A stage with two inputs: frames of a hand and senses of a wrist, joined by their stamps.

use std::path::{Path, PathBuf};

use crate::common::{
    A_FEW_GRASPS, FAST_FOREVER, Graph, HAND, RECORDING, dataflow, json_lines, run, signal, swap, unique_name,
    wait_until,
};
use rustix::process::Signal;

/// Arguments of `run` that play the wrist's recording as [`FAST_FOREVER`] plays the hand's.
const WRIST: [&str; 4] = ["--set", "wrist.rate=16", "--set", "wrist.repeat=forever"];
const COUNT: &str = "senses_without_partner";

/// The default graph with a second source and the operator that joins the two, with these options of its second input.
fn joined(folder: &Path, options: &str) -> PathBuf {
    let nodes = format!(
        "operators:\n  wrist:\n    run: recorded_source\n    params: {{recording: {RECORDING}}}\n  senses:\n    inputs:\n      \
         tactile: recorded_source/tactile\n      senses: {{from: wrist/tactile, {options}}}\n    params: {{hand: {HAND}}}\n"
    );
    dataflow(folder, &[("operators:\n", &nodes), ("{tactile: recorded_source/tactile}", "{tactile: senses/tactile}")])
}

fn started(flow: &Path, arguments: &[&str]) -> Graph {
    Graph::start(flow, &[&FAST_FOREVER[..], arguments].concat())
}

#[test]
fn kills_and_swaps_lose_neither_samples_nor_partners() {
    let folder = tempfile::tempdir().expect("a folder");
    // Long enough for a restart on a busy machine.
    let flow = joined(folder.path(), "tolerance_ms: 0, partner_wait_ms: 60000");
    let graph = started(&flow, &WRIST);
    for nodes in [["senses"].as_slice(), &["wrist"], &["recorded_source"], &["senses", "contacts"]] {
        let before = graph.node("senses")["n_restarts"].as_u64().expect("a count");
        let pids: Vec<i32> = nodes.iter().map(|node| graph.pid_of(node)).collect();
        pids.iter().for_each(|pid| signal(*pid, Signal::KILL));
        if nodes.contains(&"senses") {
            graph.wait_for_restart("senses", before + 1);
        }
        graph.wait_for_decisions(A_FEW_GRASPS);
        assert!(graph.node("senses")["counts"][COUNT].is_null(), "{nodes:?}: {}", graph.node("senses"));
    }
    for nodes in [["senses"].as_slice(), &["wrist", "senses"]] {
        swap(&graph, &[nodes, &["--probation", "0.1"]].concat(), 0);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    assert!(graph.node("senses")["counts"][COUNT].is_null(), "{}", graph.node("senses"));
    graph.stop().assert_undisturbed("frames with partners");
}

/// The wrist is far slower than the hand.
#[test]
fn frames_whose_partner_does_not_come_in_time_are_answered_without_it_and_counted() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = joined(folder.path(), "tolerance_ms: 0, partner_wait_ms: 0");
    let graph = started(&flow, &["--set", "wrist.rate=1", "--set", "wrist.repeat=forever"]);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let n_without = || graph.node("senses")["counts"][COUNT].as_u64();
    wait_until(|| n_without() > Some(100), || graph.node("senses").to_string());
    graph.stop().assert_undisturbed("frames without partners");
}

/// The wrist ends first, and the hand goes on without it.
#[test]
fn the_graph_ends_although_one_input_has_ended_long_before_the_other() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = joined(folder.path(), "partner_wait_ms: 5");
    let flow = flow.to_str().expect("UTF-8");
    for (wrist, hand) in [("max", "20"), ("20", "max")] {
        let (wrist, hand) = (format!("wrist.rate={wrist}"), format!("recorded_source.rate={hand}"));
        let output = run(&["run", "--json", "--name", &unique_name(), "--set", &wrist, "--set", &hand, flow], 0);
        let lines = json_lines(&output.stdout);
        let summary = &lines.last().expect("a summary")["summary"];
        assert_eq!((&summary["samples_lost"], &summary["undecided"]), (&0.into(), &0.into()), "{summary}");
    }
}
