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
        let place = GraspPlace { epoch: head.header.epoch, grasp_id: head.grasp_id, day: head.day };
        let values = checked(&self.model, self.dictionary_id, head, values);
        let verdict = Phase::from_code(head.phase)
            .map_err(|_| Fault::Malformed)
            .and_then(|phase| self.model.judge(&mut self.memory, self.dictionary_id, place, phase, values));
        answers.push(prediction(head, verdict));
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
