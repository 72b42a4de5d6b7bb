//! Pictures of the graph of a dataflow file.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::Context;
use serde::Serialize;

use super::super::{Outcome, check_output, print_text, write_out};
use super::{Format, GraphArguments};
use blindgrasp_graph::client::activity::RUN;
use blindgrasp_graph::dataflow::{self, EdgeOptions, Graph, Machines, Restart, RestartPolicy, Scope};
use blindgrasp_graph::log::printable;
use blindgrasp_graph::plan::is_needed;
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_pictures::{DrawnEdge, DrawnGraph, DrawnGroup, DrawnNode, graph_dot, graph_mermaid};

/// The graph that is drawn; `run` stands for the launching command.
#[derive(Serialize)]
struct Picture {
    graph: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    machines: Option<Machines>,
    nodes: Vec<PictureNode>,
    edges: Vec<PictureEdge>,
}

#[derive(Serialize)]
struct PictureNode {
    id: String,
    operator: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    machine: Option<String>,
    restart: Restart,
    heartbeat_millis: Option<u64>,
}

#[derive(Serialize)]
struct PictureEdge {
    from_node: String,
    from_port: String,
    to_node: String,
    /// `None` of `run`.
    to_port: Option<String>,
    type_name: String,
    policy: EdgePolicy,
    capacity: usize,
    deadline_millis: Option<f64>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    feedback: bool,
    /// From which machine to which other one it goes, if it does.
    #[serde(skip_serializing_if = "Option::is_none")]
    crossing: Option<[String; 2]>,
}

/// Draws the graph of a file, once it is clear that the drawing can be written.
pub(super) fn draw_file(file: &Path, out: Option<&Path>, arguments: &GraphArguments) -> anyhow::Result<Outcome> {
    let format = match (arguments.format, out) {
        (Some(format), _) => format,
        (None, Some(out)) if !arguments.json => format_of(out)?,
        (None, _) => Format::Mermaid,
    };
    if let Some(out) = out {
        check_output(out, &[file.to_owned()])?;
    }
    let scope = arguments.machine.as_deref().map_or(Scope::Everything, Scope::Machine);
    let graph = blindgrasp_cli::graph_file::checked(&dataflow::load(file)?, &arguments.overrides, scope)?;
    let picture = file_picture(&graph);
    let text = match format {
        _ if arguments.json => serde_json::to_string_pretty(&picture)?,
        Format::Mermaid => graph_mermaid(&drawn(&picture)),
        Format::Dot => graph_dot(&drawn(&picture)),
        Format::Svg => svg(&graph_dot(&drawn(&picture)))?,
    };
    match out {
        Some(out) => write_out(out, &format!("{}\n", text.trim_end()))?,
        None => print_text(text.trim_end())?,
    }
    Ok(Outcome::Done)
}

fn format_of(out: &Path) -> anyhow::Result<Format> {
    match out.extension().and_then(|extension| extension.to_str()) {
        Some("svg") => Ok(Format::Svg),
        Some("mmd" | "mermaid") => Ok(Format::Mermaid),
        Some("dot" | "gv") => Ok(Format::Dot),
        _ => anyhow::bail!(
            "{}: the name does not say the format; expected one that ends in .svg, .mmd or .dot, or give --format",
            out.display()
        ),
    }
}

/// The picture that Graphviz makes of its text.
fn svg(dot: &str) -> anyhow::Result<String> {
    let mut graphviz = Command::new("dot")
        .arg("-Tsvg")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .context("cannot start 'dot', which draws .svg: install Graphviz, or write .mmd or .dot")?;
    if let Some(mut stdin) = graphviz.stdin.take() {
        stdin.write_all(dot.as_bytes()).context("'dot' does not read the graph")?;
    }
    let drawn = graphviz.wait_with_output().context("'dot' cannot be waited for")?;
    if !drawn.status.success() {
        anyhow::bail!("'dot' failed to draw the graph ({}); its message is above", drawn.status);
    }
    String::from_utf8(drawn.stdout).context("'dot' wrote something that is not text")
}

fn file_picture(graph: &Graph) -> Picture {
    let nodes = graph.nodes.iter().map(|node| PictureNode {
        id: node.id.clone(),
        operator: node.description.operator.clone(),
        machine: node.machine.clone(),
        restart: node.restart,
        heartbeat_millis: node.heartbeat_millis,
    });
    let mut edges = Vec::new();
    let inputs = graph.nodes.iter().flat_map(|node| &node.inputs);
    // In the same order.
    for (input, edge) in inputs.zip(graph.edges()) {
        let from = (edge.from_node, edge.from_port);
        let mut drawn = file_edge(from, (edge.to_node, Some(edge.to_port)), edge.type_name, input.edge);
        drawn.feedback = input.feedback;
        drawn.crossing = graph.crossing(&edge).map(|(from, to)| [from.to_owned(), to.to_owned()]);
        edges.push(drawn);
    }
    // The launching command always reads these.
    for node in &graph.nodes {
        for output in node.outputs().iter().filter(|output| is_needed(&output.type_name)) {
            let from = (node.id.as_str(), output.name.as_str());
            edges.push(file_edge(from, (RUN, None), &output.type_name, EdgeOptions::default()));
        }
    }
    Picture { graph: graph.name.clone(), machines: graph.machines.clone(), nodes: nodes.collect(), edges }
}

