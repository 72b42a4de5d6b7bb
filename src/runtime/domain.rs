//! A running graph's own corner of shared memory.
//!
//! Each running graph has a name that nobody else on the machine has at the time, and with it an iceoryx2 root path and
//! prefix of its own: graphs don't see each other, and whatever bears the prefix when the graph ends, or before one of
//! that name starts, is left over and goes.

use std::collections::BTreeSet;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::{Path, PathBuf};

#[cfg(feature = "full")]
use iceoryx2::prelude::{CallbackProgression, NodeState};
use iceoryx2::prelude::{
    Config, FileName, LogLevel, Node, NodeBuilder, NodeName, SemanticString, SignalHandlingMode, ipc,
};

use super::wiring::DomainWiring;
use crate::dataflow::is_name;
use crate::diagnostics::print_diagnostic;

/// Where POSIX shared memory lies on Linux.
pub const SHARED_MEMORY_FOLDER: &str = "/dev/shm";
/// How much of it must be free before a graph starts: the project's own graph writes to 10 MiB of it. What is promised and
/// not there kills whoever writes to it (SIGBUS), so this is looked at before.
pub const LEAST_FREE_BYTES: u64 = 16 << 20;

/// Why a graph has no domain, or a process no place in it.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// Not a name.
    #[error("graph name '{name}': expected letters, digits, _ and -, at most 32")]
    Name {
        /// The name asked for.
        name: String,
    },
    /// A graph of that name is running.
    #[error(
        "a graph called '{name}' is running: stop it (blindgrasp stop {name}), or give this one another name with --name"
    )]
    NameTaken {
        /// The name asked for.
        name: String,
    },
    /// The name's lock could not be taken for another reason.
    #[error("cannot reserve the graph's name '{name}'")]
    Lock {
        /// The name asked for.
        name: String,
        /// The reason.
        source: std::io::Error,
    },
    /// Too little shared memory is free.
    #[error(
        "only {free_mib:.1} MiB of shared memory are free in {SHARED_MEMORY_FOLDER}, and a graph needs {needed_mib} or more: \
         remove what is left over there, or make it larger (mount -o remount,size=…; docker run --shm-size=…)"
    )]
    Full {
        /// What is free.
        free_mib: f64,
        /// What must be.
        needed_mib: u64,
    },
    /// iceoryx2 said no.
    #[error("cannot join the graph's shared memory at {root_path}: {message}")]
    Join {
        /// iceoryx2's root path.
        root_path: String,
        /// The reason.
        message: String,
    },
}

/// A name that is this process's until it is dropped, with the shared memory that goes with it.
///
/// Dropping it removes whatever is left under its prefix: by then the graph's processes must have ended.
pub struct Domain {
    name: String,
    wiring: DomainWiring,
    /// An abstract socket: the kernel frees it when the process ends, however it ends, and it leaves no file.
    lock: UnixListener,
}

impl Domain {
    /// Reserves `name`, and clears what an earlier graph of that name may have left behind.
    ///
    /// # Errors
    /// A graph of that name is running, or it is no name, or shared memory is full.
    pub fn reserve(name: &str) -> Result<Domain, DomainError> {
        if !is_name(name) {
            return Err(DomainError::Name { name: name.into() });
        }
        let uid = rustix::process::getuid().as_raw();
        sweep();
        match lock(uid, name) {
            Ok(lock) => {
                clear_or_say(uid, name);
                let domain = Domain { wiring: wiring(uid, name), name: name.into(), lock };
                check_room()?;
                Ok(domain)
            }
            Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
                Err(DomainError::NameTaken { name: name.into() })
            }
            Err(source) => Err(DomainError::Lock { name: name.into(), source }),
        }
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What other processes need to join.
    pub fn wiring(&self) -> &DomainWiring {
        &self.wiring
    }

    /// Where clients of the graph connect.
    pub fn listener(&self) -> &UnixListener {
        &self.lock
    }
}

impl Drop for Domain {
    fn drop(&mut self) {
        clear_or_say(rustix::process::getuid().as_raw(), &self.name);
    }
}

/// The name of a graph's control socket in the abstract namespace.
pub fn socket_name(uid: u32, graph: &str) -> String {
    format!("blindgrasp/{uid}/{graph}")
}

/// Removes what a graph left whose launcher has died, if no other has taken its name since.
///
/// Called by its operators as they end, so that the last of them leaves nothing behind.
pub(super) fn clear_orphaned(graph: &str) {
    // Taking the name shows that the launcher is gone.
    let uid = rustix::process::getuid().as_raw();
    if let Ok(lock) = lock(uid, graph) {
        clear_or_say(uid, graph);
        drop(lock);
    }
}

/// What graphs have left behind that do not run any more, by name: shared memory and folders. Nothing mostly: the next
/// graph that starts removes it, and so does [`sweep`].
pub fn left_over() -> Vec<(String, Vec<PathBuf>)> {
    let uid = rustix::process::getuid().as_raw();
    let names = names_in_use(uid).into_iter();
    // Taking the name shows that nobody holds it.
    names.filter(|name| lock(uid, name).is_ok()).map(|name| (name.clone(), remains(uid, &name))).collect()
}

/// Clears the domains that nobody holds: of graphs that were killed before their operators could clear up after them.
/// Returns what could not be removed.
pub fn sweep() -> Vec<(PathBuf, std::io::Error)> {
    let uid = rustix::process::getuid().as_raw();
    let mut failed = Vec::new();
    for name in names_in_use(uid) {
        if let Ok(lock) = lock(uid, &name) {
            failed.extend(clear(uid, &name));
            drop(lock);
        }
    }
    failed
}

