//! Commands for a graph's part on another machine: two links in this process, over Zenoh on the loopback interface.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr as InetAddress, TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use crate::common::{
    FAST_FOREVER, Graph, blindgrasp, dataflow, json_lines, own_operator, run, text, unique_name, wait_until,
};
use blindgrasp_bridge::config::{Endpoints, KeyKind, LinkConfig, PeerConfig};
use blindgrasp_bridge::tunnel::Tunnels;
use blindgrasp_graph::client::{ClientError, Connection, part_name, pick_graph};
use blindgrasp_graph::control::{Reply, Request, SwapRequest};
use blindgrasp_graph::operators::Operators;
use blindgrasp_learning::of_graph::of_graph;
use blindgrasp_operator::control_socket::{ControlSocket, path_of};
use blindgrasp_recording::{Record, RecordingReader};
use serde_json::{Value, json};
use zenoh::Wait;

const NEVER: &dyn Fn() -> bool = &|| false;
/// A test gives up after this time, so that a failing test ends.
const LIMIT: Duration = Duration::from_secs(60);

fn session(listen: Option<u16>, connect: Option<u16>) -> zenoh::Session {
    let endpoints = |port: Option<u16>| json!(port.map(|port| format!("tcp/127.0.0.1:{port}")).as_slice()).to_string();
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_string()),
        ("listen/endpoints", endpoints(listen)),
        ("connect/endpoints", endpoints(connect)),
        ("connect/timeout_ms", "-1".into()),
        ("connect/exit_on_failure", "false".into()),
        ("connect/retry", json!({"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2}).to_string()),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
        ("transport/link/tx/lease", "2000".into()),
    ] {
        config.insert_json5(key, &value).expect("a key of Zenoh's");
    }
    zenoh::open(config).wait().expect("open")
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").expect("bound").local_addr().expect("an address").port()
}

fn config(graph: &str, running_graph: &str, machine: &str, peer: PeerConfig) -> Arc<LinkConfig> {
    Arc::new(LinkConfig {
        run: 1,
        graph: graph.into(),
        running_graph: running_graph.into(),
        namespace: None,
        machine: machine.into(),
        fingerprint: 1,
        peers: vec![peer],
        exports: Vec::new(),
        imports: Vec::new(),
        endpoints: Endpoints::default(),
        keys: None,
        insecure: false,
        deadline_millis: 200,
        buffer: 8,
    })
}

/// The links of two machines, `robot` and `brain`; commands go from the former to the latter.
struct Pair {
    /// The robot's graph, and brain's part of it for commands of the robot.
    robot_graph: String,
    part: String,
    robot: Tunnels,
    brain: Option<Tunnels>,
    robot_session: zenoh::Session,
    brain_config: Arc<LinkConfig>,
}

impl Pair {
    fn new(brain_graph: &str, may_read: bool, may_control: bool) -> Pair {
        let port = free_port();
        let (brain, robot) = (session(Some(port), None), session(None, Some(port)));
        Pair::over(brain, robot, brain_graph, may_read, may_control)
    }

    fn over(
        brain_session: zenoh::Session,
        robot_session: zenoh::Session,
        brain_graph: &str,
        may_read: bool,
        may_control: bool,
    ) -> Pair {
        let robot_graph = unique_name();
        let graph = format!("g{robot_graph}");
        let peer = |machine: &str, may_read, may_control| PeerConfig {
            machine: machine.into(),
            may_read,
            may_control,
            may: Vec::new(),
        };
        let robot_config = config(&graph, &robot_graph, "robot", peer("brain", false, false));
        let brain_config = config(&graph, brain_graph, "brain", peer("robot", may_read, may_control));
        let brain =
            Tunnels::start(brain_session, Arc::clone(&brain_config), &[Arc::default()], of_graph, Operators::default())
                .expect("started");
        let robot =
            Tunnels::start(robot_session.clone(), robot_config, &[Arc::default()], of_graph, Operators::default())
                .expect("started");
        let part = part_name(&robot_graph, "brain");
        wait_until(|| pick_graph(Some(&part)).is_ok(), || format!("nobody listens for {part}"));
        let pair = Pair { robot_graph, part, robot, brain: Some(brain), robot_session, brain_config };
        // Zenoh finds the other side in its own time; until then, a machine is cut off.
        wait_until(|| !is_cut_off(&pair.part), || "the machines do not find each other".into());
        pair
    }

    fn open(&self) -> Connection {
        Connection::open(&self.part).expect("connected")
    }

    fn rejected(&self) -> std::collections::BTreeMap<String, u64> {
        self.brain.as_ref().expect("it runs").rejected().by_reason()
    }
}

/// Whether no tunnel can be opened. It asks for something that never reaches a launcher.
fn is_cut_off(part: &str) -> bool {
    let mut connection = Connection::open(part).expect("this machine's link listens");
    let asked = connection.send(&Request::Attach { ports: Vec::new() }).and_then(|()| connection.receive(LIMIT, NEVER));
    match asked.expect_err("a link does not attach") {
        ClientError::Refused { message, .. } => message.contains("is cut off"),
        other => panic!("{other}"),
    }
}

fn refusal(connection: &mut Connection, request: &Request) -> String {
    connection.send(request).expect("sent");
    match connection.receive(LIMIT, NEVER) {
        Err(ClientError::Refused { message, .. }) => message,
        other => panic!("{request:?} was answered with {other:?}"),
    }
}

/// A launcher whose answers the test gives, and whose requests the test reads.
struct Launcher {
    name: String,
    asked: Receiver<String>,
    answers: Sender<Vec<u8>>,
}

impl Launcher {
    /// Serves one client after the other; a closed connection is heard as an empty line. Lines for the audit log are left
    /// out.
    fn start() -> Launcher {
        let name = unique_name();
        let socket = ControlSocket::bind(&name).expect("free");
        let (ask, asked) = channel();
        let (answers, to_send) = channel::<Vec<u8>>();
        std::thread::spawn(move || {
            let to_send = Arc::new(std::sync::Mutex::new(to_send));
            for stream in socket.listener().incoming() {
                let stream: UnixStream = stream.expect("a client");
                let mut writer = Some(stream.try_clone().expect("cloned"));
                let is_for_launcher = |line: &String| {
                    !["asker", "refused"].iter().any(|word| line.contains(&format!("\"request\":\"{word}\"")))
                };
                for line in BufReader::new(stream).lines().map_while(Result::ok).filter(is_for_launcher) {
                    if let Some(mut writer) = writer.take() {
                        let to_send = Arc::clone(&to_send);
                        std::thread::spawn(move || {
                            let to_send = to_send.lock().expect("not poisoned");
                            while let Ok(bytes) = to_send.recv() {
                                if bytes.is_empty() || writer.write_all(&bytes).is_err() {
                                    let _ = writer.shutdown(std::net::Shutdown::Both);
                                    return;
                                }
                            }
                        });
                    }
                    if ask.send(line).is_err() {
                        return;
                    }
                }
                if writer.is_none() && ask.send(String::new()).is_err() {
                    return;
                }
            }
        });
        Launcher { name, asked, answers }
    }

    fn asked(&self) -> Request {
        let line = self.asked.recv_timeout(LIMIT).expect("asked");
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{error}: '{line}'"))
    }

    fn answer(&self, reply: &Reply) {
        let line = serde_json::to_string(reply).expect("JSON");
        self.answers.send(format!("{line}\n").into_bytes()).expect("it runs");
    }

    fn hang_up(&self) {
        self.answers.send(Vec::new()).expect("it runs");
    }
}

fn set() -> Request {
    Request::Set { node: "classifier".into(), param: "votes".into(), value: json!(5) }
}

fn progress(text: impl Into<String>) -> Reply {
    Reply::Progress { message: text.into() }
}

#[test]
fn requests_and_replies_cross_and_the_end_of_either_side_is_seen() {
    let launcher = Launcher::start();
    let pair = Pair::new(&launcher.name, true, true);
    let mut connection = pair.open();
    for value in 0..3 {
        let set = Request::Set { node: "classifier".into(), param: "votes".into(), value: json!(value) };
        connection.send(&set).expect("sent");
        assert_eq!(launcher.asked(), set);
        let reply = Reply::Set { old: json!(null), new: json!(value), from_seq: Some(7) };
        launcher.answer(&progress("first"));
        launcher.answer(&reply);
        assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), progress("first"));
        assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), reply);
    }
    // When a client ends, its request is abandoned on the other machine as well.
    drop(connection);
    assert_eq!(launcher.asked.recv_timeout(LIMIT).expect("heard"), "");
    launcher.hang_up();

    // When the launcher ends, the connection ends after its last answer.
    let mut connection = pair.open();
    connection.send(&Request::Stop).expect("sent");
    assert_eq!(launcher.asked(), Request::Stop);
    launcher.answer(&Reply::Stopping);
    let long = "x".repeat(3_000_000);
    launcher.answer(&progress(&long));
    launcher.hang_up();
    assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), Reply::Stopping);
    assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), progress(long));
    connection.wait_until_ended().expect("an orderly end");
    assert_eq!(pair.rejected(), Default::default());
}

