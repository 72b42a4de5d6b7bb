//! Finds operators that have died or hang, starts them again, and gives up operators that keep dying.

use std::time::Duration;

use crate::control::{GraphState, NodeState};
use crate::dataflow::{Restart, RestartPolicy};
use crate::launcher::RUNNING;
use crate::launcher::lifecycle::{LOG_DRAIN_LIMIT, Lifecycle, Member, Surroundings};
use crate::log::log_tail;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::namespace::SHARED_MEMORY_FOLDER;

/// The longest pause before a restart, unless the file asks for a longer one.
const MAX_BACKOFF: Duration = Duration::from_secs(10);

/// The pause between two looks at whether shared memory has room again.
const ROOM_PAUSE: Duration = Duration::from_millis(500);

/// The name of the count of samples that are left without an answer.
pub(crate) const QUARANTINED: &str = "quarantined";
const MAX_QUARANTINE: usize = 64;

/// What a process says right before it ends is heard within this time.
const HEARING: Duration = Duration::from_millis(1);

/// The pause before a restart, after so many others. A writer fails that waits for a reader for as long as `wait_limit`: the next
/// instance must be there sooner.
fn pause_before(restart: &Restart, n_before: u32, wait_limit: Duration) -> Duration {
    if n_before == 0 {
        return Duration::ZERO;
    }
    let first = Duration::from_millis(restart.backoff_millis);
    (first * (1 << (n_before - 1).min(10))).min(MAX_BACKOFF.min(wait_limit / 2).max(first))
}

impl<S: Surroundings> Lifecycle<S> {
    /// Finds dead processes, and starts them again if they may be, of all nodes but those whose old instance stands by.
    pub(super) fn supervise(&mut self) {
        if !self.ending.supervises() {
            return;
        }
        for idx in 0..self.members.len() {
            if self.is_launching {
                self.supervise_launch(idx);
            } else {
                self.supervise_node(idx);
            }
        }
        // Once the deaths of all nodes of their processes are known.
        for idx in 0..self.members.len() {
            let is_due = self.members[idx].restart_at.is_some_and(|at| at <= self.now);
            if is_due
                && !self.is_in_swap(idx)
                && self.together(idx).iter().all(|idx| self.members[*idx].active.is_none())
            {
                self.restart(idx);
            }
        }
    }

    /// An operator that ends or fails before all are ready ends the launch.
    fn supervise_launch(&mut self, idx: usize) {
        let has_begun = self.members.iter().all(|member| member.active.as_ref().is_some_and(|each| each.pid.is_some()));
        let member = &mut self.members[idx];
        if has_begun
            && !member.is_over
            && member.active.as_ref().is_some_and(|active| active.is_heard(self.now, LOG_DRAIN_LIMIT))
        {
            member.is_over = true;
            let error = self.failed(idx, true);
            self.site.fail(error);
        }
    }

    fn supervise_node(&mut self, idx: usize) {
        let member = &self.members[idx];
        let Some(active) = &member.active else { return };
        if member.is_over {
            return;
        }
        if active.is_stopped && !active.is_asked {
            self.kill(active.id, Some("was stopped from outside (SIGTERM)".into()));
        }
        let Some(active) = &self.members[idx].active else { return };
        // Its process is started again for another node of its group, and cannot do without it.
        let is_needed = self.together(idx).iter().any(|mate| self.members[*mate].restart_at.is_some());
        let has_done_its_work = active.is_asked && active.is_done && !is_needed;
        if !active.is_running() && !has_done_its_work {
            // A process that ends by itself with an error says why.
            let limit = if active.has_exited_in_error() { LOG_DRAIN_LIMIT } else { HEARING };
            if !active.is_heard(self.now, limit) || self.is_in_swap(idx) {
                return;
            }
            self.on_death(idx);
        }
        self.look_at_state(idx);
    }

    /// Follows a process that is ready, is done, or is not ready in time.
    fn look_at_state(&mut self, idx: usize) {
        let member = &mut self.members[idx];
        let Some(active) = &member.active else { return };
        if active.is_ready()
            && let Some(died) = member.died.take()
        {
            member.state = NodeState::Running;
            member.waits_for_room = false;
            let millis = (self.now - died).as_secs_f64() * 1e3;
            self.site.say(&format!("blindgrasp: node '{}' is back after {millis:.1} ms", member.node.id));
        } else if active.pid.is_some() && !active.is_ready() && self.now - active.started > self.options.startup_limit {
            let id = active.id;
            let limit = self.options.startup_limit.as_secs_f64();
            self.kill(id, Some(format!("was not ready within {limit} s of its restart")));
        } else if active.is_done && member.state == NodeState::Running {
            member.state = NodeState::Done;
        }
    }

