//! A running graph's own namespace in shared memory.
//!
//! Each running graph has a name that no other graph of the same user has at the time, and an iceoryx2 root path and prefix
//! of its own: graphs don't see each other, and all files with the prefix are removed when the graph ends, or after it was
//! killed.

use std::collections::BTreeSet;
use std::fs::{DirBuilder, File};
use std::hash::{BuildHasher, RandomState};
use std::io::Write;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::os::unix::net::UnixListener;
use std::path::PathBuf;

use iceoryx2::prelude::{CallbackProgression, NodeState};
use iceoryx2::prelude::{
    Config, FileName, LogLevel, Node, NodeBuilder, NodeName, SemanticString, SignalHandlingMode, ipc,
};

use rustix::fs::{FallocateFlags, FlockOperation};
use rustix::io::Errno;

use crate::control_socket::{self, ControlSocket};
use crate::diagnostics::print_diagnostic;
use crate::port::BoxedError;
use crate::text::is_name;
use crate::wiring::NamespaceWiring;

/// The folder of POSIX shared memory on Linux.
pub const SHARED_MEMORY_FOLDER: &str = "/dev/shm";
/// The shared memory that must be free before a graph starts. A graph with few cells takes so much when it has started, the
/// default graph 34 MiB ([`take_room`]); a process that writes to shared memory that is not there dies (SIGBUS).
pub const LEAST_FREE_BYTES: u64 = 16 << 20;

/// A process that dies of full shared memory (SIGBUS) is started again when so much of it is free.
const LEAST_FREE_FOR_RESTART_BYTES: u64 = 4 << 20;

/// The names of folders of graphs, in the folder for temporary files, begin with this; their id follows.
const FOLDER_PREFIX: &str = "blindgrasp-";
/// The unit in which the kernel counts the blocks of a file.
const BLOCK_BYTES: u64 = 512;
/// The names of all files that iceoryx2 makes begin with this; the id follows.
const FILE_PREFIX: &str = "blindgrasp_";
/// The names of files have so much of the graph's name.
const MAX_ID_NAME_BYTES: usize = 11;
/// The random letters in an id: so many that no other user can take all names first (36^8 is about 3 · 10^12).
const ID_LETTERS: &[u8; 36] = b"abcdefghijklmnopqrstuvwxyz0123456789";
const N_ID_LETTERS: usize = 8;
/// So many ids are tried, in case that one is taken.
const N_ID_TRIES: u32 = 8;
/// The longest path of a file in iceoryx2 0.10.
const MAX_PATH_BYTES: usize = 255;
/// iceoryx2 0.10 adds to the prefix of a connection the digits of a hash, two numbers of up to 33 digits, and an ending.
const MAX_NAME_BYTES: usize = 40 + 1 + 33 + 1 + 33 + ".connection".len();
/// The longest path of a folder in which the folders of graphs may be: behind it come the folder, and in that a file.
const MAX_FOLDER_BYTES: usize = MAX_PATH_BYTES
    - (1 + FOLDER_PREFIX.len() + MAX_ID_BYTES)
    - (1 + FILE_PREFIX.len() + MAX_ID_BYTES + 1)
    - MAX_NAME_BYTES;
const MAX_ID_BYTES: usize = MAX_ID_NAME_BYTES + 1 + N_ID_LETTERS;
/// The file in which iceoryx2 0.10 counts the processes of a graph. iceoryx2 lets all users of the machine write to it, so the
/// launcher makes it before the first process joins. The name has the hash of a type.
const COUNTER_NAME: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// The version of iceoryx2 (0.10.0, 16 bits a part), and the count, which is 0, with its padding.
const COUNTER: [u64; 2] = [10 << 16, 0];

/// The folder in which the folders of graphs are: the one for temporary files (`TMPDIR`), or `/tmp` where the path of that one is
/// too long for the files below it.
pub fn graphs_folder() -> PathBuf {
    let folder = std::env::temp_dir();
    if folder.as_os_str().len() <= MAX_FOLDER_BYTES { folder } else { "/tmp".into() }
}

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
    Lock { name: String, source: std::io::Error },
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
    #[error(
        "the graph's folder cannot be made in the folder for temporary files, {}: set TMPDIR to a folder that this user may \
         write to",
        folder.display()
    )]
    Folder { folder: PathBuf, source: std::io::Error },
    #[error("cannot join the graph's shared memory at {root_path}")]
    Join { root_path: String, source: BoxedError },
}

