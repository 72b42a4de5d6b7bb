//! Books, phones, remote controls, glasses cases and lamps. They stand upright on z = 0, their front towards -y.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Point3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::super::outline::{Point, closed_fillet, ellipse, fillet, half_ellipse, spline, superellipse};
use super::super::solid::{Assembly, Solid};
use super::{Draw, bar, capped};

const PAPER: f64 = 750.0;
/// A battery, a board, a case.
const DEVICE: f64 = 1900.0;
const REMOTE: f64 = 750.0;
const RUBBER: f64 = 1100.0;

/// Paperbacks (exact blocks) and bound books with boards and a round spine.
pub(super) fn book(draw: &mut Draw, made: &mut Assembly) {
    let height = draw.between(160.0, 225.0);
    let width = height * draw.between(0.62, 0.70);
    let thick = draw.between(10.0, 42.0);
    if draw.kind(2) == 0 {
        let shape = SharedShape::cuboid(width / 2000.0, thick / 2000.0, height / 2000.0);
        made.exact = Some((shape, PAPER));
        return;
    }
    let half = thick / 2.0;
    let board = 2.6;
    let bulge = 0.22 * thick;
    let pages = Solid::block([width - 8.0, thick - 2.0 * board + 0.4, height - 7.0], 0.0, 0.0);
    made.add(&pages.moved([1.0, 0.0, 3.5]), PAPER);
    // Boards and spine in one, as seen from above; the spine, at -x, is an arc.
    let arc = |depth: f64, half: f64, x: f64| -> Vec<Point> {
        (0..=16)
            .map(|idx| {
                let (sin, cos) = (std::f64::consts::PI * (f64::from(idx) / 16.0 - 0.5)).sin_cos();
                [x - depth * cos, -half * sin]
            })
            .collect()
    };
    let (back, front) = (-width / 2.0, width / 2.0);
    let mut outline = arc(bulge + board, half, back + 1.0);
    outline.push([front, -half]);
    outline.push([front, -half + board]);
    outline.extend(arc(bulge, half - board, back + 1.0).into_iter().rev());
    outline.push([front, half - board]);
    outline.push([front, half]);
    let cover = Solid::plate(&outline, height, 0.0).turned([1.0, 0.0, 0.0], FRAC_PI_2);
    made.add(&cover.moved([0.0, 0.0, height / 2.0]), 850.0);
}

/// Smartphones (their backs, with the camera, towards -y), phones with keys and cordless handsets.
pub(super) fn phone(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(3) {
        0 => {
            let (width, height, thick) =
                (draw.between(64.0, 79.0), draw.between(132.0, 165.0), draw.between(7.2, 10.5));
            made.add(&Solid::block([width, thick, height], draw.between(7.0, 13.0), draw.between(1.5, 3.0)), DEVICE);
            let camera = draw.between(19.0, 34.0);
            let bump = Solid::block([camera, 3.4, camera * 1.05], 6.0, 0.8);
            made.add(
                &bump.moved([width / 2.0 - camera / 2.0 - 5.0, -thick / 2.0, height - camera * 1.05 - 6.0]),
                DEVICE,
            );
            for (z, length) in [(0.68, 12.0), (0.78, 22.0)] {
                let key = Solid::block([2.4, 2.6, length], 1.1, 0.4);
                made.add(&key.moved([width / 2.0, 0.0, z * height - length / 2.0]), DEVICE);
            }
        }
        1 => {
            let (width, height, thick) =
                (draw.between(44.0, 53.0), draw.between(104.0, 128.0), draw.between(12.0, 18.0));
            made.add(&Solid::block([width, thick, height], draw.between(9.0, 18.0), draw.between(3.0, 4.5)), 1250.0);
            let screen = Solid::block([width - 13.0, 2.0, 0.33 * height], 2.0, 0.5);
            made.add(&screen.moved([0.0, -thick / 2.0, 0.56 * height]), DEVICE);
            keys(made, [3, 4], [width * 0.27, 0.098 * height], [width * 0.20, 0.06 * height], 0.12 * height, |_| {
                -thick / 2.0
            });
        }
        _ => {
            let (width, height, thick) =
                (draw.between(45.0, 55.0), draw.between(145.0, 182.0), draw.between(22.0, 30.0));
            let arch = draw.between(5.0, 10.0);
            let bent = |z: f64| arch * (2.0 * z / height - 1.0).powi(2);
            let half = spline(&[
                [0.0, 0.0],
                [0.40 * width, 3.0],
                [0.47 * width, 0.14 * height],
                [0.42 * width, 0.50 * height],
                [0.5 * width, 0.86 * height],
                [0.42 * width, height - 3.0],
                [0.0, height],
            ]);
            made.add(
                &bar(&half, 3.2, |z, half_width| {
                    [thick / 2.0 * (half_width / (0.4 * width)).min(1.0).sqrt(), -bent(z)]
                }),
                650.0,
            );
            let face = |z: f64| -thick / 2.0 - bent(z);
            keys(made, [3, 4], [width * 0.26, 0.085 * height], [width * 0.19, 0.052 * height], 0.20 * height, face);
            let screen = Solid::block([width * 0.62, 2.4, 0.17 * height], 3.0, 0.6);
            made.add(&screen.moved([0.0, face(0.67 * height) + 0.3, 0.58 * height]), DEVICE);
            let aerial = fillet(&[
                [0.0, height - 12.0, 0.0],
                [5.0, height - 12.0, 0.0],
                [4.4, height + 15.0, 3.0],
                [0.0, height + 15.0, 0.0],
            ]);
            made.add(&Solid::lathe(&aerial).moved([0.27 * width, -bent(height) + 3.0, 0.0]), RUBBER);
        }
    }
}

