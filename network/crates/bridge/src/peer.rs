//! The state of another machine's link: its identity, whether it is up, and which frames it has heard. This module does
//! no I/O; times are CLOCK_BOOTTIME.

use std::collections::VecDeque;

use super::agreement::{Agreement, PublicKey};
use super::clock::ClockOffset;
use super::sample::schema_id;
use super::wire::{Body, ExportedChannel, Hello};
use blindgrasp_graph::link::config::{Channel, KeyKind};
use blindgrasp_operator::link_status::PeerState;

/// Interval of hellos to a peer that has not answered.
const HELLO_PAUSE_NANOS: u64 = 250_000_000;
/// Interval of hellos to a peer that is up.
const HELLO_PAUSE_UP_NANOS: u64 = 1_000_000_000;
/// So many pings are sent within a deadline, or more. They tell the peer that this link is alive.
const N_PINGS_PER_DEADLINE: u64 = 6;
/// A peer that is new answers so many pings, for a good estimate of its clock.
const N_FIRST_PONGS: u64 = 64;
/// Interval of its answers from then on, which follow the drift of its clock.
const PONG_PAUSE_NANOS: u64 = 250_000_000;
/// A peer proves with each hello that its certificate is still valid. Its keys count for this long without a hello, and
/// for the peer's deadline on top.
const PROOF_NANOS: u64 = 10 * HELLO_PAUSE_UP_NANOS;
/// Number of ended instances of a peer that are remembered, so that their frames cannot be replayed.
const N_REMEMBERED: usize = 64;

/// The identity and the state of this link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Own {
    pub instance: u64,
    pub machine: String,
    /// A hash of the parts of the dataflow file that all machines must have in common.
    pub fingerprint: u64,
    /// This run of this machine's part of the graph.
    pub run: u64,
    /// Whether the operators here are ready.
    pub is_ready: bool,
    /// Until this time, peers are told often that the operators are ready, because one frame may be lost.
    pub is_eager_until_nanos: u64,
}

/// Another machine as seen by this link.
#[derive(Debug, Default)]
pub struct Peer {
    /// Its name.
    pub machine: String,
    pub clock: ClockOffset,
    /// Its version of blindgrasp.
    pub version: Option<String>,
    pub state: PeerState,
    /// The reason if it is refused.
    pub reason: Option<String>,
    /// Number of times that it came up.
    pub n_times_up: u64,
    /// Bytes of the frames to it and from it.
    pub bytes: [u64; 2],
    /// The latest time of its clock in its pings.
    pub echo_nanos: u64,
    pub last_heard_nanos: Option<u64>,
    exports: Vec<Channel>,
    imports: Vec<Channel>,
    deadline_nanos: u64,
    instance: Option<u64>,
    /// An instance that has sent a hello and has not heard this link yet.
    candidate: Option<u64>,
    candidate_key: Option<PublicKey>,
    /// `None` if this machine has no keys.
    agreement: Option<Agreement>,
    /// The time of the last hello of its process in use.
    proved_nanos: u64,
    /// The run of its part of the graph.
    run: Option<u64>,
    is_ready: bool,
    /// The last counter of each key, by [`key_idx`].
    heard: [u64; 2],
    said: [u64; 2],
    /// Ended instances.
    past: VecDeque<u64>,
    last_hello_nanos: Option<u64>,
    last_ping_nanos: Option<u64>,
    /// It came up again after it was cut off here alone: it does not know that its requests for samples no longer count.
    lacks_request: bool,
    n_pongs: u64,
    last_pong_nanos: u64,
}

/// A change of a peer's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// It is up, for the first time or again. Frames that were on their way may be lost.
    Found,
    /// It is up with a new run of its part of the graph. Its earlier samples no longer count.
    FoundAnew,
    /// It is up and had lost this link meanwhile. It waits until its samples are requested.
    Asked,
    /// It is silent, gone or refused.
    CutOff,
}

