//! Labels a simulated grasp by a lift: the object stands, the hand comes, closes, lifts and shakes in the physics of
//! trials. The frames are those before the lift and, fewer a second, while the arm lifts.
//!
//! Epsilon and volume are those of the settled grasp with friction 1, so that the paper's label can be compared with the
//! lift.

use std::collections::BTreeSet;

use nalgebra::Vector3;
use rand::RngExt;

use super::attempt::Moment;
use super::{
    Attempt, LiftTarget, MujocoOptions, PhysicsOptions, ProbeMove, TrialError, TrialOptions, TrialProtocol,
    choose_start,
};
use crate::candidate::{CandidateError, Judged, Made, Outcome, SimulatedGrasp, TimedFrame, candidate_rng};
use crate::loaded_contacts::SimulatedContact;
use crate::mechanism::Mechanism;
use crate::options::{FrameOptions, LiftOptions, SimulatorOptions};
use crate::tactile_sensor::Sensor;
use crate::wrench_space::{QualityError, quality};
use blindgrasp_messages::{GraspScene, GraspTruth, Phase};
use blindgrasp_objects::Object;

/// How much harder contacts that creep resist slipping than pressing: a usual setting of MuJoCo for grasps.
const CREEPING_IMPRATIO: f64 = 100.0;

/// Friction of the paper's label, whatever the friction in the physics.
const LABEL_FRICTION: f64 = 1.0;

/// Draws and lifts candidate number `candidate`: a pure function of it and the options' seed. Its object is that of the
/// same candidate with the other label.
pub(crate) fn try_candidate(
    mechanism: &Mechanism<'_>,
    objects: &[Object],
    options: &SimulatorOptions,
    candidate: u64,
) -> Result<Outcome, CandidateError> {
    let hand = mechanism.hand;
    let mut rng = candidate_rng(options.seed, candidate, 0);
    let object_idx = rng.random_range(0..objects.len());
    let target = varied(&objects[object_idx], options, &mut rng);
    let start_seed = rng.random();
    let trial_options = trial_options(options, &mut rng);
    // As in a trial, every second attempt comes straight down.
    let begun = choose_start(hand, &target, &trial_options, None, start_seed, 0, (candidate % 2) as u32)
        .and_then(|start| Attempt::begin(hand, &target, &trial_options, &start, 0));
    let attempt = match begun {
        Ok(attempt) => attempt,
        Err(TrialError::NoApproach { .. }) => return Ok(Outcome::NoTouch),
        Err(source) => return Err(CandidateError::Lift { candidate, source: source.into() }),
    };
    let mut rng = candidate_rng(options.seed, candidate, 1);
    let sensor = Sensor::draw(hand, &options.sensor, options.seed, &mut rng);
    let mut attempt = attempt.sensed_by(sensor, rng);
    let mut frames = settled_frames(&mut attempt, &options.frames);
    let contacts = attempt.contacts();
    let is_empty = !contacts.iter().any(|contact| contact.of_object);
    let quality = match quality(&attempt.grasp_case(LABEL_FRICTION)) {
        Ok(quality) => quality,
        Err(QualityError::Hull { .. }) => return Ok(Outcome::HullFailure),
        Err(source) => return Err(CandidateError::Quality { candidate, source }),
    };
    let scene = scene(&attempt, &target, candidate, &contacts);
    attempt.probe(ProbeMove::TestLift);
    frames.extend(std::iter::from_fn(|| attempt.next_frame(0)));
    if let Some(step_secs) = options.lift.lift_step_secs {
        attempt.set_step(step_secs);
    }
    // A hand that has touched nothing lifts nothing.
    if !is_empty {
        attempt.begin_lift();
        frames.extend(std::iter::from_fn(|| attempt.next_frame(0)));
    }
    let is_stable = !is_empty && attempt.lift_result().held;
    set_times(&mut frames, options.frames.period_nanos, trial_options.protocol.lifting_frame_nanos);
    attempt.check().map_err(|source| CandidateError::Lift { candidate, source: source.into() })?;
    if attempt.has_diverged() {
        return Ok(Outcome::Diverged);
    }
    let truth = GraspTruth {
        epsilon: quality.epsilon,
        volume: quality.volume,
        stable: is_stable,
        object: target.object.name,
        object_class: target.object.class,
        ..GraspTruth::default()
    };
    let grasp = SimulatedGrasp { frames, truth, scene };
    Ok(Outcome::Judged(Box::new(Judged { object_idx, is_stable, quality, made: Made::Lifted(grasp) })))
}

