//! What a run says and keeps while it runs: decisions as they come, and what the summary needs.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use hdrhistogram::Histogram;
use serde::Serialize;

use super::Tap;
use super::recorder::Recorder;
use super::summary::{
    OperatorPid, Ran, Summary, edges, latency, lost_to_machines, missing_from_machines, skipped_by_stages,
};
use blindgrasp_graph::control::{DecidedGrasp, DecisionStatus};
use blindgrasp_graph::launcher::{End, LaunchError};
use blindgrasp_graph::observer::Sink;
use blindgrasp_graph::recording_of_graph::Ending;
use blindgrasp_learning::evaluation::Evaluation;
use blindgrasp_messages::{Action, GraspTruth, Header, LiftDecision, LiftOutcome, Stamped};
use blindgrasp_operator::diagnostics::LinePrinter;
use blindgrasp_operator::wiring::EdgePolicy;
use blindgrasp_operator::wiring::InputCounts;
use blindgrasp_recording::Record;

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

/// What the run saw: prints decisions as they come, records, and keeps what the summary needs, which does not grow with
/// time.
pub(super) struct RunLog {
    json: bool,
    is_quiet: bool,
    /// To stdout, whether somebody reads it or not: decisions go on being made and recorded.
    printer: LinePrinter,
    recorder: Option<Recorder>,
    tap: Option<Tap>,
    /// What others are told of the decisions.
    seen: Arc<Mutex<DecisionStatus>>,
    evaluation: Evaluation,
    n_lift: usize,
    n_regrasp: usize,
    n_decisions: usize,
    n_undecided: usize,
    /// Truths whose decision has not come.
    truths: BTreeMap<u64, GraspTruth>,
    /// Decisions whose truth has not come.
    decisions: BTreeMap<u64, LiftDecision>,
    /// Outcomes of grasps whose decision has not been read.
    outcomes: BTreeMap<u64, LiftOutcome>,
    /// The grasp that was decided last.
    last_decided: Option<u64>,
    latencies_nanos: Histogram<u64>,
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
struct OutcomeLine<'a> {
    outcome: &'a LiftOutcome,
}

impl Sink for RunLog {
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        if let Some(tap) = &mut self.tap {
            tap(topic, &record, received_nanos)?;
        }
        match &record {
            Record::Truth(truth) => self.on_truth(truth.message.clone()),
            Record::Outcome(outcome) => self.on_outcome(outcome.message.clone())?,
            Record::Decision(decision) => self.on_decision(decision.clone(), received_nanos)?,
            _ => {}
        }
        if let Some(recorder) = &mut self.recorder {
            recorder.push(topic, record);
        }
        Ok(())
    }
}

impl RunLog {
    pub(super) fn new(
        json: bool,
        is_quiet: bool,
        recorder: Option<Recorder>,
        tap: Option<Tap>,
        seen: Arc<Mutex<DecisionStatus>>,
    ) -> anyhow::Result<Self> {
        Ok(RunLog {
            json,
            is_quiet,
            printer: LinePrinter::new(std::io::stdout(), MAX_UNREAD_LINES),
            recorder,
            tap,
            seen,
            evaluation: Evaluation::default(),
            n_lift: 0,
            n_regrasp: 0,
            n_decisions: 0,
            n_undecided: 0,
            truths: BTreeMap::new(),
            decisions: BTreeMap::new(),
            outcomes: BTreeMap::new(),
            last_decided: None,
            // Three digits, which takes some tens of kilobytes however long the run is.
            latencies_nanos: Histogram::new_with_max(LONGEST_LATENCY_NANOS, 3)?,
        })
    }

