//! Hands of every kind: grippers and hands of many joints from their URDF to decisions, `blindgrasp new hand`, pictures of hands.

use std::path::Path;

use crate::common::mistakes::read;
use crate::common::python::{python, utf8};
use crate::common::{blindgrasp, json_of, report_data, run, text};

/// Runs a command in a folder.
fn run_in(folder: &Path, arguments: &[&str], exit_code: i32) -> (String, String) {
    let mut command = blindgrasp();
    // xacro lies beside Python.
    let programs = python().parent().expect("a folder");
    let path = std::env::join_paths([programs, Path::new("/usr/bin"), Path::new("/bin")]).expect("a path");
    let output = command.current_dir(folder).args(arguments).env("PATH", path).output().expect("started");
    let (stdout, stderr) = (text(&output.stdout).to_owned(), text(&output.stderr).to_owned());
    assert_eq!(output.status.code(), Some(exit_code), "blindgrasp {arguments:?}\n{stdout}\n{stderr}");
    (stdout, stderr)
}

/// As in docs/hands.md, with fewer lifts. Other tests train and run with lifts.
#[test]
fn hands_that_people_own_lift_in_simulation() {
    for (hand, n_lifts) in [
        ("inspire-rh56dftp", "6"),
        ("robotiq-2f85-tsf85", "8"),
        ("uskin", "6"),
        ("unitree-dex3-1", "8"),
        ("allegro", "6"),
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        run(&["init", utf8(folder.path()), "--hand", hand], 0);
        let simulate = ["simulate", "--hand", hand, "--protocol", "planned", "--objects", "box,can,mug"];
        let few = ["--label", "lift", "--stable-fraction", "natural", "--grasps", n_lifts, "--out", "lifts.mcap"];
        let (said, _) = run_in(folder.path(), &[&simulate[..], &few].concat(), 0);
        let n_grasps = format!("grasps            {n_lifts}, ");
        assert!(said.contains(&n_grasps) && !said.contains(" 0.0 % stable"), "{hand}: {said}");
    }
}

/// Such a hand has the name and identity of the built-in one.
#[test]
fn grasps_are_read_with_the_thresholds_of_the_hand_that_made_them() {
    let folder = tempfile::tempdir().expect("a folder");
    run(&["init", utf8(folder.path())], 0);
    let layout = folder.path().join("hands/barrett-bh8-280.yaml");
    let dull = read(utf8(&layout)).replace("newtons: 0.05", "newtons: 2");
    std::fs::write(layout.with_file_name("dull.yaml"), dull).expect("written");
    let simulate = ["simulate", "--hand", "hands/dull.yaml", "--grasps", "20", "--seed", "1", "--out", "dull.mcap"];
    run_in(folder.path(), &simulate, 0);
    let felt = |more: &[&str]| {
        let (said, _) = run_in(folder.path(), &[&["info", "dull.mcap"], more].concat(), 0);
        said.lines().find(|line| line.starts_with("without contact")).expect("a line").to_owned()
    };
    assert_eq!(felt(&[]), felt(&["--hand", "hands/dull.yaml"]));
    assert_ne!(felt(&[]), felt(&["--hand", "barrett-bh8-280"]));
    // Recordings of two layouts have no thresholds in common.
    let both = ["info", "--full", "dull.mcap", "recordings/held-out.mcap"];
    let (_, errors) = run_in(folder.path(), &both, 1);
    assert!(errors.contains("differs from that of dull.mcap: say with --hand which one counts"), "{errors}");
    run_in(folder.path(), &[&both[..], &["--hand", "hands/dull.yaml"]].concat(), 0);
}

