//! Orders from the page of a graph: each is a command of this program, with its checks and its line in the audit log.

use std::process::{Command, Stdio};

use blindgrasp_graph::client::status;
use blindgrasp_viewer::{Control, Order};

/// Lets the page change a graph.
pub(super) fn control_of(graph: &str) -> std::io::Result<Control> {
    let graph = graph.to_owned();
    Control::new(Box::new(move |order| {
        let arguments = arguments(&graph, order)?;
        let failed = |error: std::io::Error| format!("the order cannot be carried out: {error}");
        let program = std::env::current_exe().map_err(failed)?;
        let output = Command::new(program).args(arguments).stdin(Stdio::null()).output().map_err(failed)?;
        let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).trim().to_owned());
        let text = text.join("\n").trim().to_owned();
        if output.status.success() { Ok(text) } else { Err(text) }
    }))
}

/// The name of a node, if the graph has it.
fn known(graph: &str, node: String) -> Result<String, String> {
    let status = status(graph).map_err(|error| error.to_string())?;
    let is_known = status.nodes.iter().any(|known| known.node == node);
    if is_known { Ok(node) } else { Err(format!("graph '{graph}' has no node '{node}'")) }
}

/// The command line of an order. A node must be one of the graph's, so that no text of the page counts as an option.
fn arguments(graph: &str, order: Order) -> Result<Vec<String>, String> {
    let mut arguments = match order {
        Order::Set { node, param, value } => vec!["set".into(), format!("{}.{param}={value}", known(graph, node)?)],
        Order::Swap { node, changes, compare_secs, min_agreement } => {
            let mut arguments = vec!["swap".into(), known(graph, node)?];
            arguments.extend(changes.into_iter().map(|change| format!("--set={change}")));
            if compare_secs > 0.0 {
                arguments.push(format!("--shadow={compare_secs}"));
                arguments.push(format!("--min-agreement={min_agreement}"));
            }
            arguments
        }
        // The name is no option.
        Order::Stop {} => return Ok(vec!["stop".into(), graph.into()]),
    };
    arguments.push(format!("--graph={graph}"));
    Ok(arguments)
}
