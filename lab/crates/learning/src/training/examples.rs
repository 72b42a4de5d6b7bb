//! The grasps of recordings as examples to learn from.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::TrainingError;
use crate::file_name;
use blindgrasp_grasps::dataset::{DatasetError, Grasp, check_once, label_of, read_grasps};
use blindgrasp_grasps::reading::{Felt, SeenReadings, Settled, check_classes, note_reading};
use blindgrasp_messages::{Contact, Fault, GraspTruth, OwnedSenses, Phase, Stamped, TactileFrame};
use blindgrasp_recording::RecordingReader;
use blindgrasp_stages::encoder::{FeltReading, wrist_values};
use blindgrasp_stages::glitches::without_glitches;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::training_summary::{ReadingId, TrainedOn};

/// A grasp to learn from: its first settled frame and its label.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Example {
    /// Index of its recording in the list it was read from.
    pub recording_idx: usize,
    /// Its number in that recording.
    pub grasp_id: u64,
    pub reading_id: ReadingId,
    /// The number of its recording day; 0 if it is not known.
    pub day: u32,
    /// Radians, or metres for a joint that slides.
    pub joints: Vec<f64>,
    /// At least one.
    pub contacts: Vec<Contact>,
    pub senses: OwnedSenses,
    /// The last frame of the tight hand, and the first one after the test lift, if the recording has them.
    pub squeezed: Option<Felt>,
    pub test_lifted: Option<Felt>,
    /// The signals of each frame while the hand tightened, and while the arm lifted.
    pub moving: [Vec<Signals>; 2],
    /// Whether the grasp was stable.
    pub stable: bool,
    /// The object's name. Splits by object keep its grasps together.
    pub object: String,
    pub class: String,
}

/// The loads that a probe follows while the hand moves: the values of [`blindgrasp_stages::probe::signals`].
#[derive(Debug, Clone, PartialEq)]
pub struct Signals {
    pub pad_newtons: Vec<f64>,
    /// The load on the wrist along gravity, if both are sensed.
    pub wrist_newtons: Option<f64>,
}

impl Signals {
    fn of(hand: &Hand, frame: &Stamped<TactileFrame>) -> Signals {
        let felt = Felt::of(hand, frame);
        let mut pad_newtons = vec![0.0; hand.pads.len()];
        felt.contacts.iter().for_each(|contact| pad_newtons[contact.pad as usize] += contact.force_newtons);
        Signals { pad_newtons, wrist_newtons: wrist_values(&felt.senses.view()).ok().map(|values| values[0]) }
    }
}

/// The frames of a grasp that are learned from.
struct FeltGrasp {
    settled: Settled,
    squeezed: Option<Felt>,
    test_lifted: Option<Felt>,
    moving: [Vec<Signals>; 2],
}

impl FeltGrasp {
    /// `None` if the hand never settled.
    fn of(hand: &Hand, mut frames: Vec<Stamped<TactileFrame>>) -> Option<FeltGrasp> {
        let cells = frames.iter_mut().map(|frame| (frame.message.phase, &mut frame.message.cells_newtons));
        without_glitches(hand, cells);
        let is_of = |phase: Phase| move |frame: &&Stamped<TactileFrame>| frame.message.phase == phase;
        let squeezed = frames.iter().rev().find(is_of(Phase::Squeezed)).map(|frame| Felt::of(hand, frame));
        let test_lifted = frames.iter().find(is_of(Phase::TestLifted)).map(|frame| Felt::of(hand, frame));
        let moving = [Phase::Squeezing, Phase::TestLifting]
            .map(|phase| frames.iter().filter(is_of(phase)).map(|frame| Signals::of(hand, frame)).collect::<Vec<_>>());
        Some(FeltGrasp { settled: Settled::of(hand, &frames)?, squeezed, test_lifted, moving })
    }
}

/// The grasps of recordings to learn from, and the number of those left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Examples {
    /// The labelled grasps that some cell feels.
    pub examples: Vec<Example>,
    /// Grasps left out, by reason.
    pub n_excluded: BTreeMap<String, usize>,
    /// Labelled grasps that no cell feels, each with the index of its recording. They are always held.
    pub unfelt: Vec<(usize, GraspTruth)>,
    /// All grasps, those left out as well: the index of the recording and the number in it.
    pub grasps: BTreeSet<(usize, u64)>,
    /// The name of each recording's file.
    pub recordings: Vec<String>,
    /// The program and options that made each recording, from its metadata.
    pub made_by: Vec<String>,
    /// Number of simulated recordings for each meaning of "stable".
    pub labels: BTreeMap<Label, usize>,
}