#[test]
fn large_data_goes_both_ways_at_once_and_arrives_whole() {
    let launcher = Launcher::start();
    let pair = Pair::new(&launcher.name, true, true);
    // Bytes are sent without a client, which would read replies only.
    let mut stream = UnixStream::connect(path_of(&pair.part)).expect("connected");
    let mut reader = BufReader::new(stream.try_clone().expect("cloned"));
    let request = |number: usize| Request::Set {
        node: format!("n{number}"),
        param: "y".repeat(number * 13 % 30_000),
        value: json!(number),
    };
    const N: usize = 300;
    let writer = std::thread::spawn(move || {
        for number in 0..N {
            let line = serde_json::to_string(&request(number)).expect("JSON");
            stream.write_all(format!("{line}\n").as_bytes()).expect("written");
        }
        stream
    });
    for number in 0..N {
        launcher.answer(&progress(format!("{number} {}", "z".repeat(number * 17 % 50_000))));
    }
    // A launcher whose answers are not read waits, and nothing is lost.
    std::thread::sleep(Duration::from_millis(300));
    let mut line = String::new();
    for number in 0..N {
        line.clear();
        reader.read_line(&mut line).expect("read");
        let expected = progress(format!("{number} {}", "z".repeat(number * 17 % 50_000)));
        assert_eq!(serde_json::from_str::<Reply>(&line).expect("a reply"), expected);
    }
    for number in 0..N {
        assert_eq!(launcher.asked(), request(number));
    }
    drop(writer.join().expect("written"));
}

