//! Checks whether this machine is fit to run a graph, and changes nothing.

mod lateness;
mod real_time;

use std::fmt;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::process::{Resource, getrlimit};
use serde::Serialize;

use crate::client::{running_graphs, status};
use crate::describe::describe;
use crate::log::LogFolder;
use crate::operators::Operators;
use blindgrasp_operator::diagnostics::ENOUGH_FILES;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::namespace::{LEAST_FREE_BYTES, SHARED_MEMORY_FOLDER, left_over};
use blindgrasp_operator::sandbox::supported;
use blindgrasp_operator::wiring::Enforcement;
pub use lateness::{Lateness, WakeUps};

/// Decisions are delayed noticeably on an idle machine that wakes up later than this once in a hundred times.
const LATE_WAKE_US: u64 = 5000;
/// The kernel's policy of a thread that asks for nothing.
const NORMAL: &str = "normal";
/// Clock sources of the kernel that a program reads without a system call.
const FAST_CLOCK_SOURCES: [&str; 4] = ["tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter"];

/// The result of a check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    pub check: String,
    pub verdict: Fitness,
    pub found: String,
    pub advice: Option<String>,
    /// Of the checks that measure how late threads wake up.
    #[serde(flatten)]
    pub wake_ups: Option<WakeUps>,
}

/// Whether [`examine`] measures how late threads wake up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measurement {
    /// For two seconds. For half of them it keeps all cores busy.
    TwoSeconds,
    Skipped,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Fitness {
    Ok,
    /// A graph runs, but maybe with delays.
    Warning,
    Failure,
}

impl fmt::Display for Fitness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Fitness::Ok => "ok",
            Fitness::Warning => "warning",
            Fitness::Failure => "FAILURE",
        })
    }
}

impl Finding {
    fn ok(check: &str, found: impl Into<String>) -> Self {
        Finding { check: check.into(), verdict: Fitness::Ok, found: found.into(), advice: None, wake_ups: None }
    }

    fn with_advice(self, advice: impl Into<String>) -> Self {
        Finding { advice: Some(advice.into()), ..self }
    }

    fn warning(check: &str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Finding { verdict: Fitness::Warning, ..Finding::ok(check, found).with_advice(advice) }
    }

    fn failure(check: &str, found: impl Into<String>, advice: impl Into<String>) -> Self {
        Finding { verdict: Fitness::Failure, ..Finding::warning(check, found, advice) }
    }
}

/// Runs all checks, in a fraction of a second and the time of the measurement.
pub fn examine(measurement: Measurement, operators: &Operators) -> Vec<Finding> {
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut findings = vec![shared_memory()];
    findings.extend(folders());
    findings.push(leftovers());
    findings.push(graphs());
    findings.push(shipped(operators));
    findings.push(cores(n_cores));
    findings.push(clock(&read("/sys/devices/system/clocksource/clocksource0/current_clocksource"), clock_cost()));
    if measurement == Measurement::TwoSeconds {
        findings.extend(wake_ups(lateness::measure(n_cores)));
    }
    findings.push(sandbox(supported()));
    // The launcher raises its own limit to this one.
    findings.push(files(getrlimit(Resource::Nofile).maximum));
    let memory_lock = getrlimit(Resource::Memlock).current;
    findings.extend(real_time::findings(lateness::granted_priority(), memory_lock, n_cores));
    findings.extend(serial_devices());
    findings
}

fn shared_memory() -> Finding {
    let check = "shared memory";
    let larger = format!("mount -o remount,size=1G {SHARED_MEMORY_FOLDER}; in a container: docker run --shm-size=1g");
    match rustix::fs::statvfs(SHARED_MEMORY_FOLDER) {
        Err(error) => Finding::failure(
            check,
            format!("{SHARED_MEMORY_FOLDER}: {error}"),
            format!("mount it: mount -t tmpfs tmpfs {SHARED_MEMORY_FOLDER}"),
        ),
        Ok(memory) if memory.f_blocks == 0 => Finding::ok(check, format!("{SHARED_MEMORY_FOLDER} without a limit")),
        Ok(memory) => {
            let mib = |blocks: u64| (blocks * memory.f_frsize) as f64 / f64::from(1 << 20);
            let found = format!(
                "{:.0} of {:.0} MiB free in {SHARED_MEMORY_FOLDER}",
                mib(memory.f_bavail),
                mib(memory.f_blocks)
            );
            match memory.f_bavail * memory.f_frsize {
                free if free < LEAST_FREE_BYTES => {
                    Finding::failure(check, found, format!("a graph needs {} MiB: {larger}", LEAST_FREE_BYTES >> 20))
                }
                free if free < 4 * LEAST_FREE_BYTES => {
                    Finding::warning(check, found, format!("little for several graphs: {larger}"))
                }
                _ => Finding::ok(check, found),
            }
        }
    }
}

