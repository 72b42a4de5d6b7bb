//! One file of a live recording: grows under its own name, in whole chunks, and ends whole when the disk is full.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use blindgrasp_messages::files::private_file;
use blindgrasp_messages::{Header, Recorded, Stamped};
use mcap::Writer;
use mcap::records::Metadata;
use rustix::fs::FallocateFlags;
use rustix::io::Errno;

use super::RecordingError;
use super::viewer::{JOINT_STATES, StandardType};
use super::writer::{add_channel, add_standard, append, attach, lock, write_error, write_options};

/// A chunk is closed at this many bytes before compression: little is lost with a killed process, and zstd still
/// compresses well.
const CHUNK_BYTES: u64 = 512 << 10;
/// A chunk is closed at this age.
const CHUNK_AGE: Duration = Duration::from_secs(1);
/// Bytes of a message beside its data: opcode, length, channel, number, two times; and its entry in the chunk's index.
const MESSAGE_OVERHEAD: u64 = 9 + 22 + 16;
/// Bytes of a chunk beside its messages: headers, and what zstd may add to data that it cannot compress.
const CHUNK_OVERHEAD: u64 = 4096 + CHUNK_BYTES / 128;
/// Bytes of the metadata about the end, and of its entry in the summary.
const END_METADATA_BYTES: u64 = 256;
/// Room is reserved in steps of this many bytes, whole pages of any size: some file systems take back the page that a
/// refused reservation begins in.
const RESERVE_STEP: u64 = 64 << 10;
/// Bytes that are reserved beyond the present need, where the disk has them.
const RESERVE_AHEAD: u64 = 8 << 20;

/// A file that is being recorded to.
pub(super) struct LiveFile {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    /// The same open file, and its lock.
    file: File,
    channels: BTreeMap<String, LiveChannel>,
    standard_channels: BTreeMap<&'static str, u16>,
    chunk_begun: Option<Instant>,
    /// Upper bound of the open chunk's bytes; 0 without an open chunk.
    n_chunk_bytes: u64,
    n_chunks: u64,
    /// Bytes of the schemas, channels and metadata, which the summary repeats or names.
    n_definition_bytes: u64,
    n_file_bytes: u64,
    /// The offset up to which room is reserved; `None` if the file system cannot reserve.
    reserved_to: Option<u64>,
}

/// A topic of a file that is being recorded to.
struct LiveChannel {
    id: u16,
    schema: &'static str,
    n_samples: u64,
}

/// Why something could not be written.
pub(super) enum WriteFailure {
    /// There is no room for another chunk; the file can still be completed.
    Full(std::io::Error),
    /// Anything else; the file is as it is.
    Broken(RecordingError),
}

impl From<RecordingError> for WriteFailure {
    fn from(error: RecordingError) -> Self {
        WriteFailure::Broken(error)
    }
}