/// A graph's name, which this process holds until it is dropped, and the shared memory that belongs to it.
///
/// Dropping it removes all files with its prefix: by then the graph's processes must have ended.
pub struct Namespace {
    name: String,
    wiring: NamespaceWiring,
    socket: ControlSocket,
    /// The lock of the id.
    _lock: Lock,
}

impl Namespace {
    /// Reserves `name`, and removes files that ended graphs have left.
    ///
    /// # Errors
    /// A graph of that name is running, the name has forbidden characters, shared memory is full, or the folder for temporary
    /// files cannot be written to.
    pub fn reserve(name: &str) -> Result<Namespace, NamespaceError> {
        if !is_name(name) {
            return Err(NamespaceError::Name { name: name.into() });
        }
        sweep();
        let failed = |source: std::io::Error| match source.kind() {
            std::io::ErrorKind::AddrInUse => NamespaceError::NameTaken { name: name.into() },
            _ => NamespaceError::Lock { name: name.into(), source },
        };
        let socket = ControlSocket::bind(name).map_err(failed)?;
        let (wiring, lock) = Self::reserve_files(name)?;
        let domain = Namespace { name: name.into(), wiring, socket, _lock: lock };
        check_room()?;
        make_counter(&domain.wiring).map_err(|source| NamespaceError::Lock { name: name.into(), source })?;
        Ok(domain)
    }

