//! Brushes, hammers, pliers, screwdrivers and flashlights. Long along z, working end up, the lower end on z = 0.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Point3, Vector3};

use super::super::outline::{Point, closed_fillet, ellipse, fillet, half_ellipse, n_around, spline, superellipse};
use super::super::solid::{Assembly, Solid};
use super::{Draw, bar, capped};

const STEEL: f64 = 7800.0;
const WOOD: f64 = 700.0;
const PLASTIC: f64 = 1050.0;
const RUBBER: f64 = 1200.0;
/// Bristles and the air between them.
const BRISTLES: f64 = 350.0;

/// Hair brushes, dish brushes, paint brushes and tooth brushes.
pub(super) fn brush(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(4) {
        0 => hair_brush(draw, made),
        1 => dish_brush(draw, made),
        2 => paint_brush(draw, made),
        _ => tooth_brush(draw, made),
    }
}

fn hair_brush(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(200.0, 250.0);
    let half_head = draw.between(27.0, 40.0);
    let grip = draw.between(9.0, 13.0);
    let head = length * 0.46;
    let half = spline(&[
        [0.0, 0.0],
        [0.85 * grip, 6.0],
        [grip, 0.16 * length],
        [0.78 * grip, length - head - 12.0],
        [0.66 * half_head, length - 0.88 * head],
        [half_head, length - 0.50 * head],
        [0.70 * half_head, length - 0.10 * head],
        [0.0, length],
    ]);
    let thick = draw.between(12.0, 16.0);
    let back = |_: f64, half_width: f64| [thick / 2.0 * (half_width / (0.9 * grip)).min(1.0).sqrt(), 0.0];
    made.add(&bar(&half, 2.8, back), 750.0);
    // Tufts in rows across the head's front.
    let middle = length - 0.50 * head;
    let tuft = Solid::lathe(&[[0.0, 0.0], [2.2, 0.0], [1.5, 19.0], [0.0, 20.0]]).turned([1.0, 0.0, 0.0], FRAC_PI_2);
    for row in -3..=3 {
        for column in -2..=2 {
            let x = f64::from(column) * half_head * 0.36;
            let z = f64::from(row) * head * 0.115;
            if (x / half_head).hypot(z / (0.5 * head)) < 0.83 {
                made.add(&tuft.clone().moved([x, -4.0, middle + z]), BRISTLES);
            }
        }
    }
}

fn dish_brush(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(230.0, 285.0);
    let r = draw.between(23.0, 33.0);
    let grip = draw.between(7.5, 10.5);
    let half = spline(&[
        [0.0, 0.0],
        [0.9 * grip, 6.0],
        [grip, 0.22 * length],
        [0.62 * grip, length - 2.0 * r - 16.0],
        [0.7 * grip, length - 2.0 * r],
        [0.85 * grip, length - r],
        [0.0, length - r + 8.0],
    ]);
    let flat = |_: f64, half_width: f64| [5.5 * (half_width / (0.8 * grip)).min(1.0).sqrt(), 0.0];
    made.add(&bar(&half, 2.6, flat), PLASTIC);
    let disc = Solid::lathe(&fillet(&[[0.0, 0.0, 0.0], [r, 0.0, 2.0], [r - 2.0, 14.0, 5.0], [0.0, 14.0, 0.0]]));
    made.add(&disc.turned([1.0, 0.0, 0.0], -FRAC_PI_2).moved([0.0, -8.0, length - r]), PLASTIC);
    let bristles =
        Solid::lathe(&fillet(&[[0.0, 0.0, 0.0], [r + 3.0, 0.0, 3.0], [r - 3.0, 26.0, 0.0], [0.0, 26.0, 0.0]]));
    made.add(&bristles.turned([1.0, 0.0, 0.0], -FRAC_PI_2).moved([0.0, -32.0, length - r]), BRISTLES);
}

