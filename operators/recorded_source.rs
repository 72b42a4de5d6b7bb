//! Takes the hardware's place: publishes a recording's tactile frames, and the truth where the recording has it. With an
//! argument it publishes what a stage said instead, and takes that stage's place.
//!
//! Samples keep their recorded numbers and times, so that the same recording gives the same samples on every edge at
//! any rate; `blindgrasp_replay::selection` says how a part of it is numbered. Each repetition continues the numbers of
//! the one before. A small recording that is damaged anywhere is refused before the first sample goes out; a large one,
//! when the damage is reached. Started again after a crash, or swapped in, it goes on where its readers are.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use blindgrasp_messages::{
    ContactSet, GraspFeature, GraspTruth, Header, MAX_NAME_BYTES, Message, Prediction, Recorded, Stamped, TactileFrame,
};
use blindgrasp_operator::board::Key;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{self, Operator, TICK, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::{Publisher, Sent, key_of};
use blindgrasp_operator::wiring::Command;
use blindgrasp_recording::RecordingReader;
use blindgrasp_replay::playback::{Next, Playback};
use blindgrasp_replay::played::{PLAYED, Played};
use blindgrasp_replay::selection::Selection;
use serde::Deserialize;

/// A longer pause between two recorded frames is cut to this: clocks jump, and robots are switched off overnight.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// A larger recording is not read through before its first sample goes out: that would take seconds.
const MAX_CHECKED_BYTES: u64 = 64 << 20;

#[derive(Deserialize)]
struct Params {
    recording: PathBuf,
    rate: NumberOr<RateWord>,
    repeat: NumberOr<RepeatWord>,
    steps: NumberOr<StepsWord>,
    from_s: Option<f64>,
    to_s: Option<f64>,
    grasps: Option<String>,
    topic: Option<String>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum NumberOr<Word> {
    Number(f64),
    Word(Word),
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum RateWord {
    /// As fast as the graph takes it.
    Max,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum RepeatWord {
    /// Until somebody stops it.
    Forever,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum StepsWord {
    /// All there are.
    Unlimited,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--describe").collect();
    let ports = PLAYED.map(|(port, _)| port);
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        [] | [TactileFrame::PORT] => run::<TactileFrame>("The recorded frames"),
        [ContactSet::PORT] => run::<ContactSet>("The recorded contacts of each frame"),
        [GraspFeature::PORT] => run::<GraspFeature>("The recorded feature of each frame"),
        [Prediction::PORT] => run::<Prediction>("The recorded prediction for each frame"),
        _ => {
            print_diagnostic(&format!(
                "recorded_source: unknown arguments {}: expected one of {}, or nothing",
                arguments.join(" "),
                ports.join(", ")
            ));
            ExitCode::from(2)
        }
    }
}

fn run<M: Played>(what: &str) -> ExitCode {
    let rate = ParamKind::Number { above: Some(0.0), min: None, max: None, words: vec!["max".into()] };
    let repeat = ParamKind::Number { above: None, min: Some(1.0), max: Some(1e9), words: vec!["forever".into()] };
    let steps = ParamKind::Number { above: None, min: Some(0.0), max: Some(1e15), words: vec!["unlimited".into()] };
    let secs = || ParamKind::Number { above: None, min: Some(0.0), max: Some(1e9), words: vec![] };
    let summary = "Publishes the samples of a recording in place of a hand, or of a stage";
    let description = OperatorDescription::new("recorded_source", summary)
        .output(M::PORT, M::TYPE_NAME, &format!("{what}, with their recorded numbers and times"))
        .output("truth", GraspTruth::TYPE_NAME, "What each grasp really was, where the recording says")
        .param("recording", ParamKind::Path { must_exist: true }, None, "The recording (MCAP)")
        .live_param("rate", rate, Some(1.0.into()), "Times the recorded speed, or max: as fast as the graph takes it")
        .param("repeat", repeat, Some(1.0.into()), "How many times the recording is played, or forever")
        .live_param("steps", steps, Some("unlimited".into()), "How many frames may go out in all, or unlimited")
        .optional_param("from_s", secs(), "Leave out grasps that begin earlier, in seconds since the first sample")
        .optional_param("to_s", secs(), "Leave out grasps that begin then or later, in seconds since the first sample")
        .optional_param("grasps", ParamKind::String {}, "Play only these grasps, like 3,7-9")
        .optional_param("topic", ParamKind::String {}, "Which topic to play, if several are of this type");
    operator::run(&description, replay::<M>)
}

fn replay<M: Played>(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let n_repetitions = match params.repeat {
        NumberOr::Number(times) if times.fract() == 0.0 => times as u64,
        NumberOr::Number(times) => bail!("repeat is {times}: expected a whole number or forever"),
        NumberOr::Word(RepeatWord::Forever) => u64::MAX,
    };
    let what =
        What { selection: params.selection()?, topic: params.topic.clone(), recording: params.recording.clone() };
    let hand_id = RecordingReader::open(&what.recording)?.info().hand_id;
    let n_bytes = std::fs::metadata(&what.recording).with_context(|| what.recording.display().to_string())?.len();
    let extent = match n_bytes {
        ..=MAX_CHECKED_BYTES => what.extent::<M>(&mut || true)?,
        _ => None,
    };
    let max_items = extent.as_ref().map_or(M::MAX_ITEMS, |extent| extent.max_items);
    let mut source = Source::<M> {
        operator,
        frames: operator.publisher(M::PORT, max_items)?,
        truth: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        pace: Pace { rate: params.rate, last: None },
        n_allowed: n_allowed(&params.steps),
        what,
        hand_id,
        extent,
        n_repetitions,
        is_active: !operator.begins_as_standby(),
        is_handed_over: false,
        may_go: false,
    };
    operator.ready(match hand_id {
        0 => BTreeMap::new(),
        id => BTreeMap::from([("hand".into(), format!("{id:016x}"))]),
    });
    while !operator.should_stop() {
        if !(source.is_active && source.may_go) {
            source.look_for_readers()?;
            operator.sleep(TICK);
            source.obey();
            continue;
        }
        if source.play()? {
            operator.finished();
            // Readers that come back still find the last samples, until all have them.
            while !operator.should_stop() && source.is_active {
                source.look_for_readers()?;
                operator.sleep(TICK);
                source.obey();
            }
        }
    }
    operator.drained();
    Ok(())
}

impl Params {
    fn selection(&self) -> anyhow::Result<Selection> {
        let nanos = |secs: Option<f64>| secs.map(|secs| (secs * 1e9).round() as u64);
        let grasps = self.grasps.as_deref().map(|text| text.parse().map_err(|what| anyhow::anyhow!("grasps: {what}")));
        let selection =
            Selection { from_nanos: nanos(self.from_s), to_nanos: nanos(self.to_s), grasps: grasps.transpose()? };
        if let (Some(from), Some(to)) = (self.from_s, self.to_s)
            && from >= to
        {
            bail!("from_s is {from} and to_s {to}: expected from_s below to_s");
        }
        Ok(selection)
    }
}

fn n_allowed(steps: &NumberOr<StepsWord>) -> u64 {
    match steps {
        NumberOr::Number(steps) => *steps as u64,
        NumberOr::Word(StepsWord::Unlimited) => u64::MAX,
    }
}

/// What is played.
struct What {
    recording: PathBuf,
    selection: Selection,
    topic: Option<String>,
}

impl What {
    fn open<M: Played>(&self) -> anyhow::Result<Playback<M>> {
        Ok(Playback::open(&self.recording, &self.selection, self.topic.as_deref())?)
    }

    /// Reads it through: its extent, `None` if `go_on` says no.
    fn extent<M: Played>(&self, go_on: &mut dyn FnMut() -> bool) -> anyhow::Result<Option<Extent>> {
        let mut extent = Extent::default();
        for next in self.open::<M>()? {
            match next? {
                Next::Frame(frame) => extent.add_frame(&frame),
                Next::Truth(truth) => extent.add_truth(&truth),
                Next::Nothing => {}
            }
            if !go_on() {
                return Ok(None);
            }
        }
        Ok(Some(extent))
    }
}

struct Source<'a, M: Message> {
    operator: &'a Operator,
    frames: Publisher<M>,
    truth: Publisher<GraspTruth>,
    what: What,
    pace: Pace,
    /// How many frames may go out in all.
    n_allowed: u64,
    hand_id: u64,
    /// `None` until it has been read through.
    extent: Option<Extent>,
    n_repetitions: u64,
    is_active: bool,
    /// Whether another instance has handed over: what it has sent will be read.
    is_handed_over: bool,
    may_go: bool,
}

impl<M: Played> Source<'_, M> {
    /// Does as the launcher says; false if it is to stop sending.
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
                Command::Set { id, params } => {
                    let from_seq = self.frames.last().map(|last| last.seq + 1);
                    let outcome = parse_params::<Params>(&params).map(|params| {
                        self.pace.rate = params.rate;
                        self.n_allowed = n_allowed(&params.steps);
                    });
                    self.operator.has_set(id, outcome, from_seq);
                }
            }
        }
        self.is_active && !self.operator.should_stop()
    }

    fn look_for_readers(&mut self) -> anyhow::Result<()> {
        self.frames.look_for_readers()?;
        self.truth.look_for_readers()?;
        Ok(())
    }

    /// Sends what its readers don't have yet; false if it was interrupted.
    fn play(&mut self) -> anyhow::Result<bool> {
        let (frames, truths) = match self.is_handed_over {
            true => (self.frames.last(), self.truth.last()),
            false => (self.frames.answered(), self.truth.answered()),
        };
        let (mut frames, mut truths) = (Resume { after: frames }, Resume { after: truths });
        self.pace.last = None;
        if self.n_repetitions > 1 && self.extent.is_none() && frames.after.is_some() {
            // Where the readers are can be in any repetition.
            self.extent = {
                let operator = self.operator;
                let mut go_on = || {
                    operator.beat();
                    !operator.has_command() && !operator.should_stop()
                };
                self.what.extent::<M>(&mut go_on)?
            };
            if self.extent.is_none() {
                self.obey();
                return Ok(false);
            }
        }
        let first = self.extent.as_ref().map_or(0, |extent| match extent.n_truth_numbers {
            0 => frames.repetition(extent.n_frame_numbers),
            n => frames.repetition(extent.n_frame_numbers).min(truths.repetition(n)),
        });
        let mut n_frames = self.extent.as_ref().map_or(0, |extent| first.saturating_mul(extent.n_frames));
        for repetition in first..self.n_repetitions {
            let mut extent = Extent::default();
            let shift = Shift { repetition, of: self.extent.clone().unwrap_or_default(), hand_id: self.hand_id };
            for next in self.what.open::<M>()? {
                // Finding the place in a long recording takes its time.
                self.operator.beat();
                if !self.obey() {
                    return Ok(false);
                }
                let sent = match next? {
                    Next::Nothing => continue,
                    Next::Frame(frame) => {
                        extent.add_frame(&frame);
                        let header = shift.header(frame.header, shift.of.n_frame_numbers);
                        let n_before = n_frames;
                        n_frames += 1;
                        if frames.has(&header) {
                            continue;
                        }
                        // The truth goes out with the frames around it: its stamp may be from another time altogether.
                        if !self.wait_until_allowed(n_before)? || !self.wait_until_due(header.stamp_nanos)? {
                            return Ok(false);
                        }
                        let grasp_id = shift.grasp_id(frame.message.grasp_id());
                        send(self.operator, &mut self.frames, &frame.message.with_grasp_id(grasp_id), header)?
                    }
                    Next::Truth(truth) => {
                        extent.add_truth(&truth);
                        let header = shift.header(truth.header, shift.of.n_truth_numbers);
                        if truths.has(&header) {
                            continue;
                        }
                        let message = GraspTruth { grasp_id: shift.grasp_id(truth.message.grasp_id), ..truth.message };
                        send(self.operator, &mut self.truth, &message, header)?
                    }
                };
                if sent == Sent::GaveWay || !self.obey() {
                    self.obey();
                    return Ok(false);
                }
            }
            self.extent.get_or_insert(extent);
        }
        Ok(true)
    }

    /// Waits until one more than `n_before` frames may go out; false if it is to stop sending.
    fn wait_until_allowed(&mut self, n_before: u64) -> anyhow::Result<bool> {
        while n_before >= self.n_allowed {
            // Afterwards nothing is to be made up for.
            self.pace.last = None;
            self.look_for_readers()?;
            self.operator.sleep(TICK);
            if !self.obey() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Waits until a frame of that recorded time is due; false if it is to stop sending.
    fn wait_until_due(&mut self, stamp_nanos: u64) -> anyhow::Result<bool> {
        let due = self.pace.due(stamp_nanos);
        loop {
            if !self.obey() {
                return Ok(false);
            }
            match due.checked_duration_since(Instant::now()) {
                Some(left) if !left.is_zero() => {
                    if left > TICK {
                        self.look_for_readers()?;
                    }
                    self.operator.sleep(left);
                }
                _ => return Ok(true),
            }
        }
    }
}

fn send<M: Message>(
    operator: &Operator,
    publisher: &mut Publisher<M>,
    message: &M,
    header: Header,
) -> anyhow::Result<Sent> {
    let (head, items) = message.to_parts(Header { origin_nanos: monotonic_nanos(), ..header });
    operator.beat();
    Ok(publisher.send(head, &items, &mut || operator.is_to_give_way())?)
}

/// Where to go on.
struct Resume {
    after: Option<Key>,
}

impl Resume {
    /// Which repetition the place is in.
    fn repetition(&self, n_numbers: u64) -> u64 {
        self.after.map_or(0, |key| key.seq / n_numbers.max(1))
    }

    /// Whether the readers have this sample; to be asked for one after the other.
    fn has(&mut self, header: &Header) -> bool {
        let Some(after) = self.after else {
            return false;
        };
        let key = key_of(header);
        let is_past = key.epoch == after.epoch && key.seq >= after.seq;
        if is_past {
            self.after = None;
        }
        !is_past || key == after
    }
}

/// What is played of a recording, once read through.
#[derive(Clone, Default)]
struct Extent {
    /// How many items its largest frame has.
    max_items: usize,
    n_frames: u64,
    /// One more than the greatest number of a frame.
    n_frame_numbers: u64,
    /// One more than the greatest number of a truth.
    n_truth_numbers: u64,
    n_grasp_ids: u64,
    /// Of the first frame, of the last one, and how far apart the first two are.
    stamps: Option<(u64, u64, u64)>,
}

impl Extent {
    fn add_frame<M: Played>(&mut self, frame: &Stamped<M>) {
        let Header { seq, stamp_nanos, .. } = frame.header;
        self.n_frames += 1;
        self.max_items = self.max_items.max(frame.message.to_parts(frame.header).1.len());
        self.n_frame_numbers = self.n_frame_numbers.max(seq.saturating_add(1));
        self.n_grasp_ids = self.n_grasp_ids.max(frame.message.grasp_id().saturating_add(1));
        let (first, last, step) = self.stamps.unwrap_or((stamp_nanos, stamp_nanos, 0));
        self.stamps = Some((first, stamp_nanos, if step == 0 { stamp_nanos.saturating_sub(last) } else { step }));
    }

    fn add_truth(&mut self, truth: &Stamped<GraspTruth>) {
        self.n_truth_numbers = self.n_truth_numbers.max(truth.header.seq.saturating_add(1));
        self.n_grasp_ids = self.n_grasp_ids.max(truth.message.grasp_id.saturating_add(1));
    }

    /// From the first frame to where the next repetition's first is due.
    fn duration_nanos(&self) -> u64 {
        self.stamps.map_or(0, |(first, last, step)| last.saturating_sub(first) + step)
    }
}

/// How a repetition continues the one before.
struct Shift {
    repetition: u64,
    of: Extent,
    hand_id: u64,
}

impl Shift {
    fn header(&self, recorded: Header, n_numbers: u64) -> Header {
        let duration_nanos = self.of.duration_nanos();
        Header {
            seq: recorded.seq.saturating_add(self.repetition.saturating_mul(n_numbers)),
            stamp_nanos: recorded.stamp_nanos.saturating_add(self.repetition.saturating_mul(duration_nanos)),
            hand_id: if recorded.hand_id == 0 { self.hand_id } else { recorded.hand_id },
            ..recorded
        }
    }

    fn grasp_id(&self, recorded: u64) -> u64 {
        recorded.saturating_add(self.repetition.saturating_mul(self.of.n_grasp_ids))
    }
}

/// Turns recorded times into waiting.
struct Pace {
    rate: NumberOr<RateWord>,
    /// When the last frame was due, and its recorded time.
    last: Option<(Instant, u64)>,
}

impl Pace {
    /// When a frame of that recorded time is due.
    fn due(&mut self, stamp_nanos: u64) -> Instant {
        let NumberOr::Number(times) = self.rate else {
            self.last = None;
            return Instant::now();
        };
        let (last_due, last_stamp_nanos) = self.last.unwrap_or((Instant::now(), stamp_nanos));
        let recorded = Duration::from_nanos(stamp_nanos.saturating_sub(last_stamp_nanos));
        if recorded > LONGEST_PAUSE {
            tracing::warn!(stamp_nanos, "skipping a pause of {:.0} s in the recording", recorded.as_secs_f64());
        }
        let pause = Duration::try_from_secs_f64(recorded.min(LONGEST_PAUSE).as_secs_f64() / times);
        let due = last_due.checked_add(pause.unwrap_or(LONGEST_PAUSE)).unwrap_or(last_due);
        self.last = Some((due, stamp_nanos));
        due
    }
}
