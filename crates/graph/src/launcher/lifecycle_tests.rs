//! Searches through histories of a graph that is swapped: faults, and the wish to stop, come at each moment. The lifecycle is the
//! launcher's own; processes and time are those of a [`World`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::Duration;

use crate::control::{NodeState, Reply, SwapRequest};
use crate::dataflow::{EdgeOptions, Graph, Input, Node, Restart};
use crate::launcher::lifecycle::{Instance, Lifecycle, StartOrder, Surroundings};
use crate::launcher::tests::stub;
use crate::launcher::{LaunchError, LaunchOptions};
use crate::plan::Port;
use blindgrasp_operator::cursors::SampleId;
use blindgrasp_operator::wiring::{Command, Enforcement, Report};

const CLIENT: u64 = 1;
const NODES: [&str; 3] = ["source", "left", "right"];
const HEARTBEAT: Duration = Duration::from_secs(1);
/// A graph is whole again, or has ended, within this time after the last fault.
const LIMIT: Duration = Duration::from_secs(40);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// What happens to the active process of a node, or to the one that stands by.
    Kill(usize),
    KillStandby(usize),
    Exit(usize),
    Hang(usize),
    HangStandby(usize),
    /// It waits for a device, and the system cannot end it.
    Stick(usize),
    /// The machine has no process left for the next start, or its program never begins.
    NoProcess,
    NeverBegins,
    /// It does not exit, although it may.
    Lingers(usize),
    /// The second node answers nothing any more, or has answered all again.
    FallsBehind,
    ClientGoes,
    Promote,
    Stop,
}

#[derive(Clone, Default)]
struct Process {
    node: usize,
    votes: u64,
    has_begun: bool,
    never_begins: bool,
    is_ready: bool,
    is_standby: bool,
    is_warm: bool,
    /// It answers samples.
    is_active: bool,
    has_handed_over: bool,
    is_asked: bool,
    is_drained: bool,
    is_let_go: bool,
    is_killed: bool,
    hangs_since: Option<Duration>,
    is_stuck: bool,
    lingers: bool,
    end: Option<i32>,
    is_reaped: bool,
    commands: VecDeque<Command>,
}

#[derive(Clone, Default)]
struct World {
    processes: BTreeMap<u64, Process>,
    /// The instance of each node that was the active one last.
    last_active: [u64; NODES.len()],
    given_up: BTreeSet<String>,
    replies: Vec<Reply>,
    has_failed: bool,
    has_no_process: bool,
    never_begins: bool,
    falls_behind: bool,
    /// The rule that was broken.
    broken: Option<String>,
}

impl World {
    fn is_to_be(&mut self, is_so: bool, rule: &str) {
        if !is_so {
            self.broken.get_or_insert(rule.into());
        }
    }

    /// From now on this instance answers the node's samples, and no other may.
    fn becomes_active(&mut self, id: u64, is_handed_over: bool) {
        let Some(process) = self.processes.get(&id) else { return };
        let node = process.node;
        let is_living =
            |process: &Process| process.node == node && process.end.is_none() && process.is_active && !process.is_stuck;
        let is_alone = self.processes.iter().all(|(other, process)| *other == id || !is_living(process));
        self.is_to_be(is_alone, "one instance of a node is active");
        let before = self.processes.get(&self.last_active[node]);
        let has_handed_over = before.is_some_and(|before| before.end.is_none() && before.has_handed_over);
        self.is_to_be(!is_handed_over || has_handed_over, "samples of a dead instance are sent again");
        self.last_active[node] = id;
        if let Some(process) = self.processes.get_mut(&id) {
            process.is_active = true;
            process.has_handed_over = false;
        }
    }
}

impl Surroundings for World {
    fn start(&mut self, orders: Vec<StartOrder>) -> Result<(), LaunchError> {
        for StartOrder { id, idx, node, is_standby, .. } in orders {
            if std::mem::take(&mut self.has_no_process) {
                let error = std::io::Error::from_raw_os_error(rustix::io::Errno::AGAIN.raw_os_error());
                return Err(LaunchError::of_spawn(&node, error));
            }
            let never_begins = std::mem::take(&mut self.never_begins);
            let votes = node.params["votes"].as_u64().expect("a number");
            self.processes.insert(id, Process { node: idx, votes, is_standby, never_begins, ..Process::default() });
            if !is_standby {
                self.becomes_active(id, false);
            }
        }
        Ok(())
    }

