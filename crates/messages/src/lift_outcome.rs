//! What became of a grasp.

use crate::MAX_NAME_BYTES;

message! {
    /// What became of a grasp that a hand tried: whether the hand lifted, and whether the object was kept. The header's
    /// sequence counts outcomes.
    #[derive(serde::Serialize)]
    pub struct LiftOutcome = "blindgrasp/LiftOutcome/4" on "/outcome" {
        pub grasp_id: u64,
        /// Number of the trial, from 0.
        pub trial: u64,
        /// Number of the attempt in its trial, from 0.
        pub attempt: u32,
        /// Whether the hand lifted.
        pub lifted: bool,
        /// Whether the object was in the hand at the end; false if it was not lifted.
        pub held: bool,
        #[ros = "Whether epsilon and volume are known."]
        pub has_quality: bool,
        /// How far the object's centre of mass moved in the hand since the hand had settled. Of a dropped object it
        /// counts until that was lost; after a test lift without a lift, until it was set down. Otherwise it is 0 if the
        /// object was not lifted.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub slip_m: f64,
        /// How far the object turned in the hand.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub turn_rad: f64,
        /// Epsilon quality of the settled grasp; -1 without force closure.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub epsilon: f64,
        /// Volume quality of the settled grasp.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub volume: f64,
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub mass_kg: f64,
        /// Coulomb friction of the object's surface on the hand.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub friction: f64,
        /// The name of the object to lift.
        #[max(MAX_NAME_BYTES)]
        pub thing: String,
        /// The object's group in tables.
        #[max(MAX_NAME_BYTES)]
        pub group: String,
        /// Whether the hand made a probe before it lifted or let go.
        #[serde(default)]
        pub probed: bool,
        /// Whether a test lift that was not followed by a lift left the object elsewhere in the hand, by 10 mm or 0.2 rad.
        #[serde(default)]
        pub disturbed: bool,
    }

    /// The items are the UTF-8 bytes of the thing's name, then of its group.
    pub struct LiftOutcomeHead = "blindgrasp/LiftOutcomeHead/4" {
        grasp_id: u64, trial: u64, slip_m: f64, turn_rad: f64, epsilon: f64, volume: f64, mass_kg: f64, friction: f64,
        attempt: u32, lifted: u32, held: u32, has_quality: u32, n_thing_bytes: u32 => thing, probed: u32,
        disturbed: u32, reserved: u32 = 0,
    }
    items: u8 => group;
}
