//! Upper bounds for the share of lifts that drop and of trials that end in a drop, for new objects.
//!
//! Grasps of one object succeed or fail together, so the object is the unit. Its loss is a number from 0 to 1, and the bound is
//! the smallest mean that a test at the level 1 - confidence rejects. That is the exact binomial test if each object's loss is 0
//! or 1, otherwise a test by betting (Waudby-Smith and Ramdas, "Estimating means of bounded random variables by betting", 2024).
//! The bounds hold for any number of objects, without a normal approximation. They need objects that are drawn like the new ones
//! and that had no part in training or in the choice of a threshold.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use blindgrasp_stages::training_summary::{Bounded, Promise};

pub const CONFIDENCE: f64 = 0.95;

/// The trials of one object, as shares of its trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectTrials {
    /// Trials that end with a lift.
    pub lifted: f64,
    /// Trials that end with a drop; at most `lifted`.
    pub dropped: f64,
}

/// The bound for new objects after lifts of so many, none of which dropped: the least that they can show.
pub fn least_bound(n_objects: usize) -> f64 {
    1.0 - (1.0 - CONFIDENCE).powf(1.0 / n_objects as f64)
}

/// The bounds for new objects; `None` if no object was lifted.
pub fn promise(objects: &[ObjectTrials]) -> Option<Promise> {
    let lifted: Vec<ObjectTrials> = objects.iter().copied().filter(|object| object.lifted > 0.0).collect();
    let sum = |of: fn(&ObjectTrials) -> f64| lifted.iter().map(of).sum::<f64>();
    let (n_lifted, n_dropped) = (sum(|object| object.lifted), sum(|object| object.dropped));
    // Of trials all count, also those that are given up.
    let trials: Vec<_> = objects.iter().map(|object| ObjectTrials { lifted: 1.0, ..*object }).collect();
    (n_lifted > 0.0).then(|| Promise {
        confidence: CONFIDENCE,
        n_attempts: None,
        drops_of_lifts: Bounded {
            estimate: n_dropped / n_lifted,
            at_most: smallest_rejected(|share| p_value(&lifted, share)),
            n_objects: lifted.len(),
        },
        drops_of_trials: Bounded {
            estimate: n_dropped / objects.len() as f64,
            at_most: smallest_rejected(|share| p_value(&trials, share)),
            n_objects: objects.len(),
        },
    })
}

/// The p-value of "at least this share of the lifts drops"; of the trials, if each object has a whole trial.
fn p_value(objects: &[ObjectTrials], share: f64) -> f64 {
    let is_whole = |object: &ObjectTrials| object.lifted == 1.0 && (object.dropped == 0.0 || object.dropped == 1.0);
    if objects.iter().all(is_whole) {
        let n_dropped = objects.iter().filter(|object| object.dropped == 1.0).count();
        return binomial_tail(n_dropped, objects.len(), share);
    }
    // The mean of tests with the objects in several orders is a test too; one order alone would be luck.
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut order = objects.to_vec();
    let capital = (0..N_ORDERS).map(|_| {
        order.shuffle(&mut random);
        final_capital(&order, share)
    });
    (f64::from(N_ORDERS) / capital.sum::<f64>()).min(1.0)
}

const N_ORDERS: u32 = 20;

/// The capital of a gambler who begins with 1 and bets on each object that fewer of its lifts drop than the share (the predictable
/// plug-in bets of section 4.1 there). If at least this share of the lifts drops, `share * lifted - dropped` has a mean of 0 at
/// most, and so the capital one of 1. A bet is at most 1, so that no object ruins him; bets do not depend on the share, so a
/// greater one makes him richer.
fn final_capital(objects: &[ObjectTrials], share: f64) -> f64 {
    let n = objects.len() as f64;
    let log_of_rejection = (1.0 / (1.0 - CONFIDENCE)).ln();
    let (mut n_seen, mut sum, mut squares) = (1.0, 0.5, 0.25);
    objects.iter().fold(1.0, |capital, ObjectTrials { lifted, dropped }| {
        let bet = (2.0 * log_of_rejection / (n * squares / n_seen)).sqrt().min(1.0);
        n_seen += 1.0;
        sum += dropped;
        squares += (dropped - sum / n_seen).powi(2);
        capital * (1.0 + bet * (share * lifted - dropped))
    })
}

