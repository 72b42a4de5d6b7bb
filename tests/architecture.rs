//! The direction of dependencies that ARCHITECTURE.md states.

use std::path::{Path, PathBuf};

fn sources(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("readable").flatten() {
        let path = entry.path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

/// The files of a module, `name.rs` or `name/…`.
fn module(name: &str) -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut paths = Vec::new();
    sources(&root, &mut paths);
    let found: Vec<_> = paths
        .into_iter()
        .filter(|path| {
            let relative = path.strip_prefix(&root).expect("below src");
            relative.starts_with(name) || relative == Path::new(&format!("{name}.rs"))
        })
        .map(|path| {
            let text = std::fs::read_to_string(&path).expect("readable");
            // What tests import is their own business.
            let code = text.split("#[cfg(test)]").next().expect("a part").to_string();
            (path, code)
        })
        .collect();
    assert!(!found.is_empty(), "no module {name}");
    found
}

fn check(modules: &[&str], must_not_use: &[&str]) {
    for name in modules {
        for (path, code) in module(name) {
            for banned in must_not_use {
                let is_used = code.lines().any(|line| !line.trim_start().starts_with("//") && line.contains(banned));
                assert!(!is_used, "{} uses {banned}", path.display());
            }
        }
    }
}

#[test]
fn messages_stages_and_science_know_nothing_of_processes() {
    let science = [
        "contacts",
        "dictionary",
        "feature",
        "histogram",
        "classifier",
        "lift_arbiter",
        "novelty",
        "regrasp",
        "hand",
        "grasp",
        "model",
        "training",
        "evaluation",
        "dataset",
        "import",
        "recording",
        "export",
        "tactile",
    ];
    check(&science, &["crate::runtime", "crate::dataflow", "crate::cli", "iceoryx2", "zenoh"]);
    check(&["message"], &["crate::"]);
    let not_for_pictures =
        ["crate::runtime", "crate::dataflow", "crate::cli", "crate::recording", "iceoryx2", "std::fs"];
    check(&["picture"], &not_for_pictures);
}

#[test]
fn runtime_and_dataflow_know_nothing_of_the_science() {
    let science = [
        "crate::contacts",
        "crate::dictionary",
        "crate::feature",
        "crate::histogram",
        "crate::classifier",
        "crate::lift_arbiter",
        "crate::novelty",
        "crate::grasp",
        "crate::model",
        "crate::training",
        "crate::evaluation",
        "crate::hand",
        "crate::cli",
    ];
    check(&["runtime", "dataflow"], &science);
    check(&["dataflow"], &["crate::runtime", "iceoryx2"]);
}

#[test]
fn stages_read_no_clock() {
    let stages =
        ["contacts", "dictionary", "feature", "histogram", "classifier", "lift_arbiter", "novelty", "hand", "grasp"];
    check(&stages, &["std::time", "Instant", "SystemTime", "monotonic_nanos"]);
}
