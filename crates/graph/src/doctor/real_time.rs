//! What a machine has for real-time nodes, and what to set where it lacks something. A graph runs without all of it.

use rustix::thread::{CapabilitySet, capabilities};

use super::lateness::{PRIORITY, WakeUps};
use super::{Finding, read};

/// A thread that is later than this by 1 in 1000 wake-ups under load misses periods of 1 kHz.
const LATE_UNDER_LOAD_US: u64 = 500;
/// Locked memory that an operator needs: its program, its stacks and the shared memory that it maps.
const ENOUGH_LOCKED_BYTES: u64 = 256 << 20;
/// With fewer cores, none can be kept free for a node.
const ENOUGH_CORES: usize = 4;

/// The means of this machine for nodes with `scheduling`, `cpus` or `lock_memory` in the dataflow file.
pub(super) fn findings(granted_priority: Option<u64>, memory_lock: Option<u64>, n_cores: usize) -> Vec<Finding> {
    let is_preempt_rt = read("/sys/kernel/realtime") == "1" || read("/proc/sys/kernel/version").contains("PREEMPT_RT");
    let may_lock =
        capabilities(None).is_ok_and(|capabilities| capabilities.effective.contains(CapabilitySet::IPC_LOCK));
    vec![
        kernel(&read("/proc/sys/kernel/osrelease"), is_preempt_rt),
        governors(&governors_of_cores()),
        priority(granted_priority),
        locked_memory(if may_lock { None } else { memory_lock }),
        isolation(&read("/sys/devices/system/cpu/isolated"), &read("/sys/devices/system/cpu/nohz_full"), n_cores),
    ]
}

/// The lateness of threads of one policy at their wake-ups. It is never a failure.
pub(super) fn wake_ups(policy: &str, measured: Option<WakeUps>, advice: &str) -> Finding {
    let check = format!("wake-up latency, {policy}");
    let Some(measured) = measured else {
        return Finding::ok(&check, "not measured: the kernel gives this process no such thread");
    };
    let of = |late: super::Lateness| {
        format!("p50 {}, p99 {}, p99.9 {}, worst {} µs", late.p50_us, late.p99_us, late.p999_us, late.worst_us)
    };
    let found = format!("idle: {}; under load: {}", of(measured.idle), of(measured.under_load));
    let finding = Finding { wake_ups: Some(measured), ..Finding::ok(&check, found) };
    if measured.under_load.p999_us > LATE_UNDER_LOAD_US { finding.with_advice(advice) } else { finding }
}

fn kernel(release: &str, is_preempt_rt: bool) -> Finding {
    let check = "real-time kernel";
    if is_preempt_rt {
        return Finding::ok(check, format!("Linux {release} with PREEMPT_RT"));
    }
    Finding::ok(check, format!("Linux {release} without PREEMPT_RT")).with_advice(
        "for a bound on the worst latency: a kernel with CONFIG_PREEMPT_RT (Debian: linux-image-rt-amd64; Ubuntu: pro enable \
         realtime-kernel; your own from Linux 6.12 on)",
    )
}

fn governors_of_cores() -> Vec<String> {
    let cores = std::fs::read_dir("/sys/devices/system/cpu").into_iter().flatten().flatten();
    let mut governors: Vec<String> = cores
        .map(|core| read(&format!("{}/cpufreq/scaling_governor", core.path().display())))
        .filter(|governor| !governor.is_empty())
        .collect();
    governors.sort();
    governors.dedup();
    governors
}

fn governors(found: &[String]) -> Finding {
    let check = "processor frequency";
    if found.is_empty() {
        return Finding::ok(check, "not in the hands of this kernel");
    }
    let finding = Finding::ok(check, format!("governor {}", found.join(", ")));
    if found.iter().all(|governor| governor == "performance") {
        finding
    } else {
        finding.with_advice("a core that slept begins slowly: cpupower frequency-set -g performance")
    }
}

fn priority(granted: Option<u64>) -> Finding {
    let check = "real-time priority";
    let advice = format!(
        "for nodes with 'scheduling': '@GROUP - rtprio {PRIORITY}' in /etc/security/limits.d/realtime.conf; systemd: \
         LimitRTPRIO={PRIORITY}; docker run --ulimit rtprio={PRIORITY} --cap-add SYS_NICE"
    );
    match granted {
        Some(priority) if priority >= PRIORITY => Finding::ok(check, format!("this process may have {priority}")),
        Some(priority) => Finding::ok(check, format!("this process may have {priority} at most")).with_advice(advice),
        None => Finding::ok(check, "this process may have none (RLIMIT_RTPRIO)").with_advice(advice),
    }
}

