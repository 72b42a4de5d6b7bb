//! One end of a tunnel: pieces of a stream in order, none missing, no more on the way than the other end can hold.

use std::collections::VecDeque;
use std::sync::Arc;

use tokio::sync::mpsc::{Receiver, Sender};
use tokio::time::{Instant, MissedTickBehavior};

use super::frame::{Body, Frame, MAX_REASON_BYTES};
use super::{ALIVE_PAUSE, OPEN_LIMIT, Peer, Place, SILENCE_LIMIT, Shared, WINDOW};

/// What the other end has said.
pub(super) enum Heard {
    Opened { token: u64 },
    Data { index: u64, bytes: Vec<u8> },
    Credit { n_taken: u64 },
    Alive,
    Close { reason: Option<String> },
}

/// What goes to the other end.
pub(super) enum ToPeer {
    /// A piece of the stream, at most as long as a frame may be.
    Chunk(Vec<u8>),
    /// What follows is bulk: it goes after everything else.
    Bulk,
}

/// What comes from the other end.
pub(super) enum FromPeer {
    Chunk(Vec<u8>),
    /// The tunnel has ended before its time: why.
    Failed(String),
}

/// An end of a tunnel.
pub(super) struct End {
    place: Place,
    shared: Arc<Shared>,
    token: u64,
    inbox: Receiver<Heard>,
    /// Pieces sent, and how many of them the other end has taken.
    n_sent: u64,
    n_credited: u64,
    /// Pieces received, how many of them were taken here, and how many of those the other end knows of.
    n_received: u64,
    n_taken: u64,
    n_told: u64,
    received: VecDeque<Vec<u8>>,
    last_heard: Instant,
    is_bulk: bool,
    /// It is to be bulk as soon as the other end has taken all that went before: priorities overtake each other.
    will_be_bulk: bool,
}

/// How the other end has closed.
struct Closed {
    reason: Option<String>,
}

impl End {
    pub(super) fn new(place: Place, token: u64, inbox: Receiver<Heard>, shared: Arc<Shared>) -> End {
        End {
            place,
            shared,
            token,
            inbox,
            n_sent: 0,
            n_credited: 0,
            n_received: 0,
            n_taken: 0,
            n_told: 0,
            received: VecDeque::new(),
            last_heard: Instant::now(),
            is_bulk: false,
            will_be_bulk: false,
        }
    }

    pub(super) fn peer(&self) -> &Arc<Peer> {
        &self.place.peer
    }

    /// Asks the other machine for its end.
    ///
    /// # Errors
    /// It refuses, or does not answer, in words.
    pub(super) async fn open(&mut self) -> Result<(), String> {
        let machine = &self.peer().config.machine;
        let silent =
            format!("machine '{machine}' is cut off: it has not answered within {} s", OPEN_LIMIT.as_secs_f64());
        self.say(Body::Open);
        let limit = Instant::now() + OPEN_LIMIT;
        loop {
            match tokio::time::timeout_at(limit, self.inbox.recv()).await {
                Ok(Some(Heard::Opened { token })) => {
                    self.token = token;
                    self.last_heard = Instant::now();
                    return Ok(());
                }
                Ok(Some(Heard::Close { reason })) => return Err(reason.unwrap_or(silent)),
                Ok(Some(_)) => {}
                Ok(None) | Err(_) => return Err(silent),
            }
        }
    }

    /// To an asking end: here is the other.
    pub(super) fn answer(&self) {
        self.say(Body::Opened);
    }

