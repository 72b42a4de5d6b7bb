//! The hand as bodies and motors: each closing joint a motor of limited torque, with break-away.
//!
//! While a finger closes, its leader is driven at constant speed and its followers at their ratio. A joint that lags
//! behind at its torque limit is blocked, and the rule is the simulator's (`grasp::protocol`): **a blocked link stops
//! every joint that moves it**. So a blocked leader stays and the follower goes on alone, and a blocked follower stops the
//! whole finger. A stopped joint keeps its torque; its gear holds against more than its motor can push (a worm drive is
//! not driven backwards). Before the arm lifts, the motors press with their full force; a link that broke away has none,
//! and only its gear holds it.
//!
//! A joint that other joints mimic is one motor with several axles: the two jaws of a gripper, the bars of a parallel
//! linkage. Each axle has a gear of its own, and the motor feels all of them.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rapier3d_f64::geometry::Group;
use rapier3d_f64::parry::mass_properties::MassProperties;
use rapier3d_f64::parry::shape::SharedShape;

use super::engine::{AxleCommand, BodyPlan, Engine, HandPlan, ShapePlan};
use crate::mechanism::{Mechanism, first_moved};
use crate::trial::world::MAX_LINKS_APART;
use crate::trial::{PhysicsOptions, TrialError};
use blindgrasp_stages::hand::{Hand, JointKind, Motion, pose_from_isometry};

/// A link that a motor moves, by a gear of its own.
struct Axle {
    /// The engine's axle.
    idx: usize,
    kind: JointKind,
    /// Its travel per travel of the motor.
    ratio: f64,
    /// The lever of the links that it moves, metres; 1 of a slide.
    reach: f64,
    /// Newton metres per radian, or newtons per metre of a slide.
    stiffness: f64,
}

impl Axle {
    /// The joint of a link that closes, and its axle; `None` of another link.
    fn of_link(
        mechanism: &Mechanism<'_>,
        link_idx: usize,
        idx: usize,
        options: &PhysicsOptions,
    ) -> Option<(usize, Axle)> {
        let (joint_idx, kind, multiplier) = closing_joint(mechanism, link_idx)?;
        let per_radian = kind.per_radian();
        let axle = Axle {
            idx,
            kind,
            ratio: multiplier.abs(),
            reach: if kind == JointKind::Prismatic { 1.0 } else { reach_m(mechanism.hand, link_idx) },
            stiffness: options.gear_stiffness / (per_radian * per_radian),
        };
        Some((joint_idx, axle))
    }
}

/// A joint with its motor. Its travel is measured from the open joint on, and grows as it closes: radians, or metres of a
/// slide.
#[derive(Default)]
struct Drive {
    /// Index into [`Hand::joints`].
    joint_idx: usize,
    /// The joint's own, and those of the joints that mimic it. There is at least one.
    axles: Vec<Axle>,
    /// Of another drive, which it follows until that one is blocked.
    follows: Option<usize>,
    /// Travel while a leader closes by a radian.
    rate: f64,
    open: f64,
    /// The change of the joint's value with its travel: 1 or -1.
    sign: f64,
    /// How far it can close.
    range: f64,
    /// Largest torque or force of the motor, at each newton at the fingertips.
    lever: f64,
    /// Largest torque or force of the motor.
    limit: f64,
    /// Where the motor is; its gears give by the difference to the axles.
    target: f64,
    /// Speed of the target while the joint closes. It is 0 when the target waits for the joint.
    target_speed: f64,
    /// Of all gears together, as the motor feels it.
    stiffness: f64,
    is_stopped: bool,
    /// It was blocked while its follower could go on: the motor has let go of it for good.
    has_broken_away: bool,
    lagging_secs: f64,
    /// The force at the tip with which it grips.
    grip_newtons: f64,
}

impl Drive {
    /// A motor with its first axle, whose force [`Drive::add_up`] sets.
    fn new(hand: &Hand, joint_idx: usize, open: f64, axle: Axle) -> Drive {
        let spec = &hand.joints[joint_idx];
        let rate = hand.closing_rate(joint_idx);
        let sign = if rate < 0.0 { -1.0 } else { 1.0 };
        Drive {
            joint_idx,
            axles: vec![axle],
            rate: rate.abs(),
            open,
            sign,
            range: if sign < 0.0 { open - spec.lower } else { spec.upper - open }.max(0.0),
            ..Drive::default()
        }
    }

