//! Frames of a hand on a key of Zenoh, and samples of a graph on keys. The other end is eclipse-zenoh, in Python.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::common::live::{free_port, grasps, live_dataflow};
use crate::common::python::python;
use crate::common::{Graph, run, undisturbed, unique_name, wait_until};
use blindgrasp_messages::{Stamped, TactileFrame};
use blindgrasp_recording::cdr;
use serde_json::{Value, json};

const N_GRASPS: u64 = 12;

/// A frame in the line protocol.
fn line_of(frame: &Stamped<TactileFrame>) -> Value {
    let message = &frame.message;
    json!({
        "joints": message.joints, "cells_newtons": message.cells_newtons, "phase": message.phase,
        "seq": frame.header.seq,
    })
}

/// A frame as `blindgrasp_msgs/msg/TactileFrame` in CDR, hexadecimal, with its number alone.
fn cdr_of(frame: &Stamped<TactileFrame>) -> String {
    let mut frame = frame.clone();
    frame.header.stamp_nanos = 0;
    // The source numbers grasps as the phases tell them, or as the sender does, which counts on.
    frame.message.grasp_id += N_GRASPS;
    let mut bytes = Vec::new();
    cdr::encode(&frame, &mut bytes).expect("CDR");
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

struct Peer(Child, BufReader<std::process::ChildStdout>);

impl Peer {
    /// Runs a program in Python, with a port.
    fn of_script(script: &str, port: u16) -> Peer {
        let mut command = Command::new(python());
        command.args(["-c", script, &port.to_string()]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().expect("started");
        let stdout = BufReader::new(child.stdout.take().expect("stdout"));
        Peer(child, stdout)
    }

    fn line(&mut self) -> Value {
        let mut line = String::new();
        self.1.read_line(&mut line).expect("read");
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line:?}: {error}"))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_lossless_input_or_a_wrong_endpoint_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = live_dataflow(folder.path(), "driver: listen");
    let text = std::fs::read_to_string(&flow).expect("readable");
    for (input, params, expected) in [
        ("lift_arbiter/decision", "{}", "input 'decision' is lossless"),
        (
            "{from: lift_arbiter/decision, policy: latest}",
            "{connect: udp/localhost:1}",
            "'udp/localhost:1' is no endpoint",
        ),
        ("{from: lift_arbiter/decision, policy: latest}", "{prefix: /robot}", "prefix '/robot': expected words"),
    ] {
        let node = format!("\n  zenoh:\n    inputs: {{decision: {input}}}\n    params: {params}\n");
        std::fs::write(&flow, format!("{text}{node}")).expect("written");
        refused_at_once(&flow, expected);
    }
}

/// `run` refuses a file, and so does `run --check`, which starts nothing.
fn refused_at_once(flow: &Path, expected: &str) {
    let (flow, name) = (flow.to_str().expect("UTF-8"), unique_name());
    for arguments in [&["run", flow, "--name", &name][..], &["run", "--check", flow]] {
        let said = crate::common::text(&run(arguments, 1).stderr);
        assert!(said.contains(expected), "{arguments:?}: {expected}: {said}");
    }
}

/// Nothing is a router: the node says so in one line, and no line of Zenoh's own comes beside it.
#[test]
fn without_a_router_one_line_says_what_to_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let source = format!("driver: zenoh\n      connect: tcp/127.0.0.1:{port}\n      key: frames");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &source), &[]);
    let advice = format!("tcp/127.0.0.1:{port}: no router of Zenoh answers; start zenohd, or give another endpoint");
    wait_until(|| graph.said().matches(&advice).count() == 1, || graph.said());
    let said = graph.said();
    for unwanted in [".rs:", "Unable to connect", "Connection refused"] {
        assert!(!said.contains(unwanted), "{unwanted}: {said}");
    }
    // Zenoh may crash under TLS without it.
    let environment = std::fs::read(format!("/proc/{}/environ", graph.pid_of("tactile_source"))).expect("readable");
    assert!(String::from_utf8_lossy(&environment).contains("ZENOH_RUNTIME=(tx: (worker_threads: 1)"));
}

