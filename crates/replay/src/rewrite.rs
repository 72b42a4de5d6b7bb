//! A graph in which a recording takes the place of a node.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::played::PLAYED;
use blindgrasp_graph::dataflow::pins::Pins;
use blindgrasp_graph::dataflow::{EdgeOptions, Graph, Input, Node, Program, Restart, RestartPolicy};
use blindgrasp_messages::{GraspTruth, Recorded};
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::wiring::EdgePolicy;

/// The program that plays recordings.
pub const PLAYER: &str = "recorded_source";

/// Why a recording cannot take a node's place.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct RewriteError(String);

/// The node that the recording replaces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replaced {
    pub node: String,
    /// The output that the recording replaces.
    pub port: String,
    pub type_name: String,
    /// The player's port for samples of that type.
    pub played_port: &'static str,
    /// The nodes that run: the player in place of `node`, and the nodes behind it.
    pub running: BTreeSet<String>,
}

/// The player in a node's place.
#[derive(Debug, Clone)]
pub struct Player {
    /// The played port is the last argument.
    pub program: Program,
    pub description: OperatorDescription,
    /// Checked params, with defaults.
    pub params: Map<String, Value>,
}

/// An edge of a graph that is fed by a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct FedEdge {
    /// The edge's topic in a recording of the whole graph.
    pub recorded_topic: String,
    /// The edge's topic in a recording of the fed graph.
    pub found_topic: String,
    pub origin: Origin,
}

/// Where an edge's samples come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The recording's frames.
    Played,
    /// The recording's labels of grasps.
    Truth,
    /// A stage that runs.
    Stage,
}

impl Replaced {
    /// Finds the node that a recording replaces: the named one, or the graph's source.
    ///
    /// # Errors
    /// There is no such node, or there are several sources; recordings do not hold the node's output; no node lies behind
    /// it, or a node behind it also reads from elsewhere.
    pub fn find(graph: &Graph, named: Option<&str>) -> Result<Replaced, RewriteError> {
        let node = replaced_node(graph, named)?;
        let (output, played_port) = played_output(graph, node)?;
        let replaced = Replaced {
            node: node.id.clone(),
            port: output.name.clone(),
            type_name: output.type_name.clone(),
            played_port,
            running: behind(graph, &node.id),
        };
        let running = graph.nodes.iter().filter(|other| other.id != node.id && replaced.running.contains(&other.id));
        for (reader, input) in running.flat_map(|node| node.inputs.iter().map(move |input| (node, input))) {
            if !replaced.running.contains(&input.from_node) {
                return Err(RewriteError(format!(
                    "node '{}' also reads {}/{}, which nothing would feed: replace a node before both",
                    reader.id, input.from_node, input.from_port
                )));
            }
            if replaced.played_port_of(input).is_none() {
                return Err(RewriteError(format!(
                    "node '{}' reads {}/{}, a {}, which the recording cannot feed beside {}",
                    reader.id, input.from_node, input.from_port, input.type_name, replaced.port
                )));
            }
        }
        Ok(replaced)
    }

    /// The graph with the player in the node's place, under its id. Nodes that do not run are left out. All edges are
    /// lossless, so that results do not depend on speed.
    pub fn rewrite(&self, graph: &Graph, player: &Player) -> Graph {
        let nodes = graph.nodes.iter().filter(|node| self.running.contains(&node.id)).map(|node| {
            if node.id == self.node {
                return Node {
                    program: player.program.path.clone(),
                    args: player.program.args.clone(),
                    description: player.description.clone(),
                    inputs: Vec::new(),
                    params: player.params.clone(),
                    sha256: Pins::default(),
                    // A restart would meet the same error again: the first one is to be reported.
                    restart: Restart { policy: RestartPolicy::Never, ..node.restart },
                    ..node.clone()
                };
            }
            let inputs = node.inputs.iter().map(|input| {
                let from_port = self.played_port_of(input).unwrap_or(&input.from_port).to_string();
                Input { from_port, edge: lossless(input.edge), ..input.clone() }
            });
            Node { inputs: inputs.collect(), ..node.clone() }
        });
        Graph { nodes: nodes.collect(), ..graph.clone() }
    }

    /// The player's port that feeds an input; the input's own port if another node feeds it.
    fn played_port_of<'a>(&'a self, input: &'a Input) -> Option<&'a str> {
        if input.from_node != self.node {
            Some(&input.from_port)
        } else if input.from_port == self.port {
            Some(self.played_port)
        } else {
            (input.type_name == GraspTruth::TYPE_NAME).then_some("truth")
        }
    }
}