    /// A folder and a lock that no other graph has. The folder is new and of this user alone: files that another user has put
    /// where a graph opens its services could lead it anywhere.
    fn reserve_files(name: &str) -> Result<(NamespaceWiring, Lock), NamespaceError> {
        for attempt in 1.. {
            let id = Id::new(name);
            let wiring = id.wiring();
            let folder = graphs_folder();
            match DirBuilder::new().mode(0o700).create(&wiring.root_path) {
                Ok(()) => {}
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists && attempt < N_ID_TRIES => continue,
                Err(source) => return Err(NamespaceError::Folder { folder, source }),
            }
            match id.reserve() {
                Ok(lock) => return Ok((wiring, lock)),
                Err(source) if attempt == N_ID_TRIES => return Err(NamespaceError::Lock { name: name.into(), source }),
                Err(_) => drop(std::fs::remove_dir(&wiring.root_path)),
            }
        }
        unreachable!("the last attempt returns")
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

/// The sign that a launcher lives: locks (flock) on a file in the folder of shared memory and on the graph's folder, because
/// containers may share one and not the other. The kernel frees both when the process ends, however it ends.
struct Lock {
    _held: Vec<File>,
}

/// The id in the names of a graph's files: the beginning of the graph's name, for people, and random letters, which
/// distinguish it from all others and cannot be foreseen.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Id(String);

impl Id {
    fn new(graph: &str) -> Id {
        // A name is ASCII.
        let mut random = RandomState::new().hash_one(std::process::id());
        let letters = std::iter::repeat_with(|| {
            let letter = ID_LETTERS[(random % ID_LETTERS.len() as u64) as usize];
            random /= ID_LETTERS.len() as u64;
            char::from(letter)
        });
        let letters: String = letters.take(N_ID_LETTERS).collect();
        Id(format!("{}.{letters}", &graph[..graph.len().min(MAX_ID_NAME_BYTES)]))
    }

    /// The id in the name of a file or folder.
    fn of(entry: &str) -> Option<Id> {
        let rest = entry.strip_prefix(FOLDER_PREFIX).or_else(|| entry.strip_prefix(FILE_PREFIX))?;
        let mut parts = rest.split('.');
        let (name, letters) = (parts.next()?, parts.next()?);
        let is_id = letters.len() == N_ID_LETTERS && letters.bytes().all(|letter| ID_LETTERS.contains(&letter));
        (is_name(name) && is_id).then(|| Id(format!("{name}.{letters}")))
    }

    fn wiring(&self) -> NamespaceWiring {
        let root_path = graphs_folder().join(format!("{FOLDER_PREFIX}{}", self.0)).to_string_lossy().into_owned();
        let prefix = format!("{FILE_PREFIX}{}.", self.0);
        // The prefix lets it be removed with the other files.
        let cursors = format!("{SHARED_MEMORY_FOLDER}/{prefix}cursors");
        NamespaceWiring { root_path, cursors, prefix, lock_file: self.lock_file() }
    }

    /// The lock, for a launcher that has made the graph's folder. No other process gets it while the launcher lives.
    fn reserve(&self) -> std::io::Result<Lock> {
        let NamespaceWiring { root_path, lock_file, .. } = self.wiring();
        std::fs::OpenOptions::new().append(true).create_new(true).mode(0o600).open(&lock_file)?;
        let mut held = Vec::new();
        for path in [&root_path, &lock_file] {
            let file = File::open(path)?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                // Some file systems (NFS) lock no folder. Then nobody else can lock it either, and so remove it.
                Err(error) if error != Errno::WOULDBLOCK && path == &root_path => continue,
                locked => locked?,
            }
            // Another launcher may have taken it for a dead graph's before and removed it.
            if file.metadata()?.ino() != std::fs::metadata(path)?.ino() {
                return Err(std::io::ErrorKind::AlreadyExists.into());
            }
            held.push(file);
        }
        Ok(Lock { _held: held })
    }

    /// The lock, if no launcher holds it. Its holder may remove the files with the id.
    fn lock(&self) -> std::io::Result<Lock> {
        let NamespaceWiring { root_path, lock_file, .. } = self.wiring();
        let mut held = Vec::new();
        for path in [root_path, lock_file] {
            match File::open(path) {
                Ok(file) => {
                    rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive)?;
                    held.push(file);
                }
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(Lock { _held: held })
    }

    fn lock_file(&self) -> String {
        format!("{SHARED_MEMORY_FOLDER}/{FILE_PREFIX}{}.lock", self.0)
    }

    /// The files and folders with this id.
    fn remains(&self) -> Vec<PathBuf> {
        let bears = |(id, path): (Id, PathBuf)| (id == *self).then_some(path);
        entries().into_iter().filter_map(bears).collect()
    }

    /// Removes the files and folders with the id, whose lock the caller holds. No living process uses them, so the clean-up of
    /// iceoryx2, which tells the dead from the living, isn't needed. Returns the files that could not be removed.
    fn clear(&self) -> Vec<(PathBuf, std::io::Error)> {
        let removed = self.remains().into_iter().filter_map(|path| {
            let outcome = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
            // Its owner was ending and may have removed it.
            let error = outcome.err().filter(|error| error.kind() != std::io::ErrorKind::NotFound)?;
            Some((path, error))
        });
        removed.collect()
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        clear_or_say(&self.wiring);
    }
}

/// Removes the files of a graph whose launcher has died. Its operators call this as they end, so that the last one leaves no
/// file behind.
pub fn clear_orphaned(domain: &NamespaceWiring) {
    // Taking the lock shows that the launcher is gone.
    if let Some(lock) = id_of(domain).and_then(|id| id.lock().ok()) {
        clear_or_say(domain);
        drop(lock);
        // An operator in a sandbox cannot: then the next graph that starts does.
        control_socket::remove_dead();
    }
}

/// The files and folders that ended graphs have left, by id or name. There are seldom any: the next graph that starts removes them, and
/// so does [`sweep`].
pub fn left_over() -> Vec<(String, Vec<PathBuf>)> {
    // Taking the lock shows that no process holds it.
    let dead = ids().into_iter().filter(|id| id.lock().is_ok());
    let mut left: Vec<(String, Vec<PathBuf>)> = dead.map(|id| (id.0.clone(), id.remains())).collect();
    left.extend(control_socket::dead().into_iter().map(|(name, socket)| (name, vec![socket])));
    left
}

/// Removes the files of graphs that were killed before their operators could do so. Returns the files that could not be
/// removed.
pub fn sweep() -> Vec<(PathBuf, std::io::Error)> {
    control_socket::remove_dead();
    let mut failed = Vec::new();
    for id in ids() {
        if let Ok(lock) = id.lock() {
            failed.extend(id.clear());
            drop(lock);
        }
    }
    failed
}

fn id_of(domain: &NamespaceWiring) -> Option<Id> {
    Id::of(&domain.prefix)
}

fn clear_or_say(domain: &NamespaceWiring) {
    for (path, error) in id_of(domain).map(|id| id.clear()).unwrap_or_default() {
        print_diagnostic(&format!("blindgrasp: cannot remove {}: {error}", path.display()));
    }
}

/// The ids of all files and folders of graphs.
fn ids() -> BTreeSet<Id> {
    entries().into_iter().map(|(id, _)| id).collect()
}

/// This user's files and folders of graphs.
fn entries() -> Vec<(Id, PathBuf)> {
    let uid = rustix::process::getuid().as_raw();
    let folders = [PathBuf::from(SHARED_MEMORY_FOLDER), graphs_folder()];
    let all = folders.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flat_map(Iterator::flatten);
    let of_graphs = all.filter_map(|entry| Some((Id::of(entry.file_name().to_str()?)?, entry)));
    let own = of_graphs.filter(|(_, entry)| entry.metadata().is_ok_and(|metadata| metadata.uid() == uid));
    own.map(|(id, entry)| (id, entry.path())).collect()
}

/// Frees the resources that dead processes of a graph still hold in iceoryx2.
pub fn clean_dead_nodes(domain: &NamespaceWiring) {
    let Ok(config) = config(domain) else {
        return;
    };
    let _ = Node::<ipc::Service>::list(&config, |state| {
        if let NodeState::Dead(view) = state {
            let _ = view.try_remove_stale_resources();
        }
        CallbackProgression::Continue
    });
}

/// Joins a graph's shared memory under a name for this process.
///
/// # Errors
/// An error of iceoryx2.
pub fn join(domain: &NamespaceWiring, node: &str) -> Result<Node<ipc::Service>, NamespaceError> {
    let refused = |source: BoxedError| NamespaceError::Join { root_path: domain.root_path.clone(), source };
    let config = config(domain)?;
    let name = NodeName::new(node).map_err(|error| refused(error.into()))?;
    NodeBuilder::new()
        .name(&name)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|error| refused(error.into()))
}

fn config(domain: &NamespaceWiring) -> Result<Config, NamespaceError> {
    let refused = |source: BoxedError| NamespaceError::Join { root_path: domain.root_path.clone(), source };
    // Errors are returned; logging them as well would only repeat them.
    iceoryx2::prelude::set_log_level(LogLevel::Fatal);
    // The global configuration would read ./config/iceoryx2.toml from the current folder.
    let mut config = Config::default();
    config.global.prefix =
        FileName::new(domain.prefix.as_bytes()).map_err(|error| refused(format!("{error:?}").into()))?;
    let root_path = iceoryx2::prelude::Path::new(domain.root_path.as_bytes());
    config.global.set_root_path(&root_path.map_err(|error| refused(format!("{error:?}").into()))?);
    // The launcher alone finds dead processes and frees their memory: looking for them costs milliseconds.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// Makes the file of [`COUNTER_NAME`] for this user alone.
fn make_counter(wiring: &NamespaceWiring) -> std::io::Result<()> {
    let path = format!("{SHARED_MEMORY_FOLDER}/{}{COUNTER_NAME}", wiring.prefix);
    let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    COUNTER.iter().try_for_each(|word| file.write_all(&word.to_ne_bytes()))
}

/// Takes the memory of a graph's files. The kernel gives memory to a file in shared memory when it is written to for the first
/// time, and kills a process that writes when there is none left; no other program can take memory that the graph has taken.
///
/// # Errors
/// Shared memory has too little room. The part that was taken stays taken.
pub fn take_room(wiring: &NamespaceWiring) -> Result<(), NamespaceError> {
    let mut n_missing_bytes = 0;
    for entry in std::fs::read_dir(SHARED_MEMORY_FOLDER).into_iter().flatten().flatten() {
        if !entry.file_name().as_bytes().starts_with(wiring.prefix.as_bytes()) {
            continue;
        }
        // A file may go meanwhile, with its process, and some are read-only: these are written already.
        let Ok(file) = std::fs::OpenOptions::new().write(true).open(entry.path()) else {
            continue;
        };
        let Ok(metadata) = file.metadata() else {
            continue;
        };
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

    #[test]
    fn an_id_is_read_back_from_what_bears_it() {
        let id = Id::new("a_graph-with_the_longest_name_32");
        let NamespaceWiring { root_path, prefix, cursors, .. } = id.wiring();
        for entry in [root_path.as_str(), cursors.as_str(), &format!("{prefix}3f.data")] {
            let name = entry.rsplit('/').next().expect("a name");
            assert_eq!(Id::of(name), Some(id.clone()), "{entry}");
        }
        assert_eq!(id_of(&id.wiring()), Some(id));
        // The folder of logs, and files of other programs.
        for entry in ["blindgrasp-state-0", "blindgrasp-", "blindgrasp_a.b.data", "iox2_a.12.data", "blindgrasp_../x.1"]
        {
            assert_eq!(Id::of(entry), None, "{entry}");
        }
    }

    /// The names, modes and contents of a graph's files in shared memory.
    fn files_of(wiring: &NamespaceWiring) -> Vec<(String, u32, Vec<u8>)> {
        let entries = std::fs::read_dir(SHARED_MEMORY_FOLDER).expect("readable").flatten();
        let of_graph = entries.filter_map(|entry| {
            let name = entry.file_name().to_str()?.strip_prefix(&wiring.prefix)?.to_string();
            Some((name, entry.metadata().ok()?.mode() & 0o7777, std::fs::read(entry.path()).ok()?))
        });
        of_graph.collect()
    }

    #[test]
    fn the_counter_of_processes_is_the_one_that_iceoryx2_would_make_but_for_its_mode() {
        let name = format!("counter-{}", std::process::id());
        let domain = Namespace::reserve(&name).expect("reserved");
        let counter = |files: Vec<(String, u32, Vec<u8>)>| files.into_iter().find(|(name, ..)| name == COUNTER_NAME);
        let (_, own_mode, own) = counter(files_of(domain.wiring())).expect("made");
        // Without it, iceoryx2 makes its own.
        let path = format!("{SHARED_MEMORY_FOLDER}/{}{COUNTER_NAME}", domain.wiring().prefix);
        std::fs::remove_file(path).expect("removed");
        drop(join(domain.wiring(), "first").expect("joined"));
        let (_, mode, mut made) = counter(files_of(domain.wiring())).expect("iceoryx2 has made it under this name");
        assert_eq!((own_mode, mode), (0o600, 0o666));
        // The first process is counted, and iceoryx2 leaves the padding as it is.
        made[8..12].fill(0);
        assert_eq!(own, made);
    }

    #[test]
    fn no_file_of_a_graph_is_open_to_other_users() {
        let domain = Namespace::reserve(&format!("modes-{}", std::process::id())).expect("reserved");
        let nodes = ["one", "two"].map(|name| join(domain.wiring(), name).expect("joined"));
        for (name, mode, _) in files_of(domain.wiring()) {
            assert_eq!(mode & 0o077, 0, "{name}: {mode:o}");
        }
        drop(nodes);
    }

    #[test]
    fn a_folder_for_temporary_files_with_a_long_path_has_room_for_a_graph() {
        let id = Id::new("a_graph-with_the_longest_name_32");
        let NamespaceWiring { prefix, .. } = id.wiring();
        let n_left = MAX_PATH_BYTES - MAX_NAME_BYTES - prefix.len() - FOLDER_PREFIX.len() - id.0.len() - 2;
        assert!(n_left >= 64, "{n_left}");
    }

    #[test]
    fn a_graphs_name_is_reserved_and_nothing_is_left_of_it() {
        let name = format!("{:0<32}", format!("r{}-", std::process::id()));
        let domain = Namespace::reserve(&name).expect("reserved");
        let again = Namespace::reserve(&name).err().expect("taken");
        assert!(matches!(again, NamespaceError::NameTaken { .. }), "{again}");
        let node = join(domain.wiring(), "reader").expect("joined");
        let root_path = PathBuf::from(&domain.wiring().root_path);
        assert!(root_path.exists() && left_over().iter().all(|(_, paths)| !paths.contains(&root_path)));
        drop(node);
        drop(domain);
        assert!(!root_path.exists());
    }
}
