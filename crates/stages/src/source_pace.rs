//! How fast a source sends frames, by its own clock.

use serde::{Deserialize, Serialize};

/// So many distances of frames show the pace: their median stays if four of them are of a source that stood still.
const N_DISTANCES: usize = 9;
/// One lost reading and an irregular one are no stop.
const MAX_PERIODS: u64 = 3;
/// A hand of fewer than three frames a second may have moved between two of them, however steady it is.
const MAX_GAP_NANOS: u64 = 1_000_000_000;

/// The last distances of consecutive frames of undecided grasps, within one epoch.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct SourcePace {
    epoch: u64,
    distances_nanos: [u64; N_DISTANCES],
    n_observed: usize,
}

impl SourcePace {
    /// Takes the distance of two frames. Frames of one time are one reading.
    pub(crate) fn observe(&mut self, epoch: u64, distance_nanos: u64) {
        if self.epoch != epoch {
            *self = SourcePace { epoch, ..SourcePace::default() };
        }
        if distance_nanos > 0 {
            self.distances_nanos[self.n_observed % N_DISTANCES] = distance_nanos;
            self.n_observed = self.n_observed.wrapping_add(1);
        }
    }

    /// The greatest distance that is not a stop for a source of this pace; 0 while its pace is unknown.
    pub(crate) fn longest_gap_nanos(&self) -> u64 {
        if self.n_observed < N_DISTANCES {
            return 0;
        }
        let mut sorted = self.distances_nanos;
        sorted.sort_unstable();
        sorted[N_DISTANCES / 2].saturating_mul(MAX_PERIODS).min(MAX_GAP_NANOS)
    }
}
