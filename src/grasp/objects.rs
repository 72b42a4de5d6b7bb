//! The built-in objects: convex shapes of the sizes of everyday things, twelve of each class.
//!
//! Sizes are spread over a range per class by a fixed low-discrepancy sequence, so the catalogue is the same everywhere.
//! Every fourth object of a class (`-03`, `-07`, `-11`) is held out: it is never used for training. Meshes are not read.

use nalgebra::Point3;
use parry3d_f64::math::Vector;
use parry3d_f64::shape::{Shape, SharedShape};

/// How many objects a class has.
pub const N_PER_CLASS: usize = 12;
/// Every so many objects of a class, one is held out.
pub const HELD_OUT_EVERY: usize = 4;

/// A convex object in its own frame, metres.
#[derive(Clone)]
pub struct Object {
    /// Class and number, e.g. `box-07`.
    pub name: String,
    /// The everyday thing, e.g. `box`.
    pub class: String,
    /// The shape, parry's (convex).
    pub shape: SharedShape,
    /// Centre of mass, for a homogeneous body.
    pub centre_of_mass_m: Point3<f64>,
    /// The largest distance of a point of the surface from the centre of mass.
    pub max_radius_m: f64,
    /// Mass.
    pub mass_kg: f64,
    /// Never used for training.
    pub held_out: bool,
}

impl std::fmt::Debug for Object {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({:?}, {} m)", self.name, self.shape.shape_type(), self.max_radius_m)
    }
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
}

/// Why a selection of objects was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectionError {
    /// Neither a split, nor a class, nor an object.
    #[error(
        "no object or class '{found}'{}: expected train, held-out, all, or a list of classes ({classes}) and objects like box-07",
        suggestion.as_ref().map(|name| format!(" (did you mean '{name}'?)")).unwrap_or_default()
    )]
    Unknown {
        /// What was asked for.
        found: String,
        /// The nearest name.
        suggestion: Option<String>,
        /// The classes.
        classes: String,
    },
}

/// All built-in objects, class by class.
pub fn catalogue() -> Vec<Object> {
    CLASSES
        .iter()
        .flat_map(|class| {
            (0..N_PER_CLASS).filter_map(|idx| {
                let held_out = idx % HELD_OUT_EVERY == HELD_OUT_EVERY - 1;
                let size_m: [f64; 3] = std::array::from_fn(|axis| {
                    let [least_mm, most_mm] = class.sizes_mm[axis];
                    // Multiples of powers of 1/φ₃ (Roberts' R3 sequence) fill the cube of sizes evenly.
                    let along = ((idx as f64 + 0.5) / 1.220_744_084_605_76_f64.powi(axis as i32 + 1)).fract();
                    (least_mm + along * (most_mm - least_mm)) / 1000.0
                });
                let shape = (class.shape)(size_m)?;
                let name = format!("{}-{idx:02}", class.name);
                Some(Object::new(name, class.name.into(), shape, class.density_kg_per_m3, held_out))
            })
        })
        .collect()
}

