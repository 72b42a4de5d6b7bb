//! A recording written anew, with what a replay of it found.

use std::collections::BTreeSet;
use std::iter::Peekable;
use std::path::Path;

use anyhow::bail;

use crate::commands::replay::{Fed, Origin};
use blindgrasp_recording::{Record, RecordingError, RecordingReader, RecordingWriter, TOPICS_FOR_VIEWERS};
use blindgrasp_replay::comparison::Coverage;
use blindgrasp_replay::played::played;

/// Writes the recording anew: what was played, truths, scenes and metadata stay, the edges of the replay take the place
/// of the recorded ones. What a live recording has for viewers follows from the samples, and is left out. Says what it
/// wrote.
pub(super) fn update(recording: &Path, found: &Path, fed: &Fed, coverage: &Coverage) -> anyhow::Result<String> {
    let reader = RecordingReader::open(recording)?;
    let is_lost = |(topic, schema): &(&String, &String)| {
        !schema.starts_with("blindgrasp_msgs/") && !TOPICS_FOR_VIEWERS.contains(&topic.as_str())
    };
    if let Some((topic, schema)) = reader.topics().iter().find(is_lost) {
        bail!(
            "it also holds {topic}, of type {schema}, which would be lost: keep such topics in a recording of their own"
        );
    }
    // What a stage gives that does not run stays as it is.
    let of_stages = || fed.edges.iter().filter(|edge| edge.origin == Origin::Stage);
    let replaced: BTreeSet<&str> = of_stages().map(|edge| edge.recorded_topic.as_str()).collect();
    let new_name = |topic: &str| {
        let edge = of_stages().find(|edge| edge.found_topic == topic)?;
        Some(edge.recorded_topic.clone())
    };
    let mut new_samples = RecordingReader::open(found)?
        .filter_map(|record| match record {
            Ok((topic, record)) => new_name(&topic).map(|topic| Ok((topic, with_recorded_number(record, coverage)))),
            Err(error) => Some(Err(error)),
        })
        .peekable();
    let metadata = reader.all_metadata().clone();
    let mut writer = RecordingWriter::create(recording, reader.info())?;
    for (name, metadata) in metadata {
        writer.write_metadata(&name, metadata)?;
    }
    for record in reader {
        let (topic, record) = record?;
        if replaced.contains(topic.as_str()) {
            continue;
        }
        if topic == fed.topic && played(&record).is_some() {
            // What was said before this sample was taken stands before it.
            copy(&mut new_samples, &mut writer, Some(record.header().stamp_nanos))?;
        }
        writer.write_record(&topic, &record)?;
    }
    copy(&mut new_samples, &mut writer, None)?;
    let written: Vec<String> = writer.finish()?.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
    Ok(format!("updated: {}", written.join(", ")))
}

/// Copies what was taken before a time; all that is left if there is none.
fn copy(
    samples: &mut Peekable<impl Iterator<Item = Result<(String, Record), RecordingError>>>,
    writer: &mut RecordingWriter,
    before_nanos: Option<u64>,
) -> anyhow::Result<()> {
    let is_due = |sample: &Result<(String, Record), RecordingError>| match (sample, before_nanos) {
        (Ok((_, record)), Some(before)) => record.header().stamp_nanos < before,
        _ => true,
    };
    while let Some(sample) = samples.next_if(is_due) {
        let (topic, record) = sample?;
        writer.write_record(&topic, &record)?;
    }
    Ok(())
}

/// What a stage said of a sample bears the recorded number of that.
fn with_recorded_number(mut record: Record, coverage: &Coverage) -> Record {
    let header = match &mut record {
        Record::Tactile(sample) => &mut sample.header,
        Record::Contacts(sample) => &mut sample.header,
        Record::Feature(sample) => &mut sample.header,
        Record::Prediction(sample) => &mut sample.header,
        // These count for themselves.
        Record::Decision(_) | Record::Truth(_) | Record::Outcome(_) | Record::Advice(_) | Record::Scene(_) => {
            return record;
        }
    };
    header.seq = coverage.recorded_seq(header);
    record
}
