//! `blindgrasp experience`

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use indicatif::ProgressBar;
use serde_json::json;

use super::{Outcome, check_output, percent, print_line};
use blindgrasp_learning::collect::collect;
use blindgrasp_learning::dataset::hand_of;
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::regrasp::Experience;

/// Keep what became of lifted grasps: what the operator `regrasp` proposes better grasps from.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: blindgrasp simulate --objects train --label lift --stable-fraction natural --grasps 4000 --out lifts.mcap\n\
                  \x20        blindgrasp experience lifts.mcap --model models/barrett-bh8-280-lifts.json --out experience.json\n\n\
                  The features in it are the model's: a graph runs with both, and with another model it has to be made again."
)]
pub(super) struct Arguments {
    /// Recordings of lifts (MCAP; simulate --label lift), or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// The model that makes the features.
    #[arg(long)]
    model: PathBuf,
    /// Where to write the experience (JSON).
    #[arg(long)]
    out: PathBuf,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long)]
    hand: Option<PathBuf>,
    /// Print what it came to as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    check_output(&arguments.out, &[&recordings[..], std::slice::from_ref(&arguments.model)].concat())?;
    let model = Model::load(&arguments.model)?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    let bar = ProgressBar::new(recordings.len() as u64);
    let collected = collect(&hand, &model, &recordings, |n_done, _| bar.set_position(n_done as u64));
    bar.finish_and_clear();
    let collected = collected?;
    let experience: &Experience = &collected.experience;
    experience.save(&arguments.out)?;
    let n_bytes = std::fs::metadata(&arguments.out).map_or(0, |found| found.len());
    let (n_grasps, n_objects, share_held) =
        (experience.grasps.len(), experience.objects.len(), experience.share_held());
    if arguments.json {
        print_line(&serde_json::to_string_pretty(&json!({
            "out": arguments.out,
            "n_grasps": n_grasps,
            "n_objects": n_objects,
            "share_held": share_held,
            "n_out_of_distribution": collected.n_out_of_distribution,
            "n_excluded": collected.n_excluded,
            "n_bytes": n_bytes,
            "dictionary_id": format!("{:016x}", experience.dictionary_id),
        }))?)?;
        return Ok(Outcome::Done);
    }
    print_line(&format!(
        "{}: {n_grasps} lifted grasps of {n_objects} objects, {} held, {} bytes a grasp",
        arguments.out.display(),
        percent(Some(share_held)),
        n_bytes / n_grasps.max(1) as u64
    ))?;
    if collected.n_out_of_distribution > 0 {
        print_line(&format!(
            "{} of them are unlike those that the model was trained on: where the graph feels such a grasp, it gives no advice",
            collected.n_out_of_distribution
        ))?;
    }
    for (reason, n) in &collected.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    Ok(Outcome::Done)
}
