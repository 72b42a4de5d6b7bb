//! `blindgrasp ps`

use std::collections::BTreeMap;
use std::time::Duration;

use clap::Args;
use serde::Serialize;

use super::promises::{RobotPromise, creep_in};
use super::text_table::TextTable;
use super::{Outcome, completions, print_line};
use blindgrasp_graph::client::usage::{ProcessUsage, usage};
use blindgrasp_graph::client::words::{
    clock_offset, node_state_word, peer_state_word, short_time, state_word, warnings,
};
use blindgrasp_graph::client::{pick_graph, running_graphs, status};
use blindgrasp_graph::control::{EdgeStatus, GraphStatus, NodeStatus};
use blindgrasp_graph::log::printable;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::link_status::LinkStatus;
use blindgrasp_operator::wiring::EdgePolicy;

/// Show running graphs with their operators and edges
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp ps grasp_gate\n\n\
                        Exit code 1 if the graph that is named does not run or does not answer.")]
pub(super) struct Arguments {
    /// Show only this graph
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    /// Print JSON
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
    /// The use of the active processes, by node.
    usage: BTreeMap<String, ProcessUsage>,
    /// The promise that the robot's lifts allow, by the node that counts them.
    promises: BTreeMap<String, RobotPromise>,
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
            Listing { graphs: vec![completed(status)], not_answering: Vec::new() }
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
    for graph in running_graphs() {
        match status(&graph) {
            Ok(status) => listing.graphs.push(completed(status)),
            Err(error) => {
                listing.not_answering.push(Silent { graph, message: format!("{:#}", anyhow::anyhow!(error)) })
            }
        }
    }
    Ok(listing)
}

/// Adds the use of the processes.
fn completed(status: GraphStatus) -> RunningGraph {
    let usage = status.nodes.iter().filter_map(|node| Some((node.node.clone(), usage(node.pid?)?))).collect();
    let promises = status.nodes.iter();
    let promises = promises.filter_map(|node| Some((node.node.clone(), RobotPromise::of(&node.counts)?))).collect();
    RunningGraph { status, usage, promises }
}

fn formatted(graph: &RunningGraph) -> Vec<String> {
    let RunningGraph { status, usage, promises } = graph;
    let uptime = humantime::format_duration(Duration::from_secs(status.uptime_secs.max(0.0) as u64));
    let on = status.link.as_ref().map_or(String::new(), |link| match &link.namespace {
        Some(namespace) => format!(" on {} of {namespace}", link.machine),
        None => format!(" on {}", link.machine),
    });
    let mut lines = vec![format!(
        "graph '{}'{on}  {}, up {uptime}, pid {}, {}",
        status.graph,
        state_word(status.state),
        status.pid,
        status.file.display()
    )];
    lines.extend(warnings(status).into_iter().map(|warning| format!("  {}", printable(&warning))));
    lines.extend(promises.iter().map(|(node, promise)| format!("  {}: {promise}", printable(node))));
    for node in &status.nodes {
        lines.extend(creep_in(&node.counts).map(|creep| format!("  {}: {creep}", printable(&node.node))));
    }
    if let Some(link) = &status.link {
        lines.extend(link_tables(link));
    }
    let titles = ["node", "state", "pid", "restarts", "swaps", "heartbeat", "cpu", "memory"];
    let mut nodes = TextTable::new(titles, 2);
    status.nodes.iter().for_each(|node| nodes.row(node_row(node, usage.get(&node.node))));
    let titles = "edge policy sent received p50 p99 dropped missing late repeated reordered blocked".split(' ');
    let mut edges = TextTable::new(titles, 2);
    status.edges.iter().for_each(|edge| edges.row(edge_row(edge)));
    lines.extend(indented(&nodes).chain(indented(&edges)));
    lines
}

fn node_row(node: &NodeStatus, used: Option<&ProcessUsage>) -> Vec<String> {
    vec![
        node.node.clone(),
        node_state_word(node.state).into(),
        pids(node),
        node.n_restarts.to_string(),
        node.n_swaps.to_string(),
        node.heartbeat_age_millis.map_or("-".into(), |millis| format!("{millis} ms ago")),
        used.map_or("-".into(), |used| format!("{:.1} s", used.cpu_secs)),
        used.map_or("-".into(), |used| mebibytes(used.resident_bytes)),
    ]
}

