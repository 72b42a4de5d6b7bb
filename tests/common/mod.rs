//! Runs the real program, and waits for it.
#![allow(dead_code, reason = "each test program uses a part of it")]

pub(crate) mod browser;
pub(crate) mod live;
pub(crate) mod mistakes;
pub(crate) mod python;
mod times;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, Once, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;

pub(crate) const RECORDING: &str = "recordings/held-out.mcap";
pub(crate) const MODEL: &str = "models/barrett-bh8-280.json";
pub(crate) const HAND: &str = "hands/barrett-bh8-280.yaml";

/// For [`dataflow`]: the default graph with its hand side on one machine and its brain on another.
pub(crate) const ON_TWO_MACHINES: [(&str, &str); 6] = [
    ("operators:\n", "machines:\n  robot: {}\n  brain: {listen: unix/gate}\noperators:\n"),
    ("  recorded_source:\n", "  recorded_source:\n    on: robot\n"),
    ("  contacts:\n", "  contacts:\n    on: robot\n"),
    ("  encoder:\n", "  encoder:\n    on: brain\n"),
    ("  classifier:\n", "  classifier:\n    on: brain\n"),
    ("  lift_arbiter:\n", "  lift_arbiter:\n    on: robot\n"),
];

/// The `blindgrasp` of this build. Beside it are the programs of the other houses, which it starts. They are in the folder above
/// that of the test program.
pub(crate) fn program() -> &'static str {
    static PROGRAM: OnceLock<String> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let test = std::env::current_exe().expect("the test program");
        let folder = test.ancestors().nth(2).expect("a folder");
        for name in ["blindgrasp", "blindgrasp-lab", "blindgrasp-network"] {
            let program = folder.join(name);
            assert!(
                program.exists(),
                "{} is missing: build it with cargo build --release --workspace",
                program.display()
            );
        }
        folder.join("blindgrasp").into_os_string().into_string().expect("UTF-8")
    })
}

/// The `blindgrasp` of this build, in the project's folder.
pub(crate) fn blindgrasp() -> Command {
    let mut command = Command::new(program());
    // Nothing comes from the user's folders, and nothing goes there: logs of graphs, and convex parts for MuJoCo.
    let own = Path::new(env!("CARGO_TARGET_TMPDIR"));
    command.env("XDG_STATE_HOME", own.join("state")).env("XDG_CACHE_HOME", own.join("cache"));
    command.current_dir(project()).stdin(Stdio::null());
    command
}

/// Nearly every test calls this or [`unique_name`] early: its time begins there.
pub(crate) fn project() -> &'static Path {
    times::note();
    // The packages of the lab and of the network have their own folders in it.
    let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    folders.find(|folder| folder.join("dataflow.yaml").exists()).expect("a folder with dataflow.yaml")
}

/// A graph name, and with it an iceoryx2 domain, that no other test has.
pub(crate) fn unique_name() -> String {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    times::note();
    // No name is a part of another one, as [`left_overs`] looks for files whose name contains it.
    format!("t{}-{}x", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed))
}

/// Runs to the end, which must have this exit code.
pub(crate) fn run(arguments: &[&str], exit_code: i32) -> Output {
    let output = blindgrasp().args(arguments).output().expect("started");
    assert_eq!(
        output.status.code(),
        Some(exit_code),
        "blindgrasp {arguments:?}\n{}\n{}",
        text(&output.stdout),
        text(&output.stderr)
    );
    output
}

/// The JSON that a command prints.
pub(crate) fn json_of(arguments: &[&str]) -> Value {
    serde_json::from_slice(&run(arguments, 0).stdout).expect("JSON")
}

/// Runs a command that must be refused with these words.
#[track_caller]
pub(crate) fn fails(arguments: &[&str], expected: &str) {
    let said = text(&run(arguments, 1).stderr);
    assert!(said.contains(expected), "blindgrasp {arguments:?}: expected '{expected}' in\n{said}");
}

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

