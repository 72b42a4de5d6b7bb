//! A graph from its start to its end, in this process: what `run` does, and whatever else runs a graph.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use anyhow::Context;
use serde_json::json;

use super::super::{Outcome, check_output};
use super::log::RunLog;
use super::summary::{Ran, Summary, table};
use crate::dataflow::Graph;
use crate::diagnostics::print_diagnostic;
use crate::hand::Hand;
use crate::message::{GraspTruth, LiftDecision, Recorded};
use crate::recording::{Record, RecordingInfo, RecordingWriter};
use crate::runtime::control::DecisionStatus;
use crate::runtime::domain::Domain;
use crate::runtime::launcher::{End, LaunchError, LaunchOptions, Launcher};
use crate::runtime::metrics;
use crate::runtime::observer::{ObservedEdge, Observer, can_observe};
use crate::runtime::plan::{Plan, PlanOptions, Port};
use crate::runtime::wiring::Clock;

/// What is told of every sample that a session sees: its topic and content, and when it was received (CLOCK_MONOTONIC).
pub(in crate::cli) type Tap = Box<dyn FnMut(&str, &Record, u64) -> anyhow::Result<()> + Send>;

/// How a graph is run.
pub(in crate::cli) struct Session {
    pub(in crate::cli) launch: LaunchOptions,
    pub(in crate::cli) clock: Clock,
    /// Every edge goes to this file.
    pub(in crate::cli) record: Option<PathBuf>,
    /// A port for Prometheus.
    pub(in crate::cli) metrics: Option<u16>,
    /// Decisions and summary as JSON.
    pub(in crate::cli) json: bool,
    /// No decisions and no summary on stdout; what is amiss still goes to stderr.
    pub(in crate::cli) is_quiet: bool,
    /// Sees every sample of every edge.
    pub(in crate::cli) tap: Option<Tap>,
}

/// A graph that has run.
pub(in crate::cli) struct Ended {
    pub(in crate::cli) summary: Summary,
    pub(in crate::cli) outcome: Outcome,
}

impl Session {
    /// Runs a checked graph to its end, or until SIGINT, SIGTERM or SIGHUP.
    ///
    /// # Errors
    /// The graph cannot start, or an operator failed; the summary has been printed then.
    pub(in crate::cli) fn run(self, graph: &Graph, name: &str) -> anyhow::Result<Ended> {
        let stop = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP] {
            signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
        }

        if let Some(path) = &self.record {
            let params = graph.nodes.iter().flat_map(|node| node.params.values());
            let inputs: Vec<PathBuf> = params.filter_map(|param| Some(PathBuf::from(param.as_str()?))).collect();
            check_output(path, &inputs)?;
        }

        let metrics = match self.metrics {
            Some(port) => {
                Some(metrics::listen(port).with_context(|| format!("cannot answer on port {port} (--metrics)"))?)
            }
            None => None,
        };

        let topics = observed_topics(graph, self.record.is_some() || self.tap.is_some());
        let domain = Domain::reserve(name)?;
        let recorder = match &self.record {
            Some(path) => Some(RecordingWriter::create(path, &recording_info(graph)?)?),
            None => None,
        };
        let plan_options =
            PlanOptions { wait_limit_millis: self.launch.wait_limit.as_millis() as u64, clock: self.clock };
        let plan = Plan::new(graph, domain.name(), domain.wiring(), &topics.keys().cloned().collect(), plan_options);
        let board = plan.create_board()?;
        // In the graph's order, not by name: the observer is to see a truth before the decision that it belongs to.
        let ports =
            graph.nodes.iter().flat_map(|node| node.outputs().iter().map(|port| (node.id.clone(), port.name.clone())));
        let edges = ports
            .filter_map(|port| {
                Some(ObservedEdge { topic: topics.get(&port)?.clone(), input: plan.observer_input(&port)? })
            })
            .collect();
        let decisions = Arc::new(Mutex::new(DecisionStatus::default()));
        let sink = RunLog::new(self.json, self.is_quiet, recorder, self.tap, Arc::clone(&decisions))?;
        let observer = Observer::start(domain.wiring(), edges, sink)?;
        let started = Launcher::start(graph, domain.name(), plan, board, domain.listener(), decisions, self.launch);
        let mut launcher = match started {
            Ok(launcher) => launcher,
            Err(error) => {
                observer.finish()?;
                return Err(error.into());
            }
        };
        let pids = launcher.pids();
        print_diagnostic(&format!(
            "graph '{}': {}",
            domain.name(),
            pids.iter().map(|(node, pid)| format!("{node} ({pid})")).collect::<Vec<_>>().join(" → ")
        ));

