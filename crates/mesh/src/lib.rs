//! Triangle meshes: read from files, checked, repaired and weighed.
//!
//! The path of a mesh: [`read`] (OFF, OBJ, STL, PLY, COLLADA, glTF) -> [`check`] (size, faults of the surface, repair) -> [`mass`]
//! (volume, centre of mass). Colours, normals, textures and materials of the files are not read; shapes are not
//! simplified.
//!
//! ```
//! use blindgrasp_mesh::{Mesh, check::repair, mass::solid_properties};
//! use nalgebra::Point3;
//!
//! // A corner of a cube of 60 mm. The last triangle faces inwards.
//! let corners = [[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.0, 0.06, 0.0], [0.0, 0.0, 0.06]];
//! let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [3, 2, 1]];
//! let mesh = Mesh { vertices_m: corners.map(Point3::from).to_vec(), triangles };
//!
//! let (mesh, survey) = repair(mesh);
//! assert_eq!(survey.n_misoriented, 1);
//! let solid = solid_properties(&mesh)?;
//! assert!((solid.volume_m3 - 36e-6).abs() < 1e-12);
//! assert!((solid.centre_of_mass_m - Point3::new(0.015, 0.015, 0.015)).norm() < 1e-9);
//! # Ok::<(), blindgrasp_mesh::MeshError>(())
//! ```

pub mod check;
mod error;
pub mod mass;
mod obj;
mod off;
mod ply;
pub mod read;
mod scene;
pub mod shape;
mod stl;
#[cfg(test)]
mod tests;
mod topology;

pub use error::MeshError;
pub use off::write_off;

use nalgebra::{Isometry3, Point3, Vector3};
use serde::{Deserialize, Serialize};

/// A triangle mesh, metres. A closed surface's triangles are counter-clockwise seen from outside.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Mesh {
    pub vertices_m: Vec<Point3<f64>>,
    /// Indices of each triangle's corners.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Adds another mesh, which stays a separate component.
    pub fn append(&mut self, other: &Mesh) {
        let first = self.vertices_m.len() as u32;
        self.vertices_m.extend_from_slice(&other.vertices_m);
        self.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|idx| first + idx)));
    }

    pub fn corners(&self) -> impl Iterator<Item = [Point3<f64>; 3]> + '_ {
        self.triangles.iter().map(|triangle| triangle.map(|idx| self.vertices_m[idx as usize]))
    }

    pub fn transform(&mut self, to_from_here: &Isometry3<f64>) {
        self.vertices_m.iter_mut().for_each(|vertex| *vertex = to_from_here * *vertex);
    }

    /// The least and the largest corner of the box around the mesh; zeros for an empty mesh.
    pub fn bounds(&self) -> [Point3<f64>; 2] {
        let least = self.vertices_m.iter().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let most = self.vertices_m.iter().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        [least, most]
    }

    /// Volume as the sum of signed tetrahedra over the origin. It is right for a closed mesh whose triangles all face
    /// outwards and whose components do not overlap.
    pub fn signed_volume_m3(&self) -> f64 {
        self.corners().map(|[a, b, c]| a.coords.dot(&b.coords.cross(&c.coords))).sum::<f64>() / 6.0
    }

    /// Unit normal of a triangle; zero for one without area.
    pub fn normal(&self, triangle_idx: usize) -> Vector3<f64> {
        let [a, b, c] = self.triangles[triangle_idx].map(|idx| self.vertices_m[idx as usize]);
        (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default()
    }
}
