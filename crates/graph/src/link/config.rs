//! The configuration of a link: the parameters that the launcher gives to its node.

use std::path::{Path, PathBuf};

use blindgrasp_operator::wiring::EdgePolicy;
use serde::{Deserialize, Serialize};

/// The file of the authority's certificate. It holds several while an authority is replaced.
pub const AUTHORITY_FILE: &str = "ca.pem";
/// The file beside it that lists revoked certificates; there may be none. It holds one list for each authority.
pub const REVOKED_FILE: &str = "crl.pem";
/// The common name in the certificate of a Zenoh router. No machine can have this name.
pub const ROUTER_COMMON_NAME: &str = "@router";

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkConfig {
    /// The graph's name in its file.
    pub graph: String,
    /// The name that tells this graph from others with the same file, one for each robot. Machines of other namespaces
    /// are not connected.
    pub namespace: Option<String>,
    /// The name of this machine.
    pub machine: String,
    /// A number for this run of this machine's part of the graph; no other run has it.
    pub run: u64,
    /// A hash of the parts of the file that all machines must have in common: nodes, their machines and their inputs.
    pub fingerprint: u64,
    /// The names of the other machines of the graph.
    pub peers: Vec<String>,
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

/// The files of a machine's keys in a folder.
pub fn key_files(folder: &Path, machine: &str) -> KeyFiles {
    KeyFiles {
        authority: folder.join(AUTHORITY_FILE),
        certificate: folder.join(format!("{machine}.pem")),
        private_key: folder.join(format!("{machine}.key.pem")),
    }
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
}

/// The kind of messages under a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyKind {
    /// Messages between links, and urgent samples.
    Link,
    Data,
    /// A liveliness token.
    Alive,
}

impl KeyKind {
    pub const ALL: [KeyKind; 3] = [KeyKind::Link, KeyKind::Data, KeyKind::Alive];

    /// The last part of the key.
    pub fn word(self) -> &'static str {
        match self {
            KeyKind::Link => "link",
            KeyKind::Data => "data",
            KeyKind::Alive => "alive",
        }
    }
}
