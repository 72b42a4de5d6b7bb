//! Closed surfaces that objects are put together from: turned, lofted, swept and cut-out solids, in millimetres.
//!
//! Each solid is one closed surface, its triangles counter-clockwise seen from outside. Parts that join overlap:
//! nothing is cut away where one enters another.

use nalgebra::{Point3, Rotation3, Unit, Vector3};
use parry3d_f64::shape::SharedShape;

use crate::outline::{Point, n_around, offset};
use blindgrasp_mesh::Mesh;

/// How far down a vessel's inner side is as fine as its outer side.
const REACH_MM: f64 = 25.0;

/// One closed surface.
#[derive(Debug, Clone)]
pub(super) struct Solid {
    points_mm: Vec<Point3<f64>>,
    triangles: Vec<[u32; 3]>,
}

/// Solids put together, and their mass.
#[derive(Default)]
pub(super) struct Assembly {
    /// All solids so far, metres.
    mesh: Mesh,
    /// The sum of their masses; where they overlap, both count.
    pub(super) mass_kg: f64,
    /// One of parry's shapes and its density, in the place of solids.
    pub(super) exact: Option<(SharedShape, f64)>,
}

impl Assembly {
    /// Adds a solid of that density.
    pub(super) fn add(&mut self, solid: &Solid, density_kg_per_m3: f64) {
        let part = Mesh {
            vertices_m: solid.points_mm.iter().map(|point| point / 1000.0).collect(),
            triangles: solid.triangles.clone(),
        };
        self.mass_kg += part.signed_volume_m3() * density_kg_per_m3;
        self.mesh.append(&part);
    }

    /// The mesh, its lowest point put on z = 0.
    pub(super) fn standing(mut self) -> Mesh {
        let low_m = self.mesh.bounds()[0].z;
        self.mesh.vertices_m.iter_mut().for_each(|corner| corner.z -= low_m);
        self.mesh
    }
}

impl Solid {
    /// A skin over rings, one after the other; where two have different numbers of points, both begin in the same
    /// direction and their points lie evenly. Either end is closed: with a fan around the
    /// ring's middle, or at a tip if the end is a single point. End rings must be star-shaped about their middle.
    pub(super) fn loft(rings: &[Vec<Point3<f64>>]) -> Solid {
        let mut solid = Solid { points_mm: Vec::new(), triangles: Vec::new() };
        let firsts = solid.skin(rings);
        for (is_last, ring_idx) in [(false, 0), (true, rings.len() - 1)] {
            let n = rings[ring_idx].len() as u32;
            if n > 1 {
                let middle = rings[ring_idx].iter().map(|point| point.coords).sum::<Vector3<f64>>() / f64::from(n);
                let middle_idx = solid.points_mm.len() as u32;
                solid.points_mm.push(middle.into());
                for idx in 0..n {
                    let [a, b] = [firsts[ring_idx] + idx, firsts[ring_idx] + (idx + 1) % n];
                    solid.triangles.push(if is_last { [middle_idx, a, b] } else { [middle_idx, b, a] });
                }
            }
        }
        solid.facing_outwards()
    }

    /// A profile of radius and height, from a point to another on the z axis (or two flat ends), turned about z.
    pub(super) fn lathe(profile: &[Point]) -> Solid {
        Self::lathe_scaled(profile, [1.0, 1.0])
    }

    /// As [`Solid::lathe`], then stretched along x and y.
    pub(super) fn lathe_scaled(profile: &[Point], scale: [f64; 2]) -> Solid {
        Self::loft(&turned_rings(profile, scale))
    }

    /// A vessel turned about z: `outer` runs from the bottom (on the axis, or off it where a foot ring's hollow has been
    /// put before it) up to the rim. The inner side keeps `wall_mm` off what is higher than `foot_mm` and ends in a flat
    /// floor, or follows the outer side where that is higher. Deep inside, where fingers seldom get, it is coarser.
    pub(super) fn vessel(outer: &[Point], foot_mm: f64, wall_mm: f64, floor_mm: f64) -> Solid {
        let above_foot = outer.iter().rposition(|point| point[1] < foot_mm).map_or(0, |idx| idx + 1);
        let inner = inner_side(&outer[above_foot..], wall_mm, floor_mm);
        let coarse_below_mm = outer[outer.len() - 1][1] - REACH_MM;
        let mut rings = turned_rings(outer, [1.0, 1.0]);
        for (ring, point) in turned_rings(&inner, [1.0, 1.0]).into_iter().zip(&inner) {
            let every = if point[1] < coarse_below_mm && ring.len() > 16 { 2 } else { 1 };
            rings.push(ring.into_iter().step_by(every).collect());
        }
        Self::loft(&rings)
    }

