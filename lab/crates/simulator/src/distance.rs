//! The distance of a link and an object, and their closest points.
//!
//! Links are convex cores with rounded edges. Objects are convex, or many convex parts (the triangles of a mesh, the
//! pieces of a compound) under parry's tree of bounding boxes; the tree is searched nearest part first.

use std::cell::Cell;

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use parry3d_f64::bounding_volume::BoundingVolume;
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::partitioning::{BvhLeafCost, BvhNode};
use parry3d_f64::query;
use parry3d_f64::query::details::contact_support_map_support_map;
use parry3d_f64::shape::{CompositeShape, ConvexPolyhedron, Shape, SupportMap, Triangle};

use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{LinkShape, pose_from_isometry};

/// A link's collision shape, with bounds.
pub struct PlacedShape<'a> {
    pub link_idx: usize,
    pub link_from_shape: Isometry3<f64>,
    pub core: &'a dyn Shape,
    pub edge_radius_m: f64,
    /// The core's box in its own frame.
    box_centre: Vector,
    box_half: Vector,
    /// Where the core is a hull of a mesh, without rounded edges: the planes of its faces, in its own frame.
    faces: Vec<Plane>,
    /// The bounding sphere in the link's frame, edges included.
    pub(super) centre_in_link: Point3<f64>,
    pub(super) radius_m: f64,
}

/// The closest points of two bodies, in the frame of the poses given.
#[derive(Debug, Clone, Copy)]
pub struct ClosestPoints {
    /// Negative if the bodies overlap.
    pub(super) distance_m: f64,
    pub(super) point_on_first: Vector,
    pub(super) point_on_second: Vector,
    /// Unit, from the first to the second.
    pub(super) direction: Vector,
}

impl BvhLeafCost for ClosestPoints {
    fn cost(&self) -> f64 {
        self.distance_m
    }
}

/// A plane with a shape behind it: the shape is at least as far as the plane from all that is before it.
#[derive(Clone, Copy)]
struct Plane {
    normal: Vector,
    /// Along the normal.
    offset_m: f64,
}

impl Plane {
    fn distance_m(&self, point: Vector) -> f64 {
        self.normal.dot(point) - self.offset_m
    }

    fn triangle_bound_m(&self, triangle: &Triangle) -> f64 {
        self.distance_m(triangle.a).min(self.distance_m(triangle.b)).min(self.distance_m(triangle.c))
    }

    fn node_bound_m(&self, node: &BvhNode) -> f64 {
        let half = (node.maxs() - node.mins()) * 0.5;
        self.distance_m(node.center()) - self.normal.abs().dot(half)
    }
}

/// The planes of a hull's faces. Faces that are nearly parallel are one, whose plane is put at the outermost corner.
fn faces(hull: &ConvexPolyhedron) -> Vec<Plane> {
    let mut planes = Vec::new();
    for face in hull.faces() {
        let normal = face.normal;
        planes.push(Plane { normal, offset_m: normal.dot(hull.local_support_point(normal)) });
    }
    planes
}

/// The points that are in a shape or near it.
pub(super) struct Within<'a> {
    shape: &'a PlacedShape<'a>,
    pose: Pose,
    reach_m: f64,
    /// The faces of a hull that are near those points: they are behind all others.
    faces: Vec<Plane>,
}

impl Within<'_> {
    pub(super) fn contains(&self, point: Vector) -> bool {
        if self.shape.faces.is_empty() {
            return self.reaches(point);
        }
        // The distance to a hull takes GJK, and the faces tell most points.
        let in_shape = self.pose.inverse_transform_point(point);
        let mut distance_m = f64::NEG_INFINITY;
        let mut on_face = in_shape;
        for face in &self.faces {
            let of_face_m = face.distance_m(in_shape);
            if of_face_m > distance_m {
                (distance_m, on_face) = (of_face_m, in_shape - face.normal * of_face_m);
            }
        }
        if distance_m <= 0.0 || distance_m > self.reach_m {
            return distance_m <= 0.0;
        }
        self.faces.iter().all(|face| face.distance_m(on_face) <= 1e-9) || self.reaches(point)
    }

    fn reaches(&self, point: Vector) -> bool {
        self.shape.distance_to_point_m(&self.pose, point) <= self.reach_m
    }
}

/// Distances that nothing depends on are measured up to here.
const FAR_M: f64 = 10.0;

