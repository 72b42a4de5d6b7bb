//! A model learns from the lifts of the robot that it runs on: outcomes are labels, correct a model, and correct a running graph.

use std::path::Path;
use std::process::Stdio;

use crate::common::live::{PATIENT, changed, grasps, listening};
use crate::common::python::utf8;
use crate::common::{
    Graph, HAND, MODEL, RECORDING, blindgrasp, dataflow, fails, json_lines, json_of, project, run, signal, text,
    wait_until,
};
use crate::import::pincer;
use blindgrasp_learning::training::{Examples, adapt_on};
use blindgrasp_messages::{Header, Phase, Stamped, TactileFrame};
use blindgrasp_stages::label::Label;
use blindgrasp_stages::own_lifts::Adapt;
use blindgrasp_stages::{Hand, Judge, Model};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

/// The lines of a bridge: grasps of a pincer that holds an object the likelier, the more force there is on the first cell.
/// `drops` is the part of the objects that fall although they should not. Each object is lifted five times.
fn bridge_lines(seed: u64, n_grasps: u64, drops: f64, names_objects: bool) -> String {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut lines, mut seq) = (String::new(), 0_u64);
    for grasp_id in 0..n_grasps {
        let force: f64 = random.random_range(0.1..4.0);
        let is_kept = random.random::<f64>() < (1.0 - drops) / (1.0 + (-3.0 * (force - 2.0)).exp());
        let cells = [force, random.random_range(0.1..1.0), random.random_range(0.1..1.0)];
        let outcome = if is_kept { "kept" } else { "dropped" };
        for phase in ["open", "settled", "settled", "settled", outcome] {
            let mut line = json!({"joints": [0.5, 0.0], "cells_newtons": cells, "phase": phase, "grasp_id": grasp_id,
                "seq": seq, "stamp_nanos": 10_000_000 * seq, "gravity_m_per_s2": [0, 0, -9.81]});
            if names_objects {
                line["object"] = json!(format!("thing-{}", grasp_id / 5));
            }
            lines += &format!("{line}\n");
            seq += 1;
        }
    }
    lines
}

