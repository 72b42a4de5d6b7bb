//! A running graph's own folder in shared memory.
//!
//! All files of a graph lie in one folder that only its user can enter. Another user can neither make a file under a name that
//! a process of the graph opens, nor see its names. The folder is locked while the launcher lives, and goes with the graph, or
//! after it was killed.

use std::fs::{DirBuilder, File, Permissions};
use std::hash::{BuildHasher, RandomState};
use std::io::Error;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::prelude::{CallbackProgression, NodeState};
use iceoryx2::prelude::{Config, FileName, LogLevel, Node, NodeBuilder, NodeName, SemanticString, SignalHandlingMode};

use rustix::fs::{FallocateFlags, FlockOperation, OFlags};
use rustix::io::Errno;

use crate::control_socket::{self, ControlSocket};
use crate::diagnostics::print_diagnostic;
use crate::port::BoxedError;
use crate::private_service::PrivateService;
use crate::text::is_name;
use crate::wiring::NamespaceWiring;

/// The folder of POSIX shared memory on Linux.
pub const SHARED_MEMORY_FOLDER: &str = "/dev/shm";
/// The shared memory that must be free before a graph starts. A graph with few cells takes so much when it has started, the
/// default graph 34 MiB ([`take_room`]); a process that writes to shared memory that is not there dies (SIGBUS).
pub const LEAST_FREE_BYTES: u64 = 16 << 20;

/// A process that dies of full shared memory (SIGBUS) is started again when so much of it is free.
const LEAST_FREE_FOR_RESTART_BYTES: u64 = 4 << 20;

/// The names of the folders of graphs begin with this; the beginning of the graph's name, for people, and random letters follow.
const FOLDER_PREFIX: &str = "blindgrasp_";
/// The unit in which the kernel counts the blocks of a file.
const BLOCK_BYTES: u64 = 512;
/// The names of all files that iceoryx2 makes begin with this.
pub const FILE_PREFIX: &str = "x";
/// The end of the names of the files that hold samples, which iceoryx2 removes without a look into them.
const SAMPLES_SUFFIX: &str = ".data";
/// The names of folders have so much of the graph's name. iceoryx2 has room for about 60 characters before the name of a socket.
const MAX_NAME_BYTES: usize = 11;
/// The random letters in a name: so many that no other user can take all names first (36^8 is about 3 · 10^12).
const LETTERS: &[u8; 36] = b"abcdefghijklmnopqrstuvwxyz0123456789";
const N_LETTERS: usize = 8;
/// So many names are tried, in case that one is taken.
const N_TRIES: u32 = 8;
/// Another thread may free the resources of other dead processes for so long.
const CLEANUP_LIMIT: Duration = Duration::from_secs(10);
/// A folder in which any user may remove and rename the files of others has this bit not set.
const STICKY_BIT: u32 = 0o1000;
/// Rights of users other than the owner.
const OTHERS: u32 = 0o077;

/// Why a graph has no namespace, or a process cannot join it.
#[derive(Debug, thiserror::Error)]
pub enum NamespaceError {
    #[error("graph name '{name}': expected letters, digits, _ and -, at most 32")]
    Name { name: String },
    #[error(
        "a graph called '{name}' is running: stop it (blindgrasp stop {name}), or give this one another name with --name"
    )]
    NameTaken { name: String },
    #[error("cannot reserve the graph's name '{name}'")]
    Lock { name: String, source: Error },
    #[error(
        "only {free_mib:.1} MiB of shared memory are free in {SHARED_MEMORY_FOLDER}, and a graph needs {needed_mib} or more: \
         remove old files there, or make it larger (mount -o remount,size=…; docker run --shm-size=…)"
    )]
    Full { free_mib: f64, needed_mib: u64 },
    #[error(
        "the graph needs {missing_mib:.1} MiB of shared memory more than are free in {SHARED_MEMORY_FOLDER}: remove old files \
         there, stop other graphs, or make it larger (mount -o remount,size=…; docker run --shm-size=…)"
    )]
    NoRoom { missing_mib: f64 },
    #[error("the graph's folder cannot be made in {SHARED_MEMORY_FOLDER}: let this user write there")]
    Folder { source: Error },
    #[error(
        "every user may rename the files of others in {SHARED_MEMORY_FOLDER}: expected a folder with the sticky bit \
         (chmod 1777 {SHARED_MEMORY_FOLDER})"
    )]
    Unprotected,
    #[error("{} must be a folder of this user with mode 0700, as the launcher made it", folder.display())]
    Foreign { folder: PathBuf },
    #[error(
        "{} is gone, expected as long as the graph runs: another program has removed it; stop the graph and start it again",
        folder.display()
    )]
    Removed { folder: PathBuf },
    #[error("cannot join the graph's shared memory at {}", folder.display())]
    Join { folder: PathBuf, source: BoxedError },
}

