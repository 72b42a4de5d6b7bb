//! The commands on pages that people read.

use std::path::{Path, PathBuf};

use crate::common::{project, run};

/// The hands of docs/hands.md, each with a project of its own.
const HANDS: [&str; 4] = ["inspire-rh56dftp", "unitree-dex3-1", "robotiq-2f85-tsf85", "uskin"];

/// Commands of pages work in a project of `blindgrasp init`: the files that they name are there. The page on hands has the
/// projects of its hands, and `--ros2` is that of the page on ROS 2.
#[test]
fn commands_name_files_that_a_project_has() {
    let folder = tempfile::tempdir().expect("a folder");
    let project_of = |name: &str, option: &[&str]| {
        let path = folder.path().join(name);
        run(&[&["init", path.to_str().expect("UTF-8")], option].concat(), 0);
        path
    };
    let usual = vec![project_of("usual", &["--ros2"])];
    let hands = Vec::from(HANDS.map(|name| project_of(name, &["--hand", name])));
    let mut missing = Vec::new();
    for page in markdown_of(&project().join("docs")) {
        let projects = if page.ends_with("hands.md") { &hands } else { &usual };
        for path in files_in_commands(&std::fs::read_to_string(&page).expect("readable")) {
            if !projects.iter().any(|root| root.join(&path).is_file()) {
                missing.push(format!("{}: {path}", page.display()));
            }
        }
    }
    assert!(missing.is_empty(), "not in a project: {}", missing.join(", "));
}

/// The files of a project that the commands of a page name. Models are left out, because commands make them.
fn files_in_commands(text: &str) -> Vec<String> {
    let mut is_shell = false;
    let mut files = Vec::new();
    for line in text.lines() {
        if let Some(language) = line.trim_start().strip_prefix("```") {
            is_shell = language == "sh";
            continue;
        }
        if !is_shell {
            continue;
        }
        let command = line.split(" #").next().unwrap_or_default();
        let is_separator = |letter: char| letter.is_whitespace() || "=|\"'()".contains(letter);
        let words = command.split(is_separator).map(|word| word.trim_start_matches("./"));
        let is_file = |word: &&str| {
            let is_below = ["recordings/", "hands/", "bridges/"].iter().any(|folder| word.starts_with(folder));
            // Files that the commands before make.
            let is_made = ["recordings/robot", "recordings/run."].iter().any(|made| word.starts_with(made));
            let is_program = word.starts_with("tactile_bridge") && word.ends_with(".py");
            (is_below && !is_made) || is_program || word.starts_with("dataflow")
        };
        files.extend(words.filter(is_file).map(str::to_owned));
    }
    files
}

fn markdown_of(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder");
    let paths: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
    let below = paths.iter().filter(|path| path.is_dir()).flat_map(|folder| markdown_of(folder));
    let mut pages: Vec<PathBuf> = below.chain(paths.clone()).collect();
    pages.retain(|path| path.extension().is_some_and(|extension| extension == "md"));
    pages.sort();
    pages
}
