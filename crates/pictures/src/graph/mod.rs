//! Pictures of a graph of processes, as text that Mermaid (and so GitHub) or Graphviz lays out.

mod text;

#[cfg(test)]
mod tests;

pub use text::{graph_dot, graph_mermaid};

/// A graph to draw.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DrawnGraph {
    /// What it is called.
    pub title: String,
    /// Its nodes; those of a layer are drawn in this order where edges leave a choice.
    pub nodes: Vec<DrawnNode>,
    /// Its edges.
    pub edges: Vec<DrawnEdge>,
    /// Frames around nodes, as for the machines that they run on.
    pub groups: Vec<DrawnGroup>,
}

/// A frame around nodes.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct DrawnGroup {
    /// What it is called.
    pub name: String,
    /// A text behind the name.
    pub note: String,
}

/// A box.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DrawnNode {
    /// Its name, in bold.
    pub name: String,
    /// Lines below.
    pub notes: Vec<String>,
    /// Whether it is no operator: what only reads the graph.
    pub is_outside: bool,
    /// The group that it is in, by index.
    pub group: Option<usize>,
}

/// An arrow.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DrawnEdge {
    /// From which node, by index.
    pub from: usize,
    /// To which node.
    pub to: usize,
    /// Lines beside the arrow.
    pub notes: Vec<String>,
    /// Whether samples may give way to newer ones: dashed.
    pub is_dashed: bool,
    /// Whether it goes back to where its samples come from: dashed, drawn below the others.
    pub is_feedback: bool,
    /// What carries it, if it goes from one machine to another: dashed, in a colour of its own.
    pub carrier: Option<String>,
}

/// What goes between machines.
const CROSSING: &str = "#7a4fb5";

impl DrawnEdge {
    /// Its lines of text: what is said, and what carries it.
    fn lines(&self) -> impl Iterator<Item = &String> {
        self.notes.iter().chain(&self.carrier)
    }
}

/// Fill and border of a group: too light to hide a text's halo.
fn tint(group: usize) -> [&'static str; 2] {
    const TINTS: [[&str; 2]; 6] = [
        ["#f5f8ef", "#a9bf86"],
        ["#fbf5ea", "#d9b878"],
        ["#f6f2fa", "#b9a3d3"],
        ["#eef7f7", "#86bfc0"],
        ["#fbf1f3", "#dba3ae"],
        ["#f3f4f6", "#aab2bd"],
    ];
    TINTS[group % TINTS.len()]
}
