//! Mugs, cups, bowls, teapots, spoons and knives. Vessels stand on z = 0 around the z axis, cutlery is long along z.

use nalgebra::{Point3, Vector3};

use super::super::outline::{Point, ellipse, fillet, half_ellipse, simplify, spline, squared, subdivide, superellipse};
use super::super::solid::{Assembly, Solid};
use super::{Draw, capped, radius_at, spline_from_axis};

const CERAMIC: f64 = 2300.0;
const GLASS: f64 = 2500.0;
const PLASTIC: f64 = 1000.0;
const STEEL: f64 = 7800.0;
const WOOD: f64 = 700.0;

/// Straight, tapered and bellied mugs with a handle that fingers go through.
pub(super) fn mug(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(36.0, 47.0);
    let h = draw.between(82.0, 114.0);
    let wall = draw.between(3.8, 5.0);
    let outer = match draw.kind(3) {
        0 => fillet(&[[0.0, 0.0, 0.0], [r, 0.0, 7.0], [r, h, 0.0]]),
        1 => fillet(&[[0.0, 0.0, 0.0], [r * draw.between(0.70, 0.82), 0.0, 6.0], [r, h, 0.0]]),
        _ => fillet(&[
            [0.0, 0.0, 0.0],
            [r * 0.72, 0.0, 5.0],
            [r * 1.02, 0.22 * h, 30.0],
            [r * 1.02, 0.62 * h, 60.0],
            [r * 0.9, h, 0.0],
        ]),
    };
    made.add(&Solid::vessel(&outer, 0.0, wall, wall + 1.5), CERAMIC);
    let high = h * draw.between(0.80, 0.86);
    let low = h * draw.between(0.17, 0.25);
    let reach = draw.between(31.0, 38.0);
    let squareness = draw.between(2.0, 3.0);
    let section = [draw.between(3.6, 4.6), draw.between(5.5, 8.0)];
    let ends = [high, low].map(|z| [radius_at(&outer, z) - 0.6 * wall, z]);
    made.add(&loop_handle(ends, reach, squareness, section), CERAMIC);
}

/// Tumblers, paper cups, tea bowls and wine glasses.
pub(super) fn cup(draw: &mut Draw, made: &mut Assembly) {
    match draw.kind(4) {
        0 => {
            let r = draw.between(31.0, 43.0);
            let h = draw.between(88.0, 150.0);
            let foot = r * draw.between(0.78, 0.98);
            let outer = fillet(&[[0.0, 0.0, 0.0], [foot, 0.0, 3.0], [r, h, 0.0]]);
            made.add(&Solid::vessel(&outer, 0.0, draw.between(2.0, 3.0), 9.0), GLASS);
        }
        1 => {
            // Paper and plastic, 0.2 to 0.5 l, with a rolled rim.
            let r = draw.between(36.0, 46.0);
            let h = draw.between(82.0, 150.0);
            let foot = r * draw.between(0.66, 0.74);
            let outer = fillet(&[
                [0.0, 4.0, 0.0],
                [foot - 2.5, 4.0, 0.0],
                [foot - 2.0, 0.0, 0.4],
                [foot, 0.0, 0.4],
                [r, h, 0.0],
            ]);
            made.add(&Solid::vessel(&outer, 0.0, 1.2, 5.5), 700.0);
            let bead: Vec<Point> = ellipse([2.0, 2.0]).iter().map(|[x, y]| [r + x + 1.1, h + y - 1.0]).collect();
            made.add(&Solid::turned_ring(&bead), 700.0);
        }
        2 => {
            // Without a handle, as for green tea.
            let r = draw.between(36.0, 50.0);
            let h = draw.between(52.0, 84.0);
            let foot = 0.52 * r;
            let outer = fillet(&[
                [0.0, 3.0, 0.0],
                [foot - 4.0, 3.0, 0.0],
                [foot - 3.0, 0.0, 1.0],
                [foot, 0.0, 1.0],
                [foot, 6.0, 1.0],
                [r * 0.93, 0.22 * h, 20.0],
                [r, h, 0.0],
            ]);
            made.add(&Solid::vessel(&outer, 5.9, 4.0, 10.0), CERAMIC);
        }
        _ => {
            let r = draw.between(31.0, 44.0);
            let h = draw.between(150.0, 225.0);
            let foot = draw.between(30.0, 38.0);
            let stem_top = h * draw.between(0.42, 0.52);
            let base = fillet(&[
                [0.0, 0.0, 0.0],
                [foot, 0.0, 0.8],
                [foot, 2.0, 0.8],
                [4.0, 7.0, 12.0],
                [4.0, stem_top + 3.0, 0.0],
                [0.0, stem_top + 3.0, 0.0],
            ]);
            made.add(&Solid::lathe(&base), GLASS);
            let bowl_h = h - stem_top;
            let rim = r * draw.between(0.72, 0.86);
            let outer = spline(&[
                [0.0, stem_top],
                [0.55 * r, stem_top + 0.08 * bowl_h],
                [0.95 * r, stem_top + 0.30 * bowl_h],
                [0.98 * r, stem_top + 0.52 * bowl_h],
                [rim, h],
            ]);
            made.add(&Solid::vessel(&outer, 0.0, 1.6, stem_top + 5.0), GLASS);
        }
    }
}

