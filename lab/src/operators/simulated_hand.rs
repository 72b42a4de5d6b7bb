//! A robot in simulation: tries to lift one object after another, and lets the graph decide whether it lifts.
//!
//! It is a source with feedback inputs: it sends the frames of the hand, waits for the decision about that grasp, lifts or
//! tries again, and sends the outcome. What it sends depends on its parameters and the decisions alone, not on the speed
//! of the machine.
//!
//! After each attempt it saves how far it is, with the attempts whose samples may still be unread. An instance that takes
//! over sends those again and goes on: nothing is lost, no trial has two numbers.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use blindgrasp_cli::shard::Shard;
use blindgrasp_messages::{
    Action, GraspTruth, Header, LiftDecision, LiftOutcome, MAX_NAME_BYTES, Message, Recorded, TactileFrame,
};
use blindgrasp_objects::Object;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::{Operator, TICK, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::{Publisher, Sent, Subscriber, sample_id};
use blindgrasp_operator::source::{self, Source, Step, send};
use blindgrasp_operator::stage::{decode_state, encode_state};
use blindgrasp_operator::wiring::InputCounts;
use blindgrasp_operators::beginning::FileNode;
use blindgrasp_simulator::trial::course::{Course, Finished};
use blindgrasp_simulator::trial::robot::{Doing, Robot, RobotOptions, told_header};
use blindgrasp_simulator::trial::targets::{check_approaches, targets_named};
use blindgrasp_simulator::trial::{LiftTarget, PhysicsEngine, TrialOptions};
use blindgrasp_stages::approach::ApproachPrior;
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;
use serde::{Deserialize, Serialize};

/// The hand of a node that names none.
pub(crate) const DEFAULT_HAND: &str = "barrett-bh8-280";
/// The most attempts that are kept because they may be unread; that many fit into a node's state.
const MAX_UNREAD: usize = 96;

#[derive(Deserialize)]
struct Params {
    hand: Option<PathBuf>,
    things: String,
    trials: u64,
    shard: String,
    seed: u64,
    gate: String,
    attempts: u32,
    watch: String,
    decision_timeout_s: f64,
    options: Option<PathBuf>,
    physics: Option<PhysicsEngine>,
    model: Option<PathBuf>,
}

/// The files and objects of a run.
struct TrialParts {
    hand: Hand,
    things: Vec<LiftTarget>,
    trial_options: TrialOptions,
    prior: Option<ApproachPrior>,
}

pub(crate) fn describe() -> OperatorDescription {
    let whole = |min: i64, max: i64| ParamKind::Integer { min: Some(min), max: Some(max) };
    let seconds = ParamKind::Number { above: Some(0.0), min: None, max: Some(3600.0), words: vec![] };
    let gate = ParamKind::Choice { values: vec!["on".into(), "off".into()] };
    OperatorDescription::new("simulated_hand", "Tries to lift things in simulated physics")
        .feedback_input("decision", LiftDecision::TYPE_NAME, "Whether to lift what the hand holds")
        .output("tactile", TactileFrame::TYPE_NAME, "The frames of the hand while it closes and holds still")
        .output("outcome", LiftOutcome::TYPE_NAME, "What became of each grasp")
        .output("truth", GraspTruth::TYPE_NAME, "Of each grasp that was lifted: whether the object stayed in the hand")
        .optional_param(
            "hand",
            ParamKind::Path { must_exist: true },
            "The hand's pad layout (YAML) instead of the built-in one",
        )
        .param("things", ParamKind::String {}, Some("paper".into()), "What to lift: a comma-separated list")
        .param("trials", whole(1, 1_000_000), Some(110.into()), "How many trials")
        .param("shard", ParamKind::String {}, Some("0/1".into()), "I/N: only every N-th trial, from the I-th on")
        .param("seed", whole(0, i64::MAX), Some(0.into()), "The seed of all random numbers")
        .param("gate", gate, Some("on".into()), "off: every settled grasp is lifted, whatever is decided")
        .param(
            "attempts",
            whole(1, 65_535),
            Some(20.into()),
            "The most attempts of a trial in which nothing is lifted",
        )
        .param(
            "watch",
            ParamKind::Choice { values: vec!["auto".into(), "on".into(), "off".into()] },
            Some("auto".into()),
            "auto: off, but on in trials with a model that judges such frames. on: the hand sends frames while it lifts, asks whether to go on, and \
             tightens or sets down",
        )
        .param(
            "decision_timeout_s",
            seconds,
            Some(30.0.into()),
            "A grasp whose decision is later is not lifted",
        )
        .optional_param(
            "options",
            ParamKind::Path { must_exist: true },
            "How attempts are made (YAML or JSON): options of the protocol, the physics and the cells other than the default",
        )
        .optional_param(
            "physics",
            ParamKind::Choice { values: vec!["rapier".into(), "mujoco".into()] },
            "The physics engine instead of that of the options: rapier is built in, mujoco comes from PyPI",
        )
        .optional_param(
            "model",
            ParamKind::Path { must_exist: true },
            "A model of lifts: of several random approaches, the hand takes the one that it says is kept most often",
        )
}

/// The mistakes with which [`work`] would fail at once, but that no approach is free, which takes simulation to find.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    setup(&parse_params(&node.params)?).map(drop)
}

