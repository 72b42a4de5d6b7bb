//! Says which node is too slow for its input, by the ages of the samples that reach it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use blindgrasp_operator::ages::Ages;

use crate::control::EdgeStatus;

/// The time between two looks.
const PERIOD: Duration = Duration::from_secs(2);
/// A node is slow if half of its samples since the last look were older than this on arrival.
const SLOW_NANOS: u64 = 1_000_000_000;
/// A node is named once in this time.
const SILENCE: Duration = Duration::from_secs(60);

/// The ages at the last look, and the times of the last words.
pub(super) struct SlowNodes {
    last_look: Instant,
    /// By edge.
    ages: Vec<Ages>,
    /// By node.
    said: BTreeMap<String, Instant>,
}

impl SlowNodes {
    pub(super) fn new() -> SlowNodes {
        SlowNodes { last_look: Instant::now(), ages: Vec::new(), said: BTreeMap::new() }
    }

    pub(super) fn is_due(&self) -> bool {
        self.last_look.elapsed() >= PERIOD
    }

    /// A line about the first slow node in the order of the graph: nodes behind it get old samples because of it.
    pub(super) fn look(&mut self, edges: &[EdgeStatus]) -> Option<String> {
        self.last_look = Instant::now();
        let before = std::mem::replace(&mut self.ages, edges.iter().map(|edge| edge.ages.clone()).collect());
        // The decision by which a grasp is held for its source's silence is as old as the silence.
        let medians = edges.iter().zip(before).map(|(edge, before)| {
            let ages = edge.ages.since(&before);
            if ages.n_samples() == 1 && edge.to == "run" { None } else { ages.quantile_nanos(0.5) }
        });
        let slow = edges.iter().zip(medians).find(|(_, median)| median.is_some_and(|nanos| nanos > SLOW_NANOS));
        let (edge, median_nanos) = slow?;
        let node = edge.to.split('/').next()?;
        if self.said.get(node).is_some_and(|said| said.elapsed() < SILENCE) {
            return None;
        }
        self.said.insert(node.into(), Instant::now());
        let secs = median_nanos? as f64 / 1e9;
        Some(format!(
            "blindgrasp: node '{node}' is slower than its input or stood still: in the last {} s its samples were {secs:.1} s \
             old on arrival (median)",
            PERIOD.as_secs()
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::made_status;

    #[test]
    fn the_first_node_with_old_samples_is_named_once_a_minute() {
        let mut edges = made_status("slow").edges;
        edges.truncate(1);
        edges[0].ages = serde_json::from_str("[[1000, 100]]").expect("ages");
        edges.push(EdgeStatus { to: "classifier/feature".into(), ..edges[0].clone() });
        edges.push(EdgeStatus { to: "lift_arbiter/prediction".into(), ..edges[0].clone() });
        let mut nodes = SlowNodes::new();
        assert!(!nodes.is_due());
        assert_eq!(nodes.look(&edges), None);
        edges.push(EdgeStatus { to: "run".into(), ..edges[0].clone() });
        assert_eq!(nodes.look(&edges), None);
        edges[3].ages = serde_json::from_str("[[1000, 100], [2500000000, 1]]").expect("ages");
        assert_eq!(nodes.look(&edges), None, "a grasp that is held for silence");
        for edge in &mut edges[1..] {
            edge.ages = serde_json::from_str("[[1000, 110], [2500000000, 20]]").expect("ages");
        }
        let said = nodes.look(&edges).expect("a slow node");
        assert!(said.contains("'classifier'") && said.contains("2.5 s old"), "{said}");
        edges[1].ages = serde_json::from_str("[[1000, 110], [2500000000, 40]]").expect("ages");
        assert_eq!(nodes.look(&edges), None);
    }
}
