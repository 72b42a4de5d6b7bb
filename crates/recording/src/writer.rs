//! Writing recordings.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::BufWriter;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions, Writer};

use super::schema::definition;
use super::source::with_cause;
use super::types::{MESSAGE_ENCODING, SCHEMA_ENCODING, encode, schema_name};
use super::{LIBRARY, METADATA_NAME, Record, RecordingError, RecordingInfo};
use blindgrasp_messages::files::partial_path;
use blindgrasp_messages::{Recorded, Stamped};

/// Of MCAP: the encodings are those of ROS 2.
pub(super) const PROFILE: &str = "ros2";

/// An open recording. The same records give the same bytes.
///
/// It grows beside its place, as `NAME.partial`, and takes it when it is finished: a recording under its own name is
/// complete, and one that is given up leaves nothing.
pub struct RecordingWriter {
    path: PathBuf,
    /// `None` once finished.
    writer: Option<Writer<BufWriter<File>>>,
    channels: BTreeMap<String, WrittenChannel>,
    /// Used over and over.
    data: Vec<u8>,
}

struct WrittenChannel {
    id: u16,
    n_samples: u64,
}

impl RecordingWriter {
    /// Begins a recording that will replace what is there under that name.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, info: &RecordingInfo) -> Result<Self, RecordingError> {
        let file = lock_partial(path)?;
        begin(BufWriter::new(file))
            .and_then(|mut writer| {
                writer.write_metadata(&Metadata { name: METADATA_NAME.into(), metadata: info_metadata(info) })?;
                Ok(writer)
            })
            .map(|writer| RecordingWriter {
                path: path.into(),
                writer: Some(writer),
                channels: BTreeMap::new(),
                data: Vec::new(),
            })
            .map_err(|error| write_error(path, error))
    }

    /// Appends a sample to a topic.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write<M: Recorded>(&mut self, topic: &str, sample: &Stamped<M>) -> Result<(), RecordingError> {
        encode(sample, &mut self.data).map_err(|error| RecordingError::Invalid {
            path: self.path.clone(),
            message: format!("{topic}, seq {}: {error}", sample.header.seq),
        })?;
        self.append(topic, sample).map_err(|error| write_error(&self.path, error))
    }

    /// Appends a sample of any type to a topic.
    ///
    /// # Errors
    /// As [`RecordingWriter::write`].
    pub fn write_record(&mut self, topic: &str, record: &Record) -> Result<(), RecordingError> {
        match record {
            Record::Tactile(sample) => self.write(topic, sample),
            Record::Contacts(sample) => self.write(topic, sample),
            Record::Histogram(sample) => self.write(topic, sample),
            Record::Prediction(sample) => self.write(topic, sample),
            Record::Decision(sample) => self.write(topic, sample),
            Record::Truth(sample) => self.write(topic, sample),
            Record::Outcome(sample) => self.write(topic, sample),
            Record::Advice(sample) => self.write(topic, sample),
            Record::Scene(sample) => self.write(topic, sample),
        }
    }

    /// Adds metadata under a name of its own, beside what the recording says of itself.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), RecordingError> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let metadata = Metadata { name: name.into(), metadata };
        writer.write_metadata(&metadata).map_err(|error| write_error(&self.path, error))
    }

    /// Completes the recording and puts it in its place. Returns the number of samples of each topic.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> Result<BTreeMap<String, u64>, RecordingError> {
        if let Some(mut writer) = self.writer.take() {
            writer.finish().map_err(|error| write_error(&self.path, error))?;
            writer
                .into_inner()
                .into_inner()
                .map_err(std::io::IntoInnerError::into_error)
                // On the disk before it takes its name, which says that it is complete; and locked until it has it.
                .and_then(|file| file.sync_all().and_then(|()| std::fs::rename(partial_path(&self.path), &self.path)))
                .map_err(|source| RecordingError::Io { path: self.path.clone(), source })?;
        }
        let channels = std::mem::take(&mut self.channels);
        Ok(channels.into_iter().map(|(topic, channel)| (topic, channel.n_samples)).collect())
    }

    fn append<M: Recorded>(&mut self, topic: &str, sample: &Stamped<M>) -> mcap::McapResult<()> {
        let Some(writer) = &mut self.writer else {
            return Ok(());
        };
        if !self.channels.contains_key(topic) {
            let definition = definition::<M>();
            let schema_id = writer.add_schema(&schema_name::<M>(), SCHEMA_ENCODING, definition.as_bytes())?;
            let id = writer.add_channel(schema_id, topic, MESSAGE_ENCODING, &BTreeMap::new())?;
            self.channels.insert(topic.into(), WrittenChannel { id, n_samples: 0 });
        }
        let Some(channel) = self.channels.get_mut(topic) else { return Ok(()) };
        let header = MessageHeader {
            channel_id: channel.id,
            // MCAP's sequence has 32 bits; the header inside the message has them all.
            sequence: sample.header.seq as u32,
            log_time: sample.header.stamp_nanos,
            publish_time: sample.header.stamp_nanos,
        };
        writer.write_to_known_channel(&header, &self.data)?;
        channel.n_samples += 1;
        Ok(())
    }
}

impl Drop for RecordingWriter {
    fn drop(&mut self) {
        // Dropping mcap's writer would complete the file; what was given up must not pass for a recording.
        if let Some(writer) = self.writer.take() {
            drop(writer);
            let _ = std::fs::remove_file(partial_path(&self.path));
        }
    }
}

/// The file that a recording grows in, empty and locked against other processes that write the same recording. What a
/// killed one left there is written over.
pub(super) fn lock_partial(path: &Path) -> Result<File, RecordingError> {
    let io = |source| RecordingError::Io { path: path.into(), source };
    let partial = partial_path(path);
    loop {
        let file = File::options().write(true).create(true).truncate(false).open(&partial).map_err(io)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let message = "another process is writing it: wait for that one, or name another file".into();
                return Err(RecordingError::Invalid { path: path.into(), message });
            }
            Err(TryLockError::Error(source)) => return Err(io(source)),
        }
        // Whoever held the lock may have given this very file its final name: then it is no longer ours to empty.
        let is_still_there = std::fs::metadata(&partial).is_ok_and(|found| {
            file.metadata().is_ok_and(|ours| (found.dev(), found.ino()) == (ours.dev(), ours.ino()))
        });
        if is_still_there {
            file.set_len(0).map_err(io)?;
            return Ok(file);
        }
    }
}

/// What a recording says of itself, as MCAP's metadata.
pub(super) fn info_metadata(info: &RecordingInfo) -> BTreeMap<String, String> {
    BTreeMap::from([
        ("hand".into(), info.hand.clone()),
        ("hand_id".into(), format!("{:016x}", info.hand_id)),
        ("made_by".into(), info.made_by.clone()),
        ("version".into(), info.version.clone()),
    ])
}

/// An MCAP file as recordings are.
pub(super) fn begin(file: BufWriter<File>) -> mcap::McapResult<Writer<BufWriter<File>>> {
    WriteOptions::new()
        .profile(PROFILE)
        .library(LIBRARY)
        .compression(Some(Compression::Zstd))
        // One thread: with several, the bytes would depend on the machine.
        .compression_threads(0)
        .create(file)
}

pub(super) fn write_error(path: &Path, error: mcap::McapError) -> RecordingError {
    RecordingError::Invalid { path: path.into(), message: format!("could not be written: {}", with_cause(&error)) }
}
