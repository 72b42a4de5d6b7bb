//! The protocol between the launcher and an operator, so that an operator can be written in any language.
//!
//! * `PROGRAM --describe` answers with an [`OperatorDescription`] as JSON.
//! * The launcher starts `PROGRAM` with a [`Wiring`] as JSON in the environment variable [`WIRING_VARIABLE`].
//! * The operator writes [`Report`]s, one line of JSON each, to a pipe of their own. The environment variable
//!   [`REPORTS_VARIABLE`] holds the number of its descriptor. The operator sees to it that its children don't inherit it.
//! * All lines on stdout and stderr are log lines.
//! * The launcher writes [`Command`]s to its stdin, one line of JSON each. The end of stdin asks it to exit.
//! * SIGTERM asks it to answer the samples that still lie in its inputs, report `drained`, and keep its ports open until
//!   its stdin ends. An operator that exits at SIGTERM at once is accepted too.
//!
//! An instance is **active** or **standby**. The active one answers samples and owns the node's slots on the
//! [cursors](crate::cursors); a standby waits beside it with open ports. An instance that starts, comes back after a crash or
//! is swapped in does the same thing: it takes over from the instance before, at the sample that the cursors name.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::cursors::SampleId;
use crate::description::OperatorDescription;
use crate::link_status::LinkStatus;

/// The environment variable that holds the [`Wiring`].
pub const WIRING_VARIABLE: &str = "BLINDGRASP_WIRING";
/// The environment variable that holds the number of the descriptor for [`Report`]s.
pub const REPORTS_VARIABLE: &str = "BLINDGRASP_REPORTS";

/// All that an operator must know of the graph that it runs in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Wiring {
    pub graph: String,
    pub node: String,
    pub domain: NamespaceWiring,
    /// By port.
    pub inputs: BTreeMap<String, InputWiring>,
    /// By port.
    pub outputs: BTreeMap<String, OutputWiring>,
    /// The node's parameters, checked, defaults filled in.
    pub params: serde_json::Map<String, serde_json::Value>,
    pub clock: Clock,
    /// Whether it begins as a standby, which waits for [`Command::TakeOver`].
    pub standby: bool,
    /// The slot of this instance's heartbeat and bell among the cursors.
    pub instance_slot: usize,
    /// The slot of the bell that wakes this instance: its own, or that of the first operator of its process.
    pub bell_slot: usize,
    #[serde(default)]
    pub wait: WaitMode,
    /// Whether its memory stays in RAM.
    #[serde(default)]
    pub lock_memory: bool,
    /// The cursors' region for the node's state, for an operator that has one.
    pub state_region: usize,
    /// The nodes before it rely on its answering each sample under the same number: whether it has a state may change with a
    /// swap.
    #[serde(default)]
    pub answers_each: bool,
    /// Samples that have killed earlier instances again and again: they are not answered.
    #[serde(default)]
    pub skip: Vec<SampleId>,
    /// The sample on which the last instance died, or the first of several on which it worked at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub suspect: Option<SampleId>,
    /// Whether the process restricts what it may do.
    #[serde(default)]
    pub sandbox: Sandbox,
    /// Of a process that is the [host](crate::host) of another program: the description of that program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hosted: Option<OperatorDescription>,
}

/// The wirings of a process with several operators, upstream ones first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupWiring {
    pub members: Vec<GroupMemberWiring>,
}

/// An operator of a group.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupMemberWiring {
    /// The arguments that name it.
    pub args: Vec<String>,
    pub wiring: Wiring,
}

/// A command or a report with the node that it is for or from, in a process with several.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Addressed<T> {
    /// No command or report has a field of this name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub member: Option<String>,
    #[serde(flatten)]
    pub message: T,
}

/// The behaviour of a process without work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WaitMode {
    /// It sleeps until it is woken.
    #[default]
    Event,
    /// It looks for samples again and again, and takes a core.
    Poll,
    /// It looks for samples for so many microseconds, and then sleeps.
    #[serde(rename = "poll_us")]
    PollMicros(u64),
}

