//! Replaces operators of a running graph, without a lost, repeated or re-ordered sample.
//!
//! 1. The replacement starts as a standby beside the running operator: it opens its ports, loads what it needs, and
//!    computes live samples, so that it is warm. No writer waits for it; if it crashes, hangs or does not fit the
//!    graph, it is killed and the graph goes on as before.
//! 2. The running operator finishes the sample at hand and reports it; the cursors then tell its last sample.
//! 3. The replacement takes over from there. The samples that came meanwhile lie in its own queue. Between 2 and 3
//!    no operator answers: that is the handover pause.
//! 4. For its probation the old one stands by. If the new one fails, the old one takes over in the same way.
//!
//! The place in the stream and the saved state, if there is one, are handed over: both are with the cursors, so that
//! handing over does not differ from coming back after a crash. A replacement with a state in the place of an operator
//! without one begins with an empty state, at the same place in the stream; one without drops the state.

use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use serde_json::{Map, Value};

use crate::control::{GraphState, NodeState, Reply, SwapRequest, SwappedNode};
use crate::dataflow::{Node, accept_param, accept_param_value};
use crate::launcher::process::Process;
use crate::launcher::{Launcher, Leaving};
use crate::log::log_tail;
use crate::plan::Port;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::wiring::Command;

/// A replacement computes live samples for at most this long before it takes over: an idle graph has none.
const WARM_LIMIT: Duration = Duration::from_millis(500);
/// An operator must finish the sample at hand, or take over, within this time.
const HAND_OVER_LIMIT: Duration = Duration::from_secs(2);

pub(super) struct Swap {
    request: SwapRequest,
    client: u64,
    reply: SyncSender<Reply>,
    targets: Vec<Target>,
    phase: Phase,
    since: Instant,
}

/// A node that is being replaced.
struct Target {
    idx: usize,
    /// The node with the replacement's program and parameters.
    node: Node,
    old_pid: u32,
    new_pid: u32,
    /// The last sample that the old one answered.
    last: Option<SampleId>,
    /// The last sample that it sent at each output.
    sent: Vec<(Port, SampleId)>,
    handover_pause: Duration,
    /// Whether the node had been given up before.
    was_given_up: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Starting,
    Warming,
    Shadowing,
    Probation,
}

impl Swap {
    /// Whether a node is being replaced.
    pub(super) fn concerns(&self, id: &str) -> bool {
        self.targets.iter().any(|target| target.node.id == id)
    }

    fn tell(&self, reply: Reply) {
        let _ = self.reply.try_send(reply);
    }

    fn progress(&self, message: String) {
        self.tell(Reply::Progress { message });
    }
}

impl Launcher {
    /// Starts the replacements, or answers why not. `description` is that of the new program, if there is one.
    pub(super) fn begin_swap(
        &mut self,
        request: SwapRequest,
        description: Option<Result<OperatorDescription, String>>,
        client: u64,
        reply: SyncSender<Reply>,
    ) {
        if !matches!(self.state, GraphState::Running | GraphState::Degraded) {
            return refuse(&reply, "the graph is starting or stopping");
        }
        if let Some(swap) = &self.swap {
            let nodes: Vec<_> = swap.targets.iter().map(|target| target.node.id.as_str()).collect();
            return refuse(&reply, &format!("a swap of {} is under way; wait for its end", nodes.join(", ")));
        }
        let description = match description.transpose() {
            Ok(description) => description,
            Err(error) => return refuse(&reply, &format!("the replacement cannot be used: {error}")),
        };
        let targets = match self.plan_swap(&request, description.as_ref()) {
            Ok(targets) => targets,
            Err(message) => return refuse(&reply, &message),
        };
        let mut swap = Swap { request, client, reply, targets, phase: Phase::Starting, since: Instant::now() };
        self.clients.begins_swap = Some(client);
        for at in 0..swap.targets.len() {
            let idx = swap.targets[at].idx;
            if self.members[idx].standby.is_some() {
                // It shares the process of a target before it.
                continue;
            }
            let together = self.together(idx);
            let nodes = swap.targets.iter().filter(|target| together.contains(&target.idx));
            let nodes: Vec<(usize, Node)> = nodes.map(|target| (target.idx, target.node.clone())).collect();
            match self.spawn(&nodes, true) {
                Ok(processes) => {
                    for ((idx, _), process) in nodes.into_iter().zip(processes) {
                        self.members[idx].standby = Some(process);
                    }
                }
                Err(error) => {
                    let message = format!("{:#}", anyhow::Error::from(error));
                    self.swap = Some(swap);
                    return self.abandon_swap(&message);
                }
            }
        }
        for target in &mut swap.targets {
            target.new_pid = self.members[target.idx].standby.as_ref().map_or(0, Process::pid);
        }
        let starting: Vec<_> =
            swap.targets.iter().map(|target| format!("{} (process {})", target.node.id, target.new_pid)).collect();
        swap.progress(format!("started beside the running one: {}", starting.join(", ")));
        self.swap = Some(swap);
        if self.clients.begins_swap.take().is_none() {
            self.on_client_gone(client);
        }
    }

