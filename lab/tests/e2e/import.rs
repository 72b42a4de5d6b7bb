//! `blindgrasp import`: tables of tactile readings become recordings, and unfit tables are refused.

use std::path::Path;

use crate::common::python::benchsuite;
use crate::common::{HAND, RECORDING, fails, json_lines, project, reference, run, text};
use blindgrasp_stages::contacts::contacts_from_frame;
use blindgrasp_stages::hand::Hand;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

/// A hand of two joints and three cells on two pads.
const LAYOUT: &str = "\
format: blindgrasp-hand/1
name: pincer
urdf: pincer.urdf
reference_link: palm
joints: [left, right]
pads:
  - {name: left, link: left, layout: two, noise_threshold_newtons: 0.05}
  - {name: right, link: right, layout: one, noise_threshold_newtons: 0.05}
layouts:
  two:
    - {at_m: [0, 0, 0], normal: [0, 0, 1], along: [1, 0, 0], size_m: [0.002, 0.002]}
    - {at_m: [0.01, 0, 0], normal: [0, 0, 1], along: [1, 0, 0], size_m: [0.002, 0.002]}
  one:
    - {at_m: [0, 0, 0], normal: [0, 0, 1], along: [1, 0, 0], size_m: [0.002, 0.002]}
";
const URDF: &str = r#"<robot name="pincer"><link name="palm"/><link name="left"/><link name="right"/>
<joint name="left" type="revolute"><parent link="palm"/><child link="left"/><origin xyz="0.1 0 0"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="right" type="revolute"><parent link="palm"/><child link="right"/><origin xyz="-0.1 0 0"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"#;
const TABLE: &str = "object,kind,held,l_1,l_2,r_1\ncup,mug,yes,0.5,1.25,2\nbox,,no,0,0.1,3e-2\n";

/// Writes the pincer to a folder; its layout.
pub(super) fn pincer(folder: &Path) -> String {
    let layout = folder.join("pincer.yaml");
    std::fs::write(&layout, LAYOUT).expect("written");
    std::fs::write(folder.join("pincer.urdf"), URDF).expect("written");
    layout.to_str().expect("UTF-8").into()
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Folder {
        let folder = Folder(tempfile::tempdir().expect("a folder"));
        pincer(folder.0.path());
        folder
    }

    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_str().expect("UTF-8").into()
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        std::fs::write(self.at(name), content).expect("written");
        self.at(name)
    }

    /// The arguments of an import of `table.csv` to `out.mcap`, and `more`.
    fn arguments(&self, more: &[&str]) -> Vec<String> {
        let has = |flag: &str| more.contains(&flag);
        let mut arguments = vec!["import".to_string(), self.at("table.csv")];
        let hand = self.at("pincer.yaml");
        for (flag, value) in [
            ("--hand", hand.as_str()),
            ("--cells", "l_*,r_*"),
            ("--label", "held"),
            ("--stable-value", "yes"),
            ("--group", "object"),
            ("--joints", "left=0.5"),
            ("--out", &self.at("out.mcap")),
        ] {
            let is_given = has(flag) || (flag == "--joints" && has("--joint-columns"));
            if !is_given {
                arguments.extend([flag.into(), value.into()]);
            }
        }
        arguments.extend(more.iter().map(|argument| (*argument).to_string()));
        arguments.push("--overwrite".into());
        arguments
    }

    /// Imports a table; the report.
    fn import(&self, table: impl AsRef<[u8]>, more: &[&str]) -> Value {
        self.write("table.csv", table);
        let arguments = self.arguments(&[more, &["--json"]].concat());
        let output = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), 0);
        serde_json::from_slice(&output.stdout).expect("a report")
    }

    /// What the recording holds of a topic.
    fn exported(&self, topic: &str) -> Vec<Value> {
        json_lines(&run(&["export", &self.at("out.mcap"), "--topic", topic], 0).stdout)
    }

    /// Refuses a table with an error that holds all of `expected`, and leaves neither a recording nor a part of one.
    fn refuse(&self, table: impl AsRef<[u8]>, more: &[&str], exit_code: i32, expected: &[&str]) {
        self.write("table.csv", table);
        let arguments = self.arguments(more);
        let output = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), exit_code);
        let stderr = text(&output.stderr);
        for part in expected {
            assert!(stderr.contains(part), "{more:?}: expected '{part}' in\n{stderr}");
        }
        assert!(!stderr.contains("panicked") && output.stdout.is_empty(), "{stderr}");
        for left in ["out.mcap", "out.mcap.partial"] {
            assert!(!Path::new(&self.at(left)).exists(), "{left} is left after {more:?}");
        }
    }
}

