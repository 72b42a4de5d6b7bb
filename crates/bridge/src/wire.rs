//! The frames that links exchange.
//!
//! A frame is `bg`, the protocol's number, and a body in bincode. Protocol 0 is for all times: a plain text that says why
//! the sender refuses to talk, so that links of different versions understand at least that.

use std::collections::BTreeMap;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use blindgrasp_graph::log::printable;
use blindgrasp_messages::read_list;
use blindgrasp_operator::cursors::SampleId;

/// Changes with the frames.
pub const PROTOCOL: u8 = 1;
/// What a frame begins with.
pub const MAGIC: [u8; 2] = *b"bg";
/// A longer frame is none. Above the largest message: 4096 features, 1024 contacts.
pub const MAX_FRAME_BYTES: usize = 256 << 10;
/// The longest text of a refusal that is shown.
pub const MAX_REFUSAL_BYTES: usize = 2048;
/// The longest name of a machine, a port, a type or a version: `NODE/PORT` is the longest there is, with 65.
pub const MAX_WIRE_NAME_BYTES: usize = 256;
/// The most channels from one machine to another.
pub const MAX_CHANNELS: usize = 4096;
/// The protocol's number of a refusal.
const REFUSAL: u8 = 0;

/// Why some bytes are no frame to go by.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// It does not begin as frames do.
    #[error("it is no frame of blindgrasp: it does not begin with '{}'", MAGIC.escape_ascii())]
    Foreign,
    /// A frame of another protocol.
    #[error(
        "a frame of protocol {found}, expected {PROTOCOL}: that machine runs another version of blindgrasp, \
         install the same on all"
    )]
    Version {
        /// The protocol's number.
        found: u8,
    },
    /// It is longer than any frame.
    #[error("a frame is longer than {MAX_FRAME_BYTES} bytes")]
    Oversized,
    /// Its body is none of this protocol; the text says why.
    #[error("malformed frame: {0}")]
    Malformed(String),
    /// The sender refuses to talk; its own words, fit for a terminal.
    #[error("refused: {0}")]
    Refused(String),
}

/// How many messages were dropped unread, by why.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Rejected {
    /// No frames of blindgrasp.
    pub foreign: u64,
    /// Frames that cannot be what they claim to be, or messages.
    pub malformed: u64,
    /// Longer than any frame.
    pub oversized: u64,
    /// Frames that came before.
    pub replayed: u64,
    /// Frames of another protocol.
    pub version: u64,
    /// What the sender has no right to say.
    pub unauthorised: u64,
    /// Samples of a request that a later one has replaced, and frames of an instance that is gone.
    pub stale: u64,
}

impl Rejected {
    /// Counts what [`Frame::decode`] gave back. A refusal was read: it is not counted.
    pub fn count(&mut self, why: &WireError) {
        match why {
            WireError::Foreign => self.foreign += 1,
            WireError::Version { .. } => self.version += 1,
            WireError::Oversized => self.oversized += 1,
            WireError::Malformed(_) => self.malformed += 1,
            WireError::Refused(_) => {}
        }
    }

    /// For [`LinkStatus::rejected`](blindgrasp_operator::link_status::LinkStatus::rejected); zeros included.
    pub fn by_why(&self) -> BTreeMap<String, u64> {
        let Rejected { foreign, malformed, oversized, replayed, version, unauthorised, stale } = *self;
        [
            ("foreign", foreign),
            ("malformed", malformed),
            ("oversized", oversized),
            ("replayed", replayed),
            ("version", version),
            ("unauthorised", unauthorised),
            ("stale", stale),
        ]
        .map(|(why, count)| (why.to_owned(), count))
        .into()
    }
}

/// What one link says to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame<'a> {
    /// The sender's instance: a number that it drew when it started.
    pub instance: u64,
    /// Counts this instance's frames to this peer under this key: one that is not above the last is a replay.
    pub counter: u64,
    /// What it says.
    #[serde(borrow)]
    pub body: Body<'a>,
}

impl<'a> Frame<'a> {
    /// Puts the frame's bytes into `out`, in place of what was there.
    pub fn encode_into(&self, out: &mut Vec<u8>) {
        out.clear();
        out.extend(MAGIC);
        out.push(PROTOCOL);
        // Memory does not fail, and there is nothing in a frame that bincode has no bytes for.
        let encoded = bincode::serde::encode_into_std_write(self, out, bincode::config::standard());
        debug_assert!(encoded.is_ok(), "{encoded:?}");
    }

