//! One candidate: a random start, the closed hand, its contacts and quality, and the frames it gives.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::contact_points::{contact_points, self_contacts};
use super::loaded_contacts::{LoadedPoint, SimulatedContact, grasp_case, press};
use super::mechanism::Mechanism;
use super::options::{FrameOptions, SimulatorOptions};
use super::planner::plan_start;
use super::protocol::{Approach, Exploration, Start, draw_start};
use super::tactile_sensor::Sensor;
use super::wrench_space::{Quality, QualityError, quality};
use blindgrasp_messages::{GraspScene, GraspTruth, Phase, TactileFrame};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::{Hand, JointError};

/// A simulated grasp with its tactile frames and its label.
#[derive(Debug, Clone)]
pub struct SimulatedGrasp {
    pub frames: Vec<TimedFrame>,
    pub truth: GraspTruth,
    pub scene: GraspScene,
}

/// A frame and its time.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedFrame {
    /// Time since the grasp's first frame.
    pub offset_nanos: u64,
    pub frame: TactileFrame,
}

/// Why a candidate could not be judged, other than by a failed hull.
#[derive(Debug, thiserror::Error)]
pub enum CandidateError {
    /// The hand's joints do not fit together.
    #[error(transparent)]
    Joint(#[from] JointError),
    /// The simulator made wrenches that cannot be used.
    #[error("candidate {candidate}")]
    Quality { candidate: u64, source: QualityError },
    /// The candidate cannot be lifted in physics.
    #[error("candidate {candidate}")]
    Lift { candidate: u64, source: Box<dyn std::error::Error + Send + Sync> },
}

/// A closed hand on an object, with its contacts.
#[derive(Debug, Clone)]
pub(crate) struct CandidateGrasp {
    object_idx: usize,
    contacts: Vec<SimulatedContact>,
    candidate: u64,
    exploration: Exploration,
}

/// The outcome of a candidate.
pub(crate) enum Outcome {
    NoTouch,
    HullFailure,
    /// The physics of its lift came to no end that could be.
    Diverged,
    Judged(Box<Judged>),
}

/// A candidate with a label.
pub(crate) struct Judged {
    pub(crate) object_idx: usize,
    pub(crate) is_stable: bool,
    pub(crate) quality: Quality,
    pub(crate) made: Made,
}

/// The state of a candidate before it is kept.
pub(crate) enum Made {
    /// A grasp whose frames are made when it is kept.
    Closed(CandidateGrasp),
    /// A grasp that has its frames, because a lift follows them.
    Lifted(SimulatedGrasp),
}

impl Judged {
    /// With frames, as grasp number `grasp_id`.
    pub(super) fn into_simulated(
        self,
        hand: &Hand,
        objects: &[Object],
        options: &SimulatorOptions,
        grasp_id: u64,
    ) -> SimulatedGrasp {
        match self.made {
            Made::Closed(grasp) => grasp.into_simulated(hand, objects, options, grasp_id, &self.quality),
            Made::Lifted(mut grasp) => {
                grasp.frames.iter_mut().for_each(|timed| timed.frame.grasp_id = grasp_id);
                (grasp.truth.grasp_id, grasp.scene.grasp_id) = (grasp_id, grasp_id);
                grasp
            }
        }
    }
}

/// Draws and judges candidate number `candidate`: a pure function of it and the options' seed.
pub(super) fn try_candidate(
    mechanism: &Mechanism<'_>,
    objects: &[Object],
    options: &SimulatorOptions,
    candidate: u64,
) -> Result<Outcome, CandidateError> {
    let mut rng = candidate_rng(options.seed, candidate, 0);
    let object_idx = rng.random_range(0..objects.len());
    let object = &objects[object_idx];
    let start = match options.protocol.approach {
        Approach::Blind => Some(draw_start(mechanism.hand, &options.protocol, &mut rng)),
        Approach::Planned => plan_start(mechanism, object, &options.protocol, &options.planner, &mut rng)?,
    };
    let Some(start) = start else { return Ok(Outcome::NoTouch) };
    let Some((exploration, contacts)) = grasp(mechanism, object, &start, options)? else {
        return Ok(Outcome::NoTouch);
    };
    match quality(&grasp_case(object, &exploration.palm_from_object, &contacts, options.friction)) {
        Ok(quality) => Ok(Outcome::Judged(Box::new(Judged {
            object_idx,
            is_stable: options.thresholds.hold(&quality),
            quality,
            made: Made::Closed(CandidateGrasp { object_idx, candidate, exploration, contacts }),
        }))),
        Err(QualityError::Hull { .. }) => Ok(Outcome::HullFailure),
        Err(source) => Err(CandidateError::Quality { candidate, source }),
    }
}

impl CandidateGrasp {
    /// With frames, as grasp number `grasp_id`.
    fn into_simulated(
        self,
        hand: &Hand,
        objects: &[Object],
        options: &SimulatorOptions,
        grasp_id: u64,
        quality: &Quality,
    ) -> SimulatedGrasp {
        let object = &objects[self.object_idx];
        SimulatedGrasp {
            frames: frames(hand, &self, options, grasp_id),
            truth: GraspTruth {
                grasp_id,
                epsilon: quality.epsilon,
                volume: quality.volume,
                stable: options.thresholds.hold(quality),
                object: object.name.clone(),
                object_class: object.class.clone(),
            },
            scene: self.scene(object, options, grasp_id),
        }
    }

