//! Makes the recordings of the regression suite from simulated ones, for `scripts/make-recordings`.
//!
//! `fault_recordings ORDINARY.mcap SLIPPERY.mcap FOLDER` writes one recording a fault into FOLDER: some grasps of the first
//! recording (of the second for `slip-prone`), numbered anew, with what goes wrong with sensors and transports put in.

use std::path::Path;

use anyhow::{Context, bail};
use blindgrasp_messages::{GraspTruth, Phase, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingInfo, RecordingReader, RecordingWriter};
use blindgrasp_replay::faults::InjectedFault;
use blindgrasp_stages::hand::Hand;

/// Grasps in each recording.
const N_GRASPS: usize = 12;
/// Between the last frame of a grasp and the first of the next.
const PAUSE_NANOS: u64 = 100_000_000;
/// What a sensor with too small a range makes of a larger force.
const FULL_SCALE_NEWTONS: f64 = 0.5;
/// What a cell reads whose amplifier is stuck.
const STUCK_NEWTONS: f64 = 20.0;
/// Below every cell's noise threshold.
const NOISE_NEWTONS: f64 = 0.03;

#[derive(Clone)]
struct Grasp {
    frames: Vec<Stamped<TactileFrame>>,
    truth: Stamped<GraspTruth>,
    is_self_collision: bool,
}

impl Grasp {
    /// Where its settled frames begin.
    fn first_settled(&self) -> anyhow::Result<usize> {
        let first = self.frames.iter().position(|frame| frame.message.phase == Phase::Settled);
        first.with_context(|| format!("grasp {} never settles", self.truth.message.grasp_id))
    }

    fn cells(&mut self) -> impl Iterator<Item = &mut f64> {
        self.frames.iter_mut().flat_map(|frame| &mut frame.message.cells_newtons)
    }
}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [ordinary, slippery, folder] = &arguments[..] else {
        bail!("expected ORDINARY.mcap SLIPPERY.mcap FOLDER");
    };
    let hand = Hand::load(Path::new("barrett-bh8-280"))?;
    let (ordinary, slippery) = (grasps(Path::new(ordinary))?, grasps(Path::new(slippery))?);
    let touching: Vec<Grasp> = ordinary.iter().filter(|grasp| grasp.is_self_collision).cloned().collect();
    let folder = Path::new(folder);
    let write = |name: &str, hand: &Hand, grasps: &[Grasp]| {
        let made_by = format!("simulated grasps, {name}");
        let info = RecordingInfo {
            hand: hand.name.clone(),
            hand_id: hand.id(),
            made_by,
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let mut writer = RecordingWriter::create(&folder.join(format!("{name}.mcap")), &info)?;
        for grasp in grasps {
            writer.write("/truth", &grasp.truth)?;
            for frame in &grasp.frames {
                writer.write("/tactile", frame)?;
            }
        }
        writer.finish().map(drop)
    };
    write("ordinary", &hand, &chosen(&ordinary)?)?;
    write("slip-prone", &hand, &chosen(&slippery)?)?;
    write("self-collision", &hand, &chosen(&touching)?)?;
    write("dead-pad", &hand, &dead_pad(&hand, chosen(&ordinary)?)?)?;
    write("saturated-cells", &hand, &saturated_cells(chosen(&ordinary)?))?;
    write("no-contact", &hand, &no_contact(chosen(&ordinary)?))?;
    write("drop-outs", &hand, &drop_outs(chosen(&ordinary)?)?)?;
    write("out-of-order", &hand, &out_of_order(chosen(&ordinary)?)?)?;
    let other = Hand::load(Path::new("shadow-biotac-sp"))?;
    write("other-hand", &other, &of_another_hand(&other, chosen(&ordinary)?))?;
    Ok(())
}

/// All grasps of a recording.
fn grasps(path: &Path) -> anyhow::Result<Vec<Grasp>> {
    let mut grasps: Vec<Grasp> = Vec::new();
    for record in RecordingReader::open(path)? {
        match (record?.1, grasps.last_mut()) {
            (Record::Truth(truth), _) => grasps.push(Grasp { frames: Vec::new(), truth, is_self_collision: false }),
            (Record::Tactile(frame), Some(grasp)) => grasp.frames.push(frame),
            (Record::Scene(scene), Some(grasp)) => grasp.is_self_collision = scene.message.self_collision,
            _ => {}
        }
    }
    Ok(grasps)
}

