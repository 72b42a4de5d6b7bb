//! The starts of attempts that follow advice: the palm's last place, moved by a proposal, as far as the arm can.
//!
//! The arm lets go, the target is put back as it stood, and the arm's frame is moved with it: a proposal is relative
//! to the target as it was in the settled hand. The hand then comes along the next palm's z axis, as it always
//! does, until something touches.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use serde::{Deserialize, Serialize};

use super::start::{first_touch, stand_distance_m, world_from_standing};
use super::{LiftTarget, Start, TrialError, TrialOptions};
use crate::mechanism::Mechanism;
use blindgrasp_messages::RegraspProposal;
use blindgrasp_stages::hand::Hand;

/// A grasp that was not lifted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Grasped {
    /// The settled palm in the target's frame.
    pub target_from_palm: Isometry3<f64>,
    /// The joints at the start.
    pub open_joints_rad: Vec<f64>,
}

/// Two grasps are the same if their palms are at most this far apart, metres, and the two other limits hold.
const SAME_M: f64 = 0.01;
/// Largest turn between the palms of the same grasp, radians.
const SAME_TURN_RAD: f64 = 0.2;
/// Largest difference between the first joint angles of the same grasp, radians.
const SAME_JOINT_RAD: f64 = 0.1;
/// A quaternion whose length differs from 1 by more than this is refused.
const UNIT_TOLERANCE: f64 = 1e-3;

/// The next attempt's start by the first proposal that the arm can do and that leads to none of the grasps in `grasped`,
/// which were not lifted; the last of them is the grasp that the proposals are for. The target stands turned by `yaw_rad`.
///
/// # Errors
/// A hand that cannot be simulated.
pub fn first_advised_start(
    hand: &Hand,
    target: &LiftTarget,
    options: &TrialOptions,
    grasped: &[Grasped],
    proposals: &[RegraspProposal],
    yaw_rad: f64,
) -> Result<Option<Start>, TrialError> {
    let Some(last) = grasped.last() else { return Ok(None) };
    let palm_from_target = last.target_from_palm.inverse();
    for proposal in proposals {
        let Some(palm_from_next) = palm_from_next(proposal) else { continue };
        let next = Grasped {
            target_from_palm: last.target_from_palm * palm_from_next,
            open_joints_rad: proposal.open_joints_rad.clone(),
        };
        if grasped.iter().any(|before| before.is_like(&next)) {
            continue;
        }
        let joints_rad = &proposal.open_joints_rad;
        let start = advised_start(hand, target, options, &palm_from_target, &palm_from_next, joints_rad, yaw_rad)?;
        if start.is_some() {
            return Ok(start);
        }
    }
    Ok(None)
}

/// The start of an attempt that comes down along the z axis of the next palm. `palm_from_target` is where the target was in
/// the settled hand, `palm_from_next` where its palm is to settle next; the target stands turned by `yaw_rad`.
///
/// `None` if the arm cannot do it, by the same rules as [`super::draw_start`]'s: the approach would go up or not steeply
/// enough down, the open hand would touch itself, miss the target or come too near to the stand; or the joints are not this
/// hand's, or beyond their limits.
///
/// # Errors
/// A hand that cannot be simulated.
pub fn advised_start(
    hand: &Hand,
    target: &LiftTarget,
    options: &TrialOptions,
    palm_from_target: &Isometry3<f64>,
    palm_from_next: &Isometry3<f64>,
    open_joints_rad: &[f64],
    yaw_rad: f64,
) -> Result<Option<Start>, TrialError> {
    let has_joints = open_joints_rad.len() == hand.joints.len()
        && open_joints_rad.iter().zip(&hand.joints).all(|(value, joint)| (joint.lower..=joint.upper).contains(value));
    if !has_joints {
        return Ok(None);
    }
    let next_from_target = palm_from_next.inverse() * palm_from_target;
    let world_from_next = world_from_standing(target, yaw_rad) * next_from_target.inverse();
    let descent = -(world_from_next.rotation * nalgebra::Vector3::z()).z;
    if descent < options.protocol.least_descent_rad.sin() {
        return Ok(None);
    }
    let centre_in_next = next_from_target * target.object.centre_of_mass_m;
    let start = Start {
        world_from_palm_xyzw: world_from_next.rotation.coords.into(),
        lateral_offset_m: [centre_in_next.x, centre_in_next.y],
        open_joints_rad: open_joints_rad.to_vec(),
        yaw_rad,
    };
    let mechanism = Mechanism::new(hand);
    let Some(touch) = first_touch(&mechanism, target, &start)? else { return Ok(None) };
    let distance_m = stand_distance_m(&mechanism, &start, &touch.palm_from_world, &options.physics)?;
    Ok((distance_m >= options.protocol.stand_clearance_m).then_some(start))
}