/// Soup bowls with a foot, deep mixing bowls, flared bowls.
pub(super) fn bowl(draw: &mut Draw, made: &mut Assembly) {
    let r = draw.between(55.0, 81.0);
    let wall = draw.between(3.5, 5.0);
    match draw.kind(3) {
        0 => {
            let h = r * draw.between(0.62, 0.85);
            let foot = 0.48 * r;
            let mut outer = vec![[0.0, 3.0], [foot - 5.0, 3.0], [foot - 4.0, 0.0], [foot, 0.0], [foot, 6.0]];
            outer.extend(spline(&[[foot + 1.0, 6.5], [0.76 * r, 0.30 * h], [0.93 * r, 0.60 * h], [r, h]]));
            made.add(&Solid::vessel(&outer, 5.9, wall, 6.0 + wall), CERAMIC);
        }
        1 => {
            let h = r * draw.between(0.80, 1.0);
            let outer = fillet(&[[0.0, 0.0, 0.0], [0.62 * r, 0.0, 0.5 * r], [0.99 * r, 0.5 * h, 0.8 * r], [r, h, 0.0]]);
            made.add(&Solid::vessel(&outer, 0.0, wall, wall), 1900.0);
            let bead: Vec<Point> =
                superellipse([3.0, 3.6], 2.0, 12).iter().map(|[x, z]| [r + x + 0.4, h + z - 3.6]).collect();
            made.add(&Solid::turned_ring(&bead), 1900.0);
        }
        _ => {
            let h = r * draw.between(0.50, 0.75);
            let outer = fillet(&[[0.0, 0.0, 0.0], [0.50 * r, 0.0, 0.25 * r], [r, h, 0.0]]);
            made.add(&Solid::vessel(&outer, 0.0, wall, wall + 0.5), WOOD);
        }
    }
}

