//! Drivers that bring a hand's live tactile frames into the graph.
//!
//! ```
//! use blindgrasp_tactile::line_protocol;
//!
//! let line = br#"{"phase": "settled", "grasp_id": 4, "joints": [0.1, 0.9], "cells_newtons": [0, 1.5]}"#;
//! let reading = line_protocol::parse(line).expect("a frame");
//! assert_eq!(reading.grasp_id, Some(4));
//! let refusal = line_protocol::parse(br#"{"phase": "settled"}"#).expect_err("a frame without readings");
//! assert!(refusal.why.contains("joints"));
//! ```
//!
//! A [`TactileDriver`] reads frames from the hand; the [`gate`] accepts and numbers them, and the operator
//! `tactile_source` publishes them. Malformed, late and out-of-order frames are counted and dropped. Each leaves a gap in the
//! numbers, so that the arbiter holds its grasp.
//!
//! * [`line_protocol`] - lines of JSON, one frame each; pure.
//! * [`gate`] - order, lateness, numbers; pure.
//! * [`stream`] - the driver for the line protocol over TCP or a serial device.
//!
//! The caller passes the time, in nanoseconds of CLOCK_BOOTTIME.

pub mod cell_zeros;
pub mod gate;
pub mod line_protocol;
mod link;
pub mod stream;

use rustix::event::PollFd;
use serde::{Deserialize, Serialize};

use blindgrasp_messages::{GraspTruth, OwnedSenses, Phase};
use blindgrasp_stages::hand::Hand;

/// Reads a hand's frames: from a socket, a device, a vendor's library.
///
/// No method may wait. The source's loop waits for the descriptors of [`TactileDriver::watch`] and the time of
/// [`TactileDriver::due_nanos`], then calls [`TactileDriver::poll`] until it returns nothing. `now_nanos` is CLOCK_BOOTTIME
/// and never goes back. A driver that loses its hand finds it again by itself; an error from `poll` ends the source.
pub trait TactileDriver {
    /// Opens the driver. Only one instance of the source has its driver open at a time. A driver whose hand may come and
    /// go returns at once and looks for it in `poll`, also after an error.
    ///
    /// # Errors
    /// The driver cannot work until a person mends something.
    fn open(&mut self, now_nanos: u64) -> Result<(), DriverError>;

    /// Lets go of the hand, so that another instance can take it.
    fn close(&mut self);

    /// Adds the file descriptors to wait for.
    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>);

    /// The time for the next poll if no descriptor is ready before; the source polls at least every 0.1 s.
    fn due_nanos(&self) -> Option<u64>;

    /// Returns the next event; `None` when there is nothing now. `place` is the source's progress.
    ///
    /// # Errors
    /// The driver cannot go on, and trying again would not help.
    fn poll(&mut self, now_nanos: u64, place: &Place) -> Result<Option<Event>, DriverError>;

    /// Tells the driver why the source refused the last event's frame, so that it can tell the sender.
    fn refused(&mut self, refusal: &Refusal, now_nanos: u64);
}

#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The hand was connected, or connected again: frames may be missing before the next one.
    Began,
    Frame(Reading, Arrival),
    /// A line that is no reading.
    Refused(Refusal),
    /// A second sender was turned away.
    TurnedAway,
}

/// One reading of all joints and cells.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
pub struct Reading {
    /// Radians, or metres for a joint that slides, in the hand's order. A missing one is not a number, and refused.
    #[serde(deserialize_with = "with_missing")]
    pub joints: Vec<f64>,
    /// Force on each cell, pad after pad in the hand's order, newtons (or the unit of the hand's layout). A missing one, `null`
    /// or `NaN` in a line, is not a number.
    #[serde(deserialize_with = "with_missing")]
    pub cells_newtons: Vec<f64>,
    pub phase: Phase,
    /// Each sense under its own name in a line. They refuse a key that is unknown.
    #[serde(flatten)]
    pub senses: OwnedSenses,
    /// The grasp; without it, the phases tell where a grasp begins.
    #[serde(default)]
    pub grasp_id: Option<u64>,
    /// The sender's number of the frame, which grows by one.
    #[serde(default)]
    pub seq: Option<u64>,
    /// The time of the reading, nanoseconds of the sender's clock.
    #[serde(default)]
    pub stamp_nanos: Option<u64>,
    /// Number of the recording day, like 20261124; the source's own without it.
    #[serde(default)]
    pub day: Option<u32>,
    /// The object's name. It counts in frames of the phases kept and dropped.
    #[serde(default)]
    pub object: Option<String>,
    /// The name or the identity of the hand that sends, if the sender says it.
    #[serde(default)]
    pub hand: Option<String>,
}