/// `None` is no limit.
fn locked_memory(limit_bytes: Option<u64>) -> Finding {
    let check = "locked memory";
    let Some(limit_bytes) = limit_bytes else {
        return Finding::ok(check, "no limit");
    };
    let finding = Finding::ok(check, format!("at most {} KiB a process (RLIMIT_MEMLOCK)", limit_bytes >> 10));
    if limit_bytes < ENOUGH_LOCKED_BYTES {
        finding.with_advice(
            "for nodes with 'lock_memory': '@GROUP - memlock unlimited' in /etc/security/limits.d/realtime.conf; systemd: \
             LimitMEMLOCK=infinity; docker run --ulimit memlock=-1",
        )
    } else {
        finding
    }
}

/// `isolated` and `nohz_full` are the kernel's lists of cores, like `2-3`; empty if there are none.
fn isolation(isolated: &str, nohz_full: &str, n_cores: usize) -> Finding {
    let check = "isolated cores";
    let nohz_full = if nohz_full == "(null)" { "" } else { nohz_full };
    let or_none = |cores: &str| if cores.is_empty() { "none".to_string() } else { cores.to_string() };
    let finding = Finding::ok(check, format!("isolcpus {}, nohz_full {}", or_none(isolated), or_none(nohz_full)));
    if !isolated.is_empty() && !nohz_full.is_empty() {
        return finding;
    }
    if n_cores < ENOUGH_CORES {
        return finding
            .with_advice(format!("{n_cores} cores are too few to keep one free: use {ENOUGH_CORES} or more"));
    }
    let last = n_cores - 1;
    finding.with_advice(format!(
        "for nodes with 'cpus': isolcpus={last} nohz_full={last} rcu_nocbs={last} on the kernel's command line, and 'cpus: \
         [{last}]' in the dataflow file"
    ))
}

#[cfg(test)]
mod tests {
    use super::super::{Fitness, Lateness};
    use super::*;

    /// The advice; empty if there is none.
    fn advice(finding: Finding) -> String {
        assert_eq!(finding.verdict, Fitness::Ok, "a graph runs without it: {finding:?}");
        let advice = finding.advice.unwrap_or_default();
        assert!(!advice.contains('\n'), "{advice}");
        advice
    }

    #[test]
    fn what_a_real_time_node_lacks_is_said_with_what_to_set() {
        assert_eq!(advice(kernel("6.12.1-rt", true)), "");
        assert!(advice(kernel("6.12.1", false)).contains("CONFIG_PREEMPT_RT"));
        let named = |names: &[&str]| governors(&names.iter().map(ToString::to_string).collect::<Vec<_>>());
        assert_eq!((advice(named(&[])), advice(named(&["performance"]))), (String::new(), String::new()));
        assert!(advice(named(&["performance", "schedutil"])).contains("cpupower frequency-set -g performance"));
        assert_eq!(advice(priority(Some(PRIORITY))), "");
        for too_low in [None, Some(10)] {
            assert!(advice(priority(too_low)).contains("rtprio 80"));
        }
        assert_eq!((advice(locked_memory(None)), advice(locked_memory(Some(1 << 30)))), (String::new(), String::new()));
        assert!(advice(locked_memory(Some(8 << 20))).contains("memlock unlimited"));
        assert!(locked_memory(Some(8 << 20)).found.contains("8192 KiB"));
        assert_eq!(advice(isolation("3", "3", 4)), "");
        for (isolated, nohz_full) in [("", ""), ("", "(null)"), ("3", ""), ("", "3")] {
            assert!(advice(isolation(isolated, nohz_full, 4)).contains("isolcpus=3 nohz_full=3"));
        }
        assert!(advice(isolation("", "", 2)).contains("2 cores are too few"));
    }

    #[test]
    fn lateness_is_advice_and_never_a_failure() {
        let late = |p999_us| Lateness { n_wake_ups: 1000, p50_us: 55, p99_us: 80, p999_us, worst_us: 1_000_000 };
        let measured = |p999_us| Some(WakeUps { idle: late(100), under_load: late(p999_us) });
        assert_eq!(advice(wake_ups("normal", measured(500), "do this")), "");
        assert_eq!(advice(wake_ups("normal", measured(501), "do this")), "do this");
        assert_eq!(advice(wake_ups("SCHED_FIFO", None, "do this")), "");
        let found = wake_ups("normal", measured(7000), "do this").found;
        assert_eq!(
            found,
            "idle: p50 55, p99 80, p99.9 100, worst 1000000 µs; under load: p50 55, p99 80, p99.9 7000, worst 1000000 µs"
        );
    }
}
