//! `blindgrasp init`

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use blindgrasp_stages::hand::{builtin_files, builtin_names};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;

use super::schema::schema;
use super::{Outcome, print_line};

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
    /// Print JSON: {"folder", "files"}.
    #[arg(long)]
    json: bool,
}

/// The project's files: those that this repository's own default graph consists of.
pub(super) const FILES: [File; 10] = [
    ("dataflow.yaml", include_bytes!("../../dataflow.yaml")),
    ("dataflow-live.yaml", include_bytes!("../../dataflow-live.yaml")),
    ("tactile_bridge.py", include_bytes!("../../examples/tactile_bridge.py")),
    ("dataflow-machines.yaml", include_bytes!("../../dataflow-machines.yaml")),
    ("hands/barrett-bh8-280.yaml", include_bytes!("../../hands/barrett-bh8-280.yaml")),
    ("hands/barrett-bh8-280.urdf", include_bytes!("../../hands/barrett-bh8-280.urdf")),
    ("models/barrett-bh8-280.json", include_bytes!("../../models/barrett-bh8-280.json")),
    ("models/barrett-bh8-280-lifts.json", include_bytes!("../../models/barrett-bh8-280-lifts.json")),
    ("recordings/held-out.mcap", include_bytes!("../../recordings/held-out.mcap")),
    ("README.md", README.as_bytes()),
];

/// A path in the project, and the content.
type File = (&'static str, &'static [u8]);

/// The bridges of built-in hands.
const BRIDGES: [(&str, &[File]); 4] = [
    (
        "inspire-rh56dftp",
        &[("bridges/inspire_rh56dftp.py", include_bytes!("../../examples/bridges/inspire_rh56dftp.py")), LINES],
    ),
    (
        "robotiq-2f85-tsf85",
        &[
            ("bridges/robotiq_2f85_tsf85.py", include_bytes!("../../examples/bridges/robotiq_2f85_tsf85.py")),
            ("bridges/robotiq-2f85-tsf85.yaml", include_bytes!("../../examples/bridges/robotiq-2f85-tsf85.yaml")),
            ROS2,
            LINES,
        ],
    ),
    (
        "unitree-dex3-1",
        &[("bridges/unitree-dex3-1.yaml", include_bytes!("../../examples/bridges/unitree-dex3-1.yaml")), ROS2, LINES],
    ),
    ("uskin", &[("bridges/uskin.yaml", include_bytes!("../../examples/bridges/uskin.yaml")), ROS2, LINES]),
];
const LINES: File = ("bridges/line_protocol.py", include_bytes!("../../examples/bridges/line_protocol.py"));
const ROS2: File = ("bridges/ros2.py", include_bytes!("../../examples/bridges/ros2.py"));

/// The files of a built-in hand and of its bridge.
fn of_hand(name: &str) -> Vec<(String, &'static [u8])> {
    let layout_and_urdf = builtin_files(name).map(|(layout, urdf)| {
        [(format!("hands/{name}.yaml"), layout.as_bytes()), (format!("hands/{name}.urdf"), urdf.as_bytes())]
    });
    let bridge = BRIDGES.iter().filter(|(hand, _)| *hand == name).flat_map(|(_, files)| *files);
    let bridge = bridge.map(|(file, content)| ((*file).to_owned(), *content));
    layout_and_urdf.into_iter().flatten().chain(bridge).collect()
}

const SCHEMA: &str = "docs/dataflow.schema.json";

const README: &str = "\
# A blindgrasp project

```sh
blindgrasp run dataflow.yaml                        # decides the recorded grasps
blindgrasp run dataflow.yaml --detach --set recorded_source.repeat=forever
blindgrasp top                                      # what it does, live; q ends top
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

Next: `blindgrasp new operator NAME` makes an operator of your own, `blindgrasp train RECORDING --out models/mine.json`
a model; `blindgrasp --help` lists the rest.
";

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = &arguments.folder;
    let made_schema = schema();
    let mut files: Vec<(String, &[u8])> = FILES.iter().map(|(name, content)| ((*name).to_owned(), *content)).collect();
    // The dataflow files name it, for editors.
    files.push((SCHEMA.into(), made_schema.as_bytes()));
    for file in arguments.hand.iter().flat_map(|hand| of_hand(hand)) {
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
    print_line(&if arguments.json {
        json!({ "folder": folder, "files": names }).to_string()
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

fn write_new(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let mut file =
        std::fs::File::create_new(path).with_context(|| format!("cannot make the file {}", path.display()))?;
    std::io::Write::write_all(&mut file, content).with_context(|| format!("cannot write {}", path.display()))
}
