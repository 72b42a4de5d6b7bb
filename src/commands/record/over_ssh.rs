//! `record --machine`: the command on the other machine writes its files there, and sends them over ssh at the end.
//!
//! So a network that is slow or breaks off costs no sample: the files stay there until they are here. Before and after
//! the recording, the command there writes a line of JSON to stdout: [`Begun`] and [`Recorded`]. The bytes of the files
//! follow.

use std::ffi::OsStr;
use std::fs::{DirBuilder, File};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{ChildStdout, Stdio};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};

use super::{Arguments, record};
use crate::commands::elsewhere::{Destination, has_caller_kept, quoted};
use crate::commands::{Outcome, print_line};
use blindgrasp_messages::files::{keep_mode, private_file};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;
use blindgrasp_recording::is_part_name;

/// The folder of the recordings on the other machine. It is on the disk and survives a restart, unlike /tmp.
const FOLDER: &str = "/var/tmp";
/// Longer lines are not from `record`.
const MAX_LINE_BYTES: u64 = 16 << 20;

#[derive(Serialize, Deserialize)]
struct Begun {
    /// Where the files are until they are copied.
    folder: PathBuf,
}

#[derive(Serialize, Deserialize)]
struct Recorded {
    /// What the command says.
    lines: Vec<String>,
    files: Vec<SentFile>,
}

#[derive(Serialize, Deserialize)]
struct SentFile {
    name: String,
    n_bytes: u64,
}

/// Records on another machine, to files here.
pub(super) fn record_there(arguments: &Arguments, destination: &Destination) -> anyhow::Result<Outcome> {
    name_of(arguments.out()?)?;
    let mut there = destination.start(Stdio::piped())?;
    let stdout = there.take_stdout()?;
    let acknowledge = there.acknowledgement();
    let (ended, received) = std::thread::scope(|scope| {
        let receiver = scope.spawn(move || {
            let received = receive(arguments, destination, stdout);
            acknowledge(received.as_ref().is_ok_and(Option::is_some));
            received
        });
        (there.wait(), receiver.join())
    });
    let (status, is_stopped) = ended?;
    let Ok(received) = received else { bail!("the thread that receives the recording panicked") };
    // Without a recording, the command there has said why.
    for line in received?.iter().flat_map(|recorded| &recorded.lines) {
        print_line(line)?;
    }
    destination.outcome(status, is_stopped)
}

/// Records for [`record_there`], which runs on another machine.
pub(super) fn record_for_caller(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let name = name_of(arguments.out()?)?;
    let folder = Path::new(FOLDER).join(format!("blindgrasp-{}-{}", std::process::id(), monotonic_nanos()));
    let made = DirBuilder::new().mode(0o700).create(&folder);
    made.with_context(|| format!("{}: the folder for the recording cannot be made", folder.display()))?;
    let sent = record_and_send(arguments, &folder, name);
    let is_kept = sent.is_ok() && has_caller_kept();
    if is_kept {
        std::fs::remove_dir_all(&folder).with_context(|| format!("{} cannot be removed", folder.display()))?;
    } else if std::fs::remove_dir(&folder).is_err() {
        // It is not empty.
        print_diagnostic(&format!("blindgrasp: the recording stays in {}", folder.display()));
    }
    sent
}

fn record_and_send(arguments: &Arguments, folder: &Path, name: &str) -> anyhow::Result<Outcome> {
    print_line(&serde_json::to_string(&Begun { folder: folder.to_owned() })?)?;
    let mut summary = record(arguments, &folder.join(name))?;
    let mut files = Vec::new();
    let mut opened = Vec::new();
    for path in &mut summary.recorded.files {
        let file = File::open(&path).with_context(|| path.display().to_string())?;
        let name = name_of(path)?.to_owned();
        *path = arguments.out()?.with_file_name(&name);
        files.push(SentFile { name, n_bytes: file.metadata()?.len() });
        opened.push(file);
    }
    let lines = summary.lines(arguments.json);
    print_line(&serde_json::to_string(&Recorded { lines, files })?)?;
    let mut stdout = std::io::stdout().lock();
    for mut file in opened {
        std::io::copy(&mut file, &mut stdout).context("the recording cannot be sent")?;
    }
    stdout.flush().context("the recording cannot be sent")?;
    Ok(summary.outcome())
}

/// Receives what [`record_for_caller`] sends; `None` if it did not begin, or recorded nothing.
fn receive(arguments: &Arguments, destination: &Destination, stdout: ChildStdout) -> anyhow::Result<Option<Recorded>> {
    let mut stdout = BufReader::new(stdout);
    let Some(Begun { folder }) = next_line(&mut stdout)? else { return Ok(None) };
    let received = next_line(&mut stdout).and_then(|recorded: Option<Recorded>| {
        let Some(recorded) = recorded else { return Ok(None) };
        for sent in &recorded.files {
            receive_file(arguments.out()?, arguments.recording.options().overwrite, sent, &mut stdout)?;
        }
        Ok(Some(recorded))
    });
    received.with_context(|| {
        let Destination { machine, host } = destination;
        format!("the recording stays on machine '{machine}': {}", copy_command(host, &folder))
    })
}

