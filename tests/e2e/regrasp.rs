//! Advice on grasping anew, through the real programs: lifts become experience, and a graph advises once on each grasp.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use crate::common::{
    Graph, HAND, MODEL, RECORDING, assert_nothing_left, dataflow, json_lines, run, shared_folder, text, unique_name,
};
use serde_json::Value;

/// Experience of a few lifted grasps.
struct Made {
    folder: PathBuf,
    report: Value,
}

impl Made {
    fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }
}

fn made() -> &'static Made {
    static MADE: OnceLock<Made> = OnceLock::new();
    MADE.get_or_init(|| {
        let folder = shared_folder("regrasp");
        let place = |name: &str| folder.join(name).to_str().expect("UTF-8").to_string();
        let (lifts, out) = (place("lifts.mcap"), place("experience.json"));
        let simulate = ["simulate", "--label", "lift", "--stable-fraction", "natural", "--objects", "ball-01,box-03"];
        run(&[&simulate[..], &["--grasps", "6", "--seed", "2", "--out", &lifts]].concat(), 0);
        let output = run(&["train", &lifts, "--experience", MODEL, "--out", &out, "--json"], 0);
        let report = serde_json::from_slice(&output.stdout).expect("JSON");
        Made { folder, report }
    })
}

/// The default graph with a node that gives advice.
fn flow(folder: &Path, experience: &Path) -> PathBuf {
    let advises = format!(
        "operators:\n  regrasp:\n    inputs: {{feature: encoder/feature}}\n    params: {{model: {MODEL}, experience: \"{}\"}}\n",
        experience.display()
    );
    dataflow(folder, &[("operators:\n", &advises)])
}

/// The advice of a recording, by grasp; each grasp has it once.
fn advice(recording: &Path) -> BTreeMap<u64, Value> {
    let output = run(&["export", recording.to_str().expect("UTF-8"), "--topic", "/advice"], 0);
    let mut found = BTreeMap::new();
    for (seq, mut line) in json_lines(&output.stdout).into_iter().enumerate() {
        assert_eq!(line["seq"], seq, "{line}");
        let grasp_id = line["data"]["grasp_id"].as_u64().expect("an id");
        assert!(found.insert(grasp_id, line["data"]["proposals"].take()).is_none(), "{grasp_id} twice");
    }
    found
}

#[test]
fn lifts_become_experience() {
    let made = made();
    let count = |name: &str| made.report[name].as_u64().expect("a count");
    assert!(count("n_grasps") >= 3 && count("n_grasps") <= 6 && count("n_objects") <= 2, "{}", made.report);
    let file = std::fs::read_to_string(made.path("experience.json")).expect("written");
    assert_eq!((file.lines().count() as u64, file.len() as u64), (1 + count("n_grasps"), count("n_bytes")));
    let experience: Value = serde_json::from_str(&file).expect("JSON");
    assert_eq!(experience["dictionary_id"], made.report["dictionary_id"]);
    for grasp in experience["grasps"].as_array().expect("grasps") {
        // The spread is what a Barrett hand begins with; its fingers are open.
        let open: Vec<f64> =
            grasp["open_joints_rad"].as_array().expect("joints").iter().filter_map(Value::as_f64).collect();
        assert!(open.len() == 7 && open[0] >= 0.0 && open[1..].iter().all(|angle| angle.abs() < 0.01), "{grasp}");
    }
}

#[test]
fn evaluate_judges_each_look_of_a_model_with_probes() {
    let made = made();
    let lifts = made.path("lifts.mcap");
    let lifts = lifts.to_str().expect("UTF-8");
    let model = "models/barrett-bh8-280-lifts.json";
    let report: Value = serde_json::from_slice(&run(&["evaluate", model, lifts, "--json"], 0).stdout).expect("JSON");
    let looks = report["looks"].as_array().expect("looks");
    let names: Vec<&str> = looks.iter().filter_map(|look| look["look"].as_str()).collect();
    assert_eq!(names, ["settled", "squeezed", "test_lifted"]);
    let n_felt = made.report["n_grasps"].as_u64().expect("a count");
    for look in looks {
        let count = |name: &str| look[name].as_u64().expect("a count");
        assert!(count("n_grasps") <= n_felt && count("n_kept") <= count("n_lifted"), "{look}");
        assert!(count("n_lifted") <= count("n_grasps") && count("n_stable") <= count("n_grasps"), "{look}");
    }
    let table = text(&run(&["evaluate", model, lifts], 0).stdout);
    assert!(table.contains("\nlook          grasps") && table.contains("\ntest_lifted "), "{table}");
    // A model without probes has one look, and the table has it already.
    let table = text(&run(&["evaluate", MODEL, lifts], 0).stdout);
    assert!(!table.contains("look "), "{table}");
}

