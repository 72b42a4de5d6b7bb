//! A consumer beside the operators: reads any edges of a running graph on a thread of its own. Where the wiring gives it
//! a cell on the board, writers wait for it and it misses nothing.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::{Node, ipc};

use super::board::Board;
use super::port::{PortError, Subscriber};
use super::waiter::{Waiter, Waker};
use super::wiring::{DomainWiring, InputCounts, InputWiring};
use super::{domain, monotonic_nanos};
use crate::diagnostics::print_diagnostic;
use crate::message::{
    ContactSet, GraspFeature, GraspTruth, Header, LiftDecision, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use crate::recording::Record;

/// How long the observer waits for samples before it looks for new publishers.
const WAIT: Duration = Duration::from_millis(100);
/// The same before all publishers are there and when the graph is ending.
const WAIT_AT_ENDS: Duration = Duration::from_millis(2);

/// How long the observer waits at the end for samples that were sent and have not come: after a crash they may be lost.
const DRAIN_LIMIT: Duration = Duration::from_secs(1);
/// How many samples of a port are read in a row.
const MAX_PER_ROUND: usize = 256;

/// An edge to observe.
#[derive(Debug, Clone, PartialEq)]
pub struct ObservedEdge {
    /// What the observer calls it.
    pub topic: String,
    /// How to read it.
    pub input: InputWiring,
}

/// What an observer does with what it sees.
pub trait Sink: Send + 'static {
    /// A sample of an edge, and when it was received (CLOCK_MONOTONIC).
    ///
    /// # Errors
    /// Whatever makes it pointless to go on.
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()>;
}

/// A running observer.
pub struct Observer<S> {
    stop: Arc<AtomicBool>,
    failed: Arc<AtomicBool>,
    connected: Arc<AtomicBool>,
    waker: Waker,
    thread: JoinHandle<anyhow::Result<(S, BTreeMap<String, InputCounts>)>>,
}

/// Whether the observer can decode an edge of this type.
pub fn can_observe(type_name: &str) -> bool {
    observable(type_name).is_some()
}

impl<S: Sink> Observer<S> {
    /// Starts observing `edges`, which are given in the graph's order, sources first; returns once all ports are open.
    ///
    /// # Errors
    /// A type that nobody here knows, or iceoryx2's reason.
    pub fn start(domain: &DomainWiring, edges: Vec<ObservedEdge>, sink: S) -> anyhow::Result<Observer<S>> {
        let stop = Arc::new(AtomicBool::new(false));
        let failed = Arc::new(AtomicBool::new(false));
        let connected = Arc::new(AtomicBool::new(false));
        let (waiter, waker) = Waiter::new().context("cannot make a pair of sockets")?;
        let (ready, wait_for_ready) = channel();
        let thread = std::thread::spawn({
            let (stop, failed, connected) = (Arc::clone(&stop), Arc::clone(&failed), Arc::clone(&connected));
            let domain = domain.clone();
            move || {
                let cells: Vec<usize> = edges.iter().filter_map(|edge| edge.input.cell).collect();
                let outcome = observe(&domain, &edges, sink, &stop, &connected, &waiter, || {
                    let _ = ready.send(());
                });
                if outcome.is_err()
                    && let Ok(board) = Board::open(std::path::Path::new(&domain.board))
                {
                    // Nobody must wait for a reader that reads no more.
                    cells.into_iter().for_each(|cell| board.input(cell).give_up(true));
                }
                failed.store(outcome.is_err(), Ordering::Relaxed);
                outcome
            }
        });
        let observer = Observer { stop, failed, connected, waker, thread };
        if wait_for_ready.recv().is_err() {
            // It ended before it was ready: its error says why.
            return Err(observer.finish().err().unwrap_or_else(|| anyhow!("the observer ended before it began")));
        }
        Ok(observer)
    }

    /// Whether every port is connected to its publisher: from then on it misses nothing.
    pub fn is_connected(&self) -> bool {
        self.connected.load(Ordering::Relaxed)
    }

    /// Whether it has given up.
    pub fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    /// Takes in what is left and ends: the sink, and what came in by topic.
    ///
    /// # Errors
    /// Why it gave up.
    pub fn finish(self) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
        self.stop.store(true, Ordering::Relaxed);
        self.waker.wake();
        self.thread.join().map_err(|_| anyhow!("the observer panicked"))?
    }
}

