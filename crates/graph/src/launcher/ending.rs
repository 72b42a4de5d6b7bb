//! The end of a graph: its operators are drained in its order, sources first, and then exit.

use std::time::Duration;

use crate::control::GraphState;
use crate::launcher::LaunchError;
use crate::launcher::lifecycle::{Lifecycle, Surroundings};
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::wiring::Command;

/// The operators behind one that has not drained in time get this time.
const SHORT_GRACE: Duration = Duration::from_millis(50);

/// How far the end of a graph has come.
#[derive(Clone, Default)]
pub(super) enum Ending {
    /// It goes on.
    #[default]
    NotBegun,
    /// The node of this index is asked to drain, and has answered the samples up to `answered`. The deadline is set once no swap is under way.
    Draining {
        idx: usize,
        deadline: Option<Duration>,
        answered: Option<SampleId>,
    },
    Drained,
    /// All are let go. Those that were asked to drain, and have not, are not waited for.
    Quitting {
        since: Duration,
        gave_up: Vec<u64>,
        killed: Option<Vec<String>>,
    },
}

impl Ending {
    pub(super) fn is_quitting(&self) -> bool {
        matches!(self, Ending::Quitting { .. })
    }

    /// Whether an operator that dies is started again, if it may be.
    pub(super) fn supervises(&self) -> bool {
        matches!(self, Ending::NotBegun | Ending::Draining { .. })
    }

    /// The longest time between two looks at how far it has come.
    pub(super) fn pause(&self) -> Option<Duration> {
        match self {
            Ending::NotBegun => None,
            Ending::Draining { .. } => Some(Duration::from_millis(2)),
            Ending::Drained | Ending::Quitting { .. } => Some(Duration::from_millis(1)),
        }
    }
}

impl<S: Surroundings> Lifecycle<S> {
    /// Begins to ask one operator after the other, sources first, to answer the samples left. An operator that dies meanwhile is
    /// started again, if it may be.
    pub(super) fn begin_draining(&mut self) {
        self.abandon_swap("the graph is stopping");
        self.is_launching = false;
        self.state = GraphState::Stopping;
        self.ending = Ending::Draining { idx: 0, deadline: None, answered: None };
    }

    /// Goes on with draining; true once it is over: for all operators within the grace period, and at once if `is_hurried`. After
    /// the last sample of all sources the period begins again with each answer.
    pub(super) fn go_on_draining(&mut self, is_hurried: bool) -> bool {
        while let Ending::Draining { idx, deadline, answered } = self.ending {
            if self.swap.is_some() && !is_hurried {
                return false;
            }
            if idx == self.members.len() {
                self.ending = Ending::Drained;
                return true;
            }
            let last = self.last_answered(idx);
            let goes_on = answered.is_some() && last != answered && !self.is_asked_to_stop && !self.link.was_stopped;
            let deadline = match deadline {
                Some(deadline) if !goes_on => deadline,
                _ => self.now + self.options.grace,
            };
            self.ending = Ending::Draining { idx, deadline: Some(deadline), answered: last };
            if self.drain(idx) {
                self.end_node(idx, deadline);
            } else if self.now >= deadline || is_hurried {
                let what = if is_hurried {
                    "had not drained when it was killed".into()
                } else {
                    format!("did not drain within {} s", self.options.grace.as_secs_f64())
                };
                let node = self.members[idx].node.id.clone();
                self.site.fail(LaunchError::Failed { node, what, log: Vec::new() });
                // The operators behind it may have all that they need, and get a little time.
                self.end_node(idx, self.now + SHORT_GRACE);
            } else {
                return false;
            }
        }
        true
    }

