//! The grasp wrench space and its two qualities, epsilon and volume: the ground truth of a grasp's stability.
//!
//! The L1 grasp wrench space (Ferrari & Canny 1992) is the convex hull of all contacts' edge wrenches together, as in Dang &
//! Allen, section III. It is not divided by the number of contacts, and the origin is not added. Finding the contacts, their
//! friction and their torsional radius is not part of this module.

use std::f64::consts::FRAC_PI_4;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use blindgrasp_messages::GraspScene;

use super::hull::{DIM, HullError, convex_hull};

/// A grasp is stable only if its epsilon is greater than this (Dang & Allen, section IV).
pub const STABLE_EPSILON: f64 = 0.07;

/// A grasp is stable only if its volume is greater than this (Dang & Allen, section IV).
pub const STABLE_VOLUME: f64 = 0.1;

/// Greatest coefficient of friction that is believed: rubber reaches about 4.
pub const MAX_FRICTION: f64 = 10.0;

/// What the wrench space depends on. All vectors are in one frame; the qualities do not depend on which.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraspCase {
    /// The object's centre of mass, metres.
    pub centre_of_mass_m: [f64; 3],
    /// The largest distance of a vertex of the object from its centre of mass, metres: torques are divided by it.
    pub max_radius_m: f64,
    /// All contacts of the hand with the object, sensed or not.
    pub contacts: Vec<GraspContact>,
}

impl From<&GraspScene> for GraspCase {
    /// Takes the contacts with the object, in the palm frame, and leaves out those of the hand with itself.
    fn from(scene: &GraspScene) -> Self {
        let of_object = scene.contacts.iter().filter(|contact| contact.other_link < 0);
        let contacts = of_object
            .map(|contact| GraspContact {
                point_m: contact.point_m,
                inward_normal: contact.inward_normal,
                tangent: contact.tangent,
                friction: scene.friction,
                torsion_m: contact.torsion_m,
            })
            .collect();
        GraspCase { centre_of_mass_m: scene.centre_of_mass_m, max_radius_m: scene.max_radius_m, contacts }
    }
}

/// A contact with friction: of a point, or of a soft finger when it has a torsional radius.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraspContact {
    /// Position, metres.
    pub point_m: [f64; 3],
    /// Unit normal n into the object: the direction in which the hand pushes.
    pub inward_normal: [f64; 3],
    /// A unit tangent t1, perpendicular to the normal; the other is t2 = n × t1. Edges are counted from t1.
    pub tangent: [f64; 3],
    /// Coefficient of Coulomb friction μ.
    pub friction: f64,
    /// Torsional radius of a soft finger, metres: torque about the normal per unit of friction force. 0 is a point
    /// contact.
    pub torsion_m: f64,
}

/// The qualities of a grasp's wrench space. Forces are per unit of normal force, torques are divided by the
/// object's largest radius too, so both qualities are without unit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quality {
    /// Radius of the largest ball around the origin within the wrench space; -1 when the origin is not strictly inside.
    pub epsilon: f64,
    /// Six-dimensional volume, reported also without force closure; 0 for a flat wrench space.
    pub volume: f64,
    /// Number of edge wrenches: 8 per point contact, 20 per soft finger.
    pub n_wrenches: usize,
    /// Whether the origin is strictly inside: the grasp resists every wrench, given enough force.
    pub force_closure: bool,
    /// Number of attempts at the hull that broke before one succeeded; 0 in the normal case.
    pub n_retries: u32,
    /// The largest movement of a wrench's coordinate that was needed to obtain a hull; `None` unless all else failed.
    pub joggle: Option<f64>,
}

impl Quality {
    /// Whether both qualities exceed their thresholds, strictly (Dang & Allen, section IV).
    pub fn is_stable(&self) -> bool {
        self.epsilon > STABLE_EPSILON && self.volume > STABLE_VOLUME
    }

    /// The quality of a wrench space without volume.
    fn flat(n_wrenches: usize) -> Self {
        Self { epsilon: -1.0, volume: 0.0, n_wrenches, force_closure: false, n_retries: 0, joggle: None }
    }
}

