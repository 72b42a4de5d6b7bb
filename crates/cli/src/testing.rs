//! Checks that the tests of each house make of its own command line.

use std::ffi::OsString;
use std::path::Path;

use clap::Command;
use clap::error::ErrorKind;

use crate::help::grouped;
use crate::houses::{GROUPS, House, house_of_command};

/// The words of a command line of a shell, up to a pipe, a comment or another command.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote) = (Vec::new(), None::<String>, None);
    for char in line.chars() {
        match (quote, char) {
            (Some(open), _) if char == open => quote = None,
            (None, '\'' | '"') => {
                quote = Some(char);
                word.get_or_insert_default();
            }
            (None, '|' | '&' | ';' | ')' | '>' | '<') => break,
            (None, '#') if word.is_none() => break,
            (None, ' ') => words.extend(word.take()),
            _ => word.get_or_insert_default().push(char),
        }
    }
    words.into_iter().chain(word).collect()
}

/// Reads the commands of this `house`, or of the robot, in the shell blocks of the pages. Returns how many there are, and those that
/// its command line does not accept: names, options and numbers of arguments; `…` stands for any further options.
///
/// # Panics
/// A folder of pages is missing.
pub fn mistakes_in_docs(root: &Path, command: &Command, house: Option<&House>) -> (usize, Vec<String>) {
    let folders = ["", "docs", "hands"].map(|folder| root.join(folder));
    let pages = folders.iter().flat_map(|folder| std::fs::read_dir(folder).expect("a folder").flatten());
    let (mut n, mut mistakes) = (0, Vec::new());
    for page in pages.map(|page| page.path()).filter(|path| path.extension().is_some_and(|it| it == "md")) {
        let text = std::fs::read_to_string(&page).expect("a page").replace("\\\n", " ");
        let mut is_shell = false;
        for line in text.lines() {
            let line = line.trim_start();
            if line.starts_with("```") {
                is_shell = line == "```sh";
                continue;
            }
            if !is_shell {
                continue;
            }
            for (at, name) in line.match_indices("blindgrasp ") {
                let before = &line[..at];
                let words = words(&line[at + name.len()..]);
                // Behind an option it is a name, as in `sudo -u blindgrasp`.
                let is_value = before.split_whitespace().last().is_some_and(|word| word.starts_with('-'));
                let is_command = (before.is_empty() || before.ends_with([' ', '('])) && !is_value;
                let is_complete = !words.iter().any(|word| word.contains(['…', '$']));
                if !is_command || !is_complete || words.is_empty() || before.contains('#') {
                    continue;
                }
                let of: Vec<OsString> = words.iter().map(OsString::from).collect();
                if house_of_command(&of).map(|house| house.program) != house.map(|house| house.program) {
                    continue;
                }
                n += 1;
                let words = std::iter::once("blindgrasp".to_owned()).chain(words);
                if let Err(error) = command.clone().try_get_matches_from(words)
                    && !matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion)
                {
                    mistakes.push(format!("{}: {line}: {error}", page.display()));
                }
            }
        }
    }
    (n, mistakes)
}

/// The mistakes in a house's rows of the table ([`crate::houses`]) and in the list of its commands.
pub fn mistakes_in_table(commands: &[(&str, &str)], command: &clap::Command) -> Vec<String> {
    let mut mistakes = Vec::new();
    for (name, about) in commands {
        let found = name.split(' ').try_fold(command, |command, word| command.find_subcommand(word));
        let told = found.and_then(clap::Command::get_about).map(|about| about.to_string());
        if told.as_deref() != Some(about) {
            mistakes.push(format!("{name}: the table says '{about}', the command {told:?}"));
        }
    }
    for command in command.get_subcommands().filter(|command| !command.is_hide_set()) {
        let name = command.get_name();
        if !GROUPS.iter().any(|(_, names)| names.contains(&name)) {
            mistakes.push(format!("{name} is in no group"));
        }
        let is_listed = commands.iter().any(|(listed, _)| listed.split(' ').next() == Some(name));
        if !is_listed && !commands.is_empty() {
            mistakes.push(format!("{name} is not in the table: 'blindgrasp {name}' would not find it"));
        }
    }
    // The robot's program lists all commands.
    for name in GROUPS.iter().flat_map(|(_, names)| *names) {
        if commands.is_empty() && command.find_subcommand(name).is_none() {
            mistakes.push(format!("'{name}' of the groups is no command"));
        }
    }
    let help = grouped(command.clone()).render_help().to_string();
    mistakes.extend(
        help.lines().filter(|line| line.chars().count() > 80).map(|line| format!("more than 80 characters: {line}")),
    );
    mistakes
}
