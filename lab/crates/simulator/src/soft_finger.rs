//! The soft finger: the patch of a rubber link on the object, the torque about the normal that it resists, and the forces
//! on its cells.
//!
//! The rubber is an elastic mattress (Ciocarlie, Miller & Allen 2005). Pressure is proportional to the local
//! indentation, so the patch is an ellipse of the relative curvature. The pressure over it is taken as p = 3N / (2πab)
//! · √(1 - x²/a² - y²/b²). All links are rubber, those without a pad with a flat surface.
//!
//! Deviations and limits: relative curvature is the sum of the two surfaces' curvature matrices, which is Johnson's formula
//! without its case analysis. A semi-axis ends at half the pad's width, 10 mm on a bare link (flat on flat, where the mattress
//! would spread without limit). The indentation for the same load is solved anew for the shortened ellipse. The part of a patch
//! that reaches beyond its link is cut off, and the rest carries the load. The indentation ends at the mattress's thickness (an
//! edge or a corner, relative radius below about 0.35 mm at 5 N).

use std::sync::LazyLock;

use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix3x2, Point3, SymmetricEigen, UnitVector3, Vector2, Vector3};
use parry3d_f64::math::Vector;
use parry3d_f64::query::Ray;
use parry3d_f64::shape::Shape;

use super::distance::{PlacedShape, Within};
use super::mechanism::Mechanism;
use super::option_check::{OptionError, positive, require, with_defaults};
use blindgrasp_stages::hand::{Cell, Hand, Pad, pose_from_isometry};

with_defaults! {
    /// The rubber and the load.
    pub struct SoftFingerOptions {
        /// Thickness of the mattress. 3 mm (Ciocarlie).
        pub thickness_m: f64 = 0.003,
        /// Young's modulus. 1.5e6 Pa (Ciocarlie; a public model file says 1500, a unit slip).
        pub youngs_modulus_pa: f64 = 1.5e6,
        /// Static load of a link, shared equally by its contacts. 5 N (Ciocarlie).
        pub normal_force_newtons: f64 = 5.0,
        /// Longest semi-axis of a patch on a link without a pad, in place of half the pad's width. 10 mm: half a Barrett finger.
        pub bare_half_width_m: f64 = 0.010,
        /// Relative radii above this count as this, so that a flat direction has a number. 1 m.
        pub largest_radius_m: f64 = 1.0,
    }
}

impl SoftFingerOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        positive("thickness_m", self.thickness_m)?;
        positive("youngs_modulus_pa", self.youngs_modulus_pa)?;
        let force = self.normal_force_newtons;
        require("normal_force_newtons", force, (1e-6..=1e4).contains(&force), "1e-6 to 1e4")?;
        positive("bare_half_width_m", self.bare_half_width_m)?;
        positive("largest_radius_m", self.largest_radius_m)
    }
}

/// A contact patch: an ellipse in the contact's tangent plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patch {
    /// Semi-axes, metres.
    pub semi_axes_m: [f64; 2],
    /// Direction of the first semi-axis in the basis of the tangents, unit.
    pub first_axis: Vector2<f64>,
    /// Indentation at the centre, metres.
    pub indentation_m: f64,
}

impl Patch {
    /// Torsional radius 8√(ab)/15: the torque about the normal per unit of friction force, metres. `on_link` is the part
    /// of the ellipse that lies on the link; the radius is that of an ellipse of the area left.
    pub fn torsion_m(&self, on_link: f64) -> f64 {
        let [a, b] = self.semi_axes_m;
        8.0 * (a * b * on_link).sqrt() / 15.0
    }
}

/// A contact's place in the palm frame: its point, and a right-handed basis of two tangents and the normal into the
/// object.
#[derive(Debug, Clone, Copy)]
pub struct ContactFrame {
    /// The contact point, metres.
    pub point_m: Point3<f64>,
    /// The tangents.
    pub tangents: [UnitVector3<f64>; 2],
    /// The normal into the object.
    pub inward_normal: UnitVector3<f64>,
}

impl ContactFrame {
    /// The same place seen from the other side. The tangents stay: the basis is left-handed.
    pub fn reversed(&self) -> ContactFrame {
        ContactFrame { inward_normal: -self.inward_normal, ..*self }
    }
}

fn semi_axis_m(indentation_m: f64, radius_m: f64) -> f64 {
    (2.0 * indentation_m * radius_m).sqrt()
}