impl<'a> PlacedShape<'a> {
    pub(super) fn new(link_idx: usize, shape: &'a LinkShape) -> Self {
        let sphere = shape.core.compute_local_bounding_sphere();
        let around = shape.core.compute_local_aabb();
        let faces = match shape.core.as_convex_polyhedron() {
            Some(hull) if shape.edge_radius_m == 0.0 => faces(hull),
            _ => Vec::new(),
        };
        PlacedShape {
            link_idx,
            link_from_shape: shape.link_from_shape,
            core: &*shape.core,
            edge_radius_m: shape.edge_radius_m,
            box_centre: around.center(),
            box_half: around.half_extents(),
            faces,
            centre_in_link: shape.link_from_shape * Point3::new(sphere.center.x, sphere.center.y, sphere.center.z),
            radius_m: sphere.radius + shape.edge_radius_m,
        }
    }

    /// The pose of the core in the palm frame.
    pub(super) fn pose_in_palm(&self, palm_from_links: &[Isometry3<f64>]) -> Pose {
        pose_from_isometry(&(palm_from_links[self.link_idx] * self.link_from_shape))
    }

    /// Distance of the bounding spheres: the shape and the object are at least so far from each other.
    pub(super) fn sphere_distance_m(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
    ) -> f64 {
        let between = palm_from_link * self.centre_in_link - palm_from_object * object.centre_of_mass_m;
        between.norm() - self.radius_m - object.max_radius_m
    }

    /// The nearest points of the shape and the object, both placed in the palm frame. `None` if they are farther than
    /// `within_m` from each other.
    pub(super) fn closest_to_object(
        &self,
        palm_from_shape: &Pose,
        palm_from_object: &Pose,
        object: &Object,
        within_m: f64,
    ) -> Option<ClosestPoints> {
        let Some(composite) = object.shape.as_composite_shape() else {
            let closest = self.closest_to_convex(palm_from_shape, palm_from_object, &*object.shape, within_m)?;
            return (closest.distance_m <= within_m).then_some(closest);
        };
        let shape_from_object = palm_from_shape.inv_mul(palm_from_object);
        // Where the surface curves away from the shape, the plane at the nearest part so far leaves out all others.
        let plane: Cell<Option<Plane>> = Cell::new(None);
        let (part_idx, closest) = composite.bvh().find_best(
            within_m,
            |node, best_m| {
                let bound_m = self.node_bound_m(node, &shape_from_object);
                if bound_m >= best_m {
                    return bound_m;
                }
                plane.get().map_or(bound_m, |plane| bound_m.max(plane.node_bound_m(node)))
            },
            |part_idx, best_m| {
                with_part(composite, part_idx, palm_from_object, |palm_from_part, part| {
                    if let Some(triangle) = part.as_triangle()
                        && (plane.get().is_some_and(|plane| plane.triangle_bound_m(triangle) >= best_m)
                            || self.triangle_bound_m(triangle, &shape_from_object) >= best_m)
                    {
                        return None;
                    }
                    let closest = self.closest_to_convex(palm_from_shape, palm_from_part, part, best_m)?;
                    if closest.distance_m < best_m {
                        plane.set(self.plane(palm_from_shape, palm_from_object, closest.direction));
                    }
                    Some(closest)
                })
            },
        )?;
        // The distance is exact, the points that GJK names need not be: on a face, many are as near.
        let on_part = with_part(composite, part_idx, palm_from_object, |palm_from_part, part| {
            Some(part.project_point(palm_from_part, closest.point_on_second, false).point)
        });
        Some(ClosestPoints { point_on_second: on_part.unwrap_or(closest.point_on_second), ..closest })
    }

    /// A bound below the distance of the shape and the object that costs little; at most `within_m`.
    pub(super) fn bound_m(
        &self,
        palm_from_shape: &Pose,
        palm_from_object: &Pose,
        object: &Object,
        within_m: f64,
    ) -> f64 {
        let Some(mesh) = object.shape.as_trimesh() else { return f64::NEG_INFINITY };
        let shape_from_object = palm_from_shape.inv_mul(palm_from_object);
        let least = mesh.bvh().find_best(
            within_m,
            |node, _| self.node_bound_m(node, &shape_from_object),
            |idx, _| Some(self.triangle_bound_m(&mesh.triangle(idx), &shape_from_object)),
        );
        least.map_or(within_m, |(_, bound_m)| bound_m)
    }

