//! Checks the file against the descriptions of its operators: programs, edges, params, cycles.

use std::collections::HashMap;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use crate::dataflow::crossing::check_crossings;
use crate::dataflow::diagnostic::{DataflowError, Diagnostics, did_you_mean_or_list, list, quote_path};
use crate::dataflow::file::DataflowFile;
use crate::dataflow::graph::{Graph, Input, Node};
use crate::dataflow::node::{InputEntry, NodeEntry, PinEntry, Source};
use crate::dataflow::order::levels;
use crate::dataflow::pins::{PinError, Pins, RUN};
use crate::dataflow::process_options::PROCESS_KEYS;
use crate::dataflow::program::Program;
use crate::dataflow::scope::{Scope, UNKNOWN_VERSION, make_up, without_files};
use crate::dataflow::settings::{Override, absolute, check_overrides, check_params, check_shared};
use crate::dataflow::yaml::Text;
use crate::describe::program_on_path;
use crate::operators::Operators;
use blindgrasp_operator::description::{OperatorDescription, PortDescription};
use blindgrasp_operator::param::ParamKind;
use blindgrasp_operator::text::{did_you_mean, quote};
use blindgrasp_operator::wiring::{OnLate, WaitMode};

/// In a file with 1 MiB of unknown nodes, finding similar names took 17 s; with this bound 0.5 s.
const MAX_MISTAKES_WITH_SIMILAR_NODES: usize = 500;

/// A node of the file, with its operator if that could be found and asked.
pub(super) struct ResolvedNode<'a> {
    pub(super) entry: &'a NodeEntry,
    pub(super) operator: Option<Operator>,
}

impl ResolvedNode<'_> {
    /// The description of its operator, by the operator itself.
    pub(super) fn known(&self) -> Option<&OperatorDescription> {
        let description = &self.operator.as_ref()?.description;
        if description.version == UNKNOWN_VERSION { None } else { Some(description) }
    }
}

#[derive(Clone)]
pub(super) struct Operator {
    pub(super) program: Program,
    pub(super) description: OperatorDescription,
}

impl Operator {
    fn node(&self, entry: &NodeEntry, inputs: Vec<Input>, params: Map<String, Value>, sha256: Pins) -> Node {
        Node {
            id: entry.id.text.clone(),
            program: self.program.path.clone(),
            args: self.program.args.clone(),
            description: self.description.clone(),
            inputs,
            params,
            restart: entry.restart,
            heartbeat_millis: entry.heartbeat_millis,
            sandbox: entry.sandbox,
            memory_max_mib: entry.memory_max_mib,
            process: entry.process.clone(),
            sha256,
            machine: entry.on.as_ref().map(|on| on.text.clone()),
        }
    }
}

/// Checks a dataflow file against its operators' descriptions.
///
/// `operators` are those that a bare name can mean. `overrides` take the place of values in the file. `scope` says
/// whether all programs and files must be there, or those of one machine's nodes. `describe` asks a program with its
/// arguments for its description (`--describe` after them, then [`OperatorDescription::from_json`]) and is called once
/// for each program with the same arguments. Its error follows "program '…' cannot be used: " in a diagnostic.
///
/// # Errors
/// Every mistake of the file and the overrides that does not follow from another mistake.
pub fn check(
    file: &DataflowFile,
    operators: &Operators,
    overrides: &[Override],
    scope: Scope<'_>,
    describe: impl FnMut(&Path, &[String]) -> Result<OperatorDescription, String>,
) -> Result<Graph, DataflowError> {
    let mut diagnostics = file.diagnostics.clone();
    scope.check(file, &mut diagnostics);
    // The parent of a file is a folder; of "/" it is nothing, but that was not read as a file.
    let folder = file.absolute_path.parent().unwrap_or(Path::new("/"));
    let resolved = resolve(file, operators, scope, folder, describe, &mut diagnostics);

    let mut nodes = Vec::with_capacity(resolved.len());
    for node in &resolved {
        let entry = node.entry;
        let inputs = check_inputs(node, &resolved, &mut diagnostics);
        if let Some(operator) = &node.operator {
            let description = &operator.description;
            let (params, sha256) = if scope.elsewhere(entry).is_none() {
                let params =
                    check_params(entry, &description.params, &file.params, overrides, folder, &mut diagnostics);
                let pins = check_pins(entry, description, &params, &mut diagnostics);
                (params, pins)
            } else if description.version == UNKNOWN_VERSION {
                (Map::new(), entry.pins())
            } else {
                let params = without_files(&description.params);
                (check_params(entry, &params, &file.params, &[], folder, &mut diagnostics), entry.pins())
            };
            nodes.push(operator.node(entry, inputs, params, sha256));
        }
    }
    check_overrides(overrides, &file.nodes, &mut diagnostics);
    let known: Vec<&OperatorDescription> = resolved.iter().filter_map(ResolvedNode::known).collect();
    // An operator that is not known may have any param.
    if known.len() == resolved.len() {
        check_shared(&file.params, overrides, &known, &mut diagnostics);
    }
    scope.check_overrides(overrides, &file.nodes, &mut diagnostics);
    check_crossings(file, &nodes, &mut diagnostics);
    check_polling(file, scope, &mut diagnostics);
    check_groups(file, &nodes, operators, &mut diagnostics);
    let levels = levels(&resolved, &mut diagnostics);

    if diagnostics.len() > 0 {
        return Err(diagnostics.into_error());
    }
    nodes.sort_by_key(|node| levels.get(node.id.as_str()).copied());
    let machines = file.machines.as_ref().map(|machines| machines.settle(&file.link, folder));
    let host = operators.host().cloned();
    Ok(Graph { name: file.name.clone(), file: file.absolute_path.clone(), nodes, machines, local: None, host })
}

