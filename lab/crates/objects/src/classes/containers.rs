//! Bottles, cans, jars, boxes and vases. They stand on z = 0 around the z axis.

use nalgebra::{Point3, Vector3};
use parry3d_f64::shape::SharedShape;

use super::super::outline::{closed_fillet, ellipse, fillet, rounded_rectangle, spline, superellipse};
use super::super::solid::{Assembly, Solid};
use super::{Draw, capped, radius_at, spline_from_axis};

/// A filled bottle or can, packaging included.
const FILLED: f64 = 970.0;
const CERAMIC: f64 = 2300.0;
/// Cardboard and its content.
const PACKAGE: f64 = 350.0;
const LID: f64 = 500.0;

/// Water, wine, beer, shampoo and spray bottles, filled and closed.
pub(super) fn bottle(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(5) {
        0 => drinks_bottle(draw, made),
        1 => wine_bottle(draw, made),
        2 => beer_bottle(draw, made),
        3 => shampoo_bottle(draw, made),
        _ => spray_bottle(draw, made),
    }
}

/// A 0.5 to 1 l PET bottle with a grip.
fn drinks_bottle(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(31.0, 38.0);
    let h = draw.between(195.0, 255.0);
    let grip = r - draw.between(2.0, 4.5);
    let body = fillet(&[
        [0.0, 2.0, 0.0],
        [r * 0.55, 0.0, 3.0],
        [r, 0.0, 10.0],
        [r, 0.30 * h, 15.0],
        [grip, 0.36 * h, 15.0],
        [grip, 0.46 * h, 15.0],
        [r, 0.52 * h, 15.0],
        [r, 0.68 * h, 30.0],
        [13.0, h - 27.0, 12.0],
        [13.0, h - 21.0, 0.5],
        [16.5, h - 20.0, 0.5],
        [16.5, h - 18.0, 0.5],
        [13.0, h - 17.0, 0.5],
        [13.0, h - 10.0, 0.0],
        [0.0, h - 10.0, 0.0],
    ]);
    made.add(&Solid::lathe(&body), FILLED);
    made.add(&Solid::lathe(&cap(15.0, h - 15.5, h)), LID);
}

/// Bordeaux and Burgundy: 0.375 and 0.75 l.
fn wine_bottle(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(31.0, 41.0);
    let h = draw.between(245.0, 325.0);
    let shoulder = draw.between(0.50, 0.64);
    let soft = draw.between(18.0, 70.0);
    let body = fillet(&[
        [0.0, 0.0, 0.0],
        [r, 0.0, 5.0],
        [r, shoulder * h, soft],
        [14.0, (shoulder + 0.12) * h, soft],
        [13.5, h - 22.0, 1.0],
        [15.0, h - 20.0, 1.0],
        [15.0, h - 2.0, 1.0],
        [13.5, h, 1.0],
        [0.0, h, 0.0],
    ]);
    made.add(&Solid::lathe(&body), 1150.0);
}

/// Beer and lemonade, 0.33 to 0.5 l, crown cap.
fn beer_bottle(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(30.0, 36.0);
    let h = draw.between(185.0, 265.0);
    let body = fillet(&[
        [0.0, 0.0, 0.0],
        [r, 0.0, 4.0],
        [r, 0.56 * h, 30.0],
        [16.5, 0.74 * h, 40.0],
        [13.0, h - 16.0, 2.0],
        [14.3, h - 13.0, 1.0],
        [14.3, h - 6.0, 1.0],
        [13.0, h - 4.0, 0.0],
        [0.0, h - 4.0, 0.0],
    ]);
    made.add(&Solid::lathe(&body), 1200.0);
    made.add(
        &Solid::lathe(&fillet(&[[0.0, h - 5.5, 0.0], [16.0, h - 5.5, 0.5], [14.0, h, 2.0], [0.0, h, 0.0]])),
        2000.0,
    );
}

/// Shampoo: an oval body, a round cap.
fn shampoo_bottle(draw: &mut Draw, made: &mut Assembly) {
    let a = draw.between(27.0, 40.0);
    let b = draw.between(17.0, 25.0);
    let h = draw.between(140.0, 215.0);
    let line = fillet(&[
        [0.80 * a, 0.0, 0.0],
        [0.97 * a, 1.5, 5.0],
        [a, h * 0.35, 60.0],
        [0.93 * a, h * 0.78, 25.0],
        [0.48 * a, h - 24.0, 10.0],
        [0.46 * a, h - 20.0, 0.0],
    ]);
    let squareness = draw.between(2.0, 2.8);
    let n = ellipse([a, b]).len();
    let sections: Vec<_> = line.iter().map(|[x, z]| (*z, superellipse([*x, b / a * x], squareness, n))).collect();
    made.add(&Solid::stack(&sections), FILLED);
    made.add(&Solid::lathe(&cap(0.46 * b + 5.0, h - 23.0, h)), LID);
}

