//! Frames as lines of JSON: those of a bridge, or of `blindgrasp export`.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Take};
use std::path::Path;

use anyhow::{Context, bail};
use serde::Deserialize;
use serde_json::Value;

use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_messages::files::open_regular;
use blindgrasp_messages::{GraspTruth, Header, LiftOutcome, OwnedSenses, Phase, Recorded, Stamped, TactileFrame};
use blindgrasp_stages::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_tactile::cell_zeros::{AllowedReadings, CellZeros};
use blindgrasp_tactile::{ExpectedHand, line_protocol};

/// The time between two frames that have no stamp.
const PERIOD_NANOS: u64 = 10_000_000;
/// The size limit of the lines, which are all read before the first grasp is decided: that of a table.
const MAX_BYTES: u64 = 1 << 30;
/// The size limit of a line: thousands of cells.
const MAX_LINE_BYTES: u64 = 4 << 20;

/// The frames, labels and outcomes of lines.
#[derive(Default)]
pub struct FrameLines {
    pub frames: Vec<Stamped<TactileFrame>>,
    /// The labels by number of the grasp and epoch, with their headers if they have lines of their own.
    pub truths: BTreeMap<(u64, u64), (Option<Header>, GraspTruth)>,
    pub outcomes: Vec<Stamped<LiftOutcome>>,
    /// What stable means in the labels, if a line of `blindgrasp export` says so.
    pub label: Option<Label>,
    /// The samples of other topics, which are left out, by topic.
    pub n_left_out: BTreeMap<String, usize>,
}

/// A line: a frame, with the label that it reports if it names the object; a label; an outcome; or a sample of another topic.
enum Line {
    Frame(Stamped<TactileFrame>, Option<GraspTruth>),
    Truth(Stamped<GraspTruth>, Option<Label>),
    Outcome(Stamped<LiftOutcome>),
    Other(String),
}

/// Reads a file of lines, or stdin if it is `-`. Empty lines, and samples of other topics, are left out.
///
/// # Errors
/// A file that is no regular one or has more than 1 GiB, a line of more than 4 MiB or that is no frame, labels of two meanings, or
/// no frame at all. The text names the line.
pub fn read_frames(file: &Path, hand: &Hand) -> anyhow::Result<FrameLines> {
    if let Some(kind) = FileKind::at(file)
        && !matches!(kind, FileKind::FrameLines | FileKind::Json | FileKind::Empty)
    {
        bail!("{}: expected frames as lines of JSON, found {}", file.display(), kind.description());
    }
    let input: Box<dyn BufRead> = match file.to_str() {
        Some("-") => Box::new(std::io::stdin().lock()),
        _ => Box::new(BufReader::new(open_regular(file).with_context(|| file.display().to_string())?)),
    };
    let mut input = input.take(MAX_BYTES + 1);
    let mut lines = FrameLines::default();
    // Of lines of a bridge: whether they have numbers.
    let mut has_seq = None;
    let mut zeros = CellZeros::new(hand, false);
    for line_number in 1_u64.. {
        let place = || format!("{}, line {line_number}", file.display());
        let Some(line) = next_line(&mut input).with_context(place)? else { break };
        // Some programs write a byte order mark before the first line.
        let line = if line_number == 1 { line.trim_start_matches('\u{feff}') } else { &line };
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        let read = read_line(line, &lines.frames, hand, &mut zeros).with_context(place)?;
        let has_seq_here = line.contains("\"seq\"");
        if !line.contains("\"data\"") && *has_seq.get_or_insert(has_seq_here) != has_seq_here {
            bail!("{}: expected seq in all lines or in none", place());
        }
        lines.add(read).with_context(place)?;
    }
    if let (Some(has_seq), Some(first)) = (has_seq, lines.frames.first()) {
        // As the source of a graph numbers them: if the first frames are missing, so is number 0, and the grasp is held.
        let first_seq = first.header.seq;
        let is_whole = first.message.phase == Phase::Open || (has_seq && first_seq == 0);
        for frame in &mut lines.frames {
            frame.header.seq = frame.header.seq.wrapping_sub(first_seq).wrapping_add(u64::from(!is_whole));
        }
    }
    if lines.frames.is_empty() {
        bail!("{}: expected lines with tactile frames, found none", file.display());
    }
    Ok(lines)
}

