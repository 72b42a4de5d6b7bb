//! The largest ball around the origin within a convex polytope that is known only by its support points: the furthest
//! point in a given direction. The Minkowski sum of a grasp's contacts has far too many corners to list, but a furthest
//! one is a sum of furthest ones.
//!
//! After Zheng, "An efficient algorithm for a grasp quality measure" (2013): a polytope inside grows only where it
//! matters. The support point beyond its nearest facet is added until there is none; then that facet is the outer
//! polytope's too.

use crate::hull::{
    Broken, DIM, FLAT_TOLERANCE, HullError, MAX_UNCERTAINTY, Surface, TOLERANCES, attempts, dot, initial_simplex,
    largest_coordinate, with_surface,
};

/// Support points after which a body is given up: more than any polytope of contacts has asked for by far.
const MAX_POINTS: usize = 5000;

/// A volume exceeds another for certain when it does so by this share: what joggles may change it by.
const VOLUME_MARGIN: f64 = 1e-3;

/// The largest ball within a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InnerBall {
    /// Its radius; negative when the origin is outside, and then it says no more than that.
    pub radius: f64,
    /// The true radius is between `radius` and this much more, by a support point in the facet's direction.
    pub gap: f64,
    /// Outward unit normal of the facet that the ball touches.
    pub normal: [f64; DIM],
    /// Number of support points that were needed, those at the start included.
    pub n_points: usize,
}

/// The largest ball around the origin within the polytope whose support point in a direction `support` gives; ends when no
/// support point is beyond the nearest facet by more than the hull's tolerance (2.3e-12 times the largest coordinate, unless
/// a coarser one was needed).
///
/// `corners` are some points of the polytope that span what it spans.
///
/// # Errors
/// As [`crate::hull::convex_hull`]; a flat polytope is [`HullError::NotFullDimensional`].
pub fn inner_ball(corners: &[[f64; DIM]], support: impl Fn(&[f64; DIM]) -> [f64; DIM]) -> Result<InnerBall, HullError> {
    // With the extremes along the axes, the largest coordinate is known from the start.
    let unit = |axis: usize, sign: f64| std::array::from_fn(|i| if i == axis { sign } else { 0.0 });
    let mut points: Vec<[f64; DIM]> =
        (0..2 * DIM).map(|k| support(&unit(k / 2, if k % 2 == 0 { 1.0 } else { -1.0 }))).collect();
    let n_extremes = points.len();
    points.extend_from_slice(corners);
    let scale = largest_coordinate(&points)?;
    let simplex = initial_simplex(&points, FLAT_TOLERANCE * scale)?;
    // The other corners are inside, or will be found when they matter.
    let spanning: Vec<[f64; DIM]> = simplex.iter().map(|idx| points[*idx as usize]).collect();
    points.truncate(n_extremes);
    points.splice(0..0, spanning);
    let simplex = std::array::from_fn(|idx| idx as u32);

    let mut reason = "";
    let mut n_attempts = 0;
    let mut surface = Surface::default();
    for (relative_tolerance, blends) in attempts(&TOLERANCES) {
        match grow(&mut surface, &points, &simplex, relative_tolerance * scale, blends, &support) {
            Ok(ball) => return Ok(ball),
            Err(Broken(why)) => reason = why,
        }
        n_attempts += 1;
        if surface.points().len() > points.len() {
            // What was found is not lost.
            points = surface.points().to_vec();
        }
    }
    Err(HullError::Topology { n_points: points.len(), reason, n_attempts, largest_joggle: 0.0 })
}

