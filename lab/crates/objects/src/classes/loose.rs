//! Balls, fruit and toys. They rest on z = 0, but for round balls, which have their centre at the origin.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Point3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::super::outline::{Point, closed_fillet, ellipse, fillet, half_ellipse, simplify, spline};
use super::super::solid::{Assembly, Solid};
use super::Draw;

const FLESH: f64 = 920.0;
const WOOD: f64 = 650.0;
/// Moulded, hollow.
const HOLLOW: f64 = 300.0;

/// Round balls from table tennis to handball (exact), and rugby balls for children.
pub(super) fn ball(draw: &mut Draw, made: &mut Assembly) {
    let diameter = draw.between(38.0, 130.0);
    if draw.kind(5) < 4 {
        // Light when large, as balls are.
        made.exact = Some((SharedShape::ball(diameter / 2000.0), 700.0 - 4.0 * diameter));
        return;
    }
    let half = draw.between(70.0, 105.0);
    let r = half * draw.between(0.56, 0.66);
    let meridian: Vec<Point> = (0..=256)
        .map(|idx| {
            // Between an ellipse and two arcs: pointed a little.
            let (sin, cos) = (FRAC_PI_2 * (f64::from(idx) / 128.0 - 1.0)).sin_cos();
            [if idx % 256 == 0 { 0.0 } else { r * cos.max(0.0).powf(1.12) }, half * (1.0 + sin)]
        })
        .collect();
    made.add(&Solid::lathe(&simplify(&meridian)), 180.0);
}

/// Apples and pears with their dimples and stalks, bananas, lemons and oranges.
pub(super) fn fruit(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(31.0, 43.0);
    // No fruit is quite round.
    let scale = [draw.between(0.96, 1.0), draw.between(0.96, 1.0)];
    match draw.kind(5) {
        0 => apple(draw, made, r, scale),
        1 => banana(draw, made),
        2 => pear(draw, made, r, scale),
        3 => lemon(draw, made, r, scale),
        _ => orange(draw, made, r, scale),
    }
}

/// A slightly bent stalk from one height to another.
fn stalk(from: f64, to: f64) -> Solid {
    let path = spline(&[[0.0, from], [0.4, 0.5 * (from + to)], [2.6, to]]);
    let points: Vec<_> = path.iter().map(|[x, z]| Point3::new(*x, 0.0, *z)).collect();
    Solid::sweep(&points, Vector3::y(), [0.0, 0.8], |along| ellipse([1.3 + 0.5 * along; 2]))
}

fn apple(draw: &mut Draw, made: &mut Assembly, r: f64, scale: [f64; 2]) {
    let h = r * draw.between(1.65, 1.95);
    let profile = spline(&[
        [0.0, 0.09 * h],
        [0.16 * r, 0.04 * h],
        [0.40 * r, 0.0],
        [0.76 * r, 0.17 * h],
        [0.98 * r, 0.48 * h],
        [0.96 * r, 0.70 * h],
        [0.70 * r, 0.95 * h],
        [0.38 * r, h],
        [0.14 * r, 0.92 * h],
        [0.0, 0.85 * h],
    ]);
    made.add(&Solid::lathe_scaled(&profile, scale), 850.0);
    made.add(&stalk(0.80 * h, 1.10 * h), WOOD);
}

/// A banana: standing on its end, hollow side towards +x.
fn banana(draw: &mut Draw, made: &mut Assembly) {
    let bend = draw.between(78.0, 115.0);
    let half_rad = draw.between(82.0, 105.0) / bend;
    let thick = draw.between(15.5, 20.0);
    let path: Vec<_> = (0..=40)
        .map(|idx| {
            let angle = half_rad * (f64::from(idx) / 20.0 - 1.0);
            Point3::new(-bend * angle.cos(), 0.0, bend * angle.sin())
        })
        .collect();
    let solid = Solid::sweep(&path, Vector3::y(), [3.0, 1.5], |along| {
        // Blunt below, drawn out into a stalk above.
        let body = 1.0 - (2.0 * (along - 0.42).abs()).powi(4).min(0.93);
        let stalk = ((along - 0.76) / 0.18).clamp(0.0, 1.0);
        let stalk = stalk * stalk * (3.0 - 2.0 * stalk);
        let r = (thick * body.powf(0.6)).max(5.5) * (1.0 - stalk) + 4.8 * stalk;
        // Five rounded edges.
        (0..40)
            .map(|idx| {
                let angle = std::f64::consts::TAU * f64::from(idx) / 40.0;
                let edge = r * (1.0 + 0.035 * (5.0 * angle).cos());
                [edge * angle.cos(), edge * angle.sin()]
            })
            .collect()
    });
    let low = bend * half_rad.sin() + 3.0;
    made.add(&solid.moved([bend, 0.0, low]), FLESH);
}