fn folders() -> Vec<Finding> {
    let logs = LogFolder::of_graph("doctor");
    let logs = logs.path().parent().unwrap_or(Path::new("/")).to_path_buf();
    // The folder for logs is made with the first log.
    let logs = logs.ancestors().find(|folder| folder.is_dir()).unwrap_or(Path::new("/")).to_path_buf();
    let places = [("permissions: shared memory", SHARED_MEMORY_FOLDER.into()), ("permissions: logs", logs)];
    let writable = |(check, folder): (&str, std::path::PathBuf)| {
        let probe = folder.join(format!(".blindgrasp-doctor-{}", std::process::id()));
        let mut options = std::fs::OpenOptions::new();
        let outcome = options.write(true).create_new(true).open(&probe).and_then(|mut file| file.write_all(b"probe"));
        let _ = std::fs::remove_file(&probe);
        match outcome {
            Ok(()) => Finding::ok(check, format!("{} can be written", folder.display())),
            Err(error) => Finding::failure(
                check,
                format!("{}: {error}", folder.display()),
                "let this user write there; for logs, set XDG_STATE_HOME to a folder where it may",
            ),
        }
    };
    places.into_iter().map(writable).collect()
}

fn leftovers() -> Finding {
    let check = "leftovers of dead graphs";
    let left = left_over();
    if left.is_empty() {
        return Finding::ok(check, "none");
    }
    let names: Vec<&str> = left.iter().map(|(name, _)| name.as_str()).collect();
    Finding::warning(
        check,
        names.join(", "),
        "blindgrasp doctor --fix removes them; so does the next graph that starts",
    )
}

fn graphs() -> Finding {
    let check = "running graphs";
    let running = running_graphs();
    let silent: Vec<String> =
        running.iter().filter_map(|graph| status(graph).err()).map(|error| error.to_string()).collect();
    if !silent.is_empty() {
        return Finding::warning(check, silent.join("; "), "continue or kill its launcher");
    }
    if running.is_empty() {
        return Finding::ok(check, "none");
    }
    Finding::ok(check, format!("{}, answering", running.join(", ")))
}

fn shipped(operators: &Operators) -> Finding {
    let check = "operators";
    let wrong = operators.iter().filter_map(|(name, program)| {
        let found = match describe(&program.path, &program.args) {
            Ok(description) if description.version == env!("CARGO_PKG_VERSION") => return None,
            Ok(description) => format!("is of version {}", description.version),
            Err(error) => error,
        };
        Some(format!("{name}: {found}"))
    });
    let wrong: Vec<String> = wrong.collect();
    if wrong.is_empty() {
        return Finding::ok(check, format!("{} of version {}", operators.iter().count(), env!("CARGO_PKG_VERSION")));
    }
    Finding::failure(check, wrong.join("; "), "install blindgrasp again: its program was replaced or removed")
}

fn cores(n_cores: usize) -> Finding {
    let check = "processor";
    let found = format!("{n_cores} cores for this process");
    if n_cores < 2 {
        return Finding::warning(
            check,
            found,
            "the operators take turns on one core: expect latencies of milliseconds",
        );
    }
    Finding::ok(check, found)
}

fn clock(source: &str, cost: Duration) -> Finding {
    let check = "clock";
    let found =
        format!("{}, {} ns to read", if source.is_empty() { "source unknown" } else { source }, cost.as_nanos());
    let is_slow = cost > Duration::from_micros(1) && !FAST_CLOCK_SOURCES.contains(&source);
    if is_slow {
        let advice = "each sample's times are read several times: choose tsc, if the machine has it \
                      (/sys/devices/system/clocksource/clocksource0/available_clocksource)";
        return Finding::warning(check, found, advice);
    }
    Finding::ok(check, found)
}

fn clock_cost() -> Duration {
    const N_READS: u32 = 1000;
    let start = Instant::now();
    (0..N_READS).for_each(|_| {
        std::hint::black_box(monotonic_nanos());
    });
    start.elapsed() / N_READS
}

/// The lateness of a thread at the normal policy and of one at SCHED_FIFO.
fn wake_ups((normal, fifo): (Option<WakeUps>, Option<WakeUps>)) -> [Finding; 2] {
    let normal = match normal {
        Some(measured) if measured.idle.p99_us > LATE_WAKE_US => {
            let advice = "something else keeps the cores busy: `run` with a recording may need a larger max_age_ms of the \
                          lift_arbiter, a robot a quieter machine";
            Finding { verdict: Fitness::Warning, ..real_time::wake_ups(NORMAL, normal, "").with_advice(advice) }
        }
        _ => real_time::wake_ups(
            NORMAL,
            normal,
            "other programs delay a graph: give the nodes of a robot 'scheduling: {policy: fifo, priority: 80}' in the dataflow \
             file",
        ),
    };
    let at_fifo =
        "not even real-time scheduling helps: a kernel with PREEMPT_RT and cores of their own for its nodes do";
    [normal, real_time::wake_ups("SCHED_FIFO", fifo, at_fifo)]
}

