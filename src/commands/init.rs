//! `blindgrasp init`

use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use blindgrasp_stages::hand::{builtin_files, builtin_names};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;

use super::schema::SCHEMA;
use super::{Outcome, print_text};

/// Write a new project that runs at once
///
/// Write a new project that runs: a dataflow, a hand, a model trained for it, and a recording to try it on.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp init my-robot && blindgrasp run my-robot/dataflow.yaml")]
pub(super) struct Arguments {
    /// The project's folder; made if it is not there. Files that are there are not overwritten.
    folder: PathBuf,
    /// Add the files of another built-in hand, and its bridge.
    #[arg(long, value_name = "NAME", value_parser = PossibleValuesParser::new(builtin_names()))]
    hand: Option<String>,
    /// Add the packages for a robot in ROS 2: nodes, and messages.
    #[arg(long)]
    ros2: bool,
    /// Print JSON: {"folder", "files"}.
    #[arg(long)]
    json: bool,
}

/// A path in the project, and the content.
type File = (&'static str, &'static [u8]);

/// Files that have the same path in a project as below a folder of this repository.
macro_rules! files {
    ($folder:literal: $($name:literal,)+) => {
        &[$(($name, include_bytes!(concat!("../../", $folder, $name)))),+]
    };
}

/// The project's files: those that this repository's own default graph consists of.
const FILES: &[File] = files! { "":
    "dataflow.yaml", "dataflow-live.yaml", "dataflow-machines.yaml",
    "hands/barrett-bh8-280.yaml", "hands/barrett-bh8-280.urdf",
    "models/barrett-bh8-280.json", "models/barrett-bh8-280-lifts.json", "recordings/held-out.mcap",
};
const MORE_FILES: [File; 2] =
    [("tactile_bridge.py", include_bytes!("../../examples/tactile_bridge.py")), ("README.md", README.as_bytes())];

/// The bridges of built-in hands.
const BRIDGES: [(&str, &[File]); 4] = [
    ("inspire-rh56dftp", files! { "examples/": "bridges/inspire_rh56dftp.py", "bridges/line_protocol.py", }),
    (
        "robotiq-2f85-tsf85",
        files! { "examples/":
            "bridges/robotiq_2f85_tsf85.py", "bridges/robotiq-2f85-tsf85.yaml", "bridges/line_protocol.py",
        },
    ),
    ("unitree-dex3-1", files! { "examples/": "bridges/unitree-dex3-1.yaml", }),
    ("uskin", files! { "examples/": "bridges/uskin.yaml", }),
];

/// The packages of ROS 2: nodes and messages.
const ROS2_FILES: &[File] = files! { "examples/":
    "blindgrasp_ros/blindgrasp_ros/line_protocol.py", "blindgrasp_ros/launch/gate.launch.py",
    "blindgrasp_ros/package.xml", "blindgrasp_ros/resource/blindgrasp_ros", "blindgrasp_ros/setup.cfg",
    "blindgrasp_ros/setup.py", "blindgrasp_ros/blindgrasp_ros/__init__.py",
    "blindgrasp_ros/blindgrasp_ros/decisions.py", "blindgrasp_ros/blindgrasp_ros/gripper_gate.py",
    "blindgrasp_ros/blindgrasp_ros/hand.py", "blindgrasp_ros/blindgrasp_ros/lift_gate.py",
    "blindgrasp_ros/blindgrasp_ros/node.py", "blindgrasp_msgs/CMakeLists.txt", "blindgrasp_msgs/package.xml",
    "blindgrasp_msgs/msg/Contact.msg", "blindgrasp_msgs/msg/ContactSet.msg", "blindgrasp_msgs/msg/Decision.msg",
    "blindgrasp_msgs/msg/GraspFeature.msg", "blindgrasp_msgs/msg/GraspScene.msg",
    "blindgrasp_msgs/msg/GraspTruth.msg", "blindgrasp_msgs/msg/Header.msg", "blindgrasp_msgs/msg/LiftDecision.msg",
    "blindgrasp_msgs/msg/LiftOutcome.msg", "blindgrasp_msgs/msg/Prediction.msg",
    "blindgrasp_msgs/msg/SceneContact.msg", "blindgrasp_msgs/msg/TactileFrame.msg", "blindgrasp_msgs/srv/Decide.srv",
};

