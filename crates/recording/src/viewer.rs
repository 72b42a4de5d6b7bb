//! Standard ROS messages beside ours, so that viewers draw a live recording without plug-ins: joint angles as
//! `sensor_msgs/msg/JointState`, contacts as `sensor_msgs/msg/PointCloud2`.

use blindgrasp_messages::{ContactSet, Header, TactileFrame};
use serde::Serialize;

use super::types::encode;

/// The frame of everything in the palm frame.
const FRAME_ID: &str = "palm";

/// A standard message type.
pub(super) struct StandardType {
    pub(super) topic: &'static str,
    pub(super) schema: &'static str,
    pub(super) definition: &'static str,
}

pub(super) const JOINT_STATES: StandardType =
    StandardType { topic: "/joint_states", schema: "sensor_msgs/msg/JointState", definition: JOINT_STATE };
pub(super) const CONTACT_POINTS: StandardType =
    StandardType { topic: "/contact_points", schema: "sensor_msgs/msg/PointCloud2", definition: POINT_CLOUD };

/// The topics of live recordings that are there for viewers. Their content follows from our own topics.
pub const TOPICS_FOR_VIEWERS: [&str; 2] = [JOINT_STATES.topic, CONTACT_POINTS.topic];

/// A definition whose own lines begin with a header.
macro_rules! with_header {
    ($own:literal) => {
        concat!(
            "std_msgs/Header header\n",
            $own,
            "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"
        )
    };
}

const JOINT_STATE: &str = with_header!(
    "\
string[] name
float64[] position
float64[] velocity
float64[] effort
"
);

const POINT_CLOUD: &str = with_header!(
    "\
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"
);

const FLOAT32: u8 = 7;
const FIELDS: [&str; 4] = ["x", "y", "z", "force"];
const BYTES_PER_POINT: u32 = 16;

/// `std_msgs/Header`; ROS counts seconds in 32 bits with sign.
#[derive(Serialize)]
struct StandardHeader {
    sec: i32,
    nanosec: u32,
    frame_id: &'static str,
}

/// `sensor_msgs/JointState`.
#[derive(Serialize)]
struct JointState<'a> {
    header: StandardHeader,
    name: &'a [String],
    position: &'a [f64],
    velocity: &'a [f64],
    effort: &'a [f64],
}

/// `sensor_msgs/PointField`.
#[derive(Serialize)]
struct PointField {
    name: &'static str,
    offset: u32,
    datatype: u8,
    count: u32,
}

/// `sensor_msgs/PointCloud2`.
#[derive(Serialize)]
struct PointCloud {
    header: StandardHeader,
    height: u32,
    width: u32,
    fields: Vec<PointField>,
    is_bigendian: bool,
    point_step: u32,
    row_step: u32,
    data: Vec<u8>,
    is_dense: bool,
}

impl StandardHeader {
    fn new(header: &Header) -> Self {
        StandardHeader {
            sec: i32::try_from(header.stamp_nanos / 1_000_000_000).unwrap_or(i32::MAX),
            nanosec: (header.stamp_nanos % 1_000_000_000) as u32,
            frame_id: FRAME_ID,
        }
    }
}

/// A frame's joint angles, radians, under the hand's names, as `sensor_msgs/msg/JointState`; neither velocities nor efforts.
///
/// # Errors
/// As [`encode`]; or there is another number of names.
pub fn joint_state(header: &Header, names: &[String], frame: &TactileFrame, data: &mut Vec<u8>) -> Result<(), String> {
    if names.len() != frame.joints.len() {
        return Err(format!("{} joint values, the hand has {}", frame.joints.len(), names.len()));
    }
    let header = StandardHeader::new(header);
    encode(&JointState { header, name: names, position: &frame.joints, velocity: &[], effort: &[] }, data)
}

/// A sample's contacts, as [`force_points`].
///
/// # Errors
/// As [`encode`].
pub fn contact_points(header: &Header, contacts: &ContactSet, data: &mut Vec<u8>) -> Result<(), String> {
    force_points(header, contacts.contacts.iter().map(|contact| (contact.position_m, contact.force_newtons)), data)
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
    let width = points.len() as u32;
    let field =
        |(idx, name): (usize, &&'static str)| PointField { name, offset: 4 * idx as u32, datatype: FLOAT32, count: 1 };
    let values = points.flat_map(|(position_m, newtons)| position_m.into_iter().chain([newtons]));
    let cloud = PointCloud {
        header: StandardHeader::new(header),
        height: 1,
        width,
        fields: FIELDS.iter().enumerate().map(field).collect(),
        is_bigendian: false,
        point_step: BYTES_PER_POINT,
        row_step: BYTES_PER_POINT * width,
        data: values.flat_map(|value| (value as f32).to_le_bytes()).collect(),
        is_dense: true,
    };
    encode(&cloud, data)
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::Contact;

    use super::*;

    fn hex(data: &[u8]) -> String {
        data.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    // The expected bytes are written by hand with Python's `struct`, from the definitions.

    #[test]
    fn joints_are_as_ros_writes_them() {
        let header = Header { stamp_nanos: 5_000_000_007, ..Header::default() };
        let frame = TactileFrame { joints: vec![0.25, -1.5], ..TactileFrame::default() };
        let mut data = vec![9; 3];
        joint_state(&header, &["a".into(), "thumb".into()], &frame, &mut data).expect("CDR");
        let expected = "0001000005000000070000000500000070616c6d00000000020000000200000061000000060000007468756d62000000\
             02000000000000000000d03f000000000000f8bf0000000000000000";
        assert_eq!(hex(&data), expected);
    }

    #[test]
    fn contacts_are_as_ros_writes_them() {
        let contact = Contact { position_m: [0.5, -0.25, 2.0], force_newtons: 3.5, ..Contact::default() };
        let contacts = ContactSet { contacts: vec![contact; 2], ..ContactSet::default() };
        let mut data = Vec::new();
        contact_points(&Header::default(), &contacts, &mut data).expect("CDR");
        let expected = "0001000000000000000000000500000070616c6d00000000010000000200000004000000020000007800000000000000\
             07000000010000000200000079000000040000000700000001000000020000007a000000080000000700000001000000\
             06000000666f7263650000000c0000000700000001000000000000001000000020000000200000000000003f000080be\
             00000040000060400000003f000080be000000400000604001";
        assert_eq!(hex(&data), expected);
    }
}
