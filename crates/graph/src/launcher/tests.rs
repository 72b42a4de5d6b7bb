//! A launcher of one node, whose program is a script that reports like an operator.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};

use crate::control::{NodeState, Reply, Request, SwapRequest};
use crate::dataflow::pins::Pins;
use crate::dataflow::{Graph, Node, ParamKind, ProcessOptions, Restart};
use crate::launcher::server::Ask;
use crate::launcher::{LaunchOptions, Launcher};
use crate::plan::{Plan, PlanOptions};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::namespace::Namespace;
use blindgrasp_operator::wiring::{Clock, Report, Sandbox};

/// The node of all these graphs.
pub(super) const STUB: &str = "stub";

/// A launched graph. Its fields are dropped in this order.
pub(super) struct Launched {
    pub(super) launcher: Launcher,
    _namespace: Namespace,
    _logs: Logs,
}

/// The folder of its logs, which goes with it.
struct Logs(PathBuf);

impl Drop for Logs {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Launches a script of sh, which finds `argument` in `$0`, and reports to descriptor 3. It has said that it is ready.
pub(super) fn launched(name: &str, script: &str, argument: &str) -> Launched {
    let name = format!("{name}-{}", std::process::id());
    let script =
        format!("exec 3> /dev/fd/$BLINDGRASP_REPORTS; echo '{{\"report\":\"ready\"}}' >&3; read -r go; {script}");
    let mut node = stub(STUB);
    node.args = vec!["-c".into(), script, argument.into()];
    let graph = Graph {
        name: name.clone(),
        file: "/dataflow.yaml".into(),
        nodes: vec![node],
        machines: None,
        local: None,
        host: None,
    };
    let namespace = Namespace::reserve(&name).expect("reserved");
    let options = PlanOptions { wait_limit_millis: 5000, clock: Clock::Recording };
    let plan = Plan::new(&graph, &name, namespace.wiring(), &BTreeSet::new(), options);
    let cursors = plan.create_cursors().expect("made");
    let options = LaunchOptions { is_on_terminal: false, ..LaunchOptions::default() };
    let started = Launcher::start(&graph, &name, plan, cursors, namespace.listener(), Arc::default(), options);
    let mut launcher = started.expect("started");
    assert_eq!(launcher.wait_until_ready(&|| true, &|| false).expect("ready"), None);
    let logs = Logs(launcher.log_folder.path().into());
    Launched { launcher, _namespace: namespace, _logs: logs }
}

/// A node whose program is the shell.
pub(super) fn stub(id: &str) -> Node {
    let votes = ParamKind::Integer { min: None, max: None };
    Node {
        id: id.into(),
        program: "/bin/sh".into(),
        args: Vec::new(),
        description: OperatorDescription::new(id, "A stub").live_param("votes", votes, Some("3".into()), "Votes"),
        inputs: Vec::new(),
        params: [("votes".to_owned(), 3.into())].into_iter().collect(),
        restart: Restart::default(),
        heartbeat_millis: None,
        sandbox: Sandbox::Off,
        memory_max_mib: None,
        process: ProcessOptions::default(),
        sha256: Pins::default(),
        machine: None,
    }
}

/// A request of a client, and its replies.
pub(super) fn ask(request: Request) -> (Box<Ask>, Receiver<Reply>) {
    let (reply, replies) = sync_channel(8);
    (Box::new(Ask { client: 1, request, description: None, reply }), replies)
}

/// Lets the launcher work until a condition holds.
pub(super) fn work_until(launcher: &mut Launcher, mut is_so: impl FnMut(&Launcher) -> bool) {
    while !is_so(launcher) {
        launcher.turn().expect("supervised");
    }
}

/// The counts of a state can fall: another model has learned from no lift.
#[test]
fn counts_of_a_state_are_those_of_the_active_process() {
    let mut graph = launched("counts", "exec cat > /dev/null", "");
    let launcher = &mut graph.launcher;
    let id = launcher.life.members[0].active.as_ref().expect("an instance").id;
    let shown_after = |launcher: &mut Launcher, kept: u64| {
        let counts = BTreeMap::from([("outcomes/kept".to_owned(), kept)]);
        launcher.on_output(id, Report::Counts { counts, in_all: true });
        launcher.status().nodes[0].counts.get("outcomes/kept").copied()
    };
    for (kept, shown) in [(0, None), (304, Some(304)), (7, Some(7)), (0, Some(0))] {
        assert_eq!(shown_after(launcher, kept), shown);
    }
    // A replacement that stands by counts for itself alone.
    let member = &mut launcher.life.members[0];
    std::mem::swap(&mut member.active, &mut member.standby);
    assert_eq!(shown_after(launcher, 12), Some(0));
}

/// The same rules with real processes, each in its order; `lifecycle_tests` has them in all others.
#[test]
fn a_process_is_started_again_swapped_taken_back_and_ended() {
    let script = r#"trap 'echo "{\"report\":\"drained\"}" >&3' TERM
        while read -r line; do
            case "$line" in
                *hand_over*) echo '{"report":"handed_over","has_sent_all":true}' >&3 ;;
                *take_over*) echo '{"report":"took_over"}' >&3 ;;
            esac
        done"#;
    let mut graph = launched("whole-life", script, "");
    let launcher = &mut graph.launcher;
    let swap = |votes: u32, probation_millis: u64| {
        ask(Request::Swap(SwapRequest {
            nodes: vec![STUB.into()],
            program: None,
            args: None,
            set: BTreeMap::from([("votes".into(), votes.to_string())]),
            folder: "/".into(),
            shadow_limit_millis: 0,
            ready_limit_millis: 60_000,
            probation_millis,
            allow_mismatch: false,
        }))
    };
    let kill = |pid: Option<u32>| {
        let pid = rustix::process::Pid::from_raw(pid.expect("a process") as i32).expect("a number");
        rustix::process::kill_process(pid, rustix::process::Signal::KILL).expect("killed");
    };
    let stub = |launcher: &Launcher| launcher.status().nodes.remove(0);
    kill(stub(launcher).pid);
    work_until(launcher, |launcher| stub(launcher).n_restarts == 1 && stub(launcher).state == NodeState::Running);
    let (asked, replies) = swap(5, 0);
    launcher.on_ask(asked);
    work_until(launcher, |launcher| stub(launcher).n_swaps == 1);
    assert!(matches!(replies.try_iter().last(), Some(Reply::Swapped { .. })));
    assert_eq!(stub(launcher).params["votes"], 5);
    let old = stub(launcher).pid;
    let (asked, replies) = swap(7, 600_000);
    launcher.on_ask(asked);
    let on_probation = |reply: &Reply| matches!(reply, Reply::Progress { message } if message.contains("on probation"));
    work_until(launcher, |_| replies.try_iter().any(|reply| on_probation(&reply)));
    assert_eq!(stub(launcher).standby_pid, old);
    kill(stub(launcher).pid);
    work_until(launcher, |launcher| launcher.life.swap.is_none());
    assert!(matches!(replies.try_iter().last(), Some(Reply::Error { rolled_back: true, .. })));
    assert_eq!((stub(launcher).pid, &stub(launcher).params["votes"]), (old, &5.into()));
    launcher.drain(&|| false).expect("drained");
    launcher.quit(&|| false).expect("ended");
}
