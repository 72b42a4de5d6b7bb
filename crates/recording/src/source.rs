//! Records out of a file: all of it, or some of its chunks.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;

use mcap::McapError;
use mcap::records::op;
use mcap::sans_io::{LinearReadEvent, LinearReader};

/// No record of ours comes near this; a damaged length would otherwise ask for all memory.
pub(super) const MAX_RECORD_BYTES: usize = 256 << 20;

/// What MCAP's library says, and what it says is the cause.
pub(super) fn with_cause(error: &McapError) -> String {
    let cause = std::error::Error::source(error).map_or(String::new(), |cause| format!(": {cause}"));
    format!("{error}{cause}")
}

/// Reads records, opcode and content, until `take` makes something of one; `None` at the end.
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

/// The bytes of a file, or of some parts of it, one after the other.
pub(super) struct Ranges {
    file: BufReader<File>,
    /// Offset and length of those to come.
    ranges: VecDeque<(u64, u64)>,
    n_left: u64,
    /// Whether each is to be a chunk, as an index says.
    are_chunks: bool,
}

impl Ranges {
    /// All of a file.
    pub(super) fn whole(file: File, n_bytes: u64) -> Self {
        Self::new(file, [(0, n_bytes)], false)
    }

    /// Chunks: offset and length of each. Reading fails where there is none.
    pub(super) fn chunks(file: File, chunks: impl IntoIterator<Item = (u64, u64)>) -> Self {
        Self::new(file, chunks, true)
    }

    fn new(file: File, ranges: impl IntoIterator<Item = (u64, u64)>, are_chunks: bool) -> Self {
        let file = BufReader::with_capacity(64 << 10, file);
        Ranges { file, ranges: ranges.into_iter().collect(), n_left: 0, are_chunks }
    }

    /// A record of another kind would be passed over, and nobody would notice that its samples are not there.
    fn check_chunk(&self, offset: u64, n_bytes: u64) -> std::io::Result<()> {
        let mut prefix = [0; 9];
        self.file.get_ref().read_exact_at(&mut prefix, offset)?;
        let [opcode, length @ ..] = prefix;
        if opcode == op::CHUNK && u64::from_le_bytes(length).checked_add(prefix.len() as u64) == Some(n_bytes) {
            return Ok(());
        }
        let message = format!("expected a chunk of {n_bytes} bytes at {offset}, as its index says");
        Err(std::io::Error::new(std::io::ErrorKind::InvalidData, message))
    }
}

impl Read for Ranges {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        while self.n_left == 0 {
            let Some((offset, n_bytes)) = self.ranges.pop_front() else { return Ok(0) };
            if self.are_chunks {
                self.check_chunk(offset, n_bytes)?;
            }
            self.file.seek(SeekFrom::Start(offset))?;
            self.n_left = n_bytes;
        }
        let n_bytes = buffer.len().min(usize::try_from(self.n_left).unwrap_or(usize::MAX));
        let n_read = self.file.read(&mut buffer[..n_bytes])?;
        if n_read == 0 {
            self.ranges.clear();
        }
        self.n_left -= n_read as u64;
        Ok(n_read)
    }
}
