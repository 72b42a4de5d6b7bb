//! What the tactile source sends.

use crate::declare::at_most;
use crate::{Header, MAX_CELLS, MAX_JOINTS, Message, MessageError, OwnedSenses, Phase, Recorded as _, Sense, Senses};

message! {
    /// One reading of all joints and cells.
    pub struct TactileFrame = "blindgrasp/TactileFrame/5" on "/tactile" {
        pub grasp_id: u64,
        pub phase: Phase,
        #[ros = "Radians, or metres for a joint that slides, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_JOINTS)]
        pub joints: Vec<f64>,
        /// Force on each cell, in the unit that the hand's layout declares if that is not newtons.
        #[ros = "Newtons, pad after pad."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_CELLS)]
        pub cells_newtons: Vec<f64>,
        /// What the robot senses beside joints and cells.
        pub senses: OwnedSenses,
        /// 0 if the source does not say it. Sensors drift from day to day: grasps of one day have one baseline.
        #[ros = "Number of the recording day, like 20261124; 0 if it is not known."]
        #[serde(default)]
        pub day: u32,
    }
    also check check_senses;

    /// The items are the joints, the senses that `has_senses` names, and then the cells' forces.
    pub struct TactileFrameHead = "blindgrasp/TactileFrameHead/5" {
        grasp_id: u64, phase: u32, n_joints: u32, has_senses: u32, day: u32,
    }
}
serialize_with_senses! { TactileFrame: grasp_id phase joints cells_newtons, senses, day }

impl Message for TactileFrame {
    type Head = TactileFrameHead;
    type Item = f64;

    fn header(head: &TactileFrameHead) -> &Header {
        &head.header
    }

    fn header_mut(head: &mut TactileFrameHead) -> &mut Header {
        &mut head.header
    }

    fn to_parts(&self, header: Header) -> (TactileFrameHead, Vec<f64>) {
        let senses = self.senses.view();
        let head = TactileFrameHead {
            header,
            grasp_id: self.grasp_id,
            phase: self.phase.code(),
            n_joints: self.joints.len() as u32,
            has_senses: senses.mask(self.joints.len()),
            day: self.day,
        };
        (head, [&self.joints, senses.values(), &self.cells_newtons].concat())
    }

    fn from_parts(head: &TactileFrameHead, items: &[f64]) -> Result<Self, MessageError> {
        let FrameParts { joints, senses, cells_newtons } = head.split(items)?;
        let message = TactileFrame {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints: joints.to_vec(),
            cells_newtons: cells_newtons.to_vec(),
            senses: senses.into(),
            day: head.day,
        };
        message.check()?;
        Ok(message)
    }
}

impl TactileFrame {
    /// The most items of a frame of a hand with so many joints and cells.
    pub fn max_items(n_joints: usize, n_cells: usize) -> usize {
        n_joints + Sense::max_values(n_joints) + n_cells
    }
}

fn check_senses(frame: &TactileFrame) -> Result<(), MessageError> {
    frame.senses.view().check(frame.joints.len())
}

/// The lists of a frame among its items.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameParts<'a> {
    pub joints: &'a [f64],
    pub senses: Senses<'a>,
    pub cells_newtons: &'a [f64],
}

/// [`FrameParts`], of which joints and cells can be changed.
#[derive(Debug, PartialEq)]
pub struct FramePartsMut<'a> {
    pub joints: &'a mut [f64],
    pub senses: Senses<'a>,
    pub cells_newtons: &'a mut [f64],
}

impl TactileFrameHead {
    /// The joints, the senses and the cells' forces among the frame's items.
    ///
    /// # Errors
    /// More of them than items, or more than a hand can have.
    pub fn split<'a>(&self, items: &'a [f64]) -> Result<FrameParts<'a>, MessageError> {
        let n_joints = self.n_joints as usize;
        at_most("joints", n_joints, MAX_JOINTS.min(items.len()))?;
        let (joints, rest) = items.split_at(n_joints);
        let senses = Senses::first_of(self.has_senses, n_joints, rest)?;
        let cells_newtons = &rest[senses.values().len()..];
        at_most("cells_newtons", cells_newtons.len(), MAX_CELLS)?;
        Ok(FrameParts { joints, senses, cells_newtons })
    }

    /// As [`TactileFrameHead::split`], to change joints or cells.
    ///
    /// # Errors
    /// As [`TactileFrameHead::split`].
    pub fn split_mut<'a>(&self, items: &'a mut [f64]) -> Result<FramePartsMut<'a>, MessageError> {
        let FrameParts { joints, senses, .. } = self.split(items)?;
        let (n_joints, n_values) = (joints.len(), senses.values().len());
        let (joints, rest) = items.split_at_mut(n_joints);
        let (values, cells_newtons) = rest.split_at_mut(n_values);
        let senses = Senses::first_of(self.has_senses, n_joints, values)?;
        Ok(FramePartsMut { joints, senses, cells_newtons })
    }

    /// The joints among the frame's items.
    ///
    /// # Errors
    /// As [`TactileFrameHead::split`].
    pub fn joints<'a>(&self, items: &'a [f64]) -> Result<&'a [f64], MessageError> {
        Ok(self.split(items)?.joints)
    }

    /// The senses among the frame's items.
    ///
    /// # Errors
    /// As [`TactileFrameHead::split`].
    pub fn senses<'a>(&self, items: &'a [f64]) -> Result<Senses<'a>, MessageError> {
        Ok(self.split(items)?.senses)
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
        Ok(self.split_mut(items)?.cells_newtons)
    }
}
