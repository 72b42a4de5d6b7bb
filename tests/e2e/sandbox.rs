//! Operators that give up what their work does not need, and those that are given little memory.

use std::path::Path;
use std::process::Command;

use blindgrasp_operator::sandbox::supported;
use blindgrasp_operator::wiring::Enforcement;

use crate::common::{
    FAST_FOREVER, Graph, HAND, MODEL, NODES, REPORTS, blindgrasp, classifier_runs, dataflow, dataflow_with, of_node,
    operator, project, run, script, skipped, stubborn_classifier, swap, text, unique_name, wait_until,
};

/// What the intruder tries.
const ATTEMPTS: [&str; 6] = ["run a program", "read a file", "write a file", "listen", "connect", "reach a launcher"];

fn intruder() -> (String, String) {
    classifier_runs(&stubborn_classifier(), "{intrudes: true}")
}

/// Waits until the intruder has said this of each attempt.
fn wait_for_each(graph: &Graph, outcome: &str) {
    let said = |what: &&str| graph.said().contains(&format!("[classifier] {what}: {outcome}"));
    wait_until(|| ATTEMPTS.iter().all(&said), || format!("expected {outcome}: {}", graph.said()));
}

#[test]
fn an_operator_in_a_sandbox_can_do_nothing_but_its_work() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow_with(folder.path(), &[intruder()]), &FAST_FOREVER);
    wait_for_each(&graph, "PermissionDenied");
    // It is supervised, set, swapped and recorded as ever, and so is its replacement.
    graph.kill("classifier");
    run(&["set", "lift_arbiter.votes=4", "--graph", &graph.name], 0);
    run(&["set", "recorded_source.rate=8", "--graph", &graph.name], 0);
    let model = format!("model={MODEL}");
    swap(&graph, &["classifier", "--run", "classifier", "--set", &model, "--probation", "0.1"], 0);
    swap(&graph, &["recorded_source", "--probation", "0.1"], 0);
    let recording = folder.path().join("some.mcap");
    run(&["record", &graph.name, "--for", "0.3", "--out", recording.to_str().expect("UTF-8")], 0);
    // The recording is opened again for its second repetition.
    graph.wait_for_decisions(150);
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
}

/// A library that is loaded into each operator. When the operator has reported that it is ready, it tries on the operator's
/// main thread to reach other processes and to make files that they would follow.
const ESCAPE: &str = r#"
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/msg.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/xattr.h>
#include <unistd.h>

static void try(const char *what, long outcome) {
    char line[128];
    int n = snprintf(line, sizeof line, "%s: %s\n", what, outcome >= 0 ? "done" : errno == EACCES ? "denied" : strerror(errno));
    syscall(SYS_write, 2, line, n);
}

static char place[400];

static const char *in(const char *name) {
    static char paths[2][500];
    static int turn;
    turn = !turn;
    snprintf(paths[turn], sizeof paths[turn], "%s/%s", place, name);
    return paths[turn];
}

static int make(const char *name) {
    return open(in(name), O_CREAT | O_RDWR, 0666);
}

