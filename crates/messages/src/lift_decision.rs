//! What the arbiter sends.

use crate::{Action, Reason, ZeroCopySend};

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