    /// A bound below the distance to all that is in a node: its sphere against the core's box.
    fn node_bound_m(&self, node: &BvhNode, shape_from_object: &Pose) -> f64 {
        let half = (node.maxs() - node.mins()) * 0.5;
        let from_centre = shape_from_object.transform_point(node.center()) - self.box_centre;
        (from_centre.abs() - self.box_half).max(Vector::ZERO).length() - half.length() - self.edge_radius_m
    }

    /// The plane that touches the shape in a direction (palm frame), in the object's frame.
    fn plane(&self, palm_from_shape: &Pose, palm_from_object: &Pose, direction: Vector) -> Option<Plane> {
        let outermost = self.core.as_support_map()?.support_point(palm_from_shape, direction);
        let in_palm_m = direction.dot(outermost) + self.edge_radius_m;
        let offset_m = in_palm_m - direction.dot(palm_from_object.translation);
        Some(Plane { normal: palm_from_object.rotation.inverse() * direction, offset_m })
    }

    /// A bound below the distance to a triangle: the largest of those along the axes of the core's box together, and
    /// along the triangle's normal.
    fn triangle_bound_m(&self, triangle: &Triangle, shape_from_object: &Pose) -> f64 {
        let corners = [triangle.a, triangle.b, triangle.c];
        let [a, b, c] = corners.map(|corner| shape_from_object.transform_point(corner) - self.box_centre);
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let along_axes_m = (low - self.box_half).max(-high - self.box_half).max(Vector::ZERO).length();
        let normal = (b - a).cross(c - a);
        let length = normal.length();
        let along_normal_m =
            if length > 0.0 { (normal.dot(a).abs() - normal.abs().dot(self.box_half)) / length } else { 0.0 };
        along_axes_m.max(along_normal_m) - self.edge_radius_m
    }

    /// A bound above [`PlacedShape::stop_z`]: that of the bounding spheres.
    pub(super) fn spheres_stop_z(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
        distance_m: f64,
    ) -> f64 {
        let com = palm_from_object * object.centre_of_mass_m;
        let reach_m = self.radius_m + object.max_radius_m + distance_m;
        spheres_stop_z(palm_from_link * self.centre_in_link, reach_m, Vector::new(com.x, com.y, com.z))
    }

    /// How far the object, placed at `palm_from_object`, must be raised along the palm's +z to keep the distance from this
    /// shape when it comes down from above. It is `at_least_z` if that is more, as where it passes by.
    pub(super) fn stop_z(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
        distance_m: f64,
        at_least_z: f64,
    ) -> f64 {
        let first_z = self.spheres_stop_z(palm_from_link, palm_from_object, object, distance_m);
        if first_z <= at_least_z {
            return at_least_z;
        }
        let palm_from_shape = pose_from_isometry(&(palm_from_link * self.link_from_shape));
        let at_zero = pose_from_isometry(palm_from_object);
        let of_convex = |palm_from_part: &Pose, part: &dyn Shape, first_z: f64, at_least_z: f64| {
            self.convex_stop_z(&palm_from_shape, palm_from_part, part, distance_m, first_z, at_least_z)
        };
        let Some(composite) = object.shape.as_composite_shape() else {
            return of_convex(&at_zero, &*object.shape, first_z, at_least_z).max(at_least_z);
        };
        let centre = palm_from_link * self.centre_in_link;
        let at_most = |centre_at_zero: Vector, radius_m: f64| {
            spheres_stop_z(centre, self.radius_m + radius_m + distance_m, centre_at_zero)
        };
        // And so do two boxes along the palm's axes.
        let around = self.core.compute_aabb(&palm_from_shape).loosened(self.edge_radius_m + distance_m);
        let boxes_at_most = |low: Vector, high: Vector| {
            let is_beside =
                low.x > around.maxs.x || high.x < around.mins.x || low.y > around.maxs.y || high.y < around.mins.y;
            if is_beside { f64::NEG_INFINITY } else { around.maxs.z - low.z }
        };
        // The tree is searched for the least cost: the cost is -z.
        let least = composite.bvh().find_best(
            -at_least_z,
            |node, _| {
                let half_m = (node.maxs() - node.mins()).length() * 0.5;
                let middle = at_zero.transform_point(node.center());
                let half = Vector::new(half_m, half_m, half_m);
                -at_most(middle, half_m).min(boxes_at_most(middle - half, middle + half))
            },
            |part_idx, best_cost| {
                with_part(composite, part_idx, &at_zero, |palm_from_part, part| {
                    let bounds = part.compute_aabb(palm_from_part);
                    let half_m = bounds.half_extents().length();
                    let first_z = at_most(bounds.center(), half_m).min(boxes_at_most(bounds.mins, bounds.maxs));
                    if -first_z >= best_cost {
                        return None;
                    }
                    Some(-of_convex(palm_from_part, part, first_z, -best_cost))
                })
            },
        );
        least.map_or(at_least_z, |(_, cost)| -cost)
    }

