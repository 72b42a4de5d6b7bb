//! `blindgrasp predict`

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde_json::json;

use super::{Outcome, completions, print_line};
use blindgrasp_cli::frame_lines::read_frames;
use blindgrasp_cli::shard::Shard;
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_grasps::decide::{Decided, decide, decide_frames, has_probability};
use blindgrasp_messages::{GraspTruth, LiftDecision};
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
    model: PathBuf,
    /// Recordings (MCAP), folders of them, or frames as lines of JSON (- for stdin)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Pad layout of the hand [default: the built-in hand of the model]
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// The probe whose frames decide, for a model that was trained on lifts: those of the settled hand, of the tight hand, or
    /// those after the test lift
    #[arg(long, default_value = "none")]
    probe: ProbeWord,
    /// Take only every N-th file, from the I-th on (0/N to N-1/N); the lines of all shards are those of the whole
    #[arg(long, value_name = "I/N", default_value = "0/1", hide_default_value = true)]
    shard: Shard,
    /// Print JSON, one object a grasp
    #[arg(long)]
    json: bool,
}

/// [`Probe`] on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum ProbeWord {
    None,
    Squeeze,
    TestLift,
}

impl From<ProbeWord> for Probe {
    fn from(word: ProbeWord) -> Probe {
        match word {
            ProbeWord::None => Probe::None,
            ProbeWord::Squeeze => Probe::Squeeze,
            ProbeWord::TestLift => Probe::TestLift,
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let model = Model::load(&arguments.model)?;
    let probe = Probe::from(arguments.probe);
    let can_judge = match probe {
        Probe::None => true,
        Probe::Squeeze => model.squeezed.is_some(),
        Probe::TestLift => model.test_lifted.is_some(),
    };
    anyhow::ensure!(
        can_judge,
        "{} does not judge grasps after this probe: expected a model trained on lifts with its frames, or another --probe",
        arguments.model.display()
    );
    let options = ArbiterOptions { probe, ..ArbiterOptions::default() };
    for file in &arguments.shard.of(recordings_in(&arguments.files)?) {
        let is_recording = file.extension().is_some_and(|extension| extension == "mcap");
        if is_recording {
            let hand = hand_of(file, arguments.hand.as_deref())?;
            let judge = Judge::with_options(hand, model.clone(), options);
            let mut judge = judge.with_context(|| format!("recording {}", file.display()))?;
            for decided in decide(&mut judge, file)? {
                print(arguments.json, file, &decided, decided.truth.as_ref())?;
            }
        } else {
            let hand = hand_of_model(&model, arguments.hand.as_deref())?;
            let read = read_frames(file, &hand)?;
            let mut judge = Judge::with_options(hand, model.clone(), options)?;
            for decided in decide_frames(&mut judge, &read.frames) {
                let grasp_id = decided.decision.grasp_id;
                let known = read.truths.range((grasp_id, 0)..=(grasp_id, u64::MAX)).next();
                print(arguments.json, file, &decided, known.map(|(_, (_, truth))| truth))?;
            }
        }
    }
    Ok(Outcome::Done)
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

fn print(json: bool, file: &Path, decided: &Decided, truth: Option<&GraspTruth>) -> std::io::Result<()> {
    let LiftDecision { grasp_id, action, reason, probability_stable, .. } = &decided.decision;
    if json {
        return print_line(
            &json!({
                "file": file.display().to_string(),
                "grasp_id": grasp_id,
                "action": action,
                "reason": reason.as_str(),
                "probability_stable": probability_stable,
                "truth": truth,
                "why": decided.why,
            })
            .to_string(),
        );
    }
    let truth = truth.map_or(String::new(), |truth| {
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
