//! `blindgrasp trials`

mod setup;
mod watch;

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use rayon::prelude::*;

use self::setup::Setup;
use self::watch::{Watch, Watched};
use super::evaluate::command_line;
use super::{Outcome, check_page, completions, print_line, print_text, stop_requests, word, write_report};
use blindgrasp_cli::shard::{Shard, all_shards};
use blindgrasp_graph::dataflow::{self, Override};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_learning::trials::late_decisions::LateDecisions;
use blindgrasp_learning::trials::page::{Made, Strip, strip, telling_records, trials_page};
use blindgrasp_learning::trials::tables::{Table, TrialsReport, tables};
use blindgrasp_messages::files::read_regular;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::LiveOptions;
use blindgrasp_session::run::Session;
use blindgrasp_simulator::trial::targets::{check_approaches, targets_and_warnings};
use blindgrasp_simulator::trial::{LiftTarget, PhysicsEngine, TrialOptions};

/// Counter of simulated_hand for trials that no approach led to.
const LEFT_OUT: &str = "left_out";

/// Most trials of which a report shows pictures.
const MAX_STRIPS: usize = 18;

/// Lift objects in simulated physics, as the paper did
///
/// Repeat the paper's robot experiment in simulated physics: lift when the graph decides so, and count the kept objects.
///
/// A simulated hand takes the robot's place. Its samples go through the same processes as a robot's would, and it obeys the
/// arbiter: it lifts, or lets go and tries again. With --lift-policy both the same trials are made a second time with
/// every settled grasp lifted, which shows the worth of the decision.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp trials                                           the paper's 110 trials, with and without the decision\n  \
                        blindgrasp trials --trials 11 --lift-policy decision        each of its objects once\n  \
                        blindgrasp trials --trials 11 --physics mujoco              the same in a physics of others\n  \
                        blindgrasp trials --objects held-out --trials 240 --report trials.html\n  \
                        blindgrasp trials --objects box-02@0.3kg@mu0.5,paper/mug --trials 40 --json\n\n\
                        Ctrl-C ends the run; the trials made so far are shown. The same seed gives the same trials.")]
pub(super) struct Arguments {
    /// Objects to lift, separated by commas: paper, one of its groups (paper/mug), objects, classes and splits of the
    /// catalogue, meshes. @MASSkg and @muFRICTION behind a name replace its mass and friction.
    #[arg(long, default_value = "paper", add = completions::objects())]
    objects: String,
    /// Number of trials; the objects take turns.
    #[arg(long, default_value_t = 110, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    trials: u64,
    /// Number of attempts without a lift after which a trial is given up.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=65_535))]
    attempts: u32,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64))]
    seed: u64,
    /// When the hand lifts: decision, as the graph decides; always, every settled grasp; both, one after the other.
    #[arg(long, default_value = "both")]
    lift_policy: LiftPolicy,
    /// The model instead of the dataflow file's.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// File of options (YAML or JSON) that replace the defaults; --print-options prints them all.
    #[arg(long, value_name = "FILE")]
    options: Option<PathBuf>,
    /// Physics engine instead of that of the options: rapier, the built-in one; mujoco (pip install 'blindgrasp[mujoco]').
    #[arg(long, value_parser = physics)]
    physics: Option<PhysicsEngine>,
    /// Print all options with their defaults and what they mean, as YAML, and stop.
    #[arg(long)]
    print_options: bool,
    /// The dataflow file. Its variable SOURCE is simulated_hand; one of its nodes must report the outcomes of lifts, as that does.
    #[arg(long, default_value = "dataflow-live.yaml")]
    dataflow: PathBuf,
    /// Name of the running graph; default: the file's.
    #[arg(long)]
    name: Option<String>,
    /// Replace a param of the file; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "[NODE.]PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Record every edge to this file (MCAP); --lift-policy may not be both.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Replace an existing recording.
    #[arg(long, requires = "record")]
    overwrite: bool,
    /// Write a report with the tables (HTML), and without --merge pictures of some of the trials.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Make only every N-th trial, from the I-th on (0/N to N-1/N). Trials of a graph that learns from its lifts depend on the
    /// shards.
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Merge the JSON of all shards into that of the whole.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["objects", "trials", "attempts", "seed", "lift_policy",
          "model", "options", "physics", "dataflow", "name", "overrides", "shard", "record"])]
    merge: Vec<PathBuf>,
    /// Print JSON, with every attempt.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LiftPolicy {
    Decision,
    Always,
    Both,
}

pub(super) fn physics(text: &str) -> Result<PhysicsEngine, String> {
    word(text, "rapier or mujoco")
}

/// One way to make the trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Way {
    /// The hand lifts only if the decision is to lift.
    obeys: bool,
    /// Name in tables.
    name: &'static str,
}

