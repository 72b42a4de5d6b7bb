//! A reader beside the operators: it reads any edges of a running graph on a thread of its own. Where the wiring gives
//! it cursor slots, writers wait for it and it misses nothing.
//!
//! Prompt edges wake it. It polls the others every few milliseconds, more often the more samples come: writers spend no
//! time on waking it, and the operators keep their cores.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::mpsc::channel;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use iceoryx2::prelude::Node;

use blindgrasp_messages::Record;
use blindgrasp_messages::{
    ContactSet, GraspFeature, Header, MESSAGE_TYPES, Message, Prediction, Recorded, Stamped, TactileFrame, WithMessage,
    with_message,
};
use blindgrasp_operator::cursors::{SampleId, SharedCursors};
use blindgrasp_operator::diagnostics::{print_diagnostic, with_lack_of_files};
use blindgrasp_operator::port::{PortError, Subscriber};
use blindgrasp_operator::private_service::PrivateService;
use blindgrasp_operator::waiter::{Waiter, Waker};
use blindgrasp_operator::wiring::{InputCounts, InputWiring, NamespaceWiring, WaitMode};
use blindgrasp_operator::{monotonic_nanos, namespace};

/// The observer waits this long for samples that wake it before it looks for new publishers.
const WAIT: Duration = Duration::from_millis(100);
/// The wait before all publishers are there, and when the observer is ending.
const WAIT_AT_ENDS: Duration = Duration::from_millis(2);
/// The shortest and the longest pause between two polls.
const LOOK_PAUSES: [Duration; 2] = [Duration::from_micros(500), Duration::from_millis(10)];
/// Polls are so frequent that 1/8 of an edge's capacity comes in between, which leaves room for late polls.
const SHARE_PER_LOOK: usize = 8;

/// At the end, the observer waits this long for samples that were sent and have not come: after a crash they may be
/// lost.
const DRAIN_LIMIT: Duration = Duration::from_secs(1);
/// An observer that leaves waits this long for the last samples that its sink wants.
const LEAVE_LIMIT: Duration = Duration::from_secs(2);
/// Writers wait again at once for an observer that was given up, if it had kept up for this long.
const KEPT_UP: Duration = Duration::from_secs(30);
/// Otherwise after this time, which doubles each time, up to the longest one.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// The most samples of a port that are read in a row.
const MAX_PER_ROUND: usize = 64;

#[derive(Debug, Clone, PartialEq)]
pub struct ObservedEdge {
    pub topic: String,
    pub input: InputWiring,
    /// Its samples wake the observer; others are read within milliseconds.
    pub is_prompt: bool,
}

/// Receives what an observer reads.
pub trait Sink: Send + 'static {
    /// A sample of an edge, and the time of its receipt (CLOCK_BOOTTIME).
    ///
    /// # Errors
    /// An error ends the observer.
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()>;

    /// An attached observer has begun: the last earlier sample of each edge, in the order of the edges.
    fn begin(&mut self, _places: &[Option<SampleId>]) {}

    /// So many samples of an edge were sent since the observer has begun, and have not come: a whole epoch leaves no gap in the
    /// numbers.
    fn lacks(&mut self, _topic: &str, _n_lost: u64) {}

    /// The observer is about to leave a graph that goes on.
    fn leave(&mut self) {}

    /// Whether it needs no more samples after [`Sink::leave`].
    fn has_enough(&mut self) -> bool {
        true
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// A part of the graph from its start, or a reader for which no writer waits.
    Member,
    Attached,
}

/// The requests to an observer, as numbers in an atomic.
const GO_ON: u8 = 0;
const DRAIN: u8 = 1;
const LEAVE: u8 = 2;

pub struct Observer<S> {
    request: Arc<AtomicU8>,
    failed: Arc<AtomicBool>,
    connected: Arc<AtomicBool>,
    waker: Waker,
    thread: JoinHandle<anyhow::Result<(S, BTreeMap<String, InputCounts>)>>,
}

/// Whether the observer can decode an edge of this type.
pub fn can_observe(type_name: &str) -> bool {
    MESSAGE_TYPES.contains(&type_name)
}

