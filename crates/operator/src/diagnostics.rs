//! Lines for people, on stderr.

use std::io::Write;
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Writes a line to stderr at once. Unlike `eprintln!` it doesn't panic when the reader is gone: the graph goes on.
pub fn print_diagnostic(line: &str) {
    let mut stderr = std::io::stderr().lock();
    let _ = stderr.write_all(format!("{line}\n").as_bytes());
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

    /// Writes a line, soon.
    pub fn print(&mut self, line: String) {
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
