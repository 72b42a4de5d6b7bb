//! Decides whether an operator that is woken may interrupt the process that runs (`SCHED_OTHER`) or waits for it
//! (`SCHED_BATCH`).
//!
//! A stage that wakes the next one has microseconds of work left. If the woken stage interrupts it, the kernel moves the
//! interrupted one to another core, and soon every third hop wakes a sleeping core. That takes 27 µs instead of 5 on a
//! virtual machine of two cores. So operators wait, as long as that costs little. Where other programs fill the cores, or
//! the operators themselves compute for long, an operator that waits would wait for milliseconds, so it interrupts them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use rustix::param::clock_ticks_per_second;
use rustix::thread::{CpuSet, sched_getaffinity};

/// The time between two looks.
const PERIOD: Duration = Duration::from_millis(250);
/// Operators wait while other programs take less than this share of the processor time.
const LARGEST_SHARE: f64 = 0.25;
/// They also wait only while none of their threads waits for a core longer than this, on average.
const LONGEST_WAIT_SECS: f64 = 1e-3;
/// A thread that runs less often between two looks has no average.
const LEAST_RUNS: u64 = 10;
/// After a look at which they must not wait, they do not for so long.
const PAUSE: Duration = Duration::from_secs(2);

/// The times of a thread since it began.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Thread {
    running_secs: f64,
    /// The time for which it could have run, and another one did.
    waiting_secs: f64,
    n_runs: u64,
}

/// The use of the cores that this process may run on, since they were started.
struct Usage {
    at: Instant,
    n_cpus: usize,
    idle_secs: f64,
    /// The threads of operators and of the launcher, by their numbers.
    threads: BTreeMap<u32, Thread>,
}

impl Usage {
    /// `None` where the kernel does not tell.
    fn now(threads: impl Iterator<Item = u32>) -> Option<Usage> {
        let cpus = sched_getaffinity(None).ok()?;
        let stat = std::fs::read_to_string("/proc/stat").ok()?;
        let idle_ticks: Vec<u64> = stat.lines().filter_map(|line| idle_ticks(line, &cpus)).collect();
        let thread = |number: u32| {
            let text = std::fs::read_to_string(format!("/proc/{number}/schedstat")).ok()?;
            Some((number, thread_of(&text)?))
        };
        Some(Usage {
            at: Instant::now(),
            n_cpus: idle_ticks.len(),
            idle_secs: idle_ticks.iter().sum::<u64>() as f64 / clock_ticks_per_second() as f64,
            threads: threads.filter_map(thread).collect(),
        })
    }

    /// Whether woken operators may wait, by the time since an earlier look.
    fn allows_waiting(&self, before: &Usage) -> bool {
        let secs = self.at.duration_since(before.at).as_secs_f64();
        let whole = secs * self.n_cpus as f64;
        let (mut own, mut waits_for_long) = (0.0, false);
        for (number, thread) in &self.threads {
            match before.threads.get(number) {
                Some(earlier) => {
                    own += thread.running_secs - earlier.running_secs;
                    let n_runs = thread.n_runs.saturating_sub(earlier.n_runs);
                    let longest = LONGEST_WAIT_SECS * n_runs as f64;
                    waits_for_long |= n_runs >= LEAST_RUNS && thread.waiting_secs - earlier.waiting_secs > longest;
                }
                // The time of a thread that was not known before may be older.
                None => own += thread.running_secs.min(secs),
            }
        }
        let share_of_others = (whole - (self.idle_secs - before.idle_secs) - own.min(whole)) / whole;
        // A core that comes or goes, or one that a container cannot see, makes no sense of the sums.
        self.n_cpus == before.n_cpus && share_of_others < LARGEST_SHARE && !waits_for_long
    }
}

/// The idle time in a line of `/proc/stat` about one of these cores: `cpu1 USER NICE SYSTEM IDLE IOWAIT …`.
fn idle_ticks(line: &str, cpus: &CpuSet) -> Option<u64> {
    let mut words = line.strip_prefix("cpu")?.split(' ');
    let cpu: usize = words.next()?.parse().ok()?;
    let ticks: Vec<u64> = words.filter_map(|word| word.parse().ok()).collect();
    (cpu < CpuSet::MAX_CPU && cpus.is_set(cpu)).then_some(ticks.get(3)? + ticks.get(4)?)
}

