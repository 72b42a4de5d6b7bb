//! Collision meshes of a URDF: finding the file, and its convex hull.

use std::path::{Path, PathBuf};

use blindgrasp_mesh::read::read_mesh;
use blindgrasp_messages::files::read_regular;
use nalgebra::Vector3;
use parry3d_f64::math::Vector;
use parry3d_f64::shape::SharedShape;
use parry3d_f64::transformation::try_convex_hull;

/// Most corners of the hull of a link with a pad. A hull of more is cut down to the outermost points in so many directions.
const N_CORNERS_OF_PADDED: usize = 200;
/// The same of a link without: its surface is within some 2 % of its size, and distances to it take a quarter of the time.
const N_CORNERS_OF_OTHERS: usize = 48;

/// The longest mesh of a hand's link. One in millimetres is far longer.
const MAX_MESH_M: f64 = 2.0;

/// The convex hull of a mesh file, whose coordinates are multiplied by `scale`, for a link with or without a pad.
///
/// # Errors
/// No such file, a file that is no mesh, or a mesh without volume.
pub(super) fn hull(path: &Path, scale: [f64; 3], has_pad: bool) -> Result<SharedShape, String> {
    let n_most = if has_pad { N_CORNERS_OF_PADDED } else { N_CORNERS_OF_OTHERS };
    let mesh = read_mesh(path, 1.0).map_err(|error| error.to_string())?;
    let points: Vec<Vector> = mesh
        .vertices_m
        .iter()
        .map(|point| Vector::new(point.x * scale[0], point.y * scale[1], point.z * scale[2]))
        .collect();
    let length_m = (0..3).map(|axis| extent(&points, axis)).fold(0.0, f64::max);
    if length_m > MAX_MESH_M {
        return Err(format!(
            "mesh {} is {length_m:.0} m long, expected at most {MAX_MESH_M} m: write scale=\"0.001 0.001 0.001\" in its <mesh> \
             if it is in millimetres (inches: 0.0254)",
            path.display()
        ));
    }
    let refused = |reason: &dyn std::fmt::Display| format!("{}: it has no convex hull: {reason}", path.display());
    let hull = |points: &[Vector]| try_convex_hull(points).map_err(|error| refused(&error));
    let (mut corners, mut triangles) = hull(&points)?;
    if corners.len() > n_most {
        let mut outermost: Vec<usize> = directions(n_most).map(|direction| outermost(&corners, &direction)).collect();
        outermost.sort_unstable();
        outermost.dedup();
        let kept: Vec<Vector> = outermost.into_iter().map(|idx| corners[idx]).collect();
        (corners, triangles) = hull(&kept)?;
    }
    let shape = SharedShape::convex_mesh(corners, &triangles);
    // A flat mesh has a hull without a volume; a cube of a tenth of a millimetre has 1e-12 m³.
    shape.filter(|shape| shape.mass_properties(1.0).mass() > 1e-12).ok_or_else(|| refused(&"it is flat"))
}

fn extent(points: &[Vector], axis: usize) -> f64 {
    let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
    for point in points {
        least = least.min(point[axis]);
        most = most.max(point[axis]);
    }
    most - least
}

/// Directions that are spread evenly over the sphere (a Fibonacci lattice).
fn directions(n_directions: usize) -> impl Iterator<Item = Vector3<f64>> {
    let golden_angle = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..n_directions).map(move |idx| {
        let z = 1.0 - (2.0 * idx as f64 + 1.0) / n_directions as f64;
        let (sin, cos) = libm::sincos(golden_angle * idx as f64);
        let radius = (1.0 - z * z).sqrt();
        Vector3::new(radius * cos, radius * sin, z)
    })
}

fn outermost(points: &[Vector], direction: &Vector3<f64>) -> usize {
    let along = |point: &Vector| point.x * direction.x + point.y * direction.y + point.z * direction.z;
    (0..points.len()).max_by(|a, b| along(&points[*a]).total_cmp(&along(&points[*b]))).unwrap_or(0)
}

