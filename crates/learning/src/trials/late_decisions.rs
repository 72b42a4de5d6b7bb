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
    /// Attempts at random because advice did not come in time. [`LateDecisions::new`] does not count these.
    pub n_unadvised: usize,
}

impl LateDecisions {
    /// Counts, among attempts made with the gate.
    ///
    /// * `decisions` - all that were made, by grasp.
    pub fn new(records: &[TrialRecord], decisions: &BTreeMap<u64, LiftDecision>) -> Self {
        let mut late = LateDecisions::default();
        // A record may come twice.
        let held: BTreeMap<u64, &TrialRecord> =
            records.iter().filter(|record| !record.lifted).map(|record| (record.grasp_id, record)).collect();
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

    /// Adds what another run came to.
    pub fn add(&mut self, other: &LateDecisions) {
        self.n_stale += other.n_stale;
        self.n_undecided += other.n_undecided;
        self.n_unadvised += other.n_unadvised;
    }

    /// A warning in a line; `None` if nothing was late.
    pub fn advice(&self) -> Option<String> {
        let LateDecisions { n_stale, n_undecided, n_unadvised } = *self;
        let raise: Vec<&str> = [
            (n_stale > 0).then_some("lift_arbiter.max_age_ms"),
            (n_undecided + n_unadvised > 0).then_some("decision_timeout_s"),
        ]
        .into_iter()
        .flatten()
        .collect();
        (!raise.is_empty()).then(|| {
            format!(
                "{} attempts were not lifted, or did not follow advice, because this machine was too slow ({n_stale} stale, \
                 {n_undecided} without a decision in time, {n_unadvised} without advice), so the results depend on it: \
                 raise {} (--set)",
                n_stale + n_undecided + n_unadvised,
                raise.join(" and ")
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trials::tally::tests::records;

    #[test]
    fn only_what_the_machine_held_is_late() {
        let records = records(&[("box-02", "box", 0.1, "----h")]);
        let decision = |grasp_id: u64, action: Action, reason: Reason| {
            (grasp_id, LiftDecision { grasp_id, action, reason, ..LiftDecision::default() })
        };
        let decisions = BTreeMap::from([
            decision(0, Action::Hold, Reason::Unstable),
            decision(1, Action::Hold, Reason::Stale),
            // Too late for the hand; of grasp 3 there is none.
            decision(2, Action::Lift, Reason::Stable),
            decision(4, Action::Lift, Reason::Stable),
        ]);
        let late = LateDecisions::new(&records, &decisions);
        assert_eq!(late, LateDecisions { n_stale: 1, n_undecided: 2, n_unadvised: 0 });
        let mut late = late;
        late.add(&LateDecisions { n_unadvised: 4, ..LateDecisions::default() });
        let advice = late.advice().expect("late");
        for expected in
            ["7 attempts", "1 stale, 2 without", "4 without advice", "lift_arbiter.max_age_ms and decision_timeout_s"]
        {
            assert!(advice.contains(expected), "{advice}");
        }
        let stale = LateDecisions { n_stale: 1, ..LateDecisions::default() };
        assert!(stale.advice().is_some_and(|advice| !advice.contains("decision_timeout_s")));
        assert_eq!(LateDecisions::default().advice(), None);
    }
}
