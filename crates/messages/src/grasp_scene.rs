//! How a simulated grasp came about.

use serde::{Deserialize, Serialize};

use crate::{MAX_CELLS, MAX_JOINTS};

message! {
    /// How a simulated grasp came about, which no robot knows. It is recorded beside the tactile frames and never sent.
    ///
    /// Everything is in the palm frame. The contacts hold all that the grasp's quality depends on, so that the quality
    /// can be computed anew, for another friction say, without another simulation.
    #[derive(serde::Serialize)]
    pub struct GraspScene = "blindgrasp/GraspScene/1" on "/scene" {
        pub grasp_id: u64,
        /// Number of the candidate.
        #[ros = "With the seed, identifies the grasp."]
        pub candidate: u64,
        /// Where the origin of the object's frame is, and how the object is turned: a unit quaternion.
        #[ros = "Palm frame; x, y, z, w."]
        pub object_position_m: [f64; 3],
        pub object_rotation_xyzw: [f64; 4],
        pub centre_of_mass_m: [f64; 3],
        /// The largest distance of a point of the object from its centre of mass.
        pub max_radius_m: f64,
        pub mass_kg: f64,
        /// Coulomb friction of the contacts with the object.
        pub friction: f64,
        /// The settled joints; the frames hold what the encoders say.
        #[ros = "Exactly, as no encoder says them."]
        #[max(MAX_JOINTS)]
        pub joints: Vec<f64>,
        /// Whether links of the hand press on each other.
        pub self_collision: bool,
        /// All contacts, sensed or not, of links with the object and with each other.
        #[max(MAX_CELLS)]
        pub contacts: Vec<SceneContact>,
    }
}

declared! {
    /// A contact of a [`GraspScene`].
    #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
    pub struct SceneContact {
        /// Index of the link among the hand's links.
        pub link: u32,
        /// Index of the other link where the hand touches itself.
        #[ros = "-1 for the object"]
        pub other_link: i32,
        /// The point on the surface of the object or of the other link.
        #[ros = "Palm frame, metres."]
        pub point_m: [f64; 3],
        /// Unit normal: the direction in which the link pushes.
        #[ros = "Into the object, palm frame."]
        pub inward_normal: [f64; 3],
        /// A unit tangent, from which a soft finger's edges are counted.
        pub tangent: [f64; 3],
        pub force_newtons: f64,
        /// Of the force, along the cells' normals.
        #[ros = "The part that cells feel."]
        pub felt_newtons: f64,
        /// Torsional radius of the patch.
        pub torsion_m: f64,
    }
}
