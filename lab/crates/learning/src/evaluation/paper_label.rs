//! The paper's label compared with labels that come from elsewhere, such as lifts: how well epsilon and volume predict
//! them.

use std::collections::BTreeMap;

use serde::Serialize;

use super::measures::{Counts, Share, area_under_roc, curve};
use super::statistics::{Estimate, wilson_interval};
use blindgrasp_messages::GraspTruth;
use blindgrasp_simulator::wrench_space::{STABLE_EPSILON, STABLE_VOLUME};

/// How well epsilon and volume predict other labels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PaperLabel {
    /// Over all grasps with epsilon and volume.
    pub all: Agreement,
    pub classes: BTreeMap<String, Agreement>,
    pub objects: BTreeMap<String, Agreement>,
    /// How often a stable grasp has a greater epsilon than an unstable one, ties counting half. `None` if all grasps have the
    /// same label.
    pub epsilon_roc_auc: Option<f64>,
    /// The same for the volume.
    pub volume_roc_auc: Option<f64>,
    /// Grasps without epsilon and volume.
    pub n_without_quality: usize,
}

/// The agreement of the paper's label (stable: epsilon above 0.07 and volume above 0.1) with the other label.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Agreement {
    pub n_stable_by_both: usize,
    /// Stable by the paper's label, but not by the other.
    pub n_stable_by_paper_only: usize,
    /// Stable by the other label, but not by the paper's.
    pub n_stable_by_truth_only: usize,
    pub n_unstable_by_both: usize,
    /// Share of the grasps with the same label, with Wilson's interval: grasps count as independent.
    pub accuracy: Option<Estimate>,
    /// The share of the larger class of the other label.
    pub majority_class: Option<f64>,
}

impl PaperLabel {
    /// Compares epsilon and volume with the labels of grasps.
    pub fn of<'a>(truths: impl IntoIterator<Item = &'a GraspTruth>) -> PaperLabel {
        let (mut epsilons, mut volumes, mut stable) = (Vec::new(), Vec::new(), Vec::new());
        let (mut all, mut n_without_quality) = (Counts::default(), 0);
        let mut classes: BTreeMap<String, Counts> = BTreeMap::new();
        let mut objects: BTreeMap<String, Counts> = BTreeMap::new();
        for truth in truths {
            if truth.epsilon.is_nan() || truth.volume.is_nan() {
                n_without_quality += 1;
                continue;
            }
            epsilons.push(truth.epsilon);
            volumes.push(truth.volume);
            stable.push(truth.stable);
            let label = truth.epsilon > STABLE_EPSILON && truth.volume > STABLE_VOLUME;
            for counts in [
                &mut all,
                classes.entry(truth.class.clone()).or_default(),
                objects.entry(truth.object.clone()).or_default(),
            ] {
                counts.add(label, truth.stable);
            }
        }
        let agreements = |counts: BTreeMap<String, Counts>| {
            counts.into_iter().map(|(name, counts)| (name, Agreement::from(counts))).collect()
        };
        PaperLabel {
            all: all.into(),
            classes: agreements(classes),
            objects: agreements(objects),
            epsilon_roc_auc: area_under_roc(&curve(&epsilons, &stable)),
            volume_roc_auc: area_under_roc(&curve(&volumes, &stable)),
            n_without_quality,
        }
    }

    /// The classes by their share of grasps with another label, the largest first; those without one are left out.
    pub fn by_disagreement(&self) -> Vec<(&str, &Agreement)> {
        let mut classes: Vec<(&str, &Agreement)> = self
            .classes
            .iter()
            .map(|(class, agreement)| (class.as_str(), agreement))
            .filter(|(_, agreement)| agreement.n_different() > 0)
            .collect();
        let share = |agreement: &Agreement| agreement.n_different() as f64 / agreement.n() as f64;
        classes.sort_by(|(_, a), (_, b)| share(b).total_cmp(&share(a)));
        classes
    }
}

impl Agreement {
    pub fn n(&self) -> usize {
        self.n_stable_by_both + self.n_unstable_by_both + self.n_different()
    }

    /// Grasps with another label than their truth.
    pub fn n_different(&self) -> usize {
        self.n_stable_by_paper_only + self.n_stable_by_truth_only
    }
}

/// As if the label had lifted.
impl From<Counts> for Agreement {
    fn from(counts: Counts) -> Self {
        let (part, whole) = counts.part_of_whole(Share::Accuracy);
        Agreement {
            n_stable_by_both: counts.n_true_positive,
            n_stable_by_paper_only: counts.n_false_positive,
            n_stable_by_truth_only: counts.n_false_negative,
            n_unstable_by_both: counts.n_true_negative,
            accuracy: counts
                .share(Share::Accuracy)
                .map(|value| Estimate { value, interval: wilson_interval(part, whole) }),
            majority_class: counts.majority(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth(class: &str, epsilon: f64, volume: f64, stable: bool) -> GraspTruth {
        GraspTruth { epsilon, volume, stable, object: class.into(), class: class.into(), ..GraspTruth::default() }
    }

    #[test]
    fn six_grasps_by_hand() {
        let truths = [
            truth("box", 0.2, 0.5, true),
            truth("box", 0.08, 0.2, false),
            truth("box", -1.0, 0.0, false),
            truth("mug", 0.1, 0.05, true),
            truth("can", -1.0, 0.0, false),
            truth("can", f64::NAN, f64::NAN, true),
        ];
        let found = PaperLabel::of(&truths);
        let Agreement { n_stable_by_both, n_stable_by_paper_only, n_stable_by_truth_only, n_unstable_by_both, .. } =
            found.all;
        let table = [n_stable_by_both, n_stable_by_paper_only, n_stable_by_truth_only, n_unstable_by_both];
        assert_eq!((table, found.n_without_quality), ([1, 1, 1, 2], 1));
        assert_eq!(found.all.accuracy.map(|accuracy| accuracy.value), Some(0.6));
        assert_eq!(found.all.majority_class, Some(0.6));
        // Stable 0.2, 0.1 against unstable 0.08, -1, -1: all six pairs in order; by volume 0.05 is below 0.2.
        assert_eq!(found.epsilon_roc_auc, Some(1.0));
        assert!(found.volume_roc_auc.is_some_and(|area| (area - 5.0 / 6.0).abs() < 1e-12));
        let classes: Vec<_> = found.by_disagreement().iter().map(|(class, of)| (*class, of.n_different())).collect();
        assert_eq!(classes, [("mug", 1), ("box", 1)]);
        assert_eq!(PaperLabel::of(&[]).all, Agreement::default());
    }
}
