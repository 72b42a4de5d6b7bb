//! A source that sends one recorded frame over and over at a steady rate: for benchmarks, whose rates should be what they
//! say.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use blindgrasp_messages::{Header, Message, Recorded, Stamped, TactileFrame};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{self, Operator};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::Sent;
use blindgrasp_operator::wiring::Command;
use blindgrasp_recording::{Record, RecordingReader};
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    recording: PathBuf,
    rate_hz: f64,
    n_samples: u64,
}

fn main() -> ExitCode {
    let rate = ParamKind::Number { above: Some(0.0), min: None, max: Some(1e6), words: vec![] };
    let description = OperatorDescription::new("steady_source", "Sends one of a recording's frames at a steady rate")
        .output("tactile", TactileFrame::TYPE_NAME, "The frame")
        .param("recording", ParamKind::Path { must_exist: true }, None, "The recording")
        .param("rate_hz", rate, Some(1000.0.into()), "Frames per second")
        .param("n_samples", ParamKind::Integer { min: Some(1), max: None }, Some(1000.into()), "How many frames");
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let Params { recording, rate_hz, n_samples } = operator.params()?;
    let Stamped { header: recorded, message: frame } = firmest_frame(&recording)?;
    let n_items = frame.joints_rad.len() + frame.cells_newtons.len();
    let mut tactile = operator.publisher::<TactileFrame>("tactile", n_items)?;
    operator.ready(BTreeMap::new());
    let mut may_go = false;
    while !may_go && !operator.should_stop() {
        while let Some(command) = operator.next_command() {
            may_go |= command == Command::Go;
        }
        operator.sleep(Duration::from_millis(5));
    }
    // As a live source's: it is among what travels.
    let epoch = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
    let start = Instant::now();
    for seq in 0..n_samples {
        operator.beat();
        let due = start + Duration::from_secs_f64(seq as f64 / rate_hz);
        while let Some(left) = due.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            // The last stretch is too short for the scheduler.
            match left > Duration::from_micros(200) {
                true => operator.sleep(left - Duration::from_micros(100)),
                false => std::thread::yield_now(),
            }
        }
        if operator.should_stop() {
            break;
        }
        let stamp_nanos = recorded.stamp_nanos + (seq as f64 * 1e9 / rate_hz) as u64;
        let header = Header { seq, epoch, stamp_nanos, origin_nanos: monotonic_nanos(), ..recorded };
        let (head, items) = frame.to_parts(header);
        if tactile.send(head, &items, &mut || operator.is_to_give_way())? == Sent::GaveWay {
            break;
        }
    }
    operator.finished();
    while !operator.should_stop() {
        operator.sleep(Duration::from_millis(20));
        tactile.look_for_readers()?;
    }
    operator.drained();
    Ok(())
}

/// The frame that is felt most: it gives the stages something to do.
fn firmest_frame(recording: &Path) -> anyhow::Result<Stamped<TactileFrame>> {
    let force = |frame: &Stamped<TactileFrame>| frame.message.cells_newtons.iter().sum::<f64>();
    let mut firmest: Option<Stamped<TactileFrame>> = None;
    for record in RecordingReader::open(recording)? {
        let (_, record) = record?;
        if let Record::Tactile(frame) = record
            && firmest.as_ref().is_none_or(|firmest| force(&frame) > force(firmest))
        {
            firmest = Some(frame);
        }
    }
    firmest.context("the recording has no frames")
}
