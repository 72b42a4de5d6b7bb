//! Runs a graph from its start to its end in this process, without the command line.
//!
//! A [`Run`] reserves the graph's name, starts the operators, reads their edges, and sums up. The caller gives a
//! [`RunSink`], which may print, record or collect; nothing is written to stdout here.

mod log;
mod summary;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use serde_json::Value;

pub use self::summary::{Latency, OperatorPid, RunSummary};

use self::log::RunLog;
use self::summary::Ran;
use crate::client::metrics;
use crate::client::observer::{ObservedEdge, Observer, can_observe};
use crate::control::DecisionStatus;
use crate::dataflow::{Graph, Node};
use crate::launcher::{End, LaunchError, LaunchOptions, Launcher};
use crate::plan::{Plan, PlanOptions, Port, is_needed, topic_of};
use crate::recorded_graph::describe_graph;
use blindgrasp_messages::Record;
use blindgrasp_messages::{GraspTruth, Header, LiftDecision, LiftOutcome};
use blindgrasp_operator::cursors::RUN_BELL;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::namespace::Namespace;
use blindgrasp_operator::wiring::Clock;

/// How a graph is run.
#[derive(Debug, Default)]
pub struct RunOptions {
    pub launch: LaunchOptions,
    pub clock: Clock,
    /// The sink gets the samples of all edges, and not only decisions, truths and outcomes.
    pub reads_all: bool,
    /// Prometheus is answered here while the graph runs.
    pub metrics: Option<TcpListener>,
    /// The processes that were started are not named on stderr.
    pub is_quiet: bool,
}

/// Receives what a run reads from its graph, on the thread that reads.
pub trait RunSink: Send + 'static {
    /// A sample of an edge, and the time of its receipt (CLOCK_BOOTTIME).
    ///
    /// # Errors
    /// An error ends the run.
    fn sample(&mut self, _topic: &str, _record: Record, _received_nanos: u64) -> anyhow::Result<()> {
        Ok(())
    }

    /// A decision, once for each grasp; also the probes before it, and what the arm should do while it lifts.
    ///
    /// # Errors
    /// An error ends the run.
    fn decision(&mut self, _decision: &SeenDecision<'_>) -> anyhow::Result<()> {
        Ok(())
    }

    /// The outcome of a grasp, after its decision.
    ///
    /// # Errors
    /// An error ends the run.
    fn outcome(&mut self, _outcome: &LiftOutcome) -> anyhow::Result<()> {
        Ok(())
    }
}

/// A decision as a run has seen it.
#[derive(Debug, Clone, Copy)]
pub struct SeenDecision<'a> {
    pub header: &'a Header,
    pub decision: &'a LiftDecision,
    /// The time from the source to the run; `None` if the source does not say when it published.
    pub latency_nanos: Option<u64>,
    /// The truth, if it came before the decision.
    pub truth: Option<&'a GraspTruth>,
}

/// A graph whose name is reserved and which has not started.
pub struct Run<'a> {
    graph: &'a Graph,
    options: RunOptions,
    namespace: Namespace,
    topics: BTreeMap<Port, String>,
}

/// A graph that has run.
pub struct Ended<S> {
    pub summary: RunSummary,
    pub sink: S,
    pub outcome: Result<End, LaunchError>,
}

