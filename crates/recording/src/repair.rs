//! Makes a recording of the whole samples in a recording that was cut off or damaged.
//!
//! Nothing is made up: samples and attachments are copied as they are. A chunk with a wrong checksum is left out; of a chunk that is
//! cut off, the beginning is taken. Samples that no checksum covers are counted separately.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use blindgrasp_messages::files::partial_path;
use mcap::Writer;
use mcap::records::{MessageHeader, Metadata, Record as McapRecord, Statistics, op};
use mcap::sans_io::{LinearReader, LinearReaderOptions};
use serde::{Serialize, Serializer};

use super::channels::Channels;
use super::reader::{RecordingReader, message_parts};
use super::source::{Growth, MAX_RECORD_BYTES, PREFIX_BYTES, parse_attachment, parse_record, read_records};
use super::summary::{info_from_metadata, is_being_written, open_mcap, raw_summary};
use super::writer::{complete, info_metadata, lock_partial, write_error, write_options};
use super::{METADATA_NAME, RecordingError, RecordingInfo};

/// The metadata of a repaired recording about its repair.
const REPAIR_METADATA_NAME: &str = "repair";
/// Bytes of a chunk before the name of its compression: two times, size, checksum, length of that name.
const CHUNK_FIXED_BYTES: usize = 8 + 8 + 8 + 4 + 4;
/// The bytes that follow in each chunk of ours, by which a chunk is found in a damaged file.
const ZSTD_NAME: &[u8] = b"\x04\0\0\0zstd";
/// Bytes of the record that ends the data: its checksum.
const DATA_END_CONTENT_BYTES: u64 = 4;
/// Bytes of the file that are searched at a time.
const WINDOW_BYTES: usize = 1 << 20;
/// The longest record beside chunks and attachments: metadata. A damaged length would otherwise hide the records behind it.
const MAX_METADATA_BYTES: u64 = 16 << 20;

/// The outcome of a repair.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct RepairReport {
    /// The recording, which stays as it is.
    #[serde(serialize_with = "path_as_text")]
    pub input: PathBuf,
    /// The repaired recording; `None` if the input is whole.
    #[serde(serialize_with = "path_as_text")]
    pub output: Option<PathBuf>,
    /// Whether the recording's own metadata (the hand, what made it) was found; otherwise the hand is `unknown`.
    pub has_info: bool,
    /// Recovered messages of each topic.
    pub n_recovered: BTreeMap<String, u64>,
    /// Recovered messages of each topic that damage may have changed, because no checksum covers them or their channel
    /// and schema. They lie outside chunks, or in a chunk that is cut off or has no checksum.
    pub n_unverified: BTreeMap<String, u64>,
    /// Lost messages of each topic, as far as the rest of the file tells.
    pub n_lost: BTreeMap<String, u64>,
    /// Lost messages of unknown topics.
    pub n_of_unknown_topics: u64,
    /// Lost attachments, as far as the rest of the file tells.
    pub n_lost_attachments: u64,
    /// Whole chunks.
    pub n_chunks: u64,
    /// Damaged chunks, which were left out.
    pub n_damaged_chunks: u64,
    /// Whether the last chunk is cut off; its beginning was taken.
    pub has_partial_chunk: bool,
    /// Bytes that are no records.
    pub n_skipped_bytes: u64,
    /// Whether the file's end is there.
    pub has_end: bool,
    /// Whether the end of the samples is there, which lies before the index. Without it, nobody knows how many came after.
    pub has_data_end: bool,
}

impl RepairReport {
    /// Whether samples are lost, or may be: after the last chunk of a file whose end is missing.
    pub fn has_loss(&self) -> bool {
        !self.has_data_end
            || self.n_damaged_chunks > 0
            || self.has_partial_chunk
            || self.n_skipped_bytes > 0
            || self.n_of_unknown_topics > 0
            || self.n_lost_attachments > 0
            || self.n_lost.values().any(|n_lost| *n_lost > 0)
    }
}

