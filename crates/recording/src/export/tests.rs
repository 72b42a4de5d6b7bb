use std::collections::{BTreeMap, BTreeSet};

use super::*;
use crate::tests::{info, records};
use crate::{Record, RecordingWriter};
use blindgrasp_messages::{
    Contact, ContactSet, Fault, GraspFeature, GraspScene, GraspTruth, Header, Phase, Prediction, SceneContact, Stamped,
    TactileFrame,
};

fn stamped<M>(seq: u64, message: M) -> Stamped<M> {
    Stamped {
        header: Header {
            seq,
            stamp_nanos: seq.wrapping_mul(10),
            epoch: 3,
            hand_id: 0xab,
            origin_nanos: 7,
            ..Header::default()
        },
        message,
    }
}

/// The shape of a topic that holds these, by way of a recording.
fn shape(records: &[Record]) -> TableShape {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("some.mcap");
    let mut writer = RecordingWriter::create(&path, &info()).expect("created");
    for record in records {
        writer.write_record("/some", record).expect("written");
    }
    writer.finish().expect("finished");
    table_shapes(&path, &[]).expect("read").remove("/some").expect("the topic")
}

fn csv_of(records: &[Record]) -> String {
    let mut table = CsvTable::new(Vec::new(), &shape(records)).expect("begun");
    for record in records {
        table.write(&row(record).expect("a row")).expect("written");
    }
    String::from_utf8(table.finish().expect("finished")).expect("UTF-8")
}

fn contact_sets() -> Vec<Record> {
    let contact =
        |force_newtons, pad| Contact { position_m: [0.5, -1.0, 1e-9], force_newtons, pad, ..Contact::default() };
    let set = |seq, contacts, fault| {
        let joints = vec![0.1 + 0.2, f64::NAN];
        Record::Contacts(stamped(seq, ContactSet { joints, contacts, fault, ..ContactSet::default() }))
    };
    vec![
        set(0, vec![], Fault::NoContact),
        set(1, vec![contact(2.5, 1), contact(f64::INFINITY, u32::MAX)], Fault::None),
        set(2, vec![contact(1.0, 2)], Fault::None),
    ]
}

#[test]
fn every_type_has_its_fields_as_columns() {
    for (_, record) in records() {
        let found = row(&record).expect("a row");
        let names: Vec<_> = found.iter().map(|(name, _)| *name).collect();
        assert_eq!(names[..4], ["seq", "stamp_nanos", "epoch", "hand_id"], "{}", record.type_name());
        assert_eq!(names.iter().collect::<BTreeSet<_>>().len(), names.len(), "{names:?}");
        // JSON has the same fields.
        let json = record.to_json().expect("JSON");
        let fields: BTreeMap<_, _> = names[4..].iter().map(|name| (*name, &json[*name])).collect();
        assert_eq!(json.as_object().expect("an object").len(), fields.len());
    }
}

#[test]
fn every_value_of_a_message_has_its_path() {
    let contact = Contact { position_m: [0.1, -0.0, f64::NAN], pad: 3, ..Contact::default() };
    let message = ContactSet {
        grasp_id: 7,
        phase: Phase::Settled,
        joints: vec![],
        contacts: vec![Contact::default(), contact],
        self_collision: true,
        fault: Fault::NoContact,
        ..ContactSet::default()
    };
    let found = leaves(&Record::Contacts(stamped(0, message))).expect("leaves");
    let shown: Vec<String> = found.iter().map(|(path, leaf)| format!("{path}={leaf}")).collect();
    let expected = [
        "grasp_id=7",
        "phase=settled",
        "contacts[1].position_m[0]=0.1",
        "contacts[1].position_m[1]=-0.0",
        "contacts[1].position_m[2]=NaN",
        "contacts[1].pad=3",
        "self_collision=true",
        "fault=no_contact",
    ];
    for line in expected {
        assert!(shown.iter().any(|shown| shown == line), "{line} in {shown:?}");
    }
    // Two numbers, then nine for each contact, then five.
    assert_eq!(shown.len(), 2 + 2 * 9 + 5);

    let mut scene = GraspScene::default();
    scene.contacts.push(SceneContact { other_link: -1, ..SceneContact::default() });
    let found = leaves(&Record::Scene(stamped(0, scene))).expect("leaves");
    assert!(found.contains(&("contacts[0].other_link".into(), Value::Signed(-1))), "{found:?}");
}

