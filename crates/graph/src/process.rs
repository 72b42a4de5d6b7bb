//! One operator process: how it is started, listened to, spoken to and ended.

use std::collections::{BTreeMap, VecDeque};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, ChildStdin, Command as Program, ExitStatus, Stdio};
use std::sync::mpsc::SyncSender;
use std::time::Instant;

use rustix::process::{Pid, Signal, kill_process, kill_process_group, set_parent_process_death_signal};

use crate::dataflow::LINK;
use crate::launcher::Event;
use blindgrasp_operator::wiring::{Command, LogEntry, REPORT_PREFIX, Report, WIRING_VARIABLE, Wiring};

/// A longer line is taken for several.
const MAX_LINE_BYTES: u64 = 64 << 10;
/// For the link: Zenoh receives and sends on one thread. Its TLS connections are read and written without a lock between the two,
/// which on several threads breaks them, or the process (eclipse-zenoh/zenoh issue 2557). All else stays as it is: with
/// everything on one thread, a client of a router takes ten seconds to close.
const ZENOH_THREADS: (&str, &str) = ("ZENOH_RUNTIME", "(tx: (worker_threads: 1), rx: (handover: tx))");
/// How many log lines of an operator are kept to explain its failure.
const N_KEPT_LINES: usize = 20;

/// What a process says.
#[derive(Debug)]
pub(super) enum Word {
    /// To the launcher.
    Report(Report),
    /// To a person.
    Log(LogEntry),
    /// It has closed stdout or stderr: it is ending, most likely.
    Closed,
}

/// A process of a node, as far as it is known.
pub(super) struct Process {
    /// Unique among all processes of this launch.
    pub(super) id: u64,
    /// When it was started.
    pub(super) started: Instant,
    /// Its heartbeat's cell on the board.
    pub(super) instance_cell: usize,
    /// It has said that it is ready, and what it is.
    pub(super) identity: Option<BTreeMap<String, String>>,
    /// A source that has sent all, or an operator that is drained.
    pub(super) is_done: bool,
    /// It was asked to drain.
    pub(super) is_asked: bool,
    /// It has drained although the launcher did not ask it.
    is_stopped: bool,
    /// A link: the other machines are there.
    pub(super) is_connected: bool,
    /// Its answer to the last [`Command::HandOver`].
    pub(super) has_handed_over: bool,
    /// Its answer to the last [`Command::TakeOver`].
    pub(super) has_taken_over: bool,
    /// It has computed samples as a standby.
    pub(super) is_warm: bool,
    /// Its answer to the last [`Command::Set`].
    pub(super) set_answer: Option<(u64, Option<u64>, Option<String>)>,
    /// What it counts besides its samples.
    pub(super) counts: BTreeMap<String, u64>,
    /// Why it says that it cannot go on.
    pub(super) failure: Option<String>,
    /// Why the launcher has ended it.
    pub(super) finding: Option<String>,
    /// How it ended.
    pub(super) exit: Option<ExitStatus>,
    /// Its last log lines.
    pub(super) log: VecDeque<String>,
    child: Child,
    stdin: Option<ChildStdin>,
}

