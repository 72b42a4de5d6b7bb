//! What the contacts stage sends.

use serde::{Deserialize, Serialize};

use crate::declare::Raw as _;
use crate::{
    Fault, Header, MAX_CELLS, MAX_JOINTS, MAX_PADS, Message, MessageError, Phase, Recorded as _, Senses, ZeroCopySend,
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

message! {
    /// A frame's contacts: its active cells in the palm frame (Dang & Allen, Eq. 1).
    pub struct ContactSet = "blindgrasp/ContactSet/6" on "/contacts" {
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
        /// The frame's.
        #[ros = "Palm frame, m/s^2; empty if it is not known."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub gravity_m_per_s2: Vec<f64>,
        #[ros = "Palm frame, newtons and newton metres; empty without a sensor."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub wrist_wrench: Vec<f64>,
        #[ros = "Newton metres, in the hand's order; empty without sensors."]
        #[serde(default, deserialize_with = "crate::serialized::any_list")]
        pub joint_torques: Vec<f64>,
        #[ros = "The frame's."]
        #[serde(default)]
        pub day: u32,
    }
    also check check_senses;

    /// The items are the contacts.
    pub struct ContactSetHead = "blindgrasp/ContactSetHead/6" {
        grasp_id: u64, phase: u32, n_pads_in_contact: u32, self_collision: u32, n_self_contacts: u32, fault: u32,
        n_joints: u32, joints_rad: [f64; MAX_JOINTS],
        n_gravity: u32, n_wrench: u32, n_torques: u32, day: u32,
        gravity_m_per_s2: [f64; 3], wrist_wrench: [f64; 6], joint_torques: [f64; MAX_JOINTS],
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
            day: self.day,
            n_joints: self.joints_rad.len() as u32,
            joints_rad: filled(&self.joints_rad),
            ..ContactSetHead::default()
        }
        .with_senses(&self.senses());
        (head, self.contacts.clone())
    }

    fn from_parts(head: &ContactSetHead, items: &[Contact]) -> Result<Self, MessageError> {
        let senses = head.senses()?;
        let message = ContactSet {
            gravity_m_per_s2: senses.gravity_m_per_s2.to_vec(),
            wrist_wrench: senses.wrist_wrench.to_vec(),
            joint_torques: senses.joint_torques.to_vec(),
            grasp_id: head.grasp_id,
            phase: Phase::from_code(head.phase)?,
            joints_rad: head.joints_rad()?.to_vec(),
            contacts: items.to_vec(),
            n_pads_in_contact: head.n_pads_in_contact,
            self_collision: bool::from_raw("self_collision", head.self_collision)?,
            n_self_contacts: head.n_self_contacts,
            fault: Fault::from_code(head.fault)?,
            day: head.day,
        };
        message.check()?;
        Ok(message)
    }
}

impl ContactSet {
    fn senses(&self) -> Senses<'_> {
        Senses {
            gravity_m_per_s2: &self.gravity_m_per_s2,
            wrist_wrench: &self.wrist_wrench,
            joint_torques: &self.joint_torques,
        }
    }
}

fn check_senses(contacts: &ContactSet) -> Result<(), MessageError> {
    contacts.senses().check(contacts.joints_rad.len())
}

/// The first `N` of a list; 0 beyond its last.
fn filled<const N: usize>(list: &[f64]) -> [f64; N] {
    std::array::from_fn(|idx| list.get(idx).copied().unwrap_or_default())
}

impl ContactSetHead {
    /// With these joint angles, at most [`MAX_JOINTS`].
    pub fn with_joints(self, joints_rad: &[f64]) -> Self {
        ContactSetHead { n_joints: joints_rad.len() as u32, joints_rad: filled(joints_rad), ..self }
    }

    /// With these senses.
    pub fn with_senses(self, senses: &Senses<'_>) -> Self {
        ContactSetHead {
            n_gravity: senses.gravity_m_per_s2.len() as u32,
            n_wrench: senses.wrist_wrench.len() as u32,
            n_torques: senses.joint_torques.len() as u32,
            gravity_m_per_s2: filled(senses.gravity_m_per_s2),
            wrist_wrench: filled(senses.wrist_wrench),
            joint_torques: filled(senses.joint_torques),
            ..self
        }
    }

    /// The joint angles, radians.
    ///
    /// # Errors
    /// More joints than a hand can have.
    pub fn joints_rad(&self) -> Result<&[f64], MessageError> {
        first("joints_rad", self.n_joints, &self.joints_rad)
    }

    /// The frame's senses.
    ///
    /// # Errors
    /// A list that is neither empty nor complete.
    pub fn senses(&self) -> Result<Senses<'_>, MessageError> {
        let senses = Senses {
            gravity_m_per_s2: first("gravity_m_per_s2", self.n_gravity, &self.gravity_m_per_s2)?,
            wrist_wrench: first("wrist_wrench", self.n_wrench, &self.wrist_wrench)?,
            joint_torques: first("joint_torques", self.n_torques, &self.joint_torques)?,
        };
        senses.check(self.n_joints as usize)?;
        Ok(senses)
    }
}

fn first<'a>(field: &'static str, n: u32, list: &'a [f64]) -> Result<&'a [f64], MessageError> {
    crate::declare::at_most(field, n as usize, list.len())?;
    Ok(&list[..n as usize])
}
