//! Blind exploration: the palm comes to the object from anywhere, then the fingers close with break-away.
//!
//! Nothing is pushed away: the object stays where it is, unless one motor moves several fingers (a gripper's jaws, by a
//! URDF's mimic joints). Such fingers push the object, without turning it, until one that comes from the other side touches it,
//! so that a gripper centres the object.
//!
//! The hand is taken from its description, not assumed to be a Barrett hand: preshape joints without an open value are drawn.
//! The other joints close from their open values towards their closed limits, all leaders at the same speed and followers at
//! their ratio. One rule makes break-away: **a link that is stopped stops every joint that moves it**. A stopped proximal link
//! stops its joint, and the follower goes on alone; a stopped distal link stops the whole finger. A joint's limit stops that
//! joint only.
//!
//! A link is stopped by the object, or by another link of the hand that it comes nearer to than a clearance, if its own
//! motion goes that way. A finger that touches from the start with the side it closes to stays open, one that touches
//! with its back closes. The reference link must not be moved by a closing joint.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use parry3d_f64::math::{Pose, Vector};
use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::distance::{ClosestPoints, PlacedShape};
use super::mechanism::{ClosestLinks, ClosingJoint, Mechanism};
use super::option_check::{OptionError, not_negative, positive, require, share, with_defaults};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{Hand, JointError, pose_from_isometry};

/// The approach of the palm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Approach {
    /// The approach of a robot that cannot see: random direction, roll, preshape and offset.
    #[default]
    Blind,
    /// From where a planner that knows the object would come ([`crate::planner`]).
    Planned,
}

with_defaults! {
    /// The options of the exploration.
    pub struct ProtocolOptions {
        /// The approach of the palm.
        pub approach: Approach = Approach::Blind,
        /// A link this near to the object touches it. 0.2 mm: small against the pad's 3 mm, large against the 0.1 mm at
        /// which links are stopped.
        pub touch_tolerance_m: f64 = 0.0002,
        /// Links of the hand stop this far from each other. 0.1 mm: fingers close until they press on each other, as a real
        /// hand's do, and cells between them feel it. Above the touch tolerance they stay apart.
        pub clearance_m: f64 = 0.0001,
        /// Preshape joints without an open value in the layout are drawn uniformly from this part of their range. `[0, 0.5]`: the Barrett's spread from 0 to π/2,
        /// fingers 1 and 2 opposite to finger 3 or at right angles to it.
        pub preshape_range: [f64; 2] = [0.0, 0.5],
        /// The object's centre of mass is off the palm's axis by up to this, uniformly over the disc. 15 mm: the approach
        /// is blind, aimed roughly.
        pub lateral_offset_m: f64 = 0.015,
        /// How far the palm draws back after the first touch of a blind approach, before the fingers close. 0, as the paper's
        /// "until something touches" does not mention it. Planned approaches have a stand-off of their own.
        pub back_off_m: f64 = 0.0,
    }
}

impl ProtocolOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        let tolerance_m = self.touch_tolerance_m;
        require(
            "touch_tolerance_m",
            tolerance_m,
            tolerance_m > 0.0 && tolerance_m <= 0.003,
            "a number above 0, at most 0.003: the rubber's thickness",
        )?;
        positive("clearance_m", self.clearance_m)?;
        check_preshape_range(["preshape_range[0]", "preshape_range[1]"], self.preshape_range)?;
        not_negative("lateral_offset_m", self.lateral_offset_m)?;
        not_negative("back_off_m", self.back_off_m)
    }
}

