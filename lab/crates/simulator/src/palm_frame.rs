//! The palm frame in which a hand closes on an object: many URDFs have a palm link whose +z runs along the fingers.
//!
//! The hand closes on balls that lie before the palm, in one frame after the other. A frame is good if many pads come to lie on
//! the balls, and if the links press on them from all sides.

use std::collections::BTreeSet;

use nalgebra::{Isometry3, Point3, Translation3, Unit, UnitQuaternion, UnitVector3, Vector3};
use parry3d_f64::shape::SharedShape;
use rayon::prelude::*;

use crate::mechanism::{Mechanism, first_moved};
use crate::pad_grid::extent;
use crate::protocol::{Exploration, ProtocolOptions, Start};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{Hand, Joint, JointError, Pad, pose_from_isometry};

/// Radii of the balls, metres: those of a golf ball and of an apple.
const BALL_RADII_M: [f64; 2] = [0.02, 0.035];
/// How far the palm draws back from the ball before the fingers close, metres. The better distance counts.
const BACK_OFFS_M: [f64; 2] = [0.0, 0.025];
/// The frame is moved across its axis in these steps, metres, the larger ones first.
const STEPS_M: [f64; 2] = [0.02, 0.01];
/// A cell farther from the ball than this does not feel it, metres.
const NEAR_M: f64 = 0.01;
/// A link this near to the ball touches it, metres.
const TOUCHES_M: f64 = 0.001;
/// A frame must have a score that is better than the hand's own by this much.
const LEAST_GAIN: f64 = 0.05;
/// Cosine of the angle between directions that are alike: 30°.
const ALIKE: f64 = 0.87;
/// A step must make the score better by this much.
const LEAST_STEP: f64 = 0.005;
/// A joint that goes as far to one side of 0 as to the other, in this part, spreads fingers: it stays at 0.
const LEAST_SYMMETRY: f64 = 0.8;
/// Frames that are moved, of those in each direction.
const N_MOVED: usize = 2;
/// Values of a joint that are tried.
const N_VALUES: usize = 5;

/// A palm frame and how well the hand closes in it.
#[derive(Debug, Clone)]
pub struct PalmFit {
    /// The frame in the palm link's own.
    pub link_from_palm: Isometry3<f64>,
    /// Mean over the balls: 1 if all pads lie on the ball and the hand holds it from all sides, 0 if none or from one side.
    pub score: f64,
    /// Whether the hand closes better in this frame than in the palm link's own.
    pub is_better: bool,
}

/// The palm frame that suits the pads, or the palm link's own if that does as well. A hand without pads keeps its own.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn palm_fit(hand: &Hand) -> Result<PalmFit, JointError> {
    if hand.pads.is_empty() {
        return Ok(PalmFit { link_from_palm: Isometry3::identity(), score: 0.0, is_better: false });
    }
    let own = Trial::of(hand, Isometry3::identity())?;
    let tried: Result<Vec<Trial>, JointError> =
        directions(hand)?.par_iter().map(|direction| Trial::of(hand, frame_along(hand, direction)?)).collect();
    let mut tried = tried?;
    tried.sort_by(|a, b| b.score.total_cmp(&a.score));
    tried.truncate(N_MOVED);
    let tried: Result<Vec<Trial>, JointError> = tried.par_iter().map(|trial| trial.moved(hand)).collect();
    let tried = tried?;
    let best = tried.into_iter().max_by(|a, b| a.score.total_cmp(&b.score)).unwrap_or_else(|| own.clone());
    // A hand whose own axis leads out of the palm, and that holds a ball on it, need not be moved aside.
    let looks_the_same_way = (best.link_from_palm * Vector3::z()).z > ALIKE;
    let is_better = best.score > own.score + LEAST_GAIN && !(looks_the_same_way && own.score > LEAST_GAIN);
    let chosen = if is_better { best } else { own };
    Ok(PalmFit { link_from_palm: chosen.link_from_palm, score: chosen.score, is_better })
}

/// Indices of the pads that come near to no ball before the palm.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn idle_pads(hand: &Hand) -> Result<Vec<usize>, JointError> {
    let trial = Trial::of(hand, Isometry3::identity())?;
    Ok((0..hand.pads.len()).filter(|pad_idx| !trial.near.contains(pad_idx)).collect())
}

