//! Watches whether joints and cells still work, without labels: by how their readings flicker, and by how pads and joints go
//! together in healthy grasps.
//!
//! Evidence grows over frames and grasps. Each [`SensorFault`] has a likelihood ratio: how much more probable a reading is with
//! the fault than without. The ratios of successive readings are multiplied, with a small prior at each grasp for a fault that
//! begins there. (The Shiryaev-Roberts procedure; Moustakides, Polunchenko & Tartakovsky, "A numerical approach to performance
//! analysis of quickest change-point detection procedures", Statistica Sinica 21, 2011). The priors of all faults sum to 1. If
//! each ratio is at most 1 in the mean over healthy grasps, a hand that is healthy is suspected once in [`ALARM`] grasps or less.
//!
//! Pure: no clock, no I/O. [`SensorMemory`] is the state.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::classifier::boosting::BoostedTrees;
use crate::day::GraspPlace;
use crate::hand::{Hand, Motion};
use crate::model::ModelHand;
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::{read_regular, write_whole};
use blindgrasp_messages::{Contact, Phase};

/// The format that this program writes and reads.
pub const FORMAT: &str = "blindgrasp-sensors/1";
/// Healthy grasps per false alarm, and the evidence at which a fault is reported.
pub const ALARM: f64 = 10_000.0;
/// A fault is reported until the evidence is below this: healthy grasps lower it.
pub const RELEASE: f64 = 100.0;
/// Evidence is not counted beyond this, so that a repaired hand is released within some grasps.
const MOST: f64 = 1e6;
/// Another fault is named in place of the first one if its evidence is so many times as great.
const RENAME: f64 = 100.0;
/// How probable a cell that repeats its readings reads something new: it is loose.
const LOOSE: f64 = 1e-3;
/// A joint that is farther than this from its last angle still moves.
const MOVING_RAD: f64 = 0.005;

/// A fault of joints or cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum SensorFault {
    /// A cell reads the same number again and again: dead, stuck or frozen.
    FrozenCell { pad: usize, cell: usize },
    /// All cells of a pad do.
    FrozenPad { pad: usize },
    /// A pad's gain, zero or noise is not that of healthy grasps.
    Level { pad: usize },
    /// A joint's encoder has a wrong zero.
    Encoder { joint: usize },
    /// Two pads are connected to each other's place.
    Exchanged { pads: [usize; 2] },
    /// The joint angles are not those of this grasp.
    Posture,
}

impl SensorFault {
    /// The kind of fault, for counters.
    pub fn kind(&self) -> &'static str {
        match self {
            SensorFault::FrozenCell { .. } => "frozen_cell",
            SensorFault::FrozenPad { .. } => "frozen_pad",
            SensorFault::Level { .. } => "level",
            SensorFault::Encoder { .. } => "encoder",
            SensorFault::Exchanged { .. } => "exchanged",
            SensorFault::Posture => "posture",
        }
    }

    /// The part of the hand, as the layout names it.
    pub fn part(&self, hand: &Hand) -> String {
        let pad = |idx: &usize| hand.pads.get(*idx).map_or_else(|| idx.to_string(), |pad| pad.name.clone());
        match self {
            SensorFault::FrozenCell { pad: of, cell } => format!("{}/{cell}", pad(of)),
            SensorFault::FrozenPad { pad: of } | SensorFault::Level { pad: of } => pad(of),
            SensorFault::Encoder { joint } => {
                hand.joints.get(*joint).map_or_else(|| joint.to_string(), |joint| joint.name.clone())
            }
            SensorFault::Exchanged { pads } => format!("{},{}", pad(&pads[0]), pad(&pads[1])),
            SensorFault::Posture => "joints".into(),
        }
    }

    /// The share of the prior that all faults of this kind have together.
    fn share(&self) -> f64 {
        match self {
            SensorFault::FrozenCell { .. } => 0.05,
            SensorFault::FrozenPad { .. } => 0.1,
            SensorFault::Level { .. } => 0.2,
            SensorFault::Encoder { .. } => 0.1,
            SensorFault::Exchanged { .. } => 0.4,
            SensorFault::Posture => 0.15,
        }
    }
}

