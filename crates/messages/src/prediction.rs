//! What the classifier sends.

use crate::{Fault, Phase};

message! {
    /// The classifier's verdict on a frame.
    #[derive(serde::Serialize)]
    pub struct Prediction = "blindgrasp/Prediction/4" on "/prediction" {
        pub grasp_id: u64,
        pub phase: Phase,
        /// The classifier's decision value, > 0 on the stable side; 0 where there is no feature.
        pub decision_value: f64,
        /// Calibrated probability that the grasp is stable; 0 where there is no feature.
        pub probability_stable: f64,
        /// Whether the probability reaches the model's threshold; false where there is no feature.
        pub stable: bool,
        /// Whether the probability is neither high enough for stable nor low enough for unstable.
        pub unsure: bool,
        /// Why there is no verdict.
        pub fault: Fault,
    }

    /// There are no items.
    pub struct PredictionHead = "blindgrasp/PredictionHead/4" {
        grasp_id: u64, decision_value: f64, probability_stable: f64, phase: u32, stable: u32, fault: u32, unsure: u32,
    }
    items: u8;
}
