//! Kernel regression over poses of the object in the hand: the share of grasps around a pose that held.
//!
//! Poses are compared by the object's centre of mass in the palm frame, the direction of its z axis there, and the
//! preshape joints. The rotation about its z axis is ignored, because most objects look similar from all sides and
//! share experience then.

use nalgebra::{Isometry3, Vector3};

/// Numbers of a pose, besides the preshape joints.
const N_POSE_NUMBERS: usize = 6;
/// Points of a leaf, which are computed together.
const LEAF: usize = 32;
/// The kernel is (1 - d²/8)⁴, d in units of its scales: near exp(-d²/2), but 0 from here on.
const SUPPORT_SQUARED: f32 = 8.0;
/// Fills up leaves. It is beyond the support of every pose.
const FAR: f32 = 1e9;

/// Distances within which poses are similar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PoseScales {
    /// Of the centre of mass, metres.
    pub(super) position_m: f64,
    /// Of the direction of the z axis: the length of the difference of the unit vectors.
    pub(super) direction: f64,
    /// Of each preshape joint, radians.
    pub(super) preshape_rad: f64,
}

/// The grasps around a pose.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Known {
    /// The sum of the kernel over the grasps.
    pub(super) weight: f64,
    /// The same over those that held.
    pub(super) held: f64,
}

/// Poses of objects in the hand and whether they held, in boxes of neighbours.
#[derive(Debug, Clone)]
pub(super) struct PoseField {
    n_numbers: usize,
    leaves: Vec<Leaf>,
}

#[derive(Debug, Clone)]
struct Leaf {
    lower: Vec<f32>,
    upper: Vec<f32>,
    /// The numbers of a pose, each for all points.
    points: Vec<[f32; LEAF]>,
    held: [f32; LEAF],
}

impl PoseScales {
    /// A pose in units of the scales.
    pub(super) fn scaled(
        &self,
        palm_from_object: &Isometry3<f64>,
        preshape_rad: impl Iterator<Item = f64>,
    ) -> Vec<f32> {
        let centre = palm_from_object.translation.vector / self.position_m;
        let up = palm_from_object.rotation * Vector3::z() / self.direction;
        let preshape = preshape_rad.map(|angle| angle / self.preshape_rad);
        centre.iter().chain(up.iter()).copied().chain(preshape).map(|number| number as f32).collect()
    }
}

impl PoseField {
    /// A field of scaled poses, each with whether it held. All have as many numbers.
    pub(super) fn new(mut poses: Vec<(Vec<f32>, bool)>) -> PoseField {
        let n_numbers = poses.first().map_or(N_POSE_NUMBERS, |(pose, _)| pose.len());
        let mut leaves = Vec::new();
        split(&mut poses, n_numbers, &mut leaves);
        PoseField { n_numbers, leaves }
    }

    /// The sums of the kernel around a scaled pose.
    pub(super) fn around(&self, pose: &[f32]) -> Known {
        let mut known = Known::default();
        if pose.len() != self.n_numbers {
            return known;
        }
        for leaf in self.leaves.iter().filter(|leaf| leaf.distance_squared(pose) < SUPPORT_SQUARED) {
            let mut squares = [0.0_f32; LEAF];
            for (number, of_points) in pose.iter().zip(&leaf.points) {
                for (square, point) in squares.iter_mut().zip(of_points) {
                    *square += (point - number) * (point - number);
                }
            }
            let (mut weight, mut held) = (0.0, 0.0);
            for (square, is_held) in squares.iter().zip(&leaf.held) {
                let base = (1.0 - square / SUPPORT_SQUARED).max(0.0);
                let kernel = base * base * base * base;
                weight += kernel;
                held += kernel * is_held;
            }
            known.weight += f64::from(weight);
            known.held += f64::from(held);
        }
        known
    }
}

