//! Standard ROS messages beside ours, so that viewers draw a live recording at once: joint angles as
//! `sensor_msgs/msg/JointState`, contacts as `sensor_msgs/msg/PointCloud2`.

use super::types::CDR_LITTLE_ENDIAN;
use blindgrasp_messages::{ContactSet, Header, TactileFrame};

/// The frame of everything in the palm frame.
const FRAME_ID: &str = "palm";

/// A standard message type, as it is written.
pub(super) struct StandardType {
    pub(super) topic: &'static str,
    pub(super) schema: &'static str,
    pub(super) definition: &'static str,
}

pub(super) const JOINT_STATES: StandardType =
    StandardType { topic: "/joint_states", schema: "sensor_msgs/msg/JointState", definition: JOINT_STATE };
pub(super) const CONTACT_POINTS: StandardType =
    StandardType { topic: "/contact_points", schema: "sensor_msgs/msg/PointCloud2", definition: POINT_CLOUD };

/// The topics of live recordings that are there for viewers, and follow from ours.
pub const TOPICS_FOR_VIEWERS: [&str; 2] = [JOINT_STATES.topic, CONTACT_POINTS.topic];

const JOINT_STATE: &str = "\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

const POINT_CLOUD: &str = "\
std_msgs/Header header
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
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

const FLOAT32: u8 = 7;
const FIELDS: [&str; 4] = ["x", "y", "z", "force"];
const BYTES_PER_POINT: u32 = 16;

/// A frame's joint angles, radians, under the hand's names.
pub(super) fn joint_state(header: &Header, names: &[String], frame: &TactileFrame, data: &mut Vec<u8>) {
    let mut cdr = Cdr::begin(data);
    cdr.header(header);
    cdr.length(names.len());
    names.iter().for_each(|name| cdr.string(name));
    cdr.length(frame.joints_rad.len());
    frame.joints_rad.iter().for_each(|joint_rad| cdr.f64(*joint_rad));
    // Neither velocities nor efforts.
    cdr.length(0);
    cdr.length(0);
}

/// A sample's contacts: palm frame, metres, and the force of each in newtons.
pub(super) fn contact_points(header: &Header, contacts: &ContactSet, data: &mut Vec<u8>) {
    let n_points = contacts.contacts.len() as u32;
    let mut cdr = Cdr::begin(data);
    cdr.header(header);
    cdr.u32(1);
    cdr.u32(n_points);
    cdr.length(FIELDS.len());
    for (idx, name) in FIELDS.iter().enumerate() {
        cdr.string(name);
        cdr.u32(4 * idx as u32);
        cdr.data.push(FLOAT32);
        cdr.u32(1);
    }
    cdr.data.push(0);
    cdr.u32(BYTES_PER_POINT);
    cdr.u32(BYTES_PER_POINT * n_points);
    cdr.u32(BYTES_PER_POINT * n_points);
    for contact in &contacts.contacts {
        for value in contact.position_m.iter().chain([&contact.force_newtons]) {
            cdr.data.extend((*value as f32).to_le_bytes());
        }
    }
    cdr.data.push(1);
}

/// Writes plain little-endian CDR, whose values are aligned from behind the four bytes that mark it.
struct Cdr<'a> {
    data: &'a mut Vec<u8>,
}

impl<'a> Cdr<'a> {
    fn begin(data: &'a mut Vec<u8>) -> Self {
        data.clear();
        data.extend(CDR_LITTLE_ENDIAN);
        Cdr { data }
    }

    fn align(&mut self, n_bytes: usize) {
        let n_body_bytes = self.data.len() - CDR_LITTLE_ENDIAN.len();
        self.data.resize(CDR_LITTLE_ENDIAN.len() + n_body_bytes.next_multiple_of(n_bytes), 0);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.data.extend(value.to_le_bytes());
    }

    fn f64(&mut self, value: f64) {
        self.align(8);
        self.data.extend(value.to_le_bytes());
    }

    fn length(&mut self, n_items: usize) {
        self.u32(n_items as u32);
    }

    fn string(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.data.extend(text.as_bytes());
        self.data.push(0);
    }

    /// `std_msgs/Header`; ROS counts seconds in 32 bits with sign.
    fn header(&mut self, header: &Header) {
        let secs = i32::try_from(header.stamp_nanos / 1_000_000_000).unwrap_or(i32::MAX);
        self.u32(secs.cast_unsigned());
        self.u32((header.stamp_nanos % 1_000_000_000) as u32);
        self.string(FRAME_ID);
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;
    use blindgrasp_messages::Contact;

    #[derive(Deserialize)]
    struct Stamp {
        secs: i32,
        nanos: u32,
        frame_id: String,
    }

    #[derive(Deserialize)]
    struct JointState {
        header: Stamp,
        names: Vec<String>,
        positions: Vec<f64>,
        velocities: Vec<f64>,
        efforts: Vec<f64>,
    }

    #[derive(Deserialize)]
    struct PointCloud {
        header: Stamp,
        height: u32,
        width: u32,
        fields: Vec<(String, u32, u8, u32)>,
        is_big_endian: bool,
        point_step: u32,
        row_step: u32,
        data: Vec<u8>,
        is_dense: bool,
    }

    fn read<'a, T: Deserialize<'a>>(data: &'a [u8]) -> T {
        let (value, n_bytes) = cdr_encoding::from_bytes::<T, byteorder::LittleEndian>(&data[4..]).expect("CDR");
        assert_eq!(n_bytes, data.len() - 4);
        value
    }

    #[test]
    fn another_cdr_reader_reads_the_joints() {
        let header = Header { stamp_nanos: 5_000_000_007, ..Header::default() };
        let frame = TactileFrame { joints_rad: vec![0.25, -1.5], ..TactileFrame::default() };
        let mut data = vec![9; 3];
        joint_state(&header, &["a".into(), "thumb".into()], &frame, &mut data);
        let found: JointState = read(&data);
        assert_eq!((found.header.secs, found.header.nanos, found.header.frame_id.as_str()), (5, 7, "palm"));
        assert_eq!((found.names, found.positions), (vec!["a".to_string(), "thumb".into()], vec![0.25, -1.5]));
        assert!(found.velocities.is_empty() && found.efforts.is_empty());
    }

    #[test]
    fn another_cdr_reader_reads_the_contacts() {
        let contact = Contact { position_m: [0.5, -0.25, 2.0], force_newtons: 3.5, ..Contact::default() };
        let contacts = ContactSet { contacts: vec![contact; 3], ..ContactSet::default() };
        let mut data = Vec::new();
        contact_points(&Header::default(), &contacts, &mut data);
        let found: PointCloud = read(&data);
        assert_eq!((found.header.secs, found.height, found.width), (0, 1, 3));
        assert_eq!((found.point_step, found.row_step, found.is_big_endian, found.is_dense), (16, 48, false, true));
        let fields: Vec<_> = found.fields.iter().map(|field| (field.0.as_str(), field.1, field.2, field.3)).collect();
        assert_eq!(fields, [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("force", 12, 7, 1)]);
        let values: Vec<f32> =
            found.data.chunks(4).map(|bytes| f32::from_le_bytes(bytes.try_into().expect("4"))).collect();
        assert_eq!(values[4..8], [0.5, -0.25, 2.0, 3.5]);
        assert_eq!(values.len(), 12);
    }
}
