//! `blindgrasp reproduce`: the paper's tables and figures, in steps that are not done twice.

use std::process::Stdio;

use crate::common::{blindgrasp, run, signal, text, wait_until};
use rustix::process::Signal;
use serde_json::Value;

#[test]
fn tables_and_figures_are_made_once_and_an_interrupted_run_goes_on() {
    let parent = tempfile::tempdir().expect("a folder");
    let folder = parent.path().join("reproduced");
    let out = folder.to_str().expect("UTF-8");
    let arguments = ["reproduce", "--out", out, "--grasps", "300", "--trials", "2"];
    // Interrupted in its first step, it leaves no result behind, and goes on later.
    let mut interrupted = blindgrasp();
    let interrupted = interrupted.args(arguments).stderr(Stdio::piped()).spawn().expect("started");
    let grasps = folder.join("grasps");
    wait_until(|| grasps.exists(), || "the simulation has not begun".into());
    signal(interrupted.id() as i32, Signal::INT);
    let ended = interrupted.wait_with_output().expect("waited");
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(text(&ended.stderr).contains("interrupted; the same command"), "{}", text(&ended.stderr));
    assert!(!folder.join("grasps.json").exists() && !folder.join("grasps.json.partial").exists());

    let first = run(&[&arguments[..], &["--json"]].concat(), 0);
    let made: Value = serde_json::from_slice(&first.stdout).expect("JSON");
    assert_eq!(made["results"].as_array().map(Vec::len), Some(7));
    // Three splits, three recipes.
    let rows = made["table_1"].as_array().expect("rows");
    assert_eq!(rows.len(), 9);
    assert!(rows.iter().all(|row| row["accuracy"]["value"].as_f64() > Some(0.5)), "{rows:?}");
    // Those that no cell feels are among all only.
    assert!(rows.iter().all(|row| row["n_grasps_of_all"] == 300 && row["n_grasps"].as_u64() < Some(300)), "{rows:?}");
    assert!(rows.iter().all(|row| row["false_positive_share_of_all"]["value"].is_number()), "{rows:?}");
    let summary = std::fs::read_to_string(folder.join("README.md")).expect("a summary");
    let expected = [
        "| grasps | Dang & Allen | 12,320 | 81.0 % | 8.6 % |",
        "| classes | joints | 300 |",
        "Table III",
        "Table IV",
        "10 of 10",
    ];
    assert!(expected.iter().all(|part| summary.contains(part)), "{summary}");
    for figure in ["figure-1.svg", "figure-2-paper.svg", "figure-2-boosted.svg"] {
        let svg = std::fs::read_to_string(folder.join("figures").join(figure)).expect("a figure");
        assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"), "{figure}");
    }
    let table = std::fs::read_to_string(folder.join("figures/table-1.csv")).expect("a table");
    assert!(table.contains("true,Test,12320,5914,6406,0.81,0.086"), "{table}");

    // As if it had been interrupted in one step: that one is done again, with the same result.
    let step = folder.join("by-object.json");
    let before: Value = serde_json::from_slice(&std::fs::read(&step).expect("a result")).expect("JSON");
    std::fs::remove_file(&step).expect("removed");
    let again = run(&arguments, 0);
    let said = text(&again.stderr);
    assert_eq!(said.matches("done before").count(), 6, "{said}");
    assert_eq!(text(&again.stdout).lines().next(), summary.lines().next());
    let after: Value = serde_json::from_slice(&std::fs::read(&step).expect("a result")).expect("JSON");
    assert_eq!(after["judges"], before["judges"]);

    let refused = run(&[&arguments[..], &["--seed", "2"]].concat(), 1);
    assert!(text(&refused.stderr).contains("begun with other options"), "{}", text(&refused.stderr));
    let taken = run(&["reproduce", "--out", parent.path().to_str().expect("UTF-8")], 1);
    assert!(text(&taken.stderr).contains("expected a new folder"), "{}", text(&taken.stderr));
}
