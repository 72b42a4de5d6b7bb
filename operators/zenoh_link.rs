//! The edges of a graph that go to another machine: `blindgrasp::link` as a process.

use std::process::ExitCode;

fn main() -> ExitCode {
    blindgrasp::link::operator::main()
}
