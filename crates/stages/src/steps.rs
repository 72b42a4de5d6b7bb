//! The steps from a frame to its prediction, each from the message before it: the operators `contacts`, `encoder` and
//! `classifier` of a graph take them one by one, and [`Judge`](crate::Judge) takes them all.
//!
//! Messages may come from another process. A step that cannot use its message answers with the fault.

use blindgrasp_messages::{
    Contact, ContactSetHead, Fault, FrameParts, GraspFeatureHead, Header, Phase, PredictionHead, Senses,
    TactileFrameHead,
};

use crate::contacts::{ContactFinder, ContactSummary, clip_to_limits, invalid_reading};
use crate::day::GraspPlace;
use crate::encoder::FeltReading;
use crate::frozen_skin::FrozenSkin;
use crate::glitches::GlitchFilter;
use crate::hand::Hand;
use crate::model::{Memory, Model};
use crate::odd_readings::OddReadings;
use crate::out_of_distribution::Violation;

/// What the contacts step keeps of the frames before.
#[derive(Debug, Default)]
pub struct ContactMemory {
    pub finder: ContactFinder,
    /// These are saved with the state of a graph's contacts stage.
    pub filter: GlitchFilter,
    pub frozen: FrozenSkin,
    odd: OddReadings,
}

impl ContactMemory {
    /// The readings of a grasp that a healthy hand does not give, a sentence each; none if the last frame is of another grasp.
    pub fn odd_readings(&self, hand: &Hand, grasp_id: u64) -> Vec<String> {
        let mut said = self.odd.said(hand, grasp_id);
        said.extend(self.filter.flicker(hand, grasp_id));
        said.extend(self.frozen.said(grasp_id));
        said
    }
}

/// Finds the contacts of a frame. It also returns the frame's parts, if they can be read.
pub fn find_contacts<'a>(
    hand: &Hand,
    memory: &mut ContactMemory,
    head: &TactileFrameHead,
    items: &'a [f64],
    contacts: &mut Vec<Contact>,
) -> (ContactSummary, Option<FrameParts<'a>>) {
    match head.split(items) {
        Ok(parts) => {
            let FrameParts { joints, cells_newtons, .. } = parts;
            let place = (head.header.epoch, head.grasp_id);
            let phase = Phase::from_code(head.phase);
            let steady = match phase {
                Ok(phase) => memory.filter.steady(hand, place, phase, cells_newtons),
                Err(_) => cells_newtons,
            };
            let mut summary = memory.finder.find(hand, head.header.hand_id, joints, steady, contacts);
            if let (Ok(phase), Fault::None | Fault::NoContact) = (phase, summary.fault) {
                memory.odd.note(hand, place, phase, (joints, cells_newtons), contacts);
                if !phase.is_over() && memory.frozen.note(place, phase, cells_newtons, summary.fault == Fault::None) {
                    summary = ContactSummary { fault: Fault::SensorFault, ..ContactSummary::default() };
                    contacts.clear();
                }
            }
            (summary, Some(parts))
        }
        Err(_) => {
            contacts.clear();
            (ContactSummary { fault: Fault::Malformed, ..ContactSummary::default() }, None)
        }
    }
}

/// The cause of the fault in the frame that [`find_contacts`] has just read, for people: joint, cell or links by their names.
pub fn explain_fault(
    hand: &Hand,
    finder: &ContactFinder,
    summary: &ContactSummary,
    parts: Option<&FrameParts<'_>>,
) -> Option<String> {
    let FrameParts { joints, cells_newtons, .. } = parts?;
    match summary.fault {
        Fault::WrongLength | Fault::InvalidValue => invalid_reading(hand, joints, cells_newtons),
        Fault::NoContact => finder.no_contact(hand, cells_newtons),
        _ => None,
    }
}

/// The head of the contacts that [`find_contacts`] found, with the joints within their limits.
pub fn contact_set(
    hand: &Hand,
    head: &TactileFrameHead,
    summary: ContactSummary,
    parts: Option<&FrameParts<'_>>,
) -> ContactSetHead {
    let mut set = ContactSetHead {
        header: Header { hand_id: hand.id(), ..head.header },
        grasp_id: head.grasp_id,
        phase: head.phase,
        n_pads_in_contact: summary.n_pads_in_contact,
        self_collision: summary.self_collision.into(),
        n_self_contacts: summary.n_self_contacts,
        fault: summary.fault.code(),
        day: head.day,
        ..ContactSetHead::default()
    }
    .with_joints(parts.map_or(&[], |parts| parts.joints))
    .with_senses(&parts.map_or(Senses::default(), |parts| parts.senses));
    clip_to_limits(hand, &mut set.joints);
    set
}

