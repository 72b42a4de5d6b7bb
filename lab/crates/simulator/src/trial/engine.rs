//! A physics engine for one attempt, in the frame of the palm, and the hand as every engine builds it.
//!
//! Motors, sensors, protocol and judgement are the same whatever engine moves the bodies.

use nalgebra::{Isometry3, Point3, UnitVector3, Vector3};
use rapier3d_f64::geometry::Group;
use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::parry::shape::SharedShape;

use blindgrasp_stages::hand::JointKind;

/// m/s².
pub(super) const GRAVITY: f64 = 9.81;

/// The body that the hand touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Target,
    /// The stand, or the ground that it stands on.
    Stand,
    Hand {
        link_idx: usize,
        shape_idx: usize,
    },
}

/// A force that presses on a link of the hand, in the palm frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Touch {
    pub(super) link_idx: usize,
    /// Index into the mechanism's shapes.
    pub(super) shape_idx: usize,
    pub(super) side: Side,
    /// The point on the surface of the touched body.
    pub(super) point_m: Point3<f64>,
    /// The normal out of the touched body.
    pub(super) outward: UnitVector3<f64>,
    /// The force at right angles to the surface.
    pub(super) newtons: f64,
}

/// A force of the stand on the target, in the palm frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StandForce {
    pub(super) point_m: Point3<f64>,
    pub(super) onto_target: Vector3<f64>,
    pub(super) newtons: f64,
}

/// The hand as bodies with shapes, in its open posture.
#[derive(Default)]
pub(super) struct HandPlan {
    /// The bodies that joints move, parents before children. Each has one axle, with the same index.
    pub(super) bodies: Vec<BodyPlan>,
    pub(super) shapes: Vec<ShapePlan>,
}

/// A body of the hand and the joint that moves it.
pub(super) struct BodyPlan {
    /// The body that bears it; `None`: the palm.
    pub(super) parent: Option<usize>,
    pub(super) palm_from_body: Isometry3<f64>,
    pub(super) kind: JointKind,
    /// The joint's frame, whose x axis is the joint's, in the direction of closing.
    pub(super) parent_from_axis: Isometry3<f64>,
    pub(super) body_from_axis: Isometry3<f64>,
    pub(super) mass: MassProperties,
    /// Inertia of the rotor as the joint feels it: kg·m², or kg of a slide.
    pub(super) armature: f64,
}

/// A shape of the hand on its body.
pub(super) struct ShapePlan {
    /// Index into the mechanism's shapes.
    pub(super) shape_idx: usize,
    pub(super) link_idx: usize,
    /// `None`: the palm.
    pub(super) body: Option<usize>,
    pub(super) body_from_shape: Isometry3<f64>,
    /// Without its rounded edges.
    pub(super) core: SharedShape,
    pub(super) edge_radius_m: f64,
    /// Its link's own group.
    pub(super) own: Group,
    /// The groups of the links that it may touch.
    pub(super) touched: Group,
}

/// The command of the motor behind an axle: it goes for `target` and `speed` with at most `most`, through a gear.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct AxleCommand {
    /// Travel from the open hand on: radians, or metres of a slide.
    pub(super) target: f64,
    pub(super) speed: f64,
    /// Newton metres per radian, or newtons per metre.
    pub(super) stiffness: f64,
    pub(super) damping: f64,
    /// Newton metres, or newtons.
    pub(super) most: f64,
}

/// What an attempt asks of a physics engine. The palm never turns. Places, velocities and forces are in the palm frame.
pub(super) trait Engine: Send {
    /// How far an axle has come from the open hand, in the direction of closing.
    fn travel(&self, axle: usize) -> f64;

    /// Sets the motors of all axles from the next step on.
    fn drive(&mut self, commands: &[AxleCommand]);

    /// Lets the palm move with this velocity and acceleration in the next step.
    fn set_palm_motion(&mut self, velocity: &Vector3<f64>, acceleration: &Vector3<f64>);

    /// The palm moves with this velocity from now on.
    fn push_off(&mut self, velocity: &Vector3<f64>);

    /// The palm, which has moved with this velocity, stops at once.
    fn stop_palm(&mut self, velocity: &Vector3<f64>);

    /// Goes on by a time step.
    fn step(&mut self);

    /// Goes on with another time step, seconds.
    fn set_step(&mut self, secs: f64);

    fn palm_from_target(&self) -> Isometry3<f64>;

    /// Velocity of the target's centre of mass against the palm.
    fn target_velocity(&self) -> Vector3<f64>;

    /// The forces on the hand.
    fn touches(&self) -> Vec<Touch>;

    /// The forces of stand and ground on the target.
    fn stand_forces(&self) -> Vec<StandForce>;

    /// Gravity, less the acceleration of the palm.
    fn gravity_in_palm(&self) -> Vector3<f64>;

    /// Why the engine has stopped, if it has.
    fn failure(&self) -> Option<String> {
        None
    }
}

/// The force with which stand and ground carry the target, at right angles to them.
pub(super) fn stand_newtons(engine: &dyn Engine) -> f64 {
    engine.stand_forces().iter().map(|force| force.newtons).sum()
}

/// Force and torque about the palm's origin with which the target loads the wrist, in the palm frame, given the place of
/// its centre of mass and its `acceleration` against the palm. That is its weight and inertia, less what the stand
/// carries. The stand's friction and the target's turning are left out.
pub(super) fn load_on_wrist(
    engine: &dyn Engine,
    mass_kg: f64,
    centre: &Point3<f64>,
    acceleration: &Vector3<f64>,
) -> (Vector3<f64>, Vector3<f64>) {
    let mut force = (engine.gravity_in_palm() - acceleration) * mass_kg;
    let mut torque = centre.coords.cross(&force);
    for on_target in engine.stand_forces() {
        let carried = on_target.onto_target * on_target.newtons;
        force += carried;
        torque += on_target.point_m.coords.cross(&carried);
    }
    (force, torque)
}