/// The file that a URDF names: a path, relative to the URDF's folder; `file://PATH`; or `package://PACKAGE/PATH`, where the
/// package is [`found`](find_package) as ROS does.
///
/// # Errors
/// A package that is in none of these places.
pub fn find(named: &str, urdf_folder: &Path) -> Result<PathBuf, String> {
    if let Some(path) = named.strip_prefix("file://") {
        return Ok(urdf_folder.join(path));
    }
    let Some(in_package) = named.strip_prefix("package://").or_else(|| named.strip_prefix("model://")) else {
        return Ok(urdf_folder.join(named));
    };
    let (package, rest) = in_package.split_once('/').unwrap_or((in_package, ""));
    find_package(package, urdf_folder).map(|folder| folder.join(rest)).find(|path| path.is_file()).ok_or_else(|| {
        format!(
            "{named}: no such file in a folder of the package '{package}', whose name or package.xml says so, above the URDF or \
             beside one of these, or in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH"
        )
    })
}

/// The file that a URDF names, as [`find`] does. For a path of another computer or system, it is the file in the URDF's folder or
/// beside it with the longest same end of its path, in whatever case.
///
/// # Errors
/// Neither is there.
pub fn find_alike(named: &str, urdf_folder: &Path) -> Result<PathBuf, String> {
    let found = find(named, urdf_folder);
    if found.as_ref().is_ok_and(|file| file.is_file()) {
        return found;
    }
    let plain = unescaped(named).replace('\\', "/");
    let parts: Vec<&str> = plain.split('/').filter(|part| !matches!(*part, "" | "." | "..")).collect();
    let folder = absolute(urdf_folder);
    for start in 0..parts.len() {
        for root in folder.ancestors().take(2) {
            if let Some(file) = file_below(root, &parts[start..]) {
                return Ok(file);
            }
        }
    }
    found.and_then(|_| {
        Err(format!("{named}: no such file, and none in {} or beside it whose path ends alike", folder.display()))
    })
}

/// The text with the bytes that it has as in an address: %20 for a blank, %2F for a slash.
fn unescaped(text: &str) -> String {
    let (mut plain, mut idx) = (Vec::new(), 0);
    while idx < text.len() {
        let mut byte = text.as_bytes()[idx];
        if byte == b'%'
            && let Some(digits) = text.get(idx + 1..idx + 3)
            && let Ok(code) = u8::from_str_radix(digits, 16)
        {
            byte = code;
            idx += 2;
        }
        plain.push(byte);
        idx += 1;
    }
    String::from_utf8_lossy(&plain).into_owned()
}

/// The absolute path of a folder, which is empty for a file that is named without one.
fn absolute(folder: &Path) -> PathBuf {
    std::path::absolute(Path::new(".").join(folder)).unwrap_or_else(|_| folder.into())
}

/// The file at this path below a folder; a name in another case is taken if there is none in this one.
fn file_below(folder: &Path, parts: &[&str]) -> Option<PathBuf> {
    let Some((first, rest)) = parts.split_first() else { return folder.is_file().then(|| folder.into()) };
    if let Some(file) = file_below(&folder.join(first), rest) {
        return Some(file);
    }
    for entry in std::fs::read_dir(folder).ok()?.flatten() {
        if entry.file_name().to_string_lossy().to_lowercase() == first.to_lowercase()
            && let Some(file) = file_below(&entry.path(), rest)
        {
            return Some(file);
        }
    }
    None
}

