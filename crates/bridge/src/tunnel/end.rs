//! One end of a tunnel: it carries the pieces of a stream in order and complete, and never more than the other end can
//! hold.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use tokio::sync::mpsc::{Receiver, Sender};
use tokio::time::{Instant, MissedTickBehavior};

use super::frame::{Body, Frame, MAX_REASON_BYTES};
use super::{ALIVE_PAUSE, OPEN_LIMIT, Peer, Place, SILENCE_LIMIT, Shared, WINDOW};

pub(super) enum ToPeer {
    /// A piece of the stream, of at most [`MAX_CHUNK_BYTES`](super::frame::MAX_CHUNK_BYTES).
    Chunk(Vec<u8>),
    /// All further pieces are sent with the lowest priority.
    Bulk,
}

pub(super) enum FromPeer {
    Chunk(Vec<u8>),
    /// The tunnel has failed, for this reason.
    Failed(String),
}

pub(super) struct End {
    place: Place,
    shared: Arc<Shared>,
    token: u64,
    inbox: Receiver<Frame<'static>>,
    n_sent: u64,
    /// The number of sent pieces that the other end has taken.
    n_credited: u64,
    n_received: u64,
    /// The number of received pieces that were taken here.
    n_taken: u64,
    /// The number of taken pieces that the other end knows of.
    n_told: u64,
    received: VecDeque<Vec<u8>>,
    last_heard: Instant,
    is_bulk: bool,
    /// The end becomes bulk when the other end has taken all earlier pieces, because priorities overtake each other.
    will_be_bulk: bool,
}

/// How the tunnel was closed.
struct Closed {
    reason: Option<String>,
}

impl End {
    pub(super) fn new(place: Place, token: u64, inbox: Receiver<Frame<'static>>, shared: Arc<Shared>) -> End {
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

    /// Opens the tunnel from the asking end.
    ///
    /// # Errors
    /// The other machine refuses or does not answer, as a sentence for the user.
    pub(super) async fn open(&mut self) -> Result<(), String> {
        let machine = &self.peer().config.machine;
        let silent =
            format!("machine '{machine}' is cut off: it has not answered within {} s", OPEN_LIMIT.as_secs_f64());
        self.say(Body::Open);
        let limit = Instant::now() + OPEN_LIMIT;
        loop {
            match tokio::time::timeout_at(limit, self.inbox.recv()).await {
                Ok(Some(Frame { token, body: Body::Opened, .. })) => {
                    self.token = token;
                    self.last_heard = Instant::now();
                    return Ok(());
                }
                Ok(Some(Frame { body: Body::Close { reason }, .. })) => return Err(reason.unwrap_or(silent)),
                Ok(Some(_)) => {}
                Ok(None) | Err(_) => return Err(silent),
            }
        }
    }

    /// Tells the asking end that this end exists.
    pub(super) fn answer(&self) {
        self.say(Body::Opened);
    }

    /// Carries the stream in both directions until one side closes it. Pieces that arrived before an orderly close are
    /// handed over.
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
            let carried = tokio::select! {
                heard = self.inbox.recv(), if closed.is_none() => match heard {
                    Some(Frame { body: Body::Close { reason }, .. }) => {
                        closed = Some(Closed { reason });
                        Ok(())
                    }
                    Some(frame) => self.hear(frame.body),
                    None => Err("the link of this machine has ended".to_string()),
                },
                permit = from_peer.reserve(), if !self.received.is_empty() => match (permit, self.received.pop_front()) {
                    (Ok(permit), Some(bytes)) => {
                        permit.send(FromPeer::Chunk(bytes));
                        self.take_one();
                        Ok(())
                    }
                    _ => return self.say(Body::Close { reason: None }),
                },
                piece = to_peer.recv(), if may_send => match piece {
                    Some(ToPeer::Chunk(bytes)) => {
                        self.say(Body::Data { index: self.n_sent, bytes: Cow::Owned(bytes) });
                        self.n_sent += 1;
                        Ok(())
                    }
                    Some(ToPeer::Bulk) => {
                        self.will_be_bulk = true;
                        self.go_bulk();
                        Ok(())
                    }
                    None => return self.say(Body::Close { reason: None }),
                },
                () = from_peer.closed(), if closed.is_none() => return self.say(Body::Close { reason: None }),
                _ = alive.tick() => {
                    self.say(Body::Alive);
                    if closed.is_some() { Ok(()) } else { self.check_silence() }
                }
            };
            if let Err(mut reason) = carried {
                reason.truncate(reason.floor_char_boundary(MAX_REASON_BYTES));
                self.say(Body::Close { reason: Some(reason.clone()) });
                // The pieces that arrived before are handed over first, then the reason.
                closed = Some(Closed { reason: Some(reason) });
            }
        }
    }

    fn check_silence(&self) -> Result<(), String> {
        let silent = self.last_heard.elapsed();
        if silent <= SILENCE_LIMIT {
            return Ok(());
        }
        let (machine, secs) = (&self.peer().config.machine, silent.as_secs_f64());
        Err(format!("machine '{machine}' is cut off: nothing has come from it for {secs:.1} s"))
    }

    fn hear(&mut self, body: Body<'static>) -> Result<(), String> {
        self.last_heard = Instant::now();
        let machine = &self.place.peer.config.machine;
        match body {
            Body::Data { index, .. } if index < self.n_received => self.shared.reject("replayed"),
            Body::Data { index, .. } if index > self.n_received => {
                return Err(format!("a part of the stream from machine '{machine}' was lost on the way; try again"));
            }
            Body::Data { .. } if self.n_received - self.n_taken >= WINDOW => {
                self.shared.reject("flooded");
                return Err(format!("machine '{machine}' sends more than it may"));
            }
            Body::Data { bytes, .. } => {
                self.n_received += 1;
                self.received.push_back(bytes.into_owned());
            }
            Body::Credit { n_taken } => {
                self.n_credited = self.n_credited.max(n_taken.min(self.n_sent));
                self.go_bulk();
            }
            Body::Open | Body::Opened | Body::Alive | Body::Close { .. } => {}
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
        // Pieces of the stream and its end must stay in order, so that they have the same priority.
        let is_bulk = self.is_bulk && matches!(body, Body::Data { .. } | Body::Close { .. });
        let (is_from_asker, id) = self.place.at;
        self.peer().say(&Frame { id, token: self.token, is_from_asker, body }, is_bulk);
    }
}