/// Round teapots, tall coffee pots (both with their lids on) and open milk jugs.
pub(super) fn teapot(draw: &mut Draw, made: &mut Assembly) {
    /// Full of tea to half its height.
    const POT: f64 = 700.0;
    match draw.kind(3) {
        0 => {
            let r = draw.between(46.0, 59.0);
            let h = r * draw.between(1.45, 1.75);
            let opening = r * 0.5;
            let body = spline_from_axis(&[
                [0.62 * r, 0.0],
                [0.95 * r, 0.24 * h],
                [r, 0.48 * h],
                [0.84 * r, 0.78 * h],
                [opening, h],
            ]);
            made.add(&Solid::lathe(&capped(body.clone())), POT);
            made.add(&Solid::lathe(&lid(opening + 2.0, h - 2.0, 0.30 * r)), CERAMIC);
            let ends = [0.80 * h, 0.28 * h].map(|z| [radius_at(&body, z) - 4.0, z]);
            made.add(&loop_handle(ends, draw.between(40.0, 48.0), 2.3, [4.5, 7.0]), CERAMIC);
            let path = spline(&[
                [-radius_at(&body, 0.36 * h) + 12.0, 0.36 * h],
                [-r - 14.0, 0.46 * h],
                [-r - 27.0, 0.72 * h],
                [-r - 43.0, 0.98 * h],
            ]);
            made.add(&spout(&path, 14.0, 6.5), CERAMIC);
        }
        1 => {
            let r = draw.between(42.0, 54.0);
            let h = draw.between(150.0, 200.0);
            let opening = r * 0.64;
            let body = fillet(&[
                [0.0, 0.0, 0.0],
                [r, 0.0, 10.0],
                [r * 0.98, 0.4 * h, 120.0],
                [opening, h, 0.0],
                [0.0, h, 0.0],
            ]);
            made.add(&Solid::lathe(&body), POT);
            made.add(&Solid::lathe(&lid(opening + 2.0, h - 2.0, 0.4 * r)), CERAMIC);
            let ends = [0.88 * h, 0.30 * h].map(|z| [radius_at(&body, z) - 4.0, z]);
            made.add(&loop_handle(ends, draw.between(40.0, 50.0), 3.0, [5.0, 7.5]), CERAMIC);
            let path = spline(&[
                [-radius_at(&body, 0.48 * h) + 12.0, 0.48 * h],
                [-r - 12.0, 0.58 * h],
                [-r - 20.0, 0.80 * h],
                [-r - 36.0, 0.98 * h],
            ]);
            made.add(&spout(&path, 12.0, 6.0), CERAMIC);
        }
        _ => {
            let r = draw.between(40.0, 53.0);
            let h = draw.between(120.0, 180.0);
            let wall = draw.between(4.0, 5.0);
            let neck = r * draw.between(0.66, 0.78);
            let mut outer = spline_from_axis(&[
                [0.72 * r, 0.0],
                [0.97 * r, 0.18 * h],
                [r, 0.36 * h],
                [neck, 0.80 * h],
                [neck * 1.12, h],
            ]);
            let smooth = outer.iter().position(|point| point[1] > 0.72 * h).unwrap_or(0);
            let upper = subdivide(&outer[smooth..], 5.0);
            outer.truncate(smooth);
            outer.extend(upper);
            // The rim is drawn out into a lip towards -x.
            let lip = |point: Point3<f64>| {
                let upper = ((point.z / h - 0.78) / 0.22).max(0.0).powi(2);
                let forward = (-point.x / neck).max(0.0).powi(3);
                Point3::new(point.x - 11.0 * upper * forward, point.y, point.z + 4.0 * upper * forward)
            };
            made.add(&Solid::vessel(&outer, 0.0, wall, wall + 1.5).mapped(lip), CERAMIC);
            let ends = [0.86 * h, 0.28 * h].map(|z| [radius_at(&outer, z) - 0.5 * wall, z]);
            made.add(&loop_handle(ends, draw.between(36.0, 46.0), 2.6, [4.5, 7.5]), CERAMIC);
        }
    }
}

/// Table, tea, wooden and serving spoons, the bowl up.
pub(super) fn spoon(draw: &mut Draw, made: &mut Assembly) {
    let kind = draw.kind(3);
    // Length, half width and depth of the bowl; thickness of the metal; half width and half thickness of the handle.
    let (length, half_bowl, depth, thick, grip, density) = match kind {
        0 => (
            draw.between(128.0, 205.0),
            draw.between(14.0, 22.0),
            draw.between(5.0, 8.0),
            2.0,
            draw.between(5.5, 8.5),
            STEEL,
        ),
        1 => (
            draw.between(230.0, 320.0),
            draw.between(24.0, 32.0),
            draw.between(7.0, 10.0),
            5.0,
            draw.between(5.5, 7.5),
            WOOD,
        ),
        _ => (
            draw.between(260.0, 330.0),
            draw.between(33.0, 42.0),
            draw.between(18.0, 26.0),
            2.4,
            draw.between(7.0, 9.0),
            STEEL,
        ),
    };
    let half_length = half_bowl * if kind == 2 { 1.05 } else { 1.45 };
    let bowl_from = length - 2.0 * half_length;
    let neck = if kind == 1 { grip * 0.95 } else { 3.4 };
    let stout = if kind == 1 { 9.0 } else { thick + 0.8 };
    let bend = if kind == 2 { 26.0 } else { 7.0 };
    // Half width, dish depth, thickness and how far forward, at a height.
    let at = |z: f64| -> [f64; 4] {
        let handle = (z / bowl_from).min(1.0);
        let grip_now = neck + (grip - neck) * (1.0 - handle).powf(0.8);
        let end = (1.0 - ((6.0 - z.min(6.0)) / 6.0).powi(2)).max(0.03).sqrt();
        let u = ((z - (length - half_length)) / half_length).clamp(-1.0, 1.0);
        let round = (1.0 - u * u).max(0.0).sqrt();
        let in_bowl = ((z - bowl_from + 6.0) / 6.0).clamp(0.0, 1.0);
        let width = if z > length - half_length {
            half_bowl * round.max(0.05)
        } else {
            (half_bowl * round).max(grip_now * end)
        };
        let dish = depth * (1.0 - u * u).max(0.0) * in_bowl;
        let slope = (z - bowl_from * 0.7).max(0.0) / (length - bowl_from * 0.7);
        [width, dish, stout + (thick - stout) * in_bowl, -bend * slope * slope * (1.0 - slope) * 3.4]
    };
    // Close together at both ends and in the bowl, where it bends.
    let mut heights: Vec<f64> =
        (0..6).map(|idx| 6.0 * (1.0 - (f64::from(idx) / 6.0 * std::f64::consts::FRAC_PI_2).cos())).collect();
    heights.extend((0..18).map(|idx| 6.0 + (bowl_from - 10.0) * f64::from(idx) / 18.0));
    heights.extend((0..=26).map(|idx| {
        let along = 1.0 - (f64::from(idx) / 26.0 * std::f64::consts::PI).cos();
        bowl_from - 4.0 + (2.0 * half_length + 4.0) * along / 2.0
    }));
    let n_across = if kind == 2 { 22 } else { 12 };
    let rings: Vec<Vec<Point3<f64>>> = heights
        .iter()
        .map(|&z| {
            let [width, dish, thick, forward] = at(z);
            let side = |idx: usize, upper: bool| {
                // From edge to edge at even angles, so that the edges come out round.
                let angle = std::f64::consts::PI * idx as f64 / n_across as f64;
                let (x, edge) = (-angle.cos(), (angle.sin()).powf(0.6));
                let y = dish * (1.0 - x * x) + if upper { -0.5 } else { 0.5 } * thick * edge.max(0.25);
                Point3::new(x * width, y + forward, z)
            };
            (0..=n_across).map(|idx| side(idx, true)).chain((0..=n_across).rev().map(|idx| side(idx, false))).collect()
        })
        .collect();
    made.add(&Solid::loft(&rings), density);
}