impl<'a> Run<'a> {
    /// Reserves the name of a checked graph.
    ///
    /// # Errors
    /// Another graph holds the name, or shared memory cannot be used.
    pub fn prepare(graph: &'a Graph, name: &str, options: RunOptions) -> anyhow::Result<Run<'a>> {
        let topics = observed_topics(graph, options.reads_all);
        Ok(Run { graph, options, namespace: Namespace::reserve(name)?, topics })
    }

    /// The graph with its programs, parameters and edges, for the metadata of a recording.
    pub fn description(&self) -> Value {
        describe_graph(self.namespace.name(), self.graph.nodes.iter())
    }

    /// Runs the graph to its end, or until `n_stops` is no longer 0. The caller counts requests to stop there; one that
    /// comes while the graph is stopping ends the patience with its operators.
    ///
    /// # Errors
    /// The graph's shared memory cannot be used, or its edges cannot be read. An operator's failure is in
    /// [`Ended::outcome`].
    pub fn run<S: RunSink>(self, sink: S, n_stops: &AtomicUsize) -> anyhow::Result<Ended<S>> {
        let Run { graph, options, namespace, topics } = self;
        let RunOptions { launch, clock, metrics, is_quiet, .. } = options;
        let plan_options = PlanOptions { wait_limit_millis: launch.wait_limit.as_millis() as u64, clock };
        let plan =
            Plan::new(graph, namespace.name(), namespace.wiring(), &topics.keys().cloned().collect(), plan_options);
        let cursors = plan.create_cursors()?;
        let decisions = Arc::new(Mutex::new(DecisionStatus::default()));
        let log = RunLog::new(sink, Arc::clone(&decisions))?;
        let observer = Observer::start(namespace.wiring(), RUN_BELL, observed_edges(graph, &plan, &topics), log)?;
        let started = Launcher::start(graph, namespace.name(), plan, cursors, namespace.listener(), decisions, launch);
        let mut launcher = match started {
            Ok(launcher) => launcher,
            Err(error) => {
                observer.finish()?;
                return Err(error.into());
            }
        };
        let pids = launcher.pids();
        if !is_quiet {
            let processes: Vec<String> = pids.iter().map(|(node, pid)| format!("{node} ({pid})")).collect();
            print_diagnostic(&format!("graph '{}': {}", namespace.name(), processes.join(" → ")));
        }
        if let Some(listener) = metrics {
            print_diagnostic(&format!("metrics: http://{}/metrics", listener.local_addr()?));
            metrics::serve(listener, namespace.name().into());
        }

        let mut outcome = drive(&mut launcher, &observer, n_stops);
        let n_seen = n_stops.load(Ordering::Relaxed);
        let should_hurry = || n_stops.load(Ordering::Relaxed) > n_seen;
        // Operators that never became ready have nothing in flight.
        if !matches!(outcome, Err(LaunchError::NotReady { .. })) {
            let drained = launcher.drain(&should_hurry);
            outcome = outcome.and_then(|end| drained.map(|()| end));
        }
        let observed = observer.finish();
        let quit = launcher.quit(&should_hurry);
        outcome = outcome.and_then(|end| quit.map(|()| launcher.final_end(end)));
        let (log, received) = observed?;
        let ran = Ran { graph, status: launcher.status(), outcome: &outcome, pids: &pids, topics: &topics };
        drop(launcher);
        let (summary, sink) = log.finish(&ran, &received)?;
        Ok(Ended { summary, sink, outcome })
    }
}

/// Waits until the graph has started, and then until it has ended.
fn drive<S: RunSink>(
    launcher: &mut Launcher,
    observer: &Observer<RunLog<S>>,
    n_stops: &AtomicUsize,
) -> Result<End, LaunchError> {
    let should_stop = || n_stops.load(Ordering::Relaxed) > 0 || observer.has_failed();
    match launcher.wait_until_ready(&|| observer.is_connected(), &should_stop)? {
        Some(end) => Ok(end),
        None => launcher.wait_until_finished(&should_stop),
    }
}

/// The edges in the graph's order, not by name: the observer must see a truth before the decision that it belongs to.
fn observed_edges(graph: &Graph, plan: &Plan, topics: &BTreeMap<Port, String>) -> Vec<ObservedEdge> {
    let ports = graph.nodes.iter().flat_map(Node::output_ports).map(|(port, _)| port);
    let edges = ports.filter_map(|port| {
        let input = plan.observer_input(&port)?;
        let is_prompt = is_needed(&input.service.type_name);
        Some(ObservedEdge { topic: topics.get(&port)?.clone(), input, is_prompt })
    });
    edges.collect()
}

/// The topics of the ports that a run reads: of decisions, truths and outcomes, or of all that can be read.
pub fn observed_topics(graph: &Graph, reads_all: bool) -> BTreeMap<Port, String> {
    let mut topics = BTreeMap::new();
    let all: Vec<Port> = graph.nodes.iter().flat_map(Node::output_ports).map(|(port, _)| port).collect();
    for (port, output) in graph.nodes.iter().flat_map(Node::output_ports) {
        // A second source that plays a recording beside the hand has truths of its own.
        let is_needed = is_needed(&output.type_name) && !is_partner_alone(graph, &port.0);
        if !(is_needed || reads_all) {
            continue;
        }
        if !can_observe(&output.type_name) {
            let (node, name) = &port;
            print_diagnostic(&format!(
                "blindgrasp: {node}/{name} is not recorded: its type {} is unknown",
                output.type_name
            ));
            continue;
        }
        let topic = topic_of(&port, &all);
        topics.insert(port, topic);
    }
    topics
}

/// Whether a node's samples go to partner inputs only.
fn is_partner_alone(graph: &Graph, node: &str) -> bool {
    let mut inputs =
        graph.nodes.iter().flat_map(|reader| &reader.inputs).filter(|input| input.from_node == node).peekable();
    inputs.peek().is_some() && inputs.all(|input| input.partner)
}
