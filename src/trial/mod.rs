//! Lift trials in physics: a hand on an arm, an object on a table, gravity, contact forces and friction.
//!
//! The physics engine (rapier) takes the robot's place, behind the interfaces that a robot would use: an [`Attempt`]
//! approaches until something touches, closes, and says what the cells and encoders read, frame by frame; then it is
//! given up, or lifted, held and shaken, and judged by where the object is. Nothing here knows of a label or a decision.
//!
//! The paper's experiment (Dang & Allen, section IV-E): [`things`] are its six objects, [`tally`] counts what
//! became of trials, [`tables`] and [`page`] show it.

pub mod course;
pub mod page;
pub mod tables;
pub mod tally;
pub mod things;

use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::grasp::candidate::TimedFrame;
use crate::grasp::objects::Object;
use crate::hand::Hand;

/// An object as a trial has it.
#[derive(Debug, Clone)]
pub struct Thing {
    /// What tables call it, e.g. `canteen with cover, 0.50 kg`.
    pub name: String,
    /// What it belongs to in the tables, e.g. `canteen`.
    pub group: String,
    /// Shape and centre of mass, standing on z = 0 of its frame.
    pub object: Object,
    /// Mass, instead of the object's own.
    pub mass_kg: f64,
    /// Coulomb friction of its surface on the hand's rubber.
    pub friction: f64,
}

/// How trials are made, each option with its default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrialOptions {
    /// Simulated time between frames. 10 ms: 100 Hz.
    pub frame_nanos: u64,
}

impl Default for TrialOptions {
    fn default() -> Self {
        TrialOptions { frame_nanos: 10_000_000 }
    }
}

/// Where an attempt comes from, in the frame of the table: z up, the thing's place at the origin.
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

/// Draws attempt number `attempt` of trial number `trial`: a pure function of them and the seed.
pub fn draw_start(hand: &Hand, _options: &TrialOptions, seed: u64, trial: u64, attempt: u32) -> Start {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(trial << 16 | u64::from(attempt));
    Start {
        world_from_palm_xyzw: [1.0, 0.0, 0.0, 0.0],
        lateral_offset_m: [0.0; 2],
        open_joints_rad: vec![0.0; hand.joints.len()],
        yaw_rad: rng.random::<f64>(),
    }
}

/// The seed of what the sensor adds in attempt number `attempt` of trial number `trial`: a pure function of them and the
/// seed.
pub fn sensor_seed(seed: u64, trial: u64, attempt: u32) -> u64 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Beside the streams that `draw_start` draws from.
    rng.set_stream(1 << 63 | trial << 16 | u64::from(attempt));
    rng.random()
}

/// Why there can be no trial.
#[derive(Debug, thiserror::Error)]
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
    /// The thing is in the hand and off the table, after lifting, holding and shaking.
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
    /// The palm in the frame of the table: position, metres, and rotation.
    pub palm_position_m: [f64; 3],
    /// x, y, z, w.
    pub palm_rotation_xyzw: [f64; 4],
    /// The hand's joints.
    pub joints_rad: Vec<f64>,
    /// The thing's own frame in the frame of the table.
    pub thing_position_m: [f64; 3],
    /// x, y, z, w.
    pub thing_rotation_xyzw: [f64; 4],
}

/// One attempt at one thing, from the approach to the grasp's end.
pub struct Attempt<'a> {
    hand: &'a Hand,
    n_frames: u64,
    will_hold: bool,
    frame_nanos: u64,
}

impl<'a> Attempt<'a> {
    /// Places the hand before the thing. What the sensor adds (noise) comes from `sensor_seed`.
    ///
    /// # Errors
    /// An option that can't be, a hand that cannot be simulated.
    pub fn begin(
        hand: &'a Hand,
        _thing: &Thing,
        options: &TrialOptions,
        start: &Start,
        _sensor_seed: u64,
    ) -> Result<Attempt<'a>, TrialError> {
        Ok(Attempt { hand, n_frames: 0, will_hold: start.yaw_rad > 0.3, frame_nanos: options.frame_nanos })
    }

    /// Goes on to the next frame; `None` once the grasp has settled and its settled frames are out.
    pub fn next_frame(&mut self, grasp_id: u64) -> Option<TimedFrame> {
        use crate::message::{Phase, TactileFrame};
        if self.n_frames == 8 {
            return None;
        }
        let phase = if self.n_frames < 2 { Phase::Open } else { Phase::Settled };
        let force = if self.n_frames < 2 { 0.0 } else { 1.0 };
        self.n_frames += 1;
        Some(TimedFrame {
            offset_nanos: (self.n_frames - 1) * self.frame_nanos,
            frame: TactileFrame {
                grasp_id,
                phase,
                joints_rad: vec![0.0; self.hand.joints.len()],
                cells_newtons: (0..self.hand.n_cells()).map(|idx| if idx % 7 == 0 { force } else { 0.0 }).collect(),
            },
        })
    }

    /// Lifts what the hand has, holds it, shakes it and judges. `watch` sees everything at each frame's time.
    pub fn lift(&mut self, mut watch: impl FnMut(&Snapshot)) -> LiftResult {
        watch(&self.snapshot());
        LiftResult { held: self.will_hold, slip_m: 0.001, turn_rad: 0.0 }
    }

    /// Epsilon and volume of the settled grasp, from all its contacts (as [`crate::grasp::wrench_space::Quality`] has
    /// them); `None` if the hull failed.
    pub fn quality(&self) -> Option<(f64, f64)> {
        Some((0.1, 0.2))
    }

    /// Where everything is now.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot {
            elapsed_nanos: self.n_frames * self.frame_nanos,
            palm_position_m: [0.0, 0.0, 0.2],
            palm_rotation_xyzw: [1.0, 0.0, 0.0, 0.0],
            joints_rad: vec![0.0; self.hand.joints.len()],
            thing_position_m: [0.0; 3],
            thing_rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        }
    }
}
