//! `blindgrasp run --detach`: the same command again, without a terminal.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;

use super::{Outcome, print_text};
use blindgrasp_graph::client;
use blindgrasp_graph::control::GraphState;
use blindgrasp_graph::log::{LogFile, LogFolder, LogFormat, LogReader};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::LogEntry;

/// How often a detaching command looks whether its graph runs.
const POLL: Duration = Duration::from_millis(10);

/// Starts the same command in the background, and waits until its graph runs.
pub(super) fn detach(name: &str, json: bool) -> anyhow::Result<Outcome> {
    // Its log is that of the running graph, and would not say why this one did not start.
    if client::status(name).is_ok() {
        bail!(
            "a graph called '{name}' is running: stop it (blindgrasp stop {name}), or give this one another name with --name"
        );
    }
    let folder = LogFolder::of_graph(name);
    let mut log = LogReader::new(&folder, "run");
    // What is there is of earlier runs.
    let _ = log.read();
    let mut command = Command::new(std::env::current_exe().context("this program's own path is unknown")?);
    // It counts more than --detach.
    command.args(std::env::args_os().skip(1)).arg("--in-background");
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    // SAFETY: between fork and exec the closure makes one system call.
    unsafe { command.pre_exec(|| Ok(rustix::process::setsid().map(drop)?)) };
    let mut child = command.spawn().context("cannot start the graph in the background")?;
    loop {
        if let Some(status) = child.try_wait().context("cannot wait for the graph")? {
            // A short recording may be over before the graph was seen to run.
            if status.success() {
                return said_over(name, &folder, json);
            }
            let lines: Vec<String> = log.read().unwrap_or_default().into_iter().map(|line| line.text).collect();
            bail!("the graph did not start ({status}):\n{}", lines.join("\n"));
        }
        // Another graph of that name may answer while ours is about to be refused, and one whose source failed is stopping.
        if let Ok(status) = client::status(name)
            && status.pid == child.id()
            && matches!(status.state, GraphState::Running | GraphState::Degraded)
        {
            break;
        }
        std::thread::sleep(POLL);
    }
    let (pid, logs) = (child.id(), folder.path().display());
    print_text(&if json {
        json!({ "graph": name, "pid": pid, "log_folder": folder.path().display().to_string() }).to_string()
    } else {
        format!(
            "graph '{name}' runs in the background (process {pid}); its logs are in {logs}\n\
             blindgrasp ps {name}    blindgrasp logs -f --graph {name}    blindgrasp stop {name}"
        )
    })?;
    Ok(Outcome::Done)
}

fn said_over(name: &str, folder: &LogFolder, json: bool) -> anyhow::Result<Outcome> {
    let logs = folder.path().display().to_string();
    print_text(&if json {
        json!({ "graph": name, "pid": null, "log_folder": logs }).to_string()
    } else {
        format!("graph '{name}' has run and is over; its logs are in {logs}")
    })?;
    Ok(Outcome::Done)
}

/// Does something whose output goes, line by line, to the log of the graph's run.
pub(super) fn into_log(
    name: &str,
    format: LogFormat,
    work: impl FnOnce() -> anyhow::Result<Outcome>,
) -> anyhow::Result<Outcome> {
    let (reader, writer) = std::io::pipe().context("cannot make a pipe")?;
    rustix::stdio::dup2_stdout(&writer)?;
    rustix::stdio::dup2_stderr(&writer)?;
    drop(writer);
    let mut log = LogFile::open(&LogFolder::of_graph(name), "run", format);
    let forward = std::thread::spawn(move || {
        for line in BufReader::new(reader).split(b'\n').map_while(Result::ok) {
            log.write(&LogEntry::plain(String::from_utf8_lossy(&line)));
        }
    });
    let outcome = work();
    if let Err(error) = &outcome {
        print_diagnostic(&format!("blindgrasp: {error:#}"));
    }
    let nowhere = File::options().write(true).open("/dev/null")?;
    rustix::stdio::dup2_stdout(&nowhere)?;
    rustix::stdio::dup2_stderr(&nowhere)?;
    // With the last writer closed the reader comes to its end.
    let _ = forward.join();
    outcome
}
