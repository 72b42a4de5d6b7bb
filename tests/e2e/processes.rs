//! Processes of nodes: nodes that share one, options that the kernel grants, and late samples.

use std::path::{Path, PathBuf};

use crate::common::{
    A_FEW_GRASPS, FAST_FOREVER, Graph, NODES, dataflow_with, of_node, project, run, signal, swap, text,
};
use rustix::process::Signal;
use serde_json::Value;

const GROUP: &str = "group: judge";

/// The default graph with these nodes in one process.
fn grouped(folder: &Path, nodes: &[&str], heartbeat_ms: u32) -> PathBuf {
    let heartbeat = format!("heartbeat_ms: {heartbeat_ms}");
    let restart = "restart: {policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}";
    let lines = |node: &str| {
        let mut lines = vec![restart, &heartbeat];
        lines.extend(nodes.contains(&node).then_some(GROUP));
        of_node(node, &lines)
    };
    dataflow_with(folder, &NODES.map(lines))
}

/// The processes of the nodes, and how often each of these was started again.
fn pids_and_restarts(graph: &Graph) -> (Vec<i32>, Vec<Value>) {
    let restarts = NODES.map(|node| graph.node(node)["n_restarts"].clone());
    (NODES.map(|node| graph.pid_of(node)).to_vec(), restarts.to_vec())
}

#[test]
fn a_group_is_killed_and_hangs_as_one_process_and_its_nodes_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    // A group of all stages; one at the start and one in the middle, whose neighbours have processes of their own.
    for nodes in [&NODES[1..], &NODES[1..3], &NODES[2..4]] {
        let graph = Graph::start(&grouped(folder.path(), nodes, 400), &FAST_FOREVER);
        let (pids, _) = pids_and_restarts(&graph);
        let of_group: Vec<i32> = nodes.iter().map(|node| graph.pid_of(node)).collect();
        assert!(of_group.iter().all(|pid| *pid == of_group[0]), "{of_group:?}");
        assert_eq!(pids.iter().filter(|pid| **pid == of_group[0]).count(), nodes.len());
        graph.wait_for_decisions(A_FEW_GRASPS);
        let mut n_restarts = 0;
        let mut disturb = |how: Signal, others: &[&str]| {
            let pids: Vec<i32> = others.iter().chain(&nodes[..1]).map(|node| graph.pid_of(node)).collect();
            pids.iter().for_each(|pid| signal(*pid, how));
            n_restarts += 1;
            nodes.iter().for_each(|node| graph.wait_for_restart(node, n_restarts));
            graph.wait_for_decisions(A_FEW_GRASPS);
        };
        disturb(Signal::KILL, &[]);
        // With the source, whose samples the group had not answered.
        disturb(Signal::KILL, &["recorded_source"]);
        disturb(Signal::STOP, &[]);
        (0..3).for_each(|_| disturb(Signal::KILL, &[]));
        // A node outside the group that reads from it, or that it reads from.
        if let Some(other) = NODES[1..].iter().find(|node| !nodes.contains(node)) {
            let before = graph.node(other)["n_restarts"].as_u64().expect("a count");
            signal(graph.pid_of(other), Signal::KILL);
            graph.wait_for_restart(other, before + 1);
            graph.wait_for_decisions(A_FEW_GRASPS);
        }
        graph.stop().assert_undisturbed("a killed group");
    }
}

