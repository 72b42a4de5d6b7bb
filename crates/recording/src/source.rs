//! Reads the records of a file.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read};
use std::ops::Range;

use mcap::records::{Record as McapRecord, op};
use mcap::sans_io::{LinearReadEvent, LinearReader};
use mcap::{Attachment, McapError};

/// The longest record, far longer than ours: a damaged length would otherwise take all memory.
pub(super) const MAX_RECORD_BYTES: usize = 256 << 20;
/// The longest record of a file: none is longer than its file, but those that are compressed.
pub(super) fn longest_record(n_file_bytes: u64) -> usize {
    MAX_RECORD_BYTES.min(usize::try_from(n_file_bytes).unwrap_or(usize::MAX))
}

/// A part of a record.
enum Field {
    /// Bytes of a known number.
    Bytes(usize),
    /// A length of 32 bits, and so many bytes of text.
    Text,
    /// A length of 32 bits, and so many bytes of pairs of texts.
    Texts,
    /// A length of 32 bits, and so many bytes of numbers.
    Numbers,
}

/// The fields of the records that have texts, up to the last of them (MCAP specification, "Records"). An attachment has its
/// length and checksum behind them, which MCAP's library takes for granted.
fn fields(opcode: u8) -> &'static [Field] {
    use Field::{Bytes, Numbers, Text, Texts};
    match opcode {
        op::HEADER => &[Text, Text],
        op::SCHEMA => &[Bytes(2), Text, Text],
        op::CHANNEL => &[Bytes(2 + 2), Text, Text, Texts],
        op::CHUNK => &[Bytes(8 + 8 + 8 + 4), Text],
        op::CHUNK_INDEX => &[Bytes(8 + 8 + 8 + 8), Numbers, Bytes(8), Text],
        op::ATTACHMENT => &[Bytes(8 + 8), Text, Text, Bytes(8 + 4)],
        op::ATTACHMENT_INDEX => &[Bytes(8 + 8 + 8 + 8 + 8), Text, Text],
        op::METADATA => &[Text, Texts],
        op::METADATA_INDEX => &[Bytes(8 + 8), Text],
        _ => &[],
    }
}

/// Reads a record. MCAP's library takes memory for a text before it looks whether the record has so many bytes, up to 4 GiB: so
/// the lengths are checked before.
///
/// # Errors
/// A length is greater than the record, or the record is not as its type says.
pub(super) fn parse_record(opcode: u8, data: &[u8]) -> Result<McapRecord<'_>, String> {
    let mut rest = data;
    for field in fields(opcode) {
        match field {
            Field::Bytes(n) => drop(take(&mut rest, *n)?),
            Field::Text | Field::Numbers => drop(take_counted(&mut rest)?),
            Field::Texts => {
                // The last pair may be longer than the length says: MCAP's library reads it as well.
                let n_after = rest.len().saturating_sub(4 + number(rest)?);
                take(&mut rest, 4)?;
                while rest.len() > n_after {
                    take_counted(&mut rest)?;
                    take_counted(&mut rest)?;
                }
            }
        }
    }
    mcap::parse_record(opcode, data).map_err(|error| with_cause(&error))
}

/// Reads the record of an attachment, and checks it by its checksum if it has one.
pub(super) fn parse_attachment(data: &[u8]) -> Result<Attachment<'_>, String> {
    let McapRecord::Attachment { header, data, .. } = parse_record(op::ATTACHMENT, data)? else {
        return Err("it is no attachment".into());
    };
    let (log_time, create_time) = (header.log_time, header.create_time);
    Ok(Attachment { log_time, create_time, name: header.name, media_type: header.media_type, data })
}

fn take<'a>(rest: &mut &'a [u8], n: usize) -> Result<&'a [u8], String> {
    let (taken, after) = rest
        .split_at_checked(n)
        .ok_or_else(|| format!("a record has a length of {n} bytes where it has {} more", rest.len()))?;
    *rest = after;
    Ok(taken)
}

fn take_counted<'a>(rest: &mut &'a [u8]) -> Result<&'a [u8], String> {
    let n = number(rest)?;
    take(rest, 4)?;
    take(rest, n)
}

/// The number of 32 bits at the beginning.
fn number(bytes: &[u8]) -> Result<usize, String> {
    let mut bytes = bytes;
    let number = take(&mut bytes, 4)?;
    Ok(number.iter().rev().fold(0, |number, byte| number << 8 | usize::from(*byte)))
}

/// Bytes of a record before its content: opcode and length.
pub(super) const PREFIX_BYTES: u64 = 1 + 8;

/// An error of MCAP's library with its cause.
pub(super) fn with_cause(error: &McapError) -> String {
    let cause = std::error::Error::source(error).map_or(String::new(), |cause| format!(": {cause}"));
    format!("{error}{cause}")
}

/// Most bytes of records for each byte of a file. Our recordings hold 4 to 14; the index of every message alone takes 16
/// bytes. Zstd can hold 30,000, and a file of a gigabyte would keep its reader busy for hours.
const MAX_GROWTH: u64 = 500;
/// A file may become this many bytes, however small it is: it takes less than a second.
const MIN_CHECKED_BYTES: u64 = MAX_RECORD_BYTES as u64;

/// A file without some ranges of its bytes.
pub(super) struct Input {
    file: BufReader<File>,
    /// Where the next byte comes from.
    pub(super) at: u64,
    /// The ranges to skip, in order.
    skipped: VecDeque<Range<u64>>,
    pub(super) has_skipped: bool,
}

impl Input {
    /// The bytes of a file from its beginning, where it must be.
    pub(super) fn new(file: File) -> Self {
        Input { file: BufReader::with_capacity(64 << 10, file), at: 0, skipped: VecDeque::new(), has_skipped: false }
    }

