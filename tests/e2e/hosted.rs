//! Programs that get their samples over pipes: each kind of operator in Python, one in C++, and programs that break.

use std::path::{Path, PathBuf};
use std::process::Command;

use blindgrasp_operator::sandbox::supported;
use blindgrasp_operator::wiring::Enforcement;
use rustix::process::Signal;

use crate::common::python::{assert_each_once, python_operator, utf8};
use crate::common::{
    A_FEW_GRASPS, Ended, FAST_FOREVER, Graph, HAND, RECORDING, classifier_runs, dataflow, dataflow_with, of_node,
    project, run, script, signal, skipped, swap, text, unique_name, wait_until,
};

fn role(folder: &Path) -> PathBuf {
    python_operator(folder, &project().join("tests/python_roles.py"))
}

/// The program of a host.
fn child_of(host: i32) -> Option<i32> {
    let children = std::fs::read_to_string(format!("/proc/{host}/task/{host}/children")).ok()?;
    children.split_whitespace().next()?.parse().ok()
}

fn is_running(pid: i32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{pid}/stat"));
    status.is_ok_and(|status| !status.contains(") Z"))
}

fn assert_whole(ended: &Ended, what: &str) {
    ended.assert_undisturbed(what);
    assert_each_once(ended);
}

#[test]
fn a_partner_input_in_python_loses_neither_samples_nor_partners() {
    let folder = tempfile::tempdir().expect("a folder");
    let nodes = format!(
        "operators:\n  wrist:\n    run: recorded_source\n    params: {{recording: {RECORDING}}}\n  senses:\n    run: {}\n    \
         args: [senses]\n    inputs:\n      tactile: recorded_source/tactile\n      senses: {{from: wrist/tactile, \
         tolerance_ms: 0, partner_wait_ms: 60000}}\n    params: {{hand: {HAND}}}\n",
        role(folder.path()).display()
    );
    let replace =
        [("operators:\n", nodes.as_str()), ("{tactile: recorded_source/tactile}", "{tactile: senses/tactile}")];
    // So slow that the wrist's writer keeps all samples that come while an interpreter starts again on a busy machine.
    let slow = ["recorded_source.rate=2", "recorded_source.repeat=forever", "wrist.rate=2", "wrist.repeat=forever"];
    let mut options: Vec<&str> = slow.iter().flat_map(|set| ["--set", set]).collect();
    options.extend(["--wait-limit", "60"]);
    let graph = Graph::start(&dataflow(folder.path(), &replace), &options);
    for nodes in [["senses"].as_slice(), &["wrist"], &["senses", "contacts"]] {
        let before = graph.node("senses")["n_restarts"].as_u64().expect("a count");
        let pids: Vec<i32> = nodes.iter().map(|node| graph.pid_of(node)).collect();
        pids.iter().for_each(|pid| signal(*pid, Signal::KILL));
        if nodes.contains(&"senses") {
            graph.wait_for_restart("senses", before + 1);
        }
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    swap(&graph, &["senses", "--probation", "0.1"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert!(graph.node("senses")["counts"]["senses_without_partner"].is_null(), "{}", graph.node("senses"));
    assert_whole(&graph.stop(), "frames with partners in Python");
}

#[test]
fn a_python_stage_without_output_has_optional_inputs_counts_params_and_a_state() {
    let folder = tempfile::tempdir().expect("a folder");
    let node = format!(
        "operators:\n  watch:\n    run: {}\n    args: [watch]\n    inputs: {{prediction: classifier/prediction, feature: \
         encoder/feature}}\n    restart: {{policy: on-failure, limit: 100, within_s: 60, backoff_ms: 1}}\n",
        role(folder.path()).display()
    );
    let flow = dataflow(folder.path(), &[("operators:\n", &node)]);
    let graph = Graph::start(&flow, &[&FAST_FOREVER[..], &["--wait-limit", "60"]].concat());
    let count = |name: &str| graph.node("watch")["counts"][name].as_u64();
    for _ in 0..3 {
        graph.wait_for_decisions(A_FEW_GRASPS);
        graph.kill("watch");
    }
    swap(&graph, &["watch", "--probation", "0.1"], 0);
    run(&["set", "--graph", &graph.name, "watch.told=yes"], 0);
    wait_until(|| count("is_told") == Some(1), || graph.said());
    assert!(count("n_prediction") > Some(100) && count("n_feature") > Some(100), "{}", graph.node("watch"));
    assert!(count("n_other").is_none());
    let ended = graph.stop();
    assert_whole(&ended, "a stage without output");
    assert_eq!(ended.summary["restarts"], 3, "{}", ended.stderr);
}

#[test]
fn the_end_of_a_recording_waits_as_long_as_samples_are_answered() {
    let folder = tempfile::tempdir().expect("a folder");
    let watch =
        "args: [watch], params: {told: 'yes'}, inputs: {prediction: classifier/prediction, feature: encoder/feature}";
    let node = format!("operators:\n  watch: {{run: {}, {watch}}}\n", role(folder.path()).display());
    let flow = dataflow(folder.path(), &[("operators:\n", &node)]);
    let graph = Graph::start(
        &flow,
        &["--set", "recorded_source.to_s=8", "--set", "recorded_source.rate=max", "--grace", "0.3"],
    );
    assert_whole(&graph.finish(), "a reader that is half a second behind");
}

#[test]
fn a_python_source_with_feedback_is_killed_without_a_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let replace = crate::python::with_source(folder.path(), "device");
    let program = role(folder.path());
    let replace: Vec<(String, String)> = replace
        .into_iter()
        .map(|(what, by)| {
            let run = by.lines().find(|line| line.trim_start().starts_with("run:")).unwrap_or_default().to_owned();
            let node = format!(
                "    run: {}\n    args: [hand]\n    inputs: {{decision: lift_arbiter/decision}}",
                program.display()
            );
            (what, if run.is_empty() { by } else { by.replace(&run, &node) })
        })
        .collect();
    let flow = dataflow_with(folder.path(), &replace);
    let slowly = ["--set", "recorded_source.period_ms=3"];
    let arguments = [&["--set", "lift_arbiter.max_age_ms=600000", "--wait-limit", "60"], &slowly[..]].concat();
    let graph = Graph::launch(&unique_name(), &flow, &arguments);
    for _ in 0..3 {
        graph.wait_for_decisions(A_FEW_GRASPS);
        wait_until(|| graph.node("recorded_source")["pid"].is_i64(), || graph.said());
        graph.kill("recorded_source");
    }
    let ended = graph.finish();
    assert_whole(&ended, "a source with feedback");
    assert_eq!((ended.decisions.len(), &ended.summary["end"]), (240, &"finished".into()));
}

#[test]
fn a_python_stage_answers_silence_and_the_end_of_the_stream() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = role(folder.path());
    let nodes = format!(
        "operators:\n  nag:\n    run: {}\n    args: [nag]\n    inputs: {{tactile: recorded_source/tactile}}\n  watch:\n    \
         run: {}\n    args: [watch]\n    inputs: {{prediction: nag/prediction}}\n",
        program.display(),
        program.display()
    );
    // Grasps are further apart than the stage waits.
    let flow = dataflow(folder.path(), &[("operators:\n", &nodes)]);
    let graph = Graph::start(&flow, &["--set", "recorded_source.rate=1", "--set", "recorded_source.repeat=forever"]);
    let count = || graph.node("watch")["counts"]["n_prediction"].as_u64();
    wait_until(|| count() > Some(3), || graph.said());
    graph.kill("nag");
    let before = count();
    wait_until(|| count() > before.map(|n| n + 3), || graph.said());
    let ended = graph.stop();
    assert_each_once(&ended);
    assert_eq!(ended.summary["restarts"], 1, "{}", ended.stderr);
}

#[test]
fn a_program_that_dies_or_hangs_is_started_again_and_ends_with_its_host() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let program = python_operator(folder, &project().join("tests/python_ports.py"));
    let node = format!(
        "operators:\n  split:\n    run: {}\n    args: [split]\n    inputs: {{tactile: recorded_source/tactile}}\n    \
         heartbeat_ms: 1000\n",
        program.display()
    );
    let replace = [
        ("operators:\n", node.as_str()),
        ("{tactile: recorded_source/tactile}\n    sandbox", "{tactile: split/a}\n    sandbox"),
    ];
    let graph = Graph::start(&dataflow(folder, &replace), &[&FAST_FOREVER[..], &["--wait-limit", "60"]].concat());
    let child = |graph: &Graph| {
        wait_until(
            || graph.node("split")["pid"].as_i64().and_then(|pid| child_of(pid as i32)).is_some(),
            || graph.said(),
        );
        child_of(graph.pid_of("split")).expect("a program")
    };
    for (n_restarts, how) in [(1, Signal::KILL), (2, Signal::STOP)] {
        let program = child(&graph);
        signal(program, how);
        graph.wait_for_restart("split", n_restarts);
        graph.wait_for_decisions(A_FEW_GRASPS);
        wait_until(|| !is_running(program), || format!("{program} goes on"));
    }
    // A stopped program does not outlive its host.
    let (host, program) = (graph.pid_of("split"), child(&graph));
    signal(program, Signal::STOP);
    signal(host, Signal::KILL);
    wait_until(|| !is_running(program), || format!("{program} goes on"));
    graph.wait_for_restart("split", 3);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_whole(&ended, "a program that dies");
    assert!(ended.stderr.contains("its program ended (signal: 9 (SIGKILL))"), "{}", ended.stderr);
}