/// Whether samples of this type carry the number of the source's sample that they answer.
pub fn bears_source_number(type_name: &str) -> bool {
    [TactileFrame::TYPE_NAME, ContactSet::TYPE_NAME, GraspFeature::TYPE_NAME, Prediction::TYPE_NAME]
        .contains(&type_name)
}

impl<S: Sink> Observer<S> {
    /// Starts observing `edges`, which are given in the graph's order, sources first; returns once all ports are open. Samples
    /// of prompt edges wake it by the bell of this slot.
    ///
    /// # Errors
    /// A type of an edge is unknown, or iceoryx2 fails.
    pub fn start(
        domain: &NamespaceWiring,
        bell: usize,
        edges: Vec<ObservedEdge>,
        sink: S,
    ) -> anyhow::Result<Observer<S>> {
        Self::start_as(Role::Member, domain, Some(bell), edges, sink)
    }

    /// Attaches to a running graph, returns once it has begun. It misses nothing
    /// from then on.
    ///
    /// # Errors
    /// See [`Observer::start`].
    pub fn start_attached(domain: &NamespaceWiring, edges: Vec<ObservedEdge>, sink: S) -> anyhow::Result<Observer<S>> {
        Self::start_as(Role::Attached, domain, None, edges, sink)
    }

    fn start_as(
        role: Role,
        domain: &NamespaceWiring,
        bell: Option<usize>,
        edges: Vec<ObservedEdge>,
        sink: S,
    ) -> anyhow::Result<Observer<S>> {
        let request = Arc::new(AtomicU8::new(GO_ON));
        let failed = Arc::new(AtomicBool::new(false));
        let connected = Arc::new(AtomicBool::new(false));
        let cursors = Arc::new(SharedCursors::open(&domain.cursors())?);
        let waiter = match bell {
            Some(slot) => Waiter::of_slot(&cursors, slot, WaitMode::Event),
            None => Waiter::of_process(),
        };
        let waiter = waiter.context("cannot make an event")?;
        let waker = waiter.waker();
        let (ready, wait_for_ready) = channel();
        let thread = std::thread::spawn({
            let (request, failed, connected) = (Arc::clone(&request), Arc::clone(&failed), Arc::clone(&connected));
            let domain = domain.clone();
            move || {
                let slots: Vec<usize> = edges.iter().filter_map(|edge| edge.input.slot).collect();
                // Also if the sink panics.
                let mut seat = Seat { cursors: Arc::clone(&cursors), slots, failed, is_left: true };
                let watch = Watch { role, request: &request, connected: &connected, waiter: &waiter };
                let outcome = observe(&domain, &cursors, &edges, sink, &watch, || {
                    let _ = ready.send(());
                });
                seat.is_left = outcome.is_err() || role == Role::Attached;
                seat.failed.store(outcome.is_err(), Ordering::Relaxed);
                drop(seat);
                if role == Role::Attached {
                    namespace::clear_orphaned(&domain);
                }
                outcome
            }
        });
        let observer = Observer { request, failed, connected, waker, thread };
        if wait_for_ready.recv().is_err() {
            // It ended before it was ready: its error says why.
            return Err(observer.finish().err().unwrap_or_else(|| anyhow!("the observer ended before it began")));
        }
        Ok(observer)
    }

    /// Whether every port is connected to its publisher; the observer misses nothing from then on.
    pub fn is_connected(&self) -> bool {
        self.connected.load(Ordering::Relaxed)
    }

    pub fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    /// Reads the rest of a graph that has ended. Returns the sink, and the counts by topic.
    ///
    /// # Errors
    /// The observer has failed.
    pub fn finish(self) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
        self.end(DRAIN)
    }

    /// Leaves a graph that goes on, once the sink has enough or after 2 s.
    ///
    /// # Errors
    /// The observer has failed.
    pub fn leave(self) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
        self.end(LEAVE)
    }

    fn end(self, request: u8) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
        self.request.store(request, Ordering::Relaxed);
        self.waker.wake();
        self.thread.join().map_err(|_| anyhow!("the observer panicked"))?
    }
}

