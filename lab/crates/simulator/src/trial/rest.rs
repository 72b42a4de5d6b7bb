//! How a target stands: on a face of its convex hull, with its centre of mass over the face.

use nalgebra::{Isometry3, Point3, UnitQuaternion, UnitVector3, Vector3};
use rapier3d_f64::parry::shape::{ConvexPolyhedron, SharedShape};

use crate::trial::world::{from_engine_vector, to_engine};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::pose_from_isometry;

/// A target that falls over when it is tilted by less than this is put on another side.
const LEAST_TILT_RAD: f64 = 0.175;

/// Normals that differ by less are of one face.
const SAME_DIRECTION: f64 = 1e-4;

/// The convex hull of an object; of one that is flat, its own shape.
pub(super) fn hull(object: &Object) -> SharedShape {
    let corners: Vec<_> = object.to_mesh().vertices_m.iter().map(|corner| to_engine(&corner.coords)).collect();
    SharedShape::convex_hull(&corners).unwrap_or_else(|| object.shape.clone())
}

/// The turn from the object's frame to one with z up in which it stands. It is none if it stands as it is, and
/// otherwise that onto the face on which it can be tilted the farthest.
pub(super) fn rest_rotation(hull: &SharedShape, centre_of_mass_m: &Point3<f64>) -> UnitQuaternion<f64> {
    let Some(hull) = hull.as_convex_polyhedron() else { return UnitQuaternion::identity() };
    let down = -Vector3::z_axis();
    let faces = faces(hull, centre_of_mass_m);
    let as_built = faces.iter().filter(|face| face.outward.dot(&down) > 1.0 - SAME_DIRECTION);
    if as_built.map(|face| face.tilt_rad).fold(0.0, f64::max) >= LEAST_TILT_RAD {
        return UnitQuaternion::identity();
    }
    match faces.iter().max_by(|a, b| a.tilt_rad.total_cmp(&b.tilt_rad)) {
        Some(best) if best.tilt_rad > 0.0 => UnitQuaternion::rotation_between(&best.outward, &down)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)),
        _ => UnitQuaternion::identity(),
    }
}

/// The lowest z of a hull.
pub(super) fn lowest_m(hull: &SharedShape, world_from_target: &Isometry3<f64>) -> f64 {
    match hull.as_convex_polyhedron() {
        // Not the box around it: that of a turned body is a turned box's.
        Some(hull) => {
            let heights_m =
                hull.points().iter().map(|point| (world_from_target * Point3::from(from_engine_vector(*point))).z);
            heights_m.fold(f64::INFINITY, f64::min)
        }
        None => hull.compute_aabb(&pose_from_isometry(world_from_target)).mins.z,
    }
}

/// A face to stand on.
struct Face {
    outward: UnitVector3<f64>,
    /// How far the target can be tilted over the nearest edge before its centre of mass is beyond it; negative if it is.
    tilt_rad: f64,
}

fn faces(hull: &ConvexPolyhedron, centre_of_mass_m: &Point3<f64>) -> Vec<Face> {
    let points: Vec<Point3<f64>> = hull.points().iter().map(|point| from_engine_vector(*point).into()).collect();
    let standing_faces = hull.faces().iter().filter(|face| face.num_vertices_or_edges >= 3);
    standing_faces
        .map(|face| {
            let first = face.first_vertex_or_edge as usize;
            let corners = &hull.vertices_adj_to_face()[first..first + face.num_vertices_or_edges as usize];
            let corners: Vec<&Point3<f64>> = corners.iter().map(|idx| &points[*idx as usize]).collect();
            let outward = UnitVector3::new_normalize(from_engine_vector(face.normal));
            let height_m = (corners[0] - centre_of_mass_m).dot(&outward);
            // Corners go round counter-clockwise, seen from outside.
            let edges = (0..corners.len()).map(|idx| (corners[idx], corners[(idx + 1) % corners.len()]));
            let inside_m = edges.filter_map(|(from, to)| {
                let inward = outward.cross(&(to - from)).try_normalize(1e-12)?;
                Some((centre_of_mass_m - from).dot(&inward))
            });
            let inside_m = inside_m.fold(f64::INFINITY, f64::min);
            Face { outward, tilt_rad: inside_m.atan2(height_m.max(1e-9)) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_objects::select;

    /// A box of these half edges, its centre of mass off the middle by `off_m` along z.
    fn turned(half: [f64; 3], off_m: f64) -> UnitQuaternion<f64> {
        let shape = SharedShape::cuboid(half[0], half[1], half[2]);
        let object = Object::new("box".into(), "box".into(), shape, 1000.0, false);
        rest_rotation(&hull(&object), &Point3::new(0.0, 0.0, off_m))
    }

    #[test]
    fn what_stands_stays_and_what_would_topple_lies_down() {
        // Tilts by atan(30/30), and by atan(10/100).
        assert_eq!(turned([0.03, 0.03, 0.03], 0.0), UnitQuaternion::identity());
        let lying = turned([0.01, 0.02, 0.1], 0.0);
        let up = lying * Vector3::x_axis();
        assert!(up.z.abs() > 1.0 - 1e-9, "on its largest face: {up:?}");
        // 30 mm wide and 100 mm up: 0.29 rad; 160 mm up: 0.185; 190 mm up: 0.157.
        assert_eq!(turned([0.03, 0.03, 0.1], 0.06), UnitQuaternion::identity());
        assert_ne!(turned([0.03, 0.03, 0.1], 0.09), UnitQuaternion::identity());
    }

    #[test]
    fn cutlery_lies_and_mugs_stand() {
        for object in select("mug,knife,spoon").expect("objects") {
            let rest = rest_rotation(&hull(&object), &object.centre_of_mass_m);
            let mut mesh = object.to_mesh();
            mesh.vertices_m.iter_mut().for_each(|corner| *corner = rest * *corner);
            let [low, high] = mesh.bounds();
            let size = high - low;
            match object.class.as_str() {
                "mug" => assert_eq!(rest, UnitQuaternion::identity(), "{}", object.name),
                _ => {
                    assert!(size.z < 0.5 * size.x.max(size.y), "{}: {size}", object.name);
                }
            }
        }
    }
}
