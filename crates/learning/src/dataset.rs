//! Recordings as data sets: a recording's grasps one by one, with the truth where it is known.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use blindgrasp_messages::{GraspTruth, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingError, RecordingReader};
use blindgrasp_stages::hand::{Hand, HandError};
use blindgrasp_stages::label::Label;

/// Metadata in which a recording says what its simulation did.
pub const REPORT_METADATA: &str = "simulation";

/// Metadata in which a recording of a graph says what stable means in its truth, where that is known: `label` is a
/// [`Label`]'s word.
pub const TRUTH_METADATA: &str = "truth";

/// One grasp of a recording, reduced to what the caller wants of its frames.
#[derive(Debug, Clone)]
pub struct Grasp<T> {
    /// Its number in the recording.
    pub grasp_id: u64,
    /// What the caller made of its frames.
    pub value: T,
    /// What it really was, where the recording says.
    pub truth: Option<GraspTruth>,
}

/// Why a recording is no data set.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// It cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// No hand for it.
    #[error(transparent)]
    Hand(#[from] HandError),
    /// It can be read but not used.
    #[error("recording {}: {message}", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
        /// What was found, what was expected.
        message: String,
    },
}

/// The hand to read `recording` with: `hand` if given, else the built-in one of the recording's hand's name.
///
/// # Errors
/// A hand that cannot be read, or is not the recording's.
pub fn hand_of(recording: &Path, hand: Option<&Path>) -> Result<Hand, DatasetError> {
    let reader = RecordingReader::open(recording)?;
    let unusable = |message| DatasetError::Unusable { path: recording.into(), message };
    let info = reader.info();
    let hand = match hand {
        Some(path) => Hand::load(path)?,
        None => Hand::load(Path::new(&info.hand)).map_err(|_| {
            unusable(format!("it was made with the hand '{}': name its pad layout with --hand", info.hand))
        })?,
    };
    check_hand(recording, &reader, &hand)?;
    Ok(hand)
}

/// What stable means in the truth of a simulated recording, or of a graph's whose truth a simulation made; `None` if none
/// did.
///
/// # Errors
/// It names a label that is not known.
pub fn label_of(path: &Path, reader: &RecordingReader) -> Result<Option<Label>, DatasetError> {
    /// All that is asked of a report, whatever version wrote it.
    #[derive(Deserialize)]
    struct Report {
        #[serde(default)]
        label: Label,
    }
    let unknown = |found: &dyn std::fmt::Display| DatasetError::Unusable {
        path: path.into(),
        message: format!("what stable means in it is not known: {found}"),
    };
    if let Some(word) = reader.metadata(TRUTH_METADATA).and_then(|metadata| metadata.get("label")) {
        let label = Label::ALL.into_iter().find(|label| label.word() == word);
        let expected = Label::ALL.map(Label::word).join(" or ");
        return label.map(Some).ok_or_else(|| unknown(&format!("its label is '{word}', expected {expected}")));
    }
    let Some(report) = reader.metadata(REPORT_METADATA).and_then(|metadata| metadata.get("report")) else {
        return Ok(None);
    };
    match serde_json::from_str::<Report>(report) {
        Ok(report) => Ok(Some(report.label)),
        Err(error) => Err(unknown(&format!("the report of its simulation has {error}"))),
    }
}

/// In how many of the simulated ones among recordings stable means what.
///
/// # Errors
/// A recording that cannot be read.
pub fn labels_of(recordings: &[PathBuf]) -> Result<BTreeMap<Label, usize>, DatasetError> {
    let mut labels = BTreeMap::new();
    for path in recordings {
        if let Some(label) = label_of(path, &RecordingReader::open(path)?)? {
            *labels.entry(label).or_default() += 1;
        }
    }
    Ok(labels)
}

/// What stable means in recordings, for people; `None` unless it means a lift in any.
pub fn label_line(labels: &BTreeMap<Label, usize>) -> Option<String> {
    labels.get(&Label::Lift)?;
    if labels.len() == 1 {
        return Some(Label::Lift.meaning().into());
    }
    let counts: Vec<String> = labels.iter().map(|(label, n)| format!("{} in {n}", label.word())).collect();
    Some(format!("mixed: {} of the simulated recordings", counts.join(", ")))
}

/// Reads a recording's grasps in order, `reduce`ing the frames of each when it is complete, so that memory holds the
/// frames of one grasp at a time.
///
/// # Errors
/// A recording that cannot be read, was made with another hand, in which a grasp's frames are torn apart, or with two
/// truths for a grasp.
pub fn read_grasps<T>(
    path: &Path,
    hand: &Hand,
    mut reduce: impl FnMut(u64, Vec<Stamped<TactileFrame>>) -> T,
) -> Result<Vec<Grasp<T>>, DatasetError> {
    let unusable = |message: String| DatasetError::Unusable { path: path.into(), message };
    let reader = RecordingReader::open(path)?;
    check_hand(path, &reader, hand)?;
    let mut grasps: Vec<Grasp<T>> = Vec::new();
    let mut seen = BTreeSet::new();
    let mut truths = BTreeMap::new();
    let mut frames: Vec<Stamped<TactileFrame>> = Vec::new();
    let mut finish = |frames: Vec<Stamped<TactileFrame>>, grasps: &mut Vec<Grasp<T>>| {
        if let Some(first) = frames.first() {
            let grasp_id = first.message.grasp_id;
            grasps.push(Grasp { grasp_id, value: reduce(grasp_id, frames), truth: None });
        }
    };
    for record in reader {
        match record?.1 {
            Record::Tactile(frame) => {
                let grasp_id = frame.message.grasp_id;
                if frames.last().is_none_or(|last| last.message.grasp_id != grasp_id) {
                    finish(std::mem::take(&mut frames), &mut grasps);
                    if !seen.insert(grasp_id) {
                        return Err(unusable(format!("the frames of grasp {grasp_id} are torn apart by another's")));
                    }
                }
                frames.push(frame);
            }
            Record::Truth(truth) => {
                let grasp_id = truth.message.grasp_id;
                if truths.insert(grasp_id, truth.message).is_some() {
                    return Err(unusable(format!("grasp {grasp_id} has two truths")));
                }
            }
            _ => {}
        }
    }
    finish(frames, &mut grasps);
    for grasp in &mut grasps {
        grasp.truth = truths.remove(&grasp.grasp_id);
    }
    Ok(grasps)
}

fn check_hand(path: &Path, reader: &RecordingReader, hand: &Hand) -> Result<(), DatasetError> {
    let info = reader.info();
    if info.hand_id != 0 && info.hand_id != hand.id() {
        return Err(DatasetError::Unusable {
            path: path.into(),
            message: format!(
                "it was made with the hand '{}' ({:016x}), not with '{}' ({:016x})",
                info.hand,
                info.hand_id,
                hand.name,
                hand.id()
            ),
        });
    }
    Ok(())
}
