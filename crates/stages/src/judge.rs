//! [`Judge`] decides grasps from frames, as the stages of a graph do, within one object.

use blindgrasp_messages::{Contact, Fault, Header, LiftDecision, Message, Prediction, Reason, Stamped, TactileFrame};

use crate::hand::Hand;
use crate::lift_arbiter::{ArbiterOptions, LiftArbiter, Probe};
use crate::model::{Memory, Model, OtherHand};
use crate::out_of_distribution::Violation;
use crate::own_lifts::{Adapt, OwnLifts};
use crate::steps::{self, ContactMemory};

/// Judges the frames of a hand one after the other, and decides each grasp once.
///
/// It is the contacts, encoder and classifier of a graph with the lift arbiter behind them, and decides as a graph with
/// this model and these options would. It has no clock: a frame bears its time, and counts as fresh.
pub struct Judge {
    hand: Hand,
    hand_id: u64,
    model: Model,
    dictionary_id: u64,
    felt: ContactMemory,
    memory: Memory,
    arbiter: LiftArbiter,
    /// The number of the next frame of [`Judge::frame`].
    next_seq: u64,
    contacts: Vec<Contact>,
    values: Vec<f64>,
    found: Findings,
    /// Of the grasp before.
    found_before: Findings,
}

/// The grounds against the last grasp that has any.
#[derive(Debug, Default)]
struct Findings {
    grasp_id: u64,
    /// The limits that its last frame violates that was at rest and out of distribution.
    violations: Vec<Violation>,
    /// The first reading that made a frame invalid.
    invalid: Option<String>,
    /// Why its last frame at rest has no contact.
    no_contact: Option<String>,
}

/// The judgement of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    pub prediction: Prediction,
    /// The decisions that come with this frame, mostly none. There are two if the frame ends a grasp that was not
    /// decided, which is held, and decides the next one at once.
    pub decisions: Vec<LiftDecision>,
}

impl Judge {
    /// A judge with the default options of the arbiter.
    ///
    /// # Errors
    /// The model is of another hand.
    pub fn new(hand: Hand, model: Model) -> Result<Judge, OtherHand> {
        Judge::with_options(hand, model, ArbiterOptions::default())
    }

    /// A judge that waits for other votes, say, or asks for a probe.
    ///
    /// # Errors
    /// The model is of another hand.
    pub fn with_options(hand: Hand, mut model: Model, options: ArbiterOptions) -> Result<Judge, OtherHand> {
        model.check_hand(&hand)?;
        let dictionary_id = model.dictionary_id();
        model.name_quantities(&hand);
        Ok(Judge {
            hand_id: hand.id(),
            dictionary_id,
            hand,
            model,
            felt: ContactMemory::default(),
            memory: Memory::default(),
            arbiter: LiftArbiter::new(options),
            next_seq: 0,
            contacts: Vec::new(),
            values: Vec::new(),
            found: Findings::default(),
            found_before: Findings::default(),
        })
    }

    /// Corrects its probabilities by the outcomes of lifts (frames of the phases kept and dropped), or judges as the model does.
    pub fn adapt(&mut self, adapt: Adapt) {
        self.memory.adapt = adapt;
    }

    /// The outcomes of lifts so far, and the corrections that follow from them.
    pub fn own_lifts(&self) -> &OwnLifts {
        &self.memory.lifts
    }

    pub fn hand(&self) -> &Hand {
        &self.hand
    }

    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Takes the next frame, and returns the decisions that come with it, in order ([`Judged::decisions`]): also a probe
    /// before a decision, or what the arm should do while it lifts. `stamp_nanos` is the time of the
    /// reading by the source's clock: frames of one time are one reading and have one vote, and a grasp whose frames
    /// come too far apart (see [`ArbiterOptions`]) is held.
    pub fn frame(&mut self, stamp_nanos: u64, frame: &TactileFrame) -> Vec<LiftDecision> {
        let header = Header { seq: self.next_seq, stamp_nanos, hand_id: self.hand_id, ..Header::default() };
        self.judge(header, frame).decisions
    }

    /// As [`Judge::frame`], for a sample that bears its source's number and time. A number that is missing is a doubt,
    /// as in a graph: the grasp is held.
    pub fn sample(&mut self, sample: &Stamped<TactileFrame>) -> Judged {
        self.judge(sample.header, &sample.message)
    }

