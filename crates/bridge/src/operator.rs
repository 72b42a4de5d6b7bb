//! The link as a process: Zenoh on one side, the graph's ports on the other.
//!
//! One thread does all: it reads local ports, takes what Zenoh's threads have put into the peers' inboxes, and says what
//! is due. Nothing in it waits for a peer or a reader.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};

use super::clock::{Origins, Passage, origin_on_arrival};
use super::config::{KeyKind, LinkConfig};
use super::export::Export;
use super::import::Accepted;
use super::line::Line;
use super::peer::{Change, Own, Rejection};
use super::session;
use super::tunnel::Tunnels;
use super::wire::{Body, Frame, Rejected, SampleFrame, WireError, encode_refusal};
use blindgrasp_graph::observer::bears_source_number;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::link_status::{LinkStatus, PeerState};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::wiring::Command;

/// How many frames of a peer are taken in a row.
const MAX_PER_ROUND: usize = 256;
/// For how long frames of a peer are taken in a row: pings are due meanwhile.
const LONGEST_ROUND: Duration = Duration::from_millis(5);
/// How soon it looks again for what readers have answered.
const ANSWER_PAUSE_NANOS: u64 = 2_000_000;
/// For how long peers are told again and again that the operators here are ready.
const EAGER_NANOS: u64 = 3_000_000_000;
/// After how many deadlines a peer whose frames nobody comes to read counts as cut off all the same.
const N_DEADLINES_BEHIND: u64 = 4;
/// How often the launcher is told how the link is.
const STATUS_PAUSE: Duration = Duration::from_millis(250);
/// How often ports look for those at their other ends.
const LOOK_PAUSE: Duration = Duration::from_millis(50);
/// How often it says that it refuses a machine, at most.
const REFUSAL_PAUSE: Duration = Duration::from_secs(10);
/// How long a machine that is cut off when the graph ends is waited for.
const AWAY_NANOS: u64 = 3_000_000_000;
/// How long it waits before it looks for a router again.
const ROUTER_PAUSE: Duration = Duration::from_secs(1);
/// How often it says that it still looks for a router.
const SAY_AGAIN: Duration = Duration::from_secs(60);
/// How long it waits for a machine before it says so.
const SAY_WAITING: Duration = Duration::from_secs(2);
/// How many samples that left this machine are remembered with the time when they began.
const N_ORIGINS: usize = 1 << 15;

struct Link<'a> {
    operator: &'a Operator,
    config: &'a Arc<LinkConfig>,
    own: Own,
    lines: Vec<Line>,
    opening: Opening,
    origins: Origins,
    rejected: Rejected,
    /// Samples beyond what a sender may have on their way.
    n_flooded: u64,
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

/// Carries edges until the operator is asked to stop.
///
/// # Errors
/// A port or the configuration.
pub fn work(operator: &Operator) -> anyhow::Result<()> {
    let config: LinkConfig = operator.params()?;
    if let Some(warning) = session::warning(&config) {
        tracing::warn!("{warning}");
    }
    let config = Arc::new(config);
    let mut link = Link::open(operator, &config)?;
    // Its ports are there; whether a router is, operators need not wait for.
    operator.ready(BTreeMap::new());
    link.run()?;
    link.give_up();
    link.report_status();
    operator.drained();
    Ok(())
}