/// Plain, waisted and small remote controls.
pub(super) fn remote(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(3) {
        0 => {
            let (width, height, thick) =
                (draw.between(42.0, 56.0), draw.between(150.0, 220.0), draw.between(16.0, 23.0));
            made.add(&Solid::block([width, thick, height], draw.between(5.0, 10.0), 3.5), REMOTE);
            keys(made, [3, 5], [width * 0.28, 0.075 * height], [width * 0.19, 0.045 * height], 0.42 * height, |_| {
                -thick / 2.0
            });
            ring_key(made, 0.35 * width, -thick / 2.0, 0.24 * height);
        }
        1 => {
            let (width, height, thick) =
                (draw.between(48.0, 60.0), draw.between(175.0, 235.0), draw.between(22.0, 30.0));
            let waist = draw.between(0.36, 0.42);
            let half = spline(&[
                [0.0, 0.0],
                [0.36 * width, 3.0],
                [0.43 * width, 0.12 * height],
                [waist * width, 0.40 * height],
                [0.5 * width, 0.80 * height],
                [0.38 * width, height - 5.0],
                [0.0, height],
            ]);
            let round = |_: f64, half_width: f64| [thick / 2.0 * (half_width / (0.4 * width)).min(1.0).sqrt(), 0.0];
            made.add(&bar(&half, 3.2, round), REMOTE);
            keys(made, [3, 4], [width * 0.24, 0.065 * height], [width * 0.16, 0.04 * height], 0.16 * height, |_| {
                -thick / 2.0
            });
            ring_key(made, 0.30 * width, -thick / 2.0, 0.66 * height);
        }
        _ => {
            let (width, height, thick) =
                (draw.between(32.0, 42.0), draw.between(118.0, 150.0), draw.between(12.0, 19.0));
            made.add(&Solid::block([width, thick, height], width * 0.46, thick * 0.36), REMOTE);
            ring_key(made, 0.32 * width, -thick / 2.0, 0.74 * height);
            keys(made, [2, 3], [width * 0.42, 0.12 * height], [width * 0.26, width * 0.26], 0.20 * height, |_| {
                -thick / 2.0
            });
        }
    }
}

