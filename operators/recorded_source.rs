//! Takes the hardware's place: publishes a recording's tactile frames, and the truth where the recording has it.
//!
//! Samples keep their recorded numbers and times, so that the same recording gives the same samples on every edge at
//! any rate; each repetition continues the numbers of the one before. A recording that is damaged anywhere is refused
//! before the first sample goes out. Started again after a crash, or swapped in, it goes on where its readers are.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use blindgrasp::dataflow::{OperatorDescription, ParamKind};
use blindgrasp::message::{GraspTruth, Header, MAX_NAME_BYTES, Message, Recorded, TactileFrame};
use blindgrasp::recording::{Record, RecordingReader};
use blindgrasp::runtime::board::Key;
use blindgrasp::runtime::monotonic_nanos;
use blindgrasp::runtime::operator::{self, Operator, TICK, parse_params};
use blindgrasp::runtime::port::{Publisher, Sent, key_of};
use blindgrasp::runtime::wiring::Command;
use serde::Deserialize;

/// A longer pause between two recorded frames is cut to this: clocks jump, and robots are switched off overnight.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

#[derive(Deserialize)]
struct Params {
    recording: PathBuf,
    rate: NumberOr<RateWord>,
    repeat: NumberOr<RepeatWord>,
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

fn main() -> ExitCode {
    let rate = ParamKind::Number { above: Some(0.0), min: None, max: None, words: vec!["max".into()] };
    let repeat = ParamKind::Number { above: None, min: Some(1.0), max: Some(1e9), words: vec!["forever".into()] };
    let summary = "Publishes the tactile frames of a recording in place of a hand";
    let description = OperatorDescription::new("recorded_source", summary)
        .output("tactile", TactileFrame::TYPE_NAME, "The recorded frames, with their recorded numbers and times")
        .output("truth", GraspTruth::TYPE_NAME, "What each grasp really was, where the recording says")
        .param("recording", ParamKind::Path { must_exist: true }, None, "The recording (MCAP)")
        .live_param("rate", rate, Some(1.0.into()), "Times the recorded speed, or max: as fast as the graph takes it")
        .param("repeat", repeat, Some(1.0.into()), "How many times the recording is played, or forever");
    operator::run(&description, replay)
}

fn replay(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let extent = Extent::of(&params.recording)?;
    let n_repetitions = match params.repeat {
        NumberOr::Number(times) if times.fract() == 0.0 => times as u64,
        NumberOr::Number(times) => bail!("repeat is {times}: expected a whole number or forever"),
        NumberOr::Word(RepeatWord::Forever) => u64::MAX,
    };
    let mut source = Source {
        operator,
        tactile: operator.publisher("tactile", extent.max_items)?,
        truth: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        recording: params.recording,
        pace: Pace { rate: params.rate, last: None },
        extent,
        n_repetitions,
        is_active: !operator.begins_as_standby(),
        is_handed_over: false,
        may_go: false,
    };
    operator.ready(source.extent.identity());
    while !operator.should_stop() {
        if !(source.is_active && source.may_go) {
            source.tactile.look_for_readers()?;
            source.truth.look_for_readers()?;
            operator.sleep(TICK);
            source.obey();
            continue;
        }
        if source.play()? {
            operator.finished();
            // Readers that come back still find the last samples, until all have them.
            while !operator.should_stop() && source.is_active {
                source.tactile.look_for_readers()?;
                source.truth.look_for_readers()?;
                operator.sleep(TICK);
                source.obey();
            }
        }
    }
    operator.drained();
    Ok(())
}

struct Source<'a> {
    operator: &'a Operator,
    tactile: Publisher<TactileFrame>,
    truth: Publisher<GraspTruth>,
    recording: PathBuf,
    pace: Pace,
    extent: Extent,
    n_repetitions: u64,
    is_active: bool,
    /// Whether another instance has handed over: what it has sent will be read.
    is_handed_over: bool,
    may_go: bool,
}

