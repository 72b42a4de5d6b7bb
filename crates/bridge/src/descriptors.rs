//! Whether this process runs out of descriptors.
//!
//! Where a stranger makes connections without a certificate until none is left, the library that accepts TLS connections
//! (tls-listener 0.11) looks at the new ones only, and never again at those that hold the descriptors: no machine comes in any
//! more, also when the stranger has long gone. A new process begins without them.

use std::time::Duration;

use rustix::process::{Resource, getrlimit};

/// The link ends after so long near the limit. A graph that starts or swaps needs many descriptors for a moment only.
const LONGEST: Duration = Duration::from_secs(10);
/// The pause between two looks: counting takes time.
pub(super) const LOOK_PAUSE: Duration = Duration::from_secs(1);

#[derive(Debug, Default)]
pub(super) struct DescriptorWatch {
    near_since: Option<Duration>,
}

impl DescriptorWatch {
    /// Takes the number of open descriptors, `None` if it cannot be told for want of one, and the limit; returns whether the
    /// process has been near it for too long. Times are since any moment.
    pub(super) fn is_out(&mut self, n_open: Option<u64>, limit: u64, now: Duration) -> bool {
        let is_near = n_open.is_none_or(|n_open| n_open >= limit - limit / 16);
        if !is_near {
            self.near_since = None;
            return false;
        }
        now.saturating_sub(*self.near_since.get_or_insert(now)) >= LONGEST
    }
}

/// The number of open descriptors of this process; `None` if no descriptor is left for counting them.
pub(super) fn n_open() -> Option<u64> {
    std::fs::read_dir("/proc/self/fd").ok().map(|entries| entries.count() as u64)
}

/// The most descriptors that this process may have.
pub(super) fn limit() -> u64 {
    getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_near_its_limit_for_long_is_out_of_descriptors() {
        let secs = Duration::from_secs;
        let mut watch = DescriptorWatch::default();
        assert!(!watch.is_out(Some(1023), 1024, secs(0)) && !watch.is_out(None, 1024, secs(9)));
        assert!(!watch.is_out(Some(500), 1024, secs(9)), "it has some again");
        assert!(!watch.is_out(Some(960), 1024, secs(10)) && watch.is_out(Some(961), 1024, secs(20)));
        assert!(!watch.is_out(Some(100_000), u64::MAX, secs(30)));
    }
}
