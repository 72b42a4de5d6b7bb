//! `blindgrasp train`

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::model::print_model;
use super::{Outcome, check_new, completions, number_in, percent};
use blindgrasp_grasps::dataset::hand_of_all;
use blindgrasp_grasps::reading::SELF_CONTACT;
use blindgrasp_learning::training::{Aim, Examples, TrainingOptions, TrainingSummary, train};
use blindgrasp_messages::Fault;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::classifier::{Classifier, Predictor};
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::recipe::{BlendParams, Learner, Recipe};

/// Train a model on recordings with labels
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp train train.mcap --out mine.json\n  \
                  blindgrasp train train.mcap --recipe paper --out mine.json")]
pub(super) struct Arguments {
    /// Recordings (MCAP), simulated or a robot's own, or folders of them.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Where to write the model (JSON).
    #[arg(short, long)]
    out: PathBuf,
    /// Replace files of these names
    #[arg(long)]
    overwrite: bool,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// The features and the learner: boosted (the histogram, pads and joints, boosted trees), wrist (the same with gravity
    /// and the load on the wrist), blend (cells and joints, boosted trees and an SVM), paper (the histogram, an SVM), raw (cells
    /// and joints, an SVM), joints (no touch, boosted trees).
    #[arg(long, default_value = "boosted", value_parser = Recipe::NAMES)]
    recipe: String,
    /// Judge each value relative to the grasps of its recording day before it, for sensors that drift from day to day. The
    /// model holds the first 30 grasps of a day. It needs recordings of several days: those of import --day, or one
    /// recording for each day.
    #[arg(long)]
    day_baseline: bool,
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
    /// Choose the thresholds by the price of a drop. They are those with the fewest attempts for each kept object, if a drop
    /// costs as much as so many attempts and the hand grasps again until it lifts, judged by folds of objects. Recordings with
    /// probes get a threshold for each probe. The models of lifts that come with blindgrasp were trained with 30; 0 is for
    /// objects that may fall.
    #[arg(long, value_name = "ATTEMPTS", value_parser = |text: &str| number_in(text, 0.0..=1e6))]
    drop_costs: Option<f64>,
    /// Choose the thresholds by a bound on drops: at most this share of the lifts drops, with 95 % confidence, for new objects
    /// like those recorded. A stage whose strictest threshold cannot promise this never lifts.
    #[arg(long, value_name = "SHARE", conflicts_with = "drop_costs", value_parser = |text: &str| number_in(text, 1e-4..=0.9999))]
    max_drops: Option<f64>,
    /// The seed of K-means and boosting.
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    seed: u64,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    check_new(&arguments.out, &recordings, arguments.overwrite)?;
    if arguments.out.extension().is_some_and(|extension| extension == "mcap") {
        let out = arguments.out.display();
        anyhow::bail!("{out}: expected a name that ends in .json, by which evaluate tells a model from a recording");
    }
    for warning in hand.warnings() {
        print_diagnostic(&warning);
    }
    let options = TrainingOptions {
        recipe: recipe(arguments)?,
        aim: arguments.drop_costs.map(Aim::DropCosts).or(arguments.max_drops.map(Aim::MaxDrops)),
        seed: arguments.seed,
    };
    let progress = |what: &str| print_diagnostic(&format!("{what} …"));
    let examples = Examples::read(&hand, &recordings, |n_read, n| {
        progress(&format!("read recording {n_read} of {n}"));
    })?;
    let model = train(&hand, &examples, &recordings, &options, progress)?;
    model.save(&arguments.out)?;
    let n_iterations = model.training.n_iterations;
    if !model.training.converged {
        print_diagnostic(&format!("blindgrasp: the SVM did not reach its tolerance in {n_iterations} iterations"));
    }
    print_model(&model, None)?;
    Ok(Outcome::Done)
}

/// A classifier's thresholds, for people.
pub(super) fn threshold_line(classifier: &Classifier) -> String {
    let (threshold, unsure_from) = (classifier.threshold_probability, classifier.unsure_from_probability);
    if threshold >= 1.0 {
        format!(
            "never stable, {}",
            if unsure_from < 1.0 { format!("unsure from {unsure_from:.4}") } else { "never unsure".into() }
        )
    } else if unsure_from < threshold {
        format!("stable from probability {threshold:.4}, unsure from {unsure_from:.4}")
    } else {
        format!("stable from probability {threshold:.4}, never unsure")
    }
}

