//! Reading recordings.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use cdr_encoding::from_bytes;
use mcap::sans_io::LinearReaderOptions;
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};

use super::writer::{CDR_LITTLE_ENDIAN, METADATA_NAME};
use super::{Record, RecordingError, RecordingInfo, schema_name};
use crate::message::{
    ContactSet, GraspFeature, GraspScene, GraspTruth, LiftDecision, Prediction, Recorded, Stamped, TactileFrame,
};

/// No record of ours comes near this; a damaged length would otherwise ask for all memory.
const MAX_RECORD_BYTES: usize = 256 << 20;

/// An open recording: an iterator over its samples in the file's order, with their topics.
///
/// Topics with other schemas than ours are passed over. After the last sample the iterator has seen the whole file, and
/// every checksum in it.
pub struct RecordingReader {
    path: PathBuf,
    info: RecordingInfo,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    topics: BTreeMap<String, String>,
    messages: mcap::io::MessageReader<BufReader<File>>,
    n_expected: Option<u64>,
    n_read: u64,
    done: bool,
}

impl RecordingReader {
    /// Opens a recording and reads what it says of itself.
    ///
    /// # Errors
    /// A file that cannot be read, is no MCAP, was cut off, or has no `blindgrasp` metadata.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.into(), source };
        let invalid = |message: String| RecordingError::Invalid { path: path.into(), message };
        let mut file = File::open(path).map_err(io)?;
        let mut magic = [0; 8];
        if !path.is_file() || file.read_exact(&mut magic).is_err() || magic != *mcap::MAGIC {
            return Err(invalid("not a recording: expected an MCAP file".into()));
        }
        let summary = summary(&mut file).map_err(|error| {
            invalid(format!("it was cut off or is damaged: expected MCAP's summary at its end ({error})"))
        })?;
        let index = summary.metadata_indexes.iter().find(|index| index.name == METADATA_NAME).ok_or_else(|| {
            invalid(format!("it has no '{METADATA_NAME}' metadata: expected a recording made by blindgrasp"))
        })?;
        let info = metadata(&mut file, index)
            .and_then(info_from_metadata)
            .map_err(|message| invalid(format!("its '{METADATA_NAME}' metadata: {message}")))?;
        let mut others = BTreeMap::new();
        for index in summary.metadata_indexes.iter().filter(|index| index.name != METADATA_NAME) {
            let found = metadata(&mut file, index)
                .map_err(|message| invalid(format!("its '{}' metadata: {message}", index.name)))?;
            others.insert(index.name.clone(), found);
        }
        let n_samples = |id: &u16| summary.stats.as_ref().map(|stats| stats.channel_message_counts.get(id).copied());
        // Without statistics, a topic that is named may be empty.
        let has_samples = |id: &u16| n_samples(id).is_none_or(|n| n.unwrap_or(0) > 0);
        let channels = summary.channels.iter().filter(|(id, _)| has_samples(id));
        let topics = channels.map(|(_, channel)| {
            let schema = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
            (channel.topic.clone(), schema.to_string())
        });
        let topics = topics.collect();
        file.rewind().map_err(io)?;
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        Ok(RecordingReader {
            path: path.into(),
            info,
            metadata: others,
            topics,
            messages: mcap::io::MessageReader::new_with_options(BufReader::new(file), options),
            n_expected: summary.stats.map(|stats| stats.message_count),
            n_read: 0,
            done: false,
        })
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

    fn invalid(&self, message: String) -> RecordingError {
        RecordingError::Invalid { path: self.path.clone(), message }
    }

