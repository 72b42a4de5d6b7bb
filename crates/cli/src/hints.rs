//! The hint after a mistake in the command line.

use std::error::Error as _;
use std::ffi::OsString;
use std::path::Path;

use blindgrasp_messages::file_kind::FileKind;
use blindgrasp_operator::text::{did_you_mean, quote};
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command};

/// The error with a hint: the command or the option that is probably meant.
///
/// `root` is the command line's definition, and `words` are those that were typed, the program's name first.
pub fn with_hint(mut error: clap::Error, mut root: Command, words: &[OsString]) -> clap::Error {
    root.build();
    let mut command = &root;
    let mut words = words.iter().skip(1).map(|word| word.to_string_lossy()).peekable();
    while let Some(word) = words.peek()
        && let Some(found) = command.find_subcommand(&**word)
    {
        command = found;
        words.next();
    }
    let hint = match error.kind() {
        ErrorKind::InvalidSubcommand => {
            error.remove(ContextKind::SuggestedSubcommand);
            command_hint(command, &words.next().unwrap_or_default())
        }
        ErrorKind::UnknownArgument => {
            // Clap advises to pass the option as a value, '-- --x', and likens names that are not alike.
            error.remove(ContextKind::Suggested);
            error.remove(ContextKind::SuggestedArg);
            // Clap's usage would have the likened option.
            error.insert(ContextKind::Usage, ContextValue::StyledStr(command.clone().render_usage()));
            match error.get(ContextKind::InvalidArg) {
                Some(ContextValue::String(option)) => option_hint(command, option),
                _ => None,
            }
        }
        ErrorKind::ValueValidation => number_hint(&error),
        _ => None,
    };
    if let Some(hint) = hint {
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint.into()]));
    }
    error
}

/// The hint for a word in the place of a command.
fn command_hint(command: &Command, word: &str) -> Option<String> {
    if let Some(kind) = FileKind::at(Path::new(word))
        && command.get_name() == "blindgrasp"
    {
        return Some(format!("the command is missing before {}: it is {}", quote(word), kind.description()));
    }
    let commands = command.get_subcommands().filter(|known| !known.is_hide_set());
    did_you_mean(word, commands.map(Command::get_name))
}

/// The option that is meant, or how the parameter is given that was taken for an option.
fn option_hint(command: &Command, option: &str) -> Option<String> {
    let name = option.strip_prefix("--")?;
    let known: Vec<&str> = command.get_arguments().filter_map(Arg::get_long).collect();
    if let Some(alike) = did_you_mean(name, known.iter().copied()) {
        return Some(alike.replacen('\'', "'--", 1));
    }
    if known.contains(&"print-options") {
        return Some("--print-options prints what a file of --options can change".into());
    }
    known.contains(&"set").then(|| "a parameter of an operator is given by --set [NODE.]PARAM=VALUE".into())
}

/// Rust's own words for a number that is none say neither what was found nor what was expected.
fn number_hint(error: &clap::Error) -> Option<String> {
    match error.source()?.to_string().as_str() {
        "invalid digit found in string" | "cannot parse integer from empty string" => {
            Some("expected a whole number, without a unit".into())
        }
        "invalid float literal" | "cannot parse float from empty string" => {
            Some("expected a number like 0.5, without a unit".into())
        }
        _ => None,
    }
}
