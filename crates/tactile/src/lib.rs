//! The hardware's side: drivers that bring a hand's live tactile frames into the graph.
//!
//! A [`TactileDriver`] brings readings from wherever they come; [`gate`] says which of them may go on, and under which
//! numbers. The operator `tactile_source` publishes those. What is malformed, late or out of order is counted, never
//! passed on, and leaves a gap in the numbers, so that the arbiter holds the grasp that it belonged to.
//!
//! * [`line_protocol`] - lines of JSON, one frame each; pure.
//! * [`gate`] - order, lateness, numbers; pure.
//! * [`stream`] - the driver for the line protocol over TCP or a serial device.
//! * [`replay`] - the driver that plays a recording at its own speed, as the hand would.
//!
//! Nothing here reads a clock: whoever calls says what time it is, in nanoseconds of CLOCK_MONOTONIC.

pub mod gate;
pub mod line_protocol;
mod link;
pub mod replay;
pub mod stream;

use rustix::event::PollFd;
use serde::{Deserialize, Serialize};

use blindgrasp_messages::Phase;
use blindgrasp_stages::hand::Hand;

/// Brings a hand's frames: from a socket, a device, a vendor's library.
///
/// Nothing in it may wait: the source's loop waits for what [`TactileDriver::watch`] and [`TactileDriver::due_nanos`]
/// name, and then calls [`TactileDriver::poll`] until that has nothing more. `now_nanos` is CLOCK_MONOTONIC and never
/// goes back. A driver that loses its hand finds it again by itself; an error from `poll` ends the source.
pub trait TactileDriver {
    /// Begins. Only one instance of the source has its driver open at a time. A driver whose hand may come and go
    /// returns at once and looks for it in `poll`, also after it has returned an error.
    ///
    /// # Errors
    /// What a person has to mend before this can work.
    fn open(&mut self, now_nanos: u64) -> Result<(), DriverError>;

    /// Lets go of the hand, so that another instance can take it.
    fn close(&mut self);

    /// Adds what to wait for.
    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>);

    /// When it wants to be polled although nothing that it watches has changed.
    fn due_nanos(&self) -> Option<u64>;

    /// What has happened, one thing at a time; `None` when there is nothing now. `place` is how far the source has come.
    ///
    /// # Errors
    /// It cannot go on, and trying again would not help.
    fn poll(&mut self, now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError>;

    /// Hears why the source refused what the last event brought, to tell whoever sent it.
    fn refused(&mut self, refusal: &Refusal, now_nanos: u64);
}

/// What a driver has to say.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// What follows does not follow on what came before: the hand was connected, or connected again.
    Began,
    /// A reading.
    Frame(Reading, Arrival),
    /// Something that is no reading.
    Refused(Refusal),
    /// Somebody else wanted to send beside the one who does, and was turned away.
    TurnedAway,
    /// There is no more.
    Ended,
}

/// One reading of all joints and cells, as a driver brings it.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reading {
    /// Joint angles in the hand's order, radians.
    pub joints_rad: Vec<f64>,
    /// Force on each cell, pad after pad in the hand's order, newtons (or the unit of the hand's layout).
    pub cells_newtons: Vec<f64>,
    /// Where in the grasp.
    pub phase: Phase,
    /// Which grasp; without it the phases tell.
    #[serde(default)]
    pub grasp_id: Option<u64>,
    /// The sender's number of the frame, one more with each.
    #[serde(default)]
    pub seq: Option<u64>,
    /// When the reading was taken, nanoseconds of the sender's clock.
    #[serde(default)]
    pub stamp_nanos: Option<u64>,
}

/// When a reading came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// When the source had it.
    pub at_nanos: u64,
    /// How long it can have waited here at most: since the source last saw that nothing was there.
    pub waited_nanos: u64,
}

/// How far a source has come: what another instance needs to go on in its place.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The sender's number of the last frame that was in order.
    pub seq: Option<u64>,
    /// The last grasp.
    pub grasp_id: Option<u64>,
    /// The last stamp by the sender's clock.
    pub stamp_nanos: Option<u64>,
    /// The least delay known, and when (CLOCK_MONOTONIC): what a sender kept meanwhile must not look fresh to a successor.
    pub delay_nanos: Option<(i128, u64)>,
}

/// Why a frame does not go on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// As what it counts.
    pub kind: RefusalKind,
    /// What was found, what was expected.
    pub why: String,
}

/// As what a refused frame counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefusalKind {
    /// It is no frame of this hand.
    Malformed,
    /// A line that is longer than any frame.
    Oversized,
    /// The connection began or ended amid it.
    CutOff,
    /// It came too late.
    Late,
    /// It belongs before what came before it.
    OutOfOrder,
}

impl RefusalKind {
    /// Its name among the source's counts.
    pub fn word(self) -> &'static str {
        match self {
            RefusalKind::Malformed => "malformed",
            RefusalKind::Oversized => "oversized",
            RefusalKind::CutOff => "cut_off",
            RefusalKind::Late => "late",
            RefusalKind::OutOfOrder => "out_of_order",
        }
    }
}

/// Why a driver cannot work.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// It cannot listen there.
    #[error("cannot listen on {address}: {source}; give another address, or end what listens there")]
    Listen {
        /// Where.
        address: String,
        /// The reason.
        source: std::io::Error,
    },
    /// The recording cannot be played.
    #[error(transparent)]
    Recording(#[from] blindgrasp_recording::RecordingError),
    /// The recording is of another hand.
    #[error("recording {path}: it is of the hand {found}, expected {expected}")]
    OtherHand {
        /// The file.
        path: String,
        /// Its hand.
        found: String,
        /// The source's hand.
        expected: String,
    },
}

/// What a sender has to know of the hand that is expected of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectedHand {
    /// Its name.
    pub hand: String,
    /// Its identity, 16 hexadecimal digits.
    pub hand_id: String,
    /// How many angles a frame has.
    pub n_joints: usize,
    /// How many forces a frame has.
    pub n_cells: usize,
    /// The joints' names, in order.
    pub joints: Vec<String>,
    /// The pads, in order.
    pub pads: Vec<ExpectedPad>,
    /// What a cell's reading is.
    pub cell_unit: &'static str,
}

/// A pad of an [`ExpectedHand`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ExpectedPad {
    /// Its name.
    pub name: String,
    /// How many cells it has.
    pub n_cells: usize,
}

impl ExpectedHand {
    /// What a frame of this hand must be.
    pub fn of(hand: &Hand) -> Self {
        ExpectedHand {
            hand: hand.name.clone(),
            hand_id: format!("{:016x}", hand.id()),
            n_joints: hand.joints.len(),
            n_cells: hand.n_cells(),
            joints: hand.joints.iter().map(|joint| joint.name.clone()).collect(),
            pads: hand
                .pads
                .iter()
                .map(|pad| ExpectedPad { name: pad.name.clone(), n_cells: pad.cells.len() })
                .collect(),
            cell_unit: hand.cell_unit.word(),
        }
    }
}
