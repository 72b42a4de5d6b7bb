//! `record --machine`: the command on the other machine writes its files there, and sends them over ssh at the end.
//!
//! So a network that is slow or breaks off costs no sample: the files stay there until they are here. Before and after
//! the recording, the command there writes a line of JSON to stdout: [`Begun`] and [`Recorded`]. The bytes of the files
//! follow.

use std::fs::{DirBuilder, File};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{ChildStdout, Stdio};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};

use super::{Arguments, record};
use crate::commands::elsewhere::{Destination, has_caller_kept};
use crate::commands::{Outcome, print_line};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::monotonic_nanos;

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
    let sent = print_line(&serde_json::to_string(&Begun { folder: folder.clone() })?)
        .map_err(anyhow::Error::from)
        .and_then(|()| record(arguments, &folder.join(name)))
        .and_then(|summary| send(arguments, summary));
    let is_kept = sent.is_ok() && has_caller_kept();
    if is_kept {
        std::fs::remove_dir_all(&folder).with_context(|| format!("{} cannot be removed", folder.display()))?;
    } else if std::fs::remove_dir(&folder).is_err() {
        // It is not empty.
        print_diagnostic(&format!("blindgrasp: the recording stays in {}", folder.display()));
    }
    sent
}

fn send(arguments: &Arguments, mut summary: super::RecordSummary) -> anyhow::Result<Outcome> {
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
            receive_file(arguments, sent, &mut stdout)?;
        }
        Ok(Some(recorded))
    });
    received.with_context(|| {
        let Destination { machine, host } = destination;
        format!("the recording stays on machine '{machine}': scp '{host}:{}/*' .", folder.display())
    })
}

fn receive_file(arguments: &Arguments, sent: &SentFile, stdout: &mut impl Read) -> anyhow::Result<()> {
    let stem = arguments.out()?.file_stem().unwrap_or_default().to_string_lossy();
    if name_of(Path::new(&sent.name))? != sent.name || !sent.name.starts_with(&*stem) {
        bail!("the other machine sends a file '{}', which does not belong to this recording", sent.name.escape_debug());
    }
    let path = arguments.out()?.with_file_name(&sent.name);
    if !arguments.recording.options().overwrite && path.exists() {
        bail!("{}: the file exists", path.display());
    }
    let part = arguments.out()?.with_file_name(format!("{}.{}.part", sent.name, std::process::id()));
    let copied = copy_to(&part, stdout, sent.n_bytes).and_then(|()| Ok(std::fs::rename(&part, &path)?));
    if copied.is_err() {
        let _ = std::fs::remove_file(&part);
    }
    copied.with_context(|| path.display().to_string())
}

fn copy_to(path: &Path, from: &mut impl Read, n_bytes: u64) -> anyhow::Result<()> {
    let mut file = File::create_new(path)?;
    let n_copied = std::io::copy(&mut from.take(n_bytes), &mut file)?;
    if n_copied < n_bytes {
        bail!("the connection ended after {n_copied} of {n_bytes} bytes");
    }
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
