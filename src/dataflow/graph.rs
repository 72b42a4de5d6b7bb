//! A checked graph: what the launcher starts.

use std::path::PathBuf;

use serde::Serialize;

use super::description::{OperatorDescription, PortDescription};

/// A graph in which every program was found and every edge and param is as the operators ask.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Graph {
    /// The graph's name: letters, digits, `_` and `-`, at most 32.
    pub name: String,
    /// The dataflow file, absolute.
    pub file: PathBuf,
    /// The nodes: sources first, each after the nodes that it reads from, otherwise in the order of the file.
    pub nodes: Vec<Node>,
}

/// One instance of an operator.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Node {
    /// Its name, unique in the graph: letters, digits, `_` and `-`, at most 32.
    pub id: String,
    /// The program; absolute when the file gave a path, otherwise as the caller of `check` gave it.
    pub program: PathBuf,
    /// What the program says about itself.
    pub description: OperatorDescription,
    /// Its connected inputs, in the order of the description.
    pub inputs: Vec<Input>,
    /// Its params by name, with defaults filled in and paths absolute.
    pub params: serde_json::Map<String, serde_json::Value>,
}

/// A connected input of a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Input {
    /// The input port.
    pub port: String,
    /// The node whose output it reads.
    pub from_node: String,
    /// The output port that it reads.
    pub from_port: String,
    /// The type of the samples, the same at both ends.
    pub type_name: String,
}

/// A connection from an output to an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Edge<'a> {
    /// The node that writes.
    pub from_node: &'a str,
    /// Its output port.
    pub from_port: &'a str,
    /// The node that reads.
    pub to_node: &'a str,
    /// Its input port.
    pub to_port: &'a str,
    /// The type of the samples.
    pub type_name: &'a str,
}

impl Graph {
    /// The node of this id.
    pub fn node(&self, id: &str) -> Option<&Node> {
        self.nodes.iter().find(|node| node.id == id)
    }

    /// All connections, in the order of the nodes and inputs that read.
    pub fn edges(&self) -> impl Iterator<Item = Edge<'_>> {
        self.nodes.iter().flat_map(|node| {
            node.inputs.iter().map(|input| Edge {
                from_node: &input.from_node,
                from_port: &input.from_port,
                to_node: &node.id,
                to_port: &input.port,
                type_name: &input.type_name,
            })
        })
    }
}

impl Node {
    /// Its outputs, connected or not.
    pub fn outputs(&self) -> &[PortDescription] {
        &self.description.outputs
    }
}
