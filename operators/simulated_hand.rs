//! A robot that a simulation stands for: tries to lift one thing after another, and lets the graph's decision say whether
//! it lifts. `blindgrasp_simulator::trial` as a process.
//!
//! It is a source with feedback inputs: it says what the hand feels, waits for the decision of that grasp, lifts or
//! tries anew, and says what became of it. A grasp that is decided to be done anew it tries as the advice says, if there is
//! any that the arm can follow, and otherwise from anywhere. What it sends depends on its parameters, the decisions and the
//! advice alone, not on how fast the machine is. It computes as fast as it can, and waits only for decisions and advice.
//!
//! After each attempt it saves how far it is, together with the attempts whose samples somebody may not have read. One
//! that was killed, or is swapped in, sends those again and goes on: nothing is lost, no trial has two numbers.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use blindgrasp_messages::{
    Action, GraspTruth, Header, LiftDecision, LiftOutcome, MAX_NAME_BYTES, Message, Phase, Recorded, RegraspAdvice,
    TactileFrame,
};
use blindgrasp_operator::board::Key;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{self, Operator, TICK};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::{Publisher, Sent, Subscriber, key_of};
use blindgrasp_operator::stage::STATE_FORMAT;
use blindgrasp_operator::wiring::{Command, InputCounts};
use blindgrasp_simulator::trial::advised::{Grasped, first_advised_start};
use blindgrasp_simulator::trial::course::{Course, Finished, Place};
use blindgrasp_simulator::trial::things::{check_approaches, thing_of_trial, things_named};
use blindgrasp_simulator::trial::{Attempt, Start, Thing, TrialError, TrialOptions, draw_start, sensor_seed};
use blindgrasp_stages::hand::Hand;
use serde::{Deserialize, Serialize};

/// The hand if none is named.
const DEFAULT_HAND: &str = "barrett-bh8-280";
/// How many attempts are kept that somebody may not have read; as many fit into a node's state.
const MAX_UNREAD: usize = 96;
/// What an attempt that follows advice remembers of those before it fits into a node's state as well.
const MAX_ADVISED_ATTEMPTS: i64 = 16;
/// The port of frames.
const TACTILE: &str = "tactile";
/// The port of outcomes.
const OUTCOME: &str = "outcome";
/// Its samples go on where those of an instance before it ended: there is one generation of it.
const EPOCH: u64 = 0;
/// What is counted when no decision came in time.
const UNDECIDED: &str = "undecided";
/// What is counted when no advice came in time.
const UNADVISED: &str = "unadvised";
/// What is counted when a thing stands so that no approach leads to it.
const LEFT_OUT: &str = "left_out";

#[derive(Deserialize)]
struct Params {
    hand: Option<PathBuf>,
    things: String,
    trials: u64,
    seed: u64,
    gate: Gate,
    attempts: u32,
    decision_timeout_s: f64,
    advised_attempts: usize,
    friction: Option<f64>,
    options: Option<PathBuf>,
}

/// Who says whether the hand lifts.
#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Gate {
    /// The decision.
    On,
    /// Nobody: every settled grasp is lifted.
    Off,
}

