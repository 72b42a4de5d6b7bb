//! The import of a robot's frames to a recording, unchanged.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Serialize;

use super::{ImportError, require_forces};
use blindgrasp_grasps::dataset::TRUTH_METADATA;
use blindgrasp_grasps::shown_hand::shown_hand;
use blindgrasp_messages::{GraspTruth, Header, LiftOutcome, Record, Recorded, Stamped, TactileFrame};
use blindgrasp_recording::{RecordingError, RecordingInfo, RecordingWriter};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;

/// Number and epoch of a grasp.
type GraspKey = (u64, u64);
/// The labels of grasps, with their own headers as far as they have any.
type Labels = BTreeMap<GraspKey, (Option<Header>, GraspTruth)>;

/// The report of an import of frames.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct FramesReport {
    pub hand: String,
    pub n_grasps: usize,
    pub n_frames: usize,
    /// Grasps whose lift has an outcome: by a frame of the phase kept or dropped, or by a label.
    pub n_kept: usize,
    pub n_dropped: usize,
    /// Different objects that the labels name.
    pub n_objects: usize,
    /// Labels and outcomes that are left out, because no frame is of their grasps.
    pub n_without_frames: usize,
    /// The senses that all frames have.
    pub senses: Vec<String>,
}

/// Writes frames, and the labels and outcomes of their grasps, to a recording at `out`. A label has its own header if it is
/// given, else stamp and epoch of its grasp's first frame. `label` says what stable means in them, if that is known. `name` says
/// where they are from. After an error there is no recording.
///
/// # Errors
/// A frame that does not fit the hand, frames of a grasp on both sides of another one, or a recording that cannot be written.
pub fn import_frames(
    name: &str,
    hand: &Hand,
    frames: &[Stamped<TactileFrame>],
    truths: &Labels,
    lifts: &[Stamped<LiftOutcome>],
    label: Option<Label>,
    out: &Path,
) -> Result<FramesReport, ImportError> {
    let refused = |message: String| ImportError::Table { path: name.into(), message };
    require_forces(hand).map_err(refused)?;
    let info = RecordingInfo {
        hand: hand.name.clone(),
        hand_id: hand.id(),
        made_by: format!("import of {name}"),
        version: env!("CARGO_PKG_VERSION").into(),
    };
    let mut recording = RecordingWriter::create(out, &info)?;
    recording.show(shown_hand(hand))?;
    let mut outcomes = BTreeMap::new();
    let mut senses: Option<BTreeSet<&'static str>> = None;
    // The header of each grasp's first frame.
    let (mut last, mut seen) = (None, BTreeMap::new());
    for frame in frames {
        let TactileFrame { grasp_id, phase, .. } = &frame.message;
        let place = format!("grasp {grasp_id}, frame {} ({})", frame.header.seq, phase.as_str());
        let key = (*grasp_id, frame.header.epoch);
        check_frame(hand, frame).map_err(|problem| refused(format!("{place}: {problem}")))?;
        if last.replace(key) != Some(key) && seen.insert(key, frame.header).is_some() {
            return Err(refused(format!(
                "{place}: frames of another grasp come before it; expected each grasp's together"
            )));
        }
        if let Some(is_kept) = phase.outcome() {
            *outcomes.entry(key).or_insert(true) &= is_kept;
        }
        let has = senses_of(&frame.message);
        senses = Some(senses.map_or(has.clone(), |known| &known & &has));
        recording.write_record(TactileFrame::TOPIC, &Record::Tactile(frame.clone()))?;
    }
    let (known, n_without_frames) = write_known(&mut recording, hand, &seen, (truths, label), lifts)?;
    outcomes.extend(known);
    recording.finish()?;
    let objects = truths.iter().filter(|(key, _)| seen.contains_key(key)).map(|(_, (_, truth))| &truth.object);
    let n_kept = outcomes.values().filter(|is_kept| **is_kept).count();
    Ok(FramesReport {
        hand: hand.name.clone(),
        n_grasps: seen.len(),
        n_frames: frames.len(),
        n_kept,
        n_dropped: outcomes.len() - n_kept,
        n_objects: objects.collect::<BTreeSet<_>>().len(),
        n_without_frames,
        senses: senses.unwrap_or_default().into_iter().map(String::from).collect(),
    })
}

/// Writes the labels and the outcomes of grasps whose first frames have these headers. Returns which lifts held (of
/// two, a drop counts), and how many labels and outcomes are of none of them.
fn write_known(
    recording: &mut RecordingWriter,
    hand: &Hand,
    seen: &BTreeMap<GraspKey, Header>,
    (truths, label): (&Labels, Option<Label>),
    lifts: &[Stamped<LiftOutcome>],
) -> Result<(BTreeMap<GraspKey, bool>, usize), RecordingError> {
    let (mut outcomes, mut n_without_frames) = (BTreeMap::new(), 0);
    if let Some(label) = label {
        recording.write_metadata(TRUTH_METADATA, BTreeMap::from([("label".into(), label.word().into())]))?;
    }
    let mut seq = 0;
    for (key, (own, truth)) in truths {
        let Some(first) = seen.get(key) else {
            n_without_frames += 1;
            continue;
        };
        if label != Some(Label::WrenchSpace) {
            outcomes.insert(*key, truth.stable);
        }
        let header = own.map_or(Header { seq, ..*first }, |own| Header { hand_id: hand.id(), ..own });
        seq += 1;
        recording.write(GraspTruth::TOPIC, &Stamped { header, message: truth.clone() })?;
    }
    for Stamped { header, message } in lifts {
        let key = (message.grasp_id, header.epoch);
        if !seen.contains_key(&key) {
            n_without_frames += 1;
            continue;
        }
        if message.lifted {
            *outcomes.entry(key).or_insert(true) &= message.held;
        }
        let header = Header { hand_id: hand.id(), ..*header };
        recording.write(LiftOutcome::TOPIC, &Stamped { header, message: message.clone() })?;
    }
    Ok((outcomes, n_without_frames))
}

/// Refuses a frame that is not of this hand, with the reason.
fn check_frame(hand: &Hand, frame: &Stamped<TactileFrame>) -> Result<(), String> {
    let TactileFrame { joints, cells_newtons, .. } = &frame.message;
    for (what, found, expected) in
        [("joints", joints.len(), hand.joints.len()), ("cells_newtons", cells_newtons.len(), hand.n_cells())]
    {
        if found != expected {
            return Err(format!("{what} has {found} numbers, the hand {} {expected}", hand.name));
        }
    }
    if frame.header.hand_id != hand.id() {
        return Err(format!("it is of another hand than {}", hand.name));
    }
    Ok(())
}

/// The senses that a frame has values of.
fn senses_of(frame: &TactileFrame) -> BTreeSet<&'static str> {
    frame.senses.view().iter().filter(|(_, values)| !values.is_empty()).map(|(sense, _)| sense.name()).collect()
}