/// What a model of lifts says after probes and before it touches anything, and what to expect of trials, for people.
pub(super) fn probe_lines(model: &Model) -> Vec<String> {
    let mut lines = Vec::new();
    for (name, probe) in [("squeezed", &model.squeezed), ("test-lifted", &model.test_lifted)] {
        lines.extend(probe.as_ref().map(|probe| {
            let about = match &probe.classifier.predictor {
                Predictor::Loads(rule) => rule.summary(),
                _ => format!("calibration error {:.4}", probe.cross_validated_ece),
            };
            format!("{name}: {about}, {}", threshold_line(&probe.classifier))
        }));
    }
    lines.extend(
        model.approach.as_ref().map(|prior| {
            format!("approaches: ROC area {:.3} before anything is touched", prior.cross_validated_roc_area)
        }),
    );
    // A promise holds for the world that the lifts were made in.
    let world = if model.training.labels.is_empty() { "as recorded" } else { "in simulation" };
    let kept = if is_of_the_papers_label(&model.training) { "stable by the paper's label" } else { "kept" };
    for policy in &model.training.policies {
        lines.push(format!(
            "expected of trials decided when {} (ROC area {:.3}; a drop costs {} attempts): {} of the lifted objects {kept}, {:.2} \
             attempts with contact a lift, {} given up",
            policy.look.replace('_', "-"),
            policy.roc_area,
            policy.drop_costs,
            percent(Some(policy.kept)),
            policy.attempts_per_lift,
            percent(Some(policy.given_up))
        ));
        lines.extend(policy.promise.map(|promise| format!("promised for new objects {world}: {promise}")));
    }
    let excluded = |reason| model.training.n_excluded.get(reason).copied();
    let (n_unfelt, n_self_contacts) = (excluded(Fault::NoContact.as_str()).unwrap_or(0), excluded(SELF_CONTACT));
    let n = n_unfelt + n_self_contacts.unwrap_or(0);
    if !model.training.policies.is_empty() && n > 0 {
        let kinds = match n_self_contacts {
            Some(felt) => format!("no cell feels {n_unfelt}, and {felt} are felt only on links that touch each other"),
            // Models of earlier versions count both as one.
            None => format!("no cell feels {n_unfelt}, or only on links that touch each other"),
        };
        lines.push(format!(
            "attempts without contact are not counted: of the {} grasps, {kinds}; a robot holds such a grasp and \
             tries again",
            n + model.training.n_grasps
        ));
    }
    lines
}

/// Whether a grasp was learned to be stable by epsilon and volume. A model names no label if its recordings are simulated with this
/// one, or if they are a robot's.
pub(super) fn is_of_the_papers_label(training: &TrainingSummary) -> bool {
    let is_simulated = training.made_by.iter().any(|made_by| made_by.starts_with("simulation of "));
    training.labels.contains_key(&Label::WrenchSpace) || (training.labels.is_empty() && is_simulated)
}

/// The named recipe with the values of the command line.
fn recipe(arguments: &Arguments) -> anyhow::Result<Recipe> {
    let mut recipe = Recipe::named(&arguments.recipe).context("no such recipe")?;
    if arguments.day_baseline {
        recipe = recipe.with_day_baseline();
    }
    recipe.n_words = arguments.words.map_or(recipe.n_words, |words| words as usize);
    recipe.sigma_m = arguments.sigma_m.unwrap_or(recipe.sigma_m);
    match &mut recipe.learner {
        Learner::Svm(params) | Learner::Blend(BlendParams { svm: params, .. }) => {
            params.c = arguments.c.unwrap_or(params.c);
            params.gamma = arguments.gamma.unwrap_or(params.gamma);
        }
        Learner::Boosting(_) | Learner::Loads => {
            let given = [("--c", arguments.c), ("--gamma", arguments.gamma)];
            if let Some((name, _)) = given.iter().find(|(_, value)| value.is_some()) {
                anyhow::bail!("{name} is the SVM's: the recipe {} has none; name another with --recipe", recipe.name);
            }
        }
    }
    Ok(recipe)
}