#[test]
fn planned_lifts_are_felt_more_often_than_blind_ones() {
    let folder = tempfile::tempdir().expect("a folder");
    // Of the candidates: a blind approach often meets nothing.
    let share_felt = |approach: &str| {
        let out = utf8(&folder.path().join(format!("{approach}.mcap"))).to_owned();
        let lift =
            ["simulate", "--hand", "parallel-gripper", "--label", "lift", "--protocol", approach, "--grasps", "20"];
        let report = json_of(&[&lift[..], &["--stable-fraction", "natural", "--json", "--out", &out]].concat());
        let frames = text(&run(&["export", &out], 0).stdout).to_owned();
        let settled = frames.lines().filter(|line| line.contains("\"phase\":\"settled\""));
        let felt: std::collections::BTreeSet<String> = settled
            .filter_map(|line| {
                let frame: serde_json::Value = serde_json::from_str(line).expect("JSON");
                let cells = frame["data"]["cells_newtons"].as_array()?;
                cells.iter().any(|cell| cell.as_f64() > Some(0.05)).then(|| frame["data"]["grasp_id"].to_string())
            })
            .collect();
        felt.len() as f64 / report["n_candidates"].as_f64().expect("a number")
    };
    let (blind, planned) = (share_felt("blind"), share_felt("planned"));
    assert!(planned > 1.2 * blind, "{planned} of the planned candidates are felt, {blind} of the blind ones");
}

/// A gripper as ROS has it: a xacro macro for both jaws, and a mesh of a package.
const XACRO: &str = r#"<robot name="gripper" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:macro name="jaw" params="side sign">
  <link name="${side}_jaw"><collision><origin xyz="0 ${sign * 0.006} 0.03"/>
    <geometry><mesh filename="package://my_gripper/meshes/jaw.obj" scale="0.001 0.001 0.001"/></geometry></collision></link>
</xacro:macro>
<link name="base"><collision><origin xyz="0 0 -0.03"/><geometry><box size="0.06 0.1 0.06"/></geometry></collision></link>
<xacro:jaw side="left" sign="1"/>
<xacro:jaw side="right" sign="-1"/>
<joint name="jaw" type="prismatic"><parent link="base"/><child link="left_jaw"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="0.04"/></joint>
<joint name="right" type="prismatic"><parent link="base"/><child link="right_jaw"/><axis xyz="0 -1 0"/>
  <limit lower="0" upper="0.04"/><mimic joint="jaw"/></joint>
</robot>"#;

/// A box of 20 x 12 x 60 mm around the origin, in millimetres.
fn jaw_obj() -> String {
    let corners: String = (0..8)
        .map(|idx| {
            let side = |bit: usize, half: i32| if idx & bit == 0 { -half } else { half };
            format!("v {} {} {}\n", side(1, 10), side(2, 6), side(4, 30))
        })
        .collect();
    let faces = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"];
    corners + &faces.map(|face| format!("f {face}\n")).concat()
}

/// A ROS package with the gripper.
fn package(folder: &Path) {
    for name in ["my_gripper/urdf", "my_gripper/meshes"] {
        std::fs::create_dir_all(folder.join(name)).expect("made");
    }
    std::fs::write(folder.join("my_gripper/urdf/gripper.urdf.xacro"), XACRO).expect("written");
    std::fs::write(folder.join("my_gripper/meshes/jaw.obj"), jaw_obj()).expect("written");
}

const URDF: &str = "my_gripper/urdf/gripper.urdf.xacro";

