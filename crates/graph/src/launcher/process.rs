//! One operator process: its start, its output, its commands and its end.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::io::{BufRead, BufReader, PipeReader, PipeWriter, Read, Write};
use std::os::fd::{AsRawFd, BorrowedFd, RawFd};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdin, Command as Program, ExitStatus, Stdio};
use std::rc::Rc;
use std::sync::mpsc::{Sender, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{
    Pid, Resource, Rlimit, Signal, WaitId, WaitIdOptions, kill_process, kill_process_group,
    set_parent_process_death_signal, setrlimit, waitid,
};
use rustix::thread::{CpuSet, sched_setaffinity, set_no_new_privs};

use crate::dataflow::{self, Node, ProcessOptions, Scheduling, SchedulingPolicy};
use crate::launcher::Event;
use crate::launcher::lifecycle::KILL_LIMIT;
use crate::launcher::log_writer::Log;
use crate::launcher::service;
use crate::log::printable;
use blindgrasp_operator::diagnostics::LinePrinter;
use blindgrasp_operator::wiring::{
    Addressed, Command, GroupMemberWiring, GroupWiring, LogEntry, REPORTS_VARIABLE, Report, WIRING_VARIABLE, Wiring,
};

/// The environment of a process that opens TLS connections: its Zenoh receives and sends on one thread. It reads and writes a
/// TLS connection without a lock, which on several threads breaks the connections or the process (eclipse-zenoh/zenoh issue
/// 2557). Its other work keeps its threads: with everything on one thread, a client of a router takes ten seconds to close.
pub const ZENOH_THREADS: (&str, &str) = ("ZENOH_RUNTIME", "(tx: (worker_threads: 1), rx: (handover: tx))");
/// The arguments of the program that runs the operators of a group.
const GROUP_ARGS: [&str; 2] = ["operator", "group"];

/// A longer line of text is split, and of a longer report the rest is dropped.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// The last log lines of an operator explain its failure.
const N_KEPT_LINES: usize = 20;
const KILL_POLL: Duration = Duration::from_micros(200);
/// Commands of this many bytes may wait for an operator that does not read them.
const MAX_UNWRITTEN: usize = 4 << 20;

/// A process of a node.
pub(super) struct Process {
    /// Its heartbeat's slot on the cursors.
    pub(super) instance_slot: usize,
    pub(super) exit: Option<ExitStatus>,
    lines: Lines,
    /// The process of the system; nodes of a group share it.
    shared: Rc<RefCell<Shared>>,
    /// The node, if its process has others.
    addressee: Option<String>,
    is_let_go: bool,
}

/// A process of the system.
struct Shared {
    child: Child,
    /// The thread that has started it lives as long as this.
    _life: Sender<()>,
    stdin: Option<ChildStdin>,
    /// The commands that its stdin has no room for yet.
    unwritten: Vec<u8>,
    exit: Option<ExitStatus>,
    killed: Option<Instant>,
    /// So many of its nodes still need it.
    n_needed: usize,
}

/// A node to start.
pub(super) struct Start {
    /// Of the instance, unique among all of this launch.
    pub(super) id: u64,
    pub(super) node: Node,
    pub(super) wiring: Wiring,
    pub(super) sink: LineSink,
}

/// The last log lines of a process.
type Lines = Arc<Mutex<VecDeque<String>>>;

/// Where the log lines of a process go, besides the few that are kept.
#[derive(Clone)]
pub(super) struct LineSink {
    pub(super) node: String,
    /// `None` if nothing is logged any more.
    pub(super) log: Option<Log>,
    /// Prints them on the terminal.
    pub(super) printer: Option<Arc<Mutex<LinePrinter>>>,
}

/// The program of a process that is to be started.
pub(super) struct PreparedProgram {
    pub(super) command: Program,
    options: ProcessOptions,
    its_reports: PipeWriter,
    lines: PipeReader,
    reports: PipeReader,
}

/// A program that has begun.
pub(super) struct BegunProgram {
    child: Unclaimed,
    /// Its thread lives as long as this.
    life: Sender<()>,
    lines: PipeReader,
    reports: PipeReader,
}

/// A child that is killed if no [`Process`] takes it.
struct Unclaimed(Option<Child>);

impl PreparedProgram {
    /// Prepares the program of a node, or of the nodes of a group, for a process group of its own. The process tells its id
    /// before the program begins.
    ///
    /// # Errors
    /// The system has no descriptors left, or the nodes have no such program.
    pub(super) fn of(
        starts: &[Start],
        host: Option<&dataflow::Program>,
    ) -> std::io::Result<(PreparedProgram, PipeReader)> {
        let node = &starts.first().ok_or(std::io::ErrorKind::InvalidInput)?.node;
        let mut command = wired_program(node, starts, host)?;
        // Text for the log has a pipe, and reports have another: no text is ever a report.
        let (lines, its_lines) = std::io::pipe()?;
        let (reports, its_reports) = std::io::pipe()?;
        let reports_number = its_reports.as_raw_fd();
        command
            .env(REPORTS_VARIABLE, reports_number.to_string())
            .env_remove(service::SOCKET_VARIABLE)
            .stdin(Stdio::piped())
            .stdout(its_lines.try_clone()?)
            .stderr(its_lines)
            .process_group(0);
        if starts.iter().any(|start| start.node.is_link() || start.node.description.uses_network) {
            command.env(ZENOH_THREADS.0, ZENOH_THREADS.1);
        }
        let options = node.process.clone();
        let memory_max = node.memory_max_mib.map(|mib| Rlimit { current: Some(mib << 20), maximum: Some(mib << 20) });
        let launcher_pid = rustix::process::getpid();
        let (its_pid, tells_pid) = std::io::pipe()?;
        let before_exec = move || {
            rustix::io::write(&tells_pid, &rustix::process::getpid().as_raw_nonzero().get().to_ne_bytes())?;
            before_exec(&options, memory_max, launcher_pid, reports_number)
        };
        // SAFETY: between fork and exec the closure makes system calls alone; it neither allocates nor takes a lock.
        unsafe { command.pre_exec(before_exec) };
        Ok((PreparedProgram { command, options: node.process.clone(), its_reports, lines, reports }, its_pid))
    }

    /// Starts the program. It may take for ever: the new process may be stopped before the program begins, and a file system
    /// may hang.
    ///
    /// # Errors
    /// The system cannot start the program.
    pub(super) fn begin(self, life: Sender<()>) -> std::io::Result<BegunProgram> {
        let PreparedProgram { mut command, options, its_reports, lines, reports } = self;
        let child = command.spawn().map_err(|error| explain(error, &options))?;
        // The ends of the pipes that are the process's alone: the others see its end.
        drop((command, its_reports));
        Ok(BegunProgram { child: Unclaimed(Some(child)), life, lines, reports })
    }
}

impl BegunProgram {
    pub(super) fn pid(&self) -> u32 {
        self.child.0.as_ref().map_or(0, Child::id)
    }
}

impl Drop for Unclaimed {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Process {
    /// Takes a program that has begun. The output about a node goes to `events` under its id. There is one [`Process`] for each
    /// node.
    ///
    /// # Errors
    /// The system has no threads left.
    pub(super) fn of(
        starts: &[Start],
        begun: BegunProgram,
        events: &SyncSender<Event>,
    ) -> std::io::Result<Vec<Process>> {
        let BegunProgram { mut child, life, lines, reports } = begun;
        let hearers: Vec<Hearer> = starts
            .iter()
            .map(|start| Hearer { id: start.id, sink: start.sink.clone(), lines: Lines::default() })
            .collect();
        hear(lines, reports, &hearers, events)?;
        let Some(mut child) = child.0.take() else { return Ok(Vec::new()) };
        let stdin = child.stdin.take();
        if let Some(stdin) = &stdin {
            // An operator that does not read its commands must not stop the launcher.
            rustix::io::ioctl_fionbio(stdin, true)?;
        }
        let n_needed = starts.len();
        let shared = Shared { child, _life: life, stdin, unwritten: Vec::new(), exit: None, killed: None, n_needed };
        let shared = Rc::new(RefCell::new(shared));
        Ok(starts.iter().zip(hearers).map(|(start, hearer)| Process::new(start, hearer.lines, &shared)).collect())
    }

    fn new(start: &Start, lines: Lines, shared: &Rc<RefCell<Shared>>) -> Process {
        let is_alone = shared.borrow().n_needed == 1;
        Process {
            instance_slot: start.wiring.instance_slot,
            exit: None,
            lines,
            shared: Rc::clone(shared),
            addressee: if is_alone { None } else { Some(start.node.id.clone()) },
            is_let_go: false,
        }
    }

    /// Its last log lines, which explain a failure.
    pub(super) fn last_lines(&self) -> Vec<String> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }

    /// Sends a command, as soon as its stdin has room. A process that has closed its stdin gets nothing; if it has died,
    /// supervision finds out.
    pub(super) fn tell(&mut self, command: &Command) {
        let addressed = Addressed { member: self.addressee.clone(), message: command };
        if let Ok(json) = serde_json::to_string(&addressed) {
            let mut shared = self.shared.borrow_mut();
            shared.unwritten.extend_from_slice(format!("{json}\n").as_bytes());
            shared.write_commands();
        }
    }

    /// Lets it exit. A process of several nodes exits when none of them is needed any more.
    pub(super) fn let_go(&mut self) {
        if std::mem::replace(&mut self.is_let_go, true) {
            return;
        }
        if self.addressee.is_some() {
            self.tell(&Command::Quit);
        }
        let mut shared = self.shared.borrow_mut();
        shared.n_needed -= 1;
        if shared.n_needed == 0 {
            shared.stdin = None;
        }
    }

    pub(super) fn ask_to_drain(&mut self) {
        match self.addressee {
            Some(_) => self.tell(&Command::Drain),
            None => self.shared.borrow().signal(Signal::TERM),
        }
    }

    /// Checks whether it has ended; true if it has ended since the last check.
    pub(super) fn look(&mut self) -> bool {
        if self.exit.is_some() {
            return false;
        }
        let mut shared = self.shared.borrow_mut();
        shared.look();
        self.exit = shared.exit;
        self.exit.is_some()
    }

    /// Kills it and its children. It does not wait for its end.
    pub(super) fn kill(&mut self) {
        let mut shared = self.shared.borrow_mut();
        shared.look();
        // Looking has killed the children of an ended process; its number may belong to another process by now.
        if shared.exit.is_none() && shared.killed.is_none() {
            shared.kill_group();
            shared.killed = Some(Instant::now());
        }
    }
}

impl Shared {
    fn write_commands(&mut self) {
        if self.unwritten.is_empty() {
            return;
        }
        let Some(stdin) = &mut self.stdin else {
            return;
        };
        match stdin.write(&self.unwritten) {
            Ok(n) => drop(self.unwritten.drain(..n)),
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock && self.unwritten.len() < MAX_UNWRITTEN => {}
            // It has closed its stdin, or has not read it for very long.
            Err(_) => self.stdin = None,
        }
    }

    fn look(&mut self) {
        if self.exit.is_some() {
            return;
        }
        self.write_commands();
        if self.has_ended() {
            // Until it is waited for, its number is its own, and its children are in its group.
            self.kill_group();
            self.exit = self.child.try_wait().ok().flatten();
        }
    }

    /// Whether it has ended. It is not waited for.
    fn has_ended(&self) -> bool {
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        let pid = Pid::from_raw(self.child.id() as i32);
        pid.is_some_and(|pid| !matches!(waitid(WaitId::Pid(pid), options), Ok(None)))
    }

    fn kill_group(&self) {
        if let Some(group) = Pid::from_raw(self.child.id() as i32) {
            let _ = kill_process_group(group, Signal::KILL);
        }
    }

    fn signal(&self, signal: Signal) {
        // Until the child has been waited for, its pid is its own.
        if self.exit.is_none()
            && let Some(pid) = Pid::from_raw(self.child.id() as i32)
        {
            let _ = kill_process(pid, signal);
        }
    }
}

impl Drop for Process {
    /// Kills it, and waits for its end for a bounded time.
    fn drop(&mut self) {
        self.kill();
        let killed = self.shared.borrow().killed;
        while !self.look() && self.exit.is_none() && killed.is_some_and(|killed| killed.elapsed() < KILL_LIMIT) {
            std::thread::sleep(KILL_POLL);
        }
    }
}

/// The program of a node, or of the nodes of a group, with its arguments and its wiring.
fn wired_program(node: &Node, starts: &[Start], host: Option<&dataflow::Program>) -> std::io::Result<Program> {
    let mut command = Program::new(&node.program);
    if node.description.hosted {
        let Some(host) = host else {
            return Err(std::io::Error::other("the program that runs the graph has no host for other languages"));
        };
        command = Program::new(&host.path);
        command.args(&host.args).arg(&node.program);
    }
    let wiring = if let [start] = starts {
        command.args(&start.node.args);
        serde_json::to_string(&start.wiring)?
    } else {
        command.args(GROUP_ARGS);
        let mut members = Vec::with_capacity(starts.len());
        for start in starts {
            let args = start.node.args.iter().skip(1).cloned().collect();
            members.push(GroupMemberWiring { args, wiring: start.wiring.clone() });
        }
        serde_json::to_string(&GroupWiring { members })?
    };
    command.env(WIRING_VARIABLE, wiring);
    Ok(command)
}

/// Runs between fork and exec, and makes system calls only.
fn before_exec(
    options: &ProcessOptions,
    memory_max: Option<Rlimit>,
    launcher: Pid,
    reports_number: RawFd,
) -> std::io::Result<()> {
    // No program that it runs gets more rights than it has: setuid has no effect.
    set_no_new_privs(true)?;
    // Not the address space: of the graph's shared memory, an operator maps far more than it uses.
    if let Some(limit) = memory_max {
        setrlimit(Resource::Data, limit)?;
    }
    give_options(options)?;
    set_parent_process_death_signal(Some(Signal::TERM))?;
    // The launcher may have died before the signal was set.
    if rustix::process::getppid() != Some(launcher) {
        return Err(rustix::io::Errno::SRCH.into());
    }
    // iceoryx2 0.10 opens its sockets and files without O_CLOEXEC: the operators must not inherit the launcher's.
    // SAFETY: it marks descriptors, and nothing of this process uses them between here and exec.
    unsafe { libc::syscall(libc::SYS_close_range, 3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC) };
    // SAFETY: the descriptor is open until the program begins.
    fcntl_setfd(unsafe { BorrowedFd::borrow_raw(reports_number) }, FdFlags::empty())?;
    Ok(())
}

/// Asks the kernel for a node's options. It runs between fork and exec and makes system calls only.
fn give_options(options: &ProcessOptions) -> std::io::Result<()> {
    if !options.cpus.is_empty() {
        let mut cpus = CpuSet::new();
        for cpu in &options.cpus {
            if *cpu < CpuSet::MAX_CPU {
                cpus.set(*cpu);
            }
        }
        sched_setaffinity(None, &cpus)?;
    }
    if let Some(nice) = options.nice {
        rustix::process::setpriority_process(None, nice)?;
    }
    if let Some(Scheduling { policy, priority }) = options.scheduling {
        let policy = match policy {
            SchedulingPolicy::Fifo => libc::SCHED_FIFO,
            SchedulingPolicy::RoundRobin => libc::SCHED_RR,
        };
        // SAFETY: the struct is valid for any bits, and the kernel reads it during the call alone.
        let outcome = unsafe {
            let mut param: libc::sched_param = std::mem::zeroed();
            param.sched_priority = priority as i32;
            libc::sched_setscheduler(0, policy | libc::SCHED_RESET_ON_FORK, &raw const param)
        };
        if outcome != 0 {
            return Err(std::io::Error::last_os_error());
        }
    }
    Ok(())
}

/// The error of a process that did not start, with what to do if the kernel refused the node's options.
fn explain(error: std::io::Error, options: &ProcessOptions) -> std::io::Error {
    let advice = match error.kind() {
        std::io::ErrorKind::PermissionDenied if options.needs_rights() => {
            "its 'scheduling' and a negative 'nice' need the right CAP_SYS_NICE or the limits RLIMIT_RTPRIO and \
             RLIMIT_NICE: 'blindgrasp doctor' says how to get them"
        }
        std::io::ErrorKind::InvalidInput if !options.cpus.is_empty() => {
            "its 'cpus' must name a CPU that this machine has and the process may use: 'nproc' and 'taskset -p $$' tell"
        }
        _ => return error,
    };
    std::io::Error::new(error.kind(), format!("{error}; {advice}"))
}

/// Hears a process until its end, on a thread for its lines and one for its reports.
fn hear(lines: PipeReader, reports: PipeReader, hearers: &[Hearer], events: &SyncSender<Event>) -> std::io::Result<()> {
    let first = hearers[0].clone();
    std::thread::Builder::new().spawn(move || forward_lines(lines, &first))?;
    let (hearers, events) = (hearers.to_vec(), events.clone());
    std::thread::Builder::new().spawn(move || forward_reports(reports, &hearers, &events))?;
    Ok(())
}

/// What a process prints goes to the log of its first node.
fn forward_lines(stream: impl Read, first: &Hearer) {
    let mut stream = BufReader::new(stream);
    let mut bytes = Vec::new();
    while read_line(&mut stream, &mut bytes) {
        first.take(LogEntry::plain(String::from_utf8_lossy(&bytes).trim_end()));
    }
}

/// Reports go to the launcher, and log entries to the log of the node that they are about.
fn forward_reports(stream: impl Read, hearers: &[Hearer], events: &SyncSender<Event>) {
    let first = &hearers[0];
    let mut stream = BufReader::new(stream);
    let mut bytes = Vec::new();
    let mut is_whole = true;
    while read_line(&mut stream, &mut bytes) {
        let is_rest = !is_whole;
        is_whole = bytes.ends_with(b"\n");
        if is_rest {
            continue;
        }
        match serde_json::from_slice::<Addressed<Report>>(&bytes) {
            Ok(Addressed { member, message }) => {
                let named = hearers.iter().find(|hearer| member.as_ref() == Some(&hearer.sink.node));
                let hearer = named.unwrap_or(first);
                match message {
                    Report::Log(entry) => hearer.take(entry),
                    report => {
                        if events.send(Event::Output(hearer.id, report)).is_err() {
                            return;
                        }
                    }
                }
            }
            Err(error) => {
                let line = String::from_utf8_lossy(&bytes);
                first.take(LogEntry::plain(format!("not a report of this version ({error}): {}", line.trim_end())));
            }
        }
    }
    let _ = events.send(Event::Closed);
}

/// Reads a line, or the first part of a long one; false at the end.
fn read_line(stream: &mut impl BufRead, bytes: &mut Vec<u8>) -> bool {
    bytes.clear();
    stream.take(MAX_LINE_BYTES).read_until(b'\n', bytes).is_ok_and(|n_read| n_read > 0)
}

/// A node whose process speaks.
#[derive(Clone)]
struct Hearer {
    id: u64,
    sink: LineSink,
    lines: Lines,
}

impl Hearer {
    fn take(&self, entry: LogEntry) {
        self.sink.take(entry, &self.lines);
    }
}

impl LineSink {
    fn take(&self, entry: LogEntry, lines: &Lines) {
        let line = printable(&entry.to_string());
        if let Some(printer) = &self.printer {
            printer.lock().unwrap_or_else(PoisonError::into_inner).print(&format!("[{}] {line}", self.node));
        }
        {
            let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
            lines.push_back(line);
            if lines.len() > N_KEPT_LINES {
                lines.pop_front();
            }
        }
        if let Some(log) = &self.log {
            log.write_patiently(entry);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hearer() -> Hearer {
        let sink = LineSink { node: "contacts".into(), log: None, printer: None };
        Hearer { id: 7, sink, lines: Lines::default() }
    }

    fn logged(hearer: &Hearer) -> Vec<String> {
        hearer.lines.lock().expect("lines").iter().cloned().collect()
    }

    /// What a program prints may be text of strangers, such as the name of an object.
    #[test]
    fn a_printed_line_is_no_report() {
        let lines = [
            "{\"report\":\"unfit\",\"message\":\"by a message\"}",
            "@blindgrasp {\"report\":\"unfit\",\"message\":\"by a message\"}",
            "no object of the name @blindgrasp {\"report\":\"ready\",\"sandbox\":\"full\"}",
        ];
        let hearer = hearer();
        forward_lines(lines.join("\n").as_bytes(), &hearer);
        assert_eq!(logged(&hearer), lines);
    }

    #[test]
    fn reports_are_heard_and_the_rest_of_a_long_line_is_not() {
        let (events, heard) = std::sync::mpsc::sync_channel(10);
        let hearer = hearer();
        let n_until_report = MAX_LINE_BYTES as usize - "{\"report\":\"drained\"}".len();
        let said = format!(
            "?\n{{\"report\":\"drained\"}}\n{}{{\"report\":\"drained\"}}{{\"report\":\"finished\"}}\n\
             {{\"report\":\"log\",\"message\":\"a line\"}}\n",
            "x".repeat(n_until_report)
        );
        forward_reports(said.as_bytes(), std::slice::from_ref(&hearer), &events);
        let heard: Vec<Event> = heard.try_iter().collect();
        assert!(matches!(heard.as_slice(), [Event::Output(7, Report::Drained), Event::Closed]), "{}", heard.len());
        let lines = logged(&hearer);
        assert!(lines.len() == 3 && lines[2] == "a line", "{lines:?}");
        assert!(lines[..2].iter().all(|line| line.starts_with("not a report of this version")), "{lines:?}");
    }
}
