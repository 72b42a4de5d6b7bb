//! Lines for people, on stderr.

use std::io::Write;

/// Writes a line to stderr, at once. Unlike `eprintln!` it doesn't panic when nobody reads it: a graph must not fall
/// over because somebody has seen enough.
pub fn print_diagnostic(line: &str) {
    let mut stderr = std::io::stderr().lock();
    let _ = stderr.write_all(format!("{line}\n").as_bytes());
}
