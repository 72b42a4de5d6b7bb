//! From tactile frames to contacts in the palm frame.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use blindgrasp_messages::{Contact, ContactSet, Fault, FrameParts, Phase, Recorded, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::stage::{self, Answers, Stage, decode_state, encode_state};
use blindgrasp_stages::contacts::ContactSummary;
use blindgrasp_stages::day::GraspPlace;
use blindgrasp_stages::frozen_skin::FrozenSkin;
use blindgrasp_stages::glitches::GlitchFilter;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::sensors::{Described, SensorCheck, SensorFault, SensorMemory};
use blindgrasp_stages::steps::{ContactMemory, contact_set, explain_fault, find_contacts};
use serde::Deserialize;

use crate::beginning::FileNode;

/// The shortest time between two lines about faulty frames.
const LOG_PAUSE_NANOS: u64 = 1_000_000_000;

#[derive(Deserialize)]
struct Params {
    hand: PathBuf,
    sensors: Option<PathBuf>,
}

pub(crate) fn describe() -> OperatorDescription {
    OperatorDescription::new("contacts", "Finds the active cells and where they are in the palm frame")
        .answers_each()
        .input("tactile", TactileFrame::TYPE_NAME, "Frames of the hand")
        .output("contacts", ContactSet::TYPE_NAME, "The contacts of each frame")
        .param("hand", ParamKind::Path { must_exist: true }, None, "The hand's pad layout (YAML)")
        .optional_param(
            "sensors",
            ParamKind::Path { must_exist: true },
            "The sensor check (blindgrasp sensors learn): frames are faulty while it finds that joints or cells are",
        )
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let (hand, mut identity, check) = files_of(&operator.params()?)?;
    let mut watch = None;
    if let Some(check) = check {
        identity.insert("sensors".into(), format!("{:016x}", check.id()));
        let (memory, reported) = (SensorMemory::default(), Reported::default());
        watch = Some(Watch { operator: operator.clone(), check, memory, reported });
    }
    let max_contacts = hand.n_cells();
    let (memory, faults, odd) = Default::default();
    let stage = FindContacts { hand, memory, watch, faults, odd };
    stage::run(operator, "tactile", "contacts", max_contacts, identity, stage)
}

/// The mistakes with which [`work`] would fail at once.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    files_of(&parse_params(&node.params)?).map(drop)
}

/// The hand, its identity, and the sensor check.
fn files_of(params: &Params) -> anyhow::Result<(Hand, BTreeMap<String, String>, Option<SensorCheck>)> {
    let (hand, identity) = hand_of(&params.hand)?;
    let check = params.sensors.as_ref().map(|sensors| SensorCheck::load(sensors, &hand)).transpose()?;
    Ok((hand, identity, check))
}

pub(crate) fn hand_of(path: &Path) -> anyhow::Result<(Hand, BTreeMap<String, String>)> {
    let hand = Hand::load(path)?;
    hand.warnings().iter().for_each(|warning| tracing::warn!("{warning}"));
    let identity = BTreeMap::from([("hand".into(), format!("{:016x}", hand.id()))]);
    Ok((hand, identity))
}

struct FindContacts {
    hand: Hand,
    memory: ContactMemory,
    /// The watch over the sensors, which remembers their readings.
    watch: Option<Watch>,
    faults: GraspLog,
    odd: GraspLog,
}

/// Tells the faults of grasps without filling the log: each sentence of a grasp once, and those of one grasp in a second. The next
/// line has the number of the grasps that were left out.
#[derive(Default)]
struct GraspLog {
    /// The last grasp with a fault, whether its sentences are told, and those that have been, without their numbers.
    grasp: Option<u64>,
    is_told: bool,
    told: BTreeSet<String>,
    due_nanos: u64,
    n_more: u64,
}

/// The state that is saved: of the filter and of the watch, as far as there are any, and what shows that the skin has stopped.
type State = (Option<GlitchFilter>, FrozenSkin, Option<(SensorMemory, Option<GraspPlace>, BTreeMap<String, u64>)>);

/// Finds faulty sensors.
struct Watch {
    operator: Operator,
    check: SensorCheck,
    memory: SensorMemory,
    reported: Reported,
}

/// The faults that were reported. The last grasp with one and the counts are a part of the state.
#[derive(Default)]
struct Reported {
    fault: Option<SensorFault>,
    grasp: Option<GraspPlace>,
    /// Grasps with a fault, by fault and part.
    counts: BTreeMap<String, u64>,
    /// The launcher does not know the counts yet.
    has_counted: bool,
}

impl GraspLog {
    /// The lines to be printed of a grasp of which this has been found so far.
    fn lines(&mut self, grasp_id: u64, found: &[String], now_nanos: u64) -> Vec<String> {
        if self.grasp != Some(grasp_id) && !found.is_empty() {
            self.grasp = Some(grasp_id);
            self.told.clear();
            self.is_told = now_nanos >= self.due_nanos;
            if self.is_told {
                self.due_nanos = now_nanos + LOG_PAUSE_NANOS;
            } else {
                self.n_more += 1;
            }
        }
        let mut lines = Vec::new();
        if self.is_told && self.grasp == Some(grasp_id) {
            for sentence in found {
                let words = sentence.split(' ').filter(|word| !word.starts_with(|char: char| char.is_ascii_digit()));
                if !self.told.insert(words.collect()) {
                    continue;
                }
                let before = match std::mem::take(&mut self.n_more) {
                    0 => String::new(),
                    n_more => format!("; of {n_more} grasps before it nothing was said"),
                };
                lines.push(format!("grasp {grasp_id}: {sentence}{before}"));
            }
        }
        lines
    }
}

