//! A hand with 10,000 cells through the real processes.

use std::fmt::Write;
use std::path::Path;

use crate::common::{HAND, MODEL, RECORDING, dataflow, decisions_of, project, undisturbed};
use blindgrasp_recording::{Record, RecordingInfo, RecordingReader, RecordingWriter};
use blindgrasp_stages::hand::Hand;
use blindgrasp_stages::model::Model;

const N_CELLS: usize = 10_000;
const N_PADS: usize = 4;
const N_GRASPS: u64 = 6;
/// Below the hand's noise threshold.
const NOISE_NEWTONS: f64 = 0.03;

/// The Barrett hand with more cells on each pad, behind its own ones.
fn hand_with_more_cells(folder: &Path) -> Hand {
    let layout = std::fs::read_to_string(project().join(HAND)).expect("a layout");
    let (palm, finger) = layout.split_once("  finger:\n").expect("two layouts");
    let mut more = String::new();
    for idx in 0..N_CELLS / N_PADS - 24 {
        // No two of them are in the same place.
        let (x_m, z_m) = (1e-3 * (idx % 50) as f64, 1e-3 * (idx / 50) as f64);
        let _ = writeln!(
            more,
            "    - {{at_m: [{x_m}, 0.0095, {z_m}], normal: [0, 1, 0], along: [1, 0, 0], size_m: [1e-3, 1e-3]}}"
        );
    }
    let path = folder.join("hand.yaml");
    std::fs::write(&path, format!("{palm}{more}  finger:\n{finger}{more}")).expect("written");
    let urdf = "hands/barrett-bh8-280.urdf";
    std::fs::copy(project().join(urdf), folder.join("barrett-bh8-280.urdf")).expect("copied");
    Hand::load(&path).expect("a hand")
}

/// The project's recording, as the hand with more cells would have sensed it: the other cells feel noise.
fn record(hand: &Hand, to: &Path) {
    let info =
        RecordingInfo { hand: hand.name.clone(), hand_id: hand.id(), made_by: "a test".into(), version: "0".into() };
    let mut writer = RecordingWriter::create(to, &info).expect("created");
    for record in RecordingReader::open(&project().join(RECORDING)).expect("opened") {
        let (topic, mut record) = record.expect("readable");
        if record.grasp_id() >= N_GRASPS {
            continue;
        }
        match &mut record {
            Record::Tactile(frame) => {
                frame.header.hand_id = hand.id();
                let mut cells_newtons = vec![NOISE_NEWTONS; N_CELLS];
                for (pad, own) in hand.pads.iter().zip(frame.message.cells_newtons.chunks(24)) {
                    cells_newtons[pad.first_cell_idx..][..24].copy_from_slice(own);
                }
                frame.message.cells_newtons = cells_newtons;
            }
            Record::Truth(truth) => truth.header.hand_id = hand.id(),
            _ => continue,
        }
        writer.write_record(&topic, &record).expect("written");
    }
    writer.finish().expect("finished");
}

#[test]
fn ten_thousand_cells_decide_as_those_that_feel_something() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let hand = hand_with_more_cells(folder.path());
    assert_eq!(hand.n_cells(), N_CELLS);
    record(&hand, Path::new(&at("many.mcap")));
    let mut model = Model::load(&project().join(MODEL)).expect("a model");
    model.hand.id = hand.id();
    for (cells, pad) in model.features.cells_in_link_m.iter_mut().zip(&hand.pads) {
        *cells = pad.cells.iter().map(|cell| cell.position_in_link_m.coords.into()).collect();
    }
    model.save(Path::new(&at("model.json"))).expect("saved");
    let flow =
        dataflow(folder.path(), &[(RECORDING, &at("many.mcap")), (MODEL, &at("model.json")), (HAND, &at("hand.yaml"))]);
    let expected = &undisturbed()[..N_GRASPS as usize];
    assert!(expected.iter().any(|(action, _)| action == "lift"), "{expected:?}");
    assert_eq!(decisions_of(&flow), expected);
}
