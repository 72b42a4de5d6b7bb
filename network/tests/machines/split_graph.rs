//! One graph on several machines, each a network namespace with shared memory of its own.

use crate::common::{signal, wait_until};
use crate::hosts::{Host, Network};
use crate::split::{
    FOREVER, assert_lost_nothing, assert_nothing_unsafe, decided, node, on_one_machine, part, patient, peer, pid_of,
    split, stop, wait_for_state,
};
use serde_json::Value;

/// Machines that trust all others on their bridge, and count as cut off after so long.
fn plain(brain: &Host, deadline_millis: u32) -> String {
    format!(
        "machines:\n  robot: {{}}\n  brain: {{listen: tcp/{}:7447}}\n\
         link: {{insecure: true, deadline_ms: {deadline_millis}}}\n",
        brain.address
    )
}

/// The default.
const DEADLINE_MILLIS: u32 = 150;
/// On a busy machine, a slow peer does not count as cut off.
const LONG_MILLIS: u32 = 20_000;

/// Nearly as on a robot, for a busy machine: samples older than a second do not count.
fn nearly_strict() -> (String, String) {
    ("max_age_ms: 5000".into(), "max_age_ms: 1000".into())
}

#[test]
fn a_graph_split_over_two_machines_decides_bit_for_bit_as_on_one() {
    let Some(network) = Network::new(&[0, 5000]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, LONG_MILLIS), &[]);
    let expected = on_one_machine();
    for is_robot_first in [true, false] {
        let max = ["--set", "recorded_source.rate=max"];
        let start_robot = || part(robot, &flow, "robot", &max);
        let start_brain = || part(brain, &flow, "brain", &[]);
        let (robot_part, brain_part) = if is_robot_first {
            let robot_part = start_robot();
            wait_until(|| robot_part.said().contains("waiting for machine brain"), || robot_part.said());
            (robot_part, start_brain())
        } else {
            let brain_part = start_brain();
            wait_until(|| brain_part.said().contains("waiting for machine robot"), || brain_part.said());
            (start_robot(), brain_part)
        };
        let (robot_end, brain_end) = (robot_part.finish(), brain_part.finish());
        for (name, end) in [("robot", &robot_end), ("brain", &brain_end)] {
            assert_lost_nothing(name, end);
            assert_eq!(end.summary["end"], "finished", "{name}: {}", end.summary);
        }
        for (line, expected) in decided(robot_end.decisions.clone()).iter().zip(expected) {
            assert_eq!(line, expected, "{}", robot_end.stderr);
        }
        assert_eq!(robot_end.decisions.len(), expected.len());
        assert!(brain_end.decisions.is_empty());
    }
}

#[test]
fn a_pulled_cable_holds_and_loses_nothing_and_is_reported() {
    let Some(network) = Network::new(&[0, 7]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, DEADLINE_MILLIS), &[nearly_strict()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    let n_lifted = || robot_part.lines().iter().filter(|line| line["action"] == "lift").count();
    wait_until(|| n_lifted() > 3, || robot_part.said());

    let has_held_for_it = || robot_part.lines().iter().any(|line| line["reason"] == "link_down");
    // The first cut outlasts the connection, whose lease is 2 s. A cut between two grasps holds nothing, so that more
    // cuts follow until one comes amid a grasp.
    for round in 0..31 {
        // A lift was seen just now, and between two grasps there are some ten milliseconds: not always then.
        std::thread::sleep(std::time::Duration::from_millis(20 + 17 * round % 57));
        network.cable(1, false);
        wait_for_state(robot, &robot_part, "brain", "down");
        wait_for_state(brain, &brain_part, "robot", "down");
        // Decisions from here on are made without the brain.
        let n_before = robot_part.n_decisions();
        std::thread::sleep(std::time::Duration::from_millis(if round == 0 { 3000 } else { 300 }));
        let meanwhile: Vec<Value> = robot_part.lines()[n_before..].to_vec();
        assert!(meanwhile.iter().all(|line| line["action"] == "hold"), "{meanwhile:?}");
        network.cable(1, true);
        wait_for_state(robot, &robot_part, "brain", "up");
        let n_before = n_lifted();
        wait_until(
            || n_lifted() > n_before + 3,
            || format!("{}\n{}", peer(robot, &robot_part, "brain"), robot_part.said()),
        );
        if has_held_for_it() {
            break;
        }
        assert!(round < 30, "no grasp was open at any of {round} cuts: {}", robot_part.said());
    }
    let at_robot = peer(robot, &robot_part, "brain");
    assert!(at_robot["n_times_up"].as_u64() >= Some(2), "{at_robot}");
    for channel in at_robot["channels"].as_array().expect("channels") {
        assert_eq!(channel["n_lost"], 0, "{channel}");
    }
    let robot_end = stop(robot, robot_part);
    let brain_end = brain_part.finish();
    assert_nothing_unsafe(&robot_end);
    assert_lost_nothing("robot", &robot_end);
    assert_lost_nothing("brain", &brain_end);
}

#[test]
fn a_killed_brain_is_missed_and_a_new_one_is_found() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, DEADLINE_MILLIS), &[nearly_strict()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    let n_lifted = || robot_part.lines().iter().filter(|line| line["action"] == "lift").count();
    wait_until(|| n_lifted() > 3, || robot_part.said());
    // The link last: it would say good-bye.
    for pid in [pid_of(brain, &brain_part, "link"), brain_part.pid()] {
        signal(pid, rustix::process::Signal::KILL);
    }
    drop(brain_part);
    wait_for_state(robot, &robot_part, "brain", "down");
    let n_before = n_lifted();
    let brain_part = part(brain, &flow, "brain", &[]);
    wait_until(|| n_lifted() > n_before + 3, || format!("{}\n{}", robot_part.said(), brain_part.said()));
    let robot_end = stop(robot, robot_part);
    let brain_end = brain_part.finish();
    assert_nothing_unsafe(&robot_end);
    assert_lost_nothing("brain", &brain_end);
    // Samples that were in the brain when it died are missing and counted, and no grasp was lifted on them.
    assert!([Some(0), Some(3)].contains(&robot_end.code), "{}\n{}", robot_end.summary, robot_end.stderr);
}