#[test]
fn a_table_becomes_a_recording() {
    let folder = Folder::new();
    let report = folder.import(TABLE, &["--grasp-id-start", "7", "--frames", "2"]);
    assert_eq!(report["n_rows"], 2);
    assert_eq!(report["n_grasps"], 2);
    assert_eq!(report["n_stable"], 1);
    assert_eq!(report["cell_unit"], "newtons");
    assert_eq!(report["label_values"], json!({"no": 1, "yes": 1}));
    assert_eq!(report["groups"]["cup"], json!({"n_grasps": 1, "n_stable": 1}));
    assert_eq!(report["pads"][0], json!({"pad": "left", "columns": ["l_1", "l_2"]}));
    assert_eq!(report["pads"][1], json!({"pad": "right", "columns": ["r_1"]}));
    let frames = folder.exported("/tactile");
    let data = |grasp_id: u64, cells: [f64; 3]| {
        json!({"grasp_id": grasp_id, "phase": "settled", "joints": [0.5, 0.0], "cells_newtons": cells,
        "gravity_m_per_s2": [], "wrist_wrench": [], "joint_torques": [], "day": 0})
    };
    let expected =
        [(0, 7, [0.5, 1.25, 2.0]), (1, 7, [0.5, 1.25, 2.0]), (2, 8, [0.0, 0.1, 0.03]), (3, 8, [0.0, 0.1, 0.03])];
    assert_eq!(frames.len(), expected.len());
    let mut last_nanos = None;
    for (frame, (seq, grasp_id, cells)) in frames.iter().zip(expected) {
        assert_eq!((&frame["seq"], &frame["data"]), (&json!(seq), &data(grasp_id, cells)));
        let nanos = frame["stamp_nanos"].as_u64();
        assert!(nanos > last_nanos, "{frames:?}");
        last_nanos = nanos;
    }
    // Values that a table lacks are NaN, and null in JSON.
    let truths: Vec<Value> = folder.exported("/truth").into_iter().map(|line| line["data"].clone()).collect();
    let truth = |grasp_id: u64, object: &str, stable: bool| json!({"grasp_id": grasp_id, "epsilon": null, "volume": null, "stable": stable, "object": object, "object_class": object});
    assert_eq!(truths, [truth(7, "cup", true), truth(8, "box", false)]);
    let info = run(&["info", &folder.at("out.mcap"), "--hand", &folder.at("pincer.yaml")], 0);
    let info = text(&info.stdout);
    assert!(info.lines().any(|line| line.starts_with("force closure") && line.ends_with("n/a")), "{info}");
}

#[test]
fn a_spreadsheets_table_reads_the_same() {
    let folder = Folder::new();
    folder.import(TABLE, &[]);
    let plain = (folder.exported("/tactile"), folder.exported("/truth"));
    let table = "\u{feff}object,kind,held,l_1,l_2,r_1\r\n\"cup\",mug,yes, 0.5 ,1.25,2\r\n\r\nbox,,no,0,0.1,3e-2";
    folder.import(table, &[]);
    assert_eq!((folder.exported("/tactile"), folder.exported("/truth")), plain);
}

#[test]
fn columns_may_hold_angles_and_classes() {
    let folder = Folder::new();
    let table = "object,kind,held,l_1,l_2,r_1,q_left,q_right\ncup,mug,1,1,0,0.5,0.75,0\nbox,crate,0,1,2,3,0,1\n";
    let more = ["--joint-columns", "q_*", "--class", "kind"];
    let report = folder.import(table, &[&more[..], &["--stable-value", "1"]].concat());
    assert_eq!(report["joint_columns"], json!(["q_left", "q_right"]));
    let frames = folder.exported("/tactile");
    assert_eq!(frames[0]["data"]["cells_newtons"], json!([1.0, 0.0, 0.5]));
    assert_eq!(frames[0]["data"]["joints"], json!([0.75, 0.0]));
    assert_eq!(frames[3]["data"]["joints"][1], json!(1.0));
    assert_eq!(folder.exported("/truth")[1]["data"]["object_class"], "crate");
}

/// Frames of two grasps.
const SERIES: &str = "object,held,l_1,l_2,r_1,grasp,phase
cup,yes,0,0,0,a,open
cup,yes,0.5,0,0,a,closing
cup,yes,0.5,1.25,2,a,settled
cup,yes,0.5,1.5,2,a,settled
box,no,0,0.1,1,b,settled
";

