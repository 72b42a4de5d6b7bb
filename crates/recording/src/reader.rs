//! Reading recordings.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Seek};
use std::path::{Path, PathBuf};

use blindgrasp_messages::Record;
use mcap::McapError;
use mcap::records::{MessageHeader, op};
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::channels::Channels;
use super::source::{Growth, MAX_RECORD_BYTES, read_records, with_cause};
use super::summary;
use super::{RecordingError, RecordingInfo};

/// Bytes of a message before its data: channel, number, two times.
const MESSAGE_HEADER_BYTES: usize = 2 + 4 + 8 + 8;

/// An open recording: an iterator over its samples in the file's order, with their topics.
///
/// Topics with other schemas than ours are ignored. After the last sample the iterator has read the whole file and
/// checked every checksum in it.
pub struct RecordingReader {
    path: PathBuf,
    info: RecordingInfo,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    topics: BTreeMap<String, String>,
    reader: LinearReader,
    input: BufReader<File>,
    growth: Growth,
    channels: Channels,
    /// `None` if the file does not say.
    n_expected: Option<u64>,
    n_read: u64,
    is_past_data: bool,
    done: bool,
}

/// Why a message is refused.
enum Refusal {
    Damaged(String),
    OtherVersion(String),
}

impl RecordingReader {
    /// Opens a recording and reads its summary.
    ///
    /// # Errors The file cannot be read, is no MCAP, was cut off, has no `blindgrasp` metadata, or has messages of
    /// another version.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let (mut file, summary) = summary::open(path)?;
        file.rewind().map_err(|source| RecordingError::Io { path: path.into(), source })?;
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        Ok(RecordingReader {
            path: path.into(),
            topics: summary.topics(),
            info: summary.info,
            metadata: summary.metadata,
            reader: LinearReader::new_with_options(options),
            input: BufReader::with_capacity(64 << 10, file),
            growth: Growth::default(),
            channels: summary.channels,
            n_expected: summary.statistics.as_ref().map(|statistics| statistics.message_count),
            n_read: 0,
            is_past_data: false,
            done: false,
        })
    }

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

    fn next_record(&mut self) -> Result<Option<(String, Record)>, RecordingError> {
        let RecordingReader { reader, input, growth, channels, n_read, is_past_data, .. } = self;
        let found = read_records(reader, input, growth, |opcode, data| match opcode {
            op::MESSAGE if *is_past_data => {
                Some(Err(Refusal::Damaged("a sample lies behind the end of its data".into())))
            }
            op::MESSAGE => {
                *n_read += 1;
                sample(channels, data)
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

/// A message's header and data.
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

/// The sample in a message; `None` if it is not ours.
fn sample(channels: &Channels, record: &[u8]) -> Option<Result<(String, Record), Refusal>> {
    let Some((MessageHeader { channel_id, sequence, .. }, data)) = message_parts(record) else {
        return Some(Err(Refusal::Damaged("a message is too short".into())));
    };
    let Some(known) = channels.get(channel_id) else {
        let what = format!("message {sequence} is of channel {channel_id}, which is not declared");
        return Some(Err(Refusal::Damaged(what)));
    };
    let decoder = known.decoder?;
    let topic = &known.channel.topic;
    Some(match decoder.decode(data) {
        Ok(record) => Ok((topic.clone(), record)),
        Err(what) => Err(Refusal::Damaged(format!("{topic}, sample {sequence}: {what}"))),
    })
}
