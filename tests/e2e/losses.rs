//! Kills, hangs, swaps and limits at the moments at which the runtime could lose samples. Each test brings about its moment:
//! the source sends as many frames as it is told, and processes are stopped and continued.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::{Duration, Instant};

use blindgrasp_recording::{Record, RecordingReader, RecordingWriter};
use rustix::process::{Pid, Resource, Rlimit, Signal, getrlimit, prlimit};
use serde_json::Value;

use crate::common::python::{assert_each_once, python_operator};
use crate::common::{
    A_FEW_GRASPS, Ended, FAST_FOREVER, Graph, HAND, MODEL, NODES, RECORDING, blindgrasp, classifier_runs,
    dataflow_with, decisions_of, of_node, program, project, run, signal, swap, text, undisturbed, unique_name,
    wait_until,
};

/// As many samples as an edge takes that nobody has answered.
const CAPACITY: u64 = 256;
/// A check of the sensors, with which the contacts have a state and long answers.
const SENSORS: &str = "models/barrett-bh8-280.sensors.json";
/// A model with which the classifier has a state.
const LIFTS: &str = "models/barrett-bh8-280-lifts.json";
/// About a thousand frames a second, and no grasp is stale.
const FAST: [&str; 4] = ["--set", "recorded_source.rate=16", "--set", "lift_arbiter.max_age_ms=600000"];
const AS_FAST_AS_IT_GOES: [&str; 4] = ["--set", "recorded_source.rate=max", "--set", "lift_arbiter.max_age_ms=600000"];

/// The default graph with these changes. Its nodes may stand still for as long as a test wants, and are given up after a few
/// restarts.
fn patient(folder: &Path, changes: &[(String, String)]) -> PathBuf {
    let lines = ["restart: {policy: on-failure, limit: 5, within_s: 60, backoff_ms: 1}", "heartbeat_ms: 60000"];
    dataflow_with(folder, &[changes, &NODES.map(|node| of_node(node, &lines))].concat())
}

fn change(what: &str, by: &str) -> (String, String) {
    (what.into(), by.into())
}

/// The contacts check the sensors.
fn with_sensors() -> (String, String) {
    let inputs = "    inputs: {tactile: recorded_source/tactile}\n";
    (inputs.into(), format!("    params: {{sensors: {SENSORS}}}\n{inputs}"))
}

/// A graph whose source waits after so many frames, all of which are answered.
fn paused(flow: &Path, n_frames: u64, arguments: &[&str]) -> Graph {
    let steps = format!("recorded_source.steps={n_frames}");
    let graph = Graph::start(flow, &[&FAST[..], &["--set", &steps], arguments].concat());
    wait_for_answers(&graph, n_frames);
    graph
}

/// Lets the source send until it has sent so many frames in all.
fn let_send(graph: &Graph, n_frames: u64) {
    set(graph, &format!("recorded_source.steps={n_frames}"));
}

fn let_finish(graph: &Graph) {
    set(graph, "recorded_source.steps=unlimited");
}

fn set(graph: &Graph, value: &str) {
    run(&["set", "--graph", &graph.name, value], 0);
}

/// What `ps --json` counts at an input of a node (`contacts/tactile`).
fn count(graph: &Graph, input: &str, what: &str) -> u64 {
    let edges = graph.status()["edges"].take();
    let edge = edges.as_array().expect("edges").iter().find(|edge| edge["to"] == input);
    edge.unwrap_or_else(|| panic!("no edge to {input}: {edges}"))[what].as_u64().expect("a count")
}

fn wait_for_count(graph: &Graph, input: &str, what: &str, n: u64) {
    let describe = || format!("{input}: expected {n} {what}; {}\n{}", edge_counts(&graph.status()), graph.said());
    wait_until(|| count(graph, input, what) >= n, describe);
}

/// Waits until the samples up to this number are answered by all nodes.
fn wait_for_answers(graph: &Graph, n_frames: u64) {
    wait_for_count(graph, "lift_arbiter/prediction", "received", n_frames);
}

/// The input of a node of the default graph.
fn input_of(node: &str) -> &'static str {
    match node {
        "contacts" => "contacts/tactile",
        "encoder" => "encoder/contacts",
        "classifier" => "classifier/feature",
        _ => "lift_arbiter/prediction",
    }
}

/// Stops a process and waits until the source may send no more, because of the samples that the process has not answered.
fn stop_until_the_source_waits(graph: &Graph, node: &str) -> i32 {
    stop_until_unanswered(graph, node, CAPACITY)
}

