//! From the feature to a calibrated probability.

use std::path::PathBuf;

use blindgrasp_messages::{Fault, GraspFeature, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use blindgrasp_stages::model::Model;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Predicts from each frame's feature whether the grasp is stable";
    OperatorDescription::new("classifier", summary)
        .answers_each()
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .param("model", ParamKind::Path { must_exist: true }, None, "The model file")
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let dictionary_id = model.dictionary_id();
    let identity = model.identity();
    let classify = stage::from_fn::<GraspFeature, Prediction, _>(move |head, values, _| {
        let verdict = match Fault::from_code(head.fault) {
            Err(_) => Err(Fault::Malformed),
            Ok(_) if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
            Ok(_) if head.dictionary_id != dictionary_id => Err(Fault::WrongModel),
            Ok(Fault::None) => model.classifier.classify(values),
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
            unsure: verdict.is_ok_and(|verdict| verdict.unsure).into(),
        }
    });
    stage::run(operator, "feature", "prediction", 0, identity, classify)
}
