//! `blindgrasp stop`

use anyhow::bail;
use clap::Args;
use serde_json::json;

use super::{Outcome, completions, print_line};
use blindgrasp_graph::client::{ANSWER_LIMIT, ClientError, Connection, pick_starting_graph, running_graphs};
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// Stop a running graph and wait until it has ended
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp stop grasp_gate\n\n\
                        Samples in flight are decided first. Ctrl-C ends the wait only; the graph still stops.\n\
                        Of a graph on several machines, the part here is stopped.")]
pub(super) struct Arguments {
    /// Graph [default: the only one running]
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    /// Stop all graphs of this user
    #[arg(long, conflicts_with = "graph")]
    all: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graphs = if arguments.all { running_graphs() } else { vec![pick_starting_graph(arguments.graph.as_deref())?] };
    if graphs.is_empty() {
        print_diagnostic("no graph is running");
    }
    let mut ended = Vec::new();
    let mut failed = Vec::new();
    let mut printed = Ok(());
    // All are asked first, so that they stop at the same time.
    let stopping: Vec<_> = graphs.into_iter().map(|graph| (ask_to_stop(&graph), graph)).collect();
    for (connection, graph) in stopping {
        let outcome = match connection {
            Ok(Some(connection)) => connection.wait_until_ended(),
            Ok(None) => Ok(()),
            Err(error) => Err(error),
        };
        match outcome {
            Ok(()) if arguments.json => ended.push(graph),
            Ok(()) => printed = printed.and(print_line(&format!("graph '{graph}' has ended"))),
            Err(error) => failed.push((graph, anyhow::Error::from(error))),
        }
    }
    if arguments.json {
        let failed: Vec<_> =
            failed.iter().map(|(graph, error)| json!({ "graph": graph, "message": format!("{error:#}") })).collect();
        printed = print_line(&json!({ "ended": ended, "failed": failed }).to_string());
    }
    let messages: Vec<String> = failed.into_iter().map(|(_, error)| format!("{error:#}")).collect();
    if !messages.is_empty() {
        bail!("{}", messages.join("\n"));
    }
    printed?;
    Ok(Outcome::Done)
}

/// The connection that ends with the graph; `None` if it ended by itself meanwhile.
fn ask_to_stop(graph: &str) -> Result<Option<Connection>, ClientError> {
    let mut connection = match Connection::open(graph) {
        Err(ClientError::NotRunning { .. }) => return Ok(None),
        connection => connection?,
    };
    match connection.ask(&Request::Stop, ANSWER_LIMIT) {
        Ok(Reply::Stopping) => Ok(Some(connection)),
        Ok(other) => Err(connection.unexpected(&other)),
        Err(ClientError::Ended { .. }) => Ok(Some(connection)),
        Err(error) => Err(error),
    }
}
