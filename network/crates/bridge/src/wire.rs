//! The frames that links exchange.
//!
//! A frame is `bg`, the version of the protocol, a byte for its form, and a body:
//!
//! | form | body |
//! |---|---|
//! | 0, plain | a [`Frame`] in bincode |
//! | 1, signed | in bincode: the sender's certificates, the signature's scheme, the signature, a plain frame with a hello |
//! | 2, encrypted | 4 bytes of the sender's public key, an 8-byte counter, a frame in ChaCha20-Poly1305 with its tag |
//!
//! Machines with keys send hellos signed ([`identity`](super::identity)) and everything else encrypted
//! ([`agreement`](super::agreement)). Machines without keys send all frames plain.
//!
//! Version 0 means the same in all versions: a plain text after the version that says why the sender refuses the
//! connection, so that links of different versions understand at least this.

use std::collections::BTreeMap;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::agreement::PublicKey;
use super::envelope;
use blindgrasp_graph::log::printable;
use blindgrasp_messages::read_list;
use blindgrasp_operator::cursors::SampleId;

/// The version of the protocol. It changes with the frames.
pub const PROTOCOL: u8 = 4;
/// The first bytes of a frame.
pub const MAGIC: [u8; 2] = *b"bg";
/// Maximum size of a frame in bytes; longer input is rejected. The largest message, with 16,384 contacts of up to 66 bytes,
/// is smaller.
pub const MAX_FRAME_BYTES: usize = 2 << 20;
/// Maximum length of a refusal's text in bytes; the rest is not shown.
pub const MAX_REFUSAL_BYTES: usize = 2048;
/// Maximum length in bytes of a name (machine, port, type or version). The longest valid name, `NODE/PORT`, has 65.
pub const MAX_WIRE_NAME_BYTES: usize = 256;
/// Maximum number of channels from one machine to another.
pub const MAX_CHANNELS: usize = 4096;
/// The protocol version of a refusal.
const REFUSAL: u8 = 0;

/// Why bytes are not a valid frame, or a frame has no bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    #[error("not a frame of blindgrasp: the first two bytes are wrong")]
    Foreign,
    #[error(
        "a frame of protocol {found}, expected {PROTOCOL}: that machine runs another version of blindgrasp; \
         install the same version on all machines"
    )]
    Version { found: u8 },
    #[error("the frame is longer than a frame may be")]
    Oversized,
    #[error("malformed frame: {0}")]
    Malformed(String),
    /// The sender has not proved who it is. The text is for the users of both machines.
    #[error("{0}")]
    Unverified(String),
    #[error("the frame was changed on its way, or is from another sender or for another purpose")]
    Forged,
    #[error("the frame is encrypted with keys that are not in use")]
    OtherKeys,
    /// The sender refuses the connection. The text is the sender's own and is fit for a terminal.
    #[error("refused: {0}")]
    Refused(String),
    #[error("this machine cannot encode a frame: {0}")]
    Unsendable(String),
}

impl WireError {
    /// The reason under which a message that cannot be decoded is counted; `None` for a refusal, which was read.
    pub fn reason(&self) -> Option<&'static str> {
        match self {
            WireError::Foreign => Some("foreign"),
            WireError::Version { .. } => Some("version"),
            WireError::Oversized => Some("oversized"),
            WireError::Malformed(_) => Some("malformed"),
            WireError::Unsendable(_) => Some("unsendable"),
            WireError::Unverified(_) | WireError::Forged => Some("forged"),
            // It is older than the keys, or comes before the hello that makes them.
            WireError::OtherKeys => Some("stale"),
            WireError::Refused(_) => None,
        }
    }
}

/// The number of messages that were dropped unread, by reason.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rejected(BTreeMap<&'static str, u64>);

