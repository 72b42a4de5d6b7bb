//! `blindgrasp stop`

use anyhow::bail;
use clap::Args;
use serde_json::json;

use super::{GraphArgument, Outcome, print_line};
use blindgrasp_graph::client::{
    ANSWER_LIMIT, ClientError, Connection, machine_of, part_name, pick_graph, running_graphs,
};
use blindgrasp_graph::control::{Reply, Request};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// Stop a running graph and wait until it has ended
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp stop grasp_gate\n\n\
                        Samples in flight are decided first. Ctrl-C ends the wait only; the graph still stops.\n\
                        Of a graph on several machines, only the part here, or the part that is named, is stopped.")]
pub(super) struct Arguments {
    #[command(flatten)]
    graph: GraphArgument,
    /// Stop the part on this other machine; the part here goes on
    #[arg(long, conflicts_with = "all")]
    machine: Option<String>,
    /// Stop all graphs of this user
    #[arg(long, conflicts_with_all = ["graph", "named"])]
    all: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graphs = match (arguments.all, &arguments.machine) {
        (true, _) => running_graphs()?,
        (false, None) => vec![pick_graph(arguments.graph.name())?],
        (false, Some(machine)) => {
            let graph = arguments.graph.name().map_or_else(|| pick_graph(None), |name| Ok(name.to_owned()))?;
            if machine_of(&graph).is_some() {
                bail!("{graph} already names a machine: leave --machine {machine} out, or name the graph alone");
            }
            vec![pick_graph(Some(&part_name(&graph, machine)))?]
        }
    };
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
