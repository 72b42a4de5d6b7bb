//! The ages of samples when a reader gets them, since their source published them: a histogram on the cursors.
//!
//! Each reader counts on the [cursors](crate::cursors) itself, so that tools can read the ages without disturbing it. There are
//! [`STEPS_PER_OCTAVE`] buckets to a doubling, at most 6.25 % wide, from [`UNIT_NANOS`] to half a minute; older samples count
//! in the last bucket.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};

/// The width of the narrowest buckets.
pub const UNIT_NANOS: u64 = 256;
pub const STEPS_PER_OCTAVE: usize = 16;
pub const N_BUCKETS: usize = 384;

/// A histogram of ages that one process writes and others read.
#[repr(C)]
pub struct AgeCounter {
    counts: [AtomicU64; N_BUCKETS],
}

/// A histogram of ages as a reader sees it: the upper bound in nanoseconds and the count of each bucket that is not empty,
/// the youngest first.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Ages {
    buckets: Vec<(u64, u64)>,
}

impl AgeCounter {
    /// Counts a sample. Only the node's active instance may.
    pub fn count(&self, age_nanos: u64) {
        let count = &self.counts[bucket_of(age_nanos)];
        count.store(count.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
    }

    pub fn read(&self) -> Ages {
        let counts =
            self.counts.iter().enumerate().map(|(idx, count)| (upper_nanos(idx), count.load(Ordering::Relaxed)));
        Ages { buckets: counts.filter(|(_, count)| *count > 0).collect() }
    }
}

impl Ages {
    pub fn n_samples(&self) -> u64 {
        self.buckets.iter().map(|(_, count)| count).sum()
    }

    /// The upper bound in nanoseconds and the count of each bucket that is not empty.
    pub fn buckets(&self) -> &[(u64, u64)] {
        &self.buckets
    }

    /// The samples that were counted since `earlier`.
    #[must_use]
    pub fn since(&self, earlier: &Ages) -> Ages {
        let counts = self.buckets.iter().map(|&(upper, count)| {
            let found = earlier.buckets.binary_search_by_key(&upper, |bucket| bucket.0);
            (upper, count.saturating_sub(found.map_or(0, |idx| earlier.buckets[idx].1)))
        });
        Ages { buckets: counts.filter(|(_, count)| *count > 0).collect() }
    }

    /// The quantile at `share`, 0 to 1, of the ages, in nanoseconds, at most 6.25 % too large; `None` without samples.
    pub fn quantile_nanos(&self, share: f64) -> Option<u64> {
        let rank = ((self.n_samples() as f64 * share).ceil() as u64).max(1);
        let mut n_below = 0;
        self.buckets.iter().find_map(|&(upper, count)| {
            n_below += count;
            (n_below >= rank).then_some(upper)
        })
    }
}

fn bucket_of(age_nanos: u64) -> usize {
    let units = age_nanos / UNIT_NANOS;
    if units < STEPS_PER_OCTAVE as u64 {
        return units as usize;
    }
    // The position of the highest bit gives the octave, the four bits after it the step.
    let octave = units.ilog2() as usize - 3;
    let step = (units >> (octave - 1)) as usize % STEPS_PER_OCTAVE;
    (octave * STEPS_PER_OCTAVE + step).min(N_BUCKETS - 1)
}

fn upper_nanos(bucket: usize) -> u64 {
    let (octave, step) = (bucket / STEPS_PER_OCTAVE, bucket % STEPS_PER_OCTAVE);
    let units = match octave {
        0 => step + 1,
        octave => (STEPS_PER_OCTAVE + step + 1) << (octave - 1),
    };
    units as u64 * UNIT_NANOS
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counter() -> AgeCounter {
        AgeCounter { counts: std::array::from_fn(|_| AtomicU64::new(0)) }
    }

    #[test]
    fn every_age_lies_below_its_buckets_bound_and_not_far() {
        assert_eq!((bucket_of(0), bucket_of(255), bucket_of(256), bucket_of(4095)), (0, 0, 1, 15));
        assert_eq!((bucket_of(4096), bucket_of(8191), bucket_of(8192)), (16, 31, 32));
        let mut age_nanos: u64 = 1;
        while age_nanos < 30_000_000_000 {
            let (bucket, upper) = (bucket_of(age_nanos), upper_nanos(bucket_of(age_nanos)));
            assert!(
                age_nanos < upper && upper <= age_nanos + (age_nanos / 16).max(UNIT_NANOS) + 1,
                "{age_nanos} {upper}"
            );
            assert!(bucket == 0 || upper_nanos(bucket - 1) <= age_nanos);
            age_nanos = age_nanos * 101 / 100 + 1;
        }
        assert_eq!(bucket_of(u64::MAX), N_BUCKETS - 1);
        assert!(upper_nanos(N_BUCKETS - 1) >= 30_000_000_000);
    }

    #[test]
    fn quantiles_of_what_came_since() {
        let counter = counter();
        assert_eq!(counter.read().quantile_nanos(0.5), None);
        (0..100).for_each(|_| counter.count(1_000));
        let first = counter.read();
        assert_eq!(
            (first.n_samples(), first.quantile_nanos(0.0), first.quantile_nanos(1.0)),
            (100, Some(1024), Some(1024))
        );
        (0..99).for_each(|_| counter.count(100_000));
        counter.count(1_000_000);
        let second = counter.read().since(&first);
        assert_eq!(second.n_samples(), 100);
        let near =
            |found: Option<u64>, nanos: u64| found.is_some_and(|found| found > nanos && found <= nanos + nanos / 16);
        assert!(near(second.quantile_nanos(0.5), 100_000) && near(second.quantile_nanos(0.99), 100_000));
        assert!(near(second.quantile_nanos(1.0), 1_000_000));
        assert_eq!(counter.read().quantile_nanos(0.5), Some(1024));
        let json = serde_json::to_string(&first).expect("JSON");
        assert_eq!(json, "[[1024,100]]");
        assert_eq!(serde_json::from_str::<Ages>(&json).expect("read"), first);
    }
}