#[test]
fn a_group_is_swapped_together_and_takes_parameters_of_each_node() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&grouped(folder.path(), &NODES[1..], 2000), &FAST_FOREVER);
    for (node, probation) in [("contacts", "0.1"), ("classifier", "0"), ("lift_arbiter", "0.1"), ("encoder", "0")] {
        let old = graph.pid_of(node);
        let (swapped, _) = swap(&graph, &[node, "--probation", probation], 0);
        let nodes = swapped["nodes"].as_array().expect("nodes");
        assert_eq!(nodes.iter().map(|node| node["node"].clone()).collect::<Vec<_>>(), NODES[1..], "{swapped}");
        let new = graph.pid_of(node);
        assert!(nodes.iter().all(|node| node["old_pid"] == old && node["new_pid"] == new && old != new), "{swapped}");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Together with the source, and a replacement beside a killed group.
    swap(&graph, &["recorded_source", "encoder", "--probation", "0.1"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    run(&["set", "lift_arbiter.votes=4", "--graph", &graph.name], 0);
    let shown = |what: &[&str]| text(&run(&[&["set", "--graph", &graph.name], what].concat(), 0).stdout);
    assert_eq!(shown(&["lift_arbiter.votes"]), "4\n");
    let of_node = shown(&["lift_arbiter"]);
    let votes = of_node.lines().find(|line| line.starts_with("lift_arbiter.votes ")).expect("listed");
    assert_eq!(votes.split_whitespace().collect::<Vec<_>>(), ["lift_arbiter.votes", "4", "live"]);
    assert!(shown(&[]).contains("encoder.model") && !of_node.contains("encoder.model"), "{of_node}");
    assert!(shown(&["--json"]).contains(r#"{"live":true,"node":"lift_arbiter","param":"votes","value":4}"#));
    let unknown = text(&run(&["set", "--graph", &graph.name, "lift_arbiter.vote"], 1).stderr);
    assert!(unknown.contains("no parameter 'vote'") && unknown.contains("votes"), "{unknown}");
    run(&["set", "lift_arbiter.votes=3", "--graph", &graph.name], 0);
    // One program cannot stand for all.
    let (_, said) = swap(&graph, &["classifier", "--run", "classifier"], 1);
    assert!(said.contains("The nodes of a group are swapped together"), "{said}");
    // A replacement that cannot start changes nothing.
    let before = graph.pid_of("contacts");
    let hand = project().join("hands/barrett-bh8-280.yaml");
    let (_, said) = swap(&graph, &["encoder", "--set", &format!("model={}", hand.display())], 1);
    assert!(said.contains("node 'encoder'"), "{said}");
    assert_eq!(graph.pid_of("contacts"), before);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    ended.assert_undisturbed("swaps of a group");
    assert_eq!(ended.summary["restarts"], 0, "{}", ended.stderr);
}

#[test]
fn a_recording_of_a_group_has_the_samples_of_each_of_its_nodes() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = grouped(folder.path(), &NODES[1..], 2000);
    let recording = folder.path().join("all.mcap");
    let (flow, recorded) = (flow.to_str().expect("UTF-8"), recording.to_str().expect("UTF-8"));
    let graph = crate::common::unique_name();
    run(&["run", flow, "--name", &graph, "--set", "recorded_source.rate=max", "--record", recorded], 0);
    let held_out = project().join("recordings/held-out.mcap");
    let counts =
        |path: &str| -> Value { serde_json::from_str(&text(&run(&["info", path, "--json"], 0).stdout)).expect("JSON") };
    let n_frames = |info: &Value| {
        let topics = info["topics"].as_object().expect("topics").clone();
        let of = |word: &str| {
            topics.iter().find(|(name, _)| name.ends_with(word)).map(|(_, topic)| topic["n_messages"].clone())
        };
        ["tactile", "contacts", "feature", "prediction"].map(of)
    };
    let expected = n_frames(&counts(held_out.to_str().expect("UTF-8")))[0].clone();
    assert!(expected.is_some());
    assert_eq!(n_frames(&counts(recorded)), [(); 4].map(|()| expected.clone()));
}

/// The same deadline at the first edge and at the last one: the mark of a late sample goes with the answers to it.
#[test]
fn a_late_sample_holds_its_grasp_or_stops_the_graph_if_the_file_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let late_at = |edge: &str, on_late: &str| {
        let (port, from) = edge.split_once(": ").expect("an edge");
        let by = format!("{{{port}: {{from: {from}, deadline_ms: 0.001, on_late: {on_late}}}}}");
        let flow = dataflow_with(folder.path(), &[(format!("{{{edge}}}"), by)]);
        let arguments = ["run", "--json", "--set", "recorded_source.rate=max", "--name"];
        let name = crate::common::unique_name();
        let arguments = [&arguments[..], &[&name, flow.to_str().expect("UTF-8")]].concat();
        let output = crate::common::blindgrasp().args(&arguments).output().expect("started");
        let lines = crate::common::json_lines(&output.stdout);
        (output.status.code(), lines, text(&output.stderr))
    };
    for edge in ["tactile: recorded_source/tactile", "prediction: classifier/prediction"] {
        let (code, lines, said) = late_at(edge, "hold");
        assert_eq!(code, Some(0), "{said}");
        let decisions: Vec<_> = lines.iter().filter(|line| line.get("summary").is_none()).collect();
        assert_eq!(decisions.len(), 240);
        assert!(decisions.iter().all(|decision| decision["action"] == "hold"), "{edge}");
        assert!(decisions.iter().any(|decision| decision["reason"] == "stale"), "{edge}");
    }
    let (code, lines, said) = late_at("contacts: contacts/contacts", "stop");
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("node 'encoder' got sample") && said.contains("too late, and 'on_late' is 'stop'"), "{said}");
    assert!(lines.iter().all(|decision| decision.get("action").is_none_or(|action| action == "hold")), "{lines:?}");
}

#[test]
fn a_group_that_cannot_be_is_refused_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |nodes: &[(&str, &[&str])]| {
        let replace: Vec<(String, String)> = nodes.iter().map(|(node, lines)| of_node(node, lines)).collect();
        let flow = dataflow_with(folder.path(), &replace);
        text(&run(&["run", "--check", flow.to_str().expect("UTF-8")], 1).stderr)
    };
    let said = refused(&[("recorded_source", &[GROUP]), ("contacts", &[GROUP])]);
    assert!(said.contains("node 'recorded_source': its operator cannot share a process with others"), "{said}");
    let said = refused(&[("contacts", &[GROUP])]);
    assert!(said.contains("node 'contacts' is alone in group 'judge'"), "{said}");
    let said = refused(&[("contacts", &[GROUP, "nice: 3"]), ("encoder", &[GROUP])]);
    assert!(said.contains("nodes 'contacts' and 'encoder' of group 'judge' share a process"), "{said}");
}

