//! A grasp, or a hand by itself, as a page: to turn by hand, its frames in time, its pads, contacts and joints.

use serde::Serialize;

use super::grasp::{ContactMark, Placed, RecordedGrasp};
use super::pads::{FlatPad, flatten};
use super::scene::ObjectScene;
use super::{DrawnFrames, PictureError, ReportKind, report_html};
use blindgrasp_messages::Fault;
use blindgrasp_stages::hand::Hand;

/// More frames than this are thinned out evenly: a robot's recording may hold minutes.
const MOST_FRAMES: usize = 150;

/// The page's script draws from this, and from the frames.
#[derive(Serialize)]
struct GraspPage<'a> {
    title: String,
    is_hand_alone: bool,
    /// Names and values.
    facts: Vec<(&'static str, String)>,
    notes: &'a [String],
    object: Option<ObjectScene>,
    contacts: &'a [ContactMark],
    /// Whether the contacts are there in a frame: they are those of the closed hand.
    is_closed: Vec<bool>,
    /// The frame that is shown first.
    shown: usize,
    flat_pads: Vec<FlatPad>,
    joints: Vec<ShownJoint<'a>>,
}

/// A joint of the frame that is shown first.
#[derive(Serialize)]
struct ShownJoint<'a> {
    name: &'a str,
    value: f64,
    lower: f64,
    upper: f64,
    unit: &'static str,
}

/// A grasp as an HTML page that needs nothing else.
///
/// # Errors
/// Frames, joints or contacts that are not this hand's.
pub fn grasp_html(hand: &Hand, grasp: &RecordedGrasp) -> Result<String, PictureError> {
    let placed = Placed::new(hand, grasp)?;
    let all = &grasp.frames;
    let shown = all.iter().position(|frame| std::ptr::eq(&frame.message, placed.frame)).unwrap_or(0);
    let step = all.len().div_ceil(MOST_FRAMES).max(1);
    // Counted from the frame shown, so that it is never thinned out.
    let chosen: Vec<usize> = (shown % step..all.len()).step_by(step).collect();
    let page = GraspPage {
        title: title(&placed),
        is_hand_alone: grasp.is_hand_alone,
        facts: facts(&placed),
        notes: &placed.notes,
        object: placed.object_in_palm.as_ref().map(ObjectScene::placed),
        contacts: &placed.contacts,
        is_closed: chosen.iter().map(|idx| all[*idx].message.phase == placed.frame.phase).collect(),
        shown: shown / step,
        flat_pads: hand.pads.iter().map(flatten).collect(),
        joints: joints(&placed),
    };
    report_html(ReportKind::Grasp, &page, Some(&DrawnFrames::of_grasp(&placed, &chosen)?))
}

fn title(placed: &Placed<'_>) -> String {
    let grasp = placed.grasp;
    match &grasp.truth {
        _ if grasp.is_hand_alone => format!("Hand {}", placed.hand.name),
        Some(truth) => format!("Grasp {} of {}", grasp.grasp_id, truth.object),
        None => format!("Grasp {}", grasp.grasp_id),
    }
}

/// The things that are known of the grasp.
fn facts(placed: &Placed<'_>) -> Vec<(&'static str, String)> {
    let (grasp, hand) = (placed.grasp, placed.hand);
    if grasp.is_hand_alone {
        let [joints, pads, cells] = [hand.joints.len(), hand.pads.len(), hand.n_cells()].map(|n| n.to_string());
        return vec![("joints", joints), ("pads", pads), ("cells", cells)];
    }
    let mut facts = Vec::new();
    let mut label = "not labelled";
    if let Some(truth) = &grasp.truth {
        label = if truth.stable { "stable" } else { "unstable" };
        facts.push(("class", truth.object_class.clone()));
        // NaN where nobody computed them.
        if !truth.epsilon.is_nan() {
            let note = if truth.epsilon < 0.0 { " (no force closure)" } else { "" };
            facts.push(("epsilon", format!("{:.4}{note}", truth.epsilon)));
            facts.push(("volume", format!("{:.3e}", truth.volume)));
        }
    }
    facts.insert(0, ("true label", label.into()));
    if let Some(prediction) = &grasp.prediction {
        let text = match prediction.fault {
            Fault::None => format!("p(stable) {:.2}", prediction.probability_stable),
            fault => fault.as_str().replace('_', " "),
        };
        facts.push(("predicted", text));
    }
    if let Some(decision) = &grasp.decision {
        let reason = decision.reason.as_str().replace('_', " ");
        facts.push(("decided", format!("{}: {reason}", decision.action.as_str())));
    }
    facts.push(("hand", hand.name.clone()));
    if let Some(scene) = &grasp.scene {
        facts.push(("object", format!("{:.0} g, friction {:.2}", 1000.0 * scene.mass_kg, scene.friction)));
    }
    facts
}

fn joints<'a>(placed: &Placed<'a>) -> Vec<ShownJoint<'a>> {
    let mut shown = Vec::new();
    for (joint, value) in placed.hand.joints.iter().zip(placed.joints) {
        let unit = joint.kind.unit();
        shown.push(ShownJoint { name: &joint.name, value: *value, lower: joint.lower, upper: joint.upper, unit });
    }
    shown
}
