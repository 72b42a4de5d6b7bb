//! Operators in Python, in graphs as a user would run them.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

use crate::common::python::{assert_each_once, python, python_operator, shell, utf8};
use crate::common::{
    A_FEW_GRASPS, Ended, FAST_FOREVER, Graph, MODEL, RECORDING, classifier_runs, dataflow, dataflow_with, json_lines,
    json_of, of_node, project, run, shared_folder, signal, swap, text, unique_name, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// Starts a graph. Writers wait for a reader for 5 s by default, and scikit-learn takes longer to be imported on a busy
/// machine.
fn start(flow: &Path) -> Graph {
    Graph::start(flow, &[&FAST_FOREVER[..], &["--wait-limit", "60"]].concat())
}

/// A scikit-learn model of the project's own recording, made once, as a user makes one.
fn sklearn_model() -> &'static Path {
    static MODEL_FILE: OnceLock<PathBuf> = OnceLock::new();
    MODEL_FILE.get_or_init(|| {
        let folder = shared_folder("sklearn");
        let (table, out) = (folder.join("features.csv"), folder.join("forest.joblib"));
        run(&["export", RECORDING, "--features", MODEL, "--out", utf8(&table)], 0);
        let train = project().join("operators/train_sklearn.py");
        let arguments = [utf8(&train), utf8(&table), "--out", utf8(&out), "--json", "--param", "max_iter=20"];
        let output = shell(&folder, python(), &arguments, 0);
        let summary = &json_lines(&output.stdout)[0];
        // Half of the grasps are stable: better than by chance.
        assert!(summary["accuracy"].as_f64() > Some(0.7), "{summary}");
        out
    })
}

fn sklearn_classifier(folder: &Path) -> PathBuf {
    python_operator(folder, &project().join("operators/sklearn_classifier.py"))
}

fn with_sklearn(folder: &Path) -> PathBuf {
    let params = format!("{{model: {}}}", sklearn_model().display());
    dataflow_with(folder, &[classifier_runs(&sklearn_classifier(folder), &params)])
}

#[test]
fn a_python_classifier_decides_each_grasp_once() {
    sklearn_model();
    let folder = tempfile::tempdir().expect("a folder");
    let flow = with_sklearn(folder.path());
    let recorded = folder.path().join("run.mcap");
    let fast = ["--set", "recorded_source.rate=max", "--set", "lift_arbiter.max_age_ms=600000"];
    let record = ["--record", utf8(&recorded)];
    let ended = Graph::launch(&crate::common::unique_name(), &flow, &[&fast[..], &record].concat()).finish();
    let summary = &ended.summary;
    assert_eq!((&summary["grasps"], &summary["samples_lost"]), (&240.into(), &0.into()), "{summary}");
    // It was trained on these very grasps.
    assert!(summary["accuracy"].as_f64() > Some(0.85), "{summary}");
    // Each prediction agrees with its own probability, and belongs to the feature that it answers.
    let exported = run(&["export", utf8(&recorded), "--topic", "/prediction", "--topic", "/feature"], 0);
    let (mut n_judged, mut asked) = (0, std::collections::HashMap::new());
    for line in json_lines(&exported.stdout) {
        let key = line["seq"].as_u64().expect("a number");
        if line["topic"] == "/feature" {
            asked.insert(key, line["data"].clone());
            continue;
        }
        let (said, of) = (&line["data"], &asked[&key]);
        for field in ["grasp_id", "phase", "fault"] {
            assert_eq!(said[field], of[field], "{line}");
        }
        let probability = said["probability_stable"].as_f64().expect("a number");
        assert_eq!(said["stable"], (said["fault"] == "none" && probability >= 0.5), "{line}");
        n_judged += usize::from(said["fault"] == "none");
    }
    assert!(n_judged > 1000, "{n_judged}");
}