const WAYS: [Way; 2] = [Way { obeys: true, name: "with the gate" }, Way { obeys: false, name: "every grasp lifted" }];

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if arguments.print_options {
        print_text(TrialOptions::DEFAULTS.trim_end())?;
        return Ok(Outcome::Done);
    }
    check_arguments(arguments)?;
    if !arguments.merge.is_empty() {
        return merge(arguments);
    }
    let (targets, warnings) = targets_and_warnings(&arguments.objects)?;
    warnings.iter().for_each(|warning| print_diagnostic(&format!("warning: {warning}")));
    let setup = Setup::new(arguments)?;
    print_diagnostic("looking for an approach to each object …");
    let left_out = check_approaches(&setup.hand, &targets, &setup.options, arguments.seed, arguments.trials)?;
    if !left_out.is_empty() {
        print_diagnostic(&format!(
            "warning: left out, because no approach leads the open hand to them without touching the table before: {}",
            left_out.join(", ")
        ));
    }
    // It also ends the work after the graph.
    let n_stops = stop_requests()?;
    let mut report = empty_report(arguments, &setup)?;
    let mut is_lossy = false;
    let mut failed = None;
    for &way in ways(arguments.lift_policy) {
        match run_way(arguments, &setup, way, &mut report, &n_stops)? {
            Ok(outcome) => is_lossy |= outcome == Outcome::FinishedWithLoss,
            // The trials made so far are shown all the same.
            Err(error) => {
                report.end = "failed".into();
                failed = Some(error);
            }
        }
        if report.end != "finished" || n_stops.load(Ordering::Relaxed) > 0 {
            break;
        }
    }
    report.count();
    if let Some(path) = &arguments.report {
        let strips = strips(&setup, &targets, &report, &n_stops);
        write_report(path, &trials_page(Some(&setup.hand), &report, &strips)?)?;
    }
    print_report(arguments, &report)?;
    is_lossy |= is_late(&report);
    match failed {
        Some(error) => Err(error),
        None => Ok(Outcome::of(is_lossy)),
    }
}

/// Shows the report of all shards.
fn merge(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let mut shards = Vec::new();
    for path in &arguments.merge {
        let text = read_regular(path).with_context(|| path.display().to_string())?;
        let report: TrialsReport = serde_json::from_str(&text)
            .with_context(|| format!("{}: expected the JSON of trials --json", path.display()))?;
        match report.shard {
            Some((idx, n)) if report.end == "finished" => shards.push((Shard { idx, n }, report)),
            Some((idx, n)) => {
                bail!("--merge: shard {idx}/{n} ended before all was done ({}): make it again", report.end)
            }
            None => bail!("--merge: {} is of no shard: expected those of trials --shard I/N --json", path.display()),
        }
    }
    let shards = all_shards(shards, |one: &TrialsReport, other| {
        const NAMES: &str = "objects, trials, attempts, seed, options, model, params of the graph and lift policy";
        if one.is_of_run(other) { None } else { Some(NAMES) }
    });
    let report = TrialsReport::merge(shards?);
    if let Some(path) = &arguments.report {
        write_report(path, &trials_page(None, &report, &[])?)?;
    }
    print_report(arguments, &report)?;
    Ok(Outcome::of(is_late(&report)))
}

/// Whether attempts were not lifted because the host was slow; says what to do.
fn is_late(report: &TrialsReport) -> bool {
    let advice = report.late.and_then(|late| late.advice());
    advice.iter().for_each(|advice| print_diagnostic(&format!("warning: {advice}")));
    advice.is_some()
}

fn check_arguments(arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.record.is_some() && arguments.lift_policy == LiftPolicy::Both {
        bail!(
            "--record makes one recording, and --lift-policy both runs the graph twice: use --lift-policy decision or \
             --lift-policy always"
        );
    }
    arguments.report.as_ref().map_or(Ok(()), |report| check_page(report, &[]))
}

fn empty_report(arguments: &Arguments, setup: &Setup) -> anyhow::Result<TrialsReport> {
    Ok(TrialsReport {
        command: command_line(),
        objects: arguments.objects.clone(),
        n_trials: arguments.trials,
        max_attempts: arguments.attempts,
        seed: arguments.seed,
        shard: arguments.shard.map(|shard| (shard.idx, shard.n)),
        options: setup.options.clone(),
        model: setup.model.clone(),
        graph_id: setup.graph_id()?,
        end: "finished".into(),
        ..TrialsReport::default()
    })
}

/// The ways to make the trials, in the order in which they are run.
fn ways(policy: LiftPolicy) -> &'static [Way] {
    match policy {
        LiftPolicy::Decision => &WAYS[..1],
        LiftPolicy::Always => &WAYS[1..],
        LiftPolicy::Both => &WAYS,
    }
}

