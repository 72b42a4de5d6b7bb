//! A launcher that is killed, stopped, asked, or given a disk that blocks: the graph goes on, or ends whole.

use std::os::unix::fs::DirBuilderExt;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::common::{
    A_FEW_GRASPS, FAST_FOREVER, Graph, assert_nothing_left, blindgrasp, classifier_runs, dataflow, dataflow_with,
    fails, of_node, operator, program, project, run, script, signal, stubborn_classifier, text, unique_name,
    wait_until,
};
use rustix::process::Signal;

/// An endless loop hears neither a signal nor the end of its stdin.
#[test]
fn an_operator_that_hangs_ends_with_a_launcher_that_is_killed() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, hanging) = classifier_runs(&stubborn_classifier(), "{hang_after: 50}");
    let watched = of_node("classifier", &["heartbeat_ms: off"]);
    let graph = Graph::start(&dataflow_with(folder.path(), &[(whole, hanging), watched]), &FAST_FOREVER);
    let hangs = || graph.node("classifier")["heartbeat_age_millis"].as_u64().is_some_and(|age| age > 500);
    wait_until(hangs, || format!("it does not hang: {}", graph.node("classifier")));
    signal(graph.pid(), Signal::KILL);
    assert_nothing_left(&graph.name);
}

/// The log of an operator that prints without end is a pipe that nobody reads.
#[test]
fn a_log_that_blocks_stops_neither_supervision_nor_decisions() {
    // A pipe takes a part of a long write, and a report of the operator may come before the rest.
    const FLOOD: &str = "import os\nlines = b\"flood\\n\" * 20000\nwhile True: os.write(1, lines)";
    let (folder, name) = (tempfile::tempdir().expect("a folder"), unique_name());
    let logs = folder.path().join("state/blindgrasp").join(&name);
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(&logs).expect("a folder");
    assert!(Command::new("mkfifo").arg(logs.join("contacts.log")).status().expect("mkfifo is there").success());
    let flood = script(
        folder.path(),
        "contacts.sh",
        &format!(
            "if [ \"$1\" = --describe ]; then exec {real} \"$@\"; fi\npython3 -c '{FLOOD}' &\nexec {real}",
            real = operator("contacts")
        ),
    );
    let flow = dataflow_with(folder.path(), &[of_node("contacts", &[&format!("run: {}", flood.display())])]);
    let mut command = blindgrasp();
    command.env("XDG_STATE_HOME", folder.path().join("state"));
    let graph = Graph::launch_on(command, &name, &flow, &FAST_FOREVER);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.kill("classifier");
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("a log that blocks");
}

/// An operator that hears no command is asked to take a parameter, and another one dies meanwhile.
#[test]
fn a_command_that_waits_for_one_operator_delays_no_restart_of_another() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &[of_node("lift_arbiter", &["heartbeat_ms: off"])]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let arbiter = graph.pid_of("lift_arbiter");
    signal(arbiter, Signal::STOP);
    let mut setting = blindgrasp();
    setting.args(["set", "lift_arbiter.votes=3", "--graph", &graph.name]).stderr(Stdio::piped());
    let mut setting = setting.spawn().expect("started");
    std::thread::sleep(Duration::from_millis(300));
    graph.kill("contacts");
    assert!(setting.try_wait().expect("looked").is_none(), "the command has not waited, and this test tests nothing");
    let answer = setting.wait_with_output().expect("waited");
    assert!(text(&answer.stderr).contains("did not take the value within 5 s"), "{}", text(&answer.stderr));
    signal(arbiter, Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("a command that waited");
}

/// With all edges recorded, the launching command reads them. A writer does not wait for it so long that it fails; samples
/// that it could not record are counted.
#[test]
fn a_launcher_that_is_stopped_does_not_stop_the_graph() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("all.mcap");
    let record = ["--record", recording.to_str().expect("UTF-8"), "--wait-limit", "2"];
    let graph = Graph::start(&dataflow(folder.path(), &[]), &[&FAST_FOREVER[..], &record].concat());
    signal(graph.pid(), Signal::STOP);
    std::thread::sleep(Duration::from_secs(4));
    signal(graph.pid(), Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["restarts"]), (Some(3), &0.into()), "{}\n{}", ended.summary, ended.stderr);
    let edges = ended.summary["edges"].as_array().expect("edges");
    let lost_by = |edge: &&serde_json::Value| edge["missing"] != 0 || edge["dropped"] != 0;
    let losing: Vec<_> = edges.iter().filter(lost_by).map(|edge| edge["to"].clone()).collect();
    assert!(!losing.is_empty() && losing.iter().all(|to| to == "run"), "{losing:?}");
}

