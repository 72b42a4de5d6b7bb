//! The summary at a run's end, and what is counted for it.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::control::{EdgeStatus, GraphStatus, NodeStatus};
use crate::dataflow::{EdgePolicy, Graph, Node};
use crate::launcher::{End, LaunchError, QUARANTINED};
use crate::plan::Port;
use blindgrasp_messages::score::Score;
use blindgrasp_operator::link_status::LinkStatus;
use blindgrasp_operator::wiring::{Clock, InputCounts};

/// What became of a graph.
#[derive(Debug, Clone, Serialize)]
pub struct RunSummary {
    pub graph: String,
    /// `finished`, `stopped`, `degraded` or `failed`.
    pub end: &'static str,
    pub grasps: usize,
    pub lift: usize,
    pub hold: usize,
    /// Probes that were asked for before decisions.
    pub probes: usize,
    pub with_truth: usize,
    pub accuracy: Option<f64>,
    pub majority_class: Option<f64>,
    pub false_positives: usize,
    pub false_positive_share: Option<f64>,
    /// The score over the grasps that the classifier decided.
    pub judged: Score,
    /// Grasps whose truth came but no decision.
    pub undecided: usize,
    pub reasons: BTreeMap<String, usize>,
    pub latency_nanos: Option<Latency>,
    /// Samples lost on lossless edges or skipped by stages.
    pub samples_lost: u64,
    /// Samples dropped for newer ones on `latest` edges.
    pub samples_dropped: u64,
    /// Edges whose writer does not count its samples, so that losses there are unknown.
    pub edges_unknown: usize,
    /// Restarts of operators after a failure.
    pub restarts: u32,
    pub swaps: u32,
    /// Other counts of nodes, such as the frames that a source refused; only nodes that have some.
    pub counts: BTreeMap<String, BTreeMap<String, u64>>,
    /// Of one machine's part of a graph: the state of the other machines at the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkStatus>,
    pub edges: Vec<EdgeStatus>,
    pub operators: Vec<OperatorPid>,
}

impl RunSummary {
    /// Whether samples were lost or may have been, or a grasp was not decided.
    pub fn is_lossy(&self, clock: Clock) -> bool {
        // A stopped graph may know the truth of a grasp that it has not reached. A replay may be cut out of a longer
        // stream, with truths of grasps that it does not hold.
        let is_undecided = self.undecided > 0 && self.end == "finished" && clock == Clock::Machine;
        self.samples_lost > 0 || self.samples_dropped > 0 || self.edges_unknown > 0 || is_undecided
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct Latency {
    pub p50: u64,
    pub p90: u64,
    pub p99: u64,
    pub max: u64,
}

#[derive(Debug, Clone, Serialize)]
pub struct OperatorPid {
    pub node: String,
    pub pid: u32,
}

/// A graph that has run, as the launcher knows it.
pub(super) struct Ran<'a> {
    pub(super) graph: &'a Graph,
    pub(super) status: GraphStatus,
    pub(super) outcome: &'a Result<End, LaunchError>,
    pub(super) pids: &'a [(String, u32)],
    pub(super) topics: &'a BTreeMap<Port, String>,
}

/// The counts of each edge; of the edges to the run itself, the samples that it could read.
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

/// Samples that a stage did not answer: numbers that are missing behind it but not before it, or those in quarantine if they
/// are more. Samples that the edge behind it dropped are counted there.
pub(super) fn skipped_by_stages(graph: &Graph, nodes: &[NodeStatus], edges: &[EdgeStatus]) -> u64 {
    graph
        .nodes
        .iter()
        .filter(|node| !node.inputs.is_empty() && !node.is_source())
        .map(|node| {
            let prefix = format!("{}/", node.id);
            let behind = edges.iter().filter(|edge| edge.from.starts_with(&prefix));
            let before = edges.iter().filter(|edge| edge.to.starts_with(&prefix));
            let n_behind = behind.map(|edge| edge.missing.saturating_sub(edge.dropped)).max().unwrap_or(0);
            let n_skipped = n_behind.saturating_sub(before.map(|edge| edge.missing).max().unwrap_or(0));
            let status = nodes.iter().find(|status| status.node == node.id);
            let n_quarantined = status.and_then(|status| status.counts.get(QUARANTINED)).copied();
            n_skipped.max(n_quarantined.unwrap_or(0))
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

/// Numbers that are missing in the answers of other machines, and were not missing in the samples of sources here.
pub(super) fn missing_from_machines(graph: &Graph, edges: &[EdgeStatus]) -> u64 {
    let imports = graph.local.iter().flat_map(|local| &local.imports);
    let missing = |edges: &mut dyn Iterator<Item = &EdgeStatus>| {
        edges.map(|edge| edge.missing.saturating_sub(edge.dropped)).max().unwrap_or(0)
    };
    let before = missing(&mut edges.iter().filter(|edge| {
        let node = edge.from.split('/').next().and_then(|node| graph.node(node));
        node.is_some_and(Node::is_source)
    }));
    // Missing samples of another machine's source are counted there: a part that begins later has not lost earlier
    // samples.
    let answers = imports.filter(|(_, is_driven)| !is_driven);
    answers.map(|(port, _)| missing(&mut edges.iter().filter(|edge| edge.from == *port)).saturating_sub(before)).sum()
}

pub(super) fn latency(nanos: &Histogram<u64>) -> Option<Latency> {
    let [p50, p90, p99] = [0.5, 0.9, 0.99].map(|share| nanos.value_at_quantile(share));
    if nanos.is_empty() { None } else { Some(Latency { p50, p90, p99, max: nanos.max() }) }
}
