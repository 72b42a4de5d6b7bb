//! `blindgrasp run`

mod log;
pub(super) mod recorder;
mod session;
mod summary;

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::bail;
use clap::{Args, ValueEnum};

pub(super) use self::recorder::RecordOptions;
pub(super) use self::session::{Ended, Session, Tap, is_needed, observed_topics};
pub(super) use self::summary::Summary;
use super::{Outcome, background, number_in, stop_signal};
use blindgrasp_bridge::local::{Placement, local_graph};
use blindgrasp_graph::dataflow::{self, Graph, Override, Scope};
use blindgrasp_graph::describe::{describe, link_program, shipped};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::log::LogFormat;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Clock;

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
    /// The machine of the file that this one is: only its operators start here, and a link to the others.
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// Start the operators of all machines here, without a link.
    #[arg(long, conflicts_with_all = ["machine", "namespace", "listen", "connect", "keys", "stay"])]
    all_machines: bool,
    /// Which of several like graphs this is: one for each robot, say. Its machines hear no others. The running graph is named
    /// GRAPH-NAMESPACE.
    #[arg(long, value_name = "NAME", requires = "machine")]
    namespace: Option<String>,
    /// Listen here for other machines instead of where the file says. Can be repeated.
    #[arg(long, value_name = "ENDPOINT", requires = "machine")]
    listen: Vec<String>,
    /// Connect to this instead of what the file says: a machine, or with a router that. Can be repeated.
    #[arg(long, value_name = "ENDPOINT", requires = "machine")]
    connect: Vec<String>,
    /// The folder with this machine's keys, instead of the file's.
    #[arg(long, value_name = "DIR", requires = "machine")]
    keys: Option<PathBuf>,
    /// When the graph has ended because the other machines' sources have, begin again and wait for them.
    #[arg(long, requires = "machine", conflicts_with = "record")]
    stay: bool,
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
    let scope = arguments.machine.as_deref().map_or(Scope::Everything, Scope::Machine);
    let graph = dataflow::check(&file, &shipped()?, &arguments.overrides, scope, describe)?;
    let name = running_name(arguments, &graph)?;
    let name = name.as_str();
    // Whatever can be wrong with it is said before anything goes into the background.
    graph_here(arguments, &graph, name)?;
    if arguments.detach {
        return background::detach(name, arguments.json);
    }
    if arguments.in_background {
        return background::into_log(name, arguments.log_format.into(), || run_graph(arguments, &graph, name));
    }
    run_graph(arguments, &graph, name)
}

/// The running graph's name.
fn running_name(arguments: &Arguments, graph: &Graph) -> anyhow::Result<String> {
    if let Some(namespace) = arguments.namespace.as_ref().filter(|namespace| !dataflow::is_name(namespace)) {
        bail!("--namespace '{namespace}': expected letters, digits, _ and -, at most 32");
    }
    let name = match (&arguments.name, &arguments.namespace) {
        (Some(name), _) => name.clone(),
        (None, Some(namespace)) => format!("{}-{namespace}", graph.name),
        (None, None) => graph.name.clone(),
    };
    if dataflow::is_name(&name) {
        return Ok(name);
    }
    match arguments.name {
        Some(_) => bail!("--name '{name}': expected letters, digits, _ and -, at most 32"),
        None => {
            bail!("'{name}' is too long for a graph's name, at most 32 characters; give it a shorter one: --name NAME")
        }
    }
}

/// What of a graph is to run here.
fn graph_here(arguments: &Arguments, graph: &Graph, name: &str) -> anyhow::Result<Graph> {
    match &arguments.machine {
        Some(machine) => part_of(arguments, graph, machine, name),
        None => whole(arguments, graph.clone()),
    }
}

/// A graph without machines, or all of one that has some.
fn whole(arguments: &Arguments, graph: Graph) -> anyhow::Result<Graph> {
    if let Some(machines) = graph.machines.as_ref().filter(|_| !arguments.all_machines) {
        let names: Vec<_> = machines.machines.iter().map(|machine| machine.name.as_str()).collect();
        bail!(
            "this graph runs on several machines: say which one this is with --machine {}, or start all operators here \
             with --all-machines",
            names.join("|")
        );
    }
    if arguments.all_machines && graph.machines.is_none() {
        bail!("the file names no machines, so --all-machines has no meaning; leave it out");
    }
    Ok(graph)
}

fn part_of(arguments: &Arguments, graph: &Graph, machine: &str, name: &str) -> anyhow::Result<Graph> {
    let placement = Placement {
        machine: machine.into(),
        namespace: arguments.namespace.clone(),
        running_graph: name.into(),
        run: run_number(),
        listen: arguments.listen.clone(),
        connect: arguments.connect.clone(),
        keys: arguments.keys.as_deref().map(std::path::absolute).transpose()?,
    };
    Ok(local_graph(graph, &placement, &link_program()?)?)
}

/// Two runs on a machine differ in when they began, and two machines' runs need not differ.
fn run_number() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |now| now.as_nanos() as u64) ^ u64::from(std::process::id()) << 32
}

fn run_graph(arguments: &Arguments, graph: &Graph, name: &str) -> anyhow::Result<Outcome> {
    // Also between two rounds.
    let stop = arguments.stay.then(stop_signal).transpose()?;
    loop {
        // Each round is a run of its own to the other machines.
        let ended = session(arguments).run(&graph_here(arguments, graph, name)?, name)?;
        let is_stopped = stop.as_ref().is_none_or(|stop| stop.load(Ordering::Relaxed));
        if is_stopped || ended.summary.end != "finished" {
            return Ok(ended.outcome);
        }
        print_diagnostic(&format!("graph '{name}' has ended; it begins again and waits for the other machines"));
    }
}

fn session(arguments: &Arguments) -> Session {
    Session {
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
    }
}
