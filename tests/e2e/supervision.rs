//! Graphs whose operators die, hang, flood, refuse to stop or never start: through the real processes,
//! each operator in turn.

use std::path::Path;
use std::time::Duration;

use crate::common::{
    A_FEW_GRASPS, Ended, FAST_FOREVER, Graph, MODEL, NODES, assert_nothing_left, classifier_runs, dataflow,
    dataflow_with, fails, json_lines, left_overs, of_node, operator, program, run, script, signal, skipped,
    stubborn_classifier, text, unique_name, wait_until,
};
use rustix::process::{Resource, Signal, getrlimit, prlimit};
use serde_json::Value;

/// A source, a stage and the last node: the launcher starts and ends the other stages as it does the one.
const ENDS_AND_MIDDLE: [&str; 3] = ["recorded_source", "encoder", "lift_arbiter"];

/// The project's graph, whose operators may be started again any number of times.
fn patient_dataflow(folder: &Path, heartbeat_ms: u32) -> std::path::PathBuf {
    let heartbeat = format!("heartbeat_ms: {heartbeat_ms}");
    let lines = ["restart: {policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}", &heartbeat];
    dataflow_with(folder, &NODES.map(|node| of_node(node, &lines)))
}

/// The launcher has no descriptor left for a moment.
#[test]
fn an_operator_that_cannot_be_started_for_a_while_comes_back_and_no_restart_is_counted() {
    let graph = Graph::fast();
    let pid = rustix::process::Pid::from_raw(graph.pid());
    let classifier = graph.pid_of("classifier");
    let limit = |current| {
        let limit = rustix::process::Rlimit { current: Some(current), ..getrlimit(Resource::Nofile) };
        prlimit(pid, Resource::Nofile, limit).expect("set").current
    };
    let before = limit(4).expect("a limit");
    signal(classifier, Signal::KILL);
    wait_until(|| graph.said().contains("when the machine can start processes again"), || graph.said());
    // More tries than restarts are allowed within a second.
    std::thread::sleep(Duration::from_millis(1200));
    limit(before);
    wait_until(|| graph.said().contains("node 'classifier' is back"), || graph.said());
    assert_eq!(graph.node("classifier")["n_restarts"], 1, "{}", graph.node("classifier"));
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("a launcher without descriptors");
}

