//! What a recording of a running graph says of it.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;

use serde_json::{Map, Value, json};

use blindgrasp_graph::recorded_graph::{GRAPH_METADATA, attached_model};
use blindgrasp_grasps::dataset::{TRUTH_METADATA, label_of};
use blindgrasp_grasps::shown_hand::shown_hand;
use blindgrasp_messages::{LiftOutcome, Recorded};
use blindgrasp_recording::{LiveOptions, RecordingInfo, RecordingReader};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::label::Label;
use blindgrasp_stages::model::Model;

/// What is to be recorded of a graph, as [`describe_graph`](blindgrasp_graph::recorded_graph::describe_graph) describes it. The hand
/// is the one that a node has as its parameter `hand`. `is_at_start` says that the graph has sent no sample yet. The options get
/// the hand, the models and the metadata.
///
/// # Errors
/// The hand cannot be read.
pub fn of_graph(
    graph: &Value,
    is_at_start: bool,
    options: LiveOptions,
) -> anyhow::Result<(RecordingInfo, LiveOptions)> {
    let name = graph["name"].as_str().unwrap_or_default();
    let hand = param(graph, "hand").next().map(|(_, path)| Hand::load(Path::new(path))).transpose()?;
    let began = if is_at_start { "start" } else { "attached" };
    let versions = nodes(graph).filter_map(|node| Some((node["id"].as_str()?.to_string(), node["version"].clone())));
    let (models, attachments) = models(graph);
    let about = BTreeMap::from([
        ("name".into(), name.into()),
        ("began".into(), began.into()),
        ("recorded_at".into(), humantime::format_rfc3339_seconds(SystemTime::now()).to_string()),
        ("blindgrasp_version".into(), env!("CARGO_PKG_VERSION").into()),
        ("graph".into(), graph.to_string()),
        ("operator_versions".into(), Value::Object(versions.collect()).to_string()),
        ("models".into(), models.to_string()),
    ]);
    let mut metadata = BTreeMap::from([(GRAPH_METADATA.into(), about)]);
    if let Some(label) = label(graph) {
        metadata.insert(TRUTH_METADATA.into(), BTreeMap::from([("label".into(), label.word().into())]));
    }
    let info = RecordingInfo {
        hand: hand.as_ref().map_or("unknown".into(), |hand| hand.name.clone()),
        hand_id: hand.as_ref().map_or(0, Hand::id),
        made_by: format!("graph {name}"),
        version: env!("CARGO_PKG_VERSION").into(),
    };
    Ok((info, LiveOptions { hand: hand.as_ref().map(shown_hand), attachments, metadata, ..options }))
}

/// What stable means in the truth that a graph tells: a lift's where a node says what became of lifts, and otherwise what
/// it means in the recording that a node plays.
fn label(graph: &Value) -> Option<Label> {
    let says_outcomes = |node: &Value| {
        node["outputs"].as_array().is_some_and(|ports| ports.iter().any(|port| port["type"] == LiftOutcome::TYPE_NAME))
    };
    if nodes(graph).any(says_outcomes) {
        return Some(Label::Lift);
    }
    param(graph, "recording").find_map(|(_, path)| {
        // One that cannot be read is its source's to complain of.
        let reader = RecordingReader::open(Path::new(path)).ok()?;
        label_of(Path::new(path), &reader).ok()?
    })
}

/// The model of each node: its path, and its dictionary and checksum if this library can read it. The files that it can read come
/// beside, each once.
fn models(graph: &Value) -> (Value, BTreeMap<String, Vec<u8>>) {
    let (mut models, mut files) = (Map::new(), BTreeMap::new());
    for (node, path) in param(graph, "model") {
        let mut about = json!({ "path": path });
        // Several nodes may have one model.
        if let Some(known) = models.values().find(|known| known["path"] == path) {
            about = known.clone();
        } else if let Ok(model) = Model::load(Path::new(path)) {
            about["dictionary_id"] = format!("{:016x}", model.dictionary_id()).into();
            about["checksum"] = model.checksum.into();
            files.extend(std::fs::read(path).map(|file| (attached_model(node), file)));
        }
        models.insert(node.into(), about);
    }
    (models.into(), files)
}

/// The nodes of a graph.
pub fn nodes(graph: &Value) -> impl Iterator<Item = &Value> {
    graph["nodes"].as_array().into_iter().flatten()
}

/// The nodes that have a parameter of that name, and its value as text.
fn param<'a>(graph: &'a Value, name: &'static str) -> impl Iterator<Item = (&'a str, &'a str)> {
    nodes(graph).filter_map(move |node| Some((node["id"].as_str()?, node["params"][name].as_str()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_of_ours_are_attached_once_and_no_other_file() {
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/barrett-bh8-280.json");
        let other = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
        let node = |id: &str, path: &str| json!({"id": id, "params": {"model": path}});
        let graph = json!({"nodes": [node("torch", other), node("encoder", model), node("classifier", model)]});
        let (_, options) = of_graph(&graph, true, LiveOptions::default()).expect("described");
        let file = std::fs::read(model).expect("a model");
        assert_eq!(options.attachments, BTreeMap::from([("model of encoder.json".to_string(), file)]));
        let models: Value = serde_json::from_str(&options.metadata[GRAPH_METADATA]["models"]).expect("JSON");
        assert_eq!(models["classifier"], models["encoder"]);
        assert!(models["encoder"]["checksum"].is_string() && models["torch"] == json!({ "path": other }), "{models}");
    }
}
