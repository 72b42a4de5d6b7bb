//! `blindgrasp man`

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, CommandFactory};

use super::{Cli, Outcome, help, print_line, print_text};

/// Write the manual pages of all commands
#[derive(Debug, Args)]
#[command(hide = true, after_help = "Example: blindgrasp man /usr/share/man/man1")]
pub(super) struct Arguments {
    /// Folder for the pages: blindgrasp.1, blindgrasp-run.1, …; it is made
    #[arg(required_unless_present = "markdown")]
    folder: Option<PathBuf>,
    /// Print the reference of the command line in Markdown
    #[arg(long, conflicts_with = "folder")]
    markdown: bool,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    match &arguments.folder {
        Some(folder) => {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            clap_mangen::generate_to(Cli::command(), folder).with_context(|| folder.display().to_string())?;
            print_line(&folder.display().to_string())?;
        }
        None => print_text(reference().trim_end())?,
    }
    Ok(Outcome::Done)
}

/// Each command with its help, as Markdown.
fn reference() -> String {
    let mut text = String::from(
        "# Command line\n\nThis page is made from the program (`blindgrasp man --markdown`): `blindgrasp COMMAND --help` prints the \
         same.\n\n",
    );
    let mut command = help::grouped(Cli::command().term_width(100));
    // It names the commands and their options in full.
    command.build();
    text += &block(&mut command);
    let mut subcommands: Vec<clap::Command> = command.get_subcommands().filter(|sub| is_shown(sub)).cloned().collect();
    for subcommand in &mut subcommands {
        text += &section(subcommand, &[]);
    }
    text
}

fn section(command: &mut clap::Command, parents: &[&str]) -> String {
    let name = command.get_name().to_owned();
    let path = [parents, &[name.as_str()]].concat();
    let mut text = format!("## {}\n\n", path.join(" ")) + &block(command);
    let mut subcommands: Vec<clap::Command> = command.get_subcommands().filter(|sub| is_shown(sub)).cloned().collect();
    for subcommand in &mut subcommands {
        text += &section(subcommand, &path);
    }
    text
}

fn is_shown(command: &clap::Command) -> bool {
    !command.is_hide_set() && command.get_name() != "help"
}

fn block(command: &mut clap::Command) -> String {
    let help = command.render_long_help().to_string();
    let lines: Vec<&str> = help.trim_end().lines().map(str::trim_end).collect();
    format!("```text\n{}\n```\n\n", lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_has_each_command_and_its_options() {
        let reference = reference();
        for heading in ["# Command line", "## run", "## model show"] {
            assert!(reference.lines().any(|line| line == heading), "no '{heading}'");
        }
        for option in Cli::command().find_subcommand("run").expect("a command").get_opts() {
            let name = if option.is_hide_set() { None } else { option.get_long() };
            assert!(name.is_none_or(|name| reference.contains(&format!("--{name}"))), "no '{option}'");
        }
        assert!(!reference.contains("## man"), "a hidden command");
    }

    #[test]
    fn each_command_has_a_manual_page() {
        let folder = tempfile::tempdir().expect("a folder");
        let arguments = Arguments { folder: Some(folder.path().join("man1")), markdown: false };
        run(&arguments).expect("written");
        let page = |name: &str| std::fs::read_to_string(folder.path().join("man1").join(name)).expect(name);
        assert!(page("blindgrasp.1").contains("blindgrasp\\-run(1)"), "{}", page("blindgrasp.1"));
        assert!(page("blindgrasp-model-show.1").contains(".SH SYNOPSIS"));
    }
}