/// `None` if the proposal is not a pose: a message may come from another program.
fn palm_from_next(proposal: &RegraspProposal) -> Option<Isometry3<f64>> {
    let rotation = Quaternion::from(proposal.palm_rotation_xyzw);
    let is_pose = proposal.palm_position_m.iter().all(|value| value.is_finite())
        && (rotation.norm() - 1.0).abs() <= UNIT_TOLERANCE;
    is_pose.then(|| Isometry3::from_parts(proposal.palm_position_m.into(), UnitQuaternion::from_quaternion(rotation)))
}

impl Grasped {
    fn is_like(&self, other: &Grasped) -> bool {
        let [ours, theirs] = [&self.target_from_palm, &other.target_from_palm];
        let apart_m = (ours.translation.vector - theirs.translation.vector).norm();
        let joints = self.open_joints_rad.iter().zip(&other.open_joints_rad);
        apart_m <= SAME_M
            && ours.rotation.angle_to(&theirs.rotation) <= SAME_TURN_RAD
            && joints.fold(0.0, |most: f64, (ours, theirs)| most.max((ours - theirs).abs())) <= SAME_JOINT_RAD
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};
    use std::path::Path;

    use nalgebra::Vector3;

    use super::*;
    use crate::trial::targets::targets_named;
    use crate::trial::{Attempt, draw_start};

    /// A hand, a box that stands turned, and straight down onto its middle: `world_from_palm` as it touches, about.
    struct Scene {
        hand: Hand,
        target: LiftTarget,
        options: TrialOptions,
        yaw_rad: f64,
    }

    fn scene() -> Scene {
        let target = targets_named("paper/candle-box").expect("targets").remove(0);
        Scene {
            hand: Hand::load(Path::new("barrett-bh8-280")).expect("a hand"),
            target,
            options: TrialOptions::default(),
            yaw_rad: 0.7,
        }
    }

    impl Scene {
        fn open_joints_rad(&self) -> Vec<f64> {
            draw_start(&self.hand, &self.target, &self.options, 1, 0, 0).expect("a start").open_joints_rad
        }

        /// Where the target is in a palm that looks straight down, its middle this far off the axis.
        fn palm_from_target_below(&self, x_m: f64) -> Isometry3<f64> {
            let looks_down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
            Isometry3::from_parts(Vector3::new(x_m, 0.0, 0.2).into(), looks_down)
        }

        fn start(&self, palm_from_target: &Isometry3<f64>, palm_from_next: &Isometry3<f64>) -> Option<Start> {
            let Scene { hand, target, options, yaw_rad } = self;
            let joints_rad = self.open_joints_rad();
            advised_start(hand, target, options, palm_from_target, palm_from_next, &joints_rad, *yaw_rad)
                .expect("a hand")
        }
    }

