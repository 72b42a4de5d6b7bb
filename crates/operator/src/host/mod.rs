//! A host: a process of blindgrasp that has the ports of an operator, and gives its samples to a program in any language.
//!
//! The program knows nothing of shared memory. It answers messages that come over a pipe ([`protocol`]). The host does all else
//! that an operator does: order, cursors, state, answers that must not be lost, commands of the launcher, signs of life. While
//! it waits for the program it gives no sign of life, so a program that hangs is an operator that hangs; one that dies or
//! sends nonsense ends the host with the reason. The program ends with its host, whatever it hangs in.

mod child;
mod ports;
pub mod protocol;
mod source;
mod stage;

use std::ffi::{OsStr, OsString};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::OnceLock;

use anyhow::Context as _;
use serde_json::{Map, Value};

use crate::description::OperatorDescription;
use crate::operator::{self, Operator, name_process};
use crate::sandbox::Sandbox;
use crate::wiring::{self, Enforcement, LogEntry, WIRING_VARIABLE, Wiring};
use crate::{monotonic_nanos, reports, sandbox};
use child::{Answer, Asides, Program};
use protocol::{Ask, HAS_STATE, Ready, Start, VERSION, Work};

/// The program of this process, if it is a host.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// The program of this process, if it is a host.
pub(crate) fn program() -> Option<PathBuf> {
    PROGRAM.get().cloned()
}

/// The `main` of a host: starts the program with its arguments, and works for it until the launcher asks for the end.
pub fn run(program: &OsStr, arguments: &[OsString]) -> ExitCode {
    if std::env::var_os(WIRING_VARIABLE).is_none() {
        crate::diagnostics::print_diagnostic(
            "this is the host of an operator: blindgrasp starts it as part of a graph (blindgrasp run dataflow.yaml)",
        );
        return ExitCode::from(2);
    }
    let _ = PROGRAM.set(program.into());
    reports::take();
    match started(program, arguments) {
        Ok((description, child)) => {
            operator::run_described(&description, |operator| work(operator, &description, child))
        }
        Err(error) => operator::failed(&error),
    }
}

/// How far the program of a host is restricted: it may read files and run programs, because its language may need both.
pub(crate) fn enforcement() -> Enforcement {
    sandbox::supported().min(Enforcement::Partial)
}

/// The program and what it says of itself. The process has no second thread yet.
fn started(program: &OsStr, arguments: &[OsString]) -> anyhow::Result<(OperatorDescription, Program)> {
    let wiring = std::env::var(WIRING_VARIABLE).with_context(|| format!("{WIRING_VARIABLE} is not UTF-8"))?;
    let wiring: Wiring =
        serde_json::from_str(&wiring).with_context(|| format!("{WIRING_VARIABLE} is not a wiring of this version"))?;
    let description = wiring.hosted.context("its wiring does not describe its program: it is of another version")?;
    name_process(&description.operator);
    let is_restricted = wiring.sandbox != wiring::Sandbox::Off && enforcement() != Enforcement::None;
    if !is_restricted {
        return Ok((description, Program::spawn(program, arguments, || Ok(()))?));
    }
    let sandbox = Sandbox::of_program(&description, &wiring.params);
    sandbox::enter_scope().context("the sandbox cannot be entered")?;
    let spawned = Program::spawn(program, arguments, move || {
        sandbox.enter_program().map_err(std::io::Error::other)?;
        Ok(())
    });
    Ok((description, spawned?))
}

fn work(operator: &Operator, description: &OperatorDescription, mut child: Program) -> anyhow::Result<()> {
    let ready = start(operator, description, &mut child);
    log(operator, child.lines());
    let ready = ready?;
    if ready.is_source {
        source::run(operator, description, ready, child)
    } else {
        stage::run(operator, description, ready, child)
    }
}

/// Gives the program its parameters.
fn start(operator: &Operator, description: &OperatorDescription, child: &mut Program) -> anyhow::Result<Ready> {
    let inputs = description.inputs.iter().map(|port| port.name.as_str());
    child.ask_json(
        Ask::Start,
        &Start {
            version: VERSION,
            params: operator.all_params(),
            inputs: inputs.filter(|port| operator.has_input(port)).collect(),
            is_standby: operator.begins_as_standby(),
            clock: operator.clock(),
        },
    )?;
    let ready: Ready = child.ready()?;
    check(description, &ready).map_err(anyhow::Error::msg)?;
    Ok(ready)
}

