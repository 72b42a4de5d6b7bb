//! Watches a lift that the arbiter has allowed: contacts that creep show nothing before the arm lifts.
//!
//! The classifier judges each frame of the phase `lifting` by the load that is left
//! ([`GraspHistory::judge_lifting`](crate::probe::GraspHistory::judge_lifting)). As many consecutive readings as an arbiter
//! takes votes for a decision ask for a reaction: `tighten` when it is unsure, and `set_down` when it is unstable.
//! A reading that is faulty, late or older than the last one has no vote, and takes none from those before it. The watch never
//! lifts: a grasp that was held stays so.
//!
//! Fingers that press harder may press a light, smooth object out of the hand. So each `tighten` asks for a step, and another
//! follows while the load stays low, unless the load has fallen since the step before.

use serde::{Deserialize, Serialize};

use blindgrasp_messages::{Action, Fault, Header, LiftDecision, Phase, Prediction, Reason};

/// The counts of an arbiter's node: lifts that were watched, and those of them in which the hand was told to tighten.
pub const WATCH_COUNTS: [&str; 2] = ["lifts/watched", "lifts/tightened"];

/// Fewer lifts say nothing of a robot. In simulated worlds the hand is told to tighten in at most 20 % of the lifts where
/// nothing creeps, and in 39 to 80 % of those where contacts creep.
const FEWEST_LIFTS: u64 = 10;

/// That a robot's contacts creep, in words, if the hand was told to tighten in most lifts. The numbers are those of
/// [`WATCH_COUNTS`].
pub fn creep([n_watched, n_tightened]: [u64; 2]) -> Option<String> {
    if n_watched < FEWEST_LIFTS || 2 * n_tightened <= n_watched {
        return None;
    }
    Some(format!(
        "this robot's contacts creep: the hand was told to tighten in {n_tightened} of {n_watched} lifts: check its rubber and \
         gears"
    ))
}

/// The most orders to tighten in one lift. Each takes an equal part of the way from the force at the first one to that of a lift.
pub const TIGHTEN_STEPS: u32 = 3;

/// The watch of one lift.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct LiftWatch {
    epoch: u64,
    grasp_id: u64,
    /// The operators that made the votes: [`Header::made_by`].
    made_by: u64,
    /// The latest consecutive votes that are not stable, and those of them that are unstable.
    n_slipping: u32,
    n_unstable: u32,
    /// The latest consecutive readings that have a stable vote, and the time of the last vote by the source's clock. They are
    /// those since the source asked.
    n_stable: u32,
    voted_nanos: u64,
    probability_stable: f64,
    has_begun: bool,
    /// The orders to tighten; [`TIGHTEN_STEPS`] also once no more may follow.
    n_steps: u32,
    /// The part of the load that was felt at the last order to tighten.
    part_at_step: f64,
    is_set_down: bool,
}

impl LiftWatch {
    /// The watch of a grasp that may be lifted, by its source's epoch.
    pub(crate) fn new(epoch: u64, grasp_id: u64, probability_stable: f64) -> LiftWatch {
        LiftWatch { epoch, grasp_id, probability_stable, ..LiftWatch::default() }
    }

    /// Counts the lift among those that [`WATCH_COUNTS`] names.
    pub(crate) fn count_lift(&self, [n_watched, n_tightened]: &mut [u64; 2]) {
        *n_watched += u64::from(self.has_begun);
        *n_tightened += u64::from(self.n_steps > 0);
    }

    /// Whether the arm was told to set the object down.
    pub(crate) fn is_set_down(&self) -> bool {
        self.is_set_down
    }

    /// Starts the counts at zero again.
    pub(crate) fn forget_votes(&mut self) {
        (self.n_stable, self.n_slipping, self.n_unstable) = (0, 0, 0);
    }

    /// Takes note of a reading that was lost or could not be judged.
    pub(crate) fn miss(&mut self) {
        self.n_stable = 0;
    }

    fn has_voted_within(&self, nanos: u64, header: &Header) -> bool {
        header.stamp_nanos.saturating_sub(self.voted_nanos) <= nanos
    }

    /// Takes a prediction, and returns the action that the arm should take, if any. A prediction that is not trusted has no
    /// vote. `votes` is
    /// [`ArbiterOptions::votes`](crate::lift_arbiter::ArbiterOptions::votes), and a vote counts for an answer for `fresh_nanos`.
    pub(crate) fn on_prediction(
        &mut self,
        header: &Header,
        prediction: &Prediction,
        is_trusted: bool,
        votes: u32,
        fresh_nanos: u64,
    ) -> Option<LiftDecision> {
        let is_of_lift = (header.epoch, prediction.grasp_id) == (self.epoch, self.grasp_id);
        if !is_of_lift || self.is_set_down {
            return None;
        }
        match prediction.phase {
            Phase::Lifting => {
                self.has_begun = true;
                if !self.has_voted_within(fresh_nanos, header) {
                    self.miss();
                }
                self.count(header, prediction, is_trusted);
                if self.n_unstable >= votes {
                    self.is_set_down = true;
                    return Some(self.says(Action::SetDown, Reason::Slipping));
                }
                if self.tightens(votes) { Some(self.says(Action::Tighten, Reason::Slipping)) } else { None }
            }
            Phase::Ended if self.has_begun => {
                let n_stable = std::mem::take(&mut self.n_stable);
                let is_stable = is_trusted && self.has_voted_within(fresh_nanos, header) && n_stable >= votes;
                Some(self.says(Action::GoOn, if is_stable { Reason::Stable } else { Reason::NoAgreement }))
            }
            _ => None,
        }
    }

    /// Whether the hand should tighten by a step. Before another one, the hand has the time of `votes` readings to obey, and as
    /// many show what became of the load.
    fn tightens(&mut self, votes: u32) -> bool {
        if self.n_steps == TIGHTEN_STEPS || self.n_slipping < votes * (1 + 2 * self.n_steps) {
            return false;
        }
        if self.n_steps > 0 && self.probability_stable < self.part_at_step {
            self.n_steps = TIGHTEN_STEPS;
            return false;
        }
        self.n_steps += 1;
        self.part_at_step = self.probability_stable;
        true
    }

    fn count(&mut self, header: &Header, prediction: &Prediction, is_trusted: bool) {
        if !is_trusted || prediction.fault != Fault::None {
            self.miss();
            return;
        }
        // A model agrees with itself only.
        if std::mem::replace(&mut self.made_by, header.made_by) != header.made_by {
            self.forget_votes();
        }
        let is_unstable = !prediction.stable && !prediction.unsure;
        let counted = |n: u32, is_one: bool| if is_one { n + 1 } else { 0 };
        self.n_stable = counted(self.n_stable, prediction.stable);
        self.n_slipping = counted(self.n_slipping, !prediction.stable);
        self.n_unstable = counted(self.n_unstable, is_unstable);
        self.voted_nanos = header.stamp_nanos;
        self.probability_stable = prediction.probability_stable;
    }

    fn says(&self, action: Action, reason: Reason) -> LiftDecision {
        let LiftWatch { grasp_id, probability_stable, .. } = *self;
        LiftDecision { grasp_id, action, reason, probability_stable }
    }
}