/// An observer's slots. No writer may wait for a reader that has ended, however it has ended.
struct Seat {
    cursors: Arc<SharedCursors>,
    slots: Vec<usize>,
    failed: Arc<AtomicBool>,
    is_left: bool,
}

impl Drop for Seat {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.failed.store(true, Ordering::Relaxed);
        }
        if self.is_left {
            for slot in &self.slots {
                self.cursors.input(*slot).give_up(true);
            }
        }
    }
}

/// The thread's end of an observer.
struct Watch<'a> {
    role: Role,
    request: &'a AtomicU8,
    connected: &'a AtomicBool,
    waiter: &'a Waiter,
}

fn observe<S: Sink>(
    domain: &NamespaceWiring,
    cursors: &Arc<SharedCursors>,
    edges: &[ObservedEdge],
    mut sink: S,
    watch: &Watch<'_>,
    on_ready: impl FnOnce(),
) -> anyhow::Result<(S, BTreeMap<String, InputCounts>)> {
    let node = namespace::join(domain, "observer").map_err(|error| with_lack_of_files(error.into()))?;
    let mut ports = open(&node, cursors, edges)?;
    if watch.role == Role::Attached {
        sink.begin(&begin(&mut ports)?);
    }
    on_ready();
    let (mut pace, mut comeback) = (Pace::of(edges), Comeback::default());
    let (mut ending, mut last_look) = (None::<Instant>, Instant::now());
    loop {
        // Looked at before the last look at the ports, as in an operator.
        let request = watch.request.load(Ordering::Relaxed);
        if request != GO_ON && ending.is_none() {
            ending = Some(Instant::now());
            if request == LEAVE {
                sink.leave();
            }
        }
        let is_connected = watch.connected.load(Ordering::Relaxed);
        if !is_connected || last_look.elapsed() >= WAIT {
            last_look = Instant::now();
            let are_all = connect(&mut ports)?;
            watch.connected.store(is_connected || are_all, Ordering::Relaxed);
        }
        let round = match receive_round(&mut ports) {
            Ok(round) => round,
            // After the launcher was killed, its shared memory may be gone.
            Err(error) if request == DRAIN && watch.role == Role::Attached => {
                print_diagnostic(&format!("blindgrasp: {error:#}"));
                break;
            }
            Err(error) => return Err(error),
        };
        let n_most = hand_on(round, &ports, &mut sink)?;
        comeback.look(&ports);
        let waited = ending.map_or(Duration::ZERO, |since| since.elapsed());
        let is_over = match request {
            LEAVE => sink.has_enough() || waited > LEAVE_LIMIT,
            DRAIN => n_most == 0 && (waited > DRAIN_LIMIT || ports.iter().all(|(_, port)| port.is_caught_up())),
            _ => false,
        };
        if is_over {
            break;
        }
        if n_most == MAX_PER_ROUND {
            continue;
        }
        let is_at_ends = request != GO_ON || !watch.connected.load(Ordering::Relaxed);
        watch.waiter.wait(pace.next(n_most).min(if is_at_ends { WAIT_AT_ENDS } else { Duration::MAX }));
    }
    let counts = ports.iter().map(|(topic, port)| (topic.clone(), port.counts())).collect();
    Ok((sink, counts))
}

/// Opens a port for each edge.
fn open(node: &Node<PrivateService>, cursors: &Arc<SharedCursors>, edges: &[ObservedEdge]) -> anyhow::Result<Ports> {
    let mut ports = Vec::new();
    for edge in edges {
        let type_name = &edge.input.service.type_name;
        let opened = with_message(type_name, Opener(node, cursors, edge))
            .with_context(|| format!("{}: cannot observe a {type_name}", edge.topic))?;
        ports.push((edge.topic.clone(), opened.map_err(|error| with_lack_of_files(error.into()))?));
    }
    Ok(ports)
}

/// Connects all ports to the publishers that are there; whether all are.
fn connect(ports: &mut Ports) -> anyhow::Result<bool> {
    let mut are_all = true;
    for (_, port) in ports {
        are_all &= port.connect()?;
    }
    Ok(are_all)
}

