//! The comparison of two judges of the same grasps.

use serde::Serialize;

use super::decisions::{JudgedGrasp, Unit, by_object, with_probability};
use super::measures::{CurvePoint, at_recall, curve};
use super::statistics::{Estimate, bootstrap, mcnemar_exact};

/// Two judges, paired over the grasps that both judged.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    pub first: String,
    pub second: String,
    pub n_grasps: usize,
    /// Grasps that only the first decides rightly.
    pub n_only_first_right: usize,
    /// Grasps that only the second decides rightly.
    pub n_only_second_right: usize,
    /// McNemar's exact test, two-sided; it takes grasps as independent.
    pub mcnemar_p: f64,
    /// The first one's accuracy less the second one's.
    pub accuracy_difference: Option<Estimate>,
    /// 1 - errors of the first / errors of the second; negative if the first makes more.
    pub relative_error_reduction: Option<Estimate>,
    /// False positives at the same recall.
    pub at_equal_recall: Option<EqualRecall>,
}

/// False positives of two judges at the recall that the second has at its own threshold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EqualRecall {
    /// The recall of the second judge at its threshold; if probabilities tie, the next higher recall.
    pub recall: f64,
    /// The first judge at the highest threshold that gives this recall.
    pub first: CurvePoint,
    pub second: CurvePoint,
    /// 1 - false positives of the first / false positives of the second, at these thresholds.
    pub relative_reduction: Option<Estimate>,
}

/// Compares two judges that decided the same grasps in the same order.
pub fn compare([first, second]: [(&str, &[JudgedGrasp]); 2], unit: Unit, seed: u64) -> Comparison {
    let pairs: Vec<(&JudgedGrasp, &JudgedGrasp)> =
        first.1.iter().zip(second.1).filter(|(first, second)| first.judged && second.judged).collect();
    let is_right = |grasp: &JudgedGrasp| grasp.lifted == grasp.stable;
    let count = |wanted: &dyn Fn(bool, bool) -> bool| {
        pairs.iter().filter(|(first, second)| wanted(is_right(first), is_right(second))).count()
    };
    let (n_only_first_right, n_only_second_right) = (count(&|a, b| a && !b), count(&|a, b| !a && b));
    let (n_first_wrong, n_second_wrong) = (count(&|a, _| !a), count(&|_, b| !b));
    let n = pairs.len();

    let wrong = |grasp: &JudgedGrasp| f64::from(u8::from(!is_right(grasp)));
    let clusters = clusters(&pairs, unit, |(first, second)| [1.0, wrong(first), wrong(second)]);
    let [difference, reduction] =
        bootstrap(&clusters, seed, |[n, first, second]| [(second - first) / n, 1.0 - first / second]);
    let share = |part: f64, whole: usize| (whole > 0).then(|| part / whole as f64);
    let estimate = |value: Option<f64>, interval| value.map(|value| Estimate { value, interval });
    let fewer = n_second_wrong as f64 - n_first_wrong as f64;
    Comparison {
        first: first.0.into(),
        second: second.0.into(),
        n_grasps: n,
        n_only_first_right,
        n_only_second_right,
        mcnemar_p: mcnemar_exact(n_only_first_right, n_only_second_right),
        accuracy_difference: estimate(share(fewer, n), difference),
        relative_error_reduction: estimate(share(fewer, n_second_wrong), reduction),
        at_equal_recall: equal_recall(&pairs, unit, seed),
    }
}

fn equal_recall(pairs: &[(&JudgedGrasp, &JudgedGrasp)], unit: Unit, seed: u64) -> Option<EqualRecall> {
    let curve_of = |grasps: Vec<&JudgedGrasp>| {
        let (probabilities, stable) = with_probability(&grasps);
        curve(&probabilities, &stable)
    };
    let second_grasps: Vec<&JudgedGrasp> = pairs.iter().map(|(_, second)| *second).collect();
    let n_stable = second_grasps.iter().filter(|grasp| grasp.stable).count();
    let n_lifted = second_grasps.iter().filter(|grasp| grasp.stable && grasp.lifted).count();
    if n_lifted == 0 {
        return None;
    }
    let second = at_recall(&curve_of(second_grasps), n_lifted as f64 / n_stable as f64)?;
    let first = at_recall(&curve_of(pairs.iter().map(|(first, _)| *first).collect()), second.recall)?;
    let dropped = |grasp: &JudgedGrasp, threshold: f64| {
        f64::from(u8::from(!grasp.stable && grasp.probability.is_some_and(|probability| probability >= threshold)))
    };
    let of_pair = |(a, b): (&JudgedGrasp, &JudgedGrasp)| [dropped(a, first.threshold), dropped(b, second.threshold)];
    let [interval] = bootstrap(&clusters(pairs, unit, of_pair), seed, |[first, second]| [1.0 - first / second]);
    let relative_reduction = (second.n_false_positive > 0)
        .then(|| Estimate { value: 1.0 - first.n_false_positive as f64 / second.n_false_positive as f64, interval });
    Some(EqualRecall { recall: second.recall, first, second, relative_reduction })
}