/// The path of the repaired recording of `path`.
pub fn repaired_path(path: &Path) -> PathBuf {
    path.with_file_name(format!("{}.repaired.mcap", path.file_stem().unwrap_or_default().to_string_lossy()))
}

/// Writes the whole samples of a damaged recording to [`repaired_path`] beside it.
///
/// # Errors The recording is no MCAP file, is still being recorded or has no whole sample; there is a repaired
/// recording already; or the repaired recording cannot be written.
pub fn repair(path: &Path) -> Result<RepairReport, RecordingError> {
    let file = open_mcap(path)?;
    if is_being_written(&file) {
        let message = "it is still being recorded: it can be repaired when its recorder has ended".into();
        return Err(RecordingError::Invalid { path: path.into(), message });
    }
    if let Some(report) = report_of_whole(path) {
        return Ok(report);
    }
    let output = repaired_path(path);
    if output.exists() {
        let message = "there is a repaired recording of that name: use it, or move it away".into();
        return Err(RecordingError::Invalid { path: output, message });
    }
    let repaired = Repair::begin(path, file, &output)?.finish(path, &output);
    if repaired.is_err() {
        let _ = std::fs::remove_file(partial_path(&output));
    }
    repaired
}

/// A repair in progress.
struct Repair {
    file: File,
    n_file_bytes: u64,
    /// Whether only the summary is left to read.
    is_past_data: bool,
    /// The chunks' offsets by the summary; none without a summary.
    chunk_offsets: Vec<u64>,
    /// The numbers of messages and attachments by the summary.
    expected: Option<Statistics>,
    channels: Channels,
    salvage: Salvage,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    growth: Growth,
    report: RepairReport,
}

/// The repaired recording.
struct Salvage {
    writer: Writer<BufWriter<File>>,
    /// The output's channel for each of the input's channels.
    ids: BTreeMap<u16, u16>,
    /// [`Channels::n_replaced`] when `ids` was made.
    n_replaced: u64,
    /// Messages taken from the present chunk, by channel.
    n_of_chunk: BTreeMap<u16, u64>,
    n_attachments: u64,
    failed: Option<mcap::McapError>,
}

/// A chunk's header.
struct ChunkAt {
    /// The end of its record, by the record's length.
    record_end: u64,
    /// The end of its data, by the data's own length.
    data_end: u64,
    /// The bytes of its header, behind opcode and length.
    header: Vec<u8>,
    n_compressed_bytes: u64,
    has_checksum: bool,
}

impl Repair {
    fn begin(path: &Path, mut file: File, output: &Path) -> Result<Repair, RecordingError> {
        let metadata = file.metadata().map_err(|source| RecordingError::Io { path: path.into(), source })?;
        let n_file_bytes = metadata.len();
        let mut chunk_offsets = Vec::new();
        let (mut channels, mut expected) = (Channels::default(), None);
        if let Ok(summary) = raw_summary(&mut file, n_file_bytes) {
            chunk_offsets.extend(summary.chunks.iter().map(|index| index.chunk_start_offset));
            channels = summary.channels;
            expected = summary.statistics;
        }
        let partial = lock_partial(output)?;
        let writer = write_options().create(BufWriter::new(partial)).map_err(|error| write_error(output, error))?;
        Ok(Repair {
            file,
            n_file_bytes,
            is_past_data: false,
            chunk_offsets,
            expected,
            channels,
            salvage: Salvage {
                writer,
                ids: BTreeMap::new(),
                n_replaced: 0,
                n_of_chunk: BTreeMap::new(),
                n_attachments: 0,
                failed: None,
            },
            metadata: BTreeMap::new(),
            growth: Growth::default(),
            report: RepairReport { input: path.into(), ..RepairReport::default() },
        })
    }

