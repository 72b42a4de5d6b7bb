//! Another machine's link: who it is, whether it is there, what it has heard. Does no I/O; times are CLOCK_MONOTONIC.

use std::collections::VecDeque;

use super::clock::ClockOffset;
use super::config::{Channel, KeyKind, PeerConfig};
use super::sample::schema_id;
use super::wire::{Body, ExportedChannel, Hello};
use blindgrasp_operator::link_status::PeerState;

/// How often a link that has not been answered says who it is.
const HELLO_PAUSE_NANOS: u64 = 250_000_000;
/// The same while the peer is there.
const HELLO_PAUSE_UP_NANOS: u64 = 1_000_000_000;
/// How often it asks a peer for its clock, and thereby says that it is there.
const PING_PAUSE_NANOS: u64 = 25_000_000;
/// How many instances that are over are remembered, so that what they said cannot be said again.
const N_REMEMBERED: usize = 64;

/// What this side is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Own {
    /// This instance.
    pub instance: u64,
    /// This machine.
    pub machine: String,
    /// What the machines must have in common.
    pub fingerprint: u64,
    /// This run of this machine's part of the graph.
    pub run: u64,
    /// Whether the operators here are ready.
    pub is_ready: bool,
    /// Until when peers are told so again and again: the first time may be lost.
    pub is_eager_until_nanos: u64,
}

/// Another machine, as this link sees it.
#[derive(Debug)]
pub struct Peer {
    /// Its name, and what it may.
    pub config: PeerConfig,
    /// Its clock.
    pub clock: ClockOffset,
    /// Its version of blindgrasp.
    pub version: Option<String>,
    /// How it is.
    pub state: PeerState,
    /// Why it is refused.
    pub reason: Option<String>,
    /// How often it has been found.
    pub n_times_up: u64,
    /// Bytes of frames to it and from it.
    pub bytes: [u64; 2],
    /// The latest of its own clock that it has told us.
    pub echo_nanos: u64,
    /// When it last said something.
    pub last_heard_nanos: Option<u64>,
    exports: Vec<Channel>,
    imports: Vec<Channel>,
    deadline_nanos: u64,
    instance: Option<u64>,
    /// An instance that has said who it is, and has not heard this one yet.
    candidate: Option<u64>,
    /// Its run of its part of the graph.
    run: Option<u64>,
    is_ready: bool,
    /// The last counter of each key, by [`key_idx`].
    heard: [u64; 2],
    said: [u64; 2],
    /// Instances that are over.
    past: VecDeque<u64>,
    last_hello_nanos: Option<u64>,
    last_ping_nanos: Option<u64>,
}

/// What has happened to a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// It is there, for the first time or anew: what was on its way may be lost.
    Found,
    /// It is there with a new run of its part of the graph: nothing of what it sent before counts.
    FoundAnew,
    /// It is there, and had lost this side meanwhile: it wants to be asked for its samples.
    Asked,
    /// It is silent, gone, or of another kind.
    CutOff,
}

/// Why a frame is not taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Rejection {
    /// It was said before.
    Replayed,
    /// Of an instance that has not said who it is.
    Stranger,
    /// A hello of another graph or version: why, for both sides to read.
    Refused(String),
}

fn key_idx(kind: KeyKind) -> usize {
    usize::from(kind == KeyKind::Data)
}

impl Peer {
    /// A peer that has not been found. `exports` go to it, `imports` come from it.
    pub fn new(config: PeerConfig, exports: Vec<Channel>, imports: Vec<Channel>, deadline_nanos: u64) -> Peer {
        Peer {
            config,
            clock: ClockOffset::default(),
            version: None,
            state: PeerState::Waiting,
            reason: None,
            n_times_up: 0,
            bytes: [0; 2],
            echo_nanos: 0,
            last_heard_nanos: None,
            exports,
            imports,
            deadline_nanos,
            instance: None,
            candidate: None,
            run: None,
            is_ready: false,
            heard: [0; 2],
            said: [0; 2],
            past: VecDeque::new(),
            last_hello_nanos: None,
            last_ping_nanos: None,
        }
    }

    /// Whether it is there, and its operators are ready.
    pub fn is_ready(&self) -> bool {
        self.state == PeerState::Up && self.is_ready
    }

    /// Whether anything crosses between it and this machine.
    pub fn is_needed(&self) -> bool {
        !self.exports.is_empty() || !self.imports.is_empty()
    }

