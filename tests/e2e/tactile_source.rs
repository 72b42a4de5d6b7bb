//! Live frames of a hand through the real processes. Each test is the bridge, and also sends faulty frames.

use std::io::{BufRead, BufReader, Read, Write};
use std::time::Duration;

use crate::common::live::{Bridge, PATIENT, changed, free_port, grasps, line, listening, live_dataflow};
use crate::common::{
    Graph, MODEL, assert_nothing_left, blindgrasp, fails, project, run, signal, text, undisturbed, unique_name,
    wait_until,
};
use blindgrasp_messages::{Phase, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingReader};
use rustix::process::Signal;
use rustix::pty::OpenptFlags;
use serde_json::{Value, json};

fn counts(graph: &Graph) -> Value {
    graph.node("tactile_source")["counts"].clone()
}

/// Waits until the source's counters are exactly these.
fn wait_for_counts(graph: &Graph, expected: &[(&str, u64)]) {
    let is_so = || {
        let counts = counts(graph);
        let counts = counts.as_object().expect("counts");
        let of = |name: &str| expected.iter().find(|(known, _)| *known == name).map_or(0, |(_, count)| *count);
        !counts.is_empty() && counts.iter().all(|(name, count)| *count == of(name))
    };
    wait_until(is_so, || format!("expected {expected:?}, found {}\n{}", counts(graph), graph.said()));
}

/// The decisions of the recording, except that these grasps are held for a gap.
fn expected_but(held: &[u64]) -> Vec<(String, String)> {
    let mut expected = undisturbed().to_vec();
    for grasp_id in held {
        expected[*grasp_id as usize] = ("hold".into(), "out_of_order".into());
    }
    expected
}

fn stop(graph: Graph, expected: &[(String, String)], n_decisions: usize) {
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}\n{}", ended.summary, ended.stderr);
    assert_eq!(ended.decisions.len(), n_decisions, "{}", ended.stderr);
    ended.assert_decided_as(expected, "live");
}

#[test]
fn frames_over_tcp_are_decided_as_those_of_the_recording() {
    let (graph, mut bridge) = listening(&[PATIENT], &[]);
    let frames = grasps(240);
    for (key, value) in [
        ("blindgrasp", json!("tactile")),
        ("protocol", json!(1)),
        ("hand", json!("barrett-bh8-280")),
        ("n_joints", json!(7)),
        ("n_cells", json!(96)),
        ("last_seq", Value::Null),
        ("last_grasp_id", Value::Null),
    ] {
        assert_eq!(bridge.greeting[key], value, "{key}");
    }
    assert_eq!(bridge.greeting["pads"].as_array().map(Vec::len), Some(4), "{}", bridge.greeting);
    frames.iter().for_each(|frame| bridge.send_frame(frame));
    wait_until(|| graph.n_decisions() == 240, || format!("{} decisions\n{}", graph.n_decisions(), graph.said()));
    wait_for_counts(&graph, &[("frames", frames.len() as u64), ("connections", 1)]);
    stop(graph, undisturbed(), 240);
}

#[test]
fn frames_have_their_own_day_or_that_of_the_source() {
    let folder = tempfile::tempdir().expect("a folder");
    for (params, of_source) in [(&[PATIENT][..], 20_260_101..=99_991_231), (&[PATIENT, "day: 5"], 5..=5)] {
        let recording = folder.path().join(format!("day{}.mcap", of_source.start()));
        let (graph, mut bridge) = listening(params, &["--record", recording.to_str().expect("UTF-8")]);
        for frame in grasps(2) {
            match frame.message.grasp_id {
                0 => bridge.send_frame(&frame),
                _ => bridge.send(&changed(&frame, |line| line["day"] = json!(7))),
            }
        }
        wait_until(|| graph.n_decisions() == 2, || graph.said());
        assert_eq!(graph.stop().code, Some(0));
        let days = RecordingReader::open(&recording).expect("a recording").filter_map(|record| {
            match record.expect("readable").1 {
                Record::Tactile(frame) => Some((frame.message.grasp_id, frame.message.day)),
                _ => None,
            }
        });
        let (first, second): (Vec<_>, Vec<_>) = days.partition(|(grasp_id, _)| *grasp_id == 0);
        assert!(!first.is_empty() && first.iter().all(|(_, day)| of_source.contains(day)), "{first:?}");
        assert!(!second.is_empty() && second.iter().all(|(_, day)| *day == 7), "{second:?}");
    }
}

