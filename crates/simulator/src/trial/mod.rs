//! Lift trials in physics: a hand on an arm, an object on a stand, gravity, contact forces and friction.
//!
//! The physics engine (rapier) takes the robot's place, behind the interfaces that a robot would use: an [`Attempt`]
//! approaches until something touches, closes, and says what the cells and encoders read, frame by frame; then it is
//! given up, or lifted, held and shaken, and judged by where the object is. Nothing here knows of a label or a decision.
//!
//! The paper's experiment (Dang & Allen, section IV-E): [`things`] are its six objects, [`tally`] counts what
//! became of trials, [`tables`] and [`page`] show it.

pub mod advised;
mod attempt;
pub mod course;
mod hand_body;
mod motion;
mod options_file;
mod rest;
pub mod robot;
mod sensing;
mod start;
pub mod things;
mod world;

use std::path::PathBuf;

use nalgebra::UnitQuaternion;
use rapier3d_f64::parry::shape::SharedShape;
use serde::{Deserialize, Serialize};

use crate::contact_points::ContactOptions;
use crate::simulator::OptionError;
use crate::soft_finger::SoftFingerOptions;
use crate::tactile_sensor::SensorOptions;
use blindgrasp_objects::Object;

pub use attempt::Attempt;
pub use start::{draw_start, sensor_seed};

/// An object as a trial has it.
#[derive(Debug, Clone)]
pub struct Thing {
    /// What tables call it, e.g. `canteen with cover, 0.50 kg`.
    pub name: String,
    /// What it belongs to in the tables, e.g. `canteen`.
    pub group: String,
    /// Shape and centre of mass.
    pub object: Object,
    /// Mass, instead of the object's own.
    pub mass_kg: f64,
    /// Coulomb friction of its surface on the hand's rubber.
    pub friction: f64,
    /// What it stands on, and what its inertia is of.
    hull: SharedShape,
    /// How it is turned, from its own frame, to stand without toppling.
    rest: UnitQuaternion<f64>,
}

impl Thing {
    /// An object as a thing of `mass_kg` with `friction`: it stands as it is built if it does not topple easily, and
    /// otherwise on the side on which it stands best (a spoon lies).
    pub fn new(name: String, group: String, object: Object, mass_kg: f64, friction: f64) -> Thing {
        let hull = rest::hull(&object);
        let rest = rest::rest_rotation(&hull, &object.centre_of_mass_m);
        Thing { name, group, object, mass_kg, friction, hull, rest }
    }
}

/// How trials are made, each option with its default.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrialOptions {
    /// How the hand comes and how long each phase takes.
    pub protocol: TrialProtocol,
    /// Hand, stand and engine.
    pub physics: PhysicsOptions,
    /// Cells and encoders.
    pub sensor: SensorOptions,
}

/// How the hand comes and how long each phase takes, in simulated time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrialProtocol {
    /// Preshape joints are drawn uniformly from this part of their range, as in the training data. `[0, 0.5]`.
    pub preshape_range: [f64; 2],
    /// The thing's centre of mass is off the palm's axis by up to this, uniformly over the disc, as in the training data.
    /// 15 mm.
    pub lateral_offset_m: f64,
    /// The approach goes down at least this steeply, from level; directions are uniform over what is left of the
    /// sphere. 0: level approaches are tried as well, where the stand lets them.
    pub least_descent_rad: f64,
    /// The open hand keeps this far from the stand, or the approach is drawn again. 5 mm.
    pub stand_clearance_m: f64,
    /// Time between frames. 10 ms: 100 Hz.
    pub frame_nanos: u64,
    /// How far from the first touch the hand begins, and how fast it comes. 3 mm at 30 mm/s: a guarded move.
    pub stand_off_m: f64,
    /// Metres per second.
    pub approach_speed: f64,
    /// The arm stops at this force. 0.1 N: a cell's noise threshold is half of it.
    pub touch_newtons: f64,
    /// From the last joint's stop to the first settled frame.
    pub settle_secs: f64,
    /// How many settled frames.
    pub n_settled: usize,
    /// How long the hand takes to grip with its full force, before the arm lifts. 0.3 s.
    pub grip_secs: f64,
    /// How far the arm lifts (0.2 m) and how long it takes.
    pub lift_m: f64,
    /// Seconds; the speed rises and falls smoothly.
    pub lift_secs: f64,
    /// How long it then keeps still.
    pub hold_secs: f64,
    /// Then it shakes sideways, and up and down, this far to either side,
    pub shake_m: f64,
    /// this often per second,
    pub shake_hertz: f64,
    /// each for so long.
    pub shake_secs: f64,
    /// A thing that has moved this far in the hand is lost. 50 mm.
    pub lost_m: f64,
}

