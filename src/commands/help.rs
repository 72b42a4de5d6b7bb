//! The list of commands in `--help`, in groups.

use clap::Command;

use super::GROUPS;

const TEMPLATE: &str = "{about-with-newline}\n{usage-heading} {usage}\n\n{before-help}Options:\n{options}{after-help}";

/// The command with its subcommands listed in groups.
pub(super) fn grouped(command: Command) -> Command {
    let mut list = String::new();
    for (group, names) in GROUPS {
        list += &format!("{group}:\n");
        for name in *names {
            let about = command.find_subcommand(name).and_then(Command::get_about);
            let about = about.map(ToString::to_string).unwrap_or_default();
            list += &format!("  {name:<12} {}\n", about.trim_end_matches('.'));
        }
        list += "\n";
    }
    // The list brings its own end of line.
    command.help_template(TEMPLATE).before_help(list.trim_end().to_owned())
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;
    use clap::error::ErrorKind;

    use super::super::Cli;
    use super::*;

    #[test]
    fn each_command_fits_a_line() {
        let command = Cli::command();
        let help = grouped(command).render_help().to_string();
        assert!(help.lines().all(|line| line.chars().count() <= 80), "{help}");
        assert!(help.contains("Learn:\n  simulate"), "{help}");
    }

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

    /// Names, options and numbers of arguments; `…` stands for any further options.
    #[test]
    fn each_command_in_the_docs_is_accepted() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
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
                    n += 1;
                    let words = std::iter::once("blindgrasp".to_owned()).chain(words);
                    if let Err(error) = grouped(Cli::command()).try_get_matches_from(words)
                        && !matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion)
                    {
                        mistakes.push(format!("{}: {line}: {error}", page.display()));
                    }
                }
            }
        }
        assert!(mistakes.is_empty() && n > 100, "{n} commands\n{}", mistakes.join("\n"));
    }
}