impl Source<'_> {
    /// Does as the launcher says; false if it is to stop sending.
    fn obey(&mut self) -> bool {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::Go => self.may_go = true,
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
                    let from_seq = self.tactile.last().map(|last| last.seq + 1);
                    let outcome = parse_params::<Params>(&params).map(|params| self.pace.rate = params.rate);
                    self.operator.has_set(id, outcome, from_seq);
                }
            }
        }
        self.is_active && !self.operator.should_stop()
    }

    /// Sends what its readers don't have yet; false if it was interrupted.
    fn play(&mut self) -> anyhow::Result<bool> {
        let (frames, truths) = match self.is_handed_over {
            true => (self.tactile.last(), self.truth.last()),
            false => (self.tactile.answered(), self.truth.answered()),
        };
        let (mut frames, mut truths) = (Resume::after(frames), Resume::after(truths));
        self.pace.last = None;
        let first = match self.extent.n_truth_numbers {
            0 => frames.repetition(self.extent.n_frame_numbers),
            n => frames.repetition(self.extent.n_frame_numbers).min(truths.repetition(n)),
        };
        for repetition in first..self.n_repetitions {
            let shift = self.extent.shift(repetition);
            for record in RecordingReader::open(&self.recording)? {
                let (_, record) = record?;
                // Finding the place in a long recording takes its time.
                self.operator.beat();
                if !self.obey() {
                    return Ok(false);
                }
                let is_sent = match record {
                    Record::Tactile(frame) => {
                        let header = shift.header(frame.header, self.extent.n_frame_numbers, self.extent.hand_id);
                        if frames.has(&header) {
                            continue;
                        }
                        // The truth goes out with the frames around it: its stamp may be from another time altogether.
                        if !self.wait_until_due(header.stamp_nanos) {
                            return Ok(false);
                        }
                        let message =
                            TactileFrame { grasp_id: shift.grasp_id(frame.message.grasp_id), ..frame.message };
                        send(self.operator, &mut self.tactile, &message, header)?
                    }
                    Record::Truth(truth) => {
                        let header = shift.header(truth.header, self.extent.n_truth_numbers, self.extent.hand_id);
                        if truths.has(&header) {
                            continue;
                        }
                        let message = GraspTruth { grasp_id: shift.grasp_id(truth.message.grasp_id), ..truth.message };
                        send(self.operator, &mut self.truth, &message, header)?
                    }
                    _ => continue,
                };
                if is_sent == Sent::GaveWay || !self.obey() {
                    self.obey();
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }

    /// Waits until a frame of that recorded time is due; false if it is to stop sending.
    fn wait_until_due(&mut self, stamp_nanos: u64) -> bool {
        let due = self.pace.due(stamp_nanos);
        loop {
            if !self.obey() {
                return false;
            }
            match due.checked_duration_since(Instant::now()) {
                Some(left) if !left.is_zero() => self.operator.sleep(left),
                _ => return true,
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
    fn after(after: Option<Key>) -> Self {
        Resume { after }
    }

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

/// What a recording holds, read once through.
struct Extent {
    hand_id: u64,
    /// How many items its largest frame has.
    max_items: usize,
    /// One more than the greatest number of a frame.
    n_frame_numbers: u64,
    /// One more than the greatest number of a truth.
    n_truth_numbers: u64,
    n_grasp_ids: u64,
    /// From the first frame to where the next repetition's first is due.
    duration_nanos: u64,
}

impl Extent {
    /// Reads the whole recording: what it holds, or what is wrong with it.
    fn of(path: &Path) -> anyhow::Result<Extent> {
        let reader = RecordingReader::open(path)?;
        let info = reader.info().clone();
        let mut extent = Extent {
            hand_id: info.hand_id,
            max_items: 0,
            n_frame_numbers: 0,
            n_truth_numbers: 0,
            n_grasp_ids: 0,
            duration_nanos: 0,
        };
        let mut stamps: Option<(u64, u64, u64)> = None;
        for record in reader {
            match record?.1 {
                Record::Tactile(frame) => {
                    let Header { hand_id, seq, stamp_nanos, .. } = frame.header;
                    if hand_id != 0 && info.hand_id != 0 && hand_id != info.hand_id {
                        bail!(
                            "recording {}: frame {seq} is of the hand {hand_id:016x}, the recording says {:016x} ({})",
                            path.display(),
                            info.hand_id,
                            info.hand
                        );
                    }
                    extent.max_items =
                        extent.max_items.max(frame.message.joints_rad.len() + frame.message.cells_newtons.len());
                    extent.n_frame_numbers = extent.n_frame_numbers.max(seq.saturating_add(1));
                    extent.n_grasp_ids = extent.n_grasp_ids.max(frame.message.grasp_id.saturating_add(1));
                    let (first, last, step) = stamps.unwrap_or((stamp_nanos, stamp_nanos, 0));
                    stamps =
                        Some((first, stamp_nanos, if step == 0 { stamp_nanos.saturating_sub(last) } else { step }));
                }
                Record::Truth(truth) => {
                    extent.n_truth_numbers = extent.n_truth_numbers.max(truth.header.seq.saturating_add(1));
                    extent.n_grasp_ids = extent.n_grasp_ids.max(truth.message.grasp_id.saturating_add(1));
                }
                _ => {}
            }
        }
        let Some((first, last, step)) = stamps else {
            bail!("recording {}: it holds no tactile frames to replay", path.display());
        };
        extent.duration_nanos = last.saturating_sub(first) + step;
        Ok(extent)
    }

    fn identity(&self) -> BTreeMap<String, String> {
        match self.hand_id {
            0 => BTreeMap::new(),
            id => BTreeMap::from([("hand".into(), format!("{id:016x}"))]),
        }
    }

    fn shift(&self, repetition: u64) -> Shift {
        Shift { repetition, n_grasp_ids: self.n_grasp_ids, duration_nanos: self.duration_nanos }
    }
}

/// How a repetition continues the one before.
struct Shift {
    repetition: u64,
    n_grasp_ids: u64,
    duration_nanos: u64,
}

impl Shift {
    fn header(&self, recorded: Header, n_numbers: u64, hand_id: u64) -> Header {
        Header {
            seq: recorded.seq.saturating_add(self.repetition.saturating_mul(n_numbers)),
            stamp_nanos: recorded.stamp_nanos.saturating_add(self.repetition.saturating_mul(self.duration_nanos)),
            hand_id: if recorded.hand_id == 0 { hand_id } else { recorded.hand_id },
            ..recorded
        }
    }

    fn grasp_id(&self, recorded: u64) -> u64 {
        recorded.saturating_add(self.repetition.saturating_mul(self.n_grasp_ids))
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
