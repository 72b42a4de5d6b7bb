//! The program of a host: its process and the two pipes to it.

use std::ffi::{OsStr, OsString};
use std::io::{PipeReader, PipeWriter, Read, Write};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow, bail};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::FdFlags;
use rustix::process::{Signal, getpid, getppid, set_parent_process_death_signal};

use super::protocol::{Ask, FRAME_BYTES, MAX_BODY_BYTES, PIPES_VARIABLE, Say, Work, number, read_work, write_work};
use crate::wiring::{LogEntry, REPORTS_VARIABLE, WIRING_VARIABLE};

/// A program whose pipes are closed gets so long to end.
const END_LIMIT: Duration = Duration::from_secs(1);
const END_POLL: Duration = Duration::from_millis(2);
/// So much is read at a time.
const READ_BYTES: usize = 64 << 10;
/// Log lines and counts that a program may say before the answer for which the host waits.
const MAX_ASIDES: usize = 10_000;
/// The longest text of a log line or a failure: the launcher reads lines of up to 64 KiB.
const MAX_TEXT_BYTES: usize = 4096;

/// A program that works for this process.
pub(super) struct Program {
    process: Child,
    to: Option<PipeWriter>,
    from: PipeReader,
    out: Vec<u8>,
    /// The bytes that were read; a message that was taken out ends at `used`.
    read: Vec<u8>,
    used: usize,
    asides: Asides,
}

/// The log lines and counts of a program, which may come at any time.
#[derive(Default)]
pub(super) struct Asides {
    pub(super) lines: Vec<LogEntry>,
    pub(super) counts: std::collections::BTreeMap<String, u64>,
}

impl Program {
    /// Starts a program before this process has a second thread. `restrict` is called in the new process, before it begins.
    pub(super) fn spawn(
        program: &OsStr,
        arguments: &[OsString],
        restrict: impl Fn() -> std::io::Result<()> + Send + Sync + 'static,
    ) -> anyhow::Result<Program> {
        let (to_read, to) = std::io::pipe().context("cannot make a pipe")?;
        let (from, from_write) = std::io::pipe().context("cannot make a pipe")?;
        let its_own: [OwnedFd; 2] = [to_read.into(), from_write.into()];
        let host = getpid();
        let numbers: Vec<String> = its_own.iter().map(|fd| fd.as_raw_fd().to_string()).collect();
        let mut command = Command::new(program);
        command
            .args(arguments)
            .env(PIPES_VARIABLE, numbers.join(","))
            .env_remove(WIRING_VARIABLE)
            .env_remove(REPORTS_VARIABLE)
            .stdin(Stdio::null());
        let inherited: Vec<i32> = its_own.iter().map(AsRawFd::as_raw_fd).collect();
        let before_exec = move || {
            set_parent_process_death_signal(Some(Signal::KILL))?;
            // The host may have died before the signal was set.
            if getppid() != Some(host) {
                return Err(rustix::io::Errno::SRCH.into());
            }
            for number in [libc::SIGTERM, libc::SIGINT] {
                // SAFETY: to ignore a signal runs no code. The host says when it is to end.
                unsafe { libc::signal(number, libc::SIG_IGN) };
            }
            for fd in &inherited {
                // SAFETY: the descriptors are open until the program begins.
                let fd = unsafe { std::os::fd::BorrowedFd::borrow_raw(*fd) };
                rustix::io::fcntl_setfd(fd, FdFlags::empty())?;
            }
            restrict()
        };
        // SAFETY: this process has one thread, so that no lock is held by another one between fork and exec.
        unsafe { command.pre_exec(before_exec) };
        let process = command.spawn().with_context(|| format!("{} cannot be started", program.display()))?;
        drop(its_own);
        Ok(Program {
            process,
            to: Some(to),
            from,
            out: Vec::new(),
            read: Vec::new(),
            used: 0,
            asides: Asides::default(),
        })
    }

