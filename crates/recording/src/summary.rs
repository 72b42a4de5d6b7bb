//! The summary at the end of a file.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::open_regular;
use mcap::Attachment;
use mcap::records::{ChunkIndex, MetadataIndex, Record as McapRecord, Statistics, op};
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::channels::{CONVERT, Channels};
use super::repair::unknown_info;
use super::source::{
    Growth, MAX_RECORD_BYTES, PREFIX_BYTES, longest_record, parse_attachment, parse_record, read_records,
};
use super::{METADATA_NAME, RecordingError, RecordingInfo};

/// Bytes of the footer: opcode and length, its 20 bytes, and MCAP's mark behind it.
const FOOTER_BYTES: u64 = 9 + 20 + 8;
/// Bytes of the record that ends the data, right before the summary: opcode, length and a checksum.
const DATA_END_BYTES: u64 = 9 + 4;

/// The summary of a file, with a correct checksum.
pub(super) struct FileSummary {
    pub(super) info: RecordingInfo,
    /// By name, without the recording's info.
    pub(super) metadata: BTreeMap<String, BTreeMap<String, String>>,
    pub(super) channels: Channels,
    pub(super) statistics: Option<Statistics>,
    /// In the file's order.
    pub(super) chunks: Vec<ChunkIndex>,
    pub(super) n_file_bytes: u64,
}

impl FileSummary {
    /// The topics that have samples, each with the name of its schema.
    pub(super) fn topics(&self) -> BTreeMap<String, String> {
        let counts = self.statistics.as_ref().map(|statistics| &statistics.channel_message_counts);
        // Without statistics, a named topic may be empty.
        let has_samples = |id: &u16| counts.is_none_or(|counts| counts.get(id).is_some_and(|n| *n > 0));
        let channels = self.channels.iter().filter(|known| has_samples(&known.channel.id));
        channels.map(|known| (known.channel.topic.clone(), self.channels.schema_name(known))).collect()
    }
}

/// Opens a file and reads its summary.
pub(super) fn open(path: &Path) -> Result<(File, FileSummary), RecordingError> {
    let invalid = |message: String| RecordingError::Invalid { path: path.into(), message };
    let damaged = |message: String| RecordingError::Damaged { path: path.into(), message };
    let mut file = open_mcap(path)?;
    let n_file_bytes = file.metadata().map_err(|source| RecordingError::Io { path: path.into(), source })?.len();
    let mut raw = raw_summary(&mut file, n_file_bytes).map_err(|error| {
        if is_being_written(&file) {
            invalid("it is still being recorded: it can be read when its recorder has ended".into())
        } else {
            damaged(format!("it was cut off or is damaged: expected MCAP's summary at its end ({error})"))
        }
    })?;
    let is_ours = raw.channels.iter().any(|known| known.ours.is_some());
    if is_ours && raw.metadata.iter().all(|index| index.name != METADATA_NAME) {
        let found = metadata_in_data(&mut file, n_file_bytes);
        raw.metadata_in_data = found.map_err(|message| damaged(format!("its metadata: {message}")))?;
    }
    let mut metadata = BTreeMap::new();
    for index in &raw.metadata {
        let found = read_metadata(&mut file, index, n_file_bytes)
            .map_err(|message| damaged(format!("its '{}' metadata: {message}", index.name)))?;
        metadata.insert(index.name.clone(), found);
    }
    metadata.extend(raw.metadata_in_data);
    // Other MCAP tools copy samples without metadata. The samples still say which hand they are of.
    let info = match metadata.remove(METADATA_NAME) {
        Some(found) => info_from_metadata(found)
            .map_err(|message| invalid(format!("its '{METADATA_NAME}' metadata: {message}")))?,
        None if is_ours => unknown_info(),
        None => {
            let message = format!(
                "it has no '{METADATA_NAME}' metadata and no topic of blindgrasp: expected a recording made by blindgrasp"
            );
            return Err(invalid(message));
        }
    };
    if let Some(difference) = raw.channels.other_version() {
        return Err(invalid(other_version(difference, &info)));
    }
    let RawSummary { channels, statistics, chunks, .. } = raw;
    Ok((file, FileSummary { info, metadata, channels, statistics, chunks, n_file_bytes }))
}

/// The files that are attached to a recording, in its order.
///
/// # Errors
/// As [`super::RecordingReader::open`], or an attachment is damaged.
pub fn attachments(path: &Path) -> Result<Vec<Attachment<'static>>, RecordingError> {
    let (mut file, summary) = open(path)?;
    let damaged =
        |message| RecordingError::Damaged { path: path.into(), message: format!("its attachments: {message}") };
    let mut attachments = Vec::new();
    for data in records_in_data(&mut file, summary.n_file_bytes, op::ATTACHMENT).map_err(damaged)? {
        let attachment = parse_attachment(&data).map_err(damaged)?;
        attachments.push(Attachment { data: Cow::Owned(attachment.data.into_owned()), ..attachment });
    }
    Ok(attachments)
}

