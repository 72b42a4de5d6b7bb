//! Objects to grasp: a built-in catalogue of everyday things, and objects from meshes.
//!
//! ```
//! use blindgrasp_objects::select;
//!
//! let mugs = select("mug")?;
//! assert_eq!(mugs.iter().filter(|mug| mug.held_out).count(), 10);
//! let mesh = mugs[0].to_mesh();
//! assert!(!mesh.triangles.is_empty());
//! # Ok::<(), blindgrasp_objects::SelectionError>(())
//! ```
//!
//! The catalogue has 24 classes of thirty objects, built from a few sizes each: vessels are hollow, mugs have handles
//! that fingers go through. It is the same everywhere. Objects are metres, upright along +z or (tools, cutlery) long
//! along z with the working end up. They stand on z = 0, but exact boxes, books and balls, which have their centre at the
//! origin. Fronts face -y, handles +x. A curved surface is cut into triangles that are off by 0.15 mm (0.2 mm in a few
//! places; coarser deep inside vessels). Every third object of a class (`-02`, `-05`, ... `-29`) is held out: it is never
//! used for training.

mod classes;
pub mod folder;
mod named;
mod outline;
mod paper;
mod solid;

use nalgebra::Point3;
use parry3d_f64::math::Vector;
use parry3d_f64::shape::{Shape, SharedShape};
use rayon::prelude::*;

use blindgrasp_mesh::mass::{SolidProperties, solid_properties};
use blindgrasp_mesh::shape::mesh_of_shape;
use blindgrasp_mesh::{Mesh, MeshError};
use classes::{CLASSES, Class, Draw};
use solid::Assembly;

pub use named::{MeshObjectError, NamedError, find_mesh, object_of_mesh, objects_id, objects_named};
pub use paper::PaperShape;

pub const N_PER_CLASS: usize = 30;
/// One object is held out of so many of a class.
pub const HELD_OUT_EVERY: usize = 3;

/// An object in its own frame, metres.
#[derive(Clone)]
pub struct Object {
    /// Class and number, e.g. `box-07`.
    pub name: String,
    /// Class, e.g. `box`.
    pub class: String,
    /// The shape, parry's: convex, or a triangle mesh, which is a surface without an inside.
    pub shape: SharedShape,
    /// Centre of mass, for a homogeneous body.
    pub centre_of_mass_m: Point3<f64>,
    /// The largest distance of a point of the surface from the centre of mass.
    pub max_radius_m: f64,
    pub mass_kg: f64,
    /// Whether the object is never used for training.
    pub held_out: bool,
}

impl std::fmt::Debug for Object {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({:?}, {} m)", self.name, self.shape.shape_type(), self.max_radius_m)
    }
}

/// Why a mesh is not an object.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ObjectError {
    /// The mesh has no triangles, or names corners that do not exist.
    #[error("object {name}: the mesh was refused ({reason}); expected triangles over existing corners")]
    Mesh { name: String, reason: String },
}

impl Object {
    /// An object of a convex shape; centre of mass and radius follow from the shape.
    pub fn new(name: String, class: String, shape: SharedShape, density_kg_per_m3: f64, held_out: bool) -> Self {
        let mass = shape.mass_properties(density_kg_per_m3);
        let centre = mass.local_com;
        Object {
            name,
            class,
            max_radius_m: farthest_m(&*shape, centre),
            shape,
            centre_of_mass_m: Point3::new(centre.x, centre.y, centre.z),
            mass_kg: mass.mass(),
            held_out,
        }
    }

    /// An object of a mesh and the properties of its solid.
    ///
    /// # Errors
    /// A mesh without triangles, or one whose triangles name corners that it does not have.
    pub fn from_mesh(
        name: String,
        class: String,
        mesh: &Mesh,
        properties: &SolidProperties,
        mass_kg: f64,
        held_out: bool,
    ) -> Result<Self, ObjectError> {
        let shape = shape_of_mesh(&name, mesh)?;
        let SolidProperties { centre_of_mass_m, max_radius_m, .. } = *properties;
        Ok(Object { name, class, shape, centre_of_mass_m, max_radius_m, mass_kg, held_out })
    }

    /// The surface as triangles.
    pub fn to_mesh(&self) -> Mesh {
        mesh_of_shape(&self.shape)
    }
}

/// An object of the catalogue, not built yet.
#[derive(Clone, Copy)]
pub struct ObjectSpec {
    class: &'static Class,
    idx: usize,
}

impl ObjectSpec {
    /// Class and number, e.g. `box-07`.
    pub fn name(&self) -> String {
        format!("{}-{:02}", self.class.name, self.idx)
    }

