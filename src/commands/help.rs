//! The list of commands in `--help`, in groups, and hints for words that are no commands.

use clap::Command;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// The commands of each group, in the order of the help.
const GROUPS: [(&str, &[&str]); 4] = [
    ("Run", &["run", "ps", "top", "echo", "stop", "set", "swap", "logs", "doctor", "diagnostics"]),
    ("Record", &["record", "replay", "test", "export", "info", "view"]),
    ("Learn", &["simulate", "import", "train", "evaluate", "predict", "trials", "reproduce", "model", "sensors"]),
    ("Describe", &["init", "new", "keys", "schema", "completions"]),
];
/// Words that people type, with the command that does it here.
const HINTS: [(&str, &str); 32] = [
    ("check", "run --check"),
    ("param", "set"),
    ("get", "set NODE.PARAM"),
    ("hz", "top --json -n 1"),
    ("compare", "test"),
    ("diff", "test"),
    ("convert", "export"),
    ("inspect", "info"),
    ("serve", "view"),
    ("ui", "view"),
    ("dashboard", "view"),
    ("hands", "simulate --list"),
    ("objects", "simulate --list"),
    ("quality", "info CASES.json"),
    ("topic", "echo', 'blindgrasp top' or 'blindgrasp ps"),
    ("node", "ps"),
    ("plot", "view"),
    ("viz", "view"),
    ("bag", "record' or 'blindgrasp replay"),
    ("service", "ps"),
    ("ls", "ps"),
    ("kill", "stop"),
    ("destroy", "stop"),
    ("rqt_graph", "view"),
    ("rviz", "view"),
    ("fit", "train"),
    ("score", "evaluate"),
    ("version", "--version"),
    ("validate", "run --check"),
    ("pub", "replay"),
    ("monitor", "top"),
    ("demo", "init DIR"),
];
/// Options that people type, with what does it here.
const OPTION_HINTS: [(&str, &str); 15] = [
    ("--dry-run", "use 'blindgrasp run --check'"),
    ("--speed", "use 'blindgrasp replay --rate 2' for a recording, --set recorded_source.rate=2 in a graph"),
    ("--rate", "use --set recorded_source.rate=2, or 'blindgrasp replay --rate 2' for a recording"),
    ("-v", "set the environment variable RUST_LOG=debug"),
    ("--verbose", "set the environment variable RUST_LOG=debug"),
    ("--data", RECORDING_HINT),
    ("--dataset", RECORDING_HINT),
    ("--input", RECORDING_HINT),
    ("--recording", RECORDING_HINT),
    ("--model", "give the model's file without an option: blindgrasp predict MODEL RECORDING"),
    ("--n", "use --grasps N"),
    ("--gate", "use --lift-policy decision, always or both"),
    ("--running", "give the graph's name without an option: blindgrasp view GRAPH --format mermaid"),
    ("--threshold-probability", "use --threshold PROBABILITY"),
    ("--max-false-positive-rate", "use --max-drops SHARE, for labels of lifts, or --drop-secs SECONDS"),
];
const RECORDING_HINT: &str = "give the recording's file without an option: blindgrasp train RECORDING --out MODEL";
const TEMPLATE: &str = "{about-with-newline}\n{usage-heading} {usage}\n\n{before-help}Options:\n{options}{after-help}";

/// The command with its subcommands listed in groups.
pub(super) fn grouped(command: Command) -> Command {
    let mut list = String::new();
    for (group, names) in GROUPS {
        list += &format!("{group}:\n");
        for name in names {
            let about = command.find_subcommand(name).and_then(Command::get_about);
            let about = about.map(ToString::to_string).unwrap_or_default();
            list += &format!("  {name:<12} {}\n", about.trim_end_matches('.'));
        }
        list += "\n";
    }
    // The list brings its own end of line.
    command.help_template(TEMPLATE).before_help(list.trim_end().to_owned())
}