/// By the text of a `schedstat`: nanoseconds of running and of waiting, and the number of runs.
fn thread_of(text: &str) -> Option<Thread> {
    let numbers: Vec<u64> = text.split_whitespace().map_while(|word| word.parse().ok()).collect();
    let [running_nanos, waiting_nanos, n_runs] = numbers.get(..3)?.try_into().ok()?;
    Some(Thread { running_secs: running_nanos as f64 / 1e9, waiting_secs: waiting_nanos as f64 / 1e9, n_runs })
}

/// The last look.
pub(super) struct WakePolicy {
    before: Option<Usage>,
    last_look: Instant,
    /// The last look at which operators must not wait.
    refused: Option<Instant>,
    /// Operators begin with the normal policy.
    is_open: bool,
}

impl WakePolicy {
    pub(super) fn new() -> WakePolicy {
        let before = Usage::now(threads_of(std::process::id()).into_iter());
        // SAFETY: the call has no preconditions.
        let is_open = unsafe { libc::sched_getscheduler(0) } == libc::SCHED_OTHER;
        WakePolicy { before, last_look: Instant::now(), refused: None, is_open }
    }

    pub(super) fn is_due(&self) -> bool {
        self.is_open && self.last_look.elapsed() >= PERIOD
    }

    /// Gives these processes their policy, which lets them wait only if `may_wait`.
    pub(super) fn look(&mut self, pids: &BTreeSet<u32>, may_wait: bool) {
        self.last_look = Instant::now();
        let threads: Vec<u32> = pids.iter().flat_map(|pid| threads_of(*pid)).collect();
        // The launcher reads and records samples, and keeps its policy: it may be a part of a user's program.
        let now = Usage::now(threads.iter().copied().chain(threads_of(std::process::id())));
        let is_allowed =
            may_wait && now.as_ref().zip(self.before.as_ref()).is_some_and(|(now, before)| now.allows_waiting(before));
        self.before = now;
        let waits = self.waits(is_allowed, self.last_look);
        threads.into_iter().for_each(|thread| set_policy(thread, waits));
    }

    /// Whether operators wait after a look at which that was allowed, or not.
    fn waits(&mut self, is_allowed: bool, now: Instant) -> bool {
        if !is_allowed {
            self.refused = Some(now);
        }
        self.refused.is_none_or(|refused| now.duration_since(refused) >= PAUSE)
    }
}

fn threads_of(pid: u32) -> Vec<u32> {
    let entries = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect()
}

