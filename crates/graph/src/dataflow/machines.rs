//! A graph on several machines, and the part of it that runs on one.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Serialize;

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
    /// The nodes that run on other machines, each with its machine.
    pub elsewhere: BTreeMap<String, String>,
}