/// A graph's name, which this process holds until it is dropped, and the folder of its memory.
///
/// Dropping it removes the folder: by then the graph's processes must have ended.
pub struct Namespace {
    name: String,
    wiring: NamespaceWiring,
    socket: ControlSocket,
    /// The kernel frees the lock when the process ends, however it ends.
    _lock: File,
}

impl Namespace {
    /// Reserves `name`, and removes files that ended graphs have left.
    ///
    /// # Errors
    /// A graph of that name is running, the name has forbidden characters, or shared memory is full or cannot be written to.
    pub fn reserve(name: &str) -> Result<Namespace, NamespaceError> {
        if !is_name(name) {
            return Err(NamespaceError::Name { name: name.into() });
        }
        sweep();
        let socket = ControlSocket::bind(name).map_err(|source| match source.kind() {
            std::io::ErrorKind::AddrInUse => NamespaceError::NameTaken { name: name.into() },
            _ => NamespaceError::Lock { name: name.into(), source },
        })?;
        let (wiring, lock) = make_folder(name)?;
        let domain = Namespace { name: name.into(), wiring, socket, _lock: lock };
        check_room()?;
        // The first process to join makes the file in which iceoryx2 counts them, and gives it rights for others, which a
        // sandbox could not.
        drop(join(&domain.wiring, "launcher")?);
        close_to_others(&domain.wiring.ports()).map_err(|source| NamespaceError::Lock { name: name.into(), source })?;
        Ok(domain)
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// The data that other processes need to join.
    pub fn wiring(&self) -> &NamespaceWiring {
        &self.wiring
    }

    /// The socket to which clients of the graph connect.
    pub fn listener(&self) -> &UnixListener {
        self.socket.listener()
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        remove_or_say(&self.wiring.folder);
    }
}

/// A new folder that no other graph has, with its lock.
fn make_folder(name: &str) -> Result<(NamespaceWiring, File), NamespaceError> {
    let shared = std::fs::metadata(SHARED_MEMORY_FOLDER).map_err(|source| NamespaceError::Folder { source })?;
    if shared.mode() & 0o022 != 0 && shared.mode() & STICKY_BIT == 0 {
        return Err(NamespaceError::Unprotected);
    }
    for attempt in 1.. {
        let wiring = NamespaceWiring { folder: Path::new(SHARED_MEMORY_FOLDER).join(folder_name(name)) };
        match make_locked(&wiring) {
            Ok(lock) => return Ok((wiring, lock)),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists && attempt < N_TRIES => {}
            Err(source) => return Err(NamespaceError::Folder { source }),
        }
    }
    unreachable!("the last attempt returns")
}

fn make_locked(wiring: &NamespaceWiring) -> std::io::Result<File> {
    let mut private = DirBuilder::new();
    private.mode(0o700).create(&wiring.folder)?;
    // Another launcher may have taken it for a dead graph's before it was locked, and removes it.
    let Ok(folder) = lock(&wiring.folder) else { return Err(std::io::ErrorKind::AlreadyExists.into()) };
    for inner in [wiring.ports(), wiring.link()] {
        private.create(inner).map_err(|_| std::io::ErrorKind::AlreadyExists)?;
    }
    Ok(folder)
}

/// Takes the rights of other users from the files of a folder.
fn close_to_others(folder: &Path) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_file() {
            std::fs::set_permissions(entry.path(), Permissions::from_mode(0o600))?;
        }
    }
    Ok(())
}

fn folder_name(graph: &str) -> String {
    // A name is ASCII.
    format!("{FOLDER_PREFIX}{}.{}", &graph[..graph.len().min(MAX_NAME_BYTES)], random_letters())
}

/// The end of a name that nobody can foresee.
pub(crate) fn random_letters() -> String {
    let mut random = RandomState::new().hash_one(std::process::id());
    let mut letters = String::new();
    for _ in 0..N_LETTERS {
        letters.push(char::from(LETTERS[(random % LETTERS.len() as u64) as usize]));
        random /= LETTERS.len() as u64;
    }
    letters
}

