//! The page of a recording: its grasps with their decisions, each frame by frame.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::bail;
use blindgrasp_grasps::dataset::hand_of;
use blindgrasp_grasps::decide::decide_alone;
use blindgrasp_messages::{Action, ContactSet, GraspTruth, LiftDecision, Phase, Recorded as _, Stamped, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_pictures::{HandScene, ObjectScene};
use blindgrasp_recording::{ChosenSamples, Reach, Record};
use blindgrasp_stages::{Hand, Judge};
use blindgrasp_viewer::{Abilities, Grasps, Viewer};
use serde::Serialize;
use serde_json::{Value, json};

use super::super::{Outcome, print_line, stop_signal};
use super::GraspArguments;
use super::grasp::{find_mesh, judge_of};
use super::live::{GraspKey, add_frame, shadow_event};

const POLL: Duration = Duration::from_millis(100);
/// Of a grasp with more frames, every nth is shown: a robot may hold an object for minutes.
const MAX_FRAMES: u64 = 2000;
/// And with more readings of cells in all.
const MAX_READINGS: u64 = 2_000_000;

/// Samples that belong to a frame are written at most so much later, by the recorded time: operators may be far behind a source
/// that sends as fast as it can.
const BEHIND_NANOS: u64 = 60_000_000_000;

/// A grasp in the list of the page.
#[derive(Debug, Clone, Serialize, Default)]
struct Listed {
    /// Its number, as text: JavaScript has no integers beyond 2^53.
    id: String,
    /// The number of its run of the source in the recording.
    epoch: String,
    n_frames: u64,
    action: Option<Action>,
    reason: Option<&'static str>,
    probability_stable: Option<f64>,
    /// Whether it was stable, if the recording tells.
    truth: Option<bool>,
    object: String,
    #[serde(skip)]
    stamps_nanos: [u64; 2],
    /// The stamp of the frame that decided.
    #[serde(skip)]
    decided_nanos: Option<u64>,
}

/// Serves the page until the command is interrupted.
pub(super) fn show(
    recording: &Path,
    port: u16,
    arguments: &GraspArguments,
    shadow: Option<&Path>,
) -> anyhow::Result<Outcome> {
    let stop = stop_signal()?;
    let hand = hand_of(recording, arguments.hand.as_deref())?;
    hand.warnings().iter().for_each(|warning| print_diagnostic(warning));
    let list = list(recording)?;
    if list.is_empty() {
        bail!("{} holds no frames on /tactile: there is no grasp to show", recording.display());
    }
    let first = match arguments.grasp {
        None => 0,
        Some(id) => list.keys().position(|(_, known)| *known == id).ok_or_else(|| {
            anyhow::anyhow!("{} has no grasp {id}: it has {}", recording.display(), counted(list.len(), "grasp"))
        })?,
    };
    let scene = serde_json::to_string(&HandScene::new(&hand))?;
    let about =
        json!({"file": recording.display().to_string(), "first": first, "grasps": list.values().collect::<Vec<_>>()});
    let shadow = shadow.map(|model| judge_of(model, &hand)).transpose()?;
    let objects = arguments.objects.clone();
    let mut reading = ShownReading { recording: recording.into(), objects, hand, list, shadow };
    let grasps: Grasps = Box::new(move |idx| reading.grasp(idx).map_err(|error| format!("{error:#}")));
    let viewer = Viewer::serve(port, Abilities { grasps: Some(grasps), ..Abilities::default() })?;
    viewer.keep("scene", &scene);
    viewer.keep("recording", &about.to_string());
    let address = viewer.address();
    print_diagnostic(&format!("shows {} in a browser on this machine: {address}", recording.display()));
    print_line(&address)?;
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(POLL);
    }
    viewer.finish("blindgrasp view has ended: the page can show no other grasp");
    Ok(Outcome::Done)
}