/// The part of the postures between the open and the closed hand in which links press on each other. Of the pairs that do so
/// comes the one that does it most often, by the links' indices.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn self_pressing(hand: &Hand) -> Result<(f64, Option<(usize, usize)>), JointError> {
    const N_STEPS: usize = 20;
    let postures = hand.closing_postures(&hand.open_joints(), N_STEPS);
    // The second half of an empty closing is always fingers on fingers.
    let postures = &postures[..=N_STEPS / 2];
    let mut pressing = Vec::new();
    for posture in postures {
        pressing.extend(hand.touching_links(posture)?.into_iter().take(1));
    }
    let commonest = pressing.iter().max_by_key(|pair| pressing.iter().filter(|other| other == pair).count()).copied();
    Ok((pressing.len() as f64 / postures.len() as f64, commonest))
}

/// The pairs of links, by their indices, that touch each other as the hand closes on balls before the palm, if one of them bears
/// a pad: what its cells feel there is no object.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn pairs_that_meet(hand: &Hand) -> Result<BTreeSet<(usize, usize)>, JointError> {
    let mechanism = Mechanism::new(hand);
    let mut pairs = BTreeSet::new();
    for radius_m in BALL_RADII_M {
        for back_off_m in BACK_OFFS_M {
            let Some(exploration) = close_on(&mechanism, &ball(radius_m), back_off_m)? else { continue };
            for (a, b) in hand.touching_links(&exploration.posture(exploration.end))? {
                if hand.pads.iter().any(|pad| pad.link_idx == a || pad.link_idx == b) {
                    pairs.insert((a, b));
                }
            }
        }
    }
    Ok(pairs)
}

fn ball(radius_m: f64) -> Object {
    Object::new("ball".into(), "ball".into(), SharedShape::ball(radius_m), 1000.0, false)
}

/// The open hand closes on a ball before its palm.
fn close_on(mechanism: &Mechanism<'_>, ball: &Object, back_off_m: f64) -> Result<Option<Exploration>, JointError> {
    let start = Start {
        open_joints: mechanism.hand.open_joints(),
        palm_from_object_rotation: UnitQuaternion::identity(),
        lateral_offset_m: [0.0; 2],
        back_off_m,
    };
    mechanism.explore(ball, &start, &ProtocolOptions::default())
}

/// A frame that was tried.
#[derive(Clone)]
struct Trial {
    link_from_palm: Isometry3<f64>,
    score: f64,
    /// Pads that came near to a ball.
    near: BTreeSet<usize>,
}

impl Trial {
    fn of(hand: &Hand, link_from_palm: Isometry3<f64>) -> Result<Trial, JointError> {
        let hand = hand.with_palm_frame(link_from_palm);
        let mechanism = Mechanism::new(&hand);
        let mut near = BTreeSet::new();
        let mut sum = 0.0;
        for radius_m in BALL_RADII_M {
            let ball = ball(radius_m);
            let mut most = 0.0_f64;
            for back_off_m in BACK_OFFS_M {
                let Some(exploration) = close_on(&mechanism, &ball, back_off_m)? else { continue };
                let palm_from_links = hand.palm_from_links(&exploration.posture(exploration.end))?;
                let centre = exploration.palm_from_object * Point3::origin();
                let felt = felt(&hand, &palm_from_links, &centre, radius_m);
                near.extend((0..felt.len()).filter(|pad_idx| felt[*pad_idx] > 0.0));
                let mean = felt.iter().sum::<f64>() / felt.len() as f64;
                most = most.max(mean * balance(&mechanism, &palm_from_links, &ball, &exploration.palm_from_object));
            }
            sum += most;
        }
        Ok(Trial { link_from_palm, score: sum / BALL_RADII_M.len() as f64, near })
    }

    /// The best frame that steps across its axis lead to.
    fn moved(&self, hand: &Hand) -> Result<Trial, JointError> {
        let mut best = self.clone();
        for step_m in STEPS_M {
            loop {
                let mut next = best.clone();
                for [x, y] in [[step_m, 0.0], [-step_m, 0.0], [0.0, step_m], [0.0, -step_m]] {
                    let trial = Trial::of(hand, best.link_from_palm * Translation3::new(x, y, 0.0))?;
                    if trial.score > next.score + LEAST_STEP {
                        next = trial;
                    }
                }
                if next.score <= best.score {
                    break;
                }
                best = next;
            }
        }
        Ok(best)
    }
}

