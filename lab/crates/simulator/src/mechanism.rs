//! A hand as the protocol moves it: the joints that close, the links that they move, and the links that may touch.

use std::ops::Range;

use nalgebra::{Isometry3, Point3, Vector3};
use parry3d_f64::math::Vector;

use super::distance::{ClosestPoints, PlacedShape};
use blindgrasp_stages::hand::{Hand, JointKind, Motion};

/// A joint that closes.
#[derive(Debug, Clone)]
pub struct ClosingJoint {
    /// Index into [`Hand::joints`].
    pub joint_idx: usize,
    /// Change of its value per unit of progress: of a leader a radian, or 0.1 m of a slide, towards its closed limit; of a
    /// follower the coupling's ratio of that.
    pub rate: f64,
    /// The progress at which the joint stops.
    pub end: f64,
}

/// A hand prepared for exploring.
pub struct Mechanism<'a> {
    pub hand: &'a Hand,
    /// Link after link.
    pub shapes: Vec<PlacedShape<'a>>,
    /// Per link: its shapes, as indices into `shapes`.
    shapes_of_links: Vec<Range<usize>>,
    pub joints: Vec<ClosingJoint>,
    /// Per link: the closing joints that move it.
    movers: Vec<Vec<Mover>>,
    /// Per link: a bound on the speed of its points while everything closes, metres per unit of progress.
    pub(super) top_speed: Vec<f64>,
    /// Per closing joint: the links of each finger that it moves by itself. More than one finger: mimic joints.
    pub(super) fingers: Vec<Vec<Vec<usize>>>,
    /// Links that may come to touch each other while closing.
    pub pairs: Vec<(usize, usize)>,
}

/// The closest points of two links.
#[derive(Clone, Copy)]
pub(super) struct ClosestLinks {
    pub(super) points: ClosestPoints,
    /// Indices into [`Mechanism::shapes`].
    pub(super) shape_idxs: [usize; 2],
}

struct Mover {
    /// Index into `Mechanism::joints`.
    closing_idx: usize,
    /// The link that the joint moves; the mover's link hangs on it.
    moved_link_idx: usize,
    kind: JointKind,
    multiplier: f64,
    axis: Vector3<f64>,
}

impl Mover {
    /// It is the same for the links that a joint moves together.
    fn key(&self) -> (usize, usize) {
        (self.closing_idx, self.moved_link_idx)
    }

    /// A bound on the speed of the points of its link, which lie within a radius of the link's origin.
    fn top_speed(&self, hand: &Hand, joints: &[ClosingJoint], link_idx: usize, radius_m: f64) -> f64 {
        let rate = (joints[self.closing_idx].rate * self.multiplier).abs();
        if self.kind == JointKind::Prismatic {
            return rate;
        }
        let mut reach_m = radius_m;
        let mut idx = link_idx;
        while idx != self.moved_link_idx {
            reach_m += hand.links[idx].parent_from_joint.translation.vector.norm() + slide_m(hand, idx);
            idx = hand.links[idx].parent_idx.unwrap_or(self.moved_link_idx);
        }
        rate * reach_m
    }

    /// Velocity of a point of the mover's link in the palm frame, for a speed of the joint.
    fn velocity(&self, point: &Point3<f64>, speed: f64, palm_from_links: &[Isometry3<f64>]) -> Vector3<f64> {
        let palm_from_moved = &palm_from_links[self.moved_link_idx];
        let motion = palm_from_moved.rotation * self.axis * speed;
        match self.kind {
            JointKind::Revolute => motion.cross(&(point.coords - palm_from_moved.translation.vector)),
            JointKind::Prismatic => motion,
        }
    }
}

impl<'a> Mechanism<'a> {
    /// Prepares a hand.
    pub fn new(hand: &'a Hand) -> Self {
        let joints: Vec<ClosingJoint> = hand
            .joints
            .iter()
            .enumerate()
            .filter(|(_, joint)| !joint.is_preshape)
            .map(|(joint_idx, _)| ClosingJoint {
                joint_idx,
                rate: hand.closing_rate(joint_idx),
                end: hand.closing_end(joint_idx),
            })
            .collect();
        let shapes: Vec<PlacedShape<'a>> = hand
            .links
            .iter()
            .enumerate()
            .flat_map(|(link_idx, link)| link.shapes.iter().map(move |shape| PlacedShape::new(link_idx, shape)))
            .collect();
        let mut end = 0;
        let ranges = hand.links.iter().map(|link| {
            end += link.shapes.len();
            end - link.shapes.len()..end
        });
        let shapes_of_links = ranges.collect();
        let movers: Vec<Vec<Mover>> = (0..hand.links.len()).map(|link_idx| movers(hand, &joints, link_idx)).collect();
        let top_speed = (0..hand.links.len())
            .map(|link_idx| {
                let radius_m = shapes
                    .iter()
                    .filter(|shape| shape.link_idx == link_idx)
                    .map(|shape| shape.centre_in_link.coords.norm() + shape.radius_m)
                    .fold(0.0, f64::max);
                movers[link_idx].iter().map(|mover| mover.top_speed(hand, &joints, link_idx, radius_m)).sum()
            })
            .collect();
        let fingers = joints.iter().map(|joint| fingers(hand, joint.joint_idx)).collect();
        let mut mechanism =
            Mechanism { hand, shapes, shapes_of_links, joints, movers, top_speed, fingers, pairs: Vec::new() };
        mechanism.pairs = mechanism.pairs();
        mechanism
    }