impl Rejected {
    /// The reasons that `ps --json` always shows, also with a count of 0.
    const ALWAYS_SHOWN: [&'static str; 7] =
        ["foreign", "forged", "malformed", "oversized", "replayed", "version", "stale"];

    /// A count of 0 for each reason that is always shown.
    pub fn with_zeros() -> Self {
        Rejected(Self::ALWAYS_SHOWN.map(|reason| (reason, 0)).into())
    }

    pub fn add(&mut self, reason: &'static str, count: u64) {
        *self.0.entry(reason).or_default() += count;
    }

    /// Counts one message.
    pub fn count(&mut self, reason: &'static str) {
        self.add(reason, 1);
    }

    /// For [`LinkStatus::rejected`](blindgrasp_operator::link_status::LinkStatus::rejected).
    pub fn by_reason(&self) -> BTreeMap<String, u64> {
        self.0.iter().map(|(reason, count)| (reason.to_string(), *count)).collect()
    }
}

/// One message from a link to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame<'a> {
    /// The number of the sender's process. It is drawn when the process starts.
    pub instance: u64,
    /// Counts this instance's frames to this peer under this key. A frame whose counter is not above the last is a
    /// replay.
    pub counter: u64,
    #[serde(borrow)]
    pub body: Body<'a>,
}

impl<'a> Frame<'a> {
    /// Puts the frame's bytes into `out` and replaces the old contents.
    ///
    /// # Errors
    /// [`WireError::Unsendable`]: the frame is longer than [`MAX_FRAME_BYTES`].
    pub fn encode_into(&self, out: &mut Vec<u8>) -> Result<(), WireError> {
        envelope::seal(MAGIC, PROTOCOL, MAX_FRAME_BYTES, self, out)
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// The bytes are not a valid frame, or they are a refusal: [`WireError::Refused`] holds its text.
    pub fn decode(bytes: &'a [u8]) -> Result<Frame<'a>, WireError> {
        match envelope::open(MAGIC, bytes)? {
            (REFUSAL, text) => Err(WireError::Refused(refusal(text))),
            (PROTOCOL, rest) => envelope::decode_plain::<_, MAX_FRAME_BYTES>(rest),
            (found, _) => Err(WireError::Version { found }),
        }
    }
}

/// The bytes that tell a link of any version why this one refuses the connection. The text is cut at
/// [`MAX_REFUSAL_BYTES`].
pub fn encode_refusal(text: &str) -> Vec<u8> {
    let text = &text[..text.floor_char_boundary(MAX_REFUSAL_BYTES)];
    [&MAGIC[..], &[REFUSAL], text.as_bytes()].concat()
}

fn refusal(bytes: &[u8]) -> String {
    printable(&String::from_utf8_lossy(&bytes[..bytes.len().min(MAX_REFUSAL_BYTES)]))
}

/// Reads a name. It is borrowed first, so that the length which a frame claims takes no memory.
fn name<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = <&str>::deserialize(deserializer)?;
    if text.len() > MAX_WIRE_NAME_BYTES {
        return Err(D::Error::custom(format!(
            "a name of {} bytes, expected at most {MAX_WIRE_NAME_BYTES}",
            text.len()
        )));
    }
    if printable(text) != text {
        return Err(D::Error::custom(format!("a name has characters that cannot be printed: '{}'", printable(text))));
    }
    Ok(text.to_owned())
}

fn channels<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<ExportedChannel>, D::Error> {
    read_list(deserializer, MAX_CHANNELS)
}

/// Writes all bytes at once; serde would write them one by one.
fn as_bytes<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytes)
}

