//! Where a link and an object are nearest to each other.
//!
//! Links are convex cores with rounded edges. Objects are convex, or many convex parts (the triangles of a mesh, the
//! pieces of a compound) under parry's tree of bounding boxes; the tree is searched nearest part first.

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::partitioning::{BvhLeafCost, BvhNode};
use parry3d_f64::query;
use parry3d_f64::shape::{CompositeShape, Shape};

use super::objects::Object;
use crate::hand::{LinkShape, pose_from_isometry};

/// A link's collision shape, with bounds.
pub struct PlacedShape<'a> {
    pub(super) link_idx: usize,
    pub(super) link_from_shape: Isometry3<f64>,
    core: &'a dyn Shape,
    pub(super) edge_radius_m: f64,
    /// The core's box in its own frame.
    box_in_shape: Aabb,
    /// The bounding sphere in the link's frame, edges included.
    pub(super) centre_in_link: Point3<f64>,
    pub(super) radius_m: f64,
}

/// Where two bodies are nearest to each other, in the frame of the poses given.
#[derive(Debug, Clone, Copy)]
pub struct Gap {
    /// Negative: they overlap.
    pub(super) distance_m: f64,
    pub(super) point_on_first: Vector,
    pub(super) point_on_second: Vector,
    /// Unit, from the first to the second.
    pub(super) direction: Vector,
}

impl BvhLeafCost for Gap {
    fn cost(&self) -> f64 {
        self.distance_m
    }
}

/// Gaps at which nothing is done are measured up to here.
const FAR_M: f64 = 10.0;

impl<'a> PlacedShape<'a> {
    pub(super) fn new(link_idx: usize, shape: &'a LinkShape) -> Self {
        let sphere = shape.core.compute_local_bounding_sphere();
        PlacedShape {
            link_idx,
            link_from_shape: shape.link_from_shape,
            core: &*shape.core,
            edge_radius_m: shape.edge_radius_m,
            box_in_shape: shape.core.compute_local_aabb(),
            centre_in_link: shape.link_from_shape * Point3::new(sphere.center.x, sphere.center.y, sphere.center.z),
            radius_m: sphere.radius + shape.edge_radius_m,
        }
    }

    /// Distance of the bounding spheres: the shape and the object are at least so far from each other.
    pub(super) fn sphere_gap_m(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
    ) -> f64 {
        let between = palm_from_link * self.centre_in_link - palm_from_object * object.centre_of_mass_m;
        between.norm() - self.radius_m - object.max_radius_m
    }

    /// The nearest points of the shape and the object, both placed in the palm frame. `None` where parry finds none.
    pub(super) fn gap_to_object(
        &self,
        palm_from_shape: &Pose,
        palm_from_object: &Pose,
        object: &Object,
    ) -> Option<Gap> {
        let Some(composite) = object.shape.as_composite_shape() else {
            return self.gap_to_convex(palm_from_shape, palm_from_object, &*object.shape);
        };
        let shape_from_object = palm_from_shape.inv_mul(palm_from_object);
        let at_least_m = |node: &BvhNode, _: f64| {
            let half = (node.maxs() - node.mins()) * 0.5;
            let centre = shape_from_object.transform_point(node.center());
            box_distance_m(&self.box_in_shape, centre) - half.length() - self.edge_radius_m
        };
        let of_part = |part_idx: u32, _: f64| {
            with_part(composite, part_idx, palm_from_object, |palm_from_part, part| {
                self.gap_to_convex(palm_from_shape, palm_from_part, part)
            })
        };
        composite.bvh().find_best(FAR_M, at_least_m, of_part).map(|(_, gap)| gap)
    }