    /// The number of the next frame under a key.
    pub fn next_counter(&mut self, kind: KeyKind) -> u64 {
        let said = &mut self.said[key_idx(kind)];
        *said += 1;
        *said
    }

    /// What is to be said to it by now.
    pub fn due(&mut self, own: &Own, now_nanos: u64, bodies: &mut Vec<Body<'static>>) {
        let is_due = |last: Option<u64>, pause: u64| last.is_none_or(|last| now_nanos.saturating_sub(last) >= pause);
        if is_due(self.last_hello_nanos, self.hello_pause_nanos(own.is_eager_until_nanos, now_nanos)) {
            bodies.push(self.hello(own, now_nanos));
        }
        if self.instance.is_some() && is_due(self.last_ping_nanos, PING_PAUSE_NANOS) {
            self.last_ping_nanos = Some(now_nanos);
            bodies.push(Body::Ping { sent_nanos: now_nanos });
        }
    }

    /// When [`Peer::due`] has something next, or the peer's deadline passes.
    pub fn next_due_nanos(&self) -> u64 {
        // Sooner than it may be due, if the peer is up.
        let hello = self.last_hello_nanos.map_or(0, |last| last + self.hello_pause_nanos(0, last));
        let ping = match self.instance {
            Some(_) => self.last_ping_nanos.map_or(0, |last| last + PING_PAUSE_NANOS),
            None => u64::MAX,
        };
        let deadline = match (self.state, self.last_heard_nanos) {
            (PeerState::Up, Some(last)) => last + self.deadline_nanos + 1,
            _ => u64::MAX,
        };
        hello.min(ping).min(deadline)
    }

    /// Also while all is well: what either side did not hear of the other heals.
    fn hello_pause_nanos(&self, eager_until_nanos: u64, now_nanos: u64) -> u64 {
        match self.state {
            PeerState::Up if now_nanos >= eager_until_nanos => HELLO_PAUSE_UP_NANOS,
            _ => HELLO_PAUSE_NANOS,
        }
    }

