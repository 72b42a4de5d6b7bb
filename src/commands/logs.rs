//! `blindgrasp logs`

use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;

use super::{Outcome, completions, print_line};
use blindgrasp_graph::client::{ClientError, is_graph_name, pick_graph, running_graphs, status};
use blindgrasp_graph::log::{LogFolder, LogLine, LogTail};
use blindgrasp_operator::diagnostics::print_diagnostic;

const POLL: Duration = Duration::from_millis(200);

/// Print the logs of a graph, also after it has ended
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp logs classifier -f\n\n\
                        Without an operator, the logs of all are merged by time. Ctrl-C ends -f.")]
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
    /// Graph [default: the only one running, or the latest]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON, one object a line
    ///
    /// {"time", "operator", "level", "text", "fields"}
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = log_folder(arguments.graph.as_deref())?;
    let opened = LogTail::open(folder, arguments.operator.as_deref(), arguments.lines);
    if let (Err(_), Some(name)) = (&opened, &arguments.operator)
        && running_graphs().contains(name)
    {
        bail!("'{name}' is a running graph, expected one of its nodes: blindgrasp logs -g {name}");
    }
    let (mut tail, lines) = opened?;
    print(&lines, arguments.json)?;
    if !arguments.follow {
        return Ok(Outcome::Done);
    }
    loop {
        std::thread::sleep(POLL);
        print(&tail.more().context("the logs cannot be read any more")?, arguments.json)?;
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
