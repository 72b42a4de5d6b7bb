//! An operator of one's own, outside `operators/`: a classifier that calls every grasp it has a feature of stable.
//!
//! Wire it in by its path (`run: ./target/release/examples/stubborn_classifier`). The tests use it to see that the arbiter holds
//! although everything says "stable": with `skip_seq` it doesn't answer one sample, with `garble_seq` it answers one with
//! nonsense.

use std::process::ExitCode;

use blindgrasp::dataflow::{OperatorDescription, ParamKind};
use blindgrasp::message::{Fault, GraspFeature, Prediction, PredictionHead, Recorded};
use blindgrasp::runtime::operator::{self, Operator, WAIT};
use blindgrasp::runtime::wiring::PortCounts;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    skip_seq: i64,
    garble_seq: i64,
}

fn main() -> ExitCode {
    let seq = || ParamKind::Integer { min: Some(-1), max: None };
    let description = OperatorDescription::new("stubborn_classifier", "Calls every grasp that is felt stable")
        .input("histogram", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "Stable, always")
        .param("skip_seq", seq(), Some((-1).into()), "The sample not to answer; -1 for none")
        .param("garble_seq", seq(), Some((-1).into()), "The sample to answer with nonsense; -1 for none");
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let mut features = operator.subscriber::<GraspFeature>("histogram")?;
    let mut predictions = operator.publisher::<Prediction>("prediction", 0)?;
    operator.ready(|| Ok(features.connect()? && predictions.has_all_consumers()))?;
    loop {
        let stop = operator.should_stop();
        while let Some(feature) = features.receive()? {
            let head = feature.user_header();
            let seq = head.header.seq as i64;
            let fault = Fault::from_code(head.fault).unwrap_or(Fault::Malformed);
            let is_felt = fault == Fault::None;
            let answer = PredictionHead {
                header: head.header,
                grasp_id: head.grasp_id,
                decision_value: f64::from(is_felt),
                probability_stable: if is_felt { 0.9 } else { 0.0 },
                phase: head.phase,
                stable: is_felt.into(),
                fault: if seq == params.garble_seq { 99 } else { fault.code() },
                unsure: 0,
            };
            if seq != params.skip_seq {
                predictions.send(answer, &[])?;
            }
        }
        if stop {
            break;
        }
        features.wait(WAIT);
    }
    operator.drained(PortCounts {
        received: [("histogram".into(), features.counts())].into(),
        sent: [("prediction".into(), predictions.n_sent())].into(),
    });
    Ok(())
}