    /// Who this side is.
    pub fn hello(&mut self, own: &Own, now_nanos: u64) -> Body<'static> {
        self.last_hello_nanos = Some(now_nanos);
        let exports = self.exports.iter().map(|channel| ExportedChannel {
            port: channel.port.clone(),
            type_name: channel.type_name.clone(),
            schema_id: schema_id(&channel.type_name).unwrap_or_default(),
        });
        Body::Hello(Hello {
            version: env!("CARGO_PKG_VERSION").into(),
            machine: own.machine.clone(),
            heard: self.candidate.or(self.instance),
            fingerprint: own.fingerprint,
            run: own.run,
            is_cut_off: self.state != PeerState::Up,
            exports: exports.collect(),
            is_ready: own.is_ready,
        })
    }

    /// Whether a frame other than a hello is to be taken, and what follows for the peer.
    ///
    /// # Errors
    /// It is not.
    pub fn on_frame(
        &mut self,
        kind: KeyKind,
        instance: u64,
        counter: u64,
        now_nanos: u64,
    ) -> Result<Option<Change>, Rejection> {
        if self.instance != Some(instance) || matches!(self.state, PeerState::Waiting | PeerState::Refused) {
            return Err(match self.past.contains(&instance) {
                true => Rejection::Replayed,
                false => Rejection::Stranger,
            });
        }
        self.count(kind, counter)?;
        self.last_heard_nanos = Some(now_nanos);
        Ok((self.state == PeerState::Down).then(|| {
            self.come_up();
            Change::Found
        }))
    }

    /// Takes a hello; the second value says whether it must be answered.
    ///
    /// # Errors
    /// It was said before, or the peer runs something else.
    pub fn on_hello(
        &mut self,
        own: &Own,
        instance: u64,
        counter: u64,
        hello: &Hello,
        now_nanos: u64,
    ) -> Result<(Option<Change>, bool), Rejection> {
        if self.past.contains(&instance) {
            return Err(Rejection::Replayed);
        }
        if self.state == PeerState::Left && self.instance == Some(instance) {
            return Ok((None, false));
        }
        if self.instance == Some(instance) {
            self.count(KeyKind::Link, counter)?;
        }
        // Only one that answers this very instance takes the place of the one before: what was said to others may be said
        // again by anybody.
        if hello.heard != Some(own.instance) {
            // It is told so, and, while the peer itself speaks, nothing more: anybody may say a hello.
            return match self.difference(own, hello).filter(|_| self.state != PeerState::Up) {
                Some(reason) => Err(Rejection::Refused(reason)),
                None => {
                    self.candidate = Some(instance).filter(|_| self.instance != Some(instance));
                    Ok((None, true))
                }
            };
        }
        if let Some(reason) = self.difference(own, hello) {
            let was_up = self.state == PeerState::Up;
            (self.state, self.reason) = (PeerState::Refused, Some(reason.clone()));
            self.version = Some(hello.version.clone());
            return match was_up {
                true => Ok((Some(Change::CutOff), false)),
                false => Err(Rejection::Refused(reason)),
            };
        }
        if self.instance != Some(instance) {
            self.replace(instance, counter);
        }
        self.candidate = None;
        self.version = Some(hello.version.clone());
        self.is_ready = hello.is_ready;
        self.last_heard_nanos = Some(now_nanos);
        self.reason = None;
        let is_anew = self.run.replace(hello.run).is_some_and(|before| before != hello.run);
        match self.state {
            PeerState::Up if !is_anew => Ok((hello.is_cut_off.then_some(Change::Asked), hello.is_cut_off)),
            _ => {
                self.come_up();
                Ok((Some(if is_anew { Change::FoundAnew } else { Change::Found }), true))
            }
        }
    }

    /// Takes a refusal by the other side, but for while that speaks with this one; whether it is a new one.
    pub fn on_refusal(&mut self, reason: &str) -> bool {
        let reason = format!("it refuses: {reason}");
        if self.state == PeerState::Up || self.reason.as_ref() == Some(&reason) {
            return false;
        }
        (self.state, self.reason) = (PeerState::Refused, Some(reason));
        true
    }

    /// Says that it has left the graph, or that its process has ended.
    pub fn on_leaving(&mut self, state: PeerState) -> Option<Change> {
        let was_up = self.state == PeerState::Up;
        if matches!(self.state, PeerState::Up | PeerState::Down) {
            self.state = state;
        }
        was_up.then_some(Change::CutOff)
    }

    /// Whether it has been silent for too long by now.
    pub fn check_deadline(&mut self, now_nanos: u64) -> Option<Change> {
        let is_silent = self.last_heard_nanos.is_none_or(|last| now_nanos.saturating_sub(last) > self.deadline_nanos);
        (self.state == PeerState::Up && is_silent).then(|| {
            self.state = PeerState::Down;
            Change::CutOff
        })
    }

    fn count(&mut self, kind: KeyKind, counter: u64) -> Result<(), Rejection> {
        let heard = &mut self.heard[key_idx(kind)];
        if counter <= *heard {
            return Err(Rejection::Replayed);
        }
        *heard = counter;
        Ok(())
    }

    fn replace(&mut self, instance: u64, counter: u64) {
        if let Some(before) = self.instance.replace(instance) {
            self.past.push_back(before);
            if self.past.len() > N_REMEMBERED {
                self.past.pop_front();
            }
        }
        self.heard = [counter, 0];
        self.echo_nanos = 0;
        self.clock = ClockOffset::default();
        if self.state == PeerState::Up {
            self.state = PeerState::Down;
        }
    }

    fn come_up(&mut self) {
        self.state = PeerState::Up;
        self.n_times_up += 1;
    }

    /// What makes it another graph's or version's, if something does.
    fn difference(&self, own: &Own, hello: &Hello) -> Option<String> {
        if hello.machine != self.config.machine {
            return Some(format!(
                "it says that it is machine '{}', but speaks as '{}'",
                hello.machine, self.config.machine
            ));
        }
        if hello.fingerprint != own.fingerprint {
            return Some(format!(
                "machine '{}' ({}) and machine '{}' ({}) have different dataflow files: nodes, where they run, and what \
                 they read must be the same on both",
                own.machine,
                env!("CARGO_PKG_VERSION"),
                hello.machine,
                hello.version
            ));
        }
        let expected = self.imports.iter().map(|channel| (&channel.port, &channel.type_name));
        let sent = hello.exports.iter().map(|channel| (&channel.port, &channel.type_name));
        if !expected.eq(sent) {
            return Some(format!("machine '{}' does not send the ports that are read here", hello.machine));
        }
        let mut types = hello.exports.iter();
        let other = types.find(|channel| schema_id(&channel.type_name) != Some(channel.schema_id))?;
        Some(format!(
            "machine '{}' ({}) and machine '{}' ({}) know different definitions of {}: install the same version on both",
            own.machine,
            env!("CARGO_PKG_VERSION"),
            hello.machine,
            hello.version,
            other.type_name
        ))
    }
}

#[cfg(test)]
mod tests;
