//! Takes the hardware's place: publishes a recording's tactile frames, and the truth where the recording has it.
//!
//! Samples keep their recorded numbers and times, so that the same recording gives the same samples on every edge at
//! any rate. A recording that is damaged anywhere is refused before the first sample goes out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use blindgrasp::dataflow::{OperatorDescription, ParamKind};
use blindgrasp::diagnostics::print_diagnostic;
use blindgrasp::message::{GraspTruth, Header, Message, Recorded, TactileFrame};
use blindgrasp::recording::{Record, RecordingReader};
use blindgrasp::runtime::monotonic_nanos;
use blindgrasp::runtime::operator::{self, Operator};
use blindgrasp::runtime::wiring::PortCounts;
use serde::Deserialize;

/// A longer pause between two recorded frames is cut to this: clocks jump, and robots are switched off overnight.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// The longest nap between looks at the stop request.
const NAP: Duration = Duration::from_millis(20);

#[derive(Deserialize)]
struct Params {
    recording: PathBuf,
    rate: Rate,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Rate {
    /// Times the recorded speed.
    Times(f64),
    /// A word instead.
    Word(RateWord),
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum RateWord {
    /// As fast as the graph takes it.
    Max,
}

fn main() -> ExitCode {
    let rate = ParamKind::Number { above: Some(0.0), min: None, max: None, words: vec!["max".into()] };
    let summary = "Publishes the tactile frames of a recording in place of a hand";
    let description = OperatorDescription::new("recorded_source", summary)
        .output("tactile", TactileFrame::TYPE_NAME, "The recorded frames, with their recorded numbers and times")
        .output("truth", GraspTruth::TYPE_NAME, "What each grasp really was, where the recording says")
        .param("recording", ParamKind::Path { must_exist: true }, None, "The recording (MCAP)")
        .param("rate", rate, Some(1.0.into()), "Times the recorded speed, or max: as fast as the graph takes it");
    operator::run(&description, replay)
}

fn replay(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let max_items = largest_frame(&params.recording)?;
    let mut tactile = operator.publisher::<TactileFrame>("tactile", max_items)?;
    let mut truth = operator.publisher::<GraspTruth>("truth", 2 * blindgrasp::message::MAX_NAME_BYTES)?;
    operator.ready(|| Ok(tactile.has_all_consumers() && truth.has_all_consumers()))?;
    let reader = RecordingReader::open(&params.recording)?;
    let hand_id = reader.info().hand_id;
    let mut pace = Pace { rate: params.rate, last: None };
    let mut is_complete = operator.wait_for_go();
    for record in reader {
        let (_, record) = record?;
        // The truth goes out with the frames around it: its stamp may be from another time altogether.
        let is_frame = matches!(record, Record::Tactile(_));
        if operator.should_stop() || (is_frame && !pace.wait(operator, record.header().stamp_nanos)) {
            is_complete = false;
            break;
        }
        let header = |recorded: Header| Header {
            hand_id: if recorded.hand_id == 0 { hand_id } else { recorded.hand_id },
            origin_nanos: monotonic_nanos(),
            ..recorded
        };
        match &record {
            Record::Tactile(frame) => {
                let (head, items) = frame.message.to_parts(header(frame.header));
                tactile.send(head, &items)?;
            }
            Record::Truth(sample) => {
                let (head, items) = sample.message.to_parts(header(sample.header));
                truth.send(head, &items)?;
            }
            _ => {}
        }
    }
    let sent = BTreeMap::from([("tactile".into(), tactile.n_sent()), ("truth".into(), truth.n_sent())]);
    let counts = PortCounts { received: BTreeMap::new(), sent };
    if is_complete {
        operator.finished(counts)
    } else {
        operator.drained(counts)
    }
    Ok(())
}

/// Reads the whole recording once: how many items its largest frame has, or what is wrong with it.
fn largest_frame(path: &Path) -> anyhow::Result<usize> {
    let mut max_items = 0;
    let mut n_frames = 0;
    let reader = RecordingReader::open(path)?;
    let info = reader.info().clone();
    for record in reader {
        if let (_, Record::Tactile(frame)) = record? {
            let hand_id = frame.header.hand_id;
            if hand_id != 0 && info.hand_id != 0 && hand_id != info.hand_id {
                anyhow::bail!(
                    "recording {}: frame {} is of the hand {hand_id:016x}, the recording says {:016x} ({})",
                    path.display(),
                    frame.header.seq,
                    info.hand_id,
                    info.hand
                );
            }
            n_frames += 1;
            max_items = max_items.max(frame.message.joints_rad.len() + frame.message.cells_newtons.len());
        }
    }
    if n_frames == 0 {
        anyhow::bail!("recording {}: it holds no tactile frames to replay", path.display());
    }
    Ok(max_items)
}

/// Turns recorded times into waiting.
struct Pace {
    rate: Rate,
    /// When the last frame was due, and its recorded time.
    last: Option<(Instant, u64)>,
}

impl Pace {
    /// Waits until a frame of that recorded time is due; false if the operator is to stop.
    fn wait(&mut self, operator: &Operator, stamp_nanos: u64) -> bool {
        let Rate::Times(times) = self.rate else {
            return !operator.should_stop();
        };
        let (last_due, last_stamp_nanos) = self.last.unwrap_or((Instant::now(), stamp_nanos));
        let recorded = Duration::from_nanos(stamp_nanos.saturating_sub(last_stamp_nanos));
        if recorded > LONGEST_PAUSE {
            print_diagnostic(&format!(
                "skipping a pause of {:.0} s in the recording before the frame at {stamp_nanos} ns",
                recorded.as_secs_f64()
            ));
        }
        let pause = Duration::try_from_secs_f64(recorded.min(LONGEST_PAUSE).as_secs_f64() / times);
        let due = last_due.checked_add(pause.unwrap_or(LONGEST_PAUSE)).unwrap_or(last_due);
        self.last = Some((due, stamp_nanos));
        while let Some(left) = due.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            if operator.should_stop() {
                return false;
            }
            std::thread::sleep(left.min(NAP));
        }
        !operator.should_stop()
    }
}
