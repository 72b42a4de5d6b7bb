//! `blindgrasp model`

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::{Args, Subcommand};
use serde_json::json;

use super::train::{is_of_the_papers_label, probe_lines, threshold_line};
use super::{Outcome, check_new, completions, number_in, percent, print_line, print_text};
use blindgrasp_grasps::dataset::{hand_of_all, label_line};
use blindgrasp_learning::plain_rule::plain_rule;
use blindgrasp_learning::training::{adapt, counts};
use blindgrasp_messages::Phase;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::classifier::boosting::BoostedTrees;
use blindgrasp_stages::classifier::svm::RbfSvm;
use blindgrasp_stages::classifier::{Blend, Predictor};
use blindgrasp_stages::day::{Baseline, DayMethod};
use blindgrasp_stages::hand::{CellUnit, Hand};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::out_of_distribution::TrainingRange;
use blindgrasp_stages::own_lifts::Correction;
use blindgrasp_stages::probe::ProbeModel;
use blindgrasp_stages::training_summary::{OwnLiftsSummary, Promise, RobotLifts, ThresholdPoint, TrainingSummary};

/// Describe or adapt a model, or rate approaches
#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Show(ShowArguments),
    Adapt(AdaptArguments),
    Rule(RuleArguments),
    Approaches(super::approaches::Arguments),
}

/// Correct a model by the robot's own outcomes: lifts, or labelled grasps of one day.
///
/// Recordings of lifts that end with a frame of the phase kept or dropped correct the probabilities of the look that decides, and
/// widen limits that held the robot's own grasps. Objects are the unit of the cross-fit. A model that looks at days
/// (--day-baseline, import --day) is corrected for the day of the recordings; other days are judged as before. The thresholds stay.
/// Outcomes of several robots of one hand are pooled, and each robot's share is shown by the name of its file or folder.
/// Use the new model in place of the old one: blindgrasp run --set model=NEW, or blindgrasp swap.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp model adapt models/barrett-bh8-280-lifts.json my-lifts.mcap --out mine.json\n  \
                        blindgrasp model adapt gate.json robot-a.mcap robot-b.mcap robot-c/ --out fleet.json")]
struct AdaptArguments {
    /// The model.
    model: PathBuf,
    /// Recordings (MCAP) of the robot: 20 outcomes of lifts or more, of several objects; or, of a model that looks at days, 20
    /// labelled grasps of one day or more, some stable and some not.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Where to write the model.
    #[arg(short, long)]
    out: PathBuf,
    /// Replace a file of this name
    #[arg(long)]
    overwrite: bool,
}

/// Make the model of a hand that has none yet: a plain rule, which needs no training.
///
/// It asks for a test lift of a grasp that two fingers, or one and the palm, feel, and lifts if the hand then feels enough. It
/// promises nothing. After 20 lifts or more, blindgrasp model adapt corrects it by the robot's own outcomes; blindgrasp learn trains a better one.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp model rule --hand my-hand.yaml --out rule.json\n         \
                        blindgrasp run dataflow-live.yaml --set hand=my-hand.yaml --set model=rule.json \\\n             --set promised_drops=1")]
struct RuleArguments {
    /// Pad layout (YAML) of the hand, or the name of a built-in one. Its cells read newtons.
    #[arg(long, add = completions::hands())]
    hand: PathBuf,
    /// The least load of all pads together after the test lift.
    #[arg(long, default_value_t = 10.0, allow_negative_numbers = true, value_parser = |text: &str| number_in(text, 0.0..=1e4))]
    newtons: f64,
    /// Where to write the model.
    #[arg(short, long)]
    out: PathBuf,
    /// Replace a file of this name
    #[arg(long)]
    overwrite: bool,
}

/// Print what a model is made of: all but its support vectors and the identities of its training grasps.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp model show models/barrett-bh8-280.json --json\n  \
                        blindgrasp model show gate.json --drop-costs 60      which threshold, if a drop costs as much as 60 attempts")]
struct ShowArguments {
    /// The model.
    model: PathBuf,
    /// Mark the threshold with the least attempts for each kept object, if a drop costs as much as so many attempts.
    #[arg(long, value_name = "ATTEMPTS", value_parser = |text: &str| number_in(text, 0.0..=1e6))]
    drop_costs: Option<f64>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match &arguments.command {
        Command::Show(arguments) => show(arguments),
        Command::Adapt(arguments) => adapt_model(arguments),
        Command::Rule(arguments) => make_rule(arguments),
        Command::Approaches(arguments) => super::approaches::run(arguments),
    }
}

