//! Takes the place of the hardware: publishes the tactile frames of a recording, and what it knows to be true of its
//! grasps. With the name of a stage's output as an argument it publishes the samples of that stage, and takes its place.
//!
//! Samples keep their recorded numbers and times, so that a recording gives the same samples on every edge at any rate. A
//! small recording that is damaged anywhere is refused before the first sample goes out; a large one, when the damage is
//! reached. Topics that are not played are not decoded, and of a large recording, parts that are not played are not even
//! looked at, where the file's index allows it. `blindgrasp info` and `blindgrasp test` check all of a recording. A source
//! that is started again after a crash, or swapped in, goes on where its readers are.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::bail;
use blindgrasp_messages::{ContactSet, GraspFeature, GraspTruth, MAX_NAME_BYTES, Prediction, Recorded, TactileFrame};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::operator::{Operator, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::Publisher;
use blindgrasp_operator::source::{self, Pace, Source, Step, send_parts};
use blindgrasp_replay::played::Played;
use blindgrasp_replay::player::{Player, Playing, Program};
use blindgrasp_replay::selection::Selection;
use serde::Deserialize;
use serde_json::{Map, Value};

use crate::beginning::FileNode;
use crate::{Form, Shipped};

/// Clocks jump, and robots are switched off overnight.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

#[derive(Deserialize)]
struct Params {
    recording: PathBuf,
    rate: Amount,
    repeat: Amount,
    steps: Amount,
    from_s: Option<f64>,
    to_s: Option<f64>,
    grasps: Option<String>,
    topic: Option<String>,
}

/// A number, or the word for no limit.
#[derive(Deserialize)]
#[serde(untagged)]
enum Amount {
    Number(f64),
    Unlimited(#[expect(dead_code, reason = "each param has one word only")] String),
}

pub(crate) const SHIPPED: Shipped = Shipped {
    variants: &[
        ("tactile", form::<TactileFrame>()),
        ("contacts", form::<ContactSet>()),
        ("feature", form::<GraspFeature>()),
        ("prediction", form::<Prediction>()),
    ],
    ..Shipped::new("recorded_source", describe::<TactileFrame>, work::<TactileFrame>, check::<TactileFrame>)
};

const fn form<M: Played>() -> Form {
    Form { describe: describe::<M>, work: work::<M>, check: check::<M> }
}

fn describe<M: Played>() -> OperatorDescription {
    let number = |above, min, max, word: &str| ParamKind::Number { above, min, max, words: vec![word.into()] };
    let rate = number(Some(0.0), None, None, "max");
    let repeat = number(None, Some(1.0), Some(1e9), "forever");
    let steps = number(None, Some(0.0), Some(1e15), "unlimited");
    let secs = || ParamKind::Number { above: None, min: Some(0.0), max: Some(1e9), words: vec![] };
    let summary = "Publishes the samples of a recording in place of a hand, or of a stage";
    OperatorDescription::new("recorded_source", summary)
        .output(M::PORT, M::TYPE_NAME, "The recorded samples, with their recorded numbers and times")
        .output("truth", GraspTruth::TYPE_NAME, "What each grasp really was, where the recording says")
        .param("recording", ParamKind::Path { must_exist: true }, None, "The recording (MCAP)")
        .live_param("rate", rate, Some(1.0.into()), "Times the recorded speed, or max: as fast as the graph takes it")
        .param("repeat", repeat, Some(1.0.into()), "How many times the recording is played, or forever")
        .live_param("steps", steps, Some("unlimited".into()), "How many frames may go out in all, or unlimited")
        .optional_param("from_s", secs(), "Leave out grasps that begin earlier, in seconds since the first sample")
        .optional_param("to_s", secs(), "Leave out grasps that begin then or later, in seconds since the first sample")
        .optional_param("grasps", ParamKind::String {}, "Play only these grasps, like 3,7-9")
        .optional_param("topic", ParamKind::String {}, "Which topic to play, if several are of this type")
}

/// The mistakes with which [`work`] would fail at once.
fn check<M: Played>(node: &FileNode) -> anyhow::Result<()> {
    opened::<M>(&parse_params(&node.params)?).map(drop)
}

fn opened<M: Played>(params: &Params) -> anyhow::Result<Player<M>> {
    Ok(Player::open(params.program()?)?)
}

fn work<M: Played>(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let player = opened::<M>(&params)?;
    let identity = match player.hand_id() {
        0 => BTreeMap::new(),
        id => BTreeMap::from([("hand".into(), format!("{id:016x}"))]),
    };
    let source = RecordedSource {
        operator,
        frames: operator.publisher(M::PORT, player.max_items())?,
        truths: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        player,
        pace: Pace::new(params.rate.number(), LONGEST_PAUSE),
        n_allowed: params.n_allowed(),
        is_pending: false,
        due: None,
    };
    source::run(operator, identity, source)
}

impl Params {
    fn program(&self) -> anyhow::Result<Program> {
        let n_repetitions = match self.repeat.number() {
            Some(times) if times.fract() == 0.0 => times as u64,
            Some(times) => bail!("repeat is {times}: expected a whole number or forever"),
            None => u64::MAX,
        };
        if let (Some(from), Some(to)) = (self.from_s, self.to_s)
            && from >= to
        {
            bail!("from_s is {from} and to_s {to}: expected from_s below to_s");
        }
        let nanos = |secs: Option<f64>| secs.map(|secs| (secs * 1e9).round() as u64);
        let grasps = self.grasps.as_deref().map(|text| text.parse().map_err(|what| anyhow::anyhow!("grasps: {what}")));
        let selection =
            Selection { from_nanos: nanos(self.from_s), to_nanos: nanos(self.to_s), grasps: grasps.transpose()? };
        Ok(Program { recording: self.recording.clone(), selection, topic: self.topic.clone(), n_repetitions })
    }

    fn n_allowed(&self) -> u64 {
        self.steps.number().map_or(u64::MAX, |steps| steps as u64)
    }
}

impl Amount {
    fn number(&self) -> Option<f64> {
        match self {
            Amount::Number(number) => Some(*number),
            Amount::Unlimited(_) => None,
        }
    }
}

struct RecordedSource<'a, M: Played> {
    operator: &'a Operator,
    frames: Publisher<M>,
    truths: Publisher<GraspTruth>,
    player: Player<M>,
    pace: Pace,
    /// How many frames may go out in all.
    n_allowed: u64,
    /// Whether the player's current frame is still to be sent, because it is not due or may not go out yet.
    is_pending: bool,
    /// When the pending frame is due.
    due: Option<Instant>,
}

impl<M: Played> Source for RecordedSource<'_, M> {
    fn resume(&mut self, is_handed_over: bool) -> anyhow::Result<bool> {
        self.is_pending = false;
        self.pace.restart();
        let operator = self.operator;
        let mut go_on = || {
            operator.beat();
            !operator.has_command() && !operator.should_stop()
        };
        let (frame, truth) = (self.frames.begin(is_handed_over), self.truths.begin(is_handed_over));
        Ok(self.player.resume(frame, truth, &mut go_on)?)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if !std::mem::take(&mut self.is_pending) {
            self.player.advance()?;
            self.due = None;
        }
        let (head, items, n_before) = match self.player.current() {
            Playing::Nothing => return Ok(Step::Next),
            Playing::End => return Ok(Step::Done),
            // A truth goes out with the frames around it: its stamp may be from another time altogether.
            Playing::Truth { head, items } => {
                return Ok(send_parts(self.operator, &mut self.truths, head, items)?.into());
            }
            Playing::Frame { head, items, n_before } => (head, items, n_before),
        };
        if n_before >= self.n_allowed {
            // The time that passes until it may go out need not be made up for.
            self.pace.restart();
            self.is_pending = true;
            return Ok(Step::Wait(None));
        }
        let due = *self.due.get_or_insert_with(|| self.pace.due(M::header(&head).stamp_nanos));
        if due > Instant::now() {
            self.is_pending = true;
            return Ok(Step::Wait(Some(due)));
        }
        Ok(send_parts(self.operator, &mut self.frames, head, items)?.into())
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.frames.look_for_readers()?;
        Ok(self.truths.look_for_readers()?)
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<()> {
        let params: Params = parse_params(params)?;
        self.pace.rate = params.rate.number();
        self.n_allowed = params.n_allowed();
        Ok(())
    }

    fn next_seq(&self) -> Option<u64> {
        self.frames.last().map(|last| last.seq + 1)
    }
}
