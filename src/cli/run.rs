//! `blindgrasp run`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use hdrhistogram::Histogram;
use serde::Serialize;
use serde_json::json;

use super::{Outcome, background, check_output, number_in, percent};
use crate::dataflow::{self, EdgePolicy, Graph, Override};
use crate::diagnostics::{LinePrinter, print_diagnostic};
use crate::evaluation::{Evaluation, Score};
use crate::hand::Hand;
use crate::message::{Action, GraspTruth, Header, LiftDecision, Recorded, Stamped};
use crate::recording::{Record, RecordingInfo, RecordingWriter};
use crate::runtime::control::{DecidedGrasp, DecisionStatus, EdgeStatus, GraphStatus};
use crate::runtime::describe::{describe, shipped};
use crate::runtime::domain::Domain;
use crate::runtime::launcher::{End, LaunchError, LaunchOptions, Launcher};
use crate::runtime::log::LogFormat;
use crate::runtime::metrics;
use crate::runtime::observer::{ObservedEdge, Observer, Sink, can_observe};
use crate::runtime::plan::{Plan, Port};
use crate::runtime::wiring::InputCounts;

/// Run a dataflow file: launch its operators, print each decision, and sum up at the end.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: blindgrasp run dataflow.yaml --record /tmp/run.mcap\n\nCtrl-C stops the graph cleanly."
)]
pub(super) struct Arguments {
    /// The dataflow file.
    #[arg(default_value = "dataflow.yaml")]
    dataflow: PathBuf,
    /// Name of the running graph; default: the file's.
    #[arg(long)]
    name: Option<String>,
    /// Give a param another value than the file does; a path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "NODE.PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Record every edge to this file (MCAP).
    #[arg(long)]
    record: Option<PathBuf>,
    /// How long the operators may take until all are ready, in seconds; a restarted one as well.
    #[arg(long, value_name = "SECS", default_value = "20", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    startup_limit: f64,
    /// How long the operators may take to answer what is left when the graph stops, and then to exit, in seconds, before
    /// they are killed.
    #[arg(long, value_name = "SECS", default_value = "10", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    grace: f64,
    /// How long a writer waits for a reader on a lossless edge before it fails, in seconds: longer than the slowest operator
    /// takes to come back.
    #[arg(long, value_name = "SECS", default_value = "5", value_parser = |text: &str| number_in(text, 0.1..=3600.0))]
    wait_limit: f64,
    /// Answer Prometheus on this port of the loopback interface (0: any that is free): http://127.0.0.1:PORT/metrics
    #[arg(long, value_name = "PORT")]
    metrics: Option<u16>,
    /// How the log files are written: for people, or a JSON object a line, for programs.
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    log_format: LogFormatArgument,
    /// Print JSON: one line per decision, and a last one with "summary".
    #[arg(long)]
    json: bool,
    /// Return as soon as the graph runs, and let it run in the background: see ps, logs, swap and stop.
    #[arg(long)]
    detach: bool,
    /// What --detach starts.
    #[arg(long, hide = true)]
    in_background: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LogFormatArgument {
    Text,
    Json,
}

impl From<LogFormatArgument> for LogFormat {
    fn from(argument: LogFormatArgument) -> Self {
        match argument {
            LogFormatArgument::Text => LogFormat::Text,
            LogFormatArgument::Json => LogFormat::Json,
        }
    }
}

/// How many decisions wait for the truth of their grasp.
const MAX_AWAITING_TRUTH: usize = 1024;
/// How many decisions are told to whoever asks the graph.
const N_SHOWN: usize = 32;
/// How many lines wait for whoever reads stdout.
const MAX_UNREAD_LINES: usize = 1 << 16;
/// How many truths wait for the decision of their grasp.
const MAX_AWAITING_DECISION: usize = 4096;
/// Longer latencies count as this long: an hour.
const LONGEST_LATENCY_NANOS: u64 = 3_600_000_000_000;

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let file = dataflow::load(&arguments.dataflow)?;
    let graph = dataflow::check(&file, &shipped()?, &arguments.overrides, describe)?;
    let name = arguments.name.as_deref().unwrap_or(&graph.name);
    if !dataflow::is_name(name) {
        bail!("--name '{name}': expected letters, digits, _ and -, at most 32");
    }
    if arguments.detach {
        return background::detach(name, arguments.json);
    }
    if arguments.in_background {
        return background::into_log(name, arguments.log_format.into(), || run_graph(arguments, &graph, name));
    }
    run_graph(arguments, &graph, name)
}

