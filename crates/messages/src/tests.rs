//! One sample of each type in all its shapes, against `golden.json`, which was captured when each shape was written by
//! hand: layouts, definitions, recordings and the wire stay as they were. A message that gets another version is
//! captured again with `BLINDGRASP_REMAKE=1`, and the difference is read.

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::{Map, Value, json};

use crate::shared_memory::IntoBytes as _;
use crate::*;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn header() -> Header {
    Header { seq: 7, stamp_nanos: 1 << 40, epoch: 3, hand_id: u64::MAX - 1, origin_nanos: 9, ..Header::default() }
}

fn recorded<M: Recorded>(message: &M) -> Map<String, Value> {
    let sample = Stamped { header: header(), message: message.clone() };
    let mut cdr = Vec::new();
    cdr_encoding::to_writer::<_, byteorder::LittleEndian, _>(&mut cdr, &sample).expect("CDR");
    let wire = bincode::serde::encode_to_vec(&sample, bincode::config::standard()).expect("bincode");
    let definition = M::definition();
    let shapes = json!({
        "type_name": M::TYPE_NAME,
        "topic": M::TOPIC,
        "definition": definition.lines().collect::<Vec<_>>(),
        "cdr": hex(&cdr),
        "wire": hex(&wire),
        "json": message,
    });
    let Value::Object(shapes) = shapes else { return Map::new() };
    shapes
}

fn sent<M: Message + PartialEq>(message: &M) -> Map<String, Value> {
    let (head, items) = message.to_parts(header());
    assert_eq!(M::from_parts(&head, &items).as_ref(), Ok(message));
    assert_eq!(M::header(&head), &header());
    let mut shapes = recorded(message);
    shapes.insert("head".into(), hex(head.as_bytes()).into());
    shapes.insert("items".into(), hex(items.as_bytes()).into());
    shapes
}

fn senses() -> OwnedSenses {
    OwnedSenses::default()
        .with(Sense::JointTorques, &[0.75, 0.0625])
        .with(Sense::Gravity, &[0.0, -9.75, 0.5])
        .with(Sense::WristWrench, &[0.5, 1.0, 1.5, 0.125, 0.25, 0.375])
}

fn shapes() -> Vec<Map<String, Value>> {
    let contact =
        Contact { position_m: [0.1, 0.2, -0.3], normal: [0.0, 0.6, 0.8], force_newtons: 2.5, pad: 1, cell: 23 };
    let scene_contact = SceneContact {
        link: 4,
        other_link: -1,
        point_m: [0.01, 0.02, 0.03],
        inward_normal: [0.0, 0.0, 1.0],
        tangent: [1.0, 0.0, 0.0],
        force_newtons: 3.5,
        felt_newtons: 2.5,
        torsion_m: 0.004,
    };
    vec![
        sent(&TactileFrame {
            grasp_id: 11,
            phase: Phase::Settled,
            joints: vec![0.25, -0.5],
            cells_newtons: vec![1.5, 0.0, 2.25],
            senses: senses(),
            day: 20_261_124,
        }),
        sent(&ContactSet {
            grasp_id: 11,
            phase: Phase::Closing,
            joints: vec![0.25, -0.5],
            contacts: vec![contact; 2],
            n_pads_in_contact: 1,
            self_collision: true,
            n_self_contacts: 3,
            fault: Fault::SelfCollision,
            senses: senses(),
            day: 20_261_124,
        }),
        sent(&GraspFeature {
            grasp_id: 11,
            phase: Phase::Open,
            values: vec![0.125, 0.5],
            n_pads_in_contact: 2,
            dictionary_id: 0x0123_4567_89ab_cdef,
            fault: Fault::OutOfDistribution,
            day: 20_261_124,
        }),
        sent(&Prediction {
            grasp_id: 11,
            phase: Phase::Ended,
            decision_value: -0.5,
            probability_stable: 0.25,
            stable: true,
            unsure: false,
            fault: Fault::Malformed,
        }),
        sent(&LiftDecision {
            grasp_id: 11,
            action: Action::TestLift,
            reason: Reason::LinkDown,
            probability_stable: 0.75,
        }),
        sent(&GraspTruth {
            grasp_id: 11,
            epsilon: -1.0,
            volume: 0.5,
            stable: true,
            object: "bücher-1".into(),
            object_class: "book".into(),
        }),
        sent(&LiftOutcome {
            grasp_id: 11,
            trial: 5,
            attempt: 2,
            lifted: true,
            held: false,
            has_quality: true,
            slip_m: 0.01,
            turn_rad: 0.5,
            epsilon: 0.125,
            volume: 0.25,
            mass_kg: 0.75,
            friction: 0.9,
            thing: "tasse".into(),
            group: "cup".into(),
            probed: true,
            disturbed: false,
        }),
        recorded(&GraspScene {
            grasp_id: 11,
            candidate: 42,
            object_position_m: [0.1, 0.2, 0.3],
            object_rotation_xyzw: [0.0, 0.6, 0.0, 0.8],
            centre_of_mass_m: [0.0, 0.0, 0.05],
            max_radius_m: 0.07,
            mass_kg: 0.5,
            friction: 0.8,
            joints: vec![0.25, -0.5],
            self_collision: true,
            contacts: vec![scene_contact; 2],
        }),
    ]
}

