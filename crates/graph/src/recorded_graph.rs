//! The facts about a graph that its recording holds, and how a recording ends.

use serde::Serialize;
use serde_json::json;

use crate::dataflow::Node;

/// The name of the metadata about the graph.
pub const GRAPH_METADATA: &str = "graph";

/// The name of the attached file of a node's model.
pub fn attached_model(node: &str) -> String {
    format!("model of {node}.json")
}

/// How a recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// With the graph.
    Graph,
    /// The graph went on.
    #[default]
    Detached,
    /// With the graph, which failed or was killed: the last samples may be missing.
    Broken,
}

impl Ending {
    /// The word in the recording.
    pub fn word(self) -> &'static str {
        match self {
            Ending::Graph => "graph",
            Ending::Detached => "detached",
            Ending::Broken => "broken",
        }
    }
}

/// A graph as it runs, for the metadata of a recording: its nodes with programs, arguments, parameters and inputs.
pub fn describe_graph<'a>(name: &str, nodes: impl Iterator<Item = &'a Node>) -> serde_json::Value {
    let node = |node: &Node| {
        let inputs = node.inputs.iter().map(|input| {
            json!({
                "port": input.port,
                "from": format!("{}/{}", input.from_node, input.from_port),
                "policy": input.edge.policy,
                "capacity": input.edge.capacity,
                "deadline_ms": input.edge.deadline_millis,
            })
        });
        json!({
            "id": node.id,
            "operator": node.description.operator,
            "version": node.description.version,
            "program": node.program,
            "args": node.args,
            "params": node.params,
            "inputs": inputs.collect::<Vec<_>>(),
            "outputs": node.outputs().iter().map(|output| json!({"port": output.name, "type": output.type_name})).collect::<Vec<_>>(),
        })
    };
    json!({"name": name, "nodes": nodes.map(node).collect::<Vec<_>>()})
}
