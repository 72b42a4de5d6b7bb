//! The options of a simulation, and their checks.

use super::contact_points::ContactOptions;
use super::option_check::{OptionError, not_negative, require, share, with_defaults};
use super::planner::PlannerOptions;
use super::protocol::ProtocolOptions;
use super::soft_finger::SoftFingerOptions;
use super::tactile_sensor::SensorOptions;
use super::wrench_space::{MAX_FRICTION, Quality, STABLE_EPSILON, STABLE_VOLUME};
use crate::trial::{PhysicsEngine, PhysicsOptions, TrialProtocol, check_planner};
use blindgrasp_stages::hand::{CellUnit, Hand};
use blindgrasp_stages::label::Label;

with_defaults! {
    /// All options of a simulation.
    pub struct SimulatorOptions {
        /// Number of grasps to keep.
        pub n_grasps: usize = 1000,
        /// Seed of everything random.
        pub seed: u64 = 0,
        /// The meaning of stable. A lift takes 0.3 to 0.6 s of CPU time a candidate.
        #[serde(skip_serializing_if = "Label::is_default")]
        pub label: Label = Label::default(),
        /// The least epsilon and volume of a stable grasp, with label `wrench-space`.
        #[serde(skip_serializing_if = "Thresholds::is_default")]
        pub thresholds: Thresholds = Thresholds::default(),
        /// Share of stable grasps among those kept, rounded to whole grasps; `None` keeps the natural share. 0.48, as in the
        /// paper.
        pub stable_fraction: Option<f64> = Some(0.48),
        /// Grasps of a part, which is the unit that machines share and that is made again after an interruption. 500: seconds
        /// of work.
        pub grasps_per_part: usize = 500,
        /// The simulation gives up after so many candidates per grasp asked for, and 1000 more. 50: a stable fraction of 0.48 is
        /// then reached down to a natural share of 1 %.
        pub max_candidates_per_grasp: usize = 50,
        /// Coulomb friction of every contact, at most 10. 1.0: rubber on wood (the paper). With label `lift` it is that of the physics, and
        /// epsilon and volume are still those of 1.0.
        pub friction: f64 = 1.0,
        /// What differs from lift to lift, with label `lift`.
        #[serde(skip_serializing_if = "LiftOptions::is_default")]
        pub lift: LiftOptions = LiftOptions::default(),
        /// Options of the exploration.
        pub protocol: ProtocolOptions = ProtocolOptions::default(),
        /// Options of the planner, which the protocol's approach `planned` uses.
        pub planner: PlannerOptions = PlannerOptions::default(),
        /// Options of the contact points.
        pub contacts: ContactOptions = ContactOptions::default(),
        /// Options of the rubber.
        pub soft_finger: SoftFingerOptions = SoftFingerOptions::default(),
        /// Options of cells and encoders.
        pub sensor: SensorOptions = SensorOptions::default(),
        /// Numbers of frames.
        pub frames: FrameOptions = FrameOptions::default(),
    }
}

impl SimulatorOptions {
    /// Checks all options.
    ///
    /// # Errors
    /// The first value that cannot be used.
    pub fn check(&self) -> Result<(), OptionError> {
        require("n_grasps", self.n_grasps, (1..=1_000_000_000).contains(&self.n_grasps), "1 to 1e9")?;
        require("grasps_per_part", self.grasps_per_part, (1..=100_000).contains(&self.grasps_per_part), "1 to 100000")?;
        share("stable_fraction", self.stable_fraction.unwrap_or(0.0))?;
        let is_friction = self.friction > 0.0 && self.friction <= MAX_FRICTION;
        require("friction", self.friction, is_friction, "a number above 0, at most 10")?;
        self.protocol.check()?;
        self.planner.check()?;
        self.contacts.check()?;
        self.soft_finger.check()?;
        self.sensor.check()?;
        self.frames.check()?;
        self.lift.check()?;
        match self.label {
            Label::WrenchSpace => {
                self.thresholds.check()?;
                require("lift", "set", self.lift.is_default(), "its default without label lift: nothing is lifted")?;
                let SensorOptions { skin, lag_secs, joint_encoders, .. } = &self.sensor;
                let is_plain = skin.is_default() && *lag_secs == 0.0 && *joint_encoders == 0.0;
                let expected = "their defaults without label lift: only lifts have them";
                require("sensor.skin, lag_secs or joint_encoders", "set", is_plain, expected)
            }
            Label::Lift => self.check_for_lift(),
        }
    }