/// The command that copies a folder of the other machine, whose name may be any text, for a shell.
fn copy_command(host: &str, folder: &Path) -> String {
    let from = format!("{host}:{}/*", folder.display().to_string().escape_debug());
    format!("scp {} .", quoted(OsStr::new(&from)).display())
}

/// * `out` - the name of the recording here.
fn receive_file(out: &Path, overwrite: bool, sent: &SentFile, stdout: &mut impl Read) -> anyhow::Result<()> {
    let SentFile { name, n_bytes } = sent;
    if name_of(out)? != name && !is_part_name(out, name) {
        bail!("the other machine sends a file '{}', which does not belong to this recording", name.escape_debug());
    }
    let path = out.with_file_name(name);
    if !overwrite && path.exists() {
        bail!("{}: the file exists", path.display());
    }
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let disk = rustix::fs::statvfs(folder).with_context(|| folder.display().to_string())?;
    let n_free_bytes = disk.f_bavail.saturating_mul(disk.f_frsize);
    if *n_bytes > n_free_bytes {
        bail!(
            "{}: the other machine sends {n_bytes} bytes, and {n_free_bytes} are free: expected room for them, or --out on \
             another disk",
            path.display()
        );
    }
    let part = out.with_file_name(format!("{name}.{}.part", std::process::id()));
    let copied = copy_to(&part, &path, stdout, *n_bytes).and_then(|()| Ok(std::fs::rename(&part, &path)?));
    if copied.is_err() {
        let _ = std::fs::remove_file(&part);
    }
    copied.with_context(|| path.display().to_string())
}

/// * `place` - the file that the part will replace.
fn copy_to(part: &Path, place: &Path, from: &mut impl Read, n_bytes: u64) -> anyhow::Result<()> {
    let mut file = private_file().create_new(true).open(part)?;
    let n_copied = std::io::copy(&mut from.take(n_bytes), &mut file)?;
    if n_copied < n_bytes {
        bail!("the connection ended after {n_copied} of {n_bytes} bytes");
    }
    keep_mode(&file, place)?;
    Ok(file.sync_all()?)
}

/// The next line; `None` at the end.
fn next_line<T: for<'a> Deserialize<'a>>(stdout: &mut impl BufRead) -> anyhow::Result<Option<T>> {
    let mut line = Vec::new();
    stdout.take(MAX_LINE_BYTES).read_until(b'\n', &mut line).context("ssh cannot be read")?;
    if line.is_empty() {
        return Ok(None);
    }
    let text = String::from_utf8_lossy(&line);
    let parsed = serde_json::from_slice(&line);
    let shown: String = text.trim_end().chars().take(200).collect();
    parsed.map(Some).with_context(|| {
        format!(
            "the other machine sends '{}' in place of a recording; its shell must print nothing when it starts",
            shown.escape_debug()
        )
    })
}

fn name_of(path: &Path) -> anyhow::Result<&str> {
    let name = path.file_name().and_then(|name| name.to_str());
    name.with_context(|| format!("{}: expected the name of a file, in UTF-8", path.display()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::process::Command;

    use super::*;

    #[test]
    fn the_other_machine_writes_no_file_but_the_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().join("run.mcap");
        let receive = |name: &str, n_bytes: u64| {
            let sent = SentFile { name: name.into(), n_bytes };
            receive_file(&out, false, &sent, &mut &b"bytes"[..]).map_err(|error| format!("{error:#}"))
        };
        for name in
            ["run.sh", "run.mcap.sh", "run-00001.sh", "run-1.mcap", "runaway.mcap", "../run.mcap", "/run.mcap", ""]
        {
            let error = receive(name, 5).expect_err(name);
            assert!(error.contains("does not belong to this recording"), "{error}");
        }
        let error = receive("run.mcap", u64::MAX).expect_err("no disk has so much room");
        assert!(error.contains("sends 18446744073709551615 bytes"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("read").count(), 0);
        receive("run.mcap", 5).expect("received");
        receive("run-00001.mcap", 5).expect("received");
        let mode = std::fs::metadata(&out).expect("there").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    #[test]
    fn the_command_to_paste_runs_nothing_of_the_other_machine() {
        let folder = tempfile::tempdir().expect("a folder");
        let run = |command: &str| {
            let script = format!("scp() {{ printf '%s' \"$1\"; }}; {command}");
            Command::new("sh").args(["-c", &script]).current_dir(folder.path()).output().expect("started").stdout
        };
        let usual = Path::new("/var/tmp/blindgrasp-1-2");
        assert_eq!(run(&copy_command("me@brain", usual)), b"me@brain:/var/tmp/blindgrasp-1-2/*");
        let evil = Path::new("/x'; touch pwned; '\n$(touch pwned)\u{1b}");
        run(&format!("scp 'me@brain:{}/*' .", evil.display()));
        assert!(folder.path().join("pwned").exists(), "the text itself runs");
        std::fs::remove_file(folder.path().join("pwned")).expect("removed");
        let command = copy_command("me@brain", evil);
        run(&command);
        assert!(!folder.path().join("pwned").exists() && !command.contains(char::is_control), "{command}");
    }
}