fn run_graph(arguments: &Arguments, graph: &Graph, name: &str) -> anyhow::Result<Outcome> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot listen for signals")?;
    }

    if let Some(path) = &arguments.record {
        let params = graph.nodes.iter().flat_map(|node| node.params.values());
        let inputs: Vec<PathBuf> = params.filter_map(|param| Some(PathBuf::from(param.as_str()?))).collect();
        check_output(path, &inputs)?;
    }

    let metrics = match arguments.metrics {
        Some(port) => Some(metrics::listen(port).with_context(|| format!("cannot answer on port {port} (--metrics)"))?),
        None => None,
    };

    let topics = observed_topics(graph, arguments.record.is_some());
    let domain = Domain::reserve(name)?;
    let recorder = match &arguments.record {
        Some(path) => Some(RecordingWriter::create(path, &recording_info(graph)?)?),
        None => None,
    };
    let options = LaunchOptions {
        startup_limit: Duration::from_secs_f64(arguments.startup_limit),
        grace: Duration::from_secs_f64(arguments.grace),
        wait_limit: Duration::from_secs_f64(arguments.wait_limit),
        is_on_terminal: !arguments.in_background,
        log_format: arguments.log_format.into(),
    };
    let wait_limit_millis = options.wait_limit.as_millis() as u64;
    let plan = Plan::new(graph, domain.name(), domain.wiring(), &topics.keys().cloned().collect(), wait_limit_millis);
    let board = plan.create_board()?;
    // In the graph's order, not by name: the observer is to see a truth before the decision that it belongs to.
    let ports =
        graph.nodes.iter().flat_map(|node| node.outputs().iter().map(|port| (node.id.clone(), port.name.clone())));
    let edges = ports
        .filter_map(|port| Some(ObservedEdge { topic: topics.get(&port)?.clone(), input: plan.observer_input(&port)? }))
        .collect();
    let decisions = Arc::new(Mutex::new(DecisionStatus::default()));
    let sink = RunLog::new(arguments.json, recorder, Arc::clone(&decisions))?;
    let observer = Observer::start(domain.wiring(), edges, sink)?;
    let started = Launcher::start(graph, domain.name(), plan, board, domain.listener(), decisions, options);
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
    let mut ended = launcher.wait_until_ready(&|| observer.is_connected(), &should_stop).and_then(|end| match end {
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
    let lines = match arguments.json {
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
    if let (Some(recorded), Some(path)) = (&summary.recorded, &arguments.record) {
        let topics: Vec<_> = recorded.iter().map(|(topic, n)| format!("{topic} {n}")).collect();
        print_diagnostic(&format!("recorded to {}: {}", path.display(), topics.join(", ")));
    }
    ended?;
    // A graph that was stopped may know the truth of a grasp that it didn't come to.
    let is_undecided = summary.undecided > 0 && summary.end == "finished";
    if summary.samples_lost > 0 || summary.samples_dropped > 0 || summary.edges_unknown > 0 || is_undecided {
        return Ok(Outcome::FinishedWithLoss);
    }
    Ok(Outcome::Done)
}

/// Which ports are read beside the operators, and under which topic: decisions and truth always, all for a recording.
fn observed_topics(graph: &Graph, record: bool) -> BTreeMap<Port, String> {
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

/// What the run saw: prints decisions as they come, records, and keeps what the summary needs, which does not grow with
/// time.
struct RunLog {
    json: bool,
    /// To stdout, whether somebody reads it or not: decisions go on being made and recorded.
    printer: LinePrinter,
    recorder: Option<RecordingWriter>,
    /// What others are told of the decisions.
    seen: Arc<Mutex<DecisionStatus>>,
    evaluation: Evaluation,
    n_lift: usize,
    n_decisions: usize,
    n_undecided: usize,
    /// Truths whose decision has not come.
    truths: BTreeMap<u64, GraspTruth>,
    /// Decisions whose truth has not come.
    decisions: BTreeMap<u64, LiftDecision>,
    latencies_nanos: Histogram<u64>,
}

/// A graph that has run.
struct Ran<'a> {
    graph: &'a Graph,
    status: GraphStatus,
    ended: &'a Result<End, LaunchError>,
    pids: &'a [(String, u32)],
    topics: &'a BTreeMap<Port, String>,
}

#[derive(Serialize)]
struct DecisionLine<'a> {
    grasp_id: u64,
    action: Action,
    reason: &'a str,
    probability_stable: f64,
    latency_nanos: Option<u64>,
    seq: u64,
    stamp_nanos: u64,
    truth: Option<&'a GraspTruth>,
}

#[derive(Serialize)]
struct Summary {
    graph: String,
    end: &'static str,
    grasps: usize,
    lift: usize,
    hold: usize,
    with_truth: usize,
    accuracy: Option<f64>,
    majority_class: Option<f64>,
    false_positives: usize,
    false_positive_share: Option<f64>,
    /// The same over the grasps that were decided by what the classifier said.
    judged: Score,
    /// Grasps whose truth came but no decision.
    undecided: usize,
    reasons: BTreeMap<String, usize>,
    latency_nanos: Option<Latency>,
    /// On lossless edges, and skipped by stages.
    samples_lost: u64,
    /// On `latest` edges, for newer ones.
    samples_dropped: u64,
    /// Edges whose writer does not count what it sends: what was lost there, nobody knows.
    edges_unknown: usize,
    /// How often operators were started again after a failure.
    restarts: u32,
    /// How often operators were swapped.
    swaps: u32,
    /// What nodes count besides their samples, like the frames that a source refused; nodes that count nothing are not there.
    counts: BTreeMap<String, BTreeMap<String, u64>>,
    edges: Vec<EdgeStatus>,
    operators: Vec<OperatorPid>,
    recorded: Option<BTreeMap<String, u64>>,
}

#[derive(Serialize)]
struct Latency {
    p50: u64,
    p90: u64,
    p99: u64,
    max: u64,
}

#[derive(Serialize)]
struct OperatorPid {
    node: String,
    pid: u32,
}

impl Sink for RunLog {
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        if let Some(recorder) = &mut self.recorder {
            recorder.write_record(topic, &record)?;
        }
        match record {
            Record::Truth(truth) => self.on_truth(truth.message),
            Record::Decision(decision) => self.on_decision(decision, received_nanos)?,
            _ => {}
        }
        Ok(())
    }
}