/// Whether a process restricts what it may do once it is ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sandbox {
    #[default]
    Off,
    /// As far as its program and the kernel can.
    On,
    /// In full, or it does not run.
    Required,
}

/// How much of a process's sandbox the kernel enforces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Enforcement {
    #[default]
    None,
    /// The kernel is too old for a part of it.
    Partial,
    Full,
}

impl fmt::Display for WaitMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WaitMode::Event => f.write_str("event"),
            WaitMode::Poll => f.write_str("poll"),
            WaitMode::PollMicros(micros) => write!(f, "poll {micros} µs"),
        }
    }
}

impl fmt::Display for Sandbox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Sandbox::Off => "off",
            Sandbox::On => "on",
            Sandbox::Required => "required",
        })
    }
}

/// The clock by which stages measure the age of samples and silence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// The machine's (CLOCK_BOOTTIME): a sample has an age, and silence means something.
    #[default]
    Machine,
    /// The recording's: every sample counts as new, and silence has no meaning. The answers then depend on the samples
    /// alone.
    Recording,
}

/// Where a graph's memory is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NamespaceWiring {
    /// A folder of shared memory that belongs to the graph's user alone. The launcher holds a lock (flock) on it while it lives.
    /// An operator that can take the lock is the last, or among the last: it removes the folder.
    pub folder: PathBuf,
}

impl NamespaceWiring {
    /// The folder of iceoryx2's files (its `global.root-path`), in which all operators write.
    pub fn ports(&self) -> PathBuf {
        self.folder.join("ports")
    }

    /// The [cursors](crate::cursors)'s file.
    pub fn cursors(&self) -> PathBuf {
        self.folder.join("cursors")
    }

    /// The folder of a link. No sandbox can make a file in it, so a process without a sandbox may trust its names.
    pub fn link(&self) -> PathBuf {
        self.folder.join("link")
    }
}

/// An input port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InputWiring {
    pub service: ServiceWiring,
    /// Whether the writer waits for it.
    pub policy: EdgePolicy,
    /// How many samples may wait: iceoryx2's `buffer_size` of its subscriber.
    pub capacity: usize,
    /// A sample that is older on arrival is counted as late.
    pub deadline_nanos: Option<u64>,
    #[serde(default)]
    pub on_late: OnLate,
    /// Of a [partner input](crate::partner): the greatest distance of two stamps that belong together.
    #[serde(default)]
    pub tolerance_nanos: u64,
    /// Of a partner input: a main sample that is older is answered without its partner.
    #[serde(default)]
    pub partner_wait_nanos: u64,
    /// Its slot on the cursors; `None` for a reader that no writer waits for.
    pub slot: Option<usize>,
    /// The writer's slot on the cursors, which names the last sample that was sent.
    pub writer_slot: usize,
}

/// An output port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputWiring {
    pub service: ServiceWiring,
    /// A standby writes its answers here, for comparison.
    pub shadow: ServiceWiring,
    /// Its slot on the cursors.
    pub slot: usize,
    /// The readers that the writer waits for.
    pub consumers: Vec<ConsumerWiring>,
    /// The slots of the bells by which the writer wakes its readers.
    #[serde(default)]
    pub bells: Vec<usize>,
    /// The writer fails after it has waited for so long.
    pub wait_limit_millis: u64,
}

/// A reader that a writer waits for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConsumerWiring {
    /// The reader's slot on the cursors, which names the last sample that it has answered.
    pub slot: usize,
    /// How many samples may be unanswered.
    pub capacity: usize,
    /// Of a reader that may be given up: the slots of all its readers, which are given up together, after
    /// `attached_limit_millis`. Empty for the graph's own readers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub attached_slots: Vec<usize>,
    #[serde(default)]
    pub attached_limit_millis: u64,
    /// The readers of the answers of a reader that answers each sample under the same number.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub behind: Vec<ReaderWiring>,
}

