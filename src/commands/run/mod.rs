//! `blindgrasp run`

mod page;

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};

use self::page::Page;
use super::recording_arguments::RecordingArguments;
use super::view::Rights;
use super::{Outcome, background, check, secs_in, stop_requests};
use blindgrasp_cli::graph_file::{OnMisfit, fitting, shipped};
use blindgrasp_graph::dataflow::{self, Graph, Override, Scope};
use blindgrasp_graph::launcher::LaunchOptions;
use blindgrasp_graph::link::{Placement, local_graph};
use blindgrasp_graph::log::LogFormat;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_session::run::Session;

/// Run a graph and print its decisions
///
/// Starts the operators of a dataflow file, prints each decision, and sums up at the end. Ctrl-C stops the graph
/// cleanly. A dataflow file is code: its programs are run.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp run dataflow.yaml --record /tmp/run.mcap\n          \
                        blindgrasp run dataflow.yaml --check --set lift_arbiter.votes=5")]
pub(super) struct Arguments {
    /// Dataflow file
    #[arg(default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// Check the file and print the graph; start nothing
    ///
    /// Asks each program for its ports and parameters, and prints nodes and edges with every value filled in. The
    /// programs of the file are run for that, with --describe: use only files that you trust. With --machine, the programs and files of
    /// other machines need not be here. With --json: {"graph": …}, with "crossing" edges where the file names machines, or {"errors": […]}.
    #[arg(long, conflicts_with_all = ["record", "detach", "stay", "metrics", "view"])]
    check: bool,
    /// Name of the running graph [default: the file's]
    #[arg(long)]
    name: Option<String>,
    /// Set a parameter; repeatable
    ///
    /// The value takes the place of the file's. A path is relative to the current folder.
    #[arg(long = "set", value_name = "[NODE.]PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Start although nothing can be lifted
    ///
    /// A graph is refused if arbiter, model and hand do not fit together: the model does not judge the arbiter's probe, or was
    /// trained for another hand, or encoder and classifier have different models. With this it is a warning.
    #[arg(long)]
    allow_mismatch: bool,
    /// Print JSON, one line a decision, and a last one with "summary"
    #[arg(long)]
    json: bool,
    /// Print warnings and errors only
    #[arg(short, long)]
    quiet: bool,
    /// Run in the background, see ps, logs, swap and stop
    ///
    /// Returns as soon as the graph runs.
    #[arg(short, long)]
    detach: bool,
    /// Answer Prometheus on this port of 127.0.0.1 (0: a free one)
    ///
    /// The address is http://127.0.0.1:PORT/metrics.
    #[arg(long, value_name = "PORT")]
    metrics: Option<u16>,
    /// Show the graph in a browser, on this port of 127.0.0.1 (0: a free one)
    ///
    /// As `blindgrasp view GRAPH`, which shows a graph that runs already. The address is printed.
    #[arg(
        long,
        value_name = "PORT",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "0",
        conflicts_with_all = ["detach", "stay"]
    )]
    view: Option<u16>,
    #[command(flatten)]
    rights: Rights,
    /// Format of the log files: text, or JSON, one object a line
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    log_format: LogFormatArgument,
    /// Record every edge to this file (MCAP)
    #[arg(long, value_name = "FILE", help_heading = "Recording")]
    record: Option<PathBuf>,
    #[command(flatten)]
    recording: RecordingArguments,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    machines: MachineOptions,
    /// This is the process that --detach has started
    #[arg(long, hide = true)]
    in_background: bool,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Time limits")]
