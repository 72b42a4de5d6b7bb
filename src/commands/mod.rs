//! The commands, one file each. They wire library and runtime together and hold no logic of their own.

mod approaches;
mod background;
mod cases;
mod check;
mod completions;
mod diagnostics;
mod doctor;
mod echo;
mod elsewhere;
mod evaluate;
mod export;
mod frame_lines;
mod graph_file;
mod guesses;
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
mod promises;
mod ps;
mod record;
mod recording_arguments;
mod replay;
mod ros2_network;
mod run;
mod schema;
mod sensors;
mod set;
mod simulate;
mod stop;
mod swap;
mod test;
mod top;
mod train;
mod trials;
mod view;

use std::ffi::OsString;
use std::io::{IsTerminal, Write};
use std::ops::RangeInclusive;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Context;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use blindgrasp_operator::text::{HarmlessWriter, harmless};
use blindgrasp_session::output::{check_new, check_output, check_page, write_out, write_report};
use blindgrasp_session::text_table::{self, percent};

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

/// The table of the commands: a module with `Arguments` and `run` each, in the groups and the order of the help.
macro_rules! commands {
    ($($group:literal: $($name:ident $module:ident),*;)*) => {
        #[derive(Debug, Subcommand)]
        enum Command {
            $($($name($module::Arguments),)*)*
            Man(man::Arguments),
            Operator(operator::Arguments),
        }

        const GROUPS: &[(&str, &[&str])] = &[$(($group, &[$(stringify!($module)),*])),*];

        /// Carries out a command.
        ///
        /// # Errors
        /// What failed, for a person to read.
        pub(crate) fn run(cli: Cli) -> anyhow::Result<Outcome> {
            match cli.command {
                $($(Command::$name(arguments) => $module::run(&arguments),)*)*
                Command::Man(arguments) => man::run(&arguments),
                // `main` has run it.
                Command::Operator(_) => Ok(Outcome::Done),
            }
        }
    };
}

commands! {
    "Run": Run run, Ps ps, Top top, Echo echo, Stop stop, Set set, Swap swap, Logs logs, Doctor doctor,
        Diagnostics diagnostics;
    "Record": Record record, Replay replay, Test test, Export export, Info info, View view;
    "Learn": Simulate simulate, Import import, Train train, Evaluate evaluate, Predict predict, Trials trials,
        Model model, Sensors sensors;
    "Describe": Init init, New new, Keys keys, Schema schema, Completions completions;
}

/// How a command ended that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// All is well.
    Done,
    /// It ran to its end, but samples were lost.
    FinishedWithLoss,
    /// It ran on another machine and ended with this exit code. What failed was told there.
    OfOtherMachine(u8),
}

impl Outcome {
    /// The outcome of a run that ended well.
    fn of(is_lossy: bool) -> Outcome {
        if is_lossy { Outcome::FinishedWithLoss } else { Outcome::Done }
    }

    /// 0 or 3, or that of the other machine.
    pub(crate) fn exit_code(self) -> ExitCode {
        match self {
            Outcome::Done => ExitCode::SUCCESS,
            Outcome::FinishedWithLoss => ExitCode::from(3),
            Outcome::OfOtherMachine(code) => ExitCode::from(code),
        }
    }
}

impl Cli {
    /// Parses the command line. A mistake ends the process with its explanation and code 2.
    pub(crate) fn read() -> Cli {
        completions::answer_shell();
        elsewhere::answer_caller();
        let words: Vec<OsString> = std::env::args_os().collect();
        let matches = help::grouped(Cli::command()).try_get_matches_from(&words);
        let parsed = matches.and_then(|matches| Cli::from_arg_matches(&matches));
        parsed.unwrap_or_else(|error| guesses::with_hint(error, Cli::command(), &words).exit())
    }

    /// Runs the operator that this process is to be. An operator reports its end to the launcher, not to a person.
    pub(crate) fn run_operator(&self) -> Option<ExitCode> {
        match &self.command {
            Command::Operator(arguments) => Some(operator::run(arguments)),
            _ => None,
        }
    }
}

/// Whether an error is only that the reader of our output has gone.
pub(crate) fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|error| error.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

/// As [`print_text`], for one line: a line break in it, as in a name of a stranger's, is escaped, or the rest would pass for a
/// line of ours.
fn print_line(line: &str) -> std::io::Result<()> {
    print_text(&line.replace('\n', "\\n"))
}

/// Writes lines of results to stdout at once, harmless to a terminal (unlike `println!`, without a panic when nobody reads it).
fn print_text(lines: &str) -> std::io::Result<()> {
    let mut stdout = std::io::stdout().lock();
    stdout.write_all(harmless(lines).as_bytes())?;
    stdout.write_all(b"\n")?;
    stdout.flush()
}

/// Stdout for data: as they are for a program, harmless for a terminal.
fn data_on_stdout() -> Box<dyn Write> {
    let stdout = std::io::stdout();
    if stdout.is_terminal() { Box::new(HarmlessWriter::new(stdout)) } else { Box::new(stdout) }
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

/// A number that clap takes only within `range`.
fn number_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
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
fn secs_in(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let with_unit = || humantime::parse_duration(text).ok().map(|time| time.as_secs_f64());
    match text.parse().ok().or_else(with_unit) {
        Some(secs) if range.contains(&secs) => Ok(secs),
        _ => Err(format!("expected a time from {} to {} seconds, like 2.5, 500ms or 1m", range.start(), range.end())),
    }
}