/// The probability of at most `k` heads in `n` throws.
fn binomial_tail(k: usize, n: usize, p: f64) -> f64 {
    if k >= n || p <= 0.0 {
        return 1.0;
    }
    let odds = (p / (1.0 - p)).ln();
    let mut log_term = n as f64 * (1.0 - p).ln();
    let mut tail = log_term.exp();
    for heads in 1..=k {
        log_term += ((n - heads + 1) as f64 / heads as f64).ln() + odds;
        tail += log_term.exp();
    }
    tail.min(1.0)
}

/// The smallest share from which on the p-value is at most 1 - confidence; 1 if none is.
fn smallest_rejected(p_value: impl Fn(f64) -> f64) -> f64 {
    let (mut accepted, mut rejected) = (0.0, 1.0);
    for _ in 0..50 {
        let middle = f64::midpoint(accepted, rejected);
        if p_value(middle) <= 1.0 - CONFIDENCE { rejected = middle } else { accepted = middle }
    }
    rejected
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn single(n_kept: usize, n_dropped: usize, n_given_up: usize) -> Vec<ObjectTrials> {
        let object = |lifted, dropped| ObjectTrials { lifted, dropped };
        let kept = std::iter::repeat_n(object(1.0, 0.0), n_kept);
        let dropped = std::iter::repeat_n(object(1.0, 1.0), n_dropped);
        kept.chain(dropped).chain(std::iter::repeat_n(object(0.0, 0.0), n_given_up)).collect()
    }

    #[test]
    fn one_trial_for_each_object_gives_the_exact_binomial_bound() {
        // Clopper-Pearson's one-sided bounds: 1 - 0.05^(1/n) without a drop; scipy's beta.ppf(0.95, k + 1, n - k) otherwise.
        let none = promise(&single(59, 0, 0)).expect("lifts");
        assert!((none.drops_of_lifts.at_most - least_bound(59)).abs() < 1e-9, "{none:?}");
        let some = promise(&single(202, 8, 30)).expect("lifts");
        assert!((some.drops_of_lifts.at_most - 0.067_685).abs() < 1e-5, "{some:?}");
        assert_eq!((some.drops_of_lifts.n_objects, some.drops_of_trials.n_objects), (210, 240));
        assert!((some.drops_of_trials.estimate - 8.0 / 240.0).abs() < 1e-12);
        assert!(some.drops_of_trials.at_most < some.drops_of_lifts.at_most);
        assert_eq!(promise(&single(0, 0, 5)), None);
        assert_eq!(promise(&single(0, 3, 0)).expect("lifts").drops_of_lifts.at_most, 1.0);
    }

    #[test]
    fn the_bound_holds_for_new_objects_in_at_least_95_of_100_runs() {
        // Objects differ: an object drops its lifts with its own probability, whose mean is 0.1, and is lifted in its own
        // share of trials. Objects that are hard to lift drop more often.
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let (n_runs, mut n_broken) = (1000, [0; 2]);
        let draw = |random: &mut ChaCha8Rng| match random.random::<f64>() {
            ..0.1 => (0.5, 0.8),
            ..0.2 => (0.8, 0.25),
            _ => (1.0, 0.03),
        };
        let (lifts, drops) = (0.1 * 0.5 + 0.1 * 0.8 + 0.8, 0.1 * 0.5 * 0.8 + 0.1 * 0.8 * 0.25 + 0.8 * 0.03);
        for _ in 0..n_runs {
            let objects: Vec<ObjectTrials> = (0..60)
                .map(|_| {
                    let (lifted, dropping) = draw(&mut random);
                    let n_trials = 3;
                    let (mut n_lifted, mut n_dropped) = (0, 0);
                    for _ in 0..n_trials {
                        let is_lifted = random.random::<f64>() < lifted;
                        n_lifted += i32::from(is_lifted);
                        n_dropped += i32::from(is_lifted && random.random::<f64>() < dropping);
                    }
                    let share = |n: i32| f64::from(n) / f64::from(n_trials);
                    ObjectTrials { lifted: share(n_lifted), dropped: share(n_dropped) }
                })
                .collect();
            let found = promise(&objects).expect("lifts");
            n_broken[0] += i32::from(found.drops_of_lifts.at_most < drops / lifts);
            n_broken[1] += i32::from(found.drops_of_trials.at_most < drops);
        }
        assert!(n_broken.iter().all(|n| *n <= 65), "{n_broken:?} of {n_runs} bounds do not hold");
    }
}
