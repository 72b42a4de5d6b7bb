//! `blindgrasp view`

mod control;
mod foxglove;
mod graph;
mod grasp;
mod hand;
pub(super) mod live;
mod model;
mod recorded;

use std::path::{Path, PathBuf};

use blindgrasp_graph::client::is_graph_name;
use blindgrasp_graph::dataflow::Override;
use clap::{Args, ValueEnum};

use super::{Outcome, completions};
use blindgrasp_cli::joint;

/// Show a graph or recording in a browser; draw a grasp or a hand.
///
/// The programs of a dataflow file are run with --describe: use only files that you trust.
#[derive(Debug, Args)]
#[command(after_help = "Example: blindgrasp view grasp_gate\n         \
                        blindgrasp view recordings/held-out.mcap\n         \
                        blindgrasp view dataflow.yaml --out graph.svg\n         \
                        blindgrasp view recordings/held-out.mcap --grasp 3 --out grasp.html\n         \
                        blindgrasp view allegro --out hand.html\n\n\
                        In a graph, 'run' is the launching command: it reads the decisions, and the label where a source knows it.\n\
                        In a picture of a recording with /scene the object and all contacts are shown, in any other the active cells.")]
pub(super) struct Arguments {
    /// A running graph by its name; the dataflow file (YAML); the recording (MCAP); or a hand: its pad layout (YAML) or the name
    /// of a built-in one
    #[arg(default_value = "dataflow.yaml")]
    file: PathBuf,
    /// Write to this file: .svg, .mmd or .dot for a dataflow file, .html for a grasp or a hand
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Port of the page of a running graph or a recording, on 127.0.0.1 [default: any free one]
    #[arg(long, value_name = "PORT", conflicts_with = "out")]
    port: Option<u16>,
    #[command(flatten)]
    rights: Rights,
    /// Judge the frames by this model as well, and show both on the page
    #[arg(long, value_name = "MODEL", conflicts_with = "out")]
    shadow: Option<PathBuf>,
    /// Wait for the graph, which is being started (run --view)
    #[arg(long, hide = true, requires = "port")]
    wait: bool,
    #[command(flatten)]
    graph: GraphArguments,
    #[command(flatten)]
    grasp: GraspArguments,
    #[command(flatten)]
    alone: HandArguments,
}

/// The abilities of the page of a running graph, beside showing it.
#[derive(Debug, Clone, Copy, Default, Args)]
pub(in crate::commands) struct Rights {
    /// Let the page set parameters, swap nodes and stop the graph
    ///
    /// The address that is printed holds a token. The page without it can only be read.
    #[arg(long)]
    pub(in crate::commands) view_control: bool,
    /// Let Foxglove read the graph's samples, at ws://127.0.0.1:PORT/foxglove
    #[arg(long)]
    pub(in crate::commands) foxglove: bool,
}

impl Rights {
    /// Whether there is any.
    pub(in crate::commands) fn is_any(self) -> bool {
        self.view_control || self.foxglove
    }

    /// The options that give them.
    pub(in crate::commands) fn options(self) -> impl Iterator<Item = &'static str> {
        [(self.view_control, "--view-control"), (self.foxglove, "--foxglove")]
            .into_iter()
            .filter_map(|(is, option)| is.then_some(option))
    }
}

#[derive(Debug, Args)]
#[command(next_help_heading = "A dataflow file")]
struct GraphArguments {
    /// Give a param another value than the file does
    ///
    /// A path is relative to the current folder. Can be repeated.
    #[arg(long = "set", value_name = "[NODE.]PARAM=VALUE", value_parser = Override::parse)]
    overrides: Vec<Override>,
    /// Check the file as this machine would
    ///
    /// Programs and files of the other machines need not be here.
    #[arg(long)]
    machine: Option<String>,
    /// Format of the picture [default: as the name of --out says, else mermaid]
    #[arg(long, value_enum, conflicts_with = "json")]
    format: Option<Format>,
    /// Print nodes and edges as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "A recorded grasp")]
struct GraspArguments {
    /// Number of the grasp [default: the recording's first]
    #[arg(long)]
    grasp: Option<u64>,
    /// Pad layout of the hand [default: that of the recording, if its name is a built-in one]
    #[arg(long, add = completions::hands())]
    hand: Option<PathBuf>,
    /// Folder of the objects' meshes [default: the built-in objects]
    #[arg(long)]
    objects: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "A hand")]
