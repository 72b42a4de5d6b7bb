//! Pictures of recorded grasps: the hand, the object, the contacts and the cells.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::Path;

use anyhow::{Context, bail};

use super::super::{Outcome, check_output, print_line, write_out};
use super::GraspArguments;
use blindgrasp_cli::houses::LAB;
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_mesh::Mesh;
use blindgrasp_messages::Phase;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_pictures::{ObjectSurface, RecordedGrasp, grasp_html};
use blindgrasp_recording::{Record, RecordingReader};
use blindgrasp_stages::{Hand, Judge, Model};

pub(super) fn draw(recording: &Path, out: &Path, arguments: &GraspArguments) -> anyhow::Result<Outcome> {
    check_output(out, &[recording.to_owned()])?;
    check_html(out)?;
    let hand = hand_of(recording, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let mut grasp = read_grasp(recording, arguments.grasp)?;
    grasp.object = surface(&grasp, arguments.objects.as_deref())?;
    write_out(out, &grasp_html(&hand, &grasp)?)?;
    print_line(&format!("grasp {} drawn to {}", grasp.grasp_id, out.display()))?;
    Ok(Outcome::Done)
}

/// Judges grasps of this hand by a model.
pub(super) fn judge_of(model: &Path, hand: &Hand) -> anyhow::Result<Judge> {
    let judge = Judge::new(hand.clone(), Model::load(model)?);
    judge.with_context(|| model.display().to_string())
}

/// Refuses a file that is no page.
pub(super) fn check_html(out: &Path) -> anyhow::Result<()> {
    let extension = out.extension().and_then(OsStr::to_str).unwrap_or_default();
    if !["html", "htm"].contains(&extension.to_lowercase().as_str()) {
        bail!("{}: expected a name that ends in .html: the page saves a picture (PNG)", out.display());
    }
    Ok(())
}

/// All that a recording says of a grasp, but for the object's surface.
fn read_grasp(path: &Path, wanted: Option<u64>) -> anyhow::Result<RecordedGrasp> {
    let mut found = RecordedGrasp {
        grasp_id: 0,
        frames: Vec::new(),
        truth: None,
        scene: None,
        object: ObjectSurface::Unknown(String::new()),
        prediction: None,
        decision: None,
        is_hand_alone: false,
    };
    let wanted_id = match wanted {
        Some(grasp_id) => Some(grasp_id),
        None => first_grasp_id(path)?,
    };
    let mut grasp_ids = BTreeSet::new();
    for record in RecordingReader::open(path)? {
        let record = record?.1;
        match record {
            Record::Tactile(frame) => {
                grasp_ids.insert(frame.message.grasp_id);
                if Some(frame.message.grasp_id) == wanted_id {
                    found.frames.push(frame);
                }
            }
            Record::Truth(truth) if Some(truth.message.grasp_id) == wanted_id => found.truth = Some(truth.message),
            Record::Scene(scene) if Some(scene.message.grasp_id) == wanted_id => found.scene = Some(scene.message),
            // The last one of a settled frame is what the picture's frame was told.
            Record::Prediction(prediction) if Some(prediction.message.grasp_id) == wanted_id => {
                let has_settled = found.prediction.as_ref().is_some_and(|last| last.phase == Phase::Settled);
                if prediction.message.phase == Phase::Settled || !has_settled {
                    found.prediction = Some(prediction.message);
                }
            }
            Record::Decision(decision)
                if Some(decision.message.grasp_id) == wanted_id
                    && (decision.message.action.decides() || found.decision.is_none()) =>
            {
                found.decision = Some(decision.message);
            }
            _ => {}
        }
    }
    let (Some(grasp_id), Some(first), Some(last)) = (wanted_id, grasp_ids.first(), grasp_ids.last()) else {
        bail!("{} holds no frames on /tactile: there is no grasp to draw", path.display());
    };
    if found.frames.is_empty() {
        let n = grasp_ids.len();
        let gaps = if n as u64 == last - first + 1 { "" } else { ", with gaps" };
        bail!("{} has no grasp {grasp_id}: it holds {}, {first} to {last}{gaps}", path.display(), counted(n, "grasp"));
    }
    found.grasp_id = grasp_id;
    Ok(found)
}

fn first_grasp_id(path: &Path) -> anyhow::Result<Option<u64>> {
    for record in RecordingReader::open(path)? {
        if let Record::Tactile(frame) = record?.1 {
            return Ok(Some(frame.message.grasp_id));
        }
    }
    Ok(None)
}

/// The surface of the object that the grasp's truth names.
fn surface(grasp: &RecordedGrasp, folder: Option<&Path>) -> anyhow::Result<ObjectSurface> {
    let name = grasp.truth.as_ref().map_or("", |truth| truth.object.as_str());
    if name.is_empty() {
        let reason = "The object is not drawn: the recording does not say which it was.";
        return Ok(ObjectSurface::Unknown(reason.into()));
    }
    if let Err(missing) = LAB.path() {
        return Ok(ObjectSurface::Unknown(format!("The object '{name}' is not drawn: {missing}.")));
    }
    Ok(match (find_mesh(name, folder)?, folder) {
        (Some(mesh), _) => ObjectSurface::Known(mesh),
        (None, None) => ObjectSurface::Unknown(format!(
            "The object '{name}' is not drawn: it is no built-in one (--objects names the folder of its mesh)."
        )),
        (None, Some(folder)) => {
            ObjectSurface::Unknown(format!("The object '{name}' is not drawn: {} does not have it.", folder.display()))
        }
    })
}

/// The mesh of an object: the folder's if one is given, else the built-in one of that name. `None` without the lab's program, which
/// has them.
///
/// # Errors
/// A folder or a mesh cannot be read.
pub(super) fn find_mesh(name: &str, folder: Option<&Path>) -> anyhow::Result<Option<Mesh>> {
    if LAB.path().is_err() {
        return Ok(None);
    }
    let mut arguments = vec![OsStr::new("mesh")];
    if let Some(folder) = folder {
        arguments.extend([OsStr::new("--objects"), folder.as_os_str()]);
    }
    // A stranger's recording may name its object like an option.
    arguments.extend([OsStr::new("--"), OsStr::new(name)]);
    serde_json::from_slice(&LAB.answer(arguments)?).context("the mesh of an object")
}
