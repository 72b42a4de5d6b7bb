//! The `blindgrasp` command.

mod commands;

fn main() -> std::process::ExitCode {
    commands::hand_over();
    commands::main()
}