#[test]
fn decisions_that_cannot_be_written_are_an_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max")]);
    for arguments in [&["run"][..], &["run", "--json"]] {
        let mut command = blindgrasp();
        command.args(arguments).args(["--name", &unique_name()]).arg(&flow);
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").expect("there");
        let output = command.stdout(full).stderr(Stdio::piped()).spawn().expect("started").wait_with_output();
        let output = output.expect("waited");
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.contains("could not be written to stdout") && stderr.contains("No space left"), "{stderr}");
    }
}

/// The program behind `run --json | program` dies.
#[test]
fn a_reader_of_the_decisions_that_has_gone_is_told_of_and_the_graph_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let (name, said) = (unique_name(), folder.path().join("said"));
    let mut command = blindgrasp();
    command.args(["run", "--json", "--name", &name]).args(FAST_FOREVER).arg(dataflow(folder.path(), &[]));
    let stderr = std::fs::File::create(&said).expect("made");
    let mut graph = command.stdout(Stdio::piped()).stderr(stderr).spawn().expect("started");
    drop(graph.stdout.take());
    let has_said = || std::fs::read_to_string(&said).expect("read");
    wait_until(|| has_said().contains("stdout takes no more lines"), has_said);
    run(&["stop", &name], 0);
    assert_eq!(graph.wait().expect("waited").code(), Some(0), "{}", has_said());
}

/// The reason of a program that fails at its start is in the message, and it is not tried again and again.
#[test]
fn a_permanent_error_ends_at_once_and_says_why() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::fast();
    let broken = script(folder.path(), "broken.py", "echo \"TypeError: not a model\" >&2; exit 1");
    let broken = broken.to_str().expect("UTF-8");
    fails(&["swap", "classifier", "--run", broken, "--graph", &graph.name], "TypeError: not a model");
    // The model's file is damaged while the graph runs.
    let model = folder.path().join("model.json");
    std::fs::copy(crate::common::MODEL, &model).expect("copied");
    let set = format!("model={}", model.display());
    run(&["swap", "classifier", "--set", &set, "--probation", "0", "--graph", &graph.name], 0);
    std::fs::write(&model, "{}").expect("written");
    signal(graph.pid_of("classifier"), Signal::KILL);
    wait_until(|| graph.node("classifier")["state"] == "failed", || graph.said());
    assert!(graph.said().contains("twice in a row at its start"), "{}", graph.said());
    assert_eq!(graph.node("classifier")["n_restarts"], 2, "{}", graph.said());
    let ended = graph.stop();
    assert_eq!(ended.code, Some(1), "{}", ended.stderr);
}

#[test]
fn a_launcher_and_its_operators_may_have_as_many_descriptors_as_the_hard_limit() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut limited = Command::new("prlimit");
    limited.args(["--nofile=512:3456", program()]).current_dir(project());
    limited.stdin(Stdio::null()).env("XDG_STATE_HOME", folder.path());
    let graph = Graph::launch_on(limited, &unique_name(), &dataflow(folder.path(), &[]), &FAST_FOREVER);
    graph.wait_for_decisions(1);
    for pid in [i64::from(graph.pid()), graph.node("classifier")["pid"].as_i64().expect("a process")] {
        let limits = std::fs::read_to_string(format!("/proc/{pid}/limits")).expect("readable");
        let line = limits.lines().find(|line| line.starts_with("Max open files")).expect("a limit");
        let found: Vec<&str> = line.split_whitespace().skip(3).take(2).collect();
        assert_eq!(found, ["3456", "3456"], "{pid}: {line}");
    }
    graph.stop();
}
