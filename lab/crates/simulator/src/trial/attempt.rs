//! One attempt at one target: it approaches, closes and settles; then it lifts, holds, shakes and judges.

use nalgebra::{Isometry3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::engine::{Engine, GRAVITY, Side, Touch, load_on_wrist, stand_newtons};
use super::hand_body::HandBody;
use super::motion::{LiftPath, Path, TestLiftPath};
use super::mujoco::Mujoco;
use super::sensing::patches;
use super::start::first_touch;
use super::world::World;
use super::{
    LiftResult, LiftTarget, PhysicsEngine, PhysicsOptions, Snapshot, Start, TrialError, TrialOptions, TrialProtocol,
};
use crate::candidate::TimedFrame;
use crate::loaded_contacts::{SimulatedContact, grasp_case};
use crate::mechanism::Mechanism;
use crate::options::check_hand;
use crate::skin::Pressure;
use crate::tactile_sensor::{Sensor, read_torques, read_wrench};
use crate::wrench_space::{GraspCase, quality};
use blindgrasp_messages::{OwnedSenses, Phase, Sense, TactileFrame};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::lift_watch::TIGHTEN_STEPS;

/// An approach that has gone so far beyond the expected touch ends there: the target has given way.
const OVERSHOOT_M: f64 = 0.005;
/// Fingers that still move after this are stopped, and their grasp counts as settled.
const MOST_CLOSING_SECS: f64 = 5.0;

/// A joint that is farther beyond its limits swings without bounds.
const MOST_BEYOND_RAD: f64 = 0.5;

/// Seed of the faults that all cells of one hand keep.
const HAND_SEED: u64 = 0;

/// One attempt at one target, from the approach to the grasp's end.
pub struct Attempt<'a> {
    mechanism: Mechanism<'a>,
    target: LiftTarget,
    options: TrialOptions,
    engine: Box<dyn Engine>,
    body: HandBody,
    sensor: Sensor,
    rng: ChaCha8Rng,
    /// The arm's own movement so far, in the palm frame, for pictures.
    palm_from_start: Vector3<f64>,
    world_from_palm: Isometry3<f64>,
    stage: Stage,
    /// The stage whose frames are the last until it is asked to go on.
    last_stage: Stage,
    n_steps: u64,
    /// When the next frame is, since the beginning.
    next_nanos: u64,
    stage_secs: f64,
    /// Frames of this stage so far.
    n_frames_of_stage: usize,
    /// Where the target was in the hand when the hand had settled.
    settled: Option<Isometry3<f64>>,
    /// Whether the hand touched the target when the last probe began.
    was_touched: bool,
    /// How far the arm has moved from where the hand closed, in the world.
    lifted: Vector3<f64>,
    /// How far it had lifted when the lift began.
    lift_from_m: f64,
    /// The target's velocity at the last frame, in the palm frame.
    last_velocity: Vector3<f64>,
    /// What cells felt that lag behind their forces, and when.
    felt: Option<(Vec<f64>, u64)>,
    /// Whether the target has left the hand while the arm lifted.
    is_lost: bool,
    /// How often it was told to tighten while the arm lifted.
    n_tightened: u32,
}

/// What the hand does until it is asked to do something else.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Approach,
    Close,
    Settle,
    Settled,
    Squeeze,
    Squeezed,
    TestLift,
    TestLifted,
    Lift,
}

impl Stage {
    fn phase(self) -> Phase {
        match self {
            Stage::Approach => Phase::Open,
            Stage::Close | Stage::Settle => Phase::Closing,
            Stage::Settled => Phase::Settled,
            Stage::Squeeze => Phase::Squeezing,
            Stage::Squeezed => Phase::Squeezed,
            Stage::TestLift => Phase::TestLifting,
            Stage::TestLifted => Phase::TestLifted,
            Stage::Lift => Phase::Lifting,
        }
    }
}

/// The state of hand and target at the time of a frame.
pub(super) struct Moment {
    offset_nanos: u64,
    pub(super) phase: Phase,
    joints: Vec<f64>,
    /// Where the encoders are.
    motors_rad: Vec<f64>,
    torques: Vec<f64>,
    touches: Vec<Touch>,
    palm_from_target: Isometry3<f64>,
    load_on_wrist: (Vector3<f64>, Vector3<f64>),
}

