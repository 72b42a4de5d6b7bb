//! Contact points with their loads: the patches of rubber, the forces on cells, and the grasp case of the wrench space.

use nalgebra::{Isometry3, Matrix2, UnitVector3};

use crate::contact_points::{ContactPoint, tangents};
use crate::mechanism::Mechanism;
use crate::soft_finger::{ContactFrame, Patch, SoftFingerOptions, link_surface, object_curvature, patch, patch_load};
use crate::wrench_space::{GraspCase, GraspContact};
use blindgrasp_messages::SceneContact;
use blindgrasp_objects::Object;

/// A contact with its patch.
#[derive(Debug, Clone)]
pub struct SimulatedContact {
    pub point: ContactPoint,
    /// The first tangent in the palm frame, from which the soft finger's edges are counted: along the link's x axis.
    pub first_tangent: UnitVector3<f64>,
    pub patch: Patch,
    /// The part of the patch that lies on the link.
    pub on_link: f64,
    pub load_newtons: f64,
    /// Force on cells at full load, as (index among the hand's cells, newtons).
    pub cells_newtons: Vec<(usize, f64)>,
    /// The progress of the closing at which both links of the contact had come to their places.
    pub settled_at: f64,
    /// Whether the contact is with the object, not with another link or the stand.
    pub of_object: bool,
}

/// A contact point with its load.
pub(crate) struct LoadedPoint<'a> {
    pub(crate) point: ContactPoint,
    pub(crate) load_newtons: f64,
    /// The object that the point presses on; `None` for a plane or another link.
    pub(crate) object: Option<&'a Object>,
}

impl SimulatedContact {
    /// The contact in a scene's form.
    pub(crate) fn to_scene(&self) -> SceneContact {
        SceneContact {
            link: self.point.link_idx as u32,
            other_link: self.point.other.map_or(-1, |other| other.link_idx as i32),
            point_m: self.point.point_in_palm_m.into(),
            inward_normal: (-self.point.object_normal_in_palm.into_inner()).into(),
            tangent: self.first_tangent.into_inner().into(),
            force_newtons: self.load_newtons,
            // Not `sum`, which makes -0 of nothing.
            felt_newtons: self.cells_newtons.iter().fold(0.0, |sum, (_, newtons)| sum + newtons),
            torsion_m: self.patch.torsion_m(self.on_link),
        }
    }
}

/// The patches of contact points and the forces on cells. `settled_at` is 0, because it is not known here.
pub(crate) fn press(
    mechanism: &Mechanism<'_>,
    palm_from_links: &[Isometry3<f64>],
    palm_from_object: &Isometry3<f64>,
    pressed: &[LoadedPoint<'_>],
    options: &SoftFingerOptions,
) -> Vec<SimulatedContact> {
    pressed
        .iter()
        .map(|LoadedPoint { point, load_newtons, object }| {
            let palm_from_link = &palm_from_links[point.link_idx];
            let frame = contact_frame(point, palm_from_link);
            let surface = |shape_idx: usize, link_idx: usize, frame: &ContactFrame| {
                let shape = &mechanism.shapes[shape_idx];
                link_surface(mechanism.hand, shape, &palm_from_links[link_idx], frame, options)
            };
            let (link_curvature, half_width_m) = surface(point.shape_idx, point.link_idx, &frame);
            let other_curvature: Matrix2<f64> = match (point.other, object) {
                (None, Some(object)) => object_curvature(&*object.shape, palm_from_object, &frame),
                (None, None) => Matrix2::zeros(),
                // Seen from the other link, the normal is turned round; the tangents stay, so curvatures add up.
                (Some(other), _) => surface(other.shape_idx, other.link_idx, &frame.reversed()).0,
            };
            let patch = patch(&(link_curvature + other_curvature), *load_newtons, half_width_m, options);
            let load = patch_load(mechanism, point.link_idx, palm_from_link, &frame, &patch);
            SimulatedContact {
                point: *point,
                first_tangent: frame.tangents[0],
                patch,
                on_link: load.on_link,
                load_newtons: *load_newtons,
                cells_newtons: load.cell_shares.iter().map(|(idx, share)| (*idx, share * load_newtons)).collect(),
                settled_at: 0.0,
                of_object: point.other.is_none() && object.is_some(),
            }
        })
        .collect()
}

/// The grasp's wrench space, in the palm frame: every contact with the object is a soft finger.
pub fn grasp_case(
    object: &Object,
    palm_from_object: &Isometry3<f64>,
    contacts: &[SimulatedContact],
    friction: f64,
) -> GraspCase {
    let contacts = contacts
        .iter()
        .filter(|contact| contact.of_object)
        .map(|contact| {
            let inward = -contact.point.object_normal_in_palm.into_inner();
            GraspContact {
                point_m: contact.point.point_in_palm_m.into(),
                inward_normal: inward.into(),
                tangent: contact.first_tangent.into_inner().into(),
                friction,
                torsion_m: contact.patch.torsion_m(contact.on_link),
            }
        })
        .collect();
    GraspCase {
        centre_of_mass_m: (palm_from_object * object.centre_of_mass_m).into(),
        max_radius_m: object.max_radius_m,
        contacts,
    }
}

fn contact_frame(point: &ContactPoint, palm_from_link: &Isometry3<f64>) -> ContactFrame {
    ContactFrame {
        point_m: point.point_in_palm_m,
        tangents: tangents(point, palm_from_link),
        inward_normal: -point.object_normal_in_palm,
    }
}