    fn tell(&mut self, id: u64, command: &Command) {
        if let Command::TakeOver { is_handed_over } = command {
            self.becomes_active(id, *is_handed_over);
        }
        if let Some(process) = self.processes.get_mut(&id) {
            process.commands.push_back(command.clone());
        }
    }

    fn ask_to_drain(&mut self, id: u64) {
        self.processes.get_mut(&id).expect("it is there").is_asked = true;
    }

    fn let_go(&mut self, id: u64) {
        self.processes.get_mut(&id).expect("it is there").is_let_go = true;
    }

    fn kill(&mut self, id: u64) {
        let process = self.processes.get_mut(&id).expect("it is there");
        process.is_killed = true;
        if !process.has_begun {
            process.end = Some(9);
        }
    }

    fn forget(&mut self, id: u64) {
        let is_over = self.processes.get(&id).is_none_or(|process| process.end.is_some() || process.is_stuck);
        self.is_to_be(is_over, "nothing that runs is forgotten");
    }

    fn stop_waiting_for(&mut self, node: &Node, reads_no_more: bool) {
        if reads_no_more {
            self.given_up.insert(node.id.clone());
        } else {
            self.given_up.remove(&node.id);
        }
    }

    fn fail(&mut self, _: LaunchError) {
        self.has_failed = true;
    }

    fn say(&mut self, _: &str) {}

    fn has_status(&mut self, _: &str) {}

    fn answer(&mut self, _: u64, reply: Reply) {
        if let Reply::Swapped { nodes } = &reply {
            for node in nodes {
                let process = |pid: u32| self.processes.get(&u64::from(pid));
                let has_ended = process(node.new_pid).is_some_and(|new| new.end.is_some());
                let is_old_there = process(node.old_pid).is_some_and(|old| old.end.is_none() && !old.is_stuck);
                let is_right = !(has_ended && is_old_there);
                self.is_to_be(is_right, "the old instance takes over from one that dies on probation");
            }
        }
        if !matches!(reply, Reply::Progress { .. } | Reply::Shadowing { .. }) {
            self.replies.push(reply);
        }
    }

    fn reap(&mut self) {
        self.processes.values_mut().for_each(|process| process.is_reaped = process.end.is_some());
    }

    fn is_memory_full(&self) -> bool {
        false
    }

    fn last_lines(&self, _: u64) -> Vec<String> {
        Vec::new()
    }

    fn last_sent_at(&self, _: &Port) -> Option<SampleId> {
        Some(SampleId { epoch: 0, seq: 7 })
    }

    fn answered_at(&self, _: &str, _: &str) -> Option<SampleId> {
        if self.falls_behind { None } else { Some(SampleId { epoch: 0, seq: 7 }) }
    }

    fn is_read(&self, _: &[(Port, SampleId)]) -> bool {
        true
    }

    fn relies_on_each_answer(&self, _: &str) -> bool {
        false
    }

    fn shadowing(&self, _: &[&str]) -> Reply {
        Reply::Progress { message: String::new() }
    }
}

/// A graph and its history.
#[derive(Clone)]
struct History {
    life: Lifecycle<World>,
    now: Duration,
    faults: Vec<(usize, Fault)>,
    n_ticks: usize,
    is_stopped: bool,
}

impl History {
    /// A running graph, whose nodes are given up if they die twice.
    fn new() -> History {
        let nodes = NODES.map(|id| {
            let mut node = stub(id);
            node.restart = Restart { limit: 1, ..Restart::default() };
            node.heartbeat_millis = Some(HEARTBEAT.as_millis() as u64);
            node.description = node.description.output("samples", "a type", "Samples");
            let before = NODES.iter().position(|known| *known == id).and_then(|idx| idx.checked_sub(1));
            if let Some(before) = before {
                let (from_node, from_port) = (NODES[before].into(), "samples".into());
                let (port, type_name, edge) = ("samples".into(), "a type".into(), EdgeOptions::default());
                node.inputs =
                    vec![Input { port, from_node, from_port, type_name, edge, feedback: false, partner: false }];
            }
            node
        });
        let graph = Graph {
            name: "graph".into(),
            file: "/dataflow.yaml".into(),
            nodes: nodes.into(),
            machines: None,
            local: None,
            host: None,
        };
        let life = Lifecycle::new(&graph, "graph", LaunchOptions::default(), World::default());
        let mut history = History { now: life.now, life, faults: Vec::new(), n_ticks: 0, is_stopped: false };
        history.life.launch();
        while history.life.members.iter().any(|member| member.is_starting()) {
            history.tick();
        }
        history.life.is_launching = false;
        history.life.begin_to_run();
        history
    }