impl RunLog {
    fn new(json: bool, recorder: Option<RecordingWriter>, seen: Arc<Mutex<DecisionStatus>>) -> anyhow::Result<Self> {
        Ok(RunLog {
            json,
            printer: LinePrinter::new(std::io::stdout(), MAX_UNREAD_LINES),
            recorder,
            seen,
            evaluation: Evaluation::default(),
            n_lift: 0,
            n_decisions: 0,
            n_undecided: 0,
            truths: BTreeMap::new(),
            decisions: BTreeMap::new(),
            // Three digits, which takes some tens of kilobytes however long the run is.
            latencies_nanos: Histogram::new_with_max(LONGEST_LATENCY_NANOS, 3)?,
        })
    }

    /// Tells it to whoever asks the graph.
    fn show(&self, decided: DecidedGrasp) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match decided.action {
            Action::Lift => seen.n_lift += 1,
            Action::Hold => seen.n_hold += 1,
        }
        seen.n_false_positives += u64::from(decided.is_false_positive());
        seen.latest.push_back(decided);
        if seen.latest.len() > N_SHOWN {
            seen.latest.pop_front();
        }
    }

    /// As [`RunLog::show`], for a truth that came after its decision.
    fn show_truth(&self, truth: &GraspTruth) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let decided = seen.latest.iter_mut().rfind(|decided| decided.grasp_id == truth.grasp_id);
        let is_false_positive = decided.is_some_and(|decided| {
            decided.truth = Some(truth.stable);
            decided.is_false_positive()
        });
        seen.n_false_positives += u64::from(is_false_positive);
    }

    fn on_truth(&mut self, truth: GraspTruth) {
        match self.decisions.remove(&truth.grasp_id) {
            Some(decision) => {
                self.show_truth(&truth);
                self.evaluation.add(&decision, Some(&truth));
            }
            None => drop(self.truths.insert(truth.grasp_id, truth)),
        }
        // A decision comes soon after its truth: older ones will never have one.
        while self.truths.len() > MAX_AWAITING_DECISION && self.truths.pop_first().is_some() {
            self.n_undecided += 1;
        }
    }

    fn on_decision(&mut self, decision: Stamped<LiftDecision>, received_nanos: u64) -> serde_json::Result<()> {
        let Stamped { header: Header { seq, stamp_nanos, origin_nanos, .. }, message } = decision;
        let latency_nanos = (origin_nanos != 0).then(|| received_nanos.saturating_sub(origin_nanos));
        if let Some(nanos) = latency_nanos {
            self.latencies_nanos.saturating_record(nanos);
        }
        let truth = self.truths.remove(&message.grasp_id);
        self.show(DecidedGrasp {
            grasp_id: message.grasp_id,
            action: message.action,
            reason: message.reason,
            probability_stable: message.probability_stable,
            latency_nanos,
            decided_nanos: received_nanos,
            truth: truth.as_ref().map(|truth| truth.stable),
        });
        let line = DecisionLine {
            grasp_id: message.grasp_id,
            action: message.action,
            reason: message.reason.word(),
            probability_stable: message.probability_stable,
            latency_nanos,
            seq,
            stamp_nanos,
            truth: truth.as_ref(),
        };
        let line = if self.json {
            serde_json::to_string(&line)?
        } else {
            let action = if line.action == Action::Lift { "LIFT" } else { "HOLD" };
            let latency = latency_nanos.map_or("-".into(), |nanos| format!("{:.0} µs", nanos as f64 / 1e3));
            let truth = truth.as_ref().map_or(String::new(), |truth| {
                format!("  truth: {} ({})", if truth.stable { "stable" } else { "unstable" }, truth.object)
            });
            format!(
                "grasp {:>5}  {action}  p {:.3}  {:<14} {latency:>9}{truth}",
                line.grasp_id, line.probability_stable, line.reason
            )
        };
        self.printer.print(line);
        self.n_decisions += 1;
        self.n_lift += usize::from(message.action == Action::Lift);
        match truth {
            Some(truth) => self.evaluation.add(&message, Some(&truth)),
            None => {
                self.decisions.insert(message.grasp_id, message);
                // A truth comes before its decision or right after it: older ones never had one.
                while self.decisions.len() > MAX_AWAITING_TRUTH
                    && let Some((_, decision)) = self.decisions.pop_first()
                {
                    self.evaluation.add(&decision, None);
                }
            }
        }
        Ok(())
    }

    fn finish(
        mut self,
        ran: Ran<'_>,
        observed: &BTreeMap<String, InputCounts>,
    ) -> anyhow::Result<(Summary, LinePrinter)> {
        for decision in self.decisions.values() {
            self.evaluation.add(decision, None);
        }
        let evaluation = self.evaluation;
        let score = &evaluation.score;
        let recorded = self.recorder.map(RecordingWriter::finish).transpose()?;
        let edges = edges(&ran, observed);
        let dropped = |policy: EdgePolicy| {
            edges.iter().filter(|edge| edge.policy == policy).map(|edge| edge.dropped).sum::<u64>()
        };
        let counts = ran.status.nodes.iter().filter(|node| !node.counts.is_empty());
        let summary = Summary {
            graph: ran.status.graph.clone(),
            end: match ran.ended {
                Ok(End::Finished) => "finished",
                Ok(End::Stopped) => "stopped",
                Err(LaunchError::Degraded(_)) => "degraded",
                Err(_) => "failed",
            },
            grasps: self.n_decisions,
            lift: self.n_lift,
            hold: self.n_decisions - self.n_lift,
            with_truth: score.n_grasps,
            accuracy: score.accuracy,
            majority_class: score.majority_class,
            false_positives: score.n_false_positive,
            false_positive_share: score.false_positive_share,
            judged: evaluation.score_judged.clone(),
            undecided: self.n_undecided + self.truths.len(),
            reasons: evaluation.by_reason.clone(),
            latency_nanos: latency(&self.latencies_nanos),
            samples_lost: dropped(EdgePolicy::Lossless) + skipped_by_stages(ran.graph, &edges),
            samples_dropped: dropped(EdgePolicy::Latest),
            edges_unknown: edges.iter().filter(|edge| edge.received > edge.sent).count(),
            restarts: ran.status.nodes.iter().map(|node| node.n_restarts).sum(),
            swaps: ran.status.nodes.iter().map(|node| node.n_swaps).sum(),
            counts: counts.map(|node| (node.node.clone(), node.counts.clone())).collect(),
            edges,
            operators: ran.pids.iter().map(|(node, pid)| OperatorPid { node: node.clone(), pid: *pid }).collect(),
            recorded,
        };
        Ok((summary, self.printer))
    }
}