/// Stops a process and waits until the source has sent so many samples that the process has not received.
fn stop_until_unanswered(graph: &Graph, node: &str, n_samples: u64) -> i32 {
    let pid = graph.pid_of(node);
    signal(pid, Signal::STOP);
    let n_ahead = || count(graph, "contacts/tactile", "sent").saturating_sub(count(graph, input_of(node), "received"));
    let is_over = || n_ahead() >= n_samples || graph.said().contains("is degraded");
    wait_until(is_over, || format!("{node} has {} samples to answer\n{}", n_ahead(), graph.said()));
    assert!(!graph.said().contains("is degraded"), "{node}: {} of {n_samples}\n{}", n_ahead(), graph.said());
    pid
}

/// Kills processes at once.
fn kill(pids: &[i32]) {
    pids.iter().for_each(|pid| signal(*pid, Signal::KILL));
}

/// Waits for the end of a graph whose recording ends.
fn end(graph: Graph) -> Ended {
    let is_over = || graph.lines().last().is_some_and(|line| line.get("summary").is_some());
    wait_until(is_over, || format!("does not end: {} decisions\n{}", graph.n_decisions(), graph.said()));
    graph.finish()
}

/// The counts of each edge, for a person.
fn edge_counts(summary: &Value) -> String {
    let count = |edge: &Value| {
        let [to, sent, received, missing] = ["to", "sent", "received", "missing"].map(|key| &edge[key]);
        format!("{to}: {sent} sent, {received} received, {missing} missing")
    };
    summary["edges"].as_array().into_iter().flatten().map(count).collect::<Vec<_>>().join("; ")
}

/// Asserts that nothing was lost, that all was decided once, in order and as expected, and that no process was started again
/// that the test has not killed.
fn assert_whole(ended: &Ended, expected: &[(String, String)], n_restarts: u64, what: &str) {
    let Ended { summary, stderr, .. } = ended;
    let found = (ended.code, &summary["samples_lost"], &summary["restarts"]);
    let counts = edge_counts(summary);
    assert_eq!(
        found,
        (Some(0), &0.into(), &n_restarts.into()),
        "{what}: exit code, lost, restarts; {counts}\n{stderr}"
    );
    assert_each_once(ended);
    ended.assert_decided_as(expected, what);
    if summary["end"] == "finished" {
        assert_eq!(ended.decisions.len() % expected.len(), 0, "{what}: {} decisions", ended.decisions.len());
    }
}

/// Answers that no reader has taken are saved with the state, and these are many.
#[test]
fn a_stage_with_a_state_and_long_answers_runs_as_fast_as_it_goes() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &[with_sensors()]);
    let arguments = [&AS_FAST_AS_IT_GOES[..], &["--set", "recorded_source.repeat=20"]].concat();
    let ended = end(Graph::launch(&unique_name(), &flow, &arguments));
    assert_whole(&ended, undisturbed(), 0, "contacts with sensors, undisturbed");
    assert_eq!(ended.decisions.len(), 20 * undisturbed().len());
}

#[test]
fn a_stage_with_a_state_and_long_answers_waits_for_a_reader_that_stands_still_or_is_killed() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&patient(folder.path(), &[with_sensors()]), &FAST_FOREVER);
    for _ in 0..2 {
        signal(stop_until_the_source_waits(&graph, "encoder"), Signal::CONT);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    kill(&[stop_until_the_source_waits(&graph, "encoder")]);
    graph.wait_for_restart("encoder", 1);
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert_whole(&graph.stop(), undisturbed(), 1, "contacts with sensors behind a slow reader");
}

const N_GRASPS: u64 = 20;
const N_FRAMES: u64 = 14 * N_GRASPS;

/// A recording of twelve epochs, each of which is numbered from 0, of 20 grasps and 280 frames each.
fn of_many_epochs(folder: &Path) -> (String, String) {
    let path = folder.join("epochs.mcap");
    let reader = RecordingReader::open(&project().join(RECORDING)).expect("opened");
    let mut writer = RecordingWriter::create(&path, reader.info()).expect("created");
    for record in reader {
        let (topic, mut record) = record.expect("read");
        let (header, grasp_id, n_numbers) = match &mut record {
            Record::Tactile(frame) => (&mut frame.header, frame.message.grasp_id, N_FRAMES),
            Record::Truth(truth) => (&mut truth.header, truth.message.grasp_id, N_GRASPS),
            _ => continue,
        };
        let epoch = grasp_id / N_GRASPS;
        header.seq -= epoch * n_numbers;
        header.epoch += epoch;
        writer.write_record(&topic, &record).expect("written");
    }
    writer.finish().expect("finished");
    change("recordings/held-out.mcap", path.to_str().expect("UTF-8"))
}

