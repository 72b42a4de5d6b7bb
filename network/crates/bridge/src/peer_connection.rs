//! The connection to another machine: Zenoh's publishers and subscribers, and the channels in both directions.

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

use super::agreement::Agreement;
use super::downlink::Downlink;
use super::identity::Identity;
use super::peer::Peer;
use super::protection::Protection;
use super::uplink::Uplink;
use super::wire::{Body, Frame, SampleFrame, WireError};
use blindgrasp_graph::link::config::{Channel, KeyKind, LinkConfig};
use blindgrasp_messages::{Message, WithMessage, with_message};
use blindgrasp_operator::link_status::{ChannelStatus, PeerState, PeerStatus};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::waiter::Waker;

/// Maximum number of frames of a peer that wait here. Further frames are dropped and requested again.
const MAX_INBOX: usize = 8192;
/// Maximum number of bytes of a peer that wait here.
const MAX_INBOX_BYTES: usize = 64 << 20;

pub(super) struct PeerConnection {
    pub(super) peer: Peer,
    pub(super) protection: Arc<Protection>,
    pub(super) uplinks: Vec<Uplink>,
    pub(super) downlinks: Vec<Downlink>,
    /// Whether the log says that it has stalled.
    pub(super) stall_logged: bool,
    /// When the refusal of this peer was logged last.
    pub(super) refusal_logged: Option<Instant>,
    /// When it was logged last that this peer refuses this machine.
    pub(super) refused_logged: Option<Instant>,
    inbox: Arc<Inbox>,
    /// `None` until there is a session.
    zenoh: Option<ZenohPorts>,
}

struct ZenohPorts {
    /// For [`KeyKind::Link`] and [`KeyKind::Data`].
    publishers: [Publisher<'static>; 2],
    _subscribers: Vec<Subscriber<()>>,
    _token: LivelinessToken,
}

/// Frames that Zenoh's threads have received and the link has not read yet.
#[derive(Default)]
struct Inbox {
    frames: Mutex<VecDeque<(KeyKind, ZBytes)>>,
    n_bytes: AtomicUsize,
    n_overrun: AtomicU64,
    /// Zenoh reports that the peer's process or its connection has ended.
    is_gone: AtomicBool,
}

impl PeerConnection {
    pub(super) fn open(
        operator: &Operator,
        config: &LinkConfig,
        machine: &str,
        instance: u64,
        identity: Option<&Arc<Identity>>,
    ) -> anyhow::Result<PeerConnection> {
        let exports: Vec<_> = config.exports.iter().filter(|channel| channel.to == machine).cloned().collect();
        let imports: Vec<_> = config.imports.iter().filter(|channel| channel.from == machine).cloned().collect();
        let agreement = identity.map(|_| Agreement::new(&config.key_prefix(), &config.machine, machine, instance));
        let agreement = agreement.transpose()?;
        let protection = identity.zip(agreement.as_ref());
        let protection = protection
            .map(|(identity, agreement)| Protection::new(Arc::clone(identity), machine, agreement))
            .unwrap_or_default();
        let mut uplinks = Vec::new();
        for channel in &exports {
            let opened = with_message(&channel.type_name, OpenUplink(operator, channel, config));
            uplinks.push(opened.ok_or_else(|| cannot_cross(channel))??);
        }
        let mut downlinks = Vec::new();
        for channel in &imports {
            let opened = with_message(&channel.type_name, OpenDownlink(operator, channel, instance));
            downlinks.push(opened.ok_or_else(|| cannot_cross(channel))??);
        }
        Ok(PeerConnection {
            protection: Arc::new(protection),
            uplinks,
            downlinks,
            peer: Peer::new(machine.into(), exports, imports, config.deadline_millis * 1_000_000, agreement),
            stall_logged: false,
            refusal_logged: None,
            refused_logged: None,
            inbox: Arc::default(),
            zenoh: None,
        })
    }

    /// Declares the publishers and subscribers of this connection.
    pub(super) fn connect(
        &mut self,
        operator: &Operator,
        config: &LinkConfig,
        session: &zenoh::Session,
    ) -> anyhow::Result<()> {
        let peer = &self.peer.machine;
        let own_key = |kind| config.key(&config.machine, peer, kind);
        let peers_key = |kind| config.key(peer, &config.machine, kind);
        let inbox = &self.inbox;
        let mut subscribers = vec![inbox.watch(session, peers_key(KeyKind::Alive), operator.waker())?];
        for kind in [KeyKind::Link, KeyKind::Data] {
            subscribers.push(inbox.listen(session, peers_key(kind), kind, operator.waker())?);
        }
        let token = session.liveliness().declare_token(own_key(KeyKind::Alive)).wait();
        self.zenoh = Some(ZenohPorts {
            publishers: [
                publisher(session, own_key(KeyKind::Link), Priority::InteractiveHigh)?,
                publisher(session, own_key(KeyKind::Data), Priority::Data)?,
            ],
            _subscribers: subscribers,
            _token: token.map_err(|error| anyhow!("Zenoh: {error}"))?,
        });
        Ok(())
    }

    /// Sends a frame in its protected form, if there are keys for it.
    pub(super) fn send(&mut self, kind: KeyKind, is_hello: bool, frame: &mut Vec<u8>) {
        let is_protected = if is_hello {
            self.protection.sign(frame).map_or_else(
                |error| {
                    tracing::error!("no hello for machine '{}': {error}", self.peer.machine);
                    false
                },
                |()| true,
            )
        } else {
            self.protection.encrypt(kind, frame)
        };
        if is_protected {
            self.put(kind, frame);
        }
    }