fn make_rule(arguments: &RuleArguments) -> anyhow::Result<Outcome> {
    let RuleArguments { hand, newtons, out, overwrite } = arguments;
    let hand = Hand::load(hand)?;
    check_new(out, &[], *overwrite)?;
    if hand.cell_unit != CellUnit::Newtons {
        bail!("--hand: the cells of {} read {}, and the rule needs newtons", hand.name, hand.cell_unit.word());
    }
    let model = plain_rule(&hand, *newtons, format!("model rule --newtons {newtons}"))?;
    model.save(out)?;
    let rule = model.look(Phase::TestLifted).map(|look| look.predictor.summary()).unwrap_or_default();
    print_text(&format!("{}: {rule}, after a test lift", out.display()))?;
    Ok(Outcome::Done)
}

fn adapt_model(arguments: &AdaptArguments) -> anyhow::Result<Outcome> {
    let recordings = recordings_in(&arguments.recordings)?;
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    let inputs = [recordings.as_slice(), std::slice::from_ref(&arguments.model)].concat();
    check_new(&arguments.out, &inputs, arguments.overwrite)?;
    let robots: Vec<String> = recordings.iter().map(|path| robot_of(path, &arguments.recordings)).collect();
    let before = Model::load(&arguments.model)?;
    let model = adapt(&hand, &before, &recordings, &robots)?;
    model.save(&arguments.out)?;
    let lines: Vec<String> = recalibration_line(&model).into_iter().chain(own_lifts_lines(&model)).collect();
    print_text(&format!("{}: {}", arguments.out.display(), lines.join("\n")))?;
    if let Some((estimate, bound)) = refuted(&before, &model) {
        let [estimate, bound] = [estimate, bound].map(|share| percent(Some(share)));
        print_diagnostic(&format!(
            "warning: {estimate} of the adapted model's lifts drop the object, and the model before promised at most {bound}: learn anew \
             with these lifts (blindgrasp train), or lift surer grasps only (blindgrasp set lift_arbiter.min_probability_stable)"
        ));
    }
    Ok(Outcome::Done)
}

/// The share of the own lifts that drop, and the bound of the model before, if they refute it.
fn refuted(before: &Model, adapted: &Model) -> Option<(f64, f64)> {
    let own = adapted.training.own_lifts.as_ref()?;
    let policy = before.training.policies.iter().find(|policy| policy.look == own.look)?;
    let (estimate, bound) = (own.promise?.drops_of_lifts.estimate, policy.promise?.drops_of_lifts.at_most);
    (estimate > bound).then_some((estimate, bound))
}

/// The name of the robot of a recording: the path of the file, without the number of a part, or the folder that was named.
fn robot_of(recording: &Path, named: &[PathBuf]) -> String {
    if !named.iter().any(|path| path == recording)
        && let Some(folder) = recording.parent().and_then(Path::file_name)
    {
        return folder.to_string_lossy().into_owned();
    }
    let stem = recording.with_extension("");
    let stem = stem.to_string_lossy();
    match stem.rsplit_once('-') {
        Some((name, number)) if number.len() == 5 && number.bytes().all(|byte| byte.is_ascii_digit()) => name.into(),
        _ => stem.into_owned(),
    }
}

fn day_line(model: &Model) -> Option<String> {
    Some(match &model.day.as_ref()?.method {
        DayMethod::Baseline(Baseline { min_grasps, .. }) => {
            format!("judged relative to the day's earlier grasps; the first {min_grasps} are held")
        }
        DayMethod::Novelty(days) => format!(
            "held on a day that is {:.2} deviations or more from the {} days of the training, and for its first {} grasps",
            days.limit,
            days.means.len(),
            days.min_grasps
        ),
    })
}

fn recalibration_line(model: &Model) -> Option<String> {
    let known = model.day.as_ref()?.recalibration.as_ref()?;
    Some(format!("log-odds of day {} are corrected by {} labelled grasps like them", known.day, known.grasps.len()))
}