#[test]
fn a_python_classifier_is_swapped_in_killed_stopped_and_swapped_out_without_a_loss() {
    sklearn_model();
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let flow = dataflow_with(folder, &[of_node("classifier", &["heartbeat_ms: 2000"])]);
    let graph = start(&flow);
    let program = sklearn_classifier(folder);
    let model = format!("model={}", sklearn_model().display());
    let to_python = ["classifier", "--run", utf8(&program), "--set", &model, "--probation", "0.3"];
    let rust_model = format!("model={}", project().join(MODEL).display());
    let to_rust = ["classifier", "--run", "classifier", "--set", &rust_model, "--probation", "0.3"];
    for _ in 0..2 {
        for arguments in [&to_python, &to_rust] {
            let (swapped, _) = swap(&graph, arguments, 0);
            assert_eq!(swapped["result"], "swapped", "{swapped}");
            graph.wait_for_decisions(A_FEW_GRASPS);
        }
    }
    swap(&graph, &to_python, 0);
    // One Python process after the other.
    swap(&graph, &["classifier", "--probation", "0.3"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    for _ in 0..2 {
        graph.kill("classifier");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Shorter than its heartbeat: its writers wait.
    let stopped = graph.pid_of("classifier");
    signal(stopped, Signal::STOP);
    std::thread::sleep(Duration::from_millis(300));
    signal(stopped, Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // Stopped for good, it is found to hang, killed and started again.
    signal(graph.pid_of("classifier"), Signal::STOP);
    graph.wait_for_restart("classifier", 3);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // Its neighbours are killed.
    for node in ["encoder", "lift_arbiter"] {
        graph.kill(node);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    assert_each_once(&ended);
    assert_eq!((&ended.summary["swaps"], &ended.summary["restarts"]), (&6.into(), &5.into()), "{}", ended.stderr);
}

#[test]
fn a_python_operator_waits_for_its_reader_and_gives_way() {
    sklearn_model();
    let folder = tempfile::tempdir().expect("a folder");
    let graph = start(&with_sklearn(folder.path()));
    for arguments in [&["classifier", "--probation", "0.1"][..], &["classifier", "lift_arbiter", "--probation", "0.1"]]
    {
        let reader = graph.pid_of("lift_arbiter");
        signal(reader, Signal::STOP);
        // Until its queue is full.
        let sent = |graph: &Graph| -> u64 {
            let status = graph.status();
            let edges = status["edges"].as_array().expect("edges").clone();
            edges.iter().find(|edge| edge["to"] == "lift_arbiter/prediction").expect("the edge")["sent"]
                .as_u64()
                .expect("a count")
        };
        let mut before = 0;
        wait_until(
            || {
                std::thread::sleep(Duration::from_millis(200));
                let now = sent(&graph);
                std::mem::replace(&mut before, now) == now
            },
            || graph.said(),
        );
        let go_on = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(400));
            signal(reader, Signal::CONT);
        });
        swap(&graph, arguments, 0);
        go_on.join().expect("continued");
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    assert_each_once(&ended);
}

#[test]
fn models_that_do_not_fit_are_refused_in_words() {
    sklearn_model();
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let program = sklearn_classifier(folder);
    let graph = start(&dataflow(folder, &[]));
    let refused = |model: &Path, reason: &str| {
        let model = format!("model={}", model.display());
        let (_, stderr) = swap(&graph, &["classifier", "--run", utf8(&program), "--set", &model], 1);
        assert!(stderr.contains(reason) && !stderr.contains("Traceback"), "{stderr}");
    };
    let damaged = folder.join("damaged.joblib");
    std::fs::write(&damaged, "not a model").expect("written");
    refused(&damaged, "not a model of train_sklearn.py");
    refused(&folder.join("none.joblib"), "none.joblib");
    // A model with another dictionary does not fit its neighbours. Without that check, the model itself refuses.
    let other = folder.join("other.joblib");
    let change = format!(
        "import joblib; model = joblib.load({:?}); model['dictionary_id'] = '00000000000000ff'; joblib.dump(model, {:?})",
        utf8(sklearn_model()),
        utf8(&other)
    );
    shell(folder, python(), &["-c", &change], 0);
    refused(&other, "'classifier' is made for the ");
    let model = format!("model={}", other.display());
    swap(
        &graph,
        &["classifier", "--run", utf8(&program), "--set", &model, "--allow-mismatch", "--probation", "0.1"],
        0,
    );
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_eq!(ended.summary["samples_lost"], 0);
    assert!(ended.summary["reasons"]["wrong_model"].as_u64() > Some(3), "{}", ended.summary);
}

/// The kinds of sources in Python: one that can give its samples again, and one whose samples come once.
const KINDS_OF_SOURCE: [&str; 2] = ["recording", "device"];
/// A node may be killed often, and comes back at once.
const PATIENT: &str = "    restart: {policy: on-failure, limit: 1000, within_s: 60, backoff_ms: 1}\n";
/// Arguments of `run` for a graph with the source of [`with_source`], which plays the recording over and over.
const PLAY_ON: [&str; 6] =
    ["--set", "recorded_source.repeat=100000", "--set", "lift_arbiter.max_age_ms=600000", "--wait-limit", "60"];

/// The frames and labels of the project's recording as lines of JSON.
fn exported() -> &'static Path {
    static LINES: OnceLock<PathBuf> = OnceLock::new();
    LINES.get_or_init(|| {
        let path = shared_folder("python_source").join("lines.jsonl");
        let exported = run(&["export", RECORDING, "--topic", "/tactile", "--topic", "/truth"], 0);
        std::fs::write(&path, exported.stdout).expect("written");
        path
    })
}

/// Replacements for [`dataflow`]: `tests/python_source.py` plays the recording.
pub(crate) fn with_source(folder: &Path, kind: &str) -> Vec<(String, String)> {
    let recording = blindgrasp_recording::RecordingReader::open(&project().join(RECORDING)).expect("readable");
    let hand_id = recording.info().hand_id;
    let program = python_operator(folder, &project().join("tests/python_source.py"));
    let at = "  recorded_source:\n    params:\n      recording: recordings/held-out.mcap\n";
    let params = format!("{{lines: {}, hand_id: '{hand_id:016x}', like: {kind}}}", exported().display());
    let node = format!("  recorded_source:\n    run: {}\n{PATIENT}    params: {params}\n", program.display());
    let rest = "      rate: 10                       # times the recorded speed, or max\n    sandbox: on\n";
    vec![(at.into(), node), (rest.into(), String::new())]
}

/// Replacements for [`dataflow`]: frames go through operators with several ports, `tests/python_ports.py`.
fn with_ports(folder: &Path) -> Vec<(String, String)> {
    let program = python_operator(folder, &project().join("tests/python_ports.py"));
    let node = |id: &str, inputs: &str| {
        format!("  {id}:\n    run: {}\n    args: [{id}]\n    inputs: {{{inputs}}}\n{PATIENT}", program.display())
    };
    let split = node("split", "tactile: recorded_source/tactile");
    let join = node("join", "a: split/a, b: split/b, truth: recorded_source/truth");
    let check = node("check", "counted: join/counted");
    let end = "    sandbox: on\n  encoder:";
    vec![
        ("  contacts:\n".into(), format!("{split}{join}{check}  contacts:\n")),
        (
            format!("    inputs: {{tactile: recorded_source/tactile}}\n{end}"),
            format!("    inputs: {{tactile: join/tactile}}\n{end}"),
        ),
    ]
}

/// The process of a node, once it has one again.
fn pid_of(graph: &Graph, node: &str) -> i32 {
    wait_until(|| graph.node(node)["pid"].is_i64(), || graph.said());
    graph.pid_of(node)
}

/// Kills, hangs and swaps a node, alone and with one of its readers, with decisions in between.
fn disturb(graph: &Graph, node: &str, reader: &str) {
    let is_alone = node == reader;
    for _ in 0..2 {
        pid_of(graph, node);
        graph.kill(node);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    swap(graph, &[node, "--probation", "0.3"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    if !is_alone {
        for pid in [pid_of(graph, node), pid_of(graph, reader)] {
            signal(pid, Signal::KILL);
        }
        graph.wait_for_decisions(A_FEW_GRASPS);
        // Its reader stands still meanwhile.
        let (slow, killed) = (pid_of(graph, reader), pid_of(graph, node));
        signal(slow, Signal::STOP);
        std::thread::sleep(Duration::from_millis(300));
        signal(killed, Signal::KILL);
        std::thread::sleep(Duration::from_millis(300));
        signal(slow, Signal::CONT);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // It is found to hang.
    let stopped = pid_of(graph, node);
    signal(stopped, Signal::STOP);
    wait_until(|| graph.node(node)["pid"].as_i64().is_some_and(|pid| pid as i32 != stopped), || graph.said());
    graph.wait_for_decisions(A_FEW_GRASPS);
}

fn assert_as_if_undisturbed(ended: &Ended, what: &str) {
    ended.assert_undisturbed(what);
    assert_each_once(ended);
}

#[test]
fn a_source_in_python_decides_as_the_recorded_source_does() {
    for kind in KINDS_OF_SOURCE {
        let folder = tempfile::tempdir().expect("a folder");
        let flow = dataflow_with(folder.path(), &with_source(folder.path(), kind));
        let fast = ["--set", "recorded_source.period_ms=0", "--set", "lift_arbiter.max_age_ms=600000"];
        let ended = Graph::launch(&unique_name(), &flow, &fast).finish();
        assert_as_if_undisturbed(&ended, kind);
        assert_eq!((ended.decisions.len(), &ended.summary["end"]), (240, &"finished".into()), "{kind}");
        // Each label belongs to its grasp.
        assert!(ended.summary["accuracy"].as_f64() > Some(0.85), "{}", ended.summary);
    }
}

#[test]
fn a_source_in_python_is_killed_stopped_and_swapped_without_a_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow_with(folder.path(), &with_source(folder.path(), "recording")), &PLAY_ON);
    disturb(&graph, "recorded_source", "contacts");
    run(&["set", "--graph", &graph.name, "recorded_source.period_ms=0"], 0);
    disturb(&graph, "recorded_source", "contacts");
    assert_as_if_undisturbed(&graph.stop(), "a source that can give its samples again");
}

/// The source is one whose samples come once.
#[test]
fn a_graph_with_a_source_and_several_ports_in_python_is_disturbed_anywhere_without_a_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let replace = [with_source(folder.path(), "device"), with_ports(folder.path())].concat();
    let graph = Graph::start(&dataflow_with(folder.path(), &replace), &PLAY_ON);
    disturb(&graph, "recorded_source", "split");
    run(&["set", "--graph", &graph.name, "recorded_source.period_ms=0"], 0);
    let neighbours =
        [("recorded_source", "split"), ("split", "join"), ("join", "contacts"), ("join", "check"), ("check", "check")];
    for (node, reader) in neighbours {
        disturb(&graph, node, reader);
    }
    assert_as_if_undisturbed(&graph.stop(), "source and several ports");
}

#[test]
fn a_source_in_python_whose_samples_cannot_be_saved_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow_with(folder.path(), &with_source(folder.path(), "device"));
    let name = unique_name();
    let stderr =
        text(&run(&["run", "--name", &name, "--set", "recorded_source.max_items=65536", utf8(&flow)], 1).stderr);
    assert!(stderr.contains("expected at most") && stderr.contains("give a smaller max_items"), "{stderr}");
}

#[test]
fn the_python_module_keeps_its_promises_without_a_graph() {
    shell(project(), python(), &["tests/operator_module.py"], 0);
}

#[test]
fn shipped_python_operators_describe_themselves_without_their_libraries() {
    // Without site packages: neither numpy nor scikit-learn.
    let output = shell(project(), Path::new("python3"), &["-S", "operators/sklearn_classifier.py", "--describe"], 0);
    let description: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let rust = json_of(&["operator", "classifier", "--describe"]);
    for ports in ["inputs", "outputs"] {
        for field in ["name", "type"] {
            assert_eq!(description[ports][0][field], rust[ports][0][field]);
        }
    }
}