    /// A closed profile that stays off the z axis, turned about it: a ring.
    pub(super) fn turned_ring(profile: &[Point]) -> Solid {
        let mut rings = turned_rings(profile, [1.0, 1.0]);
        rings.push(rings[0].clone());
        let mut solid = Solid { points_mm: Vec::new(), triangles: Vec::new() };
        let firsts = solid.skin(&rings);
        let last = firsts[firsts.len() - 1];
        for triangle in &mut solid.triangles {
            *triangle = triangle.map(|idx| if idx >= last { idx - last } else { idx });
        }
        solid.points_mm.truncate(last as usize);
        solid.facing_outwards()
    }

    /// An ellipsoid around the origin: rings of six points more each from either pole, so that its triangles are alike.
    pub(super) fn ellipsoid(semi_axes_mm: [f64; 3]) -> Solid {
        // The middle of a triangle with these steps is up to 0.5 r/n² off a sphere; flat sides of an ellipsoid bend less.
        let [least, most] = [f64::min, f64::max].map(|pick| semi_axes_mm.into_iter().reduce(pick).unwrap_or_default());
        let n = (0.5 * (most * most.min(2.0 * least)).sqrt() / (2.0 * crate::outline::SAG_MM)).sqrt().ceil().max(3.0)
            as u32;
        let mut solid = Solid { points_mm: Vec::new(), triangles: Vec::new() };
        let mut firsts = Vec::new();
        for ring in 0..=2 * n {
            firsts.push(solid.points_mm.len() as u32);
            let (sin_polar, cos_polar) = (std::f64::consts::PI * f64::from(ring) / f64::from(2 * n)).sin_cos();
            let n_points = (6 * ring.min(2 * n - ring)).max(1);
            for idx in 0..n_points {
                let (sin, cos) = (std::f64::consts::TAU * f64::from(idx) / f64::from(n_points)).sin_cos();
                let [a, b, c] = semi_axes_mm;
                solid.points_mm.push(Point3::new(a * sin_polar * cos, b * sin_polar * sin, c * cos_polar));
            }
        }
        for ring in 0..2 * n {
            // `k` steps in each of six sectors of the ring nearer its pole, one more in the other.
            let (inner, outer, k) = if ring < n { (ring, ring + 1, ring) } else { (ring + 1, ring, 2 * n - ring - 1) };
            let on_inner = |idx: u32| firsts[inner as usize] + if k == 0 { 0 } else { idx % (6 * k) };
            let on_outer = |idx: u32| firsts[outer as usize] + idx % (6 * (k + 1));
            for sector in 0..6 {
                let (i, o) = (sector * k, sector * (k + 1));
                for step in 0..=k {
                    let mut strip = vec![[on_outer(o + step), on_outer(o + step + 1), on_inner(i + step)]];
                    if step < k {
                        strip.push([on_outer(o + step + 1), on_inner(i + step + 1), on_inner(i + step)]);
                    }
                    // Below the equator the strip is seen from the other side.
                    solid
                        .triangles
                        .extend(strip.into_iter().map(|[a, b, c]| if ring < n { [a, b, c] } else { [a, c, b] }));
                }
            }
        }
        solid.facing_outwards()
    }

    /// Flat sections (x, y) at heights z.
    pub(super) fn stack(sections: &[(f64, Vec<Point>)]) -> Solid {
        let rings: Vec<Vec<Point3<f64>>> =
            sections.iter().map(|(z, ring)| ring.iter().map(|[x, y]| Point3::new(*x, *y, *z)).collect()).collect();
        Self::loft(&rings)
    }

