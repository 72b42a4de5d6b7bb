//! The `blindgrasp` command.

mod commands;

use std::process::ExitCode;
use std::sync::Arc;

use blindgrasp_graph::dataflow::DataflowError;
use blindgrasp_graph::launcher::ZENOH_THREADS;
use blindgrasp_operator::diagnostics::print_diagnostic;

fn main() -> ExitCode {
    let (name, value) = ZENOH_THREADS;
    if std::env::var_os(name).is_none() {
        // SAFETY: no other thread has begun yet, which could read the environment meanwhile.
        unsafe { std::env::set_var(name, value) };
    }
    // A file beyond the limit of sizes (ulimit -f) is an error of the write, as a full disk is, and kills no graph.
    let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
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
