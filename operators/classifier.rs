//! From the feature to a calibrated probability.

use std::path::PathBuf;

use blindgrasp_messages::{GraspFeature, GraspFeatureHead, Prediction, Recorded};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage, encode_state};
use blindgrasp_stages::model::{Memory, Model};
use blindgrasp_stages::steps;
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
    let classify = stage::from_fn::<GraspFeature, Prediction, _>(move |head, values, _| {
        // It judges each frame alone.
        steps::classify(&model, dictionary_id, &mut Memory::default(), head, values)
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
        answers.push(steps::classify(&self.model, self.dictionary_id, &mut self.memory, head, values));
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
