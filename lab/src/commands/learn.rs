//! `blindgrasp learn`: from a hand's description to a model that keeps a bound on drops, and the command that starts its graph.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use serde_json::json;

use super::evaluate::command_line;
use super::simulate::complete_folder;
use super::{Outcome, completions, number_in, percent, print_line, print_text, word, write_out, write_report};
use blindgrasp_cli::graph_file::{OnMisfit, able_to_begin};
use blindgrasp_cli::{in_shell, stop_signal};
use blindgrasp_graph::dataflow::{self, Override, Scope};
use blindgrasp_learning::evaluation::baselines::Baselines;
use blindgrasp_learning::evaluation::evaluate;
use blindgrasp_learning::evaluation::page::report_page;
use blindgrasp_learning::evaluation::report::{Origin, report_on_model};
use blindgrasp_learning::file_name;
use blindgrasp_learning::promise::least_bound;
use blindgrasp_learning::training::{Aim, Examples, TrainingError, TrainingOptions, train};
use blindgrasp_messages::Phase;
use blindgrasp_messages::score::Score;
use blindgrasp_objects::objects_named;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::recordings_in;
use blindgrasp_simulator::options::{SimulatorOptions, check_hand};
use blindgrasp_simulator::protocol::Approach;
use blindgrasp_simulator::trial::read_options;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, Probe};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::promise_monitor::drops_at_most;

/// The graph of a hand that lifts, which a project has.
const DATAFLOW: (&str, &str) = ("dataflow-live.yaml", include_str!("../../../dataflow-live.yaml"));
/// The bound on drops that is looked for.
const MAX_DROPS: f64 = 0.1;
/// A model that may drop more than this share of its lifts is of no use to a robot, and is not written.
const WORST_BOUND: f64 = 0.5;
/// The objects that are lifted for training.
const TRAIN: &str = "train";
/// The lifts of the first folder.
const FIRST_LIFTS: usize = 125;
/// The lifts from which a bound is looked for, if there may be more: fewer seldom tell kept objects from dropped ones.
const ENOUGH_LIFTS: usize = 500;
/// The lifts that judge a model.
const HELD_OUT_LIFTS: usize = 200;
/// The lifts of a part. An interruption loses those of one part.
const LIFTS_PER_PART: usize = 100;
/// The pause between two looks whether a training is to end.
const STOP_PAUSE: Duration = Duration::from_millis(100);
/// The page of the lifts that judge the model.
const REPORT: &str = "report.html";

/// Learn a hand: lift in simulation, train, judge
///
/// Lifts objects in simulation, trains a model, and makes more lifts until the model keeps the bound on drops for new objects.
/// Lifts of objects that had no part in it then judge the model. The last line is the command that starts its graph. The folder
/// gets all lifts, model.json and report.html; after Ctrl-C the same command goes on from the lifts that are there. If the bound is
/// not reached, the model promises the bound that it can keep, and the exit code is 1.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                  blindgrasp learn my_hand/my_hand.yaml\n  \
                  blindgrasp learn my_hand/my_hand.yaml --max-drops 0.05 --lifts 16000")]
