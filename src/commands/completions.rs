//! `blindgrasp completions`

use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::{Cli, Outcome};

/// Print a script that completes commands in a shell
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
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut Cli::command(), "blindgrasp", &mut script);
    // Not straight to stdout: the generator panics when nobody reads it.
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(Outcome::Done)
}