/// Why a frame is rejected.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Rejection {
    /// It was sent before.
    Replayed,
    /// Its instance has not sent a hello.
    Stranger,
    /// No keys can be agreed on with it.
    Keyless,
    /// A hello of another graph or version. The text is shown on both machines.
    Refused(String),
}

fn key_idx(kind: KeyKind) -> usize {
    usize::from(kind == KeyKind::Data)
}

impl Peer {
    /// A peer that has not been found yet. `exports` go to it, `imports` come from it. With an agreement, callers hand
    /// over verified hellos only.
    pub fn new(
        machine: String,
        exports: Vec<Channel>,
        imports: Vec<Channel>,
        deadline_nanos: u64,
        agreement: Option<Agreement>,
    ) -> Peer {
        Peer { machine, exports, imports, deadline_nanos, agreement, ..Peer::default() }
    }

    /// Whether it is up and its operators are ready.
    pub fn is_ready(&self) -> bool {
        self.state == PeerState::Up && self.is_ready
    }

    /// Whether there are edges between it and this machine.
    pub fn is_needed(&self) -> bool {
        !self.exports.is_empty() || !self.imports.is_empty()
    }

    /// The number of the next frame under a key.
    pub fn next_counter(&mut self, kind: KeyKind) -> u64 {
        let said = &mut self.said[key_idx(kind)];
        *said += 1;
        *said
    }

    /// Adds the frames that are due.
    pub fn due(&mut self, own: &Own, now_nanos: u64, bodies: &mut Vec<Body<'static>>) {
        let is_due = |last: Option<u64>, pause: u64| last.is_none_or(|last| now_nanos.saturating_sub(last) >= pause);
        if is_due(self.last_hello_nanos, self.hello_pause_nanos(own.is_eager_until_nanos, now_nanos)) {
            bodies.push(self.hello(own, now_nanos));
        }
        if self.instance.is_some() && is_due(self.last_ping_nanos, self.ping_pause_nanos()) {
            self.last_ping_nanos = Some(now_nanos);
            bodies.push(Body::Ping { sent_nanos: now_nanos });
        }
    }

    fn ping_pause_nanos(&self) -> u64 {
        (self.deadline_nanos / N_PINGS_PER_DEADLINE).min(PONG_PAUSE_NANOS)
    }

    /// Whether a ping of the peer is answered. A ping alone shows that it is alive, and so few answers measure the clock.
    pub fn answers_ping(&mut self, now_nanos: u64) -> bool {
        let is_due = self.n_pongs < N_FIRST_PONGS || now_nanos.saturating_sub(self.last_pong_nanos) >= PONG_PAUSE_NANOS;
        if is_due {
            self.n_pongs += 1;
            self.last_pong_nanos = now_nanos;
        }
        is_due
    }

    /// When the next frame is due or the peer's deadline passes.
    pub fn next_due_nanos(&self) -> u64 {
        // If the peer is up, this may be too early; then nothing is sent.
        let hello = self.last_hello_nanos.map_or(0, |last| last + self.hello_pause_nanos(0, last));
        let ping = match self.instance {
            Some(_) => self.last_ping_nanos.map_or(0, |last| last + self.ping_pause_nanos()),
            None => u64::MAX,
        };
        let deadline = match (self.state, self.last_heard_nanos) {
            (PeerState::Up, Some(last)) => last + self.deadline_nanos + 1,
            _ => u64::MAX,
        };
        hello.min(ping).min(deadline)
    }

    /// Hellos are also sent while the peer is up, so that a frame which one side missed does no lasting harm.
    fn hello_pause_nanos(&self, eager_until_nanos: u64, now_nanos: u64) -> u64 {
        match self.state {
            PeerState::Up if now_nanos >= eager_until_nanos => HELLO_PAUSE_UP_NANOS,
            _ => HELLO_PAUSE_NANOS,
        }
    }