fn sandbox(found: Enforcement) -> Finding {
    let check = "sandbox";
    let advice = "nodes with 'sandbox: on' run with fewer restrictions, those with 'sandbox: required' do not run: use Linux \
                  6.12 or newer with landlock among its security modules (lsm= of the kernel's command line)";
    match found {
        Enforcement::Full => Finding::ok(check, "Landlock"),
        Enforcement::Partial => Finding::warning(check, "Landlock of a kernel older than Linux 6.12", advice),
        Enforcement::None => Finding::warning(check, "no Landlock in this kernel", advice),
    }
}

fn files(limit: Option<u64>) -> Finding {
    let check = "open files";
    match limit {
        Some(limit) if limit < ENOUGH_FILES => {
            Finding::warning(check, format!("at most {limit} a process"), format!("ulimit -Hn {ENOUGH_FILES} or more"))
        }
        Some(limit) => Finding::ok(check, format!("at most {limit} a process")),
        None => Finding::ok(check, "no limit"),
    }
}

fn serial_devices() -> Vec<Finding> {
    let Ok(entries) = std::fs::read_dir("/dev") else {
        return Vec::new();
    };
    let names = entries.flatten().filter_map(|entry| entry.file_name().to_str().map(str::to_string));
    let mut names: Vec<String> =
        names.filter(|name| name.starts_with("ttyUSB") || name.starts_with("ttyACM")).collect();
    names.sort();
    let accessible = |name: String| {
        let path = format!("/dev/{name}");
        let access = rustix::fs::access(&path, rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK);
        match access {
            Ok(()) => Finding::ok("serial device", format!("{path} can be opened")),
            Err(error) => Finding::warning(
                "serial device",
                format!("{path}: {error}"),
                "a hand on it cannot be read: add this user to the device's group (dialout, mostly) and log in again",
            ),
        }
    };
    names.into_iter().map(accessible).collect()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(path).unwrap_or_default().trim().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_poor_is_said_with_what_to_do() {
        let verdict = |finding: Finding| {
            assert_eq!(finding.verdict == Fitness::Ok, finding.advice.is_none(), "{finding:?}");
            finding.verdict
        };
        assert_eq!((verdict(cores(1)), verdict(cores(2))), (Fitness::Warning, Fitness::Ok));
        let slow = Duration::from_micros(3);
        assert_eq!(verdict(clock("hpet", slow)), Fitness::Warning);
        // On a busy machine a read takes long whatever the source is.
        assert_eq!(verdict(clock("tsc", slow)), Fitness::Ok);
        assert_eq!(verdict(clock("", Duration::from_nanos(40))), Fitness::Ok);
        assert_eq!((verdict(files(Some(256))), verdict(files(None))), (Fitness::Warning, Fitness::Ok));
        assert_eq!(verdict(sandbox(Enforcement::Full)), Fitness::Ok);
        assert_eq!(verdict(sandbox(Enforcement::None)), Fitness::Warning);
    }

    #[test]
    fn a_machine_that_is_late_while_idle_is_too_busy() {
        let late = |p99_us| Lateness { n_wake_ups: 1000, p50_us: 55, p99_us, p999_us: 9000, worst_us: 9000 };
        let found = |idle_p99_us| {
            let measured = WakeUps { idle: late(idle_p99_us), under_load: late(9000) };
            wake_ups((Some(measured), None)).map(|finding| (finding.verdict, finding.advice.unwrap_or_default()))
        };
        let [(verdict, advice), (fifo_verdict, _)] = found(LATE_WAKE_US);
        assert_eq!((verdict, fifo_verdict), (Fitness::Ok, Fitness::Ok));
        assert!(advice.contains("policy: fifo"), "{advice}");
        let [(verdict, advice), _] = found(LATE_WAKE_US + 1);
        assert_eq!(verdict, Fitness::Warning);
        assert!(advice.contains("a quieter machine"), "{advice}");
    }

    #[test]
    fn this_machine_is_looked_at_without_leaving_anything() {
        let findings = examine(Measurement::Skipped, &Operators::default());
        let checks: Vec<&str> = findings.iter().map(|finding| finding.check.as_str()).collect();
        for check in
            ["shared memory", "leftovers of dead graphs", "clock", "processor", "real-time kernel", "locked memory"]
        {
            assert!(checks.contains(&check), "{checks:?}");
        }
        let probe = format!(".blindgrasp-doctor-{}", std::process::id());
        assert!(!Path::new(SHARED_MEMORY_FOLDER).join(&probe).exists());
    }
}