#[test]
fn a_machine_without_rights_is_told_what_would_allow_it_and_the_launcher_hears_nothing() {
    let launcher = Launcher::start();
    let swap = SwapRequest {
        nodes: vec!["classifier".into()],
        program: None,
        args: None,
        set: Default::default(),
        folder: PathBuf::new(),
        shadow_limit_millis: 0,
        ready_limit_millis: 1,
        probation_millis: 1,
        allow_mismatch: false,
    };
    let looks = [
        Request::Status,
        Request::Logs { operator: None, n_lines: 1, follow: false },
        Request::Samples { ports: Vec::new() },
        Request::Attach { ports: Vec::new() },
    ];
    let changes = [set(), Request::Stop, Request::Swap(swap.clone()), Request::Promote, Request::Abandon];

    // Reading alone.
    let pair = Pair::new(&launcher.name, true, false);
    let mut connection = pair.open();
    for request in &changes {
        let refused = refusal(&mut connection, request);
        assert!(refused.contains("machines.brain.control: [robot]") && refused.contains(request.word()), "{refused}");
    }
    assert_eq!(pair.rejected()["unauthorised"], changes.len() as u64);
    // The connection stays: an allowed request is carried out.
    connection.send(&Request::Status).expect("sent");
    assert_eq!(launcher.asked(), Request::Status);
    launcher.answer(&progress("well"));
    assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), progress("well"));
    drop(connection);
    assert_eq!(launcher.asked.recv_timeout(LIMIT).expect("heard"), "");
    launcher.hang_up();
    drop(pair);

    // Changing alone: one does not imply the other.
    let pair = Pair::new(&launcher.name, false, true);
    let mut connection = pair.open();
    for request in &looks {
        let refused = refusal(&mut connection, request);
        assert!(refused.contains("machines.brain.read: [robot]") && refused.contains(request.word()), "{refused}");
    }
    // Requests that are impossible over a link are refused.
    let shadow = Request::Swap(SwapRequest { shadow_limit_millis: 5, ..swap });
    assert!(refusal(&mut connection, &shadow).contains("run this swap there"));
    connection.send(&set()).expect("sent");
    assert_eq!(launcher.asked(), set());
    drop(connection);
    assert_eq!(launcher.asked.recv_timeout(LIMIT).expect("heard"), "");
    assert!(launcher.asked.try_recv().is_err());
}