    fn scene(&self, object: &Object, options: &SimulatorOptions, grasp_id: u64) -> GraspScene {
        let palm_from_object = &self.exploration.palm_from_object;
        GraspScene {
            grasp_id,
            candidate: self.candidate,
            object_position_m: palm_from_object.translation.vector.into(),
            object_rotation_xyzw: palm_from_object.rotation.coords.into(),
            centre_of_mass_m: (palm_from_object * object.centre_of_mass_m).into(),
            max_radius_m: object.max_radius_m,
            mass_kg: object.mass_kg,
            friction: options.friction,
            joints: self.exploration.posture(self.exploration.end),
            self_collision: self.contacts.iter().any(|contact| contact.point.other.is_some()),
            contacts: self.contacts.iter().map(SimulatedContact::to_scene).collect(),
        }
    }
}

/// A candidate's own random numbers: `part` 0 for the grasp, 1 for the sensor.
pub(crate) fn candidate_rng(seed: u64, candidate: u64, part: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(2 * candidate + part);
    rng
}

/// Explores and finds the contacts with the object and of links with each other. `None` without a contact with the object.
pub(crate) fn grasp(
    mechanism: &Mechanism<'_>,
    object: &Object,
    start: &Start,
    options: &SimulatorOptions,
) -> Result<Option<(Exploration, Vec<SimulatedContact>)>, JointError> {
    let Some(exploration) = mechanism.explore(object, start, &options.protocol)? else {
        return Ok(None);
    };
    let palm_from_links = mechanism.hand.palm_from_links(&exploration.posture(exploration.end))?;
    let palm_from_object = &exploration.palm_from_object;
    let tolerance_m = options.protocol.touch_tolerance_m;
    let mut points =
        contact_points(mechanism, &palm_from_links, palm_from_object, object, tolerance_m, &options.contacts);
    if points.is_empty() {
        return Ok(None);
    }
    points.extend(self_contacts(mechanism, &palm_from_links, tolerance_m));
    let pressed: Vec<LoadedPoint<'_>> = points
        .iter()
        .map(|point| {
            let share_newtons = |link_idx: usize| {
                let n_of_link = points.iter().filter(|other| other.link_idx == link_idx).count();
                options.soft_finger.normal_force_newtons / n_of_link as f64
            };
            // Two links press on each other with one force.
            let other_newtons = point.other.map_or(f64::INFINITY, |other| share_newtons(other.link_idx));
            LoadedPoint {
                point: *point,
                load_newtons: share_newtons(point.link_idx).min(other_newtons),
                object: Some(object),
            }
        })
        .collect();
    let mut contacts = press(mechanism, &palm_from_links, palm_from_object, &pressed, &options.soft_finger);
    for contact in &mut contacts {
        contact.settled_at = [Some(contact.point.link_idx), contact.point.other.map(|other| other.link_idx)]
            .into_iter()
            .flatten()
            .map(|link_idx| mechanism.settled_at(link_idx, &exploration.joints))
            .fold(0.0, f64::max);
    }
    Ok(Some((exploration, contacts)))
}

fn frames(hand: &Hand, grasp: &CandidateGrasp, options: &SimulatorOptions, grasp_id: u64) -> Vec<TimedFrame> {
    let mut rng = candidate_rng(options.seed, grasp.candidate, 1);
    let sensor = Sensor::draw(hand, &options.sensor, options.seed, &mut rng);
    let FrameOptions { n_open, n_closing, n_settled, period_nanos } = options.frames;
    let end = grasp.exploration.end;
    let moments = (0..n_open)
        .map(|_| (Phase::Open, 0.0))
        .chain((0..n_closing).map(|idx| (Phase::Closing, end * (idx as f64 + 1.0) / (n_closing as f64 + 1.0))))
        .chain((0..n_settled).map(|_| (Phase::Settled, end)));
    moments
        .enumerate()
        .map(|(idx, (phase, progress))| {
            let mut cells_newtons = vec![0.0; hand.n_cells()];
            for contact in &grasp.contacts {
                let part = match phase {
                    Phase::Open => 0.0,
                    Phase::Closing if end > contact.settled_at => {
                        ((progress - contact.settled_at) / (end - contact.settled_at)).max(0.0)
                    }
                    Phase::Closing => 0.0,
                    _ => 1.0,
                };
                for (cell_idx, newtons) in &contact.cells_newtons {
                    cells_newtons[*cell_idx] += part * newtons;
                }
            }
            let joints = grasp.exploration.posture(progress);
            TimedFrame {
                offset_nanos: idx as u64 * period_nanos,
                frame: TactileFrame {
                    grasp_id,
                    phase,
                    joints: sensor.read_joints(hand, &joints, &options.sensor),
                    cells_newtons: sensor.read_cells(hand, &cells_newtons, &options.sensor, &mut rng),
                    ..TactileFrame::default()
                },
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::wrench_space::STABLE_EPSILON;
    use super::*;
    use blindgrasp_mesh::mass::solid_properties;
    use blindgrasp_stages::hand::pose_from_isometry;
    use nalgebra::{Isometry3, Point3, Reflection3, Rotation3, UnitQuaternion, Vector3};
    use parry3d_f64::math::Vector;
    use parry3d_f64::shape::SharedShape;
    use std::path::Path;
    use std::sync::LazyLock;

    fn barrett() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("built in")
    }

    fn named(name: &str) -> Object {
        blindgrasp_objects::select(name).expect("built in").remove(0)
    }

    /// Grasps of all objects in turn, each with its object and start.
    fn grasps(
        hand: &Hand,
        options: &SimulatorOptions,
        n: u64,
    ) -> Vec<(Object, Start, Exploration, Vec<SimulatedContact>)> {
        // Making them takes longer than closing on a hundred.
        static OBJECTS: LazyLock<Vec<Object>> = LazyLock::new(|| blindgrasp_objects::select("all").expect("built in"));
        let mechanism = Mechanism::new(hand);
        (0..n)
            .filter_map(|idx| {
                let mut rng = candidate_rng(7, idx, 0);
                let object = OBJECTS[idx as usize % OBJECTS.len()].clone();
                let start = draw_start(hand, &options.protocol, &mut rng);
                let (exploration, contacts) = grasp(&mechanism, &object, &start, options).expect("a hand")?;
                Some((object, start, exploration, contacts))
            })
            .collect()
    }

    /// At friction 1.
    fn quality_of(object: &Object, exploration: &Exploration, contacts: &[SimulatedContact]) -> Quality {
        quality(&grasp_case(object, &exploration.palm_from_object, contacts, 1.0)).expect("a hull")
    }

    /// The least distance between any link and the object, and between links that closing may bring together.
    fn least_distances_m(
        mechanism: &Mechanism<'_>,
        object: &Object,
        exploration: &Exploration,
        progress: f64,
    ) -> [f64; 2] {
        let palm_from_links = mechanism.hand.palm_from_links(&exploration.posture(progress)).expect("7 joints");
        let object_pose = pose_from_isometry(&exploration.palm_from_object);
        let to_object = mechanism.shapes.iter().map(|shape| {
            let pose = shape.pose_in_palm(&palm_from_links);
            shape.closest_to_object(&pose, &object_pose, object, 10.0).expect("nearer than 10 m").distance_m
        });
        let between = mechanism.pairs.iter().map(|&(a, b)| {
            mechanism.closest_of_links(a, b, &palm_from_links).expect("nearer than 10 m").points.distance_m
        });
        [to_object.fold(f64::MAX, f64::min), between.fold(f64::MAX, f64::min)]
    }

    #[test]
    fn nothing_passes_through_anything_in_200_grasps() {
        let hand = barrett();
        let mechanism = Mechanism::new(&hand);
        let options = SimulatorOptions::default();
        let all = grasps(&hand, &options, 200);
        assert!(all.len() > 190, "{}", all.len());
        for (object, _, exploration, _) in &all {
            for step in 0..=20 {
                let progress = exploration.end * f64::from(step) / 20.0;
                let [to_object_m, between_m] = least_distances_m(&mechanism, object, exploration, progress);
                assert!(to_object_m > -0.0005, "{object:?} at {progress}: {to_object_m} m, rubber gives 3 mm");
                assert!(between_m > -0.0005, "{object:?} at {progress}: links {between_m} m");
            }
        }
    }

    #[test]
    fn contacts_lie_on_the_object_and_on_the_link() {
        let hand = barrett();
        let options = SimulatorOptions::default();
        for (object, _, exploration, contacts) in grasps(&hand, &options, 100) {
            let palm_from_links = hand.palm_from_links(&exploration.posture(exploration.end)).expect("7 joints");
            for contact in &contacts {
                let point = contact.point.point_in_palm_m;
                let point = Vector::new(point.x, point.y, point.z);
                if contact.point.other.is_some() {
                    continue;
                }
                let from_object =
                    object.shape.project_point(&pose_from_isometry(&exploration.palm_from_object), point, false).point;
                assert!((from_object - point).length() < 1e-6, "{object:?}: {}", (from_object - point).length());
                let link_idx = contact.point.link_idx;
                let from_link_m = hand.links[link_idx]
                    .shapes
                    .iter()
                    .map(|shape| {
                        let pose = pose_from_isometry(&(palm_from_links[link_idx] * shape.link_from_shape));
                        (shape.core.distance_to_point(&pose, point, true) - shape.edge_radius_m).max(0.0)
                    })
                    .fold(f64::MAX, f64::min);
                assert!(from_link_m <= options.protocol.touch_tolerance_m + 1e-9, "{object:?}: {from_link_m}");
                // The normal points out of the object: a step along it leads away from the object by as much.
                let normal = contact.point.object_normal_in_palm;
                let outside = point + Vector::new(normal.x, normal.y, normal.z) * 0.001;
                let distance_m =
                    object.shape.distance_to_point(&pose_from_isometry(&exploration.palm_from_object), outside, true);
                assert!((distance_m - 0.001).abs() < 1e-5, "{object:?}: {distance_m}");
            }
        }
    }

    #[test]
    fn distal_links_go_on_alone_but_never_fall_behind() {
        let hand = barrett();
        let mut n_alone = 0;
        for (_, _, exploration, _) in grasps(&hand, &SimulatorOptions::default(), 100) {
            let joints = exploration.posture(exploration.end);
            for finger in 1..=3 {
                let ahead_rad = joints[finger + 3] - joints[finger] * 45.0 / 140.0;
                assert!(ahead_rad > -1e-12, "{joints:?}");
                n_alone += usize::from(ahead_rad > 0.01);
            }
        }
        assert!(n_alone > 20, "{n_alone}");
    }

    #[test]
    fn a_ball_between_palm_and_three_fingers_is_stable() {
        let hand = barrett();
        let options = SimulatorOptions::default();
        let mechanism = Mechanism::new(&hand);
        let ball = Object::new("ball".into(), "ball".into(), SharedShape::ball(0.045), 300.0, false);
        let start = Start {
            open_joints: hand.posture([("spread", std::f64::consts::FRAC_PI_3)]).expect("in range"),
            palm_from_object_rotation: UnitQuaternion::identity(),
            lateral_offset_m: [0.0, 0.0],
            back_off_m: 0.0,
        };
        let (exploration, contacts) = grasp(&mechanism, &ball, &start, &options).expect("a hand").expect("touches");
        assert_eq!(contacts.len(), 4, "{contacts:?}");
        assert!((exploration.palm_from_object.translation.vector - Vector3::new(0.0, 0.0, 0.0451)).norm() < 1e-5);
        let quality = quality_of(&ball, &exploration, &contacts);
        assert!(quality.is_stable(), "{quality:?}");
    }

    /// Dang & Allen, section IV-B: grasps with an epsilon above 0.07 stand more uncertainty about the object's pose. Here the
    /// object is moved aside by up to 15 mm and turned by 10 degrees, and the hand comes and closes again.
    #[test]
    fn grasps_of_more_epsilon_close_again_on_an_object_that_lies_elsewhere() {
        let hand = barrett();
        let options = SimulatorOptions::default();
        let mechanism = Mechanism::new(&hand);
        let mut rng = candidate_rng(8, 0, 0);
        // Of grasps with an epsilon to 0.07, and above.
        let (mut n_moved, mut n_closed) = ([0_u32; 2], [0_u32; 2]);
        for (object, start, exploration, contacts) in grasps(&hand, &options, 120) {
            let before = quality_of(&object, &exploration, &contacts);
            if !before.force_closure {
                continue;
            }
            let group = usize::from(before.epsilon > STABLE_EPSILON);
            for _ in 0..2 {
                let by = draw_start(&hand, &options.protocol, &mut rng);
                let axis = by.palm_from_object_rotation.axis().expect("a turn");
                let turn = UnitQuaternion::from_axis_angle(&axis, 10_f64.to_radians());
                let moved = Start {
                    palm_from_object_rotation: turn * start.palm_from_object_rotation,
                    lateral_offset_m: [0, 1].map(|idx| start.lateral_offset_m[idx] + by.lateral_offset_m[idx]),
                    ..start.clone()
                };
                n_moved[group] += 1;
                if let Some((exploration, contacts)) = grasp(&mechanism, &object, &moved, &options).expect("a hand") {
                    n_closed[group] += u32::from(quality_of(&object, &exploration, &contacts).force_closure);
                }
            }
        }
        println!("closed again, epsilon to 0.07 and above: {n_closed:?} of {n_moved:?}");
        assert!(n_closed[1] * n_moved[0] > n_closed[0] * n_moved[1], "{n_closed:?} of {n_moved:?}");
    }

    /// One motor moves the knuckles, the inner knuckles and the fingers of both sides.
    #[test]
    fn a_gripper_with_linkages_pushes_an_object_only_until_both_tips_hold_it() {
        let hand = Hand::load(Path::new("robotiq-2f85-tsf85")).expect("built in");
        let options = SimulatorOptions::default();
        let mechanism = Mechanism::new(&hand);
        let ball = Object::new("ball".into(), "ball".into(), SharedShape::ball(0.02), 300.0, false);
        let mut middles_m = Vec::new();
        for aside_m in [-0.012, -0.004, 0.0, 0.004, 0.012] {
            let start = Start {
                open_joints: hand.open_joints(),
                palm_from_object_rotation: UnitQuaternion::identity(),
                lateral_offset_m: [aside_m, 0.0],
                back_off_m: 0.02,
            };
            let (exploration, contacts) = grasp(&mechanism, &ball, &start, &options).expect("a hand").expect("touches");
            let mut names: Vec<&str> =
                contacts.iter().map(|contact| hand.links[contact.point.link_idx].name.as_str()).collect();
            names.sort_unstable();
            names.dedup();
            assert_eq!(
                names,
                ["robotiq_85_left_finger_tip_link", "robotiq_85_right_finger_tip_link"],
                "{aside_m}: {contacts:?}"
            );
            middles_m.push(exploration.palm_from_object.translation.x);
        }
        assert!(middles_m.iter().all(|x| x.abs() < 5e-4), "{middles_m:?}");
    }

    /// An object of other corners, which keep their triangles.
    fn with_corners(object: &Object, faces_inwards: bool, place: impl Fn(Point3<f64>) -> Point3<f64>) -> Object {
        let mut mesh = object.to_mesh();
        mesh.vertices_m.iter_mut().for_each(|corner| *corner = place(*corner));
        if faces_inwards {
            mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        }
        let solid = solid_properties(&mesh).expect("closed");
        Object::from_mesh(object.name.clone(), object.class.clone(), &mesh, &solid, 0.3, false).expect("a mesh")
    }

    #[test]
    fn the_frame_of_the_object_does_not_matter() {
        let hand = barrett();
        let options = SimulatorOptions::default();
        let mechanism = Mechanism::new(&hand);
        let turn = Rotation3::from_euler_angles(0.4, -1.1, 2.0);
        for (idx, name) in ["mug-02", "bottle-04", "pliers-01", "fruit-03"].into_iter().enumerate() {
            let object = named(name);
            let start = draw_start(&hand, &options.protocol, &mut candidate_rng(3, idx as u64, 0));
            let turned_start = Start {
                palm_from_object_rotation: start.palm_from_object_rotation
                    * UnitQuaternion::from_rotation_matrix(&turn.inverse()),
                ..start.clone()
            };
            let here = (with_corners(&object, false, |corner| corner), start);
            let there = (with_corners(&object, false, |corner| turn * corner), turned_start);
            let [here, there] = [here, there].map(|(object, start)| {
                let (exploration, contacts) =
                    grasp(&mechanism, &object, &start, &options).expect("a hand").expect("touches");
                let quality = quality_of(&object, &exploration, &contacts);
                (exploration.posture(exploration.end), contacts, quality)
            });
            for (a, b) in here.0.iter().zip(&there.0) {
                assert!((a - b).abs() < 1e-3, "{name}: {:?} {:?}", here.0, there.0);
            }
            assert_eq!(here.1.len(), there.1.len(), "{name}");
            assert!((here.2.epsilon - there.2.epsilon).abs() < 0.01, "{name}: {:?} {:?}", here.2, there.2);
        }
    }

    /// The Barrett hand is not quite symmetric: without its offsets below 1 mm it is.
    fn symmetric_barrett() -> Hand {
        let mut hand = barrett();
        let snap = |isometry: &mut Isometry3<f64>| {
            isometry.translation.vector.apply(|value| *value = if value.abs() < 1e-3 { 0.0 } else { *value });
        };
        for link in &mut hand.links {
            snap(&mut link.parent_from_joint);
            link.shapes.iter_mut().for_each(|shape| snap(&mut shape.link_from_shape));
        }
        hand
    }

    #[test]
    fn a_mirrored_object_gives_the_mirrored_grasp() {
        let hand = symmetric_barrett();
        let options = SimulatorOptions::default();
        let mechanism = Mechanism::new(&hand);
        let open = hand.cells_in_palm(&[0.0; 7]).expect("7 joints");
        let mirrored_cell: Vec<usize> = open
            .iter()
            .map(|cell| {
                let image =
                    Point3::new(-cell.position_in_palm_m.x, cell.position_in_palm_m.y, cell.position_in_palm_m.z);
                let far = |idx: &usize| (open[*idx].position_in_palm_m - image).norm();
                (0..open.len()).min_by(|a, b| far(a).total_cmp(&far(b))).expect("cells")
            })
            .collect();
        let mirror = Reflection3::new(Vector3::x_axis(), 0.0);
        for (idx, name) in ["box-01", "can-05", "mug-04", "pliers-02", "bottle-08", "ball-06"].into_iter().enumerate() {
            let object = named(name);
            let mirrored = with_corners(&object, true, |corner| Point3::new(-corner.x, corner.y, corner.z));
            let object = with_corners(&object, false, |corner| corner);
            let start = draw_start(&hand, &options.protocol, &mut candidate_rng(11, idx as u64, 0));
            // M R M for the mirror M: the axis is mirrored, the angle turns the other way.
            let mut axis = start.palm_from_object_rotation.scaled_axis();
            mirror.reflect(&mut axis);
            let image = Start {
                palm_from_object_rotation: UnitQuaternion::from_scaled_axis(-axis),
                lateral_offset_m: [-start.lateral_offset_m[0], start.lateral_offset_m[1]],
                ..start.clone()
            };
            let [here, there] = [(&object, start), (&mirrored, image)]
                .map(|(object, start)| grasp(&mechanism, object, &start, &options).expect("a hand").expect("touches"));
            let [joints_here, joints_there] = [&here.0, &there.0].map(|found| found.posture(found.end));
            for (a, b) in [0, 2, 1, 3, 5, 4, 6].into_iter().enumerate() {
                assert!((joints_here[a] - joints_there[b]).abs() < 1e-3, "{name}: {joints_here:?} {joints_there:?}");
            }
            assert_eq!(here.1.len(), there.1.len(), "{name}");
            for contact in &here.1 {
                let mut image = contact.point.point_in_palm_m.coords;
                mirror.reflect(&mut image);
                let far = |other: &SimulatedContact| (other.point.point_in_palm_m.coords - image).norm();
                let nearest_m = there.1.iter().map(far).fold(f64::MAX, f64::min);
                assert!(nearest_m < 5e-4, "{name}: {nearest_m}");
            }
            let [cells_here, cells_there] = [&here.1, &there.1].map(|contacts| {
                let mut cells = vec![0.0; hand.n_cells()];
                for (cell_idx, newtons) in contacts.iter().flat_map(|contact| &contact.cells_newtons) {
                    cells[*cell_idx] += newtons;
                }
                cells
            });
            for (cell_idx, newtons) in cells_here.iter().enumerate() {
                let image_newtons = cells_there[mirrored_cell[cell_idx]];
                // A patch is cut into 512 pieces of 0.01 N: a few of them change sides at a cell's edge.
                assert!((newtons - image_newtons).abs() < 0.1, "{name}, cell {cell_idx}: {newtons} {image_newtons}");
            }
        }
    }
}