ssize_t write(int fd, const void *bytes, size_t n) {
    static int has_tried;
    ssize_t outcome = syscall(SYS_write, fd, bytes, n);
    const char *wiring = getenv("BLINDGRASP_WIRING");
    if (has_tried || !wiring || !memmem(bytes, n, "\"report\":\"ready\"", 16)) return outcome;
    has_tried = 1;
    int error = errno;
    sscanf(strstr(wiring, "\"folder\":\"") + 10, "%390[^\"]", place);
    char *const nothing[] = {0};
    struct rlimit limit = {0, 0};
    struct stat found;
    cpu_set_t cpus;
    CPU_SET(0, &cpus);
    pid_t launcher = getppid();
    /* The operators of the graph share the folder. */
    char own_name[32];
    snprintf(own_name, sizeof own_name, "ports/own%d", getpid());
    int own = make(own_name);
    try("own file", own);
    fstat(own, &found);
    try("file with rights for others", found.st_mode & 077 ? 0 : (errno = EACCES, -1));
    mkdir(in("ports/folder"), 0777);
    stat(in("ports/folder"), &found);
    try("folder with rights for others", found.st_mode & 077 ? 0 : (errno = EACCES, -1));
    try("set-user-ID file", open(in("ports"), O_TMPFILE | O_RDWR, 04700));
    try("file in the graph's folder", make("new"));
    try("file in the link's folder", make("link/spool_new.partial"));
    try("file in shared memory", open("/dev/shm/blindgrasp_new", O_CREAT | O_RDWR, 0600));
    try("link", symlink("/etc/passwd", in("ports/link")));
    try("hard link", link(in("cursors"), in("ports/hard")));
    try("pipe", mkfifo(in("ports/pipe"), 0600));
    try("move out", rename(in(own_name), "/dev/shm/blindgrasp_own"));
    try("move to the link", rename(in(own_name), in("link/own")));
    try("replace the slots", rename(in(own_name), in("cursors")));
    try("truncate the slots", truncate(in("cursors"), 0));
    try("umask", syscall(SYS_umask, 0));
    try("fchmod 4700", fchmod(own, 04700));
    try("fchmod 0644", fchmod(own, 0644));
    try("fchmod 0600", fchmod(own, 0600));
    try("chmod", chmod(place, 0777));
    try("fchmodat", fchmodat(AT_FDCWD, place, 0777, 0));
    try("chown", chown(place, -1, -1));
    try("fchown", fchown(own, -1, -1));
    try("setxattr", fsetxattr(own, "user.some", "", 0, 0));
    try("utimensat", futimens(own, NULL));
    try("execve", execve("/bin/true", nothing, nothing));
    try("execveat", syscall(SYS_execveat, own, "", nothing, nothing, AT_EMPTY_PATH));
    try("program in memory", syscall(SYS_memfd_create, "program", 0));
    try("fork", syscall(SYS_clone, SIGCHLD, 0, 0, 0, 0));
    try("kill", kill(launcher, 0));
    try("limit", prlimit(launcher, RLIMIT_CPU, &limit, NULL));
    try("processors", sched_setaffinity(launcher, sizeof cpus, &cpus));
    try("priority", setpriority(PRIO_PROCESS, launcher, 19));
    try("input and output priority", syscall(SYS_ioprio_set, 1, launcher, 0));
    try("read memory", syscall(SYS_process_vm_readv, launcher, NULL, 0, NULL, 0, 0));
    try("process descriptor", syscall(SYS_pidfd_open, launcher, 0));
    try("owner of signals", fcntl(own, F_SETOWN, launcher));
    try("namespace", unshare(CLONE_NEWUSER));
    try("keyring", syscall(SYS_keyctl, 0, -4, 0));
    try("System V memory", shmget(IPC_PRIVATE, 1, IPC_CREAT | 0666));
    try("System V messages", msgget(IPC_PRIVATE, IPC_CREAT | 0666));
    try("traced by others", prctl(PR_SET_DUMPABLE, 1));
    try("io_uring", syscall(SYS_io_uring_setup, 1, NULL));
    try("userfaultfd", syscall(SYS_userfaultfd, 0));
    try("inotify", syscall(SYS_inotify_init1, 0));
    try("socket UNIX", socket(AF_UNIX, SOCK_STREAM, 0));
    try("socket INET", socket(AF_INET, SOCK_STREAM, 0));
    try("socket NETLINK", socket(AF_NETLINK, SOCK_RAW, 0));
    try("socket CAN", socket(AF_CAN, SOCK_RAW, 0));
    try("socket VSOCK", socket(AF_VSOCK, SOCK_STREAM, 0));
    rmdir(in("ports/folder"));
    unlink(in(own_name));
    try("last", 0);
    errno = error;
    return outcome;
}
"#;

