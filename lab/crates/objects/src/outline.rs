//! Plane curves that the solids are made from: fillets, splines, ellipses and rounded rectangles, in millimetres.
//!
//! Curves are cut into chords that stay within [`SAG_MM`] of the curve.

/// Farthest that a chord may run from the curve it stands for. A surface curved both ways is off by twice this at most.
pub(super) const SAG_MM: f64 = 0.075;

/// A point of the plane; for a profile that is turned on the z axis: radius and height.
pub(super) type Point = [f64; 2];

/// Chords that an arc needs.
pub(super) fn n_chords(radius_mm: f64, angle_rad: f64) -> usize {
    let half_step_rad = (1.0 - SAG_MM / radius_mm.max(2.0 * SAG_MM)).acos();
    ((angle_rad.abs() / (2.0 * half_step_rad)).ceil() as usize).max(2)
}

/// Chords around a full circle: a multiple of four, twelve at least.
pub(super) fn n_around(radius_mm: f64) -> usize {
    n_chords(radius_mm, std::f64::consts::TAU).div_ceil(4).max(3) * 4
}

/// An open line through corners, each `[x, y, radius]`, with the corners rounded off. A radius too large for its corner
/// is made smaller; the first and last corner stay as they are.
pub(super) fn fillet(corners: &[[f64; 3]]) -> Vec<Point> {
    let mut points = Vec::new();
    for (idx, &[x, y, radius_mm]) in corners.iter().enumerate() {
        let neighbours = (idx > 0).then(|| corners[idx - 1]).zip(corners.get(idx + 1));
        match neighbours {
            Some((before, after)) if radius_mm > 0.0 => {
                arc_in_corner([before[0], before[1]], [x, y], [after[0], after[1]], radius_mm, &mut points);
            }
            _ => points.push([x, y]),
        }
    }
    without_repeats(points)
}

/// As [`fillet`], closed: the last corner is joined to the first.
pub(super) fn closed_fillet(corners: &[[f64; 3]]) -> Vec<Point> {
    let n = corners.len();
    let mut points = Vec::new();
    for idx in 0..n {
        let [before, corner, after] =
            [(idx + n - 1) % n, idx, (idx + 1) % n].map(|idx| [corners[idx][0], corners[idx][1]]);
        if corners[idx][2] > 0.0 {
            arc_in_corner(before, corner, after, corners[idx][2], &mut points);
        } else {
            points.push(corner);
        }
    }
    let mut points = without_repeats(points);
    if points.len() > 3 && distance(points[0], points[points.len() - 1]) < REPEAT_MM {
        points.pop();
    }
    points
}

/// A smooth line through `knots` (Catmull and Rom's), cut into as few chords as [`SAG_MM`] allows. Where it begins or
/// ends on x = 0 it does so at a right angle, so that turning it gives no tip.
pub(super) fn spline(knots: &[Point]) -> Vec<Point> {
    const N_PER_SPAN: usize = 24;
    let n = knots.len();
    let mut points = vec![knots[0]];
    let mut line = vec![beyond(knots[0], knots[1])];
    line.extend(knots);
    line.push(beyond(knots[n - 1], knots[n - 2]));
    for span in line.windows(4) {
        let [p0, p1, p2, p3] = [span[0], span[1], span[2], span[3]];
        for step in 1..=N_PER_SPAN {
            let t = step as f64 / N_PER_SPAN as f64;
            points.push(std::array::from_fn(|axis| {
                let [a, b, c, d] = [p0[axis], p1[axis], p2[axis], p3[axis]];
                0.5 * (2.0 * b
                    + (c - a) * t
                    + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
                    + (3.0 * b - a - 3.0 * c + d) * t * t * t)
            }));
        }
    }
    simplify(&points)
}

/// The knot that a line would have beyond its end.
fn beyond(end: Point, next: Point) -> Point {
    if end[0].abs() < 1e-9 { [-next[0], next[1]] } else { [2.0 * end[0] - next[0], 2.0 * end[1] - next[1]] }
}

/// Half of an ellipse around (0, centre) from its lowest to its highest point, on the side of positive x.
pub(super) fn half_ellipse([a, b]: [f64; 2], centre: f64) -> Vec<Point> {
    let points: Vec<Point> = (0..=256)
        .map(|idx| {
            let (sin, cos) = (std::f64::consts::PI * (f64::from(idx) / 256.0 - 0.5)).sin_cos();
            [if idx % 256 == 0 { 0.0 } else { a * cos }, centre + b * sin]
        })
        .collect();
    simplify(&points)
}

/// A closed curve |x/a|^k + |y/b|^k = 1: an ellipse for k = 2, ever squarer above.
pub(super) fn superellipse([a, b]: [f64; 2], exponent: f64, n: usize) -> Vec<Point> {
    (0..n)
        .map(|idx| {
            let (sin, cos) = (std::f64::consts::TAU * idx as f64 / n as f64).sin_cos();
            [a * squared(cos, exponent), b * squared(sin, exponent)]
        })
        .collect()
}

/// A sine or cosine as a superellipse of that exponent has it.
pub(super) fn squared(value: f64, exponent: f64) -> f64 {
    value.signum() * value.abs().powf(2.0 / exponent)
}

/// An ellipse.
pub(super) fn ellipse(semi_axes_mm: [f64; 2]) -> Vec<Point> {
    superellipse(semi_axes_mm, 2.0, n_around(semi_axes_mm[0].max(semi_axes_mm[1])))
}

