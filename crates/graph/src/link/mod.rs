//! One machine's part of a graph, and the configuration of the link that joins it to the others. Beside it, the way to programs
//! that are no part of the graph.

pub mod config;
pub mod network;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde_json::json;
use sha2::{Digest, Sha256};

use self::config::{Channel, Endpoints, LinkConfig, key_files};
use crate::dataflow::ProcessOptions;
use crate::dataflow::pins::Pins;
use crate::dataflow::{
    DEFAULT_HEARTBEAT_MILLIS, EdgeOptions, Graph, Input, LINK, LocalView, Machine, Machines, Node, Program, Restart,
    RestartPolicy,
};
use blindgrasp_messages::{LiftDecision, Prediction, Recorded};
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::wiring::{EdgePolicy, Sandbox};

/// Where a part of a graph runs. It adds to the dataflow file or replaces a part of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Placement {
    pub machine: String,
    /// The name that tells this graph from others with the same file, one for each robot.
    pub namespace: Option<String>,
    /// A number for this run; no other run has it.
    pub run: u64,
    /// Endpoints to listen at, in place of those in the file if there are any.
    pub listen: Vec<String>,
    /// Endpoints to connect to, in place of those in the file if there are any.
    pub connect: Vec<String>,
    /// The folder of the keys, in place of that in the file.
    pub keys: Option<PathBuf>,
}

/// Why a machine's part of a graph cannot be made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LocalError {
    #[error("the file names no machines, so --machine has no meaning; leave it out")]
    NoMachines,
    #[error("there is no machine '{machine}'; the file's machines: {}", known.join(", "))]
    Unknown { machine: String, known: Vec<String> },
    #[error(
        "machine '{machine}' does not listen and has no machine to connect to; give another machine a 'listen' in the file, \
         or use --connect ENDPOINT"
    )]
    NoEndpoint { machine: String },
}

/// The nodes of a graph that run on a machine, and the node of the link to the other machines with the program
/// `link_program`.
///
/// # Errors
/// The file does not name the machine, or the machine has no endpoint.
pub fn local_graph(graph: &Graph, placement: &Placement, link_program: &Program) -> Result<Graph, LocalError> {
    let machines = graph.machines.as_ref().ok_or(LocalError::NoMachines)?;
    let this = machines.machines.iter().find(|machine| machine.name == placement.machine).ok_or_else(|| {
        let known = machines.machines.iter().map(|machine| machine.name.clone()).collect();
        LocalError::Unknown { machine: placement.machine.clone(), known }
    })?;
    let mut nodes: Vec<Node> = graph.nodes.iter().filter(|node| is_on(node, &this.name)).cloned().collect();
    let elsewhere = graph.nodes.iter().filter(|node| !is_on(node, &this.name));
    let elsewhere = elsewhere.filter_map(|node| Some((node.id.clone(), node.machine.clone()?))).collect();
    let mut view = LocalView { machine: this.name.clone(), imports: Vec::new(), elsewhere };
    if machines.machines.len() > 1 {
        let config = link_config(graph, machines, this, placement)?;
        view.imports = config
            .imports
            .iter()
            .map(|channel| {
                let node = channel.port.split('/').next().unwrap_or_default();
                (channel.port.clone(), depends_on_source(graph, node, |machine| machine != Some(&this.name)))
            })
            .collect();
        nodes.push(link_node(&config, &this.name, link_program));
    }
    Ok(Graph { nodes, local: Some(view), ..graph.clone() })
}

fn is_on(node: &Node, machine: &str) -> bool {
    node.machine.as_deref() == Some(machine)
}

fn link_config(
    graph: &Graph,
    machines: &Machines,
    this: &Machine,
    placement: &Placement,
) -> Result<LinkConfig, LocalError> {
    let channels = channels(graph);
    let others = machines.machines.iter().filter(|machine| machine.name != this.name);
    let folder = placement.keys.as_ref().or(machines.link.keys.as_ref());
    Ok(LinkConfig {
        graph: graph.name.clone(),
        namespace: placement.namespace.clone(),
        machine: this.name.clone(),
        run: placement.run,
        fingerprint: fingerprint(graph),
        peers: others.map(|machine| machine.name.clone()).collect(),
        exports: channels.iter().filter(|channel| channel.from == this.name).cloned().collect(),
        imports: channels.iter().filter(|channel| channel.to == this.name).cloned().collect(),
        endpoints: endpoints(machines, this, placement)?,
        keys: folder.map(|folder| key_files(folder, &this.name)),
        insecure: machines.link.insecure,
        deadline_millis: machines.link.deadline_millis,
        buffer: machines.link.buffer,
    })
}

