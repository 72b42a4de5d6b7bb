//! A robot that tries to lift one target after another: its readings, its questions, and the outcome of each attempt.
//!
//! The caller sends what the robot has to say and tells it the decisions. What the robot does depends on its options and the
//! decisions alone; it reads no clock and waits for nobody.

use std::collections::VecDeque;

use super::course::{Course, Finished, Place};
use super::targets::target_of_trial;
use super::{
    Attempt, LiftResult, LiftTarget, ProbeMove, Reaction, TrialError, TrialOptions, choose_start, sensor_seed,
};
use blindgrasp_messages::{Action, Header, LiftOutcome, Phase, Stamped, TactileFrame};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::Hand;

/// The samples of an instance go on where those of the one before ended: there is one generation of them.
const EPOCH: u64 = 0;
/// A target that a test lift has moved or turned by more in the hand, once set down again, is disturbed. One that was gone
/// before is not.
const DISTURBED_M: f64 = 0.01;
const DISTURBED_RAD: f64 = 0.2;
/// A hand that is watched asks after so many frames of a lift whether it may go on: with 20 frames a second, five times a
/// second. In a long lift it asks less often, because its state holds the answers.
const FRAMES_PER_ASK: usize = 4;
const MOST_ASKS: u64 = 50;

/// How the robot goes about its trials.
#[derive(Debug, Clone, Copy)]
pub struct RobotOptions {
    pub n_trials: u64,
    /// Of all trials, it makes every `n_shards`-th from this one on.
    pub shard_idx: u64,
    pub n_shards: u64,
    pub seed: u64,
    /// The most attempts of a trial that is never decided to lift.
    pub max_attempts: u32,
    /// Every settled grasp is lifted, whatever is decided.
    pub lifts_always: bool,
    /// It sends frames while it lifts, asks whether to go on, and reacts.
    pub is_watched: bool,
}

/// What the robot does next.
#[derive(Debug)]
pub enum Doing {
    /// It feels something: the frame is to be sent.
    Feels(Stamped<TactileFrame>),
    /// It waits for the decision about a grasp, or for the probe that it takes: see [`Robot::decide`]. `n_before` answers
    /// about this grasp have been acted upon.
    AsksForDecision { grasp_id: u64, n_before: usize },
    /// An attempt is over: its outcome is to be told, then [`Robot::conclude`] called.
    IsOver(Finished),
    /// A trial ends without a lift after so many attempts, because the hand cannot come to the target as it stands. Without an
    /// attempt it is left out.
    LeavesOut { trial: u64, n_attempts: u32, why: TrialError },
    /// All trials are done.
    IsDone,
}

/// A robot in the middle of its trials.
pub struct Robot<'a> {
    hand: &'a Hand,
    targets: Vec<LiftTarget>,
    trial_options: TrialOptions,
    options: RobotOptions,
    /// It chooses among approaches.
    prior: Option<ApproachPrior>,
    course: Course,
    /// Attempts that are over and that somebody may have to hear of again.
    again: VecDeque<Finished>,
    /// The number of the last frame that need not be felt again.
    known_seq: Option<u64>,
    state: State<'a>,
}

enum State<'a> {
    /// Between two attempts.
    Between,
    Feeling(Box<TriedGrasp<'a>>),
    Deciding(Box<TriedGrasp<'a>>),
    Over {
        finished: Finished,
        /// The frame that says how a lift ended, if it is to be sent.
        told: Option<Box<Stamped<TactileFrame>>>,
        is_again: bool,
    },
    /// The physics has stopped.
    Failed(TrialError),
}

/// An attempt under way.
struct TriedGrasp<'a> {
    place: Place,
    target: LiftTarget,
    attempt: Attempt<'a>,
    n_frames: u64,
    /// Simulated time from its beginning to the last frame.
    elapsed_nanos: u64,
    last: Option<TactileFrame>,
    probes: Vec<ProbeMove>,
    lift: Option<WatchedLift>,
    /// How it ended, if only its frames are felt again.
    outcome: Option<Finished>,
}

