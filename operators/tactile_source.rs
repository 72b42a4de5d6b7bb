//! The hardware's side of the graph: live tactile frames from a bridge over a socket, or from a serial device.
//!
//! A frame that is malformed, late or out of order is counted and refused. It leaves a gap in the numbers, so that the
//! arbiter holds the grasp it belonged to. The source finds a lost sender again by itself. A source that is started again
//! after a crash, or swapped in, goes on with the numbers and grasps of the one before, after a gap.
//!
//! The driver zenoh is that of the network's program, which runs the same source with it.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, anyhow, bail};
use blindgrasp_messages::{GraspTruth, Header, MAX_CELLS, MAX_JOINTS, MAX_NAME_BYTES, Recorded, TactileFrame};
use blindgrasp_operator::control_socket;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::operator::{Operator, TICK, parse_params};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::port::Publisher;
use blindgrasp_operator::source::{self, Source, Step, send};
use blindgrasp_operator::stage::{decode_state, encode_state};
use blindgrasp_operator::waiter::PollFd;
use blindgrasp_stages::day::MAX_DAY;
use blindgrasp_stages::hand::Hand;
use blindgrasp_tactile::cell_zeros::{CellZeros, Zeroed};
use blindgrasp_tactile::gate::{Accepted, Counts, FrameFilter, Shape};
use blindgrasp_tactile::stream::{Link, Stream};
use blindgrasp_tactile::{Arrival, Event, ExpectedHand, Place, Reading, Refusal, RefusalKind, TactileDriver};
use serde::Deserialize;
use serde_json::{Map, Value};

use crate::beginning::FileNode;
use crate::connection::with_connection_params;
use crate::houses::NETWORK_PROGRAM;

const DRIVERS: [&str; 4] = ["listen", "connect", "serial", "zenoh"];
const DEFAULT_BAUD: u32 = 115_200;
/// The parameters that the source has with each driver.
const COMMON_PARAMS: [&str; 5] = ["driver", "hand", "max_delay_ms", "day", "zero_when_open"];
/// Half of the age that the arbiter allows by default, which counts from the source on.
const DEFAULT_MAX_DELAY_MS: f64 = 100.0;
/// The shortest pause between two reports of counts.
const COUNTS_PAUSE_NANOS: u64 = 250_000_000;
/// The shortest pause between two refusals that are logged.
const LOG_PAUSE_NANOS: u64 = 1_000_000_000;

#[derive(Deserialize)]
struct Params {
    driver: String,
    hand: PathBuf,
    max_delay_ms: f64,
    day: Option<u32>,
    zero_when_open: bool,
}

/// The parameters of the robot's drivers.
#[derive(Deserialize)]
struct RobotParams {
    address: Option<String>,
    device: Option<PathBuf>,
    baud: Option<u32>,
    idle_limit_ms: Option<f64>,
}

/// A driver to be made.
pub struct AskedDriver<'a> {
    /// The param `driver`.
    pub name: &'a str,
    /// All params of the node.
    pub params: &'a Map<String, Value>,
    pub hand: &'a Hand,
    /// The graph's name; its place is held by a word where a node is only checked.
    pub graph: &'a str,
    pub has_sandbox: bool,
}

