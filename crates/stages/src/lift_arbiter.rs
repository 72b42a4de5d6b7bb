//! The lift arbiter decides once per grasp whether the arm may lift, and holds when in doubt.
//!
//! It is a state machine over predictions without a clock: the operator passes the age of each prediction and reports silence.
//! A grasp is decided
//!
//! * LIFT, when `votes` consecutive settled predictions of different times, made by the same operators, say stable and no
//!   earlier prediction of the grasp raised a doubt; with a probe, the predictions after the probe;
//! * HOLD, when `votes` consecutive settled predictions say unstable, or as many say that the model is unsure; at once, when
//!   a settled prediction is faulty; at the first settled prediction, when an earlier one of the grasp raised a doubt; and at
//!   the grasp's end, when it is not decided by then.
//!
//! A wrong "stable" drops the object. So there is one path to LIFT, the `Vote::Stable` of `OpenGrasp::vote`, and every other
//! path ends in HOLD with its reason. With the option `probe`, settled predictions that are not unstable ask for a
//! probe, which decides nothing: the grasp stays open, and only the frames after the probe can lead to a LIFT. Before a
//! test lift, the frames of the tight hand may end the grasp with HOLD. If the
//! outcomes of lifts refute [`ArbiterOptions::promised_drops`], every later grasp is held.
//!
//! While the arm lifts, frames of the phase `lifting` are watched, and `tighten` or `set_down` may follow (`LiftWatch`).

use serde::{Deserialize, Serialize};

use crate::decided::Decided;
use crate::lift_watch::LiftWatch;
use crate::promise_monitor::PromiseMonitor;
use blindgrasp_messages::{Action, Fault, Header, LiftDecision, Phase, Prediction, Reason};

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ArbiterOptions {
    /// How many consecutive settled predictions must agree; at least 1.
    pub votes: u32,
    /// The least probability with which a prediction counts as stable, in addition to the model's own threshold.
    pub min_probability_stable: f64,
    /// Greatest time between two predictions of a grasp by the source's clock. A later one counts as stale.
    pub max_gap_nanos: u64,
    /// Greatest age of a prediction on arrival, since its source published it on this machine.
    pub max_age_nanos: u64,
    /// The probe that the robot can do. A settled grasp that is not unstable is then decided by this probe's frames.
    pub probe: Probe,
    /// The promised share of the lifts that drop the object; 1 promises nothing.
    pub promised_drops: f64,
    /// Number of decided grasps that are remembered, so that a late sample does not decide one of them again.
    pub n_remembered: usize,
}

/// What a robot can do to feel more of a grasp before it is decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Probe {
    /// Nothing: settled frames decide.
    #[default]
    None,
    /// It can tighten to the force of a lift.
    Squeeze,
    /// It can tighten, and then lift by a few millimetres.
    TestLift,
}

impl Probe {
    /// The action that asks for it, and the phase of the frames that decide then.
    fn asked(self) -> Option<(Action, Phase)> {
        match self {
            Probe::None => None,
            Probe::Squeeze => Some((Action::Squeeze, Phase::Squeezed)),
            Probe::TestLift => Some((Action::TestLift, Phase::TestLifted)),
        }
    }
}

impl Default for ArbiterOptions {
    fn default() -> Self {
        ArbiterOptions {
            // One outlier alone never lifts, and three votes cost 20 ms at the 100 Hz of the simulated hand.
            votes: 3,
            // The model's own threshold is enough, because training chose it.
            min_probability_stable: 0.0,
            // Ten periods at 100 Hz: single lost frames are found by their numbers, so a gap means that the source stood still.
            max_gap_nanos: 100_000_000,
            // Twice the gap: a prediction that waited longer may be of a hand that has moved since.
            max_age_nanos: 200_000_000,
            probe: Probe::None,
            // A promise is a model's for objects like its own, which an arbiter does not know.
            promised_drops: 1.0,
            // Far more grasps than can be on their way at once, in 8 kB.
            n_remembered: 1024,
        }
    }
}

/// Decides grasp after grasp.
#[derive(Debug)]
pub struct LiftArbiter {
    options: ArbiterOptions,
    state: ArbiterState,
}

/// What an arbiter knows between predictions. Another arbiter can continue from it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ArbiterState {
    /// The options that the votes were counted with.
    options: ArbiterOptions,
    last: Option<Header>,
    open: Option<OpenGrasp>,
    /// Epochs and numbers of decided grasps: a source that starts anew may use its numbers again.
    decided: Decided,
    /// A doubt about samples whose grasp is not known: it counts against the next grasp.
    pending_doubt: Option<Reason>,
    /// The last lifted grasp, if its outcome has not come.
    lifted: Option<u64>,
    /// The watch of the last lift.
    watch: Option<LiftWatch>,
    /// Number of lifts whose outcome did not come before the next lift.
    n_unreported: u64,
    promise: PromiseMonitor,
}

impl ArbiterState {
    pub fn promise(&self) -> &PromiseMonitor {
        &self.promise
    }

    pub fn n_unreported(&self) -> u64 {
        self.n_unreported
    }
}

/// A grasp that is not decided yet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct OpenGrasp {
    /// The epoch of its last prediction.
    epoch: u64,
    grasp_id: u64,
    /// The first problem of a prediction of this grasp. It rules out a LIFT.
    doubt: Option<Reason>,
    n_settled: u32,
    /// The phase of the frames that vote: [`Phase::Settled`] until a probe has been asked for.
    awaited: Phase,
    /// Whether a probe has been asked for of which no frame has come.
    is_probe_pending: bool,
    /// Whether its last frame was of a tight hand that has a test lift before it.
    is_before_test_lift: bool,
    /// Who has made the agreeing predictions: [`Header::made_by`].
    made_by: u64,
    /// The latest consecutive settled predictions that agree: their vote, their number, their lowest probability.
    agreeing: Option<(Vote, u32, f64)>,
}

impl OpenGrasp {
    /// What a frame of this phase means to the grasp.
    fn meaning_of(&mut self, phase: Phase) -> PhaseMeaning {
        // The frames of the other phases show that the source has heard of the probe, or needs another one.
        self.is_probe_pending &= matches!(phase, Phase::Settled | Phase::Ended);
        self.is_before_test_lift = self.awaited == Phase::TestLifted
            && (phase == Phase::Squeezed || phase == Phase::Ended && self.is_before_test_lift);
        match phase {
            _ if phase == self.awaited => PhaseMeaning::Vote,
            Phase::Squeezed if self.is_before_test_lift => PhaseMeaning::Vote,
            Phase::Ended if self.is_probe_pending => PhaseMeaning::Nothing,
            Phase::Ended if self.is_before_test_lift => PhaseMeaning::Wait,
            Phase::Ended | Phase::Lifting | Phase::Kept | Phase::Dropped => PhaseMeaning::End,
            Phase::Open | Phase::Closing => PhaseMeaning::OtherGrip,
            Phase::Settled | Phase::Squeezing | Phase::Squeezed | Phase::TestLifting | Phase::TestLifted => {
                PhaseMeaning::Motion
            }
        }
    }

