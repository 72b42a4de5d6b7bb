//! Which machines can talk to a link, and in which name: real Zenoh sessions over loopback.

use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use blindgrasp_bridge::access;
use blindgrasp_bridge::certificates;
use blindgrasp_bridge::keys::{KeyRequest, list, make};
use blindgrasp_bridge::session::{SessionError, open, warning};
use blindgrasp_graph::link::config::{Endpoints, KeyFiles, KeyKind, LinkConfig, key_files};
use blindgrasp_operator::control_socket::link_path;
use serde_json::{Value, json};
use time::OffsetDateTime;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use crate::common::{json_of, unique_name};

/// Long enough for any machine; nothing waits that long unless it fails.
const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let since = Instant::now();
    while !is_so() {
        assert!(since.elapsed() < PATIENCE, "waited in vain until {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub(crate) fn free_endpoint(scheme: &str) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    format!("{scheme}/{}", listener.local_addr().expect("bound"))
}

fn request(folder: &Path, machines: &[&str]) -> KeyRequest {
    KeyRequest {
        folder: folder.into(),
        machines: machines.iter().map(ToString::to_string).collect(),
        days: 90,
        ..KeyRequest::default()
    }
}

pub(crate) fn keys(machines: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    make(&request(folder.path(), machines), OffsetDateTime::now_utc()).expect("made");
    folder
}

/// One of the machines robot, brain and laptop.
pub(crate) fn config(machine: &str, endpoints: Endpoints, keys: Option<&Path>) -> LinkConfig {
    LinkConfig {
        run: 1,
        graph: "grasp_gate".into(),
        machine: machine.into(),
        peers: ["robot", "brain", "laptop"]
            .iter()
            .filter(|other| **other != machine)
            .map(ToString::to_string)
            .collect(),
        endpoints,
        keys: keys.map(|folder| key_files(folder, machine)),
        deadline_millis: 200,
        buffer: 8,
        ..LinkConfig::default()
    }
}

pub(crate) fn listen(endpoint: &str) -> Endpoints {
    Endpoints { listen: vec![endpoint.into()], ..Endpoints::default() }
}

pub(crate) fn connect(endpoint: &str) -> Endpoints {
    Endpoints { connect: vec![endpoint.into()], ..Endpoints::default() }
}

pub(crate) fn by_router(endpoint: &str) -> Endpoints {
    Endpoints { router: vec![endpoint.into()], ..Endpoints::default() }
}

/// What a session hears under a key: keys and payloads.
#[derive(Clone, Default)]
pub(crate) struct Heard(Arc<Mutex<Vec<(String, String)>>>);

impl Heard {
    pub(crate) fn listen(session: &Session, key: &str) -> Heard {
        let heard = Heard::default();
        let into = heard.clone();
        session
            .declare_subscriber(key.to_string())
            .callback(move |sample| {
                let payload = String::from_utf8_lossy(&sample.payload().to_bytes()).into_owned();
                into.0.lock().expect("not poisoned").push((sample.key_expr().to_string(), payload));
            })
            .background()
            .wait()
            .expect("subscribed");
        heard
    }

    pub(crate) fn has(&self, payload: &str) -> bool {
        self.0.lock().expect("not poisoned").iter().any(|(_, heard)| heard == payload)
    }

    fn keys(&self) -> Vec<String> {
        let mut keys: Vec<String> = self.0.lock().expect("not poisoned").iter().map(|(key, _)| key.clone()).collect();
        keys.sort();
        keys.dedup();
        keys
    }
}

pub(crate) fn put(session: &Session, key: &str, payload: &str) {
    session.put(key, payload).congestion_control(CongestionControl::Block).wait().expect("put");
}

/// Puts until it is heard.
pub(crate) fn says(session: &Session, key: &str, payload: &str, heard: &Heard) {
    wait_until(&format!("'{payload}' is heard under {key}"), || {
        put(session, key, payload);
        heard.has(payload)
    });
}

/// A Zenoh session with a configuration of its own.
pub(crate) fn stranger(endpoint: &str, tls: Value) -> Session {
    stranger_as(None, &Endpoints { connect: vec![endpoint.into()], ..Endpoints::default() }, tls, 1)
}

/// As [`stranger`], with the Zenoh id of another session.
pub(crate) fn stranger_as(id: Option<String>, endpoints: &Endpoints, tls: Value, max_links: u32) -> Session {
    let mut config = json!({
        "mode": "peer",
        "listen": {"endpoints": endpoints.listen},
        "connect": {"endpoints": endpoints.connect, "retry": {"period_init_ms": 20, "period_max_ms": 20}},
        "open": {"return_conditions": {"connect_scouted": false, "declares": false}},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "transport": {
            "link": {"tls": tls},
            "unicast": {"max_links": max_links},
            "shared_memory": {"enabled": false},
        },
    });
    if let Some(id) = id {
        config["id"] = id.into();
    }
    zenoh::open(zenoh::Config::from_json5(&config.to_string()).expect("a configuration")).wait().expect("open")
}

pub(crate) fn tls_of(folder: &Path, machine: &str) -> Value {
    let files = key_files(folder, machine);
    json!({
        "root_ca_certificate": files.authority,
        "enable_mtls": true,
        "connect_certificate": files.certificate,
        "connect_private_key": files.private_key,
        "listen_certificate": files.certificate,
        "listen_private_key": files.private_key,
        "verify_name_on_connect": false,
    })
}

fn key(from: &str, to: &str) -> String {
    config(from, Endpoints::default(), None).key(from, to, KeyKind::Data)
}

#[test]
fn machines_with_keys_connect_in_either_order() {
    let folder = keys(&["robot", "brain"]);
    let endpoint = free_endpoint("tls");
    let robot_config = config("robot", connect(&endpoint), Some(folder.path()));
    let robot = open(&robot_config).expect("brain is not there yet, which is no error");
    let robot_heard = Heard::listen(&robot, &key("*", "robot"));
    let alive = robot_config.key("*", "robot", KeyKind::Alive);
    let tokens = Heard::default();
    let into = tokens.clone();
    robot
        .liveliness()
        .declare_subscriber(alive)
        .history(true)
        .callback(move |sample| {
            into.0.lock().expect("not poisoned").push((sample.key_expr().to_string(), sample.kind().to_string()));
        })
        .background()
        .wait()
        .expect("subscribed");
    let brain_config = config("brain", listen(&endpoint), Some(folder.path()));
    let brain = open(&brain_config).expect("open");
    let brain_heard = Heard::listen(&brain, &key("*", "brain"));
    let token = brain.liveliness().declare_token(brain_config.key("brain", "robot", KeyKind::Alive)).wait();
    says(&robot, &key("robot", "brain"), "up", &brain_heard);
    says(&brain, &key("brain", "robot"), "down", &robot_heard);
    wait_until("brain is alive", || tokens.has("PUT"));
    drop(token.expect("declared"));
    wait_until("brain is not", || tokens.has("DELETE"));
    assert_eq!(warning(&robot_config), None);

    // Brain is started again.
    brain.close().wait().expect("closed");
    drop(brain);
    let brain = open(&brain_config).expect("the port is free again");
    let brain_heard = Heard::listen(&brain, &key("*", "brain"));
    says(&robot, &key("robot", "brain"), "again", &brain_heard);
}

/// Without keys: the folder of the socket is closed to other users.
#[test]
fn machines_on_one_computer_talk_over_a_socket_of_this_user() {
    let name = unique_name();
    let endpoint = format!("unix/{name}");
    let robot = open(&config("robot", connect(&endpoint), None)).expect("brain is not there yet, which is no error");
    let brain = open(&config("brain", listen(&endpoint), None)).expect("open");
    let heard = Heard::listen(&brain, &key("*", "brain"));
    says(&robot, &key("robot", "brain"), "up", &heard);
    let socket = link_path(&name).expect("a folder of this user");
    let folder = std::fs::metadata(socket.parent().expect("a folder")).expect("made");
    assert!(socket.exists() && folder.permissions().mode() & 0o777 == 0o700, "{socket:?}");
}

#[test]
fn strangers_are_not_heard() {
    let folder = keys(&["robot", "brain"]);
    let other = keys(&["robot"]);
    let expired = tempfile::tempdir().expect("a folder");
    for file in ["ca.pem", "ca.key.pem"] {
        std::fs::copy(folder.path().join(file), expired.path().join(file)).expect("copied");
    }
    let long_ago = OffsetDateTime::now_utc() - time::Duration::days(180);
    make(&request(expired.path(), &["robot"]), long_ago).expect("made");

    let endpoint = free_endpoint("tls");
    let brain = open(&config("brain", listen(&endpoint), Some(folder.path()))).expect("open");
    let heard = Heard::listen(&brain, &key("*", "brain"));
    let root = json!({"root_ca_certificate": folder.path().join("ca.pem"), "verify_name_on_connect": false});
    let strangers = [
        ("no certificate", stranger(&endpoint, root)),
        ("another authority's", stranger(&endpoint, tls_of(other.path(), "robot"))),
        ("an expired one", stranger(&endpoint, tls_of(expired.path(), "robot"))),
        ("no TLS", stranger(&endpoint.replace("tls/", "tcp/"), json!({}))),
    ];
    let robot = open(&config("robot", connect(&endpoint), Some(folder.path()))).expect("open");
    // A right one is heard all the while, and its connection was made among theirs.
    for round in 0..50 {
        for (who, stranger) in &strangers {
            put(stranger, &key("robot", "brain"), who);
        }
        says(&robot, &key("robot", "brain"), &format!("right {round}"), &heard);
        std::thread::sleep(Duration::from_millis(20));
    }
    for (who, stranger) in &strangers {
        assert!(!heard.has(who), "{who} was heard");
        assert_eq!(stranger.info().peers_zid().wait().count(), 0, "{who} is connected");
    }
    assert_eq!(heard.keys(), [key("robot", "brain")]);
}

/// A machine that keeps to no rules has a right key all the same: it can speak in its own name only, and hears only
/// what is said to it.
#[test]
fn no_machine_speaks_or_hears_in_another_ones_name() {
    let folder = keys(&["robot", "brain", "laptop"]);
    let endpoint = free_endpoint("tls");
    let brain = open(&config("brain", listen(&endpoint), Some(folder.path()))).expect("open");
    // What brain would have as a robot, in another graph or namespace, must not reach its own ears either.
    let heard = Heard::listen(&brain, &key("*", "brain"));
    let everywhere = Heard::listen(&brain, "**");
    let robot = open(&config("robot", connect(&endpoint), Some(folder.path()))).expect("open");
    let robot_heard = Heard::listen(&robot, &key("*", "robot"));
    let laptop = stranger(&endpoint, tls_of(folder.path(), "laptop"));
    let laptop_heard = Heard::listen(&laptop, "**");
    let laptop_asks = Heard::listen(&laptop, &key("*", "robot"));
    let laptop_own = Heard::listen(&laptop, &key("*", "laptop"));

    says(&laptop, &key("laptop", "brain"), "connected", &heard);
    says(&robot, &key("robot", "brain"), "connected too", &heard);
    let not_its_own = [
        key("robot", "brain"),
        key("brain", "robot"),
        key("laptop", "brain").replace("/_/", "/robot7/"),
        key("laptop", "brain").replace("/grasp_gate/", "/other_graph/"),
        "anything/else".into(),
    ];
    for key in &not_its_own {
        put(&laptop, key, "forged");
    }
    // What was said on the same connection after that has come: the forged ones never will.
    says(&laptop, &key("laptop", "brain"), "done", &heard);
    for heard in [&heard, &everywhere, &robot_heard] {
        assert!(!heard.has("forged"), "heard under {:?}", heard.keys());
    }
    assert_eq!(heard.keys(), [key("laptop", "brain"), key("robot", "brain")]);

    says(&brain, &key("brain", "robot"), "for robot", &robot_heard);
    says(&brain, &key("brain", "laptop"), "for laptop", &laptop_own);
    for heard in [&laptop_heard, &laptop_asks, &laptop_own] {
        let mut keys = heard.keys();
        // Its own words come back to it, without leaving it.
        keys.retain(|key| !not_its_own.contains(key) && !key.contains("/laptop/brain/"));
        assert!(!heard.has("for robot") && !heard.has("connected too"), "laptop heard {keys:?}");
    }
}

/// A Zenoh id is no secret. A stranger with a right key of another machine takes that of brain: as a client of a machine that
/// listens and dials, and as a server of a machine that dials two others.
#[test]
fn no_machine_joins_the_connection_of_another_one() {
    let folder = keys(&["robot", "brain", "laptop"]);
    for max_links in [1, 2] {
        let [robot_endpoint, brain_endpoint, laptop_endpoint] = [(); 3].map(|()| free_endpoint("tls"));
        let brain = open(&config("brain", listen(&brain_endpoint), Some(folder.path()))).expect("open");
        let brain_heard = Heard::listen(&brain, &key("*", "brain"));
        let id = brain.zid().to_string();
        let endpoints = Endpoints {
            listen: vec![robot_endpoint.clone()],
            connect: vec![brain_endpoint, laptop_endpoint.clone()],
            ..Endpoints::default()
        };
        let robot = open(&config("robot", endpoints, Some(folder.path()))).expect("open");
        let robot_heard = Heard::listen(&robot, &key("*", "robot"));
        // The first machine with a Zenoh id keeps the other out: that is all that a stranger can do.
        says(&brain, &key("brain", "robot"), "connected", &robot_heard);
        let server = Endpoints { listen: vec![laptop_endpoint], ..Endpoints::default() };
        let server = stranger_as(Some(id.clone()), &server, tls_of(folder.path(), "laptop"), max_links);
        let client = stranger_as(Some(id), &connect(&robot_endpoint), tls_of(folder.path(), "laptop"), max_links);
        let strangers_heard = [Heard::listen(&client, "**"), Heard::listen(&server, "**")];
        for round in 0..50 {
            put(&client, &key("brain", "robot"), "forged by a client");
            put(&server, &key("brain", "robot"), "forged by a server");
            says(&brain, &key("brain", "robot"), &format!("right {round}"), &robot_heard);
            says(&robot, &key("robot", "brain"), &format!("secret {round}"), &brain_heard);
            std::thread::sleep(Duration::from_millis(20));
        }
        for who in ["client", "server"] {
            assert!(!robot_heard.has(&format!("forged by a {who}")), "max_links {max_links}: the {who} was heard");
        }
        for heard in &strangers_heard {
            assert!((0..50).all(|round| !heard.has(&format!("secret {round}"))), "max_links {max_links}: it has heard");
        }
    }
}

#[test]
fn a_certificate_of_a_namespace_counts_there_alone() {
    let folder = keys(&["brain"]);
    let in_7 = KeyRequest { namespace: Some("robot7".into()), ..request(folder.path(), &["robot"]) };
    let in_8 = KeyRequest { namespace: Some("robot8".into()), ..request(folder.path(), &["robot"]) };
    for request in [&in_7, &in_8] {
        make(request, OffsetDateTime::now_utc()).expect("made");
    }
    let endpoint = free_endpoint("tls");
    let of = |machine: &str, endpoints, keys: &Path| LinkConfig {
        namespace: Some("robot7".into()),
        ..config(machine, endpoints, Some(keys))
    };
    let key = key("robot", "brain").replace("/_/", "/robot7/");
    let brain = open(&of("brain", listen(&endpoint), folder.path())).expect("its certificate counts everywhere");
    let heard = Heard::listen(&brain, &key);
    let wrong = open(&of("robot", connect(&endpoint), &folder.path().join("robot8"))).expect_err("another namespace's");
    assert!(wrong.to_string().contains("'robot@robot8', expected that of 'robot' or 'robot@robot7'"), "{wrong}");
    let other = stranger(&endpoint, tls_of(&folder.path().join("robot8"), "robot"));
    wait_until("robot8's robot is connected", || other.info().peers_zid().wait().count() == 1);
    let robot = open(&of("robot", connect(&endpoint), &folder.path().join("robot7"))).expect("open");
    for round in 0..20 {
        put(&other, &key, "forged");
        says(&robot, &key, &format!("right {round}"), &heard);
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(!heard.has("forged"));
}

fn router(endpoint: &str, folder: &Path, files: &str, access_control: &Value) -> Session {
    let files = key_files(folder, files);
    let config = json!({
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}},
        "adminspace": {"enabled": false},
        "transport": {"link": {"tls": {
            "root_ca_certificate": files.authority,
            "enable_mtls": true,
            "listen_certificate": files.certificate,
            "listen_private_key": files.private_key,
        }}, "shared_memory": {"enabled": false}},
        "access_control": access_control,
    });
    zenoh::open(zenoh::Config::from_json5(&config.to_string()).expect("a configuration")).wait().expect("open")
}

