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
use super::model::write_at_once;
use super::run::{Ended, RecordOptions, Session};
use super::{Outcome, check_output, print_line, stop_requests};
use blindgrasp_graph::dataflow::{self, Override};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_learning::trials::late::LateDecisions;
use blindgrasp_learning::trials::page::{Strip, strip, telling_records, trials_page};
use blindgrasp_learning::trials::tables::{Table, TrialsReport, tables};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_simulator::trial::things::{check_approaches, things_and_warnings};
use blindgrasp_stages::hand::Hand;

/// Where simulated_hand counts trials that could not be.
const LEFT_OUT: &str = "left_out";

/// How many trials a report shows pictures of.
const MAX_STRIPS: usize = 18;

/// Lift things in simulated physics when the graph says so, and count what holds: the paper's robot experiment.
///
/// A simulated hand takes the robot's place. Its samples go through the same processes as a robot's would, and what the
/// arbiter decides is what it does: lift, or let go and try again. With --gate both the same trials are done a second
/// time with every settled grasp lifted, which says what the gate is worth. If the graph gives advice how to grasp anew
/// what was not lifted, the hand follows it; with --regrasp both it also tries at random, which says what advice is
/// worth.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp trials                                   the paper's 110 trials, with and without the gate\n  \
                        blindgrasp trials --trials 11 --gate on             each of its things once\n  \
                        blindgrasp trials --gate on --regrasp both          with advice, and at random\n  \
                        blindgrasp trials --objects held-out --trials 240 --report trials.html\n  \
                        blindgrasp trials --objects box-02@0.3kg@mu0.5,paper/mug --trials 40 --json\n\n\
                        Ctrl-C ends it; what is done so far is shown. The same seed gives the same trials.")]
pub(super) struct Arguments {
    /// What to lift, separated by commas: paper, one of its groups (paper/mug), objects, classes and splits of the
    /// catalogue, meshes; each with @MASSkg and @muFRICTION behind it if it is to have others.
    #[arg(long, default_value = "paper")]
    objects: String,
    /// How many trials; the things take turns.
    #[arg(long, default_value_t = 110, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    trials: u64,
    /// A trial is given up after so many attempts that are not lifted.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=65_535))]
    attempts: u32,
    /// Everything random comes from it.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=i64::MAX as u64))]
    seed: u64,
    /// Who says when to lift: on, the graph; off, nobody, every settled grasp is lifted; both, one after the other.
    #[arg(long, default_value = "both")]
    gate: Gate,
    /// How it tries again what was not lifted: on, as the graph's advice says; off, at random; both, one after the
    /// other. Default: on, if the dataflow file connects advice to the hand.
    #[arg(long)]
    regrasp: Option<Regrasp>,
    /// The model instead of the dataflow file's.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// How trials are made: a file of options (YAML or JSON), those of docs/trials.md that are not to be the default.
    #[arg(long, value_name = "FILE")]
    options: Option<PathBuf>,
    /// The dataflow file; a node of it says what became of lifts, as simulated_hand does.
    #[arg(long, default_value = "dataflow-trials.yaml")]
    dataflow: PathBuf,
    /// Name of the running graph; default: the file's.
    #[arg(long)]
    name: Option<String>,
    /// Give a param another value than the file does; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "NODE.PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Record every edge to this file (MCAP); with neither --gate nor --regrasp both.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Write a report with the tables and pictures of some of the trials (HTML).
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Print JSON, with every attempt.
    #[arg(long)]
    json: bool,
}

/// Who says when to lift.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Gate {
    On,
    Off,
    Both,
}

/// How it tries again what was not lifted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Regrasp {
    On,
    Off,
    Both,
}