    /// Takes a frame that votes, and returns the decision that follows from it, or the probe that it asks for.
    fn vote(
        &mut self,
        header: &Header,
        prediction: &Prediction,
        is_new_reading: bool,
        options: &ArbiterOptions,
    ) -> Option<LiftDecision> {
        self.n_settled += 1;
        if let Some(doubt) = self.doubt {
            return Some(self.says(Action::Hold, doubt, 0.0));
        }
        // With a probe, the frames before it, and those of a tight hand before a test lift, cannot decide for LIFT.
        let is_before_probe = self.is_before_test_lift || self.asks_for(options).is_some();
        let is_promising = is_before_probe && (prediction.stable || prediction.unsure);
        let vote = if is_promising { Vote::Promising } else { Vote::of(prediction, options) };
        if !is_new_reading {
            // It has no vote, but if it contradicts the votes, they don't count either.
            if self.agreeing.is_some_and(|(said, ..)| said != vote) || self.made_by != header.made_by {
                self.agreeing = None;
            }
            return None;
        }
        let (n_agreeing, lowest) = self.count(vote, prediction.probability_stable, header.made_by);
        if n_agreeing < options.votes.max(1) {
            return None;
        }
        match vote {
            Vote::Stable => Some(self.says(Action::Lift, Reason::Stable, lowest)),
            Vote::Unsure => Some(self.says(Action::Hold, Reason::Unsure, lowest)),
            Vote::Unstable => Some(self.says(Action::Hold, Reason::Unstable, lowest)),
            Vote::Promising => {
                let (action, awaited) = self.asks_for(options)?;
                (self.awaited, self.agreeing, self.is_probe_pending) = (awaited, None, true);
                Some(self.says(action, Reason::Promising, lowest))
            }
        }
    }

    fn says(&self, action: Action, reason: Reason, probability_stable: f64) -> LiftDecision {
        LiftDecision { grasp_id: self.grasp_id, action, reason, probability_stable }
    }

    /// The probe that a promising grasp is asked for, if it has not been.
    fn asks_for(&self, options: &ArbiterOptions) -> Option<(Action, Phase)> {
        if self.awaited == Phase::Settled { options.probe.asked() } else { None }
    }

    /// Adds a vote, and returns the number of consecutive equal votes of the same operators and their lowest probability.
    fn count(&mut self, vote: Vote, probability_stable: f64, made_by: u64) -> (u32, f64) {
        // A model agrees with itself only.
        let is_same = std::mem::replace(&mut self.made_by, made_by) == made_by;
        let (n_agreeing, lowest) = match self.agreeing {
            Some((said, n, lowest)) if said == vote && is_same => (n + 1, lowest.min(probability_stable)),
            _ => (1, probability_stable),
        };
        self.agreeing = Some((vote, n_agreeing, lowest));
        (n_agreeing, lowest)
    }

    /// The reason why the grasp is not lifted if it ends here.
    fn reason_at_end(&self) -> Reason {
        self.doubt.unwrap_or(if self.n_settled == 0 { Reason::Missing } else { Reason::NoAgreement })
    }
}

/// What a prediction means to the open grasp, by its phase.
enum PhaseMeaning {
    /// The hand is at rest in the phase that is awaited, or tight before a test lift: the prediction votes.
    Vote,
    /// The source did not know yet that a probe was asked for.
    Nothing,
    /// The source waits for an answer before the test lift. Other sources go on by themselves.
    Wait,
    /// The source has no more frames of the grasp, or the robot lifts, or has lifted, although it was not decided.
    End,
    /// The hand has moved again, so the votes until now were about another grip, and a probe as well.
    OtherGrip,
    /// The hand or the arm moves on: votes after it are not consecutive with those before it.
    Motion,
}

/// How a prediction comes after the one before it.
struct Arrival {
    break_in_order: Option<Reason>,
    /// The reason why its numbers have no use: invalid or stale.
    unusable: Option<Reason>,
    /// Frames of one time are one reading: only the first of them votes.
    is_new_reading: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Vote {
    Stable,
    Unsure,
    Unstable,
    /// It may be stable, which a probe will tell.
    Promising,
}

impl Vote {
    fn of(prediction: &Prediction, options: &ArbiterOptions) -> Self {
        match (prediction.stable, prediction.unsure) {
            (true, false) if prediction.probability_stable >= options.min_probability_stable => Vote::Stable,
            (false, false) => Vote::Unstable,
            // This includes a prediction that is stable to the model, but too improbable for the arbiter.
            _ => Vote::Unsure,
        }
    }
}

impl LiftArbiter {
    /// An arbiter that has seen nothing.
    pub fn new(options: ArbiterOptions) -> Self {
        LiftArbiter { options, state: ArbiterState { options, ..ArbiterState::default() } }
    }

    pub fn state(&self) -> &ArbiterState {
        &self.state
    }

    /// Continues from another arbiter's state. Votes that were counted with other options are dropped.
    pub fn restore(&mut self, state: ArbiterState) {
        self.state = state;
        self.set_options(self.options);
    }

    pub fn options(&self) -> &ArbiterOptions {
        &self.options
    }

    /// Uses other options from the next prediction on. The votes of an open grasp were counted with the old options, so they
    /// are dropped.
    pub fn set_options(&mut self, options: ArbiterOptions) {
        self.options = options;
        if self.state.options.promised_drops != options.promised_drops {
            self.state.promise = PromiseMonitor::default();
        }
        if self.state.options != options {
            if let Some(open) = self.state.open.as_mut() {
                open.agreeing = None;
            }
            if let Some(watch) = self.state.watch.as_mut() {
                watch.forget_votes();
            }
        }
        self.state.options = options;
    }

    /// Takes a prediction that is `age_nanos` old, and pushes the decisions that follow from it: mostly none; two when it ends
    /// an undecided grasp and decides the next one at once.
    pub fn on_prediction(
        &mut self,
        header: &Header,
        prediction: &Prediction,
        age_nanos: u64,
        decisions: &mut Vec<LiftDecision>,
    ) {
        let options = self.options;
        let arrival = self.arrive(header, prediction, age_nanos);
        self.observe_outcome(header, prediction, arrival.break_in_order);
        if let Some(watch) = &mut self.state.watch
            && (arrival.is_new_reading || prediction.phase == Phase::Ended)
        {
            let is_trusted = arrival.break_in_order.is_none() && arrival.unusable.is_none();
            decisions.extend(watch.on_prediction(header, prediction, is_trusted, options.votes.max(1)));
        }
        let Some(open) = self.open((header.epoch, prediction.grasp_id), decisions) else {
            return;
        };
        let meaning = open.meaning_of(prediction.phase);
        let faulty = reason_of(prediction.fault, matches!(meaning, PhaseMeaning::Vote));
        open.doubt = open.doubt.or(arrival.break_in_order).or(faulty).or(arrival.unusable);
        let decision = match meaning {
            PhaseMeaning::Vote => open.vote(header, prediction, arrival.is_new_reading, &options),
            PhaseMeaning::Nothing => None,
            PhaseMeaning::Wait if open.doubt.is_none() => {
                (open.is_before_test_lift, open.is_probe_pending) = (false, true);
                let probability_stable = open.agreeing.map_or(0.0, |(.., lowest)| lowest);
                Some(open.says(Action::TestLift, Reason::Promising, probability_stable))
            }
            PhaseMeaning::Wait | PhaseMeaning::End => Some(open.says(Action::Hold, open.reason_at_end(), 0.0)),
            PhaseMeaning::OtherGrip => {
                (open.agreeing, open.awaited) = (None, Phase::Settled);
                None
            }
            PhaseMeaning::Motion => {
                open.agreeing = None;
                None
            }
        };
        if let Some(decision) = decision {
            if decision.action.decides() {
                self.close(&decision);
            }
            decisions.push(decision);
        }
    }

