//! Watches whether lifts drop their objects more often than was promised.
//!
//! The evidence is a mixture of Shiryaev-Roberts statistics: after each lift R becomes (1 + R) q / p for a drop and
//! (1 + R) (1 - q) / (1 - p) for an object that was kept, where p is the promised share and q a greater one. While no lift drops
//! with a greater probability than p, whatever came before it, the expectation of R after n lifts is at most n. So the mean
//! number of lifts until the promise is withdrawn wrongly is at least `WITHDRAWN_FROM`. Good lifts of the past do not make up
//! for drops, because the sum allows for a change at each lift (Pollak, "Optimal detection of a change in distribution", 1985).

use serde::{Deserialize, Serialize};

/// The evidence from which the promise is withdrawn: the least mean number of lifts between two false alarms.
const WITHDRAWN_FROM: f64 = 1000.0;
/// The shares of drops that are looked for, as parts of the way from the promised share to 1.
const WAYS: [f64; 6] = [0.02, 0.05, 0.1, 0.2, 0.4, 0.8];

/// The outcomes of lifts, and the evidence against the promise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PromiseMonitor {
    pub n_kept: u64,
    pub n_dropped: u64,
    evidence: [f64; WAYS.len()],
    is_withdrawn: bool,
}

impl PromiseMonitor {
    /// Takes the outcome of a lift. From a promise of 1 on nothing is promised, and a promise of 0 is withdrawn by one drop.
    pub fn observe(&mut self, is_dropped: bool, promised_drops: f64) {
        *(if is_dropped { &mut self.n_dropped } else { &mut self.n_kept }) += 1;
        if promised_drops >= 1.0 {
            return;
        }
        for (way, evidence) in WAYS.iter().zip(&mut self.evidence) {
            let suspected = promised_drops + way * (1.0 - promised_drops);
            let ratio =
                if is_dropped { suspected / promised_drops } else { (1.0 - suspected) / (1.0 - promised_drops) };
            *evidence = (1.0 + *evidence) * ratio;
        }
        self.is_withdrawn |= self.evidence.iter().sum::<f64>() >= WITHDRAWN_FROM * WAYS.len() as f64;
    }

    /// Whether outcomes have refuted the promise. It stays withdrawn.
    pub fn is_withdrawn(&self) -> bool {
        self.is_withdrawn
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The number of lifts until the promise is withdrawn, at most `most`.
    fn n_lifts(random: &mut ChaCha8Rng, n_good: usize, drops: f64, promised: f64, most: usize) -> usize {
        let mut monitor = PromiseMonitor::default();
        (0..n_good).for_each(|_| monitor.observe(false, promised));
        (0..most)
            .find(|_| {
                monitor.observe(random.random::<f64>() < drops, promised);
                monitor.is_withdrawn()
            })
            .map_or(most, |n| n + 1)
    }

    fn mean(seed: u64, n_good: usize, drops: f64, promised: f64, most: usize) -> f64 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let n_runs = 200;
        (0..n_runs).map(|_| n_lifts(&mut random, n_good, drops, promised, most) as f64).sum::<f64>() / f64::from(n_runs)
    }

    #[test]
    fn a_promise_that_is_kept_is_withdrawn_once_in_a_thousand_lifts_at_most() {
        for promised in [0.01, 0.07, 0.3] {
            // Runs that are cut off make the mean smaller.
            assert!(mean(1, 0, promised, promised, 20_000) > 1000.0, "{promised}");
            assert!(mean(2, 0, promised / 2.0, promised, 20_000) > 5000.0, "{promised}");
        }
    }

    #[test]
    fn a_promise_that_is_broken_is_withdrawn_whatever_was_kept_before() {
        for n_good in [0, 1000] {
            assert!(mean(3, n_good, 0.3, 0.07, 1000) < 40.0, "{n_good}");
            assert!(mean(4, n_good, 1.0, 0.07, 1000) <= 4.0, "{n_good}");
        }
    }

    #[test]
    fn the_evidence_by_hand() {
        let mut monitor = PromiseMonitor::default();
        monitor.observe(true, 0.5);
        monitor.observe(false, 0.5);
        // The fifth way looks for a share of 0.7.
        assert!((monitor.evidence[4] - (1.0 + 1.4) * 0.6).abs() < 1e-12, "{monitor:?}");
        assert_eq!((monitor.n_kept, monitor.n_dropped, monitor.is_withdrawn()), (1, 1, false));
        monitor.observe(true, 0.0);
        assert!(monitor.is_withdrawn(), "no drop was promised");
        let mut nothing = PromiseMonitor::default();
        (0..1000).for_each(|_| nothing.observe(true, 1.0));
        assert!(!nothing.is_withdrawn());
    }
}