/// A rectangle of that size around the origin with arcs for corners.
pub(super) fn rounded_rectangle([width, height]: [f64; 2], corner_mm: f64) -> Vec<Point> {
    let (x, y) = (width / 2.0, height / 2.0);
    closed_fillet(&[[x, -y, corner_mm], [x, y, corner_mm], [-x, y, corner_mm], [-x, -y, corner_mm]])
}

/// Fewer points, no dropped one farther than [`SAG_MM`] from the line left. Ends stay.
pub(super) fn simplify(points: &[Point]) -> Vec<Point> {
    simplify_within(points, SAG_MM)
}

/// As [`simplify`], for another distance: each chord goes as far as it can.
pub(super) fn simplify_within(points: &[Point], sag_mm: f64) -> Vec<Point> {
    let last = points.len() - 1;
    let mut kept = vec![points[0]];
    let mut from = 0;
    while from < last {
        let fits =
            |to: usize| (from + 1..to).all(|idx| distance_to_segment(points[idx], points[from], points[to]) <= sag_mm);
        let mut to = from + 1;
        while to < last && fits(to + 1) {
            to += 1;
        }
        kept.push(points[to]);
        from = to;
    }
    kept
}

/// The same line with no step in y longer than `step_mm`.
pub(super) fn subdivide(line: &[Point], step_mm: f64) -> Vec<Point> {
    let mut dense = vec![line[0]];
    for pair in line.windows(2) {
        let n = ((pair[1][1] - pair[0][1]).abs() / step_mm).ceil().max(1.0);
        dense.extend((1..=n as usize).map(|step| {
            let along = step as f64 / n;
            [0, 1].map(|axis| pair[0][axis] + along * (pair[1][axis] - pair[0][axis]))
        }));
    }
    dense
}

/// Points of a line moved to its left by `by_mm`, corners kept sharp; `closed` tells whether the ends are neighbours.
pub(super) fn offset(points: &[Point], by_mm: f64, closed: bool) -> Vec<Point> {
    let n = points.len();
    (0..n)
        .map(|idx| {
            let before = if idx > 0 { Some(idx - 1) } else { closed.then_some(n - 1) };
            let after = if idx + 1 < n { Some(idx + 1) } else { closed.then_some(0) };
            let a = before.map(|before| left(points[before], points[idx]));
            let b = after.map(|after| left(points[idx], points[after]));
            let (a, b) = (a.or(b).unwrap_or([0.0; 2]), b.or(a).unwrap_or([0.0; 2]));
            let stretch = by_mm / (1.0 + a[0] * b[0] + a[1] * b[1]).max(0.2);
            [points[idx][0] + (a[0] + b[0]) * stretch, points[idx][1] + (a[1] + b[1]) * stretch]
        })
        .collect()
}

/// The direction to the left of a line.
fn left(from: Point, to: Point) -> Point {
    let length = distance(from, to);
    [(from[1] - to[1]) / length, (to[0] - from[0]) / length]
}

/// Points nearer than this to the one before are left out, so that no triangle is without area.
const REPEAT_MM: f64 = 0.02;

fn without_repeats(points: Vec<Point>) -> Vec<Point> {
    let mut kept: Vec<Point> = Vec::with_capacity(points.len());
    for point in points {
        if kept.last().is_none_or(|last| distance(*last, point) >= REPEAT_MM) {
            kept.push(point);
        }
    }
    kept
}

fn arc_in_corner(before: Point, corner: Point, after: Point, radius_mm: f64, points: &mut Vec<Point>) {
    let [a, b] = [before, after].map(|to| {
        let length = distance(corner, to);
        [(to[0] - corner[0]) / length, (to[1] - corner[1]) / length]
    });
    let turn_rad = std::f64::consts::PI - (a[0] * b[0] + a[1] * b[1]).clamp(-1.0, 1.0).acos();
    if turn_rad < 0.02 {
        points.push(corner);
        return;
    }
    let half_tan = (turn_rad / 2.0).tan();
    // Half of either leg is left to the neighbouring corner.
    let cut_mm = (radius_mm * half_tan).min(0.499 * distance(corner, before)).min(0.499 * distance(corner, after));
    let radius_mm = cut_mm / half_tan;
    let bisector = [a[0] + b[0], a[1] + b[1]];
    let to_centre_mm = radius_mm / (turn_rad / 2.0).cos() / bisector[0].hypot(bisector[1]);
    let centre = [corner[0] + bisector[0] * to_centre_mm, corner[1] + bisector[1] * to_centre_mm];
    let start = [corner[0] + a[0] * cut_mm - centre[0], corner[1] + a[1] * cut_mm - centre[1]];
    let turn_rad = if a[0] * b[1] - a[1] * b[0] < 0.0 { turn_rad } else { -turn_rad };
    let n = n_chords(radius_mm, turn_rad);
    for idx in 0..=n {
        let (sin, cos) = (turn_rad * idx as f64 / n as f64).sin_cos();
        points.push([centre[0] + start[0] * cos - start[1] * sin, centre[1] + start[0] * sin + start[1] * cos]);
    }
}

pub(super) fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn distance_to_segment(point: Point, a: Point, b: Point) -> f64 {
    let (along, length_squared) = ([b[0] - a[0], b[1] - a[1]], distance(a, b).powi(2));
    let t = if length_squared > 0.0 {
        (((point[0] - a[0]) * along[0] + (point[1] - a[1]) * along[1]) / length_squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    distance(point, [a[0] + t * along[0], a[1] + t * along[1]])
}
