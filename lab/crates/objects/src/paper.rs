//! The six objects of Dang & Allen's experiments on a robot (section IV-E, Fig. 3(a)), modelled as such.
//!
//! The paper gives their masses and a photograph; sizes are assumed, of things one can buy. All are closed meshes that
//! stand on z = 0 around the z axis. The filling of a mug or a canteen moves the centre of mass, but has no surface and
//! does not slosh.
//!
//! | object | size, mm | made as | centre of mass |
//! |---|---|---|---|
//! | pencil cup | Ø 80 × 100 | open plastic cup, 3 mm walls, empty | the solid's |
//! | mug | Ø 82 × 95, handle on +x | ceramic, 4 mm walls | ceramic, and wet sand (2,000 kg/m³) up to the mass |
//! | candle box | 75 × 75 × 110 | closed carton | the middle |
//! | wipe box | 115 × 115 × 130 | closed carton | the middle |
//! | canteen | 80 × 68 × 200 | oval plastic bottle, closed, 0.25 kg empty | its skin, and water up to the mass |
//! | rock | 110 × 90 × 75 | polished lump, widest at a sixth of its height | the solid's |
//!
//! The canteen's empty mass follows from the paper: half full it has 0.50 kg, full 0.75 kg.

use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::classes::loop_handle;
use crate::outline::{Point, ellipse, fillet, superellipse};
use crate::solid::{Assembly, Solid};
use crate::{Object, ObjectError};
use blindgrasp_mesh::Mesh;
use blindgrasp_mesh::mass::solid_properties;

/// The shape of one of the paper's six objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PaperShape {
    /// A cup for pencils, empty.
    PencilCup,
    /// A mug with a handle.
    Mug,
    /// A carton with a candle.
    CandleBox,
    /// A carton of paper wipes.
    WipeBox,
    /// A drinking bottle.
    Canteen,
    /// A decorative rock.
    Rock,
}

const CERAMIC_KG_PER_M3: f64 = 2300.0;
const PLASTIC_KG_PER_M3: f64 = 1050.0;
const STONE_KG_PER_M3: f64 = 2600.0;
/// The paper does not name the mug's filling; water could not make it 0.93 kg.
const WET_SAND_KG_PER_M3: f64 = 2000.0;
const WATER_KG_PER_M3: f64 = 1000.0;
const CANTEEN_EMPTY_KG: f64 = 0.25;
const MUG_WALL_MM: f64 = 4.0;
const MUG_FLOOR_MM: f64 = 5.5;
const MUG_RADIUS_MM: f64 = 41.0;
const CANTEEN_WALL_MM: f64 = 3.0;
/// Half the width and half the depth of the canteen.
const CANTEEN_MM: [f64; 2] = [40.0, 34.0];
/// Squareness of the canteen: its two broad sides are nearly parallel.
const CANTEEN_EXPONENT: f64 = 2.6;

impl PaperShape {
    /// All six, as they stand in the paper's Fig. 3(a).
    pub const ALL: [PaperShape; 6] = [
        PaperShape::PencilCup,
        PaperShape::Mug,
        PaperShape::CandleBox,
        PaperShape::WipeBox,
        PaperShape::Canteen,
        PaperShape::Rock,
    ];