    fn next_record(&mut self) -> Option<Result<(String, Record), RecordingError>> {
        loop {
            let message = match self.messages.next() {
                Some(Ok(message)) => message,
                Some(Err(mcap::McapError::UnsupportedCompression(format))) => {
                    let what = format!("its chunks are compressed with {format}: write it anew with zstd or none");
                    return Some(Err(self.invalid(what)));
                }
                Some(Err(error)) => {
                    return Some(Err(
                        self.invalid(format!("cut off or damaged after {} samples: {error}", self.n_read))
                    ));
                }
                None => {
                    return self.n_expected.filter(|expected| *expected != self.n_read).map(|expected| {
                        Err(self.invalid(format!("it holds {} samples, its statistics say {expected}", self.n_read)))
                    });
                }
            };
            self.n_read += 1;
            let channel = &message.channel;
            let schema = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
            if let Some(decode) = decoder(schema) {
                let record = decode(&message.data)
                    .map_err(|what| self.invalid(format!("{}, sample {}: {what}", channel.topic, message.sequence)));
                return Some(record.map(|record| (channel.topic.clone(), record)));
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
        let next = self.next_record();
        self.done = !matches!(next, Some(Ok(_)));
        next
    }
}

type Decode = fn(&[u8]) -> Result<Record, String>;

fn decoder(schema: &str) -> Option<Decode> {
    let decoders: [(String, Decode); 7] = [
        (schema_name::<TactileFrame>(), |data| decode(data).map(Record::Tactile)),
        (schema_name::<ContactSet>(), |data| decode(data).map(Record::Contacts)),
        (schema_name::<GraspFeature>(), |data| decode(data).map(Record::Histogram)),
        (schema_name::<Prediction>(), |data| decode(data).map(Record::Prediction)),
        (schema_name::<LiftDecision>(), |data| decode(data).map(Record::Decision)),
        (schema_name::<GraspTruth>(), |data| decode(data).map(Record::Truth)),
        (schema_name::<GraspScene>(), |data| decode(data).map(Record::Scene)),
    ];
    decoders.into_iter().find(|(name, _)| name == schema).map(|(_, decode)| decode)
}

fn decode<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
    let body = data.strip_prefix(&CDR_LITTLE_ENDIAN[..]).ok_or("expected little-endian CDR")?;
    let (sample, n_bytes) = from_bytes::<Stamped<M>, byteorder::LittleEndian>(body)
        .map_err(|error| format!("not a {}: {error}", M::TYPE_NAME))?;
    if n_bytes != body.len() {
        return Err(format!("{} bytes too many for a {}", body.len() - n_bytes, M::TYPE_NAME));
    }
    sample.message.check().map_err(|error| error.to_string())?;
    Ok(sample)
}

fn summary(file: &mut File) -> Result<mcap::Summary, String> {
    let mut reader = SummaryReader::new();
    while let Some(event) = reader.next_event() {
        match event.map_err(|error| error.to_string())? {
            SummaryReadEvent::ReadRequest(need) => {
                let n_read = file.read(reader.insert(need)).map_err(|error| error.to_string())?;
                reader.notify_read(n_read);
            }
            SummaryReadEvent::SeekRequest(to) => {
                reader.notify_seeked(file.seek(to).map_err(|error| error.to_string())?);
            }
        }
    }
    reader.finish().ok_or_else(|| "it has none".into())
}

fn metadata(file: &mut File, index: &mcap::records::MetadataIndex) -> Result<BTreeMap<String, String>, String> {
    if index.length > MAX_RECORD_BYTES as u64 {
        return Err(format!("{} bytes long", index.length));
    }
    let mut bytes = vec![0; index.length as usize];
    file.seek(SeekFrom::Start(index.offset))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|error| error.to_string())?;
    match mcap::read::LinearReader::sans_magic(&bytes).next() {
        Some(Ok(mcap::records::Record::Metadata(metadata))) => Ok(metadata.metadata),
        _ => Err("not where the index says".into()),
    }
}

fn info_from_metadata(mut metadata: BTreeMap<String, String>) -> Result<RecordingInfo, String> {
    let mut take = |key: &str| metadata.remove(key).ok_or_else(|| format!("'{key}' is missing"));
    let hand_id = take("hand_id")?;
    Ok(RecordingInfo {
        hand: take("hand")?,
        hand_id: u64::from_str_radix(&hand_id, 16).map_err(|_| format!("hand_id '{hand_id}' is not hex"))?,
        made_by: take("made_by")?,
        version: take("version")?,
    })
}