pub(super) struct Arguments {
    /// Pad layout (YAML) of the hand.
    #[arg(add = completions::hands())]
    hand: PathBuf,
    /// The most lifts: 500 come first, and then as many as there are, again and again.
    #[arg(long, default_value_t = 8000, value_parser = clap::value_parser!(u64).range(FIRST_LIFTS as u64..=1_000_000))]
    lifts: u64,
    /// The bound: at most this share of the lifts drops, with 95 % confidence, for new objects like those lifted.
    #[arg(long, value_name = "SHARE", default_value_t = MAX_DROPS, value_parser = |text: &str| number_in(text, 1e-4..=WORST_BOUND))]
    max_drops: f64,
    /// The probe that the arm can make before it decides: test_lift, by 10 mm, squeeze or none.
    #[arg(long, default_value = "test_lift", value_parser = |text: &str| word::<Probe>(text, "none, squeeze or test_lift"))]
    probe: Probe,
    /// The robot does not see where objects are, so that the palm comes from anywhere.
    #[arg(long)]
    blind: bool,
    /// YAML file with options of the simulator, as of friction and skin (simulate --print-options).
    #[arg(long)]
    options: Option<PathBuf>,
    /// The folder [default: the name of the hand's file, with -gate]
    #[arg(short, long)]
    out: Option<PathBuf>,
    /// Seed of the lifts.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    seed: u64,
    /// Print the results as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let hand = hand_of(&arguments.hand)?;
    let options = options(arguments)?;
    check_bound(arguments)?;
    let stem = arguments.hand.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let out = arguments.out.clone().unwrap_or_else(|| format!("{stem}-gate").into());
    std::fs::create_dir_all(&out).with_context(|| format!("cannot make the folder {}", out.display()))?;
    let stop = stop_signal()?;
    let job = Job { arguments, hand, options, out, stop: &stop };
    let learned = job.learn()?;
    let look = look_of(&learned.model).context("expected a model with a promise")?;
    let score = job.judge(&learned.model, look.1)?;
    // The share of drops is at least what remains of the largest share that may be kept.
    let least_drops = 1.0 - drops_at_most(score.n_false_positive as u64, score.n_true_positive as u64);
    if least_drops > learned.bound {
        let (n, bound) = (score.n_false_positive, percent(Some(learned.bound)));
        bail!(
            "no model is written: {n} drops of {} lifts of held-out objects refute the bound of {bound}; --lifts {} learns from more, \
             and a greater --max-drops promises less",
            score.n_lift,
            2 * learned.n_lifts
        );
    }
    learned.model.save(&job.model_path())?;
    job.start(&learned, look, &score)?;
    if let Some(why) = learned.why_not {
        let (asked, n) = (percent(Some(arguments.max_drops)), learned.n_lifts);
        bail!("the bound of {asked} is not reached: {why}; --lifts {} goes on from these {n} lifts", 2 * n);
    }
    Ok(Outcome::Done)
}

/// A model, and the bound on drops that it keeps.
struct Learned {
    model: Model,
    n_lifts: usize,
    bound: f64,
    /// So often the lifts of the time were tested for a bound.
    n_looks: usize,
    /// Why this is not the bound that was asked for.
    why_not: Option<String>,
}

struct Job<'a> {
    arguments: &'a Arguments,
    hand: Hand,
    options: SimulatorOptions,
    out: PathBuf,
    stop: &'a AtomicBool,
}

