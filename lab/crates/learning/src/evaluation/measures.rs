//! Measures of decisions and of probabilities. Positive is "stable": a false positive is a dropped object.

use serde::Serialize;

/// Decisions counted by label.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Lifted and stable.
    pub n_true_positive: usize,
    /// Lifted and unstable: the object is dropped.
    pub n_false_positive: usize,
    /// Held and stable.
    pub n_false_negative: usize,
    /// Held and unstable.
    pub n_true_negative: usize,
}

/// A share of counted decisions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Share {
    /// Right decisions among all.
    Accuracy,
    /// Stable grasps among the lifted ones.
    Precision,
    /// Lifted grasps among the stable ones.
    Recall,
    /// False positives among all (the paper's figure).
    FalsePositiveShare,
    /// False positives among the unstable grasps.
    FalsePositiveRate,
}

/// A threshold on the probability, and the figures of lifting from it on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CurvePoint {
    pub threshold: f64,
    /// Share of the stable grasps that would be lifted.
    pub recall: f64,
    /// Share of the lifted grasps that would be stable.
    pub precision: f64,
    /// False positives among the unstable grasps.
    pub false_positive_rate: f64,
    /// False positives among all grasps.
    pub false_positive_share: f64,
    pub n_false_positive: usize,
}

impl Counts {
    pub fn add(&mut self, lifted: bool, stable: bool) {
        let count = match (lifted, stable) {
            (true, true) => &mut self.n_true_positive,
            (true, false) => &mut self.n_false_positive,
            (false, true) => &mut self.n_false_negative,
            (false, false) => &mut self.n_true_negative,
        };
        *count += 1;
    }

    /// Counts decisions, given as (lifted, stable).
    pub fn of(decisions: impl IntoIterator<Item = (bool, bool)>) -> Self {
        let mut counts = Counts::default();
        decisions.into_iter().for_each(|(lifted, stable)| counts.add(lifted, stable));
        counts
    }

    pub fn n(&self) -> usize {
        self.n_stable() + self.n_unstable()
    }

    pub fn n_stable(&self) -> usize {
        self.n_true_positive + self.n_false_negative
    }

    pub fn n_unstable(&self) -> usize {
        self.n_false_positive + self.n_true_negative
    }

    pub fn n_wrong(&self) -> usize {
        self.n_false_positive + self.n_false_negative
    }

    /// A share as its part and its whole.
    pub fn part_of_whole(&self, share: Share) -> (usize, usize) {
        match share {
            Share::Accuracy => (self.n_true_positive + self.n_true_negative, self.n()),
            Share::Precision => (self.n_true_positive, self.n_true_positive + self.n_false_positive),
            Share::Recall => (self.n_true_positive, self.n_stable()),
            Share::FalsePositiveShare => (self.n_false_positive, self.n()),
            Share::FalsePositiveRate => (self.n_false_positive, self.n_unstable()),
        }
    }

    /// A share; `None` if its whole is 0.
    pub fn share(&self, share: Share) -> Option<f64> {
        let (part, whole) = self.part_of_whole(share);
        (whole > 0).then(|| part as f64 / whole as f64)
    }

    /// The harmonic mean of precision and recall; `None` if no grasp is stable and none was lifted.
    pub fn f1(&self) -> Option<f64> {
        let whole = 2 * self.n_true_positive + self.n_wrong();
        (whole > 0).then(|| 2.0 * self.n_true_positive as f64 / whole as f64)
    }

    /// The accuracy of always deciding the same.
    pub fn majority(&self) -> Option<f64> {
        (self.n() > 0).then(|| self.n_stable().max(self.n_unstable()) as f64 / self.n() as f64)
    }
}

/// The figures of each threshold, from the highest probability that occurs to the lowest. Empty unless there are stable
/// and unstable grasps.
pub fn curve(probabilities: &[f64], stable: &[bool]) -> Vec<CurvePoint> {
    let mut samples: Vec<(f64, bool)> = probabilities.iter().copied().zip(stable.iter().copied()).collect();
    let n_stable = samples.iter().filter(|(_, stable)| *stable).count();
    let n_unstable = samples.len() - n_stable;
    if n_stable == 0 || n_unstable == 0 {
        return Vec::new();
    }
    samples.sort_by(|left, right| right.0.total_cmp(&left.0));
    let (mut n_true_positive, mut n_false_positive) = (0, 0);
    let mut points = Vec::new();
    for (idx, (threshold, stable)) in samples.iter().enumerate() {
        n_true_positive += usize::from(*stable);
        n_false_positive += usize::from(!stable);
        // Grasps with the same probability are lifted together.
        if samples.get(idx + 1).is_some_and(|(next, _)| next == threshold) {
            continue;
        }
        points.push(CurvePoint {
            threshold: *threshold,
            recall: n_true_positive as f64 / n_stable as f64,
            precision: n_true_positive as f64 / (n_true_positive + n_false_positive) as f64,
            false_positive_rate: n_false_positive as f64 / n_unstable as f64,
            false_positive_share: n_false_positive as f64 / samples.len() as f64,
            n_false_positive,
        });
    }
    points
}

