//! What is known to be true of a grasp.

use crate::MAX_NAME_BYTES;

message! {
    /// The label of a simulated or labelled grasp. The header's sequence counts labels.
    #[derive(serde::Serialize)]
    pub struct GraspTruth = "blindgrasp/GraspTruth/2" on "/truth" {
        pub grasp_id: u64,
        /// Epsilon quality: the least wrench that breaks the grasp; -1 without force closure, NaN if it was not
        /// computed.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub epsilon: f64,
        /// Volume quality: 6-D volume of the L1 grasp wrench space; NaN if it was not computed.
        #[serde(default = "crate::serialized::nan", deserialize_with = "crate::serialized::nan_for_null")]
        pub volume: f64,
        /// Whether both exceed their thresholds; of a grasp that was lifted, whether the object was kept.
        pub stable: bool,
        /// The object's name.
        #[max(MAX_NAME_BYTES)]
        pub object: String,
        /// The object's class. Lines of earlier versions name it `class`.
        #[serde(alias = "class")]
        #[max(MAX_NAME_BYTES)]
        pub object_class: String,
    }

    /// The items are the UTF-8 bytes of the object's name, then of its class.
    pub struct GraspTruthHead = "blindgrasp/GraspTruthHead/1" {
        grasp_id: u64, epsilon: f64, volume: f64, stable: u32, n_object_bytes: u32 => object,
    }
    items: u8 => object_class;
}