#[test]
fn killed_operators_come_back_and_the_decisions_are_undisturbed() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&patient_dataflow(folder.path(), 2000), &FAST_FOREVER);
    let mut n_restarts = [0; 5];
    let mut kill = |how: Signal, nodes: &[usize]| {
        let pids: Vec<i32> = nodes.iter().map(|idx| graph.pid_of(NODES[*idx])).collect();
        pids.iter().for_each(|pid| signal(*pid, how));
        for idx in nodes {
            n_restarts[*idx] += 1;
            graph.wait_for_restart(NODES[*idx], n_restarts[*idx]);
        }
    };
    for idx in 0..NODES.len() {
        kill(Signal::KILL, &[idx]);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Another program asks the operators to end. The arbiter is left out: it would hold the open grasp.
    for idx in 0..NODES.len() - 1 {
        kill(Signal::TERM, &[idx]);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Two neighbours at a time.
    for idx in 1..NODES.len() {
        kill(Signal::KILL, &[idx - 1, idx]);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Again as soon as it is back.
    for idx in 0..NODES.len() {
        (0..3).for_each(|_| kill(Signal::KILL, &[idx]));
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // And all at once.
    kill(Signal::KILL, &[0, 1, 2, 3, 4]);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    ended.assert_undisturbed("killed operators");
    assert_eq!(ended.summary["restarts"], n_restarts.iter().sum::<u64>(), "{}", ended.stderr);
}

#[test]
fn a_hung_operator_is_found_by_its_heartbeat_and_a_stopped_launcher_restarts_none() {
    let folder = tempfile::tempdir().expect("a folder");
    // So slow that the launcher's queue takes the decisions of its pause, those that a busy machine owes among them.
    let slow = FAST_FOREVER.map(|word| if word == "recorded_source.rate=16" { "recorded_source.rate=6" } else { word });
    let graph = Graph::start(&patient_dataflow(folder.path(), 1500), &slow);
    for node in NODES {
        let pid = graph.pid_of(node);
        signal(pid, Signal::STOP);
        graph.wait_for_restart(node, 1);
        assert_ne!(graph.pid_of(node), pid);
        assert!(graph.said().contains(&format!("node '{node}' had no heartbeat for 1500 ms")), "{}", graph.said());
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // A command waits for the operator meanwhile.
    signal(graph.pid_of("lift_arbiter"), Signal::STOP);
    fails(&["set", "lift_arbiter.votes=3", "--graph", &graph.name], "ended before it took the value");
    graph.wait_for_restart("lift_arbiter", 2);
    signal(graph.pid_of("encoder"), Signal::STOP);
    run(&["swap", "encoder", "--probation", "0.1", "--graph", &graph.name], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let (pids, n_before) = (NODES.map(|node| graph.pid_of(node)), graph.n_decisions());
    signal(graph.pid(), Signal::STOP);
    // Longer than a heartbeat may take.
    std::thread::sleep(Duration::from_millis(2500));
    signal(graph.pid(), Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    assert_eq!(NODES.map(|node| graph.pid_of(node)), pids);
    let ended = graph.stop();
    ended.assert_undisturbed("hung operators");
    // The launcher that stood still has read the labels before their decisions.
    for line in &ended.decisions[n_before..] {
        assert_eq!(line["truth"]["grasp_id"], line["grasp_id"], "{line}");
    }
    // The operator that was swapped while it hung was found before the swap, or during it.
    assert!([6, 7].contains(&ended.summary["restarts"].as_u64().expect("a count")), "{}", ended.stderr);
}

/// A node hangs, so that its queue fills, and then the nodes before it die as well. Their memory has all samples that it has not
/// answered, and those that it has answered may not have reached the node behind it.
#[test]
fn a_node_that_hangs_and_neighbours_that_are_killed_meanwhile_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&patient_dataflow(folder.path(), 800), &FAST_FOREVER);
    let mut n_restarts = [0; 5];
    for (hung, killed) in
        [(1, vec![0]), (2, vec![1]), (3, vec![2]), (4, vec![3]), (3, vec![1, 2]), (4, vec![3, 2, 1, 0])]
    {
        signal(graph.pid_of(NODES[hung]), Signal::STOP);
        // The time in which the queues fill is the point, and is less than a heartbeat may take.
        std::thread::sleep(Duration::from_millis(500));
        let pids: Vec<i32> = killed.iter().map(|idx: &usize| graph.pid_of(NODES[*idx])).collect();
        pids.iter().for_each(|pid| signal(*pid, Signal::KILL));
        for idx in killed.iter().chain([&hung]) {
            n_restarts[*idx] += 1;
            graph.wait_for_restart(NODES[*idx], n_restarts[*idx]);
        }
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    graph.stop().assert_undisturbed("a hung node and killed neighbours");
}

/// A reader is away for longer than its writers wait. Only the source waits, because no node behind it gets further ahead of
/// that reader than the histories reach back. It fails again and again, and nothing is lost.
#[test]
fn a_source_that_waited_too_long_goes_on_without_a_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments: Vec<&str> = FAST_FOREVER.into_iter().chain(["--wait-limit", "1"]).collect();
    let graph = Graph::start(&patient_dataflow(folder.path(), 4000), &arguments);
    signal(graph.pid_of("classifier"), Signal::STOP);
    graph.wait_for_restart("recorded_source", 1);
    graph.wait_for_restart("classifier", 1);
    graph.wait_for_decisions(3 * A_FEW_GRASPS);
    for node in ["contacts", "encoder"] {
        assert_eq!(graph.node(node)["n_restarts"], 0, "{node}: {}", graph.said());
    }
    graph.stop().assert_undisturbed("a reader away for longer than its writers wait");
}

/// A program in an operator's place: it describes itself as that operator, and then behaves as `body` says.
fn in_place_of(folder: &Path, node: &str, body: &str) -> (String, String) {
    let real = operator(node);
    let body = body.replace("REAL", &real);
    let program = script(
        folder,
        &format!("{node}.sh"),
        &format!("if [ \"$1\" = --describe ]; then exec {real} \"$@\"; fi\n{body}"),
    );
    of_node(node, &[&format!("run: {}", program.display())])
}

fn refused(folder: &Path, replace: &[(String, String)], arguments: &[&str]) -> String {
    let (name, flow) = (unique_name(), dataflow_with(folder, replace));
    let flow = flow.to_str().expect("UTF-8");
    let output = run(&[&["run", "--json", "--name", &name, flow], arguments].concat(), 1);
    assert_nothing_left(&name);
    let decisions = json_lines(&output.stdout).iter().filter(|line| line.get("summary").is_none()).count();
    assert_eq!(decisions, 0);
    text(&output.stderr)
}

#[test]
fn an_operator_that_exits_at_its_start_ends_the_launch_by_name_and_with_its_last_words() {
    for node in ENDS_AND_MIDDLE {
        let folder = tempfile::tempdir().expect("a folder");
        let stderr = refused(folder.path(), &[in_place_of(folder.path(), node, "echo out of coffee >&2; exit 3")], &[]);
        for word in [&format!("node '{node}' ended (exit status: 3) too early"), "last words", "out of coffee"] {
            assert!(stderr.contains(word), "{node}: {stderr}");
        }
    }
}

#[test]
fn an_operator_that_is_never_ready_ends_the_launch_by_name() {
    for node in ENDS_AND_MIDDLE {
        let folder = tempfile::tempdir().expect("a folder");
        let sleeper = in_place_of(folder.path(), node, "echo still loading\nexec sleep 1000");
        let stderr = refused(folder.path(), &[sleeper], &["--startup-limit", "1.5"]);
        assert!(stderr.contains(&format!("not ready within 1.5 s: {node}; its last words")), "{node}: {stderr}");
    }
}

#[test]
fn an_operator_that_floods_its_output_decides_the_same_and_fills_no_disk() {
    for node in ENDS_AND_MIDDLE {
        let folder = tempfile::tempdir().expect("a folder");
        let flow = dataflow_with(folder.path(), &[in_place_of(folder.path(), node, "yes flood &\nexec REAL")]);
        let graph = Graph::start(&flow, &FAST_FOREVER);
        graph.wait_for_decisions(2 * A_FEW_GRASPS);
        let logs = graph.status()["log_folder"].as_str().expect("a path").to_string();
        let flooded = Path::new(&logs).join(format!("{node}.log"));
        assert!(std::fs::read_to_string(flooded).expect("a log").contains("flood"), "{node}");
        let ended = graph.stop();
        ended.assert_undisturbed(&format!("{node} floods"));
        let files = std::fs::read_dir(&logs).expect("readable").flatten();
        let n_bytes: u64 = files.map(|file| file.metadata().expect("a file").len()).sum();
        // Four files of 8 MiB of the operator that floods, and a few lines of each of the others.
        assert!(n_bytes < 33 << 20, "{node}: {n_bytes} bytes of logs");
        std::fs::remove_dir_all(logs).expect("removed");
    }
}

#[test]
fn an_operator_that_ignores_sigterm_is_killed_after_the_grace_period() {
    for node in ENDS_AND_MIDDLE {
        let folder = tempfile::tempdir().expect("a folder");
        let wrapper = in_place_of(folder.path(), node, "trap '' TERM\nexec 3<&0\nREAL <&3 &\nwait $!");
        let graph =
            Graph::start(&dataflow_with(folder.path(), &[wrapper]), &[&FAST_FOREVER[..], &["--grace", "0.7"]].concat());
        let ended = graph.stop();
        assert_eq!(ended.code, Some(1), "{node}: {}", ended.stderr);
        let told = format!("node '{node}' did not drain within 0.7 s");
        assert!(ended.stderr.contains(&told), "{node}: {}", ended.stderr);
    }
}

/// A classifier that dies after so many samples each time it is started, and is given up the third time.
fn mortal_dataflow(folder: &Path, die_after: u32) -> std::path::PathBuf {
    let (what, by) = classifier_runs(&stubborn_classifier(), &format!("{{die_after: {die_after}}}"));
    let restart = "    restart: {policy: on-failure, limit: 2, within_s: 60, backoff_ms: 10}\n";
    dataflow_with(folder, &[(what, by + restart)])
}

fn lifts(decisions: &[Value]) -> Vec<u64> {
    let lifts = decisions.iter().filter(|line| line["action"] == "lift");
    lifts.map(|line| line["grasp_id"].as_u64().expect("an id")).collect()
}

#[test]
fn an_operator_that_keeps_dying_is_given_up_and_nothing_is_lifted_without_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = mortal_dataflow(folder.path(), 100);
    // Its three processes answer 300 of the 3360 samples of a repetition.
    let graph = Graph::launch(
        &unique_name(),
        &flow,
        &[
            "--set",
            "recorded_source.rate=16",
            "--set",
            "recorded_source.repeat=2",
            "--set",
            "lift_arbiter.max_age_ms=1000",
        ],
    );
    wait_until(|| graph.said().contains("is degraded"), || graph.said());
    let status = graph.status();
    assert_eq!(status["state"], "degraded");
    assert!(status["message"].as_str().expect("a message").contains("node 'classifier'"), "{status}");
    assert_eq!(
        (&graph.node("classifier")["state"], &graph.node("classifier")["n_restarts"]),
        (&"failed".into(), &2.into())
    );
    let ended = graph.finish();
    assert_eq!(ended.code, Some(1), "{}", ended.stderr);
    assert_eq!(ended.summary["end"], "degraded", "{}", ended.stderr);
    for word in ["is degraded", "node 'classifier' was killed (signal 6)", "given up", "nothing behind it is decided"] {
        assert!(ended.stderr.contains(word), "{word}: {}", ended.stderr);
    }
    // The source went on to its end.
    let sent = |edge: &&Value| edge["from"] == "recorded_source/tactile";
    let edges = ended.summary["edges"].as_array().expect("edges");
    assert!(edges.iter().find(sent).expect("an edge")["sent"].as_u64() > Some(2 * 3300), "{}", ended.summary);
    let lifts = lifts(&ended.decisions);
    // A grasp has 14 samples: three processes see at most the first 22 grasps.
    assert!(!lifts.is_empty() && lifts.iter().all(|grasp_id| *grasp_id < 22), "{lifts:?}");
    assert!(ended.summary["samples_lost"].as_u64() > Some(0), "{}", ended.summary);
}

#[test]
fn a_graph_that_is_stopped_right_after_a_restart_loses_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = patient_dataflow(folder.path(), 2000);
    for pause_ms in [0, 20, 50, 80] {
        let graph = Graph::start(&flow, &FAST_FOREVER);
        graph.wait_for_decisions(2);
        signal(graph.pid_of("encoder"), Signal::KILL);
        std::thread::sleep(Duration::from_millis(pause_ms));
        let ended = graph.stop();
        ended.assert_undisturbed(&format!("stopped after {pause_ms} ms"));
    }
}

#[test]
fn a_sample_that_kills_an_operator_again_and_again_is_left_without_an_answer() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &[classifier_runs(&stubborn_classifier(), "{die_seq: 30}")]);
    let settings = ["--set", "recorded_source.rate=16", "--set", "lift_arbiter.max_age_ms=600000"];
    let graph = Graph::launch(&unique_name(), &flow, &settings);
    let ended = graph.finish();
    // One sample is lost, and the grasp of it is held.
    assert_eq!(ended.code, Some(3), "{}", ended.stderr);
    assert!(ended.stderr.contains("has died twice on sample 30"), "{}", ended.stderr);
    assert_eq!(ended.summary["samples_lost"], 1, "{}", ended.summary);
    assert_eq!(ended.summary["restarts"], 2, "{}", ended.summary);
    assert_eq!(ended.decisions.len(), 240);
    // A grasp has 14 samples.
    let of_sample = ended.decisions.iter().find(|line| line["grasp_id"] == 30 / 14).expect("it is decided");
    assert_eq!(of_sample["action"], "hold", "{of_sample}");
}