/// Hard clamshells, slim boxes and round tubes for glasses, lying along x.
pub(super) fn glasses_case(draw: &mut Draw, made: &mut Assembly) {
    /// Mostly air.
    const CASE: f64 = 280.0;
    let length = draw.between(150.0, 172.0);
    match draw.kind(3) {
        0 => {
            let (depth, height) = (draw.between(56.0, 70.0), draw.between(38.0, 54.0));
            // Sections across x: fuller in the middle, flattened below.
            let squareness = draw.between(2.3, 3.0);
            let half = length / 2.0;
            let rings: Vec<Vec<Point3<f64>>> = (0..=28)
                .map(|idx| {
                    let angle = std::f64::consts::PI * (f64::from(idx) / 28.0 - 0.5);
                    let full = angle.cos().max(0.0).powf(2.0 / squareness);
                    let x = half * angle.sin().signum() * angle.sin().abs().powf(2.0 / squareness);
                    if full < 1e-6 {
                        return vec![Point3::new(x, 0.0, height * 0.45)];
                    }
                    let section = superellipse([depth / 2.0 * full, height / 2.0 * full.powf(0.8)], 2.4, 44);
                    section
                        .iter()
                        .map(|[y, z]| Point3::new(x, *y, height * 0.45 + if *z > 0.0 { 1.1 * z } else { 0.9 * z }))
                        .collect()
                })
                .collect();
            made.add(&Solid::loft(&rings), CASE);
            let lip = superellipse([half + 1.4, depth / 2.0 + 1.4], squareness, 84);
            made.add(
                &Solid::plate(&lip, 4.0, 1.2).turned([1.0, 0.0, 0.0], FRAC_PI_2).moved([0.0, 0.0, height * 0.45]),
                CASE,
            );
        }
        1 => {
            let (depth, height) = (draw.between(50.0, 64.0), draw.between(24.0, 36.0));
            let case = Solid::block([length, height, depth], draw.between(10.0, 22.0), draw.between(5.0, 9.0));
            made.add(&case.turned([1.0, 0.0, 0.0], -FRAC_PI_2).moved([0.0, -depth / 2.0, height / 2.0]), CASE);
            let flap = Solid::block([length * 0.30, 3.0, depth * 0.5], 6.0, 1.2);
            made.add(&flap.turned([1.0, 0.0, 0.0], -FRAC_PI_2).moved([0.0, -depth / 2.0 + 2.0, height]), CASE);
        }
        _ => {
            // Half round: flat below.
            let (depth, height) = (draw.between(50.0, 64.0), draw.between(34.0, 44.0));
            let section = closed_fillet(&[
                [depth / 2.0, 0.0, 5.0],
                [depth / 2.0, 0.55 * height, 0.42 * height],
                [0.28 * depth, height, 0.5 * height],
                [-0.28 * depth, height, 0.5 * height],
                [-depth / 2.0, 0.55 * height, 0.42 * height],
                [-depth / 2.0, 0.0, 5.0],
            ]);
            made.add(&Solid::plate(&section, length, 4.0).turned([0.0, 0.0, 1.0], FRAC_PI_2), CASE);
            let clasp = Solid::block([22.0, 4.0, 10.0], 3.0, 1.0);
            made.add(&clasp.moved([0.0, -depth / 2.0, 0.30 * height]), 900.0);
        }
    }
}