    /// [`PlacedShape::stop_z`] for one convex part, coming down from `first_z`; anything up to `at_least_z` if it is no more
    /// than that. The plane between two convex bodies bounds how far the part can come down, and a plane that it moves away
    /// from says that it never arrives. Newton-like, so a few steps do.
    fn convex_stop_z(
        &self,
        palm_from_shape: &Pose,
        at_zero: &Pose,
        part: &dyn Shape,
        distance_m: f64,
        first_z: f64,
        at_least_z: f64,
    ) -> f64 {
        let mut z = first_z;
        for _ in 0..100 {
            if z <= at_least_z {
                return f64::NEG_INFINITY;
            }
            let mut palm_from_part = *at_zero;
            palm_from_part.translation.z += z;
            let Some(closest) = self.closest_to_convex(palm_from_shape, &palm_from_part, part, FAR_M) else {
                return f64::NEG_INFINITY;
            };
            if closest.distance_m <= 1.02 * distance_m {
                return z;
            }
            if closest.direction.z <= 1e-9 {
                return f64::NEG_INFINITY;
            }
            z -= (closest.distance_m - distance_m) / closest.direction.z;
        }
        f64::NEG_INFINITY
    }

    fn closest_to_convex(
        &self,
        palm_from_shape: &Pose,
        palm_from_part: &Pose,
        part: &dyn Shape,
        within_m: f64,
    ) -> Option<ClosestPoints> {
        closest_of_rounded((palm_from_shape, self.core, self.edge_radius_m), (palm_from_part, part, 0.0), within_m)
    }

    /// The nearest points of two links' shapes.
    pub(super) fn closest_to_shape(
        &self,
        palm_from_shape: &Pose,
        other: &PlacedShape<'_>,
        palm_from_other: &Pose,
    ) -> Option<ClosestPoints> {
        let [first, second] =
            [(palm_from_shape, self.core, self.edge_radius_m), (palm_from_other, other.core, other.edge_radius_m)];
        closest_of_rounded(first, second, FAR_M)
    }

    /// Distance of a point of the palm frame to the shape; 0 inside.
    pub(super) fn distance_to_point_m(&self, palm_from_shape: &Pose, point: Vector) -> f64 {
        (self.core.distance_to_point(palm_from_shape, point, true) - self.edge_radius_m).max(0.0)
    }

    /// Tells which points are in the shape or at most `reach_m` from it, among those within a radius of `centre`. All are in the
    /// frame in which `pose` places the shape.
    pub(super) fn within(&self, pose: Pose, reach_m: f64, centre: Vector, radius_m: f64) -> Within<'_> {
        let centre = pose.inverse_transform_point(centre);
        let faces = self.faces.iter().filter(|face| face.distance_m(centre) > -radius_m - reach_m);
        Within { shape: self, pose, reach_m, faces: faces.copied().collect() }
    }

    /// Curvature of the shape's surface where its outward normal is `normal`, both in the shape's frame: a symmetric
    /// matrix (1/m) whose null space holds the normal. Flat for shapes other than boxes, cylinders, balls and capsules.
    pub(super) fn curvature(&self, normal: Vector3<f64>) -> Matrix3<f64> {
        /// A normal nearer than this to an axis of the shape is that of a flat face or of a straight side.
        const ALONG: f64 = 0.02;
        // An edge without a radius is as sharp as this.
        let edge = 1.0 / self.edge_radius_m.max(1e-4);
        let tangential = Matrix3::identity() - normal * normal.transpose();
        let is_across = normal.map(|component| if component.abs() > ALONG { 1.0 } else { 0.0 });
        if self.core.as_cuboid().is_some() {
            // On a face one component is across, on an edge two, on a corner three.
            let spread = Matrix3::from_diagonal(&is_across);
            if is_across.sum() < 1.5 { Matrix3::zeros() } else { tangential * spread * tangential * edge }
        } else if let Some(cylinder) = self.core.as_cylinder() {
            let radial = normal.x.hypot(normal.z);
            if radial < ALONG {
                return Matrix3::zeros();
            }
            let around = Vector3::new(normal.z, 0.0, -normal.x) / radial;
            let around_curvature = radial / (cylinder.radius + self.edge_radius_m * radial);
            let meridian = normal.cross(&around);
            let meridian_curvature = if is_across.y > 0.0 { edge } else { 0.0 };
            around * around.transpose() * around_curvature + meridian * meridian.transpose() * meridian_curvature
        } else if let Some(ball) = self.core.as_ball() {
            tangential / ball.radius
        } else if let Some(capsule) = self.core.as_capsule() {
            let on_side = is_across.y == 0.0;
            let along = Vector3::y() * Vector3::y().transpose();
            (if on_side { tangential - along } else { tangential }) / capsule.radius
        } else {
            Matrix3::zeros()
        }
    }
}