/// Goes on to the settled hand. The forces on cells take as long to compute as a time step, so they are computed for the frames
/// that are kept alone.
fn settled_frames(attempt: &mut Attempt<'_>, options: &FrameOptions) -> Vec<TimedFrame> {
    let moments: Vec<Moment> = std::iter::from_fn(|| attempt.next_moment()).collect();
    let kept = kept(&moments.iter().map(|moment| moment.phase).collect::<Vec<_>>(), options);
    let moments = moments.into_iter().enumerate().filter(|(idx, _)| kept.contains(idx));
    moments.map(|(_, moment)| attempt.feel(moment, 0)).collect()
}

/// Gives frames times that leave no room for the frames that are left out.
fn set_times(frames: &mut [TimedFrame], period_nanos: u64, lifting_period_nanos: u64) {
    let mut next_nanos = 0;
    for timed in frames {
        timed.offset_nanos = next_nanos;
        next_nanos += if timed.frame.phase == Phase::Lifting { lifting_period_nanos } else { period_nanos };
    }
}

/// The object as it is in one lift.
fn varied(object: &Object, options: &SimulatorOptions, rng: &mut impl rand::Rng) -> LiftTarget {
    let LiftOptions { friction_factor, mass_factor, centre_shift_m, .. } = &options.lift;
    let friction = options.friction * between(*friction_factor, rng);
    let mut object = object.clone();
    object.mass_kg *= between(mass_factor.map(f64::ln), rng).exp();
    let shift = Vector3::from_fn(|_, _| between([-1.0, 1.0], rng) * centre_shift_m);
    if shift.norm() <= *centre_shift_m {
        object.centre_of_mass_m += shift;
    }
    LiftTarget::new(object, friction)
}

fn between([low, high]: [f64; 2], rng: &mut impl rand::Rng) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// A factor from a range, its logarithm uniform.
fn factor([low, high]: [f64; 2], rng: &mut impl rand::Rng) -> f64 {
    (low.ln() + (high / low).ln() * rng.random::<f64>()).exp()
}

/// The options of the physics in one lift: the simulator's where it has them, drawn from its ranges; defaults elsewhere.
fn trial_options(options: &SimulatorOptions, rng: &mut impl rand::Rng) -> TrialOptions {
    let LiftOptions { stand_radius_m, force_factor, speed_factor, rubber_factor, contact_factor, gear_factor, .. } =
        options.lift;
    let default = PhysicsOptions::default();
    let stand_radius_m = factor(stand_radius_m, rng);
    let (force, speed) = (factor(force_factor, rng), factor(speed_factor, rng));
    let (rubber, contact, gear) = (factor(rubber_factor, rng), factor(contact_factor, rng), factor(gear_factor, rng));
    let creeps = rng.random::<f64>() < options.lift.creep_share;
    let mut soft_finger = options.soft_finger.clone();
    soft_finger.youngs_modulus_pa *= rubber;
    TrialOptions {
        planner: options.planner.clone(),
        protocol: TrialProtocol {
            approach: options.protocol.approach,
            preshape_range: options.protocol.preshape_range,
            lateral_offset_m: options.protocol.lateral_offset_m,
            frame_nanos: options.frames.period_nanos,
            n_settled: options.frames.n_settled,
            test_lift_m: options.lift.test_lift_m,
            test_shake_m: options.lift.test_shake_m,
            ..TrialProtocol::default()
        },
        physics: PhysicsOptions {
            engine: options.lift.engine,
            stand_radius_m,
            grip_newtons: force * options.soft_finger.normal_force_newtons,
            lift_grip_newtons: force * default.lift_grip_newtons,
            closing_rad_per_sec: speed * default.closing_rad_per_sec,
            contact_hertz: contact * default.contact_hertz,
            gear_stiffness: gear * default.gear_stiffness,
            contacts: options.contacts.clone(),
            soft_finger,
            step_secs: options.lift.step_secs,
            mujoco: MujocoOptions {
                // Without the iterations, the ratio alone keeps contacts from creeping.
                noslip_iterations: if creeps { 0 } else { default.mujoco.noslip_iterations },
                impratio: if creeps { CREEPING_IMPRATIO } else { default.mujoco.impratio },
                contact_secs: default.mujoco.contact_secs / contact,
                ..default.mujoco
            },
            ..default
        },
        sensor: options.sensor.clone(),
    }
}