/// What a hand does to feel more of a grasp before it decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ProbeMove {
    /// It tightens to the force of a lift.
    Squeeze,
    /// It tightens, lifts by a few millimetres and rests.
    TestLift,
}

/// What a hand does while it lifts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reaction {
    GoOn,
    /// It tightens by a step.
    Tighten,
    /// It sets the target down.
    SetDown,
}

impl<'a> Attempt<'a> {
    /// Places the hand before the target. The sensor's noise comes from `sensor_seed`.
    ///
    /// # Errors
    /// An option that can't be, a hand that cannot be simulated, or a start from which it misses the target.
    pub fn begin(
        hand: &'a Hand,
        target: &LiftTarget,
        options: &TrialOptions,
        start: &Start,
        sensor_seed: u64,
    ) -> Result<Attempt<'a>, TrialError> {
        options.check()?;
        check_hand(hand).map_err(|error| TrialError::hand(hand, error))?;
        let mechanism = Mechanism::new(hand);
        let Some(touch) = first_touch(&mechanism, target, start)? else {
            return Err(TrialError::NoApproach { target: target.object.name.clone() });
        };
        let mut stand_off_m = options.protocol.stand_off_m;
        if start.back_off_m > 0.0 {
            // Nothing stops the hand there but the end of its way.
            stand_off_m += start.back_off_m + OVERSHOOT_M;
        }
        let stand_off = Isometry3::translation(0.0, 0.0, stand_off_m);
        let palm_from_world = stand_off * touch.palm_from_world;
        let (plan, body) = HandBody::new(&mechanism, &start.open_joints, &options.physics)?;
        let (standing, physics) = (&touch.world_from_target, &options.physics);
        let mut engine: Box<dyn Engine> = match physics.engine {
            PhysicsEngine::Rapier => Box::new(World::new(target, standing, &palm_from_world, &plan, physics)?),
            PhysicsEngine::Mujoco => Box::new(Mujoco::new(target, standing, &palm_from_world, &plan, physics)?),
        };
        body.hold(&mut *engine, &options.physics);
        engine.push_off(&Vector3::new(0.0, 0.0, options.protocol.approach_speed));
        let mut rng = ChaCha8Rng::seed_from_u64(sensor_seed);
        // All attempts are one hand's.
        let sensor = Sensor::draw(hand, &options.sensor, HAND_SEED, &mut rng);
        Ok(Attempt {
            mechanism,
            target: target.clone(),
            options: options.clone(),
            engine,
            body,
            sensor,
            rng,
            palm_from_start: Vector3::zeros(),
            world_from_palm: palm_from_world.inverse(),
            stage: Stage::Approach,
            last_stage: Stage::Settled,
            n_steps: 0,
            next_nanos: 0,
            stage_secs: 0.0,
            n_frames_of_stage: 0,
            settled: None,
            was_touched: false,
            lifted: Vector3::zeros(),
            lift_from_m: 0.0,
            last_velocity: Vector3::zeros(),
            felt: None,
            is_lost: false,
            n_tightened: 0,
        })
    }

    /// The same with another sensor, such as one that many attempts have in common, and with its noise from `rng`.
    pub fn sensed_by(self, sensor: Sensor, rng: ChaCha8Rng) -> Self {
        Attempt { sensor, rng, ..self }
    }

    /// Goes on to the next frame; `None` after the last settled frame, after the last frame of a probe, and when a lift
    /// is over.
    pub fn next_frame(&mut self, grasp_id: u64) -> Option<TimedFrame> {
        let moment = self.next_moment()?;
        Some(self.feel(moment, grasp_id))
    }

    /// Goes on to the time of the next frame, without what cells and other sensors read.
    pub(super) fn next_moment(&mut self) -> Option<Moment> {
        let is_lift = self.stage == Stage::Lift;
        if !is_lift && self.stage == self.last_stage && self.n_frames_of_stage == self.options.protocol.n_settled {
            return None;
        }
        let offset_nanos = self.next_nanos;
        while self.elapsed_nanos() < offset_nanos {
            if self.is_lift_over() {
                return None;
            }
            self.step();
        }
        let TrialProtocol { frame_nanos, lifting_frame_nanos, .. } = self.options.protocol;
        let period_nanos = if is_lift { lifting_frame_nanos } else { frame_nanos };
        self.next_nanos += period_nanos;
        self.n_frames_of_stage += 1;
        let velocity = self.engine.target_velocity();
        let acceleration = (velocity - self.last_velocity) / (period_nanos as f64 * 1e-9);
        self.last_velocity = velocity;
        let centre = self.engine.palm_from_target() * self.target.object.centre_of_mass_m;
        Some(Moment {
            offset_nanos,
            phase: self.stage.phase(),
            joints: self.body.joints(&*self.engine),
            motors_rad: self.body.motors_rad(),
            torques: self.body.torques(&*self.engine),
            touches: self.engine.touches(),
            palm_from_target: self.engine.palm_from_target(),
            load_on_wrist: load_on_wrist(&*self.engine, self.target.object.mass_kg, &centre, &acceleration),
        })
    }

    /// What the hand feels at a moment.
    pub(super) fn feel(&mut self, moment: Moment, grasp_id: u64) -> TimedFrame {
        let hand = self.mechanism.hand;
        let motors_or_joints = if self.sensor.reads_joints { &moment.joints } else { &moment.motors_rad };
        let joints = self.sensor.read_joints(hand, motors_or_joints, &self.options.sensor);
        let cells_newtons = self.press(&moment.joints, moment.touches, &moment.palm_from_target);
        let cells_newtons = self.lag(cells_newtons, moment.offset_nanos);
        let sensor = &self.options.sensor;
        let (force, torque) = &moment.load_on_wrist;
        let gravity = self.world_from_palm.rotation.inverse() * Vector3::new(0.0, 0.0, -GRAVITY);
        let frame = TactileFrame {
            grasp_id,
            phase: moment.phase,
            joints,
            cells_newtons: self.sensor.read_cells(hand, &cells_newtons, sensor, &mut self.rng),
            senses: OwnedSenses::default()
                .with(Sense::Gravity, gravity.as_slice())
                .with(Sense::WristWrench, &read_wrench(force, torque, sensor, &mut self.rng))
                .with(Sense::JointTorques, &read_torques(&moment.torques, sensor, &mut self.rng)),
            day: 0,
        };
        TimedFrame { offset_nanos: moment.offset_nanos, frame }
    }

    /// The forces on the cells.
    fn press(&self, joints: &[f64], touches: Vec<Touch>, palm_from_target: &Isometry3<f64>) -> Vec<f64> {
        let hand = self.mechanism.hand;
        if let Some(bell) = &self.sensor.bell
            && let Ok(palm_from_links) = hand.palm_from_links(joints)
        {
            let pressures = touches.into_iter().map(|touch| Pressure {
                link_idx: touch.link_idx,
                point_m: touch.point_m,
                direction: touch.outward,
                newtons: touch.newtons,
            });
            return bell.cells_newtons(hand, &palm_from_links, pressures);
        }
        let mut cells_newtons = vec![0.0; hand.n_cells()];
        for contact in self.patches(joints, touches, palm_from_target) {
            for (cell_idx, newtons) in &contact.cells_newtons {
                cells_newtons[*cell_idx] += newtons;
            }
        }
        cells_newtons
    }

    /// What cells that lag behind their forces feel.
    fn lag(&mut self, cells_newtons: Vec<f64>, offset_nanos: u64) -> Vec<f64> {
        if self.sensor.lag_secs == 0.0 {
            return cells_newtons;
        }
        let (felt, at_nanos) = self.felt.get_or_insert_with(|| (vec![0.0; cells_newtons.len()], offset_nanos));
        let passed_secs = offset_nanos.saturating_sub(*at_nanos) as f64 * 1e-9;
        let part = 1.0 - (-passed_secs / self.sensor.lag_secs).exp();
        for (felt, newtons) in felt.iter_mut().zip(&cells_newtons) {
            *felt += part * (newtons - *felt);
        }
        *at_nanos = offset_nanos;
        felt.clone()
    }

    /// Begins a probe, whose frames follow.
    pub fn probe(&mut self, probe: ProbeMove) {
        self.was_touched = self.is_touched();
        self.last_stage = match probe {
            ProbeMove::Squeeze => Stage::Squeezed,
            ProbeMove::TestLift => Stage::TestLifted,
        };
        match (self.stage, probe) {
            (Stage::TestLifted, _) | (Stage::Squeezed, ProbeMove::Squeeze) => {}
            (Stage::Squeezed, ProbeMove::TestLift) => self.enter(Stage::TestLift),
            _ => {
                self.settled = Some(self.engine.palm_from_target());
                self.enter(Stage::Squeeze);
            }
        }
    }

    /// Goes on with another time step, seconds.
    pub(super) fn set_step(&mut self, step_secs: f64) {
        let physics = &mut self.options.physics;
        self.n_steps = (self.n_steps as f64 * physics.step_secs / step_secs).round() as u64;
        physics.step_secs = step_secs;
        self.engine.set_step(step_secs);
    }

    /// Lets the time of a frame pass that is not felt.
    pub fn skip_frame(&mut self) {
        self.next_nanos += self.options.protocol.frame_nanos;
    }

    /// Lowers the arm again after a test lift, or in the middle of a lift. Returns by how much the target's centre of mass
    /// has moved, and the target turned, in the hand since it settled: metres, radians. Both are 0 if the hand did not
    /// touch it before the test lift, which then has moved nothing.
    pub fn set_down(&mut self) -> (f64, f64) {
        let (protocol, step_secs) = (&self.options.protocol, self.options.physics.step_secs);
        let begin = self.lifted;
        let secs = protocol.test_lift_secs.max(protocol.lift_secs * begin.z / protocol.lift_m);
        let path = Path { from_m: begin.z, by_m: -begin.z, secs };
        for step in 0..(secs / step_secs).round() as u64 {
            let motion = path.motion(step as f64 * step_secs, step_secs);
            self.move_palm(motion);
            self.engine.step();
            self.n_steps += 1;
        }
        self.move_palm((Vector3::zeros(), Vector3::zeros()));
        self.lifted = Vector3::zeros();
        let Some(before) = self.settled else { return (0.0, 0.0) };
        if !self.was_touched {
            return (0.0, 0.0);
        }
        let (now, centre) = (self.engine.palm_from_target(), self.target.object.centre_of_mass_m);
        ((now * centre - before * centre).norm(), before.rotation.angle_to(&now.rotation))
    }

    /// Lifts, holds, shakes and judges. `watch` sees a snapshot at each frame's time.
    pub fn lift(&mut self, mut watch: impl FnMut(&Snapshot)) -> LiftResult {
        let steps_per_frame = self.steps_per_frame();
        self.begin_lift();
        while !self.is_lift_over() {
            self.step();
            if self.n_steps.is_multiple_of(steps_per_frame) {
                watch(&self.snapshot());
            }
        }
        self.lift_result()
    }

    /// Begins a lift, whose frames follow. A hand that no probe has tightened is tightened to its full force before.
    pub fn begin_lift(&mut self) {
        if self.settled.is_none() {
            self.probe(ProbeMove::Squeeze);
            while self.stage == Stage::Squeeze {
                self.step();
            }
            self.next_nanos = self.next_nanos.max(self.elapsed_nanos());
        }
        self.lift_from_m = self.lifted.z;
        self.last_stage = Stage::Lift;
        self.enter(Stage::Lift);
    }

    /// Tightens by a step, and holds this force from now on: where the target gives way, fingers with a gear lose it. The last of
    /// [`TIGHTEN_STEPS`] leads to the force of a lift.
    pub fn tighten(&mut self) {
        self.n_tightened = (self.n_tightened + 1).min(TIGHTEN_STEPS);
        let part = 1.0 / f64::from(TIGHTEN_STEPS + 1 - self.n_tightened);
        self.body.tighten(&*self.engine, part, &self.options.physics);
    }

    /// The outcome of a lift that is over.
    pub fn lift_result(&self) -> LiftResult {
        let end = self.engine.palm_from_target();
        let slip_m = self.slip_m();
        let held = self.is_touched()
            && !self.has_diverged()
            && stand_newtons(&*self.engine) == 0.0
            && slip_m <= self.options.protocol.lost_m;
        LiftResult { held, slip_m, turn_rad: self.settled.unwrap_or(end).rotation.angle_to(&end.rotation) }
    }

    fn is_lift_over(&self) -> bool {
        let secs = self.lift_path(&self.options.protocol).secs();
        self.stage == Stage::Lift && (self.is_lost || self.is_over(secs))
    }

    /// Whether the stage has taken so long. Sums of time steps are not exact.
    fn is_over(&self, secs: f64) -> bool {
        self.stage_secs >= secs - 0.5 * self.options.physics.step_secs
    }

    fn lift_path<'p>(&self, protocol: &'p TrialProtocol) -> LiftPath<'p> {
        LiftPath { from_m: self.lift_from_m, protocol }
    }

    /// How far the target's centre of mass has moved in the hand since it settled.
    fn slip_m(&self) -> f64 {
        let (now, centre) = (self.engine.palm_from_target(), self.target.object.centre_of_mass_m);
        self.settled.map_or(0.0, |begin| (now * centre - begin * centre).norm())
    }

    fn steps_per_frame(&self) -> u64 {
        let frame_secs = self.options.protocol.frame_nanos as f64 * 1e-9;
        (frame_secs / self.options.physics.step_secs).round().max(1.0) as u64
    }

    /// Whether the hand touches the target now.
    pub(super) fn is_touched(&self) -> bool {
        self.engine.touches().iter().any(|touch| touch.side == Side::Target)
    }

    /// Gives the palm a velocity and an acceleration, both in the world, for the next step.
    fn move_palm(&mut self, (velocity, acceleration): (Vector3<f64>, Vector3<f64>)) {
        let turn = self.world_from_palm.rotation.inverse();
        self.engine.set_palm_motion(&(turn * velocity), &(turn * acceleration));
    }

    /// The grasp now, as its wrench space sees it with a friction coefficient: every contact with the target, felt or
    /// not, in the palm frame.
    pub fn grasp_case(&self, friction: f64) -> GraspCase {
        grasp_case(&self.target.object, &self.palm_from_target(), &self.contacts(), friction)
    }

    /// Epsilon and volume of the grasp now with friction 1, as the paper labels grasps; `None` if the hull failed.
    pub fn quality(&self) -> Option<(f64, f64)> {
        quality(&self.grasp_case(1.0)).ok().map(|quality| (quality.epsilon, quality.volume))
    }

    /// The contacts of target, stand and hand with the hand now, felt or not, in the palm frame.
    pub fn contacts(&self) -> Vec<SimulatedContact> {
        self.patches(&self.joints(), self.engine.touches(), &self.engine.palm_from_target())
    }

    /// The hand's joints now, exactly, radians.
    pub fn joints(&self) -> Vec<f64> {
        self.body.joints(&*self.engine)
    }

    /// Whether the simulation has come to a state that cannot be: the hand's links swing without bounds, which happens to a
    /// few in a thousand shaken hands.
    pub fn has_diverged(&self) -> bool {
        let mut joints = self.mechanism.hand.joints.iter().zip(self.joints());
        let is_lost = !self.palm_from_target().translation.vector.iter().all(|number| number.is_finite());
        is_lost || joints.any(|(joint, value)| !joint.allows(value, MOST_BEYOND_RAD))
    }

    /// Why the physics has stopped, if it has: what the attempt says then is not to be used.
    ///
    /// # Errors
    /// The engine's process has ended or refused a step.
    pub fn check(&self) -> Result<(), TrialError> {
        self.engine.failure().map_or(Ok(()), |reason| Err(TrialError::Engine { reason }))
    }

    pub fn palm_from_target(&self) -> Isometry3<f64> {
        self.engine.palm_from_target()
    }

    pub fn snapshot(&self) -> Snapshot {
        let palm = nalgebra::Translation3::from(self.lifted)
            * self.world_from_palm
            * nalgebra::Translation3::from(self.palm_from_start);
        let target = palm * self.engine.palm_from_target();
        Snapshot {
            elapsed_nanos: self.elapsed_nanos(),
            palm_position_m: palm.translation.vector.into(),
            palm_rotation_xyzw: palm.rotation.coords.into(),
            joints: self.body.joints(&*self.engine),
            target_position_m: target.translation.vector.into(),
            target_rotation_xyzw: target.rotation.coords.into(),
        }
    }

    fn patches(&self, joints: &[f64], touches: Vec<Touch>, palm_from_target: &Isometry3<f64>) -> Vec<SimulatedContact> {
        // The joints are the hand's own: as many as it has, and finite.
        let Ok(palm_from_links) = self.mechanism.hand.palm_from_links(joints) else { return Vec::new() };
        patches(touches, palm_from_target, &self.mechanism, &palm_from_links, &self.target, &self.options.physics)
    }

    fn elapsed_nanos(&self) -> u64 {
        (self.n_steps as f64 * self.options.physics.step_secs * 1e9).round() as u64
    }

    /// A time step.
    fn step(&mut self) {
        let physics = self.options.physics.clone();
        let protocol = self.options.protocol.clone();
        self.act(&physics, &protocol);
        self.engine.step();
        self.n_steps += 1;
        self.stage_secs += physics.step_secs;
        self.change_stage(&physics, &protocol);
    }

    /// What arm and fingers do in the next time step.
    fn act(&mut self, physics: &PhysicsOptions, protocol: &TrialProtocol) {
        if self.stage == Stage::TestLift {
            let path = TestLiftPath(protocol);
            self.move_palm(path.motion(self.stage_secs, physics.step_secs));
            self.lifted = path.place_m(self.stage_secs + physics.step_secs);
        }
        if self.stage == Stage::Lift {
            let path = self.lift_path(protocol);
            let secs = self.stage_secs;
            let (motion, lifted) = (path.motion(secs, physics.step_secs), path.place_m(secs + physics.step_secs));
            self.move_palm(motion);
            self.lifted = lifted;
            if self.n_tightened > 0 {
                self.body.hold_force(&mut *self.engine, physics);
            }
        }
        if self.stage == Stage::Squeeze {
            let part = ((self.stage_secs + physics.step_secs) / protocol.grip_secs).min(1.0);
            self.body.grip(&mut *self.engine, part, physics);
        }
    }

    /// Goes on to the next stage where this one is over.
    fn change_stage(&mut self, physics: &PhysicsOptions, protocol: &TrialProtocol) {
        match self.stage {
            Stage::Approach => {
                self.palm_from_start.z += protocol.approach_speed * physics.step_secs;
                let mut newtons = 0.0;
                for touch in self.engine.touches() {
                    if !matches!(touch.side, Side::Hand { .. }) {
                        newtons += touch.newtons;
                    }
                }
                if newtons >= protocol.touch_newtons || self.palm_from_start.z >= protocol.stand_off_m + OVERSHOOT_M {
                    self.engine.stop_palm(&Vector3::new(0.0, 0.0, protocol.approach_speed));
                    self.enter(Stage::Close);
                }
            }
            Stage::Close => {
                let has_stopped = self.body.close(&mut *self.engine, physics);
                if has_stopped || self.stage_secs >= MOST_CLOSING_SECS {
                    self.body.stop(&mut *self.engine, physics);
                    self.enter(Stage::Settle);
                }
            }
            Stage::Settle if self.is_over(protocol.settle_secs) => self.enter(Stage::Settled),
            Stage::Squeeze if self.is_over(protocol.grip_secs) => self.enter(Stage::Squeezed),
            Stage::Squeezed if self.last_stage != Stage::Squeezed && self.n_frames_of_stage == protocol.n_settled => {
                self.enter(Stage::TestLift);
            }
            Stage::Lift if self.n_steps.is_multiple_of(self.steps_per_frame()) => {
                self.is_lost = self.slip_m() > protocol.lost_m;
            }
            Stage::TestLift if self.is_over(TestLiftPath(protocol).secs() + protocol.test_rest_secs) => {
                self.enter(Stage::TestLifted);
            }
            _ => {}
        }
    }

    fn enter(&mut self, stage: Stage) {
        self.stage = stage;
        self.stage_secs = 0.0;
        self.n_frames_of_stage = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::choose_start;
    use crate::trial::targets::targets_named;

    fn barrett() -> Hand {
        Hand::load(std::path::Path::new("barrett-bh8-280")).expect("built in")
    }

    fn cup(friction: f64) -> LiftTarget {
        targets_named(&format!("paper/pencil-cup@mu{friction}")).expect("a cup").remove(0)
    }

    /// A hand that has closed around a target on a post, where it finds room.
    fn closed<'a>(hand: &'a Hand, target: &LiftTarget) -> Attempt<'a> {
        let mut options = TrialOptions::default();
        options.physics.stand_radius_m = 0.04;
        let start = choose_start(hand, target, &options, None, 3, 0, 0).expect("a start");
        let mut attempt = Attempt::begin(hand, target, &options, &start, 0).expect("an attempt");
        while attempt.next_frame(0).is_some() {}
        attempt
    }

    /// The result of lifting a cup with this friction, and the last snapshot.
    fn lifted(friction: f64) -> (LiftResult, Snapshot) {
        let hand = barrett();
        let mut attempt = closed(&hand, &cup(friction));
        let mut last = attempt.snapshot();
        (attempt.lift(|snapshot| last = snapshot.clone()), last)
    }

    #[test]
    fn what_slips_out_of_the_hand_is_dropped_and_what_stays_is_held() {
        let (held, seen) = lifted(1.0);
        assert!(held.held && held.slip_m < 0.02, "{held:?}");
        assert!(seen.target_position_m[2] > 0.15, "it is up: {seen:?}");
        let (dropped, seen) = lifted(0.01);
        assert!(!dropped.held && dropped.slip_m > 0.05, "{dropped:?}");
        assert!(seen.target_position_m[2] < seen.palm_position_m[2], "{seen:?}");
    }

    #[test]
    fn a_test_lift_lets_the_weight_arrive_and_the_lift_goes_on_from_there() {
        let (hand, target) = (barrett(), cup(1.0));
        let closed = || closed(&hand, &target);
        let mut attempt = closed();
        attempt.probe(ProbeMove::TestLift);
        let frames: Vec<TimedFrame> = std::iter::from_fn(|| attempt.next_frame(0)).collect();
        assert!(frames.windows(2).all(|pair| pair[1].offset_nanos - pair[0].offset_nanos == 10_000_000));
        let mut phases: Vec<Phase> = frames.iter().map(|timed| timed.frame.phase).collect();
        phases.dedup();
        assert_eq!(phases, [Phase::Squeezing, Phase::Squeezed, Phase::TestLifting, Phase::TestLifted]);
        let n_of = |phase| frames.iter().filter(|timed| timed.frame.phase == phase).count();
        assert_eq!((n_of(Phase::Squeezed), n_of(Phase::TestLifted)), (6, 6));
        // What hangs on the wrist is the cup's weight, within a few times the sensor's noise.
        let last = &frames[frames.len() - 1].frame;
        let (wrench, gravity) = (last.senses.get(Sense::WristWrench), last.senses.get(Sense::Gravity));
        let borne: f64 = wrench.iter().zip(gravity).map(|(f, g)| f * g / GRAVITY).sum();
        let weight = target.object.mass_kg * GRAVITY;
        assert!((borne - weight).abs() < 0.5, "{borne} N of {weight} N");
        assert!((attempt.snapshot().palm_position_m[2] - closed().snapshot().palm_position_m[2] - 0.01).abs() < 1e-9);
        let mut highest: f64 = 0.0;
        let lift = attempt.lift(|snapshot| highest = highest.max(snapshot.target_position_m[2]));
        assert!(lift.held && highest > 0.15, "{lift:?}, {highest} m");

        let mut attempt = closed();
        attempt.probe(ProbeMove::TestLift);
        while attempt.next_frame(0).is_some() {}
        let (moved_m, turned_rad) = attempt.set_down();
        assert!(moved_m < 0.01 && turned_rad < 0.2, "{moved_m} m, {turned_rad} rad");
        let mut attempt = closed();
        attempt.probe(ProbeMove::Squeeze);
        let frames: Vec<TimedFrame> = std::iter::from_fn(|| attempt.next_frame(0)).collect();
        assert_eq!(frames.last().map(|timed| timed.frame.phase), Some(Phase::Squeezed));
        assert_eq!(attempt.snapshot().palm_position_m, closed().snapshot().palm_position_m);
    }
}