/// The files of a built-in hand and of its bridge.
fn of_hand(name: &str) -> Vec<(String, &'static [u8])> {
    let layout_and_urdf = builtin_files(name).map(|(layout, urdf)| {
        [(format!("hands/{name}.yaml"), layout.as_bytes()), (format!("hands/{name}.urdf"), urdf.as_bytes())]
    });
    let bridge = BRIDGES.iter().filter(|(hand, _)| *hand == name).flat_map(|(_, files)| *files);
    let bridge = bridge.map(|(file, content)| ((*file).to_owned(), *content));
    layout_and_urdf.into_iter().flatten().chain(bridge).collect()
}

const README: &str = "\
# A blindgrasp project

```sh
blindgrasp run dataflow.yaml                        # decides the recorded grasps
blindgrasp run dataflow.yaml --detach --set recorded_source.repeat=forever
blindgrasp top                                      # rates, latencies, decisions; Ctrl-C ends it
blindgrasp stop
```

| here | is |
|---|---|
| `dataflow.yaml` | the graph: which operators run, what they read, their parameters |
| `dataflow-live.yaml` | the graph for a hand that lifts, with its model: a bridge sends the frames; `blindgrasp trials` tries it in simulated physics |
| `tactile_bridge.py` | a bridge to begin with: `blindgrasp export recordings/held-out.mcap --topic /tactile \\| ./tactile_bridge.py` |
| `dataflow-machines.yaml` | the same graph on two machines |
| `hands/` | the Barrett hand BH8-280: kinematics (URDF) and pad layout; describe your own beside it. `init --hand NAME` adds another one, with its bridge in `bridges/` |
| `models/` | models of that hand: by the paper's label for `dataflow.yaml`, and of lifts (`…-lifts.json`) for an arm |
| `recordings/` | 240 simulated grasps of objects that the model has not been trained on |
| `docs/` | the schema of the dataflow files, with which an editor completes and checks them |

Next: `blindgrasp new operator NAME` makes an operator of your own, `blindgrasp learn HAND.yaml` a model of your
hand; `blindgrasp --help` lists the rest.
";

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = &arguments.folder;
    let mut files: Vec<(String, &[u8])> =
        FILES.iter().chain(&MORE_FILES).map(|(name, content)| ((*name).to_owned(), *content)).collect();
    // The dataflow files name it, for editors.
    files.push(("docs/dataflow.schema.json".into(), SCHEMA.as_bytes()));
    let of_hand: Vec<_> = arguments.hand.iter().flat_map(|hand| of_hand(hand)).collect();
    // The table of a hand's topics is for a node of the package.
    let has_table = of_hand.iter().any(|(name, _)| name.starts_with("bridges/") && name.ends_with(".yaml"));
    let of_ros2: &[File] = if arguments.ros2 || has_table { ROS2_FILES } else { &[] };
    let of_ros2 = of_ros2.iter().map(|(name, content)| ((*name).to_owned(), *content));
    for file in of_hand.into_iter().chain(of_ros2) {
        if files.iter().all(|(name, _)| *name != file.0) {
            files.push(file);
        }
    }
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    let taken: Vec<&str> = names.iter().copied().filter(|name| folder.join(name).exists()).collect();
    if !taken.is_empty() {
        bail!("{} has {} already: choose a new folder, or move them away", folder.display(), taken.join(", "));
    }
    for (name, content) in &files {
        write_new(&folder.join(name), content)?;
    }
    print_text(&if arguments.json {
        json!({ "folder": folder.display().to_string(), "files": names }).to_string()
    } else {
        format!(
            "{}: {}\n\nblindgrasp run {}",
            folder.display(),
            names.join(", "),
            folder.join("dataflow.yaml").display()
        )
    })?;
    Ok(Outcome::Done)
}

/// Writes a file, which can be run if it is a script.
fn write_new(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let mode = if content.starts_with(b"#!") { 0o777 } else { 0o666 };
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true).mode(mode);
    let mut file = options.open(path).with_context(|| format!("cannot make the file {}", path.display()))?;
    std::io::Write::write_all(&mut file, content).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_project_gets_all_files_of_the_packages_of_ros_2() {
        let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
        let mut folders = vec![examples.join("blindgrasp_msgs"), examples.join("blindgrasp_ros")];
        let mut found = Vec::new();
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).expect("a folder") {
                let path = entry.expect("an entry").path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_none_or(|extension| extension != "pyc") {
                    found.push(path);
                }
            }
        }
        found.sort();
        let mut written = Vec::new();
        for (name, content) in ROS2_FILES {
            let path = examples.join(name);
            assert!(std::fs::read(&path).expect("readable") == *content, "{name} gets the content of another file");
            written.push(path);
        }
        written.sort();
        assert_eq!(written, found);
    }
}