fn paint_brush(draw: &mut Draw, made: &mut Assembly) {
    let half_width = draw.between(12.0, 34.0);
    let grip = draw.between(9.0, 13.0);
    let length = draw.between(130.0, 165.0);
    let depth = draw.between(5.0, 8.0);
    let n = n_around(half_width);
    // Handle: widest below and above, hung up by a waisted end.
    let widths = spline(&[
        [0.45 * grip, 0.0],
        [0.95 * grip, 10.0],
        [grip, 0.25 * length],
        [0.62 * grip, 0.66 * length],
        [0.72 * half_width + 2.0, 0.92 * length],
        [0.92 * half_width, length],
    ]);
    let sections: Vec<_> = widths
        .iter()
        .map(|[width, z]| (*z, superellipse([*width, (0.62 * width).clamp(0.35 * grip, depth)], 2.3, n)))
        .collect();
    made.add(&Solid::stack(&sections), WOOD);
    let ferrule = [length - 6.0, length + 34.0].map(|z| (z, superellipse([half_width, depth + 1.0], 3.0, n)));
    made.add(&Solid::stack(&ferrule), 1200.0);
    let tip = length + 32.0 + draw.between(35.0, 55.0);
    let base = length + 32.0;
    let line =
        spline(&[[depth, base], [depth + 0.6, 0.5 * (base + tip)], [0.6 * depth, tip - 5.0], [0.25 * depth, tip]]);
    let tuft: Vec<_> = line.iter().map(|[y, z]| (*z, superellipse([half_width - 1.0 + 0.2 * y, *y], 3.0, n))).collect();
    made.add(&Solid::stack(&tuft), BRISTLES);
}

fn tooth_brush(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(165.0, 200.0);
    let grip = draw.between(6.0, 8.5);
    let head = draw.between(5.5, 7.0);
    let half = spline(&[
        [0.0, 0.0],
        [0.8 * grip, 4.0],
        [grip, 0.30 * length],
        [0.75 * grip, 0.55 * length],
        [0.48 * grip, length - 40.0],
        [head, length - 22.0],
        [head, length - 8.0],
        [0.0, length],
    ]);
    let thick = draw.between(8.0, 11.0);
    let bend = |z: f64| -24.0 * (z / length - 0.4).powi(2);
    // Thin towards the head, and slightly bent.
    let handle = bar(&half, 2.6, |z, half_width| {
        let upper = ((z / length - 0.35) / 0.35).clamp(0.0, 1.0);
        [thick / 2.0 * (1.0 - 0.45 * upper) * (half_width / (0.45 * grip)).min(1.0).sqrt(), bend(z)]
    });
    made.add(&handle, PLASTIC);
    for row in 0..7 {
        let z = length - 6.0 - 3.6 * f64::from(row);
        for x in [-0.32 * head, 0.32 * head] {
            let tuft = Solid::lathe(&capped(vec![[1.5, 0.0], [1.6, 12.0]])).turned([1.0, 0.0, 0.0], FRAC_PI_2);
            made.add(&tuft.moved([x, bend(z), z]), BRISTLES);
        }
    }
}

