//! `blindgrasp view` of files, as a user runs it.

use std::path::Path;

use crate::common::{RECORDING, project, report_data, run, text};
use blindgrasp_messages::{GraspScene, LiftDecision, Prediction, Recorded, SceneContact, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader, RecordingWriter};
use serde_json::Value;

/// The first grasp of the project's recording, with a scene and with what a graph would have answered.
fn with_scene(path: &Path) {
    let reader = RecordingReader::open(&project().join(RECORDING)).expect("opened");
    let mut writer = RecordingWriter::create(path, reader.info()).expect("created");
    let mut wanted = None;
    for record in reader {
        let (topic, record) = record.expect("read");
        let grasp_id = match &record {
            Record::Tactile(frame) => frame.message.grasp_id,
            Record::Truth(truth) => truth.message.grasp_id,
            _ => continue,
        };
        if *wanted.get_or_insert(grasp_id) == grasp_id {
            writer.write_record(&topic, &record).expect("written");
        }
        if let Record::Truth(truth) = record
            && Some(truth.message.grasp_id) == wanted
        {
            let header = truth.header;
            let contact = SceneContact {
                link: 0,
                other_link: -1,
                point_m: [0.0, 0.0, 0.01],
                inward_normal: [0.0, 0.0, 1.0],
                tangent: [1.0, 0.0, 0.0],
                force_newtons: 4.0,
                felt_newtons: 2.5,
                torsion_m: 0.001,
            };
            let scene = GraspScene {
                grasp_id,
                object_position_m: [0.0, 0.0, 0.06],
                object_rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
                joints: vec![0.5; 7],
                contacts: vec![contact.clone(), SceneContact { other_link: 2, ..contact }],
                ..GraspScene::default()
            };
            let prediction = Prediction { grasp_id, probability_stable: 0.8125, stable: true, ..Prediction::default() };
            let decision = LiftDecision { grasp_id, ..LiftDecision::default() };
            writer.write_record(GraspScene::TOPIC, &stamped(header, scene, Record::Scene)).expect("written");
            writer.write_record(Prediction::TOPIC, &stamped(header, prediction, Record::Prediction)).expect("written");
            writer.write_record(LiftDecision::TOPIC, &stamped(header, decision, Record::Decision)).expect("written");
        }
    }
    writer.finish().expect("finished");
}

fn stamped<M>(
    header: blindgrasp_messages::Header,
    message: M,
    record: fn(blindgrasp_messages::Stamped<M>) -> Record,
) -> Record {
    record(blindgrasp_messages::Stamped { header, message })
}

#[test]
fn a_recording_with_a_scene_shows_the_object_and_its_contacts() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    with_scene(Path::new(&at("scene.mcap")));
    run(&["view", &at("scene.mcap"), "--out", &at("a.html")], 0);
    let html = std::fs::read_to_string(at("a.html")).expect("written");
    assert!(html.starts_with("<!doctype html>"));
    let data = &report_data(&html)["data"];
    let kinds = data["contacts"].as_array().expect("contacts").iter().map(|contact| &contact["kind"]);
    assert_eq!(kinds.collect::<Vec<_>>(), ["sensed", "on-hand"]);
    let facts = data["facts"].to_string();
    for expected in ["[\"predicted\",\"p(stable) 0.81\"]", "[\"decided\",\"hold: no agreement\"]"] {
        assert!(facts.contains(expected), "{expected}: {facts}");
    }
    let triangles = data["object"]["triangles"].as_array().map(Vec::len);
    assert!(data["notes"] == Value::Array(vec![]) && triangles > Some(10), "the object is a built-in one");
}

#[test]
fn any_grasp_of_a_recording_can_be_chosen() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("grasp.html");
    let out = out.to_str().expect("UTF-8");
    let last = RecordingReader::open(&project().join(RECORDING))
        .expect("opened")
        .filter_map(|record| match record.expect("read").1 {
            Record::Tactile(frame) => Some(frame.message.grasp_id),
            _ => None,
        })
        .last()
        .expect("a grasp");
    let said = run(&["view", RECORDING, "--grasp", &last.to_string(), "--out", out], 0);
    assert!(text(&said.stdout).contains(&format!("grasp {last} ")), "{}", text(&said.stdout));
    let title = report_data(&std::fs::read_to_string(out).expect("written"))["data"]["title"].to_string();
    assert!(title.contains(&format!("Grasp {last} of ")), "{title}");
}

#[test]
fn drawings_that_are_impossible_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let check = |arguments: &[&str], exit_code: i32, expected: &[&str]| {
        let output = run(arguments, exit_code);
        let stderr = text(&output.stderr);
        for part in expected {
            assert!(stderr.contains(part), "blindgrasp {arguments:?}: expected '{part}' in\n{stderr}");
        }
        assert!(!stderr.contains("panicked") && output.stdout.is_empty(), "{stderr}");
    };
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