/// The settled grasp, without the contacts of the stand.
fn scene(attempt: &Attempt<'_>, target: &LiftTarget, candidate: u64, contacts: &[SimulatedContact]) -> GraspScene {
    let palm_from_object = attempt.palm_from_target();
    GraspScene {
        grasp_id: 0,
        candidate,
        object_position_m: palm_from_object.translation.vector.into(),
        object_rotation_xyzw: palm_from_object.rotation.coords.into(),
        centre_of_mass_m: (palm_from_object * target.object.centre_of_mass_m).into(),
        max_radius_m: target.object.max_radius_m,
        mass_kg: target.object.mass_kg,
        friction: target.friction,
        joints: attempt.joints(),
        self_collision: contacts.iter().any(|contact| contact.point.other.is_some()),
        contacts: contacts
            .iter()
            .filter(|contact| contact.of_object || contact.point.other.is_some())
            .map(SimulatedContact::to_scene)
            .collect(),
    }
}

/// The indices of the frames that are kept: the first ones before the touch, evenly spaced ones of the closing, and all from the
/// settled hand on.
fn kept(phases: &[Phase], options: &FrameOptions) -> BTreeSet<usize> {
    let n_open = phases.iter().filter(|phase| **phase == Phase::Open).count();
    let n_closing = phases.iter().filter(|phase| **phase == Phase::Closing).count();
    let closing = (1..=options.n_closing).map(|mark| n_open + mark * n_closing / (options.n_closing + 1));
    let settled = n_open + n_closing..phases.len();
    (0..n_open.min(options.n_open)).chain(closing).chain(settled).collect()
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::path::Path;

    use super::*;
    use crate::simulator::tests::{check_same, simulated};
    use crate::simulator::{SimulateError, simulate_all};
    use crate::wrench_space::GraspCase;
    use blindgrasp_objects::select;
    use blindgrasp_stages::hand::Hand;
    use blindgrasp_stages::label::Label;

    fn lifts(n_grasps: usize) -> SimulatorOptions {
        SimulatorOptions { n_grasps, seed: 2, label: Label::Lift, stable_fraction: None, ..SimulatorOptions::default() }
    }

    #[test]
    fn lifted_grasps_are_the_same_with_any_number_of_threads_and_have_a_simulated_ones_shape() {
        let objects = select("ball-01,box-03").expect("objects");
        let (one, report) = simulated(&objects, &lifts(2), 1);
        let (two, report_of_two) = simulated(&objects, &lifts(2), 2);
        assert_eq!(report, report_of_two);
        check_same(&one, &two);
        assert_eq!((report.label, report.n_grasps), (Label::Lift, 2));
        for (grasp_id, grasp) in one.iter().enumerate() {
            let phases: Vec<_> = grasp.frames.iter().map(|timed| timed.frame.phase).collect();
            let expected = [vec![Phase::Open; 2], vec![Phase::Closing; 6], vec![Phase::Settled; 6]].concat();
            assert_eq!(phases[..expected.len()], expected);
            let n_of = |wanted: Phase| phases.iter().filter(|phase| **phase == wanted).count();
            assert_eq!((n_of(Phase::Squeezed), n_of(Phase::TestLifted)), (6, 6), "the test lift follows");
            let n_before = phases.len() - n_of(Phase::Lifting);
            assert!(phases[n_before..].iter().all(|phase| *phase == Phase::Lifting), "then the lift");
            for (idx, timed) in grasp.frames.iter().enumerate() {
                let offset_nanos = 10_000_000 * idx.min(n_before) + 50_000_000 * idx.saturating_sub(n_before);
                assert_eq!((timed.offset_nanos, timed.frame.grasp_id), (offset_nanos as u64, grasp_id as u64));
            }
            assert_eq!((grasp.truth.grasp_id, grasp.scene.grasp_id), (grasp_id as u64, grasp_id as u64));
            // The scene is the settled grasp: its quality is the truth's, and what cells feel is in the last frame.
            let again = quality(&GraspCase::from(&grasp.scene)).expect("a hull");
            assert_eq!((again.epsilon, again.volume), (grasp.truth.epsilon, grasp.truth.volume));
            assert!(grasp.scene.contacts.iter().any(|contact| contact.other_link < 0));
        }
    }

    #[test]
    fn another_time_step_of_the_lift_leaves_all_before_it_as_it_was() {
        let with = |step_secs: f64, lift_step_secs: Option<f64>| {
            let mut options = lifts(1);
            (options.lift.step_secs, options.lift.lift_step_secs) = (step_secs, lift_step_secs);
            let mut grasp = simulated(&select("ball-01,box-03").expect("objects"), &options, 1).0.remove(0);
            let n_before = grasp.frames.iter().position(|timed| timed.frame.phase == Phase::Lifting).expect("it lifts");
            grasp.frames.truncate(n_before);
            grasp
        };
        let (usual, other_lift, other) = (with(0.005, None), with(0.005, Some(0.0025)), with(0.0025, None));
        assert_eq!((&usual.frames, &usual.scene), (&other_lift.frames, &other_lift.scene));
        assert_ne!(usual.frames, other.frames);
    }

    #[test]
    fn frames_are_thinned_to_what_was_asked_for_or_what_there_is() {
        let phases = [(Phase::Open, 4), (Phase::Closing, 9), (Phase::Settled, 2)];
        let phases: Vec<Phase> = phases.iter().flat_map(|(phase, n)| vec![*phase; *n]).collect();
        let thinned_to = |n_open: usize, n_closing: usize| -> Vec<usize> {
            let options = FrameOptions { n_open, n_closing, n_settled: 2, period_nanos: 5 };
            kept(&phases, &options).into_iter().collect()
        };
        assert_eq!(thinned_to(2, 2), [0, 1, 7, 10, 13, 14]);
        assert_eq!(thinned_to(0, 0), [13, 14]);
        assert_eq!(thinned_to(100, 100), (0..15).collect::<Vec<_>>());
    }

    #[test]
    fn what_physics_cannot_do_is_refused() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let objects = select("ball-01").expect("an object");
        type Change = fn(&mut SimulatorOptions);
        let cases: [(Change, &str); 8] = [
            (|options| options.frames.period_nanos = 1, "frames.period_nanos is 1, expected 1e6 to 1e8"),
            (|options| options.protocol.back_off_m = 0.01, "protocol.back_off_m is 0.01, expected its default"),
            (|options| options.planner.stand_off_m = 0.01, "planner.stand_off_m is 0.01, expected its default"),
            (|options| options.thresholds.epsilon = 0.03, "thresholds is set, expected its default with label lift"),
            (|options| options.lift.mass_factor = [2.0, 0.5], "lift.mass_factor is [2, 0.5], expected two ascending"),
            (|options| options.lift.test_lift_m = 0.3, "lift.test_lift_m is 0.3, expected more than 0"),
            (|options| options.lift.lift_step_secs = Some(0.0), "lift.lift_step_secs is 0, expected more than 0"),
            (
                |options| (options.lift.mass_factor, options.label) = ([0.5, 2.0], Label::WrenchSpace),
                "lift is set, expected its default without label lift",
            ),
        ];
        for (change, expected) in cases {
            let mut options = SimulatorOptions { label: Label::Lift, ..SimulatorOptions::default() };
            change(&mut options);
            let refused = simulate_all(&hand, &objects, &options, |_| Ok::<_, Infallible>(()));
            let Err(SimulateError::Option(error)) = refused else { panic!("{expected}: {refused:?}") };
            assert!(error.to_string().starts_with(&format!("option {expected}")), "{error}");
        }
    }

    #[test]
    fn options_from_before_there_were_labels_read_and_write_the_same() {
        let text = serde_json::to_string(&SimulatorOptions::default()).expect("written");
        assert!(!text.contains("label"), "{text}");
        assert_eq!(serde_json::from_str::<SimulatorOptions>(&text).expect("read").label, Label::WrenchSpace);
        let lift = SimulatorOptions { label: Label::Lift, ..SimulatorOptions::default() };
        let text = serde_json::to_string(&lift).expect("written");
        assert!(text.contains(r#""label":"lift""#), "{text}");
        assert_eq!(serde_json::from_str::<SimulatorOptions>(&text).expect("read"), lift);
    }
}
