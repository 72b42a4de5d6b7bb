//! The main job through the real processes: its decisions, its remains, its ends.

use std::collections::BTreeMap;

use crate::common::{
    Graph, HAND, MODEL, NODES, RECORDING, REPORTS, assert_nothing_left, classifier_runs, dataflow, fails, json_lines,
    json_of, paper_model, run, script, signal, stubborn_classifier, text, unique_name,
};
use rustix::process::Signal;
use serde_json::Value;

fn f(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("not a number: {value}"))
}

fn floats(value: &Value) -> Vec<f64> {
    value.as_array().unwrap_or_else(|| panic!("not an array: {value}")).iter().map(f).collect()
}

fn without_latency(mut lines: Vec<Value>) -> Vec<Value> {
    lines.retain(|line| line.get("summary").is_none());
    for line in &mut lines {
        line.as_object_mut().expect("an object").remove("latency_nanos");
        line.as_object_mut().expect("an object").remove("valid_until_nanos");
    }
    lines
}

#[test]
fn five_processes_decide_every_grasp_and_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max")]);
    let name = unique_name();
    let output = run(&["run", "--json", "--name", &name, flow.to_str().expect("UTF-8")], 0);
    assert_nothing_left(&name);
    let lines = json_lines(&output.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    assert_eq!(summary["end"], "finished");
    assert_eq!(summary["samples_lost"], 0);
    let pids: std::collections::BTreeSet<u64> = summary["operators"]
        .as_array()
        .expect("operators")
        .iter()
        .map(|node| node["pid"].as_u64().expect("a pid"))
        .collect();
    assert_eq!(pids.len(), 5);
    for edge in summary["edges"].as_array().expect("edges") {
        assert_eq!(edge["sent"], edge["received"], "{edge}");
        assert!(edge["sent"].as_u64() > Some(0), "{edge}");
        assert_eq!((&edge["missing"], &edge["repeated"]), (&0.into(), &0.into()), "{edge}");
    }
    assert!(summary["grasps"].as_u64() >= Some(200));
    assert_eq!(summary["grasps"], summary["with_truth"]);
    assert!(
        f(&summary["accuracy"]) > f(&summary["majority_class"]) + 0.15,
        "accuracy {} against a majority class of {}",
        summary["accuracy"],
        summary["majority_class"]
    );

    // The same stages offline come to the same result.
    let evaluation = json_of(&["evaluate", MODEL, RECORDING, "--json"]);
    assert_eq!(summary["accuracy"], evaluation["score"]["accuracy"]);
    assert_eq!(summary["lift"], evaluation["score"]["n_lift"]);
    assert_eq!(summary["false_positives"], evaluation["score"]["n_false_positive"]);
    assert_eq!(summary["reasons"], evaluation["by_reason"]);

    // The same processes decide the same again.
    let again = run(&["run", "--json", "--name", &unique_name(), flow.to_str().expect("UTF-8")], 0);
    assert_eq!(without_latency(lines), without_latency(json_lines(&again.stdout)));
}

