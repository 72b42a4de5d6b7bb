//! The other machine's clock: how far it is from this one's, and how old what comes from there is.
//!
//! The offset is measured as NTP does it (RFC 5905, section 8): half of what a round trip's two ways differ by. It is
//! never further off than half the round trip, and while it is not measured anew, by as much more as the clocks may drift
//! apart. Latencies are corrected by it; deadlines must not depend on it, and [`origin_on_arrival`] sees to that.
//!
//! All times are nanoseconds of CLOCK_MONOTONIC, whose zero differs from machine to machine.

use std::collections::{BTreeMap, VecDeque};

use blindgrasp_operator::cursors::SampleId;

/// How many round trips are looked at.
const WINDOW: usize = 64;
/// How far two clocks drift apart at most, parts per million: crystals are within 50 each.
const DRIFT_PPM: u64 = 100;
/// A round trip that took longer says nothing.
const LONGEST_ROUND_TRIP_NANOS: u64 = 10_000_000_000;

/// What is known of another machine's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Estimate {
    /// That clock less this machine's.
    pub offset_nanos: i64,
    /// How wrong the offset can be either way.
    pub uncertainty_nanos: u64,
    /// How long a message takes there and back: the median of the latest.
    pub round_trip_nanos: u64,
}

/// Measures how far another machine's clock is from this one's; of one instance of the other link, whose machine may have
/// been restarted before the next.
#[derive(Debug, Clone, Default)]
pub struct ClockOffset {
    trips: VecDeque<Trip>,
}

#[derive(Debug, Clone, Copy)]
struct Trip {
    arrived_nanos: u64,
    round_trip_nanos: u64,
    offset_nanos: i64,
}

impl ClockOffset {
    /// Takes a round trip: when the ping left and the pong came by this machine's clock, and when the ping came and the
    /// pong left by the other's. False if these times cannot be, and are not taken.
    pub fn add(&mut self, sent_nanos: u64, received_nanos: u64, answered_nanos: u64, arrived_nanos: u64) -> bool {
        let there_and_back = arrived_nanos.checked_sub(sent_nanos);
        let held = answered_nanos.checked_sub(received_nanos);
        let (Some(there_and_back), Some(held)) = (there_and_back, held) else { return false };
        let Some(round_trip_nanos) = there_and_back.checked_sub(held) else { return false };
        if there_and_back > LONGEST_ROUND_TRIP_NANOS {
            return false;
        }
        let there = i128::from(received_nanos) - i128::from(sent_nanos);
        let back = i128::from(answered_nanos) - i128::from(arrived_nanos);
        let Ok(offset_nanos) = i64::try_from((there + back) / 2) else { return false };
        if self.trips.len() == WINDOW {
            self.trips.pop_front();
        }
        self.trips.push_back(Trip { arrived_nanos, round_trip_nanos, offset_nanos });
        true
    }

    /// By the round trip that says most now; `None` before the first.
    pub fn estimate(&self, now_nanos: u64) -> Option<Estimate> {
        let uncertainty_nanos = |trip: &Trip| {
            let age_nanos = now_nanos.saturating_sub(trip.arrived_nanos);
            // One more, for what halving cuts off.
            trip.round_trip_nanos / 2 + 1 + age_nanos / 1_000_000 * DRIFT_PPM
        };
        let best = self.trips.iter().min_by_key(|trip| uncertainty_nanos(trip))?;
        let mut round_trips: Vec<u64> = self.trips.iter().map(|trip| trip.round_trip_nanos).collect();
        let median_idx = round_trips.len() / 2;
        let (_, median, _) = round_trips.select_nth_unstable(median_idx);
        Some(Estimate {
            offset_nanos: best.offset_nanos,
            uncertainty_nanos: uncertainty_nanos(best),
            round_trip_nanos: *median,
        })
    }
}

/// The times of a sample that came from another machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passage {
    /// When it came, by this machine's clock.
    pub arrival_nanos: u64,
    /// The latest time of this machine's clock that the sender had when it sent it; 0 if none.
    pub echo_nanos: u64,
    /// When it was sent, by the sender's clock.
    pub sent_nanos: u64,
    /// How old it was then, by the sender's clock; `None` if its source does not say.
    pub age_nanos: Option<u64>,
}

/// When a sample's source published it, by this machine's clock: its `origin_nanos` here. 0, the oldest there is, if nothing
/// says.
///
/// It was sent after the sender had the echo, and before it came: that much is certain by this machine's clock alone, and
/// the estimate only chooses a time in between. Where that leaves more room than `deadline_nanos`, the earliest counts. So
/// wherever the other clock stands, a sample never looks younger than it is by more than the deadline. Only how old it was
/// when it left, its own machine alone can say: a clock that stood still there, in a machine that was suspended, is not seen.
pub fn origin_on_arrival(passage: &Passage, estimate: Option<Estimate>, deadline_nanos: u64) -> u64 {
    let Passage { arrival_nanos, echo_nanos, sent_nanos, age_nanos } = *passage;
    // A time that is yet to come was never said here.
    let earliest_nanos = if echo_nanos <= arrival_nanos { echo_nanos } else { 0 };
    let estimated_nanos = estimate
        .filter(|_| arrival_nanos - earliest_nanos <= deadline_nanos)
        .and_then(|estimate| sent_nanos.checked_add_signed(estimate.offset_nanos.checked_neg()?))
        .map_or(earliest_nanos, |nanos| nanos.clamp(earliest_nanos, arrival_nanos));
    age_nanos.map_or(0, |age_nanos| estimated_nanos.saturating_sub(age_nanos))
}

/// When the sources published the samples that have left this machine lately: what comes back as an answer to one of them
/// has its origin, exactly. Only for types that bear the source's number
/// ([`bears_source_number`](blindgrasp_graph::observer::bears_source_number)).
#[derive(Debug, Clone)]
pub struct Origins {
    nanos_by_key: BTreeMap<SampleId, u64>,
    keys: VecDeque<SampleId>,
    capacity: usize,
}

impl Origins {
    /// Remembers the last `capacity` samples.
    pub fn new(capacity: usize) -> Self {
        Origins { nanos_by_key: BTreeMap::new(), keys: VecDeque::new(), capacity: capacity.max(1) }
    }

    /// A sample leaves; `origin_nanos` is 0 if its source does not say. Of several with one key the oldest counts.
    pub fn remember(&mut self, key: SampleId, origin_nanos: u64) {
        if origin_nanos == 0 {
            return;
        }
        if let Some(known_nanos) = self.nanos_by_key.get_mut(&key) {
            *known_nanos = origin_nanos.min(*known_nanos);
            return;
        }
        if self.keys.len() == self.capacity
            && let Some(oldest) = self.keys.pop_front()
        {
            self.nanos_by_key.remove(&oldest);
        }
        self.keys.push_back(key);
        self.nanos_by_key.insert(key, origin_nanos);
    }

    /// When the source published the sample of this key, if it has left here.
    pub fn origin_nanos(&self, key: &SampleId) -> Option<u64> {
        self.nanos_by_key.get(key).copied()
    }
}

#[cfg(test)]
mod tests;
