//! A separate process records a running graph: no sample is missing, and no operator waits.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use crate::common::{
    FAST_FOREVER, Graph, blindgrasp, dataflow, fails, program, run, signal, skipped, text, wait_until,
};
use blindgrasp_messages::Header;
use blindgrasp_recording::{Record, RecordingReader};
use rustix::process::Signal;
use serde_json::Value;

/// The recorded samples of each topic.
type Streams = BTreeMap<String, Vec<Record>>;

const NUMBERED: [&str; 4] = ["/tactile", "/contacts", "/feature", "/prediction"];

/// `blindgrasp record` while it runs; killed if the test fails.
struct Recorder {
    child: Child,
    stderr: BufReader<std::process::ChildStderr>,
}

impl Recorder {
    /// Starts recording a graph and waits until it does.
    fn start(graph: &str, out: &Path, arguments: &[&str]) -> Recorder {
        let mut command = blindgrasp();
        command.args(["record", graph, "--json", "--out"]).arg(out).args(arguments);
        Recorder::spawn(command)
    }

    fn spawn(mut command: Command) -> Recorder {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
        let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
        let mut line = String::new();
        stderr.read_line(&mut line).expect("read");
        assert!(line.starts_with("recording "), "{line}");
        Recorder { child, stderr }
    }

    fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    fn stop(self) -> (Option<i32>, Value, String) {
        signal(self.pid(), Signal::INT);
        self.finish()
    }

