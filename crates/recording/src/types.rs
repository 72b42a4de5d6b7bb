//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::LazyLock;

use cdr_encoding::{from_bytes, to_writer};
use serde::Serialize;

use blindgrasp_messages::{Header, Record, Recorded, Stamped, of_each_type};

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// How messages and their definitions are encoded, in MCAP's words.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";

/// One of our message types: its definition, and what makes samples of recorded messages.
#[derive(Debug)]
pub(super) struct OurType {
    /// Its name as a schema.
    pub(super) schema: &'static str,
    pub(super) definition: String,
    decode: fn(&[u8]) -> Result<Record, String>,
}

impl OurType {
    pub(super) fn decode(&self, data: &[u8]) -> Result<Record, String> {
        (self.decode)(data)
    }

    /// Reads the header and the grasp's number, with which every message of ours begins.
    pub(super) fn decode_start(&self, data: &[u8]) -> Result<(Header, u64), String> {
        let start = from_bytes::<(Header, u64), byteorder::LittleEndian>(body(data)?);
        start.map(|(start, _)| start).map_err(|error| format!("not a {}: {error}", self.schema))
    }
}

/// The type of this ROS name, if it is ours.
pub(super) fn our_type(schema: &str) -> Option<&'static OurType> {
    static TYPES: LazyLock<Vec<OurType>> = LazyLock::new(|| of_each_type!(our).into());
    TYPES.iter().find(|ours| ours.schema == schema)
}

fn our<M: Recorded>() -> OurType {
    OurType { schema: M::SCHEMA, definition: M::definition(), decode: |data| decode::<M>(data).map(M::record) }
}

/// Puts a message, or anything else, into `data` as CDR, in place of what was there.
pub(super) fn encode(value: &impl Serialize, data: &mut Vec<u8>) -> Result<(), String> {
    data.clear();
    data.extend(CDR_LITTLE_ENDIAN);
    to_writer::<_, byteorder::LittleEndian, _>(data, value).map_err(|error| error.to_string())
}

fn body(data: &[u8]) -> Result<&[u8], String> {
    data.strip_prefix(&CDR_LITTLE_ENDIAN[..]).ok_or_else(|| "expected little-endian CDR".into())
}

pub(super) fn decode<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
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
    use blindgrasp_messages::{Phase, TactileFrame};

    #[test]
    fn a_message_is_read_whole_or_refused() {
        let message = TactileFrame {
            grasp_id: 7,
            phase: Phase::Settled,
            joints_rad: vec![0.5, 0.25],
            cells_newtons: vec![1.0, 0.0, 2.0],
            ..TactileFrame::default()
        };
        let sample = Stamped { header: Header { seq: 3, ..Header::default() }, message };
        let mut data = Vec::new();
        encode(&sample, &mut data).expect("encoded");
        let ours = our_type(TactileFrame::SCHEMA).expect("a type");
        assert_eq!(ours.decode(&data), Ok(sample.into()));
        for n_bytes in 0..data.len() {
            ours.decode(&data[..n_bytes]).expect_err("cut off");
        }
        data.push(0);
        ours.decode(&data).expect_err("a byte too many");
    }
}
