//! Writing a recording anew with the results of a replay of it.

use std::collections::{BTreeMap, BTreeSet};
use std::iter::Peekable;
use std::path::Path;

use serde_json::{Map, Value};

use super::comparison::Coverage;
use super::played::is_played;
use super::rewrite::{FedEdge, Origin};
use blindgrasp_graph::recorded_graph::{GRAPH_METADATA, attached_model};
use blindgrasp_messages::with_sample;
use blindgrasp_recording::{
    Attachment, Record, RecordingError, RecordingReader, RecordingWriter, ShownHand, TOPICS_FOR_VIEWERS, attachments,
};

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

/// Writes the recording anew and says what it wrote. The edges of the replay take the place of the recorded ones. If the recording
/// has metadata about its graph, the programs, parameters, versions and models of the nodes that ran become those of the replay. The
/// played topic, labels, scenes, all other metadata and attachments, and the edges of stages that did not run stay. Topics for viewers
/// are made again if the files of the recording's hand are attached: then this library has written them.
///
/// # Errors
/// See [`UpdateError`].
pub fn update(
    recording: &Path,
    found: &Path,
    played_topic: &str,
    edges: &[FedEdge],
    coverage: &Coverage,
    hand: Option<ShownHand>,
) -> Result<String, UpdateError> {
    let reader = RecordingReader::open(recording)?;
    let mut attachments = attachments(recording)?;
    let is_shown = attachments.iter().any(|file| file.name == ShownHand::URDF_NAME);
    let hand = if is_shown { hand } else { None };
    let is_lost = |(topic, schema): &(&String, &String)| {
        let is_made_anew = hand.is_some() && TOPICS_FOR_VIEWERS.contains(&topic.as_str());
        !schema.starts_with("blindgrasp_msgs/") && !is_made_anew
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
    let replay = RecordingReader::open(found)?;
    let mut metadata = reader.all_metadata().clone();
    if let (Some(about), Some(of_replay)) = (metadata.get_mut(GRAPH_METADATA), replay.metadata(GRAPH_METADATA)) {
        let files: BTreeSet<String> = update_graph(about, of_replay).iter().map(|node| attached_model(node)).collect();
        attachments.retain(|file| !files.contains(&file.name));
        attachments.extend(self::attachments(found)?.into_iter().filter(|file| files.contains(&file.name)));
    }
    let mut new_samples = replay
        .filter_map(|record| match record {
            Ok((topic, record)) => new_name(&topic).map(|topic| Ok((topic, with_recorded_number(record, coverage)))),
            Err(error) => Some(Err(error)),
        })
        .peekable();
    let mut writer = begin(recording, &reader, metadata, &attachments, hand)?;
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

/// Gives the nodes that ran in the replay the programs, parameters, versions and models that they had there, and returns their names.
/// The replay plays the recorded sources, which stay as they are.
fn update_graph(about: &mut BTreeMap<String, String>, of_replay: &BTreeMap<String, String>) -> Vec<String> {
    let read = |from: &BTreeMap<String, String>, key: &str| -> Map<String, Value> {
        from.get(key).and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default()
    };
    let (mut graph, replay) = (read(about, "graph"), read(of_replay, "graph"));
    let (Some(nodes), Some(replayed)) =
        (graph.get_mut("nodes").and_then(Value::as_array_mut), replay.get("nodes").and_then(Value::as_array))
    else {
        return Vec::new();
    };
    let mut nodes_that_ran = Vec::new();
    for node in nodes {
        let same = replayed.iter().find(|other| other["id"] == node["id"]);
        let Some(same) = same.filter(|same| same["inputs"].as_array().is_some_and(|inputs| !inputs.is_empty())) else {
            continue;
        };
        nodes_that_ran.extend(same["id"].as_str().map(String::from));
        for key in ["operator", "version", "program", "args", "params"] {
            node[key] = same[key].clone();
        }
    }
    about.insert("graph".into(), Value::Object(graph).to_string());
    for key in ["models", "operator_versions"] {
        let (mut all, mut new) = (read(about, key), read(of_replay, key));
        for node in &nodes_that_ran {
            all.remove(node);
            all.extend(new.remove_entry(node));
        }
        about.insert(key.into(), Value::Object(all).to_string());
    }
    nodes_that_ran
}

/// Begins the new recording with this metadata and these attachments.
fn begin(
    recording: &Path,
    reader: &RecordingReader,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    attachments: &[Attachment<'_>],
    hand: Option<ShownHand>,
) -> Result<RecordingWriter, RecordingError> {
    let mut writer = RecordingWriter::create(recording, reader.info())?;
    for (name, metadata) in metadata {
        writer.write_metadata(&name, metadata)?;
    }
    for file in attachments {
        // The hand's own files are attached with it.
        if hand.is_none() || ![ShownHand::LAYOUT_NAME, ShownHand::URDF_NAME].contains(&file.name.as_str()) {
            writer.attach(file)?;
        }
    }
    if let Some(hand) = hand {
        writer.show(hand)?;
    }
    Ok(writer)
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use serde_json::json;

    use super::*;
    use blindgrasp_messages::{ContactSet, Header, Stamped, TactileFrame};
    use blindgrasp_recording::{LiveOptions, LiveRecorder, RecordingInfo};

    fn hand() -> ShownHand {
        ShownHand {
            joint_names: Vec::new(),
            layout: "name: h".into(),
            urdf: "<robot/>".into(),
            link_poses: Arc::new(|_| Vec::new()),
        }
    }

    /// Updates a recording by a replay without samples.
    fn updated(path: &Path, hand: Option<ShownHand>) -> Result<String, UpdateError> {
        let coverage = Coverage::of(path, "/tactile").expect("covered");
        update(path, path, "/tactile", &[], &coverage, hand)
    }

    #[test]
    fn an_update_says_which_models_answered() {
        let folder = tempfile::tempdir().expect("a folder");
        let record = |name: &str, source: &str, model: &str| {
            let path = folder.path().join(name);
            let info = RecordingInfo { hand: "h".into(), hand_id: 1, made_by: "a test".into(), version: "0".into() };
            let node = |id: &str, from: &[&str]| json!({"id": id, "params": {"model": model}, "inputs": from});
            let nodes = [node(source, &[]), node("classifier", &[source]), node("lift_arbiter", &["classifier"])];
            let graph = json!({ "nodes": nodes });
            let models = json!({"classifier": model});
            let about = [("graph", graph), ("models", models)].map(|(key, value)| (key.to_string(), value.to_string()));
            let files = [("notes.txt", name), ("model of classifier.json", model)];
            let attachments = files.map(|(file, text)| (file.to_string(), text.as_bytes().to_vec())).into();
            let metadata = BTreeMap::from([(GRAPH_METADATA.to_string(), BTreeMap::from(about))]);
            let options = LiveOptions { metadata, attachments, ..LiveOptions::default() };
            let mut recorder = LiveRecorder::create(&path, &info, options).expect("created");
            let frame = Stamped { header: Header::default(), message: TactileFrame::default() };
            recorder.write("/tactile", &Record::Tactile(frame)).expect("written");
            recorder.finish().expect("finished");
            path
        };
        let (path, found) = (record("run.mcap", "hand", "old"), record("found.mcap", "player", "new"));
        let coverage = Coverage::of(&path, "/tactile").expect("covered");
        update(&path, &found, "/tactile", &[], &coverage, None).expect("updated");
        let reader = RecordingReader::open(&path).expect("opened");
        let about = reader.metadata(GRAPH_METADATA).expect("there");
        let graph: Value = serde_json::from_str(&about["graph"]).expect("JSON");
        let models = [0, 1, 2].map(|idx| graph["nodes"][idx]["params"]["model"].as_str().expect("a path"));
        assert_eq!(models, ["old", "new", "new"]);
        assert_eq!(graph["nodes"][1]["inputs"], json!(["hand"]), "the recorded edge");
        assert_eq!(about["models"], r#"{"classifier":"new"}"#);
        let mut files: Vec<_> =
            attachments(&path).expect("read").into_iter().map(|file| (file.name, file.data)).collect();
        files.sort();
        let file = |name: &str, text: &'static str| (name.to_string(), text.as_bytes().into());
        assert_eq!(files, [file("model of classifier.json", "new"), file("notes.txt", "run.mcap")]);
    }

    #[test]
    fn an_update_keeps_attachments_and_topics_for_viewers_and_drops_no_foreign_topic() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let record = |hand: Option<ShownHand>| {
            let info = RecordingInfo { hand: "h".into(), hand_id: 1, made_by: "a test".into(), version: "0".into() };
            let attachments = BTreeMap::from([("model.json".to_string(), b"{}".to_vec())]);
            let options = LiveOptions { hand, attachments, overwrite: true, ..LiveOptions::default() };
            let mut recorder = LiveRecorder::create(&path, &info, options).expect("created");
            let header = Header::default();
            let frame = Record::Tactile(Stamped { header, message: TactileFrame::default() });
            let contacts = Record::Contacts(Stamped { header, message: ContactSet::default() });
            recorder.write("/tactile", &frame).expect("written");
            recorder.write("/contacts", &contacts).expect("written");
            recorder.finish().expect("finished");
        };
        record(Some(hand()));
        let topics = || RecordingReader::open(&path).expect("opened").topics().clone();
        let (before, attached) = (topics(), attachments(&path).expect("read"));
        assert_eq!((before.len(), attached.len()), (2 + TOPICS_FOR_VIEWERS.len(), 3));
        updated(&path, Some(hand())).expect("updated");
        assert_eq!(topics(), before);
        let found = attachments(&path).expect("read");
        assert!(found.iter().all(|file| attached.contains(file)) && found.len() == 3, "{found:?}");
        // Without the hand they would be lost, and of a recording without the files of its hand they may be a robot's own.
        let refused = updated(&path, None).expect_err("a hand is missing").to_string();
        assert!(refused.contains("/contact_points") && refused.contains("would be lost"), "{refused}");
        record(None);
        let refused = updated(&path, Some(hand())).expect_err("a foreign topic").to_string();
        assert!(refused.contains("/contact_points") && refused.contains("would be lost"), "{refused}");
        assert_eq!(attachments(&path).expect("read").len(), 1);
    }
}
