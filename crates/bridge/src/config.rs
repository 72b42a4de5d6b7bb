//! What a link is told by its launcher: the parameters of its node.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use blindgrasp_operator::wiring::EdgePolicy;

/// A machine's end of all its channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkConfig {
    /// The graph's name in its file.
    pub graph: String,
    /// The running graph's name on this machine: the control socket of its launcher bears it.
    pub running_graph: String,
    /// Which of several like graphs, one for each robot; machines of other namespaces are strangers.
    pub namespace: Option<String>,
    /// This machine.
    pub machine: String,
    /// This run of this machine's part of the graph: a number that no other run has.
    pub run: u64,
    /// A hash of what the machines must have in common: nodes, where they run, the edges between them.
    pub fingerprint: u64,
    /// The other machines of the graph.
    pub peers: Vec<PeerConfig>,
    /// What this machine sends.
    pub exports: Vec<Channel>,
    /// What it receives.
    pub imports: Vec<Channel>,
    /// How the machines find each other.
    pub endpoints: Endpoints,
    /// This machine's certificate; `None` without TLS.
    pub keys: Option<KeyFiles>,
    /// Whether endpoints beyond the loopback interface may go without TLS.
    pub insecure: bool,
    /// A peer that has said nothing for longer is cut off.
    pub deadline_millis: u64,
    /// How many samples of a lossless channel are kept while the peer is cut off.
    pub buffer: usize,
}

/// Zenoh endpoints, like `tls/192.168.1.10:7447`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Endpoints {
    /// Where this machine listens.
    pub listen: Vec<String>,
    /// Which machines it connects to.
    pub connect: Vec<String>,
    /// The Zenoh routers it connects to instead.
    pub router: Vec<String>,
}

/// Another machine of the graph.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerConfig {
    /// Its name.
    pub machine: String,
    /// Whether it may see how this machine's part of the graph is: status, logs, samples.
    pub may_read: bool,
    /// Whether it may change it: set, swap, stop.
    pub may_control: bool,
}

/// An output port on its way from one machine to another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channel {
    /// `NODE/PORT`.
    pub port: String,
    /// The type of its samples.
    pub type_name: String,
    /// The machine where the node runs.
    pub from: String,
    /// The machine that it goes to.
    pub to: String,
    /// What gives way when the link cannot keep up: lossless if one of the readers there asks for it.
    pub policy: EdgePolicy,
    /// How many samples may be unanswered at the sender before they are kept in the link's own memory.
    pub capacity: usize,
    /// Whether a source on the sending machine is among those that it depends on: when that machine begins anew, so do the
    /// numbers.
    pub is_from_source: bool,
    /// Whether a source on the receiving machine is: then its samples answer such as have passed there before.
    pub is_to_source: bool,
    /// Whether it goes before bulk data: decisions and predictions.
    pub is_urgent: bool,
}

/// A machine's certificate, in PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyFiles {
    /// The certificate of the authority that signs all machines' certificates.
    pub authority: PathBuf,
    /// This machine's certificate: its common name is `MACHINE`, or `MACHINE@NAMESPACE`.
    pub certificate: PathBuf,
    /// Its private key.
    pub private_key: PathBuf,
}

impl Channel {
    /// The node that writes it.
    pub fn node(&self) -> &str {
        self.port.split('/').next().unwrap_or_default()
    }

    /// The kind of key that its samples go under.
    pub fn kind(&self) -> KeyKind {
        if self.is_urgent { KeyKind::Link } else { KeyKind::Data }
    }

    /// The port of the link's node that reads this channel on the sending machine.
    pub fn input_port(&self) -> String {
        format!("{}/{}", self.to, self.port)
    }
}

impl LinkConfig {
    /// What all keys of this graph begin with.
    pub fn key_prefix(&self) -> String {
        format!("blindgrasp/{}/{}", self.namespace.as_deref().unwrap_or("_"), self.graph)
    }

    /// The key of what one machine says to another: `PREFIX/FROM/TO/KIND`.
    pub fn key(&self, from: &str, to: &str, kind: KeyKind) -> String {
        format!("{}/{from}/{to}/{}", self.key_prefix(), kind.word())
    }

    /// The other machine of this name.
    pub fn peer(&self, machine: &str) -> Option<&PeerConfig> {
        self.peers.iter().find(|peer| peer.machine == machine)
    }
}

/// What a key carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyKind {
    /// What links say to each other, and urgent samples.
    Link,
    /// Samples.
    Data,
    /// Commands for the other machine's part of the graph, and their replies: see [`tunnel`](super::tunnel).
    Ask,
    /// A liveliness token.
    Alive,
}

impl KeyKind {
    /// All of them.
    pub const ALL: [KeyKind; 4] = [KeyKind::Link, KeyKind::Data, KeyKind::Ask, KeyKind::Alive];

    /// As it stands in keys.
    pub fn word(self) -> &'static str {
        match self {
            KeyKind::Link => "link",
            KeyKind::Data => "data",
            KeyKind::Ask => "ask",
            KeyKind::Alive => "alive",
        }
    }
}
