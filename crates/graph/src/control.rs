//! How commands talk to a running graph: lines of JSON over the unix socket that bears the graph's name.
//!
//! A client sends one [`Request`] a line and reads [`Reply`]s until the last one of its request. The launcher answers
//! its own user only.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use blindgrasp_messages::{Action, Reason};
use blindgrasp_operator::ages::Ages;
use blindgrasp_operator::link_status::LinkStatus;
use blindgrasp_operator::wiring::{InputWiring, NamespaceWiring};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "request")]
pub enum Request {
    /// Asks for the graph's status. Answered with [`Reply::Status`].
    Status,
    /// Stops the graph as Ctrl-C would. Answered with [`Reply::Stopping`]; the connection ends with the graph.
    Stop,
    /// Changes a live parameter. Answered with [`Reply::Set`].
    Set { node: String, param: String, value: Value },
    /// Reads edges from now on without missing a sample. Answered with [`Reply::Attached`], and with [`Reply::Drained`]
    /// when the graph ends. The end of the connection detaches the client.
    Attach {
        /// Output ports as `NODE/PORT`; all if empty.
        ports: Vec<String>,
        /// Whether the client is a flight recorder, which takes [`Reply::Keep`].
        #[serde(default)]
        is_flight_recorder: bool,
    },
    /// Asks the flight recorders of the graph for a file. Answered with [`Reply::Asked`].
    Keep,
    /// Replaces one or several operators. Answered with [`Reply::Progress`] any number of times, [`Reply::Shadowing`]
    /// if asked for, and [`Reply::Swapped`].
    Swap(SwapRequest),
    /// Goes on with the swap after [`Reply::Shadowing`].
    Promote,
    /// Ends the replacement after [`Reply::Shadowing`]; the old operator goes on. Answered with [`Reply::Abandoned`].
    /// The end of the connection does the same.
    Abandon,
}

impl Request {
    /// Whether it changes the running graph; other requests only read.
    pub fn is_control(&self) -> bool {
        !matches!(self, Request::Status | Request::Attach { .. } | Request::Keep)
    }

    pub fn word(&self) -> &'static str {
        match self {
            Request::Status => "status",
            Request::Attach { .. } => "attach",
            Request::Keep => "keep",
            Request::Stop => "stop",
            Request::Set { .. } => "set",
            Request::Swap(_) => "swap",
            Request::Promote => "promote",
            Request::Abandon => "abandon",
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwapRequest {
    /// The nodes, all handed over at one place in the stream.
    pub nodes: Vec<String>,
    /// The program, absolute; `None` keeps the one that runs, and with several nodes each keeps its own.
    pub program: Option<PathBuf>,
    /// The program's arguments; `None` for those of the one that runs.
    pub args: Option<Vec<String>>,
    /// Parameters to change in each of the nodes that has them, live or not.
    pub set: BTreeMap<String, String>,
    /// Relative paths in `set` and `program` are relative to this folder.
    pub folder: PathBuf,
    /// The client compares for at most this long before it promotes; 0 without a comparison.
    pub shadow_limit_millis: u64,
    /// The replacement must be ready within this time.
    pub ready_limit_millis: u64,
    /// The old operator stands by for this long, and comes back if the replacement fails.
    pub probation_millis: u64,
    /// Whether a replacement of another identity (another hand, another model than its neighbours) may take over.
    pub allow_mismatch: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "reply")]
pub enum Reply {
    /// To [`Request::Status`].
    Status(Box<GraphStatus>),
    /// To [`Request::Stop`].
    Stopping,
    /// To [`Request::Set`].
    Set {
        old: Value,
        new: Value,
        /// The first sample to which the value applies; `None` if the operator has seen no sample yet.
        from_seq: Option<u64>,
    },
    /// To [`Request::Attach`]: slots are reserved. Writers wait for the reader once it has begun, see
    /// [`Subscriber::begin_here`](blindgrasp_operator::port::UntypedSubscriber::begin_here).
    Attached(Attachment),
    /// To an attached client: the graph ends, and all its samples have been sent. It waits a little until the client
    /// has read them and closes the connection.
    Drained,
    /// To a flight recorder: somebody asks for a file.
    Keep,
    /// To [`Request::Keep`].
    Asked {
        n_flight_recorders: usize,
    },
    Progress {
        message: String,
    },
    /// The replacements compute live samples beside the running operators.
    Shadowing {
        domain: NamespaceWiring,
        outputs: Vec<ShadowOutput>,
    },
    /// The swap and its probation have succeeded.
    Swapped {
        nodes: Vec<SwappedNode>,
    },
    /// To [`Request::Abandon`].
    Abandoned,
    /// The request could not be carried out; the graph goes on as before.
    Error {
        message: String,
        /// Whether a replacement had taken over and the old operator is active again.
        rolled_back: bool,
    },
}

impl Reply {
    /// The refusal of a request that has changed nothing.
    pub fn refusal(message: impl Into<String>) -> Reply {
        Reply::Error { message: message.into(), rolled_back: false }
    }
}

/// An output of a node that is shadowed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShadowOutput {
    pub node: String,
    pub port: String,
    /// The input on which the running operator's answers are read.
    pub active: InputWiring,
    /// The input on which the replacement's answers are read.
    pub shadow: InputWiring,
}

