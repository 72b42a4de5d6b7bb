//! Waits for several ports and for another thread at once.

use std::cell::Cell;
use std::io::{Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use iceoryx2::prelude::{FileDescriptorBased, ipc};
pub use rustix::event::PollFd;
use rustix::event::{PollFlags, Timespec, poll};

/// The end of a port that is woken when a sample may have come.
pub type Listener = iceoryx2::port::listener::Listener<ipc::Service>;

/// The longest wait right after a listener ended one. A listener of iceoryx2 0.10 that drains its events while
/// a second one is on its way can be left in a state in which no further one wakes it, until it looks again of its own
/// accord.
const LIMIT_AFTER_WAKING: Duration = Duration::from_millis(2);

pub struct Waiter {
    wake: UnixStream,
    /// Whether a listener ended the last wait.
    was_woken: Cell<bool>,
}

/// Ends a wait from another thread or from a signal handler.
#[derive(Debug)]
pub struct Waker {
    stream: UnixStream,
}

impl Waiter {
    /// A waiter and its waker.
    ///
    /// # Errors
    /// The system has no more sockets.
    pub fn new() -> std::io::Result<(Waiter, Waker)> {
        let (wake, stream) = UnixStream::pair()?;
        wake.set_nonblocking(true)?;
        stream.set_nonblocking(true)?;
        Ok((Waiter { wake, was_woken: Cell::new(false) }, Waker { stream }))
    }

    /// Waits until a listener or the waker wakes it, at most `limit`. It may return early.
    pub fn wait(&self, listeners: &[&Listener], limit: Duration) {
        self.wait_for(listeners, &[], limit);
    }

    /// As [`Waiter::wait`], also until one of `others` is ready.
    pub fn wait_for(&self, listeners: &[&Listener], others: &[PollFd<'_>], limit: Duration) {
        let limit = if self.was_woken.get() { limit.min(LIMIT_AFTER_WAKING) } else { limit };
        // SAFETY: the listeners and with them their descriptors outlive the wait.
        let fds = listeners
            .iter()
            .map(|listener| unsafe { BorrowedFd::borrow_raw(listener.file_descriptor().native_handle()) });
        let mut fds: Vec<PollFd<'_>> = std::iter::once(self.wake.as_fd())
            .chain(fds)
            .map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN))
            .chain(others.iter().cloned())
            .collect();
        let timeout = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: i64::from(limit.subsec_nanos()) };
        // A signal ends the wait early, which does no harm.
        let _ = poll(&mut fds, Some(&timeout));
        if fds[0].revents().contains(PollFlags::IN) {
            let _ = (&self.wake).read(&mut [0; 64]);
        }
        let n_events: u64 = listeners.iter().map(|listener| listener.try_wait(|_| {}).unwrap_or(0)).sum();
        self.was_woken.set(n_events > 0);
    }
}

impl Waker {
    /// Ends the wait, or the next one.
    pub fn wake(&self) {
        // A full socket means that the waiter is being woken already.
        let _ = (&self.stream).write(&[0]);
    }

    /// Another waker of the same waiter.
    ///
    /// # Errors
    /// The system has no more descriptors.
    pub fn try_clone(&self) -> std::io::Result<Waker> {
        Ok(Waker { stream: self.stream.try_clone()? })
    }

    /// The stream that wakes the waiter when a signal handler writes to it.
    ///
    /// # Errors
    /// The system has no more descriptors.
    pub fn stream(&self) -> std::io::Result<UnixStream> {
        self.stream.try_clone()
    }
}
