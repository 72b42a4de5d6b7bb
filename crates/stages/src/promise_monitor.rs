//! Watches whether lifts drop their objects more often than was promised.
//!
//! The evidence is a mixture of Shiryaev-Roberts statistics. After each lift R becomes (1 + R) q / p for a drop and (1 + R) (1 -
//! q) / (1 - p) for an object that was kept. Here p is the promised share and q a greater one. While no lift drops with a
//! greater probability than p, whatever came before it, the expectation of R after n lifts is at most n. So the mean number of
//! lifts until the promise is withdrawn wrongly is at least `WITHDRAWN_FROM`. Good lifts of the past do not make up for drops,
//! because the sum allows for a change at each lift (Pollak, "Optimal detection of a change in distribution", 1985).
//!
//! [`PromiseMonitor::drops_at_most`] is the promise that the outcomes themselves allow.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The evidence from which the promise is withdrawn: the least mean number of lifts between two false alarms.
const WITHDRAWN_FROM: f64 = 1000.0;
/// The evidence from which the promise is in doubt, which changes no decision.
const DOUBTED_FROM: f64 = 100.0;
/// The promise is also in doubt if so many drops or more have at most this probability under it, and two lifts dropped: the lower
/// bound of the share of drops, with a confidence of 90 % at one look, is above the promise then.
const DOUBTED_BELOW: f64 = 0.1;
/// The shares of drops that are looked for, as parts of the way from the promised share to 1.
const WAYS: [f64; 6] = [0.02, 0.05, 0.1, 0.2, 0.4, 0.8];

/// The outcomes of lifts, and the evidence against the promise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PromiseMonitor {
    pub n_kept: u64,
    pub n_dropped: u64,
    /// Those since the hand's readings changed: the ones before are evidence against the promise, and say nothing for it.
    since_change: LiftGroups,
    evidence: [f64; WAYS.len()],
    is_doubted: bool,
    is_withdrawn: bool,
}

/// Outcomes in groups of as many consecutive lifts as an object may have. Lifts of one object end alike, so each group counts once,
/// with the share of its lifts that dropped the object. Two neighbours may have lifts of one object, and every second group has
/// none in common with the one before: those are two sequences.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct LiftGroups {
    n_kept: u64,
    n_dropped: u64,
    /// Lifts and drops of the group that is not full.
    open: [u32; 2],
    n_full: u64,
    /// The number of full groups of each sequence by the number of their drops.
    full: [BTreeMap<u32, u64>; 2],
}

impl LiftGroups {
    fn observe(&mut self, is_dropped: bool, lifts_per_object: u32) {
        *(if is_dropped { &mut self.n_dropped } else { &mut self.n_kept }) += 1;
        let [n_lifts, n_dropped] = &mut self.open;
        *n_lifts += 1;
        *n_dropped += u32::from(is_dropped);
        if *n_lifts >= lifts_per_object {
            // Groups of one lift have nothing in common.
            let sequence = if lifts_per_object == 1 { 0 } else { self.n_full as usize % 2 };
            *self.full[sequence].entry(*n_dropped).or_default() += 1;
            self.n_full += 1;
            self.open = [0, 0];
        }
    }

    /// For each sequence, the drops of each full group as a share, and the number of such groups.
    fn sequences(&self, lifts_per_object: u32) -> Vec<Vec<(f64, u64)>> {
        let mut sequences = Vec::new();
        for full in &self.full[..if lifts_per_object == 1 { 1 } else { 2 }] {
            let share = |n_dropped: u32| f64::from(n_dropped) / f64::from(lifts_per_object);
            sequences.push(full.iter().map(|(n_dropped, n)| (share(*n_dropped), *n)).collect());
        }
        sequences
    }
}

