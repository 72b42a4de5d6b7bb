//! Learns the sensors of a healthy hand from its grasps, which need no labels, and tries sensor faults on recorded grasps.
//!
//! A detector learns to tell healthy grasps from the same grasps with a fault put in ([`damaged`]): boosted trees, one for each
//! part of the hand that may fail. Its power is chosen by folds of objects: see `power`.

use std::path::PathBuf;

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::file_name;
use crate::learners::booster::train_boosted;
use blindgrasp_grasps::dataset::{DatasetError, read_grasps};
use blindgrasp_messages::{Contact, Fault, Phase, TactileFrame};
use blindgrasp_simulator::tactile_sensor::gaussian;
use blindgrasp_stages::classifier::boosting::{BoostedTrees, BoostingError, BoostingParams};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::day::GraspPlace;
use blindgrasp_stages::glitches::GlitchFilter;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::ModelHand;
use blindgrasp_stages::sensors::{
    Detector, FORMAT, Flicker, GraspSummary, SensorCheck, SensorFault, SensorMemory, n_values,
};

/// The fewest grasps that a check is learned from.
pub const MIN_GRASPS: usize = 200;
const N_FOLDS: usize = 4;
/// A cell's share of repeated readings is its own from so many pairs of frames on.
const MIN_PAIRS: f64 = 500.0;
/// A detector must not suspect healthy grasps of one object, one after the other, in so many grasps.
const RUN_GRASPS: f64 = 10.0;

/// Why sensors could not be learned.
#[derive(Debug, thiserror::Error)]
pub enum SensorsError {
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    #[error(transparent)]
    Boosting(#[from] BoostingError),
    #[error("{0} grasps with a settled frame: expected at least {MIN_GRASPS} of the healthy hand, of several objects")]
    TooFew(usize),
}

/// A frame, as far as the check looks at it.
#[derive(Debug, Clone)]
pub struct Frame {
    pub phase: Phase,
    pub joints: Vec<f64>,
    pub cells_newtons: Vec<f64>,
}

/// The frames of a grasp, up to the decision.
#[derive(Debug, Clone)]
pub struct SensorGrasp {
    pub grasp_id: u64,
    /// Grasps of one object are in one fold. Empty if nobody says.
    pub object: String,
    pub frames: Vec<Frame>,
    pub stable: Option<bool>,
}

/// Reads the grasps of recordings. Frames that the contacts stage refuses are left out, as in a graph.
///
/// # Errors
/// A recording that cannot be read.
pub fn read(hand: &Hand, recordings: &[PathBuf]) -> Result<Vec<SensorGrasp>, DatasetError> {
    let mut all = Vec::new();
    for path in recordings {
        let grasps = read_grasps(path, hand, |_, frames| {
            let of = |message: TactileFrame| Frame {
                phase: message.phase,
                joints: message.joints,
                cells_newtons: message.cells_newtons,
            };
            let frames = frames.into_iter().map(|frame| of(frame.message));
            frames.filter(|frame| !frame.phase.is_over() && is_valid(hand, frame)).collect::<Vec<_>>()
        })?;
        all.extend(grasps.into_iter().map(|grasp| SensorGrasp {
            grasp_id: grasp.grasp_id,
            object: grasp.truth.as_ref().map(|truth| truth.object.clone()).unwrap_or_default(),
            stable: grasp.truth.map(|truth| truth.stable),
            frames: grasp.value,
        }));
    }
    Ok(all)
}

fn is_valid(hand: &Hand, frame: &Frame) -> bool {
    let summary = contacts_from_frame(hand, 0, &frame.joints, &frame.cells_newtons, &mut Vec::new());
    matches!(summary.fault, Fault::None | Fault::NoContact)
}

/// What goes wrong with a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Damage {
    /// A cell reads one number only.
    StuckCell { pad: usize, cell: usize, newtons: f64 },
    /// A pad reads what it read first.
    FrozenPad { pad: usize },
    /// A pad reads so many times the force.
    Gain { pad: usize, factor: f64 },
    /// A pad reads so much more than the force.
    Offset { pad: usize, newtons: f64 },
    /// More noise, of this standard deviation, is added to a pad's cells.
    Noise { pad: usize, newtons: f64 },
    /// An encoder reads so much more than the angle.
    Encoder { joint: usize, radians: f64 },
    /// The connectors of two pads of as many cells are exchanged.
    Exchanged { pads: [usize; 2] },
    /// The joint angles are those of another grasp.
    Posture,
}

