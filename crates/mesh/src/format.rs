//! Which format a mesh file has.

use std::path::Path;

use crate::MeshError;

/// A format of mesh files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Off,
    Obj,
    Stl,
    Ply,
    Dae,
    Glb,
}

impl Format {
    /// The format that a file's extension says, in upper or lower case.
    ///
    /// # Errors
    /// An extension of no known format.
    pub(crate) fn of(path: &Path) -> Result<Format, MeshError> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        match extension.as_str() {
            "off" => Ok(Format::Off),
            "obj" => Ok(Format::Obj),
            "stl" => Ok(Format::Stl),
            "ply" => Ok(Format::Ply),
            "dae" => Ok(Format::Dae),
            "glb" => Ok(Format::Glb),
            _ => Err(MeshError::UnknownFormat { path: path.into() }),
        }
    }
}