    /// The hello of this link.
    pub fn hello(&mut self, own: &Own, now_nanos: u64) -> Body<'static> {
        self.last_hello_nanos = Some(now_nanos);
        let exports = self.exports.iter().map(|channel| ExportedChannel {
            port: channel.port.clone(),
            type_name: channel.type_name.clone(),
            schema_id: schema_id(&channel.type_name).unwrap_or_default(),
        });
        let keys = self.agreement.as_ref().map(|agreement| agreement.for_hello(self.candidate_key));
        Body::Hello(Hello {
            version: env!("CARGO_PKG_VERSION").into(),
            machine: own.machine.clone(),
            heard: self.candidate.or(self.instance),
            key: keys.map(|(own, _)| own),
            heard_key: keys.and_then(|(_, heard)| heard),
            fingerprint: own.fingerprint,
            run: own.run,
            is_cut_off: self.state != PeerState::Up,
            lacks_request: self.lacks_request,
            exports: exports.collect(),
            is_ready: own.is_ready,
        })
    }

    /// Checks a frame that is not a hello.
    ///
    /// # Errors
    /// The frame must be dropped.
    pub fn on_frame(
        &mut self,
        kind: KeyKind,
        instance: u64,
        counter: u64,
        now_nanos: u64,
    ) -> Result<Option<Change>, Rejection> {
        if self.instance != Some(instance) || matches!(self.state, PeerState::Waiting | PeerState::Refused) {
            return Err(if self.past.contains(&instance) { Rejection::Replayed } else { Rejection::Stranger });
        }
        self.count(kind, counter)?;
        self.last_heard_nanos = Some(now_nanos);
        Ok((self.state == PeerState::Down).then(|| {
            self.come_up();
            self.ask_for_requests();
            Change::Found
        }))
    }

    /// Has the next hello, which is due at once, ask for a request. Hellos repeat it until [`Peer::on_requests`].
    fn ask_for_requests(&mut self) {
        self.lacks_request = !self.exports.is_empty();
        self.last_hello_nanos = None;
    }

    /// It has requested the samples of each channel.
    pub fn on_requests(&mut self) {
        self.lacks_request = false;
    }

    /// Takes a hello; the second value is whether it must be answered.
    ///
    /// # Errors
    /// The hello was sent before, or the peer has another dataflow file or version.
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
        // Only a hello that answers this instance replaces the earlier instance. A hello to another instance may be a
        // replay, and so may one that answers keys of before.
        let is_in_use = self.instance == Some(instance);
        if let Some(agreement) = &mut self.agreement
            && is_in_use
            && hello.heard == Some(own.instance)
            && agreement.is_from_settled(hello)
        {
            self.proved_nanos = now_nanos;
            agreement.set_valid(true);
        }
        let is_key_answered = self.agreement.as_ref().is_none_or(|agreement| agreement.is_answered(hello, is_in_use));
        if hello.heard != Some(own.instance) || !is_key_answered {
            // While the peer is up, a different hello changes nothing, because anyone could have sent it.
            if self.state != PeerState::Up
                && let Some(reason) = self.difference(own, hello)
            {
                return Err(Rejection::Refused(reason));
            }
            self.candidate = if is_in_use { None } else { Some(instance) };
            self.candidate_key = if is_in_use { None } else { hello.key };
            return Ok((None, true));
        }
        if let Some(reason) = self.difference(own, hello) {
            let was_up = self.state == PeerState::Up;
            (self.state, self.reason) = (PeerState::Refused, Some(reason.clone()));
            self.version = Some(hello.version.clone());
            return if was_up { Ok((Some(Change::CutOff), false)) } else { Err(Rejection::Refused(reason)) };
        }
        if !is_in_use {
            if let Some(agreement) = &mut self.agreement {
                agreement.settle(instance, hello.key.unwrap_or_default()).map_err(|_| Rejection::Keyless)?;
            }
            self.replace(instance, counter);
        }
        Ok(self.take_proved(hello, is_in_use, now_nanos))
    }

    /// Takes a hello of the instance that is in use now, and was so before with `was_in_use`; the second value is whether it
    /// must be answered.
    fn take_proved(&mut self, hello: &Hello, was_in_use: bool, now_nanos: u64) -> (Option<Change>, bool) {
        (self.candidate, self.candidate_key) = (None, None);
        self.proved_nanos = now_nanos;
        self.version = Some(hello.version.clone());
        self.is_ready = hello.is_ready;
        self.last_heard_nanos = Some(now_nanos);
        self.reason = None;
        let is_anew = self.run.replace(hello.run).is_some_and(|before| before != hello.run);
        if self.state == PeerState::Up && !is_anew {
            let is_asked = hello.is_cut_off || hello.lacks_request;
            return (is_asked.then_some(Change::Asked), hello.is_cut_off);
        }
        self.come_up();
        // It may not know that it was cut off or refused here. A new instance requests samples by itself.
        if was_in_use && !is_anew && !hello.is_cut_off {
            self.ask_for_requests();
        }
        (Some(if is_anew { Change::FoundAnew } else { Change::Found }), true)
    }

    /// Notes why a hello in the peer's name was not believed. Only the state of a peer that was never found depends on it.
    pub fn on_unverified(&mut self, reason: &str) {
        if matches!(self.state, PeerState::Waiting | PeerState::Refused) {
            (self.state, self.reason) = (PeerState::Refused, Some(reason.into()));
        }
    }

    /// Takes a refusal in the peer's name, which nobody has signed, unless the peer is up; returns whether its reason is new.
    /// Only the state of a peer that was never found depends on it.
    pub fn on_refusal(&mut self, reason: &str) -> bool {
        let reason = format!("it refuses: {reason}");
        if self.state == PeerState::Up || self.reason.as_ref() == Some(&reason) {
            return false;
        }
        if self.state == PeerState::Waiting {
            self.state = PeerState::Refused;
        }
        self.reason = Some(reason);
        true
    }

    /// The peer has left the graph (`Left`), or its process has ended (`Down`).
    pub fn on_leaving(&mut self, state: PeerState) -> Option<Change> {
        let was_up = self.state == PeerState::Up;
        if matches!(self.state, PeerState::Up | PeerState::Down) {
            self.state = state;
        }
        was_up.then_some(Change::CutOff)
    }

    /// Checks whether the peer has been silent for too long, or has not proved itself for too long: then it is not heard
    /// any more.
    pub fn check_deadline(&mut self, now_nanos: u64) -> Option<Change> {
        if let Some(agreement) = &mut self.agreement
            && now_nanos.saturating_sub(self.proved_nanos) > PROOF_NANOS.saturating_add(self.deadline_nanos)
        {
            agreement.set_valid(false);
        }
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
        self.n_pongs = 0;
        // Without a ping at once, its first samples would have no age.
        self.last_ping_nanos = None;
        self.lacks_request = false;
        if self.state == PeerState::Up {
            self.state = PeerState::Down;
        }
    }

    fn come_up(&mut self) {
        self.state = PeerState::Up;
        self.n_times_up += 1;
    }

    /// The reason why this hello is of another graph or version, if it is.
    fn difference(&self, own: &Own, hello: &Hello) -> Option<String> {
        if hello.machine != self.machine {
            return Some(format!(
                "its hello names machine '{}', but came under the key of machine '{}'",
                hello.machine, self.machine
            ));
        }
        if hello.fingerprint != own.fingerprint {
            return Some(format!(
                "machine '{}' ({}) and machine '{}' ({}) have different dataflow files: the nodes, their machines and \
                 their inputs must be the same on both; copy one file to both machines",
                own.machine,
                env!("CARGO_PKG_VERSION"),
                hello.machine,
                hello.version
            ));
        }
        let expected = self.imports.iter().map(|channel| (&channel.port, &channel.type_name));
        let sent = hello.exports.iter().map(|channel| (&channel.port, &channel.type_name));
        if !expected.eq(sent) {
            return Some(format!(
                "machine '{}' does not send the ports that this machine reads; copy one dataflow file to both machines",
                hello.machine
            ));
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
pub(crate) mod tests;