/// The part of a folder's name behind the prefix, if it is the name of a graph's folder.
fn id_of(entry: &str) -> Option<&str> {
    let id = entry.strip_prefix(FOLDER_PREFIX)?;
    let (name, letters) = id.split_once('.')?;
    let is_id = letters.len() == N_LETTERS && letters.bytes().all(|letter| LETTERS.contains(&letter));
    (is_name(name) && is_id).then_some(id)
}

/// The lock of a folder, if no launcher holds it. Its holder may remove the folder. A link to a folder is not followed.
fn lock(path: &Path) -> std::io::Result<File> {
    let flags = (OFlags::DIRECTORY | OFlags::NOFOLLOW).bits() as i32;
    let folder = std::fs::OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    rustix::fs::flock(&folder, FlockOperation::NonBlockingLockExclusive)?;
    Ok(folder)
}

/// Removes the folder of a graph whose launcher has died. Its operators call this as they end, so that the last one leaves no
/// file behind.
pub fn clear_orphaned(domain: &NamespaceWiring) {
    // Taking the lock shows that the launcher is gone.
    if let Ok(_lock) = lock(&domain.folder) {
        remove_or_say(&domain.folder);
        // An operator in a sandbox cannot: then the next graph that starts does.
        control_socket::remove_dead();
    }
}

/// The files and folders that ended graphs have left, by id or name. There are seldom any: the next graph that starts removes them, and
/// so does [`sweep`].
pub fn left_over() -> Vec<(String, PathBuf)> {
    let mut left = Vec::new();
    for (id, folder) in folders() {
        // Taking the lock shows that no process holds it.
        if lock(&folder).is_ok() {
            left.push((id, folder));
        }
    }
    left.extend(control_socket::dead());
    left
}

/// Removes the files of graphs that were killed before their operators could do so. Returns the folders that could not be
/// removed.
pub fn sweep() -> Vec<(PathBuf, Error)> {
    control_socket::remove_dead();
    let mut failed = Vec::new();
    for (_, folder) in folders() {
        if let Ok(_lock) = lock(&folder)
            && let Err(error) = remove(&folder)
        {
            failed.push((folder, error));
        }
    }
    failed
}

/// Removes a folder whose lock the caller holds, with all that is in it; links are not followed. No living process uses it, so
/// the clean-up of iceoryx2, which tells the dead from the living, isn't needed.
fn remove(folder: &Path) -> std::io::Result<()> {
    match std::fs::remove_dir_all(folder) {
        // Its owner was ending and may have removed it.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        outcome => outcome,
    }
}

fn remove_or_say(folder: &Path) {
    if let Err(error) = remove(folder) {
        print_diagnostic(&format!("blindgrasp: cannot remove {}: {error}", folder.display()));
    }
}

/// This user's folders of graphs, with their ids.
fn folders() -> Vec<(String, PathBuf)> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(SHARED_MEMORY_FOLDER).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if let Some(id) = name.to_str().and_then(id_of)
            && entry.metadata().is_ok_and(|metadata| metadata.is_dir() && metadata.uid() == own_uid())
        {
            found.push((id.to_string(), entry.path()));
        }
    }
    found.sort();
    found
}

fn own_uid() -> u32 {
    rustix::process::getuid().as_raw()
}

/// Frees the resources that dead processes of a graph still hold in iceoryx2. Nothing is freed while the small files that it reads
/// for this lack their memory, as those of a process that died of full shared memory do: it would end the calling process
/// (SIGBUS).
pub fn clean_dead_nodes(domain: &NamespaceWiring) {
    if take_room_of(domain, |name| !name.ends_with(SAMPLES_SUFFIX)).is_err() {
        return;
    }
    let Ok(config) = config(domain) else { return };
    let _ = Node::<PrivateService>::list(&config, |state| {
        if let NodeState::Dead(view) = state {
            // iceoryx2 lets one thread of a process do so at a time.
            let _ = view.blocking_remove_stale_resources(CLEANUP_LIMIT);
        }
        CallbackProgression::Continue
    });
}

