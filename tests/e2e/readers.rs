//! Other programs read recordings: mcap with mcap-ros2-support, and rosbags. Each field of each sample is compared with
//! `blindgrasp export`.

use std::path::Path;

use crate::common::python::{python, shell, utf8};
use crate::common::{RECORDING, json_lines, project, run, unique_name};
use serde_json::{Value, json};

/// Compares a recording with its export. Returns what was compared.
fn compare(folder: &Path, recording: &Path) -> Value {
    let lines = folder.join("exported.jsonl");
    run(&["export", utf8(recording), "--out", utf8(&lines)], 0);
    let script = project().join("tests/read_recording.py");
    let output = shell(folder, python(), &[utf8(&script), utf8(recording), utf8(&lines)], 0);
    let mut found = json_lines(&output.stdout).remove(0);
    let n_values = found["mcap"]["n_values"].as_u64().expect("a number");
    assert_eq!(found["rosbags"]["n_values"], n_values);
    for name in ["n_samples", "n_standard"] {
        assert_eq!(found["rosbags"][name], found["mcap"][name]);
    }
    found["mcap"].take()
}

#[test]
fn other_readers_find_the_simulated_recording_as_exported() {
    let folder = tempfile::tempdir().expect("a folder");
    let found = compare(folder.path(), &project().join(RECORDING));
    assert_eq!(found["n_samples"], json!({"/tactile": 3360, "/truth": 240, "/scene": 240}));
    // Of a frame alone: two numbers, 7 joints, 96 cells.
    assert!(found["n_values"].as_u64() > Some(3360 * 105), "{found}");
}

#[test]
fn other_readers_find_the_recording_of_a_graph_as_exported() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    let part = ["replay", RECORDING, "--grasps", "0-39", "--rate", "max", "--name", &unique_name()];
    run(&[&part[..], &["--record", utf8(&recording)]].concat(), 0);
    let found = compare(folder.path(), &recording);
    let each_frame = ["/tactile", "/contacts", "/feature", "/prediction"];
    assert!(each_frame.iter().all(|topic| found["n_samples"][topic] == 40 * 14), "{found}");
    assert!(["/decision", "/truth"].iter().all(|topic| found["n_samples"][topic] == 40), "{found}");
}

#[test]
fn other_readers_find_values_that_are_nan() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| utf8(&folder.path().join(name)).to_string();
    // An imported grasp has no quality: epsilon and volume are NaN.
    let cells: Vec<String> = (0..96).map(|idx| format!("c_{idx}")).collect();
    let forces: Vec<String> = (0..96).map(|idx| (f64::from(idx) * 0.1).to_string()).collect();
    let table = format!("object,held,{}\ncup,yes,{}\nbox,no,{}\n", cells.join(","), forces.join(","), forces.join(","));
    std::fs::write(at("table.csv"), table).expect("written");
    let joints = "spread=0.5,finger_1=1.2,finger_2=1.2,finger_3=1.2,distal_1=0.4,distal_2=0.4,distal_3=0.4";
    let table = at("table.csv");
    let arguments = ["import", &table, "--hand", "barrett-bh8-280", "--cells", "c_*", "--label", "held"];
    let recording = folder.path().join("imported.mcap");
    let more = ["--stable-value", "yes", "--group", "object", "--joints", joints, "--out", utf8(&recording)];
    run(&[&arguments[..], &more].concat(), 0);
    let found = compare(folder.path(), &recording);
    assert_eq!(found["n_samples"]["/truth"], 2);
    let lines = json_lines(&std::fs::read(folder.path().join("exported.jsonl")).expect("written"));
    let truths = lines.iter().filter(|line| line["topic"] == "/truth");
    assert!(truths.clone().all(|line| line["data"]["epsilon"].is_null()) && truths.count() == 2, "{lines:?}");
}
