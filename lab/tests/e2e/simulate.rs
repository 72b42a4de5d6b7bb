//! Simulations in parts give the same bytes in one run, in shards, and after an interruption.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use crate::common::{MODEL, blindgrasp, fails, json_of, run, text};
use serde_json::Value;

/// Four parts of 15 grasps and one of 3.
fn arguments<'a>(options: &'a str, out: &'a str) -> Vec<&'a str> {
    vec!["simulate", "--objects", "box,mug", "--grasps", "63", "--seed", "3", "--options", options, "--out", out]
}

fn options(folder: &Path) -> String {
    let path = folder.join("options.yaml");
    std::fs::write(&path, "grasps_per_part: 15\n").expect("written");
    path.to_str().expect("UTF-8").into()
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries.map(|path| (path.file_name().expect("a name").into(), std::fs::read(&path).expect("read"))).collect()
}

#[test]
fn one_run_shards_and_an_interrupted_run_give_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let options = options(folder.path());
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let (whole, shards, stopped) = (at("whole"), at("shards"), at("stopped"));
    run(&arguments(&options, &whole), 0);
    let expected = files(Path::new(&whole));
    assert_eq!(expected.len(), 6, "five parts and the manifest");

    for shard in ["1/3", "0/3", "2/3"] {
        let mut arguments = arguments(&options, &shards);
        arguments.extend(["--shard", shard]);
        run(&arguments, 0);
    }
    assert!(files(Path::new(&shards)) == expected, "the shards differ from the one run");

    let mut child = blindgrasp()
        .args(arguments(&options, &stopped))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("started");
    let second = Path::new(&stopped).join("part-00001.mcap");
    while !second.exists() && child.try_wait().expect("a child").is_none() {
        std::thread::sleep(Duration::from_millis(2));
    }
    let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&child), rustix::process::Signal::KILL);
    child.wait().expect("ended");
    let info = run(&["info", &stopped], if files(Path::new(&stopped)).len() < 6 { 1 } else { 0 });
    if files(Path::new(&stopped)).len() < 6 {
        assert!(text(&info.stderr).contains("parts are missing"), "{}", text(&info.stderr));
    }
    run(&arguments(&options, &stopped), 0);
    assert!(files(Path::new(&stopped)) == expected, "the interrupted run differs");

    // A power failure may leave an empty file, which is no part.
    std::fs::write(&second, "").expect("written");
    std::fs::write(Path::new(&stopped).join("simulation.json.1-2"), "").expect("written");
    let repaired = run(&arguments(&options, &stopped), 0);
    assert!(text(&repaired.stderr).contains("made again"), "{}", text(&repaired.stderr));
    std::fs::remove_file(Path::new(&stopped).join("simulation.json.1-2")).expect("still there");
    assert!(files(Path::new(&stopped)) == expected, "the repaired run differs");

    let other_seed: Vec<&str> =
        arguments(&options, &stopped).into_iter().map(|word| if word == "3" { "4" } else { word }).collect();
    fails(&other_seed, "options.seed is 3, now it is 4");
}

#[test]
fn info_adds_up_and_agrees_with_the_simulations_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let options = options(folder.path());
    let data = folder.path().join("data").to_str().expect("UTF-8").to_string();
    let mut arguments = arguments(&options, &data);
    arguments.push("--json");
    let report = json_of(&arguments);
    let info = json_of(&["info", &data, "--json"]);
    assert_eq!((&info["n_grasps"], &info["n_with_truth"]), (&63.into(), &63.into()));
    assert_eq!(info["recordings"].as_array().map(Vec::len), Some(5));
    assert_eq!(info["n_stable"], report["n_stable"]);
    assert_eq!(info["n_stable"], 30, "0.48 of 63, rounded");
    // Of the simulator's active cells some feel another link: they are no contacts.
    assert!(info["n_without_contact"].as_u64() >= report["n_without_active_cell"].as_u64());
    let sum: u64 =
        ["box", "mug"].iter().map(|class| info["classes"][class]["n_grasps"].as_u64().expect("a class")).sum();
    assert_eq!(sum, 63);
    let mut quantiles =
        info["epsilon_quantiles"].as_array().expect("five").iter().map(|v| v.as_f64().expect("a number"));
    assert!(quantiles.clone().is_sorted() && quantiles.all(|epsilon| epsilon > 0.0));
}

#[test]
fn a_file_is_interrupted_whole_and_leaves_nothing_else() {
    // The last one is of a terminal that is closed.
    for signal in [rustix::process::Signal::INT, rustix::process::Signal::HUP] {
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().join("big.mcap");
        interrupted(&out, signal);
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 1);
        run(&["info", out.to_str().expect("UTF-8")], 0);
        let before = std::fs::read(&out).expect("a recording");
        interrupted(&out, signal);
        let kept = std::fs::read(folder.path().join("big.before-1.mcap")).expect("the recording before");
        assert!(kept == before && out.is_file());
    }
}

/// Makes a recording of a simulation that gets a signal after its first grasps.
fn interrupted(out: &Path, signal: rustix::process::Signal) {
    let mut child = blindgrasp()
        .args(["simulate", "--objects", "box", "--grasps", "1000000", "--overwrite"])
        .args(["--out", out.to_str().expect("UTF-8")])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    let mut said = BufReader::new(child.stderr.take().expect("piped"));
    let mut line = String::new();
    said.read_line(&mut line).expect("read");
    assert!(line.contains(" of 1000000 grasps"), "{line}");
    rustix::process::kill_process(rustix::process::Pid::from_child(&child), signal).expect("signalled");
    said.read_to_string(&mut line).expect("read");
    assert_eq!(child.wait().expect("ended").code(), Some(1));
    assert!(line.contains("interrupted: the first "), "{line}");
}