/// A reader further down a chain of nodes that answer each sample under the same number. If several of these nodes die at
/// once, only the writer before them has the samples that this reader has not answered: it keeps them in its history.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReaderWiring {
    /// The reader's slot on the cursors.
    pub slot: usize,
    /// The slot of the output that it reads.
    pub writer_slot: usize,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub behind: Vec<ReaderWiring>,
}

/// One port's iceoryx2 service. The first process to come creates it, so all ask for the same.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceWiring {
    pub name: String,
    pub type_name: String,
    /// iceoryx2's `history_size`: as many as the most patient reader may leave unanswered.
    pub history: usize,
    /// iceoryx2's `subscriber_max_buffer_size`: the largest capacity of a reader.
    pub max_capacity: usize,
    /// iceoryx2's `subscriber_max_borrowed_samples`.
    pub max_borrowed: usize,
    /// iceoryx2's `max_publishers`.
    pub max_publishers: usize,
    /// iceoryx2's `max_subscribers`.
    pub max_subscribers: usize,
    /// iceoryx2's `max_nodes`.
    pub max_nodes: usize,
}

/// iceoryx2's `subscriber_max_borrowed_samples`: the sample at hand, one that was not answered, and one more. Samples that wait
/// for their turn are copied.
pub const MAX_BORROWED: usize = 3;

/// A line from the launcher to an operator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "command")]
pub enum Command {
    /// The whole graph is ready: sources may send.
    Go,
    /// Finish the sample at hand, answer no more, report `handed_over`, and be a standby.
    HandOver,
    /// Be the active instance, from the sample on that the cursors name; report `took_over`.
    TakeOver {
        /// Whether the instance before has handed over, so that all its samples will be read. Otherwise its samples may
        /// have died with it, and those that its readers have not answered are sent again.
        is_handed_over: bool,
    },
    /// To an operator of a group, as SIGTERM to one that is alone: answer the samples that have come, and report `drained`.
    Drain,
    /// To an operator of a group, as the end of stdin to one that is alone: nothing more is needed of it.
    Quit,
    /// To a link: a node of this machine is drained, its outputs have ended.
    NodeEnded { node: String },
    /// To a link: receive no more samples of these ports; the machines that send them keep them.
    TakeNoMore {
        /// As `NODE/PORT`.
        ports: Vec<String>,
    },
    /// Take these values of all parameters that the operator declares as live. Report `set`.
    Set {
        /// The answer repeats it.
        id: u64,
        params: serde_json::Map<String, serde_json::Value>,
    },
}

/// A line from an operator to the launcher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "report")]
pub enum Report {
    /// Its ports are open and it could answer a sample at once.
    Ready {
        /// Its neighbours and an instance that takes its place must have the same identities, such as that of the hand
        /// under `hand`.
        #[serde(default)]
        identity: BTreeMap<String, String>,
        /// Its answers depend on earlier samples. It may take the place of an operator that
        /// [answers each](crate::description::OperatorDescription::answers_each) sample only if it does so as well.
        #[serde(default)]
        has_state: bool,
        /// How far it is restricted, where the wiring asks for a sandbox.
        #[serde(default)]
        sandbox: Enforcement,
    },
    /// After [`Command::HandOver`].
    HandedOver {
        /// Whether the samples that it and those before it have sent, and that are not answered, can all be received.
        has_sent_all: bool,
    },
    /// After [`Command::TakeOver`].
    TookOver,
    /// A standby has computed live samples; reported now and then.
    Warm { n_samples: u64 },
    /// After [`Command::Set`].
    Set {
        /// The id of the command.
        #[serde(default)]
        id: u64,
        /// The first sequence number that the new values apply to; `None` if it has seen no sample yet.
        from_seq: Option<u64>,
        /// Why the operator keeps the old values.
        #[serde(default)]
        error: Option<String>,
    },
    /// Counts of its own since it started, besides those of its samples, such as frames that a source refused. Reported when
    /// they change, at most some times a second.
    Counts {
        /// Names in snake_case.
        counts: BTreeMap<String, u64>,
        /// They are a part of the node's state, so they are those of all its instances together.
        #[serde(default)]
        in_all: bool,
    },
    /// A line for the log, with a level and fields. A line on stdout or stderr is a log line without them.
    Log(LogEntry),
    /// Of a link: all other machines of the graph are there and ready.
    Connected,
    /// Of a link: these ports of other machines, and no others, have ended, and all their samples are answered here.
    Ended {
        /// As `NODE/PORT`.
        ports: Vec<String>,
    },
    /// Of a link, some times a second.
    Link(Box<LinkStatus>),
    /// A source has sent all it had to send.
    Finished,
    /// After SIGTERM: all samples in the inputs are answered.
    Drained,
    /// The operator cannot go on and exits.
    Failed { message: String },
    /// The graph must end, for this reason.
    Unfit { message: String },
}

