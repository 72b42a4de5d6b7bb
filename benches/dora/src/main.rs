//! The chain of `benches/programs/bare_chain.rs` as a dataflow of dora 1.1.0: samples of the same sizes in the same
//! rhythm, and nothing is computed.
//!
//! `dora-peer RATE_HZ SECS [backpressure|drop_oldest]` runs dora's daemon in this process, as `dora run` does. The
//! daemon starts six nodes: source, contacts, encoder, classifier, arbiter and arm. The arm stands for the launcher
//! that reads the bare chain's decisions. The source sends a grasp's 14 frames at RATE_HZ, then it pauses for ten
//! frames' time.
//!
//! The program prints JSON. `latency_nanos` is the time from the source's send of a grasp's last frame to the arm's
//! receipt of the decision: five hops, as in the bare chain's `decision_latency_nanos`. `lost` counts frames that did
//! not reach the arbiter. `cpu_secs` is the processor time of the daemon and all nodes, their start included.
//!
//! The third argument is dora's policy for full queues. With `backpressure`, the default here, dora 1.1.0 relays each
//! sample through the daemon. With `drop_oldest`, dora's own default, the nodes send directly to each other with Zenoh.
//! An output whose route is not proven half a second after the start is relayed all the same; `relayed_outputs` counts
//! the outputs that are relayed, of five. All samples are smaller than the 4096 bytes from which dora uses shared
//! memory.

use std::fs;
use std::path::Path;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use blindgrasp_messages::{ContactSet, GraspFeature, LiftDecision, Message, Prediction, TactileFrame};
use dora_daemon::{Daemon, LogDestination, flume};
use dora_message::SessionId;
use dora_message::common::{LogLevel, LogLevelOrStdout, LogMessage};
use dora_node_api::dora_core::config::DataId;
use dora_node_api::{DoraNode, Event, MetadataParameters};
use eyre::{WrapErr, bail, ensure};
use nix::sys::resource::{UsageWho, getrusage};
use nix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};
use tracing_subscriber::filter::LevelFilter;

/// The nodes, in the order of the chain.
const NODES: [&str; 6] = ["source", "contacts", "encoder", "classifier", "arbiter", "arm"];
/// These five have the values of the bare chain.
const N_JOINTS: usize = 7;
const N_CELLS: usize = 96;
const N_CONTACTS: usize = 4;
const N_FEATURES: usize = 70;
const N_GRASP_FRAMES: u64 = 14;
/// The distance to the next grasp's frames, in frames.
const N_PAUSE_FRAMES: u64 = 10;
/// Samples that an input keeps. With `backpressure`, dora keeps ten times as many.
const QUEUE_SIZE: usize = 1000;
/// The last samples have this long to arrive before the source ends and its output closes.
const SETTLE: Duration = Duration::from_millis(500);
/// The daemon's threads have this long to end.
const PATIENCE: Duration = Duration::from_secs(10);
/// A part of dora's warning that an output is relayed although it could be sent directly.
const RELAYED: &str = "output stays on the reliable daemon path";

fn main() -> eyre::Result<()> {
    tracing_subscriber::fmt().with_max_level(LevelFilter::WARN).with_ansi(false).with_writer(std::io::stderr).init();
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["node", node, rate_hz, n_grasps] => be_node(node, rate_hz.parse()?, n_grasps.parse()?),
        [rate_hz, secs] => run(rate_hz.parse()?, secs.parse()?, "backpressure"),
        [rate_hz, secs, policy @ ("backpressure" | "drop_oldest")] => run(rate_hz.parse()?, secs.parse()?, policy),
        _ => bail!("expected RATE_HZ SECS [backpressure|drop_oldest]"),
    }
}