/// The channels of a graph: one for each output port and each other machine that reads it, in the order of the nodes.
pub fn channels(graph: &Graph) -> Vec<Channel> {
    let mut channels: BTreeMap<(usize, String, String), Channel> = BTreeMap::new();
    for reader in &graph.nodes {
        for input in &reader.inputs {
            let Some((idx, writer)) = graph.nodes.iter().enumerate().find(|(_, node)| node.id == input.from_node)
            else {
                continue;
            };
            let (Some(from), Some(to)) = (&writer.machine, &reader.machine) else {
                continue;
            };
            if from == to {
                continue;
            }
            let port = format!("{}/{}", input.from_node, input.from_port);
            let is_urgent = [Prediction::TYPE_NAME, LiftDecision::TYPE_NAME].contains(&input.type_name.as_str());
            let channel = channels.entry((idx, port.clone(), to.clone())).or_insert_with(|| Channel {
                port,
                type_name: input.type_name.clone(),
                from: from.clone(),
                to: to.clone(),
                policy: EdgePolicy::Latest,
                capacity: 1,
                is_from_source: depends_on_source(graph, &input.from_node, |machine| machine == Some(from)),
                is_to_source: depends_on_source(graph, &input.from_node, |machine| machine == Some(to)),
                is_urgent,
            });
            if input.edge.policy == EdgePolicy::Lossless {
                channel.policy = EdgePolicy::Lossless;
            }
            channel.capacity = channel.capacity.max(input.edge.capacity);
        }
    }
    channels.into_values().collect()
}

/// The endpoints of a machine. Of two machines that both listen, the one that is later in the file connects.
fn endpoints(machines: &Machines, this: &Machine, placement: &Placement) -> Result<Endpoints, LocalError> {
    let given = |given: &[String], of_file: Vec<String>| if given.is_empty() { of_file } else { given.to_vec() };
    if !machines.link.router.is_empty() {
        let router = given(&placement.connect, machines.link.router.clone());
        return Ok(Endpoints { listen: placement.listen.clone(), connect: Vec::new(), router });
    }
    let listen = given(&placement.listen, this.listen.clone());
    let others = machines.machines.iter();
    let to_connect = if this.listen.is_empty() && placement.listen.is_empty() {
        others.filter(|machine| machine.name != this.name).collect::<Vec<_>>()
    } else {
        others.take_while(|machine| machine.name != this.name).collect()
    };
    let connect =
        given(&placement.connect, to_connect.into_iter().flat_map(|machine| machine.listen.iter().cloned()).collect());
    if listen.is_empty() && connect.is_empty() {
        return Err(LocalError::NoEndpoint { machine: this.name.clone() });
    }
    Ok(Endpoints { listen, connect, router: Vec::new() })
}

/// A hash of the parts of the graph that must be the same on all machines: the nodes, their machines and their inputs.
/// Programs and parameters may differ, because they can be swapped and set while the graph runs.
fn fingerprint(graph: &Graph) -> u64 {
    // Types are not part of it: a machine may not know the types of a node on another machine. Links compare them.
    let input = |input: &Input| json!([input.port, input.from_node, input.from_port, input.edge.policy.to_string()]);
    let node = |node: &Node| json!([node.id, node.machine, node.inputs.iter().map(input).collect::<Vec<_>>()]);
    let all = json!([graph.name, graph.nodes.iter().map(node).collect::<Vec<_>>()]).to_string();
    let hash = Sha256::digest(all.as_bytes());
    hash.iter().take(8).fold(0, |number, byte| number << 8 | u64::from(*byte))
}

