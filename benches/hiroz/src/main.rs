//! Nodes of hiroz for `scripts/benchsuite ros2`.
//!
//! * `router tcp/127.0.0.1:PORT` - the router of the others.
//! * `echo ENDPOINT` - answers as blindgrasp would, without a look at the frame: the bare loop.
//! * `robot ENDPOINT FRAMES RATE_HZ SECS` - sends the frames of grasps and receives the decisions. FRAMES has a line of
//!   names of joints, then a frame a line (JSON). Prints the number of grasps and the time of each from its first settled frame
//!   to its decision.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::msg::{SerdeCdrSerdes, ZMessage};
use hiroz::qos::{QosDurability, QosHistory, QosProfile, QosReliability};
use hiroz::{BufferGroup, Builder, MessageTypeInfo, Result, TypeHash, WithTypeInfo};
use hiroz_msgs::builtin_interfaces::Time;
use hiroz_msgs::sensor_msgs::JointState;
use hiroz_msgs::std_msgs::{Float64MultiArray, Header, MultiArrayLayout, String as Text};
use serde::{Deserialize, Serialize};

/// `blindgrasp_msgs/msg/Decision`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Decision {
    stamp: Time,
    valid_until: Time,
    grasp_id: u64,
    action: u8,
    reason: String,
    probability_stable: f64,
}

/// Of the definition above, as rosbags computes it.
const DECISION_HASH: &str = "RIHS01_ee09b7459ecfa1dff2e058e5677af62831667101a87eed055c5b2ecfb91b3bf7";

impl MessageTypeInfo for Decision {
    fn type_name() -> &'static str {
        "blindgrasp_msgs::msg::dds_::Decision_"
    }

    fn type_hash() -> TypeHash {
        TypeHash::from_rihs_string(DECISION_HASH).expect("a hash")
    }
}

impl WithTypeInfo for Decision {}

impl ZMessage for Decision {
    type Serdes = SerdeCdrSerdes<Self>;
}

#[derive(Deserialize)]
struct Frame {
    joints: Vec<f64>,
    cells_newtons: Vec<f64>,
    phase: String,
}

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["router", endpoint] => {
            let _context = context("router", endpoint)?;
            println!("ready");
            loop {
                sleep(Duration::from_secs(60));
            }
        }
        ["echo", endpoint] => echo(&context("client", endpoint)?),
        ["robot", endpoint, frames, rate, secs] => {
            robot(&context("client", endpoint)?, frames, rate.parse()?, secs.parse()?)
        }
        _ => Err("usage: hiroz-peer router|echo|robot ENDPOINT [FRAMES RATE_HZ SECS]".into()),
    }
}

fn context(mode: &str, endpoint: &str) -> Result<ZContext> {
    let builder = ZContextBuilder::default()
        .with_zenoh_config(hiroz::config::session_config()?)
        .with_domain_id(0)
        .with_mode(mode)
        .disable_multicast_scouting();
    let builder = match mode {
        "router" => builder.with_listen_endpoints([endpoint]).with_connect_endpoints(Vec::<String>::new()),
        _ => builder
            .with_listen_endpoints(Vec::<String>::new())
            .with_connect_endpoints([endpoint])
            .with_json("connect/timeout_ms", 5000)
            .with_json("connect/exit_on_failure", true),
    };
    builder.build()
}

fn now() -> Time {
    let elapsed = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Time { sec: elapsed.as_secs() as i32, nanosec: elapsed.subsec_nanos() }
}

/// As the drivers of sensors have it.
fn sensor() -> QosProfile {
    let history = QosHistory::KeepLast(NonZeroUsize::new(256).expect("a depth"));
    QosProfile { reliability: QosReliability::BestEffort, history, ..QosProfile::default() }
}

/// As blindgrasp publishes decisions.
fn decisions() -> QosProfile {
    QosProfile {
        reliability: QosReliability::Reliable,
        durability: QosDurability::TransientLocal,
        history: QosHistory::KeepLast(NonZeroUsize::new(1).expect("a depth")),
        ..QosProfile::default()
    }
}