/// Runs the graph once, and adds its attempts to the report. The inner result is that of the run.
fn run_way(
    arguments: &Arguments,
    setup: &Setup,
    way: Way,
    report: &mut TrialsReport,
    n_stops: &AtomicUsize,
) -> anyhow::Result<anyhow::Result<Outcome>> {
    let graph = setup.graph(way)?;
    let name = arguments.name.as_deref().unwrap_or(&graph.name);
    if !dataflow::is_name(name) {
        bail!("--name '{name}': expected letters, digits, _ and -, at most 32");
    }
    let watch = Watch::new(arguments.trials, arguments.attempts, way.name);
    let session = Session {
        launch: LaunchOptions { startup_limit: Duration::from_secs(60), ..LaunchOptions::default() },
        record: arguments.record.clone(),
        record_options: LiveOptions { overwrite: arguments.overwrite, ..LiveOptions::default() },
        is_quiet: true,
        tap: Some(watch.tap()),
        ..Session::default()
    };
    let ended = session.run(&graph, name, n_stops);
    let Watched { records, decisions, .. } = watch.finish();
    if way.obeys {
        report.late = Some(LateDecisions::new(&records, &decisions));
        report.records_with_gate = records;
    } else {
        report.records_without_gate = records;
    }
    Ok(ended.map(|ended| {
        let counts = ended.summary.run.counts.get(&setup.node);
        let n_left_out = counts.and_then(|counts| counts.get(LEFT_OUT)).copied().unwrap_or(0);
        report.n_left_out = report.n_left_out.max(n_left_out);
        report.end = ended.summary.run.end.into();
        Outcome::of(ended.is_lossy)
    }))
}

/// Pictures of some trials, as many as are made before Ctrl-C. Attempts that cannot be simulated are reported and left out.
fn strips(setup: &Setup, targets: &[LiftTarget], report: &TrialsReport, n_stops: &AtomicUsize) -> Vec<Strip> {
    let mut telling = telling_records(report);
    telling.truncate(MAX_STRIPS);
    let drawn: Vec<anyhow::Result<Option<Strip>>> = telling
        .par_iter()
        .map(|record| {
            if n_stops.load(Ordering::Relaxed) > 0 {
                return Ok(None);
            }
            let target = targets.iter().find(|target| target.object.name == record.thing).context("no such object")?;
            let made = Made { options: &report.options, prior: setup.prior.as_ref(), probe: setup.probe };
            Ok(Some(strip(&setup.hand, target, made, report.seed, record)?))
        })
        .collect();
    let mut strips = Vec::new();
    for (record, drawn) in telling.iter().zip(drawn) {
        match drawn {
            Ok(drawn) => strips.extend(drawn),
            Err(error) => print_diagnostic(&format!(
                "warning: no picture of trial {}, attempt {} ({}): {error:#}",
                record.trial, record.attempt, record.thing
            )),
        }
    }
    strips
}

fn print_report(arguments: &Arguments, report: &TrialsReport) -> anyhow::Result<()> {
    if arguments.json {
        print_text(&serde_json::to_string_pretty(report)?)?;
        return Ok(());
    }
    for (idx, table) in tables(report).iter().filter(|table| !table.rows.is_empty()).map(Table::to_text).enumerate() {
        if idx > 0 {
            print_line("")?;
        }
        table.iter().try_for_each(|line| print_line(line))?;
    }
    let unfinished = [&report.with_gate, &report.without_gate].into_iter().flatten();
    let n_unfinished: usize = unfinished.map(|tallies| tallies.n_unfinished).sum();
    if report.end != "finished" {
        print_text(&format!(
            "\nThe run was {} before all was done; {n_unfinished} trials without an end are not counted.",
            report.end
        ))?;
    }
    print_text(&format!("\n{}", report.in_four_numbers().join("\n")))?;
    if let Some(path) = &arguments.report {
        print_text(&format!("\nreport: {}", path.display()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::commands::{Cli, Command};

    fn parsed(line: &str) -> Result<Arguments, clap::Error> {
        match Cli::try_parse_from(line.split_whitespace())?.command {
            Command::Trials(arguments) => Ok(arguments),
            _ => panic!("another command"),
        }
    }

    #[test]
    fn without_options_it_is_the_papers_experiment() {
        let arguments = parsed("blindgrasp trials").expect("a command");
        assert_eq!((arguments.objects.as_str(), arguments.trials, arguments.seed), ("paper", 110, 1));
        assert_eq!((arguments.lift_policy, arguments.attempts), (LiftPolicy::Both, 20));
        assert!(!arguments.json && arguments.record.is_none() && arguments.report.is_none());
    }

    #[test]
    fn options_that_cannot_be_are_refused() {
        for line in ["--trials 0", "--attempts 0", "--lift-policy maybe", "--seed -1", "--set trials"] {
            parsed(&format!("blindgrasp trials {line}")).expect_err(line);
        }
        let arguments = parsed("blindgrasp trials --record a.mcap").expect("a command");
        let error = run(&arguments).expect_err("contradictory").to_string();
        assert!(error.contains("--lift-policy decision"), "{error}");
    }

    #[test]
    fn each_way_is_run_once() {
        let obeys = |policy| ways(policy).iter().map(|way| way.obeys).collect::<Vec<_>>();
        assert_eq!(obeys(LiftPolicy::Both), [true, false]);
        assert_eq!(obeys(LiftPolicy::Decision), [true]);
        assert_eq!(obeys(LiftPolicy::Always), [false]);
    }
}
