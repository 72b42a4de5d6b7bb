//! The surface of parry's shapes.

use nalgebra::Point3;
use parry3d_f64::math::Vector;
use parry3d_f64::shape::{SharedShape, TypedShape};

use crate::Mesh;

/// How many flat pieces go around a round shape.
const N_AROUND: u32 = 64;

/// The surface of a shape as triangles, in its own frame: a mesh as it is, round shapes in 64 pieces around. Empty for
/// kinds that have no surface or are never used here.
pub fn mesh_of_shape(shape: &SharedShape) -> Mesh {
    let (vertices, triangles) = match shape.as_typed_shape() {
        TypedShape::TriMesh(mesh) => (mesh.vertices().to_vec(), mesh.indices().to_vec()),
        TypedShape::Ball(ball) => ball.to_trimesh(N_AROUND, N_AROUND / 2),
        TypedShape::Cuboid(cuboid) => cuboid.to_trimesh(),
        TypedShape::Capsule(capsule) => capsule.to_trimesh(N_AROUND, N_AROUND / 4),
        TypedShape::Cylinder(cylinder) => cylinder.to_trimesh(N_AROUND),
        TypedShape::Cone(cone) => cone.to_trimesh(N_AROUND),
        TypedShape::ConvexPolyhedron(polyhedron) => polyhedron.to_trimesh(),
        _ => Default::default(),
    };
    let point = |vertex: Vector| Point3::new(vertex.x, vertex.y, vertex.z);
    Mesh { vertices_m: vertices.into_iter().map(point).collect(), triangles }
}