/// Recomputes every edge from the one before it with formulas written anew, from what `export`, `info HAND` and
/// `model show` say and the model file's support vectors.
#[test]
fn every_edge_can_be_recomputed_from_outside() {
    let folder = tempfile::tempdir().expect("a folder");
    let model_path = paper_model().to_str().expect("UTF-8");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max"), (MODEL, model_path)]);
    let recording = folder.path().join("run.mcap");
    let recording = recording.to_str().expect("UTF-8");
    run(&["run", "--json", "--name", &unique_name(), "--record", recording, flow.to_str().expect("UTF-8")], 0);
    let mut edges: BTreeMap<String, Vec<Value>> = BTreeMap::new();
    for line in json_lines(&run(&["export", recording], 0).stdout) {
        edges.entry(line["topic"].as_str().expect("a topic").into()).or_default().push(line);
    }
    let n_frames = edges["/tactile"].len();
    for topic in ["/contacts", "/feature", "/prediction"] {
        assert_eq!(edges[topic].len(), n_frames, "{topic}");
    }
    let shown = json_of(&["model", "show", model_path, "--json"]);
    let model: Value = serde_json::from_str(&std::fs::read_to_string(model_path).expect("a model")).expect("JSON");
    let svm = &model["classifier"]["predictor"]["svm"];
    let (sigma, gamma, rho) = (f(&shown["sigma_m"]), f(&shown["predictor"]["gamma"]), f(&shown["predictor"]["rho"]));
    let words: Vec<Vec<f64>> = shown["dictionary_m"].as_array().expect("words").iter().map(floats).collect();
    let (coefficients, vectors) = (floats(&svm["dual_coefficients"]), floats(&svm["support_vectors"]));
    let (a, b) = (f(&shown["calibration"]["a"]), f(&shown["calibration"]["b"]));
    let threshold = f(&shown["threshold_probability"]);

    let mut n_checked = 0;
    let mut before = Before::default();
    let mut settled: BTreeMap<u64, Vec<&Value>> = BTreeMap::new();
    for (idx, tactile) in edges["/tactile"].iter().enumerate() {
        let sample = |topic: &str| &edges[topic][idx];
        let seq = &tactile["seq"];
        for topic in ["/contacts", "/feature", "/prediction"] {
            assert_eq!(&sample(topic)["seq"], seq, "{topic}");
            for field in ["grasp_id", "phase"] {
                assert_eq!(sample(topic)["data"][field], tactile["data"][field], "{topic} {field}");
            }
        }
        let contacts = sample("/contacts")["data"]["contacts"].as_array().expect("contacts");
        let forces = steady(&tactile["data"], &mut before);
        check_contacts(&tactile["data"], &forces, &sample("/contacts")["data"], idx % 97 == 0);
        let prediction = &sample("/prediction")["data"];
        if prediction["phase"] == "settled" {
            settled.entry(prediction["grasp_id"].as_u64().expect("an id")).or_default().push(prediction);
        }
        if contacts.is_empty() {
            assert_eq!(sample("/feature")["data"]["values"], Value::Array(vec![]));
            assert_eq!((&prediction["stable"], &prediction["probability_stable"]), (&false.into(), &0.0.into()));
            continue;
        }
        let mut pad_newtons: BTreeMap<u64, f64> = BTreeMap::new();
        for contact in contacts {
            *pad_newtons.entry(contact["pad"].as_u64().expect("a pad")).or_default() += f(&contact["force_newtons"]);
        }
        let expected: Vec<f64> = words
            .iter()
            .map(|word| {
                let sum: f64 = contacts
                    .iter()
                    .map(|contact| {
                        let at = floats(&contact["position_m"]);
                        let squared: f64 = (0..3).map(|axis| (at[axis] - word[axis]).powi(2)).sum();
                        let share =
                            f(&contact["force_newtons"]) / pad_newtons[&contact["pad"].as_u64().expect("a pad")];
                        (-squared / (sigma * sigma)).exp() * share
                    })
                    .sum();
                sum / pad_newtons.len() as f64
            })
            .collect();
        let values = floats(&sample("/feature")["data"]["values"]);
        assert!(expected.iter().zip(&values).all(|(expected, value)| (expected - value).abs() < 1e-12), "seq {seq}");
        let decision_value: f64 = coefficients
            .iter()
            .zip(vectors.chunks(values.len()))
            .map(|(coefficient, vector)| {
                let squared: f64 = vector.iter().zip(&values).map(|(v, x)| (v - x).powi(2)).sum();
                coefficient * (-gamma * squared).exp()
            })
            .sum::<f64>()
            - rho;
        assert!((decision_value - f(&prediction["decision_value"])).abs() < 1e-9, "seq {seq}");
        let probability = 1.0 / (1.0 + (a * decision_value + b).exp());
        assert!((probability - f(&prediction["probability_stable"])).abs() < 1e-9, "seq {seq}");
        assert_eq!(prediction["stable"], f(&prediction["probability_stable"]) >= threshold, "seq {seq}");
        n_checked += 1;
    }
    assert!(n_checked > 1000, "only {n_checked} frames with contact");
    let decisions = &edges["/decision"];
    assert_eq!(decisions.len(), settled.len());
    for decision in decisions {
        let data = &decision["data"];
        let votes = &settled[&data["grasp_id"].as_u64().expect("an id")];
        let expected = expected_action(votes);
        assert_eq!((data["action"].as_str(), data["reason"].as_str()), (Some(expected.0), Some(expected.1)), "{data}");
    }
}

/// A grasp's phase and the cells of its frames so far, 0 where they feel nothing.
type Before = (Option<(u64, String)>, Vec<Vec<f64>>);

