//! Operators by others: in Python, and from the scaffold, in graphs as a user would run them.

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use common::{
    Ended, FAST_FOREVER, Graph, MODEL, RECORDING, blindgrasp, classifier_runs, dataflow, dataflow_with, json_lines,
    of_node, operator, project, run, script, signal, text, wait_until,
};
use rustix::process::Signal;
use serde_json::Value;

/// How many grasps are awaited to see that all goes on.
const A_FEW_GRASPS: usize = 20;

/// The environment with what Python operators need, made once.
fn python() -> &'static Path {
    static PYTHON: OnceLock<PathBuf> = OnceLock::new();
    PYTHON.get_or_init(|| {
        let output = Command::new(project().join("scripts/python-env")).output().expect("started");
        assert!(output.status.success(), "{}", text(&output.stderr));
        PathBuf::from(text(&output.stdout).trim()).join("bin/python")
    })
}

/// A program of ours in that environment: Python's `.pyc` files stay out of the sources.
fn python_operator(folder: &Path, program: &Path) -> PathBuf {
    let name = format!("run-{}", program.file_stem().expect("a name").to_string_lossy());
    script(
        folder,
        &name,
        &format!("exec env PYTHONDONTWRITEBYTECODE=1 {} {} \"$@\"", python().display(), program.display()),
    )
}

fn shell(folder: &Path, program: &Path, arguments: &[&str], exit_code: i32) -> Output {
    let mut command = Command::new(program);
    command.current_dir(folder).args(arguments).env("PYTHONDONTWRITEBYTECODE", "1");
    let output = command.output().expect("started");
    assert_eq!(
        output.status.code(),
        Some(exit_code),
        "{} {arguments:?}\n{}\n{}",
        program.display(),
        text(&output.stdout),
        text(&output.stderr)
    );
    output
}

fn utf8(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// A scikit-learn model of the project's own recording, made once, as a user makes one.
fn sklearn_model() -> &'static Path {
    static MODEL_FILE: OnceLock<(PathBuf, tempfile::TempDir)> = OnceLock::new();
    let (path, _) = MODEL_FILE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder");
        let (table, out) = (folder.path().join("features.csv"), folder.path().join("forest.joblib"));
        run(&["features", RECORDING, "--model", MODEL, "--out", utf8(&table)], 0);
        let train = project().join("operators/train_sklearn.py");
        let arguments = [utf8(&train), utf8(&table), "--out", utf8(&out), "--json", "--param", "max_iter=20"];
        let output = shell(folder.path(), python(), &arguments, 0);
        let summary = &json_lines(&output.stdout)[0];
        // Half of the grasps are stable: better than by chance.
        assert!(summary["accuracy"].as_f64() > Some(0.7), "{summary}");
        (out, folder)
    });
    path
}

fn sklearn_classifier(folder: &Path) -> PathBuf {
    python_operator(folder, &project().join("operators/sklearn_classifier.py"))
}

fn swap(graph: &Graph, arguments: &[&str], exit_code: i32) -> (Value, String) {
    let output = run(&[&["swap", "--graph", &graph.name, "--json"], arguments].concat(), exit_code);
    (json_lines(&output.stdout).pop().unwrap_or_default(), text(&output.stderr))
}

/// Asserts that no sample was lost, that `ps` and the summary count the same on both ends of each edge, and that each grasp
/// was decided once and in order.
fn assert_each_once(ended: &Ended) {
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &0.into()), "{}", ended.stderr);
    for (grasp_id, line) in ended.decisions.iter().enumerate() {
        assert_eq!(line["grasp_id"], grasp_id, "{line}");
    }
    let reasons = &ended.summary["reasons"];
    for wrong in ["out_of_order", "invalid", "stale", "wrong_model", "wrong_hand"] {
        assert!(reasons.get(wrong).is_none_or(|n| *n == 0), "{}", ended.summary);
    }
    for edge in ended.summary["edges"].as_array().expect("edges") {
        assert_eq!(edge["sent"], edge["received"], "{edge}");
        assert_eq!((&edge["missing"], &edge["dropped"]), (&0.into(), &0.into()), "{edge}");
    }
}

fn with_sklearn(folder: &Path) -> PathBuf {
    let params = format!("{{model: {}}}", sklearn_model().display());
    dataflow_with(folder, &[classifier_runs(&sklearn_classifier(folder), &params)])
}

