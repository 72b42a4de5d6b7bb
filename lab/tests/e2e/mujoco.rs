//! MuJoCo in the robot's place: lifts that the project's own physics have no part in.

use std::process::Command;

use serde_json::Value;

use crate::common::python::python;
use crate::common::{assert_nothing_left, blindgrasp, project, text, unique_name};

/// Runs the program with the interpreter that has MuJoCo, or with another one.
fn run_with(python: &str, arguments: &[&str], exit_code: i32) -> (String, String) {
    let output = blindgrasp().args(arguments).env("BLINDGRASP_PYTHON", python).output().expect("started");
    let (out, error) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(exit_code), "{arguments:?}\n{out}\n{error}");
    (out, error)
}

fn run(arguments: &[&str], exit_code: i32) -> (String, String) {
    run_with(python().to_str().expect("UTF-8"), arguments, exit_code)
}

#[test]
fn the_graph_lifts_in_mujoco_and_slippery_things_are_dropped() {
    let name = unique_name();
    let flow = project().join("dataflow-live.yaml");
    let fixed = "trials --physics mujoco --lift-policy always --trials 12 --json --set lift_arbiter.max_age_ms=600000 \
                 --set source.decision_timeout_s=600 --objects paper/wipe-box@mu1,paper/wipe-box@mu0.02";
    let flow = ["--dataflow", flow.to_str().expect("UTF-8"), "--name", &name];
    let (out, _) = run(&fixed.split_whitespace().chain(flow).collect::<Vec<_>>(), 0);
    assert_nothing_left(&name);
    let report: Value = serde_json::from_str(&out).expect("JSON");
    assert_eq!(report["options"]["physics"]["engine"], "mujoco", "{report}");
    let records = report["records_without_gate"].as_array().expect("records");
    let held = |friction: f64| -> Vec<bool> {
        let of_friction = records.iter().filter(|record| record["friction"].as_f64() == Some(friction));
        of_friction.map(|record| record["held"].as_bool().expect("a bool")).collect()
    };
    assert_eq!(held(0.02), [false; 6], "{report}");
    assert!(held(1.0).contains(&true), "{report}");
}

#[test]
fn a_seed_gives_the_same_lifts_with_mujoco_and_others_without() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let simulate = |physics: &str, out: &str| {
        let arguments = "simulate --label lift --objects box --grasps 3 --seed 5 --stable-fraction natural";
        let arguments: Vec<&str> = arguments.split(' ').chain(["--physics", physics, "--out", out]).collect();
        run(&arguments, 0);
        std::fs::read(out).expect("a recording")
    };
    let first = simulate("mujoco", &out("first.mcap"));
    assert!(first == simulate("mujoco", &out("second.mcap")));
    assert!(first != simulate("rapier", &out("rapier.mcap")));
}

#[test]
fn files_of_the_current_folder_are_no_modules() {
    let folder = tempfile::tempdir().expect("a folder");
    let modules = ["coacd", "hashlib", "json", "math", "mujoco", "numpy", "pathlib", "sitecustomize"];
    for module in modules {
        let runs = "open(__file__ + '.ran', 'w').close()\n";
        std::fs::write(folder.path().join(format!("{module}.py")), runs).expect("written");
    }
    let ran = || -> Vec<&str> {
        let marks = |module: &&str| folder.path().join(format!("{module}.py.ran")).exists();
        modules.into_iter().filter(marks).collect()
    };
    let mut lured = Command::new(python());
    lured.args(["-c", "import hashlib"]).current_dir(folder.path()).env("PYTHONPATH", ":/nowhere");
    lured.env("PYTHONDONTWRITEBYTECODE", "1").output().expect("started");
    assert!(ran().contains(&"hashlib") && ran().contains(&"sitecustomize"), "Python itself takes them: {:?}", ran());
    for module in ran() {
        std::fs::remove_file(folder.path().join(format!("{module}.py.ran"))).expect("removed");
    }
    let out = folder.path().join("lifts.mcap");
    let arguments =
        "simulate --label lift --physics mujoco --objects box --grasps 1 --seed 5 --stable-fraction natural --out";
    let mut command = blindgrasp();
    command.args(arguments.split(' ')).arg(&out).current_dir(folder.path());
    let output = command.env("BLINDGRASP_PYTHON", python()).env("PYTHONPATH", ":/nowhere").output().expect("started");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(ran(), [""; 0]);
}

#[test]
fn without_mujoco_one_line_says_what_to_install() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("lifts.mcap");
    let arguments = "simulate --label lift --physics mujoco --objects box --grasps 1 --out";
    let arguments: Vec<&str> = arguments.split(' ').chain([out.to_str().expect("UTF-8")]).collect();
    let (_, missing) = run_with("no-such-python", &arguments, 1);
    assert!(missing.contains("no-such-python does not start") && missing.contains("BLINDGRASP_PYTHON"), "{missing}");
    // An interpreter without the packages of users.
    let bare = folder.path().join("python");
    std::fs::write(&bare, "#!/bin/sh\nexec python3 -S -E \"$@\"\n").expect("written");
    std::fs::set_permissions(&bare, std::os::unix::fs::PermissionsExt::from_mode(0o755)).expect("executable");
    let (_, missing) = run_with(bare.to_str().expect("UTF-8"), &arguments, 1);
    assert!(
        missing.contains("cannot import mujoco") && missing.contains("pip install 'blindgrasp[mujoco]'"),
        "{missing}"
    );
    assert!(!out.exists());
}