/// Folders in which a package of ROS may be: a folder above `from` or beside one of those that has its name, or whose
/// `package.xml` names it. A folder of that name in ROS's `ROS_PACKAGE_PATH` or `AMENT_PREFIX_PATH` is one as well.
pub fn find_package<'a>(package: &'a str, from: &Path) -> impl Iterator<Item = PathBuf> + use<'a> {
    let from = absolute(from);
    let above: Vec<PathBuf> = from.ancestors().map(Path::to_path_buf).collect();
    let by_name = above.clone().into_iter().flat_map(move |folder| {
        let itself = folder.file_name().is_some_and(|name| name == package).then(|| folder.clone());
        itself.into_iter().chain([folder.join(package)])
    });
    // The root is no workspace.
    let above = above.into_iter().take(MAX_ABOVE).filter(|folder| folder.parent().is_some());
    let declared = above.flat_map(move |folder| {
        let beside = folders_in(&folder).into_iter().flat_map(|folder| {
            let below = folders_in(&folder);
            std::iter::once(folder).chain(below)
        });
        std::iter::once(folder).chain(beside).take(MAX_SOUGHT).filter(move |folder| declares(folder, package))
    });
    let listed = |variable: &str, between: &str| -> Vec<PathBuf> {
        let paths = std::env::var_os(variable).unwrap_or_default();
        std::env::split_paths(&paths).map(|folder| folder.join(between).join(package)).collect()
    };
    let ros = listed("ROS_PACKAGE_PATH", "").into_iter().chain(listed("AMENT_PREFIX_PATH", "share"));
    by_name.chain(ros).chain(declared).filter(|folder| folder.is_dir())
}

/// Folders above a URDF in which packages are sought by their `package.xml`: a workspace is at most so far away.
const MAX_ABOVE: usize = 5;
/// Folders that are looked into for each of those.
const MAX_SOUGHT: usize = 500;

fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    let mut paths: Vec<PathBuf> = folders.map(|entry| entry.path()).take(MAX_SOUGHT).collect();
    paths.sort_unstable();
    paths
}

