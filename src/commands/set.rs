//! `blindgrasp set`

use std::str::FromStr;
use std::time::Duration;

use anyhow::bail;
use clap::Args;
use serde_json::{Value, json};

use super::text_table::TextTable;
use super::{Outcome, completions, print_line, print_text};
use blindgrasp_cli::graph_file::{describe, warn_of_misfit};
use blindgrasp_graph::client::{Connection, pick_graph, status};
use blindgrasp_graph::control::{NodeStatus, Reply, Request};
use blindgrasp_operator::text::did_you_mean;

/// The operator checks the value, and applies it between two samples.
const LIMIT: Duration = Duration::from_secs(10);

/// Change a live parameter of a running graph, or show parameters
///
/// Without a value it shows: all parameters, those of a node, or the value of one.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples: blindgrasp set                        all parameters, and which are live\n          \
                        blindgrasp set lift_arbiter           those of a node\n          \
                        blindgrasp set lift_arbiter.votes     the value of one\n          \
                        blindgrasp set lift_arbiter.votes=5   change it from the next sample on\n\n\
                        Change parameters that are not live with: blindgrasp swap NODE --set NAME=VALUE"
)]
pub(super) struct Arguments {
    /// NODE.PARAM=VALUE to change it, NODE.PARAM or NODE to show it; the value is a number, true, false or a text
    ///
    /// Without NODE it is the parameter of each node that has it, as with run --set.
    #[arg(value_name = "[NODE.]PARAM[=VALUE]", add = completions::assignments())]
    what: Option<What>,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON: what was changed; the value; or one object a parameter, with node, param, value, live
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, PartialEq)]
enum What {
    /// A node, or a parameter of any node.
    Name(String),
    Param {
        node: String,
        param: String,
    },
    Assignment(Assignment),
}

#[derive(Debug, Clone, PartialEq)]
struct Assignment {
    /// Without it, each node that has the parameter.
    node: Option<String>,
    param: String,
    value: Value,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match &arguments.what {
        None => list(arguments, None),
        Some(What::Name(name)) => list(arguments, Some(name)),
        Some(What::Param { node, param }) => get(arguments, node, param),
        Some(What::Assignment(assignment)) => assign(arguments, assignment),
    }
}

