//! Standard ROS messages beside ours, so that viewers draw a recording without plug-ins: the hand's URDF as
//! `std_msgs/msg/String`, joint angles as `sensor_msgs/msg/JointState`, the links' poses as `tf2_msgs/msg/TFMessage`, and
//! contacts as `sensor_msgs/msg/PointCloud2`.

use std::sync::Arc;

use blindgrasp_messages::{ContactSet, Header, Record, Stamped, TactileFrame};
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

pub(super) const ROBOT_DESCRIPTION: StandardType =
    StandardType { topic: "/robot_description", schema: "std_msgs/msg/String", definition: "string data\n" };
pub(super) const TRANSFORMS: StandardType =
    StandardType { topic: "/tf", schema: "tf2_msgs/msg/TFMessage", definition: TF_MESSAGE };

/// The topics of recordings that are there for viewers. Their content follows from the hand and our own topics.
pub const TOPICS_FOR_VIEWERS: [&str; 4] =
    [JOINT_STATES.topic, CONTACT_POINTS.topic, ROBOT_DESCRIPTION.topic, TRANSFORMS.topic];

/// The poses of the hand's links at the joints' values.
pub type LinkPoses = Arc<dyn Fn(&[f64]) -> Vec<LinkPose> + Send + Sync>;

/// The hand of a recording as viewers draw it.
#[derive(Clone)]
pub struct ShownHand {
    /// The joints in the hand's order.
    pub joint_names: Vec<String>,
    /// The pad layout (YAML).
    pub layout: String,
    pub urdf: String,
    /// The poses of the links for values of the joints.
    pub link_poses: LinkPoses,
}

/// The pose of a link in the frame of its parent.
pub struct LinkPose {
    pub parent: String,
    pub link: String,
    pub position_m: [f64; 3],
    pub rotation_xyzw: [f64; 4],
}

impl ShownHand {
    /// The attached pad layout.
    pub const LAYOUT_NAME: &str = "hand.yaml";
    /// The attached URDF.
    pub const URDF_NAME: &str = "hand.urdf";

    /// The files to attach, by name.
    pub(super) fn files(&self) -> [(&str, &[u8]); 2] {
        [(Self::LAYOUT_NAME, self.layout.as_bytes()), (Self::URDF_NAME, self.urdf.as_bytes())]
    }
}

/// The messages for viewers, each with its type.
type ForViewers = Vec<(&'static StandardType, Vec<u8>)>;

/// Makes the messages for viewers. The first topic of each type of ours is the one that viewers see.
#[derive(Default)]
pub(super) struct ViewerMessages {
    pub(super) hand: Option<ShownHand>,
    joint_topic: Option<String>,
    contact_topic: Option<String>,
}

impl ViewerMessages {
    /// The messages that go with a sample. With the first frame of a file goes the description of the hand.
    pub(super) fn of_record(
        &mut self,
        topic: &str,
        record: &Record,
        is_first_of_file: bool,
    ) -> Result<ForViewers, String> {
        match record {
            Record::Tactile(frame) => self.of_frame(topic, frame, is_first_of_file),
            Record::Contacts(contacts) => self.of_contacts(topic, contacts),
            _ => Ok(Vec::new()),
        }
    }

    fn of_frame(
        &mut self,
        topic: &str,
        frame: &Stamped<TactileFrame>,
        is_first_of_file: bool,
    ) -> Result<ForViewers, String> {
        let mut messages: ForViewers = Vec::new();
        let Some(hand) = &self.hand else { return Ok(messages) };
        let Stamped { header, message } = frame;
        if message.joints.len() != hand.joint_names.len() || !is_first(&mut self.joint_topic, topic) {
            return Ok(messages);
        }
        if is_first_of_file {
            let mut data = Vec::new();
            encode(&hand.urdf, &mut data)?;
            messages.push((&ROBOT_DESCRIPTION, data));
        }
        let mut data = Vec::new();
        joint_state(header, &hand.joint_names, message, &mut data)?;
        messages.push((&JOINT_STATES, data));
        let poses = (hand.link_poses)(&message.joints);
        let transforms = Vec::from_iter(poses.iter().map(|pose| TransformStamped::new(header, pose)));
        let mut data = Vec::new();
        encode(&transforms, &mut data)?;
        messages.push((&TRANSFORMS, data));
        Ok(messages)
    }

    fn of_contacts(&mut self, topic: &str, contacts: &Stamped<ContactSet>) -> Result<ForViewers, String> {
        if !is_first(&mut self.contact_topic, topic) {
            return Ok(Vec::new());
        }
        let mut data = Vec::new();
        contact_points(&contacts.header, &contacts.message, &mut data)?;
        Ok(vec![(&CONTACT_POINTS, data)])
    }
}

fn is_first(first: &mut Option<String>, topic: &str) -> bool {
    first.get_or_insert_with(|| topic.into()) == topic
}

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

/// The definition of `sensor_msgs/msg/JointState`, with those of the types in it.
pub const JOINT_STATE: &str = with_header!(
    "\
string[] name
float64[] position
float64[] velocity
float64[] effort
"
);

/// The same of `sensor_msgs/msg/PointCloud2`.
pub const POINT_CLOUD: &str = with_header!(
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

const TF_MESSAGE: &str = concat!(
    "geometry_msgs/TransformStamped[] transforms\n",
    "================================================================================\n",
    "MSG: geometry_msgs/TransformStamped\n",
    with_header!(
        "\
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"
    )
);

const FLOAT32: u8 = 7;
const FIELDS: [&str; 4] = ["x", "y", "z", "force"];
const BYTES_PER_POINT: u32 = 16;

/// `std_msgs/Header`; ROS counts seconds in 32 bits with sign.
#[derive(Serialize)]
struct StandardHeader<'a> {
    sec: i32,
    nanosec: u32,
    frame_id: &'a str,
}

/// `sensor_msgs/JointState`.
#[derive(Serialize)]
struct JointState<'a> {
    header: StandardHeader<'a>,
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
    header: StandardHeader<'static>,
    height: u32,
    width: u32,
    fields: Vec<PointField>,
    is_bigendian: bool,
    point_step: u32,
    row_step: u32,
    data: Vec<u8>,
    is_dense: bool,
}