#[test]
fn a_router_passes_on_messages_that_machines_send_in_their_own_name() {
    let folder = keys(&["robot", "brain", "laptop"]);
    make(&KeyRequest { router: true, ..request(folder.path(), &[]) }, OffsetDateTime::now_utc()).expect("made");
    let endpoint = free_endpoint("tls");
    let robot_config = config("robot", by_router(&endpoint), Some(folder.path()));
    let not_yet = open(&robot_config).expect_err("no router yet");
    assert!(not_yet.is_passing(), "{not_yet}");

    let all = list(folder.path()).expect("listed");
    let machines = all.iter().filter(|found| !found.is_authority && !found.common_name.starts_with('@'));
    let access_control = access::for_router(machines);
    let zenohd = router(&endpoint, folder.path(), "zenohd", &access_control);
    let robot = open(&robot_config).expect("open");
    let brain = open(&config("brain", by_router(&endpoint), Some(folder.path()))).expect("open");
    let heard = Heard::listen(&brain, &key("*", "brain"));
    let robot_heard = Heard::listen(&robot, &key("*", "robot"));
    says(&robot, &key("robot", "brain"), "up", &heard);
    says(&brain, &key("brain", "robot"), "down", &robot_heard);

    let laptop = stranger(&endpoint, tls_of(folder.path(), "laptop"));
    let laptop_heard = Heard::listen(&laptop, "blindgrasp/**");
    says(&laptop, &key("laptop", "brain"), "connected", &heard);
    put(&laptop, &key("robot", "brain"), "forged");
    says(&laptop, &key("laptop", "brain"), "done", &heard);
    says(&brain, &key("brain", "robot"), "secret", &robot_heard);
    assert!(!heard.has("forged") && !laptop_heard.has("secret") && !laptop_heard.has("down"));
    zenohd.close().wait().expect("closed");
    drop(zenohd);

    // A machine in the router's place is no router, and neither is what it passes on.
    let zenohd = router(&endpoint, folder.path(), "laptop", &json!({"enabled": false}));
    let false_heard = Heard::listen(&zenohd, "**");
    for machine in [&robot, &brain] {
        let is_there = || machine.info().routers_zid().wait().any(|zid| zid == zenohd.zid());
        wait_until("a machine is connected to it", is_there);
    }
    for _ in 0..20 {
        put(&zenohd, &key("robot", "brain"), "false");
        put(&robot, &key("robot", "brain"), "betrayed");
        std::thread::sleep(Duration::from_millis(10));
    }
    zenohd.close().wait().expect("closed");
    drop(zenohd);
    // The true one again: what went before is overtaken.
    let zenohd = router(&endpoint, folder.path(), "zenohd", &access_control);
    says(&robot, &key("robot", "brain"), "true", &heard);
    assert!(!heard.has("false") && !heard.has("betrayed") && !false_heard.has("betrayed"));
    drop(zenohd);
}

