//! Reading recordings.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::{ChunkIndex, MessageHeader, op};
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::channels::Channels;
use super::source::{MAX_RECORD_BYTES, Ranges, read_records, with_cause};
use super::summary::{self, Summary};
use super::types::Decode;
use super::{Record, RecordingError, RecordingInfo};

/// Of a message before its data: channel, number, two times.
const MESSAGE_HEADER_BYTES: usize = 2 + 4 + 8 + 8;

/// What to read of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// These topics; `None`: all.
    pub topics: Option<BTreeSet<String>>,
    /// Samples stamped so, nanoseconds.
    pub stamps: RangeInclusive<u64>,
}

impl Default for Selection {
    /// Everything.
    fn default() -> Self {
        Selection { topics: None, stamps: 0..=u64::MAX }
    }
}

/// An open recording: an iterator over its samples in the file's order, with their topics.
///
/// Topics with other schemas than ours are passed over. After the last sample the iterator has seen the whole file, and
/// every checksum in it; one that reads a selection has seen the chunks that can hold it, and theirs.
pub struct RecordingReader {
    path: PathBuf,
    info: RecordingInfo,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    topics: BTreeMap<String, String>,
    reader: LinearReader,
    input: Ranges,
    channels: Channels,
    selection: Option<Selection>,
    /// Only where everything is read.
    n_expected: Option<u64>,
    n_read: u64,
    is_past_data: bool,
    done: bool,
}

/// Why a message could not be made a sample.
enum Refusal {
    Damaged(String),
    OtherVersion(String),
}

impl RecordingReader {
    /// Opens a recording and reads what it says of itself.
    ///
    /// # Errors
    /// A file that cannot be read, is no MCAP, was cut off, has no `blindgrasp` metadata, or whose messages are another
    /// version's.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let (file, summary) = summary::open(path)?;
        let whole = Ranges::whole(file, summary.n_file_bytes);
        Ok(Self::whole(path, summary, whole, None))
    }

    /// Opens a recording to read what is selected, and for that only the chunks that can hold it.
    ///
    /// # Errors
    /// As [`RecordingReader::open`].
    pub fn open_selected(path: &Path, selection: &Selection) -> Result<Self, RecordingError> {
        let (file, summary) = summary::open(path)?;
        let n_indexed = summary.statistics.as_ref().map(|statistics| u64::from(statistics.chunk_count));
        // A file without an index, or without chunks, is read from end to end.
        if summary.chunks.is_empty() || n_indexed != Some(summary.chunks.len() as u64) {
            let whole = Ranges::whole(file, summary.n_file_bytes);
            return Ok(Self::whole(path, summary, whole, Some(selection.clone())));
        }
        let wanted = |index: &&ChunkIndex| can_hold(index, selection, &summary.channels);
        let ranges: Vec<_> =
            summary.chunks.iter().filter(wanted).map(|index| (index.chunk_start_offset, index.chunk_length)).collect();
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let mut reader = Self::new(path, summary, options, Ranges::chunks(file, ranges));
        reader.selection = Some(selection.clone());
        Ok(reader)
    }

    /// What the recording says of itself.
    pub fn info(&self) -> &RecordingInfo {
        &self.info
    }

    /// Further metadata of that name.
    pub fn metadata(&self, name: &str) -> Option<&BTreeMap<String, String>> {
        self.metadata.get(name)
    }

    /// All further metadata, by name.
    pub fn all_metadata(&self) -> &BTreeMap<String, BTreeMap<String, String>> {
        &self.metadata
    }

    /// The topics that have samples, each with the name of its schema, like `blindgrasp_msgs/msg/TactileFrame`.
    pub fn topics(&self) -> &BTreeMap<String, String> {
        &self.topics
    }

    fn whole(path: &Path, summary: Summary, input: Ranges, selection: Option<Selection>) -> Self {
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let n_expected = summary.statistics.as_ref().map(|statistics| statistics.message_count);
        RecordingReader { n_expected, selection, ..Self::new(path, summary, options, input) }
    }

    fn new(path: &Path, summary: Summary, options: LinearReaderOptions, input: Ranges) -> Self {
        let topics = summary.topics();
        RecordingReader {
            path: path.into(),
            info: summary.info,
            metadata: summary.metadata,
            topics,
            reader: LinearReader::new_with_options(options),
            input,
            channels: summary.channels,
            selection: None,
            n_expected: None,
            n_read: 0,
            is_past_data: false,
            done: false,
        }
    }

    fn next_record(&mut self) -> Result<Option<(String, Record)>, RecordingError> {
        let RecordingReader { reader, input, channels, selection, n_read, is_past_data, .. } = self;
        let found = read_records(reader, input, |opcode, data| match opcode {
            op::MESSAGE if *is_past_data => Some(Err(Refusal::Damaged("a sample behind the end of its data".into()))),
            op::MESSAGE => {
                *n_read += 1;
                sample(channels, selection.as_ref(), data)
            }
            op::DATA_END => {
                *is_past_data = true;
                None
            }
            _ => match channels.add(opcode, data) {
                Ok(()) => channels.other_version().map(|difference| Err(Refusal::OtherVersion(difference.into()))),
                Err(message) => Some(Err(Refusal::Damaged(message))),
            },
        });
        let invalid = |message| RecordingError::Invalid { path: self.path.clone(), message };
        let damaged = |message| RecordingError::Damaged { path: self.path.clone(), message };
        match found {
            Ok(Some(Ok(sample))) => Ok(Some(sample)),
            Ok(Some(Err(Refusal::Damaged(message)))) => Err(damaged(message)),
            Ok(Some(Err(Refusal::OtherVersion(difference)))) => {
                Err(invalid(summary::other_version(&difference, &self.info)))
            }
            Ok(None) => match self.n_expected {
                Some(expected) if expected != self.n_read => {
                    Err(damaged(format!("it holds {} samples, its statistics say {expected}", self.n_read)))
                }
                _ => Ok(None),
            },
            Err(McapError::UnsupportedCompression(format)) => {
                Err(invalid(format!("its chunks are compressed with {format}: write it anew with zstd or none")))
            }
            Err(error) => {
                let cause = with_cause(&error);
                Err(damaged(format!("cut off or damaged after {} samples: {cause}", self.n_read)))
            }
        }
    }
}

