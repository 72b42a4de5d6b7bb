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
use blindgrasp_messages::{GraspTruth, Header, LiftDecision, OwnedSenses, Phase, Recorded, Stamped, TactileFrame};
use blindgrasp_recording::recordings_in;
use blindgrasp_stages::{Hand, Judge, Model};
use blindgrasp_tactile::line_protocol;

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
        if file.is_dir() { files.extend(recordings_in(std::slice::from_ref(file))?) } else { files.push(file.clone()) }
    }
    for file in &files {
        let is_recording = file.extension().is_some_and(|extension| extension == "mcap");
        if is_recording {
            let hand = hand_of(file, arguments.hand.as_deref())?;
            let judge = Judge::new(hand, model.clone());
            let mut judge = judge.with_context(|| format!("recording {}", file.display()))?;
            for decided in decide(&mut judge, file)? {
                print(arguments.json, file, &decided.decision, decided.truth.as_ref())?;
            }
        } else {
            let hand = hand_of_model(&model, arguments.hand.as_deref())?;
            let frames = read_frames(file, &hand)?;
            let mut judge = Judge::new(hand, model.clone())?;
            for decision in decide_frames(&mut judge, &frames) {
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
    model.check_hand(&hand)?;
    Ok(hand)
}

fn read_frames(file: &Path, hand: &Hand) -> anyhow::Result<Vec<Stamped<TactileFrame>>> {
    let input: Box<dyn BufRead> = match file.to_str() {
        Some("-") => Box::new(std::io::stdin().lock()),
        _ => Box::new(BufReader::new(std::fs::File::open(file).with_context(|| file.display().to_string())?)),
    };
    let mut frames: Vec<Stamped<TactileFrame>> = Vec::new();
    // Of lines of a bridge: whether they have numbers.
    let mut has_seq = None;
    for (line_idx, line) in input.lines().enumerate() {
        let line = line.with_context(|| file.display().to_string())?;
        if line.trim().is_empty() {
            continue;
        }
        let frame =
            read_frame(&line, &frames, hand).with_context(|| format!("{}, line {}", file.display(), line_idx + 1))?;
        let has_seq_here = line.contains("\"seq\"");
        if !line.contains("\"data\"") && *has_seq.get_or_insert(has_seq_here) != has_seq_here {
            bail!("{}, line {}: expected seq in all lines or in none", file.display(), line_idx + 1);
        }
        frames.extend(frame);
    }
    if let (Some(has_seq), Some(first)) = (has_seq, frames.first()) {
        // As the source of a graph numbers them: if the first frames are missing, so is number 0, and the grasp is held.
        let first_seq = first.header.seq;
        let is_whole = first.message.phase == Phase::Open || (has_seq && first_seq == 0);
        for frame in &mut frames {
            frame.header.seq = frame.header.seq.wrapping_sub(first_seq).wrapping_add(u64::from(!is_whole));
        }
    }
    if frames.is_empty() {
        bail!("{}: expected lines with tactile frames, found none", file.display());
    }
    Ok(frames)
}

/// A line of `blindgrasp export`, or of a bridge; `None` for a sample of another topic.
fn read_frame(
    line: &str,
    earlier: &[Stamped<TactileFrame>],
    hand: &Hand,
) -> anyhow::Result<Option<Stamped<TactileFrame>>> {
    let value: Value = serde_json::from_str(line).context("not a line of JSON")?;
    if value.get("data").is_none() {
        return of_bridge(line, earlier, hand).map(Some);
    }
    let line: ExportedLine = serde_json::from_value(value.clone())
        .context("not a line of 'blindgrasp export': expected topic, seq, stamp_nanos and data")?;
    if line.topic != TactileFrame::TOPIC {
        return Ok(None);
    }
    let hand_id = match &line.hand_id {
        Some(id) => u64::from_str_radix(id, 16).context("hand_id: expected 16 hexadecimal digits")?,
        None => hand.id(),
    };
    let header =
        Header { hand_id, seq: line.seq, stamp_nanos: line.stamp_nanos, epoch: line.epoch, ..Header::default() };
    let frame: FrameLine = serde_json::from_value(line.data)
        .context("not a tactile frame: expected grasp_id, phase, joints and cells_newtons")?;
    let message = TactileFrame {
        grasp_id: frame.grasp_id,
        phase: frame.phase,
        joints: numbers(frame.joints),
        cells_newtons: numbers(frame.cells_newtons),
        senses: frame.senses,
        day: frame.day,
    };
    Ok(Some(Stamped { header, message }))
}

/// As a graph's source numbers the frames of a bridge: from 0, with the bridge's gaps.
fn of_bridge(line: &str, earlier: &[Stamped<TactileFrame>], hand: &Hand) -> anyhow::Result<Stamped<TactileFrame>> {
    let reading = line_protocol::parse(line.as_bytes()).map_err(|refusal| anyhow::anyhow!("{}", refusal.why))?;
    let grasp_id = reading.grasp_id.context("the frame lacks grasp_id")?;
    // Without the bridge's numbers, no frame is missed.
    let seq = reading.seq.unwrap_or(earlier.last().map_or(0, |frame| frame.header.seq + 1));
    let stamp_nanos = reading.stamp_nanos.unwrap_or(seq.wrapping_mul(PERIOD_NANOS));
    let message = TactileFrame {
        grasp_id,
        phase: reading.phase,
        joints: reading.joints,
        cells_newtons: reading.cells_newtons,
        senses: reading.senses,
        day: reading.day.unwrap_or(0),
    };
    Ok(Stamped { header: Header { hand_id: hand.id(), seq, stamp_nanos, ..Header::default() }, message })
}

/// A line of `blindgrasp export`.
#[derive(Deserialize)]
struct ExportedLine {
    topic: String,
    seq: u64,
    stamp_nanos: u64,
    #[serde(default)]
    epoch: u64,
    hand_id: Option<String>,
    data: Value,
}

/// A frame as lines of JSON have it: a number that is not finite is null there.
#[derive(Deserialize)]
struct FrameLine {
    grasp_id: u64,
    phase: Phase,
    joints: Vec<Option<f64>>,
    cells_newtons: Vec<Option<f64>>,
    #[serde(flatten)]
    senses: OwnedSenses,
    #[serde(default)]
    day: u32,
}

fn numbers(values: Vec<Option<f64>>) -> Vec<f64> {
    values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect()
}

fn print(json: bool, file: &Path, decision: &LiftDecision, truth: Option<&GraspTruth>) -> std::io::Result<()> {
    let LiftDecision { grasp_id, action, reason, probability_stable, .. } = decision;
    if json {
        return print_line(
            &json!({
                "file": file.display().to_string(),
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
