//! From contacts to the feature.

use std::path::{Path, PathBuf};

use blindgrasp_messages::{ContactSet, Fault, GraspFeature, Phase, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use blindgrasp_stages::out_of_distribution::Violation;
use blindgrasp_stages::{Hand, Model, steps};
use serde::Deserialize;

use crate::beginning::FileNode;

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

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    let params: Params = parse_params(&node.params)?;
    Model::load(&params.model)?;
    Ok(())
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let mut model = Model::load(&params.model)?;
    // Both are those of the model's file, as the classifier reads it.
    let (dictionary_id, identity) = (model.dictionary_id(), model.identity());
    // A model of this version has the names of the hand's parts. An older one of a built-in hand gets them.
    if let Ok(hand) = Hand::load(Path::new(&model.hand.name))
        && hand.id() == model.hand.id
    {
        model.name_quantities(&hand);
    }
    let n_features = model.features.len();
    let mut told = None;
    let encode = stage::from_fn::<ContactSet, GraspFeature, _>(move |head, contacts, values| {
        let feature = steps::encode(&model, dictionary_id, head, contacts, values);
        let is_unusual = feature.fault == Fault::OutOfDistribution.code();
        // Once for each grasp: its frames violate the same limits.
        if is_unusual && told != Some(head.grasp_id) && Phase::from_code(head.phase).is_ok_and(Phase::decides) {
            told = Some(head.grasp_id);
            let violated = Violation::most(&steps::violations(&model, head, contacts)).join("; ");
            print_diagnostic(&format!("grasp {} is out of distribution: {violated}", head.grasp_id));
        }
        feature
    });
    stage::run(operator, "contacts", "feature", n_features, identity, encode)
}
