//! How commands talk to a running graph: lines of JSON over the abstract unix socket that bears the graph's name.
//!
//! A client sends one [`Request`] a line and reads [`Reply`]s until the last one of its request. The launcher answers
//! its own user only.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::log::LogLine;
use crate::recording_of_graph::Recording;
use blindgrasp_messages::{Action, Reason};
use blindgrasp_operator::ages::Ages;
use blindgrasp_operator::board::Key;
use blindgrasp_operator::link_status::LinkStatus;
use blindgrasp_operator::wiring::{DomainWiring, InputWiring};

/// What a client asks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "request")]
pub enum Request {
    /// How is the graph? Answered with [`Reply::Status`].
    Status,
    /// Stop it as Ctrl-C would. Answered with [`Reply::Stopping`]; the connection ends when the graph has ended.
    Stop,
    /// Change a live parameter. Answered with [`Reply::Set`].
    Set {
        /// The node.
        node: String,
        /// The parameter.
        param: String,
        /// Its new value.
        value: Value,
    },
    /// Read edges from now on without missing a sample. Answered with [`Reply::Attached`], and with [`Reply::Drained`] when
    /// the graph ends. The end of the connection gives the place up.
    Attach {
        /// Output ports as `NODE/PORT`; all if empty.
        ports: Vec<String>,
    },
    /// Replace one or several operators. Answered with [`Reply::Progress`] any number of times, [`Reply::Shadowing`]
    /// if asked for, and [`Reply::Swapped`].
    Swap(SwapRequest),
    /// After [`Reply::Shadowing`]: go on with the swap.
    Promote,
    /// After [`Reply::Shadowing`]: end the replacement, the old one goes on. Answered with [`Reply::Abandoned`]. The end of
    /// the connection says the same.
    Abandon,
    /// Read edges from now on, from another machine: the link there attaches, as with [`Request::Attach`], and sends what
    /// it reads. Answered with [`Reply::Sampling`], then any number of [`Reply::Samples`], and [`Reply::Drained`] when the
    /// graph ends. The end of the connection gives the place up.
    Samples {
        /// Output ports as `NODE/PORT`; all if empty.
        ports: Vec<String>,
    },
    /// What the operators of a graph's part on another machine have said. Answered with [`Reply::LogLines`].
    Logs {
        /// Only this operator; `run` for what the launching command itself said.
        operator: Option<String>,
        /// How many lines to begin with.
        n_lines: usize,
        /// Whether to go on with what is added, until the end of the connection.
        follow: bool,
    },
}

impl Request {
    /// Whether it changes how the graph runs: the others only look.
    pub fn is_control(&self) -> bool {
        match self {
            Request::Status | Request::Attach { .. } | Request::Samples { .. } | Request::Logs { .. } => false,
            Request::Stop | Request::Set { .. } | Request::Swap(_) | Request::Promote | Request::Abandon => true,
        }
    }

    /// Its name.
    pub fn word(&self) -> &'static str {
        match self {
            Request::Status => "status",
            Request::Attach { .. } => "attach",
            Request::Samples { .. } => "samples",
            Request::Logs { .. } => "logs",
            Request::Stop => "stop",
            Request::Set { .. } => "set",
            Request::Swap(_) => "swap",
            Request::Promote => "promote",
            Request::Abandon => "abandon",
        }
    }
}

/// What a swap is to do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwapRequest {
    /// The nodes, all handed over at one place in the stream.
    pub nodes: Vec<String>,
    /// The program, absolute; `None` for the one that runs. With several nodes each keeps its own. Asked from another machine:
    /// as in a dataflow file, the name of a program that comes with blindgrasp there, or a path there.
    pub program: Option<PathBuf>,
    /// The program's arguments; `None` for those of the one that runs.
    pub args: Option<Vec<String>>,
    /// Parameters to change in each of the nodes that has them, live or not.
    pub set: BTreeMap<String, String>,
    /// Relative paths in `set` and `program` are relative to this folder. Asked from another machine, that is the folder of
    /// the dataflow file there, whatever this says.
    pub folder: PathBuf,
    /// How long the client wants to compare before it promotes, at most; 0 if it doesn't.
    pub shadow_limit_millis: u64,
    /// How long the replacement may take until it is ready.
    pub ready_limit_millis: u64,
    /// How long the old one stands by afterwards, to come back if the replacement fails.
    pub probation_millis: u64,
    /// Whether a replacement of another identity (another hand, another model than its neighbours) may take over.
    pub allow_mismatch: bool,
}