#[test]
fn each_grasp_is_advised_once_though_operators_die() {
    let made = made();
    let flow = flow(&made.folder, &made.path("experience.json"));
    let (undisturbed, disturbed) = (made.path("undisturbed.mcap"), made.path("disturbed.mcap"));
    let utf8 = |path: &Path| path.to_str().expect("UTF-8").to_string();
    let name = unique_name();
    let fast = ["--set", "recorded_source.rate=max", "--record", &utf8(&undisturbed)];
    run(&[&["run", "--name", &name, &utf8(&flow)], &fast[..]].concat(), 0);
    assert_nothing_left(&name);
    let expected = advice(&undisturbed);
    let n_grasps = json_lines(&run(&["export", RECORDING, "--topic", "/truth"], 0).stdout).len();
    assert_eq!(expected.len(), n_grasps);
    let proposals: Vec<&Value> = expected.values().filter_map(|of_grasp| of_grasp.get(0)).collect();
    assert!(!proposals.is_empty(), "no advice has a proposal");
    for best in proposals {
        let numbers = |name: &str| -> Vec<f64> {
            best[name].as_array().expect("a list").iter().filter_map(Value::as_f64).collect()
        };
        let rotation: f64 = numbers("palm_rotation_xyzw").iter().map(|number| number * number).sum();
        assert!((rotation - 1.0).abs() < 1e-3, "{best}");
        assert!(numbers("palm_position_m").iter().all(|number| number.abs() < 0.5), "{best}");
        assert_eq!(numbers("open_joints_rad").len(), 7);
        assert!((0.0..=1.0).contains(&best["probability_held"].as_f64().expect("a share")), "{best}");
    }

    let graph = Graph::start(&flow, &["--record", &utf8(&disturbed), "--set", "recorded_source.rate=10"]);
    for _ in 0..2 {
        graph.kill("regrasp");
        graph.wait_for_decisions(5);
    }
    let ended = graph.finish();
    assert_eq!((ended.code, &ended.summary["samples_lost"]), (Some(0), &0.into()), "{}", ended.stderr);
    assert!(advice(&disturbed) == expected, "other advice after a kill");
}

#[test]
fn files_that_are_no_experience_are_refused_with_advice() {
    let made = made();
    let said = |arguments: &[&str]| text(&run(arguments, 1).stderr);
    let out = made.path("refused.json");
    let out = out.to_str().expect("UTF-8");
    let refused = said(&["train", RECORDING, "--experience", MODEL, "--out", out]);
    assert!(refused.contains("held-out.mcap") && refused.contains("simulate --label lift"), "{refused}");
    let lifts = made.path("lifts.mcap");
    let lifts = lifts.to_str().expect("UTF-8");
    let refused = said(&["train", lifts, lifts, "--experience", MODEL, "--out", out]);
    assert!(refused.contains("is given twice"), "{refused}");
    let refused = said(&["train", lifts, "--experience", HAND, "--out", out]);
    assert!(refused.contains("barrett-bh8-280.yaml"), "{refused}");
    assert!(!Path::new(out).exists());

    // The features of another model.
    let text_of = std::fs::read_to_string(made.path("experience.json")).expect("written");
    let id = made.report["dictionary_id"].as_str().expect("an id");
    let other = made.path("other.json");
    std::fs::write(&other, text_of.replacen(id, "0123456789abcdef", 1)).expect("written");
    let folder = tempfile::tempdir().expect("a folder");
    let flow = flow(folder.path(), &other);
    let name = unique_name();
    let refused = said(&["run", "--name", &name, flow.to_str().expect("UTF-8")]);
    assert_nothing_left(&name);
    assert!(refused.contains("0123456789abcdef") && refused.contains("make it again for this model"), "{refused}");
}
