//! The sandbox of an operator process, which restricts itself with Landlock and a filter of system calls (seccomp).
//!
//! A process with a sandbox restricts itself twice. Before it begins, it gives up running programs, the network, writing files,
//! changing the rights, owner and times of files, signals to other processes, and all sockets, because one leads to the launcher,
//! through which it could have programs run. When it is ready and has read its files, it gives up reading any others. It keeps
//! the graph's shared memory and folder, the files that its params name, and the network if its description says that it uses
//! it.
//!
//! Landlock decides by the place of a file. It has no rights for sockets other than TCP, for programs in memory or for the mode
//! and owner of files, so the filter denies these (`DENIED_CALLS`). The filter names what is denied, not what is allowed:
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
use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpOp, SeccompCondition, SeccompFilter, SeccompRule, apply_filter,
    apply_filter_all_threads, sock_filter,
};
use serde_json::{Map, Value};

use crate::description::OperatorDescription;
use crate::namespace::SHARED_MEMORY_FOLDER;
use crate::namespace::graphs_folder;
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
/// System calls from this number on belong to the x32 ABI of x86-64, which has each call under another number.
const FIRST_X32_CALL: u32 = 0x4000_0000;
/// System calls that no operator needs. Those with which it would give others rights on a file of its user, or take them from
/// its user; those that hide from this filter what they do; and those that make files which are neither regular nor folders.
const DENIED_CALLS: [i64; 17] = [
    libc::SYS_fchmodat,
    SYS_FCHMODAT2,
    libc::SYS_fchown,
    libc::SYS_fchownat,
    libc::SYS_setxattr,
    libc::SYS_lsetxattr,
    libc::SYS_fsetxattr,
    SYS_SETXATTRAT,
    libc::SYS_removexattr,
    libc::SYS_lremovexattr,
    libc::SYS_fremovexattr,
    SYS_REMOVEXATTRAT,
    SYS_FILE_SETATTR,
    libc::SYS_utimensat,
    libc::SYS_mknodat,
    // Its mode lies behind a pointer, which a filter cannot follow.
    libc::SYS_openat2,
    libc::SYS_io_uring_setup,
];
/// The older forms of these calls, which newer machines do not have.
#[cfg(target_arch = "x86_64")]
const DENIED_OLD_CALLS: [i64; 7] = [
    libc::SYS_chmod,
    libc::SYS_chown,
    libc::SYS_lchown,
    libc::SYS_utime,
    libc::SYS_utimes,
    libc::SYS_futimesat,
    libc::SYS_mknod,
];
#[cfg(not(target_arch = "x86_64"))]
const DENIED_OLD_CALLS: [i64; 0] = [];
/// Calls of Linux 6.6, 6.13 and 6.17, which have the same numbers on all machines.
const SYS_FCHMODAT2: i64 = 452;
const SYS_SETXATTRAT: i64 = 463;
const SYS_REMOVEXATTRAT: i64 = 466;
const SYS_FILE_SETATTR: i64 = 469;
const PROGRAM_CALLS: [i64; 2] = [libc::SYS_execve, libc::SYS_execveat];
/// The families of sockets that an operator of the network needs: TCP, UDP, and the kernel's list of interfaces.
const NETWORK_FAMILIES: [i32; 3] = [libc::AF_INET, libc::AF_INET6, libc::AF_NETLINK];
/// Types of pairs of sockets of which one end can be connected to another process's socket.
const DATAGRAM_TYPES: [i32; 2] = [libc::SOCK_DGRAM, libc::SOCK_RAW];
/// The type of a socket in an argument that has flags as well.
const SOCKET_TYPE_MASK: u64 = 0xf;
/// A file with such a mode could be run with its user's rights by others (set-user-ID, set-group-ID).
const SET_ID_BITS: [libc::mode_t; 2] = [libc::S_ISUID, libc::S_ISGID];
/// Bits of a mode that an open file must not get: those above, and rights of other users. iceoryx2 lets the group read its
/// folders, which lie in a folder of the user alone.
const FOREIGN_BITS: [libc::mode_t; 6] =
    [libc::S_ISUID, libc::S_ISGID, libc::S_IWGRP, libc::S_IROTH, libc::S_IWOTH, libc::S_IXOTH];

/// Why a sandbox cannot be entered.
#[derive(Debug, thiserror::Error)]
pub enum SandboxError {
    /// The rights of files, TCP, signals and abstract sockets.
    #[error(transparent)]
    Landlock(#[from] RulesetError),
    /// The filter of system calls cannot be built for this machine.
    #[error("the filter of system calls is not taken")]
    Filter(#[from] seccompiler::BackendError),
    /// The kernel does not take the filter.
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
        apply_filter(&calls_without(&[], self.families())?)?;
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
        apply_filter(&calls_without(&PROGRAM_CALLS, self.families())?)?;
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
        enforce(ruleset.add_rules(path_beneath_rules([graphs_folder()], AccessFs::RemoveDir))?)
    }

    /// The families of the sockets that it may make.
    fn families(&self) -> &'static [i32] {
        if self.uses_network { &NETWORK_FAMILIES } else { &[] }
    }