    /// Refuses options that the physics do not have.
    fn check_for_lift(&self) -> Result<(), OptionError> {
        let expected = "its default with label lift: whether the lift keeps the object decides";
        require("thresholds", "set", self.thresholds.is_default(), expected)?;
        require(
            "frames.period_nanos",
            self.frames.period_nanos,
            (1_000_000..=100_000_000).contains(&self.frames.period_nanos),
            "1e6 to 1e8 with label lift: steps of the physics are 5e6",
        )?;
        let (protocol, default) = (&self.protocol, ProtocolOptions::default());
        let expected = "its default with label lift: the physics have no such option";
        for (option, found, default) in [
            ("protocol.touch_tolerance_m", protocol.touch_tolerance_m, default.touch_tolerance_m),
            ("protocol.clearance_m", protocol.clearance_m, default.clearance_m),
            ("protocol.back_off_m", protocol.back_off_m, default.back_off_m),
        ] {
            require(option, found, found == default, expected)?;
        }
        check_planner(&self.planner)
    }
}

with_defaults! {
    /// A grasp is stable if both its qualities exceed these. Those of Dang & Allen (section IV) were chosen for a hand of
    /// three fingers.
    #[derive(Copy)]
    pub struct Thresholds {
        pub epsilon: f64 = STABLE_EPSILON,
        pub volume: f64 = STABLE_VOLUME,
    }
}

impl Thresholds {
    /// Whether these are the paper's.
    pub fn is_default(&self) -> bool {
        *self == Thresholds::default()
    }

    /// Whether a grasp of this quality is stable.
    pub fn hold(&self, quality: &Quality) -> bool {
        quality.epsilon > self.epsilon && quality.volume > self.volume
    }

    fn check(&self) -> Result<(), OptionError> {
        not_negative("thresholds.epsilon", self.epsilon)?;
        not_negative("thresholds.volume", self.volume)
    }
}

with_defaults! {
    /// What differs from lift to lift, so that a model does not learn what a robot does not know.
    pub struct LiftOptions {
        /// The physics engine.
        pub engine: PhysicsEngine = PhysicsEngine::default(),
        /// Range of a factor on the friction, uniform. `[1, 1]`: none.
        pub friction_factor: [f64; 2] = [1.0; 2],
        /// Range of a factor on the object's mass, its logarithm uniform. `[1, 1]`: none.
        pub mass_factor: [f64; 2] = [1.0; 2],
        /// Largest distance by which the centre of mass is off the object's own, uniform over the ball: contents. 0: none.
        pub centre_shift_m: f64 = 0.0,
        /// Range of the radius of the table or post on which the object stands, its logarithm uniform. As in trials.
        pub stand_radius_m: [f64; 2] = [PhysicsOptions::default().stand_radius_m; 2],
        /// Range of a factor on the forces with which the fingers close and grip, its logarithm uniform. `[1, 1]`: none.
        pub force_factor: [f64; 2] = [1.0; 2],
        /// Range of a factor on the fingers' closing speed, its logarithm uniform. `[1, 1]`: none.
        pub speed_factor: [f64; 2] = [1.0; 2],
        /// Range of a factor on the stiffness of the rubber that spreads a force over cells, its logarithm uniform. `[1, 1]`: none.
        pub rubber_factor: [f64; 2] = [1.0; 2],
        /// Range of a factor on how fast contacts give way, its logarithm uniform: 0.5 is four times as soft. `[1, 1]`: none.
        pub contact_factor: [f64; 2] = [1.0; 2],
        /// Range of a factor on the stiffness of the gears between motors and joints, its logarithm uniform. `[1, 1]`: none.
        pub gear_factor: [f64; 2] = [1.0; 2],
        /// Share of the lifts in which contacts creep, with MuJoCo. 0.
        pub creep_share: f64 = 0.0,
        /// Height of the test lift. As in trials.
        pub test_lift_m: f64 = TrialProtocol::default().test_lift_m,
        /// Amplitude of the shake after it; 0: none. As in trials.
        pub test_shake_m: f64 = TrialProtocol::default().test_shake_m,
        /// The engine's time step, seconds. As in trials; another one shows how far results depend on it.
        pub step_secs: f64 = PhysicsOptions::default().step_secs,
        /// The engine's time step from the lift on, seconds. As before the lift; another one shows how far the outcome depends on it
        /// from the same settled hand.
        #[serde(skip_serializing_if = "Option::is_none")]
        pub lift_step_secs: Option<f64> = None,
    }
}

