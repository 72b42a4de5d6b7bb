//! `blindgrasp echo`: the samples of a running graph on stdout.

use std::io::{BufRead, BufReader};
use std::process::Stdio;

use blindgrasp_messages::TactileFrame;
use blindgrasp_recording::cdr;
use serde_json::Value;

use crate::common::{FAST_FOREVER, Graph, blindgrasp, fails, json_lines, project, run, text, unique_name};

#[test]
fn the_samples_of_a_running_graph_are_printed_as_they_are() {
    let graph = Graph::launch(&unique_name(), &project().join("dataflow.yaml"), &FAST_FOREVER);
    graph.wait_for_decisions(1);
    let echo = |arguments: &[&str]| run(&[&["echo", "--graph", &graph.name][..], arguments].concat(), 0);
    let lines = json_lines(&echo(&["-n", "20", "lift_arbiter/decision"]).stdout);
    assert_eq!(lines.len(), 20);
    let last = lines[19]["data"]["grasp_id"].as_u64().expect("a number");
    graph.wait_for_decisions(last as usize + 1);
    let decided = graph.lines();
    for line in &lines {
        let found = decided.iter().find(|decision| decision["grasp_id"] == line["data"]["grasp_id"]).expect("decided");
        assert_eq!((&line["topic"], &line["seq"]), (&"/decision".into(), &found["seq"]));
        for field in ["action", "reason", "probability_stable"] {
            assert_eq!(line["data"][field], found[field], "{line}");
        }
    }
    assert!(lines.windows(2).all(|pair| pair[1]["seq"].as_u64() == pair[0]["seq"].as_u64().map(|seq| seq + 1)));
    // All edges, for a time.
    let lines = json_lines(&echo(&["--for", "0.5"]).stdout);
    for topic in ["/tactile", "/contacts", "/feature", "/prediction", "/decision", "/truth"] {
        assert!(lines.iter().any(|line| line["topic"] == topic), "{topic}");
    }
    // Messages of ROS 2, whose readers do not learn the epoch, and decisions with the end of their time.
    let epoch = lines.iter().find(|line| line["topic"] == "/tactile").expect("a frame")["epoch"].clone();
    let messages = json_lines(&echo(&["--cdr", "--for", "0.5"]).stdout);
    let hex_of =
        |topic: &str| messages.iter().find(|line| line["topic"] == topic).and_then(|line| line["cdr"].as_str());
    for topic in ["/contacts", "/joint_states", "/cell_points", "/contact_points", "/hand_markers"] {
        assert!(hex_of(topic).is_some_and(|hex| hex.starts_with("00010000")), "{topic}");
    }
    let hex = hex_of("/tactile").expect("a frame");
    let byte = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).expect("a byte");
    let bytes: Vec<u8> = (0..hex.len()).step_by(2).map(byte).collect();
    let frame = cdr::decode::<TactileFrame>(&bytes).expect("a message");
    assert!(frame.message.joints.len() == 7 && epoch != frame.header.epoch, "{epoch}");
    let is_decision = |line: &&Value| line["decision"]["action"].is_string() && line.get("valid_until_nanos").is_some();
    assert!(messages.iter().any(|line| is_decision(&line)) && hex_of("/decision").is_none());
    // A name that only one output has is enough, as is its node.
    for name in ["decision", "/decision", "lift_arbiter"] {
        let lines = json_lines(&echo(&["-n", "2", name]).stdout);
        assert!(lines.len() == 2 && lines.iter().all(|line| line["topic"] == "/decision"), "{name}: {lines:?}");
    }
    fails(&["echo", "--graph", &graph.name, "lift_arbiter/decisions"], "did you mean 'lift_arbiter/decision'?");
    // A parameter is named as with run --set.
    let set = |argument: &str, exit_code| run(&["set", "--graph", &graph.name, argument], exit_code);
    assert!(text(&set("votes=4", 0).stdout).contains("lift_arbiter.votes: 3 → 4"));
    let shown = set("votes", 0);
    assert!(text(&shown.stdout).contains("lift_arbiter.votes") && !text(&shown.stdout).contains("model"));
    for (argument, expected) in [
        ("vote=4", "did you mean 'votes'?"),
        ("lift_arbitr", "did you mean 'lift_arbiter'?"),
        ("lift_arbitr.votes=4", "did you mean 'lift_arbiter'?"),
    ] {
        let refused = set(argument, 1);
        assert!(text(&refused.stderr).contains(expected), "{argument}: {}", text(&refused.stderr));
    }
    // A reader that goes ends it.
    let mut command = blindgrasp();
    command.args(["echo", "--graph", &graph.name]).stdout(Stdio::piped());
    let mut child = command.spawn().expect("started");
    let mut line = String::new();
    BufReader::new(child.stdout.take().expect("stdout")).read_line(&mut line).expect("read");
    assert!(child.wait().expect("waited").success());
    graph.stop().assert_undisturbed("samples printed beside it");
}
