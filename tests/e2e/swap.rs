//! Operators replaced while the graph decides: through the real processes, each operator in turn, and with replacements
//! that are unfit.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use crate::common::{
    A_FEW_GRASPS, Ended, FAST_FOREVER, Graph, HAND, MODEL, NODES, blindgrasp, dataflow, dataflow_with, decisions_of,
    fails, of_node, operator, paper_model, project, run, script, signal, stubborn_classifier, swap, text, undisturbed,
    wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// Swaps a node, and asserts that it has another process then.
fn swap_well(graph: &Graph, arguments: &[&str]) {
    let old = graph.pid_of(arguments[0]);
    let (swapped, _) = swap(graph, arguments, 0);
    assert_eq!(swapped["result"], "swapped");
    let node = &swapped["nodes"][0];
    assert_eq!((&node["node"], &node["old_pid"]), (&arguments[0].into(), &old.into()), "{swapped}");
    assert_eq!(node["new_pid"], graph.pid_of(arguments[0]), "{swapped}");
    assert_ne!(node["new_pid"], old, "{swapped}");
}

#[test]
fn each_operator_can_be_swapped_and_the_decisions_are_undisturbed() {
    let graph = Graph::fast();
    for node in NODES {
        swap_well(&graph, &[node, "--probation", "0.1"]);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // One right after the other.
    for node in NODES.iter().rev().chain(&["classifier"; 5]) {
        swap_well(&graph, &[node, "--probation", "0"]);
    }
    // All at once.
    let (swapped, _) = swap(&graph, &[&NODES[..], &["--probation", "0.1"]].concat(), 0);
    assert_eq!(swapped["nodes"].as_array().map(Vec::len), Some(5), "{swapped}");
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert_eq!(graph.status()["nodes"][3]["n_swaps"], 8);
    let ended = graph.stop();
    ended.assert_undisturbed("swaps");
    assert_eq!((&ended.summary["swaps"], &ended.summary["restarts"]), (&20.into(), &0.into()), "{}", ended.stderr);
}

/// The reader then has unread samples of two instances, and iceoryx2 gives it those of the later one first.
#[test]
fn an_operator_can_be_swapped_twice_while_its_reader_stands_still() {
    let graph = Graph::fast();
    for pair in NODES.windows(2) {
        swap_well(&graph, &[pair[0], "--probation", "0"]);
        let reader = graph.pid_of(pair[1]);
        signal(reader, Signal::STOP);
        let go_on = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(800));
            signal(reader, Signal::CONT);
        });
        swap_well(&graph, &[pair[0], "--probation", "0"]);
        swap_well(&graph, &[pair[0], "--probation", "0"]);
        go_on.join().expect("continued");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    ended.assert_undisturbed("two swaps beside a reader that stands still");
    assert_eq!(ended.summary["restarts"], 0, "{}", ended.stderr);
}

/// At full speed a queue is often full.
#[test]
fn swaps_at_full_speed_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let fastest = ["--set", "recorded_source.rate=max", "--set", "recorded_source.repeat=forever"];
    let graph = Graph::start(&dataflow(folder.path(), &[]), &fastest);
    for node in NODES {
        swap_well(&graph, &[node, "--probation", "0.1"]);
        graph.wait_for_decisions(10 * A_FEW_GRASPS);
    }
    for node in NODES.iter().cycle().take(20) {
        swap_well(&graph, &[node, "--probation", "0"]);
    }
    let ended = graph.stop();
    ended.assert_undisturbed("swaps at full speed");
    assert_eq!(ended.summary["restarts"], 0, "{}", ended.stderr);
}

/// The samples of the old instance lie in its own memory until they are answered, also if the graph is stopped meanwhile and
/// their reader has to be started again.
#[test]
fn a_graph_that_is_stopped_on_probation_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &[of_node("lift_arbiter", &["heartbeat_ms: 3000"])]);
    let graph = Graph::start(&flow, &[&FAST_FOREVER[..], &["--wait-limit", "30", "--grace", "25"]].concat());
    signal(graph.pid_of("lift_arbiter"), Signal::STOP);
    std::thread::sleep(Duration::from_millis(600));
    let mut swapping = blindgrasp();
    swapping.args(["swap", "classifier", "--probation", "30", "--graph", &graph.name]);
    let mut swapping = swapping.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("started");
    let old = graph.pid_of("classifier");
    wait_until(|| graph.pid_of("classifier") != old, || format!("no probation: {}", graph.said()));
    let ended = graph.stop();
    swapping.wait().expect("waited");
    ended.assert_undisturbed("a stop on probation");
    assert_eq!(ended.summary["restarts"], 1, "{}", ended.stderr);
}

