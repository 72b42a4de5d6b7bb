//! Forms that make a reader stop, and for which no lint of Clippy looks.

use std::path::Path;

use crate::common::project;

/// An `if` in disguise. Clippy's `match_bool` looks for the other one.
const FORBIDDEN: [&str; 1] = ["filter(|_|"];

#[test]
fn no_filter_ignores_what_it_filters() {
    let mut found = Vec::new();
    for folder in ["crates", "operators", "src", "examples", "benches", "tests"] {
        search(&project().join(folder), &mut found);
    }
    assert!(found.is_empty(), "write an if instead:\n{}", found.join("\n"));
}

fn search(folder: &Path, found: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() && !path.ends_with("target") {
            search(&path, found);
            continue;
        }
        let is_rust = path.extension().is_some_and(|extension| extension == "rs");
        if !is_rust || path.ends_with(file!()) {
            continue;
        }
        let text = std::fs::read_to_string(&path).expect("UTF-8");
        for (idx, line) in text.lines().enumerate() {
            if FORBIDDEN.iter().any(|form| line.contains(form)) {
                found.push(format!("{}:{}: {}", path.display(), idx + 1, line.trim()));
            }
        }
    }
}
