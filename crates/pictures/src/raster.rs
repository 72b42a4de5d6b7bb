//! Triangles to samples: a camera with mild perspective and a z-buffer, several samples a pixel.

use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::geometry::corner_normals;
use blindgrasp_mesh::Mesh;

/// Samples along each side of a pixel. 3: edges look smooth.
pub(super) const SAMPLES_PER_SIDE: usize = 3;

/// Two faces that meet at more than this angle have an edge between them; below, they look round.
const CREASE_RAD: f64 = 0.6;

/// Looks at a point from a distance.
#[derive(Debug, Clone)]
pub(super) struct Camera {
    /// The view's frame: origin at the target, x to the right, y up, z to the eye.
    view_from_palm: Isometry3<f64>,
    /// From the eye to the target.
    distance_m: f64,
    /// At the target's depth.
    pixels_per_m: f64,
    width: f64,
    height: f64,
}

/// A point in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Projected {
    /// From the left edge, pixels.
    pub(super) x: f64,
    /// From the upper edge, pixels.
    pub(super) y: f64,
    /// One over the distance to the eye's plane, 1/m: larger is nearer, and it is linear in the picture.
    pub(super) nearness: f64,
}

impl Camera {
    /// Looks at `target` from the direction `to_eye`, with `up` upwards in the picture.
    pub(super) fn new(target: Point3<f64>, to_eye: Vector3<f64>, up: Vector3<f64>, size: [f64; 2]) -> Self {
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::face_towards(&to_eye, &up)).inverse();
        let view_from_palm = Isometry3::from_parts(Translation3::identity(), rotation)
            * Isometry3::from_parts((-target.coords).into(), UnitQuaternion::identity());
        Camera { view_from_palm, distance_m: 1.0, pixels_per_m: 1000.0, width: size[0], height: size[1] }
    }

    /// Moved and scaled so that all `points` lie within the picture, `margin` pixels from its edges.
    pub(super) fn fit(mut self, points: &[Point3<f64>], margin: f64) -> Self {
        if points.is_empty() {
            return self;
        }
        let in_view: Vec<_> = points.iter().map(|point| self.view_from_palm * point).collect();
        let least = in_view.iter().copied().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let most = in_view.iter().copied().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        let middle = nalgebra::center(&least, &most);
        self.view_from_palm.translation.vector -= middle.coords;
        // A tele lens: from six times the scene's size, near and far things differ by less than a fifth.
        self.distance_m = 6.0 * (most - least).norm().max(1e-6) / 2.0;
        // Perspective shifts what is seen against the middle a little, so fit twice.
        for _ in 0..2 {
            let seen: Vec<_> = points.iter().map(|point| self.project(point)).collect();
            let range = |of: fn(&Projected) -> f64| {
                seen.iter().map(of).fold([f64::MAX, f64::MIN], |[a, b], value| [a.min(value), b.max(value)])
            };
            let ([left, right], [top, bottom]) = (range(|point| point.x), range(|point| point.y));
            let shift = Vector3::new((left + right - self.width) / 2.0, (self.height - top - bottom) / 2.0, 0.0);
            self.view_from_palm.translation.vector -= shift / self.pixels_per_m;
            self.pixels_per_m *= ((self.width - 2.0 * margin) / (right - left).max(1e-9))
                .min((self.height - 2.0 * margin) / (bottom - top).max(1e-9));
        }
        self
    }

    /// The same view in a picture `factor` times as large.
    pub(super) fn scaled(&self, factor: f64) -> Self {
        Camera {
            pixels_per_m: self.pixels_per_m * factor,
            width: self.width * factor,
            height: self.height * factor,
            ..self.clone()
        }
    }

    /// Pixels a metre at the target's depth.
    pub(super) fn pixels_per_m(&self) -> f64 {
        self.pixels_per_m
    }

    /// From which side it looks: the angle about the palm frame's z axis, from its x axis.
    pub(super) fn azimuth_rad(&self) -> f64 {
        let to_eye = self.view_from_palm.rotation.inverse() * Vector3::z();
        to_eye.y.atan2(to_eye.x)
    }

    /// A direction in the view's frame: x to the right, y up, z to the eye.
    pub(super) fn direction(&self, in_palm: &Vector3<f64>) -> Vector3<f64> {
        self.view_from_palm * in_palm
    }

    /// Where a point is seen.
    pub(super) fn project(&self, point_in_palm: &Point3<f64>) -> Projected {
        let point = self.view_from_palm * point_in_palm;
        let nearness = 1.0 / (self.distance_m - point.z).max(1e-3 * self.distance_m);
        let scale = self.pixels_per_m * self.distance_m * nearness;
        Projected { x: self.width / 2.0 + scale * point.x, y: self.height / 2.0 - scale * point.y, nearness }
    }
}