    fn finish(mut self, path: &Path, output: &Path) -> Result<RepairReport, RecordingError> {
        self.scan().map_err(|source| RecordingError::Io { path: path.into(), source })?;
        self.count_lost();
        let Repair { channels, salvage, mut metadata, mut report, .. } = self;
        let info = metadata.remove(METADATA_NAME).and_then(|found| info_from_metadata(found).ok());
        report.has_info = info.is_some();
        if report.n_recovered.is_empty() {
            let why = channels.other_version().map_or(String::new(), |difference| format!(": {difference}"));
            let message = format!("there is no whole sample in it to recover{why}");
            return Err(RecordingError::Invalid { path: path.into(), message });
        }
        metadata.insert(METADATA_NAME.into(), info_metadata(&info.unwrap_or_else(unknown_info)));
        metadata.insert(REPAIR_METADATA_NAME.into(), repair_metadata(path, &report));
        salvage.complete(output, metadata)?;
        report.output = Some(output.into());
        Ok(report)
    }

    /// Counts the lost attachments, and the lost messages of each topic, by the summary, if there is one: it is complete, the
    /// rest of the indexes may not be.
    fn count_lost(&mut self) {
        let report = &mut self.report;
        if let Some(expected) = &self.expected {
            report.n_lost_attachments = u64::from(expected.attachment_count).saturating_sub(self.salvage.n_attachments);
            report.n_lost.clear();
            for known in self.channels.iter() {
                let n_expected = expected.channel_message_counts.get(&known.channel.id).copied().unwrap_or(0);
                *report.n_lost.entry(known.channel.topic.clone()).or_default() += n_expected;
            }
            for (topic, n_lost) in &mut report.n_lost {
                *n_lost = n_lost.saturating_sub(report.n_recovered.get(topic).copied().unwrap_or(0));
            }
        }
        report.n_lost.retain(|_, n_lost| *n_lost > 0);
    }

    /// Goes through the file, record by record. Where there is no record, it searches for the next chunk.
    fn scan(&mut self) -> std::io::Result<()> {
        let mut at = mcap::MAGIC.len() as u64;
        let mut last_chunk_is_damaged = false;
        while let Some((opcode, n_bytes)) = self.record_at(at)? {
            let end = at.saturating_add(PREFIX_BYTES).saturating_add(n_bytes);
            if opcode == op::CHUNK {
                self.report.has_data_end = false;
                let (next, is_whole) = self.chunk(at)?;
                last_chunk_is_damaged = !is_whole;
                at = next;
                continue;
            }
            // Indexes and the summary contain no samples.
            if opcode == op::DATA_END {
                self.is_past_data = true;
                self.report.has_data_end = n_bytes == DATA_END_CONTENT_BYTES;
            }
            if end > self.n_file_bytes && (self.is_past_data || opcode == op::MESSAGE_INDEX) {
                return Ok(());
            }
            if end > self.n_file_bytes || n_bytes > longest(opcode) || !self.is_plausible(end)? {
                self.report.n_lost_attachments += u64::from(opcode == op::ATTACHMENT);
                at = self.skip_to_chunk(at)?;
                continue;
            }
            match opcode {
                op::SCHEMA | op::CHANNEL | op::METADATA | op::ATTACHMENT | op::MESSAGE | op::MESSAGE_INDEX => {
                    let data = self.read(at + PREFIX_BYTES, n_bytes)?;
                    self.record(opcode, &data, last_chunk_is_damaged);
                }
                // The summary repeats schemas and channels.
                op::FOOTER => {
                    self.report.has_end = end + mcap::MAGIC.len() as u64 == self.n_file_bytes;
                    if self.report.has_end {
                        return Ok(());
                    }
                }
                _ => {}
            }
            if let Some(error) = self.salvage.failed.take() {
                return Err(std::io::Error::other(error));
            }
            at = end;
        }
        if !self.is_past_data {
            self.report.n_skipped_bytes += self.n_file_bytes.saturating_sub(at);
        }
        Ok(())
    }

