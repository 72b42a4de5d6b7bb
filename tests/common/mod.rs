//! Running the real programs.
#![allow(dead_code, reason = "each test file uses a part of it")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

pub(crate) const RECORDING: &str = "recordings/held-out.mcap";
pub(crate) const MODEL: &str = "models/barrett-bh8-280.json";
pub(crate) const HAND: &str = "hands/barrett-bh8-280.yaml";

/// The `blindgrasp` of this build, in the project's folder.
pub(crate) fn blindgrasp() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_blindgrasp"));
    // Logs of the tests' graphs are no business of whoever runs the tests.
    let state = Path::new(env!("CARGO_TARGET_TMPDIR")).join("state");
    command.current_dir(project()).stdin(Stdio::null()).env("XDG_STATE_HOME", state);
    command
}

pub(crate) fn project() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A graph name, and with it an iceoryx2 domain, that no other test has.
pub(crate) fn unique_name() -> String {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    format!("t{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed))
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

pub(crate) fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

pub(crate) fn json_lines(bytes: &[u8]) -> Vec<Value> {
    text(bytes).lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

/// A model by the paper's recipe, trained on the few grasps of the project's recording: worth little, made in a second.
pub(crate) fn paper_model(folder: &Path) -> PathBuf {
    let out = folder.join("paper.json");
    run(&["train", RECORDING, "--recipe", "paper", "--out", out.to_str().expect("UTF-8")], 0);
    out
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

/// What is left of a graph of that name: processes, shared memory, files.
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

/// Waits for something that must come; the limit is only there so that a failing test ends.
pub(crate) fn wait_until(mut is_so: impl FnMut() -> bool, describe: impl Fn() -> String) {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < Duration::from_secs(60), "{}", describe());
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A running graph; killed if the test fails.
pub(crate) struct Running {
    pub(crate) name: String,
    pub(crate) child: Child,
    pub(crate) stdout: std::io::BufReader<std::process::ChildStdout>,
}

impl Running {
    pub(crate) fn start(dataflow: &Path) -> Running {
        let name = unique_name();
        let mut child = blindgrasp()
            .args(["run", "--json", "--name", &name])
            .arg(dataflow)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("started");
        let stdout = std::io::BufReader::new(child.stdout.take().expect("piped"));
        Running { name, child, stdout }
    }

    /// The next line of results.
    pub(crate) fn line(&mut self) -> Value {
        let mut line = String::new();
        std::io::BufRead::read_line(&mut self.stdout, &mut line).expect("read");
        serde_json::from_str(&line).expect("a line of JSON")
    }

    /// The process of a node.
    pub(crate) fn pid(&self, node: &str) -> i32 {
        let wanted = format!("\"node\":\"{node}\"");
        let graph = format!("\"graph\":\"{}\"", self.name);
        std::fs::read_dir("/proc")
            .expect("readable")
            .flatten()
            .find_map(|entry| {
                let environment = text(&std::fs::read(entry.path().join("environ")).ok()?);
                let is_it = environment.contains(&wanted) && environment.contains(&graph);
                is_it.then(|| entry.file_name().to_string_lossy().parse().ok())?
            })
            .unwrap_or_else(|| panic!("no process of node {node}"))
    }

    pub(crate) fn signal(pid: i32, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_raw(pid).expect("a pid");
        rustix::process::kill_process(pid, signal).expect("signalled");
    }

    /// Waits for the end: exit code, remaining stdout, stderr.
    pub(crate) fn finish(mut self) -> (Option<i32>, Vec<Value>, String) {
        let mut rest = Vec::new();
        std::io::Read::read_to_end(&mut self.stdout, &mut rest).expect("read");
        let mut stderr = Vec::new();
        std::io::Read::read_to_end(self.child.stderr.as_mut().expect("piped"), &mut stderr).expect("read");
        let status = self.child.wait().expect("waited");
        (status.code(), json_lines(&rest), text(&stderr))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A file of the reference data that lie beside the project where it is developed; says so where they don't.
pub(crate) fn reference(path: &str) -> Option<PathBuf> {
    let path = project().join("../shared/data").join(path);
    if !path.exists() {
        // Not `eprintln!`, which the test runner keeps to itself when a test passes.
        blindgrasp::diagnostics::print_diagnostic(&format!("SKIPPED: no reference data at {}", path.display()));
        return None;
    }
    Some(path)
}