        if let Some(listener) = metrics {
            print_diagnostic(&format!("metrics: http://{}/metrics", listener.local_addr()?));
            metrics::serve(listener, domain.name().into());
        }

        let should_stop = || stop.load(Ordering::Relaxed) || observer.has_failed();
        // A second Ctrl-C, after the first has been taken notice of, ends the patience.
        let should_hurry = || stop.load(Ordering::Relaxed);
        let mut ended =
            launcher.wait_until_ready(&|| observer.is_connected(), &should_stop).and_then(|end| match end {
                Some(end) => Ok(end),
                None => launcher.wait_until_finished(&should_stop),
            });
        let keep_first = |ended: &mut Result<End, LaunchError>, next: Result<(), LaunchError>| {
            if let (Ok(_), Err(error)) = (&ended, next) {
                *ended = Err(error);
            }
        };
        stop.store(false, Ordering::Relaxed);
        // Operators that never became ready have nothing in flight.
        if !matches!(ended, Err(LaunchError::NotReady { .. })) {
            let drained = launcher.drain(&should_hurry);
            keep_first(&mut ended, drained);
        }
        let observed = observer.finish();
        let quit = launcher.quit(&should_hurry);
        keep_first(&mut ended, quit);

        let (log, received) = observed?;
        let ran = Ran { graph, status: launcher.status(), ended: &ended, pids: &pids, topics: &topics };
        drop(launcher);
        let (summary, mut printer) = log.finish(ran, &received)?;
        let lines = match self.json {
            _ if self.is_quiet => Vec::new(),
            true => vec![json!({ "summary": summary }).to_string()],
            false if ended.is_ok() || summary.grasps > 0 => table(&summary),
            false => Vec::new(),
        };
        lines.into_iter().for_each(|line| printer.print(line));
        printer.flush(&should_hurry);
        if printer.n_dropped() > 0 {
            print_diagnostic(&format!(
                "blindgrasp: {} lines were not printed: nobody read them in time",
                printer.n_dropped()
            ));
        }
        if let (Some(recorded), Some(path)) = (&summary.recorded, &self.record) {
            let topics: Vec<_> = recorded.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
            print_diagnostic(&format!("recorded to {}: {}", path.display(), topics.join(", ")));
        }
        ended?;
        // A graph that was stopped may know the truth of a grasp that it didn't come to.
        let is_undecided = summary.undecided > 0 && summary.end == "finished";
        if summary.samples_lost > 0 || summary.samples_dropped > 0 || summary.edges_unknown > 0 || is_undecided {
            return Ok(Ended { summary, outcome: Outcome::FinishedWithLoss });
        }
        Ok(Ended { summary, outcome: Outcome::Done })
    }
}

/// Which ports are read beside the operators, and under which topic: decisions and truth always, all for a recording.
pub(in crate::cli) fn observed_topics(graph: &Graph, record: bool) -> BTreeMap<Port, String> {
    let mut topics = BTreeMap::new();
    for node in &graph.nodes {
        for output in node.outputs() {
            let needed = [LiftDecision::TYPE_NAME, GraspTruth::TYPE_NAME].contains(&output.type_name.as_str());
            if !(needed || record) {
                continue;
            }
            if !can_observe(&output.type_name) {
                print_diagnostic(&format!(
                    "blindgrasp: {}/{} is not recorded: unknown type {}",
                    node.id, output.name, output.type_name
                ));
                continue;
            }
            let same_name = graph.nodes.iter().flat_map(|node| node.outputs()).filter(|port| port.name == output.name);
            let topic = if same_name.count() == 1 {
                format!("/{}", output.name)
            } else {
                format!("/{}/{}", node.id, output.name)
            };
            topics.insert((node.id.clone(), output.name.clone()), topic);
        }
    }
    topics
}

/// What a recording of this graph says of itself. The hand is the one that a node has as its parameter `hand`.
fn recording_info(graph: &Graph) -> anyhow::Result<RecordingInfo> {
    let hand = graph.nodes.iter().find_map(|node| node.params.get("hand")?.as_str());
    let (name, id) = match hand {
        Some(path) => {
            let hand = Hand::load(Path::new(path))?;
            (hand.name.clone(), hand.id())
        }
        None => ("unknown".into(), 0),
    };
    Ok(RecordingInfo {
        hand: name,
        hand_id: id,
        made_by: format!("graph {}", graph.name),
        version: env!("CARGO_PKG_VERSION").into(),
    })
}
