//! The project's recordings through the real processes: every edge is as recorded, and every expectation is met.

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use crate::common::{MODEL, blindgrasp, fails, json_lines, json_of, project, run, skipped, text, unique_name};
use serde_json::{Value, json};

#[test]
fn the_projects_recordings_come_out_as_recorded() {
    let output = run(&["test", "--json"], 0);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text(&output.stdout)));
    let files = std::fs::read_dir(project().join("recordings")).expect("readable").flatten();
    let n_expected = files.filter(|file| file.file_name().to_string_lossy().ends_with(".expect.yaml")).count();
    assert_eq!((report["n_passed"].as_u64(), n_expected), (Some(10), 10), "{report}");
    assert_eq!(report["n_failed"], 0, "{report}");
}

/// The decisions and features of the project's recordings, as another processor computes them. Installed by scripts/test.
#[test]
fn a_processor_without_fused_multiplication_gives_the_same_bytes() {
    let emulator = "qemu-x86_64";
    if std::process::Command::new(emulator).arg("--version").output().is_err() {
        return skipped("qemu-x86_64 is missing (qemu-user)");
    }
    for model in [MODEL, "recordings/paper-recipe.json", "models/barrett-bh8-280-lifts.json"] {
        let folder = tempfile::tempdir().expect("a folder");
        let features = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
        let (ours, theirs) = (features("here.csv"), features("there.csv"));
        let predict = vec!["predict", "--json", model, "recordings/ordinary.mcap"];
        let export = |out| vec!["export", "recordings/ordinary.mcap", "--features", model, "--out", out];
        // Nehalem has neither AVX nor FMA.
        let there = |arguments: &[&str]| {
            let mut command = std::process::Command::new(emulator);
            command.args(["-cpu", "Nehalem"]).arg(blindgrasp().get_program()).args(arguments).current_dir(project());
            let output = command.output().expect("started");
            assert!(output.status.success(), "{arguments:?}: {}", text(&output.stderr));
            output.stdout
        };
        let here = run(&predict, 0).stdout;
        assert!(!here.is_empty() && there(&predict) == here, "{model}");
        run(&export(&ours), 0);
        there(&export(&theirs));
        let read = |path: &str| std::fs::read(path).expect("written");
        assert!(read(&ours).len() > 1000 && read(&ours) == read(&theirs), "{model}");
    }
}

/// The default graph's run of the project's recording, recorded.
fn recorded_run(folder: &Path) -> String {
    let recording = folder.join("run.mcap").to_str().expect("UTF-8").to_owned();
    let rate = ["--set", "recorded_source.rate=max", "--name", &unique_name(), "--record", &recording];
    run(&[&["run", "dataflow.yaml", "-q"], &rate[..]].concat(), 0);
    recording
}

#[test]
fn a_failure_says_which_actions_have_changed() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = recorded_run(folder.path());
    let file = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let (junit, summary) = (file("report.xml"), file("summary.md"));
    let votes = ["--set", "lift_arbiter.votes=1"];
    let reports = ["--junit", &junit, "--summary", &summary];
    let output = run(&[&["test", &recording], &votes[..], &reports[..]].concat(), 1);
    let changed = "1 action changed: grasp 138: LIFT stable -> HOLD unstable (unstable)";
    assert!(text(&output.stdout).contains(changed), "{}", text(&output.stdout));
    let read = |path: &str| std::fs::read_to_string(path).expect("written");
    assert!(read(&junit).contains("grasp 138: LIFT stable"), "{}", read(&junit));
    assert!(read(&summary).starts_with("## blindgrasp test: 0 passed, 1 failed"), "{}", read(&summary));
    assert!(read(&summary).contains("| run.mcap | **failed** | 1 | /decision |"), "{}", read(&summary));
    // GitHub gives all steps one file.
    run(&["test", &recording, "--summary", &summary], 0);
    assert!(read(&summary).contains("## blindgrasp test: 1 passed, 0 failed"), "{}", read(&summary));
    let output = run(&[&["test", &recording, "--json"], &votes[..]].concat(), 1);
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let found = &report["recordings"][0]["changed_actions"];
    assert_eq!((&found[0]["grasp_id"], found.as_array().map(Vec::len)), (&json!(138), Some(1)), "{found}");
}

