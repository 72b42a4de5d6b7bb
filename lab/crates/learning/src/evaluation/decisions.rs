//! Labelled grasps with the decisions on them, and the figures of a recipe or model that decided.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::measures::{Counts, CurvePoint, Share, area_under_roc, average_precision, curve, thinned};
use super::reliability::{N_RELIABILITY_BINS, Reliability, reliability};
use super::statistics::{Estimate, Interval, bootstrap, wilson_interval};

/// A labelled grasp and the decision on it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JudgedGrasp {
    /// Index of its recording in the list of recordings.
    pub recording_idx: usize,
    /// Its number in that recording.
    pub grasp_id: u64,
    /// The fold that holds it; `None` without folds, and for grasps that are held without a judgement.
    pub fold: Option<usize>,
    pub object: String,
    pub class: String,
    pub stable: bool,
    pub lifted: bool,
    /// Whether a classifier judged it, rather than that it was held for another reason.
    pub judged: bool,
    /// The classifier's probability, if one decided.
    pub probability: Option<f64>,
}

/// The unit that a bootstrap draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Unit {
    /// Grasps, independent of each other: Wilson's intervals, and a bootstrap over grasps where shares are compared.
    Grasp,
    /// Objects with all their grasps: a bootstrap over objects; for shares of 0 and 1 Wilson's intervals over objects.
    Object,
}

/// Figures of decisions.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measures {
    pub n_grasps: usize,
    pub n_stable: usize,
    pub n_objects: usize,
    #[serde(flatten)]
    pub counts: Counts,
    /// Right decisions among all grasps.
    pub accuracy: Option<Estimate>,
    /// Stable grasps among the lifted ones.
    pub precision: Option<Estimate>,
    /// Lifted grasps among the stable ones.
    pub recall: Option<Estimate>,
    /// The harmonic mean of precision and recall.
    pub f1: Option<f64>,
    /// False positives among all grasps (the paper's figure).
    pub false_positive_share: Option<Estimate>,
    /// False positives among the unstable grasps.
    pub false_positive_rate: Option<Estimate>,
    /// The accuracy of always deciding the same.
    pub majority: Option<f64>,
}

/// Errors of a class of objects: a pair of bars of the paper's Figure 2.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassErrors {
    pub class: String,
    pub n_grasps: usize,
    pub n_wrong: usize,
    pub n_false_positive: usize,
    /// Wrong decisions as a share of the class's grasps.
    pub error_share: f64,
    /// False positives as a share of the class's grasps.
    pub false_positive_share: f64,
}

/// A recipe, a model or the predictions of an outside model, and its figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JudgedRecipe {
    /// The recipe's name, the model's file, or the name of the outside model.
    pub name: String,
    /// Its features and its learner, or the file of predictions.
    pub about: String,
    /// The judge lifts from this probability on.
    pub threshold_probability: f64,
    /// Figures over the grasps that the classifier judged.
    pub judged: Measures,
    /// Figures over all labelled grasps, with those held without a judgement.
    pub all: Measures,
    /// Judged grasps by class.
    pub by_class: Vec<ClassErrors>,
    /// Area under the receiver operating characteristic.
    pub roc_auc: Option<f64>,
    /// Area under precision over recall.
    pub average_precision: Option<f64>,
    /// The points of both curves, thinned for a picture.
    pub curve: Vec<CurvePoint>,
    pub reliability: Option<Reliability>,
    /// The decisions that the figures are of. The JSON leaves them out.
    #[serde(skip)]
    pub decided: Vec<JudgedGrasp>,
}