    /// Sets the stiffness and the force of the motor, once it has all its axles.
    fn add_up(&mut self, mechanism: &Mechanism<'_>, palm_from_links: &[Isometry3<f64>], options: &PhysicsOptions) {
        self.stiffness = self.axles.iter().map(|axle| axle.ratio * axle.ratio * axle.stiffness).sum();
        if self.axles.len() > 1 {
            self.lever = lever(mechanism, self.joint_idx, palm_from_links);
        }
        // Fingers without pads have no speed.
        if self.lever == 0.0 {
            self.lever = self.axles.iter().map(|axle| axle.ratio * axle.reach).fold(0.0, f64::max);
        }
        self.limit = options.grip_newtons * self.lever;
    }

    /// A motor has one rotor, whose inertia its axles share.
    fn share_rotor(&self, bodies: &mut [BodyPlan], options: &PhysicsOptions) {
        let whole: f64 = self.axles.iter().map(|axle| axle.ratio * axle.ratio).sum();
        for axle in &self.axles {
            let per_radian = axle.kind.per_radian();
            bodies[axle.idx].armature = options.rotor_inertia / whole / (per_radian * per_radian);
        }
    }

    /// Stops, and keeps pressing with at most its largest torque.
    fn stop(&mut self, travel: f64) {
        if !self.is_stopped {
            self.is_stopped = true;
            self.target = self.target.min(travel + self.limit / self.stiffness);
        }
    }

    /// Where the motor would be if its gears did not give: the mean of the axles, weighted by their stiffness as the motor feels it.
    fn travel(&self, engine: &dyn Engine) -> f64 {
        match &self.axles[..] {
            [axle] => engine.travel(axle.idx) / axle.ratio,
            axles => {
                let felt = axles.iter().map(|axle| axle.ratio * axle.stiffness * engine.travel(axle.idx)).sum::<f64>();
                felt / self.stiffness
            }
        }
    }
}

/// The motors of a hand.
pub(super) struct HandBody {
    drives: Vec<Drive>,
    n_axles: usize,
    open_joints: Vec<f64>,
}

impl HandBody {
    /// The hand's bodies for an engine, and the motors that move them.
    ///
    /// # Errors
    /// A hand of more links than an engine tells apart.
    pub(super) fn new(
        mechanism: &Mechanism<'_>,
        open_joints: &[f64],
        options: &PhysicsOptions,
    ) -> Result<(HandPlan, HandBody), TrialError> {
        let hand = mechanism.hand;
        let palm_from_links = hand.palm_from_links(open_joints).map_err(|error| TrialError::hand(hand, error))?;
        let mut plan = HandPlan::default();
        let mut placed = LinkBodies { hand, bodies: Vec::new(), body_from_links: Vec::new() };
        let mut drives: Vec<Drive> = Vec::new();
        for (link_idx, link) in hand.links.iter().enumerate() {
            let palm_from_link = palm_from_links[link_idx];
            let parent = link.parent_idx.and_then(|parent_idx| placed.bodies[parent_idx]);
            let joint_from_link = link.motion.joint_from_link(open_joints);
            let Some((joint_idx, axle)) = Axle::of_link(mechanism, link_idx, plan.bodies.len(), options) else {
                let parent_from_link = link.parent_from_joint * joint_from_link;
                placed.bodies.push(parent);
                placed.body_from_links.push(match link.parent_idx {
                    Some(parent_idx) if parent.is_some() => placed.body_from_links[parent_idx] * parent_from_link,
                    _ => palm_from_link,
                });
                continue;
            };
            let parent_from_joint = match link.parent_idx {
                None => link.parent_from_joint,
                Some(parent_idx) => placed.body_from_links[parent_idx] * link.parent_from_joint,
            };
            let body_from_axis = body_from_axis(hand, &link.motion);
            placed.bodies.push(Some(axle.idx));
            placed.body_from_links.push(Isometry3::identity());
            plan.bodies.push(BodyPlan {
                parent,
                palm_from_body: palm_from_link,
                kind: axle.kind,
                parent_from_axis: parent_from_joint * (joint_from_link * body_from_axis),
                body_from_axis,
                mass: body_mass(mechanism, link_idx, open_joints, options),
                armature: 0.0,
            });
            match drives.iter_mut().find(|drive| drive.joint_idx == joint_idx) {
                Some(drive) => drive.axles.push(axle),
                None => drives.push(Drive::new(hand, joint_idx, open_joints[joint_idx], axle)),
            }
        }
        for drive in &mut drives {
            drive.add_up(mechanism, &palm_from_links, options);
            drive.share_rotor(&mut plan.bodies, options);
        }
        for idx in 0..drives.len() {
            if let Some(coupling) = hand.joints[drives[idx].joint_idx].coupling {
                drives[idx].follows = drives.iter().position(|drive| drive.joint_idx == coupling.follows_idx);
            }
        }
        plan.shapes = placed.shapes(mechanism, &palm_from_links)?;
        let n_axles = plan.bodies.len();
        Ok((plan, HandBody { drives, n_axles, open_joints: open_joints.to_vec() }))
    }

