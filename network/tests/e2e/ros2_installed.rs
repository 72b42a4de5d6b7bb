//! The programs for ROS 2 with an installation of it: rclpy, Fast DDS and the generators of messages of Kilted, as PyPI has
//! them for x86-64.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use serde_json::{Value, json};

use crate::common::live::{free_port, grasps, live_dataflow};
use crate::common::python::python;
use crate::common::{Graph, project, skipped, undisturbed, unique_name, wait_until};
use blindgrasp_messages::{ContactSet, GraspFeature, Prediction, Recorded, TactileFrame};
use blindgrasp_ros::definition::Definition;
use blindgrasp_ros::standard;
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
/// Publishes the decisions of stdin: grasp, action, and the seconds for which it is valid.
const ARBITER: &str = "
import json, sys, time, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from blindgrasp_msgs.msg import Decision
rclpy.init()
node = rclpy.create_node('arbiter')
qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
decisions = node.create_publisher(Decision, '/blindgrasp/decision', qos)
while not decisions.get_subscription_count():
    time.sleep(0.05)
for line in sys.stdin:
    grasp_id, action, left_secs = json.loads(line)
    decision = Decision(grasp_id=grasp_id, action=getattr(Decision, action), reason='stable', probability_stable=0.9)
    nanos = time.time_ns() + left_secs * 1_000_000_000
    decision.valid_until.sec, decision.valid_until.nanosec = divmod(nanos, 1_000_000_000)
    decisions.publish(decision)
";

/// The controller of a gripper, which reaches each goal but 0.02.
const CONTROLLER: &str = "
import time, rclpy
from rclpy.action import ActionServer
from control_msgs.action import GripperCommand
rclpy.init()
node = rclpy.create_node('controller')
def reach(goal):
    if goal.request.command.position == 0.02:
        print('closing', flush=True)
        time.sleep(3600)
    goal.succeed()
    return GripperCommand.Result(position=goal.request.command.position, reached_goal=True)
server = ActionServer(node, GripperCommand, '/gripper/cmd', reach)
rclpy.spin(node)
";
/// In place of a graph: the same decision about one grasp after the other.
const DECISIONS: &str = "
import itertools, json, sys, time
for grasp_id in itertools.count():
    time.sleep(0.2)
    until = time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 600_000_000_000
    print(json.dumps({'grasp_id': grasp_id, 'action': sys.argv[1], 'reason': 'stable', 'valid_until_nanos': until}), flush=True)
";
/// MoveIt's part: goals, one after the other, and how each ended.
const GOALS: &str = "
import sys, rclpy
from rclpy.action import ActionClient
from control_msgs.action import GripperCommand
rclpy.init()
node = rclpy.create_node('moveit')
client = ActionClient(node, GripperCommand, '/grasp_gate/gripper_cmd')
client.wait_for_server()
def result(future):
    rclpy.spin_until_future_complete(node, future)
    return future.result()
for position in map(float, sys.argv[1:]):
    goal = GripperCommand.Goal()
    goal.command.position = position
    ended = result(result(client.send_goal_async(goal)).get_result_async())
    print(position, ended.status, flush=True)
";

/// A program in Python.
struct Node(Child);