    /// A record beside the chunks.
    fn record(&mut self, opcode: u8, data: &[u8], last_chunk_is_damaged: bool) {
        match opcode {
            op::SCHEMA | op::CHANNEL => self.channels.replace(opcode, data, false),
            op::MESSAGE => self.salvage.message(data, false, &self.channels, &mut self.report),
            op::ATTACHMENT => self.salvage.attachment(data, &mut self.report),
            op::METADATA => {
                if let Ok(McapRecord::Metadata(found)) = parse_record(opcode, data) {
                    self.metadata.insert(found.name, found.metadata);
                }
            }
            // The index has the number of messages in the chunk before, which is damaged.
            _ if last_chunk_is_damaged => {
                let Ok(McapRecord::MessageIndex(index)) = parse_record(opcode, data) else { return };
                let n_taken = self.salvage.n_of_chunk.get(&index.channel_id).copied().unwrap_or(0);
                let n_lost = (index.records.len() as u64).saturating_sub(n_taken);
                match self.channels.get(index.channel_id) {
                    Some(known) => *self.report.n_lost.entry(known.channel.topic.clone()).or_default() += n_lost,
                    None => self.report.n_of_unknown_topics += n_lost,
                }
            }
            _ => {}
        }
    }

    /// Recovers the messages of the chunk at `at`. Returns where to go on, and whether the chunk was whole.
    fn chunk(&mut self, at: u64) -> std::io::Result<(u64, bool)> {
        let Some(chunk) = self.chunk_at(at)? else {
            self.report.n_damaged_chunks += 1;
            return Ok((self.skip_to_chunk(at)?, false));
        };
        self.salvage.n_of_chunk.clear();
        if chunk.data_end <= self.n_file_bytes {
            let is_whole = self.chunk_records(&chunk, chunk.data_end, true)?;
            let counted = if is_whole { &mut self.report.n_chunks } else { &mut self.report.n_damaged_chunks };
            *counted += 1;
            // A record may be longer than its data, and its length may be damaged.
            for end in [chunk.record_end, chunk.data_end] {
                if end >= chunk.data_end && end <= self.n_file_bytes && self.is_plausible(end)? {
                    return Ok((end, is_whole));
                }
            }
            let next = if is_whole { chunk.data_end } else { at };
            return Ok((if is_whole { next } else { self.skip_to_chunk(at)? }, is_whole));
        }
        // The chunk is cut off by the end of the file or by another chunk.
        let end = self.next_chunk(at + 1)?.unwrap_or(self.n_file_bytes);
        self.chunk_records(&chunk, end, false)?;
        self.report.has_partial_chunk = true;
        Ok((end, false))
    }

    /// Copies a chunk's messages, of a whole chunk only if its checksum is right. Returns whether it could be read.
    fn chunk_records(&mut self, chunk: &ChunkAt, end: u64, is_whole: bool) -> std::io::Result<bool> {
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(is_whole)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let mut reader = LinearReader::new_with_options(options);
        let mut prefix = vec![op::CHUNK];
        prefix.extend((chunk.header.len() as u64 + chunk.n_compressed_bytes).to_le_bytes());
        prefix.extend(&chunk.header);
        let data = FileSlice { file: &self.file, at: chunk.data_end - chunk.n_compressed_bytes, end };
        let mut input = prefix.chain(data);
        // The messages of a whole chunk have passed its checksum.
        let is_checked = is_whole && chunk.has_checksum;
        let Repair { channels, salvage, report, growth, .. } = self;
        let read = read_records(&mut reader, &mut input, growth, |opcode, data| {
            match opcode {
                op::SCHEMA | op::CHANNEL => channels.replace(opcode, data, is_checked),
                op::MESSAGE => salvage.message(data, is_checked, channels, report),
                _ => {}
            }
            salvage.failed.take()
        });
        match read {
            Ok(Some(error)) => Err(std::io::Error::other(error)),
            Ok(None) => Ok(true),
            Err(_) => Ok(false),
        }
    }

