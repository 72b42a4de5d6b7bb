//! Writing recordings.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::BufWriter;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use cdr_encoding::to_vec;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions, Writer};

use super::schema::definition;
use super::{Record, RecordingError, RecordingInfo, schema_name};
use crate::message::{Recorded, Stamped};
use crate::model::partial_path;

/// Plain CDR, little-endian: how ROS 2 marks the bytes that follow.
pub(super) const CDR_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
pub(super) const METADATA_NAME: &str = "blindgrasp";

/// An open recording. The same records give the same bytes.
///
/// It grows beside its place, as `NAME.partial`, and takes it when it is finished: a recording under its own name is
/// complete, and one that is given up leaves nothing.
pub struct RecordingWriter {
    path: PathBuf,
    /// `None` once finished.
    writer: Option<Writer<BufWriter<File>>>,
    channel_ids: BTreeMap<String, u16>,
    n_written: BTreeMap<String, u64>,
}

impl RecordingWriter {
    /// Begins a recording that will replace what is there under that name.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, info: &RecordingInfo) -> Result<Self, RecordingError> {
        let file = lock_partial(path)?;
        let metadata = BTreeMap::from([
            ("hand".into(), info.hand.clone()),
            ("hand_id".into(), format!("{:016x}", info.hand_id)),
            ("made_by".into(), info.made_by.clone()),
            ("version".into(), info.version.clone()),
        ]);
        WriteOptions::new()
            .profile("ros2")
            .library(concat!("blindgrasp ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            // One thread: with several, the bytes would depend on the machine.
            .compression_threads(0)
            .create(BufWriter::new(file))
            .and_then(|mut writer| {
                writer.write_metadata(&Metadata { name: METADATA_NAME.into(), metadata })?;
                Ok(writer)
            })
            .map(|writer| {
                let (channel_ids, n_written) = (BTreeMap::new(), BTreeMap::new());
                RecordingWriter { path: path.into(), writer: Some(writer), channel_ids, n_written }
            })
            .map_err(|error| write_error(path, error))
    }

    /// Appends a sample to a topic.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write<M: Recorded>(&mut self, topic: &str, sample: &Stamped<M>) -> Result<(), RecordingError> {
        let mut data = CDR_LITTLE_ENDIAN.to_vec();
        let body = to_vec::<_, byteorder::LittleEndian>(sample).map_err(|error| RecordingError::Invalid {
            path: self.path.clone(),
            message: format!("{topic}, seq {}: {error}", sample.header.seq),
        })?;
        data.extend(body);
        self.append::<M>(topic, sample, &data).map_err(|error| write_error(&self.path, error))
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
        Ok(std::mem::take(&mut self.n_written))
    }

    fn append<M: Recorded>(&mut self, topic: &str, sample: &Stamped<M>, data: &[u8]) -> mcap::McapResult<()> {
        let Some(writer) = &mut self.writer else {
            return Ok(());
        };
        let channel_id = match self.channel_ids.get(topic) {
            Some(channel_id) => *channel_id,
            None => {
                let definition = definition::<M>();
                let schema_id = writer.add_schema(&schema_name::<M>(), "ros2msg", definition.as_bytes())?;
                let channel_id = writer.add_channel(schema_id, topic, "cdr", &BTreeMap::new())?;
                self.channel_ids.insert(topic.into(), channel_id);
                channel_id
            }
        };
        let header = MessageHeader {
            channel_id,
            // MCAP's sequence has 32 bits; the header inside the message has them all.
            sequence: sample.header.seq as u32,
            log_time: sample.header.stamp_nanos,
            publish_time: sample.header.stamp_nanos,
        };
        writer.write_to_known_channel(&header, data)?;
        *self.n_written.entry(topic.into()).or_default() += 1;
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
fn lock_partial(path: &Path) -> Result<File, RecordingError> {
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

fn write_error(path: &Path, error: mcap::McapError) -> RecordingError {
    let cause = std::error::Error::source(&error).map_or(String::new(), |cause| format!(": {cause}"));
    RecordingError::Invalid { path: path.into(), message: format!("could not be written: {error}{cause}") }
}
