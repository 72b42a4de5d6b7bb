//! What the tactile source sends.

use crate::{MAX_CELLS, MAX_JOINTS, MessageError, Phase, ZeroCopySend};

message! {
    /// One reading of all joints and cells.
    pub struct TactileFrame = "blindgrasp/TactileFrame/2" on "/tactile" {
        pub grasp_id: u64,
        pub phase: Phase,
        #[ros = "Radians, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_JOINTS)]
        pub joints_rad: Vec<f64>,
        /// Force on each cell, in the unit that the hand's layout declares if that is not newtons.
        #[ros = "Newtons, pad after pad."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_CELLS)]
        pub cells_newtons: Vec<f64>,
    }

    /// The items are `n_joints` joint angles in radians, then the cells' forces in newtons.
    pub struct TactileFrameHead = "blindgrasp/TactileFrameHead/2" {
        grasp_id: u64, phase: u32, n_joints: u32 => joints_rad,
    }
    items: f64 => cells_newtons;
}

impl TactileFrameHead {
    /// The joint angles and the cells' forces among the frame's items.
    ///
    /// # Errors
    /// More joints than items, or more of either than a hand can have.
    pub fn split<'a>(&self, items: &'a [f64]) -> Result<(&'a [f64], &'a [f64]), MessageError> {
        let n_joints = self.n_joints as usize;
        crate::declare::at_most("joints_rad", n_joints, MAX_JOINTS.min(items.len()))?;
        let (joints_rad, cells_newtons) = items.split_at(n_joints);
        crate::declare::at_most("cells_newtons", cells_newtons.len(), MAX_CELLS)?;
        Ok((joints_rad, cells_newtons))
    }
}
