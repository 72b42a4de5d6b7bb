//! The sandbox of an operator process, which restricts itself with Landlock.
//!
//! A process with a sandbox restricts itself twice. Before it begins, it gives up running programs, the network, writing files,
//! signals to other processes and sockets such as the launcher's, through which it could have programs run. When it is ready
//! and has read its files, it gives up reading any others. It keeps the graph's shared memory and folder, the files that its
//! params name, and the network if its description says that it uses it.
//!
//! Landlock knows sockets in the file system from Linux 7.1 on, and the launcher's is one. So a filter of system calls
//! (seccomp) denies making sockets of that family. The filter decides nothing else, so that
//! another version of a library, with other system calls, does not end an operator.
//!
//! Both restrict threads and those that they start. Threads that an operator starts before it is ready can read files for as
//! long as they live; the thread that listens to the launcher gives it up with its first command.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, AccessNet, BitFlags, RestrictionStatus, Ruleset, RulesetAttr, RulesetCreated,
    RulesetCreatedAttr, RulesetError, RulesetStatus, Scope, make_bitflags, path_beneath_rules,
};
use seccompiler::SeccompCmpArgLen::Dword;
use seccompiler::{SeccompAction, SeccompCmpOp, SeccompCondition, SeccompFilter, SeccompRule, apply_filter};
use serde_json::{Map, Value};

use crate::description::OperatorDescription;
use crate::namespace::SHARED_MEMORY_FOLDER;
use crate::param::ParamKind;
use crate::wiring::{Enforcement, NamespaceWiring};

/// The newest Landlock whose rights are asked for: Linux 6.12. An older one enforces the rights that it knows.
const NEWEST: ABI = ABI::V6;
const READ: BitFlags<AccessFs> = make_bitflags!(AccessFs::{ReadFile | ReadDir});
/// Names of machines are looked up with these files and libraries.
const NAME_SERVICE_FOLDERS: [&str; 5] = ["/etc", "/usr", "/lib", "/lib64", "/run"];
/// Programs write to it what nobody needs.
const NULL_DEVICE: &str = "/dev/null";
/// A device that is plugged in again is another file in this folder.
const DEVICE_FOLDER: &str = "/dev";
/// Programs for the x32 ABI of x86-64 have the same system calls under numbers with this bit.
const X32_BIT: i64 = 0x4000_0000;

