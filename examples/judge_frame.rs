//! Judges the frames of a hand without a graph, and prints one decision for each grasp.
//!
//! ```sh
//! cargo run --release --example judge_frame -- models/barrett-bh8-280.json recordings/held-out.mcap
//! ```
//!
//! The frames are a recording's here. Those of a driver go the same way: make a `TactileFrame` of each reading, and give
//! it to the judge with its time.

use std::path::Path;

use anyhow::Context;
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::{Hand, Judge, Model};

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let model = args.next().context("expected a model, then a recording")?;
    let recording = args.next().context("expected a recording after the model")?;

    let model = Model::load(Path::new(&model))?;
    let hand = Hand::load(Path::new(&model.hand.name))?;
    let mut judge = Judge::new(hand, model)?;
    for record in RecordingReader::open(Path::new(&recording))? {
        let (_topic, record) = record?;
        let Record::Tactile(frame) = record else { continue };
        for decision in judge.frame(frame.header.stamp_nanos, &frame.message) {
            let (action, reason) = (decision.action.as_str(), decision.reason.as_str());
            println!("grasp {}: {action} ({reason}), p {:.3}", decision.grasp_id, decision.probability_stable);
        }
    }
    Ok(())
}