    /// The replacements, checked against the graph as it runs.
    fn plan_swap(
        &self,
        request: &SwapRequest,
        description: Option<&OperatorDescription>,
    ) -> Result<Vec<Target>, String> {
        let asked = request.nodes.iter().map(|id| self.member_idx(id)).collect::<Result<Vec<_>, _>>()?;
        let mut idxs: Vec<usize> = asked.into_iter().flat_map(|idx| self.together(idx)).collect();
        idxs.sort_unstable();
        idxs.dedup();
        if idxs.is_empty() {
            return Err("name the node to swap".into());
        }
        if idxs.len() > 1 && request.program.is_some() {
            return Err(
                "one program cannot replace several nodes: swap them one by one, or only their parameters. The \
                        nodes of a group are swapped together"
                    .into(),
            );
        }
        let mut targets = Vec::new();
        for idx in idxs {
            let member = &self.members[idx];
            if member.node.is_link() {
                return Err("the link to the other machines cannot be swapped; if it dies it is started again".into());
            }
            if self.free_instance(idx).is_none() {
                return Err(format!(
                    "earlier instances of node '{}' have not ended yet; try again in some seconds",
                    member.node.id
                ));
            }
            let mut node = member.node.clone();
            if let (Some(program), Some(description)) = (&request.program, description) {
                check_ports(&node, description)?;
                node.program = program.clone();
                node.args = request.args.clone().unwrap_or_default();
                node.description = description.clone();
            }
            node.params = self.swapped_params(&node, request)?;
            let old_pid = member.active.as_ref().map_or(0, Process::pid);
            targets.push(Target {
                idx,
                node,
                old_pid,
                new_pid: 0,
                last: None,
                sent: Vec::new(),
                handover_pause: Duration::ZERO,
                was_given_up: member.is_given_up(),
            });
        }
        for name in request.set.keys() {
            if targets.iter().all(|target| target.node.description.params.iter().all(|param| param.name != *name)) {
                // Its error says what there is.
                accept_param(&targets[0].node.description, name, "", &request.folder)?;
            }
        }
        Ok(targets)
    }

    /// The params of a replacement: as asked for, or as the node has them, or by default.
    fn swapped_params(&self, node: &Node, request: &SwapRequest) -> Result<Map<String, Value>, String> {
        let description = &node.description;
        let mut params = Map::new();
        for param in &description.params {
            let name = &param.name;
            let value = if let Some(text) = request.set.get(name) {
                if param.optional && param.kind.is_left_out(text) {
                    continue;
                }
                accept_param(description, name, text, &request.folder)?
            } else if let Some(value) = node.params.get(name) {
                accept_param_value(description, name, value, &request.folder)?
            } else if let Some(default) = &param.default {
                accept_param_value(description, name, default, &self.folder)?
            } else if param.is_required() {
                return Err(format!(
                    "the replacement of '{}' needs the param '{name}': give it with --set {name}=…",
                    node.id
                ));
            } else {
                continue;
            };
            params.insert(name.clone(), value);
        }
        Ok(params)
    }

