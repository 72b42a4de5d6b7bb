//! The edges between machines.

use std::collections::BTreeSet;

use crate::dataflow::diagnostic::{Diagnostics, list};
use crate::dataflow::file::DataflowFile;
use crate::dataflow::graph::{Edge, Graph, Node};
use crate::dataflow::node::{NodeEntry, Source};
use crate::dataflow::scope::UNKNOWN_TYPE;
use blindgrasp_messages::MESSAGE_TYPES;
use blindgrasp_operator::text::quote;

impl Graph {
    /// The two machines of an edge; `None` if both its ends are on one machine.
    pub fn crossing(&self, edge: &Edge<'_>) -> Option<(&str, &str)> {
        let from = self.node(edge.from_node)?.machine.as_deref()?;
        let to = self.node(edge.to_node)?.machine.as_deref()?;
        if from == to { None } else { Some((from, to)) }
    }
}

/// An edge of the file between two machines.
struct Crossing<'a> {
    reader: &'a NodeEntry,
    port: &'a str,
    source: &'a Source,
    from: &'a str,
    to: &'a str,
}

impl Crossing<'_> {
    fn shown(&self) -> String {
        let Crossing { reader, port, source, from, to } = self;
        format!("{}/{} → {}/{port} goes from {from} to {to}", source.node, source.port, reader.id.text)
    }
}

/// Checks whether the edges between machines can be carried, and whether one of their machines listens.
pub(super) fn check_crossings(file: &DataflowFile, nodes: &[Node], diagnostics: &mut Diagnostics) {
    let crossings = crossings(file);
    for crossing in &crossings {
        let reader = nodes.iter().find(|node| node.id == crossing.reader.id.text);
        let input = reader.and_then(|reader| reader.inputs.iter().find(|input| input.port == crossing.port));
        if input.is_some_and(|input| input.feedback) {
            let message = format!("{}, but feedback cannot go between machines", crossing.shown());
            let help = Some("let both nodes run on one machine".to_owned());
            diagnostics.push_with_help(crossing.source.at, message, help);
        }
        let type_name = input.map_or(UNKNOWN_TYPE, |input| &input.type_name);
        if type_name != UNKNOWN_TYPE && !MESSAGE_TYPES.contains(&type_name) {
            let message = format!("{}, but {} cannot go between machines", crossing.shown(), quote(type_name));
            let help = format!("let both nodes run on one machine; {}", list("types that can", MESSAGE_TYPES));
            diagnostics.push_with_help(crossing.source.at, message, Some(help));
        }
    }
    check_listeners(file, &crossings, diagnostics);
}

fn crossings(file: &DataflowFile) -> Vec<Crossing<'_>> {
    let mut crossings = Vec::new();
    for reader in &file.nodes {
        for input in &reader.inputs {
            let Some(source) = &input.source else { continue };
            let writer = file.nodes.iter().find(|entry| entry.id.text == source.node);
            let Some(from) = writer.and_then(|writer| writer.on.as_ref()) else { continue };
            if let Some(to) = &reader.on
                && from.text != to.text
            {
                crossings.push(Crossing { reader, port: &input.port.text, source, from: &from.text, to: &to.text });
            }
        }
    }
    crossings
}

/// One of two machines that an edge joins must listen, unless there is a router.
fn check_listeners(file: &DataflowFile, crossings: &[Crossing], diagnostics: &mut Diagnostics) {
    if file.link.has_router {
        return;
    }
    let Some(machines) = &file.machines else { return };
    // A machine that the file does not have is another mistake.
    let listens = |name: &str| machines.find(name).is_none_or(|machine| machine.listens);
    let is_any = machines.names().any(listens);
    let mut seen = BTreeSet::new();
    for crossing in crossings {
        let Crossing { from, to, .. } = *crossing;
        if listens(from) || listens(to) || !seen.insert((from.min(to), from.max(to))) {
            continue;
        }
        let help =
            format!("let one listen, like '{to}: {{listen: tls/192.168.1.10:7447}}', or name a 'router' in 'link'");
        if !is_any {
            let message = format!("no machine listens, but edges cross: {}", crossing.shown());
            return diagnostics.push_with_help(machines.at, message, Some(help));
        }
        let message = format!("{}, but neither of them listens", crossing.shown());
        diagnostics.push_with_help(crossing.source.at, message, Some(help));
    }
}