/// The named node, or the graph's only source.
fn replaced_node<'a>(graph: &'a Graph, named: Option<&str>) -> Result<&'a Node, RewriteError> {
    if let Some(id) = named {
        return match graph.node(id) {
            Some(node) => Ok(node),
            None => Err(RewriteError(format!("there is no node '{id}'; nodes: {}", ids(&graph.nodes)))),
        };
    }
    let sources: Vec<&Node> = graph.nodes.iter().filter(|node| node.is_source()).collect();
    match sources.as_slice() {
        [only] => Ok(only),
        _ => Err(RewriteError(format!(
            "graph '{}' has {} sources, {}: choose one with --replace NODE",
            graph.name,
            sources.len(),
            ids(sources)
        ))),
    }
}

/// The only output of a node that is read and that a recording can play, and the player's port for it.
fn played_output<'a>(graph: &Graph, node: &'a Node) -> Result<(&'a PortDescription, &'static str), RewriteError> {
    let inputs = graph.nodes.iter().flat_map(|node| &node.inputs);
    let read: Vec<_> = inputs.filter(|input| input.from_node == node.id && !input.feedback).collect();
    if read.is_empty() {
        return Err(RewriteError(format!("nothing lies behind node '{}'", node.id)));
    }
    let mut playable = Vec::new();
    for output in node.outputs() {
        if let Some((port, _)) = PLAYED.iter().find(|(_, type_name)| *type_name == output.type_name)
            && read.iter().any(|input| input.from_port == output.name)
        {
            playable.push((output, *port));
        }
    }
    match playable.as_slice() {
        [only] => Ok(*only),
        [] => Err(RewriteError(format!(
            "a recording cannot replace node '{}': expected an output that is read and of a type among {}",
            node.id,
            PLAYED.map(|(_, type_name)| type_name).join(", ")
        ))),
        several => {
            let ports: Vec<_> = several.iter().map(|(output, _)| output.name.as_str()).collect();
            Err(RewriteError(format!(
                "a recording cannot replace node '{}': several of its outputs are read, {}; expected one",
                node.id,
                ports.join(", ")
            )))
        }
    }
}

fn lossless(edge: EdgeOptions) -> EdgeOptions {
    match edge.policy {
        EdgePolicy::Lossless => edge,
        EdgePolicy::Latest => EdgeOptions { deadline_millis: edge.deadline_millis, ..EdgeOptions::default() },
    }
}

/// The node and all nodes that depend on it, not counting feedback. Nodes come after the nodes that they read from.
fn behind(graph: &Graph, id: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::from([id.to_string()]);
    for node in &graph.nodes {
        if node.inputs.iter().any(|input| !input.feedback && found.contains(&input.from_node)) {
            found.insert(node.id.clone());
        }
    }
    found
}