impl Leaf {
    fn new(poses: &[(Vec<f32>, bool)], n_numbers: usize) -> Leaf {
        let (lower, upper) = (0..n_numbers).map(|number| range(poses, number)).unzip();
        let mut points = vec![[FAR; LEAF]; n_numbers];
        let mut held = [0.0; LEAF];
        for (point_idx, (pose, is_held)) in poses.iter().enumerate() {
            for (of_points, number) in points.iter_mut().zip(pose) {
                of_points[point_idx] = *number;
            }
            held[point_idx] = f32::from(u8::from(*is_held));
        }
        Leaf { lower, upper, points, held }
    }

    /// From the box around its points.
    fn distance_squared(&self, pose: &[f32]) -> f32 {
        let beyond = pose.iter().zip(self.lower.iter().zip(&self.upper));
        beyond.map(|(number, (lower, upper))| (lower - number).max(number - upper).max(0.0).powi(2)).sum()
    }
}

/// The least and the greatest of a number of the poses.
fn range(poses: &[(Vec<f32>, bool)], number: usize) -> (f32, f32) {
    let numbers = poses.iter().map(|(pose, _)| pose[number]);
    numbers.fold((f32::INFINITY, f32::NEG_INFINITY), |(lower, upper), number| (lower.min(number), upper.max(number)))
}

/// Halves the poses where they are widest until each part fits a leaf.
fn split(poses: &mut [(Vec<f32>, bool)], n_numbers: usize, leaves: &mut Vec<Leaf>) {
    if poses.len() <= LEAF {
        if !poses.is_empty() {
            leaves.push(Leaf::new(poses, n_numbers));
        }
        return;
    }
    let width = |number: &usize| {
        let (lower, upper) = range(poses, *number);
        upper - lower
    };
    let widest = (0..n_numbers).max_by(|one, other| width(one).total_cmp(&width(other))).unwrap_or(0);
    let middle = poses.len() / 2;
    poses.select_nth_unstable_by(middle, |one, other| one.0[widest].total_cmp(&other.0[widest]));
    let (below, above) = poses.split_at_mut(middle);
    split(below, n_numbers, leaves);
    split(above, n_numbers, leaves);
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn boxes_change_nothing_about_what_is_known() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut pose = || (0..7).map(|_| rng.random_range(-4.0..4.0_f32)).collect::<Vec<f32>>();
        let poses: Vec<(Vec<f32>, bool)> = (0..1000).map(|idx| (pose(), idx % 3 == 0)).collect();
        let field = PoseField::new(poses.clone());
        for _ in 0..50 {
            let at = pose();
            let kernel = |to: &[f32]| {
                let square: f64 = at.iter().zip(to).map(|(one, other)| f64::from(one - other).powi(2)).sum();
                (1.0 - square / 8.0).max(0.0).powi(4)
            };
            let weight: f64 = poses.iter().map(|(pose, _)| kernel(pose)).sum();
            let held: f64 = poses.iter().filter(|(_, held)| *held).map(|(pose, _)| kernel(pose)).sum();
            let found = field.around(&at);
            assert!((found.weight - weight).abs() < 1e-4 && (found.held - held).abs() < 1e-4, "{found:?}");
        }
    }

    #[test]
    fn how_an_object_is_turned_about_its_axis_makes_no_difference() {
        let scales = PoseScales { position_m: 0.02, direction: 0.5, preshape_rad: 0.5 };
        let pose = |yaw_rad: f64| {
            let yaw = Isometry3::rotation(Vector3::z() * yaw_rad);
            let tilted = Isometry3::new(Vector3::new(0.01, 0.02, 0.06), Vector3::x() * 2.0);
            scales.scaled(&(tilted * yaw), [0.25].into_iter())
        };
        let (one, other) = (pose(0.0), pose(1.2));
        assert!(one.iter().zip(&other).all(|(one, other)| (one - other).abs() < 1e-6), "{one:?} {other:?}");
        assert_eq!((one[0], one[6], one.len()), (0.5, 0.5, 7));
        // The kernel is 1 at its middle.
        let field = PoseField::new(vec![(one.clone(), true), (vec![9.0; 7], false)]);
        assert_eq!(field.around(&one), Known { weight: 1.0, held: 1.0 });
        assert_eq!(field.around(&[0.0; 3]), Known::default());
    }
}
