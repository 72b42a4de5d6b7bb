//! Errors of reading, writing and using meshes.

use std::path::PathBuf;

/// Why a mesh could not be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    #[error("cannot read mesh {}: {source}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("cannot write mesh {}: {source}", path.display())]
    Write { path: PathBuf, source: std::io::Error },
    #[error("{}: expected a mesh file that ends in .off, .obj, .stl, .ply, .dae or .glb", path.display())]
    UnknownFormat { path: PathBuf },
    #[error("{}: the file is empty", path.display())]
    Empty { path: PathBuf },
    #[error(
        "{}: it is a pointer of Git LFS, not the mesh itself: run `git lfs pull`, or check out with LFS",
        path.display()
    )]
    GitLfsPointer { path: PathBuf },
    #[error("{}: no triangles: expected a surface, found {n_vertices} vertices only", path.display())]
    NoTriangles { path: PathBuf, n_vertices: usize },
    /// The file does not have its extension's format, or is damaged. `line` counts from 1; binary files have none.
    #[error("{}{}: expected {expected}, found {found}", path.display(), line.map(|line| format!(":{line}")).unwrap_or_default())]
    Malformed { path: PathBuf, line: Option<usize>, expected: String, found: String },
    #[error("expected a positive scale (metres per unit of the file), found {found}")]
    Scale { found: f64 },
    /// The object is too large or too small to be grasped. `suggestion` names scales that would do; it may be empty.
    #[error(
        "the object is {longest_side_m} m long at scale {scale}, expected {} to {} m{suggestion}",
        crate::check::LEAST_SIZE_M,
        crate::check::GREATEST_SIZE_M
    )]
    Size { longest_side_m: f64, scale: f64, suggestion: String },
    #[error("the mesh has no surface: expected triangles with an area, found {n_triangles} triangles without")]
    NoSurface { n_triangles: usize },
    #[error("the surface encloses no volume: expected a solid, found a sheet; give it a thickness")]
    NoInside,
}
