//! The options of lift trials, and their checks.

use std::path::Path;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::TrialError;
use crate::OptionError;
use crate::contact_points::ContactOptions;
use crate::option_check::{not_negative, positive, require, with_defaults};
use crate::planner::PlannerOptions;
use crate::protocol::{Approach, check_preshape_range};
use crate::soft_finger::SoftFingerOptions;
use crate::tactile_sensor::SensorOptions;
use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::read_regular;

/// All options of trials.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrialOptions {
    /// Options of the hand's path and of the length of each phase.
    pub protocol: TrialProtocol,
    /// Options of the planner, which the protocol's approach `planned` uses.
    pub planner: PlannerOptions,
    /// Options of hand, stand and engine.
    pub physics: PhysicsOptions,
    /// Options of cells and encoders.
    pub sensor: SensorOptions,
}

with_defaults! {
    /// The hand's path and the length of each phase, in simulated time.
    pub struct TrialProtocol {
        /// The approach of the palm. Blind, as the paper's robot. `planned` is for hands that need to know the object's place,
        /// such as a gripper: the best of the planner's approaches from above.
        pub approach: Approach = Approach::Blind,
        /// Part of their range from which preshape joints are drawn uniformly. `[0, 0.5]`, as in the training data.
        pub preshape_range: [f64; 2] = [0.0, 0.5],
        /// Largest distance of the target's centre of mass from the palm's axis, uniform over the disc. 15 mm, as in the
        /// training data.
        pub lateral_offset_m: f64 = 0.015,
        /// Least descent of the approach, from level; directions are uniform over the rest of the sphere. 0: level approaches
        /// are tried as well, where the stand lets them. Attempts straight down have 1.4 rad at least.
        pub least_descent_rad: f64 = 0.0,
        /// Approaches of which one is chosen where a model says which are kept more often, 1 to 8. 8.
        pub n_approaches: u32 = 8,
        /// Least distance of the open hand from the stand; a nearer approach is drawn again. An attempt straight down keeps it
        /// while the hand closes. 5 mm.
        pub stand_clearance_m: f64 = 0.005,
        /// Time between frames. 10 ms: 100 Hz.
        pub frame_nanos: u64 = 10_000_000,
        /// Time between frames while the arm lifts. 50 ms: 20 Hz.
        pub lifting_frame_nanos: u64 = 50_000_000,
        /// Distance of the hand's first place from the first touch. 3 mm.
        pub stand_off_m: f64 = 0.003,
        /// Speed of the approach, metres per second. 0.03: a guarded move.
        pub approach_speed: f64 = 0.03,
        /// Force at which the arm stops. 0.1 N: twice a cell's noise threshold.
        pub touch_newtons: f64 = 0.1,
        /// Time from the last joint's stop to the first settled frame.
        pub settle_secs: f64 = 0.2,
        /// Number of settled frames.
        pub n_settled: usize = 6,
        /// Time in which the hand tightens to its full force before the arm lifts. 0.3 s.
        pub grip_secs: f64 = 0.3,
        /// Height of the test lift. 10 mm: with 5 mm, a model of 1,500 lifts told kept from dropped objects less well (benches/archive.md).
        pub test_lift_m: f64 = 0.01,
        /// Duration of the test lift, and of setting down. 0.25 s.
        pub test_lift_secs: f64 = 0.25,
        /// Amplitude of a sideways shake after the test lift, one period of `test_shake_secs`. 4 mm; 0: none.
        pub test_shake_m: f64 = 0.004,
        /// Duration of that shake. 0.25 s.
        pub test_shake_secs: f64 = 0.25,
        /// Time from the end of the test lift to the first frame that decides. 0.15 s.
        pub test_rest_secs: f64 = 0.15,
        /// Height of the lift. 0.2 m.
        pub lift_m: f64 = 0.2,
        /// Duration of the lift; the speed rises and falls smoothly. 1 s.
        pub lift_secs: f64 = 1.0,
        /// Time for which the arm keeps still after the lift. 1 s.
        pub hold_secs: f64 = 1.0,
        /// Amplitude of the shakes, first sideways, then up and down. 10 mm.
        pub shake_m: f64 = 0.01,
        /// Frequency of the shakes. 2 Hz.
        pub shake_hertz: f64 = 2.0,
        /// Duration of each of the two shakes. 1 s.
        pub shake_secs: f64 = 1.0,
        /// A target that has moved this far in the hand is dropped. 50 mm.
        pub lost_m: f64 = 0.05,
    }
}

