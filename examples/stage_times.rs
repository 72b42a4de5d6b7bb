//! What the stages alone cost: times their functions on a recording's frames, for `scripts/bench-runtime`.
//!
//! `stage_times RECORDING MODEL [ROUNDS]` prints JSON: over the frames at which the arbiter decides, the median of each
//! stage's time and of their sum. A frame's time is its median over the rounds, so caches are as warm as they get.

use std::path::Path;
use std::time::Instant;

use anyhow::bail;
use blindgrasp::contacts::contacts_from_frame;
use blindgrasp::dataset::hand_of;
use blindgrasp::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp::message::{Fault, Prediction};
use blindgrasp::model::Model;
use blindgrasp::recording::{Record, RecordingReader};
use serde_json::json;

const STAGES: [&str; 4] = ["contacts", "histogram", "classifier", "lift_arbiter"];

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (recording, model, n_rounds) = match &arguments[..] {
        [recording, model] => (Path::new(recording), model, 11),
        [recording, model, rounds] => (Path::new(recording), model, rounds.parse::<usize>()?.max(1)),
        _ => bail!("expected RECORDING MODEL [ROUNDS]"),
    };
    let model = Model::load(Path::new(model))?;
    let hand = hand_of(recording, None)?;
    let mut frames = Vec::new();
    for record in RecordingReader::open(recording)? {
        if let (_, Record::Tactile(frame)) = record? {
            frames.push(frame);
        }
    }
    // By frame, stage and round.
    let mut nanos = vec![[const { Vec::new() }; STAGES.len()]; frames.len()];
    let mut is_deciding = vec![false; frames.len()];
    let (mut n_contacts, mut contacts, mut values, mut decided) = (0, Vec::new(), Vec::new(), Vec::new());
    for _ in 0..n_rounds {
        let mut arbiter = LiftArbiter::new(ArbiterOptions::default());
        n_contacts = 0;
        for (idx, frame) in frames.iter().enumerate() {
            let message = &frame.message;
            let (joints_rad, cells_newtons) = (&message.joints_rad, &message.cells_newtons);
            let start = Instant::now();
            let summary = contacts_from_frame(&hand, frame.header.hand_id, joints_rad, cells_newtons, &mut contacts);
            let felt = Instant::now();
            let feature = match summary.fault {
                Fault::None => model.extract(joints_rad, &contacts, &mut values),
                fault => Err(fault),
            };
            let described = Instant::now();
            let verdict = feature.and_then(|_| model.classifier.classify(&values));
            let classified = Instant::now();
            let prediction = Prediction {
                grasp_id: message.grasp_id,
                phase: message.phase,
                decision_value: verdict.map_or(0.0, |verdict| verdict.decision_value),
                probability_stable: verdict.map_or(0.0, |verdict| verdict.probability_stable),
                stable: verdict.is_ok_and(|verdict| verdict.stable),
                unsure: verdict.is_ok_and(|verdict| verdict.unsure),
                fault: verdict.err().unwrap_or_default(),
            };
            arbiter.on_prediction(&frame.header, &prediction, 0, &mut decided);
            let end = Instant::now();
            for (stage, lap) in
                [felt - start, described - felt, classified - described, end - classified].into_iter().enumerate()
            {
                nanos[idx][stage].push(lap.as_nanos() as u64);
            }
            is_deciding[idx] = !decided.is_empty();
            n_contacts += if decided.is_empty() { 0 } else { contacts.len() };
            decided.clear();
        }
    }
    let by_frame: Vec<[u64; STAGES.len()]> = nanos
        .into_iter()
        .zip(is_deciding)
        .filter_map(|(stages, is_deciding)| is_deciding.then(|| stages.map(median)))
        .collect();
    if by_frame.is_empty() {
        bail!("no frame of {} brings a decision about", recording.display());
    }
    let stages: serde_json::Map<_, _> = STAGES
        .iter()
        .enumerate()
        .map(|(idx, stage)| (stage.to_string(), median(by_frame.iter().map(|stages| stages[idx]).collect()).into()))
        .collect();
    let sum = median(by_frame.iter().map(|stages| stages.iter().sum()).collect());
    println!(
        "{}",
        json!({
            "frames": frames.len(),
            "decisions": by_frame.len(),
            "contacts_per_deciding_frame": n_contacts as f64 / by_frame.len() as f64,
            "features": model.features.len(),
            "stages_nanos": stages,
            "sum_nanos": sum,
        })
    );
    Ok(())
}

fn median(mut nanos: Vec<u64>) -> u64 {
    nanos.sort_unstable();
    nanos[nanos.len() / 2]
}