impl PromiseMonitor {
    /// Takes the outcome of a lift, of at most `lifts_per_object` in a row of one object. From a promise of 1 on nothing is
    /// promised, and a promise of 0 is withdrawn by one drop.
    pub fn observe(&mut self, is_dropped: bool, promised_drops: f64, lifts_per_object: u32) {
        *(if is_dropped { &mut self.n_dropped } else { &mut self.n_kept }) += 1;
        self.since_change.observe(is_dropped, lifts_per_object);
        if promised_drops >= 1.0 {
            return;
        }
        for (way, evidence) in WAYS.iter().zip(&mut self.evidence) {
            let suspected = promised_drops + way * (1.0 - promised_drops);
            let ratio =
                if is_dropped { suspected / promised_drops } else { (1.0 - suspected) / (1.0 - promised_drops) };
            *evidence = (1.0 + *evidence) * ratio;
        }
        let evidence = self.evidence.iter().sum::<f64>() / WAYS.len() as f64;
        self.is_withdrawn |= evidence >= WITHDRAWN_FROM;
        let probability = probability_of_drops(self.n_dropped, self.n_kept + self.n_dropped, promised_drops);
        self.is_doubted |= evidence >= DOUBTED_FROM || (self.n_dropped > 1 && probability <= DOUBTED_BELOW);
    }

    /// Forgets outcomes that speak for the promise, because the hand's readings have changed. The evidence against it stays, so that
    /// frequent changes hide no drops.
    pub fn begin_anew(&mut self) {
        self.since_change = LiftGroups::default();
    }

    /// The outcomes since the readings changed, kept and dropped.
    pub fn since_change(&self) -> [u64; 2] {
        [self.since_change.n_kept, self.since_change.n_dropped]
    }

    /// The largest share of the lifts that may drop, given the outcomes since the readings changed, as [`drops_at_most`]. No object
    /// is lifted more than `lifts_per_object` times in a row, the number that [`PromiseMonitor::observe`] was given.
    pub fn drops_at_most(&self, lifts_per_object: u32) -> f64 {
        let sequences = self.since_change.sequences(lifts_per_object);
        let bounds = sequences.iter().map(|groups| bound_of(groups, sequences.len()));
        bounds.fold(1.0, f64::min)
    }

    /// Whether the outcomes have once spoken against the promise: a warning.
    pub fn is_doubted(&self) -> bool {
        self.is_doubted
    }

    /// Whether outcomes have refuted the promise. It stays withdrawn.
    pub fn is_withdrawn(&self) -> bool {
        self.is_withdrawn
    }
}

/// The probability that so many of the lifts drop, or more, if each does with the probability `share`; at least 0.5 if that is no
/// more than expected.
fn probability_of_drops(n_dropped: u64, n_lifts: u64, share: f64) -> f64 {
    let (dropped, lifts) = (n_dropped as f64, n_lifts as f64);
    if dropped <= share * lifts {
        return 0.5;
    }
    if share == 0.0 {
        return 0.0;
    }
    let log_ways = libm::lgamma(lifts + 1.0) - libm::lgamma(dropped + 1.0) - libm::lgamma(lifts - dropped + 1.0);
    let mut term = libm::exp(log_ways + dropped * libm::log(share) + (lifts - dropped) * libm::log(1.0 - share));
    let (mut sum, mut drops) = (0.0, dropped);
    // Above the expected number the terms fall, so the rest is soon negligible.
    while term > 1e-9 * sum {
        sum += term;
        term *= (lifts - drops) / (drops + 1.0) * share / (1.0 - share);
        drops += 1.0;
    }
    sum
}

/// The counts of an arbiter's node under the present promise: [`PromiseMonitor::since_change`], the bound of
/// [`PromiseMonitor::drops_at_most`] in millionths, and its `lifts_per_object`.
pub const OUTCOME_COUNTS: [&str; 4] =
    ["promise/kept", "promise/dropped", "promise/drops_at_most_ppm", "promise/lifts_per_object"];

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
/// that was kept by (1 - w m) / (1 - m), and a group of lifts by the mean of these. While lifts drop with a probability of m or
/// more, the capital of all together is expected to grow by nothing, so it is seldom ever 20 times as large (Ville's inequality).
/// Shares where it is are ruled out.
pub fn drops_at_most(n_kept: u64, n_dropped: u64) -> f64 {
    bound_of(&[(0.0, n_kept), (1.0, n_dropped)], 1)
}

