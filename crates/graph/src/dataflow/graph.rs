//! A checked graph: what the launcher starts.

use crate::dataflow::pins::Pins;
use crate::dataflow::program::Program;
use blindgrasp_operator::wiring::{EdgePolicy, OnLate, Sandbox};
use std::fmt;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::dataflow::machines::{LocalView, Machines};
use crate::dataflow::process_options::ProcessOptions;
use blindgrasp_operator::description::{OperatorDescription, PortDescription};

/// A graph with every program found, and every edge and param checked against its operator.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Graph {
    /// The graph's name: letters, digits, `_` and `-`, at most 32.
    pub name: String,
    /// The dataflow file, absolute.
    pub file: PathBuf,
    /// The nodes, sources first: each after the nodes that it reads from, except for feedback, otherwise in the order of
    /// the file.
    pub nodes: Vec<Node>,
    /// The machines that it runs on, if the file names any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub machines: Option<Machines>,
    /// Of one machine's part of a graph.
    #[serde(skip)]
    pub local: Option<LocalView>,
    /// The program that has the ports of nodes in other languages, if there is one.
    #[serde(skip)]
    pub host: Option<Program>,
}

/// One instance of an operator.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Node {
    /// Its name, unique in the graph: letters, digits, `_` and `-`, at most 32.
    pub id: String,
    /// The program, absolute if the file gave a path, otherwise as the caller of `check` gave it.
    pub program: PathBuf,
    /// The program's arguments, before those that blindgrasp adds.
    pub args: Vec<String>,
    pub description: OperatorDescription,
    /// Its connected inputs, in the order of the description.
    pub inputs: Vec<Input>,
    /// Its params by name, with defaults filled in and paths absolute.
    pub params: serde_json::Map<String, serde_json::Value>,
    pub restart: Restart,
    /// Without a heartbeat for this long it is killed; `None` if it is not watched.
    pub heartbeat_millis: Option<u64>,
    /// Whether its processes restrict what they may do.
    pub sandbox: Sandbox,
    /// Its processes may take so much memory, besides shared memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_max_mib: Option<u64>,
    /// The options of its processes.
    #[serde(flatten)]
    pub process: ProcessOptions,
    /// The digests that its files may have.
    #[serde(skip_serializing_if = "Pins::is_empty")]
    pub sha256: Pins,
    /// Its machine, if the file names machines.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
}

/// The restarts of a node whose process ends without a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Restart {
    pub policy: RestartPolicy,
    /// The most restarts within the window, at least 1; after one more failure the node is given up.
    pub limit: u32,
    /// The window in which restarts are counted.
    pub within_millis: u64,
    /// The pause before the second restart in a row; it doubles with each further one. The first comes at once.
    pub backoff_millis: u64,
}

/// When a node is started again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RestartPolicy {
    /// Never: its end is the end of the graph.
    Never,
    /// When it was killed, failed or hung.
    OnFailure,
    /// Also when it ended by itself with exit code 0.
    Always,
}

impl fmt::Display for RestartPolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            RestartPolicy::Never => "never",
            RestartPolicy::OnFailure => "on-failure",
            RestartPolicy::Always => "always",
        })
    }
}

impl Default for Restart {
    fn default() -> Self {
        Restart { policy: RestartPolicy::OnFailure, limit: 5, within_millis: 60_000, backoff_millis: 10 }
    }
}

/// The heartbeat limit of a node without one in the file.
pub const DEFAULT_HEARTBEAT_MILLIS: u64 = 2000;

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EdgeOptions {
    /// When the reader is behind, the writer waits, or samples are dropped.
    pub policy: EdgePolicy,
    /// The most samples that may wait for the reader.
    pub capacity: usize,
    /// A sample whose age on arrival, since its source published it, is longer is counted as late.
    pub deadline_millis: Option<f64>,
    /// The consequence of a late sample.
    pub on_late: OnLate,
    /// Of a partner input: the greatest distance of two stamps that belong together.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tolerance_millis: Option<f64>,
    /// Of a partner input: a main sample that is older is answered without its partner.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub partner_wait_millis: Option<f64>,
}

/// The tolerance of a partner input without one in the file.
pub const DEFAULT_TOLERANCE_MILLIS: f64 = 5.0;
/// The wait of a partner input without one in the file: well below the 100 ms after which a live hand's frames are late.
pub const DEFAULT_PARTNER_WAIT_MILLIS: f64 = 20.0;

impl Default for EdgeOptions {
    fn default() -> Self {
        EdgeOptions {
            policy: EdgePolicy::Lossless,
            capacity: 256,
            deadline_millis: None,
            on_late: OnLate::Count,
            tolerance_millis: None,
            partner_wait_millis: None,
        }
    }
}

/// A connected input of a node.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Input {
    pub port: String,
    /// The node whose output it reads.
    pub from_node: String,
    /// The output port that it reads.
    pub from_port: String,
    /// The type of the samples, the same at both ends.
    pub type_name: String,
    pub edge: EdgeOptions,
    /// Whether it may come from the node's own outputs. Feedback does not affect the order of the nodes.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub feedback: bool,
    /// Whether its samples are found by the stamps of those of the node's first input.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partner: bool,
}

/// A connection from an output to an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Edge<'a> {
    pub from_node: &'a str,
    pub from_port: &'a str,
    pub to_node: &'a str,
    pub to_port: &'a str,
    /// The type of the samples.
    pub type_name: &'a str,
}

impl Graph {
    /// A digest of the nodes: their arguments, inputs and params but for those named `left_out`, with the content of files in
    /// place of their paths.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn content_id(&self, left_out: Option<&str>) -> std::io::Result<u64> {
        let mut hasher = DefaultHasher::new();
        for node in &self.nodes {
            (&node.id, &node.args, format!("{:?}", node.inputs)).hash(&mut hasher);
            for (param, value) in node.params.iter().filter(|(param, _)| Some(param.as_str()) != left_out) {
                let file = value.as_str().filter(|path| Path::new(path).is_file());
                let content = file.map_or_else(|| Ok(value.to_string().into_bytes()), std::fs::read)?;
                (param, content).hash(&mut hasher);
            }
        }
        Ok(hasher.finish())
    }

    /// The node of this id.
    pub fn node(&self, id: &str) -> Option<&Node> {
        self.nodes.iter().find(|node| node.id == id)
    }

    /// The first node of this node's process.
    pub fn leader<'a>(&'a self, node: &'a Node) -> &'a Node {
        let mut others = self.nodes.iter();
        let first = others.find(|other| other.process.group.is_some() && other.process.group == node.process.group);
        first.unwrap_or(node)
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
    /// Its output ports, each with the node in the names of its samples. The [`LINK`](crate::dataflow::LINK) has the
    /// ports of other machines' nodes.
    pub fn output_ports(&self) -> impl Iterator<Item = ((String, String), &PortDescription)> {
        self.outputs().iter().map(|output| {
            let (node, port) = output.name.split_once('/').unwrap_or((&self.id, &output.name));
            ((node.to_owned(), port.to_owned()), output)
        })
    }

    /// Whether it is a source: it reads nothing, or only feedback.
    pub fn is_source(&self) -> bool {
        !self.is_link() && self.inputs.iter().all(|input| input.feedback)
    }

    /// Whether it is the link to other machines.
    pub fn is_link(&self) -> bool {
        self.id == crate::dataflow::LINK && self.machine.is_some()
    }

    /// Its outputs, connected or not.
    pub fn outputs(&self) -> &[PortDescription] {
        &self.description.outputs
    }
}
