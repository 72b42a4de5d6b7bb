//! What sensor faults cost and how soon they are found: the table of docs/trust.md.
//!
//! `sensor_faults CHECK MODEL RECORDING SEED [N_RUNS]` puts each fault at three strengths into the grasps of a recording of
//! healthy ones. A run is ten healthy grasps and then ten with the fault, of random objects. It prints, as Markdown, how
//! often the fault is reported within 1, 5 and 10 grasps, and what the model makes of all grasps with the fault. Then it prints
//! the false alarms among healthy grasps, in random order and object by object.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use blindgrasp_learning::sensors::{Damage, SensorGrasp, alarms, damaged, read};
use blindgrasp_messages::Phase;
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::{Memory, Model};
use blindgrasp_stages::sensors::{SensorCheck, SensorFault};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const NOISE_NEWTONS: f64 = 0.01;
const N_BEFORE: usize = 10;
const N_AFTER: usize = 10;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [check, model, recording, seed, rest @ ..] = &arguments[..] else {
        bail!("expected CHECK MODEL RECORDING SEED [N_RUNS]");
    };
    let hand = Hand::load(Path::new("barrett-bh8-280"))?;
    let check = SensorCheck::load(Path::new(check), &hand)?;
    let model = Model::load(Path::new(model))?;
    let n_runs: usize = rest.first().map_or(Ok(300), |n| n.parse()).context("N_RUNS")?;
    let mut random = ChaCha8Rng::seed_from_u64(seed.parse().context("SEED")?);
    let grasps = read(&hand, &[PathBuf::from(recording)])?;
    println!("| fault | strength | within 1 | 5 | 10 | named right | held | accuracy | false positives |");
    println!("|---|---|---|---|---|---|---|---|---|");
    let (held, accuracy, false_positives) = judged(&hand, &model, &grasps);
    println!("| none | | | | | | {held:.1} % | {accuracy:.1} % | {false_positives:.1} % |");
    for (name, strength, parts) in damages(&hand) {
        let mut found = [0; 3];
        let mut n_right = 0;
        for run in 0..n_runs {
            let (damage, fault) = parts[run % parts.len()];
            let mut pick = || &grasps[random.random_range(0..grasps.len())];
            let mut sequence: Vec<SensorGrasp> = (0..N_BEFORE).map(|_| pick().clone()).collect();
            let chosen: Vec<(&SensorGrasp, &SensorGrasp)> = (0..N_AFTER).map(|_| (pick(), pick())).collect();
            for (grasp, other) in chosen {
                sequence.push(damaged(&hand, grasp, damage, other, &mut random));
            }
            let alarms = alarms(&check, &hand, &sequence);
            let first = alarms.iter().skip(N_BEFORE).position(Option::is_some);
            for (count, within) in found.iter_mut().zip([1, 5, 10]) {
                *count += usize::from(first.is_some_and(|first| first < within));
            }
            n_right +=
                usize::from(first.and_then(|first| alarms[N_BEFORE + first]).is_some_and(|alarm| alarm == fault));
        }
        let mut sick = Vec::with_capacity(grasps.len());
        for (idx, grasp) in grasps.iter().enumerate() {
            let other = &grasps[random.random_range(0..grasps.len())];
            sick.push(damaged(&hand, grasp, parts[idx % parts.len()].0, other, &mut random));
        }
        let (held, accuracy, false_positives) = judged(&hand, &model, &sick);
        let share = |n: usize| 100.0 * n as f64 / n_runs as f64;
        println!(
            "| {name} | {strength} | {:.0} % | {:.0} % | {:.0} % | {:.0} % | {held:.1} % | {accuracy:.1} % | {false_positives:.1} % |",
            share(found[0]),
            share(found[1]),
            share(found[2]),
            100.0 * n_right as f64 / found[2].max(1) as f64,
        );
    }
    let mut by_object = grasps.clone();
    by_object.sort_by(|a, b| a.object.cmp(&b.object));
    let mut shuffled = grasps;
    for idx in (1..shuffled.len()).rev() {
        shuffled.swap(idx, random.random_range(0..=idx));
    }
    for (name, order) in [("random order", &shuffled), ("object by object", &by_object)] {
        let reported = alarms(&check, &hand, order);
        let n_alarms = (0..reported.len())
            .filter(|at| reported[*at].is_some() && (*at == 0 || reported[at - 1].is_none()))
            .count();
        let n_held = reported.iter().flatten().count();
        println!("{name}: {n_alarms} false alarms in {} healthy grasps, {n_held} grasps held", order.len());
        for (at, alarm) in reported.iter().enumerate() {
            if let Some(fault) = alarm
                && (at == 0 || reported[at - 1].is_none())
            {
                println!("  {fault:?} at grasp {at}, {}", order[at].object);
            }
        }
    }
    Ok(())
}