    /// Restarts a node whose active process has ended, if it may be.
    fn on_death(&mut self, idx: usize) {
        let is_stopping = self.state == GraphState::Stopping;
        let member = &mut self.members[idx];
        let policy = member.node.restart.policy;
        let Some(active) = &mut member.active else { return };
        let ending = active.ending();
        if is_stopping && active.is_asked && active.has_ended_well() {
            // It ended at SIGTERM at once, which is accepted.
            active.is_done = true;
            return;
        }
        let may_restart = match policy {
            RestartPolicy::Never => false,
            RestartPolicy::OnFailure => !active.has_succeeded() || active.is_asked,
            RestartPolicy::Always => true,
        };
        if !may_restart {
            let error = self.failed(idx, true);
            self.site.fail(error);
        }
        // If the launch has failed, the graph will not run.
        if !may_restart || (is_stopping && !self.has_gone) {
            let member = &mut self.members[idx];
            member.is_over = true;
            return self.site.stop_waiting_for(&member.node, true);
        }
        let member = &mut self.members[idx];
        let Some(active) = member.active.take() else { return };
        let log = self.site.last_lines(active.id);
        self.site.forget(active.id);
        if active.has_died_of_full_memory() {
            // Neither the node nor the sample is to blame.
            return self.wait_for_room(idx, &ending, &format!("there is room in {SHARED_MEMORY_FOLDER}"));
        }
        // A failure that comes twice at the start for the same reason, such as a file that cannot be read, comes again.
        let start_failure = if active.is_ready() { None } else { active.failure };
        let is_permanent = start_failure.is_some() && start_failure == member.start_failure;
        member.start_failure = start_failure;
        if is_permanent {
            let id = &member.node.id;
            let message = format!("node '{id}' {ending}, twice in a row at its start: it is given up");
            return self.give_up(idx, message);
        }
        self.quarantine(idx, active.death.and_then(|death| death.sample));
        self.start_again(idx, &ending, &log);
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
        self.site.say(&line);
    }

    /// Plans the restart of a node without a process, or gives it up after too many.
    pub(super) fn start_again(&mut self, idx: usize, ending: &str, log: &[String]) {
        let now = self.now;
        let member = &mut self.members[idx];
        let (id, restart) = (member.node.id.clone(), member.node.restart);
        let window = Duration::from_millis(restart.within_millis);
        member.restarts.retain(|at| now - *at <= window);
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
        self.site.say(&format!("blindgrasp: node '{id}' {ending}; it is started again"));
    }

    /// Plans the restart of a node without a process for when the machine has room for it, `when`. It does not count among its
    /// restarts.
    fn wait_for_room(&mut self, idx: usize, ending: &str, when: &str) {
        let now = self.now;
        let member = &mut self.members[idx];
        member.state = NodeState::Restarting;
        member.died.get_or_insert(now);
        member.restart_at = Some(now + ROOM_PAUSE);
        if !std::mem::replace(&mut member.waits_for_room, true) {
            let line = format!("blindgrasp: node '{}' {ending}; it is started again when {when}", member.node.id);
            self.site.say(&line);
        }
        // The memory of the dead process is free then.
        self.site.reap();
    }

    fn restart(&mut self, idx: usize) {
        let idxs = self.together(idx);
        if idxs.iter().any(|idx| self.members[*idx].waits_for_room) && self.site.is_memory_full() {
            // Dead processes may hold memory that could not be freed before.
            self.site.reap();
            for idx in idxs {
                self.members[idx].restart_at = Some(self.now + ROOM_PAUSE);
            }
            return;
        }
        self.start_active(idx);
    }

    /// The processes of these nodes could not be started again.
    pub(super) fn on_failed_restart(&mut self, idxs: &[usize], is_shortage: bool, message: &str) {
        for idx in idxs {
            if is_shortage {
                let ending = format!("is missing ({message})");
                self.wait_for_room(*idx, &ending, "the machine can start processes again");
            } else {
                self.count_restart(*idx);
            }
        }
        if !is_shortage {
            for idx in idxs {
                self.start_again(*idx, message, &[]);
            }
        }
    }

    pub(super) fn count_restart(&mut self, idx: usize) {
        // A source fails because a node behind it waits for room.
        let is_counted = !self.members.iter().any(|member| member.waits_for_room);
        let member = &mut self.members[idx];
        if is_counted {
            member.restarts.push_back(self.now);
        }
        member.n_restarts += 1;
    }

    /// Gives up a node, and those that share its process; the graph goes on without them.
    pub(super) fn give_up(&mut self, idx: usize, message: String) {
        for idx in self.together(idx) {
            let member = &mut self.members[idx];
            self.site.stop_waiting_for(&member.node, true);
            member.state = NodeState::Failed;
            member.restart_at = None;
            if let Some(active) = member.active.take_if(|active| !active.is_running()) {
                self.site.forget(active.id);
            }
        }
        if self.state != GraphState::Stopping {
            self.state = GraphState::Degraded;
        }
        self.site.say(&format!(
            "blindgrasp: graph '{}' is degraded: {message}\nblindgrasp: nothing behind it is decided until it is swapped",
            self.name
        ));
        self.site.has_status(&format!("degraded: {}", message.lines().next().unwrap_or_default()));
        self.degraded = Some(message);
    }

    /// Takes back a node that was given up, after a swap has given it a new process.
    pub(super) fn heal(&mut self, idx: usize) {
        let member = &mut self.members[idx];
        self.site.stop_waiting_for(&member.node, false);
        member.is_over = false;
        member.restarts.clear();
        if !self.members.iter().any(Member::is_given_up) && self.state == GraphState::Degraded {
            self.state = GraphState::Running;
            self.site.has_status(RUNNING);
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