#[test]
fn rows_may_be_the_frames_of_grasps() {
    let folder = Folder::new();
    let flags = ["--grasp-column", "grasp", "--phase-column", "phase"];
    let report = folder.import(SERIES, &flags);
    assert_eq!((&report["n_rows"], &report["n_frames"]), (&json!(5), &json!(5)));
    assert_eq!((&report["n_grasps"], &report["n_stable"]), (&json!(2), &json!(1)));
    assert_eq!(report["label_values"], json!({"no": 1, "yes": 1}));
    let of = |frame: &Value| {
        let data = &frame["data"];
        (data["grasp_id"].as_u64(), data["phase"].as_str().map(String::from), data["cells_newtons"][1].as_f64())
    };
    let frames: Vec<_> = folder.exported("/tactile").iter().map(of).collect();
    let expected =
        [(0, "open", 0.0), (0, "closing", 0.0), (0, "settled", 1.25), (0, "settled", 1.5), (1, "settled", 0.1)];
    assert_eq!(frames, expected.map(|(grasp_id, phase, cell)| (Some(grasp_id), Some(phase.into()), Some(cell))));
    assert_eq!(folder.exported("/truth").len(), 2);
    let all_settled = folder.import(SERIES, &flags[..2]);
    assert_eq!((&all_settled["n_frames"], &all_settled["n_grasps"]), (&json!(5), &json!(2)));

    let changed = |from: &str, to: &str| SERIES.replacen(from, to, 1);
    let folder = Folder::new();
    for (table, expected) in [
        (changed("cup,yes,0.5,0,0", "cup,no,0.5,0,0"), "line 3: label 'no', but 'yes' in line 2 of the same grasp"),
        (changed("cup,yes,0.5,0,0", "mug,yes,0.5,0,0"), "line 3: object 'mug', but 'cup' in line 2"),
        (changed("a,open", "a,settled"), "line 3: phase 'closing' after 'settled'"),
        (changed("a,closing", "a,shut"), "line 3: column 'phase': expected a phase (open, closing, settled"),
        (changed("1,b,settled", "1,b,closing"), "line 6: grasp 'b' has no settled frame"),
        (changed("1,b,settled", "1,,settled"), "line 6: column 'grasp': expected the name of a grasp"),
        (format!("{SERIES}cup,yes,0,0,0,a,settled\n"), "line 7: grasp 'a' again: expected the rows of a grasp"),
        (changed("cup,yes,0.5,1.25,2,a", "cup,yes,0.5,x,2,a"), "line 4: column 'l_2': expected a number"),
    ] {
        folder.refuse(&table, &flags, 1, &[expected]);
    }
    folder.refuse(SERIES, &["--phase-column", "phase"], 2, &["--grasp-column"]);
    // A settled frame in a bad row is not missed as well.
    folder.write("table.csv", changed("box,no,0,0.1,1,b", "box,no,0,x,1,b") + "box,no,0,0.1,1,b,lifting\n");
    let arguments = folder.arguments(&flags);
    let stderr = text(&run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), 1).stderr);
    assert!(stderr.contains("1 of 6 rows cannot be used") && !stderr.contains("no settled frame"), "{stderr}");
}