impl Default for TrialProtocol {
    fn default() -> Self {
        TrialProtocol {
            preshape_range: [0.0, 0.5],
            lateral_offset_m: 0.015,
            least_descent_rad: 0.0,
            stand_clearance_m: 0.005,
            frame_nanos: 10_000_000,
            stand_off_m: 0.003,
            approach_speed: 0.03,
            touch_newtons: 0.1,
            settle_secs: 0.2,
            n_settled: 6,
            grip_secs: 0.3,
            lift_m: 0.2,
            lift_secs: 1.0,
            hold_secs: 1.0,
            shake_m: 0.01,
            shake_hertz: 2.0,
            shake_secs: 1.0,
            lost_m: 0.05,
        }
    }
}

/// Hand, stand and engine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PhysicsOptions {
    /// The engine's time step, of which the solver makes `n_solver_iterations` small ones. 5 ms.
    pub step_secs: f64,
    /// Small steps a step. 10: of 0.5 ms.
    pub n_solver_iterations: usize,
    /// Contacts give way like a damped spring of this natural frequency: the rubber.
    pub contact_hertz: f64,
    /// Its damping, of critical.
    pub contact_damping_ratio: f64,
    /// The thing stands on a round post of this radius, so that fingers find room under and beside it. 40 mm.
    pub stand_radius_m: f64,
    /// The post's height. 0.3 m: fingers don't come to its foot.
    pub stand_height_m: f64,
    /// Coulomb friction between the thing and the post, at most 1. 0.5, assumed: wood.
    pub stand_friction: f64,
    /// The force that a finger brings to its tip while it closes and feels, and with which a stopped one presses on. 5 N:
    /// the static load of the training data.
    pub grip_newtons: f64,
    /// The force to which it tightens before the arm lifts, if what it holds does not give. 15 N: the BH8-280's active
    /// finger force.
    pub lift_grip_newtons: f64,
    /// A stopped joint's gear holds against this much at the tip. 20 N: the BH8-280's passive finger force.
    pub hold_newtons: f64,
    /// Radians per second of a closing leader. 1.0, assumed: careful.
    pub closing_rad_per_sec: f64,
    /// A joint that lags at its limit for so long is blocked. 30 ms.
    pub blocked_secs: f64,
    /// Newton metres per radian between motor, where the encoder is, and joint. 100, assumed.
    pub gear_stiffness: f64,
    /// Newton metres per radian per second. 0.5, assumed.
    pub gear_damping: f64,
    /// The motor's inertia as the joint feels it, kg·m². 0.002, assumed.
    pub rotor_inertia: f64,
    /// Of the links. 2700: aluminium.
    pub link_density_kg_per_m3: f64,
    /// From forces to contact points: as in the training data.
    pub contacts: ContactOptions,
    /// The rubber, for the cells: as in the training data. Its load is not used: forces are the engine's.
    pub soft_finger: SoftFingerOptions,
}