/// Whether a node is a source on such a machine, or depends on one.
fn depends_on_source(graph: &Graph, node: &str, is_such: impl Fn(Option<&String>) -> bool) -> bool {
    let mut seen = BTreeSet::new();
    let mut open = vec![node];
    while let Some(id) = open.pop() {
        if !seen.insert(id) {
            continue;
        }
        let Some(node) = graph.node(id) else {
            continue;
        };
        if node.is_source() && is_such(node.machine.as_ref()) {
            return true;
        }
        open.extend(node.inputs.iter().map(|input| input.from_node.as_str()));
    }
    false
}

fn link_node(config: &LinkConfig, machine: &str, program: &Program) -> Node {
    let port = |name: String, channel: &Channel| PortDescription {
        name,
        type_name: channel.type_name.clone(),
        optional: false,
        feedback: false,
        partner: false,
        summary: format!("from {} to {}", channel.from, channel.to),
    };
    let mut description = OperatorDescription::new("link", "Carries the edges that go to another machine");
    description.inputs = config.exports.iter().map(|channel| port(channel.input_port(), channel)).collect();
    description.outputs = config.imports.iter().map(|channel| port(channel.port.clone(), channel)).collect();
    let inputs = config.exports.iter().filter_map(|channel| {
        let (node, name) = channel.port.split_once('/')?;
        Some(Input {
            port: channel.input_port(),
            from_node: node.into(),
            from_port: name.into(),
            type_name: channel.type_name.clone(),
            edge: EdgeOptions { policy: channel.policy, capacity: channel.capacity, ..EdgeOptions::default() },
            feedback: false,
            partner: false,
        })
    });
    let params = match serde_json::to_value(config) {
        Ok(serde_json::Value::Object(params)) => params,
        _ => serde_json::Map::new(),
    };
    Node {
        id: LINK.into(),
        program: program.path.clone(),
        args: program.args.clone(),
        inputs: inputs.collect(),
        description,
        params,
        // A link that ends is always restarted. Meanwhile the arbiter holds, and samples are kept.
        restart: Restart { policy: RestartPolicy::Always, limit: 60, ..Restart::default() },
        heartbeat_millis: Some(DEFAULT_HEARTBEAT_MILLIS),
        // It opens sockets, and reads its keys again when they change.
        sandbox: Sandbox::Off,
        memory_max_mib: None,
        process: ProcessOptions::default(),
        sha256: Pins::default(),
        machine: Some(machine.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataflow::LinkSettings;
    use blindgrasp_messages::{ContactSet, GraspFeature, TactileFrame};

    fn link_program() -> Program {
        PathBuf::from("blindgrasp").into()
    }

    fn node(id: &str, machine: &str, input: Option<(&str, &str, &str)>, output: (&str, &str)) -> Node {
        let mut description = OperatorDescription::new(id, "").output(output.0, output.1, "");
        let mut inputs = Vec::new();
        if let Some((from, port, type_name)) = input {
            description = description.input(port, type_name, "");
            inputs.push(Input {
                port: port.into(),
                from_node: from.into(),
                from_port: port.into(),
                type_name: type_name.into(),
                edge: EdgeOptions::default(),
                feedback: false,
                partner: false,
            });
        }
        Node {
            id: id.into(),
            program: PathBuf::from(id),
            args: Vec::new(),
            description,
            inputs,
            params: serde_json::Map::new(),
            restart: Restart::default(),
            heartbeat_millis: None,
            sandbox: Sandbox::Off,
            memory_max_mib: None,
            process: ProcessOptions::default(),
            sha256: Pins::default(),
            machine: Some(machine.into()),
        }
    }

    fn split() -> Graph {
        let (tactile, contacts) = (TactileFrame::TYPE_NAME, ContactSet::TYPE_NAME);
        let (feature, prediction) = (GraspFeature::TYPE_NAME, Prediction::TYPE_NAME);
        let machine = |name: &str, listen: &[&str]| Machine {
            name: name.into(),
            listen: listen.iter().map(|endpoint| endpoint.to_string()).collect(),
        };
        Graph {
            name: "gate".into(),
            file: "/gate.yaml".into(),
            nodes: vec![
                node("source", "robot", None, ("tactile", tactile)),
                node("contacts", "robot", Some(("source", "tactile", tactile)), ("contacts", contacts)),
                node("histogram", "brain", Some(("contacts", "contacts", contacts)), ("histogram", feature)),
                node("classifier", "brain", Some(("histogram", "histogram", feature)), ("prediction", prediction)),
                node("arbiter", "robot", Some(("classifier", "prediction", prediction)), ("decision", "d")),
            ],
            machines: Some(Machines {
                machines: vec![machine("robot", &[]), machine("brain", &["tcp/127.0.0.1:7447"])],
                link: LinkSettings::default(),
            }),
            local: None,
            host: None,
        }
    }

    fn placement(machine: &str) -> Placement {
        Placement { machine: machine.into(), ..Placement::default() }
    }

    fn config(graph: &Graph) -> LinkConfig {
        let link = graph.node(LINK).expect("a link");
        serde_json::from_value(link.params.clone().into()).expect("its configuration")
    }

    #[test]
    fn each_machine_gets_its_nodes_and_a_link_with_the_channels() {
        let graph = split();
        let robot = local_graph(&graph, &placement("robot"), &link_program()).expect("robot's part");
        let ids: Vec<_> = robot.nodes.iter().map(|node| node.id.as_str()).collect();
        assert_eq!(ids, ["source", "contacts", "arbiter", LINK]);
        let link = robot.node(LINK).expect("a link");
        assert!(link.is_link());
        assert_eq!(link.inputs[0].port, "brain/contacts/contacts");
        let ports: Vec<_> = link.output_ports().map(|(port, _)| port).collect();
        assert_eq!(ports, [("classifier".to_owned(), "prediction".to_owned())]);
        // The predictions depend on robot's own source: robot's part ends when this source ends.
        let view = robot.local.expect("a view");
        assert_eq!(view.imports, [("classifier/prediction".to_owned(), false)]);
        assert_eq!(view.elsewhere["histogram"], "brain");

        let brain = local_graph(&graph, &placement("brain"), &link_program()).expect("brain's part");
        assert_eq!(brain.local.clone().expect("a view").imports, [("contacts/contacts".to_owned(), true)]);
        let (robot, brain) = (config(&split_part(&graph, "robot")), config(&brain));
        assert_eq!(robot.exports, brain.imports);
        assert_eq!(robot.imports, brain.exports);
        assert_eq!(robot.fingerprint, brain.fingerprint);
        assert_eq!((robot.endpoints.connect, robot.endpoints.listen), (brain.endpoints.listen.clone(), Vec::new()));
        assert_eq!((robot.peers, brain.peers.as_slice()), (vec!["brain".to_owned()], ["robot".to_owned()].as_slice()));
        assert!(brain.imports[0].policy == EdgePolicy::Lossless && !brain.imports[0].is_urgent);
        assert!(brain.exports[0].is_urgent);
    }

    fn split_part(graph: &Graph, machine: &str) -> Graph {
        local_graph(graph, &placement(machine), &link_program()).expect("a part")
    }

    #[test]
    fn another_place_of_a_node_is_another_graph_but_other_params_are_not() {
        let graph = split();
        let fingerprint = |graph: &Graph| config(&split_part(graph, "robot")).fingerprint;
        let mut moved = graph.clone();
        moved.nodes[3].machine = Some("robot".into());
        assert_ne!(fingerprint(&graph), fingerprint(&moved));
        let mut set = graph.clone();
        set.nodes[3].params.insert("model".into(), "other.json".into());
        set.nodes[3].program = "other".into();
        assert_eq!(fingerprint(&graph), fingerprint(&set));
    }

    #[test]
    fn an_unknown_machine_and_one_without_endpoints_are_refused() {
        let mut graph = split();
        let part = |graph: &Graph, machine: &str| local_graph(graph, &placement(machine), &link_program());
        assert!(matches!(part(&graph, "brian"), Err(LocalError::Unknown { known, .. }) if known == ["robot", "brain"]));
        if let Some(machines) = &mut graph.machines {
            machines.machines[1].listen.clear();
        }
        assert!(matches!(part(&graph, "robot"), Err(LocalError::NoEndpoint { .. })));
        graph.machines = None;
        assert_eq!(part(&graph, "robot"), Err(LocalError::NoMachines));
    }
}