#[test]
fn a_python_classifier_decides_each_grasp_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = with_sklearn(folder.path());
    let recorded = folder.path().join("run.mcap");
    let name = common::unique_name();
    let output = run(&["run", "--json", "--name", &name, utf8(&flow), "--record", utf8(&recorded)], 0);
    let lines = json_lines(&output.stdout);
    let summary = &lines[lines.len() - 1]["summary"];
    assert_eq!((&summary["grasps"], &summary["samples_lost"]), (&240.into(), &0.into()), "{summary}");
    // It was trained on these very grasps.
    assert!(summary["accuracy"].as_f64() > Some(0.85), "{summary}");
    // What it has sent is what its own probabilities say, and of the sample that it answers.
    let exported = run(&["export", utf8(&recorded), "--topic", "/prediction", "--topic", "/histogram"], 0);
    let (mut n_judged, mut asked) = (0, std::collections::HashMap::new());
    for line in json_lines(&exported.stdout) {
        let key = line["seq"].as_u64().expect("a number");
        if line["topic"] == "/histogram" {
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
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let flow = dataflow_with(folder, &[of_node("classifier", &["heartbeat_ms: 1500"])]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    let python = sklearn_classifier(folder);
    let model = format!("model={}", sklearn_model().display());
    let to_python = ["classifier", "--run", utf8(&python), "--set", &model, "--probation", "0.3"];
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
    for n_restarts in 1..=2 {
        signal(graph.pid_of("classifier"), Signal::KILL);
        graph.wait_for_restart("classifier", n_restarts);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    // Shorter than its heartbeat: its writers wait.
    let stopped = graph.pid_of("classifier");
    signal(stopped, Signal::STOP);
    std::thread::sleep(std::time::Duration::from_millis(400));
    signal(stopped, Signal::CONT);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // For good: it is found to hang, killed and started again.
    signal(graph.pid_of("classifier"), Signal::STOP);
    graph.wait_for_restart("classifier", 3);
    graph.wait_for_decisions(A_FEW_GRASPS);
    // Its neighbours.
    for (node, n_restarts) in [("histogram", 1), ("lift_arbiter", 1)] {
        signal(graph.pid_of(node), Signal::KILL);
        graph.wait_for_restart(node, n_restarts);
        graph.wait_for_decisions(A_FEW_GRASPS);
    }
    let ended = graph.stop();
    assert_each_once(&ended);
    assert_eq!((&ended.summary["swaps"], &ended.summary["restarts"]), (&6.into(), &5.into()), "{}", ended.stderr);
}

#[test]
fn a_python_operator_waits_for_its_reader_and_gives_way() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&with_sklearn(folder.path()), &FAST_FOREVER);
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
                std::thread::sleep(std::time::Duration::from_millis(200));
                let now = sent(&graph);
                std::mem::replace(&mut before, now) == now
            },
            || graph.said(),
        );
        let go_on = std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_millis(400));
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
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let python = sklearn_classifier(folder);
    let graph = Graph::start(&dataflow(folder, &[]), &FAST_FOREVER);
    let refused = |model: &Path, reason: &str| {
        let model = format!("model={}", model.display());
        let (_, stderr) = swap(&graph, &["classifier", "--run", utf8(&python), "--set", &model], 1);
        assert!(stderr.contains(reason) && !stderr.contains("Traceback"), "{stderr}");
    };
    let damaged = folder.join("damaged.joblib");
    std::fs::write(&damaged, "not a model").expect("written");
    refused(&damaged, "not a model of train_sklearn.py");
    refused(&folder.join("none.joblib"), "none.joblib");
    // Of another dictionary: its neighbours would not understand it, and without them it says so itself.
    let other = folder.join("other.joblib");
    let change = format!(
        "import joblib; model = joblib.load({:?}); model['dictionary_id'] = '00000000000000ff'; joblib.dump(model, {:?})",
        utf8(sklearn_model()),
        utf8(&other)
    );
    shell(folder, self::python(), &["-c", &change], 0);
    refused(&other, "'classifier' is made for the ");
    let model = format!("model={}", other.display());
    swap(&graph, &["classifier", "--run", utf8(&python), "--set", &model, "--allow-mismatch", "--probation", "0.1"], 0);
    graph.wait_for_decisions(A_FEW_GRASPS);
    let ended = graph.stop();
    assert_eq!(ended.summary["samples_lost"], 0);
    assert!(ended.summary["reasons"]["wrong_model"].as_u64() > Some(10), "{}", ended.summary);
}