/// Whether a folder has a `package.xml` with this name.
fn declares(folder: &Path, package: &str) -> bool {
    let text = read_regular(&folder.join("package.xml")).unwrap_or_default();
    let name =
        text.split_once("<name>").and_then(|(_, after)| after.split_once("</name>")).map(|(name, _)| name.trim());
    name == Some(package)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An OBJ file of a ball of 1,000 corners with a radius of 20 mm, in millimetres.
    fn ball_obj() -> String {
        let ball = parry3d_f64::shape::Ball::new(20.0).to_trimesh(32, 32);
        let corners: String = ball.0.iter().map(|point| format!("v {} {} {}\n", point.x, point.y, point.z)).collect();
        let faces: String = ball.1.iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1)).collect();
        corners + &faces
    }

    #[test]
    fn a_hull_has_few_corners_and_the_meshs_size() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ball.obj");
        std::fs::write(&path, ball_obj()).expect("written");
        for (has_pad, n_most, least_volume) in [(true, N_CORNERS_OF_PADDED, 0.93), (false, N_CORNERS_OF_OTHERS, 0.8)] {
            let hull = hull(&path, [0.001; 3], has_pad).expect("a hull");
            let n_corners = hull.as_convex_polyhedron().expect("a polyhedron").points().len();
            assert!((n_most / 2..=n_most).contains(&n_corners), "{n_corners}");
            let volume_m3 = hull.mass_properties(1.0).mass();
            let of_ball_m3 = 4.0 / 3.0 * std::f64::consts::PI * 0.02_f64.powi(3);
            assert!((least_volume..1.0).contains(&(volume_m3 / of_ball_m3)), "{}", volume_m3 / of_ball_m3);
        }
    }

    #[test]
    fn a_mesh_in_millimetres_is_named_with_the_scale_to_set() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ball.obj");
        std::fs::write(&path, ball_obj()).expect("written");
        let error = hull(&path, [1.0; 3], true).expect_err("40 m");
        assert!(error.contains("ball.obj is 40 m long") && error.contains("scale=\"0.001 0.001 0.001\""), "{error}");
    }

    #[test]
    fn a_mesh_of_another_computer_is_found_by_the_end_of_its_path() {
        let folder = tempfile::tempdir().expect("a folder");
        let urdf = folder.path().join("urdf");
        for name in ["urdf/m", "meshes/collision"] {
            std::fs::create_dir_all(folder.path().join(name)).expect("made");
        }
        let [near, far] = ["urdf/m/tip one.stl", "meshes/collision/palm.stl"].map(|name| folder.path().join(name));
        for file in [&near, &far] {
            std::fs::write(file, "").expect("written");
        }
        for (named, expected) in [
            ("m/tip one.stl", &near),
            ("m\\tip one.stl", &near),
            ("m%2Ftip%20one%2estl", &near),
            ("M/Tip One.STL", &near),
            ("package:///m/tip one.stl", &near),
            ("/home/someone/ws/src/trio/m/tip one.stl", &near),
            ("file://$(find trio)/m/tip one.stl", &near),
            ("C:\\ws\\meshes\\collision\\palm.stl", &far),
            ("package://nowhere/meshes/collision/palm.stl", &far),
        ] {
            let found = find_alike(named, &urdf).expect(named);
            assert_eq!(found.canonicalize().expect("there"), expected.canonicalize().expect("there"), "{named}");
        }
        let error = find_alike("/home/someone/none.stl", &urdf).expect_err("none");
        assert!(error.contains("none.stl: no such file, and none in"), "{error}");
        assert!(find_alike("package://nowhere/none.stl", &urdf).expect_err("none").contains("'nowhere'"));
    }

    #[test]
    fn a_flat_mesh_and_a_missing_one_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let flat = folder.path().join("flat.obj");
        std::fs::write(&flat, "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n").expect("written");
        for path in [flat, folder.path().join("none.stl"), folder.path().join("scene.fbx")] {
            let error = hull(&path, [1.0; 3], true).expect_err("no hull");
            assert!(error.contains(path.file_name().and_then(|name| name.to_str()).expect("a name")), "{error}");
        }
    }

    #[test]
    fn packages_are_found_above_and_beside_the_urdf() {
        let folder = tempfile::tempdir().expect("a folder");
        let package = folder.path().join("my_hand");
        for name in ["my_hand/urdf", "my_hand/meshes", "other/meshes", "repository/third-main/meshes"] {
            std::fs::create_dir_all(folder.path().join(name)).expect("made");
        }
        std::fs::write(package.join("meshes/tip.stl"), "").expect("written");
        std::fs::write(folder.path().join("other/meshes/palm.stl"), "").expect("written");
        let third = folder.path().join("repository/third-main");
        std::fs::write(third.join("meshes/nail.stl"), "").expect("written");
        std::fs::write(third.join("package.xml"), "<package><name> third </name></package>").expect("written");
        let urdf = package.join("urdf");
        for (named, expected) in [
            ("package://my_hand/meshes/tip.stl", package.join("meshes/tip.stl")),
            ("package://other/meshes/palm.stl", folder.path().join("other/meshes/palm.stl")),
            ("package://third/meshes/nail.stl", third.join("meshes/nail.stl")),
            ("../meshes/tip.stl", urdf.join("../meshes/tip.stl")),
            ("file:///tip.stl", PathBuf::from("/tip.stl")),
        ] {
            assert_eq!(find(named, &urdf), Ok(expected), "{named}");
        }
        // A URDF that is named without a folder lies in the present one: here that of the crate.
        let present = std::env::current_dir().expect("a folder");
        let name = present.file_name().and_then(|name| name.to_str()).expect("a name");
        let found = find(&format!("package://{name}/Cargo.toml"), Path::new(""));
        assert_eq!(found, Ok(present.join("Cargo.toml")));
        let error = find("package://nowhere/tip.stl", &urdf).expect_err("no package");
        assert!(error.contains("'nowhere'") && error.contains("AMENT_PREFIX_PATH"), "{error}");
    }
}
