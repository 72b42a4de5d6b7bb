//! The options of a node's processes: their way to wait, and their demands on the kernel.

use std::fmt;

use serde::Serialize;

use crate::dataflow::diagnostic::Diagnostics;
use crate::dataflow::form::{accept, accept_integer, entries_or_nothing, unknown_key};
use crate::dataflow::node::one_of;
use crate::dataflow::yaml::{Content, Entry, Value};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::text::quote;
use blindgrasp_operator::wiring::WaitMode;

pub(super) const PROCESS_KEYS: [&str; 6] = ["group", "wait", "scheduling", "cpus", "lock_memory", "nice"];
pub(super) const SCHEDULING_KEYS: [&str; 2] = ["policy", "priority"];
pub(super) const MAX_POLL_MICROS: i64 = 1_000_000;
/// Linux numbers at most so many CPUs.
pub(super) const MAX_CPUS: i64 = 8192;

/// The options of a node's processes. The default asks the kernel for nothing.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ProcessOptions {
    /// Nodes of the same group share a process.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    #[serde(skip_serializing_if = "is_default")]
    pub wait: WaitMode,
    /// `None`: the kernel's normal scheduling.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheduling: Option<Scheduling>,
    /// The CPUs that they may run on; all if it is empty.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cpus: Vec<usize>,
    /// Their memory stays in RAM.
    #[serde(skip_serializing_if = "is_default")]
    pub lock_memory: bool,
    /// -20 to 19.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nice: Option<i32>,
}

/// A real-time policy of the kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Scheduling {
    pub policy: SchedulingPolicy,
    /// 1 to 99; the kernel's own threads often have 50.
    pub priority: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SchedulingPolicy {
    /// It runs until it waits.
    Fifo,
    /// It takes turns with others of its priority.
    RoundRobin,
}

impl fmt::Display for SchedulingPolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            SchedulingPolicy::Fifo => "fifo",
            SchedulingPolicy::RoundRobin => "round_robin",
        })
    }
}

impl ProcessOptions {
    /// Whether the kernel refuses them to a process without rights.
    pub fn needs_rights(&self) -> bool {
        self.scheduling.is_some() || self.nice.is_some_and(|nice| nice < 0)
    }
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Reads one of [`PROCESS_KEYS`]. A value that is not accepted leaves the default.
pub(super) fn read_option(options: &mut ProcessOptions, key: &str, value: Value, what: &str, found: &mut Diagnostics) {
    match key {
        "group" => {
            let text = accept(&value, &ParamKind::String {}, what, None, found);
            options.group = text.and_then(|text| text.as_str().map(str::to_owned));
        }
        "wait" => options.wait = read_wait(value, what, found).unwrap_or_default(),
        "scheduling" => options.scheduling = read_scheduling(value, what, found),
        "cpus" => options.cpus = read_cpus(value, what, found).unwrap_or_default(),
        "lock_memory" => {
            let accepted = accept(&value, &ParamKind::Boolean {}, what, None, found);
            options.lock_memory = accepted.and_then(|is_locked| is_locked.as_bool()).unwrap_or_default();
        }
        _ => options.nice = accept_integer(&value, [-20, 19], what, None, found),
    }
}

/// `event`, `poll` or `{poll_us: N}`.
fn read_wait(value: Value, what: &str, found: &mut Diagnostics) -> Option<WaitMode> {
    let Content::Mapping(entries) = value.content else {
        let help = "or {poll_us: N}, which looks for samples for N microseconds and then sleeps";
        return one_of(&[WaitMode::Event, WaitMode::Poll], &value, what, Some(help), found);
    };
    let mut wait = None;
    for Entry { key, value } in entries {
        if key.text == "poll_us" {
            let micros = accept_integer(&value, [1, MAX_POLL_MICROS], &format!("'poll_us' of {what}"), None, found);
            wait = micros.map(WaitMode::PollMicros);
        } else {
            unknown_key(&key, &format!(" in {what}"), &["poll_us"], found);
        }
    }
    wait
}

fn read_scheduling(value: Value, what: &str, found: &mut Diagnostics) -> Option<Scheduling> {
    let at = value.at;
    let (mut policy, mut priority) = (None, None);
    let n_before = found.len();
    for Entry { key, value } in entries_or_nothing(value, what, found)? {
        let of_what = format!("{} of {what}", quote(&key.text));
        match key.text.as_str() {
            "policy" => {
                let policies = [SchedulingPolicy::Fifo, SchedulingPolicy::RoundRobin];
                policy = one_of(&policies, &value, &of_what, None, found);
            }
            "priority" => priority = accept_integer(&value, [1, 99], &of_what, None, found),
            _ => unknown_key(&key, &format!(" in {what}"), &SCHEDULING_KEYS, found),
        }
    }
    let scheduling = policy.zip(priority).map(|(policy, priority)| Scheduling { policy, priority });
    if scheduling.is_none() && found.len() == n_before {
        let help = Some("write {policy: fifo, priority: 60}".to_owned());
        found.push_with_help(at, format!("{what} needs a policy and a priority"), help);
    }
    scheduling
}

/// A list of numbers.
fn read_cpus(value: Value, what: &str, found: &mut Diagnostics) -> Option<Vec<usize>> {
    let Content::List(items) = value.content else {
        let message = format!("{what} must be a list of CPU numbers, found {}", value.found());
        found.push_with_help(value.at, message, Some("write [2, 3]".to_owned()));
        return None;
    };
    let mut cpus = Vec::new();
    for item in &items {
        cpus.extend(accept_integer::<usize>(item, [0, MAX_CPUS - 1], what, None, found));
    }
    Some(cpus)
}