    /// Holds a grasp of which a prediction arrived that could not be read, whether the grasp was open or not. The prediction may
    /// have been one of another grasp, so it counts against the next grasp as well.
    pub fn on_unreadable(&mut self, header: &Header, grasp_id: u64, decisions: &mut Vec<LiftDecision>) {
        let break_in_order = self.break_in_order(header, grasp_id);
        self.state.last = Some(*header);
        if let Some(watch) = self.state.watch.as_mut() {
            watch.forget_votes();
        }
        if self.open((header.epoch, grasp_id), decisions).is_some() {
            decisions.extend(self.hold(Reason::Invalid));
        }
        self.state.pending_doubt = self.state.pending_doubt.or(break_in_order).or(Some(Reason::Invalid));
    }

    /// Holds the open grasp, if any, because no prediction has come for longer than a prediction may be old.
    pub fn on_silence(&mut self) -> Option<LiftDecision> {
        self.hold(Reason::Stale)
    }

    /// Holds the open grasp, if any, because the link to the machine that predicts is down.
    pub fn on_cut_off(&mut self) -> Option<LiftDecision> {
        self.hold(Reason::LinkDown)
    }

    /// Holds the open grasp, if any, because the next grasp began or the stream ended before its source ended it.
    pub fn on_end(&mut self) -> Option<LiftDecision> {
        let reason = self.state.open.as_ref()?.reason_at_end();
        self.hold(reason)
    }

    /// Whether a grasp has begun and is not decided.
    pub fn has_open_grasp(&self) -> bool {
        self.state.open.is_some()
    }

    /// Takes the place of a prediction in the stream: whether it is in order, valid and fresh.
    fn arrive(&mut self, header: &Header, prediction: &Prediction, age_nanos: u64) -> Arrival {
        let grasp_id = prediction.grasp_id;
        let break_in_order = self.break_in_order(header, grasp_id);
        let state = &mut self.state;
        let mut is_new_reading = true;
        if let Some(last) = state.last.replace(*header) {
            is_new_reading = (last.epoch, last.stamp_nanos) != (header.epoch, header.stamp_nanos);
            // A source that was started again may go on with a grasp that is decided, unless it begins with its first sample.
            let goes_on = last.epoch != header.epoch && header.seq != 0;
            if goes_on && state.decided.contains((last.epoch, grasp_id)) {
                state.decided.push((header.epoch, grasp_id), self.options.n_remembered);
            }
        }
        // The samples of a grasp are not mixed with those of the next one, so the doubtful samples were not of that one.
        let is_open = state.open.as_ref().is_some_and(|open| open.grasp_id == grasp_id);
        if break_in_order.is_none() && (is_open || state.decided.contains((header.epoch, grasp_id))) {
            state.pending_doubt = None;
        }
        // A probability that is NaN is not in the range.
        let is_valid = prediction.decision_value.is_finite()
            && (0.0..=1.0).contains(&prediction.probability_stable)
            && !(prediction.stable && prediction.unsure);
        let unusable = if !is_valid {
            Some(Reason::Invalid)
        } else if age_nanos > self.options.max_age_nanos {
            Some(Reason::Stale)
        } else {
            None
        };
        Arrival { break_in_order, unusable, is_new_reading }
    }

    /// Counts the outcome of the last lift, once.
    fn observe_outcome(&mut self, header: &Header, prediction: &Prediction, break_in_order: Option<Reason>) {
        let is_outcome = matches!(prediction.phase, Phase::Kept | Phase::Dropped);
        let is_of_lift = self.state.lifted == Some(prediction.grasp_id)
            && self.state.decided.contains((header.epoch, prediction.grasp_id));
        if !is_outcome || !is_of_lift || break_in_order == Some(Reason::WrongHand) {
            return;
        }
        self.state.lifted = None;
        if prediction.fault == Fault::Changed {
            self.state.promise.begin_anew();
        }
        self.state.promise.observe(prediction.phase == Phase::Dropped, self.options.promised_drops);
    }

    /// The grasp of that number, opened if it is new, after the one before it has been ended; `None` if it is decided.
    fn open(&mut self, (epoch, grasp_id): (u64, u64), decisions: &mut Vec<LiftDecision>) -> Option<&mut OpenGrasp> {
        if self.state.decided.contains((epoch, grasp_id)) {
            match &mut self.state.open {
                // A late sample of a decided grasp changes nothing, unless it comes amid another one.
                Some(open) if open.epoch == epoch => open.doubt = open.doubt.or(Some(Reason::OutOfOrder)),
                // The source of the open grasp has ended.
                _ => decisions.extend(self.on_end()),
            }
            return None;
        }
        if self.state.open.as_ref().is_some_and(|open| open.grasp_id != grasp_id) {
            decisions.extend(self.on_end());
        }
        let ArbiterState { open, pending_doubt, promise, .. } = &mut self.state;
        let open = open.get_or_insert_with(|| OpenGrasp {
            epoch,
            grasp_id,
            doubt: pending_doubt.take().or(promise.is_withdrawn().then_some(Reason::PromiseWithdrawn)),
            n_settled: 0,
            awaited: Phase::Settled,
            is_probe_pending: false,
            is_before_test_lift: false,
            made_by: 0,
            agreeing: None,
        });
        // A source that was started again may go on with the grasp.
        open.epoch = epoch;
        Some(open)
    }

    /// Holds the open grasp, if any.
    fn hold(&mut self, reason: Reason) -> Option<LiftDecision> {
        let decision = self.state.open.as_ref()?.says(Action::Hold, reason, 0.0);
        self.close(&decision);
        Some(decision)
    }

    /// Remembers that the open grasp is decided, and begins to watch it if it is lifted.
    fn close(&mut self, decision: &LiftDecision) {
        let Some(OpenGrasp { epoch, grasp_id, .. }) = self.state.open.take() else { return };
        self.state.decided.push((epoch, grasp_id), self.options.n_remembered);
        if decision.action == Action::Lift {
            let before = self.state.lifted.replace(grasp_id);
            let watch = self.state.watch.replace(LiftWatch::new(epoch, grasp_id, decision.probability_stable));
            // A lift that was broken off has no outcome, unless the object was dropped.
            let is_unreported = before.is_some() && !watch.is_some_and(|watch| watch.is_set_down());
            self.state.n_unreported += u64::from(is_unreported);
        }
    }