impl Iterator for RecordingReader {
    type Item = Result<(String, Record), RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let next = self.next_record().transpose();
        self.done = !matches!(next, Some(Ok(_)));
        next
    }
}

/// A message's record, taken apart.
pub(super) fn message_parts(record: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let (header, data) = record.split_at_checked(MESSAGE_HEADER_BYTES)?;
    let header = MessageHeader {
        channel_id: u16::from_le_bytes(header[..2].try_into().ok()?),
        sequence: u32::from_le_bytes(header[2..6].try_into().ok()?),
        log_time: u64::from_le_bytes(header[6..14].try_into().ok()?),
        publish_time: u64::from_le_bytes(header[14..].try_into().ok()?),
    };
    Some((header, data))
}

/// The sample in a message; `None` if it is not ours or not wanted.
fn sample(
    channels: &Channels,
    selection: Option<&Selection>,
    record: &[u8],
) -> Option<Result<(String, Record), Refusal>> {
    let Some((MessageHeader { channel_id, sequence, log_time, .. }, data)) = message_parts(record) else {
        return Some(Err(Refusal::Damaged("a message that is too short".into())));
    };
    let Some(known) = channels.get(channel_id) else {
        let what = format!("message {sequence} is of channel {channel_id}, which is not there");
        return Some(Err(Refusal::Damaged(what)));
    };
    let decode: Decode = known.decode?;
    let topic = &known.channel.topic;
    if let Some(Selection { topics, stamps }) = selection
        && (!stamps.contains(&log_time) || topics.as_ref().is_some_and(|topics| !topics.contains(topic)))
    {
        return None;
    }
    Some(match decode(data) {
        Ok(record) => Ok((topic.clone(), record)),
        Err(what) => Err(Refusal::Damaged(format!("{topic}, sample {sequence}: {what}"))),
    })
}

/// Whether a chunk may hold something of what is wanted.
fn can_hold(index: &ChunkIndex, selection: &Selection, channels: &Channels) -> bool {
    let is_in_time =
        index.message_start_time <= *selection.stamps.end() && index.message_end_time >= *selection.stamps.start();
    let Some(topics) = &selection.topics else { return is_in_time };
    // Whoever wrote no message indexes left none to go by.
    let is_wanted = |id: &u16| channels.get(*id).is_none_or(|known| topics.contains(&known.channel.topic));
    is_in_time && (index.message_index_offsets.is_empty() || index.message_index_offsets.keys().any(is_wanted))
}