/// A fault of a frame: the counter that counts it, and the bytes that have it.
type Wrong = (&'static str, fn(&Stamped<TactileFrame>) -> Vec<u8>);

/// One of each kind; the tests of the line protocol have them all.
const WRONG: [Wrong; 5] = [
    ("malformed", |_| b"not JSON\n".to_vec()),
    ("malformed", |frame| changed(frame, |line| drop(line["cells_newtons"].as_array_mut().expect("a list").pop()))),
    ("oversized", |_| [vec![b'x'; 100_000], b"\n".to_vec()].concat()),
    ("out_of_order", |frame| changed(frame, |line| line["seq"] = json!(0))),
    ("out_of_order", |frame| changed(frame, |line| line["stamp_nanos"] = json!(1))),
];

#[test]
fn the_grasp_of_a_faulty_frame_is_held_and_the_next_is_decided() {
    let (graph, mut bridge) = listening(&[PATIENT], &[]);
    let n_grasps = 2 * WRONG.len() as u64 + 2;
    let mut expected_counts = vec![("connections", 1)];
    let mut n_frames = 0;
    let mut held = Vec::new();
    for frame in grasps(n_grasps) {
        let (grasp_id, nth) = (frame.message.grasp_id, frame.header.seq % 14);
        // The fifth frame of every second grasp.
        if grasp_id % 2 == 1 && nth == 4 && (grasp_id as usize) < 2 * WRONG.len() {
            let (kind, wrong) = WRONG[grasp_id as usize / 2];
            bridge.send(&wrong(&frame));
            assert_eq!(bridge.answer()["refused"], kind, "grasp {grasp_id}");
            match expected_counts.iter_mut().find(|(known, _)| *known == kind) {
                Some((_, count)) => *count += 1,
                None => expected_counts.push((kind, 1)),
            }
            held.push(grasp_id);
            continue;
        }
        bridge.send_frame(&frame);
        n_frames += 1;
    }
    expected_counts.push(("frames", n_frames));
    wait_for_counts(&graph, &expected_counts);
    wait_until(|| graph.n_decisions() as u64 == n_grasps, || graph.said());
    stop(graph, &expected_but(&held), n_grasps as usize);
}

#[test]
fn a_late_frame_a_lost_connection_and_a_second_client_cost_one_grasp_each_at_most() {
    let (graph, mut bridge) = listening(&[PATIENT], &[]);
    let port = bridge.port;
    let frames = grasps(12);
    let of_grasp = |grasp_id: u64| &frames[14 * grasp_id as usize..][..14];
    (0..2).flat_map(of_grasp).for_each(|frame| bridge.send_frame(frame));
    // A second client.
    let mut other = Bridge::connect(port);
    assert_eq!(other.greeting["refused"], "busy");
    assert_eq!(other.stream.read(&mut [0; 8]).expect("closed"), 0);
    of_grasp(2).iter().for_each(|frame| bridge.send_frame(frame));
    // The client hangs up within a line, and goes on from there.
    of_grasp(3)[..4].iter().for_each(|frame| bridge.send_frame(frame));
    let cut = line(&of_grasp(3)[4]).to_string();
    bridge.send(&cut.as_bytes()[..cut.len() / 2]);
    drop(bridge);
    // The kernel may show the new connection before the end of the old one. The new one would be refused then.
    let has_seen_the_end = || graph.node("tactile_source")["counts"]["cut_off"] == 1;
    wait_until(has_seen_the_end, || graph.said());
    let mut bridge = Bridge::connect(port);
    assert_eq!((&bridge.greeting["last_seq"], &bridge.greeting["last_grasp_id"]), (&json!(3 * 14 + 3), &json!(3)));
    of_grasp(3)[5..].iter().for_each(|frame| bridge.send_frame(frame));
    (4..6).flat_map(of_grasp).for_each(|frame| bridge.send_frame(frame));
    // A frame is missing.
    let missed = of_grasp(6).iter().enumerate().filter(|(nth, _)| *nth != 5);
    missed.for_each(|(_, frame)| bridge.send_frame(frame));
    of_grasp(7).iter().for_each(|frame| bridge.send_frame(frame));
    // One frame is late, and those after it are not.
    run(&["set", "tactile_source.max_delay_ms=1000", "--graph", &graph.name], 0);
    of_grasp(8)[..4].iter().for_each(|frame| bridge.send_frame(frame));
    std::thread::sleep(Duration::from_millis(2500));
    bridge.send_frame(&of_grasp(8)[4]);
    assert_eq!(bridge.answer()["refused"], "late");
    for frame in of_grasp(8)[5..].iter().chain((9..12).flat_map(of_grasp)) {
        let header =
            blindgrasp_messages::Header { stamp_nanos: frame.header.stamp_nanos + 2_500_000_000, ..frame.header };
        bridge.send_frame(&Stamped { header, message: frame.message.clone() });
    }
    wait_until(|| graph.n_decisions() == 12, || graph.said());
    let n_frames = 12 * 14 - 3;
    wait_for_counts(
        &graph,
        &[("frames", n_frames), ("connections", 2), ("cut_off", 1), ("missed", 1), ("late", 1), ("refused_clients", 1)],
    );
    stop(graph, &expected_but(&[3, 6, 8]), 12);
}

#[test]
fn the_open_hand_gives_the_zero_of_cells_that_have_drifted() {
    let folder = tempfile::tempdir().expect("a folder");
    for (zero, is_undisturbed) in [("true", true), ("false", false)] {
        let (graph, mut bridge) = listening(&[PATIENT, &format!("zero_when_open: {zero}")], &[]);
        // Each cell has its own offset, of up to 0.1 N to either side, as a sensor has that was tared once. The first grasp lacks its
        // open frames: it is not sent, and the gap holds the second one.
        let frames = grasps(40);
        let begin = frames.iter().position(|frame| frame.message.phase != Phase::Open).expect("closing frames");
        for frame in &frames[begin..] {
            bridge.send(&changed(frame, |line| {
                for (cell_idx, cell) in line["cells_newtons"].as_array_mut().expect("a list").iter_mut().enumerate() {
                    *cell = json!(cell.as_f64().expect("a number") - 0.1 + 0.002 * cell_idx as f64);
                }
            }));
        }
        if !is_undisturbed {
            // Without the zero, all frames with readings below the noise are refused.
            wait_until(|| counts(&graph)["malformed"] == 14 * 40 - begin, || counts(&graph).to_string());
            assert!(graph.said().contains("needs zero_when_open"), "{}", graph.said());
            drop(graph);
            continue;
        }
        wait_until(|| graph.n_decisions() == 39, || graph.said());
        wait_until(|| counts(&graph)["unzeroed"] == 14 - begin, || counts(&graph).to_string());
        let decided = graph.stop().decisions;
        let is_same = |found: &&Value| {
            let expected = found["grasp_id"].as_u64().map(|grasp_id| &undisturbed()[grasp_id as usize]);
            expected.is_some_and(|(action, reason)| found["action"] == **action && found["reason"] == **reason)
        };
        let n_same =
            decided.iter().filter(|found| found["grasp_id"] != 0 && found["grasp_id"] != 1).filter(is_same).count();
        // Noise that was cut off at 0 is cut off elsewhere, which may turn a close decision.
        assert!(n_same >= 37, "{n_same} of 38 as without drift");
        assert_eq!(decided[0]["reason"], "out_of_order");
    }
    // Cells that read less the more they are loaded have no force without a zero.
    let layout = std::fs::read_to_string(project().join("hands/barrett-bh8-280.yaml")).expect("a layout");
    let layout = layout.replacen("_newtons: 0.05}", "_newtons: 0.05, falls_under_load: true}", 1);
    let urdf = project().join("hands/barrett-bh8-280.urdf");
    std::fs::write(folder.path().join("falling.yaml"), layout).expect("written");
    std::fs::copy(urdf, folder.path().join("barrett-bh8-280.urdf")).expect("copied");
    let flow = live_dataflow(folder.path(), "driver: listen");
    let hand = format!("hand={}", folder.path().join("falling.yaml").display());
    let flow = flow.to_str().expect("UTF-8");
    fails(
        &["run", "--allow-mismatch", "--name", &unique_name(), "--set", &hand, flow],
        "fall under load: set zero_when_open",
    );
}

#[test]
fn a_cell_that_may_be_missing_costs_no_grasp() {
    let folder = tempfile::tempdir().expect("a folder");
    for may_be_missing in [false, true] {
        let layout = std::fs::read_to_string(project().join("hands/barrett-bh8-280.yaml")).expect("a layout");
        let pad = "layout: palm, noise_threshold_newtons: 0.05";
        let said = format!("{pad}, may_be_missing: {may_be_missing}");
        let hand = folder.path().join("missing.yaml");
        std::fs::write(&hand, layout.replacen(pad, &said, 1)).expect("written");
        std::fs::copy(project().join("hands/barrett-bh8-280.urdf"), folder.path().join("barrett-bh8-280.urdf"))
            .expect("copied");
        let (graph, mut bridge) = listening(&[PATIENT], &["--set", &format!("hand={}", hand.display())]);
        for frame in &grasps(4) {
            bridge.send(&changed(frame, |line| line["cells_newtons"][0] = Value::Null));
        }
        let count = if may_be_missing { "missing_cells" } else { "malformed" };
        wait_until(|| counts(&graph)[count] == 4 * 14, || counts(&graph).to_string());
        if may_be_missing {
            wait_until(|| graph.n_decisions() == 4, || graph.said());
        } else {
            assert!(graph.said().contains("cells_newtons[0] is missing"), "{}", graph.said());
        }
    }
}

#[test]
fn outcomes_of_lifts_withdraw_a_promise_that_they_refute() {
    let (graph, mut bridge) = listening(&[PATIENT], &["--set", "lift_arbiter.promised_drops=0.05"]);
    let frames = grasps(30);
    let mut expected = undisturbed()[..30].to_vec();
    let mut lifts: Vec<usize> = (0..30).filter(|grasp_id| expected[*grasp_id].0 == "lift").collect();
    // Each lift drops its object. The fourth one is enough, and the promise stays withdrawn in another process.
    let n_before = lifts[3] + 4;
    let mut tell = |grasps: std::ops::Range<usize>| {
        for grasp_id in grasps {
            for (nth, frame) in frames[14 * grasp_id..][..14].iter().chain([&frames[14 * grasp_id + 13]]).enumerate() {
                let (seq, dropped) = (15 * grasp_id + nth, nth == 14);
                bridge.send(&changed(frame, |line| {
                    line["seq"] = json!(seq);
                    line["phase"] = if dropped { json!("dropped") } else { line["phase"].clone() };
                }));
            }
        }
    };
    tell(0..n_before);
    wait_until(|| graph.n_decisions() == n_before, || graph.said());
    let counts = json!({"lifts/kept": 0, "lifts/dropped": 4, "lifts/unreported": 0, "promise_withdrawn": 1,
        "promise/kept": 0, "promise/dropped": 4, "promise/drops_at_most_ppm": 1_000_000, "promise/lifts_per_object": 5});
    wait_until(|| graph.node("lift_arbiter")["counts"] == counts, || graph.node("lift_arbiter").to_string());
    let told = "more lifts drop the object than the promised 5 %: 4 of 4 that were reported";
    assert!(graph.said().contains(told), "{}", graph.said());
    (0..3).for_each(|_| graph.kill("lift_arbiter"));
    tell(n_before..n_before + 4);
    wait_until(|| graph.n_decisions() == n_before + 4, || graph.said());
    // The processes after it know the outcomes, and do not count them again.
    assert_eq!(graph.node("lift_arbiter")["counts"], counts);
    // Another promise has no evidence against it yet.
    run(&["set", "lift_arbiter.promised_drops=0.9", "--graph", &graph.name], 0);
    tell(n_before + 4..30);
    wait_until(|| graph.n_decisions() == 30, || graph.said());
    expected[lifts[3] + 1..n_before + 4].fill(("hold".into(), "promise_withdrawn".into()));
    lifts.retain(|grasp_id| *grasp_id >= n_before + 4);
    assert!(!lifts.is_empty(), "grasps that are lifted under the new promise");
    let n_dropped = || graph.node("lift_arbiter")["counts"]["lifts/dropped"].as_u64();
    wait_until(|| n_dropped() == Some(4 + lifts.len() as u64), || graph.node("lift_arbiter").to_string());
    // The promise of the lifts begins anew with it.
    let promise = |name: &str| graph.node("lift_arbiter")["counts"][name].as_u64();
    assert_eq!(promise("promise/dropped"), Some(lifts.len() as u64));
    graph.kill("lift_arbiter");
    assert_eq!(n_dropped(), Some(4 + lifts.len() as u64));
    stop(graph, &expected, 30);
}

#[test]
fn a_bridge_that_never_reads_answers_does_not_block_the_source() {
    let (graph, mut bridge) = listening(&[PATIENT], &[]);
    let frames = grasps(3);
    frames[..14].iter().for_each(|frame| bridge.send_frame(frame));
    let nonsense = "nonsense\n".repeat(1000);
    (0..200).for_each(|_| bridge.send(nonsense.as_bytes()));
    frames[14..].iter().for_each(|frame| bridge.send_frame(frame));
    wait_until(|| graph.n_decisions() == 3, || graph.said());
    wait_for_counts(&graph, &[("frames", 42), ("connections", 1), ("malformed", 200_000)]);
    stop(graph, &expected_but(&[1]), 3);
}

#[test]
fn a_killed_and_a_swapped_source_go_on_after_a_gap_and_no_grasp_is_decided_twice() {
    let (graph, mut bridge) = listening(&[PATIENT], &[]);
    let frames = grasps(16);
    for (begin, disturb) in [(0, "nothing"), (4, "kill"), (8, "swap"), (12, "swap")] {
        let old = graph.pid_of("tactile_source");
        match disturb {
            "kill" => graph.kill("tactile_source"),
            "swap" => drop(run(&["swap", "tactile_source", "--probation", "0.2", "--graph", &graph.name], 0)),
            _ => {}
        }
        if disturb != "nothing" {
            assert_ne!(graph.pid_of("tactile_source"), old);
            assert_eq!(bridge.answers.read_line(&mut String::new()).unwrap_or(0), 0, "after {disturb}");
            bridge = Bridge::connect(bridge.port);
            assert_eq!(bridge.greeting["last_grasp_id"], begin - 1, "after {disturb}");
            assert_eq!(bridge.greeting["last_seq"], 14 * begin - 1, "after {disturb}");
        }
        frames[14 * begin..][..14 * 4].iter().for_each(|frame| bridge.send_frame(frame));
        wait_until(|| graph.n_decisions() == begin + 4, || graph.said());
        // The source has read all frames, so that none is lost with its process.
        wait_until(|| counts(&graph)["frames"] == 14 * (begin + 4), || counts(&graph).to_string());
    }
    stop(graph, &expected_but(&[4, 8, 12]), 16);
}

#[test]
fn frames_that_came_while_the_source_stood_still_are_late_without_stamps() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let params = format!("driver: listen\n      address: 127.0.0.1:{port}\n      max_delay_ms: 1000");
    let flow = live_dataflow(folder.path(), &params);
    let text = std::fs::read_to_string(&flow).expect("read");
    std::fs::write(&flow, text.replace("  tactile_source:\n", "  tactile_source:\n    heartbeat_ms: off\n"))
        .expect("written");
    let graph = Graph::launch(&unique_name(), &flow, &[]);
    let frames = grasps(4);
    let mut bridge = Bridge::connect(port);
    let mut send = |grasp_id: usize| {
        for frame in &frames[14 * grasp_id..][..14] {
            bridge.send(&changed(frame, |line| {
                for key in ["seq", "stamp_nanos"] {
                    line.as_object_mut().expect("an object").remove(key);
                }
            }));
        }
    };
    send(0);
    wait_until(|| graph.n_decisions() == 1, || graph.said());
    let pid = graph.pid_of("tactile_source");
    signal(pid, Signal::STOP);
    send(1);
    std::thread::sleep(Duration::from_millis(2000));
    signal(pid, Signal::CONT);
    wait_until(|| counts(&graph)["late"] == 14, || counts(&graph).to_string());
    send(2);
    send(3);
    wait_for_counts(&graph, &[("frames", 42), ("connections", 1), ("late", 14)]);
    wait_until(|| graph.n_decisions() == 3, || graph.said());
    let ended = graph.stop();
    let found: Vec<_> = ended.decisions.iter().map(|line| (&line["grasp_id"], &line["reason"])).collect();
    let reason = |grasp_id: usize| json!(undisturbed()[grasp_id].1);
    let expected = [(json!(0), reason(0)), (json!(2), json!("out_of_order")), (json!(3), reason(3))];
    assert_eq!(found, expected.each_ref().map(|(grasp_id, reason)| (grasp_id, reason)), "{}", ended.stderr);
}