impl Node {
    /// It is in a domain of ROS that other tests do not use, on this machine alone.
    fn start(arguments: &[&str], domain: u32, built: Option<&Path>) -> Node {
        let mut command = Command::new(python());
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.env("ROS_DOMAIN_ID", domain.to_string()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        command.env("PYTHONDONTWRITEBYTECODE", "1");
        if let Some(built) = built {
            let prefixes = [built.to_path_buf(), environment()];
            let libraries = prefixes.clone().map(|prefix| prefix.join("lib"));
            command.env("AMENT_PREFIX_PATH", std::env::join_paths(&prefixes).expect("paths"));
            command.env("LD_LIBRARY_PATH", std::env::join_paths(libraries).expect("paths"));
            command.env("PYTHONPATH", packages_of(built));
        }
        Node(command.spawn().expect("started"))
    }

    /// It ends as any program when it is asked to, without a traceback.
    fn stop(mut self) {
        crate::common::signal(self.0.id() as i32, rustix::process::Signal::TERM);
        assert!(self.0.wait().expect("ended").success());
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The folder in which pip has installed ROS 2.
fn environment() -> PathBuf {
    python().parent().and_then(Path::parent).expect("an environment").to_path_buf()
}

/// The packages of Python below an installation.
fn packages_of(installed: &Path) -> PathBuf {
    let folders = std::fs::read_dir(installed.join("lib")).expect("a folder");
    let paths = folders.map(|entry| entry.expect("an entry").path().join("site-packages"));
    paths.into_iter().find(|path| path.is_dir()).expect("packages of Python")
}

/// Whether something in Python is true.
fn holds(expression: &str) -> bool {
    let script = format!("import os, sysconfig\nimport rclpy\nraise SystemExit(0 if {expression} else 1)");
    let status = Command::new(python()).args(["-c", &script]).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

/// A domain for the nth test of this process. Ports of domains above 101 may be taken for other connections.
fn domain(n: u32) -> u32 {
    1 + 30 * n + std::process::id() % 30
}

#[test]
fn nodes_of_an_installation_of_ros_2_are_read_by_the_bridge() {
    if !holds("True") {
        return skipped("PyPI has no ROS 2 for this machine");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let table = folder.path().join("topics.yaml");
    std::fs::write(&table, TABLE).expect("written");
    let port = free_port();
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      max_delay_ms: 20000");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &params), &PATIENT);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    let address = format!("127.0.0.1:{port}");
    let program = project().join("examples/bridges/ros2.py").display().to_string();
    let table = table.to_str().expect("UTF-8");
    let bridge = Node::start(&[&program, table, "--address", &address], domain(0), None);

    let driver = project().join("tests/ros2_driver.py").display().to_string();
    let mut driver = Node::start(&[&driver], domain(0), None);
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
    bridge.stop();
    graph.stop();
}

/// The package of messages compiles, its types have the hashes that blindgrasp sends, and the example node lifts what it should.
#[test]
fn the_package_of_messages_compiles_and_the_gate_of_the_arm_reads_them() {
    if let Some(missing) = missing_for_packages() {
        return skipped(missing);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let built = compile(&project().join("examples/blindgrasp_msgs"), folder.path());

    let decision = std::fs::read_to_string(project().join("network/src/operators/Decision.msg")).expect("readable");
    let decision = standard::with_parts(&decision, &["builtin_interfaces/Time"]);
    for (name, definition) in [
        (TactileFrame::SCHEMA, TactileFrame::definition()),
        (ContactSet::SCHEMA, ContactSet::definition()),
        (GraspFeature::SCHEMA, GraspFeature::definition()),
        (Prediction::SCHEMA, Prediction::definition()),
        ("blindgrasp_msgs/msg/Decision", decision),
    ] {
        let ours = Definition::parse(name, &definition).expect("a definition").hash();
        assert_eq!(hash_of(&built, name), ours, "{name}");
    }

    // Other tests may run their nodes at the same time.
    let domain = domain(1);
    let gate = project().join("examples/ros2_lift_gate.py").display().to_string();
    let mut gate = Node::start(&[&gate], domain, Some(&built));
    let mut arbiter = Node::start(&["-c", ARBITER], domain, Some(&built));
    let mut stdin = arbiter.0.stdin.take().expect("stdin");
    let mut answers = BufReader::new(gate.0.stderr.take().expect("stderr"));
    for (decision, expected) in [
        (json!([1, "HOLD", 600]), "grasp 1: hold, stable"),
        (json!([2, "LIFT", -1]), "grasp 2: LIFT is no longer valid, hold"),
        (json!([3, "LIFT", 600]), "grasp 3: lift, probability 0.90"),
        // A grasp is lifted once.
        (json!([3, "LIFT", 600]), "grasp 3: LIFT came before, ignored"),
        (json!([4, "TEST_LIFT", 600]), "grasp 4: hold, stable"),
        (json!([4, "SQUEEZE", 600]), "grasp 4: hold, stable"),
        (json!([3, "TIGHTEN", 600]), "grasp 3: what to do while the arm lifts is ignored"),
        (json!([5, "LIFT", 600]), "grasp 5: lift, probability 0.90"),
    ] {
        writeln!(stdin, "{decision}").expect("written");
        let mut said = String::new();
        answers.read_line(&mut said).expect("read");
        assert!(said.trim_end().ends_with(expected), "{expected}: {said}");
    }
    gate.stop();
}

/// MoveIt's goals reach the gripper's controller, and one that closes on an object succeeds only if a LIFT follows. The action is
/// compiled from its definition, because PyPI has no `control_msgs`.
#[test]
fn the_gate_of_the_gripper_passes_goals_on_and_lets_only_a_lift_succeed() {
    if let Some(missing) = missing_for_packages() {
        return skipped(missing);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let package = folder.path().join("control_msgs");
    let example = project().join("examples/blindgrasp_msgs");
    for folder in ["msg", "action"] {
        std::fs::create_dir_all(package.join(folder)).expect("made");
    }
    for file in ["CMakeLists.txt", "package.xml"] {
        let text = std::fs::read_to_string(example.join(file)).expect("readable");
        let text = text.replace("blindgrasp_msgs", "control_msgs").replace("builtin_interfaces", "action_msgs");
        std::fs::write(package.join(file), text.replace("srv/*.srv", "action/*.action")).expect("written");
    }
    std::fs::write(package.join("msg/GripperCommand.msg"), "float64 position\nfloat64 max_effort\n").expect("written");
    let state = "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n";
    let action = format!("GripperCommand command\n---\n{state}---\n{state}");
    std::fs::write(package.join("action/GripperCommand.action"), action).expect("written");
    let built = compile(&package, folder.path());

    let mut controller = Node::start(&["-c", CONTROLLER], domain(2), Some(&built));
    let gate = project().join("examples/ros2_gripper_gate.py").display().to_string();
    let graph = folder.path().join("graph.py");
    std::fs::write(&graph, DECISIONS).expect("written");
    let (python, graph) = (python().display().to_string(), graph.display().to_string());
    let start_gate = |action: &str| {
        let of_gate = [&gate, "--controller", "/gripper/cmd", "--grasps-below", "0.03", "--wait", "50"];
        Node::start(&[&of_gate[..], &[&python, &graph, action]].concat(), domain(2), Some(&built))
    };
    // A hand that opens needs no decision; 4 is a goal that succeeded, and 6 one that was aborted.
    for (action, expected) in [("lift", ["0.08 4", "0.01 4"]), ("hold", ["0.08 4", "0.01 6"])] {
        let gate = start_gate(action);
        let mut moveit = Node::start(&["-c", GOALS, "0.08", "0.01"], domain(2), Some(&built));
        let mut ends = BufReader::new(moveit.0.stdout.take().expect("stdout"));
        for expected in expected {
            let mut end = String::new();
            ends.read_line(&mut end).expect("read");
            assert_eq!(end.trim_end(), expected, "{action}");
        }
        gate.stop();
    }
    // It also ends while the controller moves the hand.
    let gate = start_gate("lift");
    let _moveit = Node::start(&["-c", GOALS, "0.02"], domain(2), Some(&built));
    let mut said = String::new();
    BufReader::new(controller.0.stdout.take().expect("stdout")).read_line(&mut said).expect("read");
    assert_eq!(said.trim_end(), "closing");
    gate.stop();
}

/// What is missing to compile a package of messages.
fn missing_for_packages() -> Option<&'static str> {
    if !holds("os.path.exists(sysconfig.get_paths()['include'] + '/Python.h')") {
        return Some("PyPI has no ROS 2 for this machine, or the headers of Python are missing");
    }
    let compiler = Command::new("c++").arg("--version").stdout(Stdio::null()).status();
    if compiler.is_ok_and(|status| status.success()) { None } else { Some("c++ is missing") }
}

/// Compiles a package as `colcon build` does, below `folder`; returns where it is installed.
fn compile(package: &Path, folder: &Path) -> PathBuf {
    let (build, built, prefix) = (folder.join("build"), folder.join("built"), environment());
    let cmake = |arguments: &[String]| {
        let mut command = Command::new(prefix.join("bin/cmake"));
        let others = std::env::var_os("PATH").unwrap_or_default();
        let paths = std::iter::once(prefix.join("bin")).chain(std::env::split_paths(&others));
        command.args(arguments).env("PATH", std::env::join_paths(paths).expect("paths"));
        let output = command.env("AMENT_PREFIX_PATH", &prefix).output().expect("started");
        let said = crate::common::text(&output.stdout);
        assert!(output.status.success(), "{said}\n{}", crate::common::text(&output.stderr));
    };
    cmake(&[
        format!("-S{}", package.display()),
        format!("-B{}", build.display()),
        "-GNinja".into(),
        format!("-DCMAKE_PREFIX_PATH={}", prefix.display()),
        format!("-DCMAKE_INSTALL_PREFIX={}", built.display()),
        format!("-DPython3_EXECUTABLE={}", python().display()),
        "-DBUILD_TESTING=OFF".into(),
    ]);
    cmake(&["--build".into(), build.display().to_string(), "--target".into(), "install".into()]);
    built
}

/// The hash that the generators of ROS 2 gave a type.
fn hash_of(built: &Path, name: &str) -> String {
    let (package, rest) = name.split_once('/').expect("a package");
    let text = std::fs::read_to_string(built.join(format!("share/{package}/{rest}.json"))).expect("readable");
    let described: Value = serde_json::from_str(&text).expect("JSON");
    let hashes = described["type_hashes"].as_array().expect("hashes");
    let ours = hashes.iter().find(|hash| hash["type_name"] == name).expect("its hash");
    ours["hash_string"].as_str().expect("a hash").to_owned()
}