/// For each pad, how well it lies on the ball: 1 where a cell touches it and faces its centre, 0 where none is near or faces it.
fn felt(hand: &Hand, palm_from_links: &[Isometry3<f64>], centre: &Point3<f64>, radius_m: f64) -> Vec<f64> {
    let mut felt = Vec::with_capacity(hand.pads.len());
    for pad in &hand.pads {
        let palm_from_link = &palm_from_links[pad.link_idx];
        let mut most: f64 = 0.0;
        for cell in &pad.cells {
            let to_centre = centre - palm_from_link * cell.position_in_link_m;
            let normal = palm_from_link.rotation * cell.normal_in_link;
            let off_m = (to_centre.norm() - radius_m).abs();
            let facing = (normal.dot(&to_centre) / to_centre.norm()).max(0.0);
            most = most.max((1.0 - off_m / NEAR_M).max(0.0) * facing);
        }
        felt.push(most);
    }
    felt
}

/// 1 if the links that touch an object press on it from all sides, 0 if from one side only.
fn balance(
    mechanism: &Mechanism<'_>,
    palm_from_links: &[Isometry3<f64>],
    object: &Object,
    palm_from_object: &Isometry3<f64>,
) -> f64 {
    let object_pose = pose_from_isometry(palm_from_object);
    let (mut sum, mut n) = (Vector3::zeros(), 0.0);
    for shape in &mechanism.shapes {
        let pose = shape.pose_in_palm(palm_from_links);
        if let Some(closest) = shape.closest_to_object(&pose, &object_pose, object, TOUCHES_M) {
            sum += Vector3::new(closest.direction.x, closest.direction.y, closest.direction.z);
            n += 1.0;
        }
    }
    if n > 0.0 { 1.0 - sum.norm() / n } else { 0.0 }
}

/// The directions that may lead out of the palm, in the palm link's frame: its axes, and the mean normal of the pads in the
/// open hand, if they agree and face between the axes.
fn directions(hand: &Hand) -> Result<Vec<UnitVector3<f64>>, JointError> {
    let axes = [Vector3::z_axis(), Vector3::x_axis(), Vector3::y_axis()];
    let mut directions: Vec<UnitVector3<f64>> = axes.into_iter().flat_map(|axis| [axis, -axis]).collect();
    let cells = hand.cells_in_palm(&hand.open_joints())?;
    let mean: Vector3<f64> =
        cells.iter().map(|cell| cell.normal_in_palm.into_inner()).sum::<Vector3<f64>>() / cells.len() as f64;
    let between = directions.iter().all(|axis| axis.dot(&mean) < 0.94 * mean.norm());
    if between {
        directions.extend(Unit::try_new(mean, 0.5));
    }
    Ok(directions)
}

/// The frame whose +z points in a direction, and whose axis goes through the middle of the half-closed hand's pads. Its origin
/// lies where the palm's shapes end in that direction.
fn frame_along(hand: &Hand, direction: &UnitVector3<f64>) -> Result<Isometry3<f64>, JointError> {
    let rotation = UnitQuaternion::rotation_between(&Vector3::z(), direction)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
    let postures = hand.closing_postures(&hand.open_joints(), 2);
    let palm_from_links = hand.palm_from_links(&postures[1])?;
    let middles = hand.pads.iter().map(|pad| (palm_from_links[pad.link_idx] * pad.middle_in_link_m()).coords);
    let middle = middles.sum::<Vector3<f64>>() / hand.pads.len() as f64;
    let [_, outermost_m] = extent(hand, hand.palm_link_idx(), direction);
    let outermost_m = if outermost_m.is_finite() { outermost_m } else { 0.0 };
    let origin = middle + direction.into_inner() * (outermost_m - middle.dot(direction));
    Ok(Isometry3::from_parts(origin.into(), rotation))
}

/// Joints that do not close the hand on an object.
#[derive(Debug, Clone, Default)]
pub struct OddJoints {
    /// Those that move the pads of the open hand along their faces, to spread fingers or to turn a thumb.
    pub sideways: Vec<usize>,
    /// Of the others those that turn back as the joint above them closes.
    pub opposed: Vec<usize>,
}