/// The nodes of a group share a process: blindgrasp must know their operators, and what holds for the process must be said of
/// all of them.
fn check_groups(file: &DataflowFile, nodes: &[Node], operators: &Operators, diagnostics: &mut Diagnostics) {
    for node in nodes {
        let Some(group) = &node.process.group else {
            continue;
        };
        let at = file.nodes.iter().find(|entry| entry.id.text == node.id).map(|entry| entry.group_at);
        let mut others =
            nodes.iter().filter(|other| other.process.group.as_ref() == Some(group) && other.id != node.id);
        if !operators.can_share_process(&node.program, &node.args) {
            let message = format!("node {}: its operator cannot share a process with others", quote(&node.id));
            let help = format!("the operators that can: {}", operators.sharing_names());
            diagnostics.push_with_help(at, message, Some(help));
        } else if let Some(other) = others.clone().find(|other| !can_share(other, node)) {
            let message = format!(
                "nodes {} and {} of group {} share a process, and must have the same values of 'on', 'sandbox', \
                 'memory_max_mib', {}",
                quote(&node.id),
                quote(&other.id),
                quote(group),
                PROCESS_KEYS[1..].iter().map(|key| quote(key)).collect::<Vec<_>>().join(", "),
            );
            return diagnostics.push(at, message);
        } else if others.next().is_none() {
            let message = format!("node {} is alone in group {}", quote(&node.id), quote(group));
            diagnostics.push_with_help(
                at,
                message,
                Some("name the same group at another node, or leave it out".to_owned()),
            );
        }
    }
}

fn can_share(a: &Node, b: &Node) -> bool {
    (&a.process, a.sandbox, a.memory_max_mib, &a.machine) == (&b.process, b.sandbox, b.memory_max_mib, &b.machine)
}

/// A process that polls takes a core, and the others need at least one.
fn check_polling(file: &DataflowFile, scope: Scope<'_>, diagnostics: &mut Diagnostics) {
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut n_polling = 0;
    for entry in &file.nodes {
        if entry.process.wait != WaitMode::Poll || scope.elsewhere(entry).is_some() {
            continue;
        }
        n_polling += 1;
        if n_polling < n_cores {
            continue;
        }
        let message = format!(
            "node {}: 'wait: poll' takes a core, and of the {n_cores} cores of this machine {} can be spared",
            quote(&entry.id.text),
            n_cores - 1
        );
        let help = Some("write 'wait: event', or {poll_us: 50} to sleep after 50 µs without a sample".to_owned());
        diagnostics.push_with_help(entry.wait_at, message, help);
    }
}