/// Makes a driver, which is not open yet, or tells the mistake in the params.
pub type MakeDriver = fn(&AskedDriver<'_>) -> anyhow::Result<Box<dyn TactileDriver>>;

fn millis(min: f64) -> ParamKind {
    ParamKind::Number { above: None, min: Some(min), max: Some(3.6e6), words: vec![] }
}

fn file(must_exist: bool) -> ParamKind {
    ParamKind::Path { must_exist }
}

pub fn describe() -> OperatorDescription {
    let drivers = DRIVERS.map(String::from).to_vec();
    let description = OperatorDescription::new("tactile_source", "Publishes a hand's live tactile frames")
        .uses_network()
        .output("truth", GraspTruth::TYPE_NAME, "How each lift ended whose object the bridge names")
        .output(
            "tactile",
            TactileFrame::TYPE_NAME,
            "The frames, in order; a frame that was refused or missed leaves a gap in the numbers",
        )
        .param("driver", ParamKind::Choice { values: drivers }, Some("listen".into()), "Where the frames come from")
        .param("hand", file(true), None, "The hand's pad layout (YAML)")
        .optional_param(
            "address",
            ParamKind::String {},
            "HOST:PORT, or unix:PATH for programs of this user; listen: unix:/tmp/blindgrasp-UID/GRAPH.hand by default",
        )
        .optional_param("device", file(false), "serial: the device")
        .optional_param(
            "baud",
            ParamKind::Integer { min: Some(50), max: Some(20_000_000) },
            "serial: bits per second, 115200 by default",
        )
        .live_param(
            "max_delay_ms",
            millis(1.0),
            Some(DEFAULT_MAX_DELAY_MS.into()),
            "A frame whose delay exceeds the shortest one by more than this is late, and dropped",
        )
        .optional_param("idle_limit_ms", millis(1.0), "A bridge that is silent for longer is disconnected")
        .optional_param(
            "day",
            ParamKind::Integer { min: Some(1), max: Some(MAX_DAY.into()) },
            "Number of the recording day, of which all grasps have one baseline; the date (UTC) of the start by default, like \
             20261124",
        )
        .param(
            "zero_when_open",
            ParamKind::Boolean {},
            Some(false.into()),
            "Whether the mean reading of each cell while the hand is open is its zero, for sensors whose readings drift",
        )
        .optional_param("key", ParamKind::String {}, "zenoh: the key expression of the frames, like hand/frames");
    with_connection_params(description)
}

pub(crate) fn work(operator: &Operator) -> anyhow::Result<()> {
    work_with(operator, robot_driver)
}

/// The mistakes with which [`work`] would fail at once, but for devices and sockets, which it opens.
pub(crate) fn check(node: &FileNode) -> anyhow::Result<()> {
    check_with(node, robot_driver)
}

/// Publishes the frames of a driver until it ends.
///
/// # Errors
/// The params are of no use, or the driver or an edge fails.
pub fn work_with(operator: &Operator, make_driver: MakeDriver) -> anyhow::Result<()> {
    let params = operator.params()?;
    let SourceParts { params, hand, driver, zeros } =
        setup(&params, operator.graph(), operator.has_sandbox(), make_driver)?;
    let (n_joints, n_cells) = (hand.joints.len(), hand.n_cells());
    operator.reserve_state()?;
    let shape = Shape { n_joints, n_cells };
    let wall_offset_nanos = wall_nanos().saturating_sub(monotonic_nanos());
    let mut source = TactileSource {
        operator,
        tactile: operator.publisher("tactile", TactileFrame::max_items(n_joints, n_cells))?,
        truths: operator.publisher("truth", 2 * MAX_NAME_BYTES)?,
        driver,
        hand_id: hand.id(),
        gate: FrameFilter::new(shape, params.max_delay_nanos(), wall_offset_nanos, Place::default(), None)
            .with_allowed(zeros.allowed()),
        epoch: 0,
        day: params.day.unwrap_or_else(today),
        zeros,
        of_zeros: ZeroCounts::default(),
        poll_pause: params.poll_pause(),
        reported: Default::default(),
        report_due_nanos: 0,
        log: RefusalLog::default(),
    };
    if !operator.begins_as_standby() {
        source.begin()?;
        source.driver.open(monotonic_nanos())?;
    }
    source::run(operator, BTreeMap::from([("hand".into(), format!("{:016x}", hand.id()))]), source)
}

/// The mistakes with which [`work_with`] would fail at once.
///
/// # Errors
/// See above.
pub fn check_with(node: &FileNode, make_driver: MakeDriver) -> anyhow::Result<()> {
    setup(&node.params, "GRAPH", node.has_sandbox, make_driver).map(drop)
}

/// The hand, its driver, which is not open yet, and the zeros of its cells.
struct SourceParts {
    params: Params,
    hand: Hand,
    driver: Box<dyn TactileDriver>,
    zeros: CellZeros,
}

fn setup(
    node_params: &Map<String, Value>,
    graph: &str,
    has_sandbox: bool,
    make_driver: MakeDriver,
) -> anyhow::Result<SourceParts> {
    let params: Params = parse_params(node_params)?;
    let hand = Hand::load(&params.hand)?;
    let (n_joints, n_cells) = (hand.joints.len(), hand.n_cells());
    if n_joints > MAX_JOINTS || n_cells > MAX_CELLS {
        bail!("hand {}: {n_joints} joints and {n_cells} cells, at most {MAX_JOINTS} and {MAX_CELLS}", hand.name);
    }
    refuse_unused(&params.driver, node_params)?;
    let driver =
        make_driver(&AskedDriver { name: &params.driver, params: node_params, hand: &hand, graph, has_sandbox })?;
    let zeros =
        CellZeros::new(&hand, params.zero_when_open).map_err(|reason| anyhow!("hand {}: {reason}", hand.name))?;
    Ok(SourceParts { params, hand, driver, zeros })
}

/// Refuses a parameter that the driver does not use: it is a mistake.
fn refuse_unused(driver: &str, params: &Map<String, Value>) -> anyhow::Result<()> {
    let needs = params_of(driver);
    for name in params.keys() {
        if !COMMON_PARAMS.contains(&name.as_str()) && !needs.contains(name) {
            bail!("param '{name}' is of no use to driver {driver}, which takes {}: leave it out", needs.join(", "));
        }
    }
    Ok(())
}

/// The names of the params that a driver has beside [`COMMON_PARAMS`].
fn params_of(driver: &str) -> Vec<String> {
    let connection = OperatorDescription::new("", "");
    let connection = match driver {
        "listen" | "connect" => return vec!["address".into(), "idle_limit_ms".into()],
        "serial" => return vec!["device".into(), "baud".into(), "idle_limit_ms".into()],
        "zenoh" => with_connection_params(connection),
        _ => connection,
    };
    let prefix = format!("{driver}:");
    let own = describe().params.into_iter().filter(|param| param.summary.starts_with(&prefix));
    connection.params.into_iter().chain(own).map(|param| param.name).collect()
}

/// A driver for the line protocol.
///
/// # Errors
/// A param is missing or of no use.
pub fn robot_driver(asked: &AskedDriver<'_>) -> anyhow::Result<Box<dyn TactileDriver>> {
    let params: RobotParams = parse_params(asked.params)?;
    let name = asked.name;
    let lacks = |param: &str, example: &str| format!("driver {name} needs the param '{param}', like {example}");
    let link = match name {
        "listen" => Link::Listen {
            address: match params.address {
                Some(address) => address,
                None => format!("unix:{}", control_socket::tactile_path(asked.graph)?.display()),
            },
        },
        "connect" => Link::Connect { address: params.address.with_context(|| lacks("address", "robot.local:7400"))? },
        "serial" => Link::Serial {
            device: params.device.with_context(|| lacks("device", "/dev/ttyACM0"))?,
            baud: params.baud.unwrap_or(DEFAULT_BAUD),
        },
        _ => bail!("the driver {name} is in {NETWORK_PROGRAM}, not in this program"),
    };
    if let Link::Listen { address } | Link::Connect { address } = &link
        && address.starts_with("unix:")
        && asked.has_sandbox
    {
        bail!("a sandbox has no unix sockets, and the address is {address}: write `sandbox: off`, or HOST:PORT");
    }
    let idle_limit_nanos = params.idle_limit_ms.map(|millis| (millis * 1e6) as u64);
    Ok(Box::new(Stream::new(link, ExpectedHand::of(asked.hand), idle_limit_nanos)))
}

impl Params {
    fn max_delay_nanos(&self) -> u64 {
        (self.max_delay_ms * 1e6) as u64
    }

    /// The longest pause between two looks at the driver: half of the time by which a frame may be late, so that a source
    /// that stood still for that time notices.
    fn poll_pause(&self) -> Duration {
        Duration::from_nanos(self.max_delay_nanos() / 2).min(TICK)
    }
}

/// The date as a number: 20261124.
fn today() -> u32 {
    let date = time::OffsetDateTime::now_utc().date();
    10_000 * date.year().unsigned_abs() + 100 * u32::from(u8::from(date.month())) + u32::from(date.day())
}

fn wall_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}

