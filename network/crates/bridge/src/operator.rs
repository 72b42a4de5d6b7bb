//! The link as a process. It connects the ports of the graph on this machine with Zenoh.
//!
//! One thread does everything: it reads local ports, takes the frames that Zenoh's threads have put into the peers'
//! inboxes, and sends the frames that are due. It never waits for a peer or a reader.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use time::OffsetDateTime;

use super::clock::{Origins, Passage, origin_of_answer, origin_on_arrival};
use super::downlink::{Accepted, Downlink};
use super::identity::Identity;
use super::incoming::Progress;
use super::peer::{Change, Own, Rejection};
use super::peer_connection::PeerConnection;
use super::protection::Opened;
use super::session;
use super::uplink::Uplink;
use super::wire::{Body, Frame, Rejected, SampleFrame, WireError, encode_refusal};
use blindgrasp_graph::client::observer::bears_source_number;
use blindgrasp_graph::link::config::{KeyKind, LinkConfig};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::link_status::{LinkStatus, PeerState};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::wiring::Command;

/// Maximum number of frames of a peer that are taken in a row.
const MAX_PER_ROUND: usize = 256;
/// Maximum time for which frames of a peer are taken in a row, because pings are due meanwhile.
const LONGEST_ROUND: Duration = Duration::from_millis(5);
/// Interval at which the link looks for answers of readers.
const ANSWER_PAUSE_NANOS: u64 = 2_000_000;
/// For this time after the start, peers are told often that the operators here are ready.
const EAGER_NANOS: u64 = 3_000_000_000;
/// A peer whose frames wait unread counts as cut off only after this many deadlines.
const N_DEADLINES_BEHIND: u64 = 4;
/// Interval of status reports to the launcher.
const STATUS_PAUSE: Duration = Duration::from_millis(250);
/// Interval at which ports look for new publishers and readers.
const LOOK_PAUSE: Duration = Duration::from_millis(50);
/// Minimum time between two log lines about a refused machine.
const REFUSAL_PAUSE: Duration = Duration::from_secs(10);
/// When the graph ends, a machine that is cut off is waited for this long.
const AWAY_NANOS: u64 = 3_000_000_000;
/// Pause between two attempts to reach a router.
const ROUTER_PAUSE: Duration = Duration::from_secs(1);
/// Minimum time between two log lines about a router that does not answer.
const SAY_AGAIN: Duration = Duration::from_secs(60);
/// Time without a machine after which the log says that the link waits for it.
const SAY_WAITING: Duration = Duration::from_secs(2);
/// Number of sent samples whose origin time is remembered.
const N_ORIGINS: usize = 1 << 15;

struct Link<'a> {
    operator: &'a Operator,
    config: &'a Arc<LinkConfig>,
    own: Own,
    connections: Vec<PeerConnection>,
    opening: Opening,
    origins: Origins,
    rejected: Rejected,
    ended_nodes: BTreeSet<String>,
    ended_ports: BTreeSet<String>,
    is_connected: bool,
    frame: Vec<u8>,
    last_status: Instant,
    last_look: Instant,
    started: Instant,
    started_nanos: u64,
    has_said_waiting: bool,
}

pub fn work(operator: &Operator) -> anyhow::Result<()> {
    let config: LinkConfig = operator.params()?;
    if let Some(warning) = session::warning(&config) {
        tracing::warn!("{warning}");
    }
    let config = Arc::new(config);
    let mut link = Link::open(operator, &config)?;
    // The ports exist now; operators need not wait until a router is reached.
    operator.ready(BTreeMap::new());
    link.run()?;
    link.give_up();
    link.report_status();
    operator.drained(|| link.look_for_readers())
}

