//! Checking a graph of several machines on one of them, which has its own operators' programs only.

use std::path::{Path, PathBuf};

use crate::dataflow::check::{Operator, ResolvedNode};
use crate::dataflow::diagnostic::{Diagnostics, did_you_mean_or_list};
use crate::dataflow::file::DataflowFile;
use crate::dataflow::node::{InputEntry, NodeEntry};
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
    let mut params = params.to_vec();
    for param in &mut params {
        if let ParamKind::Path { must_exist } = &mut param.kind {
            *must_exist = false;
        }
    }
    params
}

/// Describes nodes of other machines whose programs are not here by their readers.
pub(super) fn make_up(resolved: &mut [ResolvedNode], scope: Scope, folder: &Path) {
    let mut made_up = Vec::new();
    for (idx, node) in resolved.iter().enumerate() {
        if node.operator.is_none() && scope.elsewhere(node.entry).is_some() {
            made_up.push((idx, described_by_readers(node.entry, resolved, folder)));
        }
    }
    for (idx, operator) in &made_up {
        resolved[*idx].operator.clone_from(operator);
    }
    // All outputs are known now.
    for (idx, _) in made_up {
        let inputs = inputs_as_written(resolved[idx].entry, resolved);
        if let Some(operator) = &mut resolved[idx].operator {
            operator.description.inputs = inputs;
        }
    }
}

/// `None` if the node's operator could not be read.
fn described_by_readers(entry: &NodeEntry, resolved: &[ResolvedNode], folder: &Path) -> Option<Operator> {
    let (run, args) = (&entry.run.as_ref()?.text, entry.args.clone()?);
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
    Some(Operator { program: Program { path: program, args }, description })
}

fn inputs_as_written(entry: &NodeEntry, resolved: &[ResolvedNode]) -> Vec<PortDescription> {
    let inputs = entry.inputs.iter().map(|input| PortDescription {
        name: input.port.text.clone(),
        type_name: type_of(input, resolved).unwrap_or(UNKNOWN_TYPE).to_owned(),
        optional: false,
        feedback: false,
        partner: false,
        summary: String::new(),
    });
    inputs.collect()
}

/// The type that an input's source gives, if that is known.
fn type_of<'a>(input: &InputEntry, resolved: &'a [ResolvedNode]) -> Option<&'a str> {
    let source = input.source.as_ref()?;
    let from = resolved.iter().find(|node| node.entry.id.text == source.node)?;
    Some(&find(&from.operator.as_ref()?.description.outputs, &source.port)?.type_name)
}

fn find<'a>(ports: &'a [PortDescription], name: &str) -> Option<&'a PortDescription> {
    ports.iter().find(|port| port.name == name)
}
