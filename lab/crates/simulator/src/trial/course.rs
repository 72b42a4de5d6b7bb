//! The course of many trials: the order of attempts, the numbers of their samples, and the state from which a process goes
//! on after a crash with the same samples.
//!
//! An attempt is a pure function of seed, trial and attempt, so all that is kept of one is where it stands and how it ended.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::{ProbeMove, Reaction};
use blindgrasp_messages::{GraspTruth, LiftOutcome};

/// The numbers of an attempt in a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// Counts the attempts of the run, from 0: the number of the grasp, and of its outcome.
    pub grasp_id: u64,
    pub trial: u64,
    pub attempt: u32,
    /// The number of its first frame.
    pub first_seq: u64,
    /// When it begins, simulated time since the run began.
    pub begin_nanos: u64,
    /// Number of grasps that were lifted before, which is the number of its label if it is lifted.
    pub n_lifted: u64,
}

/// A finished attempt.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finished {
    pub place: Place,
    /// How many frames it has; at least 1.
    pub n_frames: u64,
    /// When it was over, simulated time since the run began.
    pub end_nanos: u64,
    /// The probes that were made, which are felt again with their frames.
    pub probes: Vec<ProbeMove>,
    /// The answers to a hand that asked while it lifted; `None` if it did not ask.
    pub reactions: Option<Vec<Reaction>>,
    pub outcome: LiftOutcome,
}

impl Finished {
    /// The number of its last frame.
    pub fn last_seq(&self) -> u64 {
        self.place.first_seq + self.n_frames.saturating_sub(1)
    }

    /// The label of the grasp by physics; `None` if it was not lifted.
    pub fn truth(&self) -> Option<GraspTruth> {
        let outcome = &self.outcome;
        let quality = |value: f64| if outcome.has_quality { value } else { f64::NAN };
        outcome.lifted.then(|| GraspTruth {
            grasp_id: outcome.grasp_id,
            epsilon: quality(outcome.epsilon),
            volume: quality(outcome.volume),
            stable: outcome.held,
            object: outcome.thing.clone(),
            object_class: outcome.group.clone(),
        })
    }
}

/// The progress of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Course {
    pub next: Place,
    /// Finished attempts that a reader may have to hear of again, in order.
    pub finished: VecDeque<Finished>,
}

impl Course {
    /// Goes on to the attempt after one that is over: of the same trial, unless that one was lifted or was the last of
    /// `max_attempts`. `pause_nanos` of simulated time lie between.
    pub fn finish(&mut self, finished: Finished, max_attempts: u32, pause_nanos: u64) {
        let Place { grasp_id, trial, attempt, n_lifted, .. } = finished.place;
        let is_last = finished.outcome.lifted || attempt.saturating_add(1) >= max_attempts;
        self.next = Place {
            grasp_id: grasp_id + 1,
            trial: trial + u64::from(is_last),
            attempt: if is_last { 0 } else { attempt + 1 },
            first_seq: finished.place.first_seq + finished.n_frames,
            begin_nanos: finished.end_nanos.saturating_add(pause_nanos),
            n_lifted: n_lifted + u64::from(finished.outcome.lifted),
        };
        self.finished.push_back(finished);
    }

    /// Goes on to the next trial without an attempt: the hand cannot come to the target as it stands in this one.
    pub fn leave_out(&mut self) {
        self.next = Place { trial: self.next.trial + 1, attempt: 0, ..self.next.clone() };
    }

    /// Forgets the oldest finished attempts as long as `is_known` holds for them.
    pub fn forget(&mut self, mut is_known: impl FnMut(&Finished) -> bool) {
        while self.finished.front().is_some_and(&mut is_known) {
            self.finished.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn over(course: &Course, lifted: bool) -> Finished {
        let place = course.next.clone();
        let outcome = LiftOutcome {
            grasp_id: place.grasp_id,
            trial: place.trial,
            attempt: place.attempt,
            lifted,
            ..LiftOutcome::default()
        };
        Finished {
            n_frames: 9,
            end_nanos: place.begin_nanos + 100,
            probes: Vec::new(),
            reactions: None,
            outcome,
            place,
        }
    }

    #[test]
    fn a_trial_goes_on_until_a_lift_or_its_last_attempt() {
        let mut course = Course::default();
        let mut places = Vec::new();
        for lifted in [false, true, true, false, false, false] {
            let Place { grasp_id, trial, attempt, first_seq, n_lifted, .. } = course.next.clone();
            places.push((grasp_id, trial, attempt, first_seq, n_lifted));
            let finished = over(&course, lifted);
            course.finish(finished, 3, 10);
        }
        assert_eq!(
            places,
            [(0, 0, 0, 0, 0), (1, 0, 1, 9, 0), (2, 1, 0, 18, 1), (3, 2, 0, 27, 2), (4, 2, 1, 36, 2), (5, 2, 2, 45, 2)]
        );
        assert_eq!((course.next.trial, course.next.attempt, course.next.begin_nanos), (3, 0, 660));
        assert_eq!(course.finished.len(), 6);
        course.forget(|finished| finished.last_seq() < 27);
        assert_eq!(course.finished.front().map(|finished| finished.place.grasp_id), Some(3));
    }

    #[test]
    fn a_trial_that_is_left_out_leaves_no_gap_in_any_number_but_its_own() {
        let mut course = Course::default();
        let finished = over(&course, false);
        course.finish(finished, 3, 10);
        let before = course.next.clone();
        course.leave_out();
        assert_eq!(course.next, Place { trial: 1, attempt: 0, ..before });
        assert_eq!((before.attempt, course.finished.len()), (1, 1));
    }

    #[test]
    fn only_a_lift_tells_the_truth() {
        let course = Course::default();
        assert_eq!(over(&course, false).truth(), None);
        let mut lifted = over(&course, true);
        lifted.outcome.held = true;
        let truth = lifted.truth().expect("lifted");
        assert!(truth.stable && truth.epsilon.is_nan());
        lifted.outcome.has_quality = true;
        assert_eq!(lifted.truth().expect("lifted").epsilon, 0.0);
    }
}