/// A sentence about the fault, with the names of a hand's parts.
pub struct Described<'a>(pub SensorFault, pub &'a Hand);

impl fmt::Display for Described<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let part = self.0.part(self.1);
        match self.0 {
            SensorFault::FrozenCell { .. } => write!(f, "cell {part} repeats its reading: dead, stuck or frozen"),
            SensorFault::FrozenPad { .. } => write!(f, "pad {part} repeats its readings: dead or frozen"),
            SensorFault::Level { .. } => write!(f, "the gain, the zero or the noise of pad {part} is wrong"),
            SensorFault::Encoder { .. } => write!(f, "the encoder of joint {part} has a wrong zero"),
            SensorFault::Exchanged { .. } => write!(f, "pads {part} seem to be exchanged"),
            SensorFault::Posture => write!(f, "the joint angles do not go with the pads"),
        }
    }
}

/// How often healthy cells of a pad read the same number in two successive frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Flicker {
    /// After 0: of the cell that does so most often. Sensors that cut off their noise read 0 often.
    pub again_zero: f64,
    /// After any other number below `saturated_newtons`, also of the cell that does so most often.
    pub again: f64,
    /// All cells of the pad, by chance.
    pub again_all: f64,
    /// The greatest reading of each cell in healthy grasps. A cell at its limit repeats itself.
    pub saturated_newtons: Vec<f64>,
}

/// Tells grasps with a fault from healthy ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Detector {
    pub fault: SensorFault,
    /// The log-odds of the fault in a grasp, of two equally probable cases.
    pub trees: BoostedTrees,
    /// The likelihood ratio is this power of the odds: below 1, because grasps of an object are alike.
    pub power: f64,
}

/// The healthy hand: what `blindgrasp sensors learn` makes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorCheck {
    pub format: String,
    pub hand: ModelHand,
    /// Grasps that it has learned from, and their recordings.
    pub n_grasps: usize,
    pub recordings: Vec<String>,
    /// One for each pad.
    pub flicker: Vec<Flicker>,
    pub detectors: Vec<Detector>,
}

/// Why a sensor check could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("sensor check {}: {message}", path.display())]
pub struct SensorCheckError {
    path: PathBuf,
    message: String,
}

impl SensorCheck {
    /// Reads a check and makes sure that it is for this hand.
    ///
    /// # Errors
    /// A file that cannot be read, is no sensor check, is for another hand, or contradicts itself.
    pub fn load(path: &Path, hand: &Hand) -> Result<SensorCheck, SensorCheckError> {
        let invalid = |message: String| SensorCheckError { path: path.into(), message };
        if let Some(kind) = FileKind::at(path).filter(|kind| !matches!(kind, FileKind::Sensors | FileKind::Json)) {
            return Err(invalid(format!("expected a file of blindgrasp sensors learn, found {}", kind.description())));
        }
        let text = read_regular(path).map_err(|error| invalid(error.to_string()))?;
        let check: SensorCheck = serde_json::from_str(&text)
            .map_err(|error| invalid(format!("expected a file of blindgrasp sensors learn ({error})")))?;
        check.validate(hand).map_err(invalid)?;
        Ok(check)
    }

    /// Writes it, at once or not at all.
    ///
    /// # Errors
    /// The file could not be written.
    pub fn save(&self, path: &Path) -> Result<(), SensorCheckError> {
        let failed = |message: String| SensorCheckError { path: path.into(), message };
        let text = serde_json::to_string(self).map_err(|error| failed(error.to_string()))? + "\n";
        write_whole(path, text).map_err(|error| failed(error.to_string()))
    }

    /// Identifies its contents.
    pub fn id(&self) -> u64 {
        // A check that cannot be written has not been read either: its numbers are finite.
        let digest = Sha256::digest(serde_json::to_vec(self).unwrap_or_default());
        digest.iter().take(8).fold(0, |id, byte| (id << 8) | u64::from(*byte))
    }