/// The objects that `text` names: `train`, `held-out`, `all` (also `builtin`), or classes and objects separated by commas.
///
/// # Errors
/// A name that is neither.
pub fn select(text: &str) -> Result<Vec<Object>, SelectionError> {
    let all = catalogue();
    let wanted: Vec<&str> = text.split(',').map(str::trim).collect();
    for name in &wanted {
        if !matches!(*name, "train" | "held-out" | "all" | "builtin")
            && !all.iter().any(|object| object.name == *name || object.class == *name)
        {
            let known = all.iter().flat_map(|object| [object.class.as_str(), object.name.as_str()]);
            let nearest = known
                .chain(["train", "held-out", "all", "builtin"])
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
    let is_wanted = |object: &Object| {
        wanted.iter().any(|name| match *name {
            "all" | "builtin" => true,
            "train" => !object.held_out,
            "held-out" => object.held_out,
            name => object.name == name || object.class == name,
        })
    };
    Ok(all.into_iter().filter(is_wanted).collect())
}

/// A class: how three sizes, each drawn from its range, make a shape.
struct Class {
    name: &'static str,
    /// Least and most of three sizes; what they mean is the shape's matter.
    sizes_mm: [[f64; 2]; 3],
    density_kg_per_m3: f64,
    shape: fn([f64; 3]) -> Option<SharedShape>,
}

/// Densities are of the thing as a whole, so that masses are plausible; they do not enter the ground truth.
const CLASSES: [Class; 10] = [
    Class {
        name: "box",
        sizes_mm: [[40.0, 110.0], [40.0, 90.0], [60.0, 180.0]],
        density_kg_per_m3: 400.0,
        shape: block,
    },
    Class {
        name: "book",
        sizes_mm: [[105.0, 160.0], [12.0, 40.0], [150.0, 220.0]],
        density_kg_per_m3: 700.0,
        shape: block,
    },
    Class {
        name: "bar",
        sizes_mm: [[20.0, 45.0], [20.0, 45.0], [120.0, 260.0]],
        density_kg_per_m3: 600.0,
        shape: block,
    },
    Class { name: "can", sizes_mm: [[50.0, 100.0], [60.0, 170.0], [0.0, 0.0]], density_kg_per_m3: 900.0, shape: can },
    Class { name: "stick", sizes_mm: [[18.0, 40.0], [150.0, 300.0], [0.0, 0.0]], density_kg_per_m3: 600.0, shape: can },
    Class { name: "ball", sizes_mm: [[40.0, 130.0], [0.0, 0.0], [0.0, 0.0]], density_kg_per_m3: 300.0, shape: ball },
    Class {
        name: "bottle",
        sizes_mm: [[45.0, 90.0], [130.0, 240.0], [0.0, 0.0]],
        density_kg_per_m3: 800.0,
        shape: bottle,
    },
    Class { name: "cone", sizes_mm: [[60.0, 120.0], [80.0, 180.0], [0.0, 0.0]], density_kg_per_m3: 400.0, shape: cone },
    Class { name: "cup", sizes_mm: [[60.0, 100.0], [70.0, 130.0], [0.55, 0.9]], density_kg_per_m3: 350.0, shape: cup },
    Class {
        name: "egg",
        sizes_mm: [[45.0, 90.0], [45.0, 90.0], [70.0, 150.0]],
        density_kg_per_m3: 700.0,
        shape: ellipsoid,
    },
];

fn block([x, y, z]: [f64; 3]) -> Option<SharedShape> {
    Some(SharedShape::cuboid(x / 2.0, y / 2.0, z / 2.0))
}

fn can([diameter, height, _]: [f64; 3]) -> Option<SharedShape> {
    Some(SharedShape::cylinder(height / 2.0, diameter / 2.0))
}

fn ball([diameter, ..]: [f64; 3]) -> Option<SharedShape> {
    Some(SharedShape::ball(diameter / 2.0))
}

fn bottle([diameter, height, _]: [f64; 3]) -> Option<SharedShape> {
    Some(SharedShape::capsule_y((height - diameter) / 2.0, diameter / 2.0))
}

fn cone([diameter, height, _]: [f64; 3]) -> Option<SharedShape> {
    Some(SharedShape::cone(height / 2.0, diameter / 2.0))
}

/// A truncated cone; the third size is the ratio of the diameters (its "millimetres" come as thousandths).
fn cup([diameter, height, ratio]: [f64; 3]) -> Option<SharedShape> {
    const N: usize = 48;
    let rim = |radius: f64, y: f64| {
        (0..N).map(move |idx| {
            let (sin, cos) = (std::f64::consts::TAU * idx as f64 / N as f64).sin_cos();
            Vector::new(radius * cos, y, radius * sin)
        })
    };
    let bottom_radius = diameter / 2.0 * ratio * 1000.0;
    let points: Vec<Vector> = rim(diameter / 2.0, height / 2.0).chain(rim(bottom_radius, -height / 2.0)).collect();
    SharedShape::convex_hull(&points)
}

/// The hull of 320 evenly spread points (a Fibonacci sphere, stretched).
fn ellipsoid([x, y, z]: [f64; 3]) -> Option<SharedShape> {
    const N: usize = 320;
    let golden_angle = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let points: Vec<Vector> = (0..N)
        .map(|idx| {
            let height = 1.0 - 2.0 * (idx as f64 + 0.5) / N as f64;
            let radius = (1.0 - height * height).sqrt();
            let (sin, cos) = (golden_angle * idx as f64).sin_cos();
            Vector::new(x / 2.0 * radius * cos, y / 2.0 * radius * sin, z / 2.0 * height)
        })
        .collect();
    SharedShape::convex_hull(&points)
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
mod tests {
    use super::*;

    #[test]
    fn the_catalogue_is_complete_and_a_quarter_is_held_out() {
        let all = catalogue();
        assert_eq!(all.len(), CLASSES.len() * N_PER_CLASS);
        assert_eq!(all.iter().filter(|object| object.held_out).count(), all.len() / 4);
        for object in &all {
            assert!((0.02..0.25).contains(&object.max_radius_m), "{object:?}");
            assert!((0.01..3.0).contains(&object.mass_kg), "{object:?} {} kg", object.mass_kg);
        }
    }

    #[test]
    fn centre_and_radius_by_hand() {
        // A cone's centre of mass is a quarter of its height above its base, parry's origin half of it.
        let cone = Object::new("c".into(), "c".into(), SharedShape::cone(0.05, 0.04), 1.0, false);
        assert!((cone.centre_of_mass_m - Point3::new(0.0, -0.025, 0.0)).norm() < 1e-12);
        assert!((cone.max_radius_m - 0.075).abs() < 1e-9, "to the tip: {}", cone.max_radius_m);
        let block = Object::new("b".into(), "b".into(), SharedShape::cuboid(0.03, 0.04, 0.12), 1000.0, false);
        assert!((block.max_radius_m - 0.13).abs() < 1e-12);
        assert!((block.mass_kg - 8.0 * 0.03 * 0.04 * 0.12 * 1000.0).abs() < 1e-9);
    }

    #[test]
    fn selections() {
        let all = select("all").expect("all").len();
        assert_eq!(select("train").expect("train").len() + select("held-out").expect("held out").len(), all);
        let names: Vec<_> = select("box-07, cup").expect("known").into_iter().map(|object| object.name).collect();
        assert_eq!((names.len(), names[0].as_str(), names[1].as_str()), (13, "box-07", "cup-00"));
        let error = select("bxo-07").expect_err("unknown").to_string();
        assert!(error.contains("did you mean 'box-07'?") && error.contains("bottle"), "{error}");
        assert!(select("").is_err());
    }
}

/// Identifies a set of objects: the same for the same names, sizes, centres and masses in the same order.
pub fn objects_id(objects: &[Object]) -> u64 {
    use sha2::{Digest, Sha256};
    let mut hasher = Sha256::new();
    for object in objects {
        hasher.update(object.name.as_bytes());
        let centre = object.centre_of_mass_m;
        for number in [object.max_radius_m, object.mass_kg, centre.x, centre.y, centre.z] {
            hasher.update(number.to_le_bytes());
        }
    }
    let digest = hasher.finalize();
    let mut first = [0; 8];
    first.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(first)
}

/// Temporary until folders are read.
pub fn objects_named(text: &str) -> Result<Vec<Object>, SelectionError> {
    select(text)
}
