//! Blind exploration: the palm comes to the object from anywhere, then the fingers close with break-away.
//!
//! Nothing is pushed away: the object stays where it is. The hand is taken from its description, not assumed to be a
//! Barrett hand: preshape joints are drawn, the other joints close towards their upper limits, all leaders at the same
//! speed and followers at their ratio. One rule makes break-away: **a link that is stopped stops every joint that moves
//! it**. A stopped proximal link stops its joint, and the follower goes on alone; a stopped distal link stops the
//! whole finger. A joint's limit stops that joint only.
//!
//! A link is stopped by the object, or by another link of the hand that it comes nearer to than a clearance, if its own
//! motion goes that way: a finger that touches from the start with the side it closes to stays open, one that touches
//! with its back closes. The reference link must not be moved by a closing joint.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use parry3d_f64::math::{Pose, Vector};
use parry3d_f64::query;
use parry3d_f64::shape::Shape;
use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::objects::Object;
use crate::hand::{Hand, JointError, Motion, pose_from_isometry};

/// What the protocol leaves open, each with its default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProtocolOptions {
    /// A link this near to the object touches it. 0.2 mm: small against the pad's 3 mm, large against the 0.1 mm at
    /// which links are stopped.
    pub touch_tolerance_m: f64,
    /// Links of the hand stop this far from each other. 0.7 mm: above the Barrett layout's self-collision margin of
    /// 0.5 mm by more than rounded joint angles move a fingertip (0.1 mm), so that no collision is reported.
    pub clearance_m: f64,
    /// Preshape joints are drawn uniformly from this part of their range. `[0, 0.5]`: the Barrett's spread from 0 to π/2,
    /// fingers 1 and 2 opposite to finger 3 or at right angles to it.
    pub preshape_range: [f64; 2],
    /// The object's centre of mass is off the palm's axis by up to this, uniformly over the disc. 15 mm: the approach
    /// is blind, aimed roughly.
    pub lateral_offset_m: f64,
    /// How far the palm draws back after the first touch, before the fingers close. 0, as the paper's "until something
    /// touches" says nothing of it.
    pub back_off_m: f64,
}

impl Default for ProtocolOptions {
    fn default() -> Self {
        ProtocolOptions {
            touch_tolerance_m: 0.0002,
            clearance_m: 0.0007,
            preshape_range: [0.0, 0.5],
            lateral_offset_m: 0.015,
            back_off_m: 0.0,
        }
    }
}

/// All that is random about a grasp of a given object.
#[derive(Debug, Clone)]
pub struct Start {
    /// The joints before closing: preshape joints drawn, the others open.
    pub open_joints_rad: Vec<f64>,
    /// How the object is turned in the palm frame: direction and roll of the approach in one.
    pub palm_from_object_rotation: UnitQuaternion<f64>,
    /// Where the object's centre of mass is off the palm's axis, x and y of the palm frame.
    pub lateral_offset_m: [f64; 2],
}

/// A closed hand around (or beside) an object.
#[derive(Debug, Clone)]
pub struct Exploration {
    /// Where the object is.
    pub palm_from_object: Isometry3<f64>,
    /// The joints before closing.
    pub open_joints_rad: Vec<f64>,
    /// The joints that closed, with how and how far.
    pub joints: Vec<ClosingJoint>,
    /// The progress (radians of a leader) at which the last joint stopped.
    pub end: f64,
}

/// A joint that closes.
#[derive(Debug, Clone)]
pub struct ClosingJoint {
    /// Index into [`Hand::joints`].
    pub joint_idx: usize,
    /// Radians per radian of a leader: 1, or the coupling's ratio.
    pub rate: f64,
    /// The progress at which it stops.
    pub end: f64,
}

impl Exploration {
    /// The joints at a progress between 0 (open) and [`Exploration::end`] (settled).
    pub fn joints_rad(&self, progress: f64) -> Vec<f64> {
        joints_rad(&self.open_joints_rad, &self.joints, progress)
    }
}

