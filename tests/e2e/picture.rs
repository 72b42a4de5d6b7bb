//! `blindgrasp view` of files, as a user runs it.

use std::path::Path;

use crate::common::mistakes::check;
use crate::common::{RECORDING, project, run, text};
use blindgrasp_messages::{GraspScene, LiftDecision, Prediction, Recorded, SceneContact, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader, RecordingWriter};

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
    run(&["view", &at("scene.mcap"), "--out", &at("a.svg")], 0);
    let svg = std::fs::read_to_string(at("a.svg")).expect("written");
    for expected in ["1 felt by cells", "1 hand on hand", "p(stable) 0.81", "hold: no agreement", "predicted"] {
        assert!(svg.contains(expected), "{expected}");
    }
    assert!(!svg.contains("not drawn"), "the object is a built-in one");
    run(&["view", &at("scene.mcap"), "--out", &at("b.svg")], 0);
    assert_eq!(svg, std::fs::read_to_string(at("b.svg")).expect("written"), "the same bytes again");
    run(&["view", &at("scene.mcap"), "--out", &at("a.html")], 0);
    let html = std::fs::read_to_string(at("a.html")).expect("written");
    assert!(html.starts_with("<!doctype html>") && html.contains("<table>"));
}

#[test]
fn any_grasp_of_a_recording_can_be_chosen() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("grasp.svg");
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
    let svg = std::fs::read_to_string(out).expect("written");
    assert!(svg.contains(&format!("grasp {last}")));
}

#[test]
fn drawings_that_are_impossible_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    check(&["view", RECORDING, "--grasp", "99999", "--out", &at("a.svg")], 1, &["no grasp 99999", "0 to "]);
    check(&["view", RECORDING, "--out", &at("a.png")], 1, &["a.png", ".svg", ".html"]);
    check(&["view", RECORDING, "--out", &at("a")], 1, &[".svg", ".html"]);
    check(&["view", RECORDING, "--out", &at("")], 1, &["is a folder"]);
    check(&["view", RECORDING, "--out", &at("absent/a.svg")], 1, &["no such folder"]);
    check(&["view", "absent.mcap", "--out", &at("a.svg")], 1, &["absent.mcap"]);
    // Without --out the recording is served, if it can be.
    check(&["view", "absent.mcap"], 1, &["absent.mcap"]);
    check(&["view", RECORDING, "--grasp", "99999"], 1, &["no grasp 99999"]);
    assert!(!Path::new(&at("a.svg")).exists());
    // A hand with another pad is not the recording's.
    let layout = std::fs::read_to_string(project().join("hands/barrett-bh8-280.yaml")).expect("readable");
    let urdf = std::fs::read_to_string(project().join("hands/barrett-bh8-280.urdf")).expect("readable");
    std::fs::write(at("barrett-bh8-280.urdf"), urdf).expect("written");
    std::fs::write(at("other.yaml"), layout.replace("at_m: [0.022, 0.0159, 0]", "at_m: [0.023, 0.0159, 0]"))
        .expect("written");
    check(&["view", RECORDING, "--hand", &at("other.yaml"), "--out", &at("a.svg")], 1, &["was made with the hand"]);
    // A recording without frames.
    let info = RecordingReader::open(&project().join(RECORDING)).expect("opened").info().clone();
    RecordingWriter::create(Path::new(&at("empty.mcap")), &info).expect("created").finish().expect("finished");
    check(&["view", &at("empty.mcap"), "--out", &at("a.svg")], 1, &["empty.mcap", TactileFrame::TOPIC]);
    check(&["simulate", "--list", "--objects", "elephant"], 1, &["elephant", "bottle"]);
    check(&["simulate", "--list", "--objects", &at("nowhere")], 1, &["nowhere"]);
    check(&["view", RECORDING, "--objects", &at("nowhere"), "--out", &at("a.svg")], 1, &["nowhere"]);
    std::fs::write(at("file"), "").expect("written");
    check(&["simulate", "--list", "--objects", "can-01", "--out", &at("file")], 1, &["file"]);
}

/// The frames of two grasps, each with the decision that a graph makes of it.
#[test]
fn grasps_are_drawn_as_a_moving_picture() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let (model, out) = ("models/barrett-bh8-280.json", at("a.svg"));
    run(&["view", RECORDING, "--grasp", "4,2", "--animate", model, "--out", &out], 0);
    let svg = std::fs::read_to_string(out).expect("written");
    let frames = |id: u64| {
        let records = RecordingReader::open(&project().join(RECORDING)).expect("a recording");
        records.filter(
            move |record| matches!(&record.as_ref().expect("a record").1, Record::Tactile(it) if it.message.grasp_id == id),
        )
    };
    let n_frames = frames(4).count() + frames(2).count();
    assert_eq!(svg.matches("class=\"moment\"").count(), n_frames);
    assert_eq!(svg.matches("<image").count(), n_frames);
    assert_eq!(svg.matches("@keyframes").count(), n_frames);
    // As the graph of dataflow.yaml decides them.
    let decided: Vec<&str> = ["LIFT</text>", "HOLD</text>"].into_iter().filter(|text| svg.contains(text)).collect();
    assert_eq!(decided.len(), 2);
    assert!(svg.find("LIFT</text>") < svg.find("HOLD</text>"));
    assert!(svg.contains("The grasp is stable.") && svg.contains("The grasp is not stable."));
    assert!(svg.contains("prefers-reduced-motion"));
    let refused = |arguments: &[&str], exit_code: i32, expected: &str| {
        let output = run(&[&["view", RECORDING][..], arguments].concat(), exit_code);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.contains(expected), "{arguments:?}: {said}");
    };
    refused(&["--grasp", "1,2", "--out", &at("c.svg")], 2, "--grasp takes one number");
    refused(
        &["--animate", "models/barrett-bh8-280.json", "--out", &at("c.html")],
        1,
        "expected a name that ends in .svg",
    );
    refused(&["--animate", "models/absent.json", "--out", &at("c.svg")], 1, "absent.json");
    refused(&["--animate", "models/barrett-bh8-280.json"], 2, "--out");
}
