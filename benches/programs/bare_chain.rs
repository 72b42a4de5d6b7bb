//! What the transport alone costs: five processes that pass samples along as bare iceoryx2 code does, for
//! `scripts/benchsuite runtime`, which runs the graph beside it.
//!
//! `bare_chain --rate HZ --secs S [--json]` starts itself as source, three stages and sink. The samples have the types
//! and sizes of the graph's, and a simulated recording's rhythm: 14 frames at `--rate`, then a pause of ten frames' time.
//! `bare_chain --rate max --grasps N` sends as fast as the chain takes it, for `scripts/benchsuite recording`.
//! Nothing is computed. As in the graph, the launcher reads one decision per grasp.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use blindgrasp_messages::{
    Contact, ContactSet, ContactSetHead, GraspFeature, GraspFeatureHead, Header, LiftDecision, LiftDecisionHead,
    Message, Prediction, PredictionHead, TactileFrame, TactileFrameHead,
};
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_operator::namespace::{self, Namespace};
use blindgrasp_operator::private_service::PrivateService;
use blindgrasp_operator::wiring::NamespaceWiring;
use clap::Parser;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{listener::Listener, notifier::Notifier, publisher, subscriber};
use iceoryx2::prelude::{Node, PortFactory as _, ServiceName, ZeroCopySend};
use iceoryx2::service::port_factory::publish_subscribe;
use rustix::process::{Signal, set_parent_process_death_signal};
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};

/// The source, three stages, the sink.
const N_PROCESSES: u64 = 5;
/// The Barrett hand's joints and cells.
const N_JOINTS: usize = 7;
const N_CELLS: usize = 96;
/// The deciding frames of `recordings/held-out.mcap` have 3.8 on average.
const N_CONTACTS: usize = 4;
/// Of `models/barrett-bh8-280.json`.
const N_FEATURES: usize = 70;
/// A simulated grasp's frames, and the distance to the next grasp's in frames.
const N_GRASP_FRAMES: u64 = 14;
const N_PAUSE_FRAMES: u64 = 10;
/// As in the graph.
const CAPACITY: usize = 64;
/// The longest nap of the graph's source.
const NAP: Duration = Duration::from_millis(20);
const READY_POLL: Duration = Duration::from_millis(1);
/// As in the graph. A listener of iceoryx2 0.10 must not wait without limit. When a notification comes just as it takes in
/// the one before, it can be left waiting, and all further notifications then count as sent already.
const WAIT: Duration = Duration::from_millis(20);
/// Without a decision for so long, something is broken.
const SILENCE: Duration = Duration::from_secs(10);

/// Passes samples along a chain of five processes.
#[derive(Parser)]
struct Arguments {
    /// Frames per second within a grasp, at least 10; or max, with --grasps.
    #[arg(long, value_parser = rate)]
    rate: f64,
    /// How long the source sends.
    #[arg(long, default_value_t = 1.0)]
    secs: f64,
    /// How many grasps it sends, instead of --secs.
    #[arg(long)]
    grasps: Option<u64>,
    /// Print JSON: a line at the first decision, and a last one with "summary".
    #[arg(long)]
    json: bool,
    /// Which process of the chain to be, and where it runs.
    #[arg(long, hide = true, num_args = 2)]
    process: Option<Vec<String>>,
}

/// Frames per second; infinitely many for `max`.
fn rate(text: &str) -> Result<f64, String> {
    match text {
        "max" | "inf" => Ok(f64::INFINITY),
        _ => {
            text.parse().ok().filter(|rate| (10.0..=1e6).contains(rate)).ok_or("expected 10 to 1000000, or max".into())
        }
    }
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    if !(arguments.secs > 0.0 && arguments.secs <= 1e5) || (arguments.rate.is_infinite() && arguments.grasps.is_none())
    {
        bail!("expected --secs above 0, at most 100000, and --grasps with --rate max");
    }
    let grasp_secs = (N_GRASP_FRAMES - 1 + N_PAUSE_FRAMES) as f64 / arguments.rate;
    let n_grasps = arguments.grasps.unwrap_or_else(|| (arguments.secs / grasp_secs).ceil() as u64);
    match arguments.process.as_deref() {
        Some([process, domain]) => be_process(process.parse()?, &serde_json::from_str(domain)?, &arguments, n_grasps),
        _ => launch(&arguments, n_grasps),
    }
}

/// The chain's processes; dropping them kills those that are left.
struct Chain(Vec<(Child, BufReader<ChildStdout>, Option<ChildStdin>)>);

