//! Mistakes of users of the lab: each gives one clear error that names the file and the expected content.

use std::path::Path;

use crate::common::mistakes::{Folder, check, read};
use crate::common::{HAND, MODEL, RECORDING, project, run, text};

#[test]
fn models() {
    let folder = Folder::new();
    let model = read(MODEL);
    let show = |content: &str, expected: &[&str]| {
        let path = folder.write("model.json", content);
        check(&["model", "show", &path], 1, expected);
    };
    show("", &["model.json", "not a model"]);
    show(&model[..model.len() / 2], &["model.json", "cut off"]);
    show(
        &model.replace("blindgrasp-model/2", "blindgrasp-model/1"),
        &["blindgrasp-model/1", "blindgrasp-model/2", "train"],
    );
    show(&model.replacen("\"sigma_m\":0.03645", "\"sigma_m\":0.03646", 1), &["checksum"]);
    show("{\"format\": \"blindgrasp-model/2\"}", &["not a valid model", "hand"]);
    check(&["model", "show", "absent.json"], 1, &["absent.json"]);
    check(&["evaluate", MODEL, "absent.mcap"], 1, &["absent.mcap"]);
}

#[test]
fn recordings() {
    let folder = Folder::new();
    let whole = std::fs::read(project().join(RECORDING)).expect("readable");
    let (cut, model) = (folder.write("cut.mcap", &whole[..whole.len() * 2 / 3]), folder.at("model.json"));
    check(&["train", &cut, "--out", &model], 1, &["cut.mcap"]);
    check(&["evaluate", MODEL, &cut], 1, &["cut.mcap"]);
    assert!(!Path::new(&model).exists());
}

#[test]
fn training_data() {
    let folder = Folder::new();
    let (recording, model) = (folder.at("few.mcap"), folder.at("model.json"));
    run(&["simulate", "--objects", "ball", "--grasps", "20", "--stable-fraction", "1", "--out", &recording], 0);
    check(&["train", &recording, "--out", &model], 1, &["stable", "expected some of each"]);
    check(&["train", RECORDING, RECORDING, "--out", &model], 1, &[RECORDING, "twice"]);
    check(&["train", &recording, "--out", &recording], 1, &["few.mcap", "destroy"]);
    check(&["train", RECORDING, "--words", "0", "--out", &model], 2, &["--words"]);
    check(&["train", RECORDING, "--gamma", "0", "--out", &model], 2, &["--gamma"]);
    check(&["train", RECORDING, "--sigma-m", "0", "--out", &model], 2, &["--sigma-m"]);
    check(&["train", RECORDING, "--max-drops", "nan", "--out", &model], 2, &["--max-drops"]);
    check(&["train", "--out", &model], 2, &["RECORDING"]);
    assert!(!Path::new(&model).exists());
}

#[test]
fn simulations() {
    let folder = Folder::new();
    let out = folder.at("out.mcap");
    check(&["simulate", "--objects", "bal", "--out", &out], 1, &["bal", "ball"]);
    check(
        &["simulate", "--stable-fraction", "2", "--out", &out],
        2,
        &["--stable-fraction", "expected natural, or a number from 0 to 1; 2 % are 0.02"],
    );
    check(&["simulate", "--stable-fraction", "some", "--out", &out], 2, &["some", "natural"]);
    check(&["simulate", "--friction", "-1", "--out", &out], 2, &["--friction"]);
    check(&["simulate", "--out", "/nonexistent/out.mcap"], 1, &["/nonexistent", "no such folder"]);
    check(&["simulate"], 2, &["--out"]);
    let options = folder.write("options.yaml", "frictoin: 1\n");
    check(&["simulate", "--options", &options, "--out", &out], 1, &["options.yaml", "frictoin"]);
    let options = folder.write("options.yaml", "frames: {n_open: 99999999999}\n");
    check(&["simulate", "--options", &options, "--out", &out], 1, &["frames.n_open"]);
    // An earlier file makes room for what a simulation that gives up has done, and is not lost.
    let before = folder.write("before.mcap", "mine");
    let options = folder.write("options.yaml", "max_candidates_per_grasp: 0\n");
    let few = ["simulate", "--objects", "ball", "--stable-fraction", "0", "--grasps", "3000", "--options", &options];
    check(&[&few[..], &["--out", &before]].concat(), 1, &["the file exists", "--overwrite"]);
    for _ in 0..2 {
        check(&[&few[..], &["--overwrite", "--out", &before]].concat(), 1, &["gave up"]);
    }
    assert_eq!(std::fs::read_to_string(folder.at("before.before-1.mcap")).expect("there"), "mine");
    assert!(!Path::new(&out).exists() && !Path::new(&format!("{before}.partial")).exists());
}

#[test]
fn a_file_of_another_kind_names_the_command_that_takes_it() {
    let folder = Folder::new();
    let table = folder.write("table.csv", "a,b\n1,2\n");
    let (picture, out) = (folder.write("a.png", b"\x89PNG\r\n\x1a\n"), folder.at("out.json"));
    check(&["train", &table, "--out", &out], 1, &["table.csv", "expected an MCAP file", "blindgrasp import"]);
    check(&["train", &picture, "--out", &out], 1, &["a.png", "expected an MCAP file, found a picture"]);
    check(&["train", MODEL, "--out", &out], 1, &[MODEL, "a model", "blindgrasp model show"]);
    check(&["model", "show", HAND], 1, &[HAND, "the pad layout of a hand"]);
    let out = folder.at("out.mcap");
    check(&["simulate", "--hand", RECORDING, "--out", &out], 1, &["not a pad layout", "found a recording"]);
    check(&["simulate", "--out", &folder.at("out.csv")], 1, &["out.csv", ".mcap", "blindgrasp export"]);
    check(&["new", "hand", &folder.at("mine"), "--urdf", &table], 1, &["not a URDF", "found a table"]);
    let robot = "<robot><link name='a'/><link name='b'/><joint name='j' type='revolute'><parent link='a'/><child link='b'/>\
                 <limit lower='0' upper='1'/></joint></robot>";
    let bare = folder.write("bare.urdf", robot);
    let listed = run(&["new", "hand", &folder.at("mine"), "--urdf", &bare], 0);
    assert!(text(&listed.stderr).contains("no link has a collision shape"), "{}", text(&listed.stderr));
    // Values in another unit.
    check(&["train", RECORDING, "--max-drops", "5%", "--out", &out], 2, &["a number from", "5 % are 0.05"]);
    check(&["simulate", "--grasps", "many", "--out", &out], 2, &["'many'", "a whole number"]);
    // The text comes once.
    let text = text(&run(&["simulate", "--objects", "teapott", "--out", &out], 1).stderr).to_owned();
    assert_eq!(text.matches("did you mean 'teapot'?").count(), 1, "{text}");
}