fn file_edge(from: (&str, &str), to: (&str, Option<&str>), type_name: &str, options: EdgeOptions) -> PictureEdge {
    PictureEdge {
        from_node: from.0.into(),
        from_port: from.1.into(),
        to_node: to.0.into(),
        to_port: to.1.map(String::from),
        type_name: type_name.into(),
        policy: options.policy,
        capacity: options.capacity,
        deadline_millis: options.deadline_millis,
        feedback: false,
        crossing: None,
    }
}

fn drawn(picture: &Picture) -> DrawnGraph {
    let machines = picture.machines.as_ref().map(|machines| machines.machines.as_slice()).unwrap_or_default();
    let group_of = |id: &str| {
        let machine = picture.nodes.iter().find(|node| node.id == id)?.machine.as_deref()?;
        machines.iter().position(|known| known.name == machine)
    };
    let mut nodes: Vec<DrawnNode> = picture.nodes.iter().map(|node| drawn_node(node, group_of(&node.id))).collect();
    // Each machine has a launching command of its own.
    let readers: BTreeSet<Option<usize>> =
        picture.edges.iter().filter(|edge| is_read_by_run(edge)).map(|edge| group_of(&edge.from_node)).collect();
    nodes.extend(readers.iter().map(|&group| DrawnNode {
        name: RUN.into(),
        is_outside: true,
        group,
        ..DrawnNode::default()
    }));
    let idx_of = |id: &str| picture.nodes.iter().position(|node| node.id == id);
    let edges = picture.edges.iter().filter_map(|edge| {
        let to = if is_read_by_run(edge) {
            picture.nodes.len() + readers.iter().position(|group| *group == group_of(&edge.from_node))?
        } else {
            idx_of(&edge.to_node)?
        };
        Some(drawn_edge(edge, idx_of(&edge.from_node)?, to))
    });
    let groups = machines.iter().map(|machine| {
        let note = match machine.listen.as_slice() {
            [] => String::new(),
            listen => printable(&format!("listens at {}", listen.join(", "))),
        };
        DrawnGroup { name: printable(&machine.name), note }
    });
    DrawnGraph { title: printable(&picture.graph), edges: edges.collect(), nodes, groups: groups.collect() }
}

fn is_read_by_run(edge: &PictureEdge) -> bool {
    edge.to_port.is_none()
}

fn drawn_node(node: &PictureNode, group: Option<usize>) -> DrawnNode {
    let mut notes = Vec::new();
    if node.operator != node.id {
        notes.push(node.operator.clone());
    }
    let restart = node.restart;
    if restart != Restart::default() {
        notes.push(match restart.policy {
            RestartPolicy::Never => "restart: never".into(),
            policy => format!("restart: {policy}, {} in {} s", restart.limit, restart.within_millis as f64 / 1e3),
        });
    }
    if node.heartbeat_millis.is_none() {
        notes.push("heartbeat: off".into());
    }
    DrawnNode { name: printable(&node.id), notes: harmless(notes), group, ..DrawnNode::default() }
}

fn harmless(lines: Vec<String>) -> Vec<String> {
    lines.iter().map(|line| printable(line)).collect()
}

fn drawn_edge(edge: &PictureEdge, from: usize, to: usize) -> DrawnEdge {
    let ports = match &edge.to_port {
        Some(to_port) if *to_port != edge.from_port => format!("{} → {to_port}", edge.from_port),
        _ => edge.from_port.clone(),
    };
    let type_name = edge.type_name.strip_prefix("blindgrasp/").unwrap_or(&edge.type_name);
    let mut notes = vec![ports, type_name.to_owned()];
    let usual = EdgeOptions::default();
    if (edge.policy, edge.capacity) != (usual.policy, usual.capacity) {
        notes.push(format!("{} {}", edge.policy, edge.capacity));
    }
    notes.extend(edge.deadline_millis.map(|millis| format!("within {millis} ms")));
    let is_dashed = edge.policy == EdgePolicy::Latest;
    let carrier = edge.crossing.is_some().then(|| "Zenoh".to_owned());
    DrawnEdge { from, to, notes: harmless(notes), is_dashed, is_feedback: edge.feedback, carrier }
}