impl Drop for Chain {
    fn drop(&mut self) {
        for (child, _, _) in &mut self.0 {
            let _ = child.kill().and_then(|()| child.wait());
        }
    }
}

fn launch(arguments: &Arguments, n_grasps: u64) -> anyhow::Result<()> {
    let start_nanos = monotonic_nanos();
    // Ctrl-C must not leave shared memory behind.
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    let domain = Namespace::reserve("bare_chain")?;
    let node = namespace::join(domain.wiring(), "launcher")?;
    let decisions = Receiver::<LiftDecision>::open(&node)?;
    let mut chain = Chain(Vec::new());
    for process in 0..N_PROCESSES {
        let mut child = Command::new(std::env::current_exe()?)
            .args(["--rate", &arguments.rate.to_string(), "--grasps", &n_grasps.to_string()])
            .args(["--process", &process.to_string(), &serde_json::to_string(domain.wiring())?])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let stdout = child.stdout.take().context("no stdout")?;
        let stdin = child.stdin.take();
        chain.0.push((child, BufReader::new(stdout), stdin));
    }
    for (_, stdout, _) in &mut chain.0 {
        let mut line = String::new();
        stdout.read_line(&mut line)?;
        if line != "ready\n" {
            bail!("a process of the chain has ended before it was ready");
        }
    }
    decisions.connect()?;
    let source_stdin = chain.0[0].2.as_mut().context("no stdin")?;
    source_stdin.write_all(b"go\n")?;

    let mut latencies = Latencies::default();
    let mut pss_kib = None;
    let go = Instant::now();
    let (mut first_decision, mut last_decision) = (None, go);
    while latencies.n < n_grasps {
        // A signal ends the wait with an error.
        let _ = decisions.listener.timed_wait(|_| {}, WAIT);
        if stop.load(Ordering::Relaxed) {
            bail!("stopped");
        }
        if last_decision.elapsed() > SILENCE {
            bail!("no decision for {} s: {} of {n_grasps} came", SILENCE.as_secs(), latencies.n);
        }
        while let Some(sample) = decisions.subscriber.receive().map_err(refused)? {
            last_decision = Instant::now();
            first_decision.get_or_insert(last_decision);
            latencies.add(sample.user_header().header.origin_nanos);
            if arguments.json && latencies.n == 1 {
                println!("{}", json!({"seq": 0}));
            }
        }
        if pss_kib.is_none() && go.elapsed().as_secs_f64() > arguments.secs / 2.0 {
            let pss: anyhow::Result<u64> = chain.0.iter().map(|(child, _, _)| pss_of(child.id())).sum();
            pss_kib = Some(pss?);
        }
    }
    let mut reports: Vec<Value> = Vec::new();
    for (child, stdout, stdin) in &mut chain.0 {
        let mut line = String::new();
        stdout.read_line(&mut line)?;
        reports.push(serde_json::from_str(&line).context("a process of the chain has ended without a report")?);
        *stdin = None;
        child.wait()?;
    }
    let sink = reports.pop().context("no report of the sink")?;
    let cpu_nanos: u64 = reports.iter().chain([&sink]).filter_map(|report| report["cpu_nanos"].as_u64()).sum();
    let first_nanos = sink["first_nanos"].as_u64().context("the sink saw no sample")?.saturating_sub(start_nanos);
    let n_frames_after_first = n_grasps.saturating_sub(1) * N_GRASP_FRAMES;
    let secs = last_decision.duration_since(first_decision.unwrap_or(go)).as_secs_f64();
    let summary = json!({
        "rate": arguments.rate,
        "samples_per_sec": n_frames_after_first as f64 / secs,
        "samples": n_grasps * N_GRASP_FRAMES,
        "samples_lost": sink["lost"],
        "latency_nanos": sink["latency_nanos"],
        "decision_latency_nanos": latencies.json(),
        "cpu_secs": cpu_nanos as f64 / 1e9,
        "pss_mib": pss_kib.map(|kib| kib as f64 / 1024.0),
        "launch_to_first_sample_secs": first_nanos as f64 / 1e9,
    });
    if arguments.json {
        println!("{}", json!({ "summary": summary }));
    } else {
        for (name, value) in summary.as_object().into_iter().flatten() {
            println!("{name:<28} {value}");
        }
    }
    Ok(())
}