impl FrameLines {
    fn add(&mut self, line: Line) -> anyhow::Result<()> {
        let (key, truth) = match line {
            Line::Frame(frame, truth) => {
                let epoch = frame.header.epoch;
                self.frames.push(frame);
                let Some(truth) = truth else { return Ok(()) };
                ((truth.grasp_id, epoch), (None, truth))
            }
            Line::Truth(Stamped { header, message }, label) => {
                if self.label != label && self.truths.values().any(|(own, _)| own.is_some()) {
                    bail!("this label is by another rule than those before: import the recordings one by one");
                }
                self.label = label;
                ((message.grasp_id, header.epoch), (Some(header), message))
            }
            Line::Outcome(outcome) => {
                self.outcomes.push(outcome);
                return Ok(());
            }
            Line::Other(topic) => {
                *self.n_left_out.entry(topic).or_default() += 1;
                return Ok(());
            }
        };
        // The first label counts, but an object that was kept may be dropped after that.
        if self.truths.get(&key).is_none_or(|(_, known)| known.stable && !truth.1.stable) {
            self.truths.insert(key, truth);
        }
        Ok(())
    }
}

/// The next line; `None` at the end.
fn next_line(input: &mut Take<Box<dyn BufRead>>) -> anyhow::Result<Option<String>> {
    let mut line = Vec::new();
    input.by_ref().take(MAX_LINE_BYTES + 1).read_until(b'\n', &mut line)?;
    if line.len() as u64 > MAX_LINE_BYTES {
        bail!("more than {} MiB: expected a line with a frame", MAX_LINE_BYTES >> 20);
    }
    if input.limit() == 0 {
        bail!("more than {} GiB so far: divide the lines, and give them part by part", MAX_BYTES >> 30);
    }
    if line.is_empty() {
        return Ok(None);
    }
    Ok(Some(String::from_utf8(line).context("expected UTF-8")?))
}

fn read_line(
    line: &str,
    earlier: &[Stamped<TactileFrame>],
    hand: &Hand,
    zeros: &mut Result<CellZeros, String>,
) -> anyhow::Result<Line> {
    let value: Value = serde_json::from_str(&line_protocol::with_null_for_nan(line)).context("not a line of JSON")?;
    if value.get("data").is_none() {
        return of_bridge(line, earlier, hand, zeros.as_mut().map_err(|reason| anyhow::anyhow!("{reason}"))?);
    }
    let line: ExportedLine = serde_json::from_value(value)
        .context("not a line of 'blindgrasp export': expected topic, seq, stamp_nanos and data")?;
    let hand_id = match &line.hand_id {
        Some(id) => u64::from_str_radix(id, 16).context("hand_id: expected 16 hexadecimal digits")?,
        None => hand.id(),
    };
    let header =
        Header { hand_id, seq: line.seq, stamp_nanos: line.stamp_nanos, epoch: line.epoch, ..Header::default() };
    if line.topic == GraspTruth::TOPIC {
        let message = serde_json::from_value(line.data)
            .context("not a label: expected grasp_id, epsilon, volume, stable, object and object_class")?;
        return Ok(Line::Truth(Stamped { header, message }, line.label));
    }
    if line.topic == LiftOutcome::TOPIC {
        let message =
            serde_json::from_value(line.data).context("not an outcome: expected the fields of LiftOutcome")?;
        return Ok(Line::Outcome(Stamped { header, message }));
    }
    if line.topic != TactileFrame::TOPIC {
        return Ok(Line::Other(line.topic));
    }
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
    Ok(Line::Frame(Stamped { header, message }, None))
}

/// As a graph's source takes the frames of a bridge: numbered from 0 with the bridge's gaps, and noise below 0 as 0.
fn of_bridge(
    line: &str,
    earlier: &[Stamped<TactileFrame>],
    hand: &Hand,
    zeros: &mut CellZeros,
) -> anyhow::Result<Line> {
    let reading = line_protocol::parse(line.as_bytes()).and_then(|reading| ExpectedHand::of(hand).check(reading));
    let mut reading = reading.map_err(|refusal| anyhow::anyhow!("{}", refusal.why))?;
    let allowed = zeros.allowed();
    // A frame of another hand is refused later.
    if allowed.has_cells(reading.cells_newtons.len()) {
        let checked = AllowedReadings::check(Some(&allowed), &reading.cells_newtons);
        checked
            .and_then(|()| zeros.apply(&mut reading))
            .map_err(|why| anyhow::anyhow!("{why}, which a graph has: record its frames"))?;
    }
    let grasp_id = reading.grasp_id.context("the frame lacks grasp_id")?;
    let truth = reading.truth(grasp_id);
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
    let header = Header { hand_id: hand.id(), seq, stamp_nanos, ..Header::default() };
    Ok(Line::Frame(Stamped { header, message }, truth))
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
    label: Option<Label>,
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