with_defaults! {
    /// Hand, stand and engine.
    pub struct PhysicsOptions {
        /// The engine that moves the bodies.
        pub engine: PhysicsEngine = PhysicsEngine::Rapier,
        /// The engine's time step. 5 ms. Of MuJoCo it is the time between two commands of the motors.
        pub step_secs: f64 = 0.005,
        /// Small steps of the solver in a time step. 10: of 0.5 ms.
        pub n_solver_iterations: usize = 10,
        /// Natural frequency of contacts, which give way like a damped spring: the rubber. 100 Hz.
        pub contact_hertz: f64 = 100.0,
        /// Damping of contacts, as a share of critical damping. 1.
        pub contact_damping_ratio: f64 = 1.0,
        /// Radius of the round table on which the target stands. 0.4 m. With 0.04 it is a post, under whose edge fingers find
        /// room.
        pub stand_radius_m: f64 = 0.4,
        /// The table's height over the ground. 0.3 m: the fingers do not come to the ground beside a post.
        pub stand_height_m: f64 = 0.3,
        /// Coulomb friction between the target and the table, at most 1. 0.5, assumed: wood.
        pub stand_friction: f64 = 0.5,
        /// Force of a finger at its tip while it closes, and after its stop. 5 N: the static load of the training data.
        pub grip_newtons: f64 = 5.0,
        /// Force of a finger at its tip for the lift, if what it holds does not give. 15 N: the BH8-280's active finger force.
        pub lift_grip_newtons: f64 = 15.0,
        /// Force at the tip against which a stopped joint's gear holds. 20 N: the BH8-280's passive finger force.
        pub hold_newtons: f64 = 20.0,
        /// Speed of a closing leader, radians per second. 1.0, assumed: careful.
        pub closing_rad_per_sec: f64 = 1.0,
        /// Time after which a joint that lags at its limit is blocked. 30 ms.
        pub blocked_secs: f64 = 0.03,
        /// Stiffness of the gear between motor, where the encoder is, and joint, newton metres per radian. 100, assumed.
        pub gear_stiffness: f64 = 100.0,
        /// Damping of the gear, newton metre seconds per radian. 0.5, assumed.
        pub gear_damping: f64 = 0.5,
        /// Inertia of the motor as the joint feels it, kg·m². 0.002, assumed.
        pub rotor_inertia: f64 = 0.002,
        /// Density of the links. 2700 kg/m³: aluminium.
        pub link_density_kg_per_m3: f64 = 2700.0,
        /// Options of the contact points, as in the training data.
        pub contacts: ContactOptions = ContactOptions::default(),
        /// Options of the rubber, for the cells, as in the training data. Its load is not used: forces are the engine's.
        pub soft_finger: SoftFingerOptions = SoftFingerOptions::default(),
        /// Options of MuJoCo.
        pub mujoco: MujocoOptions = MujocoOptions::default(),
    }
}

/// A physics engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhysicsEngine {
    /// The built-in one.
    #[default]
    Rapier,
    /// MuJoCo, from PyPI: another model of contact.
    Mujoco,
}

with_defaults! {
    /// MuJoCo's contacts.
    pub struct MujocoOptions {
        /// Its longest time step. 2 ms: three steps fill the 5 ms between two commands.
        pub step_secs: f64 = 0.002,
        /// How much harder contacts resist slipping than pressing. 10.
        pub impratio: f64 = 10.0,
        /// Iterations that keep what friction holds from creeping. 10; 0: contacts creep, as the engine's usually do.
        pub noslip_iterations: usize = 10,
        /// Time constant of contacts, which give way like rubber: solref. 6 ms.
        pub contact_secs: f64 = 0.006,
        /// The torque about the normal that a contact resists, per friction force. 5 mm: of a patch of about 10 mm.
        pub torsion_m: f64 = 0.005,
    }
}

impl TrialOptions {
    /// A file of all options with their defaults and what they mean.
    pub const DEFAULTS: &str = include_str!("options.yaml");

    /// Reads options from a YAML or JSON file. Options that it leaves out have their defaults.
    ///
    /// # Errors
    /// A file that cannot be read, an unknown option, or a value that cannot be used; with the file's name.
    pub fn load(path: &Path) -> Result<TrialOptions, TrialError> {
        let options: TrialOptions = read_options(path)?;
        match options.check() {
            Ok(()) => Ok(options),
            Err(error) => Err(TrialError::OptionsFile { path: path.into(), reason: error.to_string() }),
        }
    }