    /// Sections moved along a path in the plane that is square to `side`, at right angles to it. `section` gives the
    /// ring at a place 0..=1 along the path: first coordinate outwards (side × tangent), second along `side`. Ends are
    /// domes as deep as the two numbers say (flat for 0).
    pub(super) fn sweep(
        path: &[Point3<f64>],
        side: Vector3<f64>,
        domes_mm: [f64; 2],
        section: impl Fn(f64) -> Vec<Point>,
    ) -> Solid {
        let last = path.len() - 1;
        let mut along_mm = vec![0.0];
        for idx in 1..path.len() {
            along_mm.push(along_mm[idx - 1] + (path[idx] - path[idx - 1]).norm());
        }
        let direction = |idx: usize| {
            let before = (idx > 0).then(|| (path[idx] - path[idx - 1]).normalize());
            let after = (idx < last).then(|| (path[idx + 1] - path[idx]).normalize());
            (before.unwrap_or_default() + after.unwrap_or_default()).normalize()
        };
        let ring = |idx: usize, beyond_mm: f64, scale: f64| -> Vec<Point3<f64>> {
            let tangent = direction(idx);
            let outward = side.cross(&tangent);
            let centre = path[idx] + tangent * beyond_mm;
            let section = section(along_mm[idx] / along_mm[last]);
            section.iter().map(|[x, y]| centre + (outward * *x + side * *y) * scale).collect()
        };
        const N_DOME: usize = 4;
        let dome = |idx: usize, depth_mm: f64, sign: f64| {
            (1..=N_DOME).map(move |step| (step as f64 / N_DOME as f64 * std::f64::consts::FRAC_PI_2).sin_cos()).map(
                move |(sin, cos)| {
                    if cos < 1e-9 {
                        vec![path[idx] + direction(idx) * (sign * depth_mm)]
                    } else {
                        ring(idx, sign * depth_mm * sin, cos)
                    }
                },
            )
        };
        let mut rings = Vec::new();
        if domes_mm[0] > 0.0 {
            rings.extend(dome(0, domes_mm[0], -1.0).collect::<Vec<_>>().into_iter().rev());
        }
        rings.extend((0..=last).map(|idx| ring(idx, 0.0, 1.0)));
        if domes_mm[1] > 0.0 {
            rings.extend(dome(last, domes_mm[1], 1.0));
        }
        Self::loft(&rings)
    }

    /// A plate: a closed outline (x, z), counter-clockwise, from y = -half to y = +half the thickness, its edges rounded
    /// with `edge_mm`. Corners of the outline that stick out must be rounder than the edge.
    pub(super) fn plate(outline: &[Point], thickness_mm: f64, edge_mm: f64) -> Solid {
        let n_steps = if edge_mm > 0.0 { crate::outline::n_chords(edge_mm, std::f64::consts::FRAC_PI_2) } else { 0 };
        // Inset and depth of each ring of one side, from the face to the full outline.
        let mut steps: Vec<[f64; 2]> = (0..n_steps)
            .map(|step| {
                let (sin, cos) = (step as f64 / n_steps as f64 * std::f64::consts::FRAC_PI_2).sin_cos();
                [edge_mm * (1.0 - sin), edge_mm * (1.0 - cos)]
            })
            .collect();
        steps.push([0.0, edge_mm]);
        let half_mm = thickness_mm / 2.0;
        let ring = |[inset_mm, depth_mm]: [f64; 2], sign: f64| -> Vec<Point3<f64>> {
            let points = offset(outline, inset_mm, true);
            points.iter().map(|[x, z]| Point3::new(*x, sign * (half_mm - depth_mm), *z)).collect()
        };
        let mut rings: Vec<_> = steps.iter().map(|step| ring(*step, -1.0)).collect();
        rings.extend(steps.iter().rev().filter(|step| step[1] < half_mm - 1e-6).map(|step| ring(*step, 1.0)));
        let mut solid = Solid { points_mm: Vec::new(), triangles: Vec::new() };
        let firsts = solid.skin(&rings);
        let face = triangulate(&offset(outline, steps[0][0], true));
        let last = firsts[firsts.len() - 1];
        solid.triangles.extend(face.iter().map(|[a, b, c]| [*a, *c, *b]));
        solid.triangles.extend(face.iter().map(|triangle| triangle.map(|idx| last + idx)));
        solid.facing_outwards()
    }

    /// A block of that width (x), depth (y) and height (z) on z = 0, with rounded edges along y and flatter ones around
    /// its two faces.
    pub(super) fn block([width, depth, height]: [f64; 3], corner_mm: f64, edge_mm: f64) -> Solid {
        Self::plate(&crate::outline::rounded_rectangle([width, height], corner_mm), depth, edge_mm).moved([
            0.0,
            0.0,
            height / 2.0,
        ])
    }

