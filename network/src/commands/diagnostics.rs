//! `blindgrasp diagnostics`: the state of a graph as `diagnostic_msgs/msg/DiagnosticArray`, for ROS 2.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use blindgrasp_cli::ros2_network::Ros2Network;
use blindgrasp_graph::client::activity::{Look, Measured, MeasuredEdge, MeasuredNode, measure};
use blindgrasp_graph::client::poller::Poller;
use blindgrasp_graph::client::words::{node_state_word, state_word, warnings};
use blindgrasp_graph::client::{ClientError, pick_graph};
use blindgrasp_graph::control::{EdgeStatus, GraphState, NodeState, NodeStatus};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_recording::cdr;
use blindgrasp_ros::network::Network;
use blindgrasp_ros::standard;
use blindgrasp_ros_node::node::{self, Convention, MessageType, Quality, Rights, RosNode, RosPublisher};
use clap::Args;
use serde::Serialize;

use super::{Outcome, completions, secs_in};

/// Publish a graph's state to ROS 2, on /diagnostics
///
/// A status for the graph, each node and each edge, for rqt_robot_monitor and diagnostic_aggregator. A graph that has ended is
/// an error until it runs again. The command runs until it is interrupted.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp diagnostics grasp_gate --connect tcp/localhost:7447")]
pub(super) struct Arguments {
    /// Graph [default: the only one running]
    #[arg(add = completions::graphs())]
    graph: Option<String>,
    #[command(flatten)]
    network: Ros2Network,
    /// Publish every so many seconds
    #[arg(long, value_name = "TIME", default_value = "1", value_parser = |text: &str| secs_in(text, 0.1..=3600.0))]
    interval: f64,
}

const TYPE: &str = "diagnostic_msgs/msg/DiagnosticArray";
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;
/// Counts of nodes that tell of samples from outside that were not used, or not sent.
const REFUSALS: [&str; 9] = [
    "malformed",
    "oversized",
    "cut_off",
    "late",
    "out_of_order",
    "disbelieved",
    "refused_clients",
    "unzeroed",
    "unpublished",
];

