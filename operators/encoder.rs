//! From contacts to the feature.

use std::path::PathBuf;

use blindgrasp_messages::{
    Contact, ContactSet, ContactSetHead, Fault, GraspFeature, GraspFeatureHead, Phase, Recorded,
};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use blindgrasp_stages::encoder::Reading;
use blindgrasp_stages::model::Model;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Describes each frame by the feature blocks of the model, such as the histogram over its dictionary of contacts";
    OperatorDescription::new("encoder", summary)
        .answers_each()
        .input("contacts", ContactSet::TYPE_NAME, "The contacts of each frame")
        .output("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .param("model", ParamKind::Path { must_exist: true }, None, "The model file")
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let dictionary_id = model.dictionary_id();
    let n_features = model.features.len();
    let identity = model.identity();
    let encode = stage::from_fn::<ContactSet, GraspFeature, _>(move |head, contacts, values| {
        let outcome = match Fault::from_code(head.fault) {
            Err(_) => Err(Fault::Malformed),
            Ok(_) if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
            Ok(Fault::None) => extract(&model, head, contacts, values),
            Ok(fault) => Err(fault),
        };
        GraspFeatureHead {
            header: head.header,
            grasp_id: head.grasp_id,
            phase: head.phase,
            dictionary_id,
            n_pads_in_contact: outcome.unwrap_or(head.n_pads_in_contact),
            fault: outcome.err().unwrap_or_default().code(),
            day: head.day,
        }
    });
    stage::run(operator, "contacts", "feature", n_features, identity, encode)
}

fn extract(model: &Model, head: &ContactSetHead, contacts: &[Contact], values: &mut Vec<f64>) -> Result<u32, Fault> {
    let (Ok(joints_rad), Ok(senses), Ok(phase)) = (head.joints_rad(), head.senses(), Phase::from_code(head.phase))
    else {
        return Err(Fault::Malformed);
    };
    model.extract(phase, &Reading { joints_rad, contacts, senses }, values)
}
