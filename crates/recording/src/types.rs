//! Our message types as recordings carry them: names, definitions, CDR.

use std::sync::LazyLock;

use cdr_encoding::{from_bytes, to_writer};
use serde::Serialize;

use blindgrasp_messages::{
    ContactSet, GraspFeature, LiftOutcome, Record, Recorded, Stamped, TactileFrame, of_each_type,
};

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// How messages and their definitions are encoded, in MCAP's words.
pub(super) const MESSAGE_ENCODING: &str = "cdr";
pub(super) const SCHEMA_ENCODING: &str = "ros2msg";

/// Lists at the end of frames and contacts that an earlier version had not.
const N_LATER_LISTS: usize = 3;

/// The topic of features in recordings of version 0.1 and before.
pub(super) const EARLIER_FEATURE_TOPIC: &str = "/histogram";

/// Makes a sample of a recorded message.
pub(super) type Decode = fn(&[u8]) -> Result<Record, String>;

/// One of our message types.
pub(super) struct OurType {
    schema: &'static str,
    pub(super) definition: String,
    pub(super) decode: Decode,
    /// The definitions of earlier versions.
    pub(super) earlier: Vec<String>,
    /// How messages of earlier versions are read: fields that they lack are empty.
    pub(super) decode_earlier: Decode,
}

/// The type of this ROS name, if it is ours.
pub(super) fn our_type(schema: &str) -> Option<&'static OurType> {
    static TYPES: LazyLock<Vec<OurType>> = LazyLock::new(|| of_each_type!(our).into());
    TYPES.iter().find(|ours| ours.schema == schema)
}

fn our<M: Recorded>() -> OurType {
    let definition = M::definition();
    // The fields that each earlier version lacked.
    let lacking: &[&[&str]] = match M::SCHEMA {
        // The first lies where messages without it have a byte of padding, which is 0; the others are the last fields.
        LiftOutcome::SCHEMA => {
            &[&["bool advised", "bool probed", "bool disturbed"], &["bool probed", "bool disturbed"]]
        }
        TactileFrame::SCHEMA | ContactSet::SCHEMA => {
            &[&["float64[] gravity_m_per_s2", "float64[] wrist_wrench", "float64[] joint_torques"]]
        }
        _ => &[],
    };
    let without = |text: String, field: &&str| text.replace(&format!("{field}\n"), "");
    OurType {
        schema: M::SCHEMA,
        earlier: lacking.iter().map(|fields| fields.iter().fold(definition.clone(), without)).collect(),
        definition,
        decode: |data| decode::<M>(data).map(M::record),
        decode_earlier: |data| decode_earlier::<M>(data).map(M::record),
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

/// A message without the last fields that this version has: they are 0, or empty lists.
fn decode_earlier<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
    let n_later_bytes = if M::SCHEMA == LiftOutcome::SCHEMA { 2 } else { N_LATER_LISTS * size_of::<u32>() };
    decode(&[data, &[0; N_LATER_LISTS * size_of::<u32>()][..n_later_bytes]].concat())
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

    use super::*;
    use blindgrasp_messages::{Header, Phase, first_difference};

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
        let found: Stamped<LiftOutcome> = decode_earlier(&data).expect("decoded");
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
        assert_eq!(found, Stamped { header: earlier.header, message: expected });
        let ours = our_type("blindgrasp_msgs/msg/LiftOutcome").expect("a type");
        let earlier = &ours.earlier[0];
        assert_eq!(first_difference(earlier, &ours.definition).map(|(_, ours)| ours), Some("bool advised".into()));
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
        let found: Stamped<TactileFrame> = decode_earlier(&data).expect("decoded");
        let EarlierFrame { joints_rad, cells_newtons, .. } = earlier;
        let message = TactileFrame { grasp_id: 7, phase, joints_rad, cells_newtons, ..TactileFrame::default() };
        assert_eq!(found, Stamped { header, message });
        for n_bytes in 0..data.len() {
            decode_earlier::<TactileFrame>(&data[..n_bytes]).expect_err("cut off");
        }
    }
}
