//! The system calls that a process in a sandbox may make.
//!
//! All others are denied. A library that falls back on an older call when a newer one fails works as on an older kernel.

use std::collections::BTreeMap;

use seccompiler::SeccompCmpArgLen::Dword;
use seccompiler::{BpfProgram, SeccompAction, SeccompCmpOp, SeccompCondition, SeccompFilter, SeccompRule, sock_filter};

use super::SandboxError;

/// Calls that any operator may make with any arguments. They reach its own memory, threads and clocks, the files that Landlock
/// leaves it and the descriptors that it has.
#[rustfmt::skip]
const ALLOWED: &[i64] = &[
    // Memory.
    libc::SYS_brk, libc::SYS_mmap, libc::SYS_munmap, libc::SYS_mremap, libc::SYS_mprotect, libc::SYS_madvise, libc::SYS_msync,
    libc::SYS_mincore, libc::SYS_mlock, libc::SYS_munlock, libc::SYS_membarrier, libc::SYS_get_mempolicy,
    // Files. Their modes follow from the umask.
    libc::SYS_close, libc::SYS_close_range, libc::SYS_read, libc::SYS_write, libc::SYS_readv, libc::SYS_writev,
    libc::SYS_pread64, libc::SYS_pwrite64, libc::SYS_preadv, libc::SYS_pwritev, libc::SYS_lseek, libc::SYS_fstat,
    libc::SYS_newfstatat, libc::SYS_statx, libc::SYS_fstatfs, libc::SYS_statfs, libc::SYS_getdents64, libc::SYS_getcwd,
    libc::SYS_readlinkat, libc::SYS_faccessat, libc::SYS_faccessat2, libc::SYS_mkdirat, libc::SYS_unlinkat,
    libc::SYS_renameat, libc::SYS_renameat2, libc::SYS_ftruncate, libc::SYS_fallocate, libc::SYS_fadvise64, libc::SYS_fsync,
    libc::SYS_fdatasync, libc::SYS_flock, libc::SYS_dup, libc::SYS_dup3, libc::SYS_pipe2, libc::SYS_sendfile,
    libc::SYS_splice, libc::SYS_copy_file_range, libc::SYS_chdir, libc::SYS_fchdir,
    // Waiting.
    libc::SYS_ppoll, libc::SYS_pselect6, libc::SYS_epoll_create1, libc::SYS_epoll_ctl, libc::SYS_epoll_pwait,
    libc::SYS_epoll_pwait2, libc::SYS_eventfd2, libc::SYS_timerfd_create, libc::SYS_timerfd_settime,
    libc::SYS_timerfd_gettime, libc::SYS_signalfd4, libc::SYS_nanosleep, libc::SYS_clock_nanosleep, libc::SYS_futex,
    libc::SYS_futex_waitv, SYS_FUTEX_WAKE, SYS_FUTEX_WAIT, SYS_FUTEX_REQUEUE, libc::SYS_wait4, libc::SYS_waitid,
    libc::SYS_restart_syscall,
    // Time, and questions about this process and the machine.
    libc::SYS_clock_gettime, libc::SYS_clock_getres, libc::SYS_gettimeofday, libc::SYS_times, libc::SYS_getrusage,
    libc::SYS_setitimer, libc::SYS_getitimer, libc::SYS_getpid, libc::SYS_getppid, libc::SYS_gettid, libc::SYS_getpgid,
    libc::SYS_getsid, libc::SYS_getuid, libc::SYS_geteuid, libc::SYS_getgid, libc::SYS_getegid, libc::SYS_getresuid,
    libc::SYS_getresgid, libc::SYS_getgroups, libc::SYS_uname, libc::SYS_sysinfo, libc::SYS_getrandom, libc::SYS_getcpu,
    libc::SYS_getpriority, libc::SYS_sched_yield, libc::SYS_sched_getaffinity, libc::SYS_sched_getscheduler,
    libc::SYS_sched_getparam, libc::SYS_sched_get_priority_max, libc::SYS_sched_get_priority_min,
    // Its threads, its signals and its end.
    libc::SYS_set_tid_address, libc::SYS_set_robust_list, libc::SYS_rseq, libc::SYS_rt_sigaction, libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn, libc::SYS_rt_sigtimedwait, libc::SYS_sigaltstack, libc::SYS_exit, libc::SYS_exit_group,
    // It may restrict itself further.
    libc::SYS_landlock_create_ruleset, libc::SYS_landlock_add_rule, libc::SYS_landlock_restrict_self,
    // Both ends of a pair of sockets.
    libc::SYS_recvfrom,
];
/// Other names of these, which newer machines do not have.
#[cfg(target_arch = "x86_64")]
#[rustfmt::skip]
const ALLOWED_OLD: &[i64] = &[
    libc::SYS_stat, libc::SYS_lstat, libc::SYS_access, libc::SYS_readlink, libc::SYS_mkdir, libc::SYS_rmdir, libc::SYS_unlink,
    libc::SYS_rename, libc::SYS_getdents, libc::SYS_dup2, libc::SYS_pipe, libc::SYS_poll, libc::SYS_select,
    libc::SYS_epoll_create, libc::SYS_epoll_wait, libc::SYS_eventfd, libc::SYS_signalfd, libc::SYS_pause, libc::SYS_alarm,
    libc::SYS_time, libc::SYS_getpgrp, libc::SYS_arch_prctl,
];
#[cfg(not(target_arch = "x86_64"))]
const ALLOWED_OLD: &[i64] = &[];
/// Calls of Linux 6.7, which have the same numbers on all machines.
const SYS_FUTEX_WAKE: i64 = 454;
const SYS_FUTEX_WAIT: i64 = 455;
const SYS_FUTEX_REQUEUE: i64 = 456;
/// Calls on sockets of a network.
const NETWORK_CALLS: &[i64] = &[
    libc::SYS_connect,
    libc::SYS_bind,
    libc::SYS_listen,
    libc::SYS_accept,
    libc::SYS_accept4,
    libc::SYS_shutdown,
    libc::SYS_sendmmsg,
    libc::SYS_recvmmsg,
    libc::SYS_getsockname,
    libc::SYS_getpeername,
    libc::SYS_setsockopt,
    libc::SYS_getsockopt,
];
/// A pair of sockets needs them as well. None of the sockets of an operator without a network has an address to send to.
const MESSAGE_CALLS: &[i64] = &[libc::SYS_sendto, libc::SYS_sendmsg, libc::SYS_recvmsg];
/// A program that is about to begin, and one that starts others.
const PROGRAM_CALLS: &[i64] =
    &[libc::SYS_execve, libc::SYS_execveat, libc::SYS_kill, libc::SYS_setpgid, libc::SYS_setsid];