#[test]
fn endpoints_beyond_this_machine_need_tls_or_an_open_word() {
    let folder = keys(&["robot"]);
    let refusal = |config: &LinkConfig| open(config).expect_err("refused").to_string();
    for endpoint in ["tcp/0.0.0.0:1", "tcp/robot.local:7447", "tcp/127.0.0.1:7447", "tcp/[::1]:1"] {
        let mut config = config("robot", connect(endpoint), None);
        let refused = refusal(&config);
        for way_out in ["tls/", "unix/NAME", "insecure: true"] {
            assert!(refused.contains(way_out), "{endpoint}: {refused}");
        }
        assert_eq!(warning(&config), None);
        config.insecure = true;
        assert!(warning(&config).is_some_and(|warning| warning.contains("without TLS") && warning.contains(endpoint)));
        config.keys = Some(key_files(folder.path(), "robot"));
        assert_eq!(warning(&config), None, "links with keys protect what they send");
    }
    for endpoint in [
        "udp/127.0.0.1:1",
        "127.0.0.1:1",
        "tcp/127.0.0.1",
        "tcp/:1",
        "tcp/fd00::1:7447",
        "tls/127.0.0.1:1#enable_mtls=false",
        "tcp/127.0.0.1:99999",
        "unix//tmp/gate",
    ] {
        let refused = refusal(&config("robot", connect(endpoint), Some(folder.path())));
        assert!(refused.contains("expected tls/HOST:PORT, tcp/HOST:PORT or unix/NAME"), "{endpoint}: {refused}");
    }
    let without_keys = refusal(&config("robot", connect("tls/127.0.0.1:1"), None));
    assert!(without_keys.contains("blindgrasp keys"), "{without_keys}");
    let mixed = Endpoints { connect: vec!["tls/127.0.0.1:1".into(), "tcp/127.0.0.1:2".into()], ..Endpoints::default() };
    let mixed = refusal(&LinkConfig { insecure: true, ..config("robot", mixed, Some(folder.path())) });
    assert!(mixed.contains("'tcp/127.0.0.1:2'") && mixed.contains("make this one tls/"), "{mixed}");
    assert!(matches!(open(&config("robot", Endpoints::default(), None)), Err(SessionError::NoEndpoint(_))));
}

