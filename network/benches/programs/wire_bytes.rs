//! The size of a recording's tactile frames between machines, for `scripts/benchsuite machines`.
//!
//!     wire_bytes RECORDING      prints the median size of a sample in bincode and of its frame, and the number of samples
//!
//! Counters have the values of a link that has run for a while, because their encoding grows with them.

use std::path::PathBuf;

use anyhow::{Context, bail};
use blindgrasp_bridge::sample::{encode, schema_id};
use blindgrasp_bridge::wire::{Body, Frame, SampleFrame};
use blindgrasp_messages::{Header, Message, Recorded, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader};

/// A value like that of an instance, a clock or an epoch: its encoding has the maximum length.
const LARGE: u64 = u64::MAX / 3;
/// The count that a link at 1 kHz reaches in half an hour.
const COUNT: u64 = 2_000_000;

fn main() -> anyhow::Result<()> {
    let recording: PathBuf = std::env::args_os().nth(1).context("wire_bytes RECORDING")?.into();
    let schema_id = schema_id(TactileFrame::TYPE_NAME).context("tactile frames cannot cross")?;
    let (mut message, mut bytes) = (Vec::new(), Vec::new());
    let mut found: Vec<(usize, usize)> = Vec::new();
    for record in RecordingReader::open(&recording)? {
        let (_, Record::Tactile(frame)) = record? else {
            continue;
        };
        let header = Header { seq: COUNT, epoch: LARGE, ..frame.header };
        let (head, items) = frame.message.to_parts(header);
        encode::<TactileFrame>(&head, &items, &mut message)?;
        let body = Body::Sample(SampleFrame {
            channel: 0,
            run: 1,
            index: COUNT,
            schema_id,
            echo_nanos: LARGE,
            age_nanos: Some(500_000),
            sent_nanos: LARGE,
            message: &message,
        });
        Frame { instance: LARGE, counter: COUNT, body }.encode_into(&mut bytes)?;
        found.push((message.len(), bytes.len()));
    }
    found.sort_unstable();
    let Some(&(sample_bytes, frame_bytes)) = found.get(found.len() / 2) else {
        bail!("{} has no tactile frames", recording.display());
    };
    println!("{sample_bytes} {frame_bytes} {}", found.len());
    Ok(())
}
