//! Where attempts come from: straight down, as deep as the fingers can close over the stand, or from any direction from
//! above from which the stand lets the open hand through.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use parry3d_f64::query::distance;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::rest;
use super::world::{stand_shape, world_from_stand};
use super::{LiftTarget, PhysicsOptions, Start, TrialError, TrialOptions};
use crate::mechanism::Mechanism;
use crate::planner::{Approaches, energy};
use crate::protocol::{self, Approach, ProtocolOptions};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::{Hand, pose_from_isometry};

/// Most approaches that are drawn before the target is given up. Most approaches are possible.
const MOST_DRAWS: usize = 1000;

/// Most approaches straight down that are drawn. Over a flat target each of them fails, over most other targets one of the first few
/// does not.
const MOST_DRAWS_STRAIGHT_DOWN: usize = 200;

/// Least descent of an approach straight down, from level: 10° from the vertical, so that all fingertips come to the stand.
const STRAIGHT_DOWN_RAD: f64 = 1.4;

/// Postures of closing fingers that are measured: 50 mrad apart on a Barrett hand.
const N_POSTURES: u32 = 50;

/// Fingertips that stop over the stand must be able to close on the target this much higher as well. They slide over what
/// they just reach: without this, no training object of up to 27 mm was lifted, and all of 34 to 58 mm were.
const LEAST_BESIDE_M: f64 = 0.015;

/// Beside the attempts' own: no trial has so many.
const TARGET_STREAM: u64 = (1 << 20) - 1;

/// Draws attempt number `attempt` of trial number `trial`, or, with a prior, several of them, of which it takes the one whose
/// lift is most probably kept. Every second blind attempt, from the first on, comes straight down, and the others from
/// anywhere; all come the one way where the other leads nowhere. A pure function of the arguments.
///
/// # Errors
/// A hand that cannot be simulated, or a target that it never comes to.
pub fn choose_start(
    hand: &Hand,
    target: &LiftTarget,
    options: &TrialOptions,
    prior: Option<&ApproachPrior>,
    seed: u64,
    trial: u64,
    attempt: u32,
) -> Result<Start, TrialError> {
    let draws = Draws::new(hand, target, options, seed, trial);
    let n_draws = if prior.is_some() { options.protocol.n_approaches } else { 1 };
    let mut best: Option<(f64, Start)> = None;
    for number in 0..n_draws {
        // Attempts have 16 bits.
        let Some(start) = draws.in_turn(attempt | number << 16)? else { continue };
        let probability = prior.map_or(1.0, |prior| probability_kept(prior, &start));
        if best.as_ref().is_none_or(|(most, _)| probability > *most) {
            best = Some((probability, start));
        }
    }
    best.map(|(_, start)| start).ok_or_else(|| TrialError::NoApproach { target: target.object.name.clone() })
}

/// The attempts of a trial.
struct Draws<'a> {
    mechanism: Mechanism<'a>,
    target: &'a LiftTarget,
    options: &'a TrialOptions,
    /// What blind starts are drawn from.
    range: ProtocolOptions,
    seed: u64,
    trial: u64,
    yaw_rad: f64,
}

/// Draws an attempt; `None` if the target is not reached this way.
type Way<'a> = fn(&Draws<'a>, u32) -> Result<Option<Start>, TrialError>;

impl<'a> Draws<'a> {
    fn new(hand: &'a Hand, target: &'a LiftTarget, options: &'a TrialOptions, seed: u64, trial: u64) -> Self {
        let range = ProtocolOptions {
            preshape_range: options.protocol.preshape_range,
            lateral_offset_m: options.protocol.lateral_offset_m,
            ..ProtocolOptions::default()
        };
        // The target stands as it stood for all attempts of a trial.
        let yaw_rad = std::f64::consts::TAU * stream(seed, trial << 20 | TARGET_STREAM).random::<f64>();
        Draws { mechanism: Mechanism::new(hand), target, options, range, seed, trial, yaw_rad }
    }

    fn rng(&self, attempt: u32) -> ChaCha8Rng {
        stream(self.seed, self.trial << 20 | u64::from(attempt))
    }

    fn in_turn(&self, attempt: u32) -> Result<Option<Start>, TrialError> {
        if self.options.protocol.approach == Approach::Planned {
            return self.planned(attempt);
        }
        let (first, other): (Way<'a>, Way<'a>) = (Self::straight_down, Self::anywhere);
        let (first, other) = if attempt.is_multiple_of(2) { (first, other) } else { (other, first) };
        match first(self, attempt)? {
            None => other(self, attempt),
            found => Ok(found),
        }
    }

