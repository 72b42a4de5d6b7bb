//! Writes a graph's logs on a thread of its own: a disk that blocks stops no operator, and not the launcher.
//!
//! Lines wait in a queue. An operator that prints faster than the disk writes is slowed down; while the disk writes nothing
//! at all, its lines are dropped, and the log says how many once it goes on.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::log::{LogFile, LogFolder, LogFormat};
use blindgrasp_operator::wiring::LogEntry;

/// This many lines of all operators may wait for the disk.
const MAX_WAITING: usize = 4096;
/// The first line that finds the queue full waits this long for room; the lines after it do not wait.
const PATIENCE: Duration = Duration::from_millis(100);
const RETRY_PAUSE: Duration = Duration::from_millis(1);
/// At the end, the disk gets this long for the lines that wait.
const FLUSH_LIMIT: Duration = Duration::from_secs(1);

/// What waits for the disk.
#[derive(Debug)]
enum Queued {
    /// A line of the log of this name.
    Line(Arc<str>, LogEntry),
    /// The graph has ended. Logs that outlive it, of a client's thread, write nothing more.
    End,
}

/// The logs of a graph. Dropping it writes the lines that wait, for a bounded time.
pub(super) struct LogWriter {
    sender: SyncSender<Queued>,
    state: Arc<State>,
    thread: JoinHandle<()>,
}

/// The log of one operator.
#[derive(Debug, Clone)]
pub(super) struct Log {
    name: Arc<str>,
    sender: SyncSender<Queued>,
    state: Arc<State>,
}

#[derive(Debug, Default)]
struct State {
    n_dropped: AtomicU64,
    /// A line has waited in vain, and nothing was written since.
    is_stuck: AtomicBool,
}

impl LogWriter {
    pub(super) fn new(folder: LogFolder, format: LogFormat) -> LogWriter {
        let (sender, queue) = sync_channel(MAX_WAITING);
        let state = Arc::new(State::default());
        let thread = std::thread::spawn({
            let state = Arc::clone(&state);
            move || write_lines(&folder, format, &queue, &state)
        });
        LogWriter { sender, state, thread }
    }

    /// The log of an operator; the run is marked in it.
    pub(super) fn log(&self, name: &str) -> Log {
        let log = self.log_if_written(name);
        log.write(LogEntry::plain(""));
        log
    }

    /// A log whose file is made, and the run marked in it, with the first line.
    pub(super) fn log_if_written(&self, name: &str) -> Log {
        Log { name: name.into(), sender: self.sender.clone(), state: Arc::clone(&self.state) }
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        let start = Instant::now();
        let mut has_asked = false;
        // A thread that waits for the disk ends with the process.
        while !self.thread.is_finished() && start.elapsed() < FLUSH_LIMIT {
            if !has_asked {
                has_asked = self.sender.try_send(Queued::End).is_ok();
            }
            std::thread::sleep(RETRY_PAUSE);
        }
    }
}

impl Log {
    /// Writes an entry, soon. It does not wait.
    pub(super) fn write(&self, entry: LogEntry) {
        if self.sender.try_send(Queued::Line(Arc::clone(&self.name), entry)).is_err() {
            self.state.n_dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// As [`Log::write`]; if the queue is full, it waits a little for room.
    pub(super) fn write_patiently(&self, entry: LogEntry) {
        let start = Instant::now();
        let mut line = Queued::Line(Arc::clone(&self.name), entry);
        loop {
            match self.sender.try_send(line) {
                Ok(()) => return,
                Err(TrySendError::Full(back)) => line = back,
                Err(TrySendError::Disconnected(_)) => break,
            }
            if self.state.is_stuck.load(Ordering::Relaxed) {
                break;
            }
            if start.elapsed() > PATIENCE {
                self.state.is_stuck.store(true, Ordering::Relaxed);
                break;
            }
            std::thread::sleep(RETRY_PAUSE);
        }
        self.state.n_dropped.fetch_add(1, Ordering::Relaxed);
    }
}

fn write_lines(folder: &LogFolder, format: LogFormat, queue: &Receiver<Queued>, state: &State) {
    let mut files: BTreeMap<Arc<str>, LogFile> = BTreeMap::new();
    while let Ok(Queued::Line(name, entry)) = queue.recv() {
        // Opening a log marks the run. An empty line does only that.
        let file = files.entry(Arc::clone(&name)).or_insert_with(|| LogFile::open(folder, &name, format));
        if entry.text.is_empty() && entry.fields.is_empty() {
            continue;
        }
        let n_dropped = state.n_dropped.swap(0, Ordering::Relaxed);
        if n_dropped > 0 {
            file.write(&LogEntry::plain(format!(
                "{n_dropped} lines of the graph's operators were dropped: the disk did not take them in time"
            )));
        }
        file.write(&entry);
        state.is_stuck.store(false, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The log is a pipe that nobody reads: opening it takes for ever.
    #[test]
    fn a_log_that_blocks_is_not_waited_for() {
        let folder = tempfile::tempdir().expect("a folder");
        let pipe = folder.path().join("stuck.log");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo is there");
        assert!(made.success());
        let writer = LogWriter::new(LogFolder::at(folder.path().into()), LogFormat::Text);
        let log = writer.log("stuck");
        for _ in 0..MAX_WAITING + 10 {
            log.write_patiently(LogEntry::plain("a line"));
        }
        assert!(log.state.is_stuck.load(Ordering::Relaxed) && log.state.n_dropped.load(Ordering::Relaxed) > 0);
        // A reader comes: the lines that waited are there, and how many are not.
        let content = std::thread::spawn(move || std::fs::read_to_string(&pipe).expect("read"));
        drop(log);
        drop(writer);
        let content = content.join().expect("read");
        assert!(
            content.contains("a line") && content.contains("lines of the graph's operators were dropped"),
            "{content}"
        );
    }

    /// A client's thread holds the audit log for as long as its client likes.
    #[test]
    fn the_end_does_not_wait_for_logs_that_outlive_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let writer = LogWriter::new(LogFolder::at(folder.path().into()), LogFormat::Text);
        let log = writer.log("node");
        log.write(LogEntry::plain("a line"));
        let state = Arc::clone(&writer.state);
        drop(writer);
        // The thread is over: it holds the state no more. Without a message to end, it would wait for `log`.
        assert_eq!(Arc::strong_count(&state), 2);
        log.write(LogEntry::plain("too late"));
        assert_eq!(log.state.n_dropped.load(Ordering::Relaxed), 1);
        let content = std::fs::read_to_string(folder.path().join("node.log")).expect("read");
        assert!(content.contains("a line") && !content.contains("too late"), "{content}");
    }
}