/// Claw hammers, rubber mallets and ball-peen hammers, the face towards +x.
pub(super) fn hammer(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(250.0, 345.0);
    let grip = [draw.between(13.0, 17.0), draw.between(10.0, 13.0)];
    let points: Vec<_> =
        (0..=14).map(|idx| Point3::new(0.0, 0.0, 4.0 + (length - 4.0) * f64::from(idx) / 14.0)).collect();
    let n = n_around(grip[0]);
    let handle = Solid::sweep(&points, Vector3::y(), [4.0, 0.0], |along| {
        let slim = 0.80 + 0.20 * (along * 3.2 + 0.4).cos();
        superellipse(grip.map(|size| size * slim), 2.4, n)
    });
    made.add(&handle, WOOD);
    let along_x = |solid: Solid, z: f64| solid.turned([0.0, 1.0, 0.0], FRAC_PI_2).moved([0.0, 0.0, z]);
    match draw.kind(3) {
        0 => {
            let r = draw.between(11.5, 15.0);
            let z = length - 8.0;
            let face = fillet(&[
                [0.0, -19.0, 0.0],
                [12.0, -19.0, 2.0],
                [13.0, 14.0, 5.0],
                [0.72 * r, 22.0, 5.0],
                [0.72 * r, 34.0, 4.0],
                [r, 40.0, 2.0],
                [r, 53.0, 1.5],
                [0.0, 53.0, 0.0],
            ]);
            made.add(&along_x(Solid::lathe(&face), z), STEEL);
            let reach = draw.between(56.0, 72.0);
            let claw = spline(&[[-4.0, z], [-24.0, z + 1.0], [-0.72 * reach, z - 7.0], [-reach, z - 24.0]]);
            for side in [-1.0, 1.0] {
                // The two tines spread from the socket.
                let points: Vec<_> = claw.iter().map(|[x, z]| Point3::new(*x, side * (5.5 - 0.02 * x), *z)).collect();
                let tine = Solid::sweep(&points, Vector3::y(), [0.0, 1.0], |along| {
                    superellipse([8.5 - 6.7 * along, 5.0 - 1.0 * along], 3.0, 24)
                });
                made.add(&tine, STEEL);
            }
        }
        1 => {
            let r = draw.between(24.0, 34.0);
            let half = draw.between(42.0, 56.0);
            let head = fillet(&[
                [0.0, -half, 0.0],
                [r, -half, 3.0],
                [r, -half + 9.0, 2.0],
                [r - 2.0, -half + 12.0, 2.0],
                [r - 2.0, half - 12.0, 2.0],
                [r, half - 9.0, 2.0],
                [r, half, 3.0],
                [0.0, half, 0.0],
            ]);
            made.add(&along_x(Solid::lathe(&head), length - r + 12.0), RUBBER);
        }
        _ => {
            let r = draw.between(12.0, 17.0);
            let ball = r * 0.85;
            let mut head = half_ellipse([ball, ball], -44.0);
            head.retain(|point| point[1] < -44.0 + 0.72 * ball);
            head.extend(fillet(&[
                [0.66 * r, -32.0, 0.0],
                [0.66 * r, -22.0, 4.0],
                [1.02 * r, -16.0, 4.0],
                [1.02 * r, 15.0, 4.0],
                [0.70 * r, 22.0, 4.0],
                [0.70 * r, 32.0, 4.0],
                [r, 38.0, 2.0],
                [r, 50.0, 1.5],
                [0.0, 50.0, 0.0],
            ]));
            made.add(&along_x(Solid::lathe(&head), length - 8.0), STEEL);
        }
    }
}

/// Combination pliers, needle-nose pliers and side cutters, a little open.
pub(super) fn pliers(draw: &mut Draw, made: &mut Assembly) {
    let handle = draw.between(100.0, 130.0);
    let spread = draw.between(21.0, 28.0);
    // Jaw length, half width at the joint and at the tip, half depth at the joint and at the tip.
    let [jaw, wide, tip_wide, deep, tip_deep] = match draw.kind(3) {
        0 => [draw.between(36.0, 48.0), 11.5, 6.0, 5.5, 4.0],
        1 => [draw.between(55.0, 75.0), 9.5, 2.4, 5.0, 1.8],
        _ => [draw.between(20.0, 28.0), 12.5, 3.0, 5.5, 2.4],
    };
    let thick = draw.between(4.6, 6.0);
    let opening_rad = draw.between(0.02, 0.10);
    let path = spline(&[
        [0.78 * spread, 7.0],
        [0.95 * spread, 0.25 * handle],
        [spread, 0.50 * handle],
        [0.62 * spread, 0.82 * handle],
        [5.0, handle + 2.0],
    ]);
    for side in [-1.0, 1.0] {
        let points: Vec<_> = path.iter().map(|[x, z]| Point3::new(side * x, 0.0, *z)).collect();
        let grip = Solid::sweep(&points, Vector3::y(), [7.0, 0.0], |along| {
            // A plastic sleeve as far as the joint's neck, bare steel from there.
            let sleeve = if along < 0.72 { 1.0 } else { (1.0 - (along - 0.72) * 4.0).max(0.0) };
            superellipse([thick * (0.82 + 0.18 * sleeve), thick * (0.85 + 0.35 * sleeve)], 2.5, 28)
        });
        made.add(&grip, 3200.0);
        let sections: Vec<_> = (0..=10)
            .map(|idx| {
                let along = f64::from(idx) / 10.0;
                let outer = wide + (tip_wide - wide) * along.powf(1.4);
                let half_deep = deep + (tip_deep - deep) * along;
                let ring: Vec<Point> = superellipse([(outer - 0.2) / 2.0, half_deep], 4.0, 28)
                    .iter()
                    .map(|[x, y]| [side * (x + 0.2 + (outer - 0.2) / 2.0), *y])
                    .collect();
                (jaw * along + 4.0, ring)
            })
            .collect();
        let jaw = Solid::stack(&sections).turned([0.0, 1.0, 0.0], side * opening_rad);
        made.add(&jaw.moved([0.0, 0.0, handle + 6.0]), STEEL);
    }
    let joint = closed_fillet(&[
        [9.5, handle - 8.0, 3.0],
        [14.0, handle + 6.0, 8.0],
        [wide, handle + 20.0, 5.0],
        [-wide, handle + 20.0, 5.0],
        [-14.0, handle + 6.0, 8.0],
        [-9.5, handle - 8.0, 3.0],
    ]);
    made.add(&Solid::plate(&joint, 2.0 * deep - 0.6, 1.2), STEEL);
    let rivet = Solid::lathe(&fillet(&[
        [0.0, -deep - 1.2, 0.0],
        [5.5, -deep - 1.2, 0.8],
        [5.5, deep + 1.2, 0.8],
        [0.0, deep + 1.2, 0.0],
    ]));
    made.add(&rivet.turned([1.0, 0.0, 0.0], FRAC_PI_2).moved([0.0, 0.0, handle + 6.0]), STEEL);
}