#[test]
fn an_operator_that_was_given_up_is_healed_by_a_swap() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::launch(&unique_name(), &mortal_dataflow(folder.path(), 100), &FAST_FOREVER);
    wait_until(|| graph.said().contains("is degraded"), || graph.said());
    // The source goes on, with more samples than its queue holds.
    let n_sent = |graph: &Graph| graph.status()["edges"][0]["sent"].as_u64().expect("a count");
    let n_before = n_sent(&graph);
    wait_until(|| n_sent(&graph) > n_before + 600, || graph.said());
    // A replacement that fails as well changes nothing: there is no old operator to return to.
    fails(&["swap", "classifier", "--set", "die_after=400", "--graph", &graph.name], "no old one left");
    let status = graph.status();
    assert_eq!((&status["state"], &status["nodes"][3]["state"]), (&"degraded".into(), &"failed".into()), "{status}");
    let n_before = n_sent(&graph);
    wait_until(|| n_sent(&graph) > n_before + 600, || graph.said());
    let model = format!("model={MODEL}");
    run(
        &["swap", "classifier", "--run", "classifier", "--set", &model, "--probation", "0.2", "--graph", &graph.name],
        0,
    );
    let status = graph.status();
    assert_eq!((&status["state"], &status["message"]), (&"running".into(), &Value::Null), "{status}");
    // The grasp that was open is held first.
    graph.wait_for_decisions(A_FEW_GRASPS);
    let n_before = graph.n_decisions();
    graph.wait_for_decisions(2 * A_FEW_GRASPS);
    // Its writers wait for it again, and it is supervised.
    graph.kill("classifier");
    assert_eq!(graph.node("classifier")["n_restarts"], 3);
    graph.wait_for_decisions(2 * A_FEW_GRASPS);
    let ended = graph.stop();
    // Samples that no process classified are lost.
    assert!(ended.summary["samples_lost"].as_u64() > Some(0), "{}", ended.summary);
    assert_eq!((ended.code, &ended.summary["end"]), (Some(3), &"stopped".into()), "{}", ended.stderr);
    let healed = &ended.decisions[n_before..ended.decisions.len() - 1];
    assert!(
        healed.windows(2).all(|pair| pair[1]["grasp_id"].as_u64() == pair[0]["grasp_id"].as_u64().map(|id| id + 1))
    );
    for line in healed {
        let (action, reason) = &crate::common::undisturbed()[line["grasp_id"].as_u64().expect("an id") as usize % 240];
        assert_eq!((line["action"].as_str(), line["reason"].as_str()), (Some(&**action), Some(&**reason)), "{line}");
    }
}

