//! The hardware's side of the graph: live tactile frames, from a bridge over TCP, a serial device, or a recording played
//! as the hardware would.
//!
//! What is malformed, late or out of order is counted, never passed on, and leaves a gap in the numbers, so that the
//! arbiter holds the grasp it belonged to. It loses its sender and finds it again by itself. Started again after a crash,
//! or swapped in, it goes on with the numbers and grasps of the one before, after a gap.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, bail};
use blindgrasp_messages::{Header, MAX_CELLS, MAX_JOINTS, Recorded, TactileFrame, TactileFrameHead};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{self, Operator, TICK, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::{Publisher, Sent};
use blindgrasp_operator::stage::STATE_FORMAT;
use blindgrasp_operator::wiring::Command;
use blindgrasp_stages::hand::Hand;
use blindgrasp_tactile::gate::{Counts, FrameFilter, Shape};
use blindgrasp_tactile::replay::Replay;
use blindgrasp_tactile::stream::{Link, Stream};
use blindgrasp_tactile::{Arrival, Event, ExpectedHand, Place, Reading, Refusal, TactileDriver};
use serde::Deserialize;

/// Where a bridge finds the source if the file says nothing else: on this machine, and only there.
const DEFAULT_ADDRESS: &str = "127.0.0.1:7400";
const DEFAULT_BAUD: u32 = 115_200;
/// How late a frame may be if the file says nothing else: half of what the arbiter allows by default, which counts from
/// the source on.
const DEFAULT_MAX_DELAY_MS: f64 = 100.0;
/// How often counts are reported at most.
const COUNTS_PAUSE_NANOS: u64 = 250_000_000;
/// How often refusals are logged at most.
const LOG_PAUSE_NANOS: u64 = 1_000_000_000;

#[derive(Deserialize)]
struct Params {
    driver: DriverWord,
    hand: PathBuf,
    address: Option<String>,
    device: Option<PathBuf>,
    baud: Option<u32>,
    recording: Option<PathBuf>,
    max_delay_ms: f64,
    idle_limit_ms: Option<f64>,
}

#[derive(Deserialize, Clone, Copy)]
#[serde(rename_all = "snake_case")]
enum DriverWord {
    Listen,
    Connect,
    Serial,
    Recording,
}

fn main() -> ExitCode {
    let drivers = ["listen", "connect", "serial", "recording"].map(String::from).to_vec();
    let millis = |min: f64| ParamKind::Number { above: None, min: Some(min), max: Some(3.6e6), words: vec![] };
    let file = |must_exist| ParamKind::Path { must_exist };
    let description = OperatorDescription::new("tactile_source", "Publishes a hand's live tactile frames")
        .output("tactile", TactileFrame::TYPE_NAME, "The frames, in order; what was refused or missed is a gap")
        .param("driver", ParamKind::Choice { values: drivers }, Some("listen".into()), "Where the frames come from")
        .param("hand", file(true), None, "The hand's pad layout (YAML)")
        .optional_param(
            "address",
            ParamKind::String {},
            "listen: where, 127.0.0.1:7400 by default; connect: the bridge's address and port",
        )
        .optional_param("device", file(false), "serial: the device")
        .optional_param(
            "baud",
            ParamKind::Integer { min: Some(50), max: Some(20_000_000) },
            "serial: bits per second, 115200 by default",
        )
        .optional_param("recording", file(true), "recording: the recording (MCAP)")
        .live_param(
            "max_delay_ms",
            millis(1.0),
            Some(DEFAULT_MAX_DELAY_MS.into()),
            "A frame whose delay is so much above the least is late, and dropped",
        )
        .optional_param("idle_limit_ms", millis(1.0), "A bridge that says nothing for so long is disconnected");
    operator::run(&description, work)
}

fn work(operator: &Operator) -> anyhow::Result<()> {
    let params: Params = operator.params()?;
    let hand = Hand::load(&params.hand)?;
    let (n_joints, n_cells) = (hand.joints.len(), hand.n_cells());
    if n_joints > MAX_JOINTS || n_cells > MAX_CELLS {
        bail!("hand {}: {n_joints} joints and {n_cells} cells, at most {MAX_JOINTS} and {MAX_CELLS}", hand.name);
    }
    let driver = driver(&params, &hand)?;
    operator.reserve_state()?;
    let shape = Shape { n_joints, n_cells };
    let wall_offset_nanos = wall_nanos().saturating_sub(monotonic_nanos());
    let mut source = Source {
        operator,
        tactile: operator.publisher("tactile", n_joints + n_cells)?,
        driver,
        hand_id: hand.id(),
        gate: FrameFilter::new(shape, max_delay_nanos(&params), wall_offset_nanos, Place::default(), None),
        epoch: 0,
        items: Vec::with_capacity(n_joints + n_cells),
        poll_pause: poll_pause(&params),
        is_active: false,
        may_go: false,
        reported: Counts::default(),
        report_due_nanos: 0,
        log: RefusalLog::default(),
        look_due_nanos: 0,
    };
    if !operator.begins_as_standby() {
        source.begin()?;
        source.driver.open(monotonic_nanos())?;
        source.is_active = true;
    }
    operator.ready(BTreeMap::from([("hand".into(), format!("{:016x}", hand.id()))]));
    source.run()?;
    source.driver.close();
    source.report_counts();
    operator.drained();
    Ok(())
}

/// The driver that the parameters ask for. A parameter that it has no use for is a mistake.
fn driver(params: &Params, hand: &Hand) -> anyhow::Result<Box<dyn TactileDriver>> {
    let (word, needs): (_, &[&str]) = match params.driver {
        DriverWord::Listen => ("listen", &["address", "idle_limit_ms"]),
        DriverWord::Connect => ("connect", &["address", "idle_limit_ms"]),
        DriverWord::Serial => ("serial", &["device", "baud", "idle_limit_ms"]),
        DriverWord::Recording => ("recording", &["recording"]),
    };
    let given = [
        ("address", params.address.is_some()),
        ("device", params.device.is_some()),
        ("baud", params.baud.is_some()),
        ("recording", params.recording.is_some()),
        ("idle_limit_ms", params.idle_limit_ms.is_some()),
    ];
    if let Some((name, _)) = given.iter().find(|(name, is_given)| *is_given && !needs.contains(name)) {
        bail!("param '{name}' is of no use to driver {word}, which takes {}: leave it out", needs.join(", "));
    }
    let expected = ExpectedHand::of(hand);
    let lacks = |name: &str, example: &str| format!("driver {word} needs the param '{name}', like {example}");
    let link = match params.driver {
        DriverWord::Listen => {
            Link::Listen { address: params.address.clone().unwrap_or_else(|| DEFAULT_ADDRESS.into()) }
        }
        DriverWord::Connect => {
            Link::Connect { address: params.address.clone().with_context(|| lacks("address", "robot.local:7400"))? }
        }
        DriverWord::Serial => Link::Serial {
            device: params.device.clone().with_context(|| lacks("device", "/dev/ttyACM0"))?,
            baud: params.baud.unwrap_or(DEFAULT_BAUD),
        },
        DriverWord::Recording => {
            let recording = params.recording.as_ref().with_context(|| lacks("recording", "recordings/mine.mcap"))?;
            return Ok(Box::new(Replay::new(recording, hand)?));
        }
    };
    let idle_limit_nanos = params.idle_limit_ms.map(|millis| (millis * 1e6) as u64);
    Ok(Box::new(Stream::new(link, expected, idle_limit_nanos)))
}

fn max_delay_nanos(params: &Params) -> u64 {
    (params.max_delay_ms * 1e6) as u64
}

/// How long to wait at most before it is looked whether something came: twice as often as a frame may be late, so that a
/// source that stood still for that long can tell.
fn poll_pause(params: &Params) -> Duration {
    Duration::from_nanos(max_delay_nanos(params) / 2).min(TICK)
}

fn wall_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}

