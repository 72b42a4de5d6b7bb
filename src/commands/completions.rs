//! `blindgrasp completions`

use anyhow::Context;
use clap::Args;
use clap_complete::Shell;
use clap_complete::env::Shells;

use super::Outcome;
use blindgrasp_cli::completions::VARIABLE;
pub(super) use blindgrasp_cli::completions::{assignments, graphs, hands, nodes, outputs};

/// Print a script that completes commands in a shell
///
/// Also completes the names of running graphs, their nodes, outputs and parameters, of hands and of objects.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
                        blindgrasp completions bash > ~/.local/share/bash-completion/completions/blindgrasp\n  \
                        blindgrasp completions zsh > \"${fpath[1]}/_blindgrasp\"\n  \
                        blindgrasp completions fish > ~/.config/fish/completions/blindgrasp.fish")]
pub(super) struct Arguments {
    /// The shell.
    shell: Shell,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let shells = Shells::builtins();
    let shell = shells.completer(&arguments.shell.to_string()).context("this shell cannot be served")?;
    let mut script = Vec::new();
    shell.write_registration(VARIABLE, "blindgrasp", "blindgrasp", "blindgrasp", &mut script)?;
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(Outcome::Done)
}