/// The bound of [`drops_at_most`] for groups of lifts: the share of drops in a group, and the number of such groups. They are one of
/// `n_sequences`, each of which may be wrong with an equal part of the probability.
fn bound_of(groups: &[(f64, u64)], n_sequences: usize) -> f64 {
    let n: u64 = groups.iter().map(|(_, n)| n).sum();
    if n == 0 {
        return 1.0;
    }
    let n_dropped: f64 = groups.iter().map(|(drops, n)| drops * *n as f64).sum();
    let (mut possible, mut ruled_out) = (n_dropped / n as f64, 1.0);
    for _ in 0..50 {
        let middle = f64::midpoint(possible, ruled_out);
        if middle < 1.0 && is_ruled_out(middle, groups, n_sequences) { ruled_out = middle } else { possible = middle }
    }
    ruled_out
}

/// Whether the groups of lifts rule out that this share of the lifts drops.
fn is_ruled_out(share: f64, groups: &[(f64, u64)], n_sequences: usize) -> bool {
    let mut capital = 0.0;
    for part in PARTS {
        let of_kept = (1.0 - part * share) / (1.0 - share);
        let mut log_capital = 0.0;
        for (drops, n) in groups {
            if *n > 0 {
                log_capital += *n as f64 * libm::log((1.0 - drops) * of_kept + drops * part);
            }
        }
        capital += libm::exp(log_capital);
    }
    capital >= (PARTS.len() * n_sequences) as f64 / (1.0 - CONFIDENCE)
}

