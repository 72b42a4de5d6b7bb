//! Decides once per grasp whether the arm may lift: `blindgrasp::lift_arbiter` as a process.

use std::collections::BTreeMap;
use std::process::ExitCode;

use blindgrasp::dataflow::{OperatorDescription, ParamKind};
use blindgrasp::diagnostics::print_diagnostic;
use blindgrasp::lift_arbiter::{ArbiterOptions, LiftArbiter};
use blindgrasp::message::{Header, LiftDecision, Message, Prediction, Recorded};
use blindgrasp::runtime::monotonic_nanos;
use blindgrasp::runtime::operator::{self, Operator, WAIT};
use blindgrasp::runtime::port::Publisher;
use blindgrasp::runtime::wiring::PortCounts;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    votes: u32,
    min_probability_stable: f64,
    max_gap_ms: f64,
    max_age_ms: f64,
}

fn main() -> ExitCode {
    let default = ArbiterOptions::default();
    let millis = || ParamKind::Number { above: Some(0.0), min: None, max: Some(3.6e6), words: vec![] };
    let share = ParamKind::Number { above: None, min: Some(0.0), max: Some(1.0), words: vec![] };
    let description = OperatorDescription::new("lift_arbiter", "Decides once per grasp: lift, or hold with the reason")
        .input("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .output("decision", LiftDecision::TYPE_NAME, "One decision per grasp")
        .param(
            "votes",
            ParamKind::Integer { min: Some(1), max: Some(1000) },
            Some(default.votes.into()),
            "Consecutive settled predictions that must agree",
        )
        .param(
            "min_probability_stable",
            share,
            Some(default.min_probability_stable.into()),
            "The least probability that counts as stable, in addition to the model's own threshold",
        )
        .param(
            "max_gap_ms",
            millis(),
            Some((default.max_gap_nanos as f64 / 1e6).into()),
            "How far apart two predictions of a grasp may be by the source's clock",
        )
        .param(
            "max_age_ms",
            millis(),
            Some((default.max_age_nanos as f64 / 1e6).into()),
            "How old a prediction may be on arrival, and how long none may come while a grasp is open",
        );
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let options = ArbiterOptions {
        votes: params.votes,
        min_probability_stable: params.min_probability_stable,
        max_gap_nanos: (params.max_gap_ms * 1e6) as u64,
        max_age_nanos: (params.max_age_ms * 1e6) as u64,
        ..ArbiterOptions::default()
    };
    let mut arbiter = LiftArbiter::new(options);
    let mut predictions = operator.subscriber::<Prediction>("prediction")?;
    let mut decisions = operator.publisher::<LiftDecision>("decision", 0)?;
    operator.ready(|| Ok(predictions.connect()? && decisions.has_all_consumers()))?;
    let mut last = Header::default();
    let mut last_arrival_nanos = monotonic_nanos();
    let mut decided = Vec::new();
    loop {
        let stop = operator.should_stop();
        while let Some(sample) = predictions.receive()? {
            last_arrival_nanos = monotonic_nanos();
            let head = sample.user_header();
            last = head.header;
            match Prediction::from_parts(head, sample.payload()) {
                Ok(prediction) => {
                    // A frame from the future has a clock that nobody should trust: as old as can be.
                    let age_nanos = last_arrival_nanos.checked_sub(head.header.origin_nanos).unwrap_or(u64::MAX);
                    arbiter.on_prediction(&head.header, &prediction, age_nanos, &mut decided);
                }
                Err(error) => {
                    print_diagnostic(&format!("prediction {} cannot be read: {error}", head.header.seq));
                    arbiter.on_unreadable(&head.header, head.grasp_id, &mut decided);
                }
            }
            publish(&mut decisions, &last, &mut decided)?;
        }
        if stop {
            decided.extend(arbiter.on_end());
        } else if arbiter.has_open_grasp() && monotonic_nanos() - last_arrival_nanos > options.max_age_nanos {
            decided.extend(arbiter.on_silence());
        }
        publish(&mut decisions, &last, &mut decided)?;
        if stop {
            break;
        }
        predictions.wait(WAIT);
    }
    operator.drained(PortCounts {
        received: BTreeMap::from([("prediction".into(), predictions.counts())]),
        sent: BTreeMap::from([("decision".into(), decisions.n_sent())]),
    });
    Ok(())
}

/// Sends the decisions in the name of the prediction that brought them about; their own sequence counts decisions.
fn publish(
    publisher: &mut Publisher<LiftDecision>,
    cause: &Header,
    decided: &mut Vec<LiftDecision>,
) -> anyhow::Result<()> {
    for decision in decided.drain(..) {
        let (head, items) = decision.to_parts(Header { seq: publisher.n_sent(), ..*cause });
        publisher.send(head, &items)?;
    }
    Ok(())
}
