//! The lift arbiter decides once per grasp whether the arm may lift, and holds when in doubt.
//!
//! It is a state machine over predictions without a clock: the operator passes the age of each prediction and reports silence.
//! A grasp is decided
//!
//! * LIFT, when `votes` consecutive settled predictions of different times, made by the same operators, say stable and no
//!   earlier prediction of the grasp raised a doubt; with a probe, the predictions after the probe;
//! * HOLD, when `votes` consecutive settled predictions say unstable, or as many say that the model is unsure. A settled
//!   prediction that is faulty holds at once, and a doubt of an earlier one of the grasp at the first settled prediction. A
//!   grasp that is not decided by its end is held then.
//!
//! A wrong "stable" drops the object. So there is one path to LIFT, the `Vote::Stable` of `OpenGrasp::vote`, and every other
//! path ends in HOLD with its reason. With the option `probe`, settled predictions that are not unstable ask for a
//! probe, which decides nothing: the grasp stays open, and only the frames after the probe can lead to a LIFT. Before a
//! test lift, the frames of the tight hand may end the grasp with HOLD. If the
//! outcomes of lifts refute [`ArbiterOptions::promised_drops`], every later grasp is held.
//!
//! While the arm lifts, frames of the phase `lifting` are watched, and `tighten` or `set_down` may follow (`LiftWatch`).

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::decided::Decided;
use crate::lift_watch::LiftWatch;
use crate::promise_monitor::PromiseMonitor;
use crate::source_pace::SourcePace;
use blindgrasp_messages::{Action, Fault, Header, LiftDecision, Phase, Prediction, Reason};

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ArbiterOptions {
    /// How many consecutive settled predictions must agree; at least 1.
    pub votes: u32,
    /// The least probability with which a prediction counts as stable, in place of the model's own threshold, which may be higher;
    /// 0 keeps the model's.
    pub min_probability_stable: f64,
    /// Greatest time between two predictions of a grasp by the source's clock. A later one counts as stale, unless the source
    /// is as slow as that (`SourcePace`).
    pub max_gap_nanos: u64,
    /// Greatest age of a prediction on arrival, since its source published it on this machine.
    pub max_age_nanos: u64,
    /// The probe that the robot can do. A settled grasp that is not unstable is then decided by this probe's frames.
    pub probe: Probe,
    /// The promised share of the lifts that drop the object; 1 promises nothing.
    pub promised_drops: f64,
    /// How many times in a row the robot lifts an object at most: for the bound that its outcomes allow.
    pub lifts_per_object: u32,
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
            // People who test lift an object several times in a row. For others the bound falls five times as slowly.
            lifts_per_object: 5,
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
    /// How a prediction broke the order last: its number, that of the one before, and the nanoseconds between them.
    broken: Option<(u64, u64, i128)>,
    /// The last grasp that was held for want of good frames, and why, sentence by sentence.
    held: Option<(u64, Vec<String>)>,
    /// Epoch and number of the last decided grasp whose hand has opened, and whether it has settled again after that.
    reopened: Option<((u64, u64), bool)>,
}

/// The limit that makes a grasp stale, and what was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Staleness {
    /// Two of its frames are too far apart by the source's clock.
    Gap { found_nanos: u64, limit_nanos: u64 },
    /// A prediction was too old on arrival.
    Age { found_nanos: u64, limit_nanos: u64 },
    /// A prediction may no longer be acted upon: [`Header::valid_nanos`].
    Expiry { found_nanos: u64, limit_nanos: u64 },
    /// A prediction has a time that this machine's clock has not reached.
    Future,
    /// A prediction has no time on this machine's clock.
    Unknown,
    /// No prediction came while it was open.
    Silence { limit_nanos: u64 },
}

impl fmt::Display for Staleness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let millis = |nanos: u64| nanos as f64 / 1e6;
        match *self {
            Staleness::Gap { found_nanos, limit_nanos } => write!(
                f,
                "two frames are {:.1} ms apart, expected at most {:.1} ms (max_gap_ms, or three periods of the source)",
                millis(found_nanos),
                millis(limit_nanos)
            ),
            Staleness::Age { found_nanos, limit_nanos } => {
                let (found, limit) = (millis(found_nanos), millis(limit_nanos));
                write!(f, "a frame was {found:.1} ms old, expected at most {limit:.1} ms (max_age_ms)")
            }
            Staleness::Expiry { found_nanos, limit_nanos } => {
                let (found, limit) = (millis(found_nanos), millis(limit_nanos));
                write!(
                    f,
                    "a frame was {found:.1} ms old, and expired after {limit:.1} ms (deadline_ms of an edge, or its machine)"
                )
            }
            Staleness::Future => f.write_str("a frame's time lies after this machine's clock"),
            Staleness::Unknown => {
                f.write_str("a frame's age is not known: its link has not compared the two machines' clocks yet")
            }
            Staleness::Silence { limit_nanos } => write!(
                f,
                "no frame came for more than {:.1} ms (max_age_ms, or three periods of the source)",
                millis(limit_nanos)
            ),
        }
    }
}

/// What an arbiter knows between predictions. Another arbiter can continue from it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ArbiterState {
    /// The options that the votes were counted with.
    options: ArbiterOptions,
    last: Option<Header>,
    pace: SourcePace,
    open: Option<OpenGrasp>,
    /// Epochs and numbers of decided grasps: a source that starts anew may use its numbers again.
    decided: Decided,
    /// A doubt about samples whose grasp is not known: it counts against the next grasp.
    pending_doubt: Option<Reason>,
    /// The last lifted grasp, if its outcome has not come.
    lifted: Option<u64>,
    /// The last lifted grasp whose object was kept, and the promise before that: it may still be dropped.
    kept: Option<((u64, u64), PromiseMonitor)>,
    /// The watch of the last lift.
    watch: Option<LiftWatch>,
    /// The lifts that were watched before that one: [`WATCH_COUNTS`](crate::lift_watch::WATCH_COUNTS).
    watched: [u64; 2],
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

    /// The numbers of [`WATCH_COUNTS`](crate::lift_watch::WATCH_COUNTS), without the last lift.
    pub fn watched(&self) -> [u64; 2] {
        self.watched
    }
}

