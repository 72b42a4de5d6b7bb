//! What passes between the launcher and an operator, so that an operator can be written in any language.
//!
//! * `PROGRAM --describe` answers with an [`OperatorDescription`](crate::description::OperatorDescription) as JSON.
//! * The launcher starts `PROGRAM` with a [`Wiring`] as JSON in the environment variable [`WIRING_VARIABLE`].
//! * The operator reports on stdout, one line each, beginning with [`REPORT_PREFIX`]: see [`Report`]. Any other line on
//!   stdout or stderr is a log line.
//! * The launcher writes [`Command`]s to its stdin, one line of JSON each. The end of stdin asks it to exit.
//! * SIGTERM asks it to take in what still lies in its inputs, say `drained`, and keep its ports open until its stdin
//!   ends. An operator that exits at SIGTERM at once is accepted too.
//!
//! An instance is **active** or **standby**. The active one answers samples and owns the node's cells on the
//! [board](crate::board); a standby waits beside it with open ports. A node that starts, comes back after a crash or
//! is swapped in does the same thing: it takes over from whoever was active before, at the place that the board says.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::link_status::LinkStatus;

/// The environment variable that holds the [`Wiring`].
pub const WIRING_VARIABLE: &str = "BLINDGRASP_WIRING";
/// What a line on an operator's stdout begins with when it is meant for the launcher.
pub const REPORT_PREFIX: &str = "@blindgrasp ";

/// Where an operator stands in a running graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Wiring {
    /// The running graph's name.
    pub graph: String,
    /// The node's id.
    pub node: String,
    /// Where the graph's shared memory is.
    pub domain: DomainWiring,
    /// Its inputs, by port.
    pub inputs: BTreeMap<String, InputWiring>,
    /// Its outputs, by port.
    pub outputs: BTreeMap<String, OutputWiring>,
    /// The node's parameters, checked, defaults filled in.
    pub params: serde_json::Map<String, serde_json::Value>,
    /// Whose time its stages go by.
    pub clock: Clock,
    /// Whether it begins as a standby, which waits for [`Command::TakeOver`].
    pub standby: bool,
    /// This instance's cell on the board: its heartbeat.
    pub instance_cell: usize,
    /// The board's region for the node's state, for an operator that has one.
    pub state_region: usize,
}

/// Whose time stages go by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// The machine's (CLOCK_MONOTONIC): a sample has an age, and silence means something.
    #[default]
    Machine,
    /// The recording's: a sample is as old as it was when it was recorded, which is not at all, and nothing follows from
    /// silence. What is answered then depends on the samples alone.
    Recording,
}

/// Where a graph's shared memory is: iceoryx2's `global.root-path` and `global.prefix`, and the board.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DomainWiring {
    /// iceoryx2's root path.
    pub root_path: String,
    /// iceoryx2's prefix.
    pub prefix: String,
    /// The [board](crate::board)'s file.
    pub board: String,
    /// The abstract unix socket that is the launcher's while it lives. An operator that can take it and the lock on
    /// `lock_file` is the last, or among the last: it removes the root path, and what bears the prefix in shared memory.
    pub lock: String,
    /// A file on which the launcher holds a lock (flock) while it lives.
    pub lock_file: String,
}

/// An input port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InputWiring {
    /// What it reads.
    pub service: ServiceWiring,
    /// Whether the writer waits for it.
    pub policy: EdgePolicy,
    /// How many samples may wait: iceoryx2's `buffer_size` of its subscriber.
    pub capacity: usize,
    /// A sample that is older on arrival is counted as late.
    pub deadline_nanos: Option<u64>,
    /// Its cell on the board; `None` for a reader that nobody counts on.
    pub cell: Option<usize>,
    /// The writer's cell on the board: whether all that was sent has come.
    pub writer_cell: usize,
}

/// An output port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputWiring {
    /// What it writes.
    pub service: ServiceWiring,
    /// Where a standby writes what it would have said, for whoever compares.
    pub shadow: ServiceWiring,
    /// Its cell on the board.
    pub cell: usize,
    /// The readers that it waits for.
    pub consumers: Vec<ConsumerWiring>,
    /// How long it waits for them before it fails.
    pub wait_limit_millis: u64,
}

/// A reader that a writer waits for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConsumerWiring {
    /// The reader's cell on the board: how far it has come.
    pub cell: usize,
    /// How many samples may be unanswered.
    pub capacity: usize,
    /// If the reader is a guest, the cells of all its readers, which are given up together: a writer waits for a guest for
    /// [`GUEST_LIMIT`](crate::port::GUEST_LIMIT) at most. Empty for the graph's own readers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub guest_cells: Vec<usize>,
}

/// One port's iceoryx2 services: a publish-subscribe and an event service of the same name. The first to come creates
/// them, so all ask for the same.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceWiring {
    /// The services' name.
    pub name: String,
    /// The message's type name.
    pub type_name: String,
    /// iceoryx2's `history_size`: as many as the most patient reader may leave unanswered.
    pub history: usize,
    /// iceoryx2's `subscriber_max_buffer_size`: the largest capacity of a reader.
    pub max_capacity: usize,
    /// iceoryx2's `subscriber_max_borrowed_samples`.
    pub max_borrowed: usize,
    /// iceoryx2's `max_publishers`, and the event service's `max_notifiers`.
    pub max_publishers: usize,
    /// iceoryx2's `max_subscribers`, and the event service's `max_listeners`.
    pub max_subscribers: usize,
    /// iceoryx2's `max_nodes` of both services.
    pub max_nodes: usize,
}