/// Cleaner with a trigger spray head.
fn spray_bottle(draw: &mut Draw, made: &mut Assembly) {
    let a = draw.between(36.0, 46.0);
    let b = draw.between(24.0, 32.0);
    let h = draw.between(150.0, 190.0);
    let line = spline(&[
        [0.95 * b, 0.0],
        [b, 5.0],
        [b, 0.25 * h],
        [0.97 * b, 0.45 * h],
        [0.70 * b, 0.64 * h],
        [0.60 * b, 0.82 * h],
        [13.0, h],
    ]);
    let n = ellipse([a, b]).len();
    // The neck is round: the long axis shrinks more.
    let sections: Vec<_> = line
        .iter()
        .map(|[y, z]| {
            let round = (z / h).powi(2);
            (*z, superellipse([a / b * y * (1.0 - round) + y * round, *y], 2.2, n))
        })
        .collect();
    made.add(&Solid::stack(&sections), FILLED);
    made.add(&Solid::lathe(&cap(15.5, h - 2.0, h + 17.0)), LID);
    let head = closed_fillet(&[
        [16.0, h + 15.0, 3.0],
        [17.0, h + 34.0, 8.0],
        [14.0, h + 50.0, 12.0],
        [-44.0, h + 49.0, 4.0],
        [-46.0, h + 36.0, 4.0],
        [-20.0, h + 35.0, 6.0],
        [-12.0, h + 15.0, 4.0],
    ]);
    made.add(&Solid::plate(&head, 22.0, 2.5), LID);
    let nozzle = Solid::lathe(&fillet(&[[0.0, 0.0, 0.0], [8.0, 0.0, 1.0], [7.0, 14.0, 1.0], [0.0, 14.0, 0.0]]));
    made.add(&nozzle.turned([0.0, 1.0, 0.0], -std::f64::consts::FRAC_PI_2).moved([-40.0, 0.0, h + 42.5]), LID);
    let trigger = closed_fillet(&[
        [-24.0, h + 38.0, 2.5],
        [-33.0, h + 38.0, 2.5],
        [-39.0, h - 2.0, 3.0],
        [-47.0, h - 9.0, 2.5],
        [-42.0, h - 13.0, 2.5],
        [-32.0, h - 5.0, 3.0],
    ]);
    made.add(&Solid::plate(&trigger, 13.0, 1.5), LID);
}

/// Drinks cans, food tins, flat tins and aerosols.
pub(super) fn can(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(4) {
        0 => {
            // 250 ml slim to 500 ml.
            let r = draw.between(26.5, 33.5);
            let h = draw.between(114.0, 169.0);
            let profile = fillet(&[
                [0.0, 8.0, 0.0],
                [r - 11.0, 6.0, 2.0],
                [r - 9.0, 0.0, 1.5],
                [r - 6.5, 0.0, 1.5],
                [r, 9.0, 6.0],
                [r, h - 14.0, 5.0],
                [r - 5.5, h - 4.0, 2.0],
                [r - 4.5, h, 0.6],
                [r - 7.0, h, 0.5],
                [r - 7.5, h - 4.0, 1.0],
                [0.0, h - 4.0, 0.0],
            ]);
            made.add(&Solid::lathe(&profile), 1000.0);
        }
        1 => {
            let r = draw.between(32.0, 49.5);
            let h = draw.between(78.0, 124.0);
            made.add(&Solid::lathe(&tin(r, h)), 1050.0);
        }
        2 => {
            let r = draw.between(39.0, 52.0);
            let h = draw.between(34.0, 58.0);
            made.add(&Solid::lathe(&tin(r, h)), 1050.0);
        }
        _ => {
            // Deodorant, hair spray, paint.
            let r = draw.between(22.0, 33.0);
            let h = draw.between(150.0, 215.0);
            made.add(&Solid::lathe(&tin(r, h - 42.0)), 800.0);
            let cap = fillet(&[
                [0.0, h - 43.5, 0.0],
                [r - 2.5, h - 43.5, 0.0],
                [r - 2.5, h - 38.0, 3.0],
                [r - 4.5, h - 4.0, 8.0],
                [r - 11.0, h, 8.0],
                [0.0, h, 0.0],
            ]);
            made.add(&Solid::lathe(&cap), 200.0);
        }
    }
}

