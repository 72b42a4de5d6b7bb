//! Pages of recorded grasps.

use std::path::Path;

use parry3d_f64::shape::SharedShape;
use serde_json::{Value, json};

use super::*;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_messages::{Phase, SceneContact};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::hand::Hand;

/// The first stable grasp of an object of this class in a recording.
fn recorded(class: &str) -> (Hand, RecordedGrasp) {
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../recordings/held-out.mcap");
    let read = || RecordingReader::open(&path).expect("readable").map(|record| record.expect("readable").1);
    let truth = read().find_map(|record| match record {
        Record::Truth(truth) if truth.message.object_class == class && truth.message.stable => Some(truth.message),
        _ => None,
    });
    let truth = truth.expect("a grasp");
    let mut grasp = RecordedGrasp { is_hand_alone: false, ..RecordedGrasp::hand_alone(&hand, &[]) };
    for record in read() {
        match record {
            Record::Tactile(frame) if frame.message.grasp_id == truth.grasp_id => grasp.frames.push(frame),
            Record::Scene(scene) if scene.message.grasp_id == truth.grasp_id => grasp.scene = Some(scene.message),
            _ => {}
        }
    }
    grasp.grasp_id = truth.grasp_id;
    grasp.object = ObjectSurface::Known(mesh_of_shape(&SharedShape::cylinder(0.05, 0.03)));
    grasp.truth = Some(truth);
    (hand, grasp)
}

/// The data that the page's script draws.
fn data_of(html: &str) -> Value {
    let (_, json) = html.split_once("<script type=\"application/json\" id=\"report\">").expect("the data");
    serde_json::from_str(json.split_once("</script>").expect("an end").0).expect("JSON")
}

#[test]
fn the_page_says_what_the_grasp_is_and_shows_every_contact_and_frame() {
    let (hand, mut grasp) = recorded("can");
    let scene = grasp.scene.as_mut().expect("a scene");
    let first = scene.contacts[0].clone();
    scene.contacts.push(SceneContact { other_link: 2, felt_newtons: 1.0, ..first });
    scene.contacts.push(SceneContact { felt_newtons: 0.0, ..first.clone() });
    let contacts = scene.contacts.clone();
    let html = grasp_html(&hand, &grasp).expect("a page");
    assert_eq!(html, grasp_html(&hand, &grasp).expect("a page"), "the same bytes again");
    let page = data_of(&html);
    let data = &page["data"];
    let n_found = |kind: &str| {
        let found = data["contacts"].as_array().expect("contacts").iter();
        found.filter(|contact| contact["kind"] == kind).count()
    };
    let count = |of: &dyn Fn(&SceneContact) -> bool| contacts.iter().filter(|contact| of(contact)).count();
    assert_eq!(n_found("on-hand"), 1);
    assert_eq!(n_found("sensed"), count(&|c| c.other_link < 0 && c.felt_newtons > 0.05));
    assert_eq!(n_found("unsensed"), count(&|c| c.other_link < 0 && c.felt_newtons <= 0.05));
    let truth = grasp.truth.clone().expect("a truth");
    let fact = |name: &str| data["facts"].as_array().expect("facts").iter().find(|fact| fact[0] == name).cloned();
    for (name, expected) in [("true label", "stable"), ("class", "can"), ("epsilon", &format!("{:.4}", truth.epsilon))]
    {
        assert_eq!(fact(name).expect(name)[1], expected);
    }
    assert_eq!(data["title"], format!("Grasp {} of {}", grasp.grasp_id, truth.object));
    assert_eq!(data["notes"], json!([]));
    assert_eq!(page["drawn"]["frames"].as_array().map(Vec::len), Some(grasp.frames.len()));
    assert_eq!(page["drawn"]["scale_newtons"], 3.0);
    assert_eq!(data["is_closed"][data["shown"].as_u64().expect("an index") as usize], true);
    assert_eq!(data["is_closed"][0], false, "the first frame is of the open hand");
    let values: Vec<f64> = grasp.scene.expect("a scene").joints;
    let shown: Vec<f64> =
        data["joints"].as_array().expect("joints").iter().filter_map(|joint| joint["value"].as_f64()).collect();
    assert_eq!(shown, values);
}

