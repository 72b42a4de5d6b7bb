//! `blindgrasp predict`: the decisions of a graph, without a graph.

use std::io::Write;
use std::process::Stdio;

use serde_json::Value;

use crate::common::python::utf8;
use crate::common::{MODEL, RECORDING, blindgrasp, dataflow, decisions_of, json_lines, project, run, text};

/// The decisions by lines of frames on stdin.
fn of_lines(lines: &[u8]) -> Vec<Value> {
    let mut command = blindgrasp();
    command.args(["predict", MODEL, "-", "--json"]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("started");
    child.stdin.take().expect("stdin").write_all(lines).expect("written");
    let output = child.wait_with_output().expect("waited");
    assert!(output.status.success(), "{}", text(&output.stderr));
    json_lines(&output.stdout)
}

fn action_and_reason(line: &Value) -> (String, String) {
    let word = |name: &str| line[name].as_str().expect("a word").to_owned();
    (word("action"), word("reason"))
}

#[test]
fn predictions_are_the_decisions_of_a_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let predicted = json_lines(&run(&["predict", MODEL, RECORDING, "--json"], 0).stdout);
    let of_graph = decisions_of(&dataflow(folder.path(), &[("rate: 10", "rate: max")]));
    assert_eq!(predicted.iter().map(action_and_reason).collect::<Vec<_>>(), of_graph);
    assert_eq!(predicted[0]["truth"]["object"], "vase-20");
    let said = text(&run(&["predict", MODEL, RECORDING], 0).stdout).to_string();
    assert!(said.starts_with("grasp     0  LIFT  p 0.762  stable          label: stable (vase-20)\n"), "{said}");
    // No probability decided that nothing is felt. JSON has a number, as the messages have.
    assert!(said.contains("  HOLD  p     -  no_contact ") && !said.contains("p 0.000"), "{said}");
    // Each grasp that the model holds has the two values that spoke most against it.
    let n_unstable = predicted.iter().filter(|line| line["reason"] == "unstable").count();
    assert_eq!(said.matches("\n             of pads and joints, most against it: ").count(), n_unstable, "{said}");
    // Of the 37 grasps without contact, cells feel 14 where the hand touches itself.
    let unfelt = predicted.iter().filter(|line| line["reason"] == "no_contact");
    let self_contacts = "cells feel, but only on links that touch each other: ";
    assert_eq!((unfelt.count(), said.matches(self_contacts).count()), (37, 14), "{said}");
    // Odd readings are told of a pad that is dead, of lifted grasps too, and of no healthy hand.
    let odd = ["repeat their readings", "in phase settled", "in the open hand", "grasps before"];
    assert!(!odd.iter().any(|words| said.contains(words)), "{said}");
    let of_dead_pad = text(&run(&["predict", MODEL, "recordings/dead-pad.mcap"], 0).stdout).to_string();
    assert_eq!(
        of_dead_pad.matches("24 of 24 cells of pad finger_2 repeat their readings").count(),
        12,
        "{of_dead_pad}"
    );
    let unfelt = predicted.iter().find(|line| line["reason"] == "no_contact").expect("an empty hand");
    assert_eq!(unfelt["probability_stable"], 0.0);
}

/// The lines of a bridge have numbers of its own.
#[test]
fn the_lines_of_a_bridge_are_decided_as_a_source_numbers_them() {
    let exported = json_lines(&run(&["export", RECORDING, "--topic", "/tactile"], 0).stdout);
    let lines = |left_out: std::ops::Range<usize>| {
        let of_bridge =
            exported.iter().take(14).enumerate().filter(|(idx, _)| !left_out.contains(idx)).map(|(_, line)| {
                let mut frame = line["data"].clone();
                frame["seq"] = (3041 + line["seq"].as_u64().expect("a number")).into();
                frame["stamp_nanos"] = line["stamp_nanos"].clone();
                frame.as_object_mut().expect("a frame").retain(|key, _| !["day"].contains(&key.as_str()));
                frame.to_string()
            });
        of_bridge.collect::<Vec<_>>().join("\n")
    };
    assert_eq!(of_lines(lines(0..0).as_bytes())[0]["action"], "lift");
    assert_eq!(of_lines(lines(3..10).as_bytes())[0]["action"], "hold");
    // It begins amid a grasp.
    assert_eq!(of_lines(lines(0..4).as_bytes())[0]["action"], "hold");
}