/// The patch of a load on a relative curvature (1/m, in the basis of the tangents), on a link of that half width.
pub fn patch(
    relative_curvature: &Matrix2<f64>,
    load_newtons: f64,
    half_width_m: f64,
    options: &SoftFingerOptions,
) -> Patch {
    let eigen = SymmetricEigen::new(*relative_curvature);
    // The first axis is that of the larger radius.
    let first = if eigen.eigenvalues[0] <= eigen.eigenvalues[1] { 0 } else { 1 };
    let curvatures = [eigen.eigenvalues[first], eigen.eigenvalues[1 - first]];
    let radii_m = curvatures.map(|curvature| 1.0 / curvature.max(1.0 / options.largest_radius_m));
    let axis = eigen.eigenvectors.column(first).into_owned();
    // The mattress under an ellipse carries N = (E/h) · δ · πab/2. With a = √(2δR₁), b = √(2δR₂):
    let softness = load_newtons * options.thickness_m / (options.youngs_modulus_pa * std::f64::consts::PI);
    let mut indentation_m = (softness / (radii_m[0] * radii_m[1]).sqrt()).sqrt();
    if semi_axis_m(indentation_m, radii_m[0]) > half_width_m {
        // a = half width: N = (E/h) · δ^1.5 · π · (half width) · √(2R₂) / 2.
        indentation_m = (2.0 * softness / (half_width_m * (2.0 * radii_m[1]).sqrt())).powf(2.0 / 3.0);
        if semi_axis_m(indentation_m, radii_m[1]) > half_width_m {
            indentation_m = 2.0 * softness / (half_width_m * half_width_m);
        }
    }
    indentation_m = indentation_m.min(options.thickness_m);
    let semi_axes_m = radii_m.map(|radius_m| semi_axis_m(indentation_m, radius_m).min(half_width_m));
    Patch { semi_axes_m, first_axis: axis, indentation_m }
}

/// Curvature of an object's surface (1/m, in the basis of the tangents; convex is positive, concave directions count as
/// flat). It is z = ax² + by² + cxy by least squares, over points 3 and 6 mm around the contact. That is about as far as
/// a patch reaches, which cannot tell the facets of a mesh from the round they stand for either. An edge or a corner
/// comes out as sharp as these points can tell (about 1/(3 mm)).
pub fn object_curvature(shape: &dyn Shape, palm_from_object: &Isometry3<f64>, frame: &ContactFrame) -> Matrix2<f64> {
    const RINGS_M: [f64; 2] = [0.003, 0.006];
    /// Rays start this far outside, and end as far inside.
    const REACH_M: f64 = 0.010;
    let pose = pose_from_isometry(palm_from_object);
    let [t1, t2] = frame.tangents;
    let n = frame.inward_normal.into_inner();
    let mut normal_matrix = nalgebra::Matrix3::zeros();
    let mut right_side = nalgebra::Vector3::zeros();
    for radius_m in RINGS_M {
        for idx in 0..8 {
            let (sin, cos) = (std::f64::consts::FRAC_PI_4 * (f64::from(idx) + 0.5)).sin_cos();
            let (x, y) = (radius_m * cos, radius_m * sin);
            let origin = frame.point_m + t1.into_inner() * x + t2.into_inner() * y - n * REACH_M;
            let ray = Ray::new(Vector::new(origin.x, origin.y, origin.z), Vector::new(n.x, n.y, n.z));
            let z = shape.cast_ray(&pose, &ray, 2.0 * REACH_M, true).unwrap_or(2.0 * REACH_M) - REACH_M;
            // Weighted by 1/radius², so that both rings count the same.
            let row = nalgebra::Vector3::new(x * x, y * y, x * y) / (radius_m * radius_m);
            normal_matrix += row * row.transpose();
            right_side += row * (z / (radius_m * radius_m));
        }
    }
    let Some(inverse) = normal_matrix.try_inverse() else { return Matrix2::zeros() };
    let abc: nalgebra::Vector3<f64> = inverse * right_side;
    let curvature = Matrix2::new(2.0 * abc.x, abc.z, abc.z, 2.0 * abc.y);
    let mut eigen = SymmetricEigen::new(curvature);
    eigen.eigenvalues = eigen.eigenvalues.map(|value: f64| value.max(0.0));
    eigen.recompose()
}