/// Lists all parameters, those of a node, or those of a name.
fn list(arguments: &Arguments, named: Option<&str>) -> anyhow::Result<Outcome> {
    let mut nodes = all_nodes(arguments.graph.as_deref())?;
    if let Some(name) = named {
        if !nodes.iter().any(|node| node.node == name) && nodes.iter().any(|node| node.params.contains_key(name)) {
            nodes.iter_mut().for_each(|node| node.params.retain(|param, _| param == name));
            nodes.retain(|node| !node.params.is_empty());
        } else {
            nodes = node_of(nodes, name)?;
        }
    }
    let mut table = TextTable::of_texts(["parameter", "value", ""]);
    for node in &nodes {
        let description = describe(&node.program, &node.args).ok();
        let live_params: Option<Vec<String>> = description.map(|description| {
            description.params.into_iter().filter(|param| param.live).map(|param| param.name).collect()
        });
        for (name, value) in &node.params {
            let live = live_params.as_ref().map(|live| live.contains(name));
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

fn get(arguments: &Arguments, node: &str, param: &str) -> anyhow::Result<Outcome> {
    let nodes = node_of(all_nodes(arguments.graph.as_deref())?, node)?;
    let Some(value) = nodes.iter().find_map(|node| node.params.get(param)) else {
        let known: Vec<&str> = nodes.iter().flat_map(|node| node.params.keys().map(String::as_str)).collect();
        bail!("node '{node}' has no parameter '{param}' with a value; its parameters: {}", known.join(", "));
    };
    print_text(&if arguments.json { value.to_string() } else { shown(value) })?;
    Ok(Outcome::Done)
}

fn all_nodes(graph: Option<&str>) -> anyhow::Result<Vec<NodeStatus>> {
    Ok(status(&pick_graph(graph)?)?.nodes)
}

/// The node of that name.
fn node_of(nodes: Vec<NodeStatus>, name: &str) -> anyhow::Result<Vec<NodeStatus>> {
    let known: Vec<String> = nodes.iter().map(|node| node.node.clone()).collect();
    let found: Vec<NodeStatus> = nodes.into_iter().filter(|node| node.node == name).collect();
    if found.is_empty() {
        let alike = did_you_mean(name, known.iter().map(String::as_str)).map(|alike| format!("{alike} "));
        bail!("the graph has no node '{name}'; {}its nodes: {}", alike.unwrap_or_default(), known.join(", "));
    }
    Ok(found)
}

/// A text without quotes.
fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Changes the parameter of a node, or of each node that has it, as `run --set` does.
fn assign(arguments: &Arguments, assignment: &Assignment) -> anyhow::Result<Outcome> {
    let Assignment { node, param, value } = assignment;
    let graph = pick_graph(arguments.graph.as_deref())?;
    let nodes = match node {
        Some(node) => vec![node.clone()],
        None => nodes_with(&graph, param)?,
    };
    for node in nodes {
        assign_to(arguments, &graph, &node, param, value)?;
    }
    Ok(Outcome::Done)
}

/// The nodes that have a parameter.
fn nodes_with(graph: &str, param: &str) -> anyhow::Result<Vec<String>> {
    let nodes = status(graph)?.nodes;
    let found: Vec<String> =
        nodes.iter().filter(|node| node.params.contains_key(param)).map(|node| node.node.clone()).collect();
    if found.is_empty() {
        let known = nodes.iter().flat_map(|node| node.params.keys().map(String::as_str));
        let alike = did_you_mean(param, known).map(|alike| format!("; {alike}")).unwrap_or_default();
        bail!("no node of graph '{graph}' has the parameter '{param}'{alike}; blindgrasp set lists all");
    }
    Ok(found)
}

fn assign_to(arguments: &Arguments, graph: &str, node: &str, param: &str, value: &Value) -> anyhow::Result<()> {
    warn_of_misfit(graph, node, param, value)?;
    let mut connection = Connection::open(graph)?;
    let request = Request::Set { node: node.into(), param: param.into(), value: value.clone() };
    let (old, new, from_seq) = match connection.ask(&request, LIMIT)? {
        Reply::Set { old, new, from_seq } => (old, new, from_seq),
        other => return Err(connection.unexpected(&other).into()),
    };
    if arguments.json {
        let graph = connection.graph();
        let line = json!({
            "graph": graph, "node": node, "param": param, "old": old, "new": new, "from_seq": from_seq
        });
        print_line(&line.to_string())?;
    } else {
        let from = from_seq.map_or("its first sample on".into(), |seq| format!("sample {seq} on"));
        print_line(&format!("{node}.{param}: {old} → {new}, from {from}"))?;
    }
    Ok(())
}

impl FromStr for What {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (target, value) = match text.split_once('=') {
            Some((target, value)) => (target, Some(value)),
            None => (text, None),
        };
        match (target.split_once('.'), value) {
            (Some((node, param)), Some(value)) if !node.is_empty() && !param.is_empty() => {
                let value = value_of(value);
                Ok(What::Assignment(Assignment { node: Some(node.into()), param: param.into(), value }))
            }
            (None, Some(value)) if !target.is_empty() => {
                Ok(What::Assignment(Assignment { node: None, param: target.into(), value: value_of(value) }))
            }
            (Some((node, param)), None) if !node.is_empty() && !param.is_empty() => {
                Ok(What::Param { node: node.into(), param: param.into() })
            }
            (None, None) if !text.is_empty() => Ok(What::Name(text.into())),
            _ => Err("expected [NODE.]PARAM=VALUE, as in lift_arbiter.votes=5, or NODE.PARAM, NODE or PARAM".into()),
        }
    }
}

/// A number, a boolean, or a text; quotes make a number or boolean a text.
fn value_of(text: &str) -> Value {
    match serde_json::from_str(text) {
        Ok(value @ (Value::Number(_) | Value::Bool(_) | Value::String(_))) => value,
        _ => Value::String(text.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_numbers_booleans_or_texts() {
        let cases = [
            ("5", json!(5)),
            ("-0.5", json!(-0.5)),
            ("true", json!(true)),
            ("max", json!("max")),
            ("\"5\"", json!("5")),
            ("a=b.c", json!("a=b.c")),
            ("", json!("")),
            ("null", json!("null")),
            ("[1]", json!("[1]")),
        ];
        for (text, value) in cases {
            let expected = Assignment { node: Some("lift_arbiter".into()), param: "votes".into(), value };
            assert_eq!(format!("lift_arbiter.votes={text}").parse(), Ok(What::Assignment(expected)), "{text}");
        }
        let of_all = Assignment { node: None, param: "votes".into(), value: json!(5) };
        assert_eq!("votes=5".parse(), Ok(What::Assignment(of_all)));
        for text in [".b=1", "a.=1", ".b", "a.", "=1", ""] {
            text.parse::<What>().expect_err(text);
        }
    }

    #[test]
    fn without_a_value_a_parameter_or_a_node_is_shown() {
        assert_eq!("a.b".parse(), Ok(What::Param { node: "a".into(), param: "b".into() }));
        assert_eq!("a".parse(), Ok(What::Name("a".into())));
    }
}
