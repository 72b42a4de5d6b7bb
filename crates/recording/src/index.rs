//! A recording's summary, without its samples.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use super::{RecordingError, RecordingInfo, summary};

/// A recording's summary, which is read at once whatever the recording's size.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecordingIndex {
    pub info: RecordingInfo,
    /// All other metadata, by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// All topics, ours and others.
    pub topics: BTreeMap<String, IndexedTopic>,
    /// Messages of all topics, the standard messages for viewers among them; `None` if the file does not say.
    pub n_messages: Option<u64>,
    /// Stamp of the first message, nanoseconds; `None` without messages, or if the file does not say.
    pub first_stamp_nanos: Option<u64>,
    /// Stamp of the last message, nanoseconds.
    pub last_stamp_nanos: Option<u64>,
    pub n_chunks: u64,
    /// Bytes of the chunks as they lie in the file.
    pub n_compressed_bytes: u64,
    /// Bytes of the chunks before compression.
    pub n_uncompressed_bytes: u64,
    pub n_file_bytes: u64,
}

/// A topic of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct IndexedTopic {
    /// The ROS name of its messages' type, e.g. `blindgrasp_msgs/msg/TactileFrame`; empty if it has none.
    pub schema: String,
    /// `None` if the file does not say.
    pub n_messages: Option<u64>,
    /// Whether its messages are of a type of ours; [`super::RecordingReader`] ignores other topics.
    pub is_ours: bool,
}

impl RecordingIndex {
    /// Reads the summary at the file's end and the metadata.
    ///
    /// # Errors
    /// As [`super::RecordingReader::open`].
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let (_, summary) = summary::open(path)?;
        let statistics = summary.statistics.as_ref();
        let mut topics: BTreeMap<String, IndexedTopic> = BTreeMap::new();
        for known in summary.channels.iter() {
            let counts = statistics.map(|statistics| &statistics.channel_message_counts);
            let n_messages = counts.map(|counts| counts.get(&known.channel.id).copied().unwrap_or(0));
            let topic = topics.entry(known.channel.topic.clone()).or_insert(IndexedTopic {
                schema: summary.channels.schema_name(known),
                n_messages: Some(0),
                is_ours: known.ours.is_some(),
            });
            topic.n_messages = topic.n_messages.zip(n_messages).map(|(sum, more)| sum.saturating_add(more));
        }
        let stamps = statistics.filter(|statistics| statistics.message_count > 0);
        let sum = |sizes: &mut dyn Iterator<Item = u64>| sizes.fold(0, u64::saturating_add);
        Ok(RecordingIndex {
            topics,
            n_messages: statistics.map(|statistics| statistics.message_count),
            first_stamp_nanos: stamps.map(|statistics| statistics.message_start_time),
            last_stamp_nanos: stamps.map(|statistics| statistics.message_end_time),
            n_chunks: summary.chunks.len() as u64,
            n_compressed_bytes: sum(&mut summary.chunks.iter().map(|index| index.compressed_size)),
            n_uncompressed_bytes: sum(&mut summary.chunks.iter().map(|index| index.uncompressed_size)),
            n_file_bytes: summary.n_file_bytes,
            info: summary.info,
            metadata: summary.metadata,
        })
    }

    /// How long it lasts, by its stamps, in nanoseconds: 0 without messages, `None` if the file does not say.
    pub fn duration_nanos(&self) -> Option<u64> {
        self.n_messages?;
        let stamps = self.first_stamp_nanos.zip(self.last_stamp_nanos);
        Some(stamps.map_or(0, |(first, last)| last.saturating_sub(first)))
    }
}
