//! A source that sends one recorded frame over and over at a steady rate, for benchmarks.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use blindgrasp_messages::{Header, Recorded, Stamped, TactileFrame};
use blindgrasp_operator::port::{Publisher, Sent};
use blindgrasp_operator::source::{self, Source, Step, send};
use blindgrasp_operator::{Operator, OperatorDescription, ParamKind, run};
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
    run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let Params { recording, rate_hz, n_samples } = operator.params()?;
    let frame = firmest_frame(&recording)?;
    let n_items = frame.message.joints.len() + frame.message.cells_newtons.len();
    let source = SteadySource {
        operator,
        tactile: operator.publisher("tactile", n_items)?,
        frame,
        // Like that of a live source: it is part of the samples.
        epoch: SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64,
        rate_hz,
        n_samples,
        seq: 0,
        start: None,
    };
    source::run(operator, BTreeMap::new(), source)
}

struct SteadySource<'a> {
    operator: &'a Operator,
    tactile: Publisher<TactileFrame>,
    frame: Stamped<TactileFrame>,
    epoch: u64,
    rate_hz: f64,
    n_samples: u64,
    seq: u64,
    start: Option<Instant>,
}

impl Source for SteadySource<'_> {
    fn step(&mut self) -> anyhow::Result<Step> {
        if self.seq == self.n_samples {
            return Ok(Step::Done);
        }
        let elapsed = Duration::from_secs_f64(self.seq as f64 / self.rate_hz);
        let due = *self.start.get_or_insert_with(Instant::now) + elapsed;
        let left = due.saturating_duration_since(Instant::now());
        if left > Duration::from_micros(200) {
            return Ok(Step::Wait(Some(due - Duration::from_micros(100))));
        }
        if !left.is_zero() {
            // The scheduler would take longer.
            std::thread::yield_now();
            return Ok(Step::Next);
        }
        let recorded = self.frame.header;
        let stamp_nanos = recorded.stamp_nanos + elapsed.as_nanos() as u64;
        let header = Header { seq: self.seq, epoch: self.epoch, stamp_nanos, ..recorded };
        let sent = send(self.operator, &mut self.tactile, &self.frame.message, header)?;
        self.seq += u64::from(sent == Sent::Yes);
        Ok(sent.into())
    }

    fn look(&mut self) -> anyhow::Result<()> {
        Ok(self.tactile.look_for_readers()?)
    }
}

/// The frame with the greatest force: it gives the stages something to do.
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