/// Joins a graph's shared memory under a name for this process.
///
/// # Errors
/// The graph's folder belongs to another user or is open to others; an error of iceoryx2.
pub fn join(domain: &NamespaceWiring, node: &str) -> Result<Node<PrivateService>, NamespaceError> {
    let refused = |source: BoxedError| NamespaceError::Join { folder: domain.folder.clone(), source };
    let metadata = std::fs::symlink_metadata(&domain.folder).map_err(|error| refused(error.into()))?;
    if !metadata.is_dir() || metadata.uid() != own_uid() || metadata.mode() & OTHERS != 0 {
        return Err(NamespaceError::Foreign { folder: domain.folder.clone() });
    }
    // iceoryx2 would make a new one, in which this process finds none of the others.
    if !domain.ports().is_dir() {
        return Err(NamespaceError::Removed { folder: domain.ports() });
    }
    let config = config(domain)?;
    let name = NodeName::new(node).map_err(|error| refused(error.into()))?;
    NodeBuilder::new()
        .name(&name)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<PrivateService>()
        .map_err(|error| refused(error.into()))
}

fn config(domain: &NamespaceWiring) -> Result<Config, NamespaceError> {
    let refused = |source: BoxedError| NamespaceError::Join { folder: domain.folder.clone(), source };
    // Errors are returned; logging them as well would only repeat them.
    iceoryx2::prelude::set_log_level(LogLevel::Fatal);
    // The global configuration would read ./config/iceoryx2.toml from the current folder.
    let mut config = Config::default();
    config.global.prefix =
        FileName::new(FILE_PREFIX.as_bytes()).map_err(|error| refused(format!("{error:?}").into()))?;
    let root_path = iceoryx2::prelude::Path::new(domain.ports().as_os_str().as_encoded_bytes());
    config.global.set_root_path(&root_path.map_err(|error| refused(format!("{error:?}").into()))?);
    // The launcher alone finds dead processes and frees their memory: looking for them costs milliseconds.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// Takes the memory of a graph's files. The kernel gives memory to a file in shared memory when it is written to for the first
/// time, and kills a process that writes when there is none left. No other program can take memory that the graph has taken.
///
/// # Errors
/// Shared memory has too little room. The part that was taken stays taken.
pub fn take_room(wiring: &NamespaceWiring) -> Result<(), NamespaceError> {
    take_room_of(wiring, |_| true)
}

/// As [`take_room`], for the files whose name is among them.
fn take_room_of(wiring: &NamespaceWiring, is_among: fn(&str) -> bool) -> Result<(), NamespaceError> {
    let mut n_missing_bytes = 0;
    // Links are not followed and pipes are not waited for: an operator may have put any file here.
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
    for entry in std::fs::read_dir(wiring.ports()).into_iter().flatten().flatten() {
        if !is_among(&entry.file_name().to_string_lossy()) {
            continue;
        }
        // A file may go meanwhile, with its process, and some are read-only: these are written already.
        let Ok(file) = std::fs::OpenOptions::new().write(true).custom_flags(flags).open(entry.path()) else { continue };
        let Ok(metadata) = file.metadata() else { continue };
        if !metadata.is_file() || metadata.uid() != own_uid() {
            continue;
        }
        let n_bytes_to_take = metadata.len().saturating_sub(metadata.blocks() * BLOCK_BYTES);
        if n_bytes_to_take > 0
            && rustix::fs::fallocate(&file, FallocateFlags::empty(), 0, metadata.len()) == Err(Errno::NOSPC)
        {
            n_missing_bytes += n_bytes_to_take;
        }
    }
    match n_missing_bytes.saturating_sub(free_bytes().unwrap_or(0)) {
        _ if n_missing_bytes == 0 => Ok(()),
        n_bytes => Err(NamespaceError::NoRoom { missing_mib: n_bytes as f64 / f64::from(1 << 20) }),
    }
}

/// Whether shared memory is so full that a process may die of it.
pub fn is_full() -> bool {
    free_bytes().is_some_and(|free_bytes| free_bytes < LEAST_FREE_FOR_RESTART_BYTES)
}

/// The shared memory that is free; `None` if it has no limit, or the file system does not say.
fn free_bytes() -> Option<u64> {
    let memory = rustix::fs::statvfs(SHARED_MEMORY_FOLDER).ok()?;
    (memory.f_blocks != 0).then_some(memory.f_bavail * memory.f_frsize)
}

/// Whether there is room for a graph's shared memory.
fn check_room() -> Result<(), NamespaceError> {
    match free_bytes() {
        Some(free_bytes) if free_bytes < LEAST_FREE_BYTES => Err(NamespaceError::Full {
            free_mib: free_bytes as f64 / f64::from(1 << 20),
            needed_mib: LEAST_FREE_BYTES >> 20,
        }),
        // A file system that has no limit, or does not say, is no reason to refuse.
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reserved(name: &str) -> Namespace {
        Namespace::reserve(&format!("{name}-{}", std::process::id())).expect("reserved")
    }

    #[test]
    fn the_folder_of_a_graph_is_known_by_its_name() {
        let id = "a_graph-wit.01234abc";
        assert_eq!(id_of(&format!("blindgrasp_{id}")), Some(id));
        let made = folder_name("a_graph-with_the_longest_name_32");
        assert!(id_of(&made).is_some_and(|id| id.starts_with("a_graph-wit.")), "{made}");
        for entry in
            ["blindgrasp-state-0", "blindgrasp_", "blindgrasp_a.b", "iox2_a.12345678", "blindgrasp_../.12345678"]
        {
            assert_eq!(id_of(entry), None, "{entry}");
        }
    }

    #[test]
    fn no_file_of_a_graph_can_be_reached_by_other_users() {
        let namespace = reserved("modes");
        let _nodes = ["one", "two"].map(|name| join(namespace.wiring(), name).expect("joined"));
        let folder = &namespace.wiring().folder;
        assert_eq!(std::fs::metadata(folder).expect("made").mode() & 0o7777, 0o700);
        // Nothing of it lies anywhere else.
        let id = folder.file_name().and_then(|name| name.to_str()).and_then(id_of).expect("an id");
        for place in [PathBuf::from(SHARED_MEMORY_FOLDER), std::env::temp_dir()] {
            for entry in std::fs::read_dir(place).expect("readable").flatten() {
                let is_of_graph = entry.file_name().to_string_lossy().contains(id);
                assert!(!is_of_graph || entry.path() == *folder, "{}", entry.path().display());
            }
        }
        std::fs::set_permissions(folder, Permissions::from_mode(0o755)).expect("opened");
        let refused = join(namespace.wiring(), "three").expect_err("open to others");
        assert!(matches!(refused, NamespaceError::Foreign { .. }), "{refused}");
    }

    #[test]
    fn a_process_does_not_join_a_graph_whose_files_were_removed() {
        let namespace = reserved("removed");
        std::fs::remove_dir_all(namespace.wiring().ports()).expect("removed");
        let refused = join(namespace.wiring(), "one").expect_err("nobody would find it");
        assert!(matches!(refused, NamespaceError::Removed { .. }), "{refused}");
        std::fs::remove_dir_all(&namespace.wiring().folder).expect("removed");
        assert!(join(namespace.wiring(), "one").is_err());
    }

    #[test]
    fn a_folder_that_another_user_has_made_is_no_graphs() {
        let namespace = reserved("planted");
        let elsewhere = tempfile::tempdir().expect("a folder");
        let link = elsewhere.path().join("link");
        std::os::unix::fs::symlink(&namespace.wiring().folder, &link).expect("linked");
        let refused = join(&NamespaceWiring { folder: link.clone() }, "one").expect_err("a link");
        assert!(matches!(refused, NamespaceError::Foreign { .. }), "{refused}");
        assert!(lock(&link).is_err());
    }

    #[test]
    fn room_is_taken_in_regular_files_alone_and_without_waiting() {
        let namespace = reserved("room");
        let at = |name: &str| namespace.wiring().ports().join(name);
        // To open a pipe for writing waits for a reader, and a link leads to any file.
        rustix::fs::mkfifoat(rustix::fs::CWD, at("pipe"), rustix::fs::Mode::RWXU).expect("a pipe");
        let outside = tempfile::NamedTempFile::new().expect("a file");
        outside.as_file().set_len(1 << 16).expect("sparse");
        std::os::unix::fs::symlink(outside.path(), at("link")).expect("linked");
        let own = File::create(at("own")).expect("made");
        own.set_len(1 << 16).expect("sparse");
        take_room(namespace.wiring()).expect("room");
        assert_eq!(own.metadata().expect("there").blocks() * BLOCK_BYTES, 1 << 16);
        assert_eq!(outside.as_file().metadata().expect("there").blocks(), 0);
    }

    #[test]
    fn a_graphs_name_is_reserved_and_nothing_is_left_of_it() {
        let name = format!("{:0<32}", format!("r{}-", std::process::id()));
        let domain = Namespace::reserve(&name).expect("reserved");
        let again = Namespace::reserve(&name).err().expect("taken");
        assert!(matches!(again, NamespaceError::NameTaken { .. }), "{again}");
        let node = join(domain.wiring(), "reader").expect("joined");
        let folder = domain.wiring().folder.clone();
        assert!(folder.exists() && left_over().iter().all(|(_, path)| *path != folder));
        drop(node);
        drop(domain);
        assert!(!folder.exists());
    }
}