/// The reader finds the samples of the new instance first, and those of the old one only when that gets the processor again.
#[test]
fn a_reader_that_is_started_again_waits_for_an_old_instance_that_stands_still() {
    let folder = tempfile::tempdir().expect("a folder");
    let slow = of_node("classifier", &["heartbeat_ms: 60000"]);
    let flow = dataflow_with(folder.path(), &[of_node("lift_arbiter", &["heartbeat_ms: 1000"]), slow]);
    let slow = ["--set", "recorded_source.rate=2", "--set", "recorded_source.repeat=forever", "--wait-limit", "30"];
    let graph = Graph::start(&flow, &slow);
    let (old, arbiter) = (graph.pid_of("classifier"), graph.pid_of("lift_arbiter"));
    signal(arbiter, Signal::STOP);
    let mut swapping = blindgrasp();
    swapping.args(["swap", "classifier", "--probation", "30", "--graph", &graph.name]);
    let mut swapping = swapping.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("started");
    wait_until(|| graph.pid_of("classifier") != old, || format!("no probation: {}", graph.said()));
    signal(old, Signal::STOP);
    // It has no process while it waits to be started again.
    let is_back = || {
        let node = graph.node("lift_arbiter");
        node["state"] == "running" && node["pid"].as_i64().is_some_and(|pid| pid != i64::from(arbiter))
    };
    wait_until(is_back, || format!("not started again: {}", graph.said()));
    std::thread::sleep(Duration::from_millis(300));
    signal(old, Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    swapping.wait().expect("waited");
    ended.assert_undisturbed("a reader that was started again while an old instance stood still");
}

/// Asserts that a swap is refused with these reasons, and that the old operator goes on.
fn assert_refused(graph: &Graph, arguments: &[&str], reasons: &[&str]) {
    let old = graph.pid_of(arguments[0]);
    let (_, stderr) = swap(graph, arguments, 1);
    for reason in reasons {
        assert!(stderr.contains(reason), "{arguments:?}: expected '{reason}' in {stderr}");
    }
    let node = graph.node(arguments[0]);
    assert_eq!((&node["pid"], &node["standby_pid"]), (&old.into(), &Value::Null), "{arguments:?}: {node}");
    assert_eq!((&node["n_swaps"], &node["state"]), (&0.into(), &"running".into()), "{arguments:?}: {node}");
    graph.wait_for_decisions(A_FEW_GRASPS);
}

/// A program that describes itself like the classifier and then runs `body`.
fn like_the_classifier(folder: &Path, name: &str, body: &str) -> String {
    let real = operator("classifier");
    let describe = format!("if [ \"$1\" = --describe ]; then exec {real} \"$@\"; fi");
    utf8(&script(folder, name, &format!("{describe}\n{}", body.replace("REAL", &real))))
}

/// A program that describes itself like the classifier, with a change.
fn unlike_the_classifier(folder: &Path, name: &str, change: impl FnOnce(&mut Value)) -> String {
    let described = run(&["operator", "classifier", "--describe"], 0);
    let mut description: Value = serde_json::from_slice(&described.stdout).expect("JSON");
    change(&mut description);
    utf8(&script(folder, name, &format!("cat <<'END'\n{description}\nEND")))
}

fn utf8(path: &Path) -> String {
    path.to_str().expect("UTF-8").into()
}

#[test]
fn an_unfit_replacement_is_refused_and_the_old_one_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let graph = Graph::start(&dataflow(folder, &[]), &FAST_FOREVER);
    let stubborn = utf8(&stubborn_classifier());
    assert_refused(
        &graph,
        &["classifier", "--run", &stubborn, "--set", "start_secs=2", "--ready-limit", "0.5"],
        &["not swapped", "the old one goes on", "was not ready within 0.5 s"],
    );
    assert_refused(
        &graph,
        &["classifier", "--run", &like_the_classifier(folder, "exits.sh", "echo out of coffee >&2; exit 3")],
        &["the replacement of 'classifier' ended (exit status: 3)", "out of coffee"],
    );
    assert_refused(&graph, &["classifier", "--run", "/bin/true"], &["the replacement cannot be used", "--describe"]);
    assert_refused(&graph, &["classifier", "--run", "no/such/program"], &["there is no such program"]);
    let deaf = unlike_the_classifier(folder, "deaf.sh", |description| description["inputs"] = Value::Array(vec![]));
    assert_refused(&graph, &["classifier", "--run", &deaf], &["has no input 'feature'"]);
    let dumb = unlike_the_classifier(folder, "dumb.sh", |description| description["outputs"] = Value::Array(vec![]));
    assert_refused(&graph, &["classifier", "--run", &dumb], &["has no output 'prediction'"]);
    let alien = unlike_the_classifier(folder, "alien.sh", |description| {
        let type_name = description["outputs"][0].as_object_mut().expect("a port");
        let (key, _) =
            type_name.iter().find(|(_, value)| value.as_str().is_some_and(|text| text.contains('/'))).expect("a type");
        let key = key.clone();
        type_name.insert(key, "robot/Mood/1".into());
    });
    assert_refused(&graph, &["classifier", "--run", &alien], &["output 'prediction' gives robot/Mood/1"]);
    assert_refused(&graph, &["contacts", "--run", &stubborn], &["has no input 'tactile'"]);
    assert_refused(&graph, &["classifier", "--set", "modle=x.json"], &["modle"]);
    assert_refused(&graph, &["classifier", "--set", "model=no/such/model.json"], &["no/such/model.json"]);
    let (_, stderr) = swap(&graph, &["clasifier"], 1);
    assert!(stderr.contains("no node 'clasifier'") && stderr.contains("classifier"), "{stderr}");
    graph.stop().assert_undisturbed("refused swaps");
}

