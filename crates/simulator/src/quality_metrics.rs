//! Further qualities of a grasp that other tools report, beside epsilon and volume of the L1 grasp wrench space: none of
//! them enters the ground truth of stability. Definitions, units and sources in one place for users: `docs/quality.md`.

use nalgebra::{Dyn, OMatrix, U6, Vector6};
use serde::Serialize;

use crate::hull::{DIM, Facet, dot};
use crate::inner_ball::inner_ball;
use crate::wrench_space::{GraspCase, Quality, QualityError, check, cross, n_edges, quality_of, wrenches};

/// Standard gravity (CGPM 1901), m/s².
pub const STANDARD_GRAVITY: f64 = 9.806_65;

/// A weight to hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Load {
    /// The object's mass.
    pub mass_kg: f64,
    /// Where down is, in the frame of the grasp, of any length; `None` asks for the worst direction alone.
    pub gravity_direction: Option<[f64; 3]>,
}

/// All qualities of a grasp.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Epsilon and volume of the L1 grasp wrench space.
    #[serde(flatten)]
    pub quality: Quality,
    /// Epsilon of the L∞ grasp wrench space, in which each contact's normal force is bounded by 1 on its own (Ferrari &
    /// Canny 1992): the radius of the largest ball around the origin within the Minkowski sum over the contacts of the
    /// hull of their edge wrenches and the origin. -1 without force closure; never less than the L1 epsilon.
    pub linf_epsilon: f64,
    /// Product of the six singular values of the grasp matrix (Li & Sastry 1988): the volume of the ellipsoid of wrenches
    /// that contact forces of unit length together give, but for a constant. See [`grasp_matrix`].
    pub ellipsoid_volume: f64,
    /// The least of the six singular values of the grasp matrix (Li & Sastry 1988): 0 when the contacts, were they glued,
    /// could not resist some wrench.
    pub smallest_singular_value: f64,
    /// The least sum of all contacts' normal forces that holds the weight, whichever way is down. `None` without a load
    /// or without force closure.
    pub gravity_force_newtons: Option<f64>,
    /// The same for the load's own direction. `None` without one or without force closure.
    pub gravity_force_along_newtons: Option<f64>,
}

/// Singular values below this share of the largest are rounding, and count as 0.
const RANK_TOLERANCE: f64 = 1e-12;

/// All qualities of a grasp. The L∞ epsilon is exact within 1e-9 times the number of contacts (usually 1e-11).
///
/// # Errors
/// As [`crate::wrench_space::quality`]; a mass that is not above 0, a direction without length; a failed hull.
pub fn all_metrics(case: &GraspCase, load: Option<&Load>) -> Result<Metrics, QualityError> {
    check(case)?;
    load.map_or(Ok(()), check_load)?;
    let wrenches = wrenches(case);
    let (quality, hull) = quality_of(&wrenches, case.contacts.len())?;
    let singular_values = singular_values(case);
    let mut metrics = Metrics {
        linf_epsilon: -1.0,
        ellipsoid_volume: singular_values.product(),
        smallest_singular_value: singular_values.min(),
        gravity_force_newtons: None,
        gravity_force_along_newtons: None,
        quality,
    };
    // The origin is inside the one space just when it is inside the other: both hold a small ball of what the edges span.
    if let Some(hull) = hull.filter(|_| metrics.quality.force_closure) {
        metrics.linf_epsilon = linf_epsilon(case, &wrenches)?;
        if let Some(Load { mass_kg, gravity_direction }) = load {
            let weight_newtons = mass_kg * STANDARD_GRAVITY;
            metrics.gravity_force_newtons = Some(weight_newtons / least_force(&hull.facets));
            metrics.gravity_force_along_newtons =
                gravity_direction.map(|down| weight_newtons / force_along(&hull.facets, &down.map(|x| -x)));
        }
    }
    Ok(metrics)
}