/// The same grasp as a damaged hand would have felt it. `other` is the grasp that [`Damage::Posture`] takes the joints of.
pub fn damaged(
    hand: &Hand,
    grasp: &SensorGrasp,
    damage: Damage,
    other: &SensorGrasp,
    random: &mut impl Rng,
) -> SensorGrasp {
    let mut grasp = grasp.clone();
    let cells_of =
        |pad: usize| hand.pads[pad].first_cell_idx..hand.pads[pad].first_cell_idx + hand.pads[pad].cells.len();
    let first = grasp.frames.first().map(|frame| frame.cells_newtons.clone()).unwrap_or_default();
    for (idx, frame) in grasp.frames.iter_mut().enumerate() {
        let cells = &mut frame.cells_newtons;
        match damage {
            Damage::StuckCell { pad, cell, newtons } => cells[cells_of(pad).start + cell] = newtons,
            Damage::FrozenPad { pad } => cells[cells_of(pad)].copy_from_slice(&first[cells_of(pad)]),
            Damage::Gain { pad, factor } => cells[cells_of(pad)].iter_mut().for_each(|force| *force *= factor),
            Damage::Offset { pad, newtons } => cells[cells_of(pad)].iter_mut().for_each(|force| *force += newtons),
            Damage::Noise { pad, newtons } => {
                cells[cells_of(pad)]
                    .iter_mut()
                    .for_each(|force| *force = (*force + newtons * gaussian(random)).max(0.0));
            }
            Damage::Encoder { joint, radians } => frame.joints[joint] += radians,
            Damage::Exchanged { pads: [a, b] } => cells_of(a).zip(cells_of(b)).for_each(|(a, b)| cells.swap(a, b)),
            Damage::Posture => {
                // The same moment of the other grasp, as far as it has one.
                let of_phase = |of: &&Frame| of.phase == frame.phase;
                let same = other.frames.get(idx).filter(of_phase).or_else(|| other.frames.iter().find(of_phase));
                if let Some(found) = same {
                    frame.joints.clone_from(&found.joints);
                }
            }
        }
    }
    grasp
}

/// The grasp's values for detectors, if it settles.
fn values(hand: &Hand, grasp: &SensorGrasp) -> Option<Vec<f64>> {
    let mut summary = GraspSummary::default();
    let mut contacts: Vec<Contact> = Vec::new();
    let mut filter = GlitchFilter::default();
    for frame in &grasp.frames {
        let steady = filter.steady(hand, (0, 0), frame.phase, &frame.cells_newtons);
        contacts_from_frame(hand, 0, &frame.joints, steady, &mut contacts);
        summary.add(hand, frame.phase, &frame.joints, &contacts, &frame.cells_newtons);
        if frame.phase == Phase::Settled {
            let mut values = Vec::new();
            summary.values(hand, &frame.joints, &contacts, &mut values);
            return Some(values);
        }
    }
    None
}

/// The faults that detectors are trained for.
fn trained_faults(hand: &Hand) -> Vec<SensorFault> {
    let n_pads = hand.pads.len();
    let mut faults = vec![SensorFault::Posture];
    for pad in 0..n_pads {
        faults.push(SensorFault::Level { pad });
        let alike = (pad + 1..n_pads).filter(|other| hand.pads[*other].cells.len() == hand.pads[pad].cells.len());
        faults.extend(alike.map(|other| SensorFault::Exchanged { pads: [pad, other] }));
    }
    faults.extend((0..hand.joints.len()).map(|joint| SensorFault::Encoder { joint }));
    faults
}

/// A damage of any strength that the fault stands for: the logarithm of the strength is uniform.
fn drawn(fault: SensorFault, noise_newtons: f64, random: &mut impl Rng) -> Damage {
    let mut between = |least: f64, most: f64| (least.ln() + random.random::<f64>() * (most / least).ln()).exp();
    let (factor, radians) = (between(1.4, 4.0), between(0.02, 0.2));
    let (offset, noise) = (noise_newtons * between(2.0, 40.0), noise_newtons * between(1.5, 5.0));
    let is_up: bool = random.random();
    match fault {
        SensorFault::FrozenCell { pad, cell } => Damage::StuckCell { pad, cell, newtons: 0.0 },
        SensorFault::FrozenPad { pad } => Damage::FrozenPad { pad },
        SensorFault::Level { pad } => match random.random_range(0..3) {
            0 => Damage::Gain { pad, factor: if is_up { factor } else { 1.0 / factor } },
            1 => Damage::Offset { pad, newtons: offset },
            _ => Damage::Noise { pad, newtons: noise },
        },
        SensorFault::Encoder { joint } => Damage::Encoder { joint, radians: if is_up { radians } else { -radians } },
        SensorFault::Exchanged { pads } => Damage::Exchanged { pads },
        SensorFault::Posture => Damage::Posture,
    }
}

