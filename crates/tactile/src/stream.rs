//! The driver for the [line protocol](super::line_protocol), over TCP, a unix socket or a serial device.
//!
//! There is one sender at a time. A sender without a frame for two seconds gives way to another one. The source never waits for it: answers that the sender does not read are dropped.

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsFd, OwnedFd};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, TryRecvError};

use rustix::event::{PollFd, PollFlags};
use rustix::io::Errno;

use super::line_protocol::{LineSplitter, Piece, busy_line, greeting, max_line_bytes, parse, refusal_line};
use super::link::{self, Listener};
use super::{Arrival, DriverError, Event, ExpectedHand, Place, Refusal, RefusalKind, TactileDriver};
use blindgrasp_operator::diagnostics::print_diagnostic;

/// The pause before a second try; each further pause is twice as long.
const FIRST_PAUSE_NANOS: u64 = 100_000_000;
/// The longest pause between two tries.
const LONGEST_PAUSE_NANOS: u64 = 5_000_000_000;
/// The pause between two looks whether a connection was made.
const CONNECTING_PAUSE_NANOS: u64 = 5_000_000;
/// The most bytes that wait for a sender that does not read; more are dropped.
const MAX_UNREAD_BYTES: usize = 16 << 10;
/// The most reads in a row from a connection that brings no whole line.
const MAX_READS: u32 = 16;
/// The most refusals that a sender is told in a second.
const N_TOLD_PER_SEC: u64 = 20;
const SEC_NANOS: u64 = 1_000_000_000;
/// A sender that has sent no frame for so long gives way to another one.
const SILENT_NANOS: u64 = 2_000_000_000;

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Link {
    /// Bridges connect to this address, like `127.0.0.1:7400` or `unix:/run/user/1000/hand.sock`.
    Listen { address: String },
    /// A bridge listens at this address, like `robot.local:7400`.
    Connect { address: String },
    /// A serial device like `/dev/ttyACM0`, at `baud` bits a second.
    Serial { device: PathBuf, baud: u32 },
}

/// Reads frames from a [`Link`].
pub struct Stream {
    link: Link,
    hand: ExpectedHand,
    idle_limit_nanos: Option<u64>,
    is_open: bool,
    listener: Option<Listener>,
    connecting: Option<Receiver<io::Result<OwnedFd>>>,
    connection: Option<Connection>,
    /// A second client. It gets the connection if the first one turns out to be gone.
    second: Option<(OwnedFd, String)>,
    /// Clients of other users that were turned away and not counted yet.
    n_turned_away: u64,
    /// The last time when no client was waiting.
    no_client_nanos: u64,
    retry: Retry,
}

/// The time of the next try, and the message about the last one.
#[derive(Default)]
struct Retry {
    at_nanos: u64,
    pause_nanos: u64,
    said: Option<String>,
}

impl Retry {
    /// Postpones the next try and prints why, but only once.
    fn later(&mut self, now_nanos: u64, why: &str) {
        self.pause_nanos = (2 * self.pause_nanos).clamp(FIRST_PAUSE_NANOS, LONGEST_PAUSE_NANOS);
        self.at_nanos = now_nanos + self.pause_nanos;
        if self.said.as_deref() != Some(why) {
            print_diagnostic(&format!("{why}; trying again"));
            self.said = Some(why.to_string());
        }
    }
}

struct Connection {
    fd: OwnedFd,
    peer: String,
    is_serial: bool,
    lines: LineSplitter,
    /// Answers that the sender has not read yet.
    unread: Vec<u8>,
    n_lines: u64,
    has_read: bool,
    /// The start of the current second, and the refusals told in it.
    told: (u64, u64),
    n_untold: u64,
    /// The last time when the input was empty.
    empty_nanos: u64,
    last_byte_nanos: u64,
    /// When it began or brought a frame.
    last_frame_nanos: u64,
    /// Why the connection ends, once it does.
    end: Option<String>,
}

