//! The hand as bodies and motors: each closing joint a motor of limited torque, with break-away.
//!
//! While a finger closes, its leader is driven at constant speed and its followers at their ratio. A joint that lags
//! behind at its torque limit is blocked, and the rule is the simulator's (`grasp::protocol`): **a blocked link stops
//! every joint that moves it**, so a blocked leader stays and the follower goes on alone, and a blocked follower stops
//! the whole finger. A stopped joint keeps its torque; its gear holds against more than its motor can push
//! (a worm drive is not driven backwards). Before the arm lifts, the motors press with their full force; a link that broke
//! away has none, and only its gear holds it.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rapier3d_f64::dynamics::{
    JointAxis, MotorModel, MultibodyJointHandle, RevoluteJointBuilder, RigidBodyBuilder, RigidBodyHandle,
};
use rapier3d_f64::geometry::ColliderHandle;
use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::parry::shape::{Shape, SharedShape};

use crate::mechanism::Mechanism;
use crate::trial::world::{World, to_engine};
use crate::trial::{PhysicsOptions, TrialError};
use blindgrasp_stages::hand::{Hand, LinkShape, Motion, pose_from_isometry};

/// A collider and its shape of the hand.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShapeCollider {
    pub(super) collider: ColliderHandle,
    /// Index into the mechanism's shapes.
    pub(super) shape_idx: usize,
    pub(super) link_idx: usize,
}

/// A joint with its motor.
struct Drive {
    /// Index into [`Hand::joints`].
    joint_idx: usize,
    joint: MultibodyJointHandle,
    /// Of another drive, which it follows until that one is blocked.
    follows: Option<usize>,
    /// Radians per radian of the leader.
    rate: f64,
    open_rad: f64,
    /// How far it can close from there.
    range_rad: f64,
    /// Largest torque of the motor.
    limit_newton_metres: f64,
    /// Where the motor is, from `open_rad` on; its gear twists by the difference to the joint.
    target_rad: f64,
    /// The lever of the links that the joint closes.
    reach_m: f64,
    is_stopped: bool,
    /// It was blocked while its follower could go on: the motor has let go of it for good.
    has_broken_away: bool,
    lagging_secs: f64,
}

impl Drive {
    /// Stops, and keeps pressing with at most its largest torque.
    fn stop(&mut self, angle_rad: f64, options: &PhysicsOptions) {
        if !self.is_stopped {
            self.is_stopped = true;
            let most_rad = angle_rad + self.limit_newton_metres / options.gear_stiffness;
            self.target_rad = self.target_rad.min(most_rad);
        }
    }
}

/// The hand in a world.
pub(super) struct HandBody {
    drives: Vec<Drive>,
    /// All colliders of the hand.
    pub(super) shapes: Vec<ShapeCollider>,
    open_joints_rad: Vec<f64>,
}

