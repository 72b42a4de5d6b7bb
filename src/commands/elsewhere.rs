//! `--machine NAME`: the same command on another machine, through the program `ssh`.
//!
//! The words of the command line go there as they are. [`VARIABLE`] tells the command there that it was called over ssh,
//! and by which version: it does not look for the machine again.
//!
//! ssh without a terminal passes no signals on. So the command there reads its stdin: a line [`STOP`] is Ctrl-C, and the
//! end of stdin means that the caller has gone, which stops the command as well.

use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::io::{BufRead, IsTerminal, Write};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use rustix::process::{Signal, getpid, kill_process};

use super::{Outcome, completions, stop_requests};
use blindgrasp_graph::client::{running_graphs, status};
use blindgrasp_graph::dataflow::is_ssh_host;
use blindgrasp_operator::diagnostics::print_diagnostic;

/// Set for a command that was called over ssh, to the version of the caller.
const VARIABLE: &str = "BLINDGRASP_OVER_SSH";
/// The program to use in place of `ssh`, with its options, for a shell.
const SSH_VARIABLE: &str = "BLINDGRASP_SSH";
/// A line to the command on the other machine: stop, as with Ctrl-C.
const STOP: &str = "stop";
/// The caller checks this often whether the command has ended or is to be stopped.
const POLL: Duration = Duration::from_millis(20);
/// The exit code of `ssh` if it has no connection.
const NO_CONNECTION: i32 = 255;
/// The exit codes of a shell for a program that cannot be started, and for one that does not exist.
const NOT_STARTED: [i32; 2] = [126, 127];
/// The exit code of a shell for a command that Ctrl-C has ended.
const INTERRUPTED: u8 = 130;

#[derive(Debug, Args)]
#[command(next_help_heading = "Another machine")]
pub(super) struct MachineArgument {
    /// Run this command on another machine, through ssh
    #[arg(long, value_name = "NAME", add = completions::machines())]
    machine: Option<String>,
    /// Its destination for ssh [default: `ssh` of the machine in the dataflow file of a graph that runs here, or NAME]
    #[arg(long, value_name = "USER@HOST", requires = "machine")]
    ssh: Option<String>,
}

/// Another machine, and where ssh finds it.
#[derive(Debug)]
pub(super) struct Destination {
    pub(super) machine: String,
    pub(super) host: String,
}

impl MachineArgument {
    /// The other machine that the command is for; `None` if it is for this one.
    ///
    /// # Errors
    /// ssh would not take the destination, or it is not known which one is meant.
    pub(super) fn destination(&self) -> anyhow::Result<Option<Destination>> {
        if is_over_ssh() {
            return Ok(None);
        }
        let Some(machine) = self.machine.clone() else { return Ok(None) };
        let host = match &self.ssh {
            Some(host) => host.clone(),
            None => host_of(&machine)?,
        };
        if !is_ssh_host(&host) {
            bail!("'{host}' is no destination of ssh: expected one like user@192.168.1.10, or a host of ~/.ssh/config");
        }
        Ok(Some(Destination { machine, host }))
    }
}

impl Destination {
    /// Runs this process's command there. Its output goes to stdout and stderr here.
    ///
    /// # Errors
    /// There is no connection, or no program `blindgrasp`.
    pub(super) fn run(&self) -> anyhow::Result<Outcome> {
        let n_stops = stop_requests()?;
        let mut ssh = self.command("-T")?.stdin(Stdio::piped()).spawn().context("cannot start ssh")?;
        let (status, is_stopped) = wait(&mut ssh, &n_stops)?;
        self.outcome(status, is_stopped)
    }

    /// Runs this process's command there, on this terminal.
    ///
    /// # Errors
    /// As [`Destination::run`].
    pub(super) fn run_on_terminal(&self) -> anyhow::Result<Outcome> {
        let status = self.command("-t")?.status().context("cannot start ssh")?;
        self.outcome(status, false)
    }