impl Default for PhysicsOptions {
    fn default() -> Self {
        PhysicsOptions {
            step_secs: 0.005,
            n_solver_iterations: 10,
            contact_hertz: 100.0,
            contact_damping_ratio: 1.0,
            stand_radius_m: 0.04,
            stand_height_m: 0.3,
            stand_friction: 0.5,
            grip_newtons: 5.0,
            lift_grip_newtons: 15.0,
            hold_newtons: 20.0,
            closing_rad_per_sec: 1.0,
            blocked_secs: 0.03,
            gear_stiffness: 100.0,
            gear_damping: 0.5,
            rotor_inertia: 0.002,
            link_density_kg_per_m3: 2700.0,
            contacts: ContactOptions::default(),
            soft_finger: SoftFingerOptions::default(),
        }
    }
}

/// Where an attempt comes from, in the frame of the stand (the world): z up, the origin where the thing stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// How the palm is turned while it approaches: it moves along its own z axis.
    pub world_from_palm_xyzw: [f64; 4],
    /// Where the thing's centre of mass is off the palm's axis, x and y of the palm frame.
    pub lateral_offset_m: [f64; 2],
    /// The joints before closing: preshape joints set, the others open.
    pub open_joints_rad: Vec<f64>,
    /// How the thing is turned about the vertical.
    pub yaw_rad: f64,
}

/// Why there can be no trial.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrialError {
    /// An option that can't be.
    #[error("option {option} is {found}, expected {expected}")]
    Option {
        /// The option.
        option: &'static str,
        /// Its value.
        found: f64,
        /// What was expected.
        expected: &'static str,
    },
    /// An option that the simulator of the training data has, too, that can't be.
    #[error(transparent)]
    Shared(#[from] OptionError),
    /// A file of options that cannot be read, or has one that can't be.
    #[error("options {}: {reason}", path.display())]
    OptionsFile {
        /// The file.
        path: PathBuf,
        /// What is wrong in it, and what was expected.
        reason: String,
    },
    /// The hand never comes to the thing.
    #[error(
        "{thing}: none of {n_draws} approaches leads the open hand to it without touching the stand before; expected a \
         thing that stands higher or is larger: leave it out"
    )]
    NoApproach {
        /// The thing.
        thing: String,
        /// How many were tried.
        n_draws: usize,
    },
    /// The hand cannot be simulated.
    #[error("hand {hand}: {reason}")]
    Hand {
        /// Its name.
        hand: String,
        /// What it lacks.
        reason: String,
    },
    /// No such thing, or one that cannot be lifted.
    #[error("thing {name}: {reason}")]
    Thing {
        /// What it was called.
        name: String,
        /// What is wrong, and what was expected.
        reason: String,
    },
    /// A mesh that is no thing to lift.
    #[error("{}: {reason}", path.display())]
    Mesh {
        /// The mesh.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// What became of a lift.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LiftResult {
    /// The thing is in the hand and off the stand, after lifting, holding and shaking.
    pub held: bool,
    /// How far its centre of mass has moved in the hand since the lift began; of a dropped thing, until it was lost.
    pub slip_m: f64,
    /// How far it has turned in the hand.
    pub turn_rad: f64,
}

/// Where everything is, for pictures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Simulated time since the attempt began.
    pub elapsed_nanos: u64,
    /// The palm in the world: position, metres, and rotation.
    pub palm_position_m: [f64; 3],
    /// x, y, z, w.
    pub palm_rotation_xyzw: [f64; 4],
    /// The hand's joints.
    pub joints_rad: Vec<f64>,
    /// The thing's own frame in the world.
    pub thing_position_m: [f64; 3],
    /// x, y, z, w.
    pub thing_rotation_xyzw: [f64; 4],
}

