//! A peer with what crosses to and from it: Zenoh's publishers and subscribers, and the channels.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, anyhow};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::SampleKind;

use super::config::{Channel, KeyKind, LinkConfig, PeerConfig};
use super::export::{self, Export};
use super::import::{self, Import};
use super::peer::Peer;
use super::wire::{Body, Frame, SampleFrame};
use blindgrasp_messages::{Message, WithMessage, with_message};
use blindgrasp_operator::link_status::{ChannelStatus, PeerStatus};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::waiter::Waker;

/// How many frames of a peer may wait; what comes beyond is dropped, and asked for again.
const MAX_INBOX: usize = 8192;
/// The same in bytes.
const MAX_INBOX_BYTES: usize = 64 << 20;

/// A peer and what crosses to and from it.
pub(super) struct Line {
    pub(super) peer: Peer,
    pub(super) exports: Vec<Box<dyn Export>>,
    pub(super) imports: Vec<Box<dyn Import>>,
    /// When this side last said that it refuses the peer.
    pub(super) refusal_said: Option<Instant>,
    inbox: Arc<Inbox>,
    /// `None` until there is a session.
    wire: Option<Wire>,
}

/// Zenoh's ends.
struct Wire {
    /// By kind of key: link, data.
    publishers: [Publisher<'static>; 2],
    _subscribers: Vec<Subscriber<()>>,
    _token: LivelinessToken,
}

/// What Zenoh's threads have received, and nobody has read.
#[derive(Default)]
struct Inbox {
    frames: Mutex<VecDeque<(KeyKind, ZBytes)>>,
    n_bytes: AtomicUsize,
    n_overrun: AtomicU64,
    /// The peer's process has ended, or its connection, says Zenoh.
    is_gone: AtomicBool,
}

impl Line {
    pub(super) fn open(
        operator: &Operator,
        config: &LinkConfig,
        peer: &PeerConfig,
        instance: u64,
    ) -> anyhow::Result<Line> {
        let own = |channels: &[Channel], is_its: fn(&Channel) -> &str| -> Vec<Channel> {
            channels.iter().filter(|channel| is_its(channel) == peer.machine).cloned().collect()
        };
        let exports = own(&config.exports, |channel| &channel.to);
        let imports = own(&config.imports, |channel| &channel.from);
        let open_export = |channel: &Channel| {
            let opened = with_message(&channel.type_name, OpenExport(operator, channel, config.buffer));
            opened.unwrap_or_else(|| Err(cannot_cross(channel)))
        };
        let open_import = |channel: &Channel| {
            let opened = with_message(&channel.type_name, OpenImport(operator, channel, instance));
            opened.unwrap_or_else(|| Err(cannot_cross(channel)))
        };
        Ok(Line {
            exports: exports.iter().map(open_export).collect::<anyhow::Result<_>>()?,
            imports: imports.iter().map(open_import).collect::<anyhow::Result<_>>()?,
            peer: Peer::new(peer.clone(), exports, imports, config.deadline_millis * 1_000_000),
            refusal_said: None,
            inbox: Arc::default(),
            wire: None,
        })
    }

    /// Gets it onto Zenoh.
    pub(super) fn connect(
        &mut self,
        operator: &Operator,
        config: &LinkConfig,
        session: &zenoh::Session,
    ) -> anyhow::Result<()> {
        let peer = &self.peer.config.machine;
        let own_key = |kind| config.key(&config.machine, peer, kind);
        let peers_key = |kind| config.key(peer, &config.machine, kind);
        let inbox = &self.inbox;
        let mut subscribers = vec![inbox.watch(session, peers_key(KeyKind::Alive), operator.waker()?)?];
        for kind in [KeyKind::Link, KeyKind::Data] {
            subscribers.push(inbox.listen(session, peers_key(kind), kind, operator.waker()?)?);
        }
        let token = session.liveliness().declare_token(own_key(KeyKind::Alive)).wait();
        self.wire = Some(Wire {
            publishers: [
                publisher(session, own_key(KeyKind::Link), Priority::InteractiveHigh)?,
                publisher(session, own_key(KeyKind::Data), Priority::Data)?,
            ],
            _subscribers: subscribers,
            _token: token.map_err(|error| anyhow!("Zenoh: {error}"))?,
        });
        Ok(())
    }

    /// Sends a frame, or drops it if the connection cannot keep up: it is said again where it matters.
    pub(super) fn put(&mut self, kind: KeyKind, frame: &[u8]) {
        let Some(wire) = &self.wire else {
            return;
        };
        self.peer.bytes[0] += frame.len() as u64;
        if let Err(error) = wire.publishers[usize::from(kind == KeyKind::Data)].put(frame).wait() {
            tracing::debug!("not sent to machine '{}': {error}", self.peer.config.machine);
        }
    }

    /// Sends what a channel has to send by now.
    pub(super) fn send_samples(&mut self, channel: u16, instance: u64, bytes: &mut Vec<u8>) {
        let Some(export) = self.exports.get_mut(usize::from(channel)) else {
            return;
        };
        let (kind, schema_id) = (export.channel().kind(), export.schema_id());
        loop {
            let sent_nanos = monotonic_nanos();
            let Some(next) = self.exports[usize::from(channel)].outgoing().next(sent_nanos) else {
                return;
            };
            let frame = SampleFrame {
                channel,
                run: next.run,
                index: next.index,
                schema_id,
                echo_nanos: self.peer.echo_nanos,
                age_nanos: (next.origin_nanos != 0).then(|| sent_nanos.saturating_sub(next.origin_nanos)),
                sent_nanos,
                message: next.message,
            };
            let counter = self.peer.next_counter(kind);
            Frame { instance, counter, body: Body::Sample(frame) }.encode_into(bytes);
            self.put(kind, bytes);
        }
    }

