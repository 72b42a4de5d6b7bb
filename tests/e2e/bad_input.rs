//! Mistakes of users: each gives one clear error that names the file and the expected content.

use crate::common::mistakes::{Folder, check, read};
use crate::common::{HAND, MODEL, RECORDING, json_of, project, unique_name};

#[test]
fn hands() {
    let folder = Folder::new();
    let (layout, urdf) = (read(HAND), read("hands/barrett-bh8-280.urdf"));
    let cells = |layout: &str, urdf: &str, expected: &[&str]| {
        folder.write("barrett-bh8-280.urdf", urdf);
        let path = folder.write("hand.yaml", layout);
        check(&["info", &path], 1, expected);
    };
    cells("", &urdf, &["hand.yaml", "not a pad layout"]);
    cells(&layout.replace("pads:", "pds:"), &urdf, &["hand.yaml", "pds"]);
    cells(
        &layout.replace("blindgrasp-hand/1", "blindgrasp-hand/9"),
        &urdf,
        &["blindgrasp-hand/9", "blindgrasp-hand/1"],
    );
    cells(&layout.replace("link: distal_1", "link: thumb"), &urdf, &["pad 'finger_1'", "thumb", "distal_1"]);
    cells(&layout.replace("normal: [0, 0, 1]", "normal: [0, 0, 2]"), &urdf, &["pad 'palm', entry 0", "length 2"]);
    cells(&layout.replace("size_m: [0.01, ", "size_m: [0, "), &urdf, &["size_m", "positive"]);
    cells(&layout.replace("[spread, ", "["), &urdf, &["spread", "not listed"]);
    cells(&layout.replace("noise_threshold_newtons: 0.05", "noise_threshold_newtons: -1"), &urdf, &["noise_threshold"]);
    cells(&urdf, &urdf, &["this is a URDF", "pad layout"]);
    cells(&layout, "", &["barrett-bh8-280.urdf", "not a URDF"]);
    cells(&layout, &urdf[..urdf.len() / 2], &["barrett-bh8-280.urdf", "not a URDF"]);
    cells(&layout, &urdf.replace("upper=\"2.4435\"", "upper=\"nan\""), &["limits", "NaN"]);
    cells(&layout, &urdf.replace("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 0 0\"/>"), &["axis"]);
    cells(
        &layout,
        &urdf.replace("<child link=\"distal_1\"/>", "<child link=\"distal_2\"/>"),
        &["distal_2", "child of two joints"],
    );
    cells(
        &layout,
        &urdf.replace("name=\"finger_1\" type=\"revolute\"", "name=\"finger_1\" type=\"planar\""),
        &["finger_1", "is planar: it counts as fixed"],
    );
    check(&["info", "nosuchhand"], 1, &["nosuchhand"]);
    check(&["info", &folder.at("absent.yaml")], 1, &["absent.yaml"]);
    check(&["info", HAND, "--joints", "thumb=1"], 1, &["thumb", "finger_1"]);
    check(&["info", HAND, "--joints", "spread=9"], 1, &["spread", "9"]);
    check(&["info", HAND, "--joints", "spread=nan"], 1, &["spread"]);
    check(&["info", HAND, "--joints", "spread"], 2, &["NAME=VALUE"]);
    check(&["info", HAND, "--joints", "spread=1,spread=2"], 1, &["spread", "twice"]);
    cells(&layout, &urdf.replace("radius=\"0.0445\"", "radius=\"-1\""), &["hand_base", "-1"]);
    cells(&layout, &urdf.replace("radius=\"0.0445\"", "radius=\"1e300\""), &["hand_base", "metres"]);
    cells(&layout, &urdf.replace("<origin xyz=\"0 0 0.03775\"", "<origin xyz=\"nan 0 0\""), &["hand_base", "NaN"]);
    cells(&layout, &urdf.replace("multiplier=\"1\"", "multiplier=\"nan\""), &["spread_mirror", "mimic"]);
    cells(&layout, &urdf.replace("upper=\"2.4435\"", "upper=\"1e300\""), &["finger_1", "limits"]);
    cells(&layout, &urdf.replace("name=\"distal_3\">", "name=\"distal_2\">"), &["two links", "distal_2"]);
    let nested = format!("<robot>{}", "<link>".repeat(100_000));
    cells(&layout, &nested, &["line 1", "<link>", "'name'"]);
    cells(&layout.replace("margin_m: 0.0005", "margin_m: 1000"), &urdf, &["self_collision_margin_m"]);
    cells(
        &layout.replace("{joint: distal_2, follows", "{joint: distal_1, follows"),
        &urdf,
        &["distal_1", "two joints"],
    );
    check(&["info", "/dev/zero"], 1, &["/dev/zero", "a device, expected a regular file"]);
}

