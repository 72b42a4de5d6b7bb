//! Messages that threads of Zenoh have received, for a source that waits for descriptors.

use std::collections::VecDeque;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use rustix::event::{EventfdFlags, eventfd};

/// More messages than this do not wait for the source: the eldest are dropped and counted.
const MAX_WAITING: usize = 4096;
/// The pause between two attempts to open a session.
const RETRY: Duration = Duration::from_millis(500);

/// A queue of messages of one receiver, with the times of their arrival (CLOCK_BOOTTIME).
pub(super) struct Inbox<T> {
    queue: Mutex<Queue<T>>,
    event: OwnedFd,
}

struct Queue<T> {
    waiting: VecDeque<(T, u64)>,
    n_dropped: u64,
    is_closed: bool,
}

impl<T: Send + 'static> Inbox<T> {
    pub(super) fn new() -> std::io::Result<Arc<Self>> {
        let queue = Queue { waiting: VecDeque::new(), n_dropped: 0, is_closed: false };
        let event = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Arc::new(Inbox { queue: Mutex::new(queue), event }))
    }

    /// Opens something on a thread of its own, again and again until it succeeds or the inbox is closed. It lives until the
    /// inbox is closed.
    pub(super) fn keep<S>(
        self: &Arc<Self>,
        name: String,
        open: impl Fn(&Arc<Self>) -> Result<S, String> + Send + 'static,
    ) {
        let inbox = Arc::clone(self);
        std::thread::spawn(move || {
            let mut said = String::new();
            let kept = loop {
                if inbox.is_closed() {
                    return;
                }
                match open(&inbox) {
                    Ok(kept) => break kept,
                    Err(error) => {
                        if said != error {
                            print_diagnostic(&format!("{error}; trying again"));
                            said = error;
                        }
                        std::thread::sleep(RETRY);
                    }
                }
            };
            print_diagnostic(&format!("receives {name}"));
            while !inbox.is_closed() {
                std::thread::sleep(RETRY / 10);
            }
            drop(kept);
        });
    }

    pub(super) fn put(&self, message: T) {
        let at_nanos = monotonic_nanos();
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        if queue.waiting.len() == MAX_WAITING {
            queue.waiting.pop_front();
            queue.n_dropped += 1;
        }
        queue.waiting.push_back((message, at_nanos));
        // A full counter wakes as well.
        let _ = rustix::io::write(&self.event, &1_u64.to_ne_bytes());
    }

    pub(super) fn take(&self) -> Option<(T, u64)> {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let message = queue.waiting.pop_front();
        if queue.waiting.is_empty() {
            let _ = rustix::io::read(&self.event, &mut [0_u8; 8]);
        }
        message
    }

    /// The number of messages that were dropped since the last call.
    pub(super) fn take_dropped(&self) -> u64 {
        std::mem::take(&mut self.queue.lock().unwrap_or_else(PoisonError::into_inner).n_dropped)
    }

    pub(super) fn close(&self) {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner).is_closed = true;
    }

    fn is_closed(&self) -> bool {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner).is_closed
    }
}

impl<T> AsFd for Inbox<T> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}
