//! The three programs: `blindgrasp` for a robot, `blindgrasp-lab` for data and models, `blindgrasp-network` for other machines
//! and Zenoh. People, launchers and scripts call `blindgrasp`, which hands over to the others.

use std::borrow::Cow;
use std::ffi::{OsStr, OsString};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use anyhow::Context;
use blindgrasp_graph::operators::running_program;
use blindgrasp_operators::houses::{LAB_PROGRAM, NETWORK_PROGRAM, house_of_process};

/// A program beside `blindgrasp`, and the commands that it has, each with its line in the help.
#[derive(Debug)]
pub struct House {
    pub program: &'static str,
    pub commands: &'static [(&'static str, &'static str)],
}

pub const LAB: House = House {
    program: LAB_PROGRAM,
    commands: &[
        ("learn", "Learn a hand: lift in simulation, train, judge"),
        ("simulate", "Simulate grasps with labels, or list the objects"),
        ("import", "Turn a table (CSV) or lines of frames into a recording"),
        ("train", "Train a model on recordings with labels"),
        ("evaluate", "Compare decisions with labels, on recordings or by folds"),
        ("trials", "Lift objects in simulated physics, as the paper did"),
        ("model", "Describe or adapt a model, or rate approaches"),
        ("sensors", "Learn a healthy hand's sensors, or look for faults in recordings"),
        ("new hand", "A hand: its URDF and a pad layout"),
    ],
};

pub const NETWORK: House =
    House { program: NETWORK_PROGRAM, commands: &[("keys", "Make keys and certificates for several machines")] };

pub const HOUSES: [&House; 2] = [&LAB, &NETWORK];

/// The commands of all houses in the groups and the order of the help.
pub const GROUPS: [(&str, &[&str]); 4] = [
    ("Run", &["run", "ps", "top", "echo", "stop", "set", "swap", "logs", "doctor"]),
    ("Record", &["record", "replay", "test", "export", "info", "view"]),
    ("Learn", &["learn", "simulate", "import", "train", "evaluate", "predict", "trials", "model", "sensors"]),
    ("Describe", &["init", "new", "keys", "schema", "completions"]),
];

impl House {
    /// The path of its program: beside the running one.
    ///
    /// # Errors
    /// The program is missing. The text says how to get it.
    pub fn path(&self) -> anyhow::Result<PathBuf> {
        let running = running_program().context("the path of this program is unknown")?;
        let path = running.with_file_name(self.program);
        // A link to the running program would hand over to itself for ever.
        anyhow::ensure!(
            path.canonicalize().is_ok_and(|found| found.is_file() && found != running),
            "there is no {}: build it with 'cargo build --release --workspace', or install a package, which has all programs",
            path.display()
        );
        Ok(path)
    }

    /// The stdout of its program with these arguments.
    ///
    /// # Errors
    /// The program is missing, or it fails: then the text is that of its own error.
    pub fn answer<S: AsRef<OsStr>>(&self, arguments: impl IntoIterator<Item = S>) -> anyhow::Result<Vec<u8>> {
        let path = self.path()?;
        let output = Command::new(&path).args(arguments).output();
        let output = output.with_context(|| format!("cannot start {}", path.display()))?;
        let said = String::from_utf8_lossy(&output.stderr);
        anyhow::ensure!(output.status.success(), "{}", said.trim_end().trim_start_matches("blindgrasp: "));
        Ok(output.stdout)
    }

    /// Replaces this process by its program with these arguments.
    ///
    /// # Errors
    /// There is no such program, or it cannot be started.
    pub fn become_it<S: AsRef<OsStr>>(
        &self,
        arguments: impl IntoIterator<Item = S>,
    ) -> anyhow::Result<std::convert::Infallible> {
        let path = self.path()?;
        let error = Command::new(&path).arg0("blindgrasp").args(arguments).exec();
        Err(error).with_context(|| format!("cannot start {}", path.display()))
    }
}

/// The robot's program: the running one, or the one beside that of another house.
///
/// # Errors
/// The path of the running program is unknown.
pub fn robot_program() -> std::io::Result<PathBuf> {
    let running = running_program()?;
    let is_of_house = HOUSES.iter().any(|house| running.file_name() == Some(OsStr::new(house.program)));
    Ok(if is_of_house { running.with_file_name("blindgrasp") } else { running })
}

/// The house that has the command of these words, which follow the program's name. An operator's house may depend on its params,
/// which this process was given.
pub fn house_of_command(words: &[OsString]) -> Option<&'static House> {
    let mut words = words.iter().map(|word| word.to_string_lossy()).filter(|word| word != "help");
    let first = words.next()?;
    if first == "operator" {
        let name = words.next()?;
        let arguments: Vec<String> = words.map(Cow::into_owned).collect();
        let program = house_of_process(&name, &arguments)?;
        return HOUSES.into_iter().find(|house| house.program == program);
    }
    let both = format!("{first} {}", words.next().unwrap_or_default());
    HOUSES.into_iter().find(|house| house.commands.iter().any(|(name, _)| *name == first || *name == both))
}

/// A command line with the commands of other houses, which it only lists.
pub fn with_commands_of(houses: &[&House], mut command: clap::Command) -> clap::Command {
    for (name, about) in houses.iter().flat_map(|house| house.commands) {
        match name.split_once(' ') {
            Some((parent, name)) => {
                command = command.mut_subcommand(parent, |parent| parent.subcommand(listed(name, about)));
            }
            None => command = command.subcommand(listed(name, about)),
        }
    }
    command
}

fn listed(name: &'static str, about: &'static str) -> clap::Command {
    clap::Command::new(name).about(about)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_found_in_their_houses() {
        let program = |line: &str| {
            let words: Vec<OsString> = line.split(' ').map(OsString::from).collect();
            house_of_command(&words).map(|house| house.program)
        };
        for line in ["simulate --list", "help train", "new hand x --urdf y", "help new hand"] {
            assert_eq!(program(line), Some("blindgrasp-lab"), "{line}");
        }
        assert_eq!(program("keys /k"), Some("blindgrasp-network"));
        for line in ["run simulate", "new operator hand", "--help", "new", "help"] {
            assert_eq!(program(line), None, "{line}");
        }
    }
}
