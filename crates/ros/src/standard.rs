//! The definitions of the standard messages that blindgrasp reads and writes.

use crate::definition::{Definition, DefinitionError};

/// A standard message type: its name, its own fields, and the types in it.
type Standard = (&'static str, &'static str, &'static [&'static str]);

/// The types that a message of the list below consists of.
const PARTS: [(&str, &str); 21] = [
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("std_msgs/MultiArrayDimension", "string label\nuint32 size\nuint32 stride\n"),
    ("std_msgs/MultiArrayLayout", "MultiArrayDimension[] dim\nuint32 data_offset\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"),
    ("geometry_msgs/Wrench", "Vector3 force\nVector3 torque\n"),
    ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Pose", "Point position\nQuaternion orientation\n"),
    ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"),
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"),
    ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"),
    ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n"),
    (
        "visualization_msgs/Marker",
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
         geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n\
         geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
         sensor_msgs/CompressedImage texture\nUVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n\
         MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
    ),
    (
        "service_msgs/ServiceEventInfo",
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n",
    ),
    ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation\n"),
    ("geometry_msgs/TransformStamped", "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"),
    ("diagnostic_msgs/KeyValue", "string key\nstring value\n"),
    (
        "diagnostic_msgs/DiagnosticStatus",
        "byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values\n",
    ),
    ("sensor_msgs/PointField", "string name\nuint32 offset\nuint8 datatype\nuint32 count\n"),
];

const HEADER: &[&str] = &["std_msgs/Header", "builtin_interfaces/Time"];
const ARRAY: &[&str] = &["std_msgs/MultiArrayLayout", "std_msgs/MultiArrayDimension"];

const TYPES: [Standard; 13] = [
    (
        "sensor_msgs/msg/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
        HEADER,
    ),
    (
        "sensor_msgs/msg/Image",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
        HEADER,
    ),
    (
        "sensor_msgs/msg/PointCloud2",
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\nuint32 point_step\n\
         uint32 row_step\nuint8[] data\nbool is_dense\n",
        &["std_msgs/Header", "builtin_interfaces/Time", "sensor_msgs/PointField"],
    ),
    (
        "sensor_msgs/msg/Imu",
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
         geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
         geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
        &["std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Quaternion", "geometry_msgs/Vector3"],
    ),
    (
        "geometry_msgs/msg/WrenchStamped",
        "std_msgs/Header header\nWrench wrench\n",
        &["std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Wrench", "geometry_msgs/Vector3"],
    ),
    ("std_msgs/msg/Float32MultiArray", "MultiArrayLayout layout\nfloat32[] data\n", ARRAY),
    ("std_msgs/msg/Float64MultiArray", "MultiArrayLayout layout\nfloat64[] data\n", ARRAY),
    ("std_msgs/msg/UInt16MultiArray", "MultiArrayLayout layout\nuint16[] data\n", ARRAY),
    ("std_msgs/msg/UInt8MultiArray", "MultiArrayLayout layout\nuint8[] data\n", ARRAY),
    (
        "visualization_msgs/msg/MarkerArray",
        "Marker[] markers\n",
        &[
            "visualization_msgs/Marker",
            "std_msgs/Header",
            "builtin_interfaces/Time",
            "builtin_interfaces/Duration",
            "geometry_msgs/Pose",
            "geometry_msgs/Point",
            "geometry_msgs/Quaternion",
            "geometry_msgs/Vector3",
            "std_msgs/ColorRGBA",
            "sensor_msgs/CompressedImage",
            "visualization_msgs/UVCoordinate",
            "visualization_msgs/MeshFile",
        ],
    ),
    ("std_msgs/msg/String", "string data\n", &[]),
    (
        "tf2_msgs/msg/TFMessage",
        "geometry_msgs/TransformStamped[] transforms\n",
        &[
            "geometry_msgs/TransformStamped",
            "geometry_msgs/Transform",
            "geometry_msgs/Vector3",
            "geometry_msgs/Quaternion",
            "std_msgs/Header",
            "builtin_interfaces/Time",
        ],
    ),
    (
        "diagnostic_msgs/msg/DiagnosticArray",
        "std_msgs/Header header\nDiagnosticStatus[] status\n",
        &["std_msgs/Header", "builtin_interfaces/Time", "diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue"],
    ),
];

/// The names of the types that are known here.
pub fn names() -> impl Iterator<Item = &'static str> {
    TYPES.iter().map(|(name, ..)| *name)
}

/// The definition of a standard type, with those of the types in it.
pub fn text(name: &str) -> Option<String> {
    let (_, fields, parts) = TYPES.iter().find(|(known, ..)| *known == name)?;
    Some(with_parts(fields, parts))
}

/// The fields of a message with the definitions of the standard messages in it, like `builtin_interfaces/Time`.
pub fn with_parts(fields: &str, parts: &[&str]) -> String {
    let part = |name: &&str| {
        let (_, fields) = PARTS.iter().find(|(known, _)| known == name).copied().unwrap_or_default();
        format!("{}\nMSG: {name}\n{fields}", "=".repeat(80))
    };
    fields.to_owned() + &parts.iter().map(part).collect::<String>()
}

/// The definition of a service `PACKAGE/srv/NAME` as one message, from which its hash is made: request, response, and the event
/// of a call. `parts` are the definitions of the messages in them, each behind its line `MSG: PACKAGE/NAME`.
///
/// # Errors
/// It is no service.
pub fn service(name: &str, request: &str, response: &str, parts: &str) -> Result<Definition, DefinitionError> {
    let line = "=".repeat(80);
    let event_parts = with_parts("", &["service_msgs/ServiceEventInfo", "builtin_interfaces/Time"]);
    Definition::parse(
        name,
        &format!(
            "{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message\n\
             {line}\nMSG: {name}_Request\n{request}\n{line}\nMSG: {name}_Response\n{response}\n{line}\nMSG: {name}_Event\n\
             service_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response\n{parts}{event_parts}"
        ),
    )
}

/// The definition of a standard type.
pub fn definition(name: &str) -> Option<Definition> {
    Definition::parse(name, &text(name)?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_has_the_definitions_of_its_parts() {
        for name in names() {
            assert!(definition(name).is_some(), "{name}");
        }
    }

    /// As `rosidl` of Jazzy writes it down, in std_msgs/msg/String.json.
    #[test]
    fn a_hash_is_that_of_ros() {
        let hash = definition("std_msgs/msg/String").expect("known").hash();
        assert_eq!(hash, "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18");
    }
}
