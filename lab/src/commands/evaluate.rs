//! `blindgrasp evaluate`

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::model::{curve_lines, own_threshold};
use super::{
    Outcome, check_output, check_page, completions, number_in, percent, print_line, print_text, word, write_out,
    write_report,
};
use blindgrasp_grasps::dataset::{hand_of_all, label_line, labels_of};
use blindgrasp_learning::evaluation::baselines::Baselines;
use blindgrasp_learning::evaluation::cross_validation::{HeldOutOptions, judge_held_out};
use blindgrasp_learning::evaluation::looks::Look;
use blindgrasp_learning::evaluation::page::{FIGURE_1_FILE, figure_1, report_page};
use blindgrasp_learning::evaluation::predictions::{OutsidePredictions, predictions_csv};
use blindgrasp_learning::evaluation::report::{
    Origin, Report, THRESHOLD_PROBABILITY, report_on_model, report_on_predictions, report_on_recipes,
};
use blindgrasp_learning::evaluation::split::{Split, split_into_folds};
use blindgrasp_learning::evaluation::statistics::Estimate;
use blindgrasp_learning::evaluation::{Evaluated, Score, Trained, evaluate};
use blindgrasp_learning::file_name;
use blindgrasp_learning::training::{Example, Examples};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, Probe};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::recipe::Recipe;

/// The file among the figures with the probability of each grasp.
const PREDICTIONS_FILE: &str = "predictions.csv";
/// The folds of objects of the baseline that is learned from the judged grasps.
const N_BASELINE_FOLDS: usize = 5;

/// Compare decisions with labels, on recordings or by folds
///
/// A model decides every grasp of the recordings as the graph would. Recipes (--split) are trained on a part of the
/// grasps and judged on the rest, fold by fold, so that no classifier judges a grasp that it was trained on. Predictions of any
/// other model (--predictions) are judged by the same figures, alone or beside a model or recipes.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp evaluate models/barrett-bh8-280.json recordings/held-out.mcap\n  \
                        blindgrasp evaluate gate.json lifts --drop-costs 60           which threshold, if a drop costs as much as 60 attempts\n  \
                        blindgrasp evaluate data/paper --split object --folds 5 --report report.html\n  \
                        blindgrasp evaluate data/paper --split class --recipe boosted,paper,raw --json\n  \
                        blindgrasp evaluate data/paper --split object --predictions mine.csv  a model of your own beside them\n\n\
                        Positive means lifted: a false positive is an object dropped.")]
