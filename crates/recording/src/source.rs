//! Reads the records of a file.

use std::io::Read;

use mcap::McapError;
use mcap::sans_io::{LinearReadEvent, LinearReader};

/// The longest record, far longer than ours: a damaged length would otherwise take all memory.
pub(super) const MAX_RECORD_BYTES: usize = 256 << 20;

/// An error of MCAP's library with its cause.
pub(super) fn with_cause(error: &McapError) -> String {
    let cause = std::error::Error::source(error).map_or(String::new(), |cause| format!(": {cause}"));
    format!("{error}{cause}")
}

/// Reads records, opcode and content, until `take` returns a value for one; `None` at the end.
pub(super) fn read_records<T>(
    reader: &mut LinearReader,
    input: &mut impl Read,
    mut take: impl FnMut(u8, &[u8]) -> Option<T>,
) -> Result<Option<T>, McapError> {
    while let Some(event) = reader.next_event() {
        let n_bytes = match event? {
            LinearReadEvent::ReadRequest(n_bytes) => n_bytes,
            LinearReadEvent::Record { opcode, data } => match take(opcode, data) {
                Some(taken) => return Ok(Some(taken)),
                None => continue,
            },
        };
        let n_read = loop {
            match input.read(reader.insert(n_bytes)) {
                Ok(n_read) => break n_read,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        };
        reader.notify_read(n_read);
    }
    Ok(None)
}