#[cfg(target_arch = "x86_64")]
const OLD_PROGRAM_CALLS: &[i64] = &[libc::SYS_fork, libc::SYS_vfork];
#[cfg(not(target_arch = "x86_64"))]
const OLD_PROGRAM_CALLS: &[i64] = &[];
/// Flags of `clone` that make namespaces, in which a process could have more rights.
const NAMESPACE_FLAGS: i32 = libc::CLONE_NEWNS
    | libc::CLONE_NEWCGROUP
    | libc::CLONE_NEWUTS
    | libc::CLONE_NEWIPC
    | libc::CLONE_NEWUSER
    | libc::CLONE_NEWPID
    | libc::CLONE_NEWNET;
/// What a thread may change and ask of itself.
const PRCTL_OPTIONS: &[i32] = &[
    libc::PR_SET_NAME,
    libc::PR_GET_NAME,
    libc::PR_SET_PDEATHSIG,
    libc::PR_GET_DUMPABLE,
    libc::PR_SET_NO_NEW_PRIVS,
    libc::PR_GET_NO_NEW_PRIVS,
    libc::PR_SET_VMA,
    libc::PR_SET_TIMERSLACK,
    libc::PR_CAPBSET_READ,
];
/// Requests that type into a terminal, or have signals sent to another process.
const DENIED_IOCTLS: [u64; 5] = [libc::TIOCSTI, libc::TIOCLINUX, libc::TIOCCONS, FIOSETOWN, SIOCSPGRP];
const FIOSETOWN: u64 = 0x8901;
const SIOCSPGRP: u64 = 0x8902;
/// Commands on a descriptor that have signals sent to another process.
const DENIED_FCNTLS: [i32; 4] = [libc::F_SETOWN, F_SETOWN_EX, F_SETSIG, libc::F_NOTIFY];
const F_SETSIG: i32 = 10;
const F_SETOWN_EX: i32 = 15;
/// A file with such a mode could be run with its user's rights by others (set-user-ID, set-group-ID).
const SET_ID_BITS: u32 = libc::S_ISUID | libc::S_ISGID;
/// Bits of a mode that an open file must not get: those above, and rights of other users. iceoryx2 lets the group read its
/// folders, which lie in a folder of the user alone.
const FOREIGN_BITS: u32 = SET_ID_BITS | libc::S_IWGRP | libc::S_IRWXO;
/// System calls from this number on belong to the x32 ABI of x86-64, which has each call under another number.
pub(super) const FIRST_X32_CALL: u32 = 0x4000_0000;