#[test]
fn the_outcomes_of_a_bridge_are_labels_and_correct_a_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| utf8(&folder.path().join(name)).to_string();
    let hand = pincer(folder.path());
    let imported = |name: &str, lines: &str, code: i32| {
        let (file, out) = (at(&format!("{name}.jsonl")), at(&format!("{name}.mcap")));
        std::fs::write(&file, lines).expect("written");
        let output = run(&["import", "--lines", &file, "--hand", &hand, "--json", "--out", &out], code);
        (out, output)
    };
    let (known, output) = imported("known", &bridge_lines(1, 600, 0.0, true), 0);
    let report: Value = serde_json::from_slice(&output.stdout).expect("a report");
    assert_eq!(
        (&report["n_grasps"], &report["n_frames"], &report["n_objects"]),
        (&json!(600), &json!(3000), &json!(120))
    );
    assert_eq!(report["senses"], json!(["gravity_m_per_s2"]));
    assert_eq!(report["n_kept"].as_u64().zip(report["n_dropped"].as_u64()).map(|(a, b)| a + b), Some(600));
    let (own, _) = imported("own", &bridge_lines(2, 300, 0.4, true), 0);
    let (nameless, _) = imported("nameless", &bridge_lines(3, 60, 0.4, false), 0);
    // An object that was kept may fall before the arm has put it down.
    let lines = bridge_lines(2, 300, 0.4, true);
    let fallen = |line: &str| {
        if line.contains("kept") {
            format!("{line}\n{}\n", line.replace("kept", "dropped"))
        } else {
            format!("{line}\n")
        }
    };
    let (fell, output) = imported("fell", &lines.lines().map(fallen).collect::<String>(), 0);
    assert_eq!(serde_json::from_slice::<Value>(&output.stdout).expect("a report")["n_dropped"], 300);
    assert_eq!(json_of(&["info", &fell, "--hand", &hand, "--json"])["n_stable"], 0);

    // Outcomes are labels for training, evaluation and description.
    let model = at("model.json");
    run(&["train", &known, "--hand", &hand, "--words", "2", "--drop-costs", "20", "--out", &model], 0);
    for (recording, n_grasps, n_objects) in [(&own, 300, 60), (&nameless, 60, 60)] {
        let shown = json_of(&["info", recording, "--hand", &hand, "--json"]);
        assert_eq!(shown["n_with_truth"], n_grasps);
        assert_eq!(shown["objects"].as_object().map(serde_json::Map::len), Some(n_objects));
    }
    let decided = json_lines(&run(&["predict", &model, &at("own.jsonl"), "--hand", &hand, "--json"], 0).stdout);
    assert_eq!((decided.len(), &decided[7]["truth"]["object"]), (300, &json!("thing-1")));

    // Noise below zero is 0, as in a graph; a reading that is lower is refused with its line.
    let first = |reading: f64| {
        let mut lines = bridge_lines(2, 300, 0.4, true).lines().map(str::to_owned).collect::<Vec<_>>();
        let mut line: Value = serde_json::from_str(&lines[0]).expect("JSON");
        line["cells_newtons"][0] = json!(reading);
        lines[0] = line.to_string();
        lines.join("\n")
    };
    let (tared, _) = imported("tared", &first(-1e-4), 0);
    let exported = text(&run(&["export", &tared, "--topic", "/tactile"], 0).stdout).to_owned();
    let frame: Value = serde_json::from_str(exported.lines().next().expect("a frame")).expect("JSON");
    assert_eq!(frame["data"]["cells_newtons"][0], 0.0);
    let (_, output) = imported("negative", &first(-5.0), 1);
    let said = text(&output.stderr);
    assert!(
        said.contains("line 1") && said.contains("cells_newtons[0] is -5") && said.contains("zero_when_open"),
        "{said}"
    );

    // This robot drops four of ten that the model takes for safe.
    let adapted = at("adapted.json");
    let adapt = |model: &str, recording: &str, code: i32| {
        let output =
            run(&["model", "adapt", model, recording, "--hand", &hand, "--overwrite", "--out", &adapted], code);
        (text(&output.stdout).to_string(), text(&output.stderr).to_string())
    };
    let (said, _) = adapt(&model, &own, 0);
    assert!(said.contains("by 300 lifts of 60 objects on this robot"), "{said}");
    assert!(said.contains("when settled, log-odds are"), "{said}");
    let shown = json_of(&["model", "show", &adapted, "--json"]);
    let lifts = &shown["training"]["own_lifts"];
    let number = |name: &str| lifts[name].as_f64().expect("a number");
    assert!(number("log_loss_after") < number("log_loss_before"), "{lifts}");
    assert!(lifts["correction"]["b"].as_f64() < Some(-0.3), "{lifts}");
    assert!(
        shown["training"]["policies"].as_array().expect("policies").iter().all(|policy| policy["promise"].is_null())
    );
    assert!(text(&run(&["model", "show", &adapted], 0).stdout).contains("adapted"), "the words of it");
    let mean = |model: &str| {
        let lines = json_lines(&run(&["predict", model, &own, "--hand", &hand, "--json"], 0).stdout);
        lines.iter().filter_map(|line| line["probability_stable"].as_f64()).sum::<f64>() / 300.0
    };
    assert!(mean(&adapted) < mean(&model) - 0.02);
    // A lift whose object is not named counts as one of another object.
    assert!(adapt(&model, &nameless, 0).0.contains("by 60 lifts of 60 objects"));

    // The same grasps are not learned from twice, a few are not enough, and one object cannot judge itself.
    let before = at("before.json");
    std::fs::copy(&adapted, &before).expect("copied");
    assert!(adapt(&before, &nameless, 1).1.contains("the model was trained on grasp 0 of these"));
    let (few, _) = imported("few", &bridge_lines(4, 10, 0.0, true), 0);
    assert!(adapt(&model, &few, 1).1.contains("10 lifts with an outcome"), "a few");
    let of_one =
        (0..8).fold(bridge_lines(5, 40, 0.0, true), |lines, idx| lines.replace(&format!("thing-{idx}"), "thing"));
    let (one, _) = imported("one", &of_one, 0);
    assert!(adapt(&model, &one, 1).1.contains("all lifts are of one object"), "one object");

    // Simulated lifts are named as such. The paper's label says nothing of a lift.
    let layout = Hand::load(Path::new(&hand)).expect("a hand");
    let mut read = Examples::read(&layout, &[own.clone().into()], |_, _| {}).expect("examples");
    let known = Model::load(Path::new(&model)).expect("a model");
    read.labels.insert(Label::Lift, 1);
    read.n_excluded.insert("no_contact".into(), 3);
    adapt_on(&layout, &known, &read, &[]).expect("adapted").save(Path::new(&adapted)).expect("saved");
    let shown = text(&run(&["model", "show", &adapted], 0).stdout).to_owned();
    assert!(shown.contains("objects in simulation") && !shown.contains("on this robot"), "{shown}");
    assert!(shown.contains("3 other grasps taught nothing: 3 no_contact"), "{shown}");
    read.labels.insert(Label::WrenchSpace, 1);
    let error = adapt_on(&layout, &known, &read, &[]).expect_err("refused").to_string();
    assert!(error.contains("have the paper's label"), "{error}");
    fails(
        &["model", "adapt", "models/barrett-bh8-280-lifts.json", RECORDING, "--out", &at("none.json")],
        "have the paper's label",
    );

    // Lines that do not fit the hand, or that are no lines, are named.
    for (lines, expected) in [
        (bridge_lines(6, 2, 0.0, true).replace("[0.5,0.0]", "[0.5]"), "joints has 1 numbers, the hand pincer 2"),
        ("{}\n".into(), "line 1"),
        (String::new(), "found none"),
        (bridge_lines(6, 2, 0.0, true).replace("thing-0", &"x".repeat(65)), "object has 65 bytes"),
        (bridge_lines(6, 2, 0.0, true).replace("\"object\"", "\"thing\""), "unknown field"),
    ] {
        let (out, output) = imported("bad", &lines, 1);
        let stderr = text(&output.stderr);
        assert!(stderr.contains(expected), "{expected}: {stderr}");
        assert!(!Path::new(&out).exists());
    }
}

