//! Files with mistakes, and the commands that read them.

use super::{project, run, text};

/// The files of a test.
pub(crate) struct Folder(tempfile::TempDir);

impl Folder {
    pub(crate) fn new() -> Folder {
        Folder(tempfile::tempdir().expect("a folder"))
    }

    pub(crate) fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_str().expect("UTF-8").into()
    }

    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        std::fs::write(self.at(name), content).expect("written");
        self.at(name)
    }
}

/// A file of the project.
pub(crate) fn read(path: &str) -> String {
    std::fs::read_to_string(project().join(path)).expect("readable")
}

/// Asserts that a command fails with a message on stderr that holds all of `expected`, and prints nothing on stdout.
pub(crate) fn check(arguments: &[&str], exit_code: i32, expected: &[&str]) {
    let output = run(arguments, exit_code);
    let stderr = text(&output.stderr);
    for part in expected {
        assert!(stderr.contains(part), "blindgrasp {arguments:?}: expected '{part}' in\n{stderr}");
    }
    assert!(!stderr.contains("panicked"), "{stderr}");
    assert!(output.stdout.is_empty(), "{}", text(&output.stdout));
}
