//! The frames of tunnels: `bt`, the version of the protocol, a byte for the form, and a body, as in [`wire`](crate::wire).

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::envelope;
use crate::wire::WireError;

const MAGIC: [u8; 2] = *b"bt";
/// The version of the protocol. It changes with the frames.
const PROTOCOL: u8 = 2;
/// Maximum number of bytes of the stream in a frame.
pub(super) const MAX_CHUNK_BYTES: usize = 16 << 10;
/// Maximum size of a frame in bytes; longer input is rejected.
const MAX_FRAME_BYTES: usize = MAX_CHUNK_BYTES + 128;
/// Maximum length of a reason for closing in bytes.
pub(super) const MAX_REASON_BYTES: usize = 1024;

/// One message from an end of a tunnel to the other end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Frame<'a> {
    /// The number of the tunnel, drawn by the asking end.
    pub(super) id: u64,
    /// A number drawn by the serving end; 0 in [`Body::Open`] alone. It tells frames of this tunnel from recorded
    /// frames of an earlier one.
    pub(super) token: u64,
    pub(super) is_from_asker: bool,
    #[serde(borrow)]
    pub(super) body: Body<'a>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Body<'a> {
    /// The asking end wants a tunnel.
    Open,
    /// The serving end has made the tunnel.
    Opened,
    /// A piece of the stream. `index` counts the pieces of this end, from 0.
    Data {
        index: u64,
        #[serde(borrow)]
        bytes: Cow<'a, [u8]>,
    },
    /// How many pieces of the other end this end has taken.
    Credit { n_taken: u64 },
    /// This end is alive.
    Alive,
    /// This end closes the tunnel: without a reason because it has finished, with a reason because it cannot go on.
    Close { reason: Option<String> },
}

impl Frame<'_> {
    /// # Errors
    /// [`WireError::Unsendable`]
    pub(super) fn encode(&self) -> Result<Vec<u8>, WireError> {
        let mut bytes = Vec::new();
        envelope::seal(MAGIC, PROTOCOL, MAX_FRAME_BYTES, self, &mut bytes)?;
        Ok(bytes)
    }

    /// # Errors
    /// The bytes are not a valid frame.
    pub(super) fn decode(bytes: &[u8]) -> Result<Frame<'_>, WireError> {
        let rest = match envelope::open(MAGIC, bytes)? {
            (PROTOCOL, rest) => rest,
            (found, _) => return Err(WireError::Version { found }),
        };
        let frame: Frame = envelope::decode_plain::<_, MAX_FRAME_BYTES>(rest)?;
        let n_bytes = match &frame.body {
            Body::Data { bytes, .. } if bytes.len() > MAX_CHUNK_BYTES => bytes.len(),
            Body::Close { reason: Some(reason) } if reason.len() > MAX_REASON_BYTES => reason.len(),
            _ => return Ok(frame),
        };
        Err(WireError::Malformed(format!("a part of {n_bytes} bytes is too long")))
    }

    /// The frame with its own copy of the bytes.
    pub(super) fn into_owned(self) -> Frame<'static> {
        let body = match self.body {
            Body::Data { index, bytes } => Body::Data { index, bytes: Cow::Owned(bytes.into_owned()) },
            Body::Open => Body::Open,
            Body::Opened => Body::Opened,
            Body::Credit { n_taken } => Body::Credit { n_taken },
            Body::Alive => Body::Alive,
            Body::Close { reason } => Body::Close { reason },
        };
        Frame { id: self.id, token: self.token, is_from_asker: self.is_from_asker, body }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<Frame<'static>> {
        let bodies = [
            Body::Open,
            Body::Opened,
            Body::Data { index: 300, bytes: b"{\"request\":\"status\"}\n".into() },
            Body::Data { index: u64::MAX, bytes: [7; MAX_CHUNK_BYTES].as_slice().to_vec().into() },
            Body::Credit { n_taken: 9 },
            Body::Alive,
            Body::Close { reason: None },
            Body::Close { reason: Some("cut off".into()) },
        ];
        bodies.map(|body| Frame { id: u64::MAX, token: u64::MAX - 1, is_from_asker: true, body }).into()
    }

    #[test]
    fn frames_come_back_and_other_bytes_are_rejected() {
        for frame in frames() {
            let bytes = frame.encode().expect("encoded");
            assert_eq!(Frame::decode(&bytes).map(Frame::into_owned), Ok(frame));
            for n_bytes in 0..bytes.len().min(64) {
                Frame::decode(&bytes[..n_bytes]).expect_err("cut off");
            }
            let trailing = [bytes.as_slice(), b"x"].concat();
            assert!(matches!(Frame::decode(&trailing), Err(WireError::Oversized | WireError::Malformed(_))));
            assert_eq!(Frame::decode(&[b"xx", &bytes[2..]].concat()), Err(WireError::Foreign));
            let newer = [&MAGIC, [PROTOCOL + 1].as_slice(), &bytes[3..]].concat();
            assert_eq!(Frame::decode(&newer), Err(WireError::Version { found: PROTOCOL + 1 }));
        }
        let long = [MAGIC.as_slice(), &[PROTOCOL, 0], &[0; MAX_FRAME_BYTES]].concat();
        assert_eq!(Frame::decode(&long), Err(WireError::Oversized));
        let body = Body::Data { index: 0, bytes: [0; MAX_CHUNK_BYTES + 1].as_slice().into() };
        let chunk = Frame { id: 1, token: 1, is_from_asker: false, body }.encode().expect("encoded");
        assert!(matches!(Frame::decode(&chunk), Err(WireError::Malformed(_))));
        let body = Body::Data { index: 0, bytes: [0; MAX_FRAME_BYTES].as_slice().into() };
        let error = Frame { id: 1, token: 1, is_from_asker: false, body }.encode();
        assert!(matches!(error, Err(WireError::Unsendable(_))), "{error:?}");
    }

    #[test]
    fn damaged_frames_are_decoded_or_rejected() {
        let mut state = 1_u64;
        let mut draw = |n: usize| {
            // Knuth's linear congruential generator: enough to damage bytes.
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n
        };
        for _ in 0..20_000 {
            let frames = frames();
            let mut bytes = frames[draw(frames.len())].encode().expect("encoded");
            for _ in 0..=draw(4) {
                let idx = draw(bytes.len().min(48));
                bytes[idx] = draw(256) as u8;
            }
            bytes.truncate(bytes.len() - draw(3).min(bytes.len()));
            if let Ok(frame) = Frame::decode(&bytes) {
                assert_eq!(Frame::decode(&frame.encode().expect("encoded")), Ok(frame.clone()));
            }
        }
    }
}
