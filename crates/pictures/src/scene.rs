//! A hand as a page draws it in three dimensions: its surfaces once, its posture frame by frame.

use nalgebra::{Isometry3, Point3};
use serde::Serialize;

use super::colour::{HAND, OBJECT, Rgb, SILENT_CELL, bytes, force_colour};
use super::geometry::{cells_in_link, link_mesh};
use super::grasp::palm_from_object;
use blindgrasp_mesh::Mesh;
use blindgrasp_messages::GraspScene;
use blindgrasp_stages::hand::{Hand, JointError};

/// The parts of three.js that pages use, as a module.
pub const THREE_JS: &str = include_str!("../assets/three.js");
/// Draws a [`HandScene`] with three.js, frame by frame.
pub const STAGE_JS: &str = include_str!("../assets/stage.js");
/// Colours of the scale of forces.
const N_COLOURS: usize = 64;

#[derive(Serialize)]
pub(super) struct Surface {
    positions_m: Vec<f64>,
    triangles: Vec<u32>,
    /// None for the hand's.
    colour: Option<[u8; 3]>,
}

impl Surface {
    fn new(mesh: &Mesh) -> Surface {
        Surface {
            positions_m: mesh.vertices_m.iter().flat_map(point).collect(),
            triangles: mesh.triangles.iter().flatten().copied().collect(),
            colour: None,
        }
    }

    pub(super) fn coloured(mesh: &Mesh, colour: Rgb) -> Surface {
        Surface { colour: Some(bytes(colour)), ..Surface::new(mesh) }
    }
}

#[derive(Serialize)]
struct CellData {
    link: usize,
    corners_m: Vec<f64>,
    threshold_newtons: f64,
}

#[derive(Serialize)]
struct PadData {
    first_cell: usize,
    n_cells: usize,
}

/// The parts of a hand that do not change. Lengths in metres, to hundredths of a millimetre.
#[derive(Serialize)]
pub struct HandScene {
    hand: String,
    /// Those of the hand; other things may follow.
    pub(super) links: Vec<Surface>,
    cells: Vec<CellData>,
    pads: Vec<PadData>,
    /// The names of the pads.
    pad_names: Vec<String>,
    joints: Vec<String>,
    /// The unit of each joint.
    joint_units: Vec<&'static str>,
    cell_unit: &'static str,
    colours: Vec<[u8; 3]>,
    hand_colour: [u8; 3],
    silent_colour: [u8; 3],
}

impl HandScene {
    pub fn new(hand: &Hand) -> HandScene {
        HandScene {
            hand: hand.name.clone(),
            links: hand.links.iter().map(|link| Surface::new(&link_mesh(link))).collect(),
            cells: cells(hand),
            pads: pads(hand),
            pad_names: hand.pads.iter().map(|pad| pad.name.clone()).collect(),
            joints: hand.joints.iter().map(|joint| joint.name.clone()).collect(),
            joint_units: hand.joints.iter().map(|joint| joint.kind.unit()).collect(),
            cell_unit: hand.cell_unit.symbol(),
            colours: scale_colours(),
            hand_colour: bytes(HAND),
            silent_colour: bytes(SILENT_CELL),
        }
    }
}

/// The surface of an object in the palm frame, where the scene of a grasp has it.
#[derive(Serialize)]
#[serde(transparent)]
pub struct ObjectScene(Surface);

impl ObjectScene {
    pub fn new(mesh: &Mesh, scene: &GraspScene) -> ObjectScene {
        let mut mesh = mesh.clone();
        mesh.transform(&palm_from_object(scene));
        Self::placed(&mesh)
    }

    /// Of a surface that is in the palm frame already.
    pub(super) fn placed(mesh: &Mesh) -> ObjectScene {
        ObjectScene(Surface::coloured(mesh, OBJECT))
    }
}

/// The pose of each link in the palm frame: the upper three rows of its matrix, row by row.
///
/// # Errors
/// The joint values are another hand's.
pub fn link_poses(hand: &Hand, joints: &[f64]) -> Result<Vec<Vec<f64>>, JointError> {
    Ok(hand.palm_from_links(joints)?.iter().map(|pose: &Isometry3<f64>| rows(pose)).collect())
}

/// The colours of the scale of forces.
fn scale_colours() -> Vec<[u8; 3]> {
    let colours = (0..N_COLOURS).map(|idx| force_colour(idx as f64 / (N_COLOURS - 1) as f64));
    colours.map(|colour: Rgb| bytes(colour)).collect()
}

fn cells(hand: &Hand) -> Vec<CellData> {
    hand.cells()
        .zip(cells_in_link(hand))
        .map(|((pad_idx, cell), corners)| CellData {
            link: hand.pads[pad_idx].link_idx,
            corners_m: corners.iter().flat_map(point).collect(),
            threshold_newtons: cell.noise_threshold_newtons,
        })
        .collect()
}

fn pads(hand: &Hand) -> Vec<PadData> {
    hand.pads.iter().map(|pad| PadData { first_cell: pad.first_cell_idx, n_cells: pad.cells.len() }).collect()
}

pub(super) fn point(point: &Point3<f64>) -> [f64; 3] {
    point.coords.map(rounded).into()
}

/// The upper three rows of the matrix of a pose, row by row.
pub(super) fn rows(palm_from_link: &Isometry3<f64>) -> Vec<f64> {
    let matrix = palm_from_link.to_homogeneous();
    (0..12).map(|idx| rounded(matrix[(idx / 4, idx % 4)])).collect()
}

/// To five decimals.
pub(super) fn rounded(value: f64) -> f64 {
    (value * 1e5).round() / 1e5 + 0.0
}
