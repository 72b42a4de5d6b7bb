//! Planned grasps: the best of several approaches by an energy, as a planner that knows the object would choose.
//!
//! The paper trained on the Columbia Grasp Database, whose grasps an eigengrasp planner had found (Ciocarlie & Allen):
//! simulated annealing over the posture, towards low distance of pads to the object and aligned normals. This is a
//! plainer planner with the same aim: it draws approaches along surface normals and principal axes with a stand-off,
//! closes the hand on each, and keeps the one of least energy. It sees the object's shape only, not the grasp's quality.

use nalgebra::{Isometry3, Point3, Unit, UnitQuaternion, UnitVector3, Vector3};
use parry3d_f64::math::{Rotation, Vector};
use parry3d_f64::query::Ray;
use rand::RngExt;

use super::mechanism::Mechanism;
use super::option_check::{OptionError, not_negative, positive, require, share, with_defaults};
use super::protocol::{Exploration, ProtocolOptions, Start, draw_start};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{Hand, JointError, pose_from_isometry};

with_defaults! {
    /// How grasps are planned, where the protocol's approach is `planned`.
    pub struct PlannerOptions {
        /// The best of so many is kept. 16: about where the mean epsilon stops growing quickly.
        pub n_approaches: usize = 16,
        /// The part of the approaches along a surface normal; the others go along a principal axis. 0.5.
        pub normal_fraction: f64 = 0.5,
        /// In every other approach the palm draws back from the touch by up to this, uniformly, before the fingers close: how
        /// else would they close round something small. 50 mm.
        pub stand_off_m: f64 = 0.05,
        /// A pad this far from the object, or farther, counts as much as one whose normal is at a right angle to it. 10 mm.
        pub distance_scale_m: f64 = 0.01,
    }
}

impl PlannerOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        require("planner.n_approaches", self.n_approaches, (1..=10_000).contains(&self.n_approaches), "1 to 10000")?;
        share("planner.normal_fraction", self.normal_fraction)?;
        not_negative("planner.stand_off_m", self.stand_off_m)?;
        positive("planner.distance_scale_m", self.distance_scale_m)
    }
}

/// The start of the planned grasp of least energy; `None` if no approach touches the object.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn plan_start(
    mechanism: &Mechanism<'_>,
    object: &Object,
    protocol: &ProtocolOptions,
    options: &PlannerOptions,
    rng: &mut impl rand::Rng,
) -> Result<Option<Start>, JointError> {
    let approaches = Approaches::new(mechanism.hand, object, protocol, options);
    let mut best: Option<(f64, Start)> = None;
    for _ in 0..options.n_approaches {
        let start = approaches.draw(rng);
        let Some(exploration) = mechanism.explore(object, &start, protocol)? else { continue };
        let energy = energy(mechanism.hand, object, &exploration, options)?;
        if best.as_ref().is_none_or(|(least, _)| energy < *least) {
            best = Some((energy, start));
        }
    }
    Ok(best.map(|(_, start)| start))
}

/// The approaches to an object from which a planner draws.
pub(crate) struct Approaches<'a> {
    hand: &'a Hand,
    object: &'a Object,
    protocol: &'a ProtocolOptions,
    options: &'a PlannerOptions,
    /// In the object's frame.
    principal_axes: Rotation,
}

impl<'a> Approaches<'a> {
    pub(crate) fn new(
        hand: &'a Hand,
        object: &'a Object,
        protocol: &'a ProtocolOptions,
        options: &'a PlannerOptions,
    ) -> Self {
        let principal_axes = object.shape.mass_properties(1.0).principal_inertia_local_frame;
        Approaches { hand, object, protocol, options, principal_axes }
    }