/// What the launcher answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "reply")]
pub enum Reply {
    /// To [`Request::Status`].
    Status(GraphStatus),
    /// To [`Request::Stop`].
    Stopping,
    /// To [`Request::Set`].
    Set {
        /// What it was.
        old: Value,
        /// What it is.
        new: Value,
        /// The first sequence number that it applies to; `None` if the operator has seen no sample yet.
        from_seq: Option<u64>,
    },
    /// To [`Request::Attach`]: a place is reserved. Writers wait for it once its reader has begun, see
    /// [`Subscriber::begin_here`](blindgrasp_operator::port::Subscriber::begin_here).
    Attached(Attachment),
    /// To [`Request::Samples`]: samples follow.
    Sampling(Box<Sampling>),
    /// Some samples.
    Samples(SampleBatch),
    /// To [`Request::Logs`].
    LogLines {
        /// By time, the latest last.
        lines: Vec<LogLine>,
        /// Whether these are the last of those that there were when they were asked for.
        is_all: bool,
    },
    /// To a client that is attached: the graph ends, and all that it sent has been sent. It waits a little until the client
    /// has taken that in and closes the connection.
    Drained,
    /// Where a swap stands.
    Progress {
        /// For a person.
        message: String,
    },
    /// The replacements compute live samples beside the running operators.
    Shadowing {
        /// The graph's shared memory.
        domain: DomainWiring,
        /// What to compare.
        outputs: Vec<ShadowOutput>,
    },
    /// A swap has succeeded, its probation included.
    Swapped {
        /// What happened at each node.
        nodes: Vec<SwappedNode>,
    },
    /// To [`Request::Abandon`].
    Abandoned,
    /// The request could not be carried out; the graph goes on as before.
    Error {
        /// Why.
        message: String,
        /// Whether a replacement had taken over and the old one is active again.
        rolled_back: bool,
    },
}

/// An output of a node that is shadowed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShadowOutput {
    /// The node.
    pub node: String,
    /// The output port.
    pub port: String,
    /// Where to read what the running operator says.
    pub active: InputWiring,
    /// Where to read what the replacement would say.
    pub shadow: InputWiring,
}

/// What a client needs to read a running graph's edges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attachment {
    /// The graph's shared memory.
    pub domain: DomainWiring,
    /// The edges, in the graph's order.
    pub edges: Vec<AttachedEdge>,
    /// The graph as it runs: nodes with programs, arguments, parameters and inputs.
    pub graph: Value,
    /// Whether nothing has been sent yet.
    pub is_at_start: bool,
}

/// An edge that an attached client reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AttachedEdge {
    /// `NODE/PORT`.
    pub port: String,
    /// Its topic in a recording.
    pub topic: String,
    /// How to read it.
    pub input: InputWiring,
    /// The cells on the board of the inputs that its node answers here.
    pub answered_cells: Vec<usize>,
}

/// What a client on another machine reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sampling {
    /// The edges, in the graph's order.
    pub edges: Vec<AttachedEdge>,
    /// Edges whose samples nobody here can read, as `NODE/PORT`.
    pub unreadable: Vec<String>,
    /// The last sample of each edge that is not for the client.
    pub places: Vec<Option<Key>>,
    /// What a recording says of the graph.
    pub about: Recording,
}

/// Samples for a client on another machine, and how far the graph has come.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SampleBatch {
    /// See [`blindgrasp_bridge::tunnel::batch`].
    pub samples: String,
    /// By cell of the inputs in [`AttachedEdge::answered_cells`]: the last sample answered.
    pub answered: Vec<(usize, Option<Key>)>,
    /// By cell of the edges' writers: the last sample sent, as of after `answered`.
    pub sent: Vec<(usize, Option<Key>)>,
    /// Samples that were left out so far, because this connection was too slow for them.
    pub n_left_out: u64,
}

/// What a swap did to a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwappedNode {
    /// The node.
    pub node: String,
    /// The old process.
    pub old_pid: u32,
    /// The new process.
    pub new_pid: u32,
    /// The last sequence number that the old one answered; `None` if there was none.
    pub last_seq: Option<u64>,
    /// How long nobody was active.
    pub gap_nanos: u64,
}

