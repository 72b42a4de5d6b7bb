//! What a picture of a grasp shows, put together from what was recorded.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::Serialize;

use super::PictureError;
use super::scene::rounded;
use blindgrasp_mesh::Mesh;
use blindgrasp_messages::{GraspScene, GraspTruth, LiftDecision, Phase, Prediction, Stamped, TactileFrame};
use blindgrasp_stages::hand::Hand;

/// The object's surface, as far as whoever asks for the picture has it.
#[derive(Debug, Clone)]
pub enum ObjectSurface {
    /// In the object's own frame.
    Known(Mesh),
    /// It is drawn without, and says this: why, and what to do.
    Unknown(String),
}

/// A grasp of a recording, as [`grasp_html`](super::grasp_html) draws it.
#[derive(Debug, Clone)]
pub struct RecordedGrasp {
    /// Its number.
    pub grasp_id: u64,
    /// Its frames in order; the last settled one is shown, else the last one, of a hand alone the first one.
    pub frames: Vec<Stamped<TactileFrame>>,
    /// What it really was, where the recording says.
    pub truth: Option<GraspTruth>,
    /// How it came about, where the recording says.
    pub scene: Option<GraspScene>,
    /// The object; drawn only where the scene says where it is.
    pub object: ObjectSurface,
    /// What the classifier said, where the recording says.
    pub prediction: Option<Prediction>,
    /// What the arbiter decided, where the recording says.
    pub decision: Option<LiftDecision>,
    /// Whether this is no grasp, but a hand that is shown by itself.
    pub is_hand_alone: bool,
}

impl RecordedGrasp {
    /// A hand by itself in these postures (joint values), each of its cells pressed by 1 N, so that its normal shows.
    pub fn hand_alone(hand: &Hand, postures: &[Vec<f64>]) -> RecordedGrasp {
        let frame = |joints: &Vec<f64>| TactileFrame {
            phase: Phase::Open,
            joints: joints.clone(),
            cells_newtons: vec![1.0; hand.n_cells()],
            ..TactileFrame::default()
        };
        RecordedGrasp {
            grasp_id: 0,
            frames: postures
                .iter()
                .map(|posture| Stamped { header: Default::default(), message: frame(posture) })
                .collect(),
            truth: None,
            scene: None,
            object: ObjectSurface::Unknown(String::new()),
            prediction: None,
            decision: None,
            is_hand_alone: true,
        }
    }
}

/// What a contact is to the picture; the name is also the style's class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum ContactKind {
    /// With the object, and cells feel it.
    Sensed,
    /// With the object, and no cell feels it.
    Unsensed,
    /// The hand touches itself.
    OnHand,
}

/// The note of a grasp whose recording has no scene.
const NO_SCENE: &str =
    "Object and contacts are not known: there is no /scene for this grasp. Shown are the active cells.";

/// A contact, ready to be drawn.
#[derive(Debug, Serialize)]
pub(super) struct ContactMark {
    kind: ContactKind,
    link: String,
    /// What the link touches: `object`, or another link.
    touches: String,
    /// In the palm frame.
    point_m: [f64; 3],
    inward_normal: [f64; 3],
    force_newtons: f64,
    felt_newtons: f64,
}

/// A grasp whose parts have been checked against the hand and placed in the palm frame.
pub(super) struct Placed<'a> {
    pub(super) hand: &'a Hand,
    pub(super) grasp: &'a RecordedGrasp,
    /// The frame shown.
    pub(super) frame: &'a TactileFrame,
    pub(super) joints: &'a [f64],
    /// Where it is known and given.
    pub(super) object_in_palm: Option<Mesh>,
    pub(super) contacts: Vec<ContactMark>,
    /// What the picture cannot show, and why.
    pub(super) notes: Vec<String>,
    /// The end of the force scale: the largest reading of all frames, rounded up.
    pub(super) scale_newtons: f64,
}