impl HandBody {
    pub(super) fn new(
        world: &mut World,
        mechanism: &Mechanism<'_>,
        open_joints_rad: &[f64],
        options: &PhysicsOptions,
    ) -> Result<HandBody, TrialError> {
        let hand = mechanism.hand;
        let refuse = |reason: String| TrialError::Hand { hand: hand.name.clone(), reason };
        let palm_from_links = hand.palm_from_links(open_joints_rad).map_err(|error| refuse(error.to_string()))?;
        let is_closing = |joint_idx: usize| mechanism.joints.iter().any(|joint| joint.joint_idx == joint_idx);
        let palm = world.engine.insert_body(RigidBodyBuilder::fixed());
        let mut link_bodies: Vec<RigidBodyHandle> = Vec::with_capacity(hand.links.len());
        let mut drives: Vec<Drive> = Vec::new();
        for (link_idx, link) in hand.links.iter().enumerate() {
            let parent = link.parent_idx.map_or(palm, |parent_idx| link_bodies[parent_idx]);
            let Motion::Revolute { joint_idx, multiplier, offset_rad, axis } = link.motion else {
                link_bodies.push(parent);
                continue;
            };
            if !is_closing(joint_idx) {
                if parent != palm {
                    return Err(refuse(format!(
                        "joint {} turns on a finger but does not close",
                        hand.joints[joint_idx].name
                    )));
                }
                link_bodies.push(parent);
                continue;
            }
            if multiplier != 1.0 || offset_rad != 0.0 || drives.iter().any(|drive| drive.joint_idx == joint_idx) {
                let name = &hand.joints[joint_idx].name;
                return Err(refuse(format!("joint {name} moves several links: that is not simulated")));
            }
            let palm_from_link = palm_from_links[link_idx];
            let reach_m = reach_m(hand, link_idx);
            let body = world.engine.insert_body(
                RigidBodyBuilder::dynamic()
                    .pose(pose_from_isometry(&palm_from_link))
                    .can_sleep(false)
                    .gravity_scale(0.0)
                    .additional_mass_properties(link_mass(&link.shapes, options)),
            );
            // Where the parent's body has the joint, and its axis as x.
            let parent_from_joint = match (parent == palm, link.parent_idx) {
                (false, _) | (_, None) => link.parent_from_joint,
                (true, Some(parent_idx)) => palm_from_links[parent_idx] * link.parent_from_joint,
            };
            let x_to_axis = UnitQuaternion::rotation_between(&Vector3::x(), &axis)
                .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI));
            let open = UnitQuaternion::from_axis_angle(&axis, open_joints_rad[joint_idx]);
            let turned = |rotation: UnitQuaternion<f64>| Isometry3::from_parts(Default::default(), rotation);
            let mut joint = RevoluteJointBuilder::new(to_engine(&Vector3::x())).build();
            joint.data.set_local_frame1(pose_from_isometry(&(parent_from_joint * turned(open * x_to_axis))));
            joint.data.set_local_frame2(pose_from_isometry(&turned(x_to_axis)));
            joint.data.set_contacts_enabled(false);
            let Some(handle) = world.engine.insert_multibody_joint(parent, body, joint) else {
                return Err(refuse(format!("joint {} cannot be hung on its link", hand.joints[joint_idx].name)));
            };
            let spec = &hand.joints[joint_idx];
            let coupling = spec.coupling;
            let open_rad = open_joints_rad[joint_idx];
            drives.push(Drive {
                joint_idx,
                joint: handle,
                follows: None,
                rate: coupling.map_or(1.0, |coupling| coupling.ratio),
                open_rad,
                range_rad: (spec.upper_rad - open_rad).max(0.0),
                limit_newton_metres: options.grip_newtons * reach_m,
                target_rad: 0.0,
                reach_m,
                is_stopped: false,
                has_broken_away: false,
                lagging_secs: 0.0,
            });
            link_bodies.push(body);
        }
        for idx in 0..drives.len() {
            let follows = hand.joints[drives[idx].joint_idx].coupling.map(|coupling| coupling.follows_idx);
            drives[idx].follows = follows.and_then(|leader| drives.iter().position(|drive| drive.joint_idx == leader));
        }
        let mut shapes = Vec::new();
        for (shape_idx, placed) in mechanism.shapes.iter().enumerate() {
            let link_idx = placed.link_idx;
            let body = link_bodies[link_idx];
            let body_from_link = if body == palm { palm_from_links[link_idx] } else { Isometry3::identity() };
            let shape = grown(placed.core, placed.edge_radius_m);
            let builder = World::hand_collider(shape, &(body_from_link * placed.link_from_shape));
            let collider = world.engine.insert_collider(builder, Some(body));
            shapes.push(ShapeCollider { collider, shape_idx, link_idx });
        }
        let mut hand_body = HandBody { drives, shapes, open_joints_rad: open_joints_rad.to_vec() };
        for drive in &hand_body.drives {
            if let Some((multibody, _)) = world.engine.multibody_joints.get_mut(drive.joint) {
                multibody.set_self_contacts_enabled(true);
                multibody.armature_mut().fill(options.rotor_inertia);
            }
        }
        hand_body.command(world, 0.0, options);
        Ok(hand_body)
    }

    /// The joints' angles.
    pub(super) fn joints_rad(&self, world: &World) -> Vec<f64> {
        let mut joints_rad = self.open_joints_rad.clone();
        for drive in &self.drives {
            joints_rad[drive.joint_idx] = drive.open_rad + angle_rad(world, drive);
        }
        joints_rad
    }

    /// The encoders' angles before rounding: they sit at the motors, whose gears give.
    pub(super) fn motors_rad(&self) -> Vec<f64> {
        let mut joints_rad = self.open_joints_rad.clone();
        for drive in &self.drives {
            joints_rad[drive.joint_idx] = drive.open_rad + drive.target_rad;
        }
        joints_rad
    }

    /// The torque of each joint's motor or gear, from the gear's twist, newton metres; 0 of a joint without a motor.
    pub(super) fn torques(&self, world: &World, gear_stiffness: f64) -> Vec<f64> {
        let mut torques = vec![0.0; self.open_joints_rad.len()];
        for drive in &self.drives {
            torques[drive.joint_idx] = (drive.target_rad - angle_rad(world, drive)) * gear_stiffness;
        }
        torques
    }

    /// Closes on for a time step; whether every joint has stopped.
    pub(super) fn close(&mut self, world: &mut World, options: &PhysicsOptions) -> bool {
        let dt = options.step_secs;
        for idx in 0..self.drives.len() {
            let angle = angle_rad(world, &self.drives[idx]);
            let drive = &mut self.drives[idx];
            if drive.is_stopped {
                continue;
            }
            let lag_rad = drive.target_rad - angle;
            let is_lagging = lag_rad * options.gear_stiffness >= drive.limit_newton_metres;
            drive.lagging_secs = if is_lagging { drive.lagging_secs + dt } else { 0.0 };
            let is_blocked = drive.lagging_secs >= options.blocked_secs;
            let is_at_limit = drive.target_rad >= drive.range_rad;
            if is_blocked || is_at_limit {
                drive.stop(angle, options);
                let leader = drive.follows.filter(|_| is_blocked);
                if let Some(leader) = leader {
                    let angle = angle_rad(world, &self.drives[leader]);
                    self.drives[leader].stop(angle, options);
                }
                let mut followers = self.drives.iter().filter(|other| other.follows == Some(idx));
                let goes_on = followers.any(|follower| !follower.is_stopped);
                self.drives[idx].has_broken_away = is_blocked && goes_on;
                continue;
            }
            let most = angle + 1.2 * drive.limit_newton_metres / options.gear_stiffness;
            let step = drive.rate * options.closing_rad_per_sec * dt;
            // Its target waits for the joint: no further ahead of it than to be sure that it lags.
            drive.target_rad = (drive.target_rad + step).min(most.max(drive.target_rad)).min(drive.range_rad);
        }
        let all_stopped = self.drives.iter().all(|drive| drive.is_stopped);
        self.command(world, if all_stopped { 0.0 } else { options.closing_rad_per_sec }, options);
        all_stopped
    }

    /// Stops every joint that has not stopped yet.
    pub(super) fn stop(&mut self, world: &mut World, options: &PhysicsOptions) {
        for drive in &mut self.drives {
            let angle = angle_rad(world, drive);
            drive.stop(angle, options);
        }
        self.command(world, 0.0, options);
    }

    /// Grips on for a time step, with a part of the way to the force of lifting: from 0, as it closed, to 1. Where the target
    /// gives, the joint closes on. A joint that has broken away, or is at its limit, stays.
    pub(super) fn grip(&mut self, world: &mut World, part: f64, options: &PhysicsOptions) {
        let more_newtons = (options.lift_grip_newtons - options.grip_newtons).max(0.0) * part;
        for drive in &mut self.drives {
            let angle = angle_rad(world, drive);
            drive.stop(angle, options);
            if drive.has_broken_away || drive.target_rad >= drive.range_rad {
                continue;
            }
            let newton_metres = (options.grip_newtons + more_newtons) * drive.reach_m;
            let twisted_rad = angle + newton_metres / options.gear_stiffness;
            let step_rad = drive.rate * options.closing_rad_per_sec * options.step_secs;
            // It never goes back: the gear is not driven backwards.
            let closed_rad = (drive.target_rad + step_rad).min(twisted_rad).min(drive.range_rad);
            drive.target_rad = drive.target_rad.max(closed_rad);
        }
        self.command(world, 0.0, options);
    }

    fn command(&mut self, world: &mut World, rad_per_sec: f64, options: &PhysicsOptions) {
        for drive in &self.drives {
            let Some((multibody, link_id)) = world.engine.multibody_joints.get_mut(drive.joint) else { continue };
            let Some(link) = multibody.link_mut(link_id) else { continue };
            let (speed, newtons) = match drive.is_stopped {
                true => (0.0, options.hold_newtons),
                false => (drive.rate * rad_per_sec, options.grip_newtons),
            };
            let data = &mut link.joint.data;
            data.set_motor_model(JointAxis::AngX, MotorModel::ForceBased);
            data.set_motor(JointAxis::AngX, drive.target_rad, speed, options.gear_stiffness, options.gear_damping);
            data.set_motor_max_force(JointAxis::AngX, newtons * drive.reach_m);
        }
    }
}