impl Process {
    /// Starts a program with its wiring, in a process group of its own. What it says goes to `words` under `id`.
    ///
    /// # Errors
    /// The system's.
    pub(super) fn spawn(
        id: u64,
        program: &Path,
        args: &[String],
        wiring: &Wiring,
        words: &SyncSender<Event>,
    ) -> std::io::Result<Process> {
        let launcher_pid = rustix::process::getpid();
        let mut command = Program::new(program);
        command
            .args(args)
            .env(WIRING_VARIABLE, serde_json::to_string(wiring)?)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0);
        if wiring.node == LINK {
            command.env(ZENOH_THREADS.0, ZENOH_THREADS.1);
        }
        let before_exec = move || {
            set_parent_process_death_signal(Some(Signal::TERM))?;
            // The launcher may have died before the signal was set.
            if rustix::process::getppid() != Some(launcher_pid) {
                return Err(rustix::io::Errno::SRCH.into());
            }
            Ok(())
        };
        // SAFETY: between fork and exec the closure makes two system calls; it neither allocates nor takes a lock.
        unsafe { command.pre_exec(before_exec) };
        let mut child = command.spawn()?;
        let streams: [Option<Box<dyn Read + Send>>; 2] = [
            child.stdout.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>),
            child.stderr.take().map(|stream| Box::new(stream) as Box<dyn Read + Send>),
        ];
        for stream in streams.into_iter().flatten() {
            let words = words.clone();
            std::thread::spawn(move || forward_lines(stream, id, &words));
        }
        Ok(Process {
            id,
            started: Instant::now(),
            instance_cell: wiring.instance_cell,
            identity: None,
            is_done: false,
            is_asked: false,
            is_stopped: false,
            is_connected: false,
            has_handed_over: false,
            has_taken_over: false,
            is_warm: false,
            set_answer: None,
            counts: BTreeMap::new(),
            failure: None,
            finding: None,
            exit: None,
            log: VecDeque::new(),
            stdin: child.stdin.take(),
            child,
        })
    }

    /// Its process id.
    pub(super) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Whether it can answer samples.
    pub(super) fn is_ready(&self) -> bool {
        self.identity.is_some()
    }

    /// Whether it has not ended.
    pub(super) fn is_running(&self) -> bool {
        self.exit.is_none()
    }

    /// Whether it has drained at a signal that was not the launcher's.
    pub(super) fn is_stopped_by_somebody_else(&self) -> bool {
        self.is_stopped && !self.is_asked && self.exit.is_none()
    }

    /// Takes in what it said.
    pub(super) fn hear(&mut self, report: Report) {
        match report {
            Report::Ready { identity } => self.identity = Some(identity),
            Report::HandedOver => self.has_handed_over = true,
            Report::TookOver => self.has_taken_over = true,
            Report::Warm { .. } => self.is_warm = true,
            Report::Set { id, from_seq, error } => self.set_answer = Some((id, from_seq, error)),
            Report::Counts { counts } => self.counts = counts,
            Report::Connected => self.is_connected = true,
            Report::Finished => self.is_done = true,
            Report::Drained if self.is_asked => self.is_done = true,
            Report::Drained => self.is_stopped = true,
            Report::Failed { message } => self.failure = Some(message),
            // A word of its own: to people.
            Report::Log(_) | Report::Ended { .. } | Report::Link(_) => {}
        }
    }

    /// Keeps a log line for later.
    pub(super) fn keep(&mut self, line: String) {
        self.log.push_back(line);
        if self.log.len() > N_KEPT_LINES {
            self.log.pop_front();
        }
    }

    /// Tells it something. One that has closed its stdin hears nothing; if it has died, that is found out elsewhere.
    pub(super) fn tell(&mut self, command: &Command) {
        if let (Some(stdin), Ok(json)) = (&mut self.stdin, serde_json::to_string(command)) {
            let _ = stdin.write_all(format!("{json}\n").as_bytes());
        }
    }

    /// Lets it exit.
    pub(super) fn let_go(&mut self) {
        self.stdin = None;
    }

    /// Asks it to drain.
    pub(super) fn ask_to_drain(&mut self) {
        self.is_asked = true;
        self.signal(Signal::TERM);
    }

    /// Looks whether it has ended; true if that is news.
    pub(super) fn look(&mut self) -> bool {
        if self.exit.is_none()
            && let Ok(Some(status)) = self.child.try_wait()
        {
            self.exit = Some(status);
            self.kill_group();
            return true;
        }
        false
    }

    /// Kills it, and whatever it has started, and waits for its end; false if it had ended before.
    pub(super) fn kill(&mut self) -> bool {
        self.look();
        // Looking has killed what an ended one has left; its number may be another one's by now.
        if self.exit.is_some() {
            return false;
        }
        self.kill_group();
        self.exit = self.child.wait().ok();
        true
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

    /// Whether it ended as it was asked to. One that was asked to stop before it could listen ends by the signal itself.
    pub(super) fn has_ended_well(&self) -> bool {
        self.failure.is_none()
            && self.exit.is_some_and(|status| {
                status.success() || (self.is_asked && status.signal() == Some(Signal::TERM.as_raw()))
            })
    }

    /// What it did, for a person: "failed: …", "was killed (signal 9)", "ended with exit status 1".
    pub(super) fn ending(&self) -> String {
        if let Some(finding) = &self.finding {
            return finding.clone();
        }
        match (&self.failure, self.exit) {
            (Some(message), _) => format!("failed: {message}"),
            (None, Some(status)) => match status.signal() {
                // Memory of a full /dev/shm is there only until it is written to.
                Some(signal) if signal == Signal::BUS.as_raw() => {
                    format!("was killed (signal {signal}: shared memory is full, most likely)")
                }
                Some(signal) => format!("was killed (signal {signal})"),
                None => format!("ended ({status})"),
            },
            (None, None) => "is running".into(),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Blocks when the launcher is behind: an operator that floods its output waits, and nobody's memory grows.
fn forward_lines(stream: impl Read, id: u64, words: &SyncSender<Event>) {
    let mut stream = BufReader::new(stream);
    let mut bytes = Vec::new();
    loop {
        bytes.clear();
        match (&mut stream).take(MAX_LINE_BYTES).read_until(b'\n', &mut bytes) {
            Ok(0) | Err(_) => break,
            Ok(_) => {}
        }
        let line = String::from_utf8_lossy(&bytes).trim_end().to_string();
        let word = match line.strip_prefix(REPORT_PREFIX).map(serde_json::from_str) {
            Some(Ok(Report::Log(entry))) => Word::Log(entry),
            Some(Ok(report)) => Word::Report(report),
            Some(Err(error)) => Word::Log(LogEntry::plain(format!("not a report of this version ({error}): {line}"))),
            None => Word::Log(LogEntry::plain(line)),
        };
        if words.send(Event::Word(id, word)).is_err() {
            return;
        }
    }
    let _ = words.send(Event::Word(id, Word::Closed));
}
