//! Compares hands and grasp qualities with reference values that lie beside the project where it is developed; elsewhere these
//! tests are skipped. The simulator's labels are compared with the quality of its scenes.

use std::path::Path;

use crate::common::reference;
use blindgrasp_objects::select;
use blindgrasp_simulator::simulator::{SimulatorOptions, simulate_all};
use blindgrasp_simulator::wrench_space::{GraspCase, quality};
use blindgrasp_stages::hand::Hand;
use serde_json::Value;

#[test]
fn barrett_cells_agree_to_a_micrometre() {
    let Some(path) = reference("hand/barrett-cells.csv") else { return };
    let hand = Hand::load(Path::new("barrett-bh8-280")).expect("built in");
    let text = std::fs::read_to_string(path).expect("readable");
    let mut n_rows = 0;
    for row in text.lines().skip(1) {
        let columns: Vec<&str> = row.split(',').collect();
        let number = |idx: usize| columns[idx].parse::<f64>().expect("a number");
        let joints: Vec<f64> = (1..8).map(number).collect();
        let poses = hand.cells_in_palm(&joints).expect("7 joints");
        let pad = hand.pads.iter().find(|pad| pad.name == columns[8]).expect("a pad");
        let pose = &poses[pad.first_cell_idx + columns[9].parse::<usize>().expect("an index")];
        for axis in 0..3 {
            assert!((pose.position_in_palm_m[axis] - number(10 + axis)).abs() < 1e-6, "{row}");
            // The slope of the curved rows may be taken in several ways.
            assert!((pose.normal_in_palm[axis] - number(13 + axis)).abs() < 0.02, "{row}");
        }
        n_rows += 1;
    }
    assert!(n_rows >= 96, "{n_rows} rows");
}

#[test]
fn grasp_quality_agrees_with_qhull() {
    let Some(path) = reference("quality/cases.json") else { return };
    let cases: Vec<Value> =
        serde_json::from_str(&std::fs::read_to_string(path).expect("readable")).expect("a list of cases");
    assert!(!cases.is_empty());
    for (idx, case) in cases.iter().enumerate() {
        let input: GraspCase = serde_json::from_value(case["input"].clone()).expect("a case");
        let found = quality(&input).expect("a quality");
        let expected = |field: &str| case["expected"][field].as_f64().expect("a number");
        let relative = |found: f64, expected: f64| (found - expected).abs() / expected.abs().max(1e-12);
        assert!(relative(found.epsilon, expected("epsilon")) < 1e-6, "case {idx}: {found:?}");
        assert!(relative(found.volume, expected("volume")) < 1e-6, "case {idx}: {found:?}");
        assert_eq!(found.n_wrenches as f64, expected("n_wrenches"), "case {idx}");
    }
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