/// The name of a graph that was killed with all its operators.
fn killed_altogether(flow: &Path) -> String {
    let graph = Graph::start(flow, &FAST_FOREVER);
    let name = graph.name.clone();
    let pids = NODES.map(|node| graph.pid_of(node));
    // No process is to have the time to clear up.
    signal(graph.pid(), Signal::STOP);
    pids.iter().for_each(|pid| signal(*pid, Signal::KILL));
    signal(graph.pid(), Signal::KILL);
    drop(graph);
    wait_until(|| left_overs(&name).iter().all(|left| left.starts_with('/')), || format!("{:?}", left_overs(&name)));
    name
}

#[test]
fn remains_of_a_killed_graph_do_not_disturb_the_next_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[]);
    // Another test's graph may clear up as it starts, so that nothing is left: then once more.
    let name = (0..10).map(|_| killed_altogether(&flow)).find(|name| !left_overs(name).is_empty());
    let graph = Graph::launch(&name.expect("something is left"), &flow, &FAST_FOREVER);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.stop().assert_undisturbed("the next of that name");
}

#[test]
fn full_shared_memory_ends_the_run_in_words() {
    let mountable = |command: &mut std::process::Command| {
        command.args(["-rm", "sh", "-c"]);
    };
    let mut probe = std::process::Command::new("unshare");
    mountable(&mut probe);
    let probe = probe.arg("mount -t tmpfs none /dev/shm").output();
    if !probe.is_ok_and(|output| output.status.success()) {
        skipped("this system allows no mount in a namespace of one's own");
        return;
    }
    for (kilobytes, is_enough) in [(4, false), (64, false), (8192, false), (20480, false), (65536, true)] {
        let name = unique_name();
        let program = program();
        let command = format!(
            "mount -t tmpfs -o size={kilobytes}k none /dev/shm && exec {program} run --json --set recorded_source.rate=max \
             --name {name} --startup-limit 5 dataflow.yaml"
        );
        let mut unshare = std::process::Command::new("unshare");
        mountable(&mut unshare);
        let state = Path::new(env!("CARGO_TARGET_TMPDIR")).join("state");
        let output = unshare
            .arg(command)
            .current_dir(crate::common::project())
            .env("XDG_STATE_HOME", state)
            .output()
            .expect("started");
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(i32::from(!is_enough)), "{kilobytes} KiB: {stderr}");
        // With 20 MiB it starts, and finds that what it takes does not fit.
        let is_said = stderr.contains("MiB of shared memory are free") || stderr.contains("MiB of shared memory more");
        assert_eq!(is_said, !is_enough, "{kilobytes} KiB: {stderr}");
        assert_nothing_left(&name);
    }
}

