//! Whether a process of the network runs out of descriptors.
//!
//! Where a stranger makes connections without a certificate until none is left, the library that accepts TLS connections
//! (tls-listener 0.11) looks at the new ones only, and never again at those that hold the descriptors. Nobody comes in any
//! more, also when the stranger has long gone. A new process begins without them.

use std::fs::File;
use std::time::{Duration, Instant};

use rustix::fs::Dir;
use rustix::process::{Resource, getrlimit};

/// The process ends after so long near the limit. A graph that starts or swaps needs many descriptors for a moment only, and a
/// flood that goes on must not cause five restarts a minute, after which a node is given up by default.
const LONGEST: Duration = Duration::from_secs(20);
/// The pause between two looks: counting takes time.
const LOOK_PAUSE: Duration = Duration::from_secs(1);

/// Counts the descriptors of this process.
pub(crate) struct DescriptorWatch {
    /// `/proc/self/fd`, opened at the start: later no descriptor may be left for it, and a sandbox denies it.
    folder: Dir,
    last_look: Option<Instant>,
    near_since: Option<Instant>,
}

impl DescriptorWatch {
    pub(crate) fn open() -> std::io::Result<DescriptorWatch> {
        let folder = Dir::new(File::open("/proc/self/fd")?)?;
        Ok(DescriptorWatch { folder, last_look: None, near_since: None })
    }

    /// Counts, once a second.
    ///
    /// # Errors
    /// This process has had no descriptors left for some time: the next one begins without the connections that hold them.
    pub(crate) fn look(&mut self, now: Instant) -> anyhow::Result<()> {
        if self.last_look.is_some_and(|last| now.saturating_duration_since(last) < LOOK_PAUSE) {
            return Ok(());
        }
        self.last_look = Some(now);
        let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
        let n_open = self.n_open();
        if self.is_out(n_open, limit, now) {
            anyhow::bail!(
                "nearly all {limit} descriptors have been in use for {} s, perhaps by connections of strangers: nobody else could \
                 connect any more; limit the connections per address in the firewall (docs/security.md)",
                LONGEST.as_secs()
            );
        }
        Ok(())
    }

    fn n_open(&mut self) -> u64 {
        self.folder.rewind();
        self.folder.by_ref().count() as u64
    }

    /// Whether the process has been near its limit for too long.
    fn is_out(&mut self, n_open: u64, limit: u64, now: Instant) -> bool {
        if n_open < limit - limit / 16 {
            self.near_since = None;
            return false;
        }
        now.saturating_duration_since(*self.near_since.get_or_insert(now)) >= LONGEST
    }
}

#[cfg(test)]
mod tests {
    use landlock::{ABI, AccessFs, Ruleset, RulesetAttr, RulesetStatus};

    use super::*;

    #[test]
    fn a_process_near_its_limit_for_long_is_out_of_descriptors() {
        let start = Instant::now();
        let secs = |secs| start + Duration::from_secs(secs);
        let mut watch = DescriptorWatch::open().expect("opened");
        assert!(!watch.is_out(1023, 1024, secs(0)) && !watch.is_out(1024, 1024, secs(19)));
        assert!(!watch.is_out(500, 1024, secs(19)), "it has some again");
        assert!(!watch.is_out(960, 1024, secs(20)) && watch.is_out(961, 1024, secs(40)));
        assert!(!watch.is_out(100_000, u64::MAX, secs(60)));
    }

    /// A `tactile_source` may read no files of /proc once it is ready.
    #[test]
    fn descriptors_are_counted_in_a_sandbox() {
        let sandboxed = std::thread::spawn(|| {
            let mut watch = DescriptorWatch::open().expect("opened");
            let files: Vec<File> = (0..50).map(|_| File::open("/dev/null").expect("opened")).collect();
            let ruleset = Ruleset::default().handle_access(AccessFs::from_read(ABI::V1)).expect("rights");
            let status = ruleset.create().and_then(|ruleset| ruleset.restrict_self()).expect("restricted");
            if status.ruleset != RulesetStatus::NotEnforced {
                std::fs::read_dir("/proc/self/fd").expect_err("denied");
            }
            let n_with_files = watch.n_open();
            assert!(n_with_files > files.len() as u64, "{n_with_files}");
            assert!(watch.look(Instant::now()).is_ok());
        });
        sandboxed.join().expect("no panic");
    }
}
