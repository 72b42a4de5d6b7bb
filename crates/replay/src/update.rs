//! Writing a recording anew with the results of a replay of it.

use std::collections::BTreeSet;
use std::iter::Peekable;
use std::path::Path;

use super::comparison::Coverage;
use super::played::is_played;
use super::rewrite::{FedEdge, Origin};
use blindgrasp_messages::with_sample;
use blindgrasp_recording::{Record, RecordingError, RecordingReader, RecordingWriter, TOPICS_FOR_VIEWERS};

/// Why a recording cannot be updated.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(
        "the recording also holds {topic}, of type {schema}, which would be lost: keep such topics in a recording of their own"
    )]
    OtherTopic { topic: String, schema: String },
}

/// Writes the recording anew and says what it wrote. The edges of the replay take the place of the recorded ones; the
/// played topic, labels, scenes, metadata, and the edges of stages that did not run stay. Topics for viewers are left out:
/// they follow from the samples.
///
/// # Errors
/// See [`UpdateError`].
pub fn update(
    recording: &Path,
    found: &Path,
    played_topic: &str,
    edges: &[FedEdge],
    coverage: &Coverage,
) -> Result<String, UpdateError> {
    let reader = RecordingReader::open(recording)?;
    let is_lost = |(topic, schema): &(&String, &String)| {
        !schema.starts_with("blindgrasp_msgs/") && !TOPICS_FOR_VIEWERS.contains(&topic.as_str())
    };
    if let Some((topic, schema)) = reader.topics().iter().find(is_lost) {
        return Err(UpdateError::OtherTopic { topic: topic.clone(), schema: schema.clone() });
    }
    let of_stages = || edges.iter().filter(|edge| edge.origin == Origin::Stage);
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
        if topic == played_topic && is_played(&record) {
            copy(&mut new_samples, &mut writer, Some(record.header().stamp_nanos))?;
        }
        writer.write_record(&topic, &record)?;
    }
    copy(&mut new_samples, &mut writer, None)?;
    let written: Vec<String> = writer.finish()?.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
    Ok(format!("updated: {}", written.join(", ")))
}

/// Copies the samples that are older than `before_nanos`; all samples if it is `None`.
fn copy(
    samples: &mut Peekable<impl Iterator<Item = Result<(String, Record), RecordingError>>>,
    writer: &mut RecordingWriter,
    before_nanos: Option<u64>,
) -> Result<(), RecordingError> {
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

/// A stage's answer takes the recorded number of the sample that it answers.
fn with_recorded_number(mut record: Record, coverage: &Coverage) -> Record {
    // The other messages have numbers of their own.
    if is_played(&record) {
        with_sample!(&mut record, sample => sample.header.seq = coverage.recorded_seq(&sample.header));
    }
    record
}
