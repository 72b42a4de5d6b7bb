//! Self-collision: links of the hand that touch each other instead of the object (Dang & Allen, section IV-F.3).

use nalgebra::{Isometry3, Point3};
use parry3d_f64::math::{Pose, Rotation, Vector};
use parry3d_f64::query;

use super::{Hand, JointError, LinkShape, Motion};

/// The collision shapes of a hand in one posture. It keeps its memory for the next one.
#[derive(Debug, Default)]
pub(crate) struct PosedShapes {
    /// Link after link.
    shapes: Vec<PosedShape>,
    /// For each link, the index behind its last shape.
    ends: Vec<usize>,
}

#[derive(Debug)]
struct PosedShape {
    palm_from_core: Pose,
    /// Of the core: a sphere around it.
    centre_in_palm_m: Vector,
    radius_m: f64,
}

impl PosedShapes {
    pub(crate) fn place(&mut self, hand: &Hand, palm_from_links: &[Isometry3<f64>]) {
        self.shapes.clear();
        self.ends.clear();
        for (link, palm_from_link) in hand.links.iter().zip(palm_from_links) {
            for shape in &link.shapes {
                let palm_from_core = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
                let sphere = shape.core.compute_bounding_sphere(&palm_from_core);
                let (centre_in_palm_m, radius_m) = (sphere.center, sphere.radius);
                self.shapes.push(PosedShape { palm_from_core, centre_in_palm_m, radius_m });
            }
            self.ends.push(self.shapes.len());
        }
    }

    fn of_link<'a>(&'a self, hand: &'a Hand, idx: usize) -> impl Iterator<Item = (&'a LinkShape, &'a PosedShape)> {
        let shapes = &hand.links[idx].shapes;
        shapes.iter().zip(&self.shapes[self.ends[idx] - shapes.len()..])
    }
}

impl Hand {
    /// Whether any two links that should not touch are within the layout's `self_collision_margin_m`.
    ///
    /// # Errors
    /// Not one finite angle per joint.
    pub fn self_collides(&self, joints: &[f64]) -> Result<bool, JointError> {
        Ok(!self.touching_links(joints)?.is_empty())
    }

    /// The pairs of links (indices) that touch but should not.
    ///
    /// # Errors
    /// As [`Hand::self_collides`].
    pub fn touching_links(&self, joints: &[f64]) -> Result<Vec<(usize, usize)>, JointError> {
        let mut shapes = PosedShapes::default();
        shapes.place(self, &self.palm_from_links(joints)?);
        Ok(self.touching_pairs(&shapes).collect())
    }

    /// The pairs of links (indices) that should not touch.
    pub fn self_collision_pairs(&self) -> &[(usize, usize)] {
        &self.self_collision_pairs
    }

    /// The pairs of links (indices) that touch but should not.
    pub(crate) fn touching_pairs(&self, shapes: &PosedShapes) -> impl Iterator<Item = (usize, usize)> {
        self.self_collision_pairs.iter().copied().filter(move |&(a, b)| links_touch(self, a, b, shapes))
    }

    /// Distance of a point of the palm frame to a link's collision shapes, metres; 0 inside, infinite without shapes.
    pub fn distance_to_link_m(&self, point: &Point3<f64>, link_idx: usize, palm_from_links: &[Isometry3<f64>]) -> f64 {
        let point = Vector::new(point.x, point.y, point.z);
        let distance_m = |shape: &LinkShape| {
            let pose = pose_from_isometry(&(palm_from_links[link_idx] * shape.link_from_shape));
            (shape.core.distance_to_point(&pose, point, true) - shape.edge_radius_m).max(0.0)
        };
        self.links[link_idx].shapes.iter().map(distance_m).fold(f64::INFINITY, f64::min)
    }
}

/// parry's pose of a nalgebra isometry.
pub fn pose_from_isometry(isometry: &Isometry3<f64>) -> Pose {
    let t = &isometry.translation.vector;
    let q = &isometry.rotation.coords;
    Pose { rotation: Rotation::from_xyzw(q.x, q.y, q.z, q.w), translation: Vector::new(t.x, t.y, t.z) }
}

