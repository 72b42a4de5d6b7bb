//! Lift trials in physics: a hand on an arm, an object on a stand, gravity, contact forces and friction.
//!
//! The physics engine (rapier) takes the robot's place, behind the interfaces that a robot would have: an [`Attempt`]
//! approaches until something touches, closes, and gives frames of cells and encoders. It is then given up, or lifts,
//! holds and shakes, and the place of the object says whether it was kept. Labels and decisions are not part of this.
//!
//! [`targets`] are the six objects of the paper's experiment (Dang & Allen, section IV-E). [`lift_label`] labels simulated
//! grasps by a lift.

mod attempt;
pub mod course;
mod engine;
mod hand_body;
pub mod lift_label;
mod motion;
mod mujoco;
mod options;
mod rest;
pub mod robot;
mod sensing;
mod start;
pub mod targets;
mod world;

use std::path::PathBuf;

use nalgebra::UnitQuaternion;
use rapier3d_f64::parry::shape::SharedShape;
use serde::{Deserialize, Serialize};

use crate::OptionError;
use blindgrasp_objects::Object;

pub use attempt::{Attempt, ProbeMove, Reaction};
pub use mujoco::python_path;
pub(crate) use options::check_planner;
pub use options::{MujocoOptions, PhysicsEngine, PhysicsOptions, TrialOptions, TrialProtocol, read_options};
pub use start::{choose_start, sensor_seed};

/// An object to lift. Its name and class are those in tables, e.g. `canteen with cover, 0.50 kg` and `canteen`.
#[derive(Debug, Clone)]
pub struct LiftTarget {
    pub object: Object,
    /// Coulomb friction of the surface on the hand's rubber.
    pub friction: f64,
    /// The convex hull, on which the target stands and of which its inertia is.
    hull: SharedShape,
    /// Rotation from the object's own frame to one in which it stands without toppling.
    rest: UnitQuaternion<f64>,
}

impl LiftTarget {
    /// It stands as it is built if it does not topple easily, and otherwise on the side on which it stands best: a spoon
    /// lies.
    pub fn new(object: Object, friction: f64) -> LiftTarget {
        let hull = rest::hull(&object);
        let rest = rest::rest_rotation(&hull, &object.centre_of_mass_m);
        LiftTarget { object, friction, hull, rest }
    }
}

/// The start of an attempt, in the frame of the stand (the world): z up, the origin where the target stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// Rotation of the palm while it approaches, along its own z axis.
    pub world_from_palm_xyzw: [f64; 4],
    /// The target's centre of mass off the palm's axis, x and y of the palm frame.
    pub lateral_offset_m: [f64; 2],
    /// The joints before closing, rad or m: preshape joints are set, the others open.
    pub open_joints: Vec<f64>,
    /// The target's turn about the vertical.
    pub yaw_rad: f64,
    /// How far before its first touch the hand stops, so that its fingers can close over the stand. 0: it goes on until it
    /// touches.
    pub back_off_m: f64,
}

/// Why there can be no trial.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrialError {
    #[error(transparent)]
    Option(#[from] OptionError),
    /// A file of options cannot be read, or has a value that cannot be used.
    #[error("options {}: {reason}", path.display())]
    OptionsFile { path: PathBuf, reason: String },
    #[error(
        "{target}: no approach leads the open hand to it without touching the stand before; expected an \
         object that stands higher or is larger: leave it out"
    )]
    NoApproach { target: String },
    /// The hand cannot be simulated.
    #[error("hand {hand}: {reason}")]
    Hand { hand: String, reason: String },
    /// The physics engine cannot be used, or has stopped.
    #[error("physics: {reason}")]
    Engine { reason: String },
    #[error("object {name}: {reason}")]
    Target { name: String, reason: String },
    #[error("{}: {reason}", path.display())]
    Mesh { path: PathBuf, reason: String },
}

impl TrialError {
    fn hand(hand: &blindgrasp_stages::hand::Hand, reason: impl ToString) -> TrialError {
        TrialError::Hand { hand: hand.name.clone(), reason: reason.to_string() }
    }
}

/// The outcome of a lift.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LiftResult {
    /// Whether the target is in the hand and off the stand after lifting, holding and shaking.
    pub held: bool,
    /// Movement of the target's centre of mass in the hand since the lift began; of a dropped target, until it was lost.
    pub slip_m: f64,
    /// Turn of the target in the hand.
    pub turn_rad: f64,
}

/// The places of hand and target, for pictures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Simulated time since the attempt began.
    pub elapsed_nanos: u64,
    /// The palm in the world.
    pub palm_position_m: [f64; 3],
    /// The palm's rotation: x, y, z, w.
    pub palm_rotation_xyzw: [f64; 4],
    pub joints: Vec<f64>,
    /// The target's own frame in the world.
    pub target_position_m: [f64; 3],
    /// The target's rotation: x, y, z, w.
    pub target_rotation_xyzw: [f64; 4],
}