/// The state of an instance that is long gone must not come back: it names samples that no writer keeps any more.
#[test]
fn a_program_without_a_state_leaves_none_to_the_stage_that_takes_its_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::fast();
    let lifts = format!("model={}", project().join("models/barrett-bh8-280-lifts.json").display());
    swap(&graph, &["encoder", "classifier", "--set", &lifts, "--probation", "0"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let program = role(folder.path());
    let to_plain = ["classifier", "--run", utf8(&program), "--probation", "0", "--allow-mismatch", "--args", "plain"];
    swap(&graph, &to_plain, 0);
    // Fourteen frames a grasp: more than the 256 samples that the encoder keeps.
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.wait_for_decisions(A_FEW_GRASPS);
    swap(&graph, &["classifier", "--run", "classifier", "--set", &lifts, "--probation", "0"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &0.into()), "{}", ended.stderr);
    assert_each_once(&ended);
}

/// What one instance has saved, one in another language reads: its place, its answers, and the bytes of its state.
#[test]
fn a_stage_with_state_is_swapped_between_rust_and_python_and_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::fast();
    let lifts = format!("model={}", project().join("models/barrett-bh8-280-lifts.json").display());
    let to_rust = ["classifier", "--run", "classifier", "--set", &lifts, "--probation", "0", "--allow-mismatch"];
    swap(&graph, &["encoder", "classifier", "--set", &lifts, "--probation", "0"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let program = role(folder.path());
    // It fails if it finds no state; so does the classifier if it cannot read its own.
    let to_keeper = ["classifier", "--run", utf8(&program), "--probation", "0", "--allow-mismatch", "--args", "keeper"];
    for swap_to in [&to_keeper[..], &to_rust, &to_keeper] {
        swap(&graph, swap_to, 0);
        graph.wait_for_decisions(A_FEW_GRASPS);
        graph.kill("classifier");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &0.into()), "{}", ended.stderr);
    assert_each_once(&ended);
}

/// A classifier that says something else than it should.
const BROKEN: &str = r#"
import os, struct, sys
sys.path.insert(0, "OPERATORS")
from blindgrasp_operator import Description
from blindgrasp_messages import GraspFeature, Prediction
description = Description("broken", "Says nonsense", ("feature", GraspFeature), ("prediction", Prediction)).to_json()
import json
if "--describe" in sys.argv:
    print(json.dumps(description))
    sys.exit()
reader, writer = map(int, os.environ["BLINDGRASP_HOST"].split(","))
send = lambda kind, body: os.write(writer, struct.pack("=II", len(body), kind) + body)
say = {
    "nothing": lambda: sys.exit(3),
    "half": lambda: os.write(writer, struct.pack("=II", 100, 2) + b"half"),
    "kind": lambda: send(77, b""),
    "long": lambda: os.write(writer, struct.pack("=II", 1 << 30, 2)),
    "cut": lambda: send(2, struct.pack("=QII", 0, 0, 99)),
    "port": lambda: send(2, struct.pack("=QII4I", 0, 0, 0, 7, 0, 0, 0)),
    "length": lambda: send(2, struct.pack("=QII4I", 0, 0, 0, 0, 0, 5, 0) + b"12345"),
    "silent": lambda: send(2, struct.pack("=QII", 0, 0, 0)),
    "reason": lambda: send(4, "I cannot".encode()),
}[sys.argv[1]]
while frame := os.read(reader, 8):
    n_bytes, kind = struct.unpack("=II", frame)
    while n_bytes:
        n_bytes -= len(os.read(reader, n_bytes))
    if kind == 1:
        send(1, b"{}")
        continue
    say()
    if sys.argv[1] == "half":
        sys.exit()
"#;

#[test]
fn nonsense_of_a_program_is_told_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let path = folder.join("broken.py");
    std::fs::write(&path, BROKEN.replace("OPERATORS", utf8(&project().join("operators")))).expect("written");
    for (how, reason) in [
        ("nothing", "its program ended (exit status: 3), expected an answer to Sample"),
        ("half", "its program said a part of a message, and ended"),
        ("kind", "its program said a message of the unknown kind 77, expected one from 1 to 7"),
        ("long", "its program wants to send 1073741824 bytes at once, expected at most 16777216"),
        ("cut", "its message of 16 bytes has a state where they end"),
        ("port", "it answered on the output number 7, expected 0 to 0"),
        ("length", "its sample for the output prediction has a head of 5 bytes and items of 0"),
        ("silent", "it gave 0 answers on the output prediction"),
        ("reason", "I cannot"),
    ] {
        let program = script(folder, how, &format!("exec python3 -B {} {how} \"$@\"", path.display()));
        let flow =
            dataflow_with(folder, &[classifier_runs(&program, "{}"), of_node("classifier", &["restart: never"])]);
        let output = run(&["run", "--json", "--name", &unique_name(), utf8(&flow)], 1);
        let said = text(&output.stderr);
        assert!(said.contains("node 'classifier' failed: ") && said.contains(reason), "{how}: {said}");
    }
}

