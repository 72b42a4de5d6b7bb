//! The sockets at which running graphs take commands: one file for each graph, in a folder of this user alone.
//!
//! The folder is `/tmp/blindgrasp-UID`, whatever `TMPDIR` says, so that a command finds each graph of its user. Files, unlike
//! abstract sockets, are not shared with a container that has its own files and the network of its host.

use std::fs::{DirBuilder, File};
use std::io::{Error, ErrorKind, Result};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};

/// The end of a socket's name.
const SUFFIX: &str = ".sock";

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
        let _lock = lock_folder()?;
        let path = path_of(graph);
        match connect(graph) {
            // The queue of one that does not accept is full.
            Ok(_) | Err(Errno::AGAIN) => return Err(ErrorKind::AddrInUse.into()),
            Err(Errno::CONNREFUSED) => std::fs::remove_file(&path)?,
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
        let is_own = |path: &PathBuf| std::fs::metadata(path).is_ok_and(|found| found.ino() == self.inode);
        if let Ok(_lock) = lock_folder()
            && is_own(&self.path)
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
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    rustix::net::connect(&socket, &SocketAddrUnix::new(path_of(graph))?)?;
    Ok(socket)
}

/// The names under which processes listen, sorted.
///
/// # Errors
/// The kernel's list of sockets cannot be read.
pub fn names() -> Result<Vec<String>> {
    // A file outlives a process that is killed; the kernel's list doesn't. Connecting would disturb those that listen.
    let sockets = String::from_utf8_lossy(&std::fs::read("/proc/net/unix")?).into_owned();
    let mut names = listening(&sockets, &folder());
    names.retain(|name| path_of(name).exists());
    Ok(names)
}

/// Removes the files of processes that were killed.
pub fn remove_dead() {
    let (Ok(_lock), Ok(living), Ok(entries)) = (lock_folder(), names(), std::fs::read_dir(folder())) else {
        return;
    };
    for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
        let name = path.file_name().and_then(|name| name.to_str()).and_then(|name| name.strip_suffix(SUFFIX));
        // A container that shares the folder may have a list of sockets of its own.
        if let Some(name) = name.filter(|name| !living.iter().any(|living| living == name))
            && matches!(connect(name), Err(Errno::CONNREFUSED))
        {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The names of sockets in a folder. The columns are number, references, protocol, flags, type, state, inode, path.
fn listening(sockets: &str, folder: &Path) -> Vec<String> {
    /// `__SO_ACCEPTCON`: it listens. Sockets of accepted connections have the same name.
    const LISTENS: u32 = 1 << 16;
    let name_of = |line: &str| {
        let columns: Vec<&str> = line.split_whitespace().collect();
        let is_listening = u32::from_str_radix(columns.get(3)?, 16).is_ok_and(|flags| flags & LISTENS != 0);
        let name = Path::new(columns.get(7)?).strip_prefix(folder).ok()?.to_str()?.strip_suffix(SUFFIX)?;
        is_listening.then(|| name.to_string())
    };
    let mut names: Vec<String> = sockets.lines().filter_map(name_of).collect();
    names.sort();
    names.dedup();
    names
}

/// The file of a graph's socket.
pub fn path_of(graph: &str) -> PathBuf {
    folder().join(format!("{graph}{SUFFIX}"))
}

/// The socket at which a live tactile source listens by default: other users cannot send frames.
///
/// # Errors
/// The folder cannot be made, or is open to other users.
pub fn tactile_path() -> Result<PathBuf> {
    Ok(checked_folder()?.join("tactile.hand"))
}

/// The file of a socket by which machines of a graph are linked that are one computer.
///
/// # Errors
/// The folder cannot be made, or is open to other users.
pub fn link_path(name: &str) -> Result<PathBuf> {
    Ok(checked_folder()?.join(format!("{name}.link")))
}

fn folder() -> PathBuf {
    PathBuf::from(format!("/tmp/blindgrasp-{}", rustix::process::getuid().as_raw()))
}

/// No other process binds or frees a name until the file is dropped.
fn lock_folder() -> Result<File> {
    let file = File::open(checked_folder()?)?;
    flock(&file, FlockOperation::LockExclusive)?;
    Ok(file)
}

/// Makes the folder if it is missing.
fn checked_folder() -> Result<PathBuf> {
    let path = folder();
    match DirBuilder::new().mode(0o700).create(&path) {
        Err(error) if error.kind() != ErrorKind::AlreadyExists => return Err(error),
        _ => {}
    }
    let found = std::fs::symlink_metadata(&path)?;
    if !found.is_dir() || found.uid() != rustix::process::getuid().as_raw() || found.mode() & 0o077 != 0 {
        let message =
            format!("{} must be a folder of this user with mode 0700: remove it, or change it", path.display());
        return Err(Error::new(ErrorKind::PermissionDenied, message));
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_processs_until_it_ends_however_it_ends() {
        let name = format!("socket-{}@brain", std::process::id());
        assert_eq!(connect(&name).expect_err("nobody listens"), Errno::NOENT);
        let socket = ControlSocket::bind(&name).expect("free");
        assert_eq!(std::fs::metadata(folder()).expect("made").mode() & 0o777, 0o700);
        assert!(names().expect("read").contains(&name));
        assert_eq!(ControlSocket::bind(&name).expect_err("taken").kind(), ErrorKind::AddrInUse);
        drop(socket);
        assert!(!path_of(&name).exists());
        // A process that is killed leaves the file.
        drop(UnixListener::bind(path_of(&name)).expect("free"));
        assert!(!names().expect("read").contains(&name) && path_of(&name).exists());
        remove_dead();
        assert!(!path_of(&name).exists());
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
    fn sockets_that_listen_in_the_folder_are_listed() {
        let sockets = "Num       RefCount Protocol Flags    Type St Inode Path
000000009338ee63: 00000003 00000000 00000000 0001 03  1574
000000009338ee64: 00000002 00000000 00010000 0001 01  1575 /tmp/blindgrasp-1000/gate.sock
000000009338ee65: 00000003 00000000 00000000 0001 03  1576 /tmp/blindgrasp-1000/gate.sock
000000009338ee66: 00000003 00000000 00000000 0001 03  1577 /tmp/blindgrasp-1000/accepted.sock
000000009338ee67: 00000002 00000000 00010000 0001 01  1578 /tmp/blindgrasp-100/other-user.sock
000000009338ee68: 00000002 00000000 00010000 0001 01  1579 @/tmp/blindgrasp-1000/abstract.sock
000000009338ee6a: 00000002 00000000 00010000 0001 01  1581 /tmp/blindgrasp-1000/arm-2.sock
";
        assert_eq!(listening(sockets, Path::new("/tmp/blindgrasp-1000")), ["arm-2", "gate"]);
    }
}