#[test]
fn a_replacement_that_fails_on_probation_is_rolled_back_without_a_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let flow = crate::common::dataflow_with(folder, &[of_node("classifier", &["heartbeat_ms: 2000"])]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    for (name, deed, reason) in [
        ("dies.sh", "kill -9 $$", "was killed (signal 9) within its probation"),
        ("hangs.sh", "kill -STOP $$", "had no heartbeat for 2000 ms"),
    ] {
        // Until then it answers as the running one does.
        let program = like_the_classifier(folder, name, &format!("(sleep 0.4; {deed}) &\nexec REAL"));
        let reasons = ["the replacement took over and failed; the old operator is active again", reason];
        assert_refused(&graph, &["classifier", "--run", &program, "--probation", "10"], &reasons);
        assert!(graph.said().contains("swap rolled back"), "{}", graph.said());
    }
    let ended = graph.stop();
    ended.assert_undisturbed("rolled back swaps");
    assert_eq!((&ended.summary["swaps"], &ended.summary["restarts"]), (&0.into(), &0.into()), "{}", ended.stderr);
}

fn assert_each_once(ended: &Ended) {
    assert_eq!(ended.summary["samples_lost"], 0, "{}", ended.stderr);
    for (grasp_id, line) in ended.decisions.iter().enumerate() {
        assert_eq!(line["grasp_id"], grasp_id, "{line}");
    }
}

#[test]
fn a_replacement_that_answers_a_few_samples_and_dies_or_hangs_loses_none() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = crate::common::dataflow_with(folder.path(), &[of_node("classifier", &["heartbeat_ms: 1500"])]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let stubborn = utf8(&stubborn_classifier());
    for fault in ["die_after=9", "hang_after=9", "die_after=50", "die_after=200", "hang_after=200"] {
        let arguments = ["classifier", "--run", &stubborn, "--set", fault, "--probation", "10"];
        assert_refused(&graph, &arguments, &["the old one"]);
    }
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_each_once(&ended);
}

/// The project's hand with a pad a millimetre off, in a folder of the test's.
fn other_hand(folder: &Path) -> PathBuf {
    let layout = std::fs::read_to_string(project().join(HAND)).expect("a layout");
    let other = layout.replace("at_m: [0.022, 0.0159, 0]", "at_m: [0.021, 0.0159, 0]");
    assert_ne!(other, layout);
    std::fs::write(folder.join("other.yaml"), other).expect("written");
    std::fs::copy(project().join("hands/barrett-bh8-280.urdf"), folder.join("barrett-bh8-280.urdf")).expect("copied");
    folder.join("other.yaml")
}