/// Draws what is random about a grasp.
pub fn draw_start(hand: &Hand, options: &ProtocolOptions, rng: &mut impl rand::Rng) -> Start {
    let open_joints_rad = hand
        .joints
        .iter()
        .map(|joint| {
            if joint.is_preshape {
                let [least, most] = options.preshape_range;
                let part = least + (most - least) * rng.random::<f64>();
                joint.lower_rad + part * (joint.upper_rad - joint.lower_rad)
            } else {
                0.0_f64.clamp(joint.lower_rad, joint.upper_rad)
            }
        })
        .collect();
    let radius_m = options.lateral_offset_m * rng.random::<f64>().sqrt();
    let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
    Start {
        open_joints_rad,
        palm_from_object_rotation: random_rotation(rng),
        lateral_offset_m: [radius_m * cos, radius_m * sin],
    }
}

/// A hand prepared for exploring: which joints close, what moves what and how fast.
pub struct Mechanism<'a> {
    pub(super) hand: &'a Hand,
    pub(super) shapes: Vec<PlacedShape<'a>>,
    joints: Vec<ClosingJoint>,
    /// Per link: the closing joints that move it.
    movers: Vec<Vec<Mover>>,
    /// Per link: a bound on the speed of its points while everything closes, metres per unit of progress.
    top_speed: Vec<f64>,
    /// Links that may come to touch each other while closing.
    pairs: Vec<(usize, usize)>,
}

/// A link's collision shape.
pub(super) struct PlacedShape<'a> {
    pub(super) link_idx: usize,
    pub(super) link_from_shape: Isometry3<f64>,
    pub(super) shape: &'a dyn Shape,
    /// The bounding sphere in the link's frame.
    centre_in_link: nalgebra::Point3<f64>,
    radius_m: f64,
}

impl PlacedShape<'_> {
    /// Whether the bounding spheres let the shape and the object be so near to each other.
    pub(super) fn may_be_within(
        &self,
        palm_from_link: &Isometry3<f64>,
        palm_from_object: &Isometry3<f64>,
        object: &Object,
        distance_m: f64,
    ) -> bool {
        self.sphere_gap_m(palm_from_link, palm_from_object, object) <= distance_m
    }

    fn sphere_gap_m(&self, palm_from_link: &Isometry3<f64>, palm_from_object: &Isometry3<f64>, object: &Object) -> f64 {
        let between = palm_from_link * self.centre_in_link - palm_from_object * object.centre_of_mass_m;
        between.norm() - self.radius_m - object.max_radius_m
    }
}

struct Mover {
    /// Index into `Mechanism::joints`.
    closing_idx: usize,
    /// The link that the joint turns; the mover's link hangs on it.
    turned_link_idx: usize,
    multiplier: f64,
    axis: Vector3<f64>,
}

/// Where two convex bodies are nearest to each other.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gap {
    /// Negative: they overlap.
    pub(super) distance_m: f64,
    pub(super) point_on_first: Vector,
    pub(super) point_on_second: Vector,
    /// Unit, from the first to the second.
    pub(super) direction: Vector,
}

/// No gap is looked at more often than each 0.1 mrad of progress (20 µm of a Barrett fingertip).
const LEAST_STEP: f64 = 1e-4;
/// A link that touches but moves away is looked at again after this progress.
const LEAVING_STEP: f64 = 5e-4;
/// Gaps at which nothing is done are measured up to here.
const FAR_M: f64 = 10.0;

