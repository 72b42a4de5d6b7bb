//! From the feature to a calibrated probability.

use std::path::PathBuf;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Phase, Prediction, PredictionHead, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage, encode_state};
use blindgrasp_stages::classifier::Verdict;
use blindgrasp_stages::day::GraspPlace;
use blindgrasp_stages::model::{Memory, Model};
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

/// Its state is the day's statistics.
pub(crate) fn describe_with_days() -> OperatorDescription {
    description("day_classifier", "As classifier, and judges a grasp by the earlier ones of its day")
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
    if model.day.is_some() {
        anyhow::bail!(
            "{}: the model judges a grasp by the earlier ones of its day, which this operator does not remember: expected \
             the operator day_classifier",
            params.model.display()
        );
    }
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let without_memory = Memory::default();
    let classify = stage::from_fn::<GraspFeature, Prediction, _>(move |head, values, _| {
        let (values, phase) = (checked(&model, dictionary_id, head, values), Phase::from_code(head.phase));
        let verdict = values.and_then(|values| model.classify(phase.unwrap_or_default(), values, 0, &without_memory));
        prediction(head, verdict)
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
    run_with_memory(operator, model)
}

pub(crate) fn work_with_days(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    if model.day.is_none() {
        anyhow::bail!(
            "{}: the model does not look at the day: expected one that was trained on recordings with days (blindgrasp import \
             --day), or the operator classifier",
            params.model.display()
        );
    }
    run_with_memory(operator, model)
}

fn run_with_memory(operator: &Operator, model: Model) -> anyhow::Result<()> {
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let stage = WithMemory { model, dictionary_id, memory: Memory::default() };
    stage::run(operator, "feature", "prediction", 0, identity, stage)
}

/// A classifier whose model judges a frame by earlier ones too: of the open grasp, or of the day.
struct WithMemory {
    model: Model,
    dictionary_id: u64,
    memory: Memory,
}

impl Stage for WithMemory {
    type In = GraspFeature;
    type Out = Prediction;
    const HAS_STATE: bool = true;

    fn answer(&mut self, head: &GraspFeatureHead, values: &[f64], _now_nanos: u64, answers: &mut Answers<Prediction>) {
        let place = GraspPlace { epoch: head.header.epoch, grasp_id: head.grasp_id, day: head.day };
        let values = checked(&self.model, self.dictionary_id, head, values);
        let verdict = Phase::from_code(head.phase)
            .map_err(|_| Fault::Malformed)
            .and_then(|phase| self.model.judge(&mut self.memory, self.dictionary_id, place, phase, values));
        answers.push(prediction(head, verdict));
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state(&self.memory, bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.memory = match state {
            Some(bytes) => bincode::serde::decode_from_slice(bytes, STATE_FORMAT)?.0,
            None => Memory::default(),
        };
        Ok(())
    }
}

/// The values of a feature that the model can judge.
fn checked<'a>(
    model: &Model,
    dictionary_id: u64,
    head: &GraspFeatureHead,
    values: &'a [f64],
) -> Result<&'a [f64], Fault> {
    match Fault::from_code(head.fault) {
        Err(_) => Err(Fault::Malformed),
        _ if Phase::from_code(head.phase).is_err() => Err(Fault::Malformed),
        _ if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
        _ if head.dictionary_id != dictionary_id => Err(Fault::WrongModel),
        Ok(Fault::None) => Ok(values),
        Ok(fault) => Err(fault),
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
