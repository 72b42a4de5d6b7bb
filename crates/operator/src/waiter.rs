//! Waits for samples, for other threads, for signals and for descriptors at once.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

pub use rustix::event::PollFd;
use rustix::event::{EventfdFlags, PollFlags, Timespec, eventfd, poll};

use crate::bell::Bell;
use crate::cursors::SharedCursors;
use crate::wiring::WaitMode;

/// A process that waits for descriptors looks for samples so often: a writer cannot end such a wait.
const LOOK_PAUSE: Duration = Duration::from_millis(1);
/// A spinning process looks at the clock after so many looks at its bell.
const N_SPINS: u32 = 64;

pub struct Waiter {
    waker: Waker,
    mode: WaitMode,
}

/// Ends a wait from another thread or from a signal handler.
#[derive(Clone)]
pub struct Waker {
    bell: BellPlace,
    /// Ends a wait for descriptors.
    event: Arc<OwnedFd>,
    /// Whether the waiter waits for descriptors.
    is_polling: Arc<AtomicBool>,
}

/// Where a waiter's bell is.
#[derive(Clone)]
enum BellPlace {
    /// Among the cursors, at this slot: writers can ring it.
    Shared(Arc<SharedCursors>, usize),
    Own(Arc<Bell>),
}

impl BellPlace {
    fn bell(&self) -> &Bell {
        match self {
            BellPlace::Shared(cursors, slot) => cursors.bell(*slot),
            BellPlace::Own(bell) => bell,
        }
    }
}

impl Waiter {
    /// A waiter that writers wake by the bell of a slot.
    ///
    /// # Errors
    /// The system has no more descriptors.
    pub fn of_slot(cursors: &Arc<SharedCursors>, slot: usize, mode: WaitMode) -> std::io::Result<Waiter> {
        Self::new(BellPlace::Shared(Arc::clone(cursors), slot), mode)
    }

    /// A waiter that only this process wakes.
    ///
    /// # Errors
    /// The system has no more descriptors.
    pub fn of_process() -> std::io::Result<Waiter> {
        Self::new(BellPlace::Own(Arc::default()), WaitMode::Event)
    }

    fn new(bell: BellPlace, mode: WaitMode) -> std::io::Result<Waiter> {
        bell.bell().take();
        let event = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        Ok(Waiter { waker: Waker { bell, event, is_polling: Arc::default() }, mode })
    }

    /// A handle that ends its waits.
    pub fn waker(&self) -> Waker {
        self.waker.clone()
    }

    /// Waits until a writer or a waker wakes it, at most `limit`. It may return early. Look at all inputs afterwards.
    pub fn wait(&self, limit: Duration) {
        let bell = self.waker.bell.bell();
        let spins = match self.mode {
            WaitMode::Event => Duration::ZERO,
            WaitMode::PollMicros(micros) => limit.min(Duration::from_micros(micros)),
            WaitMode::Poll => limit,
        };
        if !bell.is_rung() && !spin(bell, spins) && spins < limit {
            bell.sleep(limit - spins);
        }
        bell.clear();
    }

    /// As [`Waiter::wait`], also until one of `fds` is ready. With `has_inputs` it looks for samples every millisecond.
    pub fn wait_for(&self, fds: &[PollFd<'_>], has_inputs: bool, limit: Duration) {
        let limit = if has_inputs { limit.min(LOOK_PAUSE) } else { limit };
        let (bell, event) = (self.waker.bell.bell(), self.waker.event.as_fd());
        self.waker.is_polling.store(true, Ordering::SeqCst);
        if !bell.is_rung() {
            let own = PollFd::from_borrowed_fd(event, PollFlags::IN);
            let mut fds: Vec<PollFd<'_>> = std::iter::once(own).chain(fds.iter().cloned()).collect();
            let timeout = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: i64::from(limit.subsec_nanos()) };
            // A signal ends the wait early, which does no harm.
            let _ = poll(&mut fds, Some(&timeout));
        }
        self.waker.is_polling.store(false, Ordering::Relaxed);
        let _ = rustix::io::read(event, &mut [0; 8]);
        bell.clear();
    }
}

/// Looks at a bell again and again for so long; true once it is rung.
fn spin(bell: &Bell, time: Duration) -> bool {
    if time.is_zero() {
        return false;
    }
    let start = Instant::now();
    while start.elapsed() < time {
        for _ in 0..N_SPINS {
            if bell.is_rung() {
                return true;
            }
            std::hint::spin_loop();
        }
    }
    false
}

impl Waker {
    /// Ends the wait, or the next one. A signal handler may call it.
    pub fn wake(&self) {
        self.bell.bell().ring();
        if self.is_polling.load(Ordering::SeqCst) {
            // A full counter means that the waiter is being woken already.
            let _ = rustix::io::write(&self.event, &1_u64.to_ne_bytes());
        }
    }
}