fn be_process(process: u64, domain: &NamespaceWiring, arguments: &Arguments, n_grasps: u64) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let node = namespace::join(domain, &process.to_string())?;
    let n_frames = n_grasps * N_GRASP_FRAMES;
    match process {
        0 => source(&node, arguments.rate, n_frames),
        1 => stage::<TactileFrame, ContactSet>(&node, n_frames, &[Contact::default(); N_CONTACTS], |header| {
            ContactSetHead { header, ..ContactSetHead::default() }
        }),
        2 => stage::<ContactSet, GraspFeature>(&node, n_frames, &[0.0; N_FEATURES], |header| GraspFeatureHead {
            header,
            ..GraspFeatureHead::default()
        }),
        3 => stage::<GraspFeature, Prediction>(&node, n_frames, &[], |header| PredictionHead {
            header,
            ..PredictionHead::default()
        }),
        _ => sink(&node, n_frames),
    }
}

fn source(node: &Node<PrivateService>, rate: f64, n_frames: u64) -> anyhow::Result<()> {
    let frames = Sender::<TactileFrame>::open(node, N_JOINTS + N_CELLS)?;
    ready(|| Ok(frames.is_connected()))?;
    std::io::stdin().lock().read_line(&mut String::new())?;
    let mut due = Instant::now();
    for seq in 0..n_frames {
        while let Some(left) = due.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            std::thread::sleep(left.min(NAP));
        }
        let header = Header { seq, origin_nanos: monotonic_nanos(), ..Header::default() };
        frames.send(TactileFrameHead { header, ..TactileFrameHead::default() }, &[0.0; N_JOINTS + N_CELLS])?;
        let is_last_of_grasp = seq % N_GRASP_FRAMES == N_GRASP_FRAMES - 1;
        due += Duration::from_secs_f64(if is_last_of_grasp { N_PAUSE_FRAMES as f64 } else { 1.0 } / rate);
    }
    report(json!({}))
}

/// A message whose parts iceoryx2 carries as they are.
trait Sendable: Message<Head: ZeroCopySend, Item: ZeroCopySend> {}
impl<M: Message<Head: ZeroCopySend, Item: ZeroCopySend>> Sendable for M {}

fn stage<In: Sendable, Out: Sendable>(
    node: &Node<PrivateService>,
    n_frames: u64,
    items: &[Out::Item],
    head: impl Fn(Header) -> Out::Head,
) -> anyhow::Result<()> {
    let input = Receiver::<In>::open(node)?;
    let output = Sender::<Out>::open(node, items.len())?;
    ready(|| Ok(input.connect()? && output.is_connected()))?;
    let mut n_sent = 0;
    while n_sent < n_frames {
        input.listener.timed_wait(|_| {}, WAIT).map_err(refused)?;
        while let Some(sample) = input.subscriber.receive().map_err(refused)? {
            output.send(head(*In::header(sample.user_header())), items)?;
            n_sent += 1;
        }
    }
    report(json!({}))
}

fn sink(node: &Node<PrivateService>, n_frames: u64) -> anyhow::Result<()> {
    let predictions = Receiver::<Prediction>::open(node)?;
    let decisions = Sender::<LiftDecision>::open(node, 0)?;
    ready(|| Ok(predictions.connect()? && decisions.is_connected()))?;
    let mut latencies = Latencies::default();
    let (mut next_seq, mut n_lost, mut first_nanos) = (0, 0, None);
    while next_seq < n_frames {
        predictions.listener.timed_wait(|_| {}, WAIT).map_err(refused)?;
        while let Some(sample) = predictions.subscriber.receive().map_err(refused)? {
            let header = sample.user_header().header;
            first_nanos.get_or_insert_with(monotonic_nanos);
            latencies.add(header.origin_nanos);
            n_lost += header.seq - next_seq;
            next_seq = header.seq + 1;
            if next_seq % N_GRASP_FRAMES == 0 {
                decisions.send(LiftDecisionHead { header, ..LiftDecisionHead::default() }, &[])?;
            }
        }
    }
    report(json!({"latency_nanos": latencies.json(), "lost": n_lost, "first_nanos": first_nanos}))
}

type PubSub<M> = publish_subscribe::PortFactory<PrivateService, [<M as Message>::Item], <M as Message>::Head>;

struct Sender<M: Sendable> {
    pub_sub: PubSub<M>,
    publisher: publisher::Publisher<PrivateService, [M::Item], M::Head>,
    notifier: Notifier<PrivateService>,
}

impl<M: Sendable> Sender<M> {
    fn open(node: &Node<PrivateService>, max_items: usize) -> anyhow::Result<Self> {
        let pub_sub = pub_sub::<M>(node)?;
        let publisher =
            pub_sub.publisher_builder().initial_max_slice_len(max_items.max(1)).create().map_err(refused)?;
        let events = node.service_builder(&service_name::<M>()?).event().open_or_create().map_err(refused)?;
        let notifier = events.notifier_builder().create().map_err(refused)?;
        Ok(Sender { pub_sub, publisher, notifier })
    }