    /// Holds the open hand.
    pub(super) fn hold(&self, engine: &mut dyn Engine, options: &PhysicsOptions) {
        self.command(engine, 0.0, options);
    }

    /// The joints' values: radians, or metres of a slide.
    pub(super) fn joints(&self, engine: &dyn Engine) -> Vec<f64> {
        self.values(|drive| drive.travel(engine))
    }

    /// The encoders' values before rounding: they sit at the motors, whose gears give.
    pub(super) fn motors_rad(&self) -> Vec<f64> {
        self.values(|drive| drive.target)
    }

    fn values(&self, travel: impl Fn(&Drive) -> f64) -> Vec<f64> {
        let mut values = self.open_joints.clone();
        for drive in &self.drives {
            values[drive.joint_idx] = drive.open + drive.sign * travel(drive);
        }
        values
    }

    /// The torque of each joint's motor or gear, from the gear's twist, newton metres; of a slide the force, newtons. It is
    /// 0 of a joint without a motor.
    pub(super) fn torques(&self, engine: &dyn Engine) -> Vec<f64> {
        let mut torques = vec![0.0; self.open_joints.len()];
        for drive in &self.drives {
            torques[drive.joint_idx] = drive.sign * ((drive.target - drive.travel(engine)) * drive.stiffness);
        }
        torques
    }

    /// Closes on for a time step; whether every joint has stopped.
    pub(super) fn close(&mut self, engine: &mut dyn Engine, options: &PhysicsOptions) -> bool {
        let dt = options.step_secs;
        for idx in 0..self.drives.len() {
            let travel = self.drives[idx].travel(engine);
            let drive = &mut self.drives[idx];
            if drive.is_stopped {
                continue;
            }
            let lag = drive.target - travel;
            let is_lagging = lag * drive.stiffness >= drive.limit;
            drive.lagging_secs = if is_lagging { drive.lagging_secs + dt } else { 0.0 };
            let is_blocked = drive.lagging_secs >= options.blocked_secs;
            let is_at_limit = drive.target >= drive.range;
            if is_blocked || is_at_limit {
                drive.stop(travel);
                let leader = if is_blocked { drive.follows } else { None };
                if let Some(leader) = leader {
                    let travel = self.drives[leader].travel(engine);
                    self.drives[leader].stop(travel);
                }
                let mut followers = self.drives.iter().filter(|other| other.follows == Some(idx));
                let goes_on = followers.any(|follower| !follower.is_stopped);
                self.drives[idx].has_broken_away = is_blocked && goes_on;
                continue;
            }
            let most = travel + 1.2 * drive.limit / drive.stiffness;
            let step = drive.rate * options.closing_rad_per_sec * dt;
            // Its target waits for the joint: no further ahead of it than to be sure that it lags.
            let before = drive.target;
            drive.target = (before + step).min(most.max(before)).min(drive.range);
            drive.target_speed = (drive.target - before) / dt;
        }
        let all_stopped = self.drives.iter().all(|drive| drive.is_stopped);
        self.command(engine, if all_stopped { 0.0 } else { options.closing_rad_per_sec }, options);
        all_stopped
    }

    /// Stops every joint that has not stopped yet.
    pub(super) fn stop(&mut self, engine: &mut dyn Engine, options: &PhysicsOptions) {
        for drive in &mut self.drives {
            drive.stop(drive.travel(engine));
        }
        self.command(engine, 0.0, options);
    }

    /// Grips on for a time step, with a part of the way to the force of lifting: from 0, as it closed, to 1.
    pub(super) fn grip(&mut self, engine: &mut dyn Engine, part: f64, options: &PhysicsOptions) {
        let more_newtons = (options.lift_grip_newtons - options.grip_newtons).max(0.0) * part;
        for drive in &mut self.drives {
            drive.grip_newtons = options.grip_newtons + more_newtons;
        }
        self.hold_force(engine, options);
    }

