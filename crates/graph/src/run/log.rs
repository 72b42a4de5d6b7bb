//! Pairs decisions with truths and outcomes while a graph runs, and keeps the figures that the summary needs.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

use hdrhistogram::Histogram;

use super::summary::{
    OperatorPid, Ran, RunSummary, edges, latency, lost_to_machines, missing_from_machines, skipped_by_stages,
};
use super::{RunSink, SeenDecision};
use crate::client::observer::Sink;
use crate::control::{DecidedGrasp, DecisionStatus};
use crate::dataflow::EdgePolicy;
use crate::launcher::{End, LaunchError};
use blindgrasp_messages::Record;
use blindgrasp_messages::score::Evaluation;
use blindgrasp_messages::{Action, GraspTruth, LiftDecision, LiftOutcome, Stamped};
use blindgrasp_operator::wiring::InputCounts;

/// This many decisions wait for the truth of their grasp, or for a drop after that.
const MAX_AWAITING_TRUTH: usize = 1024;
/// The status of the graph tells this many of the latest decisions.
const N_SHOWN: usize = 32;
/// This many truths wait for the decision of their grasp.
const MAX_AWAITING_DECISION: usize = 4096;
/// Longer latencies count as an hour.
const LONGEST_LATENCY_NANOS: u64 = 3_600_000_000_000;

/// Hands samples on to the caller's sink, and counts. Its size does not grow with time.
pub(super) struct RunLog<S> {
    sink: S,
    /// The decisions that the graph's status tells.
    status: Arc<Mutex<DecisionStatus>>,
    evaluation: Evaluation,
    n_lift: usize,
    n_probes: usize,
    n_decisions: usize,
    n_undecided: usize,
    /// Truths whose decision has not come.
    truths: BTreeMap<u64, GraspTruth>,
    /// The latest decisions, each with its truth if that has come.
    decisions: VecDeque<(LiftDecision, Option<GraspTruth>)>,
    /// Outcomes of grasps whose decision has not been read.
    outcomes: BTreeMap<u64, LiftOutcome>,
    /// The grasp that was decided last.
    last_decided: Option<u64>,
    latencies_nanos: Histogram<u64>,
}

impl<S: RunSink> Sink for RunLog<S> {
    fn take(&mut self, topic: &str, record: Record, received_nanos: u64) -> anyhow::Result<()> {
        match &record {
            Record::Truth(truth) => self.on_truth(truth.message.clone()),
            Record::Outcome(outcome) => self.on_outcome(outcome.message.clone())?,
            Record::Decision(decision) => self.on_decision(decision, received_nanos)?,
            _ => {}
        }
        self.sink.sample(topic, record, received_nanos)
    }
}

impl<S: RunSink> RunLog<S> {
    pub(super) fn new(sink: S, status: Arc<Mutex<DecisionStatus>>) -> anyhow::Result<Self> {
        Ok(RunLog {
            sink,
            status,
            evaluation: Evaluation::default(),
            n_lift: 0,
            n_probes: 0,
            n_decisions: 0,
            n_undecided: 0,
            truths: BTreeMap::new(),
            decisions: VecDeque::new(),
            outcomes: BTreeMap::new(),
            last_decided: None,
            // Three digits take some tens of kilobytes, however long the run is.
            latencies_nanos: Histogram::new_with_max(LONGEST_LATENCY_NANOS, 3)?,
        })
    }

    /// Adds a decision to the graph's status.
    fn show(&self, decided: DecidedGrasp) {
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        match decided.action {
            Action::Lift => status.n_lift += 1,
            Action::Hold => {
                status.n_hold += 1;
                *status.holds.entry(decided.reason.as_str().into()).or_default() += 1;
            }
            _ => {}
        }
        status.n_false_positives += u64::from(decided.is_false_positive());
        status.latest.push_back(decided);
        if status.latest.len() > N_SHOWN {
            status.latest.pop_front();
        }
    }

    /// Adds a truth that came after its decision, or after the truth `before`, to the graph's status.
    fn show_truth(&self, truth: &GraspTruth, before: Option<bool>) {
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        let decided = status.latest.iter_mut().rfind(|it| it.grasp_id == truth.grasp_id && it.truth == before);
        let Some(decided) = decided else { return };
        decided.truth = Some(truth.stable);
        let is_false_positive = decided.is_false_positive();
        status.n_false_positives += u64::from(is_false_positive);
    }

    fn on_truth(&mut self, truth: GraspTruth) {
        match self.decisions.iter_mut().rfind(|(decision, _)| decision.grasp_id == truth.grasp_id) {
            Some((_, known @ None)) => {
                *known = Some(truth.clone());
                self.show_truth(&truth, None);
            }
            // An object that was kept may be dropped after that.
            Some((_, Some(known))) if known.stable && !truth.stable => {
                *known = truth.clone();
                self.show_truth(&truth, Some(true));
            }
            _ => drop(self.truths.insert(truth.grasp_id, truth)),
        }
        // A decision comes soon after its truth: the oldest truths will have none.
        while self.truths.len() > MAX_AWAITING_DECISION && self.truths.pop_first().is_some() {
            self.n_undecided += 1;
        }
    }