/// The forces of a frame's cells, each the median of three frames of the phase, or the smaller one of the first two.
fn steady(frame: &Value, before: &mut Before) -> Vec<f64> {
    let cells = floats(&frame["cells_newtons"]);
    let place = Some((frame["grasp_id"].as_u64().expect("an id"), frame["phase"].as_str().expect("a phase").into()));
    if before.0 != place {
        *before = (place, Vec::new());
    }
    let felt: Vec<f64> = cells.iter().map(|force| if *force > 0.05 { *force } else { 0.0 }).collect();
    let is_empty = felt.iter().all(|force| *force == 0.0);
    let of_cell = |idx: usize, force: &f64| match before.1.as_slice() {
        _ if is_empty => *force,
        [] => *force,
        [last] => force.min(last[idx]),
        [.., earlier, last] => {
            let mut forces = [*force, last[idx], earlier[idx]];
            forces.sort_by(f64::total_cmp);
            forces[1]
        }
    };
    let steady = cells.iter().enumerate().map(|(idx, force)| of_cell(idx, force)).collect();
    before.1.push(felt);
    steady
}

/// The contacts are the cells of which `forces` are above 0.05 N, in order, but for those that feel another link; where
/// `positions` is set, they are where `info HAND` says.
fn check_contacts(frame: &Value, forces: &[f64], set: &Value, positions: bool) {
    let contacts = set["contacts"].as_array().expect("contacts");
    let n_active = forces.iter().filter(|force| **force > 0.05).count();
    let n_self_contacts = set["n_self_contacts"].as_u64().expect("a count") as usize;
    assert_eq!(n_active, contacts.len() + n_self_contacts);
    assert!(n_self_contacts == 0 || set["self_collision"] == true);
    let cell_idx = |contact: &Value| {
        (contact["pad"].as_u64().expect("a pad") * 24 + contact["cell"].as_u64().expect("a cell")) as usize
    };
    let active: Vec<usize> = contacts.iter().map(cell_idx).collect();
    assert!(active.is_sorted_by(|a, b| a < b));
    for (idx, contact) in active.iter().zip(contacts) {
        assert!(forces[*idx] > 0.05);
        assert_eq!(f(&contact["force_newtons"]), forces[*idx]);
    }
    if !positions {
        return;
    }
    let names = ["spread", "finger_1", "finger_2", "finger_3", "distal_1", "distal_2", "distal_3"];
    let joints: Vec<String> =
        names.iter().zip(floats(&frame["joints"])).map(|(name, value)| format!("{name}={value}")).collect();
    let cells = json_of(&["info", HAND, "--json", "--joints", &joints.join(",")]);
    for (idx, contact) in active.iter().zip(contacts) {
        for field in ["position_m", "normal"] {
            let expected = floats(&cells[*idx][field]);
            assert!(expected.iter().zip(floats(&contact[field])).all(|(a, b)| (a - b).abs() < 1e-12));
        }
    }
}

/// Three consecutive settled predictions that agree decide; a fault holds at once.
fn expected_action(votes: &[&Value]) -> (&'static str, &'static str) {
    let mut run_length = (false, 0);
    for vote in votes {
        match vote["fault"].as_str() {
            Some("none") => {}
            Some("no_contact") => return ("hold", "no_contact"),
            other => panic!("unexpected fault {other:?}"),
        }
        let stable = vote["stable"] == true;
        run_length = if run_length.1 > 0 && run_length.0 == stable { (stable, run_length.1 + 1) } else { (stable, 1) };
        match run_length {
            (true, 3) => return ("lift", "stable"),
            (false, 3) => return ("hold", "unstable"),
            _ => {}
        }
    }
    ("hold", "no_agreement")
}

#[test]
fn ctrl_c_stops_cleanly_with_a_summary() {
    let folder = tempfile::tempdir().expect("a folder");
    let graph = Graph::start(&dataflow(folder.path(), &[("rate: 10", "rate: 1")]), &[]);
    signal(graph.pid(), Signal::INT);
    let ended = graph.finish();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert_eq!((&ended.summary["end"], &ended.summary["samples_lost"]), (&"stopped".into(), &0.into()));
}