    /// The next frame that has come.
    pub(super) fn next_frame(&self) -> Option<(KeyKind, ZBytes)> {
        let next = self.inbox.frames.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
        next.inspect(|(_, bytes)| {
            self.inbox.n_bytes.fetch_sub(bytes.len(), Ordering::Relaxed);
        })
    }

    /// Whether frames wait to be read.
    pub(super) fn has_unread(&self) -> bool {
        !self.inbox.frames.lock().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Whether Zenoh says, since the last time, that the peer's process has ended.
    pub(super) fn is_gone(&self) -> bool {
        self.inbox.is_gone.swap(false, Ordering::AcqRel)
    }

    /// How many frames were dropped because nobody had read those before.
    pub(super) fn n_overrun(&self) -> u64 {
        self.inbox.n_overrun.load(Ordering::Relaxed)
    }

    /// Whether readers here have not answered all that was published: their answers wake nobody.
    pub(super) fn awaits_answers(&self) -> bool {
        self.imports.iter().any(|import| import.published() != import.answered())
    }

    /// How it is.
    pub(super) fn status(&self, now_nanos: u64) -> PeerStatus {
        let peer = &self.peer;
        let estimate = peer.clock.estimate(now_nanos);
        let sent = self.exports.iter().map(|export| export.status().status(&export.channel().port, now_nanos));
        let received = self.imports.iter().map(|import| ChannelStatus {
            n_waiting: import.n_waiting() as u64,
            ..import.status().status(&import.channel().port)
        });
        PeerStatus {
            machine: peer.config.machine.clone(),
            state: peer.state,
            reason: peer.reason.clone(),
            version: peer.version.clone(),
            n_times_up: peer.n_times_up,
            silent_millis: peer.last_heard_nanos.map(|last| now_nanos.saturating_sub(last) / 1_000_000),
            offset_nanos: estimate.map(|estimate| estimate.offset_nanos),
            uncertainty_nanos: estimate.map(|estimate| estimate.uncertainty_nanos),
            round_trip_nanos: estimate.map(|estimate| estimate.round_trip_nanos),
            bytes_sent: peer.bytes[0],
            bytes_received: peer.bytes[1],
            channels: sent.chain(received).collect(),
        }
    }
}

impl Inbox {
    fn listen(
        self: &Arc<Self>,
        session: &zenoh::Session,
        key: String,
        kind: KeyKind,
        waker: Waker,
    ) -> anyhow::Result<Subscriber<()>> {
        let inbox = Arc::clone(self);
        let callback = move |sample: zenoh::sample::Sample| {
            let mut frames = inbox.frames.lock().unwrap_or_else(PoisonError::into_inner);
            let n_bytes = sample.payload().len();
            if frames.len() >= MAX_INBOX || inbox.n_bytes.load(Ordering::Relaxed) + n_bytes > MAX_INBOX_BYTES {
                inbox.n_overrun.fetch_add(1, Ordering::Relaxed);
                return;
            }
            inbox.n_bytes.fetch_add(n_bytes, Ordering::Relaxed);
            frames.push_back((kind, sample.payload().clone()));
            let is_first = frames.len() == 1;
            drop(frames);
            if is_first {
                waker.wake();
            }
        };
        let subscriber = session.declare_subscriber(key).callback(callback).wait();
        subscriber.map_err(|error| anyhow!("Zenoh: {error}")).context("cannot listen to another machine")
    }

    /// Notices that a peer's token has gone.
    fn watch(self: &Arc<Self>, session: &zenoh::Session, key: String, waker: Waker) -> anyhow::Result<Subscriber<()>> {
        let inbox = Arc::clone(self);
        let callback = move |sample: zenoh::sample::Sample| {
            if sample.kind() == SampleKind::Delete {
                inbox.is_gone.store(true, Ordering::Release);
                waker.wake();
            }
        };
        let subscriber = session.liveliness().declare_subscriber(key).callback(callback).wait();
        subscriber.map_err(|error| anyhow!("Zenoh: {error}")).context("cannot watch another machine")
    }
}

fn publisher(session: &zenoh::Session, key: String, priority: Priority) -> anyhow::Result<Publisher<'static>> {
    let publisher = session
        .declare_publisher(key)
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .express(true)
        .wait();
    publisher.map_err(|error| anyhow!("Zenoh: {error}")).context("cannot speak to another machine")
}

struct OpenExport<'a>(&'a Operator, &'a Channel, usize);

impl WithMessage for OpenExport<'_> {
    type Output = anyhow::Result<Box<dyn Export>>;

    fn with<M: Message>(self) -> Self::Output {
        export::open::<M>(self.0, self.1, self.2)
    }
}

struct OpenImport<'a>(&'a Operator, &'a Channel, u64);

impl WithMessage for OpenImport<'_> {
    type Output = anyhow::Result<Box<dyn Import>>;

    fn with<M: Message>(self) -> Self::Output {
        import::open::<M>(self.0, self.1, self.2)
    }
}

fn cannot_cross(channel: &Channel) -> anyhow::Error {
    anyhow!("{}: samples of type {} cannot go to another machine", channel.port, channel.type_name)
}