#[test]
fn an_occupied_port_and_a_foreign_address_are_named_in_the_error() {
    let folder = keys(&["brain"]);
    let name = format!("unix/{}", unique_name());
    for (taken, keys, help) in
        [(free_endpoint("tls"), Some(folder.path()), "another port"), (name, None, "another name")]
    {
        let first = open(&config("brain", listen(&taken), keys)).expect("open");
        let refused = open(&config("brain", listen(&taken), keys)).expect_err("taken");
        assert!(matches!(refused, SessionError::Listen { .. }), "{refused}");
        assert!(refused.to_string().contains(help) && refused.to_string().contains(&taken), "{refused}");
        drop(first);
    }
    // TEST-NET-1 (RFC 5737): no machine has it.
    let refused = open(&config("brain", listen("tls/192.0.2.1:7447"), Some(folder.path()))).expect_err("not ours");
    assert!(refused.to_string().contains("does not have this address"), "{refused}");
}

#[test]
fn keys_that_do_not_fit_are_refused_before_the_start() {
    let folder = keys(&["robot", "brain"]);
    let other = keys(&["robot"]);
    let now = OffsetDateTime::now_utc();
    let check =
        |files: &KeyFiles, now| certificates::check(files, "robot", None, now).map_err(|error| error.to_string());
    let files = key_files(folder.path(), "robot");
    assert_eq!(check(&files, now).map(|found| found.common_name), Ok("robot".into()));
    let another = key_files(other.path(), "robot");
    let brain = key_files(folder.path(), "brain");
    let cases = [
        (KeyFiles { authority: another.authority, ..files.clone() }, "was signed by"),
        (KeyFiles { private_key: brain.private_key.clone(), ..files.clone() }, "not for the private key"),
        (brain, "certificate of 'brain', expected that of 'robot'"),
        (key_files(folder.path(), "nobody"), "`blindgrasp keys`"),
    ];
    for (wrong, says) in cases {
        let found = check(&wrong, now).expect_err("refused");
        assert!(found.contains(says) && found.contains(".pem"), "{found}");
    }
    let late = check(&files, now + time::Duration::days(91)).expect_err("ended");
    assert!(late.contains("ended on") && late.contains("--renew"), "{late}");
    let early = check(&files, now - time::Duration::days(2)).expect_err("not yet");
    assert!(early.contains("set the clock"), "{early}");
    std::fs::write(&files.certificate, "nonsense").expect("written");
    assert!(check(&files, now).expect_err("refused").contains("BEGIN CERTIFICATE"));
}

