//! Writing recordings.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, WriteOptions, Writer};

use blindgrasp_messages::files::{keep_mode, partial_path, private_file};
use blindgrasp_messages::{Header, Record, Recorded, Stamped, with_sample};

use super::source::with_cause;
use super::types::{MESSAGE_ENCODING, SCHEMA_ENCODING, encode};
use super::viewer::{JOINT_STATES, ShownHand, StandardType, ViewerMessages};
use super::{LIBRARY, METADATA_NAME, RecordingError, RecordingInfo};

/// An open recording. The same records give the same bytes.
///
/// The file grows beside its place, as `NAME.partial`, and takes its place when it is finished: a recording under its
/// own name is complete. A writer that is dropped unfinished leaves nothing.
pub struct RecordingWriter {
    path: PathBuf,
    /// `None` once finished.
    writer: Option<Writer<BufWriter<File>>>,
    channels: BTreeMap<String, WrittenChannel>,
    viewer: ViewerMessages,
    standard_channels: BTreeMap<&'static str, u16>,
    /// The sample at hand as CDR; kept for its memory.
    data: Vec<u8>,
}

struct WrittenChannel {
    id: u16,
    n_samples: u64,
}

impl RecordingWriter {
    /// Begins a recording that will replace a file of that name, or the file that a link of that name leads to.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, info: &RecordingInfo) -> Result<Self, RecordingError> {
        let target = if path.is_symlink() { path.canonicalize().ok() } else { None };
        let path = target.as_deref().unwrap_or(path);
        let file = lock_partial(path)?;
        write_options()
            .create(BufWriter::new(file))
            .and_then(|mut writer| {
                writer.write_metadata(&Metadata { name: METADATA_NAME.into(), metadata: info_metadata(info) })?;
                Ok(writer)
            })
            .map(|writer| RecordingWriter {
                path: path.into(),
                writer: Some(writer),
                channels: BTreeMap::new(),
                viewer: ViewerMessages::default(),
                standard_channels: BTreeMap::new(),
                data: Vec::new(),
            })
            .map_err(|error| write_error(path, error))
    }

    /// Attaches a file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), RecordingError> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        writer.attach(attachment).map_err(|error| write_error(&self.path, error))
    }

    /// Attaches the files of a hand. Viewers can draw it with the samples of [`RecordingWriter::write_record`].
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn show(&mut self, hand: ShownHand) -> Result<(), RecordingError> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        for (name, data) in hand.files() {
            attach(writer, name, data).map_err(|error| write_error(&self.path, error))?;
        }
        self.viewer.hand = Some(hand);
        Ok(())
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

    /// Appends a sample of any type to a topic, and the messages by which viewers draw it with the hand.
    ///
    /// # Errors
    /// As [`RecordingWriter::write`].
    pub fn write_record(&mut self, topic: &str, record: &Record) -> Result<(), RecordingError> {
        with_sample!(record, sample => self.write(topic, sample))?;
        if self.viewer.hand.is_none() {
            return Ok(());
        }
        let is_first = !self.standard_channels.contains_key(JOINT_STATES.topic);
        let messages = self.viewer.of_record(topic, record, is_first);
        let messages = messages.map_err(|message| RecordingError::Invalid { path: self.path.clone(), message })?;
        let Some(writer) = &mut self.writer else { return Ok(()) };
        for (standard, data) in messages {
            add_standard(writer, &mut self.standard_channels, standard)
                .and_then(|id| append(writer, id, record.header(), &data))
                .map_err(|error| write_error(&self.path, error))?;
        }
        Ok(())
    }

    /// Adds metadata under a name of its own, beside the recording's [`RecordingInfo`].
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
        if let Some(writer) = self.writer.take() {
            complete(writer, &self.path).inspect_err(|_| {
                let _ = std::fs::remove_file(partial_path(&self.path));
            })?;
        }
        let channels = std::mem::take(&mut self.channels);
        Ok(channels.into_iter().map(|(topic, channel)| (topic, channel.n_samples)).collect())
    }

    fn append<M: Recorded>(&mut self, topic: &str, sample: &Stamped<M>) -> mcap::McapResult<()> {
        let Some(writer) = &mut self.writer else {
            return Ok(());
        };
        if !self.channels.contains_key(topic) {
            let id = add_channel(writer, topic, M::SCHEMA, &M::definition())?;
            self.channels.insert(topic.into(), WrittenChannel { id, n_samples: 0 });
        }
        let Some(channel) = self.channels.get_mut(topic) else { return Ok(()) };
        append(writer, channel.id, &sample.header, &self.data)?;
        channel.n_samples += 1;
        Ok(())
    }
}

/// Declares a topic and the type of its messages.
pub(super) fn add_channel(
    writer: &mut Writer<BufWriter<File>>,
    topic: &str,
    schema: &str,
    definition: &str,
) -> mcap::McapResult<u16> {
    let schema_id = writer.add_schema(schema, SCHEMA_ENCODING, definition.as_bytes())?;
    writer.add_channel(schema_id, topic, MESSAGE_ENCODING, &BTreeMap::new())
}

