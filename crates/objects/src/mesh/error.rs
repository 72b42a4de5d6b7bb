//! Why a mesh could not be read, written or used.

use std::path::PathBuf;

/// Why a mesh could not be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    /// The file could not be read.
    #[error("cannot read mesh {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("cannot write mesh {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file's name does not end in a known extension.
    #[error("{}: expected a mesh file that ends in .off, .obj, .stl or .ply", path.display())]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The file has no bytes.
    #[error("{}: the file is empty", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file was read and holds no triangle.
    #[error("{}: no triangles: expected a surface, found {n_vertices} vertices only", path.display())]
    NoTriangles {
        /// The file.
        path: PathBuf,
        /// How many vertices it holds.
        n_vertices: usize,
    },
    /// The file is not what its extension says, or broken, or cut off.
    #[error("{}{}: expected {expected}, found {found}", path.display(), line.map(|line| format!(":{line}")).unwrap_or_default())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, from 1; none in binary files.
        line: Option<usize>,
        /// What should be there.
        expected: String,
        /// What is there.
        found: String,
    },
    /// The mesh cannot be held by the format it should be written in.
    #[error("{}: cannot be written: {reason}", path.display())]
    NotWritable {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: &'static str,
    },
    /// The scale is no factor to multiply lengths by.
    #[error("expected a positive scale (metres per unit of the file), found {found}")]
    Scale {
        /// The scale.
        found: f64,
    },
    /// The object is too large or too small to be grasped.
    #[error(
        "the object is {longest_side_m} m long at scale {scale}, expected {} to {} m{suggestion}",
        super::check::LEAST_SIZE_M,
        super::check::GREATEST_SIZE_M
    )]
    Size {
        /// The longest side of its box.
        longest_side_m: f64,
        /// The scale that it was read with.
        scale: f64,
        /// Scales that would do, in words; may be empty.
        suggestion: String,
    },
    /// No triangle has an area.
    #[error("the mesh has no surface: expected triangles with an area, found {n_triangles} triangles without")]
    NoSurface {
        /// How many triangles there are.
        n_triangles: usize,
    },
}