/// The error, with the command or the option that is probably meant.
pub(super) fn with_hint(mut error: clap::Error) -> clap::Error {
    let hint = match error.kind() {
        ErrorKind::InvalidSubcommand => command_hint(&error),
        ErrorKind::UnknownArgument => {
            // Clap advises to pass the option as a value, '-- --x', which is never what is meant here.
            error.remove(ContextKind::Suggested);
            option_hint(&error)
        }
        _ => None,
    };
    if let Some(hint) = hint {
        error.remove(ContextKind::SuggestedSubcommand);
        error.remove(ContextKind::SuggestedArg);
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint.into()]));
    }
    error
}

fn command_hint(error: &clap::Error) -> Option<String> {
    let word = text_of(error, ContextKind::InvalidSubcommand)?;
    if text_of(error, ContextKind::Usage)?.contains("blindgrasp new ") {
        return Some(format!("use 'blindgrasp init {word}' for a project of that name"));
    }
    let (_, instead) = HINTS.iter().find(|(other, _)| *other == word)?;
    Some(format!("use 'blindgrasp {instead}'"))
}

fn option_hint(error: &clap::Error) -> Option<String> {
    let option = text_of(error, ContextKind::InvalidArg)?;
    let (_, hint) = OPTION_HINTS.iter().find(|(other, _)| *other == option)?;
    Some((*hint).into())
}

fn text_of(error: &clap::Error, kind: ContextKind) -> Option<String> {
    match error.get(kind)? {
        ContextValue::String(text) => Some(text.clone()),
        ContextValue::StyledStr(text) => Some(text.to_string()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::super::Cli;
    use super::*;

    #[test]
    fn each_command_is_in_one_group_and_fits_a_line() {
        let command = Cli::command();
        let listed: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
        let mut visible: Vec<&str> =
            command.get_subcommands().filter(|known| !known.is_hide_set()).map(Command::get_name).collect();
        let mut sorted = listed.clone();
        sorted.sort_unstable();
        visible.sort_unstable();
        assert_eq!(sorted, visible);
        let help = grouped(command).render_help().to_string();
        assert!(help.lines().all(|line| line.chars().count() <= 80), "{help}");
        assert!(help.contains("Learn:\n  simulate"), "{help}");
    }

    #[test]
    fn words_that_people_type_are_answered_with_the_command_here() {
        for (line, expected) in [
            ("plot", "use 'blindgrasp view'"),
            ("compare", "use 'blindgrasp test'"),
            ("param list", "use 'blindgrasp set'"),
            ("check dataflow.yaml", "use 'blindgrasp run --check'"),
            ("new demo", "use 'blindgrasp init demo'"),
            ("run --dry-run", "use 'blindgrasp run --check'"),
            ("run --speed 2", "recorded_source.rate"),
            ("run -v", "RUST_LOG"),
            ("train --data train.mcap", "blindgrasp train RECORDING"),
            ("predict --model m.json", "blindgrasp predict MODEL"),
            ("trials --gate on", "--lift-policy"),
        ] {
            let words = std::iter::once("blindgrasp").chain(line.split(' '));
            let error = grouped(Cli::command()).try_get_matches_from(words).expect_err("a mistake");
            let text = with_hint(error).to_string();
            assert!(text.contains(expected), "{line}: {text}");
            assert!(!text.contains("as a value") && !text.contains("similar"), "{line}: {text}");
        }
        let error =
            grouped(Cli::command()).try_get_matches_from(["blindgrasp", "run", "--chek"]).expect_err("a mistake");
        let text = with_hint(error).to_string();
        assert!(text.contains("--check") && !text.contains("as a value"), "{text}");
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

    #[test]
    fn no_hint_hides_a_command() {
        let command = Cli::command();
        assert!(HINTS.iter().all(|(word, _)| command.find_subcommand(word).is_none()));
        // A command with such an option is not asked for a hint.
        assert!(OPTION_HINTS.iter().all(|(option, _)| option.starts_with('-')));
    }
}