impl Examples {
    /// Reads recordings. A grasp whose reading equals that of an earlier one is left out as a duplicate. `progress`
    /// gets the number of recordings read and their total after each one.
    ///
    /// # Errors
    /// A recording that cannot be used or is given twice, or an object of two classes.
    pub fn read(
        hand: &Hand,
        recordings: &[PathBuf],
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Examples, TrainingError> {
        check_once(recordings)?;
        let mut read = Examples::default();
        let mut seen = SeenReadings::new();
        for (recording_idx, path) in recordings.iter().enumerate() {
            read.add(hand, path, recording_idx, &mut seen)?;
            progress(recording_idx + 1, recordings.len());
        }
        read.check_classes()?;
        Ok(read)
    }

    fn add(
        &mut self,
        hand: &Hand,
        path: &Path,
        recording_idx: usize,
        seen: &mut SeenReadings,
    ) -> Result<(), TrainingError> {
        let reader = RecordingReader::open(path).map_err(DatasetError::from)?;
        if let Some(label) = label_of(path, &reader)? {
            *self.labels.entry(label).or_default() += 1;
        }
        self.recordings.push(file_name(path));
        self.made_by.push(reader.info().made_by.clone());
        let grasps = read_grasps(path, hand, |_, frames| FeltGrasp::of(hand, frames))?;
        self.add_grasps(grasps, recording_idx, seen);
        Ok(())
    }

    /// Takes grasps out of memory, each with its frames in order and what became of it. A grasp whose reading equals that
    /// of an earlier one is left out as a duplicate.
    ///
    /// # Errors
    /// An object of two classes.
    pub fn of_grasps(
        hand: &Hand,
        grasps: impl IntoIterator<Item = (Vec<Stamped<TactileFrame>>, GraspTruth)>,
    ) -> Result<Examples, TrainingError> {
        let felt = grasps.into_iter().map(|(frames, truth)| Grasp {
            grasp_id: truth.grasp_id,
            value: FeltGrasp::of(hand, frames),
            truth: Some(truth),
        });
        let mut examples = Examples::default();
        examples.add_grasps(felt, 0, &mut SeenReadings::new());
        examples.check_classes()?;
        Ok(examples)
    }

    fn add_grasps(
        &mut self,
        grasps: impl IntoIterator<Item = Grasp<Option<FeltGrasp>>>,
        recording_idx: usize,
        seen: &mut SeenReadings,
    ) {
        let mut exclude = |reason: &str| *self.n_excluded.entry(reason.into()).or_default() += 1;
        for grasp in grasps {
            let grasp_id = grasp.grasp_id;
            self.grasps.insert((recording_idx, grasp_id));
            match (grasp.value, grasp.truth) {
                (_, None) => exclude("no truth"),
                (None, _) => exclude("no settled frame"),
                (Some(FeltGrasp { settled, squeezed, test_lifted, moving }), Some(truth))
                    if settled.fault == Fault::None =>
                {
                    match note_reading(seen, settled.reading_id, recording_idx, truth.stable) {
                        Err(reason) => exclude(reason),
                        Ok(()) => self.examples.push(Example {
                            recording_idx,
                            grasp_id,
                            reading_id: settled.reading_id,
                            day: settled.day,
                            joints: settled.felt.joints,
                            contacts: settled.felt.contacts,
                            senses: settled.felt.senses,
                            squeezed,
                            test_lifted,
                            moving,
                            stable: truth.stable,
                            object: truth.object,
                            class: truth.object_class,
                        }),
                    }
                }
                (Some(FeltGrasp { settled, .. }), Some(truth)) => {
                    exclude(settled.left_out_as());
                    // Two grasps of one recording may have equal readings. In two recordings it is the same grasp.
                    let first = seen.entry(settled.reading_id).or_insert((recording_idx, truth.stable)).0;
                    if settled.fault == Fault::NoContact && first == recording_idx {
                        self.unfelt.push((recording_idx, truth));
                    }
                }
            }
        }
    }

    /// What a model has learned from that was trained on them.
    pub fn trained_on(&self) -> TrainedOn {
        TrainedOn {
            objects: self.examples.iter().map(|example| example.object.clone()).collect(),
            grasps: self.examples.iter().map(|example| example.reading_id).collect(),
        }
    }

    fn check_classes(&self) -> Result<(), TrainingError> {
        let objects = self.examples.iter().map(|example| (example.object.as_str(), example.class.as_str()));
        Ok(check_classes(objects)?)
    }
}

impl Example {
    /// The settled frame.
    pub fn reading(&self) -> FeltReading<'_> {
        FeltReading { joints: &self.joints, contacts: &self.contacts, senses: self.senses.view() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_grasps::reading::SELF_CONTACT;

    #[test]
    fn grasps_in_memory_are_the_examples_of_their_recording() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../recordings/held-out.mcap");
        let grasps = read_grasps(&path, &hand, |_, frames| frames).expect("readable");
        let labelled = grasps.into_iter().filter_map(|grasp| Some((grasp.value, grasp.truth?)));
        let of_memory = Examples::of_grasps(&hand, labelled).expect("examples");
        let of_file = Examples::read(&hand, &[path], |_, _| {}).expect("readable");
        assert_eq!(of_memory.examples, of_file.examples);
        assert_eq!((&of_memory.unfelt, &of_memory.n_excluded), (&of_file.unfelt, &of_file.n_excluded));
        assert_eq!((of_file.n_excluded["no_contact"], of_file.n_excluded[SELF_CONTACT]), (23, 14));
    }
}
