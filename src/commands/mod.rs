//! The commands, one file each. They wire library and runtime together and hold no logic of their own.

mod approaches;
mod background;
mod cases;
mod check;
mod completions;
mod diagnostics;
mod doctor;
mod echo;
mod evaluate;
mod export;
mod grid;
mod hand_cells;
mod help;
mod import;
mod info;
mod init;
mod keys;
mod logs;
mod man;
mod model;
mod new;
mod object_list;
mod operator;
mod predict;
mod ps;
mod record;
mod replay;
mod reproduce;
mod ros2_network;
mod run;
mod schema;
mod sensors;
mod set;
mod simulate;
mod stop;
mod swap;
mod test;
mod text_table;
mod top;
mod train;
mod trials;
mod view;

use std::io::Write;
use std::ops::RangeInclusive;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Context;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

/// Decides from touch and joint angles whether a grasp will hold before the lift.
///
/// Exit codes: 0 done, 1 failed, 2 usage, 3 finished with loss.
#[derive(Debug, Parser)]
#[command(name = "blindgrasp", version, propagate_version = true)]
#[command(after_help = "Example: blindgrasp init my-robot && blindgrasp run my-robot/dataflow.yaml")]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Init(init::Arguments),
    #[command(aliases = ["up", "start", "launch"])]
    Run(run::Arguments),
    Record(record::Arguments),
    #[command(alias = "play")]
    Replay(replay::Arguments),
    Test(test::Arguments),
    #[command(aliases = ["status", "list"])]
    Ps(ps::Arguments),
    Top(top::Arguments),
    Echo(echo::Arguments),
    #[command(alias = "down")]
    Stop(stop::Arguments),
    Logs(logs::Arguments),
    Set(set::Arguments),
    #[command(alias = "restart")]
    Swap(swap::Arguments),
    Simulate(simulate::Arguments),
    Import(import::Arguments),
    Train(train::Arguments),
    Evaluate(evaluate::Arguments),
    Predict(predict::Arguments),
    Trials(trials::Arguments),
    Reproduce(reproduce::Arguments),
    Model(model::Arguments),
    Sensors(sensors::Arguments),
    Info(info::Arguments),
    Export(export::Arguments),
    New(new::Arguments),
    Keys(keys::Arguments),
    #[command(alias = "graph")]
    View(view::Arguments),
    Doctor(doctor::Arguments),
    Diagnostics(diagnostics::Arguments),
    Completions(completions::Arguments),
    Schema(schema::Arguments),
    Man(man::Arguments),
    Operator(operator::Arguments),
}

/// The running graph that a command is about, by its place or by its option, as other commands have it.
#[derive(Debug, clap::Args)]
struct GraphArgument {
    /// Graph, or its part (GRAPH@MACHINE) [default: the only one running]
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    /// The same, as other commands have it
    #[arg(short = 'g', long = "graph", value_name = "GRAPH", conflicts_with = "graph", add = completions::graphs())]
    named: Option<String>,
}

impl GraphArgument {
    fn name(&self) -> Option<&str> {
        self.graph.as_deref().or(self.named.as_deref())
    }
}

/// How a command ended that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// All is well.
    Done,
    /// It ran to its end, but samples were lost.
    FinishedWithLoss,
}

impl Outcome {
    /// 0 or 3.
    pub(crate) fn exit_code(self) -> ExitCode {
        match self {
            Outcome::Done => ExitCode::SUCCESS,
            Outcome::FinishedWithLoss => ExitCode::from(3),
        }
    }
}

impl Cli {
    /// Parses the command line. A mistake ends the process with its explanation and code 2.
    pub(crate) fn read() -> Cli {
        completions::answer_shell();
        let matches = help::grouped(Cli::command()).try_get_matches();
        let parsed = matches.and_then(|matches| Cli::from_arg_matches(&matches));
        parsed.unwrap_or_else(|error| help::with_hint(error).exit())
    }

    /// Runs the operator that this process is to be. An operator reports its end to the launcher, not to a person.
    pub(crate) fn run_operator(&self) -> Option<ExitCode> {
        match &self.command {
            Command::Operator(arguments) => Some(operator::run(arguments)),
            _ => None,
        }
    }
}

/// Carries out a command.
///
/// # Errors
/// What failed, for a person to read.
pub(crate) fn run(cli: Cli) -> anyhow::Result<Outcome> {
    match cli.command {
        Command::Init(arguments) => init::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Record(arguments) => record::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Test(arguments) => test::run(&arguments),
        Command::Ps(arguments) => ps::run(&arguments),
        Command::Top(arguments) => top::run(&arguments),
        Command::Echo(arguments) => echo::run(&arguments),
        Command::Stop(arguments) => stop::run(&arguments),
        Command::Logs(arguments) => logs::run(&arguments),
        Command::Set(arguments) => set::run(&arguments),
        Command::Swap(arguments) => swap::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Import(arguments) => import::run(&arguments),
        Command::Train(arguments) => train::run(&arguments),
        Command::Evaluate(arguments) => evaluate::run(&arguments),
        Command::Predict(arguments) => predict::run(&arguments),
        Command::Trials(arguments) => trials::run(&arguments),
        Command::Reproduce(arguments) => reproduce::run(&arguments),
        Command::Model(arguments) => model::run(&arguments),
        Command::Sensors(arguments) => sensors::run(&arguments),
        Command::Info(arguments) => info::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::New(arguments) => new::run(&arguments),
        Command::Keys(arguments) => keys::run(&arguments),
        Command::View(arguments) => view::run(&arguments),
        Command::Diagnostics(arguments) => diagnostics::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
        Command::Schema(arguments) => schema::run(&arguments),
        Command::Man(arguments) => man::run(&arguments),
        // `main` has run it.
        Command::Operator(_) => Ok(Outcome::Done),
    }
}