    fn is_connected(&self) -> bool {
        self.pub_sub.dynamic_config().number_of_subscribers() > 0
    }

    fn send(&self, head: M::Head, items: &[M::Item]) -> anyhow::Result<()> {
        let mut sample = self.publisher.loan_slice_uninit(items.len()).map_err(refused)?;
        *sample.user_header_mut() = head;
        sample.write_from_slice(items).send().map_err(refused)?;
        self.notifier.notify().map_err(refused)?;
        Ok(())
    }
}

struct Receiver<M: Sendable> {
    pub_sub: PubSub<M>,
    subscriber: subscriber::Subscriber<PrivateService, [M::Item], M::Head>,
    listener: Listener<PrivateService>,
}

impl<M: Sendable> Receiver<M> {
    fn open(node: &Node<PrivateService>) -> anyhow::Result<Self> {
        let events = node.service_builder(&service_name::<M>()?).event().open_or_create().map_err(refused)?;
        let listener = events.listener_builder().create().map_err(refused)?;
        let pub_sub = pub_sub::<M>(node)?;
        let subscriber = pub_sub.subscriber_builder().create().map_err(refused)?;
        Ok(Receiver { pub_sub, subscriber, listener })
    }

    fn connect(&self) -> anyhow::Result<bool> {
        // Looked at first: a publisher that comes in between is met the next time.
        let has_publisher = self.pub_sub.dynamic_config().number_of_publishers() > 0;
        self.subscriber.update_connections().map_err(refused)?;
        Ok(has_publisher)
    }
}

/// Lossless: a publisher waits for a full subscriber.
fn pub_sub<M: Sendable>(node: &Node<PrivateService>) -> anyhow::Result<PubSub<M>> {
    node.service_builder(&service_name::<M>()?)
        .publish_subscribe::<[M::Item]>()
        .user_header::<M::Head>()
        .enable_safe_overflow(false)
        .subscriber_max_buffer_size(CAPACITY)
        .open_or_create()
        .map_err(refused)
}

fn service_name<M: Message>() -> anyhow::Result<ServiceName> {
    ServiceName::new(M::TYPE_NAME).map_err(refused)
}

fn refused(error: impl std::fmt::Debug) -> anyhow::Error {
    anyhow!("iceoryx2: {error:?}")
}

fn ready(is_connected: impl Fn() -> anyhow::Result<bool>) -> anyhow::Result<()> {
    while !is_connected()? {
        std::thread::sleep(READY_POLL);
    }
    println!("ready");
    Ok(())
}

/// Tells the launcher, and keeps the ports open until it has all it needs.
fn report(mut report: Value) -> anyhow::Result<()> {
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    report["cpu_nanos"] = json!(cpu.tv_sec as u64 * 1_000_000_000 + cpu.tv_nsec as u64);
    println!("{report}");
    std::io::stdin().lock().read_to_end(&mut Vec::new())?;
    Ok(())
}

/// Latencies in bins of 0.1 µs, so that a long run takes no more memory than a short one.
struct Latencies {
    n: u64,
    /// The last one has all from 100 ms on.
    bins: Vec<u32>,
}

impl Default for Latencies {
    fn default() -> Self {
        Latencies { n: 0, bins: vec![0; 1_000_001] }
    }
}

impl Latencies {
    fn add(&mut self, origin_nanos: u64) {
        let bin = (monotonic_nanos().saturating_sub(origin_nanos) / 100) as usize;
        self.bins[bin.min(1_000_000)] += 1;
        self.n += 1;
    }

    fn json(&self) -> Value {
        let quantile = |share: f64| {
            let rank = (self.n.saturating_sub(1) as f64 * share).round() as u64;
            let mut n_below = 0;
            let bin = self.bins.iter().position(|n| {
                n_below += u64::from(*n);
                n_below > rank
            });
            bin.map(|bin| bin * 100)
        };
        json!({"p50": quantile(0.5), "p90": quantile(0.9), "p99": quantile(0.99)})
    }
}

/// A process's memory, with its share of what it shares.
fn pss_of(pid: u32) -> anyhow::Result<u64> {
    let path = format!("/proc/{pid}/smaps_rollup");
    let text = std::fs::read_to_string(&path).with_context(|| path.clone())?;
    let kib = text.lines().find_map(|line| line.strip_prefix("Pss:")?.trim().strip_suffix(" kB")?.parse().ok());
    kib.with_context(|| format!("{path} has no Pss"))
}
