//! Pictures: what people would rather look at than read.
//!
//! ```
//! use blindgrasp_pictures::{DrawnEdge, DrawnGraph, DrawnNode, graph_mermaid};
//!
//! let node = |name: &str| DrawnNode { name: name.into(), ..DrawnNode::default() };
//! let graph = DrawnGraph {
//!     title: "two".into(),
//!     nodes: vec![node("source"), node("contacts")],
//!     edges: vec![DrawnEdge { from: 0, to: 1, ..DrawnEdge::default() }],
//!     ..DrawnGraph::default()
//! };
//! assert!(graph_mermaid(&graph).contains("contacts"));
//! ```
//!
//! * [`grasp_svg`] - a grasp: the hand on the object from two sides, its contacts with their normals and forces, what
//!   each pad feels, and what is known of the grasp. One file, no script, a light card that dark pages show as it is.
//! * [`grasp_html`] - the same, and the grasp in three dimensions to turn by hand, with a slider over its frames. One
//!   file that asks the network for nothing.
//! * [`animation_svg`] - grasps as a moving picture, with the probability and the decision.
//! * [`HandScene`], [`link_poses`] - a hand for a page that draws it frame by frame, with [`STAGE_JS`] and [`THREE_JS`].
//! * [`posed_scene_images`] - a hand and a thing on a post, moment by moment, by one camera.
//! * [`dictionary_svg`] - a contact dictionary over the hand.
//! * [`graph_mermaid`], [`graph_dot`] - a graph of processes.
//! * [`report_html`] - a report as a page that draws its data by itself, with charts by [`CHART_JS`].
//! * [`GraspCards`] - grasps that such a page draws.
//!
//! Surfaces are rendered here, by a small z-buffered rasteriser (no graphics card, no fonts), and embedded as PNG; what
//! must be sharp or read (arrows, numbers, text) lies over them as vectors. The same input gives the same
//! bytes.
//!
//! Not here: reading recordings or object files, which is the caller's. Links are drawn as their collision shapes, the
//! only geometry that a hand's description here has.

mod animation;
mod colour;
mod dictionary_picture;
mod geometry;
mod graph;
mod grasp;
mod grasp_cards;
mod grasp_picture;
mod html;
mod pads;
mod png_image;
mod posed_scene;
mod raster;
mod report;
mod scene;
mod svg;
mod view;

#[cfg(test)]
mod tests;

pub use animation::{AnimatedGrasp, animation_svg};
pub use dictionary_picture::{DrawnWord, dictionary_svg};
pub use graph::{DrawnEdge, DrawnGraph, DrawnGroup, DrawnNode, graph_dot, graph_mermaid};
pub use grasp::{ObjectSurface, RecordedGrasp};
pub use grasp_cards::GraspCards;
pub use grasp_picture::grasp_svg;
pub use html::grasp_html;
pub use posed_scene::{PosedScene, posed_scene_images};
pub use report::{CHART_JS, ReportKind, report_html};
pub use scene::{HandScene, ObjectScene, STAGE_JS, THREE_JS, link_poses};

use blindgrasp_stages::hand::JointError;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// Nothing was recorded of the grasp.
    #[error("grasp {grasp_id} has no frames: expected at least one")]
    NoFrames {
        /// The grasp.
        grasp_id: u64,
    },
    /// The frames are not the hand's.
    #[error("grasp {grasp_id}, frame {idx}: {found} cells, the hand has {expected}")]
    Cells {
        /// The grasp.
        grasp_id: u64,
        /// Which of its frames.
        idx: usize,
        /// Readings found.
        found: usize,
        /// The hand's cells.
        expected: usize,
    },
    /// The joint angles are not the hand's.
    #[error("grasp {grasp_id}")]
    Joints {
        /// The grasp.
        grasp_id: u64,
        /// What is wrong with them.
        source: JointError,
    },
    /// The scene names a link that the hand doesn't have.
    #[error("grasp {grasp_id}: a contact of link {found}, the hand has the links 0 to {}", n_links - 1)]
    Link {
        /// The grasp.
        grasp_id: u64,
        /// The index found.
        found: i64,
        /// How many links the hand has.
        n_links: usize,
    },
    /// No objects.
    #[error("no objects to draw: expected at least one")]
    NoObjects,
    /// The page's data could not be written as JSON.
    #[error("could not write the page's data")]
    Data {
        /// The reason.
        source: serde_json::Error,
    },
    /// The image could not be encoded.
    #[error("could not encode an image as PNG")]
    Png(#[from] png::EncodingError),
}
