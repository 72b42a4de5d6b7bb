//! Experience from recordings of lifts.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::dataset::{DatasetError, label_of, read_grasps};
use blindgrasp_messages::{Fault, GraspScene, Phase, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingError, RecordingReader};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::encoder::{Reading, Scaling};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::regrasp::{Experience, FORMAT, LiftedGrasp};

/// The experience of recordings, and what was left out.
#[derive(Debug, Clone, PartialEq)]
pub struct Collected {
    pub experience: Experience,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// Grasps of the experience outside the model's training range.
    pub n_out_of_distribution: usize,
}

/// Why recordings give no experience.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error("{0}")]
    Data(String),
}

/// A grasp's first settled frame: its preshape, and its feature or the reason why it has none.
struct Felt {
    open_joints_rad: Vec<f64>,
    values: Result<Vec<f64>, Fault>,
    is_out_of_distribution: bool,
}

/// Reads recordings of lifts. The object's pose comes from the scene, so only recordings of `simulate --label lift`
/// have it. A grasp outside the model's training range is experience too. `progress` gets the number of recordings read
/// and their total after each one.
///
/// # Errors
/// A recording that cannot be read, is given twice, is of another hand or not of lifts, or no grasp to learn from.
pub fn collect(
    hand: &Hand,
    model: &Model,
    recordings: &[PathBuf],
    mut progress: impl FnMut(usize, usize),
) -> Result<Collected, CollectError> {
    if hand.id() != model.hand.id {
        return Err(CollectError::Data(format!(
            "the model is of the hand '{}' ({:016x}), the recordings are of '{}' ({:016x}): give the model that was \
             trained for it: --experience MODEL",
            model.hand.name,
            model.hand.id,
            hand.name,
            hand.id()
        )));
    }
    let mut canonical = BTreeSet::new();
    let mut n_excluded: BTreeMap<String, usize> = BTreeMap::new();
    let mut n_out_of_distribution = 0;
    let mut object_idxs: HashMap<String, usize> = HashMap::new();
    let mut objects = Vec::new();
    let (mut grasps, mut rows) = (Vec::new(), Vec::new());
    for (recording_idx, path) in recordings.iter().enumerate() {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            return Err(CollectError::Data(format!("{} is given twice", path.display())));
        }
        check_label(path)?;
        let mut scenes = scenes(path).map_err(DatasetError::from)?;
        let of_recording = read_grasps(path, hand, |_, frames| felt(hand, model, &frames))?;
        let mut exclude = |reason: &str| *n_excluded.entry(reason.into()).or_default() += 1;
        for grasp in of_recording {
            let (felt, truth, scene) = match (grasp.value, grasp.truth, scenes.remove(&grasp.grasp_id)) {
                (_, None, _) => {
                    exclude("no truth");
                    continue;
                }
                (_, _, None) => {
                    exclude("no scene that says where the object was");
                    continue;
                }
                (None, _, _) => {
                    exclude("no frame of the open hand, or no settled one");
                    continue;
                }
                (Some(felt), Some(truth), Some(scene)) => (felt, truth, scene),
            };
            let values = match felt.values {
                Ok(values) => values,
                Err(fault) => {
                    exclude(fault.as_str());
                    continue;
                }
            };
            let Some(palm_from_object) = palm_from_object(&scene) else {
                exclude("a scene whose pose is none");
                continue;
            };
            n_out_of_distribution += usize::from(felt.is_out_of_distribution);
            let object_idx = *object_idxs.entry(truth.object.clone()).or_insert_with(|| {
                objects.push(truth.object);
                objects.len() - 1
            });
            let open_joints_rad = felt.open_joints_rad;
            grasps.push(LiftedGrasp {
                object_idx,
                held: truth.stable,
                palm_from_object,
                open_joints_rad,
                feature: Vec::new(),
            });
            rows.extend(values);
        }
        progress(recording_idx + 1, recordings.len());
    }
    if grasps.is_empty() {
        let reasons: Vec<String> = n_excluded.iter().map(|(reason, n)| format!("{n} with {reason}")).collect();
        let what = if reasons.is_empty() { "no grasp at all".into() } else { reasons.join(", ") };
        return Err(CollectError::Data(format!(
            "no grasp to learn from ({what}): expected lifted grasps that some cell feels, as blindgrasp simulate --label \
             lift makes them"
        )));
    }
    let n_values = model.features.len();
    let mut experience = Experience {
        format: FORMAT.into(),
        hand: model.hand.clone(),
        dictionary_id: model.dictionary_id(),
        scaling: Scaling::of(&rows, n_values),
        preshape_idxs: (0..hand.joints.len()).filter(|idx| hand.joints[*idx].is_preshape).collect(),
        objects,
        grasps: Vec::new(),
    };
    for (grasp, values) in grasps.iter_mut().zip(rows.chunks_exact(n_values)) {
        grasp.feature = experience.code(values);
    }
    experience.grasps = grasps;
    Ok(Collected { experience, n_excluded, n_out_of_distribution })
}

fn check_label(path: &Path) -> Result<(), CollectError> {
    let reader = RecordingReader::open(path).map_err(DatasetError::from)?;
    match label_of(path, &reader)? {
        Some(Label::Lift) => Ok(()),
        found => {
            let what =
                found.map_or("no simulation made it".into(), |label| format!("its truth is {}", label.meaning()));
            Err(CollectError::Data(format!(
                "{}: {what}: expected what lifts came to, with a scene of each grasp, as blindgrasp simulate --label lift \
                 makes them",
                path.display()
            )))
        }
    }
}

fn scenes(path: &Path) -> Result<HashMap<u64, GraspScene>, RecordingError> {
    let mut scenes = HashMap::new();
    for record in RecordingReader::open(path)? {
        if let (_, Record::Scene(Stamped { message, .. })) = record? {
            scenes.insert(message.grasp_id, message);
        }
    }
    Ok(scenes)
}

fn felt(hand: &Hand, model: &Model, frames: &[Stamped<TactileFrame>]) -> Option<Felt> {
    let first_of = |phase: Phase| frames.iter().find(|frame| frame.message.phase == phase);
    let open_joints_rad = first_of(Phase::Open)?.message.joints_rad.clone();
    let settled = first_of(Phase::Settled)?;
    let (joints_rad, cells_newtons) = (&settled.message.joints_rad, &settled.message.cells_newtons);
    let (mut contacts, mut values) = (Vec::new(), Vec::new());
    let summary = contacts_from_frame(hand, settled.header.hand_id, joints_rad, cells_newtons, &mut contacts);
    let senses = settled.message.senses.view();
    let reading = Reading { joints_rad, contacts: &contacts, senses };
    let outcome = match summary.fault {
        Fault::None => model.features.extract(&reading, &mut values),
        fault => Err(fault),
    };
    let is_out_of_distribution =
        outcome.is_ok() && model.training_range.check(&model.features, joints_rad, &contacts).is_err();
    Some(Felt { open_joints_rad, values: outcome.map(|_| values), is_out_of_distribution })
}

/// The object's axes at its centre of mass, so that poses of different objects are comparable.
fn palm_from_object(scene: &GraspScene) -> Option<Isometry3<f64>> {
    let [x, y, z] = scene.centre_of_mass_m;
    let rotation = Quaternion::from(scene.object_rotation_xyzw);
    let is_pose = [x, y, z].iter().all(|number| number.is_finite()) && (rotation.norm() - 1.0).abs() < 1e-3;
    is_pose.then(|| Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(rotation)))
}
