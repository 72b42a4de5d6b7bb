//! From the feature to a calibrated probability: `blindgrasp::classifier` as a process.

use std::path::PathBuf;
use std::process::ExitCode;

use blindgrasp::dataflow::{OperatorDescription, PROTOCOL, ParamDescription, ParamKind, PortDescription};
use blindgrasp::message::{Fault, GraspFeature, Message, Prediction, PredictionHead};
use blindgrasp::model::Model;
use blindgrasp::runtime::operator::{self, Operator};
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
}

fn main() -> ExitCode {
    let description = OperatorDescription {
        protocol: PROTOCOL,
        operator: "classifier".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        summary: "Predicts from each frame's feature whether the grasp is stable".into(),
        inputs: vec![PortDescription {
            name: "histogram".into(),
            type_name: GraspFeature::TYPE_NAME.into(),
            optional: false,
            summary: "The feature of each frame".into(),
        }],
        outputs: vec![PortDescription {
            name: "prediction".into(),
            type_name: Prediction::TYPE_NAME.into(),
            optional: false,
            summary: "The prediction for each frame".into(),
        }],
        params: vec![ParamDescription {
            name: "model".into(),
            kind: ParamKind::Path { must_exist: true },
            default: None,
            optional: false,
            summary: "The model file".into(),
        }],
    };
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let dictionary_id = model.dictionary_id();
    operator::run_stage::<GraspFeature, Prediction>(operator, "histogram", "prediction", 0, |feature, _| {
        let head = feature.user_header();
        let verdict = match Fault::from_code(head.fault) {
            Err(_) => Err(Fault::Malformed),
            Ok(_) if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
            Ok(_) if head.dictionary_id != dictionary_id => Err(Fault::WrongModel),
            Ok(Fault::None) => model.classifier.classify(feature.payload()),
            Ok(fault) => Err(fault),
        };
        PredictionHead {
            header: head.header,
            grasp_id: head.grasp_id,
            decision_value: verdict.map_or(0.0, |verdict| verdict.decision_value),
            probability_stable: verdict.map_or(0.0, |verdict| verdict.probability_stable),
            phase: head.phase,
            stable: verdict.is_ok_and(|verdict| verdict.stable).into(),
            fault: verdict.err().unwrap_or_default().code(),
            reserved: 0,
        }
    })
}
