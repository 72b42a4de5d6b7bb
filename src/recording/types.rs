//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::OnceLock;

use cdr_encoding::{from_bytes, to_writer};

use super::Record;
use super::schema::definition;
use crate::message::{
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
    OurType { schema: schema_name::<M>(), definition: definition::<M>(), decode }
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