/// Frames on a key, from a plain client of Zenoh that connects to the source: first as JSON, then as CDR.
#[test]
fn frames_on_a_key_of_zenoh_are_decided_and_a_sender_may_start_again() {
    const CLIENT: &str = "
import json, sys, time, zenoh
config = {'mode': 'client', 'connect': {'endpoints': [f'tcp/127.0.0.1:{sys.argv[1]}']}}
for attempt in range(200):
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        break
    except zenoh.ZError:
        time.sleep(0.1)
publisher = session.declare_publisher('hand/frames', congestion_control=zenoh.CongestionControl.BLOCK)
while not publisher.matching_status.matching:
    time.sleep(0.05)
publisher.put('no JSON')
for line in sys.stdin:
    if line.startswith('{'):
        publisher.put(line)
    else:
        publisher.put(bytes.fromhex(line))
session.close()
";
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let params =
        format!("driver: zenoh\n      listen: tcp/127.0.0.1:{port}\n      key: hand/frames\n      max_delay_ms: 20000");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &params), &[]);
    // The second sender counts from 0 again, as a microcontroller does that was switched off and on.
    for round in 0..2 {
        let mut client = Command::new(python());
        let client = client.args(["-c", CLIENT, &port.to_string()]).stdin(Stdio::piped());
        let mut client = client.spawn().expect("started");
        let mut stdin = client.stdin.take().expect("stdin");
        for frame in grasps(N_GRASPS) {
            let line = if round == 0 { line_of(&frame).to_string() } else { cdr_of(&frame) };
            writeln!(stdin, "{line}").expect("written");
        }
        drop(stdin);
        assert!(client.wait().expect("ended").success());
        let n_expected = (round + 1) * N_GRASPS as usize - 1;
        wait_until(|| graph.n_decisions() >= n_expected, || graph.said());
    }
    let counts = || graph.node("tactile_source")["counts"].clone();
    wait_until(|| counts()["malformed"] == 2, || counts().to_string());
    assert_eq!(counts()["out_of_order"], 0, "{}", counts());
    let ended = graph.stop();
    let word = |decision: &Value, key: &str| decision[key].as_str().expect("a word").to_owned();
    let found: Vec<_> = ended.decisions.iter().map(|it| (word(it, "action"), word(it, "reason"))).collect();
    let mut expected = undisturbed()[..N_GRASPS as usize].to_vec();
    // The line that is no JSON, and the second sender, leave a gap in the numbers.
    expected[0] = ("hold".into(), "out_of_order".into());
    assert_eq!(found, [expected.clone(), expected].concat());
}

#[test]
fn decisions_go_to_keys_of_zenoh_as_json() {
    // A router that sends frames and prints the samples of the graph.
    const CLIENT: &str = "
import json, sys, time, zenoh
config = {'mode': 'router', 'listen': {'endpoints': [f'tcp/127.0.0.1:{sys.argv[1]}']}, 'scouting': {'multicast': {'enabled': False}}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
def show(sample):
    numbers = bytes(sample.attachment)
    print(json.dumps({'key': str(sample.key_expr), 'encoding': str(sample.encoding), 'seq': int.from_bytes(numbers[:8], 'little'),
                      'sent': int.from_bytes(numbers[8:16], 'little') / 1e9 - time.time(),
                      'sample': json.loads(bytes(sample.payload))}), flush=True)
subscriber = session.declare_subscriber('robot/hand/*', show)
publisher = session.declare_publisher('frames', congestion_control=zenoh.CongestionControl.BLOCK)
print('null', flush=True)
while not publisher.matching_status.matching:
    time.sleep(0.05)
for line in sys.stdin:
    publisher.put(line)
time.sleep(60)
";
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let mut peer = Peer::of_script(CLIENT, port);
    let mut stdin = peer.0.stdin.take().expect("stdin");
    assert_eq!(peer.line(), Value::Null);
    let connect = format!("connect: tcp/127.0.0.1:{port}");
    let source = format!("driver: zenoh\n      {connect}\n      key: frames\n      max_delay_ms: 20000");
    let flow = live_dataflow(folder.path(), &source);
    let mut text = std::fs::read_to_string(&flow).expect("readable");
    let edge = |from: &str| format!("{{from: {from}, policy: latest, capacity: 256}}");
    write!(
        text,
        "\n  zenoh:\n    inputs:\n      decision: {}\n      prediction: {}\n    params: {{{connect}, prefix: robot/hand}}\n    \
         sandbox: on\n",
        edge("lift_arbiter/decision"),
        edge("classifier/prediction")
    )
    .expect("written");
    std::fs::write(&flow, text).expect("written");
    let graph = Graph::launch(&unique_name(), &flow, &[]);
    wait_until(|| graph.said().contains("publishes on robot/hand/*"), || graph.said());
    for frame in grasps(N_GRASPS) {
        writeln!(stdin, "{}", line_of(&frame)).expect("written");
    }
    let expected = &undisturbed()[..N_GRASPS as usize - 1];
    let mut found = Vec::new();
    let mut n_predictions = 0;
    // On a busy machine decisions may come before predictions that are older.
    while found.len() < expected.len() || n_predictions <= found.len() {
        let line = peer.line();
        assert_eq!(line["encoding"], "application/json", "{line}");
        assert!(line["sent"].as_f64().is_some_and(|secs| secs.abs() < 20.0), "{line}");
        assert_eq!(line["seq"], line["sample"]["seq"]);
        let (key, sample) = (line["key"].as_str().expect("a key"), &line["sample"]);
        if key == "robot/hand/prediction" {
            n_predictions += 1;
            continue;
        }
        assert_eq!(key, "robot/hand/decision");
        let data = &sample["data"];
        let word = |key: &str| data[key].as_str().expect("a word").to_owned();
        let is_valid = sample["valid_for_nanos"].as_u64().expect("a time") > 0;
        assert!(is_valid || word("action") == "hold", "{line}");
        found.push((word("action"), word("reason")));
    }
    assert_eq!(found, expected);
    drop(stdin);
    graph.stop();
}