/// A lift under way in which the hand asks whether to go on.
#[derive(Default)]
struct WatchedLift {
    /// Epsilon and volume of the grasp before.
    quality: Option<(f64, f64)>,
    reactions: Vec<Reaction>,
    n_frames_since_asked: usize,
}

impl<'a> Robot<'a> {
    /// A robot at its first trial.
    pub fn new(
        hand: &'a Hand,
        targets: Vec<LiftTarget>,
        trial_options: TrialOptions,
        options: RobotOptions,
    ) -> Robot<'a> {
        let (course, again, state) = (Course::default(), VecDeque::new(), State::Between);
        Robot { hand, targets, trial_options, options, prior: None, course, again, known_seq: None, state }
    }

    /// The same with a prior, which chooses where random attempts begin.
    pub fn with_prior(self, prior: Option<ApproachPrior>) -> Self {
        Robot { prior, ..self }
    }

    /// Goes on where a course stands. Attempts that it still holds are told again; their frames are felt again, unless
    /// they are up to `known_seq`.
    pub fn resume(&mut self, course: Course, known_seq: Option<u64>) {
        (self.again, self.course) = (course.finished.clone(), course);
        (self.known_seq, self.state) = (known_seq, State::Between);
    }

    /// How far it has come.
    pub fn course(&self) -> &Course {
        &self.course
    }

    /// Whether it begins a new attempt next.
    pub fn is_about_to_begin(&self) -> bool {
        matches!(self.state, State::Between) && self.again.is_empty()
    }

    /// Forgets the oldest attempts that are over while `is_known` says that nobody will ask for them again.
    pub fn forget(&mut self, is_known: impl FnMut(&Finished) -> bool) {
        self.course.forget(is_known);
    }

    /// What the robot does next. What it waits for, it goes on asking for.
    ///
    /// # Errors
    /// A hand or target that cannot be simulated.
    pub fn advance(&mut self) -> Result<Doing, TrialError> {
        match std::mem::replace(&mut self.state, State::Between) {
            State::Between => self.begin(),
            State::Feeling(grasp) => self.feel(grasp),
            State::Failed(error) => Err(error),
            State::Deciding(grasp) => {
                let n_of_lift = grasp.lift.as_ref().map_or(0, |lift| 1 + lift.reactions.len());
                let (grasp_id, n_before) = (grasp.place.grasp_id, grasp.probes.len() + n_of_lift);
                self.state = State::Deciding(grasp);
                Ok(Doing::AsksForDecision { grasp_id, n_before })
            }
            State::Over { finished, told: Some(told), is_again } => {
                self.state = State::Over { finished, told: None, is_again };
                Ok(Doing::Feels(*told))
            }
            State::Over { finished, told: None, is_again } => {
                self.state = State::Over { finished: finished.clone(), told: None, is_again };
                Ok(Doing::IsOver(finished))
            }
        }
    }

    /// Takes the decision that the robot has asked for, and acts on it.
    pub fn decide(&mut self, action: Action) {
        match std::mem::replace(&mut self.state, State::Between) {
            State::Deciding(grasp) if grasp.lift.is_some() => {
                let reaction = match action {
                    Action::GoOn => Reaction::GoOn,
                    Action::Tighten => Reaction::Tighten,
                    // In doubt it sets the target down.
                    _ => Reaction::SetDown,
                };
                self.react(grasp, reaction);
            }
            State::Deciding(mut grasp)
                if action == Action::Lift && self.options.is_watched && !self.options.lifts_always =>
            {
                grasp.begin_lift();
                self.state = State::Feeling(grasp);
            }
            State::Deciding(mut grasp) if probe_of(action).is_some() && !self.options.lifts_always => {
                // A test lift follows a squeeze, after which the robot waits for the answer whether to go on. No probe is made
                // twice: in doubt it lets go.
                let next = match (&grasp.probes[..], probe_of(action)) {
                    ([], Some(_)) => Some(ProbeMove::Squeeze),
                    ([ProbeMove::Squeeze], Some(ProbeMove::TestLift)) => Some(ProbeMove::TestLift),
                    _ => None,
                };
                match next {
                    Some(probe) => {
                        grasp.begin_probe(probe);
                        self.state = State::Feeling(grasp);
                    }
                    None => {
                        let quality = grasp.quality();
                        self.finish(*grasp, quality, None);
                    }
                }
            }
            State::Deciding(mut grasp) => {
                let lifts = action == Action::Lift || self.options.lifts_always;
                let quality = grasp.quality();
                let lift = lifts.then(|| grasp.attempt.lift(|_| {}));
                self.finish(*grasp, quality, lift);
            }
            other => self.state = other,
        }
    }

    /// Goes on after an attempt whose outcome was told.
    pub fn conclude(&mut self) {
        match std::mem::replace(&mut self.state, State::Between) {
            State::Over { is_again: true, .. } => {}
            State::Over { finished, .. } => {
                let pause_nanos = self.trial_options.protocol.frame_nanos;
                self.course.finish(finished, self.options.max_attempts, pause_nanos);
            }
            other => self.state = other,
        }
    }

    fn begin(&mut self) -> Result<Doing, TrialError> {
        if let Some(finished) = self.again.pop_front() {
            if self.known_seq.is_some_and(|seq| seq >= finished.last_seq()) {
                self.state = State::Over { finished, told: None, is_again: true };
                return self.advance();
            }
            let (target, attempt) = self.target_and_attempt(&finished.place)?;
            return self.grasp(finished.place.clone(), target, attempt, Some(finished));
        }
        while self.course.next.trial % self.options.n_shards != self.options.shard_idx {
            self.course.leave_out();
        }
        let place = self.course.next.clone();
        if place.trial >= self.options.n_trials {
            return Ok(Doing::IsDone);
        }
        match self.target_and_attempt(&place) {
            Err(why @ TrialError::NoApproach { .. }) => {
                self.course.leave_out();
                Ok(Doing::LeavesOut { trial: place.trial, n_attempts: place.attempt, why })
            }
            drawn => {
                let (target, attempt) = drawn?;
                self.grasp(place, target, attempt, None)
            }
        }
    }

    fn target_and_attempt(&self, place: &Place) -> Result<(LiftTarget, Attempt<'a>), TrialError> {
        let Some(target) = target_of_trial(&self.targets, place.trial) else {
            let reason = "there is nothing to lift: expected at least one thing".into();
            return Err(TrialError::Target { name: String::new(), reason });
        };
        let (options, prior, seed) = (&self.trial_options, self.prior.as_ref(), self.options.seed);
        let start = choose_start(self.hand, target, options, prior, seed, place.trial, place.attempt)?;
        let sensors = sensor_seed(seed, place.trial, place.attempt);
        Ok((target.clone(), Attempt::begin(self.hand, target, options, &start, sensors)?))
    }

    fn grasp(
        &mut self,
        place: Place,
        target: LiftTarget,
        attempt: Attempt<'a>,
        outcome: Option<Finished>,
    ) -> Result<Doing, TrialError> {
        let grasp = TriedGrasp {
            place,
            target,
            attempt,
            n_frames: 0,
            elapsed_nanos: 0,
            last: None,
            probes: Vec::new(),
            lift: None,
            outcome,
        };
        self.feel(Box::new(grasp))
    }

    /// The next frame of an attempt.
    fn feel(&mut self, mut grasp: Box<TriedGrasp<'a>>) -> Result<Doing, TrialError> {
        let frames_per_ask = self.frames_per_ask();
        let asks = grasp.lift.as_ref().is_some_and(|lift| lift.n_frames_since_asked == frames_per_ask);
        let next = if asks { None } else { grasp.attempt.next_frame(grasp.place.grasp_id) };
        grasp.attempt.check()?;
        if next.is_none() && !asks && grasp.lift.is_some() {
            self.end_lift(grasp);
            return self.advance();
        }
        let (frame, is_last) = match next {
            Some(timed) => {
                grasp.elapsed_nanos = timed.offset_nanos;
                grasp.last = Some(timed.frame.clone());
                if let Some(lift) = &mut grasp.lift {
                    lift.n_frames_since_asked += 1;
                }
                (timed.frame, false)
            }
            None => {
                // The last frame once more says that no more come unless a probe is asked for, or that the hand asks: an
                // arbiter need not wait for silence.
                if grasp.lift.is_none() {
                    grasp.elapsed_nanos += self.trial_options.protocol.frame_nanos;
                }
                let Some(last) = grasp.last.clone() else {
                    let reason = format!("grasp {} has no frames", grasp.place.grasp_id);
                    return Err(TrialError::Target { name: grasp.target.object.name.clone(), reason });
                };
                (TactileFrame { phase: Phase::Ended, ..last }, true)
            }
        };
        let header = Header {
            seq: grasp.place.first_seq + grasp.n_frames,
            stamp_nanos: grasp.place.begin_nanos + grasp.elapsed_nanos,
            epoch: EPOCH,
            hand_id: self.hand.id(),
            ..Header::default()
        };
        grasp.n_frames += 1;
        match (is_last, grasp.outcome.is_some()) {
            (false, _) => self.state = State::Feeling(grasp),
            (true, false) => self.state = State::Deciding(grasp),
            (true, true) => self.do_again(grasp),
        }
        Ok(Doing::Feels(Stamped { header, message: frame }))
    }

    fn frames_per_ask(&self) -> usize {
        let protocol = &self.trial_options.protocol;
        let lift_nanos = (protocol.lift_secs + protocol.hold_secs + 2.0 * protocol.shake_secs) * 1e9;
        FRAMES_PER_ASK.max((lift_nanos as u64 / protocol.lifting_frame_nanos / MOST_ASKS) as usize)
    }

    /// Does what an attempt that is felt again did when it had asked.
    fn do_again(&mut self, mut grasp: Box<TriedGrasp<'a>>) {
        let Some(finished) = &grasp.outcome else { return };
        if let Some(lift) = &grasp.lift {
            let reactions = finished.reactions.iter().flatten().skip(lift.reactions.len()).copied();
            // The hand asked once, and was answered until it went on or set the target down.
            let answers: Vec<Reaction> = reactions.collect();
            let until = answers.iter().position(|answer| *answer != Reaction::Tighten).map_or(0, |idx| idx + 1);
            self.state = State::Deciding(grasp);
            for answer in &answers[..until] {
                if let State::Deciding(grasp) = std::mem::replace(&mut self.state, State::Between) {
                    self.react(grasp, *answer);
                }
            }
            return;
        }
        if let Some(probe) = finished.probes.get(grasp.probes.len()).copied() {
            grasp.begin_probe(probe);
        } else if finished.reactions.is_some() {
            grasp.begin_lift();
        } else {
            self.is_over_again(grasp);
            return;
        }
        self.state = State::Feeling(grasp);
    }

    fn is_over_again(&mut self, mut grasp: Box<TriedGrasp<'a>>) {
        if let Some(finished) = grasp.outcome.take() {
            let told = told_frame(&finished, grasp.last.take(), self.hand.id());
            self.state = State::Over { finished, told, is_again: true };
        }
    }

    /// Reacts while it lifts.
    fn react(&mut self, mut grasp: Box<TriedGrasp<'a>>, reaction: Reaction) {
        let Some(lift) = &mut grasp.lift else { return };
        lift.reactions.push(reaction);
        match reaction {
            Reaction::GoOn => {
                lift.n_frames_since_asked = 0;
                self.state = State::Feeling(grasp);
            }
            Reaction::Tighten => {
                grasp.attempt.tighten();
                self.state = State::Deciding(grasp);
            }
            Reaction::SetDown if grasp.outcome.is_some() => self.is_over_again(grasp),
            Reaction::SetDown => {
                let quality = lift.quality;
                self.finish(*grasp, quality, None);
            }
        }
    }

    fn end_lift(&mut self, grasp: Box<TriedGrasp<'a>>) {
        if grasp.outcome.is_some() {
            self.is_over_again(grasp);
            return;
        }
        let quality = grasp.lift.as_ref().and_then(|lift| lift.quality);
        let result = grasp.attempt.lift_result();
        self.finish(*grasp, quality, Some(result));
    }

    /// Ends an attempt with a lift, or lets go: after a test lift, or in the middle of a lift, it sets the target down.
    fn finish(&mut self, mut grasp: TriedGrasp<'a>, quality: Option<(f64, f64)>, lift: Option<LiftResult>) {
        let is_broken_off = lift.is_none() && grasp.lift.is_some();
        let is_set_down = is_broken_off || lift.is_none() && grasp.probes.last() == Some(&ProbeMove::TestLift);
        let (moved_m, turned_rad) = if is_set_down { grasp.attempt.set_down() } else { (0.0, 0.0) };
        if let Err(error) = grasp.attempt.check() {
            self.state = State::Failed(error);
            return;
        }
        // What leaves the hand on its way down is dropped.
        let is_lost = is_broken_off && (!grasp.attempt.is_touched() || moved_m > self.trial_options.protocol.lost_m);
        let lift = lift.or(is_lost.then_some(LiftResult { held: false, slip_m: moved_m, turn_rad: turned_rad }));
        let disturbed = lift.is_none() && (moved_m > DISTURBED_M || turned_rad > DISTURBED_RAD);
        let (epsilon, volume) = quality.unwrap_or((-1.0, 0.0));
        let TriedGrasp { place, target, attempt, n_frames, elapsed_nanos, probes, last, lift: watched, .. } = grasp;
        let n_frames = n_frames + u64::from(lift.is_some());
        let outcome = LiftOutcome {
            grasp_id: place.grasp_id,
            trial: place.trial,
            attempt: place.attempt,
            lifted: lift.is_some(),
            held: lift.is_some_and(|lift| lift.held),
            has_quality: quality.is_some(),
            slip_m: lift.map_or(moved_m, |lift| lift.slip_m),
            turn_rad: lift.map_or(turned_rad, |lift| lift.turn_rad),
            epsilon,
            volume,
            mass_kg: target.object.mass_kg,
            friction: target.friction,
            thing: target.object.name,
            group: target.object.class,
            probed: !probes.is_empty(),
            disturbed,
        };
        let end_nanos = place.begin_nanos + attempt.snapshot().elapsed_nanos.max(elapsed_nanos);
        let reactions = watched.map(|lift| lift.reactions);
        let finished = Finished { place, n_frames, end_nanos, probes, reactions, outcome };
        let told = told_frame(&finished, last, self.hand.id());
        self.state = State::Over { finished, told, is_again: false };
    }
}