struct Limits {
    /// Operators must be ready within this time, also after a restart
    #[arg(long, value_name = "TIME", default_value = "20", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    startup_limit: f64,
    /// Kill operators that have not drained, or exited, after this time
    ///
    /// When the graph stops, operators answer the samples that are left. At a recording's end the time begins again with each answer.
    #[arg(long, value_name = "TIME", default_value = "10", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    grace: f64,
    /// A writer on a lossless edge that waits longer for a reader fails
    ///
    /// It must be longer than the slowest operator takes to come back.
    #[arg(long, value_name = "TIME", default_value = "5", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    wait_limit: f64,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Several machines")]
struct MachineOptions {
    /// Start this machine's operators, and a link to the others
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// Start the operators of all machines here, without a link
    #[arg(long, conflicts_with_all = ["machine", "namespace", "listen", "connect", "keys", "stay"])]
    all_machines: bool,
    /// Tell equal graphs apart, for example one for each robot
    ///
    /// Machines of different namespaces do not hear each other. The running graph is named GRAPH-NAMESPACE.
    #[arg(long, value_name = "NAME", requires = "machine")]
    namespace: Option<String>,
    /// Listen here instead of where the file says; repeatable
    #[arg(long, value_name = "ENDPOINT", requires = "machine")]
    listen: Vec<String>,
    /// Connect to this machine or router instead of the file's; repeatable
    #[arg(long, value_name = "ENDPOINT", requires = "machine")]
    connect: Vec<String>,
    /// Folder with this machine's keys, instead of the file's
    #[arg(long, value_name = "DIR", requires = "machine")]
    keys: Option<PathBuf>,
    /// Begin again when the sources on other machines have ended
    #[arg(long, requires = "machine", conflicts_with = "record")]
    stay: bool,
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
    if arguments.rights.is_any() && arguments.view.is_none() {
        let message = "--view-control and --foxglove are for the page of the graph: add --view\n";
        clap::Error::raw(clap::error::ErrorKind::MissingRequiredArgument, message).exit();
    }
    let scope = arguments.machines.machine.as_deref().map_or(Scope::Everything, Scope::Machine);
    let on_misfit = if arguments.allow_mismatch { OnMisfit::Warn } else { OnMisfit::Refuse };
    if arguments.check {
        return check::run(&arguments.dataflow, &arguments.overrides, scope, on_misfit, arguments.json);
    }
    let file = dataflow::load(&arguments.dataflow)?;
    let graph = fitting(&file, &arguments.overrides, scope, on_misfit)?;
    let name = running_name(arguments, &graph)?;
    let name = name.as_str();
    // Every mistake is reported before the graph goes into the background.
    graph_here(arguments, &graph)?;
    if arguments.in_background {
        return background::into_log(name, arguments.log_format.into(), || run_graph(arguments, &graph, name));
    }
    if arguments.detach {
        return background::detach(name, arguments.json);
    }
    run_graph(arguments, &graph, name)
}

fn running_name(arguments: &Arguments, graph: &Graph) -> anyhow::Result<String> {
    if let Some(namespace) = arguments.machines.namespace.as_ref().filter(|namespace| !dataflow::is_name(namespace)) {
        bail!("--namespace '{namespace}': expected letters, digits, _ and -, at most 32");
    }
    let name = match (&arguments.name, &arguments.machines.namespace) {
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

/// The part of a graph that runs here.
fn graph_here(arguments: &Arguments, graph: &Graph) -> anyhow::Result<Graph> {
    match &arguments.machines.machine {
        Some(machine) => part_of(arguments, graph, machine),
        None => whole(arguments, graph.clone()),
    }
}

/// A graph without machines, or with all of its machines here.
fn whole(arguments: &Arguments, graph: Graph) -> anyhow::Result<Graph> {
    if let Some(machines) = graph.machines.as_ref()
        && !arguments.machines.all_machines
    {
        let names: Vec<_> = machines.machines.iter().map(|machine| machine.name.as_str()).collect();
        bail!(
            "this graph runs on several machines: say which one this is with --machine {}, or start all operators here \
             with --all-machines",
            names.join("|")
        );
    }
    if arguments.machines.all_machines && graph.machines.is_none() {
        bail!("the file names no machines, so --all-machines has no meaning; leave it out");
    }
    Ok(graph)
}

fn part_of(arguments: &Arguments, graph: &Graph, machine: &str) -> anyhow::Result<Graph> {
    let placement = Placement {
        machine: machine.into(),
        namespace: arguments.machines.namespace.clone(),
        run: run_number(),
        listen: arguments.machines.listen.clone(),
        connect: arguments.machines.connect.clone(),
        keys: arguments.machines.keys.as_deref().map(std::path::absolute).transpose()?,
    };
    let operators = shipped()?;
    let link = operators.link().context("this program has no link to other machines")?;
    Ok(local_graph(graph, &placement, link)?)
}

/// Two runs on a machine begin at different times; runs on two machines may have the same number.
fn run_number() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |now| now.as_nanos() as u64) ^ u64::from(std::process::id()) << 32
}

fn run_graph(arguments: &Arguments, graph: &Graph, name: &str) -> anyhow::Result<Outcome> {
    let n_stops = stop_requests()?;
    loop {
        // Each round is a run of its own to the other machines.
        let graph_here = graph_here(arguments, graph)?;
        let _page = arguments.view.map(|port| Page::start(name, port, arguments.rights)).transpose()?;
        let ended = session(arguments).run(&graph_here, name, &n_stops)?;
        let is_stopped = n_stops.load(Ordering::Relaxed) > 0 || !arguments.machines.stay;
        if is_stopped || ended.summary.run.end != "finished" {
            return Ok(Outcome::of(ended.is_lossy));
        }
        print_diagnostic(&format!("graph '{name}' has ended; it begins again and waits for the other machines"));
    }
}

fn session(arguments: &Arguments) -> Session {
    Session {
        launch: LaunchOptions {
            startup_limit: Duration::from_secs_f64(arguments.limits.startup_limit),
            grace: Duration::from_secs_f64(arguments.limits.grace),
            wait_limit: Duration::from_secs_f64(arguments.limits.wait_limit),
            is_on_terminal: !arguments.in_background,
            log_format: arguments.log_format.into(),
            begins_again: arguments.machines.stay,
        },
        clock: Clock::Machine,
        record: arguments.record.clone(),
        record_options: arguments.recording.options(),
        metrics: arguments.metrics,
        json: arguments.json,
        is_quiet: arguments.quiet,
        tap: None,
    }
}