/// A classifier that takes 2 ms for each sample, of which there come more: what becomes of them.
fn slow_consumer(folder: &Path, edge: &str) -> (Ended, Vec<Value>) {
    let (what, by) = classifier_runs(&stubborn_classifier(), "{pause_ms: 2}");
    let by = by.replace("encoder/feature", &format!("{{from: encoder/feature, {edge}}}"));
    let recording = folder.join("run.mcap");
    let recording = recording.to_str().expect("UTF-8");
    let flow = dataflow_with(folder, &[(what, by)]);
    let record = ["--record", recording, "--overwrite"];
    let graph = Graph::launch(&unique_name(), &flow, &[&["--set", "recorded_source.rate=16"], &record[..]].concat());
    let ended = graph.finish();
    (ended, json_lines(&run(&["export", recording], 0).stdout))
}

#[test]
fn a_slow_reader_of_the_latest_never_blocks_its_writer_and_gaps_are_never_lifted() {
    let blocked_secs = |ended: &Ended| {
        let edges = ended.summary["edges"].as_array().expect("edges").clone();
        let edge = edges.into_iter().find(|edge| edge["to"] == "classifier/feature").expect("an edge");
        edge["blocked_nanos"].as_f64().expect("a number") / 1e9
    };
    let folder = tempfile::tempdir().expect("a folder");
    let (lossless, _) = slow_consumer(folder.path(), "policy: lossless, capacity: 4");
    assert_eq!((lossless.code, &lossless.summary["samples_lost"]), (Some(0), &0.into()), "{}", lossless.stderr);
    let (latest, edges) = slow_consumer(folder.path(), "policy: latest, capacity: 4");
    assert_eq!(
        (latest.code, &latest.summary["samples_lost"]),
        (Some(3), &0.into()),
        "{} {}",
        latest.summary,
        latest.stderr
    );
    assert!(latest.summary["samples_dropped"].as_u64() > Some(0), "{}", latest.summary);
    // Only a lossless reader blocks its writer, and here there is none. The recorder reads much faster.
    assert!(
        blocked_secs(&lossless) > 1.0 && blocked_secs(&latest) < 0.1,
        "{} {}",
        blocked_secs(&lossless),
        blocked_secs(&latest)
    );
    // A grasp is lifted only if each of its frames, from the one before it on, was predicted.
    let mut last_seq = None;
    let mut with_gap = std::collections::BTreeSet::new();
    for prediction in edges.iter().filter(|line| line["topic"] == "/prediction") {
        let seq = prediction["seq"].as_u64().expect("a number");
        if last_seq.map_or(seq != 0, |last: u64| last + 1 != seq) {
            with_gap.insert(prediction["data"]["grasp_id"].as_u64().expect("an id"));
        }
        last_seq = Some(seq);
    }
    assert!(!with_gap.is_empty());
    let first_votes = |grasp_id: u64| lifts(&latest.decisions).contains(&grasp_id);
    let lifted: Vec<u64> = with_gap.iter().copied().filter(|grasp_id| first_votes(*grasp_id)).collect();
    assert_eq!(lifted, [0; 0], "lifted although a frame was missing");
}

