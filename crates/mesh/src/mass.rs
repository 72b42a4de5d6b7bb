//! Volume and centre of mass of the solid that a mesh encloses.
//!
//! There are two methods, and one checks the other. **Signed sums** over the triangles are exact where the surface is
//! closed, faces outwards and nowhere passes through itself. **Columns** are parallel rays through the mesh, along each
//! of which the winding number is known exactly; there is solid where it is 1 or more, so that overlaps count once. Holes
//! are closed with caps before either. The sums are used where both agree, the columns elsewhere. parry's mass properties
//! are signed sums alone, which are wrong for objects of overlapping parts, such as most of the built-in ones.

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use serde::Serialize;

use crate::topology::{caps, determinant};
use crate::{Mesh, MeshError};

/// Number of columns along either side of the mesh's box, a power of two.
const N_COLUMNS: i64 = 128;
/// Angle of the columns' lattice: its tangent is the golden ratio's inverse, the number furthest from any fraction.
const LATTICE_ANGLE_RAD: f64 = 0.553_574_358_897_045_3;
/// The signed sums are confirmed if the columns' volume differs from theirs by less than this share.
const AGREEMENT: f64 = 0.01;
/// A surface with holes is a sheet if, capped, it encloses less than this share of its area times its longest side. A
/// sphere encloses a sixth; a sheet that is bent by a hundredth of its length encloses about a two-hundredth.
const OPEN_SHEET: f64 = 1e-3;
/// The same share for closed surfaces, which allows for rounding only.
const CLOSED_SHEET: f64 = 1e-9;

/// A homogeneous solid.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SolidProperties {
    /// Volume, cubic metres.
    pub volume_m3: f64,
    /// Centre of mass in the mesh's frame, metres.
    pub centre_of_mass_m: Point3<f64>,
    /// The largest distance of a vertex from the centre of mass, metres.
    pub max_radius_m: f64,
    /// The method that found the volume and the centre.
    pub basis: Basis,
}

/// A method of finding a solid's volume and centre.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// Exact signed sums over the triangles.
    SignedSums,
    /// Columns through the mesh, in which overlapping parts count once.
    OccupiedColumns,
}

impl SolidProperties {
    /// One line for each fault that a user should know.
    pub fn warnings(&self) -> Vec<String> {
        match self.basis {
            Basis::SignedSums => Vec::new(),
            Basis::OccupiedColumns => {
                vec!["the surface overlaps itself: its volume is known to about 1 %, and overlaps count once".into()]
            }
        }
    }
}

/// Volume, centre of mass and greatest radius of a mesh that [`crate::check::repair`] has repaired.
///
/// Holes count as closed by flat caps: a cup whose wall is a single surface counts as full.
///
/// # Errors
/// No triangle has an area, or the surface encloses nothing.
pub fn solid_properties(mesh: &Mesh) -> Result<SolidProperties, MeshError> {
    let [least, most] = mesh.bounds();
    let centre = nalgebra::center(&least, &most);
    let longest_m = (most - least).max();
    let area_m2: f64 = mesh.corners().map(|[a, b, c]| (b - a).cross(&(c - a)).norm() / 2.0).sum();
    if area_m2.is_nan() || area_m2 <= 0.0 {
        return Err(MeshError::NoSurface { n_triangles: mesh.triangles.len() });
    }
    let caps = caps(mesh, mesh.triangles.iter().copied());
    let sheet_share = if caps.is_empty() { CLOSED_SHEET } else { OPEN_SHEET };
    let surface: Vec<[Point3<f64>; 3]> = mesh.corners().chain(caps).collect();
    let signed = signed_moments(&surface, &centre);
    let occupied = occupied_moments(&surface, &centre, [least, most]);
    let sheet_m3 = sheet_share * area_m2 * longest_m;
    let (moments, basis) = if (signed.volume_m3 - occupied.volume_m3).abs() < AGREEMENT * occupied.volume_m3
        && signed.volume_m3 > sheet_m3
    {
        (signed, Basis::SignedSums)
    } else if occupied.volume_m3 > sheet_m3 {
        (occupied, Basis::OccupiedColumns)
    } else {
        return Err(MeshError::NoInside);
    };
    let mean = moments.first / moments.volume_m3;
    let centre_of_mass_m = centre + mean;
    let covariance = moments.second / moments.volume_m3 - mean * mean.transpose();
    // Radii are measured along the principal axes: the rounding of every simulated recording so far comes from there.
    let mesh_from_principal = principal_axes(covariance);
    let used = mesh.triangles.iter().flatten().map(|idx| mesh.vertices_m[*idx as usize]);
    let max_radius_m = used
        .map(|vertex| mesh_from_principal.inverse_transform_vector(&(vertex - centre_of_mass_m)).norm())
        .fold(0.0, f64::max);
    Ok(SolidProperties { volume_m3: moments.volume_m3, centre_of_mass_m, max_radius_m, basis })
}