    /// The frame that these bytes are.
    ///
    /// # Errors
    /// They are none to go by; a [`WireError::Refused`] is what the other side wants people to read.
    pub fn decode(bytes: &'a [u8]) -> Result<Frame<'a>, WireError> {
        let Some((protocol, body)) = bytes.strip_prefix(&MAGIC).and_then(<[u8]>::split_first) else {
            return Err(WireError::Foreign);
        };
        match *protocol {
            REFUSAL => return Err(WireError::Refused(refusal(body))),
            PROTOCOL if bytes.len() <= MAX_FRAME_BYTES => {}
            PROTOCOL => return Err(WireError::Oversized),
            found => return Err(WireError::Version { found }),
        }
        let config = bincode::config::standard().with_limit::<MAX_FRAME_BYTES>();
        let (frame, n_bytes) = bincode::serde::borrow_decode_from_slice(body, config)
            .map_err(|error| WireError::Malformed(printable(&error.to_string())))?;
        if n_bytes != body.len() {
            return Err(WireError::Malformed(format!("{} bytes too many", body.len() - n_bytes)));
        }
        Ok(frame)
    }
}

/// The bytes that tell a link of any version why this one refuses to talk; at most [`MAX_REFUSAL_BYTES`] of the text.
pub fn encode_refusal(text: &str) -> Vec<u8> {
    let text = &text[..text.floor_char_boundary(MAX_REFUSAL_BYTES)];
    [&MAGIC[..], &[REFUSAL], text.as_bytes()].concat()
}

fn refusal(bytes: &[u8]) -> String {
    printable(&String::from_utf8_lossy(&bytes[..bytes.len().min(MAX_REFUSAL_BYTES)]))
}

/// A name is borrowed first: no length that a frame claims takes memory. It is shown to people.
fn name<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = <&str>::deserialize(deserializer)?;
    if text.len() > MAX_WIRE_NAME_BYTES {
        return Err(D::Error::custom(format!(
            "a name of {} bytes, expected at most {MAX_WIRE_NAME_BYTES}",
            text.len()
        )));
    }
    if printable(text) != text {
        return Err(D::Error::custom(format!("a name that is not printable: '{}'", printable(text))));
    }
    Ok(text.to_owned())
}

fn channels<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<ExportedChannel>, D::Error> {
    read_list(deserializer, MAX_CHANNELS)
}

/// At once; serde's own way is byte by byte.
fn as_bytes<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytes)
}

/// What a frame says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Body<'a> {
    /// Who the sender is. Said until it is answered by one that names this instance.
    Hello(Hello),
    /// The sender's clock (CLOCK_MONOTONIC, nanoseconds) now.
    Ping {
        /// When it was sent.
        sent_nanos: u64,
    },
    /// To [`Body::Ping`].
    Pong {
        /// The ping's.
        sent_nanos: u64,
        /// When the ping came, by the answerer's clock.
        received_nanos: u64,
        /// When the answer went out, by the answerer's clock.
        answered_nanos: u64,
    },
    /// The receiver of a channel wants its samples from here on.
    Resume {
        /// Index of the channel among the sender's exports in its [`Hello`].
        channel: u16,
        /// Counts the receiver's requests.
        run: u32,
        /// The last sample that it has; `None` for whatever there is.
        after: Option<WireKey>,
    },
    /// A sample.
    #[serde(borrow)]
    Sample(SampleFrame<'a>),
    /// How far the receiver of a channel is.
    Ack {
        /// Index of the channel.
        channel: u16,
        /// Its latest request.
        run: u32,
        /// One more than the index of the last sample of that run that it has.
        n_received: u64,
        /// The last sample that all its readers have answered.
        answered: Option<WireKey>,
    },
    /// A channel has no more samples: its writer has ended for good.
    End {
        /// Index of the channel.
        channel: u16,
        /// The request that it answers.
        run: u32,
        /// The last sample; `None` if there was none.
        last: Option<WireKey>,
    },
    /// The receiver has published all up to the end.
    Ended {
        /// Index of the channel.
        channel: u16,
    },
    /// The sender leaves the graph: it was stopped.
    Leaving,
}

/// Who a link is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hello {
    /// The version of blindgrasp.
    #[serde(deserialize_with = "name")]
    pub version: String,
    /// Its machine.
    #[serde(deserialize_with = "name")]
    pub machine: String,
    /// The peer's instance that it has heard, if it has heard one.
    pub heard: Option<u64>,
    /// [`LinkConfig::fingerprint`](super::config::LinkConfig::fingerprint).
    pub fingerprint: u64,
    /// Its run of its part of the graph: another one's samples may bear the same numbers.
    pub run: u64,
    /// Whether it had lost this peer, and waits to be asked for its samples.
    pub is_cut_off: bool,
    /// What it sends to this peer: ports, types and the types' schema numbers.
    #[serde(deserialize_with = "channels")]
    pub exports: Vec<ExportedChannel>,
    /// Whether its operators are ready.
    pub is_ready: bool,
}

/// A channel as its sender describes it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExportedChannel {
    /// `NODE/PORT`.
    #[serde(deserialize_with = "name")]
    pub port: String,
    /// The type's name.
    #[serde(deserialize_with = "name")]
    pub type_name: String,
    /// See [`sample::schema_id`](super::sample::schema_id).
    pub schema_id: u32,
}

/// A sample on its way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SampleFrame<'a> {
    /// Index of the channel.
    pub channel: u16,
    /// The request that it answers.
    pub run: u32,
    /// Counts the samples of the run, from 0.
    pub index: u64,
    /// See [`sample::schema_id`](super::sample::schema_id).
    pub schema_id: u32,
    /// The latest time that the sender has had from the receiver's clock (a [`Body::Ping`]'s), 0 if none.
    pub echo_nanos: u64,
    /// How old the sample was when it was sent, by the sender's clock; `None` if its source does not say.
    pub age_nanos: Option<u64>,
    /// When it was sent, by the sender's clock.
    pub sent_nanos: u64,
    /// The message: see [`sample`](super::sample).
    #[serde(borrow, serialize_with = "as_bytes")]
    pub message: &'a [u8],
}

/// A [`SampleId`] on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct WireKey {
    /// Generation of the source.
    pub epoch: u64,
    /// Its number.
    pub seq: u64,
}

impl From<SampleId> for WireKey {
    fn from(SampleId { epoch, seq }: SampleId) -> Self {
        WireKey { epoch, seq }
    }
}

impl From<WireKey> for SampleId {
    fn from(WireKey { epoch, seq }: WireKey) -> Self {
        SampleId { epoch, seq }
    }
}

#[cfg(test)]
mod tests;