    fn command(&self, terminal: &str) -> anyhow::Result<Command> {
        let ssh = match std::env::var_os(SSH_VARIABLE) {
            Some(ssh) => ssh,
            None if is_on_path("ssh") => "ssh".into(),
            None => bail!("there is no program ssh on PATH: install it (apt install openssh-client)"),
        };
        // Ctrl-C reaches all processes of a terminal. Without one of its own, ssh must stay until the command there has
        // ended.
        let mut script = OsString::from(if terminal == "-t" { "exec " } else { "trap '' INT; exec " });
        script.push(ssh);
        script.push(" \"$@\"");
        let mut command = Command::new("sh");
        command.arg("-c").arg(script).arg("sh").arg(terminal);
        // A connection that is dead is noticed.
        command.args(["-o", "ServerAliveInterval=5"]);
        if !std::io::stdin().is_terminal() {
            // Nobody can answer a question.
            command.args(["-o", "BatchMode=yes"]);
        }
        let words = std::env::args_os().skip(1);
        command.arg("--").arg(&self.host).arg(words_for_shell(words));
        Ok(command)
    }

    /// How the command ended there.
    ///
    /// # Errors
    /// There is no connection, or no program `blindgrasp`.
    fn outcome(&self, status: ExitStatus, is_stopped: bool) -> anyhow::Result<Outcome> {
        let Destination { machine, host } = self;
        match status.code() {
            Some(0) => Ok(Outcome::Done),
            Some(3) => Ok(Outcome::FinishedWithLoss),
            Some(code) if NOT_STARTED.contains(&code) => bail!(
                "machine '{machine}' ({host}) cannot start blindgrasp: install the same version there, in a folder that \
                 `ssh {host} 'echo $PATH'` names, like /usr/local/bin"
            ),
            // ssh has no code for a command that a signal has ended.
            Some(NO_CONNECTION) if !is_stopped => bail!(
                "no connection to machine '{machine}': try `ssh {host}`. Another destination is given with --ssh, or in the \
                 dataflow file, machines: {{{machine}: {{ssh: USER@HOST}}}}"
            ),
            Some(code) if !is_stopped || code != NO_CONNECTION => {
                Ok(Outcome::OfOtherMachine(u8::try_from(code).unwrap_or(1)))
            }
            _ if is_stopped || status.signal() == Some(Signal::INT.as_raw()) => {
                Ok(Outcome::OfOtherMachine(INTERRUPTED))
            }
            _ => bail!("ssh to machine '{machine}' has ended: {status}"),
        }
    }
}

/// Waits for the end of the command there, and passes Ctrl-C on: a second one ends ssh. Returns whether it was pressed.
///
/// # Errors
/// ssh cannot be waited for.
fn wait(ssh: &mut Child, n_stops: &AtomicUsize) -> anyhow::Result<(ExitStatus, bool)> {
    let mut n_said = 0;
    loop {
        if let Some(status) = ssh.try_wait().context("cannot wait for ssh")? {
            return Ok((status, n_said > 0));
        }
        let n_stops = n_stops.load(Ordering::Relaxed);
        if n_stops > 0
            && n_said == 0
            && let Some(stdin) = ssh.stdin.as_mut()
        {
            // If it has ended, there is nobody to tell.
            let _ = writeln!(stdin, "{STOP}").and_then(|()| stdin.flush());
        }
        if n_stops > 1 {
            let _ = ssh.kill();
        }
        n_said = n_stops;
        std::thread::sleep(POLL);
    }
}

/// Listens to the caller, if this process was called over ssh without a terminal. Another version ends the process.
pub(crate) fn answer_caller() {
    let Some(theirs) = std::env::var_os(VARIABLE) else { return };
    // A program that the command asks with --describe has no caller of its own.
    if std::env::args_os().nth(1).is_some_and(|word| word == "operator") {
        return;
    }
    let own = env!("CARGO_PKG_VERSION");
    if theirs != own {
        print_diagnostic(&format!(
            "blindgrasp: this machine has version {own}, and the command comes from version {}: install the same version on \
             both",
            theirs.display()
        ));
        std::process::exit(1);
    }
    if std::io::stdin().is_terminal() {
        return;
    }
    std::thread::spawn(|| {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if line == STOP {
                stop_self();
            }
        }
        stop_self();
    });
}

