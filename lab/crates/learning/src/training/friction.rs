//! Labels for several friction coefficients: whether a grasp would have been stable on a smoother or rougher object.
//!
//! A robot that cannot see does not know the friction either (Dang & Allen, section V). A recording with scenes says
//! where all contacts were, so each grasp can be judged again for any coefficient; its target is then the share of the
//! coefficients for which it is stable, each as probable as the others.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;

use blindgrasp_messages::GraspScene;
use blindgrasp_recording::{Record, RecordingError, RecordingReader};
use blindgrasp_simulator::wrench_space::{GraspCase, QualityError, is_stable};

/// Stable or not for each friction, or the error of the grasp's quality.
pub(super) type Judged = Result<Vec<bool>, QualityError>;

/// Whether each grasp of a recording that has a scene is stable for each of `frictions`, by its number.
///
/// # Errors
/// A recording that cannot be read.
pub(super) fn stable_by_friction(path: &Path, frictions: &[f64]) -> Result<BTreeMap<u64, Judged>, RecordingError> {
    let mut scenes = Vec::new();
    for record in RecordingReader::open(path)? {
        if let Record::Scene(scene) = record?.1 {
            scenes.push(scene.message);
        }
    }
    Ok(scenes.par_iter().map(|scene| (scene.grasp_id, judge(scene, frictions))).collect())
}

fn judge(scene: &GraspScene, frictions: &[f64]) -> Judged {
    let mut case = GraspCase::from(scene);
    let with = |friction: &f64| {
        case.contacts.iter_mut().for_each(|contact| contact.friction = *friction);
        is_stable(&case)
    };
    frictions.iter().map(with).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recordings_own_friction_gives_its_own_truth_and_more_friction_never_less() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../recordings/held-out.mcap");
        let judged = stable_by_friction(&path, &[0.3, 1.0, 2.0]).expect("readable");
        let mut n_changed = 0;
        for record in RecordingReader::open(&path).expect("readable") {
            if let Record::Truth(truth) = record.expect("readable").1 {
                let stable = judged[&truth.message.grasp_id].as_ref().expect("a quality");
                assert_eq!(stable[1], truth.message.stable, "grasp {}", truth.message.grasp_id);
                assert!(stable.is_sorted(), "grasp {}: {stable:?}", truth.message.grasp_id);
                n_changed += usize::from(stable[0] != stable[2]);
            }
        }
        assert!(n_changed > 20, "only {n_changed}");
    }
}
