//! `blindgrasp set`

use std::str::FromStr;
use std::time::Duration;

use clap::Args;
use serde_json::{Value, json};

use super::elsewhere::MachineArgument;
use super::graph_file::warn_of_misfit;
use super::{Outcome, completions, print_line};
use blindgrasp_graph::client::{Connection, pick_graph};
use blindgrasp_graph::control::{Reply, Request};

/// The operator checks the value, and applies it between two samples.
const LIMIT: Duration = Duration::from_secs(10);

/// Change a live parameter of a running operator
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp set lift_arbiter.votes=5\n\n\
                        PROGRAM --describe tells which parameters are live. Change others with: blindgrasp swap NODE --set NAME=VALUE")]
pub(super) struct Arguments {
    /// NODE.PARAM=VALUE; the value is a number, true, false or a text
    #[arg(add = completions::assignments())]
    assignment: Assignment,
    /// Graph [default: the only one running]
    #[arg(short, long, add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    machine: MachineArgument,
}

#[derive(Debug, Clone, PartialEq)]
struct Assignment {
    node: String,
    param: String,
    value: Value,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    if let Some(destination) = arguments.machine.destination()? {
        return destination.run();
    }
    let Assignment { node, param, value } = arguments.assignment.clone();
    let graph = pick_graph(arguments.graph.as_deref())?;
    warn_of_misfit(&graph, &node, &param, &value)?;
    let mut connection = Connection::open(&graph)?;
    let request = Request::Set { node: node.clone(), param: param.clone(), value };
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
    Ok(Outcome::Done)
}

impl FromStr for Assignment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('=').and_then(|(target, value)| Some((target.split_once('.')?, value)));
        match parts {
            Some(((node, param), value)) if !node.is_empty() && !param.is_empty() => {
                Ok(Assignment { node: node.into(), param: param.into(), value: value_of(value) })
            }
            _ => Err("expected NODE.PARAM=VALUE, as in lift_arbiter.votes=5".into()),
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
            let expected = Assignment { node: "lift_arbiter".into(), param: "votes".into(), value };
            assert_eq!(format!("lift_arbiter.votes={text}").parse(), Ok(expected), "{text}");
        }
        for text in ["votes=5", "a.b", ".b=1", "a.=1", ""] {
            text.parse::<Assignment>().expect_err(text);
        }
    }
}
