//! The sockets at which running graphs take commands: one file for each graph, in a folder of this user alone.
//!
//! The folder is `/run/bgrasp` if that belongs to this user, as it does in a service of systemd, otherwise
//! `/tmp/blindgrasp-UID`. If another user has taken that name, it is `/dev/shm/blindgrasp-UID.LETTERS`, whose letters are drawn
//! when it is made. A command looks for graphs in all of them. Environment variables such as `TMPDIR` are not asked: a command
//! and a graph may have different ones.
//!
//! Files, unlike abstract sockets, are not shared with a container that has its own files and the network of its host.

use std::fs::{DirBuilder, File};
use std::io::{Error, ErrorKind, Result};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::namespace::{SHARED_MEMORY_FOLDER, random_letters};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};

/// The end of the name of a graph's socket, and of that of its tactile source.
const SUFFIX: &str = ".sock";
const TACTILE_SUFFIX: &str = ".hand";
/// The [`refusal`] of a socket that a process holds, and of one whose process has died.
const HELD: Errno = Errno::PROTOTYPE;
const DEAD: Errno = Errno::CONNREFUSED;
/// The lock of a folder, which is held for less than a millisecond, is tried so often.
const N_LOCK_TRIES: u32 = 300;
const LOCK_PAUSE: Duration = Duration::from_millis(10);
/// The folder of the graphs of a service (`RuntimeDirectory=` in its unit).
const SERVICE_FOLDER: &str = "/run/bgrasp";

/// A socket that listens under a graph's name. Dropping it frees the name.
#[derive(Debug)]
pub struct ControlSocket {
    listener: UnixListener,
    path: PathBuf,
    inode: u64,
}

impl ControlSocket {
    /// Takes the name, which a process that was killed may have left.
    ///
    /// # Errors
    /// [`ErrorKind::AddrInUse`] if a process listens under this name; the folder cannot be made, or is another user's.
    pub fn bind(graph: &str) -> Result<ControlSocket> {
        let folder = folder()?;
        let _lock = lock(&folder)?;
        let path = path_in(&folder, graph);
        match connect(graph) {
            // The queue of one that does not accept is full.
            Ok(_) | Err(Errno::AGAIN) => return Err(ErrorKind::AddrInUse.into()),
            Err(Errno::CONNREFUSED) => remove_if_there(&path)?,
            Err(_) => {}
        }
        let listener = UnixListener::bind(&path)?;
        let inode = std::fs::metadata(&path)?.ino();
        Ok(ControlSocket { listener, path, inode })
    }

    pub fn listener(&self) -> &UnixListener {
        &self.listener
    }
}