impl Job<'_> {
    /// Makes lifts and trains until the bound is reached, or as many lifts are made as there may be.
    fn learn(&self) -> anyhow::Result<Learned> {
        let max_drops = self.arguments.max_drops;
        let sizes = sizes(self.arguments.lifts as usize);
        let folder = |idx: usize| self.out.join(format!("lifts-{}", idx + 1));
        let (mut recordings, mut n_lifts, mut n_looks) = (Vec::new(), 0, 0);
        for (idx, n) in sizes.iter().enumerate() {
            self.simulate(TRAIN, &folder(idx), *n, 1 + idx as u64)?;
            recordings.extend(recordings_in(&[folder(idx)])?);
            n_lifts += n;
            let is_last = idx + 1 == sizes.len();
            // If there are more, an earlier run found these too few.
            if !is_last && (n_lifts < ENOUGH_LIFTS || folder(idx + 1).is_dir()) {
                continue;
            }
            n_looks += 1;
            let error = match self.train(&recordings, max_drops) {
                Ok(model) => return Ok(Learned { model, n_lifts, bound: max_drops, n_looks, why_not: None }),
                Err(TrainingError::Dataset(error)) => return Err(error.into()),
                // More lifts of this hand would be like these.
                Err(TrainingError::Data(why)) if n_lifts >= ENOUGH_LIFTS => {
                    bail!("no model is written after {n_lifts} lifts: {why}")
                }
                Err(error) => error,
            };
            let best = error.best_bound().unwrap_or(1.0);
            let why = format!("{:#}", anyhow::Error::from(error));
            if !is_last {
                let so_far = if best < 1.0 { format!("the bound is {} so far", percent(Some(best))) } else { why };
                print_diagnostic(&format!("{n_lifts} lifts: {so_far}; more lifts follow"));
                continue;
            }
            if best > WORST_BOUND {
                bail!("no model is written: {why}; --lifts {} goes on from these {n_lifts} lifts", 2 * n_lifts);
            }
            // The model promises the bound that these lifts allow.
            let bound = (100.0 * best).ceil() / 100.0;
            let model = self.train(&recordings, bound)?;
            return Ok(Learned { model, n_lifts, bound, n_looks: n_looks + 1, why_not: Some(why) });
        }
        bail!("no lift was made")
    }

    fn simulate(&self, objects: &str, folder: &Path, n_lifts: usize, nth: u64) -> anyhow::Result<()> {
        // The seeds of neighbours would give the same lifts in part.
        let seed = (self.arguments.seed - 1) * 1000 + 1 + nth;
        let options = SimulatorOptions { n_grasps: n_lifts, seed, ..self.options.clone() };
        complete_folder(&self.hand, objects, &options, folder, self.stop)
    }

    fn train(&self, recordings: &[PathBuf], max_drops: f64) -> Result<Model, TrainingError> {
        print_diagnostic("training …");
        let (training, is_over) = channel::<()>();
        std::thread::scope(|scope| {
            scope.spawn(|| self.exit_if_stopped(is_over));
            let model = self.train_model(recordings, max_drops);
            drop(training);
            model
        })
    }

    /// Ends the program at a signal, until the sender is gone: a step of a training may take minutes.
    fn exit_if_stopped(&self, is_over: Receiver<()>) {
        while is_over.recv_timeout(STOP_PAUSE) == Err(RecvTimeoutError::Timeout) {
            if self.stop.load(Ordering::Relaxed) {
                print_diagnostic("interrupted: the lifts are kept, and the same command goes on from them");
                std::process::exit(1);
            }
        }
    }

    fn train_model(&self, recordings: &[PathBuf], max_drops: f64) -> Result<Model, TrainingError> {
        let mut read = Examples::read(&self.hand, recordings, |_, _| {})?;
        for example in &mut read.examples {
            if self.arguments.probe == Probe::None {
                example.squeezed = None;
            }
            if self.arguments.probe != Probe::TestLift {
                example.test_lifted = None;
            }
        }
        let options = TrainingOptions { aim: Some(Aim::MaxDrops(max_drops)), ..TrainingOptions::default() };
        train(&self.hand, &read, recordings, &options, |step| {
            if step.starts_with("not learned") {
                print_diagnostic(step);
            }
        })
    }

    /// Judges lifts of objects that had no part in the training, as the graph would, and writes the report.
    fn judge(&self, model: &Model, probe: Probe) -> anyhow::Result<Score> {
        let folder = self.out.join("held-out");
        self.simulate("held-out", &folder, HELD_OUT_LIFTS, 0)?;
        let recordings = recordings_in(&[folder])?;
        let options = ArbiterOptions { probe, ..ArbiterOptions::default() };
        let evaluated = evaluate(&self.hand, model, &recordings, &options)?;
        let score = evaluated.evaluation.score.clone();
        let read = Examples::read(&self.hand, &recordings, |_, _| {})?;
        let origin = Origin {
            command: command_line(),
            hand: self.hand.name.clone(),
            recordings: recordings.iter().map(|path| file_name(path)).collect(),
        };
        let baselines = Baselines::new(model, &read, &[]);
        let report = report_on_model(origin, &file_name(&self.model_path()), model, evaluated, &read, baselines, None);
        write_report(&self.out.join(REPORT), &report_page(&self.hand, &report)?)?;
        Ok(score)
    }

    /// Prints the results and the command that starts the graph, and checks the command as `run --check` does.
    fn start(&self, learned: &Learned, (_, probe, param, words): Look, score: &Score) -> anyhow::Result<()> {
        let mut dataflow = PathBuf::from(DATAFLOW.0);
        if !dataflow.is_file() {
            dataflow = self.out.join(DATAFLOW.0);
        }
        if !dataflow.is_file() {
            write_out(&dataflow, DATAFLOW.1)?;
        }
        let (model, report) = (self.model_path(), self.out.join(REPORT));
        let settings = [
            ("hand", self.arguments.hand.display().to_string()),
            ("model", model.display().to_string()),
            ("probe", param.into()),
            ("promised_drops", learned.bound.to_string()),
        ];
        let mut line = format!("blindgrasp run {}", in_shell(&dataflow.display().to_string()));
        for (param, text) in &settings {
            line += &format!(" --set {param}={}", in_shell(text));
        }
        if self.arguments.json {
            print_text(&serde_json::to_string_pretty(&json!({
                "n_lifts": learned.n_lifts, "promised_drops": learned.bound, "n_looks": learned.n_looks,
                "why_not_max_drops": learned.why_not, "probe": probe, "judged": score,
                "model": model, "report": report, "run": line,
            }))?)?;
        } else {
            let bound = percent(Some(learned.bound));
            print_line(&format!(
                "decided {words}, at most {bound} of the lifts of new objects drop (in simulation, 95 % confidence for one look at the \
                 bound; this was look {})",
                learned.n_looks
            ))?;
            print_line(&format!(
                "judged on {} lifts of objects that had no part in it: {} of them keep the object; the model makes {}, of which {} do",
                score.n_grasps, score.n_stable, score.n_lift, score.n_true_positive
            ))?;
            print_line(&format!("model: {}, report: {}", model.display(), report.display()))?;
            print_text(&format!("start the graph of your hand:\n  {line}"))?;
        }
        let set = |(param, text): (&str, String)| Override { node: None, param: param.into(), text };
        let overrides: Vec<Override> = settings.into_iter().map(set).collect();
        able_to_begin(&dataflow::load(&dataflow)?, &overrides, Scope::Everything, OnMisfit::Refuse)?;
        Ok(())
    }

    fn model_path(&self) -> PathBuf {
        self.out.join("model.json")
    }
}