    /// Opcode and length of the record at `at`; `None` at the end of the file.
    fn record_at(&self, at: u64) -> std::io::Result<Option<(u8, u64)>> {
        if at.saturating_add(PREFIX_BYTES) > self.n_file_bytes {
            return Ok(None);
        }
        let mut prefix = [0; PREFIX_BYTES as usize];
        self.file.read_exact_at(&mut prefix, at)?;
        let [opcode, n_bytes @ ..] = prefix;
        Ok(Some((opcode, u64::from_le_bytes(n_bytes))))
    }

    /// Whether a record may begin at `at`, or the file ends there.
    fn is_plausible(&self, at: u64) -> std::io::Result<bool> {
        if at == self.n_file_bytes || at + mcap::MAGIC.len() as u64 == self.n_file_bytes {
            return Ok(true);
        }
        Ok(match self.record_at(at)? {
            // The file ends within opcode and length.
            None => at < self.n_file_bytes,
            Some((opcode, n_bytes)) => {
                // A chunk's own lengths are checked instead.
                let is_chunk = opcode == op::CHUNK && self.chunk_at(at)?.is_some();
                is_chunk || ((op::HEADER..=op::DATA_END).contains(&opcode) && n_bytes <= longest(opcode))
            }
        })
    }

    /// The header of the chunk at `at`, if there is one.
    fn chunk_at(&self, at: u64) -> std::io::Result<Option<ChunkAt>> {
        let Some((op::CHUNK, n_bytes)) = self.record_at(at)? else { return Ok(None) };
        let header_at = at + PREFIX_BYTES;
        let n_most = (CHUNK_FIXED_BYTES + 16 + 8) as u64;
        let header = self.read(header_at, n_most.min(self.n_file_bytes - header_at))?;
        let number = |from: usize, n: usize| -> Option<u64> {
            let bytes = header.get(from..from + n)?;
            Some(bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
        };
        let (Some(n_uncompressed_bytes), Some(checksum), Some(n_name_bytes @ 0..=16)) =
            (number(16, 8), number(24, 4), number(28, 4))
        else {
            return Ok(None);
        };
        let size_at = CHUNK_FIXED_BYTES + n_name_bytes as usize;
        let Some(n_compressed_bytes) = number(size_at, 8) else { return Ok(None) };
        if n_uncompressed_bytes.max(n_compressed_bytes) > MAX_RECORD_BYTES as u64 {
            return Ok(None);
        }
        let n_header_bytes = size_at + 8;
        Ok(Some(ChunkAt {
            record_end: header_at.saturating_add(n_bytes),
            data_end: header_at + n_header_bytes as u64 + n_compressed_bytes,
            header: header[..n_header_bytes].to_vec(),
            n_compressed_bytes,
            // 0 stands for no checksum.
            has_checksum: checksum != 0,
        }))
    }

    fn skip_to_chunk(&mut self, at: u64) -> std::io::Result<u64> {
        let next = self.next_chunk(at + 1)?.unwrap_or(self.n_file_bytes);
        self.report.n_skipped_bytes += next - at;
        Ok(next)
    }

    /// The offset of the next chunk, at `from` or behind it.
    fn next_chunk(&self, from: u64) -> std::io::Result<Option<u64>> {
        let indexed = self.chunk_offsets.iter().copied().find(|offset| *offset >= from);
        let name_at = PREFIX_BYTES + (CHUNK_FIXED_BYTES - 4) as u64;
        let mut window_at = from + name_at;
        while window_at < self.n_file_bytes && indexed.is_none_or(|indexed| window_at - name_at < indexed) {
            let n_bytes = (WINDOW_BYTES as u64).min(self.n_file_bytes - window_at);
            let window = self.read(window_at, n_bytes)?;
            for (idx, bytes) in window.windows(ZSTD_NAME.len()).enumerate() {
                let at = window_at + idx as u64 - name_at;
                if bytes == ZSTD_NAME && self.chunk_at(at)?.is_some() {
                    return Ok(Some(indexed.map_or(at, |indexed| indexed.min(at))));
                }
            }
            // The name may lie across two windows.
            window_at += (n_bytes + 1).saturating_sub(ZSTD_NAME.len() as u64).max(1);
        }
        Ok(indexed)
    }

    fn read(&self, at: u64, n_bytes: u64) -> std::io::Result<Vec<u8>> {
        let mut bytes = vec![0; n_bytes as usize];
        self.file.read_exact_at(&mut bytes, at)?;
        Ok(bytes)
    }
}

impl Salvage {
    /// Copies a message, if it can be read. `is_checked` says that a checksum covers it.
    fn message(&mut self, record: &[u8], is_checked: bool, channels: &Channels, report: &mut RepairReport) {
        let Some((header, data)) = message_parts(record) else { return };
        let channel_id = header.channel_id;
        let Some(known) = channels.get(channel_id) else {
            report.n_of_unknown_topics += 1;
            return;
        };
        let topic = &known.channel.topic;
        let is_whole = known.other_version.is_none() && known.ours.is_none_or(|ours| ours.decode(data).is_ok());
        if !is_whole {
            *report.n_lost.entry(topic.clone()).or_default() += 1;
            return;
        }
        let written = self
            .output_id(channel_id, channels)
            .and_then(|id| self.writer.write_to_known_channel(&MessageHeader { channel_id: id, ..header }, data));
        match written {
            Ok(()) => {
                *report.n_recovered.entry(topic.clone()).or_default() += 1;
                if !is_checked || !channels.is_checked(&known.channel) {
                    *report.n_unverified.entry(topic.clone()).or_default() += 1;
                }
                *self.n_of_chunk.entry(channel_id).or_default() += 1;
            }
            Err(error) => self.failed = Some(error),
        }
    }