    /// The progress at which a link came to its final place.
    pub(super) fn settled_at(&self, link_idx: usize, joints: &[ClosingJoint]) -> f64 {
        self.movers[link_idx].iter().map(|mover| joints[mover.closing_idx].end).fold(0.0, f64::max)
    }

    /// Stops every joint that moves `link_idx`, except the joints that move `except` as well.
    pub(super) fn stop(&self, joints: &mut [ClosingJoint], progress: f64, link_idx: usize, except: Option<usize>) {
        for mover in &self.movers[link_idx] {
            let theirs = except.map_or(&[][..], |other| &self.movers[other][..]);
            if !theirs.iter().any(|theirs| theirs.key() == mover.key()) {
                let joint = &mut joints[mover.closing_idx];
                joint.end = joint.end.min(progress);
            }
        }
    }

    pub(super) fn is_moving(&self, link_idx: usize, joints: &[ClosingJoint], progress: f64) -> bool {
        self.movers[link_idx].iter().any(|mover| joints[mover.closing_idx].end > progress)
    }

    /// Velocity of a link's point in the palm frame, metres per unit of progress.
    pub(super) fn velocity(
        &self,
        link_idx: usize,
        point: Vector,
        palm_from_links: &[Isometry3<f64>],
        joints: &[ClosingJoint],
        progress: f64,
    ) -> Vector {
        let point = Point3::new(point.x, point.y, point.z);
        let velocity: Vector3<f64> = self.movers[link_idx]
            .iter()
            .filter(|mover| joints[mover.closing_idx].end > progress)
            .map(|mover| mover.velocity(&point, joints[mover.closing_idx].rate * mover.multiplier, palm_from_links))
            .sum();
        Vector::new(velocity.x, velocity.y, velocity.z)
    }

    /// Of the closing joints that move a link, the one nearest to it.
    pub(crate) fn nearest_closing_joint(&self, link_idx: usize) -> Option<&ClosingJoint> {
        self.movers[link_idx].first().map(|mover| &self.joints[mover.closing_idx])
    }

    /// The pairs of closing joints of which the second one moves the first one's links and turns against it as the hand closes.
    pub(crate) fn opposed_joints(&self, palm_from_links: &[Isometry3<f64>]) -> Vec<(usize, usize)> {
        /// Cosine of the angle between axes that count as parallel, and opposite.
        const OPPOSED: f64 = -0.9;
        let mut opposed = Vec::new();
        for movers in &self.movers {
            let mut below: Option<(usize, Vector3<f64>)> = None;
            for mover in movers.iter().filter(|mover| mover.kind == JointKind::Revolute) {
                let joint = &self.joints[mover.closing_idx];
                let axis = palm_from_links[mover.moved_link_idx].rotation * mover.axis;
                let turn = axis * (joint.rate * mover.multiplier).signum();
                if let Some((joint_idx, other)) = below
                    && other.dot(&turn) < OPPOSED
                    && joint_idx != joint.joint_idx
                {
                    opposed.push((joint_idx, joint.joint_idx));
                }
                below = Some((joint.joint_idx, turn));
            }
        }
        opposed
    }

    /// Velocity of a link's point (palm frame) per speed of the value of a closing joint.
    pub(crate) fn velocity_of_joint(
        &self,
        link_idx: usize,
        point: &Point3<f64>,
        joint_idx: usize,
        palm_from_links: &[Isometry3<f64>],
    ) -> Vector3<f64> {
        let movers = self.movers[link_idx].iter().filter(|mover| self.joints[mover.closing_idx].joint_idx == joint_idx);
        movers.map(|mover| mover.velocity(point, mover.multiplier, palm_from_links)).sum()
    }

