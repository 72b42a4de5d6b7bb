//! The default graph split over two machines.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;

use crate::common::{Ended, Graph, dataflow_with, example, json_lines, of_node, run, text, unique_name, wait_until};
use crate::hosts::Host;

/// An endless stream, at a rate that a busy machine keeps up with.
pub(crate) const FOREVER: [&str; 4] = ["--set", "recorded_source.rate=4", "--set", "recorded_source.repeat=forever"];

/// The hand's side and the arbiter run on `robot`, the model's side on `brain`; `machines` is their part of the file.
pub(crate) fn split(folder: &Path, machines: &str, more: &[(String, String)]) -> PathBuf {
    let mut replace = vec![("operators:\n".to_owned(), format!("{machines}operators:\n"))];
    for (node, machine) in [
        ("recorded_source", "robot"),
        ("contacts", "robot"),
        ("encoder", "brain"),
        ("classifier", "brain"),
        ("lift_arbiter", "robot"),
    ] {
        replace.push(of_node(node, &[&format!("on: {machine}")]));
    }
    replace.extend_from_slice(more);
    dataflow_with(folder, &replace)
}

/// No sample is too old on a machine that does other things as well.
pub(crate) fn patient() -> (String, String) {
    ("max_age_ms: 5000".into(), "max_age_ms: 600000".into())
}

/// As on a robot: samples older than 200 ms do not count.
pub(crate) fn strict() -> (String, String) {
    ("max_age_ms: 5000".into(), "max_age_ms: 200".into())
}

pub(crate) fn part(host: &Host, flow: &Path, machine: &str, arguments: &[&str]) -> Graph {
    Graph::launch_on(host.blindgrasp(), &unique_name(), flow, &[&["--machine", machine], arguments].concat())
}

/// The lines of decisions, without their latencies.
pub(crate) fn decided(mut lines: Vec<Value>) -> Vec<Value> {
    lines.retain(|line| line.get("summary").is_none());
    for line in &mut lines {
        line.as_object_mut().expect("an object").remove("latency_nanos");
        line.as_object_mut().expect("an object").remove("valid_until_nanos");
    }
    lines
}

/// The decisions of the default graph on one machine.
pub(crate) fn on_one_machine() -> &'static [Value] {
    static DECIDED: OnceLock<Vec<Value>> = OnceLock::new();
    DECIDED.get_or_init(|| {
        let rate = ["--set", "recorded_source.rate=max"];
        let output = run(&[&["run", "--json", "--name", &unique_name()], &rate[..]].concat(), 0);
        decided(json_lines(&output.stdout))
    })
}