#[test]
fn another_hand_or_a_model_unlike_its_neighbours_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::fast();
    let hand = format!("hand={}", utf8(&other_hand(folder.path())));
    assert_refused(&graph, &["contacts", "--set", &hand], &["'contacts' is made for the hand", "--allow-mismatch"]);
    let model = format!("model={}", utf8(paper_model()));
    for node in ["encoder", "classifier"] {
        assert_refused(&graph, &[node, "--set", &model], &[&format!("'{node}' is made for the "), "--allow-mismatch"]);
    }
    let in_shadow = ["encoder", "classifier", "--shadow", "0.5", "--set", &model];
    assert_refused(&graph, &in_shadow, &["without --shadow", "view --shadow MODEL"]);
    graph.stop().assert_undisturbed("refused mismatches");
}

#[test]
fn another_model_decides_once_all_that_use_it_are_swapped() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = utf8(paper_model());
    let by_the_other = decisions_of(&dataflow(folder.path(), &[(MODEL, &model)]));
    let graph = Graph::fast();
    let n_before = graph.n_decisions();
    let (swapped, _) =
        swap(&graph, &["encoder", "classifier", "--set", &format!("model={model}"), "--probation", "0.1"], 0);
    let nodes = swapped["nodes"].as_array().expect("nodes");
    let last_seqs: Vec<u64> = nodes.iter().map(|node| node["last_seq"].as_u64().expect("a number")).collect();
    assert_eq!(last_seqs[0], last_seqs[1], "at one place in the stream: {swapped}");
    // The other model decides the whole recording once.
    graph.wait_for_decisions(250);
    for id in ["encoder", "classifier"] {
        assert_eq!(graph.node(id)["params"]["model"], *model);
    }
    let ended = graph.stop();
    assert_each_once(&ended);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    // A grasp has 14 samples: the grasp during the swap may be decided by either model, or by neither.
    let swapped_at = (last_seqs[0] / 14) as usize;
    assert!(swapped_at + 1 >= n_before);
    let mut n_different = 0;
    for (grasp_id, line) in ended.decisions[..ended.decisions.len() - 1].iter().enumerate() {
        let (old, new) = (&undisturbed()[grasp_id % 240], &by_the_other[grasp_id % 240]);
        let expected = if grasp_id < swapped_at { old } else { new };
        let found = (line["action"].as_str().expect("a word"), line["reason"].as_str().expect("a word"));
        assert!(found == (&*expected.0, &*expected.1) || grasp_id == swapped_at, "{line}, expected {expected:?}");
        n_different += usize::from(grasp_id > swapped_at && old != new);
    }
    assert!(n_different > 10, "{n_different}");
}