fn observe<S: Sink>(
    domain: &DomainWiring,
    edges: &[ObservedEdge],
    mut sink: S,
    stop: &AtomicBool,
    connected: &AtomicBool,
    waiter: &Waiter,
    on_ready: impl FnOnce(),
) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
    let node = domain::join(domain, "observer")?;
    let board = Arc::new(Board::open(std::path::Path::new(&domain.board))?);
    let mut ports = Vec::new();
    for edge in edges {
        let type_name = &edge.input.service.type_name;
        let open = observable(type_name).with_context(|| format!("{}: cannot observe a {type_name}", edge.topic))?;
        ports.push((edge.topic.clone(), open(&node, &board, &edge.input)?));
    }
    on_ready();
    let mut stop_seen = None;
    loop {
        // Looked at before the last look at the ports, as in an operator.
        let last_round = stop.load(Ordering::Relaxed);
        if !connected.load(Ordering::Relaxed) {
            let mut is_connected = true;
            for (_, port) in &ports {
                is_connected &= port.connect()?;
            }
            connected.store(is_connected, Ordering::Relaxed);
        }
        let round = receive_round(&mut ports)?;
        let is_empty = round.is_empty();
        for (idx, record, received_nanos) in round {
            let header = *record.header();
            sink.take(&ports[idx].0, record, received_nanos)?;
            ports[idx].1.commit(&header);
        }
        let has_waited_long = stop_seen.is_some_and(|seen: Instant| seen.elapsed() > DRAIN_LIMIT);
        if last_round && is_empty && (has_waited_long || ports.iter().all(|(_, port)| port.is_caught_up())) {
            break;
        }
        if last_round {
            stop_seen.get_or_insert_with(Instant::now);
        }
        if !is_empty {
            continue;
        }
        let listeners: Vec<_> = ports.iter().map(|(_, port)| port.listener()).collect();
        waiter.wait(&listeners, if last_round || !connected.load(Ordering::Relaxed) { WAIT_AT_ENDS } else { WAIT });
    }
    let counts = ports.iter().map(|(topic, port)| (topic.clone(), port.counts())).collect();
    Ok((sink, counts))
}

/// What has come since the last round, upstream ports first, as `edges` are.
///
/// The ports are read downstream first: then whatever a sample is the answer to is in the same round or an earlier one,
/// and the sink sees a question before its answer. A round is bounded, so that no port starves the others.
fn receive_round(ports: &mut [(String, Box<dyn AnySubscriber>)]) -> anyhow::Result<Vec<(usize, Record, u64)>> {
    let mut by_port = Vec::with_capacity(ports.len());
    for (idx, (topic, port)) in ports.iter_mut().enumerate().rev() {
        let mut samples = Vec::new();
        while samples.len() < MAX_PER_ROUND
            && let Some(record) = port.receive()?
        {
            match record {
                Ok(record) => samples.push((idx, record, monotonic_nanos())),
                // Counted as not received by the port, and so as lost.
                Err(error) => print_diagnostic(&format!("{topic}: a sample cannot be read: {error}")),
            }
        }
        by_port.push(samples);
    }
    Ok(by_port.into_iter().rev().flatten().collect())
}

/// A subscriber whose message type is not known at compile time.
trait AnySubscriber {
    fn receive(&mut self) -> Result<Option<Result<Record, crate::message::MessageError>>, PortError>;
    fn connect(&self) -> Result<bool, PortError>;
    fn commit(&self, header: &Header);
    fn is_caught_up(&self) -> bool;
    fn listener(&self) -> &Listener<ipc::Service>;
    fn counts(&self) -> InputCounts;
}

struct Typed<M: Message> {
    subscriber: Subscriber<M>,
    n_unreadable: u64,
    wrap: fn(Stamped<M>) -> Record,
}

impl<M: Message> AnySubscriber for Typed<M> {
    fn receive(&mut self) -> Result<Option<Result<Record, crate::message::MessageError>>, PortError> {
        let Some(sample) = self.subscriber.receive()? else {
            return Ok(None);
        };
        let head = sample.user_header();
        let message = M::from_parts(head, sample.payload());
        if message.is_err() {
            self.n_unreadable += 1;
        }
        Ok(Some(message.map(|message| (self.wrap)(Stamped { header: *M::header(head), message }))))
    }

    fn connect(&self) -> Result<bool, PortError> {
        self.subscriber.connect()
    }

    fn commit(&self, header: &Header) {
        self.subscriber.commit(header);
    }

    fn is_caught_up(&self) -> bool {
        self.subscriber.is_caught_up()
    }

    fn listener(&self) -> &Listener<ipc::Service> {
        self.subscriber.listener()
    }

    fn counts(&self) -> InputCounts {
        let counts = self.subscriber.counts();
        InputCounts { n_received: counts.n_received - self.n_unreadable, ..counts }
    }
}

type Open = fn(&Node<ipc::Service>, &Arc<Board>, &InputWiring) -> Result<Box<dyn AnySubscriber>, PortError>;

fn observable(type_name: &str) -> Option<Open> {
    macro_rules! opener {
        ($message:ty, $variant:ident) => {
            (<$message>::TYPE_NAME, |node, board, input| {
                let mut subscriber = Subscriber::<$message>::open(node, Some(board), input)?;
                subscriber.take_over(None);
                Ok(Box::new(Typed { subscriber, n_unreadable: 0, wrap: Record::$variant }))
            })
        };
    }
    let openers: [(&str, Open); 6] = [
        opener!(TactileFrame, Tactile),
        opener!(ContactSet, Contacts),
        opener!(GraspFeature, Histogram),
        opener!(Prediction, Prediction),
        opener!(LiftDecision, Decision),
        opener!(GraspTruth, Truth),
    ];
    openers.into_iter().find(|(name, _)| *name == type_name).map(|(_, open)| open)
}