/// What `blindgrasp` says on a host: exit code, stdout, stderr.
pub(crate) fn command(host: &Host, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = host.blindgrasp().args(arguments).output().expect("started");
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// What `ps --json` says of a graph, or of a part of it.
pub(crate) fn status(host: &Host, graph: &str) -> Value {
    let (_, stdout, _) = command(host, &["ps", graph, "--json"]);
    json_lines(stdout.as_bytes()).pop().map_or(Value::Null, |line| line["graphs"][0].clone())
}

/// What it says of a node.
pub(crate) fn node(host: &Host, graph: &str, id: &str) -> Value {
    let status = status(host, graph);
    let mut nodes = status["nodes"].as_array().unwrap_or_else(|| panic!("no nodes in {status}")).iter();
    nodes.find(|node| node["node"] == id).unwrap_or_else(|| panic!("no {id} in {status}")).clone()
}

pub(crate) fn pid_of(host: &Host, graph: &Graph, id: &str) -> i32 {
    let node = node(host, &graph.name, id);
    node["pid"].as_i64().unwrap_or_else(|| panic!("{node} has no process")) as i32
}

/// What it says of another machine.
pub(crate) fn peer(host: &Host, graph: &Graph, machine: &str) -> Value {
    let status = status(host, &graph.name);
    let peers = status["link"]["peers"].as_array().cloned().unwrap_or_default();
    peers.into_iter().find(|peer| peer["machine"] == machine).unwrap_or_default()
}

pub(crate) fn wait_for_state(host: &Host, graph: &Graph, machine: &str, state: &str) {
    wait_until(
        || peer(host, graph, machine)["state"] == state,
        || format!("{machine} is not {state}: {}\n{}", peer(host, graph, machine), graph.said()),
    );
}

/// How many messages a part's link has dropped, for this reason.
pub(crate) fn rejected(host: &Host, graph: &Graph, why: &str) -> u64 {
    status(host, &graph.name)["link"]["rejected"][why].as_u64().unwrap_or(0)
}

pub(crate) fn stop(host: &Host, graph: Graph) -> Ended {
    let told = command(host, &["stop", &graph.name]);
    assert_eq!(told.0, Some(0), "{told:?}");
    graph.finish()
}

/// Each grasp was decided once, in order; what was lifted is lifted on one machine as well.
pub(crate) fn assert_nothing_unsafe(end: &Ended) {
    let expected = on_one_machine();
    for (grasp_id, line) in end.decisions.iter().enumerate() {
        assert_eq!(line["grasp_id"], grasp_id, "{line}\n{}", end.stderr);
        let undisturbed = &expected[grasp_id % expected.len()];
        assert!(line["action"] == "hold" || undisturbed["action"] == "lift", "{line} {undisturbed}");
    }
}

/// It ended well, and lost nothing.
pub(crate) fn assert_lost_nothing(what: &str, end: &Ended) {
    let mut summary = end.summary.clone();
    // A failure's message should fit onto a screen.
    summary["edges"].as_array_mut().into_iter().flatten().filter_map(Value::as_object_mut).for_each(|edge| {
        edge.remove("ages");
    });
    assert_eq!(summary["samples_lost"], 0, "{what}: {summary}\n{}", end.stderr);
    assert_eq!(end.code, Some(0), "{what}: {summary}\n{}", end.stderr);
}

/// Keys for these machines, and whatever else `keys` is told.
pub(crate) fn keys(folder: &Path, arguments: &[&str]) -> PathBuf {
    let keys = folder.join("keys");
    run(&[&["keys", keys.to_str().expect("UTF-8")], arguments].concat(), 0);
    keys
}

/// `tests/doubles/link_attacker.rs` at work on a host; killed with -9 if it is dropped before its end.
pub(crate) struct Attacker(Child);

impl Attacker {
    pub(crate) fn start(host: &Host, folder: &Path, arguments: &[&str]) -> Attacker {
        let program = example("link_attacker");
        // Entering a host changes the current folder.
        let mut command: Command = host.enter("env");
        // A router with the setting stops reading at full speed.
        command.arg("-C").arg(folder).env_remove("ZENOH_RUNTIME");
        if arguments[0] != "router" {
            // Zenoh's TLS breaks otherwise, as in `runtime::process`.
            command.arg("ZENOH_RUNTIME=(tx: (worker_threads: 1), rx: (handover: tx))");
        }
        command.arg(program).args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
        Attacker(command.spawn().expect("started"))
    }

    /// Waits for its end: what it tells.
    pub(crate) fn told(mut self) -> Value {
        let (stdout, stderr) = (self.0.stdout.take().expect("piped"), self.0.stderr.take().expect("piped"));
        let errors = std::thread::spawn(move || std::io::read_to_string(stderr).unwrap_or_default());
        let lines = std::io::read_to_string(stdout).expect("read");
        let errors = errors.join().expect("read");
        let status = self.0.wait().expect("waited");
        assert!(status.success(), "{status}: {errors}");
        json_lines(lines.as_bytes()).pop().unwrap_or_else(|| panic!("it says nothing: {errors}"))
    }
}

impl Drop for Attacker {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

pub(crate) fn with_tls(brain: &Host, keys: &Path) -> String {
    format!(
        "machines:\n  robot: {{}}\n  brain: {{listen: tls/{}:7447}}\n\
         link: {{keys: {}, deadline_ms: 20000}}\n",
        brain.address,
        keys.display()
    )
}
