//! `blindgrasp features`

use std::io::BufWriter;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::{Outcome, check_output, print_line};
use blindgrasp_learning::dataset::hand_of;
use blindgrasp_learning::training::{Examples, Relabelling};
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::model::Model;

/// Write the table of features that a model sees of recorded grasps, to learn from with other tools.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: blindgrasp features data/train --model models/barrett-bh8-280.json --out features.csv\n\n\
                        A row for each grasp with truth that some cell feels, of its first settled frame: recording, grasp_id, \
                        object, class, stable (1 or 0), hand_id, dictionary_id (both as in the model's identity), then the \
                        values value_0, value_1, … as the histogram operator sends them."
)]
pub(super) struct Arguments {
    /// Recordings (MCAP) with truth, or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// The model whose features are wanted.
    #[arg(long)]
    model: PathBuf,
    /// Where to write the table (CSV).
    #[arg(long)]
    out: PathBuf,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long)]
    hand: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    check_output(&arguments.out, &[&recordings[..], std::slice::from_ref(&arguments.model)].concat())?;
    let model = Model::load(&arguments.model)?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    if hand.id() != model.hand.id {
        anyhow::bail!(
            "{} is of the hand '{}' ({:016x}), {} of '{}' ({:016x}): expected the same",
            arguments.model.display(),
            model.hand.name,
            model.hand.id,
            first.display(),
            hand.name,
            hand.id()
        );
    }
    let mut read = Examples::read(&hand, &recordings, &Relabelling::default(), |_, _| {})?;
    let identity = [format!("{:016x}", model.hand.id), format!("{:016x}", model.dictionary_id())];
    let at = || format!("cannot write {}", arguments.out.display());
    let mut table = csv::Writer::from_writer(BufWriter::new(std::fs::File::create(&arguments.out).with_context(at)?));
    let names = ["recording", "grasp_id", "object", "class", "stable", "hand_id", "dictionary_id"].map(String::from);
    let values = (0..model.features.len()).map(|value_idx| format!("value_{value_idx}"));
    table.write_record(names.into_iter().chain(values)).with_context(at)?;
    let mut n_rows = 0;
    let mut values = Vec::new();
    for example in &read.examples {
        values.clear();
        if let Err(fault) = model.extract(&example.joints_rad, &example.contacts, &mut values) {
            *read.n_excluded.entry(fault.as_str().into()).or_default() += 1;
            continue;
        }
        let row = [
            recordings[example.recording_idx].display().to_string(),
            example.grasp_id.to_string(),
            example.object.clone(),
            example.class.clone(),
            u8::from(example.stable).to_string(),
        ];
        let row = row.into_iter().chain(identity.clone()).chain(values.iter().map(f64::to_string));
        table.write_record(row).with_context(at)?;
        n_rows += 1;
    }
    table.flush().with_context(at)?;
    print_line(&format!("{}: {n_rows} grasps, {} values each", arguments.out.display(), model.features.len()))?;
    for (reason, n) in &read.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    Ok(Outcome::Done)
}