/// The name of an act in messages, and the act.
type Act<'a> = (&'a str, &'a dyn Fn(&Graph));

/// Acts on a graph soon after an epoch has begun, an epoch for each act: the histories have samples of two epochs then. It must
/// not disturb the graph.
fn act_in_new_epochs(changes: &[(String, String)], n_restarts: u64, acts: &[Act<'_>]) {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = patient(folder.path(), &[changes, &[of_many_epochs(folder.path())]].concat());
    let graph = paused(&flow, N_FRAMES, &[]);
    for (epoch, (what, act)) in (1..).zip(acts) {
        let n_frames = epoch * N_FRAMES + 70;
        let_send(&graph, n_frames);
        wait_for_answers(&graph, n_frames);
        act(&graph);
        assert!(!graph.said().contains("is degraded"), "{what}: {}", graph.said());
    }
    let_finish(&graph);
    let ended = end(graph);
    assert_whole(&ended, &decisions_of(&flow), n_restarts, "acts in new epochs");
    assert_eq!(ended.summary["edges"][0]["sent"], 12 * N_FRAMES);
}

fn swap_at_once(graph: &Graph, node: &str) {
    swap(graph, &[node, "--probation", "0"], 0);
}

#[test]
fn nodes_killed_or_swapped_in_a_new_epoch_lose_nothing() {
    let acts: [Act<'_>; 11] = [
        ("contacts killed", &|graph| graph.kill("contacts")),
        ("encoder killed", &|graph| graph.kill("encoder")),
        ("classifier killed", &|graph| graph.kill("classifier")),
        ("arbiter killed", &|graph| graph.kill("lift_arbiter")),
        ("source killed", &|graph| graph.kill("recorded_source")),
        ("contacts swapped", &|graph| swap_at_once(graph, "contacts")),
        ("encoder swapped", &|graph| swap_at_once(graph, "encoder")),
        ("classifier swapped", &|graph| swap_at_once(graph, "classifier")),
        ("arbiter swapped", &|graph| swap_at_once(graph, "lift_arbiter")),
        ("source swapped", &|graph| swap_at_once(graph, "recorded_source")),
        // Each node finds samples of two epochs.
        ("all killed", &|graph| {
            kill(&NODES.map(|node| graph.pid_of(node)));
            NODES.iter().for_each(|node| graph.wait_for_restart(node, 2));
        }),
    ];
    act_in_new_epochs(&[], 10, &acts);
}

/// A classifier in Python, in a role of `tests/python_roles.py`.
fn python_classifier(folder: &Path, role: &str) -> (String, String) {
    let program = python_operator(folder, &project().join("tests/python_roles.py"));
    let (what, by) = classifier_runs(&program, "{}");
    (what, by.replace("    params:", &format!("    args: [{role}]\n    params:")))
}

#[test]
fn a_python_stage_killed_or_swapped_in_a_new_epoch_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let python = [python_classifier(folder.path(), "plain")];
    let acts: [Act<'_>; 2] = [
        ("a stage in Python killed", &|graph| graph.kill("classifier")),
        ("a stage in Python swapped", &|graph| swap_at_once(graph, "classifier")),
    ];
    act_in_new_epochs(&python, 1, &acts);
}

/// A swap that is on probation until its graph ends.
struct Probation {
    command: Child,
    _said: BufReader<ChildStderr>,
}

impl Probation {
    fn begin(graph: &Graph, node: &str) -> Probation {
        let mut command = blindgrasp();
        command.args(["swap", node, "--probation", "60", "--graph", &graph.name]);
        let mut command = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("started");
        let mut said = BufReader::new(command.stderr.take().expect("piped"));
        let is_on_probation = said.by_ref().lines().any(|line| line.expect("read").contains("on probation"));
        assert!(is_on_probation, "{node} is not swapped: {}", graph.said());
        Probation { command, _said: said }
    }
}

impl Drop for Probation {
    fn drop(&mut self) {
        let _ = self.command.kill();
        let _ = self.command.wait();
    }
}