#[test]
fn a_killed_operator_fails_the_run_by_name_and_the_open_grasp_is_held() {
    for node in NODES {
        let folder = tempfile::tempdir().expect("a folder");
        // With so many votes a grasp is decided when the next one begins: after a first decision, one is always open.
        let flow = dataflow(folder.path(), &[("rate: 10", "rate: 1"), ("votes: 3", "votes: 1000")]);
        let text = std::fs::read_to_string(&flow).expect("read");
        let never = text.replace(&format!("  {node}:\n"), &format!("  {node}:\n    restart: never\n"));
        assert_ne!(text, never);
        std::fs::write(&flow, never).expect("written");
        let graph = Graph::start(&flow, &[]);
        let first = &graph.lines()[0];
        assert_eq!((&first["grasp_id"], &first["reason"]), (&0.into(), &"no_agreement".into()), "{first}");
        signal(graph.pid_of(node), Signal::KILL);
        let ended = graph.finish();
        assert_eq!(ended.code, Some(1), "{node}: {}", ended.stderr);
        assert!(ended.stderr.contains(&format!("node '{node}'")), "{node}: {}", ended.stderr);
        assert_eq!(ended.summary["end"], "failed", "{node}");
        if node != "lift_arbiter" {
            let open = ended.decisions.iter().find(|line| line["grasp_id"] == 1);
            let open = open.expect("a decision for the open grasp");
            assert_eq!(open["action"], "hold", "{node}: {open}");
        }
    }
}

/// A classifier that calls everything stable, and lets one sample fall under the table or answers it with nonsense:
/// that grasp is held, the others are lifted, and the loss is told.
#[test]
fn a_skipped_or_garbled_prediction_holds_its_grasp_and_is_counted() {
    let program = stubborn_classifier();
    // Sample 0 is the first of all; 76 is the settled grasp 5's.
    for (param, seq, grasp_id, reason, code) in [
        ("skip_seq", 0, 0, "out_of_order", 3),
        ("skip_seq", 76, 5, "out_of_order", 3),
        ("garble_seq", 0, 0, "invalid", 0),
        ("garble_seq", 76, 5, "invalid", 0),
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        let (whole, stubborn) = classifier_runs(&program, &format!("{{{param}: {seq}}}"));
        let flow = dataflow(folder.path(), &[("rate: 10", "rate: max"), (&whole, &stubborn)]);
        let output = run(&["run", "--json", "--name", &unique_name(), flow.to_str().expect("UTF-8")], code);
        let lines = json_lines(&output.stdout);
        let summary = &lines.last().expect("a summary")["summary"];
        assert_eq!((&summary["grasps"], &summary["undecided"]), (&240.into(), &0.into()), "{param} {seq}");
        assert_eq!(summary["samples_lost"], u64::from(code == 3), "{param} {seq}");
        for line in &lines[..lines.len() - 1] {
            let expected = if line["grasp_id"] == grasp_id { reason } else { "stable" };
            // It passes on the faults of the stages before it.
            let passed_on = line["reason"] == "no_contact" || line["reason"] == "out_of_distribution";
            assert!(line["reason"] == expected || passed_on, "{param} {seq}: {line}");
        }
        let held = lines.iter().find(|line| line["grasp_id"] == grasp_id).expect("a decision");
        assert_eq!((&held["action"], &held["reason"]), (&"hold".into(), &reason.into()), "{param} {seq}");
    }
}

#[test]
fn a_source_that_another_program_stops_fails_the_run() {
    let folder = tempfile::tempdir().expect("a folder");
    let never = ("  recorded_source:\n", "  recorded_source:\n    restart: never\n");
    let graph = Graph::start(&dataflow(folder.path(), &[("rate: 10", "rate: 1"), never]), &[]);
    signal(graph.pid_of("recorded_source"), Signal::TERM);
    let ended = graph.finish();
    assert_eq!(ended.code, Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains("'recorded_source' was stopped from outside"), "{}", ended.stderr);
    assert_eq!(ended.summary["end"], "failed");
}