impl<'a> Link<'a> {
    fn open(operator: &'a Operator, config: &'a Arc<LinkConfig>) -> anyhow::Result<Link<'a>> {
        let instance = monotonic_nanos() ^ wall_nanos().rotate_left(20) ^ u64::from(std::process::id()).rotate_left(44);
        let mut lines = Vec::new();
        for peer in &config.peers {
            lines.push(Line::open(operator, config, peer, instance)?);
        }
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
            lines,
            opening: Opening::start(config, operator)?,
            origins: Origins::new(N_ORIGINS),
            rejected: Rejected::default(),
            n_flooded: 0,
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
            // Whoever floods it must not make it look dead.
            self.operator.beat();
            self.connect()?;
            self.obey();
            let mut is_busy = false;
            for idx in 0..self.lines.len() {
                is_busy |= self.take_frames(idx)?;
                is_busy |= self.serve(idx)?;
            }
            self.tell_launcher();
            if self.operator.should_quit() {
                return Ok(());
            }
            if stop && self.has_nothing_left() {
                // Nobody answers it, and from here on nobody is listened to.
                for idx in 0..self.lines.len() {
                    self.say(idx, KeyKind::Link, Body::Leaving)?;
                    self.say(idx, KeyKind::Link, Body::Leaving)?;
                }
                return Ok(());
            }
            if self.last_look.elapsed() >= LOOK_PAUSE {
                self.last_look = Instant::now();
                for line in &mut self.lines {
                    line.exports.iter().try_for_each(|export| export.connect())?;
                    line.imports.iter_mut().try_for_each(|import| import.look_for_readers())?;
                }
            }
            if !is_busy {
                self.wait(stop);
            }
        }
    }

    /// Gets onto Zenoh once there is a session.
    fn connect(&mut self) -> anyhow::Result<()> {
        let Some(session) = self.opening.session()? else {
            return Ok(());
        };
        let tunnels = Tunnels::start(session.clone(), Arc::clone(self.config)).context("cannot serve commands")?;
        for line in &mut self.lines {
            line.connect(self.operator, self.config, &session)?;
        }
        self.opening = Opening::Open { tunnels, _session: session };
        Ok(())
    }

    /// Until something may have come or is due.
    fn wait(&self, is_stopping: bool) {
        let now_nanos = monotonic_nanos();
        let waits = |line: &Line| line.imports.iter().any(|import| import.n_waiting() > 0);
        let mut due_nanos = self.lines.iter().map(|line| line.peer.next_due_nanos()).min().unwrap_or(u64::MAX);
        if is_stopping || self.lines.iter().any(waits) {
            due_nanos = due_nanos.min(now_nanos + 500_000);
        } else if self.lines.iter().any(|line| line.awaits_answers()) {
            due_nanos = due_nanos.min(now_nanos + ANSWER_PAUSE_NANOS);
        }
        let limit = Duration::from_nanos(due_nanos.saturating_sub(now_nanos)).min(LOOK_PAUSE);
        let exports = self.lines.iter().flat_map(|line| &line.exports);
        let listeners: Vec<_> = exports.filter_map(|export| export.listener()).collect();
        self.operator.wait_for(&listeners, &[], limit);
    }

    fn obey(&mut self) {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::Go => {
                    self.own.is_ready = true;
                    let now_nanos = monotonic_nanos();
                    self.own.is_eager_until_nanos = now_nanos + EAGER_NANOS;
                    for idx in 0..self.lines.len() {
                        let hello = self.lines[idx].peer.hello(&self.own, now_nanos);
                        // A hello that is lost is said again.
                        let _ = self.say(idx, KeyKind::Link, hello);
                    }
                }
                Command::NodeEnded { node } => {
                    self.ended_nodes.insert(node);
                }
                Command::TakeNoMore { ports } => {
                    for import in self.lines.iter_mut().flat_map(|line| &mut line.imports) {
                        if ports.contains(&import.channel().port) {
                            import.close();
                        }
                    }
                }
                Command::Set { id, .. } => {
                    let refused = Err(anyhow!("it has no parameters that can be changed while it runs"));
                    self.operator.has_set(id, refused, None);
                }
                Command::HandOver | Command::TakeOver { .. } => {}
            }
        }
    }

    /// Says one thing to a peer. What Zenoh drops, because a connection cannot keep up, is said again where it matters.
    fn say(&mut self, idx: usize, kind: KeyKind, body: Body<'_>) -> anyhow::Result<()> {
        let counter = self.lines[idx].peer.next_counter(kind);
        self.frame.clear();
        Frame { instance: self.own.instance, counter, body }.encode_into(&mut self.frame);
        self.lines[idx].put(kind, &self.frame);
        Ok(())
    }

    /// Takes in what a peer has said; true if there may be more.
    fn take_frames(&mut self, idx: usize) -> anyhow::Result<bool> {
        let start = Instant::now();
        for n in 0.. {
            let Some((kind, bytes)) = self.lines[idx].next_frame() else {
                break;
            };
            let bytes = bytes.to_bytes();
            self.lines[idx].peer.bytes[1] += bytes.len() as u64;
            match Frame::decode(&bytes) {
                Ok(frame) => self.on_frame(idx, kind, frame)?,
                Err(WireError::Refused(reason)) => {
                    let peer = &mut self.lines[idx].peer;
                    if peer.on_refusal(&reason) {
                        tracing::error!("machine '{}' refuses this one: {reason}", peer.config.machine);
                    }
                }
                Err(error) => self.reject(idx, &error),
            }
            if n >= MAX_PER_ROUND || start.elapsed() > LONGEST_ROUND {
                return Ok(true);
            }
        }
        if self.lines[idx].is_gone() {
            // What it said before it ended has been taken in.
            let change = self.lines[idx].peer.on_leaving(PeerState::Down);
            self.apply(idx, change)?;
        }
        Ok(false)
    }

    /// Counts a frame that cannot be read. One of another version is told so.
    fn reject(&mut self, idx: usize, error: &WireError) {
        self.rejected.count(error);
        // While the peer itself speaks, it is somebody else who says so.
        let is_up = self.lines[idx].peer.state == PeerState::Up;
        if let WireError::Version { found } = error
            && !is_up
        {
            let peer = &mut self.lines[idx].peer;
            let reason = format!(
                "machine '{}' runs blindgrasp {} with link protocol {}, machine '{}' link protocol {found}: install the \
                 same version on both",
                self.config.machine,
                env!("CARGO_PKG_VERSION"),
                super::wire::PROTOCOL,
                peer.config.machine
            );
            self.refuse(idx, &reason);
        }
    }

    /// Tells a peer why it is not talked to; said here as well, but not as often as it tries.
    fn refuse(&mut self, idx: usize, reason: &str) {
        let line = &mut self.lines[idx];
        if line.refusal_said.is_none_or(|said| said.elapsed() > REFUSAL_PAUSE) {
            line.refusal_said = Some(Instant::now());
            tracing::error!("machine '{}' is refused: {reason}", line.peer.config.machine);
        }
        line.peer.state = PeerState::Refused;
        line.peer.reason = Some(reason.into());
        line.put(KeyKind::Link, &encode_refusal(reason));
    }

    fn on_frame(&mut self, idx: usize, kind: KeyKind, frame: Frame<'_>) -> anyhow::Result<()> {
        let now_nanos = monotonic_nanos();
        let Frame { instance, counter, body } = frame;
        let peer = &mut self.lines[idx].peer;
        if let Body::Hello(hello) = &body {
            let (change, is_to_answer) = match peer.on_hello(&self.own, instance, counter, hello, now_nanos) {
                Ok(taken) => taken,
                Err(Rejection::Refused(reason)) => {
                    self.rejected.version += 1;
                    self.refuse(idx, &reason);
                    (Some(Change::CutOff), false)
                }
                Err(_) => {
                    self.rejected.replayed += 1;
                    return Ok(());
                }
            };
            self.apply(idx, change)?;
            if is_to_answer {
                let hello = self.lines[idx].peer.hello(&self.own, now_nanos);
                self.say(idx, KeyKind::Link, hello)?;
            }
            return Ok(());
        }
        let change = match peer.on_frame(kind, instance, counter, now_nanos) {
            Ok(change) => change,
            Err(Rejection::Replayed) => {
                self.rejected.replayed += 1;
                return Ok(());
            }
            Err(_) => {
                self.rejected.stale += 1;
                return Ok(());
            }
        };
        self.apply(idx, change)?;
        self.on_body(idx, body, now_nanos)
    }

    fn on_body(&mut self, idx: usize, body: Body<'_>, now_nanos: u64) -> anyhow::Result<()> {
        let line = &mut self.lines[idx];
        match body {
            Body::Hello(_) => {}
            Body::Ping { sent_nanos } => {
                line.peer.echo_nanos = line.peer.echo_nanos.max(sent_nanos);
                let pong = Body::Pong { sent_nanos, received_nanos: now_nanos, answered_nanos: monotonic_nanos() };
                self.say(idx, KeyKind::Link, pong)?;
            }
            Body::Pong { sent_nanos, received_nanos, answered_nanos } => {
                if !line.peer.clock.add(sent_nanos, received_nanos, answered_nanos, now_nanos) {
                    self.rejected.malformed += 1;
                }
            }
            Body::Resume { channel, run, after } => {
                if let Some(export) = line.exports.get_mut(usize::from(channel)) {
                    export.outgoing().on_resume(run, after.map(SampleId::from));
                }
            }
            Body::Sample(frame) => self.on_sample(idx, &frame, now_nanos)?,
            Body::Ack { channel, run, n_received, answered } => {
                if let Some(export) = line.exports.get_mut(usize::from(channel)) {
                    export.outgoing().on_ack(run, n_received, answered.map(SampleId::from), now_nanos);
                    export.commit();
                }
            }
            Body::End { channel, run, .. } => {
                if let Some(import) = line.imports.get_mut(usize::from(channel))
                    && import.incoming().on_end(run)
                {
                    let port = import.channel().port.clone();
                    if self.ended_ports.insert(port.clone()) {
                        self.operator.ended(self.ended_ports.iter().cloned().collect());
                    }
                    self.say(idx, KeyKind::Link, Body::Ended { channel })?;
                }
            }
            Body::Ended { channel } => {
                if let Some(export) = line.exports.get_mut(usize::from(channel)) {
                    export.outgoing().on_ended();
                }
            }
            Body::Leaving => {
                let change = line.peer.on_leaving(PeerState::Left);
                if change.is_some() {
                    tracing::warn!("machine '{}' has left the graph", line.peer.config.machine);
                }
                self.apply(idx, change)?;
            }
        }
        Ok(())
    }

    fn on_sample(&mut self, idx: usize, frame: &SampleFrame<'_>, now_nanos: u64) -> anyhow::Result<()> {
        let line = &mut self.lines[idx];
        let Some(import) = line.imports.get_mut(usize::from(frame.channel)) else {
            self.rejected.malformed += 1;
            return Ok(());
        };
        if import.schema_id() != frame.schema_id {
            self.rejected.version += 1;
            return Ok(());
        }
        let estimate = line.peer.clock.estimate(now_nanos);
        let deadline_nanos = self.config.deadline_millis * 1_000_000;
        let is_answer = import.channel().is_to_source && bears_source_number(&import.channel().type_name);
        let origins = is_answer.then_some(&self.origins);
        let passage = Passage {
            arrival_nanos: now_nanos,
            echo_nanos: frame.echo_nanos,
            sent_nanos: frame.sent_nanos,
            age_nanos: frame.age_nanos,
        };
        let mut origin_of = |key: SampleId| {
            let passed_here = origins.and_then(|origins| origins.origin_nanos(&key));
            passed_here.unwrap_or_else(|| origin_on_arrival(&passage, estimate, deadline_nanos))
        };
        match import.accept(frame, &mut origin_of)? {
            Accepted::Yes | Accepted::Repeated | Accepted::Gap => {}
            // Asked for again, it would come again as it is: the readers see the gap.
            Accepted::Malformed => self.rejected.malformed += 1,
            Accepted::TooMany => self.n_flooded += 1,
            Accepted::UsedNumber => {
                let port = import.channel().port.clone();
                if self.ended_ports.insert(port.clone()) {
                    tracing::warn!(
                        "machine '{}' has begun anew, and {port} with the numbers of before, as a recording does that is \
                         played again: this machine's part of the graph ends, so that it can begin anew as well (run --stay)",
                        line.peer.config.machine
                    );
                    self.operator.ended(self.ended_ports.iter().cloned().collect());
                }
            }
        }
        Ok(())
    }

    /// What follows for the channels.
    fn apply(&mut self, idx: usize, change: Option<Change>) -> anyhow::Result<()> {
        let line = &mut self.lines[idx];
        let machine = &line.peer.config.machine;
        match change {
            None => return Ok(()),
            Some(Change::CutOff) => {
                if line.peer.state == PeerState::Down {
                    tracing::warn!("machine '{machine}' is cut off: nothing heard of it");
                }
                line.exports.iter_mut().for_each(|export| export.outgoing().cut_off());
                line.imports.iter_mut().for_each(|import| import.incoming().cut_off());
            }
            Some(change @ (Change::Found | Change::FoundAnew)) => {
                tracing::info!("machine '{machine}' is there");
                line.exports.iter_mut().for_each(|export| export.outgoing().cut_off());
                for import in &mut line.imports {
                    if change == Change::FoundAnew {
                        import.begin_anew();
                    }
                    import.incoming().reconnected();
                    if self.ended_ports.remove(&import.channel().port) {
                        self.operator.ended(self.ended_ports.iter().cloned().collect());
                    }
                }
            }
            Some(Change::Asked) => line.imports.iter_mut().for_each(|import| import.incoming().reconnected()),
        }
        Ok(())
    }

    /// Reads, sends, publishes, and says what is due to a peer; true if there is more to do at once.
    fn serve(&mut self, idx: usize) -> anyhow::Result<bool> {
        let now_nanos = monotonic_nanos();
        // What lies here unread was said, unless that goes on for ever.
        let line = &mut self.lines[idx];
        let heard_nanos = line.peer.last_heard_nanos.unwrap_or(0);
        let deadline_nanos = self.config.deadline_millis * 1_000_000;
        let is_behind =
            line.has_unread() && now_nanos.saturating_sub(heard_nanos) < N_DEADLINES_BEHIND * deadline_nanos;
        let change = if is_behind { None } else { line.peer.check_deadline(now_nanos) };
        self.apply(idx, change)?;
        let mut bodies = Vec::new();
        self.lines[idx].peer.due(&self.own, now_nanos, &mut bodies);
        for body in bodies {
            self.say(idx, KeyKind::Link, body)?;
        }
        self.tell_readers(idx, now_nanos);
        let is_busy = self.send_samples(idx)?;
        self.tend_imports(idx, now_nanos)?;
        Ok(is_busy)
    }

    /// Tells the readers of a peer's ports whether anything can come: a connection that is lost and found within the deadline
    /// is none of their business.
    fn tell_readers(&mut self, idx: usize, now_nanos: u64) {
        let is_ending = !self.ended_nodes.is_empty();
        let line = &mut self.lines[idx];
        let is_cut_off = match line.peer.state {
            PeerState::Up => false,
            PeerState::Left | PeerState::Refused => true,
            PeerState::Waiting | PeerState::Down => {
                let since_nanos = line.peer.last_heard_nanos.unwrap_or(self.started_nanos);
                now_nanos.saturating_sub(since_nanos) > self.config.deadline_millis * 1_000_000
            }
        };
        for import in &line.imports {
            // At the end of a graph the others leave first, and nobody is cut off.
            import.set_cut_off(is_cut_off && !(is_ending && self.ended_ports.contains(&import.channel().port)));
        }
    }

    fn send_samples(&mut self, idx: usize) -> anyhow::Result<bool> {
        let mut is_busy = false;
        for channel_idx in 0..self.lines[idx].exports.len() {
            let line = &mut self.lines[idx];
            let is_up = line.peer.state == PeerState::Up;
            let export = &mut line.exports[channel_idx];
            is_busy |= export.take_in(is_up, &mut self.origins)?;
            export.commit();
            if self.ended_nodes.contains(export.channel().node()) && export.has_taken_all() {
                let last = export.last();
                export.outgoing().end(last);
            }
            let channel = channel_idx as u16;
            if is_up {
                line.send_samples(channel, self.own.instance, &mut self.frame);
            }
            let outgoing = self.lines[idx].exports[channel_idx].outgoing();
            if is_up && let Some((run, last)) = outgoing.end_to_send(monotonic_nanos()) {
                self.say(idx, KeyKind::Link, Body::End { channel, run, last: last.map(Into::into) })?;
            }
        }
        Ok(is_busy)
    }

    fn tend_imports(&mut self, idx: usize, now_nanos: u64) -> anyhow::Result<()> {
        let is_up = self.lines[idx].peer.state == PeerState::Up;
        for channel_idx in 0..self.lines[idx].imports.len() {
            let channel = channel_idx as u16;
            let line = &mut self.lines[idx];
            let import = &mut line.imports[channel_idx];
            import.flush()?;
            let answered = import.answered();
            if is_up && let Some(progress) = import.incoming().ack_to_send(answered, now_nanos) {
                let answered = progress.answered.map(Into::into);
                let (run, n_received) = (progress.run, progress.n_received);
                self.say(idx, KeyKind::Link, Body::Ack { channel, run, n_received, answered })?;
            }
            let import = &mut self.lines[idx].imports[channel_idx];
            if is_up && let Some((run, after)) = import.incoming().resume_to_send(now_nanos) {
                self.say(idx, KeyKind::Link, Body::Resume { channel, run, after: after.map(Into::into) })?;
            }
        }
        Ok(())
    }

    /// Whether all that has to go has gone, as far as there is somebody to take it. That a node has ended may be said after
    /// the signal that asks for an end.
    fn has_nothing_left(&self) -> bool {
        self.lines.iter().all(|line| {
            let is_away = match line.peer.state {
                PeerState::Up => false,
                PeerState::Down => {
                    line.peer.last_heard_nanos.is_none_or(|last| monotonic_nanos().saturating_sub(last) > AWAY_NANOS)
                }
                PeerState::Waiting | PeerState::Left | PeerState::Refused => true,
            };
            let has_gone = |export: &dyn Export| self.has_ended(export) && (is_away || export.status().is_done());
            line.exports.iter().all(|export| has_gone(export.as_ref()))
        })
    }

    fn has_ended(&self, export: &dyn Export) -> bool {
        self.ended_nodes.contains(export.channel().node())
    }

    fn tell_launcher(&mut self) {
        let needed = || self.lines.iter().filter(|line| line.peer.is_needed());
        if !self.is_connected && self.own.is_ready {
            if needed().all(|line| line.peer.is_ready()) {
                self.is_connected = true;
                // First: a graph that ends sooner than the next report comes would take the machine for one that is away.
                self.report_status();
                self.operator.connected();
            } else if !self.has_said_waiting && self.started.elapsed() > SAY_WAITING {
                self.has_said_waiting = true;
                let missing: Vec<_> = needed()
                    .filter(|line| !line.peer.is_ready())
                    .map(|line| line.peer.config.machine.as_str())
                    .collect();
                tracing::warn!("waiting for machine {}", missing.join(", "));
            }
        }
        if self.last_status.elapsed() >= STATUS_PAUSE {
            self.report_status();
        }
    }

    /// Counts as lost what nobody will send any more.
    fn give_up(&mut self) {
        self.lines.iter_mut().flat_map(|line| &mut line.exports).for_each(|export| export.outgoing().give_up());
    }

    fn report_status(&mut self) {
        self.last_status = Instant::now();
        let now_nanos = monotonic_nanos();
        let mut rejected = self.rejected.by_why();
        let overrun = self.lines.iter().map(|line| line.n_overrun()).sum::<u64>();
        for (why, count) in self.opening.rejected() {
            *rejected.entry(why).or_default() += count;
        }
        let stale =
            self.lines.iter().flat_map(|line| &line.imports).map(|import| import.status().n_stale()).sum::<u64>();
        *rejected.entry("stale".into()).or_default() += stale;
        if self.n_flooded > 0 {
            *rejected.entry("flooded".into()).or_default() += self.n_flooded;
        }
        if overrun > 0 {
            rejected.insert("overrun".into(), overrun);
        }
        self.operator.has_link_status(LinkStatus {
            machine: self.config.machine.clone(),
            namespace: self.config.namespace.clone(),
            peers: self.lines.iter().map(|line| line.status(now_nanos)).collect(),
            rejected,
        });
    }
}