/// The hand, the things, the options of trials and the approaches that a model prefers.
fn setup(params: &Params) -> anyhow::Result<TrialParts> {
    let hand = Hand::load(params.hand.as_deref().unwrap_or(Path::new(DEFAULT_HAND)))?;
    let things = targets_named(&params.things)?;
    if things.is_empty() {
        bail!("things is '{}': expected at least one thing", params.things);
    }
    for thing in &things {
        let Object { name, class, .. } = &thing.object;
        let names = LiftOutcome { thing: name.clone(), group: class.clone(), ..LiftOutcome::default() };
        names.check().with_context(|| format!("things: '{name}'"))?;
    }
    let mut trial_options =
        params.options.as_deref().map_or_else(|| Ok(TrialOptions::default()), TrialOptions::load)?;
    trial_options.physics.engine = params.physics.unwrap_or(trial_options.physics.engine);
    let prior = match &params.model {
        Some(path) => Model::load(path)?.approach,
        None => None,
    };
    Ok(TrialParts { hand, things, trial_options, prior })
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let TrialParts { hand, things, trial_options, prior } = setup(&params)?;
    operator.reserve_state()?;
    // An instance that goes on has checked before.
    if operator.saved_state().is_none() {
        check_approaches(&hand, &things, &trial_options, params.seed, params.trials)?;
    }
    let shard: Shard = params.shard.parse().map_err(|error| anyhow::anyhow!("shard '{}': {error}", params.shard))?;
    let options = RobotOptions {
        n_trials: params.trials,
        shard_idx: shard.idx,
        n_shards: shard.n,
        seed: params.seed,
        max_attempts: params.attempts,
        lifts_always: params.gate == "off",
        is_watched: params.watch == "on",
    };
    let mut source = SimulatedHand {
        operator,
        frames: operator.publisher("tactile", TactileFrame::max_items(hand.joints.len(), hand.n_cells()))?,
        outcomes: operator.publisher("outcome", 2 * MAX_NAME_BYTES)?,
        truths: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        decisions: Inbox { subscriber: operator.subscriber("decision")?, last: None, received: Vec::new() },
        robot: Robot::new(&hand, things, trial_options, options).with_prior(prior),
        hand_id: hand.id(),
        timeout: Duration::from_secs_f64(params.decision_timeout_s),
        deadline: None,
        known: Known::default(),
        counts: BTreeMap::new(),
    };
    source.look()?;
    source::run(operator, BTreeMap::from([("hand".into(), format!("{:016x}", hand.id()))]), source)
}

/// What another instance needs to go on.
#[derive(Default, Serialize, Deserialize)]
struct Saved {
    course: Course,
    last_decision: Option<SampleId>,
    counts: InputCounts,
}

/// The last sample of each kind that need not be sent again.
#[derive(Default)]
struct Known {
    frame: Option<SampleId>,
    outcome: Option<SampleId>,
    truth: Option<SampleId>,
}

