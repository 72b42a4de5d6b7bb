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
//! * [`grasp_html`] - a grasp, or a hand by itself: in three dimensions, to turn by hand, with a slider over its frames, what
//!   each pad feels, the contacts, and the things that are known. One file that asks the network for nothing.
//! * [`HandScene`], [`link_poses`] - a hand for a page that draws it frame by frame, with [`STAGE_JS`] and [`THREE_JS`].
//! * [`dictionary_svg`] - a contact dictionary over the hand.
//! * [`graph_mermaid`], [`graph_dot`] - a graph of processes.
//! * [`report_html`] - a report as a page that draws its data by itself, with charts by [`CHART_JS`].
//! * [`DrawnFrames`] - the frames of a grasp, or moments of a lift, that such a page draws.
//!
//! Hands are drawn in the browser alone, by three.js; the page saves a picture of them as PNG. The same input gives the same
//! bytes.
//!
//! Not here: reading recordings or object files, which is the caller's. Links are drawn as their collision shapes, the
//! only geometry that a hand's description here has.

mod colour;
mod dictionary_picture;
mod frames;
mod geometry;
mod graph;
mod grasp;
mod grasp_page;
mod pads;
mod report;
mod scene;

#[cfg(test)]
mod tests;

pub use dictionary_picture::{DrawnWord, dictionary_svg};
pub use frames::{DrawnFrames, PosedScene};
pub use graph::{DrawnEdge, DrawnGraph, DrawnGroup, DrawnNode, graph_dot, graph_mermaid};
pub use grasp::{ObjectSurface, RecordedGrasp};
pub use grasp_page::grasp_html;
pub use report::{CHART_JS, ReportKind, report_html};
pub use scene::{HandScene, ObjectScene, STAGE_JS, THREE_JS, link_poses};

use blindgrasp_stages::hand::JointError;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The joint angles are not the hand's.
    #[error(transparent)]
    Joints(#[from] JointError),
    /// The frames or the scene are not the hand's, or nothing was recorded of the grasp.
    #[error("grasp {grasp_id}{why}")]
    Grasp { grasp_id: u64, why: String },
    /// The page's data could not be written as JSON.
    #[error("could not write the page's data")]
    Data(#[from] serde_json::Error),
}