/// Pads and joints that do not belong together show in many small ways, the other faults in one or two values.
fn boosting(fault: SensorFault) -> BoostingParams {
    let (n_rounds, learning_rate, max_depth) = match fault {
        SensorFault::Exchanged { .. } | SensorFault::Posture => (200, 0.1, 6),
        _ => (60, 0.2, 4),
    };
    let shares = BoostingParams { subsample: 0.7, colsample_bynode: 0.5, ..BoostingParams::default() };
    BoostingParams { n_rounds, learning_rate, max_depth, ..shares }
}

/// Learns a check from grasps of the healthy hand. `progress` gets the number of detectors learned and their total.
///
/// # Errors
/// Too few grasps.
pub fn learn(
    hand: &Hand,
    grasps: &[SensorGrasp],
    recordings: &[PathBuf],
    seed: u64,
    mut progress: impl FnMut(usize, usize),
) -> Result<SensorCheck, SensorsError> {
    let settled: Vec<(&SensorGrasp, Vec<f64>)> =
        grasps.iter().filter_map(|grasp| values(hand, grasp).map(|values| (grasp, values))).collect();
    if settled.len() < MIN_GRASPS {
        return Err(SensorsError::TooFew(settled.len()));
    }
    let noise_newtons = noise(grasps);
    let objects: Vec<usize> = numbered(settled.iter().map(|(grasp, _)| grasp.object.as_str()));
    let faults = trained_faults(hand);
    let mut detectors = Vec::new();
    for (idx, fault) in faults.iter().enumerate() {
        let mut random = ChaCha8Rng::seed_from_u64(seed ^ (idx as u64) << 32);
        let mut sick = Vec::with_capacity(settled.len());
        for (grasp, healthy) in &settled {
            let other = settled[random.random_range(0..settled.len())].0;
            let damage = drawn(*fault, noise_newtons, &mut random);
            let changed = damaged(hand, grasp, damage, other, &mut random);
            sick.push(values(hand, &changed).unwrap_or_else(|| healthy.clone()));
        }
        let healthy: Vec<&[f64]> = settled.iter().map(|(_, values)| &values[..]).collect();
        let sick: Vec<&[f64]> = sick.iter().map(Vec::as_slice).collect();
        let mut held_out = vec![0.0; healthy.len()];
        for fold in 0..N_FOLDS {
            let is_of = |at: usize| objects[at] % N_FOLDS == fold;
            let others = |rows: &[&[f64]]| {
                (0..rows.len()).filter(|at| !is_of(*at)).flat_map(|at| rows[at].to_vec()).collect::<Vec<_>>()
            };
            let trees = grow(&boosting(*fault), n_values(hand), [&others(&healthy), &others(&sick)], seed)?;
            (0..healthy.len()).filter(|at| is_of(*at)).for_each(|at| held_out[at] = trees.decision_value(healthy[at]));
        }
        let trees = grow(&boosting(*fault), n_values(hand), [&healthy.concat(), &sick.concat()], seed)?;
        let power = power(&held_out, &objects);
        if power > 0.0 {
            detectors.push(Detector { fault: *fault, trees, power });
        }
        progress(idx + 1, faults.len());
    }
    Ok(SensorCheck {
        format: FORMAT.into(),
        hand: ModelHand { name: hand.name.clone(), id: hand.id() },
        n_grasps: settled.len(),
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
        flicker: flicker(hand, grasps),
        detectors,
    })
}

fn grow(
    params: &BoostingParams,
    n_values: usize,
    [healthy, sick]: [&[f64]; 2],
    seed: u64,
) -> Result<BoostedTrees, BoostingError> {
    let n = healthy.len() / n_values;
    let targets: Vec<f64> = (0..2 * n).map(|idx| f64::from(u8::from(idx >= n))).collect();
    train_boosted(&[healthy, sick].concat(), n_values, &targets, params, seed)
}

/// A number for each name, in the order in which they appear; a grasp without a name is an object of its own.
fn numbered<'a>(names: impl Iterator<Item = &'a str>) -> Vec<usize> {
    let mut known = std::collections::BTreeMap::new();
    let mut n = 0;
    let mut next = || {
        n += 1;
        n - 1
    };
    names.map(|name| if name.is_empty() { next() } else { *known.entry(name).or_insert_with(&mut next) }).collect()
}

/// The greatest power of the odds, in tenths, whose mean over healthy grasps is at most 1, and whose product over
/// [`RUN_GRASPS`] grasps of one object is at most 1 in the mean over objects. `log_odds` are of grasps that the trees have not
/// seen; 0 if there is no such power.
fn power(log_odds: &[f64], objects: &[usize]) -> f64 {
    let n_objects = objects.iter().max().map_or(0, |most| most + 1);
    let mut sums = vec![(0.0, 0.0); n_objects];
    for (log_odds, object) in log_odds.iter().zip(objects) {
        sums[*object] = (sums[*object].0 + log_odds, sums[*object].1 + 1.0);
    }
    let is_fair = |power: f64| {
        let by_grasp = log_odds.iter().map(|l| (power * l).exp()).sum::<f64>() / log_odds.len() as f64;
        let run = |(sum, n): &(f64, f64)| (power * sum / n * n.min(RUN_GRASPS)).exp();
        let by_object = sums.iter().filter(|(_, n)| *n > 0.0).map(run).sum::<f64>() / n_objects as f64;
        by_grasp <= 1.0 && by_object <= 1.0
    };
    (1..=10).rev().map(|tenths| f64::from(tenths) / 10.0).find(|power| is_fair(*power)).unwrap_or(0.0)
}