/// Table, kitchen and chef's knives, the point up.
pub(super) fn knife(draw: &mut Draw, made: &mut Assembly) {
    // Half thickness of the spine, and where spine and edge are (x) at heights above the bolster.
    let blade = |handle: f64, half_thick: f64, spine: Vec<Point>, edge: Vec<Point>| {
        let x_at = |line: &[Point], z: f64| {
            let pair = line.windows(2).find(|pair| z <= pair[1][1] + 1e-9).unwrap_or(&line[line.len() - 2..]);
            let along = (z - pair[0][1]) / (pair[1][1] - pair[0][1]);
            pair[0][0] + along * (pair[1][0] - pair[0][0])
        };
        let tip = edge[edge.len() - 1][1];
        let rings: Vec<Vec<Point3<f64>>> = (0..=40)
            .map(|idx| {
                let z = tip * (f64::from(idx) / 40.0 * std::f64::consts::FRAC_PI_2).sin();
                let (back, front) = (x_at(&spine, z), x_at(&edge, z));
                let y = half_thick * (1.0 - 0.65 * z / tip);
                let x = |along: f64| back + along * (front - back);
                [
                    [0.0, 0.8],
                    [0.04, 1.0],
                    [0.5, 0.8],
                    [0.97, 0.25],
                    [1.0, 0.15],
                    [1.0, -0.15],
                    [0.97, -0.25],
                    [0.5, -0.8],
                    [0.04, -1.0],
                    [0.0, -0.8],
                ]
                .iter()
                .map(|[along, thick]| Point3::new(x(*along), y * thick, handle - 2.0 + z))
                .collect()
            })
            .collect();
        Solid::loft(&rings)
    };
    match draw.kind(3) {
        0 => {
            // All of steel; the handle swells towards its end.
            let length = draw.between(195.0, 245.0);
            let handle = length * draw.between(0.46, 0.52);
            let (wide, thick) = (draw.between(7.5, 10.0), draw.between(3.2, 4.5));
            made.add(&grip(handle, [wide * 0.95, thick], [wide * 0.55, thick * 0.8], 2.4), 5500.0);
            let tip = length - handle + 2.0;
            let spine =
                spline(&[[-0.45 * wide, 0.0], [-0.75 * wide, 0.3 * tip], [-0.7 * wide, 0.85 * tip], [0.1 * wide, tip]]);
            let edge =
                spline(&[[0.45 * wide, 0.0], [0.95 * wide, 0.15 * tip], [1.3 * wide, 0.7 * tip], [0.5 * wide, tip]]);
            made.add(&blade(handle, 1.3, spine, edge), STEEL);
        }
        1 => {
            // Chef's.
            let handle = draw.between(112.0, 132.0);
            let tip = draw.between(150.0, 225.0);
            let deep = draw.between(36.0, 50.0);
            made.add(&grip(handle, [13.5, 9.5], [11.0, 8.5], 2.6), WOOD * 1.6);
            let bolster = Solid::stack(&[
                (handle - 12.0, superellipse([13.0, 9.0], 2.6, 36)),
                (handle + 4.0, superellipse([11.5, 5.0], 2.6, 36)),
            ]);
            made.add(&bolster.moved([0.0, 0.0, 0.0]), STEEL);
            let spine = spline(&[[-12.0, 0.0], [-12.0, 0.55 * tip], [-6.0, tip]]);
            let edge =
                spline(&[[deep - 12.0, 0.0], [deep - 13.0, 0.35 * tip], [0.55 * deep - 8.0, 0.80 * tip], [-4.5, tip]]);
            made.add(&blade(handle + 5.0, 1.4, spine, edge), STEEL);
        }
        _ => {
            // Paring and utility.
            let handle = draw.between(88.0, 112.0);
            let tip = draw.between(72.0, 125.0);
            let deep = draw.between(17.0, 24.0);
            made.add(&grip(handle, [11.0, 8.0], [9.0, 6.5], 2.4), PLASTIC * 1.2);
            let spine = spline(&[[-7.0, 0.0], [-7.0, 0.5 * tip], [-1.0, tip]]);
            let edge =
                spline(&[[deep - 7.0, 0.0], [deep - 8.5, 0.5 * tip], [0.45 * deep - 3.0, 0.85 * tip], [0.5, tip]]);
            made.add(&blade(handle, 1.0, spine, edge), STEEL);
        }
    }
}