#[test]
fn no_shipped_operator_reaches_another_process_or_a_name_that_one_follows() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    if Command::new("cc").arg("--version").output().is_err() {
        return skipped("there is no C compiler");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let source = folder.path().join("escape.c");
    let library = folder.path().join("escape.so");
    std::fs::write(&source, ESCAPE).expect("written");
    let compiled = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&library).arg(&source).output();
    let compiled = compiled.expect("started");
    assert!(compiled.status.success(), "{}", text(&compiled.stderr));

    let try_in = |flow: &Path, arguments: &[&str], nodes: &[&str], expected: &[&str]| {
        let mut command = blindgrasp();
        command.env("LD_PRELOAD", &library);
        let graph = Graph::launch_on(command, &unique_name(), flow, arguments);
        for node in nodes {
            wait_until(|| graph.said().contains(&format!("[{node}] last: done")), || graph.said());
            let said = graph.said();
            let of_node = said.lines().filter_map(|line| Some(line.split_once(&format!("[{node}] "))?.1));
            let outcomes: Vec<&str> =
                of_node.filter(|line| line.ends_with(": done") || line.ends_with(": denied")).collect();
            let done: Vec<&str> = outcomes.iter().filter_map(|line| line.strip_suffix(": done")).collect();
            assert_eq!(done, expected, "{node}");
            let n_tried = ESCAPE.matches("    try(\"").count();
            assert_eq!(outcomes.len(), n_tried, "{node}: {said}");
        }
    };
    try_in(&dataflow(folder.path(), &[]), &FAST_FOREVER, &NODES, &["own file", "fchmod 0600", "last"]);
    let flow = folder.path().join("network.yaml");
    let node =
        format!("{{sandbox: required, params: {{hand: {}/{HAND}, address: '127.0.0.1:0'}}}}", project().display());
    std::fs::write(&flow, format!("version: 1\nname: network\noperators:\n  tactile_source: {node}\n"))
        .expect("written");
    try_in(&flow, &[], &["tactile_source"], &["own file", "fchmod 0600", "socket INET", "socket NETLINK", "last"]);
}

#[test]
fn an_operator_without_a_sandbox_can_do_what_its_user_can() {
    let folder = tempfile::tempdir().expect("a folder");
    let off = ("sandbox: on".to_string(), "sandbox: off".to_string());
    let graph = Graph::start(&dataflow_with(folder.path(), &[intruder(), off]), &FAST_FOREVER);
    wait_for_each(&graph, "done");
    // But no program that it runs gets more rights.
    for node in NODES {
        let status = std::fs::read_to_string(format!("/proc/{}/status", graph.pid_of(node))).expect("there");
        assert!(status.lines().any(|line| line == "NoNewPrivs:\t1"), "{node}: {status}");
    }
    graph.stop();
}

#[test]
fn a_program_that_does_not_restrict_itself_is_told_of_or_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let body = format!(
        "case \"$*\" in *--describe*) exec {} --describe;; esac\necho '{{\"report\": \"ready\"}}' >{REPORTS}\nexec cat",
        operator("classifier")
    );
    let program = script(folder.path(), "classifier", &body);
    let runs = || classifier_runs(&program, &format!("{{model: {MODEL}}}"));
    let graph = Graph::launch(&unique_name(), &dataflow_with(folder.path(), &[runs()]), &FAST_FOREVER);
    let told = "node 'classifier' has 'sandbox: on', but it is not restricted";
    wait_until(|| graph.said().contains(told), || graph.said());
    drop(graph);
    let required = ("sandbox: on".to_string(), "sandbox: required".to_string());
    let flow = dataflow_with(folder.path(), &[runs(), required]);
    let refused = run(&["run", "--name", &unique_name(), flow.to_str().expect("UTF-8")], 1);
    let said = text(&refused.stderr);
    assert!(said.contains("node 'classifier' failed: its sandbox is required, and it is not restricted"), "{said}");
}

#[test]
fn an_operator_that_takes_more_memory_than_it_may_is_started_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let hoarder = classifier_runs(&stubborn_classifier(), "{hoarded_mib: 512}");
    let flow = dataflow_with(folder.path(), &[hoarder, of_node("classifier", &["memory_max_mib: 256"])]);
    let graph = Graph::launch(&unique_name(), &flow, &FAST_FOREVER);
    for part in [
        "[classifier] memory allocation of 536870912 bytes failed",
        "node 'classifier' was killed (signal 6; its memory_max_mib is 256); it is started again",
    ] {
        wait_until(|| graph.said().contains(part), || format!("expected '{part}': {}", graph.said()));
    }
    drop(graph);
    // The shipped operators need far less, and their shared memory does not count.
    let modest = NODES.map(|node| of_node(node, &["memory_max_mib: 64"]));
    let flow = dataflow_with(folder.path(), &modest);
    run(&["run", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow.to_str().expect("UTF-8")], 0);
}

#[test]
fn the_projects_graphs_run_in_full_sandboxes() {
    if supported() != Enforcement::Full {
        return skipped("the kernel has no Landlock, or one older than Linux 6.12");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("sandbox: on", "sandbox: required")]);
    run(&["run", "--name", &unique_name(), "--set", "recorded_source.rate=max", flow.to_str().expect("UTF-8")], 0);
}