/// The joints that do not close the hand on an object.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn odd_joints(hand: &Hand) -> Result<OddJoints, JointError> {
    /// Of a pad's motion, the part towards its normal.
    const LEAST_TOWARDS: f64 = 0.35;
    let mechanism = Mechanism::new(hand);
    let palm_from_links = hand.palm_from_links(&hand.open_joints())?;
    let opposed = mechanism.opposed_joints(&palm_from_links);
    let mut odd = OddJoints { sideways: Vec::new(), opposed: Vec::new() };
    let mut others = Vec::new();
    for joint_idx in 0..hand.joints.len() {
        let (mut towards, mut all) = (0.0, 0.0);
        for pad in &hand.pads {
            let palm_from_link = &palm_from_links[pad.link_idx];
            let middle = palm_from_link * pad.middle_in_link_m();
            let velocity = mechanism.velocity_of_joint(pad.link_idx, &middle, joint_idx, &palm_from_links);
            let normal = palm_from_link.rotation * mean_normal(pad);
            towards += velocity.dot(&normal).abs();
            all += velocity.norm();
        }
        let is_sideways = all > 1e-9 && towards < LEAST_TOWARDS * all;
        if is_sideways { odd.sideways.push(joint_idx) } else { others.push(joint_idx) }
    }
    for joint_idx in others {
        if opposed.iter().any(|(below, above)| *below == joint_idx && !odd.sideways.contains(above)) {
            odd.opposed.push(joint_idx);
        }
    }
    Ok(odd)
}

/// The mean normal of a pad's cells, in its link's frame.
fn mean_normal(pad: &Pad) -> Vector3<f64> {
    let sum = pad.cells.iter().map(|cell| cell.normal_in_link.into_inner()).sum::<Vector3<f64>>();
    sum.try_normalize(1e-9).unwrap_or_else(Vector3::z)
}

/// Whether a joint goes about as far to both sides of 0, as one that spreads fingers does.
fn is_symmetric(joint: &Joint) -> bool {
    let (less, more) = (joint.upper.min(-joint.lower), joint.upper.max(-joint.lower));
    less > 0.0 && less > LEAST_SYMMETRY * more
}

/// A value of a joint, one of so many from its lower limit to the upper one.
fn value_at(joint: &Joint, idx: usize) -> f64 {
    joint.lower + idx as f64 / (N_VALUES - 1) as f64 * (joint.upper - joint.lower)
}

/// The value of a joint that is set before the grasp with which the hand closes best on a ball. One that spreads fingers keeps
/// its own.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn best_value(hand: &Hand, joint_idx: usize) -> Result<f64, JointError> {
    let joint = &hand.joints[joint_idx];
    if is_symmetric(joint) {
        return Ok(joint.open());
    }
    let mut best = (Trial::of(hand, Isometry3::identity())?.score, joint.open());
    for idx in 0..N_VALUES {
        let value = value_at(joint, idx);
        let trial = Trial::of(&hand.with_open_joint(joint_idx, value), Isometry3::identity())?;
        if trial.score > best.0 + LEAST_STEP {
            best = (trial.score, value);
        }
    }
    Ok(best.1)
}

/// The values of joints that are set before the grasp with which pads come face to face as the hand closes, as those of a thumb
/// that turns in two joints. A finger's only joint keeps its value if it spreads the finger. `None` if no values do better than
/// those of the open hand.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn opposing_values(hand: &Hand, joints: &[usize]) -> Result<Option<Vec<(usize, f64)>>, JointError> {
    let mut hand = hand.clone();
    let turning = |idx: usize| joints.iter().any(|other| *other != idx && is_same_finger(&hand, idx, *other));
    let joints: Vec<usize> =
        joints.iter().copied().filter(|idx| !is_symmetric(&hand.joints[*idx]) || turning(*idx)).collect();
    let least = opposition(&hand)? + LEAST_GAIN;
    let mut most = least;
    // Two joints at a time, until no pair of values does better.
    loop {
        let before = most;
        for (n, first) in joints.iter().enumerate() {
            for second in &joints[n..] {
                let mut best = [hand.joints[*first].open, hand.joints[*second].open];
                for values in 0..N_VALUES * N_VALUES {
                    hand.joints[*first].open = Some(value_at(&hand.joints[*first], values / N_VALUES));
                    hand.joints[*second].open = Some(value_at(&hand.joints[*second], values % N_VALUES));
                    let opposition = opposition(&hand)?;
                    if opposition > most + LEAST_STEP {
                        most = opposition;
                        best = [hand.joints[*first].open, hand.joints[*second].open];
                    }
                }
                [hand.joints[*first].open, hand.joints[*second].open] = best;
            }
        }
        if most == before {
            break;
        }
    }
    Ok((most > least).then(|| joints.iter().map(|idx| (*idx, hand.joints[*idx].open())).collect()))
}

