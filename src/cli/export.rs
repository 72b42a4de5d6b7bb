//! `blindgrasp export`

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::{Outcome, print_line};
use crate::recording::RecordingReader;

/// Print a recording as JSON lines.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp export recordings/held-out.mcap --topic /truth\n\n\
                        A line: {\"topic\", \"seq\", \"stamp_nanos\", \"data\": {…}}. What JSON cannot say (NaN, \
                        infinity) is null.")]
pub(super) struct Arguments {
    /// The recording (MCAP).
    recording: PathBuf,
    /// Only this topic; may be given more than once.
    #[arg(long)]
    topic: Vec<String>,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    for record in RecordingReader::open(&arguments.recording)? {
        let (topic, record) = record?;
        if arguments.topic.is_empty() || arguments.topic.contains(&topic) {
            let header = record.header();
            let line = json!({
                "topic": topic,
                "seq": header.seq,
                "stamp_nanos": header.stamp_nanos,
                "data": record.to_json()?,
            });
            print_line(&line.to_string())?;
        }
    }
    Ok(Outcome::Done)
}