/// A link's surface at a contact: its curvature (1/m, in the basis of the tangents) and the half width where patches end.
///
/// On a pad it is the pad's curvature, and that of the link's rounded edges along the directions in which the pad is
/// flat; elsewhere that of the link's shape.
pub fn link_surface(
    hand: &Hand,
    shape: &PlacedShape<'_>,
    palm_from_link: &Isometry3<f64>,
    frame: &ContactFrame,
    options: &SoftFingerOptions,
) -> (Matrix2<f64>, f64) {
    let palm_from_shape = palm_from_link.rotation * shape.link_from_shape.rotation;
    let to_basis = |in_palm: Matrix3<f64>| {
        let basis = Matrix3x2::from_columns(&frame.tangents.map(UnitVector3::into_inner));
        basis.transpose() * in_palm * basis
    };
    let outward = palm_from_shape.inverse() * frame.inward_normal.into_inner();
    let turn = palm_from_shape.to_rotation_matrix().into_inner();
    let shape_curvature = turn * shape.curvature(outward) * turn.transpose();
    let point = palm_from_link.inverse_transform_point(&frame.point_m);
    let on_pad = hand.pads.iter().filter(|pad| pad.link_idx == shape.link_idx).find_map(|pad| {
        let (cell_idx, distance_m) = pad
            .cells
            .iter()
            .enumerate()
            .map(|(cell_idx, cell)| (cell_idx, (cell.position_in_link_m - point).norm()))
            .min_by(|(_, a), (_, b)| a.total_cmp(b))?;
        let [length_m, width_m] = pad.cells[cell_idx].size_m;
        (distance_m <= length_m.hypot(width_m) / 2.0 + PAD_EDGE_M).then_some((pad, cell_idx))
    });
    let Some((pad, cell_idx)) = on_pad else { return (to_basis(shape_curvature), options.bare_half_width_m) };
    let cell = &pad.cells[cell_idx];
    let axes = [cell.along_in_link.into_inner(), cell.normal_in_link.cross(&cell.along_in_link)];
    let curvature = [(axes[0], axes[1]), (axes[1], axes[0])]
        .map(|(along, across)| {
            let in_palm = palm_from_link.rotation * along;
            let of_pad = pad_curvature(pad, cell_idx, &along, &across);
            let of_edge = if of_pad.abs() < FLAT_PAD { in_palm.dot(&(shape_curvature * in_palm)) } else { 0.0 };
            in_palm * in_palm.transpose() * (of_pad + of_edge)
        })
        .into_iter()
        .sum();
    (to_basis(curvature), pad_half_width_m(pad))
}

/// How a patch's load falls on its link.
#[derive(Debug, Clone, PartialEq)]
pub struct PatchLoad {
    /// The part of the ellipse that lies on the link. The whole load presses there.
    pub on_link: f64,
    /// Force on each cell per newton of load, as (index among the hand's cells, share).
    pub cell_shares: Vec<(usize, f64)>,
}

/// Pieces of equal load of a patch, as places in the unit circle that becomes its ellipse.
static PIECES: LazyLock<Vec<[f64; 2]>> = LazyLock::new(|| {
    const N_RINGS: usize = 32;
    const N_ANGLES: usize = 64;
    let mut pieces = Vec::with_capacity(N_RINGS * N_ANGLES);
    for ring in 0..N_RINGS {
        // Within the part r of the ellipse lies 1 - (1 - r²)^1.5 of the load.
        let outside = 1.0 - (ring as f64 + 0.5) / N_RINGS as f64;
        let r = (1.0 - outside.powf(2.0 / 3.0)).sqrt();
        for angle in 0..N_ANGLES {
            pieces.push(on_circle(r, (angle as f64 + 0.5 * (ring % 2) as f64) / N_ANGLES as f64));
        }
    }
    pieces
});

fn on_circle(r: f64, turn: f64) -> [f64; 2] {
    let (sin, cos) = (std::f64::consts::TAU * turn).sin_cos();
    [r * cos, r * sin]
}

