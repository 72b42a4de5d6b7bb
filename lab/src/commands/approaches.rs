//! `blindgrasp model approaches`

use std::io::BufRead;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use serde::{Deserialize, Serialize};

use super::{Outcome, print_line};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::model::Model;

/// Say how often lifts after given approaches keep their object.
///
/// Reads questions from the standard input, one JSON object a line, and answers each with a line: a robot asks before it reaches
/// for an object, and takes the best approach that it can do. "gravity" is its direction in the palm frame, "joints" are the
/// open hand's joints, in its order.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: echo '{\"approaches\": [{\"gravity\": [0, 0, 1], \"joints\": [0.8, 0, 0, 0, 0, 0, 0]}]}' | \
                  blindgrasp model approaches models/barrett-bh8-280-lifts.json"
)]
pub(super) struct Arguments {
    /// A model that was learned from lifts with gravity.
    model: PathBuf,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Question {
    approaches: Vec<Approach>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Approach {
    gravity: [f64; 3],
    joints: Vec<f64>,
}

#[derive(Serialize)]
struct Answer {
    /// Of each approach, in the question's order.
    probability_kept: Vec<f64>,
    /// Index of the approach whose lift is kept most probably.
    best: Option<usize>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let path = arguments.model.display();
    let model = Model::load(&arguments.model)?;
    let n_joints = model.features.couplings.len();
    let prior = model.approach.with_context(|| {
        format!("{path} knows nothing of approaches: expected a model that was trained on lifts with gravity (docs/simulator.md)")
    })?;
    for (idx, line) in std::io::stdin().lock().lines().enumerate() {
        let line = line.context("the standard input")?;
        let answer = answer(&prior, n_joints, &line).with_context(|| format!("line {}", idx + 1))?;
        print_line(&serde_json::to_string(&answer)?)?;
    }
    Ok(Outcome::Done)
}

fn answer(prior: &ApproachPrior, n_joints: usize, line: &str) -> anyhow::Result<Answer> {
    let expected = r#"expected {"approaches": [{"gravity": [x, y, z], "joints": […]}, …]}"#;
    let question: Question = serde_json::from_str(line).context(expected)?;
    for (idx, approach) in question.approaches.iter().enumerate() {
        let found = approach.joints.len();
        anyhow::ensure!(found == n_joints, "approaches[{idx}].joints has length {found}, expected {n_joints}");
        let has_direction = approach.gravity.iter().any(|part| *part != 0.0);
        anyhow::ensure!(has_direction, "approaches[{idx}].gravity is zero, expected its direction in the palm frame");
    }
    let probability = |approach: &Approach| prior.probability_kept(approach.gravity, &approach.joints);
    let probability_kept: Option<Vec<f64>> = question.approaches.iter().map(probability).collect();
    let probability_kept = probability_kept.context("gravity has no direction")?;
    let best = (0..probability_kept.len()).max_by(|a, b| probability_kept[*a].total_cmp(&probability_kept[*b]));
    Ok(Answer { probability_kept, best })
}