/// A grasp that is not decided yet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
struct OpenGrasp {
    /// The epoch of its last prediction.
    epoch: u64,
    grasp_id: u64,
    /// The first problem of a prediction of this grasp. It rules out a LIFT.
    doubt: Option<Reason>,
    /// Why predictions of it are stale.
    stale: Option<Staleness>,
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
        let vote = if !is_before_probe {
            Vote::of(prediction, options)
        } else if prediction.stable || prediction.unsure {
            Vote::Promising
        } else {
            Vote::Unstable
        };
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
    /// It is of the same hand and run of the source as the one before, and later: no more than frames between them may be lost.
    is_later: bool,
    /// Why it is stale, if it is.
    stale: Option<Staleness>,
    /// Its numbers may be used.
    is_valid: bool,
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
        let is_probable = prediction.probability_stable >= options.min_probability_stable;
        if is_probable && (prediction.stable || options.min_probability_stable > 0.0) {
            Vote::Stable
        } else if prediction.stable || prediction.unsure {
            // This includes a prediction that is stable to the model, but too improbable for the arbiter.
            Vote::Unsure
        } else {
            Vote::Unstable
        }
    }
}

impl ArbiterOptions {
    /// Whether a prediction that may decide counts as stable only because `min_probability_stable` is below the model's own
    /// threshold: then the model's bound on drops does not hold.
    pub fn loosens(&self, prediction: &Prediction) -> bool {
        let deciding = self.probe.asked().map_or(Phase::Settled, |(_, phase)| phase);
        prediction.phase == deciding && !prediction.stable && Vote::of(prediction, self) == Vote::Stable
    }

    /// Whether a prediction is too old. Nothing is as old as [`u64::MAX`]: the age of a prediction from the future.
    fn staleness_of(&self, header: &Header, age_nanos: u64) -> Option<Staleness> {
        let found_nanos = age_nanos;
        if age_nanos == u64::MAX {
            Some(Staleness::Future)
        } else if header.origin_nanos == 0 && age_nanos > self.max_age_nanos {
            Some(Staleness::Unknown)
        } else if age_nanos > self.max_age_nanos {
            Some(Staleness::Age { found_nanos, limit_nanos: self.max_age_nanos })
        } else if header.valid_nanos != 0 && age_nanos > header.valid_nanos {
            Some(Staleness::Expiry { found_nanos, limit_nanos: header.valid_nanos })
        } else {
            None
        }
    }
}

impl LiftArbiter {
    /// An arbiter that has seen nothing.
    pub fn new(options: ArbiterOptions) -> Self {
        LiftArbiter {
            options,
            state: ArbiterState { options, ..ArbiterState::default() },
            broken: None,
            held: None,
            reopened: None,
        }
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
            (self.state.promise, self.state.kept) = (PromiseMonitor::default(), None);
        }
        // A bound is of lifts by one rule.
        let rule = |of: &ArbiterOptions| (of.lifts_per_object, of.min_probability_stable, of.votes, of.probe);
        if rule(&self.state.options) != rule(&options) {
            self.state.promise.begin_anew();
            self.state.kept = None;
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
        let silence_nanos = self.silence_limit_nanos();
        self.observe_outcome(header, prediction, arrival.break_in_order);
        if let Some(watch) = &mut self.state.watch
            && (arrival.is_new_reading || prediction.phase == Phase::Ended)
        {
            // A frame after a lost one is judged all the same, but an answer is about the last frames.
            let has_place = arrival.break_in_order.is_none() || arrival.is_later && prediction.phase == Phase::Lifting;
            let is_trusted = has_place && arrival.is_valid && arrival.stale.is_none();
            if arrival.break_in_order.is_some() {
                watch.miss();
            }
            decisions.extend(watch.on_prediction(header, prediction, is_trusted, options.votes.max(1), silence_nanos));
        }
        let Some(open) = self.open((header.epoch, prediction.grasp_id), decisions) else {
            self.note_reuse(header.epoch, prediction);
            return;
        };
        let meaning = open.meaning_of(prediction.phase);
        let faulty = reason_of(prediction.fault, matches!(meaning, PhaseMeaning::Vote));
        let invalid = if arrival.is_valid { None } else { Some(Reason::Invalid) };
        let stale = arrival.stale.map(|_| Reason::Stale);
        open.stale = open.stale.or(arrival.stale);
        open.doubt = open.doubt.or(arrival.break_in_order).or(faulty).or(invalid).or(stale);
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
        if self.state.last.replace(*header).is_some_and(|last| last.epoch != header.epoch) {
            self.state.pace = SourcePace::default();
        }
        if let Some(watch) = self.state.watch.as_mut() {
            watch.miss();
        }
        if self.open((header.epoch, grasp_id), decisions).is_some() {
            decisions.extend(self.hold(Reason::Invalid));
        }
        self.state.pending_doubt = self.state.pending_doubt.or(break_in_order).or(Some(Reason::Invalid));
    }