/// What a process in a sandbox is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Operator,
    /// It ends a program, which it has started before.
    Host,
    /// A program of another language. It may start others, which have its rights.
    Program,
}

/// A filter that allows the calls of a role and sockets of these families. Other calls fail with EACCES.
pub(super) fn filter(role: Role, families: &[i32]) -> Result<BpfProgram, SandboxError> {
    // A call without rules is allowed whatever its arguments are.
    let mut rules: BTreeMap<i64, Vec<SeccompRule>> = BTreeMap::new();
    for call in allowed(role, !families.is_empty()) {
        rules.insert(call, Vec::new());
    }
    rules.extend(sockets(families)?);
    rules.extend(files()?);
    rules.extend(processes(role)?);
    let denial = SeccompAction::Errno(libc::EACCES as u32);
    let filter = SeccompFilter::new(rules, denial, SeccompAction::Allow, std::env::consts::ARCH.try_into()?)?;
    Ok(with_prelude(filter.try_into()?))
}

/// The calls that a process may make with any arguments.
pub(super) fn allowed(role: Role, uses_network: bool) -> Vec<i64> {
    let mut calls = [ALLOWED, ALLOWED_OLD, MESSAGE_CALLS].concat();
    if uses_network {
        calls.extend(NETWORK_CALLS);
    }
    match role {
        Role::Operator => {}
        Role::Host => calls.push(libc::SYS_kill),
        Role::Program => calls.extend([PROGRAM_CALLS, OLD_PROGRAM_CALLS].concat()),
    }
    calls
}

type Rules = Vec<(i64, Vec<SeccompRule>)>;

fn sockets(families: &[i32]) -> Result<Rules, SandboxError> {
    let pair = all(vec![equal(0, libc::AF_UNIX)?, masked(1, 0xf, libc::SOCK_STREAM as u64)?])?;
    let mut rules = vec![(libc::SYS_socketpair, vec![pair])];
    if !families.is_empty() {
        rules.push((libc::SYS_socket, one_of(0, families)?));
    }
    Ok(rules)
}

fn files() -> Result<Rules, SandboxError> {
    let no_foreign_bits = all(vec![masked(1, FOREIGN_BITS.into(), 0)?])?;
    let mut rules = vec![
        (libc::SYS_fchmod, vec![no_foreign_bits]),
        (libc::SYS_ioctl, none_of(1, &DENIED_IOCTLS)?),
        (libc::SYS_fcntl, none_of(1, &DENIED_FCNTLS.map(|command| command as u64))?),
        (libc::SYS_openat, opening(2)?),
    ];
    #[cfg(target_arch = "x86_64")]
    rules.push((libc::SYS_open, opening(1)?));
    #[cfg(target_arch = "x86_64")]
    rules.push((libc::SYS_creat, vec![all(vec![masked(1, SET_ID_BITS.into(), 0)?])?]));
    Ok(rules)
}