/// Hands the samples of a round to the sink, and then tells their writers; the most samples of a port.
fn hand_on(round: Round, ports: &Ports, sink: &mut impl Sink) -> anyhow::Result<usize> {
    for (idx, record, received_nanos) in round.records {
        sink.take(&ports[idx].0, record, received_nanos)?;
    }
    for ((topic, port), header) in ports.iter().zip(round.furthest) {
        if let Some(header) = header {
            port.commit(&header);
        }
        let n_lost = port.n_lost();
        if n_lost > 0 {
            sink.lacks(topic, n_lost);
        }
    }
    Ok(round.n_most)
}

/// When writers that have given up the observer are to wait for it again. The more often that happens, the longer they are
/// left alone: an observer that cannot keep up must not slow the graph down again and again.
#[derive(Default)]
struct Comeback {
    pause: Duration,
    at: Option<Instant>,
    last: Option<Instant>,
}

impl Comeback {
    fn look(&mut self, ports: &Ports) {
        if !ports.iter().any(|(_, port)| port.is_given_up()) {
            return;
        }
        let now = Instant::now();
        let at = *self.at.get_or_insert_with(|| {
            let has_kept_up = self.last.is_none_or(|last| now.duration_since(last) > KEPT_UP);
            self.pause = if has_kept_up { Duration::ZERO } else { (2 * self.pause).clamp(FIRST_PAUSE, LONGEST_PAUSE) };
            now + self.pause
        });
        if now >= at {
            for (_, port) in ports {
                port.give_up(false);
            }
            (self.at, self.last) = (None, Some(now));
        }
    }
}

/// Begins to read on all ports of an attached observer.
fn begin(ports: &mut Ports) -> anyhow::Result<Vec<Option<SampleId>>> {
    // Before this, the newest sample is dropped from a full queue, not the oldest.
    connect(ports)?;
    Ok(ports.iter_mut().map(|(_, port)| port.begin_here()).collect())
}

/// The pace of the polls.
struct Pace {
    /// `None` if all edges wake it.
    share: Option<usize>,
    pause: Duration,
}

impl Pace {
    fn of(edges: &[ObservedEdge]) -> Pace {
        let capacities = edges.iter().filter(|edge| !edge.is_prompt).map(|edge| edge.input.capacity);
        Pace { share: capacities.min().map(|capacity| (capacity / SHARE_PER_LOOK).max(1)), pause: LOOK_PAUSES[0] }
    }

    /// The pause after a poll that found so many samples on the busiest edge.
    fn next(&mut self, n_found: usize) -> Duration {
        let Some(share) = self.share else {
            return if n_found > 0 { Duration::ZERO } else { WAIT };
        };
        let [least, most] = LOOK_PAUSES;
        let fitting = self.pause.mul_f64(share as f64 / n_found.max(1) as f64);
        self.pause = fitting.min(self.pause * 2).clamp(least, most);
        self.pause
    }
}

/// The samples of all ports since the last round.
struct Round {
    /// The port, the sample, and when it was received; upstream ports first, as the edges are.
    records: Vec<(usize, Record, u64)>,
    /// The furthest sample of each port.
    furthest: Vec<Option<Header>>,
    /// The most samples of a port.
    n_most: usize,
}

/// Reads all ports, downstream ports first: the sample that another one answers is then in the same round or an earlier
/// one, and the sink gets it first. A round is bounded, so that no port starves the others.
fn receive_round(ports: &mut Ports) -> anyhow::Result<Round> {
    let mut by_port = Vec::with_capacity(ports.len());
    let mut round = Round { records: Vec::new(), furthest: vec![None; ports.len()], n_most: 0 };
    for (idx, (topic, port)) in ports.iter_mut().enumerate().rev() {
        let mut samples = Vec::new();
        let mut furthest: Option<Header> = None;
        while samples.len() < MAX_PER_ROUND
            && let Some(record) = port.receive()?
        {
            match record {
                Ok(record) => {
                    let header = *record.header();
                    if furthest.is_none_or(|last| last.epoch != header.epoch || last.seq < header.seq) {
                        furthest = Some(header);
                    }
                    samples.push((idx, record, monotonic_nanos()));
                }
                // The port counts it as not received, and so as lost.
                Err(error) => print_diagnostic(&format!("{topic}: a sample cannot be read: {error}")),
            }
        }
        round.n_most = round.n_most.max(samples.len());
        round.furthest[idx] = furthest;
        by_port.push(samples);
    }
    round.records = by_port.into_iter().rev().flatten().collect();
    Ok(round)
}