/// A line from the launcher to an operator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "command")]
pub enum Command {
    /// The whole graph is ready: sources may send.
    Go,
    /// Finish the sample at hand, answer no more, say `handed_over`, and be a standby.
    HandOver,
    /// Be the active one, from where the board says; say `took_over`.
    TakeOver {
        /// Whether the one before has handed over: what it has sent will be read. Otherwise it may have died with what it
        /// sent, and what its readers have not answered is answered again.
        is_handed_over: bool,
    },
    /// To a link: a node of this machine is drained, its outputs have ended.
    NodeEnded {
        /// The node.
        node: String,
    },
    /// To a link: leave what still comes of these ports with the machines that send it.
    TakeNoMore {
        /// As `NODE/PORT`.
        ports: Vec<String>,
    },
    /// Take these parameters instead: of those that the operator declares as live, all of them. Say `set`.
    Set {
        /// To be repeated in the answer.
        id: u64,
        /// The node's parameters.
        params: serde_json::Map<String, serde_json::Value>,
    },
}

/// A line from an operator to the launcher, after [`REPORT_PREFIX`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "report")]
pub enum Report {
    /// Its ports are open and it could answer a sample at once.
    Ready {
        /// What it must have in common with its neighbours and with whoever takes its place, like the hand's identity
        /// under `hand`.
        #[serde(default)]
        identity: BTreeMap<String, String>,
    },
    /// After [`Command::HandOver`].
    HandedOver,
    /// After [`Command::TakeOver`].
    TookOver,
    /// A standby has computed live samples; said now and then.
    Warm {
        /// How many samples.
        n_samples: u64,
    },
    /// After [`Command::Set`].
    Set {
        /// The command's.
        #[serde(default)]
        id: u64,
        /// The first sequence number that the new values apply to; `None` if it has seen no sample yet.
        from_seq: Option<u64>,
        /// Why the values were not taken; it goes on with the old ones.
        #[serde(default)]
        error: Option<String>,
    },
    /// What it counts besides its samples, since it started, under names of its own: what a source refused, say. Said when it
    /// changes, at most some times a second.
    Counts {
        /// Names in snake_case.
        counts: BTreeMap<String, u64>,
    },
    /// For the log, with a level and fields; a line without [`REPORT_PREFIX`] is a log line, too, with nothing but its text.
    Log(LogEntry),
    /// Of a link: all other machines of the graph are there and ready.
    Connected,
    /// Of a link: these ports of other machines, and no others, have ended, and all that they sent is answered here.
    Ended {
        /// As `NODE/PORT`.
        ports: Vec<String>,
    },
    /// Of a link, some times a second.
    Link(Box<LinkStatus>),
    /// A source has sent all it had to send.
    Finished,
    /// After SIGTERM: everything in the inputs was taken in and answered.
    Drained,
    /// It cannot go on; its exit follows.
    Failed {
        /// Why.
        message: String,
    },
}

/// What an operator says to people.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LogEntry {
    /// How much it matters; `None` where nobody said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<LogLevel>,
    /// What it says.
    #[serde(rename = "message")]
    pub text: String,
    /// What belongs to it, by name.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub fields: serde_json::Map<String, serde_json::Value>,
}

/// How much a log line matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogLevel {
    /// Something failed.
    Error,
    /// Something is not as it should be.
    Warn,
    /// Worth knowing.
    Info,
    /// For whoever looks for a mistake.
    Debug,
    /// Every step.
    Trace,
}

impl LogEntry {
    /// A line of nothing but text.
    pub fn plain(text: impl Into<String>) -> Self {
        LogEntry { text: text.into(), ..LogEntry::default() }
    }
}

impl fmt::Display for LogEntry {
    /// `WARN text key=value`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(level) = self.level {
            write!(f, "{} ", level.word())?;
        }
        write!(f, "{}", self.text)?;
        self.fields.iter().try_for_each(|(name, value)| write!(f, " {name}={value}"))
    }
}

impl LogLevel {
    /// All of them, what matters most first.
    pub const ALL: [LogLevel; 5] = [LogLevel::Error, LogLevel::Warn, LogLevel::Info, LogLevel::Debug, LogLevel::Trace];

    /// As it stands in a log: `WARN`.
    pub fn word(self) -> &'static str {
        match self {
            LogLevel::Error => "ERROR",
            LogLevel::Warn => "WARN",
            LogLevel::Info => "INFO",
            LogLevel::Debug => "DEBUG",
            LogLevel::Trace => "TRACE",
        }
    }
}

/// What came in through one input port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputCounts {
    /// Samples received, each once.
    pub n_received: u64,
    /// Sequence numbers that were skipped.
    pub n_missing: u64,
    /// Samples that came again: after a restart, what the one before may already have sent.
    pub n_repeated: u64,
    /// Samples that came before their turn, as they may after a swap, and were put in order.
    pub n_reordered: u64,
    /// Samples that were older than the input's deadline.
    pub n_late: u64,
}
/// What gives way when the reader of an edge is behind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EdgePolicy {
    /// The writer waits, for a bounded time.
    Lossless,
    /// The oldest samples: the newest are kept, what is dropped is counted.
    Latest,
}

impl fmt::Display for EdgePolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            EdgePolicy::Lossless => "lossless",
            EdgePolicy::Latest => "latest",
        })
    }
}
