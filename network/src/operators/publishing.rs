//! Publishes samples of a graph to programs outside of it, as topics of a ROS 2 node or as JSON on keys of Zenoh.
//!
//! The inputs must be `latest`: the network never holds up the graph.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::bail;
use blindgrasp_messages::{Header, Message, Stamped};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::Subscriber;
use blindgrasp_operator::source::{self, Source, Step};
use blindgrasp_ros::network::RosError;
use blindgrasp_ros_node::node::{KeyPublisher, MessageType, Quality, RosNode, RosPublisher, Session, topic_name};

/// The pause between two attempts to reach the router.
const RETRY_NANOS: u64 = 1_000_000_000;

/// Publishes the samples of all edges until the graph ends.
pub(super) fn publish(operator: &Operator, outside: Outside, edges: Vec<Box<dyn Forward>>) -> anyhow::Result<()> {
    let publishing = Publishing {
        operator,
        outside,
        edges,
        epochs: RandomState::new(),
        node: None,
        retry_nanos: 0,
        said: None,
        n_published: 0,
        n_unpublished: 0,
        reported: (0, 0),
    };
    source::run(operator, BTreeMap::new(), publishing)
}

/// Refuses a node without inputs, and inputs that hold up the graph while the network does not take their samples.
pub(super) fn check_inputs<'a>(inputs: impl IntoIterator<Item = (&'a str, bool)>) -> anyhow::Result<()> {
    let mut has_any = false;
    for (port, is_lossless) in inputs {
        if is_lossless {
            bail!(
                "input '{port}' is lossless, and the network must not hold up the graph: write \
                 {port}: {{from: NODE/PORT, policy: latest, capacity: 256}}"
            );
        }
        has_any = true;
    }
    if !has_any {
        bail!("it has no input: connect one of decision, tactile, contacts, feature and prediction");
    }
    Ok(())
}

/// A topic that the samples of an edge make.
pub(super) struct Topic<M> {
    pub(super) name: &'static str,
    /// The type in ROS 2; `None` for JSON.
    pub(super) message: Option<MessageType>,
    pub(super) quality: Quality,
    pub(super) encode: Encode<M>,
    /// Samples that come sooner after the last one make no message.
    pub(super) interval_nanos: u64,
}

pub(super) type Encode<M> = Box<dyn Fn(&Stamped<M>, &mut Vec<u8>) -> Result<(), String>>;

pub(super) fn unix_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}

/// An input and its topics.
pub(super) trait Forward {
    fn open(&mut self, node: &mut Node, namespace: &str) -> Result<(), RosError>;
    fn close(&mut self);
    fn connect(&mut self) -> anyhow::Result<()>;
    /// Publishes the next sample, if there is a session, with a hash of its epoch.
    fn forward(&mut self, epochs: &RandomState, data: &mut Vec<u8>) -> anyhow::Result<Forwarded>;
}

/// The outcome of an attempt to publish a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Forwarded {
    NoSample,
    Published,
    /// There is no session, or the sample cannot be read, or it makes no message of a topic.
    Unpublished,
}

struct Edge<M: Message> {
    subscriber: Subscriber<M>,
    topics: Vec<Topic<M>>,
    publishers: Vec<Publisher>,
    /// One for each topic.
    states: Vec<TopicState>,
}

#[derive(Clone, Default)]
struct TopicState {
    /// The time of the last sample that made a message.
    sent_nanos: Option<u64>,
    /// The last reason in the log why a sample makes no message.
    said: Option<String>,
}

/// The graph as other programs see it.
pub(super) enum Node {
    /// Topics of a node, in CDR.
    Ros(RosNode),
    /// Keys, with JSON.
    Json(Session),
}

enum Publisher {
    Ros(RosPublisher),
    Json(KeyPublisher),
}

pub(super) fn edge<M: Message>(
    operator: &Operator,
    port: &str,
    topics: Vec<Topic<M>>,
) -> anyhow::Result<Option<Box<dyn Forward>>> {
    let subscriber = operator.optional_subscriber::<M>(port)?;
    Ok(subscriber.map(|subscriber| {
        let states = vec![TopicState::default(); topics.len()];
        Box::new(Edge { subscriber, topics, publishers: Vec::new(), states }) as Box<dyn Forward>
    }))
}

impl<M: Message> Forward for Edge<M> {
    fn open(&mut self, node: &mut Node, namespace: &str) -> Result<(), RosError> {
        let mut publishers = Vec::with_capacity(self.topics.len());
        for topic in &self.topics {
            publishers.push(match (&mut *node, &topic.message) {
                (Node::Ros(node), Some(message)) => {
                    Publisher::Ros(node.publisher(&topic_name(namespace, topic.name)?, message, topic.quality)?)
                }
                (Node::Ros(_), None) => return Err(RosError::Topic(topic.name.into())),
                (Node::Json(session), _) => {
                    let key = format!("{namespace}/{}", topic.name);
                    Publisher::Json(KeyPublisher::new(session, &key, topic.quality)?)
                }
            });
        }
        self.publishers = publishers;
        Ok(())
    }

    fn close(&mut self) {
        self.publishers.clear();
    }

