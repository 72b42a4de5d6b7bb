//! `blindgrasp run --check`

use std::path::Path;

use serde_json::json;

use super::text_table::TextTable;
use super::{Outcome, print_line, print_text};
use blindgrasp_cli::graph_file::{OnMisfit, able_to_begin};
use blindgrasp_graph::dataflow::{
    self, DataflowError, Edge, Graph, Input, Machines, Node, Override, Restart, RestartPolicy, Scope,
};
use blindgrasp_operator::text::counted;

/// Prints the graph with every value filled in, or its mistakes. With --json: {"graph": …}, with "crossing" edges where
/// the file names machines, or {"errors": […]}.
pub(super) fn run(
    file: &Path,
    overrides: &[Override],
    scope: Scope<'_>,
    on_misfit: OnMisfit,
    is_json: bool,
) -> anyhow::Result<Outcome> {
    let file = dataflow::load(file).map_err(anyhow::Error::from);
    let checked = file.and_then(|file| able_to_begin(&file, overrides, scope, on_misfit));
    match &checked {
        Ok(graph) if is_json => print_text(&serde_json::to_string_pretty(&as_json(graph))?)?,
        Ok(graph) => print_graph(graph)?,
        Err(error) => {
            // The mistakes go to stderr as well.
            if is_json && let Some(error) = error.downcast_ref::<DataflowError>() {
                print_text(&serde_json::to_string_pretty(&errors(error))?)?;
            }
        }
    }
    checked?;
    Ok(Outcome::Done)
}

fn as_json(graph: &Graph) -> serde_json::Value {
    let mut checked = json!({ "graph": graph });
    if graph.machines.is_some() {
        let crossing = graph.edges().filter_map(|edge| {
            let (from_machine, to_machine) = graph.crossing(&edge)?;
            let Edge { from_node, from_port, to_node, to_port, type_name } = edge;
            Some(json!({
                "from": format!("{from_node}/{from_port}"),
                "to": format!("{to_node}/{to_port}"),
                "from_machine": from_machine,
                "to_machine": to_machine,
                "type_name": type_name,
            }))
        });
        checked["crossing"] = crossing.collect();
    }
    checked
}

fn errors(error: &DataflowError) -> serde_json::Value {
    let errors = error.diagnostics.iter().map(|diagnostic| {
        json!({
            "line": diagnostic.at.map(|at| at.line),
            "column": diagnostic.at.map(|at| at.column),
            "set": diagnostic.setting.as_ref().map(ToString::to_string),
            "message": diagnostic.message,
            "help": diagnostic.help,
        })
    });
    json!({ "errors": errors.collect::<Vec<_>>() })
}

fn print_graph(graph: &Graph) -> std::io::Result<()> {
    let machines = graph.machines.as_ref();
    let on_machines = machines.map_or(String::new(), |machines| {
        let n_crossing = graph.edges().filter(|edge| graph.crossing(edge).is_some()).count();
        format!(", {}, {} between them", counted(machines.machines.len(), "machine"), counted(n_crossing, "edge"))
    });
    let (nodes, edges) = (counted(graph.nodes.len(), "node"), counted(graph.edges().count(), "edge"));
    print_text(&format!("graph '{}': {nodes}, {edges}{on_machines}\n", graph.name))?;
    if let Some(machines) = machines {
        print_machines(machines)?;
    }
    // Without machines there is no column for them.
    let with_machine = |mut row: Vec<String>, place: usize, machine: String| {
        if machines.is_some() {
            row.insert(place, machine);
        }
        row
    };
    let nodes = graph.nodes.iter().map(|node| {
        let heartbeat = node.heartbeat_millis.map_or("off".into(), |millis| format!("{millis} ms"));
        let row = vec![node.id.clone(), restart(&node.restart), heartbeat, command(node)];
        with_machine(row, 1, node.machine.clone().unwrap_or_default())
    });
    let titles = ["node", "restart", "heartbeat", "program"].map(String::from).to_vec();
    print_table(with_machine(titles, 1, "machine".into()), nodes)?;
    let inputs = graph.nodes.iter().flat_map(|node| node.inputs.iter().map(move |input| (node, input)));
    let edges = inputs.zip(graph.edges()).map(|((node, input), drawn)| {
        let crossing = graph.crossing(&drawn).map_or("-".into(), |(from, to)| format!("{from} → {to}"));
        with_machine(edge(node, input), 1, crossing)
    });
    let edges: Vec<_> = edges.collect();
    if !edges.is_empty() {
        print_line("")?;
        let titles = ["edge", "type", "policy", "capacity", "deadline"].map(String::from).to_vec();
        print_table(with_machine(titles, 1, "over Zenoh".into()), edges)?;
    }
    Ok(())
}

fn print_machines(machines: &Machines) -> std::io::Result<()> {
    let rows = machines.machines.iter().map(|machine| {
        let listen = if machine.listen.is_empty() { "-".into() } else { machine.listen.join(", ") };
        vec![machine.name.clone(), listen]
    });
    print_table(["machine", "listens at"].map(String::from).to_vec(), rows)?;
    let link = &machines.link;
    let mut said =
        vec![format!("cut off after {} ms", link.deadline_millis), format!("buffer {} samples", link.buffer)];
    if !link.router.is_empty() {
        said.push(format!("router {}", link.router.join(", ")));
    }
    if let Some(keys) = &link.keys {
        said.push(format!("keys in {}", keys.display()));
    }
    if link.insecure {
        said.push("INSECURE: no TLS needed beyond this computer".into());
    }
    print_text(&format!("link: {}\n", said.join(", ")))
}

fn restart(restart: &Restart) -> String {
    let Restart { policy, limit, within_millis, backoff_millis } = restart;
    match policy {
        RestartPolicy::Never => policy.to_string(),
        _ => format!("{policy}, {limit} in {} s, backoff {backoff_millis} ms", *within_millis as f64 / 1000.0),
    }
}

/// The program with its arguments, in quotes where they would otherwise run together.
fn command(node: &Node) -> String {
    let mut command = node.program.display().to_string();
    for arg in &node.args {
        let is_clear = !arg.is_empty() && !arg.contains(|char: char| char.is_whitespace() || char.is_control());
        command += &if is_clear { format!(" {arg}") } else { format!(" {arg:?}") };
    }
    command
}

fn edge(node: &Node, input: &Input) -> Vec<String> {
    vec![
        format!("{}/{} → {}/{}", input.from_node, input.from_port, node.id, input.port),
        input.type_name.clone(),
        if input.feedback { format!("{}, feedback", input.edge.policy) } else { input.edge.policy.to_string() },
        input.edge.capacity.to_string(),
        input.edge.deadline_millis.map_or("none".into(), |millis| format!("{millis} ms")),
    ]
}

fn print_table(titles: Vec<String>, rows: impl IntoIterator<Item = Vec<String>>) -> std::io::Result<()> {
    let mut table = TextTable::of_texts(titles);
    rows.into_iter().for_each(|row| table.row(row));
    table.lines().iter().try_for_each(|line| print_line(line))
}
