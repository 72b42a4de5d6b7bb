//! From tactile frames to contacts in the palm frame.

use std::collections::BTreeMap;
use std::path::PathBuf;

use blindgrasp_messages::{ContactSet, ContactSetHead, Fault, FrameParts, Header, Recorded, Senses, TactileFrame};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage;
use blindgrasp_stages::contacts::{ContactSummary, contacts_from_frame};
use blindgrasp_stages::hand::Hand;
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    hand: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    OperatorDescription::new("contacts", "Finds the active cells and where they are in the palm frame")
        .answers_each()
        .input("tactile", TactileFrame::TYPE_NAME, "Frames of the hand")
        .output("contacts", ContactSet::TYPE_NAME, "The contacts of each frame")
        .param("hand", ParamKind::Path { must_exist: true }, None, "The hand's pad layout (YAML)")
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let hand = Hand::load(&params.hand)?;
    let hand_id = hand.id();
    hand.warnings().iter().for_each(|warning| tracing::warn!("{warning}"));
    let identity = BTreeMap::from([("hand".into(), format!("{hand_id:016x}"))]);
    let max_contacts = hand.n_cells();
    let find = stage::from_fn::<TactileFrame, ContactSet, _>(move |head, items, contacts| {
        let (summary, joints_rad, senses) = match head.split(items) {
            Ok(FrameParts { joints_rad, senses, cells_newtons }) => {
                let summary = contacts_from_frame(&hand, head.header.hand_id, joints_rad, cells_newtons, contacts);
                (summary, joints_rad, senses)
            }
            Err(_) => {
                (ContactSummary { fault: Fault::Malformed, ..ContactSummary::default() }, &[][..], Senses::default())
            }
        };
        ContactSetHead {
            header: Header { hand_id, ..head.header },
            grasp_id: head.grasp_id,
            phase: head.phase,
            n_pads_in_contact: summary.n_pads_in_contact,
            self_collision: summary.self_collision.into(),
            n_self_contacts: summary.n_self_contacts,
            fault: summary.fault.code(),
            day: head.day,
            ..ContactSetHead::default()
        }
        .with_joints(joints_rad)
        .with_senses(&senses)
    });
    stage::run(operator, "tactile", "contacts", max_contacts, identity, find)
}