impl Watch {
    /// Whether the sensors are faulty at this frame.
    fn finds_fault(
        &mut self,
        hand: &Hand,
        head: &TactileFrameHead,
        phase: Phase,
        parts: &FrameParts<'_>,
        contacts: &[Contact],
    ) -> bool {
        let place = GraspPlace { epoch: head.header.epoch, grasp_id: head.grasp_id, day: head.day };
        let readings = (parts.joints, parts.cells_newtons);
        let fault = self.check.watch(hand, &mut self.memory, (place, phase), readings, contacts);
        self.report(hand, fault, place);
        fault.is_some()
    }

    /// Says a fault once when it is found and once when it is over, and counts the grasps that it holds.
    fn report(&mut self, hand: &Hand, fault: Option<SensorFault>, place: GraspPlace) {
        let reported = &mut self.reported;
        if reported.fault != fault {
            match fault {
                Some(fault) => tracing::warn!("{}; grasps are held until it works again", Described(fault, hand)),
                None => tracing::info!("the sensors read as those of a healthy hand again"),
            }
            reported.fault = fault;
        }
        if let Some(fault) = fault
            && reported.grasp != Some(place)
        {
            reported.grasp = Some(place);
            let name = format!("sensor_fault/{}/{}", fault.kind(), fault.part(hand));
            *reported.counts.entry(name).or_default() += 1;
            reported.has_counted = true;
        }
    }
}

impl Stage for FindContacts {
    type In = TactileFrame;
    type Out = ContactSet;

    fn has_state(&self) -> bool {
        true
    }

    fn answer(&mut self, head: &TactileFrameHead, items: &[f64], now_nanos: u64, answers: &mut Answers<ContactSet>) {
        let (mut summary, parts) = find_contacts(&self.hand, &mut self.memory, head, items, answers.items());
        // A hand that closes may have no contact yet.
        let is_at_rest = Phase::from_code(head.phase).is_ok_and(Phase::decides);
        if is_at_rest || summary.fault == Fault::SensorFault {
            let found = self.memory.odd_readings(&self.hand, head.grasp_id);
            self.odd.lines(head.grasp_id, &found, now_nanos).iter().for_each(|line| print_diagnostic(line));
        }
        if self.faults.grasp != Some(head.grasp_id)
            && Phase::from_code(head.phase).is_ok_and(|phase| !phase.is_over())
            && (is_at_rest || summary.fault != Fault::NoContact)
            && let Some(why) = explain_fault(&self.hand, &self.memory.finder, &summary, parts.as_ref())
        {
            let found = [format!("a frame cannot be judged: {why}")];
            self.faults.lines(head.grasp_id, &found, now_nanos).iter().for_each(|line| print_diagnostic(line));
        }
        let phase = Phase::from_code(head.phase).ok().filter(|phase| !phase.is_over());
        if let (Some(watch), Some(parts), Some(phase)) = (&mut self.watch, &parts, phase)
            && matches!(summary.fault, Fault::None | Fault::NoContact)
            && watch.finds_fault(&self.hand, head, phase, parts, answers.items())
        {
            summary = ContactSummary { fault: Fault::SensorFault, ..ContactSummary::default() };
            answers.items().clear();
        }
        answers.push(contact_set(&self.hand, head, summary, parts.as_ref()));
    }

    fn look(&mut self) {
        if let Some(watch) = &mut self.watch
            && std::mem::take(&mut watch.reported.has_counted)
        {
            watch.operator.has_counted_in_all(watch.reported.counts.clone());
        }
    }

    fn state(&self, bytes: &mut Vec<u8>) -> anyhow::Result<()> {
        let filter = self.hand.median_filter.then_some(&self.memory.filter);
        let watch =
            self.watch.as_ref().map(|Watch { memory, reported, .. }| (memory, reported.grasp, &reported.counts));
        encode_state("contacts", (filter, &self.memory.frozen, watch), bytes)
    }

    fn restore(&mut self, state: Option<&[u8]>) -> anyhow::Result<bool> {
        let saved: State = match state {
            Some(bytes) => decode_state("contacts", bytes)?,
            None => Default::default(),
        };
        self.memory.filter = saved.0.unwrap_or_default();
        self.memory.frozen = saved.1;
        if let Some(watch) = &mut self.watch {
            (watch.memory, watch.reported.grasp, watch.reported.counts) = saved.2.unwrap_or_default();
        }
        Ok(state.is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_sentence_is_a_line_and_grasps_within_a_second_are_counted() {
        let mut log = GraspLog::default();
        let said = |sentences: &[&str]| sentences.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
        assert_eq!(log.lines(7, &[], 5), [""; 0]);
        assert_eq!(log.lines(7, &said(&["late"]), 5), ["grasp 7: late"]);
        assert_eq!(log.lines(7, &said(&["late", "dead"]), 6), ["grasp 7: dead"]);
        for grasp_id in [8, 8, 9, 7] {
            assert_eq!(log.lines(grasp_id, &said(&["late"]), LOG_PAUSE_NANOS), [""; 0]);
        }
        let line = "grasp 10: late; of 3 grasps before it nothing was said";
        assert_eq!(log.lines(10, &said(&["late"]), LOG_PAUSE_NANOS + 5), [line]);
    }
}