    /// Takes a swap a step further, if one is under way.
    pub(super) fn go_on_with_swap(&mut self) {
        let Some(swap) = &self.swap else {
            return;
        };
        let waited = swap.since.elapsed();
        if swap.phase == Phase::Probation {
            return self.go_on_with_probation(waited);
        }
        let mut is_ready = true;
        let mut is_warm = true;
        let mut failed = None;
        for target in &swap.targets {
            let Some(process) = &mut self.members[target.idx].standby else {
                continue;
            };
            process.look();
            if !process.is_running() || process.failure().is_some() {
                failed = Some((target.node.id.clone(), target.idx));
            }
            is_ready &= process.is_ready();
            // A source computes nothing beside another source.
            is_warm &= process.is_warm || target.node.inputs.iter().all(|input| input.feedback);
        }
        if let Some((id, idx)) = failed {
            self.drain_logs(|launcher| launcher.members[idx].standby.as_ref());
            let ending = self.members[idx].standby.as_ref().map_or_else(String::new, |process| {
                let lines = if process.failure().is_none() { process.last_lines() } else { Vec::new() };
                format!("{}{}", process.ending(), log_tail(&lines))
            });
            return self.abandon_swap(&format!("the replacement of '{id}' {ending}"));
        }
        match swap.phase {
            Phase::Starting if is_ready => match self.find_mismatch() {
                Some(message) => self.abandon_swap(&message),
                None => self.enter(Phase::Warming, "ready; computes live samples beside the running one"),
            },
            Phase::Starting if waited > Duration::from_millis(swap.request.ready_limit_millis) => {
                let limit = swap.request.ready_limit_millis as f64 / 1e3;
                self.abandon_swap(&format!("the replacement was not ready within {limit} s"));
            }
            Phase::Warming if is_warm || waited > WARM_LIMIT => {
                if swap.request.shadow_limit_millis == 0 {
                    return self.hand_over();
                }
                let outputs =
                    swap.targets.iter().flat_map(|target| self.plan.shadow_outputs(&target.node.id)).collect();
                swap.tell(Reply::Shadowing { domain: self.plan.domain().clone(), outputs });
                self.enter(Phase::Shadowing, "runs in the shadow");
            }
            Phase::Shadowing if waited > Duration::from_millis(swap.request.shadow_limit_millis) => {
                self.abandon_swap("the comparison was not ended in time");
            }
            _ => {}
        }
    }

    fn enter(&mut self, phase: Phase, message: &str) {
        if let Some(swap) = &mut self.swap {
            swap.phase = phase;
            swap.since = Instant::now();
            swap.progress(message.into());
        }
    }

    /// A replacement must be made for the same hand and model as its neighbours, and for the same hand as the operator
    /// that it replaces.
    fn find_mismatch(&self) -> Option<String> {
        for target in self.swap.iter().flat_map(|swap| &swap.targets) {
            let id = &target.node.id;
            // Without a state it answers each sample by definition.
            let has_state = self.members[target.idx].standby.as_ref().is_some_and(|process| process.has_state);
            if has_state && !target.node.description.answers_each && self.plan.relies_on_each_answer(id) {
                return Some(format!(
                    "the replacement of '{id}' has a state and does not say that it answers each sample, on which the nodes \
                     before '{id}' rely: expected \"answers_each\": true in its description; start the graph with it instead"
                ));
            }
        }
        let swap = self.swap.as_ref().filter(|swap| !swap.request.allow_mismatch)?;
        for target in &swap.targets {
            let identity = self.members[target.idx].standby.as_ref()?.identity.as_ref()?;
            for (idx, member) in self.members.iter().enumerate() {
                let is_swapped = swap.targets.iter().any(|target| target.idx == idx);
                let process = if is_swapped { &member.standby } else { &member.active };
                let is_itself = idx == target.idx;
                let other = if is_itself { &member.active } else { process };
                let other = other.as_ref().and_then(|process| process.identity.as_ref());
                for (key, value) in identity {
                    let theirs = other.and_then(|other| other.get(key)).filter(|theirs| *theirs != value);
                    // Only the hand must agree with its predecessor's: a new dictionary may be the reason of the swap.
                    if let Some(theirs) = theirs
                        && (!is_itself || key == "hand")
                    {
                        let whose =
                            if is_itself { "the running one".into() } else { format!("node '{}'", member.node.id) };
                        return Some(format!(
                            "the replacement of '{}' is made for the {key} {value}, {whose} for {theirs}: the arbiter would \
                             hold every grasp. Swap the nodes together (blindgrasp swap A B --set …), or say --allow-mismatch",
                            target.node.id
                        ));
                    }
                }
            }
        }
        None
    }

