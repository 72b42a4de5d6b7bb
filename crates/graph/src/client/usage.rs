//! The processor time and memory of a process, from `/proc`.

use std::path::Path;

use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ProcessUsage {
    /// Processor time of all its threads, user and system.
    pub cpu_secs: f64,
    /// Memory that it holds now, including shared memory that it has touched.
    pub resident_bytes: u64,
}

/// The use of a process since its start, with that of its children, such as the program of a host; `None` if it does not exist.
pub fn usage(pid: u32) -> Option<ProcessUsage> {
    let mut sum = usage_of_one(pid)?;
    let children = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
    for child in children.split_whitespace().filter_map(|child| child.parse().ok()) {
        if let Some(own) = usage_of_one(child) {
            sum.cpu_secs += own.cpu_secs;
            sum.resident_bytes += own.resident_bytes;
        }
    }
    Some(sum)
}

fn usage_of_one(pid: u32) -> Option<ProcessUsage> {
    let stat = std::fs::read_to_string(Path::new("/proc").join(pid.to_string()).join("stat")).ok()?;
    parse_stat(&stat, rustix::param::clock_ticks_per_second(), rustix::param::page_size() as u64)
}

/// Fields 14, 15 (`utime`, `stime`) and 24 (`rss`) of proc_pid_stat(5).
fn parse_stat(stat: &str, ticks_per_sec: u64, page_bytes: u64) -> Option<ProcessUsage> {
    // The second field is the program's name in parentheses, which may itself hold blanks and parentheses.
    let (_, after_name) = stat.rsplit_once(')')?;
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
    let cpu_secs = (field(14)? + field(15)?) as f64 / ticks_per_sec as f64;
    Some(ProcessUsage { cpu_secs, resident_bytes: field(24)? * page_bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_blanks_and_parentheses_shifts_nothing() {
        let stat = "42 (a) S 9 (b) R 1 42 42 0 -1 4194304 900 0 0 0 150 25 7 8 20 0 5 0 1000 99999999 321 1844674407";
        let found = parse_stat(stat, 100, 4096);
        assert_eq!(found, Some(ProcessUsage { cpu_secs: 1.75, resident_bytes: 321 * 4096 }));
        assert_eq!(parse_stat("42 (short) R 1", 100, 4096), None);
    }

    #[test]
    fn this_process_holds_memory_and_no_process_has_the_greatest_number() {
        assert!(usage(std::process::id()).expect("running").resident_bytes > 0);
        assert_eq!(usage(u32::MAX), None);
    }
}