/// Why a sandbox cannot be entered.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SandboxError {
    #[error(transparent)]
    Landlock(#[from] RulesetError),
    #[error("the filter of system calls is not taken")]
    Filter(#[from] seccompiler::BackendError),
    #[error("the filter of system calls cannot be installed")]
    Install(#[from] seccompiler::Error),
}

/// The rights that an operator keeps.
pub(crate) struct Sandbox {
    /// Files and folders that it may read.
    readable: Vec<PathBuf>,
    /// Folders that it may read and write.
    writable: Vec<PathBuf>,
    uses_network: bool,
    /// It entered the scope of its signals and sockets before, with its program.
    is_host: bool,
}

/// Lets this thread, and those and the programs that it will start, send signals to no other process, and connect to no abstract
/// socket of one. A host does so first of all, so that it can still end its program.
pub(crate) fn enter_scope() -> Result<Enforcement, SandboxError> {
    enforce(Ruleset::default().scope(Scope::from_all(NEWEST))?.create()?)
}

impl Sandbox {
    /// The rights of the program of a host, which knows nothing of shared memory.
    pub(crate) fn of_program(description: &OperatorDescription, params: &Map<String, Value>) -> Self {
        Sandbox::new_in(std::iter::once((description, params)), vec![NULL_DEVICE.into()])
    }

    /// Gives up writing files, the network, signals and sockets, for a program that is about to begin. It may read files and run
    /// programs, which have its rights.
    pub(crate) fn enter_program(&self) -> Result<Enforcement, SandboxError> {
        deny_sockets(self.uses_network)?;
        let rights = AccessFs::from_all(NEWEST) & !READ & !AccessFs::Execute;
        let mut ruleset = Ruleset::default().handle_access(rights)?.scope(Scope::from_all(NEWEST))?;
        if !self.uses_network {
            ruleset = ruleset.handle_access(AccessNet::from_all(NEWEST))?;
        }
        enforce(ruleset.create()?.add_rules(path_beneath_rules(&self.writable, rights))?)
    }

    /// The rights that the operators of a process need, each with its params: params of paths that must exist are read, others
    /// are written, with their folder.
    pub(crate) fn new<'a>(
        operators: impl Iterator<Item = (&'a OperatorDescription, &'a Map<String, Value>)>,
        domain: &NamespaceWiring,
    ) -> Self {
        Sandbox::new_in(operators, vec![PathBuf::from(SHARED_MEMORY_FOLDER), PathBuf::from(&domain.root_path)])
    }

    fn new_in<'a>(
        operators: impl Iterator<Item = (&'a OperatorDescription, &'a Map<String, Value>)>,
        mut writable: Vec<PathBuf>,
    ) -> Self {
        let (mut uses_network, mut is_host) = (false, false);
        let mut readable: Vec<PathBuf> = Vec::new();
        for (description, params) in operators {
            uses_network |= description.uses_network;
            is_host |= description.hosted;
            for param in &description.params {
                let path = params.get(&param.name).and_then(Value::as_str).map(Path::new);
                match (&param.kind, path) {
                    (ParamKind::Path { must_exist: true }, Some(path)) => readable.push(path.into()),
                    (ParamKind::Path { must_exist: false }, Some(path)) if path.starts_with(DEVICE_FOLDER) => {
                        writable.push(DEVICE_FOLDER.into());
                    }
                    (ParamKind::Path { must_exist: false }, Some(path)) => {
                        writable.extend(path.parent().map(PathBuf::from))
                    }
                    _ => {}
                }
            }
        }
        if uses_network {
            readable.extend(NAME_SERVICE_FOLDERS.map(PathBuf::from));
        }
        Sandbox { readable, writable, uses_network, is_host }
    }

    /// Gives up all but reading files, for this thread and those that it will start.
    pub(crate) fn enter(&self) -> Result<Enforcement, SandboxError> {
        deny_sockets(self.uses_network)?;
        let rights = AccessFs::from_all(NEWEST) & !READ;
        let mut ruleset = Ruleset::default().handle_access(rights)?;
        if !self.is_host {
            ruleset = ruleset.scope(Scope::from_all(NEWEST))?;
        }
        if !self.uses_network {
            ruleset = ruleset.handle_access(AccessNet::from_all(NEWEST))?;
        }
        let ruleset = ruleset.create()?.add_rules(path_beneath_rules(&self.writable, rights & !AccessFs::Execute))?;
        // The last process of a graph removes its folder, which is in this one.
        enforce(ruleset.add_rules(path_beneath_rules([std::env::temp_dir()], AccessFs::RemoveDir))?)
    }

    /// Gives up reading other files than those that it keeps.
    pub(crate) fn close(&self) -> Result<Enforcement, SandboxError> {
        let kept = self.readable.iter().chain(&self.writable);
        let ruleset = Ruleset::default().handle_access(READ)?.create()?.add_rules(path_beneath_rules(kept, READ))?;
        enforce(ruleset.add_rules(path_beneath_rules([std::env::temp_dir()], AccessFs::ReadDir))?)
    }
}

/// How much of a sandbox the kernel of this machine enforces.
pub fn supported() -> Enforcement {
    // The thread restricts itself, and ends.
    let probe = std::thread::spawn(|| -> Result<Enforcement, SandboxError> {
        let ruleset = Ruleset::default().handle_access(AccessFs::from_all(NEWEST))?.scope(Scope::from_all(NEWEST))?;
        enforce(ruleset.handle_access(AccessNet::from_all(NEWEST))?.create()?)
    });
    probe.join().ok().and_then(Result::ok).unwrap_or(Enforcement::None)
}

/// The outcome of a step of the sandbox. After an error nothing counts as enforced, and the log has a line.
pub(crate) fn or_none(step: Result<Enforcement, SandboxError>) -> Enforcement {
    step.unwrap_or_else(|error| {
        tracing::warn!("the sandbox cannot be entered: {:#}", anyhow::Error::from(error));
        Enforcement::None
    })
}

/// Denies this thread, and those that it will start, sockets that connect to a socket in the file system, and all of the
/// internet where they are not needed.
fn deny_sockets(uses_network: bool) -> Result<(), SandboxError> {
    let is = |argument, value: i32| SeccompCondition::new(argument, Dword, SeccompCmpOp::Eq, value as u64);
    let mut denied = vec![SeccompRule::new(vec![is(0, libc::AF_UNIX)?])?];
    if !uses_network {
        denied.push(SeccompRule::new(vec![is(0, libc::AF_INET)?])?);
        denied.push(SeccompRule::new(vec![is(0, libc::AF_INET6)?])?);
    }
    // io_uring makes sockets as well, and connects them.
    let whole = [libc::SYS_io_uring_setup, libc::SYS_io_uring_setup | X32_BIT, libc::SYS_socket | X32_BIT];
    let mut rules: BTreeMap<i64, Vec<SeccompRule>> = whole.map(|call| (call, Vec::new())).into();
    rules.insert(libc::SYS_socket, denied);
    let denial = SeccompAction::Errno(libc::EACCES as u32);
    let filter = SeccompFilter::new(rules, SeccompAction::Allow, denial, std::env::consts::ARCH.try_into()?)?;
    let program: seccompiler::BpfProgram = filter.try_into()?;
    Ok(apply_filter(&program)?)
}

