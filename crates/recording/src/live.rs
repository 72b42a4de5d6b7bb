//! Recording a graph that runs. The file grows under its own name and can be repaired up to its last whole chunk
//! whatever happens to the recorder. It can be split into several files, and it ends whole when the disk is full.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use blindgrasp_messages::{Record, with_sample};

use super::live_file::{LiveFile, WriteFailure, open_locked};
use super::split::{RecentGrasps, Split, key_of};
use super::types::encode;
use super::viewer::{ShownHand, ViewerMessages};
use super::writer::info_metadata;
use super::{END_METADATA_NAME, METADATA_NAME, PART_METADATA_NAME, RecordingError, RecordingInfo};

/// How long a file stays open for late samples after the next file has begun.
const LATE_SAMPLES: Duration = Duration::from_secs(2);

/// How to record.
#[derive(Clone, Default)]
pub struct LiveOptions {
    /// Write over a file of that name.
    pub overwrite: bool,
    /// Begin another file when one is this large.
    pub rotate_bytes: Option<u64>,
    /// Begin another file when one is this old.
    pub rotate_after: Option<Duration>,
    /// The hand; without it viewers see contacts alone.
    pub hand: Option<ShownHand>,
    /// Files to attach to the first file, by name. Those of the hand are attached to each file.
    pub attachments: BTreeMap<String, Vec<u8>>,
    /// Further metadata, by name; each file has all of it.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}

impl LiveOptions {
    /// Whether the recording may become several files.
    pub fn is_split(&self) -> bool {
        self.rotate_bytes.is_some() || self.rotate_after.is_some()
    }
}

/// The outcome of a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LiveSummary {
    /// The files, in order.
    pub files: Vec<PathBuf>,
    /// Samples of each topic in them; the standard messages for viewers are not counted.
    pub n_samples: BTreeMap<String, u64>,
    /// Samples that came after the recording had ended, and samples of a file that could not be completed.
    pub n_refused: u64,
    /// Bytes of all files together.
    pub n_bytes: u64,
}

/// Records samples as they come.
///
/// After an error the recording has ended: further samples are counted and refused with the same error, and
/// [`LiveRecorder::finish`] returns the outcome.
#[derive(Default)]
pub struct LiveRecorder {
    path: PathBuf,
    info: BTreeMap<String, String>,
    options: LiveOptions,
    current: Option<Part>,
    previous: Option<Previous>,
    n_parts: usize,
    recent: RecentGrasps,
    viewer: ViewerMessages,
    ended: Option<Ended>,
    /// The last file's metadata about its end.
    ending: Option<&'static str>,
    summary: LiveSummary,
    /// Whether the sample at which the recording ended is in it: there may have been no room for the message for
    /// viewers that goes with it.
    is_last_taken: bool,
    /// The sample at hand as CDR; kept for its memory.
    data: Vec<u8>,
}

/// A file of the recording.
struct Part {
    file: LiveFile,
    begun: Instant,
}

/// The file before the current one, still open for late samples.
struct Previous {
    part: Part,
    since: Instant,
    /// Topics whose samples go to the next file by now.
    passed: BTreeSet<String>,
    split: Split,
}

/// Why the recording has ended.
#[derive(Clone)]
struct Ended {
    path: PathBuf,
    reason: String,
    /// The samples of a recording that is complete up to a full disk; `None` of one that could not be written.
    n_samples: Option<u64>,
}

impl LiveRecorder {
    /// Begins a recording. With an option that splits it, `FILE.mcap` becomes `FILE-00000.mcap` and so on.
    ///
    /// # Errors
    /// There is a file of that name and `overwrite` is not set, another process records to it, or it cannot be written.
    pub fn create(path: &Path, info: &RecordingInfo, options: LiveOptions) -> Result<Self, RecordingError> {
        for name in [METADATA_NAME, PART_METADATA_NAME] {
            if options.metadata.contains_key(name) {
                let message = format!("the metadata name '{name}' is reserved: choose another name");
                return Err(RecordingError::Invalid { path: path.into(), message });
            }
        }
        let mut recorder =
            LiveRecorder { path: path.into(), info: info_metadata(info), options, ..LiveRecorder::default() };
        recorder.viewer.hand = recorder.options.hand.take();
        if recorder.options.is_split() {
            recorder.clear_old_parts()?;
        }
        recorder.current = Some(recorder.begin_part()?);
        Ok(recorder)
    }

    /// Records a sample of a topic.
    ///
    /// # Errors
    /// The disk is full ([`RecordingError::Full`]: the recording is complete up to there), or it cannot be written. The
    /// recording has ended then.
    pub fn write(&mut self, topic: &str, record: &Record) -> Result<(), RecordingError> {
        if let Some(ended) = &self.ended {
            self.summary.n_refused += 1;
            return Err(ended.error());
        }
        let written = self.try_write(topic, record);
        if written.is_err() && !std::mem::take(&mut self.is_last_taken) {
            self.summary.n_refused += 1;
        }
        written
    }