#[test]
fn a_shadow_is_compared_and_promoted_only_if_it_agrees() {
    let graph = Graph::fast();
    let old = graph.pid_of("classifier");
    let (compared, _) = swap(&graph, &["classifier", "--shadow", "0.7"], 0);
    assert_eq!(compared["result"], "compared");
    let report = &compared["shadow"][0];
    assert_eq!((&report["agreement"], &report["n_unanswered"]), (&1.0.into(), &0.into()), "{report}");
    assert!(report["n_pairs"].as_u64() > Some(100), "{report}");
    assert_eq!(graph.pid_of("classifier"), old);

    let stubborn = utf8(&stubborn_classifier());
    let gate = ["--shadow", "0.7", "--min-agreement", "0.99", "--max-disagreements", "0"];
    let (held_back, stderr) = swap(&graph, &[&["classifier", "--run", &stubborn], &gate[..]].concat(), 1);
    assert_eq!(held_back["result"], "held_back");
    assert!(held_back["shadow"][0]["agreement"].as_f64() < Some(0.9), "{held_back}");
    assert!(stderr.contains("the old one goes on") && stderr.contains("agreement"), "{stderr}");
    let node = graph.node("classifier");
    assert_eq!((&node["pid"], &node["standby_pid"]), (&old.into(), &Value::Null));

    for node in NODES {
        // A source sends nothing in the shadow, so that it cannot be promoted.
        let is_source = node == NODES[0];
        let old = graph.pid_of(node);
        let (ended, stderr) =
            swap(&graph, &[&[node, "--probation", "0.1"], &gate[..]].concat(), if is_source { 1 } else { 0 });
        assert_eq!(graph.pid_of(node) == old, is_source, "{node}: {ended} {stderr}");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    ended.assert_undisturbed("shadows");
    assert_eq!(ended.summary["swaps"], 4);
}

#[test]
fn ctrl_c_in_the_shadow_abandons_the_swap() {
    let graph = Graph::fast();
    let old = graph.pid_of("classifier");
    let mut command = blindgrasp();
    command.args(["swap", "classifier", "--shadow", "600", "--graph", &graph.name]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("started");
    wait_until(|| !graph.node("classifier")["standby_pid"].is_null(), || graph.said());
    graph.wait_for_decisions(A_FEW_GRASPS);
    fails(&["swap", "encoder", "--graph", &graph.name], "a swap of classifier is under way");
    signal(child.id() as i32, Signal::INT);
    let output = child.wait_with_output().expect("waited");
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    wait_until(|| graph.node("classifier")["standby_pid"].is_null(), || graph.said());
    assert_eq!(graph.pid_of("classifier"), old);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("an abandoned swap");
}

/// A model that judges probes, for which the classifier remembers earlier frames.
const LIFTS: &str = "models/barrett-bh8-280-lifts.json";

/// `--set` of a model of the project.
fn set_model(model: &str) -> String {
    format!("model={}", project().join(model).display())
}

#[test]
fn a_model_with_a_memory_takes_the_place_of_one_without_and_back() {
    let graph = Graph::fast();
    for model in [LIFTS, MODEL, LIFTS, LIFTS, MODEL] {
        swap(&graph, &["encoder", "classifier", "--set", &set_model(model), "--probation", "0"], 0);
        graph.wait_for_decisions(A_FEW_GRASPS);
        // A process that comes back begins where its readers are, with a saved state or without one.
        for node in ["classifier", "encoder", "lift_arbiter"] {
            graph.kill(node);
        }
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    assert_each_once(&ended);
    assert_eq!((ended.code, &ended.summary["swaps"]), (Some(0), &10.into()), "{}", ended.stderr);
}

/// At full speed every writer waits for its reader: an operator that hands over has an answer that it could not send, saved with a
/// state or not.
#[test]
fn failed_and_good_swaps_under_back_pressure_lose_none() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max"), ("max_age_ms: 5000", "max_age_ms: 600000")]);
    let graph = Graph::start(&flow, &["--set", "recorded_source.repeat=forever"]);
    let stubborn = utf8(&stubborn_classifier());
    for (model, samples) in [(MODEL, [600, 2000]), (LIFTS, [1, 300]), (MODEL, [1, 300]), (LIFTS, [1, 300])] {
        swap(&graph, &["encoder", "classifier", "--set", &set_model(model), "--probation", "0"], 0);
        // One without a state answers some samples, and the old one comes back.
        for n_samples in samples {
            let fault = format!("die_after={n_samples}");
            let arguments = ["classifier", "--run", &stubborn, "--set", &fault, "--probation", "10"];
            let (_, stderr) = swap(&graph, &arguments, 1);
            assert!(stderr.contains("the old one"), "{stderr}");
        }
        for node in NODES {
            swap(&graph, &[node, "--probation", "0"], 0);
        }
    }
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["swaps"]), (Some(0), &28.into()), "{}", ended.stderr);
    assert_each_once(&ended);
    assert_eq!(ended.summary["reasons"]["out_of_order"], Value::Null, "{}", ended.summary);
    // The queues were full.
    let blocked = |edge: &Value| edge["blocked_nanos"].as_u64() > Some(0);
    assert!(ended.summary["edges"].as_array().expect("edges").iter().any(blocked), "{}", ended.summary);
}

#[test]
fn a_model_that_does_not_judge_the_probe_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let lifts = project().join(LIFTS).display().to_string();
    let flow = dataflow(folder.path(), &[(MODEL, &lifts), ("votes: 3", "votes: 3\n      probe: test_lift")]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let reasons = ["probe is test_lift", "judges no test_lifted grasps", "--allow-mismatch"];
    assert_refused(&graph, &["classifier", "--set", &set_model(MODEL)], &reasons);
    let warned = run(&["set", "lift_arbiter.probe=none", "--graph", &graph.name], 0);
    assert_eq!(text(&warned.stderr), "");
    swap(&graph, &["encoder", "classifier", "--set", &set_model(MODEL), "--probation", "0"], 0);
    let warned = run(&["set", "lift_arbiter.probe=squeeze", "--graph", &graph.name], 0);
    assert!(text(&warned.stderr).contains("judges no squeezed grasps"), "{}", text(&warned.stderr));
    assert_eq!(graph.stop().code, Some(0));
}
