//! What the tactile source sends.

use crate::{MAX_CELLS, MAX_JOINTS, MessageError, Phase, ZeroCopySend};

message! {
    /// One reading of all joints and cells.
    pub struct TactileFrame = "blindgrasp/TactileFrame/4" on "/tactile" {
        pub grasp_id: u64,
        pub phase: Phase,
        /// Radians, and metres of joints that slide.
        #[ros = "Radians, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_JOINTS)]
        pub joints_rad: Vec<f64>,
        /// Force on each cell, in the unit that the hand's layout declares if that is not newtons.
        #[ros = "Newtons, pad after pad."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_CELLS)]
        pub cells_newtons: Vec<f64>,
        /// Gravity, x, y, z; empty if it is not known.
        #[ros = "Palm frame, m/s^2."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub gravity_m_per_s2: Vec<f64>,
        /// Force and torque of the load on the wrist: x, y, z each; empty without a sensor.
        #[ros = "Palm frame, newtons and newton metres."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub wrist_wrench: Vec<f64>,
        /// The torque of each joint, positive if its motor closes; empty without sensors.
        #[ros = "Newton metres, in the hand's order."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub joint_torques: Vec<f64>,
        /// 0 if the source does not say it. Sensors drift from day to day: grasps of one day have one baseline.
        #[ros = "Number of the recording day, like 20261124; 0 if it is not known."]
        #[serde(default)]
        pub day: u32,
    }
    also check check_senses;

    /// The items are the joint angles, gravity, the wrench, the joints' torques, and then the cells' forces.
    pub struct TactileFrameHead = "blindgrasp/TactileFrameHead/4" {
        grasp_id: u64, phase: u32, n_joints: u32 => joints_rad, n_gravity: u32 => gravity_m_per_s2,
        n_wrench: u32 => wrist_wrench, n_torques: u32 => joint_torques, day: u32,
    }
    items: f64 => cells_newtons;
}

impl TactileFrame {
    /// The most items of a frame of a hand with so many joints and cells.
    pub fn max_items(n_joints: usize, n_cells: usize) -> usize {
        2 * n_joints + 3 + 6 + n_cells
    }

    /// What the frame has beside joint angles and cells.
    pub fn senses(&self) -> Senses<'_> {
        Senses {
            gravity_m_per_s2: &self.gravity_m_per_s2,
            wrist_wrench: &self.wrist_wrench,
            joint_torques: &self.joint_torques,
        }
    }
}

fn check_senses(frame: &TactileFrame) -> Result<(), MessageError> {
    frame.senses().check(frame.joints_rad.len())
}

/// What a hand or an arm may sense beside joint angles and cells. An empty list is a sense that is absent.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Senses<'a> {
    /// Gravity in the palm frame: x, y, z.
    pub gravity_m_per_s2: &'a [f64],
    /// Force (newtons) and torque (newton metres) of the load on the wrist, in the palm frame.
    pub wrist_wrench: &'a [f64],
    /// The torque of each joint, newton metres, in the hand's order.
    pub joint_torques: &'a [f64],
}

impl Senses<'_> {
    /// # Errors
    /// A list that is neither empty nor as long as it must be for a hand with `n_joints`.
    pub(crate) fn check(&self, n_joints: usize) -> Result<(), MessageError> {
        for (field, found, expected) in [
            ("gravity_m_per_s2", self.gravity_m_per_s2.len(), 3),
            ("wrist_wrench", self.wrist_wrench.len(), 6),
            ("joint_torques", self.joint_torques.len(), n_joints),
        ] {
            if found != 0 && found != expected {
                return Err(MessageError::Length { field, found, expected: format!("0 or {expected}") });
            }
        }
        Ok(())
    }
}

/// The lists of a frame among its items.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameParts<'a> {
    pub joints_rad: &'a [f64],
    pub senses: Senses<'a>,
    pub cells_newtons: &'a [f64],
}

impl TactileFrameHead {
    /// The joint angles, the senses and the cells' forces among the frame's items.
    ///
    /// # Errors
    /// More of them than items, or more than a hand can have.
    pub fn split<'a>(&self, items: &'a [f64]) -> Result<FrameParts<'a>, MessageError> {
        let mut rest = items;
        let mut take = |field, n: u32, most: usize| {
            crate::declare::at_most(field, n as usize, most.min(rest.len()))?;
            let (first, others) = rest.split_at(n as usize);
            rest = others;
            Ok(first)
        };
        let joints_rad = take("joints_rad", self.n_joints, MAX_JOINTS)?;
        let senses = Senses {
            gravity_m_per_s2: take("gravity_m_per_s2", self.n_gravity, 3)?,
            wrist_wrench: take("wrist_wrench", self.n_wrench, 6)?,
            joint_torques: take("joint_torques", self.n_torques, MAX_JOINTS)?,
        };
        senses.check(joints_rad.len())?;
        crate::declare::at_most("cells_newtons", rest.len(), MAX_CELLS)?;
        Ok(FrameParts { joints_rad, senses, cells_newtons: rest })
    }

    /// The cells' forces among the frame's items.
    ///
    /// # Errors
    /// As [`TactileFrameHead::split`].
    pub fn cells<'a>(&self, items: &'a [f64]) -> Result<&'a [f64], MessageError> {
        Ok(self.split(items)?.cells_newtons)
    }

    /// As [`TactileFrameHead::cells`], to change them.
    ///
    /// # Errors
    /// As [`TactileFrameHead::split`].
    pub fn cells_mut<'a>(&self, items: &'a mut [f64]) -> Result<&'a mut [f64], MessageError> {
        let n_before = items.len() - self.cells(items)?.len();
        Ok(&mut items[n_before..])
    }
}