    fn validate(&self, hand: &Hand) -> Result<(), String> {
        if self.format != FORMAT {
            return Err(format!("its format is '{}': expected {FORMAT}", self.format));
        }
        if self.hand.id != hand.id() {
            return Err(format!("it is for the hand '{}', this is '{}'", self.hand.name, hand.name));
        }
        if self.flicker.len() != hand.pads.len() {
            return Err(format!("{} pads: expected {}", self.flicker.len(), hand.pads.len()));
        }
        if let Some(pad) =
            self.flicker.iter().zip(&hand.pads).position(|(of, pad)| of.saturated_newtons.len() != pad.cells.len())
        {
            return Err(format!("pad {pad} has {} cells", self.flicker[pad].saturated_newtons.len()));
        }
        let share = |value: f64| value > 0.0 && value < 1.0;
        if !self.flicker.iter().all(|pad| share(pad.again_zero) && share(pad.again) && share(pad.again_all)) {
            return Err("a share of repeated readings is not between 0 and 1".into());
        }
        let n_values = n_values(hand);
        for Detector { fault, trees, power } in &self.detectors {
            if trees.n_features != n_values || !(0.0..=1.0).contains(power) {
                return Err(format!("the detector of {fault:?} does not fit the hand"));
            }
            trees.validate().map_err(|error| format!("the detector of {fault:?}: {error}"))?;
        }
        Ok(())
    }

    /// All faults that have evidence, in its order: cells, pads, detectors.
    fn faults(&self, hand: &Hand) -> impl Iterator<Item = SensorFault> {
        let cells = hand
            .pads
            .iter()
            .enumerate()
            .flat_map(|(pad, of)| (0..of.cells.len()).map(move |cell| SensorFault::FrozenCell { pad, cell }));
        let pads = (0..hand.pads.len()).map(|pad| SensorFault::FrozenPad { pad });
        cells.chain(pads).chain(self.detectors.iter().map(|detector| detector.fault))
    }

    /// Looks at the next frame, which is valid and has these contacts ([`crate::contacts::contacts_from_frame`]), and returns
    /// the most probable fault while there is enough evidence for one.
    ///
    /// * `joints`, `cells_newtons` - one per joint and cell of the hand.
    pub fn watch(
        &self,
        hand: &Hand,
        memory: &mut SensorMemory,
        (place, phase): (GraspPlace, Phase),
        (joints, cells_newtons): (&[f64], &[f64]),
        contacts: &[Contact],
    ) -> Option<SensorFault> {
        if memory.priors.len() != hand.n_cells() + hand.pads.len() + self.detectors.len() {
            *memory = SensorMemory::default();
            memory.begin(&self.faults(hand).collect::<Vec<_>>());
        }
        if memory.place != Some(place) {
            memory.place = Some(place);
            memory.before.clear();
            memory.grasp = GraspSummary::default();
            for (evidence, prior) in memory.evidence.iter_mut().zip(&memory.priors) {
                *evidence += prior;
            }
        }
        if memory.before.len() == cells_newtons.len() {
            self.compare(hand, memory, cells_newtons);
        }
        memory.before.clear();
        memory.before.extend_from_slice(cells_newtons);
        memory.grasp.add(hand, phase, joints, contacts, cells_newtons);
        if phase == Phase::Settled && !memory.grasp.is_judged {
            memory.grasp.is_judged = true;
            let mut values = Vec::with_capacity(n_values(hand));
            memory.grasp.values(hand, joints, contacts, &mut values);
            let first = hand.n_cells() + hand.pads.len();
            for (evidence, detector) in memory.evidence[first..].iter_mut().zip(&self.detectors) {
                *evidence *= libm::exp(detector.power * detector.trees.decision_value(&values));
            }
        }
        memory.evidence.iter_mut().for_each(|evidence| *evidence = evidence.min(MOST));
        let all: f64 = memory.evidence.iter().sum();
        if all < if memory.named.is_some() { RELEASE } else { ALARM } {
            memory.named = None;
            return None;
        }
        let most = memory.evidence.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).map(|(idx, _)| idx);
        // One fault may look like another as well. The first name stays unless it is clearly wrong.
        memory.named = match (memory.named, most) {
            (Some(named), Some(most)) if memory.evidence[most] < RENAME * memory.evidence[named] => Some(named),
            (_, most) => most,
        };
        memory.named.and_then(|idx| self.faults(hand).nth(idx))
    }

    /// Weighs that cells repeat their readings of the frame before, or do not.
    fn compare(&self, hand: &Hand, memory: &mut SensorMemory, cells_newtons: &[f64]) {
        let ratio =
            |repeats: bool, by_chance: f64| if repeats { (1.0 - LOOSE) / by_chance } else { LOOSE / (1.0 - by_chance) };
        for (pad_idx, (pad, flicker)) in hand.pads.iter().zip(&self.flicker).enumerate() {
            let range = pad.first_cell_idx..pad.first_cell_idx + pad.cells.len();
            let mut all_repeat = true;
            let mut is_saturated = true;
            for (idx, saturated_newtons) in range.zip(&flicker.saturated_newtons) {
                let (before, now) = (memory.before[idx], cells_newtons[idx]);
                let repeats = before == now;
                all_repeat &= repeats;
                if repeats && before >= *saturated_newtons {
                    continue;
                }
                is_saturated = false;
                memory.evidence[idx] *= ratio(repeats, if before == 0.0 { flicker.again_zero } else { flicker.again });
            }
            if !is_saturated {
                memory.evidence[hand.n_cells() + pad_idx] *= ratio(all_repeat, flicker.again_all);
            }
        }
    }
}

