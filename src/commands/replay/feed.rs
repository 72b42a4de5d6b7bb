//! A recording put into a graph in place of a node.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde_json::{Map, Value, json};

use blindgrasp_cli::graph_file::{describe, shipped};
use blindgrasp_graph::dataflow::{Graph, Override, Program, accept_param_value};
use blindgrasp_graph::plan::Port;
use blindgrasp_graph::run::observed_topics;
use blindgrasp_messages::{ContactSet, GraspFeature, Prediction, TactileFrame};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_recording::{Reach, RecordingReader, TOPICS_FOR_VIEWERS};
use blindgrasp_replay::playback::{Next, Playback};
use blindgrasp_replay::played::Played;
use blindgrasp_replay::rewrite::{FedEdge, Origin, PLAYER, Player, Replaced};
use blindgrasp_replay::selection::Selection;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

/// A larger recording is not read through before the start to check that the selection is not empty.
const MAX_SEARCHED_BYTES: u64 = 64 << 20;

/// A recording to play, and how.
pub(in crate::commands) struct Feed<'a> {
    pub(in crate::commands) recording: &'a Path,
    /// The node to replace; `None` for the source.
    pub(in crate::commands) replace: Option<&'a str>,
    pub(in crate::commands) selection: &'a Selection,
    /// The player's param: a number, or `max`.
    pub(in crate::commands) rate: Value,
    pub(in crate::commands) repeat: Value,
}

/// A graph that is fed by a recording.
pub(in crate::commands) struct Fed {
    pub(in crate::commands) graph: Graph,
    pub(in crate::commands) replaced: Replaced,
    /// The played topic.
    pub(in crate::commands) topic: String,
    /// All edges of the rewritten graph that can be recorded, in the graph's order.
    pub(in crate::commands) edges: Vec<FedEdge>,
}

impl Feed<'_> {
    /// Puts the recording into a checked graph.
    ///
    /// # Errors
    /// The recording does not fit the graph, or no grasp of it is selected.
    pub(in crate::commands) fn into_graph(self, graph: &Graph, overrides: &[Override]) -> anyhow::Result<Fed> {
        let replaced = Replaced::find(graph, self.replace)?;
        let of_one_node = overrides.iter().filter_map(|set| Some((set, set.node.as_ref()?)));
        for (set, node) in of_one_node {
            if *node == replaced.node || !replaced.running.contains(node) {
                bail!("--set {set}: node '{node}' does not run, the recording replaces it");
            }
        }
        let running: Vec<_> = replaced.running.iter().filter_map(|id| graph.node(id)).collect();
        for set in overrides.iter().filter(|set| set.node.is_none()) {
            let mut params = running.iter().flat_map(|node| &node.description.params);
            if !params.any(|param| param.name == set.param) {
                bail!("--set {set}: no node that runs has this param, the recording replaces node '{}'", replaced.node);
            }
        }
        let reader = RecordingReader::open(self.recording)?;
        compare_hands(graph, &reader, self.recording)?;
        let topics = observed_topics(graph, true);
        let port = (replaced.node.clone(), replaced.port.clone());
        let expected = topics.get(&port).cloned().unwrap_or_else(|| format!("/{}", replaced.port));
        let topic = find_topic(&reader, &expected, &replaced.type_name)
            .with_context(|| format!("recording {}", self.recording.display()))?;
        let player = self.player(&replaced, &topic)?;
        self.check_selection(&replaced, &topic)?;
        let rewritten = replaced.rewrite(graph, &player);
        let edges = edges(&rewritten, &replaced, &topic, &topics);
        Ok(Fed { graph: rewritten, replaced, topic, edges })
    }

    fn player(&self, replaced: &Replaced, topic: &str) -> anyhow::Result<Player> {
        let program = shipped()?.get(PLAYER).cloned().context("the operator recorded_source is missing")?;
        let program = Program { args: program.args_with(&[replaced.played_port.to_string()]), ..program };
        let description = describe(&program.path, &program.args)
            .map_err(|error| anyhow::anyhow!("the operator {PLAYER} cannot be used: {error}"))?;
        let Selection { from_nanos, to_nanos, grasps } = self.selection;
        let [from_s, to_s] = [from_nanos, to_nanos].map(|nanos| nanos.map(|nanos| json!(nanos as f64 / 1e9)));
        let recording = std::path::absolute(self.recording)?;
        let params = [
            ("recording", Some(json!(recording.to_str().context("the recording's path is not UTF-8")?))),
            ("rate", Some(self.rate.clone())),
            ("repeat", Some(self.repeat.clone())),
            ("steps", Some(json!("unlimited"))),
            ("from_s", from_s),
            ("to_s", to_s),
            ("grasps", grasps.as_ref().map(|grasps| json!(grasps.to_string()))),
            ("topic", Some(json!(topic))),
        ];
        let mut accepted = Map::new();
        for (name, value) in params {
            let Some(value) = value else { continue };
            let value = accept_param_value(&description, name, &value, Path::new(""));
            accepted.insert(name.into(), value.map_err(anyhow::Error::msg)?);
        }
        Ok(Player { program, description, params: accepted })
    }

    /// Checks that the selection is not empty, before the graph starts.
    fn check_selection(&self, replaced: &Replaced, topic: &str) -> anyhow::Result<()> {
        let n_bytes = std::fs::metadata(self.recording)?.len();
        if n_bytes > MAX_SEARCHED_BYTES {
            return Ok(());
        }
        let (recording, selection) = (self.recording, self.selection);
        match replaced.played_port {
            ContactSet::PORT => seek::<ContactSet>(recording, selection, topic),
            GraspFeature::PORT => seek::<GraspFeature>(recording, selection, topic),
            Prediction::PORT => seek::<Prediction>(recording, selection, topic),
            _ => seek::<TactileFrame>(recording, selection, topic),
        }
    }
}