pub(super) struct Arguments {
    /// A model (its name ends in .json) and recordings (MCAP), or folders of them; with --split, recordings only. With
    /// --predictions the model may be left out.
    #[arg(required = true, value_name = "[MODEL] RECORDING")]
    inputs: Vec<PathBuf>,
    /// The probe after which the model's arbiter decides: none, squeeze or test_lift; the recordings need its frames.
    #[arg(long, default_value = "none", value_parser = |text: &str| word::<Probe>(text, "none, squeeze or test_lift"), conflicts_with = "split")]
    probe: Probe,
    /// Train recipes on a part of the grasps and judge the rest, by folds that share no grasp, object or class.
    #[arg(long, value_parser = ["grasp", "object", "class"])]
    split: Option<String>,
    /// The number of folds.
    #[arg(long, default_value_t = 10, requires = "split", value_parser = clap::value_parser!(u64).range(2..=1000))]
    folds: u64,
    /// The recipes to judge, separated by commas; the first one is compared with the others.
    #[arg(long, requires = "split", value_delimiter = ',', default_value = "boosted,paper", value_parser = Recipe::NAMES)]
    recipe: Vec<String>,
    /// The seed of folds, K-means and boosting.
    #[arg(long, default_value_t = 1, requires = "split")]
    seed: u64,
    /// Judge what other models say of these grasps (CSV): the columns grasp_id and probability_stable, for several recordings
    /// also recording, for several models also model.
    #[arg(long, value_name = "FILE")]
    predictions: Option<PathBuf>,
    /// The models of --predictions lift from this probability on.
    #[arg(long, value_name = "PROBABILITY", requires = "predictions", default_value_t = THRESHOLD_PROBABILITY,
          value_parser = |text: &str| number_in(text, 1e-6..=1.0))]
    threshold: f64,
    /// Write a report with tables and pictures (HTML).
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Write to this folder: the probability and fold of each grasp (predictions.csv), and Figure 1 (SVG). The page of --report
    /// saves its charts as SVG.
    #[arg(long, value_name = "FOLDER")]
    figures: Option<PathBuf>,
    /// Mark the threshold of the model with the least attempts for each kept object on these lifts, if a drop costs as much as so
    /// many attempts.
    #[arg(long, value_name = "ATTEMPTS", conflicts_with_all = ["split", "json"], value_parser = |text: &str| number_in(text, 0.0..=1e6))]
    drop_costs: Option<f64>,
    /// Pad layout of the hand; default: that of the first recording, if its name is a built-in one.
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Print JSON, with every number of the report.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let is_model = |path: &Path| path.extension().is_some_and(|extension| extension == "json");
    let (model, recordings) = match arguments.inputs.split_first() {
        Some((first, rest)) if is_model(first) => (Some(first), rest),
        _ => (None, arguments.inputs.as_slice()),
    };
    let split = arguments.split.as_deref().and_then(Split::named);
    match (model, split) {
        (Some(model), Some(_)) => bail!(
            "{} is a model, and --split trains anew for each fold: give recordings only, or leave out --split",
            model.display()
        ),
        (None, None) if arguments.predictions.is_none() => bail!(
            "{}: expected a model first (its name ends in .json), --split grasp, object or class to train and judge \
             on these recordings, or --predictions of another model",
            arguments.inputs.first().map_or(Path::new(""), PathBuf::as_path).display()
        ),
        (None, None) if arguments.is_for_a_model() => bail!(
            "--probe, --drop-costs: predictions are judged as they are: give a model as well, or leave these options out"
        ),
        (Some(model), None) if recordings.is_empty() => {
            bail!("nothing to judge {} on: name recordings after it", model.display())
        }
        _ => {}
    }
    // Check files before the long work.
    let model = model.map(|path| Ok::<_, anyhow::Error>((path, Model::load(path)?))).transpose()?;
    if let Some((path, model)) = &model {
        blindgrasp_cli::check_probe(path, model, arguments.probe)?;
    }
    let recordings = recordings_in(recordings)?;
    let inputs = [recordings.as_slice(), &arguments.inputs, arguments.predictions.as_slice()].concat();
    if let Some(report) = &arguments.report {
        check_page(report, &inputs)?;
    }
    if let Some(folder) = arguments.figures.as_ref().filter(|folder| folder.is_dir()) {
        check_output(&folder.join(PREDICTIONS_FILE), &inputs)?;
    }
    let hand = hand_of_all(&recordings, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let origin = Origin {
        command: command_line(),
        hand: hand.name.clone(),
        recordings: recordings.iter().map(|path| file_name(path)).collect(),
    };
    let job = Job { arguments, hand: &hand, recordings: &recordings, origin };
    match (model, split) {
        (Some((path, model)), _) => job.model(path, &model),
        (None, Some(split)) => job.recipes(split),
        (None, None) => job.predictions(),
    }
}

impl Arguments {
    fn is_for_a_model(&self) -> bool {
        self.probe != Probe::None || self.drop_costs.is_some()
    }
}

/// The inputs that models and recipes have in common.
struct Job<'a> {
    arguments: &'a Arguments,
    hand: &'a Hand,
    recordings: &'a [PathBuf],
    origin: Origin,
}

