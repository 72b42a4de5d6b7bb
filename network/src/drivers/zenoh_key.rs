//! The driver for frames on a key of Zenoh, one a sample: the JSON of the [line protocol](blindgrasp_tactile::line_protocol), or
//! `blindgrasp_msgs/msg/TactileFrame` in CDR.

use std::sync::Arc;

use rustix::event::{PollFd, PollFlags};

use super::inbox::Inbox;
use blindgrasp_bridge::outside::{Rights, open};
use blindgrasp_graph::link::network::Network;
use blindgrasp_messages::TactileFrame;
use blindgrasp_recording::cdr;
use blindgrasp_tactile::line_protocol::{max_line_bytes, parse};
use blindgrasp_tactile::{
    Arrival, DriverError, Event, ExpectedHand, Place, Reading, Refusal, RefusalKind, TactileDriver,
};
use zenoh::Wait;

/// The bytes of a frame, none if there are too many, and their number.
type FrameBytes = (Vec<u8>, usize);
/// The begin of CDR, little endian. Nodes of ROS 2 name no encoding, and JSON begins in another way.
const CDR_BEGIN: [u8; 2] = [0, 1];

/// Reads frames from a key.
pub(crate) struct ZenohKey {
    network: Network,
    key: String,
    max_bytes: usize,
    hand: ExpectedHand,
    has_begun: bool,
    inbox: Option<Arc<Inbox<FrameBytes>>>,
    /// From the sender's numbers of frames to those of the source.
    offset: u64,
    pending: Option<Event>,
}

impl ZenohKey {
    /// A driver for a key expression. A frame that is too long is refused, and one that names another hand.
    ///
    /// # Errors
    /// It is no key expression.
    pub(crate) fn new(network: Network, key: String, hand: ExpectedHand) -> Result<Self, DriverError> {
        let error = zenoh::key_expr::KeyExpr::new(key.as_str()).err().map(|error| error.to_string());
        match error {
            Some(why) => Err(DriverError::Key { key, why }),
            None => Ok(ZenohKey {
                network,
                key,
                max_bytes: max_line_bytes(&hand),
                hand,
                has_begun: false,
                inbox: None,
                offset: 0,
                pending: None,
            }),
        }
    }
}

impl TactileDriver for ZenohKey {
    fn open(&mut self, _now_nanos: u64) -> Result<(), DriverError> {
        let inbox = Inbox::new().map_err(DriverError::Inbox)?;
        let (network, key, max_bytes) = (self.network.clone(), self.key.clone(), self.max_bytes);
        inbox.keep(format!("key {key}"), move |inbox| {
            let rights = Rights { takes: vec![key.clone()], ..Rights::default() };
            let session = open(&network, &rights).map_err(|error| error.to_string())?;
            let inbox = Arc::clone(inbox);
            let subscriber = session
                .declare_subscriber(key.clone())
                .callback(move |sample| {
                    // Of a frame that is too long, only the length matters.
                    let n_bytes = sample.payload().len();
                    let bytes = if n_bytes > max_bytes { vec![] } else { sample.payload().to_bytes().into_owned() };
                    inbox.put((bytes, n_bytes), n_bytes.min(max_bytes), true);
                })
                .wait()
                .map_err(|error| format!("key {key}: {error}"))?;
            Ok((session, subscriber))
        });
        (self.inbox, self.has_begun) = (Some(inbox), false);
        Ok(())
    }

    fn close(&mut self) {
        if let Some(inbox) = self.inbox.take() {
            inbox.close();
        }
    }

    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        fds.extend(self.inbox.iter().map(|inbox| PollFd::new(inbox.as_ref(), PollFlags::IN)));
    }

    fn due_nanos(&self) -> Option<u64> {
        None
    }

    fn poll(&mut self, _now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError> {
        if let Some(event) = self.pending.take() {
            return Ok(Some(event));
        }
        let Some(inbox) = &self.inbox else { return Ok(None) };
        if !std::mem::replace(&mut self.has_begun, true) {
            return Ok(Some(Event::Began));
        }
        let refused = |kind, why| Ok(Some(Event::Refused(Refusal { kind, why })));
        let ((bytes, n_bytes), at_nanos) = match inbox.next() {
            Ok(None) => return Ok(None),
            Ok(Some(next)) => next,
            Err(Refusal { kind, why }) => return refused(kind, why),
        };
        if n_bytes > self.max_bytes {
            let why = format!("{n_bytes} bytes, a frame of this hand has at most {}", self.max_bytes);
            return refused(RefusalKind::Oversized, why);
        }
        let reading = if bytes.starts_with(&CDR_BEGIN) { frame_of(&bytes) } else { parse(bytes.trim_ascii_end()) };
        match reading.and_then(|reading| self.hand.check(reading)) {
            Ok(mut reading) => {
                let last = place.seq;
                // A sender that was switched off and on counts from its first number again: a gap before that frame.
                let begins = reading
                    .seq
                    .is_some_and(|seq| seq <= 1 && last.is_some_and(|last| seq.saturating_add(self.offset) <= last));
                if begins {
                    self.offset = last.map_or(0, |last| last.saturating_add(2));
                }
                reading.seq = reading.seq.map(|seq| seq.saturating_add(self.offset));
                let frame = Event::Frame(reading, Arrival { at_nanos, waited_nanos: 0 });
                if begins {
                    self.pending = Some(frame);
                    return Ok(Some(Event::Began));
                }
                Ok(Some(frame))
            }
            Err(Refusal { kind, why }) => refused(kind, why),
        }
    }

    fn refused(&mut self, _refusal: &Refusal, _now_nanos: u64) {}
}

/// The reading in a message `blindgrasp_msgs/msg/TactileFrame`.
///
/// # Errors
/// It is no such message.
fn frame_of(bytes: &[u8]) -> Result<Reading, Refusal> {
    let found = cdr::decode::<TactileFrame>(bytes);
    let found = found.map_err(|why| Refusal::malformed(format!("not a TactileFrame in CDR: {why}")))?;
    let (header, frame) = (found.header, found.message);
    let hand = Some(header.hand_id).filter(|hand_id| *hand_id != 0).map(|hand_id| format!("{hand_id:016x}"));
    Ok(Reading {
        joints: frame.joints,
        cells_newtons: frame.cells_newtons,
        phase: frame.phase,
        senses: frame.senses,
        grasp_id: Some(frame.grasp_id),
        seq: Some(header.seq),
        stamp_nanos: Some(header.stamp_nanos).filter(|nanos| *nanos > 0),
        day: Some(frame.day).filter(|day| *day > 0),
        object: None,
        hand,
    })
}