    /// How far the object, placed at `palm_from_object`, must be raised along the palm's +z to keep the distance from this
    /// shape when it comes down from above; -∞ where it passes by.
    pub(super) fn stop_z(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
        distance_m: f64,
    ) -> f64 {
        let palm_from_shape = pose_from_isometry(&(palm_from_link * self.link_from_shape));
        let at_zero = pose_from_isometry(palm_from_object);
        let centre = palm_from_link * self.centre_in_link;
        // Two spheres touch at this z at the latest.
        let at_most = |centre_at_zero: Vector, radius_m: f64| {
            let reach_m = self.radius_m + radius_m + distance_m;
            let aside_m = (centre_at_zero.x - centre.x).hypot(centre_at_zero.y - centre.y);
            let up_m = (reach_m * reach_m - aside_m * aside_m).sqrt();
            if aside_m < reach_m { centre.z + up_m - centre_at_zero.z } else { f64::NEG_INFINITY }
        };
        let com = palm_from_object * object.centre_of_mass_m;
        let first_z = at_most(Vector::new(com.x, com.y, com.z), object.max_radius_m);
        if first_z == f64::NEG_INFINITY {
            return f64::NEG_INFINITY;
        }
        let Some(composite) = object.shape.as_composite_shape() else {
            return self.convex_stop_z(&palm_from_shape, &at_zero, &*object.shape, first_z, distance_m);
        };
        // The tree is searched for the least cost: the cost is -z.
        let node_cost = |node: &BvhNode, _: f64| {
            let half = (node.maxs() - node.mins()) * 0.5;
            -at_most(at_zero.transform_point(node.center()), half.length())
        };
        let leaf_cost = |part_idx: u32, _: f64| {
            let bounds = composite.bvh().leaf_node(part_idx)?;
            let first_z = -node_cost(bounds, 0.0);
            let z = with_part(composite, part_idx, &at_zero, |palm_from_part, part| {
                Some(self.convex_stop_z(&palm_from_shape, palm_from_part, part, first_z.min(FAR_M), distance_m))
            });
            z.map(|z| -z)
        };
        composite.bvh().find_best(FAR_M, node_cost, leaf_cost).map_or(f64::NEG_INFINITY, |(_, cost)| -cost)
    }

    /// [`PlacedShape::stop_z`] for one convex part, coming down from `first_z`. The plane between two convex bodies bounds
    /// how far the part can come down, and a plane that it moves away from says that it never arrives. Newton-like, so
    /// a few steps do.
    fn convex_stop_z(
        &self,
        palm_from_shape: &Pose,
        at_zero: &Pose,
        part: &dyn Shape,
        first_z: f64,
        distance_m: f64,
    ) -> f64 {
        let mut z = first_z;
        for _ in 0..100 {
            let mut palm_from_part = *at_zero;
            palm_from_part.translation.z += z;
            let Some(gap) = self.gap_to_convex(palm_from_shape, &palm_from_part, part) else {
                return f64::NEG_INFINITY;
            };
            if gap.distance_m <= 1.02 * distance_m {
                return z;
            }
            if gap.direction.z <= 1e-9 {
                return f64::NEG_INFINITY;
            }
            z -= (gap.distance_m - distance_m) / gap.direction.z;
        }
        f64::NEG_INFINITY
    }

    fn gap_to_convex(&self, palm_from_shape: &Pose, palm_from_part: &Pose, part: &dyn Shape) -> Option<Gap> {
        rounded_gap(palm_from_shape, self.core, self.edge_radius_m, palm_from_part, part, 0.0)
    }

    /// The nearest points of two links' shapes.
    pub(super) fn gap_to_shape(
        &self,
        palm_from_shape: &Pose,
        other: &PlacedShape<'_>,
        palm_from_other: &Pose,
    ) -> Option<Gap> {
        rounded_gap(palm_from_shape, self.core, self.edge_radius_m, palm_from_other, other.core, other.edge_radius_m)
    }

    /// Distance of a point of the palm frame to the shape; 0 inside.
    pub(super) fn distance_to_point_m(&self, palm_from_shape: &Pose, point: Vector) -> f64 {
        (self.core.distance_to_point(palm_from_shape, point, true) - self.edge_radius_m).max(0.0)
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

fn rounded_gap(
    pose_a: &Pose,
    a: &dyn Shape,
    radius_a_m: f64,
    pose_b: &Pose,
    b: &dyn Shape,
    radius_b_m: f64,
) -> Option<Gap> {
    let contact = query::contact(pose_a, a, pose_b, b, FAR_M).ok().flatten()?;
    Some(Gap {
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

fn box_distance_m(bounds: &Aabb, point: Vector) -> f64 {
    let outside = (bounds.mins - point).max(point - bounds.maxs).max(Vector::ZERO);
    outside.length()
}