/// Why a grasp has no quality. No such error means that the grasp is unstable.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum QualityError {
    #[error("grasp: {field} is {found:?}, expected {expected}")]
    Object { field: &'static str, expected: &'static str, found: Vec<f64> },
    #[error("contact {contact_idx}: {field} is {found:?}, expected {expected}")]
    Contact { contact_idx: usize, field: &'static str, expected: &'static str, found: Vec<f64> },
    /// The hull of the wrenches failed, which does not mean that the grasp is unstable.
    #[error("the hull of {n_wrenches} wrenches failed")]
    Hull {
        n_wrenches: usize,
        #[source]
        source: HullError,
    },
}

/// Normals and tangents may be this far from unit length, and their product from zero.
const UNIT_TOLERANCE: f64 = 1e-3;

/// All contacts' edge wrenches: force per unit of normal force, then torque about the centre of mass over the
/// largest radius, likewise per unit of normal force. In the frame of the grasp, contact by contact.
///
/// An edge (e0, e1, e5) has the force f = n + μ (e0·t1 + e1·t2) and the torque (p - c) × f + μ·e5·n. The input is not
/// checked; [`quality`] checks it.
pub fn wrenches(case: &GraspCase) -> Vec<[f64; DIM]> {
    let mut wrenches = Vec::with_capacity(case.contacts.iter().map(n_edges).sum());
    for contact in &case.contacts {
        let normal = contact.inward_normal;
        let second_tangent = cross(normal, contact.tangent);
        let arm: [f64; 3] = std::array::from_fn(|i| contact.point_m[i] - case.centre_of_mass_m[i]);
        for [e0, e1, e5] in edges(contact.torsion_m) {
            let force: [f64; 3] = std::array::from_fn(|i| {
                normal[i] + contact.friction * (e0 * contact.tangent[i] + e1 * second_tangent[i])
            });
            let moment = cross(arm, force);
            let torque: [f64; 3] =
                std::array::from_fn(|i| (moment[i] + contact.friction * e5 * normal[i]) / case.max_radius_m);
            wrenches.push([force[0], force[1], force[2], torque[0], torque[1], torque[2]]);
        }
    }
    wrenches
}

/// Epsilon and volume of a grasp's wrench space.
///
/// Fewer than two contacts, and contacts whose wrenches lie in a flat (such as two opposite points), have epsilon -1
/// and volume 0. The origin counts as strictly inside when it is further from every facet than the hull's uncertainty.
///
/// # Errors
/// A value that a grasp cannot have, with its contact and field; or a hull that failed for another reason than flatness.
pub fn quality(case: &GraspCase) -> Result<Quality, QualityError> {
    check(case)?;
    let wrenches = wrenches(case);
    let n_wrenches = wrenches.len();
    if case.contacts.len() < 2 {
        return Ok(Quality::flat(n_wrenches));
    }
    let hull = match convex_hull(&wrenches) {
        Ok(hull) => hull,
        Err(HullError::NotFullDimensional { .. }) => return Ok(Quality::flat(n_wrenches)),
        Err(source) => return Err(QualityError::Hull { n_wrenches, source }),
    };
    let least_offset = hull.least_offset();
    let force_closure = least_offset > hull.uncertainty;
    Ok(Quality {
        epsilon: if force_closure { least_offset } else { -1.0 },
        volume: hull.volume,
        n_wrenches,
        force_closure,
        n_retries: hull.n_retries,
        joggle: hull.joggle,
    })
}

fn n_edges(contact: &GraspContact) -> usize {
    if contact.torsion_m > 0.0 { 20 } else { 8 }
}

/// Edges (e0, e1, e5) of a contact: tangential directions in units of friction, torsion in metres.
fn edges(torsion_m: f64) -> Vec<[f64; 3]> {
    let mut edges = Vec::with_capacity(20);
    if torsion_m > 0.0 {
        // At the poles only torsion is left. Written out: the cosine of π/2 as a float is not quite zero.
        edges.push([0.0, 0.0, torsion_m]);
        add_ring(&mut edges, torsion_m, FRAC_PI_4, 5);
    }
    add_ring(&mut edges, torsion_m, 0.0, 8);
    if torsion_m > 0.0 {
        add_ring(&mut edges, torsion_m, -FRAC_PI_4, 5);
        edges.push([0.0, 0.0, -torsion_m]);
    }
    edges
}