/// A handle on the side of +x between two ends (x and z, the higher one first), superelliptic, of elliptic section.
pub(crate) fn loop_handle(ends: [Point; 2], reach: f64, squareness: f64, section: [f64; 2]) -> Solid {
    let [[x_high, high], [x_low, low]] = ends;
    let (middle, half) = ((high + low) / 2.0, (high - low) / 2.0);
    // On to the outermost point, measured from the upper end.
    let arc: Vec<Point> = (0..=240)
        .map(|idx| {
            let (sin, cos) = (std::f64::consts::FRAC_PI_2 * (1.0 - f64::from(idx) / 120.0)).sin_cos();
            let z = middle + half * squared(sin, squareness);
            let x = x_low + (x_high - x_low) * (z - low) / (high - low);
            [x + (reach + x_high.max(x_low) - x) * squared(cos.max(0.0), squareness), z]
        })
        .collect();
    let path: Vec<_> = simplify(&arc).iter().map(|[x, z]| Point3::new(*x, 0.0, *z)).collect();
    Solid::sweep(&path, Vector3::y(), [0.0; 2], |_| ellipse(section))
}

fn spout(path: &[Point], from: f64, to: f64) -> Solid {
    let path: Vec<_> = path.iter().map(|[x, z]| Point3::new(*x, 0.0, *z)).collect();
    Solid::sweep(&path, Vector3::y(), [0.0, 1.5], |along| {
        let r = from + (to - from) * along.powf(0.7);
        superellipse([r, r * 0.92], 2.0, 28)
    })
}

/// A domed lid with a knob.
fn lid(r: f64, z: f64, rise: f64) -> Vec<Point> {
    let knob = 0.30 * r.min(36.0);
    let mut profile = fillet(&[
        [0.0, z, 0.0],
        [r, z, 0.0],
        [r, z + 3.0, 0.0],
        [0.55 * r, z + rise, 20.0],
        [0.55 * knob, z + rise + 2.0, 2.0],
        [0.5 * knob, z + rise + 5.0, 0.0],
    ]);
    let top = half_ellipse([knob, knob * 0.85], z + rise + 5.0 + knob * 0.7);
    profile.extend(top.into_iter().filter(|point| point[1] > z + rise + 5.4));
    profile
}

/// A straight handle along z from 0 to its length, of superelliptic section, thickest in the lower half.
fn grip(length: f64, low: [f64; 2], high: [f64; 2], squareness: f64) -> Solid {
    let n = ellipse(low).len();
    let path: Vec<_> =
        (0..=15).map(|idx| Point3::new(0.0, 0.0, 3.0 + (length - 3.0) * f64::from(idx) / 15.0)).collect();
    Solid::sweep(&path, Vector3::y(), [3.0, 0.0], |along| {
        let swell =
            1.0 + 0.10 * (std::f64::consts::PI * along).sin() - 0.06 * (3.0 * std::f64::consts::PI * along).sin();
        let size = [0, 1].map(|axis| (low[axis] + (high[axis] - low[axis]) * along) * swell);
        superellipse(size, squareness, n)
    })
}