/// Integrals over a solid about a given point.
#[derive(Debug, Default)]
struct Moments {
    volume_m3: f64,
    /// Integral of the position.
    first: Vector3<f64>,
    /// Integral of the position times itself transposed.
    second: Matrix3<f64>,
}

/// Sums over the tetrahedra from `about` to each triangle.
fn signed_moments(surface: &[[Point3<f64>; 3]], about: &Point3<f64>) -> Moments {
    let mut moments = Moments::default();
    for corners in surface {
        let six_volumes = determinant(corners, about);
        moments.volume_m3 += six_volumes / 6.0;
        let (first, second) = corner_sums(corners, about);
        moments.first += first * (six_volumes / 24.0);
        moments.second += second * (six_volumes / 120.0);
    }
    moments
}

/// Sum s of the corners, and the sum of the squares of the corners and of s. First and second moments of a tetrahedron
/// with a corner at `about` are multiples of these.
fn corner_sums(corners: &[Point3<f64>; 3], about: &Point3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
    let sum: Vector3<f64> = corners.iter().map(|corner| corner - about).sum();
    let squares: Matrix3<f64> =
        corners.iter().map(|corner| corner - about).chain([sum]).map(|v| v * v.transpose()).sum();
    (sum, squares)
}

/// A point where a column meets the surface.
#[derive(Clone, Copy)]
struct Crossing {
    height_m: f64,
    /// Change of the winding number on the way up.
    step: i32,
}

/// Moments of the space that columns along the shortest side of the box find occupied.
///
/// The columns stand in a square lattice, turned by an angle that no wall of an object is likely to have. In a lattice
/// along the box, a thin wall along the box would fall between the columns or count for all of them. Across the columns,
/// corners are rounded to whole numbers, so that each ray passes a shared edge on exactly one side.
fn occupied_moments(surface: &[[Point3<f64>; 3]], about: &Point3<f64>, [least, most]: [Point3<f64>; 2]) -> Moments {
    let sides = most - least;
    let up = sides.imin();
    let [across, along] = [(up + 1) % 3, (up + 2) % 3];
    let mut moments = Moments::default();
    if sides[across] <= 0.0 || sides[along] <= 0.0 {
        return moments;
    }
    // The box, as a square of side 1, turned about its corner, fits into a square of side `reach`.
    let (sin, cos) = LATTICE_ANGLE_RAD.sin_cos();
    let reach = sin + cos;
    let mut columns = vec![Vec::new(); (N_COLUMNS * N_COLUMNS) as usize];
    for corners in surface {
        let flat = corners.map(|corner| {
            let [x, y] = [across, along].map(|axis| (corner[axis] - least[axis]) / sides[axis]);
            [cos * x - sin * y + sin, sin * x + cos * y].map(|place| 2 * (place / reach * FINE as f64).round() as i64)
        });
        push_crossings(&flat, corners.map(|corner| corner[up] - about[up]), &mut columns);
    }
    let cell = reach / N_COLUMNS as f64;
    let cell_m = [cell * sides[across], cell * sides[along]];
    let mut position: Vector3<f64> = Vector3::zeros();
    for (column_idx, column) in (0_i64..).zip(&mut columns) {
        column.sort_unstable_by(|a, b| a.height_m.total_cmp(&b.height_m));
        let [x, y] = [column_idx % N_COLUMNS, column_idx / N_COLUMNS].map(|idx| (idx as f64 + 0.5) * cell);
        let x = x - sin;
        position[across] = (cos * x + sin * y) * sides[across] + least[across] - about[across];
        position[along] = (cos * y - sin * x) * sides[along] + least[along] - about[along];
        let mut winding = 0;
        for pair in column.windows(2) {
            winding += pair[0].step;
            if winding >= 1 {
                let length_m = pair[1].height_m - pair[0].height_m;
                position[up] = (pair[0].height_m + pair[1].height_m) / 2.0;
                let volume_m3 = length_m * cell_m[0] * cell_m[1];
                moments.volume_m3 += volume_m3;
                moments.first += position * volume_m3;
                moments.second += position * position.transpose() * volume_m3;
                for (axis, side_m) in [(up, length_m), (across, cell_m[0]), (along, cell_m[1])] {
                    moments.second[(axis, axis)] += volume_m3 * side_m * side_m / 12.0;
                }
            }
        }
    }
    moments
}

