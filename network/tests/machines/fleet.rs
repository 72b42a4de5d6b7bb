//! Machines through a router, one brain for several robots, and changes of a part: network namespaces, real processes.

use crate::common::{Graph, json_lines, signal, wait_until};
use crate::hosts::Network;
use crate::split::{
    Attacker, FOREVER, assert_lost_nothing, assert_nothing_unsafe, command, decided, keys, node, on_one_machine, part,
    patient, peer, pid_of, split, stop, strict, wait_for_state, with_tls,
};
use rustix::process::Signal;

fn n_lifted(graph: &Graph) -> usize {
    graph.lines().iter().filter(|line| line["action"] == "lift").count()
}

#[test]
fn a_graph_through_a_router_decides_as_on_one_machine_and_survives_the_router() {
    let Some(network) = Network::new(&[0, 0, 0]) else { return };
    let [robot, brain, gateway] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    // Without TLS: Zenoh's TLS in a router breaks now and then, or is slow (docs/security.md).
    let config = r#"{"mode": "router", "listen": {"endpoints": ["tcp/0.0.0.0:7447"]},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}}}"#;
    std::fs::write(folder.path().join("zenohd.json5"), config).expect("written");
    let start_router = || Attacker::start(gateway, folder.path(), &["router", "zenohd.json5"]);
    let machines = |more: &str| {
        format!(
            "machines:\n  robot: {{}}\n  brain: {{}}\nlink: {{router: tcp/{}:7447, insecure: true{more}}}\n",
            gateway.address
        )
    };
    // A busy machine must not end as a cut link.
    let flow = split(folder.path(), &machines(", deadline_ms: 20000"), &[patient()]);
    let strict_folder = tempfile::tempdir().expect("a folder");
    let strict_flow = split(strict_folder.path(), &machines(""), &[strict()]);

    // The machines first.
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &["--set", "recorded_source.rate=max"]);
    let router = start_router();
    let (robot_end, brain_end) = (robot_part.finish(), brain_part.finish());
    assert_lost_nothing("robot", &robot_end);
    assert_lost_nothing("brain", &brain_end);
    assert_eq!(decided(robot_end.decisions), on_one_machine());

    let brain_part = part(brain, &strict_flow, "brain", &[]);
    let robot_part = part(robot, &strict_flow, "robot", &FOREVER);
    wait_until(|| n_lifted(&robot_part) > 2, || robot_part.said());
    drop(router);
    wait_for_state(robot, &robot_part, "brain", "down");
    wait_for_state(brain, &brain_part, "robot", "down");
    let n_before = robot_part.n_decisions();
    std::thread::sleep(std::time::Duration::from_secs(1));
    let meanwhile = robot_part.lines()[n_before..].to_vec();
    assert!(meanwhile.iter().all(|line| line["action"] == "hold"), "{meanwhile:?}");
    let _router = start_router();
    wait_for_state(robot, &robot_part, "brain", "up");
    let n_before = n_lifted(&robot_part);
    wait_until(|| n_lifted(&robot_part) > n_before + 2, || robot_part.said());
    let robot_end = stop(robot, robot_part);
    let brain_end = brain_part.finish();
    assert_nothing_unsafe(&robot_end);
    let reasons: Vec<&str> = robot_end.decisions.iter().filter_map(|line| line["reason"].as_str()).collect();
    assert!(reasons.contains(&"link_down") || reasons.contains(&"stale"), "{reasons:?}");
    assert_lost_nothing("robot", &robot_end);
    assert_lost_nothing("brain", &brain_end);
}

#[test]
fn one_brain_serves_two_robots_and_neither_disturbs_the_other() {
    let Some(network) = Network::new(&[0, 0, 3000]) else { return };
    let [one, two, brain] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "brain"]);
    for namespace in ["r1", "r2"] {
        let path = keys.to_str().expect("UTF-8");
        crate::common::run(&["keys", path, "--machine", "robot", "--namespace", namespace], 0);
    }
    // Each robot listens, wherever it is.
    let machines = format!(
        "machines:\n  robot: {{listen: tls/robot.example:7447}}\n  brain: {{}}\n\
         link: {{keys: {}, deadline_ms: 20000}}\n",
        keys.display()
    );
    let flow = split(folder.path(), &machines, &[patient()]);
    let robot_part = |host, namespace| {
        let own_keys = keys.join(namespace);
        let own_keys = own_keys.to_str().expect("UTF-8");
        let arguments = ["--namespace", namespace, "--keys", own_keys, "--listen", "tls/0.0.0.0:7447"];
        part(host, &flow, "robot", &[&arguments, &FOREVER[..]].concat())
    };
    let brain_part = |robot: &crate::hosts::Host, namespace| {
        let endpoint = format!("tls/{}:7447", robot.address);
        part(brain, &flow, "brain", &["--namespace", namespace, "--connect", &endpoint, "--stay"])
    };
    let (robot_one, brain_one) = (robot_part(one, "r1"), brain_part(one, "r1"));
    robot_one.wait_for_decisions(3);
    let (brain_two, robot_two) = (brain_part(two, "r2"), robot_part(two, "r2"));
    robot_two.wait_for_decisions(3);
    for brain_part in [&brain_one, &brain_two] {
        wait_for_state(brain, brain_part, "robot", "up");
    }
    let (_, listed, _) = command(brain, &["ps", "--json"]);
    let graphs = json_lines(listed.as_bytes()).pop().expect("a line")["graphs"].clone();
    for (graph, namespace) in [(&brain_one, "r1"), (&brain_two, "r2")] {
        let found = graphs.as_array().expect("graphs").iter().find(|found| found["graph"] == graph.name.as_str());
        let link = &found.unwrap_or_else(|| panic!("{} is not among {graphs}", graph.name))["link"];
        assert_eq!(link["namespace"], namespace, "{link}");
        assert_eq!(link["peers"][0]["state"], "up", "{link}");
    }

    // Robot two dies without a message.
    for pid in [pid_of(two, &robot_two, "link"), robot_two.pid()] {
        signal(pid, Signal::KILL);
    }
    wait_for_state(brain, &brain_two, "robot", "down");
    robot_one.wait_for_decisions(5);
    assert_eq!(peer(brain, &brain_one, "robot")["n_times_up"], 1);
    let two_so_far = decided(robot_two.lines());
    drop(robot_two);
    // It comes back, to the same brain.
    let robot_two = robot_part(two, "r2");
    wait_until(|| robot_two.n_decisions() > 4, || format!("{}\n{}", robot_two.said(), brain_two.said()));
    stop(two, robot_two);
    // Between two sessions it does not answer.
    wait_until(|| command(brain, &["stop", &brain_two.name]).0 == Some(0), || brain_two.said());
    brain_two.finish();
    let expected = on_one_machine();
    for (grasp_id, line) in two_so_far.iter().enumerate() {
        let undisturbed = &expected[grasp_id % expected.len()];
        assert_eq!((&line["action"], &line["reason"]), (&undisturbed["action"], &undisturbed["reason"]), "{line}");
    }
    robot_one.wait_for_decisions(1);
    let robot_end = stop(one, robot_one);
    robot_end.assert_undisturbed("robot one");
    assert_eq!(robot_end.summary["restarts"], 0, "{}", robot_end.stderr);
    // It may be between two sessions.
    wait_until(|| command(brain, &["stop", &brain_one.name]).0 == Some(0), || brain_one.said());
    assert_lost_nothing("brain one", &brain_one.finish());
}