/// The channel of a standard type, which is declared if the file lacks it.
pub(super) fn add_standard(
    writer: &mut Writer<BufWriter<File>>,
    channels: &mut BTreeMap<&'static str, u16>,
    standard: &StandardType,
) -> mcap::McapResult<u16> {
    if let Some(id) = channels.get(standard.topic) {
        return Ok(*id);
    }
    let id = add_channel(writer, standard.topic, standard.schema, standard.definition)?;
    channels.insert(standard.topic, id);
    Ok(id)
}

/// Attaches a file.
pub(super) fn attach(writer: &mut Writer<BufWriter<File>>, name: &str, data: &[u8]) -> mcap::McapResult<()> {
    let media_type = if name.ends_with(".json") { "application/json" } else { "text/plain" };
    // Equal content gives equal bytes: there is no time.
    writer.attach(&Attachment {
        log_time: 0,
        create_time: 0,
        name: name.into(),
        media_type: media_type.into(),
        data: data.into(),
    })
}

/// Appends a message of the sample with this header.
pub(super) fn append(
    writer: &mut Writer<BufWriter<File>>,
    channel_id: u16,
    &Header { seq, stamp_nanos, .. }: &Header,
    data: &[u8],
) -> mcap::McapResult<()> {
    // MCAP's sequence has 32 bits; the header inside the message has them all.
    let header = MessageHeader { channel_id, sequence: seq as u32, log_time: stamp_nanos, publish_time: stamp_nanos };
    writer.write_to_known_channel(&header, data)
}

impl Drop for RecordingWriter {
    fn drop(&mut self) {
        // Dropping mcap's writer completes the file, and an unfinished file must not pass for a recording.
        if let Some(writer) = self.writer.take() {
            drop(writer);
            let _ = std::fs::remove_file(partial_path(&self.path));
        }
    }
}

/// The private file that a recording grows in, empty and locked against other processes that write the same recording. The rest
/// of a killed process is written over.
pub(super) fn lock_partial(path: &Path) -> Result<File, RecordingError> {
    let io = |source| RecordingError::Io { path: path.into(), source };
    let partial = partial_path(path);
    // Another user could have planted a link to any file, or a pipe.
    let flags = (rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits() as i32;
    loop {
        let file = private_file().create(true).truncate(false).custom_flags(flags).open(&partial).map_err(io)?;
        lock(&file, path)?;
        // The process that held the lock may have given this very file its final name: then it must not be emptied.
        let is_still_there = std::fs::metadata(&partial).is_ok_and(|found| {
            file.metadata().is_ok_and(|ours| (found.dev(), found.ino()) == (ours.dev(), ours.ino()))
        });
        if is_still_there {
            file.set_len(0).map_err(io)?;
            return Ok(file);
        }
    }
}

/// Completes a file that [`lock_partial`] began, and gives it its name, with the permissions of the file that it replaces.
pub(super) fn complete(mut writer: Writer<BufWriter<File>>, path: &Path) -> Result<(), RecordingError> {
    let io = |source| RecordingError::Io { path: path.into(), source };
    writer.finish().map_err(|error| write_error(path, error))?;
    let file = writer.into_inner().into_inner().map_err(|error| io(error.into_error()))?;
    keep_mode(&file, path).map_err(io)?;
    // The file is on the disk before it takes the name that says that it is complete, and locked until then.
    file.sync_all().and_then(|()| std::fs::rename(partial_path(path), path)).map_err(io)
}

/// Locks a file against other processes that write the recording `path`.
pub(super) fn lock(file: &File, path: &Path) -> Result<(), RecordingError> {
    file.try_lock().map_err(|error| match error {
        std::fs::TryLockError::WouldBlock => RecordingError::Invalid {
            path: path.into(),
            message: "another process is writing it: wait until it ends, or name another file".into(),
        },
        std::fs::TryLockError::Error(source) => RecordingError::Io { path: path.into(), source },
    })
}

/// A [`RecordingInfo`] as MCAP's metadata.
pub(super) fn info_metadata(info: &RecordingInfo) -> BTreeMap<String, String> {
    BTreeMap::from([
        ("hand".into(), info.hand.clone()),
        ("hand_id".into(), format!("{:016x}", info.hand_id)),
        ("made_by".into(), info.made_by.clone()),
        ("version".into(), info.version.clone()),
    ])
}

/// How MCAP files of recordings are written.
pub(super) fn write_options() -> WriteOptions {
    WriteOptions::new()
        // The encodings are those of ROS 2.
        .profile("ros2")
        .library(LIBRARY)
        .compression(Some(Compression::Zstd))
        // One thread: with several, the bytes would depend on the machine.
        .compression_threads(0)
}

pub(super) fn write_error(path: &Path, error: mcap::McapError) -> RecordingError {
    RecordingError::Invalid { path: path.into(), message: format!("could not be written: {}", with_cause(&error)) }
}
