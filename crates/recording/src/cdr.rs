//! Messages as CDR, for topics of ROS 2.

use blindgrasp_messages::{ContactSet, Header, Recorded, Stamped, TactileFrame};
use serde::Serialize;

use super::{types, viewer};

/// Replaces the content of `data` with a message: little-endian CDR behind the four bytes of its encapsulation.
///
/// # Errors
/// A value that CDR does not have.
pub fn encode(value: &impl Serialize, data: &mut Vec<u8>) -> Result<(), String> {
    types::encode(value, data)
}

/// Reads a message of the package `blindgrasp_msgs`: little-endian CDR behind the four bytes of its encapsulation.
///
/// # Errors
/// Why it is no such message, for a person.
pub fn decode<M: Recorded>(data: &[u8]) -> Result<Stamped<M>, String> {
    types::decode(data)
}

/// A frame's joint angles as `sensor_msgs/msg/JointState`, under these names.
///
/// # Errors
/// As [`encode`].
pub fn joint_state(header: &Header, names: &[String], frame: &TactileFrame, data: &mut Vec<u8>) -> Result<(), String> {
    viewer::joint_state(header, names, frame, data)
}

/// Contacts as `sensor_msgs/msg/PointCloud2`: palm frame, metres, and the force of each in newtons.
///
/// # Errors
/// As [`encode`].
pub fn contact_points(header: &Header, contacts: &ContactSet, data: &mut Vec<u8>) -> Result<(), String> {
    viewer::contact_points(header, contacts, data)
}

/// Points in the palm frame, metres, each with a force, newtons, as `sensor_msgs/msg/PointCloud2` with `x`, `y`, `z`, `force`.
///
/// # Errors
/// As [`encode`].
pub fn force_points(
    header: &Header,
    points: impl ExactSizeIterator<Item = ([f64; 3], f64)>,
    data: &mut Vec<u8>,
) -> Result<(), String> {
    viewer::force_points(header, points, data)
}