#[test]
fn labels_of_exported_lines_keep_stamp_and_epoch() {
    let folder = Folder::new();
    let topics = ["--topic", "/tactile", "--topic", "/truth"];
    let exported = text(&run(&[&["export", "recordings/ordinary.mcap"], &topics[..]].concat(), 0).stdout);
    let lines = exported.replace("\"epoch\":0,", "\"epoch\":3,");
    // Labels later than their frames, and a byte order mark.
    let later = |line: &str| {
        let is_label = line.contains("\"/truth\"");
        if is_label { line.replace("\"stamp_nanos\":", "\"stamp_nanos\":7") } else { line.to_string() }
    };
    let lines: String = lines.lines().map(|line| later(line) + "\n").collect();
    let file = folder.write("lines.jsonl", format!("\u{feff}{lines}"));
    run(&["import", "--lines", &file, "--hand", HAND, "--out", &folder.at("out.mcap")], 0);
    let mut expected = json_lines(lines.as_bytes());
    expected.retain(|line| line["topic"] == "/truth");
    assert_eq!(folder.exported("/truth"), expected);
    // The paper's label is no outcome of a lift, and keeps its meaning.
    let exported = text(&run(&["export", "recordings/held-out.mcap"], 0).stdout);
    let file = folder.write("held-out.jsonl", exported.clone());
    let lines_only =
        ["import", "--lines", &file, "--hand", HAND, "--overwrite", "--json", "--out", &folder.at("out.mcap")];
    let output = run(&lines_only, 0);
    assert_eq!(text(&output.stderr), "left out: 240 samples of /scene\n");
    let report: Value = serde_json::from_slice(&output.stdout).expect("a report");
    assert_eq!(
        (&report["n_kept"], &report["n_dropped"], &report["n_without_frames"]),
        (&json!(0), &json!(0), &json!(0))
    );
    let mut expected = json_lines(exported.as_bytes());
    expected.retain(|line| line["topic"] == "/truth");
    assert_eq!(expected[0]["label"], "wrench-space");
    assert_eq!(folder.exported("/truth"), expected);
    // Labels of two rules are no recording, and those without frames are counted.
    folder.write("held-out.jsonl", exported.replacen("wrench-space", "lift", 1));
    assert!(text(&run(&lines_only, 1).stderr).contains("this label is by another rule than those before"));
    let one: String = exported
        .lines()
        .filter(|line| line.contains("/truth") || line.contains("\"grasp_id\":0,"))
        .map(|line| line.to_string() + "\n")
        .collect();
    folder.write("held-out.jsonl", one);
    assert_eq!(
        serde_json::from_slice::<Value>(&run(&lines_only, 0).stdout).expect("a report")["n_without_frames"],
        239
    );
}

#[test]
fn columns_that_do_not_fit_are_refused() {
    let folder = Folder::new();
    folder.refuse(TABLE, &["--cells", "l_*,q_*"], 1, &["table.csv", "--cells", "'q_*'", "'l_*'"]);
    folder.refuse(TABLE, &["--cells", "l_*,rr_*"], 1, &["'rr_*'", "did you mean 'r_*'"]);
    folder.refuse(TABLE, &["--cells", "l_*"], 1, &["2 columns for the 3 cells of pincer", "left 2, right 1"]);
    // As many columns as cells, but not pad by pad.
    folder.refuse(TABLE, &["--cells", "l_1,*_2"], 1, &["'l_1' 1, '*_2' 1", "left 2, right 1"]);
    folder.refuse(TABLE, &["--cells", "r_1,l_*"], 1, &["'r_1' 1, 'l_*' 2", "left 2, right 1"]);
    folder.refuse(TABLE, &["--cells", "l_1,l_2,l_1"], 1, &["'l_1' is read twice"]);
    folder.refuse(TABLE, &["--cells", "l_*,held"], 1, &["'held' is read twice, by --cells and by --label"]);
    folder.refuse(TABLE, &["--label", "heldd"], 1, &["--label", "'heldd'", "did you mean 'held'?"]);
    folder.refuse(TABLE, &["--group", "thing"], 1, &["--group", "'thing'", "object, kind, held"]);
    folder.refuse(TABLE, &["--class", "Kind"], 1, &["--class", "did you mean 'kind'?"]);
    folder.refuse(TABLE.replace("l_2", "l_1"), &[], 1, &["line 1", "columns 4 and 5", "'l_1'"]);
    folder.refuse(TABLE, &["--joint-columns", "l_1"], 1, &["1 columns for the 2 joints", "left, right"]);
    folder.refuse(TABLE, &["--joints", "middle=1"], 1, &["middle", "left, right"]);
    folder.refuse(TABLE, &["--joints", "left=45"], 1, &["left", "45 rad"]);
    for separator in [";", "\t"] {
        folder.refuse(TABLE.replace(',', separator), &[], 1, &["line 1 has no comma", "blindgrasp.from_table"]);
    }
    folder.refuse(TABLE, &["--frames", "0"], 2, &["--frames"]);
    folder.refuse(TABLE, &["--hand", "pincers"], 1, &["pincers"]);
}

#[test]
fn files_that_are_no_tables_are_refused() {
    let folder = Folder::new();
    folder.refuse("", &[], 1, &["table.csv", "empty"]);
    folder.refuse("\u{feff}\r\n", &[], 1, &["table.csv", "empty"]);
    folder.refuse("object,kind,held,l_1,l_2,r_1\n", &[], 1, &["table.csv", "no row"]);
    for (bytes, found) in [
        (&b"\xff\xfeo\0b\0\n\0"[..], "UTF-8"),
        (b"PK\x03\x04", "a compressed file"),
        (b"PAR1", "a file of arrays"),
        (b"MATLAB 5.0 MAT-file\0\x01\xff", "UTF-8"),
    ] {
        folder.refuse(bytes, &[], 1, &["table.csv", found, "blindgrasp.from_table"]);
    }
    // A quote that is not closed makes the rest of the table one field.
    let rest = "x,".repeat(3 << 20);
    folder.refuse(format!("{TABLE}\"{rest}"), &[], 1, &["table.csv: line 4: a row of more than 4 MiB"]);
    folder.refuse(format!("object,\"{rest}"), &[], 1, &["table.csv: line 1: a row of more than 4 MiB"]);
    std::fs::remove_file(folder.at("table.csv")).expect("there");
    let arguments = folder.arguments(&[]);
    let absent = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), 1);
    assert!(text(&absent.stderr).contains("cannot read") && text(&absent.stderr).contains("table.csv"));
}