    /// The name in lists: `pencil-cup`, `mug`, `candle-box`, `wipe-box`, `canteen`, `rock`.
    pub fn name(self) -> &'static str {
        match self {
            PaperShape::PencilCup => "pencil-cup",
            PaperShape::Mug => "mug",
            PaperShape::CandleBox => "candle-box",
            PaperShape::WipeBox => "wipe-box",
            PaperShape::Canteen => "canteen",
            PaperShape::Rock => "rock",
        }
    }

    /// The object with that mass (kg), which a mug's or canteen's filling makes up; its centre of mass follows.
    ///
    /// # Errors
    /// A mesh that cannot be an object, which does not happen.
    pub fn object(self, mass_kg: f64) -> Result<Object, ObjectError> {
        let name = format!("paper/{}", self.name());
        let made = match self {
            PaperShape::PencilCup => pencil_cup(),
            PaperShape::Mug => mug(),
            PaperShape::CandleBox => carton([75.0, 75.0, 110.0]),
            PaperShape::WipeBox => carton([115.0, 115.0, 130.0]),
            PaperShape::Canteen => canteen(),
            PaperShape::Rock => rock(),
        };
        let shell_kg = made.mass_kg;
        let mesh = made.standing();
        let mut properties = solid_properties(&mesh)
            .map_err(|error| ObjectError::Mesh { name: name.clone(), reason: error.to_string() })?;
        properties.centre_of_mass_m = match self {
            PaperShape::Mug => {
                let bottom_m2 = std::f64::consts::PI * ((MUG_RADIUS_MM - MUG_WALL_MM) / 1000.0).powi(2);
                let filling = Filling { floor_m: MUG_FLOOR_MM / 1000.0, bottom_m2, kg_per_m3: WET_SAND_KG_PER_M3 };
                filling.centre(properties.centre_of_mass_m, shell_kg, mass_kg)
            }
            PaperShape::Canteen => {
                let inner = CANTEEN_MM.map(|half| half - CANTEEN_WALL_MM);
                let bottom_m2 = area_mm2(&superellipse(inner, CANTEEN_EXPONENT, 96)) / 1e6;
                let filling = Filling { floor_m: CANTEEN_WALL_MM / 1000.0, bottom_m2, kg_per_m3: WATER_KG_PER_M3 };
                filling.centre(skin_centre(&mesh), CANTEEN_EMPTY_KG, mass_kg)
            }
            _ => properties.centre_of_mass_m,
        };
        let far_m = mesh.vertices_m.iter().map(|corner| (corner - properties.centre_of_mass_m).norm());
        properties.max_radius_m = far_m.fold(0.0, f64::max);
        Object::from_mesh(name, self.name().into(), &mesh, &properties, mass_kg, true)
    }
}

/// The filling of a vessel, over a bottom of constant area.
struct Filling {
    floor_m: f64,
    bottom_m2: f64,
    kg_per_m3: f64,
}

impl Filling {
    /// The centre of mass of a vessel with its own centre and mass that is filled up to `mass_kg`.
    fn centre(&self, shell_centre: Point3<f64>, shell_kg: f64, mass_kg: f64) -> Point3<f64> {
        let filling_kg = (mass_kg - shell_kg).max(0.0);
        let level_m = filling_kg / self.kg_per_m3 / self.bottom_m2;
        let filling_centre = Vector3::new(0.0, 0.0, self.floor_m + level_m / 2.0);
        ((shell_centre.coords * shell_kg + filling_centre * filling_kg) / (shell_kg + filling_kg)).into()
    }
}

/// The centre of a surface: of a skin that is equally thick everywhere.
fn skin_centre(mesh: &Mesh) -> Point3<f64> {
    let (mut area_m2, mut moment) = (0.0, Vector3::zeros());
    for [a, b, c] in mesh.corners() {
        let triangle_m2 = (b - a).cross(&(c - a)).norm() / 2.0;
        area_m2 += triangle_m2;
        moment += (a.coords + b.coords + c.coords) / 3.0 * triangle_m2;
    }
    (moment / area_m2).into()
}

fn area_mm2(polygon: &[Point]) -> f64 {
    let next = polygon.iter().cycle().skip(1);
    polygon.iter().zip(next).map(|(a, b)| a[0] * b[1] - a[1] * b[0]).sum::<f64>() / 2.0
}

fn pencil_cup() -> Assembly {
    let outer = fillet(&[[0.0, 0.0, 0.0], [40.0, 0.0, 3.0], [40.0, 98.5, 0.0]]);
    let mut made = Assembly::default();
    made.add(&Solid::vessel(&outer, 0.0, 3.0, 3.0), PLASTIC_KG_PER_M3);
    made
}

