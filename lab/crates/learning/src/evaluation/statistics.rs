//! The uncertainty of measured shares, and the comparison of two.
//!
//! There are two kinds of 95 % interval: Wilson's for a share of independent samples, and the percentiles of a bootstrap
//! over whole clusters. Clusters are for claims about objects never seen: grasps of one object go right or wrong together.
//! No resample differs from a share of 0 or 1, so such a share has Wilson's interval over clusters.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// A figure with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    pub value: f64,
    /// `None` if there are too few samples.
    pub interval: Option<Interval>,
}

/// A 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    pub low: f64,
    pub high: f64,
}

pub const N_RESAMPLES: usize = 2000;
/// The 97.5 % quantile of the standard normal distribution.
const Z_95: f64 = 1.959_963_984_540_054;

/// Wilson's score interval of a share of independent samples; `None` if there are none.
pub fn wilson_interval(part: usize, whole: usize) -> Option<Interval> {
    if whole == 0 {
        return None;
    }
    let (n, share) = (whole as f64, part as f64 / whole as f64);
    let squared = Z_95 * Z_95 / n;
    let centre = (share + squared / 2.0) / (1.0 + squared);
    let half = Z_95 * (share * (1.0 - share) / n + squared / (4.0 * n)).sqrt() / (1.0 + squared);
    Some(Interval { low: (centre - half).max(0.0), high: (centre + half).min(1.0) })
}

/// The percentile intervals of `statistics` by a bootstrap over clusters: each resample draws whole clusters with
/// replacement and adds up their values. The same seed gives the same intervals.
///
/// The interval is `None` if there are fewer than two clusters, or if the statistic has no finite value in a tenth of the
/// resamples or more.
pub fn bootstrap<const K: usize, const N: usize>(
    clusters: &[[f64; K]],
    seed: u64,
    statistics: impl Fn(&[f64; K]) -> [f64; N],
) -> [Option<Interval>; N] {
    resample(clusters.len(), seed, |drawn| {
        let mut sums = [0.0; K];
        for cluster_idx in drawn {
            sums.iter_mut().zip(&clusters[*cluster_idx]).for_each(|(sum, value)| *sum += value);
        }
        statistics(&sums)
    })
}

/// As [`bootstrap`], for statistics that are not of sums: they get the indices of the drawn clusters.
pub fn resample<const N: usize>(
    n_clusters: usize,
    seed: u64,
    statistics: impl Fn(&[usize]) -> [f64; N],
) -> [Option<Interval>; N] {
    if n_clusters < 2 {
        return [None; N];
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut found: [Vec<f64>; N] = std::array::from_fn(|_| Vec::with_capacity(N_RESAMPLES));
    let mut drawn = vec![0; n_clusters];
    for _ in 0..N_RESAMPLES {
        drawn.fill_with(|| random.random_range(0..n_clusters));
        for (values, value) in found.iter_mut().zip(statistics(&drawn)) {
            if value.is_finite() {
                values.push(value);
            }
        }
    }
    found.map(|mut values| {
        if values.len() * 10 <= N_RESAMPLES * 9 {
            return None;
        }
        values.sort_by(f64::total_cmp);
        Some(Interval { low: quantile(&values, 0.025), high: quantile(&values, 0.975) })
    })
}

/// A quantile of sorted values, interpolated between two of them.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + (above - below) * at.fract()
}

/// McNemar's exact test, two-sided, of two judges: the probability of a split at least as uneven of the grasps that only
/// one of them decides rightly, if both are equally good. It takes grasps as independent.
pub fn mcnemar_exact(n_only_first_right: usize, n_only_second_right: usize) -> f64 {
    let n = n_only_first_right + n_only_second_right;
    let fewer = n_only_first_right.min(n_only_second_right);
    // Logarithms, because 2^-n is 0 in floating point from n = 1075 on.
    let mut log_probability = -(n as f64) * std::f64::consts::LN_2;
    let mut tail = log_probability.exp();
    for k in 1..=fewer {
        log_probability += ((n - k + 1) as f64 / k as f64).ln();
        tail += log_probability.exp();
    }
    (2.0 * tail).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-9, "{found}, expected {expected}");
    }

    #[test]
    fn wilsons_interval_is_the_published_one() {
        // Newcombe (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
        for (part, whole, low, high) in
            [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)]
        {
            let interval = wilson_interval(part, whole).expect("some");
            assert!((interval.low - low).abs() < 5e-5 && (interval.high - high).abs() < 5e-5, "{interval:?}");
        }
        assert_eq!(wilson_interval(0, 0), None);
    }

    #[test]
    fn mcnemars_test_by_hand() {
        close(mcnemar_exact(0, 0), 1.0);
        close(mcnemar_exact(5, 0), 2.0 / 32.0);
        close(mcnemar_exact(1, 3), 2.0 * 5.0 / 16.0);
        close(mcnemar_exact(3, 1), mcnemar_exact(1, 3));
        assert_eq!(mcnemar_exact(4, 4), 1.0);
        // Many: the normal approximation says 2 Phi(-2.98) = 0.0029.
        let many = mcnemar_exact(1050, 1188);
        assert!(many > 0.0030 && many < 0.0042, "{many}");
        assert!(mcnemar_exact(2000, 500) < 1e-100);
    }

    #[test]
    fn a_bootstrap_over_objects_is_wider_than_one_over_grasps() {
        // 40 objects of 25 grasps each, all of an object right or all wrong.
        let objects: Vec<[f64; 2]> = (0..40).map(|idx| [if idx % 4 == 0 { 0.0 } else { 25.0 }, 25.0]).collect();
        let [interval] = bootstrap(&objects, 1, |[right, n]| [right / n]);
        let interval = interval.expect("some");
        let wilson = wilson_interval(750, 1000).expect("some");
        let half = 1.96 * (0.75_f64 * 0.25 / 40.0).sqrt();
        assert!((interval.high - interval.low - 2.0 * half).abs() < 0.2 * half, "{interval:?}");
        assert!(interval.high - interval.low > 3.0 * (wilson.high - wilson.low));
        assert_eq!(
            bootstrap(&objects, 1, |[right, n]| [right / n]),
            [Some(interval)],
            "the same seed, the same interval"
        );
        assert_eq!(bootstrap(&objects, 1, |[right, _]| [right / 0.0]), [None]);
        assert_eq!(bootstrap(&objects[..1], 1, |[right, n]| [right / n]), [None]);
    }
}