fn enforce(ruleset: RulesetCreated) -> Result<Enforcement, SandboxError> {
    let RestrictionStatus { ruleset, .. } = ruleset.restrict_self()?;
    Ok(match ruleset {
        RulesetStatus::FullyEnforced => Enforcement::Full,
        RulesetStatus::PartiallyEnforced => Enforcement::Partial,
        RulesetStatus::NotEnforced => Enforcement::None,
    })
}

#[cfg(test)]
mod tests {
    use std::io::{ErrorKind, Write};
    use std::net::{TcpListener, TcpStream, UdpSocket};
    use std::os::unix::net::{UnixDatagram, UnixListener, UnixStream};

    use serde_json::json;

    use super::*;
    use crate::namespace::Namespace;

    /// On a thread of its own, which alone is restricted.
    fn in_sandbox(description: OperatorDescription, params: Value, check: impl FnOnce() + Send + 'static) {
        if supported() != Enforcement::Full {
            // The test runner does not capture this, as it would capture what `eprintln!` writes.
            let line = b"SKIPPED sandbox: the kernel has no Landlock, or one older than Linux 6.12\n";
            return std::io::stderr().write_all(line).expect("said");
        }
        let name = format!("sandbox-{:?}", std::thread::current().id()).replace(['(', ')'], "");
        let namespace = Namespace::reserve(&format!("{name}-{}", std::process::id())).expect("reserved");
        let domain = namespace.wiring().clone();
        let restricted = std::thread::spawn(move || {
            let sandbox = Sandbox::new(std::iter::once((&description, params.as_object().expect("a map"))), &domain);
            assert_eq!(sandbox.enter().expect("entered"), Enforcement::Full);
            assert_eq!(sandbox.close().expect("closed"), Enforcement::Full);
            // It can still do its work.
            std::fs::write(format!("{}/own", domain.root_path), "own").expect("written to the graph's folder");
            std::fs::read_dir(std::env::temp_dir()).expect("the folder of graphs");
            check();
        });
        restricted.join().expect("no panic");
    }

    fn assert_denied<T>(outcome: std::io::Result<T>) {
        assert_eq!(outcome.err().map(|error| error.kind()), Some(ErrorKind::PermissionDenied));
    }

    #[test]
    fn a_stage_can_use_its_files_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        for name in ["model", "other"] {
            std::fs::write(at(name), "content").expect("written");
        }
        std::fs::create_dir(at("out")).expect("a folder");
        let description = OperatorDescription::new("mine", "")
            .param("model", ParamKind::Path { must_exist: true }, None, "")
            .param("out", ParamKind::Path { must_exist: false }, None, "");
        let params = json!({"model": at("model"), "out": at("out/log")});
        let port = TcpListener::bind("127.0.0.1:0").expect("a port");
        let launcher = at("launcher.sock");
        let _launcher = UnixListener::bind(&launcher).expect("bound");
        let path = folder.path().to_path_buf();
        in_sandbox(description, params, move || {
            assert_eq!(std::fs::read(path.join("model")).expect("its model"), b"content");
            std::fs::write(path.join("out/log"), "mine").expect("its output");
            assert_denied(std::fs::read(path.join("other")));
            assert_denied(std::fs::write(path.join("model"), "forged"));
            assert_denied(std::fs::write(path.join("new"), "new"));
            assert_denied(std::fs::remove_file(path.join("other")));
            assert_denied(std::process::Command::new("/bin/true").status());
            assert_denied(TcpStream::connect(port.local_addr().expect("an address")));
            assert_denied(TcpListener::bind("127.0.0.1:0"));
            assert_denied(UdpSocket::bind("127.0.0.1:0"));
            assert_denied(UnixStream::connect(&launcher));
            assert_denied(UnixDatagram::unbound());
            let parent = rustix::process::getppid().expect("a parent");
            assert!(rustix::process::test_kill_process(parent).is_err());
        });
    }

    #[test]
    fn an_operator_of_the_network_keeps_tcp_and_nothing_more() {
        let description = OperatorDescription::new("mine", "").uses_network();
        in_sandbox(description, json!({}), || {
            let port = TcpListener::bind("127.0.0.1:0").expect("a port");
            TcpStream::connect(port.local_addr().expect("an address")).expect("connected");
            assert_denied(UnixStream::connect("/run/launcher.sock"));
            assert_denied(std::process::Command::new("/bin/true").status());
            assert_denied(std::fs::read("/proc/self/environ"));
        });
    }
}