    /// Holds the open grasp, if any, because no prediction has come for longer than a prediction may be old.
    pub fn on_silence(&mut self) -> Option<LiftDecision> {
        let limit_nanos = self.silence_limit_nanos();
        let open = self.state.open.as_mut()?;
        open.stale = open.stale.or(Some(Staleness::Silence { limit_nanos }));
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

    /// Why a grasp was held that has just been held as stale, out of order, missing or without agreement, sentence by sentence.
    pub fn explain(&self, grasp_id: u64) -> Vec<String> {
        match &self.held {
            Some((held, why)) if *held == grasp_id => why.clone(),
            _ => Vec::new(),
        }
    }

    /// How long no prediction may come while a grasp is open.
    pub fn silence_limit_nanos(&self) -> u64 {
        self.options.max_age_nanos.max(self.state.pace.longest_gap_nanos())
    }

    /// Whether a grasp has begun and is not decided.
    pub fn has_open_grasp(&self) -> bool {
        self.state.open.is_some()
    }

    /// Takes the place of a prediction in the stream: whether it is in order, valid and fresh.
    fn arrive(&mut self, header: &Header, prediction: &Prediction, age_nanos: u64) -> Arrival {
        let grasp_id = prediction.grasp_id;
        let break_in_order = self.break_in_order(header, grasp_id);
        if let (Some(Reason::OutOfOrder), Some(last)) = (break_in_order, &self.state.last) {
            let nanos = i128::from(header.stamp_nanos) - i128::from(last.stamp_nanos);
            self.broken = Some((header.seq, last.seq, nanos));
        }
        let state = &mut self.state;
        let is_open = state.open.as_ref().is_some_and(|open| open.grasp_id == grasp_id);
        let mut stale = self.options.staleness_of(header, age_nanos);
        let (mut is_new_reading, mut is_later) = (true, false);
        if let Some(last) = state.last.replace(*header) {
            is_new_reading = (last.epoch, last.stamp_nanos) != (header.epoch, header.stamp_nanos);
            is_later = (last.epoch, last.hand_id) == (header.epoch, header.hand_id)
                && last.seq < header.seq
                && last.stamp_nanos < header.stamp_nanos;
            if last.epoch != header.epoch {
                state.pace = SourcePace::default();
            } else if break_in_order.is_none() {
                let found_nanos = header.stamp_nanos - last.stamp_nanos;
                let limit_nanos = self.options.max_gap_nanos.max(state.pace.longest_gap_nanos());
                if is_open && found_nanos > limit_nanos {
                    stale = Some(Staleness::Gap { found_nanos, limit_nanos });
                }
                state.pace.observe(found_nanos);
            }
            // A source that was started again may go on with a grasp that is decided, unless it begins with its first sample.
            let goes_on = last.epoch != header.epoch && header.seq != 0;
            if goes_on && state.decided.contains((last.epoch, grasp_id)) {
                state.decided.push((header.epoch, grasp_id), self.options.n_remembered);
            }
        }
        // The samples of a grasp are not mixed with those of the next one, so the doubtful samples were not of that one.
        if break_in_order.is_none() && (is_open || state.decided.contains((header.epoch, grasp_id))) {
            state.pending_doubt = None;
        }
        // A probability that is NaN is not in the range.
        let is_valid = prediction.decision_value.is_finite()
            && (0.0..=1.0).contains(&prediction.probability_stable)
            && !(prediction.stable && prediction.unsure);
        Arrival { break_in_order, is_later, stale, is_valid, is_new_reading }
    }

    /// Counts the outcome of the last lift, once. An object that was kept may be dropped after that, which counts in its place.
    fn observe_outcome(&mut self, header: &Header, prediction: &Prediction, break_in_order: Option<Reason>) {
        let Some(is_kept) = prediction.phase.outcome() else { return };
        let (epoch, grasp_id) = (header.epoch, prediction.grasp_id);
        if !self.state.decided.contains((epoch, grasp_id)) || break_in_order == Some(Reason::WrongHand) {
            return;
        }
        let state = &mut self.state;
        if state.lifted == Some(grasp_id) {
            state.lifted = None;
            if prediction.fault == Fault::Changed {
                state.promise.begin_anew();
            }
            state.kept = is_kept.then(|| ((epoch, grasp_id), state.promise.clone()));
        } else if let Some((_, before)) = state.kept.take_if(|(kept, _)| !is_kept && *kept == (epoch, grasp_id)) {
            state.promise = before;
        } else {
            return;
        }
        let ArbiterOptions { promised_drops, lifts_per_object, .. } = self.options;
        state.promise.observe(!is_kept, promised_drops, lifts_per_object);
    }

    /// Takes note of a decided grasp whose hand opens, and of the first frame with which it settles again.
    fn note_reuse(&mut self, epoch: u64, prediction: &Prediction) {
        let grasp = (epoch, prediction.grasp_id);
        let is_known = self.reopened.is_some_and(|(of, _)| of == grasp);
        match prediction.phase {
            Phase::Open if !is_known => self.reopened = Some((grasp, false)),
            Phase::Settled if is_known => self.reopened = Some((grasp, true)),
            _ => {}
        }
    }

    /// Whether the hand of a grasp, given by epoch and number, has opened and settled again since the grasp was decided: its source
    /// seems to grasp anew under the same number, which decides nothing.
    pub fn is_reused(&self, grasp: (u64, u64)) -> bool {
        self.reopened == Some((grasp, true))
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
            awaited: Phase::Settled,
            ..OpenGrasp::default()
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
        let Some(open) = self.state.open.take() else { return };
        let OpenGrasp { epoch, grasp_id, .. } = open;
        let why = self.grounds(&open, decision.reason);
        // Another run of the source may use the number again.
        if !why.is_empty() || self.held.as_ref().is_some_and(|(held, _)| *held == grasp_id) {
            self.held = Some((grasp_id, why));
        }
        self.state.decided.push((epoch, grasp_id), self.options.n_remembered);
        if decision.action == Action::Lift {
            let before = self.state.lifted.replace(grasp_id);
            let watch = self.state.watch.replace(LiftWatch::new(epoch, grasp_id, decision.probability_stable));
            // A lift that was broken off has no outcome, unless the object was dropped.
            let is_unreported = before.is_some() && !watch.as_ref().is_some_and(LiftWatch::is_set_down);
            if let Some(watch) = watch {
                watch.count_lift(&mut self.state.watched);
            }
            self.state.n_unreported += u64::from(is_unreported);
        }
    }

    /// The limit that a grasp has exceeded, or the frames that did not come, for people.
    fn grounds(&mut self, open: &OpenGrasp, reason: Reason) -> Vec<String> {
        let mut said = Vec::new();
        if let (Reason::Stale | Reason::NoAgreement, Some(stale)) = (reason, open.stale) {
            said.push(stale.to_string());
        }
        match reason {
            Reason::Stale | Reason::NoAgreement if open.is_probe_pending => said.push(format!(
                "no frame of phase {} came after the probe was asked for: let the hand or arm make it and send its frames, or set \
                 probe to none",
                open.awaited.as_str()
            )),
            Reason::NoAgreement if open.n_settled < self.options.votes => {
                let (n_settled, votes) = (open.n_settled, self.options.votes);
                said.push(format!("only {n_settled} of its frames could vote, and {votes} in a row must agree (votes)"));
            }
            Reason::Missing => said.push("no frame of phase settled came before its end".into()),
            Reason::OutOfOrder => {
                let Some((seq, last_seq, nanos)) = self.broken.take() else {
                    return vec!["the first frames of the grasp are missing, or a late frame of another grasp came between its own".into()];
                };
                let (millis, order) = (nanos.abs() as f64 / 1e6, if nanos < 0 { "earlier" } else { "later" });
                said.push(format!("frame {seq} came after frame {last_seq}, by its time {millis:.1} ms {order}"));
            }
            _ => {}
        }
        said
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
        None
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

    /// A prediction, as a letter of a history.
    fn prediction(letter: char) -> Prediction {
        let of = |phase, probability_stable: f64| Prediction {
            phase,
            probability_stable,
            stable: probability_stable >= 0.5,
            ..Prediction::default()
        };
        let faulty = |phase, fault| Prediction { fault, ..of(phase, 0.1) };
        match letter {
            '+' | 'o' => of(Phase::Settled, 0.9),
            '-' => of(Phase::Settled, 0.1),
            '?' => Prediction { unsure: true, ..of(Phase::Settled, 0.4) },
            '*' => Prediction { unsure: true, ..of(Phase::Settled, 0.9) },
            'c' => of(Phase::Closing, 0.9),
            'n' => faulty(Phase::Closing, Fault::NoContact),
            '!' => faulty(Phase::Closing, Fault::InvalidValue),
            's' => of(Phase::Squeezing, 0.9),
            'q' => of(Phase::Squeezed, 0.9),
            'p' => of(Phase::Squeezed, 0.1),
            'f' => faulty(Phase::Squeezed, Fault::NoContact),
            'l' => of(Phase::TestLifting, 0.1),
            't' => of(Phase::TestLifted, 0.9),
            'm' => faulty(Phase::TestLifted, Fault::MissingReading),
            'a' => of(Phase::Lifting, 0.9),
            'w' | 'y' => Prediction { unsure: true, ..of(Phase::Lifting, 0.4) },
            'z' => Prediction { unsure: true, ..of(Phase::Lifting, 0.45) },
            'v' => of(Phase::Lifting, 0.1),
            'x' => faulty(Phase::Lifting, Fault::SensorFault),
            'e' => of(Phase::Ended, 0.9),
            'k' => of(Phase::Kept, 0.9),
            'd' => of(Phase::Dropped, 0.9),
            'C' => faulty(Phase::Dropped, Fault::Changed),
            _ => panic!("no prediction is written '{letter}'"),
        }
    }

    struct Stream {
        arbiter: LiftArbiter,
        header: Header,
        grasp_id: u64,
    }

    fn stream(options: ArbiterOptions) -> Stream {
        Stream { arbiter: LiftArbiter::new(options), header: Header::default(), grasp_id: 0 }
    }

    impl Stream {
        fn advance(&mut self) {
            self.header.seq += 1;
            self.header.stamp_nanos += STEP_NANOS;
        }

        fn push(&mut self, prediction: Prediction, age_nanos: u64) -> Vec<LiftDecision> {
            let mut decisions = Vec::new();
            let prediction = Prediction { grasp_id: self.grasp_id, ..prediction };
            self.arbiter.on_prediction(&self.header, &prediction, age_nanos, &mut decisions);
            self.advance();
            decisions
        }

        /// An input, or a change of the inputs after it.
        fn take(&mut self, letter: char) -> Vec<LiftDecision> {
            let header = &mut self.header;
            match letter {
                'N' => self.grasp_id += 1,
                'P' => self.grasp_id = self.grasp_id.saturating_sub(1),
                'L' => header.seq += 1,
                'R' => header.seq = header.seq.saturating_sub(1),
                'B' => header.stamp_nanos = header.stamp_nanos.saturating_sub(2 * STEP_NANOS),
                '=' => header.stamp_nanos = header.stamp_nanos.saturating_sub(STEP_NANOS),
                'G' => header.stamp_nanos += 100 * STEP_NANOS,
                'H' => header.hand_id += 1,
                'M' => header.made_by = 1 - header.made_by,
                'E' => *header = Header { epoch: header.epoch + 1, ..Header::default() },
                'U' => {
                    let mut decisions = Vec::new();
                    self.arbiter.on_unreadable(header, self.grasp_id, &mut decisions);
                    self.advance();
                    return decisions;
                }
                'Z' => return self.arbiter.on_silence().into_iter().collect(),
                '$' => return self.arbiter.on_end().into_iter().collect(),
                'o' | 'y' => return self.push(prediction(letter), self.arbiter.options.max_age_nanos + 1),
                _ => return self.push(prediction(letter), 0),
            }
            vec![]
        }

        /// Takes a history, whose brackets hold the decisions that follow from the letter before them.
        #[track_caller]
        fn takes(&mut self, history: &str) {
            let mut found = String::new();
            let mut is_input = true;
            for letter in history.chars() {
                is_input |= letter == ']';
                if is_input && letter != '[' && letter != ']' {
                    found.push(letter);
                    for decision in self.take(letter) {
                        found += &format!("[{} {:?} {:?}]", decision.grasp_id, decision.action, decision.reason);
                    }
                }
                is_input &= letter != '[';
            }
            assert_eq!(found, history);
        }
    }

    #[test]
    fn histories_are_decided_as_written() {
        for history in [
            "+++[0 Lift Stable]---$",
            "c---[0 Hold Unstable]",
            "+---[0 Hold Unstable]",
            "c+-e[0 Hold NoAgreement]",
            "c+-$[0 Hold NoAgreement]",
            "++-++$[0 Hold NoAgreement]",
            // An outcome before the decision.
            "++k[0 Hold NoAgreement]+$",
            "++d[0 Hold NoAgreement]+$",
            // Unsure is a vote of its own, neither for nor against. Unsure and stable at once is no prediction.
            "c???[0 Hold Unsure]+++$",
            "?++?$[0 Hold NoAgreement]",
            "?--?$[0 Hold NoAgreement]",
            "++*[0 Hold Invalid]$",
            // Closing frames neither vote nor decide, and votes on both sides of a movement do not add up.
            "ccccc$[0 Hold Missing]",
            "++n++$[0 Hold NoAgreement]",
            // A lying sensor while closing is remembered.
            "!+[0 Hold Invalid]++$",
            // A grasp whose source has no more frames is decided and stays so, and a doubt is still the reason.
            "++e[0 Hold NoAgreement]N+++[1 Lift Stable]eNe[2 Hold Missing]N!e[3 Hold Invalid]$",
            // The next grasp ends the one before. A sample of a decided grasp amid another one holds that one.
            "+N+[0 Hold NoAgreement]++[1 Lift Stable]P+++N+$",
            "+++[0 Lift Stable]N++P+N+[1 Hold OutOfOrder]++$",
            // Lost, repeated and late samples. A source counts from 0, so that a later first sample has missed the beginning.
            "++L+[0 Hold OutOfOrder]$",
            "++R+[0 Hold OutOfOrder]$",
            "++B+[0 Hold OutOfOrder]$",
            "++G+[0 Hold Stale]$",
            "++H+[0 Hold WrongHand]$",
            "++o[0 Hold Stale]$",
            "co[0 Hold Stale]$",
            "L+[0 Hold OutOfOrder]++$",
            // Silence and unreadable samples hold their grasp once.
            "Z+Z[0 Hold Stale]UNU[1 Hold Invalid]U$",
            // An unreadable prediction may have been one of the next grasp, whatever grasp its head names, unless the next
            // prediction is one of the same grasp; so may missing ones before it.
            "+++[0 Lift Stable]LUN+[1 Hold OutOfOrder]++N+++[2 Lift Stable]U+N+++[3 Lift Stable]$",
            // Votes of two models do not add up. A bridge that repeats its last reading under new numbers has one vote.
            "++M++M+++[0 Lift Stable]$",
            "+=+=+=+=+++[0 Lift Stable]$",
            // A source that starts anew may use its numbers again, but does not finish a grasp that it had begun. A new grasp of
            // a new epoch is trusted from its source's first sample on, and only then.
            "+++[0 Lift Stable]E+++[0 Lift Stable]$",
            "++E+[0 Hold OutOfOrder]$",
            "---[0 Hold Unstable]EN+++[1 Lift Stable]$",
            "---[0 Hold Unstable]ELLLLN+[1 Hold OutOfOrder]++$",
        ] {
            stream(ArbiterOptions::default()).takes(history);
        }
    }

    #[test]
    fn a_slow_hand_is_decided_once_its_pace_is_known_and_held_if_it_stops() {
        const SLOW_NANOS: u64 = 125_000_000;
        let mut s = stream(ArbiterOptions::default());
        let reasons = |s: &mut Stream, letters: &str| -> Vec<Reason> {
            let mut reasons = Vec::new();
            for letter in letters.chars() {
                s.header.stamp_nanos += SLOW_NANOS - STEP_NANOS;
                reasons.extend(s.take(letter).into_iter().map(|decision| decision.reason));
            }
            reasons
        };
        let gap = |found_ms: &str, limit_ms: &str| {
            let limit = "(max_gap_ms, or three periods of the source)";
            vec![format!("two frames are {found_ms} ms apart, expected at most {limit_ms} ms {limit}")]
        };
        assert_eq!(s.arbiter.silence_limit_nanos(), 200_000_000);
        assert_eq!((reasons(&mut s, "cccc+"), s.arbiter.explain(0)), (vec![Reason::Stale], gap("125.0", "100.0")));
        // Frames of a decided grasp show the pace as well.
        assert_eq!(reasons(&mut s, "++++"), []);
        s.take('N');
        assert_eq!((reasons(&mut s, "c+++"), s.arbiter.explain(1)), (vec![Reason::Stable], vec![]));
        assert_eq!(s.arbiter.silence_limit_nanos(), 375_000_000);
        s.take('N');
        assert_eq!(reasons(&mut s, "cc+"), []);
        s.header.stamp_nanos += 2 * SLOW_NANOS + 1_000_000;
        assert_eq!((reasons(&mut s, "+"), s.arbiter.explain(2)), (vec![Reason::Stale], gap("376.0", "375.0")));
        // Another source has shown no pace.
        s.take('E');
        s.take('N');
        assert_eq!((reasons(&mut s, "cc+"), s.arbiter.explain(3)), (vec![Reason::Stale], gap("125.0", "100.0")));
    }

    #[test]
    fn a_fast_source_that_stands_still_now_and_then_is_held() {
        let mut s = stream(ArbiterOptions::default());
        for _ in 0..5 {
            assert_eq!(s.take('c'), []);
            s.header.stamp_nanos += 900_000_000;
            assert_eq!(s.take('c'), []);
        }
        assert_eq!(s.take('+').first().map(|decision| decision.reason), Some(Reason::Stale));
    }

    #[test]
    fn a_stale_grasp_names_its_limit() {
        let options = ArbiterOptions::default();
        let header = Header { origin_nanos: 1, valid_nanos: 50_000_000, ..Header::default() };
        let said = |age_nanos| options.staleness_of(&header, age_nanos).map(|staleness| staleness.to_string());
        assert_eq!(said(50_000_000), None);
        let [expired, old, future] = [60_000_000, 312_000_000, u64::MAX].map(|age| said(age).expect("stale"));
        assert_eq!(
            expired,
            "a frame was 60.0 ms old, and expired after 50.0 ms (deadline_ms of an edge, or its machine)"
        );
        assert_eq!(old, "a frame was 312.0 ms old, expected at most 200.0 ms (max_age_ms)");
        assert!(future.contains("after this machine's clock"), "{future}");
        let unknown =
            options.staleness_of(&Header::default(), 86_400_000_000_000).map(|staleness| staleness.to_string());
        assert!(unknown.is_some_and(|unknown| unknown.contains("is not known")));
    }

    #[test]
    fn a_promising_grasp_is_probed_and_only_the_frames_after_it_lift() {
        for history in [
            // Stable and unsure both are worth a probe. The source says that it has ended before it hears of it.
            "+?+[0 TestLift Promising]esqqqlttt[0 Lift Stable]$",
            // A source that waits before the test lift is told to go on, once for each time that it asks.
            "+++[0 TestLift Promising]sqqqe[0 TestLift Promising]lttt[0 Lift Stable]$",
            // A tight hand that is not promising ends the grasp, whether the source waits or not; a faulty one at once.
            "+++[0 TestLift Promising]sppp[0 Hold Unstable]elttt$",
            "+++[0 TestLift Promising]sf[0 Hold NoContact]lttt$",
            // No probe is asked for if the grasp is unstable. After the probe, `ended` ends the grasp. A hand that closes again
            // needs another probe.
            "---[0 Hold Unstable]$",
            "+++[0 TestLift Promising]sqqqte[0 Hold NoAgreement]$",
            "+++[0 TestLift Promising]sqqqcttt$[0 Hold NoAgreement]",
            "+++[0 TestLift Promising]sqqqm[0 Hold MissingReading]$",
        ] {
            stream(ArbiterOptions { probe: Probe::TestLift, ..ArbiterOptions::default() }).takes(history);
        }
    }

    #[test]
    fn a_hold_after_a_probe_that_did_not_come_says_so() {
        let mut s = stream(ArbiterOptions { probe: Probe::TestLift, ..ArbiterOptions::default() });
        s.takes("+++[0 TestLift Promising]+Nc[0 Hold NoAgreement]");
        assert!(
            s.arbiter.explain(0)[0].starts_with("no frame of phase test_lifted came after the probe was asked for: ")
        );
        s.takes("+++[1 TestLift Promising]Z[1 Hold Stale]");
        let [silent, unanswered] = &s.arbiter.explain(1)[..] else { panic!("two sentences") };
        assert!(silent.starts_with("no frame came for more than ") && unanswered.contains(" test_lifted "), "{silent}");
        // The probe came, and its frames do not agree.
        s.takes("N+++[2 TestLift Promising]sqqqlte[2 Hold NoAgreement]");
        assert_eq!(s.arbiter.explain(2), Vec::<String>::new());
    }

    #[test]
    fn a_grasp_that_lacks_frames_or_their_order_says_so() {
        let mut s = stream(ArbiterOptions::default());
        for (grasp_id, history, said) in [
            (0, "cce[0 Hold Missing]", "no frame of phase settled came before its end"),
            (1, "N++e[1 Hold NoAgreement]", "only 2 of its frames could vote, and 3 in a row must agree (votes)"),
            (2, "NcL+[2 Hold OutOfOrder]", "frame 8 came after frame 6, by its time 10.0 ms later"),
            (3, "NcB+[3 Hold OutOfOrder]", "frame 10 came after frame 9, by its time 10.0 ms earlier"),
            (4, "N+-+e[4 Hold NoAgreement]", ""),
        ] {
            s.takes(history);
            assert_eq!(s.arbiter.explain(grasp_id).join("; "), said);
        }
        // Another run of the source has a grasp of the same number, which has another reason.
        s.takes("N+e[5 Hold NoAgreement]E---[5 Hold Unstable]");
        assert_eq!(s.arbiter.explain(5), Vec::<String>::new());
    }

    #[test]
    fn a_lift_is_watched_and_neither_lifted_again_nor_lifted_after_a_hold() {
        let mut s = stream(ArbiterOptions::default());
        // It has not begun to lift; then nothing was judged for the last.
        s.takes("+++[0 Lift Stable]eaaae[0 GoOn Stable]aawe[0 GoOn NoAgreement]e[0 GoOn NoAgreement]");
        // Two are too few, and a fault or a late frame has no vote and takes none.
        s.takes("awwawxw");
        s.takes("yw[0 Tighten Slipping]we[0 GoOn NoAgreement]");
        s.takes("aaae[0 GoOn Stable]vxvLv[0 SetDown Slipping]aev");
        // A robot that lifts without having been allowed to is not watched; its grasp is held.
        s.takes("N+a[1 Hold NoAgreement]vvv");
        // A lift that was broken off has no outcome that could be missing.
        s.takes("N+++[2 Lift Stable]N+++[3 Lift Stable]");
        assert_eq!(s.arbiter.state().n_unreported(), 1);
        // The arm did not lift the other two.
        assert_eq!(s.arbiter.state().watched(), [1, 1]);
    }

    #[test]
    fn an_answer_while_the_arm_lifts_is_about_the_last_frames() {
        for (history, expected) in [
            ("aaae", Reason::Stable),
            // Too few, a fault at the end, a lost frame before the question, a question that comes late, and an unreadable frame.
            ("aae", Reason::NoAgreement),
            ("aaaaxe", Reason::NoAgreement),
            ("aaaaLe", Reason::NoAgreement),
            ("aaaaGe", Reason::NoAgreement),
            ("aaaaUe", Reason::NoAgreement),
            ("vvxe", Reason::NoAgreement),
            ("aLaaae", Reason::Stable),
            // A frame is lost between the votes, or they are far apart.
            ("aaLae", Reason::NoAgreement),
            ("aaGae", Reason::NoAgreement),
        ] {
            let mut s = stream(ArbiterOptions::default());
            s.takes("+++[0 Lift Stable]");
            let said: Vec<LiftDecision> = history.chars().flat_map(|letter| s.take(letter)).collect();
            let said: Vec<_> = said.iter().map(|decision| (decision.action, decision.reason)).collect();
            assert_eq!(said, [(Action::GoOn, expected)], "{history}");
            // Frames before a question answer no later question.
            s.takes("e[0 GoOn NoAgreement]");
        }
    }

    #[test]
    fn a_number_that_is_used_again_is_noticed() {
        let mut open = prediction('c');
        open.phase = Phase::Open;
        let mut s = stream(ArbiterOptions::default());
        s.takes("c+++[0 Lift Stable]++e");
        assert_eq!(s.push(open, 0), []);
        s.takes("cc");
        assert!(!s.arbiter.is_reused((0, 0)));
        s.takes("+++");
        assert!(s.arbiter.is_reused((0, 0)) && !s.arbiter.is_reused((0, 1)));
        // Another run of the source has a grasp of this number.
        s.takes("E+++[0 Lift Stable]+");
        assert!(!s.arbiter.is_reused((1, 0)));
    }

    #[test]
    fn a_hand_tightens_in_steps_while_the_load_does_not_fall() {
        let mut s = stream(ArbiterOptions::default());
        // Six readings after a step the next one may follow, and none after the third.
        s.takes(
            "+++[0 Lift Stable]www[0 Tighten Slipping]wwwwww[0 Tighten Slipping]wwwwzz[0 Tighten Slipping]zzzzzzzzz",
        );
        // A load that recovers for a time is no reason for another step, nor is one that falls.
        s.takes("N+++[1 Lift Stable]zzz[1 Tighten Slipping]zzzzzazzzzzzzz");
        s.takes("z[1 Tighten Slipping]zzzzzwzzzzzzzzzvvv[1 SetDown Slipping]");
    }

    #[test]
    fn lifts_that_drop_more_often_than_promised_withdraw_the_promise() {
        let options = ArbiterOptions { promised_drops: 0.05, ..ArbiterOptions::default() };
        let mut s = stream(options);
        // Two lifts are not reported, and the outcome of a grasp that was not lifted last is not counted.
        s.takes("+++[0 Lift Stable]N+++[1 Lift Stable]PdNN+++[2 Lift Stable]k");
        assert_eq!((s.arbiter.state().promise().n_kept, s.arbiter.state().promise().n_dropped), (1, 0));
        assert_eq!(s.arbiter.state().n_unreported(), 2);
        // An outcome counts once, however often it comes; but an object that was kept may be dropped later.
        s.takes("kd");
        assert_eq!((s.arbiter.state().promise().n_kept, s.arbiter.state().promise().n_dropped), (0, 1));
        s.takes("dk");
        assert_eq!((s.arbiter.state().promise().n_kept, s.arbiter.state().promise().n_dropped), (0, 1));
        s.takes("N+++[3 Lift Stable]dN+++[4 Lift Stable]dN+++[5 Lift Stable]dN+[6 Hold PromiseWithdrawn]++k");
        // It stays withdrawn in another instance, and asks for no probe, until another share is promised.
        let mut next = LiftArbiter::new(ArbiterOptions { probe: Probe::TestLift, ..options });
        next.restore(s.arbiter.state().clone());
        s.arbiter = next;
        s.takes("N+[7 Hold PromiseWithdrawn]++");
        s.arbiter.set_options(ArbiterOptions { promised_drops: 0.5, ..options });
        s.takes("N+++[8 Lift Stable]");
        // Another skin has no outcomes yet that speak for it, but a change hides no drops.
        let mut s = stream(options);
        for grasp_id in 0..5 {
            "+++CN".chars().for_each(|letter| _ = s.take(letter));
            assert_eq!(s.arbiter.state().promise().since_change(), [0, 1], "{grasp_id}");
        }
        assert!(s.arbiter.state().promise().is_withdrawn());
        // Without a promise nothing is withdrawn.
        let mut s = stream(ArbiterOptions::default());
        (0..50).for_each(|grasp_id| s.takes(&format!("+++[{grasp_id} Lift Stable]dN")));
        assert_eq!(s.arbiter.state().promise().n_dropped, 50);
    }

    #[test]
    fn a_decision_has_the_lowest_probability_of_its_votes() {
        let unsure = |probability_stable| Prediction { probability_stable, ..prediction('?') };
        let stable = |probability_stable| Prediction { probability_stable, ..prediction('+') };
        for (votes, expected) in [([0.9, 0.8, 0.95].map(stable), 0.8), ([0.45, 0.4, 0.45].map(unsure), 0.4)] {
            let mut s = stream(ArbiterOptions::default());
            let decided: Vec<LiftDecision> = votes.into_iter().flat_map(|vote| s.push(vote, 0)).collect();
            assert_eq!(decided.iter().map(|decision| decision.probability_stable).collect::<Vec<_>>(), [expected]);
        }
    }

    #[test]
    fn no_number_that_is_not_a_probability_lifts_nor_one_that_is_too_low_for_the_arbiter() {
        let options = ArbiterOptions { min_probability_stable: 0.95, ..ArbiterOptions::default() };
        for (probability_stable, expected) in [
            (f64::NAN, Reason::Invalid),
            (f64::INFINITY, Reason::Invalid),
            (-0.1, Reason::Invalid),
            (1.1, Reason::Invalid),
            (0.94, Reason::Unsure),
            (0.95, Reason::Stable),
        ] {
            let mut s = stream(options);
            let vote = Prediction { probability_stable, ..prediction('+') };
            let decided: Vec<Reason> = (0..3).flat_map(|_| s.push(vote.clone(), 0)).map(|it| it.reason).collect();
            assert_eq!(decided, [expected], "{probability_stable}");
        }
    }

    #[test]
    fn a_threshold_below_the_models_lifts_what_the_model_would_hold() {
        // The model calls 0.1 unstable and 0.4 unsure.
        for (min_probability_stable, histories) in [
            (0.0, ["---[0 Hold Unstable]", "???[0 Hold Unsure]"]),
            (0.2, ["---[0 Hold Unstable]", "???[0 Lift Stable]"]),
            (0.05, ["---[0 Lift Stable]", "???[0 Lift Stable]"]),
        ] {
            let options = ArbiterOptions { min_probability_stable, ..ArbiterOptions::default() };
            histories.into_iter().for_each(|history| stream(options).takes(history));
            let loosens = ['-', '?', '+', 'l'].map(|letter| options.loosens(&prediction(letter)));
            let is_below = |probability| min_probability_stable > 0.0 && min_probability_stable <= probability;
            assert_eq!(loosens, [is_below(0.1), is_below(0.4), false, false]);
        }
        // It is for the frames that decide: an unstable grasp gets no probe, and no lift without one.
        let options =
            ArbiterOptions { min_probability_stable: 0.05, probe: Probe::TestLift, ..ArbiterOptions::default() };
        stream(options).takes("---[0 Hold Unstable]");
        assert!(!options.loosens(&prediction('-')));
    }

    #[test]
    fn every_fault_holds_at_once_with_its_reason_however_late_it_comes() {
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
            for (before, age_nanos) in [("c", 0), ("++", 0), ("c", u64::MAX)] {
                let mut s = stream(ArbiterOptions::default());
                s.takes(before);
                let decided = s.push(Prediction { fault, ..prediction('+') }, age_nanos);
                assert_eq!(
                    decided.iter().map(|it| it.reason).collect::<Vec<_>>(),
                    [reason],
                    "{fault:?} after {before}"
                );
                s.takes("+$");
            }
        }
        let mut s = stream(ArbiterOptions::default());
        for fault in [Fault::NoContact, Fault::SelfCollision, Fault::OutOfDistribution] {
            s.push(Prediction { fault, ..prediction('c') }, 0);
        }
        s.takes("+++[0 Lift Stable]$");
    }

    #[test]
    fn an_arbiter_replaced_at_any_point_by_one_that_reads_its_state_decides_the_same() {
        use rand::{RngExt, SeedableRng};
        let letters: Vec<char> = "++++++++++++++++++++++++++++++--?cNNNNPLRBGHMEUZo!=".chars().collect();
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let (mut n_lifts, mut n_held, mut n_replaced) = (0, 0, 0);
        for _ in 0..10_000 {
            let options = ArbiterOptions { votes: rng.random_range(1..5), ..ArbiterOptions::default() };
            let (mut staying, mut replaced) = (stream(options), stream(options));
            let mut history = String::new();
            for _ in 0..rng.random_range(1..60) {
                if rng.random_bool(0.1) {
                    let config = bincode::config::standard();
                    let bytes = bincode::serde::encode_to_vec(replaced.arbiter.state(), config).expect("encoded");
                    replaced.arbiter = LiftArbiter::new(options);
                    replaced.arbiter.restore(bincode::serde::decode_from_slice(&bytes, config).expect("decoded").0);
                    n_replaced += 1;
                }
                let letter = letters[rng.random_range(0..letters.len())];
                history.push(letter);
                let decisions = staying.take(letter);
                assert_eq!(decisions, replaced.take(letter), "{history}");
                n_lifts += decisions.iter().filter(|decision| decision.action == Action::Lift).count();
                n_held += decisions.iter().filter(|decision| decision.action == Action::Hold).count();
            }
            assert_eq!(staying.arbiter.on_end(), replaced.arbiter.on_end(), "{history}");
        }
        assert!(n_lifts > 1000 && n_held > 1000 && n_replaced > 1000, "{n_lifts} {n_held} {n_replaced}");
    }
}