#[test]
fn labels_have_two_values_one_of_them_stable() {
    let folder = Folder::new();
    let two = ["column 'held'", "--stable-value", "'no' in 1 (line 3 first)", "'yes' in 1 (line 2 first)"];
    folder.refuse(TABLE, &["--stable-value", "1"], 1, &two);
    folder.refuse(TABLE, &["--stable-value", "Yes"], 1, &two);
    let three = format!("{TABLE}jar,,maybe,1,1,1\n");
    folder.refuse(three, &[], 1, &["expected two values", "'maybe' in 1 (line 4 first)"]);
    folder.refuse(TABLE.replace(",no,", ",yes,"), &[], 1, &["expected two values", "'yes' in 2"]);
    let many: String = (0..30).map(|idx| format!("cup,,{idx},1,1,1\n")).collect();
    folder.refuse(format!("{TABLE}{many}"), &[], 1, &["and 22 values more"]);
}

#[test]
fn each_bad_row_is_named() {
    let folder = Folder::new();
    let too_long = "ä".repeat(33);
    let rows = [
        ("cup,,yes,0.5,1.25", "expected 6 fields, as the header has, found 5"),
        ("cup,,yes,0.5,1.25,2,3", "expected 6 fields, as the header has, found 7"),
        ("cup,,yes,0.5,1.25,x", "column 'r_1': expected a number from 0 to 1000000, found 'x'"),
        ("cup,,yes,,1.25,2", "column 'l_1': expected a number from 0 to 1000000, found nothing"),
        ("cup,,yes,0.5,NaN,2", "column 'l_2': expected a number from 0 to 1000000, found 'NaN'"),
        ("cup,,yes,0.5,inf,2", "column 'l_2': expected a number from 0 to 1000000, found 'inf'"),
        ("cup,,yes,0.5,1e300,2", "column 'l_2': expected a number from 0 to 1000000, found '1e300'"),
        (
            "cup,,yes,-0.5,1.25,2",
            "column 'l_1': expected a number from 0 to 1000000, found '-0.5'; take readings below zero for 0: read it with pandas",
        ),
        (",,yes,0.5,1.25,2", "column 'object': expected a name, found nothing"),
        ("cup,,,0.5,1.25,2", "column 'held': expected a label, found nothing"),
        (&format!("{too_long},,no,0.5,1.25,2"), "column 'object': expected a name of at most 64 bytes, found 66"),
    ];
    let mut table = TABLE.replace('\n', "\r\n");
    let mut expected = Vec::new();
    for (idx, (row, problem)) in rows.iter().enumerate() {
        // A blank line before each: rows and lines are not the same.
        table.push_str(&format!("\r\n{row}\r\n"));
        expected.push(format!("line {}: {problem}", 5 + 2 * idx));
    }
    let named: Vec<&str> = expected.iter().map(String::as_str).collect();
    let summary = ["table.csv: 11 of 13 rows cannot be used", "leave them out with pandas"];
    folder.refuse(&table, &[], 1, &[&named[..], &summary].concat());

    // Noise around a tared zero is no bad row.
    let report = folder.import(TABLE.replacen("0.5", "-0.001", 1), &[]);
    assert_eq!((&report["n_below_zero"], &report["n_grasps"]), (&json!(1), &json!(2)));
}