/// Whether two joints move one and the same pad.
fn is_same_finger(hand: &Hand, a: usize, b: usize) -> bool {
    hand.pads.iter().any(|pad| [a, b].iter().all(|joint_idx| first_moved(hand, pad.link_idx, *joint_idx).is_some()))
}

/// How well pads come face to face while the hand closes on nothing, each finger stopping where it likes. The pad that faces
/// the most others counts: the sum over these, each 1 if both look at each other over the width of a ball.
fn opposition(hand: &Hand) -> Result<f64, JointError> {
    const N_STEPS: usize = 10;
    // Per pad its middle and normal, posture by posture.
    let mut faces: Vec<Vec<(Point3<f64>, Vector3<f64>)>> = vec![Vec::new(); hand.pads.len()];
    for posture in hand.closing_postures(&hand.open_joints(), N_STEPS) {
        let palm_from_links = hand.palm_from_links(&posture)?;
        for (pad, faces) in hand.pads.iter().zip(&mut faces) {
            let palm_from_link = &palm_from_links[pad.link_idx];
            faces.push((palm_from_link * pad.middle_in_link_m(), palm_from_link.rotation * mean_normal(pad)));
        }
    }
    let mut most: f64 = 0.0;
    for (pad_idx, of_pad) in faces.iter().enumerate() {
        for face in of_pad {
            let mut sum = 0.0;
            for others in faces.iter().skip(pad_idx + 1).chain(&faces[..pad_idx]) {
                sum += others.iter().map(|other| facing(face, other)).fold(0.0, f64::max);
            }
            most = most.max(sum);
        }
    }
    Ok(most)
}

