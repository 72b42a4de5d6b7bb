//! `blindgrasp check`

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::{Outcome, print_line};
use crate::dataflow::{self, DataflowError, Graph, Input, Node, Override, Restart, RestartPolicy};
use crate::runtime::describe::{describe, shipped};

/// Check a dataflow file without starting it, and print its nodes and edges with everything filled in.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp check dataflow.yaml --set lift_arbiter.votes=5\n\n\
                        Each program is asked for its ports and parameters (--describe); no graph is started.")]
pub(super) struct Arguments {
    /// The dataflow file.
    #[arg(default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// Give a param another value than the file does; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "NODE.PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Print JSON: {"graph": …}, or {"errors": […]} when there are mistakes.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let shipped = shipped()?;
    let checked = dataflow::load(&arguments.dataflow)
        .and_then(|file| dataflow::check(&file, &shipped, &arguments.overrides, describe));
    match &checked {
        Ok(graph) if arguments.json => print_line(&serde_json::to_string_pretty(&json!({ "graph": graph }))?)?,
        Ok(graph) => print_graph(graph)?,
        // The mistakes still go to stderr, for whoever watches the script.
        Err(error) if arguments.json => print_line(&serde_json::to_string_pretty(&errors(error))?)?,
        Err(_) => {}
    }
    checked?;
    Ok(Outcome::Done)
}

fn errors(error: &DataflowError) -> serde_json::Value {
    let errors = error.diagnostics.iter().map(|diagnostic| {
        json!({
            "line": diagnostic.at.map(|at| at.line),
            "column": diagnostic.at.map(|at| at.column),
            "set": diagnostic.setting.as_ref().map(ToString::to_string),
            "message": diagnostic.message,
            "help": diagnostic.help,
        })
    });
    json!({ "errors": errors.collect::<Vec<_>>() })
}

fn print_graph(graph: &Graph) -> std::io::Result<()> {
    let (n_nodes, n_edges) = (graph.nodes.len(), graph.edges().count());
    print_line(&format!("graph '{}': {n_nodes} nodes, {n_edges} edges\n", graph.name))?;
    let nodes = graph.nodes.iter().map(|node| {
        let heartbeat = node.heartbeat_millis.map_or("off".into(), |millis| format!("{millis} ms"));
        [node.id.clone(), restart(&node.restart), heartbeat, command(node)]
    });
    print_table(["node", "restart", "heartbeat", "program"], nodes.collect())?;
    let edges = graph.nodes.iter().flat_map(|node| node.inputs.iter().map(move |input| edge(node, input)));
    let edges: Vec<_> = edges.collect();
    if !edges.is_empty() {
        print_line("")?;
        print_table(["edge", "type", "policy", "capacity", "deadline"], edges)?;
    }
    Ok(())
}

fn restart(restart: &Restart) -> String {
    let Restart { policy, limit, within_millis, backoff_millis } = restart;
    match policy {
        RestartPolicy::Never => policy.to_string(),
        _ => format!("{policy}, {limit} in {} s, backoff {backoff_millis} ms", *within_millis as f64 / 1000.0),
    }
}

/// The program with its arguments, in quotes where they would otherwise run together.
fn command(node: &Node) -> String {
    let mut command = node.program.display().to_string();
    for arg in &node.args {
        let is_clear = !arg.is_empty() && !arg.contains(|char: char| char.is_whitespace() || char.is_control());
        command += &if is_clear { format!(" {arg}") } else { format!(" {arg:?}") };
    }
    command
}

fn edge(node: &Node, input: &Input) -> [String; 5] {
    [
        format!("{}/{} → {}/{}", input.from_node, input.from_port, node.id, input.port),
        input.type_name.clone(),
        input.edge.policy.to_string(),
        input.edge.capacity.to_string(),
        input.edge.deadline_millis.map_or("none".into(), |millis| format!("{millis} ms")),
    ]
}

/// Columns as wide as their longest entry, except the last.
fn print_table<const N: usize>(titles: [&str; N], rows: Vec<[String; N]>) -> std::io::Result<()> {
    let mut widths = titles.map(|title| title.chars().count());
    for row in &rows {
        for (width, entry) in widths.iter_mut().zip(row) {
            *width = entry.chars().count().max(*width);
        }
    }
    for row in std::iter::once(titles.map(String::from)).chain(rows) {
        let line: String = row.iter().zip(widths).map(|(entry, width)| format!("{entry:width$}  ")).collect();
        print_line(line.trim_end())?;
    }
    Ok(())
}
