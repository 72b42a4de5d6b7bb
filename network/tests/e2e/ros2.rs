//! A robot in ROS 2: joint angles and cells from its topics, decisions back to it. The robot is
//! `tests/ros2_peer.py`: nodes of zenoh-ros2-sdk, whose types and hashes are those of rosbags.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::common::live::{free_port, grasps, live_dataflow};
use crate::common::python::python;
use crate::common::{Graph, dataflow, project, run, undisturbed, unique_name, wait_until};
use blindgrasp_messages::{Action, Recorded, Stamped, TactileFrame, of_each_type};
use blindgrasp_recording::cdr;
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::standard;
use blindgrasp_stages::hand::Hand;
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

/// The live graph, its source with these parameters and with a node that publishes decisions and frames.
fn ros_graph(folder: &Path, port: u16, params: &str) -> Graph {
    let connect = format!("connect: tcp/127.0.0.1:{port}");
    let source = format!(
        "driver: ros2\n      {connect}\n      cells_topic: /cells\n      joints_topic: /robot/joint_states\n      tolerance_ms: 20000\n      \
         max_delay_ms: 20000\n      {params}"
    );
    let flow = live_dataflow(folder, &source);
    let mut text = std::fs::read_to_string(&flow).expect("readable");
    let hand = project().join("hands/barrett-bh8-280.yaml");
    write!(
        text,
        "\n  ros2:\n    inputs:\n      decision: {{from: lift_arbiter/decision, policy: latest, capacity: 256}}\n      \
         tactile: {{from: tactile_source/tactile, policy: latest, capacity: 256}}\n    \
         params: {{hand: {}, {connect}, namespace: /}}\n    sandbox: on\n",
        hand.display()
    )
    .expect("written");
    std::fs::write(&flow, text).expect("written");
    Graph::launch(&unique_name(), &flow, &[])
}

pub(crate) struct Peer(Child, BufReader<std::process::ChildStdout>);

impl Peer {
    /// Runs a program in Python, with a port and more words.
    pub(crate) fn of_script(script: &str, port: u16, words: &[&str]) -> Peer {
        let mut command = Command::new(python());
        command.args(["-c", script, &port.to_string()]).args(words).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().expect("started");
        let stdout = BufReader::new(child.stdout.take().expect("stdout"));
        Peer(child, stdout)
    }

    fn start(port: u16, rate_hz: u32, n_decisions: u64) -> Peer {
        let mut child = Command::new(python())
            .arg(project().join("tests/ros2_peer.py"))
            .args([port.to_string(), rate_hz.to_string(), n_decisions.to_string()])
            .arg(project().join("network/src/operators/Decision.msg"))
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("started");
        let hand = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
        let names: Vec<_> = hand.joints.iter().map(|joint| joint.name.clone()).collect();
        let stdin = child.stdin.as_mut().expect("stdin");
        writeln!(stdin, "{}", serde_json::to_string(&names).expect("JSON")).expect("written");
        let stdout = BufReader::new(child.stdout.take().expect("stdout"));
        let mut peer = Peer(child, stdout);
        assert_eq!(peer.line(), "ready");
        peer
    }