fn edge_row(edge: &EdgeStatus) -> Vec<String> {
    vec![
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
}

/// The other machines, and the edges between them and this one.
fn link_tables(link: &LinkStatus) -> Vec<String> {
    let titles = ["machine", "link", "clock offset", "round trip", "heard", "found", "version", "sent", "received"];
    let mut machines = TextTable::new(titles, 2);
    let mut channels = TextTable::new(["crossing", "samples", "repeated", "waiting", "lost", "blocked"], 1);
    for peer in &link.peers {
        machines.row([
            printable(&peer.machine),
            peer_state_word(peer.state).into(),
            clock_offset(peer),
            peer.round_trip_nanos.map_or("-".into(), short_time),
            peer.silent_millis.map_or("-".into(), |millis| format!("{millis} ms ago")),
            format!("{}×", peer.n_times_up),
            peer.version.as_deref().map_or("-".into(), printable),
            mebibytes(peer.bytes_sent),
            mebibytes(peer.bytes_received),
        ]);
        for channel in &peer.channels {
            let arrow = if channel.is_sent { "→" } else { "←" };
            channels.row([
                format!("{} {arrow} {}", channel.port, printable(&peer.machine)),
                channel.n_samples.to_string(),
                channel.n_repeated.to_string(),
                channel.n_waiting.to_string(),
                channel.n_lost.to_string(),
                format!("{:.1} ms", channel.blocked_nanos as f64 / 1e6),
            ]);
        }
    }
    let mut lines: Vec<String> = indented(&machines).collect();
    if !channels.is_empty() {
        lines.extend(indented(&channels));
    }
    let rejected = link.rejected.iter().filter(|(_, count)| **count > 0);
    let rejected: Vec<String> = rejected.map(|(why, count)| format!("{count} {}", printable(why))).collect();
    if !rejected.is_empty() {
        lines.push(format!("  messages dropped unread: {}", rejected.join(", ")));
    }
    lines
}

fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

/// The age of samples on arrival, since the graph's start.
fn age(edge: &EdgeStatus, share: f64) -> String {
    edge.ages.quantile_nanos(share).map_or("-".into(), short_time)
}

fn pids(node: &NodeStatus) -> String {
    let active = node.pid.map_or("-".into(), |pid| pid.to_string());
    node.standby_pid.map_or(active.clone(), |standby| format!("{active} (standby {standby})"))
}

fn policy_word(policy: EdgePolicy) -> &'static str {
    match policy {
        EdgePolicy::Lossless => "lossless",
        EdgePolicy::Latest => "latest",
    }
}

fn indented(table: &TextTable) -> impl Iterator<Item = String> {
    table.lines().into_iter().map(|line| format!("  {line}"))
}

#[cfg(test)]
mod tests {
    use blindgrasp_operator::link_status::{PeerState, PeerStatus};

    use super::*;
    use blindgrasp_graph::testing::made_status;
    use blindgrasp_operator::link_status::ChannelStatus;

    fn made() -> RunningGraph {
        let usage = ProcessUsage { cpu_secs: 1.25, resident_bytes: 3 << 20 };
        let usage = [("contacts".to_string(), usage)].into();
        RunningGraph { status: made_status("gate"), usage, promises: BTreeMap::new() }
    }

    fn linked() -> LinkStatus {
        let brain = PeerStatus {
            machine: "brain".into(),
            state: PeerState::Up,
            version: Some("0.1.0".into()),
            n_times_up: 2,
            silent_millis: Some(12),
            offset_nanos: Some(-1_200_000),
            uncertainty_nanos: Some(35_000),
            round_trip_nanos: Some(210_000),
            bytes_sent: 3 << 20,
            bytes_received: 0,
            channels: vec![ChannelStatus {
                port: "contacts/contacts".into(),
                is_sent: true,
                n_samples: 1000,
                n_repeated: 5,
                n_waiting: 2,
                n_lost: 0,
                blocked_nanos: 1_500_000,
            }],
            ..PeerStatus::default()
        };
        let laptop = PeerStatus {
            machine: "laptop".into(),
            state: PeerState::Refused,
            reason: Some("it runs version 9".into()),
            ..PeerStatus::default()
        };
        LinkStatus {
            machine: "robot".into(),
            namespace: Some("robot7".into()),
            peers: vec![brain, laptop],
            rejected: [("malformed".to_string(), 3), ("foreign".to_string(), 0)].into(),
        }
    }

    #[test]
    fn the_links_to_other_machines_are_shown() {
        let mut graph = made();
        graph.status.link = Some(linked());
        let spaced = |line: &String| line.split_whitespace().collect::<Vec<_>>().join(" ");
        let found = formatted(&graph).iter().map(spaced).collect::<Vec<_>>().join("\n");
        for expected in [
            "graph 'gate' on robot of robot7 DEGRADED",
            "machine 'laptop' and this one do not fit: it runs version 9",
            "brain up -1.2ms ±35µs 210µs 12 ms ago 2× 0.1.0 3.0 MiB 0.0 MiB",
            "contacts/contacts → brain 1000 5 2 0 1.5 ms",
            "messages dropped unread: 3 malformed\n",
        ] {
            assert!(found.contains(expected), "{expected}\n{found}");
        }
        assert_eq!(found.matches("machine 'laptop'").count(), 1, "{found}");
        let json = serde_json::to_value(&graph).expect("JSON");
        assert_eq!(json["link"]["peers"][0]["uncertainty_nanos"], 35_000);
    }

    #[test]
    fn a_degraded_graph_says_so_and_its_tables_stand_straight() {
        let mut graph = made();
        graph.status.nodes[0].pid = Some(4243);
        let expected = "\
graph 'gate'  DEGRADED, up 1h 2m 5s, pid 4242, /robot/dataflow.yaml
  classifier was given up after 5 restarts
  grasps are not decided without classifier: swap it (blindgrasp swap) or stop the graph
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
    fn json_has_the_status_and_what_is_used() {
        let json = serde_json::to_value(made()).expect("JSON");
        assert_eq!(json["state"], "degraded");
        assert_eq!(json["nodes"][1]["state"], "failed");
        assert_eq!(json["edges"][0]["policy"], "latest");
        assert_eq!(json["usage"]["contacts"]["cpu_secs"], 1.25);
    }
}
