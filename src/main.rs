//! The `blindgrasp` command.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let cli = blindgrasp::cli::Cli::parse();
    match blindgrasp::cli::run(cli) {
        Ok(outcome) => outcome.exit_code(),
        // Whoever reads our output has seen enough, like `blindgrasp export … | head`.
        Err(error) if blindgrasp::cli::is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            blindgrasp::diagnostics::print_diagnostic(&format!("blindgrasp: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