/// A policy that the operator has chosen itself stays, unless it is one of the two. So does a negative `nice`: it asks for more
/// than to wait.
fn set_policy(thread: u32, waits: bool) {
    let thread = thread as libc::pid_t;
    let (from, to) =
        if waits { (libc::SCHED_OTHER, libc::SCHED_BATCH) } else { (libc::SCHED_BATCH, libc::SCHED_OTHER) };
    // SAFETY: the struct is valid for any bits, and the kernel reads it during the call alone.
    unsafe {
        let is_from = libc::sched_getscheduler(thread) == from;
        if is_from && (!waits || libc::getpriority(libc::PRIO_PROCESS, thread as libc::id_t) >= 0) {
            let param: libc::sched_param = std::mem::zeroed();
            // A thread that has just ended, or a kernel that refuses, keeps the policy that it has.
            libc::sched_setscheduler(thread, to, &raw const param);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thread(running_secs: f64, waiting_secs: f64, n_runs: u64) -> Thread {
        Thread { running_secs, waiting_secs, n_runs }
    }

    fn usage(at: Instant, idle_secs: f64, threads: &[(u32, Thread)]) -> Usage {
        Usage { at, n_cpus: 2, idle_secs, threads: threads.iter().copied().collect() }
    }

    #[test]
    fn operators_wait_while_others_take_little_time_and_none_waits_for_long() {
        let start = Instant::now();
        let later = start + Duration::from_secs(1);
        let before = usage(start, 100.0, &[(7, thread(5.0, 1.0, 1000)), (8, thread(9.0, 0.0, 10))]);
        let allows =
            |idle_secs: f64, threads: &[(u32, Thread)]| usage(later, idle_secs, threads).allows_waiting(&before);
        // All of two seconds is idle, or our own: a process has ended, and another one began long ago.
        assert!(allows(102.0, &[(7, thread(5.0, 1.0, 1000))]));
        assert!(allows(100.5, &[(7, thread(5.5, 1.0, 1001)), (9, thread(50.0, 0.0, 1))]));
        // Others have taken a fifth, or two fifths.
        assert!(allows(101.1, &[(7, thread(5.5, 1.0, 1000))]));
        assert!(!allows(100.7, &[(7, thread(5.5, 1.0, 1000))]));
        // It waited for 0.9 ms or 1.1 ms before each run. What a thread does that runs once is no average.
        assert!(allows(101.5, &[(7, thread(5.5, 1.09, 1100)), (8, thread(9.0, 0.2, 11))]));
        assert!(!allows(101.5, &[(7, thread(5.5, 1.11, 1100))]));
        assert!(!allows(101.5, &[(7, thread(5.5, 1.0, 1100)), (8, thread(9.0, 0.2, 30))]));
        let other_cores = Usage { n_cpus: 3, ..usage(later, 102.0, &[]) };
        assert!(!other_cores.allows_waiting(&before));
        let none = || Usage { n_cpus: 0, ..usage(start, 0.0, &[]) };
        assert!(!none().allows_waiting(&none()));
    }

    #[test]
    fn operators_interrupt_for_two_seconds_after_a_refusal() {
        let mut policy = WakePolicy::new();
        let start = Instant::now();
        let mut waits = |is_allowed, millis| policy.waits(is_allowed, start + Duration::from_millis(millis));
        assert!(waits(true, 0));
        assert!(!waits(false, 250) && !waits(true, 500) && !waits(false, 750) && !waits(true, 2500));
        assert!(waits(true, 2750));
    }

    #[test]
    fn the_idle_time_is_that_of_the_cores_that_may_be_used() {
        let mut cpus = CpuSet::new();
        cpus.set(1);
        assert_eq!(idle_ticks("cpu1 10 0 20 300 4 0 1 0 0 0", &cpus), Some(304));
        for other in ["cpu0 10 0 20 300 4 0 1 0 0 0", "cpu  10 0 20 300 4 0 1 0 0 0", "intr 1 2", "cpu1 10 0"] {
            assert_eq!(idle_ticks(other, &cpus), None, "{other}");
        }
        assert_eq!(thread_of("1500000000 250000000 12\n"), Some(thread(1.5, 0.25, 12)));
        assert_eq!(thread_of("1500000000 250000000"), None);
    }

    #[test]
    fn a_process_gets_its_policy_and_loses_it_again() {
        let mut child = std::process::Command::new("sleep").arg("600").spawn().expect("sleep");
        let pid = child.id();
        // SAFETY: the call has no preconditions.
        let policy = || unsafe { libc::sched_getscheduler(pid as libc::pid_t) };
        let found = [policy(), libc::SCHED_BATCH, libc::SCHED_OTHER].map(|wanted| {
            set_policy(pid, wanted == libc::SCHED_BATCH);
            policy()
        });
        // SAFETY: as above.
        let nice = unsafe { libc::getpriority(libc::PRIO_PROCESS, pid) };
        let threads = threads_of(pid);
        child.kill().and_then(|()| child.wait()).expect("killed");
        // A policy under which the tests themselves run is left alone.
        if found[0] == libc::SCHED_OTHER && nice >= 0 {
            assert_eq!(found, [libc::SCHED_OTHER, libc::SCHED_BATCH, libc::SCHED_OTHER]);
        }
        assert_eq!(threads, [pid]);
    }
}