impl Drop for ControlSocket {
    fn drop(&mut self) {
        // A socket that was shut down may have been taken for a dead one, and replaced.
        if let Some(folder) = self.path.parent()
            && let Ok(_lock) = lock(folder)
            && std::fs::metadata(&self.path).is_ok_and(|found| found.ino() == self.inode)
        {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Connects to the process that listens under a name. The connection does not block: a stopped process accepts no client,
/// and connecting to it would block for ever when its queue is full.
///
/// # Errors
/// [`Errno::NOENT`] or [`Errno::CONNREFUSED`] if no process listens, [`Errno::AGAIN`] if too many wait for it.
pub fn connect(graph: &str) -> rustix::io::Result<OwnedFd> {
    let mut outcome = Err(Errno::NOENT);
    for folder in own_folders() {
        match connect_to(&path_in(&folder, graph), SocketType::STREAM) {
            Err(Errno::NOENT) => {}
            // A folder may still have the socket of a dead process, and another one that of a living.
            Err(Errno::CONNREFUSED) => outcome = Err(Errno::CONNREFUSED),
            connected => return connected,
        }
    }
    outcome
}

fn connect_to(path: &Path, kind: SocketType) -> rustix::io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = rustix::net::socket_with(AddressFamily::UNIX, kind, flags, None)?;
    rustix::net::connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(socket)
}

/// The names under which processes listen, sorted.
pub fn names() -> Vec<String> {
    let mut names: Vec<String> =
        sockets(SUFFIX).filter(|(_, path)| refusal(path) == Some(HELD)).map(|(name, _)| name).collect();
    names.sort();
    names.dedup();
    names
}

/// The sockets with such a name, also those of dead processes: names of graphs, and files.
fn sockets(suffix: &'static str) -> impl Iterator<Item = (String, PathBuf)> {
    let entries = own_folders().into_iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten();
    entries.filter_map(move |entry| {
        let entry = entry.ok()?;
        let name = entry.file_name().to_str()?.strip_suffix(suffix)?.to_string();
        Some((name, entry.path()))
    })
}

/// The error with which a socket refuses one of another type: it tells whether a process holds it, and nobody has to accept a
/// client. The kernel's list of sockets has only those of one network namespace.
fn refusal(path: &Path) -> Option<Errno> {
    connect_to(path, SocketType::DGRAM).err()
}

/// The names of processes that were killed, with the files that they have left.
pub fn dead() -> Vec<(String, PathBuf)> {
    let all = sockets(SUFFIX).chain(sockets(TACTILE_SUFFIX));
    let mut dead: Vec<(String, PathBuf)> = all.filter(|(_, path)| refusal(path) == Some(DEAD)).collect();
    dead.sort();
    dead
}

/// Removes the files of processes that were killed.
pub fn remove_dead() {
    for (_, path) in dead() {
        // A process may have taken the name meanwhile.
        if let Some(folder) = path.parent()
            && let Ok(_lock) = lock(folder)
            && refusal(&path) == Some(DEAD)
        {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The socket at which the tactile source of a graph listens by default: other users cannot send frames.
///
/// # Errors
/// The folder cannot be made, or is open to other users.
pub fn tactile_path(graph: &str) -> Result<PathBuf> {
    Ok(folder()?.join(format!("{graph}{TACTILE_SUFFIX}")))
}

/// The file of a socket by which machines of a graph are linked that are one computer.
///
/// # Errors
/// The folder cannot be made, or is open to other users.
pub fn link_path(name: &str) -> Result<PathBuf> {
    Ok(folder()?.join(format!("{name}.link")))
}

fn path_in(folder: &Path, graph: &str) -> PathBuf {
    folder.join(format!("{graph}{SUFFIX}"))
}

fn remove_if_there(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        outcome => outcome,
    }
}

/// No other process binds or frees a name in a folder until the file is dropped. A process that keeps the lock, stopped or
/// harmful, is not waited for without end.
fn lock(folder: &Path) -> Result<File> {
    let file = File::open(folder)?;
    for _ in 0..N_LOCK_TRIES {
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) => std::thread::sleep(LOCK_PAUSE),
            outcome => return outcome.map(|()| file).map_err(Error::from),
        }
    }
    let message = format!("{} is locked by another process: find it with 'lslocks', and end it", folder.display());
    Err(Error::new(ErrorKind::TimedOut, message))
}

/// The folder of this user's sockets. It is made if it is missing.
///
/// # Errors
/// The folder cannot be made, or is another user's.
pub fn folder() -> Result<PathBuf> {
    choose(&candidates(), own_uid())
}

/// The folders that may have sockets of this user.
fn own_folders() -> Vec<PathBuf> {
    let uid = own_uid();
    candidates().into_iter().map(|candidate| candidate.path).filter(|path| check(path, uid).is_ok()).collect()
}

fn own_uid() -> u32 {
    rustix::process::getuid().as_raw()
}

/// A folder that may have sockets of this user.
struct Candidate {
    path: PathBuf,
    /// It may be made if it is missing.
    is_made: bool,
}

/// The folders that may have sockets of this user, the first choice first.
fn candidates() -> Vec<Candidate> {
    let name = format!("blindgrasp-{}", own_uid());
    let mut candidates = vec![
        Candidate { path: SERVICE_FOLDER.into(), is_made: false },
        Candidate { path: Path::new("/tmp").join(&name), is_made: true },
    ];
    candidates.extend(drawn(Path::new(SHARED_MEMORY_FOLDER), &name));
    candidates
}

/// The folders with drawn letters that are there, and one that could be made.
fn drawn(parent: &Path, name: &str) -> Vec<Candidate> {
    let beginning = format!("{name}.");
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(parent).into_iter().flatten().flatten() {
        if entry.file_name().to_string_lossy().starts_with(&beginning) && check(&entry.path(), own_uid()).is_ok() {
            paths.push(entry.path());
        }
    }
    paths.sort();
    paths.push(parent.join(beginning + &random_letters()));
    paths.into_iter().map(|path| Candidate { path, is_made: true }).collect()
}

/// The first candidate that is a user's, made if it is missing. The error is that of the first one that could not be made.
fn choose(candidates: &[Candidate], uid: u32) -> Result<PathBuf> {
    let mut first_error = None;
    for Candidate { path, is_made } in candidates {
        let made = if *is_made { make(path) } else { Ok(()) };
        match made.and_then(|()| check(path, uid)) {
            Ok(()) => return Ok(path.clone()),
            Err(error) if *is_made => drop(first_error.get_or_insert(error)),
            Err(_) => {}
        }
    }
    Err(first_error.unwrap_or_else(|| ErrorKind::NotFound.into()))
}

fn make(path: &Path) -> Result<()> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
        outcome => outcome,
    }
}

