//! The mistakes that a node's operator finds when it begins, found before anything is started: files that cannot be read,
//! params that do not go together, inputs that must not hold up the graph. An operator asks the same functions when it
//! begins.

use blindgrasp_graph::dataflow::{EdgePolicy, Graph, Node};
use blindgrasp_operator::wiring::Sandbox;
use serde_json::{Map, Value};

use crate::form_of;

/// A node as its dataflow file has it.
pub struct FileNode<'a> {
    pub(crate) params: &'a Map<String, Value>,
    /// The connected inputs, and whether each is lossless.
    pub(crate) inputs: Vec<(&'a str, bool)>,
    pub(crate) has_sandbox: bool,
}

/// A node that could not begin, and why.
#[derive(Debug)]
pub struct UnableNode {
    pub node: String,
    pub reason: String,
}

/// The nodes of a graph that could not begin on the machine `here`; without it, on any machine. Nodes of other machines have their files there,
/// and programs of somebody's own are not asked.
pub fn unable_to_begin(graph: &Graph, here: Option<&str>) -> Vec<UnableNode> {
    let mut unable = Vec::new();
    for node in &graph.nodes {
        if here.is_some() && node.machine.is_some() && node.machine.as_deref() != here {
            continue;
        }
        if let Err(error) = check(node) {
            unable.push(UnableNode { node: node.id.clone(), reason: format!("{error:#}") });
        }
    }
    unable
}

fn check(node: &Node) -> anyhow::Result<()> {
    let Some(form) = form_of(&node.args) else {
        return Ok(());
    };
    let inputs = node.inputs.iter().map(|input| (input.port.as_str(), input.edge.policy == EdgePolicy::Lossless));
    let has_sandbox = node.sandbox != Sandbox::Off;
    (form.check)(&FileNode { params: &node.params, inputs: inputs.collect(), has_sandbox })
}