    /// Exit code, summary, and what it said.
    fn finish(mut self) -> (Option<i32>, Value, String) {
        let mut stdout = Vec::new();
        self.child.stdout.as_mut().expect("piped").read_to_end(&mut stdout).expect("read");
        let mut said = String::new();
        self.stderr.read_to_string(&mut said).expect("read");
        let code = self.child.wait().expect("waited").code();
        let summary = serde_json::from_slice(&stdout).unwrap_or(Value::Null);
        (code, summary, said)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn streams_of(files: &[PathBuf]) -> Streams {
    let mut streams = Streams::new();
    for file in files {
        for record in RecordingReader::open(file).expect("opened") {
            let (topic, record) = record.expect("readable");
            streams.entry(topic).or_default().push(record);
        }
    }
    streams
}

fn headers(records: &[Record]) -> Vec<Header> {
    records.iter().map(|record| *record.header()).collect()
}

fn files(summary: &Value) -> Vec<PathBuf> {
    let files = summary["files"].as_array().expect("files").iter();
    files.map(|file| PathBuf::from(file.as_str().expect("a path"))).collect()
}

/// Asserts that all edges with the source's numbers have the same numbers without a gap, and that the summary agrees.
fn assert_whole(streams: &Streams, summary: &Value, what: &str) {
    let numbers =
        |topic: &str| headers(&streams[topic]).iter().map(|header| (header.epoch, header.seq)).collect::<Vec<_>>();
    let tactile = numbers("/tactile");
    assert!(tactile.len() > 100, "{what}: {} frames", tactile.len());
    for pair in tactile.windows(2) {
        assert!(pair[0].0 != pair[1].0 || pair[0].1 + 1 == pair[1].1, "{what}: {pair:?}");
    }
    for topic in NUMBERED {
        assert!(numbers(topic) == tactile, "{what}: {topic} is not as long as /tactile: {summary}");
    }
    for topic in ["/decision", "/truth"] {
        for pair in numbers(topic).windows(2) {
            assert!(pair[0].0 != pair[1].0 || pair[0].1 + 1 == pair[1].1, "{what}: {topic} {pair:?}");
        }
    }
    assert_eq!(summary["missing"], 0, "{what}: {summary}");
    for edge in summary["edges"].as_array().expect("edges") {
        let stream = &streams[edge["topic"].as_str().expect("a topic")];
        assert_eq!(edge["samples"], stream.len(), "{what}: {edge}");
        let (first, last) = (stream.first().expect("a sample"), stream.last().expect("a sample"));
        assert_eq!((&edge["first"], &edge["last"]), (&first.header().seq.into(), &last.header().seq.into()), "{what}");
    }
}

#[test]
fn an_attached_recording_equals_the_graphs_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let (own, out) = (folder.path().join("own.mcap"), folder.path().join("attached.mcap"));
    let own_text = own.to_str().expect("UTF-8");
    let arguments = [&FAST_FOREVER[..], &["--record", own_text]].concat();
    let graph = Graph::start(&dataflow(folder.path(), &[]), &arguments);
    let recorder = Recorder::start(&graph.name, &out, &[]);
    graph.wait_for_decisions(30);
    let (code, summary, said) = recorder.stop();
    assert_eq!(code, Some(0), "{summary} {said}");
    assert_eq!(summary["ended"], "detached");
    graph.wait_for_decisions(5);
    graph.stop().assert_undisturbed("recorded twice");
    let (attached, own) = (streams_of(&files(&summary)), streams_of(&[own]));
    assert_whole(&attached, &summary, "attached");
    let (first, last) = (*attached["/tactile"][0].header(), *attached["/tactile"].last().expect("frames").header());
    assert!(first.seq > 0);
    for topic in NUMBERED {
        let range = first.seq as usize..=last.seq as usize;
        assert!(own[topic][range] == attached[topic], "{topic}");
    }
    // The decisions of the recorded frames, by the source's clock.
    let is_within = |record: &&Record| (first.stamp_nanos..=last.stamp_nanos).contains(&record.header().stamp_nanos);
    let expected: Vec<Record> = own["/decision"].iter().filter(is_within).cloned().collect();
    assert!(attached["/decision"] == expected, "{:?}", headers(&attached["/decision"]));
    assert!(expected.len() >= 28);
    // The recording describes its graph.
    let info = text(&run(&["info", out.to_str().expect("UTF-8"), "--json"], 0).stdout);
    for word in ["attached", "detached", "held-out.mcap", "barrett-bh8-280.json"] {
        assert!(info.contains(word), "{word} is not in {info}");
    }
}

#[test]
fn operators_that_are_killed_and_swapped_lose_nothing_of_two_recordings() {
    let folder = tempfile::tempdir().expect("a folder");
    let outs = ["a.mcap", "b.mcap", "c.mcap"].map(|name| folder.path().join(name));
    let graph = Graph::fast();
    let first = Recorder::start(&graph.name, &outs[0], &[]);
    let second = Recorder::start(&graph.name, &outs[1], &[]);
    let third = outs[2].to_str().expect("UTF-8");
    fails(&["record", &graph.name, "--out", third], "is being recorded by 2 already");
    assert!(!outs[2].exists());
    for node in ["classifier", "contacts", "recorded_source"] {
        graph.kill(node);
        graph.wait_for_decisions(5);
    }
    run(&["swap", "encoder", "--graph", &graph.name, "--probation", "0.2"], 0);
    graph.wait_for_decisions(5);
    let (code, summary, said) = first.stop();
    assert_eq!(code, Some(0), "{summary} {said}");
    assert_whole(&streams_of(&files(&summary)), &summary, "killed operators");
    // A place is free again.
    let third = Recorder::start(&graph.name, &outs[2], &["--edges", "contacts/contacts,lift_arbiter/decision"]);
    graph.wait_for_decisions(10);
    let (code, summary, _) = third.stop();
    assert_eq!(code, Some(0), "{summary}");
    let streams = streams_of(&files(&summary));
    assert_eq!(streams.keys().collect::<Vec<_>>(), ["/contacts", "/decision"]);
    assert_eq!(summary["missing"], 0);
    // The end of the graph ends the recording, which then has all samples.
    let ended = graph.stop();
    let (code, summary, said) = second.finish();
    assert_eq!((code, &summary["ended"]), (Some(0), &"graph".into()), "{summary} {said}");
    let streams = streams_of(&files(&summary));
    assert_whole(&streams, &summary, "to the end");
    let last = streams["/tactile"].last().expect("frames").header().seq;
    let sent = ended.summary["edges"][0]["sent"].as_u64().expect("a count");
    assert_eq!(last + 1, sent, "{}", ended.summary);
    ended.assert_undisturbed("recorded by two");
}

#[test]
fn a_recorder_that_is_killed_or_stopped_is_left_behind() {
    let folder = tempfile::tempdir().expect("a folder");
    let [killed_out, stopped_out, again] = ["k.mcap", "s.mcap", "k2.mcap"].map(|name| folder.path().join(name));
    let graph = Graph::start(&dataflow(folder.path(), &[]), &[&FAST_FOREVER[..], &["--wait-limit", "2"]].concat());
    let killed = Recorder::start(&graph.name, &killed_out, &[]);
    // Until more than a chunk is on the disk, behind the hand and the model.
    let n_begun = std::fs::metadata(&killed_out).expect("made").len();
    wait_until(
        || std::fs::metadata(&killed_out).is_ok_and(|found| found.len() > n_begun + 200_000),
        || "nothing is written".into(),
    );
    signal(killed.pid(), Signal::KILL);
    killed.finish();
    let stopped = Recorder::start(&graph.name, &stopped_out, &[]);
    graph.wait_for_decisions(5);
    signal(stopped.pid(), Signal::STOP);
    // Far more samples than fit into the queue.
    graph.wait_for_decisions(100);
    signal(stopped.pid(), Signal::CONT);
    graph.wait_for_decisions(20);
    let (code, summary, said) = stopped.stop();
    assert_eq!(code, Some(3), "{summary} {said}");
    assert!(said.contains("are missing"), "{said}");
    let n_missing = summary["missing"].as_u64().expect("a count");
    let streams = streams_of(&files(&summary));
    let mut n_gaps = 0;
    for edge in summary["edges"].as_array().expect("edges") {
        let numbers = headers(&streams[edge["topic"].as_str().expect("a topic")]);
        let spanned = numbers.last().expect("samples").seq - numbers[0].seq + 1;
        assert_eq!(edge["missing"], spanned - numbers.len() as u64, "{edge}");
        n_gaps += edge["missing"].as_u64().expect("a count");
    }
    assert!(n_gaps == n_missing && n_missing > 500, "{summary}");
    // Both places are free again. A name need not be UTF-8.
    let both = [&again, &folder.path().join(OsStr::from_bytes(b"k3\xff.mcap"))]
        .map(|out| Recorder::start(&graph.name, out, &["--for", "0.5"]));
    for recorder in both {
        let (code, summary, said) = recorder.finish();
        assert_eq!(code, Some(0), "{summary} {said}");
    }
    graph.stop().assert_undisturbed("killed and stopped recorders");
    // The file of the killed recorder can be repaired.
    let killed_text = killed_out.to_str().expect("UTF-8");
    // Its end is missing, so that samples may be lost.
    let output = blindgrasp().args(["info", killed_text, "--repair"]).output().expect("started");
    assert_eq!(output.status.code(), Some(3), "{}", text(&output.stderr));
    let repaired = streams_of(&[folder.path().join("k.repaired.mcap")]);
    assert!(repaired["/tactile"].len() > 100);
}

#[test]
fn recordings_that_are_impossible_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("out.mcap");
    let out_text = out.to_str().expect("UTF-8");
    let graph = Graph::fast();
    let record = |arguments: &[&str], code: i32| {
        let all = [&["record", graph.name.as_str(), "--out", out_text][..], arguments].concat();
        text(&run(&all, code).stderr)
    };
    let unknown = record(&["--edges", "contacts/contact"], 1);
    assert!(
        unknown.contains("no edge from 'contacts/contact'; it has: recorded_source/tactile, recorded_source/truth"),
        "{unknown}"
    );
    assert!(!out.exists());
    record(&["--for", "0.3"], 0);
    let before = std::fs::read(&out).expect("recorded");
    let refused = record(&["--for", "0.3"], 1);
    assert!(refused.contains("out.mcap") && refused.contains("overwrite"), "{refused}");
    assert_eq!(std::fs::read(&out).expect("still there"), before);
    record(&["--for", "0.3", "--overwrite"], 0);
    assert_ne!(std::fs::read(&out).expect("recorded"), before);
    assert!(record(&["--rotate-size", "12"], 2).contains("500MB"));
    graph.stop().assert_undisturbed("recorded thrice");
    fails(
        &["record", "no-such-graph", "--out", folder.path().join("x.mcap").to_str().expect("UTF-8")],
        "no graph 'no-such-graph' is running",
    );
}

