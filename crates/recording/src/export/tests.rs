use std::collections::{BTreeMap, BTreeSet};

use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;

use super::row::exemplar_row;
use super::*;
use crate::{Record, RecordingInfo, RecordingWriter};
use blindgrasp_messages::{
    Contact, ContactSet, Fault, GraspFeature, GraspScene, GraspTruth, Header, LiftDecision, LiftOutcome, Phase,
    Prediction, RegraspAdvice, Stamped, TactileFrame,
};

fn stamped<M>(seq: u64, message: M) -> Stamped<M> {
    Stamped {
        header: Header { seq, stamp_nanos: seq.wrapping_mul(10), epoch: 3, hand_id: 0xab, origin_nanos: 7 },
        message,
    }
}

fn of_each_type() -> Vec<Record> {
    vec![
        Record::Tactile(stamped(0, TactileFrame::default())),
        Record::Contacts(stamped(0, ContactSet::default())),
        Record::Feature(stamped(0, GraspFeature::default())),
        Record::Prediction(stamped(0, Prediction::default())),
        Record::Decision(stamped(0, LiftDecision::default())),
        Record::Truth(stamped(0, GraspTruth::default())),
        Record::Outcome(stamped(0, LiftOutcome::default())),
        Record::Advice(stamped(0, RegraspAdvice::default())),
        Record::Scene(stamped(0, GraspScene::default())),
    ]
}

/// The shape of a topic that holds these, by way of a recording.
fn shape(records: &[Record]) -> TableShape {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("some.mcap");
    let info = RecordingInfo { hand: "h".into(), hand_id: 0xab, made_by: "a test".into(), version: "0".into() };
    let mut writer = RecordingWriter::create(&path, &info).expect("created");
    for record in records {
        writer.write_record("/some", record).expect("written");
    }
    writer.finish().expect("finished");
    survey(&path, &[]).expect("surveyed").remove("/some").expect("the topic")
}

fn csv_of(records: &[Record]) -> String {
    let mut table = CsvTable::new(Vec::new(), &shape(records)).expect("begun");
    for record in records {
        table.write(&row(record).expect("a row")).expect("written");
    }
    String::from_utf8(table.finish().expect("finished")).expect("UTF-8")
}

fn parquet_of(records: &[Record]) -> SerializedFileReader<std::fs::File> {
    let mut table = ParquetTable::new(tempfile::tempfile().expect("a file"), &shape(records)).expect("begun");
    for record in records {
        table.write(&row(record).expect("a row")).expect("written");
    }
    SerializedFileReader::new(table.finish().expect("finished")).expect("a Parquet file")
}

fn contact_sets() -> Vec<Record> {
    let contact =
        |force_newtons, pad| Contact { position_m: [0.5, -1.0, 1e-9], force_newtons, pad, ..Contact::default() };
    let set = |seq, contacts, fault| {
        let joints_rad = vec![0.1 + 0.2, f64::NAN];
        Record::Contacts(stamped(seq, ContactSet { joints_rad, contacts, fault, ..ContactSet::default() }))
    };
    vec![
        set(0, vec![], Fault::NoContact),
        set(1, vec![contact(2.5, 1), contact(f64::INFINITY, u32::MAX)], Fault::None),
        set(2, vec![contact(1.0, 2)], Fault::None),
    ]
}

#[test]
fn every_type_has_columns_even_of_lists_that_are_empty() {
    for record in of_each_type() {
        let (found, exemplar) = (row(&record).expect("a row"), exemplar_row(&record).expect("an exemplar"));
        let names: Vec<_> = exemplar.iter().map(|(name, _)| *name).collect();
        assert_eq!(names[..4], ["seq", "stamp_nanos", "epoch", "hand_id"], "{}", type_name(&record));
        assert_eq!(names, found.iter().map(|(name, _)| *name).collect::<Vec<_>>());
        assert_eq!(names.iter().collect::<BTreeSet<_>>().len(), names.len(), "{names:?}");
        // What JSON says of the message, and no less.
        let json = record.to_json().expect("JSON");
        let fields: BTreeMap<_, _> = names[4..].iter().map(|name| (*name, &json[*name])).collect();
        assert!(fields.values().all(|value| !value.is_null() || json.is_null()), "{fields:?}");
        assert_eq!(json.as_object().expect("an object").len(), fields.len());
        for (name, value) in &exemplar {
            assert!(!matches!(value, Value::List(items) if items.is_empty()), "{name}");
        }
    }
    let contacts = exemplar_row(&of_each_type()[1]).expect("an exemplar");
    let (_, Value::List(contacts)) = &contacts[7] else { panic!("{contacts:?}") };
    let Value::Struct(fields) = &contacts[0] else { panic!("{contacts:?}") };
    let zeros = Value::List(vec![Value::F64(0.0); 3]);
    let expected = [
        ("position_m", zeros.clone()),
        ("normal", zeros),
        ("force_newtons", Value::F64(0.0)),
        ("pad", Value::U32(0)),
        ("cell", Value::U32(0)),
    ];
    assert_eq!(fields[..], expected);
}

