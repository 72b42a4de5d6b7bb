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

use std::time::Duration;

use serde_json::{Map, Value};

use crate::control::{GraphState, NodeState, Reply, SwapRequest, SwappedNode};
use crate::dataflow::{Node, accept_param, accept_param_value};
use crate::launcher::lifecycle::{Instance, LOG_DRAIN_LIMIT, Leaving, Lifecycle, Surroundings};
use crate::log::log_tail;
use crate::plan::Port;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::wiring::{Command, Report};

/// A replacement computes live samples for at most this long before it takes over: an idle graph has none.
const WARM_LIMIT: Duration = Duration::from_millis(500);
/// An operator must finish the sample at hand, or take over, within this time.
const HAND_OVER_LIMIT: Duration = Duration::from_secs(2);
/// The last words of a replacement that dies as it takes over are heard within this time.
const HEARING: Duration = Duration::from_millis(5);

#[derive(Clone)]
pub(super) struct Swap {
    request: SwapRequest,
    client: u64,
    targets: Vec<Target>,
    phase: Phase,
    /// When its phase began, or the instance that it waits for was asked.
    since: Duration,
    /// When the first of the running operators handed over.
    handed_over: Option<Duration>,
    /// The replacements have been active.
    has_exchanged: bool,
    /// Why it is to end before its time.
    is_to_end: Option<String>,
    /// Why the running operators go on, and whether all of them do.
    failure: String,
    has_gone_back: bool,
}

/// A node that is being replaced.
#[derive(Clone)]
struct Target {
    idx: usize,
    /// The node with the replacement's program and parameters.
    node: Node,
    /// The old one was asked to hand over, if it could be asked.
    is_asked: bool,
    /// The last sample that it sent at each output.
    sent: Vec<(Port, SampleId)>,
    swapped: SwappedNode,
    /// Whether the node had been given up before.
    was_given_up: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// The programs of the replacements have not begun.
    Beginning,
    Starting,
    Warming,
    Shadowing,
    /// The old instance of this target finishes the sample at hand.
    HandingOver(usize),
    /// The replacement of this target takes over.
    TakingOver(usize),
    /// The replacements end, and the old instance of this target takes over again.
    GoingBack {
        at: usize,
        is_asked: bool,
    },
    Probation,
}

/// What a swap does next.
enum Next {
    Waits,
    GoesOn,
    IsOver,
}

impl Swap {
    /// Whether a node is being replaced.
    pub(super) fn concerns(&self, id: &str) -> bool {
        self.targets.iter().any(|target| target.node.id == id)
    }

    /// Whether neither the old instances nor the replacements are the active ones for good.
    pub(super) fn is_being_handed_over(&self) -> bool {
        matches!(self.phase, Phase::HandingOver(_) | Phase::TakingOver(_) | Phase::GoingBack { .. })
    }
}

impl<S: Surroundings> Lifecycle<S> {
    /// Starts the replacements, or answers why not. `description` is that of the new program, if there is one.
    pub(super) fn begin_swap(
        &mut self,
        request: SwapRequest,
        description: Option<Result<OperatorDescription, String>>,
        client: u64,
    ) {
        let targets = match self.plan_swap(&request, description) {
            Ok(targets) => targets,
            Err(message) => return self.site.answer(client, Reply::refusal(message)),
        };
        let nodes: Vec<(usize, Node)> = targets.iter().map(|target| (target.idx, target.node.clone())).collect();
        self.swap = Some(Swap {
            request,
            client,
            targets,
            phase: Phase::Beginning,
            since: self.now,
            handed_over: None,
            has_exchanged: false,
            is_to_end: None,
            failure: String::new(),
            has_gone_back: true,
        });
        for (idx, _) in &nodes {
            // Those of a group share the process of the first of them, and a start that fails ends the swap.
            if self.members[*idx].standby.is_none()
                && self.swap.is_some()
                && let Some(n_before) = self.free_instance(*idx)
            {
                let together = self.together(*idx);
                let group = nodes.iter().filter(|(idx, _)| together.contains(idx)).cloned().collect();
                self.start(group, n_before, true);
            }
        }
    }