    fn judge(&mut self, header: Header, frame: &TactileFrame) -> Judged {
        self.next_seq = header.seq.wrapping_add(1);
        let (head, items) = frame.to_parts(header);
        let (summary, parts) = steps::find_contacts(&self.hand, &mut self.felt, &head, &items, &mut self.contacts);
        let contacts = steps::contact_set(&self.hand, &head, summary, parts.as_ref());
        let feature = steps::encode(&self.model, self.dictionary_id, &contacts, &self.contacts, &mut self.values);
        if self.found.grasp_id != frame.grasp_id {
            let found = Findings { grasp_id: frame.grasp_id, ..Findings::default() };
            self.found_before = std::mem::replace(&mut self.found, found);
        }
        if summary.fault != Fault::NoContact || frame.phase.decides() {
            let why = steps::explain_fault(&self.hand, &self.felt.finder, &summary, parts.as_ref());
            let found = &mut self.found;
            if summary.fault == Fault::NoContact {
                found.no_contact = why;
            } else if found.invalid.is_none() {
                found.invalid = why;
            }
        }
        if feature.fault == Fault::OutOfDistribution.code() && frame.phase.decides() {
            self.found.violations = steps::violations(&self.model, &contacts, &self.contacts);
        }
        let head = steps::classify(&self.model, self.dictionary_id, &mut self.memory, &feature, &self.values);
        let mut decisions = Vec::new();
        // The phase is a frame's and the fault a step's, so the prediction can be read.
        let unreadable = Prediction { grasp_id: frame.grasp_id, fault: Fault::Malformed, ..Prediction::default() };
        let prediction = Prediction::from_parts(&head, &[]).unwrap_or(unreadable);
        self.arbiter.on_prediction(&head.header, &prediction, 0, &mut decisions);
        Judged { prediction, decisions }
    }

    /// Why a grasp was held that has just been decided, sentence by sentence: by names of joints, pads and links, with
    /// what was found and what was expected. Empty if its reason says all that is known.
    pub fn explain(&self, decision: &LiftDecision) -> Vec<String> {
        let is_of_last_frame = decision.grasp_id == self.found.grasp_id;
        // A grasp may be held when the next one begins.
        let found = if is_of_last_frame { &self.found } else { &self.found_before };
        match decision.reason {
            Reason::Stale | Reason::NoAgreement | Reason::Missing | Reason::OutOfOrder => {
                self.arbiter.explain(decision.grasp_id)
            }
            _ if decision.grasp_id != found.grasp_id => Vec::new(),
            Reason::Invalid => found.invalid.iter().cloned().collect(),
            Reason::Unstable | Reason::Unsure if is_of_last_frame && self.arbiter.options().probe == Probe::None => {
                let names = self.model.features.value_names(&self.hand);
                self.model.speak_against(&names, &self.values).into_iter().collect()
            }
            Reason::NoContact => found.no_contact.iter().cloned().collect(),
            Reason::OutOfDistribution => Violation::most(&found.violations),
            _ => Vec::new(),
        }
    }

    /// The readings of the last frame's grasp that a healthy hand does not give, a sentence each, whatever is decided.
    pub fn odd_readings(&self) -> Vec<String> {
        self.felt.odd_readings(&self.hand, self.found.grasp_id)
    }

    /// Holds the open grasp, if any, because no more frames come.
    pub fn end(&mut self) -> Option<LiftDecision> {
        self.arbiter.on_end()
    }

    /// Begins with another recording or run of a source. Only what the model keeps of a recording day remains, if both
    /// name the same day.
    pub fn begin_recording(&mut self) {
        self.memory.begin_recording();
        self.forget_grasps();
    }

    /// Begins anew, as if it had seen nothing.
    pub fn reset(&mut self) {
        self.memory = Memory::new(self.memory.adapt);
        self.forget_grasps();
    }