impl<'a> Link<'a> {
    fn open(operator: &'a Operator, config: &'a Arc<LinkConfig>) -> anyhow::Result<Link<'a>> {
        let identity = Identity::load(config, OffsetDateTime::now_utc());
        let identity = identity.with_context(|| format!("machine '{}'", config.machine))?.map(Arc::new);
        let instance = getrandom::u64().context("the operating system gives no random numbers")?.max(1);
        let mut connections = Vec::new();
        for peer in &config.peers {
            connections.push(PeerConnection::open(operator, config, peer, instance, identity.as_ref())?);
        }
        let mut origins = Origins::new(N_ORIGINS);
        let uplinks = connections.iter().flat_map(|connection| &connection.uplinks);
        uplinks.filter_map(Uplink::sent_before).for_each(|last| origins.begin_after(last));
        let now = Instant::now();
        let own = Own {
            instance,
            machine: config.machine.clone(),
            fingerprint: config.fingerprint,
            run: config.run,
            is_ready: false,
            is_eager_until_nanos: 0,
        };
        Ok(Link {
            operator,
            config,
            own,
            connections,
            opening: Opening::start(config, operator)?,
            origins,
            rejected: Rejected::with_zeros(),
            ended_nodes: BTreeSet::new(),
            ended_ports: BTreeSet::new(),
            is_connected: false,
            frame: Vec::new(),
            last_status: now,
            last_look: now,
            started: now,
            started_nanos: monotonic_nanos(),
            has_said_waiting: false,
        })
    }

    fn run(&mut self) -> anyhow::Result<()> {
        loop {
            let stop = self.operator.should_stop();
            // A flood of frames must not make the link miss its heartbeat.
            self.operator.beat();
            self.connect()?;
            self.obey();
            let mut is_busy = false;
            for idx in 0..self.connections.len() {
                is_busy |= self.take_frames(idx)?;
                is_busy |= self.serve(idx)?;
            }
            self.tell_launcher();
            if self.operator.should_quit() {
                return Ok(());
            }
            if stop && self.has_nothing_left() {
                // This frame is not answered. It is sent twice, because Zenoh may drop one.
                for idx in 0..self.connections.len() {
                    self.say(idx, KeyKind::Link, Body::Leaving)?;
                    self.say(idx, KeyKind::Link, Body::Leaving)?;
                }
                return Ok(());
            }
            if self.last_look.elapsed() >= LOOK_PAUSE {
                self.last_look = Instant::now();
                self.operator.look_at_descriptors()?;
                for connection in &mut self.connections {
                    connection.uplinks.iter_mut().try_for_each(Uplink::connect)?;
                }
                self.look_for_readers()?;
            }
            if !is_busy {
                self.wait(stop);
            }
        }
    }

    fn look_for_readers(&mut self) -> anyhow::Result<()> {
        let mut downlinks = self.connections.iter_mut().flat_map(|connection| &mut connection.downlinks);
        downlinks.try_for_each(|downlink| Ok(downlink.writer.port_mut().look_for_readers()?))
    }

    /// Connects to Zenoh when the session has been opened.
    fn connect(&mut self) -> anyhow::Result<()> {
        let Some(session) = self.opening.session()? else { return Ok(()) };
        for connection in &mut self.connections {
            connection.connect(self.operator, self.config, &session)?;
        }
        self.opening = Opening::Open(session);
        Ok(())
    }

    /// Waits until something may have arrived or is due.
    fn wait(&self, is_stopping: bool) {
        let now_nanos = monotonic_nanos();
        let mut downlinks = self.connections.iter().flat_map(|connection| &connection.downlinks);
        let mut due_nanos =
            self.connections.iter().map(|connection| connection.peer.next_due_nanos()).min().unwrap_or(u64::MAX);
        if is_stopping || downlinks.any(|downlink| downlink.writer.n_waiting() > 0) {
            due_nanos = due_nanos.min(now_nanos + 500_000);
        } else if self.connections.iter().any(PeerConnection::awaits_answers) {
            due_nanos = due_nanos.min(now_nanos + ANSWER_PAUSE_NANOS);
        }
        let limit = Duration::from_nanos(due_nanos.saturating_sub(now_nanos)).min(LOOK_PAUSE);
        self.operator.wait_for(&[], limit);
    }

    fn obey(&mut self) {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::Go => {
                    self.own.is_ready = true;
                    let now_nanos = monotonic_nanos();
                    self.own.is_eager_until_nanos = now_nanos + EAGER_NANOS;
                    for idx in 0..self.connections.len() {
                        let hello = self.connections[idx].peer.hello(&self.own, now_nanos);
                        // A hello that is lost is repeated.
                        let _ = self.say(idx, KeyKind::Link, hello);
                    }
                }
                Command::NodeEnded { node } => {
                    self.ended_nodes.insert(node);
                }
                Command::TakeNoMore { ports } => {
                    let downlinks = self.connections.iter_mut().flat_map(|connection| &mut connection.downlinks);
                    downlinks.filter(|downlink| ports.contains(&downlink.channel.port)).for_each(Downlink::close);
                }
                Command::Set { id, .. } => {
                    let refused = Err(anyhow!("the link has no parameters that can be changed while it runs"));
                    self.operator.has_set(id, refused, None);
                }
                Command::HandOver | Command::TakeOver { .. } | Command::Drain | Command::Quit => {}
            }
        }
    }

    /// Sends one frame to a peer. Zenoh drops it if the connection cannot keep up; frames that matter are repeated.
    ///
    /// # Errors
    /// The frame cannot be encoded.
    fn say(&mut self, idx: usize, kind: KeyKind, body: Body<'_>) -> anyhow::Result<()> {
        let counter = self.connections[idx].peer.next_counter(kind);
        let is_hello = matches!(body, Body::Hello(_));
        Frame { instance: self.own.instance, counter, body }.encode_into(&mut self.frame)?;
        self.connections[idx].send(kind, is_hello, &mut self.frame);
        Ok(())
    }

    /// Takes the frames of a peer; returns whether there may be more.
    fn take_frames(&mut self, idx: usize) -> anyhow::Result<bool> {
        let start = Instant::now();
        let protection = Arc::clone(&self.connections[idx].protection);
        for n in 0.. {
            let Some((kind, bytes)) = self.connections[idx].next_frame() else { break };
            let bytes = bytes.to_bytes();
            self.connections[idx].peer.bytes[1] += bytes.len() as u64;
            let opened = protection.open(kind, &bytes);
            match opened.as_ref().map_err(WireError::clone).and_then(Opened::frame) {
                Ok(frame) => self.on_frame(idx, kind, frame)?,
                Err(WireError::Refused(reason)) => {
                    let connection = &mut self.connections[idx];
                    // Refusals are not signed: any program that reaches this key can send one, with any text.
                    if connection.peer.on_refusal(&reason)
                        && connection.refused_logged.is_none_or(|logged| logged.elapsed() > REFUSAL_PAUSE)
                    {
                        connection.refused_logged = Some(Instant::now());
                        tracing::error!("machine '{}' refuses this one: {reason}", connection.peer.machine);
                    }
                }
                Err(error) => self.reject(idx, &error),
            }
            if n >= MAX_PER_ROUND || start.elapsed() > LONGEST_ROUND {
                return Ok(true);
            }
        }
        if self.connections[idx].is_gone() {
            // All frames that the peer sent before it ended have been taken.
            let change = self.connections[idx].peer.on_leaving(PeerState::Down);
            self.apply(idx, change)?;
        }
        Ok(false)
    }

    /// Counts a frame that cannot be decoded. A peer of another version is told so.
    fn reject(&mut self, idx: usize, error: &WireError) {
        error.reason().into_iter().for_each(|reason| self.rejected.count(reason));
        // While the peer is up, the frame is not from the peer.
        let is_up = self.connections[idx].peer.state == PeerState::Up;
        if let WireError::Unverified(reason) = error
            && !is_up
        {
            self.connections[idx].peer.on_unverified(reason);
            self.say_refusal(idx, reason);
        }
        if let WireError::Version { found } = error
            && !is_up
        {
            let peer = &mut self.connections[idx].peer;
            let reason = format!(
                "machine '{}' runs blindgrasp {} with link protocol {}, machine '{}' link protocol {found}: install the \
                 same version on both",
                self.config.machine,
                env!("CARGO_PKG_VERSION"),
                super::wire::PROTOCOL,
                peer.machine
            );
            peer.on_unverified(&reason);
            self.say_refusal(idx, &reason);
        }
    }

    /// Tells a peer why it is refused. The reason is logged here as well, but not for each attempt of the peer.
    fn refuse(&mut self, idx: usize, reason: &str) {
        let peer = &mut self.connections[idx].peer;
        (peer.state, peer.reason) = (PeerState::Refused, Some(reason.into()));
        self.say_refusal(idx, reason);
    }

    fn say_refusal(&mut self, idx: usize, reason: &str) {
        let connection = &mut self.connections[idx];
        if connection.refusal_logged.is_none_or(|logged| logged.elapsed() > REFUSAL_PAUSE) {
            connection.refusal_logged = Some(Instant::now());
            tracing::error!("machine '{}' is refused: {reason}", connection.peer.machine);
        }
        connection.put(KeyKind::Link, &encode_refusal(reason));
    }

    fn on_frame(&mut self, idx: usize, kind: KeyKind, frame: Frame<'_>) -> anyhow::Result<()> {
        let now_nanos = monotonic_nanos();
        let Frame { instance, counter, body } = frame;
        let peer = &mut self.connections[idx].peer;
        if let Body::Hello(hello) = &body {
            let (change, is_to_answer) = match peer.on_hello(&self.own, instance, counter, hello, now_nanos) {
                Ok(taken) => taken,
                Err(Rejection::Refused(reason)) => {
                    self.rejected.count("version");
                    self.refuse(idx, &reason);
                    (Some(Change::CutOff), false)
                }
                Err(Rejection::Keyless) => {
                    self.rejected.count("forged");
                    return Ok(());
                }
                Err(_) => {
                    self.rejected.count("replayed");
                    return Ok(());
                }
            };
            self.apply(idx, change)?;
            if is_to_answer {
                let hello = self.connections[idx].peer.hello(&self.own, now_nanos);
                self.say(idx, KeyKind::Link, hello)?;
            }
            return Ok(());
        }
        let change = match peer.on_frame(kind, instance, counter, now_nanos) {
            Ok(change) => change,
            Err(Rejection::Replayed) => {
                self.rejected.count("replayed");
                return Ok(());
            }
            Err(_) => {
                self.rejected.count("stale");
                return Ok(());
            }
        };
        self.apply(idx, change)?;
        self.on_body(idx, body, now_nanos)
    }

    fn on_body(&mut self, idx: usize, body: Body<'_>, now_nanos: u64) -> anyhow::Result<()> {
        let connection = &mut self.connections[idx];
        match body {
            Body::Hello(_) => {}
            Body::Ping { sent_nanos } => {
                connection.peer.echo_nanos = connection.peer.echo_nanos.max(sent_nanos);
                if connection.peer.answers_ping(now_nanos) {
                    let pong = Body::Pong { sent_nanos, received_nanos: now_nanos, answered_nanos: monotonic_nanos() };
                    self.say(idx, KeyKind::Link, pong)?;
                }
            }
            Body::Pong { sent_nanos, received_nanos, answered_nanos } => {
                if !connection.peer.clock.add(sent_nanos, received_nanos, answered_nanos, now_nanos) {
                    self.rejected.count("malformed");
                }
            }
            Body::Resume { channel, run, after } => {
                if let Some(uplink) = connection.uplinks.get_mut(usize::from(channel)) {
                    uplink.outgoing.on_resume(run, after);
                }
                if connection.uplinks.iter().all(|uplink| uplink.outgoing.has_request()) {
                    connection.peer.on_requests();
                }
            }
            Body::Sample(frame) => self.on_sample(idx, &frame, now_nanos)?,
            Body::Ack { channel, run, n_received, answered } => {
                if let Some(uplink) = connection.uplinks.get_mut(usize::from(channel)) {
                    uplink.outgoing.on_ack(run, n_received, answered, now_nanos);
                    uplink.commit();
                }
            }
            Body::End { channel, run, .. } => {
                if let Some(downlink) = connection.downlinks.get_mut(usize::from(channel))
                    && downlink.incoming.on_end(run)
                {
                    let port = downlink.channel.port.clone();
                    if self.ended_ports.insert(port.clone()) {
                        self.operator.ended(self.ended_ports.iter().cloned().collect());
                    }
                    self.say(idx, KeyKind::Link, Body::Ended { channel })?;
                }
            }
            Body::Ended { channel } => {
                if let Some(uplink) = connection.uplinks.get_mut(usize::from(channel)) {
                    uplink.outgoing.on_ended();
                }
            }
            Body::Leaving => {
                let change = connection.peer.on_leaving(PeerState::Left);
                if change.is_some() {
                    tracing::warn!("machine '{}' has left the graph", connection.peer.machine);
                }
                self.apply(idx, change)?;
            }
        }
        Ok(())
    }

    fn on_sample(&mut self, idx: usize, frame: &SampleFrame<'_>, now_nanos: u64) -> anyhow::Result<()> {
        let connection = &mut self.connections[idx];
        let Some(downlink) = connection.downlinks.get_mut(usize::from(frame.channel)) else {
            self.rejected.count("malformed");
            return Ok(());
        };
        if downlink.schema_id != frame.schema_id {
            self.rejected.count("version");
            return Ok(());
        }
        let estimate = connection.peer.clock.estimate(now_nanos);
        let deadline_nanos = self.config.deadline_millis * 1_000_000;
        let is_answer = downlink.channel.is_to_source && bears_source_number(&downlink.channel.type_name);
        let passage = Passage {
            arrival_nanos: now_nanos,
            echo_nanos: frame.echo_nanos,
            sent_nanos: frame.sent_nanos,
            age_nanos: frame.age_nanos,
        };
        let on_arrival = || origin_on_arrival(&passage, estimate, deadline_nanos);
        let mut origin_of =
            |key: SampleId| if is_answer { origin_of_answer(&key, &self.origins, on_arrival) } else { on_arrival() };
        match downlink.accept(frame, &mut origin_of)? {
            Accepted::Yes | Accepted::Repeated | Accepted::Gap => {}
            // A repetition would be the same bytes. The readers see the gap.
            Accepted::Malformed => self.rejected.count("malformed"),
            Accepted::TooMany => self.rejected.count("flooded"),
            Accepted::UsedNumber => {
                let port = downlink.channel.port.clone();
                if self.ended_ports.insert(port.clone()) {
                    tracing::warn!(
                        "machine '{}' has started again, and {port} repeats earlier sequence numbers, as a recording does \
                         that is played again: this machine's part of the graph ends; with run --stay it starts again too",
                        connection.peer.machine
                    );
                    self.operator.ended(self.ended_ports.iter().cloned().collect());
                }
            }
        }
        Ok(())
    }

    /// Applies a change of a peer to its channels.
    fn apply(&mut self, idx: usize, change: Option<Change>) -> anyhow::Result<()> {
        let connection = &mut self.connections[idx];
        let machine = &connection.peer.machine;
        match change {
            None => return Ok(()),
            Some(Change::CutOff) => {
                if connection.peer.state == PeerState::Down {
                    tracing::warn!("machine '{machine}' is cut off: nothing heard of it");
                }
                connection.uplinks.iter_mut().for_each(|uplink| uplink.outgoing.cut_off());
                connection.downlinks.iter_mut().for_each(|downlink| downlink.incoming.cut_off());
            }
            Some(change @ (Change::Found | Change::FoundAnew)) => {
                tracing::info!("machine '{machine}' is there");
                connection.uplinks.iter_mut().for_each(|uplink| uplink.outgoing.cut_off());
                for downlink in &mut connection.downlinks {
                    if change == Change::FoundAnew {
                        downlink.begin_anew();
                    }
                    downlink.incoming.reconnected();
                    if self.ended_ports.remove(&downlink.channel.port) {
                        self.operator.ended(self.ended_ports.iter().cloned().collect());
                    }
                }
            }
            Some(Change::Asked) => connection.downlinks.iter_mut().for_each(|downlink| downlink.incoming.reconnected()),
        }
        Ok(())
    }

    /// Does what is due for a peer: reads, sends, publishes; returns whether there is more to do at once.
    fn serve(&mut self, idx: usize) -> anyhow::Result<bool> {
        let now_nanos = monotonic_nanos();
        // While frames of the peer wait here unread, it is not silent, unless that goes on for ever.
        let connection = &mut self.connections[idx];
        let heard_nanos = connection.peer.last_heard_nanos.unwrap_or(0);
        let deadline_nanos = self.config.deadline_millis * 1_000_000;
        let is_behind =
            connection.has_unread() && now_nanos.saturating_sub(heard_nanos) < N_DEADLINES_BEHIND * deadline_nanos;
        let change = if is_behind { None } else { connection.peer.check_deadline(now_nanos) };
        self.apply(idx, change)?;
        let mut bodies = Vec::new();
        self.connections[idx].peer.due(&self.own, now_nanos, &mut bodies);
        for body in bodies {
            self.say(idx, KeyKind::Link, body)?;
        }
        let is_busy = self.send_samples(idx)?;
        self.log_stall(idx);
        self.tell_readers(idx, now_nanos);
        self.tend_downlinks(idx, now_nanos)?;
        self.end_closed_ports(idx);
        Ok(is_busy)
    }

    /// Tells the readers of a peer's ports whether samples can arrive. A connection that is lost and found within the
    /// deadline is not reported.
    fn tell_readers(&mut self, idx: usize, now_nanos: u64) {
        let is_ending = !self.ended_nodes.is_empty();
        let connection = &mut self.connections[idx];
        let is_cut_off = match connection.peer.state {
            PeerState::Up => connection.is_stalled(),
            PeerState::Left | PeerState::Refused => true,
            PeerState::Waiting | PeerState::Down => {
                let since_nanos = connection.peer.last_heard_nanos.unwrap_or(self.started_nanos);
                now_nanos.saturating_sub(since_nanos) > self.config.deadline_millis * 1_000_000
            }
        };
        for downlink in &connection.downlinks {
            // At the end of a graph the other machines leave first; these readers are not cut off.
            let has_ended = is_ending && self.ended_ports.contains(&downlink.channel.port);
            downlink.writer.port().set_cut_off(is_cut_off && !has_ended);
        }
    }

    /// Logs that a peer has stalled, or answers again.
    fn log_stall(&mut self, idx: usize) {
        let connection = &mut self.connections[idx];
        let machine = &connection.peer.machine;
        match (connection.stall_reason(), connection.stall_logged) {
            (Some(reason), false) => tracing::warn!("machine '{machine}' is cut off: {reason}"),
            (None, true) => tracing::info!("machine '{machine}' is no longer cut off for answering no samples"),
            _ => return,
        }
        connection.stall_logged = !connection.stall_logged;
    }

    fn send_samples(&mut self, idx: usize) -> anyhow::Result<bool> {
        let mut is_busy = false;
        for channel_idx in 0..self.connections[idx].uplinks.len() {
            let connection = &mut self.connections[idx];
            let is_up = connection.peer.state == PeerState::Up;
            let uplink = &mut connection.uplinks[channel_idx];
            is_busy |= uplink.take_in(is_up, &mut self.origins)?;
            uplink.commit();
            if self.ended_nodes.contains(uplink.channel.node()) && uplink.has_taken_all() {
                uplink.outgoing.end(uplink.last);
            }
            let channel = channel_idx as u16;
            if is_up {
                connection.send_samples(channel, self.own.instance, &mut self.frame)?;
            }
            let outgoing = &mut self.connections[idx].uplinks[channel_idx].outgoing;
            if is_up && let Some((run, last)) = outgoing.end_to_send(monotonic_nanos()) {
                self.say(idx, KeyKind::Link, Body::End { channel, run, last })?;
            }
        }
        Ok(is_busy)
    }

    /// Says of ports that take no more samples that they have ended, once their readers can get all that was taken.
    fn end_closed_ports(&mut self, idx: usize) {
        let closed = self.connections[idx].downlinks.iter().filter(|downlink| downlink.is_closed_and_empty());
        let n_before = self.ended_ports.len();
        self.ended_ports.extend(closed.map(|downlink| downlink.channel.port.clone()));
        if self.ended_ports.len() > n_before {
            self.operator.ended(self.ended_ports.iter().cloned().collect());
        }
    }

    fn tend_downlinks(&mut self, idx: usize, now_nanos: u64) -> anyhow::Result<()> {
        let is_up = self.connections[idx].peer.state == PeerState::Up;
        for channel_idx in 0..self.connections[idx].downlinks.len() {
            let channel = channel_idx as u16;
            let downlink = &mut self.connections[idx].downlinks[channel_idx];
            downlink.writer.flush()?;
            let answered = downlink.answered();
            if is_up && let Some(progress) = downlink.incoming.ack_to_send(answered, now_nanos) {
                let Progress { run, n_received, answered } = progress;
                self.say(idx, KeyKind::Link, Body::Ack { channel, run, n_received, answered })?;
            }
            let incoming = &mut self.connections[idx].downlinks[channel_idx].incoming;
            if is_up && let Some((run, after)) = incoming.resume_to_send(now_nanos) {
                self.say(idx, KeyKind::Link, Body::Resume { channel, run, after })?;
            }
        }
        Ok(())
    }

    /// Whether all samples were sent to the machines that are there. The message that a node has ended may arrive after
    /// the signal to stop.
    fn has_nothing_left(&self) -> bool {
        self.connections.iter().all(|connection| {
            let is_away = match connection.peer.state {
                PeerState::Up => connection.is_stalled(),
                PeerState::Down => connection
                    .peer
                    .last_heard_nanos
                    .is_none_or(|last| monotonic_nanos().saturating_sub(last) > AWAY_NANOS),
                PeerState::Waiting | PeerState::Left | PeerState::Refused => true,
            };
            connection.uplinks.iter().all(|uplink| {
                self.ended_nodes.contains(uplink.channel.node()) && (is_away || uplink.outgoing.is_done())
            })
        })
    }

    fn tell_launcher(&mut self) {
        if !self.is_connected && self.own.is_ready {
            let connections = self.connections.iter();
            let missing = connections.filter(|connection| connection.peer.is_needed() && !connection.peer.is_ready());
            let missing: Vec<_> = missing.map(|connection| connection.peer.machine.as_str()).collect();
            if missing.is_empty() {
                self.is_connected = true;
                // The launcher needs this report first. Otherwise a graph that ends before the next one would count the
                // machine as away.
                self.report_status();
                self.operator.connected();
            } else if !self.has_said_waiting && self.started.elapsed() > SAY_WAITING {
                self.has_said_waiting = true;
                tracing::warn!("waiting for machine {}", missing.join(", "));
            }
        }
        if self.last_status.elapsed() >= STATUS_PAUSE {
            self.report_status();
        }
    }

    /// Counts the samples as lost that will not be sent any more.
    fn give_up(&mut self) {
        let uplinks = self.connections.iter_mut().flat_map(|connection| &mut connection.uplinks);
        uplinks.for_each(|uplink| uplink.outgoing.give_up());
    }

    fn report_status(&mut self) {
        self.last_status = Instant::now();
        let now_nanos = monotonic_nanos();
        let mut rejected = self.rejected.clone();
        let downlinks = self.connections.iter().flat_map(|connection| &connection.downlinks);
        rejected.add("stale", downlinks.map(|downlink| downlink.incoming.n_stale()).sum());
        let overrun = self.connections.iter().map(PeerConnection::n_overrun).sum();
        if overrun > 0 {
            rejected.add("overrun", overrun);
        }
        self.operator.has_link_status(LinkStatus {
            machine: self.config.machine.clone(),
            namespace: self.config.namespace.clone(),
            peers: self.connections.iter().map(|connection| connection.status(now_nanos)).collect(),
            rejected: rejected.by_reason(),
        });
    }
}