#[test]
fn long_grasps_are_thinned_out_around_the_frame_shown() {
    let (hand, mut grasp) = recorded("can");
    grasp.frames = grasp.frames.iter().cycle().take(1000).cloned().collect();
    let last_settled = grasp.frames.iter().rposition(|frame| frame.message.phase == Phase::Settled).expect("settled");
    let page = data_of(&grasp_html(&hand, &grasp).expect("a page"));
    let frames = page["drawn"]["frames"].as_array().expect("frames");
    assert!((100..=150).contains(&frames.len()), "{}", frames.len());
    let shown = page["data"]["shown"].as_u64().expect("an index") as usize;
    let expected = &grasp.frames[last_settled].message.cells_newtons;
    for (cell, newtons) in frames[shown]["cells"].as_array().expect("cells").iter().zip(expected) {
        assert!((cell.as_f64().expect("a number") - newtons).abs() < 1e-5);
    }
}

#[test]
fn without_a_scene_the_page_says_so() {
    let (hand, mut grasp) = recorded("box");
    grasp.scene = None;
    grasp.truth = None;
    let page = data_of(&grasp_html(&hand, &grasp).expect("a page"));
    assert_eq!((&page["data"]["object"], &page["data"]["contacts"]), (&Value::Null, &json!([])));
    assert_eq!(page["data"]["facts"][0], json!(["true label", "not labelled"]));
    let note = page["data"]["notes"][0].as_str().expect("a note");
    assert!(note.starts_with("Object and contacts are not known"), "{note}");
}

#[test]
fn an_object_that_is_not_found_is_said_and_hostile_names_are_only_text() {
    let (hand, mut grasp) = recorded("ball");
    let why = "The object 'x' is not drawn: <why> & what to do.";
    grasp.object = ObjectSurface::Unknown(why.into());
    grasp.truth.as_mut().expect("a truth").object = "</script><b>\"&".into();
    let html = grasp_html(&hand, &grasp).expect("a page");
    assert_eq!(html.matches("</script>").count(), 4, "only the page's own scripts end");
    let page = data_of(&html);
    assert_eq!(page["data"]["notes"], json!([why]));
    assert!(page["data"]["title"].as_str().expect("a title").ends_with(" of </script><b>\"&"));
    // Namespaces are names, not addresses.
    let addresses = html.replace("http://www.w3.org/2000/svg", "").replace("http://www.w3.org/1999/xhtml", "");
    for loads in ["http:", "https:", "src=", "@import", "url("] {
        assert!(!addresses.contains(loads), "{loads}");
    }
}

#[test]
fn frames_and_contacts_of_another_hand_are_refused() {
    let (hand, grasp) = recorded("can");
    let refused = |change: &dyn Fn(&mut RecordedGrasp), expected: &str| {
        let mut changed = grasp.clone();
        change(&mut changed);
        let error = anyhow::Error::from(grasp_html(&hand, &changed).expect_err("not the hand's"));
        assert!(format!("{error:#}").contains(expected), "{error:#}");
    };
    refused(&|grasp| grasp.frames[3].message.cells_newtons.truncate(95), "frame 3: 95 cells, the hand has 96");
    refused(&|grasp| grasp.frames[0].message.joints.push(0.0), "8 joint angles, the hand has 7");
    refused(&|grasp| grasp.frames.clear(), "no frames");
    let with_contact = |change: fn(&mut SceneContact)| {
        move |grasp: &mut RecordedGrasp| change(&mut grasp.scene.as_mut().expect("a scene").contacts[0])
    };
    refused(&with_contact(|contact| contact.link = 99), "link 99");
    refused(&with_contact(|contact| contact.other_link = 99), "link 99");
}
