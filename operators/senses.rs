//! Adds the senses of an arm or a wrist to the frames of a hand.

use std::path::PathBuf;

use blindgrasp_messages::{FrameParts, Recorded, Senses, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use serde::Deserialize;

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

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let (hand, identity) = crate::contacts::hand_of(&params.hand)?;
    let max_items = TactileFrame::max_items(hand.joints.len(), hand.n_cells());
    let partner = operator.partner::<TactileFrame>("senses")?;
    let mut has_warned = false;
    let stage = stage::from_fn::<TactileFrame, TactileFrame, _>(move |head, items, merged| {
        let sample = partner.sample();
        let parts = sample.as_ref().map(|sample| sample.head.split(&sample.items)).transpose();
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
        TactileFrameHead { n_joints: 0, n_gravity: 0, n_wrench: 0, n_torques: 0, ..head }
    });
    stage::run(operator, "tactile", "tactile", max_items, identity, stage)
}

/// A frame with these senses in place of its own, where they are there. Torques of another number of joints are left out, and a
/// frame that cannot be read stays as it is.
fn with_senses(head: &TactileFrameHead, items: &[f64], other: Senses<'_>, merged: &mut Vec<f64>) -> TactileFrameHead {
    let Ok(FrameParts { joints_rad, senses: own, cells_newtons }) = head.split(items) else {
        merged.extend_from_slice(items);
        return *head;
    };
    let is_of_this_hand = other.joint_torques.len() == joints_rad.len();
    let senses = Senses {
        gravity_m_per_s2: first_given(other.gravity_m_per_s2, own.gravity_m_per_s2),
        wrist_wrench: first_given(other.wrist_wrench, own.wrist_wrench),
        joint_torques: if is_of_this_hand { other.joint_torques } else { own.joint_torques },
    };
    let lists = [joints_rad, senses.gravity_m_per_s2, senses.wrist_wrench, senses.joint_torques, cells_newtons];
    lists.iter().for_each(|list| merged.extend_from_slice(list));
    TactileFrameHead {
        n_gravity: senses.gravity_m_per_s2.len() as u32,
        n_wrench: senses.wrist_wrench.len() as u32,
        n_torques: senses.joint_torques.len() as u32,
        ..*head
    }
}

fn first_given<'a>(list: &'a [f64], otherwise: &'a [f64]) -> &'a [f64] {
    if list.is_empty() { otherwise } else { list }
}

#[cfg(test)]
mod tests {
    use blindgrasp_messages::{Header, Message, Phase};

    use super::*;

    fn frame(n_joints: usize, wrench: &[f64], gravity: &[f64], torques: &[f64]) -> TactileFrame {
        TactileFrame {
            grasp_id: 3,
            phase: Phase::Settled,
            joints_rad: vec![0.5; n_joints],
            cells_newtons: vec![1.0, 2.0, 3.0],
            gravity_m_per_s2: gravity.to_vec(),
            wrist_wrench: wrench.to_vec(),
            joint_torques: torques.to_vec(),
            day: 20261125,
        }
    }

    fn merged(frame: &TactileFrame, senses: Senses<'_>) -> TactileFrame {
        let (head, items) = frame.to_parts(Header::default());
        let mut merged = Vec::new();
        let head = with_senses(&head, &items, senses, &mut merged);
        TactileFrame::from_parts(&head, &merged).expect("a frame")
    }

    #[test]
    fn senses_of_the_other_source_replace_those_of_the_frame() {
        let (gravity, wrench) = ([0.0, 0.0, -9.8], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let plain = frame(2, &[], &[], &[]);
        let other = Senses { gravity_m_per_s2: &gravity, wrist_wrench: &wrench, joint_torques: &[7.0, 8.0] };
        assert_eq!(merged(&plain, other), frame(2, &wrench, &gravity, &[7.0, 8.0]));
        let of_its_own = frame(2, &[0.0; 6], &[], &[]);
        assert_eq!(merged(&of_its_own, other), frame(2, &wrench, &gravity, &[7.0, 8.0]));
    }

    #[test]
    fn senses_that_are_absent_or_do_not_fit_leave_the_frame_as_it_is() {
        let own = frame(2, &[0.5; 6], &[], &[1.0, 1.0]);
        assert_eq!(merged(&own, Senses::default()), own);
        assert_eq!(merged(&own, Senses { joint_torques: &[1.0, 2.0, 3.0], ..Senses::default() }), own);
    }
}