impl Job<'_> {
    fn model(self, path: &Path, model: &Model) -> anyhow::Result<Outcome> {
        let options = ArbiterOptions { probe: self.arguments.probe, ..ArbiterOptions::default() };
        let evaluated = evaluate(self.hand, model, self.recordings, &options)?;
        let is_table = !self.arguments.json;
        if is_table {
            print_scores(&evaluated)?;
            print_label(self.recordings)?;
        }
        let mut read = Examples::read(self.hand, self.recordings, |_, _| {})?;
        if let Some(trained_on) = &model.training.trained_on {
            read.examples.retain(|example| !trained_on.grasps.contains(&example.reading_id));
        }
        let baselines = Baselines::new(model, &read, &self.joints_alone(model, &read.examples));
        let outside = self.outside(&read, &[file_name(path)])?;
        let name = file_name(path);
        let report = report_on_model(self.origin.clone(), &name, model, evaluated, &read, baselines, outside.as_ref());
        if is_table {
            print_looks(&report.looks)?;
            print_baselines(report.baselines.as_ref())?;
            self.print_curve(model, report.baselines.as_ref())?;
            if outside.is_some() {
                print_judges(&report)?;
            }
        }
        self.deliver(&report)
    }

    /// Prints what other thresholds of the model lead to on these lifts.
    fn print_curve(&self, model: &Model, baselines: Option<&Baselines>) -> anyhow::Result<()> {
        let drop_costs = self.arguments.drop_costs;
        let Some(Baselines { look, curve, .. }) = baselines.filter(|baselines| !baselines.curve.is_empty()) else {
            if drop_costs.is_some() {
                bail!(
                    "--drop-costs: these recordings lead to no curve of thresholds: expected lifts (simulate --label lift, or of a \
                     robot), some kept and some dropped, of which the model lifts some"
                );
            }
            return Ok(());
        };
        print_text(
            &curve_lines(look, curve, "kept", own_threshold(model, look), drop_costs.map(|price| (price, false)))
                .join("\n"),
        )?;
        let recordings: Vec<String> =
            self.arguments.inputs[1..].iter().map(|path| path.display().to_string()).collect();
        Ok(print_line(&format!(
            "thresholds: for trials with the lifts of {} that some cell feels, each judged by one frame; lifts of objects that the \
             model has learned from make them too good",
            recordings.join(", ")
        ))?)
    }

    /// The probabilities of lifts by a model of the joint angles alone, each by one that has not learned from its object. Empty
    /// for a model without probes, and if the grasps are too few to learn from.
    fn joints_alone(&self, model: &Model, examples: &[Example]) -> Vec<f64> {
        if model.squeezed.is_none() && model.test_lifted.is_none() {
            return Vec::new();
        }
        let recipes: Vec<Recipe> = Recipe::named("joints").into_iter().collect();
        let options =
            HeldOutOptions { split: Split::Object, n_folds: N_BASELINE_FOLDS, recipes, seed: model.training.seed };
        let examples: Vec<&Example> = examples.iter().collect();
        let Ok(held_out) = judge_held_out(self.hand, &examples, &options, |_| {}) else { return Vec::new() };
        held_out.probabilities.into_iter().next().unwrap_or_default()
    }

    fn predictions(self) -> anyhow::Result<Outcome> {
        let read = Examples::read(self.hand, self.recordings, |_, _| {})?;
        let outside = self.outside(&read, &[])?.context("expected predictions")?;
        let report = report_on_predictions(self.origin.clone(), &read, &outside);
        if !self.arguments.json {
            print_judges(&report)?;
            print_label(self.recordings)?;
        }
        self.deliver(&report)
    }

    /// The predictions of outside models for these examples, if there are any. `names` are those of blindgrasp's judges.
    fn outside(&self, read: &Examples, names: &[String]) -> anyhow::Result<Option<OutsidePredictions>> {
        let Some(path) = &self.arguments.predictions else { return Ok(None) };
        let outside = OutsidePredictions::read(path, self.recordings, read, self.arguments.threshold)?;
        outside.check_names(names)?;
        if outside.n_unused > 0 {
            print_diagnostic(&format!(
                "{}: {} predictions are not used: no cell feels their grasps, or they are left out",
                path.display(),
                outside.n_unused
            ));
        }
        Ok(Some(outside))
    }

    fn recipes(self, split: Split) -> anyhow::Result<Outcome> {
        let arguments = self.arguments;
        let mut recipes = Vec::new();
        for name in &arguments.recipe {
            let recipe = Recipe::named(name).context("no such recipe")?;
            if recipes.contains(&recipe) {
                bail!("recipe {name} is named twice: expected each once");
            }
            recipes.push(recipe);
        }
        let options =
            HeldOutOptions { split, n_folds: usize::try_from(arguments.folds)?, recipes, seed: arguments.seed };
        let read = Examples::read(self.hand, self.recordings, |_, _| {})?;
        let examples: Vec<&Example> = read.examples.iter().collect();
        let outside = self.outside(&read, &arguments.recipe)?;
        if let Some(outside) = &outside {
            let folds = split_into_folds(split, &examples, options.n_folds, options.seed)?;
            outside.check_folds(&read.examples, &folds)?;
        }
        let bar = progress_bar();
        let held_out = judge_held_out(self.hand, &examples, &options, |step| {
            bar.set_length(step.n as u64);
            bar.set_position(step.n_done as u64);
            bar.set_message(step.what.clone());
            if bar.is_hidden() {
                print_diagnostic(&format!("{} of {}: {} …", step.n_done + 1, step.n, step.what));
            }
        });
        bar.finish_and_clear();
        let report = report_on_recipes(self.origin.clone(), &read, &options, &held_out?, outside.as_ref());
        if !arguments.json {
            print_judges(&report)?;
            print_label(self.recordings)?;
        }
        self.deliver(&report)
    }

    /// Writes and prints the report as the options say.
    fn deliver(&self, report: &Report) -> anyhow::Result<Outcome> {
        if let Some(path) = &self.arguments.report {
            write_report(path, &report_page(self.hand, report)?)?;
            if !self.arguments.json {
                print_line(&format!("report: {}", path.display()))?;
            }
        }
        if let Some(folder) = &self.arguments.figures {
            std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
            if let Some(picture) = figure_1(self.hand, report)? {
                write_out(&folder.join(FIGURE_1_FILE), &picture)?;
            }
            write_out(&folder.join(PREDICTIONS_FILE), &predictions_csv(&report.judges, self.recordings)?)?;
        }
        if self.arguments.json {
            print_text(&serde_json::to_string_pretty(report)?)?;
        }
        Ok(Outcome::Done)
    }
}

