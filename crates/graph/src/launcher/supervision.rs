//! Finds operators that have died or hang, starts them again, and gives up operators that keep dying.

use std::time::{Duration, Instant};

use crate::control::{GraphState, NodeState};
use crate::dataflow::{Restart, RestartPolicy};
use crate::launcher::{LaunchError, Launcher, Member, RUNNING};
use crate::log::log_tail;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::namespace::SHARED_MEMORY_FOLDER;
use blindgrasp_operator::wiring::Command;
use blindgrasp_operator::{monotonic_nanos, namespace};

/// The longest pause before a restart, unless the file asks for a longer one.
const MAX_BACKOFF: Duration = Duration::from_secs(10);

/// The pause between two looks at whether shared memory has room again.
const ROOM_PAUSE: Duration = Duration::from_millis(500);

/// The name of the count of samples that are left without an answer.
pub(crate) const QUARANTINED: &str = "quarantined";
const MAX_QUARANTINE: usize = 64;

/// A launcher that has not looked for longer than this was stopped.
const AWAY_NANOS: u64 = 1_000_000_000;

/// The pause before a restart, after so many others. A writer fails that waits for a reader for as long as `wait_limit`: the next
/// instance must be there sooner.
fn pause_before(restart: &Restart, n_before: u32, wait_limit: Duration) -> Duration {
    if n_before == 0 {
        return Duration::ZERO;
    }
    let first = Duration::from_millis(restart.backoff_millis);
    (first * (1 << (n_before - 1).min(10))).min(MAX_BACKOFF.min(wait_limit / 2).max(first))
}

impl Launcher {
    /// Finds dead and hung processes, and starts them again if they may be, of all nodes but those that the launcher waits for.
    /// To be called in every loop that waits.
    pub(super) fn supervise_others(&mut self, awaited: &[usize]) {
        self.kill_hung();
        for idx in 0..self.members.len() {
            let outcome = if awaited.contains(&idx) { Ok(()) } else { self.supervise_node(idx) };
            if let Err(error) = outcome {
                self.failure.get_or_insert(error);
            }
        }
        self.restart_due();
    }

    /// Restarts the nodes whose time has come, once the deaths of all nodes of their processes are known.
    fn restart_due(&mut self) {
        for idx in 0..self.members.len() {
            let is_due = self.members[idx].restart_at.is_some_and(|at| at <= Instant::now());
            if is_due && self.together(idx).iter().all(|idx| self.members[*idx].active.is_none()) {
                self.restart(idx);
            }
        }
    }

    fn supervise_node(&mut self, idx: usize) -> Result<(), LaunchError> {
        let member = &mut self.members[idx];
        if let Some(process) = member.active.as_mut()
            && !member.is_over
        {
            process.look();
            if process.is_stopped_by_somebody_else() {
                process.kill();
                process.finding = Some("was stopped from outside (SIGTERM)".into());
            }
            let has_done_its_work = process.is_asked && process.is_done;
            if !process.is_running() && !has_done_its_work {
                if self.is_on_probation(idx) {
                    // Its predecessor comes back.
                    return Ok(());
                }
                self.on_death(idx)?;
            }
            self.look_at_state(idx);
        }
        Ok(())
    }

    /// Follows a process that is ready, is done, or is not ready in time.
    fn look_at_state(&mut self, idx: usize) {
        let member = &mut self.members[idx];
        let Some(process) = &mut member.active else {
            return;
        };
        if process.is_ready()
            && let Some(died) = member.died.take()
        {
            member.state = NodeState::Running;
            member.waits_for_room = false;
            let line = format!(
                "blindgrasp: node '{}' is back after {:.1} ms",
                member.node.id,
                died.elapsed().as_secs_f64() * 1e3
            );
            self.say(&line);
        } else if !process.is_ready() && process.started.elapsed() > self.options.startup_limit {
            process.kill();
            let limit = self.options.startup_limit.as_secs_f64();
            process.finding = Some(format!("was not ready within {limit} s of its restart"));
        } else if process.is_done && member.state == NodeState::Running {
            member.state = NodeState::Done;
        }
    }

    /// Kills processes without a heartbeat for too long.
    pub(super) fn kill_hung(&mut self) {
        let now = monotonic_nanos();
        // A launcher that was stopped itself, or suspended with the machine, does not know which processes were.
        let was_away = now.saturating_sub(std::mem::replace(&mut self.last_look_nanos, now)) > AWAY_NANOS;
        for idx in 0..self.members.len() {
            self.kill_if_hung(idx, was_away);
        }
    }

    fn kill_if_hung(&mut self, idx: usize, was_away: bool) {
        let member = &mut self.members[idx];
        let Some(limit_millis) = member.node.heartbeat_millis else {
            return;
        };
        let leaving = self.leaving.iter_mut().filter(|leaving| leaving.idx == idx);
        for process in member.processes().chain(leaving.map(|leaving| &mut leaving.process)) {
            let last = self.cursors.instance(process.instance_slot).last_beat_nanos();
            if last == 0 || !process.is_running() {
                continue;
            }
            if was_away {
                self.cursors.instance(process.instance_slot).beat(monotonic_nanos());
            } else if monotonic_nanos().saturating_sub(last) > limit_millis * 1_000_000 {
                let what = format!("had no heartbeat for {limit_millis} ms and was killed");
                process.kill();
                process.finding = Some(what);
            }
        }
    }