impl Stream {
    /// A driver for a hand. A sender that is silent for `idle_limit_nanos` counts as gone.
    pub fn new(link: Link, hand: ExpectedHand, idle_limit_nanos: Option<u64>) -> Self {
        Stream {
            link,
            hand,
            idle_limit_nanos,
            is_open: false,
            listener: None,
            connecting: None,
            connection: None,
            second: None,
            n_turned_away: 0,
            no_client_nanos: 0,
            retry: Retry::default(),
        }
    }

    pub fn local_address(&self) -> Option<SocketAddr> {
        self.listener.as_ref().and_then(Listener::local_address)
    }

    fn listen(&mut self, address: &str, now_nanos: u64) -> Result<(), DriverError> {
        let listener =
            Listener::bind(address).map_err(|source| DriverError::Listen { address: address.into(), source })?;
        let bound = listener.local_address();
        print_diagnostic(&format!("listening on {}", bound.map_or(address.into(), |bound| bound.to_string())));
        if let Some(bound) = bound.filter(|bound| !bound.ip().is_loopback()) {
            print_diagnostic(&format!(
                "WARNING: any machine that reaches {bound} can send frames; the source does not check who sends"
            ));
        }
        self.listener = Some(listener);
        self.no_client_nanos = now_nanos;
        self.retry = Retry::default();
        Ok(())
    }

    /// Looks for a sender; returns whether there is one now.
    fn look_for_sender(&mut self, now_nanos: u64, place: &Place) -> bool {
        if let Some((stream, peer)) = self.second.take() {
            self.begin(stream, peer, false, self.no_client_nanos, now_nanos, place);
            return true;
        }
        if now_nanos < self.retry.at_nanos {
            return false;
        }
        match self.link.clone() {
            Link::Listen { address } => {
                if self.listener.is_none()
                    && let Err(error) = self.listen(&address, now_nanos)
                {
                    self.retry.later(now_nanos, &error.to_string());
                    return false;
                }
                let since_nanos = self.no_client_nanos;
                let Some((stream, peer)) = self.accept(now_nanos) else { return false };
                self.begin(stream, peer, false, since_nanos, now_nanos, place);
                true
            }
            Link::Connect { address } => {
                let Some(outcome) = &self.connecting else {
                    self.connecting = Some(link::connect(&address));
                    return false;
                };
                let outcome = match outcome.try_recv() {
                    Ok(outcome) => outcome,
                    Err(TryRecvError::Empty) => return false,
                    Err(TryRecvError::Disconnected) => Err(io::ErrorKind::Other.into()),
                };
                self.connecting = None;
                match outcome {
                    Ok(stream) => {
                        self.begin(stream, address, false, now_nanos, now_nanos, place);
                        true
                    }
                    Err(error) => {
                        self.retry.later(now_nanos, &format!("cannot connect to {address}: {error}"));
                        false
                    }
                }
            }
            Link::Serial { device, baud } => match link::open_serial(&device, baud) {
                Ok(fd) => {
                    let peer = format!("{} at {baud} baud", device.display());
                    self.begin(fd, peer, true, now_nanos, now_nanos, place);
                    true
                }
                Err(error) => {
                    self.retry.later(now_nanos, &format!("cannot open {}: {error}", device.display()));
                    false
                }
            },
        }
    }