#[test]
fn frames_over_a_serial_device_are_decided_as_those_of_the_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    // The graph's processes must not inherit it: they would keep it open.
    let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
    let master = rustix::pty::openpt(flags).expect("a pty");
    rustix::pty::grantpt(&master).expect("granted");
    rustix::pty::unlockpt(&master).expect("unlocked");
    let device = rustix::pty::ptsname(&master, Vec::new()).expect("a name").into_string().expect("UTF-8");
    let params = format!("driver: serial\n      device: {device}\n      baud: 921600\n      {PATIENT}");
    let graph = Graph::launch(&unique_name(), &live_dataflow(folder.path(), &params), &[]);
    let mut master = std::fs::File::from(master);
    let mut greeting = String::new();
    BufReader::new(master.try_clone().expect("cloned")).read_line(&mut greeting).expect("read");
    assert!(greeting.contains("barrett-bh8-280"), "{greeting}");
    // A device also talks while nobody listens: the source first reads the end of a line.
    master.write_all(b"0.25],\"phase\":\"open\"}\r\n").expect("sent");
    let frames = grasps(20);
    frames.iter().for_each(|frame| master.write_all(format!("{}\r\n", line(frame)).as_bytes()).expect("sent"));
    wait_until(|| graph.n_decisions() == 20, || format!("{}\n{}", counts(&graph), graph.said()));
    wait_for_counts(&graph, &[("frames", 280), ("connections", 1), ("cut_off", 1)]);
    // The device is unplugged.
    drop(master);
    wait_until(|| graph.said().contains("cannot open"), || graph.said());
    stop(graph, &expected_but(&[0]), 20);
}