    /// Restarts a node whose active process has ended, if it may be.
    fn on_death(&mut self, idx: usize) -> Result<(), LaunchError> {
        // Its last lines may still be on their way. A process that ends by itself with an error says why.
        self.listen(Duration::from_millis(1));
        let exit = self.members[idx].active.as_ref().and_then(|process| process.exit);
        if exit.is_some_and(|exit| exit.code().is_some_and(|code| code != 0)) {
            self.drain_logs(|launcher| launcher.members[idx].active.as_ref());
        }
        let is_stopping = self.state == GraphState::Stopping;
        let member = &mut self.members[idx];
        let Some(process) = &member.active else {
            return Ok(());
        };
        let restart = member.node.restart;
        let (id, ending) = (member.node.id.clone(), process.ending());
        let ended_of_its_own = process.failure().is_none() && process.exit.is_some_and(|status| status.success());
        if is_stopping && process.is_asked && process.has_ended_well() {
            // It ended at SIGTERM at once, which is accepted.
            member.active.iter_mut().for_each(|process| process.is_done = true);
            return Ok(());
        }
        let may_restart = match restart.policy {
            RestartPolicy::Never => false,
            RestartPolicy::OnFailure => !ended_of_its_own || process.is_asked,
            RestartPolicy::Always => true,
        };
        if !may_restart {
            member.is_over = true;
            self.stop_waiting_for(idx);
            return Err(self.failed(&id, true));
        }
        let (log, is_for_want_of_room) = (process.last_lines(), process.has_died_of_full_memory());
        if is_stopping && !self.has_gone {
            // The launch has failed: the graph will not run.
            member.is_over = true;
            self.stop_waiting_for(idx);
            return Ok(());
        }
        if is_for_want_of_room {
            // Neither the node nor the sample is to blame.
            member.active = None;
            self.wait_for_room(idx, &ending, &format!("there is room in {SHARED_MEMORY_FOLDER}"));
            return Ok(());
        }
        // A failure that comes twice at the start for the same reason, such as a file that cannot be read, comes again.
        let start_failure = if process.is_ready() { None } else { process.failure() };
        let is_permanent = start_failure.is_some() && start_failure == member.start_failure;
        member.start_failure = start_failure;
        if is_permanent {
            member.active = None;
            self.give_up(idx, format!("node '{id}' {ending}, twice in a row at its start: it is given up"));
            return Ok(());
        }
        let sample = self.cursors.instance(process.instance_slot).sample();
        member.active = None;
        self.quarantine(idx, sample);
        self.start_again(idx, &ending, &log);
        Ok(())
    }

    /// Leaves a sample without an answer if a node has died on it twice in a row: it would die on it again, and take all that
    /// follow with it.
    fn quarantine(&mut self, idx: usize, sample: Option<SampleId>) {
        let member = &mut self.members[idx];
        let before = std::mem::replace(&mut member.deadly, sample);
        if sample != before {
            return;
        }
        let Some(sample) = sample else {
            return;
        };
        // Those that readers have passed do not come again.
        if member.quarantine.len() == MAX_QUARANTINE {
            member.quarantine.remove(0);
        }
        member.quarantine.push(sample);
        *member.counts.entry(QUARANTINED.into()).or_default() += 1;
        let line = format!(
            "blindgrasp: node '{}' has died twice on sample {}: the sample is left without an answer",
            member.node.id, sample.seq
        );
        self.say(&line);
    }

    /// Plans the restart of a node without a process, or gives it up after too many.
    pub(super) fn start_again(&mut self, idx: usize, ending: &str, log: &[String]) {
        let now = Instant::now();
        let member = &mut self.members[idx];
        let (id, restart) = (member.node.id.clone(), member.node.restart);
        let window = Duration::from_millis(restart.within_millis);
        member.restarts.retain(|at| now.duration_since(*at) <= window);
        if member.restarts.len() >= restart.limit as usize {
            let message = format!(
                "node '{id}' {ending}, {} times within {} s: it is given up{}",
                member.restarts.len() + 1,
                window.as_secs_f64(),
                log_tail(log)
            );
            return self.give_up(idx, message);
        }
        let n_before = member.restarts.len() as u32;
        let backoff = pause_before(&restart, n_before, self.options.wait_limit);
        member.state = NodeState::Restarting;
        member.waits_for_room = false;
        member.died.get_or_insert(now);
        member.restart_at = Some(now + backoff);
        self.say(&format!("blindgrasp: node '{id}' {ending}; it is started again"));
    }

