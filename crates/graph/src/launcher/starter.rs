//! Starts a program on a thread of its own. The call of the system ends only when the program has begun, which a process that is
//! stopped before, or a file system that hangs, delays without end; so do the digests of pinned files.

use std::io::{PipeReader, Read};
use std::sync::mpsc::{Sender, SyncSender, channel};

use rustix::io::ioctl_fionbio;
use rustix::process::{Pid, Signal, kill_process};

use crate::dataflow::Node;
use crate::launcher::process::{BegunProgram, PreparedProgram};
use crate::launcher::{Event, LaunchError};

/// Starts the program of nodes. Its outcome goes to `events` under this id.
///
/// # Errors
/// The system has no threads left.
pub(super) fn begin(
    id: u64,
    nodes: Vec<Node>,
    prepared: PreparedProgram,
    events: &SyncSender<Event>,
) -> Result<(), LaunchError> {
    let first = nodes[0].clone();
    let events = events.clone();
    let work = move || {
        // The kernel ends a process with the thread that has started it (PR_SET_PDEATHSIG).
        let (life, end) = channel();
        // If the program is not wanted any more, its process is killed.
        let _ = events.send(Event::Begun(id, check_and_begin(&nodes, prepared, life)));
        let _ = end.recv();
    };
    let spawned = std::thread::Builder::new().spawn(work);
    spawned.map(drop).map_err(|source| LaunchError::of_spawn(&first, source))
}

/// Kills a process that has not begun yet: it holds copies of the pipes of all others.
pub(super) fn kill_process_of(mut its_pid: PipeReader) {
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
    use crate::launcher::lifecycle::Surroundings;
    use crate::launcher::process::{LineSink, Start};
    use crate::launcher::tests::{ask, launched, work_until};

    #[test]
    fn a_process_that_is_stopped_before_its_program_begins_delays_neither_answers_nor_others() {
        let mut graph = launched("stopped", "exec cat > /dev/null", "");
        let launcher = &mut graph.launcher;
        let hands = &mut launcher.life.site;
        let node = launcher.life.members[0].node.clone();
        let wiring = hands.plan.wiring(&node, 1, true).expect("wired");
        let sink = LineSink { node: node.id.clone(), log: None, printer: None };
        let starts = vec![Start { id: 99, node: node.clone(), wiring, sink }];
        let (mut stopping, its_pid) = PreparedProgram::of(&starts, None).expect("prepared");
        let (mut told_pid, tells_pid) = std::io::pipe().expect("a pipe");
        let stop = move || {
            rustix::io::write(&tells_pid, &getpid().as_raw_nonzero().get().to_ne_bytes())?;
            Ok(kill_process(getpid(), Signal::STOP)?)
        };
        // SAFETY: it makes system calls alone.
        unsafe { stopping.command.pre_exec(stop) };
        begin(99, vec![node], stopping, &hands.events).expect("on its way");
        hands.starting.insert(99, (starts, its_pid));
        let mut pid = [0; 4];
        told_pid.read_exact(&mut pid).expect("told");
        // The launcher answers, and starts other processes.
        let (asked, replies) = ask(Request::Status);
        launcher.on_ask(asked);
        assert!(matches!(replies.try_recv(), Ok(Reply::Status(_))));
        let active = launcher.life.members[0].active.as_ref().expect("an instance").id;
        launcher.life.kill(active, None);
        work_until(launcher, |launcher| launcher.status().nodes[0].n_restarts == 1);
        // When it has had its time, it is killed.
        launcher.life.site.kill(99);
        let pid = Pid::from_raw(i32::from_ne_bytes(pid)).expect("a pid");
        work_until(launcher, |_| test_kill_process(pid).is_err());
    }
}