#[test]
fn names_that_are_not_utf8_are_text_in_json() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(OsStr::from_bytes(b"run\xff.mcap"));
    let missing = blindgrasp().args(["test", "--json"]).arg(&path).output().expect("started");
    let report: Value = serde_json::from_slice(&missing.stdout).expect("JSON");
    let shown = json!(path.to_string_lossy());
    assert_eq!((&report["recordings"][0]["recording"], &report["n_failed"]), (&shown, &json!(1)));
    let rate = ["--set", "recorded_source.rate=max", "--name", &unique_name(), "--json", "--record"];
    let output = blindgrasp().args(["run", "dataflow.yaml"]).args(rate).arg(&path).output().expect("started");
    let lines = json_lines(&output.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    assert_eq!(summary["recorded_files"], json!([shown]), "{}", text(&output.stderr));
}

#[test]
fn a_sweep_shows_the_decisions_with_each_value() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = recorded_run(folder.path());
    let report = json_of(&["test", &recording, "--sweep", "lift_arbiter.votes=1,3", "--json"]);
    let of = |value: usize, name: &str| report["values"][value][name].clone();
    assert_eq!((of(0, "value"), of(0, "n_actions_changed")), (json!("1"), json!(1)), "{report}");
    assert_eq!((of(1, "value"), of(1, "n_actions_changed")), (json!("3"), json!(0)), "{report}");
    assert_eq!(of(0, "decisions")["n_lifts"].as_u64().map(|n| n + 1), of(1, "decisions")["n_lifts"].as_u64());
    fails(&["test", &recording, "--sweep", "lift_arbiter.votse=2,3"], "votes");
}

#[test]
fn faults_show_the_decisions_that_they_change() {
    let report = json_of(&["test", "recordings/slip-prone.mcap", "--faults", "--json"]);
    let faults = report["faults"].as_array().expect("faults");
    let of = |name: &str| faults.iter().find(|row| row["fault"] == name).expect(name)["changed_actions"].clone();
    // Its eight lifts are held when a frame is lost, and nothing is lifted that is held without.
    assert_eq!(of("lost_frame").as_array().map(Vec::len), Some(8), "{report}");
    assert!(of("lost_frame").as_array().expect("a list").iter().all(|changed| changed["after"][1] == "out_of_order"));
    assert_eq!(report["n_lifted_only_with_a_fault"], 0, "{report}");
    // A dead pad hides why a grasp was held.
    let failed = run(&["test", "recordings/held-out.mcap", "--faults"], 1);
    assert!(text(&failed.stdout).contains("the most loaded pad reads 0: grasp"), "{}", text(&failed.stdout));
    assert!(text(&failed.stderr).contains("lifted with a fault and held without it"), "{}", text(&failed.stderr));
}

#[test]
fn expectations_are_made_of_the_decisions_and_are_met() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = recorded_run(folder.path());
    let made = run(&["test", "--init", &recording], 0);
    assert!(text(&made.stdout).contains("run.expect.yaml: 240 grasps"), "{}", text(&made.stdout));
    let expected = std::fs::read_to_string(folder.path().join("run.expect.yaml")).expect("written");
    assert!(expected.contains("accuracy_at_least: 0.8958\nfalse_positives_at_most: 14\n"), "{expected}");
    run(&["test", &recording], 0);
    // Another model decides worse.
    let failed = run(&["test", &recording, "--set", "model=recordings/paper-recipe.json"], 1);
    assert!(text(&failed.stdout).contains("FAIL  accuracy_at_least"), "{}", text(&failed.stdout));
}
