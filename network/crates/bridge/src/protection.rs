//! The protection of the frames between this machine and another one. With keys, hellos are signed and all other frames
//! are encrypted; only the text of a refusal is plain. Without keys, all frames are plain.

use std::borrow::Cow;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use time::OffsetDateTime;

use super::agreement::{Agreement, SharedKeys, in_use};
use super::envelope::{self, Form, HEAD_BYTES};
use super::identity::{Identity, Proof, Unverified};
use super::wire::{Body, Frame, MAGIC, MAX_FRAME_BYTES, PROTOCOL, WireError};
use blindgrasp_graph::link::config::KeyKind;

/// Maximum size of a signed frame in bytes, with its certificates.
const MAX_SIGNED_BYTES: usize = MAX_FRAME_BYTES + (32 << 10);

/// How frames between this machine and another one are protected; the default is not at all.
#[derive(Default)]
pub struct Protection(Option<Keys>);

struct Keys {
    identity: Arc<Identity>,
    peer: String,
    pair: SharedKeys,
}

/// A received frame.
#[derive(Debug)]
pub struct Opened<'a> {
    /// It is plain now.
    bytes: Cow<'a, [u8]>,
    form: Form,
    has_keys: bool,
}

/// A signed frame as it is encoded.
#[derive(Serialize, Deserialize)]
struct Signed<'a> {
    #[serde(borrow)]
    proof: Proof<'a>,
    /// The plain frame with its head.
    #[serde(borrow)]
    frame: Cow<'a, [u8]>,
}

impl Protection {
    pub fn new(identity: Arc<Identity>, peer: &str, agreement: &Agreement) -> Protection {
        Protection(Some(Keys { identity, peer: peer.into(), pair: agreement.keys() }))
    }

    /// Signs a frame with a hello.
    ///
    /// # Errors
    /// The private key cannot sign.
    pub fn sign(&self, frame: &mut Vec<u8>) -> Result<(), Unverified> {
        let Some(keys) = &self.0 else { return Ok(()) };
        let proof = keys.identity.sign(&keys.peer, frame, OffsetDateTime::now_utc())?;
        let signed = Signed { proof, frame: frame.clone().into() };
        envelope::seal(MAGIC, PROTOCOL, MAX_SIGNED_BYTES, &signed, frame)
            .map_err(|error| Unverified(error.to_string()))?;
        frame[HEAD_BYTES - 1] = Form::Signed as u8;
        Ok(())
    }

    /// Encrypts a frame that is no hello; returns whether it can be sent. It cannot before there are keys for it.
    pub fn encrypt(&self, kind: KeyKind, frame: &mut Vec<u8>) -> bool {
        let Some(keys) = &self.0 else { return true };
        let pair = in_use(&keys.pair);
        if let Some(pair) = &pair {
            pair.encrypt(kind, frame);
        }
        pair.is_some()
    }

    /// Opens a frame of a link.
    ///
    /// # Errors
    /// It is not from this peer, or the machines have not agreed on keys.
    pub fn open<'a>(&self, kind: KeyKind, bytes: &'a [u8]) -> Result<Opened<'a>, WireError> {
        let form = match envelope::open(MAGIC, bytes) {
            Ok((PROTOCOL, rest)) => rest.first().and_then(|byte| Form::of(*byte)).unwrap_or(Form::Plain),
            // A refusal, or a frame of another version or program.
            _ => return Ok(Opened { bytes: bytes.into(), form: Form::Plain, has_keys: false }),
        };
        let bytes = match (&self.0, form) {
            (None, Form::Plain) => Cow::Borrowed(bytes),
            (Some(keys), Form::Encrypted) => Cow::Owned(keys.decrypt(kind, bytes)?),
            (Some(keys), Form::Signed) => {
                let signed: Signed<'a> = envelope::decode_body::<_, MAX_SIGNED_BYTES>(&bytes[HEAD_BYTES..])?;
                keys.identity.verify(&keys.peer, &signed.proof, &signed.frame, OffsetDateTime::now_utc())?;
                signed.frame
            }
            (Some(keys), Form::Plain) => {
                return Err(Unverified(format!(
                    "machine '{0}' does not sign its messages: start its part of the graph with its keys, `link: {{keys: \
                     DIR}}` or --keys DIR (`blindgrasp keys DIR --machine {0}` makes them)",
                    keys.peer
                ))
                .into());
            }
            (None, Form::Signed | Form::Encrypted) => {
                return Err(Unverified(
                    "its messages are signed, but this machine has no keys to check them: give both machines keys, `link: \
                     {keys: DIR}` or --keys DIR (`blindgrasp keys DIR` makes them)"
                        .into(),
                )
                .into());
            }
        };
        Ok(Opened { bytes, form, has_keys: self.0.is_some() })
    }
}

impl Keys {
    fn decrypt(&self, kind: KeyKind, bytes: &[u8]) -> Result<Vec<u8>, WireError> {
        in_use(&self.pair).ok_or(WireError::OtherKeys)?.decrypt(kind, bytes)
    }
}

impl Opened<'_> {
    /// # Errors
    /// The bytes are not a valid frame, or a refusal.
    pub fn frame(&self) -> Result<Frame<'_>, WireError> {
        let frame = Frame::decode(&self.bytes)?;
        // A hello may be read by a machine that has no keys in common yet, everything else only by the one that has.
        let is_hello = matches!(frame.body, Body::Hello(_));
        if self.has_keys && is_hello != (self.form == Form::Signed) { Err(WireError::Forged) } else { Ok(frame) }
    }
}

impl From<Unverified> for WireError {
    fn from(Unverified(reason): Unverified) -> WireError {
        WireError::Unverified(reason)
    }
}

#[cfg(test)]
mod tests;