    /// From the running operators to their replacements, at one place in the stream.
    fn hand_over(&mut self) {
        let Some(mut swap) = self.swap.take() else {
            return;
        };
        let mut handed_over: Option<Instant> = None;
        for at in 0..swap.targets.len() {
            let idx = swap.targets[at].idx;
            // The old operator still answers the samples of the target before it.
            let is_running = self.members[idx].active.as_ref().is_some_and(Process::is_running);
            if at > 0
                && is_running
                && !self.wait_until(&swap, |launcher| launcher.has_caught_up(&swap.targets[..at], idx))
            {
                let message = format!("node '{}' did not answer what was sent to it", swap.targets[at].node.id);
                return self.take_back(swap, at, &message);
            }
            if let Some(process) = self.members[idx].active.as_mut().filter(|process| process.is_running()) {
                (process.has_handed_over, process.has_sent_all) = (false, false);
                process.tell(&Command::HandOver);
            }
            if !self.wait_until(&swap, |launcher| launcher.has_answered(idx, |process| process.has_handed_over)) {
                let message = format!("the running '{}' did not hand over", swap.targets[at].node.id);
                return self.take_back(swap, at + 1, &message);
            }
            handed_over.get_or_insert_with(Instant::now);
            swap.targets[at].last = self.last_answered(idx);
            swap.targets[at].sent = self.last_sent(idx);
        }
        self.exchange(&swap.targets);
        for at in 0..swap.targets.len() {
            let idx = swap.targets[at].idx;
            self.wait_until(&swap, |launcher| launcher.has_answered(idx, |process| process.has_taken_over));
            if !self.members[idx].active.as_ref().is_some_and(|process| process.has_taken_over) {
                // Its last lines may still be on their way.
                self.listen(Duration::from_millis(5));
                let id = &swap.targets[at].node.id;
                let message = match &self.members[idx].active {
                    Some(process) if !process.is_running() => {
                        format!("the replacement of '{id}' {} as it took over", process.ending())
                    }
                    _ => format!("the replacement of '{id}' did not take over within {} s", HAND_OVER_LIMIT.as_secs()),
                };
                return self.roll_back(swap, &message);
            }
            swap.targets[at].handover_pause = handed_over.map_or(Duration::ZERO, |since| since.elapsed());
            self.members[idx].state = NodeState::Running;
            self.heal(idx);
        }
        swap.phase = Phase::Probation;
        swap.since = Instant::now();
        let pause = swap.targets.iter().map(|target| target.handover_pause).max().unwrap_or_default();
        swap.progress(format!("has taken over, {:.2} ms without an answer; on probation", pause.as_secs_f64() * 1e3));
        self.swap = Some(swap);
    }

    /// Lets the replacements take over, downstream ones first.
    fn exchange(&mut self, targets: &[Target]) {
        for target in targets.iter().rev() {
            let member = &mut self.members[target.idx];
            std::mem::swap(&mut member.active, &mut member.standby);
            // A restart that was due is no longer needed.
            (member.restart_at, member.died) = (None, None);
            let is_handed_over = member.standby.as_ref().is_some_and(has_handed_over_all);
            if let Some(process) = &mut member.active {
                process.has_taken_over = false;
                process.tell(&Command::Go);
                process.tell(&Command::TakeOver { is_handed_over });
            }
        }
    }