/// Each fault with its strength, and the parts of the hand that it may be in, each with the fault that should be reported.
type Damages = (&'static str, &'static str, Vec<(Damage, SensorFault)>);

fn damages(hand: &Hand) -> Vec<Damages> {
    let pads = || 0..hand.pads.len();
    let cells = |newtons: f64| {
        let all = pads().flat_map(|pad| (0..hand.pads[pad].cells.len()).map(move |cell| (pad, cell)));
        all.map(|(pad, cell)| (Damage::StuckCell { pad, cell, newtons }, SensorFault::FrozenCell { pad, cell }))
            .collect()
    };
    let level =
        |damage: &dyn Fn(usize) -> Damage| pads().map(|pad| (damage(pad), SensorFault::Level { pad })).collect();
    let gain = |factor: f64| level(&|pad| Damage::Gain { pad, factor });
    let offset = |newtons: f64| level(&|pad| Damage::Offset { pad, newtons });
    // Added to the noise that is there already.
    let noise =
        |factor: f64| level(&|pad| Damage::Noise { pad, newtons: NOISE_NEWTONS * (factor * factor - 1.0).sqrt() });
    let encoder = |radians: f64| {
        let joints = 0..hand.joints.len();
        joints.map(|joint| (Damage::Encoder { joint, radians }, SensorFault::Encoder { joint })).collect()
    };
    let exchanged = [[1, 2], [2, 3], [1, 3]].map(|pads| (Damage::Exchanged { pads }, SensorFault::Exchanged { pads }));
    vec![
        ("dead cell", "0 N", cells(0.0)),
        ("stuck cell", "0.1 N", cells(0.1)),
        ("stuck cell", "1 N", cells(1.0)),
        ("frozen pad", "", pads().map(|pad| (Damage::FrozenPad { pad }, SensorFault::FrozenPad { pad })).collect()),
        ("gain", "x 0.33", gain(1.0 / 3.0)),
        ("gain", "x 1.5", gain(1.5)),
        ("gain", "x 3", gain(3.0)),
        ("offset", "0.03 N", offset(0.03)),
        ("offset", "0.1 N", offset(0.1)),
        ("offset", "0.5 N", offset(0.5)),
        ("noise", "x 1.5", noise(1.5)),
        ("noise", "x 2", noise(2.0)),
        ("noise", "x 3", noise(3.0)),
        ("encoder", "0.03 rad", encoder(0.03)),
        ("encoder", "0.1 rad", encoder(0.1)),
        ("encoder", "0.3 rad", encoder(0.3)),
        ("fingers exchanged", "", exchanged.to_vec()),
        ("posture of another grasp", "", vec![(Damage::Posture, SensorFault::Posture)]),
    ]
}

/// Per cent: grasps held for another reason than touch, accuracy of those judged or felt nowhere, false positives.
fn judged(hand: &Hand, model: &Model, grasps: &[SensorGrasp]) -> (f64, f64, f64) {
    let (mut n_held, mut n_right, mut n, mut n_unstable, mut n_wrong) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let mut contacts = Vec::new();
    for grasp in grasps {
        let Some(frame) = grasp.frames.iter().find(|frame| frame.phase == Phase::Settled) else { continue };
        let Some(stable) = grasp.stable else { continue };
        n += 1.0;
        contacts_from_frame(hand, 0, &frame.joints, &frame.cells_newtons, &mut contacts);
        let mut values = Vec::new();
        let reading = FeltReading::new(&frame.joints, &contacts);
        let place = blindgrasp_stages::day::GraspPlace::default();
        let verdict = model.extract(Phase::Settled, &reading, &mut values).and_then(|_| {
            model.judge(&mut Memory::default(), model.dictionary_id(), place, Phase::Settled, Ok(&values))
        });
        n_held += f64::from(u8::from(verdict.is_err()));
        let is_lifted = verdict.is_ok_and(|verdict| verdict.stable);
        n_right += f64::from(u8::from(is_lifted == stable));
        n_unstable += f64::from(u8::from(!stable));
        n_wrong += f64::from(u8::from(is_lifted && !stable));
    }
    (100.0 * n_held / n, 100.0 * n_right / n, 100.0 * n_wrong / n_unstable)
}