    /// Sends bytes as they are. Zenoh drops them if the connection cannot keep up; frames that matter are repeated.
    pub(super) fn put(&mut self, kind: KeyKind, frame: &[u8]) {
        let Some(zenoh) = &self.zenoh else { return };
        self.peer.bytes[0] += frame.len() as u64;
        if let Err(error) = zenoh.publishers[usize::from(kind == KeyKind::Data)].put(frame).wait() {
            tracing::debug!("not sent to machine '{}': {error}", self.peer.machine);
        }
    }

    /// Sends the samples of a channel that are due.
    ///
    /// # Errors
    /// A frame cannot be encoded.
    pub(super) fn send_samples(&mut self, channel: u16, instance: u64, bytes: &mut Vec<u8>) -> Result<(), WireError> {
        let Some(uplink) = self.uplinks.get(usize::from(channel)) else { return Ok(()) };
        let (kind, schema_id) = (uplink.channel.kind(), uplink.schema_id);
        loop {
            let sent_nanos = monotonic_nanos();
            let Some(next) = self.uplinks[usize::from(channel)].outgoing.next(sent_nanos) else { return Ok(()) };
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
            Frame { instance, counter, body: Body::Sample(frame) }.encode_into(bytes)?;
            self.send(kind, false, bytes);
        }
    }

    /// The next frame of the peer.
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

    /// Whether Zenoh has reported since the last call that the peer's process has ended.
    pub(super) fn is_gone(&self) -> bool {
        self.inbox.is_gone.swap(false, Ordering::AcqRel)
    }

    /// Number of frames that were dropped because too many waited.
    pub(super) fn n_overrun(&self) -> u64 {
        self.inbox.n_overrun.load(Ordering::Relaxed)
    }

    /// Whether readers here have not answered all published samples. Answers do not wake the link, so that it must
    /// poll.
    pub(super) fn awaits_answers(&self) -> bool {
        self.downlinks.iter().any(|downlink| downlink.writer.port().last() != downlink.answered())
    }

    /// Whether it is up and answers nothing on some channel, so that it counts as cut off.
    pub(super) fn is_stalled(&self) -> bool {
        self.peer.state == PeerState::Up && self.uplinks.iter().any(|uplink| uplink.outgoing.is_stalled())
    }

    /// Why it counts as cut off although it is up.
    pub(super) fn stall_reason(&self) -> Option<String> {
        let stalled = self.uplinks.iter().filter(|uplink| uplink.outgoing.is_stalled());
        let ports: Vec<&str> = stalled.map(|uplink| uplink.channel.port.as_str()).collect();
        self.is_stalled().then(|| {
            format!(
                "it is connected but answers no sample of {}: the graph goes on without it, and samples that find no \
                 room here are lost; look at the readers of these ports on that machine",
                ports.join(", ")
            )
        })
    }

    pub(super) fn status(&self, now_nanos: u64) -> PeerStatus {
        let peer = &self.peer;
        let stall_reason = self.stall_reason();
        let last_heard_nanos = if stall_reason.is_none() { peer.last_heard_nanos } else { None };
        let estimate = peer.clock.estimate(now_nanos);
        let sent = self.uplinks.iter().map(|uplink| uplink.outgoing.status(&uplink.channel.port, now_nanos));
        let received = self.downlinks.iter().map(|downlink| ChannelStatus {
            n_waiting: downlink.writer.n_waiting() as u64,
            ..downlink.incoming.status(&downlink.channel.port)
        });
        PeerStatus {
            machine: peer.machine.clone(),
            state: if stall_reason.is_some() { PeerState::Down } else { peer.state },
            reason: stall_reason.or_else(|| peer.reason.clone()),
            version: peer.version.clone(),
            n_times_up: peer.n_times_up,
            silent_millis: last_heard_nanos.map(|last| now_nanos.saturating_sub(last) / 1_000_000),
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
        let subscriber = session.declare_subscriber(key).callback(move |sample| {
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
        });
        subscriber.wait().map_err(|error| anyhow!("Zenoh: {error}")).context("cannot listen to another machine")
    }

    /// Watches the liveliness token of the peer.
    fn watch(self: &Arc<Self>, session: &zenoh::Session, key: String, waker: Waker) -> anyhow::Result<Subscriber<()>> {
        let inbox = Arc::clone(self);
        let subscriber = session.liveliness().declare_subscriber(key).callback(move |sample| {
            if sample.kind() == SampleKind::Delete {
                inbox.is_gone.store(true, Ordering::Release);
                waker.wake();
            }
        });
        subscriber.wait().map_err(|error| anyhow!("Zenoh: {error}")).context("cannot watch another machine")
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

struct OpenUplink<'a>(&'a Operator, &'a Channel, &'a LinkConfig);

impl WithMessage for OpenUplink<'_> {
    type Output = anyhow::Result<Uplink>;

    fn with<M: Message>(self) -> Self::Output {
        Uplink::open::<M>(self.0, self.1, self.2)
    }
}

struct OpenDownlink<'a>(&'a Operator, &'a Channel, u64);

impl WithMessage for OpenDownlink<'_> {
    type Output = anyhow::Result<Downlink>;

    fn with<M: Message>(self) -> Self::Output {
        Downlink::open::<M>(self.0, self.1, self.2)
    }
}

fn cannot_cross(channel: &Channel) -> anyhow::Error {
    anyhow!(
        "{}: samples of type {} cannot be sent to another machine; run both ends of this edge on one machine",
        channel.port,
        channel.type_name
    )
}