#[test]
fn a_hand_is_made_from_xacro_with_meshes_and_grids() {
    let folder = tempfile::tempdir().expect("a folder");
    package(folder.path());
    let new = ["new", "hand", "mine", "--urdf", URDF, "--open", "jaw=0.04"];
    let grids = ["--grid", "left_jaw=4x3", "--grid", "right_jaw=4x3"];
    let (stdout, _) = run_in(folder.path(), &[&new[..], &grids[..]].concat(), 0);
    assert!(
        stdout.contains("prismatic") && stdout.contains("0.0000 m") && stdout.contains("2 pads, 24 cells"),
        "{stdout}"
    );
    let made = folder.path().join("mine");
    let urdf = std::fs::read_to_string(made.join("mine.urdf")).expect("a URDF");
    assert!(urdf.contains("filename=\"meshes/jaw.obj\"") && !urdf.contains("package://"), "{urdf}");
    assert!(made.join("meshes/jaw.obj").is_file());
    // Around a hand that a robot keeps away from things, no cell feels any.
    let guard = "<link name=\"guard\"><collision><geometry><sphere radius=\"0.3\"/></geometry></collision></link>\
                 <joint name=\"guard_joint\" type=\"fixed\"><parent link=\"base\"/><child link=\"guard\"/></joint></robot>";
    std::fs::write(made.join("guarded.urdf"), urdf.replace("</robot>", guard)).expect("written");
    let guarded = ["new", "hand", "guarded", "--urdf", "mine/guarded.urdf", "--open", "jaw=0.04"];
    let (_, stderr) = run_in(folder.path(), &[&guarded[..], &grids[..]].concat(), 0);
    let told = "12 of the 12 cells of pad 'left_jaw' lie inside the collision shapes of link 'guard'";
    assert!(stderr.contains(told), "{stderr}");
    // The cells lie on the inner faces of the meshes' hulls and look at each other.
    let (cells, stderr) = run_in(folder.path(), &["info", "mine/mine.yaml", "--joints", "jaw=0.02", "--json"], 0);
    assert!(stderr.is_empty(), "{stderr}");
    let cells: serde_json::Value = serde_json::from_str(&cells).expect("JSON");
    for cell in cells.as_array().expect("cells") {
        let side = if cell["pad"] == "left_jaw" { 1.0 } else { -1.0 };
        let number = |key: &str, idx: usize| cell[key][idx].as_f64().expect("a number");
        assert!((number("position_m", 1) - side * 0.02).abs() < 1e-6, "{cell}");
        assert!((number("normal", 1) + side).abs() < 1e-6, "{cell}");
    }
    let simulate = ["simulate", "--hand", "mine/mine.yaml", "--protocol", "planned", "--grasps", "10"];
    let few = ["--objects", "box,can,mug", "--stable-fraction", "natural", "--out", "grasps.mcap"];
    run_in(folder.path(), &[&simulate[..], &few].concat(), 0);
}

/// The command that makes another hand of the gripper.
fn other<'a>(more: &[&'a str]) -> Vec<&'a str> {
    [&["new", "hand", "other", "--urdf", "gripper.urdf"][..], more].concat()
}

#[test]
fn a_hand_is_made_from_a_table_of_cells() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("gripper.urdf"), read("hands/parallel-gripper.urdf")).expect("written");
    // Names that YAML would take for numbers stay names.
    let table = "link,pad,x,y,z,nx,ny,nz,threshold\nleft_jaw,1.0,0,0,0.03,0,-1,0,0.2\nleft_jaw,1.0,0,0,0.04,0,-1,0,\n\
                 right_jaw,right,0,0,0.03,0,1,0,\n";
    let write = |table: &str| std::fs::write(folder.path().join("cells.csv"), table).expect("written");
    write(table);
    let new = ["new", "hand", "mine", "--urdf", "gripper.urdf", "--cells", "cells.csv", "--open", "jaw=0.0425"];
    let (stdout, _) = run_in(folder.path(), &new, 0);
    assert!(stdout.contains("2 pads, 3 cells") && stdout.contains("no width and height"), "{stdout}");
    let layout = std::fs::read_to_string(folder.path().join("mine/mine.yaml")).expect("a layout");
    assert!(
        layout.contains("at_m: [0, 0, 0.03], normal: [0, -1, 0], along: [0, 0, 1], size_m: [0.008, 0.008]"),
        "{layout}"
    );
    assert!(layout.contains("noise_threshold_newtons: 0.05}"), "{layout}");

    // Nothing is overwritten, and a hand that is refused leaves no folder.
    let (_, stderr) = run_in(folder.path(), &new, 1);
    assert!(stderr.contains("mine is there already"), "{stderr}");
    let from_table = |table: &str, expected: &[&str]| {
        write(table);
        let (_, stderr) = run_in(folder.path(), &other(&["--cells", "cells.csv"]), 1);
        assert!(expected.iter().all(|part| stderr.contains(part)), "{expected:?} in {stderr}");
        assert!(!folder.path().join("other").exists());
    };
    from_table(&table.replace("0,-1,0", "0,1,0"), &["pad '1.0'", "points into the link"]);
    from_table(&table.replace("0.03", "30"), &["metres, not millimetres"]);
    from_table(&table.replace("left_jaw", "thumb"), &["no link 'thumb'", "left_jaw"]);
    from_table(&table.replace("0,-1,0", "0,0,0"), &["a normal without a direction"]);
    from_table(&table.replace("nx", "normal"), &["cells.csv", "nx"]);
    for (more, expected) in [
        (&["--grid", "thumb=2x2"][..], "no link 'thumb'"),
        (&["--grid", "left_jaw=2x2", "--open", "jaw=1"], "open: 'jaw' is 1"),
        (&["--grid", "left_jaw=2x2", "--preshape", "wrist"], "'wrist' is not listed"),
        (&["--grid", "left_jaw=2x2", "--palm-pose", "0,0,0,0,0,0"], "--palm-pose needs --palm"),
    ] {
        let (_, stderr) = run_in(folder.path(), &other(more), 1);
        assert!(stderr.contains(expected), "{more:?}: {stderr}");
        assert!(!folder.path().join("other").exists());
    }
    // Without cells, joints and links are listed.
    let (stdout, _) = run_in(folder.path(), &other(&[]), 0);
    assert!(stdout.contains("jaw") && stdout.contains("nothing is made yet"), "{stdout}");
    // A palm frame that looks into the gripper is said, with the one that fits.
    let grid = ["--grid", "left_jaw=2x2", "--grid", "right_jaw=2x2", "--palm", "palm"];
    let (_, stderr) = run_in(folder.path(), &other(&[&grid[..], &["--palm-pose", "0,0,0,3.14159,0,0"]].concat()), 0);
    assert!(stderr.contains("closes on an object before --palm-pose 0,0,0,0,0,0"), "{stderr}");
    assert!(stderr.contains("these pads come near to none: left_jaw, right_jaw"), "{stderr}");
}