#[test]
fn a_private_key_that_others_may_read_is_refused() {
    let folder = keys(&["robot"]);
    let config = config("robot", connect("tls/127.0.0.1:1"), Some(folder.path()));
    let private_key = config.keys.clone().expect("keys").private_key;
    for mode in [0o640, 0o604, 0o660] {
        std::fs::set_permissions(&private_key, std::fs::Permissions::from_mode(mode)).expect("changed");
        let refused = open(&config).expect_err("refused").to_string();
        assert!(refused.contains(&format!("chmod 600 {}", private_key.display())), "{refused}");
    }
    std::fs::set_permissions(&private_key, std::fs::Permissions::from_mode(0o400)).expect("changed");
    open(&config).expect("its own");
}

#[test]
fn one_certificate_does_not_get_any_number_of_connections() {
    let folder = keys(&["brain", "laptop"]);
    let endpoint = free_endpoint("tls");
    let brain = open(&config("brain", listen(&endpoint), Some(folder.path()))).expect("open");
    let many: Vec<Session> = (0..20).map(|_| stranger(&endpoint, tls_of(folder.path(), "laptop"))).collect();
    // Two other machines in the file, and eight more.
    wait_until("all places are taken", || brain.info().peers_zid().wait().count() == 10);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(brain.info().peers_zid().wait().count(), 10);
    drop(many);
}