/// Whether this process was called by [`Destination`].
pub(super) fn is_over_ssh() -> bool {
    std::env::var_os(VARIABLE).is_some()
}

/// As Ctrl-C does.
fn stop_self() {
    let _ = kill_process(getpid(), Signal::INT);
}

/// The destination that the dataflow files of the graphs here name for a machine, or its name.
fn host_of(machine: &str) -> anyhow::Result<String> {
    let mut hosts = BTreeSet::new();
    for graph in running_graphs() {
        if let Ok(status) = status(&graph) {
            hosts.extend(status.ssh_hosts.get(machine).cloned());
        }
    }
    if hosts.len() > 1 {
        let hosts = Vec::from_iter(hosts).join(", ");
        bail!("the graphs here name several destinations for machine '{machine}' ({hosts}): give --ssh");
    }
    Ok(hosts.pop_first().unwrap_or_else(|| machine.to_owned()))
}

fn is_on_path(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| Path::new(&folder).join(program).is_file())
}

/// The command for the shell on the other machine.
fn words_for_shell(words: impl Iterator<Item = OsString>) -> OsString {
    let mut line = OsString::from(concat!("env BLINDGRASP_OVER_SSH=", env!("CARGO_PKG_VERSION"), " blindgrasp"));
    for word in words {
        line.push(" ");
        line.push(quoted(&word));
    }
    line
}

/// A word that sh, bash, zsh and fish take as it is. fish takes a backslash in single quotes for an escape.
fn quoted(word: &OsStr) -> OsString {
    if !word.is_empty() && word.as_bytes().iter().all(|byte| byte.is_ascii_alphanumeric() || b"_-./".contains(byte)) {
        return word.to_owned();
    }
    let mut bytes = vec![b'\''];
    for byte in word.as_bytes() {
        match byte {
            b'\'' => bytes.extend(br#"'"'"'"#),
            b'\\' => bytes.extend(br#"'"\\"'"#),
            byte => bytes.push(*byte),
        }
    }
    bytes.push(b'\'');
    OsStr::from_bytes(&bytes).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shell_takes_each_word_as_it_is() {
        let words = [
            "", "plain", "a b", "'", "\\", "\\\\'\\", "\"", "$HOME", "`id`", "$(id)", "a;b", "a\nb", "*", "~", "-n",
            "#x", "=ls", "!x", "é→", "a=b", "&&", ">x", "{a,b}", "%s", "\\n", "\t",
        ];
        let line = words_for_shell(words.iter().map(OsString::from));
        let line = line.to_str().expect("UTF-8");
        let beginning = concat!("env BLINDGRASP_OVER_SSH=", env!("CARGO_PKG_VERSION"), " blindgrasp ");
        let line = line.strip_prefix(beginning).expect("the program");
        let output = Command::new("sh").arg("-c").arg(format!("printf '%s\\0' {line}")).output().expect("started");
        let expected: Vec<u8> = words.iter().flat_map(|word| [word.as_bytes(), b"\0"].concat()).collect();
        assert_eq!(String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&expected));
        let odd = OsStr::from_bytes(b"\xff\xfe");
        assert_eq!(quoted(odd).as_bytes(), b"'\xff\xfe'");
    }

    #[test]
    fn the_end_there_becomes_the_end_here() {
        let brain = Destination { machine: "brain".into(), host: "user@brain".into() };
        let ended = |code: i32, is_stopped| brain.outcome(ExitStatus::from_raw(code << 8), is_stopped);
        assert_eq!(ended(0, false).expect("done"), Outcome::Done);
        assert_eq!(ended(3, true).expect("done"), Outcome::FinishedWithLoss);
        assert_eq!(ended(1, false).expect("told there"), Outcome::OfOtherMachine(1));
        assert_eq!(ended(255, true).expect("told there"), Outcome::OfOtherMachine(INTERRUPTED));
        assert!(ended(255, false).expect_err("no connection").to_string().contains("ssh user@brain"));
        assert!(ended(127, false).expect_err("no program").to_string().contains("cannot start blindgrasp"));
        let killed = brain.outcome(ExitStatus::from_raw(9), false);
        assert!(killed.expect_err("killed").to_string().contains("signal: 9"));
    }
}