/// What each sample of a picture shows: the nearest surface, and how it is lit.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Samples {
    pub(super) width: usize,
    pub(super) height: usize,
    /// 0 where there is nothing.
    pub(super) nearness: Vec<f32>,
    /// The number of the surface; 0 where there is nothing.
    pub(super) surface: Vec<u16>,
    /// How much light falls on it.
    pub(super) light: Vec<f32>,
}

impl Samples {
    /// Shows nothing yet.
    pub(super) fn new(width: usize, height: usize) -> Self {
        let n = width * height;
        Samples { width, height, nearness: vec![0.0; n], surface: vec![0; n], light: vec![0.0; n] }
    }

    /// Draws a mesh as `surface`, seen by a camera for a picture of this size.
    pub(super) fn draw_mesh(&mut self, camera: &Camera, mesh: &Mesh, surface: u16) {
        let seen: Vec<Projected> = mesh.vertices_m.iter().map(|vertex| camera.project(vertex)).collect();
        for (triangle, normals) in mesh.triangles.iter().zip(corner_normals(mesh, CREASE_RAD)) {
            let lights = normals.map(|normal| light(camera.direction(&normal)));
            self.draw_triangle(triangle.map(|idx| seen[idx as usize]), lights, surface);
        }
    }

    /// Draws a triangle; of two at the same depth, the first one drawn stays.
    pub(super) fn draw_triangle(&mut self, [a, b, c]: [Projected; 3], lights: [f64; 3], surface: u16) {
        let area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        if area == 0.0 || !area.is_finite() {
            return;
        }
        let range = |[p, q, r]: [f64; 3], n: usize| {
            // Sample i has its centre at i + 0.5.
            let first = (p.min(q).min(r) - 0.5).ceil().max(0.0) as usize;
            let end = ((p.max(q).max(r) - 0.5).floor() + 1.0).clamp(0.0, n as f64) as usize;
            first..end
        };
        for y in range([a.y, b.y, c.y], self.height) {
            for x in range([a.x, b.x, c.x], self.width) {
                let (px, py) = (x as f64 + 0.5, y as f64 + 0.5);
                let share = |p: Projected, q: Projected| ((q.x - p.x) * (py - p.y) - (px - p.x) * (q.y - p.y)) / area;
                let (of_a, of_b, of_c) = (share(b, c), share(c, a), share(a, b));
                if of_a < 0.0 || of_b < 0.0 || of_c < 0.0 {
                    continue;
                }
                let nearness = (of_a * a.nearness + of_b * b.nearness + of_c * c.nearness) as f32;
                let idx = y * self.width + x;
                if nearness > self.nearness[idx] {
                    self.nearness[idx] = nearness;
                    self.surface[idx] = surface;
                    self.light[idx] = (of_a * lights[0] + of_b * lights[1] + of_c * lights[2]) as f32;
                }
            }
        }
    }

    /// Whether a surface ends here: a neighbour `reach` samples away shows another one, or jumps in depth.
    pub(super) fn is_edge(&self, x: usize, y: usize, reach: usize) -> bool {
        let here = y * self.width + x;
        if self.surface[here] == 0 {
            return false;
        }
        let neighbours = [(x.wrapping_sub(reach), y), (x + reach, y), (x, y.wrapping_sub(reach)), (x, y + reach)];
        neighbours.into_iter().any(|(x, y)| {
            if x >= self.width || y >= self.height {
                return false;
            }
            let there = y * self.width + x;
            // The line belongs to the nearer surface; 1 % of the distance is about 1 cm.
            self.nearness[there] < 0.99 * self.nearness[here]
                || (self.surface[there] != self.surface[here] && self.nearness[there] <= self.nearness[here])
        })
    }
}

