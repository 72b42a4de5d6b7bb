//! Writing meshes: OFF, OBJ, STL (binary) and PLY (binary).

use std::path::Path;

use super::format::Format;
use super::{Mesh, MeshError, obj, off, ply, stl};

/// Writes a mesh, in the format that the extension says. OFF, OBJ and PLY keep `f64`, STL `f32` and no shared vertices.
///
/// # Errors
/// An unknown extension, a mesh that the format cannot hold, a file that cannot be written.
pub fn write_mesh(path: &Path, mesh: &Mesh) -> Result<(), MeshError> {
    let not_writable = |reason| MeshError::NotWritable { path: path.into(), reason };
    let format = Format::of(path)?;
    if !mesh.vertices_m.iter().flat_map(|vertex| vertex.iter()).all(|coordinate| coordinate.is_finite()) {
        return Err(not_writable("coordinates that are not finite"));
    }
    let bytes = match format {
        Format::Off => off::format(mesh),
        Format::Obj => obj::format(mesh),
        Format::Ply => ply::format(mesh),
        Format::Stl => {
            let greatest = mesh.vertices_m.iter().map(|vertex| vertex.coords.amax()).fold(0.0, f64::max);
            if greatest > f64::from(f32::MAX) {
                return Err(not_writable("coordinates beyond f32, which STL is in"));
            }
            let n_triangles = u32::try_from(mesh.triangles.len());
            stl::format(mesh, n_triangles.map_err(|_| not_writable("more than 2^32 triangles"))?)
        }
    };
    std::fs::write(path, bytes).map_err(|source| MeshError::Write { path: path.into(), source })
}