/// The numbers of lifts that are made one after the other, at most `most` in all. Those of a greater number begin with the same.
fn sizes(most: usize) -> Vec<usize> {
    let mut n_lifts = FIRST_LIFTS;
    let mut sizes = vec![n_lifts];
    while 2 * n_lifts <= most {
        sizes.push(n_lifts);
        n_lifts *= 2;
    }
    sizes
}

/// Refuses a bound that the most lifts cannot show, even if none drops.
fn check_bound(arguments: &Arguments) -> anyhow::Result<()> {
    let n_lifts: usize = sizes(arguments.lifts as usize).iter().sum();
    let n_objects = objects_named(TRAIN)?.0.len().min(n_lifts);
    let least = least_bound(n_objects);
    if arguments.max_drops < least {
        bail!(
            "--max-drops {}: {n_lifts} lifts of {n_objects} objects, all kept, show that at most {:.2} % drop; expected {:.4} or more",
            arguments.max_drops,
            100.0 * least,
            (1e4 * least).ceil() / 1e4
        );
    }
    Ok(())
}

/// The hand, whose file the graph will read.
fn hand_of(path: &Path) -> anyhow::Result<Hand> {
    let hand = Hand::load(path)?;
    if !path.exists() {
        let name = path.display();
        bail!(
            "{name} is a built-in hand, and a graph needs its files: blindgrasp init FOLDER --hand {name} writes them, then learn \
             FOLDER/hands/{name}.yaml"
        );
    }
    check_hand(&hand)?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    Ok(hand)
}

fn options(arguments: &Arguments) -> anyhow::Result<SimulatorOptions> {
    let mut options = match &arguments.options {
        Some(path) => read_options(path)?,
        None => SimulatorOptions::default(),
    };
    options.label = Label::Lift;
    options.stable_fraction = None;
    options.grasps_per_part = LIFTS_PER_PART;
    options.protocol.approach = if arguments.blind { Approach::Blind } else { Approach::Planned };
    options.check()?;
    Ok(options)
}

/// A look that may decide: its phase, the arbiter's param `probe`, and words for it.
type Look = (Phase, Probe, &'static str, &'static str);

/// The look that keeps the bound; the one that feels most, if several do.
fn look_of(model: &Model) -> Option<Look> {
    let looks = [
        (Phase::TestLifted, Probe::TestLift, "test_lift", "after a test lift"),
        (Phase::Squeezed, Probe::Squeeze, "squeeze", "after a squeeze"),
        (Phase::Settled, Probe::None, "none", "when the hand has settled"),
    ];
    let policies = &model.training.policies;
    let is_promised =
        |look: &Look| policies.iter().any(|policy| policy.look == look.0.as_str() && policy.promise.is_some());
    looks.into_iter().find(is_promised)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lifts_double_up_to_their_number_and_go_on_from_fewer() {
        assert_eq!(sizes(8000), [125, 125, 250, 500, 1000, 2000, 4000]);
        assert_eq!(sizes(1999), sizes(8000)[..4]);
    }
}