    /// Plans the restart of a node without a process for when the machine has room for it, `when`. It does not count among its
    /// restarts.
    fn wait_for_room(&mut self, idx: usize, ending: &str, when: &str) {
        let now = Instant::now();
        let member = &mut self.members[idx];
        member.state = NodeState::Restarting;
        member.died.get_or_insert(now);
        member.restart_at = Some(now + ROOM_PAUSE);
        if !std::mem::replace(&mut member.waits_for_room, true) {
            let line = format!("blindgrasp: node '{}' {ending}; it is started again when {when}", member.node.id);
            self.say(&line);
        }
        // The memory of the dead process is free then.
        self.reap();
    }

    fn restart(&mut self, idx: usize) {
        let idxs = self.together(idx);
        let waits_for_room = idxs.iter().any(|idx| self.members[*idx].waits_for_room);
        if waits_for_room && namespace::is_full() {
            let again = Instant::now() + ROOM_PAUSE;
            // Dead processes may hold memory that could not be freed before.
            self.reap();
            return idxs.into_iter().for_each(|idx| self.members[idx].restart_at = Some(again));
        }
        // While it begins, nobody starts it once more.
        idxs.iter().for_each(|idx| self.members[*idx].restart_at = None);
        let failure = self.spawn_active(idx).err().map(|error| (error.is_shortage(), anyhow::Error::from(error)));
        if let Some((true, error)) = &failure {
            let (ending, when) = (format!("is missing ({error:#})"), "the machine can start processes again");
            return idxs.into_iter().for_each(|idx| self.wait_for_room(idx, &ending, when));
        }
        // A source fails because a node behind it waits for room.
        let is_counted = !self.members.iter().any(|member| member.waits_for_room);
        for idx in &idxs {
            let member = &mut self.members[*idx];
            if is_counted {
                member.restarts.push_back(Instant::now());
            }
            member.n_restarts += 1;
        }
        if let Some((_, error)) = failure {
            let message = format!("{error:#}");
            return idxs.into_iter().for_each(|idx| self.start_again(idx, &message, &[]));
        }
        for idx in idxs {
            let member = &mut self.members[idx];
            let is_link = member.node.is_link();
            let Some(process) = &mut member.active else {
                continue;
            };
            if is_link || self.has_gone {
                process.tell(&Command::Go);
            }
            if is_link {
                // It must know what its predecessor knew.
                self.link.ended_nodes.iter().for_each(|node| process.tell(&Command::NodeEnded { node: node.clone() }));
            }
        }
        self.reap();
    }

    /// Frees the iceoryx2 resources of dead processes, on a thread because it takes milliseconds.
    pub(super) fn reap(&self) {
        let domain = self.plan.domain().clone();
        // Without a thread, they are freed the next time.
        let _ = std::thread::Builder::new().spawn(move || namespace::clean_dead_nodes(&domain));
    }

    /// Tells the writers of a node's inputs that it reads no more.
    fn stop_waiting_for(&self, idx: usize) {
        for slot in self.plan.input_slots(&self.members[idx].node.id) {
            self.cursors.input(slot).give_up(true);
        }
    }

    /// Gives up a node, and those that share its process; the graph goes on without them.
    pub(super) fn give_up(&mut self, idx: usize, message: String) {
        for idx in self.together(idx) {
            self.stop_waiting_for(idx);
            let member = &mut self.members[idx];
            member.state = NodeState::Failed;
            member.restart_at = None;
            member.active.take_if(|process| {
                process.look();
                !process.is_running()
            });
        }
        self.state = GraphState::Degraded;
        self.say(&format!(
            "blindgrasp: graph '{}' is degraded: {message}\nblindgrasp: nothing behind it is decided until it is swapped",
            self.name
        ));
        self.service.has_status(&format!("degraded: {}", message.lines().next().unwrap_or_default()));
        self.degraded = Some(message);
        self.reap();
    }

    /// Takes back a node that was given up, after a swap has given it a new process.
    pub(super) fn heal(&mut self, idx: usize) {
        let slots: Vec<usize> = self.plan.input_slots(&self.members[idx].node.id).collect();
        for slot in slots {
            self.cursors.input(slot).give_up(false);
        }
        self.members[idx].is_over = false;
        self.members[idx].restarts.clear();
        if !self.members.iter().any(Member::is_given_up) && self.state == GraphState::Degraded {
            self.state = GraphState::Running;
            self.service.has_status(RUNNING);
            self.degraded = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_back_before_its_writers_give_up() {
        let millis = Duration::from_millis;
        let pause = |n_before, wait_millis| pause_before(&Restart::default(), n_before, millis(wait_millis));
        let pauses: Vec<Duration> = [0, 1, 2, 9, 10, 60].map(|n_before| pause(n_before, 5000)).into();
        assert_eq!(pauses, [0, 10, 20, 2500, 2500, 2500].map(millis));
        assert_eq!((pause(10, 60_000), pause(11, 60_000)), (millis(5120), MAX_BACKOFF));
        let slow = Restart { backoff_millis: 60_000, ..Restart::default() };
        assert_eq!(pause_before(&slow, 5, millis(5000)), millis(60_000), "the file asks for it");
    }
}