    /// Sends a message about samples.
    pub(super) fn ask<'a>(
        &mut self,
        ask: Ask,
        nanos: u64,
        flags: u32,
        state: &[u8],
        parts: impl Iterator<Item = (usize, &'a [u8], &'a [u8])>,
    ) -> anyhow::Result<()> {
        self.begin(ask);
        write_work(nanos, flags, state, parts, &mut self.out);
        self.send(ask)
    }

    /// Sends a message with a body of JSON.
    pub(super) fn ask_json(&mut self, ask: Ask, body: &impl serde::Serialize) -> anyhow::Result<()> {
        self.begin(ask);
        serde_json::to_writer(&mut self.out, body).context("its program's message cannot be read")?;
        self.send(ask)
    }

    /// Its answer to a message about samples.
    pub(super) fn answer(&mut self, to: Ask) -> anyhow::Result<Answer> {
        match self.next()? {
            Some((Say::Done, body)) => Ok(Answer::Done(read_work(&body)?)),
            Some((Say::OneByOne, _)) => Ok(Answer::OneByOne),
            Some((Say::Refused, body)) => Ok(Answer::Refused(String::from_utf8_lossy(&body).into_owned())),
            Some((found, _)) => Err(unexpected(found, "an answer")),
            None => Err(ended(&self.end(), to)),
        }
    }

    /// Its answer to [`Ask::Start`].
    pub(super) fn ready<T: serde::de::DeserializeOwned>(&mut self) -> anyhow::Result<T> {
        match self.next()? {
            Some((Say::Ready, body)) => parsed(&body, "answer to Start"),
            Some((found, _)) => Err(unexpected(found, "that it is ready")),
            None => Err(ended(&self.end(), Ask::Start)),
        }
    }

    /// The log lines and counts that have come. Call it now and then: it also finds that the program has ended.
    pub(super) fn listen(&mut self) -> anyhow::Result<Asides> {
        // A program that talks without pause is heard again the next time.
        for _ in 0..MAX_ASIDES {
            if !self.has_more() {
                break;
            }
            match self.next_frame()? {
                Some((kind @ (Say::Log | Say::Counts | Say::Failed), body)) => self.take_in(kind, &body)?,
                Some((found, _)) => return Err(unexpected(found, "nothing, because it was not asked")),
                None => bail!("its program ended{} without being asked", self.end()),
            }
        }
        Ok(std::mem::take(&mut self.asides))
    }

    /// The log lines that it has said besides answers so far. Counts wait for [`Program::listen`]: the launcher wants them
    /// some times a second.
    pub(super) fn lines(&mut self) -> Vec<LogEntry> {
        std::mem::take(&mut self.asides.lines)
    }

    fn has_more(&self) -> bool {
        if self.used < self.read.len() {
            return true;
        }
        let mut fds = [PollFd::new(&self.from, PollFlags::IN)];
        poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })).is_ok_and(|n_ready| n_ready > 0)
    }

    fn begin(&mut self, ask: Ask) {
        self.out.clear();
        self.out.extend_from_slice(&[0; 4]);
        self.out.extend_from_slice(&(ask as u32).to_ne_bytes());
    }

    fn send(&mut self, ask: Ask) -> anyhow::Result<()> {
        let n_body = self.out.len() - FRAME_BYTES;
        self.out[..4].copy_from_slice(&(n_body as u32).to_ne_bytes());
        let Some(to) = &mut self.to else { return Err(ended("", ask)) };
        match to.write_all(&self.out) {
            Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Err(self.reason_of_end(ask)),
            outcome => outcome.context("the pipe to its program does not work"),
        }
    }

    /// Why a program does not listen any more: what it said before it ended, if it said something.
    fn reason_of_end(&mut self, ask: Ask) -> anyhow::Error {
        match self.next() {
            Err(error) => error,
            Ok(_) => ended(&self.end(), ask),
        }
    }

    /// Its next message that is an answer; `None` if it has ended.
    fn next(&mut self) -> anyhow::Result<Option<(Say, Vec<u8>)>> {
        for _ in 0..MAX_ASIDES {
            match self.next_frame()? {
                Some((kind @ (Say::Log | Say::Counts | Say::Failed), body)) => self.take_in(kind, &body)?,
                frame => return Ok(frame),
            }
        }
        bail!("its program said {} lines before its answer, expected at most {MAX_ASIDES}", MAX_ASIDES + 1)
    }

    fn take_in(&mut self, kind: Say, body: &[u8]) -> anyhow::Result<()> {
        match kind {
            Say::Log => {
                let mut line: LogEntry = parsed(body, "log line")?;
                line.text = shortened(&line.text);
                if serde_json::to_string(&line.fields).is_ok_and(|fields| fields.len() > MAX_TEXT_BYTES) {
                    line.fields = LogEntry::plain("").fields;
                    line.text += " (its fields are too long for the log)";
                }
                self.asides.lines.push(line);
            }
            Say::Counts => {
                self.asides.counts.extend(parsed::<std::collections::BTreeMap<String, u64>>(body, "counts")?);
            }
            _ => bail!(shortened(&String::from_utf8_lossy(body))),
        }
        Ok(())
    }

    fn next_frame(&mut self) -> anyhow::Result<Option<(Say, Vec<u8>)>> {
        loop {
            let rest = &self.read[self.used..];
            if rest.len() >= FRAME_BYTES {
                let (n_body, kind) = (number(rest, 0) as usize, number(rest, 4) as u32);
                if n_body > MAX_BODY_BYTES {
                    bail!("its program wants to send {n_body} bytes at once, expected at most {MAX_BODY_BYTES}");
                }
                if rest.len() >= FRAME_BYTES + n_body {
                    let body = rest[FRAME_BYTES..FRAME_BYTES + n_body].to_vec();
                    self.used += FRAME_BYTES + n_body;
                    let Some(say) = Say::of(kind) else {
                        bail!("its program said a message of the unknown kind {kind}, expected one from 1 to 7");
                    };
                    return Ok(Some((say, body)));
                }
            }
            if !self.read_more().context("the pipe to its program does not work")? {
                if self.used < self.read.len() {
                    bail!("its program said a part of a message, and ended{}, expected a whole message", self.end());
                }
                return Ok(None);
            }
        }
    }

    /// Reads what is there, or waits for it; false at the end.
    fn read_more(&mut self) -> std::io::Result<bool> {
        self.read.drain(..self.used);
        self.used = 0;
        let n_before = self.read.len();
        self.read.resize(n_before + READ_BYTES, 0);
        let n_read = loop {
            match self.from.read(&mut self.read[n_before..]) {
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                outcome => break outcome,
            }
        };
        self.read.truncate(n_before + *n_read.as_ref().unwrap_or(&0));
        Ok(n_read? > 0)
    }

    /// How it has ended, for a person; empty if it has not.
    fn end(&mut self) -> String {
        self.to = None;
        let start = Instant::now();
        while start.elapsed() < END_LIMIT {
            if let Ok(Some(status)) = self.process.try_wait() {
                return format!(" ({status})");
            }
            std::thread::sleep(END_POLL);
        }
        String::new()
    }
}

