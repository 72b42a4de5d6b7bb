//! The flight recorder (`record --keep`), and the tests that its files become.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Stdio};

use crate::common::live::{Bridge, PATIENT, changed, free_port, grasps, live_dataflow};
use crate::common::{
    FAST_FOREVER, Graph, blindgrasp, dataflow, fails, json_of, run, signal, text, unique_name, wait_until,
};
use rustix::process::Signal;
use serde_json::{Value, json};

/// `blindgrasp record --keep` while it runs; killed if the test fails.
struct FlightRecorder {
    child: Child,
    stdout: BufReader<ChildStdout>,
}

impl FlightRecorder {
    fn start(graph: &str, out: &Path, arguments: &[&str]) -> FlightRecorder {
        let mut command = blindgrasp();
        command.args(["record", graph, "--json", "--out"]).arg(out).args(arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
        let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
        let mut line = String::new();
        stderr.read_line(&mut line).expect("read");
        assert!(line.starts_with("keeping the last "), "{line}");
        // It must not be blocked by an unread line.
        std::thread::spawn(move || std::io::copy(&mut stderr, &mut std::io::sink()));
        let stdout = BufReader::new(child.stdout.take().expect("piped"));
        FlightRecorder { child, stdout }
    }

    /// The next file, once it is written.
    fn next_file(&mut self) -> (PathBuf, Value) {
        let mut line = String::new();
        self.stdout.read_line(&mut line).expect("read");
        let written: Value = serde_json::from_str(&line).unwrap_or_else(|_| panic!("{line}"));
        (PathBuf::from(written["file"].as_str().expect("a path")), written)
    }

    fn signal(&self, sent: Signal) {
        signal(self.child.id() as i32, sent);
    }

    /// Ends it, and returns its exit code and what it printed since the last file.
    fn stop(mut self) -> (Option<i32>, Vec<String>) {
        self.signal(Signal::INT);
        let rest = self.stdout.by_ref().lines().map(|line| line.expect("read")).collect();
        (self.child.wait().expect("waited").code(), rest)
    }
}

impl Drop for FlightRecorder {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_last_seconds_are_written_when_asked_for_and_pass_as_a_test() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[]);
    let graph = Graph::launch(&unique_name(), &flow, &FAST_FOREVER);
    graph.wait_for_decisions(5);
    let out = folder.path().join("robot.mcap");
    fails(&["record", &graph.name, "--write-kept"], "no flight recorder reads graph");
    let mut recorder = FlightRecorder::start(&graph.name, &out, &["--keep", "2s", "--after", "0.2"]);
    graph.wait_for_decisions(100);
    run(&["record", &graph.name, "--write-kept"], 0);
    let (asked, written) = recorder.next_file();
    recorder.signal(Signal::USR1);
    let (signalled, _) = recorder.next_file();
    assert!(asked != signalled && asked.exists() && !out.exists());
    assert_eq!((&written["why"], &written["missing"]), (&json!(["asked"]), &json!(0)), "{written}");
    let (code, rest) = recorder.stop();
    assert_eq!((code, rest), (Some(0), Vec::new()));
    for file in [asked, signalled] {
        let output = run(&["test", file.to_str().expect("UTF-8"), "--dataflow", flow.to_str().expect("UTF-8")], 0);
        assert!(text(&output.stdout).contains("ok    /decision"), "{}", text(&output.stdout));
    }
}

#[test]
fn a_drop_becomes_a_test_that_fails_until_the_grasp_is_held() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      {PATIENT}");
    let flow = live_dataflow(folder.path(), &params);
    let graph = Graph::launch(&unique_name(), &flow, &["--set", "lift_arbiter.max_gap_ms=2000"]);
    wait_until(|| graph.said().contains("listening on"), || graph.said());
    let out = folder.path().join("robot.mcap");
    let mut recorder = FlightRecorder::start(&graph.name, &out, &["--keep", "10m", "--after", "0"]);
    let mut bridge = Bridge::connect(port);
    // The lift of the fifth grasp drops the object.
    let frames = grasps(6);
    let mut seq = 0;
    for grasp in frames.chunks(14) {
        for frame in grasp {
            bridge.send(&changed(frame, |line| line["seq"] = json!(seq)));
            seq += 1;
        }
        if grasp[0].message.grasp_id == 4 {
            bridge.send(&changed(&grasp[13], |line| {
                (line["seq"], line["phase"]) = (json!(seq), json!("dropped"));
            }));
            seq += 1;
        }
    }
    let (file, written) = recorder.next_file();
    assert_eq!(written["why"], json!(["dropped"]), "{written}");
    assert!(file.to_string_lossy().ends_with("-dropped.mcap"), "{}", file.display());
    let (file, flow) = (file.to_str().expect("UTF-8"), flow.to_str().expect("UTF-8"));
    // A replay with another hand holds every grasp, which expects nothing of the graph.
    let other_hand = ["--set", "contacts.hand=hands/parallel-gripper.yaml"];
    fails(&[&["test", "--init", file, "--dataflow", flow][..], &other_hand].concat(), "as wrong_hand");
    let made = json_of(&["test", "--init", file, "--dataflow", flow, "--json"]);
    assert_eq!(made["recordings"][0]["dropped"], json!([4]), "{made}");
    let expectations = Path::new(file).with_extension("expect.yaml");
    let expected = std::fs::read_to_string(&expectations).expect("written");
    assert!(expected.contains("set:\n  - \"lift_arbiter.max_gap_ms=2000"), "the params of the run: {expected}");
    assert!(expected.contains("  4: hold    # its lift dropped the object"), "{expected}");
    // The graph lifted it, so the test fails as long as it does.
    let is_lifted = made["recordings"][0]["is_met"] == json!(false);
    assert!(is_lifted, "the fifth grasp is lifted: {made}");
    let failed = run(&["test", file, "--dataflow", flow], 1);
    assert!(text(&failed.stdout).contains("grasp 4: expected hold, found lift"), "{}", text(&failed.stdout));
    // A second run leaves the file as it is.
    fails(&["test", "--init", file, "--dataflow", flow], "the file exists");
}
