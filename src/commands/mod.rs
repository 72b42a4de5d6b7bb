//! The commands of the robot's house, one file each. They wire library and runtime together and hold no logic of their own.

mod background;
mod check;
mod completions;
mod doctor;
mod echo;
mod export;
mod hand_cells;
mod info;
mod init;
mod logs;
mod new;
mod predict;
mod promises;
mod ps;
mod record;
mod recording_arguments;
mod replay;
mod ros_messages;
mod run;
mod schema;
mod set;
mod stop;
mod swap;
mod test;
mod top;
mod view;

use std::ffi::OsString;

use blindgrasp_cli::completions::VARIABLE;
use blindgrasp_cli::houses::{HOUSES, house_of_command};
use blindgrasp_cli::{Outcome, data_on_stdout, number_in, print_line, print_text, secs_in, stop_requests, stop_signal};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_session::output::{check_new, check_output, write_out};
use blindgrasp_session::text_table::{self, percent};

blindgrasp_cli::program! {
    Run run, Ps ps, Top top, Echo echo, Stop stop, Set set, Swap swap, Logs logs, Doctor doctor, Record record, Replay replay,
    Test test, Export export, Info info, View view, Predict predict, Init init, New new, Schema schema,
    Completions completions; hidden;
    operators blindgrasp_operators::SHIPPED; others &HOUSES
}

/// Replaces this process by the program of the house that has the command, unless that is the robot's.
pub(crate) fn hand_over() {
    let arguments: Vec<OsString> = std::env::args_os().skip(1).collect();
    let mut words = arguments.as_slice();
    // A shell that asks for words gives the line so far behind the options of its own.
    if std::env::var_os(VARIABLE).is_some() {
        let at = words.iter().position(|word| word == "--").map_or(words.len(), |at| (at + 2).min(words.len()));
        words = &words[at..];
    }
    let Some(house) = house_of_command(words) else { return };
    let Err(error) = house.become_it(&arguments);
    // The shell would show it in the line that is being typed.
    if std::env::var_os(VARIABLE).is_none() {
        print_diagnostic(&format!("blindgrasp: {error:#}"));
    }
    std::process::exit(1);
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use blindgrasp_cli::hints;
    use blindgrasp_cli::testing::{mistakes_in_docs, mistakes_in_table};

    use super::*;

    #[test]
    fn the_commands_of_the_docs_are_accepted_and_the_help_lists_all() {
        assert_eq!(mistakes_in_table(&[], &command()), [""; 0]);
        let (n, mistakes) = mistakes_in_docs(Path::new(env!("CARGO_MANIFEST_DIR")), &command(), None);
        assert!(mistakes.is_empty() && n > 60, "{n} commands\n{}", mistakes.join("\n"));
    }

    /// The text of the error for a line, with its hint.
    fn told(line: &str) -> String {
        let words: Vec<OsString> = std::iter::once("blindgrasp").chain(line.split(' ')).map(OsString::from).collect();
        let error = command().try_get_matches_from(&words).expect_err("a mistake");
        hints::with_hint(error, command(), &words).to_string()
    }

    #[test]
    fn mistakes_are_likened_and_unknown_words_get_no_false_hint() {
        for (line, expected) in [
            ("evalute m.json", "tip: did you mean 'evaluate'?"),
            ("run --chek", "tip: did you mean '--check'?"),
            ("run --votes 4", "tip: a parameter of an operator is given by --set"),
        ] {
            let text = told(line);
            assert!(text.contains(expected) && !text.contains("as a value"), "blindgrasp {line}: {text}");
        }
        for line in ["zzz", "Cargo.toml/none", "ps --zzz", "info a --zzz", "predict m.json a.mcap -z"] {
            let text = told(line);
            assert!(!text.contains("tip"), "blindgrasp {line}: {text}");
        }
    }

    #[test]
    fn a_file_in_the_place_of_the_command_says_what_it_is() {
        let text = told(concat!(env!("CARGO_MANIFEST_DIR"), "/dataflow.yaml"));
        assert!(text.contains("the command is missing before") && text.contains("blindgrasp run"), "{text}");
    }
}