    fn swap(&mut self, nodes: &[usize], shadow_limit_millis: u64, probation_millis: u64) {
        let request = SwapRequest {
            nodes: nodes.iter().map(|idx| NODES[*idx].into()).collect(),
            program: None,
            args: None,
            set: BTreeMap::from([("votes".into(), "5".into())]),
            folder: "/".into(),
            shadow_limit_millis,
            ready_limit_millis: 3000,
            probation_millis,
            allow_mismatch: false,
        };
        self.life.begin_swap(request, None, CLIENT);
    }

    /// Each process does one thing, and a little time passes, or more if nothing happens.
    fn tick(&mut self) {
        self.life.now = self.now;
        let ids: Vec<u64> = self.life.site.processes.keys().copied().collect();
        let mut has_acted = false;
        for id in ids {
            has_acted |= self.act(id);
        }
        self.now += Duration::from_millis(if has_acted { 1 } else { 250 });
        self.life.step(self.now);
        self.n_ticks += 1;
        self.check();
    }

    fn act(&mut self, id: u64) -> bool {
        let process = self.life.site.processes.get_mut(&id).expect("it is there");
        if process.end.is_some() {
            return false;
        }
        if process.is_killed && !process.is_stuck {
            return self.end(id, 9);
        }
        if let Some(since) = process.hangs_since {
            self.life.on_silence(id, self.now - since);
            return false;
        }
        if !process.has_begun {
            process.has_begun = !process.never_begins;
            if process.has_begun {
                self.life.on_begun(id, id as u32);
            }
            return true;
        }
        let report = if !process.is_ready {
            process.is_ready = true;
            let identity = BTreeMap::new();
            Report::Ready { identity, has_state: false, sandbox: Enforcement::Full }
        } else if let Some(command) = process.commands.pop_front() {
            match command {
                Command::HandOver => {
                    process.is_active = false;
                    process.has_handed_over = true;
                    Report::HandedOver { has_sent_all: true }
                }
                Command::TakeOver { .. } => {
                    process.is_active = true;
                    process.has_handed_over = false;
                    Report::TookOver
                }
                _ => return true,
            }
        } else if process.is_standby && !process.is_warm {
            process.is_warm = true;
            Report::Warm { n_samples: 8 }
        } else if process.is_asked && !process.is_drained {
            process.is_drained = true;
            Report::Drained
        } else if process.is_let_go && !process.lingers {
            return self.end(id, 0);
        } else {
            return false;
        };
        self.life.on_report(id, report);
        true
    }

    fn end(&mut self, id: u64, status: i32) -> bool {
        let process = self.life.site.processes.get_mut(&id).expect("it is there");
        process.end = Some(status);
        self.life.on_end(id, ExitStatus::from_raw(status), None);
        let has_its_resources = status != 0 && !self.life.site.processes[&id].is_reaped;
        self.life.site.is_to_be(!has_its_resources, "the resources of a process that dies are freed at once");
        true
    }

    /// The rules that hold at each moment.
    fn check(&mut self) {
        let life = &mut self.life;
        for idx in 0..life.members.len() {
            let member = &life.members[idx];
            let is_given_up = member.is_given_up() || member.is_over;
            let is_there = member.active.is_some() || member.restart_at.is_some() || life.is_in_swap(idx);
            let is_told = !member.is_given_up() || life.site.given_up.contains(&member.node.id);
            life.site.is_to_be(is_there || is_given_up, "a node has an instance, a restart, or is given up");
            life.site.is_to_be(is_told, "the writers of a node that is given up do not wait for it");
        }
        life.site.is_to_be(life.site.replies.len() <= 1, "a swap has one answer");
        assert!(life.site.broken.is_none(), "{:?} after {:?}", life.site.broken, self.faults);
    }

