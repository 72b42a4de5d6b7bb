//! The parts of the command line that blindgrasp's three programs share.
//!
//! * [`houses`] - which program has which command, and the hand-over from `blindgrasp` to the two others.
//! * [`help`], [`hints`], [`completions`], [`man`] - the command line explained: to a person, after a mistake, to a shell, on paper.
//! * [`operator`] - the process of an operator.
//! * [`graph_file`] - dataflow files with the operators that come with blindgrasp, checked. [`frame_lines`] - frames as lines of JSON.
//! * [`shard`] - `--shard I/N`.

pub mod completions;
pub mod frame_lines;
pub mod graph_file;
pub mod help;
pub mod hints;
pub mod houses;
pub mod man;
pub mod operator;
pub mod shard;
pub mod testing;

use std::ffi::OsString;
use std::io::{IsTerminal, Write};
use std::ops::RangeInclusive;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Context;
use blindgrasp_graph::dataflow::DataflowError;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::{HarmlessWriter, harmless};
use blindgrasp_stages::{Model, Probe};
use clap::{Command, FromArgMatches};

/// A program's command line and its `main`: the subcommands, each a module with `Arguments` and `run`, of which those behind
/// `hidden` are in no help. It also has the operators that it runs, and the other houses, whose commands it lists.
#[macro_export]
macro_rules! program {
    (
        $($name:ident $module:ident),*; hidden $($hidden_name:ident $hidden_module:ident),*;
        operators $operators:expr; others $others:expr
    ) => {
        /// Decides from touch and joint angles whether a grasp will hold before the lift.
        ///
        /// Exit codes: 0 done, 1 failed, 2 usage, 3 finished with loss.
        #[derive(Debug, clap::Parser)]
        #[command(name = "blindgrasp", version, propagate_version = true)]
        #[command(after_help = "Example: blindgrasp init my-robot && blindgrasp run my-robot/dataflow.yaml")]
        struct Cli {
            #[command(subcommand)]
            command: Command,
        }

        #[derive(Debug, clap::Subcommand)]
        enum Command {
            $($name($module::Arguments),)*
            $($hidden_name($hidden_module::Arguments),)*
            Man($crate::man::Arguments),
            Operator($crate::operator::Arguments),
        }

        fn command() -> clap::Command {
            $crate::houses::with_commands_of($others, <Cli as clap::CommandFactory>::command())
        }

        /// Carries out the command line. A mistake in it ends the process with its explanation and code 2.
        pub(crate) fn main() -> std::process::ExitCode {
            $crate::survive_limit_of_file_sizes();
            $crate::completions::answer_shell(command);
            let cli: Cli = $crate::parse(command());
            $crate::end(match &cli.command {
                // An operator reports its end to the launcher, not to a person.
                Command::Operator(arguments) => return $crate::operator::run(arguments, &$operators),
                Command::Man(arguments) => $crate::man::run(arguments, command(), $others),
                $(Command::$name(arguments) => $module::run(arguments),)*
                $(Command::$hidden_name(arguments) => $hidden_module::run(arguments),)*
            })
        }
    };
}

/// The value that a word of an argument stands for.
pub fn word<T: serde::de::DeserializeOwned>(text: &str, expected: &str) -> Result<T, String> {
    serde_json::from_value(text.into()).map_err(|_| format!("expected {expected}"))
}

/// Refuses a probe after which the model judges nothing: every grasp would be held.
///
/// # Errors
/// It names the model, and the grasps that it does not judge.
pub fn check_probe(path: &Path, model: &Model, probe: Probe) -> anyhow::Result<()> {
    let (judges, name) = match probe {
        Probe::None => (true, ""),
        Probe::Squeeze => (model.squeezed.is_some(), "squeezed"),
        Probe::TestLift => (model.squeezed.is_some() && model.test_lifted.is_some(), "test_lifted"),
    };
    if !judges {
        anyhow::bail!(
            "--probe: {} judges no {name} grasps: leave --probe out, or give a model that was trained on lifts with that probe",
            path.display()
        );
    }
    Ok(())
}

/// How a command ended that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// All is well.
    Done,
    /// It ran to its end, but samples were lost.
    FinishedWithLoss,
}

impl Outcome {
    /// The outcome of a run that ended well.
    pub fn of(is_lossy: bool) -> Outcome {
        if is_lossy { Outcome::FinishedWithLoss } else { Outcome::Done }
    }

    /// 0 or 3.
    pub fn exit_code(self) -> ExitCode {
        match self {
            Outcome::Done => ExitCode::SUCCESS,
            Outcome::FinishedWithLoss => ExitCode::from(3),
        }
    }
}

/// Parses the command line. A mistake ends the process with its explanation and code 2.
pub fn parse<C: FromArgMatches>(command: Command) -> C {
    let words: Vec<OsString> = std::env::args_os().collect();
    let matches = help::grouped(command.clone()).try_get_matches_from(&words);
    let parsed = matches.and_then(|matches| C::from_arg_matches(&matches));
    parsed.unwrap_or_else(|error| hints::with_hint(error, command, &words).exit())
}