/// Gives the program new values of its live parameters; the inner error is its reason to refuse them.
fn set(child: &mut Program, params: &Map<String, Value>) -> anyhow::Result<Result<(), String>> {
    child.ask_json(Ask::Set, params)?;
    match child.answer(Ask::Set)? {
        Answer::Refused(reason) => Ok(Err(reason)),
        answer => answer.done().map(|_| Ok(())),
    }
}

/// Gives the program a state, or lets it begin anew.
fn restore(child: &mut Program, state: Option<&[u8]>) -> anyhow::Result<Work> {
    let flags = if state.is_some() { HAS_STATE } else { 0 };
    child.ask(Ask::Restore, monotonic_nanos(), flags, state.unwrap_or_default(), std::iter::empty())?;
    child.answer(Ask::Restore)?.done()
}

/// Refuses a program that cannot keep its promises.
fn check(description: &OperatorDescription, ready: &Ready) -> Result<(), String> {
    let n_main = description.inputs.iter().filter(|port| !port.partner).count();
    let is_fed = description.inputs.iter().any(|port| !port.feedback);
    if ready.is_source && is_fed {
        return Err(format!(
            "its program is a source, and the operator has {} inputs: expected a stage, or feedback inputs alone",
            description.inputs.len()
        ));
    }
    if !ready.is_source && !is_fed {
        return Err("the operator has no input but feedback: expected that its program is a source".into());
    }
    if !ready.is_source && n_main != 1 && n_main < description.inputs.len() {
        return Err(format!(
            "it has {n_main} inputs besides partners: expected one, whose samples the partners belong to"
        ));
    }
    if description.answers_each && n_main != 1 {
        return Err(format!("it has {n_main} inputs and answers each sample: expected one input"));
    }
    if ready.has_state && ready.resumes {
        return Err(
            "its source has `resume` and a state: expected one of them, because `resume` says where it goes on".into(),
        );
    }
    let has =
        |name: &String, ports: &[crate::description::PortDescription]| ports.iter().any(|port| port.name == *name);
    for (output, input) in &ready.answers {
        if !has(output, &description.outputs) || !has(input, &description.inputs) {
            return Err(format!(
                "output {output} is to answer the input {input}: expected an output and an input that it has"
            ));
        }
    }
    if let Some(output) = ready.max_items.keys().find(|output| !has(output, &description.outputs)) {
        return Err(format!("it limits the items of the output {output}, which it does not have"));
    }
    Ok(())
}

/// Passes on the log lines of a program.
fn log(operator: &Operator, lines: Vec<LogEntry>) {
    for line in lines {
        operator.log(line);
    }
}

/// Listens to a program that has nothing to do, some times a second: it may have said something, or ended.
fn listen(operator: &Operator, child: &mut Program) -> anyhow::Result<()> {
    let Asides { lines, counts } = child.listen()?;
    log(operator, lines);
    if !counts.is_empty() {
        operator.has_counted(counts);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn description(n_inputs: usize) -> OperatorDescription {
        let names = ["a", "b", "c"].into_iter().take(n_inputs);
        names.fold(OperatorDescription::new("mine", ""), |made, name| made.input(name, "t", "")).output("out", "t", "")
    }

    fn refused(description: &OperatorDescription, ready: Ready, reason: &str) {
        let error = check(description, &ready).expect_err(reason);
        assert!(error.contains(reason), "{error}");
    }

    #[test]
    fn programs_that_cannot_keep_their_promises_are_refused() {
        let source = || Ready { is_source: true, ..Ready::default() };
        let stateful = || Ready { has_state: true, ..Ready::default() };
        refused(&description(1), source(), "expected a stage");
        refused(&description(0), Ready::default(), "expected that its program is a source");
        refused(&description(2).answers_each(), Ready::default(), "expected one input");
        refused(&description(2).partner_input("p", "t", ""), Ready::default(), "besides partners: expected one");
        refused(&description(0), Ready { resumes: true, has_state: true, ..source() }, "has `resume` and a state");
        let answers = [("out".to_owned(), "z".to_owned())].into();
        refused(&description(1), Ready { answers, ..Ready::default() }, "expected an output and an input that it has");
        refused(&description(1), Ready { max_items: [("z".into(), 1)].into(), ..Ready::default() }, "limits the items");
        for (description, ready) in [
            (description(1).answers_each(), Ready::default()),
            (description(1).answers_each(), stateful()),
            (description(2), stateful()),
            (description(0), source()),
            (description(0).feedback_input("f", "t", ""), source()),
            (description(1).partner_input("p", "t", "").answers_each(), Ready::default()),
        ] {
            assert_eq!(check(&description, &ready), Ok(()));
        }
    }
}