    /// The problem of `header` after the last one. A gap between grasps counts against the new grasp, because its first frames
    /// may be missing. So does a first sample that is not the source's first.
    fn break_in_order(&self, header: &Header, grasp_id: u64) -> Option<Reason> {
        let Some(last) = &self.state.last else {
            return (header.seq != 0).then_some(Reason::OutOfOrder);
        };
        if header.epoch != last.epoch {
            // The source was restarted. A grasp that it had begun before is not trusted, nor one whose beginning is missing.
            let goes_on = self.state.open.as_ref().is_some_and(|open| open.grasp_id == grasp_id);
            return (goes_on || header.seq != 0).then_some(Reason::OutOfOrder);
        }
        if header.seq != last.seq.wrapping_add(1) || header.stamp_nanos < last.stamp_nanos {
            return Some(Reason::OutOfOrder);
        }
        if header.hand_id != last.hand_id {
            return Some(Reason::WrongHand);
        }
        let same_grasp = self.state.open.as_ref().is_some_and(|open| open.grasp_id == grasp_id);
        (same_grasp && header.stamp_nanos - last.stamp_nanos > self.options.max_gap_nanos).then_some(Reason::Stale)
    }
}

/// The reason that a fault gives to hold. A frame without contact, or with touching fingers, is normal while the hand is still
/// closing. A faulty sensor is not.
fn reason_of(fault: Fault, votes: bool) -> Option<Reason> {
    match fault {
        Fault::None => None,
        Fault::NoContact => votes.then_some(Reason::NoContact),
        Fault::SelfCollision => votes.then_some(Reason::SelfCollision),
        Fault::WrongLength | Fault::InvalidValue | Fault::Malformed => Some(Reason::Invalid),
        Fault::WrongHand => Some(Reason::WrongHand),
        Fault::WrongModel => Some(Reason::WrongModel),
        Fault::MissingReading => Some(Reason::MissingReading),
        Fault::OutOfDistribution => votes.then_some(Reason::OutOfDistribution),
        Fault::NoBaseline => votes.then_some(Reason::NoBaseline),
        Fault::UnlikeDay => votes.then_some(Reason::UnlikeDay),
        Fault::SensorFault => Some(Reason::SensorFault),
        // It is of an outcome, which decides nothing.
        Fault::Changed => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NANOS: u64 = 10_000_000;

    struct Stream {
        arbiter: LiftArbiter,
        header: Header,
        decisions: Vec<LiftDecision>,
    }

    fn stream() -> Stream {
        Stream { arbiter: LiftArbiter::new(ArbiterOptions::default()), header: Header::default(), decisions: vec![] }
    }

    fn settled(probability_stable: f64) -> Prediction {
        Prediction {
            phase: Phase::Settled,
            probability_stable,
            stable: probability_stable >= 0.5,
            ..Prediction::default()
        }
    }

    impl Stream {
        fn push(&mut self, prediction: Prediction) -> &mut Self {
            self.push_aged(prediction, 0)
        }

        fn push_aged(&mut self, prediction: Prediction, age_nanos: u64) -> &mut Self {
            self.arbiter.on_prediction(&self.header, &prediction, age_nanos, &mut self.decisions);
            self.header.seq += 1;
            self.header.stamp_nanos += STEP_NANOS;
            self
        }

        fn end(&mut self) -> Vec<(u64, Action, Reason)> {
            self.decisions.extend(self.arbiter.on_end());
            self.decisions.iter().map(|decision| (decision.grasp_id, decision.action, decision.reason)).collect()
        }
    }

    #[test]
    fn three_agreeing_votes_decide_once_with_the_lowest_probability() {
        let mut s = stream();
        for probability in [0.9, 0.8, 0.95, 0.1, 0.1, 0.1] {
            s.push(settled(probability));
        }
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
        assert_eq!(s.decisions[0].probability_stable, 0.8);
    }

    #[test]
    fn each_reason_not_to_lift_holds() {
        use Action::{Hold, Lift};
        let unsure = Prediction { unsure: true, ..settled(0.4) };
        let fault = |fault| Prediction { fault, ..settled(0.9) };
        let ended = Prediction { phase: Phase::Ended, ..settled(0.5) };
        for (predictions, age_nanos, expected) in [
            (vec![settled(0.1); 3], 0, (Hold, Reason::Unstable)),
            (vec![unsure; 3], 0, (Hold, Reason::Unsure)),
            (vec![settled(0.9), settled(0.1), ended], 0, (Hold, Reason::NoAgreement)),
            (vec![settled(0.9), settled(0.1)], 0, (Hold, Reason::NoAgreement)),
            (vec![fault(Fault::OutOfDistribution)], 0, (Hold, Reason::OutOfDistribution)),
            (vec![settled(0.9); 3], 0, (Lift, Reason::Stable)),
            (vec![], 0, (Hold, Reason::Missing)),
            (vec![fault(Fault::NoContact)], 0, (Hold, Reason::NoContact)),
            (vec![fault(Fault::SelfCollision)], 0, (Hold, Reason::SelfCollision)),
            (vec![fault(Fault::InvalidValue)], 0, (Hold, Reason::Invalid)),
            (vec![fault(Fault::WrongModel)], 0, (Hold, Reason::WrongModel)),
            (vec![settled(0.1)], u64::MAX, (Hold, Reason::Stale)),
            (vec![fault(Fault::OutOfDistribution)], u64::MAX, (Hold, Reason::OutOfDistribution)),
        ] {
            let mut s = stream();
            s.push(Prediction { phase: Phase::Closing, ..settled(0.5) });
            for prediction in &predictions {
                s.push_aged(prediction.clone(), age_nanos);
            }
            let (action, reason) = expected;
            assert_eq!(s.end(), [(0, action, reason)]);
        }
    }

    #[test]
    fn a_sample_of_a_decided_grasp_amid_another_one_holds_that_one() {
        let mut s = stream();
        for grasp_id in [0, 0, 0, 1, 1, 0, 1, 1, 1] {
            s.push(Prediction { grasp_id, ..settled(0.9) });
        }
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable), (1, Action::Hold, Reason::OutOfOrder)]);
    }

    #[test]
    fn a_grasp_whose_source_has_no_more_frames_is_decided() {
        let ended = |grasp_id, probability| Prediction { grasp_id, phase: Phase::Ended, ..settled(probability) };
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push(ended(0, 0.9));
        assert_eq!(s.decisions.len(), 1);
        assert_eq!((s.decisions[0].action, s.decisions[0].reason), (Action::Hold, Reason::NoAgreement));
        // One that is decided stays so; one without a settled frame has missed it; a doubt is still the reason.
        let of = |grasp_id| Prediction { grasp_id, ..settled(0.9) };
        s.push(of(1)).push(of(1)).push(of(1)).push(ended(1, 0.1)).push(ended(2, 0.9));
        s.push(Prediction { grasp_id: 3, phase: Phase::Closing, fault: Fault::Malformed, ..Prediction::default() });
        s.push(ended(3, 0.9));
        assert_eq!(
            s.end()[1..],
            [(1, Action::Lift, Reason::Stable), (2, Action::Hold, Reason::Missing), (3, Action::Hold, Reason::Invalid)]
        );
    }

    #[test]
    fn lifts_that_drop_more_often_than_promised_withdraw_the_promise() {
        let options = ArbiterOptions { promised_drops: 0.05, ..ArbiterOptions::default() };
        let mut s = Stream { arbiter: LiftArbiter::new(options), ..stream() };
        let try_grasp = |s: &mut Stream, grasp_id, phase: Option<Phase>| {
            let of = |phase| Prediction { grasp_id, phase, ..settled(0.9) };
            s.push(of(Phase::Settled)).push(of(Phase::Settled)).push(of(Phase::Settled));
            phase.into_iter().for_each(|phase| _ = s.push(of(phase)));
            s.decisions.last().map(|decision| (decision.grasp_id, decision.action, decision.reason))
        };
        // Two lifts are not reported, and the outcome of a grasp that was not lifted last is not counted.
        try_grasp(&mut s, 0, None);
        try_grasp(&mut s, 1, None);
        s.push(Prediction { grasp_id: 0, phase: Phase::Dropped, ..settled(0.9) });
        assert_eq!(try_grasp(&mut s, 2, Some(Phase::Kept)), Some((2, Action::Lift, Reason::Stable)));
        assert_eq!((s.arbiter.state().promise().n_kept, s.arbiter.state().promise().n_dropped), (1, 0));
        assert_eq!(s.arbiter.state().n_unreported(), 2);
        // An outcome counts once, however often it comes.
        s.push(Prediction { grasp_id: 2, phase: Phase::Dropped, ..settled(0.9) });
        for grasp_id in 3..8 {
            if !s.arbiter.state().promise().is_withdrawn() {
                let lifted = Some((grasp_id, Action::Lift, Reason::Stable));
                assert_eq!(try_grasp(&mut s, grasp_id, Some(Phase::Dropped)), lifted);
            }
        }
        assert!(s.arbiter.state().promise().is_withdrawn(), "{:?}", s.arbiter.state().promise());
        let held = Some((8, Action::Hold, Reason::PromiseWithdrawn));
        assert_eq!(try_grasp(&mut s, 8, Some(Phase::Kept)), held);
        // It stays withdrawn in another instance, and asks for no probe, until another share is promised.
        let mut next = LiftArbiter::new(ArbiterOptions { probe: Probe::TestLift, ..options });
        next.restore(s.arbiter.state().clone());
        s.arbiter = next;
        assert_eq!(try_grasp(&mut s, 9, None), Some((9, Action::Hold, Reason::PromiseWithdrawn)));
        s.arbiter.set_options(ArbiterOptions { promised_drops: 0.5, ..options });
        assert_eq!(try_grasp(&mut s, 10, None), Some((10, Action::Lift, Reason::Stable)));
        // Another skin has no outcomes yet that speak for it, but a change hides no drops.
        let mut s = Stream { arbiter: LiftArbiter::new(options), ..stream() };
        for grasp_id in 0..5 {
            try_grasp(&mut s, grasp_id, None);
            let fault = Fault::Changed;
            s.push(Prediction { grasp_id, phase: Phase::Dropped, fault, ..Prediction::default() });
            assert_eq!(s.arbiter.state().promise().since_change(), [0, 1]);
        }
        assert!(s.arbiter.state().promise().is_withdrawn());
        // Without a promise nothing is withdrawn.
        let mut s = stream();
        (0..50).for_each(|grasp_id| _ = try_grasp(&mut s, grasp_id, Some(Phase::Dropped)));
        assert_eq!(try_grasp(&mut s, 50, None), Some((50, Action::Lift, Reason::Stable)));
        assert_eq!(s.arbiter.state().promise().n_dropped, 50);
    }

    #[test]
    fn an_outcome_before_the_decision_holds() {
        for phase in [Phase::Kept, Phase::Dropped] {
            let mut s = stream();
            s.push(settled(0.9)).push(settled(0.9)).push(Prediction { phase, ..settled(0.9) }).push(settled(0.9));
            assert_eq!(s.end(), [(0, Action::Hold, Reason::NoAgreement)]);
        }
    }

    #[test]
    fn a_change_of_mind_starts_the_count_anew() {
        let mut s = stream();
        for probability in [0.9, 0.9, 0.2, 0.9, 0.9] {
            s.push(settled(probability));
        }
        assert_eq!(s.end(), [(0, Action::Hold, Reason::NoAgreement)]);
        let mut s = stream();
        for probability in [0.9, 0.2, 0.2, 0.2] {
            s.push(settled(probability));
        }
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Unstable)]);
    }

    #[test]
    fn agreeing_that_it_cannot_be_told_holds_as_unsure() {
        let unsure = |probability| Prediction { unsure: true, ..settled(probability) };
        let mut s = stream();
        s.push(unsure(0.45))
            .push(unsure(0.4))
            .push(unsure(0.45))
            .push(settled(0.9))
            .push(settled(0.9))
            .push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Unsure)]);
        assert_eq!(s.decisions[0].probability_stable, 0.4);
        // It is a vote of its own: neither for nor against.
        for others in [[0.9, 0.9], [0.1, 0.1]] {
            let mut s = stream();
            s.push(unsure(0.45)).push(settled(others[0])).push(settled(others[1])).push(unsure(0.45));
            assert_eq!(s.end(), [(0, Action::Hold, Reason::NoAgreement)]);
        }
    }

    #[test]
    fn stable_but_not_enough_for_the_arbiter_is_unsure() {
        let options = ArbiterOptions { min_probability_stable: 0.95, ..ArbiterOptions::default() };
        for (probability, expected) in
            [(0.94, (0, Action::Hold, Reason::Unsure)), (0.95, (0, Action::Lift, Reason::Stable))]
        {
            let mut s = Stream { arbiter: LiftArbiter::new(options), ..stream() };
            s.push(settled(probability)).push(settled(probability)).push(settled(probability));
            assert_eq!(s.end(), [expected]);
        }
    }

    #[test]
    fn a_prediction_that_contradicts_itself_is_invalid() {
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push(Prediction { unsure: true, ..settled(0.9) });
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Invalid)]);
    }

    #[test]
    fn closing_frames_neither_vote_nor_decide() {
        let mut s = stream();
        for _ in 0..5 {
            s.push(Prediction { phase: Phase::Closing, ..settled(0.99) });
        }
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Missing)]);
    }

    #[test]
    fn votes_on_both_sides_of_a_movement_do_not_add_up() {
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9));
        s.push(Prediction { phase: Phase::Closing, fault: Fault::NoContact, ..Prediction::default() });
        s.push(settled(0.9)).push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Hold, Reason::NoAgreement)]);
    }

    #[test]
    fn every_fault_holds_with_its_reason() {
        for (fault, reason) in [
            (Fault::NoContact, Reason::NoContact),
            (Fault::WrongLength, Reason::Invalid),
            (Fault::InvalidValue, Reason::Invalid),
            (Fault::Malformed, Reason::Invalid),
            (Fault::WrongHand, Reason::WrongHand),
            (Fault::WrongModel, Reason::WrongModel),
            (Fault::SelfCollision, Reason::SelfCollision),
            (Fault::OutOfDistribution, Reason::OutOfDistribution),
        ] {
            let mut s = stream();
            s.push(settled(0.9)).push(settled(0.9)).push(Prediction { fault, ..settled(0.9) }).push(settled(0.9));
            assert_eq!(s.end(), [(0, Action::Hold, reason)], "{fault:?}");
        }
    }

    #[test]
    fn no_number_that_is_not_a_probability_lifts() {
        for probability in [f64::NAN, f64::INFINITY, -0.1, 1.1] {
            let mut s = stream();
            for _ in 0..3 {
                s.push(Prediction { stable: true, ..settled(probability) });
            }
            assert_eq!(s.end(), [(0, Action::Hold, Reason::Invalid)]);
        }
    }

    #[test]
    fn a_lying_sensor_while_closing_is_remembered_no_contact_is_not() {
        let closing = |fault| Prediction { phase: Phase::Closing, fault, ..Prediction::default() };
        let mut s = stream();
        s.push(closing(Fault::InvalidValue));
        for _ in 0..3 {
            s.push(settled(0.9));
        }
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Invalid)]);
        let mut s = stream();
        s.push(closing(Fault::NoContact)).push(closing(Fault::SelfCollision)).push(closing(Fault::OutOfDistribution));
        for _ in 0..3 {
            s.push(settled(0.9));
        }
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
    }

    #[test]
    fn lost_repeated_and_late_samples_hold() {
        type Spoil = fn(&mut Header);
        let cases: [(Spoil, Reason); 5] = [
            (|header| header.seq += 1, Reason::OutOfOrder),
            (|header| header.seq -= 1, Reason::OutOfOrder),
            (|header| header.stamp_nanos -= 2 * STEP_NANOS, Reason::OutOfOrder),
            (|header| header.stamp_nanos += 100 * STEP_NANOS, Reason::Stale),
            (|header| header.hand_id += 1, Reason::WrongHand),
        ];
        for (spoil, reason) in cases {
            let mut s = stream();
            s.push(settled(0.9)).push(settled(0.9));
            spoil(&mut s.header);
            s.push(settled(0.9));
            assert_eq!(s.end(), [(0, Action::Hold, reason)]);
        }
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push_aged(settled(0.9), 200_000_001);
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Stale)]);
        // The source counts from 0: whoever begins later has missed the grasp's beginning.
        let mut s = stream();
        s.header.seq = 1;
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Hold, Reason::OutOfOrder)]);
    }

    #[test]
    fn the_next_grasp_ends_the_one_before_and_a_decided_one_stays_decided() {
        let mut s = stream();
        s.push(settled(0.9));
        for grasp_id in [1, 1, 1, 0, 0, 0, 1] {
            s.push(Prediction { grasp_id, ..settled(0.9) });
        }
        assert_eq!(s.end(), [(0, Action::Hold, Reason::NoAgreement), (1, Action::Lift, Reason::Stable)]);
    }

    /// Random streams of three grasps with everything that can go wrong: whatever comes, a grasp is decided once, and a
    /// LIFT stands behind `votes` consecutive settled predictions that are stable, sure, faultless, in order and fresh, of a
    /// grasp without any earlier fault that counts.
    #[test]
    fn no_stream_lifts_without_an_unbroken_row_of_votes() {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let mut n_lifts = 0;
        for _ in 0..20_000 {
            let mut s = stream();
            let mut row = 0;
            for grasp_id in 0..3 {
                row = 0;
                let mut is_doubtful = false;
                for _ in 0..rng.random_range(1..8) {
                    let is_settled = rng.random_bool(0.8);
                    let stable = rng.random_bool(0.85);
                    // Now and then together with stable, which no classifier says.
                    let unsure = rng.random_bool(if stable { 0.02 } else { 0.5 });
                    let fault = match rng.random_range(0..40) {
                        0 => Fault::InvalidValue,
                        1 => Fault::OutOfDistribution,
                        2 => Fault::NoContact,
                        _ => Fault::None,
                    };
                    let is_lost = rng.random_bool(0.04);
                    let age_nanos = if rng.random_bool(0.04) { u64::MAX } else { 0 };
                    s.header.seq += u64::from(is_lost);
                    let counts = match fault {
                        Fault::None => false,
                        Fault::InvalidValue => true,
                        _ => is_settled,
                    };
                    is_doubtful |= counts || is_lost || age_nanos != 0 || (stable && unsure);
                    row = if is_settled && stable && !is_doubtful { row + 1 } else { 0 };
                    let n_before = s.decisions.len();
                    let probability_stable = if stable { 0.9 } else { 0.1 };
                    let phase = if is_settled { Phase::Settled } else { Phase::Closing };
                    let prediction = Prediction { grasp_id, phase, fault, unsure, ..settled(probability_stable) };
                    s.push_aged(prediction, age_nanos);
                    let lifts = |decision: &&LiftDecision| decision.action == Action::Lift;
                    for decision in s.decisions[n_before..].iter().filter(lifts) {
                        assert!(decision.grasp_id == grasp_id && row >= 3, "{decision:?} after a row of {row}");
                        n_lifts += 1;
                    }
                }
            }
            let decided: Vec<u64> = s.end().iter().map(|(grasp_id, _, _)| *grasp_id).collect();
            assert_eq!(decided, [0, 1, 2], "a last row of {row}");
        }
        assert!(n_lifts > 1000, "the streams lift too rarely to show anything: {n_lifts}");
    }

    /// Whatever comes, in whatever order: an arbiter that is replaced at any point, by one that knows its state from bytes,
    /// decides as one that is not; each grasp once; and a LIFT stands behind an unbroken row of votes.
    #[test]
    fn an_arbiter_replaced_at_any_point_decides_the_same() {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let (mut n_lifts, mut n_held, mut n_replaced) = (0, 0, 0);
        for _ in 0..10_000 {
            let votes = rng.random_range(1..5);
            let options = ArbiterOptions { votes, ..ArbiterOptions::default() };
            let (mut staying, mut replaced) = (LiftArbiter::new(options), LiftArbiter::new(options));
            let (mut decisions, mut same) = (Vec::new(), Vec::new());
            let mut decided = std::collections::BTreeSet::new();
            let (mut header, mut grasp_id) = (Header::default(), 0);
            // The votes for a LIFT of one grasp right behind one another, and the last of them.
            let mut row = 0;
            let mut last_vote: Option<(u64, Header)> = None;
            for _ in 0..rng.random_range(1..60) {
                if rng.random_bool(0.1) {
                    let config = bincode::config::standard();
                    let bytes = bincode::serde::encode_to_vec(replaced.state(), config).expect("encoded");
                    replaced = LiftArbiter::new(options);
                    replaced.restore(bincode::serde::decode_from_slice(&bytes, config).expect("decoded").0);
                    n_replaced += 1;
                }
                // The next sample of the grasp or of the next one; seldom something else.
                match rng.random_range(0..40) {
                    0 => header.seq += 2,
                    1 => header.seq = header.seq.saturating_sub(rng.random_range(1..4)),
                    2 => header.stamp_nanos += 100 * STEP_NANOS,
                    3 => header.hand_id += 1,
                    4 => header = Header { epoch: header.epoch + 1, seq: rng.random_range(0..2), ..header },
                    6 => header.made_by += 1,
                    5 => grasp_id = rng.random_range(0..=grasp_id),
                    _ => {}
                }
                grasp_id += u64::from(rng.random_bool(0.12));
                let (n_before, before) = (decisions.len(), replaced.state().last.map_or(0, |last| last.epoch));
                let age_nanos = if rng.random_bool(0.03) { options.max_age_nanos + 1 } else { 0 };
                let fault = if rng.random_bool(0.03) { Fault::Malformed } else { Fault::None };
                let phase = if rng.random_bool(0.9) { Phase::Settled } else { Phase::Closing };
                let vote = settled(if rng.random_bool(0.8) { 0.9 } else { 0.1 });
                let prediction = Prediction { grasp_id, phase, fault, ..vote };
                let is_vote = age_nanos == 0 && fault == Fault::None && phase == Phase::Settled && prediction.stable;
                let follows = last_vote.is_some_and(|(of, last)| {
                    let next = Header { seq: last.seq + 1, stamp_nanos: last.stamp_nanos + STEP_NANOS, ..last };
                    of == grasp_id && header == next
                });
                last_vote = is_vote.then_some((grasp_id, header));
                row = if follows && is_vote { row + 1 } else { u32::from(is_vote) };
                match rng.random_range(0..30) {
                    0 => {
                        decisions.extend(staying.on_silence());
                        same.extend(replaced.on_silence());
                        (row, last_vote) = (0, None);
                    }
                    1 => {
                        staying.on_unreadable(&header, grasp_id, &mut decisions);
                        replaced.on_unreadable(&header, grasp_id, &mut same);
                        (row, last_vote) = (0, None);
                    }
                    _ => {
                        staying.on_prediction(&header, &prediction, age_nanos, &mut decisions);
                        replaced.on_prediction(&header, &prediction, age_nanos, &mut same);
                    }
                }
                for decision in &decisions[n_before..] {
                    // A source that starts anew may use its numbers again.
                    let now = replaced.state().last.map_or(0, |last| last.epoch);
                    let epoch = if decision.grasp_id == grasp_id { now } else { before };
                    assert!(decided.insert((epoch, decision.grasp_id)), "decided twice: {decisions:?}");
                }
                header.seq += 1;
                header.stamp_nanos += STEP_NANOS;
                for lift in decisions[n_before..].iter().filter(|decision| decision.action == Action::Lift) {
                    assert!(row >= votes && lift.grasp_id == grasp_id, "{lift:?} after a row of {row}");
                    n_lifts += 1;
                }
            }
            decisions.extend(staying.on_end());
            same.extend(replaced.on_end());
            assert_eq!(decisions, same);
            n_held += decisions.iter().filter(|decision| decision.action == Action::Hold).count();
        }
        assert!(n_lifts > 1000 && n_held > 1000 && n_replaced > 1000, "{n_lifts} {n_held} {n_replaced}");
    }

    #[test]
    fn silence_and_unreadable_samples_hold_their_grasp_once() {
        let mut s = stream();
        assert_eq!(s.arbiter.on_silence(), None);
        s.push(settled(0.9));
        assert_eq!(s.arbiter.on_silence().map(|decision| decision.reason), Some(Reason::Stale));
        let mut decided = |header: &Header, grasp_id| {
            let mut decisions = Vec::new();
            s.arbiter.on_unreadable(header, grasp_id, &mut decisions);
            decisions.iter().map(|decision| (decision.grasp_id, decision.reason)).collect::<Vec<_>>()
        };
        let next = |seq| Header { seq, ..Header::default() };
        assert_eq!(decided(&next(1), 0), []);
        assert_eq!(decided(&next(2), 1), [(1, Reason::Invalid)]);
        assert_eq!(decided(&next(3), 1), []);
    }

    /// An unreadable prediction may have been one of the next grasp, whatever grasp its head names, unless the next prediction
    /// is one of the same grasp; so may missing ones before it.
    #[test]
    fn an_unreadable_prediction_counts_against_the_next_grasp() {
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9));
        s.header.seq = 9;
        s.arbiter.on_unreadable(&s.header, 0, &mut s.decisions);
        s.header.seq += 1;
        s.header.stamp_nanos += 7 * STEP_NANOS;
        for grasp_id in [1, 1, 1, 2, 2, 2] {
            s.push(Prediction { grasp_id, ..settled(0.9) });
        }
        s.arbiter.on_unreadable(&s.header, 2, &mut s.decisions);
        s.header.seq += 1;
        s.header.stamp_nanos += STEP_NANOS;
        for grasp_id in [2, 3, 3, 3] {
            s.push(Prediction { grasp_id, ..settled(0.9) });
        }
        let expected = [
            (0, Action::Lift, Reason::Stable),
            (1, Action::Hold, Reason::OutOfOrder),
            (2, Action::Lift, Reason::Stable),
            (3, Action::Lift, Reason::Stable),
        ];
        assert_eq!(s.end(), expected);
    }

    #[test]
    fn votes_of_two_models_do_not_add_up() {
        let mut s = stream();
        for made_by in [1, 1, 2, 2, 1] {
            s.header.made_by = made_by;
            s.push(settled(0.9));
        }
        assert_eq!(s.decisions, []);
        s.push(settled(0.9)).push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
    }

    /// A bridge repeats its last reading under new numbers.
    #[test]
    fn a_reading_that_is_sent_again_has_one_vote() {
        let mut s = stream();
        for _ in 0..5 {
            s.push(settled(0.9));
            s.header.stamp_nanos -= STEP_NANOS;
        }
        assert_eq!(s.decisions, []);
        s.header.stamp_nanos += STEP_NANOS;
        s.push(settled(0.9)).push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
    }

    /// Another machine's source starts anew while the arbiter stays: its first grasps have numbers that were decided.
    #[test]
    fn a_source_that_starts_anew_may_use_its_numbers_again() {
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9));
        s.header = Header { epoch: 1, ..Header::default() };
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable); 2]);
    }

    #[test]
    fn a_restarted_source_does_not_finish_a_grasp_it_had_begun() {
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9));
        s.header = Header { epoch: 1, ..Header::default() };
        s.push(settled(0.9));
        assert_eq!(s.end(), [(0, Action::Hold, Reason::OutOfOrder)]);
        // A new grasp of a new epoch is trusted from its source's first sample on, and only then.
        for (seq, action) in [(0, Action::Lift), (4, Action::Hold)] {
            let mut s = stream();
            s.push(settled(0.1)).push(settled(0.1)).push(settled(0.1));
            s.header = Header { epoch: 1, seq, ..Header::default() };
            for _ in 0..3 {
                s.push(Prediction { grasp_id: 1, ..settled(0.9) });
            }
            assert_eq!(s.end()[1].1, action, "first sample {seq}");
        }
    }

    #[test]
    fn a_promising_grasp_is_probed_and_only_the_frames_after_it_lift() {
        let probing = || {
            let mut s = stream();
            s.arbiter.set_options(ArbiterOptions { probe: Probe::TestLift, ..ArbiterOptions::default() });
            s
        };
        let of = |phase, probability| Prediction { phase, ..settled(probability) };
        let mut s = probing();
        let last_asked = |s: &mut Stream| {
            let asked = s.decisions.drain(..).map(|decision| (decision.action, decision.reason));
            asked.collect::<Vec<_>>()
        };
        // Stable and unsure both are worth a probe. The source says that it has ended before it hears of it.
        s.push(settled(0.9)).push(Prediction { unsure: true, ..settled(0.4) }).push(settled(0.9));
        s.push(of(Phase::Ended, 0.9));
        assert_eq!(last_asked(&mut s), [(Action::TestLift, Reason::Promising)]);
        let squeeze = |s: &mut Stream, probability| {
            s.push(of(Phase::Squeezing, 0.9));
            (0..3).for_each(|_| _ = s.push(of(Phase::Squeezed, probability)));
        };
        let lifted = |s: &mut Stream| {
            s.push(of(Phase::TestLifting, 0.1));
            (0..3).for_each(|_| _ = s.push(of(Phase::TestLifted, 0.9)));
        };
        squeeze(&mut s, 0.9);
        lifted(&mut s);
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
        let squeezed = |probability| {
            let mut s = probing();
            s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9));
            squeeze(&mut s, probability);
            s
        };
        // A source that waits before the test lift is told to go on, once for each time that it asks.
        let mut s = squeezed(0.9);
        s.push(of(Phase::Ended, 0.9));
        assert_eq!(last_asked(&mut s), [(Action::TestLift, Reason::Promising); 2]);
        lifted(&mut s);
        assert_eq!(s.end(), [(0, Action::Lift, Reason::Stable)]);
        // A tight hand that is not promising ends the grasp, whether the source waits or not; a faulty one at once.
        let mut s = squeezed(0.1);
        s.push(of(Phase::Ended, 0.1));
        lifted(&mut s);
        assert_eq!(s.end()[1..], [(0, Action::Hold, Reason::Unstable)]);
        let mut s = probing();
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9)).push(of(Phase::Squeezing, 0.9));
        s.push(Prediction { fault: Fault::NoContact, ..of(Phase::Squeezed, 0.0) });
        lifted(&mut s);
        assert_eq!(s.end()[1..], [(0, Action::Hold, Reason::NoContact)]);
        // No probe is asked for if the grasp is unstable. After the probe, `ended` ends the grasp. A hand that closes again
        // needs another probe.
        let mut s = probing();
        s.push(settled(0.1)).push(settled(0.1)).push(settled(0.1));
        assert_eq!(s.end(), [(0, Action::Hold, Reason::Unstable)]);
        let mut s = squeezed(0.9);
        s.push(of(Phase::TestLifted, 0.9)).push(of(Phase::Ended, 0.9));
        assert_eq!(s.end()[1..], [(0, Action::Hold, Reason::NoAgreement)]);
        let mut s = squeezed(0.9);
        s.push(of(Phase::Closing, 0.9));
        s.push(of(Phase::TestLifted, 0.9)).push(of(Phase::TestLifted, 0.9)).push(of(Phase::TestLifted, 0.9));
        assert_eq!(s.end()[1..], [(0, Action::Hold, Reason::NoAgreement)]);
        let mut s = squeezed(0.9);
        s.push(Prediction { fault: Fault::MissingReading, ..of(Phase::TestLifted, 0.0) });
        assert_eq!(s.end()[1..], [(0, Action::Hold, Reason::MissingReading)]);
    }

    #[test]
    fn a_lift_is_watched_and_neither_lifted_again_nor_lifted_after_a_hold() {
        let lifting = |probability: f64, unsure: bool| Prediction {
            phase: Phase::Lifting,
            unsure,
            stable: !unsure && probability >= 0.5,
            ..settled(probability)
        };
        let ended = Prediction { phase: Phase::Ended, ..settled(0.9) };
        let said = |s: &mut Stream| -> Vec<Action> { s.decisions.drain(..).map(|decision| decision.action).collect() };
        let mut s = stream();
        s.push(settled(0.9)).push(settled(0.9)).push(settled(0.9)).push(ended.clone());
        assert_eq!(said(&mut s), [Action::Lift], "it has not begun to lift");
        s.push(lifting(0.9, false))
            .push(ended.clone())
            .push(lifting(0.4, true))
            .push(ended.clone())
            .push(ended.clone());
        let reasons: Vec<Reason> = s.decisions.iter().map(|decision| decision.reason).collect();
        assert_eq!(
            reasons,
            [Reason::Stable, Reason::NoAgreement, Reason::NoAgreement],
            "nothing was judged for the last"
        );
        assert_eq!(said(&mut s), [Action::GoOn; 3]);
        s.push(lifting(0.9, false));
        // Two are too few, and a fault or a late frame has no vote.
        s.push(lifting(0.4, true)).push(lifting(0.4, true)).push(lifting(0.9, false));
        s.push(lifting(0.4, true)).push(Prediction { fault: Fault::SensorFault, ..lifting(0.0, false) });
        s.push(lifting(0.4, true)).push_aged(lifting(0.4, true), u64::MAX).push(lifting(0.4, true));
        assert_eq!(said(&mut s), []);
        s.push(lifting(0.4, true)).push(lifting(0.1, false)).push(lifting(0.4, true)).push(ended.clone());
        assert_eq!(said(&mut s), [Action::Tighten, Action::GoOn], "once");
        s.push(lifting(0.1, false)).push(lifting(0.1, false)).push(lifting(0.0, false));
        assert_eq!(s.decisions[0].reason, Reason::Slipping);
        assert_eq!(said(&mut s), [Action::SetDown]);
        s.push(lifting(0.9, false)).push(ended).push(lifting(0.1, false));
        assert_eq!(said(&mut s), [], "that was all");
        // A robot that lifts without having been allowed to is not watched; its grasp is held.
        s.push(Prediction { grasp_id: 1, ..settled(0.9) }).push(Prediction { grasp_id: 1, ..lifting(0.9, false) });
        s.push(Prediction { grasp_id: 1, ..lifting(0.1, false) })
            .push(Prediction { grasp_id: 1, ..lifting(0.1, false) });
        s.push(Prediction { grasp_id: 1, ..lifting(0.1, false) });
        assert_eq!(s.decisions.iter().map(|it| (it.grasp_id, it.action)).collect::<Vec<_>>(), [(1, Action::Hold)]);
        // A lift that was broken off has no outcome that could be missing.
        for grasp_id in [2, 3] {
            for _ in 0..3 {
                s.push(Prediction { grasp_id, ..settled(0.9) });
            }
        }
        assert_eq!(s.arbiter.state().n_unreported(), 1);
    }
}
