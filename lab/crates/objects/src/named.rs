//! Objects by their names in the catalogue, or from a folder of meshes.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::{Object, ObjectError, SelectionError, select};
use crate::folder::{FolderError, MeshEntry, listed, read_folder};
use blindgrasp_mesh::check::{check_size, repair};
use blindgrasp_mesh::mass::solid_properties;
use blindgrasp_mesh::read::read_mesh;
use blindgrasp_mesh::{Mesh, MeshError};

/// Density of a mesh without known mass or density. 500 kg/m³: assumed, a light wood.
const DENSITY_KG_PER_M3: f64 = 500.0;

/// Why there are no such objects.
#[derive(Debug, thiserror::Error)]
pub enum NamedError {
    /// The catalogue has no such object.
    #[error("{0}; nor is there a folder or a file of meshes of that name")]
    Selection(SelectionError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Mesh(#[from] MeshObjectError),
    /// Meshes that cannot be objects. Each problem names its file.
    #[error("{}: {} of {n_meshes} meshes cannot be used:{}", folder.display(), problems.len(), listed(problems))]
    Meshes { folder: PathBuf, n_meshes: usize, problems: Vec<String> },
}

/// Why a mesh file cannot be an object.
#[derive(Debug, thiserror::Error)]
pub enum MeshObjectError {
    #[error(transparent)]
    File(#[from] MeshError),
    /// The mesh has a size or a surface that cannot be used.
    #[error("{}: {source}", path.display())]
    Surface { path: PathBuf, source: MeshError },
    #[error(transparent)]
    Object(#[from] ObjectError),
}

/// The objects that `text` names: those of the catalogue, as [`select`], or else the meshes of a folder or one mesh file.
/// With warnings about the meshes.
///
/// # Errors
/// No such object or folder; or meshes that cannot be used, all named.
pub fn objects_named(text: &str) -> Result<(Vec<Object>, Vec<String>), NamedError> {
    // A folder that is called like a class needs "./" before its name.
    match select(text) {
        Ok(objects) => Ok((objects, Vec::new())),
        Err(SelectionError::Unknown { .. }) if Path::new(text).exists() => objects_in(Path::new(text)),
        Err(error) => Err(NamedError::Selection(error)),
    }
}

fn objects_in(folder: &Path) -> Result<(Vec<Object>, Vec<String>), NamedError> {
    let entries = read_folder(folder)?;
    let loaded: Vec<_> = entries.par_iter().map(object_of_mesh).collect();
    let (mut objects, mut warnings, mut problems) = (Vec::new(), Vec::new(), Vec::new());
    for (entry, loaded) in entries.iter().zip(loaded) {
        match loaded {
            Ok((object, said)) => {
                objects.push(object);
                warnings.extend(said.into_iter().map(|warning| format!("{}: {warning}", entry.path.display())));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    if problems.is_empty() {
        return Ok((objects, warnings));
    }
    Err(NamedError::Meshes { folder: folder.into(), n_meshes: entries.len(), problems })
}

/// Reads a mesh file as an object: repaired, of a size that can be grasped, with its mass. With warnings about its faults.
///
/// # Errors
/// A file that cannot be read, a size that no hand can grasp, or a mesh without surface or inside; with the file.
pub fn object_of_mesh(entry: &MeshEntry) -> Result<(Object, Vec<String>), MeshObjectError> {
    let in_file = |source: MeshError| MeshObjectError::Surface { path: entry.path.clone(), source };
    let mesh = read_mesh(&entry.path, entry.scale)?;
    check_size(&mesh, entry.scale).map_err(in_file)?;
    let (mesh, survey) = repair(mesh);
    let properties = solid_properties(&mesh).map_err(in_file)?;
    let density_kg_per_m3 = entry.density_kg_per_m3.unwrap_or(DENSITY_KG_PER_M3);
    let mass_kg = entry.mass_kg.unwrap_or(density_kg_per_m3 * properties.volume_m3);
    let object =
        Object::from_mesh(entry.name.clone(), entry.class.clone(), &mesh, &properties, mass_kg, entry.held_out)?;
    let warnings = survey.warnings().into_iter().chain(properties.warnings()).collect();
    Ok((object, warnings))
}

/// The mesh of one object: of the folder's, if one is given, else of the built-in one of that name.
///
/// # Errors
/// A folder or a mesh that cannot be read.
pub fn find_mesh(name: &str, folder: Option<&Path>) -> Result<Option<Mesh>, NamedError> {
    if let Some(folder) = folder {
        let entry = read_folder(folder)?.into_iter().find(|entry| entry.name == name);
        return entry.map(|entry| Ok(object_of_mesh(&entry)?.0.to_mesh())).transpose();
    }
    // A selection may be a class or a split; an object has exactly this name.
    let found = select(name).ok().and_then(|found| found.into_iter().find(|object| object.name == name));
    Ok(found.map(|object| object.to_mesh()))
}

/// Identifies a set of objects: the same for the same names, classes, shapes and masses in the same order.
pub fn objects_id(objects: &[Object]) -> u64 {
    let mut hasher = Sha256::new();
    for object in objects {
        let Object { name, class, shape: _, centre_of_mass_m, max_radius_m, mass_kg, held_out } = object;
        for text in [name, class] {
            hasher.update((text.len() as u64).to_le_bytes());
            hasher.update(text);
        }
        hasher.update([u8::from(*held_out)]);
        let mesh = object.to_mesh();
        let corners = mesh.vertices_m.iter().flat_map(|corner| corner.iter());
        for number in [max_radius_m, mass_kg].into_iter().chain(centre_of_mass_m.iter()).chain(corners) {
            hasher.update(number.to_le_bytes());
        }
        for idx in mesh.triangles.iter().flatten() {
            hasher.update(idx.to_le_bytes());
        }
    }
    let digest = hasher.finalize();
    let mut first = [0; 8];
    first.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(first)
}