    /// Whether a node's process has answered a command, or will not.
    fn has_answered(&self, idx: usize, has: fn(&Process) -> bool) -> bool {
        let active = self.members[idx].active.as_ref();
        active.is_none_or(|process| has(process) || !process.is_running())
    }

    /// Before any replacement is active: the first `n` running operators go on.
    fn take_back(&mut self, swap: Swap, n: usize, message: &str) {
        for target in &swap.targets[..n] {
            if let Some(process) = &mut self.members[target.idx].active {
                process.tell(&Command::TakeOver { is_handed_over: has_handed_over_all(process) });
            }
        }
        self.swap = Some(swap);
        self.abandon_swap(message);
    }

    fn go_on_with_probation(&mut self, waited: Duration) {
        let Some(swap) = &self.swap else {
            return;
        };
        for target in &swap.targets {
            let process = self.members[target.idx].active.as_mut();
            let has_failed = process.is_none_or(|process| {
                process.look();
                !process.is_running() || process.failure().is_some()
            });
            let old = self.members[target.idx].standby.as_mut();
            let has_ended = old.is_some_and(|old| {
                old.look();
                !old.is_running()
            });
            if has_failed && has_ended {
                // No operator is left to go back to: the new program is started again.
                return self.conclude_swap();
            }
            if has_failed {
                let id = target.node.id.clone();
                let ending = self.members[target.idx].active.as_ref().map_or("ended".into(), Process::ending);
                if let Some(swap) = self.swap.take() {
                    self.roll_back(swap, &format!("the replacement of '{id}' {ending} within its probation"));
                }
                return;
            }
        }
        if waited >= Duration::from_millis(swap.request.probation_millis) {
            self.conclude_swap();
        }
    }

    /// Whether all these samples, the last that an instance has sent at its outputs, were answered by all readers and those
    /// behind them, so that its memory may go.
    pub(super) fn is_read(&self, sent: &[(Port, SampleId)]) -> bool {
        sent.iter().all(|(port, last)| {
            let written = self.plan.output_slot(port).and_then(|slot| self.cursors.output(slot).written());
            self.plan.reader_slots(port).iter().all(|slot| {
                let slot = self.cursors.input(*slot);
                slot.is_given_up()
                    || slot.key().is_some_and(|key| written.is_none_or(|written| written.is_past(key, *last)))
            })
        })
    }

    /// The last sample that a node has sent at each of its outputs.
    fn last_sent(&self, idx: usize) -> Vec<(Port, SampleId)> {
        let mut sent = Vec::new();
        for (port, _) in self.members[idx].node.output_ports() {
            if let Some(key) = self.last_sent_at(&port) {
                sent.push((port, key));
            }
        }
        sent
    }

    fn conclude_swap(&mut self) {
        let Some(swap) = self.swap.take() else {
            return;
        };
        let mut nodes = Vec::new();
        for target in &swap.targets {
            let member = &mut self.members[target.idx];
            member.node = target.node.clone();
            member.n_swaps += 1;
            if let Some(process) = member.standby.take() {
                let sent = if process.is_running() { target.sent.clone() } else { Vec::new() };
                self.leaving.push(Leaving { idx: target.idx, process, since: Instant::now(), sent, is_let_go: false });
            }
            nodes.push(SwappedNode {
                node: target.node.id.clone(),
                old_pid: target.old_pid,
                new_pid: target.new_pid,
                last_seq: target.last.map(|key| key.seq),
                handover_pause_nanos: target.handover_pause.as_nanos() as u64,
            });
        }
        for node in &nodes {
            let after = node.last_seq.map_or("at the start".into(), |seq| format!("after sample {seq}"));
            self.say(&format!(
                "blindgrasp: node '{}' swapped {after}: process {} -> {}, {:.2} ms without an answer",
                node.node,
                node.old_pid,
                node.new_pid,
                node.handover_pause_nanos as f64 / 1e6
            ));
        }
        self.reap();
        swap.tell(Reply::Swapped { nodes });
    }

