//! Records samples on a thread of its own, so that neither the disk nor the compression holds the graph up.
//!
//! A full or broken disk ends the recording, not the graph: one message says so, and later samples are counted.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::{Serialize, Serializer};

use blindgrasp_graph::recorded_graph::Ending;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::{LiveOptions, LiveRecorder, Record, RecordingError, RecordingInfo};

/// This many samples may wait for the disk: some seconds at 1 kHz.
const MAX_WAITING: usize = 16_384;
/// This many waiting samples wake the thread; fewer wait for its next poll.
const WAKE_AT: usize = 512;
const POLL: Duration = Duration::from_millis(20);
/// The graph waits this long for a stuck disk before samples are left out.
const PATIENCE: Duration = Duration::from_secs(1);

/// Refuses to replace an existing file; parts of a split recording are checked when they begin.
pub fn check_recording(path: &Path, options: &LiveOptions) -> anyhow::Result<()> {
    if !options.overwrite && !options.is_split() && path.exists() {
        anyhow::bail!("{}: the file exists; choose another name, or replace it with --overwrite", path.display());
    }
    Ok(())
}

#[derive(Debug, Clone, Default, Serialize)]
pub struct Recorded {
    #[serde(serialize_with = "as_text")]
    pub files: Vec<PathBuf>,
    /// Samples in the files, by topic.
    pub samples: BTreeMap<String, u64>,
    /// Samples that came and are not in the files.
    pub n_not_recorded: u64,
    /// The error that ended it early.
    pub error: Option<String>,
}

/// JSON has no place for names of files that are not UTF-8.
fn as_text<S: Serializer>(files: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(files.iter().map(|file| file.to_string_lossy()))
}

impl Recorded {
    /// Removes empty files, of a graph that did not start.
    pub fn remove_if_empty(&mut self) {
        if self.samples.values().all(|n| *n == 0) {
            for file in self.files.drain(..) {
                let _ = std::fs::remove_file(file);
            }
        }
    }
}

/// An open recording. A recorder that is dropped completes it, or removes it if it is empty.
pub struct Recorder {
    shared: Arc<Shared>,
    topics: Vec<Arc<str>>,
    thread: Option<JoinHandle<Recorded>>,
    /// The disk is stuck: samples are left out until half of the queue is free.
    is_stuck: bool,
    n_left_out: u64,
}

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    /// A sample has come, or the recording ends.
    come: Condvar,
    /// The queue has room.
    gone: Condvar,
    has_failed: Arc<AtomicBool>,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<(Arc<str>, Record)>,
    /// How the recording ends, once it does.
    ending: Option<Ending>,
}

impl Recorder {
    /// Begins a recording.
    ///
    /// # Errors
    /// The file cannot be written, or is there already.
    pub fn create(path: &Path, info: &RecordingInfo, options: LiveOptions) -> Result<Recorder, RecordingError> {
        let live = LiveRecorder::create(path, info, options)?;
        let shared = Arc::new(Shared::default());
        let thread = std::thread::spawn({
            let shared = Arc::clone(&shared);
            move || write(live, &shared)
        });
        Ok(Recorder { shared, topics: Vec::new(), thread: Some(thread), is_stuck: false, n_left_out: 0 })
    }

    /// Queues a sample. Waits only for a slow disk.
    pub fn push(&mut self, topic: &str, record: Record) {
        let topic = match self.topics.iter().find(|known| known.as_ref() == topic) {
            Some(known) => Arc::clone(known),
            None => {
                self.topics.push(topic.into());
                topic.into()
            }
        };
        let mut queue = self.shared.lock();
        self.is_stuck &= queue.waiting.len() > MAX_WAITING / 2;
        while queue.waiting.len() >= MAX_WAITING && !self.is_stuck {
            let waited;
            (queue, waited) = self.shared.gone.wait_timeout(queue, PATIENCE).unwrap_or_else(PoisonError::into_inner);
            self.is_stuck = waited.timed_out();
            if self.is_stuck {
                print_diagnostic("blindgrasp: the disk is stuck: samples are not recorded until it takes data again");
            }
        }
        if self.is_stuck {
            self.n_left_out += 1;
            return;
        }
        queue.waiting.push_back((topic, record));
        if queue.waiting.len() == WAKE_AT {
            self.shared.come.notify_one();
        }
    }

    /// Set once the recording has ended early.
    pub fn has_failed(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.shared.has_failed)
    }

    /// Writes what is left and completes the recording.
    pub fn finish(mut self, ending: Ending) -> Recorded {
        let mut recorded = self.end(ending);
        recorded.n_not_recorded += self.n_left_out;
        recorded
    }

    fn end(&mut self, ending: Ending) -> Recorded {
        self.shared.lock().ending = Some(ending);
        self.shared.come.notify_one();
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(recorded)) => recorded,
            _ => Recorded { error: Some("the thread that records panicked".into()), ..Recorded::default() },
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.end(Ending::Broken).remove_if_empty();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn write(mut live: LiveRecorder, shared: &Shared) -> Recorded {
    let mut recorded = Recorded::default();
    let mut batch = VecDeque::new();
    let ending = loop {
        let mut queue = shared.lock();
        if queue.waiting.len() < WAKE_AT && queue.ending.is_none() {
            (queue, _) = shared.come.wait_timeout(queue, POLL).unwrap_or_else(PoisonError::into_inner);
        }
        std::mem::swap(&mut queue.waiting, &mut batch);
        let ending = queue.ending;
        drop(queue);
        shared.gone.notify_one();
        for (topic, record) in batch.drain(..) {
            let written = live.write(&topic, &record);
            keep(shared, &mut recorded, written);
        }
        let ticked = live.tick();
        keep(shared, &mut recorded, ticked);
        if let Some(ending) = ending {
            break ending;
        }
    };
    live.set_ending(ending.word());
    let summary = match live.finish() {
        Ok(summary) => summary,
        Err(error) => {
            keep(shared, &mut recorded, Err(error));
            live.summary().clone()
        }
    };
    let (files, samples, n_not_recorded) = (summary.files, summary.n_samples, summary.n_refused);
    Recorded { files, samples, n_not_recorded, error: recorded.error }
}

/// Prints and keeps the first error.
fn keep(shared: &Shared, recorded: &mut Recorded, outcome: Result<(), RecordingError>) {
    if let Err(error) = outcome
        && recorded.error.is_none()
    {
        let text = format!("{:#}", anyhow::Error::from(error));
        print_diagnostic(&format!("blindgrasp: recording has ended, the graph goes on: {text}"));
        recorded.error = Some(text);
        shared.has_failed.store(true, Ordering::Relaxed);
    }
}
