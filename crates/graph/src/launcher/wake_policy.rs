//! Decides whether an operator that is woken may interrupt the process that runs (`SCHED_OTHER`) or waits for it
//! (`SCHED_BATCH`).
//!
//! A stage that wakes the next one has microseconds of work left. If the woken stage interrupts it, the kernel moves the
//! interrupted one to another core, and soon each hop wakes a sleeping core: 27 µs instead of 5 on a virtual machine of
//! two cores. So operators wait, as long as other programs leave most of the processor time unused. Where these fill the
//! cores, an operator that waits would wait for milliseconds, so it interrupts them.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use rustix::param::clock_ticks_per_second;
use rustix::thread::{CpuSet, sched_getaffinity};

/// The time between two looks.
const PERIOD: Duration = Duration::from_millis(250);
/// Operators wait while other programs take less than this share of the processor time.
const LARGEST_SHARE: f64 = 0.25;

/// The use of the cores that this process may run on, since they were started.
struct Usage {
    at: Instant,
    n_cpus: usize,
    idle_secs: f64,
    /// The processor time of the operators' main threads, by process.
    own_secs: BTreeMap<u32, f64>,
}

impl Usage {
    /// `None` where the kernel does not tell.
    fn now(pids: &[u32]) -> Option<Usage> {
        let cpus = sched_getaffinity(None).ok()?;
        let stat = std::fs::read_to_string("/proc/stat").ok()?;
        let idle_ticks: Vec<u64> = stat.lines().filter_map(|line| idle_ticks(line, &cpus)).collect();
        let own_secs = pids.iter().filter_map(|pid| Some((*pid, processor_secs(*pid)?))).collect();
        Some(Usage {
            at: Instant::now(),
            n_cpus: idle_ticks.len(),
            idle_secs: idle_ticks.iter().sum::<u64>() as f64 / clock_ticks_per_second() as f64,
            own_secs,
        })
    }

    /// The share of the processor time that other programs have taken since an earlier look.
    fn share_of_others(&self, before: &Usage) -> f64 {
        let whole = self.at.duration_since(before.at).as_secs_f64() * self.n_cpus as f64;
        let since = |(pid, secs): (&u32, &f64)| secs - before.own_secs.get(pid).unwrap_or(&0.0);
        let own: f64 = self.own_secs.iter().map(since).sum();
        (whole - (self.idle_secs - before.idle_secs) - own) / whole
    }
}

/// The idle time in a line of `/proc/stat` about one of these cores: `cpu1 USER NICE SYSTEM IDLE IOWAIT …`.
fn idle_ticks(line: &str, cpus: &CpuSet) -> Option<u64> {
    let mut words = line.strip_prefix("cpu")?.split(' ');
    let cpu: usize = words.next()?.parse().ok()?;
    let ticks: Vec<u64> = words.filter_map(|word| word.parse().ok()).collect();
    (cpu < CpuSet::MAX_CPU && cpus.is_set(cpu)).then_some(ticks.get(3)? + ticks.get(4)?)
}

/// The processor time of a process' main thread.
fn processor_secs(pid: u32) -> Option<f64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/schedstat")).ok()?;
    Some(text.split(' ').next()?.parse::<u64>().ok()? as f64 / 1e9)
}

/// The last look.
pub(super) struct WakePolicy {
    before: Option<Usage>,
}

impl WakePolicy {
    pub(super) fn new() -> WakePolicy {
        WakePolicy { before: Usage::now(&[]) }
    }

    pub(super) fn is_due(&self) -> bool {
        self.before.as_ref().is_none_or(|before| before.at.elapsed() >= PERIOD)
    }

    /// Gives these processes their policy, which lets them wait only if `may_wait`.
    pub(super) fn look(&mut self, pids: &[u32], may_wait: bool) {
        let now = Usage::now(pids);
        if let (Some(now), Some(before)) = (&now, &self.before) {
            let waits = may_wait && now.share_of_others(before) < LARGEST_SHARE;
            pids.iter().for_each(|pid| set_policy(*pid, waits));
        }
        self.before = now;
    }
}

/// Threads that the process starts later, such as those of a network, have the normal policy.
fn set_policy(pid: u32, waits: bool) {
    let policy = if waits { libc::SCHED_BATCH } else { libc::SCHED_OTHER };
    // SAFETY: the struct is valid for any bits, and the kernel reads it during the call alone.
    unsafe {
        let param: libc::sched_param = std::mem::zeroed();
        // A process that has just ended, or a kernel that refuses, keeps the policy that it has.
        libc::sched_setscheduler(pid as libc::pid_t, policy | libc::SCHED_RESET_ON_FORK, &raw const param);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn usage(at: Instant, idle_secs: f64, own_secs: &[(u32, f64)]) -> Usage {
        Usage { at, n_cpus: 2, idle_secs, own_secs: own_secs.iter().copied().collect() }
    }

    #[test]
    fn the_time_of_others_is_neither_idle_nor_our_own() {
        let start = Instant::now();
        let later = start + Duration::from_secs(1);
        let before = usage(start, 100.0, &[(7, 5.0), (8, 9.0)]);
        // Of two seconds, half of one was idle; a process has ended and another one begun.
        let after = usage(later, 100.5, &[(7, 5.75), (9, 0.25)]);
        assert!((after.share_of_others(&before) - 0.25).abs() < 1e-9);
        assert!(usage(later, 102.0, &[(7, 5.0)]).share_of_others(&before).abs() < 1e-9);
    }

    #[test]
    fn the_idle_time_is_that_of_the_cores_that_may_be_used() {
        let mut cpus = CpuSet::new();
        cpus.set(1);
        assert_eq!(idle_ticks("cpu1 10 0 20 300 4 0 1 0 0 0", &cpus), Some(304));
        for other in ["cpu0 10 0 20 300 4 0 1 0 0 0", "cpu  10 0 20 300 4 0 1 0 0 0", "intr 1 2", "cpu1 10 0"] {
            assert_eq!(idle_ticks(other, &cpus), None, "{other}");
        }
    }

    #[test]
    fn a_process_gets_its_policy_and_loses_it_again() {
        let mut child = std::process::Command::new("sleep").arg("600").spawn().expect("sleep");
        let pid = child.id();
        // SAFETY: the call has no preconditions.
        let policy = || unsafe { libc::sched_getscheduler(pid as libc::pid_t) } & !libc::SCHED_RESET_ON_FORK;
        let found = [true, false, true].map(|waits| {
            set_policy(pid, waits);
            policy()
        });
        let usage = Usage::now(&[pid, u32::MAX]);
        child.kill().and_then(|()| child.wait()).expect("killed");
        assert_eq!(found, [libc::SCHED_BATCH, libc::SCHED_OTHER, libc::SCHED_BATCH]);
        let usage = usage.expect("a look");
        assert!(usage.n_cpus > 0 && usage.idle_secs > 0.0, "{} cores", usage.n_cpus);
        assert_eq!(usage.own_secs.keys().copied().collect::<Vec<_>>(), [pid]);
    }
}