/// What to say of a recording whose messages are not ours.
pub(super) fn other_version(difference: &str, info: &RecordingInfo) -> String {
    if difference.contains(CONVERT) {
        return difference.into();
    }
    let version = &info.version;
    if version == env!("CARGO_PKG_VERSION") {
        return format!("{difference}: another build of blindgrasp {version} wrote it; read it with that one");
    }
    format!(
        "{difference}: blindgrasp {version} wrote it, in another version of the messages; read it with blindgrasp {version}"
    )
}

/// Opens a file that begins as MCAP does.
pub(super) fn open_mcap(path: &Path) -> Result<File, RecordingError> {
    let mut file = open_regular(path).map_err(|source| RecordingError::Io { path: path.into(), source })?;
    let mut magic = [0; 8];
    if file.read_exact(&mut magic).is_err() || magic != *mcap::MAGIC {
        let found = FileKind::at(path).filter(|kind| *kind != FileKind::Recording).map(FileKind::description);
        let found = found.map(|found| format!(", found {found}")).unwrap_or_default();
        let message = format!("not a recording: expected an MCAP file{found}");
        return Err(RecordingError::Invalid { path: path.into(), message });
    }
    Ok(file)
}

/// Whether a recorder has the file locked.
pub(super) fn is_being_written(file: &File) -> bool {
    matches!(file.try_lock_shared(), Err(std::fs::TryLockError::WouldBlock))
}

/// A summary as it stands in the file.
#[derive(Default)]
pub(super) struct RawSummary {
    pub(super) channels: Channels,
    pub(super) statistics: Option<Statistics>,
    pub(super) chunks: Vec<ChunkIndex>,
    metadata: Vec<MetadataIndex>,
    /// By name: of a file whose index does not name them.
    metadata_in_data: BTreeMap<String, BTreeMap<String, String>>,
}

/// The summary of a file that has none but is whole otherwise, as some programs write it. All of the file is read.
fn summary_of_data(file: &mut File) -> Result<RawSummary, String> {
    file.rewind().map_err(|error| error.to_string())?;
    let options = LinearReaderOptions::default()
        .with_prevalidate_chunk_crcs(true)
        .with_check_finishes_after_end_magic(true)
        .with_record_length_limit(MAX_RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut input = std::io::BufReader::new(file);
    let mut summary = RawSummary::default();
    let refused = read_records(&mut reader, &mut input, &mut Growth::default(), |opcode, data| match opcode {
        op::SCHEMA | op::CHANNEL => summary.channels.add(opcode, data).err(),
        op::METADATA => match parse_record(opcode, data) {
            Ok(McapRecord::Metadata(found)) => {
                summary.metadata_in_data.insert(found.name, found.metadata);
                None
            }
            _ => Some("a metadata record cannot be read".into()),
        },
        _ => None,
    });
    match refused.map_err(|error| error.to_string())? {
        Some(refused) => Err(refused),
        None => Ok(summary),
    }
}

/// Reads the summary and checks that all of it is there and right.
pub(super) fn raw_summary(file: &mut File, n_file_bytes: u64) -> Result<RawSummary, String> {
    let text = |error: std::io::Error| error.to_string();
    let footer_at = n_file_bytes.checked_sub(FOOTER_BYTES).ok_or("it is too short")?;
    let mut footer = [0; FOOTER_BYTES as usize];
    file.seek(SeekFrom::Start(footer_at)).and_then(|_| file.read_exact(&mut footer)).map_err(text)?;
    if footer[29..] != *mcap::MAGIC || footer[0] != op::FOOTER {
        return Err("it does not end as MCAP does".into());
    }
    let McapRecord::Footer(found) = parse_record(op::FOOTER, &footer[9..29])? else {
        return Err("it does not end as MCAP does".into());
    };
    if found.summary_start == 0 {
        return summary_of_data(file);
    }
    let data_end = match found.summary_start.checked_sub(DATA_END_BYTES) {
        Some(data_end) if found.summary_start <= footer_at => data_end,
        _ => return Err("it has none".into()),
    };
    file.seek(SeekFrom::Start(data_end)).map_err(text)?;
    let mut reader = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(longest_record(n_file_bytes)),
    );
    let mut input = std::io::BufReader::new(file);
    let mut summary = RawSummary::default();
    let mut is_first = true;
    let refused = read_records(&mut reader, &mut input, &mut Growth::default(), |opcode, data| {
        if std::mem::take(&mut is_first) && opcode != op::DATA_END {
            return Some("it is not where the footer says".into());
        }
        summary.add(opcode, data).err()
    });
    if let Some(refused) = refused.map_err(|error| error.to_string())? {
        return Err(refused);
    }
    // 0 stands for no checksum.
    if found.summary_crc != 0 {
        summary.channels.set_checked();
    }
    check_chunks(&mut summary.chunks, data_end)?;
    Ok(summary)
}