pub(crate) fn json_lines(bytes: &[u8]) -> Vec<Value> {
    text(bytes).lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

/// A folder of this test program, for files that several tests share.
pub(crate) fn shared_folder(name: &str) -> PathBuf {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("shared");
    static SWEPT: Once = Once::new();
    // Statics are never dropped: each program removes the folders of those that have ended.
    SWEPT.call_once(|| {
        for old in std::fs::read_dir(&root).into_iter().flatten().flatten() {
            if !Path::new("/proc").join(old.file_name()).exists() {
                let _ = std::fs::remove_dir_all(old.path());
            }
        }
    });
    let folder = root.join(std::process::id().to_string()).join(name);
    std::fs::create_dir_all(&folder).expect("a folder");
    folder
}

/// A model by the paper's recipe, trained once on the few grasps of the project's recording: worth little.
pub(crate) fn paper_model() -> &'static Path {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    MADE.get_or_init(|| {
        let out = shared_folder("paper_model").join("paper.json");
        run(&["train", RECORDING, "--recipe", "paper", "--out", out.to_str().expect("UTF-8")], 0);
        out
    })
}

/// A dataflow file like the project's own, with some text replaced, in a folder of the test's.
pub(crate) fn dataflow(folder: &Path, replace: &[(&str, &str)]) -> PathBuf {
    let mut text = std::fs::read_to_string(project().join("dataflow.yaml")).expect("dataflow.yaml");
    for (what, by) in replace {
        assert!(text.contains(what), "dataflow.yaml has no '{what}'");
        text = text.replace(what, by);
    }
    for shared in ["recordings", "models", "hands"] {
        text = text.replace(&format!(" {shared}/"), &format!(" {}/{shared}/", project().display()));
    }
    let path = folder.join("dataflow.yaml");
    std::fs::write(&path, text).expect("written");
    path
}

/// The remains of a graph of that name: processes, shared memory, files.
pub(crate) fn left_overs(name: &str) -> Vec<String> {
    let mut found = Vec::new();
    for folder in ["/dev/shm".into(), std::env::temp_dir()] {
        for entry in std::fs::read_dir(&folder).expect("readable").flatten() {
            let entry = entry.file_name().to_string_lossy().into_owned();
            if entry.starts_with("blindgrasp") && entry.contains(name) {
                found.push(format!("{}/{entry}", folder.display()));
            }
        }
    }
    for entry in std::fs::read_dir("/proc").expect("readable").flatten() {
        let environment = std::fs::read(entry.path().join("environ")).unwrap_or_default();
        if text(&environment).contains(&format!("\"graph\":\"{name}\"")) {
            found.push(format!("process {}", entry.file_name().to_string_lossy()));
        }
    }
    found
}

/// Asserts that nothing is left of a graph, allowing its last process a moment to go.
pub(crate) fn assert_nothing_left(name: &str) {
    wait_until(|| left_overs(name).is_empty(), || format!("left: {:?}", left_overs(name)));
}

/// Waits until a condition holds. The limit is there so that a failing test ends.
pub(crate) fn wait_until(mut is_so: impl FnMut() -> bool, describe: impl Fn() -> String) {
    let start = Instant::now();
    // Many conditions start a process to look; waiting tests must not take the processor from the graphs.
    let mut pause = Duration::from_millis(2);
    while !is_so() {
        assert!(start.elapsed() < Duration::from_secs(60), "{}", describe());
        std::thread::sleep(pause);
        pause = (pause * 3 / 2).min(Duration::from_millis(40));
    }
}

/// The data of a report (`--report`), which its page holds as JSON.
pub(crate) fn report_data(page: &str) -> serde_json::Value {
    let data = page.split_once("<script type=\"application/json\" id=\"report\">").expect("data").1;
    serde_json::from_str(data.split_once("</script>").expect("its end").0).expect("JSON")
}

/// Says that the calling test is skipped, on the real stderr. `scripts/test` counts these lines.
#[track_caller]
pub(crate) fn skipped(reason: &str) {
    let (thread, caller) = (std::thread::current(), std::panic::Location::caller());
    let test = match thread.name() {
        Some(name) if name != "main" => name.to_owned(),
        _ => format!("{}:{}", caller.file(), caller.line()),
    };
    let line = format!("SKIPPED {test}: {}\n", reason.trim().replace('\n', " "));
    // The test runner does not capture this, as it would capture what `eprintln!` writes.
    let _ = std::io::stderr().write_all(line.as_bytes());
}

