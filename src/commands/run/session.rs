//! A graph from its start to its end, in this process: what `run` does, and whatever else runs a graph.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

use anyhow::Context;
use serde_json::json;

use super::super::{Outcome, check_output, stop_signal};
use super::log::RunLog;
use super::recorder::{RecordOptions, Recorder};
use super::summary::{Ran, Summary, table};
use blindgrasp_graph::control::DecisionStatus;
use blindgrasp_graph::dataflow::{Graph, Node};
use blindgrasp_graph::guest::describe_graph;
use blindgrasp_graph::launcher::{End, LaunchError, LaunchOptions, Launcher};
use blindgrasp_graph::metrics;
use blindgrasp_graph::observer::{ObservedEdge, Observer, can_observe};
use blindgrasp_graph::plan::{Plan, PlanOptions, Port, topic_of};
use blindgrasp_graph::recording_of_graph::Beginning;
use blindgrasp_learning::of_graph::{self};
use blindgrasp_messages::{GraspTruth, LiftDecision, LiftOutcome, Recorded};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::domain::Domain;
use blindgrasp_operator::wiring::Clock;
use blindgrasp_recording::Record;

/// What is told of every sample that a session sees: its topic and content, and when it was received (CLOCK_MONOTONIC).
pub(in crate::commands) type Tap = Box<dyn FnMut(&str, &Record, u64) -> anyhow::Result<()> + Send>;

/// How a graph is run.
pub(in crate::commands) struct Session {
    pub(in crate::commands) launch: LaunchOptions,
    pub(in crate::commands) clock: Clock,
    /// Every edge goes to this file.
    pub(in crate::commands) record: Option<PathBuf>,
    /// How it is recorded.
    pub(in crate::commands) record_options: RecordOptions,
    /// A port for Prometheus.
    pub(in crate::commands) metrics: Option<u16>,
    /// Decisions and summary as JSON.
    pub(in crate::commands) json: bool,
    /// No decisions and no summary on stdout; what is amiss still goes to stderr.
    pub(in crate::commands) is_quiet: bool,
    /// Sees every sample of every edge.
    pub(in crate::commands) tap: Option<Tap>,
}

/// A graph that has run.
pub(in crate::commands) struct Ended {
    pub(in crate::commands) summary: Summary,
    pub(in crate::commands) outcome: Outcome,
}

impl Session {
    /// Runs a checked graph to its end, or until SIGINT, SIGTERM or SIGHUP.
    ///
    /// # Errors
    /// The graph cannot start, or an operator failed; the summary has been printed then.
    pub(in crate::commands) fn run(self, graph: &Graph, name: &str) -> anyhow::Result<Ended> {
        let stop = stop_signal()?;

        if let Some(path) = &self.record {
            let params = graph.nodes.iter().flat_map(|node| node.params.values());
            let inputs: Vec<PathBuf> = params.filter_map(|param| Some(PathBuf::from(param.as_str()?))).collect();
            check_output(path, &inputs)?;
            self.record_options.check(path)?;
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
            Some(path) => {
                let about = of_graph::of_graph(&describe_graph(domain.name(), graph.nodes.iter()), Beginning::Start)?;
                Some(Recorder::create(path, &about.info, &self.record_options, about.joint_names, about.metadata)?)
            }
            None => None,
        };
        let plan_options =
            PlanOptions { wait_limit_millis: self.launch.wait_limit.as_millis() as u64, clock: self.clock };
        let plan = Plan::new(graph, domain.name(), domain.wiring(), &topics.keys().cloned().collect(), plan_options);
        let board = plan.create_board()?;
        // In the graph's order, not by name: the observer is to see a truth before the decision that it belongs to.
        let ports = graph.nodes.iter().flat_map(Node::output_ports).map(|(port, _)| port);
        let edges = ports
            .filter_map(|port| {
                let input = plan.observer_input(&port)?;
                let is_prompt = is_needed(&input.service.type_name);
                Some(ObservedEdge { topic: topics.get(&port)?.clone(), input, is_prompt })
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
        if !self.is_quiet {
            print_diagnostic(&format!(
                "graph '{}': {}",
                domain.name(),
                pids.iter().map(|(node, pid)| format!("{node} ({pid})")).collect::<Vec<_>>().join(" → ")
            ));
        }

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
        if let Some(recorded) = summary.recorded.as_ref().filter(|_| !summary.recorded_files.is_empty()) {
            let topics: Vec<_> = recorded.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
            let files: Vec<_> = summary.recorded_files.iter().map(|file| file.display().to_string()).collect();
            if !self.is_quiet {
                print_diagnostic(&format!("recorded to {}: {}", files.join(", "), topics.join(", ")));
            }
        }
        ended?;
        // A graph that was stopped may know the truth of a grasp that it didn't come to.
        // One that is replayed may have been cut out of a longer stream, with truths of grasps that it does not hold.
        let is_undecided = summary.undecided > 0 && summary.end == "finished" && self.clock == Clock::Machine;
        let is_recording_lossy = summary.recording_error.is_some() || summary.samples_not_recorded > 0;
        let is_graph_lossy = summary.samples_lost > 0 || summary.samples_dropped > 0 || summary.edges_unknown > 0;
        if is_graph_lossy || is_recording_lossy || is_undecided {
            return Ok(Ended { summary, outcome: Outcome::FinishedWithLoss });
        }
        Ok(Ended { summary, outcome: Outcome::Done })
    }
}

/// Which ports are read beside the operators, and under which topic: decisions and truth always, all for a recording.
pub(in crate::commands) fn observed_topics(graph: &Graph, record: bool) -> BTreeMap<Port, String> {
    let mut topics = BTreeMap::new();
    let all: Vec<Port> = graph.nodes.iter().flat_map(Node::output_ports).map(|(port, _)| port).collect();
    for (port, output) in graph.nodes.iter().flat_map(Node::output_ports) {
        if !(is_needed(&output.type_name) || record) {
            continue;
        }
        if !can_observe(&output.type_name) {
            print_diagnostic(&format!(
                "blindgrasp: {}/{} is not recorded: unknown type {}",
                port.0, port.1, output.type_name
            ));
            continue;
        }
        let topic = topic_of(&port, &all);
        topics.insert(port, topic);
    }
    topics
}

/// Whether a run reads edges of this type even if it is not recorded: what it prints is made of them.
pub(crate) fn is_needed(type_name: &str) -> bool {
    [LiftDecision::TYPE_NAME, GraspTruth::TYPE_NAME, LiftOutcome::TYPE_NAME].contains(&type_name)
}