pub(super) fn info_from_metadata(mut metadata: BTreeMap<String, String>) -> Result<RecordingInfo, String> {
    let mut take = |key: &str| metadata.remove(key).ok_or_else(|| format!("'{key}' is missing"));
    let hand_id = take("hand_id")?;
    Ok(RecordingInfo {
        hand: take("hand")?,
        hand_id: u64::from_str_radix(&hand_id, 16).map_err(|_| format!("hand_id '{hand_id}' is not hex"))?,
        made_by: take("made_by")?,
        version: take("version")?,
    })
}

impl RawSummary {
    fn add(&mut self, opcode: u8, data: &[u8]) -> Result<(), String> {
        self.channels.add(opcode, data)?;
        if !matches!(opcode, op::STATISTICS | op::CHUNK_INDEX | op::METADATA_INDEX) {
            return Ok(());
        }
        match parse_record(opcode, data)? {
            McapRecord::Statistics(statistics) => self.statistics = Some(statistics),
            McapRecord::ChunkIndex(index) => self.chunks.push(index),
            McapRecord::MetadataIndex(index) => self.metadata.push(index),
            _ => {}
        }
        Ok(())
    }
}

/// Sorts the chunks into the file's order and checks that they lie one behind the other, before the summary.
fn check_chunks(chunks: &mut [ChunkIndex], data_end: u64) -> Result<(), String> {
    chunks.sort_by_key(|index| index.chunk_start_offset);
    let mut from = mcap::MAGIC.len() as u64;
    for index in chunks {
        let end = index.chunk_start_offset.checked_add(index.chunk_length);
        match end {
            Some(end) if index.chunk_start_offset >= from && end <= data_end => from = end,
            _ => return Err(format!("its index names a chunk at {} that cannot be", index.chunk_start_offset)),
        }
    }
    Ok(())
}

/// The metadata between the chunks, by name.
fn metadata_in_data(file: &mut File, n_file_bytes: u64) -> Result<BTreeMap<String, BTreeMap<String, String>>, String> {
    let mut all = BTreeMap::new();
    for data in records_in_data(file, n_file_bytes, op::METADATA)? {
        if let McapRecord::Metadata(found) = parse_record(op::METADATA, &data)? {
            all.insert(found.name, found.metadata);
        }
    }
    Ok(all)
}

/// The contents of the records of one kind between the chunks, in order.
fn records_in_data(file: &mut File, n_file_bytes: u64, kind: u8) -> Result<Vec<Vec<u8>>, String> {
    let text = |error: std::io::Error| error.to_string();
    let mut input = std::io::BufReader::new(file);
    input.seek(SeekFrom::Start(mcap::MAGIC.len() as u64)).map_err(text)?;
    let mut found = Vec::new();
    loop {
        let mut prefix = [0; PREFIX_BYTES as usize];
        input.read_exact(&mut prefix).map_err(text)?;
        let [opcode, n_bytes @ ..] = prefix;
        let n_bytes = u64::from_le_bytes(n_bytes);
        if opcode == op::DATA_END || opcode == op::FOOTER {
            return Ok(found);
        }
        if n_bytes > n_file_bytes {
            return Err(format!("a record of {n_bytes} bytes: more than there are"));
        }
        if opcode != kind {
            input.seek_relative(n_bytes as i64).map_err(text)?;
            continue;
        }
        if n_bytes > MAX_RECORD_BYTES as u64 {
            return Err(format!("{n_bytes} bytes: expected at most {MAX_RECORD_BYTES}"));
        }
        let mut data = vec![0; n_bytes as usize];
        input.read_exact(&mut data).map_err(text)?;
        found.push(data);
    }
}

fn read_metadata(
    file: &mut File,
    index: &MetadataIndex,
    n_file_bytes: u64,
) -> Result<BTreeMap<String, String>, String> {
    if index.length > MAX_RECORD_BYTES as u64 || index.offset.saturating_add(index.length) > n_file_bytes {
        return Err(format!("{} bytes at {}: more than there are", index.length, index.offset));
    }
    let mut bytes = vec![0; index.length as usize];
    file.seek(SeekFrom::Start(index.offset))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|error| error.to_string())?;
    let record = match bytes.split_at_checked(9) {
        Some((&[op::METADATA, ..], body)) => parse_record(op::METADATA, body).ok(),
        _ => None,
    };
    match record {
        Some(McapRecord::Metadata(metadata)) if metadata.name == index.name => Ok(metadata.metadata),
        _ => Err("not where the index says".into()),
    }
}
