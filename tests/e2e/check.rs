//! A dataflow file is checked against the real operators, without starting the graph.

use crate::common::{ON_TWO_MACHINES, dataflow, fails, json_of, operator, project, run, text, unique_name};
use blindgrasp_messages::{ContactSet, GraspFeature, Prediction, Recorded, TactileFrame};
use serde_json::{Value, json};

#[test]
fn a_right_file_is_shown_with_everything_filled_in() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = dataflow(
        folder.path(),
        &[
            (
                "inputs: {prediction: classifier/prediction}",
                "inputs:\n      prediction: {from: classifier/prediction, policy: latest, deadline_ms: 50}\n    \
                 restart: never\n    heartbeat_ms: off",
            ),
            ("inputs: {feature: encoder/feature}", "inputs: {feature: encoder/feature}\n    restart: always"),
        ],
    );
    let output = run(&["run", "--check", path.to_str().expect("UTF-8")], 0);
    assert!(output.stderr.is_empty(), "{}", text(&output.stderr));
    let shown: Vec<Vec<String>> = text(&output.stdout)
        .lines()
        .map(|line| line.split("  ").map(str::trim).filter(|entry| !entry.is_empty()).map(str::to_owned).collect())
        .collect();
    let (on_failure, always) =
        ("on-failure, 5 in 60 s, backoff 10 ms".to_owned(), "always, 5 in 60 s, backoff 10 ms".to_owned());
    let node = |name: &str, restart: &str, heartbeat: &str| {
        vec![name.to_owned(), restart.to_owned(), heartbeat.to_owned(), operator(name)]
    };
    let line = |entries: &[&str]| entries.iter().map(ToString::to_string).collect::<Vec<_>>();
    assert_eq!(
        shown,
        [
            line(&["graph 'grasp_gate': 5 nodes, 4 edges"]),
            line(&[]),
            line(&["node", "restart", "heartbeat", "program"]),
            node("recorded_source", &on_failure, "2000 ms"),
            node("contacts", &on_failure, "2000 ms"),
            node("encoder", &on_failure, "2000 ms"),
            node("classifier", &always, "2000 ms"),
            node("lift_arbiter", "never", "off"),
            line(&[]),
            line(&["edge", "type", "policy", "capacity", "deadline"]),
            line(&["recorded_source/tactile → contacts/tactile", TactileFrame::TYPE_NAME, "lossless", "256", "none"]),
            line(&["contacts/contacts → encoder/contacts", ContactSet::TYPE_NAME, "lossless", "256", "none"]),
            line(&["encoder/feature → classifier/feature", GraspFeature::TYPE_NAME, "lossless", "256", "none"]),
            line(&["classifier/prediction → lift_arbiter/prediction", Prediction::TYPE_NAME, "latest", "1", "50 ms"]),
        ]
    );
}

#[test]
fn json_holds_the_graph_with_what_was_set() {
    let recording = project().join("recordings/held-out.mcap");
    let set =
        ["--set", "lift_arbiter.votes=5", "--set", "recorded_source.recording=recordings/../recordings/held-out.mcap"];
    let checked = json_of(&[&["run", "--check", "dataflow.yaml", "--json"], &set[..]].concat());
    let nodes = checked["graph"]["nodes"].as_array().expect("nodes");
    let found = nodes[0]["params"]["recording"].as_str().expect("a path");
    assert_eq!(std::path::Path::new(found).canonicalize().ok(), recording.canonicalize().ok());
    assert!(found.starts_with('/'), "{found}");
    assert_eq!(nodes[4]["params"]["votes"], 5);
    assert_eq!(nodes[4]["args"], json!(["operator", "lift_arbiter"]));
    let restart = json!({"policy": "on-failure", "limit": 5, "within_millis": 60_000, "backoff_millis": 10});
    assert_eq!(nodes[4]["restart"], restart);
    assert_eq!(nodes[4]["heartbeat_millis"], 2000);
    let edge = json!({"policy": "lossless", "capacity": 256, "deadline_millis": null, "on_late": "count"});
    assert_eq!(nodes[4]["inputs"][0]["edge"], edge);
}