/// The nodes of the project's own dataflow file, in its order.
pub(crate) const NODES: [&str; 5] = ["recorded_source", "contacts", "encoder", "classifier", "lift_arbiter"];
/// A graph that decides this many grasps goes on well.
pub(crate) const A_FEW_GRASPS: usize = 20;
/// Arguments of `run` that play the recording over and over, at about a thousand frames a second. No grasp is stale,
/// even on a busy machine.
pub(crate) const FAST_FOREVER: [&str; 6] = [
    "--set",
    "recorded_source.rate=16",
    "--set",
    "recorded_source.repeat=forever",
    "--set",
    "lift_arbiter.max_age_ms=600000",
];

/// This much of a graph's stderr is kept.
const MAX_SAID_BYTES: usize = 1 << 20;

/// In a shell script: the file to which an operator writes its reports.
pub(crate) const REPORTS: &str = "/proc/self/fd/$BLINDGRASP_REPORTS";

/// Writes a shell script into a folder and makes it executable.
pub(crate) fn script(folder: &Path, name: &str, body: &str) -> PathBuf {
    let path = folder.join(name);
    // Another process writes it: if this one did, a child that another test starts meanwhile could hold the file open
    // for writing, and the kernel would refuse to run it.
    let mut install = Command::new("install");
    install.args(["-m", "755", "/dev/stdin"]).arg(&path).stdin(Stdio::piped());
    let mut child = install.spawn().expect("started");
    let content = format!("#!/bin/sh\n{body}\n");
    child.stdin.take().expect("piped").write_all(content.as_bytes()).expect("written");
    assert!(child.wait().expect("waited").success(), "{} cannot be written", path.display());
    path
}

/// The shell command of a shipped operator.
pub(crate) fn operator(name: &str) -> String {
    format!("{} operator {name}", program())
}

/// A program of one's own that does what a shipped operator does.
pub(crate) fn own_operator(folder: &Path, name: &str) -> PathBuf {
    script(folder, &format!("own_{name}"), &format!("exec {} \"$@\"", operator(name)))
}

/// A program of this build's examples.
pub(crate) fn example(name: &str) -> PathBuf {
    let program = Path::new(program()).with_file_name("examples").join(name);
    assert!(
        program.exists(),
        "{} is missing: build it with cargo build --release --workspace --examples",
        program.display()
    );
    program
}

/// The classifier that calls everything stable, and misbehaves as its params say.
pub(crate) fn stubborn_classifier() -> PathBuf {
    example("stubborn_classifier")
}

/// Lines for a node in a dataflow file, for [`dataflow`].
pub(crate) fn of_node(node: &str, lines: &[&str]) -> (String, String) {
    let at = format!("  {node}:\n");
    let with = lines.iter().fold(at.clone(), |text, line| format!("{text}    {line}\n"));
    (at, with)
}

/// A node of a dataflow file that runs another program with these parameters (in YAML's braces), for [`dataflow`].
pub(crate) fn classifier_runs(program: &Path, params: &str) -> (String, String) {
    let inputs = "    inputs: {feature: encoder/feature}\n";
    (
        format!("  classifier:\n{inputs}"),
        format!("  classifier:\n    run: {}\n{inputs}    params: {params}\n", program.display()),
    )
}

/// [`dataflow`] with replacements of [`of_node`] and the like.
pub(crate) fn dataflow_with(folder: &Path, replace: &[(String, String)]) -> PathBuf {
    let replace: Vec<(&str, &str)> = replace.iter().map(|(what, by)| (what.as_str(), by.as_str())).collect();
    dataflow(folder, &replace)
}

/// A running graph, whose output is read. It is killed if the test fails.
pub(crate) struct Graph {
    pub(crate) name: String,
    child: Child,
    lines: Arc<Mutex<Vec<Value>>>,
    said: Arc<Mutex<String>>,
    readers: Vec<JoinHandle<()>>,
}

/// The results of a graph that has ended.
pub(crate) struct Ended {
    pub(crate) code: Option<i32>,
    pub(crate) decisions: Vec<Value>,
    pub(crate) summary: Value,
    pub(crate) stderr: String,
}

impl Graph {
    /// Starts a graph, with these arguments for `run`, and waits for its first decision.
    pub(crate) fn start(dataflow: &Path, arguments: &[&str]) -> Graph {
        let graph = Graph::launch(&unique_name(), dataflow, arguments);
        graph.wait_for_decisions(1);
        graph
    }