#[test]
fn a_cell_may_be_missing_where_the_layout_says_so() {
    let folder = Folder::new();
    let row = "cup,,yes,0.5,,2\ncup,,no,NaN,null,2\n";
    let advice =
        "column 'l_2': expected a number from 0 to 1000000, found nothing; a pad whose cells may be missing says";
    folder.refuse(format!("{TABLE}{row}"), &[], 1, &[advice]);
    let layout = LAYOUT.replacen("{name: left,", "{name: left, may_be_missing: true,", 1);
    assert_ne!(layout, LAYOUT);
    folder.write("pincer.yaml", layout);
    let report = folder.import(format!("{TABLE}{row}"), &[]);
    assert_eq!((&report["n_grasps"], &report["n_missing"]), (&json!(4), &json!(2)));
    let cells = folder.exported("/tactile").pop().expect("a frame")["data"]["cells_newtons"].clone();
    assert_eq!(cells, json!([0.0, 0.0, 2.0]));
    std::fs::remove_file(folder.at("out.mcap")).expect("there");
    folder.refuse(format!("{TABLE}cup,,yes,0.5,1,\n"), &[], 1, &["column 'r_1': expected a number", "found nothing"]);
}

#[test]
fn bad_rows_are_counted_beyond_those_shown() {
    let folder = Folder::new();
    let bad: String = (0..25).map(|_| "cup,,yes,0.5,1.25,x\n").collect();
    let shown = ["25 of 27 rows", "line 4: ", "line 23: ", "and 5 more"];
    folder.refuse(format!("{TABLE}{bad}"), &[], 1, &shown);
    let latin = [TABLE.as_bytes(), b"b\xfccher,,no,1,1,1\n"].concat();
    folder.refuse(latin, &[], 1, &["line 4: field 1: expected UTF-8"]);
    let joints = "object,held,l_1,l_2,r_1,q_1,q_2\ncup,yes,1,1,1,0.5,90\nbox,no,1,1,1,0.5,0.5\n";
    folder.refuse(joints, &["--joint-columns", "q_*"], 1, &["line 2: column 'q_2'", "1.100 rad", "right", "'90'"]);
}

#[test]
fn values_in_another_unit_are_told() {
    let folder = Folder::new();
    let table = |angle: &str, reading: &str| {
        format!("object,held,l_1,l_2,r_1,q_1,q_2\ncup,yes,1,1,{reading},{angle},0\nbox,no,1,1,1,{angle},0\n")
    };
    let columns = ["--joint-columns", "q_*"];
    folder.refuse(table("45", "1"), &columns, 1, &["line 2: column 'q_1'", "convert degrees to radians"]);
    folder.refuse(table("0.5", "\"1,5\""), &columns, 1, &["'1,5'", "the decimal point is a dot", "from_table"]);
    assert_eq!(folder.import(table("0.5", "2"), &columns)["warnings"], json!([]));
    let warned = |table: String, expected: &str| {
        let report = folder.import(table, &columns);
        let warning = report["warnings"][0].as_str().expect("a warning");
        assert!(warning.contains(expected), "{warning}");
    };
    warned(table("0.5", "900"), "convert it to newtons");
    warned(table("0.5", "1").replacen("l_1,l_2", "l_10,l_9", 1), "'l_9' lies behind 'l_10'");
    // Both ways to give the posture are named.
    folder.write("table.csv", TABLE);
    let arguments: Vec<String> = folder.arguments(&[]).into_iter().filter(|word| word != "left=0.5").collect();
    let without: Vec<&str> = arguments.iter().map(String::as_str).filter(|word| *word != "--joints").collect();
    let refused = text(&run(&without, 2).stderr).to_string();
    assert!(refused.contains("--joints <JOINTS>") && refused.contains("--joint-columns <PATTERNS>"), "{refused}");
}

#[test]
fn existing_files_and_inputs_are_not_written_over() {
    let folder = Folder::new();
    let before = folder.write("before.mcap", "mine");
    folder.refuse(TABLE, &["--label", "x", "--out", &before], 1, &["'x'"]);
    assert_eq!(std::fs::read_to_string(&before).expect("there"), "mine");
    folder.refuse(TABLE, &["--out", &folder.at("table.csv")], 1, &["table.csv", "destroy"]);
    assert_eq!(std::fs::read_to_string(folder.at("table.csv")).expect("there"), TABLE);
}

#[test]
fn units_are_those_of_the_hand() {
    let folder = Folder::new();
    let in_counts = LAYOUT.replace("pads:", "cell_unit: counts\npads:");
    folder.write("pincer.yaml", in_counts);
    assert_eq!(folder.import(TABLE, &[])["cell_unit"], "counts");
    std::fs::remove_file(folder.at("out.mcap")).expect("there");
    folder.write("pincer.yaml", LAYOUT.replace("pads:", "cell_unit: grams\npads:"));
    folder.refuse(TABLE, &[], 1, &["pincer.yaml", "grams", "counts"]);
    let out = folder.at("simulated.mcap");
    for hand in ["shadow-biotac-sp", "hands/shadow-biotac-sp.yaml"] {
        fails(&["simulate", "--hand", hand, "--grasps", "1", "--out", &out], "read counts, no forces");
    }
    assert!(!Path::new(&out).exists());
}

