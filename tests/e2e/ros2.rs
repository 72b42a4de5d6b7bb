//! The package blindgrasp_ros with an installation of ROS 2: rclpy, Fast DDS and the generators of messages of Kilted, as PyPI has
//! them for x86-64.

use std::collections::{BTreeMap, VecDeque};
use std::io::{BufRead, BufReader, Read as _, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

use crate::common::live::{free_port, grasps, live_dataflow};
use crate::common::python::python;
use crate::common::{Graph, program, project, skipped, undisturbed, unique_name, wait_until};
use blindgrasp_stages::hand::Hand;

/// The last of these grasps may be lifted.
const N_GRASPS: u64 = 5;
/// Each frame is waited for, and the service is asked for a decision that is still valid.
const PATIENT: [&str; 4] = ["--set", "lift_arbiter.max_gap_ms=20000", "--set", "lift_arbiter.max_age_ms=600000"];
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

/// Prints each decision, the first message of each other topic, the level of the graph's state when it is another, and for each
/// line of stdin an answer of the service.
const LISTENER: &str = "
import json, sys, threading, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from blindgrasp_msgs.msg import ContactSet, Decision
from blindgrasp_msgs.srv import Decide
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState, PointCloud2
from visualization_msgs.msg import MarkerArray
rclpy.init()
node = rclpy.create_node('listener')
said = {}
def tell(key, value):
    if said.get(key) != value:
        said[key] = value
        print(json.dumps({key: value}), flush=True)
latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
words = lambda it: [it.grasp_id, it.action, it.reason]
node.create_subscription(Decision, '/blindgrasp/decision', lambda it: tell('decision', words(it)), latched)
for kind, topic, size in [(JointState, 'joint_states', lambda it: len(it.name)), (PointCloud2, 'cell_points', lambda it: it.width),
                          (MarkerArray, 'hand_markers', lambda it: len(it.markers) > 10), (ContactSet, 'contacts', lambda it: True)]:
    take = lambda it, topic=topic, size=size: tell(topic, size(it))
    node.create_subscription(kind, '/blindgrasp/' + topic, take, qos_profile_sensor_data)
def diagnose(it):
    tell('state', [status.level[0] for status in it.status if status.name.endswith(': graph')])
node.create_subscription(DiagnosticArray, '/diagnostics', diagnose, 10)
client = node.create_client(Decide, '/blindgrasp/decide')
threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
for line in sys.stdin:
    client.wait_for_service()
    answer = client.call(Decide.Request(timeout_secs=float(line)))
    print(json.dumps({'decided': [answer.decided, *words(answer.decision)]}), flush=True)
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
import itertools, sys, time, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from blindgrasp_msgs.msg import Decision
rclpy.init()
qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node = rclpy.create_node('arbiter')
decisions = node.create_publisher(Decision, '/blindgrasp/decision', qos)
for grasp_id in itertools.count():
    time.sleep(0.2)
    decision = Decision(grasp_id=grasp_id, action=getattr(Decision, sys.argv[1]), reason='stable')
    decision.valid_until.sec = int(time.time()) + 600
    decisions.publish(decision)
";
/// MoveIt's part: goals, one after the other, and how each ended.
const GOALS: &str = "
import sys, time, rclpy
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
    # At first the gate does not know who publishes decisions.
    while not (handle := result(client.send_goal_async(goal))).accepted:
        time.sleep(0.1)
    ended = result(handle.get_result_async())
    print(position, ended.status, flush=True)
";

/// A program in Python.
struct Node(Child);

impl Node {
    /// A node of the package.
    fn of_package(name: &str, arguments: &[&str], domain: u32, built: Option<&Path>) -> Node {
        let module = format!("blindgrasp_ros.{name}");
        Node::start(&[&["-m", &module], arguments].concat(), domain, built)
    }

    /// It is in a domain of ROS that other tests do not use, on this machine alone.
    fn start(arguments: &[&str], domain: u32, built: Option<&Path>) -> Node {
        let mut command = Command::new(python());
        let package = project().join("examples/blindgrasp_ros");
        command.env("PYTHONPATH", &package);
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.env("ROS_DOMAIN_ID", domain.to_string()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        command.env("PYTHONDONTWRITEBYTECODE", "1");
        if let Some(built) = built {
            let prefixes = [built.to_path_buf(), environment()];
            let libraries = prefixes.clone().map(|prefix| prefix.join("lib"));
            command.env("AMENT_PREFIX_PATH", std::env::join_paths(&prefixes).expect("paths"));
            command.env("LD_LIBRARY_PATH", std::env::join_paths(libraries).expect("paths"));
            let paths = std::env::join_paths([package, packages_of(built)]);
            command.env("PYTHONPATH", paths.expect("paths"));
        }
        Node(command.spawn().expect("started"))
    }

    fn lines(&mut self) -> Lines {
        Lines { reader: BufReader::new(self.0.stdout.take().expect("stdout")), values: BTreeMap::new() }
    }

    /// It ends as any program when it is asked to, without a traceback.
    fn stop(mut self) {
        crate::common::signal(self.0.id() as i32, rustix::process::Signal::TERM);
        let mut said = String::new();
        // A test may read its lines itself.
        if let Some(mut stderr) = self.0.stderr.take() {
            stderr.read_to_string(&mut said).expect("read");
        }
        let status = self.0.wait().expect("ended");
        assert!(status.success(), "{status}: {said}");
    }
}

/// Lines of JSON, each with a value of a key.
struct Lines {
    reader: BufReader<ChildStdout>,
    /// The values that were not waited for yet.
    values: BTreeMap<String, VecDeque<Value>>,
}

impl Lines {
    /// Waits for this value of a key.
    fn until(&mut self, key: &str, expected: &Value) {
        loop {
            let values = self.values.entry(key.into()).or_default();
            while let Some(found) = values.pop_front() {
                if found == *expected {
                    return;
                }
            }
            let mut line = String::new();
            self.reader.read_line(&mut line).expect("read");
            let found: BTreeMap<String, Value> =
                serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line:?} before {key} {expected}: {error}"));
            for (key, value) in found {
                self.values.entry(key).or_default().push_back(value);
            }
        }
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

/// The nodes of the package, with messages that are compiled once. PyPI has no `control_msgs`: its action is compiled from its
/// definition.
#[test]
fn robots_of_dds_are_gated_by_the_package_of_ros_2() {
    if let Some(missing) = missing_for_packages() {
        return skipped(missing);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let package = folder.path().join("control_msgs");
    let messages = project().join("examples/blindgrasp_msgs");
    for folder in ["msg", "action"] {
        std::fs::create_dir_all(package.join(folder)).expect("made");
    }
    for file in ["CMakeLists.txt", "package.xml"] {
        let text = std::fs::read_to_string(messages.join(file)).expect("readable");
        let text = text.replace("blindgrasp_msgs", "control_msgs").replace("builtin_interfaces", "action_msgs");
        std::fs::write(package.join(file), text.replace("srv/*.srv", "action/*.action")).expect("written");
    }
    std::fs::write(package.join("msg/GripperCommand.msg"), "float64 position\nfloat64 max_effort\n").expect("written");
    let state = "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n";
    let action = format!("GripperCommand command\n---\n{state}---\n{state}");
    std::fs::write(package.join("action/GripperCommand.action"), action).expect("written");
    let built = folder.path().join("built");
    compile(&messages, &folder.path().join("build"), &built);
    compile(&package, &folder.path().join("build_control"), &built);
    std::thread::scope(|scope| {
        scope.spawn(|| no_lift_outlives_the_graph(&built));
        scope.spawn(|| the_gate_of_the_arm_lifts_on_a_fresh_lift_alone(&built));
        scope.spawn(|| the_gate_of_the_gripper_lets_only_a_lift_succeed(&built));
    });
}

/// Frames come from topics, and decisions go to a topic. When the graph is killed, no LIFT stays.
fn no_lift_outlives_the_graph(built: &Path) {
    let domain = domain(0);
    let folder = tempfile::tempdir().expect("a folder");
    let table = folder.path().join("topics.yaml");
    std::fs::write(&table, TABLE).expect("written");
    let port = free_port();
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      max_delay_ms: 20000");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &params), &PATIENT);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    let address = format!("127.0.0.1:{port}");
    let hand = Node::of_package("hand", &[table.to_str().expect("UTF-8"), "--address", &address], domain, None);
    let of_graph = [&graph.name, "--program", program(), "--outputs", "decision", "tactile", "contacts"];
    let decisions = Node::of_package("decisions", &of_graph, domain, Some(built));
    let mut listener = Node::start(&["-c", LISTENER], domain, Some(built));
    let mut heard = listener.lines();
    let no_graph = json!([0, 0, "no_graph"]);
    heard.until("decision", &no_graph);
    // The first state comes a second after the node has begun to read the graph's samples.
    heard.until("state", &json!([0]));
    send_frames(&graph, domain);
    wait_until(|| graph.n_decisions() as u64 == N_GRASPS, || graph.said());
    let mut last = Value::Null;
    assert_eq!(undisturbed()[N_GRASPS as usize - 1].0, "lift");
    for (line, (action, reason)) in graph.lines().iter().zip(&undisturbed()[..N_GRASPS as usize]) {
        assert_eq!((&line["action"], &line["reason"]), (&json!(action), &json!(reason)), "{line}");
        last = json!([line["grasp_id"], u8::from(action == "lift"), reason]);
        heard.until("decision", &last);
    }
    for (topic, shows) in [("joint_states", json!(7)), ("cell_points", json!(96)), ("hand_markers", json!(true))] {
        heard.until(topic, &shows);
    }
    heard.until("contacts", &json!(true));
    let mut asks = listener.0.stdin.take().expect("stdin");
    writeln!(asks, "1").expect("written");
    let words = last.as_array().expect("a list");
    heard.until("decided", &json!([true, words[0], words[1], words[2]]));
    // A node that comes later gets the last decision.
    let mut late = Node::start(&["-c", LISTENER], domain, Some(built));
    late.lines().until("decision", &last);
    drop(late);

    crate::common::signal(graph.pid(), rustix::process::Signal::KILL);
    heard.until("decision", &no_graph);
    heard.until("state", &json!([2]));
    let mut late = Node::start(&["-c", LISTENER], domain, Some(built));
    late.lines().until("decision", &no_graph);
    writeln!(asks, "0.1").expect("written");
    heard.until("decided", &json!([false, 0, 0, ""]));
    // The last decision of a node that is killed goes with it.
    drop((late, decisions));
    let decisions = Node::of_package("decisions", &of_graph, domain, Some(built));
    let mut late = Node::start(&["-c", LISTENER], domain, Some(built));
    late.lines().until("decision", &no_graph);
    decisions.stop();
    hand.stop();
}

/// The driver of a hand sends the frames of the first grasps, each until the graph has accepted one.
fn send_frames(graph: &Graph, domain: u32) {
    let driver = project().join("tests/ros2_driver.py").display().to_string();
    let mut driver = Node::start(&[&driver], domain, None);
    let mut answers = BufReader::new(driver.0.stdout.take().expect("stdout"));
    let mut stdin = driver.0.stdin.take().expect("stdin");
    let mut say = |said: &Value, expected: &str| {
        writeln!(stdin, "{said}").expect("written");
        let mut answer = String::new();
        answers.read_line(&mut answer).expect("read");
        assert_eq!(answer.trim_end(), expected);
    };
    let layout = Hand::load(&project().join("hands/barrett-bh8-280.yaml")).expect("a hand");
    let names: Vec<&str> = layout.joints.iter().map(|joint| joint.name.as_str()).collect();
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
}

/// The gate of the arm lifts what it should.
fn the_gate_of_the_arm_lifts_on_a_fresh_lift_alone(built: &Path) {
    let domain = domain(1);
    let mut gate = Node::of_package("lift_gate", &[], domain, Some(built));
    let mut arbiter = Node::start(&["-c", ARBITER], domain, Some(built));
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

/// MoveIt's goals reach the gripper's controller, and one that closes on an object succeeds only if a LIFT follows.
fn the_gate_of_the_gripper_lets_only_a_lift_succeed(built: &Path) {
    let mut controller = Node::start(&["-c", CONTROLLER], domain(2), Some(built));
    let start_gate = || {
        let of_gate = ["--controller", "/gripper/cmd", "--grasps-below", "0.03", "--wait", "50"];
        Node::of_package("gripper_gate", &of_gate, domain(2), Some(built))
    };
    // A hand that opens needs no decision; 4 is a goal that succeeded, and 6 one that was aborted.
    for (action, expected) in [("LIFT", ["0.08 4", "0.01 4"]), ("HOLD", ["0.08 4", "0.01 6"])] {
        let _arbiter = Node::start(&["-c", DECISIONS, action], domain(2), Some(built));
        let gate = start_gate();
        let mut moveit = Node::start(&["-c", GOALS, "0.08", "0.01"], domain(2), Some(built));
        let mut ends = BufReader::new(moveit.0.stdout.take().expect("stdout"));
        for expected in expected {
            let mut end = String::new();
            ends.read_line(&mut end).expect("read");
            assert_eq!(end.trim_end(), expected, "{action}");
        }
        gate.stop();
    }
    // It also ends while the controller moves the hand.
    let _arbiter = Node::start(&["-c", DECISIONS, "LIFT"], domain(2), Some(built));
    let gate = start_gate();
    let _moveit = Node::start(&["-c", GOALS, "0.02"], domain(2), Some(built));
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

/// Compiles a package as `colcon build` does, and installs it in `built`.
fn compile(package: &Path, build: &Path, built: &Path) {
    let prefix = environment();
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
}
