//! `blindgrasp view` of files, as a user runs it.

use std::path::Path;

use crate::common::mistakes::check;
use crate::common::{RECORDING, project, report_data, run, text};
use blindgrasp_messages::{Recorded as _, TactileFrame};
use blindgrasp_recording::{RecordingReader, RecordingWriter};
use serde_json::{Value, json};

#[test]
fn the_page_of_any_grasp_has_what_the_recording_knows_of_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("grasp.html");
    let out = out.to_str().expect("UTF-8");
    let draw = |recording: &str, id: &str| {
        let said = run(&["view", recording, "--grasp", id, "--out", out], 0);
        assert!(text(&said.stdout).contains(&format!("grasp {id} ")), "{}", text(&said.stdout));
        let html = std::fs::read_to_string(out).expect("written");
        assert!(html.starts_with("<!doctype html>"));
        report_data(&html)["data"].take()
    };
    // The last grasp of the simulator: its object is a built-in one.
    let simulated = draw(RECORDING, "239");
    assert!(simulated["title"].to_string().contains("Grasp 239 of "), "{simulated}");
    assert!(simulated["contacts"].as_array().is_some_and(|contacts| !contacts.is_empty()), "{simulated}");
    assert!(simulated["object"]["triangles"].as_array().map(Vec::len) > Some(10) && simulated["notes"] == json!([]));
    // A graph answered this one, and its scene is not known.
    let decided = draw("recordings/ordinary.mcap", "1");
    let facts = decided["facts"].to_string();
    for expected in ["[\"predicted\",\"p(stable) 0.99\"]", "[\"decided\",\"lift: stable\"]"] {
        assert!(facts.contains(expected), "{expected}: {facts}");
    }
    assert_eq!(decided["object"], Value::Null);
}

#[test]
fn drawings_that_are_impossible_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    check(&["view", RECORDING, "--grasp", "99999", "--out", &at("a.html")], 1, &["no grasp 99999", "0 to "]);
    check(&["view", RECORDING, "--out", &at("a.png")], 1, &["a.png", "expected a name that ends in .html"]);
    check(&["view", RECORDING, "--out", &at("a")], 1, &["ends in .html"]);
    check(&["view", RECORDING, "--out", &at("")], 1, &["is a folder"]);
    check(&["view", RECORDING, "--out", &at("absent/a.html")], 1, &["no such folder"]);
    check(&["view", "absent.mcap", "--out", &at("a.html")], 1, &["absent.mcap"]);
    // Without --out the recording is served, if it can be.
    check(&["view", "absent.mcap"], 1, &["absent.mcap"]);
    check(&["view", RECORDING, "--grasp", "99999"], 1, &["no grasp 99999"]);
    assert!(!Path::new(&at("a.html")).exists());
    // A hand with another pad is not the recording's.
    let layout = std::fs::read_to_string(project().join("hands/barrett-bh8-280.yaml")).expect("readable");
    let urdf = std::fs::read_to_string(project().join("hands/barrett-bh8-280.urdf")).expect("readable");
    std::fs::write(at("barrett-bh8-280.urdf"), urdf).expect("written");
    std::fs::write(at("other.yaml"), layout.replace("at_m: [0.022, 0.0159, 0]", "at_m: [0.023, 0.0159, 0]"))
        .expect("written");
    check(&["view", RECORDING, "--hand", &at("other.yaml"), "--out", &at("a.html")], 1, &["was made with the hand"]);
    // A recording without frames.
    let info = RecordingReader::open(&project().join(RECORDING)).expect("opened").info().clone();
    RecordingWriter::create(Path::new(&at("empty.mcap")), &info).expect("created").finish().expect("finished");
    check(&["view", &at("empty.mcap"), "--out", &at("a.html")], 1, &["empty.mcap", TactileFrame::TOPIC]);
    check(&["simulate", "--list", "--objects", "elephant"], 1, &["elephant", "bottle"]);
    check(&["simulate", "--list", "--objects", &at("nowhere")], 1, &["nowhere"]);
    check(&["view", RECORDING, "--objects", &at("nowhere"), "--out", &at("a.html")], 1, &["nowhere"]);
    std::fs::write(at("file"), "").expect("written");
    check(&["simulate", "--list", "--objects", "can-01", "--out", &at("file")], 1, &["file"]);
}