fn mug() -> Assembly {
    let r = MUG_RADIUS_MM;
    let outer = fillet(&[[0.0, 0.0, 0.0], [r, 0.0, 7.0], [r, 93.0, 0.0]]);
    let mut made = Assembly::default();
    made.add(&Solid::vessel(&outer, 0.0, MUG_WALL_MM, MUG_FLOOR_MM), CERAMIC_KG_PER_M3);
    let inside = r - 0.6 * MUG_WALL_MM;
    made.add(&loop_handle([[inside, 78.0], [inside, 20.0]], 33.0, 2.4, [4.0, 6.5]), CERAMIC_KG_PER_M3);
    made
}

/// The density does not matter here, because the mass is given.
fn carton(size_mm: [f64; 3]) -> Assembly {
    let mut made = Assembly::default();
    made.add(&Solid::block(size_mm, 1.5, 1.0), PLASTIC_KG_PER_M3);
    made
}

fn canteen() -> Assembly {
    let [a, b] = CANTEEN_MM;
    const SHOULDER_MM: f64 = 140.0;
    const NECK_MM: f64 = 166.0;
    let line = fillet(&[
        [0.86 * a, 0.0, 0.0],
        [a, 4.0, 8.0],
        [a, SHOULDER_MM, 22.0],
        [15.0, NECK_MM, 8.0],
        [15.0, 181.0, 0.0],
    ]);
    let n = ellipse([a, b]).len();
    // Oval below, squarish; a round neck.
    let mut body: Vec<(f64, Vec<Point>)> = Vec::new();
    for [x, z] in crate::outline::subdivide(&line, 12.0) {
        let round = ((z - SHOULDER_MM + 20.0) / (NECK_MM - SHOULDER_MM + 20.0)).clamp(0.0, 1.0).powi(2);
        let depth = b / a * x * (1.0 - round) + x * round;
        body.push((z, superellipse([x, depth], CANTEEN_EXPONENT + (2.0 - CANTEEN_EXPONENT) * round, n)));
    }
    let mut made = Assembly::default();
    made.add(&Solid::stack(&body), PLASTIC_KG_PER_M3);
    let cap = fillet(&[[0.0, 178.0, 0.0], [19.0, 178.0, 0.5], [19.0, 200.0, 2.0], [0.0, 200.0, 0.0]]);
    made.add(&Solid::lathe(&cap), PLASTIC_KG_PER_M3);
    made
}

