//! The manual pages and the reference of a program's commands.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, Command};

use crate::help::grouped;
use crate::houses::{HOUSES, House};
use crate::{Outcome, print_line, print_text};

/// Write the manual pages of this program's commands
#[derive(Debug, Args)]
#[command(hide = true, after_help = "Example: blindgrasp man /usr/share/man/man1")]
pub struct Arguments {
    /// Folder for the pages: blindgrasp.1, blindgrasp-run.1, …; it is made
    #[arg(required_unless_present = "markdown")]
    pub folder: Option<PathBuf>,
    /// Print the reference of the command line in Markdown
    #[arg(long, conflicts_with = "folder")]
    pub markdown: bool,
}

/// Writes the pages of a house's commands, or prints their reference. Those of `others`, whose commands it only lists, are left to
/// their programs.
///
/// # Errors
/// A page cannot be written.
pub fn run(arguments: &Arguments, mut command: Command, others: &[&House]) -> anyhow::Result<Outcome> {
    let Some(folder) = &arguments.folder else {
        print_text(reference(command, others).trim_end())?;
        return Ok(Outcome::Done);
    };
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    command = command.disable_help_subcommand(true);
    command.build();
    write_pages(&command, "", folder, others).with_context(|| folder.display().to_string())?;
    print_line(&folder.display().to_string())?;
    Ok(Outcome::Done)
}

fn write_pages(command: &Command, words: &str, folder: &Path, others: &[&House]) -> std::io::Result<()> {
    for subcommand in command.get_subcommands().filter(|subcommand| !subcommand.is_hide_set()) {
        let words = format!("{words} {}", subcommand.get_name());
        if !is_of(others, words.trim_start()) {
            write_pages(subcommand, &words, folder, others)?;
        }
    }
    clap_mangen::Man::new(command.clone()).generate_to(folder).map(drop)
}

fn is_of(houses: &[&House], command: &str) -> bool {
    houses.iter().any(|house| house.commands.iter().any(|(name, _)| *name == command))
}

/// Each command with its help, as Markdown.
fn reference(command: Command, others: &[&House]) -> String {
    let mut command = grouped(command.term_width(100));
    // It names the commands and their options in full.
    command.build();
    let mut text = String::new();
    if !others.is_empty() {
        text += "# Command line\n\nThis page is made from the program (`blindgrasp man --markdown`): `blindgrasp COMMAND --help` prints \
                 the same.\n\n";
        text += &block(&mut command);
    }
    text + &sections(&command, &[], others)
}

fn sections(command: &Command, parents: &[&str], others: &[&House]) -> String {
    let mut text = String::new();
    for subcommand in command.get_subcommands() {
        let path = [parents, &[subcommand.get_name()]].concat();
        if subcommand.is_hide_set() || subcommand.get_name() == "help" || is_of(others, &path.join(" ")) {
            continue;
        }
        // The robot's program tells of a command that a house shares with it, as it shares 'new' with 'new hand'.
        let is_shared = others.is_empty() && parents.is_empty() && !is_of(&HOUSES, path[0]);
        if !is_shared {
            text += &format!("## {}\n\n", path.join(" "));
            text += &block(&mut subcommand.clone());
        }
        text += &sections(subcommand, &path, others);
    }
    text
}

fn block(command: &mut Command) -> String {
    let help = command.render_long_help().to_string();
    let lines: Vec<&str> = help.trim_end().lines().map(str::trim_end).collect();
    format!("```text\n{}\n```\n\n", lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn command() -> Command {
        let options = Command::new("run").arg(clap::Arg::new("name").long("name"));
        let hidden = Command::new("man").hide(true);
        Command::new("blindgrasp").subcommand(options).subcommand(hidden).subcommand(Command::new("simulate"))
    }

    #[test]
    fn the_reference_has_each_command_and_its_options() {
        let of_robot = reference(command(), &HOUSES);
        assert!(of_robot.contains("## run") && of_robot.contains("--name"), "{of_robot}");
        assert!(!of_robot.contains("## man"), "a hidden command");
        assert!(!of_robot.contains("## simulate"), "a command of the lab's");
        assert!(reference(command(), &[]).contains("## simulate"));
    }

    #[test]
    fn each_command_has_a_manual_page() {
        let folder = tempfile::tempdir().expect("a folder");
        let arguments = Arguments { folder: Some(folder.path().join("man1")), markdown: false };
        run(&arguments, command(), &[]).expect("written");
        let page = |name: &str| std::fs::read_to_string(folder.path().join("man1").join(name)).expect(name);
        assert!(page("blindgrasp.1").contains("blindgrasp\\-run(1)"), "{}", page("blindgrasp.1"));
        assert!(page("blindgrasp-run.1").contains(".SH SYNOPSIS"));
    }
}