    /// Gives up reading other files than those that it keeps.
    pub(crate) fn close(&self) -> Result<Enforcement, SandboxError> {
        let kept = self.readable.iter().chain(&self.writable);
        let ruleset = Ruleset::default().handle_access(READ)?.create()?.add_rules(path_beneath_rules(kept, READ))?;
        enforce(ruleset.add_rules(path_beneath_rules([graphs_folder()], AccessFs::ReadDir))?)
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

/// Gives up running programs and changing the rights of files, for all threads of a process that needs sockets of all families
/// and so has no sandbox.
///
/// # Errors
/// The kernel does not take the filter.
pub fn deny_programs() -> Result<(), SandboxError> {
    let families = [&NETWORK_FAMILIES[..], &[libc::AF_UNIX]].concat();
    Ok(apply_filter_all_threads(&calls_without(&PROGRAM_CALLS, &families)?)?)
}

/// A filter that denies `DENIED_CALLS`, `denied` and all sockets but those of some families.
fn calls_without(denied: &[i64], families: &[i32]) -> Result<BpfProgram, SandboxError> {
    let masked =
        |argument, mask: u64, value: u64| SeccompCondition::new(argument, Dword, SeccompCmpOp::MaskedEq(mask), value);
    let whole = [&DENIED_CALLS[..], &DENIED_OLD_CALLS, denied].concat();
    // A call without rules is denied whatever its arguments are.
    let mut rules: BTreeMap<i64, Vec<SeccompRule>> = whole.into_iter().map(|call| (call, Vec::new())).collect();

    let is_another = |family: &i32| SeccompCondition::new(0, Dword, SeccompCmpOp::Ne, *family as u64);
    let other_families: Vec<SeccompCondition> = families.iter().map(is_another).collect::<Result<_, _>>()?;
    rules.insert(
        libc::SYS_socket,
        if families.is_empty() { Vec::new() } else { vec![SeccompRule::new(other_families)?] },
    );

    let mut pairs = Vec::new();
    for kind in DATAGRAM_TYPES {
        pairs.push(SeccompRule::new(vec![masked(1, SOCKET_TYPE_MASK, kind as u64)?])?);
    }
    rules.insert(libc::SYS_socketpair, pairs);

    let mut modes = Vec::new();
    for bit in FOREIGN_BITS.map(u64::from) {
        modes.push(SeccompRule::new(vec![masked(1, bit, bit)?])?);
    }
    rules.insert(libc::SYS_fchmod, modes);

    // Each call that makes a file, with the positions of its flags and of its mode.
    #[cfg(target_arch = "x86_64")]
    let making = [(libc::SYS_openat, Some(2), 3), (libc::SYS_open, Some(1), 2), (libc::SYS_creat, None, 1)];
    #[cfg(not(target_arch = "x86_64"))]
    let making = [(libc::SYS_openat, Some(2), 3)];
    for (call, flags, mode) in making {
        let mut rules_of_call = Vec::new();
        for bit in SET_ID_BITS.map(u64::from) {
            let has_bit = masked(mode, bit, bit)?;
            let Some(flags) = flags else {
                rules_of_call.push(SeccompRule::new(vec![has_bit])?);
                continue;
            };
            // Without these flags, the argument of the mode is what happened to be in the register.
            for makes in [libc::O_CREAT, libc::O_TMPFILE & !libc::O_DIRECTORY].map(|flag| flag as u64) {
                rules_of_call.push(SeccompRule::new(vec![masked(flags, makes, makes)?, has_bit.clone()])?);
            }
        }
        rules.insert(call, rules_of_call);
    }

    let denial = SeccompAction::Errno(libc::EACCES as u32);
    let filter = SeccompFilter::new(rules, SeccompAction::Allow, denial.clone(), std::env::consts::ARCH.try_into()?)?;
    let filter: BpfProgram = filter.try_into()?;
    Ok(without_x32(denial.into(), filter))
}

/// A filter that denies all calls of the x32 ABI, and passes the others on.
fn without_x32(denial: u32, filter: BpfProgram) -> BpfProgram {
    let statement = |code: u32, k: u32, jf: u8| sock_filter { code: code as u16, jt: 0, jf, k };
    // The number of the call is the first field of `seccomp_data`.
    let number = statement(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0);
    let is_x32 = statement(libc::BPF_JMP | libc::BPF_JGE | libc::BPF_K, FIRST_X32_CALL, 1);
    let deny = statement(libc::BPF_RET | libc::BPF_K, denial, 0);
    [vec![number, is_x32, deny], filter].concat()
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
    use std::fs::{File, Permissions};
    use std::io::{ErrorKind, Write};
    use std::net::{TcpListener, TcpStream, UdpSocket};
    use std::os::fd::AsRawFd;
    use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
    use std::os::unix::net::{UnixDatagram, UnixListener, UnixStream};

    use rustix::fs::{CWD, FileType, Mode};
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

    /// The outcome of a system call that libraries do not make.
    fn outcome_of(returned: i64) -> std::io::Result<()> {
        if returned < 0 { Err(std::io::Error::last_os_error()) } else { Ok(()) }
    }

    /// Calls that neither a stage nor an operator of the network may make, on a file of its user.
    fn assert_nothing_is_given_away(path: &Path) {
        let open =
            File::options().read(true).write(true).create(true).truncate(false).open(path).expect("its own file");
        let mut made_set_id = std::fs::OpenOptions::new();
        assert_denied(made_set_id.write(true).create(true).mode(0o4600).open(path.with_extension("set-id")));
        for mode in [0o4700, 0o2700, 0o644, 0o620, 0o604] {
            assert_denied(open.set_permissions(Permissions::from_mode(mode)));
        }
        open.set_permissions(Permissions::from_mode(0o600)).expect("as iceoryx2 does");
        assert_denied(std::fs::set_permissions(path, Permissions::from_mode(0o600)));
        assert_denied(open.set_modified(std::time::SystemTime::now()));
        let (uid, gid) = (rustix::process::getuid().as_raw(), rustix::process::getgid().as_raw());
        assert_denied(std::os::unix::fs::chown(path, Some(uid), Some(gid)));
        assert_denied(std::os::unix::fs::fchown(&open, Some(uid), Some(gid)));
        let name = c"user.blindgrasp";
        assert_denied(rustix::fs::fsetxattr(&open, name, b"", rustix::fs::XattrFlags::empty()).map_err(Into::into));
        assert_denied(
            rustix::fs::mknodat(CWD, path.with_extension("fifo"), FileType::Fifo, Mode::RWXU, 0).map_err(Into::into),
        );
        let program = rustix::fs::memfd_create("program", rustix::fs::MemfdFlags::empty()).expect("memory");
        // SAFETY: the call reads its arguments, which live on; if it were allowed, the test would end.
        let executed = unsafe {
            libc::syscall(
                libc::SYS_execveat,
                program.as_raw_fd(),
                c"".as_ptr(),
                [std::ptr::null::<u8>()].as_ptr(),
                [std::ptr::null::<u8>()].as_ptr(),
                libc::AT_EMPTY_PATH,
            )
        };
        assert_denied(outcome_of(executed));
        for family in
            [libc::AF_UNIX, libc::AF_PACKET, libc::AF_CAN, libc::AF_ALG, libc::AF_VSOCK, libc::AF_LLC, libc::AF_XDP]
        {
            // SAFETY: the call has no pointers.
            assert_denied(outcome_of(unsafe { libc::syscall(libc::SYS_socket, family, libc::SOCK_STREAM, 0) }));
        }
        UnixStream::pair().expect("it reaches nobody");
        assert_denied(UnixDatagram::pair());
        #[cfg(target_arch = "x86_64")]
        {
            // SAFETY: the call has no pointers.
            assert_denied(outcome_of(unsafe { libc::syscall(i64::from(FIRST_X32_CALL) + libc::SYS_getpid) }));
        }
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
            // SAFETY: the call has no pointers.
            let netlink = unsafe { libc::syscall(libc::SYS_socket, libc::AF_NETLINK, libc::SOCK_RAW, 0) };
            assert_denied(outcome_of(netlink));
            assert_nothing_is_given_away(&path.join("out/own"));
            let parent = rustix::process::getppid().expect("a parent");
            assert!(rustix::process::test_kill_process(parent).is_err());
        });
    }

    #[test]
    fn an_operator_of_the_network_keeps_tcp_and_nothing_more() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("own");
        let description = OperatorDescription::new("mine", "").uses_network().param(
            "out",
            ParamKind::Path { must_exist: false },
            None,
            "",
        );
        in_sandbox(description, json!({"out": path}), move || {
            let port = TcpListener::bind("127.0.0.1:0").expect("a port");
            TcpStream::connect(port.local_addr().expect("an address")).expect("connected");
            assert_denied(UnixStream::connect("/run/launcher.sock"));
            assert_denied(std::process::Command::new("/bin/true").status());
            assert_denied(std::fs::read("/proc/self/environ"));
            UdpSocket::bind("127.0.0.1:0").expect("UDP");
            // SAFETY: the call has no pointers.
            let netlink = unsafe { libc::syscall(libc::SYS_socket, libc::AF_NETLINK, libc::SOCK_RAW, 0) };
            outcome_of(netlink).expect("the list of interfaces");
            assert_nothing_is_given_away(&path);
        });
        drop(folder);
    }
}
