//! The settings that a recorded graph had and the tested graph has not: a common reason for differing samples.

use std::path::Path;

use blindgrasp_graph::dataflow::{Graph, Node};
use blindgrasp_graph::recorded_graph::GRAPH_METADATA;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_recording::RecordingReader;
use blindgrasp_stages::model::Model;
use serde_json::Value;

/// The params of the recorded graph that have other values than in the dataflow file, as they stand after `--set`. A file that is
/// not there any more is left out.
pub(super) fn recorded(recording: &RecordingReader, file_graph: &Graph) -> Vec<String> {
    let about = recording.metadata(GRAPH_METADATA).and_then(|about| about.get("graph"));
    let recorded: Value = about.and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
    let mut sets = Vec::new();
    for then in recorded["nodes"].as_array().into_iter().flatten() {
        let node = then["id"].as_str().and_then(|id| file_graph.node(id)).filter(|node| !node.is_source());
        let (Some(node), Some(params)) = (node, then["params"].as_object()) else { continue };
        for (name, value) in params {
            let is_known = node.description.params.iter().any(|param| param.name == *name);
            let text = value.as_str().map_or_else(|| value.to_string(), String::from);
            let is_gone = is_path(node, name) && !Path::new(&text).exists();
            if is_known && !is_gone && node.params.get(name) != Some(value) && !value.is_null() {
                sets.push(format!("{}.{name}={text}", node.id));
            }
        }
    }
    sets
}

/// A note on the parameters and models that differ; `None` if none do, or the recording does not say.
pub(super) fn differing(recording: &RecordingReader, graph: &Graph) -> Option<String> {
    let about = recording.metadata(GRAPH_METADATA)?;
    let recorded: Value = serde_json::from_str(about.get("graph")?).ok()?;
    let models: Value = about.get("models").and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
    let mut differing = Vec::new();
    // The source is replaced.
    for node in graph.nodes.iter().filter(|node| !node.is_source()) {
        let mut nodes = recorded["nodes"].as_array()?.iter();
        let params = nodes.find(|other| other["id"] == node.id.as_str()).map_or(&Value::Null, |node| &node["params"]);
        for (name, now) in &node.params {
            let (then, at) = (&params[name], format!("{}.{name}", node.id));
            if name == "model" {
                let then = models[&node.id]["checksum"].as_str();
                let now = now.as_str().and_then(|path| Model::load(path.as_ref()).ok());
                if then.zip(now.as_ref()).is_some_and(|(then, now)| then != now.checksum) {
                    differing.push(format!("{at} was another model"));
                }
            } else if !then.is_null() && then != now && !is_path(node, name) {
                differing.push(format!("{at} was {then} and is {now}"));
            }
        }
    }
    let hint = "use a dataflow file with the same settings (`dataflow:` in the expectations), or --update";
    (!differing.is_empty()).then(|| format!("the recorded graph had other settings: {}; {hint}", differing.join(", ")))
}

/// Folders differ from machine to machine.
pub(super) fn is_path(node: &Node, param: &str) -> bool {
    let param = node.description.params.iter().find(|known| known.name == param);
    param.is_some_and(|param| matches!(param.kind, ParamKind::Path { .. }))
}