fn angle_rad(world: &World, drive: &Drive) -> f64 {
    let joints = &world.engine.multibody_joints;
    joints.get(drive.joint).and_then(|(multibody, id)| multibody.link(id)).map_or(0.0, |link| {
        // Three shifts, then the turn about x.
        link.joint.coords()[3]
    })
}

/// The lever of a link's tip: the distance from its joint to the farthest point of the straight finger.
fn reach_m(hand: &Hand, link_idx: usize) -> f64 {
    let own_m = hand.links[link_idx]
        .shapes
        .iter()
        .map(|shape| {
            let sphere = shape.core.compute_local_bounding_sphere();
            let centre =
                shape.link_from_shape * nalgebra::Point3::new(sphere.center.x, sphere.center.y, sphere.center.z);
            centre.coords.norm() + sphere.radius
        })
        .fold(0.0, f64::max);
    let children = hand.links.iter().enumerate().filter(|(_, link)| link.parent_idx == Some(link_idx));
    children
        .map(|(child_idx, child)| child.parent_from_joint.translation.vector.norm() + reach_m(hand, child_idx))
        .fold(own_m, f64::max)
}

/// A core with its rounded edges.
fn grown(core: &dyn Shape, edge_radius_m: f64) -> SharedShape {
    if edge_radius_m > 0.0 {
        if let Some(cuboid) = core.as_cuboid() {
            let half = cuboid.half_extents;
            return SharedShape::round_cuboid(half.x, half.y, half.z, edge_radius_m);
        }
        if let Some(cylinder) = core.as_cylinder() {
            return SharedShape::round_cylinder(cylinder.half_height, cylinder.radius, edge_radius_m);
        }
    }
    SharedShape(core.clone_dyn().into())
}