/// A COLLADA file of a box of a finger, in millimetres.
fn finger_dae() -> String {
    let corners = (0..8).map(|idx| {
        let side = |bit: usize, half: i32| if idx & bit == 0 { -half } else { half };
        format!("{} {} {}", side(1, 7), side(2, 8), side(4, 22))
    });
    let faces = ["0 2 3 1", "4 5 7 6", "0 1 5 4", "2 6 7 3", "0 4 6 2", "1 3 7 5"];
    format!(
        "<COLLADA><asset><unit meter='0.001'/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id='g'><mesh>\
         <source id='p'><float_array id='a' count='24'>{}</float_array></source><vertices id='v'><input semantic='POSITION' \
         source='#p'/></vertices><polylist count='6'><input semantic='VERTEX' source='#v' offset='0'/><vcount>4 4 4 4 4 4\
         </vcount><p>{}</p></polylist></mesh></geometry></library_geometries></COLLADA>",
        corners.collect::<Vec<_>>().join(" "),
        faces.join(" ")
    )
}

/// A hand of three fingers and a thumb, whose fingers run along +z of the palm and close towards +x, as many makers write it.
/// It is in the encoding of their country, with joints that mimic joints that mimic others, with joints and shapes that are
/// none.
fn makers_urdf() -> Vec<u8> {
    let link = |name: &str| {
        format!(
            "<link name='{name}'><collision><origin xyz='0 0 0.022'/><geometry><mesh filename = 'finger.dae'/><other:convex/>\
             </geometry></collision><collision><geometry><sphere radius='0'/></geometry></collision></link>"
        )
    };
    let mut parts = String::new();
    let fingers = [
        ("f1", "-0.007 -0.03 0.091' rpy='0 0 0", "0 1 0", "0"),
        ("f2", "-0.007 0 0.091' rpy='0 0 0", "0 1 0", "0"),
        ("f3", "-0.007 0.03 0.091' rpy='0 0 0", "0 1 0", "0"),
        // The thumb stands at right angles to the palm.
        ("t", "0.002 0 0.007' rpy='0 1.5708 0", "0 -1 0", "-0.6"),
    ];
    for (finger, origin, axis, lower) in fingers {
        parts += &[link(&format!("{finger}_1")), link(&format!("{finger}_2"))].concat();
        parts += &format!(
            "<joint name='{finger}_a' type='revolute'><parent link='palm'/><child link='{finger}_1'/><origin xyz='{origin}'/>\
             <axis xyz='{axis}'/><limit lower='{lower}' upper='1.5'/><limit effort='1'/></joint>\
             <joint name='{finger}_b' type='revolute'><parent link='{finger}_1'/><child link='{finger}_2'/><origin xyz='0 0 \
             0.045'/><axis xyz='{axis}'/><mimic joint='{finger}_a' multiplier='0.5'/></joint>"
        );
    }
    let nail = "<link name='nail'/><joint name='nail' type='revolute'><parent link='f1_2'/><child link='nail'/>\
                <axis xyz='0 1 0'/><mimic joint='f1_b' multiplier='2'/></joint>\
                <link name='camera'/><joint name='tilt' type='revolute'><parent link='palm'/><child link='camera'/>\
                <axis xyz='0 1 0'/><limit lower='0.2' upper='0.2'/></joint>";
    let text = format!(
        "<?xml version='1.0' encoding='iso-8859-1'?>\n<!-- H\u{e4}nde --><robot name='maker'><link name='palm'><collision>\
         <origin xyz='-0.01 0 0.045'/><geometry><box size='0.02 0.09 0.09'/></geometry></collision></link>{parts}{nail}</robot>"
    );
    text.chars().map(|char| char as u8).collect()
}

