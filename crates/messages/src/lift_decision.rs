//! What the arbiter sends.

use crate::{Action, Reason};

message! {
    /// The arbiter's decision, one per grasp. The header's sequence counts decisions.
    #[derive(serde::Serialize)]
    pub struct LiftDecision = "blindgrasp/LiftDecision/3" on "/decision" {
        pub grasp_id: u64,
        pub action: Action,
        pub reason: Reason,
        /// The lowest probability among the predictions that decided; 0 where none did.
        pub probability_stable: f64,
    }

    /// There are no items.
    pub struct LiftDecisionHead = "blindgrasp/LiftDecisionHead/3" {
        grasp_id: u64, probability_stable: f64, action: u32, reason: u32,
    }
    items: u8;
}

impl LiftDecision {
    /// Makes a lift whose time is over a hold that is stale, and says whether it was one. To be asked right before a decision is
    /// sent to a program that may move an arm. Times are of CLOCK_BOOTTIME; `None` is no limit.
    pub fn expire(&mut self, valid_until_nanos: Option<u64>, now_nanos: u64) -> bool {
        let is_over = valid_until_nanos.is_some_and(|until_nanos| now_nanos >= until_nanos);
        if self.action != Action::Lift || !is_over {
            return false;
        }
        (self.action, self.reason, self.probability_stable) = (Action::Hold, Reason::Stale, 0.0);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lift_whose_time_is_over_is_a_hold_and_nothing_else_changes() {
        let lift = LiftDecision { grasp_id: 7, action: Action::Lift, reason: Reason::Stable, probability_stable: 0.9 };
        for (until, is_over) in [(None, false), (Some(101), false), (Some(100), true), (Some(1), true)] {
            let mut decision = lift.clone();
            assert_eq!(decision.expire(until, 100), is_over, "{until:?}");
            let held =
                LiftDecision { grasp_id: 7, action: Action::Hold, reason: Reason::Stale, probability_stable: 0.0 };
            assert_eq!(decision, if is_over { held } else { lift.clone() });
        }
        let mut probe = LiftDecision { action: Action::Squeeze, ..lift };
        assert!(!probe.expire(Some(1), 100) && probe.action == Action::Squeeze);
    }
}
