//! Messages that threads of Zenoh have received, for a source that waits for descriptors.

use std::collections::VecDeque;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_tactile::{Refusal, RefusalKind};
use rustix::event::{EventfdFlags, eventfd};

/// More messages or bytes than this do not wait for the source: the eldest are dropped and counted.
const MAX_WAITING: usize = 4096;
const MAX_WAITING_BYTES: usize = 32 << 20;
/// The pause between two attempts to open a session.
const RETRY: Duration = Duration::from_millis(500);

/// A queue of messages of one receiver, with the times of their arrival (CLOCK_BOOTTIME).
pub(super) struct Inbox<T> {
    queue: Mutex<Queue<T>>,
    event: OwnedFd,
    closing: Condvar,
}

struct Queue<T> {
    /// Each message, its bytes, and its arrival.
    waiting: VecDeque<(T, usize, u64)>,
    n_bytes: usize,
    n_dropped: u64,
    is_closed: bool,
}

impl<T: Send + 'static> Inbox<T> {
    pub(super) fn new() -> std::io::Result<Arc<Self>> {
        let queue = Queue { waiting: VecDeque::new(), n_bytes: 0, n_dropped: 0, is_closed: false };
        let event = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Arc::new(Inbox { queue: Mutex::new(queue), event, closing: Condvar::new() }))
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
                match open(&inbox) {
                    Ok(kept) => break kept,
                    Err(error) => {
                        if said != error {
                            print_diagnostic(&format!("{error}; trying again"));
                            said = error;
                        }
                        let (queue, _) = inbox
                            .closing
                            .wait_timeout_while(inbox.queue(), RETRY, |queue| !queue.is_closed)
                            .unwrap_or_else(PoisonError::into_inner);
                        if queue.is_closed {
                            return;
                        }
                    }
                }
            };
            print_diagnostic(&format!("receives {name}"));
            drop(inbox.closing.wait_while(inbox.queue(), |queue| !queue.is_closed));
            drop(kept);
        });
    }

    /// Appends a message. One that does not wake the source is read at its next look.
    pub(super) fn put(&self, message: T, n_bytes: usize, wakes: bool) {
        let at_nanos = monotonic_nanos();
        let mut queue = self.queue();
        while queue.waiting.len() >= MAX_WAITING || queue.n_bytes + n_bytes > MAX_WAITING_BYTES {
            let Some((_, n_bytes, _)) = queue.waiting.pop_front() else { break };
            queue.n_bytes -= n_bytes;
            queue.n_dropped += 1;
        }
        queue.n_bytes += n_bytes;
        queue.waiting.push_back((message, n_bytes, at_nanos));
        drop(queue);
        if wakes {
            // A full counter wakes as well.
            let _ = rustix::io::write(&self.event, &1_u64.to_ne_bytes());
        }
    }

    /// The next message and its arrival.
    ///
    /// # Errors
    /// Messages before it were dropped.
    pub(super) fn next(&self) -> Result<Option<(T, u64)>, Refusal> {
        let mut queue = self.queue();
        let n_dropped = std::mem::take(&mut queue.n_dropped);
        if n_dropped > 0 {
            let why = format!("{n_dropped} messages were dropped, because the source was too slow for them");
            return Err(Refusal { kind: RefusalKind::Late, why });
        }
        let next = queue.waiting.pop_front().map(|(message, n_bytes, at_nanos)| {
            queue.n_bytes -= n_bytes;
            (message, at_nanos)
        });
        if queue.waiting.is_empty() {
            let _ = rustix::io::read(&self.event, &mut [0_u8; 8]);
        }
        Ok(next)
    }

    /// Closes the session and its subscribers.
    pub(super) fn close(&self) {
        self.queue().is_closed = true;
        self.closing.notify_all();
    }

    fn queue(&self) -> MutexGuard<'_, Queue<T>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> AsFd for Inbox<T> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_beyond_the_limits_are_dropped_and_said() {
        let inbox = Inbox::new().expect("an event");
        (0..5).for_each(|number| inbox.put(number, MAX_WAITING_BYTES / 4, true));
        let refusal = inbox.next().expect_err("dropped");
        assert!(refusal.why.starts_with("1 messages were dropped"), "{}", refusal.why);
        let rest: Vec<i32> = std::iter::from_fn(|| inbox.next().expect("no more dropped")).map(|(it, _)| it).collect();
        assert_eq!(rest, [1, 2, 3, 4]);
        inbox.put(5, 1, false);
        let mut fds = [rustix::event::PollFd::new(&inbox.event, rustix::event::PollFlags::IN)];
        let now = rustix::event::Timespec { tv_sec: 0, tv_nsec: 0 };
        assert_eq!(rustix::event::poll(&mut fds, Some(&now)), Ok(0));
        assert_eq!(inbox.next().expect("no more dropped").map(|(it, _)| it), Some(5));
        (0..MAX_WAITING + 3).for_each(|number| inbox.put(number as i32, 1, true));
        assert!(inbox.next().expect_err("dropped").why.starts_with("3 messages"));
    }
}