    /// Each motor is to grip with a part of the way from the force that it has to that of lifting.
    pub(super) fn tighten(&mut self, engine: &dyn Engine, part: f64, options: &PhysicsOptions) {
        for drive in &mut self.drives {
            let twisted = (drive.target - drive.travel(engine)) * drive.stiffness;
            let newtons = (twisted / drive.lever).clamp(0.0, options.lift_grip_newtons);
            drive.grip_newtons = newtons + part * (options.lift_grip_newtons - newtons);
        }
    }

    /// Grips on for a time step with the force that each motor is to have. Where the target gives, the joint closes on. A joint
    /// that has broken away, or is at its limit, stays.
    pub(super) fn hold_force(&mut self, engine: &mut dyn Engine, options: &PhysicsOptions) {
        for drive in &mut self.drives {
            let travel = drive.travel(engine);
            drive.stop(travel);
            if drive.has_broken_away || drive.target >= drive.range {
                continue;
            }
            let twisted = travel + drive.grip_newtons * drive.lever / drive.stiffness;
            let step = drive.rate * options.closing_rad_per_sec * options.step_secs;
            // It never goes back: the gear is not driven backwards.
            let closed = (drive.target + step).min(twisted).min(drive.range);
            drive.target = drive.target.max(closed);
        }
        self.command(engine, 0.0, options);
    }

    fn command(&self, engine: &mut dyn Engine, rad_per_sec: f64, options: &PhysicsOptions) {
        let still = AxleCommand { target: 0.0, speed: 0.0, stiffness: 0.0, damping: 0.0, most: 0.0 };
        let mut commands = vec![still; self.n_axles];
        for drive in &self.drives {
            // A linkage is rigid: its gears hold with more than the motor has. What limits them is the target, which waits, and
            // must not go on by its speed.
            let (speed, newtons) = match (drive.is_stopped, drive.axles.len()) {
                (true, _) => (0.0, options.hold_newtons),
                (false, 1) => (drive.rate * rad_per_sec, options.grip_newtons),
                (false, _) => (drive.target_speed, options.hold_newtons),
            };
            for axle in &drive.axles {
                let per_radian = axle.kind.per_radian();
                commands[axle.idx] = AxleCommand {
                    target: axle.ratio * drive.target,
                    speed: axle.ratio * speed,
                    stiffness: axle.stiffness,
                    damping: options.gear_damping / (per_radian * per_radian),
                    most: newtons * axle.reach,
                };
            }
        }
        engine.drive(&commands);
    }
}

/// The bodies of a hand's links.
struct LinkBodies<'a> {
    hand: &'a Hand,
    /// The body of each link, `None` for the palm.
    bodies: Vec<Option<usize>>,
    /// Where each link is on its body.
    body_from_links: Vec<Isometry3<f64>>,
}