fn main() -> ExitCode {
    let whole = |min: i64, max: i64| ParamKind::Integer { min: Some(min), max: Some(max) };
    let number = |max: f64| ParamKind::Number { above: Some(0.0), min: None, max: Some(max), words: vec![] };
    let gate = ParamKind::Choice { values: vec!["on".into(), "off".into()] };
    let description = OperatorDescription::new("simulated_hand", "Tries to lift things in simulated physics")
        .feedback_input("decision", LiftDecision::TYPE_NAME, "Whether to lift what the hand holds")
        .optional_feedback_input(
            "advice",
            RegraspAdvice::TYPE_NAME,
            "How to grasp anew what is decided to be; without it every attempt comes from anywhere",
        )
        .output(TACTILE, TactileFrame::TYPE_NAME, "What the hand feels while it closes and holds still")
        .output(OUTCOME, LiftOutcome::TYPE_NAME, "What became of each grasp")
        .output("truth", GraspTruth::TYPE_NAME, "Of each grasp that was lifted: whether the object stayed in the hand")
        .optional_param(
            "hand",
            ParamKind::Path { must_exist: true },
            "The hand's pad layout (YAML) instead of the built-in one",
        )
        .param("things", ParamKind::String {}, Some("paper".into()), "What to lift: a comma-separated list")
        .param("trials", whole(1, 1_000_000), Some(110.into()), "How many trials")
        .param("seed", whole(0, i64::MAX), Some(0.into()), "From which all chance is drawn")
        .param("gate", gate, Some("on".into()), "off: every settled grasp is lifted, whatever is decided")
        .param(
            "attempts",
            whole(1, 65_535),
            Some(20.into()),
            "The most attempts of a trial that is never decided to lift",
        )
        .param(
            "decision_timeout_s",
            number(3600.0),
            Some(30.0.into()),
            "A grasp that is not decided by then is not lifted; advice that has not come by then is not waited for",
        )
        .param(
            "advised_attempts",
            whole(0, MAX_ADVISED_ATTEMPTS),
            Some(3.into()),
            "After so many attempts in a row that followed advice and were not lifted, one comes from anywhere; 0: all do",
        )
        .optional_param("friction", number(10.0), "Friction of all things on the hand instead of their own")
        .optional_param(
            "options",
            ParamKind::Path { must_exist: true },
            "How attempts are made (YAML or JSON): options of the protocol, the physics and the cells that are not to be the default",
        );
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let hand = Hand::load(params.hand.as_deref().unwrap_or(Path::new(DEFAULT_HAND)))?;
    let mut things = things_named(&params.things)?;
    for thing in &mut things {
        thing.friction = params.friction.unwrap_or(thing.friction);
        let names = LiftOutcome { thing: thing.name.clone(), group: thing.group.clone(), ..LiftOutcome::default() };
        names.check().with_context(|| format!("things: '{}'", thing.name))?;
    }
    let options = params.options.as_deref().map_or_else(|| Ok(TrialOptions::default()), TrialOptions::load)?;
    if things.is_empty() {
        bail!("things is '{}': expected at least one thing", params.things);
    }
    operator.reserve_state()?;
    // One that goes on has looked before.
    if operator.saved_state().is_none() {
        check_approaches(&hand, &things, &options, params.seed, params.trials)?;
    }
    let mut robot = Robot {
        operator,
        frames: operator.publisher(TACTILE, hand.joints.len() + hand.n_cells())?,
        outcomes: operator.publisher(OUTCOME, 2 * MAX_NAME_BYTES)?,
        truths: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        decisions: operator.subscriber("decision")?,
        advices: operator.optional_subscriber("advice")?,
        hand: &hand,
        hand_id: hand.id(),
        things,
        params,
        options,
        course: Course::default(),
        last_decision: None,
        last_advice: None,
        heard: None,
        advice: None,
        counts: BTreeMap::new(),
        is_active: !operator.begins_as_standby(),
        is_handed_over: false,
        may_go: false,
    };
    robot.connect()?;
    operator.ready(BTreeMap::from([("hand".into(), format!("{:016x}", robot.hand_id))]));
    while !operator.should_stop() {
        if robot.is_active && robot.may_go && robot.run()? {
            operator.finished();
            // Readers that come back still find the last samples, until all have them.
            while robot.obey() {
                robot.idle(TICK)?;
                robot.hear()?;
            }
        }
        robot.idle(TICK)?;
        robot.obey();
    }
    operator.drained();
    Ok(())
}

/// All that another instance needs to go on.
#[derive(Default, Serialize, Deserialize)]
struct Saved {
    course: Course,
    last_decision: Option<Key>,
    counts: InputCounts,
    last_advice: Option<Key>,
    advice_counts: InputCounts,
}

struct Robot<'a> {
    operator: &'a Operator,
    frames: Publisher<TactileFrame>,
    outcomes: Publisher<LiftOutcome>,
    truths: Publisher<GraspTruth>,
    decisions: Subscriber<LiftDecision>,
    /// If advice is connected.
    advices: Option<Subscriber<RegraspAdvice>>,
    hand: &'a Hand,
    hand_id: u64,
    things: Vec<Thing>,
    params: Params,
    options: TrialOptions,
    course: Course,
    last_decision: Option<Key>,
    last_advice: Option<Key>,
    /// The latest decision that came.
    heard: Option<LiftDecision>,
    /// The latest advice that came.
    advice: Option<RegraspAdvice>,
    /// What did not come in time.
    counts: BTreeMap<String, u64>,
    is_active: bool,
    /// Whether another instance has handed over: what it has sent will be read.
    is_handed_over: bool,
    may_go: bool,
}