#[test]
fn a_recording_in_parts_is_whole() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("long.mcap");
    let graph = Graph::fast();
    let recorder = Recorder::start(&graph.name, &out, &["--rotate-every", "700ms"]);
    wait_until(|| folder.path().join("long-00002.mcap").exists(), || "there is no third part".into());
    let (code, summary, said) = recorder.stop();
    assert_eq!(code, Some(0), "{summary} {said}");
    let files = files(&summary);
    assert!(files.len() >= 3, "{files:?}");
    assert_whole(&streams_of(&files), &summary, "in parts");
    graph.stop().assert_undisturbed("recorded in parts");
}

/// The summary of a run that lost nothing but its recording.
fn summary_without_recording(output: &Output, file: &str) -> Value {
    let lines = crate::common::json_lines(&output.stdout);
    let summary = lines.last().expect("a summary")["summary"].clone();
    assert_eq!(output.status.code(), Some(3), "{summary} {}", text(&output.stderr));
    assert_eq!((&summary["samples_lost"], &summary["undecided"]), (&0.into(), &0.into()), "{summary}");
    assert!(summary["recording_error"].as_str().expect("an error").contains(file), "{summary}");
    summary
}

/// The recording lies on a file system of 3 MB that only this test's processes see. Only root can make one.
#[test]
fn a_limit_of_file_sizes_ends_the_recording_and_not_the_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max")]);
    let out = folder.path().join("limited.mcap");
    let name = crate::common::unique_name();
    // Larger than the graph's files in shared memory.
    let output = Command::new("prlimit")
        .args(["--fsize=40000000", program(), "run", "--json", "--name", &name, "--record"])
        .arg(&out)
        .args(["--set", "recorded_source.repeat=100"])
        .arg(&flow)
        .current_dir(crate::common::project())
        .env("XDG_STATE_HOME", Path::new(env!("CARGO_TARGET_TMPDIR")).join("state"))
        .output()
        .expect("prlimit is there");
    summary_without_recording(&output, "limited.mcap");
    crate::common::assert_nothing_left(&name);
}

