//! Checking a graph of several machines on one of them, which has its own operators' programs only.

use std::path::{Path, PathBuf};

use crate::dataflow::check::{Operator, ResolvedNode};
use crate::dataflow::diagnostic::{Diagnostics, did_you_mean_or_list};
use crate::dataflow::file::DataflowFile;
use crate::dataflow::node::NodeEntry;
use crate::dataflow::program::Program;
use crate::dataflow::settings::{Override, absolute};
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::param::{ParamDescription, ParamKind};
use blindgrasp_operator::text::quote;

/// The type of a port of another machine's node, if neither its program nor a reader that knows it is here.
pub const UNKNOWN_TYPE: &str = "unknown";

/// The version that a description has when it was not given by a program but gathered from those that read the node.
pub const UNKNOWN_VERSION: &str = "unknown";

/// Which programs and files must be there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope<'a> {
    /// All of them: the whole graph is to run here, or is only looked at.
    Everything,
    /// Those of the nodes on this machine. Another machine's node whose program is not here, too, is described by what
    /// its readers expect of it ([`UNKNOWN_TYPE`], [`UNKNOWN_VERSION`]), without params.
    Machine(&'a str),
}

impl Scope<'_> {
    /// The machine of a node that runs elsewhere.
    pub(super) fn elsewhere<'e>(&self, entry: &'e NodeEntry) -> Option<&'e str> {
        let on = entry.on.as_ref()?;
        matches!(self, Scope::Machine(here) if *here != on.text).then_some(on.text.as_str())
    }

    /// Whether the file has the machine.
    pub(super) fn check(&self, file: &DataflowFile, diagnostics: &mut Diagnostics) {
        let Scope::Machine(here) = *self else { return };
        match &file.machines {
            Some(machines) if machines.find(here).is_none() => {
                let help = did_you_mean_or_list(here, "machines", machines.names());
                diagnostics.push_with_help(None, format!("there is no machine {}", quote(here)), help);
            }
            None if file.is_for_one_machine => {
                let message = format!("there is no machine {}: the file names none", quote(here));
                diagnostics.push_with_help(None, message, Some("leave --machine out".to_owned()));
            }
            _ => {}
        }
    }

    /// Params of nodes that run elsewhere are set there.
    pub(super) fn check_overrides(&self, overrides: &[Override], nodes: &[NodeEntry], diagnostics: &mut Diagnostics) {
        for set in overrides {
            let node = nodes.iter().find(|node| set.node.as_ref() == Some(&node.id.text));
            if let Some((node, machine)) = node.and_then(|node| Some((node, self.elsewhere(node)?))) {
                let message = format!("node {} runs on machine {}", quote(&node.id.text), quote(machine));
                diagnostics.push_of_setting(set, message, Some("give --set there".to_owned()));
            }
        }
    }
}

/// The params of an operator that runs elsewhere: its files need not be here.
pub(super) fn without_files(params: &[ParamDescription]) -> Vec<ParamDescription> {
    let without = |param: &ParamDescription| match &param.kind {
        ParamKind::Path { .. } => ParamDescription { kind: ParamKind::Path { must_exist: false }, ..param.clone() },
        _ => param.clone(),
    };
    params.iter().map(without).collect()
}

/// Describes nodes of other machines whose programs are not here by their readers.
pub(super) fn make_up(resolved: &mut [ResolvedNode], scope: Scope, folder: &Path) {
    let is_missing = |node: &ResolvedNode| node.operator.is_none() && scope.elsewhere(node.entry).is_some();
    let missing: Vec<usize> = (0..resolved.len()).filter(|&idx| is_missing(&resolved[idx])).collect();
    let made_up: Vec<Option<Operator>> =
        missing.iter().map(|&idx| described_by_readers(resolved[idx].entry, resolved, folder)).collect();
    for (&idx, operator) in missing.iter().zip(made_up) {
        resolved[idx].operator = operator;
    }
    // All outputs are known now.
    for idx in missing {
        let inputs = inputs_as_written(resolved[idx].entry, resolved);
        if let Some(operator) = &mut resolved[idx].operator {
            operator.description.inputs = inputs;
        }
    }
}

/// `None` if the node's operator could not be read.
fn described_by_readers(entry: &NodeEntry, resolved: &[ResolvedNode], folder: &Path) -> Option<Operator> {
    let run = &entry.run.as_ref()?.text;
    let program = if run.contains('/') { absolute(folder, run) } else { PathBuf::from(run) };
    let name = program.file_name().map_or_else(|| run.clone(), |name| name.to_string_lossy().into_owned());
    let mut description = OperatorDescription::new(&name, "Known from its readers only: its program is not here");
    description.version = UNKNOWN_VERSION.to_owned();
    for reader in resolved {
        for input in &reader.entry.inputs {
            let Some(source) = input.source.as_ref().filter(|source| source.node == entry.id.text) else { continue };
            let operator = reader.operator.as_ref();
            let port = operator.and_then(|operator| find(&operator.description.inputs, &input.port.text));
            match (description.outputs.iter_mut().find(|output| output.name == source.port), port) {
                (None, _) => {
                    let type_name = port.map_or(UNKNOWN_TYPE, |port| &port.type_name);
                    description = description.output(&source.port, type_name, "");
                }
                (Some(output), Some(port)) if output.type_name == UNKNOWN_TYPE => {
                    output.type_name.clone_from(&port.type_name);
                }
                _ => {}
            }
        }
    }
    let program = Program { path: program, args: entry.args.clone() };
    Some(Operator { program, description })
}

fn inputs_as_written(entry: &NodeEntry, resolved: &[ResolvedNode]) -> Vec<PortDescription> {
    let type_of = |id: &str, port: &str| {
        let from = resolved.iter().find(|node| node.entry.id.text == id)?;
        Some(find(&from.operator.as_ref()?.description.outputs, port)?.type_name.clone())
    };
    let inputs = entry.inputs.iter().map(|input| {
        let type_name = input.source.as_ref().and_then(|source| type_of(&source.node, &source.port));
        let type_name = type_name.unwrap_or_else(|| UNKNOWN_TYPE.to_owned());
        PortDescription {
            name: input.port.text.clone(),
            type_name,
            optional: false,
            feedback: false,
            partner: false,
            summary: String::new(),
        }
    });
    inputs.collect()
}

fn find<'a>(ports: &'a [PortDescription], name: &str) -> Option<&'a PortDescription> {
    ports.iter().find(|port| port.name == name)
}
