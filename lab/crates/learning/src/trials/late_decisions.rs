//! Attempts that were not lifted because the machine was slow. Their outcomes do not depend on the grasp.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::trials::tally::TrialRecord;
use blindgrasp_messages::{Action, LiftDecision, Reason};

/// Attempts with the gate that were not lifted because the machine was slow.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LateDecisions {
    /// Attempts with the decision to hold for the reason stale: a prediction came too late, or none for too long.
    pub n_stale: usize,
    /// Attempts without a decision in time: none came, or it came after the hand had let go.
    pub n_undecided: usize,
}

impl LateDecisions {
    /// Counts, among attempts made with the gate.
    ///
    /// * `decisions` - all that were made, by grasp.
    pub fn new(records: &[TrialRecord], decisions: &BTreeMap<u64, LiftDecision>) -> Self {
        let mut late = LateDecisions::default();
        // A record may come twice.
        let held: BTreeMap<u64, &TrialRecord> = records
            .iter()
            .filter(|record| !record.lifted && !record.set_down)
            .map(|record| (record.grasp_id, record))
            .collect();
        for grasp_id in held.keys() {
            match decisions.get(grasp_id) {
                Some(decision) if decision.reason == Reason::Stale => late.n_stale += 1,
                None | Some(LiftDecision { action: Action::Lift, .. }) => late.n_undecided += 1,
                // Held in either case.
                Some(_) => {}
            }
        }
        late
    }

    /// A warning in a line; `None` if nothing was late.
    pub fn advice(&self) -> Option<String> {
        let LateDecisions { n_stale, n_undecided } = *self;
        let raise = match (n_stale > 0, n_undecided > 0) {
            (false, false) => return None,
            (true, false) => "lift_arbiter.max_age_ms",
            (false, true) => "decision_timeout_s",
            (true, true) => "lift_arbiter.max_age_ms and decision_timeout_s",
        };
        Some(format!(
            "{} attempts were not lifted because this machine was too slow ({n_stale} stale, {n_undecided} without a decision \
             in time), so the results depend on it: raise {raise} (--set)",
            n_stale + n_undecided
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trials::tally::tests::records;

    #[test]
    fn only_what_the_machine_held_is_late() {
        let mut records = records(&[("box-02", "box", 0.1, "-----h")]);
        // Its lift was broken off in time.
        records[5 - 1].set_down = true;
        let decision = |grasp_id: u64, action: Action, reason: Reason| {
            (grasp_id, LiftDecision { grasp_id, action, reason, ..LiftDecision::default() })
        };
        let decisions = BTreeMap::from([
            decision(0, Action::Hold, Reason::Unstable),
            decision(1, Action::Hold, Reason::Stale),
            // Too late for the hand; of grasp 3 there is none.
            decision(2, Action::Lift, Reason::Stable),
            decision(4, Action::Lift, Reason::Stable),
            decision(5, Action::Lift, Reason::Stable),
        ]);
        let late = LateDecisions::new(&records, &decisions);
        assert_eq!(late, LateDecisions { n_stale: 1, n_undecided: 2 });
        let advice = late.advice().expect("late");
        for expected in ["3 attempts", "1 stale, 2 without", "lift_arbiter.max_age_ms and decision_timeout_s"] {
            assert!(advice.contains(expected), "{advice}");
        }
        let stale = LateDecisions { n_stale: 1, ..LateDecisions::default() };
        assert!(stale.advice().is_some_and(|advice| !advice.contains("decision_timeout_s")));
        assert_eq!(LateDecisions::default().advice(), None);
    }
}
