//! An operator of one's own that needs no experience: it proposes the same for every grasp.
//!
//! Wire it in by its path (`run: ./target/release/examples/fixed_adviser`) between `encoder` and the hand's `advice`. The
//! tests use it to see that the hand follows proposals, and how it behaves without any.

use std::collections::BTreeMap;
use std::process::ExitCode;

use anyhow::Context;
use blindgrasp_messages::{GraspFeature, GraspFeatureHead, Header, Message, Phase, Recorded, RegraspAdvice};
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage, encode_state};
use blindgrasp_operator::{Operator, OperatorDescription, ParamKind, run};
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    proposals: String,
    is_silent: bool,
}

fn main() -> ExitCode {
    let description = OperatorDescription::new("fixed_adviser", "Proposes the same for every grasp, at its end")
        .input("feature", GraspFeature::TYPE_NAME, "The feature of each frame")
        .output("advice", RegraspAdvice::TYPE_NAME, "One for each grasp")
        .param("proposals", ParamKind::String {}, Some("[]".into()), "The proposals as JSON, the best one first")
        .param("is_silent", ParamKind::Boolean {}, Some(false.into()), "Says nothing at all");
    run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let Params { proposals, is_silent } = operator.params()?;
    let proposals = serde_json::from_str(&proposals).with_context(|| format!("proposals: '{proposals}'"))?;
    let advice = RegraspAdvice { grasp_id: 0, proposals };
    advice.check()?;
    let n_joints = advice.proposals.first().map_or(0, |proposal| proposal.open_joints_rad.len());
    let max_items = RegraspAdvice::max_items(n_joints);
    stage::run(operator, "feature", "advice", max_items, BTreeMap::new(), Adviser { advice, is_silent, n_advices: 0 })
}

struct Adviser {
    advice: RegraspAdvice,
    is_silent: bool,
    n_advices: u64,
}

impl Stage for Adviser {
    type In = GraspFeature;
    type Out = RegraspAdvice;

    fn has_state(&self) -> bool {
        true
    }

    fn answer(&mut self, head: &GraspFeatureHead, _values: &[f64], _now: u64, answers: &mut Answers<RegraspAdvice>) {
        if head.phase != Phase::Ended.code() || self.is_silent {
            return;
        }
        self.advice.grasp_id = head.grasp_id;
        let (head, items) = self.advice.to_parts(Header { seq: self.n_advices, ..head.header });
        self.n_advices += 1;
        answers.items().extend(items);
        answers.push(head);
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state(self.n_advices, bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.n_advices = match state {
            Some(bytes) => bincode::serde::decode_from_slice(bytes, STATE_FORMAT)?.0,
            None => 0,
        };
        Ok(())
    }
}