/// The names under which there is shared memory or a folder.
fn names_in_use(uid: u32) -> BTreeSet<String> {
    let places = [
        (std::env::temp_dir(), format!("blindgrasp-{uid}-")),
        (SHARED_MEMORY_FOLDER.into(), format!("blindgrasp_{uid}_")),
    ];
    let names = places.iter().flat_map(|(folder, prefix)| {
        // Names have no dots: what follows one is the launcher's process.
        entries_of(folder, prefix).into_iter().filter_map(move |path| {
            let (name, _) = path.file_name()?.to_str()?.strip_prefix(prefix.as_str())?.split_once('.')?;
            is_name(name).then(|| name.to_string())
        })
    });
    names.collect()
}

/// The shared memory and folders of all runs of a name.
fn remains(uid: u32, name: &str) -> Vec<PathBuf> {
    let mut paths = entries_of(Path::new(SHARED_MEMORY_FOLDER), &format!("blindgrasp_{uid}_{name}."));
    paths.extend(entries_of(&std::env::temp_dir(), &format!("blindgrasp-{uid}-{name}.")));
    paths
}

/// Removes the shared memory and folders of all runs of a name, which the caller holds: nothing alive uses them, so
/// iceoryx2's own clean-up, which tells the dead from the living, isn't needed. Returns what could not be removed.
fn clear(uid: u32, name: &str) -> Vec<(PathBuf, std::io::Error)> {
    let removed = remains(uid, name).into_iter().filter_map(|path| {
        let outcome = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        // Its owner was on the way out and may have removed it.
        let error = outcome.err().filter(|error| error.kind() != std::io::ErrorKind::NotFound)?;
        Some((path, error))
    });
    removed.collect()
}

/// As [`clear`]; what could not be removed is said.
fn clear_or_say(uid: u32, name: &str) {
    for (path, error) in clear(uid, name) {
        print_diagnostic(&format!("blindgrasp: cannot remove {}: {error}", path.display()));
    }
}

/// Takes a graph's name, or says that it is taken.
fn lock(uid: u32, name: &str) -> std::io::Result<UnixListener> {
    let address = SocketAddr::from_abstract_name(socket_name(uid, name))?;
    UnixListener::bind_addr(&address)
}

fn wiring(uid: u32, name: &str) -> DomainWiring {
    // With the launcher's process: what an operator that outlives its launcher removes is never another run's.
    let pid = std::process::id();
    let root_path = std::env::temp_dir().join(format!("blindgrasp-{uid}-{name}.{pid}")).to_string_lossy().into_owned();
    let prefix = format!("blindgrasp_{uid}_{name}.{pid}.");
    // With the prefix, so that it is cleared with whatever else bears it.
    DomainWiring { root_path, board: format!("{SHARED_MEMORY_FOLDER}/{prefix}board"), prefix }
}

/// Frees what the dead of a domain hold in iceoryx2's books.
#[cfg(feature = "full")]
pub(super) fn clean_dead_nodes(domain: &DomainWiring) {
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

/// Joins a domain under a name for this process.
///
/// # Errors
/// iceoryx2's reason.
pub fn join(domain: &DomainWiring, node: &str) -> Result<Node<ipc::Service>, DomainError> {
    let refused = |message: String| DomainError::Join { root_path: domain.root_path.clone(), message };
    let config = config(domain)?;
    let name = NodeName::new(node).map_err(|error| refused(format!("{error:?}")))?;
    NodeBuilder::new()
        .name(&name)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|error| refused(format!("{error:?}")))
}

fn config(domain: &DomainWiring) -> Result<Config, DomainError> {
    let refused = |message: String| DomainError::Join { root_path: domain.root_path.clone(), message };
    // Its errors come back as errors; logged as well, they would only be said twice.
    iceoryx2::prelude::set_log_level(LogLevel::Fatal);
    // Not the global configuration: that would read ./config/iceoryx2.toml from wherever the user stands.
    let mut config = Config::default();
    config.global.prefix = FileName::new(domain.prefix.as_bytes()).map_err(|error| refused(format!("{error:?}")))?;
    let root_path = iceoryx2::prelude::Path::new(domain.root_path.as_bytes());
    config.global.set_root_path(&root_path.map_err(|error| refused(format!("{error:?}")))?);
    // Who is dead and when its memory may go is the launcher's business: looking for the dead costs milliseconds.
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    Ok(config)
}

/// Whether there is room for a graph's shared memory.
fn check_room() -> Result<(), DomainError> {
    // A file system that cannot tell, or has no limit, is no reason to refuse.
    let Ok(memory) = rustix::fs::statvfs(SHARED_MEMORY_FOLDER) else {
        return Ok(());
    };
    let free_bytes = memory.f_bavail * memory.f_frsize;
    if memory.f_blocks == 0 || free_bytes >= LEAST_FREE_BYTES {
        return Ok(());
    }
    Err(DomainError::Full { free_mib: free_bytes as f64 / f64::from(1 << 20), needed_mib: LEAST_FREE_BYTES >> 20 })
}

/// What lies in a folder under names that begin like this.
fn entries_of(folder: &Path, prefix: &str) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let bears = |entry: &std::fs::DirEntry| entry.file_name().to_str().is_some_and(|name| name.starts_with(prefix));
    entries.flatten().filter(bears).map(|entry| entry.path()).collect()
}
