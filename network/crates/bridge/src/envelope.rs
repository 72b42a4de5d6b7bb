//! The envelope of every frame: two letters that name the protocol, one byte for its version, one for its form, and a
//! body. The body of a plain frame is in bincode; [`protection`](super::protection) makes the other forms.

use serde::{Deserialize, Serialize};

use super::wire::WireError;
use blindgrasp_graph::log::printable;

/// Bytes before the body.
pub(super) const HEAD_BYTES: usize = 4;

/// How the body of a frame is protected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    Plain = 0,
    /// A plain frame with the certificates of its sender and a signature.
    Signed = 1,
    Encrypted = 2,
}

impl Form {
    pub(super) fn of(byte: u8) -> Option<Form> {
        [Form::Plain, Form::Signed, Form::Encrypted].into_iter().find(|form| *form as u8 == byte)
    }
}

/// Puts a plain frame of at most `max_bytes` into `out` and replaces the old contents.
///
/// # Errors
/// The frame cannot be encoded or is too long. `out` is empty then: a truncated frame is never sent.
pub(super) fn seal(
    magic: [u8; 2],
    version: u8,
    max_bytes: usize,
    frame: &impl Serialize,
    out: &mut Vec<u8>,
) -> Result<(), WireError> {
    out.clear();
    out.extend(magic);
    out.extend([version, Form::Plain as u8]);
    let encoded = bincode::serde::encode_into_std_write(frame, out, bincode::config::standard());
    let sealed = match encoded {
        Err(error) => Err(WireError::Unsendable(error.to_string())),
        Ok(_) if out.len() > max_bytes => {
            Err(WireError::Unsendable(format!("it has {} bytes, at most {max_bytes} are allowed", out.len())))
        }
        Ok(_) => Ok(()),
    };
    if sealed.is_err() {
        out.clear();
    }
    sealed
}

/// The version and the rest of a message that begins with `magic`.
pub(super) fn open(magic: [u8; 2], bytes: &[u8]) -> Result<(u8, &[u8]), WireError> {
    let rest = bytes.strip_prefix(&magic).and_then(<[u8]>::split_first);
    rest.map(|(version, body)| (*version, body)).ok_or(WireError::Foreign)
}

/// Decodes the form and the body of a plain frame of at most `MAX_BYTES`.
pub(super) fn decode_plain<'a, T: Deserialize<'a>, const MAX_BYTES: usize>(rest: &'a [u8]) -> Result<T, WireError> {
    match rest.split_first() {
        Some((form, body)) if *form == Form::Plain as u8 => decode_body::<T, MAX_BYTES>(body),
        _ => Err(WireError::Malformed("it is not a plain frame".into())),
    }
}

/// Decodes the body of a frame of at most `MAX_BYTES`.
pub(super) fn decode_body<'a, T: Deserialize<'a>, const MAX_BYTES: usize>(body: &'a [u8]) -> Result<T, WireError> {
    if body.len() + HEAD_BYTES > MAX_BYTES {
        return Err(WireError::Oversized);
    }
    let config = bincode::config::standard().with_limit::<MAX_BYTES>();
    let (frame, n_bytes) = bincode::serde::borrow_decode_from_slice(body, config)
        .map_err(|error| WireError::Malformed(printable(&error.to_string())))?;
    if n_bytes != body.len() {
        return Err(WireError::Malformed(format!("{} bytes too many", body.len() - n_bytes)));
    }
    Ok(frame)
}
