//! A message as the body of a frame: its used part only, in bincode, every number bit by bit as it was.
//!
//! What comes from another machine is checked as what comes from shared memory is. `origin_nanos` does not travel: it is a
//! time of the sender's clock ([`clock`](super::clock)).

use sha2::{Digest, Sha256};

use super::wire::MAX_FRAME_BYTES;
use blindgrasp_graph::log::printable;
use blindgrasp_messages::{
    Action, ContactSet, Fault, GraspFeature, GraspTruth, LiftDecision, LiftOutcome, Message, MessageError, Phase,
    Prediction, Reason, RegraspAdvice, Stamped, TactileFrame,
};
use blindgrasp_operator::board::Key;
use blindgrasp_recording::signature;

/// Why a sample cannot travel, or is not what it claims to be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SampleError {
    /// A code or a length in it.
    #[error("a {type_name} whose {source}")]
    Message {
        /// The type.
        type_name: &'static str,
        /// What is wrong with it.
        source: MessageError,
    },
    /// Its bytes are none of this type.
    #[error("not a {type_name}: {reason}")]
    Malformed {
        /// The type that was expected.
        type_name: &'static str,
        /// What is wrong with the bytes.
        reason: String,
    },
}

/// Something to do with a type of messages that is known by its name only.
pub trait WithMessage {
    /// What comes of it.
    type Output;

    /// Does it.
    fn with<M: Message>(self) -> Self::Output;
}

/// Does something with the type of this name; `None` if there is none that can travel.
pub fn with_message<W: WithMessage>(type_name: &str, work: W) -> Option<W::Output> {
    macro_rules! choose {
        ($($message:ty),+) => { $(if type_name == <$message as blindgrasp_messages::Recorded>::TYPE_NAME {
            return Some(work.with::<$message>());
        })+ };
    }
    choose!(TactileFrame, ContactSet, GraspFeature, Prediction, LiftDecision, GraspTruth, LiftOutcome, RegraspAdvice);
    None
}

/// A number that changes with the type's name, its fields and the codes in them: machines that agree on it understand each
/// other's samples. `None` for a type that cannot cross.
pub fn schema_id(type_name: &str) -> Option<u32> {
    struct Id;
    impl WithMessage for Id {
        type Output = u32;
        fn with<M: Message>(self) -> u32 {
            let signature = signature::<M>();
            let mut hash = Sha256::new();
            hash.update(M::TYPE_NAME);
            hash.update(&signature);
            for (field, codes) in codes() {
                if signature.lines().any(|line| line == format!("uint32 {field}")) {
                    hash.update(codes);
                }
            }
            let [first, second, third, fourth, ..] = <[u8; 32]>::from(hash.finalize());
            u32::from_be_bytes([first, second, third, fourth])
        }
    }
    with_message(type_name, Id)
}

/// Puts a message from shared memory into `out`, in place of what was there.
///
/// # Errors
/// A code or a length in it that can't be; `out` is empty then.
pub fn encode<M: Message>(head: &M::Head, items: &[M::Item], out: &mut Vec<u8>) -> Result<(), SampleError> {
    out.clear();
    let message =
        M::from_parts(head, items).map_err(|source| SampleError::Message { type_name: M::TYPE_NAME, source })?;
    let sample = Stamped { header: *M::header(head), message };
    if let Err(error) = bincode::serde::encode_into_std_write(&sample, out, bincode::config::standard()) {
        out.clear();
        return Err(malformed::<M>(error));
    }
    Ok(())
}

/// The sample that these bytes are; its `origin_nanos` is 0.
///
/// # Errors
/// They are none, or too many; a code or a length that can't be.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<Stamped<M>, SampleError> {
    let config = bincode::config::standard().with_limit::<MAX_FRAME_BYTES>();
    let (sample, n_bytes): (Stamped<M>, usize) =
        bincode::serde::borrow_decode_from_slice(bytes, config).map_err(malformed::<M>)?;
    if n_bytes != bytes.len() {
        return Err(malformed::<M>(format!("{} bytes too many", bytes.len() - n_bytes)));
    }
    sample.message.check().map_err(|source| SampleError::Message { type_name: M::TYPE_NAME, source })?;
    Ok(sample)
}

fn malformed<M: Message>(reason: impl ToString) -> SampleError {
    SampleError::Malformed { type_name: M::TYPE_NAME, reason: printable(&reason.to_string()) }
}

/// The fields that hold codes, and what the codes mean.
fn codes() -> [(&'static str, String); 4] {
    macro_rules! words {
        ($codes:ty) => {
            <$codes>::ALL.iter().map(|value| format!("{} {},", value.code(), value.word())).collect()
        };
    }
    [("phase", words!(Phase)), ("fault", words!(Fault)), ("action", words!(Action)), ("reason", words!(Reason))]
}

/// What goes in the place of a sample that its own machine cannot read: which one it is. Left out, nobody would know where
/// the stream is; no message that can be read is of this length.
pub fn encode_unreadable(key: Key) -> [u8; 16] {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&key.epoch.to_le_bytes());
    bytes[8..].copy_from_slice(&key.seq.to_le_bytes());
    bytes
}

/// The sample that these bytes stand for, if they are of [`encode_unreadable`].
pub fn decode_unreadable(bytes: &[u8]) -> Option<Key> {
    let (epoch, seq) = <&[u8; 16]>::try_from(bytes).ok()?.split_at(8);
    Some(Key { epoch: u64::from_le_bytes(epoch.try_into().ok()?), seq: u64::from_le_bytes(seq.try_into().ok()?) })
}

#[cfg(test)]
mod tests;
