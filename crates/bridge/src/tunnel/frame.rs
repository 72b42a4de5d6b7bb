//! The frames of tunnels and their bytes: `bt`, the protocol's number, and a body in bincode.

use bincode::config::{Configuration, Limit, LittleEndian, Varint};
use serde::{Deserialize, Serialize};

/// What a frame begins with.
const MAGIC: [u8; 2] = *b"bt";
/// Changes with the frames.
const PROTOCOL: u8 = 1;
/// How much of the stream a frame carries.
pub(super) const MAX_CHUNK_BYTES: usize = 16 << 10;
/// A longer frame is none.
const MAX_FRAME_BYTES: usize = MAX_CHUNK_BYTES + 128;
/// The longest reason for an end.
pub(super) const MAX_REASON_BYTES: usize = 1024;

/// What one end of a tunnel says to the other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Frame<'a> {
    /// The tunnel, by the number that the asking end has drawn.
    pub(super) id: u64,
    /// The number that the serving end has drawn; 0 in [`Body::Open`] alone. What was overheard in an earlier tunnel does
    /// not bear it.
    pub(super) token: u64,
    /// Whether the asking end says it.
    pub(super) is_from_asker: bool,
    #[serde(borrow)]
    pub(super) body: Body<'a>,
}

/// What it says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Body<'a> {
    /// The asking end wants a tunnel.
    Open,
    /// The serving end has made it.
    Opened,
    /// A piece of the stream.
    Data {
        /// Counts this end's pieces, from 0.
        index: u64,
        bytes: &'a [u8],
    },
    /// How many of the other end's pieces have been taken.
    Credit { n_taken: u64 },
    /// This end lives.
    Alive,
    /// It has nothing more to say, or cannot go on.
    Close { reason: Option<&'a str> },
}

/// Why bytes are no frame of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoFrame {
    Foreign,
    Version,
    Oversized,
    Malformed,
}

impl NoFrame {
    /// As it is counted.
    pub(super) fn word(self) -> &'static str {
        match self {
            NoFrame::Foreign => "foreign",
            NoFrame::Version => "version",
            NoFrame::Oversized => "oversized",
            NoFrame::Malformed => "malformed",
        }
    }
}

impl Frame<'_> {
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = [MAGIC.as_slice(), &[PROTOCOL]].concat();
        // Numbers, bytes and text are always bincode.
        if let Ok(body) = bincode::serde::encode_to_vec(self, config()) {
            bytes.extend(body);
        }
        bytes
    }

    pub(super) fn decode(bytes: &[u8]) -> Result<Frame<'_>, NoFrame> {
        let (protocol, body) =
            bytes.strip_prefix(&MAGIC).and_then(|rest| rest.split_first()).ok_or(NoFrame::Foreign)?;
        if *protocol != PROTOCOL {
            return Err(NoFrame::Version);
        }
        if bytes.len() > MAX_FRAME_BYTES {
            return Err(NoFrame::Oversized);
        }
        let (frame, n_read): (Frame, usize) =
            bincode::serde::borrow_decode_from_slice(body, config()).map_err(|_| NoFrame::Malformed)?;
        let is_within = match &frame.body {
            Body::Data { bytes, .. } => bytes.len() <= MAX_CHUNK_BYTES,
            Body::Close { reason } => reason.is_none_or(|reason| reason.len() <= MAX_REASON_BYTES),
            _ => true,
        };
        if n_read != body.len() || !is_within {
            return Err(NoFrame::Malformed);
        }
        Ok(frame)
    }
}

fn config() -> Configuration<LittleEndian, Varint, Limit<MAX_FRAME_BYTES>> {
    bincode::config::standard().with_limit()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<Frame<'static>> {
        let bodies = [
            Body::Open,
            Body::Opened,
            Body::Data { index: 300, bytes: b"{\"request\":\"status\"}\n" },
            Body::Data { index: u64::MAX, bytes: &[7; MAX_CHUNK_BYTES] },
            Body::Credit { n_taken: 9 },
            Body::Alive,
            Body::Close { reason: None },
            Body::Close { reason: Some("cut off") },
        ];
        bodies.map(|body| Frame { id: u64::MAX, token: u64::MAX - 1, is_from_asker: true, body }).into()
    }

    #[test]
    fn a_frame_comes_back_and_nothing_else_is_one() {
        for frame in frames() {
            let bytes = frame.encode();
            assert_eq!(Frame::decode(&bytes), Ok(frame));
            for n_bytes in 0..bytes.len().min(64) {
                Frame::decode(&bytes[..n_bytes]).expect_err("cut off");
            }
            let trailing = [bytes.as_slice(), b"x"].concat();
            let expected = if trailing.len() > MAX_FRAME_BYTES { NoFrame::Oversized } else { NoFrame::Malformed };
            assert_eq!(Frame::decode(&trailing), Err(expected));
            assert_eq!(Frame::decode(&[b"xx", &bytes[2..]].concat()), Err(NoFrame::Foreign));
            assert_eq!(Frame::decode(&[&MAGIC, [2].as_slice(), &bytes[3..]].concat()), Err(NoFrame::Version));
        }
        let long = [MAGIC.as_slice(), &[PROTOCOL], &[0; MAX_FRAME_BYTES]].concat();
        assert_eq!(Frame::decode(&long), Err(NoFrame::Oversized));
        let body = Body::Data { index: 0, bytes: &[0; MAX_CHUNK_BYTES + 1] };
        let chunk = Frame { id: 1, token: 1, is_from_asker: false, body }.encode();
        assert_eq!(Frame::decode(&chunk), Err(NoFrame::Malformed));
    }

    #[test]
    fn whatever_is_done_to_a_frame_decoding_ends_well() {
        let mut state = 1_u64;
        let mut draw = |n: usize| {
            // Knuth's linear congruential generator: enough to damage bytes.
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n
        };
        for _ in 0..20_000 {
            let frames = frames();
            let mut bytes = frames[draw(frames.len())].encode();
            for _ in 0..=draw(4) {
                let idx = draw(bytes.len().min(48));
                bytes[idx] = draw(256) as u8;
            }
            bytes.truncate(bytes.len() - draw(3).min(bytes.len()));
            if let Ok(frame) = Frame::decode(&bytes) {
                assert_eq!(Frame::decode(&frame.encode()), Ok(frame.clone()));
            }
        }
    }
}