    /// A start whose palm faces a point of the surface along its normal, or the centre along a principal axis; roll and
    /// preshape are drawn as in a blind one.
    pub(crate) fn draw(&self, rng: &mut impl rand::Rng) -> Start {
        let object = self.object;
        let blind = draw_start(self.hand, self.protocol, rng);
        let along_normal = rng.random::<f64>() < self.options.normal_fraction;
        // A random direction from the centre of mass; where a ray comes in from there, it meets the surface.
        let from_centre = blind.palm_from_object_rotation.inverse() * Vector3::z_axis();
        let (target, outward) = if along_normal {
            surface_point(object, &from_centre)
        } else {
            let axis = [Vector::X, Vector::Y, Vector::Z][rng.random_range(0..3)];
            let axis = self.principal_axes * axis * if rng.random::<f64>() < 0.5 { 1.0 } else { -1.0 };
            (object.centre_of_mass_m, Unit::new_normalize(Vector3::new(axis.x, axis.y, axis.z)))
        };
        // The palm looks along its +z against the outward direction: outward becomes -z.
        let turn = UnitQuaternion::rotation_between(&outward, &-Vector3::z_axis())
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::TAU * rng.random::<f64>());
        let palm_from_object_rotation = roll * turn;
        // The target lies on the palm's axis.
        let aside = palm_from_object_rotation * (object.centre_of_mass_m - target);
        let stands_off = rng.random::<f64>() < 0.5;
        let back_off_m = if stands_off { self.options.stand_off_m * rng.random::<f64>() } else { 0.0 };
        Start { palm_from_object_rotation, lateral_offset_m: [aside.x, aside.y], back_off_m, ..blind }
    }
}

/// The outermost point of the surface in a direction from the centre of mass, and its outward normal.
fn surface_point(object: &Object, from_centre: &UnitVector3<f64>) -> (Point3<f64>, UnitVector3<f64>) {
    let reach_m = 2.0 * object.max_radius_m;
    let origin = object.centre_of_mass_m + from_centre.into_inner() * reach_m;
    let ray = Ray::new(
        Vector::new(origin.x, origin.y, origin.z),
        Vector::new(-from_centre.x, -from_centre.y, -from_centre.z),
    );
    match object.shape.cast_local_ray_and_get_normal(&ray, reach_m, true) {
        Some(hit) => {
            let point = origin - from_centre.into_inner() * hit.time_of_impact;
            let normal = Vector3::new(hit.normal.x, hit.normal.y, hit.normal.z);
            (point, Unit::try_new(normal, 1e-9).unwrap_or(*from_centre))
        }
        // The ray slips through a hole: the centre itself is the target.
        None => (object.centre_of_mass_m, *from_centre),
    }
}

/// Mean over the pads of the distance to the object, in units of the scale and at most 1. To it comes the mean of 1 -
/// cos of the angle between the pad's normal and the direction to the object. It is GraspIt!'s contact energy, at the
/// closed hand, but that a pad which is not near counts the same however far it is.
pub(crate) fn energy(
    hand: &Hand,
    object: &Object,
    exploration: &Exploration,
    options: &PlannerOptions,
) -> Result<f64, JointError> {
    let palm_from_links = hand.palm_from_links(&exploration.posture(exploration.end))?;
    let object_pose = pose_from_isometry(&exploration.palm_from_object);
    let mut sum = 0.0;
    for pad in &hand.pads {
        let palm_from_link: &Isometry3<f64> = &palm_from_links[pad.link_idx];
        let middle = pad.middle_in_link_m();
        let far = |cell: &blindgrasp_stages::hand::Cell| (cell.position_in_link_m - middle).norm();
        let Some(cell) = pad.cells.iter().min_by(|a, b| far(a).total_cmp(&far(b))) else { continue };
        let point = palm_from_link * cell.position_in_link_m;
        let normal = palm_from_link.rotation * cell.normal_in_link;
        let nearest = object.shape.project_point(&object_pose, Vector::new(point.x, point.y, point.z), false).point;
        let to_object = Vector3::new(nearest.x, nearest.y, nearest.z) - point.coords;
        let distance_m = to_object.norm();
        let misalignment = 1.0 - if distance_m > 1e-6 { normal.dot(&to_object) / distance_m } else { 1.0 };
        sum += (distance_m / options.distance_scale_m).min(1.0) + misalignment;
    }
    Ok(sum / hand.pads.len() as f64)
}