impl LinkBodies<'_> {
    /// The body that a link's body hangs on.
    fn body_above(&self, link_idx: usize) -> Option<usize> {
        let mut above_idx = link_idx;
        while self.bodies[above_idx] == self.bodies[link_idx] {
            above_idx = self.hand.links[above_idx].parent_idx?;
        }
        self.bodies[above_idx]
    }

    fn are_joined(&self, a: usize, b: usize) -> bool {
        let (body_a, body_b) = (self.bodies[a], self.bodies[b]);
        body_a == body_b || self.body_above(a) == body_b || self.body_above(b) == body_a
    }

    /// Whether link `b` must not touch link `a`.
    fn leaves_out(&self, mechanism: &Mechanism<'_>, a: usize, b: usize, palm_from_links: &[Isometry3<f64>]) -> bool {
        if self.are_joined(a, b) {
            return self.bodies[a].is_some() && self.bodies[b].is_none();
        }
        let closest = mechanism.closest_of_links(a, b, palm_from_links);
        closest.is_some_and(|closest| closest.points.distance_m <= 0.0)
    }

    /// For each link its collision group, and those of the links that it may touch. These are all but those that it overlaps in
    /// the open hand, which are built into each other, and those on the palm that a joint joins to it. The engine itself
    /// disables the contacts of other joined links. A contact takes two links that may touch each other, so one of them is
    /// enough to rule it out. Links that are left out by the same links share a group. `None` if there are too few groups.
    fn groups(&self, mechanism: &Mechanism<'_>, palm_from_links: &[Isometry3<f64>]) -> Option<Vec<(Group, Group)>> {
        let n_links = self.bodies.len();
        let with_shapes: Vec<usize> = (0..n_links).filter(|idx| !self.hand.links[*idx].shapes.is_empty()).collect();
        let mut left_out_by: Vec<Vec<usize>> = vec![Vec::new(); n_links];
        for (idx, by) in left_out_by.iter_mut().enumerate() {
            by.extend(with_shapes.iter().filter(|other| self.leaves_out(mechanism, **other, idx, palm_from_links)));
        }
        // The empty one comes first: that of the links which nothing leaves out.
        let by_none = Vec::new();
        let mut kinds: Vec<&Vec<usize>> = vec![&by_none];
        kinds.extend(with_shapes.iter().map(|idx| &left_out_by[*idx]));
        kinds.sort();
        kinds.dedup();
        if kinds.len() > MAX_LINKS_APART as usize {
            return None;
        }
        let mut own = vec![Group::NONE; n_links];
        for idx in with_shapes {
            if let Some(kind) = kinds.iter().position(|kind| **kind == left_out_by[idx]) {
                own[idx] = Group::from_bits_truncate(1 << kind);
            }
        }
        let all = own.iter().fold(Group::NONE, |all, group| all | *group);
        let mut groups: Vec<(Group, Group)> = own.iter().map(|own| (*own, all)).collect();
        for (other, by) in left_out_by.iter().enumerate() {
            for idx in by {
                groups[*idx].1 &= !own[other];
            }
        }
        Some(groups)
    }

    /// The shapes of the hand on their bodies.
    fn shapes(
        &self,
        mechanism: &Mechanism<'_>,
        palm_from_links: &[Isometry3<f64>],
    ) -> Result<Vec<ShapePlan>, TrialError> {
        let Some(groups) = self.groups(mechanism, palm_from_links) else {
            let n = MAX_LINKS_APART - 1;
            let reason = format!(
                "more than {n} links overlap others in the open hand, which no joint joins: give another open hand (--open of \
                 new hand), or simpler collision shapes"
            );
            return Err(TrialError::hand(self.hand, reason));
        };
        let mut shapes = Vec::with_capacity(mechanism.shapes.len());
        for (shape_idx, placed) in mechanism.shapes.iter().enumerate() {
            let link_idx = placed.link_idx;
            let (own, touched) = groups[link_idx];
            shapes.push(ShapePlan {
                shape_idx,
                link_idx,
                body: self.bodies[link_idx],
                body_from_shape: self.body_from_links[link_idx] * placed.link_from_shape,
                core: SharedShape(placed.core.clone_dyn().into()),
                edge_radius_m: placed.edge_radius_m,
                own,
                touched,
            });
        }
        Ok(shapes)
    }
}

/// The motor's torque or force for each newton at the fingertips that a joint with several links moves. It is the sum
/// of the speeds of the fingers, each that of the fastest middle of a pad, per speed of the joint.
fn lever(mechanism: &Mechanism<'_>, joint_idx: usize, palm_from_links: &[Isometry3<f64>]) -> f64 {
    let hand = mechanism.hand;
    let mut fingers: Vec<(usize, f64)> = Vec::new();
    for pad in &hand.pads {
        let Some(finger) = first_moved(hand, pad.link_idx, joint_idx) else { continue };
        let middle = palm_from_links[pad.link_idx] * pad.middle_in_link_m();
        let speed = mechanism.velocity_of_joint(pad.link_idx, &middle, joint_idx, palm_from_links).norm();
        match fingers.iter_mut().find(|(other, _)| *other == finger) {
            Some((_, most)) => *most = most.max(speed),
            None => fingers.push((finger, speed)),
        }
    }
    fingers.iter().map(|(_, speed)| speed).sum()
}

/// The lever of a link's tip: the distance from its joint to the farthest point of the straight finger.
fn reach_m(hand: &Hand, link_idx: usize) -> f64 {
    let mut farthest_m: f64 = 0.0;
    for shape in &hand.links[link_idx].shapes {
        let sphere = shape.core.compute_local_bounding_sphere();
        let centre = shape.link_from_shape * nalgebra::Point3::new(sphere.center.x, sphere.center.y, sphere.center.z);
        farthest_m = farthest_m.max(centre.coords.norm() + sphere.radius);
    }
    for (child_idx, child) in hand.links.iter().enumerate().filter(|(_, link)| link.parent_idx == Some(link_idx)) {
        farthest_m = farthest_m.max(child.parent_from_joint.translation.vector.norm() + reach_m(hand, child_idx));
    }
    farthest_m
}