/// A foreign operator: it opens no port, says that it is ready, and floods its output.
#[test]
fn a_foreign_operator_that_floods_its_output_can_be_stopped() {
    let folder = tempfile::tempdir().expect("a folder");
    script(
        folder.path(),
        "flood.sh",
        &format!(
            "if [ \"$1\" = --describe ]; then echo '{{\"protocol\":5,\"operator\":\"flood\",\"version\":\"1\"}}'; exit; fi\n\
             echo '{{\"report\":\"ready\"}}' >{REPORTS}\nexec yes flood"
        ),
    );
    let flow = folder.path().join("flow.yaml");
    std::fs::write(&flow, "version: 1\nname: flood\noperators:\n  flood: {run: ./flood.sh}\n").expect("written");
    let name = unique_name();
    let mut child = crate::common::blindgrasp()
        .args(["run", "--name", &name])
        .arg(&flow)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .expect("started");
    crate::common::wait_until(
        || crate::common::left_overs(&name).iter().any(|left| left.starts_with("process")),
        || "no start".into(),
    );
    signal(child.id() as i32, Signal::INT);
    // `yes` sends no reports and has no ports, so that nothing is lost. It ends by SIGTERM.
    assert_eq!(child.wait().expect("waited").code(), Some(0));
    assert_nothing_left(&name);
}

#[test]
fn a_recording_cut_in_the_middle_is_refused_before_anything_is_decided() {
    let folder = tempfile::tempdir().expect("a folder");
    let whole = std::fs::read(crate::common::project().join(RECORDING)).expect("a recording");
    let cut = folder.path().join("cut.mcap");
    std::fs::write(&cut, &whole[..whole.len() / 2]).expect("written");
    let replaced = cut.to_str().expect("UTF-8").to_string();
    let flow = dataflow(folder.path(), &[(RECORDING, &replaced)]);
    let name = unique_name();
    let output = run(&["run", "--json", "--name", &name, flow.to_str().expect("UTF-8")], 1);
    let stderr = text(&output.stderr);
    assert!(stderr.contains("cut.mcap") && stderr.contains("cut off"), "{stderr}");
    assert!(json_lines(&output.stdout).iter().all(|line| line.get("action").is_none()));
    assert_nothing_left(&name);
}

/// The encoder and the classifier have different models: every grasp is held for that reason.
#[test]
fn a_feature_of_another_model_never_lifts() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = folder.path().join("other.json").to_str().expect("UTF-8").to_string();
    run(&["train", RECORDING, "--out", &model], 0);
    let both = "inputs: {contacts: contacts/contacts}\n";
    let split = format!("{both}    params: {{model: {model}}}\n");
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max"), (both, &split)]);
    let flow = flow.to_str().expect("UTF-8");
    let refused = run(&["run", "--name", &unique_name(), flow], 1);
    assert!(
        text(&refused.stderr).contains("judges other features than node 'encoder' makes"),
        "{}",
        text(&refused.stderr)
    );
    let output = run(&["run", "--allow-mismatch", "--json", "--name", &unique_name(), flow], 0);
    let summary = json_lines(&output.stdout).pop().expect("a summary")["summary"].clone();
    assert_eq!((&summary["lift"], &summary["reasons"]["wrong_model"]), (&0.into(), &240.into()), "{summary}");
}

/// The model is of another hand: every grasp is held for that reason.
#[test]
fn a_model_of_another_hand_never_lifts() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let layout = std::fs::read_to_string(crate::common::project().join(HAND)).expect("a layout");
    std::fs::write(at("other.yaml"), layout.replace("at_m: [0.022, 0.0159, 0]", "at_m: [0.021, 0.0159, 0]"))
        .expect("written");
    std::fs::copy(crate::common::project().join("hands/barrett-bh8-280.urdf"), at("barrett-bh8-280.urdf"))
        .expect("copied");
    let (hand, recording, model) = (at("other.yaml"), at("other.mcap"), at("other.json"));
    run(&["simulate", "--hand", &hand, "--objects", "box,mug", "--grasps", "120", "--out", &recording], 0);
    run(&["train", &recording, "--hand", &hand, "--words", "8", "--out", &model], 0);
    let flow = dataflow(folder.path(), &[("rate: 10", "rate: max"), (MODEL, &model)]);
    let flow = flow.to_str().expect("UTF-8");
    fails(&["run", "--name", &unique_name(), flow], "is not the one that the model of node");
    let output = run(&["run", "--allow-mismatch", "--json", "--name", &unique_name(), flow], 0);
    let lines = json_lines(&output.stdout);
    let summary = &lines.last().expect("a summary")["summary"];
    assert_eq!((&summary["lift"], &summary["hold"]), (&0.into(), &240.into()));
    assert_eq!(summary["reasons"], serde_json::json!({ "wrong_hand": 240 }));
    fails(&["evaluate", &model, RECORDING], "hand");
}