    /// Carries the stream both ways until one side ends it. What was received before an orderly end is handed over.
    pub(super) async fn run(mut self, mut to_peer: Receiver<ToPeer>, from_peer: Sender<FromPeer>) {
        let mut alive = tokio::time::interval(ALIVE_PAUSE);
        alive.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut closed: Option<Closed> = None;
        loop {
            if self.received.is_empty()
                && let Some(closed) = closed
            {
                if let Some(reason) = closed.reason {
                    let _ = from_peer.send(FromPeer::Failed(reason)).await;
                }
                return;
            }
            let may_send = closed.is_none() && !self.will_be_bulk && self.n_sent - self.n_credited < WINDOW;
            let failed = tokio::select! {
                heard = self.inbox.recv(), if closed.is_none() => match heard {
                    Some(Heard::Close { reason }) => {
                        closed = Some(Closed { reason });
                        Ok(())
                    }
                    Some(heard) => self.hear(heard),
                    None => Err("this machine's link has ended".to_string()),
                },
                permit = from_peer.reserve() , if !self.received.is_empty() => match (permit, self.received.pop_front()) {
                    (Ok(permit), Some(bytes)) => {
                        permit.send(FromPeer::Chunk(bytes));
                        self.take_one();
                        Ok(())
                    }
                    _ => {
                        self.say(Body::Close { reason: None });
                        return;
                    }
                },
                piece = to_peer.recv(), if may_send => match piece {
                    Some(ToPeer::Chunk(bytes)) => {
                        self.say(Body::Data { index: self.n_sent, bytes: &bytes });
                        self.n_sent += 1;
                        Ok(())
                    }
                    Some(ToPeer::Bulk) => {
                        self.will_be_bulk = true;
                        self.go_bulk();
                        Ok(())
                    }
                    None => {
                        self.say(Body::Close { reason: None });
                        return;
                    }
                },
                () = from_peer.closed(), if closed.is_none() => {
                    self.say(Body::Close { reason: None });
                    return;
                }
                _ = alive.tick() => {
                    self.say(Body::Alive);
                    let silent = self.last_heard.elapsed();
                    let machine = &self.peer().config.machine;
                    if silent > SILENCE_LIMIT && closed.is_none() {
                        Err(format!("machine '{machine}' is cut off: nothing has come from it for {:.1} s", silent.as_secs_f64()))
                    } else {
                        Ok(())
                    }
                }
            };
            if let Err(reason) = failed {
                self.say(Body::Close { reason: Some(cut(&reason)) });
                // What came before is whole; that it is not all is said after it.
                closed = Some(Closed { reason: Some(reason) });
            }
        }
    }

    fn hear(&mut self, heard: Heard) -> Result<(), String> {
        self.last_heard = Instant::now();
        let machine = &self.place.peer.config.machine;
        match heard {
            Heard::Data { index, .. } if index < self.n_received => self.shared.reject("replayed"),
            Heard::Data { index, .. } if index > self.n_received => {
                return Err(format!("something of what machine '{machine}' said was lost on the way; try again"));
            }
            Heard::Data { .. } if self.n_received - self.n_taken >= WINDOW => {
                self.shared.reject("flooded");
                return Err(format!("machine '{machine}' sends more than it may"));
            }
            Heard::Data { bytes, .. } => {
                self.n_received += 1;
                self.received.push_back(bytes);
            }
            Heard::Credit { n_taken } => {
                self.n_credited = self.n_credited.max(n_taken.min(self.n_sent));
                self.go_bulk();
            }
            Heard::Opened { .. } | Heard::Alive | Heard::Close { .. } => {}
        }
        Ok(())
    }

    fn take_one(&mut self) {
        self.n_taken += 1;
        if self.received.is_empty() || self.n_taken - self.n_told >= WINDOW / 4 {
            self.n_told = self.n_taken;
            self.say(Body::Credit { n_taken: self.n_taken });
        }
    }

    fn go_bulk(&mut self) {
        if self.will_be_bulk && self.n_credited == self.n_sent {
            (self.is_bulk, self.will_be_bulk) = (true, false);
        }
    }

    fn say(&self, body: Body<'_>) {
        // The order matters between pieces of the stream and its end.
        let is_bulk = self.is_bulk && matches!(body, Body::Data { .. } | Body::Close { .. });
        let (is_from_asker, id) = self.place.at;
        self.peer().say(&Frame { id, token: self.token, is_from_asker, body }, is_bulk);
    }
}

/// As long as a reason may be.
fn cut(reason: &str) -> &str {
    let mut end = reason.len().min(MAX_REASON_BYTES);
    while !reason.is_char_boundary(end) {
        end -= 1;
    }
    &reason[..end]
}
