//! What the encoder sends.

use crate::{Fault, MAX_FEATURES, MAX_PADS, Phase};

message! {
    /// A frame's feature: the blocks of the model's recipe, the paper's histogram over the dictionary (Eq. 2-4) among
    /// them.
    #[derive(serde::Serialize)]
    pub struct GraspFeature = "blindgrasp/GraspFeature/4" on "/feature" {
        pub grasp_id: u64,
        pub phase: Phase,
        /// The values, in the order of the model's feature blocks; empty where there is no feature.
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_FEATURES)]
        pub values: Vec<f64>,
        #[max(MAX_PADS)]
        pub n_pads_in_contact: u32,
        /// `Model::dictionary_id`: hand, dictionary, σ, blocks, scaling and limits.
        #[ros = "Identity of the dictionary that made it."]
        #[serde(with = "crate::serialized::hex_id")]
        pub dictionary_id: u64,
        /// Why there is no feature.
        pub fault: Fault,
        #[ros = "The frame's."]
        #[serde(default)]
        pub day: u32,
    }

    /// The items are the values, in the order of the model's feature blocks.
    pub struct GraspFeatureHead = "blindgrasp/GraspFeatureHead/4" {
        grasp_id: u64, dictionary_id: u64, phase: u32, n_pads_in_contact: u32, fault: u32, day: u32,
    }
    items: f64 => values;
}