/// How far a point must be raised along z from where it is to be as far as `reach_m` from `centre` when it comes down from
/// above; minus infinity where it passes by.
fn spheres_stop_z(centre: Point3<f64>, reach_m: f64, at_zero: Vector) -> f64 {
    let aside_m = (at_zero.x - centre.x).hypot(at_zero.y - centre.y);
    let up_m = (reach_m * reach_m - aside_m * aside_m).sqrt();
    if aside_m < reach_m { centre.z + up_m - at_zero.z } else { f64::NEG_INFINITY }
}

/// The closest points of two convex bodies, each a pose, a core and a radius around it. `None` if they are farther than
/// `within_m` from each other, as far as that is known early.
fn closest_of_rounded(
    (pose_a, a, radius_a_m): (&Pose, &dyn Shape, f64),
    (pose_b, b, radius_b_m): (&Pose, &dyn Shape, f64),
    within_m: f64,
) -> Option<ClosestPoints> {
    let prediction_m = within_m + radius_a_m + radius_b_m;
    let contact = match (a.as_support_map(), b.as_triangle()) {
        // The dispatcher would come to the same, by way of every other pair of shapes.
        (Some(a), Some(b)) => {
            let mut found = contact_support_map_support_map(&pose_a.inv_mul(pose_b), a, b, prediction_m)?;
            found.transform_by_mut(pose_a, pose_b);
            found
        }
        _ => query::contact(pose_a, a, pose_b, b, prediction_m).ok().flatten()?,
    };
    Some(ClosestPoints {
        distance_m: contact.dist - radius_a_m - radius_b_m,
        point_on_first: contact.point1 + contact.normal1 * radius_a_m,
        point_on_second: contact.point2 - contact.normal1 * radius_b_m,
        direction: contact.normal1,
    })
}

