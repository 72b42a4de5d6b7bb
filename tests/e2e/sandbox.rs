//! Operators that give up what their work does not need, and those that are given little memory.

use blindgrasp_operator::sandbox::supported;
use blindgrasp_operator::wiring::Enforcement;

use crate::common::{
    FAST_FOREVER, Graph, MODEL, NODES, classifier_runs, dataflow, dataflow_with, of_node, operator, run, script,
    skipped, stubborn_classifier, swap, text, unique_name, wait_until,
};

/// What the intruder tries.
const ATTEMPTS: [&str; 6] = ["run a program", "read a file", "write a file", "listen", "connect", "reach a launcher"];

fn intruder() -> (String, String) {
    classifier_runs(&stubborn_classifier(), "{intrudes: true}")
}

/// Waits until the intruder has said this of each attempt.
fn wait_for_each(graph: &Graph, outcome: &str) {
    let said = |what: &&str| graph.said().contains(&format!("[classifier] {what}: {outcome}"));
    wait_until(|| ATTEMPTS.iter().all(&said), || format!("expected {outcome}: {}", graph.said()));
}

#[test]
fn an_operator_in_a_sandbox_can_do_nothing_but_its_work() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow_with(folder.path(), &[intruder()]), &FAST_FOREVER);
    wait_for_each(&graph, "PermissionDenied");
    // It is supervised, set, swapped and recorded as ever, and so is its replacement.
    graph.kill("classifier");
    run(&["set", "lift_arbiter.votes=4", "--graph", &graph.name], 0);
    run(&["set", "recorded_source.rate=8", "--graph", &graph.name], 0);
    let model = format!("model={MODEL}");
    swap(&graph, &["classifier", "--run", "classifier", "--set", &model, "--probation", "0.1"], 0);
    swap(&graph, &["recorded_source", "--probation", "0.1"], 0);
    let recording = folder.path().join("some.mcap");
    run(&["record", &graph.name, "--for", "0.3", "--out", recording.to_str().expect("UTF-8")], 0);
    // The recording is opened again for its second repetition.
    graph.wait_for_decisions(150);
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
}

#[test]
fn an_operator_without_a_sandbox_can_do_what_its_user_can() {
    let folder = tempfile::tempdir().expect("a folder");
    let off = ("sandbox: on".to_string(), "sandbox: off".to_string());
    let graph = Graph::start(&dataflow_with(folder.path(), &[intruder(), off]), &FAST_FOREVER);
    wait_for_each(&graph, "done");
    // But no program that it runs gets more rights.
    for node in NODES {
        let status = std::fs::read_to_string(format!("/proc/{}/status", graph.pid_of(node))).expect("there");
        assert!(status.lines().any(|line| line == "NoNewPrivs:\t1"), "{node}: {status}");
    }
    graph.stop();
}

#[test]
fn a_program_that_does_not_restrict_itself_is_told_of_or_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let body = format!(
        "case \"$*\" in *--describe*) exec {} --describe;; esac\necho '@blindgrasp {{\"report\": \"ready\"}}'\nexec cat",
        operator("classifier")
    );
    let program = script(folder.path(), "classifier", &body);
    let runs = || classifier_runs(&program, &format!("{{model: {MODEL}}}"));
    let graph = Graph::launch(&unique_name(), &dataflow_with(folder.path(), &[runs()]), &FAST_FOREVER);
    let told = "node 'classifier' has 'sandbox: on', but it is not restricted";
    wait_until(|| graph.said().contains(told), || graph.said());
    drop(graph);
    let required = ("sandbox: on".to_string(), "sandbox: required".to_string());
    let flow = dataflow_with(folder.path(), &[runs(), required]);
    let refused = run(&["run", "--name", &unique_name(), flow.to_str().expect("UTF-8")], 1);
    let said = text(&refused.stderr);
    assert!(said.contains("node 'classifier' failed: its sandbox is required, and it is not restricted"), "{said}");
}

#[test]
fn an_operator_that_takes_more_memory_than_it_may_is_started_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let hoarder = classifier_runs(&stubborn_classifier(), "{hoarded_mib: 512}");
    let flow = dataflow_with(folder.path(), &[hoarder, of_node("classifier", &["memory_max_mib: 256"])]);
    let graph = Graph::launch(&unique_name(), &flow, &FAST_FOREVER);
    for part in [
        "[classifier] memory allocation of 536870912 bytes failed",
        "node 'classifier' was killed (signal 6; its memory_max_mib is 256); it is started again",
    ] {
        wait_until(|| graph.said().contains(part), || format!("expected '{part}': {}", graph.said()));
    }
    drop(graph);
    // The shipped operators need far less, and their shared memory does not count.
    let modest = NODES.map(|node| of_node(node, &["memory_max_mib: 64"]));
    let flow = dataflow_with(folder.path(), &modest);
    run(&["run", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow.to_str().expect("UTF-8")], 0);
}

#[test]
fn the_projects_graphs_run_in_full_sandboxes() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("sandbox: on", "sandbox: required")]);
    run(&["run", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow.to_str().expect("UTF-8")], 0);
}