    /// Copies an attachment, if its checksum is right.
    fn attachment(&mut self, record: &[u8], report: &mut RepairReport) {
        let Ok(attachment) = parse_attachment(record) else {
            report.n_lost_attachments += 1;
            return;
        };
        match self.writer.attach(&attachment) {
            Ok(()) => self.n_attachments += 1,
            Err(error) => self.failed = Some(error),
        }
    }

    fn output_id(&mut self, channel_id: u16, channels: &Channels) -> mcap::McapResult<u16> {
        let Some(known) = channels.get(channel_id) else { return Ok(0) };
        let channel = &known.channel;
        if self.n_replaced != channels.n_replaced() {
            self.n_replaced = channels.n_replaced();
            self.ids.clear();
        }
        if let Some(id) = self.ids.get(&channel_id) {
            return Ok(*id);
        }
        let schema_id = match channels.schema(channel) {
            Some(schema) => self.writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        let id = self.writer.add_channel(schema_id, &channel.topic, &channel.message_encoding, &channel.metadata)?;
        self.ids.insert(channel_id, id);
        Ok(id)
    }

    fn complete(
        mut self,
        output: &Path,
        metadata: BTreeMap<String, BTreeMap<String, String>>,
    ) -> Result<(), RecordingError> {
        for (name, metadata) in metadata {
            self.writer.write_metadata(&Metadata { name, metadata }).map_err(|error| write_error(output, error))?;
        }
        complete(self.writer, output)
    }
}

/// A part of a file, read without moving the file's position.
struct FileSlice<'a> {
    file: &'a File,
    at: u64,
    end: u64,
}

impl Read for FileSlice<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let n_left = usize::try_from(self.end.saturating_sub(self.at)).unwrap_or(usize::MAX);
        let n_bytes = buffer.len().min(n_left);
        let n_read = self.file.read_at(&mut buffer[..n_bytes], self.at)?;
        self.at += n_read as u64;
        Ok(n_read)
    }
}

