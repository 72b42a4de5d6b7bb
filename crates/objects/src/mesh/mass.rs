//! Volume, centre of mass and principal axes of the solid that a mesh encloses.
//!
//! Two ways, and the one checks the other. **Signed sums** over the triangles are exact where the surface is closed,
//! faces outwards and nowhere passes through itself. **Columns** count what is occupied: parallel rays through the
//! mesh, along each of which the winding number is known exactly; where it is 1 or more there is solid, so that overlaps
//! count once. Holes are closed with caps before either. Where both agree, the sums are given.

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use serde::Serialize;

use super::topology::{caps, determinant};
use super::{Mesh, MeshError};

/// How thick a surface that encloses nothing is taken to be.
pub const SHEET_THICKNESS_M: f64 = 0.001;

/// Columns along either side of the mesh's box. A power of two.
const N_COLUMNS: i64 = 128;
/// How far their lattice is turned: its tangent is the golden ratio's inverse, the number furthest from any fraction.
const LATTICE_ANGLE_RAD: f64 = 0.553_574_358_897_045_3;
/// The signed sums count as confirmed when the columns' volume differs from theirs by less than this share.
const AGREEMENT: f64 = 0.01;
/// A surface with holes that, capped, holds less than this share of its area times its longest side is a sheet. (A
/// sphere holds a sixth; a sheet bent by a hundredth of its length about a two-hundredth.)
const OPEN_SHEET: f64 = 1e-3;
/// The same for closed surfaces: nothing but rounding.
const CLOSED_SHEET: f64 = 1e-9;

/// A homogeneous solid.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SolidProperties {
    /// Volume.
    pub volume_m3: f64,
    /// Centre of mass, in the mesh's frame.
    pub centre_of_mass_m: Point3<f64>,
    /// The largest distance of a vertex from the centre of mass.
    pub max_radius_m: f64,
    /// From the principal frame to the mesh's: x along the axis with the largest spread of volume, z with the least.
    pub mesh_from_principal: UnitQuaternion<f64>,
    /// Lengths of the mesh along the principal axes.
    pub principal_extents_m: Vector3<f64>,
    /// How these were found.
    pub basis: Basis,
}

/// How a solid's properties were found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Basis {
    /// Signed sums over the triangles: exact.
    SignedSums,
    /// Columns through the mesh: what is inside by winding number; overlapping parts count once.
    OccupiedColumns,
    /// The surface encloses nothing: it is a sheet of [`SHEET_THICKNESS_M`].
    Sheet,
}

impl SolidProperties {
    /// What a user should know of, in words.
    pub fn warnings(&self) -> Vec<String> {
        match self.basis {
            Basis::SignedSums => Vec::new(),
            Basis::OccupiedColumns => {
                vec!["the surface overlaps itself: its volume is counted, to about 1 %, with overlaps once".into()]
            }
            Basis::Sheet => vec![format!(
                "the surface encloses nothing: it is taken for a sheet {} mm thick",
                SHEET_THICKNESS_M * 1000.0
            )],
        }
    }
}

/// Volume, centre of mass, greatest radius and principal axes of a mesh that [`super::check::repair`] has been through.
///
/// Holes count as closed by flat caps: a cup whose wall is a single surface counts as full.
///
/// # Errors
/// No triangle has an area.
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
        (sheet_moments(mesh, &centre), Basis::Sheet)
    };
    let mean = moments.first / moments.volume_m3;
    let centre_of_mass_m = centre + mean;
    let covariance = moments.second / moments.volume_m3 - mean * mean.transpose();
    let mesh_from_principal = principal_axes(covariance);
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    let mut max_radius_m: f64 = 0.0;
    for vertex in mesh.triangles.iter().flatten().map(|idx| mesh.vertices_m[*idx as usize]) {
        let from_centre = mesh_from_principal.inverse_transform_vector(&(vertex - centre_of_mass_m));
        (low, high) = (low.inf(&from_centre), high.sup(&from_centre));
        max_radius_m = max_radius_m.max(from_centre.norm());
    }
    Ok(SolidProperties {
        volume_m3: moments.volume_m3,
        centre_of_mass_m,
        max_radius_m,
        mesh_from_principal,
        principal_extents_m: high - low,
        basis,
    })
}

