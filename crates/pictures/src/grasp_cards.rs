//! Grasps of a report, each a card with a small picture, and a 3-D view of the one that is chosen. The page draws them by itself:
//! to render a dozen grasps here takes as many seconds.

use serde::Serialize;

use super::PictureError;
use super::grasp::{Placed, RecordedGrasp};
use super::pads::pad_summary;
use super::scene::{HandScene, link_poses, rounded};
use blindgrasp_stages::hand::Hand;

/// The grasps, each at its last settled frame, as the page's script draws them.
#[derive(Serialize)]
pub struct GraspCards {
    #[serde(flatten)]
    scene: HandScene,
    frames: Vec<CardFrame>,
    /// The end of the scale of forces, for all grasps.
    scale_newtons: f64,
}

#[derive(Serialize)]
struct CardFrame {
    grasp_id: String,
    /// The decision, the label, and the force of each pad.
    lines: Vec<String>,
    links: Vec<Vec<f64>>,
    cells: Vec<Option<f64>>,
}

impl GraspCards {
    /// # Errors
    /// A frame is not the hand's.
    pub fn new<'a>(
        hand: &Hand,
        grasps: impl IntoIterator<Item = &'a RecordedGrasp>,
    ) -> Result<GraspCards, PictureError> {
        let mut cards = GraspCards { scene: HandScene::new(hand), frames: Vec::new(), scale_newtons: 1.0 };
        for grasp in grasps {
            let placed = Placed::new(hand, grasp)?;
            let links = link_poses(hand, placed.joints)
                .map_err(|source| PictureError::Joints { grasp_id: grasp.grasp_id, source })?;
            cards.scale_newtons = cards.scale_newtons.max(placed.scale_newtons);
            let cells = placed.frame.cells_newtons.iter();
            cards.frames.push(CardFrame {
                grasp_id: grasp.grasp_id.to_string(),
                lines: card_lines(&placed),
                links,
                cells: cells.map(|force| force.is_finite().then(|| rounded(*force))).collect(),
            });
        }
        Ok(cards)
    }
}

fn card_lines(placed: &Placed<'_>) -> Vec<String> {
    let grasp = placed.grasp;
    let mut lines = Vec::new();
    if let Some(decision) = &grasp.decision {
        let action = decision.action.as_str();
        let reason = decision.reason.as_str().replace('_', " ");
        lines.push(format!("{action}: {reason}, probability {:.2}", decision.probability_stable));
    }
    if let Some(truth) = &grasp.truth {
        let label = if truth.stable { "known to be stable" } else { "known to be unstable" };
        let object = if truth.object.is_empty() { String::new() } else { format!("; object {}", truth.object) };
        lines.push(format!("{label}{object}"));
    }
    for pad in &placed.hand.pads {
        let felt = pad_summary(placed.frame, pad, placed.hand.cell_unit);
        lines.push(format!("{}: {felt}", pad.name.replace('_', " ")));
    }
    lines
}
