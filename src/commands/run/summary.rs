//! The summary at a run's end.

use std::collections::BTreeMap;
use std::path::PathBuf;

use hdrhistogram::Histogram;
use serde::Serialize;

use super::super::percent;
use blindgrasp_graph::control::{EdgeStatus, GraphStatus};
use blindgrasp_graph::dataflow::{Graph, Node};
use blindgrasp_graph::launcher::{End, LaunchError};
use blindgrasp_graph::plan::Port;
use blindgrasp_learning::evaluation::Score;
use blindgrasp_operator::link_status::{ChannelStatus, LinkStatus};
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_operator::wiring::InputCounts;

#[derive(Serialize)]
pub(in crate::commands) struct Summary {
    pub(in crate::commands) graph: String,
    pub(in crate::commands) end: &'static str,
    pub(in crate::commands) grasps: usize,
    pub(in crate::commands) lift: usize,
    pub(in crate::commands) hold: usize,
    /// Of those held, the ones to be grasped anew as their advice says.
    pub(in crate::commands) regrasp: usize,
    pub(in crate::commands) with_truth: usize,
    pub(in crate::commands) accuracy: Option<f64>,
    pub(in crate::commands) majority_class: Option<f64>,
    pub(in crate::commands) false_positives: usize,
    pub(in crate::commands) false_positive_share: Option<f64>,
    /// The same over the grasps that were decided by what the classifier said.
    pub(in crate::commands) judged: Score,
    /// Grasps whose truth came but no decision.
    pub(in crate::commands) undecided: usize,
    pub(in crate::commands) reasons: BTreeMap<String, usize>,
    pub(in crate::commands) latency_nanos: Option<Latency>,
    /// On lossless edges, and skipped by stages.
    pub(in crate::commands) samples_lost: u64,
    /// On `latest` edges, for newer ones.
    pub(in crate::commands) samples_dropped: u64,
    /// Edges whose writer does not count what it sends: what was lost there, nobody knows.
    pub(in crate::commands) edges_unknown: usize,
    /// How often operators were started again after a failure.
    pub(in crate::commands) restarts: u32,
    /// How often operators were swapped.
    pub(in crate::commands) swaps: u32,
    /// What nodes count besides their samples, like the frames that a source refused; nodes that count nothing are not there.
    pub(in crate::commands) counts: BTreeMap<String, BTreeMap<String, u64>>,
    /// Of a part of a graph: how the other machines were at the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(in crate::commands) link: Option<LinkStatus>,
    pub(in crate::commands) edges: Vec<EdgeStatus>,
    pub(in crate::commands) operators: Vec<OperatorPid>,
    pub(in crate::commands) recorded: Option<BTreeMap<String, u64>>,
    pub(in crate::commands) recorded_files: Vec<PathBuf>,
    /// Why the recording ended before the graph.
    pub(in crate::commands) recording_error: Option<String>,
    /// Samples that were received and are not in the recording.
    pub(in crate::commands) samples_not_recorded: u64,
}

#[derive(Serialize)]
pub(in crate::commands) struct Latency {
    pub(in crate::commands) p50: u64,
    pub(in crate::commands) p90: u64,
    pub(in crate::commands) p99: u64,
    pub(in crate::commands) max: u64,
}

#[derive(Serialize)]
pub(in crate::commands) struct OperatorPid {
    pub(in crate::commands) node: String,
    pub(in crate::commands) pid: u32,
}

/// A graph that has run.
pub(super) struct Ran<'a> {
    pub(super) graph: &'a Graph,
    pub(super) status: GraphStatus,
    pub(super) ended: &'a Result<End, LaunchError>,
    pub(super) pids: &'a [(String, u32)],
    pub(super) topics: &'a BTreeMap<Port, String>,
}