fn pear(draw: &mut Draw, made: &mut Assembly, r: f64, scale: [f64; 2]) {
    let h = r * draw.between(2.3, 2.8);
    let neck = draw.between(0.40, 0.55) * r;
    let profile = spline(&[
        [0.0, 0.05 * h],
        [0.18 * r, 0.02 * h],
        [0.42 * r, 0.0],
        [0.85 * r, 0.13 * h],
        [r, 0.33 * h],
        [0.80 * r, 0.56 * h],
        [neck, 0.78 * h],
        [0.72 * neck, 0.94 * h],
        [0.3 * neck, h],
        [0.0, 0.985 * h],
    ]);
    made.add(&Solid::lathe_scaled(&profile, scale), FLESH);
    made.add(&stalk(0.96 * h, 1.15 * h), WOOD);
}

fn lemon(draw: &mut Draw, made: &mut Assembly, r: f64, scale: [f64; 2]) {
    let r = 0.76 * r;
    let h = r * draw.between(2.7, 3.2);
    let profile = spline(&[
        [0.0, 0.0],
        [0.20 * r, 0.01 * h],
        [0.30 * r, 0.06 * h],
        [0.74 * r, 0.20 * h],
        [r, 0.48 * h],
        [0.78 * r, 0.78 * h],
        [0.36 * r, 0.925 * h],
        [0.24 * r, 0.975 * h],
        [0.0, h],
    ]);
    made.add(&Solid::lathe_scaled(&profile, scale), FLESH);
}

fn orange(draw: &mut Draw, made: &mut Assembly, r: f64, scale: [f64; 2]) {
    let h = 2.0 * r * draw.between(0.90, 1.0);
    let mut profile = half_ellipse([r, h / 2.0], h / 2.0);
    // A navel above.
    profile.retain(|point| point[1] < 0.985 * h);
    profile.extend(spline(&[[0.17 * r, 0.988 * h], [0.10 * r, 0.975 * h], [0.0, 0.965 * h]]));
    made.add(&Solid::lathe_scaled(&profile, scale), FLESH);
    made.add(&Solid::lathe(&half_ellipse([3.0, 1.8], 0.968 * h)), WOOD);
}

/// Bath ducks, cars, robots, ring towers and rockets, their faces towards -y.
pub(super) fn toy(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(5) {
        0 => duck(draw, made),
        1 => car(draw, made),
        2 => robot(draw, made),
        3 => ring_tower(draw, made),
        _ => rocket(draw, made),
    }
}

fn duck(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(72.0, 105.0);
    let (wide, high) = (0.36 * length, 0.25 * length);
    // The body looks towards -x; the tail rises.
    let body = egg([0.5 * length, wide, high], [0.0, 0.0, high]).mapped(|point| {
        let back = (point.x / (0.5 * length)).max(0.0);
        let flat = if point.z < 0.35 * high { 0.35 * high - (0.35 * high - point.z) * 0.62 } else { point.z };
        Point3::new(point.x, point.y * (1.0 - 0.35 * back * back), flat + 0.26 * length * back.powi(3))
    });
    let low = 0.35 * high * 0.38;
    made.add(&body.moved([0.0, 0.0, -low]), HOLLOW);
    let head = draw.between(0.21, 0.25) * length;
    let (head_x, head_z) = (-0.27 * length, 1.9 * high + 0.55 * head);
    made.add(&egg([head, head * 0.96, head], [head_x, 0.0, head_z]), HOLLOW);
    let beak = egg([0.14 * length, 0.10 * length, 0.035 * length], [0.0; 3]);
    made.add(
        &beak.clone().turned([0.0, 1.0, 0.0], 0.18).moved([head_x - head - 0.02 * length, 0.0, head_z - 0.02 * length]),
        HOLLOW,
    );
    for side in [-1.0, 1.0] {
        let wing = egg([0.23 * length, 0.055 * length, 0.13 * length], [0.0; 3]);
        let wing = wing.turned([0.0, 1.0, 0.0], -0.35).turned([1.0, 0.0, 0.0], side * 0.18);
        made.add(&wing.moved([0.10 * length, side * 0.93 * wide, 1.15 * high - low]), HOLLOW);
        let eye = egg([0.035 * length; 3], [head_x - 0.72 * head, side * 0.52 * head, head_z + 0.36 * head]);
        made.add(&eye, HOLLOW);
    }
}

