//! Recordings as data sets: a recording's grasps one by one, with their labels.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use blindgrasp_messages::{GraspTruth, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingError, RecordingReader, ShownHand, attachments};
use blindgrasp_stages::OtherHand;
use blindgrasp_stages::hand::{Hand, HandError};
use blindgrasp_stages::label::Label;

/// Metadata with the report of the simulation that made a recording.
pub const REPORT_METADATA: &str = "simulation";

/// Metadata with the definition of stable in a recording of a graph: `label` is a [`Label`]'s word.
pub const TRUTH_METADATA: &str = "truth";

/// One grasp of a recording, its frames reduced to a value.
#[derive(Debug, Clone)]
pub struct Grasp<T> {
    pub grasp_id: u64,
    /// The value that the caller made of its frames.
    pub value: T,
    /// Its label, if the recording has one.
    pub truth: Option<GraspTruth>,
}

#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Hand(#[from] HandError),
    #[error(transparent)]
    OtherHand(#[from] OtherHand),
    #[error("no recording is named: expected at least one")]
    NoRecording,
    #[error("recording {}: {message}", path.display())]
    Unusable { path: PathBuf, message: String },
    #[error(
        "the object '{object}' is of class '{known}' in one grasp and '{class}' in another: expected one name for one object"
    )]
    Classes { object: String, known: String, class: String },
}

/// Refuses a recording that is given twice: its grasps would count twice.
///
/// # Errors
/// It names the recording.
pub fn check_once(recordings: &[PathBuf]) -> Result<(), DatasetError> {
    let mut canonical = BTreeSet::new();
    for path in recordings {
        if !canonical.insert(path.canonicalize().unwrap_or(path.clone())) {
            let message = "it is given twice: its grasps would count twice".into();
            return Err(DatasetError::Unusable { path: path.clone(), message });
        }
    }
    Ok(())
}

/// The hand of `recording`: `hand` if given, else the built-in hand that the recording names, with the thresholds of the pad
/// layout that is attached to it.
///
/// # Errors
/// The hand cannot be read, or is not the recording's.
pub fn hand_of(recording: &Path, hand: Option<&Path>) -> Result<Hand, DatasetError> {
    let reader = RecordingReader::open(recording)?;
    let info = reader.info();
    let hand = match hand {
        Some(path) => Hand::load(path)?,
        None => {
            let built_in = Hand::built_in(&info.hand).ok_or_else(|| DatasetError::Unusable {
                path: recording.into(),
                message: format!("it was made with the hand '{}': name its pad layout with --hand", info.hand),
            })?;
            attached_hand(recording, &built_in).unwrap_or(built_in)
        }
    };
    check_hand(recording, &reader, &hand)?;
    Ok(hand)
}

/// The one hand of several recordings, as [`hand_of`] gives it.
///
/// # Errors
/// As those of [`hand_of`]; there is no recording, or two of them have layouts of one hand that differ, as in thresholds.
pub fn hand_of_all(recordings: &[PathBuf], hand: Option<&Path>) -> Result<Hand, DatasetError> {
    let [first, others @ ..] = recordings else { return Err(DatasetError::NoRecording) };
    let found = hand_of(first, hand)?;
    let (None, Some(built_in)) = (hand, Hand::built_in(&found.name)) else { return Ok(found) };
    for path in others {
        // One of another hand is refused when it is read.
        if RecordingReader::open(path)?.info().hand_id != found.id() {
            continue;
        }
        if !attached_hand(path, &built_in).as_ref().unwrap_or(&built_in).is_same(&found) {
            let message = format!(
                "its layout, or the built-in one, differs from that of {}: say with --hand which one counts",
                first.display()
            );
            return Err(DatasetError::Unusable { path: path.clone(), message });
        }
    }
    Ok(found)
}

/// The hand whose files are attached to a recording, if its layout is not that of the built-in hand.
fn attached_hand(recording: &Path, built_in: &Hand) -> Option<Hand> {
    let (mut layout, mut urdf) = (None, None);
    for file in attachments(recording).ok()? {
        match file.name.as_str() {
            ShownHand::LAYOUT_NAME => layout = String::from_utf8(file.data.into_owned()).ok(),
            ShownHand::URDF_NAME => urdf = String::from_utf8(file.data.into_owned()).ok(),
            _ => {}
        }
    }
    let (layout, urdf) = (layout?, urdf?);
    if layout == built_in.files()[0] {
        return None;
    }
    Hand::parse(recording, &layout, |_| Ok(urdf)).ok()
}

