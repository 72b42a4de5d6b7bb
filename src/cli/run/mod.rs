//! `blindgrasp run`

mod log;
pub(super) mod metadata;
pub(super) mod recorder;
mod session;
mod summary;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::bail;
use clap::{Args, ValueEnum};

pub(super) use self::recorder::RecordOptions;
pub(super) use self::session::{Session, Tap, observed_topics};
pub(super) use self::summary::Summary;
use super::{Outcome, background, number_in};
use crate::dataflow::{self, Graph, Override};
use crate::runtime::describe::{describe, shipped};
use crate::runtime::launcher::LaunchOptions;
use crate::runtime::log::LogFormat;
use crate::runtime::wiring::Clock;

/// Run a dataflow file: launch its operators, print each decision, and sum up at the end.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: blindgrasp run dataflow.yaml --record /tmp/run.mcap\n\nCtrl-C stops the graph cleanly."
)]
pub(super) struct Arguments {
    /// The dataflow file.
    #[arg(default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// Name of the running graph; default: the file's.
    #[arg(long)]
    name: Option<String>,
    /// Give a param another value than the file does; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "NODE.PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Record every edge to this file (MCAP).
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    #[command(flatten)]
    record_options: RecordOptions,
    /// How long the operators may take until all are ready, in seconds; a restarted one as well.
    #[arg(long, value_name = "SECS", default_value = "20", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    startup_limit: f64,
    /// How long the operators may take to answer what is left when the graph stops, and then to exit, in seconds, before
    /// they are killed.
    #[arg(long, value_name = "SECS", default_value = "10", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    grace: f64,
    /// How long a writer waits for a reader on a lossless edge before it fails, in seconds: longer than the slowest operator
    /// takes to come back.
    #[arg(long, value_name = "SECS", default_value = "5", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    wait_limit: f64,
    /// Answer Prometheus on this port of the loopback interface (0: any that is free): http://127.0.0.1:PORT/metrics
    #[arg(long, value_name = "PORT")]
    metrics: Option<u16>,
    /// How the log files are written: for people, or a JSON object a line, for programs.
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    log_format: LogFormatArgument,
    /// Print JSON: one line per decision, and a last one with "summary".
    #[arg(long)]
    json: bool,
    /// Return as soon as the graph runs, and let it run in the background: see ps, logs, swap and stop.
    #[arg(long)]
    detach: bool,
    /// What --detach starts.
    #[arg(long, hide = true)]
    in_background: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LogFormatArgument {
    Text,
    Json,
}

impl From<LogFormatArgument> for LogFormat {
    fn from(argument: LogFormatArgument) -> Self {
        match argument {
            LogFormatArgument::Text => LogFormat::Text,
            LogFormatArgument::Json => LogFormat::Json,
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let file = dataflow::load(&arguments.dataflow)?;
    let graph = dataflow::check(&file, &shipped()?, &arguments.overrides, describe)?;
    let name = arguments.name.as_deref().unwrap_or(&graph.name);
    if !dataflow::is_name(name) {
        bail!("--name '{name}': expected letters, digits, _ and -, at most 32");
    }
    if arguments.detach {
        return background::detach(name, arguments.json);
    }
    if arguments.in_background {
        return background::into_log(name, arguments.log_format.into(), || run_graph(arguments, &graph, name));
    }
    run_graph(arguments, &graph, name)
}

fn run_graph(arguments: &Arguments, graph: &Graph, name: &str) -> anyhow::Result<Outcome> {
    let session = Session {
        launch: LaunchOptions {
            startup_limit: Duration::from_secs_f64(arguments.startup_limit),
            grace: Duration::from_secs_f64(arguments.grace),
            wait_limit: Duration::from_secs_f64(arguments.wait_limit),
            is_on_terminal: !arguments.in_background,
            log_format: arguments.log_format.into(),
        },
        clock: Clock::Machine,
        record: arguments.record.clone(),
        record_options: arguments.record_options.clone(),
        metrics: arguments.metrics,
        json: arguments.json,
        is_quiet: false,
        tap: None,
    };
    Ok(session.run(graph, name)?.outcome)
}