impl JudgedRecipe {
    /// Computes the figures. Curves and reliability are over the grasps with a probability.
    pub fn new(
        name: &str,
        about: String,
        threshold_probability: f64,
        decided: Vec<JudgedGrasp>,
        unit: Unit,
        seed: u64,
    ) -> JudgedRecipe {
        let judged: Vec<&JudgedGrasp> = decided.iter().filter(|grasp| grasp.judged).collect();
        let (probabilities, stable) = with_probability(&judged);
        let curve = curve(&probabilities, &stable);
        JudgedRecipe {
            name: name.into(),
            about,
            threshold_probability,
            judged: measure(&judged, unit, seed),
            all: measure(&decided.iter().collect::<Vec<_>>(), unit, seed),
            by_class: by_class(&judged),
            roc_auc: area_under_roc(&curve),
            average_precision: average_precision(&curve),
            curve: thinned(&curve, CURVE_STEP),
            reliability: (!stable.is_empty()).then(|| reliability(&probabilities, &stable, N_RELIABILITY_BINS)),
            decided,
        }
    }
}

/// The least distance between two points of a drawn curve, as a share.
const CURVE_STEP: f64 = 0.005;

/// The probabilities and labels of the grasps that have a probability.
pub(super) fn with_probability(grasps: &[&JudgedGrasp]) -> (Vec<f64>, Vec<bool>) {
    grasps.iter().filter_map(|grasp| Some((grasp.probability?, grasp.stable))).unzip()
}

pub fn measure(grasps: &[&JudgedGrasp], unit: Unit, seed: u64) -> Measures {
    const SHARES: [Share; 5] =
        [Share::Accuracy, Share::Precision, Share::Recall, Share::FalsePositiveShare, Share::FalsePositiveRate];
    let counts = Counts::of(grasps.iter().map(|grasp| (grasp.lifted, grasp.stable)));
    let intervals: [Option<Interval>; 5] = match unit {
        Unit::Grasp => SHARES.map(|share| {
            let (part, whole) = counts.part_of_whole(share);
            wilson_interval(part, whole)
        }),
        Unit::Object => {
            let of_object = |grasps: Vec<&JudgedGrasp>| -> [f64; 10] {
                let counts = Counts::of(grasps.iter().map(|grasp| (grasp.lifted, grasp.stable)));
                std::array::from_fn(|idx| {
                    let (part, whole) = counts.part_of_whole(SHARES[idx / 2]);
                    if idx % 2 == 0 { part as f64 } else { whole as f64 }
                })
            };
            let clusters: Vec<[f64; 10]> = by_object(grasps).into_values().map(of_object).collect();
            let drawn: [Option<Interval>; 5] =
                bootstrap(&clusters, seed, |sums| std::array::from_fn(|idx| sums[2 * idx] / sums[2 * idx + 1]));
            std::array::from_fn(|idx| {
                let (part, whole) = counts.part_of_whole(SHARES[idx]);
                if part > 0 && part < whole {
                    return drawn[idx];
                }
                // Every resample has this share. Wilson's interval takes each object as one sample, which is wide enough.
                let n_objects = clusters.iter().filter(|cluster| cluster[2 * idx + 1] > 0.0).count();
                wilson_interval(if part == 0 { 0 } else { n_objects }, n_objects)
            })
        }
    };
    let estimate = |idx: usize| counts.share(SHARES[idx]).map(|value| Estimate { value, interval: intervals[idx] });
    Measures {
        n_grasps: counts.n(),
        n_stable: counts.n_stable(),
        n_objects: grasps.iter().map(|grasp| &grasp.object).collect::<BTreeSet<_>>().len(),
        counts,
        accuracy: estimate(0),
        precision: estimate(1),
        recall: estimate(2),
        f1: counts.f1(),
        false_positive_share: estimate(3),
        false_positive_rate: estimate(4),
        majority: counts.majority(),
    }
}

/// Grasps by their objects.
fn by_object<'a>(grasps: &[&'a JudgedGrasp]) -> BTreeMap<&'a str, Vec<&'a JudgedGrasp>> {
    let mut objects: BTreeMap<&str, Vec<&JudgedGrasp>> = BTreeMap::new();
    for grasp in grasps {
        objects.entry(&grasp.object).or_default().push(grasp);
    }
    objects
}