/// 1 where two faces look at each other over the width of a ball, 0 where one looks aside or lies elsewhere.
fn facing((a, normal_a): &(Point3<f64>, Vector3<f64>), (b, normal_b): &(Point3<f64>, Vector3<f64>)) -> f64 {
    let gap = b - a;
    let width_m = gap.norm().max(1e-9);
    let [least_m, most_m] = BALL_RADII_M.map(|radius_m| 2.0 * radius_m);
    let off_m = (least_m - width_m).max(width_m - most_m).max(0.0);
    let looks = normal_a.dot(&gap).max(0.0) * (-normal_b.dot(&gap)).max(0.0) / width_m.powi(2);
    (1.0 - off_m / (2.0 * NEAR_M)).max(0.0) * looks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pad_grid::pad_grid;
    use blindgrasp_stages::hand::BareHand;
    use std::path::Path;

    fn built_in(name: &str) -> Hand {
        Hand::load(Path::new(name)).expect("built in").with_moving_pads()
    }

    #[test]
    fn a_hand_keeps_a_palm_frame_that_suits_it() {
        for name in ["barrett-bh8-280", "parallel-gripper"] {
            let fit = palm_fit(&built_in(name)).expect("fits");
            assert!(!fit.is_better && fit.score > 0.05, "{name}: {fit:?}");
            assert_eq!(idle_pads(&built_in(name)).expect("fits"), [0; 0], "{name}");
        }
    }

    #[test]
    fn a_turned_palm_frame_is_turned_back() {
        for name in ["barrett-bh8-280", "parallel-gripper"] {
            let hand = built_in(name);
            let turned = Isometry3::rotation(Vector3::y() * std::f64::consts::FRAC_PI_2);
            let fit = palm_fit(&hand.with_palm_frame(turned)).expect("fits");
            let out_of_palm = turned * fit.link_from_palm * Vector3::z();
            assert!(fit.is_better && out_of_palm.z > 0.9, "{name}: {fit:?} {out_of_palm}");
        }
    }

    #[test]
    fn joints_that_spread_fingers_do_not_close() {
        let mut hand = built_in("barrett-bh8-280");
        hand.joints.iter_mut().for_each(|joint| joint.is_preshape = false);
        let odd = odd_joints(&hand).expect("fits");
        assert_eq!((odd.sideways, odd.opposed), (vec![hand.joint_idx("spread").expect("a joint")], vec![]));
        let odd = odd_joints(&built_in("parallel-gripper")).expect("fits");
        assert_eq!((odd.sideways, odd.opposed), (vec![], vec![]));
    }

    #[test]
    fn links_that_meet_on_a_ball_are_named_if_they_bear_pads() {
        let gripper = built_in("parallel-gripper");
        assert_eq!(pairs_that_meet(&gripper).expect("fits"), BTreeSet::new());
        // Spread by half a radian, finger 3 closes between the others.
        let mut hand = built_in("barrett-bh8-280");
        let spread = hand.joint_idx("spread").expect("a joint");
        hand.joints[spread].open = Some(0.5);
        let mut met = Vec::new();
        for (a, b) in pairs_that_meet(&hand).expect("fits") {
            met.push((hand.links[a].name.clone(), hand.links[b].name.clone()));
        }
        assert!(met.contains(&("distal_1".into(), "distal_3".into())), "{met:?}");
        hand.pads.clear();
        assert_eq!(pairs_that_meet(&hand).expect("fits"), BTreeSet::new());
    }

    /// Two fingers that bend towards +x, and a thumb on an arm beside them that looks away. It comes to face them only if the arm
    /// turns by a quarter and the thumb by a half.
    fn hand_with_thumb() -> Hand {
        let link = |name: &str, parent: &str, place: &str, axis: &str, limits: &str, shape: &str| {
            format!(
                "<link name='{name}'>{shape}</link><joint name='{name}_joint' type='revolute'><parent link='{parent}'/><child \
                 link='{name}'/><origin xyz='{place}'/><axis xyz='{axis}'/><limit {limits}/></joint>"
            )
        };
        let bone = "<collision><origin xyz='0 0 0.04'/><geometry><box size='0.012 0.018 0.08'/></geometry></collision>";
        let bends = "lower='0' upper='1.2'";
        let parts = [
            link("index", "palm", "0 0.012 0.03", "0 1 0", bends, bone),
            link("middle", "palm", "0 -0.012 0.03", "0 1 0", bends, bone),
            link("arm", "palm", "0 0 0.03", "0 0 -1", "lower='0' upper='1.5708'", ""),
            link("twist", "arm", "0 0.06 0", "0 0 1", "lower='0' upper='3.1416'", ""),
            link("thumb", "twist", "0 0 0", "-1 0 0", bends, &bone.replace("0.012 0.018", "0.018 0.012")),
        ];
        let palm = "<link name='palm'><collision><geometry><box size='0.02 0.06 0.04'/></geometry></collision></link>";
        let urdf = format!("<robot name='hand'>{palm}{}</robot>", parts.concat());
        let bare = BareHand {
            padded_links: vec!["index".into(), "middle".into(), "thumb".into()],
            name: "hand".into(),
            preshape_joints: vec!["arm_joint".into(), "twist_joint".into()],
            ..BareHand::default()
        };
        let mut hand = Hand::without_cells(Path::new("hand.urdf"), &urdf, &bare).expect("a hand");
        for name in &bare.padded_links {
            let link_idx = hand.links.iter().position(|link| link.name == *name).expect("a link");
            let cells = pad_grid(&Mechanism::new(&hand), link_idx, [3, 2], &[], 0.05).expect("cells");
            hand.pads.push(Pad { link_idx, first_cell_idx: hand.n_cells(), cells, ..Pad::default() });
        }
        hand
    }

    #[test]
    fn a_thumb_turns_in_two_joints_to_face_the_fingers() {
        let hand = hand_with_thumb();
        let [arm, twist] = ["arm_joint", "twist_joint"].map(|name| hand.joint_idx(name).expect("a joint"));
        let values = opposing_values(&hand, &[arm, twist]).expect("fits").expect("better values");
        // As they are printed.
        let [quarter, half] =
            [std::f64::consts::FRAC_PI_2, std::f64::consts::PI].map(|turn| (1e4 * turn).round() / 1e4);
        assert_eq!(values, [(arm, quarter), (twist, half)]);
        let turned = hand.with_open_joint(arm, quarter).with_open_joint(twist, half);
        assert_eq!(opposing_values(&turned, &[arm, twist]).expect("fits"), None);
        // Neither joint does it alone.
        for joint_idx in [arm, twist] {
            assert_eq!(opposing_values(&hand, &[joint_idx]).expect("fits"), None, "{joint_idx}");
        }
    }

    #[test]
    fn fingers_press_on_each_other_only_late() {
        let (share, _) = self_pressing(&built_in("barrett-bh8-280")).expect("fits");
        assert!(share < 0.5, "{share}");
    }
}