/// A line that an operator logs for people.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LogEntry {
    /// `None` where the operator gave no level.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub level: Option<LogLevel>,
    #[serde(rename = "message")]
    pub text: String,
    /// Values that belong to the line, by name.
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
    /// Helps to find a mistake.
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
    /// All levels, the most severe first.
    pub const ALL: [LogLevel; 5] = [LogLevel::Error, LogLevel::Warn, LogLevel::Info, LogLevel::Debug, LogLevel::Trace];

    /// The level as a log shows it: `WARN`.
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

/// The samples that came in through one input port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct InputCounts {
    /// Samples received, each once.
    pub n_received: u64,
    /// Sequence numbers that were skipped.
    pub n_missing: u64,
    /// Samples that came again, as they may after a restart of their writer.
    pub n_repeated: u64,
    /// Samples that came early, as they may after a swap, and were put in order.
    pub n_reordered: u64,
    /// Samples that were older than the input's deadline.
    pub n_late: u64,
}
/// Who gives way when the reader of an edge is behind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EdgePolicy {
    /// The writer waits, for a bounded time.
    #[default]
    Lossless,
    /// The oldest samples are dropped and counted; the newest are kept.
    Latest,
}

/// The consequence of a late sample, besides its count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnLate {
    #[default]
    Count,
    /// It and the answers to it have expired: the arbiter holds.
    Hold,
    /// As [`OnLate::Hold`], and the graph ends with an error.
    Stop,
}

impl fmt::Display for OnLate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            OnLate::Count => "count",
            OnLate::Hold => "hold",
            OnLate::Stop => "stop",
        })
    }
}

impl fmt::Display for EdgePolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            EdgePolicy::Lossless => "lossless",
            EdgePolicy::Latest => "latest",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The node that a message is for must not be taken for a field of the message.
    #[test]
    fn commands_and_reports_with_an_address_are_read_back() {
        let params = serde_json::Map::from_iter([("node".to_owned(), 1.into())]);
        let commands = [
            Command::Go,
            Command::NodeEnded { node: "encoder".into() },
            Command::TakeOver { is_handed_over: true },
            Command::Set { id: 3, params },
        ];
        let reports = [
            Report::Ready { identity: BTreeMap::new(), has_state: true, sandbox: Enforcement::Full },
            Report::Ended { ports: vec!["a/b".into()] },
            Report::Log(LogEntry {
                fields: [("member".to_owned(), 2.into())].into_iter().collect(),
                ..LogEntry::plain("x")
            }),
            Report::Unfit { message: "late".into() },
        ];
        fn read_back<T: Serialize + serde::de::DeserializeOwned + PartialEq + fmt::Debug>(message: T) {
            let json = serde_json::to_string(&message).expect("JSON");
            let alone: Addressed<T> = serde_json::from_str(&json).expect("without an address");
            assert_eq!((alone.member, &alone.message), (None, &message));
            let addressed = Addressed { member: Some("contacts".to_owned()), message };
            let json = serde_json::to_string(&addressed).expect("JSON");
            assert_eq!(serde_json::from_str::<Addressed<T>>(&json).expect("with an address"), addressed);
        }
        commands.into_iter().for_each(read_back);
        reports.into_iter().for_each(read_back);
    }
}
