//! The course of many trials: the order of attempts, the numbers of their samples, and the state from which a process goes
//! on after a crash with the same samples.
//!
//! An attempt is a pure function of seed, trial and attempt, and of its start if advice said where that is; so all that is
//! kept of one is where it stands and how it ended.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::advised_start::Grasped;
use super::{Probe, Start};
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
    /// Where it begins, if advice said so; otherwise that is drawn.
    pub advised_start: Option<Start>,
}

/// A finished attempt.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finished {
    pub place: Place,
    /// How many frames it has; at least 1.
    pub n_frames: u64,
    /// When it was over, simulated time since the run began.
    pub end_nanos: u64,
    /// The probe that was made, which is felt again with its frames.
    pub probe: Option<Probe>,
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
            class: outcome.group.clone(),
        })
    }
}

/// The progress of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Course {
    pub next: Place,
    /// Finished attempts that a reader may have to hear of again, in order.
    pub finished: VecDeque<Finished>,
    /// The grasps that led to the next attempt: the last that began at random, and those that followed advice since.
    /// Empty if the next attempt begins at random.
    pub grasped: Vec<Grasped>,
}

impl Course {
    /// Goes on to the attempt after one that is over: of the same trial, unless that one was lifted or was the last of
    /// `max_attempts`. `pause_nanos` of simulated time lie between. `advised` is where it begins as advice says, and what was
    /// grasped in the one that is over.
    pub fn finish(
        &mut self,
        finished: Finished,
        max_attempts: u32,
        pause_nanos: u64,
        advised: Option<(Start, Grasped)>,
    ) {
        let Place { grasp_id, trial, attempt, n_lifted, .. } = finished.place;
        let is_last = finished.outcome.lifted || attempt.saturating_add(1) >= max_attempts;
        let advised_start = match advised.filter(|_| !is_last) {
            Some((start, grasped)) => {
                self.grasped.push(grasped);
                Some(start)
            }
            None => {
                self.grasped.clear();
                None
            }
        };
        self.next = Place {
            grasp_id: grasp_id + 1,
            trial: trial + u64::from(is_last),
            attempt: if is_last { 0 } else { attempt + 1 },
            first_seq: finished.place.first_seq + finished.n_frames,
            begin_nanos: finished.end_nanos.saturating_add(pause_nanos),
            n_lifted: n_lifted + u64::from(finished.outcome.lifted),
            advised_start,
        };
        self.finished.push_back(finished);
    }

    /// Goes on to the next trial without an attempt: the hand cannot come to the thing as it stands in this one.
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
    use nalgebra::Isometry3;

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
        Finished { n_frames: 9, end_nanos: place.begin_nanos + 100, probe: None, outcome, place }
    }

    #[test]
    fn advice_is_followed_within_a_trial_only() {
        let start = Start {
            world_from_palm_xyzw: [0.0, 0.0, 0.0, 1.0],
            lateral_offset_m: [0.0, 0.0],
            open_joints_rad: vec![0.0; 3],
            yaw_rad: 0.5,
        };
        let grasped = Grasped { target_from_palm: Isometry3::identity(), open_joints_rad: vec![0.0; 3] };
        let mut course = Course::default();
        let mut seen = Vec::new();
        for (lifted, is_advised) in [(false, true), (false, true), (false, false), (false, true), (true, true)] {
            let finished = over(&course, lifted);
            course.finish(finished, 4, 10, is_advised.then(|| (start.clone(), grasped.clone())));
            let place = &course.next;
            assert!(place.advised_start.as_ref().is_none_or(|it| *it == start));
            seen.push((place.trial, place.attempt, place.advised_start.is_some(), course.grasped.len()));
        }
        // The fourth attempt is the last one, and a lift ends a trial.
        assert_eq!(seen, [(0, 1, true, 1), (0, 2, true, 2), (0, 3, false, 0), (1, 0, false, 0), (2, 0, false, 0)]);
    }

    #[test]
    fn a_trial_goes_on_until_a_lift_or_its_last_attempt() {
        let mut course = Course::default();
        let mut places = Vec::new();
        for lifted in [false, true, true, false, false, false] {
            let Place { grasp_id, trial, attempt, first_seq, n_lifted, .. } = course.next.clone();
            places.push((grasp_id, trial, attempt, first_seq, n_lifted));
            let finished = over(&course, lifted);
            course.finish(finished, 3, 10, None);
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
        course.finish(finished, 3, 10, None);
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
