//! Pictures of recorded grasps.

use std::path::Path;

use parry3d_f64::shape::SharedShape;

use super::*;
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_messages::SceneContact;
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::hand::Hand;

/// The first stable grasp of an object of this class in a recording.
fn recorded(class: &str) -> (Hand, RecordedGrasp) {
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../recordings/held-out.mcap");
    let read = || RecordingReader::open(&path).expect("readable").map(|record| record.expect("readable").1);
    let truth = read().find_map(|record| match record {
        Record::Truth(truth) if truth.message.class == class && truth.message.stable => Some(truth.message),
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

/// Fails where the text is no XML. Returns the classes of all elements.
fn classes_of(svg: &str) -> Vec<String> {
    let mut reader = quick_xml::Reader::from_str(svg);
    let (mut classes, mut depth) = (Vec::new(), 0);
    loop {
        use quick_xml::events::Event;
        match reader.read_event().expect("well-formed XML") {
            event @ (Event::Start(_) | Event::Empty(_)) => {
                depth += i32::from(matches!(event, Event::Start(_)));
                let (Event::Start(element) | Event::Empty(element)) = event else { continue };
                for attribute in element.attributes() {
                    let attribute = attribute.expect("an attribute");
                    if attribute.key.as_ref() == "class" {
                        classes.push(attribute.value.into_owned());
                    }
                }
            }
            Event::End(_) => depth -= 1,
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(depth, 0, "an element is not closed");
    classes
}

fn n_arrows(classes: &[String], kind: &str) -> usize {
    // One of each kind is in the legend; the others are there once a view.
    let n = classes.iter().filter(|class| **class == format!("arrow {kind}")).count();
    if n == 0 { 0 } else { (n - 1) / 2 }
}

#[test]
fn the_picture_says_what_the_grasp_is_and_shows_every_contact() {
    let (hand, mut grasp) = recorded("can");
    let scene = grasp.scene.as_mut().expect("a scene");
    let first = scene.contacts[0].clone();
    scene.contacts.push(SceneContact { other_link: 2, felt_newtons: 1.0, ..first });
    scene.contacts.push(SceneContact { felt_newtons: 0.0, ..first.clone() });
    let contacts = scene.contacts.clone();
    let svg = grasp_svg(&hand, &grasp).expect("a picture");
    let classes = classes_of(&svg);
    let count = |of: &dyn Fn(&SceneContact) -> bool| contacts.iter().filter(|contact| of(contact)).count();
    assert_eq!(n_arrows(&classes, "on-hand"), 1);
    assert_eq!(n_arrows(&classes, "sensed"), count(&|c| c.other_link < 0 && c.felt_newtons > 0.05));
    assert_eq!(n_arrows(&classes, "unsensed"), count(&|c| c.other_link < 0 && c.felt_newtons <= 0.05));
    let truth = grasp.truth.clone().expect("a truth");
    let epsilon = format!("ε {}", super::grasp_picture::number(truth.epsilon));
    for expected in [">stable<", &epsilon, &truth.object, "class can", ">palm<", "distal 3", "5 N"] {
        assert!(svg.contains(expected), "{expected}");
    }
    assert!(!svg.contains("not known") && !svg.contains("not drawn"));
    assert_eq!(svg.matches("<image").count(), 2);
    assert_eq!(svg, grasp_svg(&hand, &grasp).expect("a picture"), "the same bytes again");
}

#[test]
fn without_a_scene_the_picture_shows_the_active_cells_and_says_so() {
    let (hand, mut grasp) = recorded("box");
    grasp.scene = None;
    grasp.truth = None;
    let svg = grasp_svg(&hand, &grasp).expect("a picture");
    let classes = classes_of(&svg);
    let frame = &grasp.frames.last().expect("a frame").message;
    let n_active = frame.cells_newtons.iter().filter(|newtons| **newtons > 0.05).count();
    assert!(n_active > 0);
    assert_eq!(classes.iter().filter(|class| *class == "cell-arrow").count(), 2 * n_active);
    assert!(svg.contains("Object and contacts are not known") && svg.contains("not labelled"));
    let html = grasp_html(&hand, &grasp).expect("a page");
    assert!(html.contains("\"object\":null") && !html.contains("<table>"));
}

#[test]
fn an_object_that_is_not_found_is_said_and_hostile_names_are_only_text() {
    let (hand, mut grasp) = recorded("ball");
    grasp.object = ObjectSurface::Unknown("The object 'x' is not drawn: <why> & what to do.".into());
    grasp.truth.as_mut().expect("a truth").object = "</script><b>\"&".into();
    let svg = grasp_svg(&hand, &grasp).expect("a picture");
    classes_of(&svg);
    assert!(svg.contains("&lt;why&gt; &amp; what to do."));
    let html = grasp_html(&hand, &grasp).expect("a page");
    assert_eq!(html.matches("</script>").count(), 4, "only the page's own scripts end");
}

#[test]
fn the_page_needs_nothing_else_and_holds_the_frames_and_contacts() {
    let (hand, grasp) = recorded("cup");
    let html = grasp_html(&hand, &grasp).expect("a page");
    // Namespaces are names, not addresses.
    let names = ["http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml"];
    let addresses = names.iter().fold(html.clone(), |html, name| html.replace(name, ""));
    for loads in ["http:", "https:", "src=", "@import", "url("] {
        assert!(!addresses.contains(loads), "{loads}");
    }
    assert_eq!(html.matches("\"phase\"").count(), grasp.frames.len());
    let n_contacts = grasp.scene.as_ref().expect("a scene").contacts.len();
    assert_eq!(html.matches("<span class=\"badge\">").count(), n_contacts);
    assert_eq!(html, grasp_html(&hand, &grasp).expect("a page"), "the same bytes again");
}

#[test]
fn frames_and_contacts_of_another_hand_are_refused() {
    let (hand, grasp) = recorded("can");
    let refused = |change: &dyn Fn(&mut RecordedGrasp), expected: &str| {
        let mut changed = grasp.clone();
        change(&mut changed);
        let error = anyhow::Error::from(grasp_svg(&hand, &changed).expect_err("not the hand's"));
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

#[test]
fn cards_hold_a_frame_each_and_hostile_names_are_only_text() {
    let (hand, mut grasp) = recorded("can");
    grasp.truth.as_mut().expect("a truth").object = "</script><b>\"&".into();
    let cards = GraspCards::new(&hand, [&grasp, &grasp]).expect("cards");
    let html = report_html(ReportKind::Run, &(), Some(&cards)).expect("a page");
    assert_eq!(html.matches("\"grasp_id\"").count(), 2);
    assert!(html.contains("known to be stable; object \\u003c/script>\\u003cb>"), "{}", &html[..2000]);
    assert_eq!(html.matches("</script>").count(), 4, "only the page's own scripts end");
    let (_, mut other) = recorded("can");
    other.frames[0].message.cells_newtons.pop();
    assert!(GraspCards::new(&hand, [&other]).is_err(), "a frame of another hand");
}
