//! How well probabilities agree with what happened: reliability bins, Brier score, expected calibration error, log
//! loss.
//!
//! Pass probabilities of samples that neither the machine nor its calibration has seen; those of the training samples
//! flatter.

use serde::{Deserialize, Serialize};

/// Probabilities held against labels.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Groups of about equally many samples, from the lowest probabilities to the highest; drawn, they are a
    /// reliability diagram.
    pub bins: Vec<ReliabilityBin>,
    /// Mean squared difference of probability and label; 0 is perfect, 0.25 is what always saying one half gets.
    pub brier: f64,
    /// Expected calibration error: the mean over all samples of their bin's |mean probability − share of positives|.
    pub ece: f64,
    /// Mean negative logarithm of the probability that was given to what happened, nats.
    pub log_loss: f64,
}

/// Samples of similar probability.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ReliabilityBin {
    /// Mean of their probabilities.
    pub mean_probability: f64,
    /// The share of them that are positive.
    pub share_positive: f64,
    /// How many they are.
    pub n: usize,
}

/// The number of bins that the expected calibration errors of this program are over.
pub const N_RELIABILITY_BINS: usize = 10;

/// Holds the probabilities of the positive class against the labels, in at most `n_bins` bins of about equally many
/// samples: bins of equal width would leave some with a handful, whose shares are noise. Samples of the same
/// probability are in the same bin.
///
/// A probability of 0 for what happened costs the log loss what 1e-15 would, not infinity. All figures are 0, and there
/// are no bins, without samples; of unequal lists, the longer one's end is left out.
pub fn reliability(probabilities: &[f64], labels: &[bool], n_bins: usize) -> Reliability {
    let mut samples: Vec<(f64, bool)> = probabilities.iter().copied().zip(labels.iter().copied()).collect();
    if samples.is_empty() {
        return Reliability::default();
    }
    samples.sort_by(|left, right| left.0.total_cmp(&right.0));
    let n = samples.len();
    let mean = |of: &dyn Fn(&(f64, bool)) -> f64| samples.iter().map(of).sum::<f64>() / n as f64;
    let brier = mean(&|(probability, positive)| (probability - f64::from(u8::from(*positive))).powi(2));
    let log_loss = mean(&|(probability, positive)| {
        let given = if *positive { *probability } else { 1.0 - probability };
        -given.clamp(LEAST_PROBABILITY, 1.0).ln()
    });
    let mut bins = Vec::new();
    let mut start = 0;
    for bin_idx in 0..n_bins.max(1) {
        // Where this bin would end if all probabilities differed, and behind those that equal the last one.
        let end = (bin_idx + 1) * n / n_bins.max(1);
        if end <= start {
            continue;
        }
        let last = samples[end - 1].0;
        let end = end + samples[end..].iter().take_while(|(probability, _)| *probability == last).count();
        bins.push(bin(&samples[start..end]));
        start = end;
    }
    let ece = bins.iter().map(|bin| bin.n as f64 * (bin.mean_probability - bin.share_positive).abs()).sum::<f64>();
    Reliability { bins, brier, ece: ece / n as f64, log_loss }
}

/// What a probability of 0 counts as in the log loss.
const LEAST_PROBABILITY: f64 = 1e-15;

fn bin(samples: &[(f64, bool)]) -> ReliabilityBin {
    let n = samples.len() as f64;
    ReliabilityBin {
        mean_probability: samples.iter().map(|(probability, _)| probability).sum::<f64>() / n,
        share_positive: samples.iter().filter(|(_, positive)| *positive).count() as f64 / n,
        n: samples.len(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_near(left: f64, right: f64) -> bool {
        (left - right).abs() < 1e-12
    }

    #[test]
    fn four_samples_in_two_bins_by_hand() {
        // Sorted: 0.1 no, 0.3 yes | 0.6 yes, 0.8 yes.
        let of = reliability(&[0.8, 0.1, 0.6, 0.3], &[true, false, true, true], 2);
        let [low, high] = of.bins[..] else { panic!("{of:?}") };
        assert!(is_near(low.mean_probability, 0.2) && is_near(high.mean_probability, 0.7));
        assert_eq!((low.share_positive, low.n, high.share_positive, high.n), (0.5, 2, 1.0, 2));
        assert!(is_near(of.brier, (0.2_f64.powi(2) + 0.1_f64.powi(2) + 0.4_f64.powi(2) + 0.7_f64.powi(2)) / 4.0));
        assert!(is_near(of.ece, (2.0 * 0.3 + 2.0 * 0.3) / 4.0));
        assert!(is_near(of.log_loss, -(0.8_f64.ln() + 0.9_f64.ln() + 0.6_f64.ln() + 0.3_f64.ln()) / 4.0));
    }

    #[test]
    fn always_one_half_is_calibrated_and_worth_nothing() {
        let of = reliability(&[0.5; 6], &[true, false, true, false, true, false], 3);
        assert_eq!(of.bins, [ReliabilityBin { mean_probability: 0.5, share_positive: 0.5, n: 6 }]);
        assert_eq!((of.brier, of.ece), (0.25, 0.0));
        assert!(is_near(of.log_loss, 2.0_f64.ln()));
    }

    #[test]
    fn perfect_and_perfectly_wrong() {
        let perfect = reliability(&[1.0, 0.0], &[true, false], 10);
        assert_eq!((perfect.brier, perfect.ece, perfect.log_loss), (0.0, 0.0, 0.0));
        let wrong = reliability(&[0.0, 1.0], &[true, false], 10);
        assert_eq!((wrong.brier, wrong.ece), (1.0, 1.0));
        assert!(is_near(wrong.log_loss, -LEAST_PROBABILITY.ln()));
    }

    #[test]
    fn each_sample_is_in_one_bin_whatever_the_number_of_bins() {
        let probabilities: Vec<f64> = (0..37).map(|idx| f64::from(idx % 11) / 10.0).collect();
        let labels: Vec<bool> = (0..37).map(|idx| idx % 3 == 0).collect();
        for n_bins in [0, 1, 2, 5, 10, 37, 100] {
            let of = reliability(&probabilities, &labels, n_bins);
            assert_eq!(of.bins.iter().map(|bin| bin.n).sum::<usize>(), 37);
            assert!(of.bins.len() <= n_bins.max(1));
            let ascends = of.bins.windows(2).all(|pair| pair[0].mean_probability < pair[1].mean_probability);
            assert!(ascends, "{n_bins} bins: {:?}", of.bins);
            let weighted: f64 = of.bins.iter().map(|bin| bin.n as f64 * bin.share_positive).sum();
            assert!(is_near(weighted, 13.0));
        }
        assert_eq!(reliability(&[], &[], 10), Reliability::default());
    }
}
