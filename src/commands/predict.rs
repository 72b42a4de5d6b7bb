//! `blindgrasp predict`

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{Outcome, print_line};
use blindgrasp_learning::dataset::hand_of;
use blindgrasp_learning::evaluation::{decide, decide_frames};
use blindgrasp_messages::{GraspTruth, Header, LiftDecision, Phase, Stamped, TactileFrame};
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

/// The time between two frames that have no stamp.
const PERIOD_NANOS: u64 = 10_000_000;

/// Print the decision of a model on each grasp
///
/// Decides the grasps one after the other, as a graph with this model and the arbiter's default params does, without
/// starting one.
#[derive(Debug, Args)]
#[command(after_help = "Examples: blindgrasp predict models/barrett-bh8-280.json recordings/held-out.mcap\n          \
                        blindgrasp export a.mcap --topic /tactile | blindgrasp predict model.json --hand hand.yaml -\n\n\
                        A line of frames is one of blindgrasp export, or one of a bridge (docs/hardware.md) with its grasp_id. All \
                        lines are read before the first decision is printed. As in a graph, a grasp is held if a seq is missing, or if \
                        the hand_id is another.")]
pub(super) struct Arguments {
    /// The model (JSON)
    model: PathBuf,
    /// Recordings (MCAP), folders of them, or frames as lines of JSON (- for stdin)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Pad layout of the hand [default: the built-in hand of the model]
    #[arg(long)]
    hand: Option<PathBuf>,
    /// Print JSON, one object a grasp
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let model = Model::load(&arguments.model)?;
    let mut files = Vec::new();
    for file in &arguments.files {
        match file.is_dir() {
            true => files.extend(recordings_in(std::slice::from_ref(file))?),
            false => files.push(file.clone()),
        }
    }
    for file in &files {
        let is_recording = file.extension().is_some_and(|extension| extension == "mcap");
        if is_recording {
            let hand = hand_of(file, arguments.hand.as_deref())?;
            for decided in decide(&hand, &model, file)? {
                print(arguments.json, file, &decided.decision, decided.truth.as_ref())?;
            }
        } else {
            let hand = hand_of_model(&model, arguments.hand.as_deref())?;
            let frames = read_frames(file, &hand)?;
            for decision in decide_frames(&hand, &model, &frames) {
                print(arguments.json, file, &decision, None)?;
            }
        }
    }
    Ok(Outcome::Done)
}

fn hand_of_model(model: &Model, path: Option<&Path>) -> anyhow::Result<Hand> {
    let hand = match path {
        Some(path) => Hand::load(path)?,
        None => Hand::load(Path::new(&model.hand.name)).with_context(|| {
            format!("the model is for the hand '{}': name its pad layout with --hand", model.hand.name)
        })?,
    };
    if hand.id() != model.hand.id {
        bail!("the model is for the hand '{}', not for '{}' as it is here", model.hand.name, hand.name);
    }
    Ok(hand)
}

fn read_frames(file: &Path, hand: &Hand) -> anyhow::Result<Vec<Stamped<TactileFrame>>> {
    let input: Box<dyn BufRead> = match file.to_str() {
        Some("-") => Box::new(std::io::stdin().lock()),
        _ => Box::new(BufReader::new(std::fs::File::open(file).with_context(|| file.display().to_string())?)),
    };
    let mut frames: Vec<Stamped<TactileFrame>> = Vec::new();
    for (line_idx, line) in input.lines().enumerate() {
        let line = line.with_context(|| file.display().to_string())?;
        if line.trim().is_empty() {
            continue;
        }
        let seq = frames.len() as u64;
        let frame =
            read_frame(&line, seq, hand).with_context(|| format!("{}, line {}", file.display(), line_idx + 1))?;
        frames.extend(frame);
    }
    if frames.is_empty() {
        bail!("{}: expected lines with tactile frames, found none", file.display());
    }
    Ok(frames)
}

/// A frame by itself, or in a line of `blindgrasp export`; `None` for a sample of another topic.
fn read_frame(line: &str, next_seq: u64, hand: &Hand) -> anyhow::Result<Option<Stamped<TactileFrame>>> {
    let mut value: Value = serde_json::from_str(line).context("not a line of JSON")?;
    if value.get("topic").is_some_and(|topic| topic != "/tactile") {
        return Ok(None);
    }
    let number = |name: &str| value.get(name).and_then(Value::as_u64);
    let seq = number("seq").unwrap_or(next_seq);
    let stamp_nanos = number("stamp_nanos").unwrap_or(seq.wrapping_mul(PERIOD_NANOS));
    let hand_id = match value.get("hand_id").and_then(Value::as_str) {
        Some(id) => u64::from_str_radix(id, 16).context("hand_id: expected 16 hexadecimal digits")?,
        None => hand.id(),
    };
    let header = Header { hand_id, seq, stamp_nanos, epoch: number("epoch").unwrap_or(0), ..Header::default() };
    let data = value.get_mut("data").map(Value::take).unwrap_or(value);
    let FrameLine { grasp_id, phase, joints_rad, cells_newtons, gravity_m_per_s2, wrist_wrench, joint_torques, day } =
        serde_json::from_value(data)
            .context("not a tactile frame: expected grasp_id, phase, joints_rad and cells_newtons")?;
    let [joints_rad, cells_newtons, gravity_m_per_s2, wrist_wrench, joint_torques] =
        [joints_rad, cells_newtons, gravity_m_per_s2, wrist_wrench, joint_torques].map(numbers);
    let message = TactileFrame {
        grasp_id,
        phase,
        joints_rad,
        cells_newtons,
        gravity_m_per_s2,
        wrist_wrench,
        joint_torques,
        day: day.unwrap_or(0),
    };
    Ok(Some(Stamped { header, message }))
}

/// A frame as lines of JSON have it: a number that is not finite is null there.
#[derive(Deserialize)]
struct FrameLine {
    grasp_id: u64,
    phase: Phase,
    joints_rad: Vec<Option<f64>>,
    cells_newtons: Vec<Option<f64>>,
    #[serde(default)]
    gravity_m_per_s2: Vec<Option<f64>>,
    #[serde(default)]
    wrist_wrench: Vec<Option<f64>>,
    #[serde(default)]
    joint_torques: Vec<Option<f64>>,
    day: Option<u32>,
}

fn numbers(values: Vec<Option<f64>>) -> Vec<f64> {
    values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect()
}

fn print(json: bool, file: &Path, decision: &LiftDecision, truth: Option<&GraspTruth>) -> std::io::Result<()> {
    let LiftDecision { grasp_id, action, reason, probability_stable, .. } = decision;
    if json {
        return print_line(
            &json!({
                "file": file,
                "grasp_id": grasp_id,
                "action": action,
                "reason": reason.as_str(),
                "probability_stable": probability_stable,
                "truth": truth,
            })
            .to_string(),
        );
    }
    let truth = truth.map_or(String::new(), |truth| {
        format!("  truth: {} ({})", if truth.stable { "stable" } else { "unstable" }, truth.object)
    });
    let line =
        format!("grasp {grasp_id:>5}  {}  p {probability_stable:.3}  {:<14}{truth}", action.shown(), reason.as_str());
    print_line(line.trim_end())
}
