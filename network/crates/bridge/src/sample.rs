//! A message as the body of a frame: its used part only, in bincode, every number bit by bit as it was.
//!
//! Messages from another machine are checked as messages from shared memory are. Of the header, `made_by` and `valid_nanos`
//! come first; `origin_nanos` does not travel: it is a time of the sender's clock ([`clock`](super::clock)).

use sha2::{Digest, Sha256};

use super::wire::MAX_FRAME_BYTES;
use blindgrasp_graph::log::printable;
use blindgrasp_messages::{Header, Message, MessageError, Stamped, WithMessage, coded_enums, signature, with_message};
use blindgrasp_operator::cursors::SampleId;

/// Why a sample is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SampleError {
    /// A code or a length in it is invalid.
    #[error("a {type_name} whose {source}")]
    Message { type_name: &'static str, source: MessageError },
    /// Its bytes are not a sample of this type.
    #[error("not a {type_name}: {reason}")]
    Malformed { type_name: &'static str, reason: String },
}

/// A number that changes with the type's name, its fields and their codes: machines with the same number understand
/// each other's samples. `None` for a type that cannot travel between machines.
pub fn schema_id(type_name: &str) -> Option<u32> {
    struct Id;
    impl WithMessage for Id {
        type Output = u32;
        fn with<M: Message>(self) -> u32 {
            let signature = signature::<M>();
            let mut hash = Sha256::new();
            hash.update(M::TYPE_NAME);
            hash.update(&signature);
            for codes in coded_enums() {
                if signature.lines().any(|line| line == format!("uint32 {}", codes.field)) {
                    codes.words.iter().for_each(|(word, code)| hash.update(format!("{code} {word},")));
                }
            }
            let [first, second, third, fourth, ..] = <[u8; 32]>::from(hash.finalize());
            u32::from_be_bytes([first, second, third, fourth])
        }
    }
    with_message(type_name, Id)
}

/// Puts a message from shared memory into `out`, in place of its content.
///
/// # Errors
/// The message has an invalid code or length; `out` is empty then.
pub fn encode<M: Message>(head: &M::Head, items: &[M::Item], out: &mut Vec<u8>) -> Result<(), SampleError> {
    out.clear();
    let message =
        M::from_parts(head, items).map_err(|source| SampleError::Message { type_name: M::TYPE_NAME, source })?;
    let header = *M::header(head);
    let sample = (header.made_by, header.valid_nanos, Stamped { header, message });
    if let Err(error) = bincode::serde::encode_into_std_write(&sample, out, bincode::config::standard()) {
        out.clear();
        return Err(malformed::<M>(error));
    }
    Ok(())
}

/// The sample in these bytes, with `origin_nanos` 0.
///
/// # Errors
/// The bytes are not one sample of this type, or it has an invalid code or length.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<Stamped<M>, SampleError> {
    let config = bincode::config::standard().with_limit::<MAX_FRAME_BYTES>();
    let ((made_by, valid_nanos, mut sample), n_bytes): ((u64, u64, Stamped<M>), usize) =
        bincode::serde::borrow_decode_from_slice(bytes, config).map_err(malformed::<M>)?;
    if n_bytes != bytes.len() {
        return Err(malformed::<M>(format!("{} bytes too many", bytes.len() - n_bytes)));
    }
    sample.message.check().map_err(|source| SampleError::Message { type_name: M::TYPE_NAME, source })?;
    sample.header = Header { made_by, valid_nanos, ..sample.header };
    Ok(sample)
}

fn malformed<M: Message>(reason: impl ToString) -> SampleError {
    SampleError::Malformed { type_name: M::TYPE_NAME, reason: printable(&reason.to_string()) }
}

/// Stands for a sample that its own machine cannot read: without it, the position in the stream would be unknown. No
/// readable message has this length.
pub fn encode_unreadable(key: SampleId) -> [u8; 16] {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&key.epoch.to_le_bytes());
    bytes[8..].copy_from_slice(&key.seq.to_le_bytes());
    bytes
}

/// The sample that bytes of [`encode_unreadable`] stand for.
pub fn decode_unreadable(bytes: &[u8]) -> Option<SampleId> {
    let (epoch, seq) = <&[u8; 16]>::try_from(bytes).ok()?.split_at(8);
    Some(SampleId { epoch: u64::from_le_bytes(epoch.try_into().ok()?), seq: u64::from_le_bytes(seq.try_into().ok()?) })
}

#[cfg(test)]
mod tests;