#[cfg(test)]
mod tests {
    use std::ops::RangeInclusive;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The number of lifts until the promise is withdrawn, at most `most`.
    fn n_lifts(random: &mut ChaCha8Rng, n_good: usize, drops: f64, promised: f64, most: usize) -> usize {
        let mut monitor = PromiseMonitor::default();
        (0..n_good).for_each(|_| monitor.observe(false, promised, 1));
        (0..most)
            .find(|_| {
                monitor.observe(random.random::<f64>() < drops, promised, 1);
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
        monitor.observe(true, 0.5, 1);
        monitor.observe(false, 0.5, 1);
        // The fifth way looks for a share of 0.7.
        assert!((monitor.evidence[4] - (1.0 + 1.4) * 0.6).abs() < 1e-12, "{monitor:?}");
        assert_eq!((monitor.n_kept, monitor.n_dropped, monitor.is_withdrawn()), (1, 1, false));
        monitor.observe(true, 0.0, 1);
        assert!(monitor.is_withdrawn(), "no drop was promised");
        let mut nothing = PromiseMonitor::default();
        (0..1000).for_each(|_| nothing.observe(true, 1.0, 1));
        assert!(!nothing.is_withdrawn());
    }

    #[test]
    fn a_doubt_comes_before_the_promise_is_withdrawn() {
        let mut monitor = PromiseMonitor::default();
        let mut seen = Vec::new();
        while !monitor.is_withdrawn() {
            monitor.observe(true, 0.1, 1);
            seen.push((monitor.is_doubted(), monitor.is_withdrawn()));
        }
        assert_eq!(seen, [(false, false), (true, false), (true, false), (true, false), (true, true)]);
    }

    #[test]
    fn a_lower_bound_above_the_promise_is_a_doubt() {
        // The chance of 2 of 5 or more at a share of 0.1 is 0.0815, of 1 or more 0.41.
        assert!((probability_of_drops(2, 5, 0.1) - 0.081_46).abs() < 1e-9);
        assert!((probability_of_drops(1, 5, 0.1) - 0.409_51).abs() < 1e-9);
        assert_eq!((probability_of_drops(1, 10, 0.1), probability_of_drops(1, 10, 0.0)), (0.5, 0.0));
        assert!((0.0..1e-9).contains(&probability_of_drops(200_000, 1_000_000, 0.1)));
        let mut monitor = PromiseMonitor::default();
        for is_dropped in [true, false, false, false, true] {
            assert!(!monitor.is_doubted());
            monitor.observe(is_dropped, 0.1, 1);
        }
        assert!(monitor.is_doubted() && !monitor.is_withdrawn(), "{monitor:?}");
        // It is said once.
        (0..50).for_each(|_| monitor.observe(false, 0.1, 1));
        assert!(monitor.is_doubted());
    }

    /// The number of robots, of `n_robots`, whose bound was ever below the true share of drops within 1,000 lifts. Each object is
    /// lifted as often in a row as `in_a_row` says, the first one perhaps less often, and each of its lifts drops it or none does.
    fn n_broken(
        random: &mut ChaCha8Rng,
        share: f64,
        in_a_row: RangeInclusive<u32>,
        lifts_per_object: u32,
        n_robots: u32,
    ) -> u32 {
        let mut n_broken = 0;
        for _ in 0..n_robots {
            let mut groups = LiftGroups::default();
            let mut is_bad = random.random::<f64>() < share;
            let mut n_left = random.random_range(1..=*in_a_row.end());
            let mut is_broken = false;
            for _ in 0..1000 {
                if n_left == 0 {
                    is_bad = random.random::<f64>() < share;
                    n_left = random.random_range(in_a_row.clone());
                }
                n_left -= 1;
                groups.observe(is_bad, lifts_per_object);
                if groups.open == [0, 0] {
                    let sequences = groups.sequences(lifts_per_object);
                    is_broken |= sequences.iter().any(|groups| is_ruled_out(share, groups, sequences.len()));
                }
            }
            n_broken += u32::from(is_broken);
        }
        n_broken
    }

    #[test]
    fn the_bound_after_every_lift_holds_for_95_of_100_robots() {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        for (in_a_row, lifts_per_object) in [(1..=1, 1), (1..=1, 5), (2..=2, 2), (5..=5, 5), (3..=5, 5), (10..=10, 10)]
        {
            let mut n_all_broken = 0;
            for (share, n_robots) in [(0.02, 400), (0.1, 400), (0.5, 200)] {
                n_all_broken += n_broken(&mut random, share, in_a_row.clone(), lifts_per_object, n_robots);
            }
            assert!(n_all_broken <= 50, "{n_all_broken} of 1000 robots, {in_a_row:?} lifts in a row");
        }
        // As lifts of other objects, five in a row of each would promise too much.
        assert!(n_broken(&mut random, 0.1, 5..=5, 1, 100) > 20);
    }

    #[test]
    fn lifts_of_an_object_count_once() {
        let mut monitor = PromiseMonitor::default();
        assert_eq!(monitor.drops_at_most(5), 1.0);
        // 100 objects that are kept five times, and then two that drop once of five times.
        (0..500).for_each(|_| monitor.observe(false, 0.1, 5));
        let of_two = |n_kept, n_dropped| bound_of(&[(0.0, n_kept), (1.0, n_dropped)], 2);
        assert!((monitor.drops_at_most(5) - of_two(50, 0)).abs() < 1e-9);
        (0..10).for_each(|nth| monitor.observe(nth % 5 == 0, 0.1, 5));
        let bound = monitor.drops_at_most(5);
        assert!(of_two(51, 0) < bound && bound < of_two(50, 1), "{bound}");
        // The lifts of a group that is not full are counted, and say nothing yet.
        monitor.observe(true, 0.1, 5);
        assert_eq!((monitor.since_change(), monitor.drops_at_most(5)), ([508, 3], bound));
        monitor.begin_anew();
        assert_eq!((monitor.since_change(), monitor.drops_at_most(5)), ([0, 0], 1.0));
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
