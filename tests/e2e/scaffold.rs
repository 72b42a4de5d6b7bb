//! `blindgrasp new operator`: the operators that it makes build and run.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::python::{assert_each_once, python, python_operator, shell, utf8};
use crate::common::{
    A_FEW_GRASPS, FAST_FOREVER, Graph, blindgrasp, classifier_runs, dataflow, dataflow_with, of_node, program, project,
    run, swap, text,
};
use serde_json::Value;

/// Makes an operator with `blindgrasp new operator`; one in Rust is built on this source tree.
fn scaffold(folder: &Path, name: &str, arguments: &[&str]) -> PathBuf {
    let mut command = blindgrasp();
    command.current_dir(folder).args(["new", "operator", name]).args(arguments);
    if !arguments.contains(&"--python") {
        command.arg("--blindgrasp").arg(project());
    }
    let output = command.output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let made = folder.join(name);
    for file in files_of(&made) {
        let content = std::fs::read_to_string(&file).expect("text");
        assert!(!content.contains("{{"), "{}: {content}", file.display());
    }
    made
}

fn files_of(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("readable").flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { files_of(&path) } else { vec![path] }).collect()
}

/// Builds and tests a scaffold in Rust as its README says, with the libraries of the scaffolds before it. They are not those of the
/// check, whose features are those of the whole workspace; unoptimised, they are compiled in a part of the time.
fn build(made: &Path) -> PathBuf {
    let target = Path::new(program()).ancestors().nth(2).expect("a folder");
    for command in ["build", "test"] {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.current_dir(made).args([command, "--offline"]).env("CARGO_TARGET_DIR", target);
        cargo.env("CARGO_PROFILE_DEV_DEBUG", "0").env("CARGO_INCREMENTAL", "0");
        let output = cargo.output().expect("started");
        let (stdout, stderr) = (text(&output.stdout), text(&output.stderr));
        assert!(!stderr.contains("warning"), "{stderr}");
        assert!(output.status.success(), "cargo {command}\n{stdout}\n{stderr}");
    }
    target.join("debug").join(made.file_name().expect("a name"))
}

#[test]
fn scaffolds_in_rust_and_python_build_run_and_agree() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let rust = scaffold(folder, "rust_pads", &[]);
    let in_python = scaffold(folder, "python_pads", &["--python"]);
    shell(&in_python, python(), &["-m", "unittest"], 0);
    let rust_program = build(&rust);
    let python_program = python_operator(folder, &in_python.join("main.py"));
    let flow = dataflow_with(folder, &[classifier_runs(&rust_program, "{min_pads: 3}")]);
    let graph = Graph::start(&flow, &FAST_FOREVER);
    // Both answer the same samples alike.
    let gate = ["--shadow", "1", "--min-agreement", "1", "--probation", "0.3"];
    let (swapped, _) = swap(&graph, &[&["classifier", "--run", utf8(&python_program)], &gate[..]].concat(), 0);
    assert_eq!((&swapped["result"], &swapped["shadow"][0]["agreement"]), (&"swapped".into(), &1.0.into()), "{swapped}");
    assert!(swapped["shadow"][0]["n_pairs"].as_u64() > Some(100), "{swapped}");
    // A live parameter in Python: no hand has five hundred pads.
    run(&["set", "--graph", &graph.name, "classifier.min_pads=500"], 0);
    let n_before = graph.n_decisions();
    graph.wait_for_decisions(3 * A_FEW_GRASPS);
    let stderr = text(&run(&["set", "--graph", &graph.name, "classifier.min_pads=-1"], 1).stderr);
    assert!(stderr.contains("min_pads"), "{stderr}");
    let ended = graph.stop();
    assert_each_once(&ended);
    let lifted = |line: &&Value| line["action"] == "lift";
    assert!(ended.decisions[..n_before].iter().any(|line| lifted(&line)));
    // The change may come within a grasp.
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
            &["--from", "blindgrasp/ContactSet/7", "--to", "Prediction"],
            "contacts: contacts/contacts",
            "min_newtons",
        ),
        ("denoise", &["--like", "filter"], "", "min_newtons"),
    ] {
        let rust = build(&scaffold(folder, &format!("rust_{name}"), arguments));
        let made = scaffold(folder, &format!("python_{name}"), &[arguments, &["--python"]].concat());
        shell(&made, python(), &["-m", "unittest"], 0);
        let in_python = python_operator(folder, &made.join("main.py"));
        let decisions: Vec<_> = [rust, in_python]
            .iter()
            .map(|program| {
                let flow = if from.is_empty() {
                    let filter = format!("  filter:\n    run: {}\n{from_tactile}  contacts:\n", program.display());
                    let replace = [
                        ("  contacts:\n", filter.as_str()),
                        (
                            "tactile: recorded_source/tactile}\n    sandbox: on\n  encoder:",
                            "tactile: filter/tactile}\n    sandbox: on\n  encoder:",
                        ),
                    ];
                    dataflow(folder, &replace)
                } else {
                    let (what, by) = classifier_runs(program, &format!("{{{param}: 5}}"));
                    dataflow(folder, &[(&what, &by.replace("feature: encoder/feature", from))])
                };
                crate::common::decisions_of(&flow)
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
    let tree = ["tree", "--offline", "--edges", "normal,build", "--prefix", "none", "--format", "{p}"];
    let output = Command::new(env!("CARGO")).current_dir(&made).args(tree).output().expect("started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let tree = text(&output.stdout);
    let names: std::collections::BTreeSet<&str> = tree.lines().filter_map(|line| line.split(' ').next()).collect();
    let ours: Vec<&str> = names.iter().copied().filter(|name| name.starts_with("blindgrasp")).collect();
    assert_eq!(ours, ["blindgrasp-messages", "blindgrasp-operator"]);
    assert!(names.contains("iceoryx2"), "{names:?}");
    for heavy in ["mcap", "parry3d-f64", "nalgebra", "zenoh", "tokio", "clap", "rayon", "zstd-sys", "urdf-rs"] {
        assert!(!names.contains(heavy), "{heavy} is among {names:?}");
    }
}

#[test]
fn names_and_options_that_do_not_fit_are_refused_with_advice() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let refused = |arguments: &[&str], reason: &str| {
        let output =
            blindgrasp().current_dir(folder).args(["new", "operator"]).args(arguments).output().expect("started");
        assert_eq!(output.status.code(), Some(1), "{arguments:?}");
        assert!(text(&output.stderr).contains(reason), "{arguments:?}: {}", text(&output.stderr));
    };
    for name in ["My", "9lives", "with space", "a-b", "ä", ".."] {
        refused(&[name], "is not a name for an operator");
    }
    for name in ["fn", "test", "serde", "blindgrasp_operator"] {
        refused(&[name], "choose another name");
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
fn an_exception_in_python_is_told_in_words_and_its_traceback_is_logged() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let made = scaffold(folder, "broken", &["--python"]);
    let path = made.join("main.py");
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
    let name = crate::common::unique_name();
    let output = run(&["run", "--json", "--name", &name, utf8(&flow)], 1);
    let stderr = text(&output.stderr);
    assert!(stderr.contains("node 'classifier' failed: ValueError: a grasp too far"), "{stderr}");
    let logged = run(&["logs", "classifier", "--graph", &name], 0);
    assert!(text(&logged.stdout).contains("in measure"), "{}", text(&logged.stdout));
}
