//! Pictures of graphs: of a dataflow file, or of a running graph with what was measured.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Context;
use serde::Serialize;

use super::super::promises::shown_counts;
use super::super::{Outcome, check_output, print_text, write_out};
use super::{Format, GraphArguments};
use blindgrasp_graph::client::activity::{Measured, MeasuredEdge, MeasuredNode, RUN, Window, measure};
use blindgrasp_graph::client::pick_graph;
use blindgrasp_graph::client::poller::Poller;
use blindgrasp_graph::client::words::{node_state_word, short_rate, short_time};
use blindgrasp_graph::control::NodeState;
use blindgrasp_graph::dataflow::{self, EdgeOptions, Graph, Machines, Override, Restart, RestartPolicy, Scope};
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

#[derive(Default, Serialize)]
struct PictureNode {
    id: String,
    /// As the dataflow file says; nothing of a running graph whose file has changed.
    #[serde(skip_serializing_if = "Option::is_none")]
    operator: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    machine: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    restart: Option<Restart>,
    #[serde(skip_serializing_if = "Option::is_none")]
    heartbeat_millis: Option<Option<u64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    running: Option<MeasuredNode>,
}

#[derive(Serialize)]
struct PictureEdge {
    from_node: String,
    from_port: String,
    to_node: String,
    /// `None` of `run`.
    to_port: Option<String>,
    type_name: Option<String>,
    policy: EdgePolicy,
    capacity: usize,
    deadline_millis: Option<f64>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    feedback: bool,
    /// From which machine to which other one it goes, if it does.
    #[serde(skip_serializing_if = "Option::is_none")]
    crossing: Option<[String; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    running: Option<MeasuredEdge>,
}

pub(super) fn draw_file(file: &Path, out: Option<&Path>, arguments: &GraphArguments) -> anyhow::Result<Outcome> {
    let scope = arguments.machine.as_deref().map_or(Scope::Everything, Scope::Machine);
    draw(out, arguments, &[file.to_owned()], || Ok(file_picture(&checked(file, &arguments.overrides, scope)?)))
}

pub(super) fn draw_running(name: &str, out: Option<&Path>, arguments: &GraphArguments) -> anyhow::Result<Outcome> {
    let interval = Duration::from_secs_f64(arguments.interval.unwrap_or(1.0));
    draw(out, arguments, &[], || running_picture(name, interval))
}

/// Draws a picture, once it is clear that the drawing can be written. It must not take the place of one of the `inputs`.
fn draw(
    out: Option<&Path>,
    arguments: &GraphArguments,
    inputs: &[PathBuf],
    picture: impl FnOnce() -> anyhow::Result<Picture>,
) -> anyhow::Result<Outcome> {
    let format = match (arguments.format, out) {
        (Some(format), _) => format,
        (None, Some(out)) if !arguments.json => format_of(out)?,
        (None, _) => Format::Mermaid,
    };
    if let Some(out) = out {
        check_output(out, inputs)?;
    }
    let picture = picture()?;
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

fn checked(file: &Path, overrides: &[Override], scope: Scope) -> anyhow::Result<Graph> {
    let file = dataflow::load(file)?;
    blindgrasp_cli::graph_file::checked(&file, overrides, scope)
}

fn file_picture(graph: &Graph) -> Picture {
    let nodes = graph.nodes.iter().map(|node| PictureNode {
        id: node.id.clone(),
        operator: Some(node.description.operator.clone()),
        machine: node.machine.clone(),
        restart: Some(node.restart),
        heartbeat_millis: Some(node.heartbeat_millis),
        running: None,
    });
    let mut edges = Vec::new();
    let inputs = graph.nodes.iter().flat_map(|node| &node.inputs);
    // In the same order.
    for (input, edge) in inputs.zip(graph.edges()) {
        let from = (edge.from_node, edge.from_port);
        let mut drawn = file_edge(from, (edge.to_node, Some(edge.to_port)), Some(edge.type_name), input.edge);
        drawn.feedback = input.feedback;
        drawn.crossing = graph.crossing(&edge).map(|(from, to)| [from.to_owned(), to.to_owned()]);
        edges.push(drawn);
    }
    // The launching command always reads these.
    for node in &graph.nodes {
        for output in node.outputs().iter().filter(|output| is_needed(&output.type_name)) {
            let (from, type_name) = ((node.id.as_str(), output.name.as_str()), Some(output.type_name.as_str()));
            edges.push(file_edge(from, (RUN, None), type_name, EdgeOptions::default()));
        }
    }
    Picture { graph: graph.name.clone(), machines: graph.machines.clone(), nodes: nodes.collect(), edges }
}

fn file_edge(
    from: (&str, &str),
    to: (&str, Option<&str>),
    type_name: Option<&str>,
    options: EdgeOptions,
) -> PictureEdge {
    PictureEdge {
        from_node: from.0.into(),
        from_port: from.1.into(),
        to_node: to.0.into(),
        to_port: to.1.map(String::from),
        type_name: type_name.map(String::from),
        policy: options.policy,
        capacity: options.capacity,
        deadline_millis: options.deadline_millis,
        feedback: false,
        crossing: None,
        running: None,
    }
}

fn running_picture(name: &str, interval: Duration) -> anyhow::Result<Picture> {
    let (mut poller, before) = Poller::connect(&pick_graph(Some(name))?)?;
    std::thread::sleep(interval);
    let now = poller.look()?;
    let window = Window { previous: &before, rates_since: Some(&before), counts_since: None };
    // Types and deadlines are not among what a graph says of itself. The file still knows, unless it has changed.
    let scope = now.status.link.as_ref().map_or(Scope::Everything, |link| Scope::Machine(&link.machine));
    let file = checked(&now.status.file, &[], scope).ok().map(|graph| file_picture(&graph));
    Ok(measured_picture(measure(&now, window), file))
}

fn measured_picture(measured: Measured, file: Option<Picture>) -> Picture {
    let (mut file_nodes, mut file_edges, machines) =
        file.map(|file| (file.nodes, file.edges, file.machines)).unwrap_or_default();
    let nodes = measured.nodes.into_iter().map(|node| {
        let known = file_nodes.iter().position(|known| known.id == node.node).map(|idx| file_nodes.swap_remove(idx));
        let known = known.unwrap_or_default();
        PictureNode { id: node.node.clone(), running: Some(node), ..known }
    });
    let nodes = nodes.collect();
    let mut edges = Vec::new();
    for edge in measured.edges {
        let (from_node, from_port) = edge.from.split_once('/').unwrap_or((&edge.from, ""));
        let (to_node, to_port) =
            edge.to.split_once('/').map_or((edge.to.as_str(), None), |(node, port)| (node, Some(port)));
        let known = file_edges.iter().position(|known| {
            (known.from_node.as_str(), known.from_port.as_str()) == (from_node, from_port)
                && (known.to_node.as_str(), known.to_port.as_deref()) == (to_node, to_port)
        });
        let mut drawn = match known {
            Some(idx) => file_edges.swap_remove(idx),
            None => file_edge((from_node, from_port), (to_node, to_port), None, EdgeOptions::default()),
        };
        (drawn.policy, drawn.capacity, drawn.running) = (edge.policy, edge.capacity, Some(edge));
        edges.push(drawn);
    }
    Picture { graph: measured.graph, machines, nodes, edges }
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
    let mut notes: Vec<String> = node.operator.iter().filter(|operator| **operator != node.id).cloned().collect();
    if let Some(restart) = node.restart.filter(|restart| *restart != Restart::default()) {
        notes.push(match restart.policy {
            RestartPolicy::Never => "restart: never".into(),
            policy => format!("restart: {policy}, {} in {} s", restart.limit, restart.within_millis as f64 / 1e3),
        });
    }
    if node.heartbeat_millis == Some(None) {
        notes.push("heartbeat: off".into());
    }
    let mut warnings = Vec::new();
    if let Some(running) = &node.running {
        let word = node_state_word(running.state).to_string();
        match running.state {
            NodeState::Failed | NodeState::Restarting => warnings.push(word),
            _ => notes.push(word),
        }
        if running.n_restarts > 0 {
            warnings.push(format!("restarts: {}", running.n_restarts));
        }
        if running.n_swaps > 0 {
            notes.push(format!("swaps: {}", running.n_swaps));
        }
        notes.extend(shown_counts(&running.counts));
    }
    DrawnNode {
        name: printable(&node.id),
        notes: harmless(notes),
        warnings: harmless(warnings),
        is_outside: false,
        group,
    }
}

fn harmless(lines: Vec<String>) -> Vec<String> {
    lines.iter().map(|line| printable(line)).collect()
}

fn drawn_edge(edge: &PictureEdge, from: usize, to: usize) -> DrawnEdge {
    let ports = match &edge.to_port {
        Some(to_port) if *to_port != edge.from_port => format!("{} → {to_port}", edge.from_port),
        _ => edge.from_port.clone(),
    };
    let mut notes = vec![ports];
    notes.extend(edge.type_name.iter().map(|name| name.strip_prefix("blindgrasp/").unwrap_or(name).to_string()));
    let usual = EdgeOptions::default();
    if (edge.policy, edge.capacity) != (usual.policy, usual.capacity) {
        notes.push(format!("{} {}", edge.policy, edge.capacity));
    }
    notes.extend(edge.deadline_millis.map(|millis| format!("within {millis} ms")));
    let mut warnings = Vec::new();
    if let Some(running) = &edge.running {
        let age = running.age_nanos.map_or(String::new(), |age| format!(", {} old", short_time(age.p50)));
        notes.push(format!("{}/s{age}", short_rate(running.rate_hz)));
        // What gives way on a `latest` edge is meant to.
        let (dropped, is_loss) = (running.dropped, edge.policy == EdgePolicy::Lossless);
        if dropped > 0 {
            let word = if is_loss { "lost" } else { "gave way" };
            if is_loss { &mut warnings } else { &mut notes }.push(format!("{dropped} {word}"));
        }
        let seen = [(running.missing, "missing"), (running.late, "late")];
        warnings.extend(seen.iter().filter(|(count, _)| *count > 0).map(|(count, word)| format!("{count} {word}")));
    }
    let is_dashed = edge.policy == EdgePolicy::Latest;
    let carrier = edge.crossing.is_some().then(|| "Zenoh".to_owned());
    DrawnEdge {
        from,
        to,
        notes: harmless(notes),
        warnings: harmless(warnings),
        is_dashed,
        is_feedback: edge.feedback,
        carrier,
    }
}