/// Half of the whole numbers along a side of the box. Products of two differences stay far below 2^63.
const FINE: i64 = 1 << 20;

/// Adds the crossings of one triangle, given by its corners in even whole numbers and its heights, to the columns.
fn push_crossings(flat: &[[i64; 2]; 3], heights_m: [f64; 3], columns: &mut [Vec<Crossing>]) {
    // Twice the area of the triangle a, b, p.
    let side = |a: [i64; 2], b: [i64; 2], p: [i64; 2]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
    let [a, b, c] = *flat;
    let area = side(a, b, c);
    if area == 0 {
        return;
    }
    let edges = [[b, c], [c, a], [a, b]];
    // A point on the line counts as moved by (ε, ε²), for every triangle alike: so it is left of some edges that it lies on.
    let left_if_on = edges.map(|[a, b]| i64::from((a[1] - b[1], b[0] - a[0]) > (0, 0)));
    let spacing = 2 * FINE / N_COLUMNS;
    // Rays stand at odd numbers, corners at even ones.
    let ray = |idx: i64| idx * spacing + spacing / 2 + 1;
    let range = |axis: usize| {
        let low = a[axis].min(b[axis]).min(c[axis]);
        let high = a[axis].max(b[axis]).max(c[axis]);
        let first = (low - spacing / 2 - 1).div_euclid(spacing).max(0);
        let last = (high - spacing / 2 - 1).div_euclid(spacing).min(N_COLUMNS - 1);
        first..=last
    };
    // From one ray to the next across.
    let steps = edges.map(|[a, b]| (a[1] - b[1]) * spacing);
    for along_idx in range(1) {
        let first = [ray(*range(0).start()), ray(along_idx)];
        let mut sides = edges.map(|[a, b]| side(a, b, first));
        for across_idx in range(0) {
            let is_left = |idx: usize| sides[idx] + left_if_on[idx] > 0;
            if [is_left(0), is_left(1), is_left(2)] == [area > 0; 3] {
                let weighted: f64 = sides.iter().zip(heights_m).map(|(side, height_m)| *side as f64 * height_m).sum();
                columns[(along_idx * N_COLUMNS + across_idx) as usize].push(Crossing {
                    height_m: weighted / area as f64,
                    // A triangle seen counter-clockwise from above is a way out.
                    step: if area > 0 { -1 } else { 1 },
                });
            }
            sides = [sides[0] + steps[0], sides[1] + steps[1], sides[2] + steps[2]];
        }
    }
}