/// The edges of the rewritten graph. `topics` are the topics in a recording of the whole graph.
fn edges(rewritten: &Graph, replaced: &Replaced, played: &str, topics: &BTreeMap<Port, String>) -> Vec<FedEdge> {
    let found = observed_topics(rewritten, true);
    let outputs = rewritten.nodes.iter().flat_map(|node| node.outputs().iter().map(move |output| (node, output)));
    let fed = outputs.filter_map(|(node, output)| {
        let port = (node.id.clone(), output.name.clone());
        let found_topic = found.get(&port)?.clone();
        let origin = if node.id != replaced.node {
            Origin::Stage
        } else if output.name == replaced.played_port {
            Origin::Played
        } else {
            Origin::Truth
        };
        let recorded_topic = match origin {
            Origin::Played => played.to_string(),
            Origin::Truth | Origin::Stage => topics.get(&port).unwrap_or(&found_topic).clone(),
        };
        Some(FedEdge { recorded_topic, found_topic, origin })
    });
    fed.collect()
}

/// Reads to the first selected sample.
fn seek<M: Played>(recording: &Path, selection: &Selection, topic: &str) -> anyhow::Result<()> {
    for next in Playback::<M>::open(recording, selection, Some(topic), Reach::Whole)? {
        if let Next::Frame(_) = next? {
            break;
        }
    }
    Ok(())
}

/// The recorded topic of an output: the topic of its name, or the only topic of its type.
fn find_topic(reader: &RecordingReader, expected: &str, type_name: &str) -> anyhow::Result<String> {
    let topics = reader.topics();
    let short = type_name.split('/').nth(1);
    let of_type = topics.iter().filter(|(_, schema)| schema.split('/').nth(2) == short);
    let of_type: Vec<&String> = of_type.map(|(topic, _)| topic).collect();
    match of_type.as_slice() {
        _ if of_type.iter().any(|topic| *topic == expected) => Ok(expected.into()),
        [only] => Ok((*only).clone()),
        [] => {
            let own = topics.keys().filter(|topic| !TOPICS_FOR_VIEWERS.contains(&topic.as_str()));
            let own: Vec<String> = own.cloned().collect();
            let found = if own.is_empty() { "nothing".into() } else { own.join(", ") };
            bail!("it holds no {expected} to replay; it has {found}")
        }
        _ => bail!(
            "it holds no {expected} to replay, and several topics of that type: {}; it was recorded from another graph",
            of_type.into_iter().cloned().collect::<Vec<_>>().join(", ")
        ),
    }
}

/// Prints a warning if the graph's nodes name another hand than the recording.
fn compare_hands(graph: &Graph, reader: &RecordingReader, recording: &Path) -> anyhow::Result<()> {
    let info = reader.info();
    let path = |name: &str| graph.nodes.iter().find_map(|node| Some(PathBuf::from(node.params.get(name)?.as_str()?)));
    let (name, id) = match (path("hand"), path("model")) {
        (Some(hand), _) => {
            let hand = Hand::load(&hand)?;
            (hand.name.clone(), hand.id())
        }
        (None, Some(model)) => {
            let model = Model::load(&model)?;
            (model.hand.name, model.hand.id)
        }
        (None, None) => return Ok(()),
    };
    if info.hand_id != 0 && info.hand_id != id {
        print_diagnostic(&format!(
            "blindgrasp: recording {} is of the hand {} ({:016x}), graph '{}' is for {name} ({id:016x}): every grasp will be \
             held; name the dataflow file of the recording's hand",
            recording.display(),
            info.hand,
            info.hand_id,
            graph.name
        ));
    }
    Ok(())
}