    fn connect(&mut self) -> anyhow::Result<()> {
        self.subscriber.connect()?;
        Ok(())
    }

    fn forward(&mut self, epochs: &RandomState, data: &mut Vec<u8>) -> anyhow::Result<Forwarded> {
        let Some(sample) = self.subscriber.receive()? else { return Ok(Forwarded::NoSample) };
        let header = *M::header(sample.head());
        let message = M::from_parts(sample.head(), sample.items());
        self.subscriber.commit(&header);
        let message = match message {
            Ok(message) => message,
            Err(error) => {
                print_diagnostic(&format!("sample {} is not published: {error}", header.seq));
                return Ok(Forwarded::Unpublished);
            }
        };
        if self.publishers.is_empty() {
            return Ok(Forwarded::Unpublished);
        }
        // Others can read the topics, and a user of this machine who forges samples needs the epoch.
        let told = Header { epoch: epochs.hash_one(header.epoch), ..header };
        let stamped = Stamped { header: told, message };
        let mut outcome = Forwarded::Published;
        for ((topic, publisher), state) in self.topics.iter().zip(&mut self.publishers).zip(&mut self.states) {
            if let Some(sent_nanos) = state.sent_nanos
                && header.stamp_nanos.wrapping_sub(sent_nanos) < topic.interval_nanos
            {
                continue;
            }
            state.sent_nanos = Some(header.stamp_nanos);
            if let Err(error) = (topic.encode)(&stamped, data) {
                outcome = Forwarded::Unpublished;
                if state.said.as_ref() != Some(&error) {
                    print_diagnostic(&format!("sample {} is not published as {}: {error}", header.seq, topic.name));
                    state.said = Some(error);
                }
                continue;
            }
            match publisher {
                Publisher::Ros(publisher) => publisher.publish(data)?,
                Publisher::Json(publisher) => publisher.publish(data, header.seq, unix_nanos())?,
            }
        }
        Ok(outcome)
    }
}

/// How the graph becomes known to other programs.
pub(super) struct Outside {
    /// Opens a session.
    pub(super) open: Box<dyn Fn() -> Result<Node, RosError>>,
    /// Before the names of topics or keys.
    pub(super) prefix: String,
    /// A line for the log, once a session is open.
    pub(super) opened: String,
}

struct Publishing<'a> {
    operator: &'a Operator,
    outside: Outside,
    edges: Vec<Box<dyn Forward>>,
    /// The key of the hashes that stand for the graph's epochs.
    epochs: RandomState,
    node: Option<Node>,
    retry_nanos: u64,
    said: Option<String>,
    n_published: u64,
    n_unpublished: u64,
    reported: (u64, u64),
}

impl Publishing<'_> {
    fn open(&mut self) -> Result<(), RosError> {
        let mut node = (self.outside.open)()?;
        for edge in &mut self.edges {
            edge.open(&mut node, &self.outside.prefix)?;
        }
        self.node = Some(node);
        Ok(())
    }

    /// Publishes a sample of each edge; false if there was none.
    fn forward(&mut self) -> anyhow::Result<bool> {
        let mut data = Vec::new();
        let mut has_any = false;
        for edge in &mut self.edges {
            match edge.forward(&self.epochs, &mut data)? {
                Forwarded::NoSample => continue,
                Forwarded::Published => self.n_published += 1,
                Forwarded::Unpublished => self.n_unpublished += 1,
            }
            has_any = true;
        }
        Ok(has_any)
    }

    fn report_counts(&mut self) {
        let counts = (self.n_published, self.n_unpublished);
        if std::mem::replace(&mut self.reported, counts) != counts {
            let counts = [("published", counts.0), ("unpublished", counts.1)];
            self.operator.has_counted(counts.map(|(name, count)| (name.to_owned(), count)).into());
        }
    }

    /// Opens the session, or tries again after a pause. Samples that come meanwhile are counted and not published.
    fn reach(&mut self) {
        if self.node.is_some() || monotonic_nanos() < self.retry_nanos {
            return;
        }
        match self.open() {
            Ok(()) => print_diagnostic(&self.outside.opened),
            Err(error) => {
                self.edges.iter_mut().for_each(|edge| edge.close());
                self.retry_nanos = monotonic_nanos() + RETRY_NANOS;
                let error = error.to_string();
                if self.said.as_ref() != Some(&error) {
                    print_diagnostic(&format!("{error}; nothing is published until it answers"));
                    self.said = Some(error);
                }
            }
        }
        self.operator.beat();
    }
}

impl Source for Publishing<'_> {
    fn step(&mut self) -> anyhow::Result<Step> {
        self.reach();
        Ok(if self.forward()? { Step::Next } else { Step::Wait(None) })
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.report_counts();
        self.edges.iter_mut().try_for_each(|edge| edge.connect())
    }

    /// Publishes the samples that are there, and ends the session.
    fn close(&mut self) {
        loop {
            match self.forward() {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => {
                    print_diagnostic(&format!("the last samples are not published: {error:#}"));
                    break;
                }
            }
        }
        self.edges.iter_mut().for_each(|edge| edge.close());
        self.node = None;
        self.report_counts();
    }
}