/// The rotation whose x, y and z are the eigenvectors of a covariance, largest first. Of the two directions of an axis, x
/// and y take the one whose largest part is positive.
fn principal_axes(covariance: Matrix3<f64>) -> UnitQuaternion<f64> {
    let eigen = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let [x, y] = [order[0], order[1]].map(|idx| {
        let axis = eigen.eigenvectors.column(idx).into_owned();
        axis * axis[axis.iamax()].signum()
    });
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
    UnitQuaternion::from_rotation_matrix(&rotation)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::check::repair;
    use crate::tests::{block, inside_out, random_motion, together};

    fn solid(mesh: Mesh) -> SolidProperties {
        solid_properties(&repair(mesh).0).expect("a solid")
    }

    fn assert_near(found: Point3<f64>, expected: [f64; 3], tolerance_m: f64) {
        assert!((found - Point3::from(expected)).norm() < tolerance_m, "{found} instead of {expected:?}");
    }

    /// Two cubes of volume 1 that share an eighth, and the centre of what they occupy.
    fn overlapping() -> (Mesh, f64, [f64; 3]) {
        (together(&[block([0.0; 3], [1.0; 3]), block([0.5; 3], [1.5; 3])]), 1.875, [0.75; 3])
    }

    #[test]
    fn a_cube_and_a_block_by_hand() {
        let cube = solid(block([0.0; 3], [1.0; 3]));
        assert!((cube.volume_m3 - 1.0).abs() < 1e-14);
        assert_near(cube.centre_of_mass_m, [0.5; 3], 1e-14);
        assert!((cube.max_radius_m - 0.75_f64.sqrt()).abs() < 1e-14);
        assert_eq!((cube.basis, cube.warnings().len()), (Basis::SignedSums, 0));

        let block = solid(block([1.0, 1.0, 1.0], [3.0, 7.0, 4.0]));
        assert!((block.volume_m3 - 36.0).abs() < 1e-12);
        assert!((block.max_radius_m - 3.5).abs() < 1e-12, "half the diagonal of 2, 6 and 3");
    }

    #[test]
    fn overlaps_count_once_and_cavities_not() {
        let (mesh, volume_m3, centre_m) = overlapping();
        let overlap = solid(mesh);
        assert!((overlap.volume_m3 / volume_m3 - 1.0).abs() < 0.005, "{overlap:?}");
        assert_near(overlap.centre_of_mass_m, centre_m, 0.005);
        assert_eq!(overlap.basis, Basis::OccupiedColumns);
        assert_eq!(overlap.warnings().len(), 1);

        let cavity = inside_out(block([0.25; 3], [0.75, 0.75, 0.5]));
        let hollow = solid(together(&[block([0.0; 3], [1.0; 3]), cavity]));
        assert!((hollow.volume_m3 - 0.9375).abs() < 1e-14);
        // (1·0.5 - 0.0625·0.375) / 0.9375
        assert_near(hollow.centre_of_mass_m, [0.5, 0.5, 0.508_333_333_333_333_3], 1e-14);
        assert_eq!(hollow.basis, Basis::SignedSums);

        let within = solid(together(&[block([0.0; 3], [1.0; 3]), block([0.25; 3], [0.75; 3])]));
        assert!((within.volume_m3 - 1.0).abs() < 0.005, "{within:?}");
        let apart = solid(together(&[block([0.0; 3], [1.0; 3]), block([2.0, 0.0, 0.0], [3.0, 1.0, 1.0])]));
        assert!((apart.volume_m3 - 2.0).abs() < 1e-14);
        assert_near(apart.centre_of_mass_m, [1.5, 0.5, 0.5], 1e-14);
    }

    #[test]
    fn a_surface_through_itself_counts_what_is_within() {
        // One component: an inner wall that passes out through the outer one counts negative in signed sums.
        let inner = inside_out(block([0.5, 0.25, 0.25], [1.5, 0.75, 0.75]));
        let mesh = together(&[block([0.0; 3], [1.0; 3]), inner]);
        assert!((mesh.signed_volume_m3() - 0.75).abs() < 1e-14);
        let found = solid_properties(&mesh).expect("a solid");
        assert!((found.volume_m3 - 0.875).abs() < 0.005, "{found:?}");
    }

    #[test]
    fn holes_are_capped() {
        let mut open = block([0.0; 3], [1.0; 3]);
        open.triangles.truncate(10);
        let found = solid(open.clone());
        assert!((found.volume_m3 - 1.0).abs() < 1e-14);
        assert_near(found.centre_of_mass_m, [0.5; 3], 1e-14);
        // And with an overlap, all of it inside out.
        let found = solid(inside_out(together(&[open, block([0.0, 0.0, 0.5], [1.0, 1.0, 1.5])])));
        assert!((found.volume_m3 - 1.5).abs() < 0.0075, "{found:?}");
        assert_near(found.centre_of_mass_m, [0.5, 0.5, 0.75], 0.005);
    }

    #[test]
    fn a_sheet_is_refused() {
        let corners = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.1, 0.0], [0.0, 0.1, 0.0]].map(Point3::from);
        let mut sheet = Mesh { vertices_m: corners.to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]] };
        sheet.transform(&random_motion(&mut ChaCha8Rng::seed_from_u64(3)));
        for mesh in [sheet, block([0.0; 3], [1.0, 1.0, 0.0])] {
            assert!(matches!(solid_properties(&repair(mesh).0), Err(MeshError::NoInside)));
        }
        assert!(matches!(solid_properties(&Mesh::default()), Err(MeshError::NoSurface { n_triangles: 0 })));
    }

    #[test]
    fn motion_changes_nothing() {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        let mut open = block([0.0; 3], [0.1, 0.2, 0.3]);
        open.triangles.truncate(10);
        let overlap = together(&[block([0.0; 3], [0.4, 0.6, 1.0]), block([0.2; 3], [0.6, 0.7, 1.4])]);
        for (mesh, tolerance) in [(block([0.0; 3], [0.1, 0.2, 0.3]), 1e-9), (open, 1e-9), (overlap, 0.01)] {
            let still = solid(mesh.clone());
            for _ in 0..10 {
                let motion = random_motion(&mut random);
                let mut moved = mesh.clone();
                moved.transform(&motion);
                let found = solid(moved);
                assert_eq!(found.basis, still.basis);
                assert!((found.volume_m3 / still.volume_m3 - 1.0).abs() < tolerance, "{found:?} {still:?}");
                assert_near(found.centre_of_mass_m, (motion * still.centre_of_mass_m).into(), tolerance);
                assert!((found.max_radius_m / still.max_radius_m - 1.0).abs() < tolerance);
            }
        }
    }
}
