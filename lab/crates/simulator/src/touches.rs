//! Where a hand touches objects as it closes on them, and whether its cells feel it: the places where cells are of use.

use std::ops::Range;
use std::sync::OnceLock;

use blindgrasp_objects::{Object, SelectionError, select};
use blindgrasp_stages::hand::{Hand, JointError};
use nalgebra::{Point3, UnitVector3};
use rand::RngExt;
use rayon::prelude::*;

use crate::candidate::{candidate_rng, grasp};
use crate::loaded_contacts::grasp_case;
use crate::mechanism::Mechanism;
use crate::options::SimulatorOptions;
use crate::planner::plan_start;
use crate::wrench_space::quality;

/// A contact of a link with an object.
#[derive(Debug, Clone)]
pub struct Touch {
    pub link_idx: usize,
    pub point_in_link_m: Point3<f64>,
    /// Out of the link, into the object.
    pub normal_in_link: UnitVector3<f64>,
    /// Whether a cell feels it.
    pub is_felt: bool,
}

/// A hand that closed on an object.
#[derive(Debug, Clone)]
pub struct Closing {
    /// At least one.
    pub touches: Vec<Touch>,
    /// Whether the contacts resist every wrench, given enough force, and no links press on each other.
    pub is_held: bool,
}

/// Why a hand could not be closed on objects.
#[derive(Debug, thiserror::Error)]
pub enum TouchesError {
    /// The hand's joints do not fit together.
    #[error(transparent)]
    Joint(#[from] JointError),
    /// The training objects cannot be made.
    #[error(transparent)]
    Objects(#[from] SelectionError),
}

/// Closings on training objects, the candidates of a simulation, of which each is planned as the best of `n_approaches`. Those
/// without a contact are left out.
///
/// # Errors
/// The hand's joints do not fit together.
pub fn closings(hand: &Hand, candidates: Range<u64>, n_approaches: usize) -> Result<Vec<Closing>, TouchesError> {
    let objects = training_objects()?;
    let mechanism = Mechanism::new(hand);
    let mut options = SimulatorOptions::default();
    options.planner.n_approaches = n_approaches;
    let closings: Result<Vec<Option<Closing>>, JointError> =
        candidates.into_par_iter().map(|candidate| closing(&mechanism, objects, &options, candidate)).collect();
    Ok(closings?.into_iter().flatten().collect())
}

/// The training objects, which are made once: their hulls take longer than closings of a gripper.
pub(crate) fn training_objects() -> Result<&'static [Object], SelectionError> {
    static MADE: OnceLock<Vec<Object>> = OnceLock::new();
    if MADE.get().is_none() {
        let _ = MADE.set(select("train")?);
    }
    Ok(MADE.get().map_or(&[], Vec::as_slice))
}

fn closing(
    mechanism: &Mechanism<'_>,
    objects: &[Object],
    options: &SimulatorOptions,
    candidate: u64,
) -> Result<Option<Closing>, JointError> {
    let hand = mechanism.hand;
    let mut rng = candidate_rng(options.seed, candidate, 0);
    let object = &objects[rng.random_range(0..objects.len())];
    let start = plan_start(mechanism, object, &options.protocol, &options.planner, &mut rng)?;
    let Some(start) = start else { return Ok(None) };
    let Some((exploration, contacts)) = grasp(mechanism, object, &start, options)? else { return Ok(None) };
    let palm_from_links = hand.palm_from_links(&exploration.posture(exploration.end))?;
    let thresholds: Vec<f64> = hand.cells().map(|(_, cell)| cell.noise_threshold_newtons).collect();
    let mut touches = Vec::new();
    for contact in contacts.iter().filter(|contact| contact.of_object) {
        let link_idx = contact.point.link_idx;
        let palm_from_link = &palm_from_links[link_idx];
        touches.push(Touch {
            link_idx,
            point_in_link_m: palm_from_link.inverse_transform_point(&contact.point.point_in_palm_m),
            normal_in_link: palm_from_link.rotation.inverse() * -contact.point.object_normal_in_palm,
            is_felt: contact.cells_newtons.iter().any(|(idx, newtons)| *newtons > thresholds[*idx]),
        });
    }
    let quality = quality(&grasp_case(object, &exploration.palm_from_object, &contacts, options.friction));
    let is_closed = quality.is_ok_and(|quality| quality.force_closure);
    Ok(Some(Closing { is_held: is_closed && touches.len() == contacts.len(), touches }))
}

/// The contacts of all closings.
pub fn all_touches(closings: Vec<Closing>) -> Vec<Touch> {
    closings.into_iter().flat_map(|closing| closing.touches).collect()
}