/// The lifts of a robot that corrected the model, for people.
fn own_lifts_lines(model: &Model) -> Vec<String> {
    let Some(own) = &model.training.own_lifts else { return Vec::new() };
    let OwnLiftsSummary { n_lifts, n_kept, n_objects, correction, log_loss_before, log_loss_after, .. } = own;
    let losses = format!("log loss {log_loss_before:.3} before, {log_loss_after:.3} after, over folds of objects");
    let corrected = if *correction == Correction::default() {
        format!("the probabilities stay, because a correction makes them no better ({losses})")
    } else {
        let sign = if correction.b < 0.0 { '-' } else { '+' };
        let (a, b) = (correction.a, correction.b.abs());
        format!("when {}, log-odds are {a:.3} x those of the model {sign} {b:.3} ({losses})", own.look)
    };
    let world = match own {
        OwnLiftsSummary { in_simulation: true, .. } => "in simulation",
        OwnLiftsSummary { robots, .. } if robots.is_empty() => "on this robot",
        _ => "on these robots",
    };
    let mut lines = vec![format!(
        "by {} of {} {world}, {n_kept} kept: {corrected}",
        counted(n_lifts, "lift"),
        counted(n_objects, "object")
    )];
    if !own.taught_nothing.is_empty() {
        let n: usize = own.taught_nothing.values().sum();
        lines.push(format!("{n} other grasps taught nothing: {}", counts(&own.taught_nothing)));
    }
    if own.n_outside > 0 {
        lines.push(format!("limits are wider, because they held {} of these grasps", own.n_outside));
    }
    lines.push(match &own.promise {
        Some(promise) => format!("of these lifts it makes {}; promised {world}: {promise}", own.n_lifted),
        None => "of these lifts it makes none".into(),
    });
    for (robot, RobotLifts { n_lifts, n_kept, n_lifted, promise }) in &own.robots {
        let mut line = format!("{robot}: {}, {n_kept} kept; it makes {n_lifted}", counted(n_lifts, "lift"));
        if let Some(Promise { confidence, drops_of_lifts: drops, .. }) = promise {
            let [at_most, confidence] = [drops.at_most, *confidence].map(|share| percent(Some(share)));
            line += &format!(", of which at most {at_most} drop ({confidence} confidence)");
        }
        lines.push(line);
    }
    lines
}

fn show(arguments: &ShowArguments) -> anyhow::Result<Outcome> {
    let model = Model::load(&arguments.model)?;
    if arguments.json {
        print_text(&serde_json::to_string_pretty(&model_json(&model)?)?)?;
        return Ok(Outcome::Done);
    }
    print_model(&model, arguments.drop_costs)?;
    if arguments.drop_costs.is_some() && model.training.policies.last().is_none_or(|policy| policy.curve.is_empty()) {
        bail!("--drop-costs: the model has no curve of thresholds to choose from");
    }
    Ok(Outcome::Done)
}

/// Prints what a model is made of, for people.
pub(super) fn print_model(model: &Model, drop_costs: Option<f64>) -> std::io::Result<()> {
    for (name, value) in described(model) {
        print_line(&format!("{name:<16} {value}"))?;
    }
    for line in probe_lines(model) {
        print_line(&line)?;
    }
    if let Some(policy) = model.training.policies.last() {
        let kept = if is_of_the_papers_label(&model.training) { "stable" } else { "kept" };
        let own = own_threshold(model, &policy.look);
        let price = drop_costs.map(|drop_costs| (drop_costs, drop_costs == policy.drop_costs));
        print_text(&curve_lines(&policy.look, &policy.curve, kept, own, price).join("\n"))?;
    }
    Ok(())
}

/// The threshold of a model at the look of this phase.
pub(super) fn own_threshold(model: &Model, look: &str) -> f64 {
    let phase = Phase::ALL.iter().find(|phase| phase.as_str() == look);
    phase.and_then(|phase| model.look(*phase)).unwrap_or(&model.classifier).threshold_probability
}

/// The thresholds of the look that decides, for people, with the model's own and the cheapest for a price of a drop.
///
/// * `price` - the price, and whether training has chosen the model's own threshold for it: with the cost of probes, too.
pub(super) fn curve_lines(
    look: &str,
    curve: &[ThresholdPoint],
    kept: &str,
    own: f64,
    price: Option<(f64, bool)>,
) -> Vec<String> {
    let look = look.replace('_', "-");
    if curve.is_empty() {
        return vec![format!(
            "no curve of thresholds when {look}: the model was adapted, or an earlier version trained it (blindgrasp evaluate makes \
             one from labelled lifts)"
        )];
    }
    let cheapest = price.and_then(|price| cheapest(curve, own, price));
    let mut lines = vec![format!(
        "{:<27} {:>8} {:>9} {:>16} {:>9} {:>20}",
        format!("threshold when {look}"),
        kept,
        "recall",
        "attempts a lift",
        "given up",
        "drops at most (95 %)"
    )];
    for point in curve {
        let mut line = format!(
            "{:<27} {:>8} {:>9} {:>16.2} {:>9} {:>20}",
            format!("{:.4}", point.threshold_probability),
            percent(Some(point.kept)),
            percent(Some(point.recall)),
            point.attempts_per_lift,
            percent(Some(point.given_up)),
            percent(point.drops_at_most)
        );
        if point.threshold_probability == own {
            line += "  the model's own";
        }
        if Some(point) == cheapest {
            line += "  the cheapest for this price of a drop";
        }
        lines.push(line);
    }
    if let Some(point) = cheapest {
        // 0 is the model's own.
        let threshold = if point.threshold_probability == own { 0.0 } else { point.threshold_probability };
        lines.push(format!("to choose it: blindgrasp set lift_arbiter.min_probability_stable={threshold}"));
    }
    lines
}

