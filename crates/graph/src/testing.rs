//! A graph's answers, made up: for the tests of whatever asks graphs.

use std::io::{BufRead, BufReader, Write};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use blindgrasp_messages::{Action, Reason};
use blindgrasp_operator::control_socket::ControlSocket;
use blindgrasp_operator::wiring::EdgePolicy;

use crate::client::activity::{Look, RUN};
use crate::client::usage::ProcessUsage;
use crate::control::{
    DecidedGrasp, DecisionStatus, EdgeStatus, GraphState, GraphStatus, Iceoryx2Config, NodeState, NodeStatus, Reply,
    Request,
};

pub(crate) fn listen(graph: &str) -> ControlSocket {
    ControlSocket::bind(graph).expect("free")
}

/// A graph that answers the requests of one client, each with some replies, and ends.
pub fn serve(graph: &str, answers: Vec<(Request, Vec<Reply>)>) -> JoinHandle<()> {
    let socket = listen(graph);
    std::thread::spawn(move || {
        let (mut stream, _) = socket.listener().accept().expect("a client");
        let mut lines = BufReader::new(stream.try_clone().expect("cloned")).lines();
        for (expected, replies) in answers {
            let line = lines.next().expect("a request").expect("readable");
            assert_eq!(serde_json::from_str::<Request>(&line).expect("a request"), expected);
            for reply in replies {
                writeln!(stream, "{}", serde_json::to_string(&reply).expect("JSON")).expect("sent");
            }
        }
    })
}

/// A status with something in each field.
pub fn made_status(graph: &str) -> GraphStatus {
    let lifted = DecidedGrasp {
        grasp_id: 99,
        action: Action::Lift,
        reason: Reason::Stable,
        probability_stable: 0.875,
        latency_nanos: Some(250_000),
        decided_nanos: 1,
        truth: Some(false),
    };
    GraphStatus {
        graph: graph.into(),
        file: "/robot/dataflow.yaml".into(),
        pid: 4242,
        state: GraphState::Degraded,
        message: Some("classifier was given up after 5 restarts".into()),
        uptime_secs: 3725.4,
        log_folder: "/logs".into(),
        iceoryx2: Iceoryx2Config::default(),
        nodes: vec![
            NodeStatus {
                pid: Some(std::process::id()),
                standby_pid: Some(77),
                n_restarts: 2,
                n_swaps: 1,
                heartbeat_age_millis: Some(12),
                ..made_node("contacts", NodeState::Running)
            },
            made_node("classifier", NodeState::Failed),
        ],
        decisions: DecisionStatus {
            n_lift: 60,
            n_hold: 40,
            holds: [("unstable".into(), 30), ("no_contact".into(), 10)].into(),
            n_false_positives: 1,
            latest: [lifted].into(),
        },
        edges: vec![EdgeStatus {
            from: "contacts/contacts".into(),
            to: "classifier/contacts".into(),
            policy: blindgrasp_operator::wiring::EdgePolicy::Latest,
            capacity: 4,
            sent: 1000,
            received: 990,
            dropped: 10,
            missing: 11,
            repeated: 3,
            reordered: 2,
            late: 7,
            blocked_nanos: 1_500_000,
            ages: serde_json::from_str("[[102400,900],[1024000,90]]").expect("ages"),
        }],
        link: None,
    }
}

fn made_node(node: &str, state: NodeState) -> NodeStatus {
    NodeStatus {
        node: node.into(),
        program: format!("/opt/{node}").into(),
        args: Vec::new(),
        state,
        pid: None,
        standby_pid: None,
        n_restarts: 0,
        n_swaps: 0,
        heartbeat_age_millis: None,
        params: serde_json::Map::new(),
        counts: [("refused".to_string(), 3)].into(),
    }
}

/// Two looks at a graph, two seconds apart.
pub fn made_looks() -> (Look, Look) {
    let at = Instant::now();
    let mut status = made_status("gate");
    status.nodes[0].pid = Some(4243);
    let used = |cpu_secs| ProcessUsage { cpu_secs, resident_bytes: 3 << 20 };
    let before = Look {
        status: status.clone(),
        usage: [(4243, used(1.0)), (4242, used(5.0))].into(),
        at,
        load_average: Some(0.5),
    };
    status.uptime_secs += 2.0;
    let edge = &mut status.edges[0];
    (edge.sent, edge.received, edge.missing, edge.late) = (3000, 2988, 13, 8);
    edge.ages = serde_json::from_str("[[102400,900],[204800,1980],[1024000,108]]").expect("ages");
    status.edges.push(EdgeStatus {
        from: "classifier/prediction".into(),
        to: RUN.into(),
        policy: EdgePolicy::Lossless,
        dropped: 0,
        missing: 0,
        ..status.edges[0].clone()
    });
    status.decisions.n_hold += 1;
    let held = DecidedGrasp {
        action: Action::Hold,
        reason: Reason::Unstable,
        grasp_id: 100,
        decided_nanos: 7,
        ..status.decisions.latest[0].clone()
    };
    status.decisions.latest.push_back(held);
    let now = Look {
        status,
        usage: [(4243, used(1.5)), (4242, used(5.02))].into(),
        at: at + Duration::from_secs(2),
        load_average: Some(0.75),
    };
    (before, now)
}