/// How far it is with Zenoh.
enum Opening {
    /// A thread tries until there is a session: without a router that takes as long as that does.
    Trying(Receiver<anyhow::Result<zenoh::Session>>),
    /// It is there.
    Open { tunnels: Tunnels, _session: zenoh::Session },
}

impl Opening {
    /// Only a router that does not answer is waited for: other machines may come later.
    fn start(config: &Arc<LinkConfig>, operator: &Operator) -> anyhow::Result<Opening> {
        let (sender, receiver) = channel();
        let (config, waker) = (Arc::clone(config), operator.waker()?);
        std::thread::spawn(move || {
            let mut said: Option<Instant> = None;
            loop {
                let opened = session::open(&config);
                let is_passing = opened.as_ref().is_err_and(|error| error.is_passing());
                if let Err(error) = opened.as_ref().map_err(|error| error.to_string())
                    && is_passing
                {
                    if said.is_none_or(|said| said.elapsed() > SAY_AGAIN) {
                        said = Some(Instant::now());
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

    /// The session, when it has just been opened.
    fn session(&self) -> anyhow::Result<Option<zenoh::Session>> {
        match self {
            Opening::Trying(receiver) => receiver.try_recv().ok().transpose(),
            Opening::Open { .. } => Ok(None),
        }
    }

    fn rejected(&self) -> BTreeMap<String, u64> {
        match self {
            Opening::Trying(_) => BTreeMap::new(),
            Opening::Open { tunnels, .. } => tunnels.rejected(),
        }
    }
}

fn wall_nanos() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |elapsed| elapsed.as_nanos() as u64)
}
