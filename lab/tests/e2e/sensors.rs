//! Sick sensors: learned from healthy grasps, found in recordings and in a running graph.

use serde_json::Value;

use crate::common::{FAST_FOREVER, Graph, dataflow, dataflow_with, fails, json_lines, run, swap, text, unique_name};

const CHECK: &str = "models/barrett-bh8-280.sensors.json";

fn faults(check: &str, recording: &str, exit_code: i32) -> Vec<Value> {
    let found = run(&["sensors", "check", check, recording, "--json"], exit_code);
    let found: Value = serde_json::from_slice(&found.stdout).expect("JSON");
    found["faults"].as_array().expect("a list").clone()
}

/// The default graph on a recording, with watched sensors.
fn watched(folder: &std::path::Path, recording: &str) -> std::path::PathBuf {
    let contacts = "    inputs: {tactile: recorded_source/tactile}\n";
    let checked = format!("    params: {{sensors: {CHECK}}}\n{contacts}");
    let source = ("recordings/held-out.mcap".to_string(), recording.to_string());
    dataflow_with(folder, &[(contacts.into(), checked), source])
}

#[test]
fn a_dead_pad_is_named_and_healthy_grasps_are_not_suspected() {
    assert_eq!(faults(CHECK, "recordings/ordinary.mcap", 0), Vec::<Value>::new());
    assert_eq!(faults(CHECK, "recordings/held-out.mcap", 0), Vec::<Value>::new());
    let dead = faults(CHECK, "recordings/dead-pad.mcap", 1);
    let expected: Vec<Value> = (0..12)
        .map(|grasp_id| serde_json::json!({"grasp_id": grasp_id, "fault": "frozen_pad", "part": "finger_2"}))
        .collect();
    assert_eq!(dead, expected);
    // Lost frames, frames out of order and fingers that touch each other are no fault of a sensor.
    for recording in ["drop-outs", "out-of-order", "self-collision", "slip-prone"] {
        assert_eq!(faults(CHECK, &format!("recordings/{recording}.mcap"), 0), Vec::<Value>::new(), "{recording}");
    }
    let said = run(&["sensors", "check", CHECK, "recordings/dead-pad.mcap"], 1);
    assert!(
        text(&said.stdout).contains("from grasp 0 on: pad finger_2 repeats its readings"),
        "{}",
        text(&said.stdout)
    );
    fails(&["sensors", "check", CHECK, "recordings/other-hand.mcap"], "it is for the hand 'barrett-bh8-280'");
    fails(
        &["sensors", "check", "models/barrett-bh8-280.json", "recordings/ordinary.mcap"],
        "expected a file of blindgrasp sensors learn",
    );
}

#[test]
fn a_check_is_learned_from_healthy_grasps_without_labels() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let simulate = |n: &str, seed: &str, out: &str| {
        run(&["simulate", "--objects", "train", "--grasps", n, "--seed", seed, "--out", out], 0);
    };
    let (healthy, check) = (at("healthy.mcap"), at("check.json"));
    simulate("200", "31", &healthy);
    run(&["sensors", "learn", &healthy, "--out", &check], 0);
    assert_eq!(faults(&check, "recordings/dead-pad.mcap", 1).len(), 12);
    assert_eq!(faults(&check, "recordings/ordinary.mcap", 0), Vec::<Value>::new());

    let few = at("few.mcap");
    simulate("20", "32", &few);
    fails(&["sensors", "learn", &few, "--out", &at("never.json")], "expected at least 200");
    assert!(!std::path::Path::new(&at("never.json")).exists());
}

#[test]
fn a_graph_holds_while_a_pad_is_dead_and_says_which() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = watched(folder.path(), "recordings/dead-pad.mcap");
    let flow = flow.to_str().expect("UTF-8");
    let ended = run(&["run", "--json", "--name", &unique_name(), flow], 0);
    let lines = json_lines(&ended.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    assert_eq!(summary["reasons"], serde_json::json!({"sensor_fault": 12}), "{summary}");

    let graph = Graph::start(flow.as_ref(), &FAST_FOREVER);
    graph.wait_for_decisions(30);
    let logs = run(&["logs", "contacts", "--graph", &graph.name], 0);
    assert!(text(&logs.stdout).contains("pad finger_2 repeats its readings"), "{}", text(&logs.stdout));
    assert!(
        graph.node("contacts").to_string().contains("sensor_fault/frozen_pad/finger_2"),
        "{}",
        graph.node("contacts")
    );
    // What it knows outlives its process.
    graph.kill("contacts");
    swap(&graph, &["contacts", "--probation", "0"], 0);
    graph.wait_for_decisions(30);
    // Without the sensor check, and so without a state, while its neighbours go on; and with it again.
    swap(&graph, &["contacts", "--set", "sensors=", "--probation", "0"], 0);
    assert_eq!(graph.node("contacts")["params"].get("sensors"), None);
    graph.wait_for_decisions(30);
    graph.kill("contacts");
    graph.wait_for_decisions(30);
    swap(&graph, &["contacts", "--set", &format!("sensors={CHECK}"), "--probation", "0"], 0);
    graph.wait_for_decisions(30);
    graph.kill("contacts");
    graph.wait_for_decisions(30);
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &0.into()), "{}", ended.stderr);
    let is_held = |line: &Value| line["reason"] == "sensor_fault";
    let lines = &ended.decisions;
    // Held, not held, and held again: a busy machine may take long for a swap.
    let n_changes = lines.windows(2).filter(|pair| is_held(&pair[0]) != is_held(&pair[1])).count();
    assert!(n_changes == 2 && is_held(&lines[0]) && is_held(&lines[lines.len() - 1]), "{lines:?}");

    let healthy = folder.path().join("healthy");
    std::fs::create_dir(&healthy).expect("a folder");
    let with = watched(&healthy, "recordings/ordinary.mcap");
    let without = dataflow(folder.path(), &[("recordings/held-out.mcap", "recordings/ordinary.mcap")]);
    let [with, without] = [with, without].map(|flow| {
        let ended = run(&["run", "--json", "--name", &unique_name(), flow.to_str().expect("UTF-8")], 0);
        json_lines(&ended.stdout).last().expect("a summary")["summary"]["reasons"].clone()
    });
    assert_eq!(with, without);
}
