//! Wakes a process when a sample, a command or a signal has come.
//!
//! Each instance has a bell among the [cursors](crate::cursors): two words in shared memory. A writer rings the bells of its
//! readers after each sample, or after a few where more wait for the writer itself (`stage.rs`). A reader that is awake costs
//! it one load or one exchange, a reader that sleeps one futex call. The reader clears its bell before it looks at its queues,
//! so a ring that comes after the look ends the next wait at once.
//!
//! A process that is killed at any moment leaves the bell in a state that costs a writer one futex call at most.

use std::sync::atomic::{AtomicU32, Ordering, fence};
use std::time::Duration;

use rustix::thread::futex;
use rustix::time::Timespec;

/// The words of a bell. Those of a new file of cursors are zeros.
#[repr(C)]
#[derive(Debug, Default)]
pub struct Bell<W = AtomicU32> {
    /// 1 if the bell was rung since the reader cleared it.
    is_rung: W,
    /// 1 while the reader may be asleep.
    is_asleep: W,
}

/// A word of a bell. A test puts one in its place whose interleavings and orders of memory are all tried.
pub trait FutexWord {
    fn load(&self, order: Ordering) -> u32;
    fn store(&self, value: u32, order: Ordering);
    fn swap(&self, value: u32, order: Ordering) -> u32;
    fn fence(order: Ordering);
    /// Wakes the process that sleeps on this word.
    fn wake(&self);
    /// Sleeps if the word is 0, until it is woken, a signal comes or the time is over.
    fn sleep(&self, limit: Duration);
}

impl FutexWord for AtomicU32 {
    fn load(&self, order: Ordering) -> u32 {
        self.load(order)
    }

    fn store(&self, value: u32, order: Ordering) {
        self.store(value, order);
    }

    fn swap(&self, value: u32, order: Ordering) -> u32 {
        self.swap(value, order)
    }

    fn fence(order: Ordering) {
        fence(order);
    }

    fn wake(&self) {
        let _ = futex::wake(self, futex::Flags::empty(), 1);
    }

    fn sleep(&self, limit: Duration) {
        let limit = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: i64::from(limit.subsec_nanos()) };
        // Each error ends the wait early, which does no harm.
        let _ = futex::wait(self, futex::Flags::empty(), 0, Some(&limit));
    }
}

impl<W: FutexWord> Bell<W> {
    /// Tells the reader that a sample, a command or a signal has come, which the caller has stored before. A signal handler
    /// may call it.
    pub fn ring(&self) {
        // The reader clears the bell, then looks. If this load sees a ring that was not cleared yet, the look finds the sample.
        W::fence(Ordering::SeqCst);
        if self.is_rung.load(Ordering::Relaxed) == 0
            && self.is_rung.swap(1, Ordering::SeqCst) == 0
            && self.is_asleep.load(Ordering::SeqCst) != 0
        {
            self.is_rung.wake();
        }
    }

    /// Takes the bell for a new instance, which has not looked at anything yet.
    pub(crate) fn take(&self) {
        self.is_asleep.store(0, Ordering::SeqCst);
        self.is_rung.store(1, Ordering::SeqCst);
    }

    pub(crate) fn is_rung(&self) -> bool {
        self.is_rung.load(Ordering::Relaxed) != 0
    }

    /// Clears the bell. The reader looks at its queues afterwards.
    pub(crate) fn clear(&self) {
        self.is_rung.store(0, Ordering::SeqCst);
        W::fence(Ordering::SeqCst);
    }

    /// Sleeps until the bell is rung, a signal comes or `limit` has passed.
    pub(crate) fn sleep(&self, limit: Duration) {
        self.is_asleep.store(1, Ordering::SeqCst);
        self.is_rung.sleep(limit);
        self.is_asleep.store(0, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use loom::sync::atomic::{AtomicU32, AtomicU64};
    use loom::sync::{Arc, Condvar, Mutex};

    use super::*;

    /// A word, and the kernel's queue of those that sleep on it. Nothing ends a sleep but a wake: a lost one is a deadlock,
    /// which loom finds.
    #[derive(Default)]
    struct ModelWord {
        word: AtomicU32,
        queue: Mutex<()>,
        woken: Condvar,
    }

    impl FutexWord for ModelWord {
        fn load(&self, order: Ordering) -> u32 {
            self.word.load(order)
        }

        fn store(&self, value: u32, order: Ordering) {
            self.word.store(value, order);
        }

        fn swap(&self, value: u32, order: Ordering) -> u32 {
            self.word.swap(value, order)
        }

        fn fence(order: Ordering) {
            loom::sync::atomic::fence(order);
        }

        fn wake(&self) {
            let _queue = self.queue.lock().expect("no panic");
            self.woken.notify_all();
        }

        fn sleep(&self, _limit: Duration) {
            let queue = self.queue.lock().expect("no panic");
            // The kernel has a full fence before it looks at the word.
            Self::fence(Ordering::SeqCst);
            if self.word.load(Ordering::SeqCst) == 0 {
                drop(self.woken.wait(queue).expect("no panic"));
            }
        }
    }

    /// The interleavings and orders of memory, x86 or ARM, of two writers and a reader that sleeps whenever it finds nothing
    /// new: it hears of every sample.
    #[test]
    fn a_reader_that_sleeps_misses_no_sample() {
        let mut model = loom::model::Builder::new();
        model.preemption_bound = Some(3);
        model.check(|| {
            let bell = Arc::new(Bell::<ModelWord>::default());
            bell.take();
            let sent: Arc<[AtomicU64; 2]> = Arc::default();
            for writer in 0..2 {
                let (bell, sent) = (Arc::clone(&bell), Arc::clone(&sent));
                loom::thread::spawn(move || {
                    sent[writer].store(1, Ordering::Release);
                    bell.ring();
                });
            }
            while sent.iter().any(|sent| sent.load(Ordering::Acquire) == 0) {
                if !bell.is_rung() {
                    bell.sleep(Duration::MAX);
                }
                bell.clear();
            }
        });
    }
}
