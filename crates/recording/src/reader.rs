//! Reading recordings.

use std::collections::BTreeMap;
use std::io::Seek;
use std::path::{Path, PathBuf};

use blindgrasp_messages::Record;
use mcap::McapError;
use mcap::records::{ChunkIndex, MessageHeader, op};
use mcap::sans_io::{LinearReader, LinearReaderOptions};

use super::channels::Channels;
use super::chosen::Reach;
use super::source::{Growth, Input, MAX_RECORD_BYTES, read_records, with_cause};
use super::summary;
use super::types::{COMPRESSED, OurType};
use super::{RecordingError, RecordingInfo};

/// Bytes of a message before its data: channel, number, two times.
const MESSAGE_HEADER_BYTES: usize = 2 + 4 + 8 + 8;

/// An open recording: an iterator over its samples in the file's order, with their topics.
///
/// Topics with other schemas than ours are ignored. After the last sample the iterator has read the whole file and
/// checked every checksum in it.
pub struct RecordingReader {
    path: PathBuf,
    pub(super) info: RecordingInfo,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    topics: BTreeMap<String, String>,
    reader: LinearReader,
    pub(super) input: Input,
    growth: Growth,
    channels: Channels,
    /// `None` if the file does not say.
    n_expected: Option<u64>,
    n_read: u64,
    is_past_data: bool,
    done: bool,
}

/// A message's topic, its number in MCAP's header, its type and its data.
type OurMessage<'a> = (&'a str, u32, &'static OurType, &'a [u8]);

impl RecordingReader {
    /// Opens a recording and reads its summary.
    ///
    /// # Errors The file cannot be read, is no MCAP, was cut off, has no `blindgrasp` metadata, or has messages of
    /// another version.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Ok(Self::open_with(path, Reach::Whole)?.0)
    }

    /// Opens a recording to read so much of it. The caller says which chunks the input is to skip.
    pub(super) fn open_with(path: &Path, reach: Reach) -> Result<(Self, Vec<ChunkIndex>), RecordingError> {
        let (mut file, summary) = summary::open(path)?;
        file.rewind().map_err(|source| RecordingError::Io { path: path.into(), source })?;
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            // This checksum is over all chunks.
            .with_validate_data_section_crc(reach == Reach::Whole)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let reader = RecordingReader {
            path: path.into(),
            topics: summary.topics(),
            info: summary.info,
            metadata: summary.metadata,
            reader: LinearReader::new_with_options(options),
            input: Input::new(file),
            growth: Growth::default(),
            channels: summary.channels,
            n_expected: summary.statistics.as_ref().map(|statistics| statistics.message_count),
            n_read: 0,
            is_past_data: false,
            done: false,
        };
        Ok((reader, summary.chunks))
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

    pub(super) fn damaged(&self, message: String) -> RecordingError {
        RecordingError::Damaged { path: self.path.clone(), message }
    }

    /// The channels that the file's records have declared so far, and those of its summary.
    pub(super) fn channels(&self) -> &Channels {
        &self.channels
    }

    /// What `take` makes of the next message of ours for which it returns something.
    pub(super) fn next_with<T>(
        &mut self,
        mut take: impl FnMut(OurMessage<'_>) -> Option<Result<T, String>>,
    ) -> Result<Option<T>, RecordingError> {
        let RecordingReader { path, info, reader, input, growth, channels, n_read, is_past_data, .. } = self;
        let damaged = |message: String| RecordingError::Damaged { path: path.clone(), message };
        let invalid = |message: String| RecordingError::Invalid { path: path.clone(), message };
        let found = read_records(reader, input, growth, |opcode, data| match opcode {
            op::MESSAGE if *is_past_data => Some(Err(damaged("a sample lies behind the end of its data".into()))),
            op::MESSAGE => {
                *n_read += 1;
                let taken = our_message(channels, data).and_then(|message| match message {
                    Ok(message) => take(message),
                    Err(what) => Some(Err(what)),
                });
                taken.map(|taken| {
                    taken.map_err(|what| if what.contains(COMPRESSED) { invalid(what) } else { damaged(what) })
                })
            }
            op::DATA_END => {
                *is_past_data = true;
                None
            }
            _ => match channels.add(opcode, data) {
                Ok(()) => {
                    channels.other_version().map(|difference| Err(invalid(summary::other_version(difference, info))))
                }
                Err(message) => Some(Err(damaged(message))),
            },
        });
        match found {
            Ok(Some(taken)) => taken.map(Some),
            Ok(None) => match self.n_expected {
                Some(expected) if expected != *n_read && !input.has_skipped => {
                    Err(damaged(format!("it holds {n_read} samples, its statistics say {expected}")))
                }
                _ => Ok(None),
            },
            Err(McapError::UnsupportedCompression(format)) => {
                Err(invalid(format!("its chunks are compressed with {format}: write it anew with zstd or none")))
            }
            Err(error) => {
                let cause = with_cause(&error);
                Err(damaged(format!("cut off or damaged after {n_read} samples: {cause}")))
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
        let next = self.next_with(|(topic, sequence, ours, data)| {
            let decoded = ours.decode(data).map(|record| (topic.to_owned(), record));
            Some(decoded.map_err(|what| undecodable(topic, sequence, &what)))
        });
        let next = next.transpose();
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

/// The mistake in a message that is not of its schema.
pub(super) fn undecodable(topic: &str, sequence: u32, what: &str) -> String {
    format!("{topic}, sample {sequence}: {what}")
}

/// The message in a record; `None` if it is not ours.
fn our_message<'a>(channels: &'a Channels, record: &'a [u8]) -> Option<Result<OurMessage<'a>, String>> {
    let Some((MessageHeader { channel_id, sequence, .. }, data)) = message_parts(record) else {
        return Some(Err("a message is too short".into()));
    };
    let Some(known) = channels.get(channel_id) else {
        return Some(Err(format!("message {sequence} is of channel {channel_id}, which is not declared")));
    };
    Some(Ok((&known.channel.topic, sequence, known.ours?, data)))
}