#[test]
fn a_hand_in_counts_is_another_hand_and_newtons_are_what_they_were() {
    let path = project().join(HAND);
    let layout = std::fs::read_to_string(&path).expect("readable");
    let urdf = std::fs::read_to_string(path.with_extension("urdf")).expect("readable");
    let id = |layout: &str| Hand::parse(&path, layout, |_| Ok(urdf.clone())).expect("a hand").id();
    // The recording was made before layouts had a unit.
    let recording = project().join(RECORDING);
    let recorded = blindgrasp_recording::RecordingReader::open(&recording).expect("readable").info().hand_id;
    assert_eq!(id(&layout), recorded);
    assert_eq!(id(&layout.replace("pads:", "cell_unit: newtons\npads:")), recorded);
    assert_ne!(id(&layout.replace("pads:", "cell_unit: counts\npads:")), recorded);
}

#[test]
fn the_biotac_hand_feels_the_same_however_it_is_held() {
    let hand = Hand::load(Path::new("shadow-biotac-sp")).expect("built in");
    assert_eq!((hand.n_cells(), hand.pads.len(), hand.joints.len()), (72, 3, 1));
    let cells = hand.cells_in_palm(&[0.0]).expect("one joint");
    for pitch_rad in [0.785, 1.5, -1.0] {
        for (cell, turned) in cells.iter().zip(hand.cells_in_palm(&[pitch_rad]).expect("one joint")) {
            assert!((cell.position_in_palm_m - turned.position_in_palm_m).norm() < 1e-12);
            assert!((cell.normal_in_palm.into_inner() - turned.normal_in_palm.into_inner()).norm() < 1e-12);
        }
        let mut contacts = Vec::new();
        let found = contacts_from_frame(&hand, hand.id(), &[pitch_rad], &[3000.0; 72], &mut contacts);
        assert_eq!((contacts.len(), found.n_pads_in_contact, found.self_collision), (72, 3, false));
    }
    // The fingers' pads look at the thumb's, and the thumb's at theirs, 50 mm between the ellipsoids' surfaces.
    let palm_from_links = hand.palm_from_links(&[0.0]).expect("one joint");
    for (pad, y) in hand.pads.iter().zip([-1.0, -1.0, 1.0]) {
        let out = palm_from_links[pad.link_idx].rotation * -nalgebra::Vector3::y();
        assert!((out - nalgebra::Vector3::new(0.0, y, 0.0)).norm() < 1e-12, "{}: {out}", pad.name);
    }
    let y_of = |link_idx: usize| palm_from_links[link_idx].translation.y;
    let between_m = y_of(hand.pads[0].link_idx) - y_of(hand.pads[2].link_idx) - 2.0 * 0.008;
    assert!((between_m - 0.05).abs() < 1e-9, "{between_m}");
    // Normals look outwards, at right angles to the ellipsoid that most electrodes lie on.
    for (_, cell) in hand.cells() {
        let at = cell.position_in_link_m;
        let gradient = nalgebra::Vector3::new(
            at.x / 12.346e-3_f64.powi(2),
            at.y / 8.003e-3_f64.powi(2),
            at.z / 8.003e-3_f64.powi(2),
        );
        assert!((gradient.normalize() - cell.normal_in_link.into_inner()).norm() < 1e-6, "{at}");
        let along_ellipsoid = (at.x / 12.346e-3).powi(2) + (at.y.powi(2) + at.z.powi(2)) / 8.003e-3_f64.powi(2);
        assert!((0.9..1.003).contains(&along_ellipsoid), "{at}: {along_ellipsoid}");
    }
}

#[test]
fn the_biotac_electrodes_are_where_their_table_says() {
    let Some(path) = reference("biotac-sp/taxel-positions-inches.csv") else { return };
    let hand = Hand::load(Path::new("shadow-biotac-sp")).expect("built in");
    let text = std::fs::read_to_string(path).expect("readable");
    let rows: Vec<&str> = text.lines().skip(1).collect();
    assert_eq!(rows.len(), 24);
    for pad in &hand.pads {
        for (row, cell) in rows.iter().zip(&pad.cells) {
            let inches: Vec<f64> = row.split(',').skip(1).map(|number| number.parse().expect("a number")).collect();
            for (metres, inches) in cell.position_in_link_m.iter().zip(inches) {
                assert!((metres - 0.0254 * inches).abs() < 1e-9, "{row}");
            }
        }
    }
}