/// Standard deviation of the noise: of readings of the open hand that are cut off at 0.
fn noise(grasps: &[SensorGrasp]) -> f64 {
    let open = grasps.iter().flat_map(|grasp| &grasp.frames).filter(|frame| frame.phase == Phase::Open);
    let (mut sum, mut n) = (0.0, 0.0);
    for force in open.flat_map(|frame| &frame.cells_newtons) {
        (sum, n) = (sum + force * force, n + f64::from(u8::from(*force > 0.0)));
    }
    if n > 0.0 { f64::sqrt(sum / n) } else { 0.01 }
}

fn flicker(hand: &Hand, grasps: &[SensorGrasp]) -> Vec<Flicker> {
    let pairs = || grasps.iter().flat_map(|grasp| grasp.frames.windows(2));
    let most = |cell: usize| {
        let readings = grasps.iter().flat_map(|grasp| &grasp.frames).map(|frame| frame.cells_newtons[cell]);
        readings.fold(f64::MIN_POSITIVE, f64::max)
    };
    let share = |n: f64, of: f64| (n + 1.0) / (of + 2.0);
    let of_pad = |pad: &blindgrasp_stages::hand::Pad| {
        let n_cells = pad.cells.len();
        let saturated_newtons: Vec<f64> = (0..n_cells).map(|cell| most(pad.first_cell_idx + cell)).collect();
        let (mut zero, mut other) = (vec![(0.0, 0.0); n_cells], vec![(0.0, 0.0); n_cells]);
        let (mut n_all, mut n_pairs) = (0.0, 0.0);
        for pair in pairs() {
            let cells = |frame: usize| &pair[frame].cells_newtons[pad.first_cell_idx..][..n_cells];
            let mut all_repeat = true;
            for (cell, (before, now)) in cells(0).iter().zip(cells(1)).enumerate() {
                let counts = if *before == 0.0 { &mut zero[cell] } else { &mut other[cell] };
                let repeats = before == now;
                all_repeat &= repeats;
                if *before < saturated_newtons[cell] {
                    *counts = (counts.0 + f64::from(u8::from(repeats)), counts.1 + 1.0);
                }
            }
            (n_all, n_pairs) = (n_all + f64::from(u8::from(all_repeat)), n_pairs + 1.0);
        }
        // Cells that were seldom seen count with all others.
        let greatest = |counts: &[(f64, f64)]| {
            let all = counts.iter().fold((0.0, 0.0), |sum, counts| (sum.0 + counts.0, sum.1 + counts.1));
            let often = counts.iter().filter(|(_, of)| *of >= MIN_PAIRS);
            often.chain([&all]).map(|(n, of)| share(*n, *of)).fold(0.0, f64::max)
        };
        Flicker {
            again_zero: greatest(&zero),
            again: greatest(&other),
            again_all: share(n_all, n_pairs),
            saturated_newtons,
        }
    };
    hand.pads.iter().map(of_pad).collect()
}

/// For each grasp, in their order, the fault that a check reports in it.
pub fn alarms(check: &SensorCheck, hand: &Hand, grasps: &[SensorGrasp]) -> Vec<Option<SensorFault>> {
    let mut memory = SensorMemory::default();
    let mut contacts = Vec::new();
    let mut of_grasp = |(number, grasp): (usize, &SensorGrasp)| {
        let place = GraspPlace { epoch: 0, grasp_id: number as u64, day: 0 };
        let mut found = None;
        let mut filter = GlitchFilter::default();
        for frame in &grasp.frames {
            let readings = (&frame.joints[..], &frame.cells_newtons[..]);
            let steady = filter.steady(hand, (0, 0), frame.phase, readings.1);
            let summary = contacts_from_frame(hand, 0, readings.0, steady, &mut contacts);
            // An encoder that was damaged may read beyond its joint's stops: the contacts stage refuses the frame.
            if matches!(summary.fault, Fault::None | Fault::NoContact) {
                found = check.watch(hand, &mut memory, (place, frame.phase), readings, &contacts).or(found);
            }
        }
        found
    };
    grasps.iter().enumerate().map(&mut of_grasp).collect()
}