/// Makes an operator with `blindgrasp new operator`.
fn scaffold(folder: &Path, name: &str, arguments: &[&str]) -> PathBuf {
    let output =
        blindgrasp().current_dir(folder).args(["new", "operator", name]).args(arguments).output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let made = folder.join(name);
    for file in files_of(&made) {
        let content = std::fs::read_to_string(&file).expect("text");
        assert!(!content.contains("{{") || content.contains("}}\")"), "{}: {content}", file.display());
    }
    made
}

fn files_of(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("readable").flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files_of(&path) } else { vec![path] }).collect()
}

/// Builds and tests a scaffold in Rust as its README says; where it is built lies under our own target folder, so that what
/// it is built on is built once.
fn build(made: &Path) -> PathBuf {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("scaffold");
    for arguments in [&["build", "--release"][..], &["test", "--release"]] {
        let output = Command::new(env!("CARGO"))
            .current_dir(made)
            .args(arguments)
            .env("CARGO_TARGET_DIR", &target)
            .env("RUSTFLAGS", "-D warnings")
            .output()
            .expect("started");
        assert!(output.status.success(), "cargo {arguments:?}\n{}\n{}", text(&output.stdout), text(&output.stderr));
    }
    target.join("release").join(made.file_name().expect("a name"))
}

#[test]
fn scaffolds_in_rust_and_python_build_run_and_agree() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let rust = scaffold(folder, "rust_pads", &[]);
    let in_python = scaffold(folder, "python_pads", &["--python"]);
    shell(&in_python, python(), &["-m", "unittest"], 0);
    let rust_program = build(&rust);
    let python_program = python_operator(folder, &in_python.join("python_pads.py"));
    let flow = dataflow_with(folder, &[classifier_runs(&rust_program, "{min_pads: 3}")]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    // What both say of the same samples is the same.
    let gate = ["--shadow", "1", "--promote-if", "agreement>=1", "--probation", "0.3"];
    let (swapped, _) = swap(&graph, &[&["classifier", "--run", utf8(&python_program)], &gate[..]].concat(), 0);
    assert_eq!((&swapped["result"], &swapped["shadow"][0]["agreement"]), (&"swapped".into(), &1.0.into()), "{swapped}");
    assert!(swapped["shadow"][0]["n_pairs"].as_u64() > Some(100), "{swapped}");
    // Live parameters, in Python: nothing has five hundred pads.
    run(&["set", "--graph", &graph.name, "classifier.min_pads=500"], 0);
    let n_before = graph.n_decisions();
    graph.wait_for_decisions(3 * A_FEW_GRASPS);
    let (_, stderr) = {
        let output = run(&["set", "--graph", &graph.name, "classifier.min_pads=-1"], 1);
        (text(&output.stdout), text(&output.stderr))
    };
    assert!(stderr.contains("min_pads"), "{stderr}");
    let ended = graph.stop();
    assert_each_once(&ended);
    let lifted = |line: &&Value| line["action"] == "lift";
    assert!(ended.decisions[..n_before].iter().any(|line| lifted(&line)));
    // One grasp may be amid the change.
    assert!(!ended.decisions[n_before + 5..].iter().any(|line| lifted(&line)));
}

#[test]
fn every_scaffold_builds_and_runs() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let from_tactile = "    inputs: {tactile: recorded_source/tactile}\n";
    for (name, arguments, from, param) in [
        ("frames", &["--from", "TactileFrame"][..], "tactile: recorded_source/tactile", "min_newtons"),
        (
            "felt",
            &["--from", "blindgrasp/ContactSet/3", "--to", "Prediction"],
            "contacts: contacts/contacts",
            "min_newtons",
        ),
        ("denoise", &["--like", "filter"], "", "min_newtons"),
    ] {
        let rust = build(&scaffold(folder, &format!("rust_{name}"), arguments));
        let made = scaffold(folder, &format!("python_{name}"), &[arguments, &["--python"]].concat());
        shell(&made, python(), &["-m", "unittest"], 0);
        let in_python = python_operator(folder, &made.join(format!("python_{name}.py")));
        let decisions: Vec<_> = [rust, in_python]
            .iter()
            .map(|program| {
                let flow = if from.is_empty() {
                    let filter = format!("  filter:\n    run: {}\n{from_tactile}  contacts:\n", program.display());
                    let replace = [
                        ("  contacts:\n", filter.as_str()),
                        (
                            "tactile: recorded_source/tactile}\n    params: {hand",
                            "tactile: filter/tactile}\n    params: {hand",
                        ),
                    ];
                    dataflow(folder, &replace)
                } else {
                    let (what, by) = classifier_runs(program, &format!("{{{param}: 5}}"));
                    dataflow(folder, &[(&what, &by.replace("histogram: histogram/histogram", from))])
                };
                common::decisions_of(&flow)
            })
            .collect();
        assert_eq!(decisions[0].len(), 240, "{name}");
        assert_eq!(decisions[0], decisions[1], "{name}");
        assert!(decisions[0].iter().any(|(action, _)| action == "lift"), "{name}");
    }
}