/// The content of a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Body<'a> {
    /// Who the sender is. It is repeated until the answer names this instance.
    Hello(Hello),
    /// The sender's clock (CLOCK_BOOTTIME) now.
    Ping { sent_nanos: u64 },
    /// The answer to [`Body::Ping`].
    Pong {
        /// The time in the ping.
        sent_nanos: u64,
        /// When the ping arrived, by the clock of the machine that answers.
        received_nanos: u64,
        /// When the answer was sent, by the clock of the machine that answers.
        answered_nanos: u64,
    },
    /// The receiver of a channel asks for samples.
    Resume {
        /// Index of the channel among the sender's exports in its [`Hello`].
        channel: u16,
        /// The number of the request: the receiver counts its requests.
        run: u32,
        /// The last sample that the receiver has; `None` if it has none.
        after: Option<SampleId>,
    },
    #[serde(borrow)]
    Sample(SampleFrame<'a>),
    /// The progress of a channel's receiver.
    Ack {
        /// Index of the channel, as in [`Body::Resume`].
        channel: u16,
        /// The receiver's latest request.
        run: u32,
        /// The number of samples that were received of this request.
        n_received: u64,
        /// The last sample that all readers of the channel have answered.
        answered: Option<SampleId>,
    },
    /// A channel has no more samples: its writer has ended.
    End {
        /// Index of the channel, as in [`Body::Resume`].
        channel: u16,
        /// The request that this frame answers.
        run: u32,
        /// The last sample of the writer; `None` if it has sent nothing.
        last: Option<SampleId>,
    },
    /// The receiver has published all samples up to the end.
    Ended {
        /// Index of the channel, as in [`Body::Resume`].
        channel: u16,
    },
    /// The sender leaves the graph, because it was stopped.
    Leaving,
}

/// The identity and the state of a link.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// The sender's version of blindgrasp.
    #[serde(deserialize_with = "name")]
    pub version: String,
    /// The sender's machine.
    #[serde(deserialize_with = "name")]
    pub machine: String,
    /// The instance of the receiver that the sender has heard last.
    pub heard: Option<u64>,
    /// The sender's public key for the instance in `heard`, or for the first one that answers; `None` without keys.
    pub key: Option<PublicKey>,
    /// The public key of the instance in `heard`; `None` while that instance has not proved itself, so that it knows that
    /// its frames are not taken.
    pub heard_key: Option<PublicKey>,
    /// [`LinkConfig::fingerprint`](blindgrasp_graph::link::config::LinkConfig::fingerprint).
    pub fingerprint: u64,
    /// The run of the sender's part of the graph. Samples of different runs may have the same sequence numbers.
    pub run: u64,
    /// Whether the sender had lost the receiver and waits for [`Body::Resume`].
    pub is_cut_off: bool,
    /// The receiver was cut off here and may not know it: its requests for samples no longer count.
    pub lacks_request: bool,
    /// The channels from the sender to the receiver.
    #[serde(deserialize_with = "channels")]
    pub exports: Vec<ExportedChannel>,
    /// Whether the operators on the sender's machine are ready.
    pub is_ready: bool,
}

/// A channel as its sender describes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExportedChannel {
    /// `NODE/PORT`.
    #[serde(deserialize_with = "name")]
    pub port: String,
    #[serde(deserialize_with = "name")]
    pub type_name: String,
    /// See [`sample::schema_id`](super::sample::schema_id).
    pub schema_id: u32,
}

/// A sample between two machines.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SampleFrame<'a> {
    /// Index of the channel among the sender's exports.
    pub channel: u16,
    /// The request that this sample answers.
    pub run: u32,
    /// Counts the samples of the request, from 0.
    pub index: u64,
    /// See [`sample::schema_id`](super::sample::schema_id).
    pub schema_id: u32,
    /// The latest time of the receiver's clock that the sender has got from a [`Body::Ping`]; 0 if none.
    pub echo_nanos: u64,
    /// The age of the sample when it was sent, by the sender's clock; `None` if its source does not tell.
    pub age_nanos: Option<u64>,
    /// The time of sending by the sender's clock.
    pub sent_nanos: u64,
    /// The message as encoded by [`sample`](super::sample).
    #[serde(borrow, serialize_with = "as_bytes")]
    pub message: &'a [u8],
}

#[cfg(test)]
mod tests;
