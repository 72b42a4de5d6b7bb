//! Operators in Python.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use super::{Ended, program, project, script, text};

/// The environment with what Python operators need, made once.
pub(crate) fn python() -> &'static Path {
    static PYTHON: OnceLock<PathBuf> = OnceLock::new();
    PYTHON.get_or_init(|| {
        let output = Command::new(project().join("scripts/python-env")).output().expect("started");
        assert!(output.status.success(), "{}", text(&output.stderr));
        PathBuf::from(text(&output.stdout).trim()).join("bin/python")
    })
}

/// A program of ours in that environment: Python's `.pyc` files stay out of the sources.
pub(crate) fn python_operator(folder: &Path, program: &Path) -> PathBuf {
    // Scaffolds are all called main.py: the folder tells them apart.
    let within = program.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
    let name = format!("run-{within}-{}", program.file_stem().expect("a name").to_string_lossy());
    script(
        folder,
        &name,
        &format!("exec env PYTHONDONTWRITEBYTECODE=1 {} {} \"$@\"", python().display(), program.display()),
    )
}

/// `scripts/benchsuite` with the program of this build.
pub(crate) fn benchsuite(arguments: &[&str]) -> Output {
    Command::new(python())
        .arg(project().join("scripts/benchsuite"))
        .args(arguments)
        .env("BLINDGRASP", program())
        .output()
        .expect("started")
}

pub(crate) fn shell(folder: &Path, program: &Path, arguments: &[&str], exit_code: i32) -> Output {
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

pub(crate) fn utf8(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Asserts that no sample was lost, that `ps` and the summary count the same on both ends of each edge, and that each
/// grasp was decided once and in order.
pub(crate) fn assert_each_once(ended: &Ended) {
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