/// An answer of a program.
pub(super) enum Answer {
    Done(Work),
    OneByOne,
    Refused(String),
}

impl Answer {
    /// The answer to a message that a program can neither refuse nor divide.
    pub(super) fn done(self) -> anyhow::Result<Work> {
        match self {
            Answer::Done(work) => Ok(work),
            Answer::OneByOne => Err(unexpected(Say::OneByOne, "an answer")),
            Answer::Refused(reason) => bail!(reason),
        }
    }
}

/// A text that fits into a line to the launcher.
fn shortened(text: &str) -> String {
    if text.len() <= MAX_TEXT_BYTES {
        return text.to_owned();
    }
    format!("{} …", &text[..text.floor_char_boundary(MAX_TEXT_BYTES)])
}

fn unexpected(found: Say, expected: &'static str) -> anyhow::Error {
    anyhow!("its program said {found:?}, expected {expected}")
}

fn parsed<T: serde::de::DeserializeOwned>(body: &[u8], what: &str) -> anyhow::Result<T> {
    serde_json::from_slice(body).with_context(|| format!("its program's {what} cannot be read"))
}

fn ended(how: &str, to: Ask) -> anyhow::Error {
    anyhow!("its program ended{how}, expected an answer to {to:?}")
}

impl Drop for Program {
    /// A program whose pipes are closed ends, or is killed.
    fn drop(&mut self) {
        if self.end().is_empty() && self.process.kill().is_ok() {
            let _ = self.process.wait();
        }
    }
}