    fn accept(&mut self, now_nanos: u64) -> Option<(OwnedFd, String)> {
        if now_nanos < self.retry.at_nanos {
            return None;
        }
        match self.listener.as_ref()?.accept() {
            Ok(accepted) => Some(accepted),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                self.no_client_nanos = now_nanos;
                None
            }
            // The client has gone again.
            Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => None,
            Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
                print_diagnostic(&format!("a client was turned away: {error}; expected one of this user"));
                self.n_turned_away += 1;
                None
            }
            Err(error) => {
                self.retry.later(now_nanos, &format!("cannot accept a connection: {error}"));
                None
            }
        }
    }

    fn begin(&mut self, fd: OwnedFd, peer: String, is_serial: bool, since_nanos: u64, now_nanos: u64, place: &Place) {
        print_diagnostic(&format!("connected: {peer}"));
        let mut connection = Connection {
            fd,
            peer,
            is_serial,
            lines: LineSplitter::new(max_line_bytes(&self.hand)),
            unread: Vec::new(),
            n_lines: 0,
            has_read: false,
            told: (now_nanos, 0),
            n_untold: 0,
            empty_nanos: since_nanos,
            last_byte_nanos: now_nanos,
            last_frame_nanos: now_nanos,
            end: None,
        };
        connection.send(&greeting(&self.hand, place));
        self.connection = Some(connection);
        self.retry.said = None;
    }

    /// The next event of the connection.
    fn next_of_connection(&mut self, now_nanos: u64) -> Option<Event> {
        let mut n_reads = 0;
        loop {
            let connection = self.connection.as_mut()?;
            if let Some(event) = connection.next_line(&self.hand, now_nanos) {
                return Some(event);
            }
            if let Some(end) = &connection.end {
                print_diagnostic(&format!("disconnected: {}: {end}", connection.peer));
                let is_cut_off = connection.lines.is_amid_a_line();
                // A connection that ended before its first reading is not tried again at once.
                if !connection.has_read && self.listener.is_none() {
                    self.retry.pause_nanos = (2 * self.retry.pause_nanos).clamp(FIRST_PAUSE_NANOS, LONGEST_PAUSE_NANOS);
                } else {
                    self.retry.pause_nanos = 0;
                }
                self.retry.at_nanos = now_nanos + self.retry.pause_nanos;
                self.connection = None;
                let why = "the connection ended amid a line".to_string();
                return is_cut_off.then_some(Event::Refused(Refusal { kind: RefusalKind::CutOff, why }));
            }
            connection.flush();
            if connection.read(now_nanos) {
                n_reads += 1;
                // A sender of empty lines, or of a line without end, must not keep the source from its other work.
                if n_reads == MAX_READS {
                    return connection.next_line(&self.hand, now_nanos);
                }
                continue;
            }
            if self.idle_limit_nanos.is_some_and(|limit| now_nanos.saturating_sub(connection.last_byte_nanos) > limit) {
                connection.end = Some("it was silent for idle_limit_ms".into());
                continue;
            }
            // The connection is alive, so a client that came before its input was empty is turned away.
            if let Some((stream, peer)) = self.second.take() {
                if now_nanos.saturating_sub(connection.last_frame_nanos) > SILENT_NANOS {
                    connection.end = Some("it has sent no frame for 2 s, and another client waits".into());
                    self.second = Some((stream, peer));
                    continue;
                }
                turn_away(&stream, &peer, &connection.peer);
                return Some(Event::TurnedAway);
            }
            self.second = self.accept(now_nanos);
            if self.n_turned_away > 0 {
                self.n_turned_away -= 1;
                return Some(Event::TurnedAway);
            }
            self.second.as_ref()?;
        }
    }
}

impl TactileDriver for Stream {
    fn open(&mut self, now_nanos: u64) -> Result<(), DriverError> {
        self.is_open = true;
        self.retry = Retry::default();
        match self.link.clone() {
            Link::Listen { address } => self.listen(&address, now_nanos),
            Link::Connect { .. } | Link::Serial { .. } => Ok(()),
        }
    }