/// Sequences of the form of BioTacSP-DoS, made up: one reading says little of whether a contact slides, and the drift says it.
#[test]
fn a_fingertip_that_slides_is_told_by_its_movement_and_not_by_one_reading() {
    let folder = Folder::new();
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for (kind, least, drift) in [("t", 1500.0, 0.0), ("n", 2000.0, 8.0), ("cw", 2000.0, -8.0)] {
        std::fs::create_dir_all(folder.at(&format!("csvs/{kind}"))).expect("made");
        for (object, nth) in ('a'..='l').flat_map(|object| (0..4).map(move |nth| (object, nth))) {
            let begin = random.random_range(least..least + 1000.0);
            let row = |step: u32, random: &mut ChaCha8Rng| {
                let reading = |_| format!("{:.0}", begin + drift * f64::from(step) + random.random_range(-3.0..3.0));
                (1..=24).map(reading).collect::<Vec<_>>().join(",")
            };
            let names = (1..=24).map(|number| format!("ff_e{number}")).collect::<Vec<_>>().join(",");
            let rows: Vec<String> = (0..80).map(|step| row(step, &mut random)).collect();
            folder.write(&format!("csvs/{kind}/{object}{nth}.csv"), format!("{names}\n{}\n", rows.join("\n")));
        }
    }
    folder.write("csvs/t/short0.csv", "ff_e1\n1\n");
    let measured = benchsuite(&["slip", "--sequences", &folder.at("csvs"), "--no-build", "--json"]);
    let (stdout, stderr) = (text(&measured.stdout), text(&measured.stderr));
    assert!(measured.status.success() && stderr.contains("short0.csv: 1 readings"), "{stderr}");
    let found: Value = serde_json::from_str(&stdout).expect("JSON");
    let measured = &found["results"]["slip"];
    assert_eq!((&measured["n_grasps"], &measured["n_objects"]), (&json!(144), &json!(12)));
    let area = |look: &str| measured["roc_area"][look].as_f64().expect("an area");
    assert!(area("with_movement") > 0.95 && area("earlier_alone") < 0.9 && area("later_alone") < 0.9, "{measured}");
}

#[test]
fn the_biotac_set_is_4682_grasps_of_41_objects() {
    let Some(data) = reference("biotac-sp") else { return };
    let folder = Folder::new();
    let out = folder.at("biotac.mcap");
    let mut n_grasps = 0;
    for (name, palm_pitch, expected) in
        [("palm_down", "0", (1276, 667)), ("palm_45", "0.7854", (2133, 1058)), ("palm_side", "1.5708", (1273, 603))]
    {
        let table = data.join(format!("bts3v2_{name}.csv"));
        let (table, joints) = (table.to_str().expect("UTF-8"), format!("palm_pitch={palm_pitch}"));
        let cells = "ff_biotac_*,mf_biotac_*,th_biotac_*";
        let first = n_grasps.to_string();
        let output = run(
            &[
                "import",
                table,
                "--hand",
                "shadow-biotac-sp",
                "--joints",
                &joints,
                "--cells",
                cells,
                "--label",
                "slipped",
                "--stable-value",
                "0",
                "--group",
                "object",
                "--grasp-id-start",
                &first,
                "--overwrite",
                "--out",
                &out,
                "--json",
            ],
            0,
        );
        let report: Value = serde_json::from_slice(&output.stdout).expect("a report");
        assert_eq!((report["n_grasps"].as_u64(), report["n_stable"].as_u64()), (Some(expected.0), Some(expected.1)));
        assert_eq!(report["groups"].as_object().expect("groups").len(), 41);
        assert_eq!(report["pads"][1]["columns"][9], "mf_biotac_10");
        // The last row, number by number.
        let text = std::fs::read_to_string(table).expect("readable");
        let row: Vec<&str> = text.lines().last().expect("a row").split(',').collect();
        let frames = json_lines(&run(&["export", &out, "--topic", "/tactile"], 0).stdout);
        let last = &frames.last().expect("a frame")["data"];
        let expected: Vec<f64> = row[2..].iter().map(|field| field.parse().expect("a number")).collect();
        assert_eq!(last["cells_newtons"], json!(expected));
        n_grasps += report["n_grasps"].as_u64().expect("a number");
        assert_eq!(last["grasp_id"].as_u64(), Some(n_grasps - 1));
    }
    assert_eq!(n_grasps, 4682);
}