impl TriedGrasp<'_> {
    fn begin_probe(&mut self, probe: ProbeMove) {
        self.attempt.probe(probe);
        // A frame with the number of the last one has been sent in between.
        self.attempt.skip_frame();
        self.probes.push(probe);
    }

    fn begin_lift(&mut self) {
        self.lift = Some(WatchedLift { quality: self.quality(), ..WatchedLift::default() });
        self.attempt.begin_lift();
        self.attempt.skip_frame();
    }

    fn quality(&self) -> Option<(f64, f64)> {
        self.attempt.quality().filter(|(epsilon, volume)| epsilon.is_finite() && volume.is_finite())
    }
}

fn probe_of(action: Action) -> Option<ProbeMove> {
    match action {
        Action::Squeeze => Some(ProbeMove::Squeeze),
        Action::TestLift => Some(ProbeMove::TestLift),
        _ => None,
    }
}

/// The last frame of an attempt with a lift, which says how it ended.
fn told_frame(finished: &Finished, last: Option<TactileFrame>, hand_id: u64) -> Option<Box<Stamped<TactileFrame>>> {
    if !finished.outcome.lifted {
        return None;
    }
    let phase = if finished.outcome.held { Phase::Kept } else { Phase::Dropped };
    let header = told_header(finished, finished.last_seq(), hand_id);
    Some(Box::new(Stamped { header, message: TactileFrame { phase, ..last? } }))
}