/// The grasp matrix: from the contacts' components to the wrench on the object about its centre of mass, torques divided by
/// the largest radius. 6 × (3 per point contact, 4 per soft finger), contact by contact: force along the normal, the
/// tangent t1 and t2 = n × t1; and for a soft finger the torque about the normal, in units of force times the largest
/// radius. Friction and the torsional radius don't enter.
pub fn grasp_matrix(case: &GraspCase) -> OMatrix<f64, U6, Dyn> {
    let mut columns = Vec::new();
    for contact in &case.contacts {
        let arm = std::array::from_fn(|i| contact.point_m[i] - case.centre_of_mass_m[i]);
        let normal = contact.inward_normal;
        for axis in [normal, contact.tangent, cross(normal, contact.tangent)] {
            let torque = cross(arm, axis).map(|x| x / case.max_radius_m);
            columns.push(Vector6::new(axis[0], axis[1], axis[2], torque[0], torque[1], torque[2]));
        }
        if contact.torsion_m > 0.0 {
            columns.push(Vector6::new(0.0, 0.0, 0.0, normal[0], normal[1], normal[2]));
        }
    }
    OMatrix::<f64, U6, Dyn>::from_columns(&columns)
}

/// Six of them: those of fewer than six columns are 0.
fn singular_values(case: &GraspCase) -> Vector6<f64> {
    let mut values = Vector6::zeros();
    if !case.contacts.is_empty() {
        let found = grasp_matrix(case).singular_values();
        let least = RANK_TOLERANCE * found.max();
        for (value, found) in values.iter_mut().zip(found.iter()) {
            *value = if *found > least { *found } else { 0.0 };
        }
    }
    values
}

fn linf_epsilon(case: &GraspCase, wrenches: &[[f64; DIM]]) -> Result<f64, QualityError> {
    let mut rest = wrenches;
    let mut contacts = Vec::new();
    for contact in &case.contacts {
        let (edges, others) = rest.split_at(n_edges(contact));
        contacts.push(edges);
        rest = others;
    }
    let support = |direction: &[f64; DIM]| {
        let mut sum = [0.0; DIM];
        for edges in &contacts {
            let mut furthest = (0.0, &[0.0; DIM]);
            for edge in *edges {
                let along = dot(edge, direction);
                if along > furthest.0 {
                    furthest = (along, edge);
                }
            }
            for (total, x) in sum.iter_mut().zip(furthest.1) {
                *total += x;
            }
        }
        sum
    };
    let ball =
        inner_ball(wrenches, support).map_err(|source| QualityError::Hull { n_wrenches: wrenches.len(), source })?;
    Ok(ball.radius)
}

/// The largest force that a unit of normal force resists in every direction, without torque: the radius of the largest
/// ball in the slice {x : n_f·x ≤ offset for all facets} of pure forces x.
fn least_force(facets: &[Facet]) -> f64 {
    let radius = |facet: &Facet| {
        let [x, y, z, ..] = facet.normal;
        facet.offset / (x * x + y * y + z * z).sqrt()
    };
    // A facet parallel to all forces bounds none: its radius is infinite.
    facets.iter().map(radius).fold(f64::INFINITY, f64::min)
}

/// The largest force along a direction (of any length) that a unit of normal force gives, without torque.
fn force_along(facets: &[Facet], direction: &[f64; 3]) -> f64 {
    let [x, y, z] = *direction;
    let length = (x * x + y * y + z * z).sqrt();
    let reach = |facet: &Facet| {
        let along = (facet.normal[0] * x + facet.normal[1] * y + facet.normal[2] * z) / length;
        if along > 0.0 { facet.offset / along } else { f64::INFINITY }
    };
    facets.iter().map(reach).fold(f64::INFINITY, f64::min)
}