/// The joint of a link that closes, and how the link moves with it. `None` of a link that is fixed while the hand closes.
fn closing_joint(mechanism: &Mechanism<'_>, link_idx: usize) -> Option<(usize, JointKind, f64)> {
    let Motion::Joint { joint_idx, kind, multiplier, .. } = mechanism.hand.links[link_idx].motion else { return None };
    let closes = mechanism.joints.iter().any(|joint| joint.joint_idx == joint_idx);
    closes.then_some((joint_idx, kind, multiplier))
}

/// Turns x to the axis of a link that moves, in the direction of closing.
fn body_from_axis(hand: &Hand, motion: &Motion) -> Isometry3<f64> {
    let Motion::Joint { joint_idx, multiplier, axis, .. } = *motion else { return Isometry3::identity() };
    let sign = if hand.closing_rate(joint_idx) < 0.0 { -1.0 } else { 1.0 };
    let closing_axis = if sign * multiplier < 0.0 { -axis } else { axis };
    let x_to_axis = UnitQuaternion::rotation_between(&Vector3::x(), &closing_axis)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI));
    Isometry3::from_parts(Default::default(), x_to_axis)
}

/// The mass of a link's shapes and of those of the links that are fixed on it, overlaps counted twice. Rotors are heavier
/// than links: see [`PhysicsOptions::rotor_inertia`].
fn body_mass(
    mechanism: &Mechanism<'_>,
    link_idx: usize,
    open_joints: &[f64],
    options: &PhysicsOptions,
) -> MassProperties {
    let mut parts: Vec<MassProperties> = Vec::new();
    for shape in &mechanism.hand.links[link_idx].shapes {
        let mass = SharedShape::clone(&shape.core).mass_properties(options.link_density_kg_per_m3);
        parts.push(mass.transform_by(&pose_from_isometry(&shape.link_from_shape)));
    }
    for (child_idx, child) in mechanism.hand.links.iter().enumerate() {
        if child.parent_idx == Some(link_idx) && closing_joint(mechanism, child_idx).is_none() {
            let link_from_child = child.parent_from_joint * child.motion.joint_from_link(open_joints);
            let mass = body_mass(mechanism, child_idx, open_joints, options);
            parts.push(mass.transform_by(&pose_from_isometry(&link_from_child)));
        }
    }
    parts.into_iter().sum()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::trial::LiftTarget;
    use crate::trial::world::{World, to_engine};
    use blindgrasp_objects::Object;

    /// The hand, open, before a ball that nothing moves, its middle so far from the palm's frame along z; no gravity.
    fn before_a_ball(radius_m: f64, middle_m: f64, test: impl FnOnce(&mut World, &mut HandBody, &PhysicsOptions)) {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        with_a_ball(&hand, radius_m, [0.0, 0.0, middle_m], 1e4, test);
    }

    /// As [`before_a_ball`], with any hand, and a ball of that mass anywhere in the palm frame.
    fn with_a_ball(
        hand: &Hand,
        radius_m: f64,
        [x, y, z]: [f64; 3],
        mass_kg: f64,
        test: impl FnOnce(&mut World, &mut HandBody, &PhysicsOptions),
    ) {
        let (mechanism, options) = (Mechanism::new(hand), PhysicsOptions::default());
        let object = Object::new("ball".into(), "ball".into(), SharedShape::ball(radius_m), 1000.0, false);
        let target = LiftTarget::new(Object { mass_kg, ..object }, 1.0);
        // The stand is far away.
        let palm_from_world = Isometry3::translation(0.0, 0.0, -5.0);
        let world_from_target = Isometry3::translation(x, y, 5.0 + z);
        let (plan, mut body) = HandBody::new(&mechanism, &hand.open_joints(), &options).expect("a hand");
        let mut world = World::new(&target, &world_from_target, &palm_from_world, &plan, &options).expect("a world");
        world.engine.gravity = to_engine(&Vector3::zeros());
        body.hold(&mut world, &options);
        test(&mut world, &mut body, &options);
    }

    fn close_until_stopped(world: &mut World, body: &mut HandBody, options: &PhysicsOptions) {
        for _ in 0..2000 {
            world.step();
            if body.close(world, options) {
                (0..60).for_each(|_| world.step());
                return;
            }
        }
        panic!("it never stops");
    }

    /// What a motor presses with, through its gear, of what makes `newtons` at the tip.
    fn part_of(newtons: f64, world: &World, drive: &Drive) -> f64 {
        (drive.target - drive.travel(world)) * drive.stiffness / (newtons * drive.lever)
    }

    #[test]
    fn a_hand_that_nothing_stops_closes_to_its_limits_with_its_joints_coupled() {
        before_a_ball(0.01, 1.0, |world, body, options| {
            for _ in 0..100 {
                world.step();
                body.close(world, options);
            }
            for drive in &body.drives {
                let Some(leader) = drive.follows else { continue };
                let (own, of_leader) = (drive.travel(world), body.drives[leader].travel(world));
                assert!(of_leader > 0.3 && (own - drive.rate * of_leader).abs() < 0.02, "{own} {of_leader}");
            }
            close_until_stopped(world, body, options);
            assert!(body.drives.iter().all(|drive| !drive.has_broken_away));
            for drive in &body.drives {
                assert!((drive.travel(world) - drive.range).abs() < 0.02);
            }
        });
    }

    #[test]
    fn a_blocked_link_breaks_away_and_no_motor_presses_with_more_than_it_has() {
        // It lies a little above the palm and fills the hand: the inner links come to it well before the outer ones.
        before_a_ball(0.05, 0.14, |world, body, options| {
            close_until_stopped(world, body, options);
            let n_broken_away = body.drives.iter().filter(|drive| drive.has_broken_away).count();
            assert!(n_broken_away > 0);
            for drive in &body.drives {
                let part = part_of(options.grip_newtons, world, drive);
                // Other links may push a stopped joint back: its gear holds against that.
                let most = options.hold_newtons / options.grip_newtons;
                assert!(
                    part < 1.03 * most && (part < 1.3 || drive.has_broken_away),
                    "presses with {part} of what it has"
                );
                let Some(leader) = drive.follows.map(|leader| &body.drives[leader]) else { continue };
                let (own, coupled) = (drive.travel(world), drive.rate * leader.travel(world));
                assert!(!leader.has_broken_away || own > coupled + 0.3, "{own} rad, coupled {coupled} rad");
            }
            let before: Vec<f64> = body.drives.iter().map(|drive| drive.target).collect();
            grip(world, body, options);
            for (drive, before_rad) in body.drives.iter().zip(before) {
                if drive.has_broken_away {
                    assert_eq!(drive.target, before_rad, "no motor drives a joint that has broken away");
                }
            }
        });
    }

    #[test]
    fn gripping_never_lets_go_and_reaches_the_motors_full_force() {
        before_a_ball(0.05, 0.13, |world, body, options| {
            close_until_stopped(world, body, options);
            let before: Vec<f64> = body.drives.iter().map(|drive| drive.target).collect();
            grip(world, body, options);
            assert!(body.drives.iter().zip(before).all(|(drive, before_rad)| drive.target >= before_rad));
            let parts = body.drives.iter().filter(|drive| !drive.has_broken_away);
            let parts: Vec<f64> = parts.map(|drive| part_of(options.lift_grip_newtons, world, drive)).collect();
            assert!(parts.iter().any(|part| *part >= 0.97), "{parts:?}");
        });
    }

    #[test]
    fn jaws_centre_a_ball_and_press_alike_from_both_sides() {
        let hand = Hand::load(Path::new("parallel-gripper")).expect("built in");
        // 15 mm nearer to the left jaw, which pushes it to the right one.
        with_a_ball(&hand, 0.02, [0.0, 0.015, 0.04], 0.2, |world, body, options| {
            close_until_stopped(world, body, options);
            grip(world, body, options);
            let ball = world.palm_from_target().translation.vector;
            assert!(ball.y.abs() < 0.001, "{ball}");
            assert!((body.joints(world)[0] - 0.02).abs() < 0.001, "{:?}", body.joints(world));
            let touches = world.touches();
            let newtons: Vec<f64> = touches.iter().map(|touch| touch.newtons).collect();
            assert_eq!(touches.len(), 2, "{newtons:?}");
            let wanted = options.lift_grip_newtons;
            assert!(newtons.iter().all(|found| (found - wanted).abs() < 0.1 * wanted), "{newtons:?}");
        });
    }

    #[test]
    fn jaws_tighten_in_equal_steps_and_hold_the_force_of_each() {
        let hand = Hand::load(Path::new("parallel-gripper")).expect("built in");
        with_a_ball(&hand, 0.02, [0.0, 0.0, 0.04], 0.2, |world, body, options| {
            close_until_stopped(world, body, options);
            for n_left in [3.0, 2.0, 1.0] {
                let before: Vec<f64> = body.drives.iter().map(|drive| part_of(1.0, world, drive)).collect();
                body.tighten(world, 1.0 / n_left, options);
                for _ in 0..200 {
                    body.hold_force(world, options);
                    world.step();
                }
                for (drive, before) in body.drives.iter().zip(before) {
                    let wanted = before + (options.lift_grip_newtons - before) / n_left;
                    let found = part_of(1.0, world, drive);
                    assert!((found - wanted).abs() < 0.05 * wanted, "{n_left} steps left: {before}, {found}, {wanted}");
                }
            }
        });
    }

    /// Two fingers of a parallel linkage, as of the 2F-85: their tips keep their direction while the knuckles turn.
    const LINKAGE: &str = r#"<robot name="linkage">
<link name="palm"><collision><origin xyz="0 0 -0.03"/><geometry><box size="0.06 0.07 0.06"/></geometry></collision></link>
<link name="left_knuckle"/><link name="right_knuckle"/>
<link name="left_tip"><collision><origin xyz="0 0.006 0.025"/><geometry><box size="0.022 0.012 0.05"/></geometry></collision></link>
<link name="right_tip"><collision><origin xyz="0 -0.006 0.025"/><geometry><box size="0.022 0.012 0.05"/></geometry></collision></link>
<joint name="finger" type="revolute"><parent link="palm"/><child link="left_knuckle"/><origin xyz="0 0.02 0.01" rpy="-0.8 0 0"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.9"/></joint>
<joint name="left_bar" type="revolute"><parent link="left_knuckle"/><child link="left_tip"/><origin xyz="0 0 0.06" rpy="0.8 0 0"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1"/><mimic joint="finger" multiplier="-1"/></joint>
<joint name="right_finger" type="revolute"><parent link="palm"/><child link="right_knuckle"/>
<origin xyz="0 -0.02 0.01" rpy="0.8 0 0"/><axis xyz="-1 0 0"/><limit lower="0" upper="0.9"/><mimic joint="finger"/></joint>
<joint name="right_bar" type="revolute"><parent link="right_knuckle"/><child link="right_tip"/><origin xyz="0 0 0.06" rpy="-0.8 0 0"/>
<axis xyz="-1 0 0"/><limit lower="-1" upper="1"/><mimic joint="finger" multiplier="-1"/></joint></robot>"#;

    fn linkage() -> Hand {
        let cell = "size_m: [0.009, 0.005], along: [0, 0, 1], at_m: [0, 0, 0.03]";
        let layout = format!(
            "format: blindgrasp-hand/1\nname: linkage\nurdf: linkage.urdf\nreference_link: palm\njoints: [finger]\n\
             edge_radius_m: 0.002\npads:\n\
             \x20 - {{name: left, link: left_tip, layout: left, noise_threshold_newtons: 0.05}}\n\
             \x20 - {{name: right, link: right_tip, layout: right, noise_threshold_newtons: 0.05}}\n\
             layouts:\n  left:\n    - {{normal: [0, -1, 0], {cell}}}\n  right:\n    - {{normal: [0, 1, 0], {cell}}}\n"
        );
        Hand::parse(Path::new("linkage.yaml"), &layout, |_| Ok(LINKAGE.into())).expect("a hand")
    }

    #[test]
    fn the_tips_of_a_parallel_linkage_stay_parallel_under_load() {
        let hand = linkage();
        with_a_ball(&hand, 0.02, [0.0, 0.0, 0.085], 0.2, |world, body, options| {
            close_until_stopped(world, body, options);
            grip(world, body, options);
            let touches = world.touches();
            let newtons: Vec<f64> = touches.iter().map(|touch| touch.newtons).collect();
            // The motor's torque is that of the full force for a tip that moves straight at the object. The knuckles are
            // still turned outwards by so much, so that the tips move slower towards it and press harder.
            let outwards_rad = 0.8 - body.joints(world)[0];
            let wanted = options.lift_grip_newtons / outwards_rad.cos();
            assert!(touches.len() == 2, "{newtons:?}");
            assert!(newtons.iter().all(|found| (found - wanted).abs() < 0.02 * wanted), "{newtons:?} {wanted}");
            for axle in body.drives.iter().flat_map(|drive| &drive.axles) {
                let off_rad = world.travel(axle.idx) - axle.ratio * body.drives[0].travel(world);
                assert!(off_rad.abs() < 0.02, "{off_rad}");
            }
        });
    }

    /// Grips for a second.
    fn grip(world: &mut World, body: &mut HandBody, options: &PhysicsOptions) {
        for step in 0..200 {
            body.grip(world, f64::from(step.min(60)) / 60.0, options);
            world.step();
        }
    }
}