#[test]
fn recordings() {
    let folder = Folder::new();
    let whole = std::fs::read(project().join(RECORDING)).expect("readable");
    for (name, content) in [
        ("empty.mcap", &b""[..]),
        ("text.mcap", b"grasp,stable\n1,1\n"),
        ("cut.mcap", &whole[..whole.len() * 2 / 3]),
        ("start.mcap", &whole[..40]),
    ] {
        let path = folder.write(name, content);
        check(&["export", &path], 1, &[name]);
    }
    check(&["export", &folder.at("")], 1, &["recording"]);
}

#[test]
fn dataflows() {
    let folder = Folder::new();
    let whole = read("dataflow.yaml").replace(" recordings/", &format!(" {}/recordings/", project().display()));
    let whole = whole.replace(" models/", &format!(" {}/models/", project().display()));
    let whole = whole.replace(" hands/", &format!(" {}/hands/", project().display()));
    let name = unique_name();
    let flow = |what: &str, by: &str, expected: &[&str]| {
        assert!(whole.contains(what), "{what}");
        let path = folder.write("flow.yaml", whole.replacen(what, by, 1));
        check(&["run", "--name", &name, &path], 1, expected);
    };
    let line = |of: &str| {
        let idx = whole.lines().position(|line| line.contains(of)).expect("there");
        format!("flow.yaml:{}:", idx + 1)
    };
    flow("inputs: {tactile", "inptus: {tactile", &[&line("inputs: {tactile"), "inptus", "did you mean 'inputs'"]);
    flow("rate: 10", "rate: quick", &[&line("rate: 10"), "quick"]);
    flow("held-out.mcap", "absent.mcap", &[&line("held-out.mcap"), "absent.mcap"]);
    flow("  recorded_source:", "  recorded_source:\n    run: ./absent", &["absent"]);
    let path = folder.write("flow.yaml", "version: 1\nname: [\n");
    check(&["run", &path], 1, &["flow.yaml:"]);
    check(&["run", &folder.at("absent.yaml")], 1, &["absent.yaml"]);
    let path = folder.write("flow.yaml", &whole);
    for name in ["", "a/b", "../x", "ä", &"a".repeat(33)] {
        check(&["run", "--name", name, &path], 1, &["name", "letters, digits"]);
    }
    check(&["run", "--record", RECORDING, &path], 1, &["held-out.mcap", "destroy"]);
}

#[test]
fn a_file_of_another_kind_names_the_command_that_takes_it() {
    let folder = Folder::new();
    let table = folder.write("table.csv", "a,b\n1,2\n");
    check(&["info", &table], 1, &["table.csv", "blindgrasp import"]);
    check(&["info", MODEL], 1, &[MODEL, "blindgrasp model show"]);
    check(&["info", "dataflow.yaml"], 1, &["dataflow.yaml", "blindgrasp run starts it"]);
    check(&["replay", "dataflow.yaml"], 1, &["dataflow.yaml", "blindgrasp run starts it"]);
    check(&["run", RECORDING], 1, &[RECORDING, "not a dataflow file", "blindgrasp view shows it"]);
    check(&["run", MODEL], 1, &[MODEL, "not a dataflow file", "blindgrasp model show"]);
    check(&["run", HAND], 1, &[HAND, "not a dataflow file", "blindgrasp info prints it"]);
    check(&["predict", RECORDING, MODEL], 1, &["expected JSON made by blindgrasp train", "found a recording"]);
    check(&["predict", MODEL, &table], 1, &["table.csv", "expected frames", "blindgrasp import"]);
    // A file that is not there, and names that are nearly right.
    check(&["info", "recordings/held-uot.mcap"], 1, &["No such file", "its folder has", "held-out.mcap"]);
    check(&["info", "barett-bh8-280"], 1, &["did you mean 'barrett-bh8-280'?", "allegro"]);
    // Values in another unit.
    check(&["info", HAND, "--joints", "spread=45"], 1, &["45 rad", "45 degrees are 0.7854 rad"]);
    check(&["info", HAND, "--joints", "spread=45deg"], 2, &["'45deg' is not a number", "without the unit"]);
}

#[test]
fn usage() {
    check(&["fly"], 2, &["fly"]);
    check(&["run", "--fly"], 2, &["--fly"]);
    check(
        &["run", "--speed", "2"],
        2,
        &["tip: a parameter of an operator is given by --set", "Usage: blindgrasp run [OPTIONS]"],
    );
    check(&[], 2, &["Usage"]);
    for operator in ["recorded_source", "contacts", "encoder", "classifier", "lift_arbiter"] {
        check(&["operator", operator], 2, &["--describe"]);
        let description = json_of(&["operator", operator, "--describe"]);
        assert_eq!(description["operator"], operator);
    }
}
