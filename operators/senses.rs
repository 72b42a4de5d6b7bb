//! Adds the senses of an arm or a wrist to the frames of a hand.

use std::path::PathBuf;

use blindgrasp_messages::{FrameParts, Recorded, Sense, Senses, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use serde::Deserialize;

use crate::beginning::FileNode;

#[derive(Deserialize)]
struct Params {
    hand: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    OperatorDescription::new("senses", "Adds gravity, the wrist's wrench and joint torques of another source to frames")
        .input("tactile", TactileFrame::TYPE_NAME, "The hand's readings")
        .partner_input(
            "senses",
            TactileFrame::TYPE_NAME,
            "Frames of which only the senses count, such as those of a wrist",
        )
        .output("tactile", TactileFrame::TYPE_NAME, "The hand's readings, each with the senses nearest in time")
        .param("hand", ParamKind::Path { must_exist: true }, None, "The hand file")
        .answers_each()
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    let params: Params = parse_params(&node.params)?;
    crate::contacts::hand_of(&params.hand).map(drop)
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let (hand, identity) = crate::contacts::hand_of(&params.hand)?;
    let max_items = TactileFrame::max_items(hand.joints.len(), hand.n_cells());
    let partner = operator.partner::<TactileFrame>("senses")?;
    let mut has_warned = false;
    let stage = stage::from_fn::<TactileFrame, TactileFrame, _>(move |head, items, merged| {
        let sample = partner.sample();
        let parts = sample.as_ref().map(|sample| sample.head().split(sample.items())).transpose();
        if let Err(error) = &parts
            && !std::mem::replace(&mut has_warned, true)
        {
            tracing::warn!("a frame of the input 'senses' cannot be read, and its senses are left out: {error}");
        }
        let other = parts.ok().flatten().map_or(Senses::default(), |parts| parts.senses);
        let head = with_senses(head, items, other, merged);
        if merged.len() <= max_items {
            return head;
        }
        // It is of another hand, and its reader says so.
        merged.clear();
        TactileFrameHead { n_joints: 0, has_senses: 0, ..head }
    });
    stage::run(operator, "tactile", "tactile", max_items, identity, stage)
}

/// A frame with these senses in place of its own, where they are there. Senses of another number of joints are left out, and
/// a frame that cannot be read stays as it is.
fn with_senses(head: &TactileFrameHead, items: &[f64], other: Senses<'_>, merged: &mut Vec<f64>) -> TactileFrameHead {
    let Ok(FrameParts { joints, senses: own, cells_newtons }) = head.split(items) else {
        merged.extend_from_slice(items);
        return *head;
    };
    let n_joints = joints.len();
    let mut has_senses = 0;
    merged.extend_from_slice(joints);
    for sense in Sense::ALL {
        let is_there = !other.get(sense).is_empty() && other.get(sense).len() == sense.len(n_joints);
        let values = if is_there { other.get(sense) } else { own.get(sense) };
        if !values.is_empty() {
            has_senses |= sense.bit();
        }
        merged.extend_from_slice(values);
    }
    merged.extend_from_slice(cells_newtons);
    TactileFrameHead { has_senses, ..*head }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Header, Message, OwnedSenses, Phase};

    use super::*;

    const GRAVITY: [f64; 3] = [0.0, 0.0, -9.8];
    const WRENCH: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

    fn frame(senses: OwnedSenses) -> TactileFrame {
        TactileFrame {
            grasp_id: 3,
            phase: Phase::Settled,
            joints: vec![0.5; 2],
            cells_newtons: vec![1.0, 2.0, 3.0],
            senses,
            day: 20261125,
        }
    }

    /// Gravity, a wrench and these torques.
    fn senses(torques: &[f64]) -> OwnedSenses {
        OwnedSenses::default()
            .with(Sense::Gravity, &GRAVITY)
            .with(Sense::WristWrench, &WRENCH)
            .with(Sense::JointTorques, torques)
    }

    fn merged(frame: &TactileFrame, senses: Senses<'_>) -> TactileFrame {
        let (head, items) = frame.to_parts(Header::default());
        let mut merged = Vec::new();
        let head = with_senses(&head, &items, senses, &mut merged);
        TactileFrame::from_parts(&head, &merged).expect("a frame")
    }

    #[test]
    fn senses_of_the_other_source_replace_those_of_the_frame() {
        let other = senses(&[7.0, 8.0]);
        assert_eq!(merged(&frame(OwnedSenses::default()), other.view()), frame(other.clone()));
        let own = OwnedSenses::default().with(Sense::WristWrench, &[0.0; 6]);
        assert_eq!(merged(&frame(own), other.view()), frame(other));
    }

    #[test]
    fn senses_that_are_absent_or_do_not_fit_leave_the_frame_as_it_is() {
        let own = OwnedSenses::default().with(Sense::WristWrench, &[0.5; 6]).with(Sense::JointTorques, &[1.0, 1.0]);
        let own = frame(own);
        assert_eq!(merged(&own, Senses::default()), own);
        let other = OwnedSenses::default().with(Sense::JointTorques, &[1.0, 2.0, 3.0]);
        assert_eq!(merged(&own, other.view()), own);
    }
}