#[test]
fn a_driver_without_what_it_needs_is_refused_by_name() {
    for (params, words) in [
        ("driver: connect", "driver connect needs the param 'address', like robot.local:7400"),
        ("driver: serial", "driver serial needs the param 'device', like /dev/ttyACM0"),
        ("driver: listen\n      baud: 9600", "param 'baud' is of no use to driver listen"),
        ("driver: listen\n      address: nowhere", "cannot listen on nowhere"),
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        let (name, flow) = (unique_name(), live_dataflow(folder.path(), params));
        let output = run(&["run", "--name", &name, flow.to_str().expect("UTF-8")], 1);
        assert!(text(&output.stderr).contains(words), "{params}: {}", text(&output.stderr));
        assert_nothing_left(&name);
    }
}

/// Two hands with one socket: the second graph stops while `run --detach` waits for it.
#[test]
fn a_graph_in_the_background_whose_source_cannot_listen_has_not_started() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let folder = tempfile::tempdir().expect("a folder");
    let address = format!("address: {}", taken.local_addr().expect("bound"));
    let (name, flow) = (unique_name(), live_dataflow(folder.path(), &address));
    let output = run(&["run", "--detach", "--name", &name, flow.to_str().expect("UTF-8")], 1);
    let said = text(&output.stderr);
    assert!(said.contains("did not start") && said.contains("give each source an address"), "{said}");
    assert_nothing_left(&name);
}

#[test]
fn the_live_graph_that_comes_with_the_project_is_sound() {
    let output = run(&["run", "--check", "dataflow-live.yaml"], 0);
    assert!(text(&output.stdout).contains("source/tactile"), "{}", text(&output.stdout));
    // The same graph with a simulated hand, to which the decisions come back.
    let simulated =
        blindgrasp().args(["run", "--check", "dataflow-live.yaml"]).env("SOURCE", "simulated_hand").output();
    let shown = text(&simulated.expect("started").stdout);
    assert!(shown.contains("lift_arbiter/decision → source/decision"), "{shown}");
    // The paper's label says nothing of lifts.
    let paper = [("MODEL", MODEL), ("PROBE", "none")];
    let warned = blindgrasp().args(["run", "--check", "dataflow-live.yaml"]).envs(paper).output().expect("started");
    let said = text(&warned.stderr);
    assert!(warned.status.success() && said.contains("learned the paper's label"), "{said}");
}
