//! The order of the nodes: each after those that it reads from. Cycles have none, so they are refused.

use std::collections::{BTreeSet, HashMap};

use super::diagnostic::{Diagnostics, Position, quote};
use super::node::NodeEntry;

/// A longer cycle is shown with its middle left out.
const MAX_SHOWN_NODES: usize = 16;

struct Search<'a, 'd> {
    entries: HashMap<&'a str, &'a NodeEntry>,
    levels: HashMap<&'a str, usize>,
    /// From the node where the search began, against the flow.
    path: Vec<&'a str>,
    has_source: bool,
    diagnostics: &'d mut Diagnostics,
}

/// For each node the number of edges of the longest way to it from a source. Cycles are reported.
pub(super) fn levels<'a>(nodes: &'a [NodeEntry], diagnostics: &mut Diagnostics) -> HashMap<&'a str, usize> {
    let mut search = Search {
        entries: nodes.iter().map(|entry| (entry.id.text.as_str(), entry)).collect(),
        levels: HashMap::new(),
        path: Vec::new(),
        has_source: nodes.iter().any(|entry| entry.inputs.is_empty()),
        diagnostics,
    };
    for entry in nodes {
        search.visit(entry);
    }
    search.levels
}

impl<'a> Search<'a, '_> {
    /// Recursion is as deep as the longest path, which the number of nodes bounds.
    fn visit(&mut self, entry: &'a NodeEntry) -> usize {
        let id = entry.id.text.as_str();
        if let Some(level) = self.levels.get(id) {
            return *level;
        }
        self.path.push(id);
        let mut level = 0;
        let mut seen = BTreeSet::new();
        for source in entry.inputs.iter().filter_map(|input| input.source.as_ref()) {
            let Some(from) = self.entries.get(source.node.as_str()).copied() else { continue };
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