fn with_missing<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
    let numbers: Vec<Option<f64>> = Deserialize::deserialize(deserializer)?;
    Ok(numbers.into_iter().map(|number| number.unwrap_or(f64::NAN)).collect())
}

impl Reading {
    /// The outcome of a lift whose object the frame names, as a label of its grasp.
    pub fn truth(&self, grasp_id: u64) -> Option<GraspTruth> {
        let stable = self.phase.outcome()?;
        let object = self.object.clone()?;
        let object_class = object.clone();
        Some(GraspTruth { grasp_id, epsilon: f64::NAN, volume: f64::NAN, stable, object, object_class })
    }
}

/// The time of a reading's arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    pub at_nanos: u64,
    /// The most time that it can have waited here: since the source last found its input empty.
    pub waited_nanos: u64,
}

/// A source's progress: another instance continues from it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The sender's number of the last frame that was in order.
    pub seq: Option<u64>,
    pub grasp_id: Option<u64>,
    pub stamp_nanos: Option<u64>,
    /// The least delay known, and when it was measured (CLOCK_BOOTTIME): frames that a sender kept back must not look fresh
    /// to the next instance.
    pub delay_nanos: Option<(i128, u64)>,
}

/// Why a frame is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    pub kind: RefusalKind,
    pub why: String,
}

/// The count to which a refused frame belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefusalKind {
    /// A line that is no frame of this hand.
    Malformed,
    /// A line that is longer than any frame.
    Oversized,
    /// A line of which the connection brought only a part.
    CutOff,
    Late,
    /// A frame that comes after a later one, or a copy of a frame.
    OutOfOrder,
}

impl Refusal {
    pub fn malformed(why: String) -> Refusal {
        Refusal { kind: RefusalKind::Malformed, why }
    }
}

impl RefusalKind {
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
    #[error(
        "cannot listen on {address}: {source}; end what listens there, or give each source an address of its own, and its \
         bridge the same one (--set SOURCE.address=unix:PATH, --address unix:PATH)"
    )]
    Listen { address: String, source: std::io::Error },
    #[error("'{key}' is no key expression of Zenoh: {why}")]
    Key { key: String, why: String },
    #[error("cannot make an event")]
    Inbox(#[source] std::io::Error),
}

/// The hand whose frames a sender is to send.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectedHand {
    pub hand: String,
    /// The identity of the hand, 16 hexadecimal digits.
    pub hand_id: String,
    pub n_joints: usize,
    pub n_cells: usize,
    /// The joints' names, in order.
    pub joints: Vec<String>,
    /// The pads, in order.
    pub pads: Vec<ExpectedPad>,
    pub cell_unit: &'static str,
}

/// A pad of an [`ExpectedHand`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ExpectedPad {
    pub name: String,
    pub n_cells: usize,
}

impl ExpectedHand {
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

    /// A reading that does not say that it is of another hand: a left and a right hand have as many cells.
    ///
    /// # Errors
    /// It names another hand.
    pub fn check(&self, reading: Reading) -> Result<Reading, Refusal> {
        match &reading.hand {
            Some(found) if *found != self.hand && *found != self.hand_id => Err(Refusal::malformed(format!(
                "the frame is of the hand {found}: expected {} (hand_id {}); give the bridge the name of its own hand's graph (--graph NAME)",
                self.hand, self.hand_id
            ))),
            _ => Ok(reading),
        }
    }
}