impl<'a> Mechanism<'a> {
    /// Prepares a hand.
    ///
    /// # Errors
    /// None for a [`Hand`] that was loaded: it has as many joints as it says.
    pub fn new(hand: &'a Hand, options: &ProtocolOptions) -> Result<Self, JointError> {
        let joints: Vec<ClosingJoint> = hand
            .joints
            .iter()
            .enumerate()
            .filter(|(_, joint)| !joint.is_preshape)
            .map(|(joint_idx, joint)| {
                let rate = joint.coupling.map_or(1.0, |coupling| coupling.ratio);
                let limit_rad = if rate > 0.0 { joint.upper_rad } else { joint.lower_rad };
                let open_rad = 0.0_f64.clamp(joint.lower_rad, joint.upper_rad);
                let end = if rate == 0.0 { 0.0 } else { ((limit_rad - open_rad) / rate).max(0.0) };
                ClosingJoint { joint_idx, rate, end }
            })
            .collect();
        let shapes: Vec<PlacedShape<'a>> = hand
            .links
            .iter()
            .enumerate()
            .flat_map(|(link_idx, link)| {
                link.shapes.iter().map(move |placed| {
                    let sphere = placed.shape.compute_local_bounding_sphere();
                    let centre = nalgebra::Point3::new(sphere.center.x, sphere.center.y, sphere.center.z);
                    PlacedShape {
                        link_idx,
                        link_from_shape: placed.link_from_shape,
                        shape: &*placed.shape,
                        centre_in_link: placed.link_from_shape * centre,
                        radius_m: sphere.radius,
                    }
                })
            })
            .collect();
        let movers: Vec<Vec<Mover>> = (0..hand.links.len()).map(|link_idx| movers(hand, &joints, link_idx)).collect();
        let top_speed = (0..hand.links.len())
            .map(|link_idx| {
                let radius_m = shapes
                    .iter()
                    .filter(|shape| shape.link_idx == link_idx)
                    .map(|shape| shape.centre_in_link.coords.norm() + shape.radius_m)
                    .fold(0.0, f64::max);
                let speed_of = |mover: &Mover| {
                    let mut reach_m = radius_m;
                    let mut idx = link_idx;
                    while idx != mover.turned_link_idx {
                        reach_m += hand.links[idx].parent_from_joint.translation.vector.norm();
                        idx = hand.links[idx].parent_idx.unwrap_or(mover.turned_link_idx);
                    }
                    (joints[mover.closing_idx].rate * mover.multiplier).abs() * reach_m
                };
                movers[link_idx].iter().map(speed_of).sum()
            })
            .collect();
        let mut mechanism = Mechanism { hand, shapes, joints, movers, top_speed, pairs: Vec::new() };
        mechanism.pairs = mechanism.pairs(options.clearance_m)?;
        Ok(mechanism)
    }

    /// The palm comes, the fingers close. `None`: the hand passes by the object, or the open hand touches itself.
    ///
    /// # Errors
    /// A start of another hand.
    pub fn explore(
        &self,
        object: &Object,
        start: &Start,
        options: &ProtocolOptions,
    ) -> Result<Option<Exploration>, JointError> {
        if self.hand.self_collides(&start.open_joints_rad)? {
            return Ok(None);
        }
        let Some(mut palm_from_object) = self.approach(object, start, options)? else {
            return Ok(None);
        };
        palm_from_object.translation.vector.z += options.back_off_m;
        let joints = self.close(object, &palm_from_object, &start.open_joints_rad, options)?;
        let end = joints.iter().map(|joint| joint.end).fold(0.0, f64::max);
        Ok(Some(Exploration { palm_from_object, open_joints_rad: start.open_joints_rad.clone(), joints, end }))
    }

    /// The progress at which a link came to its final place.
    pub(super) fn settled_at(&self, link_idx: usize, joints: &[ClosingJoint]) -> f64 {
        self.movers[link_idx].iter().map(|mover| joints[mover.closing_idx].end).fold(0.0, f64::max)
    }