/// A classifier that tries what a sandbox denies.
const INTRUDER: &str = r#"
import os, socket, sys
sys.path.insert(0, "OPERATORS")
from blindgrasp_operator import Description, Param, Stage, run
from blindgrasp_messages import GraspFeature, Prediction, PredictionHead

def start(params):
    attempts = {
        "write a file": lambda: open("FOLDER/forged", "w"),
        "write shared memory": lambda: open("/dev/shm/blindgrasp-forged", "w"),
        "connect": lambda: socket.create_connection(("127.0.0.1", 9)),
        "reach a launcher": lambda: socket.socket(socket.AF_UNIX),
        "send a signal": lambda: os.kill(os.getppid(), 0),
    }
    for what, attempt in attempts.items():
        try:
            attempt()
            print(what, "done", sep=": ")
        except Exception as error:
            print(what, type(error).__name__, sep=": ")
    open(os.devnull, "w").write("its own")
    open(params["out"], "w").write("its own")
    return Stage(lambda head, items: PredictionHead(grasp_id=head.grasp_id, phase=head.phase, fault=head.fault))

out = Param("out", "path", must_exist=False)
run(Description("intruder", "", ("feature", GraspFeature), ("prediction", Prediction), [out]), start)
"#;

#[test]
fn a_program_in_a_sandbox_gives_up_all_but_reading_and_running() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let path = folder.join("intruder.py");
    let program = INTRUDER.replace("OPERATORS", utf8(&project().join("operators"))).replace("FOLDER", utf8(folder));
    std::fs::write(&path, program).expect("written");
    std::fs::create_dir(folder.join("out")).expect("a folder");
    let program = script(folder, "intruder", &format!("exec python3 -B {} \"$@\"", path.display()));
    let runs = classifier_runs(&program, &format!("{{out: {}}}", folder.join("out/own").display()));
    let flow = dataflow_with(folder, std::slice::from_ref(&runs));
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let said = |line: &str| wait_until(|| graph.said().contains(line), || format!("{line}: {}", graph.said()));
    said("node 'classifier' has 'sandbox: on', but it is restricted in part only");
    for (attempt, error) in [
        ("write a file", "PermissionError"),
        ("write shared memory", "PermissionError"),
        ("connect", "PermissionError"),
        ("reach a launcher", "PermissionError"),
        ("send a signal", "PermissionError"),
    ] {
        said(&format!("[classifier] {attempt}: {error}"));
    }
    graph.kill("classifier");
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert_each_once(&graph.stop());
    let required = ("sandbox: on".to_string(), "sandbox: required".to_string());
    let flow = dataflow_with(folder, &[runs, required]);
    let refused = text(&run(&["run", "--name", &unique_name(), utf8(&flow)], 1).stderr);
    assert!(refused.contains("its sandbox is required, and it is restricted in part only"), "{refused}");
}

#[test]
fn the_operator_in_cpp_of_the_docs_compiles_and_runs() {
    if Command::new("g++").arg("--version").output().is_err() {
        return skipped("there is no g++");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let page = std::fs::read_to_string(project().join("docs/operators.md")).expect("readable");
    let (_, code) = page.split_once("```cpp\n").expect("code in C++");
    let (code, _) = code.split_once("```").expect("its end");
    let (source, program) = (folder.join("judge.cpp"), folder.join("judge"));
    std::fs::write(&source, code).expect("written");
    let compiled = Command::new("g++")
        .args(["-std=c++17", "-O2", "-Wall", "-Werror", "-o", utf8(&program), utf8(&source)])
        .output()
        .expect("started");
    assert!(compiled.status.success(), "{}", text(&compiled.stderr));
    let graph = Graph::start(&dataflow(folder, &[]), &FAST_FOREVER);
    let (swapped, _) = swap(&graph, &["classifier", "--run", utf8(&program), "--probation", "0.3"], 0);
    assert_eq!(swapped["result"], "swapped", "{swapped}");
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.kill("classifier");
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_each_once(&ended);
    assert!(ended.decisions.iter().any(|line| line["action"] == "lift"), "{}", ended.summary);
}