/// The header of what is told of an attempt that is over, under its own number.
pub fn told_header(finished: &Finished, seq: u64, hand_id: u64) -> Header {
    Header { seq, stamp_nanos: finished.end_nanos, epoch: EPOCH, hand_id, ..Header::default() }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::trial::targets::targets_named;

    const OPTIONS: RobotOptions = RobotOptions {
        n_trials: 1,
        shard_idx: 0,
        n_shards: 1,
        seed: 0,
        max_attempts: 2,
        lifts_always: false,
        is_watched: false,
    };

    fn barrett() -> Hand {
        Hand::load(Path::new("barrett-bh8-280")).expect("a hand")
    }

    fn robot(hand: &Hand, is_watched: bool) -> Robot<'_> {
        let targets = targets_named("paper/pencil-cup").expect("targets");
        Robot::new(hand, targets, TrialOptions::default(), RobotOptions { is_watched, ..OPTIONS })
    }

    /// Runs the robot to its end, with an action for each grasp and number of answers before. Returns its frames, which are
    /// numbered, and its attempts.
    fn run(
        robot: &mut Robot<'_>,
        mut decide: impl FnMut(u64, usize) -> Action,
    ) -> (Vec<Stamped<TactileFrame>>, Vec<Finished>) {
        let (mut frames, mut finished) = (Vec::new(), Vec::new());
        loop {
            match robot.advance().expect("it can be simulated") {
                Doing::Feels(frame) => frames.push(frame),
                Doing::AsksForDecision { grasp_id, n_before } => robot.decide(decide(grasp_id, n_before)),
                Doing::IsOver(over) => {
                    finished.push(over);
                    robot.conclude();
                }
                Doing::IsDone => break,
                Doing::LeavesOut { .. } => panic!("it can approach"),
            }
        }
        let first_seq = frames.first().map_or(0, |frame: &Stamped<TactileFrame>| frame.header.seq);
        assert!((first_seq..).zip(&frames).all(|(seq, frame)| frame.header.seq == seq));
        assert!(frames.is_sorted_by_key(|frame| frame.header.stamp_nanos));
        (frames, finished)
    }

    /// Holds the first grasp, and lifts the others.
    fn hold_the_first(grasp_id: u64, _: usize) -> Action {
        if grasp_id == 0 { Action::Hold } else { Action::Lift }
    }

    #[test]
    fn a_robot_that_resumes_tells_the_same_again() {
        let hand = barrett();
        let mut first = robot(&hand, false);
        let (frames, finished) = run(&mut first, hold_the_first);
        let lifted: Vec<bool> = finished.iter().map(|finished| finished.outcome.lifted).collect();
        assert_eq!(lifted, [false, true]);
        assert_eq!(frames.len() as u64, finished.iter().map(|finished| finished.n_frames).sum::<u64>());

        // The last frame of the lift says how it ended, and comes again if it alone is not known.
        let told = frames.last().expect("frames").clone();
        let phase = if finished[1].outcome.held { Phase::Kept } else { Phase::Dropped };
        assert_eq!((told.message.phase, told.header.seq), (phase, finished[1].last_seq()));
        assert_eq!(
            frames.iter().filter(|frame| matches!(frame.message.phase, Phase::Kept | Phase::Dropped)).count(),
            1
        );

        let mut again = robot(&hand, false);
        again.resume(first.course().clone(), Some(told.header.seq - 1));
        assert_eq!(run(&mut again, hold_the_first).0.last(), Some(&told));
        again.resume(first.course().clone(), None);
        assert_eq!(run(&mut again, hold_the_first), (frames, finished.clone()));
        // Readers have the frames of the first attempt.
        again.resume(first.course().clone(), Some(finished[0].last_seq()));
        let (frames, told) = run(&mut again, hold_the_first);
        assert_eq!((frames[0].header.seq, told), (finished[1].place.first_seq, finished));
    }

    #[test]
    fn shards_make_the_trials_of_the_whole() {
        let hand = barrett();
        let made = |shard_idx: u64, n_shards: u64| -> Vec<LiftOutcome> {
            let options = RobotOptions { n_trials: 2, shard_idx, n_shards, lifts_always: true, ..OPTIONS };
            let targets = targets_named("paper/pencil-cup").expect("targets");
            let mut robot = Robot::new(&hand, targets, TrialOptions::default(), options);
            let (_, finished) = run(&mut robot, |_, _| Action::Lift);
            // Grasps are numbered in each shard.
            finished.into_iter().map(|finished| LiftOutcome { grasp_id: 0, ..finished.outcome }).collect()
        };
        let whole = made(0, 1);
        assert_eq!(whole.iter().map(|outcome| outcome.trial).collect::<Vec<_>>(), [0, 1]);
        assert_eq!([made(0, 2), made(1, 2)].concat(), whole);
    }

    #[test]
    fn a_watched_hand_asks_while_it_lifts_reacts_and_is_felt_again() {
        let hand = barrett();
        let mut first = robot(&hand, true);
        let mut asked = Vec::new();
        // The first lift is tightened and broken off, the second one goes on.
        let (frames, finished) = run(&mut first, |grasp_id, n_before| {
            asked.push((grasp_id, n_before));
            match (grasp_id, n_before) {
                (_, 0) => Action::Lift,
                (0, 1) => Action::GoOn,
                (0, 2) => Action::Tighten,
                (0, _) => Action::SetDown,
                _ => Action::GoOn,
            }
        });
        assert_eq!(asked[..6], [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1)]);
        assert_eq!(finished[0].reactions.as_deref(), Some(&[Reaction::GoOn, Reaction::Tighten, Reaction::SetDown][..]));
        assert_eq!(finished.iter().map(|over| over.outcome.lifted).collect::<Vec<_>>(), [false, true]);
        assert!(finished[0].outcome.slip_m < DISTURBED_M, "it stands where it stood: {:?}", finished[0].outcome);
        let mut phases: Vec<Phase> = frames.iter().map(|frame| frame.message.phase).collect();
        let n_lifting = phases.iter().filter(|phase| **phase == Phase::Lifting).count();
        phases.dedup();
        let n_asks = phases.windows(2).filter(|pair| *pair == [Phase::Lifting, Phase::Ended]).count();
        assert_eq!(n_lifting / FRAMES_PER_ASK, n_asks);
        // The first lift asked twice, and had two answers at the second time.
        assert_eq!(n_asks, asked.len() - 1 - 2);
        let mut again = robot(&hand, true);
        again.resume(first.course().clone(), None);
        assert_eq!(run(&mut again, |_, _| panic!("all is decided")), (frames, finished));
    }

    #[test]
    fn probes_are_made_once_and_felt_again() {
        let hand = barrett();
        let mut first = robot(&hand, false);
        let mut asked = Vec::new();
        // The first attempt is held when it is tight. The second one makes its test lift, and a third probe is a hold.
        let (frames, finished) = run(&mut first, |grasp_id, n_before| {
            asked.push((grasp_id, n_before));
            if (grasp_id, n_before) == (0, 1) { Action::Hold } else { Action::TestLift }
        });
        assert_eq!(asked, [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]);
        assert!(finished.iter().all(|finished| finished.outcome.probed && !finished.outcome.lifted));
        assert!(frames.windows(2).all(|pair| pair[0].header.stamp_nanos < pair[1].header.stamp_nanos));
        let mut again = robot(&hand, false);
        again.resume(first.course().clone(), None);
        assert_eq!(run(&mut again, |_, _| panic!("all is decided")), (frames, finished));
    }
}