/// One way to make the trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Way {
    /// The decision says whether it lifts.
    gate: bool,
    /// Attempts follow advice.
    regrasp: bool,
    /// What tables call it.
    name: &'static str,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if arguments.record.is_some() && arguments.gate == Gate::Both {
        bail!("--record makes one recording, and --gate both runs the graph twice: say --gate on or --gate off");
    }
    if arguments.record.is_some() && arguments.regrasp == Some(Regrasp::Both) {
        bail!(
            "--record makes one recording, and --regrasp both runs the graph twice: say --regrasp on or --regrasp off"
        );
    }
    if arguments.gate == Gate::Off && matches!(arguments.regrasp, Some(Regrasp::On | Regrasp::Both)) {
        bail!("--gate off lifts every grasp, and --regrasp says how to try again what was not lifted: say --gate on");
    }
    if let Some(report) = &arguments.report {
        check_output(report, &[])?;
    }
    let (mut things, warnings) = things_and_warnings(&arguments.objects)?;
    warnings.iter().for_each(|warning| print_diagnostic(&format!("warning: {warning}")));
    let setup = Setup::new(arguments)?;
    if let Some(friction) = setup.friction {
        things.iter_mut().for_each(|thing| thing.friction = friction);
    }
    check_approaches(&setup.hand, &things, &setup.options, arguments.seed, arguments.trials)?;
    // Its own beside the graph's: it also ends what comes after the graph.
    let n_stops = stop_requests()?;
    let mut report = TrialsReport {
        command: command_line(),
        objects: arguments.objects.clone(),
        n_trials: arguments.trials,
        max_attempts: arguments.attempts,
        seed: arguments.seed,
        options: setup.options.clone(),
        model: setup.model.clone(),
        regrasp: setup.regrasp.to_possible_value().map_or(String::new(), |value| value.get_name().into()),
        end: "finished".into(),
        with_gate: None,
        with_gate_at_random: None,
        without_gate: None,
        late: None,
        n_left_out: 0,
        effect: None,
        regrasp_effect: None,
        records_with_gate: Vec::new(),
        records_with_gate_at_random: Vec::new(),
        records_without_gate: Vec::new(),
    };
    let mut is_lossy = false;
    let mut failed = None;
    for way in ways(arguments.gate, setup.regrasp) {
        let (Watched { records, decisions }, ended) = run_way(arguments, &setup, way, &n_stops)?;
        if way.gate {
            let late = report.late.get_or_insert_default();
            late.add(&LateDecisions::new(&records, &decisions));
            late.n_unadvised += ended.as_ref().map_or(0, |ended| setup.n_unadvised(&ended.summary.run.counts));
        }
        let place = match way {
            Way { gate: false, .. } => &mut report.records_without_gate,
            Way { regrasp: false, .. } if setup.regrasp == Regrasp::Both => &mut report.records_with_gate_at_random,
            _ => &mut report.records_with_gate,
        };
        *place = records;
        match ended {
            Ok(ended) => {
                let counts = ended.summary.run.counts.get(&setup.node);
                let n_left_out = counts.and_then(|counts| counts.get(LEFT_OUT)).copied().unwrap_or(0);
                report.n_left_out = report.n_left_out.max(n_left_out);
                is_lossy |= ended.outcome == Outcome::FinishedWithLoss;
                report.end = ended.summary.run.end.into();
            }
            // What was done so far is shown all the same.
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
        let strips = strips(&setup.hand, &things, &report, &n_stops);
        write_at_once(path, &trials_page(&report, &strips))?;
    }
    print_report(arguments, &report)?;
    let late = report.late.and_then(|late| late.advice());
    if let Some(advice) = &late {
        print_diagnostic(&format!("warning: {advice}"));
    }
    is_lossy |= late.is_some();
    match failed {
        Some(error) => Err(error),
        None if is_lossy => Ok(Outcome::FinishedWithLoss),
        None => Ok(Outcome::Done),
    }
}

/// The ways to make the trials, in the order in which they are run.
fn ways(gate: Gate, regrasp: Regrasp) -> Vec<Way> {
    let mut ways = Vec::new();
    if gate != Gate::Off {
        if regrasp != Regrasp::Off {
            ways.push(Way { gate: true, regrasp: true, name: "with the gate" });
        }
        if regrasp != Regrasp::On {
            let name = if regrasp == Regrasp::Both { "with the gate, at random" } else { "with the gate" };
            ways.push(Way { gate: true, regrasp: false, name });
        }
    }
    if gate != Gate::On {
        ways.push(Way { gate: false, regrasp: false, name: "every grasp lifted" });
    }
    ways
}