/// Slotted, cross-head and stubby screwdrivers with fluted handles.
pub(super) fn screwdriver(draw: &mut Draw, made: &mut Assembly) {
    let kind = draw.kind(3);
    let r = draw.between(11.5, 17.5);
    let handle = if kind == 2 { draw.between(52.0, 66.0) } else { draw.between(85.0, 118.0) };
    let shaft = if kind == 2 { draw.between(28.0, 45.0) } else { draw.between(75.0, 155.0) };
    let rod = draw.between(2.5, 4.0);
    let flute = draw.between(0.03, 0.07);
    let line = fillet(&[
        [0.70 * r, 0.0, 0.0],
        [0.98 * r, 4.5, 6.0],
        [r, 0.45 * handle, 30.0],
        [0.66 * r, 0.78 * handle, 10.0],
        [0.84 * r, 0.88 * handle, 5.0],
        [0.80 * r, 0.96 * handle, 3.0],
        [0.50 * r, handle, 0.0],
    ]);
    let sections: Vec<_> = line
        .iter()
        .map(|[radius, z]| {
            // Flutes fade out towards the waist.
            let depth = flute * (1.0 - ((z / handle - 0.38) / 0.38).powi(2)).max(0.0).sqrt();
            let ring: Vec<Point> = (0..48)
                .map(|idx| {
                    let angle = TAU * f64::from(idx) / 48.0;
                    let radius = radius * (1.0 - depth + depth * (6.0 * angle).cos());
                    [radius * angle.cos(), radius * angle.sin()]
                })
                .collect();
            (*z, ring)
        })
        .collect();
    made.add(&Solid::stack(&sections), RUBBER);
    let tip = handle + shaft;
    if kind == 1 {
        let rod = fillet(&[
            [0.0, handle - 10.0, 0.0],
            [rod, handle - 10.0, 0.0],
            [rod, tip - 2.2 * rod, 0.5],
            [0.3 * rod, tip, 0.3],
            [0.0, tip, 0.0],
        ]);
        made.add(&Solid::lathe(&rod), STEEL);
    } else {
        let n = n_around(rod);
        let sections = [
            (handle - 10.0, superellipse([rod, rod], 2.0, n)),
            (tip - 2.8 * rod, superellipse([rod, rod], 2.0, n)),
            (tip - 2.0 * rod, superellipse([1.25 * rod, 0.55 * rod], 3.0, n)),
            (tip, superellipse([1.1 * rod, 0.16 * rod], 4.0, n)),
        ];
        made.add(&Solid::stack(&sections), STEEL);
    }
}

