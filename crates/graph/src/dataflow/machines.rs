//! A graph on several machines, and the part of it that runs on one.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The id of the node that carries a graph's edges to other machines.
pub const LINK: &str = "link";

/// The machines of a graph, as the file says.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Machines {
    /// In the order of the file.
    pub machines: Vec<Machine>,
    pub link: LinkSettings,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Machine {
    pub name: String,
    /// The Zenoh endpoints where it listens, like `tls/192.168.1.10:7447`. A machine without one connects to machines
    /// that listen.
    pub listen: Vec<String>,
    /// The machines that may see the status, logs and samples of its part of the graph: those that the
    /// file names, and those in `control`.
    pub read: Vec<String>,
    /// The machines that may make every change of its part of the graph; by default none.
    pub control: Vec<String>,
    /// The machines that may make one kind of change; those of `control` are not repeated.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub allows: BTreeMap<Right, Vec<String>>,
}

/// A kind of change that a machine may allow another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Right {
    /// Change live params.
    Set,
    /// Replace an operator with a shipped one, or with itself and other params.
    Swap,
    /// Replace an operator with any program.
    Run,
    Stop,
}

impl Right {
    pub const ALL: [Right; 4] = [Right::Set, Right::Swap, Right::Run, Right::Stop];

    /// The key in the dataflow file.
    pub fn key(self) -> &'static str {
        match self {
            Right::Set => "set",
            Right::Swap => "swap",
            Right::Run => "run",
            Right::Stop => "stop",
        }
    }
}

/// How the machines of a graph are linked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LinkSettings {
    /// Zenoh routers that all machines connect to, instead of to each other.
    pub router: Vec<String>,
    /// The folder of this machine's keys, absolute: `ca.pem`, `MACHINE.pem`, `MACHINE.key.pem`.
    pub keys: Option<PathBuf>,
    /// Whether endpoints may be `tcp/`, without TLS.
    pub insecure: bool,
    /// A machine that has been silent for longer is cut off.
    pub deadline_millis: u64,
    /// The most samples of a lossless edge that are kept for a machine that is cut off.
    pub buffer: usize,
}

impl Default for LinkSettings {
    fn default() -> Self {
        LinkSettings { router: Vec::new(), keys: None, insecure: false, deadline_millis: 150, buffer: 8192 }
    }
}

/// The properties of one machine's part of a graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LocalView {
    pub machine: String,
    /// Output ports of other machines that are read here, as `NODE/PORT`, and whether a source on another machine is
    /// among those that they depend on: then this machine's part goes on until they end.
    pub imports: Vec<(String, bool)>,
}