#[test]
fn a_full_disk_ends_the_recording_and_not_the_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let small = folder.path().join("small");
    std::fs::create_dir(&small).expect("made");
    let mount = format!("mount -t tmpfs -o size=4m none {} && exec \"$@\"", small.display());
    let within = |arguments: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", &mount, "sh"]).args(arguments).current_dir(crate::common::project());
        command.env("XDG_STATE_HOME", Path::new(env!("CARGO_TARGET_TMPDIR")).join("state"));
        command
    };
    if !within(&["true"]).stderr(Stdio::null()).status().is_ok_and(|status| status.success()) {
        skipped("no file system can be mounted here (needs root)");
        return;
    }
    let out = small.join("full.mcap");
    let (program, out) = (program(), out.to_str().expect("UTF-8"));
    // An attached recorder ends, and the graph goes on. The recording is read where the file system is seen.
    let graph = Graph::fast();
    let script = "\"$@\"; code=$?; \"$1\" info \"$6\" >&2 || code=9; exit $code";
    let recorder =
        Recorder::spawn(within(&["sh", "-c", script, "sh", program, "record", &graph.name, "--json", "--out", out]));
    let (code, summary, said) = recorder.finish();
    assert_eq!(code, Some(3), "{summary} {said}");
    assert!(summary["error"].as_str().expect("an error").contains("full.mcap"), "{summary}");
    assert!(summary["n_not_recorded"].as_u64() > Some(0), "{summary}");
    graph.wait_for_decisions(20);
    graph.stop().assert_undisturbed("a recorder with a full disk");
    // The recording of the run itself ends, and all grasps are decided.
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max")]);
    let name = crate::common::unique_name();
    let output = within(&[program, "run", "--json", "--name", &name, "--record", out])
        .args(["--set", "recorded_source.repeat=20"])
        .arg(&flow)
        .output()
        .expect("started");
    let summary = summary_without_recording(&output, "full.mcap");
    let n_recorded: u64 = summary["recorded"].as_object().expect("topics").values().filter_map(Value::as_u64).sum();
    let n_received: u64 = summary["edges"]
        .as_array()
        .expect("edges")
        .iter()
        .filter(|edge| edge["to"] == "run")
        .filter_map(|edge| edge["received"].as_u64())
        .sum();
    assert_eq!(n_recorded + summary["samples_not_recorded"].as_u64().expect("a count"), n_received, "{summary}");
    assert_eq!(text(&output.stderr).matches("recording has ended").count(), 1, "{}", text(&output.stderr));
}