/// The definition of stable in a recording whose labels are by a simulation; `None` for other recordings.
///
/// # Errors
/// The recording names an unknown definition.
pub fn label_of(path: &Path, reader: &RecordingReader) -> Result<Option<Label>, DatasetError> {
    /// The one field that is read, so that reports of any version can be read.
    #[derive(Deserialize)]
    struct Report {
        #[serde(default)]
        label: Label,
    }
    let unknown = |found: &dyn std::fmt::Display| DatasetError::Unusable {
        path: path.into(),
        message: format!("its definition of stable is unknown: {found}"),
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

/// The number of simulated recordings with each definition of stable.
///
/// # Errors
/// A recording cannot be read.
pub fn labels_of(recordings: &[PathBuf]) -> Result<BTreeMap<Label, usize>, DatasetError> {
    let mut labels = BTreeMap::new();
    for path in recordings {
        if let Some(label) = label_of(path, &RecordingReader::open(path)?)? {
            *labels.entry(label).or_default() += 1;
        }
    }
    Ok(labels)
}

/// The definitions of stable in recordings, for people; `None` if no recording has labels by lifts.
pub fn label_line(labels: &BTreeMap<Label, usize>) -> Option<String> {
    labels.get(&Label::Lift)?;
    if labels.len() == 1 {
        return Some(Label::Lift.meaning().into());
    }
    let counts: Vec<String> = labels.iter().map(|(label, n)| format!("{} in {n}", label.word())).collect();
    Some(format!("mixed: {} of the simulated recordings", counts.join(", ")))
}

/// The label of a grasp whose outcome a frame reports, of the phase kept or dropped. The object is not known, so each such grasp
/// counts as one of another object. `recording` names the file.
pub fn reported_truth(recording: &Path, grasp_id: u64, is_kept: bool) -> GraspTruth {
    let name = recording.file_stem().unwrap_or_default().to_string_lossy();
    GraspTruth {
        grasp_id,
        epsilon: f64::NAN,
        volume: f64::NAN,
        stable: is_kept,
        object: format!("lift {grasp_id} of {name}"),
        object_class: "not named".into(),
    }
}

/// The outcome that the frames of a grasp report: an object that was kept may be dropped after that.
fn reported_outcome(frames: &[Stamped<TactileFrame>]) -> Option<bool> {
    frames.iter().filter_map(|frame| frame.message.phase.outcome()).reduce(|is_kept, is_still| is_kept && is_still)
}

/// Reads a recording's grasps in order. A grasp without a label has the outcome of its lift, if a frame reports it. `reduce` is
/// called with the frames of each complete grasp, so that memory holds the frames of one grasp at a time.
///
/// # Errors
/// The recording cannot be read, was made with another hand, has frames of a grasp on both sides of another grasp, or has
/// two labels for a grasp; but a drop may follow an object that was kept.
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
    for record in reader {
        match record?.1 {
            Record::Tactile(frame) => {
                let grasp_id = frame.message.grasp_id;
                if frames.last().is_none_or(|last| last.message.grasp_id != grasp_id) {
                    grasps.extend(finished(path, std::mem::take(&mut frames), &mut reduce));
                    if !seen.insert(grasp_id) {
                        return Err(unusable(format!("frames of another grasp lie between those of grasp {grasp_id}")));
                    }
                }
                frames.push(frame);
            }
            Record::Truth(truth) => {
                let (grasp_id, is_drop) = (truth.message.grasp_id, !truth.message.stable);
                if truths.insert(grasp_id, truth.message).is_some_and(|before| !(before.stable && is_drop)) {
                    return Err(unusable(format!("grasp {grasp_id} has two labels (/truth)")));
                }
            }
            _ => {}
        }
    }
    grasps.extend(finished(path, frames, &mut reduce));
    for grasp in &mut grasps {
        grasp.truth = truths.remove(&grasp.grasp_id).or(grasp.truth.take());
    }
    Ok(grasps)
}

/// The grasp of these frames, if there are any.
fn finished<T>(
    path: &Path,
    frames: Vec<Stamped<TactileFrame>>,
    reduce: &mut impl FnMut(u64, Vec<Stamped<TactileFrame>>) -> T,
) -> Option<Grasp<T>> {
    let grasp_id = frames.first()?.message.grasp_id;
    let truth = reported_outcome(&frames).map(|is_kept| reported_truth(path, grasp_id, is_kept));
    Some(Grasp { grasp_id, value: reduce(grasp_id, frames), truth })
}

fn check_hand(path: &Path, reader: &RecordingReader, hand: &Hand) -> Result<(), DatasetError> {
    let info = reader.info();
    if info.hand_id != 0 && info.hand_id != hand.id() {
        return Err(DatasetError::Unusable {
            path: path.into(),
            message: format!(
                "it was made with the hand '{}' ({:016x}), not with '{}' ({:016x}): leave --hand out, or name that hand",
                info.hand,
                info.hand_id,
                hand.name,
                hand.id()
            ),
        });
    }
    Ok(())
}