/// What went over each edge; of those to the run itself, what it could read.
pub(super) fn edges(ran: &Ran<'_>, observed: &BTreeMap<String, InputCounts>) -> Vec<EdgeStatus> {
    let by_port = ran.topics.iter().map(|((node, port), topic)| (format!("{node}/{port}"), topic));
    let topics: BTreeMap<String, &String> = by_port.collect();
    let mut edges = ran.status.edges.clone();
    for edge in edges.iter_mut().filter(|edge| edge.to == "run") {
        if let Some(counts) = topics.get(&edge.from).and_then(|topic| observed.get(*topic)) {
            edge.received = counts.n_received;
            edge.dropped = edge.sent.saturating_sub(edge.received);
        }
    }
    edges
}

/// Numbers that are missing behind a stage but were not missing before it: samples it did not answer. What the edge behind it
/// dropped or lost is counted there.
pub(super) fn skipped_by_stages(graph: &Graph, edges: &[EdgeStatus]) -> u64 {
    graph
        .nodes
        .iter()
        .filter(|node| !node.inputs.is_empty() && !node.is_source())
        .map(|node| {
            let prefix = format!("{}/", node.id);
            let behind = edges.iter().filter(|edge| edge.from.starts_with(&prefix));
            let before = edges.iter().filter(|edge| edge.to.starts_with(&prefix));
            let n_behind = behind.map(|edge| edge.missing.saturating_sub(edge.dropped)).max().unwrap_or(0);
            n_behind.saturating_sub(before.map(|edge| edge.missing).max().unwrap_or(0))
        })
        .sum()
}

/// Samples that were kept for other machines and given up, on channels of this policy.
pub(super) fn lost_to_machines(ran: &Ran<'_>, policy: EdgePolicy) -> u64 {
    let link = ran.graph.nodes.iter().find(|node| node.is_link());
    let is_of_policy = |machine: &str, port: &str| {
        let inputs = link.iter().flat_map(|link| &link.inputs);
        inputs.clone().any(|input| input.port == format!("{machine}/{port}") && input.edge.policy == policy)
    };
    let peers = ran.status.link.iter().flat_map(|link| &link.peers);
    let sent = peers.flat_map(|peer| peer.channels.iter().map(move |channel| (peer, channel)));
    sent.filter(|(peer, channel)| channel.is_sent && is_of_policy(&peer.machine, &channel.port))
        .map(|(_, channel)| channel.n_lost)
        .sum()
}

/// Numbers that are missing in what other machines answered, and were not missing in what sources here sent.
pub(super) fn missing_from_machines(graph: &Graph, edges: &[EdgeStatus]) -> u64 {
    let imports = graph.local.iter().flat_map(|local| &local.imports);
    let missing = |edges: &mut dyn Iterator<Item = &EdgeStatus>| {
        edges.map(|edge| edge.missing.saturating_sub(edge.dropped)).max().unwrap_or(0)
    };
    let is_of_source = |edge: &&EdgeStatus| {
        let node = edge.from.split('/').next().and_then(|node| graph.node(node));
        node.is_some_and(Node::is_source)
    };
    let before = missing(&mut edges.iter().filter(is_of_source));
    // What is missing of another machine's source is counted there, and a part that begins later has not lost what went before.
    let answers = imports.filter(|(_, is_driven)| !is_driven);
    answers.map(|(port, _)| missing(&mut edges.iter().filter(|edge| edge.from == *port)).saturating_sub(before)).sum()
}

pub(super) fn latency(nanos: &Histogram<u64>) -> Option<Latency> {
    let quantile = |share: f64| nanos.value_at_quantile(share);
    let summary = Latency { p50: quantile(0.5), p90: quantile(0.9), p99: quantile(0.99), max: nanos.max() };
    (!nanos.is_empty()).then_some(summary)
}

