//! The bridge for ROS 2 with an installation of it: rclpy and Fast DDS of Kilted, as PyPI has them for x86-64.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use serde_json::{Value, json};

use crate::common::python::python;
use crate::common::{Graph, project, skipped, undisturbed, unique_name, wait_until};
use crate::tactile_source::{free_port, grasps, live_dataflow};
use blindgrasp_stages::hand::Hand;

const N_GRASPS: u64 = 3;
/// Each frame is waited for.
const PATIENT: [&str; 2] = ["--set", "lift_arbiter.max_gap_ms=20000"];
/// The cells and the angles of the driver have one time each, and its phases come in time.
const TABLE: &str = "
cells:
  - {topic: /hand/tactile, type: sensor_msgs/msg/JointState, field: effort}
phase: {topic: /hand/phase, max_age_ms: 0}
tolerance_ms: 1000
";

struct Node(Child);

impl Node {
    /// A program in Python, in a domain of ROS that other tests do not use, on this machine alone.
    fn start(program: &Path, arguments: &[&str], domain: u32) -> Node {
        let mut command = Command::new(python());
        command.arg(program).args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
        command.env("ROS_DOMAIN_ID", domain.to_string()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        command.env("PYTHONDONTWRITEBYTECODE", "1");
        Node(command.spawn().expect("started"))
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn nodes_of_an_installation_of_ros_2_are_read_by_the_bridge() {
    let has_ros = Command::new(python()).args(["-c", "import rclpy"]).stderr(Stdio::null()).status();
    if !has_ros.is_ok_and(|status| status.success()) {
        return skipped("PyPI has no ROS 2 for this machine");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let table = folder.path().join("topics.yaml");
    std::fs::write(&table, TABLE).expect("written");
    let port = free_port();
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      max_delay_ms: 20000");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &params), &PATIENT);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    let domain = 1 + std::process::id() % 100;
    let address = format!("127.0.0.1:{port}");
    let program = project().join("examples/bridges/ros2.py");
    let mut bridge = Node::start(&program, &[table.to_str().expect("UTF-8"), "--address", &address], domain);

    let mut driver = Node::start(&project().join("tests/ros2_driver.py"), &[], domain);
    let mut answers = BufReader::new(driver.0.stdout.take().expect("stdout"));
    let mut stdin = driver.0.stdin.take().expect("stdin");
    let mut say = |said: &Value, expected: &str| {
        writeln!(stdin, "{said}").expect("written");
        let mut answer = String::new();
        answers.read_line(&mut answer).expect("read");
        assert_eq!(answer.trim_end(), expected);
    };
    let hand = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
    let names: Vec<&str> = hand.joints.iter().map(|joint| joint.name.as_str()).collect();
    say(&json!(names), "matched");
    let accepted = || graph.node("tactile_source")["counts"]["frames"].as_u64().unwrap_or(0);
    for frame in grasps(N_GRASPS) {
        let message = &frame.message;
        let line = json!({"joints": message.joints, "cells_newtons": message.cells_newtons, "phase": message.phase});
        let (n_before, mut n_looks) = (accepted(), 0);
        let mut has_come = || {
            // The driver sees the bridge before the bridge sees the driver: first messages may be lost.
            if n_looks % 50 == 0 {
                say(&line, "sent");
            }
            n_looks += 1;
            accepted() > n_before
        };
        wait_until(&mut has_come, || format!("frame {n_before} has not come: {}", graph.said()));
    }
    wait_until(|| graph.n_decisions() as u64 == N_GRASPS, || graph.said());
    let decided = graph.lines();
    for (line, (action, reason)) in decided.iter().zip(&undisturbed()[..N_GRASPS as usize]) {
        assert_eq!((&line["action"], &line["reason"]), (&json!(action), &json!(reason)), "{line}");
    }
    // It ends as any program when it is asked to, without a traceback.
    crate::common::signal(bridge.0.id() as i32, rustix::process::Signal::TERM);
    assert!(bridge.0.wait().expect("ended").success());
    graph.stop();
}
