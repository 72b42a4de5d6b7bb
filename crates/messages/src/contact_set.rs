//! What the contacts stage sends.

use serde::{Deserialize, Serialize};

use crate::declare::{Raw as _, at_most};
use crate::senses::MAX_SENSE_VALUES;
use crate::{
    Fault, Header, MAX_CELLS, MAX_JOINTS, MAX_PADS, Message, MessageError, OwnedSenses, Phase, Recorded as _, Senses,
};

declared! { shared
    /// One active cell, in the palm frame.
    #[derive(PartialEq, Serialize, Deserialize)]
    #[cfg_attr(feature = "ipc", type_name("blindgrasp/Contact/1"))]
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

/// The senses in a head lie in rows of so many values: an array of more than 32 values has no default.
const ROW: usize = 8;

message! {
    /// A frame's contacts: its active cells in the palm frame (Dang & Allen, Eq. 1).
    pub struct ContactSet = "blindgrasp/ContactSet/7" on "/contacts" {
        pub grasp_id: u64,
        pub phase: Phase,
        #[ros = "Radians, or metres for a joint that slides, in the hand's order."]
        #[serde(deserialize_with = "crate::serialized::any_list")]
        #[max(MAX_JOINTS)]
        pub joints: Vec<f64>,
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
        /// The frame's.
        pub senses: OwnedSenses,
        #[ros = "The frame's."]
        #[serde(default)]
        pub day: u32,
    }
    also check check_senses;

    /// The items are the contacts. The first values of `senses` are those of the senses that `has_senses` names.
    pub struct ContactSetHead = "blindgrasp/ContactSetHead/7" {
        grasp_id: u64, phase: u32, n_pads_in_contact: u32, self_collision: u32, n_self_contacts: u32, fault: u32,
        n_joints: u32, has_senses: u32, day: u32,
        joints: [f64; MAX_JOINTS], senses: [[f64; ROW]; MAX_SENSE_VALUES.div_ceil(ROW)],
    }
}
serialize_with_senses! {
    ContactSet: grasp_id phase joints contacts n_pads_in_contact self_collision n_self_contacts fault, senses, day
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
            day: self.day,
            ..ContactSetHead::default()
        }
        .with_joints(&self.joints)
        .with_senses(&self.senses.view());
        (head, self.contacts.clone())
    }

    fn from_parts(head: &ContactSetHead, items: &[Contact]) -> Result<Self, MessageError> {
        let message = ContactSet {
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints: head.joints()?.to_vec(),
            contacts: items.to_vec(),
            n_pads_in_contact: head.n_pads_in_contact,
            self_collision: bool::from_raw("self_collision", head.self_collision)?,
            n_self_contacts: head.n_self_contacts,
            fault: Fault::from_code(head.fault)?,
            senses: head.senses()?.into(),
            day: head.day,
        };
        message.check()?;
        Ok(message)
    }
}

fn check_senses(contacts: &ContactSet) -> Result<(), MessageError> {
    contacts.senses.view().check(contacts.joints.len())
}

impl ContactSetHead {
    /// With these joints, at most [`MAX_JOINTS`].
    pub fn with_joints(mut self, joints: &[f64]) -> Self {
        self.n_joints = joints.len() as u32;
        fill(&mut self.joints, joints);
        self
    }

    /// With these senses of a hand with its joints.
    pub fn with_senses(mut self, senses: &Senses<'_>) -> Self {
        self.has_senses = senses.mask(self.n_joints as usize);
        fill(self.senses.as_flattened_mut(), senses.values());
        self
    }

    /// The joints: radians, or metres for a joint that slides.
    ///
    /// # Errors
    /// More joints than a hand can have.
    pub fn joints(&self) -> Result<&[f64], MessageError> {
        at_most("joints", self.n_joints as usize, MAX_JOINTS)?;
        Ok(&self.joints[..self.n_joints as usize])
    }

    /// The frame's senses.
    ///
    /// # Errors
    /// A sense that is not known, or more joints than a hand can have.
    pub fn senses(&self) -> Result<Senses<'_>, MessageError> {
        Senses::first_of(self.has_senses, self.n_joints as usize, self.senses.as_flattened())
    }
}

/// Puts the values at the beginning; those for which there is no room are left out.
fn fill(room: &mut [f64], values: &[f64]) {
    for (place, value) in room.iter_mut().zip(values) {
        *place = *value;
    }
}