/// On the probation of a swap, the old process, which alone has the samples that the reader has not taken, and the reader die.
fn kill_the_old_one_and_its_reader(writer: &str, reader: &str, changes: &[(String, String)]) {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = patient(folder.path(), changes);
    let graph = Graph::start(&flow, &[&FAST_FOREVER[..], &["--wait-limit", "20"]].concat());
    let old = graph.pid_of(writer);
    let slow = stop_until_the_source_waits(&graph, reader);
    let probation = Probation::begin(&graph, writer);
    kill(&[old, slow]);
    graph.wait_for_restart(reader, 1);
    graph.wait_for_restart(writer, 1);
    graph.wait_for_decisions(2 * A_FEW_GRASPS);
    let ended = graph.stop();
    drop(probation);
    // The new process begins again as well, after the last sample that is answered.
    assert_whole(&ended, &decisions_of(&flow), 2, &format!("the old {writer} and {reader} killed"));
}

#[test]
fn an_old_process_and_its_reader_killed_on_probation() {
    for pair in NODES.windows(2) {
        kill_the_old_one_and_its_reader(pair[0], pair[1], &[]);
    }
    // With a state, the samples that the reader has not taken are among the saved answers.
    kill_the_old_one_and_its_reader("classifier", "lift_arbiter", &[change(MODEL, LIFTS)]);
}

/// A process that can open no more files, for as long as this lives.
struct WithoutDescriptors {
    pid: Pid,
    before: Rlimit,
}

impl WithoutDescriptors {
    fn of(pid: i32) -> WithoutDescriptors {
        // It keeps those that it has, and every number below is taken.
        let none_left = Rlimit { current: Some(4), ..getrlimit(Resource::Nofile) };
        let pid = Pid::from_raw(pid).expect("a pid");
        let before = prlimit(Some(pid), Resource::Nofile, none_left).expect("limited");
        WithoutDescriptors { pid, before }
    }
}

impl Drop for WithoutDescriptors {
    fn drop(&mut self) {
        // It may have been started again.
        let _ = prlimit(Some(self.pid), Resource::Nofile, self.before);
    }
}

/// Whether a node has looked for samples and neighbours since then, which it does ten times a second.
fn has_looked_since(graph: &Graph, node: &str, since: Instant) -> bool {
    let age = graph.node(node)["heartbeat_age_millis"].as_u64().map(Duration::from_millis);
    age.is_some_and(|age| since.elapsed() > age + Duration::from_millis(500))
}

/// Nodes, one after the other, have no free descriptor when a neighbour, their reader or their writer, is started again, so that
/// they cannot connect to it at once.
#[test]
fn a_node_that_cannot_connect_to_a_neighbour_at_once_connects_later() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = paused(&patient(folder.path(), &[]), 100, &["--wait-limit", "20"]);
    let n_restarts = |node: &str| graph.node(node)["n_restarts"].as_u64().expect("a count");
    let mut n_frames = 100;
    let mut connect_later = |deaf: &str, killed: &str, reader: &str| {
        let n_before = n_restarts(deaf);
        let limited = WithoutDescriptors::of(graph.pid_of(deaf));
        graph.kill(killed);
        n_frames += 10;
        let_send(&graph, n_frames);
        // Then it has tried, or has failed and is started again.
        let is_sent = || count(&graph, input_of(reader), "sent") >= n_frames;
        let has_failed = || n_restarts(deaf) > n_before;
        let describe = || format!("{deaf}: {}\n{}", edge_counts(&graph.status()), graph.said());
        wait_until(|| is_sent() || has_failed(), describe);
        let sent_at = Instant::now();
        wait_until(|| has_looked_since(&graph, deaf, sent_at) || has_failed(), describe);
        drop(limited);
        wait_for_answers(&graph, n_frames);
    };
    for pair in NODES.windows(2) {
        connect_later(pair[0], pair[1], pair[1]);
        connect_later(pair[1], pair[0], pair[1]);
    }
    let_finish(&graph);
    let ended = end(graph);
    // A node that cannot connect may fail and be started again.
    let n_restarts = ended.summary["restarts"].as_u64().expect("a count");
    assert!((8..=16).contains(&n_restarts), "8 kills, {n_restarts} restarts: {}", ended.stderr);
    assert_whole(&ended, undisturbed(), n_restarts, "nodes without descriptors");
}

