//! `blindgrasp init`

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
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
    /// Print JSON: {"folder", "files"}.
    #[arg(long)]
    json: bool,
}

/// The project's files: those that this repository's own default graph consists of.
pub(super) const FILES: [(&str, &[u8]); 10] = [
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
| `hands/` | the Barrett hand BH8-280: kinematics (URDF) and pad layout; describe your own beside it |
| `models/` | models of that hand: by the paper's label for `dataflow.yaml`, and of lifts (`…-lifts.json`) for an arm |
| `recordings/` | 240 simulated grasps of objects that the model has not been trained on |
| `docs/` | the schema of the dataflow files, with which an editor completes and checks them |

Next: `blindgrasp new operator NAME` makes an operator of your own, `blindgrasp train RECORDING --out models/mine.json`
a model; `blindgrasp --help` lists the rest.
";

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let folder = &arguments.folder;
    let taken: Vec<&str> =
        FILES.iter().map(|(name, _)| *name).chain([SCHEMA]).filter(|name| folder.join(name).exists()).collect();
    if !taken.is_empty() {
        bail!("{} has {} already: choose a new folder, or move them away", folder.display(), taken.join(", "));
    }
    for (name, content) in FILES {
        write_new(&folder.join(name), content)?;
    }
    // The dataflow files name it, for editors.
    write_new(&folder.join(SCHEMA), schema().as_bytes())?;
    let names: Vec<&str> = FILES.iter().map(|(name, _)| *name).chain([SCHEMA]).collect();
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