/// A client's access to the edges of a running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attachment {
    pub domain: NamespaceWiring,
    /// The edges, in the graph's order.
    pub edges: Vec<AttachedEdge>,
    /// The graph as it runs: nodes with programs, arguments, parameters and inputs.
    pub graph: Value,
    /// Whether no sample has been sent yet.
    pub is_at_start: bool,
}

/// An edge that an attached client reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AttachedEdge {
    /// `NODE/PORT`.
    pub port: String,
    /// Its topic in a recording.
    pub topic: String,
    pub input: InputWiring,
    /// The slots of the inputs that its node answers here.
    pub answered_slots: Vec<usize>,
}

/// A node that was swapped.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SwappedNode {
    pub node: String,
    pub old_pid: u32,
    pub new_pid: u32,
    /// The last sequence number that the old one answered; `None` if there was none.
    pub last_seq: Option<u64>,
    /// The time without an active operator.
    pub handover_pause_nanos: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GraphStatus {
    pub graph: String,
    pub file: PathBuf,
    pub pid: u32,
    pub state: GraphState,
    /// The trouble, if there is any.
    pub message: Option<String>,
    pub uptime_secs: f64,
    pub log_folder: PathBuf,
    #[serde(default)]
    pub iceoryx2: Iceoryx2Config,
    /// The nodes, in the graph's order.
    pub nodes: Vec<NodeStatus>,
    /// The edges, in the graph's order; the launching command reads the edges to `run`.
    pub edges: Vec<EdgeStatus>,
    pub decisions: DecisionStatus,
    /// The link to the other machines, if the graph runs on several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkStatus>,
}

/// The values of iceoryx2's configuration with which its own tools see a graph, as `global.root-path` and `global.prefix`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Iceoryx2Config {
    pub root_path: PathBuf,
    pub prefix: String,
}

/// The decisions that the launching command has read.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct DecisionStatus {
    pub n_lift: u64,
    pub n_hold: u64,
    /// The holds by reason.
    #[serde(default)]
    pub holds: BTreeMap<String, u64>,
    /// Grasps that were lifted and are known to have been unstable.
    pub n_false_positives: u64,
    /// The last decisions, the latest last.
    pub latest: VecDeque<DecidedGrasp>,
}

/// A decision that was seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DecidedGrasp {
    pub grasp_id: u64,
    pub action: Action,
    pub reason: Reason,
    /// The lowest probability among the predictions that decided.
    pub probability_stable: f64,
    /// The time from the source to the launching command; `None` if the source does not say when it published.
    pub latency_nanos: Option<u64>,
    /// The time at which it was read (CLOCK_BOOTTIME).
    pub decided_nanos: u64,
    /// Whether the grasp was stable, if the source knows.
    pub truth: Option<bool>,
}

impl DecidedGrasp {
    /// Whether it was lifted and is known to have been unstable.
    pub fn is_false_positive(&self) -> bool {
        self.action == Action::Lift && self.truth == Some(false)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GraphState {
    /// Not all operators are ready.
    Starting,
    Running,
    /// An operator was given up; grasps are not decided until it is swapped.
    Degraded,
    /// It is being drained.
    Stopping,
}

/// A node of a running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeStatus {
    pub node: String,
    pub program: PathBuf,
    /// The arguments that the program was started with.
    #[serde(default)]
    pub args: Vec<String>,
    pub state: NodeState,
    /// Its active process, if there is one.
    pub pid: Option<u32>,
    /// The process that stands by during a swap.
    pub standby_pid: Option<u32>,
    /// Restarts after a failure.
    pub n_restarts: u32,
    pub n_swaps: u32,
    /// The age of its last heartbeat; `None` if its operator has none.
    pub heartbeat_age_millis: Option<u64>,
    pub params: Map<String, Value>,
    /// Its other counts by name, over all its processes: frames that a source refused, for example.
    #[serde(default)]
    pub counts: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// Started, not ready.
    Starting,
    Running,
    /// It has ended and waits for its restart.
    Restarting,
    /// A source that has sent all it had, or an operator that is drained.
    Done,
    /// It was given up.
    Failed,
}

/// The counts of an edge. They are read while it runs and may lie a sample apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EdgeStatus {
    /// `node/port` that writes.
    pub from: String,
    /// `node/port` that reads; `run` for the launching command.
    pub to: String,
    pub policy: blindgrasp_operator::wiring::EdgePolicy,
    /// The most samples that may wait.
    pub capacity: usize,
    /// Samples sent, each counted once.
    pub sent: u64,
    /// Samples received, each counted once.
    pub received: u64,
    /// On a `latest` edge, samples that were dropped for newer ones; on a `lossless` edge, samples lost: 0 if all is
    /// well.
    pub dropped: u64,
    /// Sequence numbers missing in the samples received, including those that were missing before this edge.
    pub missing: u64,
    /// Samples that came again after a restart or rollback; each was used once.
    pub repeated: u64,
    /// Samples that came early and were put in order.
    pub reordered: u64,
    /// Samples older than the edge's deadline.
    pub late: u64,
    /// The total time that the writer has waited for this and its other readers.
    pub blocked_nanos: u64,
    /// The ages of its samples on arrival, since their source published them.
    pub ages: Ages,
}
