//! Where the closed hand touches the object: up to a few separated points a link, each with the object's normal; and
//! where its links touch each other, one point each.
//!
//! Every link of the hand counts, pad or not. A link's touching patch (a point, a line, a face on a face) is found by
//! tilting the link a little about its nearest point, in eight directions. The nearest points then run to the ends of
//! the patch. Of those, the points farthest from each other stay.

use nalgebra::{Isometry3, Point3, UnitQuaternion, UnitVector3, Vector3};
use parry3d_f64::math::Vector;

use super::distance::{ClosestPoints, PlacedShape};
use super::mechanism::Mechanism;
use super::option_check::{OptionError, positive, require, with_defaults};
use blindgrasp_objects::Object;
use blindgrasp_stages::hand::pose_from_isometry;

with_defaults! {
    /// How a link's patch becomes points.
    pub struct ContactOptions {
        /// At most so many points a link. 3: a face on a face needs three to resist tilting.
        pub contacts_per_link: usize = 3,
        /// Points of a link nearer to each other than this are one. 5 mm: about a finger's cell.
        pub separation_m: f64 = 0.005,
    }
}

impl ContactOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        let n_points = self.contacts_per_link;
        require("contacts_per_link", n_points, (1..=3).contains(&n_points), "1, 2 or 3")?;
        positive("separation_m", self.separation_m)
    }
}

/// A point where a link touches the object or another link, in the palm frame.
#[derive(Debug, Clone, Copy)]
pub struct ContactPoint {
    pub link_idx: usize,
    /// Index of the touching shape in the mechanism.
    pub shape_idx: usize,
    /// The other link of a contact of the hand with itself; `None` for the object.
    pub other: Option<OtherLink>,
    /// The point on the touched surface, metres.
    pub point_in_palm_m: Point3<f64>,
    /// The touched surface's normal, outwards; on an edge or corner the one that points to the link.
    pub object_normal_in_palm: UnitVector3<f64>,
    pub distance_m: f64,
}

/// The other link of a contact of the hand with itself.
#[derive(Debug, Clone, Copy)]
pub struct OtherLink {
    /// Index of that link.
    pub link_idx: usize,
    pub shape_idx: usize,
}

/// How far a link is tilted to find the ends of its patch. On a smooth object of radius R the point moves by only 0.01 R.
const TILT_RAD: f64 = 0.01;
/// The link is drawn back by this before it is tilted, so that it doesn't cut into the object.
const DRAW_BACK_M: f64 = 0.002;
/// An object farther than this from the tilted link did not touch it before.
const TILTED_REACH_M: f64 = 0.005;

/// All contacts, link by link.
pub fn contact_points(
    mechanism: &Mechanism<'_>,
    palm_from_links: &[Isometry3<f64>],
    palm_from_object: &Isometry3<f64>,
    object: &Object,
    touch_tolerance_m: f64,
    options: &ContactOptions,
) -> Vec<ContactPoint> {
    let mut contacts = Vec::new();
    let mut candidates: Vec<ContactPoint> = Vec::new();
    for (idx, shape) in mechanism.shapes.iter().enumerate() {
        touching_points(idx, shape, palm_from_links, palm_from_object, object, touch_tolerance_m, &mut candidates);
        if mechanism.shapes.get(idx + 1).is_none_or(|next| next.link_idx != shape.link_idx) {
            contacts.extend(separated(&candidates, options));
            candidates.clear();
        }
    }
    contacts
}

/// Where links of the hand touch each other: for each pair, the nearest point on either.
pub fn self_contacts(
    mechanism: &Mechanism<'_>,
    palm_from_links: &[Isometry3<f64>],
    touch_tolerance_m: f64,
) -> Vec<ContactPoint> {
    let mut contacts = Vec::new();
    for &(a, b) in &mechanism.pairs {
        let Some(found) = mechanism.closest_of_links(a, b, palm_from_links) else { continue };
        let closest = found.points;
        if closest.distance_m > touch_tolerance_m {
            continue;
        }
        let [a, b] = found.shape_idxs;
        for (shape_idx, other_idx, point, outward) in
            [(a, b, closest.point_on_second, -closest.direction), (b, a, closest.point_on_first, closest.direction)]
        {
            let [link_idx, other_link_idx] = [shape_idx, other_idx].map(|idx| mechanism.shapes[idx].link_idx);
            contacts.push(ContactPoint {
                link_idx,
                shape_idx,
                other: Some(OtherLink { link_idx: other_link_idx, shape_idx: other_idx }),
                point_in_palm_m: point_from_parry(point),
                object_normal_in_palm: UnitVector3::new_normalize(vector_from_parry(outward)),
                distance_m: closest.distance_m,
            });
        }
    }
    contacts
}

