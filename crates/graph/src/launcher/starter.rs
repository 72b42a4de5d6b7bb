//! Starts a program on a thread of its own. The call of the system ends only when the program has begun, which a process that is
//! stopped before, or a file system that hangs, delays without end; so do the digests of pinned files.

use std::io::{PipeReader, Read};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use rustix::io::ioctl_fionbio;
use rustix::process::{Pid, Signal, kill_process};

use crate::dataflow::Node;
use crate::launcher::process::{BegunProgram, PreparedProgram};
use crate::launcher::{LaunchError, Launcher};

/// A process must begin within this time while the graph runs. At its start, and with files whose digest is read before, it has
/// as long as to be ready: a pinned recording may be long.
const BEGIN_LIMIT: Duration = Duration::from_secs(5);
/// A process that is being started when the graph is asked to stop still has this time.
const STOP_LIMIT: Duration = Duration::from_secs(1);
/// The launcher looks after the others this often while a program takes its time.
const LOOK_PAUSE: Duration = Duration::from_millis(5);

impl Launcher {
    /// Starts the program of nodes, and looks after everything else meanwhile.
    pub(super) fn begin(
        &mut self,
        nodes: &[(usize, Node)],
        (prepared, its_pid): (PreparedProgram, PipeReader),
    ) -> Result<BegunProgram, LaunchError> {
        let idxs: Vec<usize> = nodes.iter().map(|(idx, _)| *idx).collect();
        let first = &nodes[0].1;
        let has_digests = nodes.iter().any(|(_, node)| !node.sha256.is_empty());
        let most = if self.has_gone && !has_digests { BEGIN_LIMIT } else { self.options.startup_limit };
        let (answer, begun) = channel();
        let checked: Vec<Node> = nodes.iter().map(|(_, node)| node.clone()).collect();
        let work = move || {
            // The kernel ends a process with the thread that has started it (PR_SET_PDEATHSIG).
            let (life, end) = channel();
            // If nobody waits any more, the process is killed here.
            let _ = answer.send(check_and_begin(&checked, prepared, life));
            let _ = end.recv();
        };
        std::thread::Builder::new().spawn(work).map_err(|source| LaunchError::of_spawn(first, source))?;
        let start = Instant::now();
        loop {
            match begun.recv_timeout(LOOK_PAUSE) {
                Ok(outcome) => return outcome,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(LaunchError::of_spawn(first, std::io::Error::other("its thread has failed")));
                }
            }
            let limit = if self.clients.is_asked_to_stop { most.min(STOP_LIMIT) } else { most };
            if start.elapsed() > limit {
                kill_process_of(its_pid);
                let secs = limit.as_secs_f64();
                let what = format!(
                    "it has not begun within {secs:.1} s: its process was stopped, a file system hangs, or a file with a digest \
                     (sha256) takes long to read"
                );
                let error = std::io::Error::new(std::io::ErrorKind::TimedOut, what);
                return Err(LaunchError::of_spawn(first, error));
            }
            self.listen(Duration::ZERO);
            if self.has_gone {
                self.supervise_others(&idxs);
            }
        }
    }
}

/// Kills a process that has not begun yet: it holds copies of the pipes of all others.
fn kill_process_of(mut its_pid: PipeReader) {
    let mut pid = [0; 4];
    if ioctl_fionbio(&its_pid, true).is_ok()
        && its_pid.read_exact(&mut pid).is_ok()
        && let Some(pid) = Pid::from_raw(i32::from_ne_bytes(pid))
    {
        let _ = kill_process(pid, Signal::KILL);
    }
}

/// `life` goes when the process is needed no more.
fn check_and_begin(nodes: &[Node], prepared: PreparedProgram, life: Sender<()>) -> Result<BegunProgram, LaunchError> {
    for node in nodes {
        let checked = node.sha256.check(&node.program, &node.params);
        checked.map_err(|source| LaunchError::Pin { node: node.id.clone(), source })?;
    }
    prepared.begin(life).map_err(|source| LaunchError::of_spawn(&nodes[0], source))
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::CommandExt;

    use rustix::process::{getpid, test_kill_process};

    use super::*;
    use crate::control::{Reply, Request};
    use crate::launcher::Event;
    use crate::launcher::process::{LineSink, Start};
    use crate::launcher::tests::{ask, launched};

    #[test]
    fn a_process_that_is_stopped_before_its_program_begins_delays_neither_answers_nor_others() {
        let mut graph = launched("stopped", "exec cat > /dev/null", "");
        let launcher = &mut graph.launcher;
        launcher.has_gone = false;
        launcher.options.startup_limit = Duration::from_secs(2);
        let node = launcher.members[0].node.clone();
        let prepared = |launcher: &Launcher| {
            let wiring = launcher.plan.wiring(&node, 1, true).expect("wired");
            let sink = LineSink { node: node.id.clone(), log: None, printer: None };
            PreparedProgram::of(&[Start { id: 99, node: &node, wiring, sink }], None).expect("prepared")
        };
        let nodes = [(0, node.clone())];
        let mut stopping = prepared(launcher);
        let (mut its_pid, tells_pid) = std::io::pipe().expect("a pipe");
        let stop = move || {
            rustix::io::write(&tells_pid, &getpid().as_raw_nonzero().get().to_ne_bytes())?;
            Ok(kill_process(getpid(), Signal::STOP)?)
        };
        // SAFETY: it makes system calls alone.
        unsafe { stopping.0.command.pre_exec(stop) };
        let (asked, replies) = ask(Request::Status);
        launcher.sender.send(Event::Ask(asked)).expect("asked");
        let error = launcher.begin(&nodes, stopping).err().expect("not begun");
        let LaunchError::Spawn { source, .. } = error else { panic!("{error}") };
        assert_eq!(source.kind(), std::io::ErrorKind::TimedOut);
        assert!(matches!(replies.try_recv(), Ok(Reply::Status(_))));
        launcher.options.startup_limit = Duration::from_secs(60);
        let next = prepared(launcher);
        assert!(launcher.begin(&nodes, next).is_ok());
        // It is killed.
        let mut pid = [0; 4];
        its_pid.read_exact(&mut pid).expect("told");
        let pid = Pid::from_raw(i32::from_ne_bytes(pid)).expect("a pid");
        while test_kill_process(pid).is_ok() {
            std::thread::sleep(LOOK_PAUSE);
        }
    }
}