/// The grasps of a recording by the epoch of their source, and number.
fn list(recording: &Path) -> anyhow::Result<BTreeMap<GraspKey, Listed>> {
    let wanted =
        |_: &str, schema: &str| [TactileFrame::SCHEMA, GraspTruth::SCHEMA, LiftDecision::SCHEMA].contains(&schema);
    let mut samples = ChosenSamples::open(recording, Box::new(wanted), Reach::ByIndex)?;
    let mut list: BTreeMap<GraspKey, Listed> = BTreeMap::new();
    while let Some(sample) = samples.advance()? {
        let stamp = sample.header.stamp_nanos;
        let grasp = list.entry((sample.header.epoch, sample.grasp_id)).or_insert_with(|| Listed {
            id: sample.grasp_id.to_string(),
            stamps_nanos: [stamp; 2],
            ..Listed::default()
        });
        grasp.stamps_nanos = [grasp.stamps_nanos[0].min(stamp), grasp.stamps_nanos[1].max(stamp)];
        if sample.schema == TactileFrame::SCHEMA {
            grasp.n_frames += 1;
            continue;
        }
        match samples.decode(&sample)? {
            Record::Truth(truth) => {
                grasp.truth = Some(truth.message.stable);
                grasp.object = truth.message.object;
            }
            Record::Decision(decision) if decision.message.action.decides() || grasp.action.is_none() => {
                grasp.decided_nanos = Some(decision.header.stamp_nanos);
                grasp.action = Some(decision.message.action);
                grasp.reason = Some(decision.message.reason.as_str());
                grasp.probability_stable = Some(decision.message.probability_stable);
            }
            _ => {}
        }
    }
    list.retain(|_, grasp| grasp.n_frames > 0);
    let epochs: BTreeSet<u64> = list.keys().map(|(epoch, _)| *epoch).collect();
    for ((epoch, _), grasp) in &mut list {
        grasp.epoch = (1 + epochs.range(..epoch).count()).to_string();
    }
    Ok(list)
}

/// A recording whose grasps are read one by one.
struct ShownReading {
    recording: PathBuf,
    objects: Option<PathBuf>,
    hand: Hand,
    list: BTreeMap<GraspKey, Listed>,
    /// Judges the grasps as well.
    shadow: Option<Judge>,
}

/// The samples of a grasp.
#[derive(Default)]
struct Samples {
    frames: Vec<Stamped<TactileFrame>>,
    contacts: BTreeMap<u64, ContactSet>,
    probabilities: BTreeMap<u64, f64>,
    object: Option<ObjectScene>,
}

impl ShownReading {
    /// The frames of a grasp, with contacts and probability where the recording has them, and the object.
    fn grasp(&mut self, idx: usize) -> anyhow::Result<String> {
        let Some((key, listed)) = self.list.iter().nth(idx) else {
            bail!("the recording has {}", counted(self.list.len(), "grasp"))
        };
        let most = MAX_FRAMES.min(MAX_READINGS / self.hand.n_cells().max(1) as u64).max(1);
        let step = listed.n_frames.div_ceil(most).max(1);
        let Samples { frames, contacts, probabilities, object } = self.samples(*key, listed, step)?;
        // Of a thinned out grasp, the gaps would decide.
        let shadow = match &mut self.shadow {
            Some(judge) if step == 1 => Some(decide_alone(judge, &frames)),
            _ => None,
        };
        let decided = decided_at(&frames, listed.decided_nanos);
        let start_nanos = frames.first().map_or(0, |frame| frame.header.stamp_nanos);
        let events = frames.iter().enumerate().map(|(idx, Stamped { header, message })| {
            let mut event = json!({
                "since_start_ms": header.stamp_nanos.saturating_sub(start_nanos) as f64 / 1e6,
                "probability": probabilities.get(&header.seq),
                "shadow": shadow.as_ref().map(|shadow| shadow.predictions[idx].probability_stable),
            });
            add_frame(&mut event, &self.hand, message, contacts.get(&header.seq));
            event
        });
        let events: Vec<Value> = events.collect();
        let decision = shadow.as_ref().and_then(|shadow| shadow.decision.as_ref()).map(shadow_event);
        Ok(json!({"step": step, "frames": events, "decided": decided, "object": object, "shadow": decision})
            .to_string())
    }

