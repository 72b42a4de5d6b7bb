//! Recordings summed up: what their indexes say, and what their grasps are.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::dataset::{DatasetError, label_of, reported_truth};
use blindgrasp_messages::{GraspTruth, Phase, TactileFrame};
use blindgrasp_recording::{IndexedTopic, Problem, Problems, Record, RecordingError, RecordingIndex, RecordingReader};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;

/// The contents of the recordings' indexes.
#[derive(Debug, Default, Serialize)]
pub struct Overview {
    pub hand: String,
    pub made_by: BTreeSet<String>,
    pub recordings: Vec<String>,
    /// Whether the recordings were read whole.
    pub is_full: bool,
    /// `None` if an index does not say.
    pub n_samples: BTreeMap<String, Option<u64>>,
    /// The sum over all recordings, by their stamps; `None` if an index does not say and the recordings were not read.
    pub duration_secs: Option<f64>,
    pub n_file_bytes: u64,
    pub n_chunks: u64,
    pub n_compressed_bytes: u64,
    pub n_uncompressed_bytes: u64,
    /// All topics, also those of other types than blindgrasp's.
    pub topics: BTreeMap<String, IndexedTopic>,
    /// The first recording's metadata by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}

/// The summary of recordings.
#[derive(Debug, Default, Serialize)]
pub struct RecordingsSummary {
    #[serde(flatten)]
    pub overview: Overview,
    pub n_grasps: usize,
    pub n_with_truth: usize,
    pub n_stable: usize,
    /// Grasps whose epsilon is known.
    pub n_with_quality: usize,
    pub n_force_closure: usize,
    pub n_settled: usize,
    pub n_without_contact: usize,
    pub n_self_collisions: usize,
    /// Frames of other hands than the one that sums up.
    pub n_frames_of_other_hands: u64,
    /// Quantiles at 5, 25, 50, 75 and 95 % over the grasps with force closure.
    pub epsilon_quantiles: Option<[f64; 5]>,
    pub volume_quantiles: Option<[f64; 5]>,
    pub pads: BTreeMap<String, PadSummary>,
    pub classes: BTreeMap<String, Group>,
    pub objects: BTreeMap<String, Group>,
    /// The definitions of stable in the simulated recordings.
    pub labels: BTreeSet<Label>,
    pub problems: Vec<FoundProblem>,
}

/// A problem in a recording.
#[derive(Debug, Serialize)]
pub struct FoundProblem {
    pub recording: String,
    #[serde(flatten)]
    pub problem: Problem,
    pub message: String,
}

/// The touch of a pad.
#[derive(Debug, Default, Serialize)]
pub struct PadSummary {
    /// Grasps in which the pad has a contact.
    pub n_grasps: usize,
    /// Active cells in these grasps.
    pub n_contacts: usize,
}

/// Grasps of one object or class.
#[derive(Debug, Default, Serialize)]
pub struct Group {
    pub n_grasps: usize,
    pub n_stable: usize,
}

/// The sums over recordings that the summary is made of.
#[derive(Default)]
struct Sums {
    n_samples: BTreeMap<String, u64>,
    read_secs: f64,
    /// Epsilon and volume of the grasps with force closure.
    qualities: Vec<(f64, f64)>,
}

impl Overview {
    /// The sums over recordings, with the hand and the metadata of the first.
    ///
    /// # Errors
    /// A recording has no index that can be read.
    pub fn of(recordings: &[PathBuf]) -> Result<Self, RecordingError> {
        let mut overview = Overview { duration_secs: Some(0.0), ..Overview::default() };
        for (idx, path) in recordings.iter().enumerate() {
            let index = RecordingIndex::open(path)?;
            overview.recordings.push(path.display().to_string());
            let secs = index.duration_nanos().map(|nanos| nanos as f64 / 1e9);
            overview.duration_secs = overview.duration_secs.zip(secs).map(|(sum, more)| sum + more);
            overview.n_file_bytes += index.n_file_bytes;
            overview.n_chunks += index.n_chunks;
            overview.n_compressed_bytes = overview.n_compressed_bytes.saturating_add(index.n_compressed_bytes);
            overview.n_uncompressed_bytes = overview.n_uncompressed_bytes.saturating_add(index.n_uncompressed_bytes);
            overview.made_by.insert(index.info.made_by);
            if idx == 0 {
                overview.hand = index.info.hand;
                overview.metadata = index.metadata;
            }
            for (name, topic) in index.topics {
                if topic.is_ours {
                    let n_samples = overview.n_samples.entry(name.clone()).or_insert(Some(0));
                    *n_samples = added(*n_samples, topic.n_messages);
                }
                match overview.topics.get_mut(&name) {
                    Some(known) => known.n_messages = added(known.n_messages, topic.n_messages),
                    None => {
                        overview.topics.insert(name, topic);
                    }
                }
            }
        }
        Ok(overview)
    }
}

fn added(sum: Option<u64>, more: Option<u64>) -> Option<u64> {
    Some(sum?.saturating_add(more?))
}

impl RecordingsSummary {
    /// Reads recordings of a hand, whose indexes say `overview`.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn read(hand: &Hand, recordings: &[PathBuf], overview: Overview) -> Result<Self, DatasetError> {
        let overview = Overview { hand: hand.name.clone(), is_full: true, ..overview };
        let mut summary = RecordingsSummary { overview, ..RecordingsSummary::default() };
        for pad in &hand.pads {
            summary.pads.insert(pad.name.clone(), PadSummary::default());
        }
        let mut sums = Sums::default();
        for path in recordings {
            summary.add(hand, path, &mut sums)?;
        }
        let Sums { n_samples, read_secs, qualities } = sums;
        summary.overview.n_samples = n_samples.into_iter().map(|(topic, n)| (topic, Some(n))).collect();
        summary.overview.duration_secs.get_or_insert(read_secs);
        summary.n_force_closure = qualities.len();
        summary.epsilon_quantiles = quantiles(qualities.iter().map(|(epsilon, _)| *epsilon).collect());
        summary.volume_quantiles = quantiles(qualities.iter().map(|(_, volume)| *volume).collect());
        Ok(summary)
    }

