//! `blindgrasp ps`

use std::time::Duration;

use clap::Args;
use serde::Serialize;

use super::top::screen::short_time;
use super::{Outcome, print_line};
use crate::dataflow::EdgePolicy;
use crate::diagnostics::print_diagnostic;
use crate::runtime::client::{pick_graph, running_graphs, status};
use crate::runtime::control::{EdgeStatus, GraphState, GraphStatus, NodeState, NodeStatus};
use crate::runtime::log::printable;
use crate::runtime::usage::{ProcessUsage, usage};

/// Show this user's running graphs: their operators, and what went over their edges.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp ps grasp_gate\n\n\
                        Exit code 1 if the graph that is named does not run or does not answer.")]
pub(super) struct Arguments {
    /// Only this graph.
    graph: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Listing {
    graphs: Vec<RunningGraph>,
    not_answering: Vec<Silent>,
}

#[derive(Serialize)]
struct RunningGraph {
    #[serde(flatten)]
    status: GraphStatus,
    /// What the active processes have used, by node; nothing for a node without one.
    usage: std::collections::BTreeMap<String, ProcessUsage>,
}

/// A graph that holds its name and does not answer.
#[derive(Serialize)]
struct Silent {
    graph: String,
    message: String,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let listing = match &arguments.graph {
        Some(graph) => {
            let status = status(&pick_graph(Some(graph))?)?;
            Listing { graphs: vec![with_usage(status)], not_answering: Vec::new() }
        }
        None => listing()?,
    };
    if arguments.json {
        print_line(&serde_json::to_string(&listing)?)?;
        return Ok(Outcome::Done);
    }
    if listing.graphs.is_empty() && listing.not_answering.is_empty() {
        print_diagnostic("no graph is running");
    }
    for (graph_idx, graph) in listing.graphs.iter().enumerate() {
        if graph_idx > 0 {
            print_line("")?;
        }
        formatted(graph).iter().try_for_each(|line| print_line(line))?;
    }
    for silent in &listing.not_answering {
        print_diagnostic(&silent.message);
    }
    Ok(Outcome::Done)
}

fn listing() -> anyhow::Result<Listing> {
    let mut listing = Listing { graphs: Vec::new(), not_answering: Vec::new() };
    for graph in running_graphs()? {
        match status(&graph) {
            Ok(status) => listing.graphs.push(with_usage(status)),
            Err(error) => {
                listing.not_answering.push(Silent { graph, message: format!("{:#}", anyhow::anyhow!(error)) })
            }
        }
    }
    Ok(listing)
}

fn with_usage(status: GraphStatus) -> RunningGraph {
    let usage = status.nodes.iter().filter_map(|node| Some((node.node.clone(), usage(node.pid?)?))).collect();
    RunningGraph { status, usage }
}

fn formatted(graph: &RunningGraph) -> Vec<String> {
    let RunningGraph { status, usage } = graph;
    // Whole seconds: more of them nobody reads.
    let uptime = humantime::format_duration(Duration::from_secs(status.uptime_secs.max(0.0) as u64));
    let mut lines = vec![format!(
        "graph '{}'  {}, up {uptime}, pid {}, {}",
        status.graph,
        state_word(status.state),
        status.pid,
        status.file.display()
    )];
    lines.extend(warnings(status).into_iter().map(|warning| format!("  {}", printable(&warning))));

    let mut rows = vec![["node", "state", "pid", "restarts", "swaps", "heartbeat", "cpu", "memory"].map(String::from)];
    for node in &status.nodes {
        let used = usage.get(&node.node);
        rows.push([
            node.node.clone(),
            node_state_word(node.state).into(),
            pids(node),
            node.n_restarts.to_string(),
            node.n_swaps.to_string(),
            node.heartbeat_age_millis.map_or("-".into(), |millis| format!("{millis} ms ago")),
            used.map_or("-".into(), |used| format!("{:.1} s", used.cpu_secs)),
            used.map_or("-".into(), |used| format!("{:.1} MiB", used.resident_bytes as f64 / f64::from(1 << 20))),
        ]);
    }
    lines.extend(table(&rows, 2));

    let columns = [
        "edge",
        "policy",
        "sent",
        "received",
        "p50",
        "p99",
        "dropped",
        "missing",
        "late",
        "repeated",
        "reordered",
        "blocked",
    ];
    let mut rows = vec![columns.map(String::from)];
    rows.extend(status.edges.iter().map(|edge| {
        [
            format!("{} → {}", edge.from, edge.to),
            format!("{} {}", policy_word(edge.policy), edge.capacity),
            edge.sent.to_string(),
            edge.received.to_string(),
            age(edge, 0.5),
            age(edge, 0.99),
            edge.dropped.to_string(),
            edge.missing.to_string(),
            edge.late.to_string(),
            edge.repeated.to_string(),
            edge.reordered.to_string(),
            format!("{:.1} ms", edge.blocked_nanos as f64 / 1e6),
        ]
    }));
    lines.extend(table(&rows, 2));
    lines
}

/// How old samples were on arrival, since the graph's start.
fn age(edge: &EdgeStatus, share: f64) -> String {
    edge.ages.quantile_nanos(share).map_or("-".into(), short_time)
}

/// What is not as it should be, in plain words.
pub(super) fn warnings(status: &GraphStatus) -> Vec<String> {
    let mut warnings: Vec<String> = status.message.iter().cloned().collect();
    if status.state == GraphState::Degraded {
        let failed: Vec<&str> =
            status.nodes.iter().filter(|node| node.state == NodeState::Failed).map(|node| node.node.as_str()).collect();
        let which = if failed.is_empty() { "an operator".into() } else { failed.join(", ") };
        warnings.push(format!(
            "nothing behind {which} is decided until it is swapped (blindgrasp swap) or the graph stopped"
        ));
    }
    let lost = |edge: &&EdgeStatus| edge.policy == EdgePolicy::Lossless && edge.dropped > 0;
    warnings.extend(status.edges.iter().filter(lost).map(|edge| {
        format!("{} samples were lost between {} and {}, whose edge is lossless", edge.dropped, edge.from, edge.to)
    }));
    warnings
}

fn pids(node: &NodeStatus) -> String {
    let active = node.pid.map_or("-".into(), |pid| pid.to_string());
    node.standby_pid.map_or(active.clone(), |standby| format!("{active} (standby {standby})"))
}

pub(super) fn state_word(state: GraphState) -> &'static str {
    match state {
        GraphState::Starting => "starting",
        GraphState::Running => "running",
        GraphState::Degraded => "DEGRADED",
        GraphState::Stopping => "stopping",
    }
}

