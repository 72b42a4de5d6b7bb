//! Pictures of simulated grasps.

use std::path::Path;

use super::*;
use blindgrasp_messages::{Header, SceneContact, Stamped};
use blindgrasp_objects::select;
use blindgrasp_simulator::simulator::{SimulatorOptions, simulate_all};
use blindgrasp_stages::hand::Hand;

/// A grasp of a built-in object.
pub(super) fn simulated(objects: &str, seed: u64) -> (Hand, RecordedGrasp) {
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
    let objects = select(objects).expect("built in");
    let options = SimulatorOptions { n_grasps: 1, seed, stable_fraction: Some(1.0), ..SimulatorOptions::default() };
    let mut found = None;
    simulate_all(&hand, &objects, &options, |grasp| {
        found = Some(grasp);
        Ok::<(), ()>(())
    })
    .expect("a grasp");
    let grasp = found.expect("a grasp");
    let object = objects.iter().find(|object| object.name == grasp.truth.object).expect("one of these");
    let frames = grasp
        .frames
        .into_iter()
        .map(|timed| Stamped {
            header: Header { stamp_nanos: timed.offset_nanos, ..Header::default() },
            message: timed.frame,
        })
        .collect();
    let object = ObjectSurface::Known(object.to_mesh());
    let recorded = RecordedGrasp {
        grasp_id: grasp.truth.grasp_id,
        frames,
        truth: Some(grasp.truth),
        scene: Some(grasp.scene),
        object,
        prediction: None,
        decision: None,
        is_hand_alone: false,
    };
    (hand, recorded)
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
    let (hand, mut grasp) = simulated("can", 1);
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
    let (hand, mut grasp) = simulated("box", 2);
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
    let (hand, mut grasp) = simulated("ball", 5);
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
    let (hand, grasp) = simulated("cup", 3);
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
    let (hand, grasp) = simulated("can", 1);
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
    let (hand, mut grasp) = simulated("can", 1);
    grasp.truth.as_mut().expect("a truth").object = "</script><b>\"&".into();
    let cards = GraspCards::new(&hand, [&grasp, &grasp]).expect("cards");
    let html = report_html(ReportKind::Run, &(), Some(&cards)).expect("a page");
    assert_eq!(html.matches("\"grasp_id\"").count(), 2);
    assert!(html.contains("known to be stable; object \\u003c/script>\\u003cb>"), "{}", &html[..2000]);
    assert_eq!(html.matches("</script>").count(), 4, "only the page's own scripts end");
    let (_, mut other) = simulated("can", 1);
    other.frames[0].message.cells_newtons.pop();
    assert!(GraspCards::new(&hand, [&other]).is_err(), "a frame of another hand");
}