#[test]
fn malformed_requests_are_refused_and_oversized_ones_end_the_tunnel() {
    let launcher = Launcher::start();
    let pair = Pair::new(&launcher.name, true, true);
    let mut stream = UnixStream::connect(path_of(&pair.part)).expect("connected");
    let mut reader = BufReader::new(stream.try_clone().expect("cloned"));
    stream.write_all(b"{\"request\":\"explode\"}\n\xff\n").expect("written");
    for _ in 0..2 {
        let mut line = String::new();
        reader.read_line(&mut line).expect("read");
        assert!(line.contains("not a request of this version"), "{line}");
    }
    assert_eq!(pair.rejected()["malformed"], 2);
    let endless = vec![b'x'; 1 << 16];
    while stream.write_all(&endless).is_ok() {}
    let mut rest = Vec::new();
    // A reset is treated like an end.
    let _ = reader.read_to_end(&mut rest);
    assert!(launcher.asked.try_recv().is_err());
    // Other clients are served.
    assert!(!is_cut_off(&pair.part));
}

/// Forwards TCP until it is cut. Then it forwards nothing, and closes nothing.
struct Cable {
    port: u16,
    is_cut: Arc<AtomicBool>,
}

impl Cable {
    fn to(port: u16) -> Cable {
        let listener = TcpListener::bind("127.0.0.1:0").expect("bound");
        let own_port = listener.local_addr().expect("an address").port();
        let is_cut = Arc::new(AtomicBool::new(false));
        let cut = Arc::clone(&is_cut);
        std::thread::spawn(move || {
            for near in listener.incoming() {
                let near: TcpStream = near.expect("a connection");
                let Ok(far) = TcpStream::connect(InetAddress::from(([127, 0, 0, 1], port))) else { continue };
                let ways = [(near.try_clone().expect("cloned"), far.try_clone().expect("cloned")), (far, near)];
                for (mut from, mut to) in ways {
                    let cut = Arc::clone(&cut);
                    std::thread::spawn(move || {
                        let mut bytes = [0; 4096];
                        while let Ok(n @ 1..) = from.read(&mut bytes) {
                            while cut.load(Ordering::Relaxed) {
                                std::thread::sleep(Duration::from_millis(5));
                            }
                            if to.write_all(&bytes[..n]).is_err() {
                                break;
                            }
                        }
                        let _ = to.shutdown(std::net::Shutdown::Both);
                    });
                }
            }
        });
        Cable { port: own_port, is_cut }
    }
}