/// Finds the program of each node and asks it for its description.
fn resolve<'a>(
    file: &'a DataflowFile,
    operators: &Operators,
    scope: Scope<'_>,
    folder: &Path,
    mut describe: impl FnMut(&Path, &[String]) -> Result<OperatorDescription, String>,
    diagnostics: &mut Diagnostics,
) -> Vec<ResolvedNode<'a>> {
    // The programs of other machines need not be here: what is wrong with them is not reported.
    let mut unreported = diagnostics.clone();
    let mut asked: HashMap<(PathBuf, Vec<String>), Result<OperatorDescription, String>> = HashMap::new();
    let mut resolved = Vec::with_capacity(file.nodes.len());
    for (idx, entry) in file.nodes.iter().enumerate() {
        let is_elsewhere = scope.elsewhere(entry).is_some();
        let diagnostics = if is_elsewhere { &mut unreported } else { &mut *diagnostics };
        resolved.push(ResolvedNode { entry, operator: None });
        let (Some(run), Some(args)) = (&entry.run, &entry.args) else { continue };
        let Some(program) = find_program(run, entry, folder, operators, diagnostics) else { continue };
        let program = Program { args: program.args_with(args), ..program };
        // Before it runs for the first time, at `--describe`.
        if let (false, Err(error)) = (is_elsewhere, entry.pins().check_program(&program.path)) {
            diagnostics.push(entry.pin_at(RUN), of_node(entry, &error));
            continue;
        }
        let answer = asked.entry((program.path.clone(), program.args.clone())).or_insert_with(|| {
            let description = describe(&program.path, &program.args)?;
            description.validate().map_err(|error| error.to_string())?;
            Ok(description)
        });
        match answer {
            Ok(description) => {
                resolved[idx].operator = Some(Operator { program, description: description.clone() });
            }
            Err(error) => {
                let with_args = match program.args.as_slice() {
                    [] => String::new(),
                    args => format!(" with the arguments {}", quote(&args.join(" "))),
                };
                let program = quote_path(&program.path);
                diagnostics.push(run.at, format!("program {program}{with_args} cannot be used: {error}"));
            }
        }
    }
    make_up(&mut resolved, scope, folder);
    resolved
}

/// Compares the files that params name with their digests.
fn check_pins(
    entry: &NodeEntry,
    description: &OperatorDescription,
    params: &Map<String, Value>,
    diagnostics: &mut Diagnostics,
) -> Pins {
    let pins = entry.pins();
    let mut files = Vec::new();
    for param in &description.params {
        if matches!(param.kind, ParamKind::Path { .. }) {
            files.push(param.name.as_str());
        }
    }
    files.push(RUN);
    for PinEntry { of, .. } in entry.pins.iter().filter(|pin| pin.of.text != RUN) {
        if !files.contains(&of.text.as_str()) {
            let message = format!("'sha256' of node {}: there is no file {}", quote(&entry.id.text), quote(&of.text));
            let help = did_you_mean_or_list(&of.text, "files", files.iter().copied());
            diagnostics.push_with_help(of.at, message, help);
        } else if let Err(error) = pins.check_param(&of.text, params) {
            diagnostics.push(of.at, of_node(entry, &error));
        }
    }
    pins
}

fn of_node(entry: &NodeEntry, error: &PinError) -> String {
    let source = std::error::Error::source(error).map_or(String::new(), |source| format!(": {source}"));
    format!("node {}: {error}{source}", quote(&entry.id.text))
}

fn find_program(
    run: &Text,
    entry: &NodeEntry,
    folder: &Path,
    operators: &Operators,
    diagnostics: &mut Diagnostics,
) -> Option<Program> {
    if !run.text.contains('/') {
        if let Some(program) = operators.get(&run.text) {
            return Some(program.clone());
        }
        if entry.is_damaged && run.at == entry.id.at {
            // The id stands in for a 'run' that may be the key that was misspelled.
            return None;
        }
        // The id alone starts no program: a node may have the name of any.
        let is_written = run.at != entry.id.at;
        if let Some(program) = program_on_path(&run.text)
            && is_written
        {
            return Some(program.into());
        }
        let on_path = if is_written { "; no program of this name is on PATH" } else { "" };
        let help = format!("{}{on_path}; a path to a program has a '/'", operators.help_for(&run.text));
        diagnostics.push_with_help(run.at, format!("unknown operator {}", quote(&run.text)), Some(help));
        return None;
    }
    let program = absolute(folder, &run.text);
    let shown = quote_path(&program);
    match program.metadata() {
        Err(error) => diagnostics.push(run.at, format!("program {shown} cannot be used: {error}")),
        Ok(metadata) if !metadata.is_file() => diagnostics.push(run.at, format!("program {shown} is not a file")),
        Ok(metadata) if metadata.permissions().mode() & 0o111 == 0 => {
            let help = Some("chmod +x makes it so".to_owned());
            diagnostics.push_with_help(run.at, format!("program {shown} is not executable"), help);
        }
        Ok(_) => return Some(program.into()),
    }
    None
}

