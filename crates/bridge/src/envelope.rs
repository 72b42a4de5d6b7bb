//! The envelope of every frame: two letters that name the protocol, one byte for its version, and a body in bincode.

use serde::{Deserialize, Serialize};

use super::wire::WireError;
use blindgrasp_graph::log::printable;

/// Puts a frame of at most `max_bytes` into `out` and replaces the old contents.
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
    out.push(version);
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

/// The version and the body of a message that begins with `magic`.
pub(super) fn open(magic: [u8; 2], bytes: &[u8]) -> Result<(u8, &[u8]), WireError> {
    let rest = bytes.strip_prefix(&magic).and_then(<[u8]>::split_first);
    rest.map(|(version, body)| (*version, body)).ok_or(WireError::Foreign)
}

/// Decodes the body of a frame of at most `MAX_BYTES`.
pub(super) fn decode_body<'a, T: Deserialize<'a>, const MAX_BYTES: usize>(body: &'a [u8]) -> Result<T, WireError> {
    // The magic and the version have three bytes.
    if body.len() + 3 > MAX_BYTES {
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
