//! The promise that a robot's own lifts allow, and whether its contacts creep, from the counts of a graph's lift arbiter.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use blindgrasp_graph::client::words;
use blindgrasp_stages::lift_watch::{WATCH_COUNTS, creep};
use blindgrasp_stages::promise_monitor::{CONFIDENCE, OUTCOME_COUNTS};

/// The bound that the reported lifts of a robot allow, since `promised_drops` was set and the readings changed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct RobotPromise {
    n_kept: u64,
    n_dropped: u64,
    /// At most this share of the lifts drops the object.
    drops_at_most: f64,
    confidence: f64,
    /// This holds if no object is lifted more often in a row.
    lifts_per_object: u64,
}

impl RobotPromise {
    /// The promise of a node that counts outcomes; `None` of others, and before the first outcome.
    pub(super) fn of(counts: &BTreeMap<String, u64>) -> Option<RobotPromise> {
        let [n_kept, n_dropped, ppm, lifts_per_object] =
            OUTCOME_COUNTS.map(|name| counts.get(name).copied().unwrap_or(0));
        if n_kept + n_dropped == 0 {
            return None;
        }
        Some(RobotPromise {
            n_kept,
            n_dropped,
            drops_at_most: ppm as f64 / 1e6,
            confidence: CONFIDENCE,
            lifts_per_object,
        })
    }
}

impl fmt::Display for RobotPromise {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let RobotPromise { n_kept, n_dropped, drops_at_most, confidence, lifts_per_object } = self;
        let n_lifts = n_kept + n_dropped;
        let condition = if *lifts_per_object == 1 {
            "objects come in random order".to_owned()
        } else {
            format!("no object is lifted more than {lifts_per_object} times in a row")
        };
        let (most, confidence) = (100.0 * drops_at_most, 100.0 * confidence);
        write!(
            formatter,
            "at most {most:.1} % of this robot's lifts drop ({confidence:.0} % confidence if {condition}; {n_dropped} of {n_lifts} did)"
        )
    }
}

/// That the contacts of a robot creep, if the counts of a node say so.
pub(super) fn creep_in(counts: &BTreeMap<String, u64>) -> Option<String> {
    creep(WATCH_COUNTS.map(|name| counts.get(name).copied().unwrap_or(0)))
}

/// The counts of a node in words, and what follows from them.
pub(super) fn shown_counts(counts: &BTreeMap<String, u64>) -> Vec<String> {
    let promise = RobotPromise::of(counts).map(|promise| promise.to_string());
    promise.into_iter().chain(creep_in(counts)).chain(words::shown_counts(counts)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_creeps_that_was_tightened_in_most_lifts() {
        let counts = |numbers: [u64; 2]| WATCH_COUNTS.map(String::from).into_iter().zip(numbers).collect();
        assert_eq!(
            [creep_in(&counts([9, 9])), creep_in(&counts([10, 5])), creep_in(&BTreeMap::new())],
            [None, None, None]
        );
        let said = creep_in(&counts([10, 6])).expect("most");
        assert!(said.ends_with("the hand was told to tighten in 6 of 10 lifts: check its rubber and gears"), "{said}");
    }

    #[test]
    fn a_promise_needs_outcomes() {
        let counts = |kept, dropped, ppm, lifts_per_object| {
            let numbers = [kept, dropped, ppm, lifts_per_object];
            OUTCOME_COUNTS.into_iter().map(String::from).zip(numbers).collect::<BTreeMap<_, _>>()
        };
        assert_eq!(RobotPromise::of(&BTreeMap::from([("lifts/kept".into(), 7)])), None);
        assert_eq!(RobotPromise::of(&counts(0, 0, 1_000_000, 5)), None);
        assert_eq!(
            shown_counts(&counts(294, 6, 50_900, 1))[0],
            "at most 5.1 % of this robot's lifts drop (95 % confidence if objects come in random order; 6 of 300 did)"
        );
        assert_eq!(
            shown_counts(&counts(294, 6, 80_000, 5))[0],
            "at most 8.0 % of this robot's lifts drop (95 % confidence if no object is lifted more than 5 times in a row; 6 of 300 did)"
        );
    }
}