    /// The project's graph, which plays its recording over and over.
    pub(crate) fn fast() -> Graph {
        Graph::start(&project().join("dataflow.yaml"), &FAST_FOREVER)
    }

    pub(crate) fn launch(name: &str, dataflow: &Path, arguments: &[&str]) -> Graph {
        Graph::launch_on(blindgrasp(), name, dataflow, arguments)
    }

    /// As [`Graph::launch`], with this `blindgrasp`.
    pub(crate) fn launch_on(mut command: Command, name: &str, dataflow: &Path, arguments: &[&str]) -> Graph {
        command.args(["run", "--json", "--name", name]).args(arguments).arg(dataflow);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
        let (stdout, mut stderr) = (child.stdout.take().expect("piped"), child.stderr.take().expect("piped"));
        let (lines, said) = (Arc::new(Mutex::new(Vec::new())), Arc::new(Mutex::new(String::new())));
        let read_lines = {
            let lines = Arc::clone(&lines);
            move || {
                for line in BufReader::new(stdout).lines() {
                    let line = serde_json::from_str(&line.expect("read")).expect("a line of JSON");
                    lines.lock().expect("not poisoned").push(line);
                }
            }
        };
        let read_said = {
            let said = Arc::clone(&said);
            move || {
                let mut bytes = [0; 4096];
                while let Ok(n @ 1..) = stderr.read(&mut bytes) {
                    let mut said = said.lock().expect("not poisoned");
                    *said += &text(&bytes[..n]);
                    // Some graphs print a lot.
                    if said.len() > 2 * MAX_SAID_BYTES {
                        *said = text(&said.as_bytes()[said.len() - MAX_SAID_BYTES..]);
                    }
                }
            }
        };
        let readers = vec![std::thread::spawn(read_lines), std::thread::spawn(read_said)];
        Graph { name: name.into(), child, lines, said, readers }
    }

    pub(crate) fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    pub(crate) fn said(&self) -> String {
        self.said.lock().expect("not poisoned").clone()
    }

    /// What it has decided.
    pub(crate) fn lines(&self) -> Vec<Value> {
        self.lines.lock().expect("not poisoned").clone()
    }

    pub(crate) fn n_decisions(&self) -> usize {
        self.lines.lock().expect("not poisoned").len()
    }

    /// Waits until so many more grasps are decided.
    pub(crate) fn wait_for_decisions(&self, n: usize) {
        let wanted = self.n_decisions() + n;
        wait_until(
            || self.n_decisions() >= wanted || self.said().contains("Error"),
            || format!("{} decisions of {wanted}; {}", self.n_decisions(), self.said()),
        );
    }

    /// What `ps --json` says of it, without a process for it: tests ask very often.
    pub(crate) fn status(&self) -> Value {
        let status = blindgrasp_graph::client::status(&self.name);
        serde_json::to_value(status.unwrap_or_else(|error| panic!("{error}\n{}", self.said()))).expect("JSON")
    }

    /// What `ps --json` says of a node.
    pub(crate) fn node(&self, id: &str) -> Value {
        let status = self.status();
        let mut nodes = status["nodes"].as_array().expect("nodes").iter();
        nodes.find(|node| node["node"] == id).unwrap_or_else(|| panic!("no node {id} in {status}")).clone()
    }

    /// The active process of a node.
    pub(crate) fn pid_of(&self, id: &str) -> i32 {
        self.node(id)["pid"].as_i64().unwrap_or_else(|| panic!("node {id} has no process")) as i32
    }

    /// Kills a node's process and waits until the next one runs.
    pub(crate) fn kill(&self, id: &str) {
        let n_restarts = self.node(id)["n_restarts"].as_u64().expect("a count");
        signal(self.pid_of(id), rustix::process::Signal::KILL);
        self.wait_for_restart(id, n_restarts + 1);
    }

    /// Waits until a node runs and has been started again so often.
    pub(crate) fn wait_for_restart(&self, id: &str, n_restarts: u64) {
        let is_back = || {
            let node = self.node(id);
            node["n_restarts"] == n_restarts && node["state"] == "running"
        };
        wait_until(is_back, || format!("{id} after {n_restarts} restarts: {}\n{}", self.node(id), self.said()));
    }

    pub(crate) fn stop(self) -> Ended {
        run(&["stop", &self.name], 0);
        self.finish()
    }