    /// Moved by that much.
    pub(super) fn moved(self, by_mm: [f64; 3]) -> Solid {
        self.mapped(|point| point + Vector3::from(by_mm))
    }

    /// Turned about an axis through the origin.
    pub(super) fn turned(self, axis: [f64; 3], angle_rad: f64) -> Solid {
        let rotation = Rotation3::from_axis_angle(&Unit::new_normalize(axis.into()), angle_rad);
        self.mapped(|point| rotation * point)
    }

    /// Each point put elsewhere; a mirror image is turned right side out.
    pub(super) fn mapped(mut self, to: impl Fn(Point3<f64>) -> Point3<f64>) -> Solid {
        self.points_mm.iter_mut().for_each(|point| *point = to(*point));
        self.facing_outwards()
    }

    /// Joins rings one to the next and returns where each begins.
    fn skin(&mut self, rings: &[Vec<Point3<f64>>]) -> Vec<u32> {
        let mut firsts = Vec::new();
        for ring in rings {
            firsts.push(self.points_mm.len() as u32);
            self.points_mm.extend_from_slice(ring);
        }
        for (idx, pair) in rings.windows(2).enumerate() {
            let [low, high] = [firsts[idx], firsts[idx + 1]];
            let [n_low, n_high] = [pair[0].len() as u32, pair[1].len() as u32];
            if n_low != n_high {
                self.zip([low, high], [n_low, n_high]);
                continue;
            }
            for a in 0..n_low {
                let b = (a + 1) % n_low;
                // The shorter diagonal, on a tie always the same one.
                let [rising, falling] = [[low + a, high + b], [low + b, high + a]].map(|[from, to]| {
                    let difference: Vector3<f64> = self.points_mm[from as usize] - self.points_mm[to as usize];
                    difference.norm()
                });
                let quad = if rising <= falling + 1e-9 {
                    [[low + a, low + b, high + b], [low + a, high + b, high + a]]
                } else {
                    [[low + a, low + b, high + a], [low + b, high + b, high + a]]
                };
                self.triangles.extend(quad);
            }
        }
        firsts
    }

    /// Joins two rings of different numbers of points, going on at the one that is behind.
    fn zip(&mut self, [low, high]: [u32; 2], [n_low, n_high]: [u32; 2]) {
        let (mut a, mut b) = (0, 0);
        while a < n_low || b < n_high {
            let [at_low, at_high] = [low + a % n_low, high + b % n_high];
            // Halfway between its own next two points; a tip has none.
            let low_goes = n_low > 1 && (n_high == 1 || (2 * a + 1) * n_high <= (2 * b + 1) * n_low);
            if low_goes {
                a += 1;
                self.triangles.push([at_low, low + a % n_low, at_high]);
            } else {
                b += 1;
                self.triangles.push([at_low, high + b % n_high, at_high]);
            }
            if (n_low == 1 && b == n_high) || (n_high == 1 && a == n_low) {
                break;
            }
        }
    }

    fn facing_outwards(mut self) -> Solid {
        let mut six_volumes = 0.0;
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|idx| self.points_mm[idx as usize].coords);
            six_volumes += a.dot(&b.cross(&c));
        }
        if six_volumes < 0.0 {
            for triangle in &mut self.triangles {
                triangle.swap(1, 2);
            }
        }
        self
    }
}

/// Each ring has as many points as its radius asks for, rounded up so that neighbours mostly agree.
fn turned_rings(profile: &[Point], scale: [f64; 2]) -> Vec<Vec<Point3<f64>>> {
    profile
        .iter()
        .map(|&[radius, z]| {
            if radius.abs() < 1e-9 {
                return vec![Point3::new(0.0, 0.0, z)];
            }
            let n = n_around(radius * scale[0].max(scale[1])).div_ceil(8) * 8;
            (0..n)
                .map(|idx| {
                    let (sin, cos) = (std::f64::consts::TAU * idx as f64 / n as f64).sin_cos();
                    Point3::new(radius * cos * scale[0], radius * sin * scale[1], z)
                })
                .collect()
        })
        .collect()
}

