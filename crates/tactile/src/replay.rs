//! The driver that plays a recording at its own speed, as the hand sent it.

use std::path::{Path, PathBuf};

use rustix::event::PollFd;

use super::{Arrival, DriverError, Event, Place, Reading, Refusal, TactileDriver};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::hand::Hand;

/// Longer pauses between two recorded frames are cut to this: clocks jump, and robots are switched off overnight.
const LONGEST_PAUSE_NANOS: u64 = 10_000_000_000;

/// Plays a recording once.
pub struct Replay {
    path: PathBuf,
    reader: Option<RecordingReader>,
    is_at_its_beginning: bool,
    is_playing: bool,
    next: Option<Reading>,
    /// The time when the next frame is due, and its recorded time.
    due: Option<(u64, u64)>,
}

impl Replay {
    /// A driver for a recording of this hand.
    ///
    /// # Errors
    /// The recording cannot be read, or is of another hand.
    pub fn new(path: &Path, hand: &Hand) -> Result<Self, DriverError> {
        let info = RecordingReader::open(path)?.info().clone();
        if info.hand_id != hand.id() && info.hand_id != 0 {
            return Err(DriverError::OtherHand {
                path: path.display().to_string(),
                found: format!("{:016x} ({})", info.hand_id, info.hand),
                expected: format!("{:016x} ({})", hand.id(), hand.name),
            });
        }
        Ok(Replay {
            path: path.into(),
            reader: None,
            is_at_its_beginning: true,
            is_playing: false,
            next: None,
            due: None,
        })
    }

    /// Reads the next frame whose number is above `after`.
    fn advance(&mut self, after: Option<u64>) -> Result<(), DriverError> {
        while let Some(record) = self.reader.as_mut().and_then(Iterator::next) {
            let (_, record) = record?;
            if let Record::Tactile(frame) = record
                && after.is_none_or(|after| frame.header.seq > after)
            {
                let message = frame.message;
                self.next = Some(Reading {
                    joints: message.joints,
                    cells_newtons: message.cells_newtons,
                    senses: message.senses,
                    phase: message.phase,
                    grasp_id: Some(message.grasp_id),
                    seq: Some(frame.header.seq),
                    stamp_nanos: Some(frame.header.stamp_nanos),
                    day: Some(message.day),
                    object: None,
                    hand: None,
                });
                return Ok(());
            }
        }
        self.reader = None;
        Ok(())
    }
}

impl TactileDriver for Replay {
    fn open(&mut self, _now_nanos: u64) -> Result<(), DriverError> {
        (self.next, self.due, self.is_at_its_beginning, self.is_playing) = (None, None, true, true);
        self.reader = Some(RecordingReader::open(&self.path)?);
        Ok(())
    }

    fn close(&mut self) {
        (self.reader, self.next, self.due, self.is_playing) = (None, None, None, false);
    }

    fn watch<'a>(&'a self, _fds: &mut Vec<PollFd<'a>>) {}

    fn due_nanos(&self) -> Option<u64> {
        self.due.map(|(due_nanos, _)| due_nanos)
    }

    fn poll(&mut self, now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError> {
        if !self.is_playing {
            return Ok(None);
        }
        if std::mem::take(&mut self.is_at_its_beginning) {
            // An earlier instance has played the frames before.
            self.advance(place.seq)?;
            return Ok(Some(Event::Began));
        }
        let Some(reading) = &self.next else {
            (self.due, self.is_playing) = (None, false);
            return Ok(Some(Event::Ended));
        };
        let stamp_nanos = reading.stamp_nanos.unwrap_or(0);
        let due_nanos = match self.due {
            None => now_nanos,
            Some((due_nanos, last)) if last == stamp_nanos => due_nanos,
            Some((due_nanos, last)) => due_nanos + stamp_nanos.saturating_sub(last).min(LONGEST_PAUSE_NANOS),
        };
        self.due = Some((due_nanos, stamp_nanos));
        if now_nanos < due_nanos {
            return Ok(None);
        }
        let Some(reading) = self.next.take() else { return Ok(None) };
        self.advance(None)?;
        let arrival = Arrival { at_nanos: now_nanos, waited_nanos: now_nanos - due_nanos };
        Ok(Some(Event::Frame(reading, arrival)))
    }

    fn refused(&mut self, _refusal: &Refusal, _now_nanos: u64) {}
}
