//! Lines for people, on stderr.

use std::io::Write;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};

use crate::text::harmless;

/// Writes a line to stderr at once, harmless to a terminal. Unlike `eprintln!` it doesn't panic when the reader is gone: the graph goes on.
pub fn print_diagnostic(line: &str) {
    let mut stderr = std::io::stderr().lock();
    let _ = stderr.write_all(format!("{}\n", harmless(line)).as_bytes());
}

/// So many descriptors may have been closed again since one was missing.
const N_CLOSED_AGAIN: u64 = 8;
/// The descriptors that a process of a graph of sixteen nodes needs, with room.
pub const ENOUGH_FILES: u64 = 1024;

/// An error with its likely cause, if this process has nearly as many files open as it may: iceoryx2 says only that something
/// has failed. To be called right where the error came.
pub fn with_lack_of_files(error: anyhow::Error) -> anyhow::Error {
    let Some(limit) = getrlimit(Resource::Nofile).current else { return error };
    let n_open = match std::fs::read_dir("/proc/self/fd") {
        Ok(entries) => entries.count() as u64,
        Err(error) if error.raw_os_error() == Some(Errno::MFILE.raw_os_error()) => limit,
        Err(_) => 0,
    };
    if n_open + N_CLOSED_AGAIN < limit {
        return error;
    }
    error.context(format!(
        "this process may have {limit} files open, and needs more: raise the limit, with ulimit -n {ENOUGH_FILES} or \
         LimitNOFILE= of a service"
    ))
}

/// A printer that is dropped waits so long for its reader.
const FLUSH_LIMIT: Duration = Duration::from_secs(1);
/// The pause between two looks at whether all is written.
const FLUSH_POLL: Duration = Duration::from_millis(1);

/// Writes lines on a thread of its own, so that the caller never waits for a reader.
pub struct LinePrinter {
    sender: Option<SyncSender<String>>,
    thread: Option<JoinHandle<()>>,
    n_dropped: u64,
    failure: Arc<Mutex<Option<std::io::Error>>>,
}

impl LinePrinter {
    /// A printer that keeps at most `capacity` lines for a reader that is behind.
    pub fn new(mut to: impl Write + Send + 'static, capacity: usize) -> Self {
        let (sender, lines) = sync_channel::<String>(capacity);
        let failure = Arc::new(Mutex::new(None));
        let thread = std::thread::spawn({
            let failure = Arc::clone(&failure);
            move || {
                for line in lines {
                    if let Err(error) = to.write_all(format!("{line}\n").as_bytes()).and_then(|()| to.flush()) {
                        // A reader that has gone wants no more. Any other error is one.
                        let found = Some(error).filter(|error| error.kind() != std::io::ErrorKind::BrokenPipe);
                        *failure.lock().unwrap_or_else(PoisonError::into_inner) = found;
                        return;
                    }
                }
            }
        });
        LinePrinter { sender: Some(sender), thread: Some(thread), n_dropped: 0, failure }
    }

    /// Writes a line, soon, harmless to a terminal.
    pub fn print(&mut self, line: &str) {
        self.print_styled(harmless(line).into_owned());
    }

    /// As [`LinePrinter::print`], for a line that has colours. The caller sees to it that all other text is
    /// [`harmless`].
    pub fn print_styled(&mut self, line: String) {
        if let Some(sender) = &self.sender
            && let Err(TrySendError::Full(_)) = sender.try_send(line)
        {
            self.n_dropped += 1;
        }
    }

    /// Whether no line is written any more: the reader has gone, or there was an error.
    pub fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Lines that were dropped because the reader was too far behind.
    pub fn n_dropped(&self) -> u64 {
        self.n_dropped
    }

    /// Why lines could not be written, if that has happened.
    pub fn take_failure(&self) -> Option<std::io::Error> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Waits until all is written, or `should_hurry`.
    pub fn flush(&mut self, should_hurry: &dyn Fn() -> bool) {
        self.sender = None;
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished()) && !should_hurry() {
            std::thread::sleep(FLUSH_POLL);
        }
        // A thread that still waits for its reader ends with the process.
        self.thread = None;
    }
}

impl Drop for LinePrinter {
    fn drop(&mut self) {
        let start = Instant::now();
        self.flush(&|| start.elapsed() > FLUSH_LIMIT);
    }
}