    /// Leaves out a range that lies ahead.
    pub(super) fn skip(&mut self, bytes: Range<u64>) {
        let idx = self.skipped.partition_point(|other| other.start < bytes.start);
        self.skipped.insert(idx, bytes);
    }
}

impl Read for Input {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        while let Some(range) = self.skipped.pop_front_if(|range| range.start <= self.at) {
            let n_bytes = range.end.saturating_sub(self.at);
            self.file.seek_relative(n_bytes as i64)?;
            self.at += n_bytes;
            self.has_skipped = true;
        }
        let most = self.skipped.front().map_or(u64::MAX, |range| range.start - self.at);
        let most = usize::try_from(most).unwrap_or(usize::MAX).min(buffer.len());
        let n_read = self.file.read(&mut buffer[..most])?;
        self.at += n_read as u64;
        Ok(n_read)
    }
}

/// How much a file's bytes have grown by decompression so far.
#[derive(Default)]
pub(super) struct Growth {
    n_file_bytes: u64,
    n_record_bytes: u64,
}

impl Growth {
    fn check(&self) -> Result<(), McapError> {
        let Growth { n_file_bytes, n_record_bytes } = *self;
        if n_record_bytes <= MIN_CHECKED_BYTES.max(n_file_bytes.saturating_mul(MAX_GROWTH)) {
            return Ok(());
        }
        Err(McapError::DecompressionError(format!(
            "{n_file_bytes} bytes became {n_record_bytes}: expected at most {MAX_GROWTH} for each, as of any real recording"
        )))
    }
}

/// Reads records, opcode and content, until `take` returns a value for one; `None` at the end. `growth` is that of the
/// whole file.
pub(super) fn read_records<T>(
    reader: &mut LinearReader,
    input: &mut impl Read,
    growth: &mut Growth,
    mut take: impl FnMut(u8, &[u8]) -> Option<T>,
) -> Result<Option<T>, McapError> {
    loop {
        // It is checked before a chunk is decompressed, too.
        growth.check()?;
        let Some(event) = reader.next_event() else { return Ok(None) };
        let n_bytes = match event? {
            LinearReadEvent::ReadRequest(n_bytes) => n_bytes,
            LinearReadEvent::Record { opcode, data } => {
                growth.n_record_bytes += data.len() as u64 + PREFIX_BYTES;
                match take(opcode, data) {
                    Some(taken) => return Ok(Some(taken)),
                    None => continue,
                }
            }
        };
        let n_read = loop {
            match input.read(reader.insert(n_bytes)) {
                Ok(n_read) => break n_read,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        };
        growth.n_file_bytes += n_read as u64;
        reader.notify_read(n_read);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::*;
    use crate::writer::{info_metadata, write_options};
    use crate::{METADATA_NAME, RecordingReader, repair};
    use mcap::records::{MessageHeader, Metadata};

    /// Writes a recording with messages of 64 MiB that compress to almost nothing, each in a chunk of its own.
    fn write_bomb(path: &Path, n_chunks: u32) {
        let file = std::io::BufWriter::new(std::fs::File::create(path).expect("created"));
        let mut writer = write_options().create(file).expect("begun");
        let metadata = Metadata { name: METADATA_NAME.into(), metadata: info_metadata(&crate::tests::info()) };
        writer.write_metadata(&metadata).expect("written");
        let channel_id = writer.add_channel(0, "/camera", "", &BTreeMap::new()).expect("added");
        let black = vec![0; 64 << 20];
        for sequence in 0..n_chunks {
            let header = MessageHeader { channel_id, sequence, log_time: 0, publish_time: 0 };
            writer.write_to_known_channel(&header, &black).expect("written");
            writer.flush().expect("flushed");
        }
        writer.finish().expect("finished");
    }

    #[test]
    fn a_small_file_that_becomes_huge_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("bomb.mcap");
        write_bomb(&path, 3);
        assert_eq!(RecordingReader::open(&path).expect("opened").count(), 0, "foreign messages within the limit");
        write_bomb(&path, 6);
        let found: Result<Vec<_>, _> = RecordingReader::open(&path).expect("opened").collect();
        let error = found.expect_err("a bomb").to_string();
        assert!(error.contains("bomb.mcap") && error.contains("expected at most 500 for each"), "{error}");
        let report = repair(&path).expect("a beginning");
        assert!(report.n_recovered["/camera"] < 6 && report.n_damaged_chunks > 0, "{report:?}");
    }

    #[test]
    fn a_length_that_is_greater_than_its_record_is_refused_before_memory_is_taken() {
        let text = |length: u32, text: &str| [&length.to_le_bytes()[..], text.as_bytes()].concat();
        let index = |length| [&[0; 16][..], &text(length, "some")].concat();
        let found = parse_record(op::METADATA_INDEX, &index(4)).map(|record| match record {
            McapRecord::MetadataIndex(index) => index.name,
            _ => String::new(),
        });
        assert_eq!(found.as_deref(), Ok("some"));
        let error = parse_record(op::METADATA_INDEX, &index(0xff00_0007)).err();
        assert_eq!(error.as_deref(), Some("a record has a length of 4278190087 bytes where it has 4 more"));
        let metadata = |length, value| {
            let pair = [text(3, "key"), text(length, value)].concat();
            [text(4, "name"), (pair.len() as u32).to_le_bytes().to_vec(), pair].concat()
        };
        let Ok(McapRecord::Metadata(found)) = parse_record(op::METADATA, &metadata(5, "value")) else {
            panic!("expected metadata");
        };
        assert_eq!(found.metadata["key"], "value");
        assert!(parse_record(op::METADATA, &metadata(u32::MAX, "value")).is_err());
        assert!(parse_record(op::CHUNK_INDEX, &[0; 40]).is_err());
    }
}
