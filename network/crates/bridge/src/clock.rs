//! The offset of another machine's clock, and the age of samples from there.
//!
//! The offset is measured as NTP does it (RFC 5905, section 8): it is half the difference between the two directions of
//! a round trip. Its error is at most half the round trip, plus the drift of the clocks since the measurement.
//! Latencies are corrected by the offset. Deadlines must not depend on it; [`origin_on_arrival`] ensures this.
//!
//! All times are nanoseconds of CLOCK_BOOTTIME, whose zero differs from machine to machine.

use std::collections::{HashMap, VecDeque};

use blindgrasp_operator::cursors::SampleId;

/// Number of round trips that are kept.
const WINDOW: usize = 64;
/// Maximum drift between two clocks in parts per million: a crystal has at most 50.
const DRIFT_PPM: u64 = 100;
/// A longer round trip is ignored.
const LONGEST_ROUND_TRIP_NANOS: u64 = 10_000_000_000;

/// An estimate of another machine's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Estimate {
    /// The other clock minus this machine's clock.
    pub offset_nanos: i64,
    /// Maximum error of the offset, in both directions.
    pub uncertainty_nanos: u64,
    /// The median of the latest round trips.
    pub round_trip_nanos: u64,
}

/// Measures the offset of another machine's clock. It is for one instance of the other link, because that machine may
/// be restarted before the next instance.
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
    /// Takes a round trip. `sent` (ping) and `arrived` (pong) are by this machine's clock, `received` (ping) and
    /// `answered` (pong) by the other clock. Returns false and ignores the times if they are impossible.
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

    /// The estimate by the round trip with the smallest error; `None` before the first round trip.
    pub fn estimate(&self, now_nanos: u64) -> Option<Estimate> {
        let uncertainty_nanos = |trip: &Trip| {
            let age_nanos = now_nanos.saturating_sub(trip.arrived_nanos);
            // One more, because the division rounds down.
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

/// The times of a sample from another machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passage {
    /// The time of arrival by this machine's clock.
    pub arrival_nanos: u64,
    /// The latest time of this machine's clock that the sender knew when it sent the sample; 0 if none.
    pub echo_nanos: u64,
    /// The time of sending by the sender's clock.
    pub sent_nanos: u64,
    /// The age of the sample at that time, by the sender's clock; `None` if its source does not tell.
    pub age_nanos: Option<u64>,
}

/// The time at which a sample's source published it, by this machine's clock: its `origin_nanos` here. It is 0, the
/// oldest time, if the age is unknown.
///
/// The sample was sent after the echo and before its arrival. This is certain by this machine's clock alone, and the
/// estimate only selects a time in between. If this interval is longer than `deadline_nanos`, its begin is taken. So a
/// sample never looks younger than it is by more than the deadline, whatever the other clock shows. The age at sending
/// is known to the other machine alone: if that machine was suspended and its clock stood still, this is not noticed.
pub fn origin_on_arrival(passage: &Passage, estimate: Option<Estimate>, deadline_nanos: u64) -> u64 {
    let Passage { arrival_nanos, echo_nanos, sent_nanos, age_nanos } = *passage;
    // This machine has never sent a time in the future.
    let earliest_nanos = if echo_nanos <= arrival_nanos { echo_nanos } else { 0 };
    let is_in_time = arrival_nanos - earliest_nanos <= deadline_nanos;
    let estimated_nanos = if is_in_time { estimate } else { None }
        .and_then(|estimate| sent_nanos.checked_add_signed(estimate.offset_nanos.checked_neg()?))
        .map_or(earliest_nanos, |nanos| nanos.clamp(earliest_nanos, arrival_nanos));
    age_nanos.map_or(0, |age_nanos| estimated_nanos.saturating_sub(age_nanos))
}

/// The origin time here of a sample that answers one of this machine's own samples. It is 0 (unknown, the oldest time)
/// if no such sample was sent from here lately: the other machine's word about its age, `on_arrival`, does not count. It
/// counts for samples that an earlier process of this link has sent, because their times ended with that process.
pub fn origin_of_answer(key: &SampleId, sent: &Origins, on_arrival: impl FnOnce() -> u64) -> u64 {
    sent.origin_nanos(key).unwrap_or_else(|| if sent.is_of_earlier_process(key) { on_arrival() } else { 0 })
}

/// The origin times of the samples that were sent lately. A sample that comes back as an answer to one of them has
/// exactly its origin time. Only for types with the source's sequence number
/// ([`bears_source_number`](blindgrasp_graph::client::observer::bears_source_number)).
#[derive(Debug, Clone)]
pub struct Origins {
    nanos_by_key: HashMap<SampleId, u64>,
    keys: VecDeque<SampleId>,
    capacity: usize,
    /// The last samples that an earlier process of this link has sent, of each port.
    before: Vec<SampleId>,
}

impl Origins {
    /// Keeps the last `capacity` samples.
    pub fn new(capacity: usize) -> Self {
        Origins { nanos_by_key: HashMap::new(), keys: VecDeque::new(), capacity: capacity.max(1), before: Vec::new() }
    }

    /// Remembers a sample that is sent. It is ignored if `origin_nanos` is 0 (unknown). Of several samples with one key
    /// the oldest counts.
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

    /// An earlier process of this link has sent the samples of a port up to this one.
    pub fn begin_after(&mut self, last: SampleId) {
        self.before.push(last);
    }

    fn is_of_earlier_process(&self, key: &SampleId) -> bool {
        self.before.iter().any(|last| last.epoch == key.epoch && last.seq >= key.seq)
    }

    /// The origin time of the sample with this key, if it was sent from here.
    pub fn origin_nanos(&self, key: &SampleId) -> Option<u64> {
        self.nanos_by_key.get(key).copied()
    }
}

#[cfg(test)]
mod tests;