    /// Approaches on which the open hand would come to the stand before it touches the target are drawn again: where the stand
    /// is, the arm knows.
    fn anywhere(&self, attempt: u32) -> Result<Option<Start>, TrialError> {
        let mut rng = self.rng(attempt);
        for _ in 0..MOST_DRAWS {
            let start = self.random_start(self.options.protocol.least_descent_rad, &mut rng);
            if self.first_touch_off_the_stand(&start)?.is_some() {
                return Ok(Some(start));
            }
        }
        Ok(None)
    }

    /// The first touch, unless the open hand comes to the stand before.
    fn first_touch_off_the_stand(&self, start: &Start) -> Result<Option<FirstTouch>, TrialError> {
        let Some(touch) = first_touch(&self.mechanism, self.target, start)? else { return Ok(None) };
        let distance_m = stand_distance_m(&self.mechanism, start, &touch.palm_from_world, &self.options.physics)?;
        Ok((distance_m >= self.options.protocol.stand_clearance_m).then_some(touch))
    }

    /// An attempt straight down stops, before it touches if need be, where its fingers can close without coming to the stand.
    /// Attempts whose fingers would close over the target or beside it are drawn again.
    fn straight_down(&self, attempt: u32) -> Result<Option<Start>, TrialError> {
        let mut rng = self.rng(attempt);
        let (mechanism, target, range, protocol) = (&self.mechanism, self.target, &self.range, &self.options.protocol);
        let refuse = |error| TrialError::hand(mechanism.hand, error);
        let least_descent_rad = protocol.least_descent_rad.max(STRAIGHT_DOWN_RAD);
        let top_m = target.hull.compute_aabb(&pose_from_isometry(&world_from_standing(target, self.yaw_rad))).maxs.z;
        for _ in 0..MOST_DRAWS_STRAIGHT_DOWN {
            let mut start = self.random_start(least_descent_rad, &mut rng);
            let Some(touch) = first_touch(mechanism, target, &start)? else { continue };
            let world_from_palm = touch.palm_from_world.inverse();
            let lowest_m = lowest_while_closing_m(mechanism, &start, &world_from_palm)?;
            let descent = -(world_from_palm * Vector3::z()).z;
            start.back_off_m = ((protocol.stand_clearance_m - lowest_m) / descent).max(0.0);
            let mut away_m = start.back_off_m;
            if away_m > 0.0 {
                away_m += LEAST_BESIDE_M;
                // All of the closing hand stays so high.
                if top_m + range.touch_tolerance_m < protocol.stand_clearance_m + LEAST_BESIDE_M * descent {
                    continue;
                }
            }
            let palm_from_target = Isometry3::translation(0.0, 0.0, away_m) * touch.palm_from_target;
            let closed = mechanism
                .close_from(&target.object, palm_from_target, start.open_joints.clone(), range)
                .map_err(refuse)?;
            let posture = closed.posture(closed.end);
            let is_apart = mechanism
                .is_apart(&target.object, &closed.palm_from_object, &posture, range.touch_tolerance_m)
                .map_err(refuse)?;
            if !is_apart {
                return Ok(Some(start));
            }
        }
        Ok(None)
    }