impl LiftOptions {
    pub fn is_default(&self) -> bool {
        *self == LiftOptions::default()
    }

    fn check(&self) -> Result<(), OptionError> {
        for (option, [low, high]) in [
            ("lift.friction_factor", self.friction_factor),
            ("lift.mass_factor", self.mass_factor),
            ("lift.stand_radius_m", self.stand_radius_m),
            ("lift.force_factor", self.force_factor),
            ("lift.speed_factor", self.speed_factor),
            ("lift.rubber_factor", self.rubber_factor),
            ("lift.contact_factor", self.contact_factor),
            ("lift.gear_factor", self.gear_factor),
        ] {
            let is_range = low > 0.0 && low <= high && high <= 100.0;
            require(option, format!("[{low}, {high}]"), is_range, "two ascending numbers above 0, at most 100")?;
        }
        share("lift.creep_share", self.creep_share)?;
        let creeps = self.creep_share == 0.0 || self.engine == PhysicsEngine::Mujoco;
        require("lift.creep_share", self.creep_share, creeps, "0 without engine mujoco")?;
        not_negative("lift.centre_shift_m", self.centre_shift_m)?;
        let most_m = TrialProtocol::default().lift_m;
        let is_height = self.test_lift_m > 0.0 && self.test_lift_m < most_m;
        require("lift.test_lift_m", self.test_lift_m, is_height, "more than 0, less than the height of the lift")?;
        not_negative("lift.test_shake_m", self.test_shake_m)?;
        for (option, secs) in
            [("lift.step_secs", self.step_secs), ("lift.lift_step_secs", self.lift_step_secs.unwrap_or(self.step_secs))]
        {
            require(option, secs, secs > 0.0 && secs <= 0.02, "more than 0, at most 0.02")?;
        }
        Ok(())
    }
}

with_defaults! {
    /// The frames of a grasp.
    pub struct FrameOptions {
        /// Frames before the object touches, without force.
        pub n_open: usize = 2,
        /// Frames that are evenly spaced over the closing. A contact's force rises linearly from the stop of its link to the
        /// end of the closing.
        pub n_closing: usize = 6,
        /// Frames after the last joint's stop, with full force and noise of their own.
        pub n_settled: usize = 6,
        /// Time between frames. 10 ms: 100 Hz.
        pub period_nanos: u64 = 10_000_000,
    }
}

impl FrameOptions {
    fn check(&self) -> Result<(), OptionError> {
        require("frames.n_open", self.n_open, self.n_open <= 100_000, "0 to 100000")?;
        require("frames.n_closing", self.n_closing, self.n_closing <= 100_000, "0 to 100000")?;
        require("frames.n_settled", self.n_settled, (1..=100_000).contains(&self.n_settled), "1 to 100000")?;
        let period = self.period_nanos;
        require("frames.period_nanos", period, (1..=1_000_000_000_000).contains(&period), "1 to 1e12")
    }
}

/// The hand's cells do not read forces, so that their readings of simulated forces are not known.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the cells of the hand '{hand}' read {}, no forces: expected a hand whose layout has newtons", unit.word())]
pub struct CellUnitError {
    pub hand: String,
    pub unit: CellUnit,
}

/// Checks that a hand can be simulated.
///
/// # Errors
/// Its cells read no forces.
pub fn check_hand(hand: &Hand) -> Result<(), CellUnitError> {
    match hand.cell_unit {
        CellUnit::Newtons => Ok(()),
        unit => Err(CellUnitError { hand: hand.name.clone(), unit }),
    }
}