    /// The replacements are killed, and the old operators take over from them.
    fn roll_back(&mut self, swap: Swap, message: &str) {
        for target in &swap.targets {
            if let Some(process) = &mut self.members[target.idx].active {
                process.kill();
            }
        }
        let mut has_taken_over = true;
        for target in &swap.targets {
            let member = &mut self.members[target.idx];
            std::mem::swap(&mut member.active, &mut member.standby);
            member.standby = None;
            let idx = target.idx;
            let Some(process) = &mut member.active else {
                // There is no old operator, or it has ended meanwhile.
                has_taken_over = false;
                if target.was_given_up {
                    self.give_up(idx, format!("the replacement of '{}', which was given up, failed", target.node.id))
                } else {
                    self.start_again(idx, "and its replacement ended", &[])
                }
                continue;
            };
            process.has_taken_over = false;
            process.tell(&Command::TakeOver { is_handed_over: false });
            // If it has died meanwhile, supervision starts it again.
            self.wait_until(&swap, |launcher| launcher.has_answered(idx, |process| process.has_taken_over));
            has_taken_over &= self.members[idx].active.as_ref().is_some_and(|process| process.has_taken_over);
        }
        self.reap();
        self.say(&format!("blindgrasp: swap rolled back: {message}"));
        let outcome = if has_taken_over {
            "the old one has taken over again"
        } else {
            "there was no old one left to take over: see blindgrasp ps"
        };
        swap.tell(Reply::Error { message: format!("{message}; {outcome}"), rolled_back: has_taken_over });
    }

    /// Ends a swap before its time: the old operators go on, or, on probation, the replacements stay.
    pub(super) fn abandon_swap(&mut self, message: &str) {
        match self.swap.as_ref().map(|swap| swap.phase) {
            None => {}
            Some(Phase::Probation) => self.conclude_swap(),
            Some(_) => {
                if let Some(swap) = self.swap.take() {
                    self.kill_standbys(&swap);
                    self.say(&format!("blindgrasp: swap abandoned: {message}"));
                    let is_old_one_there = swap.targets.iter().all(|target| self.members[target.idx].active.is_some());
                    let outcome = if is_old_one_there { "the old one goes on" } else { "nothing has changed" };
                    swap.tell(Reply::refusal(format!("{message}; {outcome}")));
                }
            }
        }
    }

    fn kill_standbys(&mut self, swap: &Swap) {
        for target in &swap.targets {
            // Dropping it kills it.
            self.members[target.idx].standby = None;
        }
        self.reap();
    }

    /// The client's answer after the comparison.
    pub(super) fn on_promote(&mut self, is_promoted: bool, client: u64, reply: SyncSender<Reply>) {
        let is_shadowing =
            self.swap.as_ref().is_some_and(|swap| swap.client == client && swap.phase == Phase::Shadowing);
        if !is_shadowing {
            return refuse(&reply, "no replacement of yours runs in the shadow");
        }
        if let Some(swap) = &mut self.swap {
            swap.reply = reply;
        }
        if is_promoted {
            self.hand_over();
        } else if let Some(swap) = self.swap.take() {
            self.kill_standbys(&swap);
            swap.tell(Reply::Abandoned);
        }
    }

    /// A swap whose client goes before the replacement is active is abandoned.
    pub(super) fn on_client_gone(&mut self, client: u64) {
        if self.clients.begins_swap == Some(client) {
            self.clients.begins_swap = None;
        }
        if self.swap.as_ref().is_some_and(|swap| swap.client == client && swap.phase != Phase::Probation) {
            self.abandon_swap("the command that asked for it has gone");
        }
    }

