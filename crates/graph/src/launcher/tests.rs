//! A launcher of one node, whose program is a script that reports like an operator.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};

use crate::control::{Reply, Request};
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
