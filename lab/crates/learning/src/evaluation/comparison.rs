//! The comparison of two judges of the same grasps.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::decisions::{JudgedGrasp, Unit, with_probability};
use super::measures::{CurvePoint, at_recall, curve};
use super::statistics::{Estimate, bootstrap, mcnemar_exact, resample};

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
    /// 1 - false positives of the first / false positives of the second, at these thresholds. For the interval, each resample
    /// has its own recall and thresholds.
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
    let (places, n_units) = places(pairs, unit);
    let ranked = [0, 1].map(|side| ranked(pairs, &places, side));
    let lifted_by_second = clusters(pairs, unit, |(_, second)| {
        [second.stable && second.lifted, second.stable].map(|counts| f64::from(u8::from(counts)))
    });
    let [interval] = resample(n_units, seed, |drawn| {
        let mut n_drawn = vec![0.0; n_units];
        drawn.iter().for_each(|place| n_drawn[*place] += 1.0);
        let sum = |idx: usize| drawn.iter().map(|place| lifted_by_second[*place][idx]).sum::<f64>();
        [reduction(&ranked, &n_drawn, sum(0) / sum(1)).unwrap_or(f64::NAN)]
    });
    let relative_reduction = (second.n_false_positive > 0)
        .then(|| Estimate { value: 1.0 - first.n_false_positive as f64 / second.n_false_positive as f64, interval });
    Some(EqualRecall { recall: second.recall, first, second, relative_reduction })
}

/// A grasp as one judge ranks it.
struct Ranked {
    probability: f64,
    stable: bool,
    /// The place of its unit.
    place: usize,
}

/// The grasps to which a judge gave a probability, from the highest one to the lowest. `side` is 0 for the first judge, 1 for the
/// second.
fn ranked(pairs: &[(&JudgedGrasp, &JudgedGrasp)], places: &[usize], side: usize) -> Vec<Ranked> {
    let ranked = |(pair, place): (&(&JudgedGrasp, &JudgedGrasp), &usize)| {
        let grasp = [pair.0, pair.1][side];
        Some(Ranked { probability: grasp.probability?, stable: grasp.stable, place: *place })
    };
    let mut all: Vec<Ranked> = pairs.iter().zip(places).filter_map(ranked).collect();
    all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    all
}

/// 1 - false positives of the first / false positives of the second, at the recall that the second has at its threshold, if each
/// unit is there `n_drawn` times.
fn reduction([first, second]: &[Vec<Ranked>; 2], n_drawn: &[f64], recall: f64) -> Option<f64> {
    let (recall, of_second) = false_positives(second, n_drawn, recall)?;
    let (_, of_first) = false_positives(first, n_drawn, recall)?;
    Some(1.0 - of_first / of_second)
}

/// The recall and the false positives of the highest threshold with this recall, as [`at_recall`] finds it, if each unit is there
/// `n_drawn` times. `None` without stable or without unstable grasps.
fn false_positives(ranked: &[Ranked], n_drawn: &[f64], recall: f64) -> Option<(f64, f64)> {
    let n_of = |stable: bool| -> f64 {
        ranked.iter().filter(|grasp| grasp.stable == stable).map(|grasp| n_drawn[grasp.place]).sum()
    };
    let n_stable = n_of(true);
    if n_stable == 0.0 || n_of(false) == 0.0 {
        return None;
    }
    let (mut n_true_positive, mut n_false_positive) = (0.0, 0.0);
    for equal in ranked.chunk_by(|a, b| a.probability == b.probability) {
        for grasp in equal {
            let count = if grasp.stable { &mut n_true_positive } else { &mut n_false_positive };
            *count += n_drawn[grasp.place];
        }
        if n_true_positive / n_stable >= recall - 1e-12 {
            return Some((n_true_positive / n_stable, n_false_positive));
        }
    }
    None
}

/// Values of pairs, summed by the unit that a bootstrap draws.
fn clusters<'a, const K: usize>(
    pairs: &[(&'a JudgedGrasp, &'a JudgedGrasp)],
    unit: Unit,
    of_pair: impl Fn((&'a JudgedGrasp, &'a JudgedGrasp)) -> [f64; K],
) -> Vec<[f64; K]> {
    let (places, n_units) = places(pairs, unit);
    let mut sums = vec![[0.0; K]; n_units];
    for (pair, place) in pairs.iter().zip(places) {
        sums[place].iter_mut().zip(of_pair(*pair)).for_each(|(sum, value)| *sum += value);
    }
    sums
}

/// The place of each pair's unit among the units that a bootstrap draws, and their number.
fn places(pairs: &[(&JudgedGrasp, &JudgedGrasp)], unit: Unit) -> (Vec<usize>, usize) {
    match unit {
        Unit::Grasp => ((0..pairs.len()).collect(), pairs.len()),
        Unit::Object => {
            let objects: BTreeSet<&str> = pairs.iter().map(|(first, _)| first.object.as_str()).collect();
            let place_of: BTreeMap<&str, usize> = objects.into_iter().zip(0..).collect();
            (pairs.iter().map(|(first, _)| place_of[first.object.as_str()]).collect(), place_of.len())
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
    fn thresholds_of_equal_recall_are_chosen_again_in_each_resample() {
        // Each is sure of the stable grasps of five objects. So the first needs no false positive for the recall of the second, or
        // all of them, as the objects fall.
        let judge = |is_sure: fn(usize) -> bool, unstable: f64| {
            let of_object = |object: usize| {
                let stable = if is_sure(object) { 0.9 } else { 0.1 };
                decided(&object.to_string(), "x", &[(true, Some(stable)), (false, Some(unstable))])
            };
            (0..10).flat_map(of_object).collect::<Vec<_>>()
        };
        let (first, second) = (judge(|object| object < 5, 0.3), judge(|object| object >= 5, 0.95));
        let equal = compare([("1", &first), ("2", &second)], Unit::Object, 1).at_equal_recall.expect("some");
        assert_eq!((equal.recall, equal.first.n_false_positive, equal.second.n_false_positive), (0.5, 0, 10));
        let Estimate { value, interval } = equal.relative_reduction.expect("some");
        let interval = interval.expect("ten objects");
        assert_eq!((value, interval.low, interval.high), (1.0, 0.0, 1.0));
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
