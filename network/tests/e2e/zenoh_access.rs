//! Who takes part in the sessions of `tactile_source` and `zenoh`: real Zenoh sessions over loopback.

use std::path::Path;
use std::process::{Command, Stdio};

use blindgrasp_bridge::keys::revoke;
use blindgrasp_bridge::outside::{Rights, open};
use blindgrasp_graph::link::config::key_files;
use blindgrasp_graph::link::network::Network;
use serde_json::{Value, json};
use time::OffsetDateTime;
use zenoh::{Session, Wait};

use crate::common::live::live_dataflow;
use crate::common::{Graph, example, program, project, run, text, unique_name};
use crate::link_security::{Heard, free_endpoint, keys, put, says, stranger, tls_of, wait_until};

const FRAMES: &str = "hand/frames";
const DECISIONS: &str = "robot/hand/decision";

fn network(listen: &str, connect: &str, folder: Option<&Path>) -> Network {
    let keys = folder.map(|folder| key_files(folder, "zenoh"));
    let names = if keys.is_some() { vec!["zenoh".into(), "arm".into()] } else { vec![] };
    let some = |endpoint: &str| if endpoint.is_empty() { vec![] } else { vec![endpoint.to_owned()] };
    Network { connect: some(connect), listen: some(listen), keys, names }
}

/// As `tactile_source` opens one.
fn source() -> Rights {
    Rights { takes: vec![FRAMES.into()], ..Rights::default() }
}

/// As the operator `zenoh` opens one.
fn output() -> Rights {
    Rights { sends: vec!["robot/hand/**".into()], ..Rights::default() }
}

/// A client: a session to which it connects passes its messages on to other clients, if that may be.
fn client(endpoint: &str, tls: &Value) -> Session {
    let config = json!({
        "mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": false}},
        "transport": {"link": {"tls": tls}},
    });
    let config = zenoh::Config::from_json5(&config.to_string()).expect("a configuration");
    zenoh::open(config).wait().expect("open")
}

/// A session that others can connect to, without access control.
fn listening(endpoint: &str, tls: &Value) -> Session {
    let config = json!({
        "mode": "peer", "listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": false}},
        "transport": {"link": {"tls": tls}},
    });
    let config = zenoh::Config::from_json5(&config.to_string()).expect("a configuration");
    zenoh::open(config).wait().expect("open")
}

fn is_connected(session: &Session) -> bool {
    let info = session.info();
    info.peers_zid().wait().chain(info.routers_zid().wait()).count() > 0
}

/// The machines of the tests: `arm` may take part, `laptop` may not, and the certificate of `lost` is revoked.
fn folder_of_keys() -> tempfile::TempDir {
    let folder = keys(&["zenoh", "arm", "laptop", "lost"]);
    revoke(folder.path(), "lost", None, OffsetDateTime::now_utc()).expect("revoked");
    folder
}

#[test]
fn a_source_takes_frames_of_the_names_that_may_send_and_on_its_key_alone() {
    let (folder, other) = (folder_of_keys(), keys(&["arm"]));
    let endpoint = free_endpoint("tls");
    let source = open(&network(&endpoint, "", Some(folder.path())), &source()).expect("a session");
    let (heard, everywhere) = (Heard::listen(&source, FRAMES), Heard::listen(&source, "**"));
    let arm = stranger(&endpoint, tls_of(folder.path(), "arm"));
    let arm_hears = Heard::listen(&arm, "**");
    let others = ["laptop", "lost"].map(|name| (name, stranger(&endpoint, tls_of(folder.path(), name))));
    let of_another_authority = stranger(&endpoint, tls_of(other.path(), "arm"));
    for (name, session) in &others {
        wait_until(&format!("{name} is connected"), || is_connected(session));
    }
    for round in 0..20 {
        for (name, session) in &others {
            put(session, FRAMES, name);
        }
        put(&of_another_authority, FRAMES, "another authority");
        put(&arm, DECISIONS, "another key");
        says(&arm, FRAMES, &format!("right {round}"), &heard);
    }
    for bad in ["laptop", "lost", "another authority", "another key"] {
        assert!(!heard.has(bad) && !everywhere.has(bad), "{bad} was heard");
    }
    assert!(!is_connected(&of_another_authority));
    // It passes nothing on from one program to another.
    assert!(!arm_hears.has("laptop") && !arm_hears.has("lost"));
}

/// With keys and without: a program that may read decisions must not be able to send some to others.
#[test]
fn an_output_passes_no_decisions_of_others_on() {
    let folder = folder_of_keys();
    for scheme in ["tls", "tcp"] {
        let has_keys = scheme == "tls";
        let of = |name: &str| if has_keys { tls_of(folder.path(), name) } else { json!({}) };
        // A session without access control does.
        let endpoint = free_endpoint(scheme);
        let _open_to_all = listening(&endpoint, &of("zenoh"));
        let [arm, laptop] = ["arm", "laptop"].map(|name| client(&endpoint, &of(name)));
        says(&laptop, DECISIONS, "forged", &Heard::listen(&arm, DECISIONS));

        let endpoint = free_endpoint(scheme);
        let output = open(&network(&endpoint, "", has_keys.then(|| folder.path())), &output()).expect("a session");
        let own = Heard::listen(&output, "**");
        let arm = client(&endpoint, &of("arm"));
        let arm_hears = Heard::listen(&arm, "**");
        let forgers = ["laptop", "lost", "zenoh"].map(|name| (name, client(&endpoint, &of(name))));
        let forgers_hear: Vec<Heard> = forgers.iter().map(|(_, session)| Heard::listen(session, DECISIONS)).collect();
        for (name, session) in &forgers {
            wait_until(&format!("{name} is connected"), || is_connected(session));
        }
        for round in 0..20 {
            forgers.iter().for_each(|(name, session)| put(session, DECISIONS, name));
            says(&output, DECISIONS, &format!("decision {round}"), &arm_hears);
        }
        for (name, _) in &forgers {
            assert!(!arm_hears.has(name) && !own.has(name), "{scheme}: the arm heard {name}");
        }
        let reads = |idx: usize| (0..20).any(|round| forgers_hear[idx].has(&format!("decision {round}")));
        assert!(!has_keys || !(reads(0) || reads(1)), "a name that does not take part reads decisions");
        put(&output, "elsewhere", "another key");
        says(&output, DECISIONS, "the last", &arm_hears);
        assert!(!arm_hears.has("another key"));
    }
}

