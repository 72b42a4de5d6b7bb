//! Dataflow files with the operators that come with blindgrasp, checked.

use std::path::Path;

use anyhow::{Context, bail};
use serde_json::Value;

use crate::houses::robot_program;
use blindgrasp_graph::client::status;
use blindgrasp_graph::control::SwapRequest;
use blindgrasp_graph::dataflow::{self, DataflowError, DataflowFile, Diagnostic, Graph, Override, Scope};
use blindgrasp_graph::describe;
use blindgrasp_graph::operators::Operators;
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operators::beginning::{UnableNode, unable_to_begin};
use blindgrasp_operators::fit::{Fit, Misfit, MisfitKind, Part, check_fit, parts_of, running_parts};
use blindgrasp_operators::{SHIPPED, form_of, operators_of};

/// What becomes of a graph with which nothing can be lifted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnMisfit {
    Refuse,
    Warn,
}

/// The operators that come with blindgrasp.
///
/// # Errors
/// The path of the running program is unknown.
pub fn shipped() -> anyhow::Result<Operators> {
    Ok(operators_of(&robot_program().context("the path of this program is unknown")?))
}

/// Ports and parameters of an operator. A robot's operator is described without starting a process.
///
/// # Errors
/// As [`describe::describe`].
pub fn describe(program: &Path, args: &[String]) -> Result<OperatorDescription, String> {
    // The path of a running program that was replaced on the disk is another one, so that the new program is asked.
    if std::env::current_exe().is_ok_and(|running| running == program)
        && let Some(form) = form_of(args)
    {
        return Ok((form.describe)());
    }
    describe::describe(program, args)
}

/// The graph of a file, which need not be able to lift.
pub fn checked(file: &DataflowFile, overrides: &[Override], scope: Scope<'_>) -> anyhow::Result<Graph> {
    Ok(dataflow::check(file, &shipped()?, overrides, scope, describe)?)
}

/// As [`checked`]; arbiter, model and hand are compared as well.
pub fn fitting(
    file: &DataflowFile,
    overrides: &[Override],
    scope: Scope<'_>,
    on_misfit: OnMisfit,
) -> anyhow::Result<Graph> {
    let graph = checked(file, overrides, scope)?;
    let mut parts = parts_of(&graph);
    if let Scope::Machine(here) = scope {
        // The files of another machine are not those of the same names here.
        for (part, node) in parts.iter_mut().zip(&graph.nodes) {
            if node.machine.as_deref().is_some_and(|machine| machine != here) {
                part.params.remove("hand");
                part.params.remove("model");
            }
        }
    }
    let Fit { mut errors, mut warnings } = check_fit(&parts);
    if on_misfit == OnMisfit::Warn {
        warnings.append(&mut errors);
    }
    warnings.iter().for_each(warn);
    let diagnostics: Vec<Diagnostic> = errors.into_iter().map(|misfit| diagnostic(file, misfit)).collect();
    if diagnostics.is_empty() {
        return Ok(graph);
    }
    Err(DataflowError { diagnostics }.into())
}

/// As [`fitting`]; each operator that comes with blindgrasp is asked as well whether it could begin.
pub fn able_to_begin(
    file: &DataflowFile,
    overrides: &[Override],
    scope: Scope<'_>,
    on_misfit: OnMisfit,
) -> anyhow::Result<Graph> {
    let graph = fitting(file, overrides, scope, on_misfit)?;
    let here = match scope {
        Scope::Everything => None,
        Scope::Machine(here) => Some(here),
    };
    let diagnostics = unable_to_begin(&graph, here).into_iter().map(|UnableNode { node, reason }| Diagnostic {
        file: file.path().into(),
        at: file.position_of(&node),
        setting: None,
        message: format!("node '{node}': {reason}"),
        help: None,
    });
    let diagnostics: Vec<Diagnostic> = diagnostics.collect();
    if diagnostics.is_empty() { Ok(graph) } else { Err(DataflowError { diagnostics }.into()) }
}

fn diagnostic(file: &DataflowFile, misfit: Misfit) -> Diagnostic {
    let Misfit { node, message, help, .. } = misfit;
    Diagnostic {
        file: file.path().into(),
        at: file.position_of(&node),
        setting: None,
        message: format!("node '{node}': {message}"),
        help: Some(help),
    }
}

/// Refuses a swap after which the arbiter could not lift any more. The launcher itself compares hands and features.
///
/// # Errors
/// The graph does not answer, or the reasons.
pub fn refuse_misfit(graph: &str, request: &SwapRequest) -> anyhow::Result<()> {
    let before = running_parts(&status(graph)?);
    let mut after = before.clone();
    for part in after.iter_mut().filter(|part| request.nodes.contains(&part.node)) {
        if let Some(run) = &request.program {
            let shipped = SHIPPED.iter().find(|shipped| run.to_str() == Some(shipped.name));
            part.operator = shipped.map_or(String::new(), |shipped| shipped.name.into());
        }
        for (name, text) in &request.set {
            let value = if name == "model" { request.folder.join(text).display().to_string() } else { text.clone() };
            part.params.insert(name.clone(), value.into());
        }
    }
    for misfit in new_misfits(&before, &after) {
        if request.allow_mismatch || misfit.kind == MisfitKind::Bound {
            warn(&misfit);
            continue;
        }
        let Misfit { node, message, help, .. } = misfit;
        bail!("not swapped: node '{node}': {message}; {help}; or say --allow-mismatch")
    }
    Ok(())
}

/// Warns if a node's new param keeps the arbiter from lifting.
///
/// # Errors
/// The graph does not answer.
pub fn warn_of_misfit(graph: &str, node: &str, param: &str, value: &Value) -> anyhow::Result<()> {
    let before = running_parts(&status(graph)?);
    let mut after = before.clone();
    for part in after.iter_mut().filter(|part| part.node == node) {
        part.params.insert(param.into(), value.clone());
    }
    new_misfits(&before, &after).iter().for_each(warn);
    Ok(())
}

/// What keeps an arbiter from lifting after a change, or voids a bound on drops, and did not before.
fn new_misfits(before: &[Part], after: &[Part]) -> Vec<Misfit> {
    let misfits = |parts: &[Part]| {
        let fit = check_fit(parts);
        let counts = |misfit: &Misfit| matches!(misfit.kind, MisfitKind::Probe | MisfitKind::Bound);
        fit.errors.into_iter().chain(fit.warnings).filter(counts).collect::<Vec<_>>()
    };
    let old = misfits(before);
    let mut new = misfits(after);
    new.retain(|misfit| !old.contains(misfit));
    new
}

fn warn(misfit: &Misfit) {
    let Misfit { node, message, help, .. } = misfit;
    print_diagnostic(&format!("warning: node '{node}': {message}; {help}"));
}
