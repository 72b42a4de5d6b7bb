//! The `blindgrasp` command.

mod commands;

use std::process::ExitCode;

use blindgrasp_graph::dataflow::DataflowError;
use blindgrasp_operator::diagnostics::print_diagnostic;

fn main() -> ExitCode {
    let cli = commands::Cli::read();
    if let Some(code) = cli.run_operator() {
        return code;
    }
    match commands::run(cli) {
        Ok(outcome) => outcome.exit_code(),
        // The reader of our output has seen enough, as in `blindgrasp export … | head`.
        Err(error) if commands::is_broken_pipe(&error) => ExitCode::SUCCESS,
        // Each of its lines begins with the file, line and column: nothing else should.
        Err(error) if error.is::<DataflowError>() => {
            print_diagnostic(&error.to_string());
            ExitCode::FAILURE
        }
        Err(error) => {
            print_diagnostic(&format!("blindgrasp: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
