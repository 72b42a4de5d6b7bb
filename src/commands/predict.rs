//! `blindgrasp predict`

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use serde_json::json;

use super::{Outcome, completions, print_line};
use blindgrasp_cli::frame_lines::read_frames;
use blindgrasp_cli::shard::{Place, Shard, hash, merge_files};
use blindgrasp_cli::{check_probe, word};
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_grasps::decide::{Decided, decide, decide_frames, has_probability};
use blindgrasp_messages::LiftDecision;
use blindgrasp_messages::files::{open_regular, read_regular_bytes};
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::{ArbiterOptions, Hand, Judge, Model, Probe};

/// Print the decision of a model on each grasp
///
/// Decides the grasps one after the other, as a graph with this model and the arbiter's default params does, without
/// starting one.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp predict models/barrett-bh8-280.json recordings/held-out.mcap\n          \
                        blindgrasp export a.mcap --topic /tactile | blindgrasp predict model.json --hand hand.yaml -\n\n\
                        A line of frames is one of blindgrasp export, or one of a bridge (docs/hardware.md) with its grasp_id. All \
                        lines are read before the first decision is printed. As in a graph, a grasp is held if a seq is missing, or if \
                        the hand_id is another.")]
pub(super) struct Arguments {
    /// The model (JSON)
    #[arg(required_unless_present = "merge")]
    model: Option<PathBuf>,
    /// Recordings (MCAP), folders of them, or frames as lines of JSON (- for stdin)
    #[arg(required_unless_present = "merge", value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Pad layout of the hand [default: the built-in hand of the model]
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// The probe whose frames decide, of a model trained on lifts: none (the settled hand's), squeeze (the tight hand's) or
    /// test_lift (those after it)
    #[arg(long, default_value = "none", value_parser = |text: &str| word::<Probe>(text, "none, squeeze or test_lift"))]
    probe: Probe,
    /// Take only every N-th file, from the I-th on (0/N to N-1/N). With --json, the last line has the shard's place in the whole
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Merge the JSON of all shards into that of the whole
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["model", "files", "hand", "probe", "shard"])]
    merge: Vec<PathBuf>,
    /// Print JSON, one object a grasp
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let Some(path) = &arguments.model else { return print_merged(&arguments.merge) };
    let model = Model::load(path)?;
    check_probe(path, &model, arguments.probe)?;
    let options = ArbiterOptions { probe: arguments.probe, ..ArbiterOptions::default() };
    let files = recordings_in(&arguments.files)?;
    let mut place = None;
    if let (true, Some(shard)) = (arguments.json, arguments.shard) {
        let hand_id = match &arguments.hand {
            Some(hand) => Some(Hand::load(hand)?.description_id()),
            None => None,
        };
        place = Some(Place::new(shard, (read_regular_bytes(path)?, hand_id, arguments.probe as u8), &files));
    }
    let (mut n_lines, mut content_id) = (Vec::new(), 0);
    for file in &arguments.shard.unwrap_or_default().of(files) {
        let decided = decide_file(file, &model, options, arguments.hand.as_deref())?;
        n_lines.push(decided.len());
        for decided in decided {
            if arguments.json {
                let line = json_of(file, &decided);
                print_line(&line)?;
                content_id = hash((content_id, line));
            } else {
                print(&decided)?;
            }
        }
    }
    if let Some(place) = place {
        print_line(&serde_json::to_string(&place.of_output(n_lines, content_id))?)?;
    }
    Ok(Outcome::Done)
}

/// Prints the lines of the whole, from those of all shards.
fn print_merged(paths: &[PathBuf]) -> anyhow::Result<Outcome> {
    let lines = merge_files(paths, |path| {
        let mut lines = BufReader::new(open_regular(path)?).lines().collect::<Result<Vec<_>, _>>()?;
        let place = serde_json::from_str(&lines.pop().unwrap_or_default())
            .context("expected the whole output of predict --shard I/N --json")?;
        Ok((place, lines.iter().fold(0, |content_id, line| hash((content_id, line))), lines))
    })?;
    lines.iter().try_for_each(|line| print_line(line))?;
    Ok(Outcome::Done)
}

/// The decisions on the grasps of a recording, or of lines of frames.
fn decide_file(
    file: &Path,
    model: &Model,
    options: ArbiterOptions,
    hand: Option<&Path>,
) -> anyhow::Result<Vec<Decided>> {
    if file.extension().is_some_and(|extension| extension == "mcap") {
        let judge = Judge::with_options(hand_of(file, hand)?, model.clone(), options);
        let mut judge = judge.with_context(|| format!("recording {}", file.display()))?;
        return Ok(decide(&mut judge, file)?);
    }
    let hand = hand_of_model(model, hand)?;
    let read = read_frames(file, &hand)?;
    let mut decided = decide_frames(&mut Judge::with_options(hand, model.clone(), options)?, &read.frames);
    for decided in &mut decided {
        let grasp_id = decided.decision.grasp_id;
        if let Some((_, (_, truth))) = read.truths.range((grasp_id, 0)..=(grasp_id, u64::MAX)).next() {
            decided.truth = Some(truth.clone());
        }
    }
    Ok(decided)
}

fn hand_of_model(model: &Model, path: Option<&Path>) -> anyhow::Result<Hand> {
    let hand = match path {
        Some(path) => Hand::load(path)?,
        None => Hand::load(Path::new(&model.hand.name)).with_context(|| {
            format!("the model is for the hand '{}': name its pad layout with --hand", model.hand.name)
        })?,
    };
    model.check_hand(&hand)?;
    Ok(hand)
}

fn json_of(file: &Path, decided: &Decided) -> String {
    let LiftDecision { grasp_id, action, reason, probability_stable, .. } = &decided.decision;
    let line = json!({
        "file": file.display().to_string(),
        "grasp_id": grasp_id,
        "action": action,
        "reason": reason.as_str(),
        "probability_stable": probability_stable,
        "truth": decided.truth,
        "why": decided.why,
    });
    line.to_string()
}

fn print(decided: &Decided) -> std::io::Result<()> {
    let LiftDecision { grasp_id, action, reason, probability_stable, .. } = &decided.decision;
    let truth = decided.truth.as_ref().map_or(String::new(), |truth| {
        format!("  label: {} ({})", if truth.stable { "stable" } else { "unstable" }, truth.object)
    });
    let probability = if has_probability(*reason) { format!("{probability_stable:.3}") } else { "-".into() };
    let line = format!("grasp {grasp_id:>5}  {}  p {probability:>5}  {:<14}{truth}", action.shown(), reason.as_str());
    print_line(line.trim_end())?;
    for sentence in &decided.why {
        print_line(&format!("             {sentence}"))?;
    }
    Ok(())
}