fn car(draw: &mut Draw, made: &mut Assembly) {
    let length = draw.between(95.0, 170.0);
    let width = length * draw.between(0.40, 0.46);
    let wheel = length * draw.between(0.095, 0.115);
    let sill = 0.7 * wheel;
    let (bonnet, roof) = (sill + 0.16 * length, sill + draw.between(0.28, 0.34) * length);
    let half = length / 2.0;
    let body = closed_fillet(&[
        [half, sill, 3.0],
        [half, bonnet - 0.01 * length, 0.05 * length],
        [0.30 * length, bonnet + 0.02 * length, 0.04 * length],
        [-half + 0.02 * length, bonnet - 0.03 * length, 0.06 * length],
        [-half, sill, 3.0],
    ]);
    made.add(&Solid::plate(&body, width, 2.8), HOLLOW * 1.5);
    let cabin = closed_fillet(&[
        [0.40 * length, bonnet - 5.0, 3.0],
        [0.30 * length, roof, 0.06 * length],
        [-0.08 * length, roof, 0.06 * length],
        [-0.24 * length, bonnet - 5.0, 3.0],
    ]);
    made.add(&Solid::plate(&cabin, 0.84 * width, 2.8), HOLLOW);
    let tyre = Solid::lathe(&fillet(&[
        [0.0, 0.5, 0.0],
        [0.5 * wheel, 0.5, 0.0],
        [0.55 * wheel, -1.5, 0.8],
        [wheel, -1.5, 1.5],
        [wheel, 0.15 * width, 1.5],
        [0.0, 0.15 * width, 0.0],
    ]));
    for x in [-0.29 * length, 0.30 * length] {
        for side in [-1.0, 1.0] {
            let placed = tyre.clone().turned([1.0, 0.0, 0.0], -side * FRAC_PI_2);
            made.add(&placed.moved([x, side * 0.5 * width, wheel]), 900.0);
        }
    }
    for side in [-1.0, 1.0] {
        let lamp = egg([3.0, 0.09 * width, 0.09 * width], [-half + 0.5, side * 0.32 * width, sill + 0.085 * length]);
        made.add(&lamp, HOLLOW);
    }
}

/// A toy robot: blocks, round arms and legs.
fn robot(draw: &mut Draw, made: &mut Assembly) {
    let height = draw.between(95.0, 165.0);
    let (wide, deep) = (height * draw.between(0.34, 0.42), height * draw.between(0.20, 0.26));
    let legs = 0.28 * height;
    let torso = 0.36 * height;
    let edge = 0.022 * height;
    for side in [-1.0, 1.0] {
        let foot = Solid::block([0.44 * wide, 1.25 * deep, 0.09 * height], edge * 1.2, edge);
        made.add(&foot.moved([side * 0.26 * wide, -0.12 * deep, 0.0]), HOLLOW * 2.0);
        let leg =
            fillet(&[[0.0, 2.0, 0.0], [0.16 * wide, 2.0, 0.0], [0.16 * wide, legs + 3.0, 0.0], [0.0, legs + 3.0, 0.0]]);
        made.add(&Solid::lathe(&leg).moved([side * 0.26 * wide, 0.0, 0.0]), HOLLOW * 2.0);
        // From the shoulder outwards, down and forwards.
        let reach = 0.5 * wide;
        let path = fillet(&[
            [0.9 * reach, legs + 0.84 * torso, 0.0],
            [1.42 * reach, legs + 0.84 * torso, 0.07 * height],
            [1.42 * reach, legs + 0.18 * torso, 0.0],
        ]);
        let points: Vec<_> = path.iter().map(|[x, z]| Point3::new(side * x, 0.0, *z)).collect();
        let arm = 0.048 * height;
        made.add(&Solid::sweep(&points, Vector3::y(), [0.0; 2], |_| ellipse([arm; 2])), HOLLOW * 2.0);
        let hand = egg([1.5 * arm; 3], [side * 1.42 * reach, 0.0, legs + 0.14 * torso]);
        made.add(&hand, HOLLOW * 2.0);
    }
    made.add(&Solid::block([wide, deep, torso], edge * 1.6, edge * 1.3).moved([0.0, 0.0, legs]), HOLLOW);
    let neck =
        fillet(&[[0.0, 0.0, 0.0], [0.11 * wide, 0.0, 0.0], [0.11 * wide, 0.1 * height, 0.0], [0.0, 0.1 * height, 0.0]]);
    made.add(&Solid::lathe(&neck).moved([0.0, 0.0, legs + torso - 0.03 * height]), HOLLOW);
    let head_low = legs + torso + 0.04 * height;
    let head = 0.22 * height;
    made.add(
        &Solid::block([0.72 * wide, 0.9 * deep, head], edge * 1.6, edge * 1.3).moved([0.0, 0.0, head_low]),
        HOLLOW,
    );
    for side in [-1.0, 1.0] {
        let eye =
            egg([0.10 * wide, 0.05 * height, 0.10 * wide], [side * 0.17 * wide, -0.42 * deep, head_low + 0.60 * head]);
        made.add(&eye, HOLLOW);
    }
    let dial = fillet(&[[0.0, -3.0, 0.0], [0.2 * wide, -3.0, 0.0], [0.2 * wide, 2.0, 0.8], [0.0, 2.0, 0.0]]);
    made.add(
        &Solid::lathe(&dial).turned([1.0, 0.0, 0.0], FRAC_PI_2).moved([0.0, -deep / 2.0, legs + 0.58 * torso]),
        HOLLOW,
    );
    let aerial = fillet(&[[0.0, -3.0, 0.0], [1.6, -3.0, 0.0], [1.6, 0.08 * height, 0.0], [0.0, 0.08 * height, 0.0]]);
    made.add(&Solid::lathe(&aerial).moved([0.0, 0.0, head_low + head]), HOLLOW);
    made.add(&egg([0.028 * height; 3], [0.0, 0.0, head_low + head + 0.09 * height]), HOLLOW);
}