#[test]
fn the_best_of_several_planned_approaches_is_better_than_the_first() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_string();
    let n_stable = |n_approaches: usize| {
        std::fs::write(at("options.yaml"), format!("planner: {{n_approaches: {n_approaches}}}\n")).expect("written");
        let arguments =
            "simulate --objects box,ball,mug --grasps 100 --seed 1 --stable-fraction natural --json --protocol planned";
        let (options, out) = (at("options.yaml"), at("planned.mcap"));
        let arguments: Vec<&str> =
            arguments.split(' ').chain(["--options", options.as_str(), "--overwrite", "--out", out.as_str()]).collect();
        let report = json_of(&arguments);
        report["n_stable"].as_u64().expect("a count")
    };
    let (first, best) = (n_stable(1), n_stable(16));
    assert!(best > first, "{first} and {best} of 100 are stable");
}

#[test]
fn options_show_the_label() {
    let printed = |more: &[&str]| {
        let output = run(&[&["simulate", "--print-options"], more].concat(), 0);
        text(&output.stdout).to_string()
    };
    assert!(printed(&[]).contains("label: wrench-space"));
    assert!(printed(&["--label", "wrench-space"]).contains("label: wrench-space"));
    let lift = printed(&["--label", "lift"]);
    assert_eq!((lift.matches("label:").count(), lift.matches("friction_factor:").count()), (1, 1), "{lift}");
    let folder = tempfile::tempdir().expect("a folder");
    let options = folder.path().join("options.yaml");
    std::fs::write(&options, &lift).expect("written");
    let options = options.to_str().expect("UTF-8");
    assert_eq!(printed(&["--options", options]), lift);
    assert!(printed(&["--options", options, "--label", "wrench-space"]).contains("label: wrench-space"));
    let unknown = run(&["simulate", "--label", "shake", "--print-options"], 2);
    assert!(text(&unknown.stderr).contains("expected wrench-space or lift"), "{}", text(&unknown.stderr));
    let own = printed(&["--thresholds", "0.03,0.02"]);
    assert!(own.contains("epsilon: 0.03") && own.contains("volume: 0.02"), "{own}");
    let both = ["simulate", "--label", "lift", "--thresholds", "0.03,0.02", "--out", "x.mcap"];
    fails(&both, "option thresholds is set");
}

#[test]
fn recordings_of_lifts_are_named_as_such_by_every_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("lifted.mcap").to_str().expect("UTF-8").to_string();
    let arguments = "simulate --label lift --objects ball,box --grasps 3 --seed 2 --stable-fraction natural --out";
    let arguments: Vec<&str> = arguments.split(' ').chain([out.as_str()]).collect();
    let said = run(&arguments, 0);
    assert!(text(&said.stdout).contains("kept while lifted and shaken"), "{}", text(&said.stdout));

    let info = json_of(&["info", &out, "--json"]);
    assert_eq!(info["labels"], serde_json::json!(["lift"]));
    let own = info["metadata"]["simulation"]["report"].as_str().expect("the simulation's report");
    assert_eq!(serde_json::from_str::<Value>(own).expect("JSON")["label"], "lift");
    let printed = run(&["info", &out], 0);
    assert!(text(&printed.stdout).contains("label             lift (stable: kept"), "{}", text(&printed.stdout));

    let printed = text(&run(&["evaluate", MODEL, &out], 0).stdout);
    assert!(printed.contains("label: lift (stable: kept"), "{printed}");
}

#[test]
fn objects_are_listed_and_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("bottles");
    let out = out.to_str().expect("UTF-8");
    let listed = json_of(&["simulate", "--list", "--objects", "bottle", "--json"]);
    let listed = listed.as_array().expect("a list");
    let table = text(&run(&["simulate", "--list", "--objects", "bottle"], 0).stdout);
    assert_eq!(table.lines().count(), listed.len() + 1);
    for (row, line) in listed.iter().zip(table.lines().skip(1)) {
        assert!(line.starts_with(row["name"].as_str().expect("a name")), "{line}");
        assert_eq!(row["class"], "bottle");
        assert!(
            row["size_m"][2].as_f64().expect("metres") > 0.01 && row["n_triangles"].as_u64().expect("a number") > 10
        );
    }
    run(&["simulate", "--list", "--objects", "bottle", "--out", out], 0);
    let files = || {
        let mut files: Vec<_> = std::fs::read_dir(out).expect("made").flatten().map(|entry| entry.path()).collect();
        files.sort();
        files.into_iter().map(|path| (path.clone(), std::fs::read(path).expect("readable"))).collect::<Vec<_>>()
    };
    let first = files();
    assert_eq!(first.len(), listed.len() + 1, "a mesh each and the catalogue");
    let catalogue = std::fs::read_to_string(Path::new(out).join("catalogue.csv")).expect("written");
    let rows: Vec<Vec<&str>> = catalogue.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0], ["file", "name", "class", "scale", "mass_kg", "split"]);
    for (row, object) in rows[1..].iter().zip(listed) {
        assert_eq!(
            (row[1], row[5]),
            (object["name"].as_str().expect("a name"), object["split"].as_str().expect("a split"))
        );
        assert!(Path::new(out).join(row[0]).is_file());
    }
    run(&["simulate", "--list", "--objects", "bottle", "--out", out], 0);
    assert!(first == files(), "the same bytes again");
    // The written folder is a folder of meshes.
    let back = json_of(&["simulate", "--list", "--objects", out, "--json"]);
    for (found, written) in back.as_array().expect("a list").iter().zip(listed) {
        for field in ["name", "class", "mass_kg", "split", "size_m"] {
            assert_eq!(found[field], written[field]);
        }
    }
}
