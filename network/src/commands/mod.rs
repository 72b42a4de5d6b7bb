//! The commands of the network's house, one file each.

mod diagnostics;
mod keys;
mod robot_description;

use std::process::ExitCode;

use clap::{CommandFactory, Parser};

use blindgrasp_cli::{Outcome, completions, data_on_stdout, print_line, secs_in};
use blindgrasp_session::output::write_out;

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
    Diagnostics diagnostics, Keys keys;
    hidden RobotDescription robot_description, Man manual, Operator operator
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
    use blindgrasp_cli::houses::NETWORK;
    use blindgrasp_cli::testing::mistakes_in_table;

    use super::*;

    #[test]
    fn the_table_of_houses_names_these_commands() {
        assert_eq!(mistakes_in_table(NETWORK.commands, &Cli::command()), [""; 0]);
    }
}