#[test]
fn a_machine_that_is_cut_off_is_reported_and_comes_back() {
    let launcher = Launcher::start();
    let port = free_port();
    let brain = session(Some(port), None);
    let cable = Cable::to(port);
    let pair = Pair::over(brain, session(None, Some(cable.port)), &launcher.name, true, true);
    let mut connection = pair.open();
    connection.send(&Request::Status).expect("sent");
    assert_eq!(launcher.asked(), Request::Status);
    cable.is_cut.store(true, Ordering::Relaxed);
    // A client that waits, and a new one.
    match connection.receive(LIMIT, NEVER) {
        Err(ClientError::Refused { message, .. }) => {
            assert!(message.starts_with("machine 'brain' is cut off: nothing has come"), "{message}");
        }
        other => panic!("{other:?}"),
    }
    let error = pair.open().ask(&Request::Status, LIMIT).expect_err("cut off");
    assert!(error.to_string().starts_with("machine 'brain' is cut off"), "{error}");
    // On the other machine the client has gone.
    assert_eq!(launcher.asked.recv_timeout(LIMIT).expect("heard"), "");
    cable.is_cut.store(false, Ordering::Relaxed);
    wait_until(|| !is_cut_off(&pair.part), || "it does not come back".into());
}

#[test]
fn the_end_of_a_link_ends_its_tunnels_in_order() {
    let launcher = Launcher::start();
    let mut pair = Pair::new(&launcher.name, true, true);
    let mut connection = pair.open();
    connection.send(&Request::Stop).expect("sent");
    assert_eq!(launcher.asked(), Request::Stop);
    launcher.answer(&Reply::Stopping);
    assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), Reply::Stopping);
    // The link on the other machine is an operator of the graph that ends.
    pair.brain = None;
    connection.wait_until_ended().expect("an orderly end");
    // This machine's link tells its clients why no answer comes, and no graph is found any more.
    let mut waiting = pair.open();
    waiting.send(&Request::Status).expect("sent");
    let part = pair.part.clone();
    drop(pair.robot);
    let error = waiting.receive(LIMIT, NEVER).expect_err("ended").to_string();
    assert!(error.contains("has ended") || error.contains("cut off"), "{error}");
    assert!(pick_graph(Some(&part)).is_err());
}

#[test]
fn the_number_of_tunnels_is_limited() {
    let launcher = Launcher::start();
    let pair = Pair::new(&launcher.name, true, true);
    let attach = Request::Attach { ports: Vec::new() };
    // A client that has gone, like the one that looked whether the machines have found each other, has its place until
    // the other machine knows.
    let open_in_time = || {
        let mut opened = None;
        wait_until(
            || {
                let mut connection = pair.open();
                let answer = refusal(&mut connection, &attach);
                let is_in = answer.contains("shared memory");
                // The limit of this machine, or of the other one.
                assert!(is_in || answer.contains("32 commands"), "{answer}");
                opened = is_in.then_some(connection);
                is_in
            },
            || "a place that is free is not given".into(),
        );
        opened.expect("it is in")
    };
    let mut connections: Vec<Connection> = (0..32).map(|_| open_in_time()).collect();
    let full = refusal(&mut pair.open(), &attach);
    assert!(full.contains("32 commands are at work"), "{full}");
    // All other tunnels are still open.
    for connection in &mut connections {
        assert!(refusal(connection, &attach).contains("shared memory"));
    }
    connections.truncate(31);
    drop(open_in_time());
}

