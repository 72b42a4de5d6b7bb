//! What the contacts stage sends.

use serde::{Deserialize, Serialize};

use crate::declare::Raw as _;
use crate::{
    Fault, Header, MAX_CELLS, MAX_JOINTS, MAX_PADS, Message, MessageError, Phase, Recorded as _, ZeroCopySend,
};

declared! { shared
    /// One active cell, in the palm frame.
    #[derive(PartialEq, Serialize, Deserialize)]
    #[type_name("blindgrasp/Contact/1")]
    pub struct Contact {
        /// The cell's centre.
        #[ros = "Palm frame, metres."]
        pub position_m: [f64; 3],
        #[ros = "The pad's outward normal, palm frame."]
        pub normal: [f64; 3],
        pub force_newtons: f64,
        /// Index of the pad in the hand's layout.
        pub pad: u32,
        #[ros = "Index on its pad."]
        pub cell: u32,
    }
}

message! {
    /// A frame's contacts: its active cells in the palm frame (Dang & Allen, Eq. 1).
    pub struct ContactSet = "blindgrasp/ContactSet/4" on "/contacts" {
        pub grasp_id: u64,
        pub phase: Phase,
        #[ros = "Radians, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_JOINTS)]
        pub joints_rad: Vec<f64>,
        /// The active cells, in the order of the hand's cells.
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_CELLS)]
        pub contacts: Vec<Contact>,
        #[max(MAX_PADS)]
        pub n_pads_in_contact: u32,
        /// Whether links of the hand touch each other in this posture.
        pub self_collision: bool,
        #[ros = "Active cells that feel another link: left out."]
        #[max(MAX_CELLS)]
        pub n_self_contacts: u32,
        /// Why there is no result.
        pub fault: Fault,
    }

    /// The items are the contacts.
    pub struct ContactSetHead = "blindgrasp/ContactSetHead/4" {
        grasp_id: u64, phase: u32, n_pads_in_contact: u32, self_collision: u32, n_self_contacts: u32, fault: u32,
        n_joints: u32, joints_rad: [f64; MAX_JOINTS],
    }
}

impl Message for ContactSet {
    type Head = ContactSetHead;
    type Item = Contact;

    fn header(head: &ContactSetHead) -> &Header {
        &head.header
    }

    fn header_mut(head: &mut ContactSetHead) -> &mut Header {
        &mut head.header
    }

    fn to_parts(&self, header: Header) -> (ContactSetHead, Vec<Contact>) {
        let head = ContactSetHead {
            header,
            grasp_id: self.grasp_id,
            phase: self.phase.code(),
            n_pads_in_contact: self.n_pads_in_contact,
            self_collision: self.self_collision.to_raw(),
            n_self_contacts: self.n_self_contacts,
            fault: self.fault.code(),
            n_joints: self.joints_rad.len() as u32,
            joints_rad: ContactSetHead::joints(&self.joints_rad),
        };
        (head, self.contacts.clone())
    }

    fn from_parts(head: &ContactSetHead, items: &[Contact]) -> Result<Self, MessageError> {
        let message = ContactSet {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints_rad: head.joints_rad()?.to_vec(),
            contacts: items.to_vec(),
            n_pads_in_contact: head.n_pads_in_contact,
            self_collision: bool::from_raw("self_collision", head.self_collision)?,
            n_self_contacts: head.n_self_contacts,
            fault: Fault::from_code(head.fault)?,
        };
        message.check()?;
        Ok(message)
    }
}

impl ContactSetHead {
    /// Joint angles as a head holds them: at most [`MAX_JOINTS`], 0 beyond the last.
    pub fn joints(joints_rad: &[f64]) -> [f64; MAX_JOINTS] {
        std::array::from_fn(|idx| joints_rad.get(idx).copied().unwrap_or_default())
    }

    /// The joint angles, radians.
    ///
    /// # Errors
    /// More joints than a hand can have.
    pub fn joints_rad(&self) -> Result<&[f64], MessageError> {
        let n_joints = self.n_joints as usize;
        crate::declare::at_most("joints_rad", n_joints, MAX_JOINTS)?;
        Ok(&self.joints_rad[..n_joints])
    }
}