/// The exit code of a command that has ended. An error is told on stderr.
pub fn end(result: anyhow::Result<Outcome>) -> ExitCode {
    match result {
        Ok(outcome) => outcome.exit_code(),
        // The reader of our output has seen enough, as in `blindgrasp export … | head`.
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        // Each of its lines begins with the file, line and column: nothing else should.
        Err(error) if error.is::<DataflowError>() => {
            print_diagnostic(&error.to_string());
            ExitCode::FAILURE
        }
        Err(error) => {
            print_diagnostic(&format!("blindgrasp: {error:#}"));
            ExitCode::FAILURE
        }
    }
}

/// Makes a file beyond the limit of sizes (`ulimit -f`) an error of the write, as a full disk is, that kills no graph.
pub fn survive_limit_of_file_sizes() {
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
}

/// Whether an error is only that the reader of our output has gone.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

/// As [`print_text`], for one line: a line break in it, as in a name of a stranger's, is escaped, or the rest would pass for a
/// line of ours.
pub fn print_line(line: &str) -> std::io::Result<()> {
    print_text(&line.replace('\n', "\\n"))
}

/// Writes lines of results to stdout at once, harmless to a terminal (unlike `println!`, without a panic when nobody reads it).
pub fn print_text(lines: &str) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    stdout.write_all(harmless(lines).as_bytes())?;
    stdout.write_all(b"\n")?;
    stdout.flush()
}

/// Stdout for data: as they are for a program, harmless for a terminal.
pub fn data_on_stdout() -> Box<dyn Write> {
    let stdout = std::io::stdout();
    if stdout.is_terminal() { Box::new(HarmlessWriter::new(stdout)) } else { Box::new(stdout) }
}

/// Raised by the signals that stop a command.
pub fn stop_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in stop_signals() {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }
    Ok(stop)
}

/// Counts the signals that stop a command: a second one ends the patience.
pub fn stop_requests() -> anyhow::Result<Arc<AtomicUsize>> {
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
    let takes_hang_up = ignored & (1 << (signal_hook::consts::SIGHUP - 1)) == 0;
    let signals = [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP];
    signals.into_iter().filter(|signal| *signal != signal_hook::consts::SIGHUP || takes_hang_up).collect()
}

/// A number that clap takes only within `range`.
pub fn number_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if range.contains(&number) => Ok(number),
        _ => {
            let hint = share_hint(text, &range).map(|hint| format!("; {hint}")).unwrap_or_default();
            Err(format!("expected a number from {} to {}{hint}", range.start(), range.end()))
        }
    }
}

/// The share that a number of percent stands for, where shares are expected.
fn share_hint(text: &str, range: &RangeInclusive<f64>) -> Option<String> {
    let percent: f64 = text.trim_end_matches('%').trim().parse().ok()?;
    let is_likely = *range.end() <= 1.0 && (text.ends_with('%') || percent > 1.0);
    (is_likely && range.contains(&(percent / 100.0))).then(|| format!("{percent} % are {}", percent / 100.0))
}

/// A length of time in seconds, within `range`: a number of seconds, or with units, as 500ms, 1m 30s.
pub fn secs_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let secs = match text.parse() {
        Ok(secs) => Ok(secs),
        Err(_) => humantime::parse_duration(text).map(|time| time.as_secs_f64()),
    };
    match secs {
        Ok(secs) if range.contains(&secs) => Ok(secs),
        _ => Err(format!("expected a time from {} to {} seconds, like 2.5, 500ms or 1m", range.start(), range.end())),
    }
}

/// A joint of a hand with its value, `NAME=VALUE`: radians, or metres of a slide.
///
/// # Errors
/// The text is no such pair.
pub fn joint(text: &str) -> Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE: radians, or metres of a slide")?;
    let value = value
        .trim()
        .parse()
        .map_err(|_| format!("'{value}' is not a number: expected radians, or metres of a slide, without the unit"))?;
    Ok((name.trim().into(), value))
}

/// Refuses a folder that is there already, or that cannot be made.
///
/// # Errors
/// The text says which, and what to do.
pub fn check_free(folder: &Path) -> anyhow::Result<()> {
    if folder.symlink_metadata().is_ok() {
        anyhow::bail!("{} is there already, and nothing is overwritten: choose another name", folder.display());
    }
    match folder.parent() {
        Some(parent) if parent != Path::new("") && !parent.is_dir() => {
            anyhow::bail!("there is no folder {} to make it in: make it first", parent.display())
        }
        _ => Ok(()),
    }
}

/// A path as one word of a shell command.
pub fn in_shell(path: &str) -> String {
    if is_plain(path) { path.into() } else { format!("'{}'", path.replace('\'', "'\\''")) }
}

/// Whether a path needs no quotes in a shell and in YAML.
pub fn is_plain(path: &str) -> bool {
    path.chars().all(|char| char.is_ascii_alphanumeric() || "/._-+".contains(char))
}
