//! `blindgrasp train`

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::grid::{GridArguments, search};
use super::{Outcome, check_output, number_in, percent, print_line};
use crate::dataset::hand_of;
use crate::diagnostics::print_diagnostic;
use crate::recording::recordings_in;
use crate::training::{Learner, Recipe, TrainingOptions, train};

/// Train a model on recordings with truth.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp train train.mcap --out mine.json\n  \
                  blindgrasp train train.mcap --recipe paper --grid --grid-report grid.json --grid-report grid.svg --out mine.json")]
pub(super) struct Arguments {
    /// Recordings (MCAP), simulated or a robot's own, or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Where to write the model.
    #[arg(long)]
    out: PathBuf,
    /// Pad layout of the hand; default: the built-in hand that the first recording names.
    #[arg(long)]
    hand: Option<PathBuf>,
    /// What a feature is made of and what learns from it: paper (the histogram and an SVM), raw (cells and joints and an
    /// SVM), posture (histogram and joints and an SVM), boosted (pads and joints and boosted trees).
    #[arg(long, default_value = "boosted", value_parser = Recipe::NAMES)]
    recipe: String,
    /// Words of the contact dictionary.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=2048))]
    words: Option<u32>,
    /// Width of the words, metres (the paper's sigma).
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-4..=10.0))]
    sigma_m: Option<f64>,
    /// The SVM's penalty.
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-9..=1e9))]
    c: Option<f64>,
    /// The SVM's kernel width.
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-9..=1e9))]
    gamma: Option<f64>,
    /// The SVM's stopping tolerance.
    #[arg(long, value_parser = |text: &str| number_in(text, 1e-12..=1.0))]
    tolerance: Option<f64>,
    /// A grasp counts as stable from this probability on.
    #[arg(long, default_value_t = TrainingOptions::default().threshold_probability, value_parser = |text: &str| number_in(text, 1e-6..=1.0))]
    threshold_probability: f64,
    /// Seeds K-means and boosting.
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    seed: u64,
    #[command(flatten)]
    grid: GridArguments,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let first = recordings.first().context("expected a recording")?;
    let hand = hand_of(first, arguments.hand.as_deref())?;
    check_output(&arguments.out, &recordings)?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let mut options = TrainingOptions {
        recipe: recipe(arguments)?,
        threshold_probability: arguments.threshold_probability,
        seed: arguments.seed,
        ..TrainingOptions::default()
    };
    let grid = search(&arguments.grid, &hand, &recordings, &mut options)?;
    let mut model = train(&hand, &recordings, &options, |what| print_diagnostic(&format!("{what} …")))?;
    model.training.grid = grid;
    model.save(&arguments.out)?;
    let training = &model.training;
    print_line(&format!(
        "{}: {} grasps ({} stable) of {} objects, {} contacts, recipe {}: {}",
        arguments.out.display(),
        training.n_grasps,
        percent(Some(training.n_stable as f64 / training.n_grasps as f64)),
        training.n_objects,
        training.n_contacts,
        training.recipe.name,
        model.classifier.machine.summary(),
    ))?;
    for (reason, n) in &training.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    if !training.converged {
        print_diagnostic(&format!(
            "blindgrasp: the SVM did not reach its tolerance in {} iterations",
            training.n_iterations
        ));
    }
    print_line(&format!(
        "cross-validated over {} folds of objects: accuracy {}, false positives {} of the grasps with contact",
        training.n_folds,
        percent(Some(training.cross_validated_accuracy)),
        percent(Some(training.cross_validated_false_positive_share)),
    ))?;
    Ok(Outcome::Done)
}

/// The recipe that was named, with what the command line says otherwise.
fn recipe(arguments: &Arguments) -> anyhow::Result<Recipe> {
    let mut recipe = Recipe::named(&arguments.recipe).context("no such recipe")?;
    recipe.n_words = arguments.words.map_or(recipe.n_words, |words| words as usize);
    recipe.sigma_m = arguments.sigma_m.unwrap_or(recipe.sigma_m);
    match &mut recipe.learner {
        Learner::Svm(params) => {
            params.c = arguments.c.unwrap_or(params.c);
            params.gamma = arguments.gamma.unwrap_or(params.gamma);
            params.tolerance = arguments.tolerance.unwrap_or(params.tolerance);
        }
        Learner::Boosting(_) => {
            let given = [("--c", arguments.c), ("--gamma", arguments.gamma), ("--tolerance", arguments.tolerance)];
            if let Some((name, _)) = given.iter().find(|(_, value)| value.is_some()) {
                anyhow::bail!("{name} is the SVM's: the recipe {} has none; name another with --recipe", recipe.name);
            }
        }
    }
    Ok(recipe)
}