    /// Writes out samples that are a second old. Call it about every 100 ms, also when no samples come.
    ///
    /// # Errors
    /// It cannot be written; the recording has ended then.
    pub fn tick(&mut self) -> Result<(), RecordingError> {
        if self.ended.is_some() {
            return Ok(());
        }
        self.close_previous(false)?;
        for part in self.previous.as_mut().map(|previous| &mut previous.part).into_iter().chain(&mut self.current) {
            if let Err(error) = part.file.tick() {
                return Err(self.end(error.into()));
            }
        }
        Ok(())
    }

    /// Sets the word in the metadata `end` of the last file. A recording that ends because of a full disk has the word
    /// `disk_full` there.
    pub fn set_ending(&mut self, ending: &'static str) {
        self.ending = Some(ending);
    }

    /// Completes the recording; also after the disk was full.
    ///
    /// # Errors
    /// It could not be written, now or earlier.
    pub fn finish(&mut self) -> Result<LiveSummary, RecordingError> {
        if self.ended.is_none() {
            self.close_previous(true)?;
            if let Some(part) = self.current.take()
                && let Err(error) = self.complete(part, true)
            {
                return Err(self.end(error.into()));
            }
        }
        match &self.ended {
            Some(ended) if ended.n_samples.is_none() => Err(ended.error()),
            _ => Ok(std::mem::take(&mut self.summary)),
        }
    }

    /// The outcome so far, of the files that have ended; also after an error.
    pub fn summary(&self) -> &LiveSummary {
        &self.summary
    }

    fn try_write(&mut self, topic: &str, record: &Record) -> Result<(), RecordingError> {
        let header = *record.header();
        let invalid = |path: &Path, error: String| RecordingError::Invalid {
            path: path.into(),
            message: format!("{topic}, seq {}: {error}", header.seq),
        };
        with_sample!(record, sample => encode(sample, &mut self.data)).map_err(|error| invalid(&self.path, error))?;
        let mut is_late = false;
        if self.options.is_split() {
            self.close_previous(false)?;
            self.split_before(record)?;
            is_late = self.previous.as_mut().is_some_and(|previous| previous.is_late(topic, record));
            self.recent.add(key_of(record));
        }
        let previous = self.previous.as_mut().map(|previous| &mut previous.part);
        let part = if is_late { previous } else { self.current.as_mut() };
        let Some(part) = part else { return Ok(()) };
        let mut written = with_sample!(record, sample => part.file.write(topic, sample, &self.data));
        let is_taken = written.is_ok();
        if is_taken {
            let messages = self.viewer.of_record(topic, record, part.file.is_first_frame());
            for (standard, data) in messages.map_err(|error| invalid(&self.path, error))? {
                if written.is_ok() {
                    written = part.file.write_standard(standard, &header, &data);
                }
            }
        }
        let Err(failure) = written else { return Ok(()) };
        self.is_last_taken = is_taken;
        Err(self.end(failure))
    }

    /// Begins the next file if this sample is to be its first.
    fn split_before(&mut self, record: &Record) -> Result<(), RecordingError> {
        let Some(part) = &self.current else { return Ok(()) };
        // The file before the current one has to be closed first.
        let n_limits = if self.previous.is_some() { 0 } else { part.n_limits(&self.options) };
        let is_new_grasp = !record.is_said_once() && !self.recent.contains(&key_of(record));
        let split = match record {
            _ if n_limits == 0 || part.file.n_samples() == 0 => return Ok(()),
            record if is_new_grasp => {
                Split::Grasps { next: BTreeSet::from([key_of(record)]), last: std::mem::take(&mut self.recent) }
            }
            Record::Tactile(frame) if n_limits >= 2 => {
                Split::Frame { epoch: frame.header.epoch, seq: frame.header.seq }
            }
            _ => return Ok(()),
        };
        let next = match self.begin_part() {
            Ok(next) => next,
            Err(RecordingError::Io { source, .. }) if is_full(&source) => {
                return Err(self.end(WriteFailure::Full(source)));
            }
            Err(error) => return Err(self.end(error.into())),
        };
        self.previous = self.current.replace(next).map(|part| Previous {
            part,
            since: Instant::now(),
            passed: BTreeSet::new(),
            split,
        });
        Ok(())
    }

    fn begin_part(&mut self) -> Result<Part, RecordingError> {
        let path = if self.options.is_split() { self.part_path(self.n_parts) } else { self.path.clone() };
        let part = BTreeMap::from([("number".to_string(), self.n_parts.to_string())]);
        let mut metadata: Vec<(&str, &BTreeMap<String, String>)> = vec![(METADATA_NAME, &self.info)];
        metadata.extend(self.options.metadata.iter().map(|(name, metadata)| (name.as_str(), metadata)));
        if self.options.is_split() {
            metadata.push((PART_METADATA_NAME, &part));
        }
        let mut attachments: Vec<(&str, &[u8])> = self.viewer.hand.iter().flat_map(ShownHand::files).collect();
        if self.n_parts == 0 {
            attachments.extend(self.options.attachments.iter().map(|(name, data)| (name.as_str(), data.as_slice())));
        }
        let file = LiveFile::create(&path, self.options.overwrite, &metadata, &attachments)?;
        self.n_parts += 1;
        Ok(Part { file, begun: Instant::now() })
    }

