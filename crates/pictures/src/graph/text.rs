//! A graph as text, for tools that lay it out themselves.

use std::fmt::Write;

use super::{CROSSING, DrawnGraph, DrawnNode, tint};

/// A flowchart for Mermaid, which GitHub and GitLab draw in a block of Markdown marked `mermaid`.
pub fn graph_mermaid(graph: &DrawnGraph) -> String {
    let mut text = format!("---\ntitle: \"{}\"\n---\nflowchart LR\n", mermaid_text(&graph.title));
    let label =
        |lines: Vec<&String>| lines.into_iter().map(|line| mermaid_text(line)).collect::<Vec<_>>().join("<br/>");
    // Writing to a string cannot fail.
    let boxed = |idx: usize, node: &DrawnNode| {
        let (open, close) = if node.is_outside { ("([", "])") } else { ("[", "]") };
        let lines = [&node.name].into_iter().chain(&node.notes).collect();
        format!("n{idx}{open}\"{}\"{close}", label(lines))
    };
    for (group_idx, group) in graph.groups.iter().enumerate() {
        let _ = writeln!(text, "  subgraph g{group_idx}[\"{}\"]", label(group_title(&group.name, &group.note)));
        for (idx, node) in in_group(graph, Some(group_idx)) {
            let _ = writeln!(text, "    {}", boxed(idx, node));
        }
        text += "  end\n";
    }
    for (idx, node) in in_group(graph, None) {
        let _ = writeln!(text, "  {}", boxed(idx, node));
    }
    for edge in &graph.edges {
        let arrow = if edge.is_dashed || edge.is_feedback || edge.carrier.is_some() { "-.->" } else { "-->" };
        let lines: Vec<&String> = edge.lines().collect();
        let label = if lines.is_empty() { String::new() } else { format!("|\"{}\"|", label(lines)) };
        let _ = writeln!(text, "  n{} {arrow}{label} n{}", edge.from, edge.to);
    }
    for (idx, edge) in graph.edges.iter().enumerate() {
        if edge.carrier.is_some() {
            let _ = writeln!(text, "  linkStyle {idx} stroke:{CROSSING},color:{CROSSING}");
        }
    }
    for (group_idx, _) in graph.groups.iter().enumerate() {
        let [fill, border] = tint(group_idx);
        let _ = writeln!(text, "  style g{group_idx} fill:{fill},stroke:{border}");
    }
    text
}

/// A graph for Graphviz.
pub fn graph_dot(graph: &DrawnGraph) -> String {
    let title = dot_text(&graph.title);
    let mut text = format!(
        "digraph \"{title}\" {{\n  rankdir=LR;\n  label=\"{title}\";\n  labelloc=t;\n  fontname=\"Helvetica\";\n  \
         node [shape=box, style=\"rounded,filled\", fillcolor=\"#e8f1fa\", color=\"#3a78b5\", fontname=\"Helvetica\"];\n  \
         edge [color=\"#33414e\", fontname=\"Helvetica\", fontsize=10];\n"
    );
    let label = |lines: Vec<&String>| lines.into_iter().map(|line| dot_text(line)).collect::<Vec<_>>().join("\\n");
    let boxed = |idx: usize, node: &DrawnNode| {
        let lines = [&node.name].into_iter().chain(&node.notes).collect();
        let mut attributes = format!("label=\"{}\"", label(lines));
        if node.is_outside {
            attributes += ", shape=oval, fillcolor=\"#fdf0dd\", color=\"#c77f1a\"";
        }
        format!("n{idx} [{attributes}];")
    };
    for (group_idx, group) in graph.groups.iter().enumerate() {
        let [fill, border] = tint(group_idx);
        let _ = writeln!(
            text,
            "  subgraph cluster_{group_idx} {{\n    label=\"{}\";\n    labeljust=l;\n    style=\"rounded,filled\";\n    \
             fillcolor=\"{fill}\";\n    color=\"{border}\";",
            label(group_title(&group.name, &group.note))
        );
        for (idx, node) in in_group(graph, Some(group_idx)) {
            let _ = writeln!(text, "    {}", boxed(idx, node));
        }
        text += "  }\n";
    }
    for (idx, node) in in_group(graph, None) {
        let _ = writeln!(text, "  {}", boxed(idx, node));
    }
    for edge in &graph.edges {
        let mut attributes = format!("label=\"{}\"", label(edge.lines().collect()));
        if edge.is_dashed || edge.is_feedback || edge.carrier.is_some() {
            attributes += ", style=dashed";
        }
        if edge.is_feedback {
            // It has no say in who stands left of whom.
            attributes += ", constraint=false";
        }
        if edge.carrier.is_some() {
            let _ = write!(attributes, ", color=\"{CROSSING}\", fontcolor=\"{CROSSING}\"");
        }
        let _ = writeln!(text, "  n{} -> n{} [{attributes}];", edge.from, edge.to);
    }
    text + "}\n"
}

/// The nodes of a group, or of none, with their numbers.
fn in_group(graph: &DrawnGraph, group: Option<usize>) -> impl Iterator<Item = (usize, &DrawnNode)> {
    let of = |node: &DrawnNode| node.group.filter(|group| *group < graph.groups.len());
    graph.nodes.iter().enumerate().filter(move |(_, node)| of(node) == group)
}

fn group_title<'a>(name: &'a String, note: &'a String) -> Vec<&'a String> {
    [name, note].into_iter().filter(|line| !line.is_empty()).collect()
}

/// Text between Mermaid's quotes: its entity codes for all that it, HTML or Markdown would take for something else.
fn mermaid_text(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            letter if letter.is_control() => escaped.push(' '),
            '"' | '#' | '&' | '<' | '>' | '`' | '\\' | '*' | '|' | '{' | '}' | '[' | ']' | ';' => {
                let _ = write!(escaped, "#{};", u32::from(letter));
            }
            other => escaped.push(other),
        }
    }
    escaped
}

/// Text between Graphviz's quotes.
fn dot_text(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            letter if letter.is_control() => escaped.push(' '),
            '"' | '\\' => escaped.extend(['\\', letter]),
            // Graphviz reads HTML's entities.
            '&' => escaped.push_str("&amp;"),
            other => escaped.push(other),
        }
    }
    escaped
}