/// The frames so far, and the evidence that they are.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SensorMemory {
    place: Option<GraspPlace>,
    /// The cells of the frame before, in newtons; empty at the beginning of a grasp.
    before: Vec<f64>,
    grasp: GraspSummary,
    /// One per cell, pad and detector.
    evidence: Vec<f64>,
    priors: Vec<f64>,
    /// The reported fault, as an index into `evidence`.
    named: Option<usize>,
}

impl SensorMemory {
    fn begin(&mut self, faults: &[SensorFault]) {
        let n_like = |fault: &SensorFault| faults.iter().filter(|other| other.kind() == fault.kind()).count();
        self.priors = faults.iter().map(|fault| fault.share() / n_like(fault) as f64).collect();
        self.evidence = vec![0.0; faults.len()];
    }
}

/// The frames of a grasp until the hand has settled, as far as the detectors need them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GraspSummary {
    /// The joints of the last open frame, rad or m.
    open_joints: Vec<f64>,
    /// For each pad: mean, mean of squares and greatest reading of its cells in the open frames, newtons.
    open_newtons: Vec<[f64; 3]>,
    n_open: u32,
    /// Joint angles of each closing frame.
    closing_rad: Vec<Vec<f64>>,
    /// For each pad: its load in each closing frame.
    closing_newtons: Vec<Vec<f64>>,
    is_judged: bool,
}

/// Values of each pad and joint that [`GraspSummary::values`] makes.
const N_PAD_VALUES: usize = 17;
const N_JOINT_VALUES: usize = 4;
/// In place of a moment that is not known.
const NEVER: f64 = -100.0;

/// How many values a detector looks at.
pub fn n_values(hand: &Hand) -> usize {
    N_JOINT_VALUES * hand.joints.len() + N_PAD_VALUES * hand.pads.len() + hand.pads.len() * (hand.pads.len() - 1) / 2
}

/// Closing frames that are looked at. A source at 1 kHz sends more than a grasp needs.
const MAX_CLOSING: usize = 64;

impl GraspSummary {
    /// Adds a frame.
    pub fn add(&mut self, hand: &Hand, phase: Phase, joints: &[f64], contacts: &[Contact], cells_newtons: &[f64]) {
        match phase {
            Phase::Open => {
                self.open_joints = joints.to_vec();
                self.open_newtons.resize(hand.pads.len(), [0.0; 3]);
                self.n_open += 1;
                for (of, pad) in self.open_newtons.iter_mut().zip(&hand.pads) {
                    let cells = &cells_newtons[pad.first_cell_idx..][..pad.cells.len()];
                    let n = pad.cells.len().max(1) as f64;
                    let share = 1.0 / f64::from(self.n_open);
                    of[0] += share * (cells.iter().sum::<f64>() / n - of[0]);
                    of[1] += share * (cells.iter().map(|force| force * force).sum::<f64>() / n - of[1]);
                    of[2] = cells.iter().fold(of[2], |most, force| most.max(*force));
                }
            }
            Phase::Closing if self.closing_rad.len() < MAX_CLOSING => {
                self.closing_rad.push(joints.to_vec());
                self.closing_newtons.push(pad_loads(hand, contacts));
            }
            _ => {}
        }
    }

