//! The `blindgrasp` command.

mod commands;

use std::process::ExitCode;

fn main() -> ExitCode {
    blindgrasp_cli::survive_limit_of_file_sizes();
    commands::hand_over();
    let cli = commands::Cli::read();
    match cli.run_operator() {
        Some(code) => code,
        None => blindgrasp_cli::end(commands::run(&cli)),
    }
}
