//! `blindgrasp logs`

use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;

use super::{Outcome, completions, print_line};
use blindgrasp_graph::client::{
    ANSWER_LIMIT, ClientError, Connection, is_graph_name, locate, machine_of, pick_graph, status,
};
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_graph::log::AUDIT;
use blindgrasp_graph::log::{LogFolder, LogLine, LogTail};
use blindgrasp_operator::diagnostics::print_diagnostic;

const POLL: Duration = Duration::from_millis(200);

/// Print the logs of a graph, also after it has ended
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp logs classifier -f\n\n\
                        Without an operator, the logs of all are merged by time. Ctrl-C ends -f.\n\
                        The log of an operator on another machine is read there, while it is linked.")]
pub(super) struct Arguments {
    /// Node id of an operator; run: the launching command; audit: requests for changes, with their clients
    #[arg(add = completions::nodes())]
    operator: Option<String>,
    /// Follow the logs
    #[arg(short, long)]
    follow: bool,
    /// Begin with so many lines
    #[arg(short = 'n', long, default_value_t = 100)]
    lines: usize,
    /// Graph, or its part (GRAPH@MACHINE) [default: the only one running, or the latest]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON, one object a line
    ///
    /// {"time", "operator", "level", "text", "fields"}
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let Some(part) = part_elsewhere(arguments) {
        return logs_of_part(arguments, &part);
    }
    let folder = log_folder(arguments.graph.as_deref())?;
    let (mut tail, lines) = LogTail::open(folder, arguments.operator.as_deref(), arguments.lines, u64::MAX)?;
    print(&lines, arguments.json)?;
    if !arguments.follow {
        return Ok(Outcome::Done);
    }
    loop {
        std::thread::sleep(POLL);
        print(&tail.more().context("the logs cannot be read any more")?, arguments.json)?;
    }
}

/// The part of the graph on another machine, if its logs are asked for.
fn part_elsewhere(arguments: &Arguments) -> Option<String> {
    let graph = pick_graph(arguments.graph.as_deref()).ok()?;
    // A node that no part knows may have logs here, of an earlier run.
    let node = arguments.operator.as_ref().filter(|operator| !["run", AUDIT].contains(&operator.as_str()));
    let part = node.map_or(Ok(graph.clone()), |node| locate(&graph, std::slice::from_ref(node)));
    part.ok().filter(|part| machine_of(part).is_some())
}

/// Prints the logs that the link on the other machine reads.
fn logs_of_part(arguments: &Arguments, part: &str) -> anyhow::Result<Outcome> {
    let mut connection = Connection::open(part)?;
    let (operator, n_lines, follow) = (arguments.operator.clone(), arguments.lines, arguments.follow);
    connection.send(&Request::Logs { operator, n_lines, follow })?;
    let mut has_all = false;
    loop {
        let reply = match has_all {
            false => Some(connection.receive(ANSWER_LIMIT, &|| false)?),
            true => connection.receive_within(POLL)?,
        };
        match reply {
            Some(Reply::LogLines { lines, is_all }) => {
                print(&lines, arguments.json)?;
                has_all |= is_all;
            }
            Some(other) => return Err(connection.unexpected(&other).into()),
            None => {}
        }
        if has_all && !arguments.follow {
            return Ok(Outcome::Done);
        }
    }
}

/// The log folder of the graph asked for, else of the only one that runs, else of the latest.
fn log_folder(asked_for: Option<&str>) -> anyhow::Result<LogFolder> {
    let (graph, is_running) = match (pick_graph(asked_for), asked_for) {
        (Ok(graph), _) => (graph, true),
        (Err(ClientError::NotRunning { .. }), Some(name)) if is_graph_name(name) => (name.to_string(), false),
        (Err(ClientError::NoneRunning), _) => {
            let graph = LogFolder::latest_graph().context("no graph is running, and none has left logs")?;
            print_diagnostic(&format!("graph '{graph}', which has ended:"));
            (graph, false)
        }
        (Err(error), _) => return Err(error.into()),
    };
    // It may have been started in another environment.
    let told = is_running.then(|| status(&graph).ok()).flatten().map(|status| LogFolder::at(status.log_folder));
    let folder = told.unwrap_or_else(|| LogFolder::of_graph(&graph));
    if !folder.path().is_dir() {
        bail!("graph '{graph}' has no logs: there is no {}", folder.path().display());
    }
    Ok(folder)
}

fn print(lines: &[LogLine], json: bool) -> anyhow::Result<()> {
    for line in lines {
        if json {
            print_line(&serde_json::to_string(line)?)?;
        } else {
            print_line(&line.to_string())?;
        }
    }
    Ok(())
}