/// Runs the dataflow to its end and prints the measured times.
fn run(rate_hz: f64, secs: f64, policy: &str) -> eyre::Result<()> {
    ensure!((10.0..=1e6).contains(&rate_hz), "expected RATE_HZ from 10 to 1000000, found {rate_hz}");
    ensure!(secs > 0.0 && secs <= 1e5, "expected SECS above 0, at most 100000, found {secs}");
    let grasp_secs = (N_GRASP_FRAMES - 1 + N_PAUSE_FRAMES) as f64 / rate_hz;
    let n_grasps = (secs / grasp_secs).ceil() as u64;
    // The nodes run in this folder, and leave their reports there.
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("dataflow.yaml");
    fs::write(&path, dataflow(rate_hz, n_grasps, policy)?.to_string())?;

    let (log, lines) = flume::unbounded::<LogMessage>();
    let (counted, count) = mpsc::channel();
    thread::spawn(move || counted.send(print_warnings(lines)));
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let outcome = runtime.block_on(Daemon::run_dataflow(
        &path,
        None,
        None,
        SessionId::generate(),
        false,
        LogDestination::Channel { sender: log },
        None,
        None,
        false,
        None,
        None,
    ));
    runtime.shutdown_timeout(PATIENCE);
    // The count comes when the daemon has closed its log.
    let n_relayed = count.recv_timeout(PATIENCE).wrap_err("dora's daemon did not end")?;
    for (node, end) in outcome?.node_results {
        if let Err(error) = end {
            bail!("node {node}: {error}");
        }
    }

    let n_frames = n_grasps * N_GRASP_FRAMES;
    let n_received = report_of(folder.path(), "arbiter")?["received"].as_u64().unwrap_or(0);
    let arm = report_of(folder.path(), "arm")?;
    let summary = json!({
        "samples": n_frames,
        "lost": n_frames.saturating_sub(n_received),
        "decisions": arm["decisions"],
        "latency_nanos": arm["latency_nanos"],
        "cpu_secs": cpu_secs()?,
        "relayed_outputs": if policy == "backpressure" { NODES.len() - 1 } else { n_relayed },
    });
    println!("{summary}");
    Ok(())
}

/// The dataflow file; JSON is YAML.
fn dataflow(rate_hz: f64, n_grasps: u64, policy: &str) -> eyre::Result<Value> {
    let program = std::env::current_exe()?;
    let mut nodes = Vec::new();
    for (idx, id) in NODES.iter().enumerate() {
        let mut node = json!({"id": id, "path": program, "args": format!("node {id} {rate_hz} {n_grasps}")});
        if idx > 0 {
            let source = format!("{}/out", NODES[idx - 1]);
            node["inputs"] = json!({"in": {"source": source, "queue_size": QUEUE_SIZE, "queue_policy": policy}});
        }
        if idx < NODES.len() - 1 {
            node["outputs"] = json!(["out"]);
        }
        nodes.push(node);
    }
    Ok(json!({"nodes": nodes}))
}

/// Prints what the daemon warns of and what the nodes print, and counts the outputs that are relayed unexpectedly.
fn print_warnings(lines: flume::Receiver<LogMessage>) -> usize {
    let mut n_relayed = 0;
    for line in lines {
        if matches!(line.level, LogLevelOrStdout::LogLevel(level) if level > LogLevel::Warn) {
            continue;
        }
        let node = line.node_id.map_or("daemon".to_string(), |id| id.to_string());
        eprintln!("{node}: {}", line.message);
        if line.message.contains(RELAYED) {
            n_relayed += 1;
        }
    }
    n_relayed
}

/// Processor time of this process and of its children that have ended.
fn cpu_secs() -> eyre::Result<f64> {
    let mut secs = 0.0;
    for who in [UsageWho::RUSAGE_SELF, UsageWho::RUSAGE_CHILDREN] {
        let usage = getrusage(who)?;
        for time in [usage.user_time(), usage.system_time()] {
            secs += time.tv_sec() as f64 + time.tv_usec() as f64 / 1e6;
        }
    }
    Ok(secs)
}

fn be_node(node: &str, rate_hz: f64, n_grasps: u64) -> eyre::Result<()> {
    match node {
        "source" => source(rate_hz, n_grasps),
        "contacts" => stage(Output::of::<ContactSet>(N_CONTACTS)),
        "encoder" => stage(Output::of::<GraspFeature>(N_FEATURES)),
        "classifier" => stage(Output::of::<Prediction>(0)),
        "arbiter" => arbiter(),
        "arm" => arm(),
        _ => bail!("there is no node {node}: expected one of {NODES:?}"),
    }
}

fn source(rate_hz: f64, n_grasps: u64) -> eyre::Result<()> {
    let (mut node, mut events) = DoraNode::init_from_env_force()?;
    let mut frames = Output::of::<TactileFrame>(N_JOINTS + N_CELLS);
    let mut due = Instant::now();
    for seq in 0..n_grasps * N_GRASP_FRAMES {
        // It has no input whose end would stop it on Ctrl-C.
        if seq % N_GRASP_FRAMES == 0 && matches!(events.try_recv(), Ok(Event::Stop(_))) {
            bail!("stopped after {seq} frames");
        }
        thread::sleep(due.saturating_duration_since(Instant::now()));
        frames.send(&mut node, Stamp { seq, origin_nanos: monotonic_nanos()? })?;
        let n_periods = if is_last_of_grasp(seq) { N_PAUSE_FRAMES } else { 1 };
        due += Duration::from_secs_f64(n_periods as f64 / rate_hz);
    }
    thread::sleep(SETTLE);
    Ok(())
}