    /// Checks all options.
    ///
    /// # Errors
    /// The first value that cannot be used.
    pub fn check(&self) -> Result<(), OptionError> {
        self.protocol.check()?;
        self.planner.check()?;
        check_planner(&self.planner)?;
        self.physics.check()?;
        self.sensor.check()
    }
}

/// Reads options, which it does not check, from a YAML or JSON file. Options that it leaves out have their defaults.
///
/// # Errors
/// A file that cannot be read, or an unknown option; with the file's name.
pub fn read_options<T: DeserializeOwned>(path: &Path) -> Result<T, TrialError> {
    let refuse = |reason: String| TrialError::OptionsFile { path: path.into(), reason };
    if let Some(kind) = FileKind::at(path).filter(|kind| !matches!(kind, FileKind::Empty | FileKind::Json)) {
        return Err(refuse(format!("expected YAML as of --print-options, found {}", kind.description())));
    }
    let text = read_regular(path).map_err(|error| refuse(error.to_string()))?;
    serde_saphyr::from_str(&text).map_err(|error| refuse(error.to_string()))
}

/// Refuses the planner's option that lifts do not have.
pub(crate) fn check_planner(options: &PlannerOptions) -> Result<(), OptionError> {
    let stand_off_m = options.stand_off_m;
    let is_default = stand_off_m == PlannerOptions::default().stand_off_m;
    require("planner.stand_off_m", stand_off_m, is_default, "its default: a lift closes the hand where it touches")
}

impl TrialProtocol {
    fn check(&self) -> Result<(), OptionError> {
        check_preshape_range(["protocol.preshape_range[0]", "protocol.preshape_range[1]"], self.preshape_range)?;
        not_negative("protocol.lateral_offset_m", self.lateral_offset_m)?;
        require(
            "protocol.least_descent_rad",
            self.least_descent_rad,
            (0.0..=std::f64::consts::FRAC_PI_2).contains(&self.least_descent_rad),
            "a number from 0 (level) to π/2 (straight down)",
        )?;
        not_negative("protocol.stand_clearance_m", self.stand_clearance_m)?;
        let is_frame_time = (1_000_000..=100_000_000).contains(&self.frame_nanos);
        require("protocol.frame_nanos", self.frame_nanos, is_frame_time, "1e6 to 1e8")?;
        let is_frame_time = (1_000_000..=100_000_000).contains(&self.lifting_frame_nanos);
        require("protocol.lifting_frame_nanos", self.lifting_frame_nanos, is_frame_time, "1e6 to 1e8")?;
        not_negative("protocol.stand_off_m", self.stand_off_m)?;
        positive("protocol.approach_speed", self.approach_speed)?;
        positive("protocol.touch_newtons", self.touch_newtons)?;
        let n_approaches = self.n_approaches;
        require("protocol.n_approaches", n_approaches, (1..=8).contains(&n_approaches), "1 to 8")?;
        require("protocol.n_settled", self.n_settled, self.n_settled >= 1, "1 or more")?;
        positive("protocol.lift_m", self.lift_m)?;
        let is_below = self.test_lift_m > 0.0 && self.test_lift_m < self.lift_m;
        require("protocol.test_lift_m", self.test_lift_m, is_below, "more than 0, less than lift_m")?;
        positive("protocol.test_lift_secs", self.test_lift_secs)?;
        not_negative("protocol.test_shake_m", self.test_shake_m)?;
        positive("protocol.test_shake_secs", self.test_shake_secs)?;
        not_negative("protocol.test_rest_secs", self.test_rest_secs)?;
        positive("protocol.grip_secs", self.grip_secs)?;
        positive("protocol.lift_secs", self.lift_secs)?;
        not_negative("protocol.shake_m", self.shake_m)?;
        positive("protocol.shake_hertz", self.shake_hertz)?;
        positive("protocol.lost_m", self.lost_m)?;
        for (option, secs) in [
            ("protocol.settle_secs", self.settle_secs),
            ("protocol.grip_secs", self.grip_secs),
            ("protocol.lift_secs", self.lift_secs),
            ("protocol.hold_secs", self.hold_secs),
            ("protocol.shake_secs", self.shake_secs),
        ] {
            require(option, secs, (0.0..=60.0).contains(&secs), "0 to 60 s")?;
        }
        Ok(())
    }
}