    fn close(&mut self) {
        self.is_open = false;
        (self.listener, self.connecting, self.connection, self.second) = (None, None, None, None);
    }

    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        if let Some(listener) = self.listener.as_ref()
            && self.retry.at_nanos <= self.no_client_nanos
        {
            fds.push(PollFd::from_borrowed_fd(listener.as_fd(), PollFlags::IN));
        }
        if let Some(connection) = &self.connection {
            let is_full = !connection.unread.is_empty();
            let flags = if is_full { PollFlags::IN | PollFlags::OUT } else { PollFlags::IN };
            fds.push(PollFd::from_borrowed_fd(connection.fd.as_fd(), flags));
        }
    }

    fn due_nanos(&self) -> Option<u64> {
        match (&self.connection, &self.connecting) {
            _ if !self.is_open => None,
            (Some(connection), _) => Some(connection.last_byte_nanos + self.idle_limit_nanos? + 1),
            (None, Some(_)) => Some(self.no_client_nanos + CONNECTING_PAUSE_NANOS),
            (None, None) => Some(self.retry.at_nanos).filter(|at| *at > self.no_client_nanos),
        }
    }

    fn poll(&mut self, now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError> {
        if !self.is_open {
            return Ok(None);
        }
        if let Some(event) = self.next_of_connection(now_nanos) {
            return Ok(Some(event));
        }
        if self.connection.is_none() {
            let has_begun = self.look_for_sender(now_nanos, place);
            if !has_begun && self.n_turned_away > 0 {
                self.n_turned_away -= 1;
                return Ok(Some(Event::TurnedAway));
            }
            if self.listener.is_none() {
                self.no_client_nanos = now_nanos;
            }
            return Ok(has_begun.then_some(Event::Began));
        }
        Ok(None)
    }

    fn refused(&mut self, refusal: &Refusal, now_nanos: u64) {
        let Some(connection) = &mut self.connection else { return };
        if now_nanos.saturating_sub(connection.told.0) >= SEC_NANOS {
            connection.told = (now_nanos, 0);
        }
        let line = refusal_line(connection.n_lines, refusal, connection.n_untold);
        if connection.told.1 < N_TOLD_PER_SEC && connection.send(&line) {
            connection.told.1 += 1;
            connection.n_untold = 0;
        } else {
            connection.n_untold += 1;
        }
    }
}

impl Connection {
    fn next_line(&mut self, hand: &ExpectedHand, now_nanos: u64) -> Option<Event> {
        let piece = self.lines.next_piece()?;
        self.n_lines += 1;
        Some(match piece {
            Piece::TooLong => {
                let why = "longer than any frame of this hand: see max_line_bytes of the greeting".to_string();
                Event::Refused(Refusal { kind: RefusalKind::Oversized, why })
            }
            Piece::Line(line, since_nanos) => match parse(line).and_then(|reading| hand.check(reading)) {
                Ok(reading) => {
                    self.has_read = true;
                    self.last_frame_nanos = now_nanos;
                    let waited_nanos = now_nanos.saturating_sub(since_nanos);
                    Event::Frame(reading, Arrival { at_nanos: now_nanos, waited_nanos })
                }
                // A serial device sends all the time: its first line may be cut.
                Err(refusal) if self.is_serial && self.n_lines == 1 => {
                    Event::Refused(Refusal { kind: RefusalKind::CutOff, ..refusal })
                }
                Err(refusal) => Event::Refused(refusal),
            },
        })
    }

    /// Reads the bytes that are there; returns whether there were any.
    fn read(&mut self, now_nanos: u64) -> bool {
        match rustix::io::read(&self.fd, self.lines.space()) {
            Ok(0) => self.end = Some("it was closed".into()),
            Ok(n_bytes) => {
                self.lines.filled(n_bytes, self.empty_nanos);
                self.last_byte_nanos = now_nanos;
            }
            Err(Errno::AGAIN) => {
                self.empty_nanos = now_nanos;
                return false;
            }
            Err(Errno::INTR) => {}
            Err(error) => self.end = Some(error.to_string()),
        }
        true
    }

    /// Sends a whole line, or nothing if there is no room for it.
    fn send(&mut self, line: &str) -> bool {
        let has_room = self.unread.len() + line.len() <= MAX_UNREAD_BYTES;
        if has_room {
            self.unread.extend_from_slice(line.as_bytes());
            self.flush();
        }
        has_room
    }

    fn flush(&mut self) {
        while !self.unread.is_empty() {
            match rustix::io::write(&self.fd, &self.unread) {
                Ok(n_bytes @ 1..) => drop(self.unread.drain(..n_bytes)),
                // The next read finds the error.
                Ok(0) | Err(_) => return,
            }
        }
    }
}

/// Tells a second client why it is turned away, without waiting for it to read.
fn turn_away(stream: &OwnedFd, peer: &str, sender: &str) {
    print_diagnostic(&format!("{peer} was turned away: {sender} is connected"));
    let _ = rustix::io::write(stream, busy_line(sender).as_bytes());
}