/// Rings on a peg, the largest below, a ball on top.
fn ring_tower(draw: &mut Draw, made: &mut Assembly) {
    const N_RINGS: i32 = 4;
    let r = draw.between(32.0, 44.0);
    let thick = draw.between(9.0, 12.0);
    let shrink = draw.between(0.11, 0.15) * r;
    let mut profile =
        fillet(&[[0.0, 0.0, 0.0], [r * 1.02, 0.0, 2.0], [r * 0.95, 6.0, 3.0], [r - 0.6 * thick, 7.0, 0.0]]);
    let pitch = 1.7 * thick;
    for idx in 0..N_RINGS {
        // The outer side of a ring, round as far as the next one lets see.
        let (x, z) = (r - shrink * f64::from(idx) - thick, 7.0 + thick + pitch * f64::from(idx));
        let arc: Vec<Point> = (0..=96)
            .map(|step| {
                let (sin, cos) = (1.02 * (f64::from(step) / 48.0 - 1.0)).sin_cos();
                [x + thick * cos, z + thick * sin]
            })
            .collect();
        profile.extend(simplify(&arc));
    }
    let top = 7.0 + thick + pitch * f64::from(N_RINGS - 1) + 0.85 * thick;
    profile.push([0.0, top]);
    made.add(&Solid::lathe(&profile), WOOD);
    let ball = 0.36 * r;
    made.add(&egg([ball; 3], [0.0, 0.0, top + 0.85 * ball]), WOOD);
}

/// A rocket on three fins.
fn rocket(draw: &mut Draw, made: &mut Assembly) {
    let height = draw.between(120.0, 190.0);
    let r = height * draw.between(0.145, 0.185);
    let clear = 0.13 * height;
    let mut body = vec![[0.0, clear]];
    body.extend(spline(&[
        [0.62 * r, clear],
        [0.88 * r, clear + 0.16 * height],
        [r, 0.46 * height],
        [0.84 * r, 0.70 * height],
        [0.40 * r, 0.90 * height],
        [0.0, height],
    ]));
    made.add(&Solid::lathe(&body), WOOD);
    let fin = closed_fillet(&[
        [0.45 * r, clear + 0.04 * height, 2.5],
        [1.35 * r, 0.0, 2.5],
        [1.75 * r, 0.0, 4.0],
        [1.6 * r, 0.16 * height, 0.10 * height],
        [0.50 * r, 0.40 * height, 2.5],
    ]);
    for idx in 0..3 {
        let angle = std::f64::consts::TAU * (f64::from(idx) / 3.0 + 0.25);
        made.add(&Solid::plate(&fin, 6.5, 1.2).turned([0.0, 0.0, 1.0], angle), WOOD);
    }
    let window = fillet(&[
        [0.0, -8.0, 0.0],
        [0.48 * r, -8.0, 0.0],
        [0.48 * r, 2.5, 1.2],
        [0.36 * r, 2.5, 0.6],
        [0.32 * r, 1.2, 0.0],
        [0.0, 1.2, 0.0],
    ]);
    made.add(&Solid::lathe(&window).turned([1.0, 0.0, 0.0], FRAC_PI_2).moved([0.0, -0.94 * r, 0.58 * height]), WOOD);
}

fn egg(semi_axes_mm: [f64; 3], centre_mm: [f64; 3]) -> Solid {
    Solid::ellipsoid(semi_axes_mm).moved(centre_mm)
}