fn by_class(grasps: &[&JudgedGrasp]) -> Vec<ClassErrors> {
    let mut classes: BTreeMap<&str, Counts> = BTreeMap::new();
    for grasp in grasps {
        classes.entry(&grasp.class).or_default().add(grasp.lifted, grasp.stable);
    }
    let errors = |(class, counts): (&str, Counts)| ClassErrors {
        class: class.into(),
        n_grasps: counts.n(),
        n_wrong: counts.n_wrong(),
        n_false_positive: counts.n_false_positive,
        error_share: counts.n_wrong() as f64 / counts.n() as f64,
        false_positive_share: counts.n_false_positive as f64 / counts.n() as f64,
    };
    classes.into_iter().map(errors).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Grasps of an object, as (stable, probability) lifted from 0.5 on; without a probability held.
    pub(in crate::evaluation) fn decided(
        object: &str,
        class: &str,
        grasps: &[(bool, Option<f64>)],
    ) -> Vec<JudgedGrasp> {
        let decided = |(idx, (stable, probability)): (usize, &(bool, Option<f64>))| JudgedGrasp {
            recording_idx: 0,
            grasp_id: idx as u64,
            fold: None,
            object: object.into(),
            class: class.into(),
            stable: *stable,
            lifted: probability.is_some_and(|probability| probability >= 0.5),
            judged: probability.is_some(),
            probability: *probability,
        };
        grasps.iter().enumerate().map(decided).collect()
    }

    #[test]
    fn what_was_held_unjudged_counts_among_all_only() {
        let mut grasps = decided("a", "x", &[(true, Some(0.9)), (false, Some(0.7)), (true, None), (false, None)]);
        grasps.extend(decided("b", "y", &[(true, Some(0.2)), (false, Some(0.1))]));
        let judge = JudgedRecipe::new("j", String::new(), 0.5, grasps.clone(), Unit::Grasp, 1);
        let counts = |measures: &Measures| (measures.n_grasps, measures.counts.n_wrong(), measures.n_objects);
        assert_eq!((counts(&judge.judged), counts(&judge.all)), ((4, 2, 2), (6, 3, 2)));
        assert_eq!(judge.judged.accuracy.expect("some").value, 0.5);
        assert_eq!(judge.judged.accuracy.expect("some").interval, wilson_interval(2, 4));
        assert_eq!(judge.judged.false_positive_rate.expect("some").value, 0.5);
        assert_eq!(judge.roc_auc, Some(0.75), "three of four pairs are in order");
        let found: Vec<_> = judge.by_class.iter().map(|class| (class.n_wrong, class.n_false_positive)).collect();
        assert_eq!(found, [(1, 1), (1, 0)]);
        assert!(judge.reliability.is_some());
        let by_object = measure(&grasps.iter().collect::<Vec<_>>(), Unit::Object, 1).accuracy.expect("some");
        let interval = by_object.interval.expect("two objects");
        assert!(by_object.value == 0.5 && interval.low == 0.5 && interval.high == 0.5, "each is half right");
    }

    #[test]
    fn a_share_of_all_or_none_has_wilsons_interval_over_the_objects_that_have_it() {
        let mut grasps: Vec<JudgedGrasp> =
            (0..20).flat_map(|object| decided(&object.to_string(), "x", &[(true, Some(0.9)); 3])).collect();
        grasps.extend(decided("unstable", "x", &[(false, Some(0.1)); 5]));
        let found = measure(&grasps.iter().collect::<Vec<_>>(), Unit::Object, 1);
        let interval = |estimate: Option<Estimate>| estimate.and_then(|estimate| estimate.interval);
        assert_eq!(interval(found.accuracy), wilson_interval(21, 21));
        assert_eq!(interval(found.recall), wilson_interval(20, 20));
        assert_eq!(interval(found.false_positive_share), wilson_interval(0, 21));
        assert_eq!(interval(found.false_positive_rate), wilson_interval(0, 1));
        assert_eq!(measure(&[], Unit::Object, 1).accuracy, None);
    }
}