#[test]
fn a_makers_urdf_becomes_a_hand_that_closes_on_objects() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("maker.urdf"), makers_urdf()).expect("written");
    std::fs::write(folder.path().join("finger.dae"), finger_dae()).expect("written");
    let mut new: Vec<String> = ["new", "hand", "mine", "--urdf", "maker.urdf"].map(String::from).into();
    for link in ["palm", "f1_2", "f2_2", "f3_2", "t_2"] {
        new.extend(["--grid".into(), format!("{link}=3x2")]);
    }
    let new: Vec<&str> = new.iter().map(String::as_str).collect();
    let (stdout, stderr) = run_in(folder.path(), &new, 0);
    assert!(stdout.contains("5 pads, 30 cells") && !stdout.contains("f1_b "), "{stdout}");
    for expected in [
        "joint 'tilt' has the limits 0.2 and 0.2: it counts as fixed at 0.2 rad",
        "link 'f1_1': a sphere of size [0.0]",
        "the hand closes on an object before --palm palm --palm-pose",
    ] {
        assert!(stderr.contains(expected), "{expected}: {stderr}");
    }
    let made = folder.path().join("mine");
    let urdf = std::fs::read_to_string(made.join("mine.urdf")).expect("UTF-8");
    assert!(urdf.contains("encoding=\"UTF-8\"") && urdf.contains("H\u{e4}nde"), "{urdf}");
    assert!(urdf.contains("<mesh filename=\"meshes/finger.dae\"/>") && made.join("meshes/finger.dae").is_file());
    let layout = std::fs::read_to_string(made.join("mine.yaml")).expect("a layout");
    assert!(layout.contains("reference_link: \"blindgrasp_palm\""), "{layout}");
    let simulate = ["simulate", "--hand", "mine/mine.yaml", "--protocol", "planned", "--grasps", "12", "--json"];
    let (report, _) =
        run_in(folder.path(), &[&simulate[..], &["--stable-fraction", "natural", "--out", "grasps.mcap"]].concat(), 0);
    let report: serde_json::Value = serde_json::from_str(&report).expect("JSON");
    let report = report.get("report").unwrap_or(&report);
    assert!(report["n_stable"].as_u64().expect("a count") > 0, "{report}");
}