/// A call that makes no file, or one without [`SET_ID_BITS`]. The mode comes after the flags, and is something else where no
/// file is made.
fn opening(flags: u8) -> Result<Vec<SeccompRule>, SandboxError> {
    let makes = libc::O_CREAT | (libc::O_TMPFILE & !libc::O_DIRECTORY);
    let makes_none = all(vec![masked(flags, makes as u64, 0)?])?;
    Ok(vec![makes_none, all(vec![masked(flags + 1, SET_ID_BITS.into(), 0)?])?])
}

fn processes(role: Role) -> Result<Rules, SandboxError> {
    let its_own = std::process::id();
    let group = rustix::process::getpgrp().as_raw_nonzero().get();
    let mut cloning = vec![masked(0, NAMESPACE_FLAGS as u64, 0)?];
    if role != Role::Program {
        cloning.push(masked(0, libc::CLONE_THREAD as u64, libc::CLONE_THREAD as u64)?);
    }
    let mut rules = vec![
        (libc::SYS_clone, vec![all(cloning)?]),
        (libc::SYS_prctl, one_of(0, PRCTL_OPTIONS)?),
        (libc::SYS_prlimit64, one_of(0, &[0])?),
        (libc::SYS_sched_setaffinity, one_of(0, &[0])?),
    ];
    match role {
        // It ends its process group after a launcher that died.
        Role::Operator => {
            rules.push((libc::SYS_kill, one_of(0, &[its_own as i32, -group])?));
            rules.push((libc::SYS_tgkill, one_of(0, &[its_own as i32])?));
        }
        // Landlock holds their signals within their scope.
        Role::Host | Role::Program => rules.push((libc::SYS_tgkill, Vec::new())),
    }
    Ok(rules)
}

fn all(conditions: Vec<SeccompCondition>) -> Result<SeccompRule, SandboxError> {
    Ok(SeccompRule::new(conditions)?)
}

fn equal(argument: u8, value: i32) -> Result<SeccompCondition, SandboxError> {
    Ok(SeccompCondition::new(argument, Dword, SeccompCmpOp::Eq, u64::from(value as u32))?)
}

fn masked(argument: u8, mask: u64, value: u64) -> Result<SeccompCondition, SandboxError> {
    Ok(SeccompCondition::new(argument, Dword, SeccompCmpOp::MaskedEq(mask), value)?)
}

fn one_of(argument: u8, values: &[i32]) -> Result<Vec<SeccompRule>, SandboxError> {
    values.iter().map(|value| all(vec![equal(argument, *value)?])).collect()
}

fn none_of(argument: u8, values: &[u64]) -> Result<Vec<SeccompRule>, SandboxError> {
    let mut others = Vec::new();
    for value in values {
        others.push(SeccompCondition::new(argument, Dword, SeccompCmpOp::Ne, *value)?);
    }
    Ok(vec![all(others)?])
}

/// The filter behind two rules that it cannot have. Calls of the x32 ABI fail with EACCES. `clone3`, whose flags lie behind a
/// pointer that a filter cannot follow, fails as on a kernel without it, so that libraries call `clone`.
fn with_prelude(filter: BpfProgram) -> BpfProgram {
    let statement = |code: u32, k: u32, jf: u8| sock_filter { code: code as u16, jt: 0, jf, k };
    let failure = |error: i32| SeccompAction::Errno(error as u32).into();
    // The number of the call is the first field of `seccomp_data`.
    let number = statement(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0);
    let is_x32 = statement(libc::BPF_JMP | libc::BPF_JGE | libc::BPF_K, FIRST_X32_CALL, 1);
    let deny = statement(libc::BPF_RET | libc::BPF_K, failure(libc::EACCES), 0);
    let is_clone3 = statement(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, libc::SYS_clone3 as u32, 1);
    let unknown = statement(libc::BPF_RET | libc::BPF_K, failure(libc::ENOSYS), 0);
    [vec![number, is_x32, deny, is_clone3, unknown], filter].concat()
}