#[test]
fn the_command_makes_shows_renews_and_rotates_keys() {
    let parent = tempfile::tempdir().expect("a folder");
    let folder = parent.path().join("keys");
    let path = folder.to_str().expect("UTF-8");
    let mode = |file: &str| std::fs::metadata(folder.join(file)).expect("there").permissions().mode() & 0o777;
    let read = |file: &str| std::fs::read_to_string(folder.join(file)).expect("there");
    let shown = || {
        let shown = json_of(&["keys", path, "--show", "--json"]);
        shown["certificates"].as_array().expect("a list").clone()
    };

    let told =
        crate::common::text(&crate::common::run(&["keys", path, "--machine", "robot", "--machine", "brain"], 0).stdout);
    assert!(told.lines().any(|line| line.contains("copy") && line.contains("robot.key.pem")), "{told}");
    assert!(!told.lines().any(|line| line.contains("copy to") && line.contains("ca.key.pem")), "{told}");
    assert_eq!((mode("robot.key.pem"), mode("ca.key.pem"), mode("ca.pem"), mode("")), (0o600, 0o600, 0o644, 0o700));
    let names: Vec<Value> = shown().iter().map(|found| found["common_name"].clone()).collect();
    assert_eq!(names[1..], [json!("brain"), json!("robot")]);

    // No file is overwritten, and no half of a set is made.
    let before = read("robot.pem");
    let refused = crate::common::run(&["keys", path, "--machine", "laptop", "--machine", "robot"], 1);
    assert!(crate::common::text(&refused.stderr).contains("--renew"), "{}", crate::common::text(&refused.stderr));
    assert!(!folder.join("laptop.pem").exists() && read("robot.pem") == before);
    let authority = read("ca.pem");
    crate::common::run(&["keys", path, "--machine", "robot", "--renew", "--days", "10"], 0);
    assert!(read("robot.pem") != before && read("ca.pem") == authority);
    for wrong in ["ca", "zenohd", "a/b", "a.b", ""] {
        crate::common::run(&["keys", path, "--machine", wrong], 1);
    }
    crate::common::run(&["keys", path], 1);

    // Rotation: the old authority's machines are trusted until it is dropped.
    crate::common::run(&["keys", path, "--machine", "robot", "--namespace", "robot7"], 0);
    crate::common::run(&["keys", path, "--renew-ca"], 0);
    let now = OffsetDateTime::now_utc();
    let check = |machine| certificates::check(&key_files(&folder, machine), machine, None, now).map(drop);
    crate::common::run(&["keys", path, "--machine", "robot", "--renew"], 0);
    assert!(check("robot").is_ok() && check("brain").is_ok());
    assert_eq!(read("ca.pem"), read("robot7/ca.pem"));
    crate::common::run(&["keys", path, "--drop-old-ca"], 0);
    assert!(check("robot").is_ok() && check("brain").is_err());
    assert_eq!(read("ca.pem"), read("robot7/ca.pem"));

    let told = crate::common::text(&crate::common::run(&["keys", path, "--revoke", "robot"], 0).stdout);
    assert!(told.contains("is revoked") && told.contains("copy") && told.contains("crl.pem"), "{told}");
    assert_eq!(read("crl.pem"), read("robot7/crl.pem"));
    crate::common::run(&["keys", path, "--revoke", "nobody"], 1);
    let told = crate::common::text(&crate::common::run(&["keys", path, "--machine", "robot", "--renew"], 0).stdout);
    assert!(told.lines().any(|line| line.contains("copy to") && line.contains("crl.pem")), "{told}");
    assert!(shown().len() > 2, "the list of revoked certificates is no certificate");

    crate::common::run(&["keys", path, "--router"], 0);
    let router: Value = serde_json::from_str(&read("zenohd.json5")).expect("JSON");
    assert_eq!(router["access_control"]["default_permission"], "deny");
    assert!(zenoh::Config::from_json5(&read("zenohd.json5")).is_ok());
}
