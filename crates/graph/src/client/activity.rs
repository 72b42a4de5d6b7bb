//! The activity of a graph between two looks at it.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::Serialize;

use super::usage::{ProcessUsage, usage};
use crate::control::{DecidedGrasp, EdgeStatus, GraphState, GraphStatus, NodeState};
use blindgrasp_operator::ages::Ages;
use blindgrasp_operator::link_status::LinkStatus;
use blindgrasp_operator::wiring::EdgePolicy;

/// A graph at a moment.
#[derive(Debug, Clone)]
pub struct Look {
    pub status: GraphStatus,
    /// The use of its processes, including the launcher's, by process.
    pub usage: BTreeMap<u32, ProcessUsage>,
    pub at: Instant,
    pub load_average: Option<f64>,
}

/// The activity of a graph, a line of JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Measured {
    pub graph: String,
    pub state: GraphState,
    pub message: Option<String>,
    pub pid: u32,
    pub uptime_secs: f64,
    pub interval_secs: f64,
    pub load_average: Option<f64>,
    /// The share of one processor used by all processes, including the launcher.
    pub cpu_percent: Option<f64>,
    pub launcher_cpu_percent: Option<f64>,
    pub nodes: Vec<MeasuredNode>,
    pub edges: Vec<MeasuredEdge>,
    /// The latency from the source to the launching command; `None` without decisions.
    pub decision_latency_nanos: Option<Quantiles>,
    pub decisions: MeasuredDecisions,
    /// The other machines of a graph on several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkStatus>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasuredNode {
    pub node: String,
    pub state: NodeState,
    pub pid: Option<u32>,
    pub standby_pid: Option<u32>,
    /// The share of one processor; `None` for a new process.
    pub cpu_percent: Option<f64>,
    pub resident_bytes: Option<u64>,
    pub n_restarts: u32,
    pub n_swaps: u32,
    pub heartbeat_age_millis: Option<u64>,
    pub counts: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasuredEdge {
    pub from: String,
    pub to: String,
    pub policy: EdgePolicy,
    pub capacity: usize,
    /// Samples received, per second.
    pub rate_hz: f64,
    /// The age on arrival, since the source published; `None` without samples that have a time.
    pub age_nanos: Option<Quantiles>,
    /// Samples that wait for the reader or are being answered.
    pub n_queued: u64,
    pub sent: u64,
    pub received: u64,
    pub dropped: u64,
    pub missing: u64,
    pub late: u64,
    pub repeated: u64,
    pub reordered: u64,
    pub blocked_nanos: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Quantiles {
    pub p50: u64,
    pub p90: u64,
    pub p99: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasuredDecisions {
    pub n_lift: u64,
    pub n_hold: u64,
    pub n_false_positives: u64,
    pub rate_hz: f64,
    /// The decisions since the look before; at most as many as the graph keeps.
    pub new: Vec<DecidedGrasp>,
}

impl Look {
    pub fn new(status: GraphStatus) -> Look {
        let nodes = status.nodes.iter().flat_map(|node| [node.pid, node.standby_pid]).flatten();
        let pids = nodes.chain([status.pid]);
        let usage = pids.filter_map(|pid| Some((pid, usage(pid)?))).collect();
        Look { status, usage, at: Instant::now(), load_average: load_average() }
    }

    fn edge(&self, from: &str, to: &str) -> Option<&EdgeStatus> {
        self.status.edges.iter().find(|edge| edge.from == from && edge.to == to)
    }
}

/// The activity of a graph up to a look at it. Rates and ages are since the look `before`, or since the graph's start;
/// counts are since its start, processor time and new decisions since the look `before` alone.
pub fn measure(now: &Look, before: Option<&Look>) -> Measured {
    let status = &now.status;
    let previous = before.unwrap_or(now);
    let interval_secs = secs_since(status, before);
    let shares: Vec<f64> = now.usage.keys().filter_map(|pid| cpu_percent(now, previous, *pid)).collect();
    let nodes = status.nodes.iter().map(|node| MeasuredNode {
        node: node.node.clone(),
        state: node.state,
        pid: node.pid,
        standby_pid: node.standby_pid,
        cpu_percent: node.pid.and_then(|pid| cpu_percent(now, previous, pid)),
        resident_bytes: node.pid.and_then(|pid| Some(now.usage.get(&pid)?.resident_bytes)),
        n_restarts: node.n_restarts,
        n_swaps: node.n_swaps,
        heartbeat_age_millis: node.heartbeat_age_millis,
        counts: node.counts.clone(),
    });
    let edges = status.edges.iter().map(|edge| measured_edge(edge, status, before, interval_secs));
    let decisions = &status.decisions;
    Measured {
        graph: status.graph.clone(),
        state: status.state,
        message: status.message.clone(),
        pid: status.pid,
        uptime_secs: status.uptime_secs,
        interval_secs,
        load_average: now.load_average,
        cpu_percent: (!shares.is_empty()).then(|| shares.iter().sum()),
        launcher_cpu_percent: cpu_percent(now, previous, status.pid),
        nodes: nodes.collect(),
        edges: edges.collect(),
        decision_latency_nanos: decision_edge(&status.edges).and_then(|edge| ages_since(edge, before)),
        decisions: MeasuredDecisions {
            n_lift: decisions.n_lift,
            n_hold: decisions.n_hold,
            n_false_positives: decisions.n_false_positives,
            rate_hz: per_sec(n_decided(now).saturating_sub(before.map_or(0, n_decided)), interval_secs),
            new: new_decisions(now, previous),
        },
        link: status.link.clone(),
    }
}

/// The share of one processor that a process has used.
fn cpu_percent(now: &Look, previous: &Look, pid: u32) -> Option<f64> {
    let secs = now.at.saturating_duration_since(previous.at).as_secs_f64();
    let (used, before) = (now.usage.get(&pid)?, previous.usage.get(&pid)?);
    if secs > 0.0 { Some(100.0 * (used.cpu_secs - before.cpu_secs).max(0.0) / secs) } else { None }
}

fn measured_edge(edge: &EdgeStatus, status: &GraphStatus, before: Option<&Look>, interval_secs: f64) -> MeasuredEdge {
    let received_before = before.and_then(|look| look.edge(&edge.from, &edge.to)).map_or(0, |edge| edge.received);
    MeasuredEdge {
        from: edge.from.clone(),
        to: edge.to.clone(),
        policy: edge.policy,
        capacity: edge.capacity,
        rate_hz: per_sec(edge.received.saturating_sub(received_before), interval_secs),
        age_nanos: ages_since(edge, before),
        n_queued: n_queued(edge, &status.edges),
        sent: edge.sent,
        received: edge.received,
        dropped: edge.dropped,
        missing: edge.missing,
        late: edge.late,
        repeated: edge.repeated,
        reordered: edge.reordered,
        blocked_nanos: edge.blocked_nanos,
    }
}

fn ages_since(edge: &EdgeStatus, before: Option<&Look>) -> Option<Quantiles> {
    match before.and_then(|look| look.edge(&edge.from, &edge.to)) {
        Some(before) => quantiles(&edge.ages.since(&before.ages)),
        None => quantiles(&edge.ages),
    }
}

fn n_decided(look: &Look) -> u64 {
    look.status.decisions.n_lift + look.status.decisions.n_hold
}

/// The edge over which the launching command reads decisions: among its edges from nodes with inputs (a source's truth
/// has none), the port `decision`, or otherwise the last in the graph's order.
fn decision_edge(edges: &[EdgeStatus]) -> Option<&EdgeStatus> {
    let mut last = None;
    for edge in edges {
        let writer = edge.from.split('/').next();
        if edge.to == RUN && edges.iter().any(|other| other.to != RUN && other.to.split('/').next() == writer) {
            if edge.from.ends_with("/decision") {
                return Some(edge);
            }
            last = Some(edge);
        }
    }
    last
}

/// The launching command, as the end of an edge.
pub const RUN: &str = "run";

/// The samples of an edge that wait for their reader or are being answered: sent, and neither received nor lost.
fn n_queued(edge: &EdgeStatus, edges: &[EdgeStatus]) -> u64 {
    let not_received = edge.sent.saturating_sub(edge.received).saturating_sub(edge.dropped);
    match edge.policy {
        EdgePolicy::Lossless => not_received,
        // While samples are on their way, dropped samples show as missing numbers. Numbers that were missing in the
        // writer's own inputs were never sent.
        EdgePolicy::Latest => {
            let writer = edge.from.split('/').next().unwrap_or_default();
            let inputs = edges.iter().filter(|other| other.to.split('/').next() == Some(writer) && other.to != RUN);
            let passed_on = inputs.map(|input| input.missing).max().unwrap_or(0);
            let gave_way = edge.missing.saturating_sub(passed_on).saturating_sub(edge.dropped);
            not_received.saturating_sub(gave_way).min(edge.capacity as u64)
        }
    }
}

fn quantiles(ages: &Ages) -> Option<Quantiles> {
    Some(Quantiles { p50: ages.quantile_nanos(0.5)?, p90: ages.quantile_nanos(0.9)?, p99: ages.quantile_nanos(0.99)? })
}

/// By the graph's own clock, because its answer takes a while to arrive.
fn secs_since(status: &GraphStatus, before: Option<&Look>) -> f64 {
    (status.uptime_secs - before.map_or(0.0, |look| look.status.uptime_secs)).max(0.0)
}

fn per_sec(count: u64, secs: f64) -> f64 {
    if secs > 0.0 { count as f64 / secs } else { 0.0 }
}

fn new_decisions(now: &Look, previous: &Look) -> Vec<DecidedGrasp> {
    let last = previous.status.decisions.latest.back().map(|decided| decided.decided_nanos);
    let latest = &now.status.decisions.latest;
    latest.iter().filter(|decided| last.is_none_or(|last| decided.decided_nanos > last)).cloned().collect()
}

fn load_average() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{made_looks, made_status};

    fn edge_of(status: &GraphStatus) -> EdgeStatus {
        status.edges[0].clone()
    }

    #[test]
    fn rates_and_ages_are_of_the_interval_and_counts_of_the_whole_run() {
        let (before, now) = made_looks();
        let found = measure(&now, Some(&before));
        assert!((found.interval_secs - 2.0).abs() < 1e-9, "{}", found.interval_secs);
        // 1998 received in 2 s; of the 1998 that came, 1980 were up to 0.2 ms old.
        assert!((found.edges[0].rate_hz - 999.0).abs() < 1e-6, "{}", found.edges[0].rate_hz);
        assert_eq!(found.edges[0].age_nanos, Some(Quantiles { p50: 204_800, p90: 204_800, p99: 204_800 }));
        assert_eq!((found.edges[0].missing, found.edges[0].late, found.edges[0].dropped), (13, 8, 10));
        assert_eq!(found.nodes[0].cpu_percent, Some(25.0));
        assert!((found.cpu_percent.expect("known") - 26.0).abs() < 1e-9);
        assert!((found.launcher_cpu_percent.expect("known") - 1.0).abs() < 1e-9);
        assert_eq!((found.decisions.n_hold, found.decisions.rate_hz), (41, 0.5));
        let new: Vec<u64> = found.decisions.new.iter().map(|decided| decided.grasp_id).collect();
        assert_eq!(new, [100]);
    }

    #[test]
    fn without_a_look_before_rates_and_ages_are_of_the_whole_run() {
        let (_, now) = made_looks();
        let whole = measure(&now, None);
        assert!((whole.edges[0].rate_hz - 2988.0 / 3727.4).abs() < 1e-9);
        // 2988 samples: the rank of p99, 2959, is beyond the 2880 that were younger.
        assert_eq!(whole.edges[0].age_nanos, Some(Quantiles { p50: 204_800, p90: 204_800, p99: 1_024_000 }));
        assert_eq!((whole.nodes[0].cpu_percent, whole.decisions.new.len()), (None, 0));
    }

    #[test]
    fn another_process_of_a_node_has_no_share_yet() {
        let (before, mut now) = made_looks();
        now.status.nodes[0].pid = Some(5000);
        now.usage.insert(5000, ProcessUsage { cpu_secs: 0.1, resident_bytes: 1 });
        let found = measure(&now, Some(&before));
        assert_eq!((found.nodes[0].cpu_percent, found.nodes[0].resident_bytes), (None, Some(1)));
        // No time between two looks is no division by zero.
        assert_eq!(measure(&now, Some(&now)).edges[0].rate_hz, 0.0);
    }

    #[test]
    fn what_waits_is_neither_received_nor_lost() {
        let (_, now) = made_looks();
        let mut edges = now.status.edges;
        edges[0] = EdgeStatus { policy: EdgePolicy::Lossless, sent: 100, received: 93, dropped: 0, ..edges[0].clone() };
        assert_eq!(n_queued(&edges[0], &edges), 7);
        // A reader that was given up: all that it did not answer is lost, nothing waits.
        edges[0].dropped = 7;
        assert_eq!(n_queued(&edges[0], &edges), 0);
        // `contacts` passes 5 gaps on; 20 of the 22 not received gave way.
        let input = EdgeStatus { to: "contacts/tactile".into(), missing: 5, ..edges[0].clone() };
        edges.push(input);
        edges[0] = EdgeStatus {
            policy: EdgePolicy::Latest,
            capacity: 4,
            sent: 100,
            received: 78,
            missing: 25,
            dropped: 0,
            ..edges[0].clone()
        };
        assert_eq!(n_queued(&edges[0], &edges), 2);
        edges[0].missing = 5;
        assert_eq!(n_queued(&edges[0], &edges), 4, "never more than can wait");
    }

    #[test]
    fn the_decisions_are_what_was_made_of_something_else() {
        let (_, now) = made_looks();
        let mut edges = now.status.edges;
        assert_eq!(decision_edge(&edges[..1]), None);
        let edge = |from: &str| EdgeStatus { from: from.into(), to: RUN.into(), ..edge_of(&made_status("a")) };
        edges.insert(0, edge("source/truth"));
        assert_eq!(decision_edge(&edges).expect("one").from, "classifier/prediction");
        edges.insert(0, edge("classifier/decision"));
        assert_eq!(decision_edge(&edges).expect("one").from, "classifier/decision");
    }

    #[test]
    fn a_line_of_json_has_what_a_script_asks_for() {
        let (before, now) = made_looks();
        let line = serde_json::to_value(measure(&now, Some(&before))).expect("JSON");
        assert_eq!(line["edges"][0]["age_nanos"]["p99"], 204_800);
        assert_eq!(line["nodes"][1]["state"], "failed");
        assert_eq!(line["decisions"]["new"][0]["action"], "hold");
        assert_eq!(line["decision_latency_nanos"]["p50"], 204_800);
    }
}