    /// Whether a fault can happen now; it has happened then.
    fn suffers(&mut self, fault: Fault) -> bool {
        self.life.now = self.now;
        self.faults.push((self.n_ticks, fault));
        let active = |node: usize| self.life.members[node].active.as_ref();
        let standby = |node: usize| self.life.members[node].standby.as_ref();
        let instance: Option<&Instance> = match fault {
            Fault::Kill(node) | Fault::Exit(node) | Fault::Hang(node) | Fault::Stick(node) | Fault::Lingers(node) => {
                active(node)
            }
            Fault::KillStandby(node) | Fault::HangStandby(node) => standby(node),
            _ => None,
        };
        let living = instance.filter(|instance| instance.is_running() && instance.pid.is_some());
        let process = living.map(|living| (living.id, &self.life.site.processes[&living.id]));
        let id = process.filter(|(_, process)| process.hangs_since.is_none() && !process.is_killed).map(|(id, _)| id);
        match (fault, id) {
            (Fault::Kill(_) | Fault::KillStandby(_), Some(id)) => self.end(id, 9),
            (Fault::Exit(_), Some(id)) => self.end(id, 1 << 8),
            (Fault::Hang(_) | Fault::HangStandby(_) | Fault::Stick(_), Some(id)) => {
                let process = self.life.site.processes.get_mut(&id).expect("it is there");
                process.hangs_since = Some(self.now);
                process.is_stuck = matches!(fault, Fault::Stick(_));
                true
            }
            (Fault::Lingers(_), Some(id)) => {
                let process = self.life.site.processes.get_mut(&id).expect("it is there");
                !std::mem::replace(&mut process.lingers, true)
            }
            (Fault::NoProcess, _) => !std::mem::replace(&mut self.life.site.has_no_process, true),
            (Fault::NeverBegins, _) => !std::mem::replace(&mut self.life.site.never_begins, true),
            (Fault::FallsBehind, _) => {
                self.life.site.falls_behind = !self.life.site.falls_behind;
                true
            }
            (Fault::ClientGoes, _) => {
                self.life.on_client_gone(CLIENT);
                true
            }
            (Fault::Promote, _) => {
                let n_replies = self.life.site.replies.len();
                self.life.on_promote(true, CLIENT);
                self.life.site.replies.len() == n_replies
            }
            (Fault::Stop, _) => {
                self.stop();
                true
            }
            _ => false,
        }
    }

    fn is_whole(&self) -> bool {
        let is_well = |id: u64| {
            let process = &self.life.site.processes[&id];
            process.is_ready && process.hangs_since.is_none() && process.commands.is_empty() && process.end.is_none()
        };
        let mut members = self.life.members.iter();
        self.life.swap.is_none()
            && self.life.leaving.is_empty()
            && members.all(|member| member.is_given_up() || member.active.as_ref().is_some_and(|each| is_well(each.id)))
    }

    /// Waits until the graph is whole again, or must end.
    fn recover(&mut self) {
        let start = self.now;
        while !self.is_whole() && !self.life.site.has_failed && !self.is_stopped {
            self.tick();
            assert!(self.now - start < LIMIT, "it stands still after {:?}", self.faults);
        }
        if self.is_stopped || self.life.site.has_failed {
            return;
        }
        assert_eq!(self.life.site.replies.len(), 1, "a swap has one answer: {:?}", self.faults);
        for member in self.life.members.iter().filter(|member| !member.is_given_up()) {
            let active = member.active.as_ref().expect("it is whole");
            let process = &self.life.site.processes[&active.id];
            let is_new = process.votes == 5;
            let is_settled = member.standby.is_none() && member.restart_at.is_none();
            let answers = process.is_active && is_settled && member.state == NodeState::Running;
            let votes = member.node.params["votes"].as_u64();
            let is_swapped = matches!(self.life.site.replies[0], Reply::Swapped { .. });
            let is_right = answers && votes == Some(process.votes) && (is_swapped || !is_new);
            assert!(is_right, "node '{}' after {:?}", member.node.id, self.faults);
        }
    }

    /// Ends the graph, which always comes to its end.
    fn stop(&mut self) {
        if std::mem::replace(&mut self.is_stopped, true) {
            return;
        }
        let start = self.now;
        self.life.begin_draining();
        while !self.life.go_on_draining(false) {
            self.tick();
            assert!(self.now - start < LIMIT, "it does not drain after {:?}", self.faults);
        }
        self.life.begin_quitting();
        while !self.life.go_on_quitting(false) {
            self.tick();
            assert!(self.now - start < LIMIT, "it does not end after {:?}", self.faults);
        }
        let is_over = self.life.site.processes.values().all(|process| process.end.is_some() || process.is_stuck);
        assert!(is_over, "no process outlives its graph: {:?}", self.faults);
    }
}

