//! How fast a source sends frames, by its own clock.

use serde::{Deserialize, Serialize};

/// So many distances of frames show the pace …
const N_DISTANCES: usize = 9;
/// … as the third smallest of them: a fast source that stands still now and then stays a fast one.
const PERIOD: usize = 2;
/// One lost reading and an irregular one are no stop.
const MAX_PERIODS: u64 = 3;
/// A hand of fewer than three frames a second may have moved between two of them, however steady it is.
const MAX_GAP_NANOS: u64 = 1_000_000_000;

/// The last distances of frames that followed each other since the source started.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct SourcePace {
    distances_nanos: [u64; N_DISTANCES],
    n_observed: usize,
}

impl SourcePace {
    /// Takes the distance of two frames. Frames of one time are one reading.
    pub(crate) fn observe(&mut self, distance_nanos: u64) {
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
        sorted[PERIOD].saturating_mul(MAX_PERIODS).min(MAX_GAP_NANOS)
    }
}