#[test]
fn a_scaffold_is_built_without_science_and_simulator() {
    let folder = tempfile::tempdir().expect("a folder");
    let made = scaffold(folder.path(), "pads", &[]);
    let tree = ["tree", "--edges", "normal,build", "--prefix", "none", "--format", "{p}"];
    let output = Command::new(env!("CARGO")).current_dir(&made).args(tree).output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let tree = text(&output.stdout);
    let names: std::collections::BTreeSet<&str> = tree.lines().filter_map(|line| line.split(' ').next()).collect();
    assert!(names.contains("blindgrasp") && names.contains("iceoryx2"), "{names:?}");
    for heavy in ["mcap", "parry3d-f64", "nalgebra", "ratatui", "hessboost", "clap", "rayon", "zstd-sys", "urdf-rs"] {
        assert!(!names.contains(heavy), "{heavy} is among {names:?}");
    }
}

#[test]
fn what_cannot_be_made_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let refused = |arguments: &[&str], reason: &str| {
        let output =
            blindgrasp().current_dir(folder).args(["new", "operator"]).args(arguments).output().expect("started");
        assert_eq!(output.status.code(), Some(1), "{arguments:?}");
        assert!(text(&output.stderr).contains(reason), "{arguments:?}: {}", text(&output.stderr));
    };
    for name in ["My", "9lives", "with space", "a-b", "ä", "", ".."] {
        refused(&[name], "is not a name for an operator");
    }
    for name in ["fn", "test", "numpy", "json"] {
        refused(&[name, "--python"], "choose another name");
    }
    refused(&["no/such/folder/pads"], "make it first");
    refused(&["pads", "--from", "Prediction"], "expected --from TactileFrame");
    refused(&["pads", "--blindgrasp", "."], "--blindgrasp FOLDER");
    assert!(!folder.join("pads").exists());
    std::fs::write(folder.join("pads"), "mine").expect("written");
    refused(&["pads"], "nothing is overwritten");
    assert_eq!(std::fs::read_to_string(folder.join("pads")).expect("there"), "mine");
}

#[test]
fn what_python_raises_is_said_in_words_and_its_traceback_is_logged() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let made = scaffold(folder, "broken", &["--python"]);
    let path = made.join("broken.py");
    let program = std::fs::read_to_string(&path).expect("there");
    let broken = program.replace(
        "    return fault_of(head), ",
        "    if head.header.seq == 100:\n        raise ValueError(\"a grasp too far\")\n    return fault_of(head), ",
    );
    assert_ne!(broken, program);
    std::fs::write(&path, broken).expect("written");
    let flow = dataflow_with(
        folder,
        &[classifier_runs(&python_operator(folder, &path), "{}"), of_node("classifier", &["restart: never"])],
    );
    let name = common::unique_name();
    let output = run(&["run", "--json", "--name", &name, utf8(&flow)], 1);
    let stderr = text(&output.stderr);
    assert!(stderr.contains("ValueError: a grasp too far") && !stderr.contains("Traceback"), "{stderr}");
    let logged = run(&["logs", "classifier", "--graph", &name], 0);
    assert!(text(&logged.stdout).contains("in measure"), "{}", text(&logged.stdout));
}

#[test]
fn shipped_python_operators_describe_themselves_without_what_they_need_later() {
    for program in ["sklearn_classifier.py"] {
        // Without site packages: neither iceoryx2 nor numpy nor scikit-learn.
        let path = project().join("operators").join(program);
        let output = shell(project(), Path::new("python3"), &["-I", "-S", "-c", "pass"], 0);
        assert!(output.status.success());
        let output = shell(project(), Path::new("python3"), &["-S", utf8(&path), "--describe"], 0);
        let description: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let rust = shell(project(), &operator("classifier"), &["--describe"], 0);
        let rust: Value = serde_json::from_slice(&rust.stdout).expect("JSON");
        for ports in ["inputs", "outputs"] {
            for field in ["name", "type"] {
                assert_eq!(description[ports][0][field], rust[ports][0][field]);
            }
        }
    }
}
