//! The commands of the lab's house, one file each.

mod approaches;
mod completions;
mod evaluate;
mod hand;
mod import;
mod mesh;
mod model;
mod new;
mod object_list;
mod quality;
mod sensors;
mod simulate;
mod train;
mod trials;

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

use blindgrasp_cli::{Outcome, number_in, print_line, print_text, stop_requests};
use blindgrasp_session::output::{check_new, check_output, check_page, write_out, write_report};
use blindgrasp_session::text_table::percent;

/// Decides from touch and joint angles whether a grasp will hold before the lift.
///
/// Exit codes: 0 done, 1 failed, 2 usage, 3 finished with loss.
#[derive(Debug, Parser)]
#[command(name = "blindgrasp", version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

blindgrasp_cli::commands! {
    Simulate simulate, Import import, Train train, Evaluate evaluate, Trials trials, Model model, Sensors sensors, New new;
    hidden Mesh mesh, Quality quality, Man manual, Operator operator
}

/// `blindgrasp man`
mod manual {
    use clap::CommandFactory;

    pub(super) use blindgrasp_cli::man::Arguments;

    pub(super) fn run(arguments: &Arguments) -> anyhow::Result<super::Outcome> {
        blindgrasp_cli::man::run(arguments, super::Cli::command(), &[])
    }
}

/// `blindgrasp operator`
mod operator {
    pub(super) use blindgrasp_cli::operator::Arguments;

    /// `main` has run it.
    #[expect(clippy::unnecessary_wraps, reason = "the form of a command")]
    pub(super) fn run(_: &Arguments) -> anyhow::Result<super::Outcome> {
        Ok(super::Outcome::Done)
    }
}

impl Cli {
    /// Parses the command line. A mistake ends the process with its explanation and code 2.
    pub(crate) fn read() -> Cli {
        blindgrasp_cli::completions::answer_shell(Cli::command);
        blindgrasp_cli::parse(Cli::command())
    }

    /// Runs the operator that this process is to be. An operator reports its end to the launcher, not to a person.
    pub(crate) fn run_operator(&self) -> Option<ExitCode> {
        match &self.command {
            Command::Operator(arguments) => Some(blindgrasp_cli::operator::run(arguments, &crate::operators::SHIPPED)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::path::Path;

    use blindgrasp_cli::hints::with_hint;
    use blindgrasp_cli::houses::LAB;
    use blindgrasp_cli::testing::{mistakes_in_docs, mistakes_in_table};

    use super::*;

    #[test]
    fn the_table_of_houses_and_the_docs_name_these_commands() {
        assert_eq!(mistakes_in_table(LAB.commands, &Cli::command()), [""; 0]);
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the project");
        let (n, mistakes) = mistakes_in_docs(root, &Cli::command(), Some(&LAB));
        assert!(mistakes.is_empty() && n > 40, "{n} commands\n{}", mistakes.join("\n"));
    }

    #[test]
    fn mistakes_get_a_hint_where_there_is_one() {
        for (line, expected) in [
            ("simulate --zzz 1", "tip: --print-options"),
            ("simulate --grasps many --out x.mcap", "expected a whole number"),
            ("model list", "unrecognized subcommand"),
        ] {
            let words: Vec<OsString> =
                std::iter::once("blindgrasp").chain(line.split(' ')).map(OsString::from).collect();
            let error = Cli::command().try_get_matches_from(&words).expect_err("a mistake");
            let text = with_hint(error, Cli::command(), &words).to_string();
            assert!(text.contains(expected) && !text.contains("as a value"), "blindgrasp {line}: {text}");
        }
    }
}
