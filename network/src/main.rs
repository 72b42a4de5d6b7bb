//! `blindgrasp-network`: the program of other machines and Zenoh. `blindgrasp` hands over to it.

mod commands;
mod drivers;
mod operators;

use std::process::ExitCode;

use blindgrasp_graph::launcher::ZENOH_THREADS;

fn main() -> ExitCode {
    let (name, value) = ZENOH_THREADS;
    if std::env::var_os(name).is_none() {
        // SAFETY: no other thread has begun yet, which could read the environment meanwhile.
        unsafe { std::env::set_var(name, value) };
    }
    commands::main()
}