#[test]
fn frames_that_are_no_tunnel_frames_are_counted_and_do_no_harm() {
    let launcher = Launcher::start();
    let pair = Pair::new(&launcher.name, true, true);
    let mut connection = pair.open();
    connection.send(&Request::Status).expect("sent");
    assert_eq!(launcher.asked(), Request::Status);
    let key = pair.brain_config.key("robot", "brain", KeyKind::Ask);
    let long = [b"bt\x02\0".as_slice(), &[0; 1 << 18]].concat();
    let unknown = [b"bt\x02\0".as_slice(), &[5, 6, 1, 4]].concat();
    for bytes in [b"".as_slice(), b"nonsense", b"bt\x09later", b"bt\x02", b"bt\x02\xff\xff\xff", &long, &unknown] {
        // By default, Zenoh drops what a busy connection cannot take.
        let put = pair.robot_session.put(&key, bytes).congestion_control(zenoh::qos::CongestionControl::Block);
        put.wait().expect("put");
    }
    wait_until(|| pair.rejected().values().sum::<u64>() >= 7, || format!("{:?}", pair.rejected()));
    let expected = [("foreign", 2), ("malformed", 2), ("oversized", 1), ("unknown", 1), ("version", 1)];
    assert_eq!(pair.rejected(), expected.map(|(why, count)| (why.to_string(), count)).into());
    launcher.answer(&progress("well"));
    assert_eq!(connection.receive(LIMIT, NEVER).expect("answered"), progress("well"));
}

fn records(path: &Path) -> Vec<(String, Record)> {
    RecordingReader::open(path).expect("opened").map(|record| record.expect("readable")).collect()
}

fn info(path: &Path) -> Value {
    let info = run(&["info", path.to_str().expect("UTF-8"), "--json"], 0);
    serde_json::from_slice(&info.stdout).expect("JSON")
}