pub(super) fn node_state_word(state: NodeState) -> &'static str {
    match state {
        NodeState::Starting => "starting",
        NodeState::Running => "running",
        NodeState::Restarting => "restarting",
        NodeState::Done => "done",
        NodeState::Failed => "FAILED",
    }
}

fn policy_word(policy: EdgePolicy) -> &'static str {
    match policy {
        EdgePolicy::Lossless => "lossless",
        EdgePolicy::Latest => "latest",
    }
}

/// Columns as wide as their widest cell; the first `n_left` begin at their left.
fn table<const N: usize>(rows: &[[String; N]], n_left: usize) -> Vec<String> {
    let n_chars = |cell: &String| cell.chars().count();
    let widths: [usize; N] =
        std::array::from_fn(|column_idx| rows.iter().map(|row| n_chars(&row[column_idx])).max().unwrap_or(0));
    let line = |row: &[String; N]| {
        let cells = row.iter().zip(widths).enumerate().map(|(column_idx, (cell, width))| {
            if column_idx < n_left { format!("{cell:<width$}") } else { format!("{cell:>width$}") }
        });
        format!("  {}", cells.collect::<Vec<_>>().join("  ")).trim_end().to_string()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::client::tests::made_status;

    fn made() -> RunningGraph {
        let usage = ProcessUsage { cpu_secs: 1.25, resident_bytes: 3 << 20 };
        RunningGraph { status: made_status("gate"), usage: [("contacts".to_string(), usage)].into() }
    }

    #[test]
    fn a_degraded_graph_says_so_and_its_tables_stand_straight() {
        let mut graph = made();
        graph.status.nodes[0].pid = Some(4243);
        let expected = "\
graph 'gate'  DEGRADED, up 1h 2m 5s, pid 4242, /robot/dataflow.yaml
  classifier was given up after 5 restarts
  nothing behind classifier is decided until it is swapped (blindgrasp swap) or the graph stopped
  node        state                  pid  restarts  swaps  heartbeat    cpu   memory
  contacts    running  4243 (standby 77)         2      1  12 ms ago  1.2 s  3.0 MiB
  classifier  FAILED                   -         0      0          -      -        -
  edge                                       policy    sent  received    p50    p99  dropped  missing  late  repeated  reordered  blocked
  contacts/contacts → classifier/contacts  latest 4  1000       990  102µs  1.0ms       10       11     7         3          2   1.5 ms";
        let found = formatted(&graph);
        let expected: Vec<&str> = expected.lines().collect();
        assert_eq!(found[..3], expected[..3]);
        let cells = |line: &str| line.split_whitespace().map(str::to_string).collect::<Vec<_>>();
        for (found, expected) in found.iter().zip(&expected).skip(3) {
            assert_eq!(cells(found), cells(expected));
        }
        assert_eq!(found.len(), expected.len());
        // Right-aligned columns end together.
        let n_chars = |line: &String| line.chars().count();
        assert!(n_chars(&found[3]) == n_chars(&found[4]) && n_chars(&found[4]) == n_chars(&found[5]));
        assert_eq!(n_chars(&found[6]), n_chars(&found[7]));
    }

    #[test]
    fn a_loss_on_a_lossless_edge_is_said_in_words() {
        let mut graph = made();
        graph.status.state = GraphState::Running;
        graph.status.message = None;
        assert_eq!(warnings(&graph.status), Vec::<String>::new());
        graph.status.edges[0].policy = EdgePolicy::Lossless;
        let expected = "10 samples were lost between contacts/contacts and classifier/contacts, whose edge is lossless";
        assert_eq!(warnings(&graph.status), [expected]);
    }

    #[test]
    fn json_has_the_status_and_what_is_used() {
        let json = serde_json::to_value(made()).expect("JSON");
        assert_eq!(json["state"], "degraded");
        assert_eq!(json["nodes"][1]["state"], "failed");
        assert_eq!(json["edges"][0]["policy"], "latest");
        assert_eq!(json["usage"]["contacts"]["cpu_secs"], 1.25);
    }
}
