//! Trains a model on labelled grasps in memory, and saves it.
//!
//! ```sh
//! cargo run --release -p blindgrasp-lab --example train -- my-model.json recordings/held-out.mcap
//! ```
//!
//! The grasps are a recording's here. Grasps of your own are the same: the frames of each grasp in order, and a
//! `GraspTruth` that says whether it held and of which object it was. `Examples::read` takes recordings as they
//! are.

use std::path::Path;

use anyhow::Context;
use blindgrasp_grasps::dataset::{hand_of, read_grasps};
use blindgrasp_learning::training::{Examples, TrainingOptions, train};

fn main() -> anyhow::Result<()> {
    let mut args = std::env::args().skip(1);
    let out = args.next().context("expected a file for the model, then a recording")?;
    let recording = args.next().context("expected a recording after the file for the model")?;
    let recording = Path::new(&recording);

    let hand = hand_of(recording, None)?;
    let grasps = read_grasps(recording, &hand, |_grasp_id, frames| frames)?;
    let labelled = grasps.into_iter().filter_map(|grasp| Some((grasp.value, grasp.truth?)));
    let examples = Examples::of_grasps(&hand, labelled)?;
    println!("{} grasps to learn from", examples.examples.len());

    let model = train(&hand, &examples, &[], &TrainingOptions::default(), |step| println!("{step}"))?;
    println!("{:.1} % right about objects not seen", 100.0 * model.training.cross_validated_accuracy);
    model.save(Path::new(&out))?;
    Ok(())
}
