//! The promise that a robot's own lifts allow, from the counts of a graph's lift arbiter.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use blindgrasp_graph::log::printable;
use blindgrasp_stages::promise_monitor::{CONFIDENCE, OUTCOME_COUNTS, drops_at_most};

/// The bound that the reported lifts of a robot allow, since `promised_drops` was set and the readings changed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct RobotPromise {
    n_kept: u64,
    n_dropped: u64,
    /// At most this share of the lifts drops the object.
    drops_at_most: f64,
    confidence: f64,
}

impl RobotPromise {
    /// The promise of a node that counts outcomes; `None` of others, and before the first outcome.
    pub(super) fn of(counts: &BTreeMap<String, u64>) -> Option<RobotPromise> {
        let [n_kept, n_dropped] = OUTCOME_COUNTS.map(|name| counts.get(name).copied().unwrap_or(0));
        let drops_at_most = drops_at_most(n_kept, n_dropped);
        (n_kept + n_dropped > 0).then_some(RobotPromise { n_kept, n_dropped, drops_at_most, confidence: CONFIDENCE })
    }
}

impl fmt::Display for RobotPromise {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let RobotPromise { n_kept, n_dropped, drops_at_most, confidence } = self;
        let n_lifts = n_kept + n_dropped;
        let (most, confidence) = (100.0 * drops_at_most, 100.0 * confidence);
        write!(
            formatter,
            "at most {most:.1} % of this robot's lifts drop ({confidence:.0} % confidence if objects come in random order; {n_dropped} of \
             {n_lifts} did)"
        )
    }
}

/// The counts of a node in words, and the promise that follows from them.
pub(super) fn shown_counts(counts: &BTreeMap<String, u64>) -> Vec<String> {
    let promise = RobotPromise::of(counts).map(|promise| promise.to_string());
    promise.into_iter().chain(counts.iter().map(|(name, count)| printable(&format!("{name} {count}")))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_promise_needs_outcomes() {
        let counts =
            |kept, dropped| BTreeMap::from([("promise/kept".into(), kept), ("promise/dropped".into(), dropped)]);
        assert_eq!(RobotPromise::of(&BTreeMap::from([("lifts/kept".into(), 7)])), None);
        assert_eq!(RobotPromise::of(&counts(0, 0)), None);
        let shown = shown_counts(&counts(294, 6));
        assert_eq!(
            shown[0],
            "at most 5.1 % of this robot's lifts drop (95 % confidence if objects come in random order; 6 of 300 did)"
        );
        assert_eq!(shown.len(), 3);
    }
}
