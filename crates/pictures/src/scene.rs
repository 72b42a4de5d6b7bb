//! A hand as a page draws it in three dimensions: its surfaces once, its posture frame by frame.

use nalgebra::Isometry3;
use serde::Serialize;

use super::colour::{HAND, OBJECT, Rgb, SILENT_CELL, bytes, force_colour};
use super::geometry::{cells_in_link, link_mesh};
use super::grasp::palm_from_object;
use super::html::{CellData, PadData, Surface, point, rows, surface};
use blindgrasp_messages::GraspScene;
use blindgrasp_objects::mesh::Mesh;
use blindgrasp_stages::hand::{Hand, JointError};

/// Colours of the scale of forces.
const N_COLOURS: usize = 64;

/// The parts of a hand that do not change. Lengths in metres, to hundredths of a millimetre.
#[derive(Serialize)]
pub struct HandScene {
    hand: String,
    links: Vec<Surface>,
    cells: Vec<CellData>,
    pads: Vec<PadData>,
    /// The names of the pads.
    pad_names: Vec<String>,
    joints: Vec<String>,
    cell_unit: &'static str,
    colours: Vec<[u8; 3]>,
    hand_colour: [u8; 3],
    silent_colour: [u8; 3],
}

impl HandScene {
    pub fn new(hand: &Hand) -> HandScene {
        let colours = (0..N_COLOURS).map(|idx| force_colour(idx as f64 / (N_COLOURS - 1) as f64));
        HandScene {
            hand: hand.name.clone(),
            links: hand.links.iter().map(|link| surface(&link_mesh(link))).collect(),
            cells: cells(hand),
            pads: pads(hand),
            pad_names: hand.pads.iter().map(|pad| pad.name.clone()).collect(),
            joints: hand.joints.iter().map(|joint| joint.name.clone()).collect(),
            cell_unit: hand.cell_unit.symbol(),
            colours: colours.map(|colour: Rgb| bytes(colour)).collect(),
            hand_colour: bytes(HAND),
            silent_colour: bytes(SILENT_CELL),
        }
    }
}

/// The surface of an object in the palm frame, where the scene of a grasp has it.
#[derive(Serialize)]
pub struct ObjectScene {
    surface: Surface,
    colour: [u8; 3],
}

impl ObjectScene {
    pub fn new(mesh: &Mesh, scene: &GraspScene) -> ObjectScene {
        let mut mesh = mesh.clone();
        mesh.transform(&palm_from_object(scene));
        ObjectScene { surface: surface(&mesh), colour: bytes(OBJECT) }
    }
}

/// The pose of each link in the palm frame: the upper three rows of its matrix, row by row.
///
/// # Errors
/// The joint values are another hand's.
pub fn link_poses(hand: &Hand, joints_rad: &[f64]) -> Result<Vec<Vec<f64>>, JointError> {
    Ok(hand.palm_from_links(joints_rad)?.iter().map(|pose: &Isometry3<f64>| rows(pose)).collect())
}

pub(super) fn cells(hand: &Hand) -> Vec<CellData> {
    hand.cells()
        .zip(cells_in_link(hand))
        .map(|((pad_idx, cell), corners)| CellData {
            link: hand.pads[pad_idx].link_idx,
            corners_m: corners.iter().flat_map(point).collect(),
            threshold_newtons: cell.noise_threshold_newtons,
        })
        .collect()
}

pub(super) fn pads(hand: &Hand) -> Vec<PadData> {
    hand.pads.iter().map(|pad| PadData { first_cell: pad.first_cell_idx, n_cells: pad.cells.len() }).collect()
}