impl<'a> Placed<'a> {
    pub(super) fn new(hand: &'a Hand, grasp: &'a RecordedGrasp) -> Result<Self, PictureError> {
        let grasp_id = grasp.grasp_id;
        for (idx, frame) in grasp.frames.iter().enumerate() {
            let (found, expected) = (frame.message.cells_newtons.len(), hand.n_cells());
            if found != expected {
                return Err(unfit(grasp_id, format!(", frame {idx}: {found} cells, the hand has {expected}")));
            }
            // Every frame is shown in the end: all of them must fit.
            hand.palm_from_links(&frame.message.joints).map_err(|error| unfit(grasp_id, format!(": {error}")))?;
        }
        let settled = grasp.frames.iter().rev().find(|frame| frame.message.phase == Phase::Settled);
        let frame = if grasp.is_hand_alone { grasp.frames.first() } else { settled.or(grasp.frames.last()) }
            .map(|frame| &frame.message)
            .ok_or(unfit(grasp_id, " has no frames: expected at least one".into()))?;
        // The scene's joints are what the contacts belong to; the frame's are rounded by the encoders.
        let joints = grasp.scene.as_ref().map_or(&frame.joints, |scene| &scene.joints);
        hand.palm_from_links(joints).map_err(|error| unfit(grasp_id, format!(": {error}")))?;
        let (mut notes, mut contacts, mut object_in_palm) = (Vec::new(), Vec::new(), None);
        match (&grasp.scene, &grasp.object) {
            (None, _) if grasp.is_hand_alone => {}
            (None, _) => notes.push(NO_SCENE.into()),
            (Some(scene), object) => {
                contacts = contact_marks(hand, scene)?;
                match object {
                    ObjectSurface::Known(mesh) => {
                        let mut mesh = mesh.clone();
                        mesh.transform(&palm_from_object(scene));
                        object_in_palm = Some(mesh);
                    }
                    ObjectSurface::Unknown(why) => notes.push(why.clone()),
                }
            }
        }
        let forces = grasp.frames.iter().flat_map(|frame| &frame.message.cells_newtons);
        let largest = forces.copied().filter(|force| force.is_finite()).fold(0.0, f64::max);
        Ok(Placed { hand, grasp, frame, joints, object_in_palm, contacts, notes, scale_newtons: round_up(largest) })
    }
}

fn unfit(grasp_id: u64, why: String) -> PictureError {
    PictureError::Grasp { grasp_id, why }
}

fn contact_marks(hand: &Hand, scene: &GraspScene) -> Result<Vec<ContactMark>, PictureError> {
    // A contact is felt if it can bring the hand's finest cell above its noise.
    let threshold_newtons = hand.cells().map(|(_, cell)| cell.noise_threshold_newtons).fold(f64::INFINITY, f64::min);
    let last = hand.links.len() - 1;
    let link_name = |idx: i64| match usize::try_from(idx).ok().and_then(|idx| hand.links.get(idx)) {
        Some(link) => Ok(link.name.clone()),
        None => Err(unfit(scene.grasp_id, format!(": a contact of link {idx}, the hand has the links 0 to {last}"))),
    };
    scene
        .contacts
        .iter()
        .map(|contact| {
            let on_hand = contact.other_link >= 0;
            Ok(ContactMark {
                kind: match (on_hand, contact.felt_newtons > threshold_newtons) {
                    (true, _) => ContactKind::OnHand,
                    (false, true) => ContactKind::Sensed,
                    (false, false) => ContactKind::Unsensed,
                },
                link: link_name(contact.link.into())?,
                touches: if on_hand { link_name(contact.other_link.into())? } else { "object".into() },
                point_m: contact.point_m.map(rounded),
                inward_normal: contact.inward_normal.map(rounded),
                force_newtons: rounded(contact.force_newtons),
                felt_newtons: rounded(contact.felt_newtons),
            })
        })
        .collect()
}

pub(super) fn palm_from_object(scene: &GraspScene) -> Isometry3<f64> {
    let [x, y, z, w] = scene.object_rotation_xyzw;
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9).unwrap_or_default();
    Isometry3::from_parts(Translation3::from(scene.object_position_m), rotation)
}

/// The next of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten; 1 for nothing.
fn round_up(newtons: f64) -> f64 {
    if newtons <= 0.0 {
        return 1.0;
    }
    let power = 10_f64.powf(newtons.log10().floor());
    let step = [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0].into_iter().find(|step| step * power >= newtons * (1.0 - 1e-9));
    step.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_end_at_round_numbers() {
        for (largest, expected) in
            [(0.0, 1.0), (0.97, 1.0), (1.0, 1.0), (1.2, 1.5), (2.5, 3.0), (9.1, 10.0), (31.0, 40.0)]
        {
            assert!((round_up(largest) - expected).abs() < 1e-9, "{largest}: {}", round_up(largest));
        }
    }
}