/// A field of a process's `/proc/PID/status`.
fn status_of(pid: i32, field: &str) -> String {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("a process");
    let value = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    value.expect("a field").trim().to_owned()
}

/// Fields 19 (nice), 40 (real-time priority) and 41 (policy) of proc_pid_stat(5).
fn scheduling_of(pid: i32) -> [i64; 3] {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("a process");
    let (_, after_name) = stat.rsplit_once(')').expect("a name");
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    [19, 40, 41].map(|number: usize| fields[number - 3].parse().expect("a number"))
}

#[test]
fn a_process_gets_from_the_kernel_what_the_file_says() {
    const FIFO: i64 = 1;
    type HasIt<'a> = &'a dyn Fn(i32) -> bool;
    let folder = tempfile::tempdir().expect("a folder");
    let allowed = status_of(std::process::id() as i32, "Cpus_allowed_list");
    let cpu = allowed.split([',', '-']).next().expect("a CPU").to_owned();
    let with = |lines: &[&str]| dataflow_with(folder.path(), &[of_node("encoder", lines)]);
    let graph = Graph::start(&with(&[&format!("cpus: [{cpu}]"), "nice: 5", "wait: {poll_us: 20}"]), &FAST_FOREVER);
    let pid = graph.pid_of("encoder");
    assert_eq!((status_of(pid, "Cpus_allowed_list"), scheduling_of(pid)[0]), (cpu, 5));
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("a nice process that polls for a while");

    // These need rights. Without them, the error says which.
    let asks: [(&str, &str, HasIt<'_>); 2] = [
        ("scheduling: {policy: fifo, priority: 7}", "CAP_SYS_NICE", &|pid| scheduling_of(pid)[1..] == [7, FIFO]),
        ("lock_memory: true", "CAP_IPC_LOCK", &|pid| status_of(pid, "VmLck") != "0 kB"),
    ];
    for (line, right, has_it) in asks {
        let flow = with(&[line]);
        let name = crate::common::unique_name();
        let once = ["run", flow.to_str().expect("UTF-8"), "--name", &name, "--set", "recorded_source.rate=max"];
        let output = crate::common::blindgrasp().args(once).output().expect("started");
        if output.status.success() {
            let graph = Graph::start(&flow, &FAST_FOREVER);
            assert!(has_it(graph.pid_of("encoder")), "{line}");
            graph.wait_for_decisions(A_FEW_GRASPS);
            graph.stop().assert_undisturbed(line);
        } else {
            let said = text(&output.stderr);
            assert!(said.contains("node 'encoder'") && said.contains(right), "{line}: {said}");
        }
    }
    // A CPU that this machine does not have.
    let flow = with(&["cpus: [8191]"]);
    let said = text(&run(&["run", flow.to_str().expect("UTF-8"), "--name", &crate::common::unique_name()], 1).stderr);
    assert!(said.contains("cannot start node 'encoder'") && said.contains("its 'cpus' must name a CPU"), "{said}");
}