    pub(crate) fn line(&mut self) -> Value {
        let mut line = String::new();
        self.1.read_line(&mut line).expect("read");
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line:?}: {error}"))
    }

    /// Sends the frames of the first grasps.
    fn send(&mut self) {
        let mut stdin = self.0.stdin.take().expect("stdin");
        writeln!(stdin).expect("written");
        for frame in grasps(N_GRASPS) {
            writeln!(stdin, "{}", serde_json::to_string(&frame.message).expect("JSON")).expect("written");
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn wait_until_joined(graph: &Graph) {
    wait_until(|| graph.said().contains("receives /") && graph.said().contains("publishes in"), || graph.said());
}

#[test]
fn a_robot_in_ros_2_gets_the_decisions_of_its_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let mut peer = Peer::start(port, 200, N_GRASPS);
    let started_nanos = unix_nanos();
    let graph = ros_graph(folder.path(), port, "phase_topic: /phase");
    wait_until_joined(&graph);
    peer.send();
    let mut expected = undisturbed()[..N_GRASPS as usize].to_vec();
    assert_decisions(&mut peer, &expected);
    let (action, _) = &expected[N_GRASPS as usize - 1];
    let action = serde_json::from_value::<Action>(action.as_str().into()).expect("an action").code();
    assert_eq!(peer.line(), json!([[true, N_GRASPS - 1, action], [true, N_GRASPS - 1, action]]));
    let late = peer.line();
    assert!(late["late"].is_u64(), "{late}");
    let tokens = peer.line()["tokens"].to_string();
    for expected in [
        "MP/%/%/blindgrasp/%decision/blindgrasp_msgs::msg::dds_::Decision_/RIHS01_",
        "SS/%/%/blindgrasp/%decide/blindgrasp_msgs::srv::dds_::Decide_/RIHS01_",
        "MP/%/%/blindgrasp/%joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_a13ee3",
        "MS/%/%blindgrasp/blindgrasp_tactile_source/%cells/std_msgs::msg::dds_::Float64MultiArray_/RIHS01_",
    ] {
        assert!(tokens.contains(expected), "{expected} is not in {tokens}");
    }
    let hand = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
    let picture = peer.line();
    let bytes: Vec<u8> = serde_json::from_value(picture["frame"].clone()).expect("bytes");
    let epoch = cdr::decode::<TactileFrame>(&bytes).expect("a frame").header.epoch;
    assert!(
        !(started_nanos..unix_nanos()).contains(&epoch),
        "the epoch of a live graph is the time of its start: {epoch}"
    );
    let n_shapes: usize = hand.links.iter().map(|link| link.shapes.len()).sum();
    assert_eq!((&picture["shapes"], &picture["cells"]), (&n_shapes.into(), &hand.n_cells().into()), "{picture}");
    assert_eq!(picture["points"], json!([hand.n_cells(), ["x", "y", "z", "force"]]), "{picture}");
    // The frames are 10 ms apart, the pictures 100 ms.
    let most = 2 + grasps(N_GRASPS).len() / 10;
    assert!(picture["pictures"].as_u64().is_some_and(|n| (2..=most as u64).contains(&n)), "{picture}");
    assert!(picture["felt"] == true && picture["size"][0].as_f64() > Some(0.01), "{picture}");
    let counts = graph.node("tactile_source")["counts"].clone();
    assert_eq!(counts["malformed"], 0, "{counts}");
    let published = || graph.node("ros2")["counts"]["published"].clone();
    wait_until(|| published().as_u64().is_some_and(|n| n > N_GRASPS), || published().to_string());
    // The robot is switched off and on, with its router.
    drop(peer);
    // Its topics have a new sender, which is turned away until the first has been silent for 2 s.
    std::thread::sleep(std::time::Duration::from_millis(2500));
    let mut peer = Peer::start(port, 200, N_GRASPS);
    peer.send();
    // Frames may be missing before its first one.
    expected[0] = ("hold".into(), "out_of_order".into());
    assert_decisions(&mut peer, &expected);
    graph.stop();
}

fn unix_nanos() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock").as_nanos() as u64
}

/// Reads decisions at the robot.
fn assert_decisions(peer: &mut Peer, expected: &[(String, String)]) {
    for (action, reason) in expected {
        let decision = peer.line();
        let known = serde_json::from_value::<Action>(action.as_str().into()).expect("an action");
        let found = (&decision["action"], &decision["reason"]);
        assert_eq!(found, (&known.code().into(), &reason.as_str().into()), "{decision}");
        // The arbiter's max_age_ms is 20 s here.
        let valid_secs = decision["valid_secs"].as_f64().expect("seconds");
        assert!((0.0..20.0).contains(&valid_secs) && (action != "lift" || valid_secs > 0.0), "{decision}");
    }
}