    fn forget_grasps(&mut self) {
        self.arbiter = LiftArbiter::new(*self.arbiter.options());
        self.felt = ContactMemory::default();
        self.next_seq = 0;
        (self.found, self.found_before) = Default::default();
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use blindgrasp_messages::{Action, Phase};

    fn hand(name: &str) -> Hand {
        Hand::load(Path::new(name)).expect("built in")
    }

    fn judge() -> Judge {
        let model = Model::parse(include_str!("../../../models/barrett-bh8-280.json")).expect("a model");
        Judge::new(hand("barrett-bh8-280"), model).expect("of one hand")
    }

    /// A frame of a hand that feels nothing.
    fn frame(phase: Phase) -> TactileFrame {
        let hand = hand("barrett-bh8-280");
        let (joints, cells_newtons) = (vec![0.5; hand.joints.len()], vec![0.0; hand.n_cells()]);
        TactileFrame { grasp_id: 1, phase, joints, cells_newtons, ..TactileFrame::default() }
    }

    #[test]
    fn a_model_of_another_hand_is_refused() {
        let model = judge().model.clone();
        let error = Judge::new(hand("shadow-biotac-sp"), model).err().expect("refused").to_string();
        assert!(error.contains("the model is for the hand 'barrett-bh8-280'"), "{error}");
        assert!(error.contains("not for 'shadow-biotac-sp'"), "{error}");
    }

    #[test]
    fn an_invalid_grasp_is_explained_by_the_joint_that_made_it_so() {
        let mut judge = judge();
        let mut degrees = frame(Phase::Closing);
        degrees.joints[1] = 39.4;
        assert_eq!(judge.frame(0, &degrees), []);
        // Another reading decides, but the first one is the cause.
        degrees.joints[1] = f64::NAN;
        degrees.phase = Phase::Settled;
        let decision = judge.frame(10_000_000, &degrees).pop().expect("decided");
        assert_eq!(decision.reason, Reason::Invalid);
        let [why] = &judge.explain(&decision)[..] else { panic!("one sentence") };
        assert!(why.starts_with("joint finger_1 reads 39.4, expected 0 to "), "{why}");
        // The next grasp has another reason.
        let next = TactileFrame { grasp_id: 2, ..frame(Phase::Settled) };
        let decision = judge.frame(20_000_000, &next).pop().expect("decided");
        assert_eq!((decision.reason, judge.explain(&decision).len()), (Reason::NoContact, 1));
    }

    #[test]
    fn a_grasp_unlike_the_training_is_explained_by_names_whatever_the_file_of_the_model_says() {
        let mut judge = judge();
        let felt = TactileFrame { cells_newtons: vec![1.0; 96], ..frame(Phase::Settled) };
        let decision = judge.frame(0, &felt).pop().expect("decided");
        assert_eq!(decision.reason, Reason::OutOfDistribution);
        let why = judge.explain(&decision).join("\n");
        assert!(
            why.contains("load of pad finger_1, newtons: 24, trained from 0 to ") && why.contains("more quantities"),
            "{why}"
        );
    }

    #[test]
    fn an_unstable_grasp_is_explained_by_two_values_of_pads_or_joints() {
        let mut judge = judge();
        let mut felt = frame(Phase::Settled);
        felt.cells_newtons[0] = 1.0;
        judge.frame(0, &felt);
        // As if the model had said so.
        let decision = LiftDecision { grasp_id: 1, reason: Reason::Unstable, ..LiftDecision::default() };
        let [why] = &judge.explain(&decision)[..] else { panic!("one sentence") };
        assert!(why.starts_with("of pads and joints, most against it: ") && why.matches(" is ").count() == 2, "{why}");
        assert!(why.ends_with("; pad palm alone feels"), "{why}");
    }

    #[test]
    fn frames_are_numbered_without_gaps_and_a_gap_of_samples_is_a_doubt() {
        let mut judge = judge();
        assert_eq!(judge.frame(0, &frame(Phase::Closing)), []);
        let decision = judge.frame(10_000_000, &frame(Phase::Settled)).pop().expect("decided");
        assert_eq!((decision.action, decision.reason), (Action::Hold, Reason::NoContact));
        assert_eq!(judge.end(), None);

        judge.reset();
        assert_eq!(judge.frame(0, &frame(Phase::Closing)), []);
        let decision = judge.end().expect("held, as it has no decision");
        assert_eq!((decision.grasp_id, decision.action, decision.reason), (1, Action::Hold, Reason::Missing));

        judge.reset();
        let sample = |seq, phase| Stamped { header: Header { seq, ..Header::default() }, message: frame(phase) };
        assert_eq!(judge.sample(&sample(0, Phase::Closing)).decisions, []);
        let judged = judge.sample(&sample(2, Phase::Settled));
        assert_eq!(judged.prediction.fault, Fault::NoContact);
        assert_eq!(judged.decisions.first().map(|decision| decision.reason), Some(Reason::OutOfOrder));
    }

    #[test]
    fn a_frame_that_ends_a_grasp_and_decides_the_next_one_has_both_decisions() {
        let mut judge = judge();
        let mut felt = frame(Phase::Settled);
        // One cell, as in training: all cells would be out of distribution, which holds at once.
        felt.cells_newtons[0] = 1.0;
        assert_eq!(judge.frame(0, &felt), []);
        assert_eq!(judge.frame(10_000_000, &felt), []);
        let next = TactileFrame { grasp_id: 2, ..frame(Phase::Settled) };
        let decisions = judge.frame(20_000_000, &next);
        let said: Vec<_> =
            decisions.iter().map(|decision| (decision.grasp_id, decision.action, decision.reason)).collect();
        assert_eq!(said, [(1, Action::Hold, Reason::NoAgreement), (2, Action::Hold, Reason::NoContact)]);
    }
}