/// Refuses a folder that other users may write to, or that is one of them.
fn check(path: &Path, uid: u32) -> Result<()> {
    let found = std::fs::symlink_metadata(path)?;
    let cure = if !found.is_dir() || found.uid() != uid {
        "the system's administrator must remove it (sudo rm -r)"
    } else if found.mode() & 0o077 != 0 {
        "chmod 0700, if all that is in it is yours"
    } else {
        return Ok(());
    };
    let message = format!("{} must be a folder of this user with mode 0700: {cure}", path.display());
    Err(Error::new(ErrorKind::PermissionDenied, message))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_processs_until_it_ends_however_it_ends() {
        let name = format!("socket-{}@brain", std::process::id());
        let folder = folder().expect("a folder");
        let path_of = |name: &str| path_in(&folder, name);
        assert_eq!(connect(&name).expect_err("nobody listens"), Errno::NOENT);
        let socket = ControlSocket::bind(&name).expect("free");
        assert_eq!(std::fs::metadata(&folder).expect("made").mode() & 0o777, 0o700);
        assert!(names().contains(&name));
        assert_eq!(ControlSocket::bind(&name).expect_err("taken").kind(), ErrorKind::AddrInUse);
        drop(socket);
        assert!(!path_of(&name).exists());
        // A process that is killed leaves the file.
        drop(UnixListener::bind(path_of(&name)).expect("free"));
        assert!(!names().contains(&name) && path_of(&name).exists());
        let of_source = tactile_path(&name).expect("a folder");
        drop(UnixListener::bind(&of_source).expect("free"));
        let dead = dead();
        assert!(dead.contains(&(name.clone(), path_of(&name))) && dead.contains(&(name.clone(), of_source.clone())));
        remove_dead();
        assert!(!path_of(&name).exists() && !of_source.exists());
        drop(UnixListener::bind(path_of(&name)).expect("free"));
        let left = ControlSocket::bind(&name).expect("nobody listens");
        // A socket that is shut down gives its name away, and leaves it to the next one.
        rustix::net::shutdown(left.listener(), rustix::net::Shutdown::Both).expect("shut");
        let next = ControlSocket::bind(&name).expect("given away");
        drop(left);
        assert!(connect(&name).is_ok());
        drop(next);
        assert!(!path_of(&name).exists());
    }

    #[test]
    fn a_folder_that_another_user_has_taken_first_is_passed_over() {
        let parent = tempfile::tempdir().expect("a folder");
        let at = |name: &str| parent.path().join(name);
        let candidates = [("service", false), ("tmp", true), ("shared", true)]
            .map(|(name, is_made)| Candidate { path: at(name), is_made });
        let uid = own_uid();
        assert_eq!(choose(&candidates, uid).expect("made"), at("tmp"));
        // A link stands for a folder of another user: neither belongs to this one.
        std::fs::remove_dir(at("tmp")).expect("removed");
        std::os::unix::fs::symlink("/tmp", at("tmp")).expect("a link");
        assert_eq!(choose(&candidates, uid).expect("made"), at("shared"));
        assert_eq!(choose(&candidates[..2], uid + 1).expect_err("taken").kind(), ErrorKind::PermissionDenied);
        let error = choose(&candidates[..2], uid).expect_err("taken").to_string();
        assert!(error.contains("tmp must be a folder of this user") && error.contains("administrator"), "{error}");
        std::fs::remove_file(at("tmp")).expect("removed");
        DirBuilder::new().mode(0o755).create(at("tmp")).expect("made");
        assert!(choose(&candidates[..2], uid).expect_err("open").to_string().contains("chmod 0700"));
        DirBuilder::new().mode(0o700).create(at("service")).expect("made");
        assert_eq!(choose(&candidates, uid).expect("a service's"), at("service"));
    }

    #[test]
    fn a_process_that_keeps_the_lock_of_the_folder_is_not_waited_for_without_end() {
        let parent = tempfile::tempdir().expect("a folder");
        let held = lock(parent.path()).expect("free");
        let error = lock(parent.path()).expect_err("held");
        assert!(error.kind() == ErrorKind::TimedOut && error.to_string().contains("lslocks"), "{error}");
        drop(held);
        lock(parent.path()).expect("free again");
    }

    #[test]
    fn a_folder_with_drawn_letters_is_found_again_unless_another_has_made_it() {
        let parent = tempfile::tempdir().expect("a folder");
        std::os::unix::fs::symlink("/tmp", parent.path().join("blindgrasp-7.planted1")).expect("a link");
        let made = choose(&drawn(parent.path(), "blindgrasp-7"), own_uid()).expect("made");
        assert_eq!(choose(&drawn(parent.path(), "blindgrasp-7"), own_uid()).expect("found"), made);
        assert_ne!(choose(&drawn(parent.path(), "blindgrasp-77"), own_uid()).expect("made"), made);
    }

    /// The kernel has a list of sockets for each network namespace: a container with the files of its host has another one.
    #[test]
    fn a_graph_in_another_network_namespace_is_seen() {
        const VARIABLE: &str = "BLINDGRASP_TEST_SEES";
        if let Ok(name) = std::env::var(VARIABLE) {
            return assert!(names().contains(&name));
        }
        let elsewhere = |program: &std::ffi::OsStr| {
            let mut command = std::process::Command::new("unshare");
            command.arg("--net").arg(program);
            command
        };
        if !elsewhere("true".as_ref()).output().is_ok_and(|output| output.status.success()) {
            eprintln!("SKIPPED: this user may make no network namespace");
            return;
        }
        let name = format!("seen-{}", std::process::id());
        let _socket = ControlSocket::bind(&name).expect("free");
        let mut looking = elsewhere(std::env::current_exe().expect("this program").as_os_str());
        looking.args(["--exact", "control_socket::tests::a_graph_in_another_network_namespace_is_seen"]);
        let looked = looking.env(VARIABLE, name).output().expect("started");
        let said = String::from_utf8_lossy(&looked.stdout);
        assert!(looked.status.success() && said.contains("1 passed"), "{said}");
    }
}
