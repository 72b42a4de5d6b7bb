//! From tactile frames to contacts in the palm frame.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use blindgrasp_messages::{ContactSet, Fault, Phase, Recorded, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::Operator;
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, STATE_FORMAT, Stage, encode_state};
use blindgrasp_stages::contacts::{ContactFinder, ContactSummary};
use blindgrasp_stages::day::GraspPlace;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::sensors::{Described, SensorCheck, SensorFault, SensorMemory};
use blindgrasp_stages::steps::{contact_set, find_contacts};
use serde::Deserialize;

#[derive(Deserialize)]
struct Params {
    hand: PathBuf,
}

#[derive(Deserialize)]
struct CheckedParams {
    hand: PathBuf,
    sensors: PathBuf,
}

pub(crate) fn describe() -> OperatorDescription {
    description("contacts", "Finds the active cells and where they are in the palm frame").answers_each()
}

pub(crate) fn describe_checked() -> OperatorDescription {
    description("checked_contacts", "As contacts, and holds while joints or cells are faulty").param(
        "sensors",
        ParamKind::Path { must_exist: true },
        None,
        "The sensor check (blindgrasp sensors learn)",
    )
}

fn description(name: &str, summary: &str) -> OperatorDescription {
    OperatorDescription::new(name, summary)
        .input("tactile", TactileFrame::TYPE_NAME, "Frames of the hand")
        .output("contacts", ContactSet::TYPE_NAME, "The contacts of each frame")
        .param("hand", ParamKind::Path { must_exist: true }, None, "The hand's pad layout (YAML)")
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let (hand, identity) = hand_of(&params.hand)?;
    let (hand_id, max_contacts) = (hand.id(), hand.n_cells());
    let mut finder = ContactFinder::default();
    let find = stage::from_fn::<TactileFrame, ContactSet, _>(move |head, items, contacts| {
        let (summary, parts) = find_contacts(&hand, &mut finder, head, items, contacts);
        contact_set(head, hand_id, summary, parts.as_ref())
    });
    stage::run(operator, "tactile", "contacts", max_contacts, identity, find)
}

pub(crate) fn work_checked(operator: &Operator) -> anyhow::Result<()> {
    let params: CheckedParams = operator.params()?;
    let (hand, mut identity) = hand_of(&params.hand)?;
    let check = SensorCheck::load(&params.sensors, &hand)?;
    identity.insert("sensors".into(), format!("{:016x}", check.id()));
    let max_contacts = hand.n_cells();
    let finder = ContactFinder::default();
    let (memory, reported) = (SensorMemory::default(), Reported::default());
    let stage = Checked { operator: operator.clone(), hand, finder, check, memory, reported };
    stage::run(operator, "tactile", "contacts", max_contacts, identity, stage)
}

pub(crate) fn hand_of(path: &Path) -> anyhow::Result<(Hand, BTreeMap<String, String>)> {
    let hand = Hand::load(path)?;
    hand.warnings().iter().for_each(|warning| tracing::warn!("{warning}"));
    let identity = BTreeMap::from([("hand".into(), format!("{:016x}", hand.id()))]);
    Ok((hand, identity))
}

/// Contacts of a hand whose sensors are watched.
struct Checked {
    operator: Operator,
    hand: Hand,
    finder: ContactFinder,
    check: SensorCheck,
    memory: SensorMemory,
    reported: Reported,
}

/// What this instance has said of faults.
#[derive(Default)]
struct Reported {
    fault: Option<SensorFault>,
    grasp: Option<GraspPlace>,
    /// Grasps with a fault, by fault and part.
    counts: BTreeMap<String, u64>,
    /// The launcher does not know the counts yet.
    has_counted: bool,
}

impl Checked {
    /// Says a fault once when it is found and once when it is over, and counts the grasps that it holds.
    fn report(&mut self, fault: Option<SensorFault>, place: GraspPlace) {
        let reported = &mut self.reported;
        if reported.fault != fault {
            match fault {
                Some(fault) => tracing::warn!("{}; grasps are held until it works again", Described(fault, &self.hand)),
                None => tracing::info!("the sensors read as those of a healthy hand again"),
            }
            reported.fault = fault;
        }
        if let Some(fault) = fault
            && reported.grasp != Some(place)
        {
            reported.grasp = Some(place);
            let name = format!("sensor_fault/{}/{}", fault.kind(), fault.part(&self.hand));
            *reported.counts.entry(name).or_default() += 1;
            reported.has_counted = true;
        }
    }
}

impl Stage for Checked {
    type In = TactileFrame;
    type Out = ContactSet;
    const HAS_STATE: bool = true;

    fn answer(&mut self, head: &TactileFrameHead, items: &[f64], _now_nanos: u64, answers: &mut Answers<ContactSet>) {
        let (mut summary, parts) = find_contacts(&self.hand, &mut self.finder, head, items, answers.items());
        let phase = Phase::from_code(head.phase).ok().filter(|phase| !phase.is_over());
        if let (Some(parts), Some(phase), Fault::None | Fault::NoContact) = (&parts, phase, summary.fault) {
            let place = GraspPlace { epoch: head.header.epoch, grasp_id: head.grasp_id, day: head.day };
            let readings = (parts.joints_rad, parts.cells_newtons);
            let found = self.check.watch(&self.hand, &mut self.memory, (place, phase), readings, answers.items());
            self.report(found, place);
            if found.is_some() {
                summary = ContactSummary { fault: Fault::SensorFault, ..ContactSummary::default() };
                answers.items().clear();
            }
        }
        answers.push(contact_set(head, self.hand.id(), summary, parts.as_ref()));
    }

    fn look(&mut self) {
        if std::mem::take(&mut self.reported.has_counted) {
            self.operator.has_counted(self.reported.counts.clone());
        }
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        encode_state(&self.memory, bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<()> {
        self.memory = match state {
            Some(bytes) => bincode::serde::decode_from_slice(bytes, STATE_FORMAT)?.0,
            None => SensorMemory::default(),
        };
        Ok(())
    }
}
