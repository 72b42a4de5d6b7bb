//! Publishes samples of a graph to programs outside of it, as JSON on keys of Zenoh.
//!
//! The inputs must be `latest`: the network never holds up the graph.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::bail;
use blindgrasp_bridge::outside::KeyPublisher;
use blindgrasp_graph::link::network::NetworkError;
use blindgrasp_messages::{Header, Message, Stamped};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::port::Subscriber;
use blindgrasp_operator::source::{self, Source, Step};
use zenoh::Session;

/// The pause between two attempts to reach the router.
const RETRY_NANOS: u64 = 1_000_000_000;

/// Publishes the samples of all edges until the graph ends.
pub(super) fn publish(operator: &Operator, outside: Outside, edges: Vec<Box<dyn Forward>>) -> anyhow::Result<()> {
    let publishing = Publishing {
        operator,
        outside,
        edges,
        epochs: RandomState::new(),
        session: None,
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

pub(super) type Encode<M> = Box<dyn Fn(&Stamped<M>, &mut Vec<u8>) -> Result<(), String>>;

fn unix_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}

/// An input and its key.
pub(super) trait Forward {
    fn open(&mut self, session: &Session, prefix: &str) -> Result<(), NetworkError>;
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
    /// There is no session, or the sample cannot be read or written.
    Unpublished,
}

struct Edge<M: Message> {
    name: &'static str,
    subscriber: Subscriber<M>,
    is_kept: bool,
    encode: Encode<M>,
    publisher: Option<KeyPublisher>,
}

/// The input `name`, whose samples go to the key `PREFIX/name`, if it is connected. Others than `is_kept` ones are dropped where
/// the network has no room.
pub(super) fn edge<M: Message>(
    operator: &Operator,
    name: &'static str,
    is_kept: bool,
    encode: Encode<M>,
) -> anyhow::Result<Option<Box<dyn Forward>>> {
    let Some(subscriber) = operator.optional_subscriber::<M>(name)? else { return Ok(None) };
    Ok(Some(Box::new(Edge { name, subscriber, is_kept, encode, publisher: None })))
}

impl<M: Message> Forward for Edge<M> {
    fn open(&mut self, session: &Session, prefix: &str) -> Result<(), NetworkError> {
        self.publisher = Some(KeyPublisher::new(session, &format!("{prefix}/{}", self.name), self.is_kept)?);
        Ok(())
    }

    fn close(&mut self) {
        self.publisher = None;
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
        let Some(publisher) = &self.publisher else { return Ok(Forwarded::Unpublished) };
        // Others can read the keys, and a user of this machine who forges samples needs the epoch.
        let told = Header { epoch: epochs.hash_one(header.epoch), ..header };
        if let Err(error) = (self.encode)(&Stamped { header: told, message }, data) {
            print_diagnostic(&format!("sample {} is not published: {error}", header.seq));
            return Ok(Forwarded::Unpublished);
        }
        publisher.publish(data, header.seq, unix_nanos())?;
        Ok(Forwarded::Published)
    }
}

/// How the graph becomes known to other programs.
pub(super) struct Outside {
    /// Opens a session.
    pub(super) open: Box<dyn Fn() -> Result<Session, NetworkError>>,
    /// Before the names of keys.
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
    session: Option<Session>,
    retry_nanos: u64,
    said: Option<String>,
    n_published: u64,
    n_unpublished: u64,
    reported: (u64, u64),
}

impl Publishing<'_> {
    fn open(&mut self) -> Result<(), NetworkError> {
        let session = (self.outside.open)()?;
        for edge in &mut self.edges {
            edge.open(&session, &self.outside.prefix)?;
        }
        self.session = Some(session);
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
        if self.session.is_some() || monotonic_nanos() < self.retry_nanos {
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
        self.session = None;
        self.report_counts();
    }
}