impl PhysicsOptions {
    fn check(&self) -> Result<(), OptionError> {
        require(
            "physics.step_secs",
            self.step_secs,
            self.step_secs > 0.0 && self.step_secs <= 0.02,
            "0 to 0.02, not 0",
        )?;
        require("physics.n_solver_iterations", self.n_solver_iterations, self.n_solver_iterations >= 1, "1 or more")?;
        // The target's foot has a friction of 1, and the lesser of the two counts.
        let is_friction = (0.0..=1.0).contains(&self.stand_friction);
        require("physics.stand_friction", self.stand_friction, is_friction, "a number from 0 to 1")?;
        for (option, value) in [
            ("physics.contact_hertz", self.contact_hertz),
            ("physics.stand_radius_m", self.stand_radius_m),
            ("physics.stand_height_m", self.stand_height_m),
            ("physics.grip_newtons", self.grip_newtons),
            ("physics.lift_grip_newtons", self.lift_grip_newtons),
            ("physics.hold_newtons", self.hold_newtons),
            ("physics.closing_rad_per_sec", self.closing_rad_per_sec),
            ("physics.gear_stiffness", self.gear_stiffness),
            ("physics.rotor_inertia", self.rotor_inertia),
            ("physics.link_density_kg_per_m3", self.link_density_kg_per_m3),
            ("physics.mujoco.impratio", self.mujoco.impratio),
            ("physics.mujoco.contact_secs", self.mujoco.contact_secs),
            ("physics.mujoco.torsion_m", self.mujoco.torsion_m),
        ] {
            positive(option, value)?;
        }
        require(
            "physics.mujoco.step_secs",
            self.mujoco.step_secs,
            self.mujoco.step_secs > 0.0 && self.mujoco.step_secs <= 0.005,
            "0 to 0.005, not 0",
        )?;
        not_negative("physics.contact_damping_ratio", self.contact_damping_ratio)?;
        not_negative("physics.blocked_secs", self.blocked_secs)?;
        not_negative("physics.gear_damping", self.gear_damping)?;
        self.contacts.check()?;
        self.soft_finger.check()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::Value;

    use super::*;

    fn loaded(text: &str) -> Result<TrialOptions, String> {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), text).expect("written");
        TrialOptions::load(file.path()).map_err(|error| {
            let error = error.to_string();
            assert!(error.starts_with(&format!("options {}: ", file.path().display())), "{error}");
            error
        })
    }

    #[test]
    fn a_file_says_what_is_not_the_default() {
        let options =
            loaded("protocol: {lift_m: 0.1}\nphysics:\n  contacts: {contacts_per_link: 1}\n").expect("options");
        assert_eq!((options.protocol.lift_m, options.physics.contacts.contacts_per_link), (0.1, 1));
        assert_eq!(options.sensor, TrialOptions::default().sensor);
        let json = serde_json::to_string_pretty(&options).expect("JSON");
        assert_eq!(loaded(&json), Ok(options));
    }

    #[test]
    fn what_cannot_be_is_refused_by_its_name() {
        for (text, expected) in [
            ("physics: {stand_friction: 1.5}", "option physics.stand_friction is 1.5, expected a number from 0 to 1"),
            ("physics: {stand_fricton: 0.5}", "stand_fricton"),
            ("protocol: {hold_secs: 1e9}", "option protocol.hold_secs is 1000000000, expected"),
            ("protocol: {frame_nanos: 1}", "option protocol.frame_nanos is 1, expected"),
            ("physics: {step_secs: 1}", "option physics.step_secs is 1, expected"),
            ("sensor: {dead_fraction: 2}", "option dead_fraction is 2, expected"),
            ("physics: {contacts: {contacts_per_link: 0}}", "option contacts_per_link is 0, expected"),
        ] {
            let error = loaded(text).expect_err(text);
            assert!(error.contains(expected), "{text}: {error}");
        }
        let missing = TrialOptions::load(Path::new("nosuch.yaml")).expect_err("no file").to_string();
        assert!(missing.starts_with("options nosuch.yaml: "), "{missing}");
    }

    #[test]
    fn the_file_to_copy_has_every_option_with_its_default() {
        let (copied, default) = (loaded(TrialOptions::DEFAULTS).expect("options"), TrialOptions::default());
        assert_eq!(copied, default);
        // A key that the file lacks would be read as its default.
        let written: Value = serde_saphyr::from_str(TrialOptions::DEFAULTS).expect("YAML");
        assert_eq!(names(&written), names(&serde_json::to_value(&default).expect("JSON")));
    }

    /// The names of all options.
    fn names(options: &Value) -> BTreeSet<String> {
        let Some(object) = options.as_object() else { return BTreeSet::from([String::new()]) };
        let mut found = BTreeSet::new();
        for (key, value) in object {
            found.extend(names(value).into_iter().map(|name| format!("{key}.{name}")));
        }
        found
    }
}
