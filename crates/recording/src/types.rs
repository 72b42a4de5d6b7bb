//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::LazyLock;

use cdr_encoding::{from_bytes, to_writer};
use serde::Serialize;

use blindgrasp_messages::{
    ContactSet, GraspFeature, Header, LiftOutcome, Record, Recorded, Sense, Stamped, TactileFrame, of_each_type,
};

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// How messages and their definitions are encoded, in MCAP's words.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";

/// The topic of features in recordings of version 0.1 and before.
pub(super) const EARLIER_FEATURE_TOPIC: &str = "/histogram";

/// Makes samples of the recorded messages of a channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Decoder {
    /// The name of the messages' schema.
    pub(super) schema: &'static str,
    decode: fn(&[u8]) -> Result<Record, String>,
    lacking: Lacking,
}

/// The fields that a message lacks because an earlier version wrote it: their bytes, which are 0 or empty lists.
#[derive(Debug, Clone, Copy, Default)]
struct Lacking {
    n_bytes: usize,
    /// Bytes of the fields behind them.
    n_bytes_after: usize,
}

impl Decoder {
    pub(super) fn decode(self, data: &[u8]) -> Result<Record, String> {
        let Lacking { n_bytes, n_bytes_after } = self.lacking;
        if n_bytes == 0 {
            return (self.decode)(data);
        }
        let (before, after) = data.split_at(data.len().saturating_sub(n_bytes_after));
        (self.decode)(&[before, &vec![0; n_bytes], after].concat())
    }

    /// Reads the header and the grasp's number, with which every message of ours begins.
    pub(super) fn decode_start(self, data: &[u8]) -> Result<(Header, u64), String> {
        let start = from_bytes::<(Header, u64), byteorder::LittleEndian>(body(data)?);
        start.map(|(start, _)| start).map_err(|error| format!("not a {}: {error}", self.schema))
    }
}

/// One of our message types.
pub(super) struct OurType {
    schema: &'static str,
    pub(super) definition: String,
    decode: fn(&[u8]) -> Result<Record, String>,
    /// The definitions of earlier versions, each with what it lacks.
    earlier: Vec<(String, Lacking)>,
}

impl OurType {
    /// Reads messages of this version.
    pub(super) fn decoder(&self) -> Decoder {
        Decoder { schema: self.schema, decode: self.decode, lacking: Lacking::default() }
    }

    /// Reads messages of the earlier version whose definition `is_it`.
    pub(super) fn earlier_decoder(&self, is_it: impl Fn(&str) -> bool) -> Option<Decoder> {
        let (_, lacking) = self.earlier.iter().find(|(definition, _)| is_it(definition))?;
        Some(Decoder { schema: self.schema, decode: self.decode, lacking: *lacking })
    }
}

/// The type of this ROS name, if it is ours.
pub(super) fn our_type(schema: &str) -> Option<&'static OurType> {
    static TYPES: LazyLock<Vec<OurType>> = LazyLock::new(|| of_each_type!(our).into());
    TYPES.iter().find(|ours| ours.schema == schema)
}

fn our<M: Recorded>() -> OurType {
    let definition = M::definition();
    // The fields that earlier versions lacked, and their bytes.
    let mut earlier = Vec::new();
    let mut without = |fields: &[&str], n_bytes, n_bytes_after| {
        let remove = |text: String, field: &&str| text.replace(&format!("{field}\n"), "");
        earlier.push((fields.iter().fold(definition.clone(), remove), Lacking { n_bytes, n_bytes_after }));
    };
    match M::SCHEMA {
        LiftOutcome::SCHEMA => {
            // `advised` lies where messages without it have a byte of padding, which is 0.
            without(&["bool advised", "bool probed", "bool disturbed"], 2, 0);
            without(&["bool probed", "bool disturbed"], 2, 0);
        }
        TactileFrame::SCHEMA | ContactSet::SCHEMA => {
            let senses = Sense::ALL.map(|sense| format!("float64[] {}", sense.name()));
            let mut later: Vec<&str> = senses.iter().map(String::as_str).collect();
            // The last senses: an empty list is its length, and `day` follows.
            for n_senses in 0..later.len() {
                without(&later[n_senses..], 4 * (later.len() - n_senses), 4);
            }
            later.push("uint32 day");
            without(&later, 4 * later.len(), 0);
            without(&["uint32 day"], 4, 0);
        }
        GraspFeature::SCHEMA => without(&["uint32 day"], 4, 0),
        _ => {}
    }
    OurType {
        schema: M::SCHEMA,
        earlier,
        definition,
        decode: |data| decode::<M>(data).map(M::record),
    }
}