fn add_ring(edges: &mut Vec<[f64; 3]>, torsion_m: f64, latitude: f64, n: u32) {
    for k in 0..n {
        let longitude = std::f64::consts::TAU * f64::from(k) / f64::from(n);
        edges.push([latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin() * torsion_m]);
    }
}

fn check(case: &GraspCase) -> Result<(), QualityError> {
    let (centre, radius_m) = (&case.centre_of_mass_m, case.max_radius_m);
    if !is_finite(centre) {
        let (field, expected) = ("centre_of_mass_m", "finite numbers");
        return Err(QualityError::Object { field, expected, found: centre.to_vec() });
    }
    if !(radius_m > 0.0 && radius_m.is_finite()) {
        let (field, expected) = ("max_radius_m", "a finite number above 0");
        return Err(QualityError::Object { field, expected, found: vec![radius_m] });
    }
    for (contact_idx, contact) in case.contacts.iter().enumerate() {
        let GraspContact { point_m, inward_normal, tangent, friction, torsion_m } = contact;
        let problem = if !is_finite(point_m) {
            Some(("point_m", "finite numbers", point_m.as_slice()))
        } else if !is_unit(inward_normal) {
            Some(("inward_normal", "a unit vector", inward_normal.as_slice()))
        } else if !is_unit(tangent) {
            Some(("tangent", "a unit vector", tangent.as_slice()))
        } else if dot(inward_normal, tangent).abs() > UNIT_TOLERANCE {
            Some(("tangent", "a vector perpendicular to the normal", tangent.as_slice()))
        } else if !is_non_negative(*friction) {
            Some(("friction", "a finite number, 0 or above", std::slice::from_ref(friction)))
        } else if !is_non_negative(*torsion_m) {
            Some(("torsion_m", "a finite number, 0 or above", std::slice::from_ref(torsion_m)))
        } else {
            None
        };
        if let Some((field, expected, found)) = problem {
            return Err(QualityError::Contact { contact_idx, field, expected, found: found.to_vec() });
        }
    }
    Ok(())
}

fn is_finite(vector: &[f64; 3]) -> bool {
    vector.iter().all(|x| x.is_finite())
}

fn is_unit(vector: &[f64; 3]) -> bool {
    (dot(vector, vector).sqrt() - 1.0).abs() <= UNIT_TOLERANCE
}