/// Whether the hull of points holds the ball of radius `radius` around the origin and has more than `volume`. `None` when it
/// could not be told, be it that the surface broke or that radius or volume are too near to the hull's own to be certain.
///
/// An inner polytope that is large enough proves the one, a plane with the points on one side the other. Either takes a
/// few tens of points, where the hull takes all.
pub fn exceeds(points: &[[f64; DIM]], radius: f64, volume: f64) -> Option<bool> {
    let scale = largest_coordinate(points).ok()?;
    let simplex = initial_simplex(points, FLAT_TOLERANCE * scale).ok()?;
    let margin = MAX_UNCERTAINTY * scale;
    let corners = simplex.map(|idx| points[idx as usize]);
    let simplex = std::array::from_fn(|idx| idx as u32);
    let tolerance = TOLERANCES[0] * scale;
    with_surface(|surface| {
        surface.enclose(&corners, &simplex, tolerance, true).ok()?;
        loop {
            let (plane, normal, offset) = surface.nearest_facet();
            if offset > radius + margin {
                break;
            }
            let (most, furthest) = furthest(points, &normal);
            if most <= radius - margin {
                return Some(false);
            }
            if most - offset <= tolerance {
                return None;
            }
            surface.extend(furthest, plane).ok()?;
        }
        let enough = volume * (1.0 + VOLUME_MARGIN);
        let mut last_measured = surface.checked_volume().ok()?;
        let mut next_at = surface.n_insertions() * 5 / 4;
        if last_measured <= enough {
            surface
                .complete(points, |surface| {
                    if surface.n_insertions() >= next_at {
                        next_at = surface.n_insertions() * 5 / 4;
                        last_measured = surface.checked_volume()?;
                    }
                    Ok(last_measured > enough)
                })
                .ok()?;
        }
        (last_measured > enough).then_some(true)
    })
}

/// The greatest n·x over points x, and that x.
fn furthest(points: &[[f64; DIM]], normal: &[f64; DIM]) -> (f64, [f64; DIM]) {
    let mut furthest = (f64::NEG_INFINITY, [0.0; DIM]);
    for point in points {
        let along = dot(point, normal);
        if along > furthest.0 {
            furthest = (along, *point);
        }
    }
    furthest
}

