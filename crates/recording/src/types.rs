//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::LazyLock;

use cdr_encoding::{from_bytes, to_writer};
use serde::Serialize;

use blindgrasp_messages::{
    ContactSet, GraspTruth, Header, Record, Recorded, Sense, Stamped, TactileFrame, of_each_type,
};

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// How data that zstd has compressed begin.
const ZSTD_BEGIN: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// The fault of messages that rosbag2 has compressed one by one. They are whole, so that a repair changes nothing.
pub(super) const COMPRESSED: &str = "each message is compressed by itself (--compression-mode message), which MCAP does not know: \
                                     write the bag anew with ros2 bag convert and without compression_mode";
/// How messages and their definitions are encoded, in MCAP's words.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";

/// One of our message types, as it is or as an earlier version had it: its definition, and what makes samples of recorded
/// messages.
#[derive(Debug)]
pub(super) struct OurType {
    /// Its name as a schema.
    pub(super) schema: &'static str,
    pub(super) definition: String,
    decode: fn(&[u8]) -> Result<Record, String>,
    /// The number of senses at the end of their table that its messages lack.
    n_senses_lacking: usize,
}

impl OurType {
    pub(super) fn decode(&self, data: &[u8]) -> Result<Record, String> {
        if self.n_senses_lacking == 0 {
            return (self.decode)(data);
        }
        // An empty list is its length, 0. Behind the senses is the day.
        let (before, day) = data.split_at(data.len().saturating_sub(size_of::<u32>()));
        (self.decode)(&[before, &vec![0; size_of::<u32>() * self.n_senses_lacking], day].concat())
    }

    /// Reads the header and the grasp's number, with which every message of ours begins.
    pub(super) fn decode_start(&self, data: &[u8]) -> Result<(Header, u64), String> {
        let start = from_bytes::<(Header, u64), byteorder::LittleEndian>(body(data)?);
        start.map(|(start, _)| start).map_err(|error| format!("not a {}: {error}", self.schema))
    }
}

/// Our type of this ROS name, if there is one, and then its earlier versions.
pub(super) fn our_types(schema: &str) -> impl Iterator<Item = &'static OurType> {
    static TYPES: LazyLock<Vec<OurType>> = LazyLock::new(|| of_each_type!(ours).into_iter().flatten().collect());
    TYPES.iter().filter(move |ours| ours.schema == schema)
}

fn ours<M: Recorded>() -> Vec<OurType> {
    let version = |definition: &str, n_senses_lacking| OurType {
        schema: M::SCHEMA,
        definition: definition.into(),
        decode: |data| decode::<M>(data).map(M::record),
        n_senses_lacking,
    };
    let mut definition = M::definition();
    let mut versions = vec![version(&definition, 0)];
    if [TactileFrame::SCHEMA, ContactSet::SCHEMA].contains(&M::SCHEMA) {
        for (idx, sense) in Sense::ALL.iter().rev().enumerate() {
            definition = definition.replace(&format!("float64[] {}\n", sense.name()), "");
            versions.push(version(&definition, idx + 1));
        }
    }
    if M::SCHEMA == GraspTruth::SCHEMA {
        // The field had a name that no ROS 2 package may have. Its bytes are the same.
        versions.push(version(&definition.replace("string object_class\n", "string class\n"), 0));
    }
    versions
}

/// Puts a message, or anything else, into `data` as CDR, in place of what was there.
///
/// # Errors
/// A value that CDR does not have.
pub fn encode(value: &impl Serialize, data: &mut Vec<u8>) -> Result<(), String> {
    data.clear();
    data.extend(CDR_LITTLE_ENDIAN);
    to_writer::<_, byteorder::LittleEndian, _>(data, value).map_err(|error| error.to_string())
}

fn body(data: &[u8]) -> Result<&[u8], String> {
    if data.starts_with(&ZSTD_BEGIN) {
        return Err(COMPRESSED.into());
    }
    data.strip_prefix(&CDR_LITTLE_ENDIAN[..]).ok_or_else(|| "expected little-endian CDR".into())
}

/// Reads a message of the package `blindgrasp_msgs`.
///
/// # Errors
/// Why it is no such message, for a person.
pub fn decode<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
    let body = body(data)?;
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
    use super::*;
    use blindgrasp_messages::{OwnedSenses, Phase};

    #[test]
    fn a_message_is_read_whole_or_refused() {
        let message = TactileFrame {
            grasp_id: 7,
            phase: Phase::Settled,
            joints: vec![0.5, 0.25],
            cells_newtons: vec![1.0, 0.0, 2.0],
            ..TactileFrame::default()
        };
        let sample = Stamped { header: Header { seq: 3, ..Header::default() }, message };
        let mut data = Vec::new();
        encode(&sample, &mut data).expect("encoded");
        let ours = our_types(TactileFrame::SCHEMA).next().expect("a type");
        assert_eq!(ours.decode(&data), Ok(sample.into()));
        for n_bytes in 0..data.len() {
            ours.decode(&data[..n_bytes]).expect_err("cut off");
        }
        data.push(0);
        ours.decode(&data).expect_err("a byte too many");
    }

    #[test]
    fn labels_with_the_earlier_name_of_the_class_are_read() {
        let earlier = our_types(GraspTruth::SCHEMA).nth(1).expect("an earlier version");
        assert!(earlier.definition.contains("string class\n") && !earlier.definition.contains("object_class"));
        let message = GraspTruth { object_class: "cup".into(), ..GraspTruth::default() };
        let sample = Stamped { header: Header::default(), message };
        let mut data = Vec::new();
        encode(&sample, &mut data).expect("encoded");
        assert_eq!(earlier.decode(&data), Ok(sample.into()));
    }

    #[test]
    fn frames_from_before_the_last_sense_lack_it() {
        let [first, .., last] = Sense::ALL;
        let message = TactileFrame {
            grasp_id: 7,
            joints: vec![0.5],
            cells_newtons: vec![1.0, 0.0],
            senses: OwnedSenses::default().with(first, &vec![-9.75; first.len(1)]),
            day: 20_261_124,
            ..TactileFrame::default()
        };
        let sample = Stamped { header: Header { seq: 3, ..Header::default() }, message };
        let mut data = Vec::new();
        encode(&sample, &mut data).expect("encoded");
        // The length of the last sense, before the day.
        data.drain(data.len() - 8..data.len() - 4);
        let before_it = our_types(TactileFrame::SCHEMA).nth(1).expect("an earlier version");
        assert!(before_it.definition.contains(first.name()) && !before_it.definition.contains(last.name()));
        assert_eq!(before_it.decode(&data), Ok(sample.into()));
        before_it.decode(&data[..data.len() - 1]).expect_err("cut off");
    }
}
