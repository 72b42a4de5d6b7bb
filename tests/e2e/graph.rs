//! `blindgrasp view` of graphs, as a user runs it.

use crate::common::{ON_TWO_MACHINES, blindgrasp, dataflow, fails, run, script, text, unique_name};
use serde_json::Value;

fn drawn(arguments: &[&str]) -> String {
    text(&run(&[&["view"], arguments].concat(), 0).stdout)
}

fn json(arguments: &[&str]) -> Value {
    serde_json::from_str(&drawn(&[arguments, &["--json"]].concat())).expect("JSON")
}

#[test]
fn the_default_graph_as_mermaid() {
    let expected = r#"---
title: "grasp_gate"
---
flowchart LR
  n0["recorded_source"]
  n1["contacts"]
  n2["encoder"]
  n3["classifier"]
  n4["lift_arbiter"]
  n5(["run"])
  n0 -->|"tactile<br/>TactileFrame/5"| n1
  n1 -->|"contacts<br/>ContactSet/7"| n2
  n2 -->|"feature<br/>GraspFeature/4"| n3
  n3 -->|"prediction<br/>Prediction/4"| n4
  n0 -->|"truth<br/>GraspTruth/2"| n5
  n4 -->|"decision<br/>LiftDecision/3"| n5
"#;
    assert_eq!(drawn(&["--format", "mermaid"]), expected);
}

/// Graphviz lays out pictures. A program of its name that prints its input stands for it.
#[test]
fn the_default_graph_as_svg_is_laid_out_by_graphviz() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("graph.svg");
    let view = |path: &std::path::Path| {
        let mut command = blindgrasp();
        command.env("PATH", path).args(["view", "--out"]).arg(&out).output().expect("started")
    };
    let refused = view(&folder.path().join("empty"));
    assert_eq!(refused.status.code(), Some(1));
    assert!(text(&refused.stderr).contains("install Graphviz"), "{}", text(&refused.stderr));
    script(folder.path(), "dot", "echo \"drawn with $1\"\nexec /bin/cat\n");
    let drawn_there = view(folder.path());
    assert!(drawn_there.status.success(), "{}", text(&drawn_there.stderr));
    let svg = std::fs::read_to_string(&out).expect("written");
    assert!(svg.starts_with("drawn with -Tsvg\ndigraph \"grasp_gate\" {"), "{svg}");
    script(folder.path(), "dot", "/bin/cat >/dev/null\nexit 7\n");
    let failed = view(folder.path());
    assert!(text(&failed.stderr).contains("'dot' failed to draw"), "{}", text(&failed.stderr));
    // The ending of the file's name sets the format. Other endings are refused.
    let text_file = folder.path().join("graph.dot");
    drawn(&["--out", text_file.to_str().expect("UTF-8")]);
    assert!(std::fs::read_to_string(text_file).expect("written").starts_with("digraph"));
    let unknown = folder.path().join("graph.png");
    fails(&["view", "--out", unknown.to_str().expect("UTF-8")], ".svg, .mmd or .dot");
    run(&["view", "--out", "dataflow.yaml", "--format", "dot"], 1);
}

#[test]
fn settings_other_than_the_defaults_are_drawn() {
    let folder = tempfile::tempdir().expect("a folder");
    let replace = [
        ("  contacts:\n", "  contacts:\n    restart: never\n    heartbeat_ms: off\n"),
        (
            "{prediction: classifier/prediction}",
            "{prediction: {from: classifier/prediction, policy: latest, capacity: 4, deadline_ms: 50}}",
        ),
    ];
    let file = dataflow(folder.path(), &replace);
    let file = file.to_str().expect("UTF-8");
    let found = drawn(&[file, "--format", "mermaid"]);
    assert!(found.contains("n1[\"contacts<br/>restart: never<br/>heartbeat: off\"]"), "{found}");
    assert!(found.contains("n3 -.->|\"prediction<br/>Prediction/4<br/>latest 4<br/>within 50 ms\"| n4"), "{found}");
    let json = json(&[file]);
    let edge = &json["edges"][3];
    assert_eq!((&edge["policy"], &edge["capacity"]), (&Value::from("latest"), &Value::from(4)));
    assert_eq!(edge["deadline_millis"], 50.0);
    assert_eq!(
        (&json["nodes"][1]["restart"]["policy"], &json["nodes"][1]["heartbeat_millis"]),
        (&"never".into(), &Value::Null)
    );
}

#[test]
fn mistakes_are_reported_as_by_check() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = dataflow(folder.path(), &[("votes", "vots")]);
    let file = file.to_str().expect("UTF-8");
    let graph = text(&run(&["view", file], 1).stderr);
    let check = text(&run(&["run", "--check", file], 1).stderr);
    assert_eq!(graph, check);
    assert!(graph.contains("did you mean 'votes'?"), "{graph}");
    let name = unique_name();
    fails(&["view", &name], &format!("no graph '{name}' is running"));
    let refused = text(&run(&["view", &name, "--json"], 2).stderr);
    assert!(refused.contains("for a dataflow file") && refused.contains("blindgrasp ps --json"), "{refused}");
}

#[test]
fn machines_are_drawn_as_frames_and_crossing_edges_as_zenoh() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = dataflow(folder.path(), &ON_TWO_MACHINES);
    let file = file.to_str().expect("UTF-8");
    let expected = r#"---
title: "grasp_gate"
---
flowchart LR
  subgraph g0["robot"]
    n0["recorded_source"]
    n1["contacts"]
    n4["lift_arbiter"]
    n5(["run"])
  end
  subgraph g1["brain<br/>listens at unix/gate"]
    n2["encoder"]
    n3["classifier"]
  end
  n0 -->|"tactile<br/>TactileFrame/5"| n1
  n1 -.->|"contacts<br/>ContactSet/7<br/>Zenoh"| n2
  n2 -->|"feature<br/>GraspFeature/4"| n3
  n3 -.->|"prediction<br/>Prediction/4<br/>Zenoh"| n4
  n0 -->|"truth<br/>GraspTruth/2"| n5
  n4 -->|"decision<br/>LiftDecision/3"| n5
  linkStyle 1 stroke:#7a4fb5,color:#7a4fb5
  linkStyle 3 stroke:#7a4fb5,color:#7a4fb5
  style g0 fill:#f5f8ef,stroke:#a9bf86
  style g1 fill:#fbf5ea,stroke:#d9b878
"#;
    assert_eq!(drawn(&[file, "--format", "mermaid"]), expected);
    let dot = drawn(&[file, "--format", "dot"]);
    assert!(dot.contains("subgraph cluster_1 {\n    label=\"brain\\nlistens at unix/gate\";"), "{dot}");
    let json = json(&[file]);
    assert_eq!(
        (&json["nodes"][2]["machine"], &json["edges"][1]["crossing"]),
        (&"brain".into(), &serde_json::json!(["robot", "brain"]))
    );
    assert_eq!(json["edges"][0]["crossing"], Value::Null);
    run(&["view", file, "--machine", "robot"], 0);
    run(&["view", file, "--machine", "rebot"], 1);
}