    /// Lets the object come down along the palm's -z until the first link touches it: `palm_from_object` then.
    fn approach(
        &self,
        object: &Object,
        start: &Start,
        options: &ProtocolOptions,
    ) -> Result<Option<Isometry3<f64>>, JointError> {
        let palm_from_links = self.hand.palm_from_links(&start.open_joints_rad)?;
        let target_m = stop_m(options);
        let [x, y] = start.lateral_offset_m;
        let rotation = start.palm_from_object_rotation;
        let at = |z: f64| {
            let centre = Vector3::new(x, y, z) - rotation * object.centre_of_mass_m.coords;
            Isometry3::from_parts(centre.into(), rotation)
        };
        let mut stop_z = f64::NEG_INFINITY;
        for shape in &self.shapes {
            let centre = palm_from_links[shape.link_idx] * shape.centre_in_link;
            let reach_m = shape.radius_m + object.max_radius_m + target_m;
            let aside_m = (centre.x - x).hypot(centre.y - y);
            if aside_m >= reach_m {
                continue;
            }
            let shape_pose = pose_from_isometry(&(palm_from_links[shape.link_idx] * shape.link_from_shape));
            let mut z = centre.z + reach_m + 0.001;
            // Both bodies are convex: the plane between them bounds how far the object can come down, and a plane that
            // it moves away from says that it never arrives. Newton-like, so a few steps do.
            for _ in 0..100 {
                if z <= stop_z {
                    break;
                }
                let Some(gap) = gap(&shape_pose, shape.shape, &pose_from_isometry(&at(z)), &*object.shape) else {
                    break;
                };
                if gap.distance_m <= 1.02 * target_m {
                    stop_z = z;
                    break;
                }
                if gap.direction.z <= 1e-9 {
                    break;
                }
                z -= (gap.distance_m - target_m) / gap.direction.z;
                if z < centre.z - reach_m {
                    break;
                }
            }
        }
        Ok(stop_z.is_finite().then(|| at(stop_z)))
    }

    /// Closes by conservative advancement: each gap and the speed bound give a progress before which the gap can't be
    /// gone, and only then it is measured again. Stopping joints makes links slower, so older bounds stay true.
    fn close(
        &self,
        object: &Object,
        palm_from_object: &Isometry3<f64>,
        open_joints_rad: &[f64],
        options: &ProtocolOptions,
    ) -> Result<Vec<ClosingJoint>, JointError> {
        let mut joints = self.joints.clone();
        let object_pose = pose_from_isometry(palm_from_object);
        let stop_m = stop_m(options);
        let mut shape_due = vec![0.0; self.shapes.len()];
        let mut pair_due = vec![0.0; self.pairs.len()];
        let mut progress = 0.0;
        loop {
            let palm_from_links = self.hand.palm_from_links(&joints_rad(open_joints_rad, &joints, progress))?;
            for (shape, due) in self.shapes.iter().zip(&mut shape_due) {
                if *due > progress {
                    continue;
                }
                let speed = self.top_speed[shape.link_idx];
                if !self.is_moving(shape.link_idx, &joints, progress) {
                    *due = f64::INFINITY;
                    continue;
                }
                let palm_from_link = &palm_from_links[shape.link_idx];
                let apart_m = shape.sphere_gap_m(palm_from_link, palm_from_object, object);
                if apart_m > 0.01 {
                    *due = progress + (apart_m - stop_m) / speed;
                    continue;
                }
                let shape_pose = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
                let Some(gap) = gap(&shape_pose, shape.shape, &object_pose, &*object.shape) else {
                    *due = progress + LEAST_STEP;
                    continue;
                };
                if gap.distance_m > stop_m {
                    *due = progress + (gap.distance_m - 0.8 * stop_m) / speed;
                } else if self
                    .velocity(shape.link_idx, gap.point_on_first, &palm_from_links, &joints, progress)
                    .dot(gap.direction)
                    > 0.0
                {
                    self.stop(&mut joints, progress, shape.link_idx, None);
                    *due = f64::INFINITY;
                } else {
                    *due = progress + LEAVING_STEP;
                }
            }
            for (&(a, b), due) in self.pairs.iter().zip(&mut pair_due) {
                if *due > progress {
                    continue;
                }
                if !self.is_moving(a, &joints, progress) && !self.is_moving(b, &joints, progress) {
                    *due = f64::INFINITY;
                    continue;
                }
                let speed = self.top_speed[a] + self.top_speed[b];
                let Some(gap) = self.link_gap(a, b, &palm_from_links) else {
                    *due = progress + LEAST_STEP;
                    continue;
                };
                let nearing = |gap: &Gap| {
                    let of = |idx, point| self.velocity(idx, point, &palm_from_links, &joints, progress);
                    (of(a, gap.point_on_first) - of(b, gap.point_on_second)).dot(gap.direction) > 0.0
                };
                if gap.distance_m > options.clearance_m {
                    *due = progress + (gap.distance_m - 0.98 * options.clearance_m) / speed;
                } else if nearing(&gap) {
                    self.stop(&mut joints, progress, a, Some(b));
                    self.stop(&mut joints, progress, b, Some(a));
                    *due = progress + LEAVING_STEP;
                } else {
                    *due = progress + LEAVING_STEP;
                }
            }
            let end = joints.iter().map(|joint| joint.end).fold(0.0, f64::max);
            if progress >= end {
                return Ok(joints);
            }
            let next = shape_due.iter().chain(&pair_due).copied().fold(end, f64::min);
            progress = next.max(progress + LEAST_STEP).min(end);
        }
    }