    /// A blind start that descends at least so steeply.
    fn random_start(&self, least_descent_rad: f64, rng: &mut ChaCha8Rng) -> Start {
        let drawn = protocol::draw_start(self.mechanism.hand, &self.range, rng);
        let turn = std::f64::consts::TAU * rng.random::<f64>();
        let roll = std::f64::consts::TAU * rng.random::<f64>();
        let least = least_descent_rad.sin();
        let descent_rad = (least + (1.0 - least) * rng.random::<f64>()).asin();
        // From level along x: about y down, about z around, about its own axis rolled.
        let level = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::FRAC_PI_2);
        let down = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), descent_rad);
        let around = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
        let rolled = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll);
        let world_from_palm = around * down * level * rolled;
        Start {
            world_from_palm_xyzw: world_from_palm.coords.into(),
            lateral_offset_m: drawn.lateral_offset_m,
            open_joints: drawn.open_joints,
            yaw_rad: self.yaw_rad,
            back_off_m: 0.0,
        }
    }

    /// The planned approach of least energy of those that come from above and pass the stand. The planner's energy is that of
    /// the hand closed on an object that stays where it is.
    fn planned(&self, attempt: u32) -> Result<Option<Start>, TrialError> {
        let mut rng = self.rng(attempt);
        let (mechanism, target, range) = (&self.mechanism, self.target, &self.range);
        let (protocol, planner) = (&self.options.protocol, &self.options.planner);
        let world_from_target = world_from_standing(target, self.yaw_rad);
        let approaches = Approaches::new(mechanism.hand, &target.object, range, planner);
        let mut best: Option<(f64, Start)> = None;
        let mut n_found = 0;
        for _ in 0..MOST_DRAWS.max(8 * planner.n_approaches) {
            let drawn = approaches.draw(&mut rng);
            let world_from_palm = world_from_target.rotation * drawn.palm_from_object_rotation.inverse();
            if -(world_from_palm * Vector3::z()).z < protocol.least_descent_rad.sin() {
                continue;
            }
            let start = Start {
                world_from_palm_xyzw: world_from_palm.coords.into(),
                lateral_offset_m: drawn.lateral_offset_m,
                open_joints: drawn.open_joints.clone(),
                yaw_rad: self.yaw_rad,
                back_off_m: 0.0,
            };
            let Some(touch) = self.first_touch_off_the_stand(&start)? else { continue };
            let explored =
                mechanism.close_from(&target.object, touch.palm_from_target, start.open_joints.clone(), range);
            let exploration = explored.map_err(|error| TrialError::hand(mechanism.hand, error))?;
            let energy = energy(mechanism.hand, &target.object, &exploration, planner);
            let energy = energy.map_err(|error| TrialError::hand(mechanism.hand, error))?;
            if best.as_ref().is_none_or(|(least, _)| energy < *least) {
                best = Some((energy, start));
            }
            n_found += 1;
            if n_found == planner.n_approaches {
                break;
            }
        }
        Ok(best.map(|(_, start)| start))
    }
}

/// The lowest height over the stand to which a hand comes whose fingers close over nothing.
fn lowest_while_closing_m(
    mechanism: &Mechanism<'_>,
    start: &Start,
    world_from_palm: &Isometry3<f64>,
) -> Result<f64, TrialError> {
    let end = mechanism.joints.iter().map(|joint| joint.end).fold(0.0, f64::max);
    let mut lowest_m = f64::INFINITY;
    for step in 0..=N_POSTURES {
        let progress = end * f64::from(step) / f64::from(N_POSTURES);
        let posture = protocol::posture(&start.open_joints, &mechanism.joints, progress);
        let palm_from_links =
            mechanism.hand.palm_from_links(&posture).map_err(|error| TrialError::hand(mechanism.hand, error))?;
        for shape in &mechanism.shapes {
            let world_from_shape = world_from_palm * palm_from_links[shape.link_idx] * shape.link_from_shape;
            let core = shape.core.compute_aabb(&pose_from_isometry(&world_from_shape));
            lowest_m = lowest_m.min(core.mins.z - shape.edge_radius_m);
        }
    }
    Ok(lowest_m)
}

fn probability_kept(prior: &ApproachPrior, start: &Start) -> f64 {
    let world_from_palm = UnitQuaternion::from_quaternion(nalgebra::Quaternion::from(start.world_from_palm_xyzw));
    let down = world_from_palm.inverse() * -Vector3::z();
    prior.probability_kept(down.into(), &start.open_joints).unwrap_or(0.0)
}

/// The seed of the sensor's noise in attempt number `attempt` of trial number `trial`: a pure function of them and the
/// seed.
pub fn sensor_seed(seed: u64, trial: u64, attempt: u32) -> u64 {
    // Beside the streams that attempts are drawn from.
    stream(seed, 1 << 63 | trial << 20 | u64::from(attempt)).random()
}

fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    rng
}

/// Where everything is when the open hand first touches.
pub(super) struct FirstTouch {
    palm_from_target: Isometry3<f64>,
    pub(super) palm_from_world: Isometry3<f64>,
    pub(super) world_from_target: Isometry3<f64>,
}

/// The first touch; `None` if the hand passes by the target, or the open hand touches itself.
pub(super) fn first_touch(
    mechanism: &Mechanism<'_>,
    target: &LiftTarget,
    start: &Start,
) -> Result<Option<FirstTouch>, TrialError> {
    let world_from_target = world_from_standing(target, start.yaw_rad);
    let world_from_palm = UnitQuaternion::from_quaternion(nalgebra::Quaternion::from(start.world_from_palm_xyzw));
    let from = protocol::Start {
        open_joints: start.open_joints.clone(),
        palm_from_object_rotation: world_from_palm.inverse() * world_from_target.rotation,
        lateral_offset_m: start.lateral_offset_m,
        back_off_m: 0.0,
    };
    if mechanism.hand.self_collides(&start.open_joints).map_err(|error| TrialError::hand(mechanism.hand, error))? {
        return Ok(None);
    }
    let palm_from_target = mechanism
        .approach(&target.object, &from, &ProtocolOptions::default())
        .map_err(|error| TrialError::hand(mechanism.hand, error))?;
    Ok(palm_from_target.map(|palm_from_target| FirstTouch {
        palm_from_target,
        palm_from_world: palm_from_target * world_from_target.inverse(),
        world_from_target,
    }))
}

