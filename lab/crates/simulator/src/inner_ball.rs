//! Whether the hull of points exceeds thresholds, without the hull.
//!
//! After Zheng, "An efficient algorithm for a grasp quality measure" (2013): a polytope inside the hull grows only where it
//! matters. The point furthest beyond its nearest facet is added until the polytope itself exceeds the thresholds, or
//! until no point is far enough beyond that facet.

use super::hull::{
    DIM, FLAT_TOLERANCE, MAX_UNCERTAINTY, TOLERANCES, dot, initial_simplex, largest_coordinate, with_surface,
};

/// A volume exceeds another for certain if it does so by this share, by which joggles may change a volume.
const VOLUME_MARGIN: f64 = 1e-3;

/// Whether the hull of points holds the ball of radius `radius` around the origin and has more than `volume`. `None` if the
/// surface broke, or if radius or volume are too near to the hull's own to be certain.
///
/// An inner polytope that is large enough proves that the hull exceeds them; a plane with all points on one side proves
/// that it does not. Either takes a few tens of points, where the hull takes all.
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

/// The greatest n·x over the points x, and that x.
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

#[cfg(test)]
mod tests {
    use super::*;

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
}
