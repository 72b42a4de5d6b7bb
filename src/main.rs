//! The `blindgrasp` command.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let cli = blindgrasp::cli::Cli::parse();
    if let Some(code) = cli.run_operator() {
        return code;
    }
    match blindgrasp::cli::run(cli) {
        Ok(outcome) => outcome.exit_code(),
        // Whoever reads our output has seen enough, like `blindgrasp export … | head`.
        Err(error) if blindgrasp::cli::is_broken_pipe(&error) => ExitCode::SUCCESS,
        // Each of its lines begins with the file, line and column: nothing else should.
        Err(error) if error.is::<blindgrasp::dataflow::DataflowError>() => {
            blindgrasp::diagnostics::print_diagnostic(&error.to_string());
            ExitCode::FAILURE
        }
        Err(error) => {
            blindgrasp::diagnostics::print_diagnostic(&format!("blindgrasp: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