/// Long torches, pocket torches and hand lanterns, the light up.
pub(super) fn flashlight(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(3) {
        0 => {
            let r = draw.between(13.0, 19.5);
            let length = draw.between(175.0, 300.0);
            let head = r * draw.between(1.4, 1.7);
            let mut corners = vec![
                [0.0, 0.0, 0.0],
                [r, 0.0, 2.5],
                [r, 20.0, 0.8],
                [r - 1.2, 21.0, 0.8],
                [r - 1.2, 23.0, 0.8],
                [r, 24.0, 0.8],
            ];
            let neck = length - 2.6 * head;
            corners.extend([
                [r, neck - 16.0, 3.0],
                [r + 1.2, neck - 12.0, 3.0],
                [r + 1.2, neck, 6.0],
                [head, length - 0.9 * head, 8.0],
                [head, length, 2.0],
                [head - 4.0, length, 0.8],
                [head - 4.5, length - 3.0, 0.0],
                [0.0, length - 3.0, 0.0],
            ]);
            made.add(&Solid::lathe(&fillet(&corners)), 1900.0);
            made.add(&switch(0.62 * length, r), RUBBER);
        }
        1 => {
            let r = draw.between(10.0, 14.0);
            let length = draw.between(88.0, 150.0);
            let head = r * draw.between(1.05, 1.45);
            let mut corners = vec![[0.0, 0.0, 0.0], [0.7 * r, 0.0, 1.0], [0.72 * r, 4.0, 1.0], [r, 6.0, 2.0]];
            let grooved = 0.5 * length / 8.0;
            for groove in 0..6 {
                let z = 0.16 * length + grooved * f64::from(groove);
                corners.extend([[r, z, 0.0], [r - 1.0, z + 0.8, 0.0], [r - 1.0, z + 2.0, 0.0], [r, z + 2.8, 0.0]]);
            }
            corners.extend([
                [r, 0.64 * length, 3.0],
                [head, 0.72 * length, 4.0],
                [head, length, 1.5],
                [head - 2.5, length, 0.6],
                [head - 3.0, length - 2.5, 0.0],
                [0.0, length - 2.5, 0.0],
            ]);
            made.add(&Solid::lathe(&fillet(&corners)), 2100.0);
        }
        _ => {
            // A lantern: its wide lamp looks towards -x from a battery case with a handle on top.
            let r = draw.between(36.0, 48.0);
            let depth = draw.between(78.0, 115.0);
            let case_high = 2.0 * r + 4.0;
            let case = Solid::block([depth, draw.between(1.3, 1.7) * r, case_high], 7.0, 4.0);
            made.add(&case.moved([depth / 2.0, 0.0, 0.0]), 750.0);
            let lamp = fillet(&[
                [0.0, -6.0, 0.0],
                [0.72 * r, -6.0, 0.0],
                [0.74 * r, 8.0, 6.0],
                [r, 20.0, 6.0],
                [r, 34.0, 2.0],
                [r - 4.0, 34.0, 1.0],
                [r - 6.0, 29.0, 0.0],
                [0.0, 29.0, 0.0],
            ]);
            made.add(&Solid::lathe(&lamp).turned([0.0, 1.0, 0.0], -FRAC_PI_2).moved([0.0, 0.0, r + 3.0]), 500.0);
            let over = case_high + draw.between(34.0, 40.0);
            let path = fillet(&[
                [0.12 * depth, case_high - 7.0, 0.0],
                [-0.05 * depth, over, 16.0],
                [0.98 * depth, over, 20.0],
                [0.85 * depth, case_high - 7.0, 0.0],
            ]);
            let points: Vec<_> = path.iter().map(|[x, z]| Point3::new(*x, 0.0, *z)).collect();
            made.add(&Solid::sweep(&points, Vector3::y(), [0.0; 2], |_| superellipse([6.5, 10.0], 2.6, 32)), 700.0);
        }
    }
}

/// A push button on the front of a round body.
fn switch(z: f64, r: f64) -> Solid {
    let button: Vec<_> = ellipse([5.0, 8.0]);
    Solid::plate(&button, 8.0, 1.5).moved([0.0, -r + 2.0, z])
}