/// Runs the graph once, and says what became of each attempt.
fn run_way(
    arguments: &Arguments,
    setup: &Setup,
    way: Way,
    n_stops: &AtomicUsize,
) -> anyhow::Result<(Watched, anyhow::Result<Ended>)> {
    let graph = setup.graph(way)?;
    let name = arguments.name.as_deref().unwrap_or(&graph.name);
    if !dataflow::is_name(name) {
        bail!("--name '{name}': expected letters, digits, _ and -, at most 32");
    }
    let watch = Watch::new(arguments.trials, arguments.attempts, way.name);
    let session = Session {
        launch: LaunchOptions { startup_limit: Duration::from_secs(60), ..LaunchOptions::default() },
        clock: Clock::Machine,
        record: arguments.record.clone(),
        record_options: RecordOptions::default(),
        metrics: None,
        json: false,
        is_quiet: true,
        tap: Some(watch.tap()),
    };
    let ended = session.run(&graph, name, n_stops);
    Ok((watch.finish(), ended))
}

/// Pictures of some trials, as many as there are before Ctrl-C. What cannot be drawn is said, and left out.
fn strips(
    hand: &Hand,
    things: &[blindgrasp_simulator::trial::Thing],
    report: &TrialsReport,
    n_stops: &AtomicUsize,
) -> Vec<Strip> {
    let mut telling = telling_records(report);
    telling.truncate(MAX_STRIPS);
    let drawn: Vec<anyhow::Result<Option<Strip>>> = telling
        .par_iter()
        .map(|record| {
            if n_stops.load(Ordering::Relaxed) > 0 {
                return Ok(None);
            }
            let thing = things.iter().find(|thing| thing.name == record.thing).context("no such thing")?;
            Ok(Some(strip(hand, thing, &report.options, report.seed, record)?))
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
        print_line(&serde_json::to_string_pretty(report)?)?;
        return Ok(());
    }
    for (idx, table) in tables(report).iter().filter(|table| !table.rows.is_empty()).map(Table::to_text).enumerate() {
        if idx > 0 {
            print_line("")?;
        }
        table.iter().try_for_each(|line| print_line(line))?;
    }
    let unfinished = [&report.with_gate, &report.with_gate_at_random, &report.without_gate].into_iter().flatten();
    let n_unfinished: usize = unfinished.map(|tallies| tallies.n_unfinished).sum();
    if report.end != "finished" {
        print_line(&format!(
            "\nThe run was {} before all was done; {n_unfinished} trials without an end are not counted.",
            report.end
        ))?;
    }
    if let Some(left_out) = report.left_out() {
        print_line(&format!("\n{left_out}."))?;
    }
    if let Some(path) = &arguments.report {
        print_line(&format!("\nreport: {}", path.display()))?;
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
        assert_eq!((arguments.gate, arguments.attempts), (Gate::Both, 20));
        assert_eq!(arguments.regrasp, None);
        assert!(!arguments.json && arguments.record.is_none() && arguments.report.is_none());
    }

    #[test]
    fn options_that_cannot_be_are_refused() {
        for line in ["--trials 0", "--attempts 0", "--gate maybe", "--seed -1", "--set trials"] {
            parsed(&format!("blindgrasp trials {line}")).expect_err(line);
        }
        for (line, expected) in [
            ("--record a.mcap", "--gate on"),
            ("--record a.mcap --gate on --regrasp both", "say --regrasp on or --regrasp off"),
            ("--gate off --regrasp on", "say --gate on"),
        ] {
            let arguments = parsed(&format!("blindgrasp trials {line}")).expect("a command");
            let error = run(&arguments).expect_err("contradictory").to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn each_way_is_run_once() {
        let made = |gate, regrasp| -> Vec<(bool, bool)> {
            ways(gate, regrasp).iter().map(|way| (way.gate, way.regrasp)).collect()
        };
        assert_eq!(made(Gate::Both, Regrasp::Both), [(true, true), (true, false), (false, false)]);
        assert_eq!(made(Gate::Both, Regrasp::On), [(true, true), (false, false)]);
        assert_eq!(made(Gate::On, Regrasp::Off), [(true, false)]);
        assert_eq!(made(Gate::Off, Regrasp::On), [(false, false)]);
    }
}