/// Whether an error is only that the reader of our output has gone.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

/// Writes a line of results to stdout at once (unlike `println!`, without a panic when nobody reads it).
fn print_line(line: &str) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    stdout.write_all(line.as_bytes())?;
    stdout.write_all(b"\n")?;
    stdout.flush()
}

/// Raised by the signals that stop a command.
fn stop_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in stop_signals() {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }
    Ok(stop)
}

/// Counts the signals that stop a command: a second one ends the patience.
fn stop_requests() -> anyhow::Result<Arc<AtomicUsize>> {
    let n_stops = Arc::new(AtomicUsize::new(0));
    let mut signals = signal_hook::iterator::Signals::new(stop_signals()).context("cannot listen for signals")?;
    let counter = Arc::clone(&n_stops);
    std::thread::spawn(move || {
        for _ in signals.forever() {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    });
    Ok(n_stops)
}

/// SIGINT (Ctrl-C), SIGTERM, and SIGHUP unless it is ignored, as `nohup` has it.
fn stop_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    let is_ignored = |signal: &i32| ignored & (1 << (signal - 1)) != 0;
    let signals = [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP];
    signals.into_iter().filter(|signal| *signal != signal_hook::consts::SIGHUP || !is_ignored(signal)).collect()
}

/// As [`check_output`], for a file that another one takes the place of once it is complete. It also refuses to replace a
/// file, unless the user has asked for that, and anything else that bears the name.
fn check_new(out: &Path, inputs: &[PathBuf], overwrite: bool) -> anyhow::Result<()> {
    check_output(out, inputs)?;
    match std::fs::symlink_metadata(out).map(|found| found.file_type()) {
        Ok(found) if found.is_symlink() => {
            anyhow::bail!("{} is a link, which would be replaced: name the file that it leads to", out.display())
        }
        Ok(found) if !found.is_file() => {
            anyhow::bail!("{} is a device or a pipe, which would be replaced: name a file", out.display())
        }
        Ok(_) if !overwrite => {
            anyhow::bail!("{}: the file exists; choose another name, or replace it with --overwrite", out.display())
        }
        _ => Ok(()),
    }
}

/// As [`check_output`], for a page, which takes the place of a file of its name.
fn check_page(out: &Path, inputs: &[PathBuf]) -> anyhow::Result<()> {
    check_output(out, inputs)?;
    if !out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html")) {
        anyhow::bail!("{} (--report): expected a name that ends in .html", out.display());
    }
    if out.is_symlink() {
        anyhow::bail!("{} is a link, which would be replaced: name the file that it leads to", out.display());
    }
    Ok(())
}

/// Refuses to write where one of the inputs lies.
fn check_output(out: &Path, inputs: &[PathBuf]) -> anyhow::Result<()> {
    // By device and number: a file may have several names.
    let place = |path: &Path| std::fs::metadata(path).ok().map(|found| (found.dev(), found.ino()));
    match inputs.iter().find(|input| place(out).is_some_and(|out| place(input) == Some(out))) {
        Some(input) => anyhow::bail!("{} is an input: writing there would destroy it", input.display()),
        None if out.parent().is_some_and(|folder| folder != Path::new("") && !folder.is_dir()) => anyhow::bail!(
            "{}: there is no such folder to write to; make it first",
            out.parent().unwrap_or(out).display()
        ),
        None if out.is_dir() => anyhow::bail!("{} is a folder: expected the name of a file to write", out.display()),
        None => Ok(()),
    }
}

/// A number that clap takes only within `range`.
fn number_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if range.contains(&number) => Ok(number),
        _ => Err(format!("expected a number from {} to {}", range.start(), range.end())),
    }
}

/// A length of time in seconds, within `range`: a number of seconds, or with units, as 500ms, 1m 30s.
fn secs_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let with_unit = || humantime::parse_duration(text).ok().map(|time| time.as_secs_f64());
    match text.parse().ok().or_else(with_unit) {
        Some(secs) if range.contains(&secs) => Ok(secs),
        _ => Err(format!("expected a time from {} to {} seconds, like 2.5, 500ms or 1m", range.start(), range.end())),
    }
}

/// A share as a percentage.
fn percent(share: Option<f64>) -> String {
    share.map_or("n/a".into(), |share| format!("{:.1} %", 100.0 * share))
}