/// The mass of a link's shapes, overlaps counted twice. Rotors are heavier than links: see [`PhysicsOptions::rotor_inertia`].
fn link_mass(shapes: &[LinkShape], options: &PhysicsOptions) -> MassProperties {
    let parts = shapes.iter().map(|shape| {
        SharedShape::clone(&shape.core)
            .mass_properties(options.link_density_kg_per_m3)
            .transform_by(&pose_from_isometry(&shape.link_from_shape))
    });
    parts.sum()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::trial::LiftTarget;
    use blindgrasp_objects::Object;

    /// The hand, open, before a ball that nothing moves, its middle so far from the palm's frame along z; no gravity.
    fn before_a_ball(radius_m: f64, middle_m: f64, test: impl FnOnce(&mut World, &mut HandBody, &PhysicsOptions)) {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let (mechanism, options) = (Mechanism::new(&hand), PhysicsOptions::default());
        let object = Object::new("ball".into(), "ball".into(), SharedShape::ball(radius_m), 1000.0, false);
        let target = LiftTarget::new("ball".into(), "ball".into(), object, 1e4, 1.0);
        // The stand is far away.
        let palm_from_world = Isometry3::translation(0.0, 0.0, -5.0);
        let world_from_target = Isometry3::translation(0.0, 0.0, 5.0 + middle_m);
        let mut world = World::new(&target, &world_from_target, &palm_from_world, &options);
        world.engine.gravity = to_engine(&Vector3::zeros());
        let open = vec![0.0; hand.joints.len()];
        let mut body = HandBody::new(&mut world, &mechanism, &open, &options).expect("a hand");
        test(&mut world, &mut body, &options);
    }

    fn close_until_stopped(world: &mut World, body: &mut HandBody, options: &PhysicsOptions) {
        for _ in 0..2000 {
            world.step();
            if body.close(world, options) {
                (0..60).for_each(|_| world.step());
                return;
            }
        }
        panic!("it never stops");
    }

    /// What a motor presses with, through its gear, of what makes `newtons` at the tip.
    fn part_of(newtons: f64, world: &World, drive: &Drive, options: &PhysicsOptions) -> f64 {
        (drive.target_rad - angle_rad(world, drive)) * options.gear_stiffness / (newtons * drive.reach_m)
    }

    #[test]
    fn a_hand_that_nothing_stops_closes_to_its_limits_with_its_joints_coupled() {
        before_a_ball(0.01, 1.0, |world, body, options| {
            for _ in 0..100 {
                world.step();
                body.close(world, options);
            }
            for drive in &body.drives {
                let Some(leader) = drive.follows else { continue };
                let (own, of_leader) = (angle_rad(world, drive), angle_rad(world, &body.drives[leader]));
                assert!(of_leader > 0.3 && (own - drive.rate * of_leader).abs() < 0.02, "{own} {of_leader}");
            }
            close_until_stopped(world, body, options);
            assert!(body.drives.iter().all(|drive| !drive.has_broken_away));
            for drive in &body.drives {
                assert!((angle_rad(world, drive) - drive.range_rad).abs() < 0.02);
            }
        });
    }

    #[test]
    fn a_blocked_link_breaks_away_and_no_motor_presses_with_more_than_it_has() {
        // It lies a little above the palm and fills the hand: the inner links come to it well before the outer ones.
        before_a_ball(0.05, 0.14, |world, body, options| {
            close_until_stopped(world, body, options);
            let n_broken_away = body.drives.iter().filter(|drive| drive.has_broken_away).count();
            assert!(n_broken_away > 0);
            for drive in &body.drives {
                let part = part_of(options.grip_newtons, world, drive, options);
                // Other links may push a stopped joint back: its gear holds against that.
                let most = options.hold_newtons / options.grip_newtons;
                assert!(
                    part < 1.03 * most && (part < 1.3 || drive.has_broken_away),
                    "presses with {part} of what it has"
                );
                let Some(leader) = drive.follows.map(|leader| &body.drives[leader]) else { continue };
                let (own, coupled) = (angle_rad(world, drive), drive.rate * angle_rad(world, leader));
                assert!(!leader.has_broken_away || own > coupled + 0.3, "{own} rad, coupled {coupled} rad");
            }
            let before: Vec<f64> = body.drives.iter().map(|drive| drive.target_rad).collect();
            grip(world, body, options);
            for (drive, before_rad) in body.drives.iter().zip(before) {
                if drive.has_broken_away {
                    assert_eq!(drive.target_rad, before_rad, "nothing drives what has broken away");
                }
            }
        });
    }

    #[test]
    fn gripping_never_lets_go_and_reaches_the_motors_full_force() {
        before_a_ball(0.05, 0.13, |world, body, options| {
            close_until_stopped(world, body, options);
            let before: Vec<f64> = body.drives.iter().map(|drive| drive.target_rad).collect();
            grip(world, body, options);
            assert!(body.drives.iter().zip(before).all(|(drive, before_rad)| drive.target_rad >= before_rad));
            let parts = body.drives.iter().filter(|drive| !drive.has_broken_away);
            let parts: Vec<f64> =
                parts.map(|drive| part_of(options.lift_grip_newtons, world, drive, options)).collect();
            assert!(parts.iter().any(|part| *part >= 0.97), "{parts:?}");
        });
    }

    /// Grips for a second.
    fn grip(world: &mut World, body: &mut HandBody, options: &PhysicsOptions) {
        for step in 0..200 {
            body.grip(world, f64::from(step.min(60)) / 60.0, options);
            world.step();
        }
    }
}
