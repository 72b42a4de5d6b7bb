//! A graph on two machines, and a third machine that attacks it: network namespaces, real processes.

use std::path::Path;

use crate::common::{Graph, signal, unique_name, wait_until};
use crate::hosts::{Host, Network};
use crate::split::{
    Attacker, FOREVER, assert_lost_nothing, assert_nothing_unsafe, decided, keys, on_one_machine, part, patient, peer,
    pid_of, rejected, split, stop, wait_for_state, with_tls,
};
use blindgrasp_bridge::wire::PROTOCOL;
use blindgrasp_graph::link::config::key_files;
use rustix::process::Signal;
use serde_json::{Value, json};

const PREFIX: &str = "blindgrasp/_/grasp_gate";

/// Machines that listen on their bridge, without TLS.
fn open_to_all(brain: &Host) -> String {
    format!(
        "machines:\n  robot: {{}}\n  brain: {{listen: tcp/{}:7447}}\nlink: {{insecure: true, deadline_ms: 20000}}\n",
        brain.address
    )
}

/// A Zenoh configuration of the attacker's own.
fn session(mode: &str, endpoint: &str, tls: &Value) -> String {
    json!({
        "mode": mode,
        "connect": {
            "endpoints": {mode: [endpoint]}, "timeout_ms": -1, "exit_on_failure": false,
            "retry": {"period_init_ms": 50, "period_max_ms": 50},
        },
        "listen": {"endpoints": []},
        "open": {"return_conditions": {"connect_scouted": false, "declares": false}},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "transport": {"link": {"tls": tls}, "shared_memory": {"enabled": false}},
    })
    .to_string()
}

fn tls_of(folder: &Path, machine: &str) -> Value {
    let files = key_files(folder, machine);
    json!({
        "root_ca_certificate": files.authority,
        "enable_mtls": true,
        "connect_certificate": files.certificate,
        "connect_private_key": files.private_key,
        "verify_name_on_connect": false,
    })
}

fn resident_kib(pid: i32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("a process");
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).expect("a peak");
    line.split_whitespace().nth(1).and_then(|kib| kib.parse().ok()).expect("a number")
}

