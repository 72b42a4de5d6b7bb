//! `blindgrasp model`

use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde_json::json;

use super::{Outcome, percent, print_line};
use crate::model::Model;

/// Look at a model.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Show(ShowArguments),
}

/// Print what a model is made of: all but its support vectors.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp model show models/barrett-bh8-280.json --json")]
struct ShowArguments {
    /// The model.
    model: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let Command::Show(arguments) = &arguments.command;
    let model = Model::load(&arguments.model)?;
    let (svm, calibration) = (&model.classifier.svm, &model.classifier.calibration);
    let training = &model.training;
    if arguments.json {
        let shown = json!({
            "format": model.format,
            "hand": model.hand.name,
            "hand_id": format!("{:016x}", model.hand.id),
            "sigma_m": model.sigma_m,
            "dictionary_m": model.dictionary.words_m,
            "svm": {
                "kernel": "rbf",
                "c": training.c,
                "gamma": svm.gamma,
                "tolerance": training.tolerance,
                "rho": svm.rho,
                "n_features": svm.n_features,
                "n_support_vectors": svm.n_support_vectors(),
            },
            "calibration": { "method": "platt", "a": calibration.a, "b": calibration.b },
            "threshold_probability": model.classifier.threshold_probability,
            "training": training,
            "checksum": model.checksum,
        });
        print_line(&serde_json::to_string_pretty(&shown)?)?;
        return Ok(Outcome::Done);
    }
    for (what, value) in [
        ("format", model.format.clone()),
        ("hand", format!("{} ({:016x})", model.hand.name, model.hand.id)),
        ("dictionary", format!("{} words, sigma {} m", model.dictionary.words_m.len(), model.sigma_m)),
        ("SVM", format!("RBF, c {}, gamma {}, {} support vectors", training.c, svm.gamma, svm.n_support_vectors())),
        ("calibration", format!("Platt, a {:.4}, b {:.4}", calibration.a, calibration.b)),
        ("threshold", format!("stable from probability {}", model.classifier.threshold_probability)),
        (
            "trained on",
            format!(
                "{} grasps ({} stable) of {} objects: {}",
                training.n_grasps,
                percent(Some(training.n_stable as f64 / training.n_grasps as f64)),
                training.n_objects,
                training.recordings.join(", ")
            ),
        ),
        (
            "cross-validated",
            format!(
                "accuracy {}, false positives {} of the grasps with contact ({} folds of objects)",
                percent(Some(training.cross_validated_accuracy)),
                percent(Some(training.cross_validated_false_positive_share)),
                training.n_folds
            ),
        ),
        ("checksum", model.checksum.clone()),
    ] {
        print_line(&format!("{what:<16} {value}"))?;
    }
    Ok(Outcome::Done)
}