    /// Stops every joint that moves `link_idx`, but not those that move `except` just as well.
    fn stop(&self, joints: &mut [ClosingJoint], progress: f64, link_idx: usize, except: Option<usize>) {
        for mover in &self.movers[link_idx] {
            let is_shared = |other: usize| {
                self.movers[other].iter().any(|theirs| {
                    theirs.closing_idx == mover.closing_idx && theirs.turned_link_idx == mover.turned_link_idx
                })
            };
            if !except.is_some_and(is_shared) {
                let joint = &mut joints[mover.closing_idx];
                joint.end = joint.end.min(progress);
            }
        }
    }

    fn is_moving(&self, link_idx: usize, joints: &[ClosingJoint], progress: f64) -> bool {
        self.movers[link_idx].iter().any(|mover| joints[mover.closing_idx].end > progress)
    }

    /// Velocity of a link's point in the palm frame, metres per unit of progress.
    fn velocity(
        &self,
        link_idx: usize,
        point: Vector,
        palm_from_links: &[Isometry3<f64>],
        joints: &[ClosingJoint],
        progress: f64,
    ) -> Vector {
        let point = Vector3::new(point.x, point.y, point.z);
        let velocity: Vector3<f64> = self.movers[link_idx]
            .iter()
            .filter(|mover| joints[mover.closing_idx].end > progress)
            .map(|mover| {
                let palm_from_turned = &palm_from_links[mover.turned_link_idx];
                let turn = palm_from_turned.rotation * mover.axis * (joints[mover.closing_idx].rate * mover.multiplier);
                turn.cross(&(point - palm_from_turned.translation.vector))
            })
            .sum();
        Vector::new(velocity.x, velocity.y, velocity.z)
    }