    /// When a joint stopped that is now at `value`, if it closed evenly before.
    fn stalled(&self, hand: &Hand, joint: usize, value: f64) -> f64 {
        let Some(open) = self.open_joints.get(joint) else { return NEVER };
        let so_far = || std::iter::once(*open).chain(self.closing_rad.iter().map(|joints| joints[joint]));
        let fastest = so_far()
            .zip(so_far().skip(1))
            .map(|(a, b)| (b - a).abs())
            .fold(1e-3 * hand.joints[joint].kind.per_radian(), f64::max);
        (value - open).abs() / fastest
    }

    /// The last frame in which a joint was not yet at `value`.
    fn last_moving(&self, hand: &Hand, joint: usize, value: f64) -> f64 {
        let least = MOVING_RAD * hand.joints[joint].kind.per_radian();
        let moving = |joints: &Vec<f64>| (value - joints[joint]).abs() > least;
        self.closing_rad.iter().rposition(moving).map_or(0.0, |idx| idx as f64 + 1.0)
    }

    /// Writes the values that tell a healthy grasp from others, [`n_values`] of them. Of each joint these are its angle in the
    /// settled and in the open hand, its breakaway, and when it stalled. Of each pad they are its load, contacts, greatest force,
    /// centre in the palm frame, its share of the load, and when it first felt the object. Then come when its force began to
    /// rise, by itself and after each of the two joints before it had stalled (by its speed, and by its last moving frame). The
    /// level of the open hand ends them. Of each two pads it is the distance of their centres. Moments are in closing frames.
    pub fn values(&self, hand: &Hand, joints: &[f64], contacts: &[Contact], values: &mut Vec<f64>) {
        values.clear();
        for (idx, (angle, joint)) in joints.iter().zip(&hand.joints).enumerate() {
            let breakaway =
                joint.coupling.as_ref().map_or(0.0, |coupling| angle - coupling.ratio * joints[coupling.follows_idx]);
            let open = self.open_joints.get(idx).copied();
            values.extend([*angle, open.unwrap_or(NEVER), breakaway, self.stalled(hand, idx, *angle)]);
        }
        let loads = pad_loads(hand, contacts);
        let total: f64 = loads.iter().sum();
        let mut centres = Vec::with_capacity(hand.pads.len());
        for (pad, load) in loads.iter().enumerate() {
            let of_pad = || contacts.iter().filter(|contact| contact.pad as usize == pad);
            let most = of_pad().map(|contact| contact.force_newtons).fold(0.0, f64::max);
            let centre: [f64; 3] = std::array::from_fn(|axis| {
                of_pad().map(|contact| contact.force_newtons * contact.position_m[axis]).sum::<f64>() / load.max(1e-12)
            });
            centres.push((*load > 0.0).then_some(centre));
            let n_closing = self.closing_newtons.len() as f64;
            let felt =
                self.closing_newtons.iter().position(|loads| loads[pad] > 0.0).map_or(n_closing, |idx| idx as f64);
            // The force of a link that has stopped rises evenly until the hand has settled.
            let last =
                self.closing_newtons.last().map(|loads| load - loads[pad]).filter(|rise| *rise > 0.0 && *load > 0.0);
            let began = last.map(|rise| (n_closing + 1.0 - load / rise).max(-1.0));
            let after_joint = |nth: usize| {
                let joint = joints_before(hand, hand.pads[pad].link_idx).nth(nth);
                joint.zip(began).map_or([NEVER; 2], |(joint, began)| {
                    [self.stalled(hand, joint, joints[joint]), self.last_moving(hand, joint, joints[joint])]
                        .map(|moment| began - moment)
                })
            };
            let [mean, square, greatest] = self.open_newtons.get(pad).copied().unwrap_or([NEVER; 3]);
            values.extend([*load, of_pad().count() as f64, most]);
            values.extend(centre);
            values.extend([load / total.max(1e-12), felt, began.unwrap_or(NEVER)]);
            values.extend([after_joint(0), after_joint(1)].concat());
            values.extend([mean, square.max(0.0).sqrt(), greatest, mean * mean / square.max(1e-12)]);
        }
        for (idx, a) in centres.iter().enumerate() {
            for b in &centres[idx + 1..] {
                let distance =
                    a.zip(*b).map(|(a, b)| a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt());
                values.push(distance.unwrap_or(-1.0));
            }
        }
    }
}

