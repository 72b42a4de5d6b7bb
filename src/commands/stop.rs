//! `blindgrasp stop`

use anyhow::bail;
use clap::Args;
use serde_json::json;

use super::{Outcome, print_line};
use blindgrasp_graph::client::{
    ANSWER_LIMIT, ClientError, Connection, machine_of, part_name, pick_graph, running_graphs,
};
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// Stop a running graph as Ctrl-C would, and wait until it has ended.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp stop grasp_gate\n\n\
                        Everything in flight is decided first. Ctrl-C ends the wait, not the stopping.\n\
                        Of a graph on several machines, only the part on this one is stopped, or the one that is named.")]
pub(super) struct Arguments {
    /// Which graph, or part of one (GRAPH@MACHINE); may be left out if only one is running.
    graph: Option<String>,
    /// Stop the part that runs on this machine of the graph; what runs here goes on.
    #[arg(long, conflicts_with = "all")]
    machine: Option<String>,
    /// Stop all of this user's graphs.
    #[arg(long, conflicts_with = "graph")]
    all: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graphs = match (arguments.all, &arguments.machine) {
        (true, _) => running_graphs()?,
        (false, None) => vec![pick_graph(arguments.graph.as_deref())?],
        (false, Some(machine)) => {
            let graph = arguments.graph.clone().map_or_else(|| pick_graph(None), Ok)?;
            if machine_of(&graph).is_some() {
                bail!("{graph} names a machine already: leave --machine {machine} out, or name the graph alone");
            }
            vec![pick_graph(Some(&part_name(&graph, machine)))?]
        }
    };
    if graphs.is_empty() {
        print_diagnostic("no graph is running");
    }
    let mut ended = Vec::new();
    let mut failed = Vec::new();
    // Nobody may be reading; the graphs are waited for all the same.
    let mut printed = Ok(());
    // All are asked before any is waited for: they stop side by side.
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