/// $(find) by package.xml, as ROS finds it, and an argument without which the hand has no side.
#[test]
fn xacro_needs_no_ros() {
    let folder = tempfile::tempdir().expect("a folder");
    let package = folder.path().join("my_gripper-main");
    std::fs::create_dir_all(package.join("urdf")).expect("made");
    std::fs::write(package.join("package.xml"), "<package><name>my_gripper</name></package>").expect("written");
    let of = |text: &str| format!("<robot name='g' xmlns:xacro='http://www.ros.org/wiki/xacro'>{text}</robot>");
    let joint = "<link name='$(arg side)_palm'/><link name='finger'/><joint name='j' type='revolute'><parent \
                 link='$(arg side)_palm'/><child link='finger'/><axis xyz='0 0 1'/><limit lower='0' upper='1'/></joint>";
    std::fs::write(package.join("urdf/parts.xacro"), of(joint)).expect("written");
    let top = "<xacro:arg name='side' default=''/><xacro:include filename='$(find my_gripper)/urdf/parts.xacro'/>";
    std::fs::write(package.join("urdf/top.urdf.xacro"), of(top)).expect("written");
    let new = ["new", "hand", "mine", "--urdf", "my_gripper-main/urdf/top.urdf.xacro", "--xacro-arg", "side:=left"];
    let (stdout, _) = run_in(folder.path(), &new, 0);
    assert!(stdout.contains("left_palm"), "{stdout}");
    let (_, stderr) =
        run_in(folder.path(), &["new", "hand", "mine", "--urdf", "my_gripper-main/urdf/none.urdf.xacro"], 1);
    assert!(stderr.contains("none.urdf.xacro"), "{stderr}");
    std::fs::write(package.join("urdf/top.urdf.xacro"), of(&top.replace("my_gripper", "nowhere"))).expect("written");
    let (_, stderr) = run_in(folder.path(), &new, 1);
    assert!(stderr.contains("$(find nowhere): no package 'nowhere'"), "{stderr}");
}

/// The arm does not become a part of the hand.
#[test]
fn a_hand_is_made_from_the_urdf_of_a_whole_robot() {
    let folder = tempfile::tempdir().expect("a folder");
    let arm = "<link name=\"world\"/>\n<joint name=\"wrist\" type=\"revolute\"><parent link=\"world\"/><child link=\"palm\"/>\
               <axis xyz=\"0 0 1\"/><limit lower=\"-3\" upper=\"3\"/></joint>\n</robot>";
    let robot = read("hands/parallel-gripper.urdf").replace("</robot>", arm);
    std::fs::write(folder.path().join("gripper.urdf"), robot).expect("written");
    let grids = ["--open", "jaw=0.0425", "--grid", "left_jaw=2x2", "--grid", "right_jaw=2x2"];
    let (_, stderr) = run_in(folder.path(), &other(&[&grids[..], &["--palm", "palm"]].concat()), 1);
    assert!(stderr.contains("joint 'wrist' moves the palm: give the first link of the hand with --base"), "{stderr}");
    let (stdout, _) = run_in(folder.path(), &other(&[&grids[..], &["--base", "palm"]].concat()), 0);
    assert!(stdout.contains("2 pads, 8 cells") && !stdout.contains("wrist"), "{stdout}");
    let (_, stderr) = run_in(folder.path(), &["new", "hand", "third", "--urdf", "gripper.urdf", "--base", "thumb"], 1);
    assert!(stderr.contains("--base: the URDF has no link 'thumb'"), "{stderr}");
}

#[test]
fn a_urdf_in_which_nothing_moves_is_told_why() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |urdf: &str, more: &[&str]| {
        std::fs::write(folder.path().join("gripper.urdf"), urdf).expect("written");
        run_in(folder.path(), &other(more), 1).1
    };
    let said = refused(XACRO, &[]);
    assert!(said.contains("it is a xacro file: give it a name that ends in .xacro"), "{said}");
    let locked = "<robot name=\"r\"><link name=\"base\"/><link name=\"jaw\"/><joint name=\"slide\" type=\"prismatic\">\
                  <parent link=\"base\"/><child link=\"jaw\"/><axis xyz=\"0 1 0\"/><limit lower=\"0\" upper=\"0\"/></joint></robot>";
    let said = refused(locked, &[]);
    assert!(said.contains("0 joints, expected 1 to 32: joint 'slide' has the limits 0 and 0"), "{said}");
    let said = refused(&locked.replace("prismatic", "fixed"), &[]);
    assert!(said.contains("no joint of the type revolute, continuous or prismatic"), "{said}");
    let said = refused(&locked.replace("upper=\"0\"", "upper=\"0.1\""), &["--base", "jaw"]);
    assert!(said.contains("below --base jaw nothing moves: name a link above it"), "{said}");
    let said = refused(&locked.replace("upper=\"0\"", "upper=\"1.3\""), &[]);
    assert!(said.contains("0..1.3") && said.contains("give the first link of the hand with --base LINK"), "{said}");
}