/// Two unit tangents of a contact, the first as near as can be to the link's x axis; with the normal *into* the object
/// they are right-handed. Bound to the link, so they turn with the hand.
pub fn tangents(contact: &ContactPoint, palm_from_link: &Isometry3<f64>) -> [UnitVector3<f64>; 2] {
    let inward = -contact.object_normal_in_palm.into_inner();
    let x = palm_from_link.rotation * Vector3::x();
    let along = if x.dot(&inward).abs() < 0.9 { x } else { palm_from_link.rotation * Vector3::y() };
    let first = UnitVector3::new_normalize(along - inward * along.dot(&inward));
    [first, UnitVector3::new_normalize(inward.cross(&first))]
}

/// The nearest point and the ends of the patch, for one shape of a link.
fn touching_points(
    shape_idx: usize,
    shape: &PlacedShape<'_>,
    palm_from_links: &[Isometry3<f64>],
    palm_from_object: &Isometry3<f64>,
    object: &Object,
    touch_tolerance_m: f64,
    points: &mut Vec<ContactPoint>,
) {
    let palm_from_link = &palm_from_links[shape.link_idx];
    if shape.sphere_distance_m(palm_from_link, palm_from_object, object) > touch_tolerance_m {
        return;
    }
    let palm_from_shape = palm_from_link * shape.link_from_shape;
    let shape_pose = pose_from_isometry(&palm_from_shape);
    let object_pose = pose_from_isometry(palm_from_object);
    let Some(nearest) = shape.closest_to_object(&shape_pose, &object_pose, object, touch_tolerance_m) else { return };
    let of = |closest: &ClosestPoints, distance_m: f64| {
        let point_in_palm_m = point_from_parry(closest.point_on_second);
        let out_of_object = -vector_from_parry(closest.direction);
        let object_normal_in_palm = UnitVector3::new_normalize(out_of_object);
        ContactPoint {
            link_idx: shape.link_idx,
            shape_idx,
            other: None,
            point_in_palm_m,
            object_normal_in_palm,
            distance_m,
        }
    };
    let first = of(&nearest, nearest.distance_m);
    points.push(first);
    let pivot = first.point_in_palm_m.coords;
    let [t1, t2] = tangents(&first, palm_from_link).map(UnitVector3::into_inner);
    for idx in 0..8 {
        // Between the tangents' directions, so that a rectangle's corners come out and not any point of its edges.
        let (sin, cos) = (std::f64::consts::FRAC_PI_4 * (f64::from(idx) + 0.5)).sin_cos();
        let tilt = UnitQuaternion::from_scaled_axis((t1 * cos + t2 * sin) * TILT_RAD);
        let back = first.object_normal_in_palm.into_inner() * DRAW_BACK_M;
        let moved = Isometry3::from_parts((pivot - tilt * pivot + back).into(), tilt);
        let tilted_pose = pose_from_isometry(&(moved * palm_from_shape));
        let Some(tilted) = shape.closest_to_object(&tilted_pose, &object_pose, object, TILTED_REACH_M) else {
            continue;
        };
        let distance_m = shape.distance_to_point_m(&shape_pose, tilted.point_on_second);
        if distance_m <= touch_tolerance_m {
            let mut point = of(&tilted, distance_m);
            // A normal within the tilt of the first one is the first one's, tilted: the same face.
            if point.object_normal_in_palm.angle(&first.object_normal_in_palm) < 1.1 * TILT_RAD {
                point.object_normal_in_palm = first.object_normal_in_palm;
            }
            points.push(point);
        }
    }
}

/// The nearest point; or, if the points are spread, the points farthest from each other.
fn separated(candidates: &[ContactPoint], options: &ContactOptions) -> Vec<ContactPoint> {
    let Some(nearest) = candidates.iter().min_by(|a, b| a.distance_m.total_cmp(&b.distance_m)) else {
        return Vec::new();
    };
    let middle: Vector3<f64> =
        candidates.iter().map(|point| point.point_in_palm_m.coords).sum::<Vector3<f64>>() / candidates.len() as f64;
    let from_middle = |point: &ContactPoint| (point.point_in_palm_m.coords - middle).norm();
    let is_spread =
        options.contacts_per_link > 1 && candidates.iter().any(|point| far_m(point, nearest) > options.separation_m);
    let outermost = candidates.iter().max_by(|a, b| from_middle(a).total_cmp(&from_middle(b))).unwrap_or(nearest);
    let mut chosen = vec![if is_spread { *outermost } else { *nearest }];
    while is_spread && chosen.len() < options.contacts_per_link {
        let from_chosen =
            |point: &ContactPoint| chosen.iter().map(|other| far_m(point, other)).fold(f64::MAX, f64::min);
        match candidates.iter().max_by(|a, b| from_chosen(a).total_cmp(&from_chosen(b))) {
            Some(next) if from_chosen(next) > options.separation_m => chosen.push(*next),
            _ => break,
        }
    }
    chosen
}

fn far_m(a: &ContactPoint, b: &ContactPoint) -> f64 {
    (a.point_in_palm_m - b.point_in_palm_m).norm()
}

fn point_from_parry(vector: Vector) -> Point3<f64> {
    Point3::new(vector.x, vector.y, vector.z)
}

fn vector_from_parry(vector: Vector) -> Vector3<f64> {
    Vector3::new(vector.x, vector.y, vector.z)
}
