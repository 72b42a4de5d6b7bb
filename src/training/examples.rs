//! The grasps of recordings as examples to learn from.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::TrainingError;
use crate::contacts::contacts_from_frame;
use crate::dataset::{DatasetError, read_grasps};
use crate::hand::Hand;
use crate::message::{Contact, Fault, Phase};
use crate::recording::RecordingReader;

/// A grasp to learn from: its first settled frame and its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Example {
    /// Index of its recording in the list it was read from.
    pub recording_idx: usize,
    /// Its number there.
    pub grasp_id: u64,
    /// Joint angles, radians.
    pub joints_rad: Vec<f64>,
    /// The contacts that cells feel; at least one.
    pub contacts: Vec<Contact>,
    /// Whether the grasp was stable.
    pub stable: bool,
    /// The object's name: what splits by object keep together.
    pub object: String,
    /// The object's class.
    pub class: String,
}

/// The grasps of recordings that can be learned from, and what was left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Examples {
    /// The grasps with truth that some cell feels.
    pub examples: Vec<Example>,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// Grasps with truth that no cell feels, as (object, class, stable): held whatever a model says.
    pub unfelt: Vec<(String, String, bool)>,
    /// What made each recording, as it says of itself.
    pub made_by: Vec<String>,
}

impl Examples {
    /// Reads recordings. `progress` is told after each how many there are done and in all.
    ///
    /// # Errors
    /// A recording that cannot be used or is given twice.
    pub fn read(
        hand: &Hand,
        recordings: &[PathBuf],
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Examples, TrainingError> {
        let mut canonical = BTreeSet::new();
        let mut read = Examples::default();
        for (recording_idx, path) in recordings.iter().enumerate() {
            if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
                return Err(TrainingError::Data(format!("{} is given twice", path.display())));
            }
            read.add(hand, path, recording_idx)?;
            progress(recording_idx + 1, recordings.len());
        }
        Ok(read)
    }

    fn add(&mut self, hand: &Hand, path: &Path, recording_idx: usize) -> Result<(), TrainingError> {
        self.made_by.push(RecordingReader::open(path).map_err(DatasetError::from)?.info().made_by.clone());
        let grasps = read_grasps(path, hand, |_, frames| {
            let frame = frames.into_iter().find(|frame| frame.message.phase == Phase::Settled)?;
            let (joints, cells) = (&frame.message.joints_rad, &frame.message.cells_newtons);
            let mut contacts = Vec::new();
            let summary = contacts_from_frame(hand, frame.header.hand_id, joints, cells, &mut contacts);
            Some((frame.message.joints_rad, contacts, summary.fault))
        })?;
        let mut exclude = |reason: &str| *self.n_excluded.entry(reason.into()).or_default() += 1;
        for grasp in grasps {
            let grasp_id = grasp.grasp_id;
            match (grasp.value, grasp.truth) {
                (_, None) => exclude("no truth"),
                (None, _) => exclude("no settled frame"),
                (Some((joints_rad, contacts, Fault::None)), Some(truth)) => self.examples.push(Example {
                    recording_idx,
                    grasp_id,
                    joints_rad,
                    contacts,
                    stable: truth.stable,
                    object: truth.object,
                    class: truth.class,
                }),
                (Some((_, _, fault)), Some(truth)) => {
                    exclude(fault.word());
                    if fault == Fault::NoContact {
                        self.unfelt.push((truth.object, truth.class, truth.stable));
                    }
                }
            }
        }
        Ok(())
    }
}