impl TrialOptions {
    /// Whether these options can be.
    ///
    /// # Errors
    /// The first that can't, with what was expected.
    pub fn check(&self) -> Result<(), TrialError> {
        let (protocol, physics) = (&self.protocol, &self.physics);
        let positive = [
            ("protocol.approach_speed", protocol.approach_speed),
            ("protocol.touch_newtons", protocol.touch_newtons),
            ("protocol.lift_m", protocol.lift_m),
            ("protocol.grip_secs", protocol.grip_secs),
            ("protocol.lift_secs", protocol.lift_secs),
            ("protocol.shake_hertz", protocol.shake_hertz),
            ("protocol.lost_m", protocol.lost_m),
            ("protocol.frame_nanos", protocol.frame_nanos as f64),
            ("protocol.n_settled", protocol.n_settled as f64),
            ("physics.step_secs", physics.step_secs),
            ("physics.n_solver_iterations", physics.n_solver_iterations as f64),
            ("physics.contact_hertz", physics.contact_hertz),
            ("physics.grip_newtons", physics.grip_newtons),
            ("physics.stand_radius_m", physics.stand_radius_m),
            ("physics.stand_height_m", physics.stand_height_m),
            ("physics.lift_grip_newtons", physics.lift_grip_newtons),
            ("physics.hold_newtons", physics.hold_newtons),
            ("physics.closing_rad_per_sec", physics.closing_rad_per_sec),
            ("physics.gear_stiffness", physics.gear_stiffness),
            ("physics.rotor_inertia", physics.rotor_inertia),
            ("physics.link_density_kg_per_m3", physics.link_density_kg_per_m3),
        ];
        let not_negative = [
            ("protocol.lateral_offset_m", protocol.lateral_offset_m),
            ("protocol.stand_clearance_m", protocol.stand_clearance_m),
            ("protocol.stand_off_m", protocol.stand_off_m),
            ("protocol.settle_secs", protocol.settle_secs),
            ("protocol.hold_secs", protocol.hold_secs),
            ("protocol.shake_m", protocol.shake_m),
            ("protocol.shake_secs", protocol.shake_secs),
            ("physics.contact_damping_ratio", physics.contact_damping_ratio),
            ("physics.blocked_secs", physics.blocked_secs),
            ("physics.gear_damping", physics.gear_damping),
        ];
        let is_wrong =
            |value: f64, least_is_fine: bool| !value.is_finite() || value < 0.0 || (value == 0.0 && !least_is_fine);
        for (list, is_zero_fine, expected) in [
            (&positive[..], false, "a finite number above 0"),
            (&not_negative[..], true, "a finite number of 0 or more"),
        ] {
            if let Some((option, found)) = list.iter().find(|(_, value)| is_wrong(*value, is_zero_fine)) {
                return Err(TrialError::Option { option, found: *found, expected });
            }
        }
        let [least, most] = protocol.preshape_range;
        let steep = protocol.least_descent_rad;
        let ranges = [
            ("protocol.preshape_range[0]", least, (0.0..=1.0).contains(&least), "a number from 0 to 1"),
            ("protocol.preshape_range[1]", most, (least..=1.0).contains(&most), "a number from preshape_range[0] to 1"),
            (
                "protocol.least_descent_rad",
                steep,
                (0.0..=std::f64::consts::FRAC_PI_2).contains(&steep),
                "a number from 0 (level) to π/2 (straight down)",
            ),
            (
                "protocol.frame_nanos",
                protocol.frame_nanos as f64,
                (1_000_000..=100_000_000).contains(&protocol.frame_nanos),
                "1e6 to 1e8",
            ),
            ("physics.step_secs", physics.step_secs, physics.step_secs <= 0.02, "at most 0.02"),
            // The thing's foot has 1, and the lesser of the two counts.
            (
                "physics.stand_friction",
                physics.stand_friction,
                (0.0..=1.0).contains(&physics.stand_friction),
                "a number from 0 to 1",
            ),
        ];
        let durations = [
            ("protocol.settle_secs", protocol.settle_secs),
            ("protocol.grip_secs", protocol.grip_secs),
            ("protocol.lift_secs", protocol.lift_secs),
            ("protocol.hold_secs", protocol.hold_secs),
            ("protocol.shake_secs", protocol.shake_secs),
        ];
        let durations = durations.map(|(option, secs)| (option, secs, secs <= 60.0, "at most 60 s"));
        match ranges.into_iter().chain(durations).find(|(_, _, is_fine, _)| !is_fine) {
            Some((option, found, _, expected)) => Err(TrialError::Option { option, found, expected }),
            None => Ok(self.check_shared()?),
        }
    }
}