/// Writes the feature of a frame's contacts to `values`. `dictionary_id` is [`Model::dictionary_id`].
pub fn encode(
    model: &Model,
    dictionary_id: u64,
    head: &ContactSetHead,
    contacts: &[Contact],
    values: &mut Vec<f64>,
) -> GraspFeatureHead {
    let outcome = match Fault::from_code(head.fault) {
        Err(_) => Err(Fault::Malformed),
        Ok(_) if head.header.hand_id != model.hand.id => Err(Fault::WrongHand),
        Ok(Fault::None) => extract(model, head, contacts, values),
        Ok(fault) => Err(fault),
    };
    if outcome.is_err() {
        values.clear();
    }
    GraspFeatureHead {
        header: head.header,
        grasp_id: head.grasp_id,
        phase: head.phase,
        dictionary_id,
        n_pads_in_contact: outcome.unwrap_or(head.n_pads_in_contact),
        fault: outcome.err().unwrap_or_default().code(),
        day: head.day,
    }
}

/// The limits that the contacts of a frame with [`Fault::OutOfDistribution`] violate.
pub fn violations(model: &Model, head: &ContactSetHead, contacts: &[Contact]) -> Vec<Violation> {
    let (Ok(joints), Ok(senses), Ok(phase)) = (head.joints(), head.senses(), Phase::from_code(head.phase)) else {
        return Vec::new();
    };
    model.violations(phase, &FeltReading { joints, contacts, senses })
}

fn extract(model: &Model, head: &ContactSetHead, contacts: &[Contact], values: &mut Vec<f64>) -> Result<u32, Fault> {
    let (Ok(joints), Ok(senses), Ok(phase)) = (head.joints(), head.senses(), Phase::from_code(head.phase)) else {
        return Err(Fault::Malformed);
    };
    model.extract(phase, &FeltReading { joints, contacts, senses }, values)
}

/// Judges the feature of a frame, and keeps in `memory` what the model needs for later frames. `dictionary_id` is
/// [`Model::dictionary_id`].
pub fn classify(
    model: &Model,
    dictionary_id: u64,
    memory: &mut Memory,
    head: &GraspFeatureHead,
    values: &[f64],
) -> PredictionHead {
    let place = GraspPlace { epoch: head.header.epoch, grasp_id: head.grasp_id, day: head.day };
    let values = usable_values(model, dictionary_id, head, values);
    let verdict = match Phase::from_code(head.phase) {
        Ok(phase) => model.judge(memory, dictionary_id, place, phase, values),
        Err(_) => Err(Fault::Malformed),
    };
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

/// The values of a feature, if the model can judge them.
fn usable_values<'a>(
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_messages::{Message, TactileFrame};

    #[test]
    fn the_encoder_gets_joints_within_their_limits() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let mut stops: Vec<f64> = hand.joints.iter().map(|joint| joint.upper).collect();
        stops[0] = 0.5;
        let joints = stops.iter().map(|stop| stop + 0.01).collect();
        let frame = TactileFrame { joints, cells_newtons: vec![1.0; hand.n_cells()], ..TactileFrame::default() };
        let (head, items) = frame.to_parts(Header::default());
        let (mut memory, mut contacts) = (ContactMemory::default(), Vec::new());
        let (summary, parts) = find_contacts(&hand, &mut memory, &head, &items, &mut contacts);
        let set = contact_set(&hand, &head, summary, parts.as_ref());
        stops[0] = 0.51;
        assert_eq!(set.joints(), Ok(&stops[..]));
    }

    #[test]
    fn the_frames_of_a_skin_that_has_stopped_are_faulty() {
        let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
        let (mut memory, mut contacts, mut faults) = (ContactMemory::default(), Vec::new(), Vec::new());
        let phases = [(Phase::Settled, 8), (Phase::TestLifting, 12), (Phase::Kept, 1)];
        let phases = phases.into_iter().flat_map(|(phase, n)| std::iter::repeat_n(phase, n));
        for (idx, phase) in phases.enumerate() {
            let mut cells_newtons = vec![0.0; hand.n_cells()];
            // Up and down, until it stops.
            cells_newtons[30] = 2.0 + 0.01 * (idx.min(8) % 2 * idx.min(8)) as f64;
            let frame =
                TactileFrame { phase, joints: vec![0.5; hand.joints.len()], cells_newtons, ..TactileFrame::default() };
            let (head, items) = frame.to_parts(Header { hand_id: hand.id(), seq: idx as u64, ..Header::default() });
            faults.push(find_contacts(&hand, &mut memory, &head, &items, &mut contacts).0.fault);
        }
        let first = faults.iter().position(|fault| *fault == Fault::SensorFault).expect("found");
        assert!((12..19).contains(&first), "{faults:?}");
        assert!(faults[first..20].iter().all(|fault| *fault == Fault::SensorFault));
        assert_eq!((faults[0], faults[20]), (Fault::None, Fault::None));
    }
}