fn ids<'a>(nodes: impl IntoIterator<Item = &'a Node>) -> String {
    nodes.into_iter().map(|node| node.id.as_str()).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_graph::dataflow;
    use blindgrasp_graph::operators::Operators;
    use blindgrasp_messages::{ContactSet, LiftDecision, Prediction, TactileFrame};

    const CHAIN: &str = "  camera:\n  contacts:\n    inputs: {in: {from: camera/frames, policy: latest}}\n  \
                         judge:\n    inputs: {in: contacts/out, truth: camera/labels}\n  arbiter:\n    inputs: {in: judge/out}\n";

    fn graph(nodes: &str) -> Graph {
        let text = format!("version: 1\nname: g\noperators:\n{nodes}");
        let file = dataflow::parse(Path::new("g.yaml"), text.as_bytes()).expect("a file");
        let programs = ["camera", "other_camera", "robot", "contacts", "judge", "arbiter", "fusion"];
        let shipped = Operators::in_folder(Path::new(""), &programs);
        let describe = |program: &Path, _: &[String]| {
            let name = program.to_str().expect("UTF-8");
            let it = OperatorDescription::new(name, "");
            let mut it =
                match name {
                    "contacts" => it.input("in", TactileFrame::TYPE_NAME, "").output("out", ContactSet::TYPE_NAME, ""),
                    "judge" => it
                        .input("in", ContactSet::TYPE_NAME, "")
                        .input("truth", GraspTruth::TYPE_NAME, "")
                        .output("out", Prediction::TYPE_NAME, ""),
                    "fusion" => it
                        .input("a", TactileFrame::TYPE_NAME, "")
                        .input("b", TactileFrame::TYPE_NAME, "")
                        .output("out", ContactSet::TYPE_NAME, ""),
                    "robot" => it
                        .feedback_input("decision", LiftDecision::TYPE_NAME, "")
                        .output("frames", TactileFrame::TYPE_NAME, "")
                        .output("labels", GraspTruth::TYPE_NAME, ""),
                    "arbiter" => it.input("in", Prediction::TYPE_NAME, "").output("out", LiftDecision::TYPE_NAME, ""),
                    _ => it.output("frames", TactileFrame::TYPE_NAME, "").output("labels", GraspTruth::TYPE_NAME, ""),
                };
            it.inputs.iter_mut().filter(|input| input.name == "truth").for_each(|input| input.optional = true);
            Ok(it)
        };
        dataflow::check(&file, &shipped, &[], dataflow::Scope::Everything, describe).expect("a graph")
    }

    fn player() -> Player {
        Player {
            program: Program { path: "player".into(), args: vec!["tactile".into()] },
            description: OperatorDescription::new(PLAYER, ""),
            params: Map::from_iter([("rate".into(), "max".into())]),
        }
    }

    #[test]
    fn the_player_takes_the_sources_place_and_its_id() {
        let graph = graph(CHAIN);
        let replaced = Replaced::find(&graph, None).expect("one source");
        let rewritten = replaced.rewrite(&graph, &player());
        let edges: Vec<String> = rewritten
            .edges()
            .map(|edge| format!("{}/{} {}/{}", edge.from_node, edge.from_port, edge.to_node, edge.to_port))
            .collect();
        assert_eq!(
            edges,
            ["camera/tactile contacts/in", "contacts/out judge/in", "camera/truth judge/truth", "judge/out arbiter/in"]
        );
        let source = rewritten.node("camera").expect("its id");
        assert_eq!((source.program.to_str(), source.args.as_slice()), (Some("player"), &["tactile".to_string()][..]));
        assert_eq!(source.params, player().params);
        assert!(rewritten.nodes.iter().flat_map(|node| &node.inputs).all(|input| input.edge == EdgeOptions::default()));
    }

    #[test]
    fn only_what_lies_behind_a_replaced_stage_runs() {
        let chain = CHAIN.replace(", truth: camera/labels", "");
        let graph = graph(&chain);
        let replaced = Replaced::find(&graph, Some("contacts")).expect("a stage");
        let rewritten = replaced.rewrite(&graph, &player());
        let nodes: Vec<&str> = rewritten.nodes.iter().map(|node| node.id.as_str()).collect();
        assert_eq!(nodes, ["contacts", "judge", "arbiter"]);
        assert_eq!(rewritten.nodes[1].inputs[0].from_port, "contacts");
    }

    #[test]
    fn who_takes_a_robots_place_hears_nothing_of_the_decisions() {
        let chain = CHAIN.replace("camera:\n", "camera:\n    run: robot\n    inputs: {decision: arbiter/out}\n");
        let graph = graph(&chain);
        for (named, expected) in
            [(None, &["camera", "contacts", "judge", "arbiter"][..]), (Some("judge"), &["judge", "arbiter"])]
        {
            let replaced = Replaced::find(&graph, named).expect("one source");
            let rewritten = replaced.rewrite(&graph, &player());
            let nodes: Vec<&str> = rewritten.nodes.iter().map(|node| node.id.as_str()).collect();
            assert_eq!(nodes, expected);
            assert!(rewritten.nodes[0].inputs.is_empty());
        }
    }

    #[test]
    fn what_cannot_be_replaced_is_said() {
        let refusal =
            |nodes: &str, named: Option<&str>| Replaced::find(&graph(nodes), named).expect_err("refused").to_string();
        let fused = "  camera:\n  other_camera:\n  fusion:\n    inputs: {a: camera/frames, b: other_camera/frames}\n";
        assert_eq!(
            refusal(fused, None),
            "graph 'g' has 2 sources, camera, other_camera: choose one with --replace NODE"
        );
        assert_eq!(
            refusal(fused, Some("camera")),
            "node 'fusion' also reads other_camera/frames, which nothing would feed: replace a node before both"
        );
        assert_eq!(refusal(fused, Some("fusion")), "nothing lies behind node 'fusion'");
        assert_eq!(
            refusal(CHAIN, Some("judges")),
            "there is no node 'judges'; nodes: camera, contacts, judge, arbiter"
        );
        assert_eq!(
            refusal(CHAIN, Some("contacts")),
            "node 'judge' also reads camera/labels, which nothing would feed: replace a node before both"
        );
    }
}