#[test]
fn a_row_has_words_and_identities_as_json_has() {
    let feature = GraspFeature { phase: Phase::Settled, dictionary_id: 0x1f, ..GraspFeature::default() };
    let found = row(&Record::Feature(stamped(5, feature))).expect("a row");
    let text = |text: &str| Value::Text(text.into());
    let expected = [
        ("seq", Value::U64(5)),
        ("stamp_nanos", Value::U64(50)),
        ("epoch", Value::U64(3)),
        ("hand_id", text("00000000000000ab")),
        ("grasp_id", Value::U64(0)),
        ("phase", text("settled")),
        ("values", Value::List(vec![])),
        ("n_pads_in_contact", Value::U32(0)),
        ("dictionary_id", text("000000000000001f")),
        ("fault", text("none")),
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
        "seq,stamp_nanos,epoch,hand_id,grasp_id,phase,joints_rad[0],joints_rad[1],contacts,n_pads_in_contact,\
         self_collision,n_self_contacts,fault"
            .to_string(),
        "0,0,3,00000000000000ab,0,open,0.30000000000000004,NaN,[],0,false,0,no_contact".into(),
        format!(
            "1,10,3,00000000000000ab,0,open,0.30000000000000004,NaN,\"[{},{}]\",0,false,0,none",
            contact("2.5", 1),
            contact("null", u32::MAX)
        ),
    ];
    assert_eq!(found.lines().collect::<Vec<_>>(), expected);
}

#[test]
fn csv_keeps_lists_that_vary_or_are_empty_and_what_numbers_and_names_may_be() {
    let frame = |cells_newtons| {
        let joints_rad = vec![-f64::INFINITY, 1e300];
        Record::Tactile(stamped(
            u64::MAX,
            TactileFrame { grasp_id: u64::MAX, joints_rad, cells_newtons, ..Default::default() },
        ))
    };
    let found = csv_of(&[frame(vec![-0.0]), frame(vec![1.0, f64::NAN])]);
    let start = format!("{0},{1},3,00000000000000ab,{0},open,-inf,1e300", u64::MAX, u64::MAX.wrapping_mul(10));
    assert_eq!(found.lines().nth(1), Some(format!("{start},[-0.0]").as_str()));
    assert_eq!(found.lines().nth(2), Some(format!("{start},\"[1.0,null]\"").as_str()));
    let found = csv_of(&[frame(vec![]), frame(vec![])]);
    assert!(found.lines().all(|line| line.ends_with(",cells_newtons") || line.ends_with(",[]")), "{found}");

    let truth = GraspTruth { object: "a \"mug\", blue".into(), class: "tassé\nlong".into(), ..GraspTruth::default() };
    let found = csv_of(&[Record::Truth(stamped(0, truth))]);
    assert!(found.ends_with(",0.0,0.0,false,\"a \"\"mug\"\", blue\",\"tassé\nlong\"\n"), "{found}");
}

#[test]
fn parquet_holds_nested_values_bit_by_bit() {
    let records = contact_sets();
    let reader = parquet_of(&records);
    let rows: Vec<_> = reader.get_row_iter(None).expect("rows").collect::<Result<_, _>>().expect("read");
    assert_eq!(rows.len(), 3);
    for (found, record) in rows.iter().zip(&records) {
        let Record::Contacts(sample) = record else { panic!("{record:?}") };
        assert_eq!(found.get_ulong(0).expect("seq"), sample.header.seq);
        assert_eq!(found.get_string(3).expect("hand_id"), "00000000000000ab");
        let joints = found.get_list(6).expect("joints");
        let joints: Vec<_> = joints.elements().iter().map(|joint| joint.to_string()).collect();
        assert_eq!(joints, ["0.30000000000000004", "NaN"]);
        let contacts = found.get_list(7).expect("contacts");
        assert_eq!(contacts.len(), sample.message.contacts.len());
        for (field, contact) in contacts.elements().iter().zip(&sample.message.contacts) {
            let parquet::record::Field::Group(of_contact) = field else { panic!("{field:?}") };
            assert_eq!(of_contact.get_double(2).expect("force").to_bits(), contact.force_newtons.to_bits());
            assert_eq!(of_contact.get_uint(3).expect("pad"), contact.pad);
            let position = of_contact.get_list(0).expect("position");
            let expected = contact.position_m.map(parquet::record::Field::Double);
            assert_eq!(position.elements(), expected);
        }
        assert_eq!(found.get_string(11).expect("fault"), sample.message.fault.as_str());
    }
}

#[test]
fn a_long_topic_becomes_several_row_groups() {
    let feature = |seq| {
        let values = (0..4096).map(|idx| (seq * 4096 + idx) as f64).collect();
        Record::Feature(stamped(seq, GraspFeature { values, ..GraspFeature::default() }))
    };
    // A value takes 12 bytes with its levels: 16 MiB are passed by 342 features of 4096.
    let reader = parquet_of(&(0..700).map(feature).collect::<Vec<_>>());
    let n_rows: Vec<_> = reader.metadata().row_groups().iter().map(|group| group.num_rows()).collect();
    assert_eq!(n_rows.iter().sum::<i64>(), 700);
    assert_eq!(n_rows.len(), 3, "{n_rows:?}");
    for (seq, found) in reader.get_row_iter(None).expect("rows").enumerate() {
        let found = found.expect("read");
        let values = found.get_list(6).expect("values");
        assert_eq!(found.get_ulong(0).expect("seq"), seq as u64);
        assert_eq!(values.elements()[4095], parquet::record::Field::Double((seq * 4096 + 4095) as f64));
    }
}

#[test]
fn a_row_of_another_type_is_refused() {
    let records = of_each_type();
    let other = row(&records[5]).expect("a row");
    let mut table = ParquetTable::new(Vec::new(), &shape(&records[3..4])).expect("begun");
    assert!(matches!(table.write(&other), Err(ExportError::Shape(_))));
    let mut table = CsvTable::new(Vec::new(), &shape(&records[3..4])).expect("begun");
    assert!(matches!(table.write(&other), Err(ExportError::Shape(_))));
}