/// The ends of the histories.
#[derive(Default)]
struct Found {
    n_histories: usize,
    swapped: usize,
    rolled_back: usize,
    abandoned: usize,
    given_up: usize,
}

/// Lets the faults happen at each moment, at most `n_faults` in a history.
fn search(mut history: History, faults: &[Fault], n_faults: usize, found: &mut Found) {
    while !history.is_stopped && (history.life.swap.is_some() || !history.is_whole()) {
        if n_faults > 0 {
            for fault in faults {
                let mut other = history.clone();
                if other.suffers(*fault) {
                    search(other, faults, n_faults - 1, found);
                }
            }
        }
        history.tick();
        if history.life.site.has_failed
            || history.now - history.life.members[0].active.as_ref().map_or(history.now, |active| active.started)
                > LIMIT
        {
            break;
        }
    }
    history.recover();
    found.n_histories += 1;
    match history.life.site.replies.first() {
        Some(Reply::Swapped { .. }) => found.swapped += 1,
        Some(Reply::Error { rolled_back: true, .. }) => found.rolled_back += 1,
        _ => found.abandoned += 1,
    }
    found.given_up += usize::from(history.life.members.iter().any(|member| member.is_given_up()));
    history.stop();
}

fn searched(mut history: History, faults: &[Fault], n_faults: usize) -> Found {
    history.faults.clear();
    let mut found = Found::default();
    search(history, faults, n_faults, &mut found);
    println!("{} histories", found.n_histories);
    found
}

/// A graph in which a swap has just been asked for.
fn swapping(nodes: &[usize], shadow_limit_millis: u64, probation_millis: u64) -> History {
    let mut history = History::new();
    history.swap(nodes, shadow_limit_millis, probation_millis);
    history
}

#[test]
fn a_swap_of_a_node_outlives_two_faults_at_any_moments() {
    let faults = [
        Fault::Kill(1),
        Fault::KillStandby(1),
        Fault::Exit(1),
        Fault::Hang(1),
        Fault::HangStandby(1),
        Fault::Stick(1),
        Fault::Lingers(1),
        Fault::NoProcess,
        Fault::NeverBegins,
        Fault::ClientGoes,
        Fault::Stop,
    ];
    let found = searched(swapping(&[1], 0, 500), &faults, 2);
    assert!(found.swapped > 0 && found.rolled_back > 0 && found.abandoned > 0 && found.given_up > 0);
}

#[test]
fn a_swap_of_two_nodes_outlives_faults_of_both_and_of_a_neighbour() {
    let mut faults = vec![Fault::FallsBehind, Fault::ClientGoes, Fault::Stop, Fault::NeverBegins, Fault::NoProcess];
    for node in 0..NODES.len() {
        faults.extend([Fault::Kill(node), Fault::Exit(node), Fault::Hang(node)]);
        faults.extend([Fault::KillStandby(node), Fault::HangStandby(node)]);
    }
    let found = searched(swapping(&[1, 2], 0, 500), &faults, 2);
    assert!(found.swapped > 0 && found.rolled_back > 0 && found.abandoned > 0);
}

/// The first of them dies while the other one delays the hand-over, and its restart is due in the midst of it.
#[test]
fn a_node_is_not_started_again_while_it_is_handed_over() {
    let mut history = swapping(&[1, 2], 0, 500);
    while history.life.members[2].standby.as_ref().is_some_and(|standby| standby.pid.is_none()) {
        history.tick();
    }
    assert!(history.suffers(Fault::NoProcess) && history.suffers(Fault::FallsBehind));
    let found = searched(history, &[Fault::Kill(1), Fault::FallsBehind, Fault::Stop], 2);
    assert!(found.swapped > 0 && found.abandoned > 0);
}

#[test]
fn a_comparison_and_a_long_probation_end_with_their_graph() {
    let found =
        searched(swapping(&[1], 1000, 500), &[Fault::Promote, Fault::ClientGoes, Fault::Kill(1), Fault::Stop], 2);
    assert!(found.swapped > 0 && found.abandoned > 0);
    let long_millis = LIMIT.as_millis() as u64 + 5000;
    let found = searched(swapping(&[1], 0, long_millis), &[Fault::ClientGoes, Fault::Kill(1), Fault::Stop], 1);
    assert!(found.swapped > 0 && found.rolled_back > 0);
}