#[test]
fn a_part_is_swapped_set_and_stopped_while_samples_cross() {
    let Some(network) = Network::new(&[0, 700]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let flow = split(folder.path(), &with_tls(brain, &keys), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(3);
    for node_id in ["classifier", "encoder", "classifier"] {
        let old = node(brain, &brain_part.name, node_id)["pid"].clone();
        let swap = ["swap", node_id, "--graph", &brain_part.name, "--probation", "0.1", "--json"];
        let told = command(brain, &swap);
        assert_eq!(told.0, Some(0), "{told:?}");
        let swapped = json_lines(told.1.as_bytes()).pop().expect("a line");
        assert_eq!((&swapped["result"], &swapped["nodes"][0]["old_pid"]), (&"swapped".into(), &old), "{swapped}");
        robot_part.wait_for_decisions(2);
    }
    let told = command(robot, &["set", "lift_arbiter.max_age_ms=500000", "--graph", &robot_part.name, "--json"]);
    assert_eq!(told.0, Some(0), "{told:?}");
    // Who asks the wrong machine is told the right one.
    let told = command(robot, &["set", "classifier.model=x", "--graph", &robot_part.name]);
    assert!(told.0 == Some(1) && told.2.contains("runs on machine 'brain': run the command there"), "{told:?}");
    // A recording of a part: no sample is missing.
    let file = folder.path().join("brain.mcap");
    let file = file.to_str().expect("UTF-8");
    let told = command(brain, &["record", &brain_part.name, "--out", file, "--for", "1", "--json"]);
    assert_eq!(told.0, Some(0), "{told:?}");
    let summary = json_lines(told.1.as_bytes()).pop().expect("a line");
    assert_eq!(summary["missing"], 0, "{summary}");

    robot_part.wait_for_decisions(2);
    let told = command(brain, &["stop", &brain_part.name]);
    assert_eq!(told.0, Some(0), "{told:?}");
    let brain_end = brain_part.finish();
    assert_eq!(
        brain_end.summary["swaps"], 3,
        "{}
{}",
        brain_end.summary, brain_end.stderr
    );
    assert_lost_nothing("brain", &brain_end);
    wait_for_state(robot, &robot_part, "brain", "left");
    let robot_end = stop(robot, robot_part);
    assert_nothing_unsafe(&robot_end);
    // Until brain was stopped.
    let expected = crate::common::undisturbed();
    let is_as_expected = |(grasp_id, line): (usize, &serde_json::Value)| {
        let (action, reason) = &expected[grasp_id % expected.len()];
        (line["action"].as_str(), line["reason"].as_str()) == (Some(action), Some(reason))
    };
    let n_before_the_end = robot_end.decisions.len().saturating_sub(2 + n_decided_after(&robot_end.decisions));
    assert!(robot_end.decisions.iter().enumerate().take(n_before_the_end).all(is_as_expected), "{}", robot_end.stderr);
}

/// How many grasps at the end were held because brain had gone.
fn n_decided_after(decisions: &[serde_json::Value]) -> usize {
    decisions
        .iter()
        .rev()
        .take_while(|line| ["link_down", "missing"].map(|reason| line["reason"] == reason).contains(&true))
        .count()
}

#[test]
fn a_part_in_the_middle_of_a_stream_can_be_stopped_without_a_loss() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let machines = with_tls(brain, &keys).replace(", deadline_ms: 20000", "");
    let flow = split(folder.path(), &machines, &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(5);
    let told = command(brain, &["stop", &brain_part.name]);
    assert_eq!(told.0, Some(0), "{told:?}");
    assert_lost_nothing("brain", &brain_part.finish());
    stop(robot, robot_part);
}
