//! An operator of one's own: a classifier that calls a grasp stable if enough pads are in contact.
//!
//! ```sh
//! cargo build --release --example operator
//! ```
//!
//! In a dataflow file it takes the place of `classifier` as `run: ./target/release/examples/operator`. `blindgrasp new
//! operator` makes a crate like it, with tests, for each kind of operator.

use std::collections::BTreeMap;
use std::process::ExitCode;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::{Operator, OperatorDescription, ParamKind, run, stage};
use serde::Deserialize;

/// The parameters, as `main` describes them.
#[derive(Deserialize)]
struct Params {
    min_pads: u32,
}

fn main() -> ExitCode {
    let at_least_1 = ParamKind::Integer { min: Some(1), max: None };
    let description = OperatorDescription::new("pad_counter", "Calls a grasp stable if enough pads are in contact")
        .answers_each()
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .param("min_pads", at_least_1, Some(2.into()), "The least number of pads of a stable grasp");
    run(&description, work)
}

/// Slow work, such as reading a model, belongs before `stage::run`.
fn work(operator: &Operator) -> anyhow::Result<()> {
    let Params { min_pads } = operator.params()?;
    let judge = stage::from_fn::<GraspFeature, Prediction, _>(move |head, _values, _items| judge(head, min_pads));
    // A prediction has no items, and the neighbours of this operator need nothing in common with it.
    stage::run(operator, "feature", "prediction", 0, BTreeMap::new(), judge)
}

/// Answers each sample under its header. A sample that cannot be judged becomes a fault, and the arm holds.
fn judge(head: &GraspFeatureHead, min_pads: u32) -> PredictionHead {
    let fault = Fault::from_code(head.fault).unwrap_or(Fault::Malformed);
    let stable = fault == Fault::None && head.n_pads_in_contact >= min_pads;
    PredictionHead {
        header: head.header,
        grasp_id: head.grasp_id,
        phase: head.phase,
        decision_value: if stable { 1.0 } else { -1.0 },
        probability_stable: if stable { 1.0 } else { 0.0 },
        stable: stable.into(),
        unsure: 0,
        fault: fault.code(),
    }
}
