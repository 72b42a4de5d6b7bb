//! `scripts/reproduce`: the paper's tables and figures, in steps that are not done twice.

use std::path::Path;
use std::process::{Command, Output};

use crate::common::{blindgrasp, project, text};
use serde_json::Value;

fn reproduce(folder: &Path, seed: &str) -> Output {
    Command::new(project().join("scripts/reproduce"))
        .args([folder.to_str().expect("UTF-8"), "150", "2", seed])
        .env("BLINDGRASP", blindgrasp().get_program())
        .output()
        .expect("started")
}

#[test]
fn tables_and_figures_are_made_once_and_an_interrupted_run_goes_on() {
    let parent = tempfile::tempdir().expect("a folder");
    let folder = parent.path().join("reproduced");
    let first = reproduce(&folder, "1");
    let tables = text(&first.stdout);
    assert!(first.status.success(), "{}", text(&first.stderr));
    let expected =
        ["grasp; Dang & Allen; 12320: 81.0 %, 8.6 %", "class; joints; 150: ", "Table III", "Table IV", "10 of 10"];
    assert!(expected.iter().all(|part| tables.contains(part)), "{tables}");
    // Three splits, three recipes.
    assert_eq!(tables.matches("; 150: ").count(), 9, "{tables}");
    let svg = std::fs::read_to_string(folder.join("figures/figure-1.svg")).expect("a figure");
    assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"), "{svg}");
    // As if it had been interrupted in one step: that one is done again, with the same result.
    let step = folder.join("by-object.json");
    let judges =
        || serde_json::from_slice::<Value>(&std::fs::read(&step).expect("a result")).expect("JSON")["judges"].take();
    let before = judges();
    std::fs::rename(&step, step.with_extension("json.partial")).expect("renamed");
    let again = reproduce(&folder, "1");
    let said = text(&again.stderr);
    assert!(
        said.matches(": blindgrasp ").count() == 1 && said.contains("by-object.json: blindgrasp evaluate"),
        "{said}"
    );
    assert_eq!((judges(), text(&again.stdout)), (before, tables));

    let refused = reproduce(&folder, "2");
    assert_eq!(refused.status.code(), Some(1));
    assert!(text(&refused.stderr).contains("was begun with 150 grasps, 2 trials, seed 1"), "{}", text(&refused.stderr));
}