/// Decides at the first settled frame of each grasp.
fn echo(context: &ZContext) -> Result<()> {
    let node = context.create_node("echo").without_parameters().build()?;
    let publisher = node.create_pub::<Decision>("/decision").with_qos(decisions()).build()?;
    let is_settled = Arc::new(AtomicBool::new(false));
    let said = Arc::clone(&is_settled);
    let _joints = node
        .create_sub::<JointState>("/joint_states")
        .with_qos(sensor())
        .with_buffer_group(BufferGroup::Off)
        .build_with_callback(|_: JointState| {})?;
    let _phase = node
        .create_sub::<Text>("/phase")
        .with_qos(sensor())
        .with_buffer_group(BufferGroup::Off)
        .build_with_callback(move |phase: Text| said.store(phase.data == "settled", Ordering::SeqCst))?;
    let next_grasp = AtomicU64::new(0);
    let was_settled = AtomicBool::new(false);
    let _cells = node
        .create_sub::<Float64MultiArray>("/cells")
        .with_qos(sensor())
        .with_buffer_group(BufferGroup::Off)
        .build_with_callback(move |_: Float64MultiArray| {
            let settles = is_settled.load(Ordering::SeqCst);
            if settles && !was_settled.swap(settles, Ordering::SeqCst) {
                let grasp_id = next_grasp.fetch_add(1, Ordering::SeqCst);
                let decision = Decision { stamp: now(), valid_until: now(), grasp_id, ..Decision::default() };
                publisher.publish(&decision).expect("published");
            }
            was_settled.store(settles, Ordering::SeqCst);
        })?;
    println!("ready");
    loop {
        sleep(Duration::from_secs(60));
    }
}

fn robot(context: &ZContext, frames: &str, rate_hz: f64, secs: f64) -> Result<()> {
    let text = std::fs::read_to_string(frames)?;
    let mut lines = text.lines();
    let name: Vec<String> = serde_json::from_str(lines.next().unwrap_or_default())?;
    let frames: Vec<Frame> = lines.map(serde_json::from_str).collect::<std::result::Result<_, _>>()?;
    let node = context.create_node("robot").without_parameters().build()?;
    let received = Arc::new(Mutex::new(Vec::new()));
    let seen = Arc::clone(&received);
    let _decisions = node
        .create_sub::<Decision>("/decision")
        .with_qos(decisions())
        .with_buffer_group(BufferGroup::Off)
        .build_with_callback(move |decision: Decision| {
            seen.lock().expect("no panic").push((decision.grasp_id, Instant::now()));
        })?;
    let joints = node.create_pub::<JointState>("/joint_states").with_qos(sensor()).build()?;
    let phases = node.create_pub::<Text>("/phase").with_qos(sensor()).build()?;
    let cells = node.create_pub::<Float64MultiArray>("/cells").with_qos(sensor()).build()?;
    println!("ready");
    // The other side has to find these topics.
    sleep(Duration::from_secs(3));
    received.lock().expect("no panic").clear();
    let start = Instant::now();
    let mut settled = Vec::new();
    let mut n_late = 0_u32;
    let mut was_settled = false;
    for (idx, frame) in frames.iter().cycle().enumerate() {
        // A grasp is sent whole.
        if frame.phase == "open" && was_settled && start.elapsed().as_secs_f64() >= secs {
            break;
        }
        match Duration::from_secs_f64(idx as f64 / rate_hz).checked_sub(start.elapsed()) {
            Some(rest) => sleep(rest),
            None => n_late += 1,
        }
        let header = Header { stamp: now(), frame_id: "hand".into() };
        let (position, none) = (frame.joints.clone(), Vec::new());
        joints.publish(&JointState { header, name: name.clone(), position, velocity: none.clone(), effort: none })?;
        phases.publish(&Text { data: frame.phase.clone() })?;
        let layout = MultiArrayLayout { dim: Vec::new(), data_offset: 0 };
        let settles = frame.phase == "settled";
        if settles && !was_settled {
            settled.push(Instant::now());
        }
        was_settled = settles;
        cells.publish(&Float64MultiArray { layout, data: frame.cells_newtons.clone() })?;
    }
    sleep(Duration::from_secs(2));
    let received = received.lock().expect("no panic").clone();
    // The first one may count from another number.
    let first = received.first().map_or(0, |(grasp_id, _)| *grasp_id);
    let by_grasp: BTreeMap<u64, Instant> = received.iter().map(|(grasp_id, at)| (grasp_id - first, *at)).collect();
    let micros: Vec<f64> = settled
        .iter()
        .enumerate()
        .filter_map(|(grasp, sent)| {
            let at = by_grasp.get(&(grasp as u64))?;
            Some(at.saturating_duration_since(*sent).as_secs_f64() * 1e6)
        })
        .collect();
    println!(
        "{}",
        serde_json::json!({"grasps": settled.len(), "decisions": received.len(), "late_sends": n_late, "micros": micros})
    );
    Ok(())
}