struct Source<'a> {
    operator: &'a Operator,
    tactile: Publisher<TactileFrame>,
    driver: Box<dyn TactileDriver>,
    hand_id: u64,
    gate: FrameFilter,
    epoch: u64,
    items: Vec<f64>,
    poll_pause: Duration,
    is_active: bool,
    may_go: bool,
    reported: Counts,
    report_due_nanos: u64,
    log: RefusalLog,
    look_due_nanos: u64,
}

impl Source<'_> {
    fn run(&mut self) -> anyhow::Result<()> {
        while !self.operator.should_stop() {
            self.obey()?;
            if self.is_active && self.may_go {
                while !self.operator.has_command() && !self.operator.should_stop() {
                    let now_nanos = monotonic_nanos();
                    let Some(event) = self.driver.poll(now_nanos, self.gate.place())? else {
                        break;
                    };
                    self.take(event)?;
                    self.operator.beat();
                    self.look_now_and_then(now_nanos)?;
                }
            }
            self.look_now_and_then(monotonic_nanos())?;
            self.wait();
        }
        Ok(())
    }

    fn wait(&self) {
        let mut fds = Vec::new();
        let mut limit = TICK;
        if self.is_active && self.may_go {
            self.driver.watch(&mut fds);
            let left = |due: u64| Duration::from_nanos(due.saturating_sub(monotonic_nanos()));
            limit = self.driver.due_nanos().map_or(self.poll_pause, left).min(self.poll_pause);
        }
        if !self.operator.has_command() {
            self.operator.wait_for(&[], &fds, limit);
        }
    }

    fn obey(&mut self) -> anyhow::Result<()> {
        while let Some(command) = self.operator.next_command() {
            match command {
                Command::Go => self.may_go = true,
                Command::NodeEnded { .. } | Command::TakeNoMore { .. } => {}
                Command::TakeOver { .. } => {
                    self.begin()?;
                    // Who fails here tries again: the one before may still be letting go.
                    if let Err(error) = self.driver.open(monotonic_nanos()) {
                        print_diagnostic(&error.to_string());
                    }
                    self.is_active = true;
                    self.operator.took_over();
                }
                Command::HandOver => {
                    self.is_active = false;
                    self.driver.close();
                    self.report_counts();
                    self.operator.handed_over();
                }
                Command::Set { id, params } => {
                    let outcome = parse_params::<Params>(&params).map(|params| {
                        self.gate.set_max_delay_nanos(max_delay_nanos(&params));
                        self.poll_pause = poll_pause(&params);
                    });
                    self.operator.has_set(id, outcome, self.tactile.last().map(|last| last.seq + 1));
                }
            }
        }
        Ok(())
    }

    /// Goes on from where the node's instance before was, if there was one.
    fn begin(&mut self) -> anyhow::Result<()> {
        let last = self.tactile.last();
        // A graph's numbers begin with its first source.
        self.epoch = last.map_or_else(wall_nanos, |last| last.epoch);
        let place = match self.operator.saved_state() {
            Some(bytes) => bincode::serde::decode_from_slice(&bytes, STATE_FORMAT)?.0,
            None => Place::default(),
        };
        self.gate.resume(place, last.map(|last| last.seq));
        Ok(())
    }

    fn take(&mut self, event: Event) -> anyhow::Result<()> {
        match event {
            Event::Began => self.gate.began(),
            Event::TurnedAway => self.gate.turned_away(),
            Event::Frame(reading, arrival) => self.pass(&reading, &arrival)?,
            Event::Refused(refusal) => {
                self.gate.refused(refusal.kind);
                self.refuse(&refusal);
            }
            Event::Ended => self.operator.finished(),
        }
        Ok(())
    }

    fn pass(&mut self, reading: &Reading, arrival: &Arrival) -> anyhow::Result<()> {
        let passed = match self.gate.take(reading, arrival) {
            Ok(passed) => passed,
            Err(refusal) => {
                self.refuse(&refusal);
                return Ok(());
            }
        };
        // First: whoever takes over must not use the number of a grasp again.
        self.operator.save_state(&bincode::serde::encode_to_vec(self.gate.place(), STATE_FORMAT)?)?;
        self.items.clear();
        self.items.extend_from_slice(&reading.joints_rad);
        self.items.extend_from_slice(&reading.cells_newtons);
        let head = TactileFrameHead {
            header: Header {
                seq: passed.seq,
                stamp_nanos: passed.stamp_nanos,
                epoch: self.epoch,
                hand_id: self.hand_id,
                origin_nanos: monotonic_nanos(),
            },
            grasp_id: passed.grasp_id,
            phase: reading.phase.code(),
            n_joints: reading.joints_rad.len() as u32,
        };
        self.operator.beat();
        let operator = self.operator;
        match self.tactile.send(head, &self.items, &mut || operator.is_to_give_way())? {
            // What was not sent is a gap before what comes next.
            Sent::Yes | Sent::GaveWay => Ok(()),
        }
    }

    fn refuse(&mut self, refusal: &Refusal) {
        let now_nanos = monotonic_nanos();
        self.driver.refused(refusal, now_nanos);
        self.log.refused(refusal, now_nanos);
    }

    fn look_now_and_then(&mut self, now_nanos: u64) -> anyhow::Result<()> {
        if now_nanos >= self.look_due_nanos {
            self.look_due_nanos = now_nanos + TICK.as_nanos() as u64;
            self.tactile.look_for_readers()?;
        }
        self.tell_now_and_then(now_nanos);
        Ok(())
    }

    fn tell_now_and_then(&mut self, now_nanos: u64) {
        self.log.flush(now_nanos);
        if now_nanos >= self.report_due_nanos && *self.gate.counts() != self.reported {
            self.report_due_nanos = now_nanos + COUNTS_PAUSE_NANOS;
            self.report_counts();
        }
    }

    fn report_counts(&mut self) {
        self.reported = *self.gate.counts();
        self.operator.has_counted(self.reported.by_name());
    }
}

/// Says why frames are refused, without filling the log: the first of a second in words, the others by their number.
#[derive(Default)]
struct RefusalLog {
    due_nanos: u64,
    n_more: u64,
}

impl RefusalLog {
    fn refused(&mut self, refusal: &Refusal, now_nanos: u64) {
        if now_nanos < self.due_nanos {
            self.n_more += 1;
            return;
        }
        self.due_nanos = now_nanos + LOG_PAUSE_NANOS;
        print_diagnostic(&format!("refused, {}: {}", refusal.kind.word(), refusal.why));
    }

    fn flush(&mut self, now_nanos: u64) {
        if self.n_more > 0 && now_nanos >= self.due_nanos {
            print_diagnostic(&format!("refused: {} more", std::mem::take(&mut self.n_more)));
        }
    }
}
