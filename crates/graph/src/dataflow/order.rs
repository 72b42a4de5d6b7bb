//! The order of the nodes: each after those that it reads from, but for feedback. Other cycles have none, so they are
//! refused.

use std::collections::{BTreeSet, HashMap};

use crate::dataflow::check::ResolvedNode;
use crate::dataflow::diagnostic::{Diagnostics, Position};
use crate::dataflow::node::InputEntry;
use blindgrasp_operator::text::quote;

/// A longer cycle is shown with its middle left out.
const MAX_SHOWN_NODES: usize = 16;

struct Search<'a, 'd> {
    resolved: HashMap<&'a str, &'a ResolvedNode<'a>>,
    levels: HashMap<&'a str, usize>,
    /// From the node where the search began, against the flow.
    path: Vec<&'a str>,
    has_source: bool,
    diagnostics: &'d mut Diagnostics,
}

/// For each node the number of edges of the longest way to it from a source. Cycles are reported.
pub(super) fn levels<'a>(nodes: &'a [ResolvedNode<'a>], diagnostics: &mut Diagnostics) -> HashMap<&'a str, usize> {
    let mut search = Search {
        resolved: nodes.iter().map(|node| (node.entry.id.text.as_str(), node)).collect(),
        levels: HashMap::new(),
        path: Vec::new(),
        has_source: nodes.iter().any(|node| forward(node).next().is_none()),
        diagnostics,
    };
    for node in nodes {
        search.visit(node);
    }
    search.levels
}

/// The inputs that are no feedback, as far as that is known.
fn forward<'a>(node: &'a ResolvedNode<'a>) -> impl Iterator<Item = &'a InputEntry> {
    node.entry.inputs.iter().filter(|input| match &node.operator {
        None => true,
        Some(operator) => match operator.description.inputs.iter().find(|port| port.name == input.port.text) {
            None => !input.is_left_out_without_port,
            Some(port) => !port.feedback,
        },
    })
}

impl<'a> Search<'a, '_> {
    /// Recursion is as deep as the longest path, which the number of nodes bounds.
    fn visit(&mut self, node: &'a ResolvedNode<'a>) -> usize {
        let id = node.entry.id.text.as_str();
        if let Some(level) = self.levels.get(id) {
            return *level;
        }
        self.path.push(id);
        let mut level = 0;
        let mut seen = BTreeSet::new();
        for source in forward(node).filter_map(|input| input.source.as_ref()) {
            let Some(from) = self.resolved.get(source.node.as_str()).copied() else { continue };
            if !seen.insert(source.node.as_str()) {
                continue;
            }
            match self.path.iter().position(|&on_path| on_path == source.node) {
                Some(start_idx) => self.report(start_idx, source.at),
                None => level = level.max(self.visit(from) + 1),
            }
        }
        self.path.pop();
        self.levels.insert(id, level);
        level
    }

    fn report(&mut self, start_idx: usize, at: Position) {
        let cycle = &self.path[start_idx..];
        if !cycle.iter().all(|id| self.resolved.get(id).is_some_and(|node| node.known().is_some())) {
            // One of them may have feedback. That it could not be asked is said elsewhere, or its program is on another machine.
            return;
        }
        let message = match cycle {
            [only] => format!("node {} reads its own output", quote(only)),
            _ => {
                // The path was walked against the flow: its first node feeds its last one.
                let mut flow: Vec<&str> = cycle[..1].iter().chain(cycle.iter().rev()).copied().collect();
                if flow.len() > MAX_SHOWN_NODES {
                    flow.splice(MAX_SHOWN_NODES / 2..flow.len() - MAX_SHOWN_NODES / 2, ["…"]);
                }
                format!("the nodes form a cycle: {}", flow.join(" -> "))
            }
        };
        let help = "no node is a source; at least one must have no inputs".to_owned();
        self.diagnostics.push_with_help(at, message, (!self.has_source).then_some(help));
    }
}