/// Table lamps: a slim stem, a ceramic body or a dome for a shade. Shades are hollow.
pub(super) fn lamp(draw: &mut Draw, made: &mut Assembly) {
    /// Wood and metal, weighted.
    const FOOT: f64 = 1500.0;
    const SHADE: f64 = 500.0;
    let height = draw.between(250.0, 375.0);
    let foot = draw.between(39.0, 50.0);
    let kind = draw.kind(3);
    let shade_low = height * if kind == 2 { draw.between(0.66, 0.74) } else { draw.between(0.54, 0.62) };
    let stem = match kind {
        0 => {
            let stem = draw.between(5.0, 8.0);
            fillet(&[
                [0.0, 0.0, 0.0],
                [foot, 0.0, 2.0],
                [foot, 8.0, 3.0],
                [stem + 7.0, 16.0, 5.0],
                [stem + 3.0, 24.0, 4.0],
                [stem, 0.20 * height, 20.0],
                [stem, 0.5 * height, 0.0],
            ])
        }
        1 => spline(&[
            [0.78 * foot, 0.0],
            [0.80 * foot, 6.0],
            [0.62 * foot, 14.0],
            [0.95 * foot, 0.16 * height],
            [foot, 0.27 * height],
            [0.62 * foot, 0.42 * height],
            [0.22 * foot, 0.50 * height],
            [0.20 * foot, 0.54 * height],
        ]),
        _ => {
            let stem = draw.between(7.0, 11.0);
            fillet(&[
                [0.0, 0.0, 0.0],
                [foot, 0.0, 2.0],
                [foot, 5.0, 2.0],
                [0.8 * foot, 12.0, 12.0],
                [stem, 22.0, 12.0],
                [stem, shade_low + 0.06 * height, 0.0],
            ])
        }
    };
    let stem_top = stem[stem.len() - 1][1];
    made.add(&Solid::lathe(&capped(stem)), FOOT * if kind == 1 { 0.45 } else { 1.0 });
    if kind == 2 {
        // A mushroom: the dome's shell, closed at the top, on the stem.
        let r = draw.between(60.0, 78.0);
        let rise = height - shade_low;
        let dome: Vec<Point> = half_ellipse([r, rise], rise).into_iter().filter(|point| point[1] <= rise).collect();
        let shell = Solid::vessel(&dome, 0.0, 3.0, 3.0);
        made.add(&shell.mapped(|point| Point3::new(point.x, point.y, height - point.z)), SHADE * 2.0);
        let carrier = [[0.0, stem_top - 2.0], [5.0, stem_top - 2.0], [5.0, height - 1.5], [0.0, height - 1.5]];
        made.add(&Solid::lathe(&carrier), FOOT);
        return;
    }
    let low = draw.between(72.0, 98.0);
    let high = low * draw.between(0.55, 0.9);
    let wall = 2.0;
    let shade = [[low, shade_low], [high, height], [high - wall, height], [low - wall, shade_low]];
    made.add(&Solid::turned_ring(&shade), SHADE);
    // Socket, bulb, and three rods that carry the shade.
    let rod_z = height - 0.10 * (height - shade_low);
    let socket = fillet(&[
        [0.0, stem_top - 4.0, 0.0],
        [9.0, stem_top - 4.0, 0.5],
        [9.0, stem_top + 24.0, 1.0],
        [0.0, stem_top + 24.0, 0.0],
    ]);
    made.add(&Solid::lathe(&socket), FOOT);
    made.add(&Solid::ellipsoid([17.0, 17.0, 22.0]).moved([0.0, 0.0, stem_top + 40.0]), 200.0);
    let carrier = [[0.0, stem_top + 20.0], [3.0, stem_top + 20.0], [3.0, rod_z + 4.0], [0.0, rod_z + 4.0]];
    made.add(&Solid::lathe(&carrier), FOOT);
    let reach = low + (high - low) * (rod_z - shade_low) / (height - shade_low) - wall / 2.0;
    for idx in 0..3 {
        let angle = TAU * f64::from(idx) / 3.0;
        let path = [Point3::new(0.0, 0.0, rod_z), Point3::new(reach, 0.0, rod_z)];
        let rod = Solid::sweep(&path, Vector3::y(), [0.0; 2], |_| ellipse([1.2, 1.2]));
        made.add(&rod.turned([0.0, 0.0, 1.0], angle), FOOT);
    }
}

/// Keys in columns and rows on a front, from a height upwards.
fn keys(
    made: &mut Assembly,
    [n_columns, n_rows]: [i32; 2],
    pitch: [f64; 2],
    size: [f64; 2],
    low: f64,
    front_y: impl Fn(f64) -> f64,
) {
    let [x, z] = size.map(|side| side / 2.0);
    let outline = |inset: f64| superellipse([x - inset, z - inset], 3.0, 12);
    let key = Solid::stack(&[(-1.5, outline(0.0)), (0.9, outline(0.0)), (1.5, outline(0.5))]);
    let key = key.turned([1.0, 0.0, 0.0], FRAC_PI_2);
    for row in 0..n_rows {
        for column in 0..n_columns {
            let x = (f64::from(column) - f64::from(n_columns - 1) / 2.0) * pitch[0];
            let z = low + f64::from(row) * pitch[1];
            made.add(&key.clone().moved([x, front_y(z) + 0.3, z]), RUBBER);
        }
    }
}

/// A round key with a ring around it.
fn ring_key(made: &mut Assembly, r: f64, front_y: f64, z: f64) {
    let key = fillet(&[
        [0.0, -2.0, 0.0],
        [r, -2.0, 0.0],
        [r, 1.0, 0.8],
        [0.62 * r, 1.0, 0.0],
        [0.58 * r, 0.3, 0.0],
        [0.0, 0.3, 0.0],
    ]);
    made.add(&Solid::lathe(&key).turned([1.0, 0.0, 0.0], FRAC_PI_2).moved([0.0, front_y, z]), RUBBER);
}
