//! The commands of the robot's house, one file each. They wire library and runtime together and hold no logic of their own.

mod background;
mod check;
mod completions;
mod doctor;
mod echo;
mod elsewhere;
mod export;
mod hand_cells;
mod info;
mod init;
mod logs;
mod new;
mod operator;
mod predict;
mod promises;
mod ps;
mod record;
mod recording_arguments;
mod replay;
mod run;
mod schema;
mod set;
mod stop;
mod swap;
mod test;
mod top;
mod view;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, Parser};

use blindgrasp_cli::houses::{self, HOUSES};
use blindgrasp_cli::{Outcome, completions as words, data_on_stdout, man, print_line, print_text, secs_in, stop_signal};
use blindgrasp_session::output::{check_new, check_output, check_page, write_out, write_report};
use blindgrasp_session::text_table::{self, percent};

/// Decides from touch and joint angles whether a grasp will hold before the lift.
///
/// Exit codes: 0 done, 1 failed, 2 usage, 3 finished with loss.
#[derive(Debug, Parser)]
#[command(name = "blindgrasp", version, propagate_version = true)]
#[command(after_help = "Example: blindgrasp init my-robot && blindgrasp run my-robot/dataflow.yaml")]
pub(crate) struct Cli {
    #[command(subcommand)]
    command: Command,
}

blindgrasp_cli::commands! {
    Run run, Ps ps, Top top, Echo echo, Stop stop, Set set, Swap swap, Logs logs, Doctor doctor, Record record, Replay replay,
    Test test, Export export, Info info, View view, Predict predict, Init init, New new, Schema schema,
    Completions completions;
    hidden Man manual, Operator operator
}

/// `blindgrasp man`
mod manual {
    pub(super) use super::man::Arguments;

    pub(super) fn run(arguments: &Arguments) -> anyhow::Result<super::Outcome> {
        super::man::run(arguments, super::command(), &super::HOUSES)
    }
}

impl Cli {
    /// Parses the command line. A mistake ends the process with its explanation and code 2.
    pub(crate) fn read() -> Cli {
        words::answer_shell(command);
        elsewhere::answer_caller();
        blindgrasp_cli::parse(command())
    }

    /// Runs the operator that this process is to be. An operator reports its end to the launcher, not to a person.
    pub(crate) fn run_operator(&self) -> Option<ExitCode> {
        match &self.command {
            Command::Operator(arguments) => Some(operator::start(arguments)),
            _ => None,
        }
    }
}

/// The command line, with the commands of the other houses, which it lists.
fn command() -> clap::Command {
    houses::with_other_houses(Cli::command())
}