#[test]
fn mistakes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = dataflow(folder.path(), &[("votes: 3", "vots: 3")]);
    let path = path.to_str().expect("UTF-8");
    let line = 1 + std::fs::read_to_string(path)
        .expect("readable")
        .lines()
        .position(|line| line.contains("vots"))
        .expect("there");
    let message = "unknown param 'vots' of node 'lift_arbiter'";
    let set_message = "there is no node 'clasifier'";
    let lines = format!(
        "{path}:{line}:7: {message}; did you mean 'votes'?\n\
         --set clasifier.model=x: {set_message}; did you mean 'classifier'?\n"
    );
    let wrong = ["run", "--check", path, "--set", "clasifier.model=x"];
    let output = run(&wrong, 1);
    assert_eq!(text(&output.stderr), lines);
    assert!(output.stdout.is_empty(), "{}", text(&output.stdout));

    let output = run(&[&wrong[..], &["--json"]].concat(), 1);
    assert_eq!(text(&output.stderr), lines);
    let errors: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(
        errors,
        json!({"errors": [
            {"line": line, "column": 7, "set": null, "message": message, "help": "did you mean 'votes'?"},
            {"line": null, "column": null, "set": "clasifier.model=x", "message": set_message,
             "help": "did you mean 'classifier'?"},
        ]})
    );

    let output = run(&["run", "--check", "absent.yaml", "--json"], 1);
    let errors: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(errors["errors"][0]["line"], Value::Null);
    assert!(errors["errors"][0]["message"].as_str().is_some_and(|message| message.contains("cannot read the file")));

    let output = run(&["run", "--check", "--set", "votes"], 2);
    assert!(text(&output.stderr).contains("expected node.param=value"), "{}", text(&output.stderr));
}

#[test]
fn arguments_come_before_describe() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let param = r#"{"name": "a", "kind": "string", "default": "'$1,$2'"}"#;
    let description = format!(r#"{{"protocol": 5, "operator": "own", "version": "1", "params": [{param}]}}"#);
    let script = format!("[ \"$#,$3\" = 3,--describe ] && echo '{description}'\n");
    std::fs::write(at("own.sh"), script).expect("written");
    let path = at("dataflow.yaml");
    let write = |args: &str| {
        let yaml =
            format!("version: 1\nname: g\noperators: {{own: {{run: /bin/sh, args: [{}, {args}]}}}}\n", at("own.sh"));
        std::fs::write(&path, yaml).expect("written");
    };
    write("--fast, 'x y'");
    let output = run(&["run", "--check", &path, "--json"], 0);
    let checked: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(checked["graph"]["nodes"][0]["params"]["a"], "--fast,x y");
    let output = run(&["run", "--check", &path], 0);
    let shown = text(&output.stdout);
    assert!(shown.ends_with(&format!("  /bin/sh {} --fast \"x y\"\n", at("own.sh"))), "{shown}");
    write("--fast");
    let output = run(&["run", "--check", &path], 1);
    let shown = text(&output.stderr);
    for part in ["program '/bin/sh' with the arguments '", "cannot be used: it failed at --describe"] {
        assert!(shown.contains(part), "{shown}");
    }
}

#[test]
fn machines_and_the_edges_between_them_are_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = dataflow(folder.path(), &ON_TWO_MACHINES);
    let path = path.to_str().expect("UTF-8");
    let shown = text(&run(&["run", "--check", path], 0).stdout);
    let lines: Vec<Vec<&str>> =
        shown.lines().map(|line| line.split("  ").map(str::trim).filter(|entry| !entry.is_empty()).collect()).collect();
    for expected in [
        &["graph 'grasp_gate': 5 nodes, 4 edges, 2 machines, 2 edges between them"][..],
        &["machine", "listens at"],
        &["robot", "-"],
        &["brain", "unix/gate"],
        &["link: cut off after 150 ms, buffer 8192 samples"],
        &["node", "machine", "restart", "heartbeat", "program"],
        &["edge", "over Zenoh", "type", "policy", "capacity", "deadline"],
        &["recorded_source/tactile → contacts/tactile", "-", TactileFrame::TYPE_NAME, "lossless", "256", "none"],
        &["contacts/contacts → encoder/contacts", "robot → brain", ContactSet::TYPE_NAME, "lossless", "256", "none"],
        &[
            "classifier/prediction → lift_arbiter/prediction",
            "brain → robot",
            Prediction::TYPE_NAME,
            "lossless",
            "256",
            "none",
        ],
    ] {
        assert!(lines.iter().any(|line| line == expected), "no {expected:?} in\n{shown}");
    }
    let node = |name: &str| lines.iter().find(|line| line.first() == Some(&name)).map(|line| line[1]);
    assert_eq!((node("contacts"), node("classifier")), (Some("robot"), Some("brain")));

    let checked = json_of(&["run", "--check", path, "--json"]);
    assert_eq!(checked["graph"]["nodes"][2]["machine"], "brain");
    assert_eq!(checked["graph"]["machines"]["machines"][1]["listen"], json!(["unix/gate"]));
    let crossing = json!([
        {"from": "contacts/contacts", "to": "encoder/contacts", "from_machine": "robot", "to_machine": "brain",
         "type_name": ContactSet::TYPE_NAME},
        {"from": "classifier/prediction", "to": "lift_arbiter/prediction", "from_machine": "brain",
         "to_machine": "robot", "type_name": Prediction::TYPE_NAME},
    ]);
    assert_eq!(checked["crossing"], crossing);
    let whole = json_of(&["run", "--check", "--json"]);
    assert_eq!((&whole["crossing"], &whole["graph"]["machines"]), (&Value::Null, &Value::Null));
}

