//! The classes: how each makes an object from a number.
//!
//! Sizes are of things one can buy, in millimetres as on a drawing. Densities are of a part as it is built here, so
//! that masses are plausible. A filled bottle weighs what its content does, a plastic case with its inside about half
//! of the plastic; walls that are real walls have the density of their material.

mod containers;
mod home;
mod loose;
mod tableware;
mod tools;

use nalgebra::Point3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::N_PER_CLASS;
use crate::outline::{Point, n_around, spline, subdivide, superellipse};
use crate::solid::{Assembly, Solid};

pub(super) use tableware::loop_handle;

/// A class.
pub(super) struct Class {
    pub(super) name: &'static str,
    pub(super) make: fn(&mut Draw, &mut Assembly),
}

/// All classes, in the catalogue's order.
pub(super) const CLASSES: [Class; 24] = [
    Class { name: "bottle", make: containers::bottle },
    Class { name: "can", make: containers::can },
    Class { name: "jar", make: containers::jar },
    Class { name: "box", make: containers::carton },
    Class { name: "vase", make: containers::vase },
    Class { name: "mug", make: tableware::mug },
    Class { name: "cup", make: tableware::cup },
    Class { name: "bowl", make: tableware::bowl },
    Class { name: "teapot", make: tableware::teapot },
    Class { name: "spoon", make: tableware::spoon },
    Class { name: "knife", make: tableware::knife },
    Class { name: "fruit", make: loose::fruit },
    Class { name: "ball", make: loose::ball },
    Class { name: "toy", make: loose::toy },
    Class { name: "book", make: home::book },
    Class { name: "phone", make: home::phone },
    Class { name: "remote", make: home::remote },
    Class { name: "glasses_case", make: home::glasses_case },
    Class { name: "lamp", make: home::lamp },
    Class { name: "brush", make: tools::brush },
    Class { name: "hammer", make: tools::hammer },
    Class { name: "pliers", make: tools::pliers },
    Class { name: "screwdriver", make: tools::screwdriver },
    Class { name: "flashlight", make: tools::flashlight },
];

/// The sizes of one object. Each size in turn is spread over its range in as many layers as a class has objects, one
/// object in each (a Latin hypercube). They are shuffled by a generator seeded by class and turn: the same everywhere.
pub(super) struct Draw {
    seed: u64,
    idx: usize,
    n_drawn: u64,
}

impl Draw {
    pub(super) fn new(class_name: &str, idx: usize) -> Self {
        let seed = class_name.bytes().fold(0_u64, |seed, byte| seed.wrapping_mul(257).wrapping_add(byte.into()));
        Draw { seed, idx, n_drawn: 0 }
    }

    /// Which of `n` kinds. Three objects in a row are of one kind, so that every kind has its share held out.
    fn kind(&self, n: usize) -> usize {
        self.idx / crate::HELD_OUT_EVERY % n
    }

    /// A number from a range.
    fn between(&mut self, least: f64, most: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed.wrapping_mul(1000).wrapping_add(self.n_drawn));
        self.n_drawn += 1;
        let mut layers: [usize; N_PER_CLASS] = std::array::from_fn(|layer| layer);
        for place in (1..N_PER_CLASS).rev() {
            layers.swap(place, rng.random_range(0..=place));
        }
        least + (layers[self.idx] as f64 + 0.5) / N_PER_CLASS as f64 * (most - least)
    }
}

/// Radius at a height of a profile that rises.
fn radius_at(profile: &[Point], z_mm: f64) -> f64 {
    profile.windows(2).find(|pair| pair[0][1] <= z_mm && z_mm <= pair[1][1] && pair[1][1] > pair[0][1]).map_or(
        0.0,
        |pair| {
            let along = (z_mm - pair[0][1]) / (pair[1][1] - pair[0][1]);
            pair[0][0] + along * (pair[1][0] - pair[0][0])
        },
    )
}

/// A smooth line that begins on the axis, on the ground.
fn spline_from_axis(knots: &[Point]) -> Vec<Point> {
    [vec![[0.0, 0.0]], spline(knots)].concat()
}

/// The last line, closed onto the axis at both ends with flat faces: a profile for a lathe.
fn capped(line: Vec<Point>) -> Vec<Point> {
    let (first, last) = (line[0], line[line.len() - 1]);
    let mut profile = Vec::with_capacity(line.len() + 2);
    if first[0] > 0.0 {
        profile.push([0.0, first[1]]);
    }
    profile.extend(line);
    if last[0] > 0.0 {
        profile.push([0.0, last[1]]);
    }
    profile
}

/// A bar along z of superelliptic section. `line` gives half the width (x) by height; `section` half the depth (y) and
/// where the middle is (y), from height and half the width.
fn bar(line: &[Point], exponent: f64, section: impl Fn(f64, f64) -> [f64; 2]) -> Solid {
    /// Longest step along z, for changes that only `section` makes.
    const STEP_MM: f64 = 12.0;
    let dense = subdivide(line, STEP_MM);
    let n = n_around(0.6 * line.iter().map(|point| point[0]).fold(0.0, f64::max)).max(24);
    let rings: Vec<Vec<Point3<f64>>> = dense
        .iter()
        .map(|&[half_width, z]| {
            let [half_depth, y] = section(z, half_width);
            if half_width < 1e-9 {
                return vec![Point3::new(0.0, y, z)];
            }
            superellipse([half_width, half_depth], exponent, n)
                .iter()
                .map(|[x, dy]| Point3::new(*x, y + dy, z))
                .collect()
        })
        .collect();
    Solid::loft(&rings)
}