/// Which samples need not be sent any more: the last of each kind that all their readers have, or will have.
struct Known {
    frame: Option<Key>,
    outcome: Option<Key>,
    truth: Option<Key>,
}

impl<'a> Robot<'a> {
    /// Does as the launcher says; false if it is to stop.
    fn obey(&mut self) -> bool {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::Go => self.may_go = true,
                Command::NodeEnded { .. } | Command::TakeNoMore { .. } => {}
                Command::TakeOver { is_handed_over } => {
                    self.is_active = true;
                    self.is_handed_over = is_handed_over;
                    self.operator.took_over();
                }
                Command::HandOver => {
                    self.is_active = false;
                    self.operator.handed_over();
                }
                Command::Set { id, .. } => {
                    let none = Err(anyhow::anyhow!("it has no parameters that can be changed while it runs"));
                    self.operator.has_set(id, none, None);
                }
            }
        }
        self.is_active && !self.operator.should_stop()
    }

    fn idle(&mut self, limit: Duration) -> anyhow::Result<()> {
        self.frames.look_for_readers()?;
        self.outcomes.look_for_readers()?;
        self.truths.look_for_readers()?;
        self.connect()?;
        let advice = self.advices.as_ref().and_then(|advices| advices.listener());
        let listeners: Vec<_> = self.decisions.listener().into_iter().chain(advice).collect();
        self.operator.wait(&listeners, Some(Instant::now() + limit));
        Ok(())
    }

    fn connect(&mut self) -> anyhow::Result<()> {
        self.decisions.connect()?;
        if let Some(advices) = &mut self.advices {
            advices.connect()?;
        }
        Ok(())
    }

    /// Goes on where the node is; true when all trials are done, false if it was interrupted.
    fn run(&mut self) -> anyhow::Result<bool> {
        let saved: Saved = match self.operator.saved_state() {
            Some(bytes) => {
                let decoded = bincode::serde::decode_from_slice(&bytes, STATE_FORMAT);
                decoded.context("the node's saved state cannot be read")?.0
            }
            None => Saved::default(),
        };
        (self.course, self.last_decision, self.last_advice) = (saved.course, saved.last_decision, saved.last_advice);
        self.decisions.take_over_at(saved.last_decision, saved.counts);
        if let Some(advices) = &mut self.advices {
            advices.take_over_at(saved.last_advice, saved.advice_counts);
        }
        let known = match self.is_handed_over {
            true => Known { frame: self.frames.last(), outcome: self.outcomes.last(), truth: self.truths.last() },
            false => Known {
                frame: self.frames.answered(),
                outcome: self.outcomes.answered(),
                truth: self.truths.answered(),
            },
        };
        for finished in self.course.finished.clone() {
            if known.frame.is_none_or(|last| last.seq < finished.last_seq()) {
                let (thing, start) = self.thing_and_start(&finished.place)?;
                let mut attempt = self.begin(&thing, &start, &finished.place)?;
                if self.feel(&mut attempt, &finished.place, known.frame)?.is_none() {
                    return Ok(false);
                }
            }
            if !self.tell(&finished, &known)? {
                return Ok(false);
            }
        }
        while self.course.next.trial < self.params.trials {
            if !self.make_room()? {
                return Ok(false);
            }
            let (thing, start) = match self.thing_and_start(&self.course.next) {
                Err(error) if matches!(error.downcast_ref(), Some(TrialError::NoApproach { .. })) => {
                    tracing::warn!(trial = self.course.next.trial, "left out: {error}");
                    self.course.leave_out();
                    self.count(LEFT_OUT);
                    self.save()?;
                    continue;
                }
                drawn => drawn?,
            };
            let Some((finished, advised)) = self.try_once(thing, &start, &known)? else {
                return Ok(false);
            };
            if !self.tell(&finished, &known)? {
                return Ok(false);
            }
            self.course.finish(finished, self.params.attempts, self.options.protocol.frame_nanos, advised);
            self.save()?;
        }
        Ok(true)
    }

    /// Waits until not too many attempts are kept; false if it was interrupted.
    fn make_room(&mut self) -> anyhow::Result<bool> {
        loop {
            let has = |last: Option<Key>, has_readers: bool, seq: u64| {
                !has_readers || last.is_some_and(|last| last.seq >= seq)
            };
            let frame = (self.frames.answered_by_readers(), self.frames.has_readers());
            let outcome = (self.outcomes.answered_by_readers(), self.outcomes.has_readers());
            let truth = (self.truths.answered_by_readers(), self.truths.has_readers());
            self.course.forget(|finished| {
                has(frame.0, frame.1, finished.last_seq())
                    && has(outcome.0, outcome.1, finished.place.grasp_id)
                    && (!finished.outcome.lifted || has(truth.0, truth.1, finished.place.n_lifted))
            });
            if !self.obey() {
                return Ok(false);
            }
            if self.course.finished.len() < MAX_UNREAD {
                return Ok(true);
            }
            self.idle(Duration::from_millis(1))?;
        }
    }

    fn thing_and_start(&self, place: &Place) -> anyhow::Result<(Thing, Start)> {
        let thing = thing_of_trial(&self.things, place.trial).context("there is no thing to lift")?.clone();
        if let Some(start) = &place.advised_start {
            return Ok((thing, start.clone()));
        }
        let (hand, options, seed) = (self.hand, &self.options, self.params.seed);
        let start = beating(self.operator, || draw_start(hand, &thing, options, seed, place.trial, place.attempt))?;
        Ok((thing, start))
    }

    fn begin(&self, thing: &Thing, start: &Start, place: &Place) -> anyhow::Result<Attempt<'a>> {
        let seed = sensor_seed(self.params.seed, place.trial, place.attempt);
        let (hand, options) = (self.hand, &self.options);
        Ok(beating(self.operator, || Attempt::begin(hand, thing, options, start, seed))?)
    }

    /// One attempt, up to what became of it, and where the next one begins if advice says so; `None` if it was interrupted.
    fn try_once(
        &mut self,
        thing: Thing,
        start: &Start,
        known: &Known,
    ) -> anyhow::Result<Option<(Finished, Option<Advised>)>> {
        let place = self.course.next.clone();
        let mut attempt = self.begin(&thing, start, &place)?;
        let Some(felt) = self.feel(&mut attempt, &place, known.frame)? else {
            return Ok(None);
        };
        let Some(action) = self.wait_for_decision(place.grasp_id)? else {
            return Ok(None);
        };
        let holding = &mut attempt;
        let quality = beating(self.operator, move || holding.quality())
            .filter(|(epsilon, volume)| epsilon.is_finite() && volume.is_finite());
        self.operator.beat();
        let lifts = action == Action::Lift || self.params.gate == Gate::Off;
        let advised = match action {
            Action::Regrasp if !lifts => {
                let Some(advised) = self.advised(&place, &thing, start, &attempt)? else {
                    return Ok(None);
                };
                advised
            }
            _ => None,
        };
        let lift = lifts.then(|| attempt.lift(|_| self.operator.beat()));
        let (epsilon, volume) = quality.unwrap_or((-1.0, 0.0));
        let outcome = LiftOutcome {
            grasp_id: place.grasp_id,
            trial: place.trial,
            attempt: place.attempt,
            lifted: lift.is_some(),
            held: lift.is_some_and(|lift| lift.held),
            has_quality: quality.is_some(),
            advised: place.advised_start.is_some(),
            slip_m: lift.map_or(0.0, |lift| lift.slip_m),
            turn_rad: lift.map_or(0.0, |lift| lift.turn_rad),
            epsilon,
            volume,
            mass_kg: thing.mass_kg,
            friction: thing.friction,
            thing: thing.name,
            group: thing.group,
        };
        let elapsed_nanos = attempt.snapshot().elapsed_nanos.max(felt.elapsed_nanos);
        let end_nanos = place.begin_nanos + elapsed_nanos;
        Ok(Some((Finished { place, n_frames: felt.n_frames, end_nanos, outcome }, advised)))
    }

    /// Where the attempt after one that is not lifted begins as the advice for it says, and what was grasped; none if no
    /// advice is to be followed, none comes or none can be followed. The outer `None` if it was interrupted.
    fn advised(
        &mut self,
        place: &Place,
        thing: &Thing,
        start: &Start,
        attempt: &Attempt<'a>,
    ) -> anyhow::Result<Option<Option<Advised>>> {
        let is_last = place.attempt.saturating_add(1) >= self.params.attempts;
        if is_last || self.advices.is_none() || self.course.grasped.len() >= self.params.advised_attempts {
            return Ok(Some(None));
        }
        let Some(advice) = self.wait_for_advice(place.grasp_id)? else {
            return Ok(None);
        };
        self.operator.beat();
        let grasped = Grasped {
            thing_from_palm: attempt.palm_from_thing().inverse(),
            open_joints_rad: start.open_joints_rad.clone(),
        };
        let mut all = self.course.grasped.clone();
        all.push(grasped.clone());
        let (hand, options, yaw_rad) = (self.hand, &self.options, start.yaw_rad);
        let proposals = &advice.proposals;
        let next = beating(self.operator, || first_advised_start(hand, thing, options, &all, proposals, yaw_rad))?;
        Ok(Some(next.map(|next| (next, grasped))))
    }

    /// Closes the hand and sends its frames, but for those up to `known`; `None` if it was interrupted.
    fn feel(&mut self, attempt: &mut Attempt<'a>, place: &Place, known: Option<Key>) -> anyhow::Result<Option<Felt>> {
        let mut felt = Felt { n_frames: 0, elapsed_nanos: 0 };
        let mut last: Option<TactileFrame> = None;
        loop {
            self.operator.beat();
            if !self.obey() {
                return Ok(None);
            }
            // The last reading once more says that there are no more: an arbiter need not wait for silence to say so.
            let (frame, is_last) = match beating(self.operator, || attempt.next_frame(place.grasp_id)) {
                Some(timed) => {
                    felt.elapsed_nanos = timed.offset_nanos;
                    (timed.frame, false)
                }
                None => {
                    felt.elapsed_nanos += self.options.protocol.frame_nanos;
                    let last = last.take().with_context(|| format!("grasp {} has no frames", place.grasp_id))?;
                    (TactileFrame { phase: Phase::Ended, ..last }, true)
                }
            };
            let seq = place.first_seq + felt.n_frames;
            let stamp_nanos = place.begin_nanos + felt.elapsed_nanos;
            felt.n_frames += 1;
            let header = header(seq, stamp_nanos, self.hand_id);
            if send(self.operator, &mut self.frames, &frame, header, known)? == Sent::GaveWay {
                self.obey();
                return Ok(None);
            }
            if is_last {
                return Ok(Some(felt));
            }
            last = Some(frame);
        }
    }

    /// Waits for the decision of a grasp; one that doesn't come is HOLD. `None` if it was interrupted.
    fn wait_for_decision(&mut self, grasp_id: u64) -> anyhow::Result<Option<Action>> {
        let deadline = Instant::now() + Duration::from_secs_f64(self.params.decision_timeout_s);
        loop {
            self.hear()?;
            if let Some(heard) = self.heard.as_ref().filter(|heard| heard.grasp_id == grasp_id) {
                return Ok(Some(heard.action));
            }
            if !self.obey() {
                return Ok(None);
            }
            if Instant::now() >= deadline {
                tracing::warn!(grasp_id, "no decision within {} s: not lifted", self.params.decision_timeout_s);
                self.count(UNDECIDED);
                return Ok(Some(Action::Hold));
            }
            self.idle(TICK)?;
        }
    }

    /// Waits for the advice for a grasp; where it doesn't come, there is none. `None` if it was interrupted.
    fn wait_for_advice(&mut self, grasp_id: u64) -> anyhow::Result<Option<RegraspAdvice>> {
        let deadline = Instant::now() + Duration::from_secs_f64(self.params.decision_timeout_s);
        loop {
            self.hear()?;
            if let Some(advice) = self.advice.as_ref().filter(|advice| advice.grasp_id == grasp_id) {
                return Ok(Some(advice.clone()));
            }
            if !self.obey() {
                return Ok(None);
            }
            if Instant::now() >= deadline {
                tracing::warn!(grasp_id, "no advice within {} s: from anywhere", self.params.decision_timeout_s);
                self.count(UNADVISED);
                return Ok(Some(RegraspAdvice::default()));
            }
            self.idle(TICK)?;
        }
    }

    fn count(&mut self, what: &str) {
        *self.counts.entry(what.into()).or_default() += 1;
        self.operator.has_counted(self.counts.clone());
    }

    /// Takes in the decisions and the advice that have come.
    fn hear(&mut self) -> anyhow::Result<()> {
        while let Some(advices) = &mut self.advices
            && let Some(sample) = advices.receive()?
        {
            let head = sample.user_header();
            self.advice = Some(RegraspAdvice::from_parts(head, sample.payload()).unwrap_or_else(|error| {
                tracing::warn!(grasp_id = head.grasp_id, "advice cannot be read: {error}");
                RegraspAdvice { grasp_id: head.grasp_id, ..RegraspAdvice::default() }
            }));
            self.last_advice = Some(key_of(&head.header));
            advices.commit(&head.header);
        }
        while let Some(sample) = self.decisions.receive()? {
            let head = sample.user_header();
            self.heard = Some(LiftDecision::from_parts(head, sample.payload()).unwrap_or_else(|error| {
                tracing::warn!(grasp_id = head.grasp_id, "a decision cannot be read: {error}");
                LiftDecision { grasp_id: head.grasp_id, ..LiftDecision::default() }
            }));
            self.last_decision = Some(key_of(&head.header));
            self.decisions.commit(&head.header);
        }
        Ok(())
    }

    /// Says what became of an attempt, as far as that is not known; false if it was interrupted.
    fn tell(&mut self, finished: &Finished, known: &Known) -> anyhow::Result<bool> {
        let header = |seq: u64| header(seq, finished.end_nanos, self.hand_id);
        let place = &finished.place;
        let sent = send(self.operator, &mut self.outcomes, &finished.outcome, header(place.grasp_id), known.outcome)?;
        let sent = match (sent, finished.truth()) {
            (Sent::Yes, Some(truth)) => {
                send(self.operator, &mut self.truths, &truth, header(place.n_lifted), known.truth)?
            }
            (sent, _) => sent,
        };
        if sent == Sent::GaveWay {
            self.obey();
        }
        Ok(sent == Sent::Yes)
    }

    fn save(&self) -> anyhow::Result<()> {
        let saved = Saved {
            course: self.course.clone(),
            last_decision: self.last_decision,
            counts: self.decisions.counts(),
            last_advice: self.last_advice,
            advice_counts: self.advices.as_ref().map_or_else(InputCounts::default, |advices| advices.counts()),
        };
        self.operator.save_state(&bincode::serde::encode_to_vec(&saved, STATE_FORMAT)?)
    }
}

