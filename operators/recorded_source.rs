//! Takes the hardware's place: publishes a recording's tactile frames, and the truth where the recording has it.
//!
//! Samples keep their recorded numbers and times, so that the same recording gives the same samples on every edge at
//! any rate. A recording that is damaged anywhere is refused before the first sample goes out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use blindgrasp::dataflow::{OperatorDescription, PROTOCOL, ParamDescription, ParamKind, PortDescription};
use blindgrasp::message::{GraspTruth, Header, Message, TactileFrame};
use blindgrasp::recording::{Record, RecordingReader};
use blindgrasp::runtime::monotonic_nanos;
use blindgrasp::runtime::operator::{self, Operator};
use blindgrasp::runtime::wiring::PortCounts;
use serde::Deserialize;

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
    let description = OperatorDescription {
        protocol: PROTOCOL,
        operator: "recorded_source".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        summary: "Publishes the tactile frames of a recording in place of a hand".into(),
        inputs: vec![],
        outputs: vec![
            PortDescription {
                name: "tactile".into(),
                type_name: TactileFrame::TYPE_NAME.into(),
                optional: false,
                summary: "The recorded frames, with their recorded numbers and times".into(),
            },
            PortDescription {
                name: "truth".into(),
                type_name: GraspTruth::TYPE_NAME.into(),
                optional: false,
                summary: "What each grasp really was, where the recording says".into(),
            },
        ],
        params: vec![
            ParamDescription {
                name: "recording".into(),
                kind: ParamKind::Path { must_exist: true },
                default: None,
                optional: false,
                summary: "The recording (MCAP)".into(),
            },
            ParamDescription {
                name: "rate".into(),
                kind: ParamKind::Number { above: Some(0.0), min: None, max: None, words: vec!["max".into()] },
                default: Some(1.0.into()),
                optional: false,
                summary: "Times the recorded speed, or max: as fast as the graph takes it".into(),
            },
        ],
    };
    operator::run(&description, replay)
}

fn replay(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let max_items = largest_frame(&params.recording)?;
    let mut tactile = operator.publisher::<TactileFrame>("tactile", max_items)?;
    let mut truth = operator.publisher::<GraspTruth>("truth", 2 * blindgrasp::message::MAX_NAME_BYTES)?;
    operator.ready(|| Ok(tactile.has_all_consumers() && truth.has_all_consumers()))?;
    operator.wait_for_go();
    let reader = RecordingReader::open(&params.recording)?;
    let hand_id = reader.info().hand_id;
    let mut pace = Pace { rate: params.rate, began: None };
    for record in reader {
        let (_, record) = record?;
        if !pace.wait(operator, record.header().stamp_nanos) {
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
    operator.finished(PortCounts { received: BTreeMap::new(), sent });
    Ok(())
}

/// Reads the whole recording once: how many items its largest frame has, or what is wrong with it.
fn largest_frame(path: &Path) -> anyhow::Result<usize> {
    let mut max_items = 0;
    let mut n_frames = 0;
    for record in RecordingReader::open(path)? {
        if let (_, Record::Tactile(frame)) = record? {
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
    /// When the replay began, and the recorded time that it began with.
    began: Option<(Instant, u64)>,
}

impl Pace {
    /// Waits until a sample of that recorded time is due; false if the operator is to stop.
    fn wait(&mut self, operator: &Operator, stamp_nanos: u64) -> bool {
        let (start, first_stamp_nanos) = *self.began.get_or_insert((Instant::now(), stamp_nanos));
        if let Rate::Times(times) = self.rate {
            let due_secs = stamp_nanos.saturating_sub(first_stamp_nanos) as f64 / 1e9 / times;
            let due = Duration::try_from_secs_f64(due_secs).unwrap_or(Duration::MAX);
            while let Some(left) = due.checked_sub(start.elapsed()).filter(|left| !left.is_zero()) {
                if operator.should_stop() {
                    return false;
                }
                std::thread::sleep(left.min(NAP));
            }
        }
        !operator.should_stop()
    }
}