/// Accepted frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct ZeroCounts {
    /// Not sent, because a zero was not known.
    unzeroed: u64,
    below_zero: u64,
    missing_cells: u64,
}

struct TactileSource<'a> {
    operator: &'a Operator,
    tactile: Publisher<TactileFrame>,
    truths: Publisher<GraspTruth>,
    driver: Box<dyn TactileDriver>,
    hand_id: u64,
    gate: FrameFilter,
    epoch: u64,
    /// For frames that do not say it.
    day: u32,
    /// The zero of each cell, if the open hand gives it.
    zeros: CellZeros,
    of_zeros: ZeroCounts,
    poll_pause: Duration,
    reported: (Counts, ZeroCounts),
    report_due_nanos: u64,
    log: RefusalLog,
}

impl Source for TactileSource<'_> {
    fn step(&mut self) -> anyhow::Result<Step> {
        let Some(event) = self.driver.poll(monotonic_nanos(), self.gate.place())? else {
            let due_nanos = self.driver.due_nanos().unwrap_or(u64::MAX);
            let left = Duration::from_nanos(due_nanos.saturating_sub(monotonic_nanos()));
            return Ok(Step::Wait(Some(Instant::now() + left.min(self.poll_pause))));
        };
        match event {
            Event::Began => self.gate.began(),
            Event::TurnedAway => self.gate.turned_away(),
            Event::Frame(reading, arrival) => self.pass(reading, &arrival)?,
            Event::Refused(refusal) => {
                self.gate.refused(refusal.kind);
                self.refuse(&refusal);
            }
        }
        Ok(Step::Next)
    }

    fn look(&mut self) -> anyhow::Result<()> {
        self.tactile.look_for_readers()?;
        self.truths.look_for_readers()?;
        let now_nanos = monotonic_nanos();
        self.log.flush(now_nanos);
        if now_nanos >= self.report_due_nanos && self.counts() != self.reported {
            self.report_due_nanos = now_nanos + COUNTS_PAUSE_NANOS;
            self.report_counts();
        }
        Ok(())
    }

    fn watch<'a>(&'a self, fds: &mut Vec<PollFd<'a>>) {
        self.driver.watch(fds);
    }

    fn take_over(&mut self) -> anyhow::Result<()> {
        self.begin()?;
        // A driver that fails here tries again: the instance before it may still be letting go.
        if let Err(error) = self.driver.open(monotonic_nanos()) {
            print_diagnostic(&error.to_string());
        }
        Ok(())
    }

    fn close(&mut self) {
        self.driver.close();
        self.report_counts();
    }

    fn set(&mut self, params: &Map<String, Value>) -> anyhow::Result<()> {
        let params: Params = parse_params(params)?;
        self.gate.set_max_delay_nanos(params.max_delay_nanos());
        self.poll_pause = params.poll_pause();
        Ok(())
    }

    fn next_seq(&self) -> Option<u64> {
        self.tactile.last().map(|last| last.seq + 1)
    }
}