/// Integrals over a solid, about a given point.
#[derive(Debug, Default)]
struct Moments {
    volume_m3: f64,
    /// Of the position.
    first: Vector3<f64>,
    /// Of the position times itself transposed.
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

/// The surface itself, with a thickness.
fn sheet_moments(mesh: &Mesh, about: &Point3<f64>) -> Moments {
    let mut moments = Moments::default();
    for corners in mesh.corners() {
        let [a, b, c] = corners;
        let volume_m3 = (b - a).cross(&(c - a)).norm() / 2.0 * SHEET_THICKNESS_M;
        moments.volume_m3 += volume_m3;
        let (first, second) = corner_sums(&corners, about);
        moments.first += first * (volume_m3 / 3.0);
        moments.second += second * (volume_m3 / 12.0);
    }
    moments
}

/// Sum s of the corners, and the sum of the squares of the corners and of s: what first and second moments of triangles
/// and of tetrahedra with a corner at `about` are made of.
fn corner_sums(corners: &[Point3<f64>; 3], about: &Point3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
    let sum: Vector3<f64> = corners.iter().map(|corner| corner - about).sum();
    let squares: Matrix3<f64> =
        corners.iter().map(|corner| corner - about).chain([sum]).map(|v| v * v.transpose()).sum();
    (sum, squares)
}

/// Where a column meets the surface.
#[derive(Clone, Copy)]
struct Crossing {
    height_m: f64,
    /// Change of the winding number on the way up.
    step: i32,
}

/// What columns along the shortest side of the box find occupied.
///
/// The columns stand in a square lattice, turned by an angle that no wall of an object is likely to have: in a lattice
/// along the box, a thin wall along the box too would fall between the columns or count for all of them. Across the
/// columns, corners are rounded to whole numbers, so that each ray passes a shared edge on exactly one side: no ray slips
/// through between two triangles or meets both.
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

/// Where the columns meet one triangle, given by its corners in whole even numbers and its heights.
fn push_crossings(flat: &[[i64; 2]; 3], heights_m: [f64; 3], columns: &mut [Vec<Crossing>]) {
    // Twice the area of the triangle a, b, p. A point on the line counts as moved by (ε, ε²), for every triangle alike.
    let side = |a: [i64; 2], b: [i64; 2], p: [i64; 2]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
    let is_left = |a: [i64; 2], b: [i64; 2], side: i64| (side, a[1] - b[1], b[0] - a[0]) > (0, 0, 0);
    let [a, b, c] = *flat;
    let area = side(a, b, c);
    if area == 0 {
        return;
    }
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
    for along_idx in range(1) {
        for across_idx in range(0) {
            let point = [ray(across_idx), ray(along_idx)];
            let sides = [side(b, c, point), side(c, a, point), side(a, b, point)];
            let lefts = [is_left(b, c, sides[0]), is_left(c, a, sides[1]), is_left(a, b, sides[2])];
            if lefts != [area > 0; 3] {
                continue;
            }
            let weighted: f64 = sides.iter().zip(heights_m).map(|(side, height_m)| *side as f64 * height_m).sum();
            columns[(along_idx * N_COLUMNS + across_idx) as usize].push(Crossing {
                height_m: weighted / area as f64,
                // A triangle seen counter-clockwise from above is a way out.
                step: if area > 0 { -1 } else { 1 },
            });
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

    use super::super::check::repair;
    use super::super::tests::{block, random_motion};
    use super::*;

    fn solid(mesh: Mesh) -> SolidProperties {
        solid_properties(&repair(mesh).0).expect("a solid")
    }

    fn together(meshes: &[Mesh]) -> Mesh {
        let mut all = Mesh::default();
        meshes.iter().for_each(|mesh| all.append(mesh));
        all
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
        assert!((block.principal_extents_m - Vector3::new(6.0, 3.0, 2.0)).norm() < 1e-12);
        let longest = block.mesh_from_principal * Vector3::x();
        assert!((longest - Vector3::y()).norm() < 1e-12, "{longest}");
        assert!((block.mesh_from_principal * Vector3::z() - Vector3::x()).norm() < 1e-12);
    }

    #[test]
    fn overlaps_count_once_and_cavities_not() {
        let (mesh, volume_m3, centre_m) = overlapping();
        let overlap = solid(mesh);
        assert!((overlap.volume_m3 / volume_m3 - 1.0).abs() < 0.005, "{overlap:?}");
        assert_near(overlap.centre_of_mass_m, centre_m, 0.005);
        assert_eq!(overlap.basis, Basis::OccupiedColumns);
        assert_eq!(overlap.warnings().len(), 1);
        let longest = overlap.mesh_from_principal * Vector3::x();
        assert!((longest.dot(&Vector3::repeat(1.0).normalize()) - 1.0).abs() < 1e-4, "{longest}");

        let mut cavity = block([0.25; 3], [0.75, 0.75, 0.5]);
        cavity.triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
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
        let mut inner = block([0.5, 0.25, 0.25], [1.5, 0.75, 0.75]);
        inner.triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
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
        // And turned inside out, with an overlap.
        open.triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
        let found = solid(together(&[open, block([0.0, 0.0, 0.5], [1.0, 1.0, 1.5])]));
        assert!((found.volume_m3 - 1.5).abs() < 0.0075, "{found:?}");
        assert_near(found.centre_of_mass_m, [0.5, 0.5, 0.75], 0.005);
    }

    #[test]
    fn a_sheet_has_a_centre_and_a_thickness() {
        let corners = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.1, 0.0], [0.0, 0.1, 0.0]].map(Point3::from);
        let mut sheet = Mesh { vertices_m: corners.to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]] };
        sheet.transform(&random_motion(&mut ChaCha8Rng::seed_from_u64(3)));
        let centre = nalgebra::center(&sheet.vertices_m[0], &sheet.vertices_m[2]);
        let found = solid(sheet);
        assert_eq!(found.basis, Basis::Sheet);
        assert!((found.volume_m3 - 0.2 * 0.1 * SHEET_THICKNESS_M).abs() < 1e-15);
        assert_near(found.centre_of_mass_m, centre.into(), 1e-12);
        assert!((found.principal_extents_m - Vector3::new(0.2, 0.1, 0.0)).norm() < 1e-9, "{found:?}");
        assert!(found.warnings()[0].contains("1 mm thick"), "{:?}", found.warnings());
        // Twice, the other way round: still a sheet.
        let [a, b] = [block([0.0; 3], [1.0, 1.0, 0.0]), Mesh::default()].map(solid_properties_of);
        assert_eq!(a.expect("a flat box").basis, Basis::Sheet);
        assert!(matches!(b, Err(MeshError::NoSurface { n_triangles: 0 })));
    }

    fn solid_properties_of(mesh: Mesh) -> Result<SolidProperties, MeshError> {
        solid_properties(&repair(mesh).0)
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
                assert!((found.principal_extents_m - still.principal_extents_m).norm() < 5.0 * tolerance);
            }
        }
    }
}