/// The length of the longest record of that kind beside chunks.
fn longest(opcode: u8) -> u64 {
    if opcode == op::ATTACHMENT { MAX_RECORD_BYTES as u64 } else { MAX_METADATA_BYTES }
}

/// The report of a recording that needs no repair; `None` if it needs one.
fn report_of_whole(path: &Path) -> Option<RepairReport> {
    let mut report = RepairReport {
        input: path.into(),
        has_info: true,
        has_end: true,
        has_data_end: true,
        ..RepairReport::default()
    };
    for record in RecordingReader::open(path).ok()? {
        *report.n_recovered.entry(record.ok()?.0).or_default() += 1;
    }
    report.n_chunks = super::RecordingIndex::open(path).ok()?.n_chunks;
    Some(report)
}

pub(super) fn unknown_info() -> RecordingInfo {
    RecordingInfo {
        hand: "unknown".into(),
        hand_id: 0,
        made_by: "unknown".into(),
        version: env!("CARGO_PKG_VERSION").into(),
    }
}

/// Serializes a path as it is shown: JSON has no place for bytes that are not UTF-8.
fn path_as_text<'a, S: Serializer>(path: impl Into<Option<&'a PathBuf>>, serializer: S) -> Result<S::Ok, S::Error> {
    let path: Option<&PathBuf> = path.into();
    path.map(|path| path.to_string_lossy()).serialize(serializer)
}

fn repair_metadata(path: &Path, report: &RepairReport) -> BTreeMap<String, String> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let n_lost: u64 = report.n_lost.values().sum::<u64>() + report.n_of_unknown_topics;
    BTreeMap::from([
        ("of".into(), name),
        ("n_lost".into(), n_lost.to_string()),
        ("n_lost_attachments".into(), report.n_lost_attachments.to_string()),
        ("n_unverified".into(), report.n_unverified.values().sum::<u64>().to_string()),
        ("n_damaged_chunks".into(), report.n_damaged_chunks.to_string()),
        ("has_partial_chunk".into(), report.has_partial_chunk.to_string()),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{info, records};
    use crate::{RecordingWriter, attachments};
    use mcap::Attachment;

    #[test]
    fn whole_attachments_are_recovered_and_lost_ones_are_counted() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let mut writer = RecordingWriter::create(&path, &info()).expect("created");
        // One is longer than any metadata.
        for (name, n_bytes) in [("hand.urdf", 1_000), ("model.json", 2_000), ("camera.bin", MAX_METADATA_BYTES + 1)] {
            let data = vec![b'x'; n_bytes as usize].into();
            let attachment =
                Attachment { log_time: 1, create_time: 2, name: name.into(), media_type: "a/b".into(), data };
            writer.attach(&attachment).expect("attached");
        }
        records().iter().for_each(|(topic, record)| writer.write_record(topic, record).expect("written"));
        writer.finish().expect("finished");
        let (whole, attached) = (std::fs::read(&path).expect("read"), attachments(&path).expect("read"));
        assert_eq!(attached.len(), 3);
        let repaired = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("written");
            let report = repair(&path).expect("repaired");
            let found = attachments(&repaired_path(&path)).expect("read");
            std::fs::remove_file(repaired_path(&path)).expect("removed");
            assert_eq!((report.has_loss(), report.n_skipped_bytes), (report.n_lost_attachments > 0, 0), "{report:?}");
            (report.n_lost_attachments, found)
        };
        let without_end = whole.len() - 100;
        assert!(repaired(&whole[..without_end]) == (0, attached));
        let mut damaged = whole.clone();
        let at = whole.windows(10).position(|found| found == b"model.json").expect("there");
        damaged[at + 100] = b'y';
        for n_bytes in [whole.len(), without_end] {
            let (n_lost, found) = repaired(&damaged[..n_bytes]);
            let names: Vec<&str> = found.iter().map(|file| file.name.as_str()).collect();
            assert_eq!((n_lost, names), (1, vec!["hand.urdf", "camera.bin"]), "{n_bytes} bytes");
        }
    }
}
