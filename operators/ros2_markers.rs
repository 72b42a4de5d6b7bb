//! The hand as `visualization_msgs/msg/MarkerArray`: the shapes of its links, and its cells in the colour of their force; and its
//! cells as `sensor_msgs/msg/PointCloud2`.

use blindgrasp_messages::{Stamped, TactileFrame};
use blindgrasp_recording::cdr;
use blindgrasp_stages::hand::{Hand, LinkShape};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use serde::Serialize;

/// `Marker.type` of a box, a ball, a cylinder, and balls of one size.
const CUBE: i32 = 1;
const SPHERE: i32 = 2;
const CYLINDER: i32 = 3;
const SPHERE_LIST: i32 = 7;
/// A cell of this force has the colour of the greatest force.
const FULL_NEWTONS: f64 = 2.0;
const LINK_COLOUR: [f32; 4] = [0.7, 0.72, 0.75, 0.6];
const SILENT_COLOUR: [f32; 4] = [0.35, 0.35, 0.4, 1.0];
const FULL_COLOUR: [f32; 4] = [0.9, 0.1, 0.1, 1.0];

#[derive(Serialize, Clone, Default)]
struct Time {
    sec: i32,
    nanosec: u32,
}

/// The fields of `visualization_msgs/msg/Marker` in their order.
#[derive(Serialize, Default)]
struct Marker {
    stamp: Time,
    frame_id: &'static str,
    ns: &'static str,
    id: i32,
    kind: i32,
    action: i32,
    position: [f64; 3],
    orientation_xyzw: [f64; 4],
    scale: [f64; 3],
    color: [f32; 4],
    lifetime: Time,
    frame_locked: bool,
    points: Vec<[f64; 3]>,
    colors: Vec<[f32; 4]>,
    texture_resource: &'static str,
    texture: Texture,
    uv_coordinates: Vec<[f32; 2]>,
    text: &'static str,
    mesh_resource: &'static str,
    mesh_filename: &'static str,
    mesh_data: Vec<u8>,
    mesh_use_embedded_materials: bool,
}

/// `sensor_msgs/msg/CompressedImage`.
#[derive(Serialize, Default)]
struct Texture {
    stamp: Time,
    frame_id: &'static str,
    format: &'static str,
    data: Vec<u8>,
}

/// Writes the markers of a frame, in CDR.
///
/// # Errors
/// The frame is another hand's.
pub fn hand_markers(hand: &Hand, sample: &Stamped<TactileFrame>, data: &mut Vec<u8>) -> Result<(), String> {
    let frame = &sample.message;
    let palm_from_links = hand.palm_from_links(&frame.joints).map_err(|error| error.to_string())?;
    if frame.cells_newtons.len() != hand.n_cells() {
        return Err(format!("{} cells, the hand has {}", frame.cells_newtons.len(), hand.n_cells()));
    }
    let nanos = sample.header.stamp_nanos;
    let stamp =
        Time { sec: i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX), nanosec: (nanos % 1_000_000_000) as u32 };
    let marker = |ns, id: usize, kind, pose: &Isometry3<f64>, scale| Marker {
        stamp: stamp.clone(),
        frame_id: "palm",
        ns,
        id: id as i32,
        kind,
        position: pose.translation.vector.into(),
        orientation_xyzw: pose.rotation.coords.into(),
        scale,
        color: LINK_COLOUR,
        ..Marker::default()
    };
    let shapes = hand.links.iter().zip(&palm_from_links);
    let shapes = shapes.flat_map(|(link, pose)| link.shapes.iter().map(move |shape| (shape, pose)));
    let mut markers: Vec<Marker> = shapes
        .enumerate()
        .map(|(id, (shape, palm_from_link))| {
            let (kind, link_from_marker, scale) = solid(shape);
            marker("links", id, kind, &(palm_from_link * link_from_marker), scale)
        })
        .collect();
    let cells = hand.cells_in_palm(&frame.joints).map_err(|error| error.to_string())?;
    let smallest = hand.cells().map(|(_, cell)| cell.size_m[0].min(cell.size_m[1])).fold(f64::INFINITY, f64::min);
    let mut cell_marker = marker("cells", 0, SPHERE_LIST, &Isometry3::identity(), [smallest; 3]);
    cell_marker.points = cells.iter().map(|cell| cell.position_in_palm_m.coords.into()).collect();
    cell_marker.colors = frame.cells_newtons.iter().map(|newtons| colour(*newtons)).collect();
    markers.push(cell_marker);
    cdr::encode(&(markers,), data)
}

/// Writes all cells of a frame with their forces as `sensor_msgs/msg/PointCloud2`, in CDR.
///
/// # Errors
/// The frame is another hand's.
pub fn cell_points(hand: &Hand, sample: &Stamped<TactileFrame>, data: &mut Vec<u8>) -> Result<(), String> {
    let frame = &sample.message;
    let cells = hand.cells_in_palm(&frame.joints).map_err(|error| error.to_string())?;
    if frame.cells_newtons.len() != cells.len() {
        return Err(format!("{} cells, the hand has {}", frame.cells_newtons.len(), cells.len()));
    }
    let points = cells.iter().zip(&frame.cells_newtons);
    let points = points.map(|(cell, newtons)| (cell.position_in_palm_m.coords.into(), *newtons));
    cdr::force_points(&sample.header, points, data)
}

/// The marker of a shape: its type, its pose in the link and its outer sizes. A capsule is drawn as a cylinder, a hull as the
/// box around it.
fn solid(shape: &LinkShape) -> (i32, Isometry3<f64>, [f64; 3]) {
    let edge = shape.edge_radius_m;
    let pose = shape.link_from_shape;
    // RViz's cylinders stand along z, the shapes' along y.
    let upright = pose * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2);
    let cylinder = |radius: f64, length: f64| (CYLINDER, upright, [2.0 * radius, 2.0 * radius, length]);
    if let Some(ball) = shape.core.as_ball() {
        return (SPHERE, pose, [2.0 * (ball.radius + edge); 3]);
    }
    if let Some(found) = shape.core.as_cylinder() {
        return cylinder(found.radius + edge, 2.0 * (found.half_height + edge));
    }
    if let Some(found) = shape.core.as_capsule() {
        return cylinder(found.radius, found.height() + 2.0 * found.radius);
    }
    let around = shape.core.compute_local_aabb();
    let (middle, half) = (around.center(), around.half_extents());
    let pose = pose * nalgebra::Translation3::new(middle.x, middle.y, middle.z);
    (CUBE, pose, [half.x, half.y, half.z].map(|half| 2.0 * (half + edge)))
}

fn colour(newtons: f64) -> [f32; 4] {
    let share = (newtons / FULL_NEWTONS).clamp(0.0, 1.0) as f32;
    std::array::from_fn(|idx| SILENT_COLOUR[idx] + share * (FULL_COLOUR[idx] - SILENT_COLOUR[idx]))
}