fn progress_bar() -> ProgressBar {
    let bar = ProgressBar::new(0);
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len}, {elapsed} ({msg})") {
        bar.set_style(style);
    }
    bar
}

/// The command as it could be given again.
pub(super) fn command_line() -> String {
    let plain = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_alphanumeric() || "-_=./,:+@%".contains(c));
    let quoted =
        |argument: String| if plain(&argument) { argument } else { format!("'{}'", argument.replace('\'', r"'\''")) };
    let arguments = std::env::args_os().skip(1).map(|argument| quoted(argument.to_string_lossy().into_owned()));
    std::iter::once("blindgrasp".to_string()).chain(arguments).collect::<Vec<_>>().join(" ")
}

/// Prints the definition of stable in the recordings, unless it is the wrench space's in all.
fn print_label(recordings: &[PathBuf]) -> anyhow::Result<()> {
    label_line(&labels_of(recordings)?).map_or(Ok(()), |label| Ok(print_line(&format!("label: {label}"))?))
}

/// Prints a model's decisions by class.
fn print_scores(Evaluated { evaluation, trained, .. }: &Evaluated) -> anyhow::Result<()> {
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
    if let Some(trained) = trained.as_ref().filter(|trained| trained.trained_objects.n_grasps > 0) {
        row("new objects", &trained.new_objects)?;
        row("trained objects", &trained.trained_objects)?;
    }
    let reasons: Vec<_> = evaluation.by_reason.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    print_line(&format!("reasons: {}", reasons.join(", ")))?;
    print_line("judged: without grasps that were held for another reason than the classifier's")?;
    match trained {
        Some(Trained { n_left_out: 0, .. }) => {}
        Some(trained) => print_line(&format!("left out: {} grasps that the model was trained on", trained.n_left_out))?,
        None => print_line("the model does not name its training grasps: some of these may be among them")?,
    }
    if evaluation.n_without_truth > 0 {
        print_line(&format!("without truth, not scored: {}", evaluation.n_without_truth))?;
    }
    Ok(())
}

