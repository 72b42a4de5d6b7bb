//! `blindgrasp logs`

use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;

use super::{Outcome, print_line};
use crate::diagnostics::print_diagnostic;
use crate::runtime::client::{ClientError, is_graph_name, pick_graph, status};
use crate::runtime::log::{LogFolder, LogLine, LogReader, merge};

/// How often new lines are looked for.
const POLL: Duration = Duration::from_millis(200);

/// Print what a graph's operators have said, also after it has ended.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp logs classifier -f\n\n\
                        Without an operator: all of them, merged by time. Ctrl-C ends -f.")]
pub(super) struct Arguments {
    /// The operator's node id; run for what the launching command itself said.
    operator: Option<String>,
    /// Go on with what is added.
    #[arg(short, long)]
    follow: bool,
    /// How many lines to begin with.
    #[arg(short = 'n', long, default_value_t = 100)]
    lines: usize,
    /// Of which graph; may be left out if only one is running, or for the latest if none is.
    #[arg(long)]
    graph: Option<String>,
    /// Print JSON: {"time", "operator", "level", "text", "fields"}, one a line.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = log_folder(arguments.graph.as_deref())?;
    let mut readers = Vec::new();
    find_new(&folder, arguments.operator.as_deref(), &mut readers)?;
    if readers.is_empty() {
        let names = folder.names()?.join(", ");
        let known = if names.is_empty() { "there are no logs".into() } else { format!("there are: {names}") };
        let whose = arguments.operator.as_deref().unwrap_or("any operator");
        bail!("no log of {whose} in {}; {known}", folder.path().display());
    }
    let logs = readers.iter_mut().map(|reader| {
        let mut lines = reader.read()?;
        // Of all together only so many are shown; of one not more.
        lines.drain(..lines.len().saturating_sub(arguments.lines));
        Ok(lines)
    });
    let mut lines = merge(logs.collect::<std::io::Result<_>>().with_context(|| unreadable(&folder))?);
    lines.drain(..lines.len().saturating_sub(arguments.lines));
    print(&lines, arguments.json)?;
    if !arguments.follow {
        return Ok(Outcome::Done);
    }
    loop {
        std::thread::sleep(POLL);
        // Operators that had said nothing so far.
        find_new(&folder, arguments.operator.as_deref(), &mut readers)?;
        let logs = readers.iter_mut().map(LogReader::read).collect::<std::io::Result<_>>();
        print(&merge(logs.with_context(|| unreadable(&folder))?), arguments.json)?;
    }
}

/// Where the logs are of the graph that is meant: the one asked for, else the only one that runs, else the latest.
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

/// Adds readers for the logs that have none yet.
fn find_new(folder: &LogFolder, operator: Option<&str>, readers: &mut Vec<LogReader>) -> anyhow::Result<()> {
    let names = folder.names().with_context(|| unreadable(folder))?;
    for name in names.iter().filter(|name| operator.is_none_or(|operator| operator == name.as_str())) {
        if !readers.iter().any(|reader| reader.name() == name) {
            readers.push(LogReader::new(folder, name));
        }
    }
    Ok(())
}

fn unreadable(folder: &LogFolder) -> String {
    format!("cannot read the logs in {}", folder.path().display())
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