impl TactileSource<'_> {
    /// Goes on where the node's instance before left off, if there was one.
    fn begin(&mut self) -> anyhow::Result<()> {
        let last = self.tactile.last();
        // The first source of a graph begins its numbers.
        self.epoch = last.map_or_else(wall_nanos, |last| last.epoch);
        let place = match self.operator.saved_state() {
            Some(bytes) => decode_state("tactile_source", &bytes)?,
            None => Place::default(),
        };
        self.gate.resume(place, last.map(|last| last.seq));
        Ok(())
    }

    fn pass(&mut self, reading: Reading, arrival: &Arrival) -> anyhow::Result<()> {
        let taken = self.gate.take(&reading, arrival);
        if let Some((earlier, accepted)) = self.gate.released() {
            self.send(earlier, accepted)?;
        }
        match taken {
            Ok(Some(accepted)) => self.send(reading, accepted)?,
            Ok(None) => {}
            Err(refusal) => self.refuse(&refusal),
        }
        Ok(())
    }

    fn send(&mut self, mut reading: Reading, accepted: Accepted) -> anyhow::Result<()> {
        // Saved first: an instance that takes over must not use the number of a grasp again.
        let mut state = Vec::new();
        encode_state("tactile_source", self.gate.place(), &mut state)?;
        self.operator.save_state(&state)?;
        match self.zeros.apply(&mut reading) {
            Ok(Zeroed { is_below_zero, has_missing }) => {
                self.of_zeros.below_zero += u64::from(is_below_zero);
                self.of_zeros.missing_cells += u64::from(has_missing);
            }
            Err(why) => {
                // The gap in the numbers holds its grasp.
                self.of_zeros.unzeroed += 1;
                self.refuse(&Refusal { kind: RefusalKind::OutOfOrder, why });
                return Ok(());
            }
        }
        let (epoch, hand_id) = (self.epoch, self.hand_id);
        let header =
            Header { seq: accepted.seq, stamp_nanos: accepted.stamp_nanos, epoch, hand_id, ..Header::default() };
        if let Some(truth) = reading.truth(accepted.grasp_id) {
            let seq = self.truths.last().map_or(0, |last| last.seq + 1);
            let _ = send(self.operator, &mut self.truths, &truth, Header { seq, ..header })?;
        }
        let frame = TactileFrame {
            grasp_id: accepted.grasp_id,
            phase: reading.phase,
            joints: reading.joints,
            cells_newtons: reading.cells_newtons,
            senses: reading.senses,
            day: reading.day.unwrap_or(self.day),
        };
        // A frame that was not sent, because this instance gives way, is a gap before the next one.
        let _ = send(self.operator, &mut self.tactile, &frame, header)?;
        Ok(())
    }

    fn refuse(&mut self, refusal: &Refusal) {
        let now_nanos = monotonic_nanos();
        self.driver.refused(refusal, now_nanos);
        self.log.refused(refusal, now_nanos);
    }

    fn counts(&self) -> (Counts, ZeroCounts) {
        (*self.gate.counts(), self.of_zeros)
    }

    fn report_counts(&mut self) {
        self.reported = self.counts();
        let mut counts = self.reported.0.by_name();
        counts.insert("unzeroed".into(), self.of_zeros.unzeroed);
        counts.insert("below_zero".into(), self.of_zeros.below_zero);
        counts.insert("missing_cells".into(), self.of_zeros.missing_cells);
        self.operator.has_counted(counts);
    }
}

/// Logs why frames are refused without filling the log: the first refusal of a second in words, the others as a number.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// The summaries tell the params of the driver zenoh from others.
    #[test]
    fn each_param_is_of_a_driver_or_of_all() {
        let of_drivers = DRIVERS.map(params_of).concat();
        for param in describe().params {
            assert!(COMMON_PARAMS.contains(&param.name.as_str()) || of_drivers.contains(&param.name), "{}", param.name);
        }
        assert!(params_of("zenoh").contains(&"key".into()) && !params_of("serial").contains(&"key".into()));
        let refused = refuse_unused("listen", &Map::from_iter([("keys".into(), "/k".into())]));
        let message = "param 'keys' is of no use to driver listen, which takes address, idle_limit_ms: leave it out";
        assert_eq!(refused.expect_err("refused").to_string(), message);
    }
}