    fn check_readiness(&self) -> Result<(), String> {
        if !matches!(self.state, GraphState::Running | GraphState::Degraded) {
            return Err("the graph is starting or stopping".into());
        }
        if let Some(swap) = &self.swap {
            let nodes: Vec<_> = swap.targets.iter().map(|target| target.node.id.as_str()).collect();
            return Err(format!("a swap of {} is under way; wait for its end", nodes.join(", ")));
        }
        Ok(())
    }

    /// The replacements, checked against the graph as it runs.
    fn plan_swap(
        &self,
        request: &SwapRequest,
        description: Option<Result<OperatorDescription, String>>,
    ) -> Result<Vec<Target>, String> {
        self.check_readiness()?;
        let description =
            description.transpose().map_err(|error| format!("the replacement cannot be used: {error}"))?;
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
            if let (Some(program), Some(description)) = (&request.program, &description) {
                check_ports(&node, description)?;
                node.program = program.clone();
                node.args = request.args.clone().unwrap_or_default();
                node.description = description.clone();
            }
            node.params = self.swapped_params(&node, request)?;
            let old_pid = member.active.as_ref().and_then(|active| active.pid).unwrap_or_default();
            let swapped =
                SwappedNode { node: node.id.clone(), old_pid, new_pid: 0, last_seq: None, handover_pause_nanos: 0 };
            let was_given_up = member.is_given_up();
            targets.push(Target { idx, node, is_asked: false, sent: Vec::new(), swapped, was_given_up });
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
                accept_param_value(description, name, default, self.folder())?
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

    /// Takes a swap as far as it goes, if one is under way.
    pub(super) fn go_on_with_swap(&mut self) {
        while !self.ending.is_quitting()
            && let Some(mut swap) = self.swap.take()
        {
            let next = match swap.phase {
                Phase::Beginning | Phase::Starting | Phase::Warming | Phase::Shadowing => self.prepare(&mut swap),
                Phase::HandingOver(at) => self.hand_over(&mut swap, at),
                Phase::TakingOver(at) => self.take_over(&mut swap, at),
                Phase::GoingBack { at, is_asked } => self.go_back(&mut swap, at, is_asked),
                Phase::Probation => self.prove(&mut swap),
            };
            match next {
                Next::Waits => {
                    self.swap = Some(swap);
                    return;
                }
                Next::GoesOn => self.swap = Some(swap),
                Next::IsOver => {}
            }
        }
    }

    fn progress(&mut self, swap: &Swap, message: String) {
        self.site.answer(swap.client, Reply::Progress { message });
    }

    /// Follows the replacements until they may take over.
    fn prepare(&mut self, swap: &mut Swap) -> Next {
        if let Some(message) = swap.is_to_end.take() {
            return self.abandon(swap, &message);
        }
        let (mut has_begun, mut is_ready, mut is_warm) = (true, true, true);
        for target in &mut swap.targets {
            let Some(standby) = &self.members[target.idx].standby else { continue };
            if !standby.is_running() || standby.failure.is_some() {
                if !standby.is_heard(self.now, LOG_DRAIN_LIMIT) {
                    return Next::Waits;
                }
                let lines = if standby.failure.is_none() { self.site.last_lines(standby.id) } else { Vec::new() };
                let ending = format!("{}{}", standby.ending(), log_tail(&lines));
                let message = format!("the replacement of '{}' {ending}", target.node.id);
                return self.abandon(swap, &message);
            }
            target.swapped.new_pid = standby.pid.unwrap_or_default();
            has_begun &= standby.pid.is_some();
            is_ready &= standby.is_ready();
            // A source computes nothing beside another source.
            is_warm &= standby.is_warm || target.node.inputs.iter().all(|input| input.feedback);
        }
        let waited = self.now - swap.since;
        match swap.phase {
            Phase::Beginning if has_begun => {
                let mut processes = Vec::new();
                for target in &swap.targets {
                    processes.push(format!("{} (process {})", target.node.id, target.swapped.new_pid));
                }
                self.progress(swap, format!("started beside the running one: {}", processes.join(", ")));
                swap.phase = Phase::Starting;
                Next::GoesOn
            }
            Phase::Starting if is_ready => match self.find_mismatch(swap) {
                Some(message) => self.abandon(swap, &message),
                None => self.enter(swap, Phase::Warming, "ready; computes live samples beside the running one"),
            },
            Phase::Starting if waited > Duration::from_millis(swap.request.ready_limit_millis) => {
                let limit = swap.request.ready_limit_millis as f64 / 1e3;
                self.abandon(swap, &format!("the replacement was not ready within {limit} s"))
            }
            Phase::Warming if is_warm || waited > WARM_LIMIT => {
                if swap.request.shadow_limit_millis == 0 {
                    swap.phase = Phase::HandingOver(0);
                    return Next::GoesOn;
                }
                let nodes: Vec<&str> = swap.targets.iter().map(|target| target.node.id.as_str()).collect();
                let shadowing = self.site.shadowing(&nodes);
                self.site.answer(swap.client, shadowing);
                self.enter(swap, Phase::Shadowing, "runs in the shadow")
            }
            Phase::Shadowing if waited > Duration::from_millis(swap.request.shadow_limit_millis) => {
                self.abandon(swap, "the comparison was not ended in time")
            }
            _ => Next::Waits,
        }
    }

    fn enter(&mut self, swap: &mut Swap, phase: Phase, message: &str) -> Next {
        swap.phase = phase;
        swap.since = self.now;
        self.progress(swap, message.into());
        Next::GoesOn
    }

    /// A replacement must be made for the same hand and model as its neighbours, and for the same hand as the operator
    /// that it replaces.
    fn find_mismatch(&self, swap: &Swap) -> Option<String> {
        for target in &swap.targets {
            let id = &target.node.id;
            // Without a state it answers each sample by definition.
            let has_state = self.members[target.idx].standby.as_ref().is_some_and(|standby| standby.has_state);
            if has_state && !target.node.description.answers_each && self.site.relies_on_each_answer(id) {
                return Some(format!(
                    "the replacement of '{id}' has a state and does not say that it answers each sample, on which the nodes \
                     before '{id}' rely: expected \"answers_each\": true in its description; start the graph with it instead"
                ));
            }
        }
        if swap.request.allow_mismatch {
            return None;
        }
        let in_shadow = swap.request.shadow_limit_millis > 0;
        for target in &swap.targets {
            let identity = self.members[target.idx].standby.as_ref()?.identity.as_ref()?;
            for (idx, member) in self.members.iter().enumerate() {
                let is_itself = idx == target.idx;
                let is_replaced = !is_itself && swap.targets.iter().any(|target| target.idx == idx);
                // In the shadow, the replacement reads the running operators.
                let process = if is_replaced && !in_shadow { &member.standby } else { &member.active };
                let other = process.as_ref().and_then(|process| process.identity.as_ref());
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
                             hold every grasp. Swap the nodes together (blindgrasp swap A B --set …), without --shadow, in which a \
                             replacement reads the running nodes (view --shadow MODEL compares models), or say --allow-mismatch",
                            target.node.id
                        ));
                    }
                }
            }
        }
        None
    }

    /// From the running operators to their replacements, at one place in the stream.
    fn hand_over(&mut self, swap: &mut Swap, at: usize) -> Next {
        if let Some(message) = swap.is_to_end.take() {
            return self.take_back(swap, &message);
        }
        let idx = swap.targets[at].idx;
        let id = swap.targets[at].node.id.clone();
        let active = self.members[idx].active.as_mut().filter(|active| active.is_running());
        let is_late = self.now - swap.since > HAND_OVER_LIMIT;
        if !swap.targets[at].is_asked {
            if let Some(active) = active {
                if active.pid.is_none() {
                    // It is being started again, which has a limit of its own.
                    swap.since = self.now;
                    return Next::Waits;
                }
                let active_id = active.id;
                active.answer = None;
                // It still answers the samples of the target before it.
                if at > 0 && !self.has_caught_up(&swap.targets[..at], idx) {
                    if is_late {
                        return self.take_back(swap, &format!("node '{id}' did not answer its samples"));
                    }
                    return Next::Waits;
                }
                self.site.tell(active_id, &Command::HandOver);
            }
            swap.targets[at].is_asked = true;
            swap.since = self.now;
            return Next::GoesOn;
        }
        if active.is_some_and(|active| !matches!(active.answer, Some(Report::HandedOver { .. }))) {
            if is_late {
                return self.take_back(swap, &format!("the running '{id}' did not hand over"));
            }
            return Next::Waits;
        }
        swap.handed_over.get_or_insert(self.now);
        swap.targets[at].swapped.last_seq = self.last_answered(idx).map(|key| key.seq);
        swap.targets[at].sent = self.last_sent(idx);
        swap.phase = Phase::HandingOver(at + 1);
        if at + 1 == swap.targets.len() {
            self.exchange(swap);
        }
        swap.since = self.now;
        Next::GoesOn
    }

    /// Lets the replacements take over, downstream ones first.
    fn exchange(&mut self, swap: &mut Swap) {
        for target in swap.targets.iter().rev() {
            let member = &mut self.members[target.idx];
            std::mem::swap(&mut member.active, &mut member.standby);
            // A restart that was due is no longer needed.
            member.restart_at = None;
            member.died = None;
            let is_handed_over = member.standby.as_ref().is_some_and(has_handed_over_all);
            if let Some(active) = &mut member.active {
                active.answer = None;
                self.site.tell(active.id, &Command::Go);
                self.site.tell(active.id, &Command::TakeOver { is_handed_over });
            }
        }
        swap.has_exchanged = true;
        swap.phase = Phase::TakingOver(0);
    }

    /// Waits until the replacements have taken over.
    fn take_over(&mut self, swap: &mut Swap, at: usize) -> Next {
        let target = &mut swap.targets[at];
        let id = &target.node.id;
        let member = &mut self.members[target.idx];
        let Some(active) = &member.active else {
            let message = format!("the replacement of '{id}' ended");
            return self.roll_back(swap, &message);
        };
        if active.answer != Some(Report::TookOver) {
            let is_waiting = if active.is_running() {
                self.now - swap.since <= HAND_OVER_LIMIT
            } else {
                !active.is_heard(self.now, HEARING)
            };
            if is_waiting {
                return Next::Waits;
            }
            let message = if active.is_running() {
                format!("the replacement of '{id}' did not take over within {} s", HAND_OVER_LIMIT.as_secs())
            } else {
                format!("the replacement of '{id}' {} as it took over", active.ending())
            };
            return self.roll_back(swap, &message);
        }
        if let Some(since) = swap.handed_over {
            target.swapped.handover_pause_nanos = (self.now - since).as_nanos() as u64;
        }
        member.state = NodeState::Running;
        self.heal(swap.targets[at].idx);
        swap.phase = Phase::TakingOver(at + 1);
        swap.since = self.now;
        if at + 1 < swap.targets.len() {
            return Next::GoesOn;
        }
        let pause = swap.targets.iter().map(|target| target.swapped.handover_pause_nanos).max().unwrap_or_default()
            as f64
            / 1e6;
        self.enter(swap, Phase::Probation, &format!("has taken over, {pause:.2} ms without an answer; on probation"))
    }

    /// Before any replacement is active: the running operators that were asked to hand over go on.
    fn take_back(&mut self, swap: &mut Swap, message: &str) -> Next {
        for target in &swap.targets {
            if let Some(standby) = &self.members[target.idx].standby {
                self.kill(standby.id, None);
            }
        }
        swap.failure = message.into();
        swap.phase = Phase::GoingBack { at: 0, is_asked: false };
        Next::GoesOn
    }

    /// The replacements are killed, and the old operators take over from them.
    fn roll_back(&mut self, swap: &mut Swap, message: &str) -> Next {
        for target in &swap.targets {
            let member = &mut self.members[target.idx];
            std::mem::swap(&mut member.active, &mut member.standby);
        }
        self.take_back(swap, message)
    }

    /// Lets the old operators take over, one after the other, once no replacement can answer any more.
    fn go_back(&mut self, swap: &mut Swap, at: usize, is_asked: bool) -> Next {
        for target in &swap.targets {
            if self.members[target.idx].standby.as_ref().is_some_and(Instance::is_running) {
                return Next::Waits;
            }
        }
        if at == swap.targets.len() {
            return self.end_going_back(swap);
        }
        let target = &swap.targets[at];
        let member = &mut self.members[target.idx];
        if let Some(standby) = member.standby.take() {
            self.site.forget(standby.id);
        }
        if let Some(active) = &mut member.active {
            let is_concerned = swap.has_exchanged || target.is_asked;
            if is_concerned && !is_asked {
                let is_handed_over = !swap.has_exchanged && has_handed_over_all(active);
                active.answer = None;
                self.site.tell(active.id, &Command::TakeOver { is_handed_over });
                swap.phase = Phase::GoingBack { at, is_asked: true };
                swap.since = self.now;
                return Next::GoesOn;
            }
            if is_concerned && active.answer != Some(Report::TookOver) {
                if active.is_running() && self.now - swap.since <= HAND_OVER_LIMIT {
                    return Next::Waits;
                }
                // If it has died meanwhile, supervision starts it again.
                swap.has_gone_back = false;
            }
        } else if swap.has_exchanged {
            // There is no old operator, or it has ended meanwhile.
            if target.was_given_up {
                let message = format!("the replacement of '{}', which was given up, failed", target.node.id);
                self.give_up(target.idx, message);
            } else {
                self.start_again(target.idx, "and its replacement ended", &[]);
            }
            swap.has_gone_back = false;
        }
        swap.phase = Phase::GoingBack { at: at + 1, is_asked: false };
        Next::GoesOn
    }

    fn end_going_back(&mut self, swap: &Swap) -> Next {
        if !swap.has_exchanged {
            return self.abandon(swap, &swap.failure);
        }
        self.site.say(&format!("blindgrasp: swap rolled back: {}", swap.failure));
        let outcome = if swap.has_gone_back {
            "the old one has taken over again"
        } else {
            "there was no old one left to take over: see blindgrasp ps"
        };
        let message = format!("{}; {outcome}", swap.failure);
        self.site.answer(swap.client, Reply::Error { message, rolled_back: swap.has_gone_back });
        Next::IsOver
    }

    /// Watches the replacements while the old operators stand by.
    fn prove(&mut self, swap: &mut Swap) -> Next {
        for target in &swap.targets {
            let member = &self.members[target.idx];
            let mut ending = "ended".into();
            if let Some(active) = &member.active {
                if active.is_running() && active.failure.is_none() {
                    continue;
                }
                ending = active.ending();
            }
            if member.standby.as_ref().is_some_and(|old| !old.is_running()) {
                // No operator is left to go back to: the new program is started again.
                return self.conclude(swap);
            }
            let message = format!("the replacement of '{}' {ending} within its probation", target.node.id);
            return self.roll_back(swap, &message);
        }
        if swap.is_to_end.is_some() || self.now - swap.since >= Duration::from_millis(swap.request.probation_millis) {
            return self.conclude(swap);
        }
        Next::Waits
    }

    fn conclude(&mut self, swap: &Swap) -> Next {
        let mut nodes = Vec::new();
        for target in &swap.targets {
            let member = &mut self.members[target.idx];
            member.node = target.node.clone();
            member.n_swaps += 1;
            if let Some(instance) = member.standby.take() {
                let sent = if instance.is_running() { target.sent.clone() } else { Vec::new() };
                self.leaving.push(Leaving { idx: target.idx, instance, since: self.now, sent, is_let_go: false });
            }
            let SwappedNode { node, old_pid, new_pid, last_seq, handover_pause_nanos } = &target.swapped;
            let after = last_seq.map_or("at the start".into(), |seq| format!("after sample {seq}"));
            let millis = *handover_pause_nanos as f64 / 1e6;
            self.site.say(&format!(
                "blindgrasp: node '{node}' swapped {after}: process {old_pid} -> {new_pid}, {millis:.2} ms without an answer"
            ));
            nodes.push(target.swapped.clone());
        }
        self.site.answer(swap.client, Reply::Swapped { nodes });
        Next::IsOver
    }

    /// Ends a swap of which no replacement is active.
    fn abandon(&mut self, swap: &Swap, message: &str) -> Next {
        self.discard_standbys(swap);
        self.site.say(&format!("blindgrasp: swap abandoned: {message}"));
        let is_old_one_there = swap.targets.iter().all(|target| self.members[target.idx].active.is_some());
        let outcome = if is_old_one_there { "the old one goes on" } else { "nothing has changed" };
        self.site.answer(swap.client, Reply::refusal(format!("{message}; {outcome}")));
        Next::IsOver
    }

    fn discard_standbys(&mut self, swap: &Swap) {
        for target in &swap.targets {
            if let Some(standby) = self.members[target.idx].standby.take() {
                self.discard(target.idx, standby);
            }
        }
    }

    /// Ends a swap before its time: the old operators go on, or, on probation, the replacements stay. One that is being handed
    /// over ends once it is clear which are active.
    pub(super) fn abandon_swap(&mut self, message: &str) {
        if let Some(swap) = &mut self.swap {
            swap.is_to_end.get_or_insert(message.into());
            self.go_on_with_swap();
        }
    }

    /// The client's answer after the comparison.
    pub(super) fn on_promote(&mut self, is_promoted: bool, client: u64) {
        let found = self.swap.take_if(|swap| swap.client == client && swap.phase == Phase::Shadowing);
        let Some(mut swap) = found else {
            return self.site.answer(client, Reply::refusal("no replacement of yours runs in the shadow"));
        };
        if is_promoted {
            swap.phase = Phase::HandingOver(0);
            swap.since = self.now;
            self.swap = Some(swap);
            self.go_on_with_swap();
        } else {
            self.discard_standbys(&swap);
            self.site.answer(client, Reply::Abandoned);
        }
    }

    /// A swap whose client goes before the hand-over is abandoned.
    pub(super) fn on_client_gone(&mut self, client: u64) {
        let swap = self.swap.as_ref().filter(|swap| swap.client == client);
        if swap.is_some_and(|swap| swap.phase != Phase::Probation && !swap.is_being_handed_over()) {
            self.abandon_swap("the command that asked for it has gone");
        }
    }

    /// Whether a node is being handed over, or on probation, so that the swap decides what follows the death of an instance.
    pub(super) fn is_in_swap(&self, idx: usize) -> bool {
        let swap = self.swap.as_ref().filter(|swap| swap.phase == Phase::Probation || swap.is_being_handed_over());
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
            let sent = self.site.last_sent_at(&from);
            sent.is_none() || sent == self.site.answered_at(&node.id, &input.port)
        })
    }

    /// The last sample that a node has sent at each of its outputs.
    fn last_sent(&self, idx: usize) -> Vec<(Port, SampleId)> {
        let mut sent = Vec::new();
        for (port, _) in self.members[idx].node.output_ports() {
            if let Some(key) = self.site.last_sent_at(&port) {
                sent.push((port, key));
            }
        }
        sent
    }

    /// The last sample that a node has answered; of a source, the last that it has sent.
    pub(super) fn last_answered(&self, idx: usize) -> Option<SampleId> {
        let node = &self.members[idx].node;
        let first_input = node.inputs.iter().map(|input| &input.port).min();
        if let Some(input) = first_input
            && !node.is_source()
        {
            return self.site.answered_at(&node.id, input);
        }
        let (port, _) = node.output_ports().next()?;
        self.site.last_sent_at(&port)
    }
}

/// Whether the readers will receive all that an operator, and those before it, have sent.
fn has_handed_over_all(instance: &Instance) -> bool {
    instance.is_running() && instance.answer == Some(Report::HandedOver { has_sent_all: true })
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