    /// Asks an operator to drain, once no machine feeds it any more; true if it has.
    fn drain(&mut self, idx: usize) -> bool {
        let is_fed = self.link.may_feed(&self.members[idx].node);
        let member = &mut self.members[idx];
        let is_asked = member.active.as_ref().is_none_or(|active| active.is_asked || member.is_source);
        if (member.is_done() && is_asked) || member.is_given_up() || member.is_over {
            return true;
        }
        // Before the sources have gone there is nothing that it could answer.
        if !self.has_gone && member.active.as_ref().is_none_or(|active| !active.is_ready()) {
            return true;
        }
        if let Some(active) = &mut member.active
            && !active.is_asked
            && active.is_ready()
            && !is_fed
        {
            active.is_asked = true;
            self.site.ask_to_drain(active.id);
        }
        false
    }

    /// Tells the other machines that the outputs of a node have ended, and goes on with the next one.
    fn end_node(&mut self, idx: usize, deadline: Duration) {
        self.ending = Ending::Draining { idx: idx + 1, deadline: Some(deadline), answered: None };
        let node = self.members[idx].node.id.clone();
        let link = self.members.iter().find(|member| member.node.is_link() && member.node.id != node);
        if let Some(link) = link {
            if let Some(active) = &link.active {
                self.site.tell(active.id, &Command::NodeEnded { node: node.clone() });
            }
            self.link.ended_nodes.push(node);
        }
    }

    /// Lets all operators exit.
    pub(super) fn begin_quitting(&mut self) {
        self.state = GraphState::Stopping;
        self.is_launching = false;
        let mut gave_up = Vec::new();
        let mut beginning = Vec::new();
        for member in &mut self.members {
            for instance in member.active.iter_mut().chain(&mut member.standby) {
                if instance.pid.is_none() {
                    beginning.push(instance.id);
                    continue;
                }
                // A process that was asked and has not drained will not drain now.
                if instance.is_asked && !instance.is_done {
                    gave_up.push(instance.id);
                } else if !instance.is_done {
                    instance.is_asked = true;
                    self.site.ask_to_drain(instance.id);
                }
                self.site.let_go(instance.id);
            }
        }
        for leaving in &mut self.leaving {
            leaving.let_go(self.now, &mut self.site);
        }
        self.ending = Ending::Quitting { since: self.now, gave_up, killed: None };
        for id in beginning {
            self.kill(id, None);
        }
    }

    /// Goes on with the exit of all operators; true when none is left. Those that are left after the grace period, or once
    /// `is_hurried`, are killed.
    pub(super) fn go_on_quitting(&mut self, is_hurried: bool) -> bool {
        let Ending::Quitting { since, gave_up, killed } = &self.ending else { return false };
        let mut running = Vec::new();
        let mut n_awaited = 0;
        let leaving = self.leaving.iter().map(|leaving| &leaving.instance);
        for instance in self.members.iter().flat_map(|member| member.instances()).chain(leaving) {
            if instance.is_running() {
                running.push(instance.id);
                n_awaited += usize::from(!gave_up.contains(&instance.id));
            }
        }
        if killed.is_some() {
            return running.is_empty();
        }
        if n_awaited > 0 && self.now - *since <= self.options.grace && !is_hurried {
            return false;
        }
        let mut names = Vec::new();
        for id in &running {
            let node = self.member_of(*id).map(|idx| self.members[idx].node.id.clone());
            if self.kill(*id, None) {
                names.extend(node);
            }
        }
        if let Ending::Quitting { killed, .. } = &mut self.ending {
            *killed = Some(names);
        }
        running.is_empty()
    }

    /// The error of a graph of which all operators have exited.
    pub(super) fn error_of_end(&self) -> Option<LaunchError> {
        if let Ending::Quitting { killed: Some(nodes), .. } = &self.ending
            && !nodes.is_empty()
        {
            let grace_secs = self.options.grace.as_secs_f64();
            return Some(LaunchError::Killed { nodes: nodes.clone(), grace_secs });
        }
        for (idx, member) in self.members.iter().enumerate() {
            if !member.is_given_up() && member.active.as_ref().is_some_and(|active| !active.has_ended_well()) {
                return Some(self.failed(idx, false));
            }
        }
        None
    }
}
