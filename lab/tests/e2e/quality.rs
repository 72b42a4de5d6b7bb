//! `blindgrasp info CASES.json` as its users meet it.

use std::io::Write;
use std::process::Stdio;

use crate::common::{blindgrasp, json_lines, run, text};
use blindgrasp_objects::select;
use blindgrasp_simulator::simulator::{SimulatorOptions, simulate_all};
use blindgrasp_simulator::wrench_space::{GraspCase, quality};
use blindgrasp_stages::hand::Hand;
use serde_json::{Value, json};

/// A ball of radius 40 mm between four soft fingers.
fn case() -> Value {
    let contact = |direction: [f64; 3], tangent: [f64; 3]| {
        json!({
            "point_m": direction.map(|x| -0.04 * x),
            "inward_normal": direction,
            "tangent": tangent,
            "friction": 0.8,
            "torsion_m": 0.003,
        })
    };
    json!({
        "centre_of_mass_m": [0.0, 0.0, 0.0],
        "max_radius_m": 0.04,
        "contacts": [
            contact([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
            contact([-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]),
            contact([-0.6, -0.8, 0.0], [0.0, 0.0, 1.0]),
            contact([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]),
        ],
    })
}

fn write(folder: &tempfile::TempDir, content: &str) -> String {
    let path = folder.path().join("grasps.json");
    std::fs::write(&path, content).expect("written");
    path.to_str().expect("UTF-8").into()
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder")
}

/// Asserts that the second of two cases, with a change, fails with an error that holds all of `expected`, and that the
/// first is judged.
#[track_caller]
fn check_second(change: impl FnOnce(&mut Value), expected: &[&str]) {
    let folder = folder();
    let mut second = case();
    change(&mut second);
    let path = write(&folder, &json!([case(), second]).to_string());
    let output = run(&["info", "--json", &path], 1);
    let stderr = text(&output.stderr);
    for part in ["grasps.json", "case 1", "1 of 2"].iter().chain(expected) {
        assert!(stderr.contains(part), "expected '{part}' in\n{stderr}");
    }
    let rows = json_lines(&output.stdout);
    assert_eq!(rows.len(), 2);
    assert_eq!(rows[0]["force_closure"], true);
    assert!(rows[1]["error"].is_string() && rows[1]["case"] == 1, "{}", rows[1]);
}

#[test]
fn values_are_those_of_the_library() {
    let folder = folder();
    let input: GraspCase = serde_json::from_value(case()).expect("a case");
    let expected = quality(&input).expect("a quality");
    assert!(expected.force_closure);
    let wrapped = json!([case(), {"name": "ball", "input": case(), "expected": {"epsilon": 1.0}}]);
    let rows = json_lines(&run(&["info", "--json", &write(&folder, &wrapped.to_string())], 0).stdout);
    for row in &rows {
        assert_eq!(row["epsilon"], expected.epsilon);
        assert_eq!(row["volume"], expected.volume);
        assert_eq!(row["n_wrenches"], 80);
        assert_eq!(row["stable"], expected.is_stable());
    }
    assert_eq!((&rows[0]["case"], &rows[1]["case"], &rows[1]["name"]), (&json!(0), &json!(1), &json!("ball")));
    let table = text(&run(&["info", &write(&folder, &wrapped.to_string())], 0).stdout);
    assert!(table.contains(&format!("{:.6}", expected.epsilon)) && table.contains("ball"), "{table}");
}

#[test]
fn stdin_may_hold_a_case_per_line() {
    let mut child = blindgrasp()
        .args(["info", "--json", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("started");
    let lines = format!("{}\n{}\n{}\n", case(), case(), case());
    child.stdin.take().expect("piped").write_all(lines.as_bytes()).expect("written");
    let output = child.wait_with_output().expect("waited");
    assert_eq!((output.status.code(), json_lines(&output.stdout).len()), (Some(0), 3));
}

#[test]
fn a_wrong_case_is_named_and_the_others_are_judged() {
    let contact = |field: &'static str, value: Value| move |case: &mut Value| case["contacts"][2][field] = value;
    check_second(contact("friction", json!(-0.5)), &["contact 2", "friction", "-0.5"]);
    // The hull fails: its coordinates are out of all bounds.
    check_second(contact("torsion_m", json!(1e300)), &["hull of 80 wrenches failed", "coordinate"]);
}

#[test]
fn files_without_a_case_say_why() {
    let folder = folder();
    let check = |content: &str, expected: &[&str]| {
        let output = run(&["info", &write(&folder, content)], 1);
        let stderr = text(&output.stderr);
        assert!(output.stdout.is_empty());
        for part in ["grasps.json"].iter().chain(expected) {
            assert!(stderr.contains(part), "expected '{part}' in\n{stderr}");
        }
    };
    check("", &["expected grasp cases (JSON), found an empty file"]);
    check("[]", &["no grasp case"]);
    check("[\n{\"a\": NaN}]", &["line 2 column", "finite"]);
    check("[1, 2", &["line 1 column"]);
    assert!(text(&run(&["info", "absent.json"], 1).stderr).contains("absent.json"));
}

#[test]
fn the_quality_of_a_scene_is_the_simulators_label() {
    let hand = Hand::load("barrett-bh8-280".as_ref()).expect("built in");
    let objects = select("all").expect("built in");
    let options = SimulatorOptions { n_grasps: 100, seed: 4, ..Default::default() };
    let mut n_stable = 0;
    let sink = |grasp: blindgrasp_simulator::candidate::SimulatedGrasp| {
        let case = GraspCase::from(&grasp.scene);
        assert_eq!(quality(&case).expect("a quality").is_stable(), grasp.truth.stable);
        n_stable += usize::from(grasp.truth.stable);
        Ok::<(), std::convert::Infallible>(())
    };
    simulate_all(&hand, &objects, &options, sink).expect("grasps");
    assert_eq!(n_stable, 48);
}