/// Jam jars, spice jars, square honey jars, all with lids, and open preserving jars.
pub(super) fn jar(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(4) {
        0 => {
            let r = draw.between(32.0, 46.0);
            let h = draw.between(80.0, 140.0);
            let neck = r - draw.between(4.0, 7.0);
            made.add(&Solid::lathe(&jar_body(r, neck, h)), 1250.0);
            made.add(&Solid::lathe(&cap(neck + 2.0, h - 14.0, h)), 700.0);
        }
        1 => {
            let r = draw.between(20.0, 26.0);
            let h = draw.between(85.0, 120.0);
            made.add(&Solid::lathe(&jar_body(r, r - 3.5, h)), 800.0);
            made.add(&Solid::lathe(&cap(r - 1.0, h - 22.0, h)), LID);
        }
        2 => {
            let side = draw.between(56.0, 84.0);
            let h = draw.between(85.0, 130.0);
            let neck = side / 2.0 - draw.between(5.0, 8.0);
            let corner = side * draw.between(0.16, 0.28);
            let line = fillet(&[
                [side - 6.0, 0.0, 0.0],
                [side, 3.0, 4.0],
                [side, h * 0.66, 12.0],
                [2.0 * neck * 0.9, h - 15.0, 0.0],
            ]);
            let square = rounded_rectangle([side; 2], corner);
            let sections: Vec<_> = line
                .iter()
                .map(|[width, z]| (*z, square.iter().map(|point| point.map(|xy| xy * width / side)).collect()))
                .collect();
            made.add(&Solid::stack(&sections), 1300.0);
            made.add(&Solid::lathe(&cap(neck, h - 17.0, h)), 700.0);
        }
        _ => {
            // Open and empty: a glass to put preserves in.
            let r = draw.between(34.0, 46.0);
            let h = draw.between(85.0, 150.0);
            let neck = r - draw.between(2.0, 5.0);
            let outer =
                fillet(&[[0.0, 0.0, 0.0], [r, 0.0, 7.0], [r, h - 26.0, 10.0], [neck, h - 17.0, 8.0], [neck, h, 0.0]]);
            made.add(&Solid::vessel(&outer, 0.0, 3.2, 5.0), 2500.0);
            let bead = |z: f64| {
                let ring = ellipse([1.6, 1.8]);
                Solid::turned_ring(&ring.iter().map(|[x, y]| [neck + x - 0.2, z + y]).collect::<Vec<_>>())
            };
            made.add(&bead(h - 5.0), 2500.0);
            made.add(&bead(h - 11.0), 2500.0);
        }
    }
}

/// Flat and tall boxes and cubes, and gable-top cartons.
pub(super) fn carton(draw: &mut Draw, made: &mut Assembly) {
    let size_mm = match draw.kind(4) {
        0 => [draw.between(110.0, 190.0), draw.between(28.0, 50.0), draw.between(80.0, 130.0)],
        1 => [draw.between(60.0, 130.0), draw.between(35.0, 65.0), draw.between(140.0, 220.0)],
        2 => {
            let side = draw.between(45.0, 105.0);
            [side, side * draw.between(0.93, 1.0), side * draw.between(0.9, 1.1)]
        }
        _ => return gable_top(draw, made),
    };
    let [x, y, z] = size_mm.map(|side| side / 2000.0);
    made.exact = Some((SharedShape::cuboid(x, y, z), PACKAGE));
}