pub(crate) fn check_preshape_range(options: [&'static str; 2], [least, most]: [f64; 2]) -> Result<(), OptionError> {
    share(options[0], least)?;
    require(options[1], most, (least..=1.0).contains(&most), "a number from preshape_range[0] to 1")
}

/// The start of a grasp of a given object.
#[derive(Debug, Clone)]
pub struct Start {
    /// The joints before closing: preshape joints drawn, the others open.
    pub open_joints: Vec<f64>,
    /// Rotation of the object in the palm frame: direction and roll of the approach in one.
    pub palm_from_object_rotation: UnitQuaternion<f64>,
    /// The object's centre of mass off the palm's axis, x and y of the palm frame.
    pub lateral_offset_m: [f64; 2],
    /// Distance by which the palm draws back after the first touch, before the fingers close.
    pub back_off_m: f64,
}

/// A closed hand around (or beside) an object.
#[derive(Debug, Clone)]
pub struct Exploration {
    pub palm_from_object: Isometry3<f64>,
    /// The joints before closing.
    pub open_joints: Vec<f64>,
    /// The joints that closed, with their ends.
    pub joints: Vec<ClosingJoint>,
    /// The progress (radians of a leader) at which the last joint stopped.
    pub end: f64,
}

impl Exploration {
    /// The joints at a progress between 0 (open) and [`Exploration::end`] (settled).
    pub fn posture(&self, progress: f64) -> Vec<f64> {
        posture(&self.open_joints, &self.joints, progress)
    }
}

/// Draws a random start.
pub fn draw_start(hand: &Hand, options: &ProtocolOptions, rng: &mut impl rand::Rng) -> Start {
    let open_joints = hand
        .joints
        .iter()
        .map(|joint| {
            if joint.is_preshape && joint.open.is_none() {
                let [least, most] = options.preshape_range;
                let part = least + (most - least) * rng.random::<f64>();
                joint.lower + part * (joint.upper - joint.lower)
            } else {
                joint.open()
            }
        })
        .collect();
    let radius_m = options.lateral_offset_m * rng.random::<f64>().sqrt();
    let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
    Start {
        open_joints,
        palm_from_object_rotation: random_rotation(rng),
        lateral_offset_m: [radius_m * cos, radius_m * sin],
        back_off_m: options.back_off_m,
    }
}

/// Least progress between two measurements of a distance, radians: 20 µm of a Barrett fingertip.
const LEAST_STEP: f64 = 1e-4;
/// Distances beyond this are not measured while closing, metres.
const CHEAP_M: f64 = 0.03;
/// Distances are measured exactly only where the cheap bound is below this, metres.
const EXACT_M: f64 = 0.002;
/// A link that touches but moves away is looked at again after this progress.
const LEAVING_STEP: f64 = 5e-4;
/// Fingers of one motor push an object at most so often, each time by half the way that is left.
const MOST_PUSHES: usize = 20;
/// A finger farther from the object than this does not count: the object is not pushed towards it.
const FARTHEST_PUSH_M: f64 = 0.2;

impl Mechanism<'_> {
    /// Approaches and closes. `None` if the hand passes by the object, or the open hand touches itself.
    ///
    /// # Errors
    /// A start of another hand.
    pub fn explore(
        &self,
        object: &Object,
        start: &Start,
        options: &ProtocolOptions,
    ) -> Result<Option<Exploration>, JointError> {
        if self.hand.self_collides(&start.open_joints)? {
            return Ok(None);
        }
        let Some(mut palm_from_object) = self.approach(object, start, options)? else {
            return Ok(None);
        };
        palm_from_object.translation.vector.z += start.back_off_m;
        self.close_from(object, palm_from_object, start.open_joints.clone(), options).map(Some)
    }

    /// Closes the open hand around an object, which fingers of one motor may push.
    ///
    /// # Errors
    /// Joints of another hand.
    pub(crate) fn close_from(
        &self,
        object: &Object,
        mut palm_from_object: Isometry3<f64>,
        open_joints: Vec<f64>,
        options: &ProtocolOptions,
    ) -> Result<Exploration, JointError> {
        let mut joints = self.close(object, &palm_from_object, &open_joints, options)?;
        for _ in 0..MOST_PUSHES {
            let posture = posture(&open_joints, &joints, f64::INFINITY);
            let Some(push) = self.push(object, &palm_from_object, &posture, &joints, options)? else { break };
            let pushed = Translation3::from(push) * palm_from_object;
            if !self.is_apart(object, &pushed, &open_joints, 0.0)? {
                break;
            }
            palm_from_object = pushed;
            joints = self.close(object, &palm_from_object, &open_joints, options)?;
        }
        let end = joints.iter().map(|joint| joint.end).fold(0.0, f64::max);
        Ok(Exploration { palm_from_object, open_joints, joints, end })
    }

    /// The way by which fingers of one motor push the object, until a finger that comes from the other side holds it. It goes in
    /// the mean direction of the fingers that touch it, by half the distance to the nearest one that moves against them. `None`
    /// where no finger touches, where those that do would push against each other, where no other is near, or where the motor is
    /// at its limit.
    fn push(
        &self,
        object: &Object,
        palm_from_object: &Isometry3<f64>,
        posture: &[f64],
        joints: &[ClosingJoint],
        options: &ProtocolOptions,
    ) -> Result<Option<Vector3<f64>>, JointError> {
        let palm_from_links = self.hand.palm_from_links(posture)?;
        let object_pose = pose_from_isometry(palm_from_object);
        for (closing_idx, fingers) in self.fingers.iter().enumerate() {
            if fingers.len() < 2 || joints[closing_idx].end >= self.joints[closing_idx].end {
                continue;
            }
            let (mut touching, mut apart) = (Vec::new(), Vec::new());
            for links in fingers {
                let Some((distance_m, direction)) = self.finger_motion(links, object, &object_pose, &palm_from_links)
                else {
                    continue;
                };
                if distance_m <= options.touch_tolerance_m {
                    touching.push(direction);
                } else {
                    apart.push((distance_m, direction));
                }
            }
            let mean = touching.iter().sum::<Vector3<f64>>();
            let Some(mean) = mean.try_normalize(1e-9) else { continue };
            if touching.iter().any(|direction| direction.dot(&mean) <= 0.0) {
                continue;
            }
            let mut nearest_m = f64::INFINITY;
            for (distance_m, direction) in apart {
                if direction.dot(&mean) < 0.0 {
                    nearest_m = nearest_m.min(distance_m);
                }
            }
            if nearest_m.is_finite() {
                return Ok(Some(mean * (nearest_m / 2.0)));
            }
        }
        Ok(None)
    }

    /// The distance of a finger from the object, and the direction in which its nearest point moves.
    fn finger_motion(
        &self,
        links: &[usize],
        object: &Object,
        object_pose: &Pose,
        palm_from_links: &[Isometry3<f64>],
    ) -> Option<(f64, Vector3<f64>)> {
        let mut nearest: Option<(usize, ClosestPoints)> = None;
        for shape in self.shapes.iter().filter(|shape| links.contains(&shape.link_idx)) {
            let pose = shape.pose_in_palm(palm_from_links);
            if let Some(closest) = shape.closest_to_object(&pose, object_pose, object, FARTHEST_PUSH_M)
                && nearest.as_ref().is_none_or(|(_, best)| closest.distance_m.total_cmp(&best.distance_m).is_lt())
            {
                nearest = Some((shape.link_idx, closest));
            }
        }
        let (link_idx, closest) = nearest?;
        let velocity = self.velocity(link_idx, closest.point_on_first, palm_from_links, &self.joints, 0.0);
        let direction = Vector3::new(velocity.x, velocity.y, velocity.z).try_normalize(1e-12)?;
        Some((closest.distance_m, direction))
    }

    /// Whether all links of the hand are farther from the object than `from_m`, at most 2 mm.
    pub(crate) fn is_apart(
        &self,
        object: &Object,
        palm_from_object: &Isometry3<f64>,
        posture: &[f64],
        from_m: f64,
    ) -> Result<bool, JointError> {
        let palm_from_links = self.hand.palm_from_links(posture)?;
        let object_pose = pose_from_isometry(palm_from_object);
        Ok(self.shapes.iter().all(|shape| {
            let pose = shape.pose_in_palm(&palm_from_links);
            shape
                .closest_to_object(&pose, &object_pose, object, EXACT_M)
                .is_none_or(|closest| closest.distance_m > from_m)
        }))
    }

    /// Lets the object come down along the palm's -z until the first link touches it: `palm_from_object` then.
    pub fn approach(
        &self,
        object: &Object,
        start: &Start,
        options: &ProtocolOptions,
    ) -> Result<Option<Isometry3<f64>>, JointError> {
        let palm_from_links = self.hand.palm_from_links(&start.open_joints)?;
        let [x, y] = start.lateral_offset_m;
        let rotation = start.palm_from_object_rotation;
        let at = |z: f64| {
            let centre = Vector3::new(x, y, z) - rotation * object.centre_of_mass_m.coords;
            Isometry3::from_parts(centre.into(), rotation)
        };
        let at_zero = at(0.0);
        // The shapes that may touch first come first, and spare most of the others the search.
        let mut shapes: Vec<(f64, &PlacedShape<'_>)> = Vec::with_capacity(self.shapes.len());
        for shape in &self.shapes {
            let palm_from_link = &palm_from_links[shape.link_idx];
            shapes.push((shape.spheres_stop_z(palm_from_link, &at_zero, object, stop_m(options)), shape));
        }
        shapes.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let mut stop_z = f64::NEG_INFINITY;
        for (_, shape) in shapes {
            stop_z = shape.stop_z(&palm_from_links[shape.link_idx], &at_zero, object, stop_m(options), stop_z);
        }
        Ok(if stop_z.is_finite() { Some(at(stop_z)) } else { None })
    }

    /// Closes by conservative advancement: a distance and a bound of the speed give a progress before which the distance cannot be
    /// zero, and only then it is measured again. Stopped joints make links slower, so older bounds stay true.
    fn close(
        &self,
        object: &Object,
        palm_from_object: &Isometry3<f64>,
        open_joints: &[f64],
        options: &ProtocolOptions,
    ) -> Result<Vec<ClosingJoint>, JointError> {
        let mut closing = Closing {
            mechanism: self,
            object,
            palm_from_object,
            object_pose: pose_from_isometry(palm_from_object),
            options,
            joints: self.joints.clone(),
            progress: 0.0,
            palm_from_links: Vec::new(),
        };
        let mut shape_due = vec![0.0; self.shapes.len()];
        let mut pair_due = vec![0.0; self.pairs.len()];
        loop {
            let progress = closing.progress;
            closing.palm_from_links = self.hand.palm_from_links(&posture(open_joints, &closing.joints, progress))?;
            for (shape, due) in self.shapes.iter().zip(&mut shape_due) {
                if *due <= progress {
                    *due = closing.look_at_shape(shape);
                }
            }
            for (&(a, b), due) in self.pairs.iter().zip(&mut pair_due) {
                if *due <= progress {
                    *due = closing.look_at_pair(a, b);
                }
            }
            let end = closing.joints.iter().map(|joint| joint.end).fold(0.0, f64::max);
            if progress >= end {
                return Ok(closing.joints);
            }
            let next = shape_due.iter().chain(&pair_due).copied().fold(end, f64::min);
            closing.progress = next.max(progress + LEAST_STEP).min(end);
        }
    }
}

/// A hand that closes around an object.
struct Closing<'a> {
    mechanism: &'a Mechanism<'a>,
    object: &'a Object,
    palm_from_object: &'a Isometry3<f64>,
    object_pose: Pose,
    options: &'a ProtocolOptions,
    joints: Vec<ClosingJoint>,
    progress: f64,
    /// At this progress.
    palm_from_links: Vec<Isometry3<f64>>,
}

