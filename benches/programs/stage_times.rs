//! What the stages alone cost: times their functions on a recording's frames, for `scripts/benchsuite runtime`.
//!
//! `stage_times RECORDING MODEL RATE_HZ` prints JSON: the median of each stage's time and of their sum, over the frames at
//! which the arbiter decides. Frames are RATE_HZ apart as in a graph at that rate. What a stage costs depends on how long
//! ago it last ran. `frame_nanos` is the time of the whole loop a frame; at the rate inf, it waits for nothing.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::bail;
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_messages::{Fault, Phase, Prediction};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::contacts::ContactFinder;
use blindgrasp_stages::encoder::FeltReading;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp_stages::model::Model;
use serde_json::json;

const STAGES: [&str; 4] = ["contacts", "encoder", "classifier", "lift_arbiter"];

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [recording, model, rate_hz] = &arguments[..] else {
        bail!("expected RECORDING MODEL RATE_HZ");
    };
    let recording = Path::new(recording);
    let period = Duration::from_secs_f64(1.0 / rate_hz.parse::<f64>()?);
    let model = Model::load(Path::new(model))?;
    let hand = hand_of(recording, None)?;
    let mut frames = Vec::new();
    for record in RecordingReader::open(recording)? {
        if let (_, Record::Tactile(frame)) = record? {
            frames.push(frame);
        }
    }
    let mut by_frame: Vec<[u64; STAGES.len()]> = Vec::new();
    let (mut n_contacts, mut contacts, mut values, mut decided) = (0, Vec::new(), Vec::new(), Vec::new());
    let mut finder = ContactFinder::default();
    let mut arbiter = LiftArbiter::new(ArbiterOptions::default());
    let begin = Instant::now();
    let mut due = begin;
    for frame in &frames {
        due += period;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let message = &frame.message;
        let (joints, cells_newtons) = (&message.joints, &message.cells_newtons);
        let start = Instant::now();
        let summary = finder.find(&hand, frame.header.hand_id, joints, cells_newtons, &mut contacts);
        let felt = Instant::now();
        let feature = match summary.fault {
            Fault::None => model.extract(Phase::Settled, &FeltReading::new(joints, &contacts), &mut values),
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
        if !decided.is_empty() {
            let laps = [felt - start, described - felt, classified - described, end - classified];
            by_frame.push(laps.map(|lap| lap.as_nanos() as u64));
            n_contacts += contacts.len();
            decided.clear();
        }
    }
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
            "frame_nanos": begin.elapsed().as_nanos() as u64 / frames.len() as u64,
        })
    );
    Ok(())
}

fn median(mut nanos: Vec<u64>) -> u64 {
    nanos.sort_unstable();
    nanos[nanos.len() / 2]
}