/// The first grasps that the hand's fingers close on, numbered from 0, one after the other.
fn chosen(grasps: &[Grasp]) -> anyhow::Result<Vec<Grasp>> {
    let mut chosen: Vec<Grasp> = grasps.iter().take(N_GRASPS).cloned().collect();
    if chosen.len() < N_GRASPS {
        bail!("only {} grasps of the {N_GRASPS} that are needed", chosen.len());
    }
    let (mut seq, mut begins_nanos) = (0, 0);
    for (grasp_id, grasp) in (0..).zip(&mut chosen) {
        let first_nanos = grasp.frames.first().map_or(0, |frame| frame.header.stamp_nanos);
        grasp.truth.message.grasp_id = grasp_id;
        grasp.truth.header.seq = grasp_id;
        grasp.truth.header.stamp_nanos = begins_nanos;
        let mut last_nanos = begins_nanos;
        for frame in &mut grasp.frames {
            frame.message.grasp_id = grasp_id;
            last_nanos = begins_nanos + (frame.header.stamp_nanos - first_nanos);
            (frame.header.seq, frame.header.stamp_nanos) = (seq, last_nanos);
            seq += 1;
        }
        begins_nanos = last_nanos + PAUSE_NANOS;
    }
    Ok(chosen)
}

/// The cells of one finger's pad say nothing.
fn dead_pad(hand: &Hand, mut grasps: Vec<Grasp>) -> anyhow::Result<Vec<Grasp>> {
    let dead = hand.pads.iter().position(|pad| pad.name.contains('2')).context("the hand has no second finger")?;
    let is_dead: Vec<bool> = hand.cells().map(|(pad_idx, _)| pad_idx == dead).collect();
    for frame in grasps.iter_mut().flat_map(|grasp| &mut grasp.frames) {
        for (cell, _) in frame.message.cells_newtons.iter_mut().zip(&is_dead).filter(|(_, is_dead)| **is_dead) {
            *cell = 0.0;
        }
    }
    Ok(grasps)
}

/// In every second grasp forces end at the sensor's full scale; in the others one cell is stuck.
fn saturated_cells(mut grasps: Vec<Grasp>) -> Vec<Grasp> {
    for (idx, grasp) in grasps.iter_mut().enumerate() {
        if idx % 2 == 0 {
            grasp.cells().for_each(|cell| *cell = cell.min(FULL_SCALE_NEWTONS));
            continue;
        }
        for frame in &mut grasp.frames {
            frame.message.cells_newtons[5 * idx] = STUCK_NEWTONS;
        }
    }
    grasps
}

/// The hand closes on nothing.
fn no_contact(mut grasps: Vec<Grasp>) -> Vec<Grasp> {
    for grasp in &mut grasps {
        grasp.cells().for_each(|cell| *cell = cell.min(NOISE_NEWTONS));
        (grasp.truth.message.stable, grasp.truth.message.epsilon, grasp.truth.message.volume) = (false, -1.0, 0.0);
    }
    grasps
}

/// A frame is lost, all cells read nothing for a moment, a reading is NaN, a frame is cut short; every fifth grasp is whole.
fn drop_outs(mut grasps: Vec<Grasp>) -> anyhow::Result<Vec<Grasp>> {
    for (idx, grasp) in grasps.iter_mut().enumerate() {
        let settled = grasp.first_settled()?;
        match idx % 5 {
            0 => InjectedFault::LostFrame.apply(&mut grasp.frames, &[]),
            1 => InjectedFault::SilentFrame.apply(&mut grasp.frames, &[]),
            2 => grasp.frames[settled].message.cells_newtons[17] = f64::NAN,
            3 => grasp.frames[settled - 2].message.cells_newtons.truncate(90),
            _ => {}
        }
    }
    Ok(grasps)
}

/// Two frames change places, a frame comes twice, the source's clock goes back; every fourth grasp is in order.
fn out_of_order(mut grasps: Vec<Grasp>) -> anyhow::Result<Vec<Grasp>> {
    for (idx, grasp) in grasps.iter_mut().enumerate() {
        let settled = grasp.first_settled()?;
        match idx % 4 {
            0 => InjectedFault::LateFrame.apply(&mut grasp.frames, &[]),
            1 => InjectedFault::DoubledFrame.apply(&mut grasp.frames, &[]),
            2 => grasp.frames[settled].header.stamp_nanos -= 50_000_000,
            _ => {}
        }
    }
    Ok(grasps)
}

/// What another hand would send: other numbers of joints and cells, and its own identity.
fn of_another_hand(hand: &Hand, mut grasps: Vec<Grasp>) -> Vec<Grasp> {
    let n_cells = hand.n_cells();
    for grasp in &mut grasps {
        grasp.truth.header.hand_id = hand.id();
        for frame in &mut grasp.frames {
            frame.header.hand_id = hand.id();
            frame.message.joints.truncate(hand.joints.len());
            // Raw counts, as its layout says.
            let counts = frame.message.cells_newtons.iter().map(|newtons| (3000.0 + 100.0 * newtons).round());
            frame.message.cells_newtons = counts.take(n_cells).collect();
        }
    }
    grasps
}