/// The topic as this version names it.
pub fn present_topic(topic: &str) -> &str {
    if topic == EARLIER_FEATURE_TOPIC { GraspFeature::TOPIC } else { topic }
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
    use serde::Serialize;

    use super::*;
    use blindgrasp_messages::{OwnedSenses, Phase, first_difference};

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
        let mut data = Vec::new();
        encode(&earlier, &mut data).expect("encoded");
        let ours = our_type("blindgrasp_msgs/msg/LiftOutcome").expect("a type");
        let (earliest, _) = &ours.earlier[0];
        assert_eq!(first_difference(earliest, &ours.definition).map(|(_, ours)| ours), Some("bool advised".into()));
        let found = ours.earlier_decoder(|definition| definition == earliest).expect("known").decode(&data);
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
            probed: false,
            disturbed: false,
        };
        assert_eq!(found, Ok(Stamped { header: earlier.header, message: expected }.into()));
    }

    /// A [`TactileFrame`] as it was before it had senses beside joints and cells.
    #[derive(Serialize)]
    struct EarlierFrame {
        header: Header,
        grasp_id: u64,
        phase: u32,
        joints_rad: Vec<f64>,
        cells_newtons: Vec<f64>,
    }

    #[test]
    fn frames_of_an_earlier_version_have_no_other_senses_and_are_whole_or_refused() {
        let (joints_rad, cells_newtons) = (vec![0.5, 0.25], vec![1.0, 0.0, 2.0]);
        let (header, phase) = (Header { seq: 3, ..Header::default() }, Phase::Settled);
        let earlier = EarlierFrame { header, grasp_id: 7, phase: 2, joints_rad, cells_newtons };
        let mut data = Vec::new();
        encode(&earlier, &mut data).expect("encoded");
        let ours = our_type(TactileFrame::SCHEMA).expect("a type");
        let decoder = ours.earlier_decoder(|definition| !definition.contains("gravity")).expect("known");
        let EarlierFrame { joints_rad, cells_newtons, .. } = earlier;
        let message = TactileFrame { grasp_id: 7, phase, joints_rad, cells_newtons, ..TactileFrame::default() };
        assert_eq!(decoder.decode(&data), Ok(Stamped { header, message }.into()));
        for n_bytes in 0..data.len() {
            decoder.decode(&data[..n_bytes]).expect_err("cut off");
        }
    }

    #[test]
    fn frames_from_before_the_last_sense_lack_it() {
        let [first, .., last] = Sense::ALL;
        let message = TactileFrame {
            grasp_id: 7,
            phase: Phase::Settled,
            joints_rad: vec![0.5],
            cells_newtons: vec![1.0, 0.0],
            senses: OwnedSenses::default().with(first, &vec![-9.75; first.len(1)]),
            day: 20_261_124,
        };
        let sample = Stamped { header: Header { seq: 3, ..Header::default() }, message };
        let mut data = Vec::new();
        encode(&sample, &mut data).expect("encoded");
        // The last sense is an empty list, and the day follows.
        data.drain(data.len() - 8..data.len() - 4);
        let ours = our_type(TactileFrame::SCHEMA).expect("a type");
        let before = ours.definition.replace(&format!("float64[] {}\n", last.name()), "");
        let decoder = ours.earlier_decoder(|definition| definition == before).expect("known");
        assert_eq!(decoder.decode(&data), Ok(sample.into()));
    }
}
