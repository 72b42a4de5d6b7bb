//! `blindgrasp evaluate`

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::{Outcome, percent, print_line};
use crate::dataset::hand_of;
use crate::diagnostics::print_diagnostic;
use crate::evaluation::{Score, evaluate};
use crate::lift_arbiter::ArbiterOptions;
use crate::model::Model;
use crate::recording::recordings_in;

/// Decide every grasp of recordings as the graph would, and hold the decisions against the truth.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp evaluate models/barrett-bh8-280.json recordings/held-out.mcap\n\n\
                        Positive means lifted: a false positive is an object dropped.")]
pub(super) struct Arguments {
    /// The model.
    model: PathBuf,
    /// Recordings (MCAP), or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long)]
    hand: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let model = Model::load(&arguments.model)?;
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let evaluation = evaluate(&hand, &model, &recordings, &ArbiterOptions::default())?;
    if arguments.json {
        print_line(&serde_json::to_string_pretty(&evaluation)?)?;
        return Ok(Outcome::Done);
    }
    let row = |name: &str, score: &Score| {
        print_line(&format!(
            "{name:<16} {:>7} {:>9} {:>9} {:>9} {:>16} {:>10}",
            score.n_grasps,
            percent((score.n_grasps > 0).then(|| score.n_stable as f64 / score.n_grasps as f64)),
            percent(score.accuracy),
            percent(score.majority_class),
            format!("{} ({})", score.n_false_positive, percent(score.false_positive_share)),
            score.n_false_negative,
        ))
    };
    print_line("class             grasps    stable  accuracy  majority  false positives  false neg.")?;
    for (class, score) in &evaluation.by_class {
        row(class, score)?;
    }
    row("all", &evaluation.score)?;
    row("judged", &evaluation.score_judged)?;
    let reasons: Vec<_> = evaluation.by_reason.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    print_line(&format!("reasons: {}", reasons.join(", ")))?;
    print_line("judged: without grasps that were held for another reason than the classifier's")?;
    if evaluation.n_without_truth > 0 {
        print_line(&format!("without truth, not scored: {}", evaluation.n_without_truth))?;
    }
    Ok(Outcome::Done)
}