/// The light on a surface of this normal in the view's frame: a lamp at the upper left, the sky, and one at the eye.
/// Surfaces are seen from both sides.
fn light(normal: Vector3<f64>) -> f64 {
    let normal = if normal.z < 0.0 { -normal } else { normal };
    let lamp = Vector3::new(-0.45, 0.70, 0.55).normalize();
    let half = (lamp + Vector3::z()).normalize();
    let highlight = normal.dot(&half).max(0.0).powi(40);
    0.46 + 0.40 * normal.dot(&lamp).max(0.0) + 0.14 * (0.5 + 0.5 * normal.y) + 0.16 * normal.z + 0.10 * highlight
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64, nearness: f64) -> Projected {
        Projected { x, y, nearness }
    }

    #[test]
    fn a_triangle_covers_the_samples_whose_centres_it_holds() {
        let mut samples = Samples::new(4, 4);
        // Centres with x + y <= 3 from the upper left corner.
        samples.draw_triangle([at(0.0, 0.0, 1.0), at(3.0, 0.0, 1.0), at(0.0, 3.0, 1.0)], [1.0; 3], 7);
        #[rustfmt::skip]
        assert_eq!(samples.surface, [
            7, 7, 7, 0,
            7, 7, 0, 0,
            7, 0, 0, 0,
            0, 0, 0, 0,
        ]);
        let mut turned = Samples::new(4, 4);
        turned.draw_triangle([at(0.0, 3.0, 1.0), at(3.0, 0.0, 1.0), at(0.0, 0.0, 1.0)], [1.0; 3], 7);
        assert_eq!(samples, turned, "seen from behind it covers the same");
    }

    #[test]
    fn the_nearer_triangle_wins_in_either_order() {
        let near = [at(0.0, 0.0, 2.0), at(8.0, 0.0, 2.0), at(0.0, 8.0, 2.0)];
        let far = [at(0.0, 0.0, 1.0), at(8.0, 0.0, 1.0), at(0.0, 8.0, 1.0)];
        for order in [[(near, 1), (far, 2)], [(far, 2), (near, 1)]] {
            let mut samples = Samples::new(3, 3);
            order.into_iter().for_each(|(triangle, surface)| samples.draw_triangle(triangle, [1.0; 3], surface));
            assert_eq!(samples.surface, [1; 9]);
        }
        // Two that cut through each other, at the middle column.
        let mut samples = Samples::new(3, 1);
        samples.draw_triangle([at(0.0, -9.0, 1.0), at(0.0, 9.0, 1.0), at(30.0, 0.0, 31.0)], [1.0; 3], 1);
        samples.draw_triangle([at(-9.0, -9.0, 2.4), at(-9.0, 9.0, 2.4), at(30.0, 0.0, 2.4)], [1.0; 3], 2);
        assert_eq!(samples.surface, [2, 1, 1]);
    }

    #[test]
    fn outside_and_degenerate_triangles_draw_nothing() {
        let mut samples = Samples::new(4, 4);
        samples.draw_triangle([at(-9.0, 0.0, 1.0), at(-1.0, 0.0, 1.0), at(-1.0, 9.0, 1.0)], [1.0; 3], 1);
        samples.draw_triangle([at(0.0, 0.0, 1.0), at(1.0, 1.0, 1.0), at(4.0, 4.0, 1.0)], [1.0; 3], 1);
        samples.draw_triangle([at(0.0, f64::NAN, 1.0), at(4.0, 1.0, 1.0), at(0.0, 4.0, 1.0)], [1.0; 3], 1);
        assert_eq!(samples, Samples::new(4, 4));
    }

    #[test]
    fn a_camera_shows_right_to_the_right_up_upwards_and_fits() {
        let size = [200.0, 100.0];
        let camera = Camera::new(Point3::origin(), Vector3::new(0.0, -1.0, 0.0), Vector3::z(), size);
        let seen = |x: f64, y: f64, z: f64| camera.project(&Point3::new(x, y, z));
        assert_eq!((seen(0.0, 0.0, 0.0).x, seen(0.0, 0.0, 0.0).y), (100.0, 50.0));
        assert!(seen(0.01, 0.0, 0.0).x > 100.0 && seen(0.0, 0.0, 0.01).y < 50.0);
        assert!(seen(0.0, -0.1, 0.0).nearness > seen(0.0, 0.1, 0.0).nearness);
        let corners: Vec<Point3<f64>> = (0..8)
            .map(|idx| Point3::new(f64::from(idx & 1), f64::from(idx >> 1 & 1), f64::from(idx >> 2)) * 0.1)
            .collect();
        let fitted = camera.fit(&corners, 10.0);
        let tops: Vec<f64> = corners.iter().map(|corner| fitted.project(corner).y).collect();
        let (top, bottom) = (tops.iter().copied().fold(f64::MAX, f64::min), tops.iter().copied().fold(0.0, f64::max));
        assert!((top - 10.0).abs() < 0.5 && (bottom - 90.0).abs() < 0.5, "{top} {bottom}");
    }
}