    fn part_path(&self, part_idx: usize) -> PathBuf {
        self.path.with_file_name(format!("{}-{part_idx:05}.mcap", stem(&self.path)))
    }

    /// Removes the parts of an earlier recording of that name, which would pass for parts of this one.
    fn clear_old_parts(&self) -> Result<(), RecordingError> {
        let folder = self.path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
        let io = |source| RecordingError::Io { path: folder.into(), source };
        for entry in std::fs::read_dir(folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if is_part_name(&self.path, &name) {
                let locked = open_locked(&path, self.options.overwrite)?;
                std::fs::remove_file(&path).map_err(io)?;
                drop(locked);
            }
        }
        Ok(())
    }

    /// Completes the file before the current one when it has all its samples or has waited long enough.
    fn close_previous(&mut self, now: bool) -> Result<(), RecordingError> {
        let is_done = |previous: &Previous| {
            now || previous.since.elapsed() >= LATE_SAMPLES
                || previous.part.file.topics().all(|(topic, _)| previous.passed.contains(topic))
        };
        match self.previous.take_if(|previous| is_done(previous)) {
            Some(previous) => self.complete(previous.part, false).map_err(|error| self.end(error.into())),
            None => Ok(()),
        }
    }

    fn complete(&mut self, mut part: Part, is_last: bool) -> Result<(), RecordingError> {
        let path = part.file.path().to_path_buf();
        if let Some(ending) = self.ending
            && is_last
        {
            let metadata = BTreeMap::from([("ended".to_string(), ending.to_string())]);
            part.file.write_metadata(END_METADATA_NAME, &metadata)?;
        }
        self.summary.files.push(path.clone());
        for (topic, n_samples) in part.file.topics() {
            *self.summary.n_samples.entry(topic.into()).or_default() += n_samples;
        }
        part.file.finish(is_last)?;
        self.summary.n_bytes += std::fs::metadata(&path).map_or(0, |found| found.len());
        Ok(())
    }

    /// Ends the recording and completes the files that can be completed.
    fn end(&mut self, failure: WriteFailure) -> RecordingError {
        let mut n_samples = 0;
        let mut ended = match failure {
            WriteFailure::Full(error) => {
                self.ending = Some("disk_full");
                Ended { path: self.path.clone(), reason: error.to_string(), n_samples: Some(0) }
            }
            WriteFailure::Broken(error) => Ended::broken(error),
        };
        for part in self.previous.take().map(|previous| previous.part).into_iter().chain(self.current.take()) {
            if ended.n_samples.is_none() && ended.path == part.file.path() {
                self.summary.files.push(part.file.path().to_path_buf());
                // Some of these samples may lie in the file, where a repair finds them.
                self.summary.n_refused += part.file.n_samples();
                part.file.abandon();
                continue;
            }
            n_samples += part.file.n_samples();
            if let Err(error) = self.complete(part, true) {
                ended = Ended::broken(error);
            }
        }
        if let (Some(found), Some(last)) = (&mut ended.n_samples, self.summary.files.last()) {
            // The next file may not have begun.
            (*found, ended.path) = (n_samples, last.clone());
        }
        self.ended.insert(ended).error()
    }
}

impl Part {
    /// How many times over a limit of a file is reached: 0, 1, or 2 for twice and more.
    fn n_limits(&self, options: &LiveOptions) -> u32 {
        let passed = |times: u32| {
            options.rotate_bytes.is_some_and(|limit| self.file.n_bytes() >= limit.saturating_mul(times.into()))
                || options.rotate_after.is_some_and(|limit| self.begun.elapsed() >= limit.saturating_mul(times))
        };
        if passed(2) { 2 } else { u32::from(passed(1)) }
    }
}

impl Previous {
    /// Whether a sample belongs to this file and not to the next.
    fn is_late(&mut self, topic: &str, record: &Record) -> bool {
        let is_late = self.split.is_late(record);
        if !is_late && !self.passed.contains(topic) {
            self.passed.insert(topic.into());
        }
        is_late
    }
}

impl Ended {
    fn broken(error: RecordingError) -> Ended {
        let (path, reason) = match error {
            RecordingError::Io { path, source } => (path, format!("could not be written: {source}")),
            RecordingError::Invalid { path, message } | RecordingError::Damaged { path, message } => (path, message),
            RecordingError::Full { path, reason, .. } => (path, reason),
        };
        Ended { path, reason, n_samples: None }
    }

    fn error(&self) -> RecordingError {
        let Ended { path, reason, n_samples } = self.clone();
        match n_samples {
            Some(n_samples) => RecordingError::Full { path, n_samples, reason },
            None => RecordingError::Damaged { path, message: reason },
        }
    }
}

fn is_full(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}

/// Whether the file `name` beside a recording would be one of its parts.
fn is_part_name(recording: &Path, name: &str) -> bool {
    let behind_stem = name.strip_prefix(&format!("{}-", stem(recording)));
    let number = behind_stem.and_then(|rest| rest.strip_suffix(".mcap"));
    number.is_some_and(|number| number.len() == 5 && number.bytes().all(|byte| byte.is_ascii_digit()))
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
