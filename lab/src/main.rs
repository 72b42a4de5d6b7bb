//! `blindgrasp-lab`: data, models and trials. `blindgrasp` hands over to it.

mod commands;
mod operators;

fn main() -> std::process::ExitCode {
    commands::main()
}