/// The joints that move a link and close with the hand, the nearest one first.
fn joints_before(hand: &Hand, link_idx: usize) -> impl Iterator<Item = usize> {
    let chain = std::iter::successors(Some(link_idx), |idx| hand.links[*idx].parent_idx);
    let joint = |idx: usize| match hand.links[idx].motion {
        Motion::Joint { joint_idx, .. } if !hand.joints[joint_idx].is_preshape => Some(joint_idx),
        _ => None,
    };
    chain.filter_map(joint)
}

fn pad_loads(hand: &Hand, contacts: &[Contact]) -> Vec<f64> {
    let mut loads = vec![0.0; hand.pads.len()];
    for contact in contacts {
        loads[contact.pad as usize] += contact.force_newtons;
    }
    loads
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classifier::boosting::{Tree, TreeNode};
    use crate::contacts::contacts_from_frame;

    fn hand() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    fn check(hand: &Hand) -> SensorCheck {
        let flicker = |pad: &crate::hand::Pad| Flicker {
            again_zero: 0.5,
            again: 0.02,
            again_all: 1e-5,
            saturated_newtons: vec![4.0; pad.cells.len()],
        };
        SensorCheck {
            format: FORMAT.into(),
            hand: ModelHand { name: hand.name.clone(), id: hand.id() },
            n_grasps: 1000,
            recordings: vec![],
            flicker: hand.pads.iter().map(flicker).collect(),
            detectors: vec![],
        }
    }

    /// Frames of a grasp whose cells flicker as healthy ones: 0 as often as not.
    fn healthy(hand: &Hand, grasp: u64) -> Vec<Vec<f64>> {
        let reading = |frame: u64, cell: u64| {
            let hash = (grasp * 1_000_003 + frame * 7919 + cell + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
            if hash.is_multiple_of(2) { 0.0 } else { (hash % 997) as f64 * 1e-5 }
        };
        (0..14).map(|frame| (0..hand.n_cells() as u64).map(|cell| reading(frame, cell)).collect()).collect()
    }

    fn watch(
        check: &SensorCheck,
        hand: &Hand,
        memory: &mut SensorMemory,
        grasp: u64,
        frames: &[Vec<f64>],
    ) -> Option<SensorFault> {
        let place = GraspPlace { epoch: 1, grasp_id: grasp, day: 0 };
        let mut contacts = Vec::new();
        let mut found = None;
        for cells in frames {
            let joints = vec![0.0; hand.joints.len()];
            contacts_from_frame(hand, 0, &joints, cells, &mut contacts);
            found = check.watch(hand, memory, (place, Phase::Settled), (&joints, cells), &contacts);
        }
        found
    }

    #[test]
    fn healthy_cells_are_not_suspected_and_repaired_ones_are_released() {
        let (hand, mut memory) = (hand(), SensorMemory::default());
        let check = check(&hand);
        for grasp in 0..500 {
            assert_eq!(watch(&check, &hand, &mut memory, grasp, &healthy(&hand, grasp)), None, "{grasp}");
        }
        let mut dead = healthy(&hand, 500);
        let pad = &hand.pads[2];
        let of_pad = pad.first_cell_idx..pad.first_cell_idx + pad.cells.len();
        dead.iter_mut().for_each(|cells| cells[of_pad.clone()].fill(0.0));
        assert_eq!(watch(&check, &hand, &mut memory, 500, &dead), Some(SensorFault::FrozenPad { pad: 2 }));
        let released =
            (501..600).find(|grasp| watch(&check, &hand, &mut memory, *grasp, &healthy(&hand, *grasp)).is_none());
        assert_eq!(released, Some(501));
    }

    #[test]
    fn a_dead_cell_needs_some_grasps_a_stuck_one_a_frame_or_two_and_a_saturated_one_is_none() {
        let hand = hand();
        let check = check(&hand);
        let first = |newtons: f64| {
            let mut memory = SensorMemory::default();
            (0..20).find(|grasp| {
                let mut frames = healthy(&hand, *grasp);
                frames.iter_mut().for_each(|cells| cells[30] = newtons);
                watch(&check, &hand, &mut memory, *grasp, &frames) == Some(SensorFault::FrozenCell { pad: 1, cell: 6 })
            })
        };
        assert_eq!((first(0.0), first(0.03), first(4.0)), (Some(1), Some(0), None));
    }

    #[test]
    fn evidence_survives_a_restart_and_priors_sum_to_one() {
        let hand = hand();
        let check = check(&hand);
        let mut memory = SensorMemory::default();
        watch(&check, &hand, &mut memory, 0, &healthy(&hand, 0));
        let text = serde_json::to_string(&memory).expect("written");
        assert_eq!(serde_json::from_str::<SensorMemory>(&text).expect("read"), memory);
        let all = [
            SensorFault::FrozenCell { pad: 0, cell: 0 },
            SensorFault::FrozenPad { pad: 0 },
            SensorFault::Level { pad: 0 },
            SensorFault::Encoder { joint: 0 },
            SensorFault::Exchanged { pads: [0, 1] },
            SensorFault::Posture,
        ];
        let sum: f64 = all.iter().map(SensorFault::share).sum();
        assert!((sum - 1.0).abs() < 1e-12, "{sum}");
        for fault in all {
            assert!(!Described(fault, &hand).to_string().is_empty());
        }
    }

    #[test]
    fn values_are_as_many_as_said_and_forces_begin_when_their_link_stops() {
        let hand = hand();
        let mut summary = GraspSummary::default();
        let mut contacts = Vec::new();
        let mut values = Vec::new();
        let cell = hand.pads[1].first_cell_idx;
        // Finger 1 stops at 2.5 of 4 closing frames; the force of its pad rises from then on until frame 5.
        for frame in 0..=5 {
            let moment = f64::from(frame);
            let mut joints = vec![0.0; hand.joints.len()];
            joints[4] = 0.1 * moment.min(2.5);
            let mut cells = vec![0.0; hand.n_cells()];
            cells[cell] = (moment - 2.5).max(0.0);
            contacts_from_frame(&hand, 0, &joints, &cells, &mut contacts);
            let phase = match frame {
                0 => Phase::Open,
                5 => Phase::Settled,
                _ => Phase::Closing,
            };
            summary.add(&hand, phase, &joints, &contacts, &cells);
            summary.values(&hand, &joints, &contacts, &mut values);
        }
        assert_eq!(values.len(), n_values(&hand));
        let pad = &values[N_JOINT_VALUES * hand.joints.len() + N_PAD_VALUES..][..N_PAD_VALUES];
        // Load, began, after the distal joint by its speed, after its last moving frame.
        for (found, expected) in [(pad[0], 2.5), (pad[8], 2.5), (pad[9], 0.0), (pad[10], 0.5)] {
            assert!((found - expected).abs() < 1e-9, "{expected}: {pad:?}");
        }
    }

    #[test]
    fn a_check_of_another_hand_or_shape_is_refused() {
        let hand = hand();
        let other = Hand::load(Path::new("shadow-biotac-sp")).expect("built in");
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("check.json");
        let good = check(&hand);
        good.save(&path).expect("written");
        assert_eq!(SensorCheck::load(&path, &hand).expect("read"), good);
        assert!(SensorCheck::load(&path, &other).expect_err("refused").to_string().contains("for the hand 'barrett"));
        let tree = Tree { nodes: vec![TreeNode::leaf(0.0)] };
        let trees = BoostedTrees { n_features: 3, base: 0.0, trees: vec![tree] };
        for (damaged, said) in [
            (SensorCheck { format: "x".into(), ..good.clone() }, "its format is 'x'"),
            (SensorCheck { flicker: good.flicker[1..].to_vec(), ..good.clone() }, "3 pads: expected 4"),
            (
                SensorCheck {
                    detectors: vec![Detector { fault: SensorFault::Posture, trees, power: 1.0 }],
                    ..good.clone()
                },
                "does not fit the hand",
            ),
        ] {
            damaged.save(&path).expect("written");
            let error = SensorCheck::load(&path, &hand).expect_err("refused").to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