/// Frames of the project's recording, each grasp followed by its outcome: most lifts drop.
fn with_outcomes(n_grasps: u64) -> Vec<Stamped<TactileFrame>> {
    let mut frames = Vec::new();
    for frame in grasps(n_grasps) {
        let ends = frame.message.phase == Phase::Settled && frame.header.seq % 14 == 13;
        frames.push(frame.clone());
        if ends {
            let is_kept = frame.message.grasp_id.is_multiple_of(10);
            let phase = if is_kept { Phase::Kept } else { Phase::Dropped };
            let message = TactileFrame { phase, ..frame.message.clone() };
            frames.push(Stamped { message, ..frame });
        }
    }
    for (seq, frame) in frames.iter_mut().enumerate() {
        frame.header.seq = seq as u64;
    }
    frames
}

fn decision(line: &Value) -> (u64, String, f64) {
    let probability = line["probability_stable"].as_f64().expect("a number");
    (line["grasp_id"].as_u64().expect("a number"), line["action"].as_str().expect("a word").into(), probability)
}

/// The classifier of a graph learns as [`Judge`] does, whatever befalls its process, and a replay of the frames decides the same.
#[test]
fn a_graph_learns_from_its_lifts_through_kills_and_swaps() {
    const N_GRASPS: u64 = 120;
    let folder = tempfile::tempdir().expect("a folder");
    let recorded = folder.path().join("lifts.mcap");
    let settings =
        ["--set", "lift_arbiter.promised_drops=1", "--set", "classifier.adapt=on", "--record", utf8(&recorded)];
    let (graph, mut bridge) = listening(&[PATIENT], &settings);
    let hand = Hand::load(&project().join(HAND)).expect("a hand");
    let model = Model::load(&project().join(MODEL)).expect("a model");
    let mut judge = Judge::new(hand.clone(), model).expect("of one hand");
    judge.adapt(Adapt::On);
    let mut expected = Vec::new();
    let frames = with_outcomes(N_GRASPS);
    let mut tell =
        |judge: &mut Judge, grasps: std::ops::Range<u64>| {
            for frame in frames.iter().filter(|frame| grasps.contains(&frame.message.grasp_id)) {
                let seq = frame.header.seq;
                bridge.send(&changed(frame, |line| {
                    line["seq"] = json!(seq);
                    line["object"] = json!(format!("thing-{}", frame.message.grasp_id % 30));
                }));
                let header = Header { hand_id: hand.id(), ..frame.header };
                let judged = judge.sample(&Stamped { header, message: frame.message.clone() });
                expected.extend(judged.decisions.into_iter().map(|decided| {
                    (decided.grasp_id, decided.action.as_str().to_string(), decided.probability_stable)
                }));
            }
            let n_expected = expected.len();
            wait_until(|| graph.n_decisions() == n_expected, || graph.said());
        };
    tell(&mut judge, 0..30);
    graph.kill("classifier");
    tell(&mut judge, 30..60);
    run(&["swap", "classifier", "--probation", "0", "--graph", &graph.name], 0);
    tell(&mut judge, 60..90);
    // A replacement that does not learn has no state. It fails, and the old one goes on with its own state.
    let old = graph.pid_of("classifier");
    let mut swapping = blindgrasp();
    swapping.args(["swap", "classifier", "--set", "adapt=off", "--probation", "60", "--graph", &graph.name]);
    let mut swapping = swapping.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("started");
    wait_until(|| graph.pid_of("classifier") != old, || graph.said());
    signal(graph.pid_of("classifier"), rustix::process::Signal::KILL);
    assert_eq!(swapping.wait().expect("waited").code(), Some(1));
    assert_eq!(graph.pid_of("classifier"), old, "{}", graph.said());
    let set = |adapt: &str| drop(run(&["set", &format!("classifier.adapt={adapt}"), "--graph", &graph.name], 0));
    set("frozen");
    judge.adapt(Adapt::Frozen);
    tell(&mut judge, 90..105);
    let own = judge.own_lifts();
    let counts = json!({"outcomes/kept": own.n_kept(), "outcomes/dropped": own.n_dropped(), "outcomes/changes": own.n_changes()});
    wait_until(|| graph.node("classifier")["counts"] == counts, || graph.node("classifier").to_string());
    set("off");
    judge.adapt(Adapt::Off);
    tell(&mut judge, 105..N_GRASPS);
    let arbiter = graph.node("lift_arbiter")["counts"].clone();
    let listed = text(&run(&["ps", &graph.name], 0).stdout).to_string();
    assert!(listed.contains("of this robot's lifts drop (95 % confidence if"), "{listed}\n{arbiter}");
    let ended = graph.stop();
    assert_eq!(ended.code, Some(0), "{}\n{}", ended.summary, ended.stderr);
    assert_eq!(ended.decisions.iter().map(decision).collect::<Vec<_>>(), expected);
    // The outcomes of the first thirty grasps made a difference.
    let lifts = |range: std::ops::Range<u64>| {
        expected.iter().filter(|(grasp_id, action, _)| range.contains(grasp_id) && action == "lift").count()
    };
    assert!(lifts(0..30) > 5 && lifts(60..90) < lifts(0..30) / 2, "{expected:?}");

    // The bridge's names are in the recording, and a graph that plays it decides the same, as long as it learns.
    let truths = json_lines(&run(&["export", utf8(&recorded), "--topic", "/truth"], 0).stdout);
    assert_eq!((truths.len() as u64, &truths[31]["data"]["object"]), (N_GRASPS, &json!("thing-1")));
    let played = dataflow(folder.path(), &[("rate: 10", "rate: max"), ("max_age_ms: 5000", "max_age_ms: 600000")]);
    let source = format!("recorded_source.recording={}", recorded.display());
    let settings = ["--set", &source, "--set", "classifier.adapt=on"];
    let again = Graph::start(&played, &settings).finish();
    let played: Vec<_> = again.decisions.iter().map(decision).take_while(|(grasp_id, ..)| *grasp_id < 90).collect();
    assert_eq!(played[..], expected[..played.len()]);
    assert_eq!(played.len(), 90);
}