/// `diagnostic_msgs/msg/DiagnosticStatus`.
#[derive(Debug, Serialize)]
struct Status {
    level: u8,
    name: String,
    message: String,
    hardware_id: &'static str,
    values: Vec<(&'static str, String)>,
}

/// The node of ROS and its publisher.
type Publishing = (RosNode, RosPublisher);

fn open(network: &Network, rights: &Rights, domain: u32, message: &MessageType) -> anyhow::Result<Publishing> {
    let session = node::open(network, rights)?;
    let mut node = RosNode::new(session, Convention::RmwZenoh, domain, "/", "blindgrasp_diagnostics")?;
    let publisher = node.publisher("/diagnostics", message, Quality::KeepLast(1))?;
    Ok((node, publisher))
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graph = match arguments.graph.as_deref() {
        // It need not run yet.
        Some(graph) => graph.to_owned(),
        None => pick_graph(None)?,
    };
    let (network, domain) = arguments.network.network()?;
    let definition = standard::definition(TYPE).context("no definition of the diagnostics")?;
    let message = MessageType { name: TYPE.into(), hash: definition.hash() };
    let rights = Rights { sends: vec![Convention::RmwZenoh.key(domain, "/diagnostics")], ..Rights::default() };
    let (mut publishing, mut said) = (None, String::new());
    let mut watched = Watched { graph, connection: None };
    let (interval, mut due) = (Duration::from_secs_f64(arguments.interval), Instant::now());
    loop {
        if publishing.is_none() {
            match open(&network, &rights, domain, &message) {
                Ok(opened) => {
                    print_diagnostic(&format!("publishes the state of graph '{}' on /diagnostics", watched.graph));
                    publishing = Some(opened);
                }
                Err(error) if said != error.to_string() => {
                    said = error.to_string();
                    print_diagnostic(&format!("{said}; trying again"));
                }
                Err(_) => {}
            }
        }
        let statuses = watched.look();
        if let Some((_, publisher)) = &mut publishing {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            let stamp = (i32::try_from(now.as_secs()).unwrap_or(i32::MAX), now.subsec_nanos());
            let mut data = Vec::new();
            cdr::encode(&((stamp, ""), statuses), &mut data).map_err(anyhow::Error::msg)?;
            publisher.publish(&data)?;
        }
        due = (due + interval).max(Instant::now());
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

/// A graph that may end and run again.
struct Watched {
    graph: String,
    connection: Option<(Poller, Look)>,
}

impl Watched {
    /// The statuses now; the graph's comes first.
    fn look(&mut self) -> Vec<Status> {
        self.looked().unwrap_or_else(|error| {
            self.connection = None;
            vec![status(ERROR, &self.graph, "graph", format!("{:#}", anyhow::Error::from(error)), vec![])]
        })
    }

    fn looked(&mut self) -> Result<Vec<Status>, ClientError> {
        let (poller, now, before) = match self.connection.take() {
            Some((mut poller, before)) => {
                let now = poller.look()?;
                (poller, now, Some(before))
            }
            None => {
                let (poller, now) = Poller::connect(&self.graph)?;
                (poller, now, None)
            }
        };
        let statuses = statuses(&now, before.as_ref());
        self.connection = Some((poller, now));
        Ok(statuses)
    }
}

fn status(level: u8, graph: &str, part: &str, message: String, values: Vec<(&'static str, String)>) -> Status {
    Status { level, name: format!("blindgrasp/{graph}: {part}"), message, hardware_id: "blindgrasp", values }
}

/// Counts are those since the start of the graph. Rates, and losses that are a warning, are those since the look before.
fn statuses(now: &Look, before: Option<&Look>) -> Vec<Status> {
    let measured = measure(now, before);
    let graph = &measured.graph;
    let mut all = vec![of_graph(now, &measured)];
    all.extend(measured.nodes.iter().map(|node| {
        let before = before.and_then(|look| look.status.nodes.iter().find(|other| other.node == node.node));
        of_node(graph, node, before)
    }));
    all.extend(measured.edges.iter().map(|edge| {
        let mut edges = before.iter().flat_map(|look| &look.status.edges);
        of_edge(graph, edge, edges.find(|other| other.from == edge.from && other.to == edge.to))
    }));
    all
}

fn of_graph(now: &Look, measured: &Measured) -> Status {
    let warnings = warnings(&now.status);
    let level = match measured.state {
        GraphState::Degraded => ERROR,
        GraphState::Running if warnings.is_empty() => OK,
        _ => WARN,
    };
    let message = if warnings.is_empty() { state_word(measured.state).to_lowercase() } else { warnings.join("; ") };
    let decisions = &measured.decisions;
    let mut values = vec![
        ("uptime_secs", format!("{:.1}", measured.uptime_secs)),
        ("n_lift", decisions.n_lift.to_string()),
        ("n_hold", decisions.n_hold.to_string()),
        ("n_false_positives", decisions.n_false_positives.to_string()),
    ];
    if let Some(latency) = measured.decision_latency_nanos {
        values.push(("decision_latency_p50_nanos", latency.p50.to_string()));
        values.push(("decision_latency_p99_nanos", latency.p99.to_string()));
    }
    if let Some(last) = now.status.decisions.latest.back() {
        values.push(("last_grasp_id", last.grasp_id.to_string()));
        values.push(("last_action", last.action.as_str().into()));
        values.push(("last_reason", last.reason.as_str().into()));
    }
    status(level, &measured.graph, "graph", message, values)
}

/// What a node refused since the look before is a warning.
fn of_node(graph: &str, node: &MeasuredNode, before: Option<&NodeStatus>) -> Status {
    let refused = REFUSALS.iter().filter_map(|name| {
        let now = node.counts.get(*name)?;
        let n = now.saturating_sub(*before?.counts.get(*name).unwrap_or(&0));
        (n > 0).then(|| format!("{n} {name}"))
    });
    let refused: Vec<String> = refused.collect();
    let level = match node.state {
        NodeState::Failed => ERROR,
        NodeState::Running | NodeState::Done if refused.is_empty() => OK,
        _ => WARN,
    };
    let state = node_state_word(node.state).to_lowercase();
    let message = if refused.is_empty() { state } else { format!("{state}; {}", refused.join(", ")) };
    let mut values = vec![("restarts", node.n_restarts.to_string()), ("swaps", node.n_swaps.to_string())];
    let counts: Vec<String> = node.counts.iter().map(|(name, count)| format!("{name} {count}")).collect();
    let known = [
        ("pid", node.pid.map(|pid| pid.to_string())),
        ("cpu_percent", node.cpu_percent.map(|percent| format!("{percent:.1}"))),
        ("resident_bytes", node.resident_bytes.map(|bytes| bytes.to_string())),
        ("heartbeat_age_millis", node.heartbeat_age_millis.map(|millis| millis.to_string())),
        ("counts", if counts.is_empty() { None } else { Some(counts.join(", ")) }),
    ];
    values.extend(known.into_iter().filter_map(|(name, value)| Some((name, value?))));
    status(level, graph, &node.node, message, values)
}

/// Samples that came late or that a lossless edge lost since the look before are a warning.
fn of_edge(graph: &str, edge: &MeasuredEdge, before: Option<&EdgeStatus>) -> Status {
    let (mut lost, mut late) = (0, 0);
    if let Some(before) = before {
        late = edge.late.saturating_sub(before.late);
        if edge.policy == EdgePolicy::Lossless {
            lost = edge.dropped.saturating_sub(before.dropped);
        }
    }
    let troubles = [("lost", lost), ("late", late)];
    let words: Vec<String> =
        troubles.iter().filter(|(_, n)| *n > 0).map(|(word, n)| format!("{n} samples {word}")).collect();
    let level = if words.is_empty() { OK } else { WARN };
    let message = if words.is_empty() { format!("{:.1} Hz", edge.rate_hz) } else { words.join(", ") };
    let mut values = vec![
        ("rate_hz", format!("{:.1}", edge.rate_hz)),
        ("received", edge.received.to_string()),
        ("queued", edge.n_queued.to_string()),
        ("dropped", edge.dropped.to_string()),
        ("missing", edge.missing.to_string()),
        ("late", edge.late.to_string()),
        ("repeated", edge.repeated.to_string()),
    ];
    if let Some(age) = edge.age_nanos {
        values.push(("age_p50_nanos", age.p50.to_string()));
        values.push(("age_p99_nanos", age.p99.to_string()));
    }
    status(level, graph, &format!("{} -> {}", edge.from, edge.to), message, values)
}
