//! Decides once per grasp whether the arm may lift.

use std::collections::BTreeMap;

use blindgrasp_messages::{
    Action, Header, LiftDecision, LiftDecisionHead, Message, Prediction, PredictionHead, Recorded,
};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, Stage, decode_state, encode_state};
use blindgrasp_operator::wiring::Clock;
use blindgrasp_stages::lift_arbiter::{ArbiterOptions, ArbiterState, LiftArbiter, Probe};
use blindgrasp_stages::lift_watch::{WATCH_COUNTS, creep};
use blindgrasp_stages::promise_monitor::{OUTCOME_COUNTS, PromiseMonitor};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::beginning::FileNode;

#[derive(Deserialize)]
struct Params {
    votes: u32,
    min_probability_stable: f64,
    max_gap_ms: f64,
    max_age_ms: f64,
    probe: Probe,
    promised_drops: f64,
    lifts_per_object: u32,
}

pub(crate) fn describe() -> OperatorDescription {
    let default = ArbiterOptions::default();
    let millis = || ParamKind::Number { above: Some(0.0), min: None, max: Some(3.6e6), words: vec![] };
    let share = ParamKind::Number { above: None, min: Some(0.0), max: Some(1.0), words: vec![] };
    OperatorDescription::new("lift_arbiter", "Decides once per grasp: lift or hold, with the reason")
        .input("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .output("decision", LiftDecision::TYPE_NAME, "One decision per grasp, and before it the probe that it takes")
        .live_param(
            "votes",
            ParamKind::Integer { min: Some(1), max: Some(1000) },
            Some(default.votes.into()),
            "Consecutive settled predictions that must agree",
        )
        .live_param(
            "min_probability_stable",
            share.clone(),
            Some(default.min_probability_stable.into()),
            "The least probability that counts as stable, in place of the model's own threshold; 0 keeps the model's. Below that \
             the model's bound on drops does not hold",
        )
        .live_param(
            "max_gap_ms",
            millis(),
            Some((default.max_gap_nanos as f64 / 1e6).into()),
            "How far apart two predictions of a grasp may be by the source's clock; three periods of the source, if that is more",
        )
        .live_param(
            "max_age_ms",
            millis(),
            Some((default.max_age_nanos as f64 / 1e6).into()),
            "How old a prediction may be on arrival, and how long none may come in an open grasp; three periods of the source, if more",
        )
        .live_param(
            "probe",
            ParamKind::Choice { values: ["none", "squeeze", "test_lift"].map(String::from).into() },
            Some("none".into()),
            "The probe that the robot can do: a grasp that may be stable is decided by its frames after it, with a model that \
             was trained on such frames",
        )
        .live_param(
            "promised_drops",
            share,
            Some(default.promised_drops.into()),
            "The promised share of the lifts that drop the object: if frames of the phases kept and dropped refute it, every grasp \
             is held until this is set to another value; 1 promises nothing",
        )
        .live_param(
            "lifts_per_object",
            ParamKind::Integer { min: Some(1), max: Some(100) },
            Some(default.lifts_per_object.into()),
            "How many times in a row the robot lifts an object at most: so many outcomes count once in the bound of this robot's \
             drops; 1 for objects in random order",
        )
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    parse_params::<Params>(&node.params)?;
    Ok(())
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let arbiter = LiftArbiter::new(operator.params::<Params>()?.options());
    let (clock, last) = (operator.clock(), Header::default());
    let stage = Arbiter {
        operator: operator.clone(),
        arbiter,
        clock,
        last,
        n_decisions: 0,
        last_arrival_nanos: 0,
        decided: Vec::new(),
        ended: EndedPromises::default(),
        reported: Default::default(),
        has_said_loosened: false,
        reused: None,
        has_said_creep: false,
    };
    stage::run(operator, "prediction", "decision", 0, BTreeMap::new(), stage)
}

impl Params {
    fn options(&self) -> ArbiterOptions {
        ArbiterOptions {
            votes: self.votes,
            min_probability_stable: self.min_probability_stable,
            max_gap_nanos: (self.max_gap_ms * 1e6) as u64,
            max_age_nanos: (self.max_age_ms * 1e6) as u64,
            probe: self.probe,
            promised_drops: self.promised_drops,
            lifts_per_object: self.lifts_per_object,
            ..ArbiterOptions::default()
        }
    }
}

/// The arbiter, and what the operator adds: the clock, and the numbers of its decisions.
struct Arbiter {
    operator: Operator,
    arbiter: LiftArbiter,
    clock: Clock,
    /// The header of the last prediction, under which it decides.
    last: Header,
    n_decisions: u64,
    last_arrival_nanos: u64,
    decided: Vec<LiftDecision>,
    ended: EndedPromises,
    /// The outcomes that are counted in the node's status, the number of lifts without one, and the lifts that were watched.
    reported: (PromiseMonitor, u64, [u64; 2]),
    /// Whether it has said that its threshold is below the model's.
    has_said_loosened: bool,
    /// The grasp of which it has said that its number was used again.
    reused: Option<(u64, u64)>,
    /// Whether it has said that contacts creep.
    has_said_creep: bool,
}

/// The outcomes of lifts under promises that another one has replaced.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
struct EndedPromises {
    n_kept: u64,
    n_dropped: u64,
    n_withdrawn: u64,
}

impl Stage for Arbiter {
    type In = Prediction;
    type Out = LiftDecision;

    fn has_state(&self) -> bool {
        true
    }

    fn answer(&mut self, head: &PredictionHead, items: &[u8], now_nanos: u64, answers: &mut Answers<LiftDecision>) {
        self.last_arrival_nanos = now_nanos;
        self.last = head.header;
        match Prediction::from_parts(head, items) {
            Ok(prediction) => {
                // The clock of a frame from the future cannot be trusted: the frame counts as infinitely old.
                let age_nanos = now_nanos.checked_sub(head.header.origin_nanos).unwrap_or(u64::MAX);
                self.arbiter.on_prediction(&head.header, &prediction, age_nanos, &mut self.decided);
                let grasp = (head.header.epoch, head.grasp_id);
                if self.reused != Some(grasp) && self.arbiter.is_reused(grasp) {
                    self.reused = Some(grasp);
                    tracing::warn!(
                        "grasp {} is decided, but its hand has opened and settled again: no decision follows; expected another \
                         grasp_id for each grasp",
                        head.grasp_id
                    );
                }
                if !self.has_said_loosened && self.arbiter.options().loosens(&prediction) {
                    self.has_said_loosened = true;
                    tracing::warn!(
                        grasp_id = head.grasp_id,
                        "min_probability_stable ({}) is below the threshold of the model, which does not call a grasp of probability \
                         {:.3} stable: the model's bound on drops does not hold",
                        self.arbiter.options().min_probability_stable,
                        prediction.probability_stable
                    );
                }
            }
            Err(error) => {
                tracing::warn!(seq = head.header.seq, "a prediction cannot be read: {error}");
                self.arbiter.on_unreadable(&head.header, head.grasp_id, &mut self.decided);
            }
        }
        self.publish(answers);
    }

    /// Nothing else has looked at the clock since the decision was made.
    fn before_sending(&self, head: &mut LiftDecisionHead, now_nanos: u64) {
        if let Ok(mut decision) = LiftDecision::from_parts(head, &[])
            && decision.expire(head.header.valid_until_nanos(), now_nanos)
        {
            let age_ms = now_nanos.saturating_sub(head.header.origin_nanos) as f64 / 1e6;
            let valid_ms = head.header.valid_nanos as f64 / 1e6;
            tracing::warn!(
                grasp_id = head.grasp_id,
                "a lift was not sent in time, {age_ms:.1} ms after its frame, and expired after {valid_ms:.1} ms (max_age_ms): it is a \
                 hold"
            );
            (*head, _) = decision.to_parts(head.header);
        }
    }

    fn deadline_nanos(&self) -> Option<u64> {
        let deadline = self.last_arrival_nanos.saturating_add(self.arbiter.silence_limit_nanos());
        self.arbiter.has_open_grasp().then_some(deadline.saturating_add(1))
    }

    fn on_silence(&mut self, now_nanos: u64, answers: &mut Answers<LiftDecision>) {
        if self.deadline_nanos().is_some_and(|deadline_nanos| now_nanos >= deadline_nanos) {
            self.decided.extend(self.arbiter.on_silence());
            self.publish(answers);
        }
    }

    fn on_cut_off(&mut self, answers: &mut Answers<LiftDecision>) {
        self.decided.extend(self.arbiter.on_cut_off());
        self.publish(answers);
    }

    fn on_end(&mut self, answers: &mut Answers<LiftDecision>) {
        self.decided.extend(self.arbiter.on_end());
        self.publish(answers);
    }

    fn look(&mut self) {
        self.report();
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state("lift_arbiter", (self.arbiter.state(), self.last, self.n_decisions, self.ended), bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        let is_there = state.is_some();
        self.decided.clear();
        // Silence counts from now: before, this instance did not listen.
        self.last_arrival_nanos = blindgrasp_operator::monotonic_nanos();
        let (state, last, n_decisions, ended): (ArbiterState, _, _, _) = match state {
            Some(bytes) => decode_state("lift_arbiter", bytes)?,
            None => Default::default(),
        };
        self.ended = ended;
        let promise = state.promise().clone();
        self.arbiter.restore(state);
        self.has_replaced(&promise);
        self.report();
        (self.last, self.n_decisions) = (last, n_decisions);
        Ok(is_there)
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<()> {
        let options = parse_params::<Params>(params)?.options();
        let promise = self.arbiter.state().promise().clone();
        self.has_said_loosened = false;
        self.arbiter.set_options(options);
        self.has_replaced(&promise);
        self.report();
        Ok(())
    }
}

impl Arbiter {
    /// Keeps the outcomes under a promise, if the arbiter has another one now.
    fn has_replaced(&mut self, before: &PromiseMonitor) {
        let now = self.arbiter.state().promise();
        if now.n_kept + now.n_dropped < before.n_kept + before.n_dropped {
            self.ended.n_kept += before.n_kept;
            self.ended.n_dropped += before.n_dropped;
            self.ended.n_withdrawn += u64::from(before.is_withdrawn());
        }
    }

    /// Counts outcomes of lifts in the node's status, and says once that the promise is withdrawn.
    fn report(&mut self) {
        let state = self.arbiter.state();
        let (promise, watched) = (state.promise(), state.watched());
        if *promise == self.reported.0 && (state.n_unreported(), watched) == (self.reported.1, self.reported.2) {
            return;
        }
        let (n_kept, n_dropped) = (promise.n_kept, promise.n_dropped);
        let [kept_since_change, dropped_since_change] = promise.since_change();
        let ArbiterOptions { promised_drops, lifts_per_object, .. } = *self.arbiter.options();
        // Before an outcome there is nothing to tell.
        let (mut drops_at_most_ppm, mut told_lifts_per_object) = (0, 0);
        if kept_since_change + dropped_since_change > 0 {
            drops_at_most_ppm = (1e6 * promise.drops_at_most(lifts_per_object)).ceil() as u64;
            told_lifts_per_object = u64::from(lifts_per_object);
        }
        if promise.is_withdrawn() && !self.reported.0.is_withdrawn() {
            let promised = 100.0 * promised_drops;
            tracing::warn!(
                "more lifts drop the object than the promised {promised} %: {n_dropped} of {} that were reported, the last ones \
                 most often; every grasp is held until promised_drops is set to another value",
                n_kept + n_dropped
            );
        }
        if promise.is_doubted() && !self.reported.0.is_doubted() && !promise.is_withdrawn() {
            tracing::warn!(
                "lifts seem to drop the object more often than the promised {} %: {n_dropped} of {} that were reported; if this \
                 goes on, every grasp will be held",
                100.0 * promised_drops,
                n_kept + n_dropped
            );
        }
        if let Some(creep) = creep(watched)
            && !self.has_said_creep
        {
            self.has_said_creep = true;
            tracing::warn!("{creep}");
        }
        let mut counts: BTreeMap<String, u64> = BTreeMap::from([
            (OUTCOME_COUNTS[0].into(), kept_since_change),
            (OUTCOME_COUNTS[1].into(), dropped_since_change),
            (OUTCOME_COUNTS[2].into(), drops_at_most_ppm),
            (OUTCOME_COUNTS[3].into(), told_lifts_per_object),
            ("lifts/kept".into(), self.ended.n_kept + n_kept),
            ("lifts/dropped".into(), self.ended.n_dropped + n_dropped),
            ("lifts/unreported".into(), state.n_unreported()),
            ("promise_withdrawn".into(), self.ended.n_withdrawn + u64::from(promise.is_withdrawn())),
        ]);
        if watched[0] > 0 {
            counts.extend(WATCH_COUNTS.map(String::from).into_iter().zip(watched));
        }
        self.operator.has_counted_in_all(counts);
        self.reported = (promise.clone(), state.n_unreported(), watched);
    }

    /// Answers under the header of the last prediction, but with numbers that count the decisions.
    fn publish(&mut self, answers: &mut Answers<LiftDecision>) {
        for decision in self.decided.drain(..) {
            let why = self.arbiter.explain(decision.grasp_id).join("; ");
            if decision.action == Action::Hold && !why.is_empty() {
                tracing::warn!("grasp {} is held, {}: {why}", decision.grasp_id, decision.reason.as_str());
            }
            // By a recording's clock nothing expires.
            let valid_nanos = if self.clock == Clock::Machine { self.arbiter.options().max_age_nanos } else { 0 };
            let (head, _) = decision.to_parts(Header { seq: self.n_decisions, valid_nanos, ..self.last });
            self.n_decisions += 1;
            answers.push(head);
        }
    }
}