fn stage(mut output: Output) -> eyre::Result<()> {
    receive(|node, stamp| output.send(node, stamp))
}

/// Decides at the last frame of each grasp, as in the bare chain.
fn arbiter() -> eyre::Result<()> {
    let mut decisions = Output::of::<LiftDecision>(0);
    let mut n_received = 0_u64;
    receive(|node, stamp| {
        n_received += 1;
        if is_last_of_grasp(stamp.seq) {
            decisions.send(node, stamp)?;
        }
        Ok(())
    })?;
    report("arbiter", &json!({"received": n_received}))
}

fn arm() -> eyre::Result<()> {
    let mut latencies_nanos = Vec::new();
    receive(|_, stamp| {
        latencies_nanos.push(monotonic_nanos()?.saturating_sub(stamp.origin_nanos));
        Ok(())
    })?;
    latencies_nanos.sort_unstable();
    let last_idx = latencies_nanos.len().saturating_sub(1) as f64;
    let quantile = |share: f64| latencies_nanos.get((last_idx * share).round() as usize);
    let quantiles = json!({"p50": quantile(0.5), "p90": quantile(0.9), "p99": quantile(0.99)});
    report("arm", &json!({"decisions": latencies_nanos.len(), "latency_nanos": quantiles}))
}

/// Hands each sample's stamp on until the input closes.
fn receive(mut take: impl FnMut(&mut DoraNode, Stamp) -> eyre::Result<()>) -> eyre::Result<()> {
    let (mut node, mut events) = DoraNode::init_from_env_force()?;
    while let Some(event) = events.recv() {
        match event {
            Event::Input { data, .. } => take(&mut node, Stamp::of(<&[u8]>::try_from(&data)?)?)?,
            Event::Error(error) => bail!("dora: {error}"),
            _ => {}
        }
    }
    Ok(())
}

fn is_last_of_grasp(seq: u64) -> bool {
    seq % N_GRASP_FRAMES == N_GRASP_FRAMES - 1
}

fn monotonic_nanos() -> eyre::Result<u64> {
    let now = clock_gettime(ClockId::CLOCK_MONOTONIC)?;
    Ok(now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64)
}

fn report(node: &str, report: &Value) -> eyre::Result<()> {
    fs::write(format!("{node}.json"), report.to_string()).wrap_err("the report cannot be written")
}

fn report_of(folder: &Path, node: &str) -> eyre::Result<Value> {
    let text = fs::read_to_string(folder.join(format!("{node}.json")));
    let text = text.wrap_err_with(|| format!("node {node} has left no report"))?;
    Ok(serde_json::from_str(&text)?)
}

/// The first bytes of each sample.
#[derive(Clone, Copy)]
struct Stamp {
    seq: u64,
    /// When the source sent the frame (CLOCK_MONOTONIC).
    origin_nanos: u64,
}

impl Stamp {
    fn of(sample: &[u8]) -> eyre::Result<Self> {
        let number = |start: usize| Some(u64::from_ne_bytes(*sample.get(start..)?.first_chunk()?));
        let (Some(seq), Some(origin_nanos)) = (number(0), number(8)) else {
            bail!("a sample has {} bytes, expected at least 16", sample.len());
        };
        Ok(Stamp { seq, origin_nanos })
    }
}

/// A node's output, and the bytes that it sends over and over with another stamp.
struct Output {
    id: DataId,
    sample: Vec<u8>,
}

impl Output {
    /// Its samples are as large as blindgrasp's head and items in shared memory.
    fn of<M: Message>(n_items: usize) -> Self {
        let n_bytes = size_of::<M::Head>() + n_items * size_of::<M::Item>();
        Output { id: DataId::from("out"), sample: vec![0; n_bytes] }
    }

    fn send(&mut self, node: &mut DoraNode, stamp: Stamp) -> eyre::Result<()> {
        self.sample[..8].copy_from_slice(&stamp.seq.to_ne_bytes());
        self.sample[8..16].copy_from_slice(&stamp.origin_nanos.to_ne_bytes());
        let sample = &self.sample;
        node.send_output_raw(self.id.clone(), MetadataParameters::default(), sample.len(), |room| {
            room.copy_from_slice(sample);
        })?;
        Ok(())
    }
}