    /// An outcome follows its decision, but may be read before it.
    fn on_outcome(&mut self, outcome: LiftOutcome) -> anyhow::Result<()> {
        if self.last_decided.is_none_or(|last| last < outcome.grasp_id) {
            self.outcomes.insert(outcome.grasp_id, outcome);
            return Ok(());
        }
        self.sink.outcome(&outcome)
    }

    fn on_decision(&mut self, decision: &Stamped<LiftDecision>, received_nanos: u64) -> anyhow::Result<()> {
        let Stamped { header, message } = decision;
        let latency_nanos = (header.origin_nanos != 0).then(|| received_nanos.saturating_sub(header.origin_nanos));
        if let Some(nanos) = latency_nanos
            && message.action != Action::GoOn
        {
            self.latencies_nanos.saturating_record(nanos);
        }
        if !message.action.decides() {
            // It comes before the grasp's decision, or after it.
            self.n_probes += usize::from(matches!(message.action, Action::Squeeze | Action::TestLift));
            return self.sink.decision(&SeenDecision { header, decision: message, latency_nanos, truth: None });
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
        self.sink.decision(&SeenDecision { header, decision: message, latency_nanos, truth: truth.as_ref() })?;
        self.last_decided = self.last_decided.max(Some(message.grasp_id));
        while let Some(first) = self.outcomes.first_entry().filter(|first| Some(*first.key()) <= self.last_decided) {
            self.sink.outcome(&first.remove())?;
        }
        self.n_decisions += 1;
        self.n_lift += usize::from(message.action == Action::Lift);
        self.decisions.push_back((message.clone(), truth));
        // A truth comes before its decision or right after it: the oldest decisions will have none.
        while self.decisions.len() > MAX_AWAITING_TRUTH
            && let Some((decision, truth)) = self.decisions.pop_front()
        {
            self.evaluation.add(&decision, truth.as_ref());
        }
        Ok(())
    }

    /// The summary of the run, and the caller's sink.
    pub(super) fn finish(
        mut self,
        ran: &Ran<'_>,
        observed: &BTreeMap<String, InputCounts>,
    ) -> anyhow::Result<(RunSummary, S)> {
        for (decision, truth) in &self.decisions {
            self.evaluation.add(decision, truth.as_ref());
        }
        for outcome in self.outcomes.values() {
            self.sink.outcome(outcome)?;
        }
        let edges = edges(ran, observed);
        let dropped = |policy: EdgePolicy| {
            edges.iter().filter(|edge| edge.policy == policy).map(|edge| edge.dropped).sum::<u64>()
        };
        let n_lost_to_machines = lost_to_machines(ran, EdgePolicy::Lossless);
        let counts = ran.status.nodes.iter().filter(|node| !node.counts.is_empty());
        let score = &self.evaluation.score;
        let summary = RunSummary {
            graph: ran.status.graph.clone(),
            end: match ran.outcome {
                Ok(End::Finished) => "finished",
                Ok(End::Stopped) => "stopped",
                Err(LaunchError::Degraded(_)) => "degraded",
                Err(_) => "failed",
            },
            grasps: self.n_decisions,
            lift: self.n_lift,
            hold: self.n_decisions - self.n_lift,
            probes: self.n_probes,
            with_truth: score.n_grasps,
            accuracy: score.accuracy,
            majority_class: score.majority_class,
            false_positives: score.n_false_positive,
            false_positive_share: score.false_positive_share,
            undecided: self.n_undecided + self.truths.len(),
            latency_nanos: latency(&self.latencies_nanos),
            samples_lost: dropped(EdgePolicy::Lossless)
                + skipped_by_stages(ran.graph, &ran.status.nodes, &edges)
                + n_lost_to_machines
                // What never reached another machine is missing in its answers as well.
                + missing_from_machines(ran.graph, &edges).saturating_sub(n_lost_to_machines),
            samples_dropped: dropped(EdgePolicy::Latest) + lost_to_machines(ran, EdgePolicy::Latest),
            edges_unknown: edges.iter().filter(|edge| edge.received > edge.sent).count(),
            restarts: ran.status.nodes.iter().map(|node| node.n_restarts).sum(),
            swaps: ran.status.nodes.iter().map(|node| node.n_swaps).sum(),
            counts: counts.map(|node| (node.node.clone(), node.counts.clone())).collect(),
            link: ran.status.link.clone(),
            edges,
            operators: ran.pids.iter().map(|(node, pid)| OperatorPid { node: node.clone(), pid: *pid }).collect(),
            judged: self.evaluation.score_judged,
            reasons: self.evaluation.by_reason,
        };
        Ok((summary, self.sink))
    }
}