#[test]
fn commands_reach_a_real_graph_on_the_other_machine() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow(folder.path(), &[]), &FAST_FOREVER);
    let pair = Pair::new(&graph.name, true, true);
    let part = pair.part.as_str();

    let status = json_lines(&run(&["ps", part, "--json"], 0).stdout)[0]["graphs"][0].clone();
    assert_eq!((status["graph"].as_str(), status["nodes"].as_array().map(Vec::len)), (Some(part), Some(5)));
    assert_eq!(status["usage"], json!({}), "another machine's processes are none of ours");
    let top = run(&["top", part, "--json", "-n", "1", "--interval", "0.1"], 0);
    assert_eq!(json_lines(&top.stdout)[0]["nodes"][0]["resident_bytes"], Value::Null);

    let changed = run(&["set", "lift_arbiter.votes=4", "--graph", part, "--json"], 0);
    assert_eq!(json_lines(&changed.stdout)[0]["new"], 4);
    assert_eq!(graph.node("lift_arbiter")["params"]["votes"], 4);
    run(&["set", "lift_arbiter.votes=3", "--graph", part], 0);

    // Names and paths are those of the other machine. Its dataflow file lies in the folder; this process runs
    // elsewhere.
    let own = own_operator(folder.path(), "classifier");
    run(&["swap", "classifier", "--graph", part, "--run", "own_classifier", "--probation", "0.1"], 0);
    assert_eq!(graph.node("classifier")["program"], json!(own));
    run(&["swap", "classifier", "--graph", part, "--run", own.to_str().expect("UTF-8"), "--probation", "0.1"], 0);
    let missing = run(&["swap", "classifier", "--graph", part, "--run", "no_such"], 1);
    assert!(text(&missing.stderr).contains("no such program on machine 'brain'"), "{}", text(&missing.stderr));
    let shadow = run(&["swap", "classifier", "--graph", part, "--shadow", "1"], 1);
    // Each of them is in the audit log, with the machine that has asked.
    let audit = || {
        let lines = json_lines(&run(&["logs", "audit", "--graph", &graph.name, "--json"], 0).stdout);
        let texts = lines.iter().map(|line| line["text"].as_str().expect("a text").to_owned());
        texts.filter(|text| text.starts_with("machine robot (uid ")).collect::<Vec<_>>()
    };
    let expected = [
        ": set lift_arbiter.votes=4: accepted: 3 became 4",
        ": set lift_arbiter.votes=3: accepted: 4 became 3",
        ": swap classifier --run ",
        ": accepted: process classifier ",
        ": swap classifier --run no_such: refused: --run no_such: there is no such program",
    ];
    let is_whole = |audit: &[String]| expected.iter().all(|part| audit.iter().any(|text| text.contains(part)));
    wait_until(|| is_whole(&audit()), || format!("{:?}", audit()));
    assert!(text(&shadow.stderr).contains("shared memory of machine 'brain'"), "{}", text(&shadow.stderr));

    let here = run(&["logs", "--graph", &graph.name, "--json", "-n", "5"], 0);
    let there = run(&["logs", "--graph", part, "--json", "-n", "5"], 0);
    assert!(!here.stdout.is_empty());
    assert_eq!(text(&there.stdout), text(&here.stdout));
    let unknown = run(&["logs", "nobody", "--graph", part], 1);
    assert!(text(&unknown.stderr).contains("no log of nobody"), "{}", text(&unknown.stderr));

    // Both machines record at the same time.
    let [near, far] = ["near.mcap", "far.mcap"].map(|name| folder.path().join(name));
    let record = |graph: &str, out: &Path, secs: &str| {
        let mut command = blindgrasp();
        command.args(["record", graph, "--json", "--for", secs, "--out"]).arg(out);
        command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().expect("started")
    };
    let (first, second) = (record(&graph.name, &near, "2"), record(part, &far, "1"));
    for recorder in [second, first] {
        let output = recorder.wait_with_output().expect("waited");
        assert_eq!(output.status.code(), Some(0), "{}\n{}", text(&output.stdout), text(&output.stderr));
        let summary = &json_lines(&output.stdout)[0];
        assert_eq!((&summary["missing"], &summary["ended"]), (&json!(0), &json!("detached")), "{summary}");
    }
    let (near_records, far_records) = (records(&near), records(&far));
    let topics = |records: &[(String, Record)]| {
        records.iter().map(|(topic, _)| topic.clone()).collect::<std::collections::BTreeSet<_>>()
    };
    assert_eq!(topics(&far_records), topics(&near_records));
    assert!(topics(&far_records).contains("/truth") && topics(&far_records).contains("/decision"));
    let keys = |records: &[(String, Record)], topic: &str| -> Vec<(u64, u64)> {
        let of_topic = records.iter().filter(|(other, _)| other == topic);
        of_topic.map(|(_, record)| (record.header().epoch, record.header().seq)).collect()
    };
    let frames = keys(&far_records, "/tactile");
    assert!(frames.len() > 200, "{} frames", frames.len());
    for topic in ["/contacts", "/feature", "/prediction"] {
        assert_eq!(keys(&far_records, topic), frames, "{topic}");
    }
    // Both recordings hold the same samples where both hold any.
    let mut n_alike = 0;
    for (topic, record) in &far_records {
        let header = *record.header();
        if let Some((_, other)) = near_records.iter().find(|(near, other)| near == topic && *other.header() == header) {
            assert_eq!(format!("{record:?}"), format!("{other:?}"));
            n_alike += 1;
            if n_alike > 2000 {
                break;
            }
        }
    }
    assert!(n_alike > 100, "{n_alike}");
    let (near_info, far_info) = (info(&near), info(&far));
    assert_eq!((&near_info["hand"], &near_info["made_by"]), (&far_info["hand"], &far_info["made_by"]));
    for word in ["attached", "detached", "held-out.mcap", "barrett-bh8-280.json", "dictionary_id"] {
        assert!(far_info.to_string().contains(word), "{word} is not in {far_info}");
    }

    // When the graph ends, the recorder has all samples.
    let last = folder.path().join("last.mcap");
    let recorder = record(part, &last, "600");
    wait_until(|| last.exists(), || "it does not begin".into());
    graph.wait_for_decisions(2);
    let stopped = run(&["stop", "--machine", "brain", &pair.robot_graph, "--json"], 0);
    assert_eq!(json_lines(&stopped.stdout)[0]["ended"], json!([part]));
    let output = recorder.wait_with_output().expect("waited");
    let summary = &json_lines(&output.stdout)[0];
    assert_eq!((&summary["missing"], &summary["ended"]), (&json!(0), &json!("graph")), "{summary}");
    let ended = graph.finish();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_eq!(pair.rejected(), Default::default());
}
