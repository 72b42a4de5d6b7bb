//! Advises how to grasp again.

use std::path::PathBuf;

use blindgrasp_messages::{Fault, GraspFeature, GraspFeatureHead, Header, Message, Recorded, RegraspAdvice};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage, encode_state};
use blindgrasp_stages::model::Model;
use blindgrasp_stages::regrasp::{AdviceStage, AdviceState, Advisor, AdvisorOptions, Experience};
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    model: PathBuf,
    experience: PathBuf,
    settled: u32,
}

pub(crate) fn describe() -> OperatorDescription {
    OperatorDescription::new("regrasp", "Advises from experience how to grasp again")
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output(
            "advice",
            RegraspAdvice::TYPE_NAME,
            "One advice per grasp: where the palm should be next, the best proposal first",
        )
        .param("model", ParamKind::Path { must_exist: true }, None, "The model file that the features are of")
        .param(
            "experience",
            ParamKind::Path { must_exist: true },
            None,
            "Grasps that were lifted (blindgrasp train --experience), with the features of the same model",
        )
        .param(
            "settled",
            ParamKind::Integer { min: Some(1), max: Some(1000) },
            Some(3.into()),
            "The advice is from the mean of so many settled frames; of fewer if the grasp ends before",
        )
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let model = Model::load(&params.model)?;
    let experience = Experience::load(&params.experience)?;
    experience.check_model(&params.experience, &model)?;
    let n_joints = experience.grasps.first().map_or(0, |grasp| grasp.open_joints_rad.len());
    let advisor = Advisor::new(experience, AdvisorOptions::default());
    let stage = Regrasp {
        stage: AdviceStage::new(advisor, params.settled),
        last: Header::default(),
        n_advice: 0,
        advice: Vec::new(),
    };
    stage::run(operator, "feature", "advice", RegraspAdvice::max_items(n_joints), model.identity(), stage)
}

/// The stage, and the numbers of its answers, which the operator adds.
struct Regrasp {
    stage: AdviceStage,
    /// The header of the last feature, under which it answers.
    last: Header,
    n_advice: u64,
    advice: Vec<RegraspAdvice>,
}

impl Stage for Regrasp {
    type In = GraspFeature;
    type Out = RegraspAdvice;

    fn has_state(&self) -> bool {
        true
    }

    fn answer(&mut self, head: &GraspFeatureHead, values: &[f64], _: u64, answers: &mut Answers<RegraspAdvice>) {
        self.last = head.header;
        let feature = GraspFeature::from_parts(head, values).unwrap_or_else(|error| {
            tracing::warn!(seq = head.header.seq, "a feature cannot be read: {error}");
            // A robot may wait for the advice about this grasp all the same.
            GraspFeature { grasp_id: head.grasp_id, fault: Fault::Malformed, ..GraspFeature::default() }
        });
        self.stage.on_feature(&head.header, &feature, &mut self.advice);
        self.publish(answers);
    }

    fn on_end(&mut self, answers: &mut Answers<RegraspAdvice>) {
        self.advice.extend(self.stage.on_end());
        self.publish(answers);
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state((self.stage.state(), self.last, self.n_advice), bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.advice.clear();
        let (state, last, n_advice) = match state {
            Some(bytes) => bincode::serde::decode_from_slice(bytes, STATE_FORMAT)?.0,
            None => (AdviceState::default(), Header::default(), 0),
        };
        self.stage.restore(state);
        (self.last, self.n_advice) = (last, n_advice);
        Ok(())
    }
}

impl Regrasp {
    /// Answers under the header of the last feature, but with numbers that count the advice.
    fn publish(&mut self, answers: &mut Answers<RegraspAdvice>) {
        for advice in self.advice.drain(..) {
            let (head, items) = advice.to_parts(Header { seq: self.n_advice, ..self.last });
            self.n_advice += 1;
            answers.items().extend(items);
            answers.push(head);
        }
    }
}