    /// Tells it to whoever asks the graph.
    fn show(&self, decided: DecidedGrasp) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match decided.action {
            Action::Lift => seen.n_lift += 1,
            Action::Hold | Action::Regrasp => seen.n_hold += 1,
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

    /// An outcome follows its decision, but may be read before it.
    fn on_outcome(&mut self, outcome: LiftOutcome) -> serde_json::Result<()> {
        if self.last_decided.is_none_or(|last| last < outcome.grasp_id) {
            self.outcomes.insert(outcome.grasp_id, outcome);
            return Ok(());
        }
        self.print_outcome(&outcome)
    }

    /// Says what became of a lift; of a grasp that was not lifted its decision has said so.
    fn print_outcome(&mut self, outcome: &LiftOutcome) -> serde_json::Result<()> {
        if self.is_quiet || !(outcome.lifted || self.json) {
            return Ok(());
        }
        let line = if self.json {
            serde_json::to_string(&OutcomeLine { outcome })?
        } else {
            format!(
                "grasp {:>5}  {}  slip {:.1} mm  turn {:.1}°  ({})",
                outcome.grasp_id,
                if outcome.held { "held   " } else { "DROPPED" },
                outcome.slip_m * 1e3,
                outcome.turn_rad.to_degrees(),
                outcome.thing
            )
        };
        self.printer.print(line);
        Ok(())
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
            let action = line.action.shown();
            let latency = latency_nanos.map_or("-".into(), |nanos| format!("{:.0} µs", nanos as f64 / 1e3));
            let truth = truth.as_ref().map_or(String::new(), |truth| {
                format!("  truth: {} ({})", if truth.stable { "stable" } else { "unstable" }, truth.object)
            });
            format!(
                "grasp {:>5}  {action}  p {:.3}  {:<14} {latency:>9}{truth}",
                line.grasp_id, line.probability_stable, line.reason
            )
        };
        if !self.is_quiet {
            self.printer.print(line);
        }
        self.last_decided = self.last_decided.max(Some(message.grasp_id));
        while let Some(first) = self.outcomes.first_entry().filter(|first| Some(*first.key()) <= self.last_decided) {
            let outcome = first.remove();
            self.print_outcome(&outcome)?;
        }
        self.n_decisions += 1;
        self.n_lift += usize::from(message.action == Action::Lift);
        self.n_regrasp += usize::from(message.action == Action::Regrasp);
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

    pub(super) fn finish(
        mut self,
        ran: Ran<'_>,
        observed: &BTreeMap<String, InputCounts>,
    ) -> anyhow::Result<(Summary, LinePrinter)> {
        for decision in self.decisions.values() {
            self.evaluation.add(decision, None);
        }
        for outcome in std::mem::take(&mut self.outcomes).values() {
            self.print_outcome(outcome)?;
        }
        let evaluation = self.evaluation;
        let score = &evaluation.score;
        let is_recorded = self.recorder.is_some();
        let ending = if ran.ended.is_ok() { Ending::Graph } else { Ending::Broken };
        let mut recorded = self.recorder.map(|recorder| recorder.finish(ending)).unwrap_or_default();
        if ran.ended.is_err() {
            recorded.remove_if_empty();
        }
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
            regrasp: self.n_regrasp,
            with_truth: score.n_grasps,
            accuracy: score.accuracy,
            majority_class: score.majority_class,
            false_positives: score.n_false_positive,
            false_positive_share: score.false_positive_share,
            judged: evaluation.score_judged.clone(),
            undecided: self.n_undecided + self.truths.len(),
            reasons: evaluation.by_reason.clone(),
            latency_nanos: latency(&self.latencies_nanos),
            samples_lost: dropped(EdgePolicy::Lossless)
                + skipped_by_stages(ran.graph, &edges)
                + lost_to_machines(&ran, EdgePolicy::Lossless)
                + missing_from_machines(ran.graph, &edges),
            samples_dropped: dropped(EdgePolicy::Latest) + lost_to_machines(&ran, EdgePolicy::Latest),
            edges_unknown: edges.iter().filter(|edge| edge.received > edge.sent).count(),
            restarts: ran.status.nodes.iter().map(|node| node.n_restarts).sum(),
            swaps: ran.status.nodes.iter().map(|node| node.n_swaps).sum(),
            counts: counts.map(|node| (node.node.clone(), node.counts.clone())).collect(),
            link: ran.status.link.clone(),
            edges,
            operators: ran.pids.iter().map(|(node, pid)| OperatorPid { node: node.clone(), pid: *pid }).collect(),
            recorded: is_recorded.then_some(recorded.samples),
            recorded_files: recorded.files,
            recording_error: recorded.error,
            samples_not_recorded: recorded.n_not_recorded,
        };
        Ok((summary, self.printer))
    }
}
