//! How late a sleeping thread wakes up, on an idle machine and while all cores are busy. It measures as cyclictest does: a
//! thread sleeps until times that lie a period apart and compares the clock with them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use std::{io, thread};

use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};
use serde::Serialize;

const PERIOD_NANOS: i64 = 1_000_000;
/// One second each on the idle machine and under load.
const N_WAKE_UPS: usize = 1000;
/// Above the threads of the kernel that handle interrupts, which have 50.
pub(super) const PRIORITY: u64 = 80;

/// The lateness of a thread at its wake-ups, in whole microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Lateness {
    pub n_wake_ups: usize,
    pub p50_us: u64,
    pub p99_us: u64,
    pub p999_us: u64,
    pub worst_us: u64,
}

/// A thread's lateness without and with load on all cores.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct WakeUps {
    pub idle: Lateness,
    pub under_load: Lateness,
}

impl Lateness {
    /// `None` of no wake-up.
    fn of(mut late: Vec<Duration>) -> Option<Self> {
        late.sort();
        let worst = late.last()?;
        // The nearest rank: at least this share of the wake-ups was not later.
        let quantile = |per_mille: usize| late[(late.len() * per_mille).div_ceil(1000).max(1) - 1];
        let micros = |late: Duration| late.as_micros() as u64;
        Some(Lateness {
            n_wake_ups: late.len(),
            p50_us: micros(quantile(500)),
            p99_us: micros(quantile(990)),
            p999_us: micros(quantile(999)),
            worst_us: micros(*worst),
        })
    }
}

/// Measures for two seconds: a thread at the normal policy and, beside it, one at SCHED_FIFO, if the kernel lets this
/// process have one.
pub(super) fn measure(n_cores: usize) -> (Option<WakeUps>, Option<WakeUps>) {
    let [idle, under_load] = [0, n_cores].map(|n_busy| {
        let goes_on = AtomicBool::new(true);
        thread::scope(|scope| {
            (0..n_busy).for_each(|_| {
                scope.spawn(|| {
                    while goes_on.load(Ordering::Relaxed) {
                        std::hint::spin_loop();
                    }
                });
            });
            let normal = scope.spawn(|| sleep_and_wake(0));
            // It wakes up between the wake-ups of the other thread.
            let fifo = scope.spawn(|| ask_for_fifo().and_then(|_| sleep_and_wake(PERIOD_NANOS / 2)));
            let late = [normal, fifo].map(|thread| Lateness::of(thread.join().ok()?.ok()?));
            goes_on.store(false, Ordering::Relaxed);
            late
        })
    });
    let both = |policy: usize| Some(WakeUps { idle: idle[policy]?, under_load: under_load[policy]? });
    (both(0), both(1))
}

/// The real-time priority that the kernel gives a thread of this process; `None` if it gives none.
pub(super) fn granted_priority() -> Option<u64> {
    thread::spawn(ask_for_fifo).join().ok()?.ok()
}

/// Gives the calling thread [`PRIORITY`] at SCHED_FIFO, or the highest priority that its limit allows.
fn ask_for_fifo() -> io::Result<u64> {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Rtprio).current.unwrap_or(PRIORITY);
    set_fifo(PRIORITY).map(|()| PRIORITY).or_else(|error| match limit {
        0 => Err(error),
        limit => set_fifo(limit.min(PRIORITY)).map(|()| limit.min(PRIORITY)),
    })
}

fn set_fifo(priority: u64) -> io::Result<()> {
    let param = libc::sched_param { sched_priority: priority as libc::c_int };
    // SAFETY: the call reads `param`, which is valid, and changes the calling thread alone. rustix does not have it.
    match unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &raw const param) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Sleeps until [`N_WAKE_UPS`] times, a period apart, and returns how late it woke up at each.
fn sleep_and_wake(offset_nanos: i64) -> io::Result<Vec<Duration>> {
    let mut late = Vec::with_capacity(N_WAKE_UPS);
    let mut due = after(clock_gettime(ClockId::Monotonic), PERIOD_NANOS + offset_nanos);
    for _ in 0..N_WAKE_UPS {
        clock_nanosleep_absolute(ClockId::Monotonic, &due)?;
        let now = clock_gettime(ClockId::Monotonic);
        late.push(since(now, due));
        // A thread that was late for more than a period does not sleep until times that are over.
        due = after(due, PERIOD_NANOS);
        if since(now, due) > Duration::ZERO {
            due = after(now, PERIOD_NANOS);
        }
    }
    Ok(late)
}

fn after(time: Timespec, nanos: i64) -> Timespec {
    let nanos = time.tv_nsec + nanos;
    Timespec { tv_sec: time.tv_sec + nanos.div_euclid(1_000_000_000), tv_nsec: nanos.rem_euclid(1_000_000_000) }
}

/// 0 if `now` is before `due`.
fn since(now: Timespec, due: Timespec) -> Duration {
    let nanos = (now.tv_sec - due.tv_sec) * 1_000_000_000 + now.tv_nsec - due.tv_nsec;
    Duration::from_nanos(u64::try_from(nanos).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_nearest_rank() {
        // 1 to 1000 µs, the latest first.
        let late = (1..=1000).rev().map(Duration::from_micros).collect();
        let expected = Lateness { n_wake_ups: 1000, p50_us: 500, p99_us: 990, p999_us: 999, worst_us: 1000 };
        assert_eq!(Lateness::of(late), Some(expected));
        let one = Lateness { n_wake_ups: 1, p50_us: 7, p99_us: 7, p999_us: 7, worst_us: 7 };
        assert_eq!(Lateness::of(vec![Duration::from_nanos(7_900)]), Some(one));
        assert_eq!(Lateness::of(Vec::new()), None);
    }

    #[test]
    fn times_carry_over_seconds() {
        let time = |tv_sec, tv_nsec| Timespec { tv_sec, tv_nsec };
        assert_eq!(after(time(5, 999_500_000), PERIOD_NANOS), time(6, 500_000));
        assert_eq!(since(time(6, 500_000), time(5, 999_500_000)), Duration::from_millis(1));
        assert_eq!(since(time(5, 0), time(6, 0)), Duration::ZERO);
    }
}