fn is_non_negative(value: f64) -> bool {
    value >= 0.0 && value.is_finite()
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A contact on an object, its tangent along the axis the normal is least along.
    fn contact(point_m: [f64; 3], direction: [f64; 3], friction: f64, torsion_m: f64) -> GraspContact {
        let unit = |v: [f64; 3]| v.map(|x| x / dot(&v, &v).sqrt());
        let inward_normal = unit(direction);
        let least = (0..3).min_by(|a, b| inward_normal[*a].abs().total_cmp(&inward_normal[*b].abs())).expect("three");
        let axis = std::array::from_fn(|i| if i == least { 1.0 } else { 0.0 });
        GraspContact { point_m, inward_normal, tangent: unit(cross(inward_normal, axis)), friction, torsion_m }
    }

    fn grasp(contacts: Vec<GraspContact>) -> GraspCase {
        GraspCase { centre_of_mass_m: [0.0; 3], max_radius_m: 0.05, contacts }
    }

    fn pinch(friction: f64, torsion_m: f64) -> GraspCase {
        grasp(vec![
            contact([0.02, 0.0, 0.0], [-1.0, 0.0, 0.0], friction, torsion_m),
            contact([-0.02, 0.0, 0.0], [1.0, 0.0, 0.0], friction, torsion_m),
        ])
    }

    /// Three fingers around an object and a palm below it.
    fn four_contacts(friction: f64) -> GraspCase {
        grasp(vec![
            contact([0.03, 0.0, 0.01], [-1.0, 0.1, 0.0], friction, 0.002),
            contact([-0.02, 0.02, 0.012], [0.8, -0.9, 0.1], friction, 0.0),
            contact([-0.02, -0.025, 0.009], [0.7, 1.0, -0.1], friction, 0.001),
            contact([0.002, 0.001, -0.03], [0.0, 0.1, 1.0], friction, 0.0),
        ])
    }

    #[track_caller]
    fn assert_near(found: f64, expected: f64) {
        assert!((found - expected).abs() <= 1e-9 * expected.abs(), "{found} instead of {expected}");
    }

    #[track_caller]
    fn assert_wrench(found: [f64; 6], expected: [f64; 6]) {
        assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-15), "{found:?} instead of {expected:?}");
    }

    #[test]
    fn wrenches_of_a_point_contact_by_hand() {
        // t2 = n × t1 = (0, 0, -1).
        let one = GraspContact {
            point_m: [0.13, 0.0, 0.0],
            inward_normal: [-1.0, 0.0, 0.0],
            tangent: [0.0, 1.0, 0.0],
            friction: 0.5,
            torsion_m: 0.0,
        };
        let case = GraspCase { centre_of_mass_m: [0.03, 0.0, 0.0], max_radius_m: 0.2, contacts: vec![one.clone()] };
        let point = wrenches(&case);
        assert_eq!(point.len(), 8);
        assert_wrench(point[0], [-1.0, 0.5, 0.0, 0.0, 0.0, 0.25]);
        assert_wrench(point[2], [-1.0, 0.0, -0.5, 0.0, 0.25, 0.0]);
        let diagonal = 0.5 * 0.5_f64.sqrt();
        assert_wrench(point[5], [-1.0, -diagonal, diagonal, 0.0, -diagonal / 2.0, -diagonal / 2.0]);

        let soft = wrenches(&GraspCase { contacts: vec![GraspContact { torsion_m: 0.002, ..one }], ..case });
        assert_eq!(soft.len(), 20);
        assert_wrench(soft[0], [-1.0, 0.0, 0.0, -0.005, 0.0, 0.0]);
        assert_wrench(soft[1], [-1.0, diagonal, 0.0, -0.005 * 0.5_f64.sqrt(), 0.0, diagonal / 2.0]);
        assert_wrench(soft[6], point[0]);
        assert_wrench(soft[13], point[7]);
        assert_wrench(soft[19], [-1.0, 0.0, 0.0, 0.005, 0.0, 0.0]);
    }

    #[test]
    fn fewer_than_two_contacts_have_no_quality() {
        assert_eq!(quality(&grasp(vec![])), Ok(Quality::flat(0)));
        let one = grasp(vec![contact([0.02, 0.0, 0.0], [-1.0, 0.0, 0.0], 1.0, 0.002)]);
        assert_eq!(quality(&one), Ok(Quality::flat(20)));
        assert_eq!((Quality::flat(20).epsilon, Quality::flat(20).volume), (-1.0, 0.0));
    }

    #[test]
    fn a_pinch_needs_soft_fingers() {
        // Two points resist no torque about the line between them.
        assert_eq!(quality(&pinch(1.0, 0.0)), Ok(Quality::flat(16)));
        let soft = quality(&pinch(1.0, 0.01)).expect("a quality");
        assert!(soft.force_closure && soft.volume > 0.0);
        // The weakest direction is about the torque around the line. The ellipsoid's pole is μ · torsion / radius = 0.2
        // away; the facets around it tilt, and cut off a little.
        assert!(soft.epsilon > 0.19 && soft.epsilon <= 0.2, "{}", soft.epsilon);
    }

    #[test]
    fn a_coincident_contact_adds_nothing() {
        let once = four_contacts(1.0);
        let mut twice = once.clone();
        twice.contacts.extend(once.contacts.clone());
        let (once, twice) = (quality(&once).expect("a quality"), quality(&twice).expect("a quality"));
        assert!(once.force_closure);
        assert_eq!(twice.n_wrenches, 2 * once.n_wrenches);
        assert_near(twice.epsilon, once.epsilon);
        assert_near(twice.volume, once.volume);
    }

    #[test]
    fn turning_and_moving_everything_changes_nothing() {
        let here = four_contacts(0.8);
        // Rodrigues' formula about a unit axis.
        let (axis, angle) = ([2.0 / 3.0, -1.0 / 3.0, 2.0 / 3.0], 1.1_f64);
        let turn = |v: [f64; 3]| -> [f64; 3] {
            let (across, along) = (cross(axis, v), dot(&axis, &v) * (1.0 - angle.cos()));
            std::array::from_fn(|i| v[i] * angle.cos() + across[i] * angle.sin() + axis[i] * along)
        };
        let shift = |v: [f64; 3]| [v[0] + 0.3, v[1] - 0.2, v[2] + 0.7];
        let mut there = here.clone();
        there.centre_of_mass_m = shift(turn(here.centre_of_mass_m));
        for contact in &mut there.contacts {
            contact.point_m = shift(turn(contact.point_m));
            contact.inward_normal = turn(contact.inward_normal);
            contact.tangent = turn(contact.tangent);
        }
        let (here, there) = (quality(&here).expect("a quality"), quality(&there).expect("a quality"));
        assert!(here.force_closure);
        assert_near(there.epsilon, here.epsilon);
        assert_near(there.volume, here.volume);
    }

    #[test]
    fn friction_never_harms() {
        let mut before = Quality::flat(0);
        for friction in [0.1, 0.3, 0.5, 0.7, 1.0, 1.5] {
            let now = quality(&four_contacts(friction)).expect("a quality");
            assert!(now.epsilon >= before.epsilon && now.volume > before.volume, "{before:?} {now:?}");
            before = now;
        }
        assert!(before.force_closure);
    }

    #[test]
    fn no_force_closure_still_has_a_volume() {
        let mut case = four_contacts(0.5);
        // All contacts push the same way, more or less.
        for contact in &mut case.contacts {
            *contact = self::contact(contact.point_m, [0.1 * contact.point_m[1], contact.point_m[0], 1.0], 0.5, 0.002);
        }
        let quality = quality(&case).expect("a quality");
        assert_eq!((quality.epsilon, quality.force_closure), (-1.0, false));
        assert!(quality.volume > 0.0);
    }

    #[test]
    fn both_thresholds_are_strict() {
        let of = |epsilon, volume| Quality { epsilon, volume, ..Quality::flat(16) }.is_stable();
        assert!(of(0.0701, 0.1001));
        assert!(!of(STABLE_EPSILON, 0.2));
        assert!(!of(0.2, STABLE_VOLUME));
        assert!(!of(-1.0, 0.2));
    }

    #[test]
    fn bad_input_says_which_contact_and_field() {
        type Change = fn(&mut GraspCase);
        let cases: [(Change, Option<usize>, &str); 9] = [
            (|case| case.max_radius_m = 0.0, None, "max_radius_m"),
            (|case| case.max_radius_m = f64::NAN, None, "max_radius_m"),
            (|case| case.centre_of_mass_m[1] = f64::INFINITY, None, "centre_of_mass_m"),
            (|case| case.contacts[2].point_m[0] = f64::NAN, Some(2), "point_m"),
            (|case| case.contacts[1].inward_normal = [0.0, 0.0, 1.01], Some(1), "inward_normal"),
            (|case| case.contacts[1].tangent = [f64::NAN; 3], Some(1), "tangent"),
            (|case| case.contacts[3].tangent = case.contacts[3].inward_normal, Some(3), "tangent"),
            (|case| case.contacts[0].friction = -0.1, Some(0), "friction"),
            (|case| case.contacts[0].torsion_m = -0.1, Some(0), "torsion_m"),
        ];
        for (change, wrong_contact, wrong_field) in cases {
            let mut case = four_contacts(1.0);
            change(&mut case);
            let found = match quality(&case) {
                Err(QualityError::Object { field, .. }) => (None, field),
                Err(QualityError::Contact { contact_idx, field, .. }) => (Some(contact_idx), field),
                other => panic!("{wrong_field}: {other:?}"),
            };
            assert_eq!(found, (wrong_contact, wrong_field));
        }
    }
}
