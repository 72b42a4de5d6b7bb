//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::OnceLock;

use cdr_encoding::{from_bytes, to_writer};

use super::Record;
use super::schema::{definition, earlier_definition};
use blindgrasp_messages::{
    ContactSet, GraspFeature, GraspScene, GraspTruth, LiftDecision, LiftOutcome, Prediction, Recorded, RegraspAdvice,
    Stamped, TactileFrame,
};

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
pub(super) const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// How our messages are encoded, and how their definitions are, in MCAP's words.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";

/// Makes a sample of a recorded message.
pub(super) type Decode = fn(&[u8]) -> Result<Record, String>;

/// One of our message types.
pub(super) struct OurType {
    /// The ROS name, e.g. `blindgrasp_msgs/msg/TactileFrame`.
    pub(super) schema: String,
    /// With those of the messages it is made of.
    pub(super) definition: String,
    /// Of an earlier version whose messages are read as they are.
    pub(super) earlier_definition: Option<String>,
    pub(super) decode: Decode,
}

/// The type whose ROS name this is, if it is ours.
pub(super) fn our_type(schema: &str) -> Option<&'static OurType> {
    our_types().iter().find(|ours| ours.schema == schema)
}

/// The type of a sample.
pub(super) fn type_of(record: &Record) -> &'static OurType {
    &our_types()[match record {
        Record::Tactile(_) => 0,
        Record::Contacts(_) => 1,
        Record::Histogram(_) => 2,
        Record::Prediction(_) => 3,
        Record::Decision(_) => 4,
        Record::Truth(_) => 5,
        Record::Outcome(_) => 7,
        Record::Scene(_) => 6,
        Record::Advice(_) => 8,
    }]
}

/// The ROS name of a message type, e.g. `blindgrasp_msgs/msg/TactileFrame` for `blindgrasp/TactileFrame/2`.
pub(super) fn schema_name<M: Recorded>() -> String {
    format!("blindgrasp_msgs/msg/{}", M::TYPE_NAME.split('/').nth(1).unwrap_or(M::TYPE_NAME))
}

/// Puts a sample of any type into `data`, in place of what was there.
pub(super) fn encode_record(record: &Record, data: &mut Vec<u8>) -> Result<(), String> {
    match record {
        Record::Tactile(sample) => encode(sample, data),
        Record::Contacts(sample) => encode(sample, data),
        Record::Histogram(sample) => encode(sample, data),
        Record::Prediction(sample) => encode(sample, data),
        Record::Decision(sample) => encode(sample, data),
        Record::Truth(sample) => encode(sample, data),
        Record::Outcome(sample) => encode(sample, data),
        Record::Advice(sample) => encode(sample, data),
        Record::Scene(sample) => encode(sample, data),
    }
}

/// Puts a sample into `data`, in place of what was there.
pub(super) fn encode<M: Recorded>(sample: &Stamped<M>, data: &mut Vec<u8>) -> Result<(), String> {
    data.clear();
    data.extend(CDR_LITTLE_ENDIAN);
    to_writer::<_, byteorder::LittleEndian, _>(data, sample).map_err(|error| error.to_string())
}

fn our_types() -> &'static [OurType; 9] {
    static TYPES: OnceLock<[OurType; 9]> = OnceLock::new();
    TYPES.get_or_init(|| {
        [
            our::<TactileFrame>(|data| decode(data).map(Record::Tactile)),
            our::<ContactSet>(|data| decode(data).map(Record::Contacts)),
            our::<GraspFeature>(|data| decode(data).map(Record::Histogram)),
            our::<Prediction>(|data| decode(data).map(Record::Prediction)),
            our::<LiftDecision>(|data| decode(data).map(Record::Decision)),
            our::<GraspTruth>(|data| decode(data).map(Record::Truth)),
            our::<GraspScene>(|data| decode(data).map(Record::Scene)),
            our::<LiftOutcome>(|data| decode(data).map(Record::Outcome)),
            our::<RegraspAdvice>(|data| decode(data).map(Record::Advice)),
        ]
    })
}

fn our<M: Recorded>(decode: Decode) -> OurType {
    let earlier_definition = earlier_definition::<M>();
    OurType { schema: schema_name::<M>(), definition: definition::<M>(), earlier_definition, decode }
}

fn decode<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
    let body = data.strip_prefix(&CDR_LITTLE_ENDIAN[..]).ok_or("expected little-endian CDR")?;
    let (sample, n_bytes) = from_bytes::<Stamped<M>, byteorder::LittleEndian>(body)
        .map_err(|error| format!("not a {}: {error}", M::TYPE_NAME))?;
    if n_bytes != body.len() {
        return Err(format!("{} bytes too many for a {}", body.len() - n_bytes, M::TYPE_NAME));
    }
    sample.message.check().map_err(|error| error.to_string())?;
    Ok(sample)
}

#[cfg(test)]
mod tests {
    use serde::Serialize;

    use super::super::schema::first_difference;
    use super::*;
    use blindgrasp_messages::Header;

    /// A [`LiftOutcome`] as it was before it had `advised`.
    #[derive(Serialize)]
    struct EarlierOutcome {
        header: Header,
        grasp_id: u64,
        trial: u64,
        attempt: u32,
        lifted: bool,
        held: bool,
        has_quality: bool,
        numbers: [f64; 6],
        thing: String,
        group: String,
    }

    #[test]
    fn outcomes_of_an_earlier_version_are_read_as_not_advised() {
        let earlier = EarlierOutcome {
            header: Header { seq: 3, ..Header::default() },
            grasp_id: 3,
            trial: 1,
            attempt: 2,
            lifted: true,
            held: true,
            has_quality: true,
            numbers: [0.001, 0.5, 0.1, 0.2, 0.3, 0.9],
            thing: "rock".into(),
            group: "stone".into(),
        };
        let mut data = CDR_LITTLE_ENDIAN.to_vec();
        to_writer::<_, byteorder::LittleEndian, _>(&mut data, &earlier).expect("encoded");
        let found: Stamped<LiftOutcome> = decode(&data).expect("decoded");
        let expected = LiftOutcome {
            grasp_id: 3,
            trial: 1,
            attempt: 2,
            lifted: true,
            held: true,
            has_quality: true,
            advised: false,
            slip_m: 0.001,
            turn_rad: 0.5,
            epsilon: 0.1,
            volume: 0.2,
            mass_kg: 0.3,
            friction: 0.9,
            thing: "rock".into(),
            group: "stone".into(),
        };
        assert_eq!(found, Stamped { header: earlier.header, message: expected });
        let ours = our_type("blindgrasp_msgs/msg/LiftOutcome").expect("a type");
        let earlier = ours.earlier_definition.as_ref().expect("an earlier definition");
        assert_eq!(first_difference(earlier, &ours.definition).map(|(_, ours)| ours), Some("bool advised".into()));
    }
}