/// How the load of a patch on `link_idx` falls on the link and its cells.
///
/// The patch is cut into pieces of equal load. Pieces that the link, bent against the patch by up to its indentation,
/// does not reach are off the link, and the others carry their load. Each goes to the cell whose rectangle it lies on,
/// seen along the cell's normal, which feels the part of the force that goes along it. Cells do not feel pieces
/// between or beyond them.
pub fn patch_load(
    mechanism: &Mechanism<'_>,
    link_idx: usize,
    palm_from_link: &Isometry3<f64>,
    frame: &ContactFrame,
    patch: &Patch,
) -> PatchLoad {
    let [a, b] = patch.semi_axes_m;
    let [t1, t2] = frame.tangents.map(|tangent| palm_from_link.rotation.inverse() * tangent.into_inner());
    let first = t1 * patch.first_axis.x + t2 * patch.first_axis.y;
    let second = t2 * patch.first_axis.x - t1 * patch.first_axis.y;
    let push_out_of_link = palm_from_link.rotation.inverse() * frame.inward_normal.into_inner();
    let centre = palm_from_link.inverse_transform_point(&frame.point_m);
    let reach_m = patch.indentation_m + REACH_SLACK_M;
    let mut shapes: Vec<Within<'_>> = Vec::new();
    for shape in mechanism.shapes.iter().filter(|shape| shape.link_idx == link_idx) {
        if (shape.centre_in_link - centre).norm() <= shape.radius_m + a.max(b) + reach_m {
            let around = Vector::new(centre.x, centre.y, centre.z);
            shapes.push(shape.within(pose_from_isometry(&shape.link_from_shape), reach_m, around, a.max(b)));
        }
    }
    let at = |[x, y]: [f64; 2]| centre + first * (a * x) + second * (b * y);
    // Links are unions of few convex shapes: where the rim is on the link, the rest is.
    let is_whole = (0..16).all(|idx| is_on_link(&shapes, &at(on_circle(1.0, f64::from(idx) / 16.0))));
    let cells = cells_near(mechanism.hand, link_idx, &centre, a.max(b), &push_out_of_link);
    if is_whole && cells.is_empty() {
        return PatchLoad { on_link: 1.0, cell_shares: Vec::new() };
    }
    let mut n_on_link = 0_u32;
    let mut n_on_cell = vec![0_u32; cells.len()];
    for piece in PIECES.iter().map(|piece| at(*piece)) {
        if !is_whole && !is_on_link(&shapes, &piece) {
            continue;
        }
        n_on_link += 1;
        let mut hit = None;
        let mut least_depth_m = f64::INFINITY;
        for (near_idx, near) in cells.iter().enumerate() {
            if let Some(depth_m) = near.depth_m(&piece)
                && depth_m < least_depth_m
            {
                (hit, least_depth_m) = (Some(near_idx), depth_m);
            }
        }
        if let Some(near_idx) = hit {
            n_on_cell[near_idx] += 1;
        }
    }
    let mut cell_shares = Vec::new();
    for (near, n) in cells.iter().zip(n_on_cell).filter(|(_, n)| *n > 0) {
        cell_shares.push((near.idx, f64::from(n) / f64::from(n_on_link) * near.along_normal));
    }
    PatchLoad { on_link: f64::from(n_on_link) / PIECES.len() as f64, cell_shares }
}

fn is_on_link(shapes: &[Within<'_>], point: &Point3<f64>) -> bool {
    let point = Vector::new(point.x, point.y, point.z);
    shapes.iter().any(|shape| shape.contains(point))
}

/// A cell that a patch may reach.
struct NearCell<'a> {
    /// Among the hand's cells.
    idx: usize,
    cell: &'a Cell,
    across_in_link: Vector3<f64>,
    /// The part of a force on the link that goes along the cell's normal.
    along_normal: f64,
}

impl NearCell<'_> {
    /// The distance of a point from the cell's plane; `None` beside the cell.
    fn depth_m(&self, point: &Point3<f64>) -> Option<f64> {
        let cell = self.cell;
        let from_cell = point - cell.position_in_link_m;
        let depth_m = from_cell.dot(&cell.normal_in_link).abs();
        let along_m = from_cell.dot(&cell.along_in_link).abs();
        let across_m = from_cell.dot(&self.across_in_link).abs();
        (depth_m <= CELL_DEPTH_M && along_m <= cell.size_m[0] / 2.0 && across_m <= cell.size_m[1] / 2.0)
            .then_some(depth_m)
    }
}

