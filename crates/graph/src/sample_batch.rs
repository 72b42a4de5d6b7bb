//! Samples in a line of JSON: pairs of edge index and sample in bincode, and the whole batch in base64.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use blindgrasp_messages::Record;

/// No sample is added to a batch that has this many bytes.
pub const FULL_BYTES: usize = 36 << 10;

/// The bytes of an edge's sample in a batch.
///
/// # Errors
/// The sample cannot be encoded.
pub fn encode(edge_idx: u16, record: &Record) -> Result<Vec<u8>, bincode::error::EncodeError> {
    bincode::serde::encode_to_vec((edge_idx, record), bincode::config::standard())
}

pub fn to_text(batch: &[u8]) -> String {
    STANDARD.encode(batch)
}

/// The samples of a [`SampleBatch`](crate::control::SampleBatch), each with the index of its edge.
///
/// # Errors
/// The text is not base64, or a sample in it cannot be decoded or is not valid; as a sentence for the user.
pub fn samples(text: &str) -> Result<Vec<(u16, Record)>, String> {
    let batch = STANDARD.decode(text).map_err(|error| format!("the samples are not base64: {error}"))?;
    let mut rest = batch.as_slice();
    let mut samples = Vec::new();
    while !rest.is_empty() {
        let (sample, n_bytes): ((u16, Record), usize) =
            bincode::serde::decode_from_slice(rest, bincode::config::standard().with_limit::<{ 4 << 20 }>())
                .map_err(|error| format!("a sample cannot be decoded: {error}"))?;
        sample.1.check().map_err(|error| format!("a sample is not valid: {error}"))?;
        samples.push(sample);
        rest = &rest[n_bytes..];
    }
    Ok(samples)
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::{
        ContactSet, GraspFeature, GraspTruth, Header, LiftDecision, LiftOutcome, Prediction, Stamped, TactileFrame,
    };

    #[test]
    fn samples_come_back() {
        let header = Header { seq: 7, stamp_nanos: 8, epoch: 9, hand_id: 10, ..Header::default() };
        let odd = f64::from_bits(0x7ff8_0000_0000_0123);
        let feature = GraspFeature { values: vec![0.1, 1e300], ..GraspFeature::default() };
        let prediction = Prediction { probability_stable: odd, ..Prediction::default() };
        let records = [
            Record::Tactile(Stamped { header, message: TactileFrame::default() }),
            Record::Contacts(Stamped { header, message: ContactSet::default() }),
            Record::Feature(Stamped { header, message: feature }),
            Record::Prediction(Stamped { header, message: prediction }),
            Record::Decision(Stamped { header, message: LiftDecision::default() }),
            Record::Truth(Stamped { header, message: GraspTruth::default() }),
            Record::Outcome(Stamped { header, message: LiftOutcome::default() }),
        ];
        let mut batch = Vec::new();
        for (edge_idx, record) in records.iter().enumerate() {
            batch.extend(encode(edge_idx as u16, record).expect("encoded"));
        }
        let found = samples(&to_text(&batch)).expect("samples");
        assert_eq!(found.len(), records.len());
        for (edge_idx, (found, record)) in found.iter().zip(&records).enumerate() {
            assert_eq!((usize::from(found.0), found.1.header()), (edge_idx, record.header()));
            // NaN does not equal itself, so that bytes are compared.
            let bytes = |record: &Record| encode(0, record).expect("encoded");
            assert_eq!(bytes(&found.1), bytes(record));
        }
        samples("?").expect_err("no base64");
        samples(&to_text(&batch[..batch.len() - 1])).expect_err("cut off");
        assert_eq!(samples(""), Ok(Vec::new()));
    }
}
