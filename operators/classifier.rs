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
    OperatorDescription::new("classifier", "Predicts from each frame's feature whether the grasp is stable")
        .answers_each()
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("prediction", Prediction::TYPE_NAME, "The prediction for each frame")
        .param(
            "model",
            ParamKind::Path { must_exist: true },
            None,
            "The model file. It says what is judged: settled grasps, and with a memory of earlier frames also probes, and grasps \
             by the earlier ones of their day",
        )
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let (identity, dictionary_id) = (model.identity(), model.dictionary_id());
    let classify = Classify { model, dictionary_id, memory: Memory::default() };
    stage::run(operator, "feature", "prediction", 0, identity, classify)
}

struct Classify {
    model: Model,
    dictionary_id: u64,
    /// Earlier frames of the open grasp, or of the day. It stays empty if the model judges each frame alone.
    memory: Memory,
}

impl Stage for Classify {
    type In = GraspFeature;
    type Out = Prediction;

    fn has_state(&self) -> bool {
        self.model.has_memory()
    }

    fn answer(&mut self, head: &GraspFeatureHead, values: &[f64], _now_nanos: u64, answers: &mut Answers<Prediction>) {
        answers.push(steps::classify(&self.model, self.dictionary_id, &mut self.memory, head, values));
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state((self.dictionary_id, &self.memory), bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.memory = Memory::default();
        if let Some(bytes) = state {
            let ((dictionary_id, memory), _) =
                bincode::serde::decode_from_slice::<(u64, Memory), _>(bytes, STATE_FORMAT)?;
            // Features of another model say nothing to this one.
            if dictionary_id == self.dictionary_id {
                self.memory = memory;
            }
        }
        Ok(())
    }
}
