//! `blindgrasp param`

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::text_table::TextTable;
use super::{Outcome, completions, print_line, set};
use blindgrasp_graph::client::{ANSWER_LIMIT, Connection, pick_graph};
use blindgrasp_graph::control::{NodeStatus, Reply, Request};
use blindgrasp_graph::describe::describe;

/// List, read or set the parameters of a running graph
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp param list lift_arbiter\n          \
                        blindgrasp param get lift_arbiter.votes\n          \
                        blindgrasp param set lift_arbiter.votes=5")]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: ParamCommand,
}

#[derive(Debug, Subcommand)]
enum ParamCommand {
    /// List the parameters with their values, and whether they are live
    List(ListArguments),
    /// Print the value of a parameter
    Get(GetArguments),
    /// Change a live parameter: the same as blindgrasp set
    Set(set::Arguments),
}

#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp param list lift_arbiter")]
struct ListArguments {
    /// Only those of this node
    #[arg(add = completions::nodes())]
    node: Option<String>,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON, one object a parameter: node, param, value, live
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp param get lift_arbiter.votes")]
struct GetArguments {
    /// NODE.PARAM
    #[arg(add = completions::params())]
    param: String,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON: the value
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match &arguments.command {
        ParamCommand::List(arguments) => list(arguments),
        ParamCommand::Get(arguments) => get(arguments),
        ParamCommand::Set(arguments) => set::run(arguments),
    }
}

fn list(arguments: &ListArguments) -> anyhow::Result<Outcome> {
    let (_, nodes) = nodes(arguments.graph.as_deref(), arguments.node.as_deref())?;
    let mut table = TextTable::of_texts(["parameter", "value", ""]);
    for node in &nodes {
        let description = describe(&node.program, &node.args).ok();
        for (name, value) in &node.params {
            let live = description
                .as_ref()
                .map(|description| description.params.iter().any(|param| param.name == *name && param.live));
            if arguments.json {
                let line = json!({"node": node.node, "param": name, "value": value, "live": live});
                print_line(&line.to_string())?;
            }
            let live = if live == Some(true) { "live" } else { "" };
            table.row([format!("{}.{name}", node.node), shown(value), live.into()]);
        }
    }
    if !arguments.json {
        table.lines().iter().try_for_each(|line| print_line(line))?;
    }
    Ok(Outcome::Done)
}

fn get(arguments: &GetArguments) -> anyhow::Result<Outcome> {
    let (node, param) = arguments.param.split_once('.').context("expected NODE.PARAM, as in lift_arbiter.votes")?;
    let (_, nodes) = nodes(arguments.graph.as_deref(), Some(node))?;
    let params = &nodes.first().context("the graph has no such node")?.params;
    let Some(value) = params.get(param) else {
        let known: Vec<&str> = params.keys().map(String::as_str).collect();
        bail!("node '{node}' has no parameter '{param}' with a value; its parameters: {}", known.join(", "));
    };
    print_line(&if arguments.json { value.to_string() } else { shown(value) })?;
    Ok(Outcome::Done)
}

/// The nodes of a graph, or one of them, wherever it runs, and the name of the graph or of its part there.
fn nodes(graph: Option<&str>, node: Option<&str>) -> anyhow::Result<(String, Vec<NodeStatus>)> {
    let graph = pick_graph(graph)?;
    let mut connection = Connection::open(&graph)?;
    let status = match connection.ask(&Request::Status, ANSWER_LIMIT)? {
        Reply::Status(status) => status,
        other => return Err(connection.unexpected(&other).into()),
    };
    let mut nodes = status.nodes.clone();
    if let Some(node) = node {
        let known: Vec<&str> = status.nodes.iter().map(|node| node.node.as_str()).collect();
        nodes.retain(|found| found.node == node);
        if nodes.is_empty() {
            bail!("graph '{graph}' has no node '{node}'; its nodes: {}", known.join(", "));
        }
    }
    Ok((graph, nodes))
}

/// A text without quotes.
fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