    /// The nearest points of two links. Shapes far apart count with the gap of their bounding spheres.
    fn link_gap(&self, a: usize, b: usize, palm_from_links: &[Isometry3<f64>]) -> Option<Gap> {
        let mut nearest: Option<Gap> = None;
        for shape_a in self.shapes.iter().filter(|shape| shape.link_idx == a) {
            let centre_a = palm_from_links[a] * shape_a.centre_in_link;
            for shape_b in self.shapes.iter().filter(|shape| shape.link_idx == b) {
                let between = palm_from_links[b] * shape_b.centre_in_link - centre_a;
                let apart_m = between.norm() - shape_a.radius_m - shape_b.radius_m;
                if nearest.is_some_and(|gap| gap.distance_m <= apart_m) {
                    continue;
                }
                let found = if apart_m > 0.005 {
                    let direction = Vector::new(between.x, between.y, between.z) / between.norm();
                    let point = Vector::new(centre_a.x, centre_a.y, centre_a.z);
                    Some(Gap { distance_m: apart_m, point_on_first: point, point_on_second: point, direction })
                } else {
                    let pose = |shape: &PlacedShape<'_>| {
                        pose_from_isometry(&(palm_from_links[shape.link_idx] * shape.link_from_shape))
                    };
                    gap(&pose(shape_a), shape_a.shape, &pose(shape_b), shape_b.shape)
                };
                if let Some(found) = found
                    && nearest.is_none_or(|gap| found.distance_m < gap.distance_m)
                {
                    nearest = Some(found);
                }
            }
        }
        nearest
    }

    /// Links that move against each other, are not joined by one joint and are apart in the open hand.
    fn pairs(&self, clearance_m: f64) -> Result<Vec<(usize, usize)>, JointError> {
        let links = &self.hand.links;
        let open = self.hand.posture([])?;
        let palm_from_links = self.hand.palm_from_links(&open)?;
        let key = |mover: &Mover| (mover.closing_idx, mover.turned_link_idx);
        let mut pairs = Vec::new();
        for a in 0..links.len() {
            for b in a + 1..links.len() {
                let moves_against = self.movers[a].iter().map(key).ne(self.movers[b].iter().map(key));
                let joined = links[a].parent_idx == Some(b) || links[b].parent_idx == Some(a);
                let gap = self.link_gap(a, b, &palm_from_links);
                if moves_against && !joined && gap.is_some_and(|gap| gap.distance_m > clearance_m) {
                    pairs.push((a, b));
                }
            }
        }
        Ok(pairs)
    }
}

/// The nearest points of two convex shapes. `None` where parry finds none.
pub(super) fn gap(pose_a: &Pose, a: &dyn Shape, pose_b: &Pose, b: &dyn Shape) -> Option<Gap> {
    let contact = query::contact(pose_a, a, pose_b, b, FAR_M).ok().flatten()?;
    Some(Gap {
        distance_m: contact.dist,
        point_on_first: contact.point1,
        point_on_second: contact.point2,
        direction: contact.normal1,
    })
}

/// Links are stopped in the middle of the touch tolerance, so that distances stay positive and well defined.
fn stop_m(options: &ProtocolOptions) -> f64 {
    options.touch_tolerance_m / 2.0
}

fn joints_rad(open_joints_rad: &[f64], joints: &[ClosingJoint], progress: f64) -> Vec<f64> {
    let mut joints_rad = open_joints_rad.to_vec();
    for joint in joints {
        joints_rad[joint.joint_idx] += joint.rate * progress.min(joint.end);
    }
    joints_rad
}

fn movers(hand: &Hand, joints: &[ClosingJoint], link_idx: usize) -> Vec<Mover> {
    let mut movers = Vec::new();
    let mut next = Some(link_idx);
    while let Some(idx) = next {
        if let Motion::Revolute { joint_idx, multiplier, axis, .. } = hand.links[idx].motion
            && let Some(closing_idx) = joints.iter().position(|joint| joint.joint_idx == joint_idx)
        {
            movers.push(Mover { closing_idx, turned_link_idx: idx, multiplier, axis: axis.into_inner() });
        }
        next = hand.links[idx].parent_idx;
    }
    movers
}

/// Uniform over all rotations (Shoemake 1992).
fn random_rotation(rng: &mut impl rand::Rng) -> UnitQuaternion<f64> {
    let [u, v, w]: [f64; 3] = std::array::from_fn(|_| rng.random());
    let (sin_v, cos_v) = (std::f64::consts::TAU * v).sin_cos();
    let (sin_w, cos_w) = (std::f64::consts::TAU * w).sin_cos();
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(a * sin_v, a * cos_v, b * sin_w, b * cos_w))
}