/// The area under the receiver operating characteristic: how often a stable grasp has a higher probability than an
/// unstable one, ties counting half. `None` without a curve.
pub fn area_under_roc(curve: &[CurvePoint]) -> Option<f64> {
    let (mut area, mut from) = (0.0, (0.0, 0.0));
    for point in curve {
        area += (point.false_positive_rate - from.0) * (point.recall + from.1) / 2.0;
        from = (point.false_positive_rate, point.recall);
    }
    (!curve.is_empty()).then_some(area)
}

/// The average precision: the precision at each threshold, weighted by the recall it adds. `None` without a curve.
pub fn average_precision(curve: &[CurvePoint]) -> Option<f64> {
    let (mut sum, mut recall) = (0.0, 0.0);
    for point in curve {
        sum += (point.recall - recall) * point.precision;
        recall = point.recall;
    }
    (!curve.is_empty()).then_some(sum)
}

/// The highest threshold that lifts at least this share of the stable grasps; `None` without a curve.
pub fn at_recall(curve: &[CurvePoint], recall: f64) -> Option<CurvePoint> {
    curve.iter().find(|point| point.recall >= recall - 1e-12).copied()
}

/// The points of a curve that are at least `step` apart in recall or in false positive rate, with the first and the last.
pub fn thinned(curve: &[CurvePoint], step: f64) -> Vec<CurvePoint> {
    let mut kept: Vec<CurvePoint> = Vec::new();
    for (idx, point) in curve.iter().enumerate() {
        let is_far = kept.last().is_none_or(|last| {
            point.recall - last.recall >= step || point.false_positive_rate - last.false_positive_rate >= step
        });
        if is_far || idx + 1 == curve.len() {
            kept.push(*point);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-9, "{found}, expected {expected}");
    }

    #[test]
    fn ten_decisions_by_hand() {
        let counts = Counts { n_true_positive: 4, n_false_positive: 1, n_false_negative: 2, n_true_negative: 3 };
        for (share, expected) in [
            (Share::Accuracy, 0.7),
            (Share::Precision, 0.8),
            (Share::Recall, 4.0 / 6.0),
            (Share::FalsePositiveShare, 0.1),
            (Share::FalsePositiveRate, 0.25),
        ] {
            close(counts.share(share).expect("some"), expected);
        }
        close(counts.f1().expect("some"), 8.0 / 11.0);
        close(counts.majority().expect("some"), 0.6);
        let nothing = Counts::default();
        assert_eq!((nothing.share(Share::Recall), nothing.f1(), nothing.majority()), (None, None, None));
        let one = Counts::of([(false, false)]);
        assert_eq!((one.share(Share::Precision), one.f1(), one.n()), (None, None, 1));
    }

    #[test]
    fn six_probabilities_by_hand() {
        // From the top: stable, unstable, then a stable and an unstable one tied, unstable, stable.
        let probabilities = [0.9, 0.8, 0.6, 0.6, 0.3, 0.1];
        let stable = [true, false, true, false, false, true];
        let points = curve(&probabilities, &stable);
        let found: Vec<(f64, usize)> = points.iter().map(|point| (point.threshold, point.n_false_positive)).collect();
        assert_eq!(found, [(0.9, 0), (0.8, 1), (0.6, 2), (0.3, 3), (0.1, 3)]);
        // Of nine pairs, 3 + 1.5 + 0 are in order.
        close(area_under_roc(&points).expect("some"), 4.5 / 9.0);
        close(average_precision(&points).expect("some"), (1.0 + 0.5 + 0.5) / 3.0);
        assert_eq!(at_recall(&points, 0.5).expect("some").threshold, 0.6);
        assert_eq!(at_recall(&points, 1.0 / 3.0).expect("some").threshold, 0.9);
        assert_eq!(at_recall(&points, 1.0).expect("some").n_false_positive, 3);
        assert!(curve(&probabilities, &[true; 6]).is_empty());
        assert_eq!(area_under_roc(&[]), None);
    }

    #[test]
    fn areas_know_only_the_order() {
        let probabilities: Vec<f64> = (0..50).map(|idx| f64::from(idx * 37 % 50) / 50.0).collect();
        let stable: Vec<bool> = (0..50).map(|idx| idx % 3 == 0).collect();
        let area = |of: fn(f64) -> f64| {
            let points = curve(&probabilities.iter().map(|value| of(*value)).collect::<Vec<_>>(), &stable);
            (area_under_roc(&points).expect("some"), average_precision(&points).expect("some"))
        };
        assert_eq!(area(|value| value), area(|value| value.powi(3) / 2.0));
        close(area(|value| value).0, 1.0 - area(|value| -value).0);
        let kept = thinned(&curve(&probabilities, &stable), 0.1);
        assert!(kept.len() < 30 && kept.last().expect("some").recall == 1.0);
    }
}