#[test]
fn a_machine_needs_no_files_of_the_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let replace = [
        &ON_TWO_MACHINES[..],
        &[
            ("models/barrett-bh8-280.json", "/on/the/brain.json"),
            ("  classifier:\n", "  classifier:\n    run: ./brain/own\n"),
        ],
    ]
    .concat();
    let path = dataflow(folder.path(), &replace);
    let path = path.to_str().expect("UTF-8");
    let refused = text(&run(&["run", "--check", path], 1).stderr);
    assert!(
        refused.contains("brain/own' cannot be used") && refused.contains("'/on/the/brain.json' does not exist"),
        "{refused}"
    );
    run(&["run", "--check", path, "--machine", "brain"], 1);
    let shown = text(&run(&["run", "--check", path, "--machine", "robot"], 0).stdout);
    let of_type = format!("classifier/prediction → lift_arbiter/prediction  brain → robot  {}", Prediction::TYPE_NAME);
    assert!(shown.contains(&of_type), "{shown}");
    let refused = run(&["run", "--check", path, "--machine", "robot", "--set", "classifier.model=x"], 1);
    let refused = text(&refused.stderr);
    assert!(refused.contains("node 'classifier' runs on machine 'brain'; give --set there"), "{refused}");
    let refused = text(&run(&["run", "--check", path, "--machine", "brian"], 1).stderr);
    assert!(refused.contains("there is no machine 'brian'; did you mean 'brain'?"), "{refused}");
}

#[test]
fn a_graph_that_could_never_lift_is_refused() {
    let probe = ["--set", "lift_arbiter.probe=test_lift"];
    let expected = "node 'lift_arbiter': probe is test_lift, and the model of node 'classifier'";
    let shown = run(&[&["run", "dataflow.yaml", "--check", "--json"], &probe[..]].concat(), 1);
    let errors: Value = serde_json::from_slice(&shown.stdout).expect("JSON");
    let error = &errors["errors"][0];
    assert!(error["message"].as_str().is_some_and(|message| message.starts_with(expected)), "{errors}");
    assert!(error["line"].as_u64() > Some(10) && error["help"].as_str().is_some(), "{errors}");
    let name = unique_name();
    fails(&[&["run", "dataflow.yaml", "--name", &name], &probe[..]].concat(), expected);
    let warned = run(&[&["run", "dataflow.yaml", "--check", "--allow-mismatch"], &probe[..]].concat(), 0);
    assert!(text(&warned.stderr).contains(expected), "{}", text(&warned.stderr));
    let warned = run(&[&["replay", "recordings/ordinary.mcap", "--name", &name], &probe[..]].concat(), 0);
    assert!(text(&warned.stderr).contains(expected), "{}", text(&warned.stderr));
}

/// `run` fails with these when the operator begins; a check finds them in the same words and starts nothing.
#[test]
fn files_that_an_operator_could_not_begin_with_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[]);
    let broken = folder.path().join("broken");
    std::fs::write(&broken, "no file of this kind").expect("written");
    let broken = broken.to_str().expect("UTF-8");
    let flow = flow.to_str().expect("UTF-8");
    crate::common::run(&["run", "--check", flow], 0);
    for (node, setting) in [
        ("recorded_source", format!("recorded_source.recording={broken}")),
        ("recorded_source", "recorded_source.repeat=1.5".to_owned()),
        ("contacts", format!("contacts.hand={broken}")),
        ("encoder", format!("encoder.model={broken}")),
        ("classifier", format!("classifier.model={broken}")),
    ] {
        let output = crate::common::run(&["run", "--check", flow, "--set", &setting], 1);
        let said = crate::common::text(&output.stderr);
        assert!(said.contains(&format!("node '{node}': ")), "{setting}: {said}");
    }
}