#[test]
fn a_graph_under_tls_decides_bit_for_bit_as_on_one_machine() {
    let Some(network) = Network::new(&[0, 5000]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let flow = split(folder.path(), &with_tls(brain, &keys), &[]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &[]);
    wait_for_state(robot, &robot_part, "brain", "up");
    wait_for_state(brain, &brain_part, "robot", "up");
    let (robot_end, brain_end) = (robot_part.finish(), brain_part.finish());
    assert_lost_nothing("robot", &robot_end);
    assert_lost_nothing("brain", &brain_end);
    assert!(!robot_end.stderr.contains("insecure"), "{}", robot_end.stderr);
    assert_eq!(decided(robot_end.decisions), on_one_machine());
}

#[test]
fn clients_without_the_right_certificate_disturb_nothing_under_tls() {
    let Some(network) = Network::new(&[0, 0, 0]) else { return };
    let [robot, brain, attacker] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let other_folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    crate::common::run(&["keys", keys.to_str().expect("UTF-8"), "--machine", "robot", "--namespace", "other"], 0);
    let other_keys = crate::split::keys(other_folder.path(), &["--machine", "robot"]);
    let flow = split(folder.path(), &with_tls(brain, &keys), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(3);

    let address = format!("{}:7447", brain.address);
    let endpoint = format!("tls/{address}");
    let no_certificate = json!({"root_ca_certificate": keys.join("ca.pem"), "verify_name_on_connect": false});
    let attack = |arguments: &[&str]| Attacker::start(attacker, folder.path(), arguments);
    // It trusts brain, which does not trust it.
    let mut another_authority = tls_of(&other_keys, "robot");
    another_authority["root_ca_certificate"] = json!(keys.join("ca.pem"));
    let sessions = [
        ("no certificate", session("peer", &endpoint, &no_certificate), Some(0)),
        ("another authority's", session("peer", &endpoint, &another_authority), Some(0)),
        // It gets a connection, but no rights.
        ("another namespace's", session("client", &endpoint, &tls_of(&keys.join("other"), "robot")), None),
    ];
    let kinds = "foreign,malformed,version,refusal,replay";
    let attackers: Vec<_> =
        sessions.iter().map(|(_, config, _)| attack(&["zenoh", config, PREFIX, kinds, "1000", "2"])).collect();
    for ((who, _, connected), attacker) in sessions.iter().zip(attackers) {
        let told = attacker.told();
        assert!(told["put"].as_u64() > Some(100) && told["heard"] == 0, "{who}: {told}");
        assert!(connected.is_none_or(|connected| told["connected"] == connected), "{who}: {told}");
    }
    robot_part.wait_for_decisions(3);
    wait_until(|| brain_part.said().contains("UnknownIssuer"), || brain_part.said());
    wait_until(|| brain_part.said().contains("peer sent no certificates"), || brain_part.said());

    // The links heard none of them, so that they rejected nothing.
    for (host, part) in [(robot, &robot_part), (brain, &brain_part)] {
        for why in ["foreign", "malformed", "version", "replayed"] {
            assert_eq!(rejected(host, part, why), 0, "{why}");
        }
    }

    // A robot that has to connect again succeeds while half-open connections wait.
    let half_open = attack(&["half-open", &address, "200", "5"]);
    robot_part.wait_for_decisions(1);
    signal(pid_of(robot, &robot_part, "link"), Signal::KILL);
    robot_part.wait_for_decisions(5);
    wait_for_state(brain, &brain_part, "robot", "up");
    assert!(half_open.told()["connections"].as_u64() >= Some(200));
    // After these, it would have to wait until all that they began has failed: a tenth of a second each.
    let n_times_up = peer(brain, &brain_part, "robot")["n_times_up"].clone();
    let attackers = [attack(&["garbage", &address, "2"]), attack(&["flood", &address, "2"])];
    robot_part.wait_for_decisions(3);
    for attacker in attackers {
        let told = attacker.told();
        assert!(told["connections"].as_u64() > Some(0), "{told}");
    }
    robot_part.wait_for_decisions(3);
    assert_eq!(peer(brain, &brain_part, "robot")["n_times_up"], n_times_up);
    let robot_end = stop(robot, robot_part);
    robot_end.assert_undisturbed("robot");
    assert_lost_nothing("brain", &brain_part.finish());
}

#[test]
fn bad_frames_in_an_open_graph_are_counted_and_disturb_nothing() {
    let Some(network) = Network::new(&[0, 0, 0]) else { return };
    let [robot, brain, attacker] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &open_to_all(brain), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(3);
    assert!(brain_part.said().contains("insecure"), "{}", brain_part.said());
    let parts = [(robot, &robot_part), (brain, &brain_part)];
    let before_kib = parts.map(|(host, part)| resident_kib(pid_of(host, part, "link")));

    // As a client of brain's, it is passed on to robot, and hears what both say.
    let config = session("client", &format!("tcp/{}:7447", brain.address), &json!({}));
    let attack = |kinds: &str, pause_micros: &str, secs: &str| {
        Attacker::start(attacker, folder.path(), &["zenoh", &config, PREFIX, kinds, pause_micros, secs]).told()
    };
    let told = attack("foreign,malformed,oversized,replay", "1000", "2");
    assert!(told["put"].as_u64() > Some(100) && told["heard"].as_u64() > Some(100), "{told}");
    // Brain may drop what is too long rather than pass it on.
    let whys = [&["foreign", "malformed", "replayed"][..], &["foreign", "malformed", "replayed", "oversized"]];
    for ((host, part), whys) in parts.into_iter().zip(whys) {
        wait_until(
            || whys.iter().all(|why| rejected(host, part, why) > 0),
            || format!("{}", crate::split::status(host, &part.name)["link"]),
        );
    }
    robot_part.wait_for_decisions(3);
    // As fast as it can.
    let told = attack("foreign,malformed,oversized", "0", "2");
    assert!(told["put"].as_u64() > Some(100), "{told}");
    robot_part.wait_for_decisions(3);
    for ((host, part), before_kib) in parts.into_iter().zip(before_kib) {
        let after_kib = resident_kib(pid_of(host, part, "link"));
        assert!(after_kib < before_kib + (200 << 10), "{} KiB, {before_kib} before", after_kib);
    }
    let robot_end = stop(robot, robot_part);
    robot_end.assert_undisturbed("robot");
    assert_eq!(robot_end.summary["restarts"], 0, "{}", robot_end.stderr);
    let brain_end = brain_part.finish();
    assert_lost_nothing("brain", &brain_end);
    assert_eq!(brain_end.summary["restarts"], 0, "{}", brain_end.stderr);
}

#[test]
fn another_version_is_refused_on_both_sides_and_the_right_one_accepted_later() {
    let Some(network) = Network::new(&[0, 0, 0]) else { return };
    let [robot, brain, attacker] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let flow = split(folder.path(), &open_to_all(brain), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    wait_until(|| brain_part.said().contains("waiting for machine"), || brain_part.said());
    let config = session("peer", &format!("tcp/{}:7447", brain.address), &json!({}));
    let attack = |kinds| {
        let arguments = ["zenoh", &config, PREFIX, kinds, "20000", "3"];
        Attacker::start(attacker, folder.path(), &arguments)
    };
    let protocol = |version: u8| format!("link protocol {version}");
    let newer = attack("version");
    wait_for_state(brain, &brain_part, "robot", "refused");
    let reason = peer(brain, &brain_part, "robot")["reason"].to_string();
    assert!(reason.contains(&protocol(PROTOCOL + 1)) && reason.contains("install the same version"), "{reason}");
    let told = newer.told();
    let refusal = told["refusals"][0].as_str().unwrap_or_default();
    assert!(refusal.contains(&protocol(PROTOCOL)) && refusal.contains("install the same version"), "{told}");
    assert!(brain_part.said().contains(&protocol(PROTOCOL + 1)), "{}", brain_part.said());
    assert!(rejected(brain, &brain_part, "version") > 0);

    // A peer that is so new that it refuses by itself.
    let newest = attack("refusal");
    wait_until(
        || peer(brain, &brain_part, "robot")["reason"].to_string().contains("not even made"),
        || peer(brain, &brain_part, "robot").to_string(),
    );
    newest.told();

    let robot_part = part(robot, &flow, "robot", &FOREVER);
    wait_for_state(brain, &brain_part, "robot", "up");
    robot_part.wait_for_decisions(5);
    assert_eq!(peer(brain, &brain_part, "robot")["reason"], Value::Null);
    let robot_end = stop(robot, robot_part);
    robot_end.assert_undisturbed("robot");
    assert_lost_nothing("brain", &brain_part.finish());
}

#[test]
fn a_link_under_tls_stays_up() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let flow = split(folder.path(), &with_tls(brain, &keys), &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part =
        part(robot, &flow, "robot", &["--set", "recorded_source.rate=16", "--set", "recorded_source.repeat=forever"]);
    // As many samples as cross it in twenty seconds at the other tests' rate, and several leases of the connection.
    robot_part.wait_for_decisions(360);
    for (host, part, other) in [(robot, &robot_part, "brain"), (brain, &brain_part, "robot")] {
        assert_eq!(peer(host, part, other)["n_times_up"], 1, "{}", part.said());
    }
    stop(robot, robot_part).assert_undisturbed("robot");
    assert_lost_nothing("brain", &brain_part.finish());
}

/// The launcher starts a link alone again, which makes Zenoh use the new keys. Revocation needs no start at all.
#[test]
fn keys_are_renewed_and_revoked_while_the_graph_runs() {
    let Some(network) = Network::new(&[0, 0]) else { return };
    let [robot, brain] = &network.hosts[..] else { panic!("two hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let of_keys = |arguments: &[&str]| {
        crate::common::run(&[&["keys", keys.to_str().expect("UTF-8")], arguments].concat(), 0);
    };
    let machines = with_tls(brain, &keys).replace("20000", "1000");
    let flow = split(folder.path(), &machines, &[patient()]);
    let brain_part = part(brain, &flow, "brain", &[]);
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    robot_part.wait_for_decisions(3);

    of_keys(&["--machine", "robot", "--machine", "brain", "--renew"]);
    for (host, part, other) in [(robot, &robot_part, "brain"), (brain, &brain_part, "robot")] {
        signal(pid_of(host, part, "link"), Signal::KILL);
        wait_for_state(host, part, other, "up");
        robot_part.wait_for_decisions(3);
    }
    for (host, part) in [(robot, &robot_part), (brain, &brain_part)] {
        assert_eq!(rejected(host, part, "forged"), 0, "{}", part.said());
    }

    of_keys(&["--revoke", "robot"]);
    wait_for_state(brain, &brain_part, "robot", "down");
    // A refusal is not signed: it is the reason that is shown, and changes no state.
    wait_for_state(robot, &robot_part, "brain", "down");
    wait_until(
        || peer(robot, &robot_part, "brain")["reason"].to_string().contains("was revoked"),
        || robot_part.said(),
    );
    assert!(rejected(brain, &brain_part, "forged") > 0);
    for part in [&robot_part, &brain_part] {
        wait_until(|| part.said().contains("was revoked"), || part.said());
    }
    of_keys(&["--machine", "robot", "--renew"]);
    wait_for_state(brain, &brain_part, "robot", "up");
    wait_for_state(robot, &robot_part, "brain", "up");
    robot_part.wait_for_decisions(3);
    stop(robot, robot_part);
    brain_part.finish();
}

/// Connections without a certificate that take all descriptors of a link keep no machine out for longer than they last and the
/// link needs to notice it.
#[test]
fn a_flood_of_connections_does_not_keep_machines_out_for_good() {
    const N_DESCRIPTORS: u32 = 400;
    let Some(network) = Network::new(&[0, 0, 0]) else { return };
    let [robot, brain, attacker] = &network.hosts[..] else { panic!("three hosts") };
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(folder.path(), &["--machine", "robot", "--machine", "brain"]);
    let flow = split(folder.path(), &with_tls(brain, &keys), &[patient()]);
    let limited = brain.blindgrasp_with_descriptors(N_DESCRIPTORS);
    let brain_part = Graph::launch_on(limited, &unique_name(), &flow, &["--machine", "brain"]);
    wait_until(|| brain_part.said().contains("waiting for machine robot"), || brain_part.said());
    let n_open = || {
        let folder = format!("/proc/{}/fd", pid_of(brain, &brain_part, "link"));
        std::fs::read_dir(folder).map_or(0, |entries| entries.count())
    };
    let address = format!("{}:7447", brain.address);
    let flood = Attacker::start(attacker, folder.path(), &["half-open", &address, "1000", "3"]);
    wait_until(|| n_open() + 5 >= N_DESCRIPTORS as usize, || format!("{} descriptors", n_open()));
    flood.told();
    let robot_part = part(robot, &flow, "robot", &FOREVER);
    wait_for_state(brain, &brain_part, "robot", "up");
    robot_part.wait_for_decisions(5);
    let robot_end = stop(robot, robot_part);
    brain_part.finish();
    assert_nothing_unsafe(&robot_end);
}