/// A lump, always the same: an ellipsoid of two halves, the lower one flatter, with broad bumps and a flat foot.
fn rock() -> Assembly {
    const SEED: u64 = 110;
    const N_BUMPS: usize = 9;
    const FOOT_MM: f64 = -12.0;
    /// By how much the upper half narrows towards its top, so that its sides face upwards.
    const TAPER: f64 = 0.2;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let bumps: Vec<(Vector3<f64>, f64)> = (0..N_BUMPS)
        .map(|_| {
            let direction = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0_f64));
            (direction.normalize(), rng.random_range(-0.07..0.07))
        })
        .collect();
    let lump = Solid::ellipsoid([55.0, 45.0, 63.0]).mapped(|point| {
        let direction = point.coords.normalize();
        let rise: f64 =
            bumps.iter().map(|(towards, height)| height * (4.0 * (direction.dot(towards) - 1.0)).exp()).sum();
        let bumped = point.coords * (1.0 + rise);
        let z = if bumped.z < 0.0 { (0.35 * bumped.z).max(FOOT_MM) } else { bumped.z };
        let narrow = 1.0 - TAPER * (z / 63.0).max(0.0);
        Point3::new(bumped.x * narrow, bumped.y * narrow, z)
    });
    let mut made = Assembly::default();
    made.add(&lump, STONE_KG_PER_M3);
    made
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_mesh::check::repair;

    /// Masses as in the paper's tables.
    const MASSES_KG: [(PaperShape, f64); 6] = [
        (PaperShape::PencilCup, 0.09),
        (PaperShape::Mug, 0.43),
        (PaperShape::CandleBox, 0.11),
        (PaperShape::WipeBox, 0.17),
        (PaperShape::Canteen, 0.50),
        (PaperShape::Rock, 0.28),
    ];

    #[test]
    fn surfaces_are_closed_whole_and_stand_on_the_ground_around_the_axis() {
        for (shape, mass_kg) in MASSES_KG {
            let object = shape.object(mass_kg).expect("an object");
            let mesh = object.to_mesh();
            let (_, survey) = repair(mesh.clone());
            assert!(survey.is_closed(), "{shape:?}: {survey:?}");
            assert_eq!(survey.warnings(), Vec::<String>::new(), "{shape:?}");
            let [least, most] = mesh.bounds();
            assert_eq!(least.z, 0.0, "{shape:?}");
            assert!(mesh.triangles.len() < 8000, "{shape:?}: {} triangles", mesh.triangles.len());
            let centre = object.centre_of_mass_m;
            assert!(centre.coords.xy().norm() < 0.006, "{shape:?}: {centre}");
            assert!((0.2 * most.z..0.6 * most.z).contains(&centre.z), "{shape:?}: {centre} of {most}");
        }
    }

    #[test]
    fn sizes_are_those_of_the_table() {
        let sizes_mm = [
            [80.0, 80.0, 100.0],
            [117.0, 82.0, 95.0],
            [75.0, 75.0, 110.0],
            [115.0, 115.0, 130.0],
            [80.0, 68.0, 200.0],
            [110.0, 90.0, 75.0],
        ];
        for ((shape, mass_kg), size_mm) in MASSES_KG.into_iter().zip(sizes_mm) {
            let [least, most] = shape.object(mass_kg).expect("an object").to_mesh().bounds();
            let found_mm = (most - least) * 1000.0;
            let near = (0..3).all(|axis| (found_mm[axis] - size_mm[axis]).abs() < 2.0);
            assert!(near, "{shape:?}: {found_mm} instead of {size_mm:?}");
        }
    }

    #[test]
    fn what_is_filled_in_lowers_the_centre_and_then_raises_it() {
        let height = |shape: PaperShape, mass_kg: f64| shape.object(mass_kg).expect("an object").centre_of_mass_m.z;
        let empty = height(PaperShape::Mug, 0.25);
        assert!(height(PaperShape::Mug, 0.43) < empty - 0.005);
        assert!(height(PaperShape::Mug, 0.93) > height(PaperShape::Mug, 0.43));
        // Full of half a litre: the water's level is still below the shoulder, its centre a third of the way up.
        let (half, full) = (height(PaperShape::Canteen, 0.50), height(PaperShape::Canteen, 0.75));
        assert!(half < full && full < 0.085, "{half} {full}");
    }

    #[test]
    fn plastic_and_ceramic_walls_weigh_what_the_paper_says() {
        assert!((pencil_cup().mass_kg - 0.09).abs() < 0.01, "{}", pencil_cup().mass_kg);
        let mug_kg = mug().mass_kg;
        assert!((0.2..0.43).contains(&mug_kg), "{mug_kg}");
    }

    #[test]
    fn most_of_the_rock_faces_upwards() {
        let mesh = PaperShape::Rock.object(0.28).expect("an object").to_mesh();
        let (mut upwards_m2, mut side_and_top_m2) = (0.0, 0.0);
        for ([a, b, c], idx) in mesh.corners().zip(0..) {
            let area_m2 = (b - a).cross(&(c - a)).norm() / 2.0;
            let up = mesh.normal(idx).z;
            side_and_top_m2 += if up > -0.99 { area_m2 } else { 0.0 };
            upwards_m2 += if up > 0.1 { area_m2 } else { 0.0 };
        }
        assert!(upwards_m2 > 0.7 * side_and_top_m2, "{upwards_m2} of {side_and_top_m2}");
    }
}