    /// Waits for its end, after which nothing may be left of it.
    pub(crate) fn finish(mut self) -> Ended {
        for reader in self.readers.drain(..) {
            reader.join().expect("read");
        }
        let code = self.child.wait().expect("waited").code();
        assert_nothing_left(&self.name);
        let mut decisions = std::mem::take(&mut *self.lines.lock().expect("not poisoned"));
        let summary = decisions.pop().map_or(Value::Null, |mut line| line["summary"].take());
        Ended { code, decisions, summary, stderr: self.said() }
    }
}

impl Drop for Graph {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Swaps nodes of a graph: what the command prints as JSON, and what it says on stderr.
pub(crate) fn swap(graph: &Graph, arguments: &[&str], exit_code: i32) -> (Value, String) {
    let output = run(&[&["swap", "--graph", &graph.name, "--json"], arguments].concat(), exit_code);
    (json_lines(&output.stdout).pop().unwrap_or_default(), text(&output.stderr))
}

impl Ended {
    /// Asserts that the decisions show no disturbance: each grasp was decided once, in order,
    /// and as in an undisturbed run; and that no sample was lost.
    pub(crate) fn assert_undisturbed(&self, what: &str) {
        let Ended { summary, stderr, .. } = self;
        assert_eq!(summary["samples_lost"], 0, "{what}: {summary}\n{stderr}");
        assert_eq!(self.code, Some(0), "{what}: {summary}\n{stderr}");
        let n_undecided = summary["undecided"].as_u64().expect("a count");
        let is_stopped = summary["end"] == "stopped";
        assert!(n_undecided == 0 || (is_stopped && n_undecided == 1), "{what}: {summary}");
        self.assert_decided_as(undisturbed(), what);
    }

    /// Asserts that each grasp was decided once, in order, and as expected.
    pub(crate) fn assert_decided_as(&self, expected: &[(String, String)], what: &str) {
        for (grasp_id, line) in self.decisions.iter().enumerate() {
            assert_eq!(line["grasp_id"], grasp_id, "{what}: {line}\n{}", self.stderr);
            let (action, reason) = &expected[grasp_id % expected.len()];
            // A grasp that was in the hand when the graph was stopped.
            let is_last = self.summary["end"] == "stopped" && grasp_id + 1 == self.decisions.len();
            let is_cut_off = is_last && ["no_agreement", "missing"].map(Value::from).contains(&line["reason"]);
            let is_as_expected = (line["action"].as_str(), line["reason"].as_str()) == (Some(action), Some(reason));
            assert!(is_as_expected || is_cut_off, "{what}: {line}, expected {action} {reason}\n{}", self.stderr);
        }
    }
}

/// Action and reason for each grasp of the recording in an undisturbed run.
pub(crate) fn undisturbed() -> &'static [(String, String)] {
    static DECISIONS: OnceLock<Vec<(String, String)>> = OnceLock::new();
    DECISIONS.get_or_init(|| decisions_of(&project().join("dataflow.yaml")))
}

/// Action and reason for each grasp of a dataflow file's recording.
pub(crate) fn decisions_of(dataflow: &Path) -> Vec<(String, String)> {
    let flow = dataflow.to_str().expect("UTF-8");
    let output = run(&["run", "--json", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow], 0);
    let lines = json_lines(&output.stdout);
    let decisions = lines.iter().filter(|line| line.get("summary").is_none());
    let word = |line: &Value, field: &str| line[field].as_str().expect("a word").to_string();
    let by_grasp: BTreeMap<u64, _> = decisions
        .map(|line| (line["grasp_id"].as_u64().expect("an id"), (word(line, "action"), word(line, "reason"))))
        .collect();
    by_grasp.into_values().collect()
}

/// Sends a signal to a process.
#[track_caller]
pub(crate) fn signal(pid: i32, signal: rustix::process::Signal) {
    let pid = rustix::process::Pid::from_raw(pid).expect("a pid");
    rustix::process::kill_process(pid, signal).expect("signalled");
}

/// A file of the reference data, which lie beside the project where it is developed. Counts the test as skipped where
/// they are missing.
#[track_caller]
pub(crate) fn reference(path: &str) -> Option<PathBuf> {
    let path = project().join("../shared/data").join(path);
    if !path.exists() {
        skipped(&format!("no reference data at {}", path.display()));
        return None;
    }
    Some(path)
}