/// The inner side of a vessel from the rim, which is round, down to the axis; `outer` is its outer side up to the rim.
fn inner_side(outer: &[Point], wall_mm: f64, floor_mm: f64) -> Vec<Point> {
    let mut inner = offset(outer, wall_mm, false);
    let rim = outer[outer.len() - 1];
    let mut profile = Vec::new();
    let inner_rim = inner[inner.len() - 1];
    let (centre, spoke) = (
        [(rim[0] + inner_rim[0]) / 2.0, (rim[1] + inner_rim[1]) / 2.0],
        [(rim[0] - inner_rim[0]) / 2.0, (rim[1] - inner_rim[1]) / 2.0],
    );
    let n = crate::outline::n_chords(wall_mm / 2.0, std::f64::consts::PI).max(4);
    for idx in 1..n {
        let (sin, cos) = (std::f64::consts::PI * idx as f64 / n as f64).sin_cos();
        profile.push([centre[0] + spoke[0] * cos - spoke[1] * sin, centre[1] + spoke[0] * sin + spoke[1] * cos]);
    }
    inner.reverse();
    let deep_at = inner.iter().position(|point| point[1] < floor_mm + 0.3 || point[0] < 0.5);
    if let Some(deep_at) = deep_at {
        let [x, z] = inner[deep_at];
        inner.truncate(deep_at);
        match inner.last() {
            // The inner side goes on to the floor in the direction it has.
            Some([x_above, z_above]) if z < floor_mm => {
                let along = (z_above - floor_mm) / (z_above - z);
                inner.push([x_above + along * (x - x_above), floor_mm]);
            }
            _ if x >= 0.5 => inner.push([x, z]),
            _ => {}
        }
    }
    let lowest = inner[inner.len() - 1][1];
    let n_near = inner.iter().position(|point| point[1] < rim[1] - REACH_MM).unwrap_or(inner.len() - 1);
    profile.extend_from_slice(&inner[..n_near]);
    profile.extend(crate::outline::simplify_within(&inner[n_near..], (0.08 * wall_mm).max(crate::outline::SAG_MM)));
    profile.push([0.0, lowest.min(floor_mm)]);
    profile
}

fn cross(a: Point, b: Point, c: Point) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Twice the area over the longest side squared; none for a corner that is no ear.
fn ear_quality(polygon: &[Point], left: &[usize], at: usize) -> Option<f64> {
    let n = left.len();
    let ids = [left[(at + n - 1) % n], left[at], left[(at + 1) % n]];
    let [a, b, c] = ids.map(|idx| polygon[idx]);
    let area = cross(a, b, c);
    if area <= 1e-9 {
        return None;
    }
    for idx in left.iter().filter(|idx| !ids.contains(idx)) {
        let p = polygon[*idx];
        if cross(a, b, p) >= 0.0 && cross(b, c, p) >= 0.0 && cross(c, a, p) >= 0.0 {
            return None;
        }
    }
    let longest = [(a, b), (b, c), (c, a)].map(|(p, q)| crate::outline::distance(p, q)).into_iter().fold(0.0, f64::max);
    Some(area / (longest * longest))
}

/// Triangles over a polygon, counter-clockwise like it: clips ears, always the one with the widest smallest angle.
fn triangulate(polygon: &[Point]) -> Vec<[u32; 3]> {
    let mut left: Vec<usize> = (0..polygon.len()).collect();
    let mut triangles = Vec::new();
    let mut qualities: Vec<Option<f64>> = (0..left.len()).map(|at| ear_quality(polygon, &left, at)).collect();
    while left.len() > 3 {
        let best = (0..left.len())
            .filter_map(|at| qualities[at].map(|quality| (at, quality)))
            .max_by(|(_, a), (_, b)| a.total_cmp(b));
        let Some((at, _)) = best else { break };
        let n = left.len();
        triangles.push([left[(at + n - 1) % n], left[at], left[(at + 1) % n]].map(|idx| idx as u32));
        left.remove(at);
        qualities.remove(at);
        let n = left.len();
        for neighbour in [(at + n - 1) % n, at % n] {
            qualities[neighbour] = ear_quality(polygon, &left, neighbour);
        }
    }
    if left.len() == 3 {
        triangles.push([left[0], left[1], left[2]].map(|idx| idx as u32));
    }
    triangles
}