/// Where the node connects, a machine of the same authority in the router's place gets nothing.
#[test]
fn what_a_node_connects_to_must_bear_a_name_that_takes_part() {
    let folder = folder_of_keys();
    for (name, takes_part) in [("laptop", false), ("arm", true)] {
        let endpoint = free_endpoint("tls");
        let router = listening(&endpoint, &tls_of(folder.path(), name));
        let router_hears = Heard::listen(&router, "**");
        let connects = network("", &endpoint, Some(folder.path()));
        let (source, output) =
            (open(&connects, &source()).expect("a session"), open(&connects, &output()).expect("a session"));
        let heard = Heard::listen(&source, FRAMES);
        wait_until("both are connected", || is_connected(&source) && is_connected(&output));
        if takes_part {
            says(&router, FRAMES, "frame", &heard);
            says(&output, DECISIONS, "decision", &router_hears);
            continue;
        }
        // In the time in which the right one is heard again and again.
        let right = free_endpoint("tls");
        let other = open(&network(&right, "", Some(folder.path())), &self::source()).expect("a session");
        let other_heard = Heard::listen(&other, FRAMES);
        let arm = stranger(&right, tls_of(folder.path(), "arm"));
        for round in 0..20 {
            put(&router, FRAMES, "frame");
            put(&output, DECISIONS, "decision");
            says(&arm, FRAMES, &format!("right {round}"), &other_heard);
        }
        assert!(!heard.has("frame") && !router_hears.has("decision"));
    }
}

/// Connections without a certificate that take all descriptors of a source keep its bridge out for no longer than they last and
/// the source needs to notice it. Its sandbox denies it to read /proc.
#[test]
fn a_flood_of_connections_does_not_keep_the_hands_bridge_out_for_good() {
    const N_DESCRIPTORS: usize = 400;
    let (folder, keys, endpoint) = (tempfile::tempdir().expect("a folder"), folder_of_keys(), free_endpoint("tls"));
    let params = format!(
        "driver: zenoh\n      key: {FRAMES}\n      listen: {endpoint}\n      keys: {}\n      from: arm\n    sandbox: on",
        keys.path().display()
    );
    let flow = live_dataflow(folder.path(), &params);
    let mut limited = Command::new("prlimit");
    limited.args([&format!("--nofile={N_DESCRIPTORS}:{N_DESCRIPTORS}"), program()]);
    limited.current_dir(project()).env("XDG_STATE_HOME", folder.path()).stdin(Stdio::null());
    let graph = Graph::launch_on(limited, &unique_name(), &flow, &[]);
    wait_until("the source listens", || graph.said().contains("receives key"));
    let descriptors = format!("/proc/{}/fd", graph.pid_of("tactile_source"));
    let n_open = || std::fs::read_dir(&descriptors).map_or(0, |entries| entries.count());
    let address = endpoint.trim_start_matches("tls/");
    let mut flood = Command::new(example("link_attacker"));
    let flood = flood.args(["half-open", address, "1000", "3"]).stdout(Stdio::null());
    let mut flood = flood.spawn().expect("started");
    wait_until("no descriptor is left", || n_open() + 5 >= N_DESCRIPTORS);
    flood.wait().expect("ended");
    let arm = stranger(&endpoint, tls_of(keys.path(), "arm"));
    wait_until("the source hears the arm", || {
        put(&arm, FRAMES, "no JSON");
        graph.node("tactile_source")["counts"]["malformed"].as_u64() > Some(0)
    });
    graph.stop();
}

/// Keys that no endpoint uses are no protection: the file is refused before anything starts.
#[test]
fn keys_that_protect_nothing_are_refused_by_a_check() {
    let folder = tempfile::tempdir().expect("a folder");
    let keys = keys(&["zenoh"]);
    let keys = keys.path().display();
    for (source, expected) in [
        (
            format!("driver: zenoh\n      keys: {keys}\n      key: a\n      listen: tcp/127.0.0.1:1"),
            "keys without an endpoint",
        ),
        (format!("driver: listen\n      keys: {keys}"), "its keys protect nothing"),
        ("driver: zenoh\n      key: a\n      from: arm".to_owned(), "'from' without keys"),
    ] {
        let flow = live_dataflow(folder.path(), &source);
        let output = run(&["run", "--check", flow.to_str().expect("UTF-8")], 1);
        let said = text(&output.stderr);
        assert!(said.contains(expected), "{expected}: {said}");
    }
}