/// How a target stands: its lowest point on the stand, its centre of mass over the stand's axis, turned about the vertical.
pub(super) fn world_from_standing(target: &LiftTarget, yaw_rad: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad) * target.rest;
    let turned = Isometry3::from_parts(Default::default(), rotation);
    let lowest_m = rest::lowest_m(&target.hull, &turned);
    let centre = turned * target.object.centre_of_mass_m;
    Isometry3::from_parts(Vector3::new(-centre.x, -centre.y, -lowest_m).into(), rotation)
}

/// How far the open hand is from the stand.
pub(super) fn stand_distance_m(
    mechanism: &Mechanism<'_>,
    start: &Start,
    palm_from_world: &Isometry3<f64>,
    options: &PhysicsOptions,
) -> Result<f64, TrialError> {
    let palm_from_links =
        mechanism.hand.palm_from_links(&start.open_joints).map_err(|error| TrialError::hand(mechanism.hand, error))?;
    let (stand, pose) = (stand_shape(options), pose_from_isometry(&(palm_from_world * world_from_stand(options))));
    let distance_m = mechanism.shapes.iter().map(|shape| {
        let shape_pose = shape.pose_in_palm(&palm_from_links);
        // No hand has a shape that cannot be measured against a cylinder.
        distance(&shape_pose, shape.core, &pose, &*stand).map_or(0.0, |found| found.distance) - shape.edge_radius_m
    });
    Ok(distance_m.fold(f64::INFINITY, f64::min))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::Attempt;
    use crate::trial::targets::targets_named;

    #[test]
    fn a_low_thing_is_met_from_above_by_fingers_that_stay_off_the_stand() {
        let hand = Hand::load(std::path::Path::new("barrett-bh8-280")).expect("built in");
        let options = TrialOptions::default();
        let low = targets_named("ball-07,can-06,spoon-00").expect("43, 34 and 9 mm high");
        let from_anywhere = Draws::new(&hand, &low[0], &options, 3, 0).anywhere(0).expect("a hand");
        assert_eq!(from_anywhere, None);
        let starts =
            [0, 1].map(|attempt| choose_start(&hand, &low[0], &options, None, 3, 0, attempt).expect("a start"));
        assert!(starts.iter().all(|start| start.back_off_m > 0.05), "{starts:?}");
        let spoon = choose_start(&hand, &low[2], &options, None, 3, 0, 0);
        assert!(matches!(spoon, Err(TrialError::NoApproach { .. })), "{spoon:?}");

        let start = choose_start(&hand, &low[1], &options, None, 3, 0, 0).expect("a start");
        let mut attempt = Attempt::begin(&hand, &low[1], &options, &start, 0).expect("an attempt");
        while attempt.next_frame(0).is_some() {}
        let contacts = attempt.contacts();
        assert!(contacts.iter().any(|contact| contact.of_object), "it closes on the can");
        assert!(contacts.iter().all(|contact| contact.of_object || contact.point.other.is_some()));
    }

    #[test]
    fn a_tall_thing_is_touched_from_above_and_in_every_second_attempt_met_from_anywhere() {
        let hand = Hand::load(std::path::Path::new("barrett-bh8-280")).expect("built in");
        let options = TrialOptions::default();
        let canteen = targets_named("paper/canteen").expect("canteens").remove(0);
        let start = choose_start(&hand, &canteen, &options, None, 3, 0, 0).expect("a start");
        let world_from_palm = UnitQuaternion::from_quaternion(nalgebra::Quaternion::from(start.world_from_palm_xyzw));
        assert!((world_from_palm * Vector3::z()).z < -0.98, "{start:?}");
        assert_eq!(start.back_off_m, 0.0);
        let second = choose_start(&hand, &canteen, &options, None, 3, 0, 1).expect("a start");
        assert_eq!(Ok(Some(second)), Draws::new(&hand, &canteen, &options, 3, 0).anywhere(1));
    }
}