impl Closing<'_> {
    /// Stops a link whose shape touches the object. Returns the progress at which the shape is looked at again.
    fn look_at_shape(&mut self, shape: &PlacedShape<'_>) -> f64 {
        let Closing { mechanism, object, progress, .. } = *self;
        let link_idx = shape.link_idx;
        if !mechanism.is_moving(link_idx, &self.joints, progress) {
            return f64::INFINITY;
        }
        let (stop_m, speed) = (stop_m(self.options), mechanism.top_speed[link_idx]);
        let palm_from_link = &self.palm_from_links[link_idx];
        let apart_m = shape.sphere_distance_m(palm_from_link, self.palm_from_object, object);
        if apart_m > 0.01 {
            return progress + (apart_m - stop_m) / speed;
        }
        let shape_pose = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
        let bound_m = shape.bound_m(&shape_pose, &self.object_pose, object, CHEAP_M);
        if bound_m > EXACT_M {
            return progress + (bound_m - stop_m) / speed;
        }
        let Some(closest) = shape.closest_to_object(&shape_pose, &self.object_pose, object, CHEAP_M) else {
            return progress + (CHEAP_M - stop_m) / speed;
        };
        if closest.distance_m > stop_m {
            return progress + (closest.distance_m - 0.8 * stop_m) / speed;
        }
        if self.velocity(link_idx, closest.point_on_first).dot(closest.direction) > 0.0 {
            mechanism.stop(&mut self.joints, progress, link_idx, None);
            return f64::INFINITY;
        }
        progress + LEAVING_STEP
    }

    /// Stops two links that come too near to each other. Returns the progress at which they are looked at again.
    fn look_at_pair(&mut self, a: usize, b: usize) -> f64 {
        let Closing { mechanism, progress, .. } = *self;
        if !mechanism.is_moving(a, &self.joints, progress) && !mechanism.is_moving(b, &self.joints, progress) {
            return f64::INFINITY;
        }
        let Some(ClosestLinks { points: closest, .. }) = mechanism.closest_of_links(a, b, &self.palm_from_links) else {
            return progress + LEAST_STEP;
        };
        let clearance_m = self.options.clearance_m;
        if closest.distance_m > clearance_m {
            let speed = mechanism.top_speed[a] + mechanism.top_speed[b];
            return progress + (closest.distance_m - 0.98 * clearance_m) / speed;
        }
        let nearing = self.velocity(a, closest.point_on_first) - self.velocity(b, closest.point_on_second);
        if nearing.dot(closest.direction) > 0.0 {
            mechanism.stop(&mut self.joints, progress, a, Some(b));
            mechanism.stop(&mut self.joints, progress, b, Some(a));
        }
        progress + LEAVING_STEP
    }

    fn velocity(&self, link_idx: usize, point: Vector) -> Vector {
        self.mechanism.velocity(link_idx, point, &self.palm_from_links, &self.joints, self.progress)
    }
}

/// Links are stopped in the middle of the touch tolerance, so that distances stay positive and well defined.
fn stop_m(options: &ProtocolOptions) -> f64 {
    options.touch_tolerance_m / 2.0
}

/// The joints at a progress of closing.
pub(crate) fn posture(open_joints: &[f64], joints: &[ClosingJoint], progress: f64) -> Vec<f64> {
    let mut posture = open_joints.to_vec();
    for joint in joints {
        posture[joint.joint_idx] += joint.rate * progress.min(joint.end);
    }
    posture
}

/// Uniform over all rotations (Shoemake 1992).
fn random_rotation(rng: &mut impl rand::Rng) -> UnitQuaternion<f64> {
    let [u, v, w]: [f64; 3] = std::array::from_fn(|_| rng.random());
    let (sin_v, cos_v) = (std::f64::consts::TAU * v).sin_cos();
    let (sin_w, cos_w) = (std::f64::consts::TAU * w).sin_cos();
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(a * sin_v, a * cos_v, b * sin_w, b * cos_w))
}