/// The cheapest threshold for a price of a drop. Training has chosen `own` for its own price, with the cost of probes.
fn cheapest(curve: &[ThresholdPoint], own: f64, (drop_costs, is_of_training): (f64, bool)) -> Option<&ThresholdPoint> {
    if is_of_training {
        return curve.iter().find(|point| point.threshold_probability == own);
    }
    // Few grasps an object make attempts uncertain: a threshold that keeps less and lifts less is never better.
    let is_worse =
        |point: &ThresholdPoint| curve.iter().any(|other| other.kept >= point.kept && other.recall > point.recall);
    let cost = |point: &&ThresholdPoint| point.attempts_per_kept(drop_costs);
    curve.iter().filter(|point| !is_worse(point)).min_by(|a, b| cost(a).total_cmp(&cost(b)))
}

fn model_json(model: &Model) -> anyhow::Result<serde_json::Value> {
    let calibration = &model.classifier.calibration;
    let mut training = serde_json::to_value(&model.training)?;
    if let Some(trained_on) = training.get_mut("trained_on").and_then(serde_json::Value::as_object_mut) {
        trained_on.remove("grasps");
    }
    Ok(json!({
        "format": model.format,
        "hand": model.hand.name,
        "hand_id": format!("{:016x}", model.hand.id),
        "recipe": model.training.recipe,
        "sigma_m": model.features.sigma_m,
        "dictionary_m": model.features.dictionary.words_m,
        "predictor": predictor_json(&model.classifier.predictor),
        "calibration": { "method": "platt", "a": calibration.a, "b": calibration.b },
        "threshold_probability": model.classifier.threshold_probability,
        "unsure_from_probability": model.classifier.unsure_from_probability,
        "training_range": model.training_range,
        "squeezed": model.squeezed.as_ref().map(probe_json),
        "test_lifted": model.test_lifted.as_ref().map(probe_json),
        "approach": model.approach.as_ref().map(|prior| json!({
            "predictor": trees_json(&prior.trees),
            "cross_validated_roc_area": prior.cross_validated_roc_area,
        })),
        "day": model.day,
        "training": training,
        "checksum": model.checksum,
    }))
}

/// The properties of a model by their names, for people.
fn described(model: &Model) -> Vec<(&'static str, String)> {
    let Model { training, features, classifier, training_range, .. } = model;
    let mut described = vec![
        ("format", model.format.clone()),
        ("hand", format!("{} ({:016x})", model.hand.name, model.hand.id)),
        ("recipe", format!("{}, {} values", training.recipe.name, features.len())),
        ("dictionary", format!("{} words, sigma {} m", features.dictionary.words_m.len(), features.sigma_m)),
        ("predictor", classifier.predictor.summary()),
        ("calibration", format!("Platt, a {:.4}, b {:.4}", classifier.calibration.a, classifier.calibration.b)),
        ("threshold", threshold_line(classifier)),
    ];
    if training.n_grasps > 0 {
        described.extend(of_training(training, training_range));
    }
    let optional = [
        // A model that was made just now has none.
        ("checksum", (!model.checksum.is_empty()).then(|| model.checksum.clone())),
        ("label", label_line(&training.labels)),
        ("day", day_line(model)),
        ("recalibrated", recalibration_line(model)),
    ];
    for (name, line) in optional {
        described.extend(line.map(|line| (name, line)));
    }
    for (reason, n) in &training.n_excluded {
        described.push(("left out", format!("{n} with {reason}")));
    }
    described.extend(own_lifts_lines(model).into_iter().map(|line| ("adapted", line)));
    described
}