/// Calls `f` with a part of a composite shape and its pose in the palm frame.
fn with_part<T>(
    composite: &dyn CompositeShape,
    part_idx: u32,
    palm_from_object: &Pose,
    f: impl Fn(&Pose, &dyn Shape) -> Option<T>,
) -> Option<T> {
    let mut found = None;
    composite.map_part_at(part_idx, &mut |object_from_part, part, _| {
        let palm_from_part = object_from_part.map_or(*palm_from_object, |pose| *palm_from_object * *pose);
        found = f(&palm_from_part, part);
    });
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};
    use parry3d_f64::shape::SharedShape;
    use rand::{RngExt, SeedableRng};

    fn block(as_mesh: bool) -> Object {
        let half = [0.03, 0.04, 0.06];
        let convex = Object::new("b".into(), "b".into(), SharedShape::cuboid(half[0], half[1], half[2]), 400.0, false);
        if !as_mesh {
            return convex;
        }
        let (points, triangles) = convex.shape.as_cuboid().expect("a cuboid").to_trimesh();
        Object { shape: SharedShape::trimesh(points, triangles).expect("a mesh"), ..convex }
    }

    fn link_shape(edge_radius_m: f64) -> LinkShape {
        let half = [0.02, 0.01, 0.008].map(|extent| extent - edge_radius_m);
        LinkShape {
            link_from_shape: Isometry3::translation(0.01, 0.0, 0.002),
            core: SharedShape::cuboid(half[0], half[1], half[2]),
            edge_radius_m,
        }
    }

    fn random_pose(rng: &mut impl rand::Rng, reach_m: f64) -> Isometry3<f64> {
        let mut number = || 2.0 * rng.random::<f64>() - 1.0;
        let translation = Translation3::new(reach_m * number(), reach_m * number(), reach_m * number());
        Isometry3::from_parts(
            translation,
            UnitQuaternion::from_euler_angles(3.0 * number(), 1.5 * number(), 3.0 * number()),
        )
    }

    #[test]
    fn a_mesh_is_as_far_away_as_the_solid_it_describes() {
        let (solid, mesh) = (block(false), block(true));
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let shape = link_shape(0.002);
        let shape = PlacedShape::new(0, &shape);
        let mut n_apart = 0;
        for _ in 0..500 {
            let palm_from_link = random_pose(&mut rng, 0.15);
            let palm_from_object = random_pose(&mut rng, 0.02);
            let shape_pose = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
            let object_pose = pose_from_isometry(&palm_from_object);
            let of = |object: &Object| {
                shape.closest_to_object(&shape_pose, &object_pose, object, 10.0).expect("within 10 m")
            };
            let (to_solid, to_mesh) = (of(&solid), of(&mesh));
            if to_solid.distance_m < 0.0 {
                continue;
            }
            n_apart += 1;
            let bound_m = shape.bound_m(&shape_pose, &object_pose, &mesh, 1.0);
            assert!(bound_m <= to_mesh.distance_m + 1e-12, "{bound_m} {to_mesh:?}");
            assert!(bound_m > 0.3 * to_mesh.distance_m - 0.02, "{bound_m} {to_mesh:?}");
            assert!(shape.closest_to_object(&shape_pose, &object_pose, &mesh, 0.9 * to_mesh.distance_m).is_none());
            assert!((to_solid.distance_m - to_mesh.distance_m).abs() < 1e-9, "{to_solid:?} {to_mesh:?}");
            assert!(to_solid.distance_m >= shape.sphere_distance_m(&palm_from_link, &palm_from_object, &solid) - 1e-12);
            let between = to_mesh.point_on_second - to_mesh.point_on_first;
            assert!((between - to_mesh.direction * to_mesh.distance_m).length() < 1e-9);
        }
        assert!(n_apart > 250, "{n_apart}");
    }

    /// Every triangle by itself gives the same distance as the search that leaves most of them out, where nothing overlaps.
    #[test]
    fn no_triangle_that_is_left_out_is_nearer() {
        let (points, triangles) = parry3d_f64::shape::Ball::new(0.03).to_trimesh(12, 24);
        let hollow =
            |point: &Vector| if point.y > 0.015 { Vector::new(point.x, 0.03 - point.y, point.z) } else { *point };
        let points: Vec<Vector> = points.iter().map(hollow).collect();
        let object = Object {
            shape: SharedShape::trimesh(points, triangles).expect("a mesh"),
            ..Object::new("b".into(), "b".into(), SharedShape::ball(0.03), 400.0, false)
        };
        let mesh = object.shape.as_trimesh().expect("a mesh");
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut n_apart = 0;
        for edge_radius_m in [0.0, 0.002] {
            let shape = link_shape(edge_radius_m);
            let shape = PlacedShape::new(0, &shape);
            for _ in 0..200 {
                let [shape_pose, object_pose] =
                    [random_pose(&mut rng, 0.05), random_pose(&mut rng, 0.02)].map(|pose| pose_from_isometry(&pose));
                let found = shape.closest_to_object(&shape_pose, &object_pose, &object, 1.0).expect("within 1 m");
                let of_triangle = |triangle: Triangle| {
                    let closest = shape.closest_to_convex(&shape_pose, &object_pose, &triangle, 1.0);
                    closest.expect("within 1 m").distance_m
                };
                let least_m = mesh.triangles().map(of_triangle).fold(f64::INFINITY, f64::min);
                assert_eq!(found.distance_m > 0.0, least_m > 0.0, "{found:?} {least_m}");
                assert!(least_m < 0.0 || (found.distance_m - least_m).abs() < 1e-9, "{found:?} {least_m}");
                n_apart += u32::from(least_m > 0.0);
            }
        }
        assert!(n_apart > 200, "{n_apart}");
    }

    #[test]
    fn the_faces_of_a_hull_tell_which_points_are_within_reach() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let mut number = || 2.0 * rng.random::<f64>() - 1.0;
        let corners: Vec<Vector> = (0..60).map(|_| 0.02 * Vector::new(number(), number(), number())).collect();
        let core = SharedShape::convex_hull(&corners).expect("a hull");
        let shape = LinkShape { link_from_shape: Isometry3::identity(), core, edge_radius_m: 0.0 };
        let shape = PlacedShape::new(0, &shape);
        let pose = pose_from_isometry(&random_pose(&mut rand_chacha::ChaCha8Rng::seed_from_u64(4), 0.1));
        let (mut n_within, mut n_off_the_faces) = (0, 0);
        for _ in 0..200 {
            let centre = pose.transform_point(0.02 * Vector::new(number(), number(), number()));
            let within = shape.within(pose, 0.0005, centre, 0.005);
            for _ in 0..50 {
                let aside = 0.005 * Vector::new(number(), number(), number()).normalize_or_zero();
                let point = centre + aside * number();
                let distance_m = shape.distance_to_point_m(&pose, point);
                assert_eq!(within.contains(point), distance_m <= 0.0005, "{distance_m}");
                n_within += usize::from(distance_m <= 0.0005);
                n_off_the_faces += usize::from(distance_m > 0.0 && distance_m <= 0.0005);
            }
        }
        assert!((1000..9000).contains(&n_within) && n_off_the_faces > 100, "{n_within} {n_off_the_faces}");
    }

    #[test]
    fn what_comes_down_stops_at_the_distance_asked_for() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let mut n_stopped = 0;
        for edge_radius_m in [0.0, 0.003] {
            let shape = link_shape(edge_radius_m);
            let shape = PlacedShape::new(0, &shape);
            for _ in 0..100 {
                let palm_from_link = random_pose(&mut rng, 0.05);
                let palm_from_object = random_pose(&mut rng, 0.05);
                let [to_solid, to_mesh] = [block(false), block(true)]
                    .map(|object| shape.stop_z(&palm_from_link, &palm_from_object, &object, 1e-4, f64::NEG_INFINITY));
                assert!(to_solid == to_mesh || (to_solid - to_mesh).abs() < 1e-5, "{to_solid} {to_mesh}");
                if !to_solid.is_finite() {
                    continue;
                }
                n_stopped += 1;
                let raised = Translation3::new(0.0, 0.0, to_mesh) * palm_from_object;
                let shape_pose = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
                let closest = shape
                    .closest_to_object(&shape_pose, &pose_from_isometry(&raised), &block(true), 1.0)
                    .expect("near");
                assert!((0.9e-4..1.1e-4).contains(&closest.distance_m), "{closest:?}");
            }
        }
        assert!(n_stopped > 100, "{n_stopped}");
    }

    #[test]
    fn curvature_of_faces_edges_corners_and_rims() {
        let rounded = link_shape(0.002);
        let rounded = PlacedShape::new(0, &rounded);
        let curvatures = |shape: &PlacedShape<'_>, normal: Vector3<f64>| {
            let normal = normal.normalize();
            let matrix = shape.curvature(normal);
            assert!((matrix * normal).norm() < 1e-9 && (matrix - matrix.transpose()).norm() < 1e-9);
            let mut values: Vec<f64> = matrix.symmetric_eigenvalues().iter().copied().collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let close = |found: Vec<f64>, expected: [f64; 3]| {
            assert!(
                found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6 * (1.0 + b)),
                "{found:?} {expected:?}"
            );
        };
        close(curvatures(&rounded, Vector3::z()), [0.0, 0.0, 0.0]);
        close(curvatures(&rounded, Vector3::new(0.0, 1.0, 1.0)), [0.0, 0.0, 500.0]);
        close(curvatures(&rounded, Vector3::new(1.0, 1.0, 1.0)), [0.0, 500.0, 500.0]);
        let cylinder = LinkShape {
            link_from_shape: Isometry3::identity(),
            core: SharedShape::cylinder(0.01, 0.008),
            edge_radius_m: 0.002,
        };
        let cylinder = PlacedShape::new(0, &cylinder);
        close(curvatures(&cylinder, Vector3::new(1.0, 0.0, 1.0)), [0.0, 0.0, 100.0]);
        close(curvatures(&cylinder, Vector3::y()), [0.0, 0.0, 0.0]);
        // On the rim at 45°: 1/r along the meridian, cos 45° / (R + r cos 45°) around.
        let cos = std::f64::consts::FRAC_1_SQRT_2;
        close(curvatures(&cylinder, Vector3::new(1.0, 1.0, 0.0)), [0.0, cos / (0.008 + 0.002 * cos), 500.0]);
    }
}
