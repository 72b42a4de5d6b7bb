//! Asking programs what they are: `PROGRAM --describe`.

use std::collections::BTreeMap;
use std::io::Read;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use blindgrasp_operator::description::OperatorDescription;

/// The operators that come with the program: a bare name in a dataflow file means one of these.
pub const SHIPPED: [&str; 8] = [
    "recorded_source",
    "tactile_source",
    "simulated_hand",
    "contacts",
    "histogram",
    "classifier",
    "lift_arbiter",
    "regrasp",
];
/// How long a program may take to describe itself.
const LIMIT: Duration = Duration::from_secs(10);
/// How often the program is looked at.
const POLL: Duration = Duration::from_millis(1);
/// The longest description.
const MAX_BYTES: u64 = 1 << 20;

/// The programs of the shipped operators: they lie beside the running one.
///
/// # Errors
/// The running program's own path is unknown.
pub fn shipped() -> std::io::Result<BTreeMap<String, PathBuf>> {
    let here = std::env::current_exe()?;
    let folder = here.parent().unwrap_or(Path::new("/"));
    Ok(SHIPPED.iter().map(|name| (name.to_string(), folder.join(name))).collect())
}

/// The program of the link to other machines, which lies beside the running one.
///
/// # Errors
/// The running program's own path is unknown.
pub fn link_program() -> std::io::Result<PathBuf> {
    Ok(std::env::current_exe()?.with_file_name("zenoh_link"))
}

/// Asks a program, started with these arguments and `--describe`, for its ports and parameters.
///
/// # Errors
/// It cannot be started, does not answer in time, fails, or answers something else; for a person to read.
pub fn describe(program: &Path, args: &[String]) -> Result<OperatorDescription, String> {
    let mut child = Command::new(program)
        .args(args)
        .arg("--describe")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .process_group(0)
        .spawn()
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::NotFound => "it is not there; build all operators with: cargo build --release".into(),
            _ => format!("it cannot be started: {error}"),
        })?;
    let (sender, answer) = channel();
    if let Some(stdout) = child.stdout.take() {
        std::thread::spawn(move || {
            let mut text = String::new();
            let read = stdout.take(MAX_BYTES).read_to_string(&mut text);
            let _ = sender.send(read.map(|_| text));
        });
    }
    let start = Instant::now();
    let answer = answer.recv_timeout(LIMIT);
    // Its answer may be complete although it goes on running.
    while start.elapsed() < LIMIT && matches!(child.try_wait(), Ok(None)) {
        std::thread::sleep(POLL);
    }
    let is_late = matches!(child.try_wait(), Ok(None));
    // Whatever it started goes as well.
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
        return Err(format!("it failed at --describe ({status})"));
    }
    OperatorDescription::from_json(&text).map_err(|error| format!("--describe: {error}"))
}
