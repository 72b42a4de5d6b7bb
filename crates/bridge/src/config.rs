//! The configuration of a link: the parameters that the launcher gives to its node.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::certificates::REVOKED_FILE;
use blindgrasp_graph::dataflow::Right;
use blindgrasp_operator::wiring::EdgePolicy;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkConfig {
    /// The graph's name in its file.
    pub graph: String,
    /// The running graph's name on this machine, as in the name of its launcher's control socket.
    pub running_graph: String,
    /// The name that tells this graph from others with the same file, one for each robot. Machines of other namespaces
    /// are not connected.
    pub namespace: Option<String>,
    /// The name of this machine.
    pub machine: String,
    /// A number for this run of this machine's part of the graph; no other run has it.
    pub run: u64,
    /// A hash of the parts of the file that all machines must have in common: nodes, their machines and their inputs.
    pub fingerprint: u64,
    /// The other machines of the graph.
    pub peers: Vec<PeerConfig>,
    /// The channels that this machine sends.
    pub exports: Vec<Channel>,
    /// The channels that this machine receives.
    pub imports: Vec<Channel>,
    pub endpoints: Endpoints,
    /// The files of this machine's certificate; `None` if it has no keys. With them, the link proves who it is and encrypts
    /// what it sends, with TLS or without.
    pub keys: Option<KeyFiles>,
    /// Whether endpoints may be `tcp/`, without TLS.
    pub insecure: bool,
    /// A peer that is silent for longer is cut off.
    pub deadline_millis: u64,
    /// Maximum number of samples of a lossless channel that are kept while the peer is cut off.
    pub buffer: usize,
}

/// Zenoh endpoints, like `tls/192.168.1.10:7447`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Endpoints {
    /// The endpoints at which this machine listens.
    pub listen: Vec<String>,
    /// The endpoints of other machines to which this machine connects.
    pub connect: Vec<String>,
    /// The endpoints of Zenoh routers to which this machine connects instead.
    pub router: Vec<String>,
}

/// Another machine of the graph.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerConfig {
    pub machine: String,
    /// Whether it may read the status, the logs and the samples of this machine's part of the graph.
    pub may_read: bool,
    /// Whether it may make every change of this machine's part of the graph.
    pub may_control: bool,
    /// The changes that it may make besides.
    #[serde(default)]
    pub may: Vec<Right>,
}

impl PeerConfig {
    /// Whether it has a right to a change; `None` is the right to read.
    pub fn may(&self, right: Option<Right>) -> bool {
        match right {
            None => self.may_read,
            // Any program: the shipped ones as well.
            Some(Right::Swap) if self.may.contains(&Right::Run) => true,
            Some(right) => self.may_control || self.may.contains(&right),
        }
    }
}

/// An output port whose samples go from one machine to another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channel {
    /// `NODE/PORT`.
    pub port: String,
    pub type_name: String,
    /// The machine that runs the writer.
    pub from: String,
    /// The machine that runs the readers.
    pub to: String,
    /// What gives way when the link cannot keep up. It is lossless if one of the readers is.
    pub policy: EdgePolicy,
    /// Maximum number of unanswered samples at the writer before the link keeps them in its own memory.
    pub capacity: usize,
    /// Whether the writer depends on a source on its own machine. When that machine starts again, so do the sequence
    /// numbers.
    pub is_from_source: bool,
    /// Whether the writer depends on a source on the receiving machine. Then its samples answer samples of that source.
    pub is_to_source: bool,
    /// Whether its samples have priority over others: decisions and predictions.
    pub is_urgent: bool,
}

/// The files of a machine's certificate, in PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyFiles {
    /// The certificate of the authority that signs the certificates of all machines.
    pub authority: PathBuf,
    /// The machine's certificate. Its common name is `MACHINE` or `MACHINE@NAMESPACE`.
    pub certificate: PathBuf,
    pub private_key: PathBuf,
}

impl KeyFiles {
    /// The file that lists revoked certificates; it need not exist.
    pub fn revoked(&self) -> PathBuf {
        self.authority.with_file_name(REVOKED_FILE)
    }
}

impl Channel {
    /// The node that writes the samples.
    pub fn node(&self) -> &str {
        self.port.split('/').next().unwrap_or_default()
    }

    /// The kind of key under which its samples are sent.
    pub fn kind(&self) -> KeyKind {
        if self.is_urgent { KeyKind::Link } else { KeyKind::Data }
    }

    /// The port of the link's node that reads this channel on the sending machine.
    pub fn input_port(&self) -> String {
        format!("{}/{}", self.to, self.port)
    }
}

impl LinkConfig {
    /// The first part of all keys of this graph.
    pub fn key_prefix(&self) -> String {
        format!("blindgrasp/{}/{}", self.namespace.as_deref().unwrap_or("_"), self.graph)
    }

    /// The key of the messages from one machine to another: `PREFIX/FROM/TO/KIND`.
    pub fn key(&self, from: &str, to: &str, kind: KeyKind) -> String {
        format!("{}/{from}/{to}/{}", self.key_prefix(), kind.word())
    }

    pub fn peer(&self, machine: &str) -> Option<&PeerConfig> {
        self.peers.iter().find(|peer| peer.machine == machine)
    }
}

/// The kind of messages under a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyKind {
    /// Messages between links, and urgent samples.
    Link,
    Data,
    /// Commands for the other machine's part of the graph, and their replies: see [`tunnel`](super::tunnel).
    Ask,
    /// A liveliness token.
    Alive,
}

impl KeyKind {
    pub const ALL: [KeyKind; 4] = [KeyKind::Link, KeyKind::Data, KeyKind::Ask, KeyKind::Alive];

    /// The last part of the key.
    pub fn word(self) -> &'static str {
        match self {
            KeyKind::Link => "link",
            KeyKind::Data => "data",
            KeyKind::Ask => "ask",
            KeyKind::Alive => "alive",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_right_to_one_change_is_none_to_another_and_control_is_all() {
        let peer = |may_control: bool, may: &[Right]| PeerConfig {
            machine: "robot".into(),
            may_read: false,
            may_control,
            may: may.to_vec(),
        };
        let changes =
            |peer: PeerConfig| Right::ALL.into_iter().filter(|right| peer.may(Some(*right))).collect::<Vec<_>>();
        assert_eq!(changes(peer(false, &[])), []);
        assert_eq!(changes(peer(false, &[Right::Set])), [Right::Set]);
        assert_eq!(changes(peer(false, &[Right::Swap, Right::Stop])), [Right::Swap, Right::Stop]);
        assert_eq!(changes(peer(false, &[Right::Run])), [Right::Swap, Right::Run]);
        assert_eq!(changes(peer(true, &[])), Right::ALL);
        assert!(!peer(true, &Right::ALL).may(None));
    }
}
