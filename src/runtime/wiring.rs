//! What passes between the launcher and an operator, so that an operator can be written in any language.
//!
//! * `PROGRAM --describe` answers with an [`OperatorDescription`](crate::dataflow::OperatorDescription) as JSON.
//! * The launcher starts `PROGRAM` with a [`Wiring`] as JSON in the environment variable [`WIRING_VARIABLE`].
//! * The operator reports on stdout, one line each, beginning with [`REPORT_PREFIX`]: see [`Report`]. Any other line on
//!   stdout or stderr is a log line.
//! * The launcher writes the line [`GO`] to its stdin once the whole graph is ready: a source sends nothing before.
//! * SIGTERM asks it to take in what still lies in its inputs, say `drained`, and keep its ports open; the end of its
//!   stdin asks it to exit. An operator that exits at SIGTERM at once is accepted too.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The environment variable that holds the [`Wiring`].
pub const WIRING_VARIABLE: &str = "BLINDGRASP_WIRING";
/// What a line on an operator's stdout begins with when it is meant for the launcher.
pub const REPORT_PREFIX: &str = "@blindgrasp ";

/// The line on an operator's stdin that starts the sources.
pub const GO: &str = "go";

/// Where an operator stands in a running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Wiring {
    /// The running graph's name.
    pub graph: String,
    /// The node's id.
    pub node: String,
    /// Where the graph's shared memory is.
    pub domain: DomainWiring,
    /// The service of each input port.
    pub inputs: BTreeMap<String, ServiceWiring>,
    /// The service of each output port.
    pub outputs: BTreeMap<String, ServiceWiring>,
    /// The node's parameters, checked, defaults filled in.
    pub params: serde_json::Map<String, serde_json::Value>,
    /// How long to wait for the other ends of its ports before giving up.
    pub startup_limit_millis: u64,
}

/// Where a graph's shared memory is: iceoryx2's `global.root-path` and `global.prefix`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DomainWiring {
    /// iceoryx2's root path.
    pub root_path: String,
    /// iceoryx2's prefix.
    pub prefix: String,
}

/// One port's iceoryx2 services: a publish-subscribe and an event service of the same name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceWiring {
    /// The services' name.
    pub name: String,
    /// The message's type name.
    pub type_name: String,
    /// How many subscribers it has once the graph is complete: what a publisher waits for before it is ready.
    pub n_consumers: usize,
    /// How many samples each subscriber holds before the publisher has to wait: iceoryx2's
    /// `subscriber_max_buffer_size`, and each subscriber's `buffer_size`.
    pub capacity: usize,
    /// iceoryx2's `max_publishers`, and `max_notifiers` of the event service. Whoever comes first creates a service, so
    /// all must ask for the same. Beside what is said here: no safe overflow, no history.
    pub max_publishers: usize,
    /// iceoryx2's `max_subscribers`, and `max_listeners` of the event service.
    pub max_subscribers: usize,
    /// iceoryx2's `subscriber_max_borrowed_samples`.
    pub max_borrowed: usize,
    /// iceoryx2's `max_nodes` of both services.
    pub max_nodes: usize,
    /// How long the publisher waits for a full subscriber before it fails.
    pub wait_limit_millis: u64,
}

/// A line from an operator to the launcher, after [`REPORT_PREFIX`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "report")]
pub enum Report {
    /// All ports are open and connected: every input to its publisher, every output to all its consumers.
    Ready,
    /// A source has sent all it had to send.
    Finished {
        /// What went through its ports.
        counts: PortCounts,
    },
    /// After SIGTERM: everything in the inputs was taken in and answered.
    Drained {
        /// What went through its ports.
        counts: PortCounts,
    },
    /// It cannot go on; its exit follows.
    Failed {
        /// Why.
        message: String,
    },
}

/// What went through an operator's ports since it started.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PortCounts {
    /// By input port.
    pub received: BTreeMap<String, InputCounts>,
    /// By output port.
    pub sent: BTreeMap<String, u64>,
}

/// What came in through one input port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputCounts {
    /// Samples received.
    pub n_received: u64,
    /// Sequence numbers that were skipped.
    pub n_missing: u64,
    /// Samples that came twice or out of order.
    pub n_repeated: u64,
}