struct SimulatedHand<'a> {
    operator: &'a Operator,
    frames: Publisher<TactileFrame>,
    outcomes: Publisher<LiftOutcome>,
    truths: Publisher<GraspTruth>,
    decisions: Inbox,
    robot: Robot<'a>,
    hand_id: u64,
    timeout: Duration,
    /// When the robot stops waiting for the decision that it has asked for.
    deadline: Option<Instant>,
    known: Known,
    /// What did not come in time, by name.
    counts: BTreeMap<String, u64>,
}

impl Source for SimulatedHand<'_> {
    fn resume(&mut self, is_handed_over: bool) -> anyhow::Result<bool> {
        let saved: Saved = match self.operator.saved_state() {
            Some(bytes) => decode_state("simulated_hand", &bytes)?,
            None => Saved::default(),
        };
        self.decisions.resume(saved.last_decision, saved.counts);
        self.known = Known {
            frame: self.frames.begin(is_handed_over),
            outcome: self.outcomes.begin(is_handed_over),
            truth: self.truths.begin(is_handed_over),
        };
        self.robot.resume(saved.course, self.known.frame.map(|last| last.seq));
        self.deadline = None;
        Ok(true)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if self.robot.is_about_to_begin() && !self.has_room() {
            return Ok(Step::Wait(Some(Instant::now() + Duration::from_millis(1))));
        }
        let robot = &mut self.robot;
        match beating(self.operator, || robot.advance())? {
            Doing::Feels(frame) => {
                let known = self.known.frame;
                Ok(send_unknown(self.operator, &mut self.frames, &frame.message, frame.header, known)?.into())
            }
            Doing::AsksForDecision { grasp_id, n_before } => {
                self.decisions.receive()?;
                let mut of_grasp = self.decisions.received.iter().filter(|decision| decision.grasp_id == grasp_id);
                let action = of_grasp.nth(n_before).map(|decision| decision.action);
                let Some(action) = self.or_hold_when_late(action, grasp_id) else {
                    return Ok(Step::Wait(self.deadline));
                };
                let robot = &mut self.robot;
                beating(self.operator, || robot.decide(action));
                Ok(Step::Next)
            }
            Doing::IsOver(finished) => {
                if self.tell(&finished)? == Sent::GaveWay {
                    return Ok(Step::GaveWay);
                }
                self.robot.conclude();
                self.save()?;
                Ok(Step::Next)
            }
            Doing::LeavesOut { trial, n_attempts, why } => {
                if n_attempts == 0 {
                    tracing::warn!(trial, "left out: {why}");
                    self.count("left_out");
                } else {
                    tracing::warn!(trial, n_attempts, "given up: {why}");
                }
                self.save()?;
                Ok(Step::Next)
            }
            Doing::IsDone => {
                if self.decisions.receive()? {
                    self.save()?;
                }
                Ok(Step::Done)
            }
        }
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.frames.look_for_readers()?;
        self.outcomes.look_for_readers()?;
        self.truths.look_for_readers()?;
        self.decisions.subscriber.connect()?;
        Ok(())
    }
}