/// What went over each edge; of those to the run itself, what it could read.
fn edges(ran: &Ran<'_>, observed: &BTreeMap<String, InputCounts>) -> Vec<EdgeStatus> {
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
fn skipped_by_stages(graph: &Graph, edges: &[EdgeStatus]) -> u64 {
    graph
        .nodes
        .iter()
        .filter(|node| !node.inputs.is_empty())
        .map(|node| {
            let prefix = format!("{}/", node.id);
            let behind = edges.iter().filter(|edge| edge.from.starts_with(&prefix));
            let before = edges.iter().filter(|edge| edge.to.starts_with(&prefix));
            let n_behind = behind.map(|edge| edge.missing.saturating_sub(edge.dropped)).max().unwrap_or(0);
            n_behind.saturating_sub(before.map(|edge| edge.missing).max().unwrap_or(0))
        })
        .sum()
}

fn latency(nanos: &Histogram<u64>) -> Option<Latency> {
    let quantile = |share: f64| nanos.value_at_quantile(share);
    let summary = Latency { p50: quantile(0.5), p90: quantile(0.9), p99: quantile(0.99), max: nanos.max() };
    (!nanos.is_empty()).then_some(summary)
}

/// The summary for a person.
fn table(summary: &Summary) -> Vec<String> {
    let counts = summary.counts.iter().map(|(node, counts)| {
        let counts = counts.iter().map(|(name, count)| format!("{name} {count}"));
        format!("{node}: {}", counts.collect::<Vec<_>>().join(", "))
    });
    let counts: Vec<String> = counts.collect();
    let rows = [
        (
            "grasps",
            format!(
                "{} ({} LIFT, {} HOLD), {} undecided{}",
                summary.grasps,
                summary.lift,
                summary.hold,
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
        ("counts", counts.join("; ")),
    ];
    // Live grasps have no truth to be measured by, and mostly nothing else is counted.
    let is_of_truth = |name: &str| ["accuracy", "false positives", "judged"].contains(&name);
    let is_shown = |(name, text): &(&str, String)| {
        (summary.with_truth > 0 || !is_of_truth(name)) && (*name != "counts" || !text.is_empty())
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