/// The topics of the edges and their ports.
type Ports = Vec<(String, Box<dyn AnySubscriber>)>;

/// A subscriber whose message type is not known at compile time.
trait AnySubscriber {
    fn receive(&mut self) -> Result<Option<Result<Record, blindgrasp_messages::MessageError>>, PortError>;
    fn connect(&mut self) -> Result<bool, PortError>;
    fn begin_here(&mut self) -> Option<SampleId>;
    fn commit(&self, header: &Header);
    fn give_up(&self, is_given_up: bool);
    fn is_given_up(&self) -> bool;
    fn is_caught_up(&self) -> bool;
    fn n_lost(&self) -> u64;
    fn counts(&self) -> InputCounts;
}

struct Typed<M: Message> {
    subscriber: Subscriber<M>,
    n_unreadable: u64,
}

impl<M: Message> AnySubscriber for Typed<M> {
    fn receive(&mut self) -> Result<Option<Result<Record, blindgrasp_messages::MessageError>>, PortError> {
        let Some(sample) = self.subscriber.receive()? else {
            return Ok(None);
        };
        let head = sample.head();
        let message = M::from_parts(head, sample.items());
        if message.is_err() {
            self.n_unreadable += 1;
        }
        Ok(Some(message.map(|message| M::record(Stamped { header: *M::header(head), message }))))
    }

    fn connect(&mut self) -> Result<bool, PortError> {
        self.subscriber.connect()
    }

    fn begin_here(&mut self) -> Option<SampleId> {
        self.subscriber.begin_here()
    }

    fn commit(&self, header: &Header) {
        self.subscriber.commit(header);
    }

    fn give_up(&self, is_given_up: bool) {
        self.subscriber.give_up(is_given_up);
    }

    fn is_given_up(&self) -> bool {
        self.subscriber.is_given_up()
    }

    fn is_caught_up(&self) -> bool {
        self.subscriber.is_caught_up()
    }

    fn n_lost(&self) -> u64 {
        self.subscriber.n_lost()
    }

    fn counts(&self) -> InputCounts {
        let counts = self.subscriber.counts();
        InputCounts { n_received: counts.n_received - self.n_unreadable, ..counts }
    }
}

/// Opens a subscriber to an edge.
struct Opener<'a>(&'a Node<PrivateService>, &'a Arc<SharedCursors>, &'a ObservedEdge);

impl WithMessage for Opener<'_> {
    type Output = Result<Box<dyn AnySubscriber>, PortError>;

    fn with<M: Message>(self) -> Self::Output {
        let Opener(node, cursors, edge) = self;
        let mut subscriber = Subscriber::<M>::open(node, Some(cursors), &edge.input)?;
        subscriber.take_over(None);
        Ok(Box::new(Typed { subscriber, n_unreadable: 0 }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_that_do_not_wake_it_are_looked_at_before_they_are_full() {
        let mut pace = Pace { share: Some(32), pause: LOOK_PAUSES[0] };
        // Idle, it comes less and less often.
        let pauses: Vec<Duration> = (0..6).map(|_| pace.next(0)).collect();
        assert_eq!(pauses.iter().map(Duration::as_millis).collect::<Vec<_>>(), [1, 2, 4, 8, 10, 10]);
        // 64 samples in 10 ms: half as long from now on; at 32 it stays.
        assert_eq!(pace.next(64), Duration::from_millis(5));
        assert_eq!(pace.next(32), Duration::from_millis(5));
        assert_eq!(pace.next(10_000), LOOK_PAUSES[0]);
        // All edges wake it.
        let mut prompt = Pace { share: None, pause: LOOK_PAUSES[0] };
        assert_eq!((prompt.next(0), prompt.next(1)), (WAIT, Duration::ZERO));
    }
}