/// `geometry_msgs/TransformStamped`.
#[derive(Serialize)]
struct TransformStamped<'a> {
    header: StandardHeader<'a>,
    child_frame_id: &'a str,
    translation: [f64; 3],
    rotation: [f64; 4],
}

impl<'a> TransformStamped<'a> {
    fn new(header: &Header, pose: &'a LinkPose) -> Self {
        TransformStamped {
            header: StandardHeader::new(header, &pose.parent),
            child_frame_id: &pose.link,
            translation: pose.position_m,
            rotation: pose.rotation_xyzw,
        }
    }
}

impl<'a> StandardHeader<'a> {
    fn new(header: &Header, frame_id: &'a str) -> Self {
        StandardHeader {
            sec: i32::try_from(header.stamp_nanos / 1_000_000_000).unwrap_or(i32::MAX),
            nanosec: (header.stamp_nanos % 1_000_000_000) as u32,
            frame_id,
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
    let header = StandardHeader::new(header, FRAME_ID);
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
        header: StandardHeader::new(header, FRAME_ID),
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
    fn links_are_as_ros_writes_them_and_the_first_frame_describes_the_hand() {
        let pose = |joints: &[f64]| LinkPose {
            parent: "palm".into(),
            link: "tip".into(),
            position_m: [joints[0], 0.0, 2.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        };
        let hand = ShownHand {
            joint_names: vec!["a".into()],
            layout: String::new(),
            urdf: "<robot/>".into(),
            link_poses: Arc::new(move |joints| vec![pose(joints)]),
        };
        let mut viewer = ViewerMessages { hand: Some(hand), ..ViewerMessages::default() };
        let message = TactileFrame { joints: vec![0.5], ..TactileFrame::default() };
        let frame = Stamped { header: Header { stamp_nanos: 5_000_000_007, ..Header::default() }, message };
        let messages = viewer.of_frame("/tactile", &frame, true).expect("messages");
        let found: Vec<_> = messages.iter().map(|(standard, data)| (standard.topic, hex(data))).collect();
        assert_eq!(found[0], ("/robot_description", "00010000090000003c726f626f742f3e00".into()));
        assert_eq!(found[1].0, "/joint_states");
        let expected = "000100000100000005000000070000000500000070616c6d000000000400000074697000000000000000e03f00000000\
             000000000000000000000040000000000000000000000000000000000000000000000000000000000000f03f";
        assert_eq!(found[2], ("/tf", expected.into()));
        let of_next = viewer.of_frame("/tactile", &frame, false).expect("messages");
        assert_eq!(of_next.len(), 2);
        assert!(viewer.of_frame("/other", &frame, true).expect("messages").is_empty());
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