    /// The closest points of two links. Shapes that are far apart count with the distance of their bounding spheres.
    pub(super) fn closest_of_links(
        &self,
        a: usize,
        b: usize,
        palm_from_links: &[Isometry3<f64>],
    ) -> Option<ClosestLinks> {
        let mut nearest: Option<ClosestLinks> = None;
        for (idx_a, shape_a) in self.shapes_of(a) {
            let centre_a = palm_from_links[a] * shape_a.centre_in_link;
            for (idx_b, shape_b) in self.shapes_of(b) {
                let between = palm_from_links[b] * shape_b.centre_in_link - centre_a;
                let apart_m = between.norm() - shape_a.radius_m - shape_b.radius_m;
                if nearest.is_some_and(|nearest| nearest.points.distance_m <= apart_m) {
                    continue;
                }
                let closest = if apart_m > 0.005 {
                    let direction = Vector::new(between.x, between.y, between.z) / between.norm();
                    let point = Vector::new(centre_a.x, centre_a.y, centre_a.z);
                    Some(ClosestPoints {
                        distance_m: apart_m,
                        point_on_first: point,
                        point_on_second: point,
                        direction,
                    })
                } else {
                    let [pose_a, pose_b] = [shape_a, shape_b].map(|shape| shape.pose_in_palm(palm_from_links));
                    shape_a.closest_to_shape(&pose_a, shape_b, &pose_b)
                };
                if let Some(closest) = closest
                    && nearest.is_none_or(|nearest| closest.distance_m < nearest.points.distance_m)
                {
                    nearest = Some(ClosestLinks { points: closest, shape_idxs: [idx_a, idx_b] });
                }
            }
        }
        nearest
    }

    /// The shapes of a link, with their places among all.
    fn shapes_of(&self, link_idx: usize) -> impl Iterator<Item = (usize, &PlacedShape<'a>)> {
        let range = self.shapes_of_links[link_idx].clone();
        range.clone().zip(&self.shapes[range])
    }

    /// The pairs of links that must not touch and that closing can bring together.
    fn pairs(&self) -> Vec<(usize, usize)> {
        let mut pairs = self.hand.self_collision_pairs().to_vec();
        pairs.retain(|(a, b)| self.movers[*a].iter().map(Mover::key).ne(self.movers[*b].iter().map(Mover::key)));
        pairs
    }
}

/// The links that a joint moves, those of each finger together: a finger begins at a link that the joint moves and that
/// hangs on no other such link.
fn fingers(hand: &Hand, joint_idx: usize) -> Vec<Vec<usize>> {
    let mut fingers: Vec<(usize, Vec<usize>)> = Vec::new();
    for link_idx in 0..hand.links.len() {
        let Some(first) = first_moved(hand, link_idx, joint_idx) else { continue };
        match fingers.iter_mut().find(|(other, _)| *other == first) {
            Some((_, links)) => links.push(link_idx),
            None => fingers.push((first, vec![link_idx])),
        }
    }
    fingers.into_iter().map(|(_, links)| links).collect()
}

/// Of the links that bear `link_idx`, and itself, the one nearest to the root that the joint moves.
pub(crate) fn first_moved(hand: &Hand, link_idx: usize, joint_idx: usize) -> Option<usize> {
    let is_moved =
        |idx: &usize| matches!(hand.links[*idx].motion, Motion::Joint { joint_idx: by, .. } if by == joint_idx);
    std::iter::successors(Some(link_idx), |idx| hand.links[*idx].parent_idx).filter(is_moved).last()
}

/// The greatest distance by which a link slides from its joint's origin.
fn slide_m(hand: &Hand, link_idx: usize) -> f64 {
    match hand.links[link_idx].motion {
        Motion::Joint { joint_idx, kind: JointKind::Prismatic, multiplier, offset, .. } => {
            let joint = &hand.joints[joint_idx];
            let [lower_m, upper_m] = [joint.lower, joint.upper].map(|value| (multiplier * value + offset).abs());
            lower_m.max(upper_m)
        }
        _ => 0.0,
    }
}

fn movers(hand: &Hand, joints: &[ClosingJoint], link_idx: usize) -> Vec<Mover> {
    let mut movers = Vec::new();
    let mut next = Some(link_idx);
    while let Some(idx) = next {
        if let Motion::Joint { joint_idx, kind, multiplier, axis, .. } = hand.links[idx].motion
            && let Some(closing_idx) = joints.iter().position(|joint| joint.joint_idx == joint_idx)
        {
            movers.push(Mover { closing_idx, moved_link_idx: idx, kind, multiplier, axis: axis.into_inner() });
        }
        next = hand.links[idx].parent_idx;
    }
    movers
}