/// Values of pairs, summed by the unit that a bootstrap draws.
fn clusters<'a, const K: usize>(
    pairs: &[(&'a JudgedGrasp, &'a JudgedGrasp)],
    unit: Unit,
    of_pair: impl Fn((&'a JudgedGrasp, &'a JudgedGrasp)) -> [f64; K],
) -> Vec<[f64; K]> {
    match unit {
        Unit::Grasp => pairs.iter().copied().map(of_pair).collect(),
        Unit::Object => {
            let firsts: Vec<&JudgedGrasp> = pairs.iter().map(|(first, _)| *first).collect();
            let place_of: std::collections::BTreeMap<&str, usize> =
                by_object(&firsts).into_keys().enumerate().map(|(place, object)| (object, place)).collect();
            let mut sums = vec![[0.0; K]; place_of.len()];
            for pair in pairs {
                let sum = &mut sums[place_of[pair.0.object.as_str()]];
                sum.iter_mut().zip(of_pair(*pair)).for_each(|(sum, value)| *sum += value);
            }
            sums
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::decisions::tests::decided;
    use super::*;

    #[test]
    fn two_judges_of_six_grasps_by_hand() {
        let truth = [true, true, true, false, false, false];
        let judge = |probabilities: [f64; 6]| {
            let grasps: Vec<_> = truth.into_iter().zip(probabilities.map(Some)).collect();
            let mut all = decided("a", "x", &grasps[..3]);
            all.extend(decided("b", "x", &grasps[3..]));
            all
        };
        let first = judge([0.9, 0.8, 0.4, 0.45, 0.2, 0.1]);
        let second = judge([0.9, 0.6, 0.3, 0.7, 0.8, 0.1]);
        for unit in [Unit::Grasp, Unit::Object] {
            let found = compare([("1", &first), ("2", &second)], unit, 1);
            assert_eq!((found.n_grasps, found.n_only_first_right, found.n_only_second_right), (6, 2, 0));
            assert_eq!(found.mcnemar_p, 0.5);
            assert!((found.accuracy_difference.expect("some").value - 1.0 / 3.0).abs() < 1e-12);
            assert!((found.relative_error_reduction.expect("some").value - 2.0 / 3.0).abs() < 1e-12);
            // The second lifts two of three stable grasps and two unstable ones; the first needs none to lift two.
            let equal = found.at_equal_recall.expect("some");
            assert!((equal.recall - 2.0 / 3.0).abs() < 1e-12);
            assert_eq!((equal.first.n_false_positive, equal.second.n_false_positive), (0, 2));
            assert_eq!(equal.relative_reduction.expect("some").value, 1.0);
        }
        let same = compare([("1", &first), ("1", &first)], Unit::Grasp, 1);
        assert_eq!((same.mcnemar_p, same.accuracy_difference.expect("some").value), (1.0, 0.0));
        assert_eq!(same.relative_error_reduction.expect("some").value, 0.0);
    }

    #[test]
    fn what_one_did_not_judge_is_not_compared() {
        let first = decided("a", "x", &[(true, Some(0.9)), (false, None)]);
        let second = decided("a", "x", &[(true, Some(0.9)), (false, Some(0.9))]);
        let found = compare([("1", &first), ("2", &second)], Unit::Object, 1);
        assert_eq!((found.n_grasps, found.n_only_first_right, found.at_equal_recall), (1, 0, None));
        assert_eq!(found.relative_error_reduction, None, "no errors to reduce");
    }
}