#[test]
fn every_message_has_the_shapes_that_it_always_had() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("golden.json");
    let found = shapes();
    if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
        let mut text = Vec::new();
        let formatter = serde_json::ser::PrettyFormatter::with_indent(b" ");
        let mut to_text = serde_json::Serializer::with_formatter(&mut text, formatter);
        serde::Serialize::serialize(&found, &mut to_text).expect("JSON");
        std::fs::write(&path, [&text[..], b"\n"].concat()).expect("written");
    }
    let golden = std::fs::read_to_string(&path).expect("golden.json");
    let golden: Vec<Map<String, Value>> = serde_json::from_str(&golden).expect("JSON");
    assert_eq!(found.len(), golden.len());
    for (found, golden) in found.iter().zip(&golden) {
        for (shape, golden) in golden {
            assert_eq!(found.get(shape), Some(golden), "{shape} of {}", found["type_name"]);
        }
    }
}

#[test]
fn the_list_has_every_type_once() {
    let mut type_names = of_each_type!(type_name);
    assert_eq!(type_names.iter().filter(|name| MESSAGE_TYPES.contains(name)).count(), MESSAGE_TYPES.len());
    assert_eq!(type_names.len(), shapes().len());
    type_names.sort_unstable();
    assert!(type_names.windows(2).all(|pair| pair[0] != pair[1]));
}

fn type_name<M: Recorded>() -> &'static str {
    M::TYPE_NAME
}

#[test]
fn the_lists_of_a_frame_are_found_and_can_be_changed() {
    let frame = TactileFrame {
        joints: vec![0.25, -0.5],
        cells_newtons: vec![1.5, 2.5],
        senses: OwnedSenses::default().with(Sense::JointTorques, &[0.75, 1.0]).with(Sense::Gravity, &[0.0, 0.0, 9.75]),
        ..TactileFrame::default()
    };
    let (head, mut items) = frame.to_parts(Header::default());
    assert_eq!(items, [0.25, -0.5, 0.0, 0.0, 9.75, 0.75, 1.0, 1.5, 2.5]);
    assert_eq!(head.joints(&items), Ok(&[0.25, -0.5][..]));
    assert_eq!(head.senses(&items), Ok(frame.senses.view()));
    let lists: Vec<_> = frame.senses.view().iter().map(|(_, values)| values).collect();
    assert_eq!(lists, [&[0.0, 0.0, 9.75][..], &[], &[0.75, 1.0]]);
    let parts = head.split_mut(&mut items).expect("a frame");
    parts.joints[0] = 0.5;
    assert_eq!(parts.senses.get(Sense::JointTorques), [0.75, 1.0]);
    head.cells_mut(&mut items).expect("a frame").fill(0.0);
    assert_eq!(items, [0.5, -0.5, 0.0, 0.0, 9.75, 0.75, 1.0, 0.0, 0.0]);
    assert_eq!(frame.senses.clone().with(Sense::Gravity, &[]).get(Sense::JointTorques), [0.75, 1.0]);
}

#[test]
fn senses_that_cannot_be_are_refused() {
    let short = TactileFrame { senses: OwnedSenses::default().with(Sense::Gravity, &[1.0]), ..Default::default() };
    let error = short.check().expect_err("one value").to_string();
    assert_eq!(error, "gravity_m_per_s2 has length 1, expected 0 or 3");
    let (head, items) = short.to_parts(Header::default());
    let error = head.split(&items).expect_err("one value").to_string();
    assert_eq!(error, "has_senses has the unknown code 4294967295");
    let head = TactileFrameHead { n_joints: 2, has_senses: Sense::JointTorques.bit(), ..Default::default() };
    let error = head.split(&[0.0; 3]).expect_err("one torque").to_string();
    assert_eq!(error, "the senses' list has length 2, expected 0 to 1");
}

#[test]
fn unknown_codes_and_lengths_that_cannot_be_are_refused() {
    let (mut head, items) =
        TactileFrame { joints: vec![0.5; 3], ..TactileFrame::default() }.to_parts(Header::default());
    head.n_joints = 4;
    let error = TactileFrame::from_parts(&head, &items).expect_err("more joints than items").to_string();
    assert_eq!(error, "joints has length 4, expected 0 to 3");
    let (mut head, items) = Prediction::default().to_parts(Header::default());
    head.stable = 2;
    let error = Prediction::from_parts(&head, &items).expect_err("neither yes nor no").to_string();
    assert_eq!(error, "stable has the unknown code 2");
    let (head, mut items) = GraspTruth { object: "ü".into(), ..GraspTruth::default() }.to_parts(Header::default());
    items[0] = 0xff;
    let error = GraspTruth::from_parts(&head, &items).expect_err("no text").to_string();
    assert_eq!(error, "object is not UTF-8");
    let long = GraspTruth { object_class: "a".repeat(MAX_NAME_BYTES + 1), ..GraspTruth::default() };
    assert_eq!(long.check().expect_err("too long").to_string(), "object_class has length 65, expected 0 to 64");
}

fn described<M: Recorded>() -> (&'static str, String) {
    (M::SCHEMA, M::definition())
}

/// The package of messages for ROS 2 has the definitions of this version. With BLINDGRASP_REMAKE the files are written.
#[test]
fn the_package_of_messages_is_that_of_this_version() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/blindgrasp_msgs/msg");
    let line = format!("{}\nMSG: blindgrasp_msgs/", "=".repeat(80));
    let mut names = BTreeSet::from(["Decision".to_owned()]);
    for (schema, definition) in of_each_type!(described) {
        let own = schema.rsplit('/').next().unwrap_or_default();
        for section in format!("{own}\n{definition}").split(&line) {
            let (name, fields) = section.split_once('\n').expect("a name and fields");
            let path = folder.join(format!("{name}.msg"));
            if std::env::var_os("BLINDGRASP_REMAKE").is_some() {
                std::fs::write(&path, fields).expect("written");
            }
            assert_eq!(std::fs::read_to_string(&path).expect("readable"), fields, "{}", path.display());
            names.insert(name.to_owned());
        }
    }
    assert_eq!(std::fs::read_dir(folder).expect("a folder").count(), names.len());
}
