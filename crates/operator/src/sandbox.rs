//! The sandbox of an operator process, which restricts itself with Landlock and a filter of system calls (seccomp).
//!
//! A process with a sandbox restricts itself twice. Before it begins, it gives up running programs, starting processes, the
//! network, writing files, signals to other processes, and all sockets, because one leads to the launcher, through which it
//! could have programs run. When it is ready and has read its files, it gives up reading any others. It keeps the graph's
//! memory, the files that its params name, and the network if its description says that it uses it.
//!
//! Landlock decides by the place of a file. It grants no process the making of links and pipes, so a process without a sandbox,
//! such as the launcher, meets none under a name that an operator could make. The filter of system calls names those that are
//! allowed (`calls`). Another process, namespace, keyring, memory of System V or right of a file is out of reach, and so is a
//! call that a newer kernel brings. A file that it makes is its user's alone, because it gives up changing the umask.
//!
//! Both restrict threads and those that they start. Threads that an operator starts before it is ready can read files for as
//! long as they live; the thread that listens to the launcher gives it up with its first command.

mod calls;

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, AccessNet, BitFlags, RestrictionStatus, Ruleset, RulesetAttr, RulesetCreated,
    RulesetCreatedAttr, RulesetError, RulesetStatus, Scope, make_bitflags, path_beneath_rules,
};
use rustix::fs::Mode;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit, umask};
use seccompiler::{apply_filter, apply_filter_all_threads};
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
/// The rights on a folder in which it may make files. Links and pipes are left out: a process without a sandbox would follow
/// them.
const WRITE: BitFlags<AccessFs> = make_bitflags!(AccessFs::{
    WriteFile | Truncate | IoctlDev | MakeReg | MakeDir | RemoveFile | RemoveDir
});
/// The last process of a graph removes what is in the graph's folder.
const REMOVE: BitFlags<AccessFs> = make_bitflags!(AccessFs::{RemoveFile | RemoveDir});
/// The rights of others on a file, none of which a file that an operator makes has.
const OTHERS: libc::mode_t = 0o077;
/// The families of sockets that an operator of the network needs: TCP, UDP, and the kernel's list of interfaces.
const NETWORK_FAMILIES: [i32; 3] = [libc::AF_INET, libc::AF_INET6, libc::AF_NETLINK];
/// The programs of other languages may start so many threads and processes beyond those that their user has.
const N_TASKS_OF_PROGRAM: u64 = 1024;

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
    /// Folders that it may read and write, and files.
    writable: Vec<PathBuf>,
    /// Its graph, if it uses the graph's memory.
    graph: Option<NamespaceWiring>,
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
        Sandbox::new_in(std::iter::once((description, params)), vec![NULL_DEVICE.into()], None)
    }

    /// Gives up writing files, the network, signals and sockets, for a program that is about to begin. It may read files and run
    /// programs, which have its rights.
    pub(crate) fn enter_program(&self) -> Result<Enforcement, SandboxError> {
        umask(Mode::from_raw_mode(OTHERS));
        limit_tasks();
        apply_filter(&calls::filter(calls::Role::Program, self.families())?)?;
        let rights = AccessFs::from_all(NEWEST) & !READ & !AccessFs::Execute;
        let mut ruleset = Ruleset::default().handle_access(rights)?.scope(Scope::from_all(NEWEST))?;
        if !self.uses_network {
            ruleset = ruleset.handle_access(AccessNet::from_all(NEWEST))?;
        }
        enforce(ruleset.create()?.add_rules(path_beneath_rules(&self.writable, WRITE))?)
    }

    /// The rights that the operators of a process need, each with its params: params of paths that must exist are read, others
    /// are written, with their folder.
    pub(crate) fn new<'a>(
        operators: impl Iterator<Item = (&'a OperatorDescription, &'a Map<String, Value>)>,
        domain: &NamespaceWiring,
    ) -> Self {
        Sandbox::new_in(operators, vec![domain.ports()], Some(domain.clone()))
    }

    fn new_in<'a>(
        operators: impl Iterator<Item = (&'a OperatorDescription, &'a Map<String, Value>)>,
        mut writable: Vec<PathBuf>,
        graph: Option<NamespaceWiring>,
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
        Sandbox { readable, writable, graph, uses_network, is_host }
    }

    /// Gives up all but reading files, for this thread and those that it will start.
    pub(crate) fn enter(&self) -> Result<Enforcement, SandboxError> {
        umask(Mode::from_raw_mode(OTHERS));
        let role = if self.is_host { calls::Role::Host } else { calls::Role::Operator };
        apply_filter(&calls::filter(role, self.families())?)?;
        let mut ruleset = Ruleset::default().handle_access(AccessFs::from_all(NEWEST) & !READ)?;
        if !self.is_host {
            ruleset = ruleset.scope(Scope::from_all(NEWEST))?;
        }
        if !self.uses_network {
            ruleset = ruleset.handle_access(AccessNet::from_all(NEWEST))?;
        }
        let ruleset = ruleset.create()?.add_rules(path_beneath_rules(&self.writable, WRITE))?;
        let folder = self.graph.as_ref().map(|graph| &graph.folder);
        let cursors = self.graph.as_ref().map(NamespaceWiring::cursors);
        let ruleset = ruleset.add_rules(path_beneath_rules(folder, REMOVE))?;
        // Without the right to truncate it: its other users would die.
        let ruleset = ruleset.add_rules(path_beneath_rules(cursors, AccessFs::WriteFile))?;
        // The graph's folder is in this one.
        enforce(ruleset.add_rules(path_beneath_rules([SHARED_MEMORY_FOLDER], AccessFs::RemoveDir))?)
    }

    /// The families of the sockets that it may make.
    fn families(&self) -> &'static [i32] {
        if self.uses_network { &NETWORK_FAMILIES } else { &[] }
    }

    /// Gives up reading other files than those that it keeps.
    pub(crate) fn close(&self) -> Result<Enforcement, SandboxError> {
        let kept = self.readable.iter().chain(&self.writable);
        let ruleset = Ruleset::default().handle_access(READ)?.create()?.add_rules(path_beneath_rules(kept, READ))?;
        enforce(
            ruleset.add_rules(path_beneath_rules(self.graph.as_ref().map(|graph| &graph.folder), AccessFs::ReadDir))?,
        )
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

/// Gives up running programs, starting processes and changing the rights of files, for all threads of a process that needs
/// files and sockets of all families and so has no sandbox.
///
/// # Errors
/// The kernel does not take the filter.
pub fn deny_programs() -> Result<(), SandboxError> {
    let families = [&NETWORK_FAMILIES[..], &[libc::AF_UNIX]].concat();
    Ok(apply_filter_all_threads(&calls::filter(calls::Role::Operator, &families)?)?)
}

/// Lets this process and those that it starts have no more than [`N_TASKS_OF_PROGRAM`] threads and processes beyond those
/// that their user has. The kernel does not hold the superuser to it.
fn limit_tasks() {
    let n_tasks = N_TASKS_OF_PROGRAM + n_tasks_of_user();
    let Rlimit { current, maximum } = getrlimit(Resource::Nproc);
    let [current, maximum] = [current, maximum].map(|limit| Some(limit.unwrap_or(n_tasks).min(n_tasks)));
    let _ = setrlimit(Resource::Nproc, Rlimit { current, maximum });
}

fn n_tasks_of_user() -> u64 {
    let uid = rustix::process::getuid().as_raw();
    let mut n_tasks = 0;
    for process in std::fs::read_dir("/proc").into_iter().flatten().flatten() {
        if process.metadata().is_ok_and(|metadata| metadata.uid() == uid) {
            n_tasks += std::fs::read_dir(process.path().join("task")).map_or(0, Iterator::count) as u64;
        }
    }
    n_tasks
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
    use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
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
            std::fs::write(domain.ports().join("own"), "own").expect("written to the graph's folder");
            std::fs::read_dir(&domain.folder).expect("the graph's folder");
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
        let program = File::open("/proc/self/exe").unwrap_or(open);
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
            assert_denied(outcome_of(unsafe { libc::syscall(i64::from(calls::FIRST_X32_CALL) + libc::SYS_getpid) }));
        }
    }

    /// Calls on other processes, and those that make names which a process without a sandbox would follow. Calls that no role
    /// needs are tried by their numbers.
    fn assert_others_are_out_of_reach(path: &Path, uses_network: bool) {
        let parent = rustix::process::getppid().expect("a parent").as_raw_nonzero().get();
        let limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
        // SAFETY: the calls read and write their arguments, which live on.
        unsafe {
            assert_denied(outcome_of(
                libc::prlimit(parent, libc::RLIMIT_CPU, &raw const limit, std::ptr::null_mut()).into(),
            ));
            assert_denied(outcome_of(libc::syscall(libc::SYS_sched_setaffinity, parent, 0, 0)));
            assert_denied(outcome_of(libc::syscall(libc::SYS_kill, parent, 0)));
            assert_denied(outcome_of(libc::syscall(libc::SYS_tgkill, parent, parent, 0)));
            assert_denied(outcome_of(libc::syscall(
                libc::SYS_clone,
                libc::CLONE_NEWUSER | libc::CLONE_THREAD,
                0,
                0,
                0,
                0,
            )));
            assert_denied(outcome_of(libc::syscall(libc::SYS_clone, libc::SIGCHLD, 0, 0, 0, 0)));
            assert_denied(outcome_of(libc::fcntl(0, libc::F_SETOWN, parent).into()));
            assert_denied(outcome_of(libc::syscall(libc::SYS_ioctl, 0, libc::TIOCSTI, 0)));
            assert_denied(outcome_of(libc::syscall(libc::SYS_prctl, libc::PR_SET_DUMPABLE, 1)));
            let allowed = calls::allowed(calls::Role::Operator, uses_network);
            for call in 0..N_CALLS {
                if allowed.contains(&call) || BY_ARGUMENTS.contains(&call) || UPROBE_CALLS.contains(&call) {
                    continue;
                }
                let error = outcome_of(libc::syscall(call, 0, 0, 0, 0, 0, 0)).expect_err("denied").raw_os_error();
                let expected = if call == libc::SYS_clone3 { libc::ENOSYS } else { libc::EACCES };
                assert_eq!(error, Some(expected), "call {call}");
            }
        }
        assert_denied(std::os::unix::fs::symlink("/etc/passwd", path.with_extension("link")));
        assert_denied(std::fs::hard_link(path, path.with_extension("hard")));
        // Others have no rights on its files and folders, whatever it asks for.
        let made = path.with_extension("made");
        drop(std::fs::OpenOptions::new().write(true).create_new(true).mode(0o666).open(&made).expect("its own file"));
        assert_eq!(std::fs::metadata(&made).expect("made").permissions().mode() & 0o077, 0);
        let folder = path.with_extension("folder");
        std::fs::DirBuilder::new().mode(0o777).create(&folder).expect("its own folder");
        assert_eq!(std::fs::metadata(&folder).expect("made").permissions().mode() & 0o077, 0);
    }

    /// The numbers of system calls of this and the next versions of Linux.
    const N_CALLS: i64 = 480;
    /// `uretprobe` and `uprobe` of x86-64, which the kernel makes for itself and which filters do not see.
    const UPROBE_CALLS: [i64; 2] = [335, 336];
    /// Calls that are allowed with some arguments.
    const BY_ARGUMENTS: [i64; 15] = [
        libc::SYS_socket,
        libc::SYS_socketpair,
        libc::SYS_fchmod,
        libc::SYS_ioctl,
        libc::SYS_fcntl,
        libc::SYS_openat,
        libc::SYS_open,
        libc::SYS_creat,
        libc::SYS_clone,
        libc::SYS_prctl,
        libc::SYS_prlimit64,
        libc::SYS_sched_setaffinity,
        libc::SYS_kill,
        libc::SYS_tgkill,
        libc::SYS_exit,
    ];

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
        let address = port.local_addr().expect("an address");
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
            assert_denied(TcpStream::connect(address));
            assert_denied(TcpListener::bind("127.0.0.1:0"));
            assert_denied(UdpSocket::bind("127.0.0.1:0"));
            assert_denied(UnixStream::connect(&launcher));
            assert_denied(UnixDatagram::unbound());
            // SAFETY: the call has no pointers.
            let netlink = unsafe { libc::syscall(libc::SYS_socket, libc::AF_NETLINK, libc::SOCK_RAW, 0) };
            assert_denied(outcome_of(netlink));
            assert_nothing_is_given_away(&path.join("out/own"));
            assert_others_are_out_of_reach(&path.join("out/own"), false);
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
            assert_others_are_out_of_reach(&path, true);
        });
        drop(folder);
    }
}