#[test]
fn killed_links_come_back_and_the_decisions_are_undisturbed() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, LONG_MILLIS), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(5);
    for round in 0..6 {
        let (host, graph) = if round % 2 == 0 { (robot, &robot_part) } else { (brain, &brain_part) };
        let pid = pid_of(host, graph, "link");
        signal(pid, rustix::process::Signal::KILL);
        robot_part.wait_for_decisions(10);
    }
    let robot_end = stop(robot, robot_part);
    let brain_end = brain_part.finish();
    robot_end.assert_undisturbed("robot");
    assert_eq!(brain_end.summary["samples_lost"], 0, "{}\n{}", brain_end.summary, brain_end.stderr);
}

/// The samples that a link keeps while the other machine is away outlive it.
#[test]
fn a_link_that_is_killed_while_the_other_machine_is_away_loses_nothing() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, DEADLINE_MILLIS), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(5);
    let waiting = || {
        let peer = peer(robot, &robot_part, "brain");
        let channels = peer["channels"].as_array().cloned().unwrap_or_default();
        channels.iter().filter(|channel| channel["is_sent"] == true).map(|it| it["n_waiting"].as_u64()).max().flatten()
    };
    for n_kills in 1..4 {
        network.cable(1, false);
        wait_for_state(robot, &robot_part, "brain", "down");
        // More than the writer's history holds.
        wait_until(|| waiting() > Some(600), || format!("{:?} wait", waiting()));
        for _ in 0..n_kills {
            let pid = pid_of(robot, &robot_part, "link");
            signal(pid, rustix::process::Signal::KILL);
            let is_back =
                || node(robot, &robot_part.name, "link")["pid"].as_i64().is_some_and(|it| it != i64::from(pid));
            wait_until(|| is_back() && waiting() > Some(600), || format!("{:?} wait", waiting()));
        }
        network.cable(1, true);
        wait_for_state(robot, &robot_part, "brain", "up");
        robot_part.wait_for_decisions(5);
    }
    let robot_end = stop(robot, robot_part);
    let brain_end = brain_part.finish();
    assert_nothing_unsafe(&robot_end);
    assert_lost_nothing("robot", &robot_end);
    assert_lost_nothing("brain", &brain_end);
}

#[test]
fn a_brain_that_answers_no_samples_is_cut_off_and_the_hands_side_goes_on() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &plain(brain, DEADLINE_MILLIS), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &["--wait-limit", "600"]);
    let fast = ["--set", "recorded_source.rate=max", "--set", "recorded_source.repeat=forever"];
    let robot_part = part(robot, &flow, "robot", &fast);
    robot_part.wait_for_decisions(5);
    // The encoder answers nothing, and nobody restarts it; brain's link lives.
    let pids = [brain_part.pid(), pid_of(brain, &brain_part, "encoder")];
    pids.into_iter().for_each(|pid| signal(pid, rustix::process::Signal::STOP));
    let is_cut_off = || {
        let brain = peer(robot, &robot_part, "brain");
        brain["state"] == "down" && brain["reason"].as_str().is_some_and(|why| why.contains("contacts/contacts"))
    };
    wait_until(is_cut_off, || format!("{}\n{}", peer(robot, &robot_part, "brain"), robot_part.said()));
    // The writer on robot goes on, also when the buffer is full.
    let lost = || peer(robot, &robot_part, "brain")["channels"][0]["n_lost"].as_u64().unwrap_or(0);
    wait_until(|| lost() > 0, || format!("{}\n{}", peer(robot, &robot_part, "brain"), robot_part.said()));
    let n_lost = lost();
    wait_until(|| lost() > n_lost, || robot_part.said());
    assert!(is_cut_off(), "{}", peer(robot, &robot_part, "brain"));

    pids.into_iter().for_each(|pid| signal(pid, rustix::process::Signal::CONT));
    wait_for_state(robot, &robot_part, "brain", "up");
    robot_part.wait_for_decisions(5);
    let robot_end = stop(robot, robot_part);
    brain_part.finish();
    assert_eq!(robot_end.summary["restarts"], 0, "{}\n{}", robot_end.summary, robot_end.stderr);
    assert_eq!(robot_end.code, Some(3), "{}\n{}", robot_end.summary, robot_end.stderr);
    // Each lost sample counts once, although brain's answers to it are missing as well.
    assert_eq!(robot_end.summary["samples_lost"], robot_end.summary["link"]["peers"][0]["channels"][0]["n_lost"]);
    let expected = on_one_machine();
    for line in &robot_end.decisions {
        let grasp_id = line["grasp_id"].as_u64().expect("an id") as usize;
        let undisturbed = &expected[grasp_id % expected.len()];
        assert!(line["action"] == "hold" || undisturbed["action"] == "lift", "{line} {undisturbed}");
    }
}
