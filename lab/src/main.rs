//! `blindgrasp-lab`: the program of data, models and trials. `blindgrasp` hands over to it.

mod commands;
mod operators;

use std::process::ExitCode;

fn main() -> ExitCode {
    blindgrasp_cli::survive_limit_of_file_sizes();
    let cli = commands::Cli::read();
    match cli.run_operator() {
        Some(code) => code,
        None => blindgrasp_cli::end(commands::run(&cli)),
    }
}