/// The runs need about seventy descriptors: all programs begin at once.
#[test]
fn a_run_with_few_descriptors_loses_nothing_or_is_refused_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &[]);
    let (mut n_whole, mut n_refused) = (0, 0);
    for n_files in (16..=100).step_by(21) {
        let mut limited = Command::new("sh");
        let exec = format!("ulimit -n {n_files} && exec \"$0\" \"$@\"");
        limited.args(["-c", &exec, program()]).current_dir(project());
        limited.env("XDG_STATE_HOME", folder.path()).stdin(Stdio::null());
        let ended = Graph::launch_on(limited, &unique_name(), &flow, &AS_FAST_AS_IT_GOES).finish();
        if ended.code == Some(1) && ended.decisions.is_empty() {
            let said = ended.stderr.to_lowercase();
            let words = ["open files", "descriptors", "ulimit -n"];
            assert!(words.iter().any(|word| said.contains(word)), "{n_files}: {said}");
            n_refused += 1;
            continue;
        }
        assert_whole(&ended, undisturbed(), 0, &format!("{n_files} descriptors"));
        for line in &ended.decisions {
            assert_eq!(line["truth"]["grasp_id"], line["grasp_id"], "{n_files} descriptors: {line}");
        }
        n_whole += 1;
    }
    assert!(n_whole > 0 && n_refused > 0, "{n_whole} runs were whole, {n_refused} refused");
}

/// The wrist is ahead of the hand, so that the stage that joins them has samples that no frame has needed.
#[test]
fn a_partners_writer_and_the_joining_stage_killed_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let nodes = format!(
        "operators:\n  wrist:\n    run: recorded_source\n    heartbeat_ms: 60000\n    params: {{recording: {RECORDING}}}\n  \
         senses:\n    heartbeat_ms: 60000\n    inputs:\n      tactile: recorded_source/tactile\n      senses: {{from: \
         wrist/tactile, tolerance_ms: 0, partner_wait_ms: 10000}}\n    params: {{hand: {HAND}}}\n"
    );
    let changes =
        [change("operators:\n", &nodes), change("{tactile: recorded_source/tactile}", "{tactile: senses/tactile}")];
    let flow = patient(folder.path(), &changes);
    let wrist = ["--set", "wrist.rate=16", "--set", "wrist.steps=100", "--wait-limit", "20"];
    let graph = paused(&flow, 100, &wrist);
    set(&graph, "wrist.steps=300");
    wait_for_count(&graph, "senses/senses", "sent", 300);
    let_send(&graph, 150);
    wait_for_answers(&graph, 150);
    kill(&[graph.pid_of("wrist"), graph.pid_of("senses")]);
    for node in ["wrist", "senses"] {
        graph.wait_for_restart(node, 1);
    }
    set(&graph, "wrist.steps=400");
    let_send(&graph, 300);
    wait_for_answers(&graph, 300);
    set(&graph, "wrist.steps=unlimited");
    let_finish(&graph);
    let ended = end(graph);
    let without = &ended.summary["counts"]["senses"]["senses_without_partner"];
    assert!(without.is_null(), "{without} frames have no partner: {}", ended.stderr);
    assert_whole(&ended, undisturbed(), 2, "wrist and senses killed");
}

/// A grasp has so many frames.
const FRAMES_OF_A_GRASP: u64 = 14;

#[test]
fn a_sample_that_kills_a_program_among_others_is_left_out_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = patient(folder.path(), &[python_classifier(folder.path(), "mortal")]);
    let graph = paused(&flow, 90, &["--wait-limit", "60"]);
    // The program gets those that have come meanwhile at once, the deadly one among them.
    let host = graph.pid_of("classifier");
    signal(host, Signal::STOP);
    let_send(&graph, 130);
    wait_for_count(&graph, "classifier/feature", "sent", 130);
    signal(host, Signal::CONT);
    let_finish(&graph);
    let ended = end(graph);
    let Ended { summary, stderr, .. } = &ended;
    assert_eq!(summary["counts"]["classifier"]["quarantined"], 1, "quarantined\n{stderr}");
    assert!(stderr.contains("has died twice on sample 100: the sample is left without an answer"), "{stderr}");
    assert_eq!((ended.code, &summary["samples_lost"]), (Some(3), &1.into()), "{}\n{stderr}", edge_counts(summary));
    // The first death may say only that the sample is one of several.
    assert!([2, 3].map(Value::from).contains(&summary["restarts"]), "{stderr}");
    for edge in summary["edges"].as_array().expect("edges") {
        let n_missing = u64::from(edge["to"] == "lift_arbiter/prediction");
        assert_eq!((&edge["sent"], &edge["missing"]), (&edge["received"], &n_missing.into()), "{edge}");
    }
    let harmless = patient(folder.path(), &[python_classifier(folder.path(), "plain")]);
    let mut expected = decisions_of(&harmless);
    let of_sample = (100 / FRAMES_OF_A_GRASP) as usize;
    let word = |field: &str| ended.decisions[of_sample][field].as_str().expect("a word").to_owned();
    assert_eq!(word("action"), "hold", "{stderr}");
    expected[of_sample] = (word("action"), word("reason"));
    assert_eq!(ended.decisions.len(), expected.len(), "{stderr}");
    ended.assert_decided_as(&expected, "a deadly sample");
}