    /// Reads a recording.
    fn add(&mut self, hand: &Hand, path: &Path, sums: &mut Sums) -> Result<(), DatasetError> {
        let reader = RecordingReader::open(path)?;
        self.labels.extend(label_of(path, &reader)?);
        let mut last: Option<TactileFrame> = None;
        // The outcomes of lifts that frames report, for grasps without a label; and the labels, of which a drop is the last.
        let mut reported = BTreeMap::new();
        let mut labels: BTreeMap<u64, GraspTruth> = BTreeMap::new();
        let mut seen = BTreeSet::new();
        let mut problems = Problems::default();
        let mut stamps_nanos: Option<(u64, u64)> = None;
        for record in reader {
            let (topic, record) = record?;
            problems.add(&topic, &record);
            let stamp_nanos = record.header().stamp_nanos;
            let (begin, end) = stamps_nanos.unwrap_or((stamp_nanos, stamp_nanos));
            stamps_nanos = Some((begin.min(stamp_nanos), end.max(stamp_nanos)));
            *sums.n_samples.entry(topic).or_default() += 1;
            match record {
                Record::Tactile(frame) => {
                    // 0 stands for an unknown hand.
                    let is_of_other = ![0, hand.id()].contains(&frame.header.hand_id);
                    self.n_frames_of_other_hands += u64::from(is_of_other);
                    let frame = frame.message;
                    if last.as_ref().is_some_and(|last| last.grasp_id != frame.grasp_id) {
                        self.count_contacts(hand, last.take());
                    }
                    self.n_grasps += usize::from(seen.insert(frame.grasp_id));
                    if let Some(is_kept) = frame.phase.outcome() {
                        *reported.entry(frame.grasp_id).or_insert(true) &= is_kept;
                    }
                    if frame.phase == Phase::Settled || last.is_none() {
                        last = Some(frame);
                    }
                }
                Record::Truth(truth) => {
                    labels.insert(truth.message.grasp_id, truth.message);
                }
                _ => {}
            }
        }
        self.count_contacts(hand, last);
        let (begin, end) = stamps_nanos.unwrap_or_default();
        sums.read_secs += (end - begin) as f64 / 1e9;
        for (grasp_id, is_kept) in reported {
            labels.entry(grasp_id).or_insert_with(|| reported_truth(path, grasp_id, is_kept));
        }
        labels.values().for_each(|truth| self.count_truth(truth, &mut sums.qualities));
        self.problems.extend(problems.found().into_iter().map(|problem| FoundProblem {
            recording: path.display().to_string(),
            message: problem.to_string(),
            problem,
        }));
        Ok(())
    }

    fn count_truth(&mut self, truth: &GraspTruth, qualities: &mut Vec<(f64, f64)>) {
        self.n_with_truth += 1;
        self.n_stable += usize::from(truth.stable);
        self.n_with_quality += usize::from(!truth.epsilon.is_nan());
        if truth.epsilon > 0.0 {
            qualities.push((truth.epsilon, truth.volume));
        }
        for group in [
            self.classes.entry(truth.object_class.clone()).or_default(),
            self.objects.entry(truth.object.clone()).or_default(),
        ] {
            group.n_grasps += 1;
            group.n_stable += usize::from(truth.stable);
        }
    }

    fn count_contacts(&mut self, hand: &Hand, frame: Option<TactileFrame>) {
        let Some(frame) = frame.filter(|frame| frame.phase == Phase::Settled) else { return };
        let mut contacts = Vec::new();
        let found = contacts_from_frame(hand, 0, &frame.joints, &frame.cells_newtons, &mut contacts);
        self.n_settled += 1;
        self.n_self_collisions += usize::from(found.self_collision);
        self.n_without_contact += usize::from(contacts.is_empty());
        for (pad_idx, pad) in hand.pads.iter().enumerate() {
            let n_contacts = contacts.iter().filter(|contact| contact.pad as usize == pad_idx).count();
            if let Some(pad) = self.pads.get_mut(&pad.name) {
                pad.n_grasps += usize::from(n_contacts > 0);
                pad.n_contacts += n_contacts;
            }
        }
    }
}

fn quantiles(mut values: Vec<f64>) -> Option<[f64; 5]> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some([0.05, 0.25, 0.5, 0.75, 0.95].map(|part| values[(part * last as f64).round() as usize]))
}
