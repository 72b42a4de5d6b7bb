//! `blindgrasp export`: where it writes, and what it refuses.

use std::io::Read;
use std::path::Path;
use std::process::Stdio;

use crate::common::python::utf8;
use crate::common::{MODEL, RECORDING, blindgrasp, json_lines, json_of, project, run, text};

fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("readable").flatten();
    let mut names: Vec<_> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Fails, and says each of `says`.
fn refused(arguments: &[&str], says: &[&str]) {
    let output = run(&[&["export"], arguments].concat(), 1);
    let errors = text(&output.stderr);
    assert!(output.stdout.is_empty(), "{}", text(&output.stdout));
    assert!(says.iter().all(|what| errors.contains(what)), "{says:?} in {errors}");
}

#[test]
fn lines_to_a_file_are_those_to_stdout() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("truth.jsonl");
    let stdout = run(&["export", RECORDING, "--topic", "/truth"], 0).stdout;
    assert!(run(&["export", RECORDING, "--topic", "/truth", "--out", utf8(&path)], 0).stdout.is_empty());
    assert_eq!(std::fs::read(&path).expect("written"), stdout);
    let first = &json_lines(&stdout)[0];
    let keys: Vec<_> = first.as_object().expect("an object").keys().map(String::as_str).collect();
    assert_eq!(keys, ["data", "epoch", "hand_id", "label", "seq", "stamp_nanos", "topic"]);
    assert_eq!(names_in(folder.path()), ["truth.jsonl"]);
}

#[test]
fn a_column_of_features_says_what_it_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("features.csv");
    let made = text(&run(&["export", RECORDING, "--features", MODEL, "--out", utf8(&path)], 0).stdout);
    let table = std::fs::read_to_string(&path).expect("written");
    let header: Vec<&str> = table.lines().next().expect("a header").split(',').collect();
    let named =
        ["recording", "grasp_id", "object", "object_class", "stable", "hand_id", "dictionary_id", "hist_0", "hist_1"];
    assert_eq!(header[..named.len()], named);
    for column in ["hist_7", "palm.load", "finger_1.max_force", "spread.position", "distal_3.breakaway"] {
        assert!(header.contains(&column), "{column}: {header:?}");
    }
    // Every grasp with a label and a contact has a row, and every row as many numbers as the header says.
    let data = json_of(&["evaluate", RECORDING, "--split", "object", "--folds", "2", "--recipe", "boosted", "--json"]);
    let n_judged = data["data"]["n_judged"].as_u64().expect("a number");
    assert_eq!(table.lines().count() as u64, 1 + n_judged);
    assert!(made.contains(&format!("{n_judged} grasps, {} values each", header.len() - 7)), "{made}");
    assert!(table.lines().all(|row| row.split(',').count() == header.len()));
}

#[test]
fn refused_exports_leave_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| utf8(&folder.path().join(name)).to_string();
    let arguments = [RECORDING, "--topic", "/truth", "--topic", "/trut", "--out", &at("x")];
    refused(&arguments, &["held-out.mcap", "/trut:", "/scene, /tactile, /truth"]);
    refused(&[RECORDING, "--topic", "/truth", "--out", &at("no/x")], &["no such folder"]);
    refused(&[RECORDING, "--topic", "/truth", "--out", "/dev/null"], &["/dev/null"]);
    refused(&[RECORDING, "--topic", "/trut"], &["/scene, /tactile, /truth"]);
    assert!(names_in(folder.path()).is_empty(), "{:?}", names_in(folder.path()));
}

#[test]
fn the_recording_is_never_written_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| utf8(&folder.path().join(name)).to_string();
    let whole = std::fs::read(project().join(RECORDING)).expect("read");
    for (name, out) in [("a.mcap", at("a.mcap")), ("a.partial", at("a"))] {
        std::fs::write(at(name), &whole).expect("copied");
        refused(&[&at(name), "--topic", "/truth", "--out", &out], &[name, "destroy"]);
        assert_eq!(std::fs::read(at(name)).expect("read"), whole, "{name}");
        std::fs::remove_file(at(name)).expect("removed");
    }
    assert!(names_in(folder.path()).is_empty(), "{:?}", names_in(folder.path()));
}

#[test]
fn a_damaged_recording_leaves_what_was_there() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| utf8(&folder.path().join(name)).to_string();
    let mut bytes = std::fs::read(project().join(RECORDING)).expect("read");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(at("damaged.mcap"), bytes).expect("written");
    std::fs::write(at("t"), "of yesterday").expect("written");
    let (damaged, out) = (at("damaged.mcap"), at("t"));
    let arguments = [damaged.as_str(), "--topic", "/truth", "--out", &out];
    let of_whole = [&[RECORDING], &arguments[1..]].concat();
    refused(&of_whole, &["t: the file exists", "--overwrite"]);
    refused(&[&arguments[..], &["--overwrite"]].concat(), &["damaged.mcap"]);
    assert_eq!(std::fs::read_to_string(&out).expect("there"), "of yesterday");
    let output = run(&["export", RECORDING, &damaged, "--features", MODEL, "--out", &out, "--overwrite"], 1);
    let errors = text(&output.stderr);
    assert!(errors.contains("damaged.mcap") && !errors.contains("cannot write"), "{errors}");
    assert_eq!(std::fs::read_to_string(&out).expect("there"), "of yesterday");
    assert_eq!(names_in(folder.path()), ["damaged.mcap", "t"]);
}

#[test]
fn a_reader_may_close_the_pipe_early() {
    let mut child = blindgrasp()
        .args(["export", RECORDING, "--topic", "/tactile"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    let mut stdout = child.stdout.take().expect("piped");
    stdout.read_exact(&mut [0; 10]).expect("read");
    drop(stdout);
    let output = child.wait_with_output().expect("waited");
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()));
}
