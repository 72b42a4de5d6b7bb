//! Watches whether lifts drop their objects more often than was promised.
//!
//! The evidence is a mixture of Shiryaev-Roberts statistics. After each lift R becomes (1 + R) q / p for a drop and (1 + R) (1 -
//! q) / (1 - p) for an object that was kept. Here p is the promised share and q a greater one. While no lift drops with a
//! greater probability than p, whatever came before it, the expectation of R after n lifts is at most n. So the mean number of
//! lifts until the promise is withdrawn wrongly is at least `WITHDRAWN_FROM`. Good lifts of the past do not make up for drops,
//! because the sum allows for a change at each lift (Pollak, "Optimal detection of a change in distribution", 1985).
//!
//! [`drops_at_most`] is the promise that the outcomes themselves allow.

use serde::{Deserialize, Serialize};

/// The evidence from which the promise is withdrawn: the least mean number of lifts between two false alarms.
const WITHDRAWN_FROM: f64 = 1000.0;
/// The evidence from which the promise is in doubt, which changes no decision.
const DOUBTED_FROM: f64 = 100.0;
/// The shares of drops that are looked for, as parts of the way from the promised share to 1.
const WAYS: [f64; 6] = [0.02, 0.05, 0.1, 0.2, 0.4, 0.8];

/// The outcomes of lifts, and the evidence against the promise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PromiseMonitor {
    pub n_kept: u64,
    pub n_dropped: u64,
    /// The outcomes before the hand's readings changed: they are evidence against the promise, and say nothing for it.
    n_before_change: [u64; 2],
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
        self.is_withdrawn |= self.mean_evidence() >= WITHDRAWN_FROM;
    }

    /// Forgets outcomes that speak for the promise, because the hand's readings have changed. The evidence against it stays, so that
    /// frequent changes hide no drops.
    pub fn begin_anew(&mut self) {
        self.n_before_change = [self.n_kept, self.n_dropped];
    }

    /// The outcomes since the readings changed, kept and dropped: the numbers that [`drops_at_most`] takes.
    pub fn since_change(&self) -> [u64; 2] {
        [self.n_kept - self.n_before_change[0], self.n_dropped - self.n_before_change[1]]
    }

    fn mean_evidence(&self) -> f64 {
        self.evidence.iter().sum::<f64>() / WAYS.len() as f64
    }

    /// Whether the outcomes speak against the promise, and do not refute it yet: a warning.
    pub fn is_doubted(&self) -> bool {
        self.is_withdrawn || self.mean_evidence() >= DOUBTED_FROM
    }

    /// Whether outcomes have refuted the promise. It stays withdrawn.
    pub fn is_withdrawn(&self) -> bool {
        self.is_withdrawn
    }
}

/// The counts of an arbiter's node under the present promise: [`PromiseMonitor::since_change`].
pub const OUTCOME_COUNTS: [&str; 2] = ["promise/kept", "promise/dropped"];

/// The confidence of [`drops_at_most`].
pub const CONFIDENCE: f64 = 0.95;
/// The bets of [`drops_at_most`]: on these parts of the share that is tested.
const PARTS: [f64; 6] = [0.0, 0.2, 0.35, 0.5, 0.65, 0.8];

/// The largest share of the lifts that may drop, given how so many of them ended. With a probability of [`CONFIDENCE`] it is at
/// least the true share after every lift, so it may be looked at whenever one likes. Lifts are taken for draws of the same
/// mixture of objects.
///
/// It is a confidence sequence by betting (Waudby-Smith and Ramdas, "Estimating means of bounded random variables by betting",
/// 2024). For a share m, six bets start with equal capital, each on a part w of m. A drop multiplies its capital by w, an object
/// that was kept by (1 - w m) / (1 - m). While lifts drop with a probability of m or more, the capital of all together is
/// expected to grow by nothing, so it is seldom ever 20 times as large (Ville's inequality). Shares where it is are ruled out.
pub fn drops_at_most(n_kept: u64, n_dropped: u64) -> f64 {
    let n = n_kept + n_dropped;
    if n == 0 {
        return 1.0;
    }
    let is_ruled_out = |share: f64| {
        let bets = PARTS.iter().map(|part| {
            let of_drops = if n_dropped == 0 { 0.0 } else { n_dropped as f64 * libm::log(*part) };
            libm::exp(of_drops + n_kept as f64 * libm::log((1.0 - part * share) / (1.0 - share)))
        });
        bets.sum::<f64>() >= PARTS.len() as f64 / (1.0 - CONFIDENCE)
    };
    let (mut possible, mut ruled_out) = (n_dropped as f64 / n as f64, 1.0);
    for _ in 0..50 {
        let middle = f64::midpoint(possible, ruled_out);
        if middle < 1.0 && is_ruled_out(middle) { ruled_out = middle } else { possible = middle }
    }
    ruled_out
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

    #[test]
    fn a_doubt_comes_before_the_promise_is_withdrawn() {
        let mut monitor = PromiseMonitor::default();
        let mut seen = Vec::new();
        while !monitor.is_withdrawn() {
            monitor.observe(true, 0.1);
            seen.push((monitor.is_doubted(), monitor.is_withdrawn()));
        }
        assert_eq!(seen, [(false, false), (false, false), (true, false), (true, false), (true, true)]);
    }

    #[test]
    fn the_bound_after_every_lift_holds_in_95_of_100_runs() {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        for (share, n_runs) in [(0.02, 400), (0.1, 400), (0.5, 200)] {
            let mut n_broken = 0;
            for _ in 0..n_runs {
                let (mut n_kept, mut n_dropped) = (0, 0);
                // Each of 1,000 looks may find a bound that is too low.
                let is_broken = (0..1000).any(|_| {
                    *(if random.random::<f64>() < share { &mut n_dropped } else { &mut n_kept }) += 1;
                    drops_at_most(n_kept, n_dropped) < share
                });
                n_broken += i32::from(is_broken);
            }
            assert!(n_broken * 20 <= n_runs, "{n_broken} of {n_runs} runs at a share of {share}");
        }
    }

    #[test]
    fn the_bound_of_some_counts() {
        for (n_kept, n_dropped, expected) in
            [(0, 0, 1.0), (20, 0, 0.185), (100, 0, 0.041), (98, 2, 0.085), (294, 6, 0.051), (0, 30, 1.0)]
        {
            let found = drops_at_most(n_kept, n_dropped);
            assert!((found - expected).abs() < 6e-4, "{n_kept} kept, {n_dropped} dropped: {found}");
        }
    }
}