#[test]
fn messages_of_another_type_or_without_joints_are_refused_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let mut peer = Peer::start(port, 200, 0);
    let graph = ros_graph(folder.path(), port, "cells_type: std_msgs/msg/Float32MultiArray");
    wait_until_joined(&graph);
    peer.send();
    let is_refused = || graph.node("tactile_source")["counts"]["malformed"].as_u64().is_some_and(|n| n > 100);
    wait_until(is_refused, || graph.said());
    let said = graph.said();
    assert!(
        said.contains("/cells: its type is std_msgs/msg/Float64MultiArray, expected std_msgs/msg/Float32MultiArray"),
        "{said}"
    );
    graph.stop();
}

/// Stands in for zenoh-bridge-ros2dds: it puts the messages of nodes of DDS on keys that are the names of topics, without
/// attachments, and hears those of the graph.
const DDS_BRIDGE: &str = r#"
import json, sys, time, zenoh
config = zenoh.Config()
for key, value in (("mode", "peer"), ("listen/endpoints", [f"tcp/127.0.0.1:{sys.argv[1]}"]), ("scouting/multicast/enabled", False)):
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
def heard(sample):
    print(json.dumps([str(sample.key_expr), bytes(sample.payload).hex(), sample.attachment is None]), flush=True)
subscriber = session.declare_subscriber("gate/decision", heard)
print(json.dumps("ready"), flush=True)
for line in sys.stdin:
    key, payload = json.loads(line)
    session.put(key, bytes.fromhex(payload))
    time.sleep(0.002)
time.sleep(600)
"#;

/// A message in CDR, hexadecimal.
fn hex(message: &impl serde::Serialize) -> String {
    let mut bytes = Vec::new();
    cdr::encode(message, &mut bytes).expect("CDR");
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn nodes_of_dds_are_reached_through_their_bridge() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let mut bridge = Peer::of_script(DDS_BRIDGE, port, &[]);
    assert_eq!(bridge.line(), "ready");
    // A hand whose fingers are told from 1000 (open) to 0, under names of their own.
    let hand = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
    let map = folder.path().join("map.yaml");
    let entries: Vec<String> = hand
        .joints
        .iter()
        .map(|joint| format!("{0}: {{from: motor_{0}, scale: -0.001, offset: 1.0}}", joint.name))
        .collect();
    std::fs::write(&map, entries.join("\n")).expect("written");
    let connect = format!("connect: tcp/127.0.0.1:{port}\n      convention: ros2dds");
    let params = format!(
        "driver: ros2\n      {connect}\n      cells_topic: /hand/cells\n      phase_topic: /hand/phase\n      joint_map: {}\n      \
         tolerance_ms: 20000\n      max_delay_ms: 20000",
        map.display()
    );
    let flow = live_dataflow(folder.path(), &params);
    let mut text = std::fs::read_to_string(&flow).expect("readable");
    write!(
        text,
        "\n  ros2:\n    inputs:\n      decision: {{from: lift_arbiter/decision, policy: latest, capacity: 256}}\n    \
         params: {{{}, namespace: /gate}}\n",
        connect.replace("\n      ", ", ")
    )
    .expect("written");
    std::fs::write(&flow, text).expect("written");
    let graph = Graph::launch(&unique_name(), &flow, &[]);
    wait_until_joined(&graph);
    type Header = ((i32, u32), String);
    let header = || -> Header { ((0, 0), String::new()) };
    let names: Vec<String> = hand.joints.iter().map(|joint| format!("motor_{}", joint.name)).collect();
    let mut stdin = bridge.0.stdin.take().expect("stdin");
    let mut say = |key: &str, payload: String| writeln!(stdin, "{}", json!([key, payload])).expect("written");
    for frame in grasps(N_GRASPS) {
        let frame = frame.message;
        let motors: Vec<f64> = frame.joints.iter().map(|angle| (1.0 - angle) * 1000.0).collect();
        let none: Vec<f64> = vec![];
        say("joint_states", hex(&(header(), &names, motors, &none, &none)));
        let phase = serde_json::to_value(frame.phase).expect("a word");
        say("hand/phase", hex(&phase.as_str().expect("a word")));
        let layout: (Vec<u8>, u32) = (vec![], 0);
        say("hand/cells", hex(&(layout, &frame.cells_newtons)));
    }
    wait_until(|| graph.n_decisions() as u64 >= N_GRASPS - 1, || graph.said());
    for _ in 0..N_GRASPS - 1 {
        let heard = bridge.line();
        assert_eq!((&heard[0], &heard[2]), (&json!("gate/decision"), &json!(true)));
    }
    let found = graph.stop().decisions;
    let is_same = |found: &&Value| {
        let expected = found["grasp_id"].as_u64().map(|grasp_id| &undisturbed()[grasp_id as usize]);
        expected.is_some_and(|(action, reason)| found["action"] == **action && found["reason"] == **reason)
    };
    // Angles lose digits on their way, which may turn a close decision.
    assert!(found.iter().filter(is_same).count() as u64 >= N_GRASPS - 2, "{found:?}");
}