    /// Class, e.g. `box`.
    pub fn class(&self) -> &'static str {
        self.class.name
    }

    /// Whether the object is never used for training.
    pub fn held_out(&self) -> bool {
        self.idx % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    }

    /// Builds the object.
    ///
    /// # Errors
    /// A mesh that cannot be an object, of which the catalogue has none.
    pub fn build(&self) -> Result<Object, ObjectError> {
        let (name, class) = (self.name(), self.class.name.to_owned());
        let mut made = Assembly::default();
        (self.class.make)(&mut Draw::new(self.class.name, self.idx), &mut made);
        if let Some((shape, density_kg_per_m3)) = made.exact {
            return Ok(Object::new(name, class, shape, density_kg_per_m3, self.held_out()));
        }
        let mass_kg = made.mass_kg;
        let mesh = made.standing();
        let refused = |error: MeshError| ObjectError::Mesh { name: self.name(), reason: error.to_string() };
        let properties = solid_properties(&mesh).map_err(refused)?;
        Object::from_mesh(name, class, &mesh, &properties, mass_kg, self.held_out())
    }
}

/// Why a selection of objects was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SelectionError {
    /// The name is neither a split, nor a class, nor an object.
    #[error(
        "no object or class '{found}'{}: expected train, held-out, all, or a list of classes ({classes}) and objects like box-07",
        suggestion.as_ref().map(|name| format!(" (did you mean '{name}'?)")).unwrap_or_default()
    )]
    Unknown { found: String, suggestion: Option<String>, classes: String },
    #[error(transparent)]
    Object(#[from] ObjectError),
}

/// The catalogue without building it, class by class.
pub fn catalogue_specs() -> impl Iterator<Item = ObjectSpec> {
    CLASSES.iter().flat_map(|class| (0..N_PER_CLASS).map(move |idx| ObjectSpec { class, idx }))
}

/// The objects that `text` names: `train`, `held-out`, `all` (also `builtin`), or classes and objects separated by
/// commas. Builds no others.
///
/// # Errors
/// A name that is neither.
pub fn select(text: &str) -> Result<Vec<Object>, SelectionError> {
    Ok(select_specs(text)?.par_iter().map(ObjectSpec::build).collect::<Result<_, _>>()?)
}

/// In the catalogue's order.
fn select_specs(text: &str) -> Result<Vec<ObjectSpec>, SelectionError> {
    const SPLITS: [&str; 4] = ["train", "held-out", "all", "builtin"];
    let all: Vec<(String, ObjectSpec)> = catalogue_specs().map(|spec| (spec.name(), spec)).collect();
    let wanted: Vec<&str> = text.split(',').map(str::trim).collect();
    for name in &wanted {
        if !SPLITS.contains(name) && !all.iter().any(|(full_name, spec)| full_name == name || spec.class() == *name) {
            let known = all.iter().flat_map(|(full_name, spec)| [spec.class(), full_name.as_str()]);
            let nearest = known
                .chain(SPLITS)
                .map(|known| (strsim::damerau_levenshtein(name, known), known))
                .min_by_key(|(distance, _)| *distance)
                .filter(|(distance, _)| *distance <= 2);
            return Err(SelectionError::Unknown {
                found: (*name).into(),
                suggestion: nearest.map(|(_, known)| known.into()),
                classes: CLASSES.iter().map(|class| class.name).collect::<Vec<_>>().join(", "),
            });
        }
    }
    let is_wanted = |full_name: &str, spec: &ObjectSpec| {
        wanted.iter().any(|name| match *name {
            "all" | "builtin" => true,
            "train" => !spec.held_out(),
            "held-out" => spec.held_out(),
            name => full_name == name || spec.class() == name,
        })
    };
    Ok(all.iter().filter(|(full_name, spec)| is_wanted(full_name, spec)).map(|(_, spec)| *spec).collect())
}

/// A mesh as parry has it, for the object of that name.
fn shape_of_mesh(name: &str, mesh: &Mesh) -> Result<SharedShape, ObjectError> {
    let refused = |reason: String| ObjectError::Mesh { name: name.into(), reason };
    let n_corners = mesh.vertices_m.len();
    if let Some(corner) = mesh.triangles.iter().flatten().find(|corner| **corner as usize >= n_corners) {
        return Err(refused(format!("corner {corner} of {n_corners}")));
    }
    let corners = mesh.vertices_m.iter().map(|corner| Vector::new(corner.x, corner.y, corner.z)).collect();
    SharedShape::trimesh(corners, mesh.triangles.clone()).map_err(|error| refused(error.to_string()))
}

/// The largest distance of a point of a convex shape from `centre`: from each of 26 directions, the support point in
/// the direction of the last support point, until it stays.
fn farthest_m(shape: &dyn Shape, centre: Vector) -> f64 {
    let Some(support) = shape.as_support_map() else {
        return shape.compute_local_bounding_sphere().radius;
    };
    let mut farthest_m: f64 = 0.0;
    for idx in 0..27 {
        let axis = |place: i32| f64::from(idx / place % 3 - 1);
        let mut direction = Vector::new(axis(1), axis(3), axis(9));
        for _ in 0..50 {
            let Some(unit) = direction.try_normalize() else { break };
            direction = support.local_support_point(unit) - centre;
            if direction.length() <= farthest_m {
                break;
            }
            farthest_m = direction.length();
        }
    }
    farthest_m
}

#[cfg(test)]
mod tests;