/// Where an attempt begins that follows advice, and what was grasped before it.
type Advised = (Start, Grasped);

/// The frames of an attempt.
struct Felt {
    n_frames: u64,
    /// From its beginning to the last frame.
    elapsed_nanos: u64,
}

/// Computes, and gives signs of life meanwhile: with a large mesh, or on a busy machine, it may take a while.
fn beating<T: Send>(operator: &Operator, compute: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        // Nothing is sent: the other side hears that it has gone.
        let (done, is_done) = mpsc::channel::<()>();
        let computing = scope.spawn(move || {
            let _done = done;
            compute()
        });
        while is_done.recv_timeout(TICK) == Err(RecvTimeoutError::Timeout) {
            operator.beat();
        }
        computing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

fn header(seq: u64, stamp_nanos: u64, hand_id: u64) -> Header {
    Header { seq, stamp_nanos, epoch: EPOCH, hand_id, origin_nanos: 0 }
}

/// Sends a sample, unless it is among those up to `known`.
fn send<M: Message>(
    operator: &Operator,
    publisher: &mut Publisher<M>,
    message: &M,
    header: Header,
    known: Option<Key>,
) -> anyhow::Result<Sent> {
    if known.is_some_and(|known| known.seq >= header.seq) {
        return Ok(Sent::Yes);
    }
    let (head, items) = message.to_parts(Header { origin_nanos: monotonic_nanos(), ..header });
    Ok(publisher.send(head, &items, &mut || operator.is_to_give_way())?)
}
