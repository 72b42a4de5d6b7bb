//! Triangle meshes: what objects are made of.
//!
//! The path of a user's object: [`folder`] (which files, of what class and scale) -> [`read`] (OFF, OBJ, STL, PLY) ->
//! [`check`] (its size; what is wrong with the surface, and the repair) -> [`mass`] (volume, centre of mass, axes).
//!
//! Colours, normals, textures and materials of the files are not read; shapes are not simplified.

pub mod check;
mod error;
pub mod folder;
mod format;
pub mod mass;
mod obj;
mod off;
mod ply;
pub mod read;
pub mod shape;
mod stl;
#[cfg(test)]
mod tests;
mod topology;
pub mod write;

pub use error::MeshError;

use nalgebra::{Isometry3, Point3, Vector3};

/// A triangle mesh, metres. A closed surface's triangles are counter-clockwise seen from outside.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Corners.
    pub vertices_m: Vec<Point3<f64>>,
    /// Three indices into the corners each.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Adds another mesh's triangles; the two stay separate components.
    pub fn append(&mut self, other: &Mesh) {
        let first = self.vertices_m.len() as u32;
        self.vertices_m.extend_from_slice(&other.vertices_m);
        self.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|idx| first + idx)));
    }

    /// The corners of each triangle.
    pub fn corners(&self) -> impl Iterator<Item = [Point3<f64>; 3]> + '_ {
        self.triangles.iter().map(|triangle| triangle.map(|idx| self.vertices_m[idx as usize]))
    }

    /// Moves all corners.
    pub fn transform(&mut self, to_from_here: &Isometry3<f64>) {
        self.vertices_m.iter_mut().for_each(|vertex| *vertex = to_from_here * *vertex);
    }

    /// The least and the largest corner of the box around the mesh; zeros for an empty mesh.
    pub fn bounds(&self) -> [Point3<f64>; 2] {
        let least = self.vertices_m.iter().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let most = self.vertices_m.iter().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        [least, most]
    }

    /// Volume as the sum of signed tetrahedra over the origin: right for a
    /// closed mesh whose triangles all face outwards and whose components don't overlap.
    pub fn signed_volume_m3(&self) -> f64 {
        self.corners().map(|[a, b, c]| a.coords.dot(&b.coords.cross(&c.coords))).sum::<f64>() / 6.0
    }

    /// Unit normal of a triangle; zero for one without area.
    pub fn normal(&self, triangle_idx: usize) -> Vector3<f64> {
        let [a, b, c] = self.triangles[triangle_idx].map(|idx| self.vertices_m[idx as usize]);
        (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default()
    }
}
