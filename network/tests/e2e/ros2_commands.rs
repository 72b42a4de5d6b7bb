//! The commands that speak to a robot in ROS 2. The robot is a router and nodes in Python, by eclipse-zenoh, zenoh-ros2-sdk
//! and rosbags.

use std::io::{BufRead, BufReader};
use std::process::{Child, Stdio};

use crate::common::live::free_port;
use crate::common::{Graph, blindgrasp, fails, project, run, text, unique_name, wait_until};
use crate::ros2::Peer;
use serde_json::Value;

/// A router and the types of ROS 2 Jazzy, for the scripts below.
const ROBOT: &str = "
import json, os, sys, time
os.environ['GIT_PYTHON_REFRESH'] = 'quiet'
import zenoh
from rosbags.typesys import Stores, get_typestore
router = {'mode': 'router', 'listen': {'endpoints': [f'tcp/127.0.0.1:{sys.argv[1]}']}, 'scouting': {'multicast': {'enabled': False}},
          'timestamping': {'enabled': True}}
router = zenoh.open(zenoh.Config.from_json5(json.dumps(router)))
store = get_typestore(Stores.ROS2_JAZZY)
";

fn robot(script: &str, port: u16, words: &[&str]) -> Peer {
    Peer::of_script(&format!("{ROBOT}{script}"), port, words)
}

/// `robot_state_publisher` publishes once, and keeps the message for those that come later.
#[test]
fn a_hand_is_made_from_the_description_that_a_robot_publishes() {
    const STATE_PUBLISHER: &str = "
from zenoh.ext import CacheConfig, declare_advanced_publisher
message = 'std_msgs/msg/String'
key = f'0/gripper/robot_description/std_msgs::msg::dds_::String_/{store.hash_rihs01(message)}'
publisher = declare_advanced_publisher(router, key, cache=CacheConfig(1), publisher_detection=True)
text = open(sys.argv[2], encoding='utf-8').read()
publisher.put(bytes(store.serialize_cdr(store.types[message](data=text), message)))
print('null', flush=True)
time.sleep(60)
";
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let urdf = project().join("hands/parallel-gripper.urdf").display().to_string();
    let mut peer = robot(STATE_PUBLISHER, port, &[&urdf]);
    assert_eq!(peer.line(), Value::Null);
    let connect = format!("tcp/127.0.0.1:{port}");
    let made = folder.path().join("mine").display().to_string();
    let new = |topic: &str, code: i32| {
        let from = [&format!("--robot-description={topic}"), "--connect", &connect];
        let how = ["--open", "jaw=0.0425", "--grid", "left_jaw=2x2", "--grid", "right_jaw=2x2"];
        run(&[&["new", "hand", &made][..], &from, &how].concat(), code)
    };
    let refused = text(&new("/robot_description", 1).stderr);
    assert!(refused.contains("/robot_description: no message has come in 10 s"), "{refused}");
    let said = text(&new("/gripper/robot_description", 0).stdout);
    assert!(said.contains("2 pads, 8 cells"), "{said}");
    let of = |path: &str| std::fs::read_to_string(path).expect("readable");
    assert_eq!(of(&format!("{made}/mine.urdf")), of(&urdf));
    fails(&["new", "hand", &format!("{made}2"), "--urdf", &urdf, "--domain", "1"], "--domain are of no use to --urdf");
}

struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn commands_say_how_to_start_the_router_that_does_not_answer() {
    let connect = format!("tcp/127.0.0.1:{}", free_port());
    let made = ["new", "hand", "mine", "--robot-description", "--base", "palm", "--connect", &connect];
    let said = text(&run(&made, 1).stderr);
    let advice = format!("{connect}: no router of Zenoh answers; start the router: ros2 run rmw_zenoh_cpp rmw_zenohd");
    assert!(said.contains(&advice) && !said.contains(".rs:"), "{said}");
    let mut command = blindgrasp();
    command.args(["diagnostics", "none", "--connect", &connect]).stderr(Stdio::piped());
    let mut running = Running(command.spawn().expect("started"));
    let mut line = String::new();
    BufReader::new(running.0.stderr.take().expect("stderr")).read_line(&mut line).expect("read");
    assert!(line.contains(&advice), "{line}");
}

#[test]
fn ros_2_sees_the_state_of_a_graph_while_it_runs_and_after() {
    const MONITOR: &str = "
message = 'diagnostic_msgs/msg/DiagnosticArray'
def show(sample):
    if str(sample.key_expr).split('/')[-1] != store.hash_rihs01(message):
        print('\"another hash\"', flush=True)
    said = store.deserialize_cdr(bytes(sample.payload), message)
    print(json.dumps({'stamp': said.header.stamp.sec - int(time.time()),
        'status': {it.name: [it.level, it.message, {pair.key: pair.value for pair in it.values}] for it in said.status}}), flush=True)
subscriber = router.declare_subscriber('0/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/*', show)
print('null', flush=True)
time.sleep(60)
";
    let port = free_port();
    let mut peer = robot(MONITOR, port, &[]);
    assert_eq!(peer.line(), Value::Null);
    let name = unique_name();
    let connect = format!("tcp/127.0.0.1:{port}");
    let mut command = blindgrasp();
    command.args(["diagnostics", &name, "--connect", &connect, "--interval", "0.2"]).stderr(Stdio::null());
    let _running = Running(command.spawn().expect("started"));
    let status = |line: &Value, part: &str| line["status"][format!("blindgrasp/{name}: {part}")].clone();
    let before = peer.line();
    assert_eq!(status(&before, "graph")[0], 2, "{before}");
    assert!(before["stamp"].as_i64().is_some_and(|secs| secs.abs() <= 2), "{before}");
    let graph = Graph::launch(&name, &project().join("dataflow.yaml"), &["--set", "recorded_source.repeat=forever"]);
    graph.wait_for_decisions(3);
    let mut line = Value::Null;
    let mut is_seen = || {
        line = peer.line();
        let rate = status(&line, "contacts/contacts -> encoder/contacts")[2]["rate_hz"].as_str().map(str::to_owned);
        let is_moving = rate.and_then(|rate| rate.parse::<f64>().ok()).is_some_and(|rate| rate > 0.0);
        is_moving && status(&line, "graph")[2]["decision_latency_p50_nanos"].is_string()
    };
    wait_until(&mut is_seen, || "no rate of the contacts".into());
    let (whole, node) = (status(&line, "graph"), status(&line, "contacts"));
    assert_eq!((&whole[0], &whole[1]), (&0.into(), &"running".into()), "{line}");
    assert!(whole[2]["n_hold"].is_string(), "{line}");
    assert_eq!((&node[0], &node[1], &node[2]["restarts"]), (&0.into(), &"running".into(), &"0".into()), "{line}");
    graph.stop();
    let mut ended = || {
        let line = peer.line();
        status(&line, "graph")[0] == 2
    };
    wait_until(&mut ended, || "the end of the graph is not said".into());
}