#[test]
fn a_row_has_words_and_identities_as_json_has() {
    let feature = GraspFeature { phase: Phase::Settled, dictionary_id: 0x1f, ..GraspFeature::default() };
    let found = row(&Record::Feature(stamped(5, feature))).expect("a row");
    let text = |text: &str| Value::Text(text.into());
    let expected = [
        ("seq", Value::Unsigned(5)),
        ("stamp_nanos", Value::Unsigned(50)),
        ("epoch", Value::Unsigned(3)),
        ("hand_id", text("00000000000000ab")),
        ("grasp_id", Value::Unsigned(0)),
        ("phase", text("settled")),
        ("values", Value::List(vec![])),
        ("n_pads_in_contact", Value::Unsigned(0)),
        ("dictionary_id", text("000000000000001f")),
        ("fault", text("none")),
        ("day", Value::Unsigned(0)),
    ];
    assert_eq!(found, expected);
}

#[test]
fn csv_has_a_column_per_number_where_lists_are_equally_long_and_json_elsewhere() {
    let found = csv_of(&contact_sets()[..2]);
    let contact = |force: &str, pad: u32| {
        format!(
            "{{\"\"position_m\"\":[0.5,-1.0,1e-9],\"\"normal\"\":[0.0,0.0,0.0],\"\"force_newtons\"\":{force},\
             \"\"pad\"\":{pad},\"\"cell\"\":0}}"
        )
    };
    let expected = [
        "seq,stamp_nanos,epoch,hand_id,grasp_id,phase,joints[0],joints[1],contacts,n_pads_in_contact,\
         self_collision,n_self_contacts,fault,gravity_m_per_s2,wrist_wrench,joint_torques,day"
            .to_string(),
        "0,0,3,00000000000000ab,0,open,0.30000000000000004,NaN,[],0,false,0,no_contact,[],[],[],0".into(),
        format!(
            "1,10,3,00000000000000ab,0,open,0.30000000000000004,NaN,\"[{},{}]\",0,false,0,none,[],[],[],0",
            contact("2.5", 1),
            contact("null", u32::MAX)
        ),
    ];
    assert_eq!(found.lines().collect::<Vec<_>>(), expected);
}

#[test]
fn csv_keeps_lists_that_vary_or_are_empty_and_what_numbers_and_names_may_be() {
    let frame = |cells_newtons| {
        let joints = vec![-f64::INFINITY, 1e300];
        Record::Tactile(stamped(
            u64::MAX,
            TactileFrame { grasp_id: u64::MAX, joints, cells_newtons, ..Default::default() },
        ))
    };
    let found = csv_of(&[frame(vec![-0.0]), frame(vec![1.0, f64::NAN])]);
    let start = format!("{0},{1},3,00000000000000ab,{0},open,-inf,1e300", u64::MAX, u64::MAX.wrapping_mul(10));
    assert_eq!(found.lines().nth(1), Some(format!("{start},[-0.0],[],[],[],0").as_str()));
    assert_eq!(found.lines().nth(2), Some(format!("{start},\"[1.0,null]\",[],[],[],0").as_str()));
    let found = csv_of(&[frame(vec![]), frame(vec![])]);
    let no_cells = |line: &str| line.contains(",cells_newtons,") || line.ends_with(",[],[],[],[],0");
    assert!(found.lines().all(no_cells), "{found}");

    let truth =
        GraspTruth { object: "a \"mug\", blue".into(), object_class: "tassé\nlong".into(), ..GraspTruth::default() };
    let found = csv_of(&[Record::Truth(stamped(0, truth))]);
    assert!(found.ends_with(",0.0,0.0,false,\"a \"\"mug\"\", blue\",\"tassé\nlong\"\n"), "{found}");
}

#[test]
fn a_row_of_another_type_is_refused() {
    let prediction = Record::Prediction(stamped(0, Prediction::default()));
    let other = row(&Record::Truth(stamped(0, GraspTruth::default()))).expect("a row");
    let mut table = CsvTable::new(Vec::new(), &shape(&[prediction])).expect("begun");
    assert!(matches!(table.write(&other), Err(ExportError::Shape(_))));
}