/// The state of the Zenoh session.
enum Opening {
    /// A thread opens the session. It waits for a router, if there is one, as long as that takes.
    Trying(Receiver<anyhow::Result<zenoh::Session>>),
    /// The ports of a connection need the session for as long as the link runs.
    Open(#[expect(dead_code, reason = "it is kept open")] zenoh::Session),
}

impl Opening {
    /// Opens the session on a thread. It tries again only if a router does not answer; other machines may come later.
    fn start(config: &Arc<LinkConfig>, operator: &Operator) -> anyhow::Result<Opening> {
        let (sender, receiver) = channel();
        let (config, waker) = (Arc::clone(config), operator.waker());
        std::thread::spawn(move || {
            let mut logged: Option<Instant> = None;
            loop {
                let opened = session::open(&config);
                let is_passing = opened.as_ref().is_err_and(|error| error.is_passing());
                if let Err(error) = opened.as_ref().map_err(|error| error.to_string())
                    && is_passing
                {
                    if logged.is_none_or(|logged| logged.elapsed() > SAY_AGAIN) {
                        logged = Some(Instant::now());
                        tracing::warn!("{error}");
                    }
                    std::thread::sleep(ROUTER_PAUSE);
                    continue;
                }
                let _ = sender.send(opened.map_err(Into::into));
                return waker.wake();
            }
        });
        Ok(Opening::Trying(receiver))
    }

    /// The session, if it has just been opened.
    fn session(&self) -> anyhow::Result<Option<zenoh::Session>> {
        match self {
            Opening::Trying(receiver) => receiver.try_recv().ok().transpose(),
            Opening::Open(_) => Ok(None),
        }
    }
}
