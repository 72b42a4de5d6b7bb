//! The edges of a graph that go to another machine: `blindgrasp_bridge` as a process.

use std::process::ExitCode;

fn main() -> ExitCode {
    blindgrasp_bridge::operator::main()
}