impl SimulatedHand<'_> {
    /// Whether another attempt may be kept, once those are forgotten that all readers have read.
    fn has_room(&mut self) -> bool {
        let read_up_to = |last: Option<SampleId>, has_readers: bool| {
            if has_readers { last.map(|last| last.seq) } else { Some(u64::MAX) }
        };
        let frame = read_up_to(self.frames.answered_by_readers(), self.frames.has_readers());
        let outcome = read_up_to(self.outcomes.answered_by_readers(), self.outcomes.has_readers());
        let truth = read_up_to(self.truths.answered_by_readers(), self.truths.has_readers());
        let has = |up_to: Option<u64>, seq: u64| up_to.is_some_and(|up_to| up_to >= seq);
        self.robot.forget(|finished| {
            has(frame, finished.last_seq())
                && has(outcome, finished.place.grasp_id)
                && (!finished.outcome.lifted || has(truth, finished.place.n_lifted))
        });
        self.robot.course().finished.len() < MAX_UNREAD
    }

    /// The action that was decided, or hold when the time is over; `None` while there is time.
    fn or_hold_when_late(&mut self, action: Option<Action>, grasp_id: u64) -> Option<Action> {
        let deadline = *self.deadline.get_or_insert_with(|| Instant::now() + self.timeout);
        if action.is_none() && Instant::now() < deadline {
            return None;
        }
        self.deadline = None;
        if action.is_none() {
            tracing::warn!(grasp_id, "undecided: no answer within {} s", self.timeout.as_secs_f64());
            self.count("undecided");
        }
        Some(action.unwrap_or(Action::Hold))
    }

    /// Sends the outcome of an attempt, and what is known to be true of it, as far as readers may not have them.
    fn tell(&mut self, finished: &Finished) -> anyhow::Result<Sent> {
        let header = |seq: u64| told_header(finished, seq, self.hand_id);
        let place = &finished.place;
        let known = &self.known;
        let (outcome, header_of_outcome) = (&finished.outcome, header(place.grasp_id));
        match (
            send_unknown(self.operator, &mut self.outcomes, outcome, header_of_outcome, known.outcome)?,
            finished.truth(),
        ) {
            (Sent::Yes, Some(truth)) => {
                send_unknown(self.operator, &mut self.truths, &truth, header(place.n_lifted), known.truth)
            }
            (sent, _) => Ok(sent),
        }
    }

    fn count(&mut self, what: &str) {
        *self.counts.entry(what.into()).or_default() += 1;
        self.operator.has_counted(self.counts.clone());
    }

    fn save(&mut self) -> anyhow::Result<()> {
        let saved = Saved {
            course: self.robot.course().clone(),
            last_decision: self.decisions.last,
            counts: self.decisions.subscriber.counts(),
        };
        let mut state = Vec::new();
        encode_state("simulated_hand", &saved, &mut state)?;
        self.operator.save_state(&state)?;
        // An instance that takes over asks for whatever the saved state does not include: until now its sender had to keep it.
        self.decisions.commit();
        Ok(())
    }
}

/// The decisions, which matter until the attempt is over.
struct Inbox {
    subscriber: Subscriber<LiftDecision>,
    /// The last sample received.
    last: Option<SampleId>,
    received: Vec<LiftDecision>,
}

impl Inbox {
    fn resume(&mut self, last: Option<SampleId>, counts: InputCounts) {
        self.last = last;
        self.received.clear();
        self.subscriber.take_over_at(last, last, counts, last);
    }

    /// Whether something has come. It is not answered before [`Inbox::commit`].
    fn receive(&mut self) -> anyhow::Result<bool> {
        let before = self.last;
        while let Some(sample) = self.subscriber.receive()? {
            let head = sample.head();
            let decision = LiftDecision::from_parts(head, sample.items()).unwrap_or_else(|error| {
                tracing::warn!(seq = head.header.seq, "a decision cannot be read, so its grasp is held: {error}");
                LiftDecision { grasp_id: head.grasp_id, ..LiftDecision::default() }
            });
            self.received.push(decision);
            self.last = Some(sample_id(&head.header));
        }
        Ok(self.last != before)
    }

    fn commit(&mut self) {
        self.received.clear();
        if let Some(last) = self.last {
            self.subscriber.commit_late(last, &self.subscriber.counts());
        }
    }
}

/// Computes, and gives signs of life meanwhile: with a large mesh, or on a busy machine, it may take a while.
fn beating<T: Send>(operator: &Operator, compute: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        // Nothing is sent: the receiver notices that the sender is gone.
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

/// Sends a sample, unless it is among those up to `known`.
fn send_unknown<M: Message>(
    operator: &Operator,
    publisher: &mut Publisher<M>,
    message: &M,
    header: Header,
    known: Option<SampleId>,
) -> anyhow::Result<Sent> {
    if known.is_some_and(|known| known.seq >= header.seq) {
        return Ok(Sent::Yes);
    }
    Ok(send(operator, publisher, message, header)?)
}
