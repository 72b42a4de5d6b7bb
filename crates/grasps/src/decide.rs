//! Decisions on recorded grasps by the stages and the arbiter, as the graph makes them.

use std::collections::BTreeMap;
use std::path::Path;

use crate::dataset::{DatasetError, Grasp, read_grasps};
use blindgrasp_messages::score::is_judged;
use blindgrasp_messages::{GraspTruth, Header, LiftDecision, Phase, Prediction, Reason, Stamped, TactileFrame};
use blindgrasp_stages::Judge;
use blindgrasp_stages::training_summary::ReadingId;

/// A grasp of a recording, decided.
#[derive(Debug, Clone)]
pub struct Decided {
    pub decision: LiftDecision,
    /// Of its first settled frame.
    pub reading_id: Option<ReadingId>,
    pub truth: Option<GraspTruth>,
    /// Why it was held, and the odd readings of its frames, sentence by sentence.
    pub why: Vec<String>,
}

/// Decides every grasp of a recording in order, as a graph that begins with it. A grasp without a decision is held.
///
/// # Errors
/// The recording cannot be used.
pub fn decide(judge: &mut Judge, recording: &Path) -> Result<Vec<Decided>, DatasetError> {
    judge.reset();
    decide_recording(judge, recording)
}

/// As [`decide`], for frames that are numbered without gaps (`seq`).
pub fn decide_frames(judge: &mut Judge, frames: &[Stamped<TactileFrame>]) -> Vec<Decided> {
    judge.reset();
    let (mut decided, mut odd) = (Vec::new(), BTreeMap::new());
    for frame in frames {
        decided.extend(sample(judge, frame, &mut odd));
    }
    decided.extend(end(judge));
    decided.retain(|decided| decided.decision.action.decides());
    for Decided { decision, why, .. } in &mut decided {
        why.extend(odd.remove(&decision.grasp_id).unwrap_or_default());
    }
    decided
}

/// The decisions that come with a frame. It notes the odd readings of its grasp until now, which go on after the decision.
fn sample(judge: &mut Judge, frame: &Stamped<TactileFrame>, odd: &mut BTreeMap<u64, Vec<String>>) -> Vec<Decided> {
    let decisions = judge.sample(frame).decisions;
    if frame.message.phase.decides() {
        odd.insert(frame.message.grasp_id, judge.odd_readings());
    }
    decisions.into_iter().map(|decision| explained(judge, decision)).collect()
}

/// The decision that comes when the frames end.
fn end(judge: &mut Judge) -> Option<Decided> {
    let decision = judge.end()?;
    Some(explained(judge, decision))
}

fn explained(judge: &Judge, decision: LiftDecision) -> Decided {
    Decided { why: judge.explain(&decision), ..Decided::from(decision) }
}

impl From<LiftDecision> for Decided {
    fn from(decision: LiftDecision) -> Self {
        Decided { decision, reading_id: None, truth: None, why: Vec::new() }
    }
}

/// Whether a probability made the decision. Without agreement of the votes, no single one did.
pub fn has_probability(reason: Reason) -> bool {
    is_judged(reason) && reason != Reason::NoAgreement
}

/// As [`decide`], of a graph that has decided other recordings before.
///
/// # Errors
/// The recording cannot be used.
pub fn decide_recording(judge: &mut Judge, path: &Path) -> Result<Vec<Decided>, DatasetError> {
    judge.begin_recording();
    let (mut decisions, mut odd) = (Vec::new(), BTreeMap::new());
    let hand = judge.hand().clone();
    let grasps = read_grasps(path, &hand, |_, frames| {
        for frame in &frames {
            decisions.extend(sample(judge, frame, &mut odd));
        }
        let settled = frames.iter().map(|frame| &frame.message).find(|frame| frame.phase == Phase::Settled);
        settled.map(|frame| ReadingId::of(&frame.joints, &frame.cells_newtons))
    })?;
    decisions.extend(end(judge));
    if grasps.is_empty() {
        let message = "it holds no tactile frames to decide on".into();
        return Err(DatasetError::Unusable { path: path.into(), message });
    }
    let deciding = decisions.into_iter().filter(|decided| decided.decision.action.decides());
    let mut by_grasp: BTreeMap<u64, Decided> = deciding.map(|decided| (decided.decision.grasp_id, decided)).collect();
    let mut all = Vec::with_capacity(grasps.len());
    for Grasp { grasp_id, value, truth } in grasps {
        let mut decided = match by_grasp.remove(&grasp_id) {
            Some(decided) => decided,
            None => LiftDecision { grasp_id, ..LiftDecision::default() }.into(),
        };
        decided.why.extend(odd.remove(&grasp_id).unwrap_or_default());
        all.push(Decided { reading_id: value, truth, ..decided });
    }
    Ok(all)
}

/// A grasp decided by itself.
#[derive(Debug, Clone)]
pub struct DecidedAlone {
    /// One for each frame.
    pub predictions: Vec<Prediction>,
    /// `None` if the frames end before the decision comes.
    pub decision: Option<LiftDecision>,
    /// The index of the frame at which the decision came.
    pub decided_at: Option<usize>,
}

/// Decides a grasp by its frames as a graph would that sees no other.
pub fn decide_alone(judge: &mut Judge, frames: &[Stamped<TactileFrame>]) -> DecidedAlone {
    judge.reset();
    let mut alone = DecidedAlone { predictions: Vec::new(), decision: None, decided_at: None };
    for (idx, frame) in frames.iter().enumerate() {
        // Its first frame is the first of all.
        let header = Header { seq: idx as u64, ..frame.header };
        let judged = judge.sample(&Stamped { header, message: frame.message.clone() });
        alone.predictions.push(judged.prediction);
        if alone.decision.is_none() && !judged.decisions.is_empty() {
            (alone.decision, alone.decided_at) = (judged.decisions.into_iter().last(), Some(idx));
        }
    }
    alone
}