    /// Every `step`th frame of a grasp, and what belongs to these.
    fn samples(&self, key: GraspKey, listed: &Listed, step: u64) -> anyhow::Result<Samples> {
        let mesh = if listed.object.is_empty() { None } else { find_mesh(&listed.object, self.objects.as_deref())? };
        let mut samples = ChosenSamples::open(&self.recording, Box::new(|_, _| true), Reach::ByIndex)?;
        samples.skip_to(listed.stamps_nanos[0]);
        let (mut found, mut n_frames) = (Samples::default(), 0_u64);
        while let Some(sample) = samples.advance()? {
            let is_past = sample.header.stamp_nanos > listed.stamps_nanos[1].saturating_add(BEHIND_NANOS);
            if n_frames == listed.n_frames && is_past {
                break;
            }
            if (sample.header.epoch, sample.grasp_id) != key {
                continue;
            }
            n_frames += u64::from(sample.schema == TactileFrame::SCHEMA);
            // By number: contacts and predictions may be written before their frame.
            let is_chosen = sample.header.seq % step == 0;
            match samples.decode(&sample)? {
                Record::Tactile(frame) if is_chosen => {
                    found.frames.push(frame);
                }
                Record::Contacts(contacts) if is_chosen => {
                    found.contacts.insert(contacts.header.seq, contacts.message);
                }
                Record::Prediction(prediction) if is_chosen => {
                    found.probabilities.insert(prediction.header.seq, prediction.message.probability_stable);
                }
                Record::Scene(scene) => {
                    found.object = mesh.as_ref().map(|mesh| ObjectScene::new(mesh, &scene.message));
                }
                _ => {}
            }
        }
        Ok(found)
    }
}

/// The frame that decided: the last one that was not stamped later than the decision. Without a decision it is the last frame of the
/// settled hand, if there is one.
fn decided_at(frames: &[Stamped<TactileFrame>], decided_nanos: Option<u64>) -> Option<usize> {
    match decided_nanos {
        Some(nanos) => frames.iter().rposition(|frame| frame.header.stamp_nanos <= nanos),
        None => frames.iter().rposition(|frame| frame.message.phase == Phase::Settled),
    }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::Header;
    use blindgrasp_recording::{RecordingInfo, RecordingWriter};

    use super::*;

    #[test]
    fn grasps_of_two_runs_of_a_source_are_two() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("two.mcap");
        let info = RecordingInfo { hand: "h".into(), hand_id: 0, made_by: "test".into(), version: "0".into() };
        let mut writer = RecordingWriter::create(&path, &info).expect("created");
        for (epoch, stamp_nanos) in [(7, 1), (7, 2), (9, 3)] {
            let header = Header { epoch, stamp_nanos, ..Header::default() };
            let message = TactileFrame { grasp_id: 5, ..TactileFrame::default() };
            writer.write(TactileFrame::TOPIC, &Stamped { header, message }).expect("written");
        }
        writer.finish().expect("finished");
        let list = list(&path).expect("two grasps");
        let found: Vec<_> =
            list.iter().map(|(key, grasp)| (*key, &grasp.epoch[..], &grasp.id[..], grasp.n_frames)).collect();
        assert_eq!(found, [((7, 5), "1", "5", 2), ((9, 5), "2", "5", 1)]);
    }

    #[test]
    fn the_frame_that_decided_is_the_last_one_up_to_the_decision() {
        let phases = [Phase::Open, Phase::Settled, Phase::Settled, Phase::Ended];
        let frames: Vec<_> = (0_u64..)
            .zip(phases)
            .map(|(idx, phase)| Stamped {
                header: Header { stamp_nanos: 10 * idx, ..Header::default() },
                message: TactileFrame { phase, ..TactileFrame::default() },
            })
            .collect();
        for (decided_nanos, expected) in [(Some(10), 1), (Some(19), 1), (Some(900), 3), (None, 2)] {
            assert_eq!(decided_at(&frames, decided_nanos), Some(expected), "{decided_nanos:?}");
        }
        assert_eq!(decided_at(&frames[..1], None), None);
    }
}