    /// Listens until a condition holds; false if that takes longer than [`HAND_OVER_LIMIT`]. Nodes that are not swapped are
    /// started again meanwhile.
    fn wait_until(&mut self, swap: &Swap, is_so: impl Fn(&Launcher) -> bool) -> bool {
        let awaited: Vec<usize> = swap.targets.iter().map(|target| target.idx).collect();
        let start = Instant::now();
        while !is_so(self) {
            if start.elapsed() > HAND_OVER_LIMIT {
                return false;
            }
            self.listen(Duration::from_micros(500));
            self.supervise_others(&awaited);
            for member in &mut self.members {
                for process in member.processes() {
                    process.look();
                }
            }
        }
        true
    }

    /// Whether a node is on probation after a swap.
    pub(super) fn is_on_probation(&self, idx: usize) -> bool {
        let swap = self.swap.as_ref().filter(|swap| swap.phase == Phase::Probation);
        swap.is_some_and(|swap| swap.targets.iter().any(|target| target.idx == idx))
    }

    /// Whether a node has answered all samples of these targets. Those of a partner input stay unanswered for a while: their
    /// writer keeps them.
    fn has_caught_up(&self, targets: &[Target], idx: usize) -> bool {
        let node = &self.members[idx].node;
        let from_targets = node
            .inputs
            .iter()
            .filter(|input| !input.partner && targets.iter().any(|target| target.node.id == input.from_node));
        from_targets.into_iter().all(|input| {
            let from = (input.from_node.clone(), input.from_port.clone());
            let sent = self.last_sent_at(&from);
            let answered = self.plan.input_slot(&node.id, &input.port).and_then(|slot| self.cursors.input(slot).key());
            sent.is_none() || sent == answered
        })
    }

    /// The last sample that a node has answered; of a source, the last that it has sent.
    fn last_answered(&self, idx: usize) -> Option<SampleId> {
        let node = &self.members[idx].node;
        let mut inputs = self.plan.input_slots(&node.id).map(|slot| self.cursors.input(slot).key());
        match inputs.next() {
            Some(key) if !node.is_source() => key,
            _ => {
                let (port, _) = node.output_ports().next()?;
                self.last_sent_at(&port)
            }
        }
    }
}

fn refuse(reply: &SyncSender<Reply>, message: &str) {
    let _ = reply.try_send(Reply::refusal(message));
}

/// Whether the readers will receive all that an operator, and those before it, have sent.
fn has_handed_over_all(process: &Process) -> bool {
    process.is_running() && process.has_handed_over && process.has_sent_all
}

fn type_of<'a>(ports: &'a [PortDescription], name: &str) -> Option<&'a str> {
    ports.iter().find(|port| port.name == name).map(|port| port.type_name.as_str())
}

/// Whether a replacement has a port of this name and type, as its node does. `words` are for the message.
fn check_port(
    node: &Node,
    words: (&str, &str),
    offered: &[PortDescription],
    (name, expected): (&str, &str),
) -> Result<(), String> {
    let (side, verb) = words;
    match type_of(offered, name) {
        None => Err(format!("the replacement has no {side} '{name}', which '{}' has", node.id)),
        Some(found) if found != expected => {
            Err(format!("the replacement's {side} '{name}' {verb} {found}, '{}' has {expected}", node.id))
        }
        Some(_) => Ok(()),
    }
}

/// Whether a program can stand where a node stands.
fn check_ports(node: &Node, description: &OperatorDescription) -> Result<(), String> {
    for input in &node.inputs {
        check_port(node, ("input", "takes"), &description.inputs, (&input.port, &input.type_name))?;
    }
    for port in &description.inputs {
        if !port.optional && node.inputs.iter().all(|input| input.port != port.name) {
            return Err(format!("the replacement needs an input '{}', which '{}' lacks", port.name, node.id));
        }
    }
    for output in node.outputs() {
        check_port(node, ("output", "gives"), &description.outputs, (&output.name, &output.type_name))?;
    }
    match description.outputs.iter().find(|port| type_of(node.outputs(), &port.name).is_none()) {
        Some(port) => Err(format!("the replacement has an output '{}', which '{}' lacks", port.name, node.id)),
        None => Ok(()),
    }
}