impl LiveFile {
    /// Begins a file.
    pub(super) fn create(
        path: &Path,
        overwrite: bool,
        metadata: &[(&str, &BTreeMap<String, String>)],
        attachments: &[(&str, &[u8])],
    ) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.into(), source };
        let file = open_locked(path, overwrite)?;
        let written = file.try_clone().map_err(io)?;
        let writer = write_options()
            // This module closes the chunks. Without seeking, mcap builds a chunk in memory and writes it in one go.
            .chunk_size(None)
            .disable_seeking(true)
            .create(BufWriter::new(written))
            .map_err(|error| write_error(path, error))?;
        let mut live = LiveFile {
            path: path.into(),
            writer,
            file,
            channels: BTreeMap::new(),
            standard_channels: BTreeMap::new(),
            chunk_begun: None,
            n_chunk_bytes: 0,
            n_chunks: 0,
            n_definition_bytes: END_METADATA_BYTES,
            n_file_bytes: 0,
            reserved_to: Some(0),
        };
        for (name, metadata) in metadata {
            let n_bytes: usize = metadata.iter().map(|(key, value)| key.len() + value.len() + 8).sum();
            live.n_definition_bytes += (n_bytes + 2 * name.len() + 64) as u64;
        }
        // Each has an entry in the summary.
        live.n_definition_bytes += 256 * attachments.len() as u64;
        let n_attached_bytes: u64 = attachments.iter().map(|(_, data)| data.len() as u64).sum();
        let begun = live.reserve(CHUNK_BYTES + n_attached_bytes).and_then(|()| {
            for (name, metadata) in metadata {
                let metadata = Metadata { name: (*name).into(), metadata: (*metadata).clone() };
                live.writer.write_metadata(&metadata).map_err(|error| write_error(path, error))?;
            }
            for (name, data) in attachments {
                attach(&mut live.writer, name, data).map_err(|error| write_error(path, error))?;
            }
            live.writer.flush().map_err(|error| write_error(path, error))?;
            live.n_file_bytes = live.file.stream_position().map_err(io)?;
            Ok(())
        });
        match begun {
            Ok(()) => Ok(live),
            Err(failure) => {
                drop(live.writer.into_inner());
                let _ = std::fs::remove_file(path);
                Err(match failure {
                    WriteFailure::Full(source) => io(source),
                    WriteFailure::Broken(error) => error,
                })
            }
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Its length, without the open chunk.
    pub(super) fn n_bytes(&self) -> u64 {
        self.n_file_bytes
    }

    /// The topics with our messages, each with its number of samples.
    pub(super) fn topics(&self) -> impl Iterator<Item = (&str, u64)> {
        self.channels.iter().map(|(topic, channel)| (topic.as_str(), channel.n_samples))
    }

    /// The number of our samples in the file.
    pub(super) fn n_samples(&self) -> u64 {
        self.channels.values().map(|channel| channel.n_samples).sum()
    }

    /// Appends a sample to a topic; `data` is the sample as CDR.
    pub(super) fn write<M: Recorded>(
        &mut self,
        topic: &str,
        sample: &Stamped<M>,
        data: &[u8],
    ) -> Result<(), WriteFailure> {
        let known = self.channels.get(topic).map(|channel| (channel.id, channel.schema));
        let id = match known {
            Some((id, schema)) if schema == M::SCHEMA => {
                self.make_room(topic, None, data)?;
                id
            }
            Some((_, schema)) => {
                let message = format!("{topic} carries {schema}, and now a {} came", M::SCHEMA);
                return Err(RecordingError::Invalid { path: self.path.clone(), message }.into());
            }
            None => {
                let definition = M::definition();
                self.make_room(topic, Some(&definition), data)?;
                let id = self.add_channel(topic, M::SCHEMA, &definition)?;
                self.channels.insert(topic.into(), LiveChannel { id, schema: M::SCHEMA, n_samples: 0 });
                id
            }
        };
        self.append(id, &sample.header, data)?;
        if let Some(channel) = self.channels.get_mut(topic) {
            channel.n_samples += 1;
        }
        Ok(())
    }

    /// Whether it has no message for viewers that goes with frames.
    pub(super) fn is_first_frame(&self) -> bool {
        !self.standard_channels.contains_key(JOINT_STATES.topic)
    }

    /// Appends a message of a standard type.
    pub(super) fn write_standard(
        &mut self,
        standard: &StandardType,
        header: &Header,
        data: &[u8],
    ) -> Result<(), WriteFailure> {
        let is_new = !self.standard_channels.contains_key(standard.topic);
        self.make_room(standard.topic, is_new.then_some(standard.definition), data)?;
        let id = add_standard(&mut self.writer, &mut self.standard_channels, standard)
            .map_err(|error| write_error(&self.path, error))?;
        self.append(id, header, data)
    }

    /// Closes the open chunk if it is old enough.
    pub(super) fn tick(&mut self) -> Result<(), RecordingError> {
        match self.chunk_begun {
            Some(begun) if begun.elapsed() >= CHUNK_AGE => self.end_chunk(),
            _ => Ok(()),
        }
    }

    /// Adds metadata at the end.
    pub(super) fn write_metadata(
        &mut self,
        name: &str,
        metadata: &BTreeMap<String, String>,
    ) -> Result<(), RecordingError> {
        let metadata = Metadata { name: name.into(), metadata: metadata.clone() };
        self.writer.write_metadata(&metadata).map_err(|error| write_error(&self.path, error))
    }

    /// Completes the file; with `sync`, waits until it is on the disk.
    pub(super) fn finish(mut self, sync: bool) -> Result<(), RecordingError> {
        self.writer.finish().map_err(|error| write_error(&self.path, error))?;
        let io = |source| RecordingError::Io { path: self.path.clone(), source };
        self.writer.into_inner().into_inner().map_err(|error| io(error.into_error()))?;
        let n_bytes = self.file.stream_position().map_err(io)?;
        // Gives back reserved room beyond the end.
        self.file.set_len(n_bytes).map_err(io)?;
        if sync { self.file.sync_all().map_err(io) } else { Ok(()) }
    }

    /// Leaves the file as it is, without an end.
    pub(super) fn abandon(self) {
        drop(self.writer.into_inner());
    }

    fn make_room(&mut self, topic: &str, definition: Option<&str>, data: &[u8]) -> Result<(), WriteFailure> {
        let mut n_bytes = data.len() as u64 + MESSAGE_OVERHEAD;
        if let Some(definition) = definition {
            let n_definition_bytes = (definition.len() + 2 * topic.len() + 128) as u64;
            self.n_definition_bytes += n_definition_bytes;
            n_bytes += n_definition_bytes;
        }
        if self.n_chunk_bytes > 0 && self.n_chunk_bytes + n_bytes > CHUNK_BYTES {
            self.end_chunk()?;
        }
        if self.n_chunk_bytes == 0 {
            self.reserve(n_bytes.max(CHUNK_BYTES))?;
            self.chunk_begun = Some(Instant::now());
        }
        self.n_chunk_bytes += n_bytes;
        Ok(())
    }

    fn add_channel(&mut self, topic: &str, schema: &str, definition: &str) -> Result<u16, RecordingError> {
        add_channel(&mut self.writer, topic, schema, definition).map_err(|error| write_error(&self.path, error))
    }

    fn append(&mut self, channel_id: u16, header: &Header, data: &[u8]) -> Result<(), WriteFailure> {
        append(&mut self.writer, channel_id, header, data).map_err(|error| write_error(&self.path, error).into())
    }

    fn end_chunk(&mut self) -> Result<(), RecordingError> {
        self.writer.flush().map_err(|error| write_error(&self.path, error))?;
        self.n_file_bytes =
            self.file.stream_position().map_err(|source| RecordingError::Io { path: self.path.clone(), source })?;
        self.n_chunks += 1;
        self.n_chunk_bytes = 0;
        self.chunk_begun = None;
        Ok(())
    }

    /// Reserves room for a chunk and for the summary behind it, so that the file can always be completed.
    fn reserve(&mut self, n_chunk_bytes: u64) -> Result<(), WriteFailure> {
        let Some(reserved_to) = self.reserved_to else { return Ok(()) };
        let n_channels = self.channels.len() as u64 + self.standard_channels.len() as u64 + 1;
        let n_summary_bytes =
            4096 + self.n_definition_bytes + (self.n_chunks + 2) * (128 + 10 * n_channels) + 10 * n_channels;
        let needed = self.n_file_bytes + n_chunk_bytes + CHUNK_OVERHEAD + n_summary_bytes;
        if needed <= reserved_to {
            return Ok(());
        }
        // Many chunks at a time, because a reservation costs the file system more than a chunk; the last ones one by
        // one.
        for n_ahead_bytes in [RESERVE_AHEAD, 0] {
            let to = (needed + n_ahead_bytes).next_multiple_of(RESERVE_STEP);
            match fallocate(&self.file, reserved_to, to - reserved_to) {
                Ok(()) => {
                    self.reserved_to = Some(to);
                    return Ok(());
                }
                Err(Errno::NOSPC | Errno::DQUOT | Errno::FBIG) if n_ahead_bytes > 0 => {}
                Err(error @ (Errno::NOSPC | Errno::DQUOT | Errno::FBIG)) => {
                    return Err(WriteFailure::Full(error.into()));
                }
                // Not every file system can reserve.
                Err(_) => {
                    self.reserved_to = None;
                    return Ok(());
                }
            }
        }
        Ok(())
    }
}

/// Reserves room in a file, also beyond its end, without making it longer.
fn fallocate(file: &File, offset: u64, n_bytes: u64) -> Result<(), Errno> {
    loop {
        match rustix::fs::fallocate(file, FallocateFlags::KEEP_SIZE, offset, n_bytes) {
            Err(Errno::INTR) => {}
            outcome => return outcome,
        }
    }
}

/// The file `path`, empty and locked against another recorder.
pub(super) fn open_locked(path: &Path, overwrite: bool) -> Result<File, RecordingError> {
    let io = |source| RecordingError::Io { path: path.into(), source };
    let found = if overwrite {
        private_file().read(true).create(true).truncate(false).open(path)
    } else {
        private_file().read(true).create_new(true).open(path)
    };
    let file = match found {
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
            let message = "there is a file of that name: name another, or write over it (--overwrite)".into();
            return Err(RecordingError::Invalid { path: path.into(), message });
        }
        found => found.map_err(io)?,
    };
    lock(&file, path)?;
    file.set_len(0).map_err(io)?;
    Ok(file)
}
