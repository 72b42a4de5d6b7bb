//! The programs of operators: which ones come with blindgrasp, and what a program says about itself at `--describe`.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use crate::dataflow::Program;
use blindgrasp_operator::description::OperatorDescription;

/// The operators that come with blindgrasp, by the name that `run:` gives. The package `blindgrasp-operators` has the
/// same table with their functions.
pub const SHIPPED: [&str; 14] = [
    "recorded_source",
    "tactile_source",
    "simulated_hand",
    "senses",
    "contacts",
    "checked_contacts",
    "encoder",
    "classifier",
    "probe_classifier",
    "day_classifier",
    "lift_arbiter",
    "regrasp",
    "ros2",
    "zenoh",
];
/// Those that can share a process: they answer samples, and have no source or device of their own.
pub const GROUPABLE: [&str; 9] = [
    "senses",
    "contacts",
    "checked_contacts",
    "encoder",
    "classifier",
    "probe_classifier",
    "day_classifier",
    "lift_arbiter",
    "regrasp",
];
/// The operator that carries edges to other machines. The launcher adds it; a dataflow file cannot name it.
pub const LINK_OPERATOR: &str = "link";
/// The longest time that a program may take to describe itself.
const LIMIT: Duration = Duration::from_secs(10);
/// The pause between two looks at whether the program has ended.
const POLL: Duration = Duration::from_millis(1);
/// So much of the end of a failed program's stderr is shown.
const MAX_LAST_WORDS: usize = 2048;
/// The longest description.
const MAX_BYTES: u64 = 1 << 20;

/// How the shipped operators are started: each one is `blindgrasp operator NAME`, by the program that is running.
///
/// # Errors
/// The path of the running program is unknown.
pub fn shipped() -> std::io::Result<BTreeMap<String, Program>> {
    let path = own_path()?;
    Ok(SHIPPED.iter().map(|name| (name.to_string(), shipped_operator(&path, name))).collect())
}

/// How the link to other machines is started.
///
/// # Errors
/// The path of the running program is unknown.
pub fn link_program() -> std::io::Result<Program> {
    Ok(shipped_operator(&own_path()?, LINK_OPERATOR))
}

/// What `--run RUN --args ARGS` of a swap starts: a shipped operator, a program by its path, relative to `folder`, or one on
/// PATH.
///
/// # Errors
/// The path of a file that is not there.
pub fn program_to_run(run: &Path, args: &[String], folder: &Path) -> Result<Program, PathBuf> {
    let shipped = run.to_str().and_then(|name| shipped().ok()?.remove(present_name(name)));
    let file = folder.join(run);
    let on_path = || run.to_str().filter(|_| !file.exists()).and_then(program_on_path).map(Program::from);
    let program = shipped.or_else(on_path).unwrap_or_else(|| file.into());
    if !program.path.is_file() {
        return Err(program.path);
    }
    Ok(Program { args: program.args_with(args), ..program })
}

/// The program that a shell would run for a name without '/'.
pub(super) fn program_on_path(name: &str) -> Option<PathBuf> {
    let is_program =
        |path: &PathBuf| path.metadata().is_ok_and(|found| found.is_file() && found.permissions().mode() & 0o111 != 0);
    // An empty entry means the current folder, which must not decide what runs.
    let folders = std::env::var_os("PATH")?;
    let mut folders = std::env::split_paths(&folders).filter(|folder| folder.is_absolute());
    (!name.contains('/')).then(|| folders.find_map(|folder| Some(folder.join(name)).filter(is_program)))?
}

/// Whether [`program_to_run`] takes this for a shipped operator.
pub(super) fn is_shipped(run: &Path) -> bool {
    run.to_str().is_some_and(|name| SHIPPED.contains(&present_name(name)))
}

/// The encoder had another name before, as in dataflow files.
fn present_name(name: &str) -> &str {
    if name == "histogram" { "encoder" } else { name }
}

fn shipped_operator(path: &Path, name: &str) -> Program {
    Program { path: path.into(), args: vec!["operator".into(), name.into()] }
}

/// The path of the running program, also after a new build has taken its place.
pub(super) fn own_path() -> std::io::Result<PathBuf> {
    let path = std::env::current_exe()?;
    // Linux says so of a file that was replaced while it runs.
    let replaced = path.to_str().and_then(|path| path.strip_suffix(" (deleted)")).map(PathBuf::from);
    Ok(replaced.unwrap_or(path))
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
        std::thread::spawn(move || {
            let mut text = String::new();
            let read = stdout.take(MAX_BYTES).read_to_string(&mut text);
            let _ = sender.send(read.map(|_| text));
        });
    }
    let (sender, last_words) = channel();
    if let Some(mut stderr) = child.stderr.take() {
        std::thread::spawn(move || {
            let mut said = Vec::new();
            let mut bytes = [0; 4096];
            while let Ok(n @ 1..) = stderr.read(&mut bytes) {
                said.extend_from_slice(&bytes[..n]);
                said.drain(..said.len().saturating_sub(MAX_LAST_WORDS));
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
        let said = last_words.recv_timeout(LIMIT).unwrap_or_default();
        let said: Vec<String> = String::from_utf8_lossy(&said).lines().map(crate::log::printable).collect();
        let said = crate::launcher::log_tail(&said);
        return Err(format!("it failed at --describe ({status}){said}"));
    }
    OperatorDescription::from_json(&text).map_err(|error| format!("--describe: {error}"))
}