struct HandArguments {
    /// Posture: joints that are not open, in radians, or metres of a slide
    #[arg(long, value_name = "NAME=VALUE,…", value_delimiter = ',', value_parser = joint)]
    joints: Vec<(String, f64)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A picture, laid out by Graphviz (the program `dot`).
    Svg,
    /// Text for a ```mermaid block of Markdown.
    Mermaid,
    /// Text for Graphviz.
    Dot,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<Outcome> {
    let (graph, grasp) = (&arguments.graph, &arguments.grasp);
    let port = arguments.port.unwrap_or(0);
    let shadow = arguments.shadow.as_deref();
    if arguments.wait {
        return live::show(&arguments.file.to_string_lossy(), port, true, arguments.rights, shadow);
    }
    if let Some(name) = graph_name(arguments) {
        return run_on_graph(name, arguments);
    }
    if arguments.rights.is_any() {
        refuse("--view-control and --foxglove are for the page of a running graph: name one");
    }
    let is_recording = arguments.file.extension().is_some_and(|extension| extension == "mcap");
    if (arguments.port.is_some() || shadow.is_some()) && !is_recording {
        refuse("--port and --shadow are for the page of a running graph or a recording: name one");
    }
    if hand::is_hand(&arguments.file) {
        let Some(out) = &arguments.out else {
            refuse("--out is missing: name the page of the hand, .html");
        };
        if grasp.grasp.is_some() {
            refuse("--grasp is for recordings: name an .mcap file");
        }
        return hand::draw(&arguments.file, out, &arguments.alone.joints);
    }
    if !arguments.alone.joints.is_empty() {
        refuse("--joints is for hands: name a pad layout (.yaml) or a built-in hand");
    }
    if is_dataflow(&arguments.file) {
        if grasp.grasp.is_some() || grasp.hand.is_some() || grasp.objects.is_some() {
            refuse("--grasp, --hand and --objects are for recordings: name an .mcap file");
        }
        return graph::draw_file(&arguments.file, arguments.out.as_deref(), graph);
    }
    if !graph.overrides.is_empty() || graph.machine.is_some() || graph.format.is_some() || graph.json {
        refuse("--set, --machine, --format and --json are for a dataflow file: name one (.yaml)");
    }
    match &arguments.out {
        Some(out) => grasp::draw(&arguments.file, out, grasp),
        None => recorded::show(&arguments.file, port, grasp, shadow),
    }
}

/// Shows a running graph.
fn run_on_graph(name: &str, arguments: &Arguments) -> anyhow::Result<Outcome> {
    let graph = &arguments.graph;
    if !graph.overrides.is_empty() || graph.machine.is_some() {
        refuse("--set and --machine are for a dataflow file: name one (.yaml)");
    }
    if arguments.out.is_some() || graph.format.is_some() || graph.json {
        refuse(
            "--out, --format and --json are for a dataflow file: name one (.yaml), or see what runs with `blindgrasp ps --json`",
        );
    }
    live::show(name, arguments.port.unwrap_or(0), false, arguments.rights, arguments.shadow.as_deref())
}

/// The name of a running graph, if the argument is one.
fn graph_name(arguments: &Arguments) -> Option<&str> {
    let name = arguments.file.to_str().filter(|name| is_graph_name(name))?;
    if arguments.file.exists() || hand::is_hand(&arguments.file) {
        return None;
    }
    Some(name)
}

/// Ends the process with a usage error.
fn refuse(message: &str) -> ! {
    clap::Error::raw(clap::error::ErrorKind::ArgumentConflict, format!("{message}\n")).exit()
}

fn is_dataflow(file: &Path) -> bool {
    file.extension().is_some_and(|extension| extension == "yaml" || extension == "yml")
}