/// The summary for a person.
pub(super) fn table(summary: &Summary) -> Vec<String> {
    let counts = summary.counts.iter().map(|(node, counts)| {
        let counts = counts.iter().map(|(name, count)| format!("{name} {count}"));
        format!("{node}: {}", counts.collect::<Vec<_>>().join(", "))
    });
    let counts: Vec<String> = counts.collect();
    let machines = summary.link.iter().flat_map(|link| &link.peers).map(|peer| {
        let total = |count: fn(&ChannelStatus) -> u64, is_sent: bool| {
            peer.channels.iter().filter(|channel| channel.is_sent == is_sent).map(count).sum::<u64>()
        };
        format!(
            "{} found {}×, {} samples to it ({} again, {} lost), {} from it",
            peer.machine,
            peer.n_times_up,
            total(|channel| channel.n_samples, true),
            total(|channel| channel.n_repeated, true),
            total(|channel| channel.n_lost, true),
            total(|channel| channel.n_samples, false)
        )
    });
    let machines: Vec<String> = machines.collect();
    let rows = [
        (
            "grasps",
            format!(
                "{} ({} LIFT, {} HOLD{}), {} undecided{}",
                summary.grasps,
                summary.lift,
                summary.hold,
                if summary.regrasp > 0 { format!(", {} of them REGRASP", summary.regrasp) } else { String::new() },
                summary.undecided,
                if summary.end == "finished" { String::new() } else { format!("; the graph was {}", summary.end) }
            ),
        ),
        (
            "accuracy",
            format!(
                "{} of {} with truth (majority class {})",
                percent(summary.accuracy),
                summary.with_truth,
                percent(summary.majority_class)
            ),
        ),
        (
            "false positives",
            format!("{} ({} of all grasps)", summary.false_positives, percent(summary.false_positive_share)),
        ),
        (
            "judged",
            format!(
                "{} grasps: accuracy {}, {} false positives ({})",
                summary.judged.n_grasps,
                percent(summary.judged.accuracy),
                summary.judged.n_false_positive,
                percent(summary.judged.false_positive_share)
            ),
        ),
        ("reasons", summary.reasons.iter().map(|(reason, n)| format!("{reason} {n}")).collect::<Vec<_>>().join(", ")),
        (
            "latency",
            summary.latency_nanos.as_ref().map_or("n/a".into(), |latency| {
                let micros = |nanos: u64| nanos as f64 / 1e3;
                format!(
                    "source to decision: p50 {:.0} µs, p90 {:.0} µs, p99 {:.0} µs, max {:.0} µs",
                    micros(latency.p50),
                    micros(latency.p90),
                    micros(latency.p99),
                    micros(latency.max)
                )
            }),
        ),
        (
            "samples lost",
            match (summary.edges_unknown, summary.samples_dropped) {
                (0, 0) => summary.samples_lost.to_string(),
                (0, n) => format!("{}, dropped for newer ones: {n}", summary.samples_lost),
                (n, _) => format!("{}, unknown on {n} edges", summary.samples_lost),
            },
        ),
        ("restarts, swaps", format!("{}, {}", summary.restarts, summary.swaps)),
        ("machines", machines.join("; ")),
        ("counts", counts.join("; ")),
    ];
    // Live grasps have no truth to be measured by, and mostly nothing else is counted.
    let is_of_truth = |name: &str| ["accuracy", "false positives", "judged"].contains(&name);
    let is_shown = |(name, text): &(&str, String)| {
        let is_rare = ["counts", "machines"].contains(name);
        (summary.with_truth > 0 || !is_of_truth(name)) && (!is_rare || !text.is_empty())
    };
    let columns = ["sent", "received", "dropped", "missing", "late"].map(|column| format!(" {column:>9}")).concat();
    let head = [String::new(), format!("{:<28} {:<26}{columns}", "edge from", "to")];
    let edges = summary.edges.iter().map(|edge| {
        let counts = [edge.sent, edge.received, edge.dropped, edge.missing, edge.late];
        format!("{:<28} {:<26}{}", edge.from, edge.to, counts.map(|count| format!(" {count:>9}")).concat())
    });
    let rows = rows.into_iter().filter(is_shown).map(|(what, value)| format!("{what:<16} {value}"));
    std::iter::once(String::new()).chain(rows).chain(head).chain(edges).collect()
}