#[test]
fn a_mesh_of_another_computer_is_copied_beside_the_hand() {
    let folder = tempfile::tempdir().expect("a folder");
    package(folder.path());
    let moved = XACRO.replace("package://my_gripper", "/home/someone/ws");
    std::fs::write(folder.path().join("my_gripper/urdf/gripper.urdf.xacro"), moved).expect("written");
    let new = ["new", "hand", "mine", "--urdf", URDF, "--open", "jaw=0.04", "--grid", "left_jaw=4x3"];
    let (_, stderr) = run_in(folder.path(), &new, 0);
    assert!(
        stderr.contains("mesh /home/someone/ws/meshes/jaw.obj is not there") && stderr.contains("is taken"),
        "{stderr}"
    );
    assert!(folder.path().join("mine/meshes/jaw.obj").is_file());
}

#[test]
fn a_hand_is_drawn_by_itself() {
    let folder = tempfile::tempdir().expect("a folder");
    let html = folder.path().join("hand.html");
    run(&["view", "hands/parallel-gripper.yaml", "--joints", "jaw=0.01", "--out", utf8(&html)], 0);
    let page = report_data(&std::fs::read_to_string(&html).expect("a page"));
    let data = &page["data"];
    assert_eq!((&data["title"], &data["is_hand_alone"]), (&"Hand parallel-gripper".into(), &true.into()));
    assert_eq!(data["facts"][2], serde_json::json!(["cells", "24"]));
    let joints = data["joints"].as_array().expect("joints");
    let jaw = joints.iter().find(|joint| joint["name"] == "jaw").expect("a joint");
    assert_eq!((&jaw["value"], &jaw["unit"]), (&0.01.into(), &"m".into()));
    assert!(page["drawn"]["frames"].as_array().expect("frames").len() > 1, "it closes");
    run(&["view", "allegro", "--out", utf8(&html)], 0);
    assert!(std::fs::read_to_string(&html).expect("a page").contains("\"title\":\"Hand allegro\""));
    let error = text(&run(&["view", "allegro"], 2).stderr).to_owned();
    assert!(error.contains("--out is missing"), "{error}");
    let error = text(&run(&["view", "allegro", "--joints", "joint_1=9", "--out", utf8(&html)], 1).stderr).to_owned();
    assert!(
        error.contains("joint 'joint_1' is 9 rad, expected -0.1960 to 1.6100; 9 degrees are 0.1571 rad"),
        "{error}"
    );
}

/// A palm with three fingers that close to its axis, and more links and joints.
fn fingers_urdf(more: &str) -> String {
    let mut fingers = String::new();
    for (idx, place) in
        ["0.05 0 0' rpy='0 0 0", "-0.025 0.0433 0' rpy='0 0 2.0944", "-0.025 -0.0433 0' rpy='0 0 -2.0944"]
            .iter()
            .enumerate()
    {
        fingers += &format!(
            "<link name='f{idx}'><collision><origin xyz='0 0 0.05'/><geometry><box size='0.012 0.02 0.09'/></geometry></collision>\
             </link><joint name='j{idx}' type='revolute'><parent link='palm'/><child link='f{idx}'/><origin xyz='{place}'/>\
             <axis xyz='0 -1 0'/><limit lower='-0.4' upper='1.2'/></joint>"
        );
    }
    format!(
        "<robot name='fingers'><link name='palm'><collision><origin xyz='0 0 -0.015'/><geometry><cylinder radius='0.05' \
         length='0.03'/></geometry></collision></link>{fingers}{more}</robot>"
    )
}