/// Prints how well each stage of a model with probes judges.
fn print_looks(looks: &[Look]) -> anyhow::Result<()> {
    if looks.is_empty() {
        return Ok(());
    }
    print_line("stage         grasps    stable  ROC area  calibration error  lifted by the thresholds, stable ones")?;
    for look in looks {
        let share = |n: usize, of: usize| percent((of > 0).then(|| n as f64 / of as f64));
        print_line(&format!(
            "{:<12} {:>7} {:>9} {:>9} {:>18.4}  {} ({}), {} ({})",
            look.look,
            look.n_grasps,
            share(look.n_stable, look.n_grasps),
            look.roc_area.map_or("n/a".into(), |area| format!("{area:.3}")),
            look.ece,
            look.n_lifted,
            share(look.n_lifted, look.n_grasps),
            look.n_kept,
            share(look.n_kept, look.n_lifted),
        ))?;
    }
    print_line("stages: of the grasps that some cell feels, each by one frame")?;
    Ok(())
}

/// Prints plain rules beside the model.
fn print_baselines(baselines: Option<&Baselines>) -> anyhow::Result<()> {
    let Some(baselines) = baselines else { return Ok(()) };
    let head = format!("rule, {} grasps", baselines.look.replace('_', "-"));
    let limit = percent(Some(baselines.false_positive_rate));
    print_line(&format!("{head:<60} ROC area  recall at {limit} of the unstable"))?;
    for rule in &baselines.rules {
        let area = rule.roc_area.map_or("n/a".into(), |area| format!("{area:.3}"));
        print_line(&format!("{:<60} {area:>8}  {:>6}", rule.name, percent(Some(rule.recall))))?;
    }
    Ok(print_line(&baselines.in_words())?)
}

fn share(estimate: Option<Estimate>) -> String {
    percent(estimate.map(|estimate| estimate.value))
}

fn with_interval(estimate: Option<Estimate>) -> String {
    let interval = estimate.and_then(|estimate| estimate.interval);
    let interval = interval.map(|interval| format!(" ({:.1}..{:.1})", 100.0 * interval.low, 100.0 * interval.high));
    format!("{}{}", share(estimate), interval.unwrap_or_default())
}

/// Prints the judges and their comparisons.
fn print_judges(report: &Report) -> anyhow::Result<()> {
    let width = report.judges.iter().map(|judge| judge.name.chars().count()).max().unwrap_or(0).max(11);
    let head = if report.made.predictions.is_some() { "model" } else { "recipe" };
    print_line(&format!(
        "{head:<width$} accuracy             of all grasps  false positives    of unstable  recall   ROC area"
    ))?;
    for judge in &report.judges {
        let m = &judge.judged;
        print_line(&format!(
            "{:<width$} {:<20} {:>13}  {:<18} {:>11}  {:<8} {}",
            judge.name,
            with_interval(m.accuracy),
            share(judge.all.accuracy),
            with_interval(m.false_positive_share),
            share(m.false_positive_rate),
            share(m.recall),
            judge.roc_auc.map_or("n/a".into(), |area| format!("{area:.3}")),
        ))?;
    }
    for pair in &report.comparisons {
        print_line(&format!(
            "{} against {}: {} fewer errors; {} fewer false positives at the same recall; McNemar's p {:.1e}",
            pair.first,
            pair.second,
            with_interval(pair.relative_error_reduction),
            with_interval(pair.at_equal_recall.as_ref().and_then(|equal| equal.relative_reduction)),
            pair.mcnemar_p,
        ))?;
    }
    let data = &report.data;
    print_line(&format!(
        "judged: {} grasps of {} objects; held without a judgement: {}, {} of them stable",
        data.n_judged, data.n_judged_objects, data.n_held_unjudged, data.n_held_unjudged_stable
    ))?;
    for (reason, n) in &data.n_excluded {
        print_line(&format!("left out: {n} with {reason}"))?;
    }
    Ok(())
}