fn grow(
    surface: &mut Surface,
    points: &[[f64; DIM]],
    simplex: &[u32; DIM + 1],
    tolerance: f64,
    blends: bool,
    support: &impl Fn(&[f64; DIM]) -> [f64; DIM],
) -> Result<InnerBall, Broken> {
    surface.enclose(points, simplex, tolerance, blends)?;
    loop {
        let (plane, normal, radius) = surface.nearest_facet();
        let furthest = support(&normal);
        let beyond = dot(&furthest, &normal) - radius;
        // Not a number is never beyond.
        if beyond.is_nan() || beyond <= tolerance {
            surface.check()?;
            return Ok(InnerBall { radius, gap: beyond.max(0.0), normal, n_points: surface.points().len() });
        }
        if surface.points().len() == MAX_POINTS {
            return Err(Broken("too many support points"));
        }
        surface.extend(furthest, plane)?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hull::{SplitMix64, convex_hull};

    fn furthest(points: &[[f64; DIM]], direction: &[f64; DIM]) -> [f64; DIM] {
        let along = |point: &&[f64; DIM]| dot(point, direction);
        *points.iter().max_by(|a, b| along(a).total_cmp(&along(b))).expect("points")
    }

    fn random_points(random: &mut SplitMix64, n: usize, centre: f64) -> Vec<[f64; DIM]> {
        (0..n).map(|_| std::array::from_fn(|_| centre + random.symmetric())).collect()
    }

    #[test]
    fn of_points_it_is_the_hulls() {
        let mut random = SplitMix64(4);
        for n in [20, 60, 200] {
            let points = random_points(&mut random, n, 0.0);
            let expected = convex_hull(&points).expect("a hull").least_offset();
            let ball = inner_ball(&points, |direction| furthest(&points, direction)).expect("a ball");
            assert!(
                (ball.radius - expected).abs() < 1e-9 || (ball.radius < 0.0 && expected < 0.0),
                "{ball:?} {expected}"
            );
            assert!(ball.n_points <= n + 19, "{ball:?}");
        }
    }

    #[test]
    fn of_a_sum_it_is_the_hulls_of_all_sums() {
        let mut random = SplitMix64(8);
        for _ in 0..5 {
            let (a, b) = (random_points(&mut random, 12, 0.1), random_points(&mut random, 12, 0.0));
            let sums: Vec<[f64; DIM]> =
                a.iter().flat_map(|a| b.iter().map(|b| std::array::from_fn(|i| a[i] + b[i]))).collect();
            let expected = convex_hull(&sums).expect("a hull").least_offset();
            let support = |direction: &[f64; DIM]| {
                let (a, b) = (furthest(&a, direction), furthest(&b, direction));
                std::array::from_fn(|i| a[i] + b[i])
            };
            let ball = inner_ball(&sums, support).expect("a ball");
            assert!(expected > 0.0 && (ball.radius - expected).abs() < 1e-9, "{ball:?} {expected}");
        }
    }

    #[test]
    fn a_cube_of_segments_has_a_ball_of_its_half_width() {
        // Six segments: 64 corners, of which the ball asks for a few.
        let half_widths = [0.5, 0.7, 0.3, 0.9, 0.4, 2.0];
        let support = |direction: &[f64; DIM]| std::array::from_fn(|i| half_widths[i] * 1_f64.copysign(direction[i]));
        let corners: Vec<[f64; DIM]> =
            (0..7).map(|k| std::array::from_fn(|i| if i < k { half_widths[i] } else { -half_widths[i] })).collect();
        let ball = inner_ball(&corners, support).expect("a ball");
        assert!((ball.radius - 0.3).abs() < 1e-12, "{ball:?}");
        assert!((ball.normal[2].abs() - 1.0).abs() < 1e-12, "{ball:?}");
    }

    #[test]
    fn exceeding_is_proved_either_way() {
        let cube: Vec<[f64; DIM]> =
            (0..64).map(|bits| std::array::from_fn(|axis| if bits >> axis & 1 == 1 { 1.0 } else { -1.0 })).collect();
        assert_eq!(exceeds(&cube, 0.99, 63.0), Some(true));
        assert_eq!(exceeds(&cube, 1.01, 1.0), Some(false));
        // Too near to tell, and a volume that is not there.
        assert_eq!(exceeds(&cube, 1.0, 1.0), None);
        assert_eq!(exceeds(&cube, 0.5, 65.0), None);
        assert_eq!(exceeds(&cube[..20], 0.1, 0.1), None);
        let moved: Vec<_> = cube.iter().map(|point| point.map(|x| x + 1.2)).collect();
        assert_eq!(exceeds(&moved, 0.0, 0.0), Some(false));
        assert_eq!(exceeds(&[[f64::NAN; DIM]; 9], 0.1, 0.1), None);
    }

    #[test]
    fn exceeding_agrees_with_the_hull() {
        let mut random = SplitMix64(6);
        let mut n_told = [0, 0];
        for idx in 0..300 {
            let points = random_points(&mut random, 30 + idx % 70, 0.0);
            let hull = convex_hull(&points).expect("a hull");
            let (radius, volume) = (0.35, 4.0);
            if let Some(found) = exceeds(&points, radius, volume) {
                assert_eq!(found, hull.least_offset() > radius && hull.volume > volume, "{idx}");
                n_told[usize::from(found)] += 1;
            }
        }
        assert!(n_told.iter().all(|n| *n > 10), "{n_told:?}");
    }

    #[test]
    fn a_flat_body_has_no_ball() {
        let corners: Vec<[f64; DIM]> = (0..20).map(|k| [1.0, f64::from(k), 0.0, f64::from(k * k), 0.0, 0.0]).collect();
        let found = inner_ball(&corners, |direction| furthest(&corners, direction));
        assert!(matches!(found, Err(HullError::NotFullDimensional { rank: 2, .. })), "{found:?}");
    }
}