/// Swaps these nodes, contacts among them, right after contacts and encoder were started again, when the samples before them
/// have not come again. What the dead contacts had sent, the new ones have not sent yet. The swap may succeed or fail.
fn swap_before_all_is_sent_again(nodes: &[&str]) {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = paused(&patient(folder.path(), &[]), 100, &["--wait-limit", "20"]);
    let [source, contacts, encoder] = ["recorded_source", "contacts", "encoder"].map(|node| graph.pid_of(node));
    signal(encoder, Signal::STOP);
    let_send(&graph, 100 + CAPACITY);
    wait_for_count(&graph, "encoder/contacts", "sent", 100 + CAPACITY);
    signal(source, Signal::STOP);
    kill(&[contacts, encoder]);
    for node in ["contacts", "encoder"] {
        graph.wait_for_restart(node, 1);
    }
    let mut command = blindgrasp();
    command.arg("swap").args(nodes).args(["--probation", "0", "--graph", &graph.name]);
    let output = command.output().expect("started");
    signal(source, Signal::CONT);
    let_finish(&graph);
    assert_whole(&end(graph), undisturbed(), 2, &format!("swap {nodes:?}: {}", text(&output.stderr)));
}

/// If the encoder is swapped as well, it cannot answer the samples that the contacts have not sent again: they take back what
/// they have handed over.
#[test]
fn a_swap_before_all_is_sent_again_or_one_that_is_taken_back() {
    swap_before_all_is_sent_again(&["contacts"]);
    swap_before_all_is_sent_again(&["contacts", "encoder"]);
}

/// The default graph with classifier and arbiter in one process, which may stand still for as long as a test wants, and the
/// graph without that group.
fn grouped(folder: &Path, changes: &[(String, String)]) -> (PathBuf, PathBuf) {
    let alone = folder.join("alone");
    std::fs::create_dir(&alone).expect("a folder");
    let group = ["classifier", "lift_arbiter"].map(|node| of_node(node, &["group: judge", "heartbeat_ms: 60000"]));
    (dataflow_with(folder, &[changes, &group].concat()), dataflow_with(&alone, changes))
}

fn run_a_group_as_fast_as_it_goes(changes: &[(String, String)], what: &str) {
    let folder = tempfile::tempdir().expect("a folder");
    let (flow, alone) = grouped(folder.path(), changes);
    let arguments = [&AS_FAST_AS_IT_GOES[..], &["--set", "recorded_source.repeat=20"]].concat();
    let ended = end(Graph::launch(&unique_name(), &flow, &arguments));
    let expected = decisions_of(&alone);
    assert_whole(&ended, &expected, 0, what);
    assert_eq!(ended.decisions.len(), 20 * expected.len(), "{what}");
}

#[test]
fn a_group_that_begins_with_a_stage_with_a_state_runs_as_fast_as_it_goes() {
    run_a_group_as_fast_as_it_goes(&[change(MODEL, LIFTS)], "a group with a state");
}

const NARROW: u64 = 16;

/// Not as many samples fit between the two nodes of the group as the first one may answer.
fn narrow_edge() -> (String, String) {
    change("classifier/prediction}", &format!("{{from: classifier/prediction, capacity: {NARROW}}}}}"))
}

#[test]
fn a_group_with_a_narrow_edge_inside_runs_as_fast_as_it_goes() {
    run_a_group_as_fast_as_it_goes(&[narrow_edge()], "a group with a narrow edge");
}

#[test]
fn a_group_that_begins_with_a_stage_with_a_state_stands_still_and_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let (flow, alone) = grouped(folder.path(), &[change(MODEL, LIFTS), narrow_edge()]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    for _ in 0..2 {
        // The classifier answers together with the arbiter: it may have received some samples that count as unanswered.
        signal(stop_until_unanswered(&graph, "classifier", CAPACITY - NARROW), Signal::CONT);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    assert_whole(&graph.stop(), &decisions_of(&alone), 0, "a group that stood still");
}