    #[test]
    fn the_hand_comes_where_the_proposal_says() {
        let scene = scene();
        let palm_from_target = scene.palm_from_target_below(0.0);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.3);
        let palm_from_next = Isometry3::from_parts(Vector3::new(0.004, -0.006, 0.0).into(), turn);
        let start = scene.start(&palm_from_target, &palm_from_next).expect("possible");
        // Straight down: about x by π after the target's own turn, then as the proposal turns the palm about its axis.
        let expected = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), scene.yaw_rad)
            * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
            * turn;
        let found = UnitQuaternion::from_quaternion(Quaternion::from(start.world_from_palm_xyzw));
        assert!(found.angle_to(&expected) < 1e-9, "{found} {expected}");
        // The middle, on the old palm's axis, seen from the next palm: moved back and turned back.
        let (sin, cos) = 0.3_f64.sin_cos();
        let expected = [-0.004 * cos + 0.006 * sin, 0.004 * sin + 0.006 * cos];
        let off_m = start.lateral_offset_m.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off_m < 1e-9, "{:?} {expected:?}", start.lateral_offset_m);
        assert_eq!(start.yaw_rad, scene.yaw_rad);
    }

    #[test]
    fn a_settled_grasp_that_is_to_stay_where_it_is_begins_as_it_began() {
        let scene = scene();
        let start = scene.start(&scene.palm_from_target_below(0.005), &Isometry3::identity()).expect("possible");
        let mut attempt = Attempt::begin(&scene.hand, &scene.target, &scene.options, &start, 3).expect("begun");
        while attempt.next_frame(0).is_some() {}
        let again = scene.start(&attempt.palm_from_target(), &Isometry3::identity()).expect("possible");
        // The closing fingers push the box about, by some millimetres.
        let turn = |start: &Start| UnitQuaternion::from_quaternion(Quaternion::from(start.world_from_palm_xyzw));
        assert!(turn(&start).angle_to(&turn(&again)) < 0.3, "{start:?} {again:?}");
        let apart_m = start.lateral_offset_m.iter().zip(again.lateral_offset_m).map(|(a, b)| (a - b).abs());
        assert!(apart_m.fold(0.0, f64::max) < 0.02, "{start:?} {again:?}");
    }

    #[test]
    fn what_the_arm_cannot_do_is_refused() {
        let scene = scene();
        let below = scene.palm_from_target_below(0.0);
        let about = |axis, angle_rad| {
            Isometry3::from_parts(Vector3::zeros().into(), UnitQuaternion::from_axis_angle(&axis, angle_rad))
        };
        // From below.
        assert_eq!(scene.start(&below, &about(Vector3::x_axis(), PI)), None);
        // Beside the target.
        assert_eq!(scene.start(&below, &Isometry3::translation(0.5, 0.0, 0.0)), None);
        // Level, and so low that the hand comes to the stand.
        let level = Isometry3::from_parts(
            Vector3::new(0.0, 0.2, 0.2).into(),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), FRAC_PI_2),
        );
        let low = level * Isometry3::translation(0.0, 0.06, 0.0);
        let high = level * Isometry3::translation(0.0, -0.06, 0.0);
        let possible = [&low, &high].map(|pose| scene.start(&below, pose).is_some());
        assert!(possible.contains(&false), "{possible:?}");
        let Scene { hand, target, options, yaw_rad } = &scene;
        let mut joints_rad = scene.open_joints_rad();
        let start = |joints_rad: &[f64]| {
            advised_start(hand, target, options, &below, &Isometry3::identity(), joints_rad, *yaw_rad).expect("a hand")
        };
        assert!(start(&joints_rad).is_some());
        assert_eq!(start(&joints_rad[1..]), None);
        joints_rad[1] = f64::NAN;
        assert_eq!(start(&joints_rad), None);
        joints_rad[1] = 9.0;
        assert_eq!(start(&joints_rad), None);
    }

    #[test]
    fn the_first_proposal_that_is_possible_and_new_is_taken() {
        let scene = scene();
        let joints_rad = scene.open_joints_rad();
        let proposal = |x_m: f64, rotation: [f64; 4]| RegraspProposal {
            palm_position_m: [x_m, 0.0, 0.0],
            palm_rotation_xyzw: rotation,
            open_joints_rad: joints_rad.clone(),
            probability_held: 0.9,
        };
        let upright = [0.0, 0.0, 0.0, 1.0];
        let proposals = [
            proposal(f64::NAN, upright),
            proposal(0.02, [0.0, 0.0, 0.0, 2.0]),
            // Where it is, and where it was before.
            proposal(0.001, upright),
            proposal(-0.03, upright),
            // Beside the target.
            proposal(0.5, upright),
            proposal(0.015, upright),
            proposal(0.018, upright),
        ];
        let grasped = |x_m: f64| Grasped {
            target_from_palm: scene.palm_from_target_below(x_m).inverse(),
            open_joints_rad: joints_rad.clone(),
        };
        let first = |grasped: &[Grasped]| {
            let Scene { hand, target, options, yaw_rad } = &scene;
            first_advised_start(hand, target, options, grasped, &proposals, *yaw_rad).expect("a hand")
        };
        let start = first(&[grasped(0.03), grasped(0.0)]).expect("possible");
        assert!((start.lateral_offset_m[0] + 0.015).abs() < 1e-9, "{start:?}");
        // Not where it was before: nothing but that is possible.
        assert_eq!(first(&[grasped(-0.016), grasped(0.03), grasped(0.0)]), None);
        assert_eq!(first(&[]), None);
    }
}