/// The cells of a link's pads that a patch of that size may reach and press on.
fn cells_near<'a>(
    hand: &'a Hand,
    link_idx: usize,
    centre: &Point3<f64>,
    patch_radius_m: f64,
    push_out_of_link: &Vector3<f64>,
) -> Vec<NearCell<'a>> {
    let mut near = Vec::new();
    for pad in hand.pads.iter().filter(|pad| pad.link_idx == link_idx) {
        for (cell_idx, cell) in pad.cells.iter().enumerate() {
            let reach_m = patch_radius_m + cell.size_m[0].hypot(cell.size_m[1]) / 2.0 + CELL_DEPTH_M;
            let along_normal = cell.normal_in_link.dot(push_out_of_link);
            if (cell.position_in_link_m - centre).norm() <= reach_m && along_normal > 0.0 {
                let across_in_link = cell.normal_in_link.cross(&cell.along_in_link);
                near.push(NearCell { idx: pad.first_cell_idx + cell_idx, cell, across_in_link, along_normal });
            }
        }
    }
    near
}

/// A piece of a patch this far from the link, beyond the indentation, is still on it: the touch tolerance and rounding.
const REACH_SLACK_M: f64 = 0.0003;
/// Curvatures of a pad below this (1/m) count as flat.
const FLAT_PAD: f64 = 1.0;
/// A contact this far beyond a cell's corner is still on the pad.
const PAD_EDGE_M: f64 = 0.001;
/// A patch piece this far above or below a cell's plane presses on it: the mattress's thickness.
const CELL_DEPTH_M: f64 = 0.003;

/// How much the cells' normals turn per metre along `along`, from the neighbours on both sides; convex is positive.
fn pad_curvature(pad: &Pad, cell_idx: usize, along: &nalgebra::Vector3<f64>, across: &nalgebra::Vector3<f64>) -> f64 {
    let cell = &pad.cells[cell_idx];
    let beside_m = cell.size_m[0].min(cell.size_m[1]) / 2.0;
    let curvatures: Vec<f64> = [1.0, -1.0]
        .into_iter()
        .filter_map(|side| {
            pad.cells
                .iter()
                .map(|other| (other, other.position_in_link_m - cell.position_in_link_m))
                .filter(|(_, step)| side * step.dot(along) > 1e-6 && step.dot(across).abs() < beside_m)
                .min_by(|(_, a), (_, b)| a.norm().total_cmp(&b.norm()))
                .map(|(other, step)| {
                    let angle = cell.normal_in_link.angle(&other.normal_in_link);
                    angle.copysign(side * other.normal_in_link.dot(along)) / step.norm()
                })
        })
        .collect();
    if curvatures.is_empty() { 0.0 } else { curvatures.iter().sum::<f64>() / curvatures.len() as f64 }
}

