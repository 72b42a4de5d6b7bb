//! Pictures of a graph of processes: as SVG, laid out here; as text that Mermaid (and so GitHub) or Graphviz lays out.

mod layout;
mod svg;
mod text;

#[cfg(test)]
mod tests;

pub use svg::graph_svg;
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
}

/// A box.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DrawnNode {
    /// Its name, in bold.
    pub name: String,
    /// Lines below.
    pub notes: Vec<String>,
    /// Lines below in red; the box is red then, too.
    pub warnings: Vec<String>,
    /// Whether it is no operator: what only reads the graph.
    pub is_outside: bool,
}

/// An arrow.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DrawnEdge {
    /// From which node, by index.
    pub from: usize,
    /// To which node.
    pub to: usize,
    /// What is said of it.
    pub notes: Vec<String>,
    /// What is wrong with it, in red; the arrow is red then, too.
    pub warnings: Vec<String>,
    /// Whether samples may give way to newer ones: dashed.
    pub is_dashed: bool,
}
