//! The mistakes that a node's operator finds when it begins, found before anything is started: files that cannot be read,
//! params that do not go together, inputs that must not hold up the graph. An operator asks the same functions when it
//! begins.

use std::path::Path;
use std::process::{Command, ExitCode, Stdio};

use anyhow::{Context as _, bail};
use blindgrasp_graph::dataflow::{EdgePolicy, Graph, Node};
use blindgrasp_graph::operators::running_program;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::wiring::Sandbox;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::houses::{CHECK, house_of};
use crate::{Form, form_of};

/// A node as its dataflow file has it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FileNode {
    pub params: Map<String, Value>,
    /// The connected inputs, and whether each is lossless.
    pub inputs: Vec<(String, bool)>,
    pub has_sandbox: bool,
}

/// A node that could not begin, and why.
#[derive(Debug)]
pub struct UnableNode {
    pub node: String,
    pub reason: String,
}

/// The nodes of a graph that could not begin on the machine `here`; without it, on any machine. Nodes of other machines have their files there,
/// and programs of somebody's own are not asked.
pub fn unable_to_begin(graph: &Graph, here: Option<&str>) -> Vec<UnableNode> {
    let mut unable = Vec::new();
    for node in &graph.nodes {
        if here.is_some() && node.machine.is_some() && node.machine.as_deref() != here {
            continue;
        }
        if let Err(error) = check(node) {
            unable.push(UnableNode { node: node.id.clone(), reason: format!("{error:#}") });
        }
    }
    unable
}

/// Answers `PROGRAM operator NAME --check`, with a [`FileNode`] as JSON on stdin: the mistake goes to stderr, with exit code 1.
pub fn check_from_stdin(form: Form) -> ExitCode {
    let checked = match serde_json::from_reader(std::io::stdin()) {
        Ok(node) => (form.check)(&node),
        Err(error) => Err(anyhow::Error::from(error).context("stdin has no node as JSON")),
    };
    let Err(error) = checked else {
        return ExitCode::SUCCESS;
    };
    print_diagnostic(&format!("{error:#}"));
    ExitCode::FAILURE
}

fn check(node: &Node) -> anyhow::Result<()> {
    let inputs = node.inputs.iter().map(|input| (input.port.clone(), input.edge.policy == EdgePolicy::Lossless));
    let has_sandbox = node.sandbox != Sandbox::Off;
    let file_node = FileNode { params: node.params.clone(), inputs: inputs.collect(), has_sandbox };
    if let [word, name, ..] = node.args.as_slice()
        && word == "operator"
        && house_of(name, Some(&node.params)).is_some_and(|house| is_beside(&node.program, house))
    {
        return check_elsewhere(node, &file_node);
    }
    match form_of(&node.args) {
        Some(form) => (form.check)(&file_node),
        None => Ok(()),
    }
}

/// Whether a node's program is that of a house, or the one that hands over to it, in the folder of the running one: programs of
/// strangers are not asked.
fn is_beside(program: &Path, house: &str) -> bool {
    let Ok(running) = running_program() else { return false };
    program == running || program == running.with_file_name(house) || program == running.with_file_name("blindgrasp")
}

/// Asks the program of another house.
fn check_elsewhere(node: &Node, file_node: &FileNode) -> anyhow::Result<()> {
    let program = node.program.display();
    let mut child = Command::new(&node.program)
        .args(&node.args)
        .arg(CHECK)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("{program} cannot be started"))?;
    if let Some(stdin) = child.stdin.take() {
        // A program that ends before it has read says why.
        let _ = serde_json::to_writer(stdin, file_node);
    }
    let output = child.wait_with_output().with_context(|| format!("{program} {CHECK}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    let said = said.trim_end().trim_start_matches("blindgrasp: ");
    match output.status.code() {
        Some(0) => Ok(()),
        Some(1) => bail!("{said}"),
        _ => bail!("{program} failed at {CHECK} ({}): {said}", output.status),
    }
}