/// Half the smaller extent of a pad, measured along and across its first cell.
fn pad_half_width_m(pad: &Pad) -> f64 {
    let Some(cell) = pad.cells.first() else { return 0.0 };
    let axes = [cell.along_in_link.into_inner(), cell.normal_in_link.cross(&cell.along_in_link)];
    let half_extents = [0, 1].map(|idx| {
        let ends = pad.cells.iter().map(|cell| {
            let middle = cell.position_in_link_m.coords.dot(&axes[idx]);
            (middle - cell.size_m[idx] / 2.0, middle + cell.size_m[idx] / 2.0)
        });
        let (least, most) =
            ends.fold((f64::MAX, f64::MIN), |(least, most), (from, to)| (least.min(from), most.max(to)));
        (most - least) / 2.0
    });
    half_extents[0].min(half_extents[1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use parry3d_f64::shape::{Ball, Cuboid, Cylinder};
    use std::path::Path;

    fn frame_at(point: [f64; 3], inward: Vector3<f64>) -> ContactFrame {
        let helper = if inward.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        let t1 = UnitVector3::new_normalize(helper - inward * helper.dot(&inward));
        let t2 = UnitVector3::new_normalize(inward.cross(&t1));
        ContactFrame { point_m: point.into(), tangents: [t1, t2], inward_normal: UnitVector3::new_normalize(inward) }
    }

    #[test]
    fn a_ball_of_20_mm_on_a_flat_pad() {
        let ball = Ball::new(0.02);
        let curvature =
            object_curvature(&ball, &Isometry3::translation(0.0, 0.0, 0.02), &frame_at([0.0; 3], Vector3::z()));
        // The fit over 6 mm sees a circle slightly more curved than its parabola.
        assert!((curvature - Matrix2::identity() * 50.0).norm() < 1.5, "{curvature}");
        let patch = patch(&(Matrix2::identity() * 50.0), 5.0, 0.02, &SoftFingerOptions::default());
        // δ = √(5 · 0.003 / (1.5e6 · π · 0.02)) = 0.39894 mm, a = √(2 · δ · 20 mm) = 3.9947 mm.
        assert!((patch.indentation_m - 3.9894e-4).abs() < 1e-7, "{patch:?}");
        assert!((patch.semi_axes_m[0] - 3.9947e-3).abs() < 1e-6 && (patch.semi_axes_m[1] - 3.9947e-3).abs() < 1e-6);
        assert!((patch.torsion_m(1.0) - 8.0 * 3.9947e-3 / 15.0).abs() < 1e-6);
    }

    #[test]
    fn caps_act_on_flat_and_sharp_objects() {
        let options = SoftFingerOptions::default();
        let load_of = |patch: &Patch| {
            let [a, b] = patch.semi_axes_m;
            options.youngs_modulus_pa / options.thickness_m * patch.indentation_m * std::f64::consts::PI * a * b / 2.0
        };
        let flat = patch(&Matrix2::zeros(), 5.0, 0.0075, &options);
        assert_eq!(flat.semi_axes_m, [0.0075; 2]);
        assert!((load_of(&flat) - 5.0).abs() < 1e-9);
        let line = patch(&Matrix2::new(0.0, 0.0, 0.0, 40.0), 5.0, 0.0075, &options);
        assert_eq!(line.semi_axes_m[0], 0.0075);
        assert!(line.semi_axes_m[1] < 0.0075 && (load_of(&line) - 5.0).abs() < 1e-9, "{line:?}");
        assert!(line.first_axis.x.abs() > 0.999, "the long axis lies along the flat direction");
        let sharp = patch(&(Matrix2::identity() / 1e-4), 5.0, 0.0075, &options);
        assert_eq!(sharp.indentation_m, options.thickness_m);
    }

    #[test]
    fn curvature_of_planes_cylinders_and_edges() {
        let block = Cuboid::new(Vector::new(0.03, 0.03, 0.03));
        let on_face = frame_at([0.0, 0.0, -0.03], Vector3::z());
        assert!(object_curvature(&block, &Isometry3::identity(), &on_face).norm() < 1e-6);
        // parry's cylinder stands along y; the contact's x is palm x, its y then palm y.
        let can = Cylinder::new(0.05, 0.03);
        let curvature = object_curvature(&can, &Isometry3::identity(), &frame_at([0.0, 0.0, -0.03], Vector3::z()));
        assert!((curvature[(0, 0)] - 1.0 / 0.03).abs() < 0.5 && curvature[(1, 1)].abs() < 1e-6, "{curvature}");
        let diagonal = Vector3::new(0.0, 1.0, 1.0).normalize();
        let edge = object_curvature(&block, &Isometry3::identity(), &frame_at([0.0, -0.03, -0.03], diagonal));
        assert!(edge.symmetric_eigenvalues().max() > 150.0, "{edge}");
    }

    #[test]
    fn a_patch_on_one_cell_gives_it_everything_and_one_beside_the_pad_nothing() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let mechanism = Mechanism::new(&hand);
        let palm = hand.pads[0].link_idx;
        let round = patch(&(Matrix2::identity() * 50.0), 5.0, 0.02, &SoftFingerOptions::default());
        let on = |x: f64, y: f64| {
            let load =
                patch_load(&mechanism, palm, &Isometry3::identity(), &frame_at([x, y, 0.0], Vector3::z()), &round);
            (load.cell_shares, load.on_link)
        };
        let (whole, on_link) = on(0.011, 0.0053);
        assert_eq!(on_link, 1.0);
        assert_eq!((whole.len(), whole[0].0), (1, 7), "{whole:?}");
        assert!((whole[0].1 - 1.0).abs() < 1e-12);
        assert_eq!(on(0.06, 0.0), (vec![], 0.0));
        // In the middle between two cells, their 1 mm gap swallows a part and the rest is shared evenly.
        let (between, _) = on(0.0055, 0.0053);
        assert_eq!(between.len(), 2);
        assert!((between[0].1 - between[1].1).abs() < 0.01, "{between:?}");
        let sum = between[0].1 + between[1].1;
        // Of p ~ √(1 - r²), the strip |x| < 0.5 mm of a = 3.99 mm holds 1.5 · t - 0.5 · t³ with t = 0.1252.
        assert!((sum - (1.0 - 0.1868)).abs() < 0.03, "{sum}");
    }
}