#[test]
fn a_joint_map_of_another_hand_and_a_domain_of_the_bridge_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let map = folder.path().join("map.yaml");
    for (joint, params, expected) in [
        ("thumb", "", "has no joint 'thumb'"),
        ("spread: {scale: 0}\n#", "", "no scale of 0"),
        ("spread: {form: a}\n#", "", "{JOINT: {from: NAME, scale: 1, offset: 0}}"),
        ("spread", "convention: ros2dds\n      domain: 3", "have no domain"),
    ] {
        std::fs::write(&map, format!("{joint}: {{}}")).expect("written");
        let params =
            format!("driver: ros2\n      cells_topic: /cells\n      joint_map: {}\n      {params}", map.display());
        let flow = live_dataflow(folder.path(), &params);
        refused_at_once(&flow, expected);
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
        ("{from: lift_arbiter/decision, policy: latest}", "{namespace: /a b}", "is no name of a topic"),
    ] {
        let node = format!("\n  ros2:\n    inputs: {{decision: {input}}}\n    params: {params}\n");
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

/// The dataflow file of the page on ROS 2, with the topics and the model of the tests' robot.
#[test]
fn the_graph_for_ros_2_that_comes_with_the_project_decides() {
    let port = free_port();
    let mut peer = Peer::start(port, 200, N_GRASPS);
    let connect = format!("connect=tcp/127.0.0.1:{port}");
    let model = format!("model={}", project().join("models/barrett-bh8-280.json").display());
    let settings = [
        &connect,
        &model,
        "source.joints_topic=/robot/joint_states",
        "source.cells_topic=/cells",
        "source.phase_topic=/phase",
        "source.tolerance_ms=20000",
        "source.max_delay_ms=20000",
        "lift_arbiter.max_age_ms=20000",
        "lift_arbiter.max_gap_ms=1000",
        "lift_arbiter.min_probability_stable=0",
        "ros2.namespace=/",
    ];
    let arguments: Vec<&str> = settings.into_iter().flat_map(|setting| ["--set", setting]).collect();
    let graph = Graph::launch(&unique_name(), &project().join("dataflow-ros2.yaml"), &arguments);
    wait_until_joined(&graph);
    peer.send();
    assert_decisions(&mut peer, &undisturbed()[..N_GRASPS as usize]);
    graph.stop();
}

/// Nothing is a router: each node says so in one line, and no line of Zenoh's own comes beside it.
#[test]
fn without_a_router_one_line_a_node_says_how_to_start_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let graph = ros_graph(folder.path(), port, "");
    let advice = format!(
        "tcp/127.0.0.1:{port}: no router of Zenoh answers; start the router: ros2 run rmw_zenoh_cpp rmw_zenohd"
    );
    wait_until(|| graph.said().matches(&advice).count() == 2, || graph.said());
    let said = graph.said();
    for unwanted in [".rs:", "Unable to connect", "Connection refused"] {
        assert!(!said.contains(unwanted), "{unwanted}: {said}");
    }
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
    let mut peer = Peer::of_script(CLIENT, port, &[]);
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
    let flow = std::fs::read_to_string(&flow).expect("readable").replace("robot/hand}", "/robot}");
    let wrong = folder.path().join("wrong.yaml");
    std::fs::write(&wrong, flow).expect("written");
    let said = run(&["run", wrong.to_str().expect("UTF-8")], 1);
    let said = String::from_utf8_lossy(&said.stderr).into_owned();
    assert!(said.contains("prefix '/robot': expected words"), "{said}");
}