/// A running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GraphStatus {
    /// Its name.
    pub graph: String,
    /// The dataflow file.
    pub file: PathBuf,
    /// The launcher's process.
    pub pid: u32,
    /// How it is.
    pub state: GraphState,
    /// What is wrong, if something is.
    pub message: Option<String>,
    /// How long it has been running.
    pub uptime_secs: f64,
    /// Where its logs are.
    pub log_folder: PathBuf,
    /// Its nodes, in the graph's order.
    pub nodes: Vec<NodeStatus>,
    /// Its edges, in the graph's order; those to `run` are what the launching command reads.
    pub edges: Vec<EdgeStatus>,
    /// What was decided.
    pub decisions: DecisionStatus,
    /// Of a graph that runs on several machines: how the link to the others is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkStatus>,
}

/// What a graph has decided, as the launching command has seen it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DecisionStatus {
    /// How many grasps were lifted.
    pub n_lift: u64,
    /// How many were held.
    pub n_hold: u64,
    /// How many of the lifted ones are known to have been unstable: false positives.
    pub n_false_positives: u64,
    /// The last decisions, the latest last.
    pub latest: VecDeque<DecidedGrasp>,
}

/// A decision that was seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DecidedGrasp {
    /// Which grasp.
    pub grasp_id: u64,
    /// What the arm should do.
    pub action: Action,
    /// Why.
    pub reason: Reason,
    /// The lowest probability among the predictions that decided.
    pub probability_stable: f64,
    /// From the source to the launching command; `None` if the source does not say when it published.
    pub latency_nanos: Option<u64>,
    /// When it was seen (CLOCK_MONOTONIC).
    pub decided_nanos: u64,
    /// Whether the grasp really was stable, where the source knows.
    pub truth: Option<bool>,
}

impl DecidedGrasp {
    /// Whether it was lifted and is known to have been unstable.
    pub fn is_false_positive(&self) -> bool {
        self.action == Action::Lift && self.truth == Some(false)
    }
}

/// How a graph is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GraphState {
    /// Not all operators are ready.
    Starting,
    /// All is well.
    Running,
    /// An operator was given up: nothing behind it is decided until somebody swaps it or stops the graph.
    Degraded,
    /// It is being drained.
    Stopping,
}

/// A node of a running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    /// Its id.
    pub node: String,
    /// The program that it runs.
    pub program: PathBuf,
    /// How it is.
    pub state: NodeState,
    /// Its active process, if there is one.
    pub pid: Option<u32>,
    /// The process that stands by during a swap.
    pub standby_pid: Option<u32>,
    /// How often it was started again after a failure.
    pub n_restarts: u32,
    /// How often it was swapped.
    pub n_swaps: u32,
    /// How long ago it last gave a sign of life; `None` if its operator gives none.
    pub heartbeat_age_millis: Option<u64>,
    /// Its parameters.
    pub params: Map<String, Value>,
    /// What else it counts, by name, in all its processes together: what a source refused, say.
    #[serde(default)]
    pub counts: BTreeMap<String, u64>,
}

/// How a node is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// Started, not ready.
    Starting,
    /// Ready.
    Running,
    /// It has ended and waits for its restart.
    Restarting,
    /// A source that has sent all it had, or an operator that is drained.
    Done,
    /// It was given up.
    Failed,
}

/// What went over an edge. Its latest counts may lie a sample apart: they are read while it runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EdgeStatus {
    /// `node/port` that writes.
    pub from: String,
    /// `node/port` that reads; `run` for the launching command.
    pub to: String,
    /// `lossless` or `latest`.
    pub policy: blindgrasp_operator::wiring::EdgePolicy,
    /// How many samples may wait.
    pub capacity: usize,
    /// Samples sent, each counted once.
    pub sent: u64,
    /// Samples received, each counted once.
    pub received: u64,
    /// On a `latest` edge, samples that were dropped for newer ones; on a `lossless` edge, samples lost: 0 if all is well.
    pub dropped: u64,
    /// Sequence numbers skipped in what was received, gaps that were there before this edge included.
    pub missing: u64,
    /// Samples that came again after a restart or rollback; each was used once.
    pub repeated: u64,
    /// Samples that came before their turn and were put in order.
    pub reordered: u64,
    /// Samples older than the edge's deadline.
    pub late: u64,
    /// How long the writer has waited for this and its other readers, in total.
    pub blocked_nanos: u64,
    /// How old its samples were on arrival, since their source published them.
    pub ages: Ages,
}
