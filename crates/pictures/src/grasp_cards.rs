//! Grasps of a report, each a card with a small picture, and a 3-D view of the one that is chosen. The page draws them by itself:
//! to render a dozen grasps here takes as many seconds.

use std::fmt::Write;

use serde::Serialize;

use super::PictureError;
use super::grasp::{Placed, RecordedGrasp};
use super::pads::pad_summary;
use super::scene::{HandScene, STAGE_JS, THREE_JS, link_poses, rounded, scale_stops};
use super::svg::escape;
use blindgrasp_stages::hand::Hand;

const SCRIPT: &str = include_str!("../assets/cards.js");

/// The cards of a page, and the frames that its script draws.
pub struct GraspCards<'a> {
    hand: &'a Hand,
    frames: Vec<CardFrame>,
    /// The end of the scale of forces, for all grasps.
    scale_newtons: f64,
}

#[derive(Serialize)]
struct CardFrame {
    grasp_id: String,
    links: Vec<Vec<f64>>,
    cells: Vec<Option<f64>>,
}

#[derive(Serialize)]
struct Data<'a> {
    #[serde(flatten)]
    scene: HandScene,
    frames: &'a [CardFrame],
    scale_newtons: f64,
}

impl<'a> GraspCards<'a> {
    pub fn new(hand: &'a Hand) -> GraspCards<'a> {
        GraspCards { hand, frames: Vec::new(), scale_newtons: 1.0 }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Adds grasps, each at its last settled frame; their cards as HTML.
    ///
    /// # Errors
    /// A frame is not the hand's.
    pub fn add(&mut self, grasps: &[RecordedGrasp]) -> Result<String, PictureError> {
        let mut html = String::from("<div class=\"cards\">\n");
        for grasp in grasps {
            let placed = Placed::new(self.hand, grasp)?;
            let links = link_poses(self.hand, placed.joints)
                .map_err(|source| PictureError::Joints { grasp_id: grasp.grasp_id, source })?;
            let cells = placed.frame.cells_newtons.iter();
            self.scale_newtons = self.scale_newtons.max(placed.scale_newtons);
            // Writing to a string cannot fail.
            let _ = writeln!(
                html,
                "<button type=\"button\" class=\"card\" data-grasp=\"{}\" aria-pressed=\"false\">\
                 <canvas width=\"280\" height=\"210\" aria-hidden=\"true\"></canvas>{}</button>",
                self.frames.len(),
                card_text(&placed)
            );
            self.frames.push(CardFrame {
                grasp_id: grasp.grasp_id.to_string(),
                links,
                cells: cells.map(|force| force.is_finite().then(|| rounded(*force))).collect(),
            });
        }
        html.push_str("</div>\n");
        Ok(html)
    }

    /// The 3-D view of the chosen grasp. It belongs before the cards.
    pub fn view(&self) -> String {
        let unit = self.hand.cell_unit.symbol();
        let colours = scale_stops();
        format!(
            "<div class=\"view\"><canvas id=\"stage\" tabindex=\"0\" role=\"img\" aria-label=\"The hand of the chosen grasp in \
             three dimensions. Drag or arrow keys turn it, plus and minus zoom, Home resets the view.\"></canvas></div>\n\
             <p id=\"chosen\" class=\"caption\"></p>\n<p class=\"caption\">Force of a cell: 0 <span class=\"bar\" \
             style=\"background:linear-gradient(to right,{colours})\"></span> {} {unit}. The axes are those of the palm.</p>\n\
             <p id=\"without-webgl\" class=\"caption\" hidden>This browser has no WebGL: the hand cannot be drawn.</p>\n\
             <noscript><p class=\"caption\">Pictures need JavaScript.</p></noscript>\n",
            self.scale_newtons
        )
    }

    /// The scripts that draw. They belong at the end of the page.
    ///
    /// # Errors
    /// The data cannot be written as JSON.
    pub fn scripts(&self) -> Result<String, PictureError> {
        let data = Data { scene: HandScene::new(self.hand), frames: &self.frames, scale_newtons: self.scale_newtons };
        let data = serde_json::to_string(&data).map_err(|source| PictureError::Data { source })?;
        Ok(format!(
            "<script type=\"application/json\" id=\"grasps\">{}</script>\n\
             <script type=\"text/plain\" id=\"three.js\">{THREE_JS}</script>\n\
             <script type=\"text/plain\" id=\"stage.js\">{STAGE_JS}</script>\n\
             <script type=\"module\">\n{SCRIPT}</script>\n",
            // A name in the data must not end the script.
            data.replace('<', "\\u003c"),
        ))
    }
}

/// The decision, the label, and the force of each pad.
fn card_text(placed: &Placed<'_>) -> String {
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
    let hand = placed.hand;
    let pads = hand
        .pads
        .iter()
        .map(|pad| format!("{}: {}", pad.name.replace('_', " "), pad_summary(placed.frame, pad, hand.cell_unit)));
    lines.extend(pads);
    let lines: String = lines.iter().map(|line| format!("<span>{}</span>", escape(line))).collect();
    format!("<b>Grasp {}</b>{lines}", grasp.grasp_id)
}