/// The connected inputs without mistakes, in the order of the description.
fn check_inputs(node: &ResolvedNode, resolved: &[ResolvedNode], diagnostics: &mut Diagnostics) -> Vec<Input> {
    let entry = node.entry;
    let node_name = format!("node {}", quote(&entry.id.text));
    // Without a description the sources can still be checked, the ports not.
    let ports = node.operator.as_ref().map(|operator| operator.description.inputs.as_slice());

    let mut connected = HashMap::new();
    for input in &entry.inputs {
        let port = ports.and_then(|ports| find_port(ports, &input.port.text));
        if let (Some(ports), None, false) = (ports, port, input.is_left_out_without_port) {
            let help = did_you_mean_or_list(&input.port.text, "inputs", port_names(ports));
            let message = format!("unknown input {} of {node_name}", quote(&input.port.text));
            diagnostics.push_with_help(input.port.at, message, help);
        }
        let Some(source) = &input.source else { continue };
        let Some(output) = find_output(source, resolved, diagnostics) else { continue };
        let Some(port) = port else { continue };
        if port.type_name != output.type_name {
            let message = format!(
                "input {} of {node_name} takes {}, but {}/{} gives {}",
                quote(&port.name),
                port.type_name,
                source.node,
                source.port,
                output.type_name
            );
            diagnostics.push_with_help(source.at, message, outputs_of_type(&port.type_name, resolved));
            continue;
        }
        check_partner(input, port, &node_name, diagnostics);
        connected.insert(port.name.as_str(), (source, input.edge));
    }

    let mut inputs = Vec::new();
    for port in ports.unwrap_or_default() {
        if let Some((source, edge)) = connected.get(port.name.as_str()) {
            inputs.push(Input {
                port: port.name.clone(),
                from_node: source.node.clone(),
                from_port: source.port.clone(),
                type_name: port.type_name.clone(),
                edge: *edge,
                feedback: port.feedback,
                partner: port.partner,
            });
        } else if !port.optional && !is_meant(entry, &port.name, ports.unwrap_or_default()) {
            let message = format!("{node_name} lacks the input {}, a {}", quote(&port.name), port.type_name);
            diagnostics.push_with_help(entry.inputs_at, message, outputs_of_type(&port.type_name, resolved));
        }
    }
    inputs
}

/// Whether the options of an edge that is there fit an input whose samples are found by their stamps, or another one.
fn check_partner(input: &InputEntry, port: &PortDescription, node_name: &str, diagnostics: &mut Diagnostics) {
    let is_paired = input.edge.tolerance_millis.is_some() || input.edge.partner_wait_millis.is_some();
    let name = quote(&port.name);
    if is_paired && !port.partner {
        let message = format!(
            "'tolerance_ms' and 'partner_wait_ms' have no meaning for input {name} of {node_name}: its samples are not found \
             by the stamps of those of another input"
        );
        diagnostics.push(input.port.at, message);
    }
    if port.partner && input.edge.on_late != OnLate::Count {
        let message = format!(
            "'on_late' of input {name} of {node_name} must be 'count': give 'partner_wait_ms' to say how long the node waits \
             for its samples"
        );
        diagnostics.push(input.port.at, message);
    }
}

/// Whether an input was given, rightly or wrongly, or an unknown input may be a misspelling of it.
fn is_meant(entry: &NodeEntry, name: &str, ports: &[PortDescription]) -> bool {
    entry.is_damaged
        || entry.inputs.iter().any(|input| {
            let given = input.port.text.as_str();
            given == name || (find_port(ports, given).is_none() && did_you_mean(given, [name]).is_some())
        })
}

fn find_output<'a>(
    source: &Source,
    resolved: &'a [ResolvedNode],
    diagnostics: &mut Diagnostics,
) -> Option<&'a PortDescription> {
    let Some(from) = resolved.iter().find(|node| node.entry.id.text == source.node) else {
        let mut help = None;
        if diagnostics.len() < MAX_MISTAKES_WITH_SIMILAR_NODES {
            let nodes = resolved.iter().map(|node| node.entry.id.text.as_str());
            help = did_you_mean_or_list(&source.node, "nodes", nodes);
        }
        diagnostics.push_with_help(source.at, format!("there is no node {}", quote(&source.node)), help);
        return None;
    };
    let outputs = &from.operator.as_ref()?.description.outputs;
    let output = find_port(outputs, &source.port);
    if output.is_none() {
        let help = did_you_mean_or_list(&source.port, "outputs", port_names(outputs));
        let message = format!("node {} has no output {}", quote(&source.node), quote(&source.port));
        diagnostics.push_with_help(source.at, message, help);
    }
    output
}

fn outputs_of_type(type_name: &str, resolved: &[ResolvedNode]) -> Option<String> {
    let mut found = Vec::new();
    for ResolvedNode { entry, operator } in resolved {
        for output in operator.iter().flat_map(|operator| &operator.description.outputs) {
            if output.type_name == type_name {
                found.push(format!("{}/{}", entry.id.text, output.name));
            }
        }
    }
    if found.is_empty() { None } else { Some(list("outputs of that type", found.iter().map(String::as_str))) }
}

fn find_port<'a>(ports: &'a [PortDescription], name: &str) -> Option<&'a PortDescription> {
    ports.iter().find(|port| port.name == name)
}

fn port_names(ports: &[PortDescription]) -> impl Iterator<Item = &str> + Clone {
    ports.iter().map(|port| port.name.as_str())
}