#[test]
fn a_wrist_beside_a_palm_with_a_pad_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let wrist = "<link name='forearm'/><joint name='wrist' type='revolute'><parent link='forearm'/><child link='palm'/>\
                 <axis xyz='0 1 0'/><limit lower='-0.7' upper='0.5'/></joint>";
    std::fs::write(folder.path().join("gripper.urdf"), fingers_urdf(wrist)).expect("written");
    let fingers = ["--grid", "f0=3x2", "--grid", "f1=3x2", "--grid", "f2=3x2"];
    for palm in [&[][..], &["--grid", "palm=3x3"]] {
        let (_, stderr) = run_in(folder.path(), &other(&[&fingers[..], palm].concat()), 1);
        assert!(stderr.contains("joint 'wrist' moves all pads together"), "{palm:?}: {stderr}");
    }
}

#[test]
fn cells_on_sensor_frames_belong_to_the_finger() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut frames, mut table) = (String::new(), "link,x,y,z,nx,ny,nz\n".to_owned());
    for idx in 0..3 {
        frames += &format!(
            "<link name='s{idx}'/><joint name='s{idx}' type='fixed'><parent link='f{idx}'/><child link='s{idx}'/><origin \
             xyz='-0.006 0 0.07' rpy='0 -1.5708 0'/></joint>"
        );
        table += &format!("s{idx},0,0,0,0,0,1\n");
    }
    std::fs::write(folder.path().join("gripper.urdf"), fingers_urdf(&frames)).expect("written");
    std::fs::write(folder.path().join("cells.csv"), table).expect("written");
    let (_, stderr) = run_in(folder.path(), &other(&["--cells", "cells.csv"]), 0);
    assert!(stderr.contains("the cells of 3 pads lie on links without collision shapes"), "{stderr}");
    assert!(!stderr.contains("where they feel nothing"), "{stderr}");
    let layout = std::fs::read_to_string(folder.path().join("other/other.yaml")).expect("a layout");
    assert!(layout.contains("{name: \"s1\", link: \"f1\"") && layout.contains("at_m: [-0.006, 0, 0.07]"), "{layout}");
    assert!(layout.contains("normal: [-1, 0,"), "{layout}");
}

#[test]
fn a_jaw_closes_on_a_fixed_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let jaw = "<geometry><box size='0.008 0.024 0.09'/></geometry></collision>";
    let urdf = format!(
        "<robot name='jaw'><link name='base'><collision><origin xyz='0 0 -0.02'/><geometry><box size='0.06 0.03 0.04'/></geometry>\
         </collision><collision><origin xyz='0.012 0 0.045'/>{jaw}</link><link name='jaw'><collision><origin xyz='0 0 0.045'/>\
         {jaw}</link><joint name='j' type='revolute'><parent link='base'/><child link='jaw'/><origin xyz='-0.006 0 0'/>\
         <axis xyz='0 -1 0'/><limit lower='-0.17' upper='1.74'/></joint></robot>"
    );
    std::fs::write(folder.path().join("gripper.urdf"), urdf).expect("written");
    let (stdout, stderr) = run_in(folder.path(), &other(&["--grid", "base=4x3", "--grid", "jaw=4x3"]), 0);
    assert!(stderr.contains("--open j=1.74"), "{stderr}");
    assert!(stdout.contains("planned grasps"), "{stdout}");
    // The cells of the fixed jaw look at the other one.
    let layout = std::fs::read_to_string(folder.path().join("other/other.yaml")).expect("a layout");
    assert!(layout.contains("normal: [-1, 0, 0]") && layout.contains("normal: [1, 0, 0]"), "{layout}");
    // Until it has a model of its own, a plain rule is one.
    let rule = ["model", "rule", "--hand", "other/other.yaml", "--newtons", "4", "--out", "rule.json"];
    let says = "a plain rule: 2 of 2 (fingers, palm) feel, together 4 newtons or more";
    let (stdout, _) = run_in(folder.path(), &rule, 0);
    assert!(stdout.contains(says), "{stdout}");
    let (shown, _) = run_in(folder.path(), &["model", "show", "rule.json", "--json"], 0);
    assert!(shown.contains("\"kind\": \"loads\"") && shown.contains("\"least_newtons\": 4.0"), "{shown}");
    let (shown, _) = run_in(folder.path(), &["model", "show", "rule.json"], 0);
    assert!(!shown.contains("trained on") && shown.contains(&format!("test-lifted: {says}")), "{shown}");
}