/// The pairs to check: with shapes, not joined to each other, and apart in the open hand (links that overlap there are built into each
/// other, as in MoveIt's setup assistant).
pub(super) fn pairs(hand: &Hand) -> Vec<(usize, usize)> {
    let Ok(palm_from_links) = hand.palm_from_links(&hand.open_joints()) else {
        return Vec::new();
    };
    // Links that cannot move against each other count as one body, named after the link nearest to the root.
    let body = |mut idx: usize| {
        while let (Motion::Fixed, Some(parent_idx)) = (hand.links[idx].motion, hand.links[idx].parent_idx) {
            idx = parent_idx;
        }
        idx
    };
    let joined = |a: usize, b: usize| {
        let parent_body = |idx: usize| hand.links[body(idx)].parent_idx.map(body);
        body(a) == body(b) || parent_body(a) == Some(body(b)) || parent_body(b) == Some(body(a))
    };
    let mut shapes = PosedShapes::default();
    shapes.place(hand, &palm_from_links);
    let mut pairs = Vec::new();
    for a in 0..hand.links.len() {
        for b in a + 1..hand.links.len() {
            let have_shapes = [a, b].iter().all(|idx| !hand.links[*idx].shapes.is_empty());
            if have_shapes && !joined(a, b) && !links_touch(hand, a, b, &shapes) {
                pairs.push((a, b));
            }
        }
    }
    pairs
}

fn links_touch(hand: &Hand, a: usize, b: usize, shapes: &PosedShapes) -> bool {
    shapes.of_link(hand, a).any(|(shape_a, posed_a)| {
        shapes.of_link(hand, b).any(|(shape_b, posed_b)| {
            // Most pairs are far apart, so their bounding spheres make a distance query unnecessary.
            let gap_m =
                (posed_a.centre_in_palm_m - posed_b.centre_in_palm_m).length() - posed_a.radius_m - posed_b.radius_m;
            let touching_m = hand.self_collision_margin_m + shape_a.edge_radius_m + shape_b.edge_radius_m;
            gap_m <= touching_m
                && query::distance(&posed_a.palm_from_core, &*shape_a.core, &posed_b.palm_from_core, &*shape_b.core)
                    .is_ok_and(|found| found.distance <= touching_m)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn fingers_closed_on_nothing_touch_and_open_ones_do_not() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        assert!(!hand.self_collides(&[0.0; 7]).expect("7 joints"));
        // At spread 0 finger 3 passes between the others; a spread of 0.5 brings them into its way.
        for (spread, touches) in [(0.0, false), (0.5, true)] {
            let closed = hand
                .posture([("spread", spread), ("finger_1", 1.7), ("finger_2", 1.7), ("finger_3", 1.7)])
                .expect("in range");
            assert_eq!(hand.self_collides(&closed).expect("7 joints"), touches, "spread {spread}");
        }
    }

    #[test]
    fn a_plate_as_large_as_the_palm_pad_touches_the_pad_first() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let plate = parry3d_f64::shape::Cuboid::new(Vector::new(0.039, 0.02125, 0.01));
        for spread in [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0] {
            let posture = hand.posture([("spread", spread)]).expect("in range");
            let palm_from_links = hand.palm_from_links(&posture).expect("7 joints");
            // Its lower face 0.2 mm above the pad.
            let plate_pose = Pose::translation(0.0, 0.0, 0.0102);
            for (link, palm_from_link) in hand.links.iter().zip(&palm_from_links) {
                for shape in &link.shapes {
                    let pose = pose_from_isometry(&(palm_from_link * shape.link_from_shape));
                    let distance_m =
                        query::distance(&plate_pose, &plate, &pose, &*shape.core).expect("supported").distance
                            - shape.edge_radius_m;
                    assert!(distance_m > 1e-4, "{} is {distance_m} m from the plate at spread {spread}", link.name);
                }
            }
        }
    }
}