fn check_load(load: &Load) -> Result<(), QualityError> {
    let error = |field, expected, found: &[f64]| Err(QualityError::Object { field, expected, found: found.to_vec() });
    if !(load.mass_kg > 0.0 && load.mass_kg.is_finite()) {
        return error("mass_kg", "a finite number above 0", &[load.mass_kg]);
    }
    match &load.gravity_direction {
        Some(down) if !(down.iter().all(|x| x.is_finite()) && down.iter().any(|x| x.abs() > 1e-100)) => {
            error("gravity_direction", "a finite vector that is not zero", down)
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hull::{SplitMix64, convex_hull};
    use crate::wrench_space::{GraspContact, quality};

    fn contact(point_m: [f64; 3], inward_normal: [f64; 3], tangent: [f64; 3], torsion_m: f64) -> GraspContact {
        GraspContact { point_m, inward_normal, tangent, friction: 0.7, torsion_m }
    }

    fn grasp(max_radius_m: f64, contacts: Vec<GraspContact>) -> GraspCase {
        GraspCase { centre_of_mass_m: [0.0; 3], max_radius_m, contacts }
    }

    /// Contacts on a ball of radius 1 m on both sides along each of the first `n_axes` axes.
    fn opposed(n_axes: usize, torsion_m: f64) -> GraspCase {
        let unit = |axis: usize, sign: f64| std::array::from_fn(|i| if i == axis % 3 { sign } else { 0.0 });
        let contacts = (0..n_axes).flat_map(|axis| {
            [1.0, -1.0].map(|sign| contact(unit(axis, -sign), unit(axis, sign), unit(axis + 1, 1.0), torsion_m))
        });
        grasp(1.0, contacts.collect())
    }

    /// Around a ball of radius 40 mm: random places, normals to the centre but for friction's sake.
    fn around(random: &mut SplitMix64, n: usize, friction: f64) -> GraspCase {
        let normalised = |v: [f64; 3]| v.map(|x| x / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt());
        let contacts = (0..n).map(|_| {
            let inward_normal = normalised(std::array::from_fn(|_| random.symmetric()));
            let other = std::array::from_fn(|_| random.symmetric());
            let tangent = normalised(cross(inward_normal, other));
            let torsion_m = if random.next().is_multiple_of(3) { 0.0 } else { 0.004 };
            GraspContact { friction, ..contact(inward_normal.map(|x| -0.04 * x), inward_normal, tangent, torsion_m) }
        });
        grasp(0.04, contacts.collect())
    }

    fn metrics(case: &GraspCase) -> Metrics {
        all_metrics(case, None).expect("metrics")
    }

    #[track_caller]
    fn assert_near(found: f64, expected: f64) {
        assert!((found - expected).abs() <= 1e-9 * expected.abs(), "{found} instead of {expected}");
    }

    #[test]
    fn singular_values_by_hand() {
        // Six points on the axes: forces along all axes from all of them, G Gᵀ = diag(6, 6, 6, 4, 4, 4).
        let points = metrics(&opposed(3, 0.0));
        assert_near(points.smallest_singular_value, 2.0);
        assert_near(points.ellipsoid_volume, 6.0_f64.powf(1.5) * 8.0);
        // Soft fingers add torque about each axis from two contacts: diag(6, 6, 6, 6, 6, 6).
        let soft = metrics(&opposed(3, 0.002));
        assert_near(soft.smallest_singular_value, 6.0_f64.sqrt());
        assert_near(soft.ellipsoid_volume, 216.0);
        // Two points resist no torque about their line, two soft fingers do: diag(2, 2, 2, 2, 2, 2).
        let [points, soft] = [0.0, 0.002].map(|torsion_m| metrics(&opposed(1, torsion_m)));
        assert_eq!((points.smallest_singular_value, points.ellipsoid_volume), (0.0, 0.0));
        assert_near(soft.smallest_singular_value, 2.0_f64.sqrt());
        assert_near(soft.ellipsoid_volume, 8.0);
        // Of three columns, or none, some singular values are missing.
        for contacts in [vec![], vec![opposed(1, 0.0).contacts[0].clone()]] {
            let few = metrics(&grasp(1.0, contacts));
            assert_eq!((few.smallest_singular_value, few.ellipsoid_volume, few.linf_epsilon), (0.0, 0.0, -1.0));
        }
    }

    /// All sums of one edge wrench, or none, per contact.
    fn all_sums(case: &GraspCase) -> Vec<[f64; DIM]> {
        let mut sums = vec![[0.0; DIM]];
        for contact in &case.contacts {
            let mut edges = wrenches(&GraspCase { contacts: vec![contact.clone()], ..case.clone() });
            edges.push([0.0; DIM]);
            sums = sums
                .iter()
                .flat_map(|sum| edges.iter().map(|edge| std::array::from_fn(|i| sum[i] + edge[i])))
                .collect();
        }
        sums
    }

    #[test]
    fn linf_is_that_of_all_sums() {
        let mut cases = vec![opposed(1, 0.3)];
        let mut random = SplitMix64(21);
        for n in [3, 3, 3, 3, 4].repeat(8) {
            let mut case = around(&mut random, n, 1.0);
            // One soft finger at most, or there are too many sums.
            case.contacts[n - 1].torsion_m *= if n == 3 { 1.0 } else { 0.0 };
            case.contacts[..n - 1].iter_mut().for_each(|contact| contact.torsion_m = 0.0);
            cases.push(case);
        }
        let mut n_closed = 0;
        for case in cases {
            let found = metrics(&case);
            if found.quality.force_closure {
                let expected = convex_hull(&all_sums(&case)).expect("a hull").least_offset();
                assert!((found.linf_epsilon - expected).abs() < 1e-9, "{} instead of {expected}", found.linf_epsilon);
                n_closed += 1;
            }
        }
        assert!(n_closed >= 4, "{n_closed}");
    }

    #[test]
    fn linf_of_two_equal_halves_by_hand() {
        // Each contact twice: the sum of two equal convex sets is twice the set.
        let once = opposed(1, 0.3);
        let mut twice = once.clone();
        twice.contacts.extend(once.contacts.clone());
        let (once, twice) = (metrics(&once), metrics(&twice));
        assert!(once.quality.force_closure);
        assert_near(twice.linf_epsilon, 2.0 * once.linf_epsilon);
        assert_near(twice.quality.epsilon, once.quality.epsilon);
    }

    #[test]
    fn linf_is_never_less_than_l1_and_never_more_than_n_times_it() {
        let mut random = SplitMix64(5);
        let mut n_closed = 0;
        for n in (3..9).cycle().take(60) {
            let case = around(&mut random, n, 0.8);
            let Metrics { quality, linf_epsilon, .. } = metrics(&case);
            if quality.force_closure {
                // A sum of n wrenches is n times a mean, and all means of edges and the origin are in the L1 space.
                let most = n as f64 * quality.epsilon;
                assert!(linf_epsilon >= quality.epsilon - 1e-9 && linf_epsilon <= most + 1e-9, "{linf_epsilon} {most}");
                n_closed += 1;
            } else {
                assert_eq!(linf_epsilon, -1.0);
            }
        }
        assert!((10..60).contains(&n_closed), "{n_closed}");
    }

    #[test]
    fn friction_helps_and_the_frame_does_not_matter() {
        let mut before = -1.0;
        for friction in [0.2, 0.4, 0.6, 0.8, 1.0, 1.3] {
            let found = metrics(&around(&mut SplitMix64(77), 7, friction)).linf_epsilon;
            assert!(found >= before, "{found} after {before}");
            before = found;
        }
        assert!(before > 0.0);
        // A quarter turn about z and a shift.
        let here = around(&mut SplitMix64(77), 7, 1.0);
        let turn = |[x, y, z]: [f64; 3]| [-y, x, z];
        let shift = |[x, y, z]: [f64; 3]| [x + 0.4, y - 0.1, z + 0.2];
        let mut there = here.clone();
        there.centre_of_mass_m = shift(turn(here.centre_of_mass_m));
        for contact in &mut there.contacts {
            contact.point_m = shift(turn(contact.point_m));
            contact.inward_normal = turn(contact.inward_normal);
            contact.tangent = turn(contact.tangent);
        }
        let load = Load { mass_kg: 0.5, gravity_direction: Some([1.0, 2.0, 3.0]) };
        let turned_load = Load { gravity_direction: Some(turn([1.0, 2.0, 3.0])), ..load };
        let here = all_metrics(&here, Some(&load)).expect("metrics");
        let there = all_metrics(&there, Some(&turned_load)).expect("metrics");
        assert_near(there.linf_epsilon, here.linf_epsilon);
        assert_near(there.ellipsoid_volume, here.ellipsoid_volume);
        assert_near(there.smallest_singular_value, here.smallest_singular_value);
        assert_near(there.gravity_force_newtons.expect("a force"), here.gravity_force_newtons.expect("a force"));
        let [here, there] = [here, there].map(|found| found.gravity_force_along_newtons.expect("a force"));
        assert_near(there, here);
    }

    #[test]
    fn gravity_by_hand() {
        let case = opposed(3, 0.1);
        let force = |down: [f64; 3], mass_kg| {
            let load = Load { mass_kg, gravity_direction: Some(down) };
            let found = all_metrics(&case, Some(&load)).expect("metrics");
            (found.gravity_force_newtons.expect("a force"), found.gravity_force_along_newtons.expect("a force"))
        };
        // Along -z the contact below gives 1 per unit of normal force; at most 1, because no wrench has more along z than
        // 1 when friction is less. So the weight itself is enough.
        let (worst, along) = force([0.0, 0.0, -2.0], 1.0);
        assert_near(along, STANDARD_GRAVITY);
        assert!(worst > along, "{worst} {along}");
        assert_near(force([0.3, -0.1, 0.7], 3.0).1, 3.0 * force([0.3, -0.1, 0.7], 1.0).1);
        // The worst of many directions is nearly the worst.
        let mut random = SplitMix64(2);
        let many = (0..2000).map(|_| force_of(&case, std::array::from_fn(|_| random.symmetric())));
        let found = many.fold(0.0, f64::max);
        assert!(found <= worst * (1.0 + 1e-9) && found > 0.97 * worst, "{found} {worst}");
    }

    fn force_of(case: &GraspCase, down: [f64; 3]) -> f64 {
        let hull = convex_hull(&wrenches(case)).expect("a hull");
        STANDARD_GRAVITY / force_along(&hull.facets, &down.map(|x| -x))
    }

    #[test]
    fn without_force_closure_no_weight_is_held_for_certain() {
        let load = Load { mass_kg: 0.2, gravity_direction: Some([0.0, 0.0, -1.0]) };
        let found = all_metrics(&opposed(1, 0.0), Some(&load)).expect("metrics");
        assert_eq!((found.gravity_force_newtons, found.gravity_force_along_newtons), (None, None));
    }

    #[test]
    fn degenerate_grasps_have_numbers() {
        let round = around(&mut SplitMix64(3), 5, 1.0);
        let one = round.contacts[0].clone();
        let coincident = grasp(0.04, vec![one.clone(); 6]);
        let coplanar = grasp(1.0, [opposed(2, 0.0).contacts, opposed(2, 0.0).contacts].concat());
        let frictionless = GraspCase {
            contacts: round.contacts.iter().map(|one| GraspContact { friction: 0.0, ..one.clone() }).collect(),
            ..round.clone()
        };
        for case in [grasp(0.04, vec![]), grasp(0.04, vec![one]), coincident, coplanar, frictionless] {
            let found = metrics(&case);
            let numbers = [found.linf_epsilon, found.ellipsoid_volume, found.smallest_singular_value];
            assert!(numbers.iter().all(|x| x.is_finite()), "{found:?}");
            assert_eq!(found.quality, quality(&case).expect("a quality"));
        }
    }

    #[test]
    fn a_load_that_cannot_be_is_refused() {
        let field_of = |mass_kg, gravity_direction| match all_metrics(
            &opposed(3, 0.0),
            Some(&Load { mass_kg, gravity_direction }),
        ) {
            Err(QualityError::Object { field, .. }) => field,
            other => panic!("{other:?}"),
        };
        assert_eq!(field_of(0.0, None), "mass_kg");
        assert_eq!(field_of(f64::NAN, None), "mass_kg");
        assert_eq!(field_of(1.0, Some([0.0; 3])), "gravity_direction");
        assert_eq!(field_of(1.0, Some([0.0, f64::INFINITY, 0.0])), "gravity_direction");
    }
}