/// On an edge that drops samples, the reader must not wait for a sample that may never come, even with a new writer.
#[test]
fn a_reader_of_the_latest_outlives_its_writers() {
    let folder = tempfile::tempdir().expect("a folder");
    let (what, by) = classifier_runs(&stubborn_classifier(), "{pause_ms: 3}");
    let by = by.replace("encoder/feature", "{from: encoder/feature, policy: latest, capacity: 4}");
    let graph = Graph::start(&dataflow_with(folder.path(), &[(what, by)]), &FAST_FOREVER);
    run(&["swap", "encoder", "--probation", "0.3", "--graph", &graph.name], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    graph.kill("encoder");
    graph.wait_for_decisions(A_FEW_GRASPS);
    // It misses more samples meanwhile than fit into the edge behind it.
    let reader = graph.pid_of("classifier");
    signal(reader, Signal::STOP);
    std::thread::sleep(Duration::from_millis(700));
    signal(reader, Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_eq!((ended.code, &ended.summary["restarts"]), (Some(3), &1.into()), "{}", ended.stderr);
    assert_eq!(ended.summary["samples_lost"], 0, "{}", ended.summary);
    // A grasp is not decided if all its frames were dropped.
    let ids: Vec<u64> = ended.decisions.iter().map(|line| line["grasp_id"].as_u64().expect("an id")).collect();
    assert!(ids.is_sorted_by(|a, b| a < b), "{ids:?}");
}

/// A graph in the background, which ends with the test.
struct Detached {
    pid: i32,
}

impl Drop for Detached {
    fn drop(&mut self) {
        let _ = rustix::process::kill_process(rustix::process::Pid::from_raw(self.pid).expect("a pid"), Signal::KILL);
    }
}

#[test]
fn a_graph_in_the_background_can_be_watched_set_and_stopped() {
    let folder = tempfile::tempdir().expect("a folder");
    let (name, flow) = (unique_name(), dataflow(folder.path(), &[]));
    let flow = flow.to_str().expect("UTF-8");
    let json = |arguments: &[&str]| json_lines(&run(arguments, 0).stdout).pop().expect("a line of JSON");
    let started = json(&[&["run", "--detach", "--json", "--name", &name, flow], &FAST_FOREVER[..]].concat());
    assert_eq!(started["graph"], *name);
    let detached = Detached { pid: started["pid"].as_i64().expect("a pid") as i32 };

    let status = json(&["ps", &name, "--json"])["graphs"][0].clone();
    assert_eq!((&status["state"], &status["pid"]), (&"running".into(), &detached.pid.into()));
    assert_eq!(status["nodes"].as_array().expect("nodes").len(), 5);
    assert!(text(&run(&["ps", &name], 0).stdout).contains(&format!("graph '{name}'  running")));
    let again = run(&["run", "--detach", "--name", &name, flow], 1);
    // The second command must not print the running graph's decisions as its own reason.
    let again = text(&again.stderr);
    assert!(again.contains("is running: stop it") && !again.contains("HOLD"), "{again}");
    let undetached = text(&run(&["run", "--name", &name, flow], 1).stderr);
    assert!(undetached.contains(&format!("a graph called '{name}' is running")), "{undetached}");

    let sent = || {
        let edges = json(&["ps", &name, "--json"])["graphs"][0]["edges"].clone();
        edges[0]["sent"].as_u64().expect("a count")
    };
    let before = sent();
    let set = json(&["set", "lift_arbiter.votes=5", "--graph", &name, "--json"]);
    assert_eq!((&set["old"], &set["new"]), (&3.into(), &5.into()), "{set}");
    assert!(
        (before.saturating_sub(64)..=sent()).contains(&set["from_seq"].as_u64().expect("a number")),
        "{before} {set}"
    );
    assert!(
        text(&run(&["set", "lift_arbiter.votes=4", "--graph", &name], 0).stdout).contains("lift_arbiter.votes: 5 → 4")
    );
    for (wrong, word) in [
        ("lift_arbiter.votes=0", "1"),
        ("lift_arbiter.votes=1001", "1000"),
        ("lift_arbiter.votes=many", "integer"),
        ("lift_arbiter.vote=5", "votes"),
        ("arbiter.votes=5", "lift_arbiter"),
        ("classifier.model=dataflow.yaml", "live"),
    ] {
        let stderr = text(&run(&["set", wrong, "--graph", &name], 1).stderr);
        assert!(stderr.contains(word), "{wrong}: {stderr}");
    }
    assert_eq!(json(&["ps", &name, "--json"])["graphs"][0]["nodes"][4]["params"]["votes"], 4);

    let said = run(&["logs", "run", "--graph", &name, "--lines", "100000"], 0);
    assert!(text(&said.stdout).contains("lift_arbiter.votes: 5 -> 4"), "{}", text(&said.stdout));
    let stopped = json(&["stop", &name, "--json"]);
    assert_eq!(stopped, serde_json::json!({ "ended": [&*name], "failed": [] }));
    assert_nothing_left(&name);
    for gone in [&["ps", &*name][..], &["stop", &name], &["set", "lift_arbiter.votes=5", "--graph", &name]] {
        let stderr = text(&run(gone, 1).stderr);
        assert!(stderr.contains(&name), "{gone:?}: {stderr}");
    }
    // The logs are still there, and end with the summary.
    let logs = text(&run(&["logs", "run", "--graph", &name], 0).stdout);
    assert!(logs.contains("\"summary\"") && logs.contains("\"samples_lost\":0"), "{logs}");
}
