//! From the feature to a calibrated probability.

use std::path::PathBuf;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Phase, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage};
use blindgrasp_stages::classifier::Verdict;
use blindgrasp_stages::model::Model;
use blindgrasp_stages::probe::GraspHistory;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    let summary = "Predicts from each frame's feature whether the grasp is stable";
    description("classifier", summary).answers_each()
}

/// It is an operator of its own because it has a state: other nodes do not rely on answers that depend on one sample alone.
pub(crate) fn describe_with_probes() -> OperatorDescription {
    description("probe_classifier", "As classifier, and predicts after a probe what the lift will come to")
}

fn description(name: &str, summary: &str) -> OperatorDescription {
    OperatorDescription::new(name, summary)
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .param("model", ParamKind::Path { must_exist: true }, None, "The model file")
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let without_history = GraspHistory::default();
    let classify = stage::from_fn::<GraspFeature, Prediction, _>(move |head, values, _| {
        prediction(head, classify(&model, dictionary_id, head, values, &without_history))
    });
    stage::run(operator, "feature", "prediction", 0, identity, classify)
}

pub(crate) fn work_with_probes(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    if !model.has_probes() {
        anyhow::bail!(
            "{}: the model judges no probes: expected one of lifts with probes (blindgrasp train), or the operator classifier",
            params.model.display()
        );
    }
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let stage = WithHistory { model, dictionary_id, history: GraspHistory::default() };
    stage::run(operator, "feature", "prediction", 0, identity, stage)
}

/// A classifier whose model judges probes, for which it remembers the features of the open grasp.
struct WithHistory {
    model: Model,
    dictionary_id: u64,
    history: GraspHistory,
}

impl Stage for WithHistory {
    type In = GraspFeature;
    type Out = Prediction;
    const HAS_STATE: bool = true;

    fn answer(&mut self, head: &GraspFeatureHead, values: &[f64], _now_nanos: u64, answers: &mut Answers<Prediction>) {
        let verdict = classify(&self.model, self.dictionary_id, head, values, &self.history);
        if let Ok(phase) = Phase::from_code(head.phase) {
            // A frame that is at fault leaves no feature behind.
            let values = if verdict.is_ok() { values } else { &[] };
            self.model.remember(&mut self.history, (head.header.epoch, head.grasp_id), phase, values);
        }
        answers.push(prediction(head, verdict));
    }

    fn state(&self) -> anyhow::Result<Vec<u8>> {
        Ok(bincode::serde::encode_to_vec(&self.history, STATE_FORMAT)?)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.history = match state {
            Some(bytes) => bincode::serde::decode_from_slice(bytes, STATE_FORMAT)?.0,
            None => GraspHistory::default(),
        };
        Ok(())
    }
}

fn classify(
    model: &Model,
    dictionary_id: u64,
    head: &GraspFeatureHead,
    values: &[f64],
    history: &GraspHistory,
) -> Result<Verdict, Fault> {
    match (Fault::from_code(head.fault), Phase::from_code(head.phase)) {
        (Err(_), _) | (_, Err(_)) => Err(Fault::Malformed),
        _ if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
        _ if head.dictionary_id != dictionary_id => Err(Fault::WrongModel),
        (Ok(Fault::None), Ok(phase)) => model.classify(phase, values, history),
        (Ok(fault), _) => Err(fault),
    }
}

fn prediction(head: &GraspFeatureHead, verdict: Result<Verdict, Fault>) -> PredictionHead {
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
}