/// Bulbs, amphorae with handles, flared and slender vases; hollow.
pub(super) fn vase(draw: &mut Draw, made: &mut Assembly) {
    let h = draw.between(140.0, 290.0) * if draw.kind(4) == 1 { 0.68 } else { 1.0 };
    let r = draw.between(0.19, 0.26) * h;
    let wall = draw.between(4.0, 6.0);
    let outer = match draw.kind(4) {
        0 => {
            let neck = draw.between(0.34, 0.5) * r;
            spline_from_axis(&[
                [0.60 * r, 0.0],
                [0.93 * r, 0.16 * h],
                [r, 0.34 * h],
                [0.78 * r, 0.56 * h],
                [neck, 0.76 * h],
                [neck, 0.88 * h],
                [1.35 * neck, h],
            ])
        }
        1 => {
            let neck = draw.between(0.46, 0.58) * r;
            spline_from_axis(&[
                [0.46 * r, 0.0],
                [0.62 * r, 0.16 * h],
                [0.96 * r, 0.42 * h],
                [0.94 * r, 0.60 * h],
                [neck, 0.78 * h],
                [0.95 * neck, 0.90 * h],
                [1.3 * neck, h],
            ])
        }
        2 => {
            let waist = draw.between(0.55, 0.75) * r;
            spline_from_axis(&[
                [0.80 * r, 0.0],
                [0.74 * r, 0.12 * h],
                [waist, 0.42 * h],
                [0.86 * r, 0.78 * h],
                [1.12 * r, h],
            ])
        }
        _ => {
            let top = draw.between(0.6, 0.85) * r;
            fillet(&[[0.0, 0.0, 0.0], [0.7 * r, 0.0, 12.0], [r, 0.36 * h, 90.0], [top, h, 0.0]])
        }
    };
    made.add(&Solid::vessel(&outer, 0.0, wall, wall + 2.0), CERAMIC);
    if draw.kind(4) == 1 {
        let (low, high) = (0.60 * h, 0.88 * h);
        let [x_low, x_high] = [low, high].map(|z| radius_at(&outer, z) - 0.5 * wall);
        // Ear-shaped: from the neck outwards and down onto the shoulder.
        let path = spline(&[
            [x_high, high],
            [x_high + 0.12 * h, high + 0.01 * h],
            [x_low + 0.10 * h, 0.76 * h],
            [x_low, low + 0.03 * h],
        ]);
        let thick = draw.between(3.5, 5.0);
        for sign in [1.0, -1.0] {
            let points: Vec<_> = path.iter().map(|[x, z]| Point3::new(x * sign, 0.0, *z)).collect();
            made.add(
                &Solid::sweep(&points, Vector3::y(), [0.0; 2], |_| superellipse([thick, thick * 1.4], 2.0, 18)),
                CERAMIC,
            );
        }
    }
}

/// A milk carton, its ridge along x.
fn gable_top(draw: &mut Draw, made: &mut Assembly) {
    let (w, d) = (draw.between(58.0, 95.0), draw.between(58.0, 92.0));
    let (h, roof) = (draw.between(95.0, 195.0), draw.between(22.0, 34.0));
    let rectangle = |width: f64, depth: f64| rounded_rectangle([width, depth], 0.0);
    let sections = [(0.0, rectangle(w, d)), (h, rectangle(w, d)), (h + roof, rectangle(w, 4.0))];
    made.add(&Solid::stack(&sections), 900.0);
    let fin = [(h + roof - 2.0, rectangle(w - 1.2, 3.0)), (h + roof + 14.0, rectangle(w - 1.2, 2.6))];
    made.add(&Solid::stack(&fin), 700.0);
    if draw.between(0.0, 1.0) > 0.5 {
        let lean_rad = ((d / 2.0 - 2.0) / roof).atan();
        let spout = Solid::lathe(&fillet(&[[0.0, -6.0, 0.0], [12.0, -6.0, 0.0], [12.0, 9.0, 1.0], [0.0, 9.0, 0.0]]));
        let side = std::f64::consts::FRAC_PI_2 - lean_rad;
        made.add(&spout.turned([1.0, 0.0, 0.0], side).moved([0.0, -d / 4.0 - 1.0, h + roof / 2.0]), LID);
    }
}

/// A screw cap from one height to another.
fn cap(r: f64, low: f64, high: f64) -> Vec<[f64; 2]> {
    fillet(&[[0.0, low, 0.0], [r, low, 0.4], [r, high, 1.5], [0.0, high, 0.0]])
}

/// A tin with a seam around either end.
fn tin(r: f64, h: f64) -> Vec<[f64; 2]> {
    fillet(&[
        [0.0, 3.0, 0.0],
        [r - 3.0, 3.0, 0.0],
        [r - 2.5, 0.0, 0.7],
        [r, 0.0, 0.7],
        [r, 3.0, 0.0],
        [r - 1.2, 4.0, 0.0],
        [r - 1.2, h - 4.0, 0.0],
        [r, h - 3.0, 0.0],
        [r, h, 0.7],
        [r - 2.5, h, 0.7],
        [r - 3.0, h - 3.0, 0.0],
        [0.0, h - 3.0, 0.0],
    ])
}

fn jar_body(r: f64, neck: f64, h: f64) -> Vec<[f64; 2]> {
    capped(fillet(&[
        [r * 0.8, 0.0, 0.0],
        [r, 0.0, 5.0],
        [r, h - 30.0 * h / 110.0, 12.0],
        [neck, h - 14.0 * h / 110.0, 6.0],
        [neck, h - 4.0, 0.0],
    ]))
}
