//! Asks the programs of operators what they are (`--describe`).

use std::io::{ErrorKind, Read};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use blindgrasp_operator::description::OperatorDescription;

/// The longest time that a program may take to describe itself.
const LIMIT: Duration = Duration::from_secs(10);
/// The pause between two looks at whether the program has ended.
const POLL: Duration = Duration::from_millis(1);
/// So much of the end of a failed program's stderr is shown.
const MAX_STDERR_TAIL: usize = 2048;
/// The longest description.
const MAX_BYTES: u64 = 1 << 20;

/// The program that a shell would run for a name without '/'.
pub(super) fn program_on_path(name: &str) -> Option<PathBuf> {
    let is_program =
        |path: &PathBuf| path.metadata().is_ok_and(|found| found.is_file() && found.permissions().mode() & 0o111 != 0);
    // An empty entry means the current folder, which must not decide what runs.
    let folders = std::env::var_os("PATH")?;
    let mut folders = std::env::split_paths(&folders).filter(|folder| folder.is_absolute());
    (!name.contains('/')).then(|| folders.find_map(|folder| Some(folder.join(name)).filter(is_program)))?
}

/// Starts a program with these arguments and `--describe`, and reads its ports and parameters.
///
/// # Errors
/// The program cannot be started, does not answer in time, fails, or answers something else; the text is for a person.
pub fn describe(program: &Path, args: &[String]) -> Result<OperatorDescription, String> {
    let mut child = Command::new(program)
        .args(args)
        .arg("--describe")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .process_group(0)
        .spawn()
        .map_err(|error| match error.kind() {
            ErrorKind::NotFound => "there is no such file".into(),
            _ => format!("it cannot be started: {error}"),
        })?;
    let (sender, answer) = channel();
    if let Some(stdout) = child.stdout.take() {
        // Without a thread no answer comes.
        let _ = std::thread::Builder::new().spawn(move || {
            let mut text = String::new();
            let read = stdout.take(MAX_BYTES).read_to_string(&mut text);
            let _ = sender.send(read.map(|_| text));
        });
    }
    let (sender, stderr_tail) = channel();
    if let Some(mut stderr) = child.stderr.take() {
        let _ = std::thread::Builder::new().spawn(move || {
            let mut said = Vec::new();
            let mut bytes = [0; 4096];
            while let Ok(n @ 1..) = stderr.read(&mut bytes) {
                said.extend_from_slice(&bytes[..n]);
                said.drain(..said.len().saturating_sub(MAX_STDERR_TAIL));
            }
            let _ = sender.send(said);
        });
    }
    let start = Instant::now();
    let answer = answer.recv_timeout(LIMIT);
    // The answer may be complete although the program goes on running.
    while start.elapsed() < LIMIT && matches!(child.try_wait(), Ok(None)) {
        std::thread::sleep(POLL);
    }
    let is_late = matches!(child.try_wait(), Ok(None));
    // Processes that the program has started end as well.
    if let Some(group) = rustix::process::Pid::from_raw(child.id() as i32) {
        let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
    }
    let status = child.wait().map_err(|error| error.to_string())?;
    if is_late {
        return Err(format!("it did not answer --describe and exit within {} s", LIMIT.as_secs()));
    }
    let text = answer
        .map_err(|_| "it did not answer --describe".to_string())?
        .map_err(|error| format!("its answer to --describe cannot be read: {error}"))?;
    if !status.success() {
        let said = stderr_tail.recv_timeout(LIMIT).unwrap_or_default();
        let said: Vec<String> = String::from_utf8_lossy(&said).lines().map(crate::log::printable).collect();
        let said = crate::log::log_tail(&said);
        return Err(format!("it failed at --describe ({status}){said}"));
    }
    OperatorDescription::from_json(&text).map_err(|error| format!("--describe: {error}"))
}