/// The properties that the training grasps gave a model.
fn of_training(training: &TrainingSummary, training_range: &TrainingRange) -> Vec<(&'static str, String)> {
    vec![
        (
            "training range",
            format!(
                "{} quantities have limits; those of other objects' grasps flag {} of the training grasps",
                training_range.limits.len(),
                percent(Some(training_range.share_flagged))
            ),
        ),
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
        (
            "probabilities",
            format!(
                "Brier score {:.4}, calibration error {:.4} (same folds)",
                training.cross_validated_brier, training.cross_validated_ece
            ),
        ),
    ]
}

/// The size and parameters of a predictor, without its support vectors or nodes.
fn predictor_json(predictor: &Predictor) -> serde_json::Value {
    match predictor {
        Predictor::Svm(svm) => svm_json(svm),
        Predictor::Boosting(trees) => trees_json(trees),
        Predictor::Loads(rule) => json!({ "kind": "loads", "rule": rule }),
        Predictor::Blend(Blend { trees, svm, svm_weight }) => json!({
            "kind": "blend",
            "boosting": trees_json(trees),
            "svm": svm_json(svm),
            "svm_weight": svm_weight,
        }),
    }
}

fn probe_json(probe: &ProbeModel) -> serde_json::Value {
    json!({
        "predictor": predictor_json(&probe.classifier.predictor),
        "calibration": { "method": "platt", "a": probe.classifier.calibration.a, "b": probe.classifier.calibration.b },
        "threshold_probability": probe.classifier.threshold_probability,
        "unsure_from_probability": probe.classifier.unsure_from_probability,
        "training_range": probe.training_range,
        "cross_validated_roc_area": probe.cross_validated_roc_area,
        "cross_validated_ece": probe.cross_validated_ece,
    })
}

fn svm_json(svm: &RbfSvm) -> serde_json::Value {
    json!({
        "kind": "svm",
        "kernel": "rbf",
        "gamma": svm.gamma,
        "rho": svm.rho,
        "n_features": svm.n_features,
        "n_support_vectors": svm.n_support_vectors(),
    })
}

fn trees_json(trees: &BoostedTrees) -> serde_json::Value {
    json!({
        "kind": "boosting",
        "n_features": trees.n_features,
        "n_trees": trees.trees.len(),
        "n_nodes": trees.n_nodes(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_is_named_by_its_file_or_folder() {
        let named = ["days/robot-a.mcap", "robot-b-00001.mcap", "robots/c/"].map(PathBuf::from);
        let robot = |path: &str| robot_of(Path::new(path), &named);
        assert_eq!(robot("days/robot-a.mcap"), "days/robot-a");
        assert_eq!(robot("robot-b-00001.mcap"), "robot-b");
        assert_eq!(robot("robots/c/2026-11-29.mcap"), "c");
    }

    #[test]
    fn the_price_of_a_drop_chooses_a_point_of_the_curve() {
        let point = |threshold_probability, kept, recall, attempts_per_lift| ThresholdPoint {
            threshold_probability,
            kept,
            recall,
            attempts_per_lift,
            given_up: 0.1,
            drops_at_most: Some(0.08),
        };
        // The last one keeps no more and lifts less: its few attempts are chance.
        let curve = [point(0.5, 0.9, 0.8, 2.0), point(0.933, 0.98, 0.5, 6.0), point(0.98, 0.98, 0.3, 1.0)];
        let marked = |price| curve_lines("test_lifted", &curve, "kept", 0.933, price);
        let lines = marked(None);
        assert_eq!((lines.len(), lines.iter().filter(|line| line.contains("cheapest")).count()), (4, 0));
        assert!(lines[2].contains("98.0 %") && lines[2].ends_with("8.0 %  the model's own"), "{lines:?}");
        // (2 + 10 x 0.1) / 0.9 = 3.3 attempts for each kept object, and (6 + 10 x 0.02) / 0.98 = 6.3.
        let lines = marked(Some((10.0, false)));
        assert!(lines[1].contains("cheapest") && lines[4].ends_with("min_probability_stable=0.5"), "{lines:?}");
        // 13.3 and 8.2.
        let lines = marked(Some((100.0, false)));
        assert!(lines[2].ends_with("the model's own  the cheapest for this price of a drop"), "{lines:?}");
        assert!(lines[4].ends_with("min_probability_stable=0"), "{lines:?}");
        assert_eq!(marked(Some((10.0, true))), lines, "training has counted probes, too");
        let none = curve_lines("test_lifted", &[], "kept", 0.933, None);
        assert!(none[0].starts_with("no curve of thresholds when test-lifted"), "{none:?}");
    }
}