/// Frames that are out of order, that lack cells, or that are of another hand are held as in the recording.
#[test]
fn lines_of_frames_are_decided_as_their_recording() {
    for name in ["held-out", "out-of-order", "drop-outs", "dead-pad", "no-contact", "self-collision"] {
        let path = project().join(format!("recordings/{name}.mcap"));
        let of_recording = json_lines(&run(&["predict", MODEL, utf8(&path), "--json"], 0).stdout);
        let found = of_lines(&run(&["export", utf8(&path), "--topic", "/tactile"], 0).stdout);
        let short = |lines: &[Value]| lines.iter().map(action_and_reason).collect::<Vec<_>>();
        assert_eq!(short(&found), short(&of_recording), "{name}");
    }
    let lines = text(&run(&["export", RECORDING, "--topic", "/tactile", "--topic", "/truth"], 0).stdout).to_string();
    let hand_id = json_lines(lines.as_bytes())[0]["hand_id"].as_str().expect("an identity").to_owned();
    let of_another = of_lines(lines.replace(&hand_id, "00000000000000aa").as_bytes());
    assert!(of_another.iter().all(|line| line["action"] == "hold"), "{of_another:?}");
    // Without its closing frames a grasp is held, because their numbers are missing.
    let frames = text(&run(&["export", RECORDING, "--topic", "/tactile"], 0).stdout).to_string();
    let first = of_lines(frames.lines().take(14).collect::<Vec<_>>().join("\n").as_bytes());
    assert_eq!(first[0]["action"], "lift");
    let cut: Vec<&str> =
        frames.lines().take(14).enumerate().filter(|(idx, _)| !(3..10).contains(idx)).map(|(_, line)| line).collect();
    assert_eq!(of_lines(cut.join("\n").as_bytes())[0]["action"], "hold");
}

#[test]
fn input_that_is_no_frame_is_named() {
    let refused = |lines: &str, expected: &str| {
        let mut command = blindgrasp();
        command.args(["predict", MODEL, "-"]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("started");
        child.stdin.take().expect("stdin").write_all(lines.as_bytes()).expect("written");
        let output = child.wait_with_output().expect("waited");
        let stderr = text(&output.stderr).to_string();
        assert!(output.status.code() == Some(1) && stderr.contains(expected) && output.stdout.is_empty(), "{stderr}");
    };
    refused("", "expected lines with tactile frames, found none");
    refused("{", "-, line 1: not a line of JSON");
    refused("{}\n", "-, line 1: not a frame: missing field `joints`");
    // It has no end yet, and would be read to it.
    refused(&"x".repeat((4 << 20) + 1), "-, line 1: more than 4 MiB: expected a line with a frame");
    let frame = r#""data": {"grasp_id": 0, "phase": "settled", "joints": [], "cells_newtons": []}"#;
    let with = |seq: &str| format!("{{\"topic\": \"/tactile\", \"stamp_nanos\": 0, {seq}{frame}}}\n");
    for seq in ["", "\"seq\": 1.5, ", "\"seq\": \"1\", ", "\"seq\": -1, ", "\"seq\": 1, \"hand_id\": 170, "] {
        refused(&with(seq), "-, line 1: not a line of 'blindgrasp export': expected topic, seq, stamp_nanos and data");
    }
    assert!(text(&run(&["predict", MODEL, "none.mcap"], 1).stderr).contains("none.mcap"));
    assert!(text(&run(&["predict", MODEL], 2).stderr).contains("FILE"));
}