/// Frames of another hand than the node's are no joint states and no markers of it. They are counted, and the graph goes on.
#[test]
fn frames_of_another_hand_are_counted_as_unpublished() {
    let folder = tempfile::tempdir().expect("a folder");
    let hand = project().join("hands/parallel-gripper.yaml");
    let node = format!(
        "operators:\n  ros2:\n    inputs:\n      tactile: {{from: recorded_source/tactile, policy: latest, capacity: 256}}\n    \
         params: {{hand: {}, listen: tcp/127.0.0.1:{}}}\n    sandbox: on\n",
        hand.display(),
        free_port()
    );
    let path = dataflow(folder.path(), &[("operators:\n", &node)]);
    let graph = Graph::launch(&unique_name(), &path, &["--set", "recorded_source.repeat=forever"]);
    let unpublished = || graph.node("ros2")["counts"]["unpublished"].as_u64().unwrap_or(0);
    wait_until(|| graph.n_decisions() > 5, || graph.said());
    wait_until(|| unpublished() > 5, || graph.said());
    assert_eq!(graph.node("ros2")["n_restarts"], 0, "{}", graph.node("ros2"));
    let said = graph.said();
    assert!(said.contains("is not published as joint_states: 7 joint values, the hand has 1"), "{said}");
    assert_eq!(said.matches("is not published as").count(), 3, "each reason is said once: {said}");
    // Zenoh may crash under TLS without it.
    let environment = std::fs::read(format!("/proc/{}/environ", graph.node("ros2")["pid"])).expect("readable");
    assert!(String::from_utf8_lossy(&environment).contains("ZENOH_RUNTIME=(tx: (worker_threads: 1)"));
    graph.stop();
}

/// Rosbags computes the hashes of types on its own, from its own definitions of ROS 2 Jazzy and from our package.
#[test]
fn hashes_of_types_are_those_that_rosbags_computes() {
    const HASHES: &str = "
import json, pathlib, sys
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
store = get_typestore(Stores.ROS2_JAZZY)
ours = {}
for path in pathlib.Path(sys.argv[1]).glob('*.msg'):
    ours.update(get_types_from_msg(path.read_text(encoding='utf-8'), f'blindgrasp_msgs/msg/{path.stem}'))
store.register(ours)
print(json.dumps({name: store.hash_rihs01(name) for name in [*sys.argv[2:], *ours]}))
";
    let package = project().join("examples/blindgrasp_msgs/msg");
    let output =
        Command::new(python()).args(["-c", HASHES]).arg(&package).args(standard::names()).output().expect("started");
    let found: BTreeMap<String, String> = serde_json::from_slice(&output.stdout).expect("JSON");
    let of = |name: &str, text: &str| Definition::parse(name, text).expect("a definition").hash();
    for name in standard::names() {
        assert_eq!(found[name], of(name, &standard::text(name).expect("known")), "{name}");
    }
    let decision = std::fs::read_to_string(package.join("Decision.msg")).expect("readable");
    let decision = standard::with_parts(&decision, &["builtin_interfaces/Time"]);
    assert_eq!(found["blindgrasp_msgs/msg/Decision"], of("blindgrasp_msgs/msg/Decision", &decision));
    fn ours<M: Recorded>() -> (&'static str, String) {
        (M::SCHEMA, M::definition())
    }
    for (name, text) in of_each_type!(ours) {
        assert_eq!(found[name], of(name, &text), "{name}");
    }
}
